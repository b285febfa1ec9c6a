"""Dictionaries of Mitsuba's plugins between plain data and what its loader takes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from advsearch.scene.mitsuba_backend.variant import Plugin, mitsuba


def loadable(plugin: Mapping[str, object]) -> Plugin:
    """Return a dictionary with Mitsuba's transforms for arrays (4, 4) and (3, 3), and its bitmaps for pictures
    (H, W, C)."""
    mi = mitsuba()

    def made(value: object) -> object:
        if isinstance(value, Mapping):
            return loadable(value)
        if isinstance(value, np.ndarray):
            transform = {(4, 4): mi.ScalarTransform4f, (3, 3): mi.ScalarTransform3f}.get(value.shape)
            return transform(value) if transform else mi.Bitmap(np.ascontiguousarray(value, dtype=np.float32))
        return value

    return {key: made(value) for key, value in plugin.items()}


def plain(plugin: Mapping[str, object]) -> Plugin:
    """Return a dictionary with arrays (4, 4), of texture coordinates (3, 3), for Mitsuba's transforms."""

    def made(value: object) -> object:
        if isinstance(value, Mapping):
            return plain(value)
        matrix = getattr(value, "matrix", None)
        if matrix is None:
            return value
        side = len(matrix)
        return np.array(matrix, dtype=np.float64).reshape(side, side)

    return {key: made(value) for key, value in plugin.items()}
