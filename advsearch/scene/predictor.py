"""Base class of predictors: images of a scene without tracing paths for each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.renderer import Renderer


class RefusalCause(Enum):
    """Cause of a refusal, for code that reacts to some of them."""

    UNSUITABLE = "the scene, the space or the policy"
    TOO_FEW_STEPS = "it does not pay for so few images"
    NO_CAMERA = "no camera moves"
    HAZE = "haze"
    NOISE = "no denoiser"
    TOO_LARGE = "memory"
    NOTHING_MOVES = "nothing changes that it could follow"


@dataclass(frozen=True)
class Refusal:
    """Why images are rendered and not predicted."""

    text: str  # completes "rendered: ..."
    cause: RefusalCause = RefusalCause.UNSUITABLE

    def __str__(self) -> str:
        return self.text


NOTHING_MOVES = Refusal(
    "nothing that varies is what it predicts", RefusalCause.NOTHING_MOVES
)
NOISE = Refusal("noise is part of the picture without the denoiser", RefusalCause.NOISE)
"""A refusal without other reasons: with the denoiser, the images could be predicted."""
# fractions of a parameter's range at which its effect on the inputs is tested
PROBE_FRACTIONS = (0.02, 0.29, 0.61, 0.97)
MAX_BYTES = 2**30  # memory limit of one predictor, times `ADVSEARCH_LIMITS`


class Predictor(ABC):
    """Predict the images of a space without noise; differentiable.

    Args:
        traced: a renderer of the space, which traces paths.

    Attributes:
        path_renderer: the renderer `traced`.
        n_non_finite: how many traced values were not finite, and were set to zero.
    """

    n_non_finite: int = 0

    def __init__(self, traced: Renderer) -> None:
        self.path_renderer = traced

    @property
    def renderer(self) -> Renderer:
        """A renderer of the same space whose images are the predicted ones."""
        # It is not stored, since it refers to this object. Two objects that refer to
        # each other are freed late, and matrices are large.
        return self.path_renderer.copy_with(predict=self.predict_radiance)

    def __call__(self, u: Tensor) -> Tensor:
        """Return the image (H, W, 3) sRGB of a configuration (d,); differentiable."""
        return self.renderer(u)

    def predict_images(self, us: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return the images of several configurations."""
        return [self(u) for u in us]

    @abstractmethod
    def predict_radiance(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the linear radiance of scene inputs.

        See `advsearch.scene.renderer.Predict`.
        """

    @property
    @abstractmethod
    def n_entries(self) -> int:
        """Number of entries of all matrices, for one color channel."""

    @property
    @abstractmethod
    def n_bytes(self) -> int:
        """Memory of all that is stored, bytes."""

    @property
    def n_traced_images(self) -> int:
        """Number of images that were traced for it."""
        return 1


def inputs_differ(first: Tensor | None, second: Tensor | None) -> bool:
    """Return whether two inputs of a scene are not the same, bit for bit.

    None stands for an input without a known value, which may differ from anything. So
    even two None count as different.
    """
    return (
        first is None
        or second is None
        or first.shape != second.shape
        or not torch.equal(first, second)
    )


def find_changed_inputs(renderer: Renderer, varying: Collection[str]) -> frozenset[str]:
    """Return the names of the scene inputs that some controls change.

    All coordinates of these controls are set to one value, one of a few fractions of
    their range after another, and the inputs are compared with those of the start.

    Args:
        renderer: renderer of the scene.
        varying: names of controls, or of groups of coordinates such as "pose.yaw".
    """
    changed: set[str] = set()
    with torch.no_grad():
        start_inputs = renderer.scene.input_assembler(
            renderer.space.inputs(renderer.start)
        )
        for fraction in PROBE_FRACTIONS:
            u = _set_varying_to_fraction(renderer, varying, fraction)
            inputs = renderer.scene.input_assembler(renderer.space.inputs(u))
            for name in start_inputs.keys() | inputs.keys():
                if inputs_differ(start_inputs.get(name), inputs.get(name)):
                    changed.add(name)
    return frozenset(changed)


def _set_varying_to_fraction(
    renderer: Renderer, varying: Collection[str], fraction: float
) -> Tensor:
    """Return the start (d,) with the coordinates of some controls at a fraction."""
    u = renderer.start.clone()
    for group in renderer.space.groups:
        if group.control in varying or group.name in varying:
            u[group.coordinates] = fraction
    return u


class LinearMap(torch.autograd.Function):
    """A linear map as a torch operation, differentiable any number of times.

    The map is `times`. Its derivative is the transposed map, `transposed_times`, and
    the derivative of that is `times` again.
    """

    @staticmethod
    def forward(
        ctx: Any,
        times: Callable[[Tensor], Tensor],
        transposed_times: Callable[[Tensor], Tensor],
        values: Tensor,
    ) -> Tensor:
        """Apply the map to `values`, and store both functions for the derivative."""
        ctx.times = times
        ctx.transposed_times = transposed_times
        return times(values.detach())

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[None, None, Tensor]:
        """Apply the transpose as a `LinearMap` with both functions exchanged."""
        gradient = LinearMap.apply(
            ctx.transposed_times, ctx.times, cotangent.contiguous()
        )  # type: ignore[no-untyped-call]
        return None, None, gradient
