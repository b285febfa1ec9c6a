"""The bytes and numbers of a glTF file: buffers, views of them, and accessors (glTF 2.0, sections 3.6 and 3.11)."""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.importing.files import damaged, shown
from advsearch.scene.importing.gltf_entries import Header
from advsearch.scene.importing.references import References, plain_name

Array = npt.NDArray[np.float64]

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


class Buffers:
    """Reads what the header of a file refers to.

    Args:
        path: the file.
        header: as `gltf.read_header` gives it.
        chunk: what a .glb file has after its header; None where it has nothing.
        references: finds the files that it names.
    """

    def __init__(self, path: Path, header: Header, chunk: bytes | None, references: References) -> None:
        self._path, self._header, self._chunk, self._references = path, header, chunk, references
        self._read: dict[int, bytes] = {}
        self._put_in: dict[int, npt.NDArray[Any]] = {}

    def uri(self, uri: str) -> bytes:
        """Return what a URI holds, or the file in the folder that it names.

        Raises:
            FileNotFoundError: there is no such file, or it must not be read; the references say which.
            ValueError: base64 that is none.
        """
        if not uri.startswith("data:"):
            return self._references.get(uri)
        kind, _, content = uri.partition(",")
        try:
            return (
                base64.b64decode(unquote_to_bytes(content)) if kind.endswith(";base64") else unquote_to_bytes(content)
            )
        except binascii.Error as error:
            raise ValueError(str(error)) from None

    def view(self, index: int) -> memoryview:
        """Return the bytes of a view.

        Raises:
            FileFormatError: they are not there.
        """
        view = self._header.bufferViews[index]
        data, end = self._buffer(view.buffer), view.byteOffset + view.byteLength
        if end > len(data):
            raise damaged(self._path, f"a buffer of at least {end:,} bytes", f"{len(data):,}; the file is cut short")
        return memoryview(data)[view.byteOffset : end]

    def _buffer(self, number: int) -> bytes:
        if number not in self._read:
            uri = self._header.buffers[number].uri
            try:
                if uri is None and (number > 0 or self._chunk is None):
                    raise damaged(self._path, f"a buffer {number} with content", "none")
                self._read[number] = self.uri(uri) if uri is not None else self._chunk or b""
            except FileNotFoundError:
                name = plain_name(uri or "")
                reason = self._references.refused.get(name, "is missing")
                message = f"{self._path}: needs {shown(name)}, which {reason}; put that file beside it"
                raise FileFormatError(message) from None
            except ValueError:
                raise damaged(self._path, f"a buffer {number} in base64", "other text") from None
        return self._read[number]

    def values(self, index: int) -> npt.NDArray[Any]:
        """Return the values (count, width) of an accessor as they are stored, those that are sparse put in.

        Raises:
            FileFormatError: they reach beyond their view.
        """
        if index in self._put_in:
            return self._put_in[index]
        one = self._header.accessors[index]
        values = np.zeros((one.count, one.width), _TYPES[one.componentType])
        if one.bufferView is not None and one.count:
            stride = self._header.bufferViews[one.bufferView].byteStride
            values = self._array(one.bufferView, one.byteOffset, values.shape, values.dtype, stride)
        if one.sparse is None or not one.sparse.count:
            return values
        places, given, count = one.sparse.indices, one.sparse.values, one.sparse.count
        if count > one.count:
            raise damaged(self._path, f"at most {one.count:,} sparse values", f"{count:,}")
        kind = np.dtype(_TYPES[places.componentType])
        rows = self._array(places.bufferView, places.byteOffset, (count, 1), kind)[:, 0]
        if rows.max() >= one.count:
            raise damaged(self._path, f"sparse values at places under {one.count:,}", f"{int(rows.max()):,}")
        values = np.array(values)
        values[rows] = self._array(given.bufferView, given.byteOffset, (count, one.width), values.dtype)
        self._put_in[index] = values
        return values

    def _array(
        self, view: int, offset: int, shape: tuple[int, int], kind: np.dtype[Any], stride: int | None = None
    ) -> npt.NDArray[Any]:
        data, step = self.view(view), stride or shape[1] * kind.itemsize
        end = offset + (shape[0] - 1) * step + shape[1] * kind.itemsize
        if end > len(data):
            raise damaged(self._path, f"a view of at least {end:,} bytes", f"{len(data):,}")
        found: npt.NDArray[Any] = np.ndarray(shape, kind, data, offset, (step, kind.itemsize))
        return found

    def numbers(self, index: int, rows: npt.NDArray[np.int64]) -> Array:
        """Return rows (N,) of an accessor as (N, width), normalised integers as the numbers that they stand for."""
        values = self.values(index)[rows]
        numbers: Array = values.astype(np.float64)
        if not self._header.accessors[index].normalized or values.dtype.kind == "f":
            return numbers
        return np.asarray(numbers / np.iinfo(values.dtype).max).clip(-1.0)
