"""What the materials of an .mtl file look like, as `ImportedSurface` has it; what they
say beyond that is named.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from PIL import Image

from advsearch.scene.assets import Doubles, Floats, Ints
from advsearch.scene.importing.files import Notes, shown, text_of
from advsearch.scene.importing.parts import (
    NEUTRAL,
    ImportedSurface,
    holds_normals,
    instead_of_texture,
    limited_radiance,
    normal_map,
    with_opacity,
)
from advsearch.scene.importing.pictures import FilePictures, Kind
from advsearch.scene.importing.texture import mean_over
from advsearch.scene.importing.unread import TrackedKeys
from advsearch.trust.named_files import References, plain_name

QUIET = frozenset("ka ks ns ni sharpness map_aat".split())
"""Statements of every file whose terms (ambient light, Phong's highlights) have no
place in a physical material.
"""
NORMALS = ("norm", "map_kn", "map_bump", "bump")
PLACED = ("map_kd", "map_d", *NORMALS, "map_ke")
"""Maps that are looked up by texture coordinates; the first of a material says where
all of them lie.
"""
# channels of a picture by the value of ``-imfchan``
CHANNELS = {"r": 0, "g": 1, "b": 2, "m": 3}
DEFAULTS = {
    "blendu": "on",
    "blendv": "on",
    "cc": "off",
    "clamp": "off",
    "bm": "1",
    "boost": "0",
}
"""What options say by default."""


@dataclass(frozen=True, eq=False)
class Painted:
    """A material that was read."""

    surface: ImportedSurface  # what it looks like
    scale: Pair = (1.0, 1.0)  # factors of texture coordinates
    offset: Pair = (0.0, 0.0)  # what is added to them then
    clamped: bool = False  # whether its textures are not to repeat


@dataclass
class MtlReader:
    """Reads the material files that a mesh file names, and turns their materials into
    surfaces, each once. `shown_on` returns UVs (F, 3, 2) and areas (F,) of the faces
    with a material, by its name and a UDIM square.
    """

    references: References
    notes: Notes
    shown_on: Callable[[str, int], tuple[Doubles, Doubles]]
    libraries: int = 0  # how many material files were read
    _materials: dict[str, MtlMaterial] = field(default_factory=dict)
    _painted: dict[tuple[int, int], Painted] = field(default_factory=dict)
    _uses: dict[tuple[int, str], MapUse | None] = field(default_factory=dict)

    def read_library(self, name: str) -> None:
        """Read a material file; of materials with the same name, the first counts."""
        try:
            text = text_of(self.references.get(name))
        except FileNotFoundError:
            plain = plain_name(name)
            why = f"{shown(plain)}, which {self.references.refused[plain]}"
            self.notes.say(
                f" names the material file {why}; neutral grey is used instead"
            )
            return
        self.libraries += 1
        file = plain_name(name).rpartition("/")[2]
        materials, stray = parsed(text, file)
        for key in stray:
            self.notes.has(
                f"before the first material of {shown(file, quoted=False)}, statement",
                key,
            )
        for material in materials:
            first = self._materials.setdefault(material.name, material)
            if first.statements != material.statements and first.file == material.file:
                self.notes.say(
                    f"{file} has the material {shown(material.name)} more "
                    "than once; the first counts"
                )
        for material in materials:  # a comment, or part of the name: both are tried
            self._materials.setdefault(without_comment(material.name), material)

    def _named(self, name: str) -> MtlMaterial | None:
        return self._materials.get(name) or self._materials.get(without_comment(name))

    def painted(self, name: str, square: int = 0) -> Painted | None:
        """Return a material by its name, or None; the name may have a comment after it.
        Of pictures of one UDIM square each, it takes those of that one, or as the file
        names them.
        """
        material = self._named(name)
        if material is not None and (id(material), square) not in self._painted:
            self._painted[id(material), square] = self._look_of(material, square, name)
        return None if material is None else self._painted[id(material), square]

    def squares_of(self, name: str, wanted: Sequence[int]) -> list[int]:
        """Return for which of these UDIM squares, the first of them 1001, there are
        pictures of their own; none of a material whose pictures have no square in their
        names, or repeat.
        """
        material = self._named(name)
        maps = [
            use
            for key in PLACED
            if material is not None and (use := self._use(material, key)) is not None
        ]
        numbered = next(
            (use.name for use in maps if number_in(use.name) is not None), None
        )
        if numbered is None:
            return []
        others = [
            square for square in wanted if square and square != number_in(numbered)
        ]
        beside = (
            isinstance(self.references.tried(named(numbered, square)), bytes)
            for square in others
        )
        if others and (number_in(numbered) == 0 or any(beside)):
            return [square for square in wanted if square]
        if others:
            self.notes.say(
                f"{shown(numbered)} is named like one of several pictures (UDIM), and "
                "there is none for the "
                f"faces in {', '.join(map(str, others[:8]))}: it repeats there; put "
                "those pictures beside it"
            )
        return []

    def _look_of(self, material: MtlMaterial, square: int, name: str) -> Painted:
        is_first = not any(known == id(material) for known, _ in self._painted)
        uses = {
            key: use
            for key in (*PLACED, "map_pr", "map_pm")
            if (use := self._use(material, key)) is not None
        }
        material.keys.mark_read("illum", *(key for key in uses if key not in NORMALS))
        if square:
            uses = {
                key: replace(use, name=named(use.name, square))
                for key, use in uses.items()
            }
        first = next((uses[key] for key in PLACED if key in uses), MapUse("", {}))
        for key in [key for key in PLACED if key in uses]:
            if (uses[key].scale, uses[key].offset) != (first.scale, first.offset):
                what = f"{material.spelled[key]} of the material {shown(material.name)}"
                self.notes.say(
                    f"{what} lies elsewhere than its other maps (-s, -o); "
                    "it is left out"
                )
                material.keys.mark_read(key)
                del uses[key]
        rest = material.numbers("kd")
        base = uses.get("map_kd")
        color = None
        values = numbers_of(rest)
        if values is not None and len(values) in (1, 3, 4):  # of four, three count
            color = np.clip(np.broadcast_to(values[:3], (3,)), 0.0, 1.0).astype(
                np.float32
            )
        elif "kd" in material.statements:
            what = f"the Kd {shown(rest)} of the material {shown(material.name)}"
            self.notes.say(f"{what} is no colour; neutral grey is used instead")
        # A texture stands alone: a Kd beside it is an exporter's default more often
        # than a tint.
        instead = f"{instead_of_texture(color)} is used instead"
        words = f"{material.file} names the texture {{name}}, which {{why}}; {instead}"
        texture = self._picture(base, "colours and alpha", words)
        if base is not None and texture is not None:
            if texture[:, :, 3].min() < 1.0 and "map_d" not in material.statements:
                self.notes.say(
                    f"the alpha of {shown(base.name)} is left out: no map_d "
                    "makes it an opacity"
                )
            texture = np.ascontiguousarray(texture[:, :, :3])
        if base is not None and color is not None and (color > 0.999).all():
            color = None  # plain white only leaves a texture alone
        look = replace(
            self._see_through(
                material,
                uses.get("map_d"),
                ImportedSurface(color, texture, name=material.name),
            ),
            roughness=self._share(material, "pr", uses.get("map_pr"), name, square),
            metallic=self._share(material, "pm", uses.get("map_pm"), name, square),
            normal_map=self._bumps(material, uses),
            emission=self._glow(material, uses.get("map_ke")),
        )
        if is_first:
            self._list(material)
        clamped = bool(first.name) and any(
            use.options.get("clamp", "").lower() == "on" for use in uses.values()
        )
        return Painted(look, first.scale, first.offset, clamped)

    def _list(self, material: MtlMaterial) -> None:
        """Put what is not read into the inventory; what is there by default, and
        changes nothing, is not in it.
        """
        zero = {
            key
            for key in material.statements
            if not any(numbers_of(material.peek_numbers(key)) or [1.0])
        }
        base = map_of(without_comment(material.statements.get("map_kd", "")))

        def is_quiet(key: str, statement: str) -> bool:
            rest = without_comment(statement)
            use = map_of(rest)
            if (
                not rest
                or key in QUIET
                or key in zero
                or (key == "pcr" and "pc" in zero)
            ):
                return True
            if key == "tf":
                return len(set(rest.split())) == 1
            return (
                key == "map_ka"
                and use is not None
                and base is not None
                and use.name == base.name
            )

        for key in material.again:
            self.notes.has("earlier material statement", key)
        if len(material.peek_numbers("kd").split()) == 4:
            self.notes.has("fourth number of", material.spelled["kd"])
        if material.peek_numbers("illum") not in ("", "0", "1", "2"):
            self.notes.has(
                "illumination model", without_comment(material.statements["illum"])
            )
        for name in material.keys.unread(is_quiet):
            self.notes.has("material statement", name)

    def _use(self, material: MtlMaterial, key: str) -> MapUse | None:
        """Return what a statement says that names a picture, and put options that are
        not read into the inventory.
        """
        if (id(material), key) in self._uses:
            return self._uses[id(material), key]
        rest = material.statements.get(key, "")
        use = map_of(without_comment(rest))
        whole = map_of(rest)
        if (
            whole is not None
            and whole != use
            and isinstance(self.references.tried(whole.name), bytes)
        ):
            use = whole  # the # belongs to the name
        self._uses[id(material), key] = use
        taken = ("s", "o", "mm", "clamp", "bm" if key in NORMALS else "imfchan")
        colors = key in ("map_kd", "map_ke")
        options = TrackedKeys({} if use is None else use.options)
        options.mark_read(
            *(option for option in taken if option != "imfchan" or not colors)
        )

        def is_quiet(option: str, value: str) -> bool:
            if option == "colorspace":
                return value.lower() == ("srgb" if colors else "linear")
            is_usual = value.lower() == DEFAULTS.get(option) or not any(
                numbers_of(value) or [1.0]
            )
            return is_usual and option != "imfchan"

        for option in options.unread(is_quiet):
            self.notes.has("texture option", f"-{option} of {material.spelled[key]}")
        return use

    def _see_through(
        self, material: MtlMaterial, use: MapUse | None, surface: ImportedSurface
    ) -> ImportedSurface:
        """Give a surface its opacity: ``d``, a number, or 1 - ``Tr``, which some
        programs write for d; and ``map_d``, a picture.
        """
        if "-halo" in material.numbers("d").lower().split():
            self.notes.has("option", "-halo of d")
        factor = share_of(material.numbers("d"), -1.0)
        clear = share_of(material.numbers("tr"), -1.0)
        what = f"the material {shown(material.name)} has Tr {clear:g}"
        if (
            factor >= 0.0
            and clear >= 0.0
            and min(abs(clear - factor), abs(1.0 - clear - factor)) > 0.01
        ):
            self.notes.say(
                f"{what} beside d {factor:g}, which it contradicts; d is "
                "taken for its opacity"
            )
        elif factor < 0.0 < clear:
            self.notes.say(
                f"{what} and no d: it is taken for transparency, which makes its "
                f"opacity {1.0 - clear:g}; some programs"
                f" mean opacity by it, so write d in its place"
            )
        factor = factor if factor >= 0.0 else 1.0 - max(clear, 0.0)
        picture = self._picture(
            use, "colours and alpha", "the opacity {name} {why}; it is opaque instead"
        )
        if picture is None and factor == 1.0:
            return surface
        share = np.array([factor], np.float32)
        color = surface.color
        texture = surface.texture
        plain = np.full(3, NEUTRAL, np.float32) if color is None else color
        if use is None or picture is None:
            color = plain if texture is None else color
        else:
            opacity = _channel(picture, use)
            texture = (
                np.broadcast_to(plain, (*opacity.shape, 3))
                if texture is None
                else texture
            )
            size = (texture.shape[1], texture.shape[0])
            fitted = np.asarray(
                Image.fromarray(opacity).resize(size, Image.Resampling.BILINEAR)
            )
            texture = np.concatenate([texture, fitted[:, :, None]], axis=2)
        return replace(
            surface,
            color=with_opacity(color, share, None),
            texture=with_opacity(texture, share, None),
        )

    def _share(
        self,
        material: MtlMaterial,
        key: str,
        use: MapUse | None,
        name: str,
        square: int,
    ) -> float | None:
        """Return a roughness or metallic: the mean of its map over the faces that show
        it, or else its number; None where there is neither.
        """
        words = f"{material.spelled.get(f'map_{key}')} {{name}} {{why}}; it is left out"
        picture = self._picture(use, "numbers", words)
        value = share_of(material.numbers(key), -1.0)
        if use is not None and picture is not None:
            self.notes.say(
                "textures of roughness and metallic are replaced by their means"
            )
            uvs, areas = self.shown_on(name, square)
            return float(
                mean_over(
                    _channel(picture, use)[:, :, None],
                    uvs * use.scale + use.offset,
                    areas,
                )[0]
            )
        return value if value >= 0.0 else None

    def _bumps(self, material: MtlMaterial, uses: dict[str, MapUse]) -> Floats | None:
        words = "the normal map {name} {why}; it is left out"
        for key, use in ((key, uses[key]) for key in NORMALS if key in uses):
            picture = self._picture(use, "numbers", words)
            material.keys.mark_read(
                *(other for other in uses if uses[other].name == use.name)
            )
            if picture is not None:
                if key in ("norm", "map_kn") or holds_normals(picture):
                    return normal_map(picture, use.bump)
                self._pictures.lacks(use.name, "holds heights, and no normals", words)
        return None

    def _glow(self, material: MtlMaterial, use: MapUse | None) -> Floats | None:
        values = numbers_of(material.numbers("ke") or "0")
        if values is None or len(values) not in (1, 3) or min(values) < 0:
            self.notes.say(
                f"the emission {shown(material.numbers('ke'))} is no "
                "colour; it is left out"
            )
            return None
        factor = np.broadcast_to(values, (3,))
        picture = self._picture(
            use, "colours", "the texture {name} of the emission {why}; it is left out"
        )
        if use is not None and picture is None:
            return None
        return limited_radiance(
            np.ones(3) if use is not None and not factor.any() else factor,
            picture,
            self.notes,
        )

    @cached_property
    def _pictures(self) -> FilePictures:
        return FilePictures(len(self._materials), self.references, self.notes)

    def _picture(self, use: MapUse | None, kind: Kind, words: str) -> Floats | None:
        """Return a picture's values with its ``-mm`` applied; None where there is none,
        or it cannot be had.
        """
        picture = None if use is None else self._pictures.of_file(use.name, kind, words)
        if use is None or picture is None or use.range == (0.0, 1.0):
            return picture
        base, gain = map(np.float32, use.range)
        return np.concatenate(
            [np.clip(picture[:, :, :3] * gain + base, 0.0, 1.0), picture[:, :, 3:]],
            axis=2,
        )


def _channel(picture: Floats, use: MapUse) -> Floats:
    """Return the (H, W) values that a picture holds for a map of numbers: of the
    channel that ``-imfchan`` names, or else its alpha, or its grey where it has none.
    """
    number = CHANNELS.get(use.options.get("imfchan", "").lower())
    alpha = picture.shape[2] == 4
    if number is None and alpha and picture[:, :, 3].min() < 1.0:
        number = 3
    return (
        picture[:, :, :3].mean(axis=2)
        if number is None or (number == 3 and not alpha)
        else picture[:, :, number]
    )


def libraries_of(rests: Sequence[str], references: References) -> list[str]:
    """Return the names of material files that ``mtllib`` lines hold. A line may name
    several, and a name may have blanks: a line that is the name of a file is that, else
    each name ends in ``.mtl``, else in a blank.
    """
    names: list[str] = []
    for rest in rests:
        plain = without_comment(rest)
        for line in (rest, plain):
            if isinstance(references.tried(line), bytes):
                names.append(line)
                break
        else:
            parts = list[str]()
            name = ""
            for word in plain.split():
                name = f"{name} {word}".strip()
                if word.strip('"').lower().endswith(".mtl"):
                    parts = [*parts, name]
                    name = ""
            parts += name.split()
            ended = all(part.strip('"').lower().endswith(".mtl") for part in parts)
            names += (
                parts
                if ended
                or any(isinstance(references.tried(part), bytes) for part in parts)
                else [plain]
            )
    return list(dict.fromkeys(filter(None, names)))


# ---------------------------------------------------------------------------------------------------------------------
# UDIM: one picture for each unit square of texture coordinates, with the square's
# number in its name.
#
# The square from (0, 0) is 1001, those to its right count on to 1010, and each row
# above adds 10.

FIRST = 1001
ACROSS = 10
_NUMBER = re.compile(r"(?<!\d)1\d{3}(?=\.\w+$)")
_PLACE = re.compile(r"<UDIM>", re.IGNORECASE)


def number_in(name: str) -> int | None:
    """Return the number of the square that a picture's name has; 0 where it has
    ``<UDIM>`` in its place, else None.
    """
    if _PLACE.search(name):
        return 0
    found = _NUMBER.search(name)
    return int(found[0]) if found and int(found[0]) >= FIRST else None


def named(name: str, number: int) -> str:
    return (
        _PLACE.sub(str(number), name)
        if _PLACE.search(name)
        else _NUMBER.sub(str(number), name)
    )


def squares(uvs: Doubles) -> Ints:
    """Return the numbers (F,) of the squares that the middles of faces, with these UVs
    (F, 3, 2), lie in; 0 for none.
    """
    column, row = np.floor(uvs.mean(axis=1)).T
    known = (column >= 0) & (column < ACROSS) & (row >= 0) & (row < 100)
    return np.where(known, FIRST + column + ACROSS * row, 0).astype(np.int64)


def corner_of(square: int) -> tuple[int, int]:
    """Return the texture coordinates at which a square begins; (0, 0) for none."""
    return ((square - FIRST) % ACROSS, (square - FIRST) // ACROSS) if square else (0, 0)


# ---------------------------------------------------------------------------------------------------------------------
# The grammar of material files (.mtl): statements, comments, and the options of maps.
#
# Nothing of a statement's meaning is here; what each says of a surface is read in
# `mtl_surfaces`.

Pair = tuple[float, float]
_MTL_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_OPTIONS = {
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
_OPTION = re.compile(
    "|".join(
        rf"(?:(?<=\s)|^)-(?P<{name}>{name})\s+(?P<{name}_>{value})(?=\s|$)"
        for name, value in _OPTIONS.items()
    ),
    re.IGNORECASE,
)
_UNKNOWN = re.compile(
    rf"-([a-z]\w*)(?:\s+(?:on|off|{_MTL_NUMBER})(?=\s))*\s+", re.IGNORECASE
)
_COMMENT = re.compile(r"(?:^|(?<=\s))#.*")
_CONTINUED = re.compile(r"^([^#\n][^\n]*?)\\[ \t]*\n", re.MULTILINE)


@dataclass
class MtlMaterial:
    """A material as its file has it: the rest of each line by its keyword in lower case
    (of several lines with the same one, the last), and that as the file spells it.
    """

    name: str  # as it stands after ``newmtl``, with what may be a comment
    file: str  # name of the material file
    statements: dict[str, str] = field(default_factory=dict)
    spelled: dict[str, str] = field(default_factory=dict)
    # keywords of lines that others come after that say something else
    again: list[str] = field(default_factory=list)

    @cached_property
    def keys(self) -> TrackedKeys[str]:
        """The statements, of which those that are read are recorded."""
        return TrackedKeys(
            {self.spelled[key]: rest for key, rest in self.statements.items()},
            fold=str.lower,
        )

    def numbers(self, key: str) -> str:
        """Read what a statement of numbers says, without a comment; empty where there
        is none.
        """
        self.keys.mark_read(key)
        return self.peek_numbers(key)

    def peek_numbers(self, key: str) -> str:
        """Return what `numbers` does, and do not count it as read."""
        return self.statements.get(key, "").partition("#")[0].strip()


@dataclass(frozen=True)
class MapUse:
    """A statement that names a picture."""

    name: str  # of the picture, as the file has it
    # its options by their names, in lower case, as (name, value)
    options: dict[str, str]
    # how often the picture repeats over a unit of u and of v (``-s``)
    scale: Pair = (1.0, 1.0)
    offset: Pair = (0.0, 0.0)  # what is added to scaled texture coordinates (``-o``)
    # what is added to the picture's values, and their factor before (``-mm``)
    range: Pair = (0.0, 1.0)
    bump: float = 1.0  # the factor of a normal map's x and y (``-bm``)


def parsed(text: str, file: str) -> tuple[list[MtlMaterial], list[str]]:
    """Return the materials of a material file, and the keywords of statements before
    the first of them.
    """
    materials: list[MtlMaterial] = []
    stray = []
    for line in _CONTINUED.sub(r"\1 ", text.replace("\r\n", "\n")).splitlines():
        key, _, rest = line.strip().replace("\t", " ").partition(" ")
        if not key or key.startswith("#"):
            continue
        if key.lower() == "newmtl":
            materials.append(MtlMaterial(" ".join(rest.split()), file))
        elif materials:
            if materials[-1].statements.get(key.lower(), rest.strip()) != rest.strip():
                materials[-1].again.append(key)
            materials[-1].statements[key.lower()] = rest.strip()
            materials[-1].spelled[key.lower()] = key
        else:
            stray.append(key)
    return materials, stray


def without_comment(text: str) -> str:
    """Return what stands before a ``#`` at the beginning of a word."""
    return _COMMENT.sub("", text).strip()


def map_of(rest: str) -> MapUse | None:
    """Return what a statement says that names a picture, with options before the name
    and after it, which may have blanks; None where it names none.
    """
    options: dict[str, str] = {}
    for match in _OPTION.finditer(rest):
        options.update(
            {key: match[f"{key}_"] for key in _OPTIONS if match[key] is not None}
        )
    name = " ".join(_OPTION.sub("", rest).split())
    while unknown := _UNKNOWN.match(name):
        options[unknown[1].lower()], name = "", name[unknown.end() :]
    if not name:
        return None
    pairs = []
    for key, usual in {
        "s": (1.0, 1.0),
        "o": (0.0, 0.0),
        "mm": (0.0, 1.0),
        "bm": (1.0, 1.0),
    }.items():
        words = options.get(key, "").split()[:2]
        u, v = (*map(float, words), *usual[len(words) :])
        # what can be computed with
        pairs.append((u, v) if abs(u) < 1e6 and abs(v) < 1e6 else usual)
    scale, offset, values, (bump, _) = pairs
    return MapUse(name, options, scale, offset, values, bump)


def numbers_of(rest: str) -> list[float] | None:
    """Return the finite numbers that a statement consists of; None where it has other
    words, or none.
    """
    try:
        values = [float(word) for word in rest.split()]
    except ValueError:
        return None
    return values if values and all(map(math.isfinite, values)) else None


def share_of(rest: str, otherwise: float) -> float:
    """Return the last word as a number, in [0, 1], or what holds otherwise; `d` has
    options before it.
    """
    values = numbers_of(" ".join(rest.split()[-1:]))
    return otherwise if values is None else min(max(values[0], 0.0), 1.0)
