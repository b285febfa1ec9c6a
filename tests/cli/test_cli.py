"""The command line: what it prints where, its exit statuses, and that it answers at once."""

import ctypes
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import samples
from advsearch.cli.main import list_commands, main
from advsearch.config import CONFIGS
from advsearch.errors import InputError, StorageError
from advsearch.options import Value
from advsearch.progress import Progress
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.settings import Config
from conftest import ROOT
from samples import SUMMARY, make_run

HEAVY = ("torch", "mitsuba", "drjit", "numpy", "scipy", "pydantic", "rich", "yaml", "PIL")


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Put a stand-in in the place of `advsearch.experiment.run_experiment`."""

    def not_wanted(config: Config, **named: Any) -> Any:
        raise AssertionError(f"the command line asked for {config.command}")

    return lambda answering=not_wanted: monkeypatch.setattr("advsearch.experiment.run_experiment", answering)


@pytest.fixture
def asked(api: Callable[..., None]) -> list[AttackConfig]:
    """The configurations that a successful stand-in was given."""
    given: list[AttackConfig] = []

    def attack(config: AttackConfig, *, progress: Progress, resumed_directory: Path | None = None) -> Any:
        given.append(config)
        return SUMMARY

    api(attack)
    return given


def python(code: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a piece of Python in a process of its own."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, **options)


def test_help_is_quick_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from advsearch.cli.main import main; status = main(['--help']);"
        f"print(sorted(set({HEAVY}) & set(sys.modules)), file=sys.stderr); sys.exit(status)"
    )
    seconds = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = python(code)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)  # CPU seconds: what others do on the machine takes none
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert (done.returncode, done.stderr) == (0, "[]\n")
    assert all(name in done.stdout for name in list_commands())
    assert min(seconds) < 0.5


@pytest.mark.parametrize("command", list_commands())
def test_every_command_has_help_and_json(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("usage: advsearch " + command) and "--json" in out and err == ""


@pytest.mark.parametrize(
    ("argv", "named"),
    [
        (["atack"], "'attack'"), (["attack", "--epsilom", "1"], "'--epsilon'"),
        pytest.param(["region", "--workers", "2"], "--workers", marks=pytest.mark.island("advsearch.questions.region")),
        (["attack", "--object", "mug", "--epsilon", "nan"], "--epsilon: "),
        (["attack", "--object", "mug", "--set", "a"], "--set: "), (["run", "no.yaml"], "no.yaml: "),
        (["show", "no-run"], "'no-run'"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_status_2(
    argv: list[str], named: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("advsearch: error: ") and named in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.medium
def test_a_bug_keeps_its_traceback_and_ends_with_1() -> None:
    code = (
        "import sys, advsearch.experiment\n"
        "def carry_out(config, *, progress, resumed_directory): raise ValueError('a bug')\n"
        "advsearch.experiment.run_experiment = carry_out\n"
        "from advsearch.cli.main import main; sys.exit(main(['attack', '--object', 'mug', '--json']))"
    )
    path = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    done = python(code, cwd=Path(__file__).parent, env={**os.environ, "PYTHONPATH": path})
    assert done.returncode == 1 and done.stdout == ""
    assert "Traceback" in done.stderr and done.stderr.endswith("ValueError: a bug\n")


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (InputError("--object: no such thing"), 2, "advsearch: error: --object: no such thing\n"),
        (StorageError("the disk is full"), 2, "advsearch: error: the disk is full\n"),
        (KeyboardInterrupt(), 130, "advsearch: interrupted\n"),
    ],
)
def test_what_the_api_raises_becomes_a_status(
    api: Callable[..., None], capsys: pytest.CaptureFixture[str], error: BaseException, status: int, message: str
) -> None:
    def attack(config: AttackConfig, *, progress: Progress, resumed_directory: Path | None = None) -> Any:
        raise error

    api(attack)
    assert main(["attack", "--object", "mug", "--json"]) == status
    assert capsys.readouterr() == ("", message)


def test_a_reader_that_goes_away_is_no_error() -> None:
    code = "import sys; from advsearch.cli.main import main; sys.stdin.read(); sys.exit(main(['--help']))"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdin and process.stdout and process.stderr
        process.stdout.close()
        process.stdin.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


def test_json_is_all_that_stands_on_standard_output(
    api: Callable[..., None], capfd: pytest.CaptureFixture[str]
) -> None:
    def attack(config: AttackConfig, *, progress: Progress, resumed_directory: Path | None = None) -> Any:
        print("an objective of the user prints")
        os.write(1, b"so does a native library\n")
        ctypes.CDLL(None).puts(b"and one that buffers")
        progress.message("a warning")
        return samples.attack(seconds={"total": float("nan")})

    api(attack)
    assert main(["attack", "--object", "mug", "--json"]) == 0
    out, err = capfd.readouterr()
    found = json.loads(out, parse_constant=lambda text: pytest.fail(f"{text} is not JSON"))
    assert found == samples.attack(seconds={"total": None}).to_dict()
    for text in ("an objective of the user prints", "so does a native library", "and one that buffers", "a warning"):
        assert text in err


@pytest.mark.parametrize(
    ("ending", "status"), [("found", 0), ("budget spent", 0), ("already wrong", 0), ("interrupted", 130)]
)
def test_the_status_of_an_attack(api: Callable[..., None], ending: str, status: int) -> None:
    api(lambda config, progress, resumed_directory: samples.attack(ending=ending))
    assert main(["attack", "--object", "mug"]) == status
    assert main(["attack", "--object", "mug", "--json"]) == status


def test_run_reads_a_file_and_puts_changes_over_it(asked: list[AttackConfig], tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(AttackConfig(object="mug", steps=10, seed=4).to_yaml())
    assert (
        main(["run", str(path), "steps=80", "set.camera.azimuth=130", "--run", "again", "--overwrite", "--quiet"]) == 0
    )
    assert asked == [
        AttackConfig(object="mug", steps=80, seed=4, set_={"camera.azimuth": 130}, run="again", overwrite=True)
    ]


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with one run that is done and one that was killed."""
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs" / "done", pictures=False)
    with RunDirectory.create_for(AttackConfig(object="mug", controls=["pose"], run="killed")) as run:
        yaw: dict[str, Value] = {"pose.yaw": {"value": 12.5, "unit": "degrees"}}
        run.append_rows(Row("search", 0, objective=0.5, success=True, values=yaw), Row("control", 0))
    return tmp_path


