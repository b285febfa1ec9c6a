"""Islands are built-in parts that the core does without: they import `advsearch.extend`, and nothing else of ours."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from hidden_islands import read_catalog
from test_architecture import ROOT, imports, python_files

BUILT_INS = read_catalog()

CORE = {
    "experiment": {"attack", "sweep", "render"},
    "control": {"pose", "camera", "texture", "material", "light", "environment", "geometry"},
    "policy": {"auto", "cmaes", "nes", "grid", "random", "pgd"},
    "task": {"classification", "detection"},
    "model source": set[str](),
    "recognizer": set[str](),
    "exporter": set[str](),
    "reader": {"obj", "ply", "stl", "gltf", "glb", "vrm"},
    "converter": set[str](),
    "predictor": {"matrix"},
    "cluster": set[str](),
}
"""The built-in parts that are no islands, by kind."""

OTHER_ISLANDS = {
    "advsearch.questions.photographs": "photographs of runs",
    "advsearch.questions.report": "command report",
}
"""Islands that no table of parts has, with what they are; `advsearch.registry` imports them by name."""

ELSEWHERE = {"advsearch.cli.report": "advsearch.questions.report", "advsearch.testing": "advsearch.questions.test"}
"""Modules that belong to an island, but stand where users or the command line look for them."""

COMMAND_LINE = ("advsearch.cli", "advsearch.cli.main", "advsearch.cli.output")
"""What the command of an island, which stands in the command line, may import too."""


def island_of_module() -> dict[str, str]:
    """Return the module or package of each island, with the names of its parts."""
    islands = dict(OTHER_ISLANDS)
    for part in BUILT_INS:
        if part.name not in CORE[part.kind]:
            module = part.import_path.partition(":")[0]
            islands[module] = f"{islands[module]}, {part.name}" if module in islands else f"{part.kind} {part.name}"
    return islands


def find_island(module: str) -> str | None:
    """Return the island that a module belongs to: its own, or that of a package that it is in."""
    islands = island_of_module()
    while module:
        module = ELSEWHERE.get(module, module)
        if module in islands:
            return module
        module = module.rpartition(".")[0]
    return None


@cache
def list_modules() -> frozenset[str]:
    """Return the name of every module of the package."""
    return frozenset(name for name, _ in python_files())


@cache
def find_imports(module: str, path: Path) -> frozenset[str]:
    """Return the modules that a file imports, also those of `from advsearch.models import address`.

    Those that only type checkers import do not count.
    """
    tree = ast.parse(path.read_text("utf-8"))
    names = set(imports(module, path)) | imported_names(tree)
    for node in tree.body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            names -= imported_names(ast.Module(node.body, []))
    return frozenset(name for name in names if name in list_modules())


def imported_names(tree: ast.AST) -> set[str]:
    """Return the modules, and the names in them, of all `from ... import ...` in a file or a part of one."""
    names = set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.update([node.module, *(f"{node.module}.{alias.name}" for alias in node.names)])
    return names


def wrong_imports() -> Iterator[tuple[str, str]]:
    """Yield each file of an island with what it imports of the package, other than the interface and its own parts."""
    for module, path in python_files():
        island = find_island(module)
        if island is None:
            continue
        for name in sorted(find_imports(module, path)):
            is_own = name == island or name.startswith(f"{island}.")
            if module.startswith("advsearch.cli.") and name in COMMAND_LINE:
                continue
            if name not in ("advsearch", "advsearch.extend") and not is_own:
                yield str(path.relative_to(ROOT)), name


def test_islands_import_only_the_interface() -> None:
    broken = [f"{path} imports {name}" for path, name in wrong_imports()]
    assert broken == []


def test_the_core_imports_no_island() -> None:
    broken = [
        f"{path.relative_to(ROOT)} imports {name}"
        for module, path in python_files()
        if find_island(module) is None
        for name in find_imports(module, path)
        if find_island(name) is not None
    ]
    assert broken == []


USE_WITHOUT = """
import json, os, sys
sys.path.append("tests")
import hidden_islands
import mitsuba, scipy.stats, torch  # once, for all children
from advsearch.catalog import BUILT_INS, list_built_ins

def hide(modules):
    hidden_islands.hide(modules)
    list_built_ins.cache_clear()

def list_parts():
    return [[part.kind, part.name] for part in BUILT_INS if part.name in list_built_ins(part.kind)]

def use_parts():
    import advsearch.cli.main
    from advsearch.attacks.policies import POLICIES
    from advsearch.cluster.workers import CLUSTERS
    from advsearch.controls import CONTROLS
    from advsearch.engine.prediction import PREDICTORS
    from advsearch.models.loading import SOURCES
    from advsearch.runs.exporters import EXPORTERS
    from advsearch.scene.importing.readers import READERS, get_reader, list_suffixes
    from advsearch.tasks import TASKS
    registries = (CONTROLS, POLICIES, TASKS, SOURCES, EXPORTERS, READERS, PREDICTORS, CLUSTERS)
    assert all(registry[name] for registry in registries for name in registry)
    assert all(get_reader(suffix) for suffix in list_suffixes())

singly, by_kind = json.loads(sys.argv[1])
for module in singly:
    hide([module])
    print(json.dumps([module, list_parts()]))
for kind, modules in by_kind.items():
    sys.stdout.flush()
    if os.fork():
        assert os.wait()[1] == 0, kind
        continue
    hide(modules)
    use_parts()
    print(json.dumps([kind, list_parts()]))
    sys.stdout.flush()
    os._exit(0)
"""


@pytest.mark.slow
def test_without_any_island_the_other_parts_are_there_and_can_be_used() -> None:
    """Each island is hidden singly, and all of a kind together: then everything else is imported."""
    every = [[part.kind, part.name] for part in BUILT_INS]
    module_of = {(part.kind, part.name): part.import_path.partition(":")[0] for part in BUILT_INS}
    by_kind: dict[str, set[str]] = {}
    for part in BUILT_INS:
        if part.name not in CORE[part.kind]:
            by_kind.setdefault(part.kind, set()).add(module_of[part.kind, part.name])
    asked = [sorted(set().union(*by_kind.values())), {kind: sorted(modules) for kind, modules in by_kind.items()}]
    done = subprocess.run(
        [sys.executable, "-c", USE_WITHOUT, json.dumps(asked)], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    answers = dict(json.loads(line) for line in done.stdout.splitlines())
    for name, left in answers.items():
        hidden = by_kind.get(name, {name})
        assert left == [part for part in every if module_of[part[0], part[1]] not in hidden], name
    assert set(answers) == {*asked[0], *by_kind}
