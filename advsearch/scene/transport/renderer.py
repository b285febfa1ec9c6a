"""A renderer without rays: pictures of configurations that change base colours only, to first order."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.files import scaled
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.gradients.group import Group
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import Smooth, TextureTransport

BASE_SPP = 128
"""Samples a pixel of the base picture, whose noise all predicted pictures have."""
SPP = 64
"""Samples a pixel of the paths whose vertices become the matrix; its rows lose their noise in the denoiser."""
PASS = 2**20
"""Samples of all pixels in one pass; its vertices are held in memory."""
MOST_BYTES = 2**30
"""Memory of the matrix of one input, times `ADVSEARCH_LIMITS`."""
LINEAR = ".base_color"
"""What the names of inputs end in to which radiance is linear, but for light that meets them twice."""


class TransportTooLargeError(Exception):
    """A matrix that takes more memory than it may."""


class LinearRenderer(Renderer):
    """A renderer of the same space whose pictures come from a matrix; differentiable, without noise.

    The seed and the samples of a call mean nothing to it.

    Args:
        renderer: the one that traces paths.
        u: where the picture is linearised.
        seed: number of the noise.
        tick: told of samples a pixel as they are traced, `samples_to_collect` in all.

    Attributes:
        at: the configuration where it was linearised.
        products: pictures it has made.
        transports: by input.

    Raises:
        TransportTooLargeError: a matrix would take more than `MOST_BYTES`.
    """

    def __init__(
        self, renderer: Renderer, u: Tensor, seed: int, tick: Callable[[int], None] = lambda samples: None
    ) -> None:
        vars(self).update(vars(copy.copy(renderer)))
        self.paths, self.at, self.products = renderer, u.detach().clone(), 0
        with torch.no_grad():
            inputs = self._assembled(self.at)
            hide = "backdrop.color" in inputs
            self._there = {name: value for name, value in inputs.items() if name not in ON_PICTURE}
            self._base = renderer.primal(self._there, seeds.stream(seed, "base picture"), BASE_SPP, hide)
            tick(BASE_SPP)
            linear = [name for name in self._there if name in linear_inputs(renderer)]
            self.transports = {name: self._collected(name, seed, tick) for name in linear}

    @property
    def entries(self) -> int:
        """Entries of all matrices, for one colour channel."""
        return sum(one.entries for one in self.transports.values())

    @property
    def bytes(self) -> int:
        """Memory of all matrices."""
        return sum(one.bytes for one in self.transports.values())

    def _collected(self, name: str, seed: int, tick: Callable[[int], None]) -> TextureTransport:
        """Trace paths and build the matrix of one input.

        Raises:
            TransportTooLargeError: it would take more than `MOST_BYTES`.
        """
        (height, width), picture = self._there[name].shape[:2], self.formation.resolution
        made = TextureTransport(picture, (height, width))
        samples, passes = _passes(self)
        for number in range(passes):
            noise = seeds.stream(seed, f"transport {name}", number)
            made.add(self.scene.transport(self._there, name, noise, samples), 1.0 / passes)
            if made.bytes > scaled(MOST_BYTES):
                raise TransportTooLargeError(f"the matrix would take more than {scaled(MOST_BYTES) / 2**30:g} GiB")
            tick(samples)
        made.finish(self._smooth(seed))
        return made

    def _smooth(self, seed: int) -> Smooth | None:
        """The denoiser, guided by what the pixels see."""
        if self.formation.denoiser != "oidn":
            return None
        albedo, normal = self.scene.guides(self._there, seeds.stream(seed, "guides"), SPP)
        even = (albedo.sum(dim=-1, keepdim=True) > 0.0).to(albedo.dtype).expand(-1, -1, 3).contiguous()
        return lambda picture: self._denoise(picture.contiguous(), even, normal)

    def _rendered(self, inputs: Mapping[str, Tensor], seed: int, spp: int, hide: bool) -> Tensor:
        radiance = self._base[..., :3]
        for name, transport in self.transports.items():
            radiance = radiance + transport(inputs[name] - self._there[name])
        self.products += 1
        return torch.cat([radiance, self._base[..., 3:]], dim=-1) if hide else radiance

    def _through(self, u: Tensor) -> Tensor:
        return u

    def _differenced(self) -> tuple[Group, ...]:
        return ()


def linear_inputs(renderer: Renderer) -> frozenset[str]:
    """The inputs of a scene to which radiance is linear."""
    return frozenset(name for name in renderer.scene.names if name.endswith(LINEAR))


def why_not(renderer: Renderer) -> str | None:
    """Why pictures of a renderer's space cannot be predicted by a matrix, in words; None if they can."""
    plan, linear = renderer.plan, linear_inputs(renderer)
    if renderer.scene.volumetric:
        return "there is haze"
    if renderer.formation.denoiser != "oidn":
        return "noise is part of the picture without the denoiser"
    for group in plan.groups:
        if "forced" in group.reason and group.estimator not in ("none", "image"):
            return f"the estimator of {group.name} is forced"
        if group.estimator == "image":
            continue
        if group.estimator != "adjoint" or not renderer.routes.get(group.name, frozenset()) <= linear:
            return f"{group.name} changes more than a base colour"
    if not any(renderer.routes.get(group.name) for group in plan.groups):
        return "nothing that is searched needs a render to be differentiated"
    return None


def samples_to_collect(renderer: Renderer) -> int:
    """Samples a pixel that a linear renderer traces before it can begin."""
    inputs = {name for group in renderer.plan.groups for name in renderer.routes.get(group.name, ())}
    samples, passes = _passes(renderer)
    return BASE_SPP + samples * passes * len(inputs)


def _passes(renderer: Renderer) -> tuple[int, int]:
    """Samples a pixel of a pass, and how many passes there are."""
    height, width = renderer.formation.resolution
    samples = max(1, min(SPP, PASS // (height * width)))
    return samples, -(-SPP // samples)
