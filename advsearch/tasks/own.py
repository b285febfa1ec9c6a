"""A task from a function of the caller's, for the simple case: it says how wrong an output is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from torch import Tensor

from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.options import FROM_RUN, check_takes
from advsearch.tasks.base import Answer, Facts, Task

MOST_NUMBERS = 4
"""Of an output that are said one by one."""


@dataclass(frozen=True, kw_only=True)
class OwnTask(Task):
    """A task by one function, see `own_task`; its truth are the scene's facts in each configuration.

    Args:
        function: from an output (N, ...) and facts to (N,): over 0 exactly where the output is wrong.
        labels: one name per class where the model has names; else empty.
    """

    name = "own"
    varies = True

    function: Callable[[Any, Facts], Tensor]
    labels: tuple[str, ...] = field(default=(), metadata=FROM_RUN)

    def on(self, model: Model, *, target: str | None = None, minimise: bool = False) -> OwnTask:
        asked = super().on(model, target=target, minimise=minimise)
        return replace(asked, labels=tuple(model.labels) if model.named else ())

    def truth(self, facts: Facts) -> Facts:
        return facts

    def margin(self, output: Any, truth: Facts) -> Tensor:
        """Return what the function says, (N,).

        Raises:
            InputError: it returns something else.
        """
        found, count = self.function(output, truth), len(output)
        if isinstance(found, Tensor) and found.is_floating_point() and found.numel() == count:
            return found.reshape(count)
        got = f"{found.dtype} {tuple(found.shape)}" if isinstance(found, Tensor) else type(found).__name__
        raise InputError(
            f"task {self.name}: expected how wrong each output is, a tensor of {count} floating-point number"
            f"{'s' * (count != 1)}, over 0 where it is wrong, got {got}; a distance less what is allowed does, or a "
            "wrong logit less the right one"
        )

    def answers(self, output: Any, count: int = 1) -> list[tuple[Answer, ...]]:
        """Return the largest class of each output where classes have names, else its numbers."""
        return [(self._answer(one),) for one in output.detach()]

    def _answer(self, one: Tensor) -> Answer:
        if one.ndim == 1 and len(one) == len(self.labels):
            index = int(one.argmax())
            return Answer(self.labels[index], index)
        if one.numel() <= MOST_NUMBERS:
            return Answer(", ".join(f"{value:.3g}" for value in one.flatten().tolist()))
        return Answer(f"{' x '.join(map(str, one.shape))} numbers, mean {float(one.double().mean()):.3g}")

    def truth_names(self, truth: Facts) -> tuple[str, ...]:
        return (truth.label or truth.own_label or truth.object,)


def own_task(function: Callable[[Any, Facts], Tensor]) -> OwnTask:
    """Return a task from a function, by whose name it is called.

    Args:
        function: `judge(output, truth)`, with the outputs of the model for N pictures (N, ...), and `Facts`: what is
            true of the scene in this configuration, such as `truth.number("pose.yaw")`, `truth.mask` or `truth.label`.
            It returns (N,), or a number for one picture: over 0 exactly where the output is wrong, differentiable.

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
