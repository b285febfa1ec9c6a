"""The examples in the documentation run or are read; what holds its words to the code is tools/check_docs.py."""

import ast
import importlib.util
import inspect
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from check_docs import DOCS, PAGES, ROOT, blocks, name_of, script

import advsearch
import advsearch.config
from advsearch.attacks import count_planned_renders, make_policy
from advsearch.attacks.objectives import check_objective
from advsearch.cli.flags import make_config
from advsearch.cli.main import _parse
from advsearch.config import CONFIGS, RenderConfig, SceneConfig
from advsearch.engine.acceptance import compare_views, compare_with_traced
from advsearch.engine.loading import make_controls
from advsearch.engine.naming import check_run_settings, make_configured_controls
from advsearch.files import MESHES
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.compare import CompareConfig
from advsearch.questions.explain import ExplainConfig
from advsearch.questions.harden.result import ALL_OBJECTS, HardenConfig
from advsearch.questions.recipe.description import list_recipes as recipes
from advsearch.questions.recipe.description import plan_runs, read_recipe
from advsearch.questions.recipe.result import RecipeConfig
from advsearch.questions.replay.result import RENDER_METHODS, ReplayConfig
from advsearch.questions.stability.result import StabilityConfig
from advsearch.questions.stability.scenes import select_cases
from advsearch.questions.sweep.axes import parse_axes
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.test.settings import SuiteConfig, read_suite
from advsearch.questions.twins.result import TwinsConfig
from advsearch.runs import export
from advsearch.runs.exporters import EXPORTERS
from advsearch.scene import library
from advsearch.scene.importing.scenes import MITSUBA_SUFFIX, split_node_argument
from advsearch.scene.places.place_file import is_place_file, read_place_file
from advsearch.scene.rig import read_rig
from advsearch.scene.settings import resolve_settings
from advsearch.settings import Config, parse_assignment, read_yaml
from advsearch.tasks import make_task

pytestmark = pytest.mark.island("all")

every_page_with = {
    language: pytest.mark.parametrize("page", having, ids=[name_of(page) for page in having])
    for language in ("sh", "yaml", "python")
    if (having := [page for page in PAGES if any(blocks(page, language))])
}


def lines(page: Path) -> list[list[str]]:
    """Return the words of every command in a page's shell blocks."""
    joined = (line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines())
    return [words for line in joined if (words := shlex.split(line, comments=True))]


def check_names(config: Config) -> None:
    """Look up every name in a configuration, as its command would; nothing is loaded."""
    if isinstance(config, StabilityConfig):
        select_cases(config.cases, config.groups)
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
        assert set(config.selected_names) <= set(RENDER_METHODS)
        return
    if isinstance(config, RecipeConfig):
        assert config.recipe in ("list", "mine.yaml") or plan_runs(read_recipe(config.recipe), config)
        return
    if isinstance(config, TwinsConfig):
        assert config.photographs
        return
    assert isinstance(config, SceneConfig)
    check_run_settings(
        config.model_copy(update=dict.fromkeys(("path", "shutter", "rolling"))) if config.command == "sweep" else config
    )
    make_configured_controls(config, config.controls)
    resolve_settings(config.set_)
    lights = config.environments if isinstance(config, SweepConfig) else (config.environment_name,)
    for name in config.objects:
        suffixes = (*MESHES, MITSUBA_SUFFIX)
        assert name in (*library.list_objects(), ALL_OBJECTS) or Path(split_node_argument(name)[0]).suffix in suffixes
        needs_label = not isinstance(config, (RenderConfig, HardenConfig)) and name not in library.list_objects()
        assert config.label is not None or not needs_label, "a file does not bring a label"
    for name in lights:
        is_file = Path(name).suffix in library.ENVIRONMENT_SUFFIXES or is_place_file(name)
        assert name in library.list_environments() or is_file
    if isinstance(config, AttackConfig):
        make_controls(config.over)
        make_policy(config.policy_name, **config.policy_options)
        task = make_task(config.task)
        check_objective(
            config.objective or task.objective, task.name, targeted=config.target is not None, minimise=config.minimise
        )
        known = script("make_figures").stored_record()["labels"]
        assert config.model != "reference" or set((config.target or known[0]).split(",")) <= set(known)
    if isinstance(config, SweepConfig):
        parse_axes(config.grid, make_controls(config.controls))


