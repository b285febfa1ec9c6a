"""What a search leaves out of a scene, what that saves, and the proof that it changes neither picture nor gradient."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.engine.gradients import Loss
from advsearch.questions.check.answer import GainRow, TexelRow
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.formation import EVERYTHING, ITEMS, NOTHING
from advsearch.scene.renderer import Renderer

ALL, BOUNCES = "everything above", "bounces"
"""Names of the rows in which all items are put back together, and in which paths have their full length."""
WHAT = {
    **ITEMS,
    BOUNCES: "bounces of light beyond the search's longest path",
    ALL: "all of these",
}
"""What is left out, in words, for each row."""
AGREES = 1.2
"""Difference, as a share of what another seed changes, up to which two pictures or gradients agree: 1 is expected where
the random numbers are others."""
REPEATS = 3
"""Timed gradients of each."""
MOST_GRADIENTS = (2 + REPEATS) * (len(ITEMS) + 3)
"""That `measured_gains` takes: with every item put back, with all, with all bounces and with none."""
PER_PIXEL = 2.0
"""Texels a pixel that `TexelRow.enough` keeps: two samples a period (Nyquist), with room for oblique views."""


@dataclass
class Samples:
    """Pictures and gradients of two seeds, and the seconds of a gradient."""

    pictures: list[Tensor]
    gradients: list[Tensor]
    seconds: float = 0.0


def measured_gains(
    renderer: Renderer,
    loss: Loss,
    u: Tensor,
    *,
    seed: int,
    spp: int,
    repeats: int = REPEATS,
    depth: int | None = None,
    tick: Callable[[], None] = lambda: None,
) -> list[GainRow]:
    """Put back what a renderer leaves out, item by item and all at once, and measure a gradient of a loss at u (d,).

    `depth` is the longest light path of the search, where it is shorter than the scene's; `tick` is called after each
    gradient. There is one row for each item, one for the bounces, and one for all.
    """
    scene = renderer.scene
    depth = scene.max_depth if depth is None else depth
    renderers = {"": renderer if depth == scene.max_depth else renderer.like(scene.like(max_depth=depth))}
    for item in ITEMS:
        renderers[item] = renderer.like(scene.like(max_depth=depth, leave_out=EVERYTHING - {item}))
    if depth < scene.max_depth:
        renderers[BOUNCES] = renderer
    renderers[ALL] = renderer.like(scene.like(leave_out=NOTHING))
    both = seed, seeds.stream(seed, "another")
    samples = {item: Samples([], []) for item in renderers}
    for noise in both:  # the first compiles
        for item, each in renderers.items():
            with torch.no_grad():
                samples[item].pictures.append(each(u, noise, spp))
            samples[item].gradients.append(each.gradient(loss, u, noise, spp)[1])
            tick()
    times: dict[str, list[float]] = {item: [] for item in renderers}
    for number in range(repeats):
        for item, each in renderers.items():
            begun = time.perf_counter()
            each.gradient(loss, u, seeds.stream(seed, "round", number), spp)
            times[item].append(time.perf_counter() - begun)
            tick()
    for item, taken in times.items():
        samples[item].seconds = statistics.median(taken)
    lean = samples.pop("")
    return [_gain(item, lean, having) for item, having in samples.items()]


def _gain(item: str, without: Samples, having: Samples) -> GainRow:
    picture, gradient = _share(without.pictures, having.pictures), _share(without.gradients, having.gradients)
    noise, lean_noise = (float((each.pictures[1] - each.pictures[0]).norm()) for each in (having, without))
    return GainRow(
        item=item,
        what=WHAT[item],
        time_gain=((noise / lean_noise) ** 2 if lean_noise > 0.0 else 1.0) * having.seconds / without.seconds,
        picture_difference=picture,
        gradient_difference=gradient,
        safe=max(picture, gradient) <= AGREES,
        seconds=having.seconds,
    )


def _share(without: list[Tensor], having: list[Tensor]) -> float:
    """The difference at one seed over the root mean square of those that another seed makes."""
    size = math.sqrt(statistics.fmean(float((one - other).norm()) ** 2 for one, other in (without, having)))
    difference = float((having[0] - without[0]).norm())
    return difference / size if size > 0.0 else difference


def resolved_texels(renderer: Renderer, u: Tensor, *, seed: int, spp: int = 16) -> list[TexelRow]:
    """Return, for every searched texture, how its texels compare with the pixels that show them."""
    scene, rows = renderer.scene, []
    assembled = scene.assembly(renderer.space.inputs(u))
    inputs = {name: value.detach() for name, value in assembled.items() if name not in ON_PICTURE}
    for group in renderer.plan.groups:
        for name in sorted(renderer.routes.get(group.name, ())) if group.parameter == "texels" else ():
            bright, dark = ({**inputs, name: torch.full_like(inputs[name], level)} for level in (1.0, 0.0))
            difference = scene.guides(bright, seed, spp)[0] - scene.guides(dark, seed, spp)[0]
            pixels = int((difference.amax(dim=-1) > 0.0).sum())
            with scene.shorter(2):
                gradient = scene.adjoint(inputs, torch.ones(*scene.resolution, 3), seed, spp, wrt=[name])[name]
            seen, side = int((gradient.abs().amax(dim=-1) > 0.0).sum()), max(inputs[name].shape[:2])
            enough = side
            while enough > 2 and seen * (enough / 2 / side) ** 2 >= PER_PIXEL * pixels:
                enough //= 2
            rows.append(TexelRow(control=group.control, side=side, seen=seen, pixels=pixels, enough=enough))
    return rows
