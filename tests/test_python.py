"""The Python interface as a person meets it: names, signatures, short texts, tables."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

import advsearch
from advsearch.config import AttackConfig, SceneConfig, SweepConfig

BY_SCENE = {"environment", "up", "set", "exposure"}
"""Settings that a loaded scene has already, so that they have no default of their own."""


def test_dir_lists_the_public_names() -> None:
    assert set(dir(advsearch)) == {*advsearch.__all__, "__version__"}


@pytest.mark.parametrize(("function", "config"), [(advsearch.attack, AttackConfig), (advsearch.sweep, SweepConfig)])
def test_signatures_have_every_setting_with_its_default(function: Any, config: type[SceneConfig]) -> None:
    parameters = inspect.signature(function).parameters
    assert not [one for one in parameters.values() if one.kind is one.VAR_KEYWORD]
    names = {"set" if name == "set_" else name for name in config.model_fields} - {"object"}
    assert names <= set(parameters) and set(parameters) - names <= {"scene", "resume", "progress"}
    for name in names - BY_SCENE - {"model", "controls", "over", "grid"}:
        default = config.model_fields[name].get_default(call_default_factory=True)
        assert parameters[name].default == (default or None if isinstance(default, dict) else default), name
    assert all(parameters[name].default is None for name in BY_SCENE)
    assert all(one.annotation is not inspect.Parameter.empty for one in parameters.values())


def test_an_argument_that_there_is_not_is_python_s_own_error() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'epsilonn'"):
        advsearch.attack("mug", epsilonn=0.1)  # type: ignore[call-arg]
