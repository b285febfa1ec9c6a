"""Skeletons, clips and morph targets of glTF files, in the file's axes and units."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from advsearch.scene.assets import Float64Array, IntArray


@dataclass(frozen=True, eq=False)
class Track:
    """The keys of one property of a node in a clip."""

    node: int  # index of the node
    # "translation", "rotation" (x, y, z, w), "scale" or "weights" (of morph targets)
    path: str
    interpolation: str  # "LINEAR", "STEP" or "CUBICSPLINE"
    times: Float64Array  # (K,) seconds, rising
    # (K, 1, W); of a cubic spline (K, 3, W): in-tangent, value, out-tangent.
    values: Float64Array


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
    names: tuple[str, ...]  # names of the nodes, unique
    parents: IntArray  # (N,) parent of each node; -1 for a root
    local_matrices: Float64Array  # (N, 4, 4) matrices from each node to its parent
    # The components of these matrices.
    translations: Float64Array  # (N, 3)
    rotations: Float64Array  # (N, 4)
    scales: Float64Array  # (N, 3)
    has_matrix: np.ndarray  # (N,) whether a node has a matrix and no components
    clips: tuple[Clip, ...]


@dataclass(frozen=True, eq=False)
class MorphTarget:
    """A morph target."""

    name: str
    rows: IntArray  # (n,) the vertices that it moves
    offsets: Float64Array  # (n, 3) how far it moves them


@dataclass(frozen=True, eq=False)
class Movable:
    """A part as the file stores it, and what moves it."""

    skeleton: Skeleton  # skeleton of its file
    node: int  # index of the node that draws it
    vertices: Float64Array  # (V, 3) in the coordinates of its mesh
    joint_nodes: IntArray  # (J,) nodes of the joints; its own node if it has no skin
    inverse_binds: Float64Array  # (J, 4, 4) inverse bind matrices
    joints: IntArray  # (V, n) indices into `joint_nodes`
    weights: Float64Array  # (V, n) of the joints; they sum to 1
    targets: tuple[MorphTarget, ...]  # morph targets
    rest_weights: Float64Array  # (T,) their weights at rest


def with_ancestors(
    parents: Sequence[int] | IntArray, nodes: Collection[int]
) -> set[int]:
    """Return nodes and all their ancestors.

    `parents` (N,) are the parents of all nodes, -1 for a root. The ancestors are found
    level by level; one that was reached already is not followed again.
    """
    reached = set[int]()
    level = set(nodes)
    while level:
        reached |= level
        level = {int(parents[node]) for node in level} - {-1} - reached
    return reached


def compute_rotation_entries(x: Any, y: Any, z: Any, w: Any) -> list[Any]:
    """Return the nine entries, row by row, of the rotation of a unit quaternion.

    Its real part is `w`. The components are numbers, or arrays or tensors of one shape,
    which the entries then have.
    """
    first_row = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    second_row = [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    third_row = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return [*first_row, *second_row, *third_row]
