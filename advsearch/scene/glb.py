"""Meshes as binary glTF 2.0 (.glb): y up, one node a mesh, its texture inside as a PNG or JPEG file of 8 bits.

Materials have the numbers of the principled surface (glTF 2.0, section 3.9, and the extensions KHR_materials_specular
and KHR_materials_clearcoat): a specular of 0.5 reflects 4 % at normal incidence, as glTF's default does.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from advsearch.scene.assembly import MovingMesh
from advsearch.scene.assets import Doubles, Floats, Shape
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.glb_buffer import GlbBuffer
from advsearch.scene.parts import MeshPart

COAT_ROUGHNESS = 0.316
"""Of Mitsuba's clearcoat, whose alpha is 0.1: the square root of it."""
PLAIN = 0.5
"""Specular of a surface whose index of refraction is 1.5."""
WEB_SIDE, WEB_QUALITY = 1024, 90
"""Longest side in pixels of a texture in a file for the web, and the quality of its JPEG, from 1 to 95."""
PNG = b"\x89PNG"
"""The first bytes of such a file."""
CAMERA = {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.01}}
"""The camera of such a file: its place counts."""


def posed(part: MeshPart, inputs: Mapping[str, Tensor]) -> Shape:
    """Return a mesh of a scene as its inputs have it, in world space, z up.

    Args:
        part: of the scene.
        inputs: of `MitsubaScene`, that differ from the base values.
    """
    given = {key.partition(".")[2]: value.detach().cpu() for key, value in inputs.items() if _of(key) == part.name}
    vertices, normals = MovingMesh(part.mesh, part.to_world).place(None, None)
    vertices, normals = given.get("vertices", vertices), given.get("normals", normals)
    mesh = replace(part.mesh, vertices=_rows(vertices), normals=_rows(normals))
    color = part.base_color
    if "base_color" in given:
        color = linear_to_srgb(given["base_color"].clamp(0.0, 1.0)).numpy()
    numbers = {key: float(given[key]) for key in vars(part.material) if key in given}
    material = replace(part.material, **numbers)
    return replace(part, mesh=mesh, base_color=color, material=material, to_world=np.eye(4))


def _of(key: str) -> str:
    return key.partition(".")[0]


def _rows(flat: Tensor) -> Floats:
    return flat.reshape(-1, 3).to(torch.float32).numpy()


def glb(meshes: Sequence[Shape]) -> bytes:
    """Return a binary glTF file of some meshes."""
    made = GlbBuffer()
    return made.file(_described(made, meshes, _png))


def web_glb(adversarial: Sequence[Shape], clean: Sequence[Shape], camera: Doubles, note: str = "") -> bytes:
    """Return a small file with two scenes, the adversarial one and "clean": what is the same in both is there once.

    Args:
        adversarial: the meshes of the adversarial scene.
        clean: the same before.
        camera: (4, 4) pose of the camera that sees that; it looks along its own +z.
        note: what a reader has to know, in `asset.extras`.
    """
    made, count = GlbBuffer(), len(adversarial)
    header = _described(made, [*adversarial, *clean], _jpeg)
    ours = camera[:3].T.astype(np.float32)  # rows: its axes, then its place
    columns = np.eye(4)
    columns[:, :3] = _y_up(ours * np.array([[-1.0], [1.0], [-1.0], [1.0]], np.float32))  # glTF's look along their -z
    header["cameras"] = [CAMERA]
    header["nodes"].append({"name": "camera", "camera": 0, "matrix": columns.ravel().tolist()})
    first, last = list(range(count)), len(header["nodes"]) - 1
    header["scenes"] = [
        {"name": "adversarial", "nodes": [*first, last]},
        {"name": "clean", "nodes": list(range(count, last))},
    ]
    header["asset"] |= {"extras": {"note": note}} if note else {}
    return made.file(header)


