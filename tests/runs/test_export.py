"""Rows as tables for other programs, and the list of runs."""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from advsearch.cli.main import main
from advsearch.errors import StorageError, UnknownNameError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.export import FORMATS, list_columns, write_rows
from advsearch.runs.exporters import EXPORTERS
from advsearch.runs.listing import is_finished, list_runs
from advsearch.runs.store import NAME, Row, Store
from advsearch.viewer.pages import write_result
from samples import attack, rated

TWO: Any = {"light.place": {"value": [1.0, 2.0], "unit": ""}}
"""A value of two numbers; our own controls have none such."""
ROWS = (
    Row("search", 0, seed=2**63 - 1, spp=8, objective=0.1 + 0.2, success=True, label="tea, pot", label_index=3,
        probability=0.5, values={"pose.yaw": {"value": 30.0, "unit": "degrees"}}, renders=3),
    Row("search", 1, objective=math.nan, values=TWO),
    Row("control", 0, success=False, values={"material.pattern": {"value": "felt", "unit": ""}}),
)  # fmt: skip


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    with RunDirectory.create("one", config=AttackConfig(object="mug", controls="pose")) as made:
        made.append_rows(*ROWS)
        return made.path


def table(run: Path, format: str, kind: str | None = None) -> bytes:
    stream = io.BytesIO()
    with Store(run / NAME, read_only=True) as store:
        assert write_rows(store, format, None, stream, kind) == (3 if kind is None else 2)
    return stream.getvalue()


def test_units_stand_in_the_columns_and_vectors_are_spread() -> None:
    names = list_columns(ROWS)
    assert names[:3] == ["id", "kind", "step"] and names[-4:] == ["renders", "machine", "seconds", "time"]
    assert names[names.index("payload") + 1 : -4] == [
        "pose.yaw [degrees]",
        "light.place[0]",
        "light.place[1]",
        "material.pattern",
    ]


def test_csv_can_be_read_back(run: Path) -> None:
    found = list(csv.DictReader(io.StringIO(table(run, "csv").decode())))
    assert [row["kind"] for row in found] == ["search", "search", "control"]
    assert float(found[0]["objective"]) == 0.1 + 0.2 and int(found[0]["seed"]) == 2**63 - 1
    assert found[0]["label"] == "tea, pot" and found[0]["success"] == "1" and found[1]["objective"] == ""
    assert found[1]["light.place[1]"] == "2.0" and found[2]["material.pattern"] == "felt"


def test_json_has_every_column_in_every_row(run: Path) -> None:
    found = json.loads(table(run, "json", "search"))
    assert len(found) == 2 and list(found[0]) == list(found[1])
    assert found[0]["success"] is True and found[1]["objective"] is None and found[0]["pose.yaw [degrees]"] == 30.0


