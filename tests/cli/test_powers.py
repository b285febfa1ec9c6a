"""Settings with power over more than their run: honoured where they are typed or given in Python, from no file."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from advsearch import experiment
from advsearch.cli.flags import COMMANDS_OF_FILES as COMMANDS
from advsearch.cli.main import main
from advsearch.config import CONFIGS
from advsearch.errors import InputError
from advsearch.progress import NullProgress
from advsearch.questions.sweep import carry_out as sweeping
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import RunDirectory
from advsearch.settings import HEADER, settings
from advsearch.threads import count_cores
from advsearch.trust import powers
from stored_sweeps import make_sweep

MANY = 100_000
POWERS: dict[str, Any] = {
    "cluster": "tcp://127.0.0.1:1",
    "workers": MANY,
    "log": "wandb",
    "run": "/tmp/elsewhere",
    "overwrite": True,
    "junit": "precious",
    "sarif": "precious",
    "markdown": "precious",
    "add": "theirs",
    "update": True,
}
"""A value of each setting that has such power."""

HARMLESS: dict[str, Any] = {
    "cluster": "local", "workers": 1, "log": "tensorboard", "run": "a-name", "overwrite": False, "update": False,
}  # fmt: skip
"""And one that has none."""

NEEDED = {"attack": "theirs", "compared": "theirs", "recipe": "realism", "suite": "suite.yaml", "sweeps": "theirs"}
CASES = [
    (command, one.name)
    for command in COMMANDS
    for one in settings(CONFIGS[command])
    if one.power is not powers.no_power
]  # fmt: skip
"""Every such setting of every command that a file may name."""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("precious").write_text("mine")


def written(command: str, **given: Any) -> Path:
    """A file for a command that names what it has to and these settings."""
    needed = {
        one.name: NEEDED.get(one.name, "mug") for one in settings(CONFIGS[command]) if one.required and not one.default
    }
    needed |= {"object": "mug", "compared": "reference,a.pt2"} if command == "compare" else {}
    Path("a.yaml").write_text(HEADER + yaml.safe_dump({"schema": 2, "command": command, **needed, **given}))
    return Path("a.yaml")


@pytest.mark.island("advsearch.questions.test")
def test_every_setting_that_reaches_beyond_the_run_says_so() -> None:
    """A new setting that names a place to write, or who shares the work, is declared with what it does there."""
    assert {name for _, name in CASES} == {*POWERS}
    for command in COMMANDS:
        for one in settings(CONFIGS[command]):
            text = f"{one.name} {one.description} {one.expects}"
            suspicious = ("folder that", "write ", "writes", "address", "replace ", "processes", "tracker", "keep the")
            inside = {"aov", "suite", "attack", "keep_pictures", "compared", "sweeps", "ask"}
            inside |= {"model", "models"}  # what only a file names is asked nothing (test_addresses.py)
            if any(word in text for word in suspicious) and one.name not in inside:
                assert one.power is not powers.no_power, f"{command}: {text}"


@pytest.mark.parametrize(("command", "name"), CASES)
def test_a_file_alone_asks_in_vain(command: str, name: str) -> None:
    kind, given = CONFIGS[command], {name: POWERS[name]}
    file = written(command, **given, **({"run": "there"} if name == "overwrite" else {}))
    made = kind.from_yaml(file)
    left = {one.name: one.value for one in made.omitted_settings}
    field = next(one.field for one in settings(kind) if one.name == name)
    default = next(one.default for one in settings(kind) if one.name == name)
    assert left == given and getattr(made, field) == default
    typed = kind.from_yaml(file, given)
    assert getattr(typed, field) == POWERS[name] and not typed.omitted_settings
    assert not kind.from_yaml(file, {name: default}).omitted_settings
    if name in HARMLESS:
        plain = kind.from_yaml(written(command, **{name: HARMLESS[name]}))
        assert getattr(plain, field) == HARMLESS[name] and not plain.omitted_settings


@pytest.mark.parametrize(("command", "name"), CASES)
def test_a_file_that_asks_is_refused_with_what_to_type(
    command: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(command, **{name: POWERS[name]}, **({"run": "there"} if name == "overwrite" else {}))
    assert main(["run", str(file), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"advsearch: error: a.yaml: {name}: ") and f"type {name}=" in error
    assert not Path("runs").exists() and Path("precious").read_text() == "mine"


def test_a_base_asks_in_vain_too(capsys: pytest.CaptureFixture[str]) -> None:
    Path("base.yaml").write_text(f"workers: &many {MANY}\nsteps: 3\n")
    Path("b.yaml").write_text("base: base.yaml\nobject: mug\ncontrols: pose\nworkers: '90000'\n")
    assert main(["run", "b.yaml", "--quiet"]) == 2
    assert f"workers: starts 90000 processes on {count_cores()} processors" in capsys.readouterr().err


@pytest.mark.medium
def test_a_run_goes_on_without_and_says_what_to_type(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with RunDirectory.create_for(SweepConfig(object="mug", grid={"pose.yaw": [0]}, run="runs/sent")) as run:
        run.store.append([])
    with Path("runs/sent/run.yaml").open("a") as file:
        file.write("\n")
    text = Path("runs/sent/run.yaml").read_text()
    text = text.replace("cluster: null", "cluster: tcp://127.0.0.1:1").replace("log: null", "log: mlflow")
    Path("runs/sent/run.yaml").write_text(text.replace("workers: null", f"workers: {MANY}"))
    seen: list[SweepConfig] = []

    def carried(config: SweepConfig, **_: object) -> None:
        seen.append(config)
        raise InputError("stopped here")

    monkeypatch.setattr(sweeping, "sweep_from_config", carried)
    assert main(["resume", "sent"]) == 2
    error = capsys.readouterr().err
    assert "cluster is left out: it connects to tcp://127.0.0.1:1, and what answers there can run code here" in error
    assert "log is left out: it sends every evaluation to mlflow; type log=mlflow if you want that" in error
    assert f"workers is left out: it starts {MANY} processes on {count_cores()} processors" in error
    assert main(["resume", "sent", "workers=2", "cluster=cluster.yaml", "--quiet"]) == 2
    assert [(one.cluster, one.log, one.workers) for one in seen] == [(None, None, None), ("cluster.yaml", None, 2)]


@pytest.mark.island("advsearch.questions.test")
def test_what_decides_numbers_is_not_left_out_but_refused(capsys: pytest.CaptureFixture[str]) -> None:
    Path("runs/sent").mkdir(parents=True)
    Path("suite.yaml").write_text("settings: {object: mug}\nclaims: {a: {claim: not_broken}}\n")
    written("test", suite="suite.yaml", add="theirs").rename("runs/sent/run.yaml")
    assert main(["resume", "sent", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "add: changes what is kept beside the suite, which a file can't ask for; type add=theirs" in error


@pytest.mark.island("advsearch.questions.test")
@pytest.mark.medium
def test_resume_writes_none_of_the_files_that_a_run_names(capsys: pytest.CaptureFixture[str]) -> None:
    Path("runs/sent").mkdir(parents=True)
    Path("suite.yaml").write_text("settings: {object: nothing}\nclaims: {a: {claim: not_broken}}\n")
    written("test", suite="suite.yaml", markdown="precious", update=True).rename("runs/sent/run.yaml")
    assert main(["resume", "sent"]) == 2  # of the object
    assert "markdown is left out: it writes precious; type markdown=precious" in capsys.readouterr().err
    assert Path("precious").read_text() == "mine" and not Path("suite.counterexamples").exists()


@pytest.mark.medium
@pytest.mark.parametrize("setting", ["log: wandb", "cluster: tcp://127.0.0.1:1", "run: x", "overwrite: true"])
def test_a_suite_asks_in_vain(setting: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = f"claims: {{a: {{claim: not_broken, settings: {{object: mug, {setting}}}}}}}\n"
    Path("suite.yaml").write_text(text)
    assert main(["test", "suite.yaml", "--quiet"]) == 2
    assert f"settings: {setting.partition(':')[0]}" in capsys.readouterr().err and not Path("runs").exists()
    Path("suite.yaml").write_text(f"{setting}\n{text}")
    assert main(["test", "suite.yaml", "--quiet"]) == 2
    assert "there is no such name in a suite" in capsys.readouterr().err


@pytest.mark.medium
@pytest.mark.parametrize("setting", ["log: mlflow", "cluster: tcp://127.0.0.1:1", f"workers: {MANY}", "run: x"])
def test_a_recipe_asks_in_vain(setting: str, capsys: pytest.CaptureFixture[str]) -> None:
    part = f"{{command: sweep, settings: {{controls: {{pose: {{}}}}, {setting}}}}}"
    Path("mine.yaml").write_text(f"title: t\nsettings: {{object: mug}}\nparts: {{a: {part}}}\n")
    assert main(["recipe", "mine.yaml", "--quiet"]) == 2
    assert setting.partition(":")[0] in capsys.readouterr().err and not Path("runs").exists()


@pytest.mark.medium
def test_a_part_has_the_workers_of_who_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_sweep(Path("runs/part"), ended=False)
    text = (path / "run.yaml").read_text()
    (path / "run.yaml").write_text(text.replace("workers: null", "workers: 1").replace("log: null", "log: wandb"))
    seen: list[Any] = []
    monkeypatch.setattr(experiment, "run_experiment", lambda config, **_: seen.append(config))
    for workers in (3, None):
        asked = SweepConfig(object="mug", grid={"pose.yaw": [0.0]}, workers=workers)
        experiment.run_part(path, asked, NullProgress())
    assert [(one.workers, one.log) for one in seen] == [(3, None), (None, None)]
