"""What moves in a glTF file, as plain arrays in its own axes and units: nodes, clips,
and what hangs on the nodes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from advsearch.scene.assets import Doubles, Ints


@dataclass(frozen=True, eq=False)
class Track:
    """What a clip makes of one property of a node."""

    node: int  # number of the node
    # "translation", "rotation" (x, y, z, w), "scale" or "weights" (of morph targets)
    path: str
    interpolation: str  # "LINEAR", "STEP" or "CUBICSPLINE"
    times: Doubles  # (K,) seconds that rise
    # (K, 1, W); of a cubic spline (K, 3, W): the tangent before, the value, the tangent
    # after
    values: Doubles


@dataclass(frozen=True, eq=False)
class Clip:
    """An animation: its name, and its tracks, at least one."""

    name: str
    tracks: tuple[Track, ...]

    @property
    def begin(self) -> float:
        return float(min(track.times[0] for track in self.tracks))

    @property
    def end(self) -> float:
        return float(max(track.times[-1] for track in self.tracks))


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The nodes of a file at rest, and what moves them."""

    source: str  # name of the file, for messages
    names: tuple[str, ...]  # of the nodes, all different
    parents: Ints  # (N,) their numbers; -1 of a root
    places: Doubles  # (N, 4, 4) from each node to its parent
    translations: Doubles  # (N, 3), of which, with the two below, `places` is made
    rotations: Doubles  # (N, 4)
    scales: Doubles  # (N, 3)
    fixed: np.ndarray  # (N,) whether `places` is a matrix instead
    clips: tuple[Clip, ...]


@dataclass(frozen=True, eq=False)
class Target:
    """A morph target: its name, the numbers (n,) of the vertices that it moves, and how
    far it moves them, (n, 3).
    """

    name: str
    rows: Ints
    moves: Doubles


@dataclass(frozen=True, eq=False)
class Movable:
    """A part as it is stored, and what moves it."""

    skeleton: Skeleton  # of its file
    node: int  # number of the node that draws it
    vertices: Doubles  # (V, 3) in the coordinates of its mesh
    nodes: Ints  # (J,) numbers of the joints; where no skin moves it, its own node
    inverse: Doubles  # (J, 4, 4) inverse bind matrices
    joints: Ints  # (V, n) indices into `nodes`
    weights: Doubles  # (V, n) of each; they add up to 1
    targets: tuple[Target, ...]  # morph targets
    rest: Doubles  # (T,) their weights at rest


def with_above(parents: Sequence[int] | Ints, nodes: Collection[int]) -> set[int]:
    """Return nodes, and all on which they hang; `parents` are (N,) their numbers, -1 of
    a root.
    """
    reached = set[int]()
    level = set(nodes)
    while level:
        reached |= level
        level = {int(parents[node]) for node in level} - {-1} - reached
    return reached


def entries_of_turn(x: Any, y: Any, z: Any, w: Any) -> list[Any]:
    """Return the nine entries, row by row, of the rotation of a unit quaternion with
    real part `w`.
    """
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
