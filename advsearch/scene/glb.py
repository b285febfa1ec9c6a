"""Writer of binary glTF 2.0 (.glb): one node for each mesh, textures as PNG or JPEG.

Up is +y. The front, which is our +x, is +z, as the format requires (glTF 2.0, section
3.4).

Materials have the parameters of the principled surface (glTF 2.0, section 3.9, and the
extensions KHR_materials_specular and KHR_materials_clearcoat). A specular of 0.5
reflects 4 % at normal incidence, as glTF's default does.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.pictures import encode_levels
from advsearch.scene.assets import Float32Array, Float64Array, Material, Shape
from advsearch.scene.color import linear_to_srgb

# ---- The buffer of a binary glTF file, and the file around it ----

# Component types: float32, uint32 and uint16.
FLOAT = 5126
UNSIGNED_INT = 5125
UNSIGNED_SHORT = 5123
# Targets of buffer views: vertex attributes, and indices.
ARRAY_BUFFER = 34962
ELEMENT_ARRAY_BUFFER = 34963
COMPONENT_TYPES = {
    np.dtype(np.uint32): UNSIGNED_INT,
    np.dtype(np.uint16): UNSIGNED_SHORT,
}
"""Types of components by NumPy's types of integers; all others are `FLOAT`."""


def find_mime_type(image_file: bytes) -> str:
    """Return the MIME type of a PNG or JPEG file."""
    return "image/png" if image_file.startswith(b"\x89PNG") else "image/jpeg"


