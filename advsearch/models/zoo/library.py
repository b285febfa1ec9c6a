"""What the sources of library networks share: errors, and the preprocessing of images.

The effect of an image processor of transformers is measured, because its class may
override what its files state. A processor that cannot be replaced by a size, a mean and
a standard deviation is called as a part of the differentiable function.
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

    Inside this context nothing is unpickled. Nothing is fetched if only a file, and not
    the user, names the model.

    Args:
        spec: name of the model.
        advice: end of the message: what the user may set instead.
    """
    disabled_before = logging.root.manager.disable
    # Libraries log failed connections. This is not needed: an error is raised in the
    # end.
    logging.disable(logging.WARNING)
    # connections that were not allowed, and therefore not made
    rejected: list[object] = []
    try:
        with (
            models.without_unpickling(),
            warnings.catch_warnings(),
            models.restrict_connections(models.is_fetch_allowed(spec), rejected),
        ):
            warnings.simplefilter("ignore")
            yield
    except errors.ModelError:
        raise
    # Libraries raise many types of errors for missing and corrupt files.
    except Exception as error:
        if rejected:
            raise _make_fetch_error(spec) from error
        raise _make_library_error(spec, error, advice) from error
    finally:
        logging.disable(disabled_before)


def _make_fetch_error(spec: str) -> errors.ModelError:
    """Return the error of a model that would be fetched, though only a file names it."""
    return models.CodeNotAllowedError(
        f"a file names the model {spec}, which is not on this machine and "
        f"would be fetched; {models.explain_how_to_allow(spec)}"
    )


def _make_library_error(spec: str, error: Exception, advice: str) -> errors.ModelError:
    """Return the error for a model that a library cannot load."""
    return errors.ModelError(
        f"model {spec}: cannot be fetched or read ({models.get_first_line(error)}). "
        "Weights come from the library's "
        "cache on this machine, else from where it publishes them; they are never "
        f"unpickled. {advice}"
    )


Array = npt.NDArray[np.float64]
Color = tuple[int, int, int]  # red, green, blue, from 0 to 255

# Sizes in pixels of the square images with which a processor is measured.
PROBE_SIZES = (96, 160)
# Maximum difference of a processor's output from that of an affine map, relative to its
# range.
TOLERANCE = 1e-3
# Maximum relative difference between a network's scores and those that are computed
# from its parts.
SCORE_TOLERANCE = 1e-4
# Likewise, in units of the machine epsilon of the network's dtype. It is the larger one
# in half precision.
SCORE_TOLERANCE_IN_EPS = 8.0
# Files of a repository that describe its processor.
FILES = ("preprocessor_config.json", "processor_config.json")


class Processing(TypedDict, total=False):
    """Fields of `advsearch.models.source.Source`."""

    input_size: tuple[int, int]
    mean: models.Triple
    std: models.Triple
    channels: str
    processor: Callable[[Tensor], Tensor]


def load_processor(transformers: Any, name: str, hub_options: Mapping[str, Any]) -> Any:
    """Return the image processor of a repository or a directory; None if it has none.

    Code in the repository is never run.
    """
    if not any(
        find_cached_file(transformers, name, file, hub_options) for file in FILES
    ):
        return None
    return transformers.AutoImageProcessor.from_pretrained(
        name, trust_remote_code=False, **hub_options
    )


def find_cached_file(
    transformers: Any, name: str, file: str, hub_options: Mapping[str, Any]
) -> str | None:
    """Return the path of a file of a repository or a directory; None if it has none.

    The file of a repository is fetched if it is not in the cache.

    Args:
        transformers: the package.
        name: name of the repository or directory.
        file: name of the file in it.
        hub_options: arguments of `cached_file`, such as a revision.
    """
    path: str | None = transformers.utils.cached_file(
        name, file, _raise_exceptions_for_missing_entries=False, **hub_options
    )
    return path


