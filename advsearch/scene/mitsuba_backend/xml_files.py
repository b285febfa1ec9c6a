"""Mitsuba's XML scene files as the dictionaries that its loader takes, by Mitsuba's own
parser.

A file may come from anywhere. It names plugins, which are libraries, and files, and may
include others. So Mitsuba gets one text without document types, `$names` and includes,
of a bounded size and depth, and makes nothing of it; then only plugins that Mitsuba
brings are taken, and only ordinary files of the scene's own folder: Mitsuba finds a
plugin as a library, the current folder included, and reads most files without the
checks that a file from anywhere needs.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from advsearch.errors import FileFormatError
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import damaged, looks_like, read_bytes, shown
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.importing.pictures import (
    TEXTURE_LIMIT,
    banded_average,
    read_picture,
)
from advsearch.scene.library import SUFFIXES as RADIANCE
from advsearch.scene.library import import_environment, read_light
from advsearch.scene.mitsuba_backend.meshes import with_inner
from advsearch.scene.mitsuba_backend.variant import VARIANT, Plugin, fewer_warnings, mi
from advsearch.trust.named_files import References, is_inside
from advsearch.trust.stored_files import note_opened, scaled, too_large

SUFFIX = ".xml"
LARGEST = 1 << 24  # bytes of a file, and of all that it includes
MOST_ELEMENTS = 50_000
DEEPEST = 40
MOST_INCLUDED = 50
LONGEST = 10_000  # letters of a text with the values of its `$names`
# elements that are not called as the type is
TAGS = {"ReconstructionFilter": "rfilter", "PhaseFunction": "phase"}
_PLACE = re.compile(
    r"^\[.*?\] Error while loading string \(line (\d+), col \d+\): ", re.DOTALL
)


def read_scene(path: Path) -> Plugin:
    """Return the dictionary of a scene file: plugins with their `type`, numbers, texts,
    transforms (4, 4).

    Raises:
        FileFormatError: it is missing, damaged, too large, or no Mitsuba scene.
    """
    text = _Text(path, References(path))
    root = text.parsed(read_bytes(path, "scene", (SUFFIX,)))
    if root.tag != "scene":
        raise damaged(
            path,
            "a Mitsuba scene, which begins with <scene version=...>",
            f"<{shown(root.tag)}>",
        )
    text.fill(root)
    root.set("version", "3.0.0")
    config = mi.parser.ParserConfig(VARIANT)
    config.unused_parameters = mi.LogLevel.Debug
    try:
        with fewer_warnings():
            state = mi.parser.parse_string(
                config, ElementTree.tostring(root, encoding="unicode")
            )
    except RuntimeError as error:
        place = _PLACE.match(str(error))
        # lines are the file's as long as nothing is included
        where = (
            f"line {int(place[1]) + text.above}: "
            if place and not text.included
            else ""
        )
        raise FileFormatError(
            f"{path}: {where}{_PLACE.sub('', str(error))}; correct it"
        ) from error
    referred: set[str] = set()
    scene = _plugin(path, state, 0, referred)
    # plugins with ids that stand within others, to which the rest of the file may refer
    for name in sorted(referred):
        if _plain(name) not in scene and name in state.id_to_index:
            scene[_plain(name)] = _plugin(path, state, state.id_to_index[name], set())
    return scene


@dataclass
class _Text:
    path: Path
    references: References
    values: dict[str, str] = field(default_factory=dict)
    size: int = 0
    elements: int = 0
    included: int = 0
    above: int = 0  # lines before the scene's first one

    def parsed(self, data: bytes) -> ElementTree.Element:
        """Return the tree of a file, comments and blanks included, so that lines stay
        the same.
        """
        self.size += len(data)
        if self.size > scaled(LARGEST):
            raise too_large(
                self.path,
                f"a scene of at most {scaled(LARGEST):,} bytes",
                f"{self.size:,}",
            )
        parser = expat.ParserCreate()
        tree = ElementTree.TreeBuilder(insert_comments=True)
        depth = 0

        def refuse(*_: object) -> None:
            raise FileFormatError(
                f"{self.path}: declares a document type or entities, "
                "which no scene needs; remove it"
            )

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            if not self.elements:
                self.above = parser.CurrentLineNumber - 1
            depth = depth + 1
            self.elements = self.elements + 1
            if self.elements > scaled(MOST_ELEMENTS) or depth > DEEPEST:
                most = f"at most {scaled(MOST_ELEMENTS):,} elements, {DEEPEST} deep"
                raise FileFormatError(
                    f"{self.path}: expected {most}, got more; split the scene up"
                )
            if tag in ("alias", "path"):
                where = f"{self.path}: line {parser.CurrentLineNumber}"
                raise FileFormatError(
                    f"{where}: <{tag}> is not read; write the scene without it"
                )
            tree.start(tag, attributes)

        def end(tag: str) -> None:
            nonlocal depth
            depth -= 1
            tree.end(tag)

        parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
        parser.StartElementHandler = start
        parser.EndElementHandler = end
        parser.CharacterDataHandler = lambda text: tree.data(text) if depth else None
        parser.CommentHandler = lambda text: tree.comment(text) if depth else None
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            found = f"{expat.errors.messages[error.code]} in line {error.lineno}"
            got = found if data.lstrip().startswith(b"<") else looks_like(data)
            raise damaged(self.path, "an XML file", got) from error
        except (
            LookupError,
            ValueError,
        ) as error:  # an encoding that Python does not have
            raise damaged(
                self.path,
                "an XML file",
                f"one in an unknown encoding ({shown(str(error))})",
            ) from error
        root = tree.close()
        version = root.get("version", "3.0.0")
        if root.tag == "scene" and not re.match(r"[23]\.", version):
            raise FileFormatError(
                f"{self.path}: expected a scene of Mitsuba 2 or 3, got version "
                f"{shown(version)}; convert it"
            )
        return root

    def fill(self, element: ElementTree.Element) -> None:
        """Put the values of `$names`, and what other files hold, into an element."""
        inner: list[ElementTree.Element] = []
        for child in element:
            for key, text in child.items():
                child.set(key, self.filled(text))
            if child.tag == "default":
                self.values.setdefault(child.get("name", ""), child.get("value", ""))
            if child.tag != "include":
                self.fill(child)
                inner.append(child)
                continue
            self.included, name = self.included + 1, child.get("filename", "")
            if self.included > MOST_INCLUDED:
                raise FileFormatError(
                    f"{self.path}: includes more than {MOST_INCLUDED} files; does one "
                    "include itself?"
                )
            try:
                included = self.parsed(self.references.get(name))
            except FileNotFoundError:
                reason = next(reversed(self.references.refused.values()))
                raise FileFormatError(
                    f"{self.path}: includes {shown(name)}, which {reason}"
                ) from None
            if included.tag != "scene":
                alone = included
                included = ElementTree.Element("scene")
                included.append(alone)
            self.fill(included)
            inner += list(included)
        element[:] = inner

    def filled(self, text: str) -> str:
        whole = ""
        for at, part in enumerate(re.split(r"\$(\w+)", text)):
            if at % 2 and part not in self.values:
                named = shown(part, quoted=False)
                raise FileFormatError(
                    f"{self.path}: ${named} has no value: no <default> has that name"
                )
            whole += self.values[part] if at % 2 else part
            # a <default> may name others twice, and so on
            if at and len(whole) > LONGEST:
                most = f"expected at most {LONGEST:,} letters, got more"
                raise FileFormatError(
                    f"{self.path}: {shown(text)}: {most}; write the value out"
                )
        return whole


def _plugin(path: Path, state: Any, number: int, referred: set[str]) -> Plugin:
    """Return a parsed plugin with all in it, as `mitsuba.load_dict` takes it; ids that
    it names go into `referred`.
    """
    kinds = mi.Properties.Type
    props = state.nodes[number].props
    entries: Plugin = {"type": props.plugin_name()}
    last: dict[str, int] = {}

    def put(wanted: str, made: object) -> None:
        name = wanted
        count = last.get(wanted, 1)
        while name in entries:
            count += 1
            name = f"{wanted}-{count}"
        last[wanted], entries[name] = count, made

    for key in props.keys():
        kind = props.type(key)
        value = props[key]
        named = "" if key.startswith("_arg_") else key
        if kind == kinds.ResolvedReference:
            node = state.nodes[value.index()]
            name = node.props.id() or named if number == 0 else named or node.props.id()
            tag = TAGS.get(node.type.name, node.type.name.lower())
            name = name or (node.props.plugin_name() if number == 0 else tag)
            put(_plain(name), _plugin(path, state, value.index(), referred))
        elif kind == kinds.Reference:
            referred.add(str(value.id()))
            put(named or "ref", {"type": "ref", "id": _plain(str(value.id()))})
        else:
            put(key, _value(f"{path}: {shown(key, quoted=False)}", kind, value))
    return entries


def _value(where: str, kind: Any, value: Any) -> object:
    """Return a number, a text, a colour, a transform, of finite numbers of float32's
    range.
    """
    kinds = mi.Properties.Type
    made: object = value
    numbers: Any = value if kind in (kinds.Float, kinds.Integer) else ()
    if kind == kinds.Color:
        numbers = list(value)
        made = {"type": "rgb", "value": numbers}
    elif kind == kinds.Vector:
        made = numbers = list(value)
    elif kind == kinds.Transform:
        made = numbers = np.array(value.matrix, np.float64)
    elif kind == kinds.Spectrum:
        pairs = list(zip(value.wavelengths, value.values, strict=False))
        numbers = pairs or value.values
        made = {"type": "spectrum", "value": pairs or value.values[0]}
    if not (np.abs(np.asarray(numbers, np.float64)) < 1e30).all():
        raise FileFormatError(
            f"{where}: expected a finite number, got "
            f"{shown(str(np.asarray(numbers)))}; correct it"
        )
    if kind == kinds.Transform and not abs(np.linalg.det(numbers[:3, :3])) > 0.0:
        raise FileFormatError(
            f"{where}: expected a transform that can be undone, got "
            "one that squashes; correct it"
        )
    if kind == kinds.Transform and not np.array_equal(numbers[3], (0.0, 0.0, 0.0, 1.0)):
        raise FileFormatError(
            f"{where}: expected an affine transform, whose last row "
            "is 0 0 0 1; correct it"
        )
    return made


def _plain(name: str) -> str:
    """A name as Mitsuba's loader takes it: without dots."""
    return name.replace(".", "_")


