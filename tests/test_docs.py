"""The documentation can't drift: names, flags, tables, numbers, links and examples are held to the code."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import pytest
import reference_calibration as calibration
import reference_scenes
import torch
from PIL import Image
from samples import attack

import advsearch
import advsearch.config
from advsearch.api import region as mapping
from advsearch.attacks import (
    POLICIES,
    clopper_pearson,
    make_policy,
    planned_renders,
    region,
    sample_count,
    smallest,
    verification,
)
from advsearch.attacks.objectives import OBJECTIVE_KINDS, check_objective
from advsearch.attacks.policies import pgd
from advsearch.attacks.verification import WORST_CASE
from advsearch.cli.export import WRITERS
from advsearch.cli.flags import config_from
from advsearch.cli.list import REGISTRIES
from advsearch.cli.main import COMMANDS, _parse
from advsearch.config import (
    CONFIGS,
    TRIALS,
    TRIALS_OVER,
    WAYS,
    AttackConfig,
    ExplainConfig,
    HardenConfig,
    RecipeConfig,
    RegionConfig,
    RenderConfig,
    ReplayConfig,
    SceneConfig,
    StabilityConfig,
    SweepConfig,
)
from advsearch.config.attack import FEWEST_TRIALS
from advsearch.config.hardening import ALL
from advsearch.controls import CONTROLS, texture
from advsearch.engine import run_settings, stages
from advsearch.engine.loading import as_controls
from advsearch.engine.sweeps.axes import read_axes
from advsearch.evaluation.stability.suite import chosen
from advsearch.files import MESHES
from advsearch.models import loading, reference
from advsearch.questions.compare.settings import CompareConfig
from advsearch.questions.test.settings import SuiteConfig
from advsearch.questions.test.suite import read_suite
from advsearch.recipes.description import read_recipe
from advsearch.recipes.description import recipe_names as recipes
from advsearch.recipes.parts import planned
from advsearch.runs import directory, export, store
from advsearch.runs.results import KEPT
from advsearch.runs.results.base import Result
from advsearch.runs.results.gap import CurveResult
from advsearch.runs.results.matrix import MatrixResult
from advsearch.runs.results.render import RenderResult
from advsearch.scene import environments, exposure, library
from advsearch.scene.description import FRAME_FILL
from advsearch.scene.importing.images import TEXTURE_LIMIT
from advsearch.scene.importing.scenes import MITSUBA_FILE, split_node
from advsearch.scene.mitsuba_backend import scene as mitsuba_scene
from advsearch.scene.settings import SETTINGS, resolve
from advsearch.settings import Config, parse_assignment, read_yaml, settings
from advsearch.tasks import make_task

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *sorted(DOCS.rglob("*.md"))]
every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())


def script(name: str) -> ModuleType:
    """Import a script of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def blocks(page: Path, language: str) -> Iterator[str]:
    """Yield the fenced blocks of one language, without their indentation."""
    for indent, body in re.findall(rf"^( *)```{language}\n(.*?)^ *```$", page.read_text("utf-8"), re.M | re.S):
        yield re.sub(rf"^{indent}", "", body, flags=re.MULTILINE)


# ---- everything that has a name is documented -----------------------------------------------------------------------


def section_of(command: str) -> str:
    """Return what the page about the command line says of a command."""
    page = (DOCS / "command-line.md").read_text("utf-8")
    section = re.search(rf"^## {command}\n(.*?)(?=^## |\Z)", page, re.M | re.S)
    assert section is not None
    return section[1]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_section_with_an_example(command: str) -> None:
    assert f"\nadvsearch {command}" in section_of(command)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_flag_of_every_command_is_in_its_section(command: str) -> None:
    known = script("make_figures").flags_of(command) - {"--json", "--quiet"}
    section = section_of(command)
    assert command != "attack" or len(known) > 30
    if "All flags of `attack` but" in section:
        known -= script("make_figures").flags_of("attack")
    assert not [flag for flag in known if f"`{flag}`" not in section]


