"""The rule by which predicted pictures take the place of rendered ones, and how often it is wrong."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.engine.acceptance import MIN_ALLOWED_LEVELS, N_VIEWS, ComparedView, compare_views, compare_with_traced

SEARCHES = 400


def accepted(share: float, bias: float = 0.0, deviation: float = 0.2) -> float:
    """How many of the searches are predicted whose predictions are off by a share of what is allowed, over views whose
    squared errors are log-normal, and whose margins are off by a bias and a deviation."""
    random, sigma = np.random.default_rng(0), math.sqrt(math.log(1.0 + 0.8**2))
    good = 0
    for normal in random.normal(size=(SEARCHES, 2, N_VIEWS)):
        squares, margins = share**2 * np.exp(sigma * normal[0] - sigma**2 / 2.0), bias + deviation * normal[1]
        good += compare_views(lambda n, s=squares, m=margins: ComparedView(9.0 * s[n], 9.0, m[n], 3)).is_accepted  # type: ignore[misc]
    return good / SEARCHES


@pytest.mark.parametrize(
    ("share", "bias", "least", "most"),
    [
        (0.5, 0.0, 0.97, 1.0), (1.25, 0.0, 0.0, 0.06), (0.5, 0.5, 0.0, 0.05), (0.5, -0.5, 0.0, 0.05),
    ],
)  # fmt: skip
def test_right_predictions_are_accepted_and_wrong_ones_seldom(
    share: float, bias: float, least: float, most: float
) -> None:
    assert least <= accepted(share, bias) <= most


def test_what_the_search_moved_allows_as_small_a_part_of_it() -> None:
    assert compare_views(lambda number: ComparedView(1.0, 9.0, 1.0, 3, margin_change=30.0)).is_accepted
    assert not compare_views(lambda number: ComparedView(1.0, 9.0, 1.0, 3, margin_change=10.0)).is_accepted


class Tracer:
    """A renderer of a grey picture with a small object in it: 36 of 4,096 pixels."""

    def __init__(self, noise: float = 0.02) -> None:
        self.picture, self.noise = torch.full((64, 64, 3), 0.5), noise
        self.seen = torch.zeros(64, 64, dtype=torch.bool)
        self.seen[30:36, 30:36] = True

    def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
        return self.noisy(seed)

    def noisy(self, seed: int) -> Tensor:
        return self.picture + self.noise * torch.randn(64, 64, 3, generator=torch.Generator().manual_seed(seed % 2**31))

    def render_independent_images(self, u: Tensor, seed: int, spp: int) -> tuple[Tensor, Tensor, Tensor]:
        return self.noisy(seed + 1), self.noisy(seed + 2), self.picture

    def compute_object_mask(self, u: Tensor) -> Tensor:
        return self.seen


def of_model(picture: Tensor, u: Tensor) -> float:
    return 0.0


def seen(change: Callable[[Tracer, Tensor], Tensor], margin: Callable[[Tensor, Tensor], float] = of_model) -> Any:
    """The comparison of a picture that is changed."""
    tracer: Any = Tracer()
    predicted = change(tracer, tracer.picture.clone())
    return compare_views(
        lambda number: compare_with_traced(tracer, predicted, torch.zeros(1), 10 * number, 8, margin)
    ), predicted


def brighter(tracer: Tracer, picture: Tensor) -> Tensor:
    picture[tracer.seen] *= 1.25
    return picture


def test_a_small_object_that_is_too_bright_is_refused() -> None:
    """Over the whole picture it would be less than two levels off."""
    found, predicted = seen(brighter)
    whole = 255.0 * float((predicted - Tracer().picture).square().mean().sqrt())
    assert whole < 3.0 and found.levels > 25.0 and not found.is_accepted
    assert "levels of 255 off on the object" in found.reason
    right, _ = seen(lambda tracer, picture: picture)
    assert right.is_accepted and right.levels < MIN_ALLOWED_LEVELS


def test_a_bias_of_the_margin_is_refused_where_the_picture_is_near_enough() -> None:
    def model(picture: Tensor, u: Tensor) -> float:
        return 100.0 * float(picture[..., 0].mean())

    found, _ = seen(lambda tracer, picture: picture + 0.005, model)
    assert found.levels < MIN_ALLOWED_LEVELS
    assert found.margin_bias == pytest.approx(0.5, abs=1e-3) and not found.is_accepted
    assert found.reason == "+0.50 off in the margin, where 0.30 would do"
