"""Which scenes and spaces have pictures that light on surfaces may predict."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import torch
from torch import Tensor

from advsearch.scene.description import OBJECT
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.arrangement import CAMERAS, COLOR, FREE
from advsearch.scene.transport.lights import NOISE

PLACES = (0.02, 0.29, 0.61, 0.97)
"""Places in the range of what varies at which is looked what it changes."""


def why_not(renderer: Renderer, varying: Collection[str]) -> str | None:
    """Why light on surfaces cannot predict the pictures of a renderer's space, in words; None if it may: how far it is
    off is then for measurement.

    Args:
        renderer: which traces.
        varying: names of the controls that vary; the others are searched, and may change base colours alone.
    """
    reason = why_not_kept(renderer)
    if reason is not None:
        return reason
    for group in renderer.plan.groups:
        if group.control in varying or group.estimator == "image":
            continue
        reached = renderer.routes.get(group.name, frozenset())
        if reached != {COLOR}:
            return f"{group.name} changes more than the object's base colour"
    changed = varied(renderer, varying)
    if not changed <= FREE:
        return f"{', '.join(sorted(changed - FREE))} varies, and light on surfaces is kept for one arrangement"
    return None if changed & CAMERAS else "no camera varies"


def why_not_kept(renderer: Renderer) -> str | None:
    """Why light cannot be kept on the surfaces of a renderer's scene, in words; None if it may be."""
    description = renderer.scene.made[0]
    thing = description.meshes[OBJECT]
    if thing.mesh.repeats or thing.surface is not None:
        return "the object's surface repeats its texture, or is one of Mitsuba's own"
    if description.environment is None or description.emits or len(description.parts) > 0:
        return "there is more in the scene than the object, its ground and an environment"
    if renderer.scene.volumetric or description.thin_lens or description.backdrop:
        return "there is haze, a lens with an aperture, or a plain background"
    if renderer.formation.denoiser != "oidn":
        return NOISE
    return None


def varied(renderer: Renderer, varying: Collection[str]) -> frozenset[str]:
    """The scene inputs that some controls, or groups of coordinates, change; by their names."""
    with torch.no_grad():
        start = renderer.scene.assembly(renderer.space.inputs(renderer.start))
        found: set[str] = set()
        for place in _places(renderer, varying):
            there = renderer.scene.assembly(renderer.space.inputs(place))
            found |= {name for name in start.keys() | there.keys() if _differs(start.get(name), there.get(name))}
    return frozenset(found)


def _places(renderer: Renderer, varying: Collection[str]) -> Iterator[Tensor]:
    for value in PLACES:
        place = renderer.start.clone()
        for group in renderer.space.groups:
            if group.control in varying or group.name in varying:
                place[group.coordinates] = value
        yield place


def _differs(one: Tensor | None, other: Tensor | None) -> bool:
    return one is None or other is None or one.shape != other.shape or not torch.equal(one, other)
