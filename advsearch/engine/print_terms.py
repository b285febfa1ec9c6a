"""What `printable` takes from the objective of a search: how rough the colours to be printed are, and how far from ink.

Sharif et al. 2016, *Accessorize to a Crime*, sections 5.2.2 (total variation) and 5.2.3 (the non-printability score).
Theirs are sums over pixels; these are means, so that a weight means the same at every resolution. Their score is a
product of distances to all printable colours; here it is the distance to the nearest, which is zero at the same
colours. Both depend on u alone, so that they hold for rendered and for predicted pictures.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.attacks import Evaluation
from advsearch.controls import Space
from advsearch.errors import InputError
from advsearch.runs.results.attack import PrintTerms

LOW, HIGH, STEP = 0.1, 0.9, 0.2
"""The printable colours: all 125 of which each channel is 0.1, 0.3, 0.5, 0.7 or 0.9 in sRGB. No printer was measured:
that ink on paper reaches neither the black, nor the white, nor the pure colours of a screen is all that they say."""
WEIGHT = 10.0
"""Of either term, in the objective's unit (logits for a margin) per unit of sRGB."""


LEAST = 2.0**-40
"""Shortest step in sRGB that has a gradient."""


def variation(colors: Tensor) -> Tensor:
    """Return the mean length of the step from a pixel (h, w, 3) to its right and lower neighbours, by channel; of a
    picture (h, w, 4) only between pixels that its last channel has."""
    colors, there = colors[..., :3], colors[..., 3:]
    right, down = colors.diff(dim=1), colors.diff(dim=0)
    if there.shape[-1]:
        right, down = right * there[:, 1:], down * there[1:]
    squared = F.pad(right.square(), (0, 0, 0, 1)) + F.pad(down.square(), (0, 0, 0, 0, 0, 1))
    length = squared.clamp(min=LEAST**2).sqrt() - LEAST
    return length[there[..., 0] > 0.0].mean() if there.shape[-1] else length.mean()


def off_print(colors: Tensor, palette: Tensor | None = None) -> Tensor:
    """Return the mean Euclidean distance in sRGB of pixels (h, w, 3) from the nearest printable colour, of a palette
    (P, 3) where one is given; of a picture (h, w, 4) of those that its last channel has."""
    colors = colors if colors.shape[-1] == 3 else colors[colors[..., 3] > 0][:, None, :3]
    if palette is None:
        nearest = (LOW + STEP * ((colors.detach() - LOW) / STEP).round()).clamp(LOW, HIGH)
    else:
        palette = palette.to(colors)
        nearest = palette[torch.cdist(colors.detach().reshape(-1, 3), palette).argmin(dim=1)].reshape(colors.shape)
    distance: Tensor = torch.linalg.vector_norm(colors - nearest, dim=2).mean()
    return distance


def _terms(space: Space, u: Tensor) -> tuple[Tensor, Tensor]:
    """Both terms, summed over what is to be printed."""
    found = list(space.printed(u).values())
    if not found:
        raise InputError(
            "printable: expected a search over the colours of a texture or a patch, got "
            f"{', '.join(control.name for control in space.controls)}; add `texture` or `patch`, or leave it out"
        )
    return torch.stack([variation(one) for one in found]).sum(), torch.stack([off_print(one) for one in found]).sum()


def print_terms(space: Space, u: Tensor) -> PrintTerms:
    """Return both terms of a configuration (d,), without their weight.

    Raises:
        InputError: nothing that can be printed is searched.
    """
    with torch.no_grad():
        rough, off = _terms(space, u)
    return PrintTerms(variation=float(rough), off_print=float(off))


def penalised(found: Evaluation, space: Space, u: Tensor) -> Evaluation:
    """Return an evaluation of u whose objective is less by both weighted terms, and its derivative by theirs."""
    at = u.detach().clone().requires_grad_()
    with torch.enable_grad():
        penalty = WEIGHT * torch.stack(_terms(space, at)).sum()
        (slope,) = torch.autograd.grad(penalty, at)
    derivative = None if found.gradient is None else found.gradient - slope
    return replace(found, objective=found.objective - float(penalty.detach()), gradient=derivative)
