"""Answers out again: stock Mitsuba renders the adversarial scene of a run as the run did, and so does reading it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

import advsearch
from advsearch.api.export import AdversarialRun
from advsearch.cli.main import main
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.importing.objects import import_object
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from samples import make_attacked

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.medium]

CONTROLS = {"texture": {"resolution": 64}, "pose": {}, "light": {}, "camera": {}, "lens": {}}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over a mug that has been turned, painted and lit anew, before a camera elsewhere."""
    config = AttackConfig(object="mug", controls=CONTROLS, resolution=32)
    size = advsearch.load_scene("mug").renderer(CONTROLS, resolution=32).start.numel()
    u = torch.rand(size, generator=torch.Generator().manual_seed(4))
    return make_attacked(tmp_path_factory.mktemp("runs") / "mug-all-001", config, u.numpy())


def test_stock_mitsuba_renders_the_adversarial_scene(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", str(run), "--out", str(tmp_path / "scene.xml")]
    assert main([*command, "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]

    answer = AdversarialRun.load(run)
    renderer = answer.problem.renderer.copy_with(denoiser="none")
    ours, again = (renderer.radiance(answer.u, seed, 128).numpy() for seed in (0, 1))
    mi = import_mitsuba()
    theirs = np.array(mi.render(mi.load_file(str(tmp_path / "scene.xml")), seed=2, spp=128))
    back = advsearch.load_scene(f"{tmp_path}/scene.xml#object").description
    read = MitsubaScene(back, (32, 32)).render_radiance({}, 3, 128).numpy()
    noise = float(np.abs(ours - again).mean())
    assert np.abs(ours - renderer.radiance(renderer.start, 0, 128).numpy()).mean() > 5 * noise
    gain = float(notes[1].partition("curve of ")[2].partition(" ")[0])
    for other in (theirs, read):
        assert np.abs(ours - other).mean() < 1.2 * noise
        assert other.mean() == pytest.approx(ours.mean(), rel=0.01)
        one, two, shown = (linear_to_srgb(np.float32(np.clip(gain * found, 0, 1))) for found in (ours, again, other))
        assert np.abs(one - shown).mean() < 1.2 * np.abs(one - two).mean()
        np.testing.assert_allclose(one, renderer.formation.map_to_display(torch.from_numpy(ours)).numpy(), atol=1e-5)


def test_the_adversarial_object_is_read_back(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mug.glb"
    assert main(["export", str(run), "--out", str(out), "--json"]) == 0
    assert "8 bits" in json.loads(capsys.readouterr().out)["notes"][0]
    answer = AdversarialRun.load(run)
    inputs, description = answer.inputs, answer.problem.space.scene
    assert description is not None
    texture = np.round(linear_to_srgb(inputs["object.base_color"]).numpy() * 255)
    world, own = inputs["object.vertices"].numpy(), description.meshes["object"]

    read = trimesh.load(out, process=False, force="mesh")
    metres = world * description.object.size_in_metres  # glTF is in metres
    np.testing.assert_allclose(read.vertices[:, [2, 0, 1]], metres, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(read.faces, own.mesh.faces)
    np.testing.assert_allclose(read.visual.uv, own.mesh.uvs, atol=1e-6)
    np.testing.assert_array_equal(np.array(read.visual.material.baseColorTexture)[..., :3], texture)
    surface = read.visual.material
    assert (surface.roughnessFactor, surface.metallicFactor) == (own.material.roughness, own.material.metallic)

    back = import_object(out)
    np.testing.assert_allclose(back.base_color, texture / 255, atol=1e-6)
    assert (back.material.roughness, back.material.metallic) == (own.material.roughness, own.material.metallic)
    size = np.ptp(world, axis=0)
    corners, middle = (world - world.min(axis=0)) / size.max(), size / (2 * size.max())
    middle[2] = 0.0
    there = np.concatenate([back.mesh.vertices + middle, back.mesh.uvs], axis=1)
    apart, at = KDTree(there).query(np.concatenate([corners, own.mesh.uvs], axis=1))
    assert apart.max() < 1e-5
    normals = torch.nn.functional.normalize(inputs["object.normals"], dim=1).numpy()
    assert float((back.mesh.normals[at] * normals).sum(axis=1).mean()) > 0.99
