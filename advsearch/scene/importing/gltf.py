"""glTF files: the header, read strictly and held to limits, and the numbers in their
buffers.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from advsearch.errors import FileFormatError
from advsearch.files import JsonValue
from advsearch.scene.assets import Doubles, Ints
from advsearch.scene.importing.files import (
    SPLATS,
    check_faces,
    damaged,
    find_kind,
    looks_like,
    shown,
    text_of,
)
from advsearch.scene.importing.gltf_entries import Asset, Entry, Header, Primitive
from advsearch.trust.named_files import References, plain_name
from advsearch.trust.stored_files import JsonBoundsError, check_most, parse_json

MOST_VALUES = 1_000_000
"""Lists, objects and values in a header; each takes hundreds of bytes of memory, and
may take two of the file.
"""


def read_header(path: Path, data: bytes) -> Header:
    """Return the header of a .gltf or .glb file. Raises FileFormatError: the file is
    not glTF, is shorter than it says, has other types in its header than glTF has,
    refers to what is not there, is over a limit, or needs what is not supported.
    """
    chunk = _chunks(path, data)[0]
    text = text_of(chunk)
    check_most(
        path,
        sum(map(text.count, ",[{")),
        MOST_VALUES,
        "a glTF header of at most {} values",
        "more",
    )
    try:
        content = parse_json(text)
    except ValueError as error:
        otherwise = (
            str(error) if isinstance(error, JsonBoundsError) else "something else"
        )
        raise damaged(
            path, "glTF with a JSON header", find_kind(chunk) or otherwise
        ) from None
    if not isinstance(content, dict) or "asset" not in content:
        raise damaged(path, "glTF with an 'asset' entry", "other JSON")
    try:
        version = Asset.model_validate(content["asset"]).version
        if version.split(".")[0] != "2":
            raise damaged(path, "glTF of version 2", f"version {shown(version)}")
        header = Header.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = "".join(
            f"[{part}]" if isinstance(part, int) else f".{part}"
            for part in first["loc"]
        ).lstrip(".")
        if first["type"] == "missing":
            raise damaged(path, f"glTF with {place}", "nothing") from None
        needed = first["msg"].removeprefix("Input should be ").removeprefix("Field ")
        got = shown(json.dumps(first["input"], default=str))
        raise damaged(path, f"glTF whose {place} is {needed}", got) from None
    extensions: set[str] = set()
    level: list[JsonValue] = [content]
    while level:
        entry = level.pop()
        if isinstance(entry, list):
            level.extend(entry)
        elif isinstance(entry, dict):
            held = {} if entry.get("extensions") is None else entry["extensions"]
            if not isinstance(held, dict) or not all(
                isinstance(held.get(name) or {}, dict) for name in READ
            ):
                raise damaged(
                    path, "glTF whose extensions are objects", shown(json.dumps(held))
                )
            extensions.update(held)
            level.extend(value for key, value in entry.items() if key != "extras")
    for number, (node, entry) in enumerate(
        zip(header.nodes, content.get("nodes", ()), strict=True)
    ):
        if (
            node.lamp is None
            and (entry.get("extensions") or {}).get("KHR_lights_punctual") is not None
        ):
            raise damaged(
                path,
                f"glTF with nodes[{number}].extensions.KHR_lights_punctual.light",
                "nothing",
            )
    header = header.model_copy(
        update={"extensionsUsed": sorted({*header.extensionsUsed, *extensions})}
    )
    check_header(path, header)
    return header


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """Return the header of a file as text, and what follows it in a .glb file; None
    where nothing does.
    """
    if path.suffix.lower() == ".gltf":
        return data, None
    if not data.startswith(b"glTF") or len(data) < 20:
        got = (
            "the first few bytes of one"
            if data.startswith(b"glTF")
            else looks_like(data)
        )
        raise damaged(path, "a binary glTF file", got)
    version, length, chunk, kind = struct.unpack_from("<4xIII4s", data)
    if version != 2:
        raise damaged(path, "binary glTF of version 2", f"version {version}")
    if length > len(data):
        raise damaged(
            path,
            f"{length} bytes, as its header says",
            f"{len(data)}; the file is cut short",
        )
    if kind != b"JSON" or 20 + chunk > length:
        raise damaged(
            path,
            "a chunk of JSON first",
            f"{chunk} bytes of {shown(kind.decode('latin-1'))}",
        )
    start = 28 + chunk
    rest = None
    if start <= length:
        size, kind = struct.unpack_from("<I4s", data, start - 8)
        rest = data[start : min(start + size, length)] if kind == b"BIN\0" else None
    return data[20 : 20 + chunk].rstrip(b"\0"), rest  # some pad with zeros


LARGEST_VALUES = 1 << 28
"""Bytes that all views, and all accessors, of a file may have; they may overlap, so its
size says nothing.
"""
LARGEST_TREE = 20_000  # nodes, and pieces of geometry at their places, in one file
DEEPEST_TREE = 500  # nodes from the root to a leaf
READ = tuple(
    "EXT_texture_webp KHR_lights_punctual KHR_materials_emissive_strength "
    "KHR_materials_pbrSpecularGlossiness "
    "KHR_mesh_quantization KHR_texture_transform VRM VRMC_vrm".split()
)
"""Extensions that are understood."""
_LOOKS = ("KHR_materials_", "KHR_xmp")
"""Beginnings of those without which a file looks otherwise and has the same geometry:
they are named in warnings.
"""


def is_of_splats(name: str) -> bool:
    """Whether an extension or an attribute holds Gaussian splats:
    KHR_gaussian_splatting, and those that pack it.
    """
    return "gaussian_splat" in name.lower()


def check_header(path: Path, header: Header) -> None:
    """Check what the types leave open: extensions, limits, and that whatever is
    referred to is there. Raises FileFormatError: the header needs what is not
    supported, refers to what is not there, or is over a limit.
    """
    needed = sorted(
        name
        for name in header.extensionsRequired
        if name not in READ and not name.startswith(_LOOKS)
    )
    if needed:
        raise _needs(path, needed)
    for entry in header.entries():
        for kind, index in entry.references():
            if index >= (count := len(getattr(header, kind))):
                raise damaged(
                    path, f"glTF with {index + 1} {kind}, as it refers to", f"{count}"
                )
    for animation in header.animations:
        most = max((channel.curve for channel in animation.channels), default=-1)
        count = len(animation.samplers)
        if most >= count:
            raise damaged(
                path,
                f"glTF with {most + 1} samplers of an animation, as it refers to",
                f"{count}",
            )
    sizes = (
        entry.count * entry.width * np.dtype(_TYPES[entry.componentType]).itemsize
        for entry in header.accessors
    )
    size = max(sum(view.byteLength for view in header.bufferViews), sum(sizes))
    check_most(path, size, LARGEST_VALUES, "geometry and pictures of at most {} bytes")
    for mesh in header.meshes:
        for primitive in mesh.primitives:
            _check_primitive(path, header, primitive)
    _check_tree(path, header)


def _needs(path: Path, names: Iterable[str]) -> FileFormatError:
    names = list(names)
    if any(map(is_of_splats, names)):
        return FileFormatError(f"{path}: needs Gaussian splats, a model that {SPLATS}")
    named = shown(", ".join(names), quoted=False)
    return FileFormatError(
        f"{path}: needs {named}, which is not supported; export it without that option"
    )


def unread_extensions(entry: Entry) -> list[str]:
    """Return the names of an entry's extensions that are not understood."""
    held = entry.extensions
    return (
        sorted(name for name in held if name not in READ)
        if isinstance(held, dict)
        else []
    )


