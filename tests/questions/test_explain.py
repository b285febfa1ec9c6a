"""`explain` on stored sweeps, without a renderer: what it reads, what it would render, what it answers and prints."""

from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pandas as pd
import pytest
import torch

import advsearch
from advsearch.cli.main import main
from advsearch.questions.explain import renders as explaining
from advsearch.questions.explain.importance import find_importance
from advsearch.questions.explain.result import ExplainResult
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.stored import StoredSweep
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import NAME, Row, Store
from advsearch.runs.summary import read_result
from samples import sweep
from stored_sweeps import described

pytestmark = pytest.mark.island("advsearch.questions.explain")

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


def test_a_rule_is_confirmed_by_what_is_rendered_inside_it(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[SweepConfig] = []

    def rendered(self: Any, name: str, config: SweepConfig) -> pd.DataFrame:
        asked.append(config)
        outside = np.arange(10) == 9
        elevation = np.where(outside, 10.0, 70.0)
        return pd.DataFrame({"camera.elevation": elevation, "correct": outside, "unit": np.arange(10), "label": ""})

    monkeypatch.setattr(explaining.SweepRunner, "run_sweep", rendered)
    result = advsearch.explain(swept, confirm=10, pairs=0, clusters=0, run=tmp_path / "run")
    confirmed = result.rules[0].confirmed
    assert confirmed is not None and (confirmed.right, confirmed.total) == (0, 9)  # what lies outside is not counted
    low, high = np.asarray(asked[0].controls["camera"]["elevation"], dtype=float)
    assert 57.0 < low < 63.0 and 84.0 < high <= 85.0 and asked[0].controls["light"] == {}
    assert asked[0].samples == 10 and asked[0].seed != 0 and asked[0].trials == 0


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

    monkeypatch.setattr(explaining.SweepRunner, "run_sweep", rendered)
    result = advsearch.explain(swept, confirm=0, pairs=1, clusters=0, run=tmp_path / "run")
    (pair,) = result.pairs
    assert pair.parameter == "camera.elevation" and float(pair.wrong_at) > HIGH >= float(pair.right_at) > 50.0
    assert (pair.failure_label, pair.right_label) == ("bowl", "mug") and result.pairs_sought == 1
    several = advsearch.explain(swept, confirm=0, pairs=12, clusters=0, run=tmp_path / "several")
    assert several.pairs_sought == 12 and several.pairs[0] == pair and len(several.pairs) >= 6
    assert len({str(one.values) for one in several.pairs}) == len(several.pairs)


def test_of_predictions_without_a_law_it_is_said_that_nothing_decides_and_how_many_rows_a_rule_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    faint = stored(tmp_path / "faint", lambda elevation: np.random.default_rng(int(1e6 * elevation)).random() < 0.5)
    asked = ["explain", str(faint), "--confirm", "0", "--pairs", "0", "--clusters", "0", "--run", str(tmp_path / "run")]
    assert main(asked) == 0
    said = capsys.readouterr().out
    assert "No rule is significant in 600 rows, of which one half chooses and the other counts" in said
    assert "No parameter is shown to decide anything" in said
    kept = read_result(tmp_path / "run")
    assert isinstance(kept, ExplainResult) and kept.rules == []
    rule = kept.rejected_rule
    assert rule is not None and rule.chance > rule.p_value_limit == 0.01
    assert f"right in {rule.right} of {rule.total}" in said
    assert rule.rows is None or (
        rule.rows > 600 and f"About {rule.rows:,} rows with these fractions would make it significant" in said
    )
    assert all(one.interval[0] == 0.0 < one.interval[1] < 0.05 for one in kept.importance)


class Read:
    """Features that tell the lighter pictures from the darker ones."""

    source_description = "twelve numbers"

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        sides = (images[:, 0, 0, :1] - 0.5) * torch.linspace(-8.0, 8.0, 12)
        return sides + torch.randn(sides.shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.medium
def test_failures_are_grouped_by_what_the_model_decides_by(
    swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def again(self: Any, sweep: StoredSweep, numbers: Any) -> tuple[torch.Tensor, Read]:
        """Dark pictures of even rows and light ones of odd rows."""
        asked.extend(numbers)
        shades = torch.tensor([0.2 + 0.6 * (number % 2) for number in numbers])
        return shades[:, None, None, None].expand(-1, 4, 4, 3), Read()

    monkeypatch.setattr(explaining.SweepRunner, "render_again", again)
    result = advsearch.explain(swept, confirm=0, pairs=0, clusters=50, run=tmp_path / "run")
    found = result.clusters
    assert found is not None and found.are_separated and found.failures == 50 == len(set(asked))
    assert result.renders == 50
    with Store(swept / NAME, read_only=True) as store:
        assert all(not row.correct for row in store.rows("sweep") if row.step in asked)
    odd = sum(number % 2 for number in asked)
    assert sorted(one.failures for one in found.listed) == sorted([odd, 50 - odd])
    assert all(sum(one.labels.values()) == one.failures and "bowl" in one.labels for one in found.listed)
    shades = {round(float(iio.imread(tmp_path / "run" / one.picture).mean()) / 255.0, 1) for one in found.listed}
    assert shades == {0.2, 0.8}


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
