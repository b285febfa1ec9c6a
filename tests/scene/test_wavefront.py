"""Wavefront OBJ and its material files: what each statement says is read, or named as left out."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.mtl_surfaces import parse_map
from advsearch.scene.importing.objects import import_object, read_parts
from advsearch.scene.importing.parts import ImportedPart

POINTS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
MAPPED = POINTS + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACE = "f 1/1 2/2 3/3 4/4\n"
USED = "mtllib a.mtl\nusemtl m\n"


def read(folder: Path, obj: str, **others: str) -> tuple[list[ImportedPart], list[str]]:
    """Read an OBJ beside other files; ``a`` is a.mtl."""
    for name, text in others.items():
        (folder / f"{name}.mtl").write_text(text)
    path = folder / "a.obj"
    path.write_text(obj)
    parts, notes = read_parts(path, path.read_bytes())
    assert all(note.startswith("a.obj") for note in notes)
    return parts, [note.removeprefix("a.obj").removeprefix(": ") for note in notes]


def material(folder: Path, *lines: str, obj: str = MAPPED + USED + FACE) -> tuple[ImportedPart, list[str]]:
    """Read a square with a material of some lines."""
    (part,), notes = read(folder, obj, a="\n".join(("newmtl m", *lines, "")))
    return part, notes


def picture(folder: Path, name: str, pixels: object = None) -> np.ndarray:
    """Write a picture, of noise by default; return its values."""
    codes = np.random.default_rng(1).integers(256, size=(8, 8, 3)) if pixels is None else np.asarray(pixels)
    Image.fromarray(codes.astype(np.uint8)).save(folder / name)
    found: np.ndarray = codes.astype(np.float32) / np.float32(255.0)
    return found


def same(found: np.ndarray | None, expected: np.ndarray) -> bool:
    """Whether there is an array, and it is as expected."""
    return found is not None and np.array_equal(found, expected)


def areas(part: ImportedPart) -> np.ndarray:
    """The areas (F,) of a part's faces."""
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    found: np.ndarray = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    return found


@pytest.mark.parametrize(
    ("rest", "name", "options"),
    [
        ("wood.png", "wood.png", {}),
        ("-s 2 my wood tex.png", "my wood tex.png", {"s": "2"}),
        ("-S 2 2 -o 0.5 -clamp on wood 2.png", "wood 2.png", {"s": "2 2", "o": "0.5", "clamp": "on"}),
        ("-bm 0.5 -imfchan r bump.png", "bump.png", {"bm": "0.5", "imfchan": "r"}),
        ("-blendu off -blendv on -cc off -mm 0.1 .8 -texres 64 -t 1 1 1 -boost 2 w.png", "w.png", None),
        ("a -s.png", "a -s.png", {}),
        ("-s 2 2 2 7", "7", {"s": "2 2 2"}),
        ("-s 2 2 2", None, {}),
    ],
)
def test_options_and_names_of_maps(rest: str, name: str | None, options: dict[str, str] | None) -> None:
    use = parse_map(rest)
    assert (use and use.name) == name
    assert use is None or options is None or use.options == options


def test_values_and_channels_of_maps(tmp_path: Path) -> None:
    pixels = picture(tmp_path, "wood.png")
    part, notes = material(tmp_path, "map_Kd -mm 0.25 0.5 wood.png", "map_d -imfchan g wood.png")
    assert notes == [] and part.surface.texture is not None
    np.testing.assert_allclose(part.surface.texture[:, :, 3], pixels[:, :, 1], atol=1e-6)
    seen = part.surface.texture[:, :, 3] > 0
    np.testing.assert_allclose(part.surface.texture[seen][:, :3], (0.25 + 0.5 * pixels)[seen], atol=1e-6)


def test_several_material_files(tmp_path: Path) -> None:
    faces = "usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4\n"
    red, blue = "newmtl red\nKd 0.8 0.1 0.1\n", "newmtl blue\nKd 0.1 0.1 0.8\nnewmtl red\nKd 0 1 0\n"
    (tmp_path / "my red.mtl").write_text(red)
    for line in (
        "mtllib red.mtl blue.mtl\n",
        "mtllib red.mtl\nmtllib blue.mtl # and more\n",
        "mtllib my red.mtl\nmtllib blue.mtl\n",
        "mtllib my red.mtl blue.mtl\n",
        'mtllib "my red.mtl"\nmtllib .\\blue.mtl\n',
    ):
        parts, notes = read(tmp_path, line + POINTS + faces, red=red, blue=blue)
        colors = [list(part.surface.color) for part in parts if part.surface.color is not None]
        assert notes == [] and colors == [pytest.approx([0.8, 0.1, 0.1]), pytest.approx([0.1, 0.1, 0.8])]
    _, notes = read(tmp_path, "mtllib gone.mtl blue.mtl\n" + POINTS + faces, blue="newmtl blue\nKd 0 0 1\n")
    assert len(notes) == 2 and "'gone.mtl'" in notes[0] and "'red'" in notes[1]


