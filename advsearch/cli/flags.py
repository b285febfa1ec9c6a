"""Make flags from the settings of a command, and a configuration from flags or a file.

The configuration parses the values, which are strings. So a wrong value gets the same
message whether it came from a flag or from a file.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from advsearch.config import CONFIGS
from advsearch.errors import InputError, UnknownNameError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.settings import Config, Setting, read_yaml, settings, split_names
from advsearch.trust.code import allow_code_in_settings

# Flags that messages name too, although they belong to no setting.
_OTHER_FLAGS = {
    "code": "--code",
    "sheets": "--sheets",
    "paper": "--paper",
    "size": "--size",
}

SCENE_HELP = (
    "a .glb or .gltf file, or a Mitsuba .xml file: --object is the name of one of its "
    "nodes or shapes, and the rest of the file is the surroundings (the same as "
    "--object FILE#NAME)"
)

# Commands that a file may name in `command`.
COMMANDS_OF_FILES = tuple(name for name in CONFIGS if name != "render")
MAX_NAMES = 50  # maximum number of names in a scene that a message lists

AnyConfig = TypeVar("AnyConfig", bound=Config)


def add_settings(
    parser: argparse.ArgumentParser,
    config: type[Config] = AttackConfig,
    only: Collection[str] = (),
) -> None:
    """Add a flag for each setting of a configuration to a parser, under the headings of
    their groups.

    Args:
        parser: parser of a command.
        config: the class of the configuration.
        only: fields of settings to add; empty for all.
    """
    headings: dict[str, argparse._ArgumentGroup] = {}
    for setting in settings(config):
        if only and setting.field not in only:
            continue
        if setting.group not in headings:
            headings[setting.group] = parser.add_argument_group(setting.group)
        _add_setting(headings[setting.group], setting)


def _add_setting(group: argparse._ArgumentGroup, setting: Setting) -> None:
    """Add the flag of a setting to the help's group; with --object also --scene."""
    # SUPPRESS: a flag that was not given is absent from the arguments
    add = partial(group.add_argument, default=argparse.SUPPRESS)
    if setting.field == "object":
        # --scene is a flag but no setting: with it, the values of --object are names
        # in the scene file. The help lists it before --object.
        add("--scene", metavar="FILE", help=SCENE_HELP)
    options: dict[str, Any] = {
        "action": "append" if setting.repeats else "store",
        "metavar": setting.metavar,
    }
    if setting.is_switch:
        # a flag without a value, which sets the opposite of the default
        options = {"action": "store_const", "const": not setting.default}
    add(setting.flag, dest=setting.field, help=format_help(setting), **options)


def make_config(
    args: argparse.Namespace, config_type: type[AnyConfig], **defaults: Any
) -> AnyConfig:
    """Return the configuration that flags describe.

    Args:
        args: arguments of the command line; a flag that was not given is absent.
        config_type: the class of the configuration.
        defaults: values of settings whose flags were not given.

    Raises:
        InputError: a value is not allowed.
    """
    typed = {
        setting.field: getattr(args, setting.field)
        for setting in settings(config_type)
        if setting.field in args
    }
    data = {**defaults, **typed}
    if "scene" in args:
        data["object"] = _prefix_with_scene_file(data.get("object"), args.scene)
    config = config_type(**data)
    # Python code that these settings name may run, since the user typed them. Those in
    # `defaults` come from the file of a run; code in them needs --code. The
    # configuration is made first, since it parses the strings of the flags.
    allow_code_in_settings({name: getattr(config, name) for name in typed})
    return config


def _prefix_with_scene_file(object_names: Any, scene: str) -> Any:
    """Return the names of objects as those in a scene file: ``FILE#NAME``.

    Args:
        object_names: the value of ``--object``: names with commas in between. Other
            values are returned as they are.
        scene: the scene file.

    Raises:
        InputError: the value is None.
    """
    if object_names is None:
        raise InputError(
            f"object: expected something in {scene}, got nothing; "
            f"name one of {_format_object_names(scene)}"
        )
    if isinstance(object_names, str):
        return ",".join(f"{scene}#{name}" for name in split_names(object_names))
    return object_names


