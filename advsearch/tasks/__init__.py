"""Tasks: what a model is asked to do, and how its output is judged against what is true of the scene."""

from __future__ import annotations

from advsearch.errors import UnknownNameError
from advsearch.registry import Registry
from advsearch.tasks.base import Answer, Facts, Judgement, Task
from advsearch.tasks.classification import Classification

TASKS: Registry[type[Task]] = Registry(
    "advsearch.tasks",
    {Classification.name: Classification},
    "a subclass of Task whose name is that of the entry point",
    lambda name, entry: isinstance(entry, type) and issubclass(entry, Task) and entry.name == name,
)
"""Every task that has a name."""


def make_task(task: str | Task) -> Task:
    """Return the task of that name with its own options, or the task itself.

    Raises:
        UnknownNameError: no such name.
    """
    if isinstance(task, Task):
        return task
    if task not in TASKS:
        raise UnknownNameError("task", task, TASKS)
    return TASKS[task]()


__all__ = ["TASKS", "Answer", "Classification", "Facts", "Judgement", "Task", "make_task"]
