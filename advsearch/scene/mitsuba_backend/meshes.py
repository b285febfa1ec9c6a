"""Make Mitsuba's mesh and surface plugins from our assets.

The names of a mesh's parameters are defined here and nowhere else: Mitsuba 3.10 renames
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assets import (
    Float32Array,
    Float64Array,
    Mesh,
    compute_area_vectors,
    compute_lengths,
    multiply_rows,
)
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.mitsuba_backend.variant import Plugin, mi
from advsearch.scene.parts import BASE_COLOR, MeshPart

POSITIONS = "vertex_positions"
NORMALS = "vertex_normals"
TEXCOORDS = "vertex_texcoords"
FACES = "faces"
"""Names of a mesh's parameters.

They are flat arrays of 3, 3 and 2 numbers per vertex, and 3 indices per face.
"""
MIN_WEIGHT_FRACTION = 0.2  # see `compute_sampling_weights`
RENDERED_RANGES = {
    "metallic": (0.0, 0.999),
    "specular": (1e-3, 1.0),
    "clearcoat": (1e-4, 1.0),
}
"""Ranges of numbers of the principled surface that Mitsuba renders correctly.

At an end of their full range they are rendered or differentiated wrongly: a value
beyond is clamped to this range, wherever it comes from (docs/controls/material.md).
"""
BLACK_METAL_VALUES = {
    "specular": (0.0, RENDERED_RANGES["specular"][0]),
    "eta": (1.0, 1.001),
}
"""Values of a user's principled surface at which metal would be black.

