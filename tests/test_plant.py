"""The list of planted faults is true: each stands in the source once, is no slip of syntax, and its tests are there."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import plant
import pytest
from plant import FAULTS, ROOT, Fault, Outcome, found_by, rooms, write

EVERY_ROOM = {
    *("attacks", "cli", "cluster", "config", "controls", "engine", "explain", "exporting", "hardening"),
    *("importing", "mitsuba_backend", "models", "policies", "recipes", "report", "runs", "scene", "sweeps"),
    *("tasks", "viewer"),
}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda one: one.name)
def test_a_fault_is_in_the_source_once(fault: Fault) -> None:
    compile(fault.planted(ROOT), fault.file, "exec")
    assert fault.after != fault.before
    assert fault.tests and all((ROOT / one.partition("::")[0]).is_file() for one in fault.tests)


def test_forty_faults_in_every_room() -> None:
    assert len({one.name for one in FAULTS}) == len(FAULTS) == 40
    assert set(rooms()) == EVERY_ROOM


def test_a_text_that_is_not_there_or_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1\ny = 1\n")
    for before in ("z", "1"):
        with pytest.raises(ValueError, match="expected its text once"):
            Fault("scene: x", "a.py", before, "2", ()).planted(tmp_path)


def test_what_was_compiled_of_a_module_goes(tmp_path: Path) -> None:
    compiled = tmp_path / "__pycache__" / "a.cpython-313.pyc"
    compiled.parent.mkdir()
    compiled.write_bytes(b"")
    write(tmp_path / "a.py", "x = 1\n")
    assert not compiled.exists() and (tmp_path / "a.py").read_text() == "x = 1\n"


@pytest.mark.parametrize(("finds", "words"), [(True, "t.py::test_b[1] (2 s)"), (False, None)])
def test_a_test_that_fails_without_the_fault_finds_nothing(
    finds: bool, words: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, failing = tmp_path / "a.py", set[str]()
    file.write_text("x = 1\n")

    def answered(root: Path, tests: Sequence[str], without: Collection[str] = ()) -> Outcome:
        fault = file.read_text() == "x = 2\n"
        fails = ["t.py::test_a[0]"] if "t.py::test_a" not in without else []
        fails += ["t.py::test_b[1]"] if fault and finds else []
        return Outcome(next((one for one in fails if one.startswith(tuple(tests))), None), 2.0)

    monkeypatch.setattr(plant, "outcome", answered)
    assert found_by(tmp_path, Fault("scene: x", "a.py", "1", "2", ("t.py",)), failing) == words
    assert failing == {"t.py::test_a"} and file.read_text() == "x = 1\n"
