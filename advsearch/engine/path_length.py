"""How many bounces of light a search needs: what each one adds to the picture, measured on the scene at hand.

Renders of other path lengths with the same seed draw the same paths, cut off earlier, so that their difference is the
light of the bounces left out, almost without noise. A search may leave out what the eye could not see; a verification
leaves out nothing, so that no answer rests on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.runs.results.derivatives import PathCut, PathLength
from advsearch.scene.renderer import Renderer

SHORTEST = 2
"""Segments of the shortest path tried: light that reaches the camera from a surface that it falls on directly."""
BOUND = 0.5
"""Root-mean-square change of the displayed picture, in 8-bit levels, that a search accepts."""
LEVELS = 255.0


def measured_bounces(
    renderer: Renderer,
    configurations: Sequence[Tensor],
    *,
    seed: int,
    spp: int,
    bound: float = BOUND,
    tick: Callable[[], None] = lambda: None,
) -> PathLength:
    """Return the shortest paths whose pictures agree with those of the full length to within a bound.

    Args:
        renderer: at the full length.
        configurations: where to look, each (d,).
        seed: root of the noise, which is the same for all lengths.
        spp: samples a pixel of each of two halves; few are enough.
        bound: in 8-bit levels, see `PathCut.levels`.
        tick: called after each picture.

    Returns:
        The depth, with what was measured: from the full length downwards, to the first that misses the bound.
    """
    raw = renderer.like(denoiser="none")  # a denoiser would spread a change over its neighbours
    full = raw.scene.max_depth
    noises = [seeds.stream(seed, "half", half) for half in range(2)]

    def pictures(u: Tensor, depth: int) -> list[tuple[Tensor, Tensor]]:
        rendered = []
        for noise in noises:
            rendered.append(_pictures(raw, u, noise, spp, depth))
            tick()
        return rendered

    wholes = [pictures(u, full) for u in configurations]
    cuts, chosen = [], full
    for depth in range(full - 1, SHORTEST - 1, -1):
        light = levels = 0.0
        for u, whole in zip(configurations, wholes, strict=True):
            cut = pictures(u, depth)
            light = max(light, _missing(whole, cut))
            levels = max(levels, LEVELS * _bias(whole, cut))
        cuts.append(PathCut(depth=depth, light=light, levels=levels))
        if not levels <= bound:
            break
        chosen = depth
    reason = _reason(chosen, full, {cut.depth: cut for cut in cuts})
    return PathLength(depth=chosen, full=full, cuts=cuts, configurations=len(configurations), reason=reason)


def _reason(depth: int, full: int, cuts: Mapping[int, PathCut]) -> str:
    """Why a search renders paths of this length, by what cuts at other lengths leave out."""
    said = []
    if depth < full:
        cut = cuts[depth]
        said.append(
            f"paths of {depth} segments leave out {cut.light:.2%} of the light, which moves the picture by "
            f"{cut.levels:.2f} of 255 levels (bound {BOUND:g})"
        )
    if depth - 1 in cuts:
        rejected = cuts[depth - 1]
        said.append(f"{rejected.depth} would leave out {rejected.light:.2%} and move it by {rejected.levels:.2f}")
    return "; ".join(said) or f"all {full} segments"


def _missing(whole: Sequence[tuple[Tensor, Tensor]], cut: Sequence[tuple[Tensor, Tensor]]) -> float:
    """The share of the radiance that is missing."""
    full = sum(float(radiance.mean()) for radiance, _ in whole)
    return 1.0 - sum(float(radiance.mean()) for radiance, _ in cut) / full if full > 0.0 else 0.0


def _bias(whole: Sequence[tuple[Tensor, Tensor]], cut: Sequence[tuple[Tensor, Tensor]]) -> float:
    """The root-mean-square bias: the product of two independent differences has no noise in its mean."""
    first, second = (one[1] - other[1] for one, other in zip(whole, cut, strict=True))
    return float((first * second).mean().clamp_min(0.0).sqrt())


def _pictures(renderer: Renderer, u: Tensor, seed: int, spp: int, depth: int) -> tuple[Tensor, Tensor]:
    """Radiance and displayed picture."""
    with torch.no_grad(), renderer.scene.shorter(depth):
        radiance = renderer.radiance(u, seed, spp)
        return radiance, renderer.space.picture(u, renderer.formation.display(radiance))
