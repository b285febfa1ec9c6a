"""glTF files: their headers, checked strictly and against limits, and their buffers."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeGuard
from urllib.parse import unquote_to_bytes

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from advsearch.errors import FileFormatError
from advsearch.files import JsonValue
from advsearch.scene.assets import Float64Array, IntArray
from advsearch.scene.importing.files import (
    SPLATS_ADVICE,
    check_faces,
    damaged,
    decode_text,
    describe_content,
    detect_file_kind,
    format_name,
)
from advsearch.scene.importing.gltf_entries import (
    Accessor,
    Asset,
    Entry,
    Header,
    Primitive,
    Sparse,
)
from advsearch.trust.named_files import ReferencedFiles, normalize_name
from advsearch.trust.stored_files import JsonBoundsError, check_most, parse_json

MOST_VALUES = 1_000_000
"""Limit of the lists, objects and values in a header. Each needs only two bytes of the
file, but hundreds of bytes of memory.
"""


# sizes in a .glb file, bytes
_FILE_HEADER_SIZE = 12
_CHUNK_HEADER_SIZE = 8
_JSON_START = _FILE_HEADER_SIZE + _CHUNK_HEADER_SIZE


def read_header(path: Path, data: bytes) -> Header:
    """Read and check the header of a .gltf or .glb file.

    Raises:
        FileFormatError: the file is not glTF, is shorter than it states, has a header
            with wrong types or with references to missing entries, is over a limit, or
            needs an extension that is not supported.
    """
    json_chunk, _ = _split_chunks(path, data)
    content = _parse_content(path, json_chunk)
    header = _validate_header(path, content)
    present_extensions = _find_extensions(path, content)
    _check_node_lights(path, header, content)
    # Some files use extensions without listing them. The notes about extensions need
    # the complete list.
    all_used = sorted({*header.extensionsUsed, *present_extensions})
    header = header.model_copy(update={"extensionsUsed": all_used})
    check_header(path, header)
    return header


def _validate_header(path: Path, content: dict[str, Any]) -> Header:
    """Return the header that JSON describes, whose version and types are checked.

    Raises:
        FileFormatError: it is of another version, or an entry is invalid.
    """
    try:
        # `_parse_content` has checked that there is an asset.
        version = Asset.model_validate(content["asset"]).version
        if version.split(".")[0] != "2":
            raise damaged(path, "glTF of version 2", f"version {format_name(version)}")
        return Header.model_validate(content)
    except ValidationError as error:
        raise _make_entry_error(path, error) from None


def _check_node_lights(path: Path, header: Header, content: dict[str, Any]) -> None:
    """Raise FileFormatError if a node has a light's extension that names no light.

    Args:
        path: path of the file, for messages.
        header: header of the file, checked for its types.
        content: the JSON from which the header was made.
    """
    entries = zip(header.nodes, content.get("nodes", ()), strict=True)
    for index, (node, entry) in enumerate(entries):
        node_extensions = entry.get("extensions") or {}
        has_extension = node_extensions.get("KHR_lights_punctual") is not None
        # `lamp` is the index of the light, which the extension has to state.
        if has_extension and node.lamp is None:
            raise damaged(
                path,
                f"glTF with nodes[{index}].extensions.KHR_lights_punctual.light",
                "nothing",
            )


def _parse_content(path: Path, chunk: bytes) -> dict[str, Any]:
    """Parse the JSON of a header, which must have an asset.

    Raises:
        FileFormatError: it is too large, no JSON, or no glTF.
    """
    text = decode_text(chunk)
    _check_header_size(path, text)
    try:
        content = parse_json(text)
    except ValueError as error:
        raise _make_json_error(path, chunk, error) from None
    if not isinstance(content, dict) or "asset" not in content:
        raise damaged(path, "glTF with an 'asset' entry", "other JSON")
    return content


def _check_header_size(path: Path, text: str) -> None:
    """Check an upper bound for the number of values of a header, before it is parsed.

    Commas and opening brackets are counted.
    """
    # Each value follows a comma, or the bracket that begins its list or object.
    max_values = sum(text.count(character) for character in ",[{")
    check_most(
        path,
        max_values,
        MOST_VALUES,
        "a glTF header of at most {} values",
        "more",
    )


def _make_json_error(path: Path, chunk: bytes, error: ValueError) -> FileFormatError:
    """Return the error for a header that cannot be parsed.

    Args:
        path: path of the file.
        chunk: the header.
        error: error of the parser.
    """
    got = detect_file_kind(chunk)  # such as a web page; None if unknown
    if not got:
        is_over_limit = isinstance(error, JsonBoundsError)
        got = str(error) if is_over_limit else "something else"
    return damaged(path, "glTF with a JSON header", got)


def _make_entry_error(path: Path, error: ValidationError) -> FileFormatError:
    """Return the error for the first entry of a header that is invalid.

    It names the entry, as in "meshes[0].primitives[1].mode".
    """
    first_error = error.errors(include_url=False)[0]
    keys = (
        f"[{key}]" if isinstance(key, int) else f".{key}" for key in first_error["loc"]
    )
    location = "".join(keys).lstrip(".")
    if first_error["type"] == "missing":
        return damaged(path, f"glTF with {location}", "nothing")
    # pydantic's sentences, without their beginnings
    requirement = (
        first_error["msg"].removeprefix("Input should be ").removeprefix("Field ")
    )
    got = format_name(json.dumps(first_error["input"], default=str))
    return damaged(path, f"glTF whose {location} is {requirement}", got)


def _are_extensions(value: JsonValue) -> TypeGuard[dict[str, JsonValue]]:
    """Return whether a value is an object whose supported extensions are objects.

    Extensions that are not supported may be anything: nothing reads them.
    """
    return isinstance(value, dict) and all(
        isinstance(value.get(name) or {}, dict) for name in SUPPORTED_EXTENSIONS
    )


def _find_extensions(path: Path, content: JsonValue) -> set[str]:
    """Return the names of all extensions that entries of a header have.

    Raises:
        FileFormatError: some are no objects.
    """
    extensions: set[str] = set()
    # Walk through all lists and objects except `extras`, which may hold anything.
    pending: list[JsonValue] = [content]
    while pending:
        entry = pending.pop()
        if isinstance(entry, list):
            pending.extend(entry)
        elif isinstance(entry, dict):
            extensions.update(_get_extensions(path, entry))
            pending.extend(value for key, value in entry.items() if key != "extras")
    return extensions


def _get_extensions(path: Path, entry: dict[str, JsonValue]) -> dict[str, JsonValue]:
    """Return the extensions of an entry; raise FileFormatError if one is no object."""
    extensions = entry.get("extensions")
    if extensions is None:
        return {}
    if not _are_extensions(extensions):
        raise damaged(
            path,
            "glTF whose extensions are objects",
            format_name(json.dumps(extensions)),
        )
    return extensions


def _split_chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON of a file, and the binary chunk of a .glb file or None.

    A .glb has a header, then chunks with a header each (glTF 2.0, section 4.4).

    Raises:
        FileFormatError: it is no .glb of version 2, or shorter than it states.
    """
    if path.suffix.lower() == ".gltf":
        return data, None
    json_end, file_end = _find_json_end(path, data)
    binary = _read_binary_chunk(data, json_end, file_end)
    # Some writers pad the JSON with zeros.
    return data[_JSON_START:json_end].rstrip(b"\0"), binary


