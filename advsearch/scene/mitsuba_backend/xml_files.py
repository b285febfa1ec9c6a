"""Mitsuba's XML scene files as the dictionaries that its loader takes, without asking Mitsuba.

A file may come from anywhere. It names plugins, which are libraries, and files, and may include others: only plugins
that Mitsuba brings are taken, and only ordinary files in its own folder and below: Mitsuba finds a plugin as a library,
the current folder included, and reads most files without the checks that a file from anywhere needs. Entities and
document types are refused, and all is counted.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.files import note_opened
from advsearch.scene.assets import Doubles, Floats
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.environments import SUFFIXES as RADIANCE
from advsearch.scene.environments import import_environment, read_light
from advsearch.scene.importing.files import References, damaged, looks_like, read_bytes, shown
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.importing.pictures import TEXTURE_LIMIT, banded_average, read_picture
from advsearch.scene.mitsuba_backend.variant import Plugin

SUFFIX = ".xml"

LARGEST = 1 << 24
"""Bytes of a file, and of all that it includes."""
MOST_ELEMENTS = 50_000
DEEPEST = 40
MOST_INCLUDED = 50
LONGEST = 10_000
"""Letters of a text with the values of its `$names`."""

PLUGINS = frozenset(
    "shape bsdf emitter sensor integrator film rfilter sampler texture medium phase volume spectrum".split()
)
"""Elements that are plugins."""
SHARED = frozenset(("bsdf", "texture", "medium", "phase", "volume"))
"""Those to which others refer."""
MOVES = frozenset(("translate", "rotate", "scale", "matrix", "lookat", "look_at"))


@dataclass
class _Element:
    tag: str
    line: int
    given: dict[str, str]
    inner: list[_Element] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.given.get("name", "")


def read_scene(path: Path, parameters: Mapping[str, str] | None = None) -> Plugin:
    """Return the dictionary of a scene file: plugins with their `type`, numbers, texts, transforms (4, 4).

    Args:
        path: of the file.
        parameters: values for its `$names`, over its own defaults.

    Raises:
        FileFormatError: it is missing, damaged, too large, or no Mitsuba scene.
    """
    data = read_bytes(path, "scene", (SUFFIX,))
    reader = _Reader(path, References(path), dict(parameters or {}))
    root = reader.parsed(data)
    if root.tag != "scene":
        raise damaged(path, "a Mitsuba scene, which begins with <scene version=...>", f"<{shown(root.tag)}>")
    scene = reader.plugin(root, "scene")
    return {**scene, **{name: reader.named[name] for name in sorted(reader.referred & set(reader.named) - set(scene))}}


@dataclass
class _Reader:
    path: Path
    references: References
    values: dict[str, str]
    size: int = 0
    elements: int = 0
    included: int = 0
    named: dict[str, Plugin] = field(default_factory=dict)
    """Plugins with ids that stand within others, to which the rest of the file may refer."""
    referred: set[str] = field(default_factory=set)
    last: dict[tuple[int, str], int] = field(default_factory=dict)
    """The last number behind a name in a plugin, by the identity of its dictionary."""

    def parsed(self, data: bytes) -> _Element:
        """Return the tree of a file."""
        self.size += len(data)
        if self.size > files.scaled(LARGEST):
            raise files.too_large(self.path, f"a scene of at most {files.scaled(LARGEST):,} bytes", f"{self.size:,}")
        parser, open_ones, roots = expat.ParserCreate(), list[_Element](), list[_Element]()

        def refuse(*_: object) -> None:
            raise FileFormatError(f"{self.path}: declares a document type or entities, which no scene needs; remove it")

        def start(tag: str, given: dict[str, str]) -> None:
            self.elements += 1
            if self.elements > files.scaled(MOST_ELEMENTS) or len(open_ones) >= DEEPEST:
                most = f"at most {files.scaled(MOST_ELEMENTS):,} elements, {DEEPEST} deep"
                raise FileFormatError(f"{self.path}: expected {most}, got more; split the scene up")
            one = _Element(tag, parser.CurrentLineNumber, given)
            (open_ones[-1].inner if open_ones else roots).append(one)
            open_ones.append(one)

        parser.StartDoctypeDeclHandler = refuse
        parser.EntityDeclHandler = refuse
        parser.StartElementHandler = start
        parser.EndElementHandler = lambda tag: open_ones.pop() and None
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            found = f"{expat.errors.messages[error.code]} in line {error.lineno}"
            got = found if data.lstrip().startswith(b"<") else looks_like(data)
            raise damaged(self.path, "an XML file", got) from error
        except (LookupError, ValueError) as error:  # an encoding that Python does not have
            raise damaged(self.path, "an XML file", f"one in an unknown encoding ({shown(str(error))})") from error
        root = roots[0]
        version = root.given.get("version", "3.0.0")
        if root.tag == "scene" and not re.match(r"[23]\.", version):
            raise FileFormatError(
                f"{self.path}: expected a scene of Mitsuba 2 or 3, got version {shown(version)}; convert it"
            )
        return root

    def plugin(self, element: _Element, kind: str) -> Plugin:
        """Return a plugin with all that is in it."""
        found: Plugin = {"type": kind}
        for one in element.inner:
            self.put(one, found)
        return found

    def put(self, one: _Element, into: Plugin) -> None:
        """Put what an element says into a plugin's dictionary."""
        if one.tag == "default":
            self.values.setdefault(self.text(one, "name"), self.text(one, "value"))
        elif one.tag == "include":
            self.include(self.text(one, "filename"), into)
        elif one.tag in ("alias", "path"):
            raise self.wrong(one, f"<{one.tag}> is not read; write the scene without it")
        elif one.tag == "ref":
            self.referred.add(_plain(self.text(one, "id")))
            into[self.free(into, one.name or "ref")] = {"type": "ref", "id": _plain(self.text(one, "id"))}
        elif one.tag in PLUGINS and "type" in one.given:
            wanted = one.name or one.given.get("id") or (one.given["type"] if into["type"] == "scene" else one.tag)
            inner = self.plugin(one, self.text(one, "type"))
            if "id" in one.given and into["type"] == "scene":
                wanted = one.given["id"]
            elif "id" in one.given and one.tag in SHARED:
                self.named.setdefault(_plain(self.text(one, "id")), inner)
            into[self.free(into, _plain(wanted))] = inner
        else:
            into[self.free(into, self.text(one, "name"))] = self.value(one)

    def free(self, taken: Plugin, wanted: str) -> str:
        """A name that is free: the one that is wanted, or with a number behind it."""
        name, number = wanted, self.last.get((id(taken), wanted), 1)
        while name in taken:
            number += 1
            name = f"{wanted}-{number}"
        self.last[id(taken), wanted] = number
        return name

    def include(self, name: str, into: Plugin) -> None:
        """Put what another file of the folder holds into a dictionary."""
        self.included += 1
        if self.included > MOST_INCLUDED:
            raise FileFormatError(f"{self.path}: includes more than {MOST_INCLUDED} files; does one include itself?")
        try:
            data = self.references.get(name)
        except FileNotFoundError:
            reason = next(reversed(self.references.refused.values()))
            raise FileFormatError(f"{self.path}: includes {shown(name)}, which {reason}") from None
        root = self.parsed(data)
        for one in root.inner if root.tag == "scene" else [root]:
            self.put(one, into)

    def value(self, one: _Element) -> object:
        """Return a number, a text, a colour, a transform."""
        readers: dict[str, Callable[[], object]] = {
            "float": lambda: self.numbers(one, 1)[0],
            "integer": lambda: round(self.numbers(one, 1)[0]),
            "boolean": lambda: self.text(one, "value").strip().lower() == "true",
            "string": lambda: self.text(one, "value"),
            "rgb": lambda: {"type": "rgb", "value": self.color(one)},
            "spectrum": lambda: self.spectrum(one),
            "point": lambda: list(self.place(one, 0.0)),
            "vector": lambda: list(self.place(one, 0.0)),
            "transform": lambda: self.transform(one),
        }
        if one.tag not in readers:
            raise self.wrong(one, f"<{shown(one.tag, quoted=False)}> is nothing that a Mitsuba scene has")
        return readers[one.tag]()

    def spectrum(self, one: _Element) -> object:
        """A constant, or pairs of wavelength and value."""
        text = self.text(one, "value")
        if ":" not in text:
            return {"type": "spectrum", "value": self.numbers(one, 1)[0]}
        pairs = [pair.split(":") for pair in re.split(r"[,\s]+", text.strip())]
        if not all(len(pair) == 2 for pair in pairs):
            raise self.wrong(one, f"expected wavelength:value, got {shown(text)}")
        return {"type": "spectrum", "value": [(self.number(one, a), self.number(one, b)) for a, b in pairs]}

    def color(self, one: _Element) -> list[float]:
        """Three numbers, or #rrggbb."""
        text = self.text(one, "value").strip()
        if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
            return [int(text[at : at + 2], 16) / 255.0 for at in (1, 3, 5)]
        found = self.numbers(one, None)
        if len(found) not in (1, 3):
            raise self.wrong(one, f"expected three numbers, got {shown(text)}")
        return found * 3 if len(found) == 1 else found

    def transform(self, one: _Element) -> Doubles:
        """The product of its steps (4, 4), the first applied first."""
        matrix = np.eye(4)
        for step in one.inner:
            if step.tag not in MOVES:
                raise self.wrong(step, f"<{shown(step.tag, quoted=False)}> is no step of a transform")
            matrix = self.step(step) @ matrix
        if not np.isfinite(matrix).all() or not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
            raise self.wrong(one, "expected a transform that can be undone, of finite numbers")
        return matrix

    def step(self, one: _Element) -> Doubles:
        """One step of a transform (4, 4)."""
        matrix = np.eye(4)
        if one.tag == "matrix":
            found = self.numbers(one, None)
            if len(found) not in (9, 16):
                raise self.wrong(one, f"expected 9 or 16 numbers, got {len(found)}")
            side = 3 if len(found) == 9 else 4
            matrix[:side, :side] = np.array(found).reshape(side, side)
            if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
                raise self.wrong(one, "expected an affine transform, whose last row is 0 0 0 1")
        elif one.tag == "translate":
            matrix[:3, 3] = self.place(one, 0.0)
        elif one.tag == "scale":
            matrix[:3, :3] = np.diag(self.place(one, 1.0))
        elif one.tag == "rotate":
            axis = self.place(one, 0.0)
            if not any(axis):
                raise self.wrong(one, 'expected an axis, such as y="1"')
            matrix[:3, :3] = _turn(axis, math.radians(self.number(one, self.text(one, "angle"))))
        else:
            origin, target, up = (
                np.array(self.triple(one, one.given.get(key, "0 1 0"))) for key in ("origin", "target", "up")
            )
            ahead = _unit(target - origin)
            left = _unit(np.cross(up, ahead))
            matrix[:3] = np.stack([left, np.cross(ahead, left), ahead, origin], axis=1)
        return matrix

    def place(self, one: _Element, otherwise: float) -> tuple[float, float, float]:
        """Three numbers in `value`, or in `x`, `y`, `z`."""
        if "value" in one.given:
            return self.triple(one, one.given["value"])
        x, y, z = (self.number(one, one.given[axis]) if axis in one.given else otherwise for axis in "xyz")
        return x, y, z

    def triple(self, one: _Element, text: str) -> tuple[float, float, float]:
        """Three numbers from one or three."""
        found = [self.number(one, part) for part in re.split(r"[,\s]+", self.filled(one, text).strip())]
        if len(found) not in (1, 3):
            raise self.wrong(one, f"expected three numbers, got {shown(text)}")
        x, y, z = found * 3 if len(found) == 1 else found
        return x, y, z

    def numbers(self, one: _Element, count: int | None) -> list[float]:
        """The numbers in `value`."""
        text = self.text(one, "value")
        found = [self.number(one, part) for part in re.split(r"[,\s]+", text.strip())]
        if count is not None and len(found) != count:
            raise self.wrong(one, f"expected a number, got {shown(text)}")
        return found

    def number(self, one: _Element, text: str) -> float:
        """A finite number of float32's range."""
        try:
            found = float(self.filled(one, text))
        except ValueError:
            raise self.wrong(one, f"expected a number, got {shown(text)}") from None
        if not abs(found) < 1e30:
            raise self.wrong(one, f"expected a finite number, got {shown(text)}")
        return found

    def text(self, one: _Element, key: str) -> str:
        """An attribute, with the values of its `$names`."""
        if key not in one.given:
            raise self.wrong(one, f"<{shown(one.tag, quoted=False)}> has no {key!r}")
        return self.filled(one, one.given[key])

    def filled(self, one: _Element, text: str) -> str:
        """A text with the values of its `$names`."""

        def value(name: str) -> str:
            if name not in self.values:
                raise self.wrong(one, f"${shown(name, quoted=False)} has no value: no <default> has that name")
            return self.values[name]

        if "$" not in text:
            return text
        found = ""
        for at, part in enumerate(re.split(r"\$(\w+)", text)):
            found += value(part) if at % 2 else part
            if len(found) > LONGEST:  # a <default> may name others twice, and so on
                raise self.wrong(one, f"expected at most {LONGEST:,} letters, got more; write the value out")
        return found

    def wrong(self, one: _Element, reason: str) -> FileFormatError:
        """The error about an element."""
        return FileFormatError(f"{self.path}: line {one.line}: {reason}")


