"""The rules of the house, read from the source: who may import whom, what is shipped, what is pinned, what is heavy."""

import ast
import configparser
import fnmatch
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "advsearch"

RENDERER = {"mitsuba", "drjit", "mitsuba_oidn"}
COMMON = {
    "calls",
    "catalog",
    "copies",
    "distributions",
    "described",
    "errors",
    "files",
    "interrupts",
    "options",
    "pictures",
    "registry",
    "seeds",
    "threads",
    "progress",
    "trust",
    "version",
}
"""Small modules, and the room of guards, that anyone may import and that import nobody but each other."""


@dataclass(frozen=True)
class Rule:
    """What a room may import.

    Attributes:
        rooms: of advsearch, besides itself and `COMMON`; None means all but the command line.
        packages: the third-party packages it may import; None means all that are not forbidden.
        forbidden: third-party packages it must not import.
    """

    rooms: set[str] | None
    packages: set[str] | None = None
    forbidden: frozenset[str] = frozenset()


HEAVY = frozenset(RENDERER | {"torch"})
RULES = {
    **{name: Rule(set(), {"numpy"}, HEAVY) for name in COMMON},
    "pictures": Rule(set(), {"numpy", "PIL"}, HEAVY),
    "trust": Rule(set(), {"torch", "yaml"}, frozenset(RENDERER)),  # torch where it guards what torch does
    "progress": Rule({"report"}, {"rich"}),
    # typing_extensions for the type checker only
    "settings": Rule(set(), {"pydantic", "yaml", "typing_extensions"}),
    "config": Rule({"settings"}, {"pydantic", "yaml", "typing_extensions"}),
    "scene": Rule(set()),
    "bundled": Rule(set()),
    "controls": Rule({"scene"}),
    "models": Rule(set(), {"torch", "numpy", "safetensors"}),
    "tasks": Rule({"models"}, {"torch"}),
    "statistics": Rule(set(), {"numpy", "scipy"}, HEAVY),
    "attacks": Rule({"tasks", "statistics"}, {"torch", "numpy", "scipy", "cma", "ribs"}),
    "cluster": Rule({"scene"}, set()),
    "engine": Rule(
        {"scene", "bundled", "controls", "models", "tasks", "attacks", "cluster", "runs", "report", "viewer", "config"}
        | {"settings", "statistics"}
    ),
    "runs": Rule(
        {"config", "settings"},
        {"numpy", "pydantic", "typing_extensions", "imageio", "OpenEXR", "PIL", "pandas", "pyarrow"},
    ),
    "report": Rule({"runs", "config", "settings"}, {"numpy", "pandas", "PIL", "matplotlib", "pydantic"}, HEAVY),
    # its server shows the pages of sweeps and photographs
    "viewer": Rule({"runs", "report", "config", "settings", "questions"}, {"numpy", "pandas", "PIL"}, HEAVY),
    "rules": Rule({"statistics", "runs"}, {"numpy", "pandas"}, HEAVY),
    "losses": Rule({"attacks", "engine"}, {"torch"}),
    "predictors": Rule({"extend"}, {"torch", "numpy", "scipy"}, frozenset(RENDERER)),
    "maite": Rule({"scene", "models", "tasks", "engine"}, {"torch"}),
    "experiment": Rule({"runs", "report", "viewer", "api", "settings"}, {"pydantic"}, HEAVY),
    "questions": Rule(None, None, frozenset(RENDERER)),
    "testing": Rule({"questions"}, set()),
    "api": Rule(None),
    "extend": Rule(None, set()),
    "cli": Rule(None),
    "": Rule(
        {"api", "attacks", "controls", "engine", "losses", "maite", "models", "questions", "tasks", "testing"}, set()
    ),
}
"""As in docs/design.md, "Packages and imports". The empty name is `advsearch/__init__.py`."""

OF_AN_ISLAND = dict.fromkeys(("dask", "distributed"), "advsearch.cluster.dask_executor")
"""Packages that only one module may import, an island, and which."""

