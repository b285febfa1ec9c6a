"""The header of a glTF file: read strictly, held to limits, and written again with only what is understood here.

trimesh gets the header that is written here and never the file's own, so that nothing which has not been looked at
reaches it: neither other types than those of glTF 2.0 nor extensions that decode pictures at full size.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

from pydantic import ValidationError

from advsearch import files
from advsearch.files import JsonObject, JsonValue
from advsearch.scene.importing.files import damaged, looks_like, shown, text_of
from advsearch.scene.importing.gltf_checks import check_header
from advsearch.scene.importing.gltf_entries import Asset, Header, MaterialEntry, Primitive, TextureUse
from advsearch.scene.importing.references import GLOW, NORMAL_MAPS

MOST_VALUES = 1_000_000
"""Lists, objects and values in a header; each takes hundreds of bytes of memory, and may take two of the file."""

MAP = "TEXCOORD_0"
"""The texture coordinates that are read of the header that is written."""

MATERIAL = "material "
"""Before the number of a material in its name, in the header that is written."""

NODE = "node "
"""Before the number of a node in its name, in the header that is written."""


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


def rewritten(path: Path, data: bytes, header: Header) -> bytes:
    """Return the file with a header of only what was read of it."""
    plain = header.model_copy(
        update={
            "meshes": [
                mesh.model_copy(update={"primitives": [_one_map(header, one) for one in mesh.primitives]})
                for mesh in header.meshes
            ],
            "materials": [
                material.plain().model_copy(update={"name": f"{MATERIAL}{index}"})
                for index, material in enumerate(header.materials)
            ],
            "textures": [texture.plain() for texture in header.textures],
            "nodes": [
                node.model_copy(update={"name": f"{NODE}{index}", "camera": None, "extensions": None})
                for index, node in enumerate(header.nodes)
            ],
            "cameras": [],
            "samplers": [],
            "extensions": None,
            "extensionsRequired": [],
            "extensionsUsed": [],
        }
    )
    text = json.dumps(plain.model_dump(exclude_none=True, exclude_defaults=True)).encode()
    if path.suffix.lower() == ".gltf":
        return text
    text += b" " * (-len(text) % 4)
    rest = data[20 + struct.unpack_from("<I", data, 12)[0] : struct.unpack_from("<I", data, 8)[0]]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def _one_map(header: Header, primitive: Primitive) -> Primitive:
    """Return a primitive whose one set of texture coordinates is that by which its textures are looked up."""
    used = MAP if primitive.material is None else header.materials[primitive.material].coordinates
    if used == MAP:
        return primitive
    attributes = {name: index for name, index in primitive.attributes.items() if name != MAP}
    if used in attributes:
        attributes[MAP] = attributes[used]
    return primitive.model_copy(update={"attributes": attributes})


def entry_of(header: Header, name: str | None) -> MaterialEntry | None:
    """Return the material of a name in the header that is written; None where there is none."""
    number = (name or "").removeprefix(MATERIAL)
    return header.materials[int(number)] if number.isdecimal() and int(number) < len(header.materials) else None


def image_name(header: Header, used: TextureUse | None) -> str | None:
    """Return a name for the image of a texture, or None where there is no texture."""
    if used is None:
        return None
    source = header.textures[used.index].plain().source
    uri = None if source is None else header.images[source].uri
    return "(embedded)" if uri is None or uri.startswith("data:") else uri


def unread(header: Header) -> dict[str, int]:
    """Return what materials have that is not read, each with how many of them."""
    return {
        NORMAL_MAPS: sum(one.normalTexture is not None and not one.plain().normalTexture for one in header.materials),
        GLOW: sum(any(one.emission) and not _lit_alike(one) for one in header.materials),
    }


def _lit_alike(material: MaterialEntry) -> bool:
    """Whether the texture of its emission, if it has one, is looked up as its other textures are."""
    return material.emissiveTexture is None or material.plain().emissiveTexture is not None


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
