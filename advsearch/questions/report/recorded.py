"""The settings that a run recorded: its own, and those of the claims and runs that it
is based on.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from advsearch.extend import (
    Config,
    RunDirectory,
    directory,
    errors,
    results,
    settings,
    wording,
    workbench,
)

# kind of the settings that a suite noted: those of each claim
CLAIM_KIND = "claim"
NOT_SETTINGS = ("schema", "command", "base", *settings.RUN_LOCATION)
"""Keys of `run.yaml` that are not settings of the experiment."""
# settings whose value is a run of an attack
ATTACK_SETTINGS = ("attack", "adversarial_of", "around")
DEFAULT_TASK = "classification"
# maximum number of characters of a value
MAX_VALUE_LENGTH = 2000


@dataclass
class RecordedSettings:
    """Settings as a run recorded them.

    Attributes:
        source: name of the claim or the run that has these settings; empty for the
            run's own.
        values: values by name, as the file states them.
    """

    source: str
    values: Mapping[str, Any]

    @property
    def is_of_scene(self) -> bool:
        """Whether they describe images of a scene, and do not only name other runs."""
        return bool(self.values.get("object"))

    @property
    def task(self) -> str:
        """The task in words, with its thresholds."""
        return describe_task(
            self.values.get("task") or DEFAULT_TASK, self.values.get("objective")
        )

    def as_text(self) -> dict[str, str]:
        """Return every setting that has an effect as text.

        The key is the name of the setting. Settings of another claim or run have its
        name before theirs, as in "NAME: seed".
        """
        prefix = f"{self.source}: " if self.source else ""
        texts = dict[str, str]()
        for name, value in self.values.items():
            if name in NOT_SETTINGS or not self._is_used(name, value):
                continue
            # `task` has the task's options, too.
            text = self.task if name == "task" else _shorten(value)
            texts[f"{prefix}{name}"] = text
        return texts

    def _is_used(self, name: str, value: object) -> bool:
        """Return whether a setting has an effect.

        A value that differs from the default has one. A default value has none if it is
        empty, if the command renders nothing, or if the setting has no meaning together
        with the others, such as `fps` without a path. A command that takes an object
        but names none renders nothing. A name that is not a setting of the command
        counts as a default value.
        """
        differs = name in self._defaults and value != self._defaults[name]
        if differs:
            return True
        takes_object = "object" in self._defaults
        renders_nothing = takes_object and not self.is_of_scene
        if renders_nothing or name in self._meaningless:
            return False
        is_empty = value is None or value is False or value in ("", {}, [], ())
        return not is_empty

    @cached_property
    def _config_class(self) -> type[Config] | None:
        """The class of the command's settings; None if the command is unknown."""
        command = str(self.values.get("command") or "")
        with suppress(errors.AdvsearchError, KeyError):
            config_class: type[Config] = workbench.get_experiment(command).settings
            return config_class
        return None

    @cached_property
    def _defaults(self) -> dict[str, Any]:
        """The default of each setting of the command; None for a required one."""
        if self._config_class is None:
            return {}
        return {
            setting.name: None if setting.required else setting.default
            for setting in settings.settings(self._config_class)
        }

    @cached_property
    def _meaningless(self) -> set[str]:
        """The settings that have no meaning together with the other recorded settings.

        These are settings that a command would reject, such as `fps` without a path of
        the camera. If the recorded settings are not valid any more, since versions or
        files have changed after the run, nothing is known and the set is empty.
        """
        if self._config_class is None:
            return set()
        values = {
            name: value
            for name, value in self.values.items()
            if name not in NOT_SETTINGS
        }
        try:
            return _find_meaningless(self._config_class, values)
        except errors.AdvsearchError:
            return set()


def _find_meaningless(
    config_class: type[Config], values: Mapping[str, Any]
) -> set[str]:
    """Return the names of settings that have no meaning together with the others.

    Raises:
        SettingsError: the settings are not valid; it is not an error of pydantic.
    """
    config = config_class(**values)
    # Fields such as `set_` have an underscore that the setting does not have.
    return {
        clash.setting.rstrip("_")
        for clash in config_class.clashes
        if clash.with_others(config)
    }


def describe_task(task: Any, objective: object) -> str:
    """Return a task in words with all of its options, also default ones.

    If no options are known, it is the task as it was recorded.

    Args:
        task: name of the task, or a mapping with its name and options.
        objective: an objective that defines success, or None.
    """
    options = ", ".join(
        f"{option} {wording.format_number(value)}"
        for option, value in _list_task_options(task, objective).items()
    )
    if not options:
        return _shorten(task)
    name = task.get("name") if isinstance(task, Mapping) else task
    return f"{name} ({options})"


def _shorten(value: object) -> str:
    """Return a value as text, shortened if it is long."""
    text = value
    if not isinstance(text, str):
        text = json.dumps(value, ensure_ascii=False, default=str)
    if len(text) <= MAX_VALUE_LENGTH:
        return text
    return f"{text[:MAX_VALUE_LENGTH]}... ({len(text)} characters)"


