"""Tasks, which evaluate the output of a model against the ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from torch import Tensor

from advsearch.catalog import list_built_ins
from advsearch.copies import copy_value
from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonValue
from advsearch.models import Model
from advsearch.options import (
    FROM_RUN,
    NOT_A_NUMBER,
    OUT_OF_VIEW,
    OUTCOME,
    TASK_SEPARATOR,
    Outcome,
    check_options,
    check_takes_arguments,
    describe_value,
)
from advsearch.registry import Registry, get_class
from advsearch.tasks.base import (
    Facts,
    Judgement,
    Mark,
    Prediction,
    PredictionWithPayload,
    Sight,
    Task,
    Truth,
)
from advsearch.tasks.classification import (
    MISSED_PREFIX,
    Classification,
    ClassTask,
    Labels,
    compute_misclassification_margin,
    compute_target_margin,
    make_class_mask,
)
from advsearch.tasks.detection import Detection
from advsearch.tasks.together import (
    EnsembleTask,
    JointTask,
    Outputs,
    Truths,
    join_predictions,
    make_outcome_payload,
)

MAX_LISTED_NUMBERS = 4  # maximum size of an output whose label lists its numbers


@dataclass(frozen=True, kw_only=True)
class FunctionTask(Task):
    """A task defined by a function, see `make_function_task`; its truth is the scene's
    facts.
    """

    name = "own"
    varies = True

    function: Callable[[Any, Facts], Tensor]
    # Empty if the model's classes have no names.
    labels: tuple[str, ...] = field(default=(), metadata=FROM_RUN)

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> FunctionTask:
        task = super().on(model, target=target, minimise=minimise)
        return replace(task, labels=tuple(model.labels) if model.named else ())

    def truth(self, facts: Facts) -> Facts:
        return facts

    def loss(self, output: Any, truth: Facts) -> Tensor:
        """Compute how wrong each of N outputs is by the user's function, (N,).

        Raises:
            InputError: the function returns something else than a floating-point number
                for each output.
        """
        losses = self.function(copy_value(output), truth)
        n_outputs = len(output)
        is_tensor = isinstance(losses, Tensor)
        # any shape with N numbers will do: () for one output, or (N, 1)
        if is_tensor and losses.is_floating_point() and losses.numel() == n_outputs:
            return losses.reshape(n_outputs)
        got = type(losses).__name__
        if is_tensor:
            got = f"{losses.dtype} {tuple(losses.shape)}"
        raise _make_loss_error(self.name, n_outputs, got)

    def predictions(self, output: Any, count: int = 1) -> list[tuple[Prediction, ...]]:
        """Return a prediction for each image (`_describe_values`)."""
        return [(self._describe_values(values),) for values in output.detach()]

    def _describe_values(self, values: Tensor) -> Prediction:
        """Return the prediction for the output of an image.

        It is the class with the largest output if there is a number for each label.
        Otherwise it lists the numbers, or if there are many their shape and mean.
        """
        has_number_per_label = values.ndim == 1 and len(values) == len(self.labels)
        if has_number_per_label:
            index = int(values.argmax())
            return Prediction(self.labels[index], index)
        if values.numel() <= MAX_LISTED_NUMBERS:
            numbers = [f"{value:.3g}" for value in values.flatten().tolist()]
            return Prediction(", ".join(numbers))
        # too many numbers to list
        shape = " x ".join(map(str, values.shape))
        mean = float(values.double().mean())
        return Prediction(f"{shape} numbers, mean {mean:.3g}")

    def truth_names(self, truth: Facts) -> tuple[str, ...]:
        return (truth.label or truth.object_label or truth.object,)


def _make_loss_error(name: str, n_outputs: int, got: str) -> InputError:
    """Return the error of a user's function that returned no losses.

    Args:
        name: name of the task.
        n_outputs: number of outputs that were passed.
        got: what the function returned instead.
    """
    plural = "" if n_outputs == 1 else "s"
    return InputError(
        f"task {name}: expected the loss of each output, a tensor of "
        f"{n_outputs} floating-point number{plural}, over 0 for a wrong output, got "
        f"{got}; for example a distance minus a tolerance, or a wrong logit minus "
        "the right one"
    )


def make_function_task(function: Callable[[Any, Facts], Tensor]) -> FunctionTask:
    """Create a task from a function, whose name becomes the task's.

    Args:
        function: `judge(output, truth)`, with the outputs of the model for N images (N,
            ...), and `Facts`: the ground truth of the scene in this configuration, such
            as `truth.get_number("pose.yaw")`, `truth.mask` or `truth.label`. It returns
            (N,), or a number for one image: over 0 exactly if the output is wrong,
            differentiable.

    Raises:
        InputError: it takes other arguments.
    """
    name = getattr(function, "__name__", type(function).__name__)
    check_takes_arguments(f"task {name}", function, "output", "truth")
    task_class: Any = type(name, (FunctionTask,), {"name": name})
    task: FunctionTask = task_class(function=function)
    return task


def get_task_function(task: Task) -> Callable[..., Tensor] | None:
    """Return the function that a task was created from; None if there is none."""
    return task.function if isinstance(task, FunctionTask) else None


TASKS: Registry[type[Task]] = Registry(
    "advsearch.tasks",
    list_built_ins("task"),
    "a subclass of Task whose name is that of the entry point",
    lambda name, entry: (
        isinstance(entry, type) and issubclass(entry, Task) and entry.name == name
    ),
)
"""Classes of tasks by name."""


AnyTask = str | Mapping[str, object] | Task | Callable[[Any, Facts], Tensor]
"""A task: its name, a mapping with its `name` and options, an instance, or a function
`judge(output, truth)`.
"""


def make_task(task: AnyTask) -> Task:
    """Create a task from any form that names one.

    Args:
        task: a name; a mapping with a `name` (by default "classification") and options,
            which are the fields of the task's dataclass; a task, which is returned; or
            a function (`make_function_task`). For a joint task, "detection+depth", the
            options of each stand under its name.

    Raises:
        UnknownNameError: there is no such task, or it has no such option.
        InputError: an option's value is of another type, or out of range.
    """
    if isinstance(task, Task):
        return task
    if callable(task) and not isinstance(task, type):
        return make_function_task(task)
    if not isinstance(task, (str, Mapping)):
        raise InputError(
            "task: expected a name, a mapping with a `name`, a Task or a "
            f"function, got {describe_value(task)}"
        )
    setting: Mapping[str, Any] = {"name": task} if isinstance(task, str) else task
    name = str(setting.get("name", Classification.name))
    options = {key: value for key, value in setting.items() if key != "name"}
    if TASK_SEPARATOR in name:
        return _make_joint_task(name, options)
    return _make_named_task(name, options)


def _make_named_task(name: str, options: Mapping[str, Any]) -> Task:
    """Create a task from its name and its options."""
    if name not in TASKS:
        raise UnknownNameError("task", name, TASKS)
    check_options("task", name, TASKS[name], options)
    task_class: Callable[..., Any] = TASKS[name]
    created: Any = task_class(**options)
    if created.judges_rig:
        # A rig is several cameras. Its option `task` names the task of each image.
        created = replace(created, image_task=make_task(created.task))
    result: Task = created
    return result


def _make_joint_task(name: str, options: Mapping[str, Any]) -> EnsembleTask:
    """Create the joint task of several names, such as "detection+depth".

    Args:
        name: the names, with `TASK_SEPARATOR` between them.
        options: a mapping of options for each name; a name may be left out.

    Raises:
        UnknownNameError: there are options for a name that the joint task does not have.
        InputError: options are no mapping.
    """
    names = [part.strip() for part in name.split(TASK_SEPARATOR)]
    _check_joint_options(names, options)
    parts = [
        make_task({**options.get(task_name, {}), "name": task_name})
        for task_name in names
    ]
    return EnsembleTask(parts=tuple(parts))


def _check_joint_options(names: Sequence[str], options: Mapping[str, Any]) -> None:
    """Raise an error if the options of a joint task are no mappings by its names."""
    for task_name, task_options in options.items():
        if task_name not in names:
            raise UnknownNameError(
                f"option of task {TASK_SEPARATOR.join(names)!r}:", task_name, names
            )
        if not isinstance(task_options, Mapping):
            raise InputError(
                f"task {task_name}: expected its options as a mapping, got "
                f"{task_options!r:.80}"
            )


def __getattr__(name: str) -> Any:
    """Import the class of another built-in task on first use, such as `Depth`."""
    return get_class("task", name)


__all__ = [
    "FROM_RUN",
    "MISSED_PREFIX",
    "NOT_A_NUMBER",
    "OUTCOME",
    "OUT_OF_VIEW",
    "TASKS",
    "AnyTask",
    "ClassTask",
    "Classification",
    "Detection",
    "EnsembleTask",
    "Facts",
    "FunctionTask",
    "JointTask",
    "JsonValue",
    "Judgement",
    "Labels",
    "Mark",
    "Outcome",
    "Outputs",
    "Prediction",
    "PredictionWithPayload",
    "Sight",
    "Task",
    "Truth",
    "Truths",
    "compute_misclassification_margin",
    "compute_target_margin",
    "get_task_function",
    "join_predictions",
    "make_class_mask",
    "make_function_task",
    "make_outcome_payload",
    "make_task",
]
