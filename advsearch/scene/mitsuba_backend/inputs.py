"""Scene inputs inside Mitsuba: the parameter path that each of our names means, and the type that it takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.variant import mitsuba

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
    return mitsuba().Float(value.array)


def plain_number(value: Any) -> float:
    """A single number that is the same for all light paths."""
    return float(value.array[0])


def color(value: Any) -> Any:
    """Three numbers: an RGB colour."""
    return mitsuba().Color3f(*_entries(value, 3))


def point(value: Any) -> Any:
    """Three numbers: a place."""
    return mitsuba().Point3f(*_entries(value, 3))


def transform(value: Any) -> Any:
    """A 4 x 4 matrix, row by row."""
    mi, found = mitsuba(), _entries(value, 16)
    return mi.Transform4f(mi.Matrix4f([found[4 * row : 4 * row + 4] for row in range(4)]))


def contiguous(tensor: Tensor) -> Tensor:
    """Return what Dr.Jit takes of a tensor: float32 in one piece, without a graph."""
    return tensor.detach().to(torch.float32).contiguous()


def as_torch(value: Any) -> Tensor:
    """Return a Dr.Jit value as a torch tensor with memory of its own."""
    mi = mitsuba()
    if isinstance(value, (mi.Color3f, mi.Point3f)):  # Dr.Jit's own conversion gives a colour six entries
        return torch.cat([as_torch(component) for component in value])
    value = getattr(value, "matrix", value)
    if hasattr(value, "torch"):
        tensor: Tensor = value.torch()
        return tensor.clone()
    return torch.tensor(np.array(value, dtype=np.float32))


def _entries(value: Any, count: int) -> list[Any]:
    mi = mitsuba()
    import drjit as dr

    return [dr.gather(mi.Float, value.array, mi.UInt32(entry)) for entry in range(count)]


@dataclass(frozen=True)
class SceneInput:
    """One named input of a scene.

    Attributes:
        name: the input's name, e.g. "key.position".
        key: Mitsuba's parameter path, or its beginning and end with one "*" between for an unknown middle.
        write: converts the tensor.
        interior: the interior adjoint (`prb`) differentiates it correctly.
        shape: of the tensor; None takes it from Mitsuba's own value.
        owner: Mitsuba's object that has the parameter, where `key` alone may mean several.
    """

    name: str
    key: str
    write: Write = as_is
    interior: bool = False
    shape: tuple[int, ...] | None = None
    owner: Any = None


def key_of(parameters: Any, one: SceneInput) -> str | None:
    """Return the parameter that an input means, or None if the scene has none such.

    Raises:
        RuntimeError: there are several.
    """
    before, star, after = one.key.partition("*")
    found = [
        key
        for key in parameters.keys()
        if (key.startswith(before) and key.endswith(after) if star else key == one.key)
        and (one.owner is None or parameters.properties[key][2] is one.owner)
    ]
    if len(found) > 1:
        raise RuntimeError(f"expected one Mitsuba parameter {one.key}, found {found}")
    return str(found[0]) if found else None