def check_advsearch(words: list[str], folder: Path) -> None:
    """Parse a command with the real parser, and read its settings."""
    args = _parse(words, words[0])
    if args.command in CONFIGS:
        brought = args.command in ("region", "sweep") and ("around" in args or "adversarial_of" in args)
        otherwise = {"object": "mug"} if brought else {}
        check_names(make_config(args, CONFIGS[args.command], **otherwise))
    if args.command in ("run", "resume"):
        run = Path(args.run).name if args.command == "resume" else ""
        of_a_recipe = run.rpartition("-")[0] in recipes()
        file = folder / "run.yaml"
        file.write_text(f"recipe: {run.rpartition('-')[0]}\n" if of_a_recipe else "object: mug\n", encoding="utf-8")
        config = RecipeConfig if of_a_recipe else SweepConfig if "-sweep-" in run else AttackConfig
        check_names(config.from_yaml(file, dict(parse_assignment(text, text) for text in args.change)))
    if args.command == "export":
        assert args.format in (None, *EXPORTERS, *export.FORMATS)


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


@pytest.mark.medium
@every_page_with["sh"]
def test_every_command_in_an_example_is_one_that_the_tools_take(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poses.txt").write_text("0 6 0 1 0 0 0 1\n1 4 0 1 0 0 0 1\n")  # a trajectory that a page names
    for words in lines(page):
        command = words[0].removeprefix(".venv/bin/")
        if command == "advsearch":
            check_advsearch(words[1:], tmp_path)
        else:
            check_other([command, *words[1:]])


@every_page_with["yaml"]
def test_every_yaml_example_is_a_configuration(page: Path, tmp_path: Path) -> None:
    for block in blocks(page, "yaml"):
        if re.search(r"^ *(runs-on|script):", block, re.M):  # of a machine that runs jobs
            commands = re.findall(r"^.*?(?:- |run: )(advsearch .*)$", block, re.M)
            given = re.search(r"advsearch@.*\n +with: (\{.*\})", block)
            inputs = yaml.safe_load((Path(__file__).parents[1] / "action.yml").read_text("utf-8"))["inputs"]
            assert commands or (given and yaml.safe_load(given[1]).keys() <= inputs.keys())
            for one in commands:
                check_advsearch(shlex.split(one)[1:], tmp_path)
            continue
        named = re.match(r"# (\S+\.yaml)\n", block)  # others on the page may build on it
        path = tmp_path / (named[1] if named else "example.yaml")
        path.write_text(block, encoding="utf-8")
        if "claims" in read_yaml(path):
            suite = read_suite(path)
            for name in suite.claims:
                check_names(AttackConfig.from_config(suite.make_config(name)))
            continue
        if "cameras" in read_yaml(path):
            assert len(read_rig(str(path))) > 1
            continue
        if "mesh" in read_yaml(path):
            assert read_place_file(path).lights
            continue
        if "parts" in read_yaml(path):
            read_recipe(str(path))
            continue
        config = CONFIGS[str(read_yaml(path).get("command", "attack"))]
        check_names(config.from_yaml(path))


def parameters(call: str) -> set[str]:
    """Return the keywords that a function of `advsearch` takes."""
    return set(inspect.signature(getattr(advsearch, call)).parameters)


@every_page_with["python"]
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
    assert names["result"].search.renders == count_planned_renders(40)


def code_with(page: str, word: str) -> dict[str, Any]:
    """Run the only Python block of a page that has a word, and return its names."""
    (block,) = [one for one in blocks(DOCS / page, "python") if word in one]
    names: dict[str, Any] = {"__name__": "of_the_page"}
    exec(compile(block, page, "exec"), names)
    return names


@pytest.mark.medium
@pytest.mark.docs
def test_the_page_about_losses_of_ones_own_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every block, after those before it, with smaller pictures and fewer steps than on the page."""
    page = DOCS / "own-loss.md"
    small: dict[str, Any] = {"steps": 2, "trials": 6, "spp": 2, "verify_spp": 4, "denoise": "none", "measure": "no"}
    small |= {"baseline": False}
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


@pytest.mark.docs
def test_the_predictor_of_the_page_is_as_good_as_a_render() -> None:
    camera = {"azimuth": 40, "elevation": 25, "roll": 0, "sizes": 2.4, "exposure": [-2, 0]}
    renderer = advsearch.load_scene("mug").renderer({"camera": camera}, resolution=32)
    predictor = code_with("extending.md", "Predictor")["StillPredictor"](renderer, renderer.start, seed=1)
    u = torch.tensor([0.2], requires_grad=True)
    picture = predictor(u)
    picture.mean().backward()
    assert u.grad is not None and float(u.grad) > 0.0
    still = u.detach()
    deviation = compare_views(
        lambda view: compare_with_traced(renderer, picture.detach(), still, view, 16, lambda *_: 0.0)
    )
    assert deviation.is_accepted, deviation.reason
