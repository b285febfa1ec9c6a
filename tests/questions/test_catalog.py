"""Parts are listed in the catalog or come from packages; without one of them the tool works."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import advsearch
from advsearch.catalog import BUILT_INS
from advsearch.settings import HEADER

PACKAGE = Path(advsearch.__file__).parent


CORE = ("attack", "sweep", "render")


REMOVABLE = [part for part in BUILT_INS if part.kind == "experiment" and part.name not in CORE]


CORE_PARTS = {
    "control": "pose camera texture material light environment geometry",
    "policy": "random grid pgd adam cmaes nes auto sobol restarts portfolio", "task": "classification detection",
    "reader": "obj ply stl gltf glb vrm",
}  # fmt: skip


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


def list_removable_modules() -> dict[str, list[str]]:
    """Return the modules of parts outside the core, each with its parts as "kind name"."""
    found: dict[str, list[str]] = {}
    for part in BUILT_INS:
        is_core = part.name in CORE_PARTS.get(part.kind, "").split()
        if part.kind not in ("experiment", "model source") and not is_core:
            found.setdefault(part.target.partition(":")[0], []).append(f"{part.kind} {part.name}")
    return found


SETUP = """from setuptools import setup

setup(
    name="advsearch-count",
    version="1",
    py_modules=["advsearch_count"],
    entry_points={"advsearch.experiments": ["count = advsearch_count:count"]},
)
"""


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


def test_without_all_removable_parts_the_tool_works(tmp_path: Path) -> None:
    copy_package(tmp_path)
    for module in list_removable_modules():
        path = tmp_path.joinpath(*module.split("."))
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.with_suffix(".py").unlink()
    listed = run_python(tmp_path, "-m", "advsearch", "list", "controls")
    assert listed.returncode == 0, listed.stderr
    assert [line.split()[0] for line in listed.stdout.splitlines()] == CORE_PARTS["control"].split()
    words = ["--control", "pose", "--resolution", "32", "--spp", "2", "--run"]
    swept = run_python(tmp_path, "-m", "advsearch", "sweep", "--object", "mug", "--samples", "2", *words, "swept")
    assert swept.returncode == 0, swept.stderr
    attack = ["attack", "--object", "mug", "--steps", "2", "--trials", "6", "--verify-spp", "2", "--no-baseline"]
    attacked = run_python(tmp_path, "-m", "advsearch", *attack, *words, "attacked", "--json")
    assert attacked.returncode == 0, attacked.stderr
    exported = run_python(tmp_path, "-m", "advsearch", "export", "attacked", "--out", "rows.csv")
    assert exported.returncode == 0, exported.stderr


def test_no_control_imports_another_one() -> None:
    modules = {part.target.partition(":")[0] for part in BUILT_INS if part.kind == "control"}
    found = set()
    for module in modules:
        spec = importlib.util.find_spec(module)
        assert spec is not None and spec.origin is not None
        for node in ast.walk(ast.parse(Path(spec.origin).read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module in modules - {module}:
                found.add((module, node.module))
    assert found == set()


@pytest.mark.medium
def test_the_experiment_of_the_docs_is_a_package_of_its_own(tmp_path: Path) -> None:
    """The package is installed in a folder of the Python path; command, page and Python know the experiment."""
    design = (Path(__file__).parents[2] / "docs" / "design.md").read_text()
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", design, re.DOTALL) if "@experiment" in block]
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    (source / "advsearch_count.py").write_text(code)
    (source / "setup.py").write_text(SETUP)
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*install, "--target", str(site), str(source)], check=True, capture_output=True)
    for name in ("first", "second"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.yaml").write_text(HEADER)

    def run(*words: str) -> str:
        environment = {**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{PACKAGE.parent}"}
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "  count       count the files that runs have" in run("-m", "advsearch", "--help")
    counted = run("-m", "advsearch", "count", "--runs", "first,second", "--json", "--run", "kept")
    assert json.loads(counted)["files"] == {"first": 1, "second": 1}
    assert "There are 2 files." in run("-m", "advsearch", "show", "kept")
    repeated = run("-m", "advsearch", "run", "runs/kept/run.yaml", "runs=first", "--json", "--run", "again")
    assert json.loads(repeated)["files"] == {"first": 1}
    called = "import advsearch, inspect; from advsearch import count; print(inspect.signature(count)); "
    python = run("-c", f"{called} print(count('first', run='third'), advsearch.load_run('third'))")
    assert "(runs: 'str | Path'" in python and python.count("files={'first': 1}") == 2
