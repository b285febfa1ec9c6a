"""Skeletons, clips and morph targets of glTF files, in the file's axes and units."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from advsearch.scene.assets import Doubles, Ints


@dataclass(frozen=True, eq=False)
class Track:
    """The keys of one property of a node in a clip."""

    node: int  # index of the node
    # "translation", "rotation" (x, y, z, w), "scale" or "weights" (of morph targets)
    path: str
    interpolation: str  # "LINEAR", "STEP" or "CUBICSPLINE"
    times: Doubles  # (K,) seconds, rising
    # (K, 1, W); of a cubic spline (K, 3, W): in-tangent, value, out-tangent.
    values: Doubles


@dataclass(frozen=True, eq=False)
class Clip:
    """An animation with at least one track."""

    name: str
    tracks: tuple[Track, ...]

    @property
    def begin(self) -> float:
        """Time of the first key, seconds."""
        return float(min(track.times[0] for track in self.tracks))

    @property
    def end(self) -> float:
        """Time of the last key, seconds."""
        return float(max(track.times[-1] for track in self.tracks))


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The nodes of a file at rest, and what moves them."""

    source: str  # name of the file, for messages
    names: tuple[str, ...]  # of the nodes, unique
    parents: Ints  # (N,) parent of each node; -1 for a root
    places: Doubles  # (N, 4, 4) matrices from each node to its parent
    # The components of these matrices.
    translations: Doubles  # (N, 3)
    rotations: Doubles  # (N, 4)
    scales: Doubles  # (N, 3)
    fixed: np.ndarray  # (N,) whether a node has a matrix and no components
    clips: tuple[Clip, ...]


@dataclass(frozen=True, eq=False)
class Target:
    """A morph target."""

    name: str
    rows: Ints  # (n,) the vertices that it moves
    moves: Doubles  # (n, 3) how far it moves them


@dataclass(frozen=True, eq=False)
class Movable:
    """A part as the file stores it, and what moves it."""

    skeleton: Skeleton  # of its file
    node: int  # index of the node that draws it
    vertices: Doubles  # (V, 3) in the coordinates of its mesh
    nodes: Ints  # (J,) nodes of the joints; its own node if it has no skin
    inverse: Doubles  # (J, 4, 4) inverse bind matrices
    joints: Ints  # (V, n) indices into `nodes`
    weights: Doubles  # (V, n) of the joints; they sum to 1
    targets: tuple[Target, ...]  # morph targets
    rest: Doubles  # (T,) their weights at rest


def with_above(parents: Sequence[int] | Ints, nodes: Collection[int]) -> set[int]:
    """Return nodes and all their ancestors.

    `parents` (N,) are the parents of all nodes, -1 for a root.
    """
    reached = set[int]()
    level = set(nodes)
    while level:
        reached |= level
        level = {int(parents[node]) for node in level} - {-1} - reached
    return reached


def entries_of_turn(x: Any, y: Any, z: Any, w: Any) -> list[Any]:
    """Return the nine entries, row by row, of the rotation of a unit quaternion.

    Its real part is `w`.
    """
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
