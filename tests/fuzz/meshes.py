"""Wavefront OBJ with its materials, PLY and STL."""

import struct
from functools import cache

import numpy as np
import trimesh

from fuzz.case import OUTSIDE, Case, Maker, Random
from fuzz.mutations import NUMBERS, damaged
from fuzz.pictures import sample

MTL = b"""newmtl paint # the first
Kd .2 .4 .6
Ns 20
illum 2
map_Kd -s 2 2 1 -o .1 .2 -mm 0 1 -clamp on wood.png
map_Pr -imfchan r wood.png
bump -bm .5 -t 1 1 1 wood.png
newmtl plain
Kd 1 0 0
Tr .5
Pm .3
Ke 0 .1 0
"""


@cache
def box_obj() -> bytes:
    """Return a box with normals, texture coordinates and two materials."""
    box = trimesh.creation.box()
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices]
    lines += [f"vt {x + 0.5} {y + 0.5}" for x, y, _ in box.vertices]
    lines += [f"vn {x} {y} {z}" for x, y, z in box.vertex_normals]
    faces = ["f " + " ".join(f"{k + 1}/{k + 1}/{k + 1}" for k in face) for face in box.faces]
    rest = ["s off", "usemtl plain", *faces[6:], "f 1 2 3 4 5 6 7 8", "f -1 -2 -3#", "l 1 2", "curv2 1 2", ""]
    return "\n".join(["mtllib thing.mtl", *lines, "usemtl paint", *faces[:6], *rest]).encode()


@cache
def mapped_ply(order: str) -> bytes:
    """Return an L-shaped face and a strip, with texture coordinates of corners, two textures and colours."""
    scalars = {"vertex": "float x,float y,float z,ushort red,ushort green,ushort blue,float quality".split(",")}
    header = f"ply\nformat {'binary_little_endian' if order else 'ascii'} 1.0\ncomment TextureFile wood.png\n"
    header += "comment TextureFile wood.png\nelement vertex 6\n"
    header += "".join(f"property {one}\n" for one in scalars["vertex"])
    header += "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    header += "property int texnumber\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    points = ((0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0))
    rows = [("3f3Hf", [*map(float, point), 65535, 0, 300, 0.5]) for point in points]
    for face, number in ((range(6), 1), (range(3), 0)):
        uvs = [0.1 * k for k in range(2 * len(face))]
        rows.append((f"B{len(face)}iB{len(uvs)}fi", [len(face), *face, len(uvs), *uvs, number]))
    rows.append(("6i", [5, 0, 1, 2, -1, 3]))
    if order:
        return header.encode() + b"".join(struct.pack(order + kinds, *values) for kinds, values in rows)
    return (header + "".join(" ".join(map(str, values)) + "\n" for _, values in rows)).encode()


@cache
def coloured_stl(head: bytes) -> bytes:
    """Return a box with colours of its facets."""
    data = bytearray(box_file("stl"))
    data[: len(head)] = head
    for place in range(84, len(data), 50):
        data[place + 48 : place + 50] = struct.pack("<H", 0x801C if place % 100 else 0x7000)
    return bytes(data)


@cache
def box_file(kind: str, encoding: str = "") -> bytes:
    """Return a box as trimesh writes it, with colours of its vertices where the format has them."""
    box = trimesh.creation.box()
    if kind == "ply":
        box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4) * 8
        coloured: bytes = box.export(file_type=kind, encoding=encoding)
        return coloured
    written: str | bytes = box.export(file_type=f"{kind}_ascii" if encoding == "ascii" else kind)
    return written.encode() if isinstance(written, str) else written


def obj(random: Random) -> Case:
    """A damaged OBJ or material file."""
    files = {"thing.obj": box_obj(), "thing.mtl": MTL, "wood.png": sample("PNG")}
    name = random.choice(("thing.obj", "thing.obj", "thing.mtl"))
    what, files[name] = damaged(random, files[name])
    return Case(f"obj: {name[-3:]} {what}", "object", "thing.obj", files)


