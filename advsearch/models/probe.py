"""Look at a network once, before anyone trusts its outputs: two images, a repetition, a
pair, a gradient.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor, nn

from advsearch.errors import ModelError
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.inputs import EightBitInput, WithImageSize, WithState
from advsearch.models.labels import LabelsOrigin, fitting_labels
from advsearch.models.model import (
    PROGRAMS,
    Detaching,
    Model,
    logits_of,
    read_by,
    tensors_in,
    warn,
)
from advsearch.trust.foreign_code import TookTooLong, first_line, within
from advsearch.trust.stored_files import FACTOR, scaled

# rows that are non-negative and sum to 1 within this are taken for probabilities
PROBABILITY_TOLERANCE = 1e-3
# rows that are non-negative and sum to 100 within this share of it, for percentages
PERCENT_TOLERANCE = 5e-3
# how far from [0, 1] colours are that show whether scores stay in it whatever the
# picture is
FAR = 1000.0
# share of the largest logit by which outputs differ that are the same; kernels' differ
# by 1e-6
REPEAT_TOLERANCE = 1e-3

ROUNDING = 4.0
"""Steps between neighbouring numbers of the network's type by which its pictures are
changed at least, and outputs may differ: a network in bfloat16 tells 0.50 from 0.51 and
no less.
"""

# change of each value of an image, in [0, 1], along the gradient that is checked
STEP = 1e-3

MASKED = 0.9
"""Share of a change by which outputs may miss what the gradient foretells: a sign that
is wrong is a miss of 2, a step function one of 1; kinks of ordinary networks stay under
a half.
"""

AGREES = 0.5
"""Share of a change by which outputs may miss what a gradient foretells that takes the
place of the network's own.
"""

HARDLY = 0.15
"""Median share of their size by which an output's numbers differ between unlike
pictures, below which they hardly follow these. Measured: 0.50 to 1.04 of five trained
networks, and 0.006 to 0.10 with a 255th of their range.
"""

MOST_GROWTH = 2.0
"""How many times larger outputs may be with the right range of colors: 0.98 to 1.22
times of the same five networks. Networks that are not trained grow with their input.
"""

EIGHT_BIT = (0.0, 255.0)  # the other range of colours that networks are made for

# smallest change that is looked at, as a share of the outputs: what is less may be
# rounding
SMALLEST = 1e-5

"""What torch makes of a model file. Others that are made of one have a method `stop`,
which ends what they run.
"""

# pixels of all the images that a network takes at once, at least: 800 MB of numbers
LARGEST = 1 << 26


def probe(
    model: Model, labels: tuple[str, ...] | None, labels_origin: LabelsOrigin
) -> Model:
    """Return the model with `labels`, `probabilities`, `differentiable` and
    `batch_limits` set from what it does. There are labels for each class, or None for
    placeholders ("class 0"); where they came from is for messages.

    It is shown a grey image and one of uniform noise. The idea of looking for
    probabilities, randomness and missing gradients before an attack is AutoAttack's
    (Croce and Hein 2020, the flags of its reference implementation).

    Raises:
        ModelError: it takes more than `LARGEST`, cannot be run on such an image,
            returns something other than logits, or with NaN or infinity.
        InputError: the number of labels is not the number of classes.

    Warns:
        ModelWarning: it returns probabilities (a segmenter's too), differently every
            time, differently in a batch, or no gradient reaches the image.
    """
    (height, width) = model.input_size
    count = max(model.batch_limits[0], 1)
    if count * height * width > scaled(LARGEST):
        raise ModelError(
            f"model {model.name}: takes {count:,} images of {height:,} x {width:,} "
            "pixels at once, expected at most "
            f"{scaled(LARGEST):,} pixels; if you trust it, {FACTOR}=10 in the "
            "environment allows ten times "
            "as many"
        )
    grey = torch.full((1, height, width, 3), 0.5)
    noise = torch.rand(grey.shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        rows = torch.cat([_run(model, grey), _run(model, noise)])
        again = _run(model, grey)
    logits = model.read is None
    if not bool(torch.isfinite(rows).all()):
        which = "grey" if not bool(torch.isfinite(rows[0]).all()) else "noise"
        what = "logits" if logits else "numbers"
        raise ModelError(
            f"model {model.name}: expected finite {what}, got NaN or infinity for a "
            f"{which} image; "
            "check its weights and the value range and normalisation that it expects"
        )
    names = (
        fitting_labels(rows.shape[1], labels, labels_origin, model.name)
        if logits
        else labels or ()
    )
    percentages = logits and _probabilities(rows / 100.0, PERCENT_TOLERANCE)
    probabilities = logits and (percentages or _probabilities(rows))
    if probabilities:
        kind = "percentages that sum to 100" if percentages else "probabilities"
        warn(
            f"model {model.name} returns {kind}. Their logarithm is used, so that "
            "margins are log-odds, "
            "but gradients vanish where a probability rounds to 0 or 1: remove the "
            "final softmax if you can"
        )
    with torch.no_grad():
        output: Any = None if logits else _read(model, noise)
    # (N, classes, h, w)
    maps = isinstance(output, Tensor) and output.ndim == 4 and output.shape[1] > 1
    if maps and _probabilities(output.movedim(1, -1).flatten(0, 2)):
        warn(
            f"model {model.name} returns probabilities for each pixel: margins are "
            "differences of these and no "
            "log-odds, and gradients vanish where one rounds to 0 or 1: remove the "
            "final softmax if you can"
        )
    repeatable = _same(model, rows[:1], again)
    if (
        repeatable
        and logits
        and not probabilities
        and (odd := _odd_scores(model, rows))
    ):
        warn(
            f"model {model.name} returns {odd}. They are taken for logits: the "
            "probabilities that are shown are none, "
            "and margins are differences of such scores. Return what stands before the "
            "last function"
        )
    if repeatable:
        _check_range(
            model, torch.cat([torch.zeros_like(grey), torch.ones_like(grey), noise])
        )
    if not repeatable:
        warn(
            f"model {model.name} differs each time on the same image: results hold "
            "for single draws only"
        )
    return dataclasses.replace(
        _with_gradient(model, noise, repeatable),
        labels=names,
        named=labels is not None,
        probabilities=probabilities,
        batch_limits=_batch_limits(
            model, torch.cat([grey, noise]), rows if repeatable else None
        ),
    )


def _run(model: Model, images: Tensor) -> Tensor:
    """Return the raw output of the network for images (N, H, W, 3) as (N, classes)
    float32 on the CPU. An output of another kind comes as three numbers of each image,
    (N, 3): how many it has, their sum, and the sum of their sizes.
    """
    if model.read is None:
        return logits_of(*_returned(model, images), None, model.name)[
            : len(images)
        ].cpu()
    rows = []
    for output in _read(model, images):
        values = torch.cat(
            [
                torch.zeros(0, device="cpu"),
                *(tensor.float().flatten().cpu() for tensor in tensors_in(output)),
            ]
        )
        rows.append(
            torch.stack(
                [
                    torch.tensor(float(len(values))).to(values),
                    values.sum(),
                    values.abs().sum(),
                ]
            )
        )
    return torch.stack(rows)


def _read(model: Model, images: Tensor) -> Any:
    """Return what is read for images (N, H, W, 3) of a network that returns something
    other than logits.
    """
    assert model.read is not None
    return read_by(model.read, *_returned(model, images), model.name)[: len(images)]


def _returned(model: Model, images: Tensor) -> tuple[Any, int]:
    """Return what the network gives for images (N, H, W, 3), and for how many: no fewer
    than it takes at once.
    """
    x = model.prepared(images)
    with torch.set_grad_enabled(torch.is_grad_enabled()):
        return _guarded(model, lambda: model.ask(x, raw=True)), len(x)


def _guarded(model: Model, call: Callable[[], Any]) -> Any:
    """Return what the foreign network returns; whatever it raises becomes a ModelError
    with advice. A program has to end, for nothing ends it; code of one's own that does
    not is ended by Ctrl-C.
    """
    network = _inner(model.module)
    try:
        stop = getattr(network, "stop", None)
        return within(call, stop) if stop or isinstance(network, PROGRAMS) else call()
    except TookTooLong as error:
        raise ModelError(f"model {model.name}: {error}") from None
    except Exception as error:  # any network may raise anything
        (height, width) = model.input_size
        preprocessing = model.preprocessing
        made_for = ""
        why = _unlike_pictures(network, str(error))
        if isinstance(model.module, WithState) and model.module.state:
            sizes = ", ".join(
                f"{name} (N, {len(numbers)})"
                for name, numbers in model.module.state.items()
            )
            made_for = "`state`"
            why = f"cannot be called with pictures and a state of {sizes[:200]}"
        elif not why:
            picture = (
                f"{preprocessing.channels} image of {height} x {width} pixels "
                "in "
                f"layout {preprocessing.layout}"
            )
            made_for = "`input_size` and `layout`"
            why = f"cannot be run on a {picture}"
        advice = f". Give the {made_for} that it was made for" if made_for else ""
        raise ModelError(
            f"model {model.name}: {why} ({first_line(error)}){advice}"
        ) from error


def _inner(network: Any) -> Any:
    """Return the network inside of what makes it one of single pictures alone."""
    while isinstance(network, (AllAtOnce, WithState, WithImageSize, EightBitInput)):
        network = network.network
    return network


TRUTHS = {"target", "targets", "label", "labels", "annotations", "ground_truth"}
"""What a network in its form for training calls the right labels."""


def _unlike_pictures(network: object, error: str) -> str:
    """What a network that raised an error wants beside pictures or in place of them; ""
    where that does not show.
    """
    if not isinstance(network, nn.Module):
        return ""
    taken: list[inspect.Parameter] = []
    with suppress(TypeError, ValueError):  # it is not written in Python
        taken = list(inspect.signature(network.forward).parameters.values())[1:]
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    needed = {
        one.name
        for one in taken
        if one.kind not in variable and one.default is inspect.Parameter.empty
    }
    missed = TRUTHS & set(re.findall(r"\w+", error))
    if more := [
        parameter.name for parameter in taken if parameter.name in needed | missed
    ]:
        return (
            f"wants {' and '.join(more)} beside pictures; wrap it in an nn.Module that "
            "is called with pictures alone, "
            "as it is used outside of training"
        )
    if any(isinstance(layer, nn.Conv3d) for layer in network.modules()):
        return (
            "is made for videos or volumes (it has an nn.Conv3d), and pictures (N, 3, "
            "H, W) are what is given; wrap it "
            "in an nn.Module that makes one of each picture"
        )
    return ""


def _probabilities(rows: Tensor, tolerance: float = PROBABILITY_TOLERANCE) -> bool:
    sums = rows.sum(dim=1)
    return bool((rows >= 0).all()) and bool(((sums - 1).abs() < tolerance).all())


def _odd_scores(model: Model, rows: Tensor) -> str:
    """What rows of scores (N, classes) are that are neither logits nor probabilities;
    empty of others. A black picture tells a sigmoid from means of the picture, which
    are 0 there; colours far outside of [0, 1] tell it from logits that are small, as
    those of a network that is not trained.
    """
    least = float(rows.min())
    if least >= 0.0 and float(rows.max()) <= 1.0:
        with torch.no_grad():
            height, width = model.input_size
            far = torch.linspace(0.0, FAR, 3 * height * width).reshape(height, width, 3)
            rows = torch.cat([rows, _run(model, torch.zeros_like(far)[None])])
            with suppress(ModelError):  # it may refuse such colours
                rows = torch.cat([rows, _run(model, torch.stack([far, -far]))])
    if (
        0.0 <= float(rows.min())
        and float(rows.max()) <= 1.0
        and bool(rows.any(dim=1).all())
    ):
        return (
            "scores in [0, 1] that do not sum to 1, as after a sigmoid for each class"
        )
    if least >= 0.0 and bool(
        ((torch.exp(-rows).sum(dim=1) - 1.0).abs() < PROBABILITY_TOLERANCE).all()
    ):
        return (
            "costs, of which the least is meant: minus the logarithm of probabilities"
        )
    return ""


def _check_range(model: Model, images: Tensor) -> None:
    """Warn if outputs hardly follow pictures (3, H, W, 3) that are black, white and
    noise, and do so, at no other size, with colours from 0 to 255: the network is made
    for these.

    A network in Python that gives no logits is left alone: where it is not trained, it
    looks the same.
    """
    preprocessing = model.preprocessing
    is_declared = preprocessing.processor is not None or any(
        getattr(preprocessing, name) != default
        for name, default in (
            ("mean", (0.0, 0.0, 0.0)),
            ("std", (1.0, 1.0, 1.0)),
            ("value_range", (0.0, 1.0)),
        )
    )
    is_program = isinstance(_inner(model.module), PROGRAMS) or hasattr(
        _inner(model.module), "stop"
    )
    if is_declared or (model.read is not None and not is_program):
        return
    narrow = _numbers_of(model, images)
    if narrow is None or _relative_change(narrow) >= HARDLY:
        return
    wide_model = dataclasses.replace(
        model, preprocessing=dataclasses.replace(preprocessing, value_range=EIGHT_BIT)
    )
    wide = _numbers_of(wide_model, images)
    if wide is None or wide.shape != narrow.shape or _relative_change(wide) < HARDLY:
        return
    growth = float(wide.abs().amax(dim=0).mean() / narrow.abs().amax(dim=0).mean())
    if 1.0 / MOST_GROWTH < growth < MOST_GROWTH:
        warn(
            f"outputs of model {model.name} hardly follow the picture: they differ by "
            f"{_relative_change(narrow):.1%} "
            "between a black, a white and a random one, and by "
            f"{_relative_change(wide):.0%} if colors go from 0 to "
            "255. If it is made for these, give `value_range=0,255`"
        )


@torch.no_grad()
def _numbers_of(model: Model, images: Tensor) -> Tensor | None:
    """Return the numbers (K, n) that a network gives for images (K, H, W, 3), one after
    the other; of scores in [0, 1] the logits, which do not saturate. None where they
    are none, not finite, or not as many of each.
    """
    rows = []
    for image in images:
        try:
            returned, _ = _returned(model, image[None])
        except ModelError:  # it may refuse such colors
            return None
        numbers = [
            tensor.float().flatten().cpu()
            for tensor in tensors_in(returned)
            if tensor.is_floating_point()
        ]
        rows.append(torch.cat([torch.zeros(0, device="cpu"), *numbers]))
    if len({len(row) for row in rows}) > 1 or len(rows[0]) == 0:
        return None
    outputs = torch.stack(rows)
    if not bool(outputs.isfinite().all()):
        return None
    is_score = float(outputs.min()) >= 0.0 and float(outputs.max()) <= 1.0
    return torch.logit(outputs, eps=1e-6) if is_score else outputs


def _relative_change(outputs: Tensor) -> float:
    """Return the median share of its size by which a number differs between outputs (K,
    n).
    """
    change = outputs.amax(dim=0) - outputs.amin(dim=0)
    size = outputs.abs().amax(dim=0).clamp_min(torch.finfo(torch.float32).tiny)
    return float((change / size).median())


def _same(model: Model, a: Tensor, b: Tensor) -> bool:
    tolerance = max(REPEAT_TOLERANCE, ROUNDING * torch.finfo(model.dtype).eps)
    return bool((a - b).abs().amax() <= tolerance * a.abs().amax().clamp_min(1e-6))


def _batch_limits(model: Model, pair: Tensor, rows: Tensor | None) -> tuple[int, int]:
    low, high = model.batch_limits
    # which takes the pictures of a rig together
    if isinstance(model.module, AllAtOnce):
        return max(low, model.module.cameras), max(
            low, high - high % model.module.cameras
        )
    if high < 2:
        return low, high
    try:
        with torch.no_grad():
            together = _run(model, pair)
    except ModelError:
        return 1, 1
    if rows is not None and not _same(model, rows, together):
        warn(
            f"model {model.name} sees an image differently in a batch: was it exported "
            "in training mode? "
            "Call .eval() before exporting"
        )
    return low, high


def _with_gradient(model: Model, images: Tensor, repeatable: bool) -> Model:
    """Set `differentiable` and `attached`; warn if no gradient reaches the image, or
    outputs do not follow it.
    """
    try:
        why = "it is zero everywhere"
        with Detaching() as detaching:
            try:
                rows, gradient = _slope(model, images)
            except (
                RuntimeError
            ) as error:  # what it detaches may have been all of its gradient
                if not (repeatable and detaching.seen):
                    raise
                why = first_line(error)
                with torch.no_grad():
                    rows = _run(model, images)
                gradient = torch.zeros_like(images)
        if model.read is not None and not bool(rows[:, 0].any()):
            # it sees nothing in noise: its pictures will tell
            return dataclasses.replace(model, differentiable=True)
        if repeatable and detaching.seen:
            whole = dataclasses.replace(model, attached=True)
            # it may detach what must have no gradient, such as for numpy
            with suppress(RuntimeError, ModelError):
                slope = _slope(whole, images)[1]
                # Whether outputs change as this gradient says, and less so as the
                # network's own does. Networks that round behind a `detach` keep their
                # own: the other one is zero.
                for size in (STEP, STEP / 8.0):
                    step = (
                        max(size, ROUNDING * torch.finfo(model.dtype).eps)
                        * (slope - gradient).sign()
                    )
                    seen, (told, less), *_ = _moved(
                        model, images, step, slope, gradient
                    )
                    if abs(seen - told) < min(abs(seen - less), AGREES * abs(told)):
                        model = whole
                        gradient = slope
                        break
        reaches = bool((gradient != 0).any())
        if reaches and repeatable:
            _check_gradient(
                model, images, gradient, detaching.seen and not model.attached
            )
    except (RuntimeError, ModelError) as error:
        reaches = False
        why = first_line(error)
        if EightBitInput in {
            type(model.module),
            type(getattr(model.module, "network", None)),
        }:
            why = (
                "it takes whole numbers from 0 to 255, uint8, and rounding to these "
                "has none"
            )
    if not reaches:
        warn(
            f"no gradient of model {model.name} reaches its image ({why}): use `auto` "
            "or a policy without gradients"
        )
    return dataclasses.replace(model, differentiable=reaches)


def _slope(model: Model, images: Tensor) -> tuple[Tensor, Tensor]:
    """Return what `_run` does of images, and the gradient of `_told` of it; zero where
    nothing is found.
    """
    leaf = images.clone().requires_grad_()
    with torch.enable_grad():
        rows = _run(model, leaf)
        if model.read is not None and not bool(rows[:, 0].any()):
            return rows, torch.zeros_like(images)
        return rows, torch.autograd.grad(_told(rows), leaf)[0]


def _told(rows: Tensor) -> Tensor:
    """Return one number of what `_run` returns, whose gradient is looked at."""
    return (rows * torch.linspace(-1.0, 1.0, rows.shape[1])).sum()


@torch.no_grad()
def _moved(
    model: Model, images: Tensor, step: Tensor, *slopes: Tensor
) -> tuple[float, list[float], list[Tensor], float]:
    """Return by how much `_told` differs a step before and behind images, what each
    slope foretells of that, both ends of the step, and the size of outputs.
    """
    ends = [(images + step).clamp(0.0, 1.0), (images - step).clamp(0.0, 1.0)]
    outputs = [_run(model, end) for end in ends]
    foretold = [float(((ends[0] - ends[1]) * slope).sum()) for slope in slopes]
    return (
        float(_told(outputs[0] - outputs[1])),
        foretold,
        ends,
        float(outputs[0].abs().sum()),
    )


def _check_gradient(
    model: Model, images: Tensor, gradient: Tensor, detached: bool
) -> None:
    """Warn if a network's outputs do not move as its gradient says: it is masked, cut
    off, or not of this network.
    """
    # what suppression leaves may jump in the first only
    sizes = (STEP,) if model.read is None else (STEP, STEP / 8.0)
    told_apart = ROUNDING * torch.finfo(model.dtype).eps
    if told_apart > STEP:
        # a network in half precision bends in the first, and rounds the second
        sizes = (told_apart, told_apart / 8.0)
    for size in sizes:
        seen, (expected,), ends, total = _moved(
            model, images, size * gradient.sign(), gradient
        )
        if (
            model.read is not None
            and len({_choices(model, image) for image in (images, *ends)}) > 1
        ):
            return  # nothing can be said of what jumps
        change = max(abs(seen), abs(expected))
        if change <= SMALLEST * total or abs(seen - expected) <= MASKED * change:
            return
    why = "Steps that round, or a defence that masks gradients?"
    if detached:
        why = (
            "It detaches a part of what it computes, where it rounds or for another "
            "reason."
        )
    warn(
        f"the gradient of model {model.name} does not say how its outputs change: "
        f"{expected:.3g} expected, "
        f"{seen:.3g} seen for a small step along it. {why} A search "
        "that follows them may find nothing: try a policy without gradients beside it"
    )


@torch.no_grad()
def _choices(model: Model, images: Tensor) -> str:
    """What an output has that no gradient moves: how many numbers, which of them are
    whole, and texts. A detector that has suppressed boxes finds more or fewer of them,
    or others, after a small step, and what is returned in words goes on otherwise after
    another word.
    """
    outputs = _read(model, images)
    choices = list[Any]()
    if isinstance(outputs, Tensor):
        return ""
    for tensor in tensors_in(outputs):
        columns = tensor.flatten(1).T if tensor.ndim > 1 else tensor[None]
        choices.append(
            (tensor.shape, columns[(columns == columns.round()).all(dim=1)].tolist())
        )
    mappings = (output for output in outputs if isinstance(output, Mapping))
    return str(
        choices
        + [
            text
            for mapping in mappings
            for text in mapping.values()
            if type(text) is str
        ]
    )
