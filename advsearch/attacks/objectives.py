"""What a search maximises, from logits; and what counts as success, which is another thing (DESIGN 4.2).

An objective is a callable `(logits, images, labels) -> values`, the larger the worse for the model:

- logits: (N, C) float32 output of the model;
- images: (N, H, W, 3) float32 that the model saw, display-referred sRGB in [0, 1];
- labels: the indices of the label set Y, every one of which is a right answer;
- values: (N,), differentiable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from advsearch.attacks.evaluation import Evaluation, StopWhen
from advsearch.errors import InputError, UnknownNameError

Labels = tuple[int, ...]


class Objective(Protocol):
    """The signature of an objective; see the module's docstring."""

    def __call__(self, logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
        """Return (N,) values to maximise."""
        ...


def margin(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """max over j not in Y of z_j, minus max over y in Y of z_y: over 0 exactly where the model answers wrongly.

    In logits (log-odds), unbounded, and with a gradient of one at every confidence (Carlini and Wagner 2017, f_6
    without its hinge). Ties share the gradient.
    """
    right = _membership(logits, labels)
    wrong = logits.masked_fill(right, -torch.inf).amax(dim=1)
    return wrong - logits.masked_fill(~right, -torch.inf).amax(dim=1)


def cross_entropy(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """-log of the total probability of Y, computed as softplus(logsumexp over j not in Y - logsumexp over Y).

    That form neither overflows for logits of thousands nor cancels where the probability is near 1. The gradient does
    fade with the probability of a wrong answer, and float32 rounds it to nothing once the model is surer than
    1 - 1e-45 (log-odds of about 100); `margin` has no such limit.
    """
    right = _membership(logits, labels)
    wrong = logits.masked_fill(right, -torch.inf).logsumexp(dim=1)
    return functional.softplus(wrong - logits.masked_fill(~right, -torch.inf).logsumexp(dim=1))


OBJECTIVES: dict[str, Objective] = {"margin": margin, "cross_entropy": cross_entropy}


def succeeded(logits: Tensor, labels: Labels) -> Tensor:
    """Return (N,) bool: the largest logit lies outside the label set. Ties and NaN are no success."""
    return margin(logits, logits, labels) > 0.0


def stop_at_margin(threshold: float, labels: Labels) -> StopWhen:
    """Return a `stop_when` for `search`: stop once one render shows a margin of at least `threshold` logits.

    One render is noisy, so a threshold a few times the margin's noise saves the search from stopping on luck.
    """

    def reached(evaluation: Evaluation) -> bool:
        logits = evaluation.logits.reshape(1, -1)
        return bool(margin(logits, logits, labels)[0] >= threshold)

    return reached


def get_objective(objective: str | Callable[..., Tensor]) -> Objective:
    """Return the objective of that name, or the user's own callable wrapped so that its mistakes are explained.

    Raises:
        UnknownNameError: no such name.
        InputError: neither a name nor callable.
    """
    if isinstance(objective, str):
        if objective not in OBJECTIVES:
            hint = "From Python, objective= also takes a function (logits, images, labels)."
            raise UnknownNameError("objective", objective, OBJECTIVES, hint)
        return OBJECTIVES[objective]
    if not callable(objective):
        raise InputError(f"objective: expected a name or a function (logits, images, labels), got {objective!r}")
    return objective if objective in OBJECTIVES.values() else checked(objective)


def checked(function: Callable[..., Tensor]) -> Objective:
    """Wrap a user's function: a scalar becomes (1,), and a wrong type, shape or a lost gradient is an InputError.

    The function gets (logits, images, labels) as the module's docstring says and returns (N,), or a scalar for one
    image. What it raises itself passes through. NaN values pass too: a search has a rule for them.
    """
    name = getattr(function, "__name__", type(function).__name__)

    def objective(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
        values = function(logits, images, labels)
        count = logits.shape[0]
        if not isinstance(values, Tensor):
            raise InputError(
                f"objective {name!r}: expected a torch tensor of shape ({count},), got {type(values).__name__}; "
                "compute it with torch operations and don't call .item(), float() or .numpy()"
            )
        if not values.is_floating_point():
            raise InputError(
                f"objective {name!r}: expected floating-point values, got {values.dtype}; a count or a comparison has "
                "no gradient"
            )
        if values.ndim == 0 and count == 1:
            values = values.reshape(1)
        if values.shape != (count,):
            raise InputError(
                f"objective {name!r}: expected one value per image, shape ({count},), got {tuple(values.shape)}; "
                "reduce over everything but the first axis"
            )
        wanted = torch.is_grad_enabled() and (logits.requires_grad or images.requires_grad)
        if wanted and not values.requires_grad:
            raise InputError(
                f"objective {name!r}: the result does not depend on logits or images differentiably; "
                "remove .detach(), torch.no_grad() or argmax, or choose a policy without gradients (random)"
            )
        return values

    return objective


def _membership(logits: Tensor, labels: Labels) -> Tensor:
    """Return (C,) bool, true for the classes of the label set; checks the logits and the labels."""
    if logits.ndim != 2:
        raise InputError(f"model output: expected logits of shape (N, classes), got {tuple(logits.shape)}")
    classes = logits.shape[1]
    if not labels or not all(0 <= label < classes for label in labels):
        raise InputError(f"--label: expected class indices from 0 to {classes - 1}, got {tuple(labels)}")
    right = torch.zeros(classes, dtype=torch.bool, device=logits.device)
    right[list(labels)] = True
    if bool(right.all()):
        raise InputError(f"--label: the label set holds all {classes} classes, so no answer could be wrong")
    return right
