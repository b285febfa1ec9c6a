"""From patches and paints to one mesh with one texture: packs the charts, paints them, joins the pieces.

Charts get rectangles of one square atlas at one common scale, so that texels are equally large all over the object,
with `GUTTER` texels of their own colour around them, so that filtering and halving the resolution do not bleed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import Mesh

from .curves import Array
from .shapes import Patch
from .textures import Paint, Texels

SIZE = 256  # texels along the atlas, where a family says nothing else
GUTTER = 2  # texels around each chart, on every side
DECIMALS = 6  # coordinates are rounded to this: machines differ in the last bits of a sine


@dataclass(frozen=True)
class Place:
    """Where a chart lies: left, bottom, width and height in texels (gutters included); turned by 90 degrees or not."""

    x: int
    y: int
    width: int
    height: int
    turned: bool


def _shelves(sizes: Sequence[tuple[float, float]], scale: float, side: int) -> list[Place] | None:
    """Pack rectangles (w, h), w >= h, on shelves of a square, tallest first; None where they do not fit."""
    cells = [(int(np.ceil(w * scale)) + 2 * GUTTER, int(np.ceil(h * scale)) + 2 * GUTTER) for w, h in sizes]
    order = sorted(range(len(cells)), key=lambda i: (-cells[i][1], -cells[i][0], i))
    places: dict[int, Place] = {}
    shelves: list[list[int]] = []  # bottom, height, filled width
    top = 0
    for i in order:
        width, height = cells[i]
        if width > side:
            return None
        shelf = next((s for s in shelves if s[2] + width <= side), None)
        if shelf is None:
            if top + height > side:
                return None
            shelf = [top, height, 0]
            shelves.append(shelf)
            top += height
        places[i] = Place(shelf[2], shelf[0], width, height, False)
        shelf[2] += width
    return [places[i] for i in range(len(cells))]


def pack(sizes: Sequence[tuple[float, float]], side: int = SIZE) -> list[Place]:
    """Return a place for every chart of size (width, height), at the largest common scale that was found to fit."""
    exact = [(round(w, DECIMALS), round(h, DECIMALS)) for w, h in sizes]
    wide = [(max(s), min(s)) for s in exact]
    low, high = 0.0, side / max(w for w, _ in wide)
    best = _shelves(wide, low, side)
    for _ in range(12):
        middle = (low + high) / 2
        places = _shelves(wide, middle, side)
        if places is None:
            high = middle
        else:
            low, best = middle, places
    if best is None:
        raise ValueError(f"{len(sizes)} charts do not fit an atlas of {side} texels; use fewer patches")
    return [replace(place, turned=h > w) for place, (w, h) in zip(best, exact, strict=True)]


def _chart(place: Place) -> tuple[Array, Array]:
    """Chart coordinates (u, v) of every texel of a place, row by row from the bottom, clamped in the gutter."""
    a = np.clip((np.arange(place.width) + 0.5 - GUTTER) / (place.width - 2 * GUTTER), 0.0, 1.0)
    b = np.clip((np.arange(place.height) + 0.5 - GUTTER) / (place.height - 2 * GUTTER), 0.0, 1.0)
    a, b = np.broadcast_to(a, (place.height, place.width)).ravel(), np.repeat(b, place.width)
    return (b, 1.0 - a) if place.turned else (a, b)


def _in_atlas(place: Place, uvs: Array, side: int) -> Array:
    """Atlas coordinates in [0, 1] of chart coordinates (V, 2)."""
    local = np.stack([1.0 - uvs[:, 1], uvs[:, 0]], axis=1) if place.turned else uvs
    inner = np.array([place.width - 2 * GUTTER, place.height - 2 * GUTTER])
    places: Array = (np.array([place.x, place.y]) + GUTTER + local * inner) / side
    return places


def painted(
    patches: Sequence[Patch], places: Sequence[Place], paints: Mapping[str, Paint], side: int = SIZE
) -> npt.NDArray[np.float32]:
    """Return the (side, side, 3) texture, display-referred sRGB, multiples of 1/255, row 0 at the top."""
    image = np.zeros((side, side, 3))
    used = np.zeros((side, side), dtype=bool)
    for patch, place in zip(patches, places, strict=True):
        u, v = _chart(place)
        color = paints[patch.tag](Texels(patch.rest(u, v), u, v, patch.size))
        area = np.s_[place.y : place.y + place.height, place.x : place.x + place.width]
        image[area] = color.reshape(place.height, place.width, 3)
        used[area] = True
    image[~used] = np.round(image[used].mean(axis=0), 2)
    levels = np.clip(np.round(image[::-1] * 255.0, 4) + 0.5, 0.5, 255.5).astype(np.uint8)
    stored: npt.NDArray[np.float32] = levels.astype(np.float32) / np.float32(255.0)
    return stored


def joined(patches: Sequence[Patch], places: Sequence[Place], side: int = SIZE) -> Mesh:
    """Return one mesh, largest extent 1, standing on z = 0 and centred, every number rounded to `DECIMALS`."""
    starts = np.cumsum([0] + [len(p.vertices) for p in patches[:-1]])
    vertices = np.concatenate([p.vertices for p in patches])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origin = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    vertices = (vertices - origin) / float((high - low).max())
    normals = np.concatenate([p.normals for p in patches])
    uvs = np.concatenate([_in_atlas(place, p.uvs, side) for p, place in zip(patches, places, strict=True)])
    faces = np.concatenate([p.faces + start for p, start in zip(patches, starts, strict=True)])
    used = np.unique(faces)  # poles leave vertices behind that no triangle needs
    renumbered = np.searchsorted(used, faces).astype(np.uint32)
    return Mesh(_exact(vertices[used]), renumbered, _exact(normals[used]), _exact(np.clip(uvs[used], 0.0, 1.0)))


def _exact(values: Array) -> npt.NDArray[np.float32]:
    """Round to `DECIMALS`, without negative zeros."""
    return (np.round(values, DECIMALS) + 0.0).astype(np.float32)