def test_parquet_has_the_same_table_with_types(run: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra `parquet`, which the set-up installs")
    found = parquet.read_table(io.BytesIO(table(run, "parquet"))).to_pylist()
    as_json = json.loads(table(run, "json"))
    assert found == as_json and isinstance(found[0]["seed"], int)


def test_without_pyarrow_it_says_what_to_do(run: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert main(["export", "one", "--format", "parquet", "--out", "x.parquet"]) == 2
    assert "pip install pyarrow, or choose csv or json" in capsys.readouterr().err
    assert not Path("x.parquet").exists()


@pytest.mark.parametrize("format", FORMATS)
def test_the_command_writes_by_the_name_of_the_file(run: Path, format: str, capsys: pytest.CaptureFixture[str]) -> None:
    if format == "parquet":
        pytest.importorskip("pyarrow", reason="the extra `parquet`, which the set-up installs")
    assert main(["export", "one", "--out", f"rows.{format}"]) == 0
    out, err = capsys.readouterr()
    assert out == "" and f"3 rows in rows.{format}" in err
    assert main(["export", str(run), "--json", "--out", f"again.{format}"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == 3
    assert Path(f"rows.{format}").read_bytes() == Path(f"again.{format}").read_bytes()
    assert main(["export", "one", "--out", "rows.xyz"]) == 0 and "3 rows in rows.xyz, as csv" in capsys.readouterr().err


def test_what_is_wrong_is_told(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, message in (
        (["export", "two"], "unknown run 'two'"),
        (["export", "one", "--format", "xls"], "unknown format 'xls'. Known: 3db, coco, csv, gltf, json, "),
        (
            ["export", "one", "--format", "fiftyone", "--out", "x"],
            "fiftyone was removed, since FiftyOne reads COCO; use ",
        ),
        (["export", "one", "--all"], "--all: belongs to --format coco and yolo"),
        (["export", "one", "--kind", "serch"], "unknown kind of rows 'serch'. Did you mean 'search'?"),
        (["export", "one", "--json", "--format", "csv"], "--json: prints JSON, but --format asks for csv"),
        (["export", "one", "--out", "."], "--out: expected the name of a file, got the folder"),
    ):
        assert main(words) == 2
        assert message in capsys.readouterr().err


def test_a_table_that_cannot_be_written_names_out(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run.parent / "file").touch()
    assert main(["export", str(run), "--out", str(run.parent / "file" / "rows.csv")]) == 2
    assert capsys.readouterr().err.endswith("choose another place with --out\n")


@pytest.mark.parametrize("format", EXPORTERS)
def test_what_is_no_table_says_what_it_writes_and_is_in_the_help(format: str, run: Path, capsys: Any) -> None:
    writer = EXPORTERS[format]
    said = EXPORTERS.get_help(format)
    assert said.endswith(".") and "\n" not in said, f"{format}: expected a sentence"
    assert f"--format {format}" in writer.example and "--out" in writer.example, f"{format}: an example with --format"
    assert main(["export", "--help"]) == 0
    assert f"{format}: {said.rstrip('.')}".lower() in " ".join(capsys.readouterr().out.split()).lower()
    assert main(["export", run.name, "--format", format]) == 2
    assert f"--out: {format} writes {writer.writes}; give its name" in " ".join(capsys.readouterr().err.split())
    out = writer.example.split("--out ")[1]
    assert main(["export", "nowhere", "--format", format, "--out", out]) == 2
    assert "nowhere" in capsys.readouterr().err and not Path(out).exists()


def test_an_unknown_kind_leaves_no_file(run: Path) -> None:
    with Store(run / NAME, read_only=True) as store, pytest.raises(UnknownNameError):
        write_rows(store, "csv", run / "x.csv", io.BytesIO(), "none")
    assert not (run / "x.csv").exists()


# ---- the list of runs -----------------------------------------------------------------------------------------------


def test_runs_says_how_each_ended(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [(one.name, one.state, one.rows) for one in list_runs(run.parent)] == [("one", "stopped", 3)]
    with RunDirectory.resume("one"):
        assert list_runs(run.parent)[0].state == "running"
    with RunDirectory.create("two", config=AttackConfig(object="bowl", controls="texture")) as other:
        other.write_summary(attack(verified=rated(19)))
    with RunDirectory.create("three") as third:
        third.write_summary(attack(ending="interrupted", verified=None))
    assert main(["runs", "--json"]) == 0
    found = {one["name"]: one for one in json.loads(capsys.readouterr().out)["runs"]}
    assert (found["two"]["state"], found["two"]["answer"], found["two"]["object"]) == ("found", "19/20", "bowl")
    assert found["three"]["state"] == "stopped"
    assert [is_finished(run.parent / name) for name in ("one", "two", "three")] == [False, True, False]
    assert main(["runs"]) == 0
    assert "one" in capsys.readouterr().out


def test_no_runs_and_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["runs"]) == 0 and "no runs in runs/ yet" in capsys.readouterr().out
    assert main(["runs", "nowhere"]) == 2 and "nowhere: expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize("full_at", ["report.html", "summary.json"])
def test_a_run_whose_disk_was_full_at_the_end_goes_on_and_has_everything(
    full_at: str, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = os.replace

    def full(source: Path, target: Path) -> None:
        if Path(target).name == full_at:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    result = attack(verified=None)
    with monkeypatch.context() as patched:
        patched.setattr("advsearch.trust.writing.os.replace", full)
        with RunDirectory.resume("one") as again, pytest.raises(StorageError, match="the disk is full"):
            write_result(again, result)
    assert not is_finished(run) and not (run / full_at).exists() and not list(run.glob(".part-*"))
    with RunDirectory.resume("one") as again:
        write_result(again, result)
    assert is_finished(run) and (run / "report.html").is_file()


def test_resume_makes_the_page_again_that_is_missing(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDirectory.resume("one") as again:
        write_result(again, attack(verified=None))
    (run / "report.html").unlink()
    assert main(["resume", "one"]) == 0 and "is done already" in capsys.readouterr().err
    assert b"<html" in (run / "report.html").read_bytes()


@pytest.mark.parametrize("leads_to", ["an empty folder", "nothing"])
@pytest.mark.parametrize("format", ["coco", "yolo", "mitsuba", "projector", "3db"])
def test_an_export_goes_to_no_link(
    format: str, leads_to: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunDirectory.resume("one") as again:
        write_result(again, attack(verified=None))
    target = tmp_path / "target"
    if leads_to == "an empty folder":
        target.mkdir()
    link = tmp_path / "link"
    link.symlink_to(target)
    assert main(["export", "one", "--format", format, "--out", str(link)]) == 2
    error = capsys.readouterr().err
    assert "link" in error.splitlines()[-1] and error.splitlines()[-1].startswith("advsearch: error: --out: ")
    assert link.is_symlink() and (not target.exists() or not list(target.iterdir()))
    assert not list(tmp_path.glob(".export-*"))


def test_resume_of_a_run_that_is_done_shows_its_result(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with RunDirectory.resume("one") as again:
        again.write_summary(attack(verified=None))
    assert main(["resume", "one", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["ending"] == "found" and "is done already" in err
    assert main(["resume", "nothing"]) == 2 and "unknown run 'nothing'" in capsys.readouterr().err