def _plain(name: str) -> str:
    """A name as Mitsuba's loader takes it: without dots."""
    return name.replace(".", "_")


def _unit(vector: Doubles) -> Doubles:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-30))


def _turn(axis: tuple[float, float, float], angle: float) -> Doubles:
    """The rotation (3, 3) about an axis by an angle in radians."""
    x, y, z = _unit(np.array(axis))
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * across + (1.0 - math.cos(angle)) * (across @ across))


STOCK = frozenset(
    """
    aov area batch bitmap blackbody blendbsdf blendphase box bsplinecurve bumpmap catmullrom checkerboard circular
    conductor constant constvolume cube cylinder d65 depth dielectric diffuse direct directional directionalarea disk
    distant ellipsoids ellipsoidsmesh envmap gaussian gridvolume hair hdrfilm heterogeneous hg homogeneous independent
    instance irradiancemeter irregular isotropic lanczos ldsampler linearcurve mask mesh_attribute mitchell moment
    multijitter normalmap null obj orthogonal orthographic path perspective plastic ply point polarizer pplastic prb
    prb_basic prb_projective prbvolpath principled principledthin projector ptracer radiancemeter rawconstant rayleigh
    rectangle ref regular retarder rgb roughconductor roughdielectric roughplastic scene sdfgrid serialized sggx
    shapegroup specfilm spectrum sphere spot srgb stokes stratified sunsky tabphase tent thindielectric thinlens
    timed_sunsky twosided uniform volpath volpathmis volume
    """.split()
)
"""The plugins that come with Mitsuba 3.9, but for `measured` and `merge`."""


