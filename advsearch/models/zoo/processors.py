"""What an image processor of transformers does to a picture, measured: what its files say, its class may overrule."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from advsearch.errors import ModelError
from advsearch.models.preprocessing import Triple

Array = npt.NDArray[np.float64]

SIDES = (96, 160)
"""Sides in pixels of the square pictures that a processor is shown."""

TOLERANCE = 1e-3
"""Of the range of a processor's answers: what it may be off from an affine map."""

FILES = ("preprocessor_config.json", "processor_config.json")
"""Where a repository keeps its processor."""


class Measured(TypedDict, total=False):
    """Fields of `advsearch.models.source.Source`."""

    input_size: tuple[int, int]
    mean: Triple
    std: Triple
    channels: str


def processor_of(transformers: Any, name: str, where: Mapping[str, Any]) -> Any:
    """Return the image processor of a repository or a folder; None where it has none. It never runs code of its own."""
    there = (
        transformers.utils.cached_file(name, file, _raise_exceptions_for_missing_entries=False, **where)
        for file in FILES
    )
    if not any(there):
        return None
    return transformers.AutoImageProcessor.from_pretrained(name, trust_remote_code=False, **where)


def measured(processor: Any, spec: str) -> Measured:
    """Return size, mean, standard deviation and order of channels such that ours is what a processor does.

    Pictures of one colour tell gain and offset of each channel, whatever is resized or cropped: with x in [0, 1],
    ``gain x + offset = (x - mean) / std``. The size is that of a square picture's answer.

    Args:
        processor: of transformers.
        spec: the model, for messages.

    Raises:
        ModelError: what it does is no such map: it mixes channels, bends values, or cuts the picture into patches.
    """

    def shown(colour: tuple[int, int, int], side: int = SIDES[0]) -> Array:
        picture = np.full((side, side, 3), colour, np.uint8)
        values: Array = np.asarray(processor(images=picture, return_tensors="np")["pixel_values"], np.float64)
        if values.ndim != 4 or values.shape[:2] != (1, 3):
            raise _other(spec, processor, f"answers with an array of shape {values.shape} in place of (1, 3, H, W)")
        picked: Array = values[0]
        return picked

    black = shown((0, 0, 0))
    offset = black.mean(axis=(1, 2))
    slopes = [shown(one).mean(axis=(1, 2)) - offset for one in ((255, 0, 0), (0, 255, 0), (0, 0, 255))]
    gains: Array = np.stack(slopes, axis=1)  # what goes in across, what comes out down
    size = max(float(np.abs(gains).max()), 1e-12)
    for level in (51, 128, 255):
        seen = shown((level, level, level))
        asked = offset + gains.sum(axis=1) * (level / 255.0)
        if np.abs(seen - asked[:, None, None]).max() > TOLERANCE * size:
            raise _other(spec, processor, "changes the values of pixels by something else than a gain and an offset")
    orders = {"RGB": gains, "BGR": gains[:, ::-1]}
    own = [name for name, one in orders.items() if np.abs(one - np.diag(np.diag(one))).max() <= TOLERANCE * size]
    if len(own) != 1 or (gain := np.diag(orders[own[0]])).min() <= 0.0:
        raise _other(spec, processor, "mixes the channels of a picture, or turns it into its negative")
    found = Measured(mean=_triple(-offset / gain), std=_triple(1.0 / gain), channels=own[0])
    if black.shape == shown((0, 0, 0), SIDES[1]).shape:  # and not just as large as what it was shown
        found["input_size"] = (black.shape[1], black.shape[2])
    return found


def _triple(numbers: Array) -> Triple:
    """Round to what eight digits hold: a processor computes in float32."""
    red, green, blue = (float(f"{number:.7g}") + 0.0 for number in numbers)
    return red, green, blue


def _other(spec: str, processor: Any, what: str) -> ModelError:
    return ModelError(
        f"model {spec}: its processor {type(processor).__name__} {what}, which no size, mean and std stand for. Wrap "
        "network and processing in an nn.Module of yours, and give that from Python or as package.module:callable"
    )