def test_the_page_says_which_commands_can_be_quiet() -> None:
    page = " ".join((DOCS / "command-line.md").read_text("utf-8").split())
    said = page.partition("also take `--quiet`")[2].partition(".")[0]
    quiet = {command for command in COMMANDS if "--quiet" in script("make_figures").flags_of(command)}
    assert set(re.findall(r"`([a-z]+)`", said)) == quiet


def test_every_flag_of_attack_is_in_the_command_line_page() -> None:
    page = (DOCS / "command-line.md").read_text("utf-8")
    missing = [one.flag for one in settings(AttackConfig) if f"| `{one.flag}` |" not in page]
    assert not missing


@pytest.mark.parametrize("kind", CONTROLS)
def test_every_control_has_a_page_with_its_parameters_settings_and_an_example(kind: str) -> None:
    page = (DOCS / "controls" / f"{kind}.md").read_text("utf-8")
    declared = [one.name for one in CONTROLS[kind].parameters] + [one.name for one in CONTROLS[kind].choices]
    assert not [name for name in declared if f"| `{name}` |" not in page]
    assert f"--control {kind}" in page


@pytest.mark.parametrize("name", POLICIES)
def test_every_policy_has_a_page_or_a_row_with_an_example(name: str) -> None:
    page, overview = DOCS / "policies" / f"{name}.md", (DOCS / "policies" / "README.md").read_text("utf-8")
    assert f"\n| [`{name}`]({name}.md) |" in overview if page.exists() else f"\n| `{name}` |" in overview
    assert f"--policy {name}" in (page.read_text("utf-8") if page.exists() else overview)


@pytest.mark.parametrize("name", POLICIES)
def test_every_option_of_a_policy_is_in_its_row_with_its_default(name: str) -> None:
    overview = (DOCS / "policies" / "README.md").read_text("utf-8")
    row = re.search(rf"^\| \[?`{name}`.*$", overview, re.MULTILINE)
    assert row is not None
    options = row[0].rpartition(" | ")[2]
    said = dict(re.findall(r"`([a-z0-9_]+)` \(([^)]*)\)", options))
    declared = {one.name: one.default for one in fields(POLICIES[name])}  # type: ignore[arg-type]
    assert set(said) == set(declared)
    for option, default in declared.items():
        if isinstance(default, (bool, int, float)):
            stated = re.split(r"[:;,]\s*", said[option].rpartition("; ")[2] or said[option])[0].strip("` ")
            assert stated == f"{default:g}" if not isinstance(default, bool) else stated == str(default).lower()


@pytest.mark.parametrize("name", OBJECTIVE_KINDS)
def test_every_objective_has_a_row_and_an_example(name: str) -> None:
    page = (DOCS / "objectives.md").read_text("utf-8")
    assert f"| `{name}` |" in page
    assert f"--objective {name}" in page


def test_everything_bundled_and_every_scene_parameter_is_in_the_page_about_scenes() -> None:
    page = (DOCS / "scenes.md").read_text("utf-8")
    names = [*SETTINGS, *library.list_objects(), *library.list_environments()]
    assert not [name for name in names if f"| `{name}` |" not in page]
    endings = (*MESHES, *environments.SUFFIXES)
    assert not [ending for ending in endings if f"`{ending}`" not in page]


def test_every_option_of_load_model_is_in_the_page_about_models() -> None:
    page = (DOCS / "models.md").read_text("utf-8")
    options = set(inspect.signature(loading.load_model).parameters) - {"spec", "name", "max_batch"}
    assert not [option for option in options if f"{option}=" not in page and f"`{option}`" not in page]


def test_every_kind_that_list_knows_is_in_the_command_line_page() -> None:
    page = (DOCS / "command-line.md").read_text("utf-8")
    assert not [kind for kind in REGISTRIES if f"`{kind}`" not in page]


