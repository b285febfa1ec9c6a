"""Losses for the objective of a user, or for a training loop, `advsearch.losses`.

    def smooth(logits, images, labels, texture):
        return losses.margin(logits, labels) - 10.0 * losses.total_variation(texture)

The losses of logits are **maximized**; each is an objective by itself. They take logits
(N, C) and labels: (N,) int64, or the indices of a label set of which every label is
right. The losses of colors are a **cost**, to be subtracted. All return (N,) and are
differentiable. The formulas are in `advsearch.attacks.objective_functions` and
`advsearch.engine.judging`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from advsearch.attacks import objective_functions as of_logits
from advsearch.engine import judging
from advsearch.errors import InputError

__all__ = [
    "carlini_wagner",
    "cross_entropy",
    "dlr",
    "log_odds",
    "margin",
    "non_printability",
    "nps",
    "targeted_carlini_wagner",
    "targeted_cross_entropy",
    "targeted_dlr",
    "targeted_log_odds",
    "targeted_margin",
    "total_variation",
]

# (N,) int64, the right label of each image; or indices of a label set for all images
Labels = Tensor | Sequence[int]


# ---- of logits (N, C), to be maximized


def margin(logits: Tensor, labels: Labels) -> Tensor:
    """Return the largest wrong logit minus the largest right one, (N,).

    It is over 0 exactly where the prediction is wrong.
    """
    return _by_label(of_logits.margin, logits, labels)


def targeted_margin(logits: Tensor, target: Labels) -> Tensor:
    """Return the largest logit of the target minus the largest other one, (N,).

    It is over 0 exactly where the prediction is the target.
    """
    return _by_label(of_logits.targeted_margin, logits, target)


def carlini_wagner(
    logits: Tensor, labels: Labels, *, confidence: float = 0.0
) -> Tensor:
    """Return `margin`, clipped at a confidence (Carlini and Wagner 2017, f_6).

    The sign is opposite to theirs, as this is to be maximized. Where it is clipped it
    has no gradient, so that a search improves the other terms of the objective there.
    """
    return margin(logits, labels).clamp(max=confidence)


def targeted_carlini_wagner(
    logits: Tensor, target: Labels, *, confidence: float = 0.0
) -> Tensor:
    """Return `targeted_margin`, clipped at a confidence; see `carlini_wagner`."""
    return targeted_margin(logits, target).clamp(max=confidence)


def cross_entropy(logits: Tensor, labels: Labels) -> Tensor:
    """Return minus the logarithm of the probability of the right labels, (N,), in nats.

    For one right label it equals the loss of torch, but it keeps a gradient where the
    model is sure.
    """
    return _by_label(of_logits.cross_entropy, logits, labels)


def targeted_cross_entropy(logits: Tensor, target: Labels) -> Tensor:
    """Return the logarithm of the probability of the target, (N,), in nats."""
    return _by_label(of_logits.targeted_cross_entropy, logits, target)


def log_odds(logits: Tensor, labels: Labels) -> Tensor:
    """Return the log-odds of a wrong prediction over all classes, (N,)."""
    return _by_label(of_logits.log_odds, logits, labels)


def targeted_log_odds(logits: Tensor, target: Labels) -> Tensor:
    """Return the log-odds of the target, (N,)."""
    return _by_label(of_logits.targeted_log_odds, logits, target)


def dlr(logits: Tensor, labels: Labels) -> Tensor:
    """Return the difference of logits ratio, (N,) (Croce and Hein 2020, section 4).

    It is `margin` over a distance between logits.
    """
    return _by_label(of_logits.dlr, logits, labels)


def targeted_dlr(logits: Tensor, target: Labels) -> Tensor:
    """Return the targeted difference of logits ratio, (N,).

    It is `targeted_margin` over a distance between logits (Croce and Hein 2020, section
    4).
    """
    return _by_label(of_logits.targeted_dlr, logits, target)


# ---- of colors (N, h, w, 3), a cost


def total_variation(colors: Tensor) -> Tensor:
    """Compute the mean difference of a pixel from its right and lower neighbors, (N,).

    It is the total variation of Sharif et al. 2016, section 5.2.2, in sRGB. They take
    the sum over pixels. Here it is the mean, so that a weight has the same effect at
    every resolution.

    Args:
        colors: (N, h, w, 3) sRGB in [0, 1], a texture or images; or (N, h, w, 4), where
            only pixels whose last channel is over 0 count.
    """
    return torch.stack([judging.mean_variation(image) for image in _to_batch(colors)])


def non_printability(colors: Tensor, palette: Tensor | None = None) -> Tensor:
    """Return the mean sRGB distance of pixels from the nearest printable color, (N,).

    The non-printability score of Sharif et al. 2016, section 5.2.3, is a product of the
    distances to all printable colors. Both are zero at the same colors.

    Args:
        colors: (N, h, w, 3) sRGB in [0, 1], a texture or images; or (N, h, w, 4), where
            only pixels whose last channel is over 0 count.
        palette: (P, 3) sRGB in [0, 1], the colors that can be printed; None for the 125
            of `printable`.
    """
    return torch.stack(
        [judging.printable_distance(image, palette) for image in _to_batch(colors)]
    )


nps = non_printability  # its usual short name


# ---- as objectives


def check_direction(objective: object, *, targeted: bool) -> None:
    """Check that a loss function fits a search with or without a target.

    A search maximizes its objective. With a target, the loss must rise towards the
    target, and most losses fall towards it. Only losses of this module and of torch are
    checked; any other objective passes.

    Args:
        objective: the loss function.
        targeted: whether the search has a target.

    Raises:
        InputError: the loss needs a target and there is none, or it does not rise
            towards the target.
    """
    function = getattr(objective, "func", objective)  # of functools.partial
    if targeted:
        _check_not_of_torch(function)
    for name in __all__:
        counterpart = f"targeted_{name}"  # the same loss for a target
        if counterpart in __all__:
            _check_not_counterpart(function, name, counterpart, targeted=targeted)


def _check_not_counterpart(
    function: object, name: str, counterpart: str, *, targeted: bool
) -> None:
    """Check that a function is not the wrong one of two losses.

    Args:
        function: the function.
        name: name of the loss for a search without a target.
        counterpart: name of the same loss for a search with a target.
        targeted: whether the search has a target.

    Raises:
        InputError: it is the other one.
    """
    if function is globals()[name] and targeted:
        raise InputError(
            f"objective: losses.{name} leads away from the `target`; "
            f"take losses.{counterpart}"
        )
    if function is globals()[counterpart] and not targeted:
        raise InputError(
            f"objective: losses.{counterpart} needs a `target`; name one, or take "
            f"losses.{name}"
        )


def _check_not_of_torch(function: object) -> None:
    """Check that a loss function for a search with a target is none of torch's.

    Raises:
        InputError: it is one, which falls towards the target.
    """
    module = str(getattr(function, "__module__", None) or type(function).__module__)
    is_of_torch = module.startswith(
        ("torch.nn.functional", "torch.nn.modules", "torch._C")
    )
    if is_of_torch:
        name = getattr(function, "__name__", type(function).__name__)
        raise InputError(
            f"objective: it is maximised, and torch's {name} falls towards the "
            "`target`; take losses.targeted_cross_entropy, or negate it: lambda "
            "logits, labels: -loss(logits, labels)"
        )


# ---- parts


def _check_label_type(labels: object) -> None:
    """Check that labels are those of classification: a tensor, or a label set.

    Raises:
        InputError: they are the truth of another task.
    """
    if not isinstance(labels, (Tensor, Sequence)):
        raise InputError(
            "labels: expected (N,) int64 or the indices of a label set, got "
            f"{type(labels).__name__}, the truth of another task than classification; "
            "a loss of your own takes it as it is"
        )


def _by_label(loss: Callable[..., Tensor], logits: Tensor, labels: Labels) -> Tensor:
    """Compute a loss of logits for their labels, (N,).

    Args:
        loss: function (logits, images, label set) -> (N,) that does not use the images.
            The logits are passed as its images, too.
        logits: (N, C).
        labels: (N,) or (1,) int64, a label for each row or one for all rows; or the
            indices of a label set for all rows, any of which is right.

    Raises:
        InputError: the labels have another type, or do not fit the number of rows.
    """
    _check_label_type(labels)
    if not isinstance(labels, Tensor):  # a label set for all rows
        return loss(logits, logits, tuple(labels))
    label_sets = [(int(label),) for label in labels.flatten()]
    _check_label_count(label_sets, logits)
    if len(set(label_sets)) == 1:  # the same label for all rows
        return loss(logits, logits, label_sets[0])
    row_losses = [
        loss(row[None], row[None], label_set)
        for row, label_set in zip(logits, label_sets, strict=True)
    ]
    return torch.cat(row_losses)


def _check_label_count(label_sets: Sequence[object], logits: Tensor) -> None:
    """Check that there is one label, or one for each row of logits (N, C).

    Raises:
        InputError: there are more or fewer.
    """
    if len(label_sets) not in (1, len(logits)):
        raise InputError(
            f"labels: expected {len(logits)}, one for each row of logits, "
            f"got {len(label_sets)}"
        )


def _to_batch(colors: Tensor) -> Tensor:
    """Return colors (h, w, c) or (N, h, w, c) as (N, h, w, c)."""
    if colors.ndim == 3:
        return colors[None]
    if colors.ndim != 4 or colors.shape[-1] not in (3, 4):
        raise InputError(f"colors: expected (N, h, w, 3), got {tuple(colors.shape)}")
    return colors