def _find_json_end(path: Path, data: bytes) -> tuple[int, int]:
    """Return the end of the JSON of a .glb file, and the end of the file as it states.

    Raises:
        FileFormatError: it is no .glb of version 2, or shorter than it states.
    """
    _check_file_start(path, data)
    version, length, json_size, kind = struct.unpack_from("<4xIII4s", data)
    if version != 2:
        raise damaged(path, "binary glTF of version 2", f"version {version}")
    _check_stated_length(path, length, data)
    json_end = _JSON_START + json_size
    if kind != b"JSON" or json_end > length:
        raise damaged(
            path,
            "a chunk of JSON first",
            f"{json_size} bytes of {format_name(kind.decode('latin-1'))}",
        )
    return json_end, length


def _check_file_start(path: Path, data: bytes) -> None:
    """Raise FileFormatError unless data begin as a .glb file does, up to its JSON."""
    has_magic = data.startswith(b"glTF")
    if not has_magic or len(data) < _JSON_START:
        got = "the first few bytes of one" if has_magic else describe_content(data)
        raise damaged(path, "a binary glTF file", got)


def _check_stated_length(path: Path, length: int, data: bytes) -> None:
    """Raise FileFormatError if a .glb file has fewer bytes than its header states."""
    if length > len(data):
        raise damaged(
            path,
            f"{length} bytes, as its header states",
            f"{len(data)}; the file is cut short",
        )


