"""Decide whether predicted images may replace rendered ones.

The rule is the same for matrices and for light on surfaces.

A few views are predicted and also traced (docs/surface-light.md, "How far off
predictions may be"). Noise averages out over a search, but bias does not: a search
would follow it. So a prediction may be as noisy as a rendered image; this is measured
on the object only, which may be small. Its mean error of the margin has to be near
zero: at most a small fraction of the change that the search has made.
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

# largest accepted mean error of the margin over the views (for a classifier: in logits)
MAX_MARGIN_BIAS = 0.3
MAX_BIAS_FRACTION = 0.05
"""The same as a fraction of the change of the margin by the search; the larger limit
counts. Such an error affects the length of a predicted step, but not its direction.
"""
# The root-mean-square error on the object may always be this large, in levels of 255,
# even if a rendered image has less noise.
MIN_ALLOWED_LEVELS = 2.0
# fraction of the allowed levels that is accepted, so that a prediction beyond the limit
# rarely passes by chance
ACCEPTED_FRACTION = 0.9
CHECK_SPP = 16  # samples per pixel of each of the two traced images of a view
N_FIRST_VIEWS = 2  # number of views that are compared at first
N_VIEWS = 6  # number of views that are compared if the first do not decide
# The first views decide if the error is at most the first, or at least the second
# fraction of what is allowed.
CLEARLY_GOOD = 0.7
CLEARLY_BAD = 1.4

MeasureMargin = Callable[[Tensor, Tensor], float]
"""From an image (H, W, 3) and its configuration (d,) to the model's margin."""


@dataclass(frozen=True)
class ComparedView:
    """A predicted image compared with traced ones.

    Attributes:
        squared_error: mean squared error over the object, in levels of 255 squared; a
            small one may be below 0 by chance.
        allowed_squared_error: the same of a rendered image.
        margin_bias: margin of the predicted image minus that of the traced one.
        n_traced: number of images that were traced.
        margin_change: absolute change of the margin by the search, in predicted images.
    """

    squared_error: float
    allowed_squared_error: float
    margin_bias: float
    n_traced: int
    margin_change: float = 0.0


@dataclass(frozen=True)
class Deviation:
    """The error of predictions, over several views.

    Attributes:
        levels: root-mean-square error over the object, in levels of 255.
        margin_bias: mean error of the margin, with its sign.
        allowed_levels: limit of `levels`.
        n_traced: number of images that were traced to measure it.
        allowed_margin_bias: limit of the absolute value of `margin_bias`.
    """

    levels: float
    margin_bias: float
    allowed_levels: float
    n_traced: int
    allowed_margin_bias: float = MAX_MARGIN_BIAS

    @classmethod
    def from_views(cls, views: Sequence[ComparedView]) -> Deviation:
        """Return the deviation of predictions, from means over several views.

        The error of the margin may be `MAX_MARGIN_BIAS`, or a fraction of the change of
        the margin by the search, whichever is larger.
        """
        # Squared errors are estimates without noise, which may be below 0 by chance.
        # The root is 0 then.
        square = statistics.fmean(view.squared_error for view in views)
        allowed_square = statistics.fmean(view.allowed_squared_error for view in views)
        margin_change = statistics.fmean(view.margin_change for view in views)
        allowed_bias = max(MAX_MARGIN_BIAS, MAX_BIAS_FRACTION * margin_change)
        return cls(
            levels=_root(square),
            margin_bias=statistics.fmean(view.margin_bias for view in views),
            allowed_levels=max(MIN_ALLOWED_LEVELS, _root(allowed_square)),
            n_traced=sum(view.n_traced for view in views),
            allowed_margin_bias=allowed_bias,
        )

    @property
    def levels_fraction(self) -> float:
        """The levels as a fraction of those that are allowed."""
        if self.allowed_levels > 0.0:
            return self.levels / self.allowed_levels
        return math.inf

    @property
    def has_accepted_levels(self) -> bool:
        """Whether the levels alone are small enough; False if they are NaN."""
        return self.levels_fraction <= ACCEPTED_FRACTION

    @property
    def is_accepted(self) -> bool:
        """Whether predictions may replace rendered images; False if anything is NaN."""
        has_accepted_margin = abs(self.margin_bias) <= self.allowed_margin_bias
        return self.has_accepted_levels and has_accepted_margin

    @property
    def reason(self) -> str:
        """Why predictions may not replace rendered images, as a part of a sentence.

        It is only read if the deviation is not accepted. The reason is the levels if
        they are too large, and else the margin.
        """
        if not self.has_accepted_levels:
            max_levels = ACCEPTED_FRACTION * self.allowed_levels  # for acceptance
            return (
                f"{self.levels:.1f} levels of 255 off on the object, where "
                f"{max_levels:.1f} would do"
            )
        return (
            f"{self.margin_bias:+.2f} off in the margin, where "
            f"{self.allowed_margin_bias:.2f} would do"
        )


