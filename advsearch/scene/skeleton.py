"""What moves in a glTF file, as plain arrays in its own axes and units: nodes, clips, and what hangs on the nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from advsearch.scene.assets import Doubles, Ints


@dataclass(frozen=True, eq=False)
class Track:
    """What a clip makes of one property of a node.

    Attributes:
        node: number of the node.
        path: "translation", "rotation" (x, y, z, w), "scale" or "weights" (of morph targets).
        interpolation: "LINEAR", "STEP" or "CUBICSPLINE".
        times: (K,) seconds that rise.
        values: (K, 1, W); of a cubic spline (K, 3, W): the tangent before, the value, the tangent after.
    """

    node: int
    path: str
    interpolation: str
    times: Doubles
    values: Doubles


@dataclass(frozen=True, eq=False)
class Clip:
    """An animation: its name, and its tracks, at least one."""

    name: str
    tracks: tuple[Track, ...]

    @property
    def begin(self) -> float:
        """Seconds of the first key."""
        return float(min(one.times[0] for one in self.tracks))

    @property
    def end(self) -> float:
        """Seconds of the last one."""
        return float(max(one.times[-1] for one in self.tracks))


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The nodes of a file at rest, and what moves them.

    Attributes:
        source: name of the file, for messages.
        names: of the nodes, all different.
        parents: (N,) their numbers; -1 of a root.
        places: (N, 4, 4) from each node to its parent.
        translations, rotations, scales: (N, 3), (N, 4) and (N, 3) of which `places` is made.
        fixed: (N,) whether `places` is a matrix instead.
        clips: animations.
    """

    source: str
    names: tuple[str, ...]
    parents: Ints
    places: Doubles
    translations: Doubles
    rotations: Doubles
    scales: Doubles
    fixed: np.ndarray
    clips: tuple[Clip, ...]


@dataclass(frozen=True, eq=False)
class Target:
    """A morph target: its name, the numbers (n,) of the vertices that it moves, and how far it moves them, (n, 3)."""

    name: str
    rows: Ints
    moves: Doubles


@dataclass(frozen=True, eq=False)
class Movable:
    """A part as it is stored, and what moves it.

    Attributes:
        skeleton: of its file.
        node: number of the node that draws it.
        vertices: (V, 3) in the coordinates of its mesh.
        nodes: (J,) numbers of the joints; where no skin moves it, its own node.
        inverse: (J, 4, 4) inverse bind matrices.
        joints: (V, n) indices into `nodes`.
        weights: (V, n) of each; they add up to 1.
        targets: morph targets.
        rest: (T,) their weights at rest.
    """

    skeleton: Skeleton
    node: int
    vertices: Doubles
    nodes: Ints
    inverse: Doubles
    joints: Ints
    weights: Doubles
    targets: tuple[Target, ...]
    rest: Doubles


def entries_of_turn(x: Any, y: Any, z: Any, w: Any) -> list[Any]:
    """Return the nine entries, row by row, of the rotation matrix of a unit quaternion with the real part `w`: numbers,
    arrays or tensors."""
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
