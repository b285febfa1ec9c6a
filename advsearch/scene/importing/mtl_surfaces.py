"""Materials of .mtl files as surfaces; statements that are not read are noted."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from PIL import Image

from advsearch.scene.assets import Float32Array, Float64Array, IntArray
from advsearch.scene.importing.files import Notes, decode_text, format_name
from advsearch.scene.importing.parts import (
    NEUTRAL_GREY,
    ImportedSurface,
    apply_opacity,
    compute_radiance,
    describe_substitute,
    has_normals,
    is_plain_white,
    make_normal_map,
)
from advsearch.scene.importing.pictures import FileImages, ImageKind
from advsearch.scene.importing.texture import average_over_faces
from advsearch.scene.importing.unread import TrackedKeys
from advsearch.trust.named_files import ReferencedFiles, normalize_name

IGNORED_KEYWORDS = frozenset("ka ks ns ni sharpness map_aat".split())
"""Common statements without a counterpart in a physical material: ambient light, Phong's
highlights.
"""
NORMAL_MAPS = ("norm", "map_kn", "map_bump", "bump")
COLOR_MAPS = ("map_kd", "map_ke")  # others have numbers
UV_MAPS = ("map_kd", "map_d", *NORMAL_MAPS, "map_ke")
"""Maps that are sampled at texture coordinates. All have the layout (scale and offset of
texture coordinates) of the first of them that a material has.
"""
# Channels of an image by the value of ``-imfchan``.
CHANNELS = {"r": 0, "g": 1, "b": 2, "m": 3}
DEFAULT_OPTIONS = {
    "blendu": "on",
    "blendv": "on",
    "cc": "off",
    "clamp": "off",
    "bm": "1",
    "boost": "0",
}
"""Default values of texture options (bm: bump multiplier, cc: color correction)."""


@dataclass(frozen=True, eq=False)
class MtlSurface:
    """A material of an .mtl file as a surface."""

    surface: ImportedSurface
    scale: Pair = (1.0, 1.0)  # factors of texture coordinates
    offset: Pair = (0.0, 0.0)  # offsets that are added after scaling
    is_clamped: bool = False  # whether a texture must not repeat beyond its edges


@dataclass
class MtlReader:
    """Reads the material files of a mesh file, and converts materials to surfaces.

    Attributes:
        references: finds files beside the mesh file.
        notes: notes about the file.
        find_mapped_faces: function of a material's name and a UDIM square; returns UVs
            (F, 3, 2) and areas (F,) of the faces with that material in that square.
        n_libraries: number of material files that were read.
    """

    references: ReferencedFiles
    notes: Notes
    find_mapped_faces: Callable[[str, int], tuple[Float64Array, Float64Array]]
    n_libraries: int = 0
    # Materials by name. A name with a # is also listed without the text from there on.
    _materials: dict[str, MtlMaterial] = field(default_factory=dict)
    # Surfaces by `id` of their material and the UDIM square.
    _surfaces: dict[tuple[int, int], MtlSurface] = field(default_factory=dict)
    # Maps by `id` of their material and the keyword.
    _uses: dict[tuple[int, str], MapStatement | None] = field(default_factory=dict)

    def read_library(self, name: str) -> None:
        """Read a material file, and store its materials by name for `get_surface`.

        If several materials have the same name, the first is stored. A missing file is
        noted. So is a second material with the same name in a file, unless its
        statements are the same. Statements before the first material are recorded as
        left out.

        Args:
            name: name of the file, as the mesh file writes it.
        """
        try:
            text = decode_text(self.references.read_file(name))
        except FileNotFoundError:
            self._note_missing_library(name)
            return
        self.n_libraries += 1
        file = normalize_name(name).rpartition("/")[2]  # without its folder
        materials, stray_keywords = parse_mtl(text, file)
        for keyword in stray_keywords:
            self._record_stray_statement(file, keyword)
        self._add_materials(materials)

    def _record_stray_statement(self, file: str, keyword: str) -> None:
        """Record a statement before the first material of a file, which is left out."""
        self.notes.record(
            f"before the first material of {format_name(file, quoted=False)}, "
            "statement",
            keyword,
        )

    def _note_missing_library(self, name: str) -> None:
        """Note a material file that is missing, or that must not be read."""
        file_name = normalize_name(name)
        # `references.get` has stored a reason such as "is missing".
        reason = self.references.refusal_by_name[file_name]
        self.notes.warn_that_file(
            f"names the material file {format_name(file_name)}, which {reason}; "
            "neutral grey is used instead"
        )

    def _add_materials(self, materials: Sequence[MtlMaterial]) -> None:
        """Add the materials of one file by name; the first of equal names is stored.

        A second material of a name is noted, unless its statements are the same, or the
        first is of another file.
        """
        for material in materials:
            known_material = self._materials.setdefault(material.name, material)
            if (
                known_material.argument_by_keyword != material.argument_by_keyword
                and known_material.file == material.file
            ):
                self.notes.warn(
                    f"{material.file} has the material {format_name(material.name)} "
                    "more than once; the first one is used"
                )
        # A # may begin a comment or be part of a name. So both names are added.
        for material in materials:
            self._materials.setdefault(without_comment(material.name), material)

    def _find_material(self, name: str) -> MtlMaterial | None:
        """Return the material of a name, which may end in a comment, or None."""
        return self._materials.get(name) or self._materials.get(without_comment(name))

    def get_surface(self, name: str, square: int = 0) -> MtlSurface | None:
        """Return the material of a name as a surface; None if there is none.

        Args:
            name: the name as the mesh file writes it, perhaps with a comment after it.
            square: the UDIM square whose images replace those that the material names;
                0 for none.
        """
        material = self._find_material(name)
        if material is None:
            return None
        key = (id(material), square)
        if key not in self._surfaces:
            self._surfaces[key] = self._make_surface(material, square, name)
        return self._surfaces[key]

    def find_squares(self, name: str, candidates: Sequence[int]) -> list[int]:
        """Return the UDIM squares for which a material has images: all, or none.

        A UDIM texture has one image for each unit square of texture coordinates, with
        the number of the square in its name, such as "wood.1002.png". The material's
        first image with such a number decides. There are images for all squares if the
        name has the placeholder ``<UDIM>``, or if the file of another candidate square
        exists. Otherwise the image is used as an ordinary one that repeats, which is
        noted.

        Args:
            name: the material.
            candidates: UDIM squares of the material's faces. A 0, for faces outside of
                all squares, is left out of the result.
        """
        material = self._find_material(name)
        numbered_name = self._find_numbered_name(material) if material else None
        if numbered_name is None:
            return []
        squares = [square for square in candidates if square]
        named_square = parse_udim_square(numbered_name)
        other_squares = [square for square in squares if square != named_square]
        if not other_squares:
            return []  # all faces are in the square of the image that is named
        has_placeholder = named_square == PLACEHOLDER_SQUARE
        if has_placeholder or self._has_square_image(numbered_name, other_squares):
            return squares
        self._note_missing_squares(numbered_name, other_squares)
        return []

    def _has_square_image(self, numbered_name: str, squares: Sequence[int]) -> bool:
        """Return whether there is an image for some square, named like `numbered_name`."""
        names = (replace_square(numbered_name, square) for square in squares)
        return any(_exists(self.references, name) for name in names)

    def _note_missing_squares(self, numbered_name: str, squares: Sequence[int]) -> None:
        """Note that an image repeats in other UDIM squares, which have no image."""
        self.notes.warn(
            f"{format_name(numbered_name)} is named like one of several pictures (UDIM), "
            "and there is none for the "
            f"faces in {', '.join(map(str, squares[:8]))}: it repeats there; put "
            "those pictures beside it"
        )

    def _find_numbered_name(self, material: MtlMaterial) -> str | None:
        """Return the first name of a material's images that has a UDIM square in it."""
        for use in [self._parse_use(material, key) for key in UV_MAPS]:
            if use is not None and parse_udim_square(use.name) is not None:
                return use.name
        return None

    def _make_surface(
        self, material: MtlMaterial, square: int, name: str
    ) -> MtlSurface:
        """Convert a material to a surface.

        Texture coordinates are those of the first of `UV_MAPS`; maps with others are
        left out.

        Args:
            material: the statements of the material.
            square: the UDIM square whose images are used, 0 for none.
            name: the name by which the mesh file uses it.
        """
        # A material becomes one surface for each UDIM square, but its unread statements
        # are noted only once.
        are_noted = any(
            material_id == id(material) for material_id, _ in self._surfaces
        )
        uses = self._parse_uses(material, square)
        # The mesh has one layout of texture coordinates, which is that of its first
        # image. Without images it has the defaults of `MapStatement`.
        no_use = MapStatement(name="", options={})
        first_use = next((uses[key] for key in UV_MAPS if key in uses), no_use)
        self._drop_other_layouts(material, uses, first_use)
        surface = self._convert_maps(material, uses, name, square)
        if not are_noted:
            self._note_unread(material)
        is_clamped = first_use is not no_use and any(map(_is_clamped, uses.values()))
        return MtlSurface(surface, first_use.scale, first_use.offset, is_clamped)

    def _convert_maps(
        self,
        material: MtlMaterial,
        uses: dict[str, MapStatement],
        name: str,
        square: int,
    ) -> ImportedSurface:
        """Convert the statements of a material, and its maps by keyword, to a surface.

        Maps of roughness and metallic are averaged over the faces with this name of the
        material and this UDIM square.
        """
        color, texture = self._make_base_color(material, uses.get("map_kd"))
        opaque_surface = ImportedSurface(color, texture, name=material.name)
        return replace(
            self._apply_opacity(material, uses.get("map_d"), opaque_surface),
            roughness=self._read_fraction(material, "pr", uses, name, square),
            metallic=self._read_fraction(material, "pm", uses, name, square),
            normal_map=self._make_normal_map(material, uses),
            emission=self._make_emission(material, uses.get("map_ke")),
        )

    def _parse_uses(
        self, material: MtlMaterial, square: int
    ) -> dict[str, MapStatement]:
        """Return the maps of a material by keyword, with the images of a UDIM square.

        The maps are marked as read, so that they are not noted. Normal maps are not:
        `_make_normal_map` reads only the first one that it can use.
        """
        uses = dict[str, MapStatement]()
        for key in (*UV_MAPS, "map_pr", "map_pm"):
            use = self._parse_use(material, key)
            if use is not None:
                uses[key] = use
        read_keys = [key for key in uses if key not in NORMAL_MAPS]
        # `_note_unread` notes some values of illum, but not the statement itself.
        material.tracked_statements.mark_read(*read_keys, "illum")
        if not square:
            return uses
        return {
            key: replace(use, name=replace_square(use.name, square))
            for key, use in uses.items()
        }

    def _drop_other_layouts(
        self,
        material: MtlMaterial,
        uses: dict[str, MapStatement],
        first_use: MapStatement,
    ) -> None:
        """Remove maps whose texture coordinates differ from those of the first.

        A surface has one layout of texture coordinates: scale (``-s``) and offset
        (``-o``). Removed maps are noted.

        Args:
            material: the material.
            uses: its maps by keyword; maps are removed from it.
            first_use: the map whose layout is that of the surface.
        """
        first_layout = (first_use.scale, first_use.offset)
        for key in [key for key in UV_MAPS if key in uses]:
            layout = (uses[key].scale, uses[key].offset)
            if layout != first_layout:
                self._note_other_layout(material, key)
                # It is noted here, and needs no note as an unread statement.
                material.tracked_statements.mark_read(key)
                del uses[key]

    def _note_other_layout(self, material: MtlMaterial, key: str) -> None:
        """Note that the map of a keyword is left out, since its UVs differ."""
        statement = (
            f"{material.spelling[key]} of the material {format_name(material.name)}"
        )
        self.notes.warn(
            f"{statement} has other texture coordinates (-s, -o) than its first "
            "map; it is left out"
        )

    def _make_base_color(
        self, material: MtlMaterial, use: MapStatement | None
    ) -> tuple[Float32Array | None, Float32Array | None]:
        """Return the color (3,) of ``Kd`` and the texture (H, W, 3) of ``map_Kd``.

        A texture is not multiplied by ``Kd``: in a material with a texture, ``Kd`` is
        more often an exporter's default than a tint. The color is used if the texture
        is missing. It is None if ``Kd`` is no color, or is plain white and the material
        names a texture.

        Args:
            material: the material.
            use: its ``map_Kd``, or None.
        """
        color = self._read_color(material)
        substitute = f"{describe_substitute(color)} is used instead"
        note_template = (
            f"{material.file} names the texture {{name}}, which {{why}}; {substitute}"
        )
        texture = self._load_image(use, "colours and alpha", note_template)
        if use is not None and texture is not None:
            self._note_unused_alpha(material, use, texture)
            texture = np.ascontiguousarray(texture[:, :, :3])
        if use is not None and color is not None and is_plain_white(color):
            color = None  # plain white does not change a texture
        return color, texture

    def _note_unused_alpha(
        self, material: MtlMaterial, use: MapStatement, texture: Float32Array
    ) -> None:
        """Note the alpha of a texture (H, W, 4), unless the material has a ``map_d``."""
        has_transparency = texture[:, :, 3].min() < 1.0
        if has_transparency and "map_d" not in material.argument_by_keyword:
            self.notes.warn(
                f"the alpha of {format_name(use.name)} is left out: no map_d "
                "makes it an opacity"
            )

    def _read_color(self, material: MtlMaterial) -> Float32Array | None:
        """Return the color (3,) of ``Kd``; None, and a note, if it is no color.

        A fourth number is ignored.
        """
        argument = material.read_argument("kd")
        values = parse_numbers(argument)
        if values is not None and len(values) in (1, 3, 4):
            rgb = np.clip(np.broadcast_to(values[:3], (3,)), 0.0, 1.0)
            return np.asarray(rgb, np.float32)
        if "kd" in material.argument_by_keyword:
            statement = (
                f"the Kd {format_name(argument)} of the material "
                f"{format_name(material.name)}"
            )
            self.notes.warn(f"{statement} is no colour; neutral grey is used instead")
        return None

    def _note_unread(self, material: MtlMaterial) -> None:
        """Note the statements that are not read, unless they change nothing.

        Also noted are statements that were overridden, a fourth number of Kd, and
        illumination models above 2, such as ray-traced glass.
        """
        for key in material.overridden:
            self.notes.record("earlier material statement", key)
        if len(material.peek_argument("kd").split()) == 4:
            self.notes.record("fourth number of", material.spelling["kd"])
        if material.peek_argument("illum") not in ("", "0", "1", "2"):
            self.notes.record(
                "illumination model",
                without_comment(material.argument_by_keyword["illum"]),
            )
        is_without_effect = _EffectTest(material).is_without_effect
        for name in material.tracked_statements.find_unread(is_without_effect):
            self.notes.record("material statement", name)

    def _parse_use(self, material: MtlMaterial, key: str) -> MapStatement | None:
        """Parse a statement that names an image, and note options that are not read.

        The result is None if the statement is missing or names no image. Text from a #
        on belongs to the name if a file with that name exists, and is a comment
        otherwise. Results are cached, so that options are noted only once.
        """
        if (id(material), key) in self._uses:
            return self._uses[id(material), key]
        statement = material.argument_by_keyword.get(key, "")
        use = parse_map(without_comment(statement))
        use_with_comment = parse_map(statement)
        if use_with_comment is not None and use_with_comment != use:
            # the file's bytes, or a text that explains why it cannot be read
            content = self.references.read_or_explain(use_with_comment.name)
            if isinstance(content, bytes):
                use = use_with_comment  # the # belongs to the name
        self._uses[id(material), key] = use
        if use is not None:
            self._note_unread_options(material, key, use)
        return use

    def _note_unread_options(
        self, material: MtlMaterial, key: str, use: MapStatement
    ) -> None:
        """Note the options of an image that are not read, unless they change nothing.

        Args:
            material: the material.
            key: keyword of the statement with the image, such as "map_kd".
            use: the image and its options.
        """
        options = TrackedKeys(use.options)
        options.mark_read(*_list_read_options(key))
        is_without_effect = partial(_is_default_option, key in COLOR_MAPS)
        for option in options.find_unread(is_without_effect):
            self.notes.record(
                "texture option", f"-{option} of {material.spelling[key]}"
            )

    def _apply_opacity(
        self, material: MtlMaterial, use: MapStatement | None, surface: ImportedSurface
    ) -> ImportedSurface:
        """Return a surface with its opacity.

        The opacity is a number, ``d`` or 1 - ``Tr``, times the image of ``map_d``. The
        image is resized to the size of the color texture. The single color of a surface
        gets the number alone.

        Args:
            material: the material.
            use: its ``map_d``, or None.
            surface: the surface with its color (3,) and texture (H, W, 3).
        """
        factor = self._read_opacity(material)
        image = self._load_image(
            use, "colours and alpha", "the opacity {name} {why}; it is opaque instead"
        )
        if image is None and factor == 1.0:
            return surface
        opacity = None
        if use is not None and image is not None:
            opacity = _select_channel(image, use)
        surface = _prepare_opacity(surface, opacity)
        factor_array = np.array([factor], np.float32)
        return replace(
            surface,
            color=apply_opacity(surface.color, factor_array, cutoff=None),
            texture=apply_opacity(surface.texture, factor_array, cutoff=None),
        )

    def _read_opacity(self, material: MtlMaterial) -> float:
        """Return the opacity in [0, 1] that ``d`` or ``Tr`` states, 1 by default.

        If both are stated, ``d`` is returned. Some programs mean transparency by
        ``Tr``, and some mean opacity. If ``Tr`` contradicts ``d`` in both senses, that
        is noted. Without ``d``, ``Tr`` is read as transparency, which is noted, too.
        """
        if "-halo" in material.read_argument("d").lower().split():
            self.notes.record("option", "-halo of d")
        opacity = parse_fraction(material.read_argument("d"))
        tr = parse_fraction(material.read_argument("tr"))
        if tr is None:
            return 1.0 if opacity is None else opacity
        if opacity is None:
            self._note_transparency(material, tr)
            return 1.0 - tr
        self._note_contradiction(material, tr, opacity)
        return opacity

    def _note_transparency(self, material: MtlMaterial, tr: float) -> None:
        """Note a ``Tr`` without ``d``, which is read as transparency, unless it is 0."""
        if tr > 0.0:
            self.notes.warn(
                f"the material {format_name(material.name)} has Tr {tr:g} and no d: it "
                "is read as transparency, which "
                f"makes its opacity {1.0 - tr:g}; some programs mean "
                "opacity by it, so write d instead"
            )

    def _note_contradiction(
        self, material: MtlMaterial, tr: float, opacity: float
    ) -> None:
        """Note a ``Tr`` that contradicts ``d``, the opacity, in both of its senses."""
        # Programs may round to two digits.
        agrees_as_opacity = abs(tr - opacity) <= 0.01
        agrees_as_transparency = abs(1.0 - tr - opacity) <= 0.01
        if not agrees_as_opacity and not agrees_as_transparency:
            self.notes.warn(
                f"the material {format_name(material.name)} has Tr {tr:g}, which "
                f"contradicts its d {opacity:g}; d is used as its opacity"
            )

    def _read_fraction(
        self,
        material: MtlMaterial,
        key: str,
        uses: dict[str, MapStatement],
        name: str,
        square: int,
    ) -> float | None:
        """Return a roughness ("pr") or metallic ("pm"), None if there is none.

        It is the mean of its map over the faces that show it, or else the number of the
        statement.

        Args:
            material: the material.
            key: "pr" or "pm".
            uses: the maps of the material by keyword, such as "map_pr".
            name: name by which the mesh file uses the material.
            square: the UDIM square.
        """
        use = uses.get(f"map_{key}")
        # Only notes about a map use the keyword; without a map it is None.
        keyword = material.spelling.get(f"map_{key}")
        note_template = f"{keyword} {{name}} {{why}}; it is left out"
        image = self._load_image(use, "numbers", note_template)
        number = parse_fraction(material.read_argument(key))
        if use is None or image is None:
            return number
        self.notes.warn(
            "textures of roughness and metallic are replaced by their means"
        )
        uvs, areas = self.find_mapped_faces(name, square)
        return _average_mapped_values(image, use, uvs, areas)

    def _make_normal_map(
        self, material: MtlMaterial, uses: dict[str, MapStatement]
    ) -> Float32Array | None:
        """Return the first usable normal map (H, W, 3) of a material, or None.

        A bump map is usable if it holds normals; one of heights is left out with a
        note. All statements with the same image are marked as read.

        Args:
            material: the material.
            uses: its maps by keyword.
        """
        note_template = "the normal map {name} {why}; it is left out"
        for key in (key for key in NORMAL_MAPS if key in uses):
            use = uses[key]
            image = self._load_image(use, "numbers", note_template)
            same_image = [other for other in uses if uses[other].name == use.name]
            material.tracked_statements.mark_read(*same_image)
            if image is None:
                continue
            # These two keywords are for normals alone; bump maps may be either.
            if key in ("norm", "map_kn") or has_normals(image):
                return make_normal_map(image, use.bump)
            self._images.note_missing(
                use.name, "holds heights, and no normals", note_template
            )
        return None

    def _make_emission(
        self, material: MtlMaterial, use: MapStatement | None
    ) -> Float32Array | None:
        """Return the radiance of ``Ke`` and ``map_Ke``, (H, W, 3), or None.

        Both are multiplied; without a map the radiance is (1, 1, 3). If the map cannot
        be read, there is no emission, with a note.

        Args:
            material: the material.
            use: its ``map_Ke``, or None.
        """
        factor = self._read_emission(material)
        if factor is None:
            return None
        image = self._load_image(
            use, "colours", "the texture {name} of the emission {why}; it is left out"
        )
        if use is not None and image is None:
            return None
        if use is not None and not factor.any():
            factor = np.ones(3)  # exporters leave Ke at 0 if there is a map
        return compute_radiance(factor, image, self.notes)

    def _read_emission(self, material: MtlMaterial) -> Float64Array | None:
        """Return the factor (3,) of ``Ke``, by default black; None, with a note, if wrong."""
        values = parse_numbers(material.read_argument("ke") or "0")
        if values is None or len(values) not in (1, 3) or min(values) < 0:
            self.notes.warn(
                f"the emission {format_name(material.read_argument('ke'))} is no "
                "colour; it is left out"
            )
            return None
        return np.broadcast_to(values, (3,))

    @cached_property
    def _images(self) -> FileImages:
        """Decodes the images of all materials."""
        return FileImages(len(self._materials), self.references, self.notes)

    def _load_image(
        self, use: MapStatement | None, kind: ImageKind, note_template: str
    ) -> Float32Array | None:
        """Return the values (H, W, C) of an image with its ``-mm`` applied.

        Args:
            use: the image; None returns None.
            kind: content of the image, such as "colours".
            note_template: the note if it cannot be read, with `{name}` for the image
                and `{why}` for the reason; then None is returned.
        """
        if use is None:
            return None
        image = self._images.load_file(use.name, kind, note_template)
        if image is None or use.range == (0.0, 1.0):
            return image
        # -mm base gain: values are multiplied by the gain, then the base is added.
        base, gain = map(np.float32, use.range)
        colors = np.clip(image[:, :, :3] * gain + base, 0.0, 1.0)
        return np.concatenate([colors, image[:, :, 3:]], axis=2)


