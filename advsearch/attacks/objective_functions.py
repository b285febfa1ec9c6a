"""Objectives as pure functions: of logits margin, log-odds, cross-entropy and DLR; of
features two distances.

Each of logits comes in two forms over label sets, both to be *maximised*:

- plain, `f(logits, images, labels)`: away from the label set Y of right labels;
- targeted, `targeted_f(logits, images, target)`: towards a target T, which is a label
set as well.

Arguments are logits (N, C), images (N, H, W, 3), which none of these look at, and class
indices. Values are (N,), of the dtype of the logits, and differentiable. At logits of
ten thousand, at ties and at probabilities that round to 0 or 1 the gradient is finite,
and it is not lost. InputError: logits that are not (N, C), indices that the model does
not have, a label set of all classes.
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
"""Log-odds below which cross-entropy is continued by its tangent. In float32 its own
slope, exp(log-odds), would be lost at -103 and count for nothing beside other numbers
long before.
"""

# added to a denominator of `dlr`, as a fraction of the distance from the largest to the
# smallest logit
RELIEF = 1e-4
SAME = 1e-12  # logits that lie closer together than this are all the same to `dlr`


def margin(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """Return the largest wrong logit minus the largest right one, (N,): over 0 exactly
    where the model is wrong.

    max over j not in Y of z_j, minus max over y in Y of z_y. In logits (log-odds),
    unbounded, and with a gradient of one at every confidence (Carlini and Wagner 2017,
    f_6 without its hinge). Ties share the gradient.
    """
    return compute_misclassification_margin(logits, labels)


def targeted_margin(logits: Tensor, images: Tensor, target: Labels) -> Tensor:
    """max over t in T of z_t, minus max over j not in T of z_j: over 0 exactly where
    the prediction is in T.
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
    """log(p / (1 - p)) with p the total probability of T."""
    return _compute_log_odds(logits, make_class_mask(logits, target, "target"))


