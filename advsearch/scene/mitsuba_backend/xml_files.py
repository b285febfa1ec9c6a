"""Read Mitsuba's XML scene files as the dictionaries that its loader takes.

Mitsuba's own parser does the work. But a file may come from anywhere: it names plugins,
which are libraries, and files, and may include others. So the parser gets one text
without document types, `$names` and includes, of a bounded size and depth, and loads
nothing. Then only plugins that come with Mitsuba are accepted, and only ordinary files
of the scene's own folder: Mitsuba finds a plugin as a library, the current folder
included, and reads most files without the checks that an untrusted file needs.
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
from advsearch.scene.assets import Float32Array, Float64Array
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import (
    damaged,
    describe_content,
    format_name,
    read_bytes,
)
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.importing.pictures import (
    TEXTURE_LIMIT,
    average_in_bands,
    read_image,
)
from advsearch.scene.library import ENVIRONMENT_SUFFIXES as RADIANCE
from advsearch.scene.library import import_environment, read_light
from advsearch.scene.mitsuba_backend.meshes import map_inner_plugins
from advsearch.scene.mitsuba_backend.variant import (
    VARIANT,
    Plugin,
    mi,
    suppress_warnings,
)
from advsearch.trust.named_files import ReferencedFiles, is_inside
from advsearch.trust.stored_files import make_size_error, record_opened, scale_limit

SUFFIX = ".xml"
MAX_BYTES = 1 << 24  # bytes of a file, and of all that it includes
MAX_ELEMENTS = 50_000
MAX_NESTING = 40
MAX_INCLUDES = 50
MAX_TEXT_LENGTH = 10_000  # letters of a text with the values of its `$names`
# elements that are not named like their type
TYPE_TAGS = {"ReconstructionFilter": "rfilter", "PhaseFunction": "phase"}
_ERROR_LINE = re.compile(
    r"^\[.*?\] Error while loading string \(line (\d+), col \d+\): ", re.DOTALL
)


def read_scene(path: Path) -> Plugin:
    """Return the dictionary of a scene file.

    It has plugins with their `type`, numbers, strings and transforms (4, 4).

    Raises:
        FileFormatError: it is missing, corrupt, too large, or no Mitsuba scene.
    """
    text = _SceneText(path, ReferencedFiles(path))
    root = _parse_root(path, text)
    text.fill_element(root)
    root.set("version", "3.0.0")
    state = _parse_with_mitsuba(path, text, root)
    referred_ids: set[str] = set()
    scene = _convert_plugin(path, state, 0, referred_ids)  # 0 is the scene itself
    _copy_referred_plugins(path, state, scene, referred_ids)
    return scene


def _copy_referred_plugins(
    path: Path, state: Any, scene: Plugin, referred_ids: set[str]
) -> None:
    """Copy inner plugins that are referred to to the top of a scene's dictionary.

    Mitsuba's loader resolves a reference only to a plugin there.

    Args:
        path: path of the file, for errors.
        state: what Mitsuba's parser returns.
        scene: the dictionary, which is changed.
        referred_ids: ids of the plugins.
    """
    for plugin_id in sorted(referred_ids):
        name = _make_plain_name(plugin_id)
        if name not in scene and plugin_id in state.id_to_index:
            index = state.id_to_index[plugin_id]
            # What this plugin refers to in turn is not copied: its ids are discarded.
            scene[name] = _convert_plugin(path, state, index, referred_ids=set())


def _parse_root(path: Path, text: _SceneText) -> ElementTree.Element:
    """Return the root of a scene file's tree, in which nothing is filled in yet."""
    root = text.parse(read_bytes(path, "scene", (SUFFIX,)))
    if root.tag != "scene":
        raise damaged(
            path,
            "a Mitsuba scene, which begins with <scene version=...>",
            f"<{format_name(root.tag)}>",
        )
    return root