@dataclass(frozen=True)
class _EffectTest:
    """Tests whether statements of a material change nothing."""

    material: MtlMaterial

    @cached_property
    def _zero_keys(self) -> set[str]:
        """Keywords of statements whose numbers are all 0."""
        return {
            key
            for key in self.material.argument_by_keyword
            if _is_zero(self.material.peek_argument(key))
        }

    @cached_property
    def _base_map(self) -> MapStatement | None:
        """The image of the color."""
        statement = self.material.argument_by_keyword.get("map_kd", "")
        return parse_map(without_comment(statement))

    def is_without_effect(self, key: str, statement: str) -> bool:
        """Return whether a statement changes nothing."""
        argument = without_comment(statement)
        if not argument or key in IGNORED_KEYWORDS or key in self._zero_keys:
            return True
        if key == "pcr":  # the roughness of a clear coat, which may be absent
            return "pc" in self._zero_keys
        if key == "tf":  # a transmission filter, which is grey if numbers are equal
            return len(set(argument.split())) == 1
        if key == "map_ka" and self._base_map is not None:
            # exporters repeat the image of the color as that of ambient light
            ambient_map = parse_map(argument)
            return ambient_map is not None and ambient_map.name == self._base_map.name
        return False


def _is_default_option(has_colors: bool, option: str, value: str) -> bool:
    """Return whether an option of an image has a value that changes nothing.

    `has_colors` is whether the image is one of colors, and not of numbers.
    """
    if option == "colorspace":
        return value.lower() == ("srgb" if has_colors else "linear")
    return value.lower() == DEFAULT_OPTIONS.get(option) or _is_zero(value)


