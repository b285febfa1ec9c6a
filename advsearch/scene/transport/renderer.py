"""Renderers without rays; and the one for configurations that change base colours only, to first order."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.files import scaled
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.mitsuba_backend.denoise import denoise
from advsearch.scene.mitsuba_backend.transport import Paths, mean_of
from advsearch.scene.renderer import InputSpace, Renderer
from advsearch.scene.transport.matrix import Halves, TextureTransport

SPP = 128
"""Samples a pixel of the paths whose vertices become the matrix and which make the base picture; what noise the
denoiser leaves in it is in all predicted pictures."""
PASS = 2**20
"""Samples of all pixels in one pass; its vertices are held in memory."""
MOST = 4.0
"""Factor by which the noise of the base picture corrects a row at most."""
MOST_BYTES = 2**30
"""Memory of the matrix of one input, times `ADVSEARCH_LIMITS`."""
TOO_LARGE = "the matrix would take more than"
LINEAR = ".base_color"
"""What the names of inputs end in to which radiance is linear, but for light that meets them twice."""


class TransportTooLargeError(Exception):
    """A matrix that takes more memory than it may."""


class PredictingRenderer(Renderer, ABC):
    """A renderer of the same space that traces no paths for its pictures; differentiable, without noise.

    The seed and the samples of a call mean nothing to it.

    Attributes:
        products: pictures it has made.
    """

    products: int
    _predicts = True

    @property
    @abstractmethod
    def entries(self) -> int:
        """Entries of all matrices, for one colour channel."""

    @property
    @abstractmethod
    def bytes(self) -> int:
        """Memory of all matrices and pictures, 16 bits a number."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """What a `LinearRenderer` has collected; it can be sent to another process.

    Attributes:
        transports: by input, finished.
        there: the inputs where it was linearised.
        applied: the inputs that belong to the picture, not to the scene.
        base: the picture there, linear radiance.
    """

    transports: Mapping[str, TextureTransport]
    there: dict[str, Tensor]
    applied: Mapping[str, Tensor]
    base: Halves


class LinearRenderer(PredictingRenderer):
    """A renderer whose pictures come from a matrix.

    Args:
        renderer: the one that traces paths.
        u: where the picture is linearised.
        seed: number of the noise.
        tick: told of samples a pixel as they are traced, `samples_to_collect` in all.
        spp: samples a pixel.
        quick: take the noise out of the rows of the matrix as it was taken out of the base picture, which they
            resemble, and not by the denoiser.
        names: the inputs that get a matrix; None for all base colours that the space sets. Without any there is the
            base picture alone.
        light: inputs in the place of those of u.
        collected: what was collected elsewhere with the same arguments; nothing is traced then.

    Attributes:
        transports: by input.
        there: the inputs where it was linearised.

    Raises:
        TransportTooLargeError: a matrix would take more than `MOST_BYTES`.
    """

    transports: Mapping[str, TextureTransport]
    there: dict[str, Tensor]
    _applied: Mapping[str, Tensor]

    def __init__(
        self,
        renderer: Renderer,
        u: Tensor,
        seed: int,
        tick: Callable[[int], None] = lambda samples: None,
        *,
        spp: int = SPP,
        quick: bool = False,
        names: Collection[str] | None = None,
        light: Mapping[str, Tensor] = MappingProxyType({}),
        collected: Linearised | None = None,
    ) -> None:
        vars(self).update(vars(copy.copy(renderer)))
        self.products = 0
        if collected is not None:
            self.transports, self.there = collected.transports, collected.there
            self._applied, self._base = collected.applied, collected.base
            return
        with torch.no_grad():
            inputs = self.scene.assembly(self.space.inputs(u))
            self._applied = {name: value for name, value in inputs.items() if name in ON_PICTURE}
            traced = {name: value for name, value in inputs.items() if name not in ON_PICTURE} | dict(light)
            linear = [name for name in traced if name in (linear_inputs(renderer) if names is None else names)]
            self.there = {name: traced[name].clone() for name in linear}
            self.transports = {
                name: TextureTransport(self.formation.resolution, (value.shape[0], value.shape[1]), small=quick)
                for name, value in self.there.items()
            }
            if self.transports:
                base = self._finished(self._traced(traced, seed, tick, spp), quick)
            else:
                base = super()._rendered(traced, seed, spp, self._hide)
                tick(spp)
            self._base = Halves(base)

    def let_go(self, space: InputSpace) -> None:
        """Let go of the scene, which only tracing takes; the pictures stay, and `space` is the same without a scene."""
        del self.scene
        self.space = space

    @property
    def collected(self) -> Linearised:
        """What was collected."""
        return Linearised(self.transports, self.there, self._applied, self._base)

    @property
    def entries(self) -> int:
        return sum(one.entries for one in self.transports.values())

    @property
    def bytes(self) -> int:
        height, width = self.formation.resolution
        return sum(one.bytes for one in self.transports.values()) + 8 * height * width

    @property
    def _hide(self) -> bool:
        return "backdrop.color" in self._applied

    def _traced(self, inputs: Mapping[str, Tensor], seed: int, tick: Callable[[int], None], spp: int) -> Paths:
        """Trace paths, fill the matrices with their vertices, and return the mean of their pictures.

        Raises:
            TransportTooLargeError: a matrix would take more than `MOST_BYTES`.
        """
        samples, count = passes(self, spp)
        found: list[Paths] = []
        for name, transport in self.transports.items():
            for number in range(count):
                noise = seeds.stream(seed, f"transport {name}", number)
                paths = self.scene.transport(inputs, name, noise, samples)
                transport.add(paths.vertices, 1.0 / count)
                if self.bytes > scaled(MOST_BYTES):
                    raise TransportTooLargeError(f"{TOO_LARGE} {scaled(MOST_BYTES) / 2**30:g} GiB")
                found.append(replace(paths, vertices=[]))
                tick(samples)
        return mean_of(found)

    def _finished(self, seen: Paths, quick: bool) -> Tensor:
        """Take the noise out of the matrices and the base picture, and return that, with coverage if hidden."""
        radiance = self._finite(seen.radiance - seen.background if self._hide else seen.radiance)
        clean = radiance
        if self.formation.denoiser == "oidn":
            clean = denoise(radiance, seen.albedo.clamp(0.0, 1.0), seen.normal)
        ratio = (clean / radiance.clamp_min(1e-12)).clamp(1.0 / MOST, MOST)
        even = (seen.albedo.sum(dim=-1, keepdim=True) > 0.0).to(torch.float32).expand(-1, -1, 3).contiguous()

        def smooth(picture: Tensor) -> Tensor:
            return picture * ratio if quick else denoise(picture.contiguous(), even, seen.normal)

        for transport in self.transports.values():
            transport.finish(smooth if self.formation.denoiser == "oidn" else None)
        return torch.cat([clean, seen.coverage], dim=-1) if self._hide else clean

    def _rendered(self, inputs: Mapping[str, Tensor], seed: int, spp: int, hide: bool) -> Tensor:
        base = self._base()
        radiance = base[..., :3]
        for name, transport in self.transports.items():
            radiance = radiance + transport(inputs[name] - self.there[name])
        self.products += 1
        return torch.cat([radiance, base[..., 3:]], dim=-1) if hide else radiance

    def shown(self, inputs: Mapping[str, Tensor], u: Tensor) -> Tensor:
        """The picture (H, W, 3) sRGB of scene inputs, of which only those to which radiance is linear count; what
        controls do to the finished picture comes from `u`."""
        return self._picture(u, 0, 1, {**inputs, **self._applied})


def linear_inputs(renderer: Renderer) -> frozenset[str]:
    """The inputs of a scene to which radiance is linear."""
    return frozenset(name for name in renderer.scene.names if name.endswith(LINEAR))


def passes(renderer: Renderer, spp: int) -> tuple[int, int]:
    """Samples a pixel of a pass, and how many passes there are."""
    height, width = renderer.formation.resolution
    samples = max(1, min(spp, PASS // (height * width)))
    return samples, -(-spp // samples)
