"""A place as it is written: a binary glTF file with variants of its materials, and the
YAML file beside it.

Textures are PNG files of 8 bits. The strength of a reflection that glTF's factor of at
most 1 cannot say is written as an index of refraction. What emits light is in cd/m2.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml
from PIL import Image

from advsearch.scene.assets import Float32Array, Float64Array, Material, Mesh
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.glb import GlbBuffer, find_mime_type
from scenes.places.quads import Quads

VARIANTS = "KHR_materials_variants"
EMISSION = "KHR_materials_emissive_strength"
SPECULAR = "KHR_materials_specular"
IOR = "KHR_materials_ior"
CLEARCOAT = "KHR_materials_clearcoat"
USUAL_SPECULAR = 0.5  # of an index of refraction of 1.5
REFLECTANCE = 0.08  # of a surface of specular 1 that faces the light
Y_UP = np.array(
    [
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""From z up and x ahead to y up and z ahead."""


@dataclass(frozen=True, eq=False)
class Look:
    """A material of the file."""

    # (h, w, 3) display-referred, row 0 at v = 1; (3,) where it is the same everywhere
    base: Float32Array
    finish: Material
    emission: Float32Array | None = None  # (h, w, 3) or (3,) linear luminance, cd/m2


@dataclass(frozen=True, eq=False)
class Primitive:
    """Geometry with one material, and the materials that it has in variants."""

    mesh: Mesh
    look: str
    variants: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Node:
    """Primitives in one place; nodes of the same list share what is stored."""

    primitives: Sequence[Primitive]
    pose: Float64Array = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class PlaceModel:
    """A place."""

    looks: Mapping[str, Look]
    nodes: Sequence[Node]
    file: Mapping[str, Any]  # what its YAML file says beside the mesh


def make_primitive(quads: Quads, look: str, **variants: str) -> Primitive:
    return Primitive(quads.mesh(), look, variants)


def place_files(name: str, model: PlaceModel) -> dict[str, bytes]:
    """Return the files of a place by path below the data folder."""
    text = yaml.safe_dump(
        {"mesh": "place.glb", **model.file},
        sort_keys=False,
        default_flow_style=None,
        width=110,
    )
    return {
        f"places/{name}/place.yaml": text.encode(),
        f"places/{name}/place.glb": glb(model),
    }


def glb(model: PlaceModel) -> bytes:
    """Return the binary glTF file of a place."""
    buffer = GlbBuffer()
    names = list(model.looks)
    header: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "advsearch, scenes/build.py"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(model.nodes)))}],
        "nodes": [],
        "meshes": [],
        "materials": [],
        "textures": [],
        "samplers": [
            {"magFilter": 9729, "minFilter": 9729, "wrapS": 10497, "wrapT": 10497}
        ],
        "images": [],
    }
    for name, look in model.looks.items():
        header["materials"].append(_material(header, buffer, name, look))
    variants = sorted(
        {
            variant
            for node in model.nodes
            for one in node.primitives
            for variant in one.variants
        }
    )
    meshes: dict[int, int] = {}
    for node in model.nodes:
        if id(node.primitives) not in meshes:
            meshes[id(node.primitives)] = len(header["meshes"])
            written = [
                _primitive(buffer, primitive, names, variants)
                for primitive in node.primitives
            ]
            header["meshes"].append(
                {"name": node.primitives[0].look, "primitives": written}
            )
        entry: dict[str, Any] = {
            "name": node.primitives[0].look,
            "mesh": meshes[id(node.primitives)],
        }
        if not np.array_equal(node.pose, np.eye(4)):
            entry["matrix"] = (Y_UP @ node.pose @ Y_UP.T).T.reshape(-1).tolist()
        header["nodes"].append(entry)
    used = {
        name
        for material in header["materials"]
        for name in material.get("extensions", ())
    }
    if variants:
        header["extensions"] = {
            VARIANTS: {"variants": [{"name": variant} for variant in variants]}
        }
        used.add(VARIANTS)
    if used:
        header["extensionsUsed"] = sorted(used)
    return buffer.to_bytes(
        {name: value for name, value in header.items() if value != []}
    )