def _is_clamped(use: MapStatement) -> bool:
    """Return whether an image must not repeat beyond its edges."""
    return use.options.get("clamp", "").lower() == "on"


def _average_mapped_values(
    image: Float32Array, use: MapStatement, uvs: Float64Array, areas: Float64Array
) -> float:
    """Return the mean of a map of numbers over the faces that show it.

    Args:
        image: (H, W, C) values of the map's image.
        use: the map.
        uvs: (F, 3, 2) texture coordinates of the faces, as the file has them.
        areas: (F,) areas of the faces.
    """
    values = _select_channel(image, use)[:, :, None]
    mean = average_over_faces(values, uvs * use.scale + use.offset, areas)
    return float(mean[0])


def _list_read_options(key: str) -> list[str]:
    """Return the options that are read of an image with a keyword such as "map_kd"."""
    read_options = ["s", "o", "mm", "clamp"]  # scale, offset, value range, clamping
    if key in NORMAL_MAPS:
        read_options.append("bm")  # bump multiplier
    elif key not in COLOR_MAPS:
        read_options.append("imfchan")  # channel of the image
    return read_options


def _prepare_opacity(
    surface: ImportedSurface, opacity: Float32Array | None
) -> ImportedSurface:
    """Return a surface with an opacity map (h, w) as fourth channel of its texture.

    Without a map, the surface only gets a color if it has neither a color nor a
    texture: it could have no opacity either. It becomes grey.
    """
    color = surface.color
    if color is None:
        color = np.full(3, NEUTRAL_GREY, np.float32)
    if opacity is not None:
        texture = _append_opacity(surface.texture, color, opacity)
        return replace(surface, texture=texture)
    if surface.texture is None:
        return replace(surface, color=color)
    return surface


