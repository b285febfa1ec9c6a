"""Small scenes for cases: an image, its gradient compared with finite differences, and
a search.
"""

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

from advsearch.extend import (
    Policy,
    SceneDescription,
    assets,
    gradients,
    policies,
    results,
    workbench,
)
from advsearch.questions.stability.result import (
    CaseOutcome,
    Check,
    check_condition,
    check_range,
)

# width and height of images, pixels
IMAGE_SIZE = 24
# samples per pixel of images and of the gradients of a search
SPP = 8
# samples per pixel of images and gradients that others are compared with
REFERENCE_SPP = 64
# maximum relative error of the mean of a gradient that its noise does not explain
MAX_GRADIENT_ERROR = 0.1
# maximum noise of a comparison, as a fraction of the derivative; with more it is
# useless
MAX_NOISE = 0.4
# logits of the searched model per unit of the linear loss
LOGIT_SCALE = 20.0
# maximum mean difference of two images that should be equal; an 8-bit level is 4e-3
MAX_PICTURE_DIFFERENCE = 2e-3
ControlSettings = Mapping[str, Mapping[str, object]]
ObjectSource = str | Path | assets.ObjectAsset | Callable[[], assets.ObjectAsset]
"""The object of a scene; a function is called when the case runs."""


def make_renderer(
    controls: ControlSettings,
    thing: ObjectSource = "mug",
    *,
    environment: str | Path | assets.EnvironmentAsset | None = None,
    settings: Mapping[str, float] | None = None,
    plugins: Mapping[str, Mapping[str, object]] = MappingProxyType({}),
    denoise: str = "none",
) -> gradients.Renderer:
    """Return a renderer of a small image, which is called as `render(u, seed, spp)`.

    Parameters whose derivatives are finite differences get a derivative for each pixel,
    and not only one of the loss. The loss may then be any smooth function of the image.

    Args:
        controls: controls that vary, with their settings.
        thing: the object, the name of one, or a function that makes it.
        environment: environment of the scene; None for a plain one.
        settings: settings of the scene.
        plugins: further shapes, as Mitsuba's dictionaries by name.
        denoise: the denoiser.
    """
    object_source = thing() if callable(thing) else thing
    scene = workbench.load_scene(
        object_source, environment or make_plain_environment(), settings=settings
    )
    description = scene.description
    for name, plugin in plugins.items():
        description = description.with_part(workbench.PluginPart(name, plugin))
    renderer = replace(scene, description=description).renderer(
        controls, resolution=IMAGE_SIZE, denoise=denoise
    )
    # What is differentiated by finite differences gets them for each pixel.
    renderer.plan = renderer.plan.with_pixel_steps()
    return renderer


def describe_mug() -> SceneDescription:
    """Return the description of the bundled mug in the default scene."""
    return workbench.load_scene("mug").description


def make_plain_environment() -> assets.EnvironmentAsset:
    """Return a sky (16, 32, 3), brighter above and, to show rotations, on one side."""
    rows, columns = np.mgrid[0:16, 0:32].astype(np.float32)
    azimuthal = 0.6 * np.sin(columns * (2.0 * np.pi / 32.0))
    vertical = 0.8 * np.cos(rows * (np.pi / 16.0))
    light = 0.4 * (1.0 + azimuthal + vertical)
    radiance = np.repeat(light[:, :, None], 3, axis=2).clip(0.05).astype(np.float32)
    return assets.EnvironmentAsset("plain", radiance)


def make_gray_environment(
    value: float, texel: float | None = None
) -> assets.EnvironmentAsset:
    """Return a gray environment map, with one texel of another value.

    Args:
        value: radiance of the map.
        texel: radiance of the texel, which is in the upper half; None for `value`.
    """
    radiance: assets.Float32Array = np.full((16, 32, 3), value, np.float32)
    if texel is not None:
        radiance[4, 10] = texel
    return assets.EnvironmentAsset("made", radiance)


def make_mesh(
    vertices: Sequence[Sequence[float]], faces: Sequence[Sequence[int]]
) -> assets.Mesh:
    """Return a mesh whose normals face +x, with UVs from y and z.

    Args:
        vertices: points (x, y, z), near a plane of constant x.
        faces: three indices of vertices for each face.
    """
    points = np.asarray(vertices, np.float32)
    facing = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    low = points.min(axis=0)
    high = points.max(axis=0)
    uvs = ((points - low) / np.maximum(high - low, 1e-12))[:, 1:]
    return assets.Mesh(
        points,
        np.asarray(faces, np.uint32),
        facing.astype(np.float32),
        uvs.astype(np.float32),
    )