def measure_processor(processor: Any, spec: str) -> Processing:
    """Measure the preprocessing of a transformers processor.

    The result has size, mean, standard deviation and channel order, if the processor is
    an affine map of colors. With x in [0, 1], it returns ``gain x + offset``, which is
    ``(x - mean) / std``. Gains and offset are measured on images of a single color,
    which resizing and cropping do not change. The size is that of the output for a
    square image. The result for any other processor is a function that calls it, if it
    is differentiable.

    Raises:
        ModelError: no gradient goes through it, or it pads images or cuts them into
            patches.
    """
    process_color = partial(_process_color, processor, spec)
    black = process_color((0, 0, 0))
    processing = Processing()
    # If the size of the output depends on that of the input, there is no fixed size.
    if black.shape == process_color((0, 0, 0), PROBE_SIZES[1]).shape:
        processing["input_size"] = (black.shape[1], black.shape[2])
    offset = black.mean(axis=(1, 2))
    gains = _measure_channel_gains(process_color, offset)
    # 1e-12: a processor that returns a constant has no gain
    tolerance = TOLERANCE * max(float(np.abs(gains).max()), 1e-12)
    if not _predicts_grays(process_color, gains, offset, tolerance):
        problem = "changes pixels by something else than a gain and an offset"
        return _wrap_processor(processor, spec, processing, problem)
    # None if an output channel depends on several input channels, or falls with one
    normalization = _find_normalization(gains, offset, tolerance)
    if normalization is None:
        problem = "mixes the channels of a picture, or turns it into its negative"
        return _wrap_processor(processor, spec, processing, problem)
    return Processing(**{**normalization, **processing})


def _process_color(
    processor: Any, spec: str, color: Color, size: int = PROBE_SIZES[0]
) -> Array:
    """Return the output (3, h, w) of a processor for a square image of one color."""
    image = np.full((size, size, 3), color, np.uint8)
    return _run_processor(processor, image, spec)


def _measure_channel_gains(
    process_color: Callable[[Color], Array], offset: Array
) -> Array:
    """Return the gains (3, 3) of input channels (columns) in output channels (rows).

    Args:
        process_color: returns the output (3, h, w) for an image of one color.
        offset: (3,) output for black.
    """
    primaries = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
    gains = [process_color(color).mean(axis=(1, 2)) - offset for color in primaries]
    return np.stack(gains, axis=1)


def _predicts_grays(
    process_color: Callable[[Color], Array],
    gains: Array,
    offset: Array,
    tolerance: float,
) -> bool:
    """Return whether an affine map predicts the output for gray images at every pixel.

    Args:
        process_color: returns the output (3, h, w) for an image of one color.
        gains: (3, 3) gains of input channels (columns) in output channels (rows).
        offset: (3,) output for black.
        tolerance: maximum absolute error.
    """
    for level in (51, 128, 255):
        expected = offset + gains.sum(axis=1) * (level / 255.0)
        difference = process_color((level, level, level)) - expected[:, None, None]
        if np.abs(difference).max() > tolerance:
            return False
    return True


def _find_normalization(
    gains: Array, offset: Array, tolerance: float
) -> Processing | None:
    """Return the mean, standard deviation and channel order of an affine map of colors.

    None unless each output channel depends on one input channel only, in the order RGB
    or BGR, and grows with it.

    Args:
        gains: (3, 3) gains of input channels (columns) in output channels (rows).
        offset: (3,) output for black.
        tolerance: gains up to this one count as 0.
    """
    # With the input channels in the order of the network, the matrix of gains is
    # diagonal.
    gain_of_order = {}
    for order, matrix in (("RGB", gains), ("BGR", gains[:, ::-1])):
        diagonal = np.diag(matrix)
        if np.abs(matrix - np.diag(diagonal)).max() <= tolerance:
            gain_of_order[order] = diagonal
    # Both orders fit only if all gains are about zero.
    if len(gain_of_order) != 1:
        return None
    channels, gain = gain_of_order.popitem()
    if gain.min() <= 0.0:
        return None
    mean = _round_triple(-offset / gain)
    return Processing(mean=mean, std=_round_triple(1.0 / gain), channels=channels)


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
    output: Array = values[0]
    return output


def _disable_resizing(processor: Any) -> Callable[..., Any]:
    """Return a function that calls a processor without resizing and cropping.

    It is for images of the right size.
    """
    switches = ("do_resize", "do_center_crop")
    disabled = {name: False for name in switches if getattr(processor, name, None)}
    return partial(processor, **disabled)


