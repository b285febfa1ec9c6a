"""`advsearch report`: runs as evidence, from their folders."""

import json
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

import advsearch
from advsearch.cli.main import main
from advsearch.errors import InputError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.files import write_png
from advsearch.runs.summary import VERSIONS_NOTE, compute_file_digests
from samples import make_run

pytestmark = pytest.mark.island("advsearch.questions.report")


def test_runs_become_a_page_markdown_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = make_run(tmp_path / "good", pictures=False, rows=False)
    with RunDirectory.create_for(AttackConfig(object="bowl", run=str(tmp_path / "killed"))):
        pass
    out = tmp_path / "card"
    asked = ["report", str(good), str(tmp_path / "killed"), str(good), "--evidence", "--out", str(out)]
    assert main([*asked, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [run["claims"][0]["kind"] for run in told["runs"]] == ["found", "nothing claimed"], "each run once"
    assert {"advsearch", "torch", "mitsuba"} <= set(told["runs"][0]["made_with"])
    assert json.loads((out / "evidence.json").read_text()) == told
    assert all("a vase in 20 of 20" in (out / f"evidence.{kind}").read_text() for kind in ("md", "json"))
    assert main(asked) == 2 and "--overwrite" in capsys.readouterr().err
    assert main([*asked, "--overwrite"]) == 0 and "nothing claimed" in capsys.readouterr().out
    assert main(["report", str(good)]) == 2 and "--evidence" in capsys.readouterr().err


def test_every_file_that_was_read_is_digested(tmp_path: Path) -> None:
    """The .mtl, the paint and the buffer too, which decide what the picture is."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    write_png(tmp_path / "a" / "paint.png", np.full((4, 4, 3), 0.5, np.float32))
    (tmp_path / "a" / "cube.mtl").write_text("newmtl one\nKd 1 1 1\nmap_Kd paint.png\n")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "usemtl one\nf 1/1 3/2 2/3\nf 1/1 2/2 4/3\nf 1/1 4/2 3/3\nf 2/1 3/2 4/3\n"
    (tmp_path / "a" / "cube.obj").write_text(f"mtllib cube.mtl\n{corners}{faces}")
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint16)
    (tmp_path / "b" / "part.bin").write_bytes(points.tobytes() + triangles.tobytes())
    views = [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
        {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
    ]
    scene = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, "name": "thing"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"uri": "part.bin", "byteLength": 72}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    (tmp_path / "b" / "scene.gltf").write_text(json.dumps(scene))
    cube, whole = str(tmp_path / "a" / "cube.obj"), f"{tmp_path / 'b' / 'scene.gltf'}#thing"
    for spec in (cube, whole):
        advsearch.load_scene(spec)
    found = compute_file_digests({"object": f"{cube},{whole}", "environment": "studio"})
    read = [tmp_path / "a" / one for one in ("cube.obj", "cube.mtl", "paint.png")]
    read += [tmp_path / "b" / one for one in ("scene.gltf", "part.bin")]
    assert found == {str(one): sha256(one.read_bytes()).hexdigest() for one in read}
    (tmp_path / "a" / "paint.png").write_bytes(b"another")
    assert compute_file_digests({"object": cube})[str(read[2])] != found[str(read[2])]


def test_a_run_does_not_go_on_with_another_version(tmp_path: Path) -> None:
    config = AttackConfig(object="mug", run=str(tmp_path / "run"))
    with RunDirectory.create_for(config) as run:
        first = run.store.read_json_note(VERSIONS_NOTE)
        run.store.write_note(VERSIONS_NOTE, json.dumps({**first, "torch": "0.1"}))
    with pytest.raises(InputError, match="torch"):
        RunDirectory.resume(tmp_path / "run", config)
