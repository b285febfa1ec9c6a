"""A setting of the whole run reaches every control that declares it, by whatever name and in whatever command."""

from typing import Any

import pytest

from advsearch.cli.flags import format_as_flags
from advsearch.engine.naming import check_run_settings, make_configured_controls
from advsearch.errors import InputError
from advsearch.questions.attack.settings import AttackConfig

ALL: dict[str, Any] = {"epsilon": 0.07, "norm": "l2", "texture_resolution": 16}


def settings(controls: Any, **options: Any) -> dict[str, dict[str, object]]:
    """Settings of the controls of an attack, by the name of the instance."""
    config = AttackConfig(object="mug", controls=controls, **options)
    return {one.name: one.to_settings() for one in make_configured_controls(config, config.controls)}


@pytest.mark.parametrize(("asked", "name"), [("texture", "texture"), ("texture.texels:label", "texture:label")])
def test_a_control_takes_the_settings_of_the_run_whatever_its_name(asked: str, name: str) -> None:
    found = settings({asked: {}}, **ALL)[name]
    assert (found["epsilon"], found["norm"], found["resolution"]) == (0.07, "l2", 16)


def test_an_epsilon_for_one_control_leaves_the_others_their_own() -> None:
    found = settings("texture,geometry,texture:label", epsilon="geometry=0.02,texture:label=0.3")
    assert [one.get("epsilon") for one in found.values()] == [None, 0.02, 0.3]


@pytest.mark.parametrize(
    ("controls", "options", "message"),
    [
        ("pose", {"epsilon": 0.1}, "--epsilon pose: the control has ranges and no epsilon; give its ranges, as in"),
        pytest.param(
            "pose,lens",
            {"norm": "l2"},
            "--norm: the control pose does not take it, nor does another one here; leave it out",
            marks=pytest.mark.island("advsearch.controls.lens"),
        ),
        pytest.param(
            {"patch": {"picture": "a.png", "azimuth": [0, 360]}},
            {"epsilon": 0.1},
            "--epsilon patch: the control has ranges and no epsilon; give its ranges, as in --control "
            "'patch={PARAMETER: [LOW, HIGH]}', or search pixels with it",
            marks=pytest.mark.island("advsearch.controls.patch"),
        ),
    ],
)
def test_a_setting_that_no_control_takes_is_refused(controls: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        check_run_settings(AttackConfig(object="mug", controls=controls, **options))
    assert format_as_flags(str(error.value)).startswith(message)