def _wrap_processor(
    processor: Any, spec: str, processing: Processing, what: str
) -> Processing:
    """Return the preprocessing that calls a processor on images of its size.

    Args:
        processor: processor that does more than apply a gain and an offset.
        spec: specification of the model, for messages.
        processing: preprocessing with the size, if it is fixed.
        what: what the processor does, for messages.

    Raises:
        ModelError: it ignores pixels, is not differentiable, or treats floating-point
            images differently.
    """
    _check_reads_all_pixels(processor, spec)
    process = _disable_resizing(processor)
    call = partial(_call_processor, process)
    # A processor without a fixed size takes any.
    default_size = (PROBE_SIZES[0], PROBE_SIZES[0])
    size = processing.get("input_size", default_size)
    levels = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    expected = _run_processor(process, levels, spec)
    image = torch.from_numpy(levels).float() / 255.0
    try:
        output, has_gradient = _call_with_gradient(call, image.movedim(2, 0)[None])
    except Exception as error:  # a processor with numpy raises errors of many types
        problem = _explain_gradient_error(processor, error)
        raise _make_processor_error(
            spec, processor, f"{what}, and {problem}"
        ) from error
    if not has_gradient or not _is_as_expected(output, expected):
        problem = (
            "returns other values for floating-point images than for 8-bit images, or "
            "no gradient"
        )
        raise _make_processor_error(spec, processor, f"{what}, and {problem}")
    return Processing(processor=call, **processing)


def _call_processor(process: Callable[..., Any], images: Tensor) -> Tensor:
    """Process images (N, 3, H, W) in [0, 1].

    The processor expects values up to 255. They are not rounded to integers, since
    rounding has no gradient.
    """
    outputs = [
        process(images=255.0 * image, return_tensors="pt")["pixel_values"]
        for image in images
    ]
    return torch.cat(outputs).to(images)


def _explain_gradient_error(processor: Any, error: Exception) -> str:
    """Return the clause that a processor has no gradient, by the error that it raised."""
    advice = ""
    if getattr(processor, "backend", None) == "pil":
        advice = "; with torchvision installed, transformers takes one that may"
    return f"lets no gradient through ({models.get_first_line(error)}){advice}"


def _is_as_expected(output: Tensor, expected: Array) -> bool:
    """Return whether an output (1, 3, h, w) is the expected one (3, h, w), but for
    rounding.
    """
    max_error = np.inf
    if output.shape == (1, *expected.shape):
        max_error = np.abs(output.detach().double().numpy() - expected).max()
    return bool(max_error <= TOLERANCE * np.ptp(expected))  # False for NaN


def _call_with_gradient(
    call: Callable[[Tensor], Tensor], images: Tensor
) -> tuple[Tensor, bool]:
    """Return the output for images, and whether its gradient is not zero everywhere."""
    variable_images = images.requires_grad_()
    with torch.enable_grad():
        output = call(variable_images)
        gradient = torch.autograd.grad(output.square().sum(), variable_images)[0]
        return output, bool(gradient.any())


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
    """Round to seven significant digits, since a processor computes in float32."""
    red, green, blue = (float(f"{number:.7g}") + 0.0 for number in numbers)
    return red, green, blue


def _make_processor_error(spec: str, processor: Any, what: str) -> errors.ModelError:
    """Return the error for a processor that cannot be used.

    Args:
        spec: specification of the model.
        processor: the processor.
        what: what it does, as a clause.
    """
    return errors.ModelError(
        f"model {spec}: its processor {type(processor).__name__} {what}, which no "
        "size, mean and std stand for. Wrap network and processing in an nn.Module of "
        "yours, and give that from Python or as package.module:callable"
    )


RunNetwork = Callable[[Any, Tensor], Any]
"""Calls a network on images (N, 3, H, W), and returns its output."""


class AdaptedNetwork(nn.Module):
    """Call a network of a library on images (N, 3, H, W).

    Args:
        network: network of the library.
        run_network: calls the network as its library requires.
        returns_pixel_boxes: whether the output has boxes as corners in pixels. The task
            detection reads this attribute.
    """

    def __init__(
        self,
        network: nn.Module,
        run_network: RunNetwork,
        *,
        returns_pixel_boxes: bool = False,
    ) -> None:
        super().__init__()
        self.network = network
        self.run_network = run_network
        self.boxes_are_corners_in_pixels = returns_pixel_boxes

    def forward(self, images: Tensor) -> Any:
        return self.run_network(self.network, images)


