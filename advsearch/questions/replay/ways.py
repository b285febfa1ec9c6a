"""The conditions under which an answer is rendered again: other pictures of the same configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from advsearch.controls.corruption.digital import coded
from advsearch.controls.sensor import SensorControl, through_sensor
from advsearch.engine.problem import Problem
from advsearch.engine.retrial import RetrialCondition, unchanged
from advsearch.scene.exporting.cycles import BlenderError, Cycles
from advsearch.scene.renderer import MAX_SPP

OWN = "as verified"
"""The way in which nothing is changed."""

OWN_LIGHT = "own"
"""What conditions share whose pictures come of the radiance that the run itself would render."""

QUALITIES = (90, 75, 50)
"""Of JPEG files."""

SENSORS: dict[str, dict[str, float]] = {
    "a good camera": {"shot": 0.02, "read": 0.005, "mosaic": 1.0},
    "a phone in a dim room": {
        "shot": 0.08, "read": 0.02, "mosaic": 1.0, "aberration": 0.002, "red": 0.1, "blue": -0.1, "compression": 25.0,
    },
}  # fmt: skip
"""Values of the control `sensor`, by what they stand for; those that are not named are 0."""

CURVES = {"gamma": "a power of 1/2.2 in place of sRGB", "reinhard": "highlights rolled off, x / (1 + x)"}
"""Other tone curves, by `ImageFormation.transfer`."""

SHORT, LONG = 2, 16
"""Longest light paths in segments: direct light alone, and far more than a run renders."""


@dataclass(frozen=True)
class Way:
    """One condition of a replay.

    Attributes:
        name: what is changed.
        condition: it is made anew each time, and holds a scene of its own where it has to.
        text: to what.
        missing: why it cannot be had; empty where it can.
        shares: whether it takes the radiance of the first condition, so that it costs no renders beside that.
    """

    name: str
    condition: Callable[[], RetrialCondition]
    text: str
    missing: str = ""
    shares: bool = False


def ways_of(problem: Problem, spp: int, sized: Callable[[tuple[int, int]], Problem]) -> Iterator[Way]:
    """Yield every condition of a problem's answer but other models; the first changes nothing.

    Args:
        problem: as the run had it.
        spp: samples a pixel of its verification.
        sized: makes the same problem at another (height, width) in pixels.
    """
    renderer = problem.renderer
    scene, formation = renderer.scene, renderer.formation

    def same(
        count: int = spp, change: Callable[[Tensor, int], Tensor] = unchanged
    ) -> Callable[[str], RetrialCondition]:
        return lambda name: RetrialCondition(name, problem, count, OWN_LIGHT, change, OWN_LIGHT)

    def other(**made: object) -> Callable[[str], RetrialCondition]:
        def condition(name: str) -> RetrialCondition:
            changed = renderer.like(scene.like(**made), **({"sampler": made["sampler"]} if "sampler" in made else {}))
            return RetrialCondition(name, replace(problem, renderer=changed), spp, name)

        return condition

    def formed(light: str | None = None, **fields: Any) -> Callable[[str], RetrialCondition]:
        changed = replace(problem, renderer=renderer.like(**fields))
        return lambda name: RetrialCondition(name, changed, spp, name, light=light)

    def at(size: tuple[int, int]) -> Callable[[str], RetrialCondition]:
        return lambda name: RetrialCondition(name, sized(size), spp, name)

    def way(name: str, text: str, make: Callable[[str], RetrialCondition], *, shares: bool = False) -> Way:
        return Way(name, lambda: make(text if name == OWN else f"{name}: {text}"), text, shares=shares)

    yield way(OWN, OWN, same(), shares=True)
    for count in (max(1, spp // 4), min(MAX_SPP, 4 * spp)):
        if count != spp:
            yield way("samples", f"{count} a pixel", same(count))
    height, width = formation.resolution
    for size in ((max(8, height // 2), max(8, width // 2)), (min(4096, 2 * height), min(4096, 2 * width))):
        if size != (height, width):
            yield way("resolution", f"{size[0]} x {size[1]} pixels", at(size))
    for depth in (SHORT, LONG):
        if depth != scene.max_depth:
            yield way("depth", f"light paths of {depth} segments", other(max_depth=depth))
    if not scene.volumetric:
        yield way("integrator", "Mitsuba's path in place of prb", other(integrator="path"))
    sampler = "independent" if formation.sampler != "independent" else "multijitter"
    yield way("sampler", sampler, other(sampler=sampler))
    denoiser = "none" if formation.denoiser != "none" else "oidn"
    yield way("denoiser", denoiser, formed(denoiser=denoiser))
    for curve, text in CURVES.items():
        yield way("curve", f"{curve}, {text}", formed(OWN_LIGHT, transfer=curve), shares=True)
    for quality in QUALITIES:
        yield way("jpeg", f"quality {quality}", same(change=_file(quality)), shares=True)
    for name, values in SENSORS.items():
        yield way("sensor", name, same(change=_sensor(values)), shares=True)
    yield _by_blender(problem, spp)


def _by_blender(problem: Problem, spp: int) -> Way:
    """The scene rendered by another program."""
    renderer = problem.renderer
    formation, text = renderer.formation, "Cycles, Blender's renderer"

    def condition() -> RetrialCondition:
        rendered = replace(problem, renderer=renderer.rendered_by(made.radiance))
        return RetrialCondition(f"blender: {text}", rendered, spp, "blender")

    try:
        made = Cycles(
            renderer.scene.made[0],
            formation.resolution,
            max_depth=renderer.scene.max_depth,
            denoise=formation.denoiser != "none",
        )
    except BlenderError as error:
        return Way("blender", condition, text, str(error))
    return Way("blender", condition, text)


def _file(quality: int) -> Callable[[Tensor, int], Tensor]:
    return lambda picture, seed: coded(picture, quality).clamp(0.0, 1.0)


def _sensor(values: dict[str, float]) -> Callable[[Tensor, int], Tensor]:
    full = {one.name: torch.tensor(values.get(one.name, 0.0)) for one in SensorControl.parameters}
    return lambda picture, seed: through_sensor(picture, full, seed)
