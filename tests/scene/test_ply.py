"""PLY and STL: what their properties say is read, or named as left out."""

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from advsearch.errors import FileFormatError
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.importing.parts import ImportedPart

XYZ = ("float x", "float y", "float z")
FACES = ("list uchar int vertex_indices",)
SQUARE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]
CODES = dict(zip("char uchar short ushort int uint float double".split(), "bBhHiIfd", strict=True))
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
Rows = list[list[Any]]


@dataclass
class Ply:
    """A PLY file: for each element its properties and its rows, whose lists are lists."""

    elements: dict[str, tuple[tuple[str, ...], Rows]]
    comments: list[str] = field(default_factory=list)

    def read(self, folder: Path, kind: str = "ascii") -> tuple[list[ImportedPart], list[str]]:
        """Write the file and read it."""
        (folder / "a.ply").write_bytes(self.written(kind))
        parts, notes = read_parts(folder / "a.ply", (folder / "a.ply").read_bytes())
        return parts, [note.removeprefix("a.ply").removeprefix(": ") for note in notes]

    def written(self, kind: str) -> bytes:
        """The file, in a format of PLY."""
        order, head = ORDERS[kind], f"ply\nformat {kind} 1.0\n" + "".join(f"comment {one}\n" for one in self.comments)
        body = []
        for name, (properties, rows) in self.elements.items():
            head += f"element {name} {len(rows)}\n" + "".join(f"property {one}\n" for one in properties)
            for row in rows:
                for declared, value in zip(properties, row, strict=True):
                    words = declared.split()
                    many = value if words[0] == "list" else [value]
                    count = [(CODES[words[1]], len(value))] if words[0] == "list" else []
                    cells = [*count, *((CODES[words[-2]], one) for one in many)]
                    body += [struct.pack(order + code, one) if order else f"{one} ".encode() for code, one in cells]
                body += [] if order else [b"\n"]
        return head.encode() + b"end_header\n" + b"".join(body)


def square(*properties: str, values: Rows | None = None, faces: Rows | None = None) -> Ply:
    """A square with more properties of its vertices."""
    rows: Rows = [[*point, *more] for point, more in zip(SQUARE, values or [[]] * 4, strict=True)]
    return Ply({"vertex": ((*XYZ, *properties), rows), "face": (FACES, faces or [[[0, 1, 2, 3]]])})


def area(parts: list[ImportedPart]) -> float:
    """The area of all faces."""
    ends = np.concatenate([part.vertices[part.faces] for part in parts])
    vectors = np.cross(ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0])
    return float(np.linalg.norm(vectors, axis=1).sum()) / 2.0


def shown(part: ImportedPart) -> np.ndarray:
    """The display-referred colours (F, 3, 3) of a part's corners."""
    assert part.colors is not None and part.surface.color is not None and (part.surface.color == 1.0).all()
    found: np.ndarray = linear_to_srgb(part.colors.astype(np.float32))
    return found


def textures(folder: Path) -> None:
    """Write red.png and blue.png."""
    for name, color in (("red", (200, 0, 0)), ("blue", (0, 0, 200))):
        Image.new("RGB", (4, 4), color).save(folder / f"{name}.png")


def test_colors_of_faces_and_of_both(tmp_path: Path) -> None:
    colors = (*FACES, "uchar red", "uchar green", "uchar blue")
    faces: Rows = [[[0, 1, 2], 255, 0, 0], [[0, 2, 3], 0, 0, 255]]
    whole = square()
    whole.elements["face"] = (colors, faces)
    (part,), notes = whole.read(tmp_path)
    assert notes == [] and shown(part)[:, 0] == pytest.approx(np.array([[1, 0, 0], [0, 0, 1]]))
    for same in ([255, 255, 255], [255, 0, 0]):
        plain = square("uchar red", "uchar green", "uchar blue", values=[same] * 4)
        plain.elements["face"] = (colors, faces)
        (part,), notes = plain.read(tmp_path)
        assert shown(part)[:, 0] == pytest.approx(np.array([[1, 0, 0], [0, 0, 1]]))
        assert len(notes) == 1 and "colours of vertices" in notes[0]
    varied = square("uchar red", "uchar green", "uchar blue", values=[[9, 9, 9], [0, 0, 0], [1, 1, 1], [2, 2, 2]])
    varied.elements["face"] = (colors, faces)
    assert varied.read(tmp_path)[1] == ["colours of faces are left out: its vertices have some, too"]


def wedged(*more: str, rows: Rows) -> Ply:
    """A square of two triangles with texture coordinates of their corners and more properties."""
    whole = square()
    whole.elements["face"] = ((*FACES, "list uchar float texcoord", *more), rows)
    return whole


