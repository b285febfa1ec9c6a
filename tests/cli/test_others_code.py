"""Python code that a run, a suite or a recipe of somebody else names is imported by no command and no function, until
whoever asks has named it."""

import shlex
import shutil
import sqlite3
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml

import advsearch
from advsearch.cli.main import list_commands, main
from advsearch.cluster import WorkerTask
from advsearch.cluster.worker import run_batch
from advsearch.errors import InputError
from advsearch.questions.attack.carry_out import load_parts_of_run
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.studies import make_chain_worker
from advsearch.runs.directory import RunDirectory
from advsearch.settings import HEADER
from advsearch.trust.code import allow_code_in_settings, allowed_code, restrict_allowed_code
from samples import make_attacked
from stored_sweeps import make_sweep

PLANTED = "open('imported', 'w').close()\nraise RuntimeError('planted')"
NAME = "planted:make"

SUITE = "settings: {object: mug, model: 'planted:make', controls: {pose: {}}}\nclaims: {a: {claim: not_broken}}\n"
BESIDE = (
    "settings: {object: mug, controls: {pose: {}}}\nclaims: {a: {claim: no_worse, than: 'planted:make', points: 2}}\n"
)
RECIPE = (
    "title: t\nsettings: {object: mug, model: 'planted:make'}\n"
    "parts: {a: {command: sweep, settings: {controls: {pose: {}}, samples: 2}}}\n"
)
MINE = "settings: {object: mug}\nclaims: {a: {claim: not_broken, settings: {controls: {pose: {}}}}}\n"


def named_in(run: Path) -> None:
    """Let the settings of a run name the code as its model, and where a patch is to be printed as its control."""
    file = run / "run.yaml"
    settings = yaml.safe_load(file.read_text())
    printed = "patch" in settings["controls"]
    settings["controls" if printed else "model"] = {"planted:Make": {}} if printed else NAME
    file.write_text(HEADER + yaml.safe_dump(settings))


