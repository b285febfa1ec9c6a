"""Parts are listed in the catalog or come from packages; without one of them the tool works."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import advsearch
from advsearch.catalog import BUILT_INS

PACKAGE = Path(advsearch.__file__).parent
CORE = ("attack", "sweep", "render")
REMOVABLE = [part for part in BUILT_INS if part.kind == "experiment" and part.name not in CORE]
"""Parts that are not removed, those in their modules included."""


def copy_package(folder: Path, without: tuple[str, ...] = ()) -> None:
    """Copy the package into a folder, without some of its experiments."""
    shutil.copytree(PACKAGE, folder / "advsearch", ignore=shutil.ignore_patterns("__pycache__"))
    for name in without:
        path = folder / "advsearch" / "questions" / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.with_suffix(".py").unlink()


def run_python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.medium
def test_without_all_removable_experiments_the_tool_works(tmp_path: Path) -> None:
    names = tuple(part.name for part in REMOVABLE)
    copy_package(tmp_path, names)
    shown_help = run_python(tmp_path, "-m", "advsearch", "--help")
    assert shown_help.returncode == 0, shown_help.stderr
    assert "  attack " in shown_help.stdout
    assert not [name for name in names if f"\n  {name} " in shown_help.stdout]
    listed = run_python(tmp_path, "-m", "advsearch", "list", "objects")
    assert listed.returncode == 0 and "mug" in listed.stdout
    unknown = run_python(tmp_path, "-m", "advsearch", "harden")
    assert unknown.returncode == 2 and "unknown command 'harden'" in unknown.stderr
    imports = (
        "import advsearch; from advsearch.config import CONFIGS; import advsearch.viewer.pages; "
        "import advsearch.questions.attack.carry_out, advsearch.questions.sweep.carry_out; print(*CONFIGS)"
    )
    known = run_python(tmp_path, "-c", imports)
    assert known.returncode == 0, known.stderr
    assert known.stdout.split() == ["attack", "render", "sweep"]
    attacked = run_python(
        tmp_path,
        *("-m", "advsearch", "attack", "--object", "mug", "--control", "pose", "--steps", "2", "--trials", "6"),
        *("--resolution", "32", "--spp", "2", "--verify-spp", "2", "--no-baseline", "--run", "kept", "--json"),
    )
    assert attacked.returncode == 0, attacked.stderr
    assert (tmp_path / "runs" / "kept" / "report.html").is_file()