@pytest.mark.parametrize(
    ("command", "given", "make_answer"),
    [
        ("attack", {"object": "mug"}, lambda: SUMMARY),
        ("attack", {"object": "mug,bowl"}, samples.curve),
        pytest.param(
            "region", {"object": "mug"}, samples.region, marks=pytest.mark.island("advsearch.questions.region")
        ),
        ("sweep", {"object": "mug", "grid": {"pose.yaw": [1, 2]}}, samples.sweep),
    ],
)
def test_resume_goes_on_with_what_was_stopped(
    api: Callable[..., None], runs: Path, command: str, given: dict[str, Any], make_answer: Callable[[], Any]
) -> None:
    config, answer = CONFIGS[command](**given, run="stopped"), make_answer()
    with RunDirectory.create_for(config) as run:
        run.append_rows(Row("search", 0))
    found: list[Any] = []

    def goes_on(config: Config, *, progress: Progress, resumed_directory: Path | None) -> Any:
        found.append((config.command, resumed_directory))
        return answer

    api(goes_on)
    assert main(["resume", "stopped", "--quiet"]) == 0
    assert found == [(config.command, Path("runs/stopped"))]


def test_a_run_that_was_stopped_says_how_far_it_came_and_how_to_go_on(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", "killed"]) == 0
    assert "advsearch resume killed" in capsys.readouterr().out
    assert main(["show", "killed", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["run"] == "runs/killed" and told["ending"] is None and told["state"] == "stopped"
    assert told["kinds"] == {"control": 1, "search": 1} and told["resume"] == "advsearch resume killed"
    RunDirectory.create("early").close()
    assert main(["show", "early"]) == 0
    assert "run.yaml" in capsys.readouterr().out
