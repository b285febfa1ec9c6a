"""What the libraries of networks have in common: they may be absent, and their weights
may be out of reach.

What an image processor of transformers does to a picture is measured, because its class
may overrule what its files say. One that no size, mean and standard deviation stand for
is called, inside the differentiable function.
"""

from __future__ import annotations

import contextlib
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from advsearch.extend import errors, models


@contextlib.contextmanager
def reading(spec: str, advice: str) -> Iterator[None]:
    """Turn what a library raises while it fetches and reads a model's weights into a
    ModelError, which advises what else its user may give; it never unpickles, and
    connects to nobody for a model that only a file names.
    """
    disabled = logging.root.manager.disable
    # of single tries to connect: an error is raised in the end
    logging.disable(logging.WARNING)
    tries: list[object] = []
    try:
        with (
            models.without_unpickling(),
            warnings.catch_warnings(),
            models.connecting(models.may_fetch(spec), tries),
        ):
            warnings.simplefilter("ignore")
            yield
    except errors.ModelError:
        raise
    except (
        Exception
    ) as error:  # a library raises nearly anything for what is not there or damaged
        if tries:
            raise models.CodeNotAllowedError(
                f"a file names the model {spec}, which is not on this machine and "
                "would be fetched; "
                f"{models.how_to_allow(spec)}"
            ) from error
        raise errors.ModelError(
            f"model {spec}: cannot be fetched or read ({models.first_line(error)}). "
            "Weights come from the library's "
            "cache on this machine, else from where it publishes them; they are never "
            f"unpickled. {advice}"
        ) from error
    finally:
        logging.disable(disabled)


Array = npt.NDArray[np.float64]

SIDES = (96, 160)  # in pixels, of the square pictures that a processor is shown
# of the range of a processor's outputs: what it may be off from an affine map
TOLERANCE = 1e-3
# what scores that are worked out of a network's parts may be off from its own, as a
# share
ROUNDING = 1e-4
# where a repository keeps its processor
FILES = ("preprocessor_config.json", "processor_config.json")


class Processing(TypedDict, total=False):
    """Fields of `advsearch.models.source.Source`."""

    input_size: tuple[int, int]
    mean: models.Triple
    std: models.Triple
    channels: str
    processor: Callable[[Tensor], Tensor]


def processor_of(transformers: Any, name: str, where: Mapping[str, Any]) -> Any:
    """Return the image processor of a repository or a folder; None where it has none.
    It never runs code of its own.
    """
    if not any(cached_file(transformers, name, file, where) for file in FILES):
        return None
    return transformers.AutoImageProcessor.from_pretrained(
        name, trust_remote_code=False, **where
    )


def cached_file(
    transformers: Any, name: str, file: str, where: Mapping[str, Any]
) -> str | None:
    """Return the path of a file of a repository or a folder; None where it has none."""
    path: str | None = transformers.utils.cached_file(
        name, file, _raise_exceptions_for_missing_entries=False, **where
    )
    return path