def make_checkered_object(mesh: assets.Mesh) -> assets.ObjectAsset:
    """Return an object with a checkered texture (4, 4): 0.35 and 0.65, in sRGB."""
    is_light = np.indices((4, 4)).sum(axis=0) % 2  # 0 or 1
    gray = np.float32(0.5) + np.float32(0.3) * (is_light - np.float32(0.5))
    texels = np.repeat(gray[:, :, None], 3, axis=2).clip(0.0, 1.0).astype(np.float32)
    return assets.ObjectAsset("thing", mesh, texels, assets.Material())


def paint_mug(texels: np.ndarray) -> assets.ObjectAsset:
    """Return the mug with a gray texture (H, W)."""
    base_color = np.repeat(texels[:, :, None], 3, axis=2).astype(np.float32)
    return replace(describe_mug().object, name="painted", base_color=base_color)


def make_checkered_mug() -> assets.ObjectAsset:
    """Return the mug with a checkered texture (8, 8) of black and white."""
    return paint_mug(np.indices((8, 8)).sum(axis=0) % 2)


def make_dark_mug() -> assets.ObjectAsset:
    """Return the mug in black.

    Only its outline changes in the picture, with little noise.
    """
    return paint_mug(np.full((4, 4), 0.02))


# lower and upper bound of a number; None for no bound
Bounds = tuple[float | None, float | None]


def check_scene(
    controls: ControlSettings,
    thing: ObjectSource = "mug",
    *,
    u: Sequence[float] | Mapping[int, float] | None = None,
    spp: int = SPP,
    compare: bool = True,
    seeds: tuple[int, int] = (3, 12),
    repeats: int = 24,
    evaluations: int = 3,
    mean: Bounds | None = None,
    gradient: Bounds | None = None,
    ending: str = "",
    other_scene: Mapping[str, object] | None = None,
    difference: Bounds = (None, MAX_PICTURE_DIFFERENCE),
    **scene: object,
) -> CaseOutcome:
    """Render a scene, differentiate it, and search from there.

    It is always checked that the image is in [0, 1], and that nothing is NaN or
    infinite. With `compare`, the gradient is compared with finite differences, which
    takes most of the time. Bounds that are passed are checked, too.

    Args:
        controls: settings of the controls.
        thing: the object, the name of one, or a function that makes it.
        u: the configuration (d,), or some of its values by index. Values that are not
            passed are those of the start.
        spp: samples per pixel.
        compare: whether to compare the gradient with finite differences.
        seeds: minimum and maximum number of seeds of the finite differences, which are
            the reference.
        repeats: number of gradients, each with other noise, that are compared with it.
        evaluations: number of evaluations of the search.
        mean: bounds of the image's mean.
        gradient: bounds of the largest absolute entry of the gradient.
        ending: expected status of the search; empty expects none.
        other_scene: arguments of `make_renderer` for a second scene, whose image is
            compared with the first; None for no comparison. The controls are those of
            the first scene unless they are passed; the rest has its default values.
        difference: bounds of the mean absolute difference of both images.
        **scene: further arguments of `make_renderer` for the first scene.
    """
    renderer = make_renderer(controls, thing, **scene)  # type: ignore[arg-type]
    start = _replace_start_values(u, renderer)
    loss = gradients.make_smooth_loss(renderer.formation.resolution)
    image = render_image(renderer, start, seed=0, spp=spp)
    _, loss_gradient = renderer.gradient(loss, start, 0, spp)  # 0 is the seed
    compared = list[results.Measured]()
    if compare:
        compared = compare_gradient(
            renderer, start, spp=spp, seeds=seeds, repeats=repeats
        )
    gradient_checks, relative_error = _check_gradient(compared)
    result = search_scene(renderer, loss, start, spp, evaluations)
    measured = {
        "mean": float(image.mean()),
        "largest gradient": float(loss_gradient.abs().max()),
    }
    checks = [
        *_check_finite(renderer, image, result),
        *gradient_checks,
        *_check_bounds(measured, mean, gradient),
        *_check_ending(result, ending),
    ]
    if other_scene is not None:
        other_renderer = _make_other_renderer(controls, other_scene)
        checks.append(_compare_images(renderer, start, other_renderer, difference))
    return CaseOutcome(
        checks,
        # The renderer replaces and counts values of images that are not finite.
        finite=_are_finite(image, loss_gradient) and renderer.n_non_finite == 0,
        relative_error=relative_error,
        ending=result.ending.value,
        measurements=measured,
    )


