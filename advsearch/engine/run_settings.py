"""What a run says for all of its controls at once, and which of them takes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from advsearch.config import SceneConfig
from advsearch.controls import CONTROLS, Choice, Control, gathered, names_of
from advsearch.controls.values import is_number
from advsearch.engine.loading import CONTROL, Controls, as_controls, controls_by_name, lent
from advsearch.errors import InputError, UnknownNameError

RUN_SETTINGS = ("epsilon", "norm", "texture_resolution", "path")
"""What a configuration says for all of its controls; each control declares what it takes of it (`Choice.run_setting`).
A configuration without such a setting counts as one that does not say it."""


def given_to(config: SceneConfig, controls: Controls) -> tuple[Control, ...]:
    """Return control instances, with what they take of the configuration where they say nothing themselves.

    Args:
        config: of the run.
        controls: in any form; instances stay as they are.

    Raises:
        InputError: an instance takes a setting that is given here.
    """
    asked = controls_by_name(controls)
    as_controls(controls)  # refuses what is none
    for one in (one if isinstance(one, Control) else lent(CONTROL, name) for name, one in asked.items()):
        for choice in _counting(type(one), one.settings()) if one is not None else ():
            if getattr(config, choice.run_setting, None) is not None:
                raise InputError(
                    f"{choice.run_setting}: control {one.name} is an instance already; give it its own, as in "
                    f"{type(one).__name__}({choice.name}=...)"
                )
    return as_controls(
        {name: one if isinstance(one, Control) else {**_taken(config, name, one), **one} for name, one in asked.items()}
    )


def alone(config: SceneConfig, asked: str, given: Mapping[str, object]) -> dict[str, Any]:
    """Return what a run over one of the controls says: None for what that does not take."""
    _, name = names_of(asked, given)
    kept = {}
    for setting in RUN_SETTINGS:
        value = getattr(config, setting, None)
        if isinstance(value, Mapping):
            value = {own: number for own, number in value.items() if own == name} or None
        kept[setting] = value if takes(asked, given, setting) else None
    return kept


def check(config: SceneConfig) -> None:
    """Refuse a setting that none of the controls takes; those that vary by chance have no epsilon.

    Raises:
        UnknownNameError: an epsilon for a control that is not searched.
        InputError: no control takes it, or not the one that it names.
    """
    for setting in RUN_SETTINGS:
        value = getattr(config, setting, None)
        if value is None:
            continue
        drawn = {} if setting == "epsilon" else getattr(config, "over", {})
        asked = gathered({**config.controls, **drawn})
        if isinstance(value, Mapping):
            known = {names_of(one, given)[1]: one for one, given in asked.items()}
            for name in value:
                if name not in known:
                    raise UnknownNameError(f"control in `{setting}`", name, known)
                if not takes(known[name], asked[known[name]], setting):
                    raise _not_taken(setting, name, names_of(known[name], asked[known[name]])[0])
            continue
        without = [one for one, given in asked.items() if not takes(one, given, setting)]
        if without and (isinstance(value, tuple) or len(without) == len(asked)):
            raise _not_taken(setting, without[0], names_of(without[0], asked[without[0]])[0])


def _taken(config: SceneConfig, asked: str, given: Mapping[str, object]) -> dict[str, object]:
    """What one control takes, by the names of its own settings."""
    _, name = names_of(asked, given)
    taken = {}
    for choice in _choices(asked, given):
        value = getattr(config, choice.run_setting, None)
        value = value.get(name) if isinstance(value, Mapping) else value
        if value is not None and not isinstance(value, tuple):  # the several epsilons of a curve: each run has its own
            taken[choice.name] = value
    return taken


def takes(asked: str, given: Mapping[str, object], setting: str) -> bool:
    """Whether a control takes one of the run's settings; one that is not known counts as one that does."""
    kind, _ = names_of(asked, given)
    return kind not in CONTROLS or setting in {choice.run_setting for choice in _choices(asked, given)}


def _choices(asked: str, given: Mapping[str, object]) -> list[Choice]:
    """The choices of a control, as it is asked for, that count."""
    ((name, settings),) = gathered({asked: given}).items()
    kind, _ = names_of(name, settings)
    return _counting(CONTROLS[kind], settings) if kind in CONTROLS else []


def _counting(kind: type[Control], given: Mapping[str, object]) -> list[Choice]:
    """The choices that count beside the settings that are given: what they are about is searched."""
    return [choice for choice in kind.choices if not choice.bounds or _is_searched(kind, choice.bounds, given)]


def _is_searched(kind: type[Control], parameter: str, given: Mapping[str, object]) -> bool:
    """Whether a parameter of a control is searched beside the settings that are given."""
    if any(choice.fixes == parameter and given.get(choice.name) is not None for choice in kind.choices):
        return False
    if given.get(parameter) is not None:
        return not is_number(given[parameter])
    return any(one.name == parameter and one.search is not None for one in kind.parameters)


def _not_taken(setting: str, name: str, kind: str) -> InputError:
    if setting == "epsilon":
        return InputError(
            f"`epsilon` {name}: the control has ranges and no epsilon; give its ranges, as in "
            f"`controls` '{name}={{PARAMETER: [LOW, HIGH]}}'{_bounded(kind)}"
        )
    if setting == "path":
        return InputError(f"path: {name} does not travel; add `over=path` beside it, or `controls=path`")
    return InputError(f"{setting}: {name} has none, and no other control is there that has one; leave it out")


def _bounded(kind: str) -> str:
    """What a control would take an epsilon for, in words; nothing if there is no such thing."""
    choices = CONTROLS[kind].choices if kind in CONTROLS else ()
    bounded = [choice.bounds for choice in choices if choice.run_setting == "epsilon" and choice.bounds]
    return f", or search {bounded[0]} with it" if bounded else ""
