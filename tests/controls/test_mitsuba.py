"""Numbers and colours by Mitsuba's own names: the picture is Mitsuba's with that value, and gradients are right."""

from pathlib import Path

import numpy as np
import pytest
import torch

import advsearch
from advsearch.engine.gradients import make_smooth_loss
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.mitsuba_backend.writing import write_scene, write_xml
from advsearch.scene.mitsuba_backend.xml_files import read_scene

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.island("advsearch.controls.mitsuba")]

RED, GLOW, WIDE = "red.reflectance.value", "light.emitter.radiance.value", "camera.x_fov"
SIZE = 16


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> advsearch.Scene:
    """Mitsuba's Cornell box as a file, with the large box as the object."""
    path = tmp_path_factory.mktemp("scenes") / "box.xml"
    write_xml(path, import_mitsuba().cornell_box(), {}, "")
    return advsearch.load_scene(f"{path}#large-box")


@pytest.mark.medium
def test_the_picture_is_that_of_the_scene_with_the_value(box: advsearch.Scene, tmp_path: Path) -> None:
    changed = import_mitsuba().cornell_box()
    changed["red"]["reflectance"]["value"] = [0.3] * 3
    changed["light"]["emitter"]["radiance"]["value"] = [5.0] * 3
    write_xml(tmp_path / "other.xml", changed, {}, "")
    other = advsearch.load_scene(f"{tmp_path}/other.xml#large-box").description
    expected = MitsubaScene(other, (SIZE, SIZE)).render_radiance({}, 1, 36).numpy()
    controls = {f"mitsuba:{RED}": [0.2, 0.4], f"mitsuba:{GLOW}": [4, 6]}
    renderer = box.renderer(controls, resolution=SIZE, denoise="none")
    middle = torch.full_like(renderer.start, 0.5)
    inputs = renderer.scene.input_assembler(renderer.space.inputs(middle))
    found = renderer.scene.render_radiance(inputs, 1, 36).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    write_scene(renderer.scene, inputs, tmp_path / "again.xml", "")
    out = read_scene(tmp_path / "again.xml")
    np.testing.assert_allclose(
        [out["red"]["reflectance"]["value"], out["light"]["emitter"]["radiance"]["value"]],
        [[0.3] * 3, [5.0] * 3],
        rtol=1e-6,
    )
    stock = np.array(import_mitsuba().render(import_mitsuba().load_file(str(tmp_path / "again.xml")), seed=2, spp=1024))
    read = advsearch.load_scene(f"{tmp_path}/again.xml#object").description
    back = MitsubaScene(read, (SIZE, SIZE)).render_radiance({}, 3, 1024).numpy()
    first, second = (renderer.scene.render_radiance(inputs, seed, 1024).numpy() for seed in (4, 5))
    noise = np.abs(first - second).mean()
    assert noise < 0.02 * found.mean()
    assert max(np.abs(stock - first).mean(), np.abs(back - first).mean()) < 1.2 * noise
    assert [group.name for group in renderer.plan.groups][2:4] == [f"mitsuba.{RED}.blue", f"mitsuba.{GLOW}.red"]


@pytest.mark.medium
def test_adjoints_agree_with_differences(box: advsearch.Scene) -> None:
    controls, loss = {f"mitsuba:{RED}": [0.1, 0.9], f"mitsuba:{GLOW}": [1, 30]}, make_smooth_loss((SIZE, SIZE))
    found = []
    for estimator in ("adjoint", "differences"):
        renderer = box.renderer(controls, resolution=SIZE, denoise="none", estimators={"*": estimator})
        found.append(renderer.gradient(loss, torch.full_like(renderer.start, 0.2), 2, 64)[1])
    assert {group.estimator for group in renderer.plan.groups} == {"differences"}
    assert float((found[0] - found[1]).norm()) < 0.05 * float(found[1].norm())
    assert bool((found[0] != 0).all())


def test_a_plain_number_changes_recorded_renders(box: advsearch.Scene) -> None:
    renderer = box.renderer({"mitsuba:camera.near_clip": [0.01, 5.0]}, resolution=SIZE, denoise="none")
    shown = [float(renderer.radiance(torch.tensor([share]), 1, 16).mean()) for share in (0.0, 0.9, 0.0, 0.9)]
    assert shown[0] == shown[2] and shown[1] == shown[3] and abs(shown[0] - shown[1]) > 0.1 * shown[0]
    assert renderer.plan.groups[0].estimator == "differences"


def test_one_channel_of_a_colour_varies_and_the_others_stay(box: advsearch.Scene) -> None:
    renderer = box.renderer({f"mitsuba:{RED}": [0.0, 1.0], f"mitsuba:{RED}.green": 0.25}, resolution=SIZE)
    assert [group.name for group in renderer.plan.groups] == [f"mitsuba.{RED}.red", f"mitsuba.{RED}.blue"]
    renderer = box.renderer({f"mitsuba:{RED}.green": [0.0, 1.0]}, resolution=SIZE)
    inputs = renderer.space.inputs(torch.tensor([0.25]))
    np.testing.assert_allclose(inputs[f"mitsuba.{RED}"], [0.570068, 0.25, 0.0443706], rtol=1e-5)
