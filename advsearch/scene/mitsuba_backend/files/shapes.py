"""Shapes of a Mitsuba scene as triangles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import InputError
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.importing.imported_part import ImportedPart
from advsearch.scene.importing.parts import read_parts
from advsearch.scene.importing.surfaces import ImportedSurface
from advsearch.scene.mitsuba_backend.variant import Plugin
from advsearch.scene.parts import BASE_COLOR

Doubles = npt.NDArray[np.float64]

SECTIONS = 64
"""Sides of a round shape."""
MESHES = ("rectangle", "cube", "sphere", "cylinder", "disk", "obj", "ply")
"""The shapes that can be the object."""
COLORS = {
    "diffuse": "reflectance",
    "principled": "base_color",
    "principledthin": "base_color",
    "plastic": "diffuse_reflectance",
    "roughplastic": "diffuse_reflectance",
    "pplastic": "diffuse_reflectance",
}
"""Surfaces with a base colour, and its name there."""
SIDES = (
    ((1, -1, -1), (1, -1, 1), (-1, -1, 1), (-1, -1, -1)),
    ((1, 1, -1), (-1, 1, -1), (-1, 1, 1), (1, 1, 1)),
    ((1, -1, -1), (1, 1, -1), (1, 1, 1), (1, -1, 1)),
    ((1, -1, 1), (1, 1, 1), (-1, 1, 1), (-1, -1, 1)),
    ((-1, -1, 1), (-1, 1, 1), (-1, 1, -1), (-1, -1, -1)),
    ((1, 1, -1), (1, -1, -1), (-1, -1, -1), (-1, 1, -1)),
)
"""Corners of each side of Mitsuba's cube, in the order of those of a picture: (0, 1), (1, 1), (1, 0), (0, 0)."""
GREY = 0.5
"""Reflectance where a surface says none: Mitsuba's default."""


def mesh_of(shape: Mapping[str, object], name: str, *, painted: bool = False) -> ImportedPart:
    """Return a shape's triangles in its scene, without a surface.

    Args:
        shape: its dictionary.
        name: of it.
        painted: it shows a picture. Without one, texture coordinates of a solid shape are left out: on a cube they
            repeat.

    Raises:
        InputError: it has none.
    """
    kind = str(shape["type"])
    if kind not in MESHES:
        raise InputError(f"object {name}: a {kind} cannot be moved; expected a shape of {', '.join(MESHES)}")
    matrix = np.asarray(shape.get("to_world", np.eye(4)), dtype=np.float64)
    if kind in ("obj", "ply"):
        path = Path(str(shape["filename"]))
        parts, _ = read_parts(path, path.read_bytes())
        part = _joined(parts)
    else:
        part, own = _solid(kind, shape)
        matrix = matrix @ own
        if not (painted or kind == "rectangle"):
            part = replace(part, uvs=None)
    if part.uvs is not None and not shape.get("flip_tex_coords", kind == "obj"):
        part = replace(part, uvs=part.uvs * (1.0, -1.0) + (0.0, 1.0))  # Mitsuba has row 0 of a picture at v = 0
    vertices = part.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    mirrored = (np.linalg.det(matrix[:3, :3]) < 0.0) != bool(shape.get("flip_normals"))
    normals = part.normals
    if normals is not None:
        normals = normals @ np.linalg.inv(matrix[:3, :3]) * (-1.0 if shape.get("flip_normals") else 1.0)
    faces = part.faces[:, ::-1] if mirrored else part.faces
    return replace(part, vertices=vertices, faces=faces, normals=None if shape.get("face_normals") else normals)


def _solid(kind: str, shape: Mapping[str, object]) -> tuple[ImportedPart, Doubles]:
    """A shape of Mitsuba's around the origin, and its own transform (4, 4) before `to_world`."""
    own = np.eye(4)
    round_ = np.linspace(0.0, 1.0, SECTIONS + 1)
    if kind == "sphere":
        uvs, faces = _grid(round_, round_[::2])
        down = np.pi * uvs[:, 1]
        vertices = np.stack([*(np.sin(down) * _circle(uvs[:, 0])), np.cos(down)], axis=1)
        own[:3, :3] *= _number(shape.get("radius", 1.0))
        own[:3, 3] = np.asarray(shape.get("center", (0.0, 0.0, 0.0)), dtype=np.float64)
    elif kind == "cylinder":  # open at both ends, as Mitsuba's
        uvs, faces = _grid(round_, np.array([0.0, 1.0]))
        vertices = np.stack([*_circle(uvs[:, 0]), uvs[:, 1]], axis=1)
        own = _along(shape)
    elif kind == "cube":
        vertices = np.array(SIDES, dtype=np.float64).reshape(-1, 3)
        uvs = np.tile([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], (6, 1))
        faces = (np.arange(0, 24, 4)[:, None, None] + np.array([[0, 1, 2], [3, 0, 2]])).reshape(-1, 3)
    elif kind == "disk":
        uvs, faces = _grid(round_[::8], round_)
        vertices = np.stack([*(uvs[:, 0] * _circle(uvs[:, 1])), np.zeros(len(uvs))], axis=1)
    else:
        uvs, faces = _grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
        vertices = np.column_stack([uvs * 2.0 - 1.0, np.zeros(4)])
    normals = {"sphere": vertices, "cylinder": vertices * (1.0, 1.0, 0.0)}.get(kind)
    ends = vertices[faces]
    faces = faces[np.linalg.norm(np.cross(ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0]), axis=1) > 1e-9]
    return ImportedPart(vertices, faces, normals, uvs, None, ImportedSurface()), own


