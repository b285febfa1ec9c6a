"""A setting of the whole run reaches every control that declares it, by whatever name and in whatever command."""

from __future__ import annotations

from typing import Any

import pytest

import advsearch
from advsearch.api import render as rendering
from advsearch.cli.flags import format_as_flags
from advsearch.cli.main import main
from advsearch.config import RenderConfig
from advsearch.controls import CONTROLS, make_control
from advsearch.controls.patch import PatchControl
from advsearch.controls.pose import PoseControl
from advsearch.controls.texture import TextureControl
from advsearch.engine.naming import RUN_SETTINGS, check_run_settings, make_configured_controls, select_run_settings
from advsearch.errors import InputError, UnknownNameError
from advsearch.questions.attack import python
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.sweep.carry_out import load_job
from advsearch.questions.sweep.settings import SweepConfig

ALL: dict[str, Any] = {"epsilon": 0.07, "norm": "l2", "texture_resolution": 16}


def settings(controls: Any, **options: Any) -> dict[str, dict[str, object]]:
    """Settings of the controls of an attack, by the name of the instance."""
    config = AttackConfig(object="mug", controls=controls, **options)
    return {one.name: one.to_settings() for one in make_configured_controls(config, config.controls)}


def test_controls_declare_settings_that_a_run_has() -> None:
    declared = {choice.run_setting for kind in CONTROLS for choice in CONTROLS[kind].choices} - {""}
    assert declared == set(RUN_SETTINGS)


@pytest.mark.parametrize(
    ("asked", "name"),
    [
        ("texture", "texture"),
        ("texture:label", "texture:label"),
        ("texture.palette", "texture"),
        ("texture.texels:label", "texture:label"),
    ],
)
def test_a_control_takes_the_settings_of_the_run_whatever_its_name(asked: str, name: str) -> None:
    found = settings({asked: {}}, **ALL)[name]
    assert (found["epsilon"], found["norm"], found["resolution"]) == (0.07, "l2", 16)


def test_a_control_of_a_file_takes_them_by_its_kind() -> None:
    found = settings({"label": {"kind": "texture"}, "mine": {"kind": "patch"}}, **ALL)
    assert (found["label"]["epsilon"], found["label"]["norm"], found["label"]["resolution"]) == (0.07, "l2", 16)
    assert found["mine"] == {"kind": "patch", "epsilon": 0.07, "norm": "l2"}


def test_what_a_control_says_itself_goes_over_the_run() -> None:
    found = settings({"texture": {"epsilon": 0.5}, "patch": {"norm": "linf", "resolution": 8}}, **ALL)
    assert (found["texture"]["epsilon"], found["texture"]["norm"]) == (0.5, "l2")
    assert found["patch"] == {"epsilon": 0.07, "norm": "linf", "resolution": 8}


def test_an_epsilon_for_one_control_leaves_the_others_their_own() -> None:
    found = settings("texture,geometry,texture:label", epsilon="geometry=0.02,texture:label=0.3")
    assert [one.get("epsilon") for one in found.values()] == [None, 0.02, 0.3]


@pytest.mark.parametrize(("norm", "expected"), [(None, "linf"), ("linf", "linf"), ("l2", "l2")])
def test_a_patch_takes_an_epsilon_in_the_norm_of_the_run(norm: str | None, expected: str) -> None:
    config = AttackConfig(object="mug", controls="patch", epsilon=0.1, norm=norm)
    (patch,) = make_configured_controls(config, config.controls)
    assert (patch.chosen["epsilon"], patch.chosen["norm"]) == (0.1, expected)
    assert PatchControl().chosen["norm"] == "box", "without an epsilon its pixels may go anywhere"


