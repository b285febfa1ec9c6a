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
def report_library_errors(spec: str, advice: str) -> Iterator[None]:
    """Turn what a library raises while it loads a model's weights into a ModelError.

    Its message has `advice` on what else the user may give. Nothing is unpickled, and
    nothing is fetched for a model that only a file names.
    """
    disabled = logging.root.manager.disable
    # of single tries to connect: an error is raised in the end
    logging.disable(logging.WARNING)
    tries: list[object] = []
    try:
        with (
            models.without_unpickling(),
            warnings.catch_warnings(),
            models.restrict_connections(models.is_fetch_allowed(spec), tries),
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
                f"{models.explain_how_to_allow(spec)}"
            ) from error
        raise errors.ModelError(
            f"model {spec}: cannot be fetched or read ({models.get_first_line(error)}). "
            "Weights come from the library's "
            "cache on this machine, else from where it publishes them; they are never "
            f"unpickled. {advice}"
        ) from error
    finally:
        logging.disable(disabled)


Array = npt.NDArray[np.float64]

PROBE_SIZES = (96, 160)  # in pixels, of the square pictures that a processor is shown
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


def load_processor(transformers: Any, name: str, where: Mapping[str, Any]) -> Any:
    """Return the image processor of a repository or a directory; None if it has none.

    Its own code is never run.
    """
    if not any(find_cached_file(transformers, name, file, where) for file in FILES):
        return None
    return transformers.AutoImageProcessor.from_pretrained(
        name, trust_remote_code=False, **where
    )


def find_cached_file(
    transformers: Any, name: str, file: str, where: Mapping[str, Any]
) -> str | None:
    """Return the path of a file of a repository or a directory; None if it has none.

    The file of a repository is fetched if it is not in the cache.

    Args:
        transformers: the package.
        name: name of the repository or directory.
        file: its name there.
        where: arguments of `cached_file`, such as a revision.
    """
    path: str | None = transformers.utils.cached_file(
        name, file, _raise_exceptions_for_missing_entries=False, **where
    )
    return path


def measure_processor(processor: Any, spec: str) -> Processing:
    """Measure size, mean, standard deviation and channel order of a transformers
    processor.

    Images of a single color show gain and offset of each channel, whatever is resized
    or cropped: with x in [0, 1], ``gain x + offset = (x - mean) / std``. The size is
    that of the output for a square image. A processor that changes pixels otherwise is
    returned, to be called, if a gradient goes through it.

    Raises:
        ModelError: no gradient goes through it, or it pads images or cuts them into
            patches.
    """

    def process_color(color: tuple[int, int, int], size: int = PROBE_SIZES[0]) -> Array:
        """Return the output (3, h, w) for a square image of one color."""
        return _run_processor(
            processor, np.full((size, size, 3), color, np.uint8), spec
        )

    black = process_color((0, 0, 0))
    processing = Processing()
    # Unless the output is just as large as the input.
    if black.shape == process_color((0, 0, 0), PROBE_SIZES[1]).shape:
        processing["input_size"] = (black.shape[1], black.shape[2])
    offset = black.mean(axis=(1, 2))
    primaries = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
    # Rows are output channels, columns input channels.
    gains: Array = np.stack(
        [process_color(color).mean(axis=(1, 2)) - offset for color in primaries],
        axis=1,
    )
    tolerance = TOLERANCE * max(float(np.abs(gains).max()), 1e-12)
    # grays have to be what gain and offset predict, everywhere in the image
    for level in (51, 128, 255):
        expected = offset + gains.sum(axis=1) * (level / 255.0)
        difference = process_color((level, level, level)) - expected[:, None, None]
        if np.abs(difference).max() > tolerance:
            return _make_called_processing(
                processor,
                spec,
                processing,
                "changes pixels by something else than a gain and an offset",
            )
    # Each output channel may depend on one input channel only, in one of two orders.
    diagonal_gains = {
        channels: np.diag(matrix)
        for channels, matrix in (("RGB", gains), ("BGR", gains[:, ::-1]))
        if np.abs(matrix - np.diag(np.diag(matrix))).max() <= tolerance
    }
    if len(diagonal_gains) == 1:
        ((channels, gain),) = diagonal_gains.items()
        if gain.min() > 0.0:
            return Processing(
                mean=_round_triple(-offset / gain),
                std=_round_triple(1.0 / gain),
                channels=channels,
                **processing,
            )
    return _make_called_processing(
        processor,
        spec,
        processing,
        "mixes the channels of a picture, or turns it into its negative",
    )