SHAPES = frozenset(
    "rectangle cube sphere cylinder disk obj ply serialized instance shapegroup "
    "sdfgrid bsplinecurve linearcurve "
    "ellipsoids ellipsoidsmesh merge".split()
)
LIGHTS = frozenset(
    "constant envmap point spot directional projector sunsky "
    "timed_sunsky area directionalarea".split()
)
SENSORS = frozenset(
    "perspective thinlens orthographic radiancemeter irradiancemeter "
    "distant batch".split()
)
INTEGRATORS = frozenset(
    "path prb prb_basic prb_projective prbvolpath volpath volpathmis direct aov "
    "ptracer depth moment stokes".split()
)
MEDIA = frozenset(("homogeneous", "heterogeneous"))
OTHERS = frozenset(
    """
    bitmap blackbody blendbsdf blendphase box bumpmap catmullrom checkerboard circular conductor constvolume d65
    dielectric diffuse gaussian gridvolume hair hdrfilm hg independent irregular isotropic lanczos ldsampler mask
    mesh_attribute mitchell multijitter normalmap null orthogonal plastic polarizer pplastic principled principledthin
    rawconstant rayleigh ref regular retarder rgb roughconductor roughdielectric roughplastic scene sggx specfilm
    spectrum srgb stratified tabphase tent thindielectric twosided uniform volume
    """.split()
)
STOCK = (SHAPES | LIGHTS | SENSORS | INTEGRATORS | MEDIA | OTHERS) - {"merge"}
"""The plugins that come with Mitsuba 3.9, but for `measured` and `merge`."""