def _described(made: GlbBuffer, meshes: Sequence[Shape], picture: Callable[[Floats], bytes]) -> dict[str, Any]:
    """Return the header of a file with some meshes in one scene, and put their bytes into the buffer."""
    header: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "advsearch"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": shape.name, "mesh": number} for number, shape in enumerate(meshes)],
        "meshes": [],
        "materials": [],
        "textures": [],
        "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 10497, "wrapT": 10497}],
        "images": [],
    }
    for number, shape in enumerate(meshes):
        mesh = shape.mesh
        corners = {
            "POSITION": made.accessor(_y_up(mesh.vertices), "VEC3", bounds=True),
            "NORMAL": made.accessor(_y_up(_unit(mesh.normals)), "VEC3"),
            "TEXCOORD_0": made.accessor(np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1), "VEC2"),
        }
        whole = np.uint32 if len(mesh.vertices) > np.iinfo(np.uint16).max else np.uint16
        indices = made.accessor(mesh.faces.reshape(-1).astype(whole), "SCALAR")
        header["meshes"].append(
            {"name": shape.name, "primitives": [{"attributes": corners, "indices": indices, "material": number}]}
        )
        encoded = picture(shape.base_color) if shape.opacity is None else _cut_out_png(shape.base_color, shape.opacity)
        material = _material(shape, _texture(header, made.view(encoded), encoded))
        if shape.normal_map is not None:
            encoded = picture(shape.normal_map)
            material["normalTexture"] = {"index": _texture(header, made.view(encoded), encoded)}
        if shape.emission is not None:
            most = float(shape.emission.max())
            share = linear_to_srgb(shape.emission / np.float32(most))
            material["emissiveFactor"] = [1.0, 1.0, 1.0]
            encoded = picture(share)
            material["emissiveTexture"] = {"index": _texture(header, made.view(encoded), encoded)}
            material.setdefault("extensions", {})["KHR_materials_emissive_strength"] = {"emissiveStrength": most}
        header["materials"].append(material)
    used = sorted({name for material in header["materials"] for name in material.get("extensions", ())})
    return {**header, "extensionsUsed": used} if used else header


def _texture(header: dict[str, Any], view: int, picture: bytes) -> int:
    """Add a picture in a view of the buffer to the header, and return the number of its texture."""
    kind = "image/png" if picture.startswith(PNG) else "image/jpeg"
    header["images"].append({"mimeType": kind, "bufferView": view})
    header["textures"].append({"source": len(header["textures"]), "sampler": 0})
    return len(header["textures"]) - 1


def _material(one: Shape, texture: int) -> dict[str, Any]:
    surface = one.material
    extensions: dict[str, Any] = {}
    if surface.specular != PLAIN:
        extensions["KHR_materials_specular"] = {"specularFactor": min(1.0, surface.specular / PLAIN)}
    if surface.clearcoat > 0.0:
        extensions["KHR_materials_clearcoat"] = {
            "clearcoatFactor": surface.clearcoat,
            "clearcoatRoughnessFactor": COAT_ROUGHNESS,
        }
    cut_out = {}
    if one.opacity is not None:
        cut_out = {"alphaMode": "MASK" if set(np.unique(one.opacity)) <= {0.0, 1.0} else "BLEND"}
    return {
        "name": one.name,
        "doubleSided": True,
        **cut_out,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": texture},
            "roughnessFactor": surface.roughness,
            "metallicFactor": surface.metallic,
        },
        **({"extensions": extensions} if extensions else {}),
    }


def _y_up(vectors: Floats) -> Floats:
    """Turn (N, 3) from z up to y up, by 90 degrees about x."""
    return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=1).astype(np.float32)


def _unit(normals: Floats) -> Floats:
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    found: Floats = np.where(lengths > 0.0, normals / np.maximum(lengths, 1e-12), np.eye(3)[2])
    return found.astype(np.float32)


def _png(color: Floats) -> bytes:
    file = io.BytesIO()
    _rounded(color).save(file, "PNG")
    return file.getvalue()


def _cut_out_png(color: Floats, opacity: Floats) -> bytes:
    """A picture whose alpha is the opacity, at the size of the colour."""
    file, picture = io.BytesIO(), _rounded(color)
    picture.putalpha(_rounded(opacity).resize(picture.size, Image.Resampling.BILINEAR))
    picture.save(file, "PNG")
    return file.getvalue()


def _jpeg(color: Floats) -> bytes:
    file, picture = io.BytesIO(), _rounded(color)
    picture.thumbnail((WEB_SIDE, WEB_SIDE))
    picture.save(file, "JPEG", quality=WEB_QUALITY, subsampling=0)
    return file.getvalue()


def _rounded(color: Floats) -> Image.Image:
    return Image.fromarray(np.uint8(np.clip(color, 0.0, 1.0) * 255.0 + 0.5))
