"""The machinery of a typed configuration: settings with one description each, read from
YAML, flags and Python alike.

`config` declares the settings themselves.
"""

from __future__ import annotations

from advsearch.settings.configuration import (
    FILES,
    PLACE,
    Clash,
    Config,
    PythonOnly,
    Setting,
    SettingsError,
    python_only_text,
    setting,
    setting_as_in,
    settings,
)
from advsearch.settings.values import (
    CONFIG,
    FOR_ALL,
    HEADER,
    all_finite,
    as_python,
    as_text,
    check_once,
    each_once,
    merged,
    names_together,
    number_or_text,
    parse_assignment,
    parse_choices,
    read_controls,
    read_yaml,
    shown,
    split_names,
    texts,
)
from advsearch.trust import powers

__all__ = [
    "CONFIG",
    "FILES",
    "FOR_ALL",
    "HEADER",
    "PLACE",
    "Clash",
    "Config",
    "PythonOnly",
    "Setting",
    "SettingsError",
    "all_finite",
    "as_python",
    "as_text",
    "check_once",
    "each_once",
    "merged",
    "names_together",
    "number_or_text",
    "parse_assignment",
    "parse_choices",
    "powers",
    "python_only_text",
    "read_controls",
    "read_yaml",
    "setting",
    "setting_as_in",
    "settings",
    "shown",
    "split_names",
    "texts",
]
