"""Exports: written by the name of the file, to no link, and of a run whose disk was full."""

import errno
import json
import math
import os
from pathlib import Path
from typing import Any

import pytest

from advsearch.cli.main import main
from advsearch.errors import StorageError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.export import FORMATS
from advsearch.runs.exporters import EXPORTERS
from advsearch.runs.listing import is_finished
from advsearch.runs.store import Row
from advsearch.viewer.pages import write_result
from samples import attack

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


@pytest.mark.parametrize("leads_to", ["an empty folder", "nothing"])
@pytest.mark.parametrize(
    "format", [name for name in ("coco", "yolo", "mitsuba", "projector", "3db") if name in EXPORTERS]
)
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
