"""Run folders that are damaged, or that somebody made to do harm: one sentence that names the file, and status 2."""

import json
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest

from advsearch.cli.main import main
from advsearch.errors import AdvsearchError, FileFormatError
from advsearch.options import Value
from advsearch.runs import summary
from advsearch.runs.directory import RunDirectory, find_run
from advsearch.runs.files import read_png
from advsearch.runs.listing import read_listed_run
from advsearch.runs.results import Result
from advsearch.runs.store import CachedEvaluation, Row, Store
from advsearch.settings import HEADER
from advsearch.trust.writing import write_text
from advsearch.viewer import thumbnails
from covering import once_each
from samples import CURVE, REGION, SWEEP, attack, rated

SUMMARY = attack(ending="interrupted", verified=rated(3)).to_dict()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that was stopped, with two rows."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "it"
    folder.mkdir(parents=True)
    (folder / "run.yaml").write_text(f"{HEADER}schema: 2\ncommand: attack\nobject: mug\ncontrols: {{pose: {{}}}}\n")
    (folder / "summary.json").write_text(json.dumps(SUMMARY))
    with Store(folder / "results.sqlite") as store:
        values: dict[str, Value] = {"pose.yaw": {"value": 3.0, "unit": "degrees"}}
        store.append([Row("search", step, objective=0.5, values=values) for step in range(2)])
        store.write_note("answer", "[0.5]")
    return folder


