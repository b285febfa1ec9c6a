"""Objectives: the values that a search maximizes. Whether a prediction is a success is
decided by the task instead (`advsearch.tasks`, docs/objectives.md).

An objective is a callable `(output, images, truth) -> values`:

- output: output of the model for N images, as the task needs it; in classification
logits (N, C) float32;
- images: (N, H, W, 3) float32 input of the model, display-referred sRGB in [0, 1];
- truth: ground truth of the scene, as the task needs it; in classification the indices
  of the label set Y, every one of which is a right label;
- values: (N,), differentiable; the larger, the closer to what is sought.

A user's function takes `(output, images, truth)`, or `(output, labels)` as losses of
torch do. By the names of further parameters it requests further inputs, such as the
texture. So what `get_objective` returns takes a fourth argument, `more`: a function
from the name of such an input to its value.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, final

import torch
from torch import Tensor, nn

from advsearch.attacks import objective_functions as functions
from advsearch.attacks.objective_functions import ReadFeatures

# for objectives of plugins, docs/extending.md
from advsearch.attacks.objective_functions import margin as margin
from advsearch.copies import copy_value
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import describe_value
from advsearch.registry import Registry, load_attribute
from advsearch.tasks import TASKS, Classification, Task
from advsearch.tasks.classification import ClassTask
from advsearch.tasks.detection import GOALS, Detection
from advsearch.tasks.together import EnsembleTask

# names of further parameters by which a user's function can request an input
REQUESTABLE_INPUTS = ("u", "texture", "textures", "inputs", "configuration")

TRUTH_PARAMETERS = ("target", "targets", "labels", "label", "truth")
"""Names of a second parameter that show that a function takes (output, truth), without
the images.
"""

# names of a parameter that gets the images
IMAGE_PARAMETERS = ("images", "image")

ReadInput = Callable[[str], Any]
"""A function from a name in `REQUESTABLE_INPUTS` to that input, at the configuration of
each image.
"""


class Objective(Protocol):
    """The signature of an objective, called by position; see
    `advsearch.attacks.objectives`.
    """

    def __call__(
        self, output: Any, images: Tensor, truth: Any, more: ReadInput = ..., /
    ) -> Tensor:
        """Return (N,) values to maximize."""
        ...


def reject_inputs(name: str) -> Any:
    """Raise InputError: no further inputs can be read without a configuration.

    It is the default `ReadInput`, of a call without a configuration.
    """
    raise InputError(
        f"objective: asks for `{name}`, and no configuration was given; "
        "pass `more`, which gives it"
    )


@dataclass(frozen=True)
class ObjectiveSignature:
    """The arguments that a user's function takes.

    Attributes:
        takes_images: whether it takes (output, images, truth), not (output, truth).
        requested_inputs: names of the inputs that it requests by further parameters, of
            `REQUESTABLE_INPUTS`.
    """

    takes_images: bool = True
    requested_inputs: tuple[str, ...] = ()


def read_signature(function: Callable[..., Any]) -> ObjectiveSignature:
    """Return which arguments an objective takes, by the names of its parameters.

    It is called with (output, images, truth) or (output, labels). Further parameters
    named like one of `REQUESTABLE_INPUTS`, e.g. "texture", request that input. The
    first two parameters request nothing, whatever their names are.

    Args:
        function: a user's function, or a torch module, whose `forward` is read.

    Raises:
        InputError: it is a class, takes images first, or takes other arguments.
    """
    if isinstance(function, type):
        raise InputError(
            "objective: expected a name or a function (output, images, "
            f"truth), got {describe_value(function)}"
        )
    # The `__call__` of a module takes (*args, **kwargs), which says nothing.
    callee = function.forward if isinstance(function, nn.Module) else function
    try:
        signature = inspect.signature(callee)
    except ValueError:
        # A function written in C has no signature. By default it gets (output, images,
        # truth), and no further inputs.
        return ObjectiveSignature()
    _check_takes_output_first(function, signature)
    requests = _find_requests(signature)
    _check_binding(function, signature, requests)
    return requests


def _check_takes_output_first(
    function: Callable[..., Any], signature: inspect.Signature
) -> None:
    """Raise InputError if a function takes images first, like a metric."""
    by_position = _list_positional(signature)
    if by_position and by_position[0] in IMAGE_PARAMETERS:
        raise InputError(
            f"objective {get_name(function)!r}: its first argument is called "
            f"{by_position[0]!r}, but gets what the "
            "model says; write (output, images, truth)"
        )


def _find_requests(signature: inspect.Signature) -> ObjectiveSignature:
    """Return which arguments a function takes, by the names of its parameters."""
    by_position = _list_positional(signature)
    # The first two always get output and truth (or images), even if they are called "u"
    # or "inputs".
    requested_inputs = tuple(
        name
        for name in signature.parameters
        if name in REQUESTABLE_INPUTS and name not in by_position[:2]
    )
    has_star_args = any(
        parameter.kind is parameter.VAR_POSITIONAL
        for parameter in signature.parameters.values()
    )
    other_names = [name for name in by_position if name not in requested_inputs]
    takes_images = has_star_args or _has_image_parameter(other_names)
    return ObjectiveSignature(takes_images, requested_inputs)


def _list_positional(signature: inspect.Signature) -> list[str]:
    """Return the names of the parameters that can be passed by position, in order."""
    return [
        parameter.name
        for parameter in signature.parameters.values()
        if parameter.kind
        in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    ]


def _check_binding(
    function: Callable[..., Any],
    signature: inspect.Signature,
    requests: ObjectiveSignature,
) -> None:
    """Raise InputError if a function can't be called as an objective is.

    Args:
        function: the function.
        signature: its signature.
        requests: how it is called: with (output, images, truth) or (output, labels),
            and with the requested inputs by keyword.
    """
    n_positional = 3 if requests.takes_images else 2
    by_keyword = dict.fromkeys(requests.requested_inputs)
    try:
        signature.bind(*([None] * n_positional), **by_keyword)
    except TypeError as error:
        raise InputError(
            f"objective {get_name(function)!r}: expected a function that takes "
            "(output, images, truth) or (output, labels), and beside them any of "
            f"{', '.join(REQUESTABLE_INPUTS)} by name: {error}"
        ) from None


def _has_image_parameter(names: Sequence[str]) -> bool:
    """Return whether a function takes (output, images, truth), not (output, truth).

    This is decided by its positional parameters. With three or more it takes images,
    unless the second is named like the truth, e.g. "target": then it is a loss whose
    third parameter is an option.

    The result is True for a function without a parameter for the truth, too. The caller
    finds that it can't be called with three arguments, and explains this.

    Args:
        names: names of its positional parameters, in order, without requested inputs.
    """
    lacks_parameters = len(names) < 2  # output and truth are always passed
    if lacks_parameters:
        return True
    second_name = names[1]
    if second_name in TRUTH_PARAMETERS:
        return False
    has_third = len(names) > 2
    # If the last of two parameters has such a name, there is none for the truth.
    lacks_truth = second_name in (*IMAGE_PARAMETERS, *REQUESTABLE_INPUTS)
    return has_third or lacks_truth


def wrap_objective(function: Callable[..., Tensor]) -> Objective:
    """Wrap a user's function as an objective whose mistakes are explained.

    The function gets copies of its arguments, which it may write into. A label set of a
    single class is passed as (N,) int64, as torch's losses take it. Errors that the
    function raises are not caught, except the one of a torch loss that gets several
    labels. NaN values are allowed, as a search counts them.

    Args:
        function: takes (output, images, truth) or (output, labels), and by name any of
            `REQUESTABLE_INPUTS`. It returns values (N,), or a scalar; if it returns a
            scalar for several images, it is called again with one image at a time.

    Raises:
        InputError: (when the objective is called) the result has a wrong type or shape,
            or does not depend on the arguments differentiably.
    """
    return _UserObjective(get_name(function), function, read_signature(function))


@dataclass(frozen=True, eq=False)
class _UserObjective:
    """A user's function as an objective: it is called with what it requests, and what
    it returns is checked.

    Attributes:
        name: name of the function, for messages.
        function: the function.
        signature: which arguments it takes.
    """

    name: str
    function: Callable[..., Tensor]
    signature: ObjectiveSignature

    def __call__(
        self,
        output: Any,
        images: Tensor,
        truth: Any,
        read_input: ReadInput = reject_inputs,
        /,
    ) -> Tensor:
        """Return the values (N,) of the function."""
        inputs = {name: read_input(name) for name in self.signature.requested_inputs}
        count = images.shape[0]
        argument_copies = self._copy_arguments(output, images, truth)
        input_copies = copy_value(inputs)
        result = self._call_function(argument_copies, input_copies)
        is_scalar = isinstance(result, Tensor) and result.ndim == 0
        if is_scalar and count > 1:
            # This calls the objective again, with a count of 1.
            result = _evaluate_each_image(self, output, images, truth, inputs)
        values = _check_values(self.name, result, count)
        if values.requires_grad and _are_written_into((argument_copies, input_copies)):
            self._check_backward_pass(values, output, images, inputs)
        # values without a gradient, though an argument has one, are an error
        _check_keeps_gradient(self.name, values, (images, output, *inputs.values()))
        return values

    def _copy_arguments(
        self, output: Any, images: Tensor, truth: Any
    ) -> tuple[Any, ...]:
        """Return copies of the arguments that the function takes by position.

        Args:
            output: output of the model for N images.
            images: (N, H, W, 3).
            truth: what is right for all images.
        """
        labels = truth_to_labels(truth, output, count=images.shape[0])
        takes_images = self.signature.takes_images
        arguments = (output, images, labels) if takes_images else (output, labels)
        copies: tuple[Any, ...] = copy_value(arguments)
        return copies

    def _call_function(
        self, arguments: tuple[Any, ...], inputs: Mapping[str, Any]
    ) -> Any:
        """Return what the function returns; its last argument are the labels.

        Raises:
            InputError: it is a loss of torch, and there are several labels.
        """
        labels = arguments[-1]
        try:
            return self.function(*arguments, **inputs)
        except TypeError as error:
            if not _is_label_set_rejected(labels, error):
                raise
            raise InputError(
                f"objective {self.name!r}: expected one right label for a loss of "
                f"torch, got {len(labels)} (indices "
                f"{labels}); use those of advsearch.losses, or name one with `label`"
            ) from error

    def _check_backward_pass(
        self, values: Tensor, output: Any, images: Tensor, inputs: Mapping[str, Any]
    ) -> None:
        """Raise InputError if torch can't differentiate values with a gradient.

        The function has changed a copy in place, which may make torch's backward pass
        fail. It is tried here, so that the error names the function. The gradient is by
        the output and the inputs, or else by the images.
        """
        sources = _list_differentiable((output, inputs)) or [images]
        _check_differentiable(self.name, values, sources)


def _are_written_into(copies: Any) -> bool:
    """Return whether a tensor in nested copies was written into since it was made."""
    # torch counts in `_version` how often a tensor was written into
    return any(tensor._version for tensor in _list_tensors(copies))


def _is_label_set_rejected(labels: Any, error: TypeError) -> bool:
    """Return whether a loss of torch raised the error because it got a label set.

    A set of several labels is a tuple, and such a loss takes a tensor.
    """
    return isinstance(labels, tuple) and "not tuple" in str(error)


def _evaluate_each_image(
    objective: Objective,
    output: Any,
    images: Tensor,
    truth: Any,
    inputs: Mapping[str, Any],
) -> Tensor:
    """Return the values (N,) of an objective that is called with one image at a time.

    Args:
        objective: wraps a function that returns a scalar for any number of images.
        output: output of the model for N images.
        images: (N, H, W, 3).
        truth: what is right, equal for all images.
        inputs: inputs that the function requests, by name, for all N images.
    """
    values = []
    for index in range(images.shape[0]):
        batch = slice(index, index + 1)  # a batch of one
        read_input = partial(_select_input, inputs, index)
        value = objective(output[batch], images[batch], truth, read_input)
        values.append(value)
    return torch.cat(values)


def _check_keeps_gradient(name: str, values: Tensor, sources: tuple[Any, ...]) -> None:
    """Raise InputError if a function's values have lost the gradient.

    Nothing is checked if torch records no gradients, or no argument needs one.

    Args:
        name: name of the function.
        values: (N,) values that it returned.
        sources: arguments that it was called with, tensors or not.
    """
    if values.requires_grad or not torch.is_grad_enabled():
        return
    if any(isinstance(source, Tensor) and source.requires_grad for source in sources):
        raise InputError(
            f"objective {name!r}: the result does not depend on the output or the "
            "images differentiably; remove .detach(), torch.no_grad() or argmax, or "
            "choose a policy without gradients (random)"
        )


def _list_tensors(value: Any) -> list[Tensor]:
    """Return all tensors in nested tuples, lists and mappings."""
    if isinstance(value, Tensor):
        return [value]
    elements: Iterable[Any] = ()
    if isinstance(value, dict):
        elements = value.values()
    elif isinstance(value, (list, tuple)):
        elements = value
    return [tensor for element in elements for tensor in _list_tensors(element)]


def _list_differentiable(value: Any) -> list[Tensor]:
    """Return the tensors in nested tuples, lists and mappings that need a gradient."""
    return [tensor for tensor in _list_tensors(value) if tensor.requires_grad]


def _check_differentiable(name: str, values: Tensor, sources: Sequence[Tensor]) -> None:
    """Raise InputError if torch can't differentiate a function that wrote in place.

    Args:
        name: name of the function.
        values: (N,) values that it returned, with a graph.
        sources: tensors that need a gradient.
    """
    try:
        torch.autograd.grad(values.sum(), sources, retain_graph=True, allow_unused=True)
    except RuntimeError as error:
        if "inplace" not in str(error):
            raise
        raise InputError(
            f"objective {name!r}: it writes into what it is given, and then torch "
            "can't differentiate what it has computed before; use the operation that "
            "makes a new tensor (`scatter` for `scatter_`, `logits.clone()` before "
            "`logits[...] = ...`)"
        ) from None


def get_name(function: Callable[..., Any]) -> str:
    """Return the name of a function for messages."""
    return getattr(function, "__name__", type(function).__name__)


def _check_values(name: str, values: Any, count: int) -> Tensor:
    """Check what a user's function returned; return one value per image, (count,).

    Args:
        name: name of the function.
        values: what it returned; a scalar is allowed for a single image.
        count: number of images.

    Raises:
        InputError: it is no floating-point tensor of that shape.
    """
    _check_floating_point(name, values, count)
    value_per_image: Tensor = values
    # a scalar is the value of a single image
    if values.ndim == 0 and count == 1:
        value_per_image = values.reshape(1)
    if value_per_image.shape != (count,):
        raise InputError(
            f"objective {name!r}: expected one value per image, shape ({count},), got "
            f"{tuple(value_per_image.shape)}; "
            "reduce over everything but the first axis"
        )
    return value_per_image


def _check_floating_point(name: str, values: Any, count: int) -> None:
    """Raise InputError if what a user's function returned for `count` images is no
    tensor of floating-point numbers.
    """
    if not isinstance(values, Tensor):
        raise InputError(
            f"objective {name!r}: expected a torch tensor of shape ({count},), got "
            f"{type(values).__name__}; compute it with torch operations and don't call "
            ".item(), float() or .numpy()"
        )
    if not values.is_floating_point():
        raise InputError(
            f"objective {name!r}: expected floating-point values, got {values.dtype}; "
            "a count or a comparison has no gradient"
        )


def truth_to_labels(truth: Any, output: Any, count: int) -> Any:
    """Return the truth as a user's function gets it.

    A label set of one class, e.g. (3,), becomes a tensor (count,) int64, as torch's
    losses take it. Anything else, e.g. boxes or several labels, is returned unchanged.

    Args:
        truth: what is right for all images.
        output: output of the model; the tensor is on its device.
        count: number of images, N.
    """
    if (
        isinstance(truth, tuple)
        and len(truth) == 1
        and isinstance(truth[0], int)
        and isinstance(output, Tensor)
    ):
        return torch.full((count,), truth[0], device=output.device)
    return truth


def _select_input(inputs: Mapping[str, Any], index: int, name: str) -> Any:
    """Return the input of that name for a single image of several, by its index."""
    value = inputs[name]
    image_slice = slice(index, index + 1)
    if isinstance(value, Tensor):
        return value[image_slice]
    return {key: values[image_slice] for key, values in value.items()}


@final
@dataclass(frozen=True)
class ObjectiveKind:
    """A named objective: its functions, or how they are made for a run.

    Exactly one of `plain`, `of_features` and `of_task` is set.

    Attributes:
        name: name of the objective, e.g. "margin".
        summary: one line about it.
        unit: unit of its values.
        plain: function (output, images, right labels), which may request further inputs
            as a user's function may.
        targeted: the same function with a target in place of the labels; None if it has
            no such form.
        task: name of the task whose outputs it takes. Tasks that are subclasses of that
            task fit as well. None for any task.
        of_features: makes the function from the model's features and a clean image.
        of_task: makes the objective from the task. The task has the target and the
            direction, so the objective needs neither.
    """

    name: str
    summary: str
    unit: str
    plain: Callable[..., Tensor] | None = None
    targeted: Callable[..., Tensor] | None = None
    task: str | None = Classification.name
    of_features: Callable[[ReadFeatures, Tensor], Callable[..., Tensor]] | None = None
    of_task: Callable[[Any], Objective] | None = None

    @property
    def needs_features(self) -> bool:
        """Whether it is made from features."""
        return self.of_features is not None

    def fits(self, task: str) -> bool:
        """Return whether it takes the outputs of a task, by the name of the task.

        An objective without a task fits every task. Otherwise it fits its own task and
        all subclasses of it.
        """
        if self.task is None or self.task == task:
            return True
        # The task of another package need not be installed, so it may be unknown.
        are_known = self.task in TASKS and task in TASKS
        return are_known and issubclass(TASKS[task], TASKS[self.task])

    def form(self, *, targeted: bool) -> Callable[..., Tensor]:
        """Return the plain or the targeted function."""
        function = self.targeted if targeted else self.plain
        if function is None:
            raise InputError(
                f"objective {self.name!r}: has no "
                f"{'targeted' if targeted else 'plain'} form; use another"
            )
        return function


def _ignore_inputs(function: Callable[[Any, Tensor, Any], Tensor]) -> Objective:
    """Make an objective from a function of (output, images, truth).

    An objective is called with a fourth argument as well, which reads further inputs;
    it is ignored.
    """

    def plain(
        output: Any, images: Tensor, truth: Any, more: ReadInput = reject_inputs, /
    ) -> Tensor:
        return function(output, images, truth)

    return plain


def _pass_copies(objective: Objective) -> Objective:
    """Wrap another package's objective so that it is called with copies.

    It may write into its arguments, and the run still needs them unchanged.
    """

    def with_copies(
        output: Any, images: Tensor, truth: Any, more: ReadInput = reject_inputs, /
    ) -> Tensor:
        def read_copy(name: str) -> Any:
            return copy_value(more(name))

        return objective(*copy_value((output, images, truth)), read_copy)

    return with_copies


def _make_score_objective(task: Task) -> Objective:
    return _ignore_inputs(lambda output, images, truth: task.score(output, truth))


_DEPTH_GOALS: Mapping[str, str] = (
    load_attribute("advsearch.tasks.depth:GOALS") if "depth" in TASKS.built_ins else {}
)
_BUILT_IN_KINDS = {
    kind.name: kind
    for kind in (
        *(
            ObjectiveKind(
                name,
                summary,
                unit,
                getattr(functions, name),
                getattr(functions, f"targeted_{name}"),
            )
            for name, summary, unit in (
                (
                    "margin",
                    "the margin loss: the largest wrong logit minus the largest "
                    "right one",
                    "logits (log-odds)",
                ),
                (
                    "log_odds",
                    "the log-odds of a wrong prediction, over all classes",
                    "logits (log-odds)",
                ),
                (
                    "cross_entropy",
                    "minus the logarithm of the probability of the right labels",
                    "nats",
                ),
                (
                    "dlr",
                    "the margin loss over a distance between logits: independent "
                    "of their scale",
                    "none (a ratio)",
                ),
            )
        ),
        ObjectiveKind(
            "feature_distance",
            "distance of the features from those of the clean image",
            "lengths of the clean features",
            of_features=functions.feature_distance,
        ),
        ObjectiveKind(
            "distance",
            "distance of the features from those of the clean image, by the angle",
            "1 - cosine",
            task="similarity",
            of_features=functions.cosine_distance,
        ),
        ObjectiveKind(
            "score",
            "the task's own score, over 0 where a prediction is a success; in "
            "classification the margin loss",
            "that of the task",
            task=None,
            of_task=_make_score_objective,
        ),
        *(
            ObjectiveKind(
                name,
                f"success: {summary}",
                "log-odds",
                task=Detection.name,
                of_task=_make_score_objective,
            )
            for name, summary in GOALS.items()
        ),
        ObjectiveKind(
            EnsembleTask.objective,
            "the objectives of several tasks, combined by `ensemble`",
            "those of the tasks",
            task=EnsembleTask.name,
            of_task=_make_score_objective,
        ),
        *(
            ObjectiveKind(
                name,
                f"success: {summary}",
                "logarithm of a factor",
                task="depth",
                of_task=_make_score_objective,
            )
            for name, summary in _DEPTH_GOALS.items()
        ),
        ObjectiveKind(
            "pixel_margin",
            "the largest wrong logit minus the largest right one, mean "
            "over the object's pixels",
            "logits (log-odds)",
            task="segmentation",
            of_task=lambda task: _ignore_inputs(
                lambda output, images, truth: task.pixel_margin(output, truth)
            ),
        ),
    )
    if kind.task in (None, EnsembleTask.name, *TASKS.built_ins)
}

OBJECTIVE_KINDS: Registry[ObjectiveKind] = Registry(
    "advsearch.objectives",
    _BUILT_IN_KINDS,
    "an ObjectiveKind whose name is that of the entry point",
    lambda name, entry: isinstance(entry, ObjectiveKind) and entry.name == name,
)
"""All named objectives, including those of other packages."""

OBJECTIVES: dict[str, Callable[..., Tensor]] = {
    name: kind.plain for name, kind in _BUILT_IN_KINDS.items() if kind.plain is not None
}
"""The built-in objectives of logits, in their plain form."""


def objective_summaries() -> dict[str, str]:
    """Return one line about every objective that has a name."""
    return {name: kind.summary for name, kind in OBJECTIVE_KINDS.items()}


# ---- from names and functions to objectives


def get_objective(
    objective: str | Callable[..., Tensor],
    task: Task | None = None,
    *,
    features: ReadFeatures | None = None,
    clean: Tensor | None = None,
) -> Objective:
    """Return an objective by its name, or a user's function wrapped as one.

    The result is always called with the truth, and is to be maximized. If the task has
    a target, a named objective uses its targeted form, and a user's function gets the
    target in place of the truth. If the task minimises, the values are negated. The
    mistakes of a user's function are explained.

    Args:
        objective: a name, or a function of (output, images, truth) or of (output,
            labels), which may request further inputs by name.
        task: judges the model; by default classification without a target.
        features: computes the model's features, for an objective that
            `needs_features`: `advsearch.models.features.features_of(model)`.
        clean: for such an objective the clean image (H, W, 3), or renders of it (N, H,
            W, 3).

    Raises:
        UnknownNameError: there is no objective of that name.
        InputError: the objective does not fit the task, or needs features and got none.
    """
    task = task or Classification()
    targeted = task.target is not None
    check_objective(objective, task.name, targeted=targeted, minimise=task.minimise)
    kind = _find_kind(objective)
    if kind is not None:
        return _make_named_objective(kind, task, features, clean)
    function = wrap_objective(objective)  # type: ignore[arg-type]
    name = get_name(objective)  # type: ignore[arg-type]
    return _OrientedObjective(function, task, name if targeted else "")


def _make_named_objective(
    kind: ObjectiveKind, task: Task, features: ReadFeatures | None, clean: Tensor | None
) -> Objective:
    """Return a named objective for a task; the arguments are those of `get_objective`.

    Raises:
        InputError: the objective needs features and got none.
    """
    if kind.of_task is not None:
        # The objective that the task itself defines has its target and direction
        # already.
        task_objective = kind.of_task(task)
        return task_objective if _is_built_in(kind) else _pass_copies(task_objective)
    if kind.of_features is not None:
        function = _make_feature_objective(kind, features, clean)
        return _OrientedObjective(function, task)
    function = _make_output_objective(kind, targeted=task.target is not None)
    converts_output = _must_convert_outputs(task)
    return _OrientedObjective(function, task, converts_output=converts_output)


def _is_built_in(kind: ObjectiveKind) -> bool:
    """Return whether an objective is part of this package, not of another one."""
    return any(kind is built_in for built_in in _BUILT_IN_KINDS.values())


def _make_output_objective(kind: ObjectiveKind, *, targeted: bool) -> Objective:
    """Return the objective of a kind that has functions of the model's output.

    A function of another package is wrapped like one of a user: it gets copies of its
    arguments, and its mistakes are explained.

    Args:
        kind: kind with a `plain` or `targeted` form.
        targeted: which of these forms to take.
    """
    function = kind.form(targeted=targeted)  # of (output, images, labels)
    if _is_built_in(kind):
        return _ignore_inputs(function)
    return wrap_objective(function)


def _make_feature_objective(
    kind: ObjectiveKind, features: ReadFeatures | None, clean: Tensor | None
) -> Objective:
    """Return the objective of a kind that is made from the model's features.

    A function of another package gets copies of its arguments.

    Args:
        kind: kind with `of_features`.
        features: function from images (N, H, W, 3) to features (N, F).
        clean: the clean image (H, W, 3), or renders of it (N, H, W, 3).

    Raises:
        InputError: no features, or no clean image.
    """
    assert kind.of_features is not None
    if features is None or clean is None:
        raise InputError(
            f"objective {kind.name!r}: expected the model's features and a clean "
            "picture, got none; use get_objective(name, "
            "features=advsearch.models.features.features_of(model), clean=picture)"
        )
    objective = _ignore_inputs(kind.of_features(features, clean))
    return objective if _is_built_in(kind) else _pass_copies(objective)


def _must_convert_outputs(task: Task) -> bool:
    """Return whether the model's outputs have to be converted to logits of classes.

    `Task.as_logits` converts them. The outputs may be features that are compared with
    those of each label, or may have classes that mean "nothing here".
    """
    compares_features = isinstance(task, Classification) and not task.reads_logits
    has_nothing_classes = isinstance(task, ClassTask) and bool(task.background_classes)
    return compares_features or has_nothing_classes


@dataclass(eq=False)
class _OrientedObjective:
    """An objective that is called with the truth and is to be maximized.

    So a search need not distinguish targets or minimizing.

    - If the task has a target, the function gets it in place of the truth.
    - If the task minimizes, the values of the function are negated.
    - With a target, a user's function may have the wrong sign: it may fall as the
      target becomes more likely. This is checked once, in the first call with a
      gradient. A named objective has the right sign.

    Attributes:
        function: function to orient.
        task: task with the target and the direction.
        name_to_check: name of a user's function whose sign is not checked yet, else
            empty.
        converts_output: whether the function gets `Task.as_logits` of the output.
    """

    function: Objective
    task: Task
    name_to_check: str = ""
    converts_output: bool = False

    def __call__(
        self,
        output: Any,
        images: Tensor,
        truth: Any,
        read_input: ReadInput = reject_inputs,  # reads further inputs by name
        /,
    ) -> Tensor:
        """Return the values (N,) of the function, negated if the task minimizes."""
        labels = truth if self.task.target is None else self.task.target
        converts = self.converts_output
        function_output = self.task.as_logits(output, labels) if converts else output
        values = self.function(function_output, images, labels, read_input)
        # it can only be checked if the values have a gradient by the model's output
        if self.name_to_check and _has_slope_by_class(values, output):
            name = self.name_to_check
            self.name_to_check = ""
            _warn_of_direction(name, values, output, labels)
        return -values if self.task.minimise else values


def _has_slope_by_class(values: Tensor, output: Any) -> bool:
    """Return whether values can be differentiated by an output (N, classes)."""
    has_logits = isinstance(output, Tensor) and output.ndim == 2
    return values.requires_grad and has_logits and output.requires_grad


def _warn_of_direction(name: str, values: Tensor, output: Tensor, target: Any) -> None:
    """Warn if a user's function falls, for every image, as the target's logit rises.

    It probably has the wrong sign: maximizing it leads away from the target.

    Args:
        name: name of the function.
        values: (N,) values that it returned, with a graph.
        output: (N, classes) logits.
        target: indices of classes; anything else is not checked.
    """
    if _falls_with_target(values, output, target):
        warnings.warn(
            f"objective {name!r} falls as the target becomes more likely, and an "
            "objective is maximised: the search walks away from the target. Negate "
            "it, or take a loss of advsearch.losses that begins with targeted_.",
            stacklevel=2,
        )


def _falls_with_target(values: Tensor, output: Tensor, target: Any) -> bool:
    """Return whether the value of every image falls as the target's logits rise.

    Args:
        values: (N,) values of an objective, with a graph.
        output: (N, classes) logits.
        target: indices of classes; False for anything else.
    """
    # the graph is retained, as the search differentiates it again
    (slope,) = torch.autograd.grad(
        values.sum(), output, retain_graph=True, allow_unused=True
    )
    classes = []
    if isinstance(target, tuple):
        classes = [index for index in target if isinstance(index, int)]
    if slope is None or not classes:
        return False
    return bool((slope[:, classes].sum(dim=1) < 0.0).all())


def check_objective(
    objective: object,
    task: str = Classification.name,
    *,
    targeted: bool = False,
    minimise: bool = False,
) -> None:
    """Check that an objective fits a task, before a model or scene is loaded.

    Args:
        objective: a name, or a function.
        task: name of the task.
        targeted: whether a prediction of a certain target is sought.
        minimise: whether a right prediction is sought.

    Raises:
        UnknownNameError: there is no objective of that name.
        InputError: it is neither a name nor a function with the arguments of an
            objective; it belongs to another task; `targeted` and `minimise` are both
            set; or an objective of features has a target or is minimised.
    """
    if targeted and minimise:
        raise InputError(
            "minimise: expected no `target` beside it; to make the object easier to "
            "recognise as something else, give that as `label`"
        )
    _check_exists(objective)
    kind = _find_kind(objective)
    if kind is not None:
        _check_kind(kind, task, targeted=targeted, minimise=minimise)
    else:  # a function: this raises if it takes other arguments
        read_signature(objective)  # type: ignore[arg-type]


def _check_exists(objective: object) -> None:
    """Raise InputError if it is neither the name of an objective nor a function."""
    if isinstance(objective, str) and objective not in OBJECTIVE_KINDS:
        hint = (
            "From Python, objective= also takes a function (output, images, truth), "
            "or (output, labels)."
        )
        raise UnknownNameError("objective", objective, OBJECTIVE_KINDS, hint)
    if not isinstance(objective, str) and not callable(objective):
        raise InputError(
            "objective: expected a name or a function (output, images, "
            f"truth), got {objective!r}"
        )


def _check_kind(
    kind: ObjectiveKind, task: str, *, targeted: bool, minimise: bool
) -> None:
    """Raise InputError if a named objective does not fit the task or the goal.

    Args:
        kind: kind of the objective.
        task: name of the task.
        targeted: whether a prediction of a certain target is sought.
        minimise: whether a right prediction is sought.
    """
    if not kind.fits(task):
        fitting = [name for name, other in OBJECTIVE_KINDS.items() if other.fits(task)]
        raise InputError(
            f"objective: expected an objective of task {task} ({', '.join(fitting)}), "
            f"got {kind.name}, which takes outputs of {kind.task}"
        )
    # An objective of features is a distance from the clean image, which can only be
    # maximized.
    if kind.needs_features and targeted:
        reason = "it leads away from the clean image, to no class in particular"
        raise _make_features_error(kind, "target", reason)
    if kind.needs_features and minimise:
        reason = "its minimum is at the start already"
        raise _make_features_error(kind, "minimise", reason)


def _make_features_error(kind: ObjectiveKind, setting: str, reason: str) -> InputError:
    """Return the error of a setting that an objective of features can't have."""
    return InputError(
        f"{setting}: expected `objective` {' or '.join(OBJECTIVES)}, "
        f"got {kind.name}; {reason}"
    )


def list_requested_inputs(objective: str | Callable[..., Tensor]) -> tuple[str, ...]:
    """Return the names of the further inputs that an objective requests.

    They are some of `REQUESTABLE_INPUTS`. The objective must have been checked already
    (`check_objective`).
    """
    kind = _find_kind(objective)
    function = objective if kind is None else kind.plain
    return read_signature(function).requested_inputs if callable(function) else ()


def _find_kind(objective: object) -> ObjectiveKind | None:
    """Return the kind of a named objective, or None for a user's function.

    Args:
        objective: a name, or a function; the plain form of a named objective, such as
            `margin`, counts as named.
    """
    if isinstance(objective, str):
        return OBJECTIVE_KINDS[objective]
    return next(
        (kind for kind in OBJECTIVE_KINDS.values() if kind.plain is objective), None
    )
