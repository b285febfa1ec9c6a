"""Decide whether predicted images may replace rendered ones.

The rule is the same for matrices and for light on surfaces.

A few views are traced beside predicted ones (docs/surface-light.md, "How far off
predictions may be"). Noise averages out over a search, and bias does not: a search
climbs it. So a prediction may be as noisy as a rendered image, on the object alone,
which may be small. On average over the views it may not move the margin, except for a
small part of what the search has moved it.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.scene.renderer import Renderer

# largest accepted mean difference of the margin over the views (of a classifier: logits)
MARGIN = 0.3
OF_MOVED = 0.05
"""The same as a fraction of what the search has moved the margin, where that is larger.

So much affects the length of a step that is predicted, and not its direction.
"""
# accepted root mean square over the object, in levels of 255, where a rendered image
# has less noise
BOUND = 2.0
# fraction of the allowed levels that is accepted, so that a prediction beyond the limit
# seldom passes by chance
ACCEPTED = 0.9
CHECK_SPP = 16  # samples per pixel of each of the two traced images of a view


@dataclass(frozen=True)
class ComparedView:
    """A predicted image compared with traced ones.

    Attributes:
        square: mean squared error over the object, in levels of 255 squared; below 0
            by chance where it is small.
        allowed: the same of a rendered image.
        margin: by how much its margin is larger than the traced one.
        pictures: images that were traced.
        moved: by how much the search has moved the margin of predicted images.
    """

    square: float
    allowed: float
    margin: float
    pictures: int
    moved: float = 0.0


@dataclass(frozen=True)
class Deviation:
    """How far predictions are off, over several views.

    Attributes:
        levels: root mean square over the object, in levels of 255.
        logits: mean difference of the margin.
        most: levels that are allowed.
        pictures: images that were traced to measure it.
        margin: difference of the margin that is allowed.
    """

    levels: float
    logits: float
    most: float
    pictures: int
    margin: float = MARGIN

    @classmethod
    def of(cls, views: Sequence[ComparedView]) -> Deviation:
        """Return the deviation over several views."""
        square = statistics.fmean(view.square for view in views)
        allowed = statistics.fmean(view.allowed for view in views)
        logits = statistics.fmean(view.margin for view in views)
        moved = statistics.fmean(view.moved for view in views)
        return cls(
            levels=_root(square),
            logits=logits,
            most=max(BOUND, _root(allowed)),
            pictures=sum(view.pictures for view in views),
            margin=max(MARGIN, OF_MOVED * moved),
        )

    @property
    def share(self) -> float:
        """The levels as a fraction of those that are allowed."""
        return self.levels / self.most if self.most > 0.0 else math.inf

    @property
    def good(self) -> bool:
        """Whether predictions may replace rendered images; False if anything is NaN."""
        return self.share <= ACCEPTED and abs(self.logits) <= self.margin

    @property
    def reason(self) -> str:
        """Why predictions may not replace rendered images, for a sentence."""
        if not self.share <= ACCEPTED:
            return (
                f"{self.levels:.1f} levels of 255 off on the object, where "
                f"{ACCEPTED * self.most:.1f} would do"
            )
        return f"{self.logits:+.2f} off in the margin, where {self.margin:.2f} would do"


def compared(view: Callable[[int], ComparedView]) -> Deviation:
    """Compare predictions over several views, in few where these decide.

    `view` compares a single view, by its index below `VIEWS`.
    """
    views = [view(index) for index in range(FIRST)]
    first = Deviation.of(views)
    margin_limit = CLEARLY_GOOD * first.margin
    is_good = first.share <= CLEARLY_GOOD and abs(first.logits) <= margin_limit
    if not is_good and first.share < CLEARLY_BAD:
        views += [view(index) for index in range(FIRST, VIEWS)]
    return Deviation.of(views)


def view_of(
    renderer: Renderer,
    predicted: Tensor,
    u: Tensor,
    seed: int,
    spp: int,
    margin: MarginOf,
    before: Tensor | None = None,
) -> ComparedView:
    """Compare a predicted image with traced images of the same configuration.

    Args:
        renderer: traces images.
        predicted: (H, W, 3) image.
        u: (d,) full configuration.
        seed: of the noise of the traced images.
        spp: samples per pixel of the search.
        margin: from an image and a configuration to the model's margin.
        before: (H, W, 3) image that was predicted in its place before the search, if
            there was one.
    """
    with torch.no_grad():
        rendered = renderer(u, seeds.stream(seed, "rendered"), spp)
        *halves, converged = renderer.halves(u, seed, CHECK_SPP)
        object_mask = renderer.mask(u)
    predicted_margin = margin(predicted, u)
    moved = 0.0
    if before is not None:
        moved = abs(predicted_margin - margin(before, u))
    return ComparedView(
        square=squares_off(predicted, halves, object_mask),
        allowed=squares_off(rendered, halves, object_mask),
        margin=predicted_margin - margin(converged, u),
        pictures=3,
        moved=moved,
    )


def squares_off(
    picture: Tensor, halves: Sequence[Tensor], seen: Tensor | None = None
) -> float:
    """Return the mean squared error of an image without the noise of its reference.

    The mean product of the differences to two traced images of independent noise is the
    squared error without their noise, which a square would count. They are traced
    without the denoiser, which leaves marks of its own in every image.

    Args:
        picture: (H, W, 3) image.
        halves: two traced images (H, W, 3).
        seen: (H, W) mask of the pixels that count; all do if None, or if it is empty.

    Returns:
        The error in levels of 255, squared.
    """
    first, second = halves
    products = (picture - first) * (picture - second)
    if seen is not None and bool(seen.any()):
        products = products[seen]
    return 255.0**2 * float(products.mean())


def levels_off(
    renderer: Renderer, pictures: Sequence[Tensor], u: Tensor, seed: int, spp: int
) -> list[float]:
    """Return the root-mean-square error of full images (H, W, 3), in levels of 255.

    All are of the configuration u (d,).
    """
    halves = renderer.halves(u, seed, spp)[:2]
    return [_root(squares_off(picture, halves)) for picture in pictures]


def _root(square: float) -> float:
    """Return the square root, or 0 of a negative number; NaN stays NaN."""
    return 0.0 if square <= 0.0 else math.sqrt(square)


FIRST = 2  # views that are compared at first
VIEWS = 6  # views that are compared where the first do not decide
# fractions of what is allowed up to which, and from which on, the first views decide
CLEARLY_GOOD = 0.7
CLEARLY_BAD = 1.4
MarginOf = Callable[[Tensor, Tensor], float]
"""The margin of what a model says of a picture (H, W, 3) of a configuration (d,)."""