def measured(processor: Any, spec: str) -> Processing:
    """Return size, mean, standard deviation and order of channels such that ours is
    what a processor of transformers does.

    Pictures of one colour tell gain and offset of each channel, whatever is resized or
    cropped: with x in [0, 1], ``gain x + offset = (x - mean) / std``. The size is that
    of a square picture's output. A processor that does
    something else to the values of pixels is returned, to be called, if a gradient goes through it. Raises ModelError:
    no gradient does, or it pads pictures or cuts them into patches.
    """

    def shown(colour: tuple[int, int, int], side: int = SIDES[0]) -> Array:
        return _processed(processor, np.full((side, side, 3), colour, np.uint8), spec)

    black = shown((0, 0, 0))
    size = Processing()
    # and not just as large as what it was shown
    if black.shape == shown((0, 0, 0), SIDES[1]).shape:
        size["input_size"] = (black.shape[1], black.shape[2])
    offset = black.mean(axis=(1, 2))
    slopes = [
        shown(colour).mean(axis=(1, 2)) - offset
        for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255))
    ]
    gains: Array = np.stack(slopes, axis=1)  # what goes in across, what comes out down
    tolerance = TOLERANCE * max(float(np.abs(gains).max()), 1e-12)
    for level in (51, 128, 255):
        affine = offset + gains.sum(axis=1) * (level / 255.0)
        if (
            np.abs(shown((level, level, level)) - affine[:, None, None]).max()
            > tolerance
        ):
            return _called(
                processor,
                spec,
                size,
                "changes pixels by something else than a gain and an offset",
            )
    orders = {"RGB": gains, "BGR": gains[:, ::-1]}
    diagonal = [
        name
        for name, gain in orders.items()
        if np.abs(gain - np.diag(np.diag(gain))).max() <= tolerance
    ]
    if len(diagonal) != 1 or (gain := np.diag(orders[diagonal[0]])).min() <= 0.0:
        return _called(
            processor,
            spec,
            size,
            "mixes the channels of a picture, or turns it into its negative",
        )
    return Processing(
        mean=_triple(-offset / gain),
        std=_triple(1.0 / gain),
        channels=diagonal[0],
        **size,
    )


def _processed(processor: Any, picture: Any, spec: str) -> Array:
    """Return a processor's output (3, h, w) for an 8-bit picture (H, W, 3)."""
    values: Array = np.asarray(
        processor(images=picture, return_tensors="np")["pixel_values"], np.float64
    )
    if values.ndim != 4 or values.shape[:2] != (1, 3):
        raise _other(
            spec,
            processor,
            f"returns an array of shape {values.shape} in place of (1, 3, H, W)",
        )
    picked: Array = values[0]
    return picked


def _called(processor: Any, spec: str, size: Processing, what: str) -> Processing:
    """Return the size that was found, with the processor to be called on a picture of
    it.
    """
    height, width = size.get("input_size", (SIDES[0], SIDES[0]))
    ends = [
        _processed(processor, np.full((SIDES[0], SIDES[0], 3), level, np.uint8), spec)
        for level in (0, 255)
    ]
    if (ends[0] == ends[1]).all(axis=0).any():
        raise _other(
            spec, processor, "pads a square picture, or leaves some of its pixels out"
        )
    levels = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    switches = ("do_resize", "do_center_crop")  # a picture has the right size
    as_it_is = partial(
        processor,
        **{name: False for name in switches if getattr(processor, name, None)},
    )
    expected = _processed(as_it_is, levels, spec)
    picture = (
        (torch.from_numpy(levels).float() / 255.0).movedim(2, 0)[None].requires_grad_()
    )

    # (N, 3, H, W) in [0, 1]; it is shown numbers up to 255, unrounded
    def call(images: Tensor) -> Tensor:
        shown = [
            as_it_is(images=255.0 * image, return_tensors="pt")["pixel_values"]
            for image in images
        ]
        return torch.cat(shown).to(images)

    try:
        with torch.enable_grad():
            seen = call(picture)
            reaches = bool(torch.autograd.grad(seen.square().sum(), picture)[0].any())
    except (
        Exception
    ) as error:  # a processor that works with numpy raises nearly anything
        pil = getattr(processor, "backend", None) == "pil"
        advice = (
            "; with torchvision installed, transformers takes one that may"
            if pil
            else ""
        )
        raise _other(
            spec,
            processor,
            f"{what}, and lets no gradient through "
            f"({models.first_line(error)}){advice}",
        ) from error
    off = (
        np.abs(seen.detach().double().numpy() - expected).max()
        if seen.shape == (1, *expected.shape)
        else np.inf
    )
    if not reaches or not off <= TOLERANCE * np.ptp(expected):
        raise _other(
            spec,
            processor,
            f"{what}, and rounds or does otherwise where a gradient goes through it",
        )
    return Processing(processor=call, **size)


def _triple(numbers: Array) -> models.Triple:
    """Round to what eight digits hold: a processor computes in float32."""
    red, green, blue = (float(f"{number:.7g}") + 0.0 for number in numbers)
    return red, green, blue


