"""The settings that a run recorded: its own, those of its suite's claims, and those of
the runs that it read.
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

CLAIM = "claim"  # the kind of settings that a suite noted for each of its claims
NOT_SETTINGS = ("schema", "command", "base", *settings.PLACE)
ATTACKS = ("attack", "adversarial_of", "around")  # settings that name an attack's run
DEFAULT_TASK = "classification"
LONGEST = 2000  # characters of a value that are written


@dataclass
class RecordedSettings:
    """Settings as a file or a note has them, and where they are from: empty for the
    run's own.
    """

    source: str
    values: Mapping[str, Any]

    @property
    def is_of_scene(self) -> bool:
        """Whether they describe pictures of a scene, and not only which runs are
        read.
        """
        return bool(self.values.get("object"))

    @property
    def task(self) -> str:
        """The task in words, with its thresholds."""
        return task_text(
            self.values.get("task") or DEFAULT_TASK, self.values.get("objective")
        )

    def as_text(self) -> dict[str, str]:
        """Return every setting that was used, by its name with the source before it."""
        before = f"{self.source}: " if self.source else ""
        return {
            f"{before}{name}": self.task if name == "task" else _short(value)
            for name, value in self.values.items()
            if name not in NOT_SETTINGS and self._is_used(name, value)
        }

    def _is_used(self, name: str, value: object) -> bool:
        """Whether a setting says anything. What is default says nothing where the
        command renders nothing, as it names no object, and where it would clash with
        the other settings if it were given, as `fps` without a path.
        """
        defaults = self._defaults
        is_default = name not in defaults or value == defaults[name]
        if is_default and (
            name in self._idle or ("object" in defaults and not self.is_of_scene)
        ):
            return False
        return not is_default or not (
            value is None or value is False or value in ("", {}, [], ())
        )

    @cached_property
    def _kind(self) -> type[Config] | None:
        with suppress(errors.AdvsearchError, KeyError):
            config: type[Config] = workbench.get_experiment(
                str(self.values.get("command") or "")
            ).settings
            return config
        return None

    @cached_property
    def _defaults(self) -> dict[str, Any]:
        known = settings.settings(self._kind) if self._kind else ()
        return {
            setting.name: None if setting.required else setting.default
            for setting in known
        }

    @cached_property
    def _idle(self) -> set[str]:
        """The settings that would say nothing if they were given."""
        with suppress(errors.AdvsearchError):
            if self._kind is not None:
                given = {
                    name: value
                    for name, value in self.values.items()
                    if name not in NOT_SETTINGS
                }
                config = self._kind(**given)
                return {
                    clash.setting.rstrip("_")
                    for clash in self._kind.clashes
                    if clash.with_others(config)
                }
        return set()


def task_text(named: Any, objective: object) -> str:
    """Return a task in words, with all its options, such as thresholds, also those that
    are default; an objective of its own says what counts as success.
    """
    options = ", ".join(
        f"{option} {wording.number_text(given)}"
        for option, given in _task_options(named, objective).items()
    )
    called = str(named.get("name") if isinstance(named, Mapping) else named)
    return f"{called} ({options})" if options else _short(named)


def _short(value: object) -> str:
    text = (
        value
        if isinstance(value, str)
        else json.dumps(value, ensure_ascii=False, default=str)
    )
    return (
        text
        if len(text) <= LONGEST
        else (f"{text[:LONGEST]}... ({len(text)} characters)")
    )


def _task_options(named: Any, objective: object) -> dict[str, Any]:
    from advsearch.extend import workbench  # it brings torch, which takes a second

    options = dict[str, Any]()
    with suppress(errors.AdvsearchError):
        task = workbench.make_task(named)
        task = task.seeking(objective) if isinstance(objective, str) else task
        parts = (
            {f"{part.name}.": part for part in task.parts}
            if isinstance(task, workbench.Together)
            else {"": task}
        )
        for before, part in parts.items():
            for option in fields(part):
                value = getattr(part, option.name)
                if option.metadata != workbench.FROM_RUN and value not in (
                    None,
                    "",
                    (),
                    False,
                ):
                    options[f"{before}{option.name}"] = value
    return options


def own_settings(folder: Path) -> Mapping[str, Any]:
    """Return what the `run.yaml` of a run says; nothing where it cannot be read."""
    with suppress(errors.AdvsearchError):
        return settings.read_yaml(folder / directory.CONFIG)
    return {}


def sweeps_read(result: results.Result) -> list[Path]:
    """Return the folders of the sweeps whose rows a result was made from, as far as
    they are there.
    """
    return _found(
        [
            *getattr(result, "sweeps", ()),
            *(side.run for side in getattr(result, "sides", ())),
        ]
    )


def attacks_read(values: Mapping[str, Any]) -> list[Path]:
    """Return the folders of the attacks that settings name, whose adversarial scenes
    were rendered again.
    """
    return _found([values.get(name) for name in ATTACKS])


def _found(names: Iterable[object]) -> list[Path]:
    folders = list[Path]()
    for name in dict.fromkeys(name for name in names if isinstance(name, str) and name):
        with suppress(errors.AdvsearchError, OSError, ValueError):
            folders.append(directory.find_run(name))
    return folders


def recorded_settings(
    folder: Path, result: results.Result, read: Sequence[Path]
) -> list[RecordedSettings]:
    """Return the settings of a run: its own, of a suite those of each claim and
    counterexample that was tried, and those of the runs that it read.
    """
    recorded = [RecordedSettings("", own_settings(folder))]
    for kind, settings_by_name in (noted_settings(folder, result) or {}).items():
        recorded += [
            RecordedSettings(f"{kind} {name}", values)
            for name, values in settings_by_name.items()
        ]
    return recorded + [
        RecordedSettings(directory.typed_name(path), own_settings(path))
        for path in read
    ]


def noted_settings(
    folder: Path, result: results.Result
) -> Mapping[str, Mapping[str, Mapping[str, Any]]] | None:
    """Return what a run noted of settings beside its own, by kind and name; None for an
    experiment that notes none.
    """
    hook = workbench.get_experiment(result.command).noted_settings
    if hook is None:
        return None
    noted: Mapping[str, Mapping[str, Mapping[str, Any]]] = {}
    with suppress(errors.AdvsearchError):
        noted = hook(folder, result)
    return noted


def stated(recorded: Iterable[RecordedSettings], name: str, otherwise: str = "") -> str:
    """Return what settings of scenes say under a name, each different text once;
    `otherwise` where one says nothing.
    """
    texts = [
        _short(one.values.get(name) or otherwise) for one in recorded if one.is_of_scene
    ]
    return "; ".join(dict.fromkeys(filter(None, texts)))


def made_with(folder: Path, read: Sequence[Path]) -> dict[str, str]:
    """Return versions and digests of files, of a run, of the runs that it consists of
    and of those that it read; of several that differ, all.
    """
    found = dict[str, dict[str, None]]()
    parts = [
        part
        for part in sorted((folder / directory.PARTS).glob("*"))
        if directory.is_run(part)
    ]
    for run in [folder, *parts, *read]:
        with suppress(errors.AdvsearchError):
            for name, text in RunDirectory.read_made_with(run).items():
                found.setdefault(name, {})[str(text)] = None
    return {name: ", then ".join(texts) for name, texts in found.items()}