def test_texture_coordinates_of_corners_and_several_textures(tmp_path: Path) -> None:
    textures(tmp_path)
    first, second = [0.0, 0.0, 1.0, 0.0, 1.0, 1.0], [0.5, 0.5, 1.0, 1.0, 0.5, 1.0]
    whole = wedged("int texnumber", rows=[[[0, 1, 2], first, 1], [[0, 2, 3], second, 0]])
    whole.comments = ["TextureFile red.png", "TextureFile blue.png"]
    for kind in ORDERS:
        parts, notes = whole.read(tmp_path, kind)
        assert notes == []
        for part, color, uvs in zip(parts, ((200, 0, 0), (0, 0, 200)), (second, first), strict=True):
            assert part.surface.texture is not None and part.uvs is not None
            assert part.surface.texture[0, 0] * 255 == pytest.approx(color)
            assert part.uvs[part.faces].reshape(-1).tolist() == pytest.approx(uvs)
    whole.comments.pop()
    parts, notes = whole.read(tmp_path)
    assert len(notes) == 1 and "texnumber" in notes[0]
    assert [part.surface.texture is None for part in parts] == [True, False]
    whole.comments.clear()
    assert whole.read(tmp_path)[1] == ["face property 'texnumber' is left out"]
    several = wedged(rows=[[[0, 1, 2], first], [[0, 2, 3], []]])
    several.comments = ["TextureFile red.png", "TextureFile blue.png"]
    parts, notes = several.read(tmp_path)
    assert len(notes) == 1 and "red.png" in notes[0]
    assert [part.uvs is None for part in parts] == [True, False]


@pytest.mark.parametrize("kind", ORDERS)
def test_strips_become_triangles(tmp_path: Path, kind: str) -> None:
    points: Rows = [[float(k // 2), float(k % 2), 0.0] for k in range(8)]
    strips: Rows = [[[0, 1, 2, 3, -1, 4, 5, 6, 7]], [[3, 2, 5]], [[0, 0, 1]]]
    whole = Ply({"vertex": (XYZ, points), "tristrips": (("list int int vertex_indices",), strips)})
    (part,), notes = whole.read(tmp_path, kind)
    assert notes == [] and len(part.faces) == 5 and area([part]) == pytest.approx(2.5)
    ends = part.vertices[part.faces]
    up = np.cross(ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0])[:, 2]
    assert (up < 0).sum() == 4  # those of one strip face the same way


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"float x", b"float q"), (b"float x", b"flota x"), (b"face 1", b"face 2"), (b"1.0 1.0", b"1.0 one"),
        (b"4 0 1 2 3", b"4 0 1 2 4"), (b"4 0 1 2 3", b"2 0 1 2 3"), (b"4 0 1 2 3", b"-1 0 1 2 3"),
    ],
)  # fmt: skip
def test_damage_is_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    data = square().written("ascii")
    assert data.count(old) == 1 or old == b"1.0 1.0"
    (tmp_path / "a.ply").write_bytes(new.join(data.rsplit(old, 1)))
    with pytest.raises(FileFormatError, match=r"a\.ply"):
        read_parts(tmp_path / "a.ply", (tmp_path / "a.ply").read_bytes())


def test_a_format_below_the_elements_is_refused(tmp_path: Path) -> None:
    """Properties above it would have the byte order of this machine, whatever it says."""
    line = b"format binary_big_endian 1.0\n"
    data = square().written("binary_big_endian").replace(line, b"").replace(b"end_header", line + b"end_header")
    with pytest.raises(FileFormatError, match="format binary_big_endian"):
        read_parts(tmp_path / "a.ply", data)


