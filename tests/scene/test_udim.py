"""Pictures of one square of texture coordinates each (UDIM), faces of too few corners, and means over what is shown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_gltf import File
from test_wavefront import MAPPED, USED, areas, picture, read

from advsearch.errors import FileFormatError
from advsearch.scene.importing import mtl_surfaces
from advsearch.scene.importing.objects import import_object, read_parts
from advsearch.scene.importing.parts import has_normals
from advsearch.scene.importing.texture import average_over_faces

RED, BLUE = np.full((4, 4, 3), (255, 0, 0)), np.full((4, 4, 3), (0, 0, 255))
TWO = (
    "mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\n"
    "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 2 0\nvt 2 1\nf 1/1 2/2 3/3 4/4\nf 2/2 5/5 6/6 3/3\n"
)
"""Two squares side by side, in 1001 and 1002."""
SHARED = "mtllib a.mtl\nusemtl m\n" + MAPPED.replace("vt 1 ", "vt 0.5 ") + "f 1/1 2/2 3/3 4/4\n"
"""A square that shows the left half of its picture."""


@pytest.mark.parametrize("name", ["skin.1001.png", "skin.<UDIM>.png", "skin_1001.png", "-s 1 1 1 skin.1001.png"])
def test_each_square_has_its_own_picture(name: str, tmp_path: Path) -> None:
    file = name.rpartition(" ")[2]
    for number, pixels in ((1001, RED), (1002, BLUE)):
        picture(tmp_path, file.replace("<UDIM>", "1001").replace("1001", str(number)), pixels)
    parts, notes = read(tmp_path, TWO, a=f"newmtl m\nmap_Kd {name}\n")
    assert notes == []
    shown = {}
    for part in parts:
        assert part.surface.texture is not None and part.uvs is not None
        assert part.uvs.min() == 0.0 and part.uvs.max() == 1.0
        shown[float(part.vertices[:, 0].max())] = part.surface.texture[0, 0].tolist()
    assert shown == {1.0: [1.0, 0.0, 0.0], 2.0: [0.0, 0.0, 1.0]}
    assert {part.surface.name for part in parts} == {"m"}


@pytest.mark.medium
def test_both_pictures_are_on_the_object(tmp_path: Path) -> None:
    picture(tmp_path, "skin.1001.png", RED), picture(tmp_path, "skin.1002.png", BLUE)
    read(tmp_path, TWO, a="newmtl m\nmap_Kd skin.1001.png\n")
    asset = import_object(tmp_path / "a.obj")
    assert {tuple(one) for one in asset.base_color.reshape(-1, 3).round(3)} == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    assert any("the pictures of its material were baked" in note for note in asset.warnings)
    assert list(asset.mesh.materials) == ["m"]


def test_a_square_without_a_picture_is_said(tmp_path: Path) -> None:
    picture(tmp_path, "skin.1001.png", RED), picture(tmp_path, "skin.1003.png", BLUE)
    three = TWO + "vt 2 0\nvt 3 0\nvt 3 1\nf 1/7 2/8 3/9\n"
    parts, notes = read(tmp_path, three, a="newmtl m\nmap_Kd skin.1001.png\n")
    assert len(parts) == 3 and len(notes) == 1
    assert "'skin.1002.png', which is missing" in notes[0]


def test_one_picture_with_a_number_in_its_name_repeats_and_is_said(tmp_path: Path) -> None:
    picture(tmp_path, "brick.1001.png", RED)
    (part,), notes = read(tmp_path, TWO, a="newmtl m\nmap_Kd brick.1001.png\n")
    assert part.uvs is not None and part.uvs.max() == 2.0
    assert len(notes) == 1 and "named like one of several pictures (UDIM)" in notes[0] and "1002" in notes[0]
    _, notes = read(tmp_path, MAPPED + USED + "f 1/1 2/2 3/3 4/4\n", a="newmtl m\nmap_Kd brick.1001.png\n")
    assert notes == []  # all is in 1001


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("a.1001.png", 1001),
        ("a<udim>.exr", 0),
        ("a1999.png", 1999),
        ("a1000.png", None),
        ("a11001.png", None),
        ("1001", None),
    ],
)
def test_numbers_in_names(name: str, number: int | None) -> None:
    assert mtl_surfaces.find_square(name) == number
    if number is not None:
        assert mtl_surfaces.replace_square(name, 1013) in ("a.1013.png", "a1013.exr", "a1013.png")


def test_squares_are_numbered_as_udim_has_them() -> None:
    at = np.array([[0.5, 0.5], [9.5, 0.5], [0.5, 1.5], [2.5, 3.5], [-0.5, 0.5], [10.5, 0.5]])
    assert mtl_surfaces.compute_squares(at[:, None].repeat(3, axis=1)).tolist() == [1001, 1010, 1011, 1033, 0, 0]
    assert [mtl_surfaces.get_square_corner(one) for one in (1001, 1010, 1033, 0)] == [(0, 0), (9, 0), (2, 3), (0, 0)]


# ---- faces of one and two corners -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("lines", "few"), [("f 1 2\nf 3\n", "2 faces"), ("f 1/1 2/2\n", "1 face"), ("f\n", "1 face")])
def test_faces_of_too_few_corners_are_left_out_with_a_note(lines: str, few: str, tmp_path: Path) -> None:
    for text in (MAPPED + lines + "f 1/1 2/2 3/3 4/4\n", MAPPED + "f -4/-4 -3/-3 -2/-2 -1/-1\n" + lines):
        (part,), notes = read(tmp_path, text)
        assert areas(part).sum() == pytest.approx(1.0)
        assert notes == [f"{few} of fewer than 3 corners left out"]


def test_a_file_of_such_faces_only_has_none(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="expected a mesh with faces"):
        read(tmp_path, MAPPED + "f 1 2\nf 3\n")


@pytest.mark.parametrize(
    ("line", "words"),
    [("f 0 1", "indices that count from 1"), ("f a 1", "whole numbers in the face"), ("f 1 99", "99 'v' lines")],
)
def test_what_is_no_corner_in_them_is_refused_all_the_same(line: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=words):
        read(tmp_path, f"{MAPPED}{line}\nf 1 2 3\n")


def test_a_ply_loses_them_too_and_keeps_colours_and_coordinates_of_the_others(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    faces = "2 0 1 2 0 0 1 1 9 0 0\n4 0 1 2 3 8 0 0 1 0 1 1 0 1 0 255 0\n1 3 0 0 0 9\n"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 3\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
        + faces.replace("2 0 1 2 0 0 1 1 9 0 0", "2 0 1 4 0 0 1 1 9 0 0").replace("1 3 0 0 0 9", "1 3 2 0 0 0 0 9")
    )
    (part,), notes = read_parts(path, path.read_bytes())
    assert areas(part).sum() == pytest.approx(1.0) and part.colors is not None and part.uvs is not None
    assert part.colors.reshape(-1, 3) == pytest.approx(np.tile([0.0, 1.0, 0.0], (6, 1)))
    assert (part.uvs == part.vertices[:, :2]).all()
    assert notes == ["a.ply: 2 faces of fewer than 3 corners left out"]


# ---- means ----------------------------------------------------------------------------------------------------------


def halves(left: int, right: int) -> np.ndarray:
    """A picture whose left half is of one value, and a part of the right half of another."""
    found = np.full((32, 32, 3), left)
    found[:, 20:28] = right  # away from the seams, where it would be filtered
    return found


def test_a_mean_is_over_what_faces_show(tmp_path: Path) -> None:
    """In a material file; the right half of the picture is on no face."""
    picture(tmp_path, "rough.png", halves(204, 0))
    parts, notes = read(tmp_path, SHARED, a="newmtl m\nmap_Pr rough.png\nmap_Pm rough.png\n")
    assert parts[0].surface.roughness == pytest.approx(0.8, abs=0.01)
    assert parts[0].surface.metallic == pytest.approx(0.8, abs=0.01)
    assert notes == ["textures of roughness and metallic are replaced by their means"]


def test_a_mean_of_gltf_is_too(tmp_path: Path) -> None:
    file = File()
    use = file.texture(halves(204, 0).astype(np.uint8))
    file.header["materials"][0]["pbrMetallicRoughness"] = {"metallicRoughnessTexture": use}
    uvs = np.array([[0.0, 1.0], [0.5, 1.0], [0.5, 0.0], [0.0, 0.0]])
    file.primitive(attributes={"TEXCOORD_0": file.values(uvs)})
    path = file.write(tmp_path)
    ((part,), _) = read_parts(path, path.read_bytes())
    assert part.surface.roughness == pytest.approx(0.8, abs=0.01)


def test_faces_without_coordinates_get_the_mean_of_what_the_others_show(tmp_path: Path) -> None:
    Image.fromarray(halves(204, 0).astype(np.uint8)).save(tmp_path / "half.png")
    read(tmp_path, SHARED + "v 0 0 1\nv 1 0 1\nv 1 1 1\nf 5 6 7\n", a="newmtl m\nmap_Kd half.png\n")
    asset = import_object(tmp_path / "a.obj")
    assert float(asset.base_color.min()) == pytest.approx(0.8, abs=0.02)  # not of all texels


def test_a_mean_weighs_faces_by_their_area() -> None:
    columns = np.arange(64, dtype=np.float32)[None, :, None].repeat(64, axis=0) / 64.0
    left = np.array([[0.0, 0.0], [0.25, 0.0], [0.0, 1.0]])
    right = left + np.array([0.5, 0.0])
    uvs = np.stack([left, right])
    lone = [float(average_over_faces(columns, one[None], np.ones(1))[0]) for one in (left, right)]
    assert lone == pytest.approx([0.25 / 3, 0.5 + 0.25 / 3], abs=0.01)
    both = float(average_over_faces(columns, uvs, np.array([3.0, 1.0]))[0])
    assert both == pytest.approx(0.75 * lone[0] + 0.25 * lone[1], abs=1e-3)
    assert float(average_over_faces(columns, np.full((2, 3, 2), np.nan), np.ones(2))[0]) == pytest.approx(
        columns.mean()
    )


def test_a_normal_map_with_black_between_its_charts_is_one() -> None:
    map = np.zeros((16, 16, 3), np.float32)
    assert not has_normals(map)
    map[:4] = (0.5, 0.5, 1.0)
    assert has_normals(map)
    map[:4] = 0.5
    assert not has_normals(map)
