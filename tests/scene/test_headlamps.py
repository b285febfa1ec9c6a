"""Lamps of cars: the beam, light on the ground and on a wall, where lamps sit, and what they belong to."""

from typing import Any

import numpy as np
import pytest
import torch

import advsearch
from advsearch.controls import Space
from advsearch.engine.loading import Scene, fit_camera, make_renderer
from advsearch.scene.description import SceneDescription
from advsearch.scene.grounds import LUMINANCE
from advsearch.scene.headlamps import CUT_OFF, EGO_LAMP_POSITION, HEADLAMP_CANDELA, TAILLAMP_CANDELA, compute_candela
from advsearch.scene.mitsuba_backend.parts import translate_part
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.parts import BeamLamp, LampGlass
from advsearch.scene.renderer import Renderer

pytestmark = pytest.mark.usefixtures("two_threads")

LOW = {"object.lamps": "low"}
FRONT: dict[str, Any] = {"camera.distance": 9.0, "camera.azimuth": 15.0, "camera.elevation": 8.0, "camera.ev": 4.0}


def beams(scene: SceneDescription) -> list[BeamLamp]:
    return [lamp for lamp in scene.lamps.values() if isinstance(lamp, BeamLamp)]


def glasses(scene: SceneDescription) -> dict[str, LampGlass]:
    return {name: one for name, one in scene.meshes.items() if isinstance(one, LampGlass)}


def intensity(kind: str, h: float, v: float) -> float:
    return float(compute_candela(kind, np.array(h), np.array(v)))


@pytest.mark.parametrize(
    ("v", "h", "least", "most"),
    [
        (0.57, -3.43, 0.0, 350.0), (1.0, 2.5, 0.0, 1750.0), (-0.57, -3.43, 0.0, 10600.0), (-0.86, -3.43, 0.0, 13200.0),
        (-0.86, 1.72, 10100.0, 44100.0), (-0.86, 0.0, 5100.0, 44100.0), (-1.72, -9.0, 1700.0, 44100.0),
        (-1.72, 9.0, 1700.0, 44100.0), (0.5, 0.0, 0.0, 625.0),
    ],
)  # fmt: skip
def test_a_low_beam_has_what_a_regulation_asks_for(v: float, h: float, least: float, most: float) -> None:
    """UN Regulation 112, section 6.2.4, a lamp of class B, with what its glass adds; its 75 R lies above a level
    cut-off."""
    assert least <= intensity("low", h, v) and intensity("low", h, v) + HEADLAMP_CANDELA <= most


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["low", "high"])
def test_a_wall_is_lit_by_the_beam_as_its_formula_says(kind: str) -> None:
    """A wall 25 m ahead of one lamp, 0.5 white: radiance = 0.5 / pi I cos / d^2, and the cut-off 25 cm below."""
    mi = import_mitsuba()
    lamp = next(one for one in beams(scene(**{"object.lamps": kind}).description) if "left" in one.name)
    pose = np.eye(4)
    pose[:3, :3] = lamp.pose_on_carrier[:3, :3]
    lamp = BeamLamp("lamp", "", pose, lamp.table, (1.0, 1.0, 1.0), to_world=pose)
    view = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[1, 0, -0.02], up=[0, 0, 1])
    made = mi.load_dict({
        "type": "scene", "lamp": translate_part(lamp).plugins["lamp"], "integrator": {"type": "prb", "max_depth": 2},
        "wall": {
            "type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
            "to_world": mi.ScalarTransform4f().look_at(origin=[25, 0, 0], target=[0, 0, 0], up=[0, 0, 1]).scale(40),
        },
        "camera": {
            "type": "perspective", "fov": 8.0, "fov_axis": "larger", "to_world": view,
            "sampler": {"type": "independent"},
            "film": {"type": "hdrfilm", "width": 48, "height": 160, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
        },
    })  # fmt: skip
    rendered = np.array(mi.render(made, spp=64, seed=1))[..., 0]
    row = np.tan(np.radians(4.0)) * (1.0 - 2.0 * (np.arange(160) + 0.5) / 160)
    column = np.tan(np.radians(4.0)) * 48 / 160 * (2.0 * (np.arange(48) + 0.5) / 48 - 1.0)
    y, up = np.meshgrid(column, row)
    ahead = np.stack([np.ones_like(y), y, 0.0 * y], -1) + up[..., None] * [0.02, 0.0, 1.0] + [0.0, 0.0, -0.02]
    ahead *= 25.0 / ahead[..., :1]
    far = np.linalg.norm(ahead, axis=-1)
    h = np.degrees(np.arctan2(ahead[..., 1], ahead[..., 0]))
    v = np.degrees(np.arcsin(ahead[..., 2] / far))
    expected = 0.5 / np.pi * compute_candela(kind, h, v) * 25.0 / far**3
    bright = expected > 0.05 * expected.max()
    smooth = bright & (np.abs(v - CUT_OFF) > 0.3)
    np.testing.assert_allclose(rendered[smooth], expected[smooth], rtol=0.02)
    if kind == "low":
        middle = rendered[:, 20:28].mean(axis=1)
        above = middle[: middle.argmax()]
        assert v[np.abs(above - middle.max() / 2).argmin(), 24] == pytest.approx(CUT_OFF, abs=0.08)
        assert middle[v[:, 24] > 0.0].max() < 0.01 * middle.max()


def scene(environment: str = "avenue-night", things: str | None = None, **given: Any) -> Scene:
    return advsearch.load_scene("car", environment, settings=given, things=things)


def rendered(made: Scene, side: int) -> Renderer:
    return make_renderer(fit_camera(made.description, side), Space(()), side, "none", 0)


@pytest.mark.medium
def test_the_ground_ahead_has_the_lux_of_both_headlamps() -> None:
    """A matt floor before the camera's car, by what two lamps put there: radiance = albedo / pi sum I cos / d^2."""
    floor = {"ground.size": 40.0, "ground.red": 0.5, "ground.green": 0.5, "ground.blue": 0.5}
    view = {"camera.distance": 40.0, "camera.height": 1.3, "camera.azimuth": 180.0, "camera.fov": 40.0}
    lit, dark = (scene(**floor, **view, **lamps) for lamps in ({"camera.lamps": "low"}, {}))  # type: ignore[arg-type]
    found = []
    for one in (lit, dark):
        renderer = rendered(one, 96)
        found.append(renderer.radiance(renderer.start, 3, 64).numpy() @ np.array(LUMINANCE))
    seen, described = renderer.find_surfaces(renderer.start), lit.description
    camera, right = (lamp.to_world for lamp in beams(described))
    place = 0.5 * (camera + right)[:3, 3] * described.size_in_metres
    assert place[2] == pytest.approx(EGO_LAMP_POSITION[2]) and camera[:3, 2] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    eye = place - [EGO_LAMP_POSITION[0], 0.0, EGO_LAMP_POSITION[2] - 1.3]
    # from depth to places: the picture's rows are at known angles below the camera's axis, its middle column ahead
    depth = seen.depth.numpy()[:, 47:49].mean(axis=1)  # metres
    rows = np.flatnonzero(seen.visible_mask("ground").numpy()[:, 47:49].all(axis=1) & (depth < 22.0) & (depth > 4.5))
    assert len(rows) > 15
    x = eye[0] + np.sqrt(depth[rows] ** 2 - 1.3**2)
    lux = np.zeros(len(rows))
    for side in (EGO_LAMP_POSITION[1], -EGO_LAMP_POSITION[1]):
        way = np.stack([x - place[0], 0.0 * x - side, 0.0 * x - EGO_LAMP_POSITION[2]], axis=1)
        far = np.linalg.norm(way, axis=1)
        h, v = np.degrees(np.arctan2(way[:, 1], way[:, 0])), np.degrees(np.arcsin(way[:, 2] / far))
        lux += compute_candela("low", h, v) * EGO_LAMP_POSITION[2] / far**3
    albedo = ((0.5 + 0.055) / 1.055) ** 2.4
    assert described.environment is not None and described.environment.candelas is not None
    measured = (found[0] - found[1])[rows, 47:49].mean(axis=1) * described.environment.candelas
    np.testing.assert_allclose(measured, albedo / np.pi * lux, rtol=0.03)
    assert measured.sum() == pytest.approx(float((albedo / np.pi * lux).sum()), rel=0.02)


@pytest.mark.medium
def test_glass_shines_as_many_candela_as_it_says_and_rear_lamps_are_red() -> None:
    described = scene(**LOW).description
    assert described.environment is not None and described.environment.candelas is not None
    for name, candelas, way in (
        ("object-headlamps", HEADLAMP_CANDELA, 1.0),
        ("object-taillamps", TAILLAMP_CANDELA, -1.0),
    ):
        part = glasses(described)[name]
        corners = (part.mesh.vertices.astype(np.float64) @ part.to_world[:3, :3].T)[
            part.mesh.faces
        ] * described.size_in_metres
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 0] * way / 2.0
        assert part.emission is not None
        luminance = float(part.emission[0, 0] @ np.array(LUMINANCE)) * described.environment.candelas
        assert luminance * area[area > 0.0].sum() == pytest.approx(2.0 * candelas, rel=0.02)
    red, green, blue = glasses(described)["object-taillamps"].emission[0, 0]  # type: ignore[index]
    assert red > 0.0 and green == blue == 0.0


