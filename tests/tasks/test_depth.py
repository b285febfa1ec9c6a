"""Depth: how far a model judges the object to be, beside how far it is."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks.objectives import get_objective
from advsearch.options import NOT_A_NUMBER
from advsearch.runs.files import read_png
from advsearch.runs.store import Store
from advsearch.tasks import Facts, Sight
from advsearch.tasks.depth import (
    AS_BACKGROUND,
    AS_FAR,
    DISPARITY,
    FARTHER,
    METRIC,
    NEARER,
    OUT_OF_SHAPE,
    RELATIVE,
    Depth,
    DepthTruth,
)
from small_models import Ranger, answer, assert_slope, save_exported

pytestmark = pytest.mark.island("advsearch.tasks.depth")

HIGH, WIDE = 8, 10
MASK = torch.zeros(HIGH, WIDE).bool()
MASK[2:7, 3:7] = True
GROUND = torch.linspace(0.2, 0.5, HIGH)[:, None].expand(HIGH, WIDE)
"""Disparities of a plane."""
INVERSE = torch.where(MASK, 1.2, GROUND)
TRUTH = DepthTruth(MASK, INVERSE.reciprocal())
OTHERS = torch.where(MASK, 1.2, torch.where(torch.arange(HIGH)[:, None] < 3, 0.0, GROUND))
OPEN = DepthTruth(MASK, OTHERS.reciprocal())
"""The same with a sky above the ground."""


def said(inverse: Tensor, kind: str = DISPARITY, size: float = 0.5) -> list[dict[str, Tensor]]:
    """The output of a model that means these disparities, by its own scale and shift."""
    values = {DISPARITY: 7.0 * inverse - 2.0, RELATIVE: 3.0 / inverse + 1.0, METRIC: size / inverse}[kind]
    return [{kind: values}]


def moved(factor: float) -> Tensor:
    """Disparities with the object so many times as far as it is."""
    return torch.where(MASK, INVERSE / factor, INVERSE)


TASK = Depth(size=0.5)


@pytest.mark.parametrize("kind", [DISPARITY, RELATIVE, METRIC])
@pytest.mark.parametrize(
    ("factor", "right", "answer"),
    [(1.0, True, AS_FAR), (1.2, True, AS_FAR), (1.3, False, FARTHER), (0.7, False, NEARER)],
)
def test_a_factor_of_the_tolerance_is_what_decides(kind: str, factor: float, right: bool, answer: str) -> None:
    """By whatever scale and shift the model speaks: what is beside the object says them."""
    (found,) = TASK.judge(said(moved(factor), kind), TRUTH)
    assert (found.right, found.prediction.label, found.success) == (right, answer, not right)
    assert found.margin == pytest.approx(math.log(1.25) - abs(math.log(factor)), abs=1e-4)
    payload: Any = found.payload
    assert payload["factor"] == pytest.approx(max(factor, 1.0 / factor), abs=1e-3)
    assert payload["judged"] == pytest.approx(factor / 1.2, abs=1e-3)
    assert ("fitted" in payload) is (kind != METRIC)


def test_an_object_that_takes_the_depth_of_what_is_behind_is_gone() -> None:
    gone = replace(TASK, seek="gone")
    for share, left in ((1.0, 1.0), (0.6, 0.6), (0.4, 0.4), (0.0, 0.0)):
        inverse = GROUND + share * (INVERSE - GROUND)
        (found,) = gone.judge(said(inverse), TRUTH)
        payload: Any = found.payload
        assert payload["relief"] == pytest.approx(left, abs=1e-3)
        assert found.success is (left < 0.5) and (found.prediction.label == AS_BACKGROUND) is (left < 0.5)
    (found,) = replace(TASK, seek="farther").judge(said(GROUND), TRUTH)
    assert found.success and found.prediction.label == FARTHER, "what is sought is named first"


def test_nearer_and_farther_have_a_sign_and_a_mixture_has_neither() -> None:
    for seek, factor in (("nearer", 0.7), ("farther", 1.4)):
        task = replace(TASK, seek=seek)
        other = said(moved(1.0 / factor))
        assert task.judge(said(moved(factor)), TRUTH)[0].success and not task.judge(other, TRUTH)[0].success
        assert float(get_objective(seek, task)(said(moved(factor)), torch.zeros(1), TRUTH)) > 0.0
    columns = torch.where(torch.arange(WIDE) % 2 == 0, 2.0, 0.5)
    (found,) = TASK.judge(said(torch.where(MASK, INVERSE * columns, INVERSE)), TRUTH)
    assert not found.right and found.prediction.label == OUT_OF_SHAPE
    assert replace(TASK, minimise=True).judge(said(INVERSE), TRUTH)[0].success


def test_where_nothing_is_seen_nothing_is_wrong_and_where_numbers_are_none_nothing_is_right() -> None:
    unseen = DepthTruth(torch.zeros_like(MASK), TRUTH.z_depth)
    (found,) = TASK.judge(said(GROUND), unseen)
    assert (found.right, found.prediction.label, found.payload) == (True, "out of view", None)
    for value in (math.nan, math.inf):
        broken = said(INVERSE)
        broken[0][DISPARITY][0, 0] = value
        (found,) = TASK.judge(broken, TRUTH)
        assert found.is_non_finite and not found.right and not found.success
        assert TASK.predictions(broken)[0][0].label == NOT_A_NUMBER
    assert TASK.predictions(said(INVERSE, METRIC))[0][0].label == "metric depth from 0.417 to 2.5"


def test_what_is_beside_the_object_has_to_say_the_scale() -> None:
    """In a scene that is all object, or seen from above: refused when a run begins, and fitted on all that there is."""
    alone = DepthTruth(MASK, torch.where(MASK, 1.0 / 1.2, math.inf))
    above = DepthTruth(MASK, torch.where(MASK, 1.0, 2.0))
    for truth, count in ((alone, 0), (above, 60)):
        assert not truth.determines_scale
        task = TASK.after_calibration(said(INVERSE), truth)
        assert f"expected 16 pixels at distances that differ by a factor of 1.1, got {count}" in task.ambiguity_message
        assert not TASK.after_calibration(said(INVERSE, METRIC), truth).ambiguity_message
    (found,) = TASK.judge([{DISPARITY: torch.where(MASK, 3.0, 1.0)}], above)
    payload: Any = found.payload
    assert found.right and payload["fitted"] == "in the whole picture"
    assert (
        TASK.after_calibration(said(INVERSE), OPEN).ambiguity_message == ""
        and TASK.after_calibration(said(INVERSE), None).ambiguity_message == ""
    )


def test_the_gradient_agrees_with_differences() -> None:
    """Of every objective, in float64, along a direction."""
    generator = torch.Generator().manual_seed(0)
    at, way = (torch.randn((HIGH, WIDE), generator=generator, dtype=torch.float64) for _ in range(2))
    truth = DepthTruth(MASK, TRUTH.z_depth.double())
    for kind in (DISPARITY, RELATIVE, METRIC):
        start = said(INVERSE.double(), kind)[0][kind] + 0.02 * at
        for seek in ("", "nearer", "farther", "gone"):
            task = replace(TASK, seek=seek)

            def value(values: Tensor, task: Depth = task, kind: str = kind) -> Tensor:
                return task.score([{kind: values}], truth).sum()

            assert abs(assert_slope(value, start, way, 1e-6, 1e-4)) > 1e-3, (kind, seek)


def test_it_is_compared_with_the_distance_along_the_axis() -> None:
    sight = Sight(MASK, 2.0 * TRUTH.z_depth, TRUTH.z_depth)
    truth = TASK.truth(Facts("mug", compute_sight=lambda: sight))
    assert torch.equal(truth.z_depth, TRUTH.z_depth) and TASK.truth_names(truth) == (AS_FAR,)
    for kind in (DISPARITY, RELATIVE, METRIC):
        true, right = TASK.marks(said(moved(2.0), kind), truth)[0]
        assert (
            true.true
            and true.mask is not None
            and torch.equal(true.mask, MASK)
            and right.mask is not None
            and not right.mask.any()
        )
        assert true.map is not None and torch.allclose(true.map, INVERSE)
        assert right.map is not None and torch.allclose(right.map, moved(2.0), atol=1e-4)


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The flags of the task with a model file."""
    file = tmp_path_factory.mktemp("depth") / "net.pt2"
    save_exported(Ranger(), file)
    return ["--object", "mug", "--task", f"depth={{kind: {DISPARITY}}}", "--model", str(file), "--json"]


