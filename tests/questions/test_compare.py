"""`compare` on stored sweeps, without a renderer."""

import json
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import advsearch
from advsearch.cli.main import main
from advsearch.errors import FileFormatError, InputError
from advsearch.experiment import RunContext
from advsearch.options import Value
from advsearch.questions.compare.result import ComparedPair, CompareResult
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.runs.summary import read_result
from advsearch.runs.tables import EDGES_NOTE
from advsearch.statistics.paired import mcnemar, paired_difference
from advsearch.viewer import thumbnails
from samples import make_run, sweep
from stored_sweeps import described

pytestmark = pytest.mark.island("advsearch.questions.compare")

PICTURES = 400
EDGES_OF_ELEVATION = (5.0, 25.0, 45.0, 65.0, 85.0)

Right = Callable[[float, float], bool]
"""Whether a model is right, by elevation and a number in [0, 1]."""


def good(elevation: float, luck: float) -> bool:
    """Right nine times in ten."""
    return luck < 0.9


def low(elevation: float, luck: float) -> bool:
    """The same, but for pictures from high above."""
    return luck < 0.9 and elevation < 65.0


def stored(
    path: Path,
    models: dict[str, Right],
    *,
    pictures: int = PICTURES,
    keep: bool = False,
    lowest: float = 5.0,
    **asked: Any,
) -> Path:
    """Keep the sweep of some models, whose draws are those of any other with as many pictures and the same seed."""
    names = ",".join(models)
    config = SweepConfig(
        **{"object": "mug", "controls": "camera", "samples": pictures, "run": str(path), "model": names, **asked}
    )
    draws = np.random.default_rng(config.seed).uniform(size=(pictures, 2))
    halves = ("clean", Path(config.adversarial_of).name) if config.adversarial_of else ("",)
    rows = []
    with RunDirectory.create_for(config) as run:
        run.store.write_note(EDGES_NOTE, json.dumps({"camera.elevation": EDGES_OF_ELEVATION}))
        for half, answer in enumerate(halves):
            for number, (height, luck) in enumerate(draws):
                elevation = lowest + 80.0 * height
                place = half * pictures + number
                if keep:
                    picture = np.full((8, 8, 3), luck, np.float32)
                    thumbnails.write_thumbnail(run.path, place, thumbnails.make_thumbnail(picture))
                for model, (name, right) in enumerate(models.items()):
                    is_right = right(elevation, luck) and not (half and luck < 0.5)
                    values: dict[str, Value] = {
                        "object": described(config.object),
                        **({"answer": described(answer)} if answer else {}),
                        "model": described(name),
                        "camera.elevation": described(elevation, "degrees"),
                    }
                    rows.append(
                        Row("sweep", place * len(models) + model, correct=is_right, values=values, seconds=0.25,
                            margin=1.0 if is_right else -1 - luck, label="mug" if is_right else "bowl")
                    )  # fmt: skip
        run.append_rows(*rows, Row("verification", 0, correct=False, label="bowl"))
        right_ones = sum(bool(one.correct) for one in rows)
        counts = {"configurations": len(rows), "correct": right_ones, "accuracy": right_ones / len(rows)}
        run.write_summary(
            sweep(**counts, interval=(0.0, 1.0), planned=len(rows), run=str(path), model=names, object=config.object,
                  controls=["camera"])
        )  # fmt: skip
    return path


def compared(*runs: Path, **asked: Any) -> tuple[CompareResult, ComparedPair]:
    """The result and its first pair."""
    result = advsearch.compare(list(runs), run=runs[0].parent / "compared", **{"pictures": 0, **asked})
    return result, result.pairs[0]


@pytest.mark.medium
def test_one_sweep_of_two_models_is_counted_pair_by_pair(tmp_path: Path) -> None:
    result, pair = compared(stored(tmp_path / "both", {"good": good, "low": low}))
    draws = np.random.default_rng(0).uniform(size=(PICTURES, 2))
    one, two = ([right(5 + 80 * a, b) for a, b in draws] for right in (good, low))
    lost = sum(a and not b for a, b in zip(one, two, strict=True))
    assert (pair.both, pair.first_only, pair.second_only) == (sum(two), lost, 0)
    assert pair.pairs == PICTURES and pair.right == (sum(one), sum(two)) and pair.p == pytest.approx(2 * 0.5**lost)
    assert pair.difference == pytest.approx(-lost / PICTURES) and pair.interval[1] < 0
    assert [(side.name, side.correct) for side in result.sides] == [("good", sum(one)), ("low", sum(two))]
    assert (
        [side.seconds for side in result.sides] == [0.25, 0.25] and result.renders == 0 and result.differ == ["model"]
    )
    assert pair.worse is not None and pair.better == []
    (rule,) = pair.worse
    (condition,) = rule.conditions
    assert condition.parameter == "camera.elevation" and condition.over == pytest.approx(65.0, abs=3.0)
    assert rule.count > 0.8 * rule.total and rule.elsewhere.count < 0.1 * rule.elsewhere.total
    assert [part.value for part in pair.parts] == list(pairwise(EDGES_OF_ELEVATION))
    assert [part.first_only for part in pair.parts] == [0, 0, 0, lost]
    kept = read_result(tmp_path / "compared")
    assert isinstance(kept, CompareResult) and kept.pairs == result.pairs


