"""Names in settings that are looked up before PyTorch and Mitsuba are imported, which
takes seconds: a slip is told at once. What this module lets through is looked up again
by whoever loads it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from advsearch.catalog import list_built_ins
from advsearch.errors import InputError, UnknownNameError, resembling
from advsearch.runs.directory import find_run
from advsearch.scene.library import (
    MAP_HINT,
    OBJECT_HINT,
    list_environments,
    list_objects,
)
from advsearch.settings import Config, split_names

# what can only be the name of something bundled: no path, no file, no code
WORD = re.compile(r"[^\W\d][\w-]{0,59}")
LABEL_SETS = ("imagenet", "cifar10", "cifar100", "coco", "coco90", "coco91", "voc")
"""`advsearch.models.labels.SETS`, which a test holds this to."""
PARAMETERS = frozenset(
    "aberration aperture exposure heading height lumens phase pitch power pushes shot "
    "texels water weight x y z".split()
)
"""Names of controls' parameters that are like the name of a control, which a test holds
this to.
"""


def check_names(config: Config) -> None:
    """Refuse, by an UnknownNameError or an InputError, names in settings that nothing
    is called by.
    """
    if config.only_here:
        return  # what exists in a Python session alone may be called anything
    said: dict[str, Any] = {
        name: getattr(config, name) for name in type(config).model_fields
    }
    things = [
        part.strip()
        for part in str(said.get("things") or "").split(";")
        if part.strip()
    ]
    whats = [part.partition("@")[0].strip() for part in things]
    objects = [
        *split_names(said.get("object") or ""),
        *split_names(said.get("held_out") or ""),
        *whats,
    ]
    environments = [
        *split_names(said.get("environment") or ""),
        *split_names(said.get("held_out_environment") or ""),
    ]
    _check(
        "object", [one for one in objects if one != "all"], list_objects(), OBJECT_HINT
    )
    _check(
        "environment",
        [one for one in environments if one != "none"],
        list_environments(),
        MAP_HINT,
    )
    controls = {**(said.get("controls") or {}), **(said.get("over") or {})}
    kinds = [str((own or {}).get("kind") or name) for name, own in controls.items()]
    names = [
        re.split(r"[:.]", kind)[0] for kind in kinds if not re.search(r":[A-Z]", kind)
    ]
    built_in_controls = list_built_ins("control")
    # of a parameter the registry says whose it is
    slips = [
        name
        for name in names
        if name not in PARAMETERS and resembling(name, built_in_controls)
    ]
    _check("control", slips, "controls")
    for setting, group in (("policy", "policies"), ("task", "tasks")):
        given = said.get(setting)
        name = (
            str(given.get("name", ""))
            if isinstance(given, Mapping)
            else str(given or "")
        )
        _check(setting, name.split("+") if setting == "task" else [name], group)
    slips = [
        one
        for one in split_names(said.get("model") or "")
        if resembling(one, ["reference"])
    ]
    _check("model", slips, ["reference"], "A model of yours is a file or Python code.")
    labels = said.get("labels")
    if labels and WORD.fullmatch(labels) and not Path(labels).exists():
        _check(
            "set of labels",
            [labels],
            LABEL_SETS,
            "Or give a file, or the names with commas between them.",
        )
    judge = said.get("judge")
    if things and judge and objects[0] in list_objects():
        of_things = [re.search(r"name=([^,]+)", part) for part in things]
        names = [
            named[1].strip() if named else what
            for named, what in zip(of_things, whats, strict=True)
        ]
        if re.sub(r"-\d+$", "", judge) not in (*names, "object", "all"):
            raise UnknownNameError(
                "thing to judge:",
                judge,
                ("object", "all", *names),
                "It stands in `judge`.",
            )
    for setting in ("sweeps", "compared"):
        # which is shown to models, that are compared then
        if said.get(setting) and not said.get("object"):
            for run in split_names(said[setting]):
                find_run(run)
    suite = said.get("suite")
    if suite and not Path(suite).exists():
        there = [
            str(file)
            for folder in {Path(suite).parent, Path("suites")}
            for file in sorted(folder.glob("*.y*ml"))
        ]
        near = resembling(Path(suite).stem, [Path(file).stem for file in there])[:1]
        like = [file for file in there if Path(file).stem in near]
        raise InputError(
            "suite: there is no file "
            f"{suite}{f'; did you mean {like[0]}?' if like else ''}"
        )


def _check(
    kind: str, names: Iterable[str], known: Iterable[str], hint: str = ""
) -> None:
    """Refuse a word that is none of those known; `known` may be the end of a group of
    entry points, whose names other packages add to.
    """
    for name in names:
        if not WORD.fullmatch(name) or Path(name).exists():
            continue
        if isinstance(known, str):
            known = [
                *list_built_ins(kind),
                *(point.name for point in entry_points(group=f"advsearch.{known}")),
            ]
        if name not in (known := list(known)):
            raise UnknownNameError(kind, name, known, hint)
