"""Probe a network before its outputs are trusted.

It is run on two images, once more on one of them, and on a batch; and its gradient is
checked.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from advsearch.errors import ModelError
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.inputs import (
    EightBitInput,
    WithImageSize,
    WithState,
    is_required,
)
from advsearch.models.labels import LabelsOrigin, fit_labels
from advsearch.models.model import (
    PROGRAMS,
    DetachMode,
    Model,
    list_tensors,
    read_logits,
    read_output,
    warn,
)
from advsearch.trust.foreign_code import (
    ForeignCodeTimeoutError,
    get_first_line,
    run_within_limits,
)
from advsearch.trust.stored_files import FACTOR, scale_limit

# Non-negative rows that sum to 1 within this tolerance are probabilities.
PROBABILITY_TOLERANCE = 1e-3
# Non-negative rows that sum to 100 within this relative tolerance are percentages.
PERCENT_TOLERANCE = 5e-3
# Magnitude of colors outside [0, 1] that show whether scores stay in [0, 1] whatever
# the image is.
FAR_COLOR = 1000.0
# Relative difference of outputs that count as the same; kernels differ by 1e-6.
REPEAT_TOLERANCE = 1e-3

ROUNDING_STEPS = 4.0
"""Minimum change of an image, and tolerance of outputs, in units of the machine epsilon
of the network's dtype. bfloat16, for example, cannot resolve less than the difference
of 0.50 and 0.51.
"""

# Change of each pixel value in [0, 1] over which a gradient is checked.
STEP = 1e-3
# A second, smaller change, over which fewer outputs jump.
STEP_RATIO = 8.0
SMALL_STEP = STEP / STEP_RATIO

MAX_GRADIENT_ERROR = 0.9
"""Maximum relative error of the change of outputs that the gradient predicts. A wrong
sign has an error of 2, a step function one of 1; kinks of ordinary networks stay below
0.5.
"""

MAX_ATTACHED_ERROR = 0.5
"""Likewise, for a gradient that ignores `detach` and replaces the network's own one."""

MIN_RELATIVE_CHANGE = 0.15
"""Minimum of the median relative change of outputs between unlike images. Below it the
outputs hardly depend on the image. Five trained networks had 0.50 to 1.04; with colors
divided by 255, they had 0.006 to 0.10.
"""

MAX_GROWTH = 2.0
"""Maximum factor by which outputs may grow from a wrong range of colors to the right
one. The same five networks had 0.98 to 1.22. Outputs of untrained networks grow more.
"""

EIGHT_BIT = (0.0, 255.0)  # the other range of colors that networks are made for

# Minimum relative change of outputs that is evaluated: a smaller one may be rounding.
MIN_CHANGE = 1e-5

# Maximum number of pixels in the smallest batch that a network takes: 800 MB.
MAX_PIXELS = 1 << 26


def probe_model(
    model: Model, labels: tuple[str, ...] | None, labels_origin: LabelsOrigin
) -> Model:
    """Run a model on test images, and set the fields of the model that follow from it.

    These are `labels`, `probabilities`, `differentiable`, `attached` and
    `batch_limits`. The images are a gray one and one of uniform noise. AutoAttack, a
    set of attacks, checks networks for probabilities, randomness and missing gradients,
    too (Croce and Hein 2020, the flags of its reference implementation).

    Args:
        model: the model, without labels.
        labels: one name for each class; None for placeholders ("class 0").
        labels_origin: where the labels come from, for messages.

    Raises:
        ModelError: its smallest batch has more than `MAX_PIXELS`, it cannot be run on
            these images, or its output is of another form, NaN or infinity.
        InputError: the number of labels is not the number of classes.

    Warns:
        ModelWarning: it returns probabilities; its output differs each time, or in a
            batch; or no gradient reaches the image.
    """
    _check_batch_size(model)
    gray, noise = _make_probe_images(*model.input_size)
    with torch.no_grad():
        rows_of_images = [_compute_output_rows(model, image) for image in (gray, noise)]
        rows = torch.cat(rows_of_images)
        repeated_rows = _compute_output_rows(model, gray)
    _check_finite(model, rows)
    returns_logits = model.read is None
    if returns_logits:
        names = fit_labels(rows.shape[1], labels, labels_origin, model.name)
        probabilities = _find_probabilities(model, rows)
    else:
        names = labels or ()
        probabilities = False
        _warn_of_pixel_probabilities(model, noise)
    # Two outputs for the same gray image; those of a network with dropout differ.
    repeatable = _are_equal(model, rows[:1], repeated_rows)
    if repeatable and returns_logits and not probabilities:
        _warn_of_odd_scores(model, rows)
    if repeatable:
        _check_range(model, _make_unlike_images(noise))
    else:
        warn(
            f"model {model.name} differs each time on the same image: results hold "
            "for single draws only"
        )
    probed = _probe_gradient(model, noise, repeatable)
    # The outputs for a batch are compared with those of single images.
    compared_rows = rows if repeatable else None
    return dataclasses.replace(
        probed,
        labels=names,
        named=labels is not None,
        probabilities=probabilities,
        batch_limits=_find_batch_limits(model, torch.cat([gray, noise]), compared_rows),
    )


