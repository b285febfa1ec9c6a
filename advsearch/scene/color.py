"""Display-referred sRGB and linear values, in numpy (IEC 61966-2-1); `formation` has the torch form."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]


def srgb_to_linear(display: Floats) -> Floats:
    """Decode display-referred sRGB in [0, 1] to linear values in [0, 1]; any shape, float32."""
    low = display / 12.92
    high = ((np.maximum(display, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(display <= 0.04045, low, high).astype(np.float32)


def linear_to_srgb(linear: Floats) -> Floats:
    """Encode linear values as display-referred sRGB, clipped to [0, 1]; any shape, float32."""
    clipped = np.clip(linear, 0.0, 1.0)
    high = 1.055 * np.maximum(clipped, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.where(clipped <= 0.0031308, clipped * 12.92, high).astype(np.float32)
