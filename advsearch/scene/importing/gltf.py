"""The header of a glTF file: read strictly, held to limits, and written again with only what is understood here.

trimesh gets the header that is written here and never the file's own, so that nothing which has not been looked at
reaches it: neither other types than those of glTF 2.0 nor extensions that decode pictures at full size.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, FailFast, Field, JsonValue, ValidationError

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.scene.importing.checks import check_faces
from advsearch.scene.importing.files import damaged, looks_like, shown, text_of

LARGEST_VALUES = 1 << 28
"""Bytes that all views, and all accessors, of a file may have; they may overlap, so its size says nothing."""

LARGEST_TREE = 20_000
"""Nodes, and pieces of geometry at their places, in one file."""

DEEPEST_TREE = 500
"""Nodes from the root to a leaf."""

MOST_VALUES = 1_000_000
"""Lists, objects and values in a header; each takes hundreds of bytes of memory, and may take two of the file."""

NODE = "node "
"""Before the number of a node in its name, in the header that is written."""

T = TypeVar("T")
List = Annotated[list[T], FailFast()]
"""A list of which only the first wrong entry is reported; a million reports take gigabytes."""

Index = Annotated[int, Field(ge=0, lt=1 << 32)]
Size = Annotated[int, Field(ge=0, lt=1 << 40)]
_COMPONENTS = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_FLOAT = 5126
_ELEMENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_UNREADABLE = ("compression", "quantization", "basisu")


class _Entry(BaseModel):
    """A JSON object of glTF; what it holds beyond the fields is dropped."""

    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False, frozen=True)


class Asset(_Entry):
    version: str


class Buffer(_Entry):
    byteLength: Size
    uri: str | None = None


class BufferView(_Entry):
    buffer: Index
    byteLength: Size
    byteOffset: Size = 0
    byteStride: Annotated[int, Field(ge=4, le=252)] | None = None


class Accessor(_Entry):
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Size
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: Index | None = None
    byteOffset: Size = 0
    sparse: dict[str, JsonValue] | None = Field(default=None, exclude=True)

    def size(self) -> int:
        """Bytes of its values, packed."""
        return self.count * _COMPONENTS[self.componentType] * _ELEMENTS[self.type]


class Primitive(_Entry):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4


class MeshEntry(_Entry):
    primitives: List[Primitive]
    name: str | None = None


class _LightUse(_Entry):
    light: Index


class _NodeExtensions(_Entry):
    punctual: _LightUse | None = Field(default=None, alias="KHR_lights_punctual")


class Node(_Entry):
    children: List[Index] = []
    mesh: Index | None = None
    camera: Index | None = None
    extensions: _NodeExtensions | None = None
    matrix: Annotated[list[float], Field(min_length=16, max_length=16)] | None = None
    translation: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    rotation: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    scale: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    name: str | None = None

    @property
    def lamp(self) -> int | None:
        """Number of the light that the node carries."""
        carried = self.extensions.punctual if self.extensions else None
        return None if carried is None else carried.light


class SceneEntry(_Entry):
    nodes: List[Index] = []


class Perspective(_Entry):
    yfov: Annotated[float, Field(gt=0.0, lt=3.1416)]
    aspectRatio: Annotated[float, Field(gt=0.0)] | None = None


class CameraEntry(_Entry):
    type: Literal["perspective", "orthographic"]
    perspective: Perspective | None = None
    name: str | None = None


class Light(_Entry):
    """A light of KHR_lights_punctual: `intensity` in candela, of a directional one in lux."""

    type: Literal["point", "spot", "directional"]
    color: Annotated[list[float], Field(min_length=3, max_length=3)] = [1.0, 1.0, 1.0]
    intensity: Annotated[float, Field(ge=0.0)] = 1.0
    name: str | None = None


class _Lights(_Entry):
    lights: List[Light] = []


class _Extensions(_Entry):
    punctual: _Lights | None = Field(default=None, alias="KHR_lights_punctual")


class TextureUse(_Entry):
    index: Index


Factor = Annotated[list[float], Field(min_length=4, max_length=4)]


class MetallicRoughness(_Entry):
    baseColorFactor: Factor | None = None
    baseColorTexture: TextureUse | None = None
    metallicFactor: float | None = None
    roughnessFactor: float | None = None
    metallicRoughnessTexture: TextureUse | None = None


class SpecularGlossiness(_Entry):
    diffuseFactor: Factor | None = None
    diffuseTexture: TextureUse | None = None
    glossinessFactor: float = 1.0


class _MaterialExtensions(_Entry):
    glossiness: SpecularGlossiness | None = Field(default=None, alias="KHR_materials_pbrSpecularGlossiness")


class MaterialEntry(_Entry):
    pbrMetallicRoughness: MetallicRoughness | None = None
    name: str | None = None
    normalTexture: TextureUse | None = None
    emissiveTexture: TextureUse | None = None
    emissiveFactor: list[float] = []
    alphaMode: str = "OPAQUE"
    extensions: _MaterialExtensions | None = None

    def plain(self) -> MaterialEntry:
        """Return the material without extensions: the diffuse colour of an old one is its base colour."""
        old = self.extensions.glossiness if self.extensions else None
        if old is None:
            return MaterialEntry(pbrMetallicRoughness=self.pbrMetallicRoughness, name=self.name)
        surface = MetallicRoughness(
            baseColorFactor=old.diffuseFactor,
            baseColorTexture=old.diffuseTexture,
            metallicFactor=0.0,
            roughnessFactor=1.0 - old.glossinessFactor,
        )
        return MaterialEntry(pbrMetallicRoughness=surface, name=self.name)


class _WebpSource(_Entry):
    source: Index | None = None


class _TextureExtensions(_Entry):
    webp: _WebpSource | None = Field(default=None, alias="EXT_texture_webp")


class Texture(_Entry):
    source: Index | None = None
    extensions: _TextureExtensions | None = None

    def plain(self) -> Texture:
        """Return the texture without extensions."""
        webp = self.extensions.webp if self.extensions else None
        return Texture(source=self.source if webp is None or webp.source is None else webp.source)


class Image(_Entry):
    uri: str | None = None
    bufferView: Index | None = None
    mimeType: str | None = None


class Header(_Entry):
    """What is read of the JSON of a glTF file; field names are the format's (glTF 2.0, section 5)."""

    asset: Asset
    scene: Index | None = None
    scenes: List[SceneEntry] = []
    nodes: List[Node] = []
    meshes: List[MeshEntry] = []
    accessors: List[Accessor] = []
    bufferViews: List[BufferView] = []
    buffers: List[Buffer] = []
    materials: List[MaterialEntry] = []
    textures: List[Texture] = []
    images: List[Image] = []
    cameras: List[CameraEntry] = []
    extensions: _Extensions | None = None
    extensionsUsed: List[str] = []
    extensionsRequired: List[str] = []

    @property
    def lights(self) -> list[Light]:
        """The lights that nodes may carry."""
        found = self.extensions.punctual if self.extensions else None
        return [] if found is None else found.lights

    def label(self, index: int) -> str:
        """Return what a node is called: by its name, its mesh's, or its number."""
        node = self.nodes[index]
        mesh = None if node.mesh is None else self.meshes[node.mesh].name
        return node.name or mesh or f"node {index}"


