"""Small scenes for cases of the stability suite: a picture, its gradient beside differences, and a short search."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import Domain, Evaluation, Policy, SceneDescription, assets, gradients, results, workbench
from advsearch.questions.stability.result import Outcome, check, holds

SIZE = 24  # side of the pictures in pixels
SPP = 8  # samples a pixel of a picture and of a working gradient
REFERENCE_SPP = 64  # samples a pixel of a reference render
ERROR = 0.1  # relative error that the mean of a gradient may have beyond what its noise explains
DOUBT = 0.4  # the noise of a comparison, as a share of the derivative, from which it decides nothing
SHARPNESS = 20.0  # logits per unit of the linear loss that the searched model returns
SAME_PICTURE = 2e-3  # mean difference of two pictures that should be one: an 8-bit level is 4e-3
ControlSettings = Mapping[str, Mapping[str, object]]
Thing = str | Path | assets.ObjectAsset | Callable[[], assets.ObjectAsset]
"""What a scene shows; a function makes it when the case runs."""


def small(
    controls: ControlSettings, thing: Thing = "mug", *,
    environment: str | Path | assets.EnvironmentAsset | None = None, settings: Mapping[str, float] | None = None,
    plugins: Mapping[str, Mapping[str, object]] = MappingProxyType({}), denoise: str = "none",
) -> gradients.Renderer:  # fmt: skip
    """Return `render(u, seed, spp)` of a small image: as `Scene.renderer`, with further shapes in Mitsuba's words.

    Its differences are taken over a pixel: the losses of these cases are smooth.
    """
    shape = thing() if callable(thing) else thing
    scene = workbench.load_scene(shape, environment or plain_environment(), settings=settings)
    description = scene.description
    for name, plugin in plugins.items():
        description = description.with_part(workbench.PluginPart(name, plugin))
    renderer = replace(scene, description=description).renderer(controls, resolution=SIZE, denoise=denoise)
    renderer.plan = renderer.plan.at_a_pixel()
    return renderer


def describe_mug() -> SceneDescription:
    return workbench.load_scene("mug").description


def plain_environment() -> assets.EnvironmentAsset:
    """Return a sky brighter on one side and above, (16, 32, 3), so that turning it changes something."""
    rows, columns = np.mgrid[0:16, 0:32].astype(np.float32)
    light = 0.4 * (1.0 + 0.6 * np.sin(columns * (2.0 * np.pi / 32.0)) + 0.8 * np.cos(rows * (np.pi / 16.0)))
    return assets.EnvironmentAsset("plain", np.repeat(light[:, :, None], 3, axis=2).clip(0.05).astype(np.float32))


def grey_map(value: float, texel: float | None = None) -> assets.EnvironmentAsset:
    radiance: assets.Floats = np.full((16, 32, 3), value, np.float32)
    if texel is not None:
        radiance[4, 10] = texel
    return assets.EnvironmentAsset("made", radiance)


def mesh_of(vertices: Sequence[Sequence[float]], faces: Sequence[Sequence[int]]) -> assets.Mesh:
    """Return a mesh with UVs from x and z, whose normals face +x."""
    points = np.asarray(vertices, np.float32)
    facing = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    low, high = points.min(axis=0), points.max(axis=0)
    uvs = ((points - low) / np.maximum(high - low, 1e-12))[:, 1:]
    return assets.Mesh(points, np.asarray(faces, np.uint32), facing.astype(np.float32), uvs.astype(np.float32))


def checked(mesh: assets.Mesh) -> assets.ObjectAsset:
    """Return an object with a checked texture around a display-referred grey."""
    checks = np.indices((4, 4)).sum(axis=0) % 2
    base = np.float32(0.5) + np.float32(0.3) * (checks - np.float32(0.5))
    texels = np.repeat(base[:, :, None], 3, axis=2).clip(0.0, 1.0).astype(np.float32)
    return assets.ObjectAsset("thing", mesh, texels, assets.Material())


def painted(texels: np.ndarray) -> assets.ObjectAsset:
    grey = np.repeat(texels[:, :, None], 3, axis=2).astype(np.float32)
    return replace(describe_mug().object, name="painted", base_color=grey)


def black_and_white() -> assets.ObjectAsset:
    return painted(np.indices((8, 8)).sum(axis=0) % 2)


def dark() -> assets.ObjectAsset:
    """Return the mug in black: what moves in the picture is its outline and nothing else, so little noise."""
    return painted(np.full((4, 4), 0.02))


Range = tuple[float | None, float | None]


def seen(
    controls: ControlSettings, thing: Thing = "mug", *, u: Sequence[float] | Mapping[int, float] | None = None,
    spp: int = SPP, compare: bool = True, seeds: tuple[int, int] = (3, 12), repeats: int = 24, evaluations: int = 3,
    mean: Range | None = None, gradient: Range | None = None, ending: str = "",
    beside: Mapping[str, object] | None = None, apart: Range = (None, SAME_PICTURE), **scene: object,
) -> Outcome:  # fmt: skip
    """Render a scene, differentiate it, compare the gradient with differences, which costs most of the time, and search
    from there.

    Args:
        u: the configuration, or numbers of it in place of those of the start.
        mean, gradient, ending: what the picture's mean, the largest entry of the gradient and the search's ending have
            to be.
        beside: the arguments of `small` for another scene, and `apart` the mean difference that its picture may have.
        scene: further arguments of `small`.
    """
    renderer = small(controls, thing, **scene)  # type: ignore[arg-type]
    at = renderer.start.clone()
    for index, value in u.items() if isinstance(u, Mapping) else enumerate(u or ()):
        at[index] = value
    loss = gradients.smooth_loss(renderer.formation.resolution)
    picture = shown(renderer, at, 0, spp)
    _, slope = renderer.gradient(loss, at, 0, spp)
    finite = bool(torch.isfinite(picture).all()) and bool(torch.isfinite(slope).all())
    rows = compared(renderer, at, spp=spp, seeds=seeds, repeats=repeats) if compare else []
    # a linear model of two classes: its logits are 0, and so many times the rise of the loss over the start, less 1
    here, domain = float(loss(shown(renderer, at, 0, spp))), search_domain(renderer, at)
    rise = lambda image: SHARPNESS * (loss(image) - here) - 1.0  # noqa: E731
    steps = evaluations * (1 + domain.gradient_cost) + 1
    result = searched(renderer, rise, steps, spp=spp, start=at, candidates=1, repeats=1)
    checks = [
        holds("the picture is in [0, 1]", float(picture.min()) >= 0.0 and float(picture.max()) <= 1.0),
        check("values that were NaN or infinite", float(renderer.non_finite), 0.0, 0.0),
        check("objectives that were NaN or infinite", float(result.non_finite_objectives), 0.0, 0.0),
    ]
    worst = max(rows, key=lambda row: (row.excess, row.bias or 0.0), default=None)
    if worst is not None:
        unsure = max(rows, key=lambda row: row.doubt or 0.0)
        checks.append(check(f"noise of the comparison, {unsure.name}", unsure.doubt or 0.0, most=DOUBT))
        checks.append(check(f"gradient error beyond the noise, {worst.name}", worst.excess, most=ERROR))
    measured = {"mean": float(picture.mean()), "largest gradient": float(slope.abs().max())}
    if mean is not None:
        checks.append(check("mean of the picture", measured["mean"], *mean))
    if gradient is not None:
        checks.append(check("largest gradient", measured["largest gradient"], *gradient))
    if ending:
        checks.append(holds(f"the ending is {ending!r}", result.ending.value == ending))
    if beside is not None:
        other = small(**{"controls": controls, **beside})  # type: ignore[arg-type]
        difference = float((shown(renderer, at) - shown(other, other.start)).abs().mean())
        checks.append(check("mean difference from the picture beside it", difference, *apart))
    finite = finite and renderer.non_finite == 0
    return Outcome(checks, finite, worst.bias if worst else None, result.ending.value, measured)


def shown(renderer: gradients.Renderer, u: Tensor, seed: int = 0, spp: int = 16) -> Tensor:
    with torch.no_grad():
        return renderer(u, seed, spp)


def compared(
    renderer: gradients.Renderer, u: Tensor, *, spp: int = SPP, seeds: tuple[int, int] = (3, 12), repeats: int = 24
) -> list[results.Measured]:
    """Compare the plan's own gradient with common-random-number differences, of a linear loss of the raw picture."""
    before = renderer.formation
    renderer.formation = replace(before, transfer="linear")
    try:
        bench = gradients.Bench(renderer, gradients.smooth_loss(before.resolution), u, seed=1, spp=spp)
        rows = gradients.measure_derivatives(
            bench, reference_spp=REFERENCE_SPP, seeds_of_reference=seeds, repeats=(repeats, repeats)
        )
        return list(rows)
    finally:
        renderer.formation = before


