"""An objective of features: how far a picture has moved from the clean one in the eyes of the network."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

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
    away = torch.randn(reference.shape, generator=torch.Generator().manual_seed(0)).to(reference)
    away = NEARBY * away / torch.linalg.vector_norm(away)

    def objective(logits: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        moved = (features(images) - reference) / scale + away
        squared = moved.square().sum(dim=1) + NEARBY**2
        distance: Tensor = squared.sqrt() - math.sqrt(2.0) * NEARBY
        return distance

    objective.__name__ = objective.__qualname__ = "feature_distance"
    return objective


def _reference(features: ReadFeatures, clean: Tensor) -> Tensor:
    """Return the mean features (F,) of the clean pictures."""
    with torch.no_grad():
        found = features(clean if clean.dim() == 4 else clean[None])
    if found.dim() != 2:
        raise InputError(f"feature_distance: expected features of shape (N, F), got {tuple(found.shape)}")
    if not bool(torch.isfinite(found).all()):
        raise InputError(
            "feature_distance: expected finite features of the clean picture, got NaN or infinity; check that the "
            "model answers it"
        )
    return found.mean(dim=0)
