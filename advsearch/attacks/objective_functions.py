"""Objectives as pure functions: margin, log-odds, cross-entropy and DLR of logits, and
two distances of features.

An objective of logits has two forms, both to be *maximized*:

- plain, `f(logits, images, labels)`: away from the label set Y of right labels;
- targeted, `targeted_f(logits, images, target)`: towards a target T, which is a label
set as well.

The arguments are logits (N, C), images (N, H, W, 3) and class indices. All objectives
have the images as an argument, but those of logits do not use them. Values are (N,), of
the dtype of the logits, and differentiable. The gradient is finite and does not vanish,
also for logits of ten thousand, at ties, and at probabilities that round to 0 or 1.
InputError: logits that are not (N, C), indices that the model does not have, a label
set of all classes.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from advsearch.errors import InputError
from advsearch.tasks.classification import (
    Labels,
    compute_largest_logit,
    compute_misclassification_margin,
    compute_target_margin,
    make_class_mask,
)

MAX_LOG_ODDS = -15.0
"""Log-odds of a wrong prediction below which cross-entropy is replaced by its tangent.
There its slope is about exp(log-odds). In float32 this rounds to 0 at -103, and is
negligible next to other gradients long before.
"""

# It is added to the denominator of `dlr`, as a fraction of the distance from the
# largest to the smallest logit.
RELIEF = 1e-4
# If all logits lie within this distance, `dlr` treats them as equal.
SAME = 1e-12


def margin(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """Return the largest wrong logit minus the largest right one, (N,): over 0 exactly
    where the model is wrong.

    With logits z it is (max over j not in Y of z_j) - (max over y in Y of z_y). It is
    unbounded, and its gradient is 1 in one logit and -1 in another at every confidence.
    This is f_6 of Carlini and Wagner 2017 without its hinge, max(., -confidence). If
    several logits are the largest, the gradient is divided among them.
    """
    return compute_misclassification_margin(logits, labels)


def targeted_margin(logits: Tensor, images: Tensor, target: Labels) -> Tensor:
    """Return the largest logit in T minus the largest other one, (N,): over 0 exactly
    where the prediction is in T.
    """
    return compute_target_margin(logits, target)


def log_odds(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """Return the log-odds of a wrong prediction, (N,).

    It is log((1 - p) / p), with p the total probability of the right labels Y, computed
    as logsumexp over j not in Y minus logsumexp over Y. All classes count, as in
    cross-entropy, but the gradient does not vanish where the model is sure. It
    increases with `cross_entropy`, so the two rank configurations alike. It differs
    from `margin` by at most the logarithm of the number of classes.
    """
    return _compute_log_odds(logits, ~make_class_mask(logits, labels))


def targeted_log_odds(logits: Tensor, images: Tensor, target: Labels) -> Tensor:
    """Return log(p / (1 - p)), (N,), with p the total probability of T."""
    return _compute_log_odds(logits, make_class_mask(logits, target, "target"))


def cross_entropy(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """Return minus the logarithm of the probability of the right labels, (N,) in nats.

    Let p be the probability of the right labels, and l the `log_odds` of a wrong
    prediction, log((1 - p) / p). The value is -log p = softplus(l). This form does not
    overflow for logits of thousands, and keeps its digits where p is near 1.

    Its slope in l is 1 - p, which rounds to 0 where the model is sure (l very
    negative). So for l below `MAX_LOG_ODDS` the softplus is continued by its tangent at
    this point, which has the slope 3e-7 and gets slightly under 0. That is enough for
    policies that normalize their steps; `log_odds` has slope 1 everywhere.
    """
    return _softplus(log_odds(logits, images, labels))


def targeted_cross_entropy(logits: Tensor, images: Tensor, target: Labels) -> Tensor:
    """Return log p, (N,) in nats, with p the total probability of T.

    It is 0 at best. Where p is near 1 it is replaced by a tangent, as in
    `cross_entropy`.
    """
    return -_softplus(-targeted_log_odds(logits, images, target))


def dlr(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """Return the difference of logits ratio, (N,), of Croce and Hein 2020.

    It is `margin` divided by a distance between logits, so that scale and offset of the
    logits cancel. Let s be the largest right logit, w the largest wrong one, and p_1 >=
    p_2 >= ... the sorted list of s and all wrong logits. The value is

        (w - s) / (p_1 - p_3)              where the model is right (w <= s); -1 to 0;
        (w - s) / (p_1 - (p_3 + p_4) / 2)  where it is wrong; over 0.

    The first line is the ratio of Croce and Hein 2020 (Auto-PGD), section 4. The second
    has the denominator of their targeted form, because a search goes on after its first
    success. With the first denominator, the ratio would be constant (1) wherever s is
    p_3 and w is p_1, so that it would have no gradient. Three more things differ from
    theirs:

    - Of several right labels only the one with the largest logit is in the list:
      otherwise three of them at the top would give a denominator of zero.
    - If there is no fourth logit, p_2 replaces p_4.
    - `RELIEF` times the distance from the largest to the smallest logit is added to a
      denominator, so that it is never zero and the value never exceeds 1 / `RELIEF`. If
      all logits are the same, the denominator is 1.

    The value does not measure confidence, as the scale cancels: if p_2 = p_3 behind a
    right prediction, it is -1, however sure the model is.

    Raises:
        InputError: fewer than two wrong classes. Two logits without scale and offset
            only have an order.
    """
    is_right_label = make_class_mask(logits, labels)
    top_logits, spread = _sort_logits(logits, is_right_label, "label")
    difference = margin(logits, images, labels)  # w - s
    gap_if_right = top_logits[:, 0] - top_logits[:, 2]  # p_1 - p_3
    gap_if_wrong = _compute_wide_gap(top_logits)  # p_1 - (p_3 + p_4) / 2
    is_wrong = difference > 0.0
    gap = torch.where(is_wrong, gap_if_wrong, gap_if_right)
    return difference / _bound_denominator(gap, spread)


def targeted_dlr(logits: Tensor, images: Tensor, target: Labels) -> Tensor:
    """Return the difference of logits ratio towards a target T, (N,).

    It is `targeted_margin` over p_1 - (p_3 + p_4) / 2, with p the sorted list of the
    largest logit in T and all logits not in T. This is the targeted ratio of Croce and
    Hein 2020, section 4, with another numerator. Theirs is z_t - z_y with the right
    label y, which is over 0 also where a third class wins. All else is as in `dlr`.
    """
    in_target = make_class_mask(logits, target, "target")
    # `spread` is the distance from the largest to the smallest logit
    top_logits, spread = _sort_logits(logits, in_target, "target")
    gap = _compute_wide_gap(top_logits)  # p_1 - (p_3 + p_4) / 2
    return targeted_margin(logits, images, target) / _bound_denominator(gap, spread)


def _compute_log_odds(logits: Tensor, group: Tensor) -> Tensor:
    """Return the log-odds (N,) of a prediction in a group of classes (C,) bool."""
    group_logit = logits.masked_fill(~group, -math.inf).logsumexp(dim=1)
    return group_logit - logits.masked_fill(group, -math.inf).logsumexp(dim=1)


def _softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)), continued by its tangent below `MAX_LOG_ODDS`."""
    value = math.log1p(math.exp(MAX_LOG_ODDS))
    slope = 1.0 / (1.0 + math.exp(-MAX_LOG_ODDS))
    return torch.where(
        x < MAX_LOG_ODDS, value + slope * (x - MAX_LOG_ODDS), functional.softplus(x)
    )