def _other(spec: str, processor: Any, what: str) -> errors.ModelError:
    return errors.ModelError(
        f"model {spec}: its processor {type(processor).__name__} {what}, which no "
        "size, mean and std stand for. Wrap "
        "network and processing in an nn.Module of yours, and give that from Python or "
        "as package.module:callable"
    )


Ask = Callable[[Any, Tensor], Any]  # what asks a network about pictures (N, 3, H, W)


class Adapted(nn.Module):
    """A network of a library, asked as that one's are; `boxes` says that its boxes are
    corners in pixels.
    """

    def __init__(self, network: nn.Module, ask: Ask, *, boxes: bool = False) -> None:
        super().__init__()
        self.network = network
        self.ask = ask
        self.boxes_are_corners_in_pixels = boxes

    def forward(self, images: Tensor) -> Any:
        return self.ask(self.network, images)


@dataclass(frozen=True, eq=False)
class Loaded:
    """A network of transformers, and what comes with it."""

    network: Any  # a `PreTrainedModel`
    name: str
    spec: str  # what its user wrote, for messages
    processor: Any  # of images; None where it has none
    # loads another part by the class that does it, such as "AutoTokenizer"
    part: Callable[[str], Any]
    purpose: models.Purpose

    @cached_property
    def described(self) -> Processing:
        """What is done to pictures. Raises ModelError as `measured`; warns where there
        is no image processor.
        """
        if self.processor is None:
            models.warn(
                f"model {self.spec} comes without an image processor: pictures are "
                "given as they are, RGB in [0, 1]. "
                "Say `mean`, `std` and `input_size` of load_model if it wants them "
                "otherwise"
            )
            return Processing()
        return measured(self.processor, self.spec)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its classes, as its ``config`` has them; none where transformers
        only numbers them.
        """
        labels = getattr(self.network.config, "id2label", None) or {}
        names = tuple(str(labels[key]) for key in sorted(labels, key=int))
        return () if all(re.fullmatch(r"LABEL_\d+", name) for name in names) else names

    def sized(self, config: Any) -> Processing:
        """Return what is done to pictures, of the size in a part of the network's
        ``config`` if no other is known.
        """
        side = getattr(config, "image_size", None)
        sides = (side, side) if isinstance(side, int) else tuple(side or ())
        return Processing(
            **{**({"input_size": sides} if sides else {}), **self.described}
        )

    def source(self, ask: Ask, *, boxes: bool = False, **fields: Any) -> models.Source:
        """Return the source of the network as `Adapted` asks it, given pictures as it
        wants them; `fields` go to `Source`.
        """
        return models.source_of(
            Adapted(self.network, ask, boxes=boxes),
            self.name,
            **{**self.described, **fields},
        )

    def with_texts(
        self, module: nn.Module, names: tuple[str, ...], dtype: torch.dtype
    ) -> models.Source:
        """Return the source of a module made of the network and texts for names."""
        described = self.sized(getattr(self.network.config, "vision_config", None))
        return models.source_of(
            module, self.name, labels=names, dtype=dtype, reads_text=True, **described
        )


def nearly(own: Tensor, ours: Tensor, size: float, dtype: torch.dtype) -> bool:
    """Whether a network's own scores, and those that we work out of its parts in its
    type, are the same but for rounding, as a share of a size.
    """
    return bool(
        (own - ours).abs().max() <= max(ROUNDING, 8.0 * torch.finfo(dtype).eps) * size
    )


def in_pixels(boxes: Tensor, images: Tensor) -> Tensor:
    """Return boxes (N, K, 4), middle and size as shares of images (N, 3, H, W), as
    corners x0 y0 x1 y1 in pixels.
    """
    height, width = images.shape[2:]
    middle, size = boxes.split(2, dim=-1)
    corners = torch.cat([middle - size / 2, middle + size / 2], dim=-1)
    return corners * corners.new_tensor([width, height, width, height])
