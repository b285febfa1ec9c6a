"""From display-referred images to what a network eats: size, value range, channel order, normalisation, layout."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.errors import InputError

Triple = tuple[float, float, float]

#: Named (mean, std) pairs, for values in [0, 1] and channels in RGB order.
PRESETS: dict[str, tuple[Triple, Triple]] = {
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "half": ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
    "clip": ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
}
LAYOUTS = ("NCHW", "NHWC")
CHANNELS = ("RGB", "BGR")


@dataclass(frozen=True)
class Preprocessing:
    """What happens to an image before the network sees it, in this order.

    1. Antialiased bilinear resize to `input_size` (only if the size differs).
    2. `x -> low + (high - low) x`, from [0, 1] to `value_range`.
    3. Channel order: RGB, or reversed to BGR.
    4. `x -> (x - mean) / std`, in the units of `value_range` and in the order of `channels`.
    5. Layout: NCHW (contiguous), or NHWC.

    Where there is a `processor`, it stands for steps 2 to 4.

    Args:
        input_size: (height, width) in pixels.
        mean: three numbers, one per channel.
        std: three positive numbers, one per channel.
        value_range: (low, high) that black and white are sent to.
        layout: ``"NCHW"`` or ``"NHWC"``.
        channels: ``"RGB"`` or ``"BGR"``.
        processor: from pictures (N, 3, H, W) in [0, 1], RGB, to what the network takes, of the same shape.
    """

    input_size: tuple[int, int]
    mean: Triple = (0.0, 0.0, 0.0)
    std: Triple = (1.0, 1.0, 1.0)
    value_range: tuple[float, float] = (0.0, 1.0)
    layout: str = "NCHW"
    channels: str = "RGB"
    processor: Callable[[Tensor], Tensor] | None = None

    def __call__(self, images: Tensor) -> Tensor:
        """Preprocess images (N, H, W, 3), display-referred sRGB in [0, 1], any floating dtype; differentiable."""
        x = images.permute(0, 3, 1, 2)
        if (x.shape[2], x.shape[3]) != self.input_size:
            x = F.interpolate(x, size=self.input_size, mode="bilinear", align_corners=False, antialias=True)
        x = self.processor(x) if self.processor else self._normalise(x.flip(1) if self.channels == "BGR" else x)
        return x.contiguous() if self.layout == "NCHW" else x.permute(0, 2, 3, 1).contiguous()

    def _normalise(self, x: Tensor) -> Tensor:
        """Steps 2 and 4 as one affine map per channel, on (N, 3, H, W) in the network's channel order."""
        low, high = self.value_range
        gain = [(high - low) / std for std in self.std]
        offset = [(low - mean) / std for mean, std in zip(self.mean, self.std, strict=True)]
        if gain == [1.0] * 3 and offset == [0.0] * 3:
            return x
        return torch.addcmul(x.new_tensor(offset).view(3, 1, 1), x, x.new_tensor(gain).view(3, 1, 1))


# ---------------------------------------------------------------------------------------------------------------------
# from what a user writes (Python values, or strings from a command line) to the fields above


def parse_input_size(value: Any) -> tuple[int, int]:
    """Return (height, width) from one positive integer, two, or text such as ``"224"`` and ``"240,320"``."""
    parts = _numbers("input_size", value, (1, 2), "one whole number or (height, width)")
    if any(part != int(part) or part < 1 for part in parts):
        raise InputError(f"input_size: expected whole numbers of at least 1, got {value!r}")
    return int(parts[0]), int(parts[-1])


def parse_value_range(value: Any) -> tuple[float, float]:
    """Return (low, high) from two numbers or text such as ``"0,255"``."""
    low, high = _numbers("value_range", value, (2,), "two numbers (low, high), such as (0, 255)")
    if low >= high:
        raise InputError(f"value_range: expected low < high, got {value!r}")
    return low, high


def parse_normalisation(mean: Any, std: Any) -> dict[str, Triple]:
    """Return the fields among `mean` and `std` that were given.

    A preset's name (``"imagenet"``, ``"half"``, ``"clip"``) in one of the two also fills the other if that one is None.
    """
    fields: dict[str, Triple] = {}
    for position, (key, value) in enumerate((("mean", mean), ("std", std))):
        if value is None:
            continue
        if isinstance(value, str) and value.strip().lower() in PRESETS:
            preset = PRESETS[value.strip().lower()]
            fields[key] = preset[position]
            if (mean, std)[1 - position] is None:
                fields[("std", "mean")[position]] = preset[1 - position]
        else:
            expected = f"one number, three numbers, or one of {', '.join(PRESETS)}"
            numbers = _numbers(key, value, (1, 3), expected)
            fields[key] = (numbers[0], numbers[len(numbers) // 2], numbers[-1])
    if any(number <= 0 for number in fields.get("std", ())):
        raise InputError(f"std: expected numbers greater than 0, got {std!r}")
    return fields


def parse_choice(key: str, value: Any, choices: Sequence[str]) -> str:
    """Return the member of `choices` that `value` names in any case."""
    text = str(value).strip().upper()
    if text not in choices:
        raise InputError(f"{key}: expected one of {', '.join(choices)}, got {value!r}")
    return text


def _numbers(key: str, value: Any, counts: tuple[int, ...], expected: str) -> tuple[float, ...]:
    """Return finite numbers from a number, a sequence, or comma-separated text; their count is one of `counts`."""
    problem = InputError(f"{key}: expected {expected}, got {value!r}")
    if isinstance(value, str):
        parts: list[Any] = value.split(",")
    elif isinstance(value, Tensor) or hasattr(value, "tolist"):
        listed = value.tolist()
        parts = listed if isinstance(listed, list) else [listed]
    else:
        parts = list(value) if isinstance(value, Sequence) else [value]
    try:
        numbers = tuple(float(part) for part in parts)
    except (TypeError, ValueError):
        raise problem from None
    if len(numbers) not in counts or not all(math.isfinite(number) for number in numbers):
        raise problem
    return numbers
