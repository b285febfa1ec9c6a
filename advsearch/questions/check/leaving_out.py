"""Measure how much time a search saves by what it does not compute.

It is also checked that images and gradients stay the same.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from advsearch.extend import gradients, seeds
from advsearch.questions.check.result import GainRow, TexelRow

ITEMS = gradients.OMISSIONS
ALL_ITEMS = frozenset(ITEMS)
NO_ITEMS = frozenset[str]()
# Names of the variants of a renderer that are compared, besides those that compute one
# item: the search's, which computes no item; the one that computes all items; and the
# one whose light paths have their full length.
SEARCH = ""
ALL = "everything above"
BOUNCES = "bounces"
WHAT = {
    **ITEMS,
    BOUNCES: "bounces of light beyond the search's longest path",
    ALL: "all of these",
}
"""Descriptions of what is left out, for each row."""
AGREEMENT_LIMIT = 1.2
"""Two images or gradients agree if they differ by at most this much, as a fraction of
the difference between two seeds. Without any effect, 1 is expected.
"""
REPEATS = 3  # timed gradients of each variant
MAX_GRADIENTS = (2 + REPEATS) * (len(ITEMS) + 3)
"""Maximum number of gradients that `measure_gains` computes: each variant has two to
compare, and the timed ones.
"""
TEXELS_PER_PIXEL = 2.0
"""Visible texels for each pixel that suffice: two samples a period (Nyquist), with room
for oblique views.
"""


def measure_gains(
    renderer: gradients.Renderer,
    loss: gradients.Loss,
    u: Tensor,
    *,
    seed: int,
    spp: int,
    repeats: int = REPEATS,
    depth: int | None = None,
    tick: Callable[[], None] = lambda: None,
) -> list[GainRow]:
    """Measure what a renderer saves by each item that it leaves out.

    The search's renderer computes no item. For each item there is a variant of the
    renderer that computes it, and one variant computes all. The images and gradients of
    each variant are compared with those of the search's renderer. All are rendered with
    two seeds, and the difference between these shows how much is noise. Then gradients
    are timed in rounds over all variants, so that a slow moment of the machine affects
    all of them alike.

    Args:
        renderer: renderer of a search.
        loss: loss that is differentiated.
        u: (d,) the configuration.
        seed: seed of the renders.
        spp: samples per pixel.
        repeats: number of timed gradients of each variant.
        depth: maximum number of segments of the search's light paths; None for the
            scene's.
        tick: called after each gradient.

    Returns:
        A row for each item, one for the bounces if the search limits them, and one for
        all items together.
    """
    variants = _make_variants(renderer, depth)
    measurements = {item: _Measurements() for item in variants}
    # The first gradient of a variant compiles its kernels. That is done here, and not
    # timed.
    other_seed = seeds.derive_seed(seed, "another")
    for noise_seed in (seed, other_seed):
        for item, variant in variants.items():
            measurements[item].add_renders(variant, loss, u, noise_seed, spp)
            tick()
    for number in range(repeats):
        time_seed = seeds.derive_seed(seed, "round", number)
        for item, variant in variants.items():
            measurements[item].time_gradient(variant, loss, u, time_seed, spp)
            tick()
    search = measurements.pop(SEARCH)
    return [
        _compare_item(item, search, with_item)
        for item, with_item in measurements.items()
    ]


def _make_variants(
    renderer: gradients.Renderer, depth: int | None
) -> dict[str, gradients.Renderer]:
    """Return variants of a search's renderer, by the item that they compute.

    The variant `SEARCH` leaves out everything that it can. Each of the others computes
    one of these items, and `ALL` computes all. `BOUNCES` has light paths of full length.

    Args:
        renderer: renderer that leaves out everything it can, except bounces: its light
            paths have their full length.
        depth: maximum number of segments of the search's light paths; None for the
            scene's.
    """
    scene = renderer.scene
    depth = scene.max_depth if depth is None else depth
    variants = {SEARCH: renderer}
    if depth != scene.max_depth:
        variants[SEARCH] = renderer.copy_with(scene.copy_with(max_depth=depth))
    for item in ITEMS:
        with_item = scene.copy_with(max_depth=depth, leave_out=ALL_ITEMS - {item})
        variants[item] = renderer.copy_with(with_item)
    leaves_out_bounces = depth < scene.max_depth
    if leaves_out_bounces:
        variants[BOUNCES] = renderer  # its light paths have their full length
    variants[ALL] = renderer.copy_with(scene.copy_with(leave_out=NO_ITEMS))
    return variants


@dataclass
class _Measurements:
    """Measurements with one variant of the renderer.

    Attributes:
        images: images (H, W, 3) at two seeds.
        derivatives: gradients (d,) at two seeds.
        seconds: times of gradients.
    """

    images: list[Tensor] = field(default_factory=list)
    derivatives: list[Tensor] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add_renders(
        self,
        variant: gradients.Renderer,
        loss: gradients.Loss,
        u: Tensor,
        seed: int,
        spp: int,
    ) -> None:
        """Add an image and a gradient at a seed."""
        with torch.no_grad():
            self.images.append(variant(u, seed, spp))
        _, gradient = variant.gradient(loss, u, seed, spp)
        self.derivatives.append(gradient)

    def time_gradient(
        self,
        variant: gradients.Renderer,
        loss: gradients.Loss,
        u: Tensor,
        seed: int,
        spp: int,
    ) -> None:
        """Compute a gradient, and add how long that takes."""
        begin = time.perf_counter()
        variant.gradient(loss, u, seed, spp)
        self.seconds.append(time.perf_counter() - begin)


def _compare_item(
    item: str, search: _Measurements, with_item: _Measurements
) -> GainRow:
    """Compare the renderer that computes an item with that of the search.

    `time_gain` is how many times longer the renderer with the item takes for an equally
    noisy image. That is (ratio of seconds) * (ratio of variances), both of the renderer
    with the item to that of the search, since the variance of a Monte Carlo estimate
    falls as 1 / time.

    Args:
        item: name of the item.
        search: measurements with the search's renderer, which computes no item.
        with_item: measurements with the renderer that computes the item.
    """
    image_difference = _relative_difference(search.images, with_item.images)
    gradient_difference = _relative_difference(
        search.derivatives, with_item.derivatives
    )
    variance_ratio = _compute_variance_ratio(search.images, with_item.images)
    seconds = statistics.median(with_item.seconds)
    search_seconds = statistics.median(search.seconds)
    return GainRow(
        item=item,
        what=WHAT[item],
        time_gain=variance_ratio * seconds / search_seconds,
        picture_difference=image_difference,
        gradient_difference=gradient_difference,
        safe=max(image_difference, gradient_difference) <= AGREEMENT_LIMIT,
        seconds=seconds,
    )


def _compute_variance_ratio(without: list[Tensor], with_item: list[Tensor]) -> float:
    """Return the variance of an image with an item, over that without it.

    It is 1 if there is no noise without the item.

    Args:
        without: images at two seeds, without the item.
        with_item: the same with the item.
    """
    # Two images of the same renderer differ only by noise.
    search_noise = _seed_difference(without)
    if search_noise > 0.0:
        return (_seed_difference(with_item) / search_noise) ** 2
    return 1.0


def _seed_difference(pair: list[Tensor]) -> float:
    """Return the norm of the difference between two seeds."""
    first, other = pair
    return float((other - first).norm())


def _relative_difference(without: list[Tensor], with_item: list[Tensor]) -> float:
    """Return how much an item changes an image or gradient, compared with the noise.

    That is the difference at the first seed, divided by the root mean square of the
    differences between the two seeds. If seeds make no difference, it is not divided.

    Args:
        without: images or gradients at two seeds, without the item.
        with_item: the same with the item, at the same seeds.
    """
    noise = math.sqrt(
        statistics.fmean(_seed_difference(pair) ** 2 for pair in (without, with_item))
    )
    difference = float((with_item[0] - without[0]).norm())
    return difference / noise if noise > 0.0 else difference


def measure_texels(
    renderer: gradients.Renderer, u: Tensor, *, seed: int, spp: int = 16
) -> list[TexelRow]:
    """Compare the texels of each searched texture with the pixels that show it.

    A texture with many more visible texels than pixels is larger than necessary.

    Args:
        renderer: renderer of a search.
        u: (d,) the configuration.
        seed: seed of the renders.
        spp: samples per pixel.
    """
    inputs = renderer.compute_scene_inputs(u)
    rows = list[TexelRow]()
    for group in renderer.plan.groups:
        if group.parameter != "texels":
            continue
        # names of the scene inputs (textures) that the group changes
        input_names = renderer.inputs_by_group.get(group.name, frozenset())
        for name in sorted(input_names):
            n_pixels = _count_pixels(renderer, inputs, name, seed, spp)
            n_visible = _count_visible_texels(renderer, inputs, name, seed, spp)
            side = max(inputs[name].shape[:2])
            rows.append(_make_texel_row(group.control, side, n_visible, n_pixels))
    return rows


def _make_texel_row(control: str, side: int, n_visible: int, n_pixels: int) -> TexelRow:
    """Return the row of a texture, with the side that would suffice.

    Args:
        control: control that changes the texture.
        side: side of the texture, in texels.
        n_visible: number of its visible texels.
        n_pixels: number of pixels that show it.
    """
    return TexelRow(
        control=control,
        side=side,
        seen=n_visible,
        pixels=n_pixels,
        enough=_find_sufficient_side(side, n_visible, n_pixels),
    )


def _find_sufficient_side(side: int, n_visible: int, n_pixels: int) -> int:
    """Return the smallest sufficient side of a texture.

    The side is halved as long as there remain at least `TEXELS_PER_PIXEL` visible
    texels for each pixel that shows the texture.

    Args:
        side: side of the texture, in texels.
        n_visible: number of its visible texels.
        n_pixels: number of pixels that show it.
    """
    sufficient = side
    while sufficient > 2:
        # The number of texels falls with the square of the side.
        half_fraction = sufficient / 2 / side
        n_visible_of_half = n_visible * half_fraction**2
        if n_visible_of_half < TEXELS_PER_PIXEL * n_pixels:
            break
        sufficient //= 2
    return sufficient


def _count_pixels(
    renderer: gradients.Renderer,
    inputs: Mapping[str, Tensor],
    name: str,
    seed: int,
    spp: int,
) -> int:
    """Count the pixels that show a texture.

    The albedo of the scene is rendered with a white and with a black texture. The
    pixels that differ show the texture.

    Args:
        renderer: renderer of the scene.
        inputs: inputs of the scene.
        name: name of the input that is the texture.
        seed: seed of the renders.
        spp: samples per pixel.
    """
    scene = renderer.scene
    white = {**inputs, name: torch.full_like(inputs[name], 1.0)}
    black = {**inputs, name: torch.full_like(inputs[name], 0.0)}
    white_albedo, _ = scene.render_guides(white, seed, spp)
    black_albedo, _ = scene.render_guides(black, seed, spp)
    difference = white_albedo - black_albedo
    shows_texture = difference.amax(dim=-1) > 0.0
    return int(shows_texture.sum())


def _count_visible_texels(
    renderer: gradients.Renderer,
    inputs: Mapping[str, Tensor],
    name: str,
    seed: int,
    spp: int,
) -> int:
    """Count the texels of a texture that reach the camera directly.

    The gradient of the sum of all pixels by the texels is rendered with light paths of
    two segments: from the light to the surface, and on to the camera. A texel is
    visible if its derivative is not 0.

    Args:
        renderer: renderer of the scene.
        inputs: inputs of the scene.
        name: name of the input that is the texture.
        seed: seed of the render.
        spp: samples per pixel.
    """
    scene = renderer.scene
    with scene.limit_depth(2):
        # The sum of all pixels has the derivative 1 by each of them.
        pixel_gradient = torch.ones(*scene.resolution, 3)
        gradients_by_input = scene.render_adjoint(
            inputs, pixel_gradient, seed, spp, wrt=[name]
        )
    is_visible = gradients_by_input[name].abs().amax(dim=-1) > 0.0
    return int(is_visible.sum())
