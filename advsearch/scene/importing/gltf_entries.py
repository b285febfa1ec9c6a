"""The entries of a glTF header, as far as they are read; field names are the format's
(glTF 2.0, section 5).
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

# what the glTF is made by; what it leaves out is in the extras of its asset
GENERATOR = "advsearch, of OpenUSD"
T = TypeVar("T")
List = Annotated[list[T], FailFast()]
"""A list of which only the first wrong entry is reported; a million reports take
gigabytes.
"""
Unread = Annotated[JsonValue, Field(exclude=True)]
"""What is never read, and named in a warning of its own, or makes no difference."""
Index = Annotated[int, Field(ge=0, lt=1 << 32)]
Size = Annotated[int, Field(ge=0, lt=1 << 40)]
_ELEMENTS = {
    "SCALAR": 1,
    "VEC2": 2,
    "VEC3": 3,
    "VEC4": 4,
    "MAT2": 4,
    "MAT3": 9,
    "MAT4": 16,
}


REFERENCES = {
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
"""What of the header the numbers in a field refer to."""


class Entry(BaseModel):
    """A JSON object of glTF; what it holds beyond the fields is kept as `model_extra`,
    to be named as left out.
    """

    model_config = ConfigDict(
        strict=True, extra="allow", allow_inf_nan=False, frozen=True
    )
    extensions: Unread = None  # as they are in the file

    def entries(self) -> Iterator[Entry]:
        """Yield this entry, and all that it consists of."""
        level: list[object] = [self]
        for held in level:  # which grows
            if isinstance(held, Entry):
                yield held
                level.extend(vars(held).values())
            elif isinstance(held, (list, dict)):
                inside = held.values() if isinstance(held, dict) else held
                level.extend(inner for inner in inside if isinstance(inner, Entry))

    @classmethod
    def read_of_extensions(cls) -> dict[str, set[str]]:
        """Return the keys that are read of extensions, by their names; none where an
        extension is an entry itself.
        """
        read: dict[str, set[str]] = {}
        for info in cls.model_fields.values():
            if isinstance(info.validation_alias, AliasPath):
                path = [str(key) for key in info.validation_alias.path]
                read.setdefault(path[1], set()).update(path[2:3])
        return read

    def references(self) -> Iterator[tuple[str, int]]:
        for name, value in vars(self).items():
            level: list[Any] = [value] if name in REFERENCES else []
            for held in level:
                if isinstance(held, int):
                    yield REFERENCES[name], held
                elif isinstance(held, (list, dict)):
                    level.extend(held.values() if isinstance(held, dict) else held)


def _extension(*path: str, default: Any = None) -> Any:
    """A field that an extension of the entry holds; those that are not understood are
    named by `gltf_left_out`.
    """
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
    """Values in place of some of an accessor's own."""

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
        """Numbers of one of its values."""
        return _ELEMENTS[self.type]


class Primitive(Entry):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    # morph targets: how far each attribute goes where their weight is 1
    targets: List[dict[str, Index]] = []


class MeshEntry(Entry):
    primitives: List[Primitive]
    name: str | None = None
    weights: List[float] = []  # of its morph targets, where a node says none of its own
    # `targetNames` in it are what they are called: not of the format, but exporters
    # write them
    extras: Unread = None


class Node(Entry):
    children: List[Index] = []
    mesh: Index | None = None
    camera: Index | None = None
    skin: Index | None = None
    # number of the light that the node carries
    lamp: Index | None = _extension("KHR_lights_punctual", "light")
    matrix: Annotated[list[float], Field(min_length=16, max_length=16)] | None = None
    translation: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    rotation: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    scale: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    weights: List[float] = []
    name: str | None = None


class Skin(Entry):
    """The nodes that move a mesh, and the accessor of the matrices from the mesh to
    each of them.
    """

    joints: Annotated[list[Index], FailFast(), Field(min_length=1)]
    inverseBindMatrices: Index | None = None


