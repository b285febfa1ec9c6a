"""The entries of a glTF header that are read; field names are the format's.

See glTF 2.0, section 5.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AliasPath,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    FailFast,
    Field,
    JsonValue,
)

# Generator of glTF files that were converted from USD. Notes of the converter are in
# the extras of their asset.
GENERATOR = "advsearch, of OpenUSD"
T = TypeVar("T")
List = Annotated[list[T], FailFast()]
"""A list whose validation stops at the first wrong entry, since a million errors take
gigabytes.
"""
Unread = Annotated[JsonValue, Field(exclude=True)]
"""A value that is not read as an entry: it is handled elsewhere, or changes nothing."""
Index = Annotated[int, Field(ge=0, lt=1 << 32)]
Size = Annotated[int, Field(ge=0, lt=1 << 40)]
_WIDTH_OF_TYPE = {
    "SCALAR": 1,
    "VEC2": 2,
    "VEC3": 3,
    "VEC4": 4,
    "MAT2": 4,
    "MAT3": 9,
    "MAT4": 16,
}


REFERENCED_LISTS = {
    **dict.fromkeys(
        ("attributes", "indices", "targets", "input", "output", "inverseBindMatrices"),
        "accessors",
    ),
    **dict.fromkeys(("children", "joints", "node", "nodes"), "nodes"),
    **dict.fromkeys(("source", "webp"), "images"),
    **{
        "buffer": "buffers",
        "bufferView": "bufferViews",
        "camera": "cameras",
        "index": "textures",
        "lamp": "lights",
    },
    **{
        "material": "materials",
        "mesh": "meshes",
        "sampler": "samplers",
        "scene": "scenes",
        "skin": "skins",
    },
}
"""The list of the header to which the indices in a field refer."""


class Entry(BaseModel):
    """A JSON object of glTF; keys without a field are in `model_extra`."""

    model_config = ConfigDict(
        strict=True, extra="allow", allow_inf_nan=False, frozen=True
    )
    extensions: Unread = None  # as they are in the file

    def iterate_entries(self) -> Iterator[Entry]:
        """Yield this entry, and all entries within it."""
        queue: list[object] = [self]
        for item in queue:  # the loop also reaches the items that are added in it
            if isinstance(item, Entry):
                yield item
                queue.extend(vars(item).values())
            elif isinstance(item, (list, dict)):
                # Fields have entries in a list or dictionary, but not in nested ones.
                children = item.values() if isinstance(item, dict) else item
                queue.extend(child for child in children if isinstance(child, Entry))

    @classmethod
    def list_extension_keys(cls) -> dict[str, set[str]]:
        """Return, for each extension of this type of entry, the keys that are read.

        These are the keys to which fields are aliased: for a node
        `{"KHR_lights_punctual": {"light"}}`. The set is empty if a field has the
        extension itself as an entry.
        """
        keys_of_extension: dict[str, set[str]] = {}
        for info in cls.model_fields.values():
            if isinstance(info.validation_alias, AliasPath):
                # A path is "extensions", the name of the extension, and a key in it. It
                # has no key if the field is the extension itself.
                _, extension, *keys = map(str, info.validation_alias.path)
                keys_of_extension.setdefault(extension, set()).update(keys[:1])
        return keys_of_extension

    def iterate_references(self) -> Iterator[tuple[str, int]]:
        """Yield each reference: the name of a list of the header, and an index in it.

        References are fields named in `REFERENCED_LISTS`. A value is an index, or a
        list or dictionary of indices.
        """
        for name, value in vars(self).items():
            queue: list[Any] = [value] if name in REFERENCED_LISTS else []
            for item in queue:  # the loop also reaches the items that are added in it
                if isinstance(item, int):
                    yield REFERENCED_LISTS[name], item
                elif isinstance(item, (list, dict)):
                    queue.extend(item.values() if isinstance(item, dict) else item)


def _make_extension_field(*path: str, default: Any = None) -> Any:
    """Return a field whose value is in an extension of the entry."""
    return Field(default=default, validation_alias=AliasPath("extensions", *path))


class Asset(Entry):
    version: str
    generator: JsonValue = ""
    extras: JsonValue = None


class Buffer(Entry):
    byteLength: Size
    uri: str | None = None


class BufferView(Entry):
    buffer: Index
    byteLength: Size
    byteOffset: Size = 0
    byteStride: Annotated[int, Field(ge=4, le=252)] | None = None


class SparseValues(Entry):
    bufferView: Index
    byteOffset: Size = 0


class SparseIndices(SparseValues):
    componentType: Literal[5121, 5123, 5125]


class Sparse(Entry):
    """Values that replace some of an accessor's values."""

    count: Size
    indices: SparseIndices
    values: SparseValues


class Accessor(Entry):
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Size
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    bufferView: Index | None = None
    byteOffset: Size = 0
    normalized: bool = False
    sparse: Sparse | None = None

    @property
    def width(self) -> int:
        """Number of components of each value, such as 3 for "VEC3"."""
        return _WIDTH_OF_TYPE[self.type]


