"""Image formation: from linear radiance to the display-referred picture that the model sees.

    display = sRGB(clip(gain * denoised(radiance), 0, 1))          (IEC 61966-2-1 transfer)

It is part of a run, named and stored, and the same in search and verification (docs/design.md, "Image formation").
Verification then rounds to 8 bits, as a file would.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.scene.color import LOW_END, linear_to_srgb

DENOISERS = ("oidn", "none")
FILTERS = ("box", "gaussian")
SAMPLERS = ("independent", "multijitter")
"""Samplers of a run's image formation; `advsearch precision` compares more."""
SAMPLER = "multijitter"
"""The one that is taken where nobody asks: its pictures are as good with a third of the samples."""
PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61, 67, 71, 73, 79, 83, 89, 97, 101)
DARK = 1e-6
"""Keeps the slope of a power finite in black; half of one of 255 levels comes of it."""


@dataclass(frozen=True)
class ImageFormation:
    """How a picture is formed.

    Attributes:
        denoiser: "oidn" (Intel Open Image Denoise with albedo and normals as guides) or "none".
        filter: reconstruction filter, "box" or "gaussian"; a gaussian correlates pixels, so the denoiser refuses it.
        sampler: how samples are spread over a pixel: "multijitter" (Kensler 2013, Correlated multi-jittered sampling),
            or "independent", whose noise is more.
        exposure: stops over the metered exposure; kept for the record, `gain` is what is applied.
        resolution: (height, width) in pixels.
        gain: factor from radiance to display-linear values.
        transfer: "srgb"; "gamma", a power of 1/2.2 in its place; "reinhard", sRGB after x / (1 + x), which clips
            nothing (Reinhard, Stark, Shirley and Ferwerda 2002, Photographic tone reproduction for digital images,
            equation 3); or "linear", neither clipped nor encoded, for checks of derivatives: the mean of a noisy
            picture after a curve is not the curve of the mean.
        quick: whether the denoiser takes some 0.6 of its time and leaves a little more error.
    """

    denoiser: str = "oidn"
    filter: str = "box"
    sampler: str = SAMPLER
    exposure: float = 0.0
    resolution: tuple[int, int] = (128, 128)
    gain: float = 1.0
    transfer: str = "srgb"
    quick: bool = False

    def __post_init__(self) -> None:
        if self.denoiser not in DENOISERS:
            raise InputError(f"denoise: expected one of {', '.join(DENOISERS)}, got {self.denoiser!r}")
        if self.sampler not in SAMPLERS:
            raise InputError(f"pixel_sampler: expected one of {', '.join(SAMPLERS)}, got {self.sampler!r}")
        if self.filter not in FILTERS:
            raise InputError(f"reconstruction filter: expected one of {', '.join(FILTERS)}, got {self.filter!r}")
        if self.denoiser == "oidn" and self.filter != "box":
            raise InputError(
                "the denoiser needs the box filter: any other correlates pixels; use `denoise=none` with it"
            )
        if min(self.resolution) < 8 or max(self.resolution) > 4096:
            raise InputError(f"resolution: expected 8 to 4096 pixels, got {self.resolution}")

    def display(self, radiance: Tensor) -> Tensor:
        """Map linear radiance (..., 3) to display-referred sRGB in [0, 1]; differentiable, flat where clipped."""
        if self.transfer == "linear":
            return radiance * self.gain
        if self.transfer == "gamma":
            return (radiance * self.gain).clamp(DARK, 1.0) ** (1.0 / 2.2)
        if self.transfer == "reinhard":
            light = (radiance * self.gain).clamp_min(0.0)
            return linear_to_srgb(light / (1.0 + light))
        shown: Tensor = _Shown.apply(radiance, self.gain)  # type: ignore[no-untyped-call]
        return shown


class _Shown(torch.autograd.Function):
    """`linear_to_srgb(radiance * gain)` with its derivative, bit for bit, over a third of the memory: beside a small
    model, what autograd keeps of each operation costs as much as a product with a matrix of light transport."""

    @staticmethod
    def forward(ctx: Any, radiance: Tensor, gain: float) -> Tensor:
        ctx.save_for_backward(radiance)
        ctx.gain = gain
        clipped = (radiance * gain).clamp_(0.0, 1.0)
        low, curve = clipped <= LOW_END, clipped.clamp(min=LOW_END).pow_(1.0 / 2.4).mul_(1.055).sub_(0.055)
        return torch.where(low, clipped.mul_(12.92), curve)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor, None]:
        (radiance,) = ctx.saved_tensors
        if torch.is_grad_enabled():  # somebody takes a second derivative
            return torch.autograd.grad(linear_to_srgb(radiance * ctx.gain), radiance, cotangent, create_graph=True)[
                0
            ], None
        linear = radiance * ctx.gain
        inside = (linear >= 0.0) & (linear <= 1.0)
        slope = linear.clamp(LOW_END, 1.0).pow_(1.0 / 2.4 - 1.0).mul_(1.0 / 2.4).mul_(cotangent * 1.055)
        slope = torch.where(linear <= LOW_END, cotangent * 12.92, slope)
        return torch.where(inside, slope, 0.0).mul_(ctx.gain), None


def levels_of(display: Tensor) -> Tensor:
    """Return the levels (uint8) that an 8-bit file has for values in [0, 1]; not differentiable."""
    return (display.detach() * 255.0).round().to(torch.uint8)


def to_8_bit(display: Tensor) -> Tensor:
    """Round to the 256 levels of an 8-bit file and return the values in [0, 1]; not differentiable."""
    return (display.detach() * 255.0).round() / 255.0


@lru_cache(maxsize=64)
def next_count(sampler: str, samples: float) -> int:
    """Return the number of samples that a sampler takes when it is asked for at least so many.

    Independent samples come in any number; stratified ones in squares, multi-jittered ones in products of two near
    numbers, orthogonal arrays in squares of primes, the low-discrepancy sequence in powers of four.
    """
    whole = max(1, math.ceil(samples - 1e-9))
    root = math.isqrt(whole - 1) + 1
    if sampler == "stratified":
        return root**2
    if sampler == "multijitter":
        wide = max(1, math.isqrt(whole))
        return wide * math.ceil(whole / wide)
    if sampler == "orthogonal":
        return next((prime for prime in PRIMES if prime >= root), PRIMES[-1]) ** 2
    if sampler == "ldsampler":
        return int(4 ** math.ceil(math.log(max(4, whole), 4) - 1e-9))
    return whole


ITEMS: Mapping[str, str] = {
    "tracing": "tracing a render anew: it is recorded once and replayed",
    "uploads": "writing inputs that are as they were, with the sampling tables and the ray tracing tree that follow",
    "gradients": "derivatives of inputs that no coordinate reaches",
    "boundary": "boundary terms of an adjoint where nothing that it differentiates moves an outline",
    "lobes": "lobes of the object's surface that have no strength",
    "emitters": "samples of lamps that emit nothing",
}
"""What a scene inside Mitsuba leaves out because a search doesn't need it, by name; each can be put back.

None of it changes what is computed: pictures and gradients with and without agree to within their noise, and where the
random numbers are the same ones, to within rounding, which `advsearch check` shows on the scene at hand. Bounces of
light are another matter (`engine.path_length`): leaving those out has a bias, so only the search does it, within a
measured bound, and the verification renders all of them."""

EVERYTHING = frozenset(ITEMS)
"""Leave out all that can be."""
NOTHING: frozenset[str] = frozenset()
"""Leave out nothing: what a program has to do that knows neither scene nor search."""