def _check_primitive(path: Path, header: Header, primitive: Primitive) -> None:
    held = {
        name: header.accessors[index] for name, index in primitive.attributes.items()
    }
    coordinates = (
        "TEXCOORD_0"
        if primitive.material is None
        else header.materials[primitive.material].attribute
    )
    kinds_of = {
        "POSITION": ("VEC3",),
        "NORMAL": ("VEC3",),
        "COLOR_0": ("VEC3", "VEC4"),
        coordinates: ("VEC2",),
    }
    for name, kinds in kinds_of.items():
        if name in held and held[name].type not in kinds:
            raise damaged(path, f"{name} of type {' or '.join(kinds)}", held[name].type)
        if (
            name in held
            and "POSITION" in held
            and held[name].count != held["POSITION"].count
        ):
            expected = (
                f"as many values of {name} as of POSITION, {held['POSITION'].count:,}"
            )
            raise damaged(path, expected, f"{held[name].count:,}")
    indices = None if primitive.indices is None else header.accessors[primitive.indices]
    for values in (*held.values(), indices):
        bare = (
            values is not None and values.bufferView is None and values.sparse is None
        )
        unread = unread_extensions(primitive)
        is_packed = bare and unread and not any(map(is_of_splats, unread))
        if is_packed:  # an extension has the numbers, as Draco's
            raise _needs(path, unread)
    if indices is not None and indices.type != "SCALAR":
        raise damaged(path, "indices of type SCALAR", indices.type)
    if indices is not None and indices.componentType not in (5121, 5123, 5125):
        raise damaged(path, "indices that are unsigned integers", "other numbers")