def _append_opacity(
    texture: Float32Array | None, color: Float32Array, opacity: Float32Array
) -> Float32Array:
    """Return a texture (H, W, 3) with an opacity (h, w), resized, as fourth channel.

    Without a texture, the color (3,) is that of all texels of the opacity.
    """
    if texture is None:
        texture = np.broadcast_to(color, (*opacity.shape, 3))
    size = (texture.shape[1], texture.shape[0])
    image = Image.fromarray(opacity).resize(size, Image.Resampling.BILINEAR)
    return np.concatenate([texture, np.asarray(image)[:, :, None]], axis=2)


def _select_channel(picture: Float32Array, use: MapStatement) -> Float32Array:
    """Return the values (H, W) of an image for a map of numbers.

    They are those of the channel that ``-imfchan`` names, such as "r". Without this
    option, they are the alpha if it is not 1 everywhere, or else the mean of the
    colors. The mean is also returned if ``-imfchan`` names the alpha of an image that
    has none.
    """
    alpha_index = 3
    has_alpha = picture.shape[2] == 4
    channel = CHANNELS.get(use.options.get("imfchan", "").lower())
    if channel is None and has_alpha and picture[:, :, alpha_index].min() < 1.0:
        channel = alpha_index
    lacks_channel = channel == alpha_index and not has_alpha
    if channel is None or lacks_channel:
        mean: Float32Array = picture[:, :, :3].mean(axis=2)
        return mean
    return picture[:, :, channel]


