"""Ground truth beside a picture: what each pixel sees, and the EXR that it is written to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

from advsearch.engine.loading import load_scene
from advsearch.runs.files import write_layers
from advsearch.scene.formation import AOVS, CHANNELS, Surfaces
from advsearch.scene.mitsuba_backend.scene import MitsubaScene

SIZE = 32


@pytest.fixture(scope="module")
def seen() -> tuple[MitsubaScene, Surfaces]:
    render = load_scene("mug").renderer(["pose"], resolution=SIZE)
    return render.scene, render.surfaces(render.start)


def made() -> Surfaces:
    """Two pixels: the object, and nothing."""
    return Surfaces(
        names=("ground", "object"),
        id=torch.tensor([[2, 0]]),
        depth=torch.tensor([[1.5, torch.inf]]),
        z_depth=torch.tensor([[1.4, torch.inf]]),
        normal=torch.tensor([[[0.0, 0.6, 0.8], [0.0, 0.0, 0.0]]]),
        uv=torch.tensor([[[0.25, 0.75], [0.0, 0.0]]]),
        face=torch.tensor([[7, 0]]),
    )


def test_layers_are_read_back_with_what_they_mean(tmp_path: Path) -> None:
    surfaces, every = made(), tuple(AOVS)
    path = write_layers(tmp_path / "a.exr", surfaces.make_layers(every, "object"), surfaces.describe_layers(every))
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found, header = {name: one.pixels for name, one in file.channels().items()}, dict(file.header())
    assert sorted(found) == sorted(f"{name}.{channel}" for name in every for channel in CHANNELS[name])
    assert found["mask.Y"].tolist() == [[1.0, 0.0]] and found["depth.Z"].tolist() == [[1.5, np.inf]]
    assert found["uv.V"].tolist() == [[0.75, 0.0]] and found["normal.Z"][0, 0] == np.float32(0.8)
    assert found["id.Y"].dtype == np.uint32 and found["id.Y"].tolist() == [[2, 0]]
    assert header["depth"].startswith("distance from the camera along the ray, metres")
    assert header["id"].endswith("1 is ground, 2 is object")


def test_depth_normal_and_texture_coordinates_are_those_of_the_triangle(seen: tuple[MitsubaScene, Surfaces]) -> None:
    scene, found = seen
    mesh = scene.assembly.meshes["object"]
    metres = scene.definition[0].size_in_metres
    vertices, faces = metres * mesh.transform_mesh(None, None)[0], torch.from_numpy(mesh._mesh.faces.astype(np.int64))
    uvs = torch.from_numpy(mesh._mesh.uvs)
    there = found.visible_mask("object")
    assert int(there.sum()) > SIZE
    eye = metres * scene.get_base_value("camera.to_world")[:3, 3]
    corners = faces[found.face[there]]
    for low, high, value in (
        (
            vertices[corners].sub(eye).norm(dim=2).amin(1) - 2e-3,
            vertices[corners].sub(eye).norm(dim=2).amax(1),
            "depth",
        ),
        (uvs[corners].amin(1), uvs[corners].amax(1), "uv"),
    ):
        at = getattr(found, value)[there]
        assert bool(((at >= low - 1e-4) & (at <= high + 1e-4)).all()), value
    ahead = scene.get_base_value("camera.to_world")[:3, 2]
    along = (vertices[corners] - eye) @ (ahead / ahead.norm())
    assert bool(((found.z_depth[there] >= along.amin(1) - 1e-4) & (found.z_depth[there] <= along.amax(1) + 1e-4)).all())
    assert bool((found.z_depth[there] < found.depth[there]).all()) and bool(found.z_depth[found.id == 0].isinf().all())
    facing = (found.normal[there] * (vertices[corners].mean(1) - eye)).sum(1)
    assert float((facing < 0.0).float().mean()) > 0.9
    nothing = found.id == 0
    assert bool(nothing.any()) and bool(found.depth[nothing].isinf().all()) and not found.normal[nothing].any()