def compare_views(compare_view: Callable[[int], ComparedView]) -> Deviation:
    """Compare predictions with traced images over several views.

    `N_FIRST_VIEWS` are compared first. Only if these are neither clearly good nor
    clearly bad, all `N_VIEWS` are: each view costs three traced images.

    Args:
        compare_view: function of the index of a view that compares a predicted image
            with traced ones of the same configuration.
    """
    views = [compare_view(index) for index in range(N_FIRST_VIEWS)]
    first = Deviation.from_views(views)
    margin_limit = CLEARLY_GOOD * first.allowed_margin_bias
    # `levels_fraction`: error of the images as a fraction of the allowed error
    is_clearly_good = (
        first.levels_fraction <= CLEARLY_GOOD and abs(first.margin_bias) <= margin_limit
    )
    # Only levels are clearly bad, never the margin. The `not` makes NaN clearly bad.
    is_clearly_bad = not first.levels_fraction < CLEARLY_BAD
    if is_clearly_good or is_clearly_bad:
        return first
    views += [compare_view(index) for index in range(N_FIRST_VIEWS, N_VIEWS)]
    return Deviation.from_views(views)


def compare_with_traced(
    renderer: Renderer,
    predicted: Tensor,
    u: Tensor,
    seed: int,
    spp: int,
    measure_margin: MeasureMargin,
    predicted_start: Tensor | None = None,
) -> ComparedView:
    """Compare a predicted image with traced images of the same configuration.

    The reference is traced with many samples. The error that a prediction may have is
    that of an image which is traced with the samples of the search.

    Args:
        renderer: traces images.
        predicted: (H, W, 3) image.
        u: (d,) full configuration.
        seed: seed of the noise of the traced images.
        spp: samples per pixel of the search.
        measure_margin: function from an image (H, W, 3) and its configuration to the
            model's margin.
        predicted_start: (H, W, 3) image that is predicted for the start of the search
            under the same conditions; None if `u` is the start itself.
    """
    with torch.no_grad():
        # what the model would see in the search without a predictor
        search_image = renderer(u, seeds.derive_seed(seed, "rendered"), spp)
        # two images with independent noise (the halves), and the denoised image of both
        *halves, converged = renderer.render_independent_images(u, seed, CHECK_SPP)
        object_mask = renderer.compute_object_mask(u)
    predicted_margin = measure_margin(predicted, u)
    # How far the search has moved the margin: an error of the margin that is small
    # against this is accepted.
    margin_change = 0.0
    if predicted_start is not None:
        margin_change = abs(predicted_margin - measure_margin(predicted_start, u))
    return ComparedView(
        squared_error=compute_squared_error(predicted, halves, object_mask),
        allowed_squared_error=compute_squared_error(search_image, halves, object_mask),
        margin_bias=predicted_margin - measure_margin(converged, u),
        n_traced=3,  # the image of the search, and the two halves
        margin_change=margin_change,
    )


def compute_squared_error(
    image: Tensor, halves: Sequence[Tensor], mask: Tensor | None = None
) -> float:
    """Return the mean squared error of an image, without the noise of its reference.

    There are two reference images with independent noise. The product of the
    differences to both has the squared error as its mean, while the noise cancels; in
    the square of one difference it would count. They are traced without the denoiser,
    which leaves marks of its own in every image.

    Args:
        image: (H, W, 3) image.
        halves: the two reference images (H, W, 3).
        mask: (H, W) mask of the pixels that count; all do if None, or if it is empty.

    Returns:
        The error in levels of 255, squared; below 0 by chance where it is small.
    """
    first, second = halves
    products = (image - first) * (image - second)
    if mask is not None and bool(mask.any()):
        products = products[mask]
    return 255.0**2 * float(products.mean())


def compute_level_errors(
    renderer: Renderer, images: Sequence[Tensor], u: Tensor, seed: int, spp: int
) -> list[float]:
    """Return the root-mean-square error of each image (H, W, 3) over all its pixels, in
    levels of 255.

    Args:
        renderer: traces the images that they are compared with.
        images: images of one configuration.
        u: (d,) the configuration.
        seed: seed of the noise of the traced images.
        spp: samples per pixel of each of the two traced images.
    """
    # the third image is the denoised one of both
    first_half, second_half, _ = renderer.render_independent_images(u, seed, spp)
    halves = (first_half, second_half)
    return [_root(compute_squared_error(image, halves)) for image in images]


def _root(square: float) -> float:
    """Return the square root, or 0 of a negative number; NaN stays NaN."""
    return 0.0 if square <= 0.0 else math.sqrt(square)