class Primitive(Entry):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    # Morph targets: accessors of the offsets of each attribute at weight 1.
    targets: List[dict[str, Index]] = []


class MeshEntry(Entry):
    primitives: List[Primitive]
    name: str | None = None
    weights: List[float] = []  # weights of its morph targets, unless a node has weights
    # Exporters write the names of morph targets to `targetNames`.
    extras: Unread = None


class Node(Entry):
    children: List[Index] = []
    mesh: Index | None = None
    camera: Index | None = None
    skin: Index | None = None
    # Index of the light of the node.
    lamp: Index | None = _make_extension_field("KHR_lights_punctual", "light")
    matrix: Annotated[list[float], Field(min_length=16, max_length=16)] | None = None
    translation: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    rotation: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    scale: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    weights: List[float] = []
    name: str | None = None


class Skin(Entry):
    """The nodes that move a mesh, and the accessor of its inverse bind matrices."""

    joints: Annotated[list[Index], FailFast(), Field(min_length=1)]
    inverseBindMatrices: Index | None = None


class ChannelTarget(Entry):
    """The property that a channel moves; without a node, it is of an extension."""

    path: str
    node: Index | None = None


class Channel(Entry):
    # Index in the samplers of its animation. It is not named `sampler`, since such a
    # field refers to the samplers of textures (`REFERENCED_LISTS`).
    sampler_index: Index = Field(validation_alias="sampler")
    target: ChannelTarget


class AnimationSampler(Entry):
    """Accessors of times in seconds and of the values at these times."""

    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(Entry):
    channels: List[Channel] = []
    samplers: List[AnimationSampler] = []
    name: str | None = None


class HumanBone(Entry):
    """The node of a person's bone in VRM; `bone` is its name, which only VRM 0 has."""

    node: Index
    bone: str = ""


class SceneEntry(Entry):
    nodes: List[Index] = []


class Perspective(Entry):
    yfov: Annotated[float, Field(gt=0.0, lt=3.1416)]
    aspectRatio: Annotated[float, Field(gt=0.0)] | None = None


class CameraEntry(Entry):
    type: Literal["perspective", "orthographic"]
    perspective: Perspective | None = None
    name: str | None = None


class Cone(Entry):
    """Angles in radians from the axis of a spot light: full inside the inner one, dark
    outside the outer one.
    """

    innerConeAngle: Annotated[float, Field(ge=0.0)] = 0.0
    outerConeAngle: Annotated[float, Field(gt=0.0, lt=1.571)] = math.pi / 4.0


class LightEntry(Entry):
    """A light of KHR_lights_punctual; intensity in candela, or lux if directional."""

    type: Literal["point", "spot", "directional"]
    color: Annotated[
        list[Annotated[float, Field(ge=0.0)]], Field(min_length=3, max_length=3)
    ] = [1.0, 1.0, 1.0]
    intensity: Annotated[float, Field(ge=0.0)] = 1.0
    spot: Cone = Cone()
    range: Annotated[float, Field(gt=0.0)] | None = None
    name: str | None = None


Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
UvSetIndex = Annotated[int, Field(ge=0, lt=256)]


class TextureTransform(Entry):
    """KHR_texture_transform: scale, then rotate counter-clockwise, then translate."""

    offset: Pair = [0.0, 0.0]
    rotation: float = 0.0
    scale: Pair = [1.0, 1.0]
    texCoord: UvSetIndex | None = None


class TextureInfo(Entry):
    index: Index
    texCoord: UvSetIndex = 0
    transform: Annotated[
        TextureTransform, BeforeValidator(lambda value: value or {})
    ] = _make_extension_field("KHR_texture_transform", default=TextureTransform())
    """Transform of the texture coordinates."""

    @property
    def uv_attribute(self) -> str:
        """Name of the attribute with its texture coordinates."""
        other = self.transform.texCoord
        return f"TEXCOORD_{self.texCoord if other is None else other}"

    def has_same_coordinates(self, other: TextureInfo) -> bool:
        """Return whether another texture has the same coordinates and transform."""
        transform = self.transform
        other_transform = other.transform
        return (
            self.uv_attribute == other.uv_attribute
            and transform.offset == other_transform.offset
            and transform.rotation == other_transform.rotation
            and transform.scale == other_transform.scale
        )


class NormalUse(TextureInfo):
    scale: float = 1.0


Factor = Annotated[list[float], Field(min_length=4, max_length=4)]


class MetallicRoughness(Entry):
    baseColorFactor: Factor | None = None
    baseColorTexture: TextureInfo | None = None
    metallicFactor: float = 1.0
    roughnessFactor: float = 1.0
    metallicRoughnessTexture: TextureInfo | None = None


class SpecularGlossiness(Entry):
    diffuseFactor: Factor | None = None
    diffuseTexture: TextureInfo | None = None
    glossinessFactor: float = 1.0


# Alpha modes in which the alpha of the base color is used.
TRANSPARENT_MODES = ("MASK", "BLEND")
# Default alpha below which a masked surface is cut out.
DEFAULT_ALPHA_CUTOFF = 0.5


