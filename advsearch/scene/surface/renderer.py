"""A renderer of pictures from many cameras and under many environments: light is kept on surfaces."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from advsearch.files import scaled
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.arrangement import CAMERAS, COLOR, FREE, MAP, Arrangement, Light
from advsearch.scene.surface.view import SurfaceView
from advsearch.scene.transport.renderer import MOST_BYTES, PredictingRenderer


class Look(NamedTuple):
    """What one of several cameras sees, by its number, and under which light."""

    number: int
    view: SurfaceView
    light: Light


class SurfaceRenderer(PredictingRenderer):
    """A renderer whose pictures come from light on surfaces; for spaces that `plan.why_not` says nothing against.

    A picture is linear in the base colour of the object. Light that goes from the object to itself, or to the ground
    and back, is that of the base colour `there`.

    Args:
        renderer: the one that traces paths.
        u: everything but cameras, environment and base colour stays as it is there.
        seed: number of the noise of the rays that say what texels see.

    Attributes:
        arrangement: object and surroundings.
        there: (h, w, 3) the base colour whose light between surfaces is kept; see `renew`.
        dropped: lights that made room for others.
    """

    def __init__(self, renderer: Renderer, u: Tensor, seed: int) -> None:
        vars(self).update(vars(copy.copy(renderer)))
        self.products = self.dropped = 0
        self._lights: OrderedDict[bytes, Light] = OrderedDict()
        self._base = {name: self.scene.base(name) for name in (*CAMERAS, MAP, COLOR) if name in self.scene.names}
        with torch.no_grad():
            inputs = self.scene.assembly(self.space.inputs(u))
            self.there = self.color(inputs)
            standing = {name: inputs[name] for name in inputs if name not in FREE}
            texture = self.there.shape[0], self.there.shape[1]
            self.arrangement = Arrangement(renderer, standing, texture, seed)

    def stands(self, inputs: Mapping[str, Tensor]) -> bool:
        """Whether everything but cameras and environment is the same in scene inputs."""
        own, others = self.arrangement.inputs, {name: inputs[name] for name in inputs if name not in FREE}
        if own.keys() != others.keys() or not _same(self.there, self.color(inputs)):
            return False
        return all(_same(own[name], others[name]) for name in own)

    def forget(self) -> None:
        """Let go of all light."""
        self._lights.clear()

    def renew(self, u: Tensor) -> None:
        """Take the light between surfaces from the base colour at u from now on."""
        with torch.no_grad():
            self.there = self.color(self.scene.assembly(self.space.inputs(u)))
        self._lights.clear()

    @property
    def entries(self) -> int:
        return self.arrangement.entries

    @property
    def bytes(self) -> int:
        return self.arrangement.bytes + sum(one.bytes for one in self._lights.values())

    def light(self, inputs: Mapping[str, Tensor]) -> Light:
        """Return the light under the environment of scene inputs, made on first use; `MOST_BYTES` of them are kept."""
        padded = inputs.get(MAP, self._base[MAP]).detach()
        flat = padded.reshape(-1)
        key = torch.cat([flat[:: max(1, flat.numel() // 997)], flat.sum()[None]]).numpy().tobytes()
        if key not in self._lights:
            self._lights[key] = self.arrangement.light(padded, self.there)
            while len(self._lights) > 1 and self.bytes > scaled(MOST_BYTES):
                self._lights.popitem(last=False)
                self.dropped += 1
        return self._lights[key]

    def pictures(self, inputs: Sequence[Mapping[str, Tensor]], color: Tensor, wholes: Sequence[Tensor]) -> Tensor:
        """Return the pictures (n, H, W, 3) sRGB of a base colour for several cameras and environments; those under one
        environment in one launch. Differentiable in the base colour.

        Args:
            inputs: of the scene, for each; their base colour does not count.
            color: (h, w, 3) base colour.
            wholes: (d,) configurations of the space, for what controls do to the finished picture.
        """
        return self.shown(self.looks(inputs), inputs, color, wholes)

    def looks(self, inputs: Sequence[Mapping[str, Tensor]], light: Light | None = None) -> Iterator[Look]:
        """Look through cameras; those under one environment in one launch, while the last launch's are made use of.

        Args:
            inputs: of the scene, for each.
            light: in place of theirs.
        """
        groups: dict[Light, list[int]] = {}
        for number, one in enumerate(inputs):
            groups.setdefault(self.light(one) if light is None else light, []).append(number)
        looks = (self.arrangement.look([self._camera(inputs[n]) for n in some], lit) for lit, some in groups.items())
        begun = next(looks)
        for lit, numbers in groups.items():
            seen = begun()
            begun = next(looks, begun)
            for place, number in enumerate(numbers):
                yield Look(number, self.arrangement.view(seen, place), lit)

    def shown(
        self,
        looks: Iterable[Look],
        inputs: Sequence[Mapping[str, Tensor]],
        color: Tensor,
        wholes: Sequence[Tensor],
    ) -> Tensor:
        """Return the pictures of what cameras see; arguments as of `pictures`."""
        fine, reflected, found = self.arrangement.finer(color), dict[Light, Tensor](), dict[int, Tensor]()
        for look in looks:
            if look.light not in reflected:
                reflected[look.light] = look.light.reflected(fine)
            radiance = look.view.radiance(reflected[look.light])
            found[look.number] = self._shown(radiance, inputs[look.number], wholes[look.number])
        self.products += len(found)
        return torch.stack([found[number] for number in range(len(inputs))])

    def _rendered(self, inputs: Mapping[str, Tensor], seed: int, spp: int, hide: bool) -> Tensor:
        (look,) = self.looks([inputs])
        self.products += 1
        return look.view.radiance(look.light.reflected(self.arrangement.finer(self.color(inputs))))

    def _camera(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: inputs.get(name, self._base[name]) for name in CAMERAS if name in self._base}

    def color(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """The base colour (h, w, 3) of scene inputs."""
        return inputs.get(COLOR, self._base[COLOR])


def _same(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and torch.equal(one, other)
