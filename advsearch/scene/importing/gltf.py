"""The header of a glTF file: read strictly and held to limits."""

from __future__ import annotations

import json
import struct
from pathlib import Path

from pydantic import ValidationError

from advsearch import files
from advsearch.files import JsonObject, JsonValue
from advsearch.scene.importing.files import damaged, looks_like, shown, text_of
from advsearch.scene.importing.gltf_checks import check_header
from advsearch.scene.importing.gltf_entries import Asset, Header

MOST_VALUES = 1_000_000
"""Lists, objects and values in a header; each takes hundreds of bytes of memory, and may take two of the file."""


def read_header(path: Path, data: bytes) -> Header:
    """Return the header of a .gltf or .glb file.

    Raises:
        FileFormatError: the file is not glTF, is shorter than it says, has other types in its header than glTF has,
            refers to what is not there, is over a limit, or needs what is not supported.
    """
    text = text_of(_json_chunk(path, data) if path.suffix.lower() != ".gltf" else data)
    if text.count(",") + text.count("[") + text.count("{") > files.scaled(MOST_VALUES):
        raise files.too_large(path, f"a glTF header of at most {files.scaled(MOST_VALUES):,} values", "more")
    try:
        content = files.parse_json(text)
    except ValueError as error:
        kind, reason = looks_like(data), str(error)
        if "another kind" in kind:
            kind = reason if reason.startswith(("a whole", "lists or")) else "something else"
        raise damaged(path, "glTF with a JSON header", kind) from None
    if not isinstance(content, dict) or "asset" not in content:
        raise damaged(path, "glTF with an 'asset' entry", "other JSON")
    try:
        version = Asset.model_validate(content["asset"]).version
        if version.split(".")[0] != "2":
            raise damaged(path, "glTF of version 2", f"version {shown(version)}")
        header = Header.model_validate(content)
    except ValidationError as error:
        raise damaged(path, *_first(error)) from None
    header = header.model_copy(update={"extensionsUsed": sorted({*header.extensionsUsed, *_extensions(content)})})
    check_header(path, header)
    return header


def _extensions(content: JsonObject) -> set[str]:
    """Return the names of the extensions that entries have, in the file's list of them or not."""
    found: set[str] = set()
    level: list[JsonValue] = [content]
    while level:
        entry = level.pop()
        if isinstance(entry, list):
            level.extend(entry)
        elif isinstance(entry, dict):
            held = entry.get("extensions")
            found.update(held if isinstance(held, dict) else ())
            level.extend(value for key, value in entry.items() if key != "extras")
    return found


def binary_chunk(data: bytes) -> bytes | None:
    """Return what follows the header of a .glb file, as `read_header` has accepted it; None where nothing does."""
    start, end = 20 + struct.unpack_from("<I", data, 12)[0], struct.unpack_from("<I", data, 8)[0]
    if start + 8 > end:
        return None
    size, kind = struct.unpack_from("<I4s", data, start)
    return data[start + 8 : min(start + 8 + size, end)] if kind == b"BIN\0" else None


def _json_chunk(path: Path, data: bytes) -> bytes:
    """Return the first chunk of a .glb file."""
    if not data.startswith(b"glTF") or len(data) < 20:
        got = "the first few bytes of one" if data.startswith(b"glTF") else looks_like(data)
        raise damaged(path, "a binary glTF file", got)
    version, length, chunk, kind = struct.unpack_from("<4xIII4s", data)
    if version != 2:
        raise damaged(path, "binary glTF of version 2", f"version {version}")
    if length > len(data):
        raise damaged(path, f"{length} bytes, as its header says", f"{len(data)}; the file is cut short")
    if kind != b"JSON" or 20 + chunk > length:
        raise damaged(path, "a chunk of JSON first", f"{chunk} bytes of {shown(kind.decode('latin-1'))}")
    return data[20 : 20 + chunk]


def _first(error: ValidationError) -> tuple[str, str]:
    """Return what the first entry of the wrong type should be, and what it is."""
    first = error.errors(include_url=False)[0]
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    needed = first["msg"].removeprefix("Input should be ").removeprefix("Field ")
    got = "nothing" if first["type"] == "missing" else shown(json.dumps(first["input"], default=str))
    return f"glTF whose {place} is {needed}" if got != "nothing" else f"glTF with {place}", got
