"""Pictures from many cameras and under many environments: light is kept on surfaces.

`why_not` says which scenes and spaces have pictures that it may predict.
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
TEXELS = 333  # of an environment's map, by which it is known again


class Look(NamedTuple):
    """What one of several cameras sees, by its number; under which light, and how many
    times as bright (3,) that is.
    """

    number: int
    view: SurfaceView
    light: Light
    factor: Tensor | float


@dataclass(frozen=True, eq=False)
class Sketch:
    """What tells an environment's map from others: its means (3,), and some of its
    texels (n, 3) over these.
    """

    mean: Tensor
    texels: Tensor

    @classmethod
    def of(cls, padded: Tensor) -> Sketch:
        flat = padded.reshape(-1, 3)
        mean = padded.reshape(-1, 3).mean(dim=0)
        return cls(mean, flat[:: max(1, len(flat) // TEXELS)] / mean.clamp_min(1e-12))

    def times(self, other: Sketch) -> Tensor | None:
        """Return how many times as bright (3,) another map is; None where it differs in
        more.
        """
        if self.texels.shape != other.texels.shape or not torch.allclose(
            self.texels, other.texels, 1e-5, 1e-6
        ):
            return None
        return torch.where(self.mean > 0.0, other.mean / self.mean, 1.0)


class SurfaceRenderer(Predictor):
    """Predicts pictures by light on surfaces, in spaces that `why_not` says nothing
    against. All but cameras, environment and base colour stays as it is at u; the seed
    is that of the rays that say what texels see.

    A picture is linear in the base colour of the object. Light that goes from the
    object to itself, or to the ground and back, is that of the base colour (h, w, 3)
    `there`; see `renew`. `lights_kept` are the lights of maps, the oldest first, and
    `dropped` counts those that made room for others; `fixed` is the light of all
    pictures, None for that of their own environment, see `under`.
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
        standing = {name: inputs[name] for name in inputs if name not in FREE}
        with torch.no_grad():
            self.arrangement = Arrangement(
                traced, standing, (self.there.shape[0], self.there.shape[1]), seed
            )

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Return the scene inputs of a configuration (d,), without a graph."""
        with torch.no_grad():
            return self.traced.scene.assembly(self.traced.space.inputs(u))

    def color(self, inputs: Mapping[str, Tensor]) -> Tensor:
        return inputs.get(COLOR, self._base[COLOR])

    def stands(self, inputs: Mapping[str, Tensor]) -> bool:
        """Whether everything but cameras and environment is the same in scene
        inputs.
        """
        standing = {**self.arrangement.inputs, COLOR: self.there}
        others = {name: inputs[name] for name in inputs if name not in FREE} | {
            COLOR: self.color(inputs)
        }
        return standing.keys() == others.keys() and not any(
            differs(standing[name], others[name]) for name in standing
        )

    def renew(self, u: Tensor) -> None:
        """Take the light between surfaces from the base colour at u from now on."""
        self.there = self.color(self.inputs(u))
        self.lights_kept.clear()

    def under(self, inputs: Mapping[str, Tensor]) -> SurfaceRenderer:
        """Return what predicts pictures that are all under the environment of some
        scene inputs.
        """
        other = copy.copy(self)
        other.fixed = self.light(inputs)
        other.lights_kept = {}
        return other

    @property
    def at_once(self) -> int:
        height, width = self.traced.formation.resolution
        return max(1, MOST_RAYS // (height * width * RAYS))

    @property
    def entries(self) -> int:
        return self.arrangement.entries

    @property
    def bytes(self) -> int:
        if self.fixed is not None:  # of its own: the rest is shared
            return self.fixed.bytes
        return self.arrangement.bytes + sum(
            light.bytes for light in self.lights_kept.values()
        )

    def light(self, inputs: Mapping[str, Tensor]) -> Light:
        return self.arrangement.light(
            inputs.get(MAP, self._base[MAP]).detach(), self.there
        )

    def kept_light(self, inputs: Mapping[str, Tensor]) -> tuple[Light, Tensor]:
        """Return the light under the environment of scene inputs, and a factor (3,) on
        it: exposures and tints of one map have one light. It is made on first use, and
        `MOST_BYTES` of them are kept.
        """
        sketch = Sketch.of(inputs.get(MAP, self._base[MAP]).detach())
        for known, light in self.lights_kept.items():
            factor = known.times(sketch)
            if factor is not None:
                return light, factor
        self.lights_kept[sketch] = light = self.light(inputs)
        while len(self.lights_kept) > 1 and self.bytes > scaled(MOST_BYTES):
            self.lights_kept.pop(next(iter(self.lights_kept)))
            self.dropped += 1
        return light, torch.ones(3)

    def looks(self, inputs: Sequence[Mapping[str, Tensor]]) -> Iterator[Look]:
        """Look through the cameras of scene inputs; those under one environment in one
        launch, while the last launch's are made use of.
        """
        lights = [
            self.kept_light(each) if self.fixed is None else (self.fixed, 1.0)
            for each in inputs
        ]
        groups: dict[Light, list[int]] = {}
        for number, (light, _) in enumerate(lights):
            groups.setdefault(light, []).append(number)
        names = CAMERAS & self._base.keys()
        cameras = [
            {name: each.get(name, self._base[name]) for name in names}
            for each in inputs
        ]
        looks = (
            self.arrangement.look([cameras[number] for number in some], light)
            for light, some in groups.items()
        )
        begun = next(looks)
        for light, numbers in groups.items():
            seen = begun()
            begun = next(looks, begun)
            for place, number in enumerate(numbers):
                yield Look(
                    number, self.arrangement.view(seen, place), light, lights[number][1]
                )

    def shown(
        self,
        looks: Iterable[Look],
        inputs: Sequence[Mapping[str, Tensor]],
        color: Tensor,
        wholes: Sequence[Tensor],
    ) -> Tensor:
        """Return the pictures (n, H, W, 3) sRGB of what cameras see (`looks`) of a base
        colour (h, w, 3), differentiable in that; by the inputs of the scene for each,
        whose base colour does not count, and the configurations (d,), for what controls
        do to the finished picture.
        """
        fine = self.arrangement.finer(color)
        reflected = dict[Light, Tensor]()
        pictures = dict[int, Tensor]()
        for look in looks:
            if look.light not in reflected:
                reflected[look.light] = look.light.reflected(fine)
            radiance = look.view.radiance(reflected[look.light]) * look.factor
            pictures[look.number] = self.traced.finished(
                radiance, inputs[look.number], wholes[look.number]
            )
        return torch.stack([pictures[number] for number in range(len(inputs))])

    def pictures(self, us: Sequence[Tensor]) -> list[Tensor]:
        """Return pictures of configurations that differ in camera and environment
        alone, many in one launch.
        """
        pictures = list[Tensor]()
        with torch.no_grad():
            for begin in range(0, len(us), self.at_once):
                some = us[begin : begin + self.at_once]
                inputs = [self.inputs(u) for u in some]
                pictures += self.shown(self.looks(inputs), inputs, self.there, some)
        return pictures

    def radiance(self, inputs: Mapping[str, Tensor]) -> Tensor:
        (look,) = self.looks([inputs])
        return (
            look.view.radiance(
                look.light.reflected(self.arrangement.finer(self.color(inputs)))
            )
            * look.factor
        )


def why_not(renderer: Renderer, varying: Collection[str]) -> Refusal | None:
    """Why light on surfaces cannot predict the pictures of a renderer's space, in
    words; None if it may: how far it is off is then for measurement. Some controls
    vary; the others are searched, and may change base colours alone.
    """
    reason = why_not_kept(renderer)
    if reason is not None:
        return reason
    for group in renderer.plan.groups:
        if group.control not in varying and group.estimator != "image":
            if renderer.routes.get(group.name, frozenset()) != {COLOR}:
                return Refusal(
                    f"{group.name} changes more than the object's base colour"
                )
    changed = varied(renderer, varying)
    if not changed <= FREE:
        return Refusal(
            f"{', '.join(sorted(changed - FREE))} varies, and light on "
            "surfaces is kept for one arrangement"
        )
    return (
        None
        if changed & CAMERAS
        else Refusal("no camera varies", RefusalCause.NO_CAMERA)
    )


def why_not_kept(renderer: Renderer) -> Refusal | None:
    """Why light cannot be kept on the surfaces of a renderer's scene, in words; None if
    it may be.
    """
    description = renderer.scene.made[0]
    thing = description.meshes[OBJECT]
    if thing.mesh.repeats or thing.surface is not None:
        return Refusal(
            "the object's surface repeats its texture, or is one of Mitsuba's own"
        )
    if (
        description.environment is None
        or description.emits
        or len(description.parts) > 0
    ):
        return Refusal(
            "there is more in the scene than the object, its ground and an environment"
        )
    if renderer.scene.volumetric or description.thin_lens or description.backdrop:
        return Refusal("there is haze, a lens with an aperture, or a plain background")
    if description.number("camera.drops") > 0.0:
        return Refusal("there are raindrops before the camera")
    return None if renderer.formation.denoiser == "oidn" else NOISE


def varied(renderer: Renderer, varying: Collection[str]) -> frozenset[str]:
    """The scene inputs that some controls, or groups of coordinates, change; by their
    names.
    """
    changed: set[str] = set()
    with torch.no_grad():
        start = renderer.scene.assembly(renderer.space.inputs(renderer.start))
        for value in BETWEEN:
            u = renderer.start.clone()
            for group in renderer.space.groups:
                if group.control in varying or group.name in varying:
                    u[group.coordinates] = value
            there = renderer.scene.assembly(renderer.space.inputs(u))
            changed |= {
                name
                for name in start.keys() | there.keys()
                if differs(start.get(name), there.get(name))
            }
    return frozenset(changed)