def trusted(path: Path, scene: Mapping[str, object], notes: list[str]) -> Plugin:
    """Return a file's dictionary with pictures read, about which warnings are put into
    `notes`, and with the full names of meshes that were read once.

    Raises:
        FileFormatError: a plugin that Mitsuba does not bring, or a file that is
            missing, outside the folder of `path`, damaged, or of a kind that only
            Mitsuba reads.
    """
    references = References(path)

    def file_of(kind: str, name: object) -> Path:
        try:
            references.get(str(name))
        except FileNotFoundError:
            reason = references.refused.get(
                next(reversed(references.refused)), "is missing"
            )
            raise FileFormatError(
                f"{path}: {kind} needs {shown(str(name))}, which {reason}"
            ) from None
        for candidate in (str(name), os.path.basename(str(name))):
            file = Path(os.path.realpath(os.path.join(path.parent, candidate)))
            if file.is_file() and is_inside(file, path.parent):
                note_opened(file)
                return file
        raise FileFormatError(
            f"{path}: {kind} needs {shown(str(name))}; write its "
            "name as it is in the folder"
        )

    def mesh(plugin: Plugin) -> Plugin:
        file = file_of("a shape", plugin["filename"])
        if file.suffix.lower() != f".{plugin['type']}":
            raise FileFormatError(
                f"{path}: expected a .{plugin['type']} file, got "
                f"{shown(file.name)}; rename it"
            )
        read_parts(file, file.read_bytes())
        return {**plugin, "filename": str(file)}

    def bitmap(plugin: Plugin) -> Plugin:
        file = file_of("a texture", plugin.pop("filename"))
        if file.suffix.lower() not in RADIANCE:
            raw = bool(plugin.get("raw"))
            picture = read_picture(file, raw=raw)
            return {
                **plugin,
                "bitmap": picture if raw else srgb_to_linear(picture),
                "raw": True,
            }
        light = read_light(file, "texture")
        notes.extend(f"{file.name}: {note}" for note in light.notes)
        scale = min(1.0, TEXTURE_LIMIT / max(light.size))
        small = (
            max(1, round(light.size[0] * scale)),
            max(1, round(light.size[1] * scale)),
        )
        linear = (
            light.band(0, light.size[0])
            if scale == 1.0
            else banded_average(light.band, light.size, small)
        )
        return {**plugin, "bitmap": linear, "raw": True}

    def envmap(plugin: Plugin) -> Plugin:
        file = file_of("a light", plugin.pop("filename"))
        if file.suffix.lower() not in RADIANCE:
            return {
                **plugin,
                "bitmap": np.asarray(srgb_to_linear(read_picture(file)), np.float32),
            }
        environment = import_environment(file)
        notes.extend(environment.warnings)
        return {**plugin, "bitmap": environment.radiance}

    readers: dict[str, Callable[[Plugin], Plugin]] = {
        "obj": mesh,
        "ply": mesh,
        "bitmap": bitmap,
        "envmap": envmap,
    }

    def checked(plugin: Mapping[str, object]) -> Plugin:
        kind = str(plugin["type"])
        if kind not in STOCK:
            raise FileFormatError(
                f"{path}: {shown(kind)} is no plugin that comes with Mitsuba; leave it "
                "out of the file"
            )
        if not re.fullmatch(r"\w*", str(plugin.get("material", ""))):
            raise FileFormatError(
                f"{path}: {shown(str(plugin['material']))} is no name of a material"
            )
        entries = with_inner(plugin, checked)
        # without one Mitsuba's bitmap ends the process
        if kind in readers and "filename" not in entries:
            raise FileFormatError(
                f"{path}: expected a filename in each {kind}, got none; name the file"
            )
        if "filename" in entries:
            if kind not in readers:
                named = shown(str(entries["filename"]))
                raise FileFormatError(
                    f"{path}: {kind} names the file {named}, which only Mitsuba reads, "
                    "without checks; convert it to "
                    "a .ply mesh or a picture, or give the scene as a dictionary from "
                    "Python"
                )
            entries = readers[kind](entries)
        return entries

    return checked(scene)
