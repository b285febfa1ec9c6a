"""Flags made from the settings of `AttackConfig`, and a configuration made from flags.

Values stay text until the configuration reads them, so that a wrong one is reported in one way wherever it came from.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from advsearch.config import AttackConfig, Setting, parse_assignment, settings

GROUPS = {
    "scene": "scene",
    "model": "model",
    "search": "search",
    "verification": "verification",
    "run": "run",
}

_LISTS = ("controls", "set_")


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add a flag for every setting, under the heading of its group."""
    groups = {name: parser.add_argument_group(heading) for name, heading in GROUPS.items()}
    for setting in settings():
        group = groups[setting.group]
        if setting.is_switch:
            group.add_argument(
                setting.flag,
                dest=setting.field,
                action="store_const",
                const=not setting.default,
                default=argparse.SUPPRESS,
                help=help_text(setting),
            )
        else:
            group.add_argument(
                setting.flag,
                dest=setting.field,
                action="append" if setting.field in _LISTS else "store",
                default=argparse.SUPPRESS,
                metavar=_metavar(setting),
                help=help_text(setting),
            )


def config_from(args: argparse.Namespace) -> AttackConfig:
    """Return the configuration that the flags describe.

    Raises:
        InputError: a value is not allowed; the message names the flag.
    """
    known = {setting.field for setting in settings()}
    data: dict[str, Any] = {name: value for name, value in vars(args).items() if name in known}
    if "controls" in data:
        data["controls"] = _controls(data["controls"])
    if "set_" in data:
        data["set_"] = dict(parse_assignment(text, "--set") for text in data["set_"])
    return AttackConfig.from_flags(data)


def help_text(setting: Setting) -> str:
    """Return what the help says of a setting: what it is, its values with range and unit, and its default."""
    if setting.is_switch:
        without = {"baseline": "without the random search that runs beside the search"}
        return without.get(setting.field, setting.description)
    unit = f", in {setting.unit}" if setting.unit else ""
    default = setting.otherwise if setting.default is None else _default(setting.default)
    text = f"{setting.description}: {setting.expects}{unit}" + (f" (default: {default})" if default else "")
    return text.replace("%", "%%")


def _controls(given: Sequence[str]) -> dict[str, Any]:
    """Return control to parameters from ``texture,pose`` and ``texture={resolution: 64}``."""
    found: dict[str, Any] = {}
    for text in given:
        if "=" in text:
            name, parameters = parse_assignment(text, "--control")
            found[name] = parameters
        else:
            found.update({name.strip(): {} for name in text.split(",") if name.strip()})
    return found


def _metavar(setting: Setting) -> str:
    names = {"set_": "PARAMETER=VALUE", "controls": "NAME", "labels": "FILE"}
    return names.get(setting.field, setting.field.rpartition("_")[2].upper())


def _default(value: Any) -> str:
    if isinstance(value, dict):
        return ",".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)
