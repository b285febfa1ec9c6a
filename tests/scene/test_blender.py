"""Blender files: Blender is started so that nothing in the file runs, has a deadline, and its glTF is read."""

import json
import os
import stat
import sys
from pathlib import Path

import pytest
import trimesh

from advsearch.errors import FileFormatError
from advsearch.scene.description import load_description
from advsearch.scene.importing import blender
from advsearch.scene.importing.objects import import_object
from advsearch.trust import programs

pytestmark = pytest.mark.island("advsearch.scene.importing.blender")

STAND_IN = f"""#!{sys.executable}
import json, os, shutil, sys
from pathlib import Path
here = Path(__file__).parent
(here / "seen.json").write_text(json.dumps([sys.argv[1:], dict(os.environ)]))
exec((here / "does.py").read_text())
"""
COPY = "shutil.copy(here / 'made.glb', sys.argv[-2])"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a stand-in for Blender on the PATH, and the glTF that it writes."""
    scene = trimesh.Scene()
    for name, x in (("crate", 0.0), ("post", 3.0)):
        place = trimesh.transformations.translation_matrix([x, 0.5, 0.0])
        scene.add_geometry(trimesh.creation.box(extents=[1.0, 1.0, 1.0]), name, name, transform=place)
    (tmp_path / "made.glb").write_bytes(scene.export(file_type="glb"))
    (tmp_path / "does.py").write_text(COPY)
    (tmp_path / "room.blend").write_bytes(b"BLENDER-v405 and more")
    program = tmp_path / "blender"
    program.write_text(STAND_IN)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("SECRET", "x")
    monkeypatch.delenv(programs.BLENDER, raising=False)
    return tmp_path


def test_a_blender_file_is_read_as_the_gltf_that_blender_makes_of_it(folder: Path) -> None:
    scene = load_description(f"{folder}/room.blend#crate")
    assert set(scene.meshes) == {"object", "post"} and scene.object.up is not None and scene.object.up.axis == "y"
    assert import_object(folder / "room.blend").name == "room"


def test_nothing_in_the_file_is_run(folder: Path) -> None:
    import_object(folder / "room.blend")
    arguments, environment = json.loads((folder / "seen.json").read_text())
    assert arguments[:3] == ["--background", "--factory-startup", "--disable-autoexec"]
    assert "use_scripts=False" in blender.EXPORT_SCRIPT
    assert environment["HOME"] == environment["TMPDIR"] != os.environ["HOME"] and "SECRET" not in environment
    assert not Path(environment["HOME"]).exists()


@pytest.mark.parametrize(
    ("does", "words"),
    [
        (
            "print('Error: File written by newer Blender'); sys.exit(1)",
            "could not read it: Error: File written by newer",
        ),
        ("pass", "could not read it; export glTF"),
        ("import time; time.sleep(30)", "had not read it after 1 seconds.*ADVSEARCH_LIMITS=10"),
        ("Path(sys.argv[-2]).write_text('no glTF')", "expected .*got"),
        ("Path(sys.argv[-2]).touch()", "empty"),
    ],
)
def test_what_blender_can_not_read_is_said(
    folder: Path, does: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blender, "LONGEST", 1 if "sleep" in does else blender.LONGEST)
    (folder / "does.py").write_text(does)
    with pytest.raises(FileFormatError, match=words):
        import_object(folder / "room.blend")


def test_without_blender_the_command_to_type_is_said(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "blender").unlink()
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(FileFormatError, match="pip install bpy"):
        import_object(folder / "room.blend")
    monkeypatch.setenv(programs.BLENDER, "nowhere/blender")
    with pytest.raises(FileFormatError, match="ADVSEARCH_BLENDER"):
        import_object(folder / "room.blend")
