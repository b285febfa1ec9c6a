"""Meshes with fewer faces: as many as were asked for, where they were, without gaps."""

import numpy as np
import pytest

from advsearch.scene.assets import Mesh, make_simplifier
from advsearch.scene.library import load_object


def ball(rows: int = 90, columns: int = 180) -> Mesh:
    """A ball of radius 1 with a seam where its texture begins and ends: some 32,000 faces."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    up, around = np.pi * (v - 0.5), 2 * np.pi * (u % 1.0)
    points = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=2)
    corner = np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)
    lower = np.stack([corner, corner + 1, corner + columns + 2], axis=2).reshape(-1, 3)
    upper = np.stack([corner, corner + columns + 2, corner + columns + 1], axis=2).reshape(-1, 3)
    vertices = points.reshape(-1, 3).astype(np.float32)
    uvs = np.stack([u, v], axis=2).reshape(-1, 2).astype(np.float32)
    return Mesh(vertices, np.concatenate([lower, upper]).astype(np.uint32), vertices, uvs)


def test_few_faces_are_left_alone() -> None:
    assert make_simplifier(load_object("mug").mesh, 6000) is None


@pytest.mark.parametrize("most", [20_000, 5_000, 1_500])
def test_a_ball_of_fewer_faces_is_still_a_closed_ball(most: int) -> None:
    own = ball()
    found = make_simplifier(own, most)
    assert found is not None
    less = found(own)
    assert most / 4 < len(less.faces) <= most
    radius = np.linalg.norm(less.vertices, axis=1)
    assert radius.max() <= 1.0 + 1e-6 and radius.min() > 1.0 - 40 / most
    first, second, third = less.vertices[less.faces].transpose(1, 0, 2).astype(float)
    outwards = np.cross(second - first, third - first)
    assert (np.einsum("fi,fi->f", outwards, first + second + third) > 0).all()  # no face was turned over
    area = np.linalg.norm(outwards, axis=1).sum() / 2
    assert area == pytest.approx(4 * np.pi, rel=0.03 if most > 2000 else 0.08)
    moved = found(Mesh(own.vertices + np.float32(1), own.faces, own.normals, own.uvs))
    np.testing.assert_allclose(moved.vertices, less.vertices + 1, atol=1e-5)


def test_a_seam_stays_shut() -> None:
    own = ball()
    found = make_simplifier(own, 5_000)
    assert found is not None
    _, together = np.unique(found(own).vertices, axis=0, return_inverse=True)
    edges = together.reshape(-1)[found(own).faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)]
    _, shared = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    assert (shared == 2).mean() > 0.99  # an edge without a neighbour is one of a gap