def read_command(file: str | Path) -> str:
    """Return the command that a file of settings is for; "attack" if it names none.

    Raises:
        FileFormatError: it is no file with settings.
    """
    return str(read_yaml(file).get("command", "attack"))


def read_file_config(
    command: str, file: str | Path, changes: Mapping[str, object]
) -> Config:
    """Return the configuration that a file describes.

    Args:
        command: command that the file names, from `read_command`.
        file: YAML file with settings.
        changes: values by name that replace those of the file.

    Raises:
        UnknownNameError: there is no such command.
    """
    if command not in COMMANDS_OF_FILES:
        raise UnknownNameError(
            "command", command, COMMANDS_OF_FILES, f"It stands in {file}."
        )
    return CONFIGS[command].from_yaml(file, changes)


def _format_object_names(scene: str) -> str:
    """Return the names in a scene file that can be the object, as text for a message.

    Raises:
        InputError: there is none.
    """
    # late, so that --help answers at once
    from advsearch.scene.importing.files import format_name

    path = Path(scene)
    names = _list_object_names(path)
    if not names:
        raise InputError(
            f"--scene: {path} has nothing that can be the object; "
            "expected a shape or a node with a mesh"
        )
    text = ", ".join(format_name(name, quoted=False) for name in names[:MAX_NAMES])
    n_omitted = len(names) - MAX_NAMES
    return f"{text} or {n_omitted:,} more" if n_omitted > 0 else text


def _list_object_names(path: Path) -> Sequence[str]:
    """Return the names of nodes or shapes in a scene file that can be the object."""
    # late, so that --help answers at once
    from advsearch.scene.importing.scenes import MITSUBA_SUFFIX, list_node_names
    from advsearch.scene.mitsuba_backend.scene_files import read_contents

    if path.suffix.lower() == MITSUBA_SUFFIX:
        return read_contents(path).objects
    return list_node_names(path)


def format_as_flags(message: str) -> str:
    """Return an error's message with settings written as flags.

    Messages name a setting as Python and YAML do: before a colon at the beginning of a
    clause, or in backticks, with or without a value. Example: ``epsilon: ...; lower
    `steps` or use `denoise=none` `` becomes ``--epsilon: ...; lower --steps or use
    --denoise none``.
    """
    known = [setting for config in CONFIGS.values() for setting in settings(config)]
    flags = {**_OTHER_FLAGS, **{setting.name: setting.flag for setting in known}}
    switches = {setting.name for setting in known if setting.is_switch}
    # A pattern for any known setting. If one name begins with another, both still match
    # correctly: in each use "=", a backtick or ": " has to follow the name.
    names = f"(?P<name>{'|'.join(flags)})"
    # in backticks, perhaps with a value
    message = re.sub(
        rf"`{names}(=(?P<value>[^`]*))?`",
        lambda match: _write_flag(match, flags, switches),
        message,
    )
    # before a colon, at the beginning of the message or of a clause
    return re.sub(
        rf"(?P<before>^|; ){names}(?=: )",
        lambda match: match["before"] + flags[match["name"]],
        message,
    )


def _write_flag(
    match: re.Match[str], flags: Mapping[str, str], switches: Collection[str]
) -> str:
    """Return the flag of a setting in a message, with its value if it takes one.

    Args:
        match: the setting, with the groups "name" and "value".
        flags: the flag of each setting.
        switches: names of settings whose flags take no value.
    """
    name = match["name"]
    value = match["value"]
    if value is None or name in switches:
        return flags[name]
    return f"{flags[name]} {value}"


def format_help(setting: Setting) -> str:
    """Return the help text of a setting; for a switch, what its flag does."""
    text = setting.text
    if setting.is_switch:
        text = setting.switched or setting.description
    return text.replace("%", "%%")  # for argparse, "%" begins a field
