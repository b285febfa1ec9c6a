"""Islands are built-in parts that the core does without: they import `advsearch.extend`, and nothing else of ours."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from test_architecture import PACKAGE, ROOT, imports, python_files

from advsearch.catalog import BUILT_INS

CORE = {
    "experiment": {"attack", "sweep", "render"},
    "control": {"pose", "camera", "texture", "material", "light", "environment", "geometry"},
    "policy": {"auto", "cmaes", "nes", "grid", "random", "sobol", "pgd", "adam", "portfolio", "restarts"},
    "task": {"classification", "detection"},
    "model source": set[str](),
    "exporter": set[str](),
    "reader": {"obj", "ply", "stl", "gltf", "glb", "vrm"},
    "converter": set[str](),
}
"""The built-in parts that are no islands, by kind."""

NOT_YET: frozenset[str] = frozenset(
    {
        "advsearch/attacks/policies/archive.py",
        "advsearch/attacks/policies/mixture.py",
        "advsearch/cli/exporters/dataset.py",
        "advsearch/cli/exporters/projection.py",
        "advsearch/cli/exporters/scene.py",
        "advsearch/cli/exporters/sheets.py",
        "advsearch/cli/exporters/threedb.py",
        "advsearch/controls/background.py",
        "advsearch/controls/body.py",
        "advsearch/controls/contents.py",
        "advsearch/controls/corruption.py",
        "advsearch/controls/haze.py",
        "advsearch/controls/lens.py",
        "advsearch/controls/mitsuba.py",
        "advsearch/controls/occlusion.py",
        "advsearch/controls/patch.py",
        "advsearch/controls/path.py",
        "advsearch/controls/projector.py",
        "advsearch/controls/sensor.py",
        "advsearch/controls/shadow.py",
        "advsearch/controls/sky.py",
        "advsearch/controls/spot.py",
        "advsearch/controls/things.py",
        "advsearch/models/address.py",
        "advsearch/models/zoo/outputs.py",
        "advsearch/models/zoo/transformers.py",
        "advsearch/questions/check/__init__.py",
        "advsearch/questions/check/carry_out.py",
        "advsearch/questions/check/result.py",
        "advsearch/questions/compare/__init__.py",
        "advsearch/questions/compare/pairs.py",
        "advsearch/questions/compare/result.py",
        "advsearch/questions/explain/__init__.py",
        "advsearch/questions/explain/findings.py",
        "advsearch/questions/explain/renders.py",
        "advsearch/questions/explain/result.py",
        "advsearch/questions/harden/__init__.py",
        "advsearch/questions/harden/carry_out.py",
        "advsearch/questions/harden/detectors.py",
        "advsearch/questions/harden/lessons.py",
        "advsearch/questions/harden/result.py",
        "advsearch/questions/harden/rounds.py",
        "advsearch/questions/harden/scenes.py",
        "advsearch/questions/harden/training.py",
        "advsearch/questions/precision/__init__.py",
        "advsearch/questions/precision/benches.py",
        "advsearch/questions/precision/carry_out.py",
        "advsearch/questions/precision/result.py",
        "advsearch/questions/recipe/__init__.py",
        "advsearch/questions/recipe/carry_out.py",
        "advsearch/questions/recipe/description.py",
        "advsearch/questions/recipe/given.py",
        "advsearch/questions/recipe/rates.py",
        "advsearch/questions/recipe/result.py",
        "advsearch/questions/region/__init__.py",
        "advsearch/questions/region/growing.py",
        "advsearch/questions/region/result.py",
        "advsearch/questions/replay/__init__.py",
        "advsearch/questions/replay/conditions.py",
        "advsearch/questions/replay/result.py",
        "advsearch/questions/stability/__init__.py",
        "advsearch/questions/stability/result.py",
        "advsearch/questions/stability/scene.py",
        "advsearch/questions/stability/scenes.py",
        "advsearch/questions/test/__init__.py",
        "advsearch/questions/test/carry_out.py",
        "advsearch/questions/test/claims.py",
        "advsearch/questions/test/counterexamples.py",
        "advsearch/questions/test/result.py",
        "advsearch/questions/test/settings.py",
        "advsearch/scene/importing/blender.py",
        "advsearch/scene/importing/usd.py",
        "advsearch/tasks/answers.py",
        "advsearch/tasks/command.py",
        "advsearch/tasks/depth.py",
        "advsearch/tasks/rig.py",
        "advsearch/tasks/segmentation.py",
        "advsearch/tasks/similarity.py",
    }
)
"""Files of islands that still import more than they may. The list only gets shorter."""

CORE_NOT_YET: frozenset[str] = frozenset(
    {
        "advsearch/api/projection.py",
        "advsearch/cli/show.py",
        "advsearch/engine/journal.py",
        "advsearch/questions/attack/run.py",
        "advsearch/questions/report/evidence.py",
        "advsearch/questions/report/recorded.py",
        "advsearch/scene/cycles.py",
        "advsearch/scene/importing/usd_layers.py",
        "advsearch/scene/importing/usd_stage.py",
        "advsearch/testing.py",
    }
)
"""Files of the core that still import an island. The list only gets shorter."""


def island_of_module() -> dict[str, str]:
    """Return the module or package of each island, with the names of its parts."""
    islands: dict[str, str] = {}
    for part in BUILT_INS:
        if part.name not in CORE[part.kind]:
            module = part.target.partition(":")[0]
            islands[module] = f"{islands[module]}, {part.name}" if module in islands else f"{part.kind} {part.name}"
    return islands


def find_island(module: str) -> str | None:
    """Return the island that a module belongs to: its own, or that of a package that it is in."""
    islands = island_of_module()
    while module:
        if module in islands:
            return module
        module = module.rpartition(".")[0]
    return None


def wrong_imports() -> Iterator[tuple[str, str]]:
    """Yield each file of an island with what it imports of the package, other than the interface and its own parts."""
    for module, path in python_files():
        island = find_island(module)
        if island is None:
            continue
        for name in sorted(imports(module, path)):
            is_own = name == island or name.startswith(f"{island}.")
            if name.startswith("advsearch") and name != "advsearch.extend" and not is_own:
                yield str(path.relative_to(ROOT)), name


def test_islands_import_only_the_interface() -> None:
    broken = [f"{path} imports {name}" for path, name in wrong_imports() if path not in NOT_YET]
    assert broken == []


def test_files_that_are_mended_leave_the_list() -> None:
    assert sorted(NOT_YET - {path for path, _ in wrong_imports()}) == []


def test_the_core_imports_no_island() -> None:
    broken = [
        f"{path.relative_to(ROOT)} imports {name}"
        for module, path in python_files()
        if find_island(module) is None and module not in ("advsearch", "advsearch.extend")  # both for type checkers
        for name in imports(module, path)
        if find_island(name) is not None
    ]
    assert [line for line in broken if line.partition(" imports ")[0] not in CORE_NOT_YET] == []
    assert sorted(CORE_NOT_YET - {line.partition(" imports ")[0] for line in broken}) == []


def test_the_interface_states_each_name_once_for_editors_and_once_for_python() -> None:
    tree = ast.parse((PACKAGE / "extend.py").read_text("utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    for_editors = {
        alias.name: f"{node.module}.{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    from advsearch import extend

    for_python = {name: f"{module}.{name}" for name, module in extend._MODULE_OF_NAME.items()} | extend._MODULES
    assert for_editors == for_python
    assert len(for_python) <= 60
    assert all(getattr(extend, name) is not None for name in extend.__all__)


def read_documented_names(page: Path) -> set[str]:
    """Return the names that a page imports from the interface in its examples."""
    names = set[str]()
    for line in page.read_text("utf-8").splitlines():
        _, found, imported = line.strip().partition("from advsearch.extend import ")
        if found:
            names.update(name.strip() for name in imported.split(","))
    return names