def test_every_make_target_is_in_the_page_about_development() -> None:
    page = (DOCS / "development.md").read_text("utf-8")
    targets = re.findall(r"^([a-z-]+):.*?## ", (ROOT / "Makefile").read_text("utf-8"), re.M)
    assert len(targets) > 10
    assert not [target for target in targets if f"`{target}`" not in page and f"make {target}" not in page]


def test_every_benchmark_is_in_the_table() -> None:
    page = (DOCS / "design.md").read_text("utf-8")
    scripts = [path.name for path in (ROOT / "benchmarks").glob("[!_]*.py")]
    assert scripts and not [name for name in scripts if f"| [`{name}`]" not in page]


@pytest.mark.parametrize("kind", [*KEPT, CurveResult, MatrixResult, RenderResult], ids=lambda kind: kind.__name__)
def test_every_field_of_a_result_has_a_type_and_most_say_what_they_hold(kind: type[Result]) -> None:
    assert kind.__doc__ and kind.command
    silent = {name for name, field in kind.model_fields.items() if not script("make_figures")._field(field)}
    assert silent <= PLAIN, "say what these hold in Field(description=...)"


PLAIN = {
    *(
        "object",
        "objects",
        "task",
        "environment",
        "controls",
        "model",
        "policy",
        "objective",
        "loss",
        "run",
        "ending",
        "depth",
    ),
    *("specialised", "interrupted", "figures", "seconds", "seed", "spp", "goal", "renders_per_gradient"),
}
"""Fields that say themselves."""


def test_every_column_of_an_exported_table_is_in_the_page_about_runs() -> None:
    page = (DOCS / "runs.md").read_text("utf-8")
    said = {name for row in re.findall(r"^\| (`.*?) \|", page, re.M) for name in re.findall(r"`([a-z_]+)`", row)}
    assert not {*export.OWN, *export.AFTER} - said
    assert {*export.OWN, *export.AFTER, "values", "metrics"} == {one.name for one in fields(store.Row)}
    assert all(f"`{format}`" in page for format in export.FORMATS)


def test_everything_that_a_run_writes_is_in_the_page_about_runs() -> None:
    page = (DOCS / "runs.md").read_text("utf-8").partition("## What survives")[0]
    stems = [name.removesuffix("-journal").removesuffix("-wal").removesuffix("-shm") for name in directory.CONTENTS]
    assert not [stem for stem in stems if f"`{stem}" not in page]


# ---- what is made from the code is up to date -----------------------------------------------------------------------


def test_the_made_parts_are_up_to_date() -> None:
    found = [path.relative_to(ROOT).as_posix() for path in script("make_figures").differing()]
    assert not found, "run python docs/make_figures.py"


def test_every_control_and_policy_with_options_has_a_made_part() -> None:
    made = script("make_figures").PARTS
    pages = [f"controls/{kind}.md" for kind in CONTROLS]
    own_pages = [name for name in POLICIES if (DOCS / "policies" / f"{name}.md").exists()]
    pages += [f"policies/{name}.md" for name in own_pages if inspect.signature(POLICIES[name]).parameters]
    assert not [page for page in pages if page not in {page for page, _ in made}]
    for path in sorted(DOCS.rglob("*.md")):
        page = path.relative_to(DOCS).as_posix()
        marked = re.findall(r"<!-- made by docs/make_figures\.py: ([a-z-]+) -->", path.read_text("utf-8"))
        assert set(marked) == {name for known, name in made if known == page}