DISTRIBUTIONS = {"PIL": "pillow", "yaml": "PyYAML", "mitsuba_oidn": "mitsuba-oidn"}
"""Where a package is installed under another name than it is imported."""

BROUGHT_ALONG = {"drjit": "mitsuba", "typing_extensions": "pydantic"}
"""Imported, but pinned by another package on purpose: Mitsuba works with exactly one version of Dr.Jit, and types of
pydantic's classes are written with its own typing_extensions."""

OPTIONAL = {
    "pyarrow": "parquet",
    "textual_image": "terminal",
    "distributed": "dask",
    "dask": "dask",
    "ribs": "archive",
    "shtab": "completion",
}
"""Packages that only an extra brings, and which: imported inside a function that says what to do where it is not."""


OF_A_PROCESS = {f"advsearch.scene.importing.usd.{name}": "pxr" for name in ("layers", "stage", "surface")}
"""Modules that run in a process of their own, and what only they import, which an extra brings."""


def python_files() -> list[tuple[str, Path]]:
    """Every module of the package: dotted name and file."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found.append((".".join(parts).removesuffix(".__init__"), path))
    return found


@cache
def imports(module: str, path: Path) -> frozenset[str]:
    """Every module that a file imports anywhere in it, functions and type checking included; relative ones resolved."""
    names: set[str] = set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parent = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parent, *([node.module] if node.module else [])])
            # `from advsearch import threads` names the module threads, `from advsearch import __version__` does not
            names.update(f"{base}.{a.name}" if base == "advsearch" else base for a in node.names)
    return frozenset(names)


def room(module: str) -> str:
    """The room of one of our modules: the first name below `advsearch`; empty for the package itself.

    `python -m advsearch` is the command line's front door, so `__main__` belongs to its room.
    """
    name = module.split(".")[1] if "." in module else ""
    if name == "__main__":
        return "cli"
    return name if (PACKAGE / name).is_dir() or (PACKAGE / f"{name}.py").is_file() else ""


def broken_rules() -> Iterator[str]:
    """Every import that its room's rule does not allow."""
    for module, path in python_files():
        own = room(module)
        rule = RULES.get(own)
        if rule is None:
            yield f"{path.relative_to(ROOT)}: the room {own!r} has no rule in {Path(__file__).name}"
            continue
        for name in imports(module, path):
            top = name.split(".")[0]
            if top == "advsearch":
                verdict = _room_allowed(own, room(name), rule)
            elif top in sys.stdlib_module_names:
                verdict = True
            elif top in OF_AN_ISLAND:
                verdict = module == OF_AN_ISLAND[top]
            else:
                verdict = top not in rule.forbidden and (rule.packages is None or top in rule.packages)
            if not verdict:
                yield f"{path.relative_to(ROOT)} imports {name}"


def _room_allowed(own: str, other: str, rule: Rule) -> bool:
    if other == own or other in COMMON or (other == "" and own not in COMMON):
        return True
    if other == "cli":
        return False
    return rule.rooms is None or other in rule.rooms or other == "extend"  # islands are in many rooms, see test_islands


@pytest.mark.medium
def test_rooms_import_only_what_they_may() -> None:
    assert sorted(broken_rules()) == []


LIGHT = {"settings", "summary", "result", "wording", "figures", "page"}
"""What a room has for those who only read or show a result."""

BASES = ("attack", "sweep")
"""The questions that others stand on, each on those before it."""


def questions() -> Iterator[tuple[str, str, Path, list[str]]]:
    """Every module of a question: the question, the rest of its name, its file, and what of ours it imports."""
    for module, path in python_files():
        parts = module.split(".")
        if parts[1:2] == ["questions"] and len(parts) > 3:
            yield parts[2], ".".join(parts[3:]), path, [one for one in imports(module, path) if one.startswith("advs")]


