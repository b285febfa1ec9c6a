"""The typed configuration: what every wrong value says, and that YAML, flags and Python mean the same."""

import argparse
import math
import re
import shlex
from pathlib import Path
from typing import Any, TypeVar

import pytest
import yaml
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from advsearch.cli import flags
from advsearch.cli.main import main
from advsearch.config import CONFIGS, RenderConfig, SceneConfig
from advsearch.errors import InputError
from advsearch.questions.attack.settings import TRIALS, TRIALS_OVER, AttackConfig
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.settings import Config, PythonOnly, Setting, are_all_finite, read_yaml, settings
from hostile import HOSTILE, shown

WRONG: dict[str, Any] = {
    "object": "", "path": "", "shutter": 0.0, "rolling": -61.0, "environment": [], "up": "x", "size": 0, "things": 3,
    "judge": "", "backdrop": "", "occluder": "", "twins": "", "unit": "ft",
    "facing": "ahead", "camera": "", "set_": {"camera.azimuth": math.nan}, "exposure": 99,
    "resolution": "4x4", "model": "a\x00b", "labels": ["tench, Tinca tinca", "goldfish"],
    "prompt": "a photo of a {} | ", "value_range": "255,0", "ask": {"calls": "many"}, "task": "  ", "label": "  ",
    "controls": {"texture": 3}, "epsilon": "nan", "seconds": 0, "target": [3.5], "minimise": "maybe", "smallest": 2,
    "over": {"camera": 3}, "draws": 0, "average": -1, "norm": "l3", "texture_resolution": 0,
    "estimators": {"pose": 3}, "printable": 2, "metrics": "feature", "log": "excel", "aov": 3, "ensemble": "median",
    "measure": "some", "policy": None, "steps": 2.5, "objective": {}, "spp": "many", "denoise": False,
    "pixel_sampler": "sobol", "specialise": "maybe", "baseline": "maybe", "verify_spp": 0, "trials": 5, "seed": -1,
    "threads": 0, "deterministic": 3, "run": "", "workers": 0, "cluster": "", "overwrite": [],
}  # fmt: skip
"""A value that each setting of an attack refuses."""

GIVEN: dict[str, Any] = {
    "object": "mug.obj", "environment": "room.hdr", "up": "y", "facing": "-z", "size": 4.9, "unit": "cm",
    "camera": "front", "things": "car@1,2", "judge": "car", "backdrop": "desk.jpg#1,2,30,40",
    "occluder": "hand.png", "twins": "runs/lmo",
    "set": {"camera.azimuth": 130.0, "camera.target": (0.0, 0.5, 1.0), "material": "felt"},
    "exposure": -1.5, "resolution": (96, 128), "model": "net.pt2,other.pt2", "ensemble": "mean",
    "labels": "labels.json", "prompt": "a photo of a {}", "ask": {"calls": 5.0}, "task": "detection",
    "value_range": (0.0, 255.0),
    "label": "coffee mug,cup",
    "controls": {"texture": {}, "pose": {"yaw": [0, 90]}}, "epsilon": {"texture": 0.03, "pose": 2.0},
    "seconds": 20.0, "target": "bowl", "minimise": False, "smallest": False, "over": {"camera": {}}, "draws": 2,
    "path": "orbit",
    "shutter": 0.02,
    "rolling": 0.03,
    "average": 50, "printable": True, "aov": "mask,uv", "metrics": {"feature": "own.metrics:seen"}, "log": "wandb",
    "norm": "l2", "texture_resolution": 64,
    "estimator": {"pose": "differences", "*": "adjoint"}, "measure": "no",
    "policy": {"name": "pgd", "momentum": 0.9},
    "steps": 3, "objective": "cross_entropy", "spp": 4, "denoise": "none",
    "pixel_sampler": "independent",
    "specialise": False,
    "baseline": False, "verify_spp": 32, "trials": 7, "seed": 9, "threads": 1, "deterministic": True, "run": "x/y",
    "overwrite": True, "workers": None, "cluster": None,
}  # fmt: skip


Given = TypeVar("Given", bound=Config)


