"""From what a user writes of preprocessing (Python values, or strings from a command line) to the fields of
`advsearch.models.model.Preprocessing`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

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


READERS: dict[str, Callable[[Any], Any]] = {
    "input_size": parse_input_size,
    "value_range": parse_value_range,
    "layout": partial(parse_choice, "layout", choices=LAYOUTS),
    "channels": partial(parse_choice, "channels", choices=CHANNELS),
}
"""What reads the fields that have a form of their own."""


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
