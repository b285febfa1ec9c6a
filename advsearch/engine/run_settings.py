"""What a run says for all of its controls at once, and which of them takes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from advsearch.controls import CONTROLS, Choice, Control, gathered, names_of
from advsearch.controls.values import is_number
from advsearch.engine.loading import CONTROL, Controls, as_controls, lent, settings_of
from advsearch.errors import InputError, UnknownNameError


@dataclass(frozen=True)
class RunSettings:
    """What a run says for all of its controls; each control declares what it takes of it (`Choice.run_setting`).

    Attributes:
        epsilon: how far a control may go, in its own unit: one for all, by the names of controls, or the several of a
            curve; None for each control's own.
        norm: how that distance is measured: "linf" or "l2"; None for each control's own.
        texture_resolution: side of a searched texture, texels; None for a choice by the object's own.
    """

    epsilon: float | Mapping[str, float] | tuple[float, ...] | None = None
    norm: str | None = None
    texture_resolution: int | None = None

    def given_to(self, controls: Controls) -> tuple[Control, ...]:
        """Return control instances, with what they take of this where they say nothing themselves.

        Args:
            controls: in any form; instances stay as they are.

        Raises:
            InputError: an instance takes a setting that is given here.
        """
        ready: tuple[Control, ...] = ()
        if not isinstance(controls, (str, Mapping)):
            controls = [controls] if isinstance(controls, Control) else list(controls)
            as_controls(controls)  # refuses what is none
            ready = tuple(one for one in controls if isinstance(one, Control))
            controls = [one for one in controls if isinstance(one, str)]
        named = settings_of(controls)
        for one in (*ready, *(found for name in named if (found := lent(CONTROL, name)))):
            for choice in _counting(type(one), one.settings()):
                if choice.run_setting and getattr(self, choice.run_setting) is not None:
                    raise InputError(
                        f"{choice.run_setting}: control {one.name} is an instance already; give it its own, as in "
                        f"{type(one).__name__}({choice.name}=...)"
                    )
        return ready + as_controls({asked: {**self._taken(asked, given), **given} for asked, given in named.items()})

    def _taken(self, asked: str, given: Mapping[str, object]) -> dict[str, object]:
        """What one control takes, by the names of its own settings."""
        _, name = names_of(asked, given)
        taken = {one.name: self._value(one.run_setting, name) for one in _choices(asked, given) if one.run_setting}
        return {own: value for own, value in taken.items() if value is not None}

    def _value(self, setting: str, name: str) -> Any:
        """The value of a setting for the control of a name."""
        value = getattr(self, setting)
        return value.get(name) if isinstance(value, Mapping) else None if isinstance(value, tuple) else value

    def alone(self, asked: str, given: Mapping[str, object]) -> RunSettings:
        """Return what a run over one of the controls says: None for what that does not take."""
        _, name = names_of(asked, given)
        kept = {}
        for setting, value in vars(self).items():
            if isinstance(value, Mapping):
                value = {own: number for own, number in value.items() if own == name} or None
            kept[setting] = value if takes(asked, given, setting) else None
        return RunSettings(**kept)

    def check(
        self, searched: Mapping[str, Mapping[str, object]], drawn: Mapping[str, Mapping[str, object]] | None = None
    ) -> None:
        """Refuse a setting that none of the controls takes.

        Args:
            searched: the controls that are searched.
            drawn: those that vary by chance, which have no epsilon.

        Raises:
            UnknownNameError: an epsilon for a control that is not searched.
            InputError: no control takes it, or not the one that it names.
        """
        for setting, value in vars(self).items():
            if value is None:
                continue
            asked = gathered(searched if setting == "epsilon" else {**searched, **(drawn or {})})
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
    return InputError(f"{setting}: {name} has none, and no other control is there that has one; leave it out")


def _bounded(kind: str) -> str:
    """What a control would take an epsilon for, in words; nothing if there is no such thing."""
    choices = CONTROLS[kind].choices if kind in CONTROLS else ()
    bounded = [choice.bounds for choice in choices if choice.run_setting == "epsilon" and choice.bounds]
    return f", or search {bounded[0]} with it" if bounded else ""