def test_a_question_knows_another_only_by_what_carries_it_out_and_its_result() -> None:
    """But attacks and sweeps, on which the others stand; these know no other."""
    broken = []
    for question, _, path, names in questions():
        below = BASES[: BASES.index(question)] if question in BASES else BASES
        for parts in (name.split(".") for name in names if name.startswith("advsearch.questions.")):
            known = parts[2] == question or parts[2] in below
            seen = question not in BASES and parts[3:4] in (["carry_out"], ["result"])
            if not known and not seen:
                broken.append(
                    f"{path.relative_to(ROOT)} imports {'.'.join(parts)}: take what both need out of the room"
                )
    assert broken == []


def test_nothing_below_the_questions_imports_one_of_them() -> None:
    above, server = {"questions", "api", "cli", "extend", "testing", ""}, "advsearch.viewer.server"
    broken = [
        f"{path.relative_to(ROOT)} imports {name}: find it by `advsearch.registry`"
        for module, path in python_files()
        if room(module) not in above and module != server
        for name in imports(module, path)
        if name.startswith("advsearch.questions.")
    ]
    assert broken == []


def test_a_result_is_read_and_shown_without_what_renders() -> None:
    heavy = ("advsearch.engine", "advsearch.scene", "advsearch.api", "advsearch.models", "advsearch.tasks")
    broken = [
        f"{path.relative_to(ROOT)} imports {name}"
        for question, module, path, names in questions()
        if module in LIGHT and (question not in BASES or module != "result")  # theirs are what Python gets
        for name in names
        if name.startswith(heavy) or name.endswith(".carry_out")
    ]
    assert broken == []


def test_only_the_backend_speaks_mitsuba() -> None:
    """And the probe of `advsearch doctor`; predictors that trace rays get it with their interface. A mesh's names
    stand once.
    """
    backend = "advsearch.scene.mitsuba_backend"
    variant = f"{backend}.variant"
    users: dict[str, set[str]] = {}
    for module, path in python_files():
        if not module.startswith(backend):
            for name in imports(module, path):
                if name == variant or name.split(".")[0] in RENDERER:
                    users.setdefault(name, set()).add(module)
    probe = "advsearch.cli.doctor_probe"
    assert users == {"drjit": {probe}, "mitsuba_oidn": {probe}, variant: {probe, "advsearch.api.prediction"}}
    for name, only in (("vertex_positions", f"{backend}.meshes"), ("llvm_ad_rgb", variant)):
        assert [module for module, path in python_files() if name in path.read_text(encoding="utf-8")] == [only]


def test_every_picture_is_opened_as_one_of_some_formats() -> None:
    """Pillow runs Ghostscript for what is an EPS, whatever its file is called."""
    opened = [
        text for _, path in python_files() for text in re.findall(r"Image\.open\([^\n]*", path.read_text("utf-8"))
    ]
    assert len(opened) > 8 and [text for text in opened if "formats=" not in text] == []


IMPORT_LINE = re.compile(r"\s*import \w+(, \w+)*$", re.MULTILINE)


def test_scripts_that_other_programs_run_are_python() -> None:
    """Blender and child processes run them, and stand-ins take their place in tests."""
    scripts = list[tuple[str, str]]()
    for name, path in python_files():
        nodes = list(ast.walk(ast.parse(path.read_text("utf-8"))))
        pieces = {id(value) for node in nodes if isinstance(node, ast.JoinedStr) for value in node.values}
        texts = [node.value for node in nodes if isinstance(node, ast.Constant) and id(node) not in pieces]
        scripts += [(name, text) for text in texts if isinstance(text, str) and IMPORT_LINE.match(text)]
    assert {name.split(".")[-1] for name, _ in scripts} >= {"cycles", "blender", "llvm"}
    for name, script in scripts:
        compile(script, name, "exec")


def test_everything_imported_is_a_declared_dependency() -> None:
    declared = {canonicalize_name(one.name) for one in requirements("install_requires")}
    for module, path in python_files():
        for name in imports(module, path):
            top = name.split(".")[0]
            if top == "advsearch" or top in sys.stdlib_module_names or top in OPTIONAL:
                continue
            if OF_A_PROCESS.get(module) == top:
                continue
            assert name not in OF_A_PROCESS, f"{path.relative_to(ROOT)} imports {name}"
            distribution = BROUGHT_ALONG.get(top) or DISTRIBUTIONS.get(top, top)
            assert canonicalize_name(distribution) in declared, f"{path.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize(("package", "extra"), OPTIONAL.items())
