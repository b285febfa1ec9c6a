"""A control of one's own from a module in the current directory: `--control module:Class`, in YAML and in Python."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from advsearch.cli.main import main
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory

MODULE = '''
import torch
from advsearch.controls import NumberControl, Parameter


class Fade(NumberControl):
    """How far the object's colours have faded."""

    kind = "fade"
    summary = "How far the object's colours have faded."
    parameters = (Parameter("amount", (), "1", 0.0, 1.0, 0.0, "Share of grey.", search=(0.0, 1.0)),)

    def scene_inputs(self, values, earlier_inputs):
        own = torch.from_numpy(self.scene.object.base_color)
        return {"object.base_color": torch.lerp(own, torch.full_like(own, 0.5), values["amount"])}


class Else:
    kind = "else"
'''
QUICK = ["--resolution", "16", "--spp", "1", "--trials", "0", "--quiet", "--json"]


@pytest.fixture(autouse=True)
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    Path("own_controls.py").write_text(MODULE, encoding="utf-8")
    yield
    sys.modules.pop("own_controls", None)


@pytest.mark.medium
def test_the_command_line_and_yaml_take_a_class(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", "--object", "mug", "--control", "own_controls:Fade", "--samples", "2", *QUICK]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["controls"] == ["fade"] and found["worst"]["values"]["fade.amount"]["unit"] == "1"
    assert main(["run", f"{found['run']}/run.yaml", "--code", "own_controls:Fade", "--quiet", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["worst"]["values"] == found["worst"]["values"] and again["run"] != found["run"]


PLANTED = "open('imported', 'w').close()\nraise RuntimeError('planted')"


def stopped_run(**settings: object) -> None:
    """The folder of a run that somebody else has begun, beside Python code that leaves a trace."""
    Path("planted.py").write_text(PLANTED, encoding="utf-8")
    config = AttackConfig(object="mug", **{"resolution": 16, **settings})
    with RunDirectory.create("theirs", config=config) as run:
        run.store.append([])


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"model": "planted:make@weights.safetensors"}, "planted:make"),
        pytest.param({"model": "torchvision:resnet18"}, "", marks=pytest.mark.island("advsearch.models.zoo")),
        ({"model": "planted:make", "over": {"planted:Fade": {}}}, "planted:make planted:Fade"),
    ],
)
def test_how_to_go_on_names_the_code_that_is_needed(
    settings: dict[str, object], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line that `show` prints goes on as it stands; nothing is imported to make it."""
    stopped_run(**settings)
    assert main(["show", "theirs"]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    flags = [word for name in named.split() for word in ("--code", name)]
    assert line.split() == ["Go", "on", "with:", "advsearch", "resume", "theirs", *flags]
    assert not Path("imported").exists()
    if named:
        assert main([*line.split()[4:], "--quiet"]) == 2
        assert Path("imported").exists() and "RuntimeError: planted" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"model": "planted:make"}, "planted:make"), ({"model": "planted:make@weights.safetensors"}, "planted:make"),
        ({"controls": {"planted:Fade": {}}}, "planted:Fade"),
        ({"controls": {"mine": {"kind": "planted:Fade"}}}, "planted:Fade"),
        ({"over": {"planted:Fade": {}}}, "planted:Fade"),
    ],
)  # fmt: skip
@pytest.mark.parametrize(
    "command",
    [
        "resume theirs",
        "run runs/theirs/run.yaml",
        pytest.param("region --around theirs", marks=pytest.mark.island("advsearch.questions.region")),
    ],
)
def test_code_that_somebody_elses_file_names_is_not_run(
    command: str, settings: dict[str, object], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if "over" in settings and command.startswith("region"):
        settings = {"controls": settings["over"]}  # nothing varies by chance there
    stopped_run(**settings)
    assert main([*command.split(), "--quiet"]) == 2
    error = capsys.readouterr().err
    assert f"a file names {name}, Python code from {Path('planted.py').resolve()} that would be imported" in error
    assert error.endswith(f"--code {name}\n") and not Path("imported").exists()
    assert main([*command.split(), "--quiet", "--code", name]) == 2
    assert Path("imported").exists() and "RuntimeError: planted" in capsys.readouterr().err