class GlbBuffer:
    """The binary buffer of a glTF file, with its views and accessors.

    Bytes that are already in it are not added again.

    Attributes:
        data: the bytes of the buffer.
        views: entries of the buffer views in the document.
        accessors: entries of the accessors in the document.
    """

    def __init__(self) -> None:
        self.data = bytearray()
        self._view_of_data: dict[tuple[bytes, int | None], int] = {}
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add_view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, padded to four, and return the index of their view.

        Bytes that were added before with the same target keep their view.

        Args:
            data: the bytes.
            target: `ARRAY_BUFFER` for vertex attributes, `ELEMENT_ARRAY_BUFFER` for
                indices; None if the bytes are no geometry, such as an image.
        """
        key = (data, target)
        if key in self._view_of_data:
            return self._view_of_data[key]
        self._view_of_data[key] = len(self.views)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def add_accessor(
        self, values: npt.NDArray[Any], kind: str, *, bounds: bool = False
    ) -> int:
        """Append an array and return the index of its accessor.

        Args:
            values: (N,) or (N, width); float32 for vertex attributes, uint32 or uint16
                for indices.
            kind: glTF's type of a row, such as "VEC3".
            bounds: whether minimum and maximum are written too, which glTF requires of
                positions.
        """
        component_type = COMPONENT_TYPES.get(values.dtype, FLOAT)
        target = ARRAY_BUFFER if component_type == FLOAT else ELEMENT_ARRAY_BUFFER
        view = self.add_view(np.ascontiguousarray(values).tobytes(), target)
        entry: dict[str, Any] = {
            "bufferView": view,
            "componentType": component_type,
            "count": len(values),
            "type": kind,
        }
        if bounds:
            entry["min"] = values.min(axis=0).tolist()
            entry["max"] = values.max(axis=0).tolist()
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def to_bytes(self, header: dict[str, Any]) -> bytes:
        """Return the complete .glb file: a header, then JSON, then binary data.

        Args:
            header: the glTF document. The entries that describe the buffer are added to
                this dictionary.
        """
        header |= {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)  # a chunk has a multiple of 4 bytes
        binary = bytes(self.data)
        # The file's header has 12 bytes, and that of each of the two chunks 8. The two
        # numbers below are the chunk types "JSON" and "BIN".
        size = 28 + len(text) + len(binary)
        file_header = struct.pack("<4sIIII", b"glTF", 2, size, len(text), 0x4E4F534A)
        chunk_header = struct.pack("<II", len(binary), 0x004E4942)
        return file_header + text + chunk_header + binary


ByteImage = npt.NDArray[np.uint8]
# Square root of the alpha of Mitsuba's clearcoat, 0.1.
COAT_ROUGHNESS = 0.316
DEFAULT_SPECULAR = 0.5  # specular of a surface whose index of refraction is 1.5
# Limit of the sides of a texture in a file for the web, and the quality of its JPEG.
WEB_TEXTURE_SIZE = 1024
WEB_QUALITY = 90
# Filter and wrap mode of textures, as OpenGL numbers them.
LINEAR = 9729
REPEAT = 10497
# Entry of a camera. Viewers need only the pose of its node; its numbers are examples.
CAMERA_ENTRY = {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.01}}


def encode_glb(meshes: Sequence[Shape]) -> bytes:
    """Return meshes as a binary glTF file with PNG textures."""
    buffer = GlbBuffer()
    return buffer.to_bytes(_make_document(buffer, meshes, encode_levels))


def encode_web_glb(
    adversarial: Sequence[Shape],
    clean: Sequence[Shape],
    camera: Float64Array,
    note: str = "",
) -> bytes:
    """Return a small .glb file with two scenes, "adversarial" and "clean".

    Data that are the same in both scenes are stored once.

    Args:
        adversarial: meshes of the first scene.
        clean: meshes of the second scene.
        camera: (4, 4) pose of a camera, which looks along its +z.
        note: text for readers, in `asset.extras`.
    """
    buffer = GlbBuffer()
    document = _make_document(buffer, [*adversarial, *clean], _encode_jpeg)
    document["cameras"] = [CAMERA_ENTRY]
    document["nodes"].append(_make_camera_node(camera))
    n_adversarial = len(adversarial)
    camera_node = len(document["nodes"]) - 1
    document["scenes"] = [
        {"name": "adversarial", "nodes": [*range(n_adversarial), camera_node]},
        {"name": "clean", "nodes": list(range(n_adversarial, camera_node))},
    ]
    if note:
        document["asset"]["extras"] = {"note": note}
    return buffer.to_bytes(document)


def _make_camera_node(camera: Float64Array) -> dict[str, Any]:
    """Return the node of a camera with a pose (4, 4), which looks along its +z."""
    # (4, 3) vectors: the camera's axes to the left, up and ahead, then its position.
    # These are the columns of the pose.
    pose_columns = camera[:3].T.astype(np.float32)
    # glTF's cameras look along their -z, with +x to the right. So the axes to the left
    # and ahead are reversed.
    signs = np.array([[-1.0], [1.0], [-1.0], [1.0]], np.float32)
    # glTF stores a matrix column by column, so that its columns are rows here.
    transposed_matrix = np.eye(4)
    transposed_matrix[:, :3] = _to_y_up(pose_columns * signs)
    matrix = transposed_matrix.ravel().tolist()
    return {"name": "camera", "camera": 0, "matrix": matrix}


def _make_document(
    buffer: GlbBuffer,
    meshes: Sequence[Shape],
    encode_image: Callable[[ByteImage], bytes],
) -> dict[str, Any]:
    """Return the glTF document (the JSON part) of a file of meshes.

    Nodes, meshes and materials are in the order of the shapes. All nodes are in one
    scene.

    Args:
        buffer: the binary part; geometry and image files are appended to it.
        meshes: meshes, each of which gets a node.
        encode_image: encodes an image (H, W, 3) as a JPEG or PNG file.
    """
    document = _make_empty_document(meshes)
    for index, shape in enumerate(meshes):
        primitive = {**_add_geometry(buffer, shape), "material": index}
        document["meshes"].append({"name": shape.name, "primitives": [primitive]})
        document["materials"].append(
            _add_material(document, buffer, shape, encode_image)
        )
    extensions = _list_extensions(document["materials"])
    if extensions:
        document["extensionsUsed"] = extensions
    return document


def _make_empty_document(meshes: Sequence[Shape]) -> dict[str, Any]:
    """Return a document with the nodes of meshes, but not yet the meshes themselves."""
    return {
        "asset": {"version": "2.0", "generator": "advsearch"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [
            {"name": shape.name, "mesh": index} for index, shape in enumerate(meshes)
        ],
        "meshes": [],
        "materials": [],
        "textures": [],
        "samplers": [
            {
                "magFilter": LINEAR,
                "minFilter": LINEAR,
                "wrapS": REPEAT,
                "wrapT": REPEAT,
            }
        ],
        "images": [],
    }


def _list_extensions(materials: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the sorted names of the extensions that materials use."""
    return sorted(
        {name for material in materials for name in material.get("extensions", ())}
    )