VERTEX = {
    **dict.fromkeys(("float confidence", "double quality", "float intensity", "uchar flags", "int radius"), True),
    **dict.fromkeys(
        ("float nx,float ny,float nz", "uchar red,uchar green,uchar blue", "ushort r,ushort g,ushort b"), False
    ),
    **dict.fromkeys(("float s,float t", "double texture_u,double texture_v", "list uchar float weights"), False),
}
"""Groups of properties of vertices, and whether nothing becomes of them."""


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.sampled_from(sorted(VERTEX)), unique=True),
    st.lists(st.integers(3, 9), min_size=1, max_size=5),
    st.sampled_from(sorted(ORDERS)),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_whatever_a_file_has_is_read_or_named(
    tmp_path_factory: pytest.TempPathFactory, groups: list[str], sides: list[int], kind: str, wedge: bool, seed: int
) -> None:
    random = np.random.default_rng(seed)
    properties, rows, faces = list(XYZ), list[list[Any]](), list[list[Any]]()
    for group in groups:
        properties += group.split(",")
    for place, count in enumerate(sides):
        corners = np.arange(count) + len(rows)
        for k in range(count):
            angle = 2 * np.pi * k / count
            rows.append([np.cos(angle) + 3.0 * place, np.sin(angle), 0.0])
            for one in properties[3:]:
                many = [float(v) for v in random.random(int(random.integers(3)))]
                small = float(random.random()) if one.split()[0] in ("float", "double") else int(random.integers(256))
                rows[-1].append(many if one.startswith("list") else small)
        uvs = [float(v) for v in random.random(2 * count)]
        faces.append([corners.tolist(), *([uvs] if wedge else []), int(random.integers(9))])
    declared = (*FACES, *(["list uchar float texcoord"] if wedge else []), "uchar group")
    whole = Ply({"vertex": (tuple(properties), rows), "face": (declared, faces)})
    parts, notes = whole.read(tmp_path_factory.mktemp("ply"), kind)
    (part,) = parts
    ngons = sum(count / 2 * np.sin(2 * np.pi / count) for count in sides)
    assert area(parts) == pytest.approx(ngons, rel=1e-5)
    index = {one.split()[-1]: number for number, one in enumerate(properties)}
    table = {(round(row[0], 3), round(row[1], 3)): row for row in rows}
    of = [table[round(float(x), 3), round(float(y), 3)] for x, y, _ in part.vertices]
    unread = [name for group, left in VERTEX.items() if left and group in groups for name in group.split()[1:]]
    both = "float s,float t" in groups and "double texture_u,double texture_v" in groups
    if "float nx,float ny,float nz" in groups:
        assert part.normals == pytest.approx(
            np.array([[row[index[n]] for n in ("nx", "ny", "nz")] for row in of]), abs=1e-6
        )
    colors = [names for names in ("red green blue", "r g b") if names.split()[0] in index]
    if colors:
        top = 255.0 if colors[0][:3] == "red" else 65535.0
        given = np.array([[row[index[name]] for name in colors[0].split()] for row in of]) / top
        assert shown(part) == pytest.approx(given[part.faces], abs=2e-3)
        unread += colors[1].split() if len(colors) > 1 else []
    mapped = [names for names in (("s", "t"), ("texture_u", "texture_v")) if names[0] in index]
    if wedge:
        unread += [name for names in mapped for name in names]
        assert part.uvs is not None
        given = np.concatenate([np.reshape(face[1], (-1, 2)) for face in faces]).round(5)
        used = part.uvs[part.faces].reshape(-1, 2).round(5)
        assert np.unique(used, axis=0) == pytest.approx(np.unique(given, axis=0), abs=1e-4)
    elif mapped:
        unread += mapped[1] if both else []
        assert part.uvs == pytest.approx(np.array([[row[index[name]] for name in mapped[0]] for row in of]), abs=1e-6)
    unread += ["weights"] if "weights" in index else []
    expected = [f"vertex property {name!r} is left out" for name in unread] + ["face property 'group' is left out"]
    assert sorted(notes) == sorted(expected)


FACETS = [[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(1, 0, 0), (1, 1, 0), (0, 1, 0)]]


def stl(folder: Path, head: bytes, *attributes: int) -> tuple[ImportedPart, list[str]]:
    """Read a binary STL of two facets."""
    data = head.ljust(80, b"\0") + struct.pack("<I", 2)
    for facet, attribute in zip(FACETS, attributes, strict=True):
        data += struct.pack("<12fH", 0, 0, 1, *(one for point in facet for one in point), attribute)
    (folder / "a.stl").write_bytes(data)
    (part,), notes = read_parts(folder / "a.stl", data)
    assert area([part]) == pytest.approx(1.0)
    return part, notes


def test_colors_of_binary_stl(tmp_path: Path) -> None:
    part, notes = stl(tmp_path, b"by VisCAM", 0x801C, 0xF000)
    assert notes == [] and shown(part)[:, 0] == pytest.approx(np.array([[0, 0, 28 / 31], [28 / 31, 0, 0]]), abs=1e-4)
    part, notes = stl(tmp_path, b"solid", 0x801C, 0)
    assert notes == [] and shown(part)[:, 0] == pytest.approx(np.array([[0, 0, 28 / 31], [0.5] * 3]), abs=1e-4)
    magics = b"COLOR=" + bytes((51, 102, 153, 255))
    part, notes = stl(tmp_path, magics, 0x001C, 0xFFFF)
    assert notes == [] and shown(part)[:, 0] == pytest.approx(np.array([[28 / 31, 0, 0], [0.2, 0.4, 0.6]]), abs=1e-4)
    part, notes = stl(tmp_path, magics + b",MATERIAL=" + bytes(12), 0, 0)
    assert shown(part)[:, 0] == pytest.approx(np.array([[0.2, 0.4, 0.6]] * 2), abs=1e-4)
    assert len(notes) == 1 and "'MATERIAL'" in notes[0]
    part, notes = stl(tmp_path, b"other", 7, 0)
    assert part.colors is None
    assert len(notes) == 1 and "'0x0007'" in notes[0]
    assert stl(tmp_path, b"plain", 0, 0)[1] == []


def test_text_stl(tmp_path: Path) -> None:
    rows = ["solid vertex 1 2 3 of a thing"]
    for facet in FACETS:
        corners = [f"  VERTEX {x}.0 {y}e0 {z}" for x, y, z in facet]
        rows += ["facet normal 0 0 1", " outer loop", *corners, " endloop", "color 1 0 0", "endfacet"]
    (tmp_path / "a.stl").write_text("\r\n".join([*rows, "endsolid vertex", "solid b", "endsolid b", ""]))
    (part,), notes = read_parts(tmp_path / "a.stl", (tmp_path / "a.stl").read_bytes())
    assert area([part]) == pytest.approx(1.0) and len(notes) == 1 and "'color'" in notes[0]
