"""Sweeps over light: pictures that differ in nothing else come from basis pictures, once these pay."""

from pathlib import Path
from typing import Any

import pytest

import advsearch
from advsearch.attacks.domain import ProductIndex
from advsearch.engine import acceptance, transport
from advsearch.engine.image_groups import Groups
from advsearch.questions.sweep.job import SweptScene
from advsearch.runs.results import LinearTransport
from stand_ins import rows

SMALL: dict[str, Any] = {"resolution": 48, "trials": 0}
GRID = {"camera.exposure": [-10, -1, 6], "light.power": "0:6:8"}


@pytest.fixture(autouse=True)
def _paying(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few dozen pictures are enough here, and the first two views of a comparison decide."""
    monkeypatch.setattr(transport, "MIN_SAVING_FACTOR", 0.2)
    for name in ("MIN_ALLOWED_LEVELS", "MAX_MARGIN_BIAS"):
        monkeypatch.setattr(acceptance, name, 50.0)


def test_pictures_fall_into_groups_that_differ_in_light_alone() -> None:
    """Of pose x power x camera x tint with two draws each, each group has all of power and tint."""
    groups = Groups(ProductIndex((2, 3, 2, 4)), 2, (False, True, False, True), True)
    assert (groups.group_size, groups.n_groups, groups.n_groups_to_cache) == (24, 4, 2)
    found: dict[int, list[int]] = {}
    for number in range(groups.grid.count * 2):
        found.setdefault(groups.find_group_of_image(number), []).append(number)
    assert sorted(found) == [0, 1, 2, 3]
    for members in found.values():
        assert [groups.find_image_of_group(members[-1], place) for place in range(groups.group_size)] == members


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
    settings: Any = {"grid": {"pose.yaw": [0, 90], "light.power": "0:12:18"}, "deterministic": True, "trials": 0}
    settings = {**settings, "resolution": 24, "batch": 8}
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
