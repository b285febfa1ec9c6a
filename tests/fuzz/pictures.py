"""Pictures and environment maps: PNG, JPEG and other textures, Radiance and OpenEXR maps."""

import io
import math
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from fuzz.case import Case, Maker, Random
from fuzz.mutations import damaged

QUAD = b"mtllib thing.mtl\nusemtl paint\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 .2\n"
QUAD += b"vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"


@cache
def plain_png(width: int, height: int, depth: int = 8, color: int = 2, interlace: int = 0) -> bytes:
    """Return a PNG whose pixels are all zero: a thousand times smaller than its pixels."""
    bits = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[color] * depth
    rows = height * (1 + (width * bits + 7) // 8) + 16 * height * interlace  # each of 7 passes has rows of its own
    packer, packed = zlib.compressobj(9), []
    for start in range(0, rows, 1 << 24):
        packed.append(packer.compress(bytes(min(1 << 24, rows - start))))
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, interlace)
    palette = [(b"PLTE", bytes(3))] if color == 3 else []
    chunks = [(b"IHDR", header), *palette, (b"IDAT", b"".join(packed) + packer.flush()), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


@cache
def sample(kind: str, mode: str = "RGB") -> bytes:
    """Return a small honest picture in a format and mode of Pillow."""
    y, x = np.mgrid[0:24, 0:32]
    pixels = np.stack([8 * x, 10 * y, 4 * (x + y), 255 - 8 * x], axis=2).clip(0, 255).astype(np.uint8)
    picture = Image.fromarray(pixels, "RGBA").convert("RGB") if mode != "RGBA" else Image.fromarray(pixels, "RGBA")
    buffer = io.BytesIO()
    picture.convert(mode).save(buffer, kind)
    return buffer.getvalue()


SAMPLES = [one.split() for one in "PNG RGB,PNG P,PNG RGBA,PNG 1,JPEG RGB,JPEG L,BMP RGB,TIFF RGB,GIF P".split(",")]


def picture(random: Random) -> tuple[str, bytes]:
    """Return a hostile picture and what it is."""
    kind, mode = random.choice(SAMPLES)
    what, data = damaged(random, sample(kind, mode))
    bombs: tuple[tuple[str, Callable[[], bytes]], ...] = (
        ("a bomb of 20,000 x 20,000", lambda: plain_png(20_000, 20_000, 1, 0)),
        ("a bomb of 12,000 x 9,000", lambda: plain_png(12_000, 9_000)),
        ("a bomb in a palette", lambda: plain_png(30_000, 30_000, 1, 3)),
        ("a bomb of 16 bits, interlaced", lambda: plain_png(8_000, 8_000, 16, 6, 1)),
        ("a strip", lambda: plain_png(2_000_000, 3, 1, 0)),
        ("large and honest", lambda: plain_png(4_096, 4_096)),
        ("a size of 2^31", lambda: plain_png(4, 4)[:16] + b"\x7f\xff\xff\xff" * 2 + plain_png(4, 4)[24:]),
        ("an EPS", lambda: b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 90 90\n%%EndComments\nshowpage\n%%EOF\n"),
        ("a text that unpacks to 100 MB", _text_bomb),
        ("empty", lambda: b""),
    )
    if random.random() < 0.4:
        name, make = random.choice(bombs)
        return name, make()
    return f"{kind} {mode} {what}", data


def _text_bomb() -> bytes:
    text = b"zTXt" + b"note\0\0" + zlib.compress(bytes(100_000_000))
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    return sample("PNG")[:33] + chunk + sample("PNG")[33:]


def texture(random: Random) -> Case:
    """A hostile picture as the texture of an OBJ."""
    what, data = picture(random)
    files = {"thing.obj": QUAD, "thing.mtl": b"newmtl paint\nKd .2 .4 .6\nmap_Kd wood.png\n", "wood.png": data}
    return Case(f"texture: {what}", "object", "thing.obj", files)


def stuck_picture(random: Random) -> Case:
    """A hostile picture for the `patch` control."""
    what, data = picture(random)
    return Case(f"picture: {what}", "picture", "print.png", {"print.png": data})


def radiance(height: int = 8, width: int = 16, *, packed: bool = True) -> bytes:
    """Return a small honest Radiance map."""
    pixels = (np.arange(height * width * 4) % 120 + 40).astype(np.uint8).reshape(height, width, 4)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + f"-Y {height} +X {width}\n".encode()
    if not packed:
        return head + pixels.tobytes()
    rows = []
    for row in pixels:
        rows.append(bytes([2, 2, width >> 8, width & 255]))
        rows.extend(bytes([width]) + row[:, channel].tobytes() for channel in range(4))
    return head + b"".join(rows)


def _hdr_bomb(random: Random) -> tuple[str, bytes]:
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
    height, width = random.choice(((16_000, 16_000), (999_999, 268), (30_000, 8_000), (8_192, 8_192), (3, 89_000_000)))
    kind = random.choice(("run lengths", "old repeats", "nothing", "one long run"))
    if kind == "run lengths" and width < 32_768:
        line = bytes([2, 2, width >> 8, width & 255]) + (bytes([255, 66]) * math.ceil(width / 127)) * 4
        body = line * min(height, 40_000_000 // len(line))
    elif kind == "one long run":
        body = bytes([2, 2, 4, 0]) + b"\xff\x00" * 2_000_000
        width, height = 1024, 512
    elif kind == "old repeats":
        body = b"\x40\x50\x60\x80" + (b"\x01\x01\x01\xff" * 4 + b"\x40\x50\x60\x80") * 50_000
    else:
        body = b""
    return f"{height} x {width}, {kind}", head + f"-Y {height} +X {width}\n".encode() + body


def hdr(random: Random) -> Case:
    """A damaged or hostile Radiance map."""
    if random.random() < 0.3:
        what, data = _hdr_bomb(random)
    else:
        what, data = damaged(random, radiance(packed=random.random() < 0.5))
    return Case(f"hdr: {what}", "environment", "room.hdr", {"room.hdr": data})


@cache
def exr(
    compression: str = "ZIP", *, tiled: bool = False, kind: str = "half", names: str = "RGB", side: int = 8
) -> bytes:
    """Return a small honest OpenEXR map."""
    values = np.linspace(0.1, 2.0, side * side * 2, dtype=np.float16 if kind == "half" else np.float32)
    channels = {name: values.reshape(side, side * 2) for name in names}
    header = {
        "compression": getattr(OpenEXR, f"{compression}_COMPRESSION"),
        "type": OpenEXR.tiledimage if tiled else OpenEXR.scanlineimage,
    }
    if tiled:
        header["tiles"] = OpenEXR.TileDescription()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.exr"
        OpenEXR.File(header, channels).write(str(path))
        return path.read_bytes()


def _window(data: bytes, name: bytes, box: tuple[int, int, int, int]) -> bytes:
    """Write another data or display window into an OpenEXR header."""
    at = data.index(name + b"\0box2i\0") + len(name) + 7 + 4
    return data[:at] + struct.pack("<4i", *box) + data[at + 16 :]


def environment(random: Random) -> Case:
    """A damaged or hostile OpenEXR map."""
    compression = random.choice(("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA"))
    data = exr(compression, tiled=random.random() < 0.3, kind=random.choice(("half", "float")))
    draw = random.random()
    if draw < 0.3:
        box = random.choice(
            (
                (0, 0, 19_999, 9_999),
                (0, 0, 2**31 - 1, 2**31 - 1),
                (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1),
                (0, 0, 1_000_000, 10),
                (0, 0, 10, 1_000_000),
                (5, 5, 0, 0),
                (1_000, 1_000, 1_015, 1_007),
            )
        )
        name = random.choice((b"dataWindow", b"dataWindow", b"displayWindow"))
        what, data = f"{name.decode()} {box}", _window(data, name, box)
    elif draw < 0.45:  # the bits that say tiled, deep, long names, multipart
        data = data[:5] + bytes([random.choice((0x02, 0x04, 0x08, 0x10, 0x1E, 0x0A))]) + data[6:]
        what = "other flags"
    elif draw < 0.55:
        what = "other channels"
        data = exr(compression, names=random.choice(("XYZ", "Y", "A", "RG", "RGBAZ")))
    else:
        what, data = damaged(random, data)
    return Case(f"exr: {compression} {what}", "environment", "room.exr", {"room.exr": data})


MAKERS: tuple[Maker, ...] = (texture, hdr, environment, stuck_picture, texture, environment)
