"""glTF files as a list of parts: the primitives that its nodes draw, in their places.

What materials look like is said in glTF 2.0, section 3.9; how their textures go on in
section 3.8.4.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from advsearch.errors import FileFormatError
from advsearch.scene.assets import Doubles, Floats, Ints, face_vectors
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing import gltf_entries, gltf_skeleton
from advsearch.scene.importing.files import SPLATS, Notes, check_faces, damaged, shown
from advsearch.scene.importing.gltf import (
    READ,
    GltfFile,
    is_of_splats,
    unread_extensions,
)
from advsearch.scene.importing.gltf_entries import (
    CUT_OUTS,
    GENERATOR,
    Header,
    MaterialEntry,
    Primitive,
    Sampler,
    TextureUse,
)
from advsearch.scene.importing.parts import (
    FLAT,
    ImportedPart,
    ImportedSurface,
    instead_of_texture,
    limited_radiance,
    normal_map,
    placed,
    unit,
    with_opacity,
)
from advsearch.scene.importing.pictures import TEXTURE_LIMIT, FilePictures, Kind
from advsearch.scene.importing.texture import mean_over
from advsearch.scene.importing.unread import TrackedKeys
from advsearch.scene.skeleton import Movable, Target

# ---------------------------------------------------------------------------------------------------------------------
# What a glTF file has and a scene of ours has not, in sentences: nothing is dropped in
# silence.
#
# Each of them begins with the name of the file, which the caller puts before it.

_OPAQUE = " lets light pass through surfaces with {name}; here they are opaque"
EXTENSIONS = {
    "EXT_mesh_gpu_instancing": " repeats meshes with {name}; each is there once",
    "KHR_materials_diffuse_transmission": _OPAQUE,
    "KHR_materials_pbrSpecularGlossiness": " has {name}, of which only diffuse colour "
    "and glossiness are read",
    "KHR_materials_transmission": _OPAQUE,
    "KHR_materials_unlit": " has surfaces that keep their colour in any light "
    "({name}); here they are lit as others",
    "KHR_materials_variants": " has variants of its materials ({name}); those that it "
    "shows by itself are taken",
}
"""What becomes of a file with an extension; of all that are not named here, nor
understood, `UNKNOWN`.
"""
UNKNOWN = " uses {name}, which is not understood and left out"
LONGEST_SENTENCE = 500  # characters of what the reader of OpenUSD says
FAR = 1000.0  # distance of a directional light, in object sizes


def left_out(header: Header, notes: Notes) -> None:
    """Say what the file has that is not carried over, whether one node or all of it is
    the object.
    """
    if header.asset.generator == GENERATOR and isinstance(header.asset.extras, dict):
        sentences = header.asset.extras.get("left_out")
        for what in sentences if isinstance(sentences, list) else ():
            notes.say(" " + shown(str(what), quoted=False, longest=LONGEST_SENTENCE))
    if any(map(is_of_splats, {*header.extensionsUsed, *header.extensionsRequired})):
        notes.say(f" has Gaussian splats, which are left out: a model that {SPLATS}")
    used = {*header.extensionsUsed, *header.extensionsRequired}
    for name in sorted(used & set(EXTENSIONS) | used - set(READ)):
        if not is_of_splats(name):
            notes.say(
                EXTENSIONS.get(name, UNKNOWN).format(name=shown(name, quoted=False))
            )
    drawn = header.below(
        header.scenes[header.scene or 0].nodes
        if header.scenes
        else range(len(header.nodes))
    )
    looks = header.materials
    kinds = {
        "occlusion map{s}: left out": (
            look.occlusionTexture is not None for look in looks
        ),
        "normal map{s} with other texture coordinates than the base colour: left out": (
            not look.reads(look.normalTexture) for look in looks
        ),
        "emission texture{s} with other coordinates than the base colour: left out, "
        "with the emission": (
            any(look.emission) and not look.reads(look.emissiveTexture)
            for look in looks
        ),
        "material{s} with an alphaMode that glTF does not have: opaque": (
            look.alphaMode not in ("OPAQUE", *CUT_OUTS) for look in looks
        ),
        "further scene{s}: left out": (True for _ in header.scenes[1:]),
        "node{s} with a mesh outside of its scene: left out": (
            node.mesh is not None
            for index, node in enumerate(header.nodes)
            if index not in drawn
        ),
    }
    for sentence in _counts(kinds):
        notes.say(sentence)
    _note_unread(header, notes)


WORDS = {
    "Header": "entry",
    **dict.fromkeys(("MaterialEntry", "MetallicRoughness"), "entry of a material"),
    **dict.fromkeys(("TextureUse", "NormalUse"), "entry of a material's texture"),
    **{
        name: f"entry of a {name.lower()}"
        for name in ("Primitive", "Node", "Sampler", "Texture")
    },
    **{
        "MeshEntry": "entry of a mesh",
        "Image": "entry of an image",
        "LightEntry": "entry of a light",
    },
    **{"TextureTransform": "entry of KHR_texture_transform"},
}
"""What is left out of entries whose contents are seen."""
PLAIN = frozenset(("name", "weights", "extensions"))
"""Keys without a field that make no difference, or are named with what they belong
to.
"""


def _note_unread(header: Header, notes: Notes) -> None:
    for entry in header.entries():
        kind = WORDS.get(type(entry).__name__)
        if kind is None:
            continue
        keys = TrackedKeys(
            {**(entry.model_extra or {}), "extensions": entry.extensions}
        )
        extensions = keys.nested("extensions")
        for name, read_keys in entry.read_of_extensions().items():
            extensions.nested(name).mark_read(
                *(read_keys or (key for key, _ in extensions.nested(name).items()))
            )
        # others are named with the file's
        extensions.mark_read(*(name for name, _ in extensions.items()))
        for key in keys.unread():
            notes.has(kind, key)
    for kind in set(WORDS.values()):
        # notes of applications
        for key in (
            PLAIN if "material" in kind or "texture" in kind else {*PLAIN, "extras"}
        ):
            notes.take(kind, key)
    for mesh in header.meshes:
        for primitive in mesh.primitives:
            material = (
                None
                if primitive.material is None
                else header.materials[primitive.material]
            )
            read = {
                "POSITION",
                "NORMAL",
                "COLOR_0",
                "TEXCOORD_0",
                material.attribute if material else "",
            }
            packed = material.surface.metallicRoughnessTexture if material else None
            read.add(packed.attribute if packed else "")
            for name in primitive.attributes:
                is_of_skin = header.skins and name.startswith(("JOINTS_", "WEIGHTS_"))
                if name not in read and not is_of_skin and not is_of_splats(name):
                    notes.has("attribute", name)


def beside(header: Header, file: str) -> list[str]:
    """Return what a file of that name, read as one object, leaves out of its scene: one
    sentence, or none.
    """
    lights, cameras = (
        [getattr(node, kind) is not None for node in header.nodes]
        for kind in ("lamp", "camera")
    )
    what = " and ".join(_counts({"light{s}": lights, "camera{s}": cameras}))
    left = f"{'is' if sum(lights + cameras) == 1 else 'are'} left out of the object"
    what_to_do = "name one node as the object, FILE#NODE, to keep the rest around it"
    return [f"{file}: {what} {left}; {what_to_do}"] if what else []


def lights_and_cameras(header: Header, file: str) -> list[str]:
    """Return what becomes of lights and cameras that are not what they are in a file of
    that name.
    """
    distant = f"directional light{{s}}, here as lamps {FAR:g} object sizes away"
    ranged = "light{s} with a range, which is left out: light reaches beyond it"
    kinds = {
        distant: (light.type == "directional" for light in header.lights),
        ranged: (light.range is not None for light in header.lights),
        "camera{s} without perspective: left out": (
            camera.perspective is None for camera in header.cameras
        ),
    }
    return [f"{file}: {sentence}" for sentence in _counts(kinds)]


def _counts(kinds: Mapping[str, Iterable[bool]]) -> list[str]:
    """Return how many there are of each kind, but for those of which there are none;
    {s} and {es} are for several.
    """
    counts = {what: sum(those) for what, those in kinds.items()}
    ends = {True: {"s": "", "es": ""}, False: {"s": "s", "es": "es"}}
    return [
        f"{count} {what.format(**ends[count == 1])}"
        for what, count in counts.items()
        if count
    ]


# how far texture coordinates may lie outside of a texture before it matters how that
# goes on
BEYOND = 1e-4
SMALL = 256  # texels a side up to which half a texel at an edge is seen
EDGES = (
    " has textures that do not repeat beyond their edges; where they differ, or "
    "reach far, they do here"
)
BLURRED = (
    " has textures with sharp texels (filter NEAREST); those above {most} "
    "texels "
    "a side are filtered"
)


@dataclass
class GltfSurfaces:
    """Turns the materials of one file into surfaces; `notes` are about it."""

    file: GltfFile
    notes: Notes
    # longest side of a texture; None for what `FilePictures` takes for an object
    texture_limit: int | None = None

    def __post_init__(self) -> None:
        materials = len(self.file.header.materials)
        self._pictures = FilePictures(
            materials, self.file.references, self.notes, self.texture_limit
        )

    def surface(
        self, number: int | None, pieces: Sequence[Piece]
    ) -> tuple[ImportedSurface, Doubles, Doubles]:
        """Return the surface of a material (None: the format's default), and by what
        texture coordinates are scaled, (2,), and shifted then, (2,), to fit its
        pictures; `pieces` are all that have it, with the format's.
        """
        material = (
            MaterialEntry() if number is None else self.file.header.materials[number]
        )
        entry = material.surface
        scaled = np.array(
            [1.0] * 4 if entry.baseColorFactor is None else entry.baseColorFactor,
            np.float32,
        ).clip(0, 1)
        factor = scaled[:3]
        alpha = material.alphaMode in CUT_OUTS
        color = linear_to_srgb(factor)
        texture = self._picture(
            entry.baseColorTexture,
            "colours and alpha" if alpha else "colours",
            f" names the texture {{name}}, which {{why}}; {instead_of_texture(color)} "
            "is used instead",
        )
        if texture is not None and (factor != 1.0).any():
            tinted = linear_to_srgb(srgb_to_linear(texture[:, :, :3]) * factor)
            texture = np.concatenate([tinted, texture[:, :, 3:]], axis=2)
        kept: Floats | None = color
        if entry.baseColorTexture is not None and (color > 0.999).all():
            kept = None  # plain white only leaves a texture alone
        if alpha:
            cutoff = None if material.alphaMode == "BLEND" else material.alphaCutoff
            kept = with_opacity(kept, scaled[3:], cutoff)
            texture = with_opacity(texture, scaled[3:], cutoff)
        roughness, metallic = self._roughness_and_metallic(material, pieces)
        normals = emission = None
        if material.normalTexture is not None and material.reads(
            material.normalTexture
        ):
            normals = self._picture(
                material.normalTexture,
                "numbers",
                "the normal map {name} {why}; it is left out",
            )
            normals = (
                None
                if normals is None
                else normal_map(normals, material.normalTexture.scale)
            )
        # in the unit of environments, as Blender has it (section 3.9.3, and
        # KHR_materials_emissive_strength)
        glow = np.array(material.emission)
        glowing = material.emissiveTexture
        if glow.any() and material.reads(glowing):
            picture = self._picture(
                glowing,
                "colours",
                "the texture {name} of the emission {why}; it is left out",
            )
            if glowing is None or picture is not None:
                emission = limited_radiance(glow, picture, self.notes)
        name = "" if number is None else material.name or f"material {number}"
        surface = ImportedSurface(
            kept, texture, unit(roughness), unit(metallic), normals, emission, name
        )
        return self._fitted(
            surface,
            material,
            [piece.part.uvs for piece in pieces if piece.part.uvs is not None],
        )

    def _roughness_and_metallic(
        self, material: MaterialEntry, pieces: Sequence[Piece]
    ) -> tuple[float, float]:
        """The factors times the mean of their picture over the faces that show it; over
        all of it where they have no coordinates.
        """
        entry = material.surface
        use = material.surface.metallicRoughnessTexture
        packed = self._picture(
            use,
            "numbers",
            "the texture {name} of roughness and metallic {why}; it is left out",
        )
        if packed is None or use is None:
            return entry.roughnessFactor, entry.metallicFactor
        self.notes.say("textures of roughness and metallic are replaced by their means")
        mapped = [
            (piece.part, piece.packed_uvs)
            for piece in pieces
            if piece.packed_uvs is not None
        ]
        mean = np.asarray(packed.mean(axis=(0, 1), dtype=np.float64), np.float32)
        if mapped:
            corners = np.concatenate(
                [uvs[part.faces] * [1.0, -1.0] + [0.0, 1.0] for part, uvs in mapped]
            )
            sides = face_vectors(
                np.concatenate([part.vertices[part.faces] for part, _ in mapped])
            )
            mean = mean_over(packed, corners, np.linalg.norm(sides, axis=1))
        _, green, blue = mean.tolist()
        return entry.roughnessFactor * green, entry.metallicFactor * blue

    def _picture(self, use: TextureUse | None, kind: Kind, words: str) -> Floats | None:
        """Return the values of a texture, each texel as often as its filter asks for;
        say why it cannot be had.
        """
        if use is None:
            return None
        number = self.file.header.textures[use.index].image
        entry = (
            gltf_entries.Image() if number is None else self.file.header.images[number]
        )
        name = (
            "(embedded)"
            if entry.uri is None or entry.uri.startswith("data:")
            else entry.uri
        )
        if number is None:
            self._pictures.lacks(
                name, "has a picture of a kind that is not understood", words
            )
            return None

        def content() -> bytes:
            if entry.uri is not None:
                return self.file.uri(entry.uri)
            return (
                b""
                if entry.bufferView is None
                else bytes(self.file.view(entry.bufferView))
            )

        texels = self._pictures.read(
            (entry.uri, entry.bufferView), content, kind, name, words
        )
        if (
            texels is None
            or self._sampler(use).magFilter != gltf_entries.NEAREST
            or texels.shape[:2] == (1, 1)
        ):
            return texels
        # so many that filtering does not show
        sharp = min(self._pictures.side, TEXTURE_LIMIT) // 2
        times = sharp // max(texels.shape[:2])
        if times < 2:
            self.notes.say(BLURRED.format(most=sharp // 2))
            return texels
        return texels.repeat(times, axis=0).repeat(times, axis=1)

    def _sampler(self, use: TextureUse) -> Sampler:
        number = self.file.header.textures[use.index].sampler
        return Sampler() if number is None else self.file.header.samplers[number]

    def _fitted(
        self, surface: ImportedSurface, material: MaterialEntry, uvs: Sequence[Doubles]
    ) -> tuple[ImportedSurface, Doubles, Doubles]:
        places = np.concatenate([*uvs, np.zeros((0, 2))])
        scale = np.ones(2)
        shift = np.zeros(2)
        # the layout first
        uses = (
            material.surface.baseColorTexture,
            material.normalTexture,
            material.emissiveTexture,
        )
        samplers = [
            self._sampler(use)
            for use in uses
            if use is not None and material.reads(use)
        ]
        pictures = list(surface.pictures)
        normals_at = 0 if surface.texture is None else 1  # if there are any
        normals_at = -1 if surface.normal_map is None else normals_at
        if not pictures or not len(places) or not np.isfinite(places).all():
            return surface, scale, shift
        for axis, wraps in enumerate(
            ([use.wrapS for use in samplers], [use.wrapT for use in samplers])
        ):
            low = float(places[:, axis].min())
            high = float(places[:, axis].max())
            side = 1 - axis  # rows of pictures come first
            sizes = [picture.shape[side] for picture in pictures]
            out = low < -BEYOND or high > 1.0 + BEYOND
            # small ones would be filtered across their edges, and look otherwise for it
            differ = (
                size <= SMALL
                and not np.array_equal(
                    np.take(picture, 0, side), np.take(picture, -1, side)
                )
                for picture, size in zip(pictures, sizes, strict=True)
            )
            if out and len(set(wraps)) > 1:
                self.notes.say(EDGES)
            if wraps[0] == gltf_entries.BORDER and out:
                pictures = [_enlarged(picture, side) for picture in pictures]
                sizes = [picture.shape[side] for picture in pictures]
            if wraps[0] == gltf_entries.MIRRORED and out:
                pictures = [
                    np.concatenate([picture, np.flip(picture, side)], axis=side)
                    for picture in pictures
                ]
                scale[axis] = 0.5
            elif wraps[0] in (
                gltf_entries.CLAMPED,
                gltf_entries.BORDER,
                gltf_entries.MIRRORED,
            ) and (out or any(differ)):
                unit_size = int(np.gcd.reduce(sizes))  # pads are whole texels of each
                before, after = (
                    max(0, int(np.ceil(beyond * unit_size))) + 1
                    for beyond in (-low, high - 1.0)
                )
                total = unit_size + before + after
                if total * (max(sizes) // unit_size) > 2 * self._pictures.side:
                    self.notes.say(EDGES)
                    continue
                for number, size in enumerate(sizes):
                    step = size // unit_size
                    texels = np.clip(
                        np.arange(-before * step, (unit_size + after) * step),
                        0,
                        size - 1,
                    )
                    pictures[number] = np.take(pictures[number], texels, side)
                    if wraps[0] == gltf_entries.BORDER and out:
                        beyond = np.arange(len(texels)) // step
                        is_outside = (beyond < before) | (beyond >= before + unit_size)
                        along_axis = np.moveaxis(pictures[number], side, 0)
                        along_axis[is_outside] = FLAT if number == normals_at else 0.0
                scale[axis], shift[axis] = unit_size / total, before / total
        return surface.with_pictures(pictures), scale, shift


def _enlarged(picture: Floats, axis: int) -> Floats:
    """Return a picture with at least `SMALL` texels along an axis, of which a border of
    one is not seen.
    """
    size = picture.shape[axis]
    times = -(-SMALL // size)
    if times == 1:
        return picture
    position = ((np.arange(size * times) + 0.5) / times - 0.5).clip(0.0, size - 1.0)
    lower = np.floor(position).astype(np.int64)
    shape = [1] * picture.ndim
    shape[axis] = -1
    share = (position - lower).reshape(shape).astype(np.float32)
    upper = np.minimum(lower + 1, size - 1)
    return np.asarray(
        np.take(picture, lower, axis) * (1.0 - share)
        + np.take(picture, upper, axis) * share
    )


# --- primitives in their places
# --------------------------------------------------------------------------------------

TRIANGLES = 4  # modes of primitives; those below are points and lines
STRIP = 5
FAN = 6
SEE_THROUGH = "mesh{es} with an opacity in vertex colours, which is left out"
DEFAULT = (
    "mesh{es} without material: of white metal with roughness 1, the default of glTF"
)


@np.errstate(all="ignore")
def read_gltf(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Parse a glTF file; arguments, results and errors as for the others
    (`advsearch.scene.importing.objects`).
    """
    file = GltfFile(path, data)
    header = file.header
    poses = sorted(gltf_skeleton.poses(header), key=lambda item: item[0])
    drawn = [
        (node, mesh, pose)
        for node, pose in poses
        if (mesh := header.nodes[node].mesh) is not None
    ]
    moving = gltf_skeleton.check_moving(file, [node for node, _, _ in drawn])
    skinned = {mesh for node, mesh, _ in drawn if header.nodes[node].skin is not None}
    pieces = {
        (mesh, number): read_piece(
            file, primitive, header.meshes[mesh].extras, mesh in skinned
        )
        for mesh in dict.fromkeys(mesh for _, mesh, _ in drawn)
        for number, primitive in enumerate(header.meshes[mesh].primitives)
    }
    with_faces = {
        key: piece
        for key, piece in pieces.items()
        if piece is not None and len(piece.part.faces)
    }
    if not with_faces:
        if any(map(is_of_splats, header.extensionsUsed)):
            raise FileFormatError(
                f"{path}: expected a mesh with faces, got Gaussian "
                f"splats, a model that {SPLATS}"
            )
        got = "points or lines only" if pieces else "none"
        raise FileFormatError(
            f"{path}: expected a mesh with faces, got {got}; export triangles"
        )
    left_out(header, notes)
    primitives = [header.meshes[mesh].primitives[number] for mesh, number in pieces]
    splats = sum(
        any(map(is_of_splats, unread_extensions(primitive))) for primitive in primitives
    )
    if without_faces := len(pieces) - len(with_faces) - splats:
        notes.say(f"{without_faces} parts without faces (points, lines) are left out")
    clear = {mesh for (mesh, _), piece in with_faces.items() if piece.see_through}
    bare = {mesh for (mesh, _), piece in with_faces.items() if piece.material is None}
    for sentence in _counts(
        {SEE_THROUGH: [True] * len(clear), DEFAULT: [True] * len(bare)}
    ):
        notes.say(sentence)
    surfaces = GltfSurfaces(file, notes)
    finished = dict[tuple[int, int], ImportedPart]()
    groups = dict[int | None, dict[tuple[int, int], Piece]]()
    for key, piece in with_faces.items():
        groups.setdefault(piece.material, {})[key] = piece
    for material, group in groups.items():
        surface, scale, shift = surfaces.surface(material, list(group.values()))
        for key, piece in group.items():
            part = piece.part
            uvs = (
                None
                if part.uvs is None
                else (part.uvs * scale + shift) * [1.0, -1.0] + [0.0, 1.0]
            )
            finished[key] = replace(part, surface=surface, uvs=uvs)
    everywhere = dict(gltf_skeleton.poses(header.model_copy(update={"scenes": []})))
    skins = {}
    for number in {
        number
        for node, _, _ in drawn
        if (number := header.nodes[node].skin) is not None
    }:
        joints = header.skins[number].joints
        inverse = gltf_skeleton.inverse_binds(file, header.skins[number])
        skins[number] = (
            np.array(joints),
            inverse,
            np.stack([everywhere[joint] for joint in joints]) @ inverse,
        )
    skeleton = gltf_skeleton.skeleton_of(file, moving)
    if skeleton is not None:
        names = [clip.name for clip in skeleton.clips]
        clips = (
            f", and plays {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}"
            if names
            else ""
        )
        notes.say(f" is shown at rest: the control body moves it{clips}")

    def in_place(key: tuple[int, int], node: int, pose: Doubles) -> ImportedPart:
        skin = header.nodes[node].skin
        piece = with_faces[key]
        part = finished[key]
        joints = np.zeros((len(part.vertices), 1), np.int64)
        nodes = np.array([node])
        inverse = np.eye(4)[None]
        # a node of its own, unless there is a skin
        by = gltf_skeleton.Bound(joints, np.ones(joints.shape))
        if skin is not None and piece.bound is not None:
            by = piece.bound
            (nodes, inverse, matrices) = skins[skin]
        if skeleton is not None:
            rest = gltf_skeleton.weights_of(file, node, len(piece.targets))
            stored = Movable(
                skeleton, node, part.vertices, nodes, inverse, *by, piece.targets, rest
            )
            part = replace(
                gltf_skeleton.morphed(part, piece.targets, piece.turns, rest),
                movable=stored,
            )
        if skin is None or piece.bound is None:
            return placed(part, pose)
        return gltf_skeleton.posed(path, part, piece.bound, matrices)

    parts = [
        replace(in_place((mesh, number), node, pose), node=node)
        for node, mesh, pose in drawn
        for number in range(len(header.meshes[mesh].primitives))
        if (mesh, number) in finished
    ]
    check_faces(path, sum(len(part.faces) for part in parts))
    return parts


class Piece(NamedTuple):
    """A primitive as it is stored, without surface. Texture coordinates are the
    format's, v = 0 at the top.
    """

    part: ImportedPart  # its geometry
    material: int | None
    see_through: bool  # whether it has vertex colours whose alpha would count
    bound: gltf_skeleton.Bound | None  # to which joints
    targets: tuple[Target, ...]  # of morphing
    turns: tuple[Doubles | None, ...]  # how far each target turns its normals
    packed_uvs: Doubles | None  # (V, 2) of its texture of roughness and metallic


def read_piece(
    file: GltfFile, primitive: Primitive, extras: object, skinned: bool
) -> Piece | None:
    """Return a primitive; None for points, lines and what has no places. `extras` are
    those of its mesh.
    """
    held = primitive.attributes
    header = file.header
    if primitive.mode < TRIANGLES or "POSITION" not in held:
        return None
    count = header.accessors[held["POSITION"]].count
    order = np.arange(count)
    if primitive.indices is not None:
        order = file.values(primitive.indices)[:, 0].astype(np.int64)
    if len(order) and order.max() >= count:
        raise damaged(
            file.path,
            "faces of its own vertices",
            "a face that refers to a vertex that is not there",
        )
    # others may share the vertices
    used, corners = np.unique(_triangles(order, primitive.mode), return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int64)
    vertices = file.numbers(held["POSITION"], used)
    material = (
        MaterialEntry()
        if primitive.material is None
        else header.materials[primitive.material]
    )
    colors = None
    see_through = False
    uvs = _coordinates(file, held, material.layout, used)
    packed = material.surface.metallicRoughnessTexture
    packed_uvs = None if packed is None else _coordinates(file, held, packed, used)
    if "COLOR_0" in held:
        rgba = np.clip(np.nan_to_num(file.numbers(held["COLOR_0"], used)), 0.0, 1.0)
        colors = rgba[:, :3][faces]
        see_through = (
            material.alphaMode in CUT_OUTS
            and rgba.shape[1] == 4
            and bool((rgba[:, 3] < 1.0).any())
        )
    normals = file.numbers(held["NORMAL"], used) if "NORMAL" in held else None
    part = ImportedPart(
        vertices, faces, normals, uvs, colors, ImportedSurface(), flat=True
    )
    joints = gltf_skeleton.bound(file, primitive, used) if skinned else None
    targets = gltf_skeleton.targets_of(file, primitive, used, extras)
    return Piece(part, primitive.material, see_through, joints, *targets, packed_uvs)


def _coordinates(
    file: GltfFile, held: Mapping[str, int], use: TextureUse | None, used: Ints
) -> Doubles | None:
    """Return the texture coordinates (N, 2) by which a texture is looked up, (0, 0) at
    its top left corner.
    """
    attribute = "TEXCOORD_0" if use is None else use.attribute
    if attribute not in held:
        return None
    accessor = file.header.accessors[held[attribute]]
    if (
        accessor.type != "VEC2"
        or accessor.count != file.header.accessors[held["POSITION"]].count
    ):
        return None  # those of the base colour are checked with the header
    uvs = file.numbers(held[attribute], used)
    if use is None:
        return uvs
    by = use.transform
    sine = np.sin(by.rotation)
    cosine = np.cos(by.rotation)
    u, v = (uvs * by.scale).T
    return np.asarray(
        np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=1) + by.offset
    )


def _triangles(order: Ints, mode: int) -> Ints:
    """Return the faces (F, 3) of a primitive (section 3.7.2.1) with vertices in that
    order.
    """
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    number = np.arange(max(0, len(order) - 2))
    if mode == STRIP:
        corners = np.stack(
            [number, number + 1 + number % 2, number + 2 - number % 2], axis=1
        )
    else:
        corners = np.stack([number + 1, number + 2, np.zeros_like(number)], axis=1)
    faces = order[corners]
    # with which strips go on elsewhere
    joints = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return np.asarray(faces[~joints], np.int64)
