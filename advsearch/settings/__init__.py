"""Typed configurations: each setting is declared once, and read from YAML, flags or
Python.

This package has the functions and base classes; `config` declares the settings.
"""

from __future__ import annotations

from advsearch.settings.configuration import (
    FILES,
    RUN_LOCATION,
    Clash,
    Config,
    PythonOnly,
    Setting,
    SettingsError,
    format_python_only,
    setting,
    setting_as_in,
    settings,
)
from advsearch.settings.values import (
    CONFIG,
    FOR_ALL,
    HEADER,
    are_all_finite,
    check_no_duplicates,
    format_value,
    join_names,
    merge_mappings,
    parse_assignment,
    parse_choices,
    parse_controls,
    parse_number_or_text,
    read_yaml,
    split_names,
    text_validator,
    to_python,
    to_text,
    unique_names_validator,
)
from advsearch.trust import powers

__all__ = [
    "CONFIG",
    "FILES",
    "FOR_ALL",
    "HEADER",
    "RUN_LOCATION",
    "Clash",
    "Config",
    "PythonOnly",
    "Setting",
    "SettingsError",
    "are_all_finite",
    "check_no_duplicates",
    "format_python_only",
    "format_value",
    "join_names",
    "merge_mappings",
    "parse_assignment",
    "parse_choices",
    "parse_controls",
    "parse_number_or_text",
    "powers",
    "read_yaml",
    "setting",
    "setting_as_in",
    "settings",
    "split_names",
    "text_validator",
    "to_python",
    "to_text",
    "unique_names_validator",
]
