"""Check names in settings before PyTorch and Mitsuba are imported, which takes seconds.

So a misspelled name is reported at once. Names that pass are looked up again when
something is loaded by them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from advsearch.catalog import list_built_ins
from advsearch.errors import InputError, UnknownNameError, find_similar_names
from advsearch.runs.directory import find_run
from advsearch.scene.library import (
    MAP_HINT,
    OBJECT_HINT,
    list_environments,
    list_objects,
)
from advsearch.settings import split_names

# A plain word. It can only be a known name, unless there is a file of this name: paths
# and code ("package.module:Class") contain other characters.
WORD = re.compile(r"[^\W\d][\w-]{0,59}")
LABEL_SETS = ("imagenet", "cifar10", "cifar100", "coco", "coco90", "coco91", "voc")
"""The bundled sets of labels. A test checks that they equal
`advsearch.models.labels.SETS`, which is slow to import.
"""
PARAMETERS = frozenset(
    "aberration aperture exposure heading height lumens phase pitch power pushes shot "
    "texels water weight x y z".split()
)
"""Names of parameters of controls that are similar to the name of a control. A test
checks that the list is complete.
"""


def check_names(values: Mapping[str, Any]) -> None:
    """Check that the names in settings exist, before anything is loaded.

    So a misspelled name is reported at once.

    Args:
        values: values of the settings, by name.

    Raises:
        UnknownNameError: a name is unknown.
        InputError: a run or a file is missing.
    """
    _check_scene(values)
    _check_controls(values)
    _check_entries("policy", [_get_name(values.get("policy"))], "policies")
    # several tasks are joined with +
    _check_entries("task", _get_name(values.get("task")).split("+"), "tasks")
    _check_models(values)
    _check_labels(values)
    _check_runs(values)
    if values.get("suite"):
        _check_suite(values["suite"])


def _get_name(value: Any) -> str:
    """Return the name in a setting that is a name or a mapping; "" if it has none."""
    if isinstance(value, Mapping):
        return str(value.get("name", ""))
    return str(value or "")


def _check_models(values: Mapping[str, Any]) -> None:
    """Check names of models that are similar to "reference".

    This is the only bundled model; a name that is not similar may be a file or code of
    the user.
    """
    names_like_reference = [
        name
        for name in split_names(values.get("model") or "")
        if find_similar_names(name, ["reference"])
    ]
    _check_words(
        "model",
        names_like_reference,
        ["reference"],
        "A model of yours is a file or Python code.",
    )


def _check_labels(values: Mapping[str, Any]) -> None:
    """Check that labels are a bundled set, if they are neither a file nor a list."""
    labels = values.get("labels")
    if labels and WORD.fullmatch(labels) and not Path(labels).exists():
        _check_words(
            "set of labels",
            [labels],
            LABEL_SETS,
            "Or give a file, or the names with commas between them.",
        )


def _check_runs(values: Mapping[str, Any]) -> None:
    """Check that the runs exist that are to be compared."""
    # With an object, models are compared on new images, and the settings name models.
    compares_models = bool(values.get("object"))
    for setting in ("sweeps", "compared"):
        if values.get(setting) and not compares_models:
            for run in split_names(values[setting]):
                find_run(run)


def _check_scene(values: Mapping[str, Any]) -> None:
    """Check the names of objects and environments, and of the object to judge.

    Args:
        values: values of the settings, by name. "things" are additional objects, as in
            "car@12,3.5,name=taxi; person@6,-2".
    """
    things = _split_things(values)
    thing_objects = [thing.partition("@")[0].strip() for thing in things]
    objects = [*_list_main_objects(values), *thing_objects]
    known_objects = [name for name in objects if name != "all"]
    _check_words("object", known_objects, list_objects(), OBJECT_HINT)
    _check_environments(values)
    judge = values.get("judge")
    # A scene in a file may have further objects, whose names are not known here.
    if things and judge and objects[0] in list_objects():
        _check_judge(judge, things, thing_objects)


def _list_main_objects(values: Mapping[str, Any]) -> list[str]:
    """Return the objects in settings, without additional ones: first those of the
    search, then those that are held out.
    """
    return [
        *split_names(values.get("object") or ""),
        *split_names(values.get("held_out") or ""),
    ]


def _split_things(values: Mapping[str, Any]) -> list[str]:
    """Return the additional objects in settings, each with its options."""
    return [
        part.strip()
        for part in str(values.get("things") or "").split(";")
        if part.strip()
    ]


def _check_environments(values: Mapping[str, Any]) -> None:
    """Check the names of the environments in settings."""
    environments = [
        *split_names(values.get("environment") or ""),
        *split_names(values.get("held_out_environment") or ""),
    ]
    known_environments = [name for name in environments if name != "none"]
    _check_words("environment", known_environments, list_environments(), MAP_HINT)


def _check_judge(judge: str, things: Iterable[str], objects: Iterable[str]) -> None:
    """Check that the object to judge is one of the objects in the scene.

    Args:
        judge: name of the object. If several objects have the same name, the second is
            called NAME-2, and so on. The number is not checked here.
        things: additional objects as the setting has them, ``car@12,3.5,name=taxi``.
        objects: the object of each additional object, such as "car". It is also its
            name unless the options have another.

    Raises:
        UnknownNameError: no object has this name.
    """
    names = []
    for thing, object_name in zip(things, objects, strict=True):
        name_option = re.search(r"name=([^,]+)", thing)
        names.append(name_option[1].strip() if name_option else object_name)
    judge_without_number = re.sub(r"-\d+$", "", judge)
    if judge_without_number not in (*names, "object", "all"):
        raise UnknownNameError(
            "thing to judge:",
            judge,
            ("object", "all", *names),
            "It stands in `judge`.",
        )


def _check_controls(values: Mapping[str, Any]) -> None:
    """Check the names of controls, both those searched and those that vary at random.

    A name without resemblance to a built-in control may be the user's code, and passes.

    Raises:
        UnknownNameError: a name is nearly that of a built-in control.
    """
    controls = {**(values.get("controls") or {}), **(values.get("over") or {})}
    names = _list_checked_controls(controls)
    built_in_controls = list_built_ins("control")
    # The name of a parameter passes here: later the registry reports it in a message
    # that also names the control with this parameter.
    names_like_controls = [
        name
        for name in names
        if name not in PARAMETERS and find_similar_names(name, built_in_controls)
    ]
    _check_entries("control", names_like_controls, "controls")


def _list_checked_controls(controls: Mapping[str, Any]) -> list[str]:
    """Return the names of the controls in a setting that are no classes of the user.

    Args:
        controls: options by the name of the control.
    """
    names = []
    for name, options in controls.items():
        # A control may have any name if its options state the kind.
        kind = str((options or {}).get("kind") or name)
        is_class = re.search(r":[A-Z]", kind)  # "package.module:Class"
        if not is_class:
            # "light" of "light:key", and "pose" of "pose.yaw"
            name_of_control = re.split(r"[:.]", kind)[0]
            names.append(name_of_control)
    return names


def _check_suite(suite: str) -> None:
    """Check that the file of a suite exists.

    Raises:
        InputError: it does not; the message suggests a file with a similar name.
    """
    if Path(suite).exists():
        return
    best_file = _find_similar_suite(suite)
    hint = "" if best_file is None else f"; did you mean {best_file}?"
    raise InputError(f"suite: there is no file {suite}{hint}")


def _find_similar_suite(suite: str) -> Path | None:
    """Return the file of a suite whose name is like a name; None if there is none."""
    # YAML files in the stated folder, and in the folder with our suites
    files = [
        file
        for folder in {Path(suite).parent, Path("suites")}
        for file in sorted(folder.glob("*.y*ml"))
    ]
    similar_names = find_similar_names(Path(suite).stem, [file.stem for file in files])
    if not similar_names:
        return None
    return next(file for file in files if file.stem == similar_names[0])


def _check_entries(kind: str, names: Iterable[str], group: str) -> None:
    """Check that names are built-in entries of a kind, or entries of other packages.

    A name that is no plain word, such as "package.module:Class", is not checked.

    Args:
        kind: kind of the entries, such as "policy".
        names: names to check.
        group: group of entry points of other packages, such as "policies" for
            "advsearch.policies".

    Raises:
        UnknownNameError: a name is unknown.
    """
    words = [name for name in names if _is_word(name)]
    if not words:  # so that entry points are not listed without need
        return
    installed = entry_points(group=f"advsearch.{group}")
    known = [*list_built_ins(kind), *(point.name for point in installed)]
    _check_words(kind, words, known)


def _check_words(
    kind: str, names: Iterable[str], known: Iterable[str], hint: str = ""
) -> None:
    """Check that plain words are known names.

    Other names pass: those of existing files, and those that are no plain words, such
    as "package.module:Class" (`_is_word`).

    Args:
        kind: kind of the named object, for messages.
        names: names to check.
        known: the known names.
        hint: end of the message; "" for none.

    Raises:
        UnknownNameError: a word is unknown.
    """
    known_names = list(known)
    for name in names:
        if _is_word(name) and name not in known_names:
            raise UnknownNameError(kind, name, known_names, hint)


def _is_word(name: str) -> bool:
    """Return whether a name is a plain word and not the path of an existing file.

    Then it can only be a known name.
    """
    return WORD.fullmatch(name) is not None and not Path(name).exists()