def _make_other_renderer(
    controls: ControlSettings, other_scene: Mapping[str, object]
) -> gradients.Renderer:
    """Make the renderer of a second scene, which has the same controls by default."""
    arguments: dict[str, Any] = {"controls": controls, **other_scene}
    return make_renderer(**arguments)


def _are_finite(image: Tensor, gradient: Tensor) -> bool:
    """Return whether no number of an image and of a gradient is NaN or infinite."""
    return bool(torch.isfinite(image).all() and torch.isfinite(gradient).all())


def _check_ending(search: workbench.SearchResult, expected: str) -> list[Check]:
    """Check the status of a search; no check if none is expected."""
    if not expected:
        return []
    is_expected = search.ending.value == expected
    return [check_condition(f"the ending is {expected!r}", is_expected)]


def _check_finite(
    renderer: gradients.Renderer, image: Tensor, search: workbench.SearchResult
) -> list[Check]:
    """Check that an image is in [0, 1], and nothing was NaN or infinite.

    Args:
        renderer: renderer, which has counted the values that were not finite.
        image: image of the start.
        search: result of the search, with its objectives that were not finite.
    """
    in_range = float(image.min()) >= 0.0 and float(image.max()) <= 1.0
    n_non_finite = float(renderer.n_non_finite)
    n_objectives = float(search.non_finite_objectives)
    return [
        check_condition("the picture is in [0, 1]", in_range),
        check_range("values that were NaN or infinite", n_non_finite, 0.0, 0.0),
        check_range("objectives that were NaN or infinite", n_objectives, 0.0, 0.0),
    ]


def _check_bounds(
    measured: Mapping[str, float], mean: Bounds | None, gradient: Bounds | None
) -> list[Check]:
    """Check the mean of the image, and the largest entry of the gradient.

    Args:
        measured: both numbers, "mean" and "largest gradient".
        mean, gradient: bounds of these numbers; None for no check.
    """
    checks = []
    if mean is not None:
        checks.append(check_range("mean of the picture", measured["mean"], *mean))
    if gradient is not None:
        checks.append(
            check_range("largest gradient", measured["largest gradient"], *gradient)
        )
    return checks


def _replace_start_values(
    u: Sequence[float] | Mapping[int, float] | None, renderer: gradients.Renderer
) -> Tensor:
    """Return the start (d,) with some or all of its values replaced.

    u: new values by index, or the first values; None replaces none.
    renderer: renderer with the start.
    """
    start: Tensor = renderer.start.clone()
    value_of_index = u if isinstance(u, Mapping) else dict(enumerate(u or ()))
    for index, value in value_of_index.items():
        start[index] = value
    return start


def _compare_images(
    renderer: gradients.Renderer,
    start: Tensor,
    other: gradients.Renderer,
    bounds: Bounds,
) -> Check:
    """Check the mean difference of an image from that of another scene's start.

    Args:
        renderer, start: renderer and configuration of the first image.
        other: renderer of the second image, at its own start.
        bounds: lower and upper bound of the mean absolute difference.
    """
    difference = compute_mean_difference(
        render_image(renderer, start), render_image(other, other.start)
    )
    return check_range(
        "mean difference from the picture beside it", difference, *bounds
    )


def _check_gradient(
    rows: Sequence[results.Measured],
) -> tuple[list[Check], float | None]:
    """Check noise and error of derivatives that were compared with finite differences.

    One check is for the derivative with the largest noise, another for the one with the
    largest error. Without derivatives there are no checks.

    Args:
        rows: the compared derivatives. `bias` is the relative error of the mean
            derivative, `doubt` the noise of the comparison relative to the derivative,
            and `excess` the error beyond what the noise explains.

    Returns:
        The checks, and the relative error of the derivative with the largest error.
    """
    if not rows:
        return [], None
    # `excess` is often 0 for several rows: then `bias` decides.
    worst = max(rows, key=lambda row: (row.excess, row.bias or 0.0))
    noisiest = max(rows, key=lambda row: row.doubt or 0.0)
    noise_name = f"noise of the comparison, {noisiest.name}"
    error_name = f"gradient error beyond the noise, {worst.name}"
    checks = [
        check_range(noise_name, noisiest.doubt or 0.0, max_value=MAX_NOISE),
        check_range(error_name, worst.excess, max_value=MAX_GRADIENT_ERROR),
    ]
    return checks, worst.bias


