"""Meshes as binary glTF 2.0 (.glb): one node a mesh, its texture inside as a PNG or
JPEG file of 8 bits.

Up is +y, and the front, our +x, is +z, as the format says of an asset (glTF 2.0,
section 3.4).

Materials have the numbers of the principled surface (glTF 2.0, section 3.9, and the
extensions KHR_materials_specular and KHR_materials_clearcoat): a specular of 0.5
reflects 4 % at normal incidence, as glTF's default does.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.pictures import png_of
from advsearch.scene.assets import Doubles, Floats, Shape
from advsearch.scene.color import linear_to_srgb

# ---- The buffer of a binary glTF file, and the file around it
# -------------------------------------------------------

FLOAT = 5126  # types of numbers in glTF: float32, uint32 and uint16
WHOLE = 5125
SHORT = 5123
CORNERS = 34962  # what a part of the buffer is for
INDICES = 34963


def mime_type(picture: bytes) -> str:
    """Return the kind of a PNG or JPEG file, as glTF calls it."""
    return "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"


class GlbBuffer:
    """The bytes of a file and where in them what is; bytes that are there already are
    not added again.
    """

    def __init__(self) -> None:
        self.data = bytearray()
        self._known: dict[tuple[bytes, int | None], int] = {}
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append some bytes, whole words, and return the number of the view."""
        if (data, target) in self._known:
            return self._known[data, target]
        self._known[data, target] = len(self.views)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def accessor(
        self, values: npt.NDArray[Any], kind: str, *, bounds: bool = False
    ) -> int:
        """Append an array and return the number of its accessor."""
        number = {np.dtype(np.uint32): WHOLE, np.dtype(np.uint16): SHORT}.get(
            values.dtype, FLOAT
        )
        view = self.view(
            np.ascontiguousarray(values).tobytes(),
            CORNERS if number == FLOAT else INDICES,
        )
        entry: dict[str, Any] = {
            "bufferView": view,
            "componentType": number,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            entry |= {
                "min": values.min(axis=0).tolist(),
                "max": values.max(axis=0).tolist(),
            }
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def file(self, header: dict[str, Any]) -> bytes:
        """Return the whole file with a header that says all but what is in the
        buffer.
        """
        header |= {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        rest = bytes(self.data)
        head = struct.pack(
            "<4sIIII", b"glTF", 2, 28 + len(text) + len(rest), len(text), 0x4E4F534A
        )
        return head + text + struct.pack("<II", len(rest), 0x004E4942) + rest


Levels = npt.NDArray[np.uint8]
# of Mitsuba's clearcoat, whose alpha is 0.1: the square root of it
COAT_ROUGHNESS = 0.316
PLAIN = 0.5  # specular of a surface whose index of refraction is 1.5
# longest side of a texture in a file for the web, and the quality of its JPEG
WEB_SIDE = 1024
WEB_QUALITY = 90
# its place counts
CAMERA = {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.01}}


def glb(meshes: Sequence[Shape]) -> bytes:
    made = GlbBuffer()
    return made.file(_described(made, meshes, png_of))


def web_glb(
    adversarial: Sequence[Shape],
    clean: Sequence[Shape],
    camera: Doubles,
    note: str = "",
) -> bytes:
    """Return a small file with two scenes, the adversarial one and "clean": what is the
    same in both is there once; with the camera of pose (4, 4), which looks along its
    own +z, and a note for readers in `asset.extras`.
    """
    made = GlbBuffer()
    count = len(adversarial)
    header = _described(made, [*adversarial, *clean], _jpeg)
    ours = camera[:3].T.astype(np.float32)  # rows: its axes, then its place
    columns = np.eye(4)
    # glTF's look along their -z
    columns[:, :3] = _y_up(ours * np.array([[-1.0], [1.0], [-1.0], [1.0]], np.float32))
    header["cameras"] = [CAMERA]
    header["nodes"].append(
        {"name": "camera", "camera": 0, "matrix": columns.ravel().tolist()}
    )
    first = list(range(count))
    last = len(header["nodes"]) - 1
    header["scenes"] = [
        {"name": "adversarial", "nodes": [*first, last]},
        {"name": "clean", "nodes": list(range(count, last))},
    ]
    header["asset"] |= {"extras": {"note": note}} if note else {}
    return made.file(header)


def _described(
    made: GlbBuffer, meshes: Sequence[Shape], picture: Callable[[Levels], bytes]
) -> dict[str, Any]:
    header: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "advsearch"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [
            {"name": shape.name, "mesh": number} for number, shape in enumerate(meshes)
        ],
        "meshes": [],
        "materials": [],
        "textures": [],
        "samplers": [
            {"magFilter": 9729, "minFilter": 9729, "wrapS": 10497, "wrapT": 10497}
        ],
        "images": [],
    }
    for number, shape in enumerate(meshes):
        mesh = shape.mesh
        lengths = np.linalg.norm(mesh.normals, axis=1, keepdims=True)
        normals = np.where(
            lengths > 0.0, mesh.normals / np.maximum(lengths, 1e-12), np.eye(3)[2]
        ).astype(np.float32)
        corners = {
            "POSITION": made.accessor(_y_up(mesh.vertices), "VEC3", bounds=True),
            "NORMAL": made.accessor(_y_up(normals), "VEC3"),
            "TEXCOORD_0": made.accessor(
                np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1), "VEC2"
            ),
        }
        whole = np.uint32 if len(mesh.vertices) > np.iinfo(np.uint16).max else np.uint16
        indices = made.accessor(mesh.faces.reshape(-1).astype(whole), "SCALAR")
        primitive = {"attributes": corners, "indices": indices, "material": number}
        header["meshes"].append({"name": shape.name, "primitives": [primitive]})
        levels = _levels(shape.base_color)
        encoded = (
            picture(levels)
            if shape.opacity is None
            else _cut_out_png(levels, _levels(shape.opacity))
        )
        material = _material(shape, _texture(header, made, encoded))
        if shape.normal_map is not None:
            material["normalTexture"] = _texture(
                header, made, picture(_levels(shape.normal_map))
            )
        if shape.emission is not None:
            most = float(shape.emission.max())
            material["emissiveFactor"] = [1.0, 1.0, 1.0]
            share = linear_to_srgb(shape.emission / np.float32(most))
            material["emissiveTexture"] = _texture(
                header, made, picture(_levels(share))
            )
            material.setdefault("extensions", {})["KHR_materials_emissive_strength"] = {
                "emissiveStrength": most
            }
        header["materials"].append(material)
    used = sorted(
        {
            name
            for material in header["materials"]
            for name in material.get("extensions", ())
        }
    )
    return {**header, "extensionsUsed": used} if used else header


