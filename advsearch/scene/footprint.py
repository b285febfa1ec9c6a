"""What things take up: outlines on the ground, from a height to another one."""

from __future__ import annotations

from typing import NamedTuple

from advsearch.scene.assets import Float64Array


class Footprint(NamedTuple):
    """A convex outline on the ground, corners (K, 2), and a range of heights."""

    outline: Float64Array
    lower: float
    upper: float


class Solid(NamedTuple):
    """What nothing else can be in, and what it is called in a sentence: "a house"."""

    name: str
    footprint: Footprint