def trusted(path: Path, scene: Mapping[str, object], notes: list[str]) -> Plugin:
    """Return a file's dictionary with pictures read, and with the full names of meshes that were read once.

    Args:
        path: of the file.
        scene: its dictionary.
        notes: warnings about pictures are put here.

    Raises:
        FileFormatError: a plugin that Mitsuba does not bring, or a file that is missing, outside the folder of `path`,
            damaged, or of a kind that only Mitsuba reads.
    """
    references = References(path)

    def file_of(kind: str, name: object) -> Path:
        try:
            references.get(str(name))
        except FileNotFoundError:
            reason = references.refused.get(next(reversed(references.refused)), "is missing")
            raise FileFormatError(f"{path}: {kind} needs {shown(str(name))}, which {reason}") from None
        for candidate in (str(name), os.path.basename(str(name))):
            found = Path(os.path.realpath(os.path.join(path.parent, candidate)))
            if found.is_file() and found.is_relative_to(os.path.realpath(path.parent)):
                note_opened(found)
                return found
        raise FileFormatError(f"{path}: {kind} needs {shown(str(name))}; write its name as it is in the folder")

    def mesh(plugin: Plugin) -> Plugin:
        found = file_of("a shape", plugin["filename"])
        if found.suffix.lower() != f".{plugin['type']}":
            raise FileFormatError(f"{path}: expected a .{plugin['type']} file, got {shown(found.name)}; rename it")
        read_parts(found, found.read_bytes())
        return {**plugin, "filename": str(found)}

    def bitmap(plugin: Plugin) -> Plugin:
        found = file_of("a texture", plugin.pop("filename"))
        if found.suffix.lower() in RADIANCE:
            return {**plugin, "bitmap": _texture(found, notes), "raw": True}
        raw = bool(plugin.get("raw"))
        picture = read_picture(found, raw=raw)
        return {**plugin, "bitmap": picture if raw else srgb_to_linear(picture), "raw": True}

    def envmap(plugin: Plugin) -> Plugin:
        found = file_of("a light", plugin.pop("filename"))
        if found.suffix.lower() in RADIANCE:
            environment = import_environment(found)
            notes.extend(environment.warnings)
            return {**plugin, "bitmap": environment.radiance}
        return {**plugin, "bitmap": np.asarray(srgb_to_linear(read_picture(found)), np.float32)}

    readers: dict[str, Callable[[Plugin], Plugin]] = {"obj": mesh, "ply": mesh, "bitmap": bitmap, "envmap": envmap}

    def checked(plugin: Mapping[str, object]) -> Plugin:
        kind = str(plugin["type"])
        if kind not in STOCK:
            raise FileFormatError(
                f"{path}: {shown(kind)} is no plugin that comes with Mitsuba; leave it out of the file"
            )
        if not re.fullmatch(r"\w*", str(plugin.get("material", ""))):
            raise FileFormatError(f"{path}: {shown(str(plugin['material']))} is no name of a material")
        found = {key: checked(value) if isinstance(value, Mapping) else value for key, value in plugin.items()}
        if kind in readers and "filename" not in found:  # without one Mitsuba's bitmap ends the process
            raise FileFormatError(f"{path}: expected a filename in each {kind}, got none; name the file")
        if "filename" in found:
            if kind not in readers:
                named = shown(str(found["filename"]))
                raise FileFormatError(
                    f"{path}: {kind} names the file {named}, which only Mitsuba reads, without checks; convert it to "
                    "a .ply mesh or a picture, or give the scene as a dictionary from Python"
                )
            found = readers[kind](found)
        return found

    return checked(scene)


def _texture(file: Path, notes: list[str]) -> Floats:
    """The linear values (H, W, 3) of an .hdr or .exr picture, averaged down as other textures are."""
    picture = read_light(file, "texture")
    notes.extend(f"{file.name}: {note}" for note in picture.notes)
    height, width = picture.size
    scale = min(1.0, TEXTURE_LIMIT / max(height, width))
    if scale == 1.0:
        return picture.band(0, height)
    return banded_average(picture.band, picture.size, (max(1, round(height * scale)), max(1, round(width * scale))))