def _sort_logits(logits: Tensor, group: Tensor, setting: str) -> tuple[Tensor, Tensor]:
    """Return the largest logits, after a group of classes was merged into one.

    The logit of the merged class is the largest of the group. All other classes keep
    theirs.

    Args:
        logits: (N, C).
        group: (C,) bool, which classes are merged.
        setting: name of the setting that gave the group, "label" or "target", for
            messages.

    Returns:
        The 4 largest logits in descending order, (N, 4), or (N, 3) if there are only 3;
        and the difference (N,) of the largest and the smallest logit.

    Raises:
        InputError: there are fewer than two other classes.
    """
    _check_other_classes(group, setting)
    merged_logit = compute_largest_logit(logits, group)[:, None]
    all_logits = torch.cat([merged_logit, logits[:, ~group]], dim=1)
    top_logits = all_logits.topk(min(4, all_logits.shape[1]), dim=1).values
    spread = top_logits[:, 0] - all_logits.amin(dim=1)
    return top_logits, spread


def _check_other_classes(group: Tensor, setting: str) -> None:
    """Raise InputError if fewer than two classes are outside of a group (C,) bool."""
    n_merged = int(group.sum())
    n_other = int((~group).sum())
    if n_other < 2:
        raise InputError(
            f"`objective` dlr: expected at least 2 classes beside the {n_merged} of "
            f"`{setting}`, got {n_other}; "
            "its ratio needs a third logit: use `objective=margin`"
        )


def _compute_wide_gap(top_logits: Tensor) -> Tensor:
    """Return the denominator of the targeted ratio, (N,), from `_sort_logits`.

    It is p_1 - (p_3 + p_4) / 2, or p_1 - (p_2 + p_3) / 2 if there are only three.
    """
    return top_logits[:, 0] - top_logits[:, -2:].mean(dim=1)


def _bound_denominator(denominator: Tensor, spread: Tensor) -> Tensor:
    """Return a denominator over 0, which is 1 if all logits are equal.

    Args:
        denominator: (N,) differences of logits, at least 0.
        spread: (N,) difference of the largest and the smallest logit.
    """
    return torch.where(
        spread > SAME, denominator + RELIEF * spread, torch.ones_like(spread)
    )