@pytest.mark.parametrize(
    ("asked", "names", "differ"),
    [
        ({"object": "bowl"}, ["mug", "bowl"], ["object"]),
        ({"set": {"camera.exposure": 1.0}}, ["one", "two"], ["set"]),
        ({"set": {"camera.exposure": 1.0}, "object": "bowl"}, ["mug", "bowl"], ["object", "set"]),
    ],
)
def test_two_sweeps_of_the_same_draws_are_a_pair(
    asked: dict[str, Any], names: Sequence[str], differ: Sequence[str], tmp_path: Path
) -> None:
    one, two = stored(tmp_path / "one", {"net": good}), stored(tmp_path / "two", {"net": low}, **asked)
    result, pair = compared(one, two)
    assert [side.name for side in result.sides] == names and result.differ == differ
    assert pair.first_only > 0 and pair.second_only == 0
    assert ("may come from any of these" in " ".join(result.warnings)) == (len(differ) > 1)


@pytest.mark.medium
def test_a_sweep_with_an_adversarial_scene_is_compared_without_it_and_beside_others_only_with_it(
    tmp_path: Path,
) -> None:
    paint = stored(tmp_path / "one", {"net": good}, adversarial_of="runs/paint")
    result, pair = compared(paint)
    assert [side.name for side in result.sides] == ["clean", "paint"] and pair.pairs == PICTURES
    assert pair.second_only == 0 and 0.4 * PICTURES < pair.first_only < 0.6 * PICTURES
    other = stored(tmp_path / "two", {"net": good}, adversarial_of="runs/other")
    bare = stored(tmp_path / "three", {"net": good})
    result = advsearch.compare([bare, paint, other], pictures=0, run=tmp_path / "all")
    assert [side.name for side in result.sides] == ["as it is", "paint", "other"]
    assert [pair.first_only > 0 for pair in result.pairs] == [True, True] and result.pairs[0].second_only == 0


@pytest.mark.medium
def test_sweeps_that_are_no_pairs_are_refused(tmp_path: Path) -> None:
    one = stored(tmp_path / "one", {"net": good})
    attack = make_run(tmp_path / "attack")
    few = stored(tmp_path / "few", {"net": good}, environment="studio,noon")
    short = read_result(few).model_copy(update={"planned": 2 * PICTURES})
    (few / "summary.json").write_text(json.dumps(short.to_dict()))
    refused: list[tuple[list[Path], type[Exception], str]] = [
        ([one], InputError, "a sweep of one model; name another sweep"),
        ([one, stored(tmp_path / "seed", {"net": low}, seed=1)], InputError, "same draws.*`seed` differ"),
        ([one, stored(tmp_path / "less", {"net": low}, pictures=9)], InputError, "same draws.*`samples` differ"),
        ([one, stored(tmp_path / "drawn", {"net": low}, controls="pose")], InputError, "same draws.*`controls` differ"),
        ([one, attack], FileFormatError, "expected the run of a sweep, got one of attack"),
        ([one, few], FileFormatError, "a sweep that has ended, got one with 400 of 800 predictions"),
    ]
    for runs, error, said in refused:
        with pytest.raises(error, match=said):
            advsearch.compare(runs, run=tmp_path / "no")
        assert not (tmp_path / "no").exists()


def test_mcnemar_is_the_exact_binomial_test() -> None:
    assert mcnemar(1, 9) == mcnemar(9, 1) == pytest.approx(2 * (1 + 10) / 2**10)
    assert (mcnemar(0, 0), mcnemar(5, 5), mcnemar(0, 5)) == (1.0, 1.0, 2 / 2**5)
    assert 0.0 <= mcnemar(0, 100_000) < 1e-300
    with pytest.raises(InputError, match="from 0, got -1 and 2"):
        mcnemar(-1, 2)


@pytest.mark.parametrize("shares", [(0.6, 0.1, 0.1, 0.2), (0.85, 0.05, 0.05, 0.05), (0.5, 0.25, 0.05, 0.2)])
def test_p_value_and_interval_err_no_more_often_than_they_say(shares: Sequence[float]) -> None:
    """Four thousand studies of 80 pairs: a p-value up to 0.05 without a difference, or an interval beside it."""
    p, interval = cache(mcnemar), cache(paired_difference)
    drawn = np.random.default_rng(3).multinomial(80, shares, size=4000).tolist()
    truth = shares[2] - shares[1]
    ends = [interval(*cells)[1] for cells in drawn]
    assert np.mean([low <= truth <= high for low, high in ends]) > 0.94
    called = np.mean([p(cells[1], cells[2]) <= 0.05 for cells in drawn])
    assert called < 0.05 if truth == 0 else called > 0.8


def test_a_comparison_that_was_stopped_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parts: list[str] = []

    def swept(self: Any, name: str, config: SweepConfig) -> SweepSummary:
        parts.append(config.model)
        if len(parts) == 1:
            return sweep(ending="interrupted")
        stored(tmp_path / "run" / "parts" / name, {"a": good, "b": low})
        return sweep(ending="finished")

    monkeypatch.setattr(RunContext, "run_part", swept)
    line = ["compare", "a", "b", "--object", "mug", "--control", "camera", "--pictures", "0"]
    assert main([*line, "--run", str(tmp_path / "run")]) == 130
    assert f"Go on with: advsearch resume {tmp_path / 'run'}" in capsys.readouterr().out
    assert main(["resume", str(tmp_path / "run"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["ending"] == "done" and said["pairs"][0]["first_only"] > 0 and parts == ["a,b", "a,b"]