def _parse_with_mitsuba(path: Path, text: _SceneText, root: ElementTree.Element) -> Any:
    """Parse a scene with Mitsuba's parser, and return the parser's state.

    Args:
        path: path of the file, for errors.
        text: text of the scene, which knows what it includes.
        root: root of its tree, in which nothing is to be filled in any more.

    Raises:
        FileFormatError: Mitsuba rejects it; the message has the line if it is known.
    """
    config = mi.parser.ParserConfig(VARIANT)
    config.unused_parameters = mi.LogLevel.Debug
    try:
        with suppress_warnings():
            return mi.parser.parse_string(
                config, ElementTree.tostring(root, encoding="unicode")
            )
    except RuntimeError as error:
        where = _find_error_line(text, str(error))
        raise FileFormatError(
            f"{path}: {where}{_ERROR_LINE.sub('', str(error))}; correct it"
        ) from error


def _find_error_line(text: _SceneText, message: str) -> str:
    """Return the line of an error of Mitsuba's parser, such as "line 12: ".

    It is empty if the line is not known. The lines of included files are inserted into
    the text that Mitsuba has parsed, so that a line is known only without any.
    """
    line_match = _ERROR_LINE.match(message)
    if line_match and not text.included:
        return f"line {int(line_match[1]) + text.lines_before}: "
    return ""


@dataclass
class _SceneText:
    """The text of a scene file and of the files that it includes.

    Attributes:
        path: path of the scene file.
        references: finds files in its folder.
        values: values of `$names`, by name; the first default of a name counts.
        size, elements, included: bytes, elements and included files so far.
        lines_before: lines before the scene's first one.
    """

    path: Path
    references: ReferencedFiles
    values: dict[str, str] = field(default_factory=dict)
    size: int = 0
    elements: int = 0
    included: int = 0
    lines_before: int = 0

    def parse(self, data: bytes) -> ElementTree.Element:
        """Parse the bytes of a file, and return the root of its tree.

        The size limit is for all parsed files together, the scene and its includes.

        Raises:
            FileFormatError: they are too large, no XML, or a scene of another version.
        """
        self.size += len(data)
        if self.size > scale_limit(MAX_BYTES):
            raise make_size_error(
                self.path,
                f"a scene of at most {scale_limit(MAX_BYTES):,} bytes",
                f"{self.size:,}",
            )
        root = self._parse_tree(data)
        _check_version(self.path, root)
        return root

    def _parse_tree(self, data: bytes) -> ElementTree.Element:
        """Parse bytes as XML, and return the root of the tree.

        Comments and blanks stay in the tree, so that the numbers of lines stay the
        same.
        """
        parser = expat.ParserCreate()
        tree = ElementTree.TreeBuilder(insert_comments=True)
        _TreeHandlers(self, parser, tree).attach()
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            got = _describe_parse_error(data, error)
            raise damaged(self.path, "an XML file", got) from error
        # an encoding that Python does not have
        except (LookupError, ValueError) as error:
            raise damaged(
                self.path,
                "an XML file",
                f"one in an unknown encoding ({format_name(str(error))})",
            ) from error
        return tree.close()

    def fill_element(self, element: ElementTree.Element) -> None:
        """Replace `$names` by their values and includes by the files' elements, in
        place.

        A `<default name="x" value="1"/>` gives `$x` its value in everything that comes
        after it, in included files too. If there are several, the first one counts.
        """
        children: list[ElementTree.Element] = []
        for child in element:
            for key, text in child.items():
                child.set(key, self.fill_text(text))
            if child.tag == "default":
                self.values.setdefault(child.get("name", ""), child.get("value", ""))
            if child.tag == "include":
                children += self._include(child.get("filename", ""))
            else:
                self.fill_element(child)
                children.append(child)
        element[:] = children

    def _include(self, name: str) -> list[ElementTree.Element]:
        """Return the elements of another file, in which `$names` are filled in.

        They are the children of its `<scene>`, or else its root element.

        Raises:
            FileFormatError: the file may not be read, or too many files are included.
        """
        self.included += 1
        if self.included > MAX_INCLUDES:
            raise FileFormatError(
                f"{self.path}: includes more than {MAX_INCLUDES} files; does one "
                "include itself?"
            )
        root = self._parse_included(name)
        if root.tag != "scene":
            root = _wrap_in_scene(root)
        self.fill_element(root)
        return list(root)

    def _parse_included(self, name: str) -> ElementTree.Element:
        """Return the root of the tree of a file that is included by its name."""
        try:
            return self.parse(self.references.read_file(name))
        except FileNotFoundError:
            # The file that was requested last is the last one with a refusal.
            reason = next(reversed(self.references.refusal_by_name.values()))
            raise FileFormatError(
                f"{self.path}: includes {format_name(name)}, which {reason}"
            ) from None

    def fill_text(self, text: str) -> str:
        """Replace every `$name` in a text by its value, as in "$folder/mug.ply".

        Raises:
            FileFormatError: a name has no value, or the text becomes too long.
        """
        filled = ""
        # the group in the pattern makes `split` return the names too, as every second
        # piece
        for index, piece in enumerate(re.split(r"\$(\w+)", text)):
            is_name = index % 2 == 1
            filled += self._get_named_value(piece) if is_name else piece
            # The length is limited because values may grow exponentially: a <default>
            # may name another one twice, which names others twice, and so on. A text
            # that is long without names has only a first piece, and is accepted.
            has_names = index > 0
            if has_names and len(filled) > MAX_TEXT_LENGTH:
                limit = f"expected at most {MAX_TEXT_LENGTH:,} letters, got more"
                raise FileFormatError(
                    f"{self.path}: {format_name(text)}: {limit}; write the value out"
                )
        return filled

    def _get_named_value(self, name: str) -> str:
        """Return the value of a `$name`, or raise FileFormatError if it has none."""
        if name not in self.values:
            name = format_name(name, quoted=False)
            raise FileFormatError(
                f"{self.path}: ${name} has no value: no <default> has that name"
            )
        return self.values[name]


