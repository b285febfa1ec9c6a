"""Find the window of the image outside of which a search changes nothing.

What is searched may be visible only in a small part of the image. Then the search
traces the smallest window around it that fulfils two conditions. Full images are
rendered at the start and at both bounds of the budget. Outside of the window they
differ by less than `MAX_LEVELS` on average; and the margin stays the same if the
window is pasted into the image of the start (docs/leaving-out.md, "The rest of the
picture").
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from advsearch import seeds
from advsearch.engine.acceptance import (
    ACCEPTED_FRACTION,
    MAX_BIAS_FRACTION,
    MAX_MARGIN_BIAS,
    Deviation,
)
from advsearch.engine.problem import Problem
from advsearch.scene.assembly import IMAGE_INPUTS
from advsearch.scene.predictor import (
    NOISE,
    Refusal,
    RefusalCause,
    find_changed_inputs,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import HAZE, find_light_inputs
from advsearch.scene.window import Window

MIN_STEPS = 16  # smallest number of evaluations of a search for which a crop pays
MAX_AREA = 0.3  # area of the largest window that pays, as a fraction of the image
MAX_LEVELS = 0.1
"""Allowed difference outside of the window, in levels of 255. It is the root mean
square of the mean differences over squares of `SQUARE` pixels.
"""
SQUARE = 8  # side of these squares in pixels
MARGINS = (8, 16, 24, 32, 48, 64, 96, 128)  # pixels around the box, smallest first
PROBE_SPP = 2
"""Samples per pixel of each half of a full image that is compared with others. Few are
enough, since images of one seed have nearly the same noise.
"""
N_WINDOW_IMAGES = 3  # number of full images that `find_window` renders
# endings of inputs that move a mesh, such as "mug.vertices"
MOVING_SUFFIXES = (".vertices", ".normals")


class FullImage(NamedTuple):
    """A full image, traced twice with independent noise.

    Linear radiance has three color channels. With a backdrop it has a fourth one, the
    coverage by the scene.

    Attributes:
        u: (d,) configuration of the image.
        independent_renders: linear radiance (H, W, 3 or 4) of both, with noise.
        radiance: mean of both (H, W, 3 or 4), denoised.
    """

    u: Tensor
    independent_renders: Sequence[Tensor]
    radiance: Tensor


@dataclass(frozen=True, eq=False)
class Windowing:
    """A window of a search, with the image that surrounds it.

    Attributes:
        window: window of the pixels that are traced.
        start_image: the full image at the start.
        deviation: error of images at both bounds of the budget if their surroundings
            are those of the start.
    """

    window: Window
    start_image: FullImage
    deviation: Deviation


def find_window(problem: Problem) -> Windowing | Refusal:
    """Return the smallest window outside of which a search changes little.

    The box around what is searched is grown by each of `MARGINS`, in pixels, in turn. A
    window is
    accepted if the images of three configurations look alike outside of it: the start,
    and the smallest and the largest allowed values of all coordinates. These are
    `N_WINDOW_IMAGES` full images of few samples.

    Returns:
        The window with the image of the start, or why there is none.
    """
    refusal = find_crop_refusal(problem)
    if refusal is not None:
        return refusal
    resolution = problem.renderer.formation.resolution
    max_area = MAX_AREA * resolution[0] * resolution[1]
    box = _find_box(problem)
    if box is None:
        return Refusal("nothing of what is searched is in the picture")
    if box.grow(MARGINS[0], resolution).area > max_area:
        return Refusal("what is searched fills much of the picture")
    return _grow_window(problem, box, max_area)


def _grow_window(problem: Problem, box: Window, max_area: float) -> Windowing | Refusal:
    """Return the smallest accepted window around a box, or why there is none.

    Args:
        problem: problem of the search.
        box: the box around what is searched.
        max_area: area of the largest window that pays, in pixels.
    """
    resolution = problem.renderer.formation.resolution
    start, *extremes = _render_extremes(problem)
    # The first window is small enough, as was checked above, so that there is a
    # deviation after the loop: that of the largest window.
    for margin in MARGINS:
        window = box.grow(margin, resolution)
        if window.area > max_area:
            break
        deviation = measure_outside(problem, window, start, extremes)
        if deviation.is_accepted:
            return Windowing(window, start, deviation)
    return Refusal(f"its surroundings change with it: {_describe_excess(deviation)}")


def _render_extremes(problem: Problem) -> list[FullImage]:
    """Render the full images of the start and of both bounds of the budget."""
    domain = problem.domain
    # Bounds of the budget: all coordinates as small and as large as it allows. u is in
    # [0, 1], and `project` moves it into the budget.
    lower = domain.project(torch.zeros_like(domain.start))
    upper = domain.project(torch.ones_like(domain.start))
    return [render_full(problem, u) for u in (domain.start, lower, upper)]


def find_crop_refusal(problem: Problem) -> Refusal | None:
    """Return why a search renders full images; None if a crop may be enough.

    Whether the search changes anything outside of the crop is measured later.
    """
    renderer = problem.renderer
    # why the image is composed of several; "" if it is not
    if renderer.composition_reason:
        return Refusal(renderer.composition_reason)
    if problem.conditions is not None:
        # random conditions change all of the image
        return Refusal("the surroundings of each picture are others")
    if problem.steps < MIN_STEPS:
        return Refusal(
            f"a crop pays from {MIN_STEPS} evaluations on", RefusalCause.TOO_FEW_STEPS
        )
    return _find_render_refusal(renderer) or find_searched_refusal(problem)


def _find_render_refusal(renderer: Renderer) -> Refusal | None:
    """Return why images of a renderer can't be pasted together; None if they can."""
    if renderer.scene.is_volumetric:
        return HAZE
    description, _filter = renderer.scene.description_and_filter
    if description.camera_model is not None:
        return Refusal("the camera has a lens of its own")
    is_denoised = renderer.formation.denoiser == "oidn"
    return None if is_denoised else NOISE