def find_libraries(arguments: Sequence[str], references: ReferencedFiles) -> list[str]:
    """Return the names of the material files that ``mtllib`` lines name.

    A line may name several files, and a name may have blanks. If the full line is the
    name of a file that exists, it is one name. Otherwise it is split after each
    ``.mtl``, and the rest at blanks. These words are the names if all of them end in
    ``.mtl`` or one of them exists. If not, the full line is one name.

    Args:
        arguments: text after ``mtllib`` in each line.
        references: finds files beside the mesh file.
    """
    names: list[str] = []
    for argument in arguments:
        names += _find_line_libraries(argument, references)
    return list(dict.fromkeys(filter(None, names)))


def _find_line_libraries(argument: str, references: ReferencedFiles) -> list[str]:
    """Return the names of the material files of one line; see `find_libraries`."""
    argument_without_comment = without_comment(argument)
    if _exists(references, argument):
        return [argument]
    if _exists(references, argument_without_comment):
        return [argument_without_comment]
    candidates = _split_libraries(argument_without_comment)
    have_suffix = all(map(_has_mtl_suffix, candidates))
    exist = (_exists(references, name) for name in candidates)
    return candidates if have_suffix or any(exist) else [argument_without_comment]


def _exists(references: ReferencedFiles, name: str) -> bool:
    """Return whether there is a file of a name that may be read."""
    return isinstance(references.read_or_explain(name), bytes)