def _wrap_in_scene(element: ElementTree.Element) -> ElementTree.Element:
    """Return a `<scene>` around an element, which so gets a parent."""
    root = ElementTree.Element("scene")
    root.append(element)
    return root


def _describe_parse_error(data: bytes, error: expat.ExpatError) -> str:
    """Return what the mistake in XML is; of other data, what they are instead."""
    if not data.lstrip().startswith(b"<"):
        return describe_content(data)
    message = expat.errors.messages[error.code]
    return f"{message} in line {error.lineno}"


def _check_version(path: Path, root: ElementTree.Element) -> None:
    """Raise FileFormatError for a scene of another version of Mitsuba."""
    version = root.get("version", "3.0.0")
    if root.tag == "scene" and not re.match(r"[23]\.", version):
        raise FileFormatError(
            f"{path}: expected a scene of Mitsuba 2 or 3, got version "
            f"{format_name(version)}; convert it"
        )


class _TreeHandlers:
    """A parser's callbacks, which build a tree and refuse some things.

    They refuse document types, entities, the elements `alias` and `path`, and elements
    that are more or nested deeper than the limits. Texts and comments outside of the
    root element are left out.

    Args:
        text: text of the scene, whose elements are counted.
        parser: the parser.
        tree: the tree.
    """

    def __init__(
        self,
        text: _SceneText,
        parser: expat.XMLParserType,
        tree: ElementTree.TreeBuilder,
    ) -> None:
        """Begin outside of the root element."""
        self._text = text
        self._parser = parser
        self._tree = tree
        self._depth = 0  # how many elements are open

    def attach(self) -> None:
        """Set the callbacks of the parser."""
        parser = self._parser
        parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = (
            self._refuse_declaration
        )
        parser.StartElementHandler = self._start_element
        parser.EndElementHandler = self._end_element
        parser.CharacterDataHandler = self._add_data
        parser.CommentHandler = self._add_comment

    def _refuse_declaration(self, *_: object) -> None:
        """Raise FileFormatError for what no scene needs."""
        raise FileFormatError(
            f"{self._text.path}: declares a document type or entities, "
            "which no scene needs; remove it"
        )

    def _start_element(self, tag: str, attributes: dict[str, str]) -> None:
        """Begin an element of the tree, after the checks."""
        text = self._text
        if not text.elements:  # the root
            text.lines_before = self._parser.CurrentLineNumber - 1
        self._depth += 1
        text.elements += 1
        self._check_element_limits()
        if tag in ("alias", "path"):
            where = f"{text.path}: line {self._parser.CurrentLineNumber}"
            raise FileFormatError(
                f"{where}: <{tag}> is not read; write the scene without it"
            )
        self._tree.start(tag, attributes)

    def _check_element_limits(self) -> None:
        """Raise FileFormatError if there are too many elements, or too deep ones."""
        max_elements = scale_limit(MAX_ELEMENTS)
        if self._text.elements > max_elements or self._depth > MAX_NESTING:
            raise FileFormatError(
                f"{self._text.path}: expected at most {max_elements:,} elements, "
                f"{MAX_NESTING} deep, got more; split the scene up"
            )

    def _end_element(self, tag: str) -> None:
        """End an element of the tree."""
        self._depth -= 1
        self._tree.end(tag)

    def _add_data(self, data: str) -> None:
        """Add a text to the tree."""
        if self._depth:
            self._tree.data(data)

    def _add_comment(self, comment: str) -> None:
        """Add a comment to the tree."""
        if self._depth:
            self._tree.comment(comment)