def _read_binary_chunk(data: bytes, chunk_start: int, file_end: int) -> bytes | None:
    """Return the content of the binary chunk of a .glb file; None if it has none.

    The content may be cut short; that is reported when it is read.

    Args:
        data: the bytes of the file.
        chunk_start: position of the chunk's header, which follows the JSON.
        file_end: end of the file, as it states.
    """
    content_start = chunk_start + _CHUNK_HEADER_SIZE
    if content_start > file_end:
        return None
    size, kind = struct.unpack_from("<I4s", data, chunk_start)
    if kind != b"BIN\0":
        return None
    return data[content_start : min(content_start + size, file_end)]


MAX_DATA_SIZE = 1 << 28
"""Limit of the bytes of all views, and of all accessors, of a file. They may overlap, so
that the size of the file does not limit them.
"""
LARGEST_TREE = 20_000  # limit of the nodes, and of the drawn primitives, of a file
DEEPEST_TREE = 500  # limit of the nodes from the root to a leaf
SUPPORTED_EXTENSIONS = tuple(
    "EXT_texture_webp KHR_lights_punctual KHR_materials_emissive_strength "
    "KHR_materials_pbrSpecularGlossiness "
    "KHR_mesh_quantization KHR_texture_transform VRM VRMC_vrm".split()
)
"""Extensions that are read, at least in part."""
_APPEARANCE_PREFIXES = ("KHR_materials_", "KHR_xmp")
"""Prefixes of extensions that change how a file looks, but not its geometry. If they are
not supported, a warning names them.
"""


def is_splat_name(name: str) -> bool:
    """Return whether an extension or attribute holds Gaussian splats.

    These are KHR_gaussian_splatting and the extensions that compress it.
    """
    return "gaussian_splat" in name.lower()


def _check_references(path: Path, header: Header) -> None:
    """Check that every entry to which a header refers is in the header.

    Raises:
        FileFormatError: an entry is missing.
    """
    for entry in header.iterate_entries():
        for kind, index in entry.iterate_references():
            count = len(getattr(header, kind))  # such as `header.meshes`
            if index >= count:
                raise damaged(
                    path, f"glTF with {index + 1} {kind}, as it refers to", f"{count}"
                )
    _check_channels(path, header)


def _check_channels(path: Path, header: Header) -> None:
    """Raise FileFormatError if a channel refers to a sampler that its clip lacks."""
    for animation in header.animations:
        sampler_indices = [channel.sampler_index for channel in animation.channels]
        max_index = max(sampler_indices, default=-1)
        n_samplers = len(animation.samplers)
        if max_index >= n_samplers:
            raise damaged(
                path,
                f"glTF with {max_index + 1} samplers of an animation, as it refers to",
                f"{n_samplers}",
            )


def check_header(path: Path, header: Header) -> None:
    """Check a header whose entries have the right types.

    Raises:
        FileFormatError: the header needs an extension that is not supported, refers to
            a missing entry, or is over a limit.
    """
    _check_required_extensions(path, header)
    _check_references(path, header)
    _check_data_size(path, header)
    for mesh in header.meshes:
        for primitive in mesh.primitives:
            _check_primitive(path, header, primitive)
    _check_tree(path, header)


def _check_required_extensions(path: Path, header: Header) -> None:
    """Raise FileFormatError if a file cannot be read without an unsupported extension.

    A file that requires an extension of its appearance is read without it.
    """
    unsupported = sorted(
        name
        for name in header.extensionsRequired
        if name not in SUPPORTED_EXTENSIONS
        and not name.startswith(_APPEARANCE_PREFIXES)
    )
    if unsupported:
        raise _make_unsupported_error(path, unsupported)


