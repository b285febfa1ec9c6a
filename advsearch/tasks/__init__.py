"""Tasks: what a model is asked to do, and how its output is judged against what is true
of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from torch import Tensor

from advsearch.catalog import list_built_ins
from advsearch.copies import copied
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonValue
from advsearch.models import Model
from advsearch.options import (
    FROM_RUN,
    JOINED,
    NOT_A_NUMBER,
    OUT_OF_VIEW,
    OUTCOME,
    Outcome,
    check_options,
    check_takes,
    told,
)
from advsearch.registry import Registry, get_class
from advsearch.tasks.base import (
    Facts,
    Judgement,
    Mark,
    Prediction,
    Said,
    Sight,
    Task,
    Truth,
)
from advsearch.tasks.classification import (
    NO,
    Classification,
    ClassTask,
    Labels,
    members,
    target_lead,
    wrong_lead,
)
from advsearch.tasks.detection import Detection
from advsearch.tasks.together import (
    Joined,
    Outputs,
    Together,
    Truths,
    all_said,
    outcome_in,
)

MOST_NUMBERS = 4  # of an output that are said one by one


@dataclass(frozen=True, kw_only=True)
class OwnTask(Task):
    """A task by one function, see `own_task`; its truth are the scene's facts in each
    configuration.
    """

    name = "own"
    varies = True

    function: Callable[[Any, Facts], Tensor]
    # empty where the model has no names
    labels: tuple[str, ...] = field(default=(), metadata=FROM_RUN)

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> OwnTask:
        asked = super().on(model, target=target, minimise=minimise)
        return replace(asked, labels=tuple(model.labels) if model.named else ())

    def truth(self, facts: Facts) -> Facts:
        return facts

    def loss(self, output: Any, truth: Facts) -> Tensor:
        """Return what the function says, (N,). Raises InputError where it returns
        something else.
        """
        found = self.function(copied(output), truth)
        count = len(output)
        if (
            isinstance(found, Tensor)
            and found.is_floating_point()
            and found.numel() == count
        ):
            return found.reshape(count)
        got = (
            f"{found.dtype} {tuple(found.shape)}"
            if isinstance(found, Tensor)
            else type(found).__name__
        )
        raise InputError(
            f"task {self.name}: expected how wrong each output is, a tensor of {count} "
            "floating-point number"
            f"{'s' * (count != 1)}, over 0 where it is wrong, got {got}; a distance "
            "less what is allowed does, or a "
            "wrong logit less the right one"
        )

    def predictions(self, output: Any, count: int = 1) -> list[tuple[Prediction, ...]]:
        """Return the largest class of each output where classes have names, else its
        numbers.
        """
        found: list[tuple[Prediction, ...]] = []
        for one in output.detach():
            index = (
                int(one.argmax())
                if one.ndim == 1 and len(one) == len(self.labels)
                else None
            )
            if index is not None:
                label = self.labels[index]
            elif one.numel() <= MOST_NUMBERS:
                label = ", ".join(f"{value:.3g}" for value in one.flatten().tolist())
            else:
                label = (
                    f"{' x '.join(map(str, one.shape))} numbers, mean "
                    f"{float(one.double().mean()):.3g}"
                )
            found.append((Prediction(label, index),))
        return found

    def truth_names(self, truth: Facts) -> tuple[str, ...]:
        return (truth.label or truth.own_label or truth.object,)


def own_task(function: Callable[[Any, Facts], Tensor]) -> OwnTask:
    """Return a task from a function, by whose name it is called.

    Args:
        function: `judge(output, truth)`, with the outputs of the model for N pictures
            (N, ...), and `Facts`: what is true of the scene in this configuration, such
            as `truth.number("pose.yaw")`, `truth.mask` or `truth.label`. It returns
            (N,), or a number for one picture: over 0 exactly where the output is wrong,
            differentiable.

    Raises:
        InputError: it takes other arguments.
    """
    name = getattr(function, "__name__", type(function).__name__)
    check_takes(f"task {name}", function, "output", "truth")
    kind: Any = type(name, (OwnTask,), {"name": name})
    made: OwnTask = kind(function=function)
    return made


def function_of(task: Task) -> Callable[..., Tensor] | None:
    """Return the function that a task was made from; None where it was not."""
    return task.function if isinstance(task, OwnTask) else None


TASKS: Registry[type[Task]] = Registry(
    "advsearch.tasks",
    list_built_ins("task"),
    "a subclass of Task whose name is that of the entry point",
    lambda name, entry: (
        isinstance(entry, type) and issubclass(entry, Task) and entry.name == name
    ),
)
"""Every task that has a name."""


AnyTask = str | Mapping[str, object] | Task | Callable[[Any, Facts], Tensor]
"""A task: its name, a mapping with its `name` and options, the task itself, or a
function `judge(output, truth)`.
"""


def make_task(task: AnyTask) -> Task:
    """Return the task of that name, of that `name` with these options, which are its
    dataclass's fields, the task itself, or that of a function (`own_task`).

    Of several tasks at once, "detection+depth", the options of each stand under its
    name. Raises UnknownNameError: no such task, or it has no such option; InputError:
    an option's value is of another type, or outside its range.
    """
    if isinstance(task, Task):
        return task
    if callable(task) and not isinstance(task, type):
        return own_task(task)
    if not isinstance(task, (str, Mapping)):
        raise InputError(
            "task: expected a name, a mapping with a `name`, a Task or a "
            f"function, got {told(task)}"
        )
    given = {"name": task} if isinstance(task, str) else task
    name = str(given.get("name", Classification.name))
    options: dict[str, Any] = {key: given[key] for key in given if key != "name"}
    if JOINED in name:
        names = [part.strip() for part in name.split(JOINED)]
        for part, of_part in options.items():
            if part not in names:
                raise UnknownNameError(
                    f"option of task {JOINED.join(names)!r}:", part, names
                )
            if not isinstance(of_part, Mapping):
                raise InputError(
                    f"task {part}: expected its options as a mapping, got "
                    f"{of_part!r:.80}"
                )
        return Together(
            parts=tuple(
                make_task({**options.get(part, {}), "name": part}) for part in names
            )
        )
    if name not in TASKS:
        raise UnknownNameError("task", name, TASKS)
    check_options("task", name, TASKS[name], options)
    build: Callable[..., Any] = TASKS[name]
    made: Any = build(**options)
    if made.judges_rig:
        made = replace(made, part=make_task(made.task))
    result: Task = made
    return result


def __getattr__(name: str) -> Any:
    """Import the class of another built-in task when it is asked for by name: Depth."""
    return get_class("task", name)


__all__ = [
    "FROM_RUN",
    "NO",
    "NOT_A_NUMBER",
    "OUTCOME",
    "OUT_OF_VIEW",
    "TASKS",
    "AnyTask",
    "ClassTask",
    "Classification",
    "Detection",
    "Facts",
    "Joined",
    "JsonValue",
    "Judgement",
    "Labels",
    "Mark",
    "Outcome",
    "Outputs",
    "OwnTask",
    "Prediction",
    "Said",
    "Sight",
    "Task",
    "Together",
    "Truth",
    "Truths",
    "all_said",
    "function_of",
    "make_task",
    "members",
    "outcome_in",
    "own_task",
    "target_lead",
    "wrong_lead",
]
