"""What leaving things out brings on a scene as it is, and the proof that nothing of it changes the answer.

Each item of `advsearch.scene.leaving_out` is put back alone, then all together. The gain is the time of a gradient
with it over the time without, medians of interleaved repeats, times the same ratio of the picture's variance. The proof
is that the same seed gives the same picture and the same gradient: what differs is measured against what another seed
changes. An item that draws other random numbers may change as much as another seed does, but not more.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.engine.gradients import Loss
from advsearch.engine.transport import WORTH
from advsearch.questions.plan.answer import GainRow, TexelRow
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.leaving_out import EVERYTHING, ITEMS, NOTHING
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import predicting, why_not
from advsearch.scene.transport.renderer import SPP

ALL = "everything above"
"""Name of the row in which all items are put back together."""
BOUNCES = "bounces"
"""Name of the row in which paths have their full length."""
RENDERS = "renders"
"""Name of the row in which steps render, where a matrix of light transport predicts them."""
WHAT = {
    **ITEMS,
    BOUNCES: "bounces of light beyond the search's longest path",
    ALL: "all of these",
    RENDERS: "renders of the steps that light transport predicts",
}
"""What is left out, in words, for each row."""
AGREES = 1.2
"""Difference, as a share of what another seed changes, up to which two pictures or gradients agree: 1 is expected where
the random numbers are others."""


REPEATS = 3
"""Timed gradients of each."""


def most_gradients(repeats: int = REPEATS) -> int:
    """Return how many gradients `measured_gains` takes at most: with every item put back, with all, with all bounces
    and with none, twice to compare and then timed, and predicted ones."""
    return (2 + repeats) * (len(ITEMS) + 4)


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
    """Put back what is left out, item by item and all at once, and measure a gradient.

    Args:
        renderer: with everything left out.
        loss: what is differentiated.
        u: (d,) where.
        seed: root of the noise.
        spp: samples a pixel.
        repeats: timed gradients of each.
        depth: longest light path of the search, where it is shorter than the scene's.
        tick: called after each gradient.

    Returns:
        One row for each item, one for all, and where light transport can predict the pictures of a search one for that
            too: against a rendered gradient, with a share of the making as large as the shortest search that predicts
            has, its picture beside one of as many samples as its own.
    """
    scene = renderer.scene
    depth = scene.max_depth if depth is None else depth
    everyone = {"": renderer if depth == scene.max_depth else renderer.like(scene.like(max_depth=depth))}
    for item in ITEMS:
        everyone[item] = renderer.like(scene.like(max_depth=depth, leave_out=EVERYTHING - {item}))
    if depth < scene.max_depth:
        everyone[BOUNCES] = renderer
    everyone[ALL] = renderer.like(scene.like(leave_out=NOTHING))
    first = [_one(each, loss, u, seed, spp, tick) for each in everyone.values()]  # compiles, and compares
    again = [_one(each, loss, u, seeds.stream(seed, "another"), spp, tick) for each in everyone.values()]
    noises = [seeds.stream(seed, "round", number) for number in range(repeats)]
    rounds = [[_seconds(each, loss, u, noise, spp, tick) for each in everyone.values()] for noise in noises]
    typical = [statistics.median(times) for times in zip(*rounds, strict=True)]
    rows = [
        _row(item, (first[0], again[0], typical[0]), (first[number], again[number], typical[number]))
        for number, item in list(enumerate(everyone))[1:]
    ]
    if why_not(renderer) is None:
        both = seed, seeds.stream(seed, "another")
        predicted = [_predicted(renderer, loss, u, noise, spp, tick) for noise in both]
        seconds = statistics.fmean(one[2] for one in predicted)
        row = _row(RENDERS, (predicted[0][:2], predicted[1][:2], seconds), (first[0], again[0], typical[0]))
        with torch.no_grad():  # at few samples the denoiser's own bias is in a rendered picture
            clean, other = (renderer(u, noise, SPP) for noise in both)
        apart = _share(clean - predicted[0][0], predicted[1][0] - predicted[0][0], other - clean)
        rows.append(
            row.model_copy(update={"picture_difference": apart, "safe": max(apart, row.gradient_difference) <= AGREES})
        )
    return rows


GradientSamples = tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], float]
"""The picture and the gradient of one seed, those of another, and the seconds of a gradient."""


def _row(item: str, without: GradientSamples, having: GradientSamples) -> GainRow:
    """Compare what is found with an item and without it."""
    (first, again, seconds), (first_with, again_with, seconds_with) = without, having
    picture, gradient = (
        _share(first_with[k] - first[k], again[k] - first[k], again_with[k] - first_with[k]) for k in range(2)
    )
    noise = _ratio(again_with[0] - first_with[0], again[0] - first[0])
    return GainRow(
        item=item,
        what=WHAT[item],
        gain=noise**2 * seconds_with / seconds,
        picture_difference=picture,
        gradient_difference=gradient,
        safe=picture <= AGREES and gradient <= AGREES,
        seconds=seconds_with,
    )


def _predicted(
    renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int, tick: Callable[[], None]
) -> tuple[Tensor, Tensor, float]:
    """The picture and the gradient that light transport predicts, and the seconds of a gradient with its share of the
    making."""
    begun = time.perf_counter()
    made = predicting(renderer, u, seed)
    with torch.no_grad():
        picture = made(u, seed, spp)
    ready = time.perf_counter()
    gradient = made.gradient(loss, u, seed, spp)[1]
    seconds = time.perf_counter() - ready + (ready - begun) / WORTH
    tick()
    return picture, gradient, seconds


def _one(
    renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int, tick: Callable[[], None]
) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        picture = renderer(u, seed, spp)
    gradient = renderer.gradient(loss, u, seed, spp)[1]
    tick()
    return picture, gradient


def _seconds(renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int, tick: Callable[[], None]) -> float:
    begun = time.perf_counter()
    renderer.gradient(loss, u, seed, spp)
    tick()
    return time.perf_counter() - begun


def _share(difference: Tensor, *noises: Tensor) -> float:
    """The size of a difference over the root mean square of those that another seed makes."""
    size = math.sqrt(statistics.fmean(float(noise.norm()) ** 2 for noise in noises))
    return float(difference.norm()) / size if size > 0.0 else float(difference.norm())


def _ratio(above: Tensor, below: Tensor) -> float:
    size = float(below.norm())
    return float(above.norm()) / size if size > 0.0 else 1.0


# ---- texels ---------------------------------------------------------------------------------------------------------


PER_PIXEL = 2.0
"""Texels a pixel that `TexelRow.enough` keeps: two samples a period (Nyquist), with room for oblique views."""


def resolved_texels(renderer: Renderer, u: Tensor, *, seed: int, spp: int = 16) -> list[TexelRow]:
    """Return, for every searched texture, how its texels compare with the pixels that show them."""
    found = []
    groups = [group for group in renderer.plan.groups if group.parameter == "texels"]
    assembled = renderer.scene.assembly(renderer.space.inputs(u))
    inputs = {name: value.detach() for name, value in assembled.items() if name not in ON_PICTURE}
    for group in groups:
        for name in sorted(renderer.routes.get(group.name, ())):
            found.append(_texels(renderer.scene, group.control, name, inputs, seed, spp))
    return found


def _texels(scene: MitsubaScene, control: str, name: str, inputs: dict[str, Tensor], seed: int, spp: int) -> TexelRow:
    texture = inputs[name]
    bright, dark = ({**inputs, name: torch.full_like(texture, level)} for level in (1.0, 0.0))
    difference = scene.guides(bright, seed, spp)[0] - scene.guides(dark, seed, spp)[0]
    pixels = int((difference.amax(dim=-1) > 0.0).sum())
    with scene.shorter(2):
        gradient = scene.adjoint(inputs, torch.ones(*scene.resolution, 3), seed, spp, wrt=[name])[name]
    seen, side = int((gradient.abs().amax(dim=-1) > 0.0).sum()), max(texture.shape[:2])
    enough = side
    while enough > 2 and seen * (enough / 2 / side) ** 2 >= PER_PIXEL * pixels:
        enough //= 2
    return TexelRow(control=control, side=side, seen=seen, pixels=pixels, enough=enough)