def inward(
    renderer: gradients.Renderer, slope: Tensor, of: Tensor | float, seeds: int, spp: int
) -> tuple[float, float]:
    """Return the derivative of the smooth linear loss of the raw picture as numbers go inwards from the start that
    raise it so, where `of` is 1: by a gradient (d,), and by one-sided differences of second order, since there is no
    other side at a bound."""
    raw, u, step = renderer.like(transfer="linear"), renderer.start, 0.04
    loss = gradients.smooth_loss(raw.formation.resolution)
    direction = torch.where(u > 0.5, -1.0, 1.0) * (slope * (0.5 - u) > 0.0) * of
    wanted = []
    for seed in range(seeds):
        here, near, far = (float(loss(shown(raw, u + k * step * direction, seed, spp))) for k in range(3))
        wanted.append((4.0 * near - 3.0 * here - far) / (2.0 * step))
    return float(slope @ direction), math.fsum(wanted) / seeds


def evaluated(renderer: gradients.Renderer, loss: gradients.Loss, spp: int, query: workbench.Query) -> Evaluation:
    """Evaluate a configuration by a loss of the picture; over 0 is a success."""
    u, seed, spp, derivative = query.u, query.number, spp * query.samples, None
    bad, renders = renderer.non_finite, renderer.renders
    if query.gradient:
        value, derivative = renderer.gradient(loss, u, seed, spp, free=query.gradient == "free")
    else:
        value = loss(shown(renderer, u, seed, spp))
    cost = (renderer.renders - renders) * query.samples
    return Evaluation(float(value), derivative, float(value) > 0.0, renderer.non_finite - bad, cost)


def searched(
    renderer: gradients.Renderer, loss: gradients.Loss, steps: int, *, spp: int = SPP, start: Tensor | None = None,
    policy: Policy[Any] | None = None, **more: Any,
) -> workbench.SearchResult:  # fmt: skip
    """Search for a picture of a loss over 0."""
    evaluate, domain = partial(evaluated, renderer, loss, spp), search_domain(renderer, start)
    policy = policy or workbench.make_policy("pgd")
    return workbench.search(partial(map, evaluate), domain, policy, steps=steps, seed=0, **{"candidates": 0, **more})


def search_domain(renderer: gradients.Renderer, start: Tensor | None = None) -> Domain:
    space: Any = renderer.space  # of controls, since `small` made it
    start = renderer.start if start is None else start
    return workbench.domain_of(space.controls, start, gradient_cost=renderer.plan.renders, partial_gradients=True)
