"""Predict images from many cameras and under many environments by light on surfaces.

`why_not` returns why a scene's or a space's images cannot be predicted.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from advsearch.scene.description import OBJECT
from advsearch.scene.mitsuba_backend.surface import RAYS
from advsearch.scene.predictor import (
    BETWEEN,
    MOST_BYTES,
    NOISE,
    Predictor,
    Refusal,
    RefusalCause,
    differs,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.arrangement import (
    CAMERAS,
    COLOR,
    FREE,
    MAP,
    Arrangement,
    Light,
    SurfaceView,
)
from advsearch.trust.stored_files import scaled

MOST_RAYS = 1 << 21  # rays of cameras of one launch
TEXELS = 333  # of an environment's map that are compared with those of others


class Look(NamedTuple):
    """What one of several cameras sees, and under which light."""

    number: int  # index of the camera
    view: SurfaceView
    light: Light
    factor: Tensor | float  # (3,) how many times as bright the light is


@dataclass(frozen=True, eq=False)
class Sketch:
    """A fingerprint of an environment's map, for comparison with other maps."""

    mean: Tensor  # (3,) of the map
    texels: Tensor  # (n, 3) some of its texels over the means

    @classmethod
    def of(cls, padded: Tensor) -> Sketch:
        """Return the fingerprint of a map (H, W + 2, 3)."""
        flat = padded.reshape(-1, 3)
        mean = flat.mean(dim=0)
        step = max(1, len(flat) // TEXELS)
        return cls(mean, flat[::step] / mean.clamp_min(1e-12))

    def times(self, other: Sketch) -> Tensor | None:
        """Return how many times as bright (3,) another map is.

        None if it differs in more than that.
        """
        if self.texels.shape != other.texels.shape or not torch.allclose(
            self.texels, other.texels, 1e-5, 1e-6
        ):
            return None
        return torch.where(self.mean > 0.0, other.mean / self.mean, 1.0)


class SurfaceRenderer(Predictor):
    """Predict images by light on surfaces, in spaces that `why_not` does not refuse.

    An image is linear in the base color of the object. Light that goes from the object
    to itself, or to the ground and back, is that of the base color `there`; see
    `renew`.

    Args:
        traced: renderer of the scene.
        u: (d,) configuration; all but cameras, environment and base color stays as it
            is there.
        seed: of the rays from texels.

    Attributes:
        there: (h, w, 3) base color.
        lights_kept: the lights of maps, the oldest first.
        dropped: how many lights were removed for others.
        fixed: the light of all images, see `under`; None for that of the image's own
            environment.
    """

    fixed: Light | None = None
    lights = 0

    def __init__(self, traced: Renderer, u: Tensor, seed: int) -> None:
        super().__init__(traced)
        self.dropped = 0
        self.lights_kept: dict[Sketch, Light] = {}
        self._base = {
            name: traced.scene.base(name)
            for name in (*CAMERAS, MAP, COLOR)
            if name in traced.scene.names
        }
        inputs = self.inputs(u)
        self.there = self.color(inputs)
        fixed_inputs = {name: inputs[name] for name in inputs if name not in FREE}
        texture = (self.there.shape[0], self.there.shape[1])
        with torch.no_grad():
            self.arrangement = Arrangement(traced, fixed_inputs, texture, seed)

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Return the scene inputs of a configuration (d,), without a graph."""
        with torch.no_grad():
            return self.traced.scene.assembly(self.traced.space.inputs(u))

    def color(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the base color (h, w, 3) of scene inputs."""
        return inputs.get(COLOR, self._base[COLOR])

    def stands(self, inputs: Mapping[str, Tensor]) -> bool:
        """Return whether only cameras and environment differ in some scene inputs."""
        expected = {**self.arrangement.inputs, COLOR: self.there}
        fixed_inputs = {name: inputs[name] for name in inputs if name not in FREE}
        fixed_inputs[COLOR] = self.color(inputs)
        return expected.keys() == fixed_inputs.keys() and not any(
            differs(expected[name], fixed_inputs[name]) for name in expected
        )

    def renew(self, u: Tensor) -> None:
        """Take the light between surfaces from the base color at u from now on."""
        self.there = self.color(self.inputs(u))
        self.lights_kept.clear()

    def under(self, inputs: Mapping[str, Tensor]) -> SurfaceRenderer:
        """Return a predictor of images that are all under the environment of inputs."""
        other = copy.copy(self)
        other.fixed = self.light(inputs)
        other.lights_kept = {}
        return other

    @property
    def at_once(self) -> int:
        """Number of images in one launch."""
        height, width = self.traced.formation.resolution
        return max(1, MOST_RAYS // (height * width * RAYS))

    @property
    def entries(self) -> int:
        return self.arrangement.entries

    @property
    def bytes(self) -> int:
        if self.fixed is not None:  # the rest is shared
            return self.fixed.bytes
        lights = sum(light.bytes for light in self.lights_kept.values())
        return self.arrangement.bytes + lights

    def light(self, inputs: Mapping[str, Tensor]) -> Light:
        """Compute the light under the environment of scene inputs."""
        padded = inputs.get(MAP, self._base[MAP]).detach()
        return self.arrangement.light(padded, self.there)

    def kept_light(self, inputs: Mapping[str, Tensor]) -> tuple[Light, Tensor]:
        """Return the light under the environment of scene inputs, and its factor (3,).

        Exposures and tints of one map have one light. It is computed on first use, and
        up to `MOST_BYTES` of lights are stored.
        """
        sketch = Sketch.of(inputs.get(MAP, self._base[MAP]).detach())
        for stored_sketch, light in self.lights_kept.items():
            factor = stored_sketch.times(sketch)
            if factor is not None:
                return light, factor
        light = self.light(inputs)
        self.lights_kept[sketch] = light
        while len(self.lights_kept) > 1 and self.bytes > scaled(MOST_BYTES):
            oldest = next(iter(self.lights_kept))
            self.lights_kept.pop(oldest)
            self.dropped += 1
        return light, torch.ones(3)

    def looks(self, inputs: Sequence[Mapping[str, Tensor]]) -> Iterator[Look]:
        """Yield what the cameras of scene inputs see.

        Those under one environment are traced in one launch, while the results of the
        launch before are used.
        """
        lights: list[tuple[Light, Tensor | float]] = []
        for camera_inputs in inputs:
            if self.fixed is None:
                lights.append(self.kept_light(camera_inputs))
            else:
                lights.append((self.fixed, 1.0))
        cameras_of_light: dict[Light, list[int]] = {}
        for number, (light, _) in enumerate(lights):
            cameras_of_light.setdefault(light, []).append(number)
        names = CAMERAS & self._base.keys()
        cameras = [
            {name: camera_inputs.get(name, self._base[name]) for name in names}
            for camera_inputs in inputs
        ]
        launches = (
            self.arrangement.look([cameras[number] for number in numbers], light)
            for light, numbers in cameras_of_light.items()
        )
        running = next(launches)
        for light, numbers in cameras_of_light.items():
            samples = running()
            running = next(launches, running)
            for index, number in enumerate(numbers):
                view = self.arrangement.view(samples, index)
                yield Look(number, view, light, lights[number][1])

    def shown(
        self,
        looks: Iterable[Look],
        inputs: Sequence[Mapping[str, Tensor]],
        color: Tensor,
        wholes: Sequence[Tensor],
    ) -> Tensor:
        """Return the images (n, H, W, 3) sRGB of what cameras see of a base color.

        Args:
            looks: of the cameras.
            inputs: scene inputs for each, whose base color is ignored.
            color: (h, w, 3); the images are differentiable in it.
            wholes: full configurations (d,), for what controls do to the finished
                image.
        """
        fine = self.arrangement.finer(color)
        reflected = dict[Light, Tensor]()
        images = dict[int, Tensor]()
        for look in looks:
            if look.light not in reflected:
                reflected[look.light] = look.light.reflected(fine)
            radiance = look.view.radiance(reflected[look.light]) * look.factor
            images[look.number] = self.traced.finished(
                radiance, inputs[look.number], wholes[look.number]
            )
        return torch.stack([images[number] for number in range(len(inputs))])

    def pictures(self, us: Sequence[Tensor]) -> list[Tensor]:
        """Return images of configurations that differ in camera and environment alone.

        Many are made in one launch.
        """
        images = list[Tensor]()
        with torch.no_grad():
            for begin in range(0, len(us), self.at_once):
                batch = us[begin : begin + self.at_once]
                inputs = [self.inputs(u) for u in batch]
                images += self.shown(self.looks(inputs), inputs, self.there, batch)
        return images

    def radiance(self, inputs: Mapping[str, Tensor]) -> Tensor:
        (look,) = self.looks([inputs])
        fine = self.arrangement.finer(self.color(inputs))
        return look.view.radiance(look.light.reflected(fine)) * look.factor


def why_not(renderer: Renderer, varying: Collection[str]) -> Refusal | None:
    """Return why light on surfaces cannot predict images of a space; None if it may.

    How far it is off is then for measurement.

    Args:
        renderer: of the space.
        varying: names of the controls that vary; the others are searched, and may
            change base colors alone.
    """
    refusal = why_not_kept(renderer)
    if refusal is not None:
        return refusal
    for group in renderer.plan.groups:
        if group.control in varying or group.estimator == "image":
            continue
        if renderer.routes.get(group.name, frozenset()) != {COLOR}:
            return Refusal(f"{group.name} changes more than the object's base colour")
    changed = varied(renderer, varying)
    if not changed <= FREE:
        return Refusal(
            f"{', '.join(sorted(changed - FREE))} varies, and light on "
            "surfaces is kept for one arrangement"
        )
    if not changed & CAMERAS:
        return Refusal("no camera varies", RefusalCause.NO_CAMERA)
    return None


def why_not_kept(renderer: Renderer) -> Refusal | None:
    """Return why light cannot be stored on a scene's surfaces; None if it may be."""
    description = renderer.scene.made[0]
    mesh_part = description.meshes[OBJECT]
    if mesh_part.mesh.repeats or mesh_part.surface is not None:
        return Refusal(
            "the object's surface repeats its texture, or is one of Mitsuba's own"
        )
    has_more = len(description.parts) > 0 or description.emits
    if description.environment is None or has_more:
        return Refusal(
            "there is more in the scene than the object, its ground and an environment"
        )
    if renderer.scene.volumetric or description.thin_lens or description.backdrop:
        return Refusal("there is haze, a lens with an aperture, or a plain background")
    if description.number("camera.drops") > 0.0:
        return Refusal("there are raindrops before the camera")
    return None if renderer.formation.denoiser == "oidn" else NOISE


def varied(renderer: Renderer, varying: Collection[str]) -> frozenset[str]:
    """Return the names of the scene inputs that some controls change.

    `varying` has the names of controls, or of groups of coordinates.
    """
    changed: set[str] = set()
    with torch.no_grad():
        start = renderer.scene.assembly(renderer.space.inputs(renderer.start))
        for value in BETWEEN:
            u = renderer.start.clone()
            for group in renderer.space.groups:
                if group.control in varying or group.name in varying:
                    u[group.coordinates] = value
            inputs = renderer.scene.assembly(renderer.space.inputs(u))
            for name in start.keys() | inputs.keys():
                if differs(start.get(name), inputs.get(name)):
                    changed.add(name)
    return frozenset(changed)
