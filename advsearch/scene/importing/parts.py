"""Mesh files as a list of parts: one piece of geometry with one surface each, in the file's own coordinates.

The formats have readers of our own: those that there are drop without a word what they do not know.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from advsearch.pictures import without_pillows_limit
from advsearch.scene.importing.gltf_parts import read_gltf
from advsearch.scene.importing.imported_part import ImportedPart
from advsearch.scene.importing.ply import read_ply
from advsearch.scene.importing.stl import read_stl
from advsearch.scene.importing.wavefront import read_obj

GLTF = (".glb", ".gltf", ".blend")
"""Endings of glTF files, which have conventions of their own: y up, linear colours; and of what is read as glTF."""

Reader = Callable[[Path, bytes], tuple[list[ImportedPart], list[str]]]

READERS: dict[str, Reader] = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl, **dict.fromkeys(GLTF, read_gltf)}
"""Readers by the endings of files."""


def read_parts(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Parse a mesh file.

    Args:
        path: the file; its ending names the format, and files that it refers to are looked up beside it.
        data: its content.

    Returns:
        The parts that have faces (at least one), always in the same order, and the warnings.

    Raises:
        FileFormatError: the file is damaged, not a mesh, refers to missing geometry, or has no faces.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"), without_pillows_limit():
        warnings.simplefilter("ignore")
        return READERS[path.suffix.lower()](path, data)
