"""Folders of 3DB: written so that its dashboard reads them, and read into a run."""

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

from advsearch.cli.main import main
from advsearch.errors import FileFormatError
from advsearch.questions.sweep.result import import_threedb
from advsearch.viewer.thumbnails import find_thumbnails
from stored_sweeps import make_sweep, rows_of


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "details.log").read_text().splitlines()]


def write(folder: Path, *lines: Any, classes: Any = ("cup", "mug")) -> Path:
    """A folder of 3DB with these lines."""
    folder.mkdir()
    (folder / "class_maps.json").write_text(json.dumps(classes))
    (folder / "details.log").write_text(
        "".join((one if isinstance(one, str) else json.dumps(one)) + "\n" for one in lines)
    )
    return folder


LINE = {
    "id": "a-1", "environment": "park.blend", "model": "mug.blend", "is_correct": "True", "loss": 0.25,
    "prediction": [1, 0], "output_type": "classes", "render_args": {"OrientationControl.rotation_x": 0.5, "on": True},
}  # fmt: skip


@pytest.mark.island("advsearch.cli.exporters.threedb")
def test_a_sweep_is_written_as_its_dashboard_reads_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_sweep(tmp_path / "run", keep="wrong")
    out = tmp_path / "out"
    assert main(["export", str(run), "--format", "3db", "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == 24
    lines, classes = lines_of(out), json.loads((out / "class_maps.json").read_text())
    assert len({tuple(line) for line in lines}) == 1, "every line has the same keys in the same order"
    assert len({tuple(line["render_args"]) for line in lines}) == 1
    for line, row in zip(lines, rows_of(run), strict=True):
        assert line["is_correct"] == str(row.correct)
        assert classes[line["prediction"][0]] == row.label
        assert line["render_args"]["pose.yaw"] == row.values["pose.yaw"]["value"]
        assert (out / "images" / f"{line['id']}_rgb.png").is_file() == (not row.correct)
    assert main(["export", str(run), "--format", "3db", "--out", str(out)]) == 2
    assert "not empty" in capsys.readouterr().err


@pytest.mark.island("advsearch.cli.exporters.threedb")
def test_3dbs_own_dashboard_opens_what_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its program, up to where it would listen."""
    pytest.importorskip("threedboard", reason="no threedboard here: pip install threedboard")
    run = make_sweep(tmp_path / "run", keep="wrong")
    assert main(["export", str(run), "--format", "3db", "--out", str(tmp_path / "out")]) == 0
    started: list[Any] = []
    monkeypatch.setattr("flask.Flask.run", lambda app, **settings: started.append(app.test_client()))
    monkeypatch.setattr("sys.argv", ["threedboard", "--no-browser", str(tmp_path / "out")])
    runpy.run_module("threedboard", run_name="__main__")
    (client,) = started
    told = client.get("/log.json").get_json()
    rows = [dict(zip(told["parameters"], row, strict=True)) for row in told["data"]]
    assert [row["is_correct"] for row in rows] == [row.correct for row in rows_of(run)]
    wrong = next(row for row in rows if not row["is_correct"])
    assert told["class_map"][wrong["prediction"][0]] == "cup"
    with client.get(f"/images/{wrong['id']}") as picture:
        assert picture.data[:4] == b"\x89PNG"


@pytest.mark.island("advsearch.cli.exporters.threedb")
def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    run = make_sweep(tmp_path / "run", keep="all")
    main(["export", str(run), "--format", "3db", "--out", str(tmp_path / "out")])
    again = import_threedb(tmp_path / "out", tmp_path / "again")
    for before, after in zip(rows_of(run), rows_of(again), strict=True):
        assert (before.correct, before.label, before.margin) == (after.correct, after.label, after.margin)
        assert after.values["pose.yaw"]["value"] == before.values["pose.yaw"]["value"]
        assert after.values["environment"] == before.values["environment"]
    kept = find_thumbnails(again)
    assert kept is not None
    assert kept.numbers == tuple(range(24))
    assert "Right in 18 of 24" in (again / "report.html").read_text().replace("&nbsp;", " ")


def test_an_id_leads_nowhere_else(tmp_path: Path) -> None:
    secret = tmp_path / "secret_rgb.png"
    secret.write_bytes(b"no picture")
    run = import_threedb(write(tmp_path / "in", {**LINE, "id": "../../secret"}), tmp_path / "run")
    assert find_thumbnails(run) is None


@pytest.mark.medium
def test_a_large_picture_is_refused(tmp_path: Path) -> None:
    from PIL import Image

    folder = write(tmp_path / "in", LINE)
    (folder / "images").mkdir()
    Image.new("1", (20_000, 20_000)).save(folder / "images" / "a-1_rgb.png")
    with pytest.raises(FileFormatError, match="pixels"):
        import_threedb(folder, tmp_path / "run")
