"""The rig of a glTF file: skins, morph targets and clips, evaluated in torch as the
format says (glTF 2.0, Khronos).

    world_n = world_parent T R S                               nodes, section 3.5
    moved   = sum_j w_j world_j inverse_bind_j (p + sum_t m_t d_t)   skins and morph targets, sections 3.7.3 and 3.7.2.2

A clip sets T, R, S or m at a time by steps, by linear interpolation (of rotations on
the sphere) or by cubic Hermite splines (section 3.11 and appendix C). A joint's own
turns come on top: about the axes of the object as it stands at rest (z up), first x,
then y, then z, carried along by the joints above it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.options import Value
from advsearch.scene.assets import Doubles, Ints
from advsearch.scene.people import PARAMETERS, about
from advsearch.scene.settings import Parameter
from advsearch.scene.skeleton import Clip, Movable, Track, entries_of_turn, with_above

AXES = ("x", "y", "z")
PERSON = PARAMETERS  # everything that a person can be asked for
WEIGHT = "weight"
_moving = partial(Parameter.moving, Parameter.GEOMETRIC)
TIME = _moving(
    "time",
    "1",
    0.0,
    1.0,
    0.0,
    "Of the clip of a rigged file: 0 is its beginning, 1 its end.",
    (0.0, 1.0),
)
# cosine of the angle between rotations beyond which arc and chord are the same
NEARLY_ONE = 1.0 - 1e-9


def part_of_a_rig(name: str) -> Parameter | None:
    """Return the parameter that `JOINT.x` (or y, z) or `TARGET.weight` means; None for
    another form.
    """
    whose, dot, what = name.rpartition(".")
    if not (whose and dot and what in (*AXES, WEIGHT)):
        return None
    if what == WEIGHT:
        return _moving(
            name, "1", 0.0, 1.0, 0.0, f"How much of the morph target {whose} there is."
        )
    return _moving(
        name, "degrees", -360.0, 360.0, 0.0, f"Turn of the joint {whose} about {what}."
    )


class SkeletonRig:
    """What moves the mesh of a glTF file, which is made of some parts: each of its
    `vertices` (V,) is the number of one among those of all parts one after the other,
    and (3, 3) `to_mesh` leads from the file's axes and unit to its.
    """

    def __init__(
        self, parts: Sequence[Movable], vertices: Ints, to_mesh: Doubles
    ) -> None:
        self.skeleton, parents = parts[0].skeleton, parts[0].skeleton.parents
        self._to_mesh = torch.from_numpy(to_mesh)
        self._upright = torch.from_numpy(to_mesh / np.cbrt(np.linalg.det(to_mesh)))
        # the parts one after the other, and what the mesh has of them
        widest = max(part.joints.shape[1] for part in parts)
        counts = [len(part.vertices) for part in parts]
        starts = np.cumsum([0, *counts])
        slots = np.cumsum([0, *(len(part.nodes) for part in parts)])

        def wide(values: np.ndarray) -> np.ndarray:
            return np.pad(values, ((0, 0), (0, widest - values.shape[1])))

        self._points = torch.from_numpy(
            np.concatenate([part.vertices for part in parts])[vertices]
        )
        joints = np.concatenate(
            [wide(part.joints + slot) for part, slot in zip(parts, slots, strict=False)]
        )
        self._joints = torch.from_numpy(joints[vertices])
        self._weights = torch.from_numpy(
            np.concatenate([wide(part.weights) for part in parts])[vertices]
        )
        self._nodes = torch.from_numpy(np.concatenate([part.nodes for part in parts]))
        self._inverse = torch.from_numpy(
            np.concatenate([part.inverse for part in parts])
        )
        self._targets: list[tuple[str, int, int, float, Tensor, Tensor]] = []
        for part, start, count in zip(parts, starts, counts, strict=False):
            mine = np.flatnonzero((vertices >= start) & (vertices < start + count))
            for number, target in enumerate(part.targets):
                place = np.full(count, -1)
                place[target.rows] = np.arange(len(target.rows))
                rows = place[vertices[mine] - start]
                hit = rows >= 0
                moves = torch.from_numpy(target.moves[rows[hit]])
                rest = float(part.rest[number])
                self._targets.append(
                    (
                        target.name,
                        part.node,
                        number,
                        rest,
                        torch.from_numpy(mine[hit]),
                        moves,
                    )
                )
        # the nodes by their depth, so that all of one depth are placed at once
        level = np.flatnonzero(parents < 0)
        self._levels = list[tuple[Tensor, Tensor]]()
        row = np.zeros(len(parents), np.int64)
        while len(level):
            self._levels.append(
                (torch.from_numpy(level), torch.from_numpy(row[parents[level]]))
            )
            row[level] = np.arange(len(level))
            level = np.flatnonzero(np.isin(parents, level))
        self._back = torch.argsort(torch.cat([nodes for nodes, _ in self._levels]))
        self._places = torch.from_numpy(self.skeleton.places)
        # the nearest rotation to each node's place in the scene: what scale and shear
        # leave of its axes
        left, _, right = np.linalg.svd(self._world(self._places)[:, :3, :3].numpy())
        self._axes = torch.from_numpy(left @ right)
        self._rest = self.posed({})

    # ---- what can be asked for
    # ---------------------------------------------------------------------------------------

    @property
    def clips(self) -> tuple[str, ...]:
        return tuple(clip.name for clip in self.skeleton.clips)

    @cached_property
    def joints(self) -> dict[str, int]:
        """The nodes that move something, by name."""
        moving = with_above(self.skeleton.parents, [int(node) for node in self._nodes])
        return {self.skeleton.names[node]: node for node in sorted(moving)}

    @property
    def targets(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for name, *_ in self._targets))

    @property
    def defaults(self) -> Mapping[str, float]:
        time = {TIME.name: 0.0} if self.clips else {}
        turns = {f"{name}.{axis}": 0.0 for name in self.joints for axis in AXES}
        return (
            time
            | turns
            | {
                f"{name}.{WEIGHT}": rest
                for name, _, _, rest, _, _ in reversed(self._targets)
            }
        )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        named = (
            TIME if name == TIME.name else part_of_a_rig(name) for name in self.defaults
        )
        return tuple(parameter for parameter in named if parameter is not None)

    def measured(
        self, values: Mapping[str, Tensor], clip: str | None = None
    ) -> Mapping[str, Value]:
        if clip is None:
            return {}
        return {
            "seconds": {"value": float(self._playing(clip, values)[1]), "unit": "s"}
        }

    # ---- where the vertices are
    # --------------------------------------------------------------------------------------

    def offsets(self, values: Mapping[str, Tensor], clip: str | None = None) -> Tensor:
        """Return how far each vertex goes from the mesh at rest, (V, 3) float32 in its
        unit; differentiable. Numbers, by the names of `parameters`, are those of the
        clip of that name, and else at rest, where one is missing. Raises InputError: a
        vertex is nowhere, because the file's numbers are too large.
        """
        posed = self.posed(values, clip)
        moved = (posed - self._rest.to(posed.device)) @ self._to_mesh.to(posed.device).T
        if not bool(torch.isfinite(moved.detach()).all()):
            what = f"the clip {clip}" if clip else "such turns"
            raise InputError(
                f"{self.skeleton.source}: {what} would put vertices "
                "infinitely far away; take another"
            )
        return moved.float()

    def posed(self, values: Mapping[str, Tensor], clip: str | None = None) -> Tensor:
        """Return the vertices (V, 3) in the file's axes and unit, float64; arguments as
        of `offsets`.
        """
        some = next(iter(values.values()), torch.zeros(()))
        number = {name: value.double() for name, value in values.items()}
        here = self._places.to(some.device)
        weights = dict[int, Tensor]()
        if clip is not None:
            playing, seconds = self._playing(clip, number)
            here, weights = self._played(playing, seconds.to(some.device))
        here = self._turned(here, number)
        matrices = (
            self._world(here)[self._nodes.to(some.device)]
            @ self._inverse.to(some.device)
        )[:, :3]
        points = self._points.to(some.device)
        shares = self._weights.to(some.device)
        for name, node, index, rest, rows, shifts in self._targets:
            weight = number.get(f"{name}.{WEIGHT}")
            if weight is None:
                weight = (
                    weights[node][index]
                    if node in weights
                    else torch.tensor(rest, dtype=torch.float64)
                )
            if weight.requires_grad or float(weight) != 0.0:
                points = points.index_add(
                    0,
                    rows.to(some.device),
                    weight.to(some.device) * shifts.to(some.device),
                )
        joints = self._joints.to(some.device)
        moves = sum(
            shares[:, k, None, None] * matrices[joints[:, k]]
            for k in range(joints.shape[1])
        )
        assert isinstance(moves, Tensor)
        return torch.einsum("vij,vj->vi", moves[:, :, :3], points) + moves[:, :, 3]

    def _playing(self, name: str, values: Mapping[str, Tensor]) -> tuple[Clip, Tensor]:
        clip = next(clip for clip in self.skeleton.clips if clip.name == name)
        return clip, clip.begin + (clip.end - clip.begin) * values.get(
            TIME.name, torch.zeros(())
        ).double()

    def _played(self, clip: Clip, seconds: Tensor) -> tuple[Tensor, dict[int, Tensor]]:
        """Places (N, 4, 4) of all nodes at a time of a clip, and weights of morph
        targets by node.
        """
        skeleton = self.skeleton
        device = seconds.device
        rest = {
            "translation": skeleton.translations,
            "rotation": skeleton.rotations,
            "scale": skeleton.scales,
        }
        parts = {
            path: torch.from_numpy(values).to(device) for path, values in rest.items()
        }
        for path in rest:
            mine = [track for track in clip.tracks if track.path == path]
            if mine:
                nodes = torch.tensor([track.node for track in mine], device=device)
                parts[path] = parts[path].index_copy(
                    0, nodes, torch.stack([sampled(track, seconds) for track in mine])
                )
        turns = rotation(parts["rotation"]) * parts["scale"][:, None, :]
        last = torch.tensor(
            [0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=device
        ).expand(len(turns), 1, 4)
        composed = torch.cat(
            [torch.cat([turns, parts["translation"][:, :, None]], dim=2), last], dim=1
        )
        fixed = torch.from_numpy(skeleton.fixed).to(device)
        places = torch.where(fixed[:, None, None], self._places.to(device), composed)
        return places, {
            track.node: sampled(track, seconds)
            for track in clip.tracks
            if track.path == "weights"
        }

    def _turned(self, places: Tensor, number: Mapping[str, Tensor]) -> Tensor:
        upright = self._upright.to(places.device)
        for joint in dict.fromkeys(
            name.rpartition(".")[0]
            for name in number
            if name.rpartition(".")[2] in AXES
        ):
            node = self.joints[joint]
            turn = torch.eye(3, dtype=torch.float64, device=places.device)
            for axis in AXES:
                if f"{joint}.{axis}" in number:
                    turn = about(axis, number[f"{joint}.{axis}"]) @ turn
            turn = upright.T @ turn @ upright
            parent = int(self.skeleton.parents[node])
            if parent >= 0:
                axes = self._axes[parent].to(places.device)
                turn = axes.T @ turn @ axes
            row = torch.cat(
                [
                    torch.cat(
                        [turn @ places[node, :3, :3], places[node, :3, 3:]], dim=1
                    ),
                    places[node, 3:],
                ]
            )
            places = places.index_copy(
                0, torch.tensor([node], device=places.device), row[None]
            )
        return places

    def _world(self, places: Tensor) -> Tensor:
        levels = list[Tensor]()
        for level, parents in self._levels:
            here = places[level.to(places.device)]
            levels.append(
                levels[-1][parents.to(places.device)] @ here if levels else here
            )
        return torch.cat(levels)[self._back.to(places.device)]


def sampled(track: Track, seconds: Tensor) -> Tensor:
    """Return the value (W,) of a track at a time; before its first key and after its
    last it stays (appendix C).
    """
    times = torch.from_numpy(track.times).to(seconds.device)
    values = torch.from_numpy(track.values).to(seconds.device)
    middle = values.shape[1] // 2
    after = int(torch.searchsorted(times, seconds.detach(), right=True))
    if track.interpolation == "STEP" or not 0 < after < len(times):
        held = values[max(0, after - 1), middle]
        return held / held.norm() if track.path == "rotation" else held
    before = after - 1
    span = times[after] - times[after - 1]
    share = (seconds - times[before]) / span
    first = values[before, middle]
    second = values[after, middle]
    if track.interpolation == "CUBICSPLINE":
        square = share**2
        cube = share**3
        spline = (
            (2.0 * cube - 3.0 * square + 1.0) * first
            + span * (cube - 2.0 * square + share) * values[before, 2]
            + (3.0 * square - 2.0 * cube) * second
            + span * (cube - square) * values[after, 0]
        )
        return (
            spline / spline.norm().clamp_min(1e-12)
            if track.path == "rotation"
            else spline
        )
    return (
        slerp(first, second, share)
        if track.path == "rotation"
        else first + share * (second - first)
    )


def slerp(first: Tensor, second: Tensor, share: Tensor) -> Tensor:
    """Return the rotation (4,) between two, along the shorter arc."""
    first = first / first.norm()
    second = second / second.norm()
    cosine = first @ second
    second = torch.where(cosine < 0.0, -second, second)
    cosine = cosine.abs()
    if float(cosine) > NEARLY_ONE:
        chord: Tensor = first + share * (second - first)
        return chord.div(chord.norm())
    angle = torch.arccos(cosine)
    arc: Tensor = (
        torch.sin((1.0 - share) * angle) * first + torch.sin(share * angle) * second
    )
    return arc / torch.sin(angle)


def rotation(quaternions: Tensor) -> Tensor:
    """Return the turns (N, 3, 3) of unit quaternions (N, 4), x, y, z, w."""
    return torch.stack(entries_of_turn(*quaternions.unbind(dim=1)), dim=1).reshape(
        -1, 3, 3
    )