class ChannelTarget(Entry):
    """What a channel moves; without a node nothing (an extension may know what)."""

    path: str
    node: Index | None = None


class Channel(Entry):
    curve: Index = Field(validation_alias="sampler")  # of the samplers of its animation
    target: ChannelTarget


class AnimationSampler(Entry):
    """Accessors of times in seconds and of what holds at them."""

    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(Entry):
    channels: List[Channel] = []
    samplers: List[AnimationSampler] = []
    name: str | None = None


class HumanBone(Entry):
    """The node that is a bone of a person, in VRM; its name is here in VRM 0 alone."""

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
    """Of a spot light: angles from its axis in radians, up to which it shines fully and
    beyond which not at all.
    """

    innerConeAngle: Annotated[float, Field(ge=0.0)] = 0.0
    outerConeAngle: Annotated[float, Field(gt=0.0, lt=1.571)] = math.pi / 4.0


class LightEntry(Entry):
    """A light of KHR_lights_punctual: `intensity` in candela, of a directional one in
    lux.
    """

    type: Literal["point", "spot", "directional"]
    color: Annotated[
        list[Annotated[float, Field(ge=0.0)]], Field(min_length=3, max_length=3)
    ] = [1.0, 1.0, 1.0]
    intensity: Annotated[float, Field(ge=0.0)] = 1.0
    spot: Cone = Cone()
    range: Annotated[float, Field(gt=0.0)] | None = None
    name: str | None = None


Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Map = Annotated[int, Field(ge=0, lt=256)]


class TextureTransform(Entry):
    """KHR_texture_transform: scaled, then turned counter-clockwise in radians, then
    moved.
    """

    offset: Pair = [0.0, 0.0]
    rotation: float = 0.0
    scale: Pair = [1.0, 1.0]
    texCoord: Map | None = None


class TextureUse(Entry):
    index: Index
    texCoord: Map = 0
    transform: Annotated[
        TextureTransform, BeforeValidator(lambda given: given or {})
    ] = _extension("KHR_texture_transform", default=TextureTransform())
    """What is done to the texture coordinates before it is looked up."""

    @property
    def attribute(self) -> str:
        """Name of the texture coordinates by which it is looked up."""
        other = self.transform.texCoord
        return f"TEXCOORD_{self.texCoord if other is None else other}"

    def looked_up_as(self, other: TextureUse) -> bool:
        """Whether another texture is looked up at the same places."""
        moves = [
            (by.offset, by.rotation, by.scale)
            for by in (self.transform, other.transform)
        ]
        return self.attribute == other.attribute and moves[0] == moves[1]


class NormalUse(TextureUse):
    scale: float = 1.0


Factor = Annotated[list[float], Field(min_length=4, max_length=4)]


class MetallicRoughness(Entry):
    baseColorFactor: Factor | None = None
    baseColorTexture: TextureUse | None = None
    metallicFactor: float = 1.0
    roughnessFactor: float = 1.0
    metallicRoughnessTexture: TextureUse | None = None


class SpecularGlossiness(Entry):
    diffuseFactor: Factor | None = None
    diffuseTexture: TextureUse | None = None
    glossinessFactor: float = 1.0


CUT_OUTS = ("MASK", "BLEND")  # modes in which the alpha of the base colour counts
# the alpha under which there is nothing, where the file does not say which
CUTOFF = 0.5