def of_commands(*cases: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    """Return the cases, which begin with the name of a command, of the commands that are there."""
    return [case for case in cases if case[0] in CONFIGS]


def of_command_line(line: str, config: type[Given] = AttackConfig) -> Given:  # type: ignore[assignment]
    """Return the configuration of a shell command ``advsearch attack ...``, or of another one's."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    flags.add_settings(parser, config=config)
    args = parser.parse_args(shlex.split(line)[2:])
    return flags.make_config(args, config)


@pytest.mark.parametrize("setting", settings(AttackConfig), ids=lambda setting: setting.name)
def test_every_wrong_value_names_its_flag(setting: Any) -> None:
    with pytest.raises(InputError) as error:
        AttackConfig(**{"object": "mug", setting.field: WRONG[setting.field]})
    assert str(error.value).startswith(f"{setting.name}: expected ")
    assert flags.format_as_flags(str(error.value)).startswith(f"{setting.flag}: expected ")


@pytest.mark.parametrize(
    ("command", "given"),
    of_commands(
        ("attack", {"object": "mug,bowl", "workers": 2, "cluster": "local"}),
        ("attack", {"object": "mug,bowl", "controls": ["pose", "camera"], "average": 50, "run": "x", "steps": 9}),
        (
            "region",
            {
                "object": "mug", "controls": "pose", "vary": "pose.yaw,pose.pitch", "map": 24, "samples": 50,
                "around": "mug-pose-001",
            },
        ),
        (
            "sweep",
            {"object": "mug", "grid": {"pose.yaw": "0:360:24", "camera.elevation": [5, 50]}, "samples": 3, "batch": 2},
        ),
        (
            "precision",
            {"object": "mug", "controls": "pose", "quantities": "image", "seconds": 9.0, "samplers": "independent"},
        ),
        ("stability", {"case": ["ties", "saturated"], "group": "stiff", "seconds": 9.0, "run": "x", "overwrite": True}),
    ),
)  # fmt: skip
def test_every_command_is_repeated_by_its_yaml(command: str, given: dict[str, Any], tmp_path: Path) -> None:
    config = CONFIGS[command](**given)
    path = tmp_path / "run.yaml"
    path.write_text(config.to_yaml())
    assert type(config).from_yaml(path, {one.name: one.value for one in config.settings_with_effects}) == config
    assert read_yaml(path)["command"] == config.command
    assert config.command_line(tmp_path) == f"advsearch run {path}" and config.command_line(None) is None
    assert config.command_line("my run") == "advsearch run 'my run/run.yaml'"
    only_here = config.with_python_only_parts([PythonOnly("scene"), PythonOnly("model", "mine")])
    assert only_here.command_line(tmp_path) is None and only_here.python_only == ["the scene", "the model mine"]


TYPED = """
    --control texture                                 controls {texture: {}}
    --control 'texture={resolution: 64}'              controls {texture: {resolution: 64}}
    --control pose,texture --control camera           controls {pose: {}, texture: {}, camera: {}}
    --set a.b=1 --set 'c=[1, 2]'                      set {a.b: 1.0, c: [1.0, 2.0]}
    --set environment.which=noon --set a=1e-3         set {environment.which: noon, a: 0.001}
    --ask calls=500 --ask tokens=1e4                  ask {calls: 500.0, tokens: 10000.0}
    --metric seen=own.metrics:seen                    metrics {seen: "own.metrics:seen"}
    --estimator adjoint                               estimator {"*": adjoint}
    --estimator adjoint --estimator pose=differences  estimator {"*": adjoint, pose: differences}
    --epsilon 0.1                                     epsilon 0.1
    --epsilon 0.1,0.2                                 epsilon [0.1, 0.2]
    --epsilon texture=0.05,geometry=0.01              epsilon {texture: 0.05, geometry: 0.01}
    --resolution 64                                   resolution [64, 64]
    --resolution 48x64                                resolution [48, 64]
    --value-range=-1,1                                value_range [-1.0, 1.0]
    --policy 'pgd={momentum: 0.9}'                    policy {name: pgd, momentum: 0.9}
    --task yaw={}                                     task yaw
    --task 'detection={iou: 0.7}+depth'               task {name: detection+depth, detection: {iou: 0.7}}
    --label '#504'                                    label "#504"
    --no-baseline                                     baseline false
    --steps 3 --steps 4                               steps 4
"""


@pytest.mark.parametrize("line", [line.strip() for line in TYPED.strip().splitlines()])
def test_what_is_typed_is_read_as_yaml_has_it(line: str, tmp_path: Path) -> None:
    words, setting = re.split(r"\s{2,}", line, maxsplit=1)
    name, value = setting.split(" ", 1)
    models = " --model one,two" if "+" in words else ""
    typed: AttackConfig = of_command_line(f"advsearch attack --object mug{models} {words}")
    file = tmp_path / "run.yaml"
    file.write_text(f"object: mug\n{models.replace(' --model ', 'model: ')}\n{name}: {value}\n")
    assert typed == AttackConfig.from_yaml(file) and typed.to_json()[name] == yaml.safe_load(value)


def test_what_a_grid_is_typed_as(tmp_path: Path) -> None:
    words = "--grid pose.yaw=0:360:24 --grid camera.elevation=5,20 --grid 'pose.x=[0,1]' --grid environment.which=noon"
    config: SweepConfig = of_command_line(f"advsearch sweep --object mug {words}", SweepConfig)
    grid = {"pose.yaw": "0:360:24", "camera.elevation": [5, 20], "pose.x": [0, 1], "environment.which": ["noon"]}
    assert config.grid == grid
    if "stability" in CONFIGS:
        cases: Any = of_command_line("advsearch stability --case a --case b,c", CONFIGS["stability"])
        assert cases.cases == ("a", "b", "c")
    if "recipe" in CONFIGS:
        recipe: Any = of_command_line(
            "advsearch recipe --recipe pose --label '#504' --label mug='coffee mug,cup'", CONFIGS["recipe"]
        )
        assert recipe.label == {"*": "#504", "mug": "coffee mug,cup"}


def own_settings(config: type[Config]) -> list[Setting]:
    """The settings that no command before has in the very same words."""
    before = list(CONFIGS.values())[: list(CONFIGS.values()).index(config)]
    told = {repr(one) for other in before for one in settings(other)}
    return [one for one in settings(config) if repr(one) not in told]


@pytest.mark.medium
@pytest.mark.parametrize("config", CONFIGS.values(), ids=lambda config: config.command)
def test_no_value_of_any_setting_ends_in_a_traceback(config: type[Config]) -> None:
    """Refused in one line that names the setting, or accepted and then the same in every form."""
    needed = {one.field: "a.png" for one in settings(config) if one.required}
    for setting in own_settings(config):
        for value in HOSTILE:
            try:
                made = config(**{**needed, setting.field: value})
            except InputError as error:
                assert len(str(error)) < 500 and str(error).isprintable(), (setting.name, shown(value))
                continue
            given = getattr(made, setting.field)
            assert are_all_finite(given if isinstance(given, (list, tuple, dict)) else [given]), (
                setting.name,
                shown(value),
            )
            assert made.to_yaml() and made.command_line("x") and made.get_deciding_settings(), (
                setting.name,
                shown(value),
            )


@pytest.mark.parametrize(
    "line",
    [
        "--epsilon ''", "--epsilon 1e308", "--epsilon 0.1,0.10", "--epsilon texture=0.1,texture=0.2",
        "--control pose --control pose", "--over camera --over 'camera={fov: 30}'",
        "--estimator adjoint --estimator differences", "--over 'camera={azimuth: [0, .inf]}'",
    ],
)  # fmt: skip
def test_slips_on_the_command_line_are_refused(line: str) -> None:
    with pytest.raises(InputError) as error:
        of_command_line(f"advsearch attack --object mug {line}")
    assert flags.format_as_flags(str(error.value)).startswith(f"{line.split()[0]}: ")


CLASHES = of_commands(
    ("attack", {"deterministic": True, "threads": 4}, "threads"),
    ("sweep", {"overwrite": True}, "overwrite"),
    ("attack", {"smallest": True, "epsilon": "0.1,0.2"}, "smallest"),
    ("check", {"loss": "linear", "objective": "logit-gap"}, "objective"),
    ("attack", {"smallest": True, "object": "mug,bowl"}, "smallest"),
    ("attack", {"model": "a.pt2,b.pt2", "object": "mug,bowl"}, "model"),
    ("attack", {"ensemble": "mean"}, "ensemble"),
    ("attack", {"smallest": True, "printable": True}, "smallest"),
    ("attack", {"smallest": True, "seconds": 5}, "smallest"),
    ("attack", {"smallest": True, "over": "camera"}, "smallest"),
    ("attack", {"minimise": True, "object": "mug,bowl"}, "minimise"),
    ("attack", {"minimise": True, "target": "bowl"}, "minimise"),
    ("attack", {"minimise": True, "smallest": True}, "minimise"),
    ("attack", {"over": "camera", "controls": "camera.fov"}, "over"),
    ("attack", {"draws": 8}, "draws"),
    ("attack", {"over": "camera", "estimators": {"camera.fov": "secant"}}, "estimators"),
    ("attack", {"average": 10, "epsilon": "0.1,0.2"}, "average"),
    ("region", {"spp": 4}, "spp"),
    ("render", {"out": "a.png", "run": "it"}, "run"),
    ("check", {"epsilon": "0.1,0.2"}, "epsilon"),
    ("sweep", {"sampler": "random", "grid": {"pose.yaw": "0,90"}}, "sampler"),
    ("sweep", {"fps": 5, "grid": {"pose.yaw": "0,90"}}, "fps"),
    ("sweep", {"trials": 0, "verify_spp": 8}, "verify_spp"),
    ("precision", {"samplers": "independent", "quantities": "gradient"}, "samplers"),
    ("precision", {"loss": "model", "quantities": "image"}, "loss"),
    ("test", {"suite": "a.yaml", "fresh": True, "seed": 1}, "fresh"),
    ("test", {"suite": "a.yaml", "update": True, "add": "run"}, "update"),
    ("test", {"suite": "a.yaml", "only": "a", "add": "run"}, "only"),
    ("check", {"all": True, "controls": "pose"}, "all"),
)  # fmt: skip
"""Every pair of settings that excludes each other, or of which one would be ignored."""


@pytest.mark.parametrize(("command", "given", "name"), CLASHES)
def test_settings_that_would_be_ignored_or_exclude_each_other_are_refused(
    command: str, given: dict[str, Any], name: str
) -> None:
    config = CONFIGS[command]
    with pytest.raises(InputError) as error:
        config(**{**({"object": "mug"} if "object" in config.model_fields else {}), **given})
    assert str(error.value).startswith(f"{name}: ")


def test_yaml_round_trip_of_everything(tmp_path: Path) -> None:
    config = AttackConfig(**GIVEN)
    assert all(getattr(config, setting.field) == GIVEN[setting.name] for setting in settings(AttackConfig))
    path = tmp_path / "run.yaml"
    path.write_text(config.to_yaml())
    assert AttackConfig.from_yaml(path, {one.name: one.value for one in config.settings_with_effects}) == config
    assert read_yaml(path)["schema"] == 2 and read_yaml(path)["command"] == "attack"


@pytest.mark.medium
@examples(max_examples=60, deadline=None)
@given(
    epsilon=st.none() | st.floats(1e-20, 1e6), exposure=st.floats(-10, 10), seed=st.integers(0, 2**63 - 1),
    name=st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs"))).filter(lambda text: text.strip(" ,")),
    value=st.floats(allow_nan=False, allow_infinity=False),
)  # fmt: skip
def test_any_values_go_round(
    tmp_path_factory: pytest.TempPathFactory, epsilon: float | None, exposure: float, seed: int, name: str, value: float
) -> None:
    config = AttackConfig(object=name, label=name, epsilon=epsilon, exposure=exposure, seed=seed, set_={"a.b": value})
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(config.to_yaml(), encoding="utf-8")
    assert AttackConfig.from_yaml(path) == config


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (None, r"study\.yaml"), (b"- a\n", r"study\.yaml"), (b"a: [1,\n", r"study\.yaml"),
        (b"schema: 7\nobject: mug\n", r"study\.yaml"), (b"object: mug\nset:\n  a: .inf\n", r"study\.yaml: set"),
        (b"objekt: mug\n", "'objekt'"), (b"\xff\xfe\x00", r"study\.yaml"),
    ],
)  # fmt: skip
def test_a_bad_file_is_named(tmp_path: Path, content: bytes | None, name: str) -> None:
    path = tmp_path / "study.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=name):
        AttackConfig.from_yaml(path)


def test_yaml_as_a_person_writes_it(tmp_path: Path) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(
        "object: mug\nup: y\ndenoise: none\ncontrols: [texture, pose]\nlabel: [coffee mug, cup]\n"
        "labels: [coffee mug, cup, bowl]\nprompt: ['a photo of a {}, big', 'the {}']\n"
        "epsilon: 1e-3\nresolution: 224\nset: {camera.azimuth: 130, camera.elevation: 2e1}\n"
    )
    config = AttackConfig.from_yaml(path)
    assert (config.up, config.denoise, config.label) == ("y", "none", "coffee mug,cup")
    assert (config.labels, config.prompt) == ("coffee mug,cup,bowl", "a photo of a {}, big | the {}")
    assert (config.epsilon, config.resolution) == (1e-3, (224, 224))
    assert config.controls == {"texture": {}, "pose": {}}
    assert config.set_ == {"camera.azimuth": 130.0, "camera.elevation": 20.0}


def test_overrides_reach_inside(tmp_path: Path) -> None:
    path = tmp_path / "study.yaml"
    path.write_text("object: mug\nset: {camera.azimuth: 1}\ncontrols: [texture]\n")
    changes = {"steps": 80, "set.camera.elevation": 25, "controls.texture.resolution": 64, "controls.pose.yaw": [0, 9]}
    config = AttackConfig.from_yaml(path, changes)
    assert config.steps == 80
    assert config.set_ == {"camera.azimuth": 1.0, "camera.elevation": 25.0}
    assert config.controls == {"texture": {"resolution": 64}, "pose": {"yaw": [0, 9]}}


@pytest.mark.parametrize("given", ["yaw={tolerance: 5}", {"name": "yaw", "tolerance": 5}])
@pytest.mark.parametrize(
    "config", [CONFIGS[name] for (name,) in of_commands(("attack",), ("sweep",), ("region",), ("render",))]
)
def test_a_task_has_options_as_a_policy_has(given: Any, config: type[SceneConfig], tmp_path: Path) -> None:
    needed: dict[Any, dict[str, Any]] = {SweepConfig: {"grid": {"pose.yaw": [0, 1]}}, RenderConfig: {"out": "a.png"}}
    own = needed.get(config, {})
    made = config(object="mug", task=given, **own)
    assert (made.task_name, made.task) == ("yaw", {"name": "yaw", "tolerance": 5})
    (tmp_path / "run.yaml").write_text(made.to_yaml())
    assert config.from_yaml(tmp_path / "run.yaml") == made
    assert config.from_yaml(tmp_path / "run.yaml", {"task.tolerance": 7}).task == {"name": "yaw", "tolerance": 7}
    assert made.get_deciding_settings()["task"] == made.task, "a run with other options is not gone on with"
    plain = config(object="mug", task="yaw={}", **own)
    assert (plain.task_name, plain.task) == ("yaw", "yaw")


def test_a_file_is_laid_over_its_bases(tmp_path: Path) -> None:
    (tmp_path / "far.yaml").write_text("object: bowl\nseed: 3\ncontrols: {pose: {yaw: [0, 90], pitch: 3}}\n")
    (tmp_path / "near.yaml").write_text("base: far.yaml\nseed: 4\ncontrols: {pose: {yaw: [0, 45]}}\n")
    path = tmp_path / "study.yaml"
    path.write_text("base: [near.yaml]\nobject: mug\npolicy: pgd\n")
    config = AttackConfig.from_yaml(path, {"policy.steps": 80, "policy.momentum": 0.9})
    assert (config.object, config.seed, config.steps) == ("mug", 4, 80)
    assert config.controls == {"pose": {"yaw": [0, 45], "pitch": 3}}
    assert config.policy == {"name": "pgd", "momentum": 0.9}


@pytest.mark.parametrize(
    ("text", "message"),
    [("base: gone.yaml\n", r"gone\.yaml"), ("base: 3\n", r"study\.yaml"), ("base: study.yaml\n", r"study\.yaml")],
)
def test_a_bad_base_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        AttackConfig.from_yaml(path)


@pytest.mark.parametrize(
    ("command", "name"), of_commands(("region", "object"), ("check", "environment"), ("render", "model"))
)
def test_several_of_a_kind_are_for_a_sweep(
    command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = {"object": "mug", "environment": "noon", "model": "reference"} | {name: "one,two"}
    words = [word for flag, value in flags.items() for word in (f"--{flag}", value)]
    assert main([command, *words, *(["--out", "a.png"] if command == "render" else [])]) == 2
    assert f"--{name}: " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_configuration_for_many_conditions_is_tried_more_often() -> None:
    assert AttackConfig(object="mug").trial_count == TRIALS == 20
    assert AttackConfig(object="mug", over={"light": {}}).trial_count == TRIALS_OVER == 200
    assert AttackConfig(object="mug", over={"light": {}}, trials=7).trial_count == 7