def _add_geometry(buffer: GlbBuffer, shape: Shape) -> dict[str, Any]:
    """Add the mesh of a shape to a buffer, and return its primitive.

    The mesh is converted to glTF's axes, with y up. v becomes 1 - v, since glTF's is 0
    at the top. glTF requires unit normals, so that a normal of length 0 becomes +z.
    Indices have 16 bits if that suffices.
    """
    mesh = shape.mesh
    normals = _make_unit_normals(mesh.normals)
    uvs = np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1)
    attributes = {
        "POSITION": buffer.add_accessor(_to_y_up(mesh.vertices), "VEC3", bounds=True),
        "NORMAL": buffer.add_accessor(_to_y_up(normals), "VEC3"),
        "TEXCOORD_0": buffer.add_accessor(uvs, "VEC2"),
    }
    is_large = len(mesh.vertices) > np.iinfo(np.uint16).max
    index_type = np.uint32 if is_large else np.uint16
    indices = buffer.add_accessor(mesh.faces.reshape(-1).astype(index_type), "SCALAR")
    return {"attributes": attributes, "indices": indices}


def _make_unit_normals(normals: Float32Array) -> Float32Array:
    """Return normals (V, 3) of length 1; one of length 0 becomes +z."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    unit_normals = normals / np.maximum(lengths, 1e-12)
    upwards = np.eye(3)[2]
    unit_or_upward: Float32Array = np.where(
        lengths > 0.0, unit_normals, upwards
    ).astype(np.float32)
    return unit_or_upward


def _add_material(
    document: dict[str, Any],
    buffer: GlbBuffer,
    shape: Shape,
    encode_image: Callable[[ByteImage], bytes],
) -> dict[str, Any]:
    """Return the material of a shape; its images go to the buffer and the document.

    Args:
        document: the glTF document; entries of images and textures are appended.
        buffer: the binary part; image files are appended.
        shape: the mesh with its surface.
        encode_image: encodes an image (H, W, 3). An image with opacity is always PNG.
    """
    color = _to_bytes(shape.base_color)
    if shape.opacity is None:
        encoded = encode_image(color)
    else:
        encoded = _encode_png_with_alpha(color, _to_bytes(shape.opacity))
    material = _make_material(shape, _add_texture(document, buffer, encoded))
    if shape.normal_map is not None:
        normals = encode_image(_to_bytes(shape.normal_map))
        material["normalTexture"] = _add_texture(document, buffer, normals)
    if shape.emission is not None:
        _add_emission_texture(document, buffer, material, shape.emission, encode_image)
    return material


def _add_emission_texture(
    document: dict[str, Any],
    buffer: GlbBuffer,
    material: dict[str, Any],
    emission: Float32Array,
    encode_image: Callable[[ByteImage], bytes],
) -> None:
    """Add light (H, W, 3) to a material; the others are those of `_add_material`."""
    strength = float(emission.max())
    relative = linear_to_srgb(emission / np.float32(strength))
    image = encode_image(_to_bytes(relative))
    _set_emission(material, _add_texture(document, buffer, image), strength)


def _set_emission(
    material: dict[str, Any], texture: dict[str, int], strength: float
) -> None:
    """Set the light of a material.

    A texture's values are at most 1: the texture has the emission divided by its
    maximum, and an extension has the maximum, `strength`.
    """
    material["emissiveFactor"] = [1.0, 1.0, 1.0]
    material["emissiveTexture"] = texture
    extensions = material.setdefault("extensions", {})
    extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}


def _add_texture(
    document: dict[str, Any], buffer: GlbBuffer, image_file: bytes
) -> dict[str, int]:
    """Add an image file as a texture, and return the reference to it.

    Each texture has an image of its own, which has the same index in its list.
    """
    document["images"].append(
        {
            "mimeType": find_mime_type(image_file),
            "bufferView": buffer.add_view(image_file),
        }
    )
    index = len(document["textures"])
    document["textures"].append({"source": index, "sampler": 0})
    return {"index": index}


def _make_material(shape: Shape, texture: dict[str, int]) -> dict[str, Any]:
    """Return the material of a shape with a texture of its base color.

    If all opacities are 0 or 1, they are written as a mask, otherwise as blending.
    Extensions are written only if the surface differs from glTF's default. A specular
    above `DEFAULT_SPECULAR` is cut to it, since glTF's factor is at most 1.

    Args:
        shape: the mesh with its surface.
        texture: glTF's reference to the texture, such as {"index": 0}.
    """
    surface = shape.material
    material: dict[str, Any] = {"name": shape.name, "doubleSided": True}
    if shape.opacity is not None:
        is_binary = set(np.unique(shape.opacity)) <= {0.0, 1.0}
        material["alphaMode"] = "MASK" if is_binary else "BLEND"
    material["pbrMetallicRoughness"] = {
        "baseColorTexture": texture,
        "roughnessFactor": surface.roughness,
        "metallicFactor": surface.metallic,
    }
    extensions = _make_extensions(surface)
    if extensions:
        material["extensions"] = extensions
    return material


def _make_extensions(surface: Material) -> dict[str, Any]:
    """Return the extensions of a material for what differs from glTF's default."""
    extensions: dict[str, Any] = {}
    if surface.specular != DEFAULT_SPECULAR:
        extensions["KHR_materials_specular"] = {
            "specularFactor": min(1.0, surface.specular / DEFAULT_SPECULAR)
        }
    if surface.clearcoat > 0.0:
        extensions["KHR_materials_clearcoat"] = {
            "clearcoatFactor": surface.clearcoat,
            "clearcoatRoughnessFactor": COAT_ROUGHNESS,
        }
    return extensions