def _grid(u: Doubles, v: Doubles) -> tuple[Doubles, npt.NDArray[np.int64]]:
    """The points (N, 2) of a grid of texture coordinates, and its triangles (F, 3)."""
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    first = (np.arange(len(v) - 1)[:, None] * len(u) + np.arange(len(u) - 1)).reshape(-1)
    above = first + len(u)
    triangles = [[first, first + 1, above + 1], [first, above + 1, above]]
    return points, np.concatenate([np.stack(one, axis=1) for one in triangles])


def _circle(share: Doubles) -> Doubles:
    """Points (2, N) of the unit circle, at shares (N,) of a whole turn."""
    found: Doubles = np.stack([np.cos(2.0 * np.pi * share), np.sin(2.0 * np.pi * share)])
    return found


def _along(shape: Mapping[str, object]) -> Doubles:
    """The transform (4, 4) of a cylinder between its two points; around it as Mitsuba's (Duff et al. 2017)."""
    low = np.asarray(shape.get("p0", (0.0, 0.0, 0.0)), dtype=np.float64)
    high = np.asarray(shape.get("p1", (0.0, 0.0, 1.0)), dtype=np.float64)
    length = float(np.linalg.norm(high - low))
    x, y, z = along = (high - low) / max(length, 1e-30)
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    aside = np.array([1.0 + sign * x * x * a, sign * x * y * a, -sign * x])
    across = np.array([x * y * a, sign + y * y * a, -y])
    radius = _number(shape.get("radius", 1.0))
    own = np.eye(4)
    own[:3] = np.stack([aside * radius, across * radius, along * length, low], axis=1)
    return own


def _number(value: object) -> float:
    return float(np.asarray(value, dtype=np.float64))


def _joined(parts: list[ImportedPart]) -> ImportedPart:
    """All parts of a file as one; what not all of them have is left out."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    normals, uvs = [part.normals for part in parts], [part.uvs for part in parts]
    return ImportedPart(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate([one for one in normals if one is not None]) if all(n is not None for n in normals) else None,
        np.concatenate([one for one in uvs if one is not None]) if all(uv is not None for uv in uvs) else None,
        None,
        ImportedSurface(),
    )


def surface_of(bsdf: Mapping[str, object]) -> tuple[ImportedSurface, Plugin]:
    """Return a surface's base colour, and its dictionary with `BASE_COLOR` in the place of it, if it has such a place.

    Only the first base colour is taken out. A texture that is no picture stays where it is.
    """
    found = ImportedSurface()
    taken = False

    def without(plugin: Mapping[str, object]) -> Plugin:
        nonlocal found, taken
        key = COLORS.get(str(plugin["type"]))
        if key is not None and not taken:
            color = _color(plugin.get(key, GREY))
            if color is not None:
                taken, found = True, color
                return {**plugin, key: BASE_COLOR}
        return {name: without(value) if isinstance(value, Mapping) else value for name, value in plugin.items()}

    surface = without(bsdf)
    return found, surface


def _color(value: object) -> ImportedSurface | None:
    """A constant or a picture as a base colour, display-referred."""
    if isinstance(value, Mapping):
        picture = value.get("bitmap")
        if value["type"] == "bitmap" and isinstance(picture, np.ndarray) and picture.ndim == 3 and "to_uv" not in value:
            return ImportedSurface(texture=linear_to_srgb(np.clip(picture[..., :3], 0.0, 1.0).astype(np.float32)))
        value = value.get("value") if value["type"] in ("rgb", "uniform", "spectrum", "srgb") else None
    if isinstance(value, (int, float)):
        value = [float(value)] * 3
    if not isinstance(value, (list, tuple, np.ndarray)) or np.shape(value) != (3,):
        return None
    return ImportedSurface(color=linear_to_srgb(np.clip(np.array(value, dtype=np.float32), 0.0, 1.0)))