def _make_unlike_images(noise: Tensor) -> Tensor:
    """Return a black and a white image, and one of noise, from the latter (1, H, W, 3).

    Returns:
        (3, H, W, 3).
    """
    black = torch.zeros_like(noise)
    white = torch.ones_like(noise)
    return torch.cat([black, white, noise])


def _check_batch_size(model: Model) -> None:
    """Raise ModelError if the smallest batch of a model has too many pixels."""
    height, width = model.input_size
    count = max(model.batch_limits[0], 1)
    if count * height * width > scale_limit(MAX_PIXELS):
        raise ModelError(
            f"model {model.name}: takes {count:,} images of {height:,} x {width:,} "
            f"pixels at once, expected at most {scale_limit(MAX_PIXELS):,} pixels; if "
            f"you trust it, {FACTOR}=10 in the environment allows ten times as many"
        )


def _check_finite(model: Model, rows: Tensor) -> None:
    """Raise ModelError if outputs are not finite.

    Args:
        model: model that is probed.
        rows: output for a gray image, then that for noise.
    """
    if bool(torch.isfinite(rows).all()):
        return
    image = "grey" if not bool(torch.isfinite(rows[0]).all()) else "noise"
    expected = "logits" if model.read is None else "numbers"
    raise ModelError(
        f"model {model.name}: expected finite {expected}, got NaN or infinity for a "
        f"{image} image; "
        "check its weights and the value range and normalization that it expects"
    )


