"""Binary glTF files taken apart and put together again, with another header."""

import json
import struct
from collections.abc import Callable
from typing import Any


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header of a .glb file, and what comes after it."""
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[20 + length :]


def join_glb(header: dict[str, Any], rest: bytes = b"") -> bytes:
    """Return a .glb file with a header, and whatever comes after it."""
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def change_header(data: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """Return a .glb file whose header is changed in place."""
    header, rest = split_glb(data)
    change(header)
    return join_glb(header, rest)


def change_material(data: bytes, number: int = 0, **entries: Any) -> bytes:
    """Return a .glb file of which a material has other entries."""
    return change_header(data, lambda header: header["materials"][number].update(entries))
