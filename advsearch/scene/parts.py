"""What controls may put into a scene beside the object and its environment: meshes, lights, a medium.

A part says which Mitsuba plugins it adds and which scene inputs they take. An input is a torch tensor under a name of
ours; `MitsubaScene` writes it into Mitsuba's parameters, and reads its gradient back where the adjoint is valid.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import Floats, Material, Mesh

Write = Callable[[Any], Any]
"""From a Dr.Jit `TensorXf` (perhaps with gradients enabled) to the type that the Mitsuba parameter takes."""


def as_is(value: Any) -> Any:
    """Textures, grids: Mitsuba takes the tensor itself."""
    return value


def flat(value: Any) -> Any:
    """Vertex buffers: Mitsuba takes a flat array."""
    return value.array


def number(value: Any) -> Any:
    """A single number."""
    from advsearch.scene.mitsuba_backend.variant import mitsuba

    return mitsuba().Float(value.array)


def color(value: Any) -> Any:
    """Three numbers: an RGB colour."""
    from advsearch.scene.mitsuba_backend.variant import mitsuba

    mi = mitsuba()
    import drjit as dr

    return mi.Color3f(*(dr.gather(mi.Float, value.array, mi.UInt32(channel)) for channel in range(3)))


def point(value: Any) -> Any:
    """Three numbers: a place."""
    from advsearch.scene.mitsuba_backend.variant import mitsuba

    mi = mitsuba()
    import drjit as dr

    return mi.Point3f(*(dr.gather(mi.Float, value.array, mi.UInt32(axis)) for axis in range(3)))


def transform(value: Any) -> Any:
    """A 4 x 4 matrix, row by row."""
    from advsearch.scene.mitsuba_backend.variant import mitsuba

    mi = mitsuba()
    import drjit as dr

    rows = [[dr.gather(mi.Float, value.array, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(4)]
    return mi.Transform4f(mi.Matrix4f(rows))


@dataclass(frozen=True)
class PartInput:
    """One input of a part.

    Attributes:
        name: the input's name, e.g. "key.position".
        key: Mitsuba's parameter path, or its beginning and end with one "*" between for an unknown middle.
        write: converts the tensor.
        interior: the interior adjoint (`prb`) differentiates it correctly.
        shape: of the tensor; None takes it from Mitsuba's own value.
    """

    name: str
    key: str
    write: Write = as_is
    interior: bool = False
    shape: tuple[int, ...] | None = None


class Part(ABC):
    """Something in a scene.

    Attributes:
        name: unique in the scene; begins the names of its inputs and plugins.
        volumetric: needs an integrator that handles media.
        dark: is a lamp that emits nothing, whatever its inputs are.
    """

    name: str
    volumetric: bool = False
    dark: bool = False

    @abstractmethod
    def plugins(self) -> dict[str, Any]:
        """Return entries of Mitsuba's scene dictionary (plugin dictionaries or objects) by name. A name that the
        scene has already ("environment") is replaced."""

    @abstractmethod
    def inputs(self) -> tuple[PartInput, ...]:
        """Return what may be set; the base value of each is whatever `plugins` made."""

    def sensor(self) -> dict[str, Any]:
        """Return entries to add to the sensor's dictionary (the medium that the camera is in)."""
        return {}

    def integrator(self, plugins: Mapping[str, Any]) -> dict[str, Any]:
        """Return entries that replace those of the path integrator's dictionary (another type, for a medium).

        Args:
            plugins: the scene's dictionary, complete.
        """
        return {}


@dataclass(frozen=True, eq=False)
class MeshPart(Part):
    """A mesh with a principled surface and a base-colour texture.

    Takes `NAME.vertices` and `NAME.normals` (V, 3) in world space, `NAME.base_color` (h, w, 3) linear reflectance with
    row 0 at v = 1, and `NAME.roughness`, `.metallic`, `.specular`, `.clearcoat` (1,) in [0, 1]. `NAME.to_world` (4, 4)
    and `NAME.offsets` (V, 3) are turned into vertices and normals by `advsearch.scene.assembly`.

    Attributes:
        name: "object" for the object itself.
        mesh: geometry in its own coordinates.
        to_world: (4, 4) its base pose.
        base_color: (h, w, 3) float32 display-referred sRGB.
        material: the rest of the surface.
        extra: further entries of the principled plugin's dictionary (e.g. {"spec_trans": 0.9}).
    """

    name: str
    mesh: Mesh
    to_world: npt.NDArray[np.float64]
    base_color: Floats
    material: Material = field(default_factory=Material)
    extra: dict[str, Any] = field(default_factory=dict)

    def plugins(self) -> dict[str, Any]:
        from advsearch.scene.mitsuba_backend.plugins import mitsuba_mesh, principled

        surface = principled(self.base_color, self.material, self.extra)
        return {self.name: mitsuba_mesh(self.name, self.mesh, self.to_world, surface)}

    def inputs(self) -> tuple[PartInput, ...]:
        name, count = self.name, len(self.mesh.vertices)
        found = [
            PartInput(f"{name}.vertices", f"{name}.vertex_positions", flat, shape=(count, 3)),
            PartInput(f"{name}.normals", f"{name}.vertex_normals", flat, shape=(count, 3)),
            PartInput(f"{name}.base_color", f"{name}.*.base_color.data", interior=True),
            PartInput(f"{name}.roughness", f"{name}.*.roughness.value", number, True, (1,)),
            PartInput(f"{name}.metallic", f"{name}.*.metallic.value", number, True, (1,)),
            PartInput(f"{name}.specular", f"{name}.*.specular", number, True, (1,)),
            PartInput(f"{name}.clearcoat", f"{name}.*.clearcoat.value", number, True, (1,)),
        ]
        return tuple(found)
