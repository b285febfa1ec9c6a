"""Objectives of features: how far a picture has moved from the clean one in the eyes of the network."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from advsearch.errors import InputError

NEARBY = 1e-3
"""Distances under this fraction of the clean features' length count as none: the distance is rounded off there."""

ReadFeatures = Callable[[Tensor], Tensor]
"""From images (N, H, W, 3), display-referred sRGB in [0, 1], to features (N, F): what
`advsearch.models.features.features_of` returns, say."""


def feature_distance(features: ReadFeatures, clean: Tensor) -> Callable[[Tensor, Tensor, tuple[int, ...]], Tensor]:
    """How far the features of the picture lie from those of the clean one, in lengths of the clean ones.

    With f0 the features of the clean picture, e = (f - f0) / |f0|, r a fixed unit vector and h = `NEARBY`,

        sqrt(|e + h r|^2 + h^2) - sqrt(2) h,

    which is |e| to within 3 h, exactly 0 at e = 0, and has a finite gradient everywhere. The plain |e| has none at the
    clean picture, where every search starts, and |e|^2 and a smoothed |e| have their minimum there: a gradient of zero,
    which a search without noise would never leave. Hence r: at the clean picture the gradient is r / (sqrt(2) |f0|), at
    the full strength of a distance, and beyond a few h it is that of |e|. The direction of r (drawn once, from a fixed
    seed) does not matter: every direction leads away, and after the first step the distance itself shows which leads
    away fastest. With a noisy renderer the noise does the same.

    The idea is that of Sabour et al. 2016, who lead a picture's features to those of another one; here they lead away.

    It looks at no label: it needs no right answer, leads to no class in particular, and what counts as success is
    checked by the answer as ever. Where f0 is zero its length counts as 1.

    Args:
        features: differentiable; called once here, and once more per evaluation, which costs one more run of the
            network.
        clean: (H, W, 3) or (N, H, W, 3): the clean picture, or several renders of it, whose features are averaged.
            Take as little noise as you can afford: noise of the search's own renders is a distance as well.

    Returns:
        An objective (logits, images, labels) -> (N,), at least 0 but for h, that looks at the images only.

    Raises:
        InputError: the features are not (N, F), or not finite.
    """
    reference = _reference(features, clean)
    length = torch.linalg.vector_norm(reference)
    scale = torch.where(length > 0.0, length, torch.ones_like(length))
    away = _away(reference)

    def objective(logits: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        moved = (features(images) - reference) / scale + away
        squared = moved.square().sum(dim=1) + NEARBY**2
        distance: Tensor = squared.sqrt() - math.sqrt(2.0) * NEARBY
        return distance

    objective.__name__ = objective.__qualname__ = "feature_distance"
    return objective


def cosine_distance(features: ReadFeatures, clean: Tensor) -> Callable[[Tensor, Tensor, tuple[int, ...]], Tensor]:
    """One minus the cosine of the features and those of the clean picture: from 0 where they are the same to 2.

    That is |e|^2 / 2 for e the difference of both at length 1. Its gradient is zero at the clean picture, where every
    search starts, so `h` e . r is added, with r and `h` as in `feature_distance`: at the clean picture the gradient
    leads along r, and beyond a few `h` it is that of the distance.

    Args:
        features: of the clean picture; called once, here.
        clean: as for `feature_distance`.

    Returns:
        An objective (features (N, F), images, labels) -> (N,), at least 0 but for `h`^2, that looks at the features
        only, whatever their length.

    Raises:
        InputError: as for `feature_distance`.
    """
    reference = functional.normalize(_reference(features, clean), dim=0)
    away = _away(reference)

    def objective(output: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        moved = functional.normalize(output, dim=1) - reference.to(output)
        distance: Tensor = moved.square().sum(dim=1) / 2.0 + moved @ away.to(output)
        return distance

    return objective


def _away(reference: Tensor) -> Tensor:
    """Return a fixed direction (F,) of length `NEARBY`."""
    away = torch.randn(reference.shape, generator=torch.Generator().manual_seed(0)).to(reference)
    return away * (NEARBY / float(torch.linalg.vector_norm(away)))


def _reference(features: ReadFeatures, clean: Tensor) -> Tensor:
    """Return the mean features (F,) of the clean pictures."""
    with torch.no_grad():
        found = features(clean if clean.dim() == 4 else clean[None])
    if found.dim() != 2:
        raise InputError(f"objective: expected features of shape (N, F), got {tuple(found.shape)}")
    if not bool(torch.isfinite(found).all()):
        raise InputError(
            "objective: expected finite features of the clean picture, got NaN or infinity; check that the "
            "model answers it"
        )
    return found.mean(dim=0)