def _check_tree(path: Path, header: Header) -> None:
    def triangles_of(primitive: Primitive) -> int:  # at most
        index = (
            primitive.attributes.get("POSITION")
            if primitive.indices is None
            else primitive.indices
        )
        count = (
            0 if index is None or primitive.mode < 4 else header.accessors[index].count
        )
        return count // 3 if primitive.mode == 4 else max(0, count - 2)

    triangles = [sum(map(triangles_of, mesh.primitives)) for mesh in header.meshes]
    pieces = [len(mesh.primitives) for mesh in header.meshes]
    drawn = [node.mesh for node in header.nodes if node.mesh is not None]
    parents: set[int] = set()
    for child in [child for node in header.nodes for child in node.children]:
        if child in parents:
            raise damaged(path, "nodes with one parent each", f"two for node {child}")
        parents.add(child)
    check_faces(path, max(sum(triangles[mesh] for mesh in drawn), sum(triangles)))
    most = max(sum(pieces[mesh] for mesh in drawn), sum(pieces), len(header.nodes))
    check_most(path, most, LARGEST_TREE, "glTF of at most {} nodes and pieces")
    level = [index for index in range(len(header.nodes)) if index not in parents]
    reached = 0
    depth = 0
    while level:
        check_most(path, depth + 1, DEEPEST_TREE, "nodes of at most {} levels", "more")
        depth = depth + 1
        reached = reached + len(level)
        level = [child for index in level for child in header.nodes[index].children]
    if reached < len(header.nodes):
        raise damaged(path, "nodes that form trees", "a cycle")


_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


