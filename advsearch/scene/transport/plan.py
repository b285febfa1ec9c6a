"""Which spaces have pictures that can be predicted, by what, and at what cost."""

from __future__ import annotations

from collections.abc import Callable, Collection

from torch import Tensor

from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import BasisRenderer, Lights, fixed_lights, light_inputs, lighting
from advsearch.scene.transport.renderer import SPP, LinearRenderer, PredictingRenderer, linear_inputs, passes

HAZE = "there is haze"
NOISE = "noise is part of the picture without the denoiser"
"""Reasons that stand alone: without haze, or with the denoiser, pictures of the same space could be predicted."""


def why_not(renderer: Renderer, varying: Collection[str] = ()) -> str | None:
    """Why pictures of a renderer's space cannot be predicted, in words; None if they can.

    Args:
        varying: names of controls that stand still for each matrix, whatever they change. Beside them light may not
            move.
    """
    plan, linear = renderer.plan, linear_inputs(renderer)
    searched = [group for group in plan.groups if group.control not in varying]
    lit = {} if varying else lighting(renderer).groups
    for group in searched:
        if "forced" in group.reason and group.estimator not in ("none", "image"):
            return f"the estimator of {group.name} is forced"
        if group.estimator == "image" or group.name in lit or _of_haze(renderer, group.name):
            continue
        if renderer.routes.get(group.name, frozenset()) & light_inputs(renderer) and fixed_lights(renderer):
            return f"{group.name} changes light, and the scene has other lights of its own"
        if group.estimator != "adjoint" or not renderer.routes.get(group.name, frozenset()) <= linear:
            return f"{group.name} changes more than base colours{'' if varying else ' and light'}"
    if not any(renderer.routes.get(group.name) or lit.get(group.name) for group in searched):
        return "nothing that is searched needs a render to be differentiated"
    if renderer.scene.volumetric and not all(group.name in lit for group in searched):
        return HAZE
    return None if renderer.formation.denoiser == "oidn" else NOISE


def _of_haze(renderer: Renderer, group: str) -> bool:
    """Whether a group of coordinates changes haze alone."""
    hazes = tuple(f"{part.name}." for part in renderer.scene.made[0].parts if part.volumetric)
    inputs = renderer.routes.get(group, frozenset())
    return bool(inputs) and all(name.startswith(hazes) for name in inputs)


def predicting(
    renderer: Renderer, u: Tensor, seed: int, tick: Callable[[int], None] = lambda samples: None
) -> PredictingRenderer:
    """Return what predicts the pictures of a renderer's space, made at u; arguments as for `LinearRenderer`."""
    moving = lighting(renderer)
    if moving.moved:
        return BasisRenderer(renderer, u, seed, tick, moving=moving)
    return LinearRenderer(renderer, u, seed, tick)


def lights_to_collect(renderer: Renderer) -> int:
    """The lights that a basis picture, or a matrix, is made of; 1 where no light moves."""
    moving = lighting(renderer)
    inputs = renderer.scene.assembly(renderer.space.inputs(renderer.start))
    return len(Lights(renderer, moving, inputs).alone) if moving.moved else 1


def samples_to_collect(renderer: Renderer) -> int:
    """Samples a pixel that are traced before anything can be predicted."""
    inputs = {name for group in renderer.plan.groups for name in renderer.routes.get(group.name, ())}
    matrices = len(inputs & linear_inputs(renderer))
    samples, count = passes(renderer, SPP)
    return lights_to_collect(renderer) * (samples * count * matrices if matrices else SPP)