def _has_mtl_suffix(name: str) -> bool:
    """Return whether a name, perhaps in quotation marks, ends in ``.mtl``."""
    return name.strip('"').lower().endswith(".mtl")


def _split_libraries(line: str) -> list[str]:
    """Split a line into names that end in ``.mtl``, and the rest at blanks."""
    names = list[str]()
    name = ""
    for word in line.split():
        name = f"{name} {word}".strip()
        if _has_mtl_suffix(word):
            names.append(name)
            name = ""
    return [*names, *name.split()]


# ---- UDIM: one image for each unit square of texture coordinates ----
#
# The number of the square is in the name of the image. The square from (0, 0) to (1, 1)
# is 1001, those to its right are 1002 to 1010, and each row above adds 10.

FIRST_SQUARE = 1001
SQUARES_PER_ROW = 10
PLACEHOLDER_SQUARE = (
    0  # result of `parse_udim_square` for a name that stands for all squares
)
_SQUARE_NUMBER = re.compile(r"(?<!\d)1\d{3}(?=\.\w+$)")
_PLACEHOLDER = re.compile(r"<UDIM>", re.IGNORECASE)


def parse_udim_square(name: str) -> int | None:
    """Return the UDIM square in the name of an image, or None if it has none.

    It is `PLACEHOLDER_SQUARE` if the name has the placeholder ``<UDIM>``.
    """
    if _PLACEHOLDER.search(name):
        return PLACEHOLDER_SQUARE
    match = _SQUARE_NUMBER.search(name)
    if match is None or int(match[0]) < FIRST_SQUARE:
        return None
    return int(match[0])