def _texture(header: dict[str, Any], made: GlbBuffer, picture: bytes) -> dict[str, int]:
    header["images"].append(
        {"mimeType": mime_type(picture), "bufferView": made.view(picture)}
    )
    header["textures"].append({"source": len(header["textures"]), "sampler": 0})
    return {"index": len(header["textures"]) - 1}


def _material(shape: Shape, texture: dict[str, int]) -> dict[str, Any]:
    surface = shape.material
    material: dict[str, Any] = {"name": shape.name, "doubleSided": True}
    if shape.opacity is not None:
        material["alphaMode"] = (
            "MASK" if set(np.unique(shape.opacity)) <= {0.0, 1.0} else "BLEND"
        )
    numbers = {"roughnessFactor": surface.roughness, "metallicFactor": surface.metallic}
    material["pbrMetallicRoughness"] = {"baseColorTexture": texture, **numbers}
    extensions: dict[str, Any] = {}
    if surface.specular != PLAIN:
        extensions["KHR_materials_specular"] = {
            "specularFactor": min(1.0, surface.specular / PLAIN)
        }
    if surface.clearcoat > 0.0:
        coat = {
            "clearcoatFactor": surface.clearcoat,
            "clearcoatRoughnessFactor": COAT_ROUGHNESS,
        }
        extensions["KHR_materials_clearcoat"] = coat
    return {**material, "extensions": extensions} if extensions else material


def _y_up(vectors: Floats) -> Floats:
    """Turn (N, 3) from z up and +x ahead to y up and +z ahead."""
    return np.stack([vectors[:, 1], vectors[:, 2], vectors[:, 0]], axis=1).astype(
        np.float32
    )


def _levels(color: Floats) -> Levels:
    levels: Levels = np.uint8(np.clip(color, 0.0, 1.0) * 255.0 + 0.5)
    return levels


def _cut_out_png(color: Levels, opacity: Levels) -> bytes:
    picture = Image.fromarray(color)
    picture.putalpha(
        Image.fromarray(opacity).resize(picture.size, Image.Resampling.BILINEAR)
    )
    return png_of(np.asarray(picture))


def _jpeg(color: Levels) -> bytes:
    file = io.BytesIO()
    picture = Image.fromarray(color)
    picture.thumbnail((WEB_SIDE, WEB_SIDE))
    picture.save(file, "JPEG", quality=WEB_QUALITY, subsampling=0)
    return file.getvalue()
