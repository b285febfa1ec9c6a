"""The list of planted faults is true: each stands in the source once, is no slip of syntax, and its tests are there."""

from __future__ import annotations

from pathlib import Path

import pytest
from plant import FAULTS, ROOT, Fault, rooms, write

EVERY_ROOM = {
    *("attacks", "cli", "cluster", "config", "controls", "engine", "explanations", "exporting", "hardening"),
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