def _convert_plugin(
    path: Path, state: Any, index: int, referred_ids: set[str]
) -> Plugin:
    """Convert a parsed plugin, with its inner ones, for `mitsuba.load_dict`.

    Args:
        path: path of the file, for errors.
        state: what Mitsuba's parser returns.
        index: index of the plugin in it; 0 is the scene.
        referred_ids: is extended by the ids that the plugin refers to.
    """
    props = state.nodes[index].props
    entries: Plugin = {"type": props.plugin_name()}
    # Entries that have no name of their own may get the same: "bsdf", "bsdf-2". This is
    # the last number of each name, 1 for the name without a number.
    last_number: dict[str, int] = {}
    for key in props.keys():
        plain_name, entry = _convert_entry(
            path, state, props, key, referred_ids, at_top=index == 0
        )
        name = _find_free_name(entries, plain_name, last_number)
        entries[name] = entry
    return entries


def _find_free_name(
    entries: Plugin, plain_name: str, last_number: dict[str, int]
) -> str:
    """Return the name of a new entry, with a number behind it if there is one already.

    Args:
        entries: the entries so far.
        plain_name: the name without a number.
        last_number: the last number of each name, which is updated.
    """
    name = plain_name
    number = last_number.get(plain_name, 1)
    while name in entries:
        number += 1
        name = f"{plain_name}-{number}"
    last_number[plain_name] = number
    return name


def _convert_entry(
    path: Path,
    state: Any,
    props: Any,
    key: str,
    referred_ids: set[str],
    *,
    at_top: bool,
) -> tuple[str, object]:
    """Return one entry of a parsed plugin, and its name.

    It is an inner plugin, a reference to another plugin, or a plain value.

    Args:
        path: path of the file, for errors.
        state: what Mitsuba's parser returns.
        props: the plugin's properties in it.
        key: the parser's name of the entry.
        referred_ids: is extended by the ids that the entry refers to.
        at_top: whether the plugin is the scene.
    """
    types = mi.Properties.Type
    kind = props.type(key)
    value = props[key]
    # The parser calls what has no name in the file "_arg_0", "_arg_1", ...
    argument = "" if key.startswith("_arg_") else key
    if kind == types.ResolvedReference:
        node = state.nodes[value.index()]
        name = _get_node_name(node, argument, at_top=at_top)
        inner_plugin = _convert_plugin(path, state, value.index(), referred_ids)
        return _make_plain_name(name), inner_plugin
    if kind == types.Reference:
        referred_ids.add(str(value.id()))
        reference = {"type": "ref", "id": _make_plain_name(str(value.id()))}
        return argument or "ref", reference
    where = f"{path}: {format_name(key, quoted=False)}"
    return key, _convert_value(where, kind, value)


