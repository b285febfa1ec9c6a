"""Meshes as binary glTF 2.0 (.glb): y up, one node a mesh, its texture inside as a PNG file of 8 bits.

Materials have the numbers of the principled surface (glTF 2.0, section 3.9, and the extensions KHR_materials_specular
and KHR_materials_clearcoat): a specular of 0.5 reflects 4 % at normal incidence, as glTF's default does.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from advsearch.scene.assembly import MovingMesh
from advsearch.scene.assets import Floats, Material, Mesh
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.parts import MeshPart

FLOAT, WHOLE = 5126, 5125
"""Types of numbers in glTF: float32 and uint32."""
CORNERS, INDICES = 34962, 34963
"""What a part of the buffer is for."""
COAT_ROUGHNESS = 0.316
"""Of Mitsuba's clearcoat, whose alpha is 0.1: the square root of it."""
PLAIN = 0.5
"""Specular of a surface whose index of refraction is 1.5."""


@dataclass(frozen=True, eq=False)
class PosedMesh:
    """A mesh as it is in a configuration.

    Attributes:
        name: of the part of the scene.
        mesh: in world space, z up.
        base_color: (h, w, 3) display-referred sRGB, row 0 at v = 1.
        material: the rest of the surface.
    """

    name: str
    mesh: Mesh
    base_color: Floats
    material: Material


def posed(part: MeshPart, inputs: Mapping[str, Tensor]) -> PosedMesh:
    """Return a mesh of a scene as its inputs have it.

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
    return PosedMesh(part.name, mesh, color, replace(part.material, **numbers))


def _of(key: str) -> str:
    return key.partition(".")[0]


def _rows(flat: Tensor) -> Floats:
    return flat.reshape(-1, 3).to(torch.float32).numpy()


def glb(meshes: Sequence[PosedMesh]) -> bytes:
    """Return a binary glTF file of some meshes."""
    made = _Buffer()
    header: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "advsearch"},
        "extensionsUsed": ["KHR_materials_clearcoat", "KHR_materials_specular"],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": one.name, "mesh": number} for number, one in enumerate(meshes)],
        "meshes": [],
        "materials": [],
        "textures": [{"source": number, "sampler": 0} for number in range(len(meshes))],
        "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 10497, "wrapT": 10497}],
        "images": [],
    }
    for number, one in enumerate(meshes):
        mesh = one.mesh
        corners = {
            "POSITION": made.accessor(_y_up(mesh.vertices), "VEC3", bounds=True),
            "NORMAL": made.accessor(_y_up(_unit(mesh.normals)), "VEC3"),
            "TEXCOORD_0": made.accessor(np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1), "VEC2"),
        }
        indices = made.accessor(mesh.faces.reshape(-1).astype(np.uint32), "SCALAR")
        header["meshes"].append(
            {"name": one.name, "primitives": [{"attributes": corners, "indices": indices, "material": number}]}
        )
        header["materials"].append(_material(one, number))
        header["images"].append({"mimeType": "image/png", "bufferView": made.view(_png(one.base_color))})
    header |= {"accessors": made.accessors, "bufferViews": made.views, "buffers": [{"byteLength": len(made.data)}]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = bytes(made.data)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(rest), 0x004E4942) + rest


class _Buffer:
    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append some bytes, whole words, and return the number of the view."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def accessor(self, values: npt.NDArray[Any], kind: str, *, bounds: bool = False) -> int:
        """Append an array and return the number of its accessor."""
        whole = values.dtype == np.uint32
        entry: dict[str, Any] = {
            "bufferView": self.view(np.ascontiguousarray(values).tobytes(), INDICES if whole else CORNERS),
            "componentType": WHOLE if whole else FLOAT,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def _material(one: PosedMesh, texture: int) -> dict[str, Any]:
    surface = one.material
    extensions: dict[str, Any] = {}
    if surface.specular != PLAIN:
        extensions["KHR_materials_specular"] = {"specularFactor": min(1.0, surface.specular / PLAIN)}
    if surface.clearcoat > 0.0:
        extensions["KHR_materials_clearcoat"] = {
            "clearcoatFactor": surface.clearcoat,
            "clearcoatRoughnessFactor": COAT_ROUGHNESS,
        }
    return {
        "name": one.name,
        "doubleSided": True,
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
    Image.fromarray(np.uint8(np.clip(color, 0.0, 1.0) * 255.0 + 0.5)).save(file, "PNG")
    return file.getvalue()
