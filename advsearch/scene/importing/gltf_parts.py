"""glTF files as a list of parts: the primitives that its nodes draw, in their places.

What materials look like is said in glTF 2.0, section 3.9; how their textures go on in section 3.8.4.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import Image

from advsearch.errors import FileFormatError
from advsearch.pictures import FORMATS
from advsearch.scene.assets import Doubles, Floats, Ints
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import Notes, References, check_faces, damaged, shown
from advsearch.scene.importing.gltf import Buffers, binary_chunk, read_header
from advsearch.scene.importing.gltf_entries import (
    CLAMPED,
    CUT_OUTS,
    MIRRORED,
    NEAREST,
    Header,
    MaterialEntry,
    Primitive,
    Sampler,
    TextureUse,
)
from advsearch.scene.importing.gltf_left_out import counted, left_out, moves
from advsearch.scene.importing.gltf_skeleton import (
    Bound,
    bound,
    check_moving,
    joint_matrices,
    morphed,
    movable,
    posed,
    poses,
    skeleton_of,
    targets_of,
    weights_of,
)
from advsearch.scene.importing.parts import (
    ImportedPart,
    ImportedSurface,
    limited_radiance,
    normal_map,
    placed,
    unit,
    with_opacity,
)
from advsearch.scene.importing.pictures import Kind, Pictures
from advsearch.scene.importing.texture import mean_over
from advsearch.scene.skeleton import Target

Fit = Callable[[Doubles], Doubles]
"""Takes texture coordinates (V, 2) of the format to those of the pictures that were made."""

BEYOND = 1e-4
"""How far texture coordinates may lie outside of a texture before it matters how that goes on."""
SMALL = 256
"""Texels a side up to which half a texel at an edge is seen."""

EDGES = " has textures that do not repeat beyond their edges; where they differ, or reach far, they do here"
BLURRED = " has textures with sharp texels (filter NEAREST); those above {most} texels a side are filtered"


@dataclass
class GltfSurfaces:
    """Turns the materials of one file into surfaces.

    Attributes:
        header: of the file.
        buffers: reads its pictures.
        references: the files that it names.
        notes: about the file.
    """

    header: Header
    buffers: Buffers
    references: References
    notes: Notes
    _opened: dict[tuple[str | None, int | None], Image.Image | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._pictures = Pictures(len(self.header.materials), self.references, self.notes)

    def surface(self, number: int | None, parts: Sequence[ImportedPart]) -> tuple[ImportedSurface, Fit]:
        """Return the surface of a material, and how texture coordinates fit its pictures.

        Args:
            number: of the material; None for the format's default.
            parts: all that have it, with the format's texture coordinates.
        """
        uvs = [part.uvs for part in parts if part.uvs is not None]
        material = MaterialEntry() if number is None else self.header.materials[number]
        entry = material.surface
        scaled = np.array([1.0] * 4 if entry.baseColorFactor is None else entry.baseColorFactor, np.float32).clip(0, 1)
        factor, alpha = scaled[:3], material.alphaMode in CUT_OUTS
        color = linear_to_srgb(factor)
        textured = entry.baseColorTexture is not None and bool((color > 0.999).all())
        instead = "neutral grey" if textured else f"its base colour ({', '.join(f'{c:.2f}' for c in color)})"
        texture = self._picture(
            entry.baseColorTexture,
            "colours and alpha" if alpha else "colours",
            " names the texture {name}, which {why}; " + instead + " is used instead",
        )
        if texture is not None and (factor != 1.0).any():
            tinted = linear_to_srgb(srgb_to_linear(texture[:, :, :3]) * factor)
            texture = np.concatenate([tinted, texture[:, :, 3:]], axis=2)
        kept: Floats | None = None if textured else color
        if alpha:
            cutoff = None if material.alphaMode == "BLEND" else material.alphaCutoff
            kept, texture = with_opacity(kept, scaled[3:], cutoff), with_opacity(texture, scaled[3:], cutoff)
        roughness, metallic = entry.roughnessFactor, entry.metallicFactor
        packed = self._picture(
            entry.metallicRoughnessTexture,
            "numbers",
            "the texture {name} of roughness and metallic {why}; it is left out",
        )
        if packed is not None:
            self.notes.say("textures of roughness and metallic are replaced by their means")
            _, green, blue = self._mean(packed, material, entry.metallicRoughnessTexture, parts).tolist()
            roughness, metallic = roughness * green, metallic * blue
        normals = None
        if material.normalTexture is not None and material.reads(material.normalTexture):
            words = "the normal map {name} {why}; it is left out"
            normals = self._picture(material.normalTexture, "numbers", words)
            normals = None if normals is None else normal_map(normals, material.normalTexture.scale)
        name = "" if number is None else material.name or f"material {number}"
        found = ImportedSurface(kept, texture, unit(roughness), unit(metallic), normals, self._emission(material), name)
        return self._fitted(found, material, uvs)

    def _mean(
        self, packed: Floats, material: MaterialEntry, use: TextureUse | None, parts: Sequence[ImportedPart]
    ) -> Floats:
        """The mean (3,) of a picture over the faces that show it; over all of it where it has other coordinates than
        those that are read."""
        parts = [part for part in parts if part.uvs is not None]
        if use is None or not parts or not use.looked_up_as(material.layout or TextureUse(index=0)):
            return np.asarray(packed.mean(axis=(0, 1), dtype=np.float64), np.float32)
        corners = [part.uvs[part.faces] * [1.0, -1.0] + [0.0, 1.0] for part in parts if part.uvs is not None]
        triangles = np.concatenate([part.vertices[part.faces] for part in parts])
        sides = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        return mean_over(packed, np.concatenate(corners), np.linalg.norm(sides, axis=1))

    def _emission(self, material: MaterialEntry) -> Floats | None:
        """The radiance of a material (section 3.9.3, and KHR_materials_emissive_strength), in the unit of
        environments, as Blender has it."""
        factor, picture = np.array(material.emission), None
        if not factor.any() or not material.reads(material.emissiveTexture):
            return None
        if material.emissiveTexture is not None:
            words = "the texture {name} of the emission {why}; it is left out"
            picture = self._picture(material.emissiveTexture, "colours", words)
            if picture is None:
                return None
        found, note = limited_radiance(factor, picture)
        if note is not None:
            self.notes.say(note)
        return found

    # --- pictures ----------------------------------------

    def _picture(self, use: TextureUse | None, kind: Kind, words: str) -> Floats | None:
        """Return the values of a texture, each texel as often as its filter asks for; say why it cannot be had."""
        if use is None:
            return None
        number = self.header.textures[use.index].image
        uri = None if number is None else self.header.images[number].uri
        name = "(embedded)" if uri is None or uri.startswith("data:") else uri
        if number is None:
            texels: Floats | str | None = "has a picture of a kind that is not understood"
        else:
            texels = self._pictures.decoded(self._image(number), kind, name)
        if not isinstance(texels, np.ndarray):
            why = self._pictures.why(name, texels)
            self.notes.say(words.format(name=shown(name), why=why))
            return None
        if self._sampler(use).magFilter != NEAREST or min(texels.shape[:2]) == max(texels.shape[:2]) == 1:
            return texels
        sharp = self._pictures.side // 2  # so many that filtering does not show
        times = sharp // max(texels.shape[:2])
        if times < 2:
            self.notes.say(BLURRED.format(most=sharp // 2))
            return texels
        return texels.repeat(times, axis=0).repeat(times, axis=1)

    def _image(self, number: int) -> Image.Image | None:
        """Open a picture of the file; None where it cannot be had."""
        entry, opened = self.header.images[number], None
        if (entry.uri, entry.bufferView) not in self._opened:
            try:
                if entry.uri is not None:
                    data = self.buffers.uri(entry.uri)
                else:
                    data = b"" if entry.bufferView is None else bytes(self.buffers.view(entry.bufferView))
                opened = Image.open(io.BytesIO(data), formats=FORMATS)
            except (OSError, ValueError, SyntaxError):
                pass
            self._opened[entry.uri, entry.bufferView] = opened
        return self._opened[entry.uri, entry.bufferView]

    def _sampler(self, use: TextureUse) -> Sampler:
        number = self.header.textures[use.index].sampler
        return Sampler() if number is None else self.header.samplers[number]

    # --- beyond the edges ----------------------------------------

    def _fitted(
        self, surface: ImportedSurface, material: MaterialEntry, uvs: Sequence[Doubles]
    ) -> tuple[ImportedSurface, Fit]:
        """Give the pictures of a surface what lies beyond their edges, where they do not repeat there."""
        places = np.concatenate([*uvs, np.zeros((0, 2))])
        samplers = [self._sampler(use) for use in material.textures]
        if not surface.pictures or not len(places) or not np.isfinite(places).all():
            return surface, lambda given: given
        scale, shift = np.ones(2), np.zeros(2)
        pictures, changed = list(surface.pictures), False
        for axis, wraps in enumerate(([one.wrapS for one in samplers], [one.wrapT for one in samplers])):
            low, high = float(places[:, axis].min()), float(places[:, axis].max())
            side = 1 - axis  # rows of pictures come first
            sizes = [one.shape[side] for one in pictures]
            out = low < -BEYOND or high > 1.0 + BEYOND
            if out and len(set(wraps)) > 1:
                self.notes.say(EDGES)
            if wraps[0] == MIRRORED and out:
                pictures = [np.concatenate([one, np.flip(one, side)], axis=side) for one in pictures]
                scale[axis], changed = 0.5, True
            elif wraps[0] in (CLAMPED, MIRRORED) and (out or _differ_at_edges(pictures, side)):
                unit_size = int(np.gcd.reduce(sizes))  # pads are whole texels of each
                before, after = (max(0, int(np.ceil(beyond * unit_size))) + 1 for beyond in (-low, high - 1.0))
                total = unit_size + before + after
                if total * (max(sizes) // unit_size) > 2 * self._pictures.side:
                    self.notes.say(EDGES)
                    continue
                pictures = [
                    np.take(
                        one,
                        np.clip(np.arange(-before * step, (unit_size + after) * step), 0, one.shape[side] - 1),
                        side,
                    )
                    for one, step in ((one, one.shape[side] // unit_size) for one in pictures)
                ]
                scale[axis], shift[axis], changed = unit_size / total, before / total, True
        if not changed:
            return surface, lambda given: given
        left = iter(pictures)
        replaced = replace(
            surface,
            texture=None if surface.texture is None else next(left),
            normal_map=None if surface.normal_map is None else next(left),
            emission=next(left, surface.emission),
        )
        return replaced, lambda given: given * scale + shift


def _differ_at_edges(pictures: Sequence[Floats], side: int) -> bool:
    """Whether small pictures would be filtered across their edges, and look otherwise for it."""
    return any(
        one.shape[side] <= SMALL and not np.array_equal(np.take(one, 0, side), np.take(one, -1, side))
        for one in pictures
    )


# --- primitives in their places --------------------------------------------------------------------------------------

TRIANGLES, STRIP, FAN = 4, 5, 6
"""Modes of primitives; those below are points and lines."""

SEE_THROUGH = "mesh{es} with an opacity in vertex colours, which is left out"
DEFAULT = "mesh{es} without material: of white metal with roughness 1, the default of glTF"


@np.errstate(all="ignore")
def read_gltf(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Parse a glTF file; arguments, results and errors as for the others (`advsearch.scene.importing.objects`)."""
    header, references = read_header(path, data), References(path)
    chunk = None if path.suffix.lower() == ".gltf" else binary_chunk(data)
    buffers = Buffers(path, header, chunk, references)
    drawn = [(node, pose) for node, pose in poses(header) if header.nodes[node].mesh is not None]
    drawn.sort(key=lambda item: item[0])
    meshes = {mesh: header.meshes[mesh] for node, _ in drawn if (mesh := header.nodes[node].mesh) is not None}
    skinned = {header.nodes[node].mesh for node, _ in drawn if header.nodes[node].skin is not None}
    moving = check_moving(path, header, [node for node, _ in drawn])
    pieces = {
        (mesh, number): _piece(path, header, buffers, primitive, skinned=mesh in skinned, extras=entry.extras)
        for mesh, entry in meshes.items()
        for number, primitive in enumerate(entry.primitives)
    }
    with_faces = {key: piece for key, piece in pieces.items() if piece is not None and len(piece.part.faces)}
    if not with_faces:
        got = "points or lines only" if pieces else "none"
        raise FileFormatError(f"{path}: expected a mesh with faces, got {got}; export triangles")
    left_out(header, notes)
    if len(with_faces) < len(pieces):
        notes.say(f"{len(pieces) - len(with_faces)} parts without faces (points, lines) are left out")
    for words, keys in (
        (SEE_THROUGH, [mesh for (mesh, _), piece in with_faces.items() if piece.see_through]),
        (DEFAULT, [mesh for (mesh, _), piece in with_faces.items() if piece.material is None]),
    ):
        if keys:
            notes.say(counted(len(set(keys)), words))
    surfaces = GltfSurfaces(header, buffers, references, notes)
    groups: dict[int | None, dict[tuple[int, int], ImportedPart]] = {}
    for key, piece in with_faces.items():
        groups.setdefault(piece.material, {})[key] = piece.part
    finished = {}
    for material, group in groups.items():
        surface, fit = surfaces.surface(material, list(group.values()))
        for key, part in group.items():
            finished[key] = replace(
                part, surface=surface, uvs=None if part.uvs is None else fit(part.uvs) * [1.0, -1.0] + [0.0, 1.0]
            )
    everywhere = dict(poses(header.model_copy(update={"scenes": []})))
    skins = {
        number: joint_matrices(path, header.skins[number], buffers, everywhere)
        for number in {header.nodes[node].skin for node, _ in drawn} - {None}
        if number is not None
    }

    skeleton = skeleton_of(path, header, buffers, moving)
    if skeleton is not None:
        notes.say(moves(skeleton))

    def in_place(key: tuple[int, int], node: int, pose: Doubles) -> ImportedPart:
        skin, piece, part = header.nodes[node].skin, with_faces[key], finished[key]
        if skeleton is not None:
            rest = weights_of(path, header, node, len(piece.targets))
            stored = movable(path, header, buffers, skeleton, node, part.vertices, piece.bound, piece.targets, rest)
            part = replace(morphed(part, piece.targets, piece.turns, rest), movable=stored)
        if skin is None or piece.bound is None:
            return placed(part, pose)
        return posed(path, part, piece.bound, skins[skin])

    parts = [
        replace(in_place((mesh, number), node, pose), node=node)
        for node, pose in drawn
        if (mesh := header.nodes[node].mesh) is not None
        for number in range(len(header.meshes[mesh].primitives))
        if (mesh, number) in finished
    ]
    check_faces(path, sum(len(part.faces) for part in parts))
    return parts