Mitsuba takes the second value in place of the first where the value is set later, but
not where a file has it.
"""


def make_principled(part: MeshPart, extra: Plugin | None = None) -> Plugin:
    """Return the surface of a mesh, with cut-outs and normal map.

    It is a two-sided principled BSDF with the base color as a bilinear texture of
    linear reflectance. A clearcoat of 0 leaves the lobe out.

    Args:
        part: the mesh.
        extra: further entries of the principled plugin.
    """
    surface = _make_single_sided_surface(part, extra or {})
    bsdf: Plugin = {"type": "twosided", "bsdf": surface}
    if part.normal_map is not None:
        bsdf = {
            "type": "normalmap",
            "normalmap": make_texture(part.normal_map),
            "bsdf": bsdf,
        }
    if part.opacity is not None:
        bsdf = {
            "type": "mask",
            "opacity": make_texture(part.opacity[:, :, None]),
            "bsdf": bsdf,
        }
    return bsdf


def _make_single_sided_surface(part: MeshPart, extra: Plugin) -> Plugin:
    """Return the one-sided principled BSDF of a mesh, with further entries `extra`."""
    material = part.material
    surface: Plugin = {
        "type": "principled",
        "base_color": make_texture(srgb_to_linear(part.base_color)),
        "roughness": material.roughness,
        "metallic": clamp_to_rendered("metallic", material.metallic),
        "specular": clamp_to_rendered("specular", material.specular),
        **extra,
    }
    if material.clearcoat > 0.0:
        surface["clearcoat"] = clamp_to_rendered("clearcoat", material.clearcoat)
    return surface


def clamp_to_rendered(name: str, value: float) -> float:
    """Return the value that is rendered for a number of the principled surface."""
    lower, upper = RENDERED_RANGES.get(name, (0.0, 1.0))
    return min(max(value, lower), upper)


def make_emitter(part: MeshPart) -> Plugin | None:
    """Return the light that a mesh emits from the front of its faces, or None.

    Even light is a color, whose input has three numbers; other light is a texture.
    """
    if part.emission is None:
        return None
    if has_textured_emission(part):
        return {"type": "area", "radiance": make_texture(part.emission)}
    return {
        "type": "area",
        "radiance": {"type": "rgb", "value": part.emission[0, 0].tolist()},
    }


def compute_sampling_weights(parts: Iterable[MeshPart]) -> dict[str, float]:
    """Return how often light is sampled from each mesh that emits some, by its name.

    The environment has the weight 1, and all meshes together also have 1. Each mesh has
    a fraction of it in proportion to its power, but at least `MIN_WEIGHT_FRACTION` of
    an equal part, so that no light is sampled too rarely.
    """
    powers: dict[str, float] = {}
    for part in parts:
        if part.emission is not None:
            powers[part.name] = _compute_relative_power(part, part.emission)
    total = max(sum(powers.values()), 1e-30)  # of faces without area it is 0
    return {
        name: (1.0 - MIN_WEIGHT_FRACTION) * power / total
        + MIN_WEIGHT_FRACTION / len(powers)
        for name, power in powers.items()
    }


def _compute_relative_power(part: MeshPart, emission: Float32Array) -> float:
    """Return the power of a mesh that emits light, up to a constant factor."""
    vertices = part.mesh.vertices.astype(np.float64) @ part.to_world[:3, :3].T
    vectors = compute_area_vectors(vertices[part.mesh.faces])
    doubled_area = np.linalg.norm(vectors, axis=1).sum()
    return float(emission.mean() * doubled_area)


def has_textured_emission(part: MeshPart) -> bool:
    """Return whether a mesh emits light that varies over its surface."""
    return part.emission is not None and part.emission.shape != (1, 1, 3)


def make_diffuse(reflectance: Float32Array) -> Plugin:
    """Return a two-sided diffuse BSDF with a bilinear texture of linear reflectance.

    The texture is (h, w, 3), row 0 at v = 1.
    """
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": make_texture(reflectance)},
    }


def make_texture(linear: Float32Array) -> Plugin:
    """Return a bilinear texture (h, w, channels) of linear values, row 0 at v = 1."""
    bitmap = mi.Bitmap(np.ascontiguousarray(linear, dtype=np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear"}


def map_inner_plugins(
    plugin: Mapping[str, object], change: Callable[[Mapping[str, object]], object]
) -> Plugin:
    """Return a plugin in which each of its direct inner plugins is replaced by its
    change.
    """
    return {
        key: change(entry) if isinstance(entry, Mapping) else entry
        for key, entry in plugin.items()
    }


def fill_base_color(
    surface: Mapping[str, object], fill: Callable[[Mapping[str, object]], object]
) -> Plugin:
    """Return one of Mitsuba's surfaces with its base color put in.

    Args:
        surface: a dictionary, in which a plugin of the type `BASE_COLOR` stands for the
            base color.
        fill: makes the texture from the other entries of that plugin, which say how it
            is looked up.
    """

    def fill_in(plugin: Mapping[str, object]) -> object:
        """Return a plugin with base colors put in, or the texture of a placeholder."""
        if plugin.get("type") == BASE_COLOR:
            return fill({key: entry for key, entry in plugin.items() if key != "type"})
        return map_inner_plugins(plugin, fill_in)

    return to_loadable(map_inner_plugins(surface, fill_in))


def make_base_texture(
    base_color: Float32Array, options: Mapping[str, object]
) -> Plugin:
    """Return a display-referred base color (h, w, 3) as a linear texture.

    The options are entries of the texture that say how it is looked up, such as
    "wrap_mode".
    """
    return {**make_texture(srgb_to_linear(base_color)), **to_loadable(options)}


def to_repeating_uv(
    uv: Tensor, options: Mapping[str, object], size: tuple[int, int]
) -> Tensor:
    """Convert texture coordinates for a texture that repeats and is interpolated.

    The texture's own transform, its wrap mode and its filter are applied here instead:
    mirrored and clamped coordinates stay half a texel inside, and unfiltered ones go to
    the center of their texel.

    Args:
        uv: (n, 2) float32, as Mitsuba has them.
        options: how the texture is really looked up, see `make_base_texture`.
        size: rows and columns of the texture.

    Returns:
        (n, 2), where a repeating texture shows what the real one does at `uv`.
    """
    if "to_uv" in options:
        matrix = torch.as_tensor(np.asarray(options["to_uv"]), dtype=uv.dtype)
        uv = uv @ matrix[:2, :2].T + matrix[:2, -1]  # (3, 3) or (4, 4)
    texture_size = torch.tensor((size[1], size[0]), dtype=uv.dtype)
    uv = _wrap_uv(uv, options.get("wrap_mode", "repeat"), texture_size)
    # At the center of a texel, interpolation returns that texel alone.
    if options.get("filter_type") == "nearest":
        return (torch.floor(uv * texture_size) + 0.5) / texture_size
    return uv


def _wrap_uv(uv: Tensor, wrap_mode: object, texture_size: Tensor) -> Tensor:
    """Convert mirrored or clamped texture coordinates (n, 2) for a repeating texture.

    `texture_size` is its width and height in texels.
    """
    if wrap_mode == "mirror":
        uv = 1.0 - (uv % 2.0 - 1.0).abs()  # back and forth in [0, 1]
    if wrap_mode == "repeat":
        return uv
    # within half a texel of the border the texture does not blend with the other side
    half_texel = 0.5 / texture_size
    return torch.minimum(torch.maximum(uv, half_texel), 1.0 - half_texel)


def make_mitsuba_mesh(
    name: str,
    mesh: Mesh,
    to_world: Float64Array,
    bsdf: Plugin,
    light: Plugin | None = None,
) -> Any:
    """Make a Mitsuba mesh under a pose, with shading normals and texture coordinates.

    Args:
        name: Mitsuba's id of the mesh.
        mesh: the mesh.
        to_world: (4, 4) pose.
        bsdf: dictionary of its surface.
        light: dictionary of the light that it emits, or None.
    """
    vertices, normals = _transform_mesh(mesh, to_world)
    plugin = mi.Mesh(
        name,
        vertex_count=len(vertices),
        face_count=len(mesh.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=_make_mesh_properties(bsdf, light),
    )
    _set_mesh_arrays(plugin, mesh, vertices, normals)
    for key, values in mesh.attributes.items():
        flat_values = np.ascontiguousarray(values, np.float32).ravel()
        plugin.add_attribute(key, values.shape[1], flat_values)
    return plugin


def _transform_mesh(
    mesh: Mesh, to_world: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the vertices and the unit normals (V, 3) of a mesh in the world."""
    linear = to_world[:3, :3]
    vertices = multiply_rows(mesh.vertices.astype(np.float64), linear.T)
    vertices += to_world[:3, 3]
    # Normals go by the inverse transpose: as rows, by the inverse.
    inverse = np.linalg.inv(linear).astype(np.float64)
    normals = multiply_rows(mesh.normals.astype(np.float64), inverse)
    normals /= np.maximum(compute_lengths(normals), 1e-12)
    return vertices, normals


