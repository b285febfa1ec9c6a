"""A control of one's own from a module in the current directory: `--control module:Class`, in YAML and in Python."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import advsearch
from advsearch.cli.main import main
from advsearch.controls import CONTROLS, make_control
from advsearch.errors import InputError

MODULE = '''
import torch
from advsearch.controls import NumberControl, Parameter


class Fade(NumberControl):
    """How far the object's colours have faded."""

    kind = "fade"
    summary = "How far the object's colours have faded."
    parameters = (Parameter("amount", (), "1", 0.0, 1.0, 0.0, "Share of grey.", search=(0.0, 1.0)),)

    def scene_inputs(self, scene, values, so_far):
        own = torch.from_numpy(scene.object.base_color)
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


def test_the_command_line_and_yaml_take_a_class(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", "--object", "mug", "--control", "own_controls:Fade", "--samples", "2", *QUICK]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["controls"] == ["fade"] and found["worst"]["values"]["fade.amount"]["unit"] == "1"
    assert main(["run", f"{found['run']}/run.yaml", "--quiet", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["worst"]["values"] == found["worst"]["values"] and again["run"] != found["run"]


def test_settings_and_a_name_of_its_own() -> None:
    given = {"old": {"kind": "own_controls:Fade", "amount": [0.0, 0.3]}}
    render = advsearch.load_scene("mug").renderer(given, resolution=16)
    assert list(render.space.describe(render.start)) == ["old.amount"]
    assert make_control("own_controls:Fade", {"amount": [0.0, 0.5]}).name == "fade"


def test_an_instance_of_a_known_control_is_no_class() -> None:
    Path("light.py").write_text("raise SystemExit('imported')", encoding="utf-8")
    assert make_control("light:Key").name == "Key"
    assert "light:Key" not in CONTROLS and "lihgt:key" not in CONTROLS


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("own_controls:Else", r"own_controls:Else: expected a subclass of Control"),
        ("own_controls:Gone", r"own_controls:Gone: cannot be imported \(AttributeError: .*'Gone'\)"),
        (
            "no_module:Fade",
            r"no_module:Fade: cannot be imported \(ModuleNotFoundError: .*looked for on the Python path",
        ),
    ],
)
def test_what_is_no_control_is_refused(asked: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_control(asked)