def _check_data_size(path: Path, header: Header) -> None:
    """Raise FileFormatError if the views, or the accessors, of a file have too many bytes.

    Both sums are limited. Accessors may share a view, or have none and be zeros, and
    views may also hold images, so neither sum bounds the other.
    """
    view_size = sum(view.byteLength for view in header.bufferViews)
    accessor_size = sum(map(_compute_accessor_size, header.accessors))
    check_most(
        path,
        max(view_size, accessor_size),
        MAX_DATA_SIZE,
        "geometry and pictures of at most {} bytes",
    )


def _compute_accessor_size(accessor: Accessor) -> int:
    """Return the number of bytes of all values of an accessor."""
    kind = np.dtype(_COMPONENT_TYPES[accessor.componentType])
    return accessor.count * accessor.width * kind.itemsize


def _make_unsupported_error(path: Path, names: Iterable[str]) -> FileFormatError:
    """Return the error for a file that needs extensions that are not supported."""
    names = list(names)
    if any(map(is_splat_name, names)):
        return FileFormatError(f"{path}: needs Gaussian splats: {SPLATS_ADVICE}")
    text = format_name(", ".join(names), quoted=False)
    return FileFormatError(
        f"{path}: needs {text}, which is not supported; export it without that option"
    )


def find_unread_extensions(entry: Entry) -> list[str]:
    """Return the names of an entry's extensions that are not read."""
    if not isinstance(entry.extensions, dict):
        return []
    return sorted(name for name in entry.extensions if name not in SUPPORTED_EXTENSIONS)


def _check_primitive(path: Path, header: Header, primitive: Primitive) -> None:
    """Check the accessors of a primitive.

    Types have to be those of the format, attributes need as many values as positions,
    and indices have to be unsigned integers. An accessor without data is an error if
    the primitive has an unsupported extension, which may hold the data in compressed
    form.

    Raises:
        FileFormatError: an accessor is wrong, or an extension is needed.
    """
    attributes = {
        name: header.accessors[index] for name, index in primitive.attributes.items()
    }
    indices = None if primitive.indices is None else header.accessors[primitive.indices]
    _check_attributes(path, header, primitive, attributes)
    unsupported = find_unread_extensions(primitive)
    # Gaussian splats are left out with a note instead.
    may_be_compressed = unsupported and not any(map(is_splat_name, unsupported))
    accessors = (*attributes.values(), indices)
    if may_be_compressed and any(map(_has_no_data, accessors)):  # Draco, for example
        raise _make_unsupported_error(path, unsupported)
    if indices is not None:
        _check_indices(path, indices)


def _has_no_data(accessor: Accessor | None) -> bool:
    """Return whether an accessor exists but has neither a buffer view nor sparse values."""
    return (
        accessor is not None and accessor.bufferView is None and accessor.sparse is None
    )


def _check_indices(path: Path, indices: Accessor) -> None:
    """Raise FileFormatError unless the accessor of indices has unsigned integers."""
    if indices.type != "SCALAR":
        raise damaged(path, "indices of type SCALAR", indices.type)
    # unsigned integers of 1, 2 and 4 bytes
    if indices.componentType not in (5121, 5123, 5125):
        raise damaged(path, "indices that are unsigned integers", "other numbers")


def _check_attributes(
    path: Path,
    header: Header,
    primitive: Primitive,
    attributes: dict[str, Accessor],
) -> None:
    """Check types and counts of the attributes of a primitive that are read.

    Args:
        path: path of the file, for messages.
        header: header of the file.
        primitive: entry of the primitive.
        attributes: accessors of its attributes, by name.

    Raises:
        FileFormatError: an attribute has a type that the format excludes, or its number
            of values is not that of the positions.
    """
    for name, types in _find_valid_types(header, primitive).items():
        if name in attributes:
            _check_attribute(path, attributes, name, types)