def _get_node_name(node: Any, argument: str, *, at_top: bool) -> str:
    """Return the name of an inner plugin among the entries of its parent.

    At the top of a scene that is its id, by which others refer to it; elsewhere it is
    the name of the argument. If it has neither, it is named by its plugin at the top
    ("sphere"), and by its kind elsewhere ("bsdf").
    """
    node_id = str(node.props.id())
    if at_top:
        return node_id or argument or str(node.props.plugin_name())
    tag = TYPE_TAGS.get(node.type.name, node.type.name.lower())
    return argument or node_id or tag


def _convert_value(where: str, kind: Any, value: Any) -> object:
    """Return a number, a string, a color or a transform of a plugin as Python has it.

    A color or a spectrum becomes a plugin, such as `{"type": "rgb", "value": [1, 0,
    0]}`. A vector becomes a list of numbers, and a transform an array (4, 4).

    Args:
        where: beginning of error messages.
        kind: Mitsuba's type of the value, one of `mi.Properties.Type`.
        value: the value.

    Raises:
        FileFormatError: a number is not finite or out of float32's range, or a
            transform is not affine or cannot be inverted.
    """
    types = mi.Properties.Type
    if kind == types.Transform:
        return _convert_transform(where, value)
    if kind == types.Spectrum:
        return _convert_spectrum(where, value)
    if kind in (types.Color, types.Vector):
        numbers = list(value)
        _check_finite(where, numbers)
        return {"type": "rgb", "value": numbers} if kind == types.Color else numbers
    if kind in (types.Float, types.Integer):
        _check_finite(where, value)
    return value


def _convert_transform(where: str, transform: Any) -> Float64Array:
    """Return a transform as an array (4, 4); `where` begins error messages."""
    matrix = np.array(transform.matrix, np.float64)
    _check_finite(where, matrix)
    _check_affine(where, matrix)
    return matrix


def _convert_spectrum(where: str, spectrum: Any) -> dict[str, object]:
    """Return a spectrum as a plugin; `where` begins error messages.

    A spectrum without wavelengths has a single value, and no pairs.
    """
    pairs = list(zip(spectrum.wavelengths, spectrum.values, strict=False))
    _check_finite(where, pairs or spectrum.values)
    return {"type": "spectrum", "value": pairs or spectrum.values[0]}


def _check_finite(where: str, numbers: Any) -> None:
    """Raise FileFormatError for a number that is not finite or near float32's limit."""
    # float32 ends at 3.4e38; 1e30 leaves room for products. NaN fails the comparison.
    is_usable = np.abs(np.asarray(numbers, np.float64)) < 1e30
    if not is_usable.all():
        raise FileFormatError(
            f"{where}: expected a finite number, got "
            f"{format_name(str(np.asarray(numbers)))}; correct it"
        )


def _check_affine(where: str, matrix: Float64Array) -> None:
    """Raise FileFormatError for a matrix (4, 4) not affine or without an inverse."""
    if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
        raise FileFormatError(
            f"{where}: expected a transform that can be undone, got one that squashes; "
            "correct it"
        )
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        raise FileFormatError(
            f"{where}: expected an affine transform, whose last row is 0 0 0 1; "
            "correct it"
        )


def _make_plain_name(name: str) -> str:
    """Return a name as Mitsuba's loader takes it: without dots."""
    return name.replace(".", "_")


