"""Files of objects that are not read: what they are comes first, then what to do."""

from __future__ import annotations

import ast
import shlex
from pathlib import Path

import pytest

from advsearch.errors import FileFormatError
from advsearch.files import MESHES
from advsearch.scene.importing.files import BLENDER_IMPORTERS, FORMAT_ADVICE, find_advice
from advsearch.scene.importing.objects import import_object

ENDINGS = [one for _, endings in BLENDER_IMPORTERS.values() for one in endings]
ENDINGS += [one for _, endings in FORMAT_ADVICE.values() for one in endings]
ENDINGS += [".bin"]


@pytest.mark.parametrize(
    ("ending", "what", "do"),
    [
        (".splat", "Gaussian splats", "fuse_post.ply"),
        (".sog", "Gaussian splats", "fuse_post.ply"),
        (".fbx", "an FBX model", "bpy.ops.import_scene.fbx"),
        (".DAE", "a COLLADA model", "assimp export 'my thing.DAE' 'my thing.obj'"),
        (".3mf", "a 3MF model", "assimp export"),
        (".step", "a CAD model", "gmsh 'my thing.step' -2 -o 'my thing.stl'"),
        (".npz", "NumPy's arrays", "export('mesh.ply')"),
        (".zip", "an archive", "unpack"),
    ],
)
def test_it_says_what_the_file_is_and_then_what_to_do(ending: str, what: str, do: str, tmp_path: Path) -> None:
    path = tmp_path / f"my thing{ending}"
    path.write_bytes(b"anything")
    with pytest.raises(FileFormatError) as caught:
        import_object(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ") and "\n" not in said
    assert said.index(what) < said.index(do) < said.index("(read are .obj")


def test_no_ending_is_there_twice_or_is_read() -> None:
    assert len(set(ENDINGS)) == len(ENDINGS) and not set(ENDINGS) & set(MESHES)
    assert all(find_advice(Path(f"a{one}")) for one in ENDINGS)
    assert find_advice(Path("a.nonsense")) is None


@pytest.mark.parametrize("name", ["plain.fbx", 'it\'s "mine" $(x).fbx'])
def test_blender_is_given_one_argument_of_python(name: str) -> None:
    command = (find_advice(Path(name)) or "").rpartition("with Blender: ")[2]
    *start, script = shlex.split(command)
    assert start == ["blender", "-b", "--python-expr"]
    calls = [node for node in ast.walk(ast.parse(script)) if isinstance(node, ast.Call)]
    names = [one.value.value for call in calls for one in call.keywords if isinstance(one.value, ast.Constant)]
    assert names == [True, name, f"{Path(name).stem}.glb"]


def test_a_buffer_names_the_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "scene.bin").write_bytes(b"1")
    (tmp_path / "scene.gltf").write_text("{}")
    with pytest.raises(FileFormatError, match=r"a buffer, as a \.gltf file has .*: name that file, scene\.gltf"):
        import_object(tmp_path / "scene.bin")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.ply#lid", r"a\.ply: has no parts by name, got #lid"),
        ("a.fbx#lid", "an FBX model"),
        ("a.nonsense#lid", r"got '\.nonsense#lid'"),
    ],
)
def test_a_part_of_a_file_without_parts_is_told_so(name: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=words):
        import_object(tmp_path / name)


def test_a_ply_of_splats_is_not_called_points(tmp_path: Path) -> None:
    path = tmp_path / "point_cloud.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "property float f_dc_0\nproperty float opacity\nend_header\n0 0 0 1 1\n"
    )
    with pytest.raises(FileFormatError, match="got Gaussian splats, a model that has no surface"):
        import_object(path)
    path.write_text(
        "ply\nformat ascii 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
        "property uint packed_position\nend_header\n0\n7\n"
    )
    with pytest.raises(FileFormatError, match="got Gaussian splats, a model that has no surface"):
        import_object(path)


def test_splats_beside_faces_are_named_first(tmp_path: Path) -> None:
    path = tmp_path / "both.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "property float f_dc_0\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 1\n1 0 0 1\n0 1 0 1\n3 0 1 2\n"
    )
    assert import_object(path).warnings[0].startswith("both.ply has Gaussian splats, which are left out: a model that")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"PXR-USDC\x00", "a USD scene"),
        (b"Kaydara FBX Binary  \x00", "an FBX model"),
        (b"<?xml version='1.0'?>", "XML"),
    ],
)
@pytest.mark.parametrize("ending", [".obj", ".glb"])
def test_a_file_under_another_ending_is_told_by_what_it_holds(
    content: bytes, what: str, ending: str, tmp_path: Path
) -> None:
    path = tmp_path / f"thing{ending}"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=f"got {what}"):
        import_object(path)