def replace_square(name: str, square: int) -> str:
    """Return the name of an image with another UDIM square in it."""
    pattern = _PLACEHOLDER if _PLACEHOLDER.search(name) else _SQUARE_NUMBER
    return pattern.sub(str(square), name)


def compute_squares(uvs: Float64Array) -> IntArray:
    """Return the UDIM squares (F,) of the centers of faces (F, 3, 2); 0 for none."""
    column, row = np.floor(uvs.mean(axis=1)).T
    is_valid = (column >= 0) & (column < SQUARES_PER_ROW) & (row >= 0) & (row < 100)
    return np.where(is_valid, FIRST_SQUARE + column + SQUARES_PER_ROW * row, 0).astype(
        np.int64
    )


def get_square_corner(square: int) -> tuple[int, int]:
    """Return the UV at which a UDIM square begins; (0, 0) for no square."""
    if not square:
        return 0, 0
    return (square - FIRST_SQUARE) % SQUARES_PER_ROW, (
        square - FIRST_SQUARE
    ) // SQUARES_PER_ROW


# ---- The grammar of material files (.mtl) ----
#
# Statements, comments, and the options of maps. `MtlReader` interprets them.

Pair = tuple[float, float]
_MTL_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
# Patterns of the values of options, by the option's name.
_VALUE_PATTERNS = {
    **dict.fromkeys(("blendu", "blendv", "cc", "clamp"), "on|off"),
    **dict.fromkeys(("bm", "boost"), _MTL_NUMBER),
    **dict.fromkeys(("o", "s", "t"), rf"{_MTL_NUMBER}(?:\s+{_MTL_NUMBER}){{0,2}}"),
    **{
        "colorspace": r"\S+",
        "imfchan": "[rgbmlz]",
        "mm": rf"{_MTL_NUMBER}\s+{_MTL_NUMBER}",
        "texres": r"\d+",
    },
    "type": r"sphere|cube_\w+",
}
# A known option. It has two groups for each: "s" is its name as it is written, and "s_"
# its value.
_KNOWN_OPTION = re.compile(
    "|".join(
        rf"(?:(?<=\s)|^)-(?P<{name}>{name})\s+(?P<{name}_>{value})(?=\s|$)"
        for name, value in _VALUE_PATTERNS.items()
    ),
    re.IGNORECASE,
)
# An unknown option with all of its values, which are switches or numbers. The group is
# its name.
_UNKNOWN_OPTION = re.compile(
    rf"-([a-z]\w*)(?:\s+(?:on|off|{_MTL_NUMBER})(?=\s))*\s+", re.IGNORECASE
)
_COMMENT = re.compile(r"(?:^|(?<=\s))#.*")
_CONTINUED = re.compile(r"^([^#\n][^\n]*?)\\[ \t]*\n", re.MULTILINE)


@dataclass
class MtlMaterial:
    """The statements of one material, by keyword in lower case.

    If several statements have the same keyword, the last one is stored.
    """

    name: str  # as it is written after ``newmtl``, perhaps with a comment
    file: str  # name of the material file
    argument_by_keyword: dict[str, str] = field(default_factory=dict)
    spelling: dict[str, str] = field(default_factory=dict)  # keywords as written
    # Keywords of statements that a later, different one overrides.
    overridden: list[str] = field(default_factory=list)

    @cached_property
    def tracked_statements(self) -> TrackedKeys[str]:
        """The statements, tracking which of them are read."""
        # The keys are the keywords as the file writes them, since `find_unread` returns
        # them for notes. With `fold` they are looked up in lower case.
        return TrackedKeys(
            {
                self.spelling[key]: statement
                for key, statement in self.argument_by_keyword.items()
            },
            fold=str.lower,
        )

    def read_argument(self, key: str) -> str:
        """Return the arguments of a statement of numbers, "" if there is none.

        The statement is marked as read.
        """
        self.tracked_statements.mark_read(key)
        return self.peek_argument(key)

    def peek_argument(self, key: str) -> str:
        """Return what `read_argument` returns, but don't mark the statement as read."""
        return self.argument_by_keyword.get(key, "").partition("#")[0].strip()

    def add_statement(self, keyword: str, value: str) -> None:
        """Store a statement, which overrides an earlier one with the same keyword."""
        key = keyword.lower()
        earlier_value = self.argument_by_keyword.get(key, value)
        if earlier_value != value:
            self.overridden.append(keyword)
        self.argument_by_keyword[key] = value
        self.spelling[key] = keyword


