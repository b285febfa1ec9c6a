"""What predicts pictures of a scene, so that no paths have to be traced for them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.renderer import Renderer


class RefusalCause(Enum):
    """Why a predictor does not make the images of a search, as far as code has to know
    it.
    """

    UNSUITABLE = "the scene, the space or the policy"
    TOO_FEW_STEPS = "it does not pay for so few images"
    NO_CAMERA = "no camera moves"
    HAZE = "haze"
    NOISE = "no denoiser"
    TOO_LARGE = "memory"
    NOTHING_MOVES = "nothing changes that it could follow"


@dataclass(frozen=True)
class Refusal:
    """Why images are rendered and not predicted: a text that completes "rendered: ...",
    and its cause.
    """

    text: str
    cause: RefusalCause = RefusalCause.UNSUITABLE

    def __str__(self) -> str:
        return self.text


NOTHING_MOVES = Refusal(
    "nothing that varies is what it predicts", RefusalCause.NOTHING_MOVES
)
NOISE = Refusal("noise is part of the picture without the denoiser", RefusalCause.NOISE)
"""A refusal that stands alone: with the denoiser, the same images could be
predicted.
"""
# places in the range of a parameter at which its effect on the inputs is looked up
BETWEEN = (0.02, 0.29, 0.61, 0.97)
MOST_BYTES = 2**30  # memory of what one predictor keeps, times `ADVSEARCH_LIMITS`


class Predictor(ABC):
    """Predicts the pictures of the space of a renderer, which traces paths, without
    noise; differentiable. `non_finite` values were not finite while it was made, and
    were set to zero.
    """

    non_finite: int = 0

    def __init__(self, traced: Renderer) -> None:
        self.traced = traced

    @property
    def renderer(self) -> Renderer:
        """A renderer of the same space whose pictures are the predicted ones."""
        # made each time: two objects that hold each other are freed late, and matrices
        # are large
        return self.traced.like(predict=self.radiance)

    def __call__(self, u: Tensor) -> Tensor:
        """Return the picture (H, W, 3) sRGB of a configuration (d,); differentiable."""
        return self.renderer(u)

    def pictures(self, us: Sequence[Tensor]) -> Sequence[Tensor]:
        return [self(u) for u in us]

    @abstractmethod
    def radiance(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the linear radiance of scene inputs; see
        `advsearch.scene.renderer.Predict`.
        """

    @property
    @abstractmethod
    def entries(self) -> int:
        """Entries of all matrices, for one colour channel."""

    @property
    @abstractmethod
    def bytes(self) -> int:
        """Memory of all that is kept."""

    @property
    def lights(self) -> int:
        """Pictures that were traced for it."""
        return 1


def differs(one: Tensor | None, other: Tensor | None) -> bool:
    """Whether two inputs of a scene are not the same, bit for bit."""
    return (
        one is None
        or other is None
        or one.shape != other.shape
        or not torch.equal(one, other)
    )


class LinearMap(torch.autograd.Function):
    """A linear map as a torch operation: `times`, with its transpose as the derivative,
    any number of times.
    """

    @staticmethod
    def forward(
        ctx: Any,
        times: Callable[[Tensor], Tensor],
        transposed_times: Callable[[Tensor], Tensor],
        values: Tensor,
    ) -> Tensor:
        ctx.back = transposed_times, times
        return times(values.detach())

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[None, None, Tensor]:
        return None, None, LinearMap.apply(*ctx.back, cotangent.contiguous())  # type: ignore[no-untyped-call]
