"""The function in the middle: `render(u, seed, spp)`, differentiable in ordinary torch autograd (DESIGN section 1).

    u in [0, 1]^d  --space-->  scene inputs  --Mitsuba-->  radiance  --image formation-->  (H, W, 3) sRGB in [0, 1]

The arrows outside Mitsuba are torch operations and differentiate themselves. Mitsuba's is a custom autograd function
whose backward pass renders the adjoint with a seed of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.errors import InputError
from advsearch.scene.denoise import Denoiser
from advsearch.scene.formation import ImageFormation
from advsearch.scene.mitsuba_scene import MitsubaScene

MAX_SPP = 65536


class InputSpace(Protocol):
    """What the renderer asks of a space: its start, and the scene inputs of a configuration."""

    @property
    def start(self) -> Tensor:
        """(d,) float32 in [0, 1]: the unchanged scene."""

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u to scene inputs by torch operations; differentiable."""


class Renderer:
    """Renders the configurations of one space in one scene.

    Attributes:
        start: (d,) float32 in [0, 1], the configuration that leaves the scene as it is.
        formation: how radiance becomes the picture.
        renders: number of primal renders so far.
        gradients: number of adjoint renders so far.
        non_finite: number of pixels and gradient entries that were NaN or infinite and were set to zero.

    Args:
        scene: the scene inside Mitsuba, at the formation's resolution.
        space: maps u to scene inputs.
        formation: how radiance becomes the picture.
        root_seed: seeds of different roots never meet, whatever is passed as `seed`.
    """

    def __init__(self, scene: MitsubaScene, space: InputSpace, formation: ImageFormation, root_seed: int = 0) -> None:
        self.scene = scene
        self.space = space
        self.formation = formation
        self.root_seed = root_seed
        self._denoise = Denoiser(formation.resolution)
        self.renders = 0
        self.gradients = 0
        self.non_finite = 0

    @property
    def start(self) -> Tensor:
        return self.space.start

    def __call__(self, u: Tensor, seed: int = 0, spp: int = 16) -> Tensor:
        """Render a configuration as the model would see it.

        Args:
            u: (d,) float in [0, 1].
            seed: number of the noise; the same seed gives the same bytes.
            spp: independent samples a pixel, 1 to 65,536.

        Returns:
            (H, W, 3) float32, display-referred sRGB in [0, 1]; differentiable with respect to u.

        Raises:
            InputError: u has another shape, or values outside [0, 1], or spp is out of range.
        """
        return self.formation.display(self.radiance(u, seed, spp))

    def radiance(self, u: Tensor, seed: int = 0, spp: int = 16) -> Tensor:
        """Render linear radiance, denoised if the formation says so; arguments as for a call; (H, W, 3) float32."""
        self._check(u, spp)
        inputs = self.space.inputs(u)
        names = tuple(inputs)
        result: Tensor = _Radiance.apply(self, names, seed, spp, *inputs.values())  # type: ignore[no-untyped-call]
        return result

    def _check(self, u: Tensor, spp: int) -> None:
        if u.shape != self.start.shape:
            raise InputError(f"render: expected u of shape {tuple(self.start.shape)}, got {tuple(u.shape)}")
        if not 1 <= spp <= MAX_SPP:
            raise InputError(f"--spp: expected 1 to {MAX_SPP} samples a pixel, got {spp}")
        values = u.detach()
        if not bool((values >= 0.0).all() & (values <= 1.0).all()):
            raise InputError("render: expected every entry of u in [0, 1]; project u before you render it")

    # ---- the two halves of the autograd function --------------------------------------------------------------------

    def primal(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> Tensor:
        """Radiance of given scene inputs, without a graph; counted in `renders`."""
        noise = seeds.stream(self.root_seed, "primal", seed)
        radiance = self._finite(self.scene.radiance(inputs, noise, spp))
        if self.formation.denoiser == "oidn":
            albedo, normal = self.scene.guides(inputs, seeds.stream(self.root_seed, "guides", seed), spp)
            radiance = self._denoise(radiance, albedo, normal)
        self.renders += 1
        return radiance

    def backward(self, inputs: Mapping[str, Tensor], cotangent: Tensor, seed: int, spp: int) -> dict[str, Tensor]:
        """Gradient of `sum(cotangent * radiance)` for each input; the denoiser counts as the identity."""
        noise = seeds.stream(self.root_seed, "gradient", seed)
        gradients = self.scene.adjoint(inputs, cotangent, noise, spp)
        self.gradients += 1
        return {name: self._finite(gradient) for name, gradient in gradients.items()}

    def _finite(self, values: Tensor) -> Tensor:
        """Replace NaN and infinite entries by zero and count them (DESIGN 4.9)."""
        if bool(torch.isfinite(values.sum())):
            return values
        finite = torch.isfinite(values)
        self.non_finite += int((~finite).sum())
        return torch.where(finite, values, torch.zeros_like(values))


class _Radiance(torch.autograd.Function):
    """Mitsuba as one torch operation; the adjoint is rendered only if a gradient is asked for."""

    @staticmethod
    def forward(ctx: Any, renderer: Renderer, names: tuple[str, ...], seed: int, spp: int, *tensors: Tensor) -> Tensor:
        ctx.renderer, ctx.names, ctx.seed, ctx.spp = renderer, names, seed, spp
        ctx.save_for_backward(*tensors)
        return renderer.primal(dict(zip(names, tensors, strict=True)), seed, spp)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        inputs = dict(zip(ctx.names, ctx.saved_tensors, strict=True))
        gradients = ctx.renderer.backward(inputs, cotangent, ctx.seed, ctx.spp)
        return None, None, None, None, *(gradients[name] for name in ctx.names)
