"""Parts are listed in the catalog or come from packages; without one of them the tool works."""

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
from advsearch import registry
from advsearch.catalog import BUILT_INS, is_module_installed
from advsearch.experiment import Experiment
from advsearch.settings import HEADER
from test_islands import CORE

PACKAGE = Path(advsearch.__file__).parent
REMOVABLE = [part for part in BUILT_INS if part.kind == "experiment" and part.name not in CORE["experiment"]]


@pytest.mark.island("all")
def test_every_part_of_the_catalog_is_there_and_is_what_it_says() -> None:
    for part in BUILT_INS:
        assert is_module_installed(part.import_path.partition(":")[0]), part
        assert not part.help.endswith("."), part
    for name, experiment in registry.EXPERIMENTS.items():
        assert isinstance(experiment, Experiment)
        assert experiment.settings.command == name and experiment.result.command == name


def copy_package(folder: Path, without: tuple[str, ...] = ()) -> None:
    """Copy the package into a folder, without some of its experiments."""
    shutil.copytree(PACKAGE, folder / "advsearch", ignore=shutil.ignore_patterns("__pycache__"))
    for name in without:
        path = folder / "advsearch" / "questions" / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.with_suffix(".py").unlink()


RUN = """
import contextlib, io, json, sys
from advsearch.cli.main import main
from advsearch.config import CONFIGS
results = [list(CONFIGS)]
for words in json.loads(sys.argv[1]):
    out = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)  # tables are written as bytes
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()) as error:
        status = main(words)
    results.append([status, out.buffer.getvalue().decode(), error.getvalue()])
print(json.dumps(results))
"""


def run_commands(folder: Path, *commands: list[str]) -> tuple[list[str], list[tuple[int, str, str]]]:
    """Run commands of the package in a folder, in one process, and return the names of its configurations and of each
    command the status, the output and the messages."""
    done = subprocess.run(
        [sys.executable, "-c", RUN, json.dumps(commands)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    configurations, *results = json.loads(done.stdout)
    return configurations, [tuple(result) for result in results]


SMALL = ["--control", "pose", "--resolution", "32", "--spp", "2", "--run"]
ATTACK = ["attack", "--object", "mug", "--steps", "2", "--trials", "6", "--verify-spp", "2", "--no-baseline"]


@pytest.mark.medium
def test_without_all_removable_experiments_the_tool_works(tmp_path: Path) -> None:
    names = tuple(part.name for part in REMOVABLE)
    copy_package(tmp_path, names)
    configurations, (shown_help, listed, unknown, attacked) = run_commands(
        tmp_path, ["--help"], ["list", "objects"], ["harden"], [*ATTACK, *SMALL, "kept", "--json"]
    )
    assert configurations == ["attack", "render", "sweep"]
    assert shown_help[0] == 0 and "  attack " in shown_help[1]
    assert not [name for name in names if f"\n  {name} " in shown_help[1]]
    assert listed[0] == 0 and "mug" in listed[1]
    assert unknown[0] == 2 and "unknown command 'harden'" in unknown[2]
    assert attacked[0] == 0, attacked[2]
    assert (tmp_path / "runs" / "kept" / "report.html").is_file()


def list_removable_modules() -> dict[str, list[str]]:
    """Return the modules of parts outside the core, each with its parts as "kind name"."""
    found: dict[str, list[str]] = {}
    for part in BUILT_INS:
        is_core = part.name in CORE[part.kind]
        if part.kind not in ("experiment", "model source") and not is_core:
            found.setdefault(part.import_path.partition(":")[0], []).append(f"{part.kind} {part.name}")
    return found


@pytest.mark.medium
def test_without_all_removable_parts_the_tool_works(tmp_path: Path) -> None:
    copy_package(tmp_path)
    for module in list_removable_modules():
        path = tmp_path.joinpath(*module.split("."))
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.with_suffix(".py").unlink()
    _, (listed, *done) = run_commands(
        tmp_path,
        ["list", "controls"],
        ["sweep", "--object", "mug", "--samples", "2", *SMALL, "swept"],
        [*ATTACK, *SMALL, "attacked", "--json"],
        ["export", "attacked", "--out", "rows.csv"],
    )
    assert {line.split()[0] for line in listed[1].splitlines()} == CORE["control"]
    assert [status for status, _, _ in done] == [0, 0, 0], done


@pytest.mark.island("all")
def test_no_control_imports_another_one() -> None:
    modules = {part.import_path.partition(":")[0] for part in BUILT_INS if part.kind == "control"}
    found = set()
    for module in modules:
        spec = importlib.util.find_spec(module)
        assert spec is not None and spec.origin is not None
        for node in ast.walk(ast.parse(Path(spec.origin).read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module in modules - {module}:
                found.add((module, node.module))
    assert found == set()


SETUP = """from setuptools import setup

setup(
    name="advsearch-count",
    version="1",
    py_modules=["advsearch_count"],
    entry_points={"advsearch.experiments": ["count = advsearch_count:count"]},
)
"""


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