def _primitive(
    buffer: GlbBuffer, primitive: Primitive, names: list[str], variants: list[str]
) -> dict[str, Any]:
    mesh = primitive.mesh
    is_small = len(mesh.vertices) <= np.iinfo(np.uint16).max
    indices = mesh.faces.reshape(-1).astype(np.uint16 if is_small else np.uint32)
    written: dict[str, Any] = {
        "attributes": {
            "POSITION": buffer.add_accessor(_y_up(mesh.vertices), "VEC3", bounds=True),
            "NORMAL": buffer.add_accessor(_y_up(mesh.normals), "VEC3"),
            "TEXCOORD_0": buffer.add_accessor(
                np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1), "VEC2"
            ),
        },
        "indices": buffer.add_accessor(indices, "SCALAR"),
        "material": names.index(primitive.look),
    }
    if primitive.variants:
        mappings = [
            {"material": names.index(look), "variants": [variants.index(variant)]}
            for variant, look in primitive.variants.items()
        ]
        written["extensions"] = {VARIANTS: {"mappings": mappings}}
    return written


def _y_up(vectors: Float32Array) -> Float32Array:
    return np.ascontiguousarray(vectors[:, [1, 2, 0]], np.float32)


def _material(
    header: dict[str, Any], buffer: GlbBuffer, name: str, look: Look
) -> dict[str, Any]:
    finish = look.finish
    surface: dict[str, Any] = {
        "roughnessFactor": finish.roughness,
        "metallicFactor": finish.metallic,
    }
    if look.base.ndim == 1:
        linear = srgb_to_linear(look.base.astype(np.float32)).tolist()
        surface["baseColorFactor"] = [*linear, 1.0]
    else:
        surface["baseColorTexture"] = _texture(header, buffer, look.base)
    material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": surface}
    extensions: dict[str, Any] = {}
    if finish.specular > USUAL_SPECULAR:
        amplitude = float(np.sqrt(REFLECTANCE * finish.specular))
        extensions[IOR] = {"ior": (1.0 + amplitude) / (1.0 - amplitude)}
    elif finish.specular < USUAL_SPECULAR:
        extensions[SPECULAR] = {"specularFactor": finish.specular / USUAL_SPECULAR}
    if finish.clearcoat > 0.0:
        extensions[CLEARCOAT] = {"clearcoatFactor": finish.clearcoat}
    if look.emission is not None:
        strength = float(look.emission.max())
        fraction = look.emission / np.float32(strength)
        if look.emission.ndim == 1:
            material["emissiveFactor"] = fraction.tolist()
        else:
            material["emissiveFactor"] = [1.0, 1.0, 1.0]
            material["emissiveTexture"] = _texture(
                header, buffer, linear_to_srgb(fraction)
            )
        extensions[EMISSION] = {"emissiveStrength": strength}
    return {**material, "extensions": extensions} if extensions else material


def _texture(
    header: dict[str, Any], buffer: GlbBuffer, display: Float32Array
) -> dict[str, int]:
    picture = _png(display)
    view = buffer.add_view(picture)
    views = [image["bufferView"] for image in header["images"]]
    if view not in views:
        views.append(view)
        header["images"].append(
            {"mimeType": find_mime_type(picture), "bufferView": view}
        )
        header["textures"].append({"source": len(views) - 1, "sampler": 0})
    return {"index": views.index(view)}


def _png(display: Float32Array) -> bytes:
    levels = np.clip(np.round(display.astype(np.float64) * 255.0), 0, 255).astype(
        np.uint8
    )
    stream = io.BytesIO()
    Image.fromarray(levels).save(stream, "PNG", optimize=True)
    return stream.getvalue()