@dataclass(frozen=True, eq=False)
class LoadedNetwork:
    """A network of transformers, with its processor and the purpose of loading it.

    Attributes:
        network: a `PreTrainedModel`.
        name: name of the model.
        spec: what the user wrote, for messages.
        processor: processor of images; None if the network has none.
        load_component: loads another part of the repository by its class, such as
            "AutoTokenizer".
        purpose: what the network is loaded for.
    """

    network: Any
    name: str
    spec: str
    processor: Any
    load_component: Callable[[str], Any]
    purpose: models.Purpose

    @cached_property
    def preprocessing(self) -> Processing:
        """The preprocessing of images.

        Raises ModelError like `measure_processor`; warns if there is no image
        processor.
        """
        if self.processor is None:
            models.warn(
                f"model {self.spec} comes without an image processor: images are not "
                "changed, RGB in [0, 1]. Set `mean`, `std` and `input_size` of "
                "load_model if it needs others"
            )
            return Processing()
        return measure_processor(self.processor, self.spec)

    @property
    def class_names(self) -> tuple[str, ...]:
        """The names of classes in the network's ``config``.

        Empty if they are only numbers ("LABEL_0").
        """
        labels = getattr(self.network.config, "id2label", None) or {}
        names = tuple(str(labels[key]) for key in sorted(labels, key=int))
        return () if all(re.fullmatch(r"LABEL_\d+", name) for name in names) else names

    def get_sized_preprocessing(self, config: Any) -> Processing:
        """Return the preprocessing with an image size.

        The measured size takes precedence. If there is none, because the processor
        keeps the size of images, the size that the network's config states is used.

        Args:
            config: ``config`` of the network, or a part of it such as
                ``config.vision_config``; None if there is none.
        """
        # one number for a square, a list of two numbers, or None
        size = getattr(config, "image_size", None)
        input_size = (size, size) if isinstance(size, int) else tuple(size or ())
        default = Processing()
        if input_size:
            default["input_size"] = input_size
        # the later one takes precedence
        return Processing(**{**default, **self.preprocessing})

    def make_source(
        self,
        run_network: RunNetwork,
        *,
        returns_pixel_boxes: bool = False,
        **fields: Any,
    ) -> models.Source:
        """Return the source of the network, with the measured preprocessing.

        Args:
            run_network: calls the network on images (N, 3, H, W).
            returns_pixel_boxes: whether the output has boxes as corners in pixels.
            **fields: fields of `Source`; they take precedence over the measured
                preprocessing.
        """
        network = AdaptedNetwork(
            self.network, run_network, returns_pixel_boxes=returns_pixel_boxes
        )
        return models.make_source(
            network, self.name, **{**self.preprocessing, **fields}
        )

    def make_text_source(
        self, module: nn.Module, names: tuple[str, ...], dtype: torch.dtype
    ) -> models.Source:
        """Return the source of a module that compares images with texts.

        Args:
            module: module that consists of the network and of texts for names.
            names: names of classes.
            dtype: dtype of the images.
        """
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
    """Return whether two ways to compute a network's scores agree up to rounding.

    Args:
        expected: scores of the network itself.
        computed: scores that are computed from its parts.
        size: magnitude of the numbers that are summed; errors are relative to it.
        dtype: dtype of the network.
    """
    relative_tolerance = max(
        SCORE_TOLERANCE, SCORE_TOLERANCE_IN_EPS * torch.finfo(dtype).eps
    )
    max_difference = (expected - computed).abs().max()
    return bool(max_difference <= relative_tolerance * size)


def to_pixel_corners(boxes: Tensor, images: Tensor) -> Tensor:
    """Convert boxes from center and size to corners in pixels.

    Args:
        boxes: (N, K, 4) center x, y, width and height, as fractions of the image.
        images: (N, 3, H, W).

    Returns:
        (N, K, 4) corners x0, y0, x1, y1 in pixels.
    """
    height, width = images.shape[2:]
    center, size = boxes.split(2, dim=-1)
    corners = torch.cat([center - size / 2, center + size / 2], dim=-1)
    return corners * corners.new_tensor([width, height, width, height])
