"""Sweeps over light: pictures that differ in nothing else come from basis pictures, once these pay."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import advsearch
from advsearch.attacks.domain import ProductIndex
from advsearch.engine import acceptance
from advsearch.engine.acceptance import Deviation
from advsearch.questions.sweep import predicting
from advsearch.questions.sweep.job import SweptScene
from advsearch.questions.sweep.predicting import Groups, combine_transport
from advsearch.runs.results import LinearTransport, PredictionError
from stand_ins import rows

SMALL: dict[str, Any] = {"resolution": 48, "trials": 0}
GRID = {"camera.exposure": [-10, -1, 6], "light.power": "0:6:8"}


@pytest.fixture(autouse=True)
def _paying(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few dozen pictures are enough here, and the first two views of a comparison decide."""
    monkeypatch.setattr(predicting, "MIN_SAVING_FACTOR", 0.2)
    for name in ("MIN_ALLOWED_LEVELS", "MAX_MARGIN_BIAS"):
        monkeypatch.setattr(acceptance, name, 50.0)


def test_pictures_fall_into_groups_that_differ_in_light_alone() -> None:
    """Of pose x power x camera x tint with two draws each, each group has all of power and tint."""
    groups = Groups(ProductIndex((2, 3, 2, 4)), 2, (False, True, False, True), True)
    assert (groups.group_size, groups.n_groups, groups.n_cached_groups) == (24, 4, 2)
    found: dict[int, list[int]] = {}
    for number in range(groups.grid.count * 2):
        found.setdefault(groups.find_group(number), []).append(number)
    assert sorted(found) == [0, 1, 2, 3]
    for members in found.values():
        assert [groups.find_member(members[-1], place) for place in range(groups.group_size)] == members


def test_light_as_the_last_axes_needs_one_group_at_a_time() -> None:
    assert Groups(ProductIndex((5, 3)), 1, (False, True), True).n_cached_groups == 1
    assert Groups(ProductIndex((5, 3)), 2, (True, True), True).n_groups == 1
    assert Groups(ProductIndex((5, 3)), 2, (False, True), False).group_size == 1


@pytest.mark.medium
def test_verdicts_are_those_of_rendering_each() -> None:
    """From a picture that is nearly black to one that is nearly white."""
    predicted = advsearch.sweep("mug", "reference", GRID, **SMALL)
    rendered = advsearch.sweep("mug", "reference", GRID, specialise=False, **SMALL)
    pairs = list(zip(predicted.rows(), rendered.rows(), strict=True))
    assert [one.correct for one, _ in pairs] == [other.correct for _, other in pairs]
    assert 0 < predicted.summary.correct < 24
    told, renders = predicted.summary.transport, predicted.summary.renders
    assert told is not None and told.used and told.error is not None and told.bytes
    assert renders["products"] == 24 and renders["sweep"] == 2 + 3 * 2
    assert all(one.seed is None and one.spp == 128 for one, _ in pairs)
    assert sum(one.renders or 0 for one, _ in pairs) == 8
    assert rendered.summary.transport == LinearTransport(used=False, reason="nothing is left out")
    assert rendered.summary.renders["sweep"] == 24


@pytest.mark.medium
def test_each_pose_has_basis_pictures_of_its_own_and_a_sweep_that_was_stopped_ends_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    settings: Any = {**SMALL, "deterministic": True, "grid": {"pose.yaw": [0, 90], "light.power": "0:12:18"}}
    settings = {**settings, "batch": 8}
    whole = advsearch.sweep("mug", "reference", run=tmp_path / "whole", **settings).summary
    assert whole.transport is not None and whole.transport.used
    assert whole.renders["products"] == 36 and whole.renders["sweep"] == 2 * (2 + 3 * 2)
    look, looked = SweptScene.evaluate_all, 0

    def stopped(self: SweptScene, *given: Any) -> Any:
        nonlocal looked
        looked += 1
        if looked == 4:
            raise KeyboardInterrupt
        return look(self, *given)

    monkeypatch.setattr(SweptScene, "evaluate_all", stopped)
    first = advsearch.sweep("mug", "reference", run=tmp_path / "parts", **settings).summary
    assert first.ending == "interrupted" and first.configurations == 24
    monkeypatch.setattr(SweptScene, "evaluate_all", look)
    again = advsearch.sweep("mug", "reference", run=tmp_path / "parts", **settings).summary
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole") and again.renders == whole.renders


@pytest.mark.medium
def test_a_group_whose_prediction_is_off_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predicting, "compare_views", lambda view: Deviation(9.0, 0.0, 2.0, n_traced=6))
    found = advsearch.sweep("mug", "reference", GRID, **SMALL)
    told, renders = found.summary.transport, found.summary.renders
    assert told is not None and "1 of 1 groups were rendered" in str(told.reason)
    assert "products" not in renders and renders["sweep"] == 24 + 2 + 6
    assert all(one.seed is not None for one in found.rows())


@pytest.mark.medium
def test_draws_of_light_share_one_basis() -> None:
    controls = {"environment": {"exposure": [-1, 1], "tint_red": [0, 2]}}
    found = advsearch.sweep("mug", "reference", controls=controls, samples=32, **SMALL).summary
    assert found.renders == {"sweep": 1 + 3 * 2, "verification": 0, "products": 32}


@pytest.mark.medium
@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"grid": {"light.power": [1, 2]}}, "basis pictures pay where 13 pictures or more differ in light alone"),
        ({"grid": {"light.power": "0:12:16"}, "denoise": "none"}, "noise is part of the picture without the denoiser"),
        ({"grid": {"pose.yaw": [0, 90]}}, None),
        (
            {"grid": {"light.power": [1, 2]}, "controls": "pose", "samples": 4},
            "basis pictures pay where 13 pictures or more differ in light alone; here 1 do",
        ),
    ],
)
def test_why_a_sweep_renders(settings: dict[str, Any], reason: str | None) -> None:
    found = advsearch.sweep("mug", "reference", **{**SMALL, "resolution": 16, **settings}).summary
    assert (found.transport is None) == (reason is None)
    if reason is not None and found.transport is not None:
        assert not found.transport.used and reason in str(found.transport.reason)


def test_of_several_scenes_the_worst_is_told() -> None:
    def one(levels: float, seconds: float) -> LinearTransport:
        return LinearTransport(used=True, bytes=8, seconds=seconds, error=PredictionError(levels=levels, logits=0.0))

    found = combine_transport([one(1.0, 2.0), None, one(3.0, 4.0)])
    assert found is not None and found.error is not None and (found.error.levels, found.seconds) == (3.0, 6.0)
    assert combine_transport([None]) is None