def search_scene(
    renderer: gradients.Renderer,
    loss: gradients.Loss,
    start: Tensor,
    spp: int,
    evaluations: int,
) -> workbench.SearchResult:
    """Search from a configuration by the margin of a linear model of two classes.

    A search maximizes the margin and stops above 0. Here the margin is LOGIT_SCALE *
    (loss - loss at the start) - 1. So it is -1 at the start, and above 0 once the loss
    has increased by 1 / `LOGIT_SCALE`.

    Args:
        renderer: renderer of the scene.
        loss: loss of an image.
        start: (d,) configuration.
        spp: samples per pixel.
        evaluations: number of evaluations with gradients that the search makes.
    """
    loss_at_start = float(loss(render_image(renderer, start, seed=0, spp=spp)))
    # number of renders that a gradient takes in addition to the image
    gradient_cost = make_domain(renderer, start).gradient_cost

    def margin(image: Tensor) -> Tensor:
        return LOGIT_SCALE * (loss(image) - loss_at_start) - 1.0

    # Steps count renders: each evaluation takes the image and those of its gradient.
    # One step is left for an image without a gradient.
    steps = evaluations * (1 + gradient_cost) + 1
    # The smallest search that also verifies its result: one candidate is rendered again
    # once.
    return run_search(
        renderer, margin, steps, spp=spp, start=start, candidates=1, repeats=1
    )


def render_image(
    renderer: gradients.Renderer, u: Tensor, seed: int = 0, spp: int = 16
) -> Tensor:
    """Render the image (H, W, 3) of a configuration (d,), without a graph."""
    with torch.no_grad():
        return renderer(u, seed, spp)


def compute_mean_difference(image: Tensor, other: Tensor) -> float:
    """Return the mean absolute difference of two images."""
    return float((image - other).abs().mean())


def compare_gradient(
    renderer: gradients.Renderer,
    u: Tensor,
    *,
    spp: int = SPP,
    seeds: tuple[int, int] = (3, 12),
    repeats: int = 24,
) -> list[results.Measured]:
    """Compare a renderer's gradient of a smooth linear loss with finite differences.

    The finite differences are between renders with the same random numbers, so that
    their noise mostly cancels.

    Args:
        renderer: renderer of the scene; while it is measured, its image formation has
            no tone curve.
        u: the configuration (d,).
        spp: samples per pixel of the gradients.
        seeds: minimum and maximum number of seeds of the differences.
        repeats: number of gradients that are compared.
    """
    formation = renderer.formation
    loss = gradients.make_smooth_loss(formation.resolution)
    bench = gradients.Bench(renderer, loss, u, seed=1, spp=spp)
    # This renderer is changed for a while, instead of a copy, since the caller reads its
    # count of values that are not finite.
    renderer.formation = replace(formation, transfer="linear")
    try:
        rows = gradients.measure_derivatives(
            bench,
            reference_spp=REFERENCE_SPP,
            reference_repeats=seeds,
            repeats=(repeats, repeats),  # minimum and maximum number
        )
        return list(rows)
    finally:
        renderer.formation = formation


def measure_inward_slope(
    renderer: gradients.Renderer,
    gradient: Tensor,
    factor: Tensor | float,
    seeds: int,
    spp: int,
) -> tuple[float, float]:
    """Return the derivative of the smooth linear loss along a direction inwards.

    All values of the start have to be at a bound of their range, 0 or 1, so that they
    can move inwards only. The direction has the values whose move inwards increases the
    loss; all other values stay.

    Args:
        renderer: renderer of the scene.
        gradient: (d,) gradient of the loss at the start.
        factor: factor of the direction, for all values or for each, (d,).
        seeds: number of seeds over which the finite differences are averaged.
        spp: samples per pixel.

    Returns:
        The derivative from the gradient, and the derivative from one-sided finite
        differences of second order, since a bound has no other side.
    """
    linear = renderer.copy_with(transfer="linear")
    u = renderer.start
    inwards = torch.where(u > 0.5, -1.0, 1.0)  # down from 1, up from 0
    increases_loss = gradient * (0.5 - u) > 0.0  # 0.5 - u points inwards, too
    direction = inwards * increases_loss * factor
    loss = gradients.make_smooth_loss(linear.formation.resolution)

    def compute_loss(seed: int, configuration: Tensor) -> float:
        """Return the loss at a configuration (d,), with the noise of a seed."""
        return float(loss(render_image(linear, configuration, seed, spp)))

    slopes = [
        _compute_forward_slope(partial(compute_loss, seed), u, direction)
        for seed in range(seeds)
    ]
    return float(gradient @ direction), math.fsum(slopes) / seeds


