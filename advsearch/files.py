"""Suffixes and names of files, and types for the contents of JSON files."""

from __future__ import annotations

import os
from collections.abc import Sequence

from advsearch.catalog import list_built_ins

# A value that JSON can hold.
JsonValue = bool | int | float | str | list["JsonValue"] | dict[str, "JsonValue"] | None
# A JSON object: before it is validated, or after it was converted for writing.
JsonObject = dict[str, JsonValue]
MESHES = tuple(
    f".{name}" for name in (*list_built_ins("reader"), *list_built_ins("converter"))
)
"""Suffixes of the files from which an object can be read, without those of readers in
other packages.
"""


def join_alternatives(names: Sequence[str], conjunction: str = "or") -> str:
    """Return names as a sentence lists them: ".a, .b or .c"."""
    *first, last = names
    return f"{', '.join(first)} {conjunction} {last}" if first else last


PATH_ENDINGS = (".csv", ".txt", ".tum", ".kitti")
"""Suffixes of files with a motion path, in lower case."""


def split_paths(name: str) -> list[str]:
    """Split the name of a pair of motion paths into those of the camera and the object.

    Pairs are ``camera.csv+object.csv``, ``approach+object.csv`` and
    ``camera.csv+orbit``. Any other name is returned as a single part.
    """
    first, _, second = name.partition("+")
    if not second or os.path.isfile(name):  # the name of a file may have a + in it
        return [name]
    is_camera_file, is_object_file = (
        part.lower().endswith(PATH_ENDINGS) for part in (first, second)
    )
    # The first part may be the name of a built-in path of the camera, such as
    # "approach"; then the second part has to be a file.
    may_be_camera_name = "/" not in first
    is_pair = is_camera_file or (is_object_file and may_be_camera_name)
    return [first, second] if is_pair else [name]
