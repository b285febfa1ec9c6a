"""What the libraries of networks have in common: they may be absent, and their weights may be out of reach.

What an image processor of transformers does to a picture is measured, because its class may overrule what its files
say. One that no size, mean and standard deviation stand for is called, inside the differentiable function.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import socket
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from advsearch.errors import ModelError
from advsearch.models.model import ModelWarning, Triple
from advsearch.models.probe import first_line
from advsearch.models.source import Purpose, Source, source_of
from advsearch.registry import may_fetch


def library(name: str, spec: str, extra: str) -> Any:
    """Return an optional library, that an extra of advsearch installs and a model needs. Raises ModelError where it is
    not installed, or cannot be imported."""
    try:
        return importlib.import_module(name)
    except Exception as error:  # a build for another torch raises RuntimeError, among others
        command = f"pip install 'advsearch[{extra}]'"
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            raise ModelError(f"model {spec}: needs {name}, which is not installed: {command}") from error
        raise ModelError(
            f"model {spec}: needs {name}, which cannot be imported here ({first_line(error)}). Install builds that fit "
            f"each other: {command}, torch's own index where that has them; or export the network with torch.export "
            f"where {name} works, and give the .pt2 file"
        ) from error


@contextlib.contextmanager
def without_unpickling() -> Iterator[None]:
    """Hold `torch.load` to tensors and plain containers, whoever calls it and whatever it asks for."""
    changed = {"TORCH_FORCE_WEIGHTS_ONLY_LOAD": "1", "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": None}
    before = {key: os.environ.get(key) for key in changed}
    _set_environment(changed)
    try:
        yield
    finally:
        _set_environment(before)


@contextlib.contextmanager
def connecting(allowed: bool, tries: list[object]) -> Iterator[None]:
    """Let this thread connect to nobody inside the block, unless that is allowed: what a library has in its cache is
    read all the same. Each try is noted in `tries`."""
    if allowed:
        yield
        return
    names, thread = ("connect", "connect_ex"), threading.get_ident()
    before = {name: getattr(socket.socket, name) for name in names}

    def refusing(name: str) -> Callable[[socket.socket, Any], Any]:
        def connect(self: socket.socket, address: Any) -> Any:
            if threading.get_ident() != thread:
                return before[name](self, address)
            tries.append(address)
            raise ConnectionRefusedError("only a file names this model")

        return connect

    for name in names:
        setattr(socket.socket, name, refusing(name))
    try:
        yield
    finally:
        for name in names:
            setattr(socket.socket, name, before[name])


@contextlib.contextmanager
def reading(spec: str, advice: str) -> Iterator[None]:
    """Turn what a library raises while it fetches and reads a model's weights into a ModelError, which advises what
    else its user may give; it never unpickles, and connects to nobody for a model that only a file names."""
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)  # of single tries to connect: an error is raised in the end
    tries: list[object] = []
    try:
        with without_unpickling(), warnings.catch_warnings(), connecting(may_fetch(spec), tries):
            warnings.simplefilter("ignore")
            yield
    except ModelError:
        raise
    except Exception as error:  # a library raises nearly anything for what is not there or damaged
        if tries:
            raise ModelError(
                f"a file names the model {spec}, which is not on this machine and would be fetched; if you trust it, "
                f"allow it yourself: in Python with advsearch.allow_code({spec!r}), or with `code={spec}`"
            ) from error
        raise ModelError(
            f"model {spec}: cannot be fetched or read ({first_line(error)}). Weights come from the library's cache on "
            f"this machine, else from where it publishes them; they are never unpickled. {advice}"
        ) from error
    finally:
        logging.disable(disabled)


def _set_environment(values: dict[str, str | None]) -> None:
    for key, value in values.items():
        if value is None:
            os.environ.pop(key, None)
        else:
            os.environ[key] = value


Array = npt.NDArray[np.float64]

SIDES = (96, 160)
"""Sides in pixels of the square pictures that a processor is shown."""

TOLERANCE = 1e-3
"""Of the range of a processor's outputs: what it may be off from an affine map."""

