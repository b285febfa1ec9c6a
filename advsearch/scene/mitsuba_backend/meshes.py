"""Mitsuba's mesh and surface plugins from our assets, and the names of a mesh's
parameters.

Mitsuba 3.10 renames these parameters: they stand here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assets import Doubles, Floats, Mesh, face_vectors
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.mitsuba_backend.variant import Plugin, mi
from advsearch.scene.parts import BASE_COLOR, MeshPart

POSITIONS = "vertex_positions"
NORMALS = "vertex_normals"
TEXCOORDS = "vertex_texcoords"
FACES = "faces"
"""Names of a mesh's parameters: flat arrays of 3, 3 and 2 numbers a vertex, and 3
indices a face.
"""
LEAST = 0.2  # see `sampling_weights`
RENDERED = {"metallic": (0.0, 0.999), "specular": (1e-3, 1.0), "clearcoat": (1e-4, 1.0)}
"""Numbers of the principled surface that Mitsuba renders or differentiates wrongly at
an end of their range: a value beyond is moved to the nearest of these, wherever it
comes from (docs/controls/material.md).
"""
DARK = {"specular": (0.0, RENDERED["specular"][0]), "eta": (1.0, 1.001)}
"""Of principled surfaces of the user's: at the first value metal would be black.
Mitsuba takes the second in its place where the value is set later, but not where a file
has it.
"""


def principled(part: MeshPart, extra: Plugin | None = None) -> Plugin:
    """The surface of a mesh, with cut-outs and normal map: a two-sided principled BSDF
    with the base colour as a bilinear texture of linear reflectance, and some extra
    entries. A clearcoat of 0 leaves the lobe out.
    """
    material = part.material
    surface: Plugin = {
        "type": "principled", "base_color": texture(srgb_to_linear(part.base_color)), "roughness": material.roughness,
        "metallic": rendered("metallic", material.metallic), "specular": rendered("specular", material.specular),
        **(extra or {}),
    }  # fmt: skip
    if material.clearcoat > 0.0:
        surface["clearcoat"] = rendered("clearcoat", material.clearcoat)
    bsdf: Plugin = {"type": "twosided", "bsdf": surface}
    if part.normal_map is not None:
        bsdf = {
            "type": "normalmap",
            "normalmap": texture(part.normal_map),
            "bsdf": bsdf,
        }
    if part.opacity is not None:
        bsdf = {
            "type": "mask",
            "opacity": texture(part.opacity[:, :, None]),
            "bsdf": bsdf,
        }
    return bsdf


def rendered(name: str, value: float) -> float:
    """Return the value that is rendered for a number of the principled surface."""
    low, high = RENDERED.get(name, (0.0, 1.0))
    return min(max(value, low), high)


def emitter(part: MeshPart) -> Plugin | None:
    """The light that a mesh emits, from the front of its faces; None where it emits
    none.
    """
    if part.emission is None:
        return None
    if textured_emission(part):
        return {"type": "area", "radiance": texture(part.emission)}
    return {
        "type": "area",
        "radiance": {"type": "rgb", "value": part.emission[0, 0].tolist()},
    }


def sampling_weights(parts: Iterable[MeshPart]) -> dict[str, float]:
    """How often light is sampled from each mesh that emits some, by its name, where the
    environment has 1.

    All of them together have 1 too, by their power; however little that is, each has
    `LEAST` of an equal share.
    """
    powers: dict[str, float] = {}
    for part in parts:
        if part.emission is not None:
            corners = (part.mesh.vertices.astype(np.float64) @ part.to_world[:3, :3].T)[
                part.mesh.faces
            ]
            powers[part.name] = float(
                part.emission.mean()
                * np.linalg.norm(face_vectors(corners), axis=1).sum()
            )
    total = max(sum(powers.values()), 1e-30)  # of faces without area it is 0
    return {
        name: (1.0 - LEAST) * power / total + LEAST / len(powers)
        for name, power in powers.items()
    }


def textured_emission(part: MeshPart) -> bool:
    """Whether a mesh emits light that differs from place to place."""
    return part.emission is not None and part.emission.shape != (1, 1, 3)


def matt(reflectance: Floats) -> Plugin:
    """A two-sided diffuse BSDF with a bilinear texture (h, w, 3) of linear reflectance,
    row 0 at v = 1.
    """
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": texture(reflectance)},
    }


def texture(linear: Floats) -> Plugin:
    """A bilinear texture (h, w, channels) of linear values, row 0 at v = 1."""
    bitmap = mi.Bitmap(np.ascontiguousarray(linear, dtype=np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear"}


def with_inner(
    plugin: Mapping[str, object], change: Callable[[Mapping[str, object]], object]
) -> Plugin:
    """Return a plugin whose inner plugins are changed."""
    return {
        key: change(entry) if isinstance(entry, Mapping) else entry
        for key, entry in plugin.items()
    }


def own_surface(
    surface: Mapping[str, object], fill: Callable[[Mapping[str, object]], object]
) -> Plugin:
    """Return a surface in Mitsuba's words, which has `BASE_COLOR` as a type, with its
    base colour in that place: what `fill` makes of how the texture is looked up.
    """

    def filled(plugin: Mapping[str, object]) -> object:
        if plugin.get("type") == BASE_COLOR:
            return fill({key: entry for key, entry in plugin.items() if key != "type"})
        return with_inner(plugin, filled)

    return loadable(with_inner(surface, filled))


def base_texture(base_color: Floats, options: Mapping[str, object]) -> Plugin:
    """A display-referred base colour (h, w, 3) as a texture of linear reflectance,
    looked up as `options` say.
    """
    return {**texture(srgb_to_linear(base_color)), **loadable(options)}


def repeating(
    uv: Tensor, options: Mapping[str, object], size: tuple[int, int]
) -> Tensor:
    """Return where a texture of a size (rows, columns) that repeats and is interpolated
    shows what one with these options, as of `base_texture`, does at texture coordinates
    (n, 2) float32, as Mitsuba has them.
    """
    if "to_uv" in options:
        matrix = torch.as_tensor(np.asarray(options["to_uv"]), dtype=uv.dtype)
        uv = uv @ matrix[:2, :2].T + matrix[:2, -1]
    texels = torch.tensor((size[1], size[0]), dtype=uv.dtype)
    wrap = options.get("wrap_mode", "repeat")
    if wrap == "mirror":
        uv = 1.0 - (uv % 2.0 - 1.0).abs()
    if wrap != "repeat":
        uv = torch.minimum(torch.maximum(uv, 0.5 / texels), 1.0 - 0.5 / texels)
    return (
        (torch.floor(uv * texels) + 0.5) / texels
        if options.get("filter_type") == "nearest"
        else uv
    )


def mitsuba_mesh(
    name: str, mesh: Mesh, to_world: Doubles, bsdf: Plugin, light: Plugin | None = None
) -> Any:
    """Return a Mitsuba mesh of the given geometry under a pose, with shading normals
    and texture coordinates.

    Mitsuba's bitmaps have row 0 at v = 0 while ours have it at v = 1, hence the flip.
    """
    vertices = mesh.vertices.astype(np.float64) @ to_world[:3, :3].T + to_world[:3, 3]
    normals = mesh.normals.astype(np.float64) @ np.linalg.inv(to_world[:3, :3])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    uvs = np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1)
    properties = mi.Properties()
    # which makes equal numbers one: both would change
    properties["bsdf"] = mi.load_dict(bsdf, optimize=False)
    if light is not None:
        properties["emitter"] = mi.load_dict(light, optimize=False)
    counts = {"vertex_count": len(vertices), "face_count": len(mesh.faces)}
    result = mi.Mesh(
        name,
        **counts,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(result)
    for key, values in ((POSITIONS, vertices), (NORMALS, normals), (TEXCOORDS, uvs)):
        parameters[key] = mi.Float(values.astype(np.float32).ravel())
    parameters[FACES] = mi.UInt32(mesh.faces.astype(np.uint32).ravel())
    parameters.update()
    for key, values in mesh.attributes.items():
        result.add_attribute(
            key, values.shape[1], np.ascontiguousarray(values, np.float32).ravel()
        )
    return result


def loadable(plugin: Mapping[str, object]) -> Plugin:
    """Return a dictionary with Mitsuba's transforms for arrays (4, 4) and (3, 3), its
    bitmaps for pictures (H, W, C), and principled surfaces without what is `DARK`.
    """

    def made(value: object) -> object:
        if isinstance(value, Mapping):
            return loadable(value)
        if isinstance(value, np.ndarray):
            transform = {
                (4, 4): mi.ScalarTransform4f,
                (3, 3): mi.ScalarTransform3f,
            }.get(value.shape)
            return (
                transform(value)
                if transform
                else mi.Bitmap(np.ascontiguousarray(value, dtype=np.float32))
            )
        return value

    entries = {key: made(value) for key, value in plugin.items()}
    if entries.get("type") == "principled":
        entries |= {
            name: least
            for name, (dark, least) in DARK.items()
            if entries.get(name) == dark
        }
    return entries


def plain(plugin: Mapping[str, object]) -> Plugin:
    """Return a dictionary with arrays (4, 4), of texture coordinates (3, 3), for
    Mitsuba's transforms.
    """

    def made(value: object) -> object:
        if isinstance(value, Mapping):
            return plain(value)
        matrix = getattr(value, "matrix", None)
        return (
            value
            if matrix is None
            else np.array(matrix, dtype=np.float64).reshape(len(matrix), len(matrix))
        )

    return {key: made(value) for key, value in plugin.items()}