class GltfFile:
    """A file: its header, and what that refers to, also in files that `references`
    finds. Raises FileFormatError: as `read_header`.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.header, self.references = (
            path,
            read_header(path, data),
            References(path),
        )
        self._chunk = _chunks(path, data)[1]
        self._read: dict[int, bytes] = {}
        self._put_in: dict[int, npt.NDArray[Any]] = {}

    def uri(self, uri: str) -> bytes:
        """Return what a URI holds, or the file in the folder that it names. Raises
        FileNotFoundError: there is no such file, or it must not be read; the references
        say which. Raises ValueError: base64 that is none.
        """
        if not uri.startswith("data:"):
            return self.references.get(uri)
        kind, _, content = uri.partition(",")
        data = unquote_to_bytes(content)
        return base64.b64decode(data) if kind.endswith(";base64") else data

    def view(self, index: int) -> memoryview:
        """Return the bytes of a view. Raises FileFormatError: they are not there."""
        view = self.header.bufferViews[index]
        number = view.buffer
        uri = self.header.buffers[view.buffer].uri
        if number not in self._read:
            try:
                if uri is None and (number > 0 or self._chunk is None):
                    views = [
                        view
                        for view in self.header.bufferViews
                        if view.buffer == number
                    ]
                    # as meshopt's
                    if unread := {
                        name for view in views for name in unread_extensions(view)
                    }:
                        raise _needs(self.path, sorted(unread))
                    raise damaged(self.path, f"a buffer {number} with content", "none")
                self._read[number] = (
                    self.uri(uri) if uri is not None else self._chunk or b""
                )
            except FileNotFoundError:
                name = plain_name(uri or "")
                reason = self.references.refused.get(name, "is missing")
                message = (
                    f"{self.path}: needs {shown(name)}, which {reason}; put "
                    "that "
                    "file beside it"
                )
                raise FileFormatError(message) from None
            except ValueError:
                raise damaged(
                    self.path, f"a buffer {number} in base64", "other text"
                ) from None
        data = self._read[number]
        end = view.byteOffset + view.byteLength
        if end > len(data):
            raise damaged(
                self.path,
                f"a buffer of at least {end:,} bytes",
                f"{len(data):,}; the file is cut short",
            )
        return memoryview(data)[view.byteOffset : end]

    def values(self, index: int) -> npt.NDArray[Any]:
        """Return the values (count, width) of an accessor as they are stored, those
        that are sparse put in. Raises FileFormatError: they reach beyond their view.
        """
        if index in self._put_in:
            return self._put_in[index]
        accessor = self.header.accessors[index]
        values = np.zeros(
            (accessor.count, accessor.width), _TYPES[accessor.componentType]
        )
        if accessor.bufferView is not None and accessor.count:
            stride = self.header.bufferViews[accessor.bufferView].byteStride
            values = self._array(
                accessor.bufferView,
                accessor.byteOffset,
                values.shape,
                values.dtype,
                stride,
            )
        if accessor.sparse is None or not accessor.sparse.count:
            return values
        places = accessor.sparse.indices
        fresh = accessor.sparse.values
        count = accessor.sparse.count
        if count > accessor.count:
            raise damaged(
                self.path, f"at most {accessor.count:,} sparse values", f"{count:,}"
            )
        kind = np.dtype(_TYPES[places.componentType])
        rows = self._array(places.bufferView, places.byteOffset, (count, 1), kind)[:, 0]
        if rows.max() >= accessor.count:
            raise damaged(
                self.path,
                f"sparse values at places under {accessor.count:,}",
                f"{int(rows.max()):,}",
            )
        values = np.array(values)
        values[rows] = self._array(
            fresh.bufferView, fresh.byteOffset, (count, accessor.width), values.dtype
        )
        self._put_in[index] = values
        return values

    def _array(
        self,
        view: int,
        offset: int,
        shape: tuple[int, int],
        kind: np.dtype[Any],
        stride: int | None = None,
    ) -> npt.NDArray[Any]:
        data = self.view(view)
        step = stride or shape[1] * kind.itemsize
        end = offset + (shape[0] - 1) * step + shape[1] * kind.itemsize
        if end > len(data):
            raise damaged(
                self.path, f"a view of at least {end:,} bytes", f"{len(data):,}"
            )
        values: npt.NDArray[Any] = np.ndarray(
            shape, kind, data, offset, (step, kind.itemsize)
        )
        return values

    def numbers(self, index: int, rows: Ints) -> Doubles:
        """Return rows (N,) of an accessor as (N, width), normalised integers as the
        numbers that they stand for.
        """
        values = self.values(index)[rows]
        numbers: Doubles = values.astype(np.float64)
        if not self.header.accessors[index].normalized or values.dtype.kind == "f":
            return numbers
        return np.asarray(numbers / np.iinfo(values.dtype).max).clip(-1.0)
