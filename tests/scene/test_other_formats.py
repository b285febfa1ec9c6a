"""Files of objects that are not read: what they are comes first, then what to do."""

from __future__ import annotations

import ast
import shlex
from pathlib import Path

import pytest

from advsearch.errors import FileFormatError
from advsearch.scene.importing.files import find_advice
from advsearch.scene.importing.objects import import_object


@pytest.mark.parametrize(
    ("ending", "what", "do"),
    [
        (".splat", "Gaussian splats", "fuse_post.ply"),
        (".fbx", "an FBX model", "bpy.ops.import_scene.fbx"),
        (".DAE", "a COLLADA model", "assimp export 'my thing.DAE' 'my thing.obj'"),
    ],
)
def test_it_says_what_the_file_is_and_then_what_to_do(ending: str, what: str, do: str, tmp_path: Path) -> None:
    path = tmp_path / f"my thing{ending}"
    path.write_bytes(b"anything")
    with pytest.raises(FileFormatError) as caught:
        import_object(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.index(what) < message.index(do)


@pytest.mark.parametrize("name", ["plain.fbx", 'it\'s "mine" $(x).fbx'])
def test_blender_is_given_one_argument_of_python(name: str) -> None:
    command = (find_advice(Path(name)) or "").rpartition("with Blender: ")[2]
    *start, script = shlex.split(command)
    assert start == ["blender", "-b", "--python-expr"]
    calls = [node for node in ast.walk(ast.parse(script)) if isinstance(node, ast.Call)]
    names = [one.value.value for call in calls for one in call.keywords if isinstance(one.value, ast.Constant)]
    assert names == [True, name, f"{Path(name).stem}.glb"]


VERTEX = "property float x\nproperty float y\nproperty float z\nproperty float f_dc_0\nproperty float opacity\n"


def test_a_ply_of_splats_is_not_called_points(tmp_path: Path) -> None:
    path = tmp_path / "point_cloud.ply"
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{VERTEX}end_header\n0 0 0 1 1\n")
    with pytest.raises(FileFormatError, match="Gaussian splats"):
        import_object(path)


@pytest.mark.parametrize("ending", [".obj", ".glb"])
@pytest.mark.parametrize(("content", "what"), [(b"PXR-USDC\x00", "a USD scene"), (b"<?xml version='1.0'?>", "XML")])
def test_a_file_under_another_ending_is_told_by_what_it_holds(
    content: bytes, what: str, ending: str, tmp_path: Path
) -> None:
    path = tmp_path / f"thing{ending}"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=what):
        import_object(path)
