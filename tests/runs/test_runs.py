"""The run directory: what survives, what is refused, and that files are whole or not there."""

import csv
import errno
import io
import json
import math
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from advsearch.errors import FileFormatError, InputError, RunExistsError, StorageError, UnknownNameError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs import directory, files
from advsearch.runs.directory import RunDirectory, find_run
from advsearch.runs.export import write_rows
from advsearch.runs.listing import is_finished, list_runs
from advsearch.runs.results import Result
from advsearch.runs.store import Row, Store
from advsearch.runs.summary import read_result
from advsearch.trust.stored_files import open_regular
from advsearch.trust.writing import PART, RunLock, replace_file, write_text
from samples import attack, exr, rated, sweep

WRITER = """
import sys
from pathlib import Path
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
run = RunDirectory.create(Path(sys.argv[1]))
for step in range(100_000):
    values = {"p": {"value": step, "unit": "degrees"}}
    run.append_rows(Row("search", step, seed=step * 7, objective=step / 3, values=values))
    print(step, flush=True)
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunDirectory]:
    """A new run."""
    with RunDirectory.create(tmp_path / "run") as made:
        yield made


@pytest.mark.medium
@pytest.mark.parametrize("acknowledged", [1, 20, 137])
def test_every_acknowledged_row_survives_sigkill(tmp_path: Path, acknowledged: int) -> None:
    path = tmp_path / "run"
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        said = [int(writer.stdout.readline()) for _ in range(acknowledged)]
        writer.send_signal(signal.SIGKILL)
        said += [int(line) for line in writer.stdout if line.endswith("\n")]
    assert writer.returncode == -signal.SIGKILL
    with Store(path / "results.sqlite", read_only=True) as store:
        rows = list(store.rows())
    assert len(rows) - len(said) in (0, 1)
    assert [row.step for row in rows] == list(range(len(rows)))
    assert all(row.seed == row.step * 7 and row.objective == row.step / 3 for row in rows)
    RunLock(path).release()  # the kernel dropped the lock of the killed process


def test_a_row_comes_back_as_it_was(run: RunDirectory) -> None:
    row = Row(
        kind="search", step=3, seed=2**32 - 1, spp=16, objective=-1.25, success=True, label="wine glass", label_index=5,
        probability=0.75, values={"camera.azimuth": {"value": 130.0, "unit": "degrees"}}, seconds=0.5,
    )  # fmt: skip
    run.append_rows(row)
    (found,) = run.store.rows()
    assert found.id == 1 and found.time is not None and found.time > 1.6e9
    assert {name: getattr(found, name) for name in vars(row) if name not in ("id", "time")} == {
        name: getattr(row, name) for name in vars(row) if name not in ("id", "time")
    }


def test_rows_are_added_all_or_none(run: RunDirectory) -> None:
    run.append_rows(Row("search", 0))
    nothing: Any = object()
    broken = Row("search", 2, values={"p": nothing})
    with pytest.raises(TypeError, match="JSON"):
        run.append_rows(Row("search", 1), broken)
    run.append_rows(Row("search", 5))
    assert [row.step for row in run.store.rows()] == [0, 5]


def test_a_step_is_there_once_however_often_it_is_written(tmp_path: Path) -> None:
    with Store(tmp_path / "results.sqlite") as store:
        store.append([Row("sweep", 4, label="first", id=5), Row("sweep", 1, id=2)])
        store.append([Row("sweep", 4, label="late", id=5), Row("sweep", 0, id=1), Row("verification", 4)])
        assert [(row.id, row.step, row.label) for row in store.rows("sweep")] == [
            (1, 0, None),
            (2, 1, None),
            (5, 4, "first"),
        ]
        assert store.count_rows() == 4
        assert list(store.find_missing_steps("sweep", 8)) == [range(2, 4), range(5, 8)]
        assert list(store.find_missing_steps("sweep", 6)) == [range(2, 4), range(5, 6)]
        assert list(store.find_missing_steps("sweep", 5)) == [range(2, 4)] and list(
            store.find_missing_steps("none", 2)
        ) == [range(2)]


def test_results_of_another_advsearch_or_none_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.sqlite"
    with pytest.raises(FileFormatError, match="no such file"):
        Store(path, read_only=True)
    path.write_bytes(b"not a database, but long enough to look like a file of some kind" * 20)
    for read_only in (True, False):
        with pytest.raises(FileFormatError, match="not a database"):
            Store(path, read_only=read_only)
    path.unlink()
    Store(path).close()
    for version in (5, 99):
        with sqlite3.connect(path) as db:
            db.execute(f"PRAGMA user_version = {version}")
            db.execute("UPDATE meta SET value = '2026-11-24T10:00:00Z'")
        db.close()
        for read_only in (True, False):
            with pytest.raises(FileFormatError, match=f"got {version}"):
                Store(path, read_only=read_only)


PLAIN = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(-1e300, 1e300) | st.text()
VALUE = st.fixed_dictionaries({"value": PLAIN | st.lists(PLAIN, max_size=3), "unit": st.text()})


@pytest.fixture(scope="module")
def codec(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """One store for many rows."""
    with Store(tmp_path_factory.mktemp("codec") / "results.sqlite") as store:
        yield store


@pytest.mark.medium
@settings(max_examples=50, deadline=None)
@given(values=st.dictionaries(st.text(), VALUE, max_size=3), objective=st.floats(), label=st.none() | st.text())
def test_any_values_come_back(codec: Store, values: dict[str, Any], objective: float, label: str | None) -> None:
    label = None if label is None else label.encode("utf-8", "replace").decode()
    codec.append([Row("search", codec.count_rows(), objective=objective, label=label, values=values)])
    found = list(codec.rows())[-1]
    assert found.values == values and found.label == label
    assert found.objective == (objective if math.isfinite(objective) else None)


def test_a_second_process_is_refused(run: RunDirectory) -> None:
    code = (
        "import sys; from pathlib import Path; from advsearch.trust.writing import RunLock; RunLock(Path(sys.argv[1]))"
    )
    second = subprocess.run([sys.executable, "-c", code, run.path], capture_output=True, text=True)
    assert f"process {os.getpid()} is working on this run; wait for it or choose another name" in second.stderr
    assert second.returncode != 0


def test_runs_are_numbered(home: Path) -> None:
    paths = []
    for _ in range(2):
        with RunDirectory.create(default="mug-texture") as run:
            run.append_rows(Row("search", 0))
            paths.append(run.path)
    assert paths == [Path("runs/mug-texture-001"), Path("runs/mug-texture-002")]
    Path("runs/mug-texture-0999").mkdir()
    with RunDirectory.create(default="mug-texture") as run:
        assert run.path == Path("runs/mug-texture-1000")


def test_no_two_runs_get_one_number(home: Path) -> None:
    made: list[Path] = []

    def make() -> None:
        with RunDirectory.create() as run:
            made.append(run.path)

    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(made)) == 8


def test_an_existing_run_is_refused_and_overwritten_on_request(tmp_path: Path) -> None:
    path = tmp_path / "run"
    with RunDirectory.create(path) as run:
        run.append_rows(Row("search", 0))
        run.save_image("clean", np.zeros((4, 4, 3)))
        run.write_summary(attack())
    (path / "notes.txt").write_text("mine")
    with pytest.raises(RunExistsError, match="overwrite"):
        RunDirectory.create(path)
    with RunDirectory.create(path, overwrite=True) as run:
        assert run.store.count_rows() == 0
        assert sorted(found.name for found in path.iterdir()) == [
            ".lock", "notes.txt", "results.sqlite", "results.sqlite-shm", "results.sqlite-wal",
        ]  # fmt: skip


@pytest.mark.parametrize("name", ["run.yaml", "results.sqlite", "images"])
def test_a_folder_that_is_no_run_is_never_touched(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("model: mine\n")
    with pytest.raises(RunExistsError, match="not a run"):
        RunDirectory.create(tmp_path, overwrite=True)
    assert (tmp_path / name).read_text() == "model: mine\n"
    assert not (tmp_path / ".lock").exists()


def test_a_run_that_fails_before_any_result_leaves_nothing(home: Path) -> None:
    config = AttackConfig(object="mug")
    with pytest.raises(InputError, match="no such label"), RunDirectory.create_for(config):
        assert Path("runs/mug-texture-001/run.yaml").is_file()
        raise InputError("no such label")
    assert not list(Path("runs").iterdir())


@pytest.mark.parametrize("keep", ["row", "summary"])
def test_a_run_that_fails_later_keeps_what_it_has(tmp_path: Path, keep: str) -> None:
    with pytest.raises(KeyboardInterrupt), RunDirectory.create(tmp_path / "run") as run:
        run.append_rows(Row("search", 0)) if keep == "row" else run.write_summary(attack(ending="interrupted"))
        raise KeyboardInterrupt
    assert (tmp_path / "run" / "results.sqlite").exists()
    with RunDirectory.create(tmp_path / "run", overwrite=True):
        pass


GONE_ON: dict[str, Callable[[RunDirectory], object]] = {
    "record": lambda run: run.append_rows(Row("search", 1)),
    "write_summary": lambda run: run.write_summary(attack()),
    "forget": lambda run: run.store.delete_cached(),
    "create": lambda run: RunDirectory.create(run.path / "parts" / "00"),
    "nothing": lambda run: None,
}


@pytest.mark.parametrize("what", GONE_ON)
@pytest.mark.parametrize("how", ["removed", "renamed", "another"])
def test_a_run_whose_folder_went_ends_with_a_sentence_and_leaves_nothing(tmp_path: Path, what: str, how: str) -> None:
    """Nor does it touch a run that another process has put in its place."""
    path, other = tmp_path / "run", tmp_path / "moved"
    with pytest.raises(StorageError, match="removed or renamed"):
        with RunDirectory.create(path) as run:
            run.append_rows(Row("search", 0))
            shutil.rmtree(path) if how == "removed" else path.rename(other)
            if how == "another":
                shutil.copytree(other, path)
                (path / "summary.json").write_text("of the other")
            GONE_ON[what](run)
    kept = {"results.sqlite", ".lock", "summary.json"}
    assert ({one.name for one in path.iterdir()} >= kept) if how == "another" else not path.exists()
    if how != "removed":
        with RunDirectory.resume(other) as found:
            assert found.store.count_rows() == 1


def test_runs_are_found_by_name_and_path(home: Path) -> None:
    with RunDirectory.create_for(AttackConfig(object="mug")) as run:
        run.append_rows(Row("search", 0))
    for name in ("mug-texture-001", "runs/mug-texture-001", "runs/mug-texture-001/run.yaml"):
        assert find_run(name) == Path("runs/mug-texture-001")
    with pytest.raises(UnknownNameError, match="mug-texture-001"):
        find_run("mug-textur")


@pytest.mark.parametrize(
    ("setting", "value", "file"),
    [
        ("camera", "camchain.yaml#cam1", "camchain.yaml"), ("path", "approach+way.csv", "way.csv"),
        ("model", "reference@weights.safetensors", "weights.safetensors"),
        ("controls", {"patch": {"picture": "sticker.png"}}, "sticker.png"),
    ],
)  # fmt: skip
def test_a_run_does_not_go_on_with_another_file(home: Path, setting: str, value: object, file: str) -> None:
    Path("folder").mkdir()
    Path(file).write_text("one")
    open_regular(Path(file), "what is opened for a control", 10).close()
    over: dict[str, Any] = {"over": {"path": {}}} if setting == "path" else {}
    config = AttackConfig(object="mug", run="first", **over, **{setting: value})
    for wanted in ("one", "another", "one"):
        Path(file).write_text(wanted)
        if wanted == "another":
            with pytest.raises(InputError, match=Path(file).parts[0]):
                RunDirectory.resume("first", config)
        else:
            (RunDirectory.resume("first", config) if Path("runs").is_dir() else RunDirectory.create_for(config)).close()


def _raises(number: int) -> Any:
    def fail(*_: Any, **__: Any) -> Any:
        raise OSError(number, os.strerror(number))

    return fail


def test_a_file_is_replaced_only_when_all_went_well(tmp_path: Path) -> None:
    path = write_text(tmp_path / "deep" / "summary.json", "old")
    with pytest.raises(ValueError, match="half way"), replace_file(path) as part:
        part.write_text("ne")
        raise ValueError("half way")
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["summary.json"]


@pytest.mark.parametrize(
    ("number", "named"), [(errno.ENOSPC, "the disk is full"), (errno.EACCES, "there is no permission")]
)
def test_a_bad_disk_is_said_and_leaves_nothing(
    run: RunDirectory, monkeypatch: pytest.MonkeyPatch, number: int, named: str
) -> None:
    run.write_summary(attack(ending="old"))
    with monkeypatch.context() as broken:
        broken.setattr("os.replace", _raises(number))
        writes: list[Callable[[], object]] = [
            lambda: run.save_image("clean", np.zeros((4, 4, 3))),
            lambda: run.save_exr("clean", np.zeros((4, 4, 3))),
            lambda: run.save_animation("search", [np.zeros((4, 4, 3))]),
            lambda: run.write_summary(attack(ending="new")),
        ]
        for write in writes:
            with pytest.raises(StorageError, match=named):
                write()
    assert not list((run.path / "images").iterdir())
    assert not list(run.path.glob(PART + "*"))
    assert getattr(read_result(run.path), "ending", "") == "old"


def test_a_full_disk_stops_the_store_and_keeps_the_rows_before(run: RunDirectory) -> None:
    run.append_rows(Row("search", 0))
    run.store._db.execute("PRAGMA max_page_count = 8")
    with pytest.raises(StorageError, match="the disk is full"):
        run.append_rows(*(Row("search", step, label="x" * 1000) for step in range(1, 100)))
    assert [row.step for row in run.store.rows()] == [0]


@given(st.lists(st.floats(-1.0, 2.0, width=32), min_size=1, max_size=30))
@settings(max_examples=50, deadline=None)
def test_eight_bits_round_as_verification_does(values: list[float]) -> None:
    expected = [round(float(np.float32(min(max(value, 0.0), 1.0)) * np.float32(255.0))) for value in values]
    assert files.to_8bit(np.array(values, dtype=np.float32)).tolist() == expected


def test_png_round_trip_and_equal_bytes(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((5, 7, 3), dtype=np.float32)
    path = files.write_png(tmp_path / "image.png", image)
    assert path.read_bytes() == files.encode_png(image.copy())
    np.testing.assert_array_equal(files.to_8bit(files.read_png(path)), files.to_8bit(image))
    assert files.read_png(files.write_png(tmp_path / "grey.png", image[..., :1])).shape == (5, 7, 3)
    with pytest.raises(ValueError, match="shape"):
        files.encode_png(np.zeros((5, 7, 4)))


def test_exr_round_trip_is_exact_and_equal_bytes(tmp_path: Path) -> None:
    image = np.random.default_rng(0).normal(scale=1e4, size=(5, 7, 3)).astype(np.float32)
    image[0, 0] = np.inf, -0.0, np.nan
    first, second = (files.write_exr(tmp_path / f"{name}.exr", image) for name in "ab")
    np.testing.assert_array_equal(exr(first), image)
    assert first.read_bytes() == second.read_bytes()
    grey = files.write_exr(tmp_path / "grey.exr", image[..., 1])
    np.testing.assert_array_equal(exr(grey), image[..., 1])


def test_the_log_is_forced_to_the_disk_once_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    forced = []
    with Store(tmp_path / "results.sqlite") as store:
        for step, seconds in enumerate([0.0, 0.5, 0.6, 1.0, 0.9]):
            now[0] += seconds
            store.append([Row("search", step)])
            forced.append(store._db.execute("PRAGMA synchronous").fetchone()[0] == 2)
    assert forced == [True, False, True, True, False]


@pytest.fixture
def filled(run: RunDirectory) -> Store:
    """Rows of three kinds; the values of the second have a column more, and a list."""
    yaw: dict[str, Any] = {"pose.yaw": {"value": 0.1, "unit": "degrees"}}
    target: dict[str, Any] = {
        "camera.target": {"value": [0.5, -1.0], "unit": "sizes"},
        "backdrop.which": {"value": 'a,"b"\n', "unit": ""},
    }
    run.append_rows(
        Row("search", 0, seed=2**63 - 1, spp=8, objective=0.1 + 0.2, success=True, label="bowl", label_index=2,
            probability=0.5, values=yaw, seconds=0.25, renders=1),
        Row("search", 1, objective=math.nan, success=False, label="mug", values={**yaw, **target}, renders=13,
            metrics={"light": 0.25}),
        Row("control", 0, spp=64, success=None),
    )  # fmt: skip
    return run.store


COLUMNS = [
    "id", "kind", "step", "phase", "seed", "spp", "objective", "score", "success", "correct", "margin",
    "label", "label_index", "probability", "payload", "light",
    "pose.yaw [degrees]", "camera.target[0] [sizes]", "camera.target[1] [sizes]", "backdrop.which",
    "renders", "machine", "seconds", "time",
]  # fmt: skip


def exported(store: Store, format: str, kind: str | None = None) -> bytes:
    """The bytes that standard output would get."""
    stream = io.BytesIO()
    write_rows(store, format, None, stream, kind)
    return stream.getvalue()


def test_csv_has_a_column_for_each_value_with_its_unit_and_rows_in_their_order(filled: Store) -> None:
    first, second, third = csv.DictReader(io.StringIO(exported(filled, "csv").decode(), newline=""))
    assert list(first) == COLUMNS
    assert [row["id"] for row in (first, second, third)] == ["1", "2", "3"]
    assert (first["seed"], first["success"], second["success"], third["success"]) == (str(2**63 - 1), "1", "0", "")
    assert float(first["objective"]) == 0.1 + 0.2 and second["objective"] == ""
    assert (second["camera.target[1] [sizes]"], second["backdrop.which"]) == ("-1.0", 'a,"b"\n')
    assert (first["camera.target[0] [sizes]"], third["pose.yaw [degrees]"], second["renders"]) == ("", "", "13")
    assert [row["light"] for row in (first, second, third)] == ["", "0.25", ""]


def test_json_and_parquet_have_the_same_rows(filled: Store, tmp_path: Path) -> None:
    rows = json.loads(exported(filled, "json"))
    assert [list(row) for row in rows] == [COLUMNS] * 3
    assert rows[0]["objective"] == 0.1 + 0.2 and rows[0]["success"] is True and rows[1]["objective"] is None
    assert rows[2]["success"] is None and rows[1]["camera.target[0] [sizes]"] == 0.5
    out = tmp_path / "rows.parquet"
    assert write_rows(filled, "parquet", out, io.BytesIO()) == 3
    table = pyarrow.parquet.read_table(out)
    assert table.column_names == COLUMNS and table.to_pylist() == rows
    assert str(table.schema.field("seed").type) == "int64" and str(table.schema.field("success").type) == "bool"


def test_runs_are_listed_with_their_state(home: Path) -> None:
    def make(name: str, summary: Result | None, rows: int = 2) -> None:
        with RunDirectory.create_for(AttackConfig(object="mug", controls=["pose"], run=name)) as run:
            run.append_rows(*(Row("search", step) for step in range(rows)))
            if summary is not None:
                run.write_summary(summary)

    make("b-found", attack(verified=rated(19), controls=["pose", "light"]))
    make("a-killed", None, rows=3)
    make("c-ctrl-c", attack(ending="interrupted", verified=None))
    make("d-sweep", sweep(configurations=8, correct=7, accuracy=0.875))
    Path("runs/e-damaged").mkdir()
    Path("runs/e-damaged/results.sqlite").write_bytes(Path("runs/a-killed/results.sqlite").read_bytes()[:100])
    Path("runs/not-a-run").mkdir()
    with RunDirectory.resume("c-ctrl-c"):
        during = {one.name: one.state for one in list_runs(Path("runs"))}
    found = list_runs(Path("runs"))
    assert [one.name for one in found] == ["a-killed", "b-found", "c-ctrl-c", "d-sweep", "e-damaged"]
    assert [one.state for one in found] == ["stopped", "found", "stopped", "finished", "stopped"]
    assert during["c-ctrl-c"] == "running" and during["b-found"] == "found"
    assert [one.rows for one in found] == [3, 2, 2, 2, 0]
    assert [one.outcome for one in found] == ["", "19/20", "vase, unverified", "right in 7 of 8", ""]
    assert [is_finished(Path(one.path)) for one in found] == [False, True, False, True, False]


def test_the_store_is_readable_beside_the_writer(run: RunDirectory) -> None:
    run.append_rows(Row("search", 0))
    with Store(run.path / "results.sqlite", read_only=True) as reader:
        assert reader.count_rows() == 1
        run.append_rows(Row("search", 1))
        assert reader.count_rows() == 2
        with pytest.raises(StorageError, match=r"results\.sqlite: the file system is read-only; choose another place"):
            reader.append([Row("search", 2)])


def test_a_closed_run_is_one_file_and_opens_again(tmp_path: Path) -> None:
    with RunDirectory.create(tmp_path / "run") as run:
        run.append_rows(Row("search", 0))
    assert not list((tmp_path / "run").glob("results.sqlite-*"))
    with Store(tmp_path / "run" / "results.sqlite") as store:
        store.append([Row("search", 1)])
        assert store.count_rows() == 2


def test_a_run_in_work_is_not_overwritten(run: RunDirectory) -> None:
    run.append_rows(Row("search", 0))
    with pytest.raises(InputError, match="is working on this run"):
        RunDirectory.create(run.path, overwrite=True)
    assert run.store.count_rows() == 1


def test_all_that_a_run_writes_is_known_to_overwrite(home: Path) -> None:
    with RunDirectory.create_for(AttackConfig(object="mug", run="all")) as run:
        run.append_rows(Row("search", 0))
        run.save_image("clean", np.zeros((4, 4, 3)))
        run.save_exr("texture", np.zeros((4, 4, 3)), folder="artifacts")
        run.write_summary(attack())
        assert {path.name for path in run.path.iterdir()} - {".lock"} <= set(directory.CONTENTS)


def test_text_is_on_the_disk_when_it_is_written_and_pictures_do_not_wait(
    run: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    forced: list[int] = []
    monkeypatch.setattr("os.fsync", forced.append)
    run.save_image("clean", np.zeros((4, 4, 3)))
    assert len(forced) == 0
    run.write_summary(attack())
    assert len(forced) == 2  # the file and its folder