def _to_y_up(vectors: Float32Array) -> Float32Array:
    """Rotate vectors (N, 3) from z up and +x ahead to y up and +z ahead."""
    return np.stack([vectors[:, 1], vectors[:, 2], vectors[:, 0]], axis=1).astype(
        np.float32
    )


def _to_bytes(color: Float32Array) -> ByteImage:
    """Quantize values in [0, 1] to 8 bits."""
    levels: ByteImage = np.uint8(np.clip(color, 0.0, 1.0) * 255.0 + 0.5)
    return levels


def _encode_png_with_alpha(color: ByteImage, opacity: ByteImage) -> bytes:
    """Encode colors (H, W, 3) with an opacity, resized to their size, as PNG."""
    image = Image.fromarray(color)
    image.putalpha(
        Image.fromarray(opacity).resize(image.size, Image.Resampling.BILINEAR)
    )
    return encode_levels(np.asarray(image))


def _encode_jpeg(color: ByteImage) -> bytes:
    """Encode colors (H, W, 3) as JPEG, reduced to the size for the web."""
    file = io.BytesIO()
    image = Image.fromarray(color)
    image.thumbnail((WEB_TEXTURE_SIZE, WEB_TEXTURE_SIZE))
    image.save(file, "JPEG", quality=WEB_QUALITY, subsampling=0)
    return file.getvalue()