def read_header(path: Path, data: bytes) -> Header:
    """Return the header of a .gltf or .glb file.

    Raises:
        FileFormatError: the file is not glTF, is shorter than it says, has other types in its header than glTF has,
            refers to what is not there, is over a limit, or needs what is not supported.
    """
    text = text_of(_json_chunk(path, data) if path.suffix.lower() == ".glb" else data)
    if text.count(",") + text.count("[") + text.count("{") > files.scaled(MOST_VALUES):
        raise files.too_large(path, f"a glTF header of at most {files.scaled(MOST_VALUES):,} values", "more")
    try:
        content = files.parse_json(text)
    except ValueError as error:
        kind, reason = looks_like(data), str(error)
        if "another kind" in kind:
            kind = reason if reason.startswith(("a whole", "lists or")) else "something else"
        raise damaged(path, "glTF with a JSON header", kind) from None
    if not isinstance(content, dict) or "asset" not in content:
        raise damaged(path, "glTF with an 'asset' entry", "other JSON")
    try:
        version = Asset.model_validate(content["asset"]).version
        if version.split(".")[0] != "2":
            raise damaged(path, "glTF of version 2", f"version {shown(version)}")
        header = Header.model_validate(content)
    except ValidationError as error:
        raise damaged(path, *_first(error)) from None
    _check(path, header)
    return header


