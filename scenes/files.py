"""Writing meshes, textures and environments so that the same content gives the same
bytes on every machine.

PNG and PLY are written here, byte by byte: general compressors differ between their
versions. PNG blocks are therefore stored, not compressed (git and wheels compress
them). EXR goes through OpenEXR with PIZ, whose coding the format fixes.
"""

from __future__ import annotations

import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import Mesh

Floats = npt.NDArray[np.float32]
STORED = 65535  # largest stored block of deflate


def ply(mesh: Mesh) -> bytes:
    """Return a binary little-endian PLY: float32 x y z nx ny nz s t, faces of three
    uint32 indices.
    """
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n"
        + "".join(
            f"property float {name}\n"
            for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t")
        )
        + f"element face {len(mesh.faces)}\nproperty list uchar uint "
        "vertex_indices\nend_header\n"
    )
    table = np.concatenate([mesh.vertices, mesh.normals, mesh.uvs], axis=1).astype(
        "<f4"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<u4", (3,))])
    faces["count"], faces["index"] = 3, mesh.faces
    return header.encode("ascii") + table.tobytes() + faces.tobytes()


def png(display: Floats) -> bytes:
    """Return an 8-bit RGB PNG (stored, not compressed) of an (H, W, 3) image in [0, 1],
    row 0 at the top.
    """
    levels = np.clip(np.round(display.astype(np.float64) * 255.0), 0, 255).astype(
        np.uint8
    )
    height, width = levels.shape[:2]
    rows = np.concatenate(
        [np.zeros((height, 1), dtype=np.uint8), levels.reshape(height, -1)], axis=1
    ).tobytes()
    blocks = [rows[at : at + STORED] for at in range(0, len(rows), STORED)]
    body = b"".join(
        struct.pack("<BHH", i == len(blocks) - 1, len(block), len(block) ^ 0xFFFF)
        + block
        for i, block in enumerate(blocks)
    )
    data = b"\x78\x01" + body + struct.pack(">I", zlib.adler32(rows))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", head)
        + _chunk(b"sRGB", b"\x00")
        + _chunk(b"IDAT", data)
        + _chunk(b"IEND", b"")
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return (
        struct.pack(">I", len(data))
        + kind
        + data
        + struct.pack(">I", zlib.crc32(kind + data))
    )


def exr(radiance: Floats) -> bytes:
    """Return a half-precision RGB EXR (PIZ) of an (H, W, 3) map."""
    import OpenEXR

    channels = {
        name: np.ascontiguousarray(radiance[..., i].astype(np.float16))
        for i, name in enumerate("RGB")
    }
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.exr"
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))
        return path.read_bytes()
