"""Answers out again: stock Mitsuba renders the adversarial scene of a run as the run did, and so does reading it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree

import advsearch
from advsearch.api.export import AdversarialRun
from advsearch.cli.main import main
from advsearch.controls import make_control, make_space
from advsearch.questions.attack.result import write_object
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import OBJECT_FILE, RunDirectory
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.importing.objects import import_object
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.parts import HazePart
from samples import make_attacked

pytestmark = pytest.mark.usefixtures("two_threads")

CONTROLS = {"texture": {"resolution": 64}, "pose": {}, "light": {}, "camera": {}, "lens": {}}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over a mug that has been turned, painted and lit anew, before a camera elsewhere."""
    config = AttackConfig(object="mug", controls=CONTROLS, resolution=32)
    size = advsearch.load_scene("mug").renderer(CONTROLS, resolution=32).start.numel()
    u = torch.rand(size, generator=torch.Generator().manual_seed(4))
    return make_attacked(tmp_path_factory.mktemp("runs") / "mug-all-001", config, u.numpy())


@pytest.mark.medium
def test_stock_mitsuba_renders_the_adversarial_scene(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", str(run), "--out", str(tmp_path / "scene.xml")]
    assert main([*command, "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    readme = (tmp_path / "scene-README.txt").read_text("utf-8")
    assert all(note in readme for note in notes)
    assert "32 x 32" in notes[0] and "denoiser" in notes[2] and "lens" in notes[3]
    assert main(command) == 2
    assert "is there already" in capsys.readouterr().err

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
        np.testing.assert_allclose(one, renderer.formation.display(torch.from_numpy(ours)).numpy(), atol=1e-5)


def answered_by(controls: dict[str, Any], path: Path) -> Path:
    """A small run over a mug with a configuration a little above the middle as its answer."""
    config = AttackConfig(object="mug", controls=controls, resolution=16, denoise="none")
    size = advsearch.load_scene("mug").renderer(controls, resolution=16).start.numel()
    return make_attacked(path, config, np.full(size, 0.6))


HAZE: dict[str, Any] = {"haze": {"density": [0.1, 0.3]}}


@pytest.mark.medium
@pytest.mark.parametrize("controls", [HAZE, {"background": {}}], ids=["haze", "background"])
def test_stock_mitsuba_renders_haze_and_a_plain_background(
    controls: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = answered_by(controls, tmp_path / "mug-001")
    assert main(["export", str(run), "--out", str(tmp_path / "scene.xml"), "--json"]) == 0
    note = json.loads(capsys.readouterr().out)["notes"][2]
    answer = AdversarialRun.load(run)
    renderer = answer.problem.renderer
    ours, again = (renderer.radiance(answer.u, seed, 128).numpy() for seed in (0, 1))
    mi = import_mitsuba()
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    theirs, once_more = (np.array(mi.render(scene, seed=seed, spp=128)) for seed in (2, 3))
    noise = max(np.abs(ours - again).mean(), np.abs(theirs - once_more)[..., :3].mean())
    if controls is HAZE:
        assert "Haze scatters light" in note
        back = advsearch.load_scene(f"{tmp_path}/scene.xml#object")
        (haze,) = (part for part in back.description.parts if isinstance(part, HazePart))
        read = MitsubaScene(back.description, (16, 16)).render_radiance({}, 3, 128).numpy()
        assert not back.description.notes and np.abs(ours - read).mean() < 1.2 * noise
        assert read.mean() == pytest.approx(ours.mean(), rel=0.02)
        space = make_space([make_control("haze", {})], back.description)  # goes on from the scene's own
        assert (
            space.describe(space.start)["haze.density"]["value"] == pytest.approx(haze.density) == pytest.approx(0.22)
        )
    else:
        color = [float(one) for one in note.partition("(")[2].partition(")")[0].split(",")]
        theirs = theirs[..., :3] + (1.0 - theirs[..., 3:]) * color
    assert theirs.mean() == pytest.approx(ours.mean(), rel=0.03)
    assert np.abs(ours - theirs).mean() < 1.2 * noise
    clean = renderer.radiance(renderer.start, 0, 128).numpy()
    assert np.abs(clean - ours).mean() > 1.5 * noise


@pytest.mark.medium
def test_haze_before_a_plain_background_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = answered_by({**HAZE, "background": {}}, tmp_path / "mug-001")
    assert main(["export", str(run), "--out", str(tmp_path / "scene.xml")]) == 2
    assert "haze before a plain background is no part of a Mitsuba scene" in capsys.readouterr().err


@pytest.mark.parametrize(("given", "message"), [([], "give its name"), (["--kind", "search"], "tables of rows")])
def test_what_is_missing_is_said(
    run: Path, tmp_path: Path, given: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "new")] if given else []
    assert main(["export", str(run), "--format", "mitsuba", *out, *given]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.medium
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
    metres = world * description.object.metres  # glTF is in metres
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


@pytest.mark.medium
def test_the_object_to_turn_is_the_adversarial_scene_and_what_was_before(run: Path, tmp_path: Path) -> None:
    answer = AdversarialRun.load(run)
    with RunDirectory.create_for(AttackConfig(object="mug", run=str(tmp_path / "kept"))) as kept:
        write_object(kept, answer.problem, answer.u)
    read = trimesh.load(tmp_path / "kept" / OBJECT_FILE, process=False, force="mesh")
    world = answer.inputs["object.vertices"].numpy()
    np.testing.assert_array_equal(read.vertices[: len(world), [2, 0, 1]], world)
    header = json.loads(
        (tmp_path / "kept" / OBJECT_FILE).read_bytes()[20:].partition(b"\0")[0].rpartition(b"}")[0] + b"}"
    )
    assert [one["name"] for one in header["scenes"]] == ["adversarial", "clean"]
    assert len(header["bufferViews"]) == 2 * 2 + 2 + 2  # places, normals and textures differ, the rest is there once
    camera = next(one["matrix"] for one in header["nodes"] if "camera" in one)
    x, y, z = answer.inputs["camera.to_world"][:3, 3].tolist()
    np.testing.assert_allclose(camera[12:15], [y, z, x], atol=1e-6)
    away = np.array(camera[12:15]) - read.vertices[: len(world)].mean(axis=0)
    assert float(np.dot(away, camera[8:11])) > 0.9 * float(np.linalg.norm(away))  # it looks at the object