@pytest.fixture(scope="module")
def sent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder from somebody else: runs, a suite and a recipe that name a module which lies beside them."""
    folder = tmp_path_factory.mktemp("sent")
    small = AttackConfig(object="mug", controls={"pose": {}}, resolution=16)
    runs = folder / "runs"
    runs.mkdir()
    make_attacked(runs / "theirs", small, np.full(3, 0.5))
    make_attacked(runs / "patched", small.model_copy(update={"controls": {"patch": {}}}), np.full(12288, 0.5))
    with RunDirectory.create_for(small.model_copy(update={"run": str(runs / "stopped")})) as run:
        run.store.append([])
    names = ("noon", "studio", *(f"sky-{number}" for number in range(8)))
    make_sweep(runs / "swept", environments=names)
    make_sweep(runs / "kept", keep="all")
    make_sweep(runs / "beside", environments=names)
    with closing(sqlite3.connect(runs / "beside" / "results.sqlite")) as results:
        results.execute("UPDATE evaluations SET correct = 1")
        results.commit()
    (runs / "beside" / "columns.bin").unlink(missing_ok=True)
    for one in runs.iterdir():
        named_in(one)
    for name, text in {"suite": SUITE, "beside": BESIDE, "recipe": RECIPE, "mine": MINE}.items():
        (folder / f"{name}.yaml").write_text(text)
    (folder / "planted.py").write_text(PLANTED)
    return folder


@pytest.fixture(autouse=True)
def here(sent: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    shutil.copytree(sent, tmp_path / "sent")
    monkeypatch.chdir(tmp_path / "sent")
    with restrict_allowed_code():
        yield
    sys.modules.pop("planted", None)


IMPORTING = {
    "resume": ["resume stopped"],
    "run": ["run runs/theirs/run.yaml --run again"],
    "region": ["region --around theirs"],
    "replay": ["replay theirs", "replay theirs --model reference"],
    "sweep": ["sweep --adversarial-of theirs --control light --samples 2"],
    "export": [
        "export theirs --format gltf --out a.glb",
        "export theirs --format mitsuba --out folder",
        "export patched --format print --out a.pdf",
        "export kept --format coco --out b",
    ],
    "explain": ["explain swept --confirm 0 --pairs 0 --clusters 4"],
    "compare": ["compare swept beside"],
    "test": ["test suite.yaml", "test beside.yaml", "test mine.yaml --add theirs"],
    "recipe": ["recipe ./recipe.yaml"],
}
"""Commands that load what a run, a suite or a recipe names."""

READING = {
    "show": ["show theirs", "show stopped"],
    "view": ["view theirs", "view swept --bundle site"],
    "runs": ["runs"],
    "report": ["report theirs swept --evidence"],
    "export": ["export swept", "export kept --format 3db --out a"],
}
"""And those that look at them."""

ALONE = (
    *("attack", "harden", "render", "twins", "list", "labels", "check", "precision", "stability", "doctor"),
    *("import", "import-3db", "completion"),
)
"""Those that are told everything, and the dashboard, which is tried below."""


@pytest.mark.island("all")
def test_every_command_is_tried_here() -> None:
    assert {*IMPORTING, *READING, *ALONE, "dashboard"} == {*list_commands()}


@pytest.mark.medium
@pytest.mark.parametrize("line", [line for lines in IMPORTING.values() for line in lines])
def test_a_command_imports_what_it_names_alone(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    quiet = [] if line.startswith("export") else ["--quiet"]
    status = main([*shlex.split(line), *quiet])
    error = capsys.readouterr().err
    assert not Path("imported").exists() and not allowed_code()
    if not line.startswith(("compare", "explain")):  # these go on without pictures, and say so
        assert status == 2 and f", Python code from {Path('planted.py').resolve()} that would be imported" in error
        assert error.endswith((f"--code {NAME}\n", "--code planted:Make\n"))
    main([*shlex.split(line), *quiet, "--code", NAME, "--code", "planted:Make"])
    assert Path("imported").exists() and not allowed_code()


@pytest.mark.medium
@pytest.mark.parametrize("line", [line for lines in READING.values() for line in lines])
def test_who_looks_imports_nothing(line: str) -> None:
    assert main(shlex.split(line)) == 0
    assert not Path("imported").exists()


@pytest.mark.medium
@pytest.mark.parametrize(
    "settings",
    [
        "controls: pose\nmetrics: {m: 'planted:make'}", "controls: {mine: {kind: 'planted:Make'}}", "base: base.yaml",
        "base: [base.yaml]",
    ],
)  # fmt: skip
def test_any_setting_that_names_code_in_a_file(settings: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("base.yaml").write_text(f"model: &code {NAME}\nlabel: *code\ncontrols: pose\n")
    Path("a.yaml").write_text(f"command: sweep\nobject: mug\nsamples: 2\n{settings}\n")
    assert main(["run", "a.yaml", "--quiet"]) == 2
    assert "names planted:" in capsys.readouterr().err and not Path("imported").exists()


@pytest.mark.medium
@pytest.mark.parametrize("typed", ["model=planted:make", "model=planted:make@a.safetensors"])
def test_what_is_typed_behind_a_file_is_imported(typed: str) -> None:
    assert main(["run", "runs/theirs/run.yaml", typed, "--quiet", "--run", "again"]) == 2
    assert Path("imported").exists()


def in_a_worker() -> None:
    settings = AttackConfig(object="mug", model=NAME, controls={"pose": {}}).to_json()
    work = WorkerTask("advsearch.questions.attack.carry_out:attack_worker", settings)
    reply = run_batch(work, [], 60.0)
    assert reply.failure is not None
    raise InputError(reply.error)


def explained() -> None:
    raise InputError(" ".join(advsearch.explain("swept", confirm=0, pairs=0, clusters=4).warnings))


def add_photograph() -> None:
    from advsearch.questions.photographs.carry_out import Photographs

    Photographs().add(Path("runs/kept"), "0", photograph())


PYTHON: dict[str, Callable[[], object]] = {
    "a loaded run": lambda: load_parts_of_run(Path("runs/theirs")),
    "sweep": lambda: advsearch.sweep(adversarial_of="theirs", controls=["light"], samples=2),
    "replay": lambda: advsearch.replay("theirs"),
    "explain": explained,
    "recipe": lambda: advsearch.recipe("./recipe.yaml"),
    "assert_suite": lambda: advsearch.testing.assert_suite("suite.yaml"),
    "a thread": add_photograph,
    "a worker": in_a_worker,
    "a worker of a study": lambda: make_chain_worker(
        AttackConfig(object="mug,bowl", model=NAME, controls={"pose": {}}).to_json()
    )([0]),
}


NEEDED = {
    "replay": pytest.mark.island("advsearch.questions.replay"),
    "explain": pytest.mark.island("advsearch.questions.explain"),
    "recipe": pytest.mark.island("advsearch.questions.recipe"),
    "assert_suite": pytest.mark.island("advsearch.questions.test"),
    "a thread": pytest.mark.island("advsearch.questions.photographs"),
}
"""What such a function needs beyond the core."""

FUNCTIONS = [pytest.param(name, marks=NEEDED.get(name, ())) for name in PYTHON]


def photograph() -> bytes:
    return next(Path("runs/kept").rglob("*.jpg")).read_bytes()


@pytest.mark.medium
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_imports_what_its_caller_names_alone(name: str) -> None:
    with pytest.raises(InputError, match=rf"a file names {NAME}, Python code from .*allow_code\('{NAME}'\)"):
        PYTHON[name]()
    assert not Path("imported").exists()
    advsearch.allow_code(NAME)
    with pytest.raises(Exception, match="RuntimeError"):
        PYTHON[name]()
    assert Path("imported").exists()


@pytest.mark.island("advsearch.questions.photographs")
@pytest.mark.medium
def test_the_dashboard_imports_nothing_for_a_photograph() -> None:
    from advsearch.questions.photographs.pages import PhotographPages

    with pytest.raises(InputError, match=NAME):
        PhotographPages()._photographs.add(Path("runs/kept"), "0", photograph())
    assert not Path("imported").exists()


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ({"model": "a:b, c.d:e@x.safetensors"}, ("a:b", "c.d:e")),
        ({"compared": ("a:b", "runs/x")}, ("a:b",)),
        ({"controls": ["pose", "a:B"], "over": {"c:D": {}}}, ("a:B", "c:D")),
        ({"metrics": {"m": "a:b", "n": shlex.split}}, ("a:b", "shlex:split")),
        ({"object": "a:b", "label": "a:b", "task": {"name": "a:b"}, "model": "m.pt2", "controls": None}, ()),
    ],
)
def test_what_is_named_in_settings(given: dict[str, object], names: tuple[str, ...]) -> None:
    allow_code_in_settings(given)
    assert allowed_code() == names


@pytest.mark.parametrize("name", ["a", "a:", ":b", "a b:c", "a:b@w", "../a:b", ""])
def test_what_is_no_name_of_code_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=r"expected package\.module:attribute"):
        advsearch.allow_code(name)


@pytest.mark.medium
@pytest.mark.parametrize("module", ["io", "torch", "json", "ctypes", "advsearch"])
def test_processes_that_we_start_look_for_no_modules_in_the_current_folder(module: str) -> None:
    import io

    from advsearch.scene.mitsuba_backend.llvm import query_version
    from advsearch.trust.foreign_code import try_torchscript

    Path(f"{module}.py").write_text("open('imported', 'w').close()")
    query_version("libnone.so")
    if module == "torch":
        assert try_torchscript(io.BytesIO(b"")) == ""
    assert not Path("imported").exists()
