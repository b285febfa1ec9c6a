"""Cells of a mesh's map, and where the mesh is unwrapped anew for it."""

import numpy as np
import pytest

from advsearch.scene import library
from advsearch.scene.assets import Mesh
from advsearch.scene.surface_parts import MAP_SIZE, SurfaceParts


def board(front: tuple[float, float], back: tuple[float, float], flat: bool = False) -> Mesh:
    """Two squares, each of two triangles, whose texture coordinates run over these ends in u."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    vertices = np.concatenate([np.insert(corners, 1, side, axis=1) for side in (0.0, 0.1)])
    uvs = np.concatenate(
        [corners * (ends[1] - ends[0], 0.0 if flat else 1.0) + (ends[0], 0.0) for ends in (front, back)]
    )
    faces = np.array([(0, 1, 2), (0, 2, 3), (6, 5, 4), (7, 6, 4)], np.uint32)
    normals = np.repeat(np.array([(0, -1, 0), (0, 1, 0)], np.float32), 4, axis=0)
    return Mesh(vertices.astype(np.float32), faces, normals, uvs.astype(np.float32))


def test_cells_run_from_the_top_row_and_have_places_on_the_mesh() -> None:
    parts = SurfaceParts(board((0.0, 0.5), (0.5, 1.0)))
    assert not parts.is_unwrapped and parts.n_parts == MAP_SIZE**2 + 4
    uv = np.array([(0.0, 1.0), (0.499, 1.0), (1.0, 0.0), (0.25, 0.5)])
    found = parts.find_cells(np.array([1, 1, 3, 0]), uv)
    half = MAP_SIZE // 2
    assert found.tolist() == [0, half - 1, MAP_SIZE**2 - 1, half * MAP_SIZE + half // 2]
    assert parts.centers[found[:3]] == pytest.approx(np.array([(0, 0, 1), (1, 0, 1), (1, 0.1, 0)]), abs=2.0 / MAP_SIZE)
    assert parts.face_of_part[found].tolist() == [1, 1, 2, 0]
    assert parts.center_uvs[0] == pytest.approx((0.5 / MAP_SIZE, 1 - 0.5 / MAP_SIZE)) and parts.is_covered.all()
    assert parts.part_slices["face"] == slice(MAP_SIZE**2, MAP_SIZE**2 + 4) and parts.face_of_part[
        MAP_SIZE**2 :
    ].tolist() == [
        0,
        1,
        2,
        3,
    ]


@pytest.mark.parametrize(
    "mesh",
    [board((0.0, 0.5), (0.0, 0.5)), board((0.2, 0.2), (0.7, 0.7)), board((0, 0.5), (0.5, 1), flat=True)],
    ids=["one on the other", "no area", "lines"],
)
def test_places_that_texture_coordinates_do_not_tell_apart_get_new_ones(mesh: Mesh) -> None:
    parts = SurfaceParts(mesh)
    assert parts.is_unwrapped and parts.face_uvs.min() >= 0.0 and parts.face_uvs.max() <= 1.0
    same = mesh.uvs[mesh.faces[[0, 2]]].mean(axis=1)
    front, back = parts.find_cells(np.array([0, 2]), same.astype(np.float64))
    assert front != back and parts.is_covered.mean() > 0.2
    assert parts.centers[front][1] < 0.05 < parts.centers[back][1]


def test_a_place_keeps_its_neighbourhood_on_a_new_map() -> None:
    own = library.load_object("mug").mesh
    folded = Mesh(own.vertices, own.faces, own.normals, np.abs(own.uvs - (0.5, 0.0)).astype(np.float32))
    parts, plain = SurfaceParts(folded), SurfaceParts(own)
    assert parts.is_unwrapped and not plain.is_unwrapped
    faces = np.arange(len(own.faces))
    for made in (parts, plain):
        cells = made.find_cells(faces, made.mesh.uvs[own.faces].mean(axis=1).astype(np.float64))
        away = np.linalg.norm(made.centers[cells] - made.centers[MAP_SIZE**2 :], axis=1)
        assert np.median(away) < 0.05 * np.ptp(own.vertices) and (away < 0.15 * np.ptp(own.vertices)).mean() > 0.97