def _make_mesh_properties(bsdf: Plugin, light: Plugin | None) -> Any:
    """Return Mitsuba's properties of a mesh with a surface and perhaps a light."""
    properties = mi.Properties()
    # Optimizing would merge equal values into one object: to change one would change
    # all.
    properties["bsdf"] = mi.load_dict(bsdf, optimize=False)
    if light is not None:
        properties["emitter"] = mi.load_dict(light, optimize=False)
    return properties


def _set_mesh_arrays(
    plugin: Any, mesh: Mesh, vertices: Float64Array, normals: Float64Array
) -> None:
    """Set vertices, normals, texture coordinates and faces of a Mitsuba mesh.

    Mitsuba's bitmaps have row 0 at v = 0 and ours have it at v = 1, so v is flipped.
    """
    uvs = np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1)
    parameters = mi.traverse(plugin)
    for key, values in ((POSITIONS, vertices), (NORMALS, normals), (TEXCOORDS, uvs)):
        parameters[key] = mi.Float(values.astype(np.float32).ravel())
    parameters[FACES] = mi.UInt32(mesh.faces.astype(np.uint32).ravel())
    parameters.update()


def to_loadable(plugin: Mapping[str, object]) -> Plugin:
    """Return a dictionary that Mitsuba loads.

    Arrays of shape (4, 4) and (3, 3) become Mitsuba's transforms, others its bitmaps
    (H, W, C). If a principled surface has a number that Mitsuba does not take, it gets
    the nearest one that it takes, see `BLACK_METAL_VALUES`.
    """
    entries = {key: _to_loadable_entry(value) for key, value in plugin.items()}
    if entries.get("type") == "principled":
        for name, (refused_value, smallest_value) in BLACK_METAL_VALUES.items():
            if entries.get(name) == refused_value:
                entries[name] = smallest_value
    return entries


def _to_loadable_entry(value: object) -> object:
    """Convert one value of a dictionary, see `to_loadable`."""
    if isinstance(value, Mapping):
        return to_loadable(value)
    if not isinstance(value, np.ndarray):
        return value
    if value.shape == (4, 4):
        return mi.ScalarTransform4f(value)
    if value.shape == (3, 3):
        return mi.ScalarTransform3f(value)
    return mi.Bitmap(np.ascontiguousarray(value, dtype=np.float32))


def to_plain(plugin: Mapping[str, object]) -> Plugin:
    """Return a dictionary with arrays for Mitsuba's transforms.

    They are (4, 4), and (3, 3) for texture coordinates.
    """
    return {key: _to_plain_entry(value) for key, value in plugin.items()}


def _to_plain_entry(value: object) -> object:
    """Convert one value of a dictionary, see `to_plain`."""
    if isinstance(value, Mapping):
        return to_plain(value)
    matrix = getattr(value, "matrix", None)  # of a transform
    if matrix is None:
        return value
    # The reshape drops a further axis, of one lane, that some of Dr.Jit's matrices
    # have.
    size = len(matrix)
    return np.array(matrix, dtype=np.float64).reshape(size, size)