FILES = ("preprocessor_config.json", "processor_config.json")
"""Where a repository keeps its processor."""


class Measured(TypedDict, total=False):
    """Fields of `advsearch.models.source.Source`."""

    input_size: tuple[int, int]
    mean: Triple
    std: Triple
    channels: str
    processor: Callable[[Tensor], Tensor]


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
    """Return size, mean, standard deviation and order of channels such that ours is what a processor of transformers
    does.

    Pictures of one colour tell gain and offset of each channel, whatever is resized or cropped: with x in [0, 1],
    ``gain x + offset = (x - mean) / std``. The size is that of a square picture's output. A processor that does
    something else to the values of pixels is returned, to be called, if a gradient goes through it. Raises ModelError:
    no gradient does, or it pads pictures or cuts them into patches.
    """

    def shown(colour: tuple[int, int, int], side: int = SIDES[0]) -> Array:
        return _processed(processor, np.full((side, side, 3), colour, np.uint8), spec)

    black = shown((0, 0, 0))
    found = Measured()
    if black.shape == shown((0, 0, 0), SIDES[1]).shape:  # and not just as large as what it was shown
        found["input_size"] = (black.shape[1], black.shape[2])
    offset = black.mean(axis=(1, 2))
    slopes = [shown(one).mean(axis=(1, 2)) - offset for one in ((255, 0, 0), (0, 255, 0), (0, 0, 255))]
    gains: Array = np.stack(slopes, axis=1)  # what goes in across, what comes out down
    size = max(float(np.abs(gains).max()), 1e-12)
    for level in (51, 128, 255):
        seen = shown((level, level, level))
        asked = offset + gains.sum(axis=1) * (level / 255.0)
        if np.abs(seen - asked[:, None, None]).max() > TOLERANCE * size:
            return _called(processor, spec, found, "changes pixels by something else than a gain and an offset")
    orders = {"RGB": gains, "BGR": gains[:, ::-1]}
    own = [name for name, one in orders.items() if np.abs(one - np.diag(np.diag(one))).max() <= TOLERANCE * size]
    if len(own) != 1 or (gain := np.diag(orders[own[0]])).min() <= 0.0:
        return _called(processor, spec, found, "mixes the channels of a picture, or turns it into its negative")
    return Measured(mean=_triple(-offset / gain), std=_triple(1.0 / gain), channels=own[0], **found)


def _processed(processor: Any, picture: Any, spec: str) -> Array:
    """Return a processor's output (3, h, w) for an 8-bit picture (H, W, 3)."""
    values: Array = np.asarray(processor(images=picture, return_tensors="np")["pixel_values"], np.float64)
    if values.ndim != 4 or values.shape[:2] != (1, 3):
        raise _other(spec, processor, f"returns an array of shape {values.shape} in place of (1, 3, H, W)")
    picked: Array = values[0]
    return picked


def _called(processor: Any, spec: str, found: Measured, what: str) -> Measured:
    """Return what was found, with the processor to be called on a picture of that size."""
    height, width = found.get("input_size", (SIDES[0], SIDES[0]))
    ends = [_processed(processor, np.full((SIDES[0], SIDES[0], 3), level, np.uint8), spec) for level in (0, 255)]
    if (ends[0] == ends[1]).all(axis=0).any():
        raise _other(spec, processor, "pads a square picture, or leaves some of its pixels out")
    levels = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    asked = _processed(partial(processor, **_as_it_is(processor)), levels, spec)
    picture = (torch.from_numpy(levels).float() / 255.0).movedim(2, 0)[None].requires_grad_()
    call = partial(_process, processor)
    try:
        with torch.enable_grad():
            seen = call(picture)
            reaches = bool(torch.autograd.grad(seen.square().sum(), picture)[0].any())
    except Exception as error:  # a processor that works with numpy raises nearly anything
        pil = getattr(processor, "backend", None) == "pil"
        advice = "; with torchvision installed, transformers takes one that may" if pil else ""
        raise _other(spec, processor, f"{what}, and lets no gradient through ({first_line(error)}){advice}") from error
    off = np.abs(seen.detach().double().numpy() - asked).max() if seen.shape == (1, *asked.shape) else np.inf
    if not reaches or not off <= TOLERANCE * np.ptp(asked):
        raise _other(spec, processor, f"{what}, and rounds or does otherwise where a gradient goes through it")
    return Measured(processor=call, **found)