def _compute_forward_slope(
    value: Callable[[Tensor], float], u: Tensor, direction: Tensor
) -> float:
    """Compute the derivative of a value by a forward difference of second order.

    Args:
        value: function of the configuration.
        u: (d,) the configuration.
        direction: (d,) direction of the derivative.
    """
    step = 0.04  # in units of the range, small but above the noise
    # values at the bound, and one and two steps from it
    at_0, at_1, at_2 = (value(u + count * step * direction) for count in range(3))
    # f'(0) = (4 f(h) - 3 f(0) - f(2h)) / (2h) + O(h^2)
    return (4.0 * at_1 - 3.0 * at_0 - at_2) / (2.0 * step)


def evaluate(
    renderer: gradients.Renderer, loss: gradients.Loss, spp: int, query: workbench.Query
) -> policies.Evaluation:
    """Evaluate a configuration by a loss of the image; a loss above 0 is a success.

    The `row_index` of the query is the seed of the noise. The cost is the number of
    renders with `spp` samples.

    Args:
        renderer: renderer of the scene.
        loss: loss of the image.
        spp: samples per pixel.
        query: the query, which may request a multiple of the samples.
    """
    query_spp = spp * query.samples
    non_finite_before = renderer.n_non_finite
    renders_before = renderer.n_renders
    gradient = None
    if query.gradient:
        # `query.gradient` is True or "free". The latter requests only derivatives that
        # cost no further render.
        value, gradient = renderer.gradient(
            loss, query.u, query.row_index, query_spp, free=query.gradient == "free"
        )
    else:
        value = loss(render_image(renderer, query.u, query.row_index, query_spp))
    objective = float(value)
    return policies.Evaluation(
        objective=objective,
        gradient=gradient,
        success=objective > 0.0,
        n_non_finite=renderer.n_non_finite - non_finite_before,
        # Each render has `query.samples` times `spp` samples.
        cost=(renderer.n_renders - renders_before) * query.samples,
    )


def run_search(
    renderer: gradients.Renderer,
    loss: gradients.Loss,
    steps: int,
    *,
    spp: int = SPP,
    start: Tensor | None = None,
    policy: Policy[Any] | None = None,
    **options: Any,
) -> workbench.SearchResult:
    """Search for an image with a loss above 0.

    Args:
        renderer: renderer of the scene.
        loss: loss of the image, which is maximized.
        steps: steps of the search.
        spp: samples per pixel.
        start: the first configuration (d,); None takes the start of the renderer.
        policy: policy of the search; None takes "pgd".
        **options: options of `attacks.search`. By default no candidate is rendered
            again.
    """
    evaluate_query = partial(evaluate, renderer, loss, spp)
    evaluate_all = partial(map, evaluate_query)  # called with the queries
    return workbench.search(
        evaluate_all,
        make_domain(renderer, start),
        policy or workbench.make_policy("pgd"),
        steps=steps,
        seed=0,
        **{"candidates": 0, **options},
    )


def make_domain(
    renderer: gradients.Renderer, start: Tensor | None = None
) -> policies.Domain:
    """Return the domain of a search.

    Args:
        renderer: renderer of the scene.
        start: configuration (d,) at which the search starts; None takes that of the
            renderer.
    """
    # `make_renderer` has made a space of controls; the type of `space` is more general.
    space: Any = renderer.space
    start = renderer.start if start is None else start
    return workbench.make_domain(
        space.controls,
        start,
        gradient_cost=renderer.plan.renders,  # renders that a gradient takes
        partial_gradients=True,  # `evaluate` also handles "free" gradients
    )
