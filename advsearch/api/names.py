"""Names in settings that are looked up before PyTorch and Mitsuba are imported, which takes seconds: a slip is told at
once. What this module lets through is looked up again by whoever loads it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from advsearch.errors import InputError, UnknownNameError, resembling
from advsearch.runs.directory import find_run
from advsearch.scene.library import MAP_HINT, OBJECT_HINT, list_environments, list_objects
from advsearch.settings import Config, split_names

WORD = re.compile(r"[^\W\d][\w-]{0,59}")  # what can only be the name of something bundled: no path, no file, no code
LABEL_SETS = ("imagenet", "cifar10", "cifar100", "coco", "coco90", "coco91", "voc")
"""`advsearch.models.labels.SETS`, which a test holds this to."""
PACKAGE = Path(__file__).parent.parent


def own_names(kind: str) -> list[str]:
    """Return the names of the package's own "control"s, "policy"s or "task"s, read from their files without an import.

    Tests hold them to the registries."""
    if kind == "control":
        named = {path.stem if path.stem != "__init__" else path.parent.name: path for path in _files("controls")}
        return [name for name, path in named.items() if f"class {name.title().replace('_', '')}Control(" in _text(path)]
    folder = {"policy": "attacks/policies", "task": "tasks"}[kind]
    found = re.findall(r'^    name(?:: ClassVar\[str\])? = "(\w+)"$', "\n".join(map(_text, _files(folder))), re.M)
    return [name for name in found if name not in ("choices", "own", "ensemble")]  # nobody asks for these


def _files(folder: str) -> Iterator[Path]:
    yield from sorted((PACKAGE / folder).glob("*.py"))
    yield from sorted((PACKAGE / folder).glob("*/__init__.py"))


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def check_names(config: Config) -> None:
    """Refuse, by an UnknownNameError or an InputError, names in settings that nothing is called by."""
    if config.only_here:
        return  # what exists in a Python session alone may be called anything
    said: dict[str, Any] = {name: getattr(config, name) for name in type(config).model_fields}
    things = [part.strip() for part in str(said.get("things") or "").split(";") if part.strip()]
    whats = [part.partition("@")[0].strip() for part in things]
    objects = [*split_names(said.get("object") or ""), *split_names(said.get("held_out") or ""), *whats]
    environments = [*split_names(said.get("environment") or ""), *split_names(said.get("held_out_environment") or "")]
    _check("object", [one for one in objects if one != "all"], list_objects(), OBJECT_HINT)
    _check("environment", [one for one in environments if one != "none"], list_environments(), MAP_HINT)
    controls = {**(said.get("controls") or {}), **(said.get("over") or {})}
    kinds = [str((own or {}).get("kind") or name) for name, own in controls.items()]
    texts = "".join(map(_text, (*_files("controls"), PACKAGE / "scene" / "settings.py")))
    kinds = [kind for kind in kinds if f'"{kind}"' not in texts]  # of a parameter the registry says whose it is
    _check("control", [re.split(r"[:.]", kind)[0] for kind in kinds if not re.search(r":[A-Z]", kind)], "controls")
    for setting, group in (("policy", "policies"), ("task", "tasks")):
        given = said.get(setting)
        name = str(given.get("name", "")) if isinstance(given, Mapping) else str(given or "")
        _check(setting, name.split("+") if setting == "task" else [name], group)
    slips = [one for one in split_names(said.get("model") or "") if resembling(one, ["reference"])]
    _check("model", slips, ["reference"], "A model of yours is a file or Python code.")
    labels = said.get("labels")
    if labels and WORD.fullmatch(labels) and not Path(labels).exists():
        _check("set of labels", [labels], LABEL_SETS, "Or give a file, or the names with commas between them.")
    judge = said.get("judge")
    if things and judge and objects[0] in list_objects():
        of_things = [re.search(r"name=([^,]+)", part) for part in things]
        names = [named[1].strip() if named else what for named, what in zip(of_things, whats, strict=True)]
        if re.sub(r"-\d+$", "", judge) not in (*names, "object", "all"):
            raise UnknownNameError("thing to judge:", judge, ("object", "all", *names), "It stands in `judge`.")
    for setting in ("sweeps", "compared"):
        if said.get(setting) and not said.get("object"):  # which is shown to models, that are compared then
            for run in split_names(said[setting]):
                find_run(run)
    suite = said.get("suite")
    if suite and not Path(suite).exists():
        there = [str(file) for folder in {Path(suite).parent, Path("suites")} for file in sorted(folder.glob("*.y*ml"))]
        near = resembling(Path(suite).stem, [Path(file).stem for file in there])[:1]
        like = [file for file in there if Path(file).stem in near]
        raise InputError(f"suite: there is no file {suite}{f'; did you mean {like[0]}?' if like else ''}")


def _check(kind: str, names: Iterable[str], known: Iterable[str], hint: str = "") -> None:
    """Refuse a word that is none of those known; `known` may be the end of a group of entry points, whose names other
    packages add to."""
    for name in names:
        if not WORD.fullmatch(name) or Path(name).exists():
            continue
        if isinstance(known, str):
            known = [*own_names(kind), *(point.name for point in entry_points(group=f"advsearch.{known}"))]
        if name not in (known := list(known)):
            raise UnknownNameError(kind, name, known, hint)