class MaterialEntry(Entry):
    pbrMetallicRoughness: MetallicRoughness | None = None
    name: str | None = None
    normalTexture: NormalUse | None = None
    emissiveTexture: TextureUse | None = None
    emissiveFactor: Annotated[
        list[Annotated[float, Field(ge=0.0)]], Field(min_length=3, max_length=3)
    ] = [0.0] * 3
    alphaMode: str = "OPAQUE"
    alphaCutoff: float = CUTOFF
    doubleSided: Unread = None
    occlusionTexture: Unread = None
    strength: Annotated[float, Field(ge=0.0)] = _extension(
        "KHR_materials_emissive_strength", "emissiveStrength", default=1.0
    )
    glossiness: SpecularGlossiness | None = _extension(
        "KHR_materials_pbrSpecularGlossiness"
    )

    @property
    def surface(self) -> MetallicRoughness:
        """Its base colour, roughness and metallic: the format's where it says none, and
        those of an old extension, whose diffuse colour is the base colour.
        """
        old = self.glossiness
        if old is None:
            return self.pbrMetallicRoughness or MetallicRoughness()
        color = old.diffuseFactor
        texture = old.diffuseTexture
        rough = 1.0 - old.glossinessFactor
        return MetallicRoughness(
            baseColorFactor=color,
            baseColorTexture=texture,
            metallicFactor=0.0,
            roughnessFactor=rough,
        )

    @property
    def layout(self) -> TextureUse | None:
        """The use of a texture whose coordinates the mesh gets: of the base colour, if
        it has one.
        """
        return (
            self.surface.baseColorTexture or self.normalTexture or self.emissiveTexture
        )

    @property
    def attribute(self) -> str:
        """Name of the texture coordinates that are read."""
        return "TEXCOORD_0" if self.layout is None else self.layout.attribute

    def reads(self, use: TextureUse | None) -> bool:
        """Whether a texture is looked up at the same places as the others, if there is
        one; else it is left out.
        """
        return use is None or self.layout is None or use.looked_up_as(self.layout)

    @property
    def emission(self) -> list[float]:
        """(3,) linear radiance, where there is a texture that times its colour."""
        return [channel * self.strength for channel in self.emissiveFactor]


REPEAT = 10497  # how a texture goes on beyond its edges
MIRRORED = 33648
CLAMPED = 33071
BORDER = 33069  # nothing beyond the edges: OpenGL's and USD's, not glTF's
NEAREST = 9728  # the filter that leaves texels sharp


class Sampler(Entry):
    wrapS: int = REPEAT
    wrapT: int = REPEAT
    magFilter: int | None = None
    minFilter: Unread = None


class Texture(Entry):
    source: Index | None = None
    sampler: Index | None = None
    webp: Index | None = _extension("EXT_texture_webp", "source")

    @property
    def image(self) -> int | None:
        """Number of its picture; None where only an extension that is not understood
        has one.
        """
        return self.source if self.webp is None else self.webp


class Image(Entry):
    uri: str | None = None
    bufferView: Index | None = None
    mimeType: str | None = None


class Header(Entry):
    """What is read of the JSON of a glTF file; field names are the format's (glTF 2.0,
    section 5).
    """

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
    vrm: dict[str, HumanBone] = _extension(
        "VRMC_vrm", "humanoid", "humanBones", default={}
    )
    """The bones of a person by the names of VRM 1."""
    vrm_0: List[HumanBone] = _extension("VRM", "humanoid", "humanBones", default=[])
    lights: List[LightEntry] = _extension("KHR_lights_punctual", "lights", default=[])
    """The lights that nodes may carry."""
    extensionsUsed: List[str] = []
    extensionsRequired: List[str] = []

    def below(self, nodes: Iterable[int]) -> set[int]:
        """Return nodes, and all that hang on them."""
        reached = set[int]()
        level = set(nodes)
        while level:
            reached |= level
            level = {
                child for node in level for child in self.nodes[node].children
            } - reached
        return reached

    @property
    def parents(self) -> list[int]:
        parents = [-1] * len(self.nodes)  # of roots
        for number, node in enumerate(self.nodes):
            for child in node.children:
                parents[child] = number
        return parents

    def label(self, index: int) -> str:
        """Return what a node is called: by its name, its mesh's, or its number."""
        node = self.nodes[index]
        mesh = None if node.mesh is None else self.meshes[node.mesh].name
        return node.name or mesh or f"node {index}"