def _make_probe_images(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return a gray image and one of uniform noise, (1, height, width, 3) each."""
    gray = torch.full((1, height, width, 3), 0.5)
    noise = torch.rand(gray.shape, generator=torch.Generator().manual_seed(0))
    return gray, noise


def _find_probabilities(model: Model, rows: Tensor) -> bool:
    """Return whether rows (N, classes) are probabilities or percentages, and warn."""
    are_percentages = _are_probabilities(rows / 100.0, PERCENT_TOLERANCE)
    if not are_percentages and not _are_probabilities(rows):
        return False
    kind = "percentages that sum to 100" if are_percentages else "probabilities"
    warn(
        f"model {model.name} returns {kind}. Their logarithm is used, so that margins "
        "are log-odds, but gradients vanish where a probability rounds to 0 or 1: "
        "remove the final softmax if you can"
    )
    return True


def _warn_of_pixel_probabilities(model: Model, images: Tensor) -> None:
    """Warn if a segmenter returns probabilities for the pixels of images."""
    with torch.no_grad():
        output: Any = _run_and_read(model, images)
    # (N, classes, h, w)
    is_map = isinstance(output, Tensor) and output.ndim == 4 and output.shape[1] > 1
    if is_map and _are_probabilities(output.movedim(1, -1).flatten(0, 2)):
        warn(
            f"model {model.name} returns probabilities for each pixel: margins are "
            "differences of these and no log-odds, and gradients vanish where one "
            "rounds to 0 or 1: remove the final softmax if you can"
        )


def _warn_of_odd_scores(model: Model, rows: Tensor) -> None:
    """Warn if scores (N, classes) are neither logits nor probabilities."""
    kind = _describe_odd_scores(model, rows)
    if kind:
        warn(
            f"model {model.name} returns {kind}. They are used as logits: displayed "
            "probabilities are not meaningful, and margins are differences of such "
            "scores. Return the values before the last function"
        )


def _compute_output_rows(model: Model, images: Tensor) -> Tensor:
    """Run a network on images (N, H, W, 3), and return a row of numbers for each image.

    The rows are for comparisons. For a classifier they are its raw scores (N, classes),
    float32 on the CPU. Any other output, such as boxes, may have a different size for
    each image. So it is summarized by three numbers, (N, 3): the count of its numbers,
    their sum, and the sum of their absolute values.
    """
    if model.read is None:
        # The batch may be filled up with copies of an image, whose logits are cut off.
        returned, batch_size = _run_network(model, images)
        logits = read_logits(returned, batch_size, classes=None, name=model.name)
        return logits[: len(images)].cpu()
    return torch.stack(
        [_summarize_output(output) for output in _run_and_read(model, images)]
    )


def _summarize_output(output: Any) -> Tensor:
    """Return the count of an output's numbers, their sum, and that of their magnitudes,
    (3,).
    """
    # `cat` needs at least one tensor, but an output may have none: an empty one is
    # added.
    tensors = [torch.zeros(0, device="cpu")]
    tensors += [tensor.float().flatten().cpu() for tensor in list_tensors(output)]
    values = torch.cat(tensors)
    size = torch.tensor(float(len(values))).to(values)
    return torch.stack([size, values.sum(), values.abs().sum()])


def _run_and_read(model: Model, images: Tensor) -> Any:
    """Run a network, and return its output as the task reads it.

    The network is one that does not return logits.

    Args:
        model: model that is probed.
        images: (N, H, W, 3).

    Returns:
        The output for each of the N images, a tensor (N, ...) or a list.
    """
    assert model.read is not None
    returned, batch_size = _run_network(model, images)
    output = read_output(model.read, returned, batch_size, model.name)
    # without the outputs for copies of an image that fill up a batch
    return output[: len(images)]


def _run_network(model: Model, images: Tensor) -> tuple[Any, int]:
    """Return a network's own return value for images (N, H, W, 3), and the batch size.

    The batch is larger than N if the network needs a larger one. No output is read from
    the return value (`raw`).
    """
    x = model.prepare(images)
    # A network that raises may leave gradients switched on or off: this context
    # restores the switch at its end.
    with torch.set_grad_enabled(torch.is_grad_enabled()):
        returned = _call_guarded(model, lambda: model.run_network(x, raw=True))
        return returned, len(x)


def _call_guarded(model: Model, call: Callable[[], Any]) -> Any:
    """Call a user's network, and turn whatever it raises into a ModelError with advice.

    A program from a file has a deadline, since it may never end and Ctrl-C does not
    stop it. The user's own Python code has none, as Ctrl-C ends it.

    Args:
        model: the model, for messages.
        call: runs the network.
    """
    network = _unwrap(model.module)
    try:
        # `OnnxNetwork` has a method `stop`, which ends its program.
        stop = getattr(network, "stop", None)
        if stop or isinstance(network, PROGRAMS):
            return run_within_limits(call, stop)
        return call()
    except ForeignCodeTimeoutError as error:
        raise ModelError(f"model {model.name}: {error}") from None
    except Exception as error:  # any network may raise anything
        reason, advice = _explain_failed_call(model, network, error)
        raise ModelError(
            f"model {model.name}: {reason} ({get_first_line(error)}){advice}"
        ) from error


def _explain_failed_call(
    model: Model, network: object, error: Exception
) -> tuple[str, str]:
    """Explain why a network may have raised an error when it was called.

    Args:
        model: the model, with its options.
        network: the user's network in it.
        error: error that it raised.

    Returns:
        The reason, to follow the model's name; and advice, a further sentence or "".
    """
    if isinstance(model.module, WithState) and model.module.state:
        sizes = _list_state_sizes(model.module.state)
        reason = f"cannot be called with pictures and a state of {sizes[:200]}"
        return reason, ". Give the `state` that it was made for"
    reason = _describe_other_inputs(network, str(error))
    if reason:
        return reason, ""
    height, width = model.input_size
    reason = (
        f"cannot be run on a {model.preprocessing.channels} image of "
        f"{height} x {width} pixels in layout {model.preprocessing.layout}"
    )
    return reason, ". Give the `input_size` and `layout` that it was made for"


def _unwrap(network: Any) -> Any:
    """Return the user's network inside the adapters of this package."""
    while isinstance(network, (AllAtOnce, WithState, WithImageSize, EightBitInput)):
        network = network.network
    return network


LABEL_ARGUMENTS = {
    "target",
    "targets",
    "label",
    "labels",
    "annotations",
    "ground_truth",
}
"""Names of arguments that take the right labels, for networks that compute a loss."""


def _list_state_sizes(state: Mapping[str, Sequence[float]]) -> str:
    """Return the names of a state's inputs with their shapes, as text."""
    return ", ".join(f"{name} (N, {len(numbers)})" for name, numbers in state.items())


def _describe_other_inputs(network: object, error: str) -> str:
    """Describe which inputs other than images a network needs.

    Args:
        network: the user's network, which has raised an error.
        error: text of the error, which may name a missing argument.

    Returns:
        A clause to follow the model's name; "" if nothing is known.
    """
    if not isinstance(network, nn.Module):
        return ""
    missing = _list_missing_inputs(network, error)
    if missing:
        return (
            f"needs {' and '.join(missing)} in addition to images; wrap it in an "
            "nn.Module that is called with images only, as outside of training"
        )
    if any(isinstance(layer, nn.Conv3d) for layer in network.modules()):
        return (
            "is made for videos or volumes (it has an nn.Conv3d), but gets images (N, "
            "3, H, W); wrap it in an nn.Module that makes a video or volume of each "
            "image"
        )
    return ""


def _list_missing_inputs(network: nn.Module, error: str) -> list[str]:
    """Return the names of the inputs that a network needs in addition to images.

    These are the arguments without a default. Arguments for training, such as
    `targets`, often have the default None, although the network fails without them:
    they count if the text of the error names them.

    Args:
        network: the user's network.
        error: text of the error that it raised.
    """
    try:
        # without the first parameter, which takes the images
        parameters = list(inspect.signature(network.forward).parameters.values())[1:]
    except (TypeError, ValueError):  # it is not written in Python
        return []
    named_in_error = LABEL_ARGUMENTS & set(re.findall(r"\w+", error))
    return [
        parameter.name
        for parameter in parameters
        if is_required(parameter) or parameter.name in named_in_error
    ]


def _are_probabilities(rows: Tensor, tolerance: float = PROBABILITY_TOLERANCE) -> bool:
    """Return whether all rows (N, classes) are non-negative and sum to 1."""
    sums = rows.sum(dim=1)
    return bool((rows >= 0).all()) and bool(((sums - 1).abs() < tolerance).all())


def _describe_odd_scores(model: Model, rows: Tensor) -> str:
    """Describe scores (N, classes) that are neither logits nor probabilities.

    Scores in [0, 1] are taken for those of a sigmoid under two conditions. They stay in
    [0, 1] for colors far outside of that range: small logits, such as those of an
    untrained network, do not. And they are not all 0 for a black image: means of the
    image's colors are.

    Args:
        model: model that is probed.
        rows: (N, classes) scores for the images so far.

    Returns:
        A description such as "costs"; "" if the scores look like logits.
    """
    is_non_negative = float(rows.min()) >= 0.0
    all_rows = rows
    if is_non_negative and float(rows.max()) <= 1.0:
        all_rows = torch.cat([rows, _run_on_extreme_images(model)])
    is_in_unit_range = float(all_rows.min()) >= 0.0 and float(all_rows.max()) <= 1.0
    every_row_has_score = bool(all_rows.any(dim=1).all())  # a score other than 0
    if is_in_unit_range and every_row_has_score:
        return (
            "scores in [0, 1] that do not sum to 1, as after a sigmoid for each class"
        )
    # If x are the negative logarithms of probabilities, exp(-x) sums to 1.
    sum_error = (torch.exp(-all_rows).sum(dim=1) - 1.0).abs()
    if is_non_negative and bool((sum_error < PROBABILITY_TOLERANCE).all()):
        return (
            "costs (negative logarithms of probabilities), of which the smallest is "
            "the predicted class"
        )
    return ""


@torch.no_grad()
def _run_on_extreme_images(model: Model) -> Tensor:
    """Return the scores for a black image, and for colors far outside of [0, 1].

    The latter are missing if the network rejects such colors.
    """
    height, width = model.input_size
    far_colors = torch.linspace(0.0, FAR_COLOR, 3 * height * width).reshape(
        height, width, 3
    )
    rows = _compute_output_rows(model, torch.zeros_like(far_colors)[None])
    with suppress(ModelError):  # the network may reject such colors
        far_rows = _compute_output_rows(model, torch.stack([far_colors, -far_colors]))
        rows = torch.cat([rows, far_rows])
    return rows


def _check_range(model: Model, images: Tensor) -> None:
    """Warn if a network seems to be made for colors from 0 to 255.

    With colors from 0 to 1 all images look black to such a network, and its outputs
    hardly differ between unlike images. With colors from 0 to 255 its outputs differ,
    and have about the same magnitude. A network in Python that returns no logits is not
    checked, since an untrained one behaves in the same way.

    Args:
        model: model that is probed.
        images: (3, H, W, 3) a black, a white and a random image.
    """
    returns_logits = model.read is None
    is_checked = returns_logits or _is_program(_unwrap(model.module))
    if _is_range_declared(model) or not is_checked:
        return
    outputs = _collect_numbers(model, images)
    if outputs is None or _follows_images(outputs):
        return
    wide_outputs = _find_wide_outputs(model, images, outputs)
    if wide_outputs is not None:
        warn(
            f"outputs of model {model.name} hardly follow the picture: they differ by "
            f"{_compute_relative_change(outputs):.1%} "
            "between a black, a white and a random one, and by "
            f"{_compute_relative_change(wide_outputs):.0%} if colors go from 0 to "
            "255. If it is made for these, give `value_range=0,255`"
        )


def _find_wide_outputs(model: Model, images: Tensor, outputs: Tensor) -> Tensor | None:
    """Return outputs for colors from 0 to 255, if a network seems made for these.

    Args:
        model: model that is probed.
        images: (K, H, W, 3) unlike images.
        outputs: (K, n) numbers for colors from 0 to 1, which hardly differ.

    Returns:
        (K, n); None if these outputs do not differ either, or have another magnitude.
    """
    wide_preprocessing = dataclasses.replace(model.preprocessing, value_range=EIGHT_BIT)
    wide_model = dataclasses.replace(model, preprocessing=wide_preprocessing)
    wide_outputs = _collect_numbers(wide_model, images)
    if wide_outputs is None or wide_outputs.shape != outputs.shape:
        return None
    if not _follows_images(wide_outputs):
        return None
    magnitude = outputs.abs().amax(dim=0).mean()
    wide_magnitude = wide_outputs.abs().amax(dim=0).mean()
    growth = float(wide_magnitude / magnitude)  # infinite or NaN if all outputs are 0
    # Outputs of untrained networks grow with the colors in any case.
    return wide_outputs if 1.0 / MAX_GROWTH < growth < MAX_GROWTH else None


def _is_program(network: object) -> bool:
    """Return whether a network is a program from a file, and no Python code."""
    # Only `OnnxNetwork` has a method `stop`.
    return isinstance(network, PROGRAMS) or hasattr(network, "stop")


def _is_range_declared(model: Model) -> bool:
    """Return whether the user or a library has stated how colors are normalized.

    Then their range is known, and is not guessed.
    """
    preprocessing = model.preprocessing
    return (
        preprocessing.processor is not None
        or preprocessing.mean != (0.0, 0.0, 0.0)
        or preprocessing.std != (1.0, 1.0, 1.0)
        or preprocessing.value_range != (0.0, 1.0)
    )


def _follows_images(outputs: Tensor) -> bool:
    """Return whether outputs (K, n) differ between K unlike images."""
    return _compute_relative_change(outputs) >= MIN_RELATIVE_CHANGE


@torch.no_grad()
def _collect_numbers(model: Model, images: Tensor) -> Tensor | None:
    """Return the numbers (K, n) that a network returns for K images.

    The images (K, H, W, 3) are passed one by one. Scores in [0, 1] are converted to
    logits, since scores near 0 or 1 hardly change. The result is None if the network
    rejects an image, if there are no numbers or not all are finite, or if the count of
    numbers differs between images.
    """
    rows = []
    for image in images:
        try:
            returned, _batch_size = _run_network(model, image[None])
        except ModelError:
            # A network may reject colors of another range, such as 255.
            return None
        rows.append(_join_numbers(returned))
    if len({len(row) for row in rows}) > 1 or len(rows[0]) == 0:
        return None
    outputs = torch.stack(rows)
    if not bool(outputs.isfinite().all()):
        return None
    are_scores = float(outputs.min()) >= 0.0 and float(outputs.max()) <= 1.0
    return torch.logit(outputs, eps=1e-6) if are_scores else outputs


def _join_numbers(returned: Any) -> Tensor:
    """Return all floating-point numbers that a network returned, (n,) on the CPU."""
    numbers = [
        tensor.float().flatten().cpu()
        for tensor in list_tensors(returned)
        if tensor.is_floating_point()
    ]
    # `cat` needs at least one tensor, but there may be none: an empty one is added.
    return torch.cat([torch.zeros(0, device="cpu"), *numbers])


def _compute_relative_change(outputs: Tensor) -> float:
    """Return how much outputs change between K images, relative to their size.

    The relative change of a number is its range over the images, divided by its largest
    absolute value. The result is the median over the n numbers.

    Args:
        outputs: (K, n).
    """
    change = outputs.amax(dim=0) - outputs.amin(dim=0)
    size = outputs.abs().amax(dim=0).clamp_min(torch.finfo(torch.float32).tiny)
    return float((change / size).median())


def _are_equal(model: Model, rows: Tensor, repeated_rows: Tensor) -> bool:
    """Return whether outputs are equal up to the tolerance of the network's dtype."""
    tolerance = max(REPEAT_TOLERANCE, ROUNDING_STEPS * torch.finfo(model.dtype).eps)
    difference = (rows - repeated_rows).abs().amax()
    return bool(difference <= tolerance * rows.abs().amax().clamp_min(1e-6))


def _find_batch_limits(
    model: Model, pair: Tensor, rows: Tensor | None
) -> tuple[int, int]:
    """Return the minimum and maximum batch size, after running a batch of two images.

    A network that fails on two images takes one at a time. There is a warning if the
    output for an image in a batch differs from that for the image alone.

    Args:
        model: model that is probed.
        pair: the two images.
        rows: the outputs for each image alone; None if outputs are not repeatable.
    """
    min_batch, max_batch = model.batch_limits
    if isinstance(model.module, AllAtOnce):
        return _fit_limits_to_rigs(min_batch, max_batch, model.module.cameras)
    if max_batch < 2:
        return min_batch, max_batch
    batch_rows = _compute_rows_if_accepted(model, pair)
    if batch_rows is None:  # it takes only one image at a time
        return 1, 1
    if rows is not None and not _are_equal(model, rows, batch_rows):
        warn(
            f"model {model.name} sees an image differently in a batch: was it exported "
            "in training mode? Call .eval() before exporting"
        )
    return min_batch, max_batch


def _fit_limits_to_rigs(
    min_batch: int, max_batch: int, cameras: int
) -> tuple[int, int]:
    """Return batch limits with which the images of a rig stay together.

    The maximum is a multiple of the number of images of a rig, if that is possible.

    Args:
        min_batch: minimum batch size.
        max_batch: maximum batch size.
        cameras: number of images of a rig.
    """
    max_batch = max(min_batch, max_batch - max_batch % cameras)
    return max(min_batch, cameras), max_batch


def _compute_rows_if_accepted(model: Model, images: Tensor) -> Tensor | None:
    """Return a model's rows for a batch of images; None if the model fails on it."""
    try:
        with torch.no_grad():
            return _compute_output_rows(model, images)
    except ModelError:
        return None


def _probe_gradient(model: Model, images: Tensor, repeatable: bool) -> Model:
    """Return a model with `differentiable` and `attached` set.

    `differentiable` states whether a gradient reaches the image. `attached` states
    whether the gradient is right only if the network's calls of `detach` are ignored;
    this is tried if it has such calls and its outputs are repeatable (`_try_attached`).
    A detector that finds nothing in noise counts as differentiable.

    Args:
        model: model that is probed.
        images: (N, H, W, 3) noise.
        repeatable: whether the network returns the same for the same image; only then
            can changes of outputs be compared with a gradient.

    Warns:
        ModelWarning: no gradient reaches the image, or outputs do not follow it.
    """
    # why there is no gradient, for the warning
    reason = "it is zero everywhere"
    try:
        # the gradient of the network as it is, without ignoring `detach`
        first = _compute_first_gradient(model, images, repeatable)
        if first.reason is not None:
            reason = first.reason
        if _has_no_output(model, first.rows):
            # It detects nothing in noise; rendered images will show its gradient.
            return dataclasses.replace(model, differentiable=True)
        gradient = first.gradient
        if repeatable and first.has_detached:
            # The result may have `attached` set: then gradients go through `detach`.
            model, gradient = _try_attached(model, images, gradient)
        has_gradient = bool((gradient != 0).any())
        if has_gradient and repeatable:
            is_cut_by_detach = first.has_detached and not model.attached
            _check_gradient(model, images, gradient, detached=is_cut_by_detach)
    except (RuntimeError, ModelError) as error:
        has_gradient = False
        reason = _explain_missing_gradient(model, error)
    if not has_gradient:
        warn(
            f"no gradient of model {model.name} reaches its image ({reason}): use "
            "`auto` or a policy without gradients"
        )
    return dataclasses.replace(model, differentiable=has_gradient)


def _explain_missing_gradient(model: Model, error: Exception) -> str:
    """Return why a network has no gradient, by the error that it raised."""
    if _rounds_to_eight_bit(model.module):
        return (
            "it takes whole numbers from 0 to 255, uint8, and rounding to these "
            "has none"
        )
    return get_first_line(error)


def _rounds_to_eight_bit(module: object) -> bool:
    """Return whether a network is wrapped to round its images to 8 bits."""
    # This wrapper may be inside another one.
    networks = (module, getattr(module, "network", None))
    return any(type(network) is EightBitInput for network in networks)


class _FirstGradient(NamedTuple):
    """The gradient of a network whose calls of `detach` are not ignored.

    Attributes:
        rows: rows that `_compute_output_rows` returned for the images.
        gradient: gradient with respect to the images (N, H, W, 3).
        has_detached: whether the network detaches tensors with a gradient.
        reason: why there is no gradient; None if there is one, or if it is not known.
    """

    rows: Tensor
    gradient: Tensor
    has_detached: bool
    reason: str | None = None


def _compute_first_gradient(
    model: Model, images: Tensor, repeatable: bool
) -> _FirstGradient:
    """Compute the gradient of a network's outputs with respect to images (N, H, W, 3).

    If the network detaches everything, autograd raises an error. If outputs are
    repeatable, the result then has a gradient of zero, and the caller tries to ignore
    `detach`. Otherwise the error is raised.

    Raises:
        RuntimeError: there is no gradient for another reason.
    """
    with DetachMode() as detaching:
        try:
            rows, gradient = _compute_gradient(model, images)
        except RuntimeError as error:
            if not (repeatable and detaching.has_detached):
                raise
            with torch.no_grad():
                rows = _compute_output_rows(model, images)
            reason = get_first_line(error)
            no_gradient = torch.zeros_like(images)
            return _FirstGradient(rows, no_gradient, has_detached=True, reason=reason)
    return _FirstGradient(rows, gradient, has_detached=detaching.has_detached)


def _try_attached(
    model: Model, images: Tensor, gradient: Tensor
) -> tuple[Model, Tensor]:
    """Return the model that ignores `detach`, if its gradient is better.

    Each gradient predicts how outputs change over a small step: the one that is closer
    to the actual change is better. The step follows the sign of the difference of both
    gradients, since their predictions differ most there. A network with a
    straight-through gradient, which rounds behind a `detach`, keeps its own gradient,
    because ignoring `detach` makes it zero.

    Args:
        model: model that is probed.
        images: (N, H, W, 3) noise.
        gradient: (N, H, W, 3) the network's own gradient.

    Returns:
        The model to use, and its gradient (N, H, W, 3).
    """
    attached = dataclasses.replace(model, attached=True)
    # A network may have to detach a tensor, such as for numpy, and raises an error if
    # `detach` is ignored. It keeps its own gradient.
    with suppress(RuntimeError, ModelError):
        _, attached_gradient = _compute_gradient(attached, images)
        # A smaller step would be rounded.
        min_step = ROUNDING_STEPS * torch.finfo(model.dtype).eps
        for step_size in (STEP, SMALL_STEP):
            step = max(step_size, min_step) * (attached_gradient - gradient).sign()
            change = _measure_change(model, images, step, attached_gradient, gradient)
            if _is_first_better(change):
                return attached, attached_gradient
    return model, gradient


def _is_first_better(change: _Change) -> bool:
    """Return whether the first of two gradients predicts a change better, and well."""
    attached_change, detached_change = change.predicted
    detached_error = abs(change.actual - detached_change)
    attached_error = abs(change.actual - attached_change)
    is_better = attached_error < detached_error
    is_accurate = attached_error < MAX_ATTACHED_ERROR * abs(attached_change)
    return is_better and is_accurate


def _compute_gradient(model: Model, images: Tensor) -> tuple[Tensor, Tensor]:
    """Return the output for images, and the gradient of one number computed from it.

    That number is a weighted sum of the output (`_compute_checked_value`). The gradient
    (N, H, W, 3) is zero if nothing is detected.

    Args:
        model: model that is probed.
        images: (N, H, W, 3).
    """
    leaf = images.clone().requires_grad_()  # autograd differentiates with respect to it
    with torch.enable_grad():
        rows = _compute_output_rows(model, leaf)
        if _has_no_output(model, rows):
            return rows, torch.zeros_like(images)
        return rows, torch.autograd.grad(_compute_checked_value(rows), leaf)[0]


def _has_no_output(model: Model, rows: Tensor) -> bool:
    """Return whether a model, such as a detector, finds nothing in all images.

    Args:
        model: model that is probed.
        rows: rows that `_compute_output_rows` returned.
    """
    if model.read is None:  # logits are never empty
        return False
    n_numbers = rows[:, 0]  # the first number of a row is the count of numbers
    return not bool(n_numbers.any())


def _compute_checked_value(rows: Tensor) -> Tensor:
    """Return one number from the rows (N, n) of `_compute_output_rows`, whose gradient is checked.

    It is a sum with weights from -1 to 1. A plain sum of probabilities would always be
    1.
    """
    return (rows * torch.linspace(-1.0, 1.0, rows.shape[1])).sum()


class _Change(NamedTuple):
    """The change of `_compute_checked_value` between images a step before and after.

    Attributes:
        actual: the change.
        predicted: the change that each gradient predicts.
        ends: the two batches of images, after the step and before it.
        total: sum of the absolute values of the outputs after the step. A change that
            is much smaller may be rounding.
    """

    actual: float
    predicted: list[float]
    ends: list[Tensor]
    total: float


@torch.no_grad()
def _measure_change(
    model: Model, images: Tensor, step: Tensor, *gradients: Tensor
) -> _Change:
    """Measure how outputs change around images, and how gradients predict the change.

    Outputs are summarized by one number f (`_compute_checked_value`). Its change is the
    central difference f(x + step) - f(x - step).

    Args:
        model: model that is run.
        images: (N, H, W, 3).
        step: (N, H, W, 3) change of the images; x + step and x - step are clipped to
            [0, 1].
        *gradients: gradients (N, H, W, 3) of f with respect to the images.
    """
    end = (images + step).clamp(0.0, 1.0)
    start = (images - step).clamp(0.0, 1.0)
    end_rows = _compute_output_rows(model, end)
    start_rows = _compute_output_rows(model, start)
    return _Change(
        # f is linear in the rows, so that this is f(x + step) - f(x - step).
        actual=float(_compute_checked_value(end_rows - start_rows)),
        predicted=[float(((end - start) * gradient).sum()) for gradient in gradients],
        ends=[end, start],
        total=float(end_rows.abs().sum()),
    )


def _check_gradient(
    model: Model, images: Tensor, gradient: Tensor, *, detached: bool
) -> None:
    """Warn if a network's outputs do not change as its gradient predicts.

    A defense may mask the gradient, or a rounding may cut it off. The change of outputs
    over a small step along the sign of the gradient is compared with the change that
    the gradient predicts. The gradient counts as right if they agree for one of the
    step sizes.

    Args:
        model: model that is probed.
        images: (N, H, W, 3).
        gradient: (N, H, W, 3), the gradient of `_compute_checked_value`.
        detached: whether the network detaches tensors, for the message.
    """
    change = _find_unpredicted_change(model, images, gradient)
    if change is None:
        return
    reason = "Steps that round, or a defence that masks gradients?"
    if detached:
        reason = (
            "It detaches a part of what it computes, where it rounds or for another "
            "reason."
        )
    warn(
        f"the gradient of model {model.name} does not say how its outputs change: "
        f"{change.predicted[0]:.3g} expected, {change.actual:.3g} observed for a small "
        f"step along it. {reason} A search by this gradient may find nothing: try a "
        "policy without gradients, too"
    )


def _find_unpredicted_change(
    model: Model, images: Tensor, gradient: Tensor
) -> _Change | None:
    """Return the change of outputs for the last step size, if a gradient is wrong.

    None if the gradient predicts the change for one of the step sizes, or if outputs
    jump, so that they cannot be compared with a gradient.

    Args:
        model: model that is probed.
        images: (N, H, W, 3).
        gradient: (N, H, W, 3), the gradient of `_compute_checked_value`.
    """
    returns_logits = model.read is None
    for step_size in _choose_step_sizes(model):
        step = step_size * gradient.sign()
        change = _measure_change(model, images, step, gradient)
        if not returns_logits and _jumps(model, images, change):
            return None
        if _is_predicted(change, change.predicted[0]):  # there is one gradient
            return None
    return change


def _jumps(model: Model, images: Tensor, change: _Change) -> bool:
    """Return whether a part of an output that no gradient changes differs over a step.

    Args:
        model: model that is probed.
        images: (N, H, W, 3) images in the middle of the step.
        change: change of the outputs over it.
    """
    discrete_values = {
        _collect_discrete_values(model, image) for image in (images, *change.ends)
    }
    return len(discrete_values) > 1


def _is_predicted(change: _Change, predicted: float) -> bool:
    """Return whether a change of outputs is as predicted, or so small that it may be
    rounding.
    """
    size = max(abs(change.actual), abs(predicted))
    may_be_rounding = size <= MIN_CHANGE * change.total
    is_predicted = abs(change.actual - predicted) <= MAX_GRADIENT_ERROR * size
    return may_be_rounding or is_predicted


def _choose_step_sizes(model: Model) -> tuple[float, ...]:
    """Return the step sizes over which the gradient of a model is checked.

    They are tried in this order, and it is enough if the gradient holds for one.
    """
    min_step = ROUNDING_STEPS * torch.finfo(model.dtype).eps
    is_half_precision = min_step > STEP
    if is_half_precision:
        # A step that is large compared to rounding may be too large for a linear
        # prediction, and a smaller one may be rounded. Both are tried.
        return (min_step, min_step / STEP_RATIO)
    returns_logits = model.read is None
    if returns_logits:
        return (STEP,)
    # A detector may suppress other boxes after the larger step, so that its outputs
    # jump. Then the smaller step is tried.
    return (STEP, SMALL_STEP)


@torch.no_grad()
def _collect_discrete_values(model: Model, images: Tensor) -> str:
    """Return the part of an output that no gradient changes, as a string to compare.

    These are its shapes, its columns of integers (such as classes), and its texts. They
    jump if a detector suppresses other boxes after a small step, or if a text continues
    differently. The result is "" if the output is a single tensor.

    Args:
        model: model that is probed.
        images: (N, H, W, 3).
    """
    outputs = _run_and_read(model, images)
    if isinstance(outputs, Tensor):
        return ""
    discrete_values = [
        _find_discrete_columns(tensor) for tensor in list_tensors(outputs)
    ]
    for output in outputs:
        if isinstance(output, Mapping):
            texts = [value for value in output.values() if type(value) is str]
            discrete_values += texts
    return str(discrete_values)


def _find_discrete_columns(tensor: Tensor) -> Any:
    """Return the shape of a tensor, and its columns of integers."""
    columns = tensor.flatten(1).T if tensor.ndim > 1 else tensor[None]
    # Classes may be stored as floating-point numbers.
    is_integer = (columns == columns.round()).all(dim=1)
    return tensor.shape, columns[is_integer].tolist()
