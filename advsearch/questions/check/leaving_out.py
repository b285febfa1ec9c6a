"""Measure what a search saves by what it leaves out, and that it changes nothing."""

from __future__ import annotations

import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from advsearch.extend import gradients, seeds
from advsearch.questions.check.result import GainRow, TexelRow

ITEMS = gradients.OMISSIONS
EVERYTHING = frozenset(ITEMS)  # leave out all that can be
NOTHING = frozenset[str]()
ALL = "everything above"
BOUNCES = "bounces"
"""Names of the rows in which all items are put back together, and in which paths have
their full length.
"""
WHAT = {
    **ITEMS,
    BOUNCES: "bounces of light beyond the search's longest path",
    ALL: "all of these",
}
"""What is left out, in words, for each row."""
AGREEMENT_LIMIT = 1.2
"""Difference, as a fraction of what another seed changes, up to which two images or
gradients agree: 1 is expected if the random numbers are others.
"""
REPEATS = 3  # timed gradients of each
MAX_GRADIENTS = (2 + REPEATS) * (len(ITEMS) + 3)
"""That `measure_gains` takes: with every item put back, with all, with all bounces and
with none.
"""
TEXELS_PER_PIXEL = 2.0
"""That `TexelRow.enough` keeps: two samples a period (Nyquist), with room for oblique
views.
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

    Each item is put back, and then all at once, and a gradient is timed and compared.
    Images and gradients are compared at two seeds, so that it is known what noise
    changes; then gradients are timed in rounds over all variants.

    Args:
        renderer: renderer of a search.
        loss: loss that is differentiated.
        u: (d,) where.
        seed: seed of the renders.
        spp: samples per pixel.
        repeats: timed gradients of each.
        depth: the longest light path of the search; None for the scene's.
        tick: called after each gradient.

    Returns:
        A row for each item, one for the bounces if these are limited, and one for all.
    """
    variants = _make_variants(renderer, depth)
    # by item; "" is the renderer of the search
    images = defaultdict[str, list[Tensor]](list)
    slopes = defaultdict[str, list[Tensor]](list)
    times = defaultdict[str, list[float]](list)
    # The first gradient of each compiles, so that these are not timed.
    for noise_seed in (seed, seeds.stream(seed, "another")):
        for item, variant in variants.items():
            with torch.no_grad():
                images[item].append(variant(u, noise_seed, spp))
            slopes[item].append(variant.gradient(loss, u, noise_seed, spp)[1])
            tick()
    for number in range(repeats):
        for item, variant in variants.items():
            begin = time.perf_counter()
            variant.gradient(loss, u, seeds.stream(seed, "round", number), spp)
            times[item].append(time.perf_counter() - begin)
            tick()
    return [
        _compare_item(item, images, slopes, times) for item in variants if item != ""
    ]


def _make_variants(
    renderer: gradients.Renderer, depth: int | None
) -> dict[str, gradients.Renderer]:
    """Return the renderer of a search, by "", and others by the item that they compute.

    The renderer of the search leaves out everything that it can; each of the others
    computes one item of that, or all (`ALL`).

    Args:
        renderer: whose paths have their full length.
        depth: the longest light path of the search; None for the scene's.
    """
    scene = renderer.scene
    depth = scene.max_depth if depth is None else depth
    is_limited = depth != scene.max_depth
    variants = {"": renderer}
    if is_limited:
        variants[""] = renderer.copy_with(scene.copy_with(max_depth=depth))
    for item in ITEMS:
        leave_out = EVERYTHING - {item}
        variants[item] = renderer.copy_with(
            scene.copy_with(max_depth=depth, leave_out=leave_out)
        )
    # It leaves out the same things, but no bounces.
    if depth < scene.max_depth:
        variants[BOUNCES] = renderer
    variants[ALL] = renderer.copy_with(scene.copy_with(leave_out=NOTHING))
    return variants