MADE_BY_HAND = [
    ("design.md", f"**First look**: {stages.FIRST_LOOK} renders of the clean scene"),
    ("design.md", f"That makes `steps` + {planned_renders(0)} renders"),
    ("design.md", f"at {', '.join(map(str, sample_count.LADDER[:-1]))} and {sample_count.LADDER[-1]} samples a pixel"),
    ("design.md", f"is at most {sample_count.DRIFT} of the margin itself"),
    ("design.md", f"**Trials**: {TRIALS} renders (`--trials`; {TRIALS_OVER} with `--over`)"),
    ("design.md", f"must reach {verification.PASS_PERCENT_OVER} % of the trials in which the clean scene is right"),
    ("design.md", f"rounded up: {WORST_CASE.needed(20)} of 20"),
    ("design.md", f"20 of 20 means a true rate of at least {100 * clopper_pearson(20, 20)[0]:.0f} %"),
    ("design.md", f"at most {mitsuba_scene.MAX_DEPTH} segments"),
    ("questions.md", {8: "Eight renders of the best configurations"}[planned_renders(0)]),
    ("questions.md", f"**Verified** by {TRIALS} fresh renders"),
    ("questions.md", f"until they are within {100 * (smallest.RATIO - 1):.0f} % of each other"),
    ("questions.md", {12: "or twelve searches are done"}[smallest.ROUNDS]),
    (
        "questions.md",
        f"What counts on the way is {FEWEST_TRIALS} trials without a failure, or, after one, {TRIALS} in all",
    ),
    ("questions.md", f"**Verified** on {TRIALS_OVER} conditions"),
    ("questions.md", f"needs {verification.PASS_PERCENT_OVER} % of those that count"),
    ("questions.md", {8: "in one to eight parameters"}[mapping.MOST]),
    ("questions.md", {8: "as long as eight random pictures"}[region.PROBES]),
    ("questions.md", {4: "with other seeds, up to four times"}[region.ATTEMPTS]),
    ("questions.md", f"First {mapping.AT_CENTRE} trials of the centre"),
    ("questions.md", f"Then {RegionConfig.model_fields['samples'].default} fresh samples"),
    ("questions.md", f"at most {100 * (1 - clopper_pearson(200, 200)[0]):.1f} % of the box has another verdict"),
    ("runs.md", {1.0: "may lose the rows of the last second"}[store.SYNC_INTERVAL]),
    ("runs.md", f"more than {100 * store.SYNC_SHARE:.0f} % of the time"),
    ("scenes.md", f"reaches to {100 * FRAME_FILL:.0f} % of the way"),
    ("scenes.md", f"gets the linear value {exposure.METERED_WHITE}"),
    ("scenes.md", f"averaged down to at most {TEXTURE_LIMIT} texels"),
    ("scenes.md", "Maps larger than {1} x {0} are".format(*environments.LARGEST)),
    ("controls/texture.md", f"Default {texture.DEFAULT_EPSILON}"),
    ("controls/texture.md", "at least {} and at most {}".format(*texture.RESOLUTIONS)),
    ("policies/pgd.md", f"the first after {100 * pgd.FIRST_WINDOW:.0f} % of the steps"),
    ("policies/pgd.md", {0.75: "fewer than three quarters of the steps"}[pgd.IMPROVING]),
    ("policies/pgd.md", {5: "Five in a row end the search"}[pgd.PATIENCE]),
    ("reference-model.md", {0.25: "A quarter of the pictures is not denoised"}[reference_scenes.RAW_SHARE]),
    ("reference-model.md", "pictures of {} x {} pixels".format(*reference.INPUT_SIZE)),
    ("models.md", "goes in as {} x {}, RGB".format(*loading.DEFAULT_INPUT_SIZE)),
]


@pytest.mark.parametrize(("page", "sentence"), MADE_BY_HAND)
def test_numbers_in_the_text_are_those_of_the_code(page: str, sentence: str) -> None:
    assert sentence in " ".join((DOCS / page).read_text("utf-8").split())


# ---- links and words ------------------------------------------------------------------------------------------------


def prose(page: Path) -> str:
    """Return a page without its code, fenced and inline."""
    text = re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.M | re.S)
    return re.sub(r"`[^`\n]*`", "code", text)


