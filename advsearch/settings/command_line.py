"""A setting as words of a command line."""

from __future__ import annotations

from typing import Any

import yaml

from advsearch.settings.declaration import Setting
from advsearch.settings.yaml_files import NAMED


def as_flags(setting: Setting, value: Any) -> list[str]:
    """Return the words of a command line that give `setting` the value."""
    if setting.form == "switch":
        return [setting.flag]
    if setting.form in ("assignments", "axes", "choices"):
        return [word for name, given in value.items() for word in (setting.flag, f"{name}={_number(given)}")]
    if setting.form == "controls":
        plain, tuned = [name for name in value if not value[name]], [name for name in value if value[name]]
        words = [setting.flag, ",".join(plain)] if plain else []
        return words + [word for name in tuned for word in (setting.flag, f"{name}={_flow(value[name])}")]
    if setting.field == "epsilon" and isinstance(value, (dict, tuple)):
        pairs = [f"{name}={_number(given)}" for name, given in value.items()] if isinstance(value, dict) else value
        return [setting.flag, ",".join(str(one) for one in pairs)]
    if setting.field in NAMED and isinstance(value, dict):
        options = {name: given for name, given in value.items() if name != "name"}
        return [setting.flag, f"{value['name']}={_flow(options)}"]
    if setting.field == "resolution":
        return ["--resolution", "x".join(str(side) for side in value)]
    return [f"{setting.flag}={_number(value)}"] if str(value).startswith("-") else [setting.flag, _number(value)]


def _flow(value: Any) -> str:
    """Return `value` as YAML on one line."""
    return str(yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)).strip()


def _number(value: Any) -> str:
    """Return a value as it is typed: 130 for 130.0, [0,0,1] for a list."""
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(_number(part) for part in value) + "]"
    return repr(int(value)) if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 else str(value)