SHAPE_TYPES = frozenset(
    "rectangle cube sphere cylinder disk obj ply serialized instance shapegroup "
    "sdfgrid bsplinecurve linearcurve "
    "ellipsoids ellipsoidsmesh merge".split()
)
LIGHT_TYPES = frozenset(
    "constant envmap point spot directional projector sunsky "
    "timed_sunsky area directionalarea".split()
)
SENSOR_TYPES = frozenset(
    "perspective thinlens orthographic radiancemeter irradiancemeter "
    "distant batch".split()
)
INTEGRATOR_TYPES = frozenset(
    "path prb prb_basic prb_projective prbvolpath volpath volpathmis direct aov "
    "ptracer depth moment stokes".split()
)
MEDIUM_TYPES = frozenset(("homogeneous", "heterogeneous"))
OTHER_PLUGINS = frozenset(
    """
    bitmap blackbody blendbsdf blendphase box bumpmap catmullrom checkerboard circular
    conductor constvolume d65 dielectric diffuse gaussian gridvolume hair hdrfilm hg
    independent irregular isotropic lanczos ldsampler mask mesh_attribute mitchell
    multijitter normalmap null orthogonal plastic polarizer pplastic principled
    principledthin rawconstant rayleigh ref regular retarder rgb roughconductor
    roughdielectric roughplastic scene sggx specfilm spectrum srgb stratified tabphase
    tent thindielectric twosided uniform volume
    """.split()
)
STOCK_PLUGINS = (
    SHAPE_TYPES
    | LIGHT_TYPES
    | SENSOR_TYPES
    | INTEGRATOR_TYPES
    | MEDIUM_TYPES
    | OTHER_PLUGINS
) - {"merge"}
"""The plugins that come with Mitsuba 3.9, but for `measured` and `merge`."""


def check_and_read_files(
    path: Path, scene: Mapping[str, object], notes: list[str]
) -> Plugin:
    """Return a file's dictionary with images read and full names of checked meshes.

    Args:
        path: path of the file.
        scene: its dictionary.
        notes: is extended by warnings about images.

    Raises:
        FileFormatError: a plugin that Mitsuba does not bring, or a file that is
            missing, outside the folder of `path`, corrupt, or of a kind that only
            Mitsuba reads.
    """
    return _FileReader(path, notes).check(scene)


