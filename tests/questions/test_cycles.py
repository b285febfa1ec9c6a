"""Cycles: Blender gets the scene as it is in a configuration, and a picture for each seed; what goes wrong is said."""

import json
import math
import os
import stat
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

import advsearch
from advsearch.questions.replay import cycles
from advsearch.questions.replay.cycles import BlenderError, Cycles
from advsearch.scene.description import SceneDescription
from advsearch.scene.parts import HazePart
from advsearch.scene.renderer import Renderer
from advsearch.trust.programs import BLENDER

pytestmark = pytest.mark.island("advsearch.questions.replay")

STAND_IN = f"""#!{sys.executable}
import json, os, shutil, sys
from pathlib import Path
import numpy as np, OpenEXR
here, folder = Path(__file__).parent, Path(sys.argv[-1])
for name in ("scene.json", "scene.glb", "environment.exr"):
    if (folder / name).exists():
        shutil.copy(folder / name, here)
(here / "seen.json").write_text(json.dumps([sys.argv[1:], dict(os.environ)]))
exec((here / "does.py").read_text())
"""
PAINT = """
for line in sys.stdin:
    seed, spp, number = line.split()
    pixels = np.full((8, 12, 3), float(seed) + float(spp), np.float32)
    with OpenEXR.File({}, {"RGB": pixels}) as picture:
        picture.write(str(folder / f"{number}.part"))
    os.replace(folder / f"{number}.part", folder / f"{number}.exr")
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a stand-in for Blender on the PATH."""
    program = tmp_path / "blender"
    program.write_text(STAND_IN)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    (tmp_path / "does.py").write_text(PAINT)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("SECRET", "x")
    monkeypatch.delenv(BLENDER, raising=False)
    yield tmp_path


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return advsearch.load_scene("mug").renderer("pose,light,camera", resolution=(8, 12), denoise="none")


def by_cycles(scene: SceneDescription) -> Cycles:
    return Cycles(scene, (8, 12), max_depth=6, denoise=False)


@pytest.mark.medium
def test_blender_gets_the_scene_as_it_is(folder: Path, renderer: Renderer) -> None:
    u = torch.full_like(renderer.start, 0.7)
    made = by_cycles(renderer.scene.description_and_filter[0])
    theirs = renderer.copy_with(external_render=made.radiance)
    first, again = (theirs.radiance(u, seed, 4) for seed in (1, 2))
    assert first.shape == (8, 12, 3) and not torch.equal(first, again) and theirs.n_renders == 2
    told = json.loads((folder / "scene.json").read_text())
    inputs = renderer.scene.input_assembler(renderer.space.inputs(u))
    meshes = trimesh.load(folder / "scene.glb", process=False).geometry
    assert set(meshes) == {"object", "ground"}
    np.testing.assert_array_equal(
        meshes["object"].vertices[:, [0, 2, 1]] * (1, -1, 1), inputs["object.vertices"].numpy()
    )
    camera = inputs["camera.to_world"].numpy()
    np.testing.assert_allclose(np.array(told["camera"])[:, [1, 3]], camera[:, [1, 3]], rtol=1e-6)
    np.testing.assert_allclose(np.array(told["camera"])[:, [0, 2]], -camera[:, [0, 2]], rtol=1e-6)
    (lamp,) = told["lamps"]
    np.testing.assert_allclose(lamp["ball"], inputs["light.ball"].numpy(), rtol=1e-6)
    assert told["environment"] and told["bounces"] == 4 and told["turn"] == math.pi / 2
    assert told["fov"] == pytest.approx(math.radians(float(inputs["camera.fov"])))
    assert (folder / "environment.exr").exists()
    arguments, environment = json.loads((folder / "seen.json").read_text())
    assert arguments[:3] == ["--background", "--factory-startup", "--disable-autoexec"] and "SECRET" not in environment
    del made, theirs
    assert not Path(environment["HOME"]).exists()


def test_blender_gets_the_field_of_view_in_radians(folder: Path, renderer: Renderer) -> None:
    (folder / "does.py").write_text("sys.exit(3)")
    inputs = renderer.scene.input_assembler(renderer.space.inputs(renderer.start)) | {
        "camera.fov": torch.tensor([60.0])
    }
    with pytest.raises(BlenderError):
        by_cycles(renderer.scene.description_and_filter[0]).radiance(inputs, 0, 1)
    assert json.loads((folder / "scene.json").read_text())["fov"] == pytest.approx(1.0471976)


@pytest.mark.parametrize(
    ("does", "words"),
    [
        ("print('no engine CYCLES'); sys.exit(3)", "Blender stopped"),
        ("import time; time.sleep(30)", "had not rendered it after 1 seconds"),
    ],
)
def test_what_blender_can_not_render_is_said(
    folder: Path, renderer: Renderer, does: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cycles, "MAX_RENDER_SECONDS", 1 if "sleep" in does else cycles.MAX_RENDER_SECONDS)
    (folder / "does.py").write_text(does)
    inputs = renderer.scene.input_assembler(renderer.space.inputs(renderer.start))
    with pytest.raises(BlenderError, match=words):
        by_cycles(renderer.scene.description_and_filter[0]).radiance(inputs, 0, 1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"parts": (HazePart("haze", 3.0),)}, "the scene has haze, which is not carried over"),
        ({"backdrop": True, "thin_lens": True}, "a lens, a plain background"),
    ],
)
def test_what_is_not_carried_over_is_said(
    folder: Path, renderer: Renderer, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(BlenderError, match=words):
        by_cycles(replace(renderer.scene.description_and_filter[0], **changes))