def _list_task_options(recorded_task: Any, objective: object) -> dict[str, Any]:
    """Return the options of a task by name.

    For an ensemble, options have the name of their task before theirs, as in
    "NAME.OPTION". Options that the run sets itself are left out, and so are empty ones.
    The result is empty if the task cannot be made any more.

    Args:
        recorded_task: the recorded setting `task`.
        objective: the recorded setting `objective`, if it is a name.
    """
    options = dict[str, Any]()
    with suppress(errors.AdvsearchError):
        task = workbench.make_task(recorded_task)
        if isinstance(objective, str):
            task = task.with_objective(objective)
        task_of_prefix = {"": task}
        if isinstance(task, workbench.EnsembleTask):
            task_of_prefix = {f"{part.name}.": part for part in task.parts}
        for prefix, part in task_of_prefix.items():
            for name, value in _list_single_options(part).items():
                options[f"{prefix}{name}"] = value
    return options


def _list_single_options(task: Any) -> dict[str, Any]:
    """Return the options of one task that are not empty, without those of the run."""
    options = dict[str, Any]()
    for option in fields(task):
        value = getattr(task, option.name)
        is_set_by_run = option.metadata == workbench.FROM_RUN
        is_empty = value in (None, "", (), False)
        if not is_set_by_run and not is_empty:
            options[option.name] = value
    return options


def read_run_settings(folder: Path) -> Mapping[str, Any]:
    """Return the settings in the `run.yaml` of a run; empty if it cannot be read."""
    with suppress(errors.AdvsearchError):
        return settings.read_yaml(folder / directory.CONFIG)
    return {}


def find_read_sweeps(result: results.Result) -> list[Path]:
    """Return the directories of the sweeps that a result was made from.

    Sweeps that do not exist any more are left out.
    """
    sweeps = getattr(result, "sweeps", ())  # of an explanation
    sides = getattr(result, "sides", ())  # of a comparison
    return _find_runs([*sweeps, *(side.run for side in sides)])


def find_read_attacks(values: Mapping[str, Any]) -> list[Path]:
    """Return the directories of the attacks that settings name, if they exist."""
    return _find_runs([values.get(name) for name in ATTACK_SETTINGS])


def _find_runs(names: Iterable[object]) -> list[Path]:
    """Return the directories of runs that exist, each name once."""
    folders = list[Path]()
    for name in dict.fromkeys(name for name in names if isinstance(name, str) and name):
        with suppress(errors.AdvsearchError, OSError, ValueError):
            folders.append(directory.find_run(name))
    return folders


def collect_settings(
    folder: Path, result: results.Result, read_paths: Sequence[Path]
) -> list[RecordedSettings]:
    """Return the settings of a run, of the claims it tested, and of runs that it read.

    The run of a suite tests claims, each with settings of its own.

    Args:
        folder: directory of the run.
        result: result of the run.
        read_paths: directories of the runs that it read.
    """
    recorded = [RecordedSettings(source="", values=read_run_settings(folder))]
    for kind, settings_by_name in (read_noted_settings(folder, result) or {}).items():
        recorded += [
            RecordedSettings(f"{kind} {name}", values)
            for name, values in settings_by_name.items()
        ]
    return recorded + [
        RecordedSettings(directory.format_run_name(path), read_run_settings(path))
        for path in read_paths
    ]


def read_noted_settings(
    folder: Path, result: results.Result
) -> Mapping[str, Mapping[str, Mapping[str, Any]]] | None:
    """Return the settings that a run noted in addition to its own.

    The run of a suite notes the settings of its claims and of its counterexamples.

    Returns:
        The settings by kind, such as "claim", then by the name of the claim. Empty if
        they cannot be read; None if the run's command notes none.
    """
    hook = workbench.get_experiment(result.command).noted_settings
    if hook is None:
        return None
    noted: Mapping[str, Mapping[str, Mapping[str, Any]]] = {}
    with suppress(errors.AdvsearchError):
        noted = hook(folder, result)
    return noted


def join_setting_values(
    recorded: Iterable[RecordedSettings], name: str, otherwise: str = ""
) -> str:
    """Return the different values of a setting as text, separated by semicolons.

    Only settings that describe a scene count.

    Args:
        recorded: settings that a run recorded.
        name: name of the setting.
        otherwise: text for a missing or empty value; empty leaves it out.
    """
    texts = [
        _shorten(run_settings.values.get(name) or otherwise)
        for run_settings in recorded
        if run_settings.is_of_scene
    ]
    return "; ".join(dict.fromkeys(filter(None, texts)))


def collect_versions(folder: Path, read_paths: Sequence[Path]) -> dict[str, str]:
    """Return versions and digests of files that a run was made with, by name.

    They include those of its parts and of the runs that it read. If a name has several
    versions, all are listed in the order of the runs. Runs without readable versions
    are skipped.
    """
    texts_of_name = dict[str, dict[str, None]]()
    candidates = sorted((folder / directory.PARTS).glob("*"))
    parts = [part for part in candidates if directory.is_run(part)]
    for run in [folder, *parts, *read_paths]:
        with suppress(errors.AdvsearchError):
            for name, text in RunDirectory.read_versions(run).items():
                texts_of_name.setdefault(name, {})[str(text)] = None
    return {name: ", then ".join(texts) for name, texts in texts_of_name.items()}