def find_searched_refusal(problem: Problem) -> Refusal | None:
    """Return why what is searched may change all of the image; None if it does not.

    It does not if surfaces of meshes are searched, such as a texture, and the meshes
    stay where they are. Then the image changes where the meshes are visible. Lights
    and moving things change it elsewhere. If all that is searched changes the finished
    image, such as a blur, no part has to be traced, which is a refusal as well.
    """
    light_inputs = find_light_inputs(problem.renderer)
    input_names = find_searched_inputs(problem)  # such as "mug.bsdf.reflectance"
    if not input_names:
        return Refusal("nothing that is searched needs a render")
    mesh_names = problem.renderer.find_surfaces(problem.renderer.start).shape_names
    for name in sorted(input_names):
        refusal = _find_input_refusal(name, light_inputs, mesh_names)
        if refusal is not None:
            return refusal
    return None


def _find_input_refusal(
    name: str, light_inputs: Container[str], mesh_names: Container[str]
) -> Refusal | None:
    """Return why a scene input may change all of the image; None if it does not."""
    part = name.partition(".")[0]  # "mug": the mesh or light that has the input
    if name in light_inputs:
        return Refusal(f"{part} is light, which shows everywhere")
    if name.endswith(MOVING_SUFFIXES):
        return Refusal(f"{part} moves")
    is_mesh = part in mesh_names  # only a mesh has a place in the image
    if not is_mesh:
        return Refusal(f"{part} shows in more than a part of the picture")
    return None


def find_searched_inputs(problem: Problem) -> frozenset[str]:
    """Return the scene inputs that are searched."""
    names = [control.name for control in problem.searched_space.controls]
    return find_changed_inputs(problem.renderer, names) - IMAGE_INPUTS


def _find_box(problem: Problem) -> Window | None:
    """Return the box of all searched meshes at the start; None if none is visible."""
    surfaces = problem.renderer.find_surfaces(problem.domain.start)
    mask = torch.zeros(problem.renderer.formation.resolution, dtype=torch.bool)
    for name in find_searched_inputs(problem):
        mask |= surfaces.visible_mask(name.partition(".")[0])
    return Window.from_mask(mask)