class _FileReader:
    """Check the plugins of a scene file, and read the files that they name.

    Args:
        path: path of the scene file.
        notes: is extended by warnings about images.
    """

    def __init__(self, path: Path, notes: list[str]) -> None:
        """Prepare to read a scene file's files; `notes` gets the readers' remarks."""
        self._path = path
        self._notes = notes
        self._references = ReferencedFiles(path)
        self._readers: dict[str, Callable[[Plugin], Plugin]] = {
            "obj": self._check_mesh,
            "ply": self._check_mesh,
            "bitmap": self._read_bitmap,
            "envmap": self._read_envmap,
        }

    def check(self, plugin: Mapping[str, object]) -> Plugin:
        """Return a plugin in which inner plugins are checked and files are read.

        Raises:
            FileFormatError: a plugin does not come with Mitsuba; a file can be read
                only by Mitsuba; or the name of a material is not a single word.
        """
        kind = str(plugin["type"])
        self._check_kind_and_material(kind, plugin)
        entries = map_inner_plugins(plugin, self.check)
        if "filename" not in entries and kind not in self._readers:
            return entries
        self._check_filename(kind, entries)
        return self._readers[kind](entries)

    def _check_kind_and_material(self, kind: str, plugin: Mapping[str, object]) -> None:
        """Raise FileFormatError for a plugin or a material that is not known."""
        if kind not in STOCK_PLUGINS:
            raise FileFormatError(
                f"{self._path}: {format_name(kind)} is no plugin that comes with "
                "Mitsuba; leave it out of the file"
            )
        # Mitsuba builds the name of a file from the name of a material.
        if not re.fullmatch(r"\w*", str(plugin.get("material", ""))):
            raise FileFormatError(
                f"{self._path}: {format_name(str(plugin['material']))} is no name of a "
                "material"
            )

    def _check_filename(self, kind: str, entries: Plugin) -> None:
        """Raise FileFormatError if a plugin lacks a file, or names one that is not
        read.
        """
        # Without a filename Mitsuba's bitmap plugin crashes the process.
        if "filename" not in entries:
            raise FileFormatError(
                f"{self._path}: expected a filename in each {kind}, got none; name the "
                "file"
            )
        if kind not in self._readers:
            filename = format_name(str(entries["filename"]))
            raise FileFormatError(
                f"{self._path}: {kind} names the file {filename}, which only Mitsuba "
                "reads, without checks; convert it to a .ply mesh or a picture, or "
                "give the scene as a dictionary from Python"
            )

    def _find_file(self, kind: str, name: object) -> Path:
        """Return the path of a file that a scene names, which is in the scene's folder.

        If there is no file of the full name in the folder, one with the last part of
        the name counts: for "textures/wood.png" also "wood.png".

        Args:
            kind: what needs the file, for errors, such as "a texture".
            name: the name as the scene has it.

        Raises:
            FileFormatError: there is no such file.
        """
        self._check_is_readable(kind, str(name))
        directory = self._path.parent
        for candidate in (str(name), os.path.basename(str(name))):
            file = Path(os.path.realpath(os.path.join(directory, candidate)))
            if file.is_file() and is_inside(file, directory):
                record_opened(file)
                return file
        raise FileFormatError(
            f"{self._path}: {kind} needs {format_name(str(name))}; write its "
            "name as it is in the folder"
        )

    def _check_is_readable(self, kind: str, name: str) -> None:
        """Raise FileFormatError if a file may not be read; `kind` is what needs it."""
        try:
            # checks that the name is allowed; its content is not needed
            self._references.read_file(name)
        except FileNotFoundError:
            # The file that was requested last is the last one with a refusal.
            refusal_by_name = self._references.refusal_by_name
            last_name = next(reversed(refusal_by_name))
            reason = refusal_by_name.get(last_name, "is missing")
            raise FileFormatError(
                f"{self._path}: {kind} needs {format_name(name)}, which {reason}"
            ) from None

    def _check_mesh(self, plugin: Plugin) -> Plugin:
        """Read a mesh once, so that a corrupt one is found, and set its full name."""
        file = self._find_file("a shape", plugin["filename"])
        if file.suffix.lower() != f".{plugin['type']}":
            raise FileFormatError(
                f"{self._path}: expected a .{plugin['type']} file, got "
                f"{format_name(file.name)}; rename it"
            )
        read_parts(file, file.read_bytes())
        return {**plugin, "filename": str(file)}

    def _read_bitmap(self, plugin: Plugin) -> Plugin:
        """Return a texture's plugin with its file read, as linear values.

        A file of display colors is decoded from sRGB, unless the plugin says that it is
        raw. A large file of linear values is averaged down to `TEXTURE_LIMIT`.
        """
        file = self._find_file("a texture", plugin.pop("filename"))
        if file.suffix.lower() not in RADIANCE:
            is_raw = bool(plugin.get("raw"))
            image = read_image(file, is_raw=is_raw)
            if not is_raw:
                image = srgb_to_linear(image)
            return {**plugin, "bitmap": image, "raw": True}
        linear = self._read_radiance_texture(file)
        return {**plugin, "bitmap": linear, "raw": True}

    def _read_radiance_texture(self, file: Path) -> Float32Array:
        """Return the linear values (H, W, 3) of a file, of at most `TEXTURE_LIMIT` a
        side.
        """
        light = read_light(file, "texture")
        self._notes.extend(f"{file.name}: {note}" for note in light.notes)
        height, width = light.size
        scale = min(1.0, TEXTURE_LIMIT / max(light.size))
        if scale == 1.0:
            return light.read_rows(0, height)
        reduced_size = (max(1, round(height * scale)), max(1, round(width * scale)))
        return average_in_bands(light.read_rows, light.size, reduced_size)

    def _read_envmap(self, plugin: Plugin) -> Plugin:
        """Read an environment as linear values."""
        file = self._find_file("a light", plugin.pop("filename"))
        if file.suffix.lower() not in RADIANCE:
            image = np.asarray(srgb_to_linear(read_image(file)), np.float32)
            return {**plugin, "bitmap": image}
        environment = import_environment(file)
        self._notes.extend(environment.warnings)
        return {**plugin, "bitmap": environment.radiance}