def anchors(page: Path) -> set[str]:
    """Return what `#...` may name in a page: its headings as GitHub spells them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@every_page
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    broken = []
    for target in targets:
        path, _, anchor = target.partition("#")
        if path.startswith(("http://", "https://")):
            continue
        found = (page.parent / path).resolve() if path else page
        if not found.exists() or (anchor and anchor not in anchors(found)):
            broken.append(target)
    assert not broken


def test_every_page_can_be_reached_from_the_readme() -> None:
    seen, todo = set(), [PAGES[0]]
    while todo:
        page = todo.pop()
        if page not in seen:
            seen.add(page)
            targets = re.findall(r"\]\(([^)#\s]+\.md)", prose(page))
            todo += [(page.parent / target).resolve() for target in targets if "://" not in target]
    assert seen == set(PAGES)


@every_page
def test_words_are_british_and_no_path_of_one_machine_is_left(page: Path) -> None:
    assert not re.findall(r"\b\w*(?:color|normaliz|recogniz|gray|behavior)\w*", prose(page), re.I)
    assert not re.findall(r"/(?:work|tmp|home|root)/|\.\./shared", page.read_text("utf-8"))


# ---- examples -------------------------------------------------------------------------------------------------------


def lines(page: Path) -> list[list[str]]:
    """Return the words of every command in a page's shell blocks."""
    joined = (line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines())
    return [words for line in joined if (words := shlex.split(line, comments=True))]


def check_names(config: Config) -> None:
    """Look up every name in a configuration, as its command would; nothing is loaded."""
    if isinstance(config, StabilityConfig):
        chosen(config.cases, config.groups)
        return
    if isinstance(config, CompareConfig) and not config.object:
        assert config.pictures >= 0
        return
    if isinstance(config, ExplainConfig):
        assert config.confirm >= 0
        return
    if isinstance(config, SuiteConfig):
        assert config.suite
        return
    if isinstance(config, ReplayConfig):
        assert set(config.chosen) <= set(WAYS)
        return
    if isinstance(config, RecipeConfig):
        assert config.recipe in ("list", "mine.yaml") or planned(read_recipe(config.recipe), config)
        return
    assert isinstance(config, SceneConfig)
    run_settings.check(config)
    run_settings.given_to(config, config.controls)
    resolve(config.set_)
    lights = config.environments if isinstance(config, SweepConfig) else (config.lit_by,)
    for name in config.objects:
        suffixes = (*MESHES, MITSUBA_FILE)
        assert name in (*library.list_objects(), ALL) or Path(split_node(name)[0]).suffix in suffixes
        needs_label = not isinstance(config, (RenderConfig, HardenConfig)) and name not in library.list_objects()
        assert config.label is not None or not needs_label, "a file does not bring a label"
    for name in lights:
        assert name in library.list_environments() or Path(name).suffix in environments.SUFFIXES
    if isinstance(config, AttackConfig):
        as_controls(config.over)
        make_policy(config.policy_name, **config.policy_options)
        task = make_task(config.task)
        check_objective(
            config.objective or task.objective,
            task.name,
            targeted=config.target is not None,
            minimise=config.minimise,
        )
        known = script("make_figures").stored_record()["labels"]
        assert config.model != "reference" or set((config.target or known[0]).split(",")) <= set(known)
    if isinstance(config, SweepConfig):
        read_axes(config.grid, as_controls(config.controls))


def check_advsearch(words: list[str], folder: Path) -> None:
    """Parse a command with the real parser, and read its settings."""
    args = _parse(words, words[0])
    if args.command in CONFIGS:
        brought = args.command in ("region", "sweep") and ("around" in args or "answer_of" in args)
        otherwise = {"object": "mug"} if brought else {}
        check_names(config_from(args, CONFIGS[args.command], **otherwise))
    if args.command in ("run", "resume"):
        run = Path(args.run).name if args.command == "resume" else ""
        of_a_recipe = run.rpartition("-")[0] in recipes()
        file = folder / "run.yaml"
        file.write_text(f"recipe: {run.rpartition('-')[0]}\n" if of_a_recipe else "object: mug\n", encoding="utf-8")
        config = RecipeConfig if of_a_recipe else SweepConfig if "-sweep-" in run else AttackConfig
        check_names(config.from_yaml(file, dict(parse_assignment(text, text) for text in args.change)))
    if args.command == "export":
        assert args.format in (None, *WRITERS, *export.FORMATS)