def _process(processor: Any, images: Tensor) -> Tensor:
    """Return what a processor returns for pictures (N, 3, H, W) in [0, 1]: it is shown numbers up to 255, unrounded."""
    does = partial(processor, return_tensors="pt", **_as_it_is(processor))
    return torch.cat([does(images=255.0 * one)["pixel_values"] for one in images]).to(images)


def _as_it_is(processor: Any) -> dict[str, bool]:
    """Return what keeps a processor from resizing and cropping a picture that has the right size."""
    return {name: False for name in ("do_resize", "do_center_crop") if getattr(processor, name, None)}


def _triple(numbers: Array) -> Triple:
    """Round to what eight digits hold: a processor computes in float32."""
    red, green, blue = (float(f"{number:.7g}") + 0.0 for number in numbers)
    return red, green, blue


def _other(spec: str, processor: Any, what: str) -> ModelError:
    return ModelError(
        f"model {spec}: its processor {type(processor).__name__} {what}, which no size, mean and std stand for. Wrap "
        "network and processing in an nn.Module of yours, and give that from Python or as package.module:callable"
    )


UNPREPARED = (
    "model {spec} comes without an image processor: pictures are given as they are, RGB in [0, 1]. Say `mean`, `std` "
    "and `input_size` of load_model if it wants them otherwise"
)


@dataclass(frozen=True, eq=False)
class Loaded:
    """A network of transformers, and what comes with it.

    Args:
        network: itself, a `PreTrainedModel`.
        name: what to call it.
        spec: what its user wrote, for messages.
        processor: its image processor; None where it has none.
        part: loads another part by the class of transformers that does it, such as "AutoTokenizer".
    """

    network: Any
    name: str
    spec: str
    processor: Any
    part: Callable[[str], Any]

    @cached_property
    def described(self) -> Measured:
        """What is done to pictures.

        Raises:
            ModelError: see `measured`.

        Warns:
            ModelWarning: it has no image processor.
        """
        if self.processor is None:
            warnings.warn(UNPREPARED.format(spec=self.spec), ModelWarning, stacklevel=4)
            return Measured()
        return measured(self.processor, self.spec)

    def source(self, module: nn.Module, **fields: Any) -> Source:
        """Return the source of a module that is given pictures as the network wants them; `fields` go to `Source`."""
        return source_of(module, self.name, **{**self.described, **fields})

    def when_named(self, named: Callable[[Any, Any, str, Measured, Purpose], Source]) -> Source:
        """Return the source of a network that reads texts, which is built when the user's names are there: of the
        network, its tokenizer, its name, what is done to pictures, and the purpose."""
        tokenizer, described = self.part("AutoTokenizer"), self.described
        side = getattr(getattr(self.network.config, "vision_config", None), "image_size", None)
        if "input_size" not in described and isinstance(side, int):
            described = Measured(**{**described, "input_size": (side, side)})
        finish = partial(named, self.network, tokenizer, self.name, described)
        return Source(self.network, self.name, finish=finish, reads_text=True)


def in_pixels(boxes: Tensor, images: Tensor) -> Tensor:
    """Return boxes (N, K, 4), middle and size as shares of images (N, 3, H, W), as corners x0 y0 x1 y1 in pixels."""
    height, width = images.shape[2:]
    middle, size = boxes.split(2, dim=-1)
    corners = torch.cat([middle - size / 2, middle + size / 2], dim=-1)
    return corners * corners.new_tensor([width, height, width, height])
