"""A question is a room: without its folder the tool works, and says that there is no such command."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import advsearch
from advsearch import registry
from advsearch.settings import HEADER

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
        "import advsearch.questions.report.evidence, advsearch.questions.explain; print(*CONFIGS)"
    )
    known = told("-c", asked)
    assert known.returncode == 0, known.stderr
    assert {"attack", "sweep", "explain"} <= {*known.stdout.split()} and not {*GONE} & {*known.stdout.split()}
    unknown = told("-m", "advsearch", "harden")
    assert unknown.returncode == 2 and "unknown command 'harden'" in unknown.stderr


def test_every_room_has_what_finds_it() -> None:
    for name in registry.rooms():
        config, result, ask = (registry.part_of(name, part) for part in ("config", "result", "from_config"))
        if config is not None:
            assert config.command == name and result.command == name
            assert ask is not None


def test_the_question_of_the_docs_is_one_file(tmp_path: Path) -> None:
    """No other place is edited, and command, file, page and Python know it."""
    design = (Path(__file__).parents[2] / "docs" / "design.md").read_text()
    (written,) = [block for block in re.findall(r"```python\n(.*?)```", design, re.DOTALL) if "@question" in block]
    shutil.copytree(
        Path(advsearch.__file__).parent, tmp_path / "advsearch", ignore=shutil.ignore_patterns("__pycache__")
    )
    (tmp_path / "advsearch" / "questions" / "count.py").write_text(written)
    for name in ("first", "second"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.yaml").write_text(HEADER)

    def told(*words: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "  count       count the files that runs have" in told("-m", "advsearch", "--help")
    helped = told("-m", "advsearch", "count", "--help")
    assert "Count the files that runs have." in helped and "advsearch count --runs mug-texture-001" in helped
    asked = told("-m", "advsearch", "count", "--runs", "first,second", "--json", "--run", "kept")
    assert json.loads(asked)["files"] == {"first": 1, "second": 1}
    assert "There are 2 files." in told("-m", "advsearch", "show", "kept")
    assert "There are 2 files." in (tmp_path / "runs" / "kept" / "report.html").read_text()
    again = told("-m", "advsearch", "run", "runs/kept/run.yaml", "runs=first", "--json", "--run", "again")
    assert json.loads(again)["files"] == {"first": 1}
    called = "import advsearch, inspect; from advsearch import count; print(inspect.signature(count)); "
    python = told("-c", f"{called} print(count('first', run='third'), advsearch.load_run('third'))")
    assert "(runs: 'str | Path'" in python and python.count("files={'first': 1}") == 2