def test_roughness_and_metallic(tmp_path: Path) -> None:
    part, notes = material(tmp_path, "Kd 1 1 1", "Pr 0.25", "Pm 1")
    assert notes == [] and (part.surface.roughness, part.surface.metallic) == (0.25, 1.0)
    pixels = picture(tmp_path, "rm.png")
    part, notes = material(tmp_path, "Pr 0.25", "map_Pr -imfchan g rm.png", "map_Pm -imfchan b -mm 0 0.5 rm.png")
    assert part.surface.roughness == pytest.approx(pixels[:, :, 1].mean(), abs=1e-6)
    assert part.surface.metallic == pytest.approx(pixels[:, :, 2].mean() / 2.0, abs=1e-6)
    assert len(notes) == 1 and "roughness and metallic" in notes[0]


def test_colors_of_vertices_times_the_color_of_the_material(tmp_path: Path) -> None:
    colored = "".join(f"v {x} {y} 0 {x} {y} 0.5\n" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    for kd, n_notes in ((1.0, 0), (0.5, 1)):
        part, notes = material(tmp_path, f"Kd {kd} {kd} {kd}", "Tr 0", obj=colored + USED + "f 1 2 3 4\n")
        at = part.vertices[part.faces]
        expected = srgb_to_linear(np.concatenate([at[:, :, :2], np.full_like(at[:, :, :1], 0.5)], axis=2))
        assert len(notes) == n_notes and part.colors == pytest.approx(expected, abs=1e-6)
        assert part.surface.color == pytest.approx([kd] * 3)
    picture(tmp_path, "wood.png")
    part, notes = material(tmp_path, "map_Kd wood.png", obj=colored + MAPPED.replace(POINTS, "") + USED + FACE)
    assert part.colors is None and len(notes) == 1 and "colours of vertices" in notes[0]
    assert material(tmp_path, "map_Kd wood.png", obj=MAPPED.replace(" 0\n", " 0 1 1 1\n") + USED + FACE)[1] == []


@pytest.mark.parametrize(
    ("rest", "color", "n_notes"),
    [
        ("0.2 0.4 0.6", (0.2, 0.4, 0.6), 0),
        ("51 102 153", (0.2, 0.4, 0.6), 0),
        ("0.2 0.4 0.6 0.5", (0.2, 0.4, 0.6), 1),  # an opacity, which is left out
        ("2.5", None, 1),  # a weight, which is left out
    ],
)
def test_numbers_after_the_coordinates(
    tmp_path: Path, rest: str, color: tuple[float, float, float] | None, n_notes: int
) -> None:
    (part,), notes = read(tmp_path, "".join(f"v {k % 2} {k // 2} 0 {rest}\n" for k in range(3)) + "f 1 2 3\n")
    assert len(notes) == n_notes
    assert (part.colors is None) == (color is None)
    if color is not None and part.colors is not None:
        assert linear_to_srgb(part.colors[0, 0].astype(np.float32)) == pytest.approx(color, abs=1e-4)


def test_a_face_without_smoothing_is_flat(tmp_path: Path) -> None:
    roof = "v 0 0 0\nv 1 0 0.2\nv 1 1 0.2\nv 0 1 0\nv 2 0 0\nv 2 1 0\n"
    faces = "f 1 2 3 4\nf 2 5 6 3\n"
    flat, smooth = (import_roof(tmp_path, roof + said + faces) for said in ("s off\n", ""))
    assert len(np.unique(flat.round(4), axis=0)) == 2 and len(np.unique(smooth.round(4), axis=0)) > 2
    assert np.array_equal(import_roof(tmp_path, roof + "s 0 # off\n" + faces), flat)
    _, notes = read(tmp_path, roof + "s 1\n" + faces)
    assert len(notes) == 1 and "smoothing groups" in notes[0]
    normals = "vn 0 0 1\ns 1\nf 1//1 2//1 3//1 4//1\n"
    assert read(tmp_path, roof + normals)[1] == []


def import_roof(folder: Path, obj: str) -> np.ndarray:
    """The normals (V, 3) of an imported OBJ."""
    (folder / "roof.obj").write_text(obj)
    return import_object(folder / "roof.obj").mesh.normals


def test_concave_polygons_keep_their_area(tmp_path: Path) -> None:
    shape = ((0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3))
    points = "".join(f"v {x} {y} {z}\n" for z in (0, 0.4) for x, y in shape)
    sides = "".join(f"f {k + 1} {(k + 1) % 8 + 1} {(k + 1) % 8 + 9} {k + 9}\n" for k in range(8))
    (part,), notes = read(tmp_path, points + "f 8 7 6 5 4 3 2 1\nf 9 10 11 12 13 14 15 16\n" + sides)
    assert notes == [] and areas(part).sum() == pytest.approx(20.4) and len(part.faces) == 28


def test_indices_of_every_form(tmp_path: Path) -> None:
    normals = "vn 0 0 1\nvn 0 0 1\n"
    obj = (
        MAPPED + normals + "f 1/1/1 2/2/2 3/3/1\nf 1/1 3/3 4/4\nf 1//1 2//2 4//1\nfo -4/-4/-1 -3/-3/-1 -1/-1\nf 2 3 4\n"
    )
    parts, notes = read(tmp_path, obj + "v 9 9 9\nf -2 -3 -4\n")
    assert notes == [] and [len(part.faces) for part in parts] == [3, 3]
    bare, mapped = parts
    assert bare.uvs is None and mapped.uvs is not None
    np.testing.assert_allclose(mapped.uvs[mapped.faces], mapped.vertices[mapped.faces][:, :, :2])
    assert bare.vertices[bare.faces[-1]].tolist() == [[0, 1, 0], [1, 1, 0], [1, 0, 0]]


STATEMENTS = (
    "l 1 2 3;p 1;curv 0 1 1 2;cstype bezier;vp 0.5;lod 3;bevel on;usemap brick;call more.obj;vx 1 2 3".split(";"),
    "bevel off;lod 0;g side top;o box".split(";"),
)
"""Statements of OBJ files that are named as left out, and others of which nothing is said."""

MATERIAL_LINES = (
    (
        "illum 7;Tf 1 0.5 0.5;Pcr 0.03;Ps 0.5;anisor 0.5;map_Ks gloss.png;disp -mm 0 2 high.png;decal sticker.png;"
        "refl -type sphere sky.png;gloss_factor 3;Ke black"
    ).split(";"),
    (
        "Ka 0.2 0.2 0.2;Ks 0.5 0.5 0.5;Ns 250;Ni 1.45;illum 2;Tf 1 1 1;Pc 0;aniso 0.0;map_Ka wood.png;norm;Pr 0.5;"
        "Ke 1 1 1"
    ).split(";"),
)
"""The same of lines of material files."""

OPTIONS = (
    "-blendv off;-t 1 1;-texres 64;-bm 2;-imfchan g;-boost 3".split(";"),
    "-s 2 2;-o 0.5;-mm 0 1;-blendu on;-cc off;-t 0 0 0;-colorspace sRGB".split(";"),
)
"""The same of options of a texture."""

WORDS = {"illum": "illumination", "Ke": "emission"}
"""What a note calls a line by, where that is not its keyword."""


def chosen(lines: tuple[list[str], list[str]]) -> st.SearchStrategy[list[str]]:
    """Some of the lines, of each keyword one at most."""
    return st.lists(st.sampled_from([*lines[0], *lines[1]]), unique_by=lambda line: line.split()[0], max_size=6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a texture."""
    found = tmp_path_factory.mktemp("obj")
    picture(found, "wood.png")
    return found


@settings(max_examples=40, deadline=None)
@given(
    chosen(STATEMENTS),
    chosen(MATERIAL_LINES),
    chosen(OPTIONS),
    st.sampled_from(["", " # so", "\t#1"]),
    st.sampled_from(["\n", "\r\n"]),
)
def test_whatever_a_file_has_is_read_or_named(
    folder: Path, statements: list[str], lines: list[str], options: list[str], comment: str, newline: str
) -> None:
    words = ("newmtl m", "Kd 1 1 1", *lines, " ".join(("map_Kd", *options, "wood.png")))
    (folder / "a.mtl").write_bytes(newline.join(f"{line}{comment}" for line in words).encode())
    whole = [*MAPPED.splitlines(), *USED.splitlines(), *statements, *FACE.splitlines()]
    (folder / "a.obj").write_bytes((newline.join(f"{line}{comment}" for line in whole) + newline).encode())
    (part,), notes = read_parts(folder / "a.obj", (folder / "a.obj").read_bytes())
    tables = ((statements, STATEMENTS), (lines, MATERIAL_LINES), (options, OPTIONS))
    left_out = [line.split()[0] for found, table in tables for line in found if line in table[0]]
    left_out = [word for word in left_out if word != "Pcr" or "Pc 0" not in lines]
    if "Ke" in left_out:  # the maps lie at the same place all the same
        assert part.surface.emission is None
    assert len(notes) == len(left_out)
    for word in left_out:
        assert any(WORDS.get(word, f"'{word}") in note for note in notes), (word, notes)
    assert part.surface.texture is not None and areas(part).sum() == pytest.approx(1.0)
    assert part.surface.roughness == (0.5 if "Pr 0.5" in lines else None)
    scale, offset = (2.0, 2.0) if "-s 2 2" in options else (1.0, 1.0), (0.5 if "-o 0.5" in options else 0.0, 0.0)
    assert part.uvs == pytest.approx(part.vertices[:, :2] * np.array(scale) + np.array(offset))
