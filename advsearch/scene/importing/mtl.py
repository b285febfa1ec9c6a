"""The grammar of material files (.mtl): statements, comments, and the options of maps.

Nothing of a statement's meaning is here; what each says of a surface is read in `mtl_surfaces`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

import numpy as np

from advsearch.scene.assets import Doubles, Floats

Pair = tuple[float, float]
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_OPTIONS = {
    "blendu": "on|off",
    "blendv": "on|off",
    "bm": _NUMBER,
    "boost": _NUMBER,
    "cc": "on|off",
    "clamp": "on|off",
    "colorspace": r"\S+",
    "imfchan": "[rgbmlz]",
    "mm": rf"{_NUMBER}\s+{_NUMBER}",
    "o": rf"{_NUMBER}(?:\s+{_NUMBER}){{0,2}}",
    "s": rf"{_NUMBER}(?:\s+{_NUMBER}){{0,2}}",
    "t": rf"{_NUMBER}(?:\s+{_NUMBER}){{0,2}}",
    "texres": r"\d+",
    "type": r"sphere|cube_\w+",
}
_OPTION = re.compile(
    "|".join(rf"(?:(?<=\s)|^)-(?P<{name}>{name})\s+(?P<{name}_>{value})(?=\s|$)" for name, value in _OPTIONS.items()),
    re.IGNORECASE,
)
_UNKNOWN = re.compile(rf"-([a-z]\w*)(?:\s+(?:on|off|{_NUMBER})(?=\s))*\s+", re.IGNORECASE)
_COMMENT = re.compile(r"(?:^|(?<=\s))#.*")
_CONTINUED = re.compile(r"^([^#\n][^\n]*?)\\[ \t]*\n", re.MULTILINE)


@dataclass
class MtlMaterial:
    """A material as its file has it: the rest of each line by its keyword in lower case (of several lines with the same
    one, the last), and that as the file spells it."""

    name: str  # as it stands after ``newmtl``, with what may be a comment
    file: str  # name of the material file
    statements: dict[str, str] = field(default_factory=dict)
    spelled: dict[str, str] = field(default_factory=dict)
    again: list[str] = field(default_factory=list)  # keywords of lines that others come after that say something else

    def numbers(self, key: str) -> str:
        """Return what a statement of numbers says, without a comment; empty where there is none."""
        return self.statements.get(key, "").partition("#")[0].strip()


@dataclass(frozen=True)
class MapUse:
    """A statement that names a picture."""

    name: str  # of the picture, as the file has it
    options: dict[str, str]  # its options by their names, in lower case, as (name, value)
    scale: Pair = (1.0, 1.0)  # how often the picture repeats over a unit of u and of v (``-s``)
    offset: Pair = (0.0, 0.0)  # what is added to scaled texture coordinates (``-o``)
    range: Pair = (0.0, 1.0)  # what is added to the picture's values, and their factor before (``-mm``)
    bump: float = 1.0  # the factor of a normal map's x and y (``-bm``)


def parsed(text: str, file: str) -> tuple[list[MtlMaterial], list[str]]:
    """Return the materials of a material file, and the keywords of statements before the first of them."""
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
    """Return what a statement says that names a picture, with options before the name and after it, which may have
    blanks; None where it names none."""
    options: dict[str, str] = {}
    for match in _OPTION.finditer(rest):
        options.update({key: match[f"{key}_"] for key in _OPTIONS if match[key] is not None})
    name = " ".join(_OPTION.sub("", rest).split())
    while unknown := _UNKNOWN.match(name):
        options[unknown[1].lower()], name = "", name[unknown.end() :]
    if not name:
        return None
    usual = {"s": (1.0, 1.0), "o": (0.0, 0.0), "mm": (0.0, 1.0), "bm": (1.0, 1.0)}
    scale, offset, values, (bump, _) = (_pair(options.get(key, ""), pair) for key, pair in usual.items())
    return MapUse(name, options, scale, offset, values, bump)


def _pair(text: str, otherwise: Pair) -> Pair:
    """What an option says, or what holds otherwise, where it says too little or nothing that can be computed with."""
    words = text.split()[:2]
    u, v = (*map(float, words), *otherwise[len(words) :])
    return (u, v) if abs(u) < 1e6 and abs(v) < 1e6 else otherwise


def color_of(rest: str) -> Floats | None:
    """Return a colour (3,) float32, clipped to [0, 1], of one number, three, or four of which three count; or None."""
    values = numbers_of(rest)
    if values is None or len(values) not in (1, 3, 4):
        return None
    color: Floats = np.clip(np.broadcast_to(values[:3], (3,)), 0.0, 1.0).astype(np.float32)
    return color


def radiance_of(rest: str) -> Doubles | None:
    """Return one or three numbers of at least 0 as a colour (3,), black where there are none; None for other words."""
    values = numbers_of(rest or "0")
    return np.broadcast_to(values, (3,)) if values is not None and len(values) in (1, 3) and min(values) >= 0 else None


def numbers_of(rest: str) -> list[float] | None:
    """Return the finite numbers that a statement consists of; None where it has other words, or none."""
    try:
        values = [float(word) for word in rest.split()]
    except ValueError:
        return None
    return values if values and all(map(math.isfinite, values)) else None


def share_of(rest: str, otherwise: float) -> float:
    """Return the last word as a number, in [0, 1], or what holds otherwise; `d` has options before it."""
    values = numbers_of(" ".join(rest.split()[-1:]))
    return otherwise if values is None else min(max(values[0], 0.0), 1.0)
