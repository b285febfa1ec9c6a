"""How much of a thing a picture shows, against a picture of twice the width and height round the same one."""

import math
from typing import Any

import pytest
import torch

import advsearch
from advsearch.scene import outlines
from advsearch.scene.geometry import project_points
from advsearch.scene.outlines import VisibleMesh, find_visible_meshes
from advsearch.scene.renderer import Renderer

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.medium]

SIDE = 64


def renderer(controls: Any, fov: float, side: int, camera: str | None = None) -> Renderer:
    scene = advsearch.load_scene("mug", size=1.0, settings={"camera.distance": 2.2, "camera.fov": fov})
    return scene.renderer(controls, resolution=side, denoise="none")


def seen(one: Renderer) -> VisibleMesh:
    (found,) = find_visible_meshes(one, one.start)
    return found


@pytest.mark.parametrize("shift", [[0.0, 0.0], [0.45, -0.3]])
def test_the_share_is_that_of_a_larger_picture(shift: list[float]) -> None:
    wide = math.degrees(2.0 * math.atan(2.0 * math.tan(math.radians(15.0))))
    moved = seen(renderer({"camera": {"shift_x": shift[0], "shift_y": shift[1]}}, 30.0, SIDE))
    around = seen(renderer({"camera": {"shift_x": shift[0] / 2, "shift_y": shift[1] / 2}}, wide, 2 * SIDE))
    middle = around.mask[SIDE // 2 : -SIDE // 2, SIDE // 2 : -SIDE // 2]
    assert (middle != moved.mask).mean() < 0.002
    assert moved.visible_fraction == pytest.approx(moved.mask.sum() / around.mask.sum(), abs=0.01)
    assert moved.is_truncated is bool(middle.sum() < around.mask.sum())
    assert around.is_truncated is False and around.visible_fraction == pytest.approx(1.0, abs=0.01)


def test_a_lens_bends_the_outline() -> None:
    scene = advsearch.load_scene("mug", camera="fisheye")
    found = seen(scene.renderer({"pose": {}}, resolution=SIDE, denoise="none"))
    assert found.is_truncated is False and found.visible_fraction == pytest.approx(1.0, abs=0.03)


def test_an_outline_that_is_elsewhere_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    places = project_points
    one = renderer({"pose": {}}, 60.0, SIDE)
    assert seen(one).visible_fraction == pytest.approx(1.0, abs=0.01)

    def beside(*given: Any) -> Any:
        where, before = places(*given)
        return where + 4.0, before

    monkeypatch.setattr(outlines, "project_points", beside)
    assert seen(one).visible_fraction is None

    def behind(*given: Any) -> Any:
        return places(*given)[0], torch.zeros(len(given[2]), dtype=torch.bool)

    monkeypatch.setattr(outlines, "project_points", behind)
    assert (seen(one).visible_fraction, seen(one).is_truncated) == (None, None)
    assert torch.equal(torch.from_numpy(seen(one).mask), one.find_surfaces(one.start).visible_mask("object"))