SHORT = ["--spp", "2", "--verify-spp", "4", "--measure", "no", "--denoise", "none", "--trials", "6"]


@pytest.mark.medium
def test_a_search_verifies_and_draws(asked: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    flags = ["--epsilon", "0.5", "--steps", "12", "--objective", "gone", "--no-baseline", "--run", str(run)]
    found = answer(capsys, "attack", *asked, *SHORT, *flags)
    assert found["ending"] == "found" and found["clean"]["label"] == AS_FAR and found["clean"]["correct"]
    assert found["verified"]["labels"] == {AS_BACKGROUND: 6} and found["adversarial"]["payload"]["relief"] < 0.5
    with Store(run / "results.sqlite", read_only=True) as store:
        payloads: list[Any] = [row.payload for row in store.rows("verification")]
    assert {one["fitted"] for one in payloads} == {"beside the object"}
    clean, drawn = (read_png(run / "images" / f"{name}-prediction.png") for name in ("clean", "adversarial"))
    assert clean.shape == (512, 3 * 512, 3), "the picture, the true disparity and the model's"
    orange = [float((one[:, :512, 0] - one[:, :512, 2]).clip(0.2).mean()) for one in (clean, drawn)]
    assert orange[0] > orange[1] + 0.02, "fewer pixels of the object are right"
    off = [float(abs(one[:, 512:1024] - one[:, 1024:]).mean()) for one in (clean, drawn)]
    assert off[0] < 0.16 and off[1] > off[0] + 0.1, off


@pytest.mark.medium
def test_a_sweep_counts(asked: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """From above, what is beside the object says no scale, and the whole picture does."""
    flags = ["--grid", "camera.elevation=25,85", "--spp", "2", "--denoise", "none", "--trials", "6"]
    found = answer(capsys, "sweep", *asked, *flags, "--run", str(tmp_path / "run"))
    assert found["configurations"] == 2 and found["task"] == "depth"
    with Store(tmp_path / "run" / "results.sqlite", read_only=True) as store:
        payloads: list[Any] = [row.payload for row in store.rows("sweep")]
    assert [one["fitted"] for one in payloads] == ["beside the object", "in the whole picture"]