def check_other(words: list[str]) -> None:
    """Check that a make target, a module or a script exists."""
    if words[0] == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
        assert words[1] in targets
    elif words[:2] == ["python", "-m"]:
        assert importlib.util.find_spec(words[2]) is not None
    elif words[0] == "python":
        assert (ROOT / words[1]).is_file()
    else:
        assert words == [".", ".venv/bin/activate"], f"an example that no test can check: {shlex.join(words)}"


@every_page
def test_every_command_in_an_example_is_one_that_the_tools_take(page: Path, tmp_path: Path) -> None:
    for words in lines(page):
        command = words[0].removeprefix(".venv/bin/")
        if command == "advsearch":
            check_advsearch(words[1:], tmp_path)
        else:
            check_other([command, *words[1:]])


@every_page
def test_every_yaml_example_is_a_configuration(page: Path, tmp_path: Path) -> None:
    for block in blocks(page, "yaml"):
        if re.search(r"^ *(runs-on|script):", block, re.M):  # of a machine that runs jobs
            commands = re.findall(r"^.*?(?:- |run: )(advsearch .*)$", block, re.M)
            assert commands
            for one in commands:
                check_advsearch(shlex.split(one)[1:], tmp_path)
            continue
        named = re.match(r"# (\S+\.yaml)\n", block)  # others on the page may build on it
        path = tmp_path / (named[1] if named else "example.yaml")
        path.write_text(block, encoding="utf-8")
        if "claims" in read_yaml(path):
            suite = read_suite(path)
            for name in suite.claims:
                check_names(AttackConfig.of(suite.config_of(name)))
            continue
        if "parts" in read_yaml(path):
            read_recipe(str(path))
            continue
        config = CONFIGS[str(read_yaml(path).get("command", "attack"))]
        check_names(config.from_yaml(path))


def parameters(call: str) -> set[str]:
    """Return the keywords that a function of `advsearch` takes."""
    return set(inspect.signature(getattr(advsearch, call)).parameters)


@every_page
def test_every_python_example_compiles_and_names_what_exists(page: Path) -> None:
    for block in blocks(page, "python"):
        tree = ast.parse(block, filename=str(page))
        compile(tree, str(page), "exec")
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module or "")
                assert not [alias.name for alias in node.names if not hasattr(module, alias.name)]
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "advsearch":
                assert node.attr in advsearch.__all__
            if isinstance(node, ast.Call) and re.fullmatch(r"advsearch\.\w+", ast.unparse(node.func)):
                known = parameters(ast.unparse(node.func).removeprefix("advsearch."))
                assert not {keyword.arg for keyword in node.keywords if keyword.arg} - known


@pytest.mark.slow
def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks(PAGES[0], "python"):
        exec(compile(block, "README.md", "exec"), names)
    assert names["result"].search.renders == planned_renders(40)