def _check_attribute(
    path: Path, attributes: dict[str, Accessor], name: str, types: tuple[str, ...]
) -> None:
    """Check one attribute of a primitive, with the errors of `_check_attributes`.

    Args:
        path: path of the file, for messages.
        attributes: accessors of all attributes, by name.
        name: the attribute that is checked.
        types: the types that the format allows for it.
    """
    accessor = attributes[name]
    if accessor.type not in types:
        raise damaged(path, f"{name} of type {' or '.join(types)}", accessor.type)
    positions = attributes.get("POSITION")
    if positions is not None and accessor.count != positions.count:
        expected = f"as many values of {name} as of POSITION, {positions.count:,}"
        raise damaged(path, expected, f"{accessor.count:,}")


def _find_valid_types(
    header: Header, primitive: Primitive
) -> dict[str, tuple[str, ...]]:
    """Return the types that the format allows for each attribute that is read."""
    uv_name = "TEXCOORD_0"
    if primitive.material is not None:
        uv_name = header.materials[primitive.material].uv_attribute
    return {
        "POSITION": ("VEC3",),
        "NORMAL": ("VEC3",),
        "COLOR_0": ("VEC3", "VEC4"),
        uv_name: ("VEC2",),
    }


def _check_tree(path: Path, header: Header) -> None:
    """Check the number of triangles and primitives, and that nodes form trees.

    Nodes must have one parent at most, form no cycles, and be at most `DEEPEST_TREE`
    deep.

    Raises:
        FileFormatError: nodes are no trees, or a limit is exceeded.
    """
    children = _find_children(path, header)  # all nodes with a parent
    _check_tree_sizes(path, header)
    # From the roots down, level by level. A cycle has no root, so it is never reached.
    level = [index for index in range(len(header.nodes)) if index not in children]
    n_reached = 0
    depth = 0
    while level:
        check_most(path, depth + 1, DEEPEST_TREE, "nodes of at most {} levels", "more")
        depth = depth + 1
        n_reached = n_reached + len(level)
        level = [child for index in level for child in header.nodes[index].children]
    if n_reached < len(header.nodes):
        raise damaged(path, "nodes that form trees", "a cycle")


def _find_children(path: Path, header: Header) -> set[int]:
    """Return all nodes that have a parent; raise FileFormatError if one has two."""
    children: set[int] = set()
    for node in header.nodes:
        for child in node.children:
            if child in children:
                raise damaged(
                    path, "nodes with one parent each", f"two for node {child}"
                )
            children.add(child)
    return children


def _check_tree_sizes(path: Path, header: Header) -> None:
    """Raise FileFormatError if there are too many triangles, primitives or nodes.

    Two sums are limited: over all meshes, and over all nodes with a mesh, in which a
    mesh counts as often as it is drawn.
    """
    triangles_of_mesh = [
        sum(_count_max_triangles(header, primitive) for primitive in mesh.primitives)
        for mesh in header.meshes
    ]
    n_instanced_triangles = _sum_over_nodes(header, triangles_of_mesh)
    check_faces(path, max(n_instanced_triangles, sum(triangles_of_mesh)))
    primitives_of_mesh = [len(mesh.primitives) for mesh in header.meshes]
    n_instanced = _sum_over_nodes(header, primitives_of_mesh)
    check_most(
        path,
        max(n_instanced, sum(primitives_of_mesh), len(header.nodes)),
        LARGEST_TREE,
        "glTF of at most {} nodes and primitives",
    )


def _sum_over_nodes(header: Header, count_of_mesh: list[int]) -> int:
    """Return the sum, over all nodes with a mesh, of a count that each mesh has."""
    return sum(
        count_of_mesh[node.mesh] for node in header.nodes if node.mesh is not None
    )


def _count_max_triangles(header: Header, primitive: Primitive) -> int:
    """Return an upper bound of the number of triangles of a primitive.

    In mode 4 each triangle has three corners of its own. In strips and fans each corner
    after the first two makes a triangle.
    """
    index = primitive.indices
    if index is None:
        index = primitive.attributes.get("POSITION")
    if index is None or primitive.mode < 4:  # points or lines
        return 0
    count = header.accessors[index].count
    return count // 3 if primitive.mode == 4 else max(0, count - 2)