def _run_processor(processor: Any, picture: Any, spec: str) -> Array:
    """Run a processor on an 8-bit image (H, W, 3), and return its output (3, h, w)."""
    values: Array = np.asarray(
        processor(images=picture, return_tensors="np")["pixel_values"], np.float64
    )
    if values.ndim != 4 or values.shape[:2] != (1, 3):
        raise _make_processor_error(
            spec,
            processor,
            f"returns an array of shape {values.shape} in place of (1, 3, H, W)",
        )
    picked: Array = values[0]
    return picked


def _disable_resizing(processor: Any) -> Callable[..., Any]:
    """Return a function that calls a processor with its resizing and cropping turned
    off, for images of the right size.
    """
    switches = ("do_resize", "do_center_crop")
    disabled = {name: False for name in switches if getattr(processor, name, None)}
    return partial(processor, **disabled)


def _make_called_processing(
    processor: Any, spec: str, processing: Processing, what: str
) -> Processing:
    """Return the measured size, with the processor to be called on images of it.

    Args:
        processor: processor that is no gain and offset.
        spec: specification of the model, for messages.
        processing: processing with the size, if it is fixed.
        what: the processor does, for messages.

    Raises:
        ModelError: it ignores pixels, or no gradient goes through it.
    """
    height, width = processing.get("input_size", (PROBE_SIZES[0], PROBE_SIZES[0]))
    _check_reads_all_pixels(processor, spec)
    levels = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    process = _disable_resizing(processor)
    expected = _run_processor(process, levels, spec)
    image = torch.from_numpy(levels).float() / 255.0
    images = image.movedim(2, 0)[None].requires_grad_()

    def call(images: Tensor) -> Tensor:
        """Process images (N, 3, H, W) in [0, 1]; values up to 255 stay unrounded."""
        outputs = [
            process(images=255.0 * image, return_tensors="pt")["pixel_values"]
            for image in images
        ]
        return torch.cat(outputs).to(images)

    try:
        with torch.enable_grad():
            output = call(images)
            gradient = torch.autograd.grad(output.square().sum(), images)[0]
            has_gradient = bool(gradient.any())
    except Exception as error:  # a processor with numpy raises nearly anything
        advice = ""
        if getattr(processor, "backend", None) == "pil":
            advice = "; with torchvision installed, transformers takes one that may"
        raise _make_processor_error(
            spec,
            processor,
            f"{what}, and lets no gradient through "
            f"({models.get_first_line(error)}){advice}",
        ) from error
    error_size = np.inf
    if output.shape == (1, *expected.shape):
        error_size = np.abs(output.detach().double().numpy() - expected).max()
    if not has_gradient or not error_size <= TOLERANCE * np.ptp(expected):
        raise _make_processor_error(
            spec,
            processor,
            f"{what}, and rounds or does otherwise where a gradient goes through it",
        )
    return Processing(processor=call, **processing)


def _check_reads_all_pixels(processor: Any, spec: str) -> None:
    """Raise ModelError if a pixel of the output is the same for black and white."""
    black, white = (
        _run_processor(
            processor,
            np.full((PROBE_SIZES[0], PROBE_SIZES[0], 3), level, np.uint8),
            spec,
        )
        for level in (0, 255)
    )
    if (black == white).all(axis=0).any():
        raise _make_processor_error(
            spec, processor, "pads a square picture, or leaves some of its pixels out"
        )


def _round_triple(numbers: Array) -> models.Triple:
    """Round to what eight digits hold: a processor computes in float32."""
    red, green, blue = (float(f"{number:.7g}") + 0.0 for number in numbers)
    return red, green, blue


def _make_processor_error(spec: str, processor: Any, what: str) -> errors.ModelError:
    """Return the error for a processor that cannot be used, with what it does."""
    return errors.ModelError(
        f"model {spec}: its processor {type(processor).__name__} {what}, which no "
        "size, mean and std stand for. Wrap "
        "network and processing in an nn.Module of yours, and give that from Python or "
        "as package.module:callable"
    )


RunNetwork = Callable[
    [Any, Tensor], Any
]  # what asks a network about pictures (N, 3, H, W)


