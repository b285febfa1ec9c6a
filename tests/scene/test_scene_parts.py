"""A scene's named meshes, lamps and cameras, and scenes without an environment map."""

import gc
import weakref
from dataclasses import replace

import pytest
import torch

from advsearch.engine.loading import Scene
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import load_description
from advsearch.scene.formation import compute_metered_gain
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.parts import BallLamp, PointLamp, PosedCamera
from advsearch.scene.settings import ORBIT_CAMERA


def picture(scene: Scene, controls: str | dict[str, dict[str, object]] = "pose") -> torch.Tensor:
    render = scene.renderer(controls, resolution=24)
    with torch.no_grad():
        return render(render.start, seed=0, spp=16)


@pytest.mark.parametrize(
    "lamp",
    [
        PointLamp("key", position=(1.5, -1.0, 2.5), intensity=(1.0, 1.0, 1.0)),
        BallLamp("key", center=(1.5, -1.0, 2.5), radius=0.1, radiance=(31.8, 31.8, 31.8)),
    ],
)
def test_a_scene_without_a_map_is_lit_and_metered_by_its_lamps(lamp: PointLamp | BallLamp) -> None:
    scene = load_description("mug", "none").with_part(lamp)
    assert scene.environment is None and set(scene.lamps) == {"key"} and set(scene.meshes) == {"object"}
    assert Scene(scene).description.gain == pytest.approx(61.2, rel=0.01)
    seen = picture(Scene(scene))
    assert 0.2 < float(seen.mean()) < 0.6 and float(seen.max()) > 0.6
    twice = replace(scene, parts=(PointLamp("key", position=(1.5, -1.0, 2.5), intensity=(2.0, 2.0, 2.0)),))
    assert twice.gain == pytest.approx(scene.gain / 2.0, rel=0.01), "an automatic exposure"


def test_meshes_have_names_and_one_of_them_is_the_object() -> None:
    scene = load_description("mug")
    scene = scene.with_part(replace(scene.meshes["object"], name="second"))
    assert list(scene.meshes) == ["object", "second"] and scene.meshes["object"].mesh is scene.object.mesh
    assert {"object.vertices", "second.vertices"} <= MitsubaScene(scene, (8, 8)).input_names
    with pytest.raises(InputError, match="already"):
        scene.with_part(scene.meshes["object"])


@pytest.mark.medium
def test_a_scene_is_seen_by_any_of_its_cameras() -> None:
    scene = load_description("mug")
    side = load_description("mug", setting_values={"camera.azimuth": 130.0, "camera.fov": 50.0})
    cameras = {"front": PosedCamera(camera_to_world(scene), 35.0), "side": PosedCamera(camera_to_world(side), 50.0)}
    scene = replace(scene, cameras=cameras)
    assert torch.equal(picture(Scene(scene.with_camera("front"))), picture(Scene(scene)))
    assert torch.equal(picture(Scene(scene.with_camera("side"))), picture(Scene(side)))
    assert scene.with_camera("side").with_camera(ORBIT_CAMERA).get_number("camera.fov") == 35.0
    with pytest.raises(UnknownNameError, match="'sied'"):
        scene.with_camera("sied")
    with pytest.raises(InputError, match="camera 'side'"):
        picture(Scene(scene.with_camera("side")), "camera")


def test_what_is_cached_of_a_scene_goes_with_it() -> None:
    scene = load_description("mug")
    gain = compute_metered_gain(scene)
    assert compute_metered_gain(scene) == gain
    reference = weakref.ref(scene)
    del scene
    gc.collect()
    assert reference() is None