_COMPONENT_TYPES = {
    5120: "<i1",
    5121: "<u1",
    5122: "<i2",
    5123: "<u2",
    5125: "<u4",
    5126: "<f4",
}


class GltfFile:
    """The header of a glTF file, and the data that it refers to.

    Data may be in other files, which `references` finds.

    Attributes:
        path: the file.
        header: its checked header.
        references: finds files beside it.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        """Read the header; buffers are loaded when they are first used.

        Raises FileFormatError as `read_header`.
        """
        self.path = path
        self.header = read_header(path, data)
        self.references = ReferencedFiles(path)
        _, self._chunk = _split_chunks(path, data)
        self._buffers: dict[int, bytes] = {}
        self._sparse_filled: dict[int, npt.NDArray[Any]] = {}

    def load_uri(self, uri: str) -> bytes:
        """Return the content of a data URI, or of the file that the URI names.

        Raises:
            FileNotFoundError: there is no such file, or it must not be read. The reason
                is in `references.refused`.
            ValueError: the data is not valid base64.
        """
        if not uri.startswith("data:"):
            return self.references.read_file(uri)
        kind, _, content = uri.partition(",")
        data = unquote_to_bytes(content)
        return base64.b64decode(data) if kind.endswith(";base64") else data

    def get_view_bytes(self, index: int) -> memoryview:
        """Return the bytes of a buffer view.

        Raises:
            FileFormatError: the buffer is too short, or cannot be loaded.
        """
        view = self.header.bufferViews[index]
        data = self._load_buffer(view.buffer)
        end = view.byteOffset + view.byteLength
        if end > len(data):
            raise damaged(
                self.path,
                f"a buffer of at least {end:,} bytes",
                f"{len(data):,}; the file is cut short",
            )
        return memoryview(data)[view.byteOffset : end]

    def _load_buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer, which are loaded on first use.

        They are those that its URI names. The first buffer of a .glb file may have no
        URI: it is the binary chunk.

        Raises:
            FileFormatError: the buffer has no data, or its file is missing.
        """
        if index not in self._buffers:
            self._buffers[index] = self._read_buffer(index)
        return self._buffers[index]

    def _read_buffer(self, index: int) -> bytes:
        """Read the bytes of a buffer, with the errors of `_load_buffer`."""
        uri = self.header.buffers[index].uri
        try:
            if uri is not None:
                return self.load_uri(uri)
            if index == 0 and self._chunk is not None:  # of a .glb file
                return self._chunk
            raise self._make_empty_buffer_error(index)
        except FileNotFoundError:
            raise self._make_missing_buffer_error(uri or "") from None
        except ValueError:
            raise damaged(
                self.path, f"a buffer {index} in base64", "other text"
            ) from None

    def _make_missing_buffer_error(self, uri: str) -> FileFormatError:
        """Return the error for a buffer whose file is missing, or must not be read."""
        name = normalize_name(uri)
        reason = self.references.refusal_by_name.get(name, "is missing")
        return FileFormatError(
            f"{self.path}: needs {format_name(name)}, which {reason}; put that "
            "file beside it"
        )

    def _make_empty_buffer_error(self, index: int) -> FileFormatError:
        """Return the error for a buffer without data."""
        # An extension of its views may have the data, such as meshopt's.
        unread = {
            name
            for view in self.header.bufferViews
            if view.buffer == index
            for name in find_unread_extensions(view)
        }
        if unread:
            return _make_unsupported_error(self.path, sorted(unread))
        return damaged(self.path, f"a buffer {index} with content", "none")

    def read_stored_values(self, index: int) -> npt.NDArray[Any]:
        """Return the values (count, width) of an accessor as they are stored.

        They are those of the buffer view, or zeros if the accessor has none. Sparse
        values replace some of the rows (glTF 2.0, section 3.6.2.3).

        Raises:
            FileFormatError: they reach beyond their view.
        """
        if index in self._sparse_filled:
            return self._sparse_filled[index]
        accessor = self.header.accessors[index]
        values = self._read_dense_values(accessor)
        if accessor.sparse is None or not accessor.sparse.count:
            return values
        values = self._replace_rows(values, accessor, accessor.sparse)
        # Other values are views of the file's bytes, and need no cache.
        self._sparse_filled[index] = values
        return values

    def _read_dense_values(self, accessor: Accessor) -> npt.NDArray[Any]:
        """Return the values (count, width) of an accessor without its sparse values."""
        shape = (accessor.count, accessor.width)
        kind = np.dtype(_COMPONENT_TYPES[accessor.componentType])
        view = accessor.bufferView
        if view is None or not accessor.count:
            return np.zeros(shape, kind)
        stride = self.header.bufferViews[view].byteStride
        return self._make_array(view, accessor.byteOffset, shape, kind, stride)

    def _replace_rows(
        self, dense_values: npt.NDArray[Any], accessor: Accessor, sparse: Sparse
    ) -> npt.NDArray[Any]:
        """Return a copy of an accessor's values in which sparse values replace rows.

        Args:
            dense_values: (count, width) the values without the sparse ones.
            accessor: the accessor.
            sparse: its sparse values, and the rows that they replace.

        Raises:
            FileFormatError: there are too many sparse values, or they are for rows that
                do not exist.
        """
        sparse_values = sparse.values
        sparse_rows = self._read_sparse_rows(sparse, accessor.count)
        # a copy, because `dense_values` may be a view of the file's bytes
        values = np.array(dense_values)
        values[sparse_rows] = self._make_array(
            sparse_values.bufferView,
            sparse_values.byteOffset,
            (sparse.count, accessor.width),
            values.dtype,
        )
        return values

    def _read_sparse_rows(self, sparse: Sparse, n_rows: int) -> npt.NDArray[Any]:
        """Return the rows (S,) that sparse values replace, of an array of `n_rows`.

        Raises:
            FileFormatError: there are too many, or they do not exist.
        """
        indices = sparse.indices
        count = sparse.count
        if count > n_rows:
            raise damaged(self.path, f"at most {n_rows:,} sparse values", f"{count:,}")
        kind = np.dtype(_COMPONENT_TYPES[indices.componentType])
        column = self._make_array(
            indices.bufferView, indices.byteOffset, (count, 1), kind
        )
        sparse_rows = column[:, 0]
        max_row = int(sparse_rows.max())
        if max_row >= n_rows:
            expected = f"sparse values at rows under {n_rows:,}"
            raise damaged(self.path, expected, f"{max_row:,}")
        return sparse_rows

    def _make_array(
        self,
        view: int,
        offset: int,
        shape: tuple[int, int],
        kind: np.dtype[Any],
        stride: int | None = None,
    ) -> npt.NDArray[Any]:
        """Return an array in a buffer view, without copying it.

        Args:
            view: index of the buffer view.
            offset: first byte of the array in the view.
            shape: rows and columns.
            kind: type of its numbers.
            stride: bytes from one row to the next; None if there is no gap between
                rows.

        Raises:
            FileFormatError: the view is too short.
        """
        data = self.get_view_bytes(view)
        row_size = shape[1] * kind.itemsize
        row_stride = stride or row_size
        # There is no gap after the last row.
        end = offset + (shape[0] - 1) * row_stride + row_size
        if end > len(data):
            raise damaged(
                self.path, f"a view of at least {end:,} bytes", f"{len(data):,}"
            )
        values: npt.NDArray[Any] = np.ndarray(
            shape, kind, data, offset, (row_stride, kind.itemsize)
        )
        return values

    def read_float_rows(self, index: int, rows: IntArray) -> Float64Array:
        """Return rows (N,) of an accessor as float64 (N, width).

        Normalized integers are divided by the largest value of their type. The results
        are in [-1, 1]: the smallest signed integer would be below -1, and is clipped.
        """
        values = self.read_stored_values(index)[rows]
        numbers: Float64Array = values.astype(np.float64)
        if not self.header.accessors[index].normalized or values.dtype.kind == "f":
            return numbers
        return np.asarray(numbers / np.iinfo(values.dtype).max).clip(-1.0)