class AdaptedNetwork(nn.Module):
    """A network of a library, called as that library calls it.

    Args:
        network: network of the library.
        ask: calls it on images (N, 3, H, W).
        boxes: whether what it returns are boxes as corners in pixels.
    """

    def __init__(
        self, network: nn.Module, ask: RunNetwork, *, boxes: bool = False
    ) -> None:
        super().__init__()
        self.network = network
        self.ask = ask
        self.boxes_are_corners_in_pixels = boxes

    def forward(self, images: Tensor) -> Any:
        return self.ask(self.network, images)


@dataclass(frozen=True, eq=False)
class LoadedNetwork:
    """A network of transformers, with what belongs to it.

    Attributes:
        network: a `PreTrainedModel`.
        name: name of the model.
        spec: what the user wrote, for messages.
        processor: processor of images; None if it has none.
        load_part: loads another part by its class, such as "AutoTokenizer".
        purpose: purpose of the network.
    """

    network: Any
    name: str
    spec: str
    processor: Any
    load_part: Callable[[str], Any]
    purpose: models.Purpose

    @cached_property
    def preprocessing(self) -> Processing:
        """The preprocessing of images.

        Raises ModelError as `measure_processor`; warns if there is no image processor.
        """
        if self.processor is None:
            models.warn(
                f"model {self.spec} comes without an image processor: pictures are "
                "given as they are, RGB in [0, 1]. "
                "Say `mean`, `std` and `input_size` of load_model if it wants them "
                "otherwise"
            )
            return Processing()
        return measure_processor(self.processor, self.spec)

    @property
    def class_names(self) -> tuple[str, ...]:
        """The names of its classes in its ``config``; none if transformers only numbers
        them.
        """
        labels = getattr(self.network.config, "id2label", None) or {}
        names = tuple(str(labels[key]) for key in sorted(labels, key=int))
        return () if all(re.fullmatch(r"LABEL_\d+", name) for name in names) else names

    def get_sized_preprocessing(self, config: Any) -> Processing:
        """Return the preprocessing, with the size in a part of the network's ``config``
        if it has none.
        """
        size = getattr(config, "image_size", None)
        input_size = (size, size) if isinstance(size, int) else tuple(size or ())
        processing = Processing()
        if input_size:
            processing["input_size"] = input_size
        return Processing(**{**processing, **self.preprocessing})

    def make_source(
        self, ask: RunNetwork, *, boxes: bool = False, **fields: Any
    ) -> models.Source:
        """Return the source of the network as `AdaptedNetwork` calls it.

        Args:
            ask: see `AdaptedNetwork`.
            boxes: see `AdaptedNetwork`.
            **fields: fields of `Source`; they overrule the measured preprocessing.
        """
        return models.make_source(
            AdaptedNetwork(self.network, ask, boxes=boxes),
            self.name,
            **{**self.preprocessing, **fields},
        )

    def make_text_source(
        self, module: nn.Module, names: tuple[str, ...], dtype: torch.dtype
    ) -> models.Source:
        """Return the source of a module made of the network and texts for names."""
        vision_config = getattr(self.network.config, "vision_config", None)
        return models.make_source(
            module,
            self.name,
            labels=names,
            dtype=dtype,
            reads_text=True,
            **self.get_sized_preprocessing(vision_config),
        )


def are_nearly_equal(
    expected: Tensor, computed: Tensor, size: float, dtype: torch.dtype
) -> bool:
    """Return whether a network's scores and those computed from its parts are equal up
    to rounding.

    Args:
        expected: scores of the network itself.
        computed: scores from its parts.
        size: size of the numbers that are summed, which errors are relative to.
        dtype: dtype of the network.
    """
    return bool(
        (expected - computed).abs().max()
        <= max(ROUNDING, 8.0 * torch.finfo(dtype).eps) * size
    )


def to_pixel_corners(boxes: Tensor, images: Tensor) -> Tensor:
    """Convert boxes (N, K, 4), center and size as fractions of images (N, 3, H, W), to
    corners x0, y0, x1, y1 in pixels.
    """
    height, width = images.shape[2:]
    middle, size = boxes.split(2, dim=-1)
    corners = torch.cat([middle - size / 2, middle + size / 2], dim=-1)
    return corners * corners.new_tensor([width, height, width, height])
