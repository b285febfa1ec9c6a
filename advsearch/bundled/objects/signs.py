"""A stop sign as it stands at road works, on a low stand. Units are metres; it is read from +x.

The stand is low because data sets draw the box of a stop sign around its plate: on a tall post the box of all that is
there would be another one.
"""

from __future__ import annotations

import numpy as np

from advsearch.scene.assets import Material

from .curves import Array, away_from, polygon, rotation, rounded
from .draw import Draw, hexed
from .family import Instance, family
from .shapes import Patch, box, cap, lathe, placed, sweep
from .textures import Texels, mix, painter, solid, step

_STROKES = {  # letters in a cell 1 high and 0.6 wide: runs of points (x, y)
    "S": [[(0.58, 0.82), (0.48, 0.97), (0.12, 0.97), (0.02, 0.84), (0.02, 0.66), (0.12, 0.54),
           (0.48, 0.46), (0.58, 0.34), (0.58, 0.16), (0.48, 0.03), (0.12, 0.03), (0.02, 0.18)]],
    "T": [[(0.0, 0.97), (0.6, 0.97)], [(0.3, 0.97), (0.3, 0.0)]],
    "O": [[(0.02, 0.2), (0.02, 0.8), (0.14, 0.97), (0.46, 0.97), (0.58, 0.8), (0.58, 0.2), (0.46, 0.03), (0.14, 0.03),
           (0.02, 0.2)]],
    "P": [[(0.04, 0.0), (0.04, 0.97), (0.46, 0.97), (0.58, 0.85), (0.58, 0.58), (0.46, 0.46), (0.04, 0.46)]],
}  # fmt: skip


FINISHES = {
    "face": Material(roughness=0.35, clearcoat=0.4),
    "metal": Material(roughness=0.5, metallic=0.6),
    "post": Material(roughness=0.45, metallic=0.7),
    "rubber": Material(roughness=0.85),
}


def _away_from_word(x: Array, y: Array, word: str, height: float) -> Array:
    """Distance to the strokes of a word centred at (0, 0), in the unit of x and y."""
    lefts = [(k - len(word) / 2) * 0.74 * height + 0.07 * height for k in range(len(word))]
    strokes = [
        np.array(path) * height + np.array([left, -height / 2])
        for left, letter in zip(lefts, word, strict=True)
        for path in _STROKES[letter]
    ]
    return away_from(x, y, *strokes)


@painter
def _face(t: Texels, red: Array, radius: float) -> Array:
    """The word in white on red, with a white rim. Octagon of a circumradius, painted before it is raised."""
    inner = radius * np.cos(np.pi / 8)
    turns = np.pi * (np.arange(8) + 0.5) / 4 + np.pi / 8
    y, z = t.xyz[:, 1], t.xyz[:, 2]
    out = np.max([y * np.cos(a) + z * np.sin(a) for a in turns], axis=0)
    rim = step(out - 0.915 * inner, 0.0, 0.006) * step(0.985 * inner - out, 0.0, 0.006)
    letters = step(0.05 * inner - _away_from_word(y, z, "STOP", 0.52 * inner), 0.0, 0.006)
    return mix(red, hexed("f3f2ee"), np.maximum(rim, letters))


def _plate(radius: float, thick: float) -> list[Patch]:
    """An octagon that looks along +x, its middle at the origin."""
    ring = polygon(8, 0.02, 2) * radius
    front = np.stack([np.full(len(ring), thick), ring[:, 0], ring[:, 1]], axis=1)
    back = front * np.array([0.0, 1.0, 1.0])
    edge = sweep("metal", [[0.0, 0, 0], [thick, 0, 0]], ring, first=(0.0, 1.0, 0.0))
    along = np.array([1.0, 0.0, 0.0])
    return [cap("face", front, along), *edge, cap("metal", back[::-1], -along)]


@family(metres=1.0, texels=192)
def stop_sign(draw: Draw) -> Instance:
    radius, height = draw(0.45, 0.4, 0.5), draw(0.74, 0.66, 0.84)
    red = draw.colour("b3121d", "a8161f", "c0202a", wild=0.0)
    plate = placed(_plate(radius, 0.004), offset=(0.036, 0.0, height))
    tube = rounded([(0.03, 0.0), (0.03, height + 0.7 * radius), (0.0, height + 0.7 * radius + 0.004)], 0.004, 2)
    post = lathe([("post", [(0.0, 0.0), (0.03, 0.0)]), ("post", tube[:-1]), ("post", tube[-2:])], 20)
    foot = [
        *box("rubber", (0.0, 0.0, 0.03), (0.6, 0.36, 0.06), 0.02, 2),
        *box("post", (0, 0, 0.07), (0.1, 0.1, 0.05), 0.01, 1),
    ]
    heights = (height - 0.5 * radius, height + 0.5 * radius)
    clamps = [patch for z in heights for patch in box("post", (0.008, 0.0, z), (0.05, 0.09, 0.03), 0.006, 1)]
    grey = draw.colour("9a9da0", "7d8083", wild=0.0)
    paints = {"face": _face(red, radius), "metal": solid("a4a7aa"), "post": solid(grey), "rubber": solid("1d1d1f")}
    turned = placed([*plate, *post, *foot, *clamps], rotation("z", draw(0.0, -25.0, 25.0)))
    return Instance(turned, paints, FINISHES["face"], {"metal": 0.25, "post": 0.18, "rubber": 0.3}, FINISHES)