# ---- every command --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "controls", [["texture"], "texture", ("texture",), {"texture": {}}, {"texture:texture": {}}, ["texture", "pose"]]
)
def test_python_gives_controls_the_settings_of_the_run(controls: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(python, "run_attack", lambda parts, *_: parts)
    job: Any = advsearch.attack("mug", controls=controls, **ALL)
    again = make_configured_controls(job.config, job.config.controls)
    texture: Any
    for texture in (job.controls[0], again[0]):
        assert {"epsilon": 0.07, "norm": "l2", "resolution": 16}.items() <= texture.to_settings().items()


def test_what_varies_by_chance_takes_all_but_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(python, "run_attack", lambda parts, *_: parts)
    job: Any = advsearch.attack("mug", controls=["geometry"], over=["texture:label"], **ALL)
    assert job.controls[0].to_settings() == {"epsilon": 0.07}
    assert job.random_controls[0].to_settings() == {"kind": "texture", "norm": "l2", "resolution": 16}


@pytest.mark.parametrize("asked", ["texture", "texture:object", {"label": {"kind": "texture"}}])
def test_a_sweep_and_a_render_give_every_texture_its_resolution(asked: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    job = load_job(SweepConfig(object="mug", controls=asked, texture_resolution=16))
    assert [one.chosen["resolution"] for one in job.controls if isinstance(one, TextureControl)] == [16]

    def rendered(scene: Any, model: Any, *, controls: Any, **more: Any) -> None:
        raise InterruptedError(controls[0].chosen["resolution"])

    monkeypatch.setattr(rendering, "render", rendered)
    config = RenderConfig(object="mug", controls=asked, texture_resolution=16, out="a.png")
    with pytest.raises(InterruptedError, match="16"):
        rendering.render_picture_file(config)


def test_a_control_alone_gets_what_it_takes() -> None:
    config = AttackConfig(object="mug", controls="texture,pose,geometry", **ALL)
    seen: list[Any] = []
    for control, settings_of_control in config.controls.items():
        changes = select_run_settings(config, control, settings_of_control)
        alone = AttackConfig.from_config(config, controls={control: settings_of_control}, **changes)
        check_run_settings(alone)
        seen.append((alone.epsilon, alone.norm, alone.texture_resolution))
    assert seen == [(0.07, "l2", 16), (None, None, None), (0.07, None, None)]


# ---- what nobody takes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("controls", "options", "message"),
    [
        ("pose", {"epsilon": 0.1}, "--epsilon pose: the control has ranges and no epsilon; give its ranges, as in"),
        (
            "pose,lens",
            {"norm": "l2"},
            "--norm: the control pose does not take it, nor does another one here; leave it out",
        ),
        ("patch", {"texture_resolution": 8}, "--texture-resolution: the control patch does not take it"),
        ("texture,pose", {"epsilon": "pose=1"}, "--epsilon pose: the control has ranges and no epsilon"),
        (
            "environment",
            {"epsilon": 0.1},
            "--epsilon environment: the control has ranges and no epsilon; give its ranges, as in --control "
            "'environment={PARAMETER: [LOW, HIGH]}', or search harmonics with it",
        ),
        ("texture,environment", {"epsilon": "environment=1"}, "--epsilon environment: the control has ranges"),
        ("environment.rotation", {"epsilon": 0.1}, "--epsilon environment: the control has ranges"),
        ("texture,pose", {"epsilon": (0.1, 0.2)}, "--epsilon pose: the control has ranges and no epsilon"),
        (
            {"patch": {"picture": "a.png", "azimuth": [0, 360]}},
            {"epsilon": 0.1},
            "--epsilon patch: the control has ranges and no epsilon; give its ranges, as in --control "
            "'patch={PARAMETER: [LOW, HIGH]}', or search pixels with it",
        ),
        ({"patch": {"pixels": 0.5, "size": [0.1, 0.3]}}, {"epsilon": 0.1}, "--epsilon patch: the control has ranges"),
        (
            {"patch": {"picture": "a.png", "size": [0.1, 0.3]}},
            {"norm": "l2"},
            "--norm: the control patch does not take it",
        ),
        (
            {"texture": {}, "sign": {"kind": "patch", "pixels": 0, "size": [0.1, 0.3]}},
            {"epsilon": "sign=0.1"},
            "--epsilon sign: the control has ranges and no epsilon",
        ),
    ],
)
def test_a_setting_that_no_control_takes_is_refused(controls: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        check_run_settings(AttackConfig(object="mug", controls=controls, **options))
    assert format_as_flags(str(error.value)).startswith(message)


@pytest.mark.parametrize(
    "controls",
    [
        ["environment.harmonics"],
        ["environment.harmonics", "environment.rotation"],
        {"environment": {"harmonics": [-1, 1]}},
    ],
)
def test_an_environment_takes_an_epsilon_for_its_harmonics(controls: Any) -> None:
    named = controls if isinstance(controls, dict) else {name: {} for name in controls}
    config = AttackConfig(object="mug", controls=named, epsilon=0.07)
    check_run_settings(config)
    (control,) = make_configured_controls(config, named)
    assert control.to_settings()["epsilon"] == 0.07


def test_an_environment_without_harmonics_refuses_an_epsilon_of_its_own() -> None:
    with pytest.raises(InputError, match=r"environment\.epsilon: the radius of the ball of harmonics, which are not"):
        make_control("environment", {"epsilon": 0.3})


@pytest.mark.parametrize("controls", ["patch", "patch.size", {"patch": {"pixels": [0.1, 0.9]}}])
def test_a_patch_takes_an_epsilon_for_searched_pixels(controls: Any) -> None:
    config = AttackConfig(object="mug", controls=controls, epsilon=0.07)
    check_run_settings(config)
    (control,) = make_configured_controls(config, config.controls)
    assert control.to_settings()["epsilon"] == 0.07


def test_an_epsilon_that_another_control_takes_leaves_a_fixed_patch() -> None:
    config = AttackConfig(
        object="mug", controls={"texture": {}, "patch": {"pixels": 0.5, "size": [0.1, 0.3]}}, epsilon=0.07
    )
    check_run_settings(config)
    texture, patch = make_configured_controls(config, config.controls)
    assert texture.to_settings()["epsilon"] == 0.07 and "epsilon" not in patch.to_settings()


def test_an_epsilon_that_another_control_takes_leaves_an_environment_as_it_is() -> None:
    config = AttackConfig(object="mug", controls="texture,environment", epsilon=0.07)
    check_run_settings(config)
    texture, environment = make_configured_controls(config, "texture,environment")
    assert texture.to_settings()["epsilon"] == 0.07 and "epsilon" not in environment.to_settings()


def test_an_epsilon_for_a_control_that_is_not_there_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown control in --epsilon 'texure'\. Did you mean 'texture'"):
        try:
            check_run_settings(AttackConfig(object="mug", epsilon="texure=1"))
        except UnknownNameError as error:
            error.args = (format_as_flags(str(error)),)
            raise


@pytest.mark.parametrize("setting", sorted(ALL))
def test_an_instance_says_its_own(setting: str) -> None:
    config = AttackConfig(object="mug", **{setting: ALL[setting]})
    with pytest.raises(InputError, match=rf"{setting}: control texture was given as an instance; set it there"):
        make_configured_controls(config, [PoseControl(), TextureControl()])
    assert make_configured_controls(config, [PoseControl()])[0].name == "pose"


@pytest.mark.parametrize("given", [{"estimators": {"*": "secant"}}, {"measure": "full"}])
def test_settings_of_derivatives_are_refused_beside_a_policy_that_takes_none(given: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="policy random takes no derivatives; leave one of the two out"):
        advsearch.attack("mug", policy="random", resolution=16, **given)


def test_a_region_has_no_samples_of_a_search(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["region", "--object", "mug", "--spp", "4"]) == 2
    assert "advsearch region has no --spp, a flag of advsearch" in capsys.readouterr().err