def statement(text: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with sqlite3.connect(folder / "results.sqlite") as db:
            db.executescript(text)
        db.close()

    return change


def edited_schema(text: str) -> Callable[[Path], None]:
    """Change the schema past SQLite's own checks: a name that begins with sqlite_ is reserved, but can be written."""
    return statement(f"PRAGMA writable_schema = ON; {text}; PRAGMA writable_schema = RESET")


def made_internal(kind: str, made: str) -> Callable[[Path], None]:
    """Make a trigger, a view, ... called `it`, and give it a name that begins like SQLite's own."""
    renamed = f"sql = replace(sql, '{kind} it', '{kind} sqlite_it'), name = 'sqlite_it'"
    if kind in ("TABLE", "VIEW"):
        renamed += ", tbl_name = 'sqlite_it'"
    return edited_schema(f"CREATE {kind} it {made}; UPDATE sqlite_master SET {renamed} WHERE name = 'it'")


def content(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(data)


def truncated(folder: Path) -> None:
    path = folder / "results.sqlite"
    path.write_bytes(path.read_bytes()[:5000])


STORES: dict[str, Callable[[Path], object]] = {
    "truncated": truncated,
    "no rows": statement("DROP TABLE evaluations"),
    "values that are a list": statement("UPDATE evaluations SET values_json = '[1]'"),
    "values that are nested": statement(f"UPDATE evaluations SET values_json = '{'[' * 100_000}'"),
    "metrics that are no mapping": statement("UPDATE evaluations SET metrics_json = '[1]'"),
    "a step that is text": statement("UPDATE evaluations SET step = 'one' WHERE id = 1"),
    "text that is not UTF-8": statement("UPDATE evaluations SET label = CAST(x'ff' AS TEXT)"),
    "a trigger with an internal name": made_internal(
        "TRIGGER", "AFTER INSERT ON evaluations BEGIN DELETE FROM evaluations; END"
    ),
    "a trigger called like a table": statement(
        "CREATE TRIGGER told AFTER INSERT ON evaluations BEGIN DELETE FROM evaluations; END"
    ),
    "a virtual table": statement("CREATE VIRTUAL TABLE words USING fts5(text)"),
    "an index on an expression": statement("CREATE INDEX likely ON evaluations (abs(step))"),
    "a column that is checked": edited_schema(
        "UPDATE sqlite_master SET sql = replace(sql, 'step         INTEGER NOT NULL', "
        "'step INTEGER NOT NULL CHECK (step > 0)') WHERE name = 'evaluations'"
    ),
    "a view without an end": statement(
        "DROP TABLE evaluations; CREATE VIEW evaluations AS WITH RECURSIVE t(id) AS "
        "(SELECT 1 UNION ALL SELECT id + 1 FROM t) SELECT * FROM t"
    ),
    "a computed column": statement(
        "ALTER TABLE evaluations DROP COLUMN spp; ALTER TABLE evaluations ADD COLUMN spp INTEGER AS (step)"
    ),
    "another file": content("results.sqlite", b"SQLite format 3\0" + bytes(5000)),
}


@pytest.mark.parametrize("case", STORES)
def test_damaged_results_are_named(case: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    STORES[case](run)
    assert main(["export", "it"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("advsearch: error: ") and error.count("\n") == 1 and len(error) < 500 + len(str(run))
    assert "results.sqlite: " in error
    assert main(["runs"]) == 0 and main(["show", "it"]) == 0
    with pytest.raises(FileFormatError, match=r"results\.sqlite: "), RunDirectory.resume("it") as opened:
        list(opened.store.rows())


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "[" * 100_000, '{"a": ' + "9" * 6000 + "}", "\0", '{"ending": NaN', '{"schema": 1}']
)
def test_summaries_that_are_none_are_named(text: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "summary.json").write_text(text)
    for command in ("show", "resume"):
        assert main([command, "it"]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and "summary.json: expected the summary of a run" in error and len(error) < 600
    assert main(["runs"]) == 0


OTHERS = [None, 3, "text", [], [1], {}, {"a": [1]}, True, float("inf"), {"a\u001b[2J": "\u001b"}]


@pytest.mark.medium
@once_each("summary, value", [SUMMARY, SWEEP, CURVE, REGION], OTHERS)
def test_summaries_of_other_types_are_named(
    summary: dict[str, Any], value: Any, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever part of it is of another type: shown, or refused in one sentence with the file's name."""
    for name in summary:
        (run / "summary.json").write_text(json.dumps({**summary, name: value}))
        status = main(["show", "it"])
        captured = capsys.readouterr()
        assert status == 0 or (status == 2 and "summary.json: expected the summary" in captured.err)
        assert captured.err.count("\n") == (status == 2) and len(captured.err) < 600 and "\x1b" not in captured.err
        assert main(["runs"]) == 0
        capsys.readouterr()


DAMAGED = [
    "",
    "[1]",
    "command: [1]\n",
    "command: attack\nobject: [1]\n",
    "command: attack\nobject: mug\ncontrols: 3\n",
    "command: attack\nobject: mug\nseed: 0b_\n",
    "command: attack\nobject: mug\nbase: /dev/zero\n",
    "command: attack\nobject: mug\nset: [1]\nsteps: x\n",
    "\0",
]


@pytest.mark.medium
@once_each("command, text", [["resume", "it"], ["run", "runs/it/run.yaml"], ["region", "--around", "it"]], DAMAGED)
def test_damaged_configurations_are_refused(
    command: list[str], text: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "run.yaml").write_text(HEADER + text)
    assert main(command) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("advsearch: error: ")
    assert main(["runs"]) == 0


@pytest.mark.parametrize("name", ["run.yaml", "results.sqlite", "summary.json", ".lock"])
def test_pipes_in_a_run_do_not_block(name: str, run: Path) -> None:
    (run / name).unlink(missing_ok=True)
    os.mkfifo(run / name)
    assert main(["runs"]) == 0 and main(["show", "it"]) in (0, 2) and main(["export", "it"]) in (0, 2)
    with suppress(AdvsearchError), RunDirectory.resume("it") as opened:
        opened.store.count_rows()


KEPT = (
    *("run.yaml", "summary.json", "results.sqlite", "results.sqlite-wal", "report.html", "columns.bin"),
    *("images", "images/clean.png", "images/rows", "images/rows/0000", "images/photos", "images/photos/3-0000.jpg"),
    *("artifacts", "artifacts/adversarial.npy", "artifacts/object.glb", "aov", "aov/000001.exr", "parts", "parts/a"),
    *("parts/a/report.html", "parts/a/images/rows", ".lock"),
)
"""Whatever is read, shown, copied or written."""


def away(link: Path, outside: Path) -> None:
    link.symlink_to(outside)


def chain(link: Path, outside: Path) -> None:
    (link.parent / "hop").symlink_to(outside)
    link.symlink_to("hop")


def above(link: Path, _: Path) -> None:
    link.symlink_to("..")


def inside(link: Path, _: Path) -> None:
    link.symlink_to(link.parent / "run.yaml")


@pytest.mark.medium
@once_each("name, how", KEPT, [away, chain, above, inside])
def test_a_link_in_a_run_is_followed_by_nobody(
    name: str, how: Callable[[Path, Path], None], run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    link = run / name
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    how(link, outside)
    commands = [["show", "it"], ["export", "it"], ["view", "it"], ["view", "it", "--bundle", "site"], ["resume", "it"]]
    for command in [*commands, ["report", "it", "--evidence"], ["replay", "it"], ["compare", "it"], ["explain", "it"]]:
        assert main(command) == 2, command
        assert "got a link; remove it" in capsys.readouterr().err.splitlines()[-1], command
    assert "got a link; remove it" in read_listed_run(run).fault
    assert not (tmp_path / "site").exists() and not list(outside.iterdir())


def test_a_run_may_be_reached_by_a_link(run: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").symlink_to(run)
    assert find_run(tmp_path / "elsewhere") == tmp_path / "elsewhere"
    assert read_listed_run(tmp_path / "elsewhere").fault == ""
    assert main(["show", str(tmp_path / "elsewhere")]) == 0


def test_a_small_picture_that_is_a_link_is_none(run: Path, tmp_path: Path) -> None:
    """Of a million no command looks at each beforehand: each is looked at as it is read."""
    thumbnails.write_thumbnail(run, 3, b"kept")
    assert thumbnails.read_thumbnail(run, 3) == b"kept"
    (tmp_path / "secret").write_bytes(b"secret")
    (run / "images/rows/0000/4.jpg").symlink_to(tmp_path / "secret")
    (run / "images/rows/0001").symlink_to(run / "images/rows/0000")
    (run / "images/rows/0000/1003.jpg").write_bytes(b"secret")
    for number in (4, 1003, 5):
        assert thumbnails.find_thumbnail(run, number) is None
        with pytest.raises(FileNotFoundError):
            thumbnails.read_thumbnail(run, number)


def test_a_journal_cannot_delete_another_file(run: Path, tmp_path: Path) -> None:
    """SQLite removes the "super-journal" that the journal of a file names, once that is rolled back."""
    mine, results = tmp_path / "mine", run / "results.sqlite"
    mine.write_text("alias ll='ls -l'\n")
    magic, named = bytes.fromhex("d9d505f920a163d7"), os.fsencode(mine)
    header = magic + struct.pack(">IIIII", 0, 1, results.stat().st_size // 4096, 512, 4096)
    ending = struct.pack(">I", (1 << 30) // 4096 + 1) + named + struct.pack(">II", len(named), sum(named)) + magic
    Path(f"{results}-journal").write_bytes(header.ljust(512, b"\0") + ending)
    assert main(["show", "it"]) == main(["runs"]) == main(["export", "it"]) == 0
    with pytest.raises(FileFormatError, match="-journal"):
        RunDirectory.resume("it")
    assert mine.is_file()


def test_a_link_in_place_of_what_is_being_written_is_not_written_through(run: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    for name in ("report.html", "summary.json"):
        (run / f".part-{os.getpid()}-{name}").symlink_to(tmp_path / "mine")
        write_text(run / name, "written")
        assert (run / name).read_text() == "written" and not (run / name).is_symlink()
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_picture_of_another_format_runs_no_program(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow asks Ghostscript for what is an EPS, whatever its file is called."""
    program = tmp_path / "programs" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/ran\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n%%EOF\n"
    (run / "images").mkdir()
    (run / "images" / "clean.png").write_bytes(eps)
    thumbnails.write_thumbnail(run, 3, eps)
    assert thumbnails.make_cover(run)[:2] == b"\xff\xd8"
    with pytest.raises(FileFormatError, match="expected a PNG picture"):
        read_png(run / "images" / "clean.png")
    with pytest.raises(FileFormatError, match="expected a small picture"):
        thumbnails.Thumbnails(run, 1, is_subset=False).read_png(3)
    assert not (tmp_path / "ran").exists()


CONFUSED: dict[str, list[Any]] = {
    "values_json": ['{"a": 5}', '{"a": {"value": 1.0}}', '{"a": {"value": {}, "unit": ""}}',
                    '{"a": {"value": [[1]], "unit": ""}}', '{"a": {"value": NaN, "unit": ""}}',
                    '{"a": {"value": 1e999, "unit": ""}}', "[1]", "x",
                    '{"a": {"value": 1, "unit": 5}}', '{"a": {"value": 1' + "0" * 400 + ', "unit": ""}}', "[" * 5000],
    "payload_json": ['{"a": NaN}', '{"a": 1e999}', "[" * 5000, "x", "1" * 5000],
    "metrics_json": ['{"a": "b"}', '{"a": NaN}', "[1]"],
    "margin": [9e999], "step": [-1, 1 << 40],
}  # fmt: skip


@pytest.mark.parametrize(("column", "value"), [(name, one) for name, ones in CONFUSED.items() for one in ones])
def test_what_is_inside_a_row_is_checked(column: str, value: object, run: Path) -> None:
    with closing(sqlite3.connect(run / "results.sqlite")) as db:
        db.execute(f"UPDATE evaluations SET {column} = ? WHERE step = 1", (value,))
        db.commit()
    with Store(run / "results.sqlite", read_only=True) as store, pytest.raises(FileFormatError, match=f"{column}; it"):
        list(store.rows())


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_a_summary_has_no_numbers_that_are_none(text: str, run: Path) -> None:
    (run / "summary.json").write_text(json.dumps(SUMMARY | {"epsilon": "HERE"}).replace('"HERE"', text))
    assert main(["show", "it"]) == 2
    assert text in read_listed_run(run).fault


def test_a_bad_run_does_not_take_the_list_along(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd, linked, deep = (run.parent / name for name in (os.fsdecode(b"b\xffd"), "linked", "deep"))
    for one in (odd, linked, deep):
        shutil.copytree(run, one)
    (linked / "columns.bin").symlink_to("/dev/null")
    (deep / "summary.json").write_text("[" * 100_000)
    assert main(["runs"]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 5
    assert [line.split(": ")[1] for line in err.splitlines()] == ["deep", "linked"]
    assert main(["runs", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["runs"]) == 4


def test_a_run_is_listed_anew_only_where_it_has_changed(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = list[Path]()
    real = summary.read_result

    def counted(path: Path) -> Result:
        read.append(path)
        return real(path)

    monkeypatch.setattr(summary, "read_result", counted)
    first = read_listed_run(run)
    assert read_listed_run(run) is first and len(read) == 1
    write_text(run / "summary.json", json.dumps(SUMMARY | {"ending": "found"}))
    assert read_listed_run(run).state == "found" and len(read) == 2
    with Store(run / "results.sqlite") as store:
        store.append([Row("search", 2)])
    assert (read_listed_run(run).rows, read_listed_run(run).fault) == (3, "")


@pytest.mark.parametrize("name", ["results.sqlite", ".lock", "images", "artifacts"])
def test_a_run_that_links_elsewhere_changes_nothing_there(name: str, run: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    if (run / name).exists():
        shutil.copy(run / name, outside)
        (run / name).unlink()
    else:
        outside.write_text("mine")
    before = outside.read_bytes()
    (run / name).symlink_to(outside)
    with pytest.raises(FileFormatError, match=f"{name}: expected a file or a folder of this run, got a link"):
        RunDirectory.resume("it")
    assert outside.read_bytes() == before


@pytest.mark.parametrize(
    "change",
    [
        "u = 3", "gradient = x'010203'", "picture = x'01', height = 1",
    ],
)  # fmt: skip
def test_what_a_search_was_told_is_checked(change: str, tmp_path: Path) -> None:
    path = tmp_path / "results.sqlite"
    with Store(path) as store:
        store.append([Row("search", 0)], CachedEvaluation(0, b"u", 0, 1))
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(f"UPDATE told SET {change}")
    with Store(path) as store, pytest.raises(FileFormatError, match="expected the cached evaluations of a search, got"):
        store.read_cached("search", 0)