def hostile_obj(random: Random) -> Case:
    """An OBJ that is large in one way."""
    vertices = b"".join(b"v %d %d %d\n" % (k % 7, k * k % 11, k) for k in range(50))
    number = random.choice(NUMBERS)
    crossing = [b" ".join(b"%d" % (k * k * s % 50 + 1) for k in range(400)) for s in range(1, 40)]
    quad = b"mtllib thing.mtl\nusemtl paint\n" + vertices + b"vt 0 0\nvt 1 0\nvt 1 "
    kinds = {
        "a face of a million corners": lambda: vertices + b"f " + b"1 2 3 4 5 " * 200_000 + b"\n",
        "a line of 5 MB": lambda: vertices + b"f 1 2 3\n# " + b"x" * 5_000_000 + b"\n",
        "5,000 materials": lambda: vertices + b"".join(b"usemtl m%d\nf 1 2 3\n" % k for k in range(5000)),
        "5,000 material files": lambda: (
            b"".join(b"mtllib m%d.mtl\n" % k for k in range(5000)) + vertices + b"f 1 2 3\n"
        ),
        "random triangles": lambda: _random_triangles(random),
        "an odd coordinate": lambda: vertices + b"v " + number + b" 0 0\nf 1 2 3\nf 1 2 51\n",
        "an odd index": lambda: vertices + b"f 1 2 3\nf 1 2 " + number + b"\n",
        "an odd texture coordinate": lambda: quad + number + b"\nf 1/1 2/2 4/3\nf 1/1 3/2 4/3\n",
        "faces that cross themselves": lambda: vertices + b"".join(b"f " + face + b"\n" for face in crossing),
        "a million options": lambda: b"mtllib thing.mtl\n" + vertices + b"usemtl plain\nf 1 2 3\n",
        "continued lines": lambda: vertices + b"f 1 \\\n" * 100_000 + b"2 3\n",
        "escapes in names": lambda: b"mtllib \x1b]0;owned\x07.mtl\n" + vertices + b"usemtl \x1b[31mred\nf 1 2 3\n",
    }
    what = random.choice(sorted(kinds))
    mtl = MTL + b"map_Ka " + b"-s 1 1 1 " * 200_000 if "options" in what else MTL
    files = {"thing.obj": kinds[what](), "thing.mtl": mtl, "wood.png": sample("PNG")}
    return Case(f"obj: {what}", "object", "thing.obj", files)


def _random_triangles(random: Random) -> bytes:
    numbers = [f"{random.uniform(-1, 1):.3f}" for _ in range(9 * 1500)]
    vertices = "".join(f"v {' '.join(numbers[k : k + 3])}\n" for k in range(0, len(numbers), 3))
    return (vertices + "".join(f"f {k} {k + 1} {k + 2}\n" for k in range(1, 4500, 3))).encode()


def references(random: Random) -> Case:
    """An OBJ, material file, PLY or glTF that names what it must not."""
    names = b"../outside/secret.png ../../outside/secret.png link.png folder/secret.png pipe.png /dev/zero".split()
    names += b"/proc/self/mem http://127.0.0.1:9/a.png file:///dev/zero ~/secret.png thing.obj .".split()
    names += [OUTSIDE + b"/secret.png", b"\\\\server\\share\\a.png", b"%2e%2e/outside/secret.png"]
    names += [b"", b"x" * 5000 + b".png", b"a\x00b.png", b"\x1b[31m.png"]
    name = random.choice(names)
    material = random.random() < 0.4
    mtl = name.replace(b".png", b".mtl") if material else b"thing.mtl"
    files = {
        "thing.obj": b"mtllib " + mtl + box_obj()[len(b"mtllib thing.mtl") :],
        "thing.mtl": MTL.replace(b"wood.png", name),
    }
    main = "thing.obj"
    if not material and random.random() < 0.2:
        files["thing.ply"] = box_file("ply", "ascii").replace(
            b"format ascii 1.0\n", b"format ascii 1.0\ncomment TextureFile " + name + b"\n"
        )
        main = "thing.ply"
    links = {"link.png": "../outside/secret.png", "link.mtl": "../outside/secret.mtl", "folder": "../outside"}
    return Case(f"reference: {name[:40]!r}", "object", main, files, links, ("pipe.png", "pipe.mtl"))


def special(random: Random) -> Case:
    """A main file that is no ordinary file."""
    name = random.choice(("thing.obj", "thing.ply", "thing.stl", "thing.glb", "room.hdr", "room.exr", "print.png"))
    loader = {"room": "environment", "print": "picture"}.get(name.split(".")[0], "object")
    target = random.choice(("/dev/zero", "/dev/null", "/dev/stdin", "/proc/kmsg", ".", "none", name))
    if random.random() < 0.4:
        return Case(f"special: a pipe as {name}", loader, name, {}, pipes=(name,))
    return Case(f"special: a link to {target} as {name}", loader, name, {}, {name: target})


