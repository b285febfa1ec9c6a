"""The `geometry` control: a smooth change of the object's shape, at most so far.

    modes          d = sum_k a_k m_k,  a = 2 u - 1             m_k: the smoothest displacement fields of the mesh
    large-steps    d = g R (I + lambda L)^-2 (2 u - 1)         a push for each vertex, spread out over its surroundings
    offsets        epsilon s(d) d                              s: one factor that keeps the mesh whole

u = 0.5 leaves the shape as it is. See `geometry_modes` for the fields, for `s`, and where they come
from. No vertex moves by more than epsilon, no face turns over and no wall meets the other, for any u.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import NOTHING, BoundControl, Choice, Control, Group, Parameter, Value
from advsearch.controls.geometry_modes import Limits, Preconditioner, body, shape_modes
from advsearch.scene.assembly import MovingMesh
from advsearch.scene.assets import Mesh
from advsearch.scene.description import SceneDescription

FORMS = ("modes", "large-steps")
DEFAULT_EPSILON = 0.03
LARGEST_EPSILON = 0.5
DEFAULT_MODES = 24
LARGEST_MODES = 200
PUSH = 4.0
"""Factor on the pushes of form large-steps: pushes at their largest over a neighbourhood pass the bound on the length
of d, so that it is reached without every vertex of the object agreeing."""
ESTIMATORS = ("material", "differences")


@dataclass(frozen=True)
class GeometryControl(Control):
    """A smooth change of the object's shape, at most so far.

    Attributes:
        epsilon: largest displacement of a vertex in object sizes, over 0 to 0.5.
        modes: number of modes, 1 to 200.
        form: "modes" or "large-steps"; None takes modes.
        amplitudes: stands for form "modes" when `geometry.amplitudes` is asked for; its range cannot be set.
        pushes: likewise, for form "large-steps".
        name: the instance's name.
    """

    epsilon: float = DEFAULT_EPSILON
    modes: int = DEFAULT_MODES
    form: str | None = None
    amplitudes: object = None
    pushes: object = None
    name: str = "geometry"

    kind: ClassVar[str] = "geometry"
    of_a_mesh: ClassVar[bool] = True
    summary: ClassVar[str] = "A smooth change of the object's shape, at most so far."
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "amplitudes", (None,), "1", -1.0, 1.0, 0.0,
            "How much of each smooth mode of the shape is added (form modes).", moves_silhouettes=True,
            search=(-1.0, 1.0), estimators=ESTIMATORS,
        ),
        Parameter(
            "pushes", (None, 3), "1", -1.0, 1.0, 0.0, "Push on each vertex before it is spread out (form large-steps).",
            moves_silhouettes=True, search=(-1.0, 1.0), estimators=ESTIMATORS,
        ),
    )  # fmt: skip
    choices: ClassVar[tuple[Choice, ...]] = (
        Choice(
            "epsilon", DEFAULT_EPSILON, "Largest displacement of a vertex, in object sizes.", "epsilon",
            most=LARGEST_EPSILON,
        ),
        Choice("modes", DEFAULT_MODES, "Number of smooth modes (form modes).", whole=(1, LARGEST_MODES)),
        Choice("form", "modes", "What is searched: modes (a few smooth fields) or large-steps (every vertex)."),
    )  # fmt: skip

    def __post_init__(self) -> None:
        for choice in self.choices:
            choice.check(self.name, getattr(self, choice.name))
        object.__setattr__(self, "form", self.chosen_form(FORMS, self.form))

    def bind(self, scene: SceneDescription) -> BoundControl:
        mesh = self.mesh_in(scene).mesh
        shaper: Shaper = Moded(mesh, int(self.modes)) if self.form == "modes" else Pushed(mesh)
        return BoundGeometry(self.name, self.mesh, mesh, shaper, float(self.epsilon))


class Shaper(ABC):
    """One form of the control: a map from its slice of u to a field of displacements.

    Attributes:
        group: the slice as a group.
    """

    group: Group

    @abstractmethod
    def field(self, u: Tensor) -> Tensor:
        """Map (d,) in [0, 1] to (P, 3) float64, before it is held inside its limits; zero at 0.5; differentiable."""


class Moded(Shaper):
    """A sum of smooth modes."""

    def __init__(self, mesh: Mesh, count: int) -> None:
        self._modes = torch.from_numpy(shape_modes(mesh, count))
        self.group = Group("amplitudes", self._modes.shape[2], ESTIMATORS)

    def field(self, u: Tensor) -> Tensor:
        return self._modes.to(u.device) @ (2.0 * u.double() - 1.0)


class Pushed(Shaper):
    """A push for each vertex, spread out."""

    def __init__(self, mesh: Mesh) -> None:
        solid = body(mesh)
        self._spread = Preconditioner(solid)
        self._count = len(solid.places)
        self.group = Group("pushes", 3 * self._count, ESTIMATORS)

    def field(self, u: Tensor) -> Tensor:
        return PUSH * self._spread((2.0 * u.double() - 1.0).reshape(self._count, 3))


class BoundGeometry(BoundControl):
    """The shape of one mesh.

    Args:
        name: the instance's name.
        on: name of the mesh.
        mesh: its geometry.
        shaper: maps u to a field of displacements.
        epsilon: largest displacement, in the mesh's units.
    """

    def __init__(self, name: str, on: str, mesh: Mesh, shaper: Shaper, epsilon: float) -> None:
        self.name = name
        self._offsets = f"{on}.offsets"
        self._mesh, self._shaper = mesh, shaper
        solid = body(mesh)
        self._index = torch.from_numpy(solid.index)
        self._limits = Limits(solid, epsilon)
        self.groups = (shaper.group,)
        self.start = torch.full((shaper.group.size,), 0.5)

    def inputs(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        return {self._offsets: self.offsets(u).index_select(0, self._index.to(u.device)).float()}

    def offsets(self, u: Tensor) -> Tensor:
        """Displacement of each place, (P, 3) float64."""
        return self._limits.held(self._shaper.field(u))

    def describe(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Value]:
        offsets = self.offsets(u.detach())
        lengths = offsets.norm(dim=1)
        return {
            f"{self.name}.largest": {"value": float(lengths.max()), "unit": "object sizes"},
            f"{self.name}.rms": {"value": float(lengths.square().mean().sqrt()), "unit": "object sizes"},
            f"{self.name}.thinnest": {"value": self._limits.thinnest(offsets), "unit": "1"},
        }

    def files(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, bytes]:
        moving = MovingMesh(self._mesh, np.eye(4))
        vertices, normals = moving.place(None, self.inputs(u.detach())[self._offsets])
        return {f"{self.name}.obj": obj_bytes(vertices, normals, self._mesh)}


def obj_bytes(vertices: Tensor, normals: Tensor, mesh: Mesh) -> bytes:
    """Return a mesh as a Wavefront OBJ file, z up, with the texture coordinates and faces of another.

    Args:
        vertices: (V, 3).
        normals: (V, 3).
        mesh: with V vertices.
    """
    lines = ["# advsearch: z is up; texture coordinates as of the original object"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices.tolist()]
    lines += [f"vt {u:.7g} {v:.7g}" for u, v in mesh.uvs.tolist()]
    lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in normals.tolist()]
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (mesh.faces.astype(np.int64) + 1).tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")