def test_an_optional_package_is_an_extra_and_imported_lazily(package: str, extra: str) -> None:
    brought, always = requirements(extra, "options.extras_require"), requirements("install_requires")
    (one,) = [one for one in brought if canonicalize_name(one.name) == canonicalize_name(package)]
    assert str(one) in [str(other) for other in requirements("dev", "options.extras_require")], "tests need it too"
    assert canonicalize_name(package) not in {canonicalize_name(other.name) for other in always}
    users = [path for module, path in python_files() if package in {n.split(".")[0] for n in imports(module, path)}]
    assert users, f"nothing imports {package}"
    for path in users:
        outside = [one for one in ast.parse(path.read_text(encoding="utf-8")).body if _imports(one, package)]
        assert not outside, f"{path.relative_to(ROOT)} imports {package} as soon as it is imported itself"


def _imports(statement: ast.stmt, package: str) -> bool:
    """Whether a statement of a module imports a package when the module is imported, in a branch too."""
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef)):
        return False
    if isinstance(statement, ast.Import):
        return any(alias.name.split(".")[0] == package for alias in statement.names)
    if isinstance(statement, ast.ImportFrom):
        return (statement.module or "").split(".")[0] == package
    inner = (one for one in ast.iter_child_nodes(statement) if isinstance(one, (ast.stmt, ast.excepthandler)))
    return any(_imports(one, package) for one in inner)  # type: ignore[arg-type]


LATE = ("torch", "mitsuba", "drjit", "scipy", "matplotlib", "pandas", "pyarrow", "dask", "distributed")
SHOW_HEAVY = f"import sys; print([m for m in {LATE} if m in sys.modules])"


