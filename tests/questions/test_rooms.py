"""A question is a room: without its folder the tool works, and says that there is no such command."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import advsearch
from advsearch import rooms

GONE = ("recipe", "harden", "stability")


def test_without_the_folders_of_three_questions_the_tool_works(tmp_path: Path) -> None:
    package = Path(advsearch.__file__).parent
    shutil.copytree(package, tmp_path / "advsearch", ignore=shutil.ignore_patterns("__pycache__"))
    for name in GONE:
        shutil.rmtree(tmp_path / "advsearch" / "questions" / name)

    def told(*words: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        return subprocess.run(
            [sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )

    helped = told("-m", "advsearch", "--help")
    assert helped.returncode == 0 and "  attack " in helped.stdout and "  explain " in helped.stdout
    assert not [name for name in GONE if f"\n  {name} " in helped.stdout]
    listed = told("-m", "advsearch", "list", "objects")
    assert listed.returncode == 0 and "mug" in listed.stdout
    asked = (
        "import advsearch; from advsearch.config import CONFIGS; import advsearch.viewer.pages; "
        "import advsearch.questions.attack.carry_out; "
        "import advsearch.questions.report.evidence, advsearch.questions.explain.carry_out; print(*CONFIGS)"
    )
    known = told("-c", asked)
    assert known.returncode == 0, known.stderr
    assert {"attack", "sweep", "explain"} <= {*known.stdout.split()} and not {*GONE} & {*known.stdout.split()}
    unknown = told("-m", "advsearch", "harden")
    assert unknown.returncode == 2 and "unknown command 'harden'" in unknown.stderr


def test_every_room_has_what_finds_it() -> None:
    for name in rooms.rooms():
        if rooms.in_room(name, "settings", "CONFIG") is not None:
            assert rooms.in_room(name, "settings", "CONFIG").command == name
            assert rooms.in_room(name, "carry_out", f"{name}_from_config") is not None
            assert rooms.in_room(name, "answer", "RESULT").command == name
