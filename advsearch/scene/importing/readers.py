"""Readers of mesh files by suffix, and converters of other files to glTF.

External packages may add readers (docs/extending.md).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from advsearch.catalog import list_built_ins
from advsearch.registry import Registry, load_attribute
from advsearch.scene.importing.files import Notes, read_bytes
from advsearch.scene.importing.parts import ImportedPart

Reader = Callable[[Path, bytes, Notes], list[ImportedPart]]
"""Function of a file's path, content and notes that returns its parts with faces.

It raises the errors of `objects.read_parts`.
"""

READERS: Registry[Reader] = Registry(
    "advsearch.readers",
    list_built_ins("reader"),
    "a function (path, data, notes) that returns a list of ImportedPart",
    lambda name, entry: callable(entry) and name == name.lower(),
)
"""Readers by suffix, in lower case without the dot; imported on first use."""

_CONVERTERS = list_built_ins("converter")
_READ_AS_GLTF = ("glb", "gltf", "vrm", *_CONVERTERS)
GLTF_SUFFIXES = tuple(
    f".{name}" for name in _READ_AS_GLTF if name in (*READERS.built_ins, *_CONVERTERS)
)
"""Suffixes of glTF files and of files that are converted to glTF. In these, y is up and
vertex colors are linear.
"""


def list_suffixes() -> tuple[str, ...]:
    """Return the suffixes of mesh files, those of external packages last."""
    installed = [name for name in READERS if name not in READERS.built_ins]
    return tuple(f".{name}" for name in (*READERS.built_ins, *_CONVERTERS, *installed))


def get_reader(suffix: str) -> Reader:
    """Return the reader of the files of a suffix, which is one of `list_suffixes`."""
    name = suffix.removeprefix(".")
    return READERS["glb" if name in _CONVERTERS else name]


def read_mesh_bytes(path: Path, what: str, suffixes: tuple[str, ...]) -> bytes:
    """Return the content of a mesh or scene file, converted to binary glTF if needed.

    Args:
        path: the file.
        what: expected content, such as "object", for messages.
        suffixes: suffixes that it may have, in lower case with the dot.

    Raises:
        FileFormatError: the file has another suffix, cannot be read, or cannot be
            converted.
    """
    data = read_bytes(path, what, suffixes)
    converter = _CONVERTERS.get(path.suffix.lower().removeprefix("."))
    if converter is None:
        return data
    convert: Callable[[Path, bytes], bytes] = load_attribute(converter.import_path)
    return convert(path, data)