@pytest.mark.medium
@pytest.mark.parametrize("control", ["pose", "camera"])
def test_lamps_go_with_what_carries_them(control: str) -> None:
    """A picture of a control's configuration is that of a scene that has it from the start, recorded or not."""
    at = {"pose": {"pose.yaw": 35.0, "pose.x": 0.2}, "camera": {"camera.azimuth": 190.0}}[control]
    given = {**FRONT, **LOW, "camera.lamps": "high", "camera.elevation": 15.0}
    given.pop("camera.azimuth")
    ranges = {name.partition(".")[2]: [0.5 * value, 1.5 * value] for name, value in at.items()}
    moved = scene(**given).renderer({control: ranges}, resolution=48, denoise="none")
    u = torch.full_like(moved.start, 0.5)
    first = moved(moved.start, 0, 16)
    found = moved(u, 0, 16)
    fixed = rendered(scene(**{**given, **at}), 48)
    expected = fixed(fixed.start, 0, 16)
    assert float((found - expected).abs().mean()) < 0.004 < float((first - expected).abs().mean())


@pytest.mark.slow
def test_a_texture_in_a_beam_has_the_gradient_of_differences() -> None:
    given = {**FRONT, **LOW, "camera.azimuth": 180.0, "camera.lamps": "low", "camera.ev": 6.0}
    renderer = scene(**given).renderer({"texture": {"resolution": 4}}, resolution=16, denoise="none")
    at = 0.1 + 0.8 * renderer.start
    _, slope = renderer.gradient(torch.mean, at, 0, 1024)
    step = torch.full_like(at, 0.05)
    with torch.no_grad():
        high, low = (renderer(at + way * step, 1, 2048).mean() for way in (1.0, -1.0))
    assert float(slope.sum()) == pytest.approx(float(high - low) / 0.1, rel=0.1)
