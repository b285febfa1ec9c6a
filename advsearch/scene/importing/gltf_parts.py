"""Reader of glTF files: the primitives that nodes draw, as parts in their poses.

Materials are those of glTF 2.0, section 3.9; wrap modes of textures are in section
3.8.4.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from advsearch.errors import FileFormatError
from advsearch.scene.assets import (
    Float32Array,
    Float64Array,
    IntArray,
    compute_area_vectors,
)
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing import gltf_entries, gltf_skeleton
from advsearch.scene.importing.files import (
    SPLATS_ADVICE,
    Notes,
    check_faces,
    damaged,
    format_name,
)
from advsearch.scene.importing.gltf import (
    SUPPORTED_EXTENSIONS,
    GltfFile,
    find_unread_extensions,
    is_splat_name,
)
from advsearch.scene.importing.gltf_entries import (
    GENERATOR,
    TRANSPARENT_MODES,
    Entry,
    Header,
    MaterialEntry,
    Primitive,
    Sampler,
    TextureInfo,
)
from advsearch.scene.importing.parts import (
    FLAT_TEXEL,
    ImportedPart,
    ImportedSurface,
    apply_opacity,
    clip_to_unit,
    compute_radiance,
    describe_substitute,
    is_plain_white,
    make_normal_map,
    transform_part,
)
from advsearch.scene.importing.pictures import TEXTURE_LIMIT, FileImages, ImageKind
from advsearch.scene.importing.texture import average_over_faces
from advsearch.scene.importing.unread import TrackedKeys
from advsearch.scene.skeleton import MorphTarget, Movable, Skeleton

# ---- Notes on entries of a glTF file that our scenes cannot represent ----
#
# Nothing is dropped silently. The name of the file is the subject of each sentence.

_OPAQUE = "lets light pass through surfaces with {name}; here they are opaque"
EXTENSION_NOTES = {
    "EXT_mesh_gpu_instancing": "repeats meshes with {name}; each is imported once",
    "KHR_materials_diffuse_transmission": _OPAQUE,
    "KHR_materials_pbrSpecularGlossiness": "has {name}, of which only diffuse colour "
    "and glossiness are read",
    "KHR_materials_transmission": _OPAQUE,
    "KHR_materials_unlit": "has surfaces that keep their colour in any light "
    "({name}); here they are lit as others",
    "KHR_materials_variants": "has variants of its materials ({name}); the default "
    "ones are used",
}
"""Predicates of notes about extensions, whose subject is the file."""
UNKNOWN_EXTENSION_NOTE = "uses {name}, which is not supported and left out"
"""Predicate of the note about an extension that has none in `EXTENSION_NOTES`."""
MAX_SENTENCE_LENGTH = 500  # limit of the characters of a note of the USD converter
DIRECTIONAL_LIGHT_DISTANCE = 1000.0  # distance of a directional light, in object sizes


def note_skipped_contents(header: Header, notes: Notes) -> None:
    """Note the contents of a file that are not imported.

    First come notes of the converter from OpenUSD, then extensions, and then maps,
    materials, scenes, nodes and keys that are not read. The notes do not depend on
    whether the object is one node of the file or the full file.

    Args:
        header: the parsed JSON of the file.
        notes: notes about the file, to which sentences are added.
    """
    _note_converter_sentences(header, notes)
    _note_extensions(header, notes)
    for sentence in _count_phrases(_find_left_out_entries(header)):
        notes.warn(sentence)
    _note_unread(header, notes)


def _note_converter_sentences(header: Header, notes: Notes) -> None:
    """Note the sentences that our converter from OpenUSD wrote into a file."""
    is_converted = header.asset.generator == GENERATOR
    if not is_converted or not isinstance(header.asset.extras, dict):
        return
    sentences = header.asset.extras.get("left_out")
    if not isinstance(sentences, list):
        return
    for sentence in sentences:
        predicate = format_name(
            str(sentence), quoted=False, max_length=MAX_SENTENCE_LENGTH
        )
        notes.warn_that_file(predicate)


def _note_extensions(header: Header, notes: Notes) -> None:
    """Note the extensions of a file that are read in part only, or not at all."""
    used_extensions = {*header.extensionsUsed, *header.extensionsRequired}
    if any(map(is_splat_name, used_extensions)):
        notes.warn_that_file(
            f"has Gaussian splats, which are left out: {SPLATS_ADVICE}"
        )
    # Extensions in `EXTENSION_NOTES` that are supported are read only in part.
    partly_read = used_extensions & set(EXTENSION_NOTES)
    unread = used_extensions - set(SUPPORTED_EXTENSIONS)
    for name in sorted(partly_read | unread):
        if not is_splat_name(name):
            template = EXTENSION_NOTES.get(name, UNKNOWN_EXTENSION_NOTE)
            notes.warn_that_file(template.format(name=format_name(name, quoted=False)))


def _find_left_out_entries(header: Header) -> dict[str, Iterable[bool]]:
    """Find the maps, materials, scenes and nodes of a file that are left out.

    Returns:
        For each kind a phrase, in which `{s}` is the ending of the plural, such as
        "occlusion map{s}: left out"; and for each entry whether it is left out.
    """
    materials = header.materials
    # `shares_layout` returns whether a texture has the texture coordinates of the base
    # color. It is also True for a material without that texture.
    return {
        "occlusion map{s}: left out": (
            material.occlusionTexture is not None for material in materials
        ),
        "normal map{s} with other texture coordinates than the base colour: left out": (
            not material.shares_layout(material.normalTexture) for material in materials
        ),
        "emission texture{s} with other coordinates than the base colour: left out, "
        "with the emission": map(_has_unreadable_emission, materials),
        "material{s} with an alphaMode that glTF does not have: opaque": (
            material.alphaMode not in ("OPAQUE", *TRANSPARENT_MODES)
            for material in materials
        ),
        "further scene{s}: left out": (True for _ in header.scenes[1:]),
        "node{s} with a mesh outside of its scene: left out": _list_has_mesh_outside(
            header
        ),
    }


def _has_unreadable_emission(material: MaterialEntry) -> bool:
    """Return whether an emission has other texture coordinates than the base color."""
    has_emission = any(material.emission)
    return has_emission and not material.shares_layout(material.emissiveTexture)


def _list_has_mesh_outside(header: Header) -> list[bool]:
    """Return for each node outside of the default scene whether it has a mesh."""
    roots: Iterable[int] = range(len(header.nodes))
    if header.scenes:
        default_scene = header.scene or 0
        roots = header.scenes[default_scene].nodes
    scene_nodes = header.find_descendants(roots)  # with the roots themselves
    return [
        node.mesh is not None
        for index, node in enumerate(header.nodes)
        if index not in scene_nodes
    ]


ENTRY_KINDS = {
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
"""Kind, for notes, of the keys of each type of entry that are left out."""
IGNORED_KEYS = frozenset(("name", "weights", "extensions"))
"""Keys without a field that need no note: they change nothing, or another note reports
them.
"""


def _note_unread(header: Header, notes: Notes) -> None:
    """Note the keys of entries, and the attributes of primitives, that are not read.

    Keys inside extensions that are read are noted too. All other extensions are noted
    by name, in `_note_extensions`.
    """
    for entry in header.iterate_entries():
        kind = ENTRY_KINDS.get(type(entry).__name__)
        # Entries of other types, such as accessors, have no keys that change the image.
        if kind is not None:
            for key in _find_unread_keys(entry):
                notes.record(kind, key)
    _mark_ignored_keys(notes)
    for mesh in header.meshes:
        for primitive in mesh.primitives:
            _note_unread_attributes(header, primitive, notes)


def _mark_ignored_keys(notes: Notes) -> None:
    """Mark the keys that need no note as read, so that they are not noted."""
    for kind in set(ENTRY_KINDS.values()):
        ignored_keys = set(IGNORED_KEYS)
        # Extras of a material or a texture may change how it looks. Elsewhere they are
        # private data of applications, which need no note.
        if "material" not in kind and "texture" not in kind:
            ignored_keys.add("extras")
        for key in ignored_keys:
            notes.mark_read(kind, key)


def _find_unread_keys(entry: Entry) -> list[str]:
    """Return the keys of an entry that have no field, also within its extensions."""
    # `model_extra` has the keys without a field. `extensions` has a field, but may have
    # unread keys inside.
    keys = TrackedKeys({**(entry.model_extra or {}), "extensions": entry.extensions})
    extensions = keys.get_nested("extensions")
    for name, read_keys in entry.list_extension_keys().items():
        extension = extensions.get_nested(name)
        is_separate_entry = not read_keys
        if is_separate_entry:
            # `iterate_entries` yields this extension as an entry, and then its unread
            # keys are found. Here all of its keys are marked as read.
            read_keys = {key for key, _ in extension.items()}
        extension.mark_read(*read_keys)
    # Extensions that are not supported are noted once for the file.
    extensions.mark_read(*(name for name, _ in extensions.items()))
    return keys.find_unread()


def _note_unread_attributes(header: Header, primitive: Primitive, notes: Notes) -> None:
    """Note the vertex attributes of a primitive that are not read.

    Attributes of skins are read if the file has skins. Gaussian splats are noted by
    `_note_extensions`.
    """
    read_names = {"POSITION", "NORMAL", "COLOR_0", "TEXCOORD_0"}
    if primitive.material is not None:
        material = header.materials[primitive.material]
        # Normal maps and emission are read only with the coordinates of the base color.
        read_names.add(material.uv_attribute)
        roughness_texture = material.metallic_roughness.metallicRoughnessTexture
        if roughness_texture is not None:
            read_names.add(roughness_texture.uv_attribute)
    for name in primitive.attributes:
        is_of_skin = header.skins and name.startswith(("JOINTS_", "WEIGHTS_"))
        if name not in read_names and not is_of_skin and not is_splat_name(name):
            notes.record("attribute", name)


def describe_left_out(header: Header, file: str) -> list[str]:
    """Describe the lights and cameras that a file read as one object leaves out.

    Returns:
        One sentence, or none if there are no lights and cameras.
    """
    has_light = [node.lamp is not None for node in header.nodes]
    has_camera = [node.camera is not None for node in header.nodes]
    phrases = _count_phrases({"light{s}": has_light, "camera{s}": has_camera})
    if not phrases:
        return []
    verb = "is" if sum(has_light) + sum(has_camera) == 1 else "are"
    advice = "name one node as the object, FILE#NODE, to import the rest around it"
    return [f"{file}: {' and '.join(phrases)} {verb} left out of the object; {advice}"]


def describe_changed_lights(header: Header, file: str) -> list[str]:
    """Describe the lights and cameras of a file that are imported as something else."""
    directional = (
        f"directional light{{s}}, here as lamps "
        f"{DIRECTIONAL_LIGHT_DISTANCE:g} object sizes away"
    )
    ranged = "light{s} with a range, which is left out: light reaches beyond it"
    # Each phrase is counted over the lights or cameras for which it holds.
    phrases = {
        directional: (light.type == "directional" for light in header.lights),
        ranged: (light.range is not None for light in header.lights),
        "camera{s} without perspective: left out": (
            camera.perspective is None for camera in header.cameras
        ),
    }
    return [f"{file}: {sentence}" for sentence in _count_phrases(phrases)]


def _count_phrases(kinds: Mapping[str, Iterable[bool]]) -> list[str]:
    """Return a phrase with a count, such as "2 cameras", for each kind that occurs.

    Args:
        kinds: for each phrase, whether each entry of the file is of that kind. {s} and
            {es} in the phrase become plural endings.
    """
    phrases = []
    for phrase, is_of_kind in kinds.items():
        count = sum(is_of_kind)
        if count:
            phrases.append(_format_count(count, phrase))
    return phrases


def _format_count(count: int, phrase: str) -> str:
    """Return a count and a phrase, whose {s} and {es} are endings of the plural."""
    if count == 1:
        return f"{count} {phrase.format(s='', es='')}"
    return f"{count} {phrase.format(s='s', es='es')}"


# Texture coordinates may be outside [0, 1] by this much before the wrap mode matters.
WRAP_TOLERANCE = 1e-4
SMALL_IMAGE_SIZE = 256  # texels of a side up to which half a texel is visible
# Predicates of notes, whose subject is the file.
EDGES_NOTE = (
    "has textures that do not repeat beyond their edges; where they differ, or reach "
    "far, they do here"
)
BLURRED_NOTE = (
    "has textures with sharp texels (filter NEAREST); those above {most} texels a "
    "side are filtered"
)

NOT_REPEATED = (gltf_entries.CLAMPED, gltf_entries.BORDER, gltf_entries.MIRRORED)
"""Wrap modes whose images end at their edges, or are mirrored there."""


@dataclass
class GltfSurfaces:
    """Converts the materials of one glTF file to surfaces."""

    file: GltfFile
    notes: Notes  # notes about the file
    # Longest side of a texture; None for the limit that `FileImages` computes.
    texture_limit: int | None = None

    def __post_init__(self) -> None:
        """Prepare to decode images, whose size depends on the number of materials."""
        n_materials = len(self.file.header.materials)
        self._images = FileImages(
            n_materials, self.file.references, self.notes, self.texture_limit
        )

    def make_surface(
        self, material_index: int | None, pieces: Sequence[PrimitiveData]
    ) -> tuple[ImportedSurface, Float64Array, Float64Array]:
        """Convert one material.

        Args:
            material_index: index of the material; None is the format's default.
            pieces: all primitives with the material, with texture coordinates as the
                file stores them.

        Returns:
            The surface; and the scale (2,) and shift (2,) by which a texture coordinate
            t of the file becomes scale * t + shift.
        """
        material, name = self._get_named_material(material_index)
        surface = self._make_unfitted_surface(material, name, pieces)
        uvs = [piece.part.uvs for piece in pieces if piece.part.uvs is not None]
        return self._fit_images(surface, material, uvs)

    def _make_unfitted_surface(
        self, material: MaterialEntry, name: str, pieces: Sequence[PrimitiveData]
    ) -> ImportedSurface:
        """Return the surface of a material, with its images as the file has them.

        Args:
            material: the material.
            name: its name.
            pieces: all primitives with the material.
        """
        color, texture = self._make_base_color(material)
        roughness, metallic = self._compute_roughness_and_metallic(material, pieces)
        return ImportedSurface(
            color=color,
            texture=texture,
            roughness=clip_to_unit(roughness),
            metallic=clip_to_unit(metallic),
            normal_map=self._make_normal_map(material),
            emission=self._make_emission(material),
            name=name,
        )

    def _get_named_material(
        self, material_index: int | None
    ) -> tuple[MaterialEntry, str]:
        """Return a material and its name; None is the format's default, without name."""
        if material_index is None:
            return MaterialEntry(), ""
        material = self.file.header.materials[material_index]
        return material, material.name or f"material {material_index}"

    def _make_base_color(
        self, material: MaterialEntry
    ) -> tuple[Float32Array | None, Float32Array | None]:
        """Return the base color (3 or 4,) and its texture (H, W, 3 or 4), in sRGB.

        The base color factor multiplies the texture. There is a fourth channel, the
        opacity, only for the alpha modes "MASK" and "BLEND". The color is None if it is
        plain white and the material names a texture, even if its file is missing.
        """
        factor = _get_base_color_factor(material)
        opacity_factor = factor[3:]
        color = linear_to_srgb(factor[:3])  # factors are linear in glTF
        texture = self._make_base_texture(material, color, factor[:3])
        base_color: Float32Array | None = color
        has_texture = material.metallic_roughness.baseColorTexture is not None
        if has_texture and is_plain_white(color):
            base_color = None  # plain white does not change a texture
        if material.alphaMode in TRANSPARENT_MODES:
            # "BLEND" keeps partial opacity, "MASK" cuts out what is below the cutoff.
            cutoff = None if material.alphaMode == "BLEND" else material.alphaCutoff
            base_color = apply_opacity(base_color, opacity_factor, cutoff)
            texture = apply_opacity(texture, opacity_factor, cutoff)
        return base_color, texture

    def _make_base_texture(
        self, material: MaterialEntry, color: Float32Array, factor: Float32Array
    ) -> Float32Array | None:
        """Return the texture of the base color, sRGB, times a linear factor (3,); or None.

        `color` (3,) is the factor in sRGB.
        """
        texture = self._load_base_texture(material, color)
        if texture is None or not (factor != 1.0).any():
            return texture
        return _multiply_colors(texture, factor)

    def _load_base_texture(
        self, material: MaterialEntry, color: Float32Array
    ) -> Float32Array | None:
        """Return the texture (H, W, 3 or 4) of the base color as the file has it, or None.

        `color` is what is used instead, for the note if it cannot be read.
        """
        image_kind: ImageKind = "colours"
        if material.alphaMode in TRANSPARENT_MODES:
            image_kind = "colours and alpha"
        return self._load_image(
            material.metallic_roughness.baseColorTexture,
            image_kind,
            # The blank makes the file the subject: "chair.glb names the texture ...".
            f" names the texture {{name}}, which {{why}}; {describe_substitute(color)} "
            "is used instead",
        )

    def _make_normal_map(self, material: MaterialEntry) -> Float32Array | None:
        """Return the normal map (H, W, 3) of a material, or None."""
        use = material.normalTexture
        if use is None or not material.shares_layout(use):
            return None
        image = self._load_image(
            use, "numbers", "the normal map {name} {why}; it is left out"
        )
        return None if image is None else make_normal_map(image, use.scale)

    def _make_emission(self, material: MaterialEntry) -> Float32Array | None:
        """Return the radiance (H, W, 3) that a material emits, or None.

        Its unit is that of environments, as in Blender (section 3.9.3, and
        KHR_materials_emissive_strength). It is None if the material emits no light, if
        its texture cannot be read, or if it has other texture coordinates than the base
        color.
        """
        factor = np.array(material.emission)
        use = material.emissiveTexture
        if not factor.any() or not material.shares_layout(use):
            return None
        image = self._load_image(
            use, "colours", "the texture {name} of the emission {why}; it is left out"
        )
        # If the texture cannot be read, there is no emission: without the texture, all
        # of the surface would emit light.
        if use is not None and image is None:
            return None
        return compute_radiance(factor, image, self.notes)

    def _compute_roughness_and_metallic(
        self, material: MaterialEntry, pieces: Sequence[PrimitiveData]
    ) -> tuple[float, float]:
        """Return roughness and metallic: the factors times the mean of their texture.

        The mean is that over the faces with the texture, or over all texels if faces
        have no texture coordinates.

        Args:
            material: the material.
            pieces: all primitives with the material.
        """
        entry = material.metallic_roughness
        use = entry.metallicRoughnessTexture
        note = "the texture {name} of roughness and metallic {why}; it is left out"
        image = self._load_image(use, "numbers", note)
        if image is None or use is None:
            return entry.roughnessFactor, entry.metallicFactor
        self.notes.warn(
            "textures of roughness and metallic are replaced by their means"
        )
        # The format has roughness in the green channel, metallic in the blue one.
        _, green, blue = _average_where_visible(image, pieces).tolist()
        return entry.roughnessFactor * green, entry.metallicFactor * blue

    def _load_image(
        self, use: TextureInfo | None, kind: ImageKind, note_template: str
    ) -> Float32Array | None:
        """Return the texels (H, W, C) of a texture for a renderer that filters.

        If the file requests sharp texels (filter NEAREST), each texel is repeated, so
        that filtering is not visible. A texture too large for that is filtered, with a
        note.

        Args:
            use: the texture; None returns None.
            kind: content of the image, such as "colours".
            note_template: the note if it has no texels, with `{name}` for the image and
                `{why}` for the reason; then None is returned.
        """
        if use is None:
            return None
        texels = self._load_texels(use, kind, note_template)
        is_unfiltered = self._get_sampler(use).magFilter == gltf_entries.NEAREST
        is_single_texel = texels is not None and texels.shape[:2] == (1, 1)
        if texels is None or not is_unfiltered or is_single_texel:
            return texels
        return self._sharpen(texels)

    def _sharpen(self, texels: Float32Array) -> Float32Array:
        """Repeat texels (H, W, C), so that filtering is not visible, or note that it is.

        Texels are repeated until the longer side has up to half the limit of a texture.
        """
        max_sharp_size = min(self._images.max_side, TEXTURE_LIMIT) // 2
        repeats = max_sharp_size // max(texels.shape[:2])
        min_repeats = 2
        if repeats < min_repeats:
            largest_side = max_sharp_size // min_repeats
            self.notes.warn_that_file(BLURRED_NOTE.format(most=largest_side))
            return texels
        return texels.repeat(repeats, axis=0).repeat(repeats, axis=1)

    def _load_texels(
        self, use: TextureInfo, kind: ImageKind, note_template: str
    ) -> Float32Array | None:
        """Return the texels (H, W, C) of a texture as the file has them.

        Args:
            use: the texture.
            kind: content of the image, such as "colours".
            note_template: the note if it has no texels, with `{name}` for the image and
                `{why}` for the reason; then None is returned.
        """
        image_index = self.file.header.textures[use.index].image_index
        if image_index is None:
            self._images.note_missing(
                "(embedded)",
                "has a picture in an unsupported format",
                note_template,
            )
            return None
        entry = self.file.header.images[image_index]
        # Several textures may show the same image, a file or a buffer view. It is
        # decoded once.
        key = (entry.uri, entry.bufferView)
        name = _name_image(entry)
        load_content = partial(self._load_image_content, entry)
        return self._images.load_image(key, load_content, kind, name, note_template)

    def _load_image_content(self, entry: gltf_entries.Image) -> bytes:
        """Return the bytes of an image's file or buffer view; empty if it has none."""
        if entry.uri is not None:
            return self.file.load_uri(entry.uri)
        if entry.bufferView is None:
            return b""
        return bytes(self.file.get_view_bytes(entry.bufferView))

    def _get_sampler(self, use: TextureInfo) -> Sampler:
        """Return the sampler of a texture, which has defaults if the file states none."""
        sampler_index = self.file.header.textures[use.index].sampler
        if sampler_index is None:
            return Sampler()
        return self.file.header.samplers[sampler_index]

    def _fit_images(
        self,
        surface: ImportedSurface,
        material: MaterialEntry,
        uvs: Sequence[Float64Array],
    ) -> tuple[ImportedSurface, Float64Array, Float64Array]:
        """Change a surface's images so that repeating them looks like their wrap modes.

        The renderer repeats all textures, so that other wrap modes are a part of the
        images: see `_fit_axis`.

        Args:
            surface: the surface.
            material: its material in the file, which has the wrap modes.
            uvs: texture coordinates (V, 2) of all primitives with the material.

        Returns:
            The surface, and the scale (2,) and shift (2,) of texture coordinates.
        """
        scale = np.ones(2)
        shift = np.zeros(2)
        images = list(surface.images)
        uv_bounds = _compute_uv_bounds(uvs)
        if not images or uv_bounds is None:
            return surface, scale, shift
        wraps_by_axis = self._list_wraps_by_axis(material)
        for axis, wraps in enumerate(wraps_by_axis):
            # u, the first coordinate, runs along the second axis of an image.
            images, scale[axis], shift[axis] = self._fit_axis(
                images,
                axis=1 - axis,
                wraps=wraps,
                bounds=uv_bounds[axis],
                normals_index=_find_normals_index(surface),
            )
        return surface.with_images(images), scale, shift

    def _list_wraps_by_axis(
        self, material: MaterialEntry
    ) -> tuple[list[int], list[int]]:
        """Return the wrap modes along u, and along v, of a material's textures."""
        samplers = self._list_samplers(material)
        return (
            [sampler.wrapS for sampler in samplers],
            [sampler.wrapT for sampler in samplers],
        )

    def _list_samplers(self, material: MaterialEntry) -> list[Sampler]:
        """Return the samplers of a material's textures that are read.

        The first is that of the texture whose coordinates the mesh has. Textures whose
        images are missing have a sampler, too.
        """
        uses = (
            material.metallic_roughness.baseColorTexture,
            material.normalTexture,
            material.emissiveTexture,
        )
        return [
            self._get_sampler(use)
            for use in uses
            if use is not None and material.shares_layout(use)
        ]

    def _fit_axis(
        self,
        images: list[Float32Array],
        axis: int,
        wraps: Sequence[int],
        bounds: tuple[float, float],
        normals_index: int | None,
    ) -> tuple[list[Float32Array], float, float]:
        """Fit images (H, W, C) along one axis to the wrap mode of the first of them.

        If texture coordinates reach outside [0, 1], mirrored images are doubled, and
        images that are clamped or have a border are padded. If coordinates are inside
        [0, 1], images of all three modes are padded by their edges only where opposite
        edges would blend visibly. Repeated images are not changed.

        Args:
            images: the images of a surface.
            axis: axis of their arrays, 0 for rows.
            wraps: wrap modes of the material's textures. The first is applied to all
                images; if others differ, and it matters, there is a note.
            bounds: smallest and largest texture coordinate along the axis.
            normals_index: index of the normal map in `images`; None if there is none.

        Returns:
            The images, and scale and shift of texture coordinates.
        """
        reaches_out = bounds[0] < -WRAP_TOLERANCE or bounds[1] > 1.0 + WRAP_TOLERANCE
        edges_differ = any(_edges_differ(image, axis) for image in images)
        first_wrap = wraps[0]
        if reaches_out and len(set(wraps)) > 1:
            self.notes.warn_that_file(EDGES_NOTE)
        # If coordinates are inside [0, 1], the border is not visible.
        has_border = first_wrap == gltf_entries.BORDER and reaches_out
        if has_border:
            # Filtering blends the border into the outer half of the edge's texels. If
            # texels are small enough, that is not visible.
            images = [_enlarge(image, axis) for image in images]
        if first_wrap == gltf_entries.MIRRORED and reaches_out:
            return [_append_mirror_image(image, axis) for image in images], 0.5, 0.0
        if first_wrap in NOT_REPEATED and (reaches_out or edges_differ):
            return self._pad_images(images, axis, bounds, normals_index, has_border)
        return images, 1.0, 0.0

    def _pad_images(
        self,
        images: list[Float32Array],
        axis: int,
        bounds: tuple[float, float],
        normals_index: int | None,
        has_border: bool,
    ) -> tuple[list[Float32Array], float, float]:
        """Pad images along an axis as far as texture coordinates reach.

        The pads have the texels that the wrap mode requires beyond the image. Images
        that would become larger than twice the limit of a texture stay as they are,
        with a note.

        Args:
            images: images of one surface, perhaps of different sizes.
            axis: axis of their arrays, 0 for rows.
            bounds: smallest and largest texture coordinate along the axis.
            normals_index: index of the normal map in `images`; None if there is none.
            has_border: whether pads are black (flat in a normal map); otherwise they
                repeat the edge.

        Returns:
            The images; and the scale and shift by which a coordinate t of an old image
            becomes that of the padded one, scale * t + shift.
        """
        sizes = [image.shape[axis] for image in images]
        units = _count_units(sizes, bounds)
        if units.padded * (max(sizes) // units.image) > 2 * self._images.max_side:
            self.notes.warn_that_file(EDGES_NOTE)
            return images, 1.0, 0.0
        borders = _list_borders(len(images), normals_index, has_border)
        padded = []
        for image, border in zip(images, borders, strict=True):
            unit = image.shape[axis] // units.image  # in texels of this image
            pads = (units.before * unit, units.after * unit)
            padded.append(_pad(image, axis, *pads, border))
        scale = units.image / units.padded
        shift = units.before / units.padded
        return padded, scale, shift


def _name_image(entry: gltf_entries.Image) -> str:
    """Return the URI of an image's file, or "(embedded)" if the image is in the file."""
    is_embedded = entry.uri is None or entry.uri.startswith("data:")
    return "(embedded)" if is_embedded else str(entry.uri)


def _compute_uv_bounds(
    uvs: Sequence[Float64Array],
) -> list[tuple[float, float]] | None:
    """Return the smallest and the largest u, and the smallest and the largest v.

    `uvs` are texture coordinates (V, 2) of several primitives. The result is None if
    there are none, or if one is NaN or infinite.
    """
    # An empty array is added, since none at all cannot be concatenated.
    all_uvs = np.concatenate([*uvs, np.zeros((0, 2))])
    if not len(all_uvs) or not np.isfinite(all_uvs).all():
        return None
    return [(float(column.min()), float(column.max())) for column in all_uvs.T]


def _list_borders(
    n_images: int, normals_index: int | None, has_border: bool
) -> list[Float32Array | None]:
    """Return the texel (1,) or (C,) beyond the edges of each image; see `_pad_images`.

    All are None if images have no border.
    """
    if not has_border:
        return [None] * n_images
    borders: list[Float32Array | None] = [np.zeros(1, np.float32)] * n_images
    if normals_index is not None:
        borders[normals_index] = FLAT_TEXEL
    return borders


def _get_base_color_factor(material: MaterialEntry) -> Float32Array:
    """Return the linear factor (4,) of a base color and its opacity, in [0, 1]."""
    stated_factor = material.metallic_roughness.baseColorFactor
    if stated_factor is None:
        stated_factor = [1.0] * 4
    factor: Float32Array = np.array(stated_factor, np.float32)
    return factor.clip(0, 1)


def _find_normals_index(surface: ImportedSurface) -> int | None:
    """Return the index of the normal map in a surface's images; None if it has none.

    The images are the texture, if there is one, then the normal map, then the emission.
    """
    if surface.normal_map is None:
        return None
    return 0 if surface.texture is None else 1


def _append_mirror_image(image: Float32Array, axis: int) -> Float32Array:
    """Return an image and its mirror image along an axis: old UVs cover the first half."""
    return np.concatenate([image, np.flip(image, axis)], axis=axis)


def _multiply_colors(texture: Float32Array, factor: Float32Array) -> Float32Array:
    """Multiply the colors of a texture (H, W, 3 or 4), sRGB, by a linear factor (3,)."""
    linear = srgb_to_linear(texture[:, :, :3]) * factor
    return np.concatenate([linear_to_srgb(linear), texture[:, :, 3:]], axis=2)


class _PadUnits(NamedTuple):
    """Lengths along an axis of images and their pads, in units.

    All images of a surface have the same texture coordinates, so that their pads must
    be the same fraction of an image. A pad must also be an integer number of texels. So
    each image is divided into the same number of units, the greatest common divisor of
    the sizes.

    Attributes:
        image: number of units of each image.
        before: number of units of the pad before it.
        after: number of units of the pad after it.
    """

    image: int
    before: int
    after: int

    @property
    def padded(self) -> int:
        """Number of units of an image with its pads."""
        return self.image + self.before + self.after


def _count_units(sizes: list[int], bounds: tuple[float, float]) -> _PadUnits:
    """Return the units of images and of the pads that they need.

    An image covers the texture coordinates from 0 to 1. Pads reach as far as texture
    coordinates, and one unit farther, so that filtering does not reach beyond them.

    Args:
        sizes: number of texels of each image along an axis.
        bounds: smallest and largest texture coordinate.
    """
    n_units = int(np.gcd.reduce(sizes))
    min_uv, max_uv = bounds
    units_before = max(0, int(np.ceil(-min_uv * n_units))) + 1
    units_after = max(0, int(np.ceil((max_uv - 1.0) * n_units))) + 1
    return _PadUnits(n_units, units_before, units_after)


def _average_where_visible(
    image: Float32Array, pieces: Sequence[PrimitiveData]
) -> Float32Array:
    """Return the mean (C,) of an image over the faces of some primitives that show it.

    It is the mean of all texels if no primitive has texture coordinates for it.

    Args:
        image: (H, W, C) values.
        pieces: the primitives with the material.
    """
    mapped_parts = [
        (piece.part, piece.roughness_uvs)
        for piece in pieces
        if piece.roughness_uvs is not None
    ]
    if not mapped_parts:
        return np.asarray(image.mean(axis=(0, 1), dtype=np.float64), np.float32)
    # v points down in the file, and up in `average_over_faces`: it becomes 1 - v.
    corner_uvs = [
        uvs[part.faces] * [1.0, -1.0] + [0.0, 1.0] for part, uvs in mapped_parts
    ]
    corners = [part.vertices[part.faces] for part, _ in mapped_parts]
    areas = np.linalg.norm(compute_area_vectors(np.concatenate(corners)), axis=1)
    return average_over_faces(image, np.concatenate(corner_uvs), areas)


def _edges_differ(image: Float32Array, axis: int) -> bool:
    """Return whether a repeated image would blend visibly at its edges along an axis.

    Filtering blends half a texel at an edge with the opposite edge. That is visible
    only in small images, and only if the two edges differ.
    """
    if image.shape[axis] > SMALL_IMAGE_SIZE:
        return False
    return not np.array_equal(np.take(image, 0, axis), np.take(image, -1, axis))


def _pad(
    image: Float32Array, axis: int, before: int, after: int, border: Float32Array | None
) -> Float32Array:
    """Pad an image along an axis by a number of texels before and after it.

    Args:
        image: (H, W, C) texels.
        axis: axis of the array, 0 for rows.
        before, after: width of the pads in texels.
        border: (1,) or (C,) value of the pads; None repeats the texel at the edge.
    """
    size = image.shape[axis]
    texel_index = np.clip(np.arange(-before, size + after), 0, size - 1)
    padded = np.take(image, texel_index, axis)
    if border is not None:
        position = np.arange(len(texel_index))
        is_outside = (position < before) | (position >= before + size)
        along_axis = np.moveaxis(padded, axis, 0)  # a view
        along_axis[is_outside] = border
    return padded


def _enlarge(picture: Float32Array, axis: int) -> Float32Array:
    """Enlarge an image to at least `SMALL_IMAGE_SIZE` texels along an axis.

    It is interpolated linearly, by an integer factor. At that size a border of one
    texel is not visible.
    """
    size = picture.shape[axis]
    # negated twice, so that the quotient is rounded up
    factor = -(-SMALL_IMAGE_SIZE // size)
    if factor == 1:
        return picture
    return _interpolate_texels(picture, axis, factor)


def _interpolate_texels(picture: Float32Array, axis: int, factor: int) -> Float32Array:
    """Interpolate an image linearly to `factor` times as many texels along an axis."""
    size = picture.shape[axis]
    # Positions of the new texels' centers, in units of old texels. The centers of old
    # texels are at integers.
    position = ((np.arange(size * factor) + 0.5) / factor - 0.5).clip(0.0, size - 1.0)
    lower = np.floor(position).astype(np.int64)
    shape = [1] * picture.ndim
    shape[axis] = -1
    fraction = (position - lower).reshape(shape).astype(np.float32)
    upper = np.minimum(lower + 1, size - 1)
    enlarged: Float32Array = np.take(picture, lower, axis) * (1.0 - fraction)
    enlarged = enlarged + np.take(picture, upper, axis) * fraction
    return enlarged


# ---- Primitives ----

# Modes of primitives; those below `TRIANGLES` are points and lines.
TRIANGLES = 4
STRIP = 5
FAN = 6
TRANSPARENT_COLORS_NOTE = (
    "mesh{es} with an opacity in vertex colours, which is left out"
)
DEFAULT_MATERIAL_NOTE = (
    "mesh{es} without material: the default of glTF, white metal with roughness 1, is "
    "used"
)


PrimitiveKey = tuple[int, int]  # index of a mesh, and of a primitive in it


class _Instance(NamedTuple):
    """A mesh that a node draws."""

    node: int
    mesh: int
    pose: Float64Array  # (4, 4) from the node's coordinates to the scene's


def _list_instances(header: Header) -> list[_Instance]:
    """Return every mesh that a node of the scene draws, in order of the nodes."""
    poses = sorted(gltf_skeleton.iterate_node_poses(header), key=lambda item: item[0])
    instances = []
    for node, pose in poses:
        mesh = header.nodes[node].mesh
        if mesh is not None:
            instances.append(_Instance(node, mesh, pose))
    return instances


def _select_with_faces(
    pieces: Mapping[PrimitiveKey, PrimitiveData | None],
) -> dict[PrimitiveKey, PrimitiveData]:
    """Return the primitives that have faces, by the indices of mesh and primitive."""
    return {
        key: piece
        for key, piece in pieces.items()
        if piece is not None and len(piece.part.faces)
    }


# NaN and infinite coordinates are reported by `join_parts`, not by NumPy's warnings.
@np.errstate(all="ignore")
def read_gltf(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Read the primitives of a glTF file that its nodes draw, as one part each.

    Args:
        path: path of the file.
        data: its bytes, of a .gltf or a .glb file.
        notes: notes about the file, to which sentences are added.

    Raises:
        FileFormatError: the file is corrupt, or no primitive has faces.
    """
    file = GltfFile(path, data)
    instances = _list_instances(file.header)
    mesh_nodes = [instance.node for instance in instances]
    target_counts = gltf_skeleton.count_targets(file, mesh_nodes)
    with_faces = _read_pieces_with_faces(file, mesh_nodes, notes)
    parts_by_key = _make_parts(GltfSurfaces(file, notes), with_faces)
    skins = _read_skins(file, mesh_nodes)
    skeleton = gltf_skeleton.read_skeleton(file, target_counts)
    if skeleton is not None:
        _note_skeleton(skeleton, notes)

    parts = _pose_parts(file, instances, parts_by_key, with_faces, skins, skeleton)
    # The faces of a mesh count once for each node that draws it.
    check_faces(path, sum(len(part.faces) for part in parts))
    return parts


def _read_pieces_with_faces(
    file: GltfFile, mesh_nodes: Sequence[int], notes: Notes
) -> dict[PrimitiveKey, PrimitiveData]:
    """Read the primitives with faces that nodes draw, and note what else the file has.

    Raises:
        FileFormatError: no primitive has faces.
    """
    header = file.header
    pieces = _read_pieces(file, mesh_nodes)
    with_faces = _select_with_faces(pieces)
    if not with_faces:
        raise _make_no_faces_error(file.path, header, has_primitives=bool(pieces))
    note_skipped_contents(header, notes)
    _note_pieces(header, keys=list(pieces), with_faces=with_faces, notes=notes)
    return with_faces


class SkinPose(NamedTuple):
    """A skin at rest."""

    joint_nodes: IntArray  # (J,) its joints, which are nodes
    inverse_binds: Float64Array  # (J, 4, 4) from the mesh to each joint
    matrices: Float64Array  # (J, 4, 4) from the mesh to the scene


def _read_pieces(
    file: GltfFile, mesh_nodes: Sequence[int]
) -> dict[PrimitiveKey, PrimitiveData | None]:
    """Read the primitives that nodes draw, each once.

    Args:
        file: the glTF file.
        mesh_nodes: indices of nodes that have a mesh.

    Returns:
        The primitives by the indices of the mesh and of the primitive in it. The value
        is None for a primitive of points or lines.
    """
    header = file.header
    meshes = dict.fromkeys(header.nodes[node].mesh for node in mesh_nodes)
    skinned_meshes = _find_skinned_meshes(header, mesh_nodes)
    pieces = dict[PrimitiveKey, PrimitiveData | None]()
    for mesh in meshes:
        assert mesh is not None  # for mypy: these nodes have meshes
        entry = header.meshes[mesh]
        is_skinned = mesh in skinned_meshes
        for index, primitive in enumerate(entry.primitives):
            piece = read_primitive(file, primitive, entry.extras, is_skinned)
            pieces[mesh, index] = piece
    return pieces


def _find_skinned_meshes(header: Header, mesh_nodes: Sequence[int]) -> set[int | None]:
    """Return the meshes that some node with a skin draws."""
    return {
        header.nodes[node].mesh
        for node in mesh_nodes
        if header.nodes[node].skin is not None
    }


def _make_no_faces_error(
    path: Path, header: Header, has_primitives: bool
) -> FileFormatError:
    """Return the error for a file without any face."""
    if any(map(is_splat_name, header.extensionsUsed)):
        return FileFormatError(
            f"{path}: expected a mesh with faces, got Gaussian splats: {SPLATS_ADVICE}"
        )
    got = "points or lines only" if has_primitives else "none"
    return FileFormatError(
        f"{path}: expected a mesh with faces, got {got}; export triangles"
    )


def _note_pieces(
    header: Header,
    keys: Sequence[PrimitiveKey],
    with_faces: Mapping[PrimitiveKey, PrimitiveData],
    notes: Notes,
) -> None:
    """Note primitives without faces or material, and with transparent vertices.

    Args:
        header: the parsed JSON of the file.
        keys: all primitives, each by the index of its mesh and its index in the mesh.
        with_faces: the primitives with faces, by the same keys.
        notes: notes about the file, to which sentences are added.
    """
    primitives = [header.meshes[mesh].primitives[index] for mesh, index in keys]
    _note_without_faces(primitives, len(with_faces), notes)
    transparent_meshes = {
        mesh for (mesh, _), piece in with_faces.items() if piece.has_transparent_colors
    }
    _note_meshes(transparent_meshes, TRANSPARENT_COLORS_NOTE, notes)
    meshes_without_material = {
        mesh for (mesh, _), piece in with_faces.items() if piece.material_index is None
    }
    _note_meshes(meshes_without_material, DEFAULT_MATERIAL_NOTE, notes)


def _note_meshes(meshes: set[int], phrase: str, notes: Notes) -> None:
    """Note the number of meshes, if any, with a phrase as `_format_count` takes it."""
    if meshes:
        notes.warn(_format_count(len(meshes), phrase))


def _note_without_faces(
    primitives: Sequence[Primitive], n_with_faces: int, notes: Notes
) -> None:
    """Note how many primitives have no faces, without those of Gaussian splats.

    Splats have no faces either, but are noted in `_note_extensions`.
    """
    n_splats = sum(
        any(map(is_splat_name, find_unread_extensions(primitive)))
        for primitive in primitives
    )
    n_without_faces = len(primitives) - n_with_faces - n_splats
    if n_without_faces:
        notes.warn(
            f"{n_without_faces} parts without faces (points, lines) are left out"
        )


def _make_parts(
    surfaces: GltfSurfaces, with_faces: Mapping[PrimitiveKey, PrimitiveData]
) -> dict[PrimitiveKey, ImportedPart]:
    """Return the primitives as parts with their surfaces and final UVs.

    Primitives with the same material share one surface, whose images fit the texture
    coordinates of all of them.

    Args:
        surfaces: converts the file's materials.
        with_faces: the primitives, by the indices of the mesh and of the primitive.
    """
    groups = dict[int | None, dict[PrimitiveKey, PrimitiveData]]()
    for key, piece in with_faces.items():
        groups.setdefault(piece.material_index, {})[key] = piece
    parts = dict[PrimitiveKey, ImportedPart]()
    for material, group in groups.items():
        surface, scale, shift = surfaces.make_surface(material, list(group.values()))
        for key, piece in group.items():
            uvs = _convert_uvs(piece.part.uvs, scale, shift)
            parts[key] = replace(piece.part, surface=surface, uvs=uvs)
    return parts


def _convert_uvs(
    uvs: Float64Array | None, scale: Float64Array, shift: Float64Array
) -> Float64Array | None:
    """Return UVs (V, 2) of a part: scaled and shifted, with v that points up; or None.

    v points down in the file: it becomes 1 - v.
    """
    if uvs is None:
        return None
    converted_uvs: Float64Array = (uvs * scale + shift) * [1.0, -1.0] + [0.0, 1.0]
    return converted_uvs


def _read_skins(file: GltfFile, mesh_nodes: Sequence[int]) -> dict[int, SkinPose]:
    """Return the skins of nodes, in the pose of the scene, by index.

    A skin's matrices are the poses of its joints times its inverse bind matrices, so
    that they lead from the mesh to the scene (section 3.7.3).
    """
    header = file.header
    # Joints may be outside of the scene that is imported. Without scenes in the header,
    # all nodes are iterated over.
    all_poses = dict(
        gltf_skeleton.iterate_node_poses(header.model_copy(update={"scenes": []}))
    )
    skins = dict[int, SkinPose]()
    for index in {header.nodes[node].skin for node in mesh_nodes}:
        if index is None:
            continue
        joints = header.skins[index].joints
        inverse_binds = gltf_skeleton.read_inverse_binds(file, header.skins[index])
        matrices = np.stack([all_poses[joint] for joint in joints]) @ inverse_binds
        skins[index] = SkinPose(np.array(joints), inverse_binds, matrices)
    return skins


def _note_skeleton(skeleton: Skeleton, notes: Notes) -> None:
    """Note that a skeleton is at rest, and which clips the control `body` can play.

    At most five clips are named.
    """
    names = [clip.name for clip in skeleton.clips]
    clips = ""
    if names:
        more = ", ..." if len(names) > 5 else ""
        clips = f", and plays {', '.join(names[:5])}{more}"
    notes.warn_that_file(f"is shown at rest: the control `body` moves it{clips}")


def _pose_parts(
    file: GltfFile,
    instances: Sequence[_Instance],
    parts_by_key: Mapping[PrimitiveKey, ImportedPart],
    with_faces: Mapping[PrimitiveKey, PrimitiveData],
    skins: Mapping[int, SkinPose],
    skeleton: Skeleton | None,
) -> list[ImportedPart]:
    """Return the primitives that nodes draw, in the pose of each node.

    A primitive with a skin is posed only by its joints, as glTF requires; others are
    posed by their node. A mesh that several nodes draw becomes several parts.

    Args:
        file: the glTF file.
        instances: the meshes that nodes draw.
        parts_by_key: the primitives as parts, by the indices of mesh and primitive.
        with_faces: these primitives as the file stores them, by the same indices.
        skins: the skins of the nodes, by index.
        skeleton: skeleton of the file, None if nothing in it moves.
    """
    parts = []
    for node, mesh, pose in instances:
        skin_index = file.header.nodes[node].skin
        skin = None if skin_index is None else skins[skin_index]
        for key in _list_keys_with_faces(file.header, mesh, parts_by_key):
            piece = with_faces[key]
            part = parts_by_key[key]
            if skeleton is not None:
                part = _make_movable(file, part, piece, node, skin, skeleton)
            posed = _pose_part(file.path, part, piece.vertex_joints, skin, pose)
            parts.append(replace(posed, node=node))
    return parts


def _list_keys_with_faces(
    header: Header, mesh: int, parts_by_key: Mapping[PrimitiveKey, ImportedPart]
) -> list[PrimitiveKey]:
    """Return the keys of the primitives of a mesh that are parts, in the file's order."""
    indices = range(len(header.meshes[mesh].primitives))
    return [(mesh, index) for index in indices if (mesh, index) in parts_by_key]


def _pose_part(
    path: Path,
    part: ImportedPart,
    vertex_joints: gltf_skeleton.VertexJoints | None,
    skin: SkinPose | None,
    node_pose: Float64Array,
) -> ImportedPart:
    """Return a part as its joints pose it, or its node if it has no skin or no joints."""
    if skin is None or vertex_joints is None:
        return transform_part(part, node_pose)
    return gltf_skeleton.pose_part(path, part, vertex_joints, skin.matrices)


def _make_movable(
    file: GltfFile,
    part: ImportedPart,
    piece: PrimitiveData,
    node: int,
    skin: SkinPose | None,
    skeleton: Skeleton,
) -> ImportedPart:
    """Return a part with its morph targets at rest, and with the data that moves it.

    Args:
        file: the glTF file.
        part: the part.
        piece: its primitive as the file stores it.
        node: index of the node that draws it.
        skin: skin of the node; None if it has none.
        skeleton: skeleton of the file.
    """
    targets = piece.morph_targets
    rest_weights = gltf_skeleton.read_rest_weights(file, node, len(targets))
    movable = _bind_to_node(part.vertices, targets, rest_weights, node, skeleton)
    if skin is not None and piece.vertex_joints is not None:
        movable = _bind_to_skin(movable, skin, piece.vertex_joints)
    morphed = gltf_skeleton.apply_morph_targets(
        part, targets, piece.normal_offsets, rest_weights
    )
    return replace(morphed, movable=movable)


def _bind_to_node(
    vertices: Float64Array,
    targets: tuple[MorphTarget, ...],
    rest_weights: Float64Array,
    node: int,
    skeleton: Skeleton,
) -> Movable:
    """Return the data that moves a part without a skin: its node is its only joint.

    Args:
        vertices: (V, 3) in the node's coordinates.
        targets: T morph targets.
        rest_weights: (T,) weights of the targets at rest.
        node: index of the node.
        skeleton: skeleton of the file.
    """
    n_vertices = len(vertices)
    return Movable(
        skeleton=skeleton,
        node=node,
        vertices=vertices,
        joint_nodes=np.array([node]),
        inverse_binds=np.eye(4)[None],
        joints=np.zeros((n_vertices, 1), np.int64),
        weights=np.ones((n_vertices, 1)),
        targets=targets,
        rest_weights=rest_weights,
    )


def _bind_to_skin(
    movable: Movable, skin: SkinPose, vertex_joints: gltf_skeleton.VertexJoints
) -> Movable:
    """Return the data that moves a part, with its vertices bound to a skin's joints."""
    return replace(
        movable,
        joint_nodes=skin.joint_nodes,
        inverse_binds=skin.inverse_binds,
        joints=vertex_joints.joints,
        weights=vertex_joints.weights,
    )


class PrimitiveData(NamedTuple):
    """A primitive as the file stores it, without surface.

    Texture coordinates are the format's, with v = 0 at the top.
    """

    part: ImportedPart  # its geometry
    material_index: int | None  # index of its material
    # Whether it has vertex colors with an alpha below 1, and a transparent material.
    has_transparent_colors: bool
    vertex_joints: gltf_skeleton.VertexJoints | None  # joints and weights
    morph_targets: tuple[MorphTarget, ...]  # morph targets
    # (V, 3) offsets that each target adds to the normals; None if it changes none.
    normal_offsets: tuple[Float64Array | None, ...]
    # (V, 2) coordinates of its texture of roughness and metallic.
    roughness_uvs: Float64Array | None


def _read_vertex_colors(
    file: GltfFile, attributes: Mapping[str, int], used: IntArray, faces: IntArray
) -> tuple[Float64Array | None, bool]:
    """Return vertex colors at the corners of faces, and whether an alpha is below 1.

    The colors are linear, (F, 3, 3); None if the primitive has none.

    Args:
        file: the glTF file.
        attributes: indices of the primitive's accessors, by names such as "COLOR_0".
        used: (V,) the vertices that faces use.
        faces: (F, 3) indices into `used`.
    """
    if "COLOR_0" not in attributes:
        return None, False
    rgba = file.read_float_rows(attributes["COLOR_0"], used)
    rgba = np.clip(np.nan_to_num(rgba), 0.0, 1.0)
    has_alpha = rgba.shape[1] == 4 and bool((rgba[:, 3] < 1.0).any())
    return rgba[:, :3][faces], has_alpha


def _read_roughness_coordinates(
    file: GltfFile,
    attributes: Mapping[str, int],
    material: MaterialEntry,
    used: IntArray,
) -> Float64Array | None:
    """Return the UVs (V, 2) of the texture of roughness and metallic, if there is one.

    The result is None also if the primitive lacks them.

    Args:
        file: the glTF file.
        attributes: indices of the primitive's accessors, by name.
        material: its material.
        used: (V,) the vertices that faces use.
    """
    texture = material.metallic_roughness.metallicRoughnessTexture
    if texture is None:
        return None
    return _read_texture_coordinates(file, attributes, texture, used)


def read_primitive(
    file: GltfFile, primitive: Primitive, mesh_extras: object, is_skinned: bool
) -> PrimitiveData | None:
    """Read one primitive; None if it is points or lines, or has no positions.

    Args:
        file: the glTF file.
        primitive: its entry in the header.
        mesh_extras: extras of its mesh, which may have the names of morph targets.
        is_skinned: whether a node with a skin draws it; otherwise joints are not read.

    Raises:
        FileFormatError: a face refers to a vertex that does not exist.
    """
    attributes = primitive.attributes
    if primitive.mode < TRIANGLES or "POSITION" not in attributes:
        return None
    used, faces = _find_used_vertices(file, primitive)
    positions = file.read_float_rows(attributes["POSITION"], used)
    material = _get_primitive_material(file.header, primitive)
    uvs = _read_texture_coordinates(file, attributes, material.layout_texture, used)
    roughness_uvs = _read_roughness_coordinates(file, attributes, material, used)
    colors, has_alpha = _read_vertex_colors(file, attributes, used, faces)
    normals = _read_stated_normals(file, attributes, used)
    vertex_joints = None
    if is_skinned:
        vertex_joints = gltf_skeleton.read_vertex_joints(file, primitive, used)
    targets, normal_offsets = gltf_skeleton.read_morph_targets(
        file, primitive, used, mesh_extras
    )
    part = _make_part_without_surface(positions, faces, normals, uvs, colors)
    return PrimitiveData(
        part=part,
        material_index=primitive.material,
        has_transparent_colors=material.alphaMode in TRANSPARENT_MODES and has_alpha,
        vertex_joints=vertex_joints,
        morph_targets=targets,
        normal_offsets=normal_offsets,
        roughness_uvs=roughness_uvs,
    )


def _get_primitive_material(header: Header, primitive: Primitive) -> MaterialEntry:
    """Return the material of a primitive; the format's default if it names none."""
    if primitive.material is None:
        return MaterialEntry()
    return header.materials[primitive.material]


def _read_stated_normals(
    file: GltfFile, attributes: Mapping[str, int], used: IntArray
) -> Float64Array | None:
    """Return the normals (V, 3) of used vertices (V,); None if the primitive has none.

    `attributes` are the indices of its accessors, by name.
    """
    if "NORMAL" not in attributes:
        return None
    return file.read_float_rows(attributes["NORMAL"], used)


def _make_part_without_surface(
    positions: Float64Array,
    faces: IntArray,
    normals: Float64Array | None,
    uvs: Float64Array | None,
    colors: Float64Array | None,
) -> ImportedPart:
    """Return the geometry of a primitive, to which `_make_parts` adds the surface.

    Primitives with the same material share a surface.
    """
    return ImportedPart(
        vertices=positions,
        faces=faces,
        normals=normals,
        uvs=uvs,
        colors=colors,
        surface=ImportedSurface(),
        flat=True,  # as glTF shades faces without normals
    )


def _find_used_vertices(
    file: GltfFile, primitive: Primitive
) -> tuple[IntArray, IntArray]:
    """Return the vertices (V,) that a primitive uses, and its faces (F, 3).

    Primitives may share accessors, so not every vertex is used. Faces are indices into
    the used vertices.

    Args:
        file: the glTF file.
        primitive: entry of the primitive.

    Raises:
        FileFormatError: a face refers to a vertex that does not exist.
    """
    order = _read_vertex_order(file, primitive)
    triangles = _make_triangles(order, primitive.mode)
    used_vertices, corners = np.unique(triangles, return_inverse=True)
    return used_vertices, corners.reshape(-1, 3).astype(np.int64)


def _read_vertex_order(file: GltfFile, primitive: Primitive) -> IntArray:
    """Return the vertices in the order in which a primitive lists them.

    Raises:
        FileFormatError: one does not exist.
    """
    count = file.header.accessors[primitive.attributes["POSITION"]].count
    order = np.arange(count)
    if primitive.indices is not None:
        order = file.read_stored_values(primitive.indices)[:, 0].astype(np.int64)
    if len(order) and order.max() >= count:
        raise damaged(
            file.path,
            "faces of its own vertices",
            "a face that refers to a vertex that does not exist",
        )
    return order


def _read_texture_coordinates(
    file: GltfFile,
    attributes: Mapping[str, int],
    use: TextureInfo | None,
    used: IntArray,
) -> Float64Array | None:
    """Return the texture coordinates of used vertices, or None if there are none.

    They are (N, 2) after the texture's transform (KHR_texture_transform): scaled,
    rotated, then shifted. (0, 0) is the texture's top left corner.

    Args:
        file: the glTF file.
        attributes: indices of the primitive's accessors, by name.
        use: the texture; None returns the first coordinates without a transform.
        used: (N,) the vertices that faces use.
    """
    name = "TEXCOORD_0" if use is None else use.uv_attribute
    if name not in attributes:
        return None
    accessor = file.header.accessors[attributes[name]]
    vertex_count = file.header.accessors[attributes["POSITION"]].count
    if accessor.type != "VEC2" or accessor.count != vertex_count:
        # This is no error: the coordinates of the base color were checked with the
        # header, and other textures can be left out.
        return None
    uvs = file.read_float_rows(attributes[name], used)
    return uvs if use is None else _apply_texture_transform(uvs, use.transform)


def _apply_texture_transform(
    uvs: Float64Array, transform: gltf_entries.TextureTransform
) -> Float64Array:
    """Return UVs (N, 2) scaled, rotated, then shifted by a texture's transform."""
    sine = np.sin(transform.rotation)
    cosine = np.cos(transform.rotation)
    u, v = (uvs * transform.scale).T
    rotated = np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=1)
    return np.asarray(rotated + transform.offset)


def _make_triangles(order: IntArray, mode: int) -> IntArray:
    """Return the faces (F, 3) of a primitive of a mode (glTF 2.0, section 3.7.2.1).

    A list has three vertices for each face. A strip or a fan has one vertex for each
    face, after the first two vertices. Every second face of a strip has its last two
    corners swapped, so that all have the same winding.

    Args:
        order: the vertices in the order in which the primitive lists them.
        mode: `TRIANGLES`, `STRIP` or `FAN`.
    """
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    index = np.arange(max(0, len(order) - 2))  # of each face
    if mode == STRIP:
        # i, i + 1, i + 2 of an even face, and i, i + 2, i + 1 of an odd one
        is_odd = index % 2
        corners = np.stack([index, index + 1 + is_odd, index + 2 - is_odd], axis=1)
    else:  # all faces of a fan share the first vertex
        corners = np.stack([index + 1, index + 2, np.zeros_like(index)], axis=1)
    faces = order[corners]
    # Faces with a repeated vertex have no area, and are left out. Exporters repeat
    # vertices on purpose, to join strips that are far apart.
    has_repeated_vertex = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return np.asarray(faces[~has_repeated_vertex], np.int64)
