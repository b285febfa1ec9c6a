"""Flags made from the settings of `AttackConfig`, and a configuration made from flags.

Values stay text until the configuration reads them, so that a wrong one is reported in one way wherever it came from.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import Any, TypeVar

from advsearch.config import CONFIGS, AttackConfig
from advsearch.settings import Config, Setting, check_once, parse_assignment, settings

GROUPS = {
    "scene": "scene",
    "model": "model",
    "search": "search",
    "sweep": "sweep",
    "region": "region",
    "check": "check",
    "picture": "picture",
    "verification": "verification",
    "run": "run",
}

_NO_SETTINGS = {"code": "--code"}
"""Flags which messages name too and which are no setting of a configuration."""

_LISTS = ("controls", "over", "set_", "estimators", "grid", "case", "group")

Given = TypeVar("Given", bound=Config)


def add_settings(
    parser: argparse.ArgumentParser,
    groups: Sequence[str] = tuple(GROUPS),
    fields: Sequence[str] = (),
    config: type[Config] = AttackConfig,
    without: Sequence[str] = (),
) -> None:
    """Add flags for settings, under the headings of their groups.

    Args:
        parser: gets them.
        groups: all settings of these groups.
        fields: and these settings.
        config: whose settings.
        without: but not these settings.
    """
    asked = [one for one in settings(config) if one.group in groups or one.field in fields]
    wanted = [one for one in asked if one.field not in without]
    headings = {one.group: parser.add_argument_group(GROUPS[one.group]) for one in wanted}
    for setting in wanted:
        group = headings[setting.group]
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


def config_from(args: argparse.Namespace, config: type[Given], **otherwise: Any) -> Given:
    """Return the configuration that the flags describe.

    Args:
        args: parsed flags.
        config: of which kind.
        **otherwise: values for settings that were not given.

    Raises:
        InputError: a value is not allowed.
    """
    known = {setting.field for setting in settings(config)}
    data: dict[str, Any] = {name: value for name, value in vars(args).items() if name in known}
    for name, flag in (("controls", "--control"), ("over", "--over")):
        if name in data:
            data[name] = _controls(data[name], flag)
    for name, flag in (("set_", "--set"), ("grid", "--grid")):
        if name in data:
            data[name] = _assignments(data[name], flag)
    if "estimators" in data:
        pairs = [text if "=" in text else f"*={text}" for text in data["estimators"]]
        data["estimators"] = _assignments(pairs, "--estimator")
    return config(**{**otherwise, **data})


def with_flags(message: str) -> str:
    """Return an error's message with the flags of the settings that it names.

    Messages name a setting as Python and YAML do: before a colon at their beginning, or else in backticks, with a value
    or without. ``epsilon: ...; lower `steps` or use `denoise=none` `` becomes
    ``--epsilon: ...; lower --steps or use --denoise none``.
    """
    known = [one for config in CONFIGS.values() for one in settings(config)]
    flags = {**_NO_SETTINGS, **{one.name: one.flag for one in known}}
    switches = {one.name for one in known if one.is_switch}

    def written(match: re.Match[str]) -> str:
        name, value = match["name"], match["value"]
        return flags[name] if value is None or name in switches else f"{flags[name]} {value}"

    names = f"(?P<name>{'|'.join(flags)})"
    message = re.sub(rf"`{names}(=(?P<value>[^`]*))?`", written, message)
    return re.sub(rf"(?P<before>^|; ){names}(?=: )", lambda match: match["before"] + flags[match["name"]], message)


def help_text(setting: Setting) -> str:
    """Return what the help says of a setting: what it is, its values with range and unit, and its default."""
    if setting.is_switch:
        without = {
            "baseline": "without the random search that runs beside the search",
            "specialise": "compute what the scene and the search don't need too; `advsearch plan` shows what that is",
        }
        return without.get(setting.field, setting.description)
    unit = f", in {setting.unit}" if setting.unit else ""
    default = setting.otherwise if setting.default is None else _default(setting.default)
    text = f"{setting.description}: {setting.expects}{unit}" + (f" (default: {default})" if default else "")
    return text.replace("%", "%%")


def _assignments(given: Sequence[str], flag: str) -> dict[str, Any]:
    """Return name to value from ``NAME=VALUE``, each name once."""
    pairs = [parse_assignment(text, flag) for text in given]
    check_once((name for name, _ in pairs), flag)
    return dict(pairs)


def _controls(given: Sequence[str], flag: str) -> dict[str, Any]:
    """Return control to settings from ``texture,pose``, ``texture={resolution: 64}`` and ``pose,texture={...}``."""
    found: list[tuple[str, Any]] = []
    for text in given:
        names, equals, settings_text = text.partition("=")
        plain = [name.strip() for name in names.split(",") if name.strip()]
        last = [plain.pop() if plain else ""] if equals else []
        found += [(name, {}) for name in plain]
        found += [parse_assignment(f"{name}={settings_text}", flag) for name in last]
    check_once((name for name, _ in found), flag)
    return dict(found)


def _metavar(setting: Setting) -> str:
    names = {
        "set_": "PARAMETER=VALUE",
        "controls": "NAME",
        "over": "NAME",
        "grid": "PARAMETER=VALUES",
        "labels": "FILE",
        "estimators": "NAME",
    }
    return names.get(setting.field, setting.field.rpartition("_")[2].upper())


def _default(value: Any) -> str:
    if isinstance(value, dict):
        return ",".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)