def ply(random: Random) -> Case:
    """A damaged PLY."""
    encoding = random.choice(("ascii", "binary"))
    whole = random.choice((box_file("ply", encoding), mapped_ply("<" if encoding == "binary" else "")))
    what, data = damaged(random, whole)
    return Case(f"ply: {encoding} {what}", "object", "thing.ply", {"thing.ply": data, "wood.png": sample("PNG")})


def hostile_ply(random: Random) -> Case:
    """A PLY whose header promises much or oddly."""
    kind = random.choice(("ascii", "binary_little_endian", "binary_big_endian"))
    count = random.choice((3, 3, 0, -1, 10**9, 2**63, 10**30))
    corners = random.choice((3, 3, 4, 250, 100_000))
    size = random.choice(("uchar", "int", "float", "char", "double"))
    extras = ["", "property list uchar float s\n", "property unknown q\n", "property float x\n", "element none 10\n"]
    extras += ["comment TextureFile wood.png\n", "property list double double big\n"]
    extras.append("element tristrips 1000000000\nproperty list uchar int vertex_indices\n")
    extra = random.choice(extras)
    header = f"ply\nformat {kind} 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n"
    header += (
        f"{extra}element face {random.choice((1, 1, count))}\nproperty list {size} int vertex_indices\nend_header\n"
    )
    if kind == "ascii":
        body = "0 0 0\n1 0 0\n0 1 0\n" + f"{corners} " + "0 1 2 " * (corners // 3 + 1) + "\n"
        return Case(f"ply: {kind} header", "object", "thing.ply", {"thing.ply": (header + body).encode()})
    order = "<" if "little" in kind else ">"
    data = header.encode() + struct.pack(f"{order}9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    data += struct.pack(
        {"uchar": "B", "char": "B", "int": order + "i", "float": order + "f", "double": order + "d"}[size],
        corners & 0xFF if "char" in size else corners,
    )
    data += struct.pack(f"{order}3i", 0, 1, 2) * max(1, (corners & 0xFF if "char" in size else corners) // 3)
    return Case(f"ply: {kind} header", "object", "thing.ply", {"thing.ply": data})


def stl(random: Random) -> Case:
    """A damaged STL."""
    encoding = random.choice(("ascii", "binary"))
    binary = (box_file("stl", "binary"), coloured_stl(b"COLOR=\x10\x20\x30\xff"), coloured_stl(b"solid"))
    what, data = damaged(random, box_file("stl", encoding) if encoding == "ascii" else random.choice(binary))
    return Case(f"stl: {encoding} {what}", "object", "thing.stl", {"thing.stl": data})


def hostile_stl(random: Random) -> Case:
    """An STL with odd counts or values."""
    count = random.choice((0, 1, 12, 0xFFFFFFFF, 20_000))
    values = {
        "noise": lambda: random.randbytes(50),
        "zeros": lambda: bytes(50),
        "nan": lambda: struct.pack("<12fH", *[float("nan")] * 12, 0),
        "small": lambda: struct.pack("<12fH", *[random.uniform(-1e-38, 1e-38) for _ in range(12)], 0),
        "large": lambda: struct.pack("<12fH", *[random.uniform(-3e38, 3e38) for _ in range(12)], 0),
        "random": lambda: struct.pack("<12fH", *[random.uniform(-1, 1) for _ in range(12)], 0),
        "flat": lambda: struct.pack("<12fH", 0, 0, 1, *[c for _ in range(3) for c in (random.random(), 0, 0)], 0),
    }
    what = random.choice(sorted(values))
    written = min(count, random.choice((1, 500, 1500)))
    told = random.choice((count, written, written))
    data = bytes(80) + struct.pack("<I", told) + b"".join(values[what]() for _ in range(written))
    return Case(f"stl: {what}, {written} facets of {told}", "object", "thing.stl", {"thing.stl": data})


MAKERS: tuple[Maker, ...] = (obj, hostile_obj, references, ply, hostile_ply, stl, hostile_stl, special)