def test_the_page_about_losses_of_ones_own_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every block, after those before it, with smaller pictures and fewer steps than on the page."""
    page = DOCS / "own-loss.md"
    small = {"steps": 4, "trials": 6, "spp": 2, "verify_spp": 4, "denoise": "none", "measure": "no"}
    names: dict[str, Any] = {}
    endings: list[str] = []
    attacked = advsearch.attack
    monkeypatch.setattr(advsearch, "attack", lambda *asked, **given: attacked(*asked, **{**given, **small}))
    for block in blocks(page, "python"):
        names.pop("result", None)
        exec(compile(block.replace("resolution=48", "resolution=16"), page.name, "exec"), names)
        names.setdefault("quick", {})["resolution"] = 24
        endings += [names["result"].summary.ending] if "result" in names else []
    assert len(endings) == 7 and not {"already wrong"} & {*endings}
    assert names["wrong"] and float(names["u"].grad.abs().max()) > 0.0 and float(names["derivative"].abs().max()) > 0.0


# ---- the scripts ----------------------------------------------------------------------------------------------------


def made_up_record() -> dict[str, Any]:
    """A record as `tools/reference_model.py` writes it, of a model that is right nine times in ten."""
    labels = ["ball", "mug", "wine glass"]
    truth = [index % 3 for index in range(300)]
    logits = torch.nn.functional.one_hot(torch.tensor(truth), 3).float() * 3.0
    logits[::10] = logits[::10].roll(1, dims=1)
    heldout = asdict(calibration.report(logits, truth))
    views = {"ball": 0.91, "mug": 0.97, "wine-glass": 0.8812}
    figures = {"pictures": 16000, "epochs": 16, "seed": 0, "temperature": 1.1, "heldout": heldout}
    return {"schema": 1, "labels": labels, "figures": {**figures, "default_views": views}}


def test_the_figures_of_the_reference_model_come_from_its_record() -> None:
    figures = script("make_figures")
    record = made_up_record()
    part = figures.reference(record)
    assert "| right | 90.0 % (95 % interval 86.0 to 93.2 %) |" in part
    assert "| training pictures | 16,000, seen 16 times, seed 0 |" in part
    assert "| wine glass | 90.0 % | ball (10) | 0.881 |" in part
    wanted = figures.differing(record)
    assert part in wanted[DOCS / "reference-model.md"]
    assert wanted[DOCS / "images" / "reliability.svg"] == figures.reliability_diagram(record["figures"]["heldout"])


def test_without_a_record_the_page_says_so_and_nothing_is_drawn() -> None:
    figures = script("make_figures")
    assert "not been measured" in figures.reference({})
    assert "not been measured" in figures.reference({"labels": ["a", "b"], "figures": {"pictures": 10}})
    assert not [path for path in figures.differing({}) if path.suffix == ".svg"]


def test_the_reliability_diagram_is_an_svg_whose_bars_are_the_bins() -> None:
    heldout = made_up_record()["figures"]["heldout"]
    svg = script("make_figures").reliability_diagram(heldout)
    root = ElementTree.fromstring(svg)
    bars = [one for one in root.iter("{http://www.w3.org/2000/svg}rect") if one.get("fill") == "#4477aa"]
    filled = [one for one in heldout["bins"] if one["count"]]
    assert len(bars) == 2 * len(filled)
    accuracy = [float(one.get("height", "nan")) / 300 for one in bars[::2]]
    assert accuracy == pytest.approx([one["accuracy"] for one in filled], abs=1e-4)


def test_a_part_is_exchanged_and_nothing_else() -> None:
    replaced = script("make_figures").replaced
    page = "a\n<!-- made by docs/make_figures.py: x -->\nold\n<!-- end of x -->\nb\n"
    assert replaced(page, "x", "new\n") == page.replace("old", "new")
    with pytest.raises(ValueError, match="expected one part named 'y'"):
        replaced(page, "y", "new\n")


def test_the_picture_and_the_answer_in_the_readme_are_made_from_a_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    for name, grey in (("images/clean", 40), ("images/adversarial", 120), ("artifacts/texture", 200)):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (16, 16), (grey, grey, grey)).save(run / f"{name}.png")
    summary = attack(object="path/to/mug.obj")
    images = script("make_images")
    sheet = images.side_by_side(run, summary)
    centres = [sheet.getpixel((images.SIDE // 2 + number * (images.SIDE + images.GAP), 9)) for number in range(3)]
    assert centres == [(40, 40, 40), (120, 120, 120), (200, 200, 200)]
    readme = images.with_answer(PAGES[0].read_text("utf-8"), summary)
    assert "The model calls this mug a vase in 20 of 20 fresh renders" in readme
    assert "runs/mug-texture-001\n```\n<!-- end -->" in readme


def test_the_readme_shows_an_answer() -> None:
    shown = (
        PAGES[0].read_text("utf-8").partition("<!-- made by docs/make_images.py -->")[2].partition("<!-- end -->")[0]
    )
    assert "fresh renders" in shown, "run python docs/make_images.py RUN"