def cross_entropy(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """Return minus the logarithm of the probability of the right labels, (N,) in nats.

    It is computed as -log p = softplus(l), with l the `log_odds`. This form does not
    overflow for logits of thousands and keeps its digits where p is near 1. Its slope
    in l is 1 - p, which rounds to 0 where the model is sure. So below l =
    `MAX_LOG_ODDS`, where the value is 3e-7, it is continued by its tangent: the slope
    stays 3e-7, and values get slightly under 0. That is enough for policies that
    normalise their steps; `log_odds` has slope 1 everywhere.
    """
    return _softplus(log_odds(logits, images, labels))


def targeted_cross_entropy(logits: Tensor, images: Tensor, target: Labels) -> Tensor:
    """log p with p the total probability of T, in nats: 0 at best, continued as
    `cross_entropy` is.
    """
    return -_softplus(-targeted_log_odds(logits, images, target))


def dlr(logits: Tensor, images: Tensor, labels: Labels) -> Tensor:
    """Return the difference of logits ratio, (N,), of Croce and Hein 2020.

    It is `margin` divided by a distance between logits, so that scale and offset of the
    logits cancel. Let s be the largest right logit, w the largest wrong one, and p_1 >=
    p_2 >= ... the sorted list of s and all wrong logits. The value is

        (w - s) / (p_1 - p_3)                 where the model is right (w <= s): from -1 to 0;
        (w - s) / (p_1 - (p_3 + p_4) / 2)     where it is wrong: over 0.

    The first line is the ratio of Croce and Hein 2020 (Auto-PGD), section 4. The second
    has the denominator of their targeted form, because a search goes on after its first
    success: with the first denominator the value would be 1, without a gradient,
    wherever s comes third. Three more things differ from theirs:

    - Of several right labels only the one with the largest logit is in the list:
      otherwise three of them at the top would give a denominator of zero.
    - If there is no fourth logit, p_2 replaces p_4.
    - `RELIEF` times the distance from the largest to the smallest logit is added to a
      denominator, so that it is never zero and the value never exceeds 1 / `RELIEF`. If
      all logits are the same, the denominator is 1.

    The value does not measure confidence, as the scale cancels: if p_2 = p_3 behind a
    right prediction, it is -1, however sure the model is.

    Raises:
        InputError: fewer than two wrong classes. Of two numbers only the order is left
            without scale and offset.
    """
    top_logits, spread = _sort_logits(logits, make_class_mask(logits, labels), "label")
    difference = margin(logits, images, labels)
    narrow_gap = top_logits[:, 0] - top_logits[:, 2]
    wide_gap = _compute_wide_gap(top_logits)
    is_wrong = difference > 0.0
    gap = torch.where(is_wrong, wide_gap, narrow_gap)
    return difference / _add_relief(gap, spread)


def targeted_dlr(logits: Tensor, images: Tensor, target: Labels) -> Tensor:
    """Return the difference of logits ratio towards a target T, (N,).

    It is `targeted_margin` over p_1 - (p_3 + p_4) / 2, with p the sorted list of the
    largest logit in T and all logits not in T. This is the targeted ratio of Croce and
    Hein 2020, section 4, but for the numerator: theirs, z_t - z_y with the right label
    y, is over 0 also where a third class wins. Otherwise as `dlr`.
    """
    in_target = make_class_mask(logits, target, "target")
    top_logits, spread = _sort_logits(logits, in_target, "target")
    gap = _compute_wide_gap(top_logits)
    return targeted_margin(logits, images, target) / _add_relief(gap, spread)


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
    """Return the largest logits, where a group of classes counts as a single class.

    Args:
        logits: (N, C).
        group: (C,) bool, classes of the group; its logit is the largest of theirs.
        setting: name of the setting that gave the group, "label" or "target", for
            messages.

    Returns:
        The 4 largest logits in descending order, (N, 4), or (N, 3) if there are only 3;
        and the distance (N,) from the largest to the smallest of all.

    Raises:
        InputError: there are fewer than two other classes.
    """
    size = int(group.sum())
    others = int((~group).sum())
    if others < 2:
        raise InputError(
            f"`objective` dlr: expected at least 2 classes beside the {size} of "
            f"`{setting}`, got {others}; "
            "its ratio needs a third logit: use `objective=margin`"
        )
    collapsed = torch.cat(
        [compute_largest_logit(logits, group)[:, None], logits[:, ~group]], dim=1
    )
    top = collapsed.topk(min(4, collapsed.shape[1]), dim=1).values
    return top, top[:, 0] - collapsed.amin(dim=1)


def _compute_wide_gap(top: Tensor) -> Tensor:
    """p_1 - (p_3 + p_4) / 2, or p_1 - (p_2 + p_3) / 2 where there are three."""
    return top[:, 0] - top[:, -2:].mean(dim=1)


def _add_relief(denominator: Tensor, spread: Tensor) -> Tensor:
    """Return a denominator that is over 0; 1 where all logits are the same."""
    return torch.where(
        spread > SAME, denominator + RELIEF * spread, torch.ones_like(spread)
    )


# distances under this fraction of the clean features' length count as none: it is
# rounded off there
NEARBY = 1e-3

ReadFeatures = Callable[[Tensor], Tensor]
"""From images (N, H, W, 3), display-referred sRGB in [0, 1], to features (N, F): what
`advsearch.models.features.features_of` returns, say."""


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
    start_direction = _make_start_direction(reference)

    def objective(logits: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        displacement = (features(images) - reference) / scale + start_direction
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
    and h = `NEARBY`: at the clean image the gradient points along r, and beyond a few h
    it is that of the distance.

    Args:
        features: function from images to features (N, F); called once, for the clean
            image.
        clean: (H, W, 3) or (N, H, W, 3): the clean image, or several renders of it,
            whose features are averaged.

    Returns:
        An objective (features (N, F), images, labels) -> (N,) that uses the features
        only; at least -h^2 / 2.
    """
    reference = functional.normalize(_compute_reference(features, clean), dim=0)
    start_direction = _make_start_direction(reference)

    def objective(output: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        displacement = functional.normalize(output, dim=1) - reference.to(output)
        squared_length = displacement.square().sum(dim=1)
        along_start = displacement @ start_direction.to(output)
        distance: Tensor = squared_length / 2.0 + along_start
        return distance

    return objective


def _make_start_direction(reference: Tensor) -> Tensor:
    """Return a fixed direction (F,) of length `NEARBY`."""
    direction = torch.randn(
        reference.shape, generator=torch.Generator().manual_seed(0)
    ).to(reference)
    return direction * (NEARBY / float(torch.linalg.vector_norm(direction)))


def _compute_reference(features: ReadFeatures, clean: Tensor) -> Tensor:
    """Return the mean features (F,) of the clean pictures."""
    with torch.no_grad():
        reference = features(clean if clean.dim() == 4 else clean[None])
    if reference.dim() != 2:
        raise InputError(
            "objective: expected features of shape (N, F), got "
            f"{tuple(reference.shape)}"
        )
    if not bool(torch.isfinite(reference).all()):
        raise InputError(
            "objective: expected finite features of the clean picture, got NaN or "
            "infinity; check that the model predicts it"
        )
    return reference.mean(dim=0)
