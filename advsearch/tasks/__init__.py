"""Tasks: what a model is asked to do, and how its output is judged against what is true of the scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from advsearch.errors import InputError, UnknownNameError
from advsearch.options import JOINED, check_options, told
from advsearch.registry import Registry
from advsearch.tasks.answers import FreeAnswer
from advsearch.tasks.base import Answer, Facts, Judgement, Mark, Sight, Task
from advsearch.tasks.classification import Classification
from advsearch.tasks.depth import Depth
from advsearch.tasks.detection import Detection
from advsearch.tasks.own import own_task
from advsearch.tasks.segmentation import Segmentation
from advsearch.tasks.similarity import Similarity
from advsearch.tasks.together import Together

TASKS: Registry[type[Task]] = Registry(
    "advsearch.tasks",
    {kind.name: kind for kind in (Classification, Detection, Segmentation, Depth, Similarity, FreeAnswer)},
    "a subclass of Task whose name is that of the entry point",
    lambda name, entry: isinstance(entry, type) and issubclass(entry, Task) and entry.name == name,
)
"""Every task that has a name."""


AnyTask = str | Mapping[str, object] | Task | Callable[[Any, Facts], Tensor]
"""A task: its name, a mapping with its `name` and options, the task itself, or a function `judge(output, truth)`."""


def make_task(task: AnyTask) -> Task:
    """Return the task of that name, of that `name` with these options, which are its dataclass's fields, the task
    itself, or that of a function (`advsearch.tasks.own.own_task`).

    Of several tasks at once, "detection+depth", the options of each stand under its name.

    Raises:
        UnknownNameError: no such task, or it has no such option.
        InputError: an option's value is of another type, or outside its range.
    """
    if isinstance(task, Task):
        return task
    if callable(task) and not isinstance(task, type):
        return own_task(task)
    if not isinstance(task, (str, Mapping)):
        raise InputError(f"task: expected a name, a mapping with a `name`, a Task or a function, got {told(task)}")
    given = {"name": task} if isinstance(task, str) else task
    name, options = str(given.get("name", Classification.name)), {key: given[key] for key in given if key != "name"}
    if JOINED in name:
        return _together([one.strip() for one in name.split(JOINED)], options)
    if name not in TASKS:
        raise UnknownNameError("task", name, TASKS)
    check_options("task", name, TASKS[name], options)
    build: Callable[..., Task] = TASKS[name]
    return build(**options)


def _together(names: Sequence[str], options: Mapping[str, Any]) -> Together:
    """Return several tasks as one, from their names, and by name the options of those that have some."""
    for name, own in options.items():
        if name not in names:
            raise UnknownNameError(f"option of task {JOINED.join(names)!r}:", name, names)
        if not isinstance(own, Mapping):
            raise InputError(f"task {name}: expected its options as a mapping, got {own!r:.80}")
    return Together(parts=tuple(make_task({**options.get(name, {}), "name": name}) for name in names))


__all__ = [
    "TASKS", "Answer", "AnyTask", "Classification", "Depth", "Detection", "Facts", "FreeAnswer", "Judgement", "Mark",
    "Segmentation", "Sight", "Similarity", "Task", "make_task",
]  # fmt: skip