def rewritten(path: Path, data: bytes, header: Header) -> bytes:
    """Return the file with a header of only what was read of it."""
    plain = header.model_copy(
        update={
            "materials": [material.plain() for material in header.materials],
            "textures": [texture.plain() for texture in header.textures],
            "nodes": [
                node.model_copy(update={"name": f"{NODE}{index}", "camera": None, "extensions": None})
                for index, node in enumerate(header.nodes)
            ],
            "cameras": [],
            "extensions": None,
            "extensionsRequired": [],
            "extensionsUsed": [],
        }
    )
    text = json.dumps(plain.model_dump(exclude_none=True, exclude_defaults=True)).encode()
    if path.suffix.lower() != ".glb":
        return text
    text += b" " * (-len(text) % 4)
    rest = data[20 + struct.unpack_from("<I", data, 12)[0] : struct.unpack_from("<I", data, 8)[0]]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def base_color_image(header: Header, material: MaterialEntry) -> str | None:
    """Return a name for the base colour image of a material, or None when it has none."""
    surface = material.plain().pbrMetallicRoughness
    if surface is None or surface.baseColorTexture is None:
        return None
    source = header.textures[surface.baseColorTexture.index].plain().source
    uri = None if source is None else header.images[source].uri
    return "(embedded)" if uri is None or uri.startswith("data:") else uri


def not_carried_over(header: Header) -> Iterator[str]:
    """Yield what materials have that is not read, each with how many of them, as the beginning of a sentence."""
    counts = {
        "the normal maps": sum(one.normalTexture is not None for one in header.materials),
        "the glow": sum(bool(one.emissiveTexture or any(one.emissiveFactor)) for one in header.materials),
        "the transparency": sum(one.alphaMode != "OPAQUE" for one in header.materials),
    }
    for what, count in counts.items():
        if count:
            yield f"{what} of {count} material{'s' if count > 1 else ''} {'are' if what.endswith('maps') else 'is'}"


def _json_chunk(path: Path, data: bytes) -> bytes:
    """Return the first chunk of a .glb file."""
    if not data.startswith(b"glTF") or len(data) < 20:
        got = "the first few bytes of one" if data.startswith(b"glTF") else looks_like(data)
        raise damaged(path, "a binary glTF file", got)
    version, length, chunk, kind = struct.unpack_from("<4xIII4s", data)
    if version != 2:
        raise damaged(path, "binary glTF of version 2", f"version {version}")
    if length > len(data):
        raise damaged(path, f"{length} bytes, as its header says", f"{len(data)}; the file is cut short")
    if kind != b"JSON" or 20 + chunk > length:
        raise damaged(path, "a chunk of JSON first", f"{chunk} bytes of {shown(kind.decode('latin-1'))}")
    return data[20 : 20 + chunk]


def _first(error: ValidationError) -> tuple[str, str]:
    """Return what the first entry of the wrong type should be, and what it is."""
    first = error.errors(include_url=False)[0]
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    needed = first["msg"].removeprefix("Input should be ").removeprefix("Field ")
    got = "nothing" if first["type"] == "missing" else shown(json.dumps(first["input"], default=str))
    return f"glTF whose {place} is {needed}" if got != "nothing" else f"glTF with {place}", got


def _check(path: Path, header: Header) -> None:
    """Check what the types leave open: extensions, limits, and that whatever is referred to is there."""
    needed = sorted(name for name in header.extensionsRequired if any(word in name for word in _UNREADABLE))
    if needed:
        names = shown(", ".join(needed), quoted=False)
        raise FileFormatError(f"{path}: needs {names}, which is not supported; export it without that option")
    for view in header.bufferViews:
        _check_index(path, "buffers", view.buffer, header.buffers)
    for accessor in header.accessors:
        _check_index(path, "bufferViews", accessor.bufferView, header.bufferViews)
    for texture in header.textures:
        _check_index(path, "images", texture.plain().source, header.images)
    for image in header.images:
        _check_index(path, "bufferViews", image.bufferView, header.bufferViews)
    for material in header.materials:
        surface = material.plain().pbrMetallicRoughness
        for use in (surface.baseColorTexture, surface.metallicRoughnessTexture) if surface else ():
            _check_index(path, "textures", None if use is None else use.index, header.textures)
    sizes = (sum(view.byteLength for view in header.bufferViews), sum(a.size() for a in header.accessors))
    if max(sizes) > files.scaled(LARGEST_VALUES):
        most = f"geometry and pictures of at most {files.scaled(LARGEST_VALUES):,} bytes"
        raise files.too_large(path, most, f"{max(sizes):,}")
    for mesh in header.meshes:
        for primitive in mesh.primitives:
            _check_primitive(path, header, primitive)
    _check_tree(path, header)


