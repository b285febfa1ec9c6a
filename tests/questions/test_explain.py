"""`explain` on stored sweeps, without a renderer: what it reads, what it would render, what it answers and prints."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as iio
import numpy as np
import pandas as pd
import pytest
import torch

import advsearch
from advsearch.cli.main import main
from advsearch.errors import FileFormatError, InputError
from advsearch.experiment import RunContext
from advsearch.progress import NullProgress
from advsearch.questions.explain import renders as explaining
from advsearch.questions.explain.importance import find_importance
from advsearch.questions.explain.result import ExplainResult, describe_pairs
from advsearch.questions.explain.rows import read_predictions
from advsearch.questions.explain.sweeps import is_settable, make_sweep_along, make_sweep_inside
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.stored import StoredSweep
from advsearch.rules import (
    CountedRule,
    RuleCondition,
    find_covered,
    find_rules,
    make_table,
    merge_repeats,
    split_in_halves,
)
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import NAME, Row, Store
from advsearch.runs.summary import read_result
from samples import sweep
from stored_sweeps import described, make_sweep, seen

HIGH = 60.0


@pytest.fixture
def swept(tmp_path: Path) -> Path:
    """A sweep whose model is wrong from high above."""
    return stored(tmp_path / "swept", lambda elevation: elevation > HIGH)


def stored(path: Path, wrong: Any, rows: int = 600, model: str = "reference", seed: int = 0) -> Path:
    config = SweepConfig(object="mug", controls="camera,light", samples=rows, run=str(path), model=model, seed=seed)
    generator = np.random.default_rng(1)
    with RunDirectory.create_for(config) as run:
        made = []
        for step in range(rows):
            elevation, power = generator.uniform(5.0, 85.0), generator.uniform(0.0, 2.0)
            is_wrong = bool(wrong(elevation)) ^ (generator.random() < 0.03)
            values = {
                "camera.elevation": described(elevation, "degrees"),
                "light.power": described(power, "1"),
                "model": described("reference"),
            }
            label = "bowl" if is_wrong else "mug"
            made.append(Row("sweep", step, correct=not is_wrong, margin=0.5, label=label, values=values))
        run.append_rows(*made, *(Row("verification", step, correct=False, label="bowl") for step in range(20)))
        right = sum(bool(one.correct) for one in made)
        counts = {"configurations": rows, "correct": right, "accuracy": right / rows, "interval": (0.0, 1.0)}
        run.write_summary(sweep(**counts, planned=rows, run=str(path)))
    return path


def test_a_rule_is_found_in_stored_rows(swept: Path, tmp_path: Path) -> None:
    result = advsearch.explain(swept, confirm=0, pairs=0, clusters=0, accuracy=0.9, run=tmp_path / "run")
    (rule,) = result.rules
    assert [one.parameter for one in rule.conditions] == ["camera.elevation"]
    over = rule.conditions[0].over
    assert over is not None and abs(over - HIGH) < 3.0 and rule.conditions[0].at_most is None
    assert rule.right < 0.15 * rule.total and rule.elsewhere.right > 0.9 * rule.elsewhere.total and not rule.confirmed
    assert result.importance[0].parameters == ["camera.elevation"] and result.envelope is not None
    assert result.parameters == ["camera.elevation", "light.power"] and result.renders == 0
    kept = read_result(tmp_path / "run")
    assert isinstance(kept, ExplainResult) and kept.rules == result.rules
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert f"camera.elevation over {over:g} degrees" in page and "<script" not in page.split("<main")[1]


@pytest.mark.medium
def test_json_says_right_of_and_interval(swept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = [
        "explain",
        str(swept),
        "--confirm",
        "0",
        "--pairs",
        "0",
        "--clusters",
        "0",
        "--accuracy",
        "0.9",
        "--run",
        str(tmp_path / "run"),
    ]
    assert main([*asked, "--json"]) == 0
    rule = json.loads(capsys.readouterr().out)["rules"][0]
    assert rule["right"] < rule["of"] and rule["interval"][0] < rule["interval"][1] and rule["confirmed"] is None
    assert rule["conditions"][0]["text"].startswith("camera.elevation over 6")
    assert main([*asked, "--overwrite"]) == 0
    text = capsys.readouterr().out
    assert "1. camera.elevation over 6" in text and "Where it can be relied on\nAt least" in text


def test_a_rule_is_confirmed_by_what_is_rendered_inside_it(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[SweepConfig] = []

    def rendered(self: Any, name: str, config: SweepConfig) -> pd.DataFrame:
        asked.append(config)
        outside = np.arange(10) == 9
        elevation = np.where(outside, 10.0, 70.0)
        return pd.DataFrame({"camera.elevation": elevation, "correct": outside, "unit": np.arange(10), "label": ""})

    monkeypatch.setattr(explaining.Renders, "render_rows", rendered)
    result = advsearch.explain(swept, confirm=10, pairs=0, clusters=0, run=tmp_path / "run")
    confirmed = result.rules[0].confirmed
    assert confirmed is not None and (confirmed.right, confirmed.total) == (0, 9)  # what lies outside is not counted
    low, high = np.asarray(asked[0].controls["camera"]["elevation"], dtype=float)
    assert 57.0 < low < 63.0 and 84.0 < high <= 85.0 and asked[0].controls["light"] == {}
    assert asked[0].samples == 10 and asked[0].seed != 0 and asked[0].trials == 0


@pytest.mark.medium
def test_a_rule_about_the_distance_is_confirmed_by_fresh_pictures(tmp_path: Path) -> None:
    """As docs/explain.md has it: the distance on a grid, the direction drawn beside it, by the same control."""
    advsearch.sweep(
        "mug", "small_models:near", {"camera.distance": [0.2, 0.3, 0.4, 0.6, 0.9, 1.4]},
        controls={"camera": {"azimuth": [0, 360]}}, samples=24, sampler="random", trials=0, resolution=16, spp=1,
        denoise="none", run=tmp_path / "swept",
    )  # fmt: skip
    result = advsearch.explain(tmp_path / "swept", confirm=20, pairs=0, clusters=0, run=tmp_path / "run")
    rule = result.rules[0]
    (far,) = (one for one in rule.conditions if one.parameter == "camera.distance")
    assert far.unit == "metres" and far.over is not None and 0.3 < far.over < 0.9 and far.at_most is None
    assert rule.confirmed is not None and rule.confirmed.held and rule.confirmed.total >= 20
    assert result.renders >= rule.confirmed.total and not result.warnings
    text = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Fresh renders inside it" in text and "; confirmed." in text


@pytest.mark.medium
def test_fresh_pictures_vary_as_the_sweep_did_and_count_beyond_the_rules_before(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = seen({"camera.elevation": [5.0, 85.0], "camera.azimuth": [10.0, 350.0]}, np.array([True, False]))
    config = SweepConfig(object="mug", controls={"camera": {}}, samples=2)
    high = (RuleCondition("camera.elevation", low=60.0),)
    made = make_sweep_inside(config, table, high, 20, 7)
    assert made.controls == {"camera": {"elevation": [60.0, 85.0], "azimuth": [10.0, 350.0]}}
    end_on = RuleCondition("camera.azimuth", "degrees", 160.0, 20.0, turn=180.0)
    drawn = [make_sweep_inside(config, table, (end_on,), 20, 7, arc).controls["camera"]["azimuth"] for arc in (0, 1)]
    assert drawn == [[160.0, 200.0], [340.0, 380.0]]
    hue = SweepConfig(object="mug", controls={"background": {"hue": [0, 360]}}, samples=2)
    around = RuleCondition("background.hue", "degrees", 340.0, 20.0, turn=360.0)
    colours = seen({"background.hue": [0.0, 359.0]}, np.array([True, False]))
    assert make_sweep_inside(hue, colours, (around,), 20, 7).controls == hue.controls, "a hue ends at 360"

    def rendered(self: Any, name: str, config: SweepConfig) -> pd.DataFrame:
        elevation = np.linspace(20.0, 80.0, 40)
        made = {"camera.elevation": elevation, "correct": elevation <= 70, "unit": np.arange(40)}
        return pd.DataFrame({**made, "label": ""})

    monkeypatch.setattr(explaining.Renders, "render_rows", rendered)
    rows = read_predictions([StoredSweep.read(swept)])
    whole = make_table(rows, rows.attrs["units"])
    below, above = whole["camera.elevation"] <= 50, whole["camera.elevation"] > 70
    rules = [
        CountedRule((RuleCondition("camera.elevation", low=70.0),), whole[above], whole[~above]),
        CountedRule((RuleCondition("camera.elevation", low=50.0),), whole[~below & ~above], whole[below]),
    ]
    asked: Any = SimpleNamespace(
        config=SimpleNamespace(confirm=20, seed=0), progress=NullProgress(), run=SimpleNamespace(path=tmp_path)
    )
    renders = explaining.Renders(asked, [StoredSweep.read(swept)], rows, whole)
    first, second = (renders.confirm_rule(rules, number) for number in range(2))
    assert first is not None and (first.right, first.total, first.held) == (0, 7, True)
    assert second is not None and (second.right, second.total, second.held) == (13, 13, False), "not those of the first"


@pytest.mark.medium
def test_the_nearest_right_prediction_differs_in_one_value(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rendered(self: Any, name: str, config: SweepConfig) -> pd.DataFrame:
        high, power = config.grid["camera.elevation"], config.grid["light.power"]
        assert isinstance(high, list) and isinstance(power, list) and min(len(high), len(power)) == 1
        made = pd.DataFrame({"camera.elevation": a, "light.power": b} for a in high for b in power)
        right = made["camera.elevation"] <= HIGH
        self.n_renders += len(made)
        return made.assign(correct=right, label=np.where(right, "mug", "bowl"))

    monkeypatch.setattr(explaining.Renders, "render_rows", rendered)
    result = advsearch.explain(swept, confirm=0, pairs=1, clusters=0, run=tmp_path / "run")
    (pair,) = result.pairs
    assert pair.parameter == "camera.elevation" and float(pair.wrong_at) > HIGH >= float(pair.right_at) > 50.0
    assert (pair.answered, pair.answered_there) == ("bowl", "mug") and result.pairs_sought == 1
    several = advsearch.explain(swept, confirm=0, pairs=12, clusters=0, run=tmp_path / "several")
    assert several.pairs_sought == 12 and several.pairs[0] == pair and len(several.pairs) >= 6
    assert len({str(one.values) for one in several.pairs}) == len(several.pairs)
    left = several.total - several.right - 12
    assert f"Of the 12 most typical of {left + 12} failures, {len(several.pairs)} are right" in describe_pairs(several)
    assert f"The other {left} were not tried" in describe_pairs(several)


def test_nothing_is_counted_of_failures_for_which_nothing_was_rendered(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*given: Any) -> Any:
        raise InputError("a file names Python code that nobody allowed")

    monkeypatch.setattr(RunContext, "run_part", refuse)
    result = advsearch.explain(swept, confirm=0, pairs=3, clusters=0, run=tmp_path / "run")
    assert (result.renders, result.pairs_sought, result.pairs) == (0, 0, [])
    text = str(result)
    assert "once one parameter is another" not in text and "Nothing was rendered for pair-1" in text


def test_typical_failures_take_turns_between_rules_and_those_under_none() -> None:
    """Failures at 1, 2 and 3 are under the rule, of which 2 is in the middle; one at 9 is not."""
    table = seen({"yaw": [1.0, 2.0, 3.0, 9.0, 10.0]}, np.array([False, False, False, False, True]))
    under = table["yaw"] <= 5.0
    rule = CountedRule((RuleCondition("yaw", high=5.0),), table[under], table[~under])
    order = explaining.find_typical_failures(table, [rule], 12)
    assert [index for index, _ in order[:2]] == [1, 3] and {index for index, _ in order[2:]} == {0, 2}
    assert order[0][1] == rule.conditions and order[1][1] == ()
    assert (
        explaining.find_typical_failures(table, [], 2)[0][1] == ()
        and len(explaining.find_typical_failures(table, [], 2)) == 2
    )


@pytest.mark.medium
def test_what_cannot_be_explained_is_refused_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = make_sweep(tmp_path / "few")
    with pytest.raises(InputError, match="expected at least 100 rows, got 24"):
        advsearch.explain(few)
    with pytest.raises(InputError, match="unknown run"):
        advsearch.explain("nothing")
    assert main(["explain"]) == 2 and "expected the run of a sweep" in capsys.readouterr().err
    assert main(["explain", ","]) == 2 and "expected names or folders" in capsys.readouterr().err
    same = stored(tmp_path / "same", lambda elevation: False, rows=120)
    kept = advsearch.explain(same, confirm=0, pairs=0, run=tmp_path / "run")
    assert kept.rules == []
    with pytest.raises(FileFormatError, match="expected the run of a sweep"):
        advsearch.explain(tmp_path / "run")


TABLE = seen(
    {
        "pose.yaw": np.repeat([0.0, 90.0, 180.0], 4),
        "environment": ["noon", "noon", "studio", "studio"] * 3,
        "light.power": np.tile([0.5, 1.5], 6),
    },
    np.ones(12, dtype=bool),
)


def test_of_predictions_without_a_law_it_is_said_that_nothing_decides_and_how_many_rows_a_rule_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    faint = stored(tmp_path / "faint", lambda elevation: np.random.default_rng(int(1e6 * elevation)).random() < 0.5)
    asked = ["explain", str(faint), "--confirm", "0", "--pairs", "0", "--clusters", "0", "--run", str(tmp_path / "run")]
    assert main(asked) == 0
    said = capsys.readouterr().out
    assert "No rule is told from chance in 600 rows, of which one half chooses and the other counts" in said
    assert "No parameter is shown to decide anything" in said
    kept = read_result(tmp_path / "run")
    assert isinstance(kept, ExplainResult) and kept.rules == []
    rule = kept.not_told
    assert rule is not None and rule.chance > rule.asked == 0.01 and f"right in {rule.right} of {rule.total}" in said
    assert rule.rows is None or (
        rule.rows > 600 and f"About {rule.rows:,} rows with these shares would tell it" in said
    )
    assert all(one.interval[0] == 0.0 < one.interval[1] < 0.05 for one in kept.importance)


def test_a_sweep_inside_conditions_keeps_what_they_leave() -> None:
    config = SweepConfig(
        object="mug", environment="studio,noon", grid={"pose.yaw": [0.0, 90.0, 180.0]}, controls={"light": {}}
    )
    conditions = (
        RuleCondition("pose.yaw", low=45.0),
        RuleCondition("environment", options=frozenset({"studio"})),
        RuleCondition("light.power", high=1.0),
    )
    made = make_sweep_inside(config, TABLE, conditions, 20, 7)
    assert made.grid == {"pose.yaw": [90.0, 180.0]} and made.environment == "studio" and made.samples == 10
    assert made.controls == {"light": {"power": [0.5, 1.0]}} and made.seed == 7 and made.spp == config.spp
    fresh = pd.DataFrame({"pose.yaw": 90.0, "environment": ["studio", "noon"], "light.power": 0.7})
    assert find_covered(conditions, fresh).tolist() == [True, False]


def test_a_sweep_along_a_factor_keeps_the_rest() -> None:
    config = SweepConfig(
        object="mug,bowl", environment="studio,noon", controls={"light": {}}, set_={"light.power": 1.0}, workers=2
    )
    row: dict[str, float | str] = {
        "object": "bowl", "environment": "noon", "model": "reference", "pose.yaw": 90.0, "light.power": 0.5,
    }  # fmt: skip
    made = make_sweep_along(config, row, "pose.yaw", TABLE, 3)
    assert made.object == "bowl" and made.environment == "noon" and made.controls == {} and made.keep_pictures == "all"
    assert made.grid["pose.yaw"][0] == 90.0 and len(made.grid["pose.yaw"]) == 9  # type: ignore[index, arg-type]
    assert made.grid["light.power"] == [0.5] and made.to_json()["set"] == {} and made.workers is None
    lit = make_sweep_along(config, row, "environment", TABLE, 3)
    assert lit.environment == "noon,studio" and lit.grid["pose.yaw"] == [90.0]


def test_numbers_that_follow_from_others_and_axes_are_not_asked_for_again() -> None:
    """A row of a drive has its distance, which follows from the time; a control may be drawn beside an axis of it."""
    row: dict[str, float | str] = {
        "object": "mug", "environment": "noon", "model": "reference", "path.time": 1.0, "path.distance": 4.0,
    }  # fmt: skip
    values = {"path.time": [0.0, 1.0], "path.distance": [5.0, 4.0], "camera.fov": [30.0, 40.0]}
    table = seen(values, np.array([False, True]))
    drive = SweepConfig(object="mug", path="approach", fps=1.0, controls={"path": {"reach": 8.0}})
    made = make_sweep_along(drive, row, "path.time", table, 3)
    assert list(made.grid) == ["path.time"] and not is_settable(drive, "path.distance")
    assert made.controls == {"path": {"reach": 8.0}}, "as far as the drive went"
    conditions = tuple(RuleCondition(name, low=0.0) for name in values)
    assert make_sweep_inside(drive, table, conditions, 20, 7).controls == {"path": {"reach": 8.0}}
    beside = SweepConfig(object="mug", grid={"camera.fov": [30.0, 40.0]}, controls={"camera": {"roll": [-5, 5]}})
    inside = make_sweep_inside(beside, table, (RuleCondition("camera.fov", low=35.0),), 20, 7)
    assert inside.controls == {"camera": {"roll": [-5, 5]}} and inside.grid == {"camera.fov": [40.0]}


class Read:
    """Features that tell the lighter pictures from the darker ones."""

    source = "twelve numbers"

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        sides = (images[:, 0, 0, :1] - 0.5) * torch.linspace(-8.0, 8.0, 12)
        return sides + torch.randn(sides.shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.medium
def test_failures_are_grouped_by_what_the_model_decides_by(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    def again(self: Any, sweep: StoredSweep, numbers: Any) -> tuple[torch.Tensor, Read]:
        """Dark pictures of even rows and light ones of odd rows."""
        asked.extend(numbers)
        shades = torch.tensor([0.2 + 0.6 * (number % 2) for number in numbers])
        return shades[:, None, None, None].expand(-1, 4, 4, 3), Read()

    monkeypatch.setattr(explaining.Renders, "render_again", again)
    result = advsearch.explain(swept, confirm=0, pairs=0, clusters=50, run=tmp_path / "run")
    found = result.clusters
    assert found is not None and found.apart and found.failures == 50 == len(set(asked)) and result.renders == 50
    with Store(swept / NAME, read_only=True) as store:
        assert all(not row.correct for row in store.rows("sweep") if row.step in asked)
    odd = sum(number % 2 for number in asked)
    assert sorted(one.failures for one in found.listed) == sorted([odd, 50 - odd])
    assert all(sum(one.answers.values()) == one.failures and "bowl" in one.answers for one in found.listed)
    shades = {round(float(iio.imread(tmp_path / "run" / one.picture).mean()) / 255.0, 1) for one in found.listed}
    assert shades == {0.2, 0.8}
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "2 kinds among the 50 failures" in page and page.count("data:image/png") == 2
    assert main(["show", str(tmp_path / "run")]) == 0
    assert "images/cluster-1.png" in capsys.readouterr().out


@pytest.mark.medium
def test_failures_of_all_sweeps_of_a_model_are_grouped_together(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = stored(tmp_path / "second", lambda elevation: elevation > HIGH, seed=1)
    third = stored(tmp_path / "third", lambda elevation: elevation > HIGH, model="third")
    asked: list[str] = []

    def again(self: Any, sweep: StoredSweep, numbers: Any) -> tuple[torch.Tensor, Read]:
        asked.append(sweep.config.model)
        return torch.full((len(numbers), 4, 4, 3), 0.6 * len(asked) - 0.4), Read()

    monkeypatch.setattr(explaining.Renders, "render_again", again)
    result = advsearch.explain([swept, second, third], confirm=0, pairs=0, clusters=60, run=tmp_path / "run")
    found = result.clusters
    assert asked == ["reference"] * 2 and found is not None and found.failures == 60
    assert found.apart and len(found.listed) == 2
    assert any("Kinds are of the failures of model reference alone" in text for text in result.warnings)


# ---- the same draw, come twice ---------------------------------------------------------------------------------------


def test_a_table_in_which_rows_come_twice_tells_no_rule_by_that() -> None:
    """Two sweeps of 200 and 400 rows of one seed, without any effect, whose units say nothing of it."""
    told, runs = 0, 30
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        values, correct = rng.random((200, 2)) * 100.0, rng.random(200) < 0.7
        table = pd.DataFrame(values, columns=["camera.elevation", "light.power"]).assign(correct=correct)
        twice = pd.concat([table, table[:100]], ignore_index=True)
        twice["unit"] = np.arange(len(twice))
        twice.attrs["units"] = {"camera.elevation": "degrees", "light.power": "1"}
        merged = merge_repeats(twice)
        assert merged["unit"].nunique() == 200 and (merged["unit"][:100] == merged["unit"][200:].to_numpy()).all()
        choosing, counting = split_in_halves(twice, seed)
        assert not {*choosing["light.power"]} & {*counting["light.power"]}
        told += bool(find_rules(choosing, counting, seed).accepted)
    assert told <= 1


def test_values_of_a_grid_come_again_in_independent_rows() -> None:
    table = pd.DataFrame({"pose.yaw": np.repeat([0.0, 90.0], 50), "correct": True, "unit": np.arange(100)})
    table.attrs["units"] = {"pose.yaw": "degrees"}
    assert merge_repeats(table)["unit"].nunique() == 100


def test_few_drives_with_many_frames_in_view_do_not_make_a_parameter_decide() -> None:
    """One drive of ten has the object in 12 frames, the others in one; nothing decides. 2.5 of 100 are asked."""
    decides, runs = 0, 80
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        frames = np.where(rng.random(60) < 0.1, 12, 1)
        right = rng.random(frames.sum()) < np.repeat(rng.beta(0.5, 0.2, 60), frames)
        elevation = np.repeat(rng.random(60), frames)
        table = pd.DataFrame({"camera.elevation": elevation, "correct": right, "unit": np.repeat(range(60), frames)})
        table.attrs["units"] = {"camera.elevation": "degrees"}
        decides += any(weight.interval[0] > 0.0 for weight in find_importance(table))
    assert decides <= 6