class MaterialEntry(Entry):
    pbrMetallicRoughness: MetallicRoughness | None = None
    name: str | None = None
    normalTexture: NormalUse | None = None
    emissiveTexture: TextureInfo | None = None
    emissiveFactor: Annotated[
        list[Annotated[float, Field(ge=0.0)]], Field(min_length=3, max_length=3)
    ] = [0.0] * 3
    alphaMode: str = "OPAQUE"
    alphaCutoff: float = DEFAULT_ALPHA_CUTOFF
    doubleSided: Unread = None
    occlusionTexture: Unread = None
    strength: Annotated[float, Field(ge=0.0)] = _make_extension_field(
        "KHR_materials_emissive_strength", "emissiveStrength", default=1.0
    )
    glossiness: SpecularGlossiness | None = _make_extension_field(
        "KHR_materials_pbrSpecularGlossiness"
    )

    @property
    def metallic_roughness(self) -> MetallicRoughness:
        """Base color, roughness and metallic.

        A material of KHR_materials_pbrSpecularGlossiness is read as not metallic. Its
        base color is the diffuse color, and its roughness is 1 - glossiness.
        """
        glossy = self.glossiness
        if glossy is None:
            return self.pbrMetallicRoughness or MetallicRoughness()
        return MetallicRoughness(
            baseColorFactor=glossy.diffuseFactor,
            baseColorTexture=glossy.diffuseTexture,
            metallicFactor=0.0,
            roughnessFactor=1.0 - glossy.glossinessFactor,
        )

    @property
    def layout_texture(self) -> TextureInfo | None:
        """The texture whose coordinates become those of the mesh.

        It is the texture of the base color, or else the normal map, or else the texture
        of the emission.
        """
        return (
            self.metallic_roughness.baseColorTexture
            or self.normalTexture
            or self.emissiveTexture
        )

    @property
    def uv_attribute(self) -> str:
        """Name of the attribute with the texture coordinates that are read."""
        if self.layout_texture is None:
            return "TEXCOORD_0"
        return self.layout_texture.uv_attribute

    def shares_layout(self, use: TextureInfo | None) -> bool:
        """Return whether a texture has the coordinates of `layout_texture`, or is None.

        Textures with other coordinates are left out.
        """
        return (
            use is None
            or self.layout_texture is None
            or use.has_same_coordinates(self.layout_texture)
        )

    @property
    def emission(self) -> list[float]:
        """Linear radiance (3,), which a texture multiplies."""
        return [channel * self.strength for channel in self.emissiveFactor]


# Wrap modes.
REPEAT = 10497
MIRRORED = 33648
CLAMPED = 33071
BORDER = 33069  # black beyond the edges; a mode of OpenGL and USD, not of glTF
NEAREST = 9728  # filter that does not interpolate between texels
FLOAT32 = 5126  # the component type of 32-bit floats


class Sampler(Entry):
    wrapS: int = REPEAT
    wrapT: int = REPEAT
    magFilter: int | None = None
    minFilter: Unread = None


class Texture(Entry):
    source: Index | None = None
    sampler: Index | None = None
    webp: Index | None = _make_extension_field("EXT_texture_webp", "source")

    @property
    def image_index(self) -> int | None:
        """Index of its image; None if only an unsupported extension has one."""
        return self.source if self.webp is None else self.webp


class Image(Entry):
    uri: str | None = None
    bufferView: Index | None = None
    mimeType: str | None = None


class Header(Entry):
    """The JSON of a glTF file."""

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
    samplers: List[Sampler] = []
    cameras: List[CameraEntry] = []
    skins: List[Skin] = []
    animations: List[Animation] = []
    vrm: dict[str, HumanBone] = _make_extension_field(
        "VRMC_vrm", "humanoid", "humanBones", default={}
    )
    """The bones of a person in VRM 1, by name."""
    vrm_0: List[HumanBone] = _make_extension_field(
        "VRM", "humanoid", "humanBones", default=[]
    )
    lights: List[LightEntry] = _make_extension_field(
        "KHR_lights_punctual", "lights", default=[]
    )
    """The lights to which nodes refer."""
    extensionsUsed: List[str] = []
    extensionsRequired: List[str] = []

    def find_descendants(self, nodes: Iterable[int]) -> set[int]:
        """Return the given nodes and all their descendants."""
        reached = set[int]()
        level = set(nodes)
        while level:
            reached |= level
            children = {child for node in level for child in self.nodes[node].children}
            level = children - reached
        return reached

    @property
    def parent_of_node(self) -> list[int]:
        """The parent of each node, -1 for a root."""
        parents = [-1] * len(self.nodes)
        for index, node in enumerate(self.nodes):
            for child in node.children:
                parents[child] = index
        return parents

    def get_node_label(self, index: int) -> str:
        """Return the name of a node, or of its mesh, or its index in words."""
        node = self.nodes[index]
        mesh_name = None if node.mesh is None else self.meshes[node.mesh].name
        return node.name or mesh_name or f"node {index}"