# Below this fraction of the clean features' length, a distance is rounded off, so that
# it has a gradient at 0.
NEARBY = 1e-3

ReadFeatures = Callable[[Tensor], Tensor]
"""A function from images (N, H, W, 3), display-referred sRGB in [0, 1], to features (N,
F), for example what `advsearch.models.features.features_of` returns."""


def feature_distance(
    features: ReadFeatures, clean: Tensor
) -> Callable[[Tensor, Tensor, tuple[int, ...]], Tensor]:
    """Make the objective of how far an image's features are from the clean image's.

    The distance is a multiple of the length of the clean features. With f0 the clean
    features, e = (f - f0) / |f0|, r a fixed unit vector and h = `NEARBY`, the value is

        sqrt(|e + h r|^2 + h^2) - sqrt(2) h.

    This differs from |e| by at most 3 h, is exactly 0 at e = 0, and has a finite
    gradient everywhere. Every search starts at the clean image, where |e| has no
    gradient, and |e|^2 or a smoothed |e| has a gradient of zero, so that a search
    without noise would never move. With r the gradient there is r / (sqrt(2) |f0|), as
    strong as that of a distance; beyond a few h it is that of |e|. The direction of r
    (from a fixed seed) does not matter: every direction leads away, and after the first
    step the distance itself shows which leads away fastest.

    The idea is that of Sabour et al. 2016, who move the features of an image towards
    those of another one; here they move away.

    No label is used: the objective leads to no class in particular, and success is
    decided by the prediction, as with all objectives. If f0 is zero, its length counts
    as 1.

    Args:
        features: differentiable function from images to features (N, F).
        clean: (H, W, 3) or (N, H, W, 3): the clean image, or several renders of it,
            whose features are averaged. It should have little noise, as the noise of
            the renders adds to the distance.

    Returns:
        An objective (logits, images, labels) -> (N,), at least 0 but for h, that looks
        at the images only.

    Raises:
        InputError: features are not (N, F), or not finite.
    """
    reference = _compute_reference(features, clean)
    length = torch.linalg.vector_norm(reference)
    scale = torch.where(length > 0.0, length, torch.ones_like(length))
    start_offset = _make_start_offset(reference)

    def objective(logits: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        displacement = (features(images) - reference) / scale + start_offset  # e + h r
        squared = displacement.square().sum(dim=1) + NEARBY**2
        distance: Tensor = squared.sqrt() - math.sqrt(2.0) * NEARBY
        return distance

    objective.__name__ = objective.__qualname__ = "feature_distance"
    return objective


def cosine_distance(
    features: ReadFeatures, clean: Tensor
) -> Callable[[Tensor, Tensor, tuple[int, ...]], Tensor]:
    """Make the objective of one minus the cosine with the clean image's features.

    It is 0 for equal directions and 2 for opposite ones. With both features scaled to
    length 1 and e their difference, it is |e|^2 / 2. Its gradient is zero at the clean
    image, where every search starts. So h e . r is added, with a fixed unit vector r
    and the small number h = `NEARBY`. At the clean image the gradient points along r.
    Where |e| is more than a few h, the added gradient is negligible.

    Args:
        features: function from images to features (N, F); called once, for the clean
            image.
        clean: (H, W, 3) or (N, H, W, 3): the clean image, or several renders of it,
            whose features are averaged.

    Returns:
        An objective (features (N, F), images, labels) -> (N,) that uses the features
        only. Its minimum is at least -h^2 / 2, as |e|^2 / 2 + h e . r is.
    """
    reference = functional.normalize(_compute_reference(features, clean), dim=0)
    start_offset = _make_start_offset(reference)

    def objective(output: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        displacement = functional.normalize(output, dim=1) - reference.to(output)
        squared_length = displacement.square().sum(dim=1)
        along_start = displacement @ start_offset.to(output)  # h e . r
        distance: Tensor = squared_length / 2.0 + along_start
        return distance

    return objective


def _make_start_offset(reference: Tensor) -> Tensor:
    """Return h r: a fixed vector (F,) of length h = `NEARBY`."""
    direction = torch.randn(
        reference.shape, generator=torch.Generator().manual_seed(0)
    ).to(reference)
    return direction * (NEARBY / float(torch.linalg.vector_norm(direction)))


def _compute_reference(features: ReadFeatures, clean: Tensor) -> Tensor:
    """Return the mean features (F,) of the clean image, or of several renders of it."""
    with torch.no_grad():
        reference = features(clean if clean.dim() == 4 else clean[None])
    _check_features(reference)
    return reference.mean(dim=0)


def _check_features(features: Tensor) -> None:
    """Raise InputError if features are not (N, F), or not finite."""
    if features.dim() != 2:
        raise InputError(
            f"objective: expected features of shape (N, F), got {tuple(features.shape)}"
        )
    if not bool(torch.isfinite(features).all()):
        raise InputError(
            "objective: expected finite features of the clean picture, got NaN or "
            "infinity; check that the model predicts it"
        )
