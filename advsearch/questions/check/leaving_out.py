"""Measures what a search leaves out of its renders: what that saves, and that it
changes nothing.
"""

from __future__ import annotations

import math
import statistics
import time
from collections import defaultdict
from collections.abc import Callable

import torch
from torch import Tensor

from advsearch.extend import gradients, seeds
from advsearch.questions.check.result import GainRow, TexelRow

ITEMS = gradients.ITEMS
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
AGREES = 1.2
"""Difference, as a share of what another seed changes, up to which two images or
gradients agree: 1 is expected where the random numbers are others.
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
    renderer: gradients.Renderer, loss: gradients.Loss, u: Tensor, *, seed: int, spp: int, repeats: int = REPEATS,
    depth: int | None = None, tick: Callable[[], None] = lambda: None,
) -> list[GainRow]:  # fmt: skip
    """Put back what a renderer leaves out, item by item and all at once, and measure a
    gradient of a loss at u (d,).

    `depth` is the longest light path of the search, where it is shorter than the
    scene's; `tick` is called after each gradient. There is one row for each item, one
    for the bounces, and one for all.
    """
    scene = renderer.scene
    depth = scene.max_depth if depth is None else depth
    renderers = {
        "": renderer
        if depth == scene.max_depth
        else renderer.like(scene.like(max_depth=depth))
    }
    for item in ITEMS:
        renderers[item] = renderer.like(
            scene.like(max_depth=depth, leave_out=EVERYTHING - {item})
        )
    if depth < scene.max_depth:
        renderers[BOUNCES] = renderer
    renderers[ALL] = renderer.like(scene.like(leave_out=NOTHING))

    images = defaultdict[str, list[Tensor]](list)
    slopes = defaultdict[str, list[Tensor]](list)
    times = defaultdict[str, list[float]](list)
    for noise in (seed, seeds.stream(seed, "another")):  # the first compiles
        for item, variant in renderers.items():
            with torch.no_grad():
                images[item].append(variant(u, noise, spp))
            slopes[item].append(variant.gradient(loss, u, noise, spp)[1])
            tick()
    for number in range(repeats):
        for item, variant in renderers.items():
            start_time = time.perf_counter()
            variant.gradient(loss, u, seeds.stream(seed, "round", number), spp)
            times[item].append(time.perf_counter() - start_time)
            tick()

    rows = []
    noise_without = _difference(images[""])
    seconds_without = statistics.median(times[""])
    for item in list(renderers)[1:]:
        image_difference = _relative_difference(images[""], images[item])
        gradient_difference = _relative_difference(slopes[""], slopes[item])
        variance_gain = (
            (_difference(images[item]) / noise_without) ** 2
            if noise_without > 0.0
            else 1.0
        )
        seconds = statistics.median(times[item])
        rows.append(
            GainRow(
                item=item, what=WHAT[item], time_gain=variance_gain * seconds / seconds_without,
                picture_difference=image_difference, gradient_difference=gradient_difference,
                safe=max(image_difference, gradient_difference) <= AGREES, seconds=seconds,
            )
        )  # fmt: skip
    return rows


def _difference(pair: list[Tensor]) -> float:
    """Return the norm of what another seed changes."""
    first, other = pair
    return float((other - first).norm())


def _relative_difference(without: list[Tensor], having: list[Tensor]) -> float:
    """Return the difference at one seed over the root mean square of those that another
    seed makes.
    """
    size = math.sqrt(
        statistics.fmean(_difference(pair) ** 2 for pair in (without, having))
    )
    difference = float((having[0] - without[0]).norm())
    return difference / size if size > 0.0 else difference


def measure_texels(
    renderer: gradients.Renderer, u: Tensor, *, seed: int, spp: int = 16
) -> list[TexelRow]:
    """Return, for every searched texture, how its texels compare with the pixels that
    show them.
    """
    scene = renderer.scene
    inputs = renderer.traced_inputs(u)
    rows = []
    for group in renderer.plan.groups:
        names = (
            sorted(renderer.routes.get(group.name, ()))
            if group.parameter == "texels"
            else []
        )
        for name in names:
            bright, dark = (
                {**inputs, name: torch.full_like(inputs[name], level)}
                for level in (1.0, 0.0)
            )
            difference = (
                scene.guides(bright, seed, spp)[0] - scene.guides(dark, seed, spp)[0]
            )
            pixels = int((difference.amax(dim=-1) > 0.0).sum())
            with scene.shorter(2):
                gradient = scene.adjoint(
                    inputs, torch.ones(*scene.resolution, 3), seed, spp, wrt=[name]
                )[name]
            seen = int((gradient.abs().amax(dim=-1) > 0.0).sum())
            side = max(inputs[name].shape[:2])
            enough = side
            while (
                enough > 2
                and seen * (enough / 2 / side) ** 2 >= TEXELS_PER_PIXEL * pixels
            ):
                enough //= 2
            rows.append(
                TexelRow(
                    control=group.control,
                    side=side,
                    seen=seen,
                    pixels=pixels,
                    enough=enough,
                )
            )
    return rows
