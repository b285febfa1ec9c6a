"""Ground truth beside a picture: what each pixel sees, and the EXR that it is written to."""

import numpy as np
import pytest
import torch

from advsearch.engine.loading import load_scene
from advsearch.scene.formation import Surfaces
from advsearch.scene.mitsuba_backend.scene import MitsubaScene

SIZE = 32


@pytest.fixture(scope="module")
def seen() -> tuple[MitsubaScene, Surfaces]:
    render = load_scene("mug").renderer(["pose"], resolution=SIZE)
    return render.scene, render.find_surfaces(render.start)


def test_depth_normal_and_texture_coordinates_are_those_of_the_triangle(seen: tuple[MitsubaScene, Surfaces]) -> None:
    scene, found = seen
    mesh = scene.input_assembler.meshes["object"]
    metres = scene.description_and_filter[0].size_in_metres
    vertices, faces = metres * mesh.transform_mesh(None, None)[0], torch.from_numpy(mesh._mesh.faces.astype(np.int64))
    uvs = torch.from_numpy(mesh._mesh.uvs)
    there = found.visible_mask("object")
    assert int(there.sum()) > SIZE
    eye = metres * scene.get_base_value("camera.to_world")[:3, 3]
    corners = faces[found.face_index[there]]
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