@dataclass(frozen=True, eq=False)
class _Piece:
    """A primitive as it is stored, without surface; its texture coordinates are the format's, v = 0 at the top.

    Attributes:
        part: its geometry.
        material: its number.
        see_through: it has vertex colours whose alpha would count.
        bound: to which joints; None where it is to none.
        targets, turns: its morph targets, and how far each turns its normals.
    """

    part: ImportedPart
    material: int | None
    see_through: bool
    bound: Bound | None
    targets: tuple[Target, ...]
    turns: tuple[Doubles | None, ...]


def _piece(
    path: Path, header: Header, buffers: Buffers, primitive: Primitive, *, skinned: bool, extras: object
) -> _Piece | None:
    """Return a primitive; None for points, lines and what has no places."""
    held = primitive.attributes
    if primitive.mode < TRIANGLES or "POSITION" not in held:
        return None
    count = header.accessors[held["POSITION"]].count
    if primitive.indices is None:
        order = np.arange(count)
    else:
        order = buffers.values(primitive.indices)[:, 0].astype(np.int64)
    if len(order) and order.max() >= count:
        raise damaged(path, "faces of its own vertices", "a face that refers to a vertex that is not there")
    used, corners = np.unique(_triangles(order, primitive.mode), return_inverse=True)  # others may share the vertices
    faces, vertices = corners.reshape(-1, 3).astype(np.int64), buffers.numbers(held["POSITION"], used)
    material = MaterialEntry() if primitive.material is None else header.materials[primitive.material]
    uvs = colors = None
    see_through = False
    if material.attribute in held:
        uvs = _moved(buffers.numbers(held[material.attribute], used), material.layout)
    if "COLOR_0" in held:
        given = np.clip(np.nan_to_num(buffers.numbers(held["COLOR_0"], used)), 0.0, 1.0)
        colors = given[:, :3][faces]
        see_through = material.alphaMode in CUT_OUTS and given.shape[1] == 4 and bool((given[:, 3] < 1.0).any())
    normals = buffers.numbers(held["NORMAL"], used) if "NORMAL" in held else None
    part = ImportedPart(vertices, faces, normals, uvs, colors, ImportedSurface(), flat=True)
    by = bound(path, header, buffers, primitive, used) if skinned else None
    targets, turns = targets_of(path, header, buffers, primitive, used, extras)
    return _Piece(part, primitive.material, see_through, by, targets, turns)


def _triangles(order: Ints, mode: int) -> Ints:
    """Return the faces (F, 3) of a primitive (section 3.7.2.1) with vertices in that order."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    number = np.arange(max(0, len(order) - 2))
    if mode == STRIP:
        corners = np.stack([number, number + 1 + number % 2, number + 2 - number % 2], axis=1)
    else:
        corners = np.stack([number + 1, number + 2, np.zeros_like(number)], axis=1)
    faces = order[corners]
    joints = (faces == np.roll(faces, 1, axis=1)).any(axis=1)  # with which strips go on elsewhere
    return np.asarray(faces[~joints], np.int64)


def _moved(uvs: Doubles, use: TextureUse | None) -> Doubles:
    """Return texture coordinates (V, 2) as the transform of a texture moves them."""
    if use is None:
        return uvs
    given = use.transform
    sine, cosine = np.sin(given.rotation), np.cos(given.rotation)
    u, v = (uvs * given.scale).T
    return np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=1) + given.offset