def _compare_item(
    item: str,
    images: Mapping[str, list[Tensor]],
    slopes: Mapping[str, list[Tensor]],
    times: Mapping[str, list[float]],
) -> GainRow:
    """Compare the renderer that computes an item with the one that leaves it out.

    Measurements are by the item that is computed; those under "" are without any.

    `time_gain` is how many times as long the renderer with the item takes to images of
    the same noise: the ratio of the seconds, times that of the variances.

    Args:
        item: its name.
        images: images at two seeds.
        slopes: gradients at two seeds.
        times: times of gradients, in seconds.
    """
    image_difference = _relative_difference(images[""], images[item])
    gradient_difference = _relative_difference(slopes[""], slopes[item])
    noise_without = _difference(images[""])
    variance_gain = 1.0
    if noise_without > 0.0:
        variance_gain = (_difference(images[item]) / noise_without) ** 2
    seconds_without = statistics.median(times[""])
    seconds = statistics.median(times[item])
    return GainRow(
        item=item,
        what=WHAT[item],
        time_gain=variance_gain * seconds / seconds_without,
        picture_difference=image_difference,
        gradient_difference=gradient_difference,
        safe=max(image_difference, gradient_difference) <= AGREEMENT_LIMIT,
        seconds=seconds,
    )


def _difference(pair: list[Tensor]) -> float:
    """Return the norm of what another seed changes."""
    first, other = pair
    return float((other - first).norm())


def _relative_difference(without: list[Tensor], with_item: list[Tensor]) -> float:
    """Return how much an item changes an image or gradient, compared with the noise.

    That is the difference at the first seed, divided by the root mean square of the
    differences between the two seeds; not divided if seeds make no difference.

    Args:
        without: images or gradients at two seeds, without the item.
        with_item: the same with the item, at the same seeds.
    """
    noise = math.sqrt(
        statistics.fmean(_difference(pair) ** 2 for pair in (without, with_item))
    )
    difference = float((with_item[0] - without[0]).norm())
    return difference / noise if noise > 0.0 else difference


def measure_texels(
    renderer: gradients.Renderer, u: Tensor, *, seed: int, spp: int = 16
) -> list[TexelRow]:
    """Compare the texels of every searched texture with the pixels that show them.

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
        for name in sorted(renderer.routes.get(group.name, ())):
            n_pixels = _count_pixels(renderer, inputs, name, seed, spp)
            n_visible = _count_visible_texels(renderer, inputs, name, seed, spp)
            size = max(inputs[name].shape[:2])
            # Halved as long as enough texels per pixel would still be visible.
            enough = size
            while enough > 2:
                # The number of texels falls with the square of the side.
                n_visible_of_half = n_visible * (enough / 2 / size) ** 2
                if n_visible_of_half < TEXELS_PER_PIXEL * n_pixels:
                    break
                enough //= 2
            rows.append(
                TexelRow(
                    control=group.control,
                    side=size,
                    seen=n_visible,
                    pixels=n_pixels,
                    enough=enough,
                )
            )
    return rows


def _count_pixels(
    renderer: gradients.Renderer,
    inputs: Mapping[str, Tensor],
    name: str,
    seed: int,
    spp: int,
) -> int:
    """Count the pixels that show a texture: they differ if it is white or black."""
    scene = renderer.scene
    white = {**inputs, name: torch.full_like(inputs[name], 1.0)}
    black = {**inputs, name: torch.full_like(inputs[name], 0.0)}
    difference = (
        scene.render_guides(white, seed, spp)[0]
        - scene.render_guides(black, seed, spp)[0]
    )
    return int((difference.amax(dim=-1) > 0.0).sum())


def _count_visible_texels(
    renderer: gradients.Renderer,
    inputs: Mapping[str, Tensor],
    name: str,
    seed: int,
    spp: int,
) -> int:
    """Count the texels of a texture that reach the camera directly.

    These are the ones by which the sum of all pixels has a derivative, if light paths
    have just two segments: from the light to the surface, and on to the camera.

    Args:
        renderer: renderer of the scene.
        inputs: inputs of the scene.
        name: name of the input that is the texture.
        seed: seed of the render.
        spp: samples per pixel.
    """
    scene = renderer.scene
    with scene.limit_depth(2):
        ones = torch.ones(*scene.resolution, 3)
        gradient = scene.render_adjoint(inputs, ones, seed, spp, wrt=[name])[name]
    return int((gradient.abs().amax(dim=-1) > 0.0).sum())