def render_full(problem: Problem, u: Tensor) -> FullImage:
    """Render the full image of a configuration, to compare it with that of another.

    It is traced twice with independent noise (the two halves), and the mean of both is
    denoised. The two seeds are the same for every u, so that most of the noise
    cancels in the difference of two images.

    Args:
        problem: problem of the search.
        u: (d,) the configuration.
    """
    renderer = problem.renderer
    noise_seed = seeds.derive_seed(problem.seed, "crop")
    with (
        torch.no_grad(),
        renderer.scene.limit_depth(problem.search_depth),
        renderer.share_paths(problem.shared_paths),
    ):
        halves, radiance = renderer.trace_independent_radiances(
            _compute_inputs(problem, u), noise_seed, PROBE_SPP
        )
    return FullImage(u.detach().clone(), independent_renders=halves, radiance=radiance)


def _compute_inputs(problem: Problem, u: Tensor) -> dict[str, Tensor]:
    """Return the scene inputs of u (d,)."""
    return problem.renderer.scene.input_assembler(problem.space.inputs(u))


def measure_outside(
    problem: Problem, window: Window, before: FullImage, others: Sequence[FullImage]
) -> Deviation:
    """Measure the mean difference of images outside of a window.

    Args:
        problem: problem of the search.
        window: the pixels that are traced.
        before: full image whose surroundings would be pasted around the window.
        others: full images of other configurations, which are compared with it.
    """
    squared_differences = []
    margin_biases = []
    margin_changes = []
    for image in others:
        squared_differences.append(_measure_square(problem, window, before, image))
        # error of the margin by pasting, and change of the margin by the search
        bias, change = _measure_margin(problem, window, before, image)
        margin_biases.append(bias)
        margin_changes.append(change)
    count = len(others)
    mean_square = sum(squared_differences) / count
    # The bias may be a fraction of the change of the margin by the search itself.
    allowed_bias = max(MAX_MARGIN_BIAS, MAX_BIAS_FRACTION * sum(margin_changes) / count)
    return Deviation(
        # The mean square is an estimate without noise, and may be below 0 by chance.
        levels=math.sqrt(max(0.0, mean_square)),
        margin_bias=sum(margin_biases) / count,  # mean error of the margin
        allowed_levels=MAX_LEVELS,
        n_traced=count,  # full images
        allowed_margin_bias=allowed_bias,
    )


def _measure_square(
    problem: Problem, window: Window, before: FullImage, after: FullImage
) -> float:
    """Return the mean squared difference of two images outside of a window.

    Each image has two halves, traced with the same two seeds. Most of the noise cancels
    in the difference of two halves with one seed. The rest is independent for the two
    seeds, so that the product of both differences has the squared difference as its
    mean, without noise.

    Args:
        problem: problem of the search.
        window: the pixels that do not count.
        before: a full image.
        after: another full image.

    Returns:
        The mean over the pixels outside of the window and the color channels, in levels
        of 255 squared. Differences are averaged over squares of `SQUARE` pixels before
        they are squared. The result may be below 0 by chance.
    """
    # (H, W, 1) 1 outside of the window, 0 inside
    outside = window.make_outside_mask(problem.renderer.formation.resolution).float()
    outside = outside[..., None]
    # converts a small difference of radiance to one of displayed values, in [0, 1]
    slope = _compute_slope(problem, before)
    # for each of the two seeds, differences summed over the squares: (1, 3, h, w)
    first_sum, second_sum = [
        _sum_levels(old, new, slope, outside)
        for old, new in zip(
            before.independent_renders, after.independent_renders, strict=True
        )
    ]
    # number of pixels outside of the window in each square, (1, 1, h, w)
    n_pixels = _sum_over_squares(outside)
    # A sum over a square is n_pixels times a mean. The product of both means is
    # weighted by the number of pixels: mean * mean * n_pixels = sum * sum / n_pixels.
    products = first_sum * second_sum / n_pixels.clamp_min(1.0)
    n_channels = 3.0
    return float(products.sum() / (n_channels * n_pixels.sum().clamp_min(1.0)))