def _check_index(path: Path, kind: str, index: int | None, entries: list[Any]) -> None:
    if index is not None and index >= len(entries):
        raise damaged(path, f"glTF with {index + 1} {kind}, as it refers to", f"{len(entries)}")


def _check_primitive(path: Path, header: Header, primitive: Primitive) -> None:
    """Refuse what would be read wrongly: integers where floats are meant, attributes of different lengths."""
    for index in (*primitive.attributes.values(), primitive.indices):
        _check_index(path, "accessors", index, header.accessors)
    _check_index(path, "materials", primitive.material, header.materials)
    for name in ("POSITION", "NORMAL", "TEXCOORD_0"):
        if name not in primitive.attributes:
            continue
        accessor = header.accessors[primitive.attributes[name]]
        if accessor.componentType != _FLOAT:
            got = f"{name} values that are not 32-bit floats"
            raise FileFormatError(f"{path}: expected floats, got {got}; export it without quantization")
        kind = "VEC2" if name == "TEXCOORD_0" else "VEC3"
        if accessor.type != kind:
            raise damaged(path, f"{name} of type {kind}", accessor.type)
    if primitive.indices is not None and header.accessors[primitive.indices].type != "SCALAR":
        raise damaged(path, "indices of type SCALAR", header.accessors[primitive.indices].type)
    for index in (*primitive.attributes.values(), primitive.indices):
        used = None if index is None else header.accessors[index]
        if used is not None and used.sparse is not None:
            raise FileFormatError(f"{path}: has sparse accessors, which are not supported; export it without them")
        if used is not None and used.bufferView is None:
            raise damaged(path, "accessors with a bufferView", "one without values")


def _triangles(header: Header, primitive: Primitive) -> int:
    """Return how many triangles a primitive has, at most."""
    index = primitive.attributes.get("POSITION") if primitive.indices is None else primitive.indices
    if index is None or primitive.mode < 4:
        return 0
    count = header.accessors[index].count
    return count // 3 if primitive.mode == 4 else max(0, count - 2)


def _check_tree(path: Path, header: Header) -> None:
    """Check that the nodes form trees, as glTF demands, and neither too large nor too deep ones."""
    for scene in header.scenes:
        for root in scene.nodes:
            _check_index(path, "nodes", root, header.nodes)
    _check_index(path, "scenes", header.scene, header.scenes)
    parents: set[int] = set()
    triangles = [sum(_triangles(header, primitive) for primitive in mesh.primitives) for mesh in header.meshes]
    pieces, drawn = 0, 0
    for node in header.nodes:
        _check_index(path, "meshes", node.mesh, header.meshes)
        _check_index(path, "cameras", node.camera, header.cameras)
        _check_index(path, "lights", node.lamp, header.lights)
        if node.mesh is not None:
            pieces, drawn = pieces + len(header.meshes[node.mesh].primitives), drawn + triangles[node.mesh]
        for child in node.children:
            _check_index(path, "nodes", child, header.nodes)
            if child in parents:
                raise damaged(path, "nodes with one parent each", f"two for node {child}")
            parents.add(child)
    pieces = max(pieces, sum(len(mesh.primitives) for mesh in header.meshes), len(header.nodes))
    check_faces(path, max(drawn, sum(triangles)))
    if pieces > files.scaled(LARGEST_TREE):
        raise files.too_large(path, f"glTF of at most {files.scaled(LARGEST_TREE):,} nodes and pieces", f"{pieces:,}")
    level, reached = [index for index in range(len(header.nodes)) if index not in parents], 0
    for _ in range(files.scaled(DEEPEST_TREE)):
        reached += len(level)
        level = [child for index in level for child in header.nodes[index].children]
        if not level:
            break
    if level:
        raise files.too_large(path, f"nodes of at most {files.scaled(DEEPEST_TREE)} levels", "more")
    if reached < len(header.nodes):
        raise damaged(path, "nodes that form trees", "a cycle")
