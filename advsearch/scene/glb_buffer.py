"""The buffer of a binary glTF file, and the file around it."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

FLOAT, WHOLE, SHORT = 5126, 5125, 5123  # types of numbers in glTF: float32, uint32 and uint16
CORNERS, INDICES = 34962, 34963  # what a part of the buffer is for


def mime_type(picture: bytes) -> str:
    """Return the kind of a PNG or JPEG file, as glTF calls it."""
    return "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"


class GlbBuffer:
    """The bytes of a file and where in them what is; bytes that are there already are not added again."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._known: dict[tuple[bytes, int | None], int] = {}
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append some bytes, whole words, and return the number of the view."""
        if (data, target) in self._known:
            return self._known[data, target]
        self._known[data, target] = len(self.views)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def accessor(self, values: npt.NDArray[Any], kind: str, *, bounds: bool = False) -> int:
        """Append an array and return the number of its accessor."""
        number = {np.dtype(np.uint32): WHOLE, np.dtype(np.uint16): SHORT}.get(values.dtype, FLOAT)
        view = self.view(np.ascontiguousarray(values).tobytes(), CORNERS if number == FLOAT else INDICES)
        entry: dict[str, Any] = {"bufferView": view, "componentType": number, "count": len(values), "type": kind}
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def file(self, header: dict[str, Any]) -> bytes:
        """Return the whole file with a header that says all but what is in the buffer."""
        header |= {"accessors": self.accessors, "bufferViews": self.views, "buffers": [{"byteLength": len(self.data)}]}
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        rest = bytes(self.data)
        head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(rest), len(text), 0x4E4F534A)
        return head + text + struct.pack("<II", len(rest), 0x004E4942) + rest
