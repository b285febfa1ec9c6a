"""The sRGB encoding and its inverse, for numpy arrays and torch tensors (IEC
61966-2-1), and its 8-bit levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from advsearch.scene.settings import CHANNELS as CHANNELS

if TYPE_CHECKING:
    from torch import Tensor

Values = TypeVar("Values", npt.NDArray[np.float32], "Tensor")
LINEAR_LIMIT = 0.0031308  # linear values up to which the encoding is straight


def srgb_to_linear(display: Values) -> Values:
    """Decode display-referred sRGB in [0, 1] to linear values.

    Any shape, float32; differentiable everywhere.
    """
    is_straight = display <= 0.04045
    straight = display / 12.92
    # Clipped, so that the side that is not taken has a finite derivative.
    curve = ((display.clip(0.04045, None) + 0.055) / 1.055) ** 2.4
    if isinstance(display, np.ndarray):
        return np.where(is_straight, straight, curve).astype(np.float32)
    return straight.where(is_straight, curve)


def linear_to_srgb(linear: Values) -> Values:
    """Encode linear values as display-referred sRGB, clipped to [0, 1].

    Any shape, float32; differentiable.
    """
    clipped = linear.clip(0.0, 1.0)
    is_straight = clipped <= LINEAR_LIMIT
    straight = clipped * 12.92
    curve = 1.055 * clipped.clip(LINEAR_LIMIT, None) ** (1.0 / 2.4) - 0.055
    if isinstance(linear, np.ndarray):
        return np.where(is_straight, straight, curve).astype(np.float32)
    return straight.where(is_straight, curve)


def to_uint8(display: Tensor) -> Tensor:
    """Return the levels (uint8) of values in [0, 1] in an 8-bit file.

    Not differentiable.
    """
    return (display.detach() * 255.0).round().byte()


def round_to_8_bit(display: Tensor) -> Tensor:
    """Round values in [0, 1] to the 256 levels of an 8-bit file.

    Not differentiable.
    """
    return (display.detach() * 255.0).round() / 255.0


def combine_channels(values: Mapping[str, Tensor]) -> Tensor:
    """Return a linear color (3,), differentiable.

    Args:
        values: display-referred numbers by the names "red", "green" and "blue".
    """
    # Imported here, so that the module loads fast where there are no tensors.
    import torch

    return srgb_to_linear(torch.stack([values[channel] for channel in CHANNELS]))