@dataclass(frozen=True)
class MapStatement:
    """A statement that names a picture."""

    name: str  # name of the picture in the file
    options: dict[str, str]  # values of its options by their names, in lower case
    # Number of repeats of the image over a unit of u and of v (``-s``).
    scale: Pair = (1.0, 1.0)
    offset: Pair = (0.0, 0.0)  # offset of texture coordinates after scaling (``-o``)
    # Offset of the image's values after scaling, and their factor (``-mm``).
    range: Pair = (0.0, 1.0)
    bump: float = 1.0  # factor of a normal map's x and y (``-bm``)


def parse_mtl(text: str, file: str) -> tuple[list[MtlMaterial], list[str]]:
    """Parse the text of a material file.

    Args:
        text: the text.
        file: name of the file, for notes.

    Returns:
        Its materials, and the keywords of statements before the first of them.
    """
    materials: list[MtlMaterial] = []
    stray_keywords = []
    for line in _CONTINUED.sub(r"\1 ", text.replace("\r\n", "\n")).splitlines():
        keyword, _, argument = line.strip().replace("\t", " ").partition(" ")
        key = keyword.lower()
        if not key or key.startswith("#"):
            continue
        if key == "newmtl":
            materials.append(MtlMaterial(" ".join(argument.split()), file))
        elif materials:
            materials[-1].add_statement(keyword, argument.strip())
        else:
            stray_keywords.append(keyword)
    return materials, stray_keywords


def without_comment(text: str) -> str:
    """Return a text up to the first ``#`` that begins a word, without blanks around it."""
    return _COMMENT.sub("", text).strip()


def parse_map(argument: str) -> MapStatement | None:
    """Parse the arguments of a statement that names an image; None if it names none.

    In "-s 2 2 -clamp on old wood.png" the name is "old wood.png". Known options are
    removed wherever they are. Then words with a dash at the beginning are unknown
    options, which are removed together with their values. The rest is the name, which
    may have blanks.
    """
    options = _parse_known_options(argument)
    name = _remove_unknown_options(_KNOWN_OPTION.sub("", argument), options)
    if not name:
        return None
    bump, _ = _parse_pair(options, "bm", (1.0, 1.0))  # the option has one number
    return MapStatement(
        name,
        options,
        scale=_parse_pair(options, "s", (1.0, 1.0)),
        offset=_parse_pair(options, "o", (0.0, 0.0)),
        range=_parse_pair(options, "mm", (0.0, 1.0)),
        bump=bump,
    )


def _parse_known_options(argument: str) -> dict[str, str]:
    """Return the values of the known options in a statement, by name."""
    options: dict[str, str] = {}
    for match in _KNOWN_OPTION.finditer(argument):
        for key in _VALUE_PATTERNS:
            if match[key] is not None:
                options[key] = match[f"{key}_"]
    return options


def _remove_unknown_options(text: str, options: dict[str, str]) -> str:
    """Return the name after the unknown options of a text, which are added to `options`.

    They are added without their values, since only their names are noted.
    """
    name = " ".join(text.split())
    unknown = _UNKNOWN_OPTION.match(name)
    while unknown:
        options[unknown[1].lower()] = ""
        name = name[unknown.end() :]
        unknown = _UNKNOWN_OPTION.match(name)
    return name


def _parse_pair(options: dict[str, str], key: str, default: Pair) -> Pair:
    """Return the first two numbers of an option, completed by defaults.

    Numbers that are too large to compute with are replaced by the defaults.
    """
    numbers = [float(word) for word in options.get(key, "").split()[:2]]
    u, v = [*numbers, *default[len(numbers) :]]
    return (u, v) if abs(u) < 1e6 and abs(v) < 1e6 else default


def parse_numbers(argument: str) -> list[float] | None:
    """Return the numbers of a statement; None unless all its words are finite numbers."""
    try:
        values = [float(word) for word in argument.split()]
    except ValueError:
        return None
    return values if values and all(map(math.isfinite, values)) else None


def parse_fraction(argument: str) -> float | None:
    """Return the last word of a statement as a number clipped to [0, 1].

    Options may precede that word. The result is None if it is missing or no number.
    """
    words = argument.split()
    if not words:
        return None
    values = parse_numbers(words[-1])
    return None if values is None else min(max(values[0], 0.0), 1.0)


def _is_zero(argument: str) -> bool:
    """Return whether a statement has numbers, and all of them are 0."""
    values = parse_numbers(argument)
    return values is not None and not any(values)