@pytest.mark.medium
@pytest.mark.parametrize(
    "code",
    [
        "import advsearch, advsearch.errors, advsearch.seeds, advsearch.threads, advsearch.settings, advsearch.config",
        "import advsearch.runs, advsearch.report, advsearch.scene, advsearch.scene.assets\n"
        "import advsearch.scene.mitsuba_backend.llvm",
        "import contextlib, io\n"
        "from advsearch.cli.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit): main(['--help'])\n"
        "assert 'attack' in text.getvalue()",
        "from advsearch.registry import EXPERIMENTS, get_experiment\n"
        "assert [get_experiment(name).result for name in EXPERIMENTS]",
    ],
    ids=["small modules", "rooms", "help", "questions"],
)
def test_nothing_heavy_is_imported_before_it_is_needed(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", f"{code}\n{SHOW_HEAVY}"], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


@pytest.mark.medium
def test_an_attack_on_what_is_bundled_needs_little() -> None:
    """torch's compilers take two seconds, and only files of `torch.export` need them; a quarter of one goes to
    scipy.stats, which draws from nets."""
    code = (
        "import sys, advsearch.questions.attack.carry_out, advsearch.models.reference\n"
        "advsearch.engine.loading.load_scene('mug', 'studio')\n"
        "print([m for m in ('torch._dynamo', 'networkx', 'scipy.stats') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@cache
def setup_cfg() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    return parser


def requirements(key: str, section: str = "options") -> list[Requirement]:
    return [Requirement(line) for line in setup_cfg()[section][key].split("\n") if line]


def test_every_folder_with_python_files_is_listed_as_a_package() -> None:
    packages = {module for module, path in python_files() if path.name == "__init__.py"}
    assert set(setup_cfg()["options"]["packages"].split()) == packages
    unlisted = {path.parent for _, path in python_files() if not (path.parent / "__init__.py").is_file()}
    assert unlisted == set(), "Python files in a folder without __init__.py are not shipped"
    assert [path for path in PACKAGE.rglob("*") if path.is_symlink()] == [], "what is shipped lies in the package"


def test_every_data_file_is_listed_as_package_data() -> None:
    patterns = {package: value.split(", ") for package, value in setup_cfg()["options.package_data"].items()}
    for package in ("advsearch.bundled", "advsearch.models"):
        folder = ROOT.joinpath(*package.split("."))
        for path in (folder / "data").rglob("*"):
            name = path.relative_to(folder).as_posix()
            shipped = any(fnmatch.fnmatch(name, pattern.replace("**/", "*")) for pattern in patterns[package])
            assert shipped or path.is_dir(), f"{name} matches none of {package}'s patterns"


@cache
def pins() -> dict[str, list[Requirement]]:
    """The lines of constraints.txt by canonical name."""
    found: dict[str, list[Requirement]] = {}
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            one = Requirement(line)
            found.setdefault(canonicalize_name(one.name), []).append(one)
    return found


@pytest.mark.parametrize("version", ["3.10", "3.11", "3.12", "3.13"])
def test_every_dependency_has_one_pin_within_its_range_for_every_python(version: str) -> None:
    def counts(one: Requirement) -> bool:
        where = {"python_version": version, "python_full_version": version + ".0"}
        return one.marker is None or one.marker.evaluate(where)

    for one in filter(counts, requirements("install_requires") + requirements("dev", "options.extras_require")):
        fitting = [pin for pin in pins().get(canonicalize_name(one.name), []) if counts(pin)]
        assert len(fitting) == 1, f"{one.name} on Python {version}: {fitting}"
        (specifier,) = fitting[0].specifier
        assert specifier.operator == "==" and one.specifier.contains(specifier.version)


def test_what_the_dependencies_need_is_pinned_too() -> None:
    wanted = {canonicalize_name(one.name) for one in requirements("install_requires")}
    wanted |= {canonicalize_name(one.name) for one in requirements("dev", "options.extras_require")}
    seen: set[str] = set()
    while wanted - seen:
        name = (wanted - seen).pop()
        seen.add(name)
        for text in metadata.requires(name) or []:
            one = Requirement(text)
            if one.marker is None or one.marker.evaluate({"extra": ""}):
                wanted.add(canonicalize_name(one.name))
    cuda = {name for name in seen if name.startswith(("nvidia-", "cuda-")) or name == "triton"}
    assert seen - cuda - set(pins()) == set()


def repository_files() -> list[Path]:
    """Every file that is or would be committed."""
    command = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, capture_output=True, check=True).stdout.decode().split("\0")
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed if name and (ROOT / name).is_file()]


@pytest.mark.medium
def test_no_file_names_a_path_of_the_machine_it_was_written_on() -> None:
    here = {re.escape(f"{ROOT}/").encode(), re.escape(f"{Path.home()}/").encode()}
    machine = re.compile(rb"(?<![\w.$}/])/(?:work|root)/|" + b"|".join(sorted(here)))
    found = [
        f"{path.relative_to(ROOT)}: {m[0].decode()}"
        for path in repository_files()
        for m in machine.finditer(path.read_bytes())
    ]
    assert found == []


@pytest.mark.medium
def test_imports_inside_functions_are_few_and_say_why() -> None:
    concepts = runpy.run_path(str(ROOT / "tools" / "concepts.py"))
    inner = {name: concepts["inner_imports"](path.read_text()) for name, path in concepts["modules_of"](ROOT).items()}
    found = {f"{name}:{line}": why for name, imports in inner.items() for line, why in imports.items()}
    bare = sorted(place for place, why in found.items() if not why)
    assert not bare, "each takes a comment, beside it or above it, with the reason why it stands inside"
    assert len(found) <= 214, "see whether this one can stand at the top: `advsearch --help` has to answer at once"


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Late imports and those for the type checker counted."""
    concepts = runpy.run_path(str(ROOT / "tools" / "concepts.py"))
    assert concepts["circles"](concepts["modules_of"](ROOT)) == []
