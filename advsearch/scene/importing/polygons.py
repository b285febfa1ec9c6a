"""Polygons as triangles: fans where those are right, else ears are cut off, for many polygons at a time."""

from __future__ import annotations

import numpy as np

from advsearch.scene.assets import Bools, Doubles, Ints
from advsearch.scene.importing.files import Notes

MOST_WORK = 50_000_000  # points that are compared with ears, in all; then the polygons that are left are cut up as fans
_FLAT = 1e-9  # twice the area of a triangle, as a share of that of its polygon, up to which it has none


def cut_up(points: Doubles, counts: Ints, notes: Notes) -> tuple[Ints, Ints]:
    """Return the triangles of polygons, and the polygon of each, as `triangulated`; what is odd is noted."""
    if few := int((counts < 3).sum()):
        notes.say(f"{few:,} face{'' if few == 1 else 's'} of fewer than 3 corners left out")
    triangles, owner, wrong = triangulated(points, counts)
    if wrong:
        notes.say(f"{wrong:,} faces cross themselves, or are too much work, and may be cut up wrongly")
    return triangles, owner


def triangulated(points: Doubles, counts: Ints) -> tuple[Ints, Ints, int]:
    """Cut polygons up into triangles: return their corners (T, 3), as indices into `points`, in the order of the
    polygons; the polygon of each (T,); and of how many polygons some triangles may lie outside: they cross themselves,
    or were too much work.

    Where the triangles from a polygon's first corner all face as the polygon does (it is convex, mostly), these are
    taken. Otherwise ears are cut off (Meisters 1975) in the plane that the polygon lies in on average (Newell). Points
    (C, 3) are those of the corners of all polygons, one polygon after the other, and may be NaN; counts (P,) are of
    each one's corners, and those of fewer than 3 become no triangle.
    """
    starts = np.cumsum(counts) - counts
    kinds, group = np.unique(counts, return_inverse=True)
    triangles, owners, wrong, left = [], [], 0, MOST_WORK
    for number, count in enumerate(kinds):
        if count < 3:
            continue
        polygons = np.flatnonzero(group == number)
        corners = starts[polygons, None] + np.arange(count)
        cut = np.stack([corners[:, :1].repeat(count - 2, axis=1), corners[:, 1:-1], corners[:, 2:]], axis=2)
        if count > 3:
            flat = _flattened(points[corners])
            areas = _doubled_areas(flat[:, :1], flat[:, 1:-1], flat[:, 2:])
            bad = np.flatnonzero((areas <= _FLAT * np.abs(areas.sum(axis=1))[:, None]).any(axis=1))
            if len(bad):
                ears, failed, used = _ears(flat[bad], left)
                left, wrong = left - used, wrong + failed
                cut[bad] = corners[bad][np.arange(len(bad))[:, None, None], ears]
        triangles.append(cut.reshape(-1, 3))
        owners.append(np.repeat(polygons, count - 2))
    if not owners:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64), wrong
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order], wrong


def _flattened(corners: Doubles) -> Doubles:
    """Return polygons (P, n, 3) in their planes, (P, n, 2), counter-clockwise and about 1 large."""
    corners = corners - corners.mean(axis=1, keepdims=True)
    corners = corners / np.maximum(np.abs(corners).max(axis=(1, 2), keepdims=True), 1e-300)
    normal = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    aside = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(aside, normal)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    plane = np.stack([across, np.cross(normal, across)], axis=2)
    return np.asarray(corners @ plane)


def _doubled_areas(a: Doubles, b: Doubles, c: Doubles) -> Doubles:
    """Return twice the signed areas of triangles in the plane, (..., 2) each."""
    ahead, aside = b - a, c - a
    return np.asarray(ahead[..., 0] * aside[..., 1] - ahead[..., 1] * aside[..., 0])


def _ears(flat: Doubles, budget: int) -> tuple[Ints, int, int]:
    """Cut the ears off polygons (P, n, 2) with the same number of corners, as `_flattened` gives them, all at once,
    each in turns of its own, with so many comparisons at most. Return the corners of the triangles (P, n - 2, 3); how
    many polygons with an area had no ear at some time, or were left over; and the comparisons that were made."""
    count, corners = flat.shape[:2]
    after = np.tile(np.roll(np.arange(corners), -1), (count, 1))
    before = np.tile(np.roll(np.arange(corners), 1), (count, 1))
    triangles = np.zeros((count, corners - 2, 3), dtype=np.int64)
    cut, tip, tries = (np.zeros(count, dtype=np.int64) for _ in range(3))
    failed = np.zeros(count, dtype=np.bool_)
    size = np.abs(_doubled_areas(flat, np.roll(flat, -1, axis=1), np.zeros(2)).sum(axis=1))
    # only a corner that is not convex can lie in an ear
    dents = _doubled_areas(np.roll(flat, 1, axis=1), flat, np.roll(flat, -1, axis=1)) <= _FLAT * size[:, None]
    dent = np.argsort(~dents, axis=1, kind="stable")[:, : int(dents.sum(axis=1).max())]
    there = np.take_along_axis(dents, dent, axis=1)
    places = np.take_along_axis(flat, dent[:, :, None], axis=1)
    busy, used = np.arange(count), 0
    while len(busy):
        b = tip[busy]
        a, c = before[busy, b], after[busy, b]
        left = corners - cut[busy]
        ear = left == 3
        hopeless = tries[busy] >= left
        if used < budget:
            used += places[busy].size // 2
            ends = [flat[busy, corner] for corner in (a, b, c)]
            ear |= _is_ear(ends, places[busy], there[busy], _FLAT * size[busy])
        else:
            hopeless[:] = True
        failed[busy] |= hopeless & ~ear
        ear |= hopeless
        tip[busy], tries[busy] = c, tries[busy] + 1
        rows, a, b, c = busy[ear], a[ear], b[ear], c[ear]
        triangles[rows, cut[rows]] = np.stack([a, b, c], axis=1)
        there[rows] &= dent[rows] != b[:, None]
        after[rows, a], before[rows, c], tries[rows] = c, a, 0
        cut[rows] += 1
        busy = busy[cut[busy] < corners - 2]
    return triangles, int((failed & (size > _FLAT)).sum()), used


def _is_ear(ends: list[Doubles], places: Doubles, there: Bools, least: Doubles) -> Bools:
    """Tell of triangles, three times (P, 2), whether they have an area and hold no place (P, n, 2) that is there."""
    ear: Bools = _doubled_areas(*ends) > least
    x, y, inside = places[ear, :, 0], places[ear, :, 1], there[ear]
    for begin, end in zip(ends, [*ends[1:], ends[0]], strict=True):
        (x0, y0), (x1, y1) = begin[ear, :, None].swapaxes(0, 1), end[ear, :, None].swapaxes(0, 1)
        inside &= (x1 - x0) * (y - y0) >= (y1 - y0) * (x - x0)
        inside &= (x != x0) | (y != y0)
    ear[ear] = ~inside.any(axis=1)
    return ear
