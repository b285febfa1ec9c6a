"""Polygons become triangles with the same area, convex or not."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from advsearch.scene.importing import geometry
from advsearch.scene.importing.geometry import triangulate


def doubled(corners: np.ndarray) -> np.ndarray:
    """Twice the signed areas along z of triangles (T, 3, 3)."""
    ahead, aside = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    found: np.ndarray = ahead[:, 0] * aside[:, 1] - ahead[:, 1] * aside[:, 0]
    return found


def outline(points: np.ndarray) -> float:
    """Twice the signed area of a polygon (n, 3)."""
    after = np.roll(points, -1, axis=0)
    return float((points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]).sum())


@pytest.mark.medium
@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(3, 30), min_size=1, max_size=12), st.integers(0, 2**32 - 1), st.booleans())
def test_star_shaped_polygons_are_covered_once(counts: list[int], seed: int, clockwise: bool) -> None:
    random = np.random.default_rng(seed)
    shapes = []
    for count in counts:
        angles = 2.0 * np.pi * (np.arange(count) + random.uniform(0.0, 0.8, count)) / count
        radius = random.uniform(0.05, 1.0, count)
        shape = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, 0.3)], axis=1)
        shapes.append(np.roll(shape[::-1] if clockwise else shape, random.integers(count), axis=0))
    points = np.concatenate(shapes) * random.uniform(1e-3, 1e3) + random.uniform(-5.0, 5.0, 3)
    triangles, owner, wrong = triangulate(points, np.array(counts))
    areas, starts = doubled(points[triangles]), np.cumsum([0, *counts])
    assert wrong == 0 and np.array_equal(np.bincount(owner), np.array(counts) - 2)
    for number, (low, high) in enumerate(pairwise(starts)):
        own = triangles[owner == number]
        assert own.min() >= low and own.max() < high
        whole = outline(points[low:high] - points[low])
        assert areas[owner == number].sum() == pytest.approx(whole, rel=1e-6, abs=1e-9 * abs(whole))
        assert (areas[owner == number] * np.sign(whole) >= -1e-9 * abs(whole)).all()


@pytest.mark.parametrize("tilt", [0.0, 1.0, 2.5])
def test_a_comb_a_hole_and_corners_in_line(tilt: float) -> None:
    comb = [(0, -1), (100, -1)] + [(k, 5.0 * (k % 2)) for k in reversed(range(101))]
    ring = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]  # cut open to its hole
    line = [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)]
    for shape, area in ((comb, 50 * 5 + 100), (ring, 12.0), (line, 4.0)):
        flat = np.array([(x, y, 0.0) for x, y in shape])
        turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        triangles, _, wrong = triangulate(flat @ turn.T, np.array([len(flat)]))
        assert wrong == 0 and doubled(flat[triangles]).sum() / 2.0 == pytest.approx(area)
        assert (doubled(flat[triangles]) > 1e-9).all()  # each corner of a line is used, so that no seam opens


def test_what_crosses_itself_is_counted_and_work_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    star = np.array([(np.cos(4 * np.pi * k / 5), np.sin(4 * np.pi * k / 5), 0.0) for k in range(5)])
    triangles, _, wrong = triangulate(star, np.array([5]))
    assert triangles.shape == (3, 3) and wrong in (0, 1)
    wild = np.random.default_rng(0).normal(size=(400, 3))
    monkeypatch.setattr(geometry, "MOST_WORK", 1000)
    triangles, owner, wrong = triangulate(wild, np.array([200, 200]))
    assert wrong == 2 and triangles.shape == (396, 3) and np.array_equal(np.bincount(owner), [198, 198])
    assert triangulate(np.full((4, 3), np.nan), np.array([4]))[0].shape == (2, 3)