def _sum_levels(old: Tensor, new: Tensor, slope: Tensor, outside: Tensor) -> Tensor:
    """Return the difference of two renders, in levels of 255, summed over squares.

    Args:
        old: (H, W, 3 or 4) linear radiance.
        new: (H, W, 3 or 4) linear radiance of the same seed.
        slope: (H, W, 3) derivative of displayed values by radiance.
        outside: (H, W, 1) 1 for the pixels that count, else 0.
    """
    difference = (new - old)[..., :3]  # without coverage
    levels = 255.0 * slope * difference * outside
    return _sum_over_squares(levels)


def _sum_over_squares(image: Tensor) -> Tensor:
    """Return the sums over squares of `SQUARE` pixels of an image (H, W, c).

    The result is (1, c, h, w). Squares at the right and lower border may be smaller, if
    the image is not divisible into full ones.
    """
    # `ceil_mode` includes the smaller squares; with a divisor of 1 the average is a sum
    sums: Tensor = functional.avg_pool2d(
        image.movedim(-1, 0)[None], SQUARE, ceil_mode=True, divisor_override=1
    )
    return sums


def _compute_slope(problem: Problem, image: FullImage) -> Tensor:
    """Return the derivative of the displayed image by its radiance, (H, W, 3).

    It converts small differences of radiance into differences of displayed values. Each
    displayed pixel depends on its own radiance, so that the gradient of the sum has the
    derivative of each pixel.
    """
    radiance = image.radiance.clone()  # (H, W, 3), or 4 with coverage
    inputs = _compute_inputs(problem, image.u)
    renderer = problem.renderer
    with torch.enable_grad():
        radiance.requires_grad_()
        # The two steps of displaying an image, without rounding. First exposure and
        # backdrop are applied, then the tone curve.
        linear = renderer.finish_image(radiance, inputs, image.u, display=False)
        displayed = renderer.formation.map_to_display(linear)
        (slope,) = torch.autograd.grad(displayed.sum(), radiance)
    return slope[..., :3]  # without coverage


def _measure_margin(
    problem: Problem, window: Window, before: FullImage, after: FullImage
) -> tuple[float, float]:
    """Return the error of the margin with other surroundings, and how far it moved.

    Args:
        problem: problem of the search.
        window: the pixels that are traced.
        before: full image whose surroundings are pasted around the window.
        after: full image of the configuration that is searched.

    Returns:
        The margin with pasted surroundings minus the true margin of `after`; and the
        absolute difference between the margins of `after` and `before`.
    """
    pasted = window.paste(window.crop_image(after.radiance), before.radiance)
    margin = _compute_margin(problem, after.radiance, after.u)
    bias = _compute_margin(problem, pasted, after.u) - margin
    change = margin - _compute_margin(problem, before.radiance, before.u)
    return bias, abs(change)


def _compute_margin(problem: Problem, radiance: Tensor, u: Tensor) -> float:
    """Return the model's margin on the image of radiance (H, W, 3 or 4)."""
    with torch.no_grad():
        inputs = _compute_inputs(problem, u)
        image = problem.renderer.finish_image(radiance, inputs, u)
        return problem.judge(image, u).margin


def _describe_excess(deviation: Deviation) -> str:
    """Return by how much a rejected deviation exceeds its limit, for a sentence."""
    has_accepted_levels = deviation.levels_fraction <= ACCEPTED_FRACTION
    if not has_accepted_levels:
        max_levels = ACCEPTED_FRACTION * deviation.allowed_levels
        return (
            f"by {deviation.levels:.2f} levels of 255, where {max_levels:.2f} would do"
        )
    # the deviation is rejected, so it is the margin
    return (
        f"by {deviation.margin_bias:+.2f} in the margin, where "
        f"{deviation.allowed_margin_bias:.2f} would do"
    )
