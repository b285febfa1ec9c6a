"""Whether predicted images may take the place of rendered ones: the one rule for
matrices and for light on surfaces.

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

# mean difference of the margin over the views, with its sign, that is accepted (of a
# classifier: logits)
MARGIN = 0.3
OF_MOVED = 0.05
"""The same as a share of what the search has moved the margin, where that is more: so
much is the length of a step that is predicted, and not its direction.
"""
# levels of 255, root mean square over the object, that will do where a rendered picture
# has less noise
BOUND = 2.0
# share of the levels that is accepted in the end, so that one beyond the limit seldom
# is by chance
ACCEPTED = 0.9
CHECK_SPP = 16  # samples a pixel of each of the two traced pictures of a view


@dataclass(frozen=True)
class ComparedView:
    """A predicted picture beside traced ones: mean squares over the object, levels of
    255, of what it is off and of what a rendered one is (below 0 by chance where both
    are small); by how much its margin is larger; the pictures that were traced; and by
    how much the search has moved the margin of what is predicted.
    """

    square: float
    allowed: float
    margin: float
    pictures: int
    moved: float = 0.0


@dataclass(frozen=True)
class Deviation:
    """How far predictions are off, over several views: the root mean square over the
    object in levels of 255, the mean difference of the margin, and the levels that are
    allowed; so many pictures were traced to find it; and the difference of the margin
    that is allowed.
    """

    levels: float
    logits: float
    most: float
    pictures: int
    margin: float = MARGIN

    @classmethod
    def of(cls, views: Sequence[ComparedView]) -> Deviation:
        square, allowed, logits, moved = (
            statistics.fmean(getattr(view, name) for view in views)
            for name in ("square", "allowed", "margin", "moved")
        )
        pictures = sum(view.pictures for view in views)
        return cls(
            _root(square),
            logits,
            max(BOUND, _root(allowed)),
            pictures,
            max(MARGIN, OF_MOVED * moved),
        )

    @property
    def share(self) -> float:
        """Of the levels that are allowed."""
        return self.levels / self.most if self.most > 0.0 else math.inf

    @property
    def good(self) -> bool:
        """Whether predictions may take the place of rendered pictures; never where
        something is NaN.
        """
        return self.share <= ACCEPTED and abs(self.logits) <= self.margin

    @property
    def reason(self) -> str:
        if not self.share <= ACCEPTED:
            return (
                f"{self.levels:.1f} levels of 255 off on the object, where "
                f"{ACCEPTED * self.most:.1f} would do"
            )
        return f"{self.logits:+.2f} off in the margin, where {self.margin:.2f} would do"


def compared(view: Callable[[int], ComparedView]) -> Deviation:
    """Compare predictions, in few views where these decide; `view` compares one, by its
    number below `VIEWS`.
    """
    views = [view(number) for number in range(FIRST)]
    first = Deviation.of(views)
    clearly = (
        first.share <= CLEARLY_GOOD and abs(first.logits) <= CLEARLY_GOOD * first.margin
    )
    if not clearly and first.share < CLEARLY_BAD:
        views += [view(number) for number in range(FIRST, VIEWS)]
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
    """Compare a predicted picture (H, W, 3) of a configuration u (d,) of the whole
    space with traced ones. The search renders with `spp` samples a pixel; `before` was
    predicted in its place before the search, if anything was.
    """
    with torch.no_grad():
        rendered = renderer(u, seeds.stream(seed, "rendered"), spp)
        *halves, clean = renderer.halves(u, seed, CHECK_SPP)
        seen = renderer.mask(u)
    square, allowed = (
        squares_off(picture, halves, seen) for picture in (predicted, rendered)
    )
    here = margin(predicted, u)
    moved = 0.0 if before is None else abs(here - margin(before, u))
    return ComparedView(
        square, allowed, here - margin(clean, u), pictures=3, moved=moved
    )


def squares_off(
    picture: Tensor, halves: Sequence[Tensor], seen: Tensor | None = None
) -> float:
    """Return the mean squared difference, levels of 255, of a picture (H, W, 3) from
    what two traced ones of independent noise converge to, over the pixels that are
    seen, (H, W), or all where there are none.

    These are traced without the denoiser, which leaves its own marks in all that it is
    given. The mean product of the differences to both is the squared error without
    their noise, which a square would count.
    """
    first, second = halves
    products = (picture - first) * (picture - second)
    return 255.0**2 * float(
        (products if seen is None or not bool(seen.any()) else products[seen]).mean()
    )


def levels_off(
    renderer: Renderer, pictures: Sequence[Tensor], u: Tensor, seed: int, spp: int
) -> list[float]:
    """Return how far pictures (H, W, 3) of a configuration are off as a whole, levels
    of 255.
    """
    halves = renderer.halves(u, seed, spp)[:2]
    return [_root(squares_off(picture, halves)) for picture in pictures]


def _root(square: float) -> float:
    """NaN stays NaN."""
    return 0.0 if square <= 0.0 else math.sqrt(square)


FIRST = 2  # views that are compared at first, and in all where these don't decide
VIEWS = 6
# shares of what is allowed up to which, and from which on, the first views decide
CLEARLY_GOOD = 0.7
CLEARLY_BAD = 1.4
MarginOf = Callable[[Tensor, Tensor], float]
"""The margin of what a model says of a picture (H, W, 3) of a configuration (d,)."""
