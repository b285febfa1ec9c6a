"""`load_model`: from what a user names to a `Model`."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from advsearch.catalog import list_built_ins
from advsearch.errors import InputError, ModelError, UnknownNameError, resembling
from advsearch.models import files, reference
from advsearch.models.inputs import EightBitInput, WithImageSize, WithState
from advsearch.models.labels import (
    find_labels_origin,
    fitting_labels,
    names_in,
    read_labels,
    read_prompts,
)
from advsearch.models.model import PRESETS, Model, Preprocessing, Read, RemoteNetwork
from advsearch.models.probe import probe
from advsearch.models.source import (
    Purpose,
    Source,
    load_callable,
    source_of,
    split_weights,
)
from advsearch.registry import Registry, imported
from advsearch.trust.foreign_code import called_under, plainly, turned_by_code

DEFAULT_INPUT_SIZE = (224, 224)  # where neither the model nor the caller says

SOURCES: Registry[Callable[..., Source | Model]] = Registry(
    "advsearch.models",
    list_built_ins("model source"),
    "a function from the whole text, such as 'zoo:resnet18', to a Source or a Model",
    lambda name, entry: callable(entry),
)
"""What loads ``SOURCE:NAME``, by source."""

# those of them that are told what the network is to be asked
FOR_A_PURPOSE = ("timm", "hf", "http", "https")

FORMS = (
    "A model is 'reference', a file (.pt2, TorchScript or .onnx), 'torchvision:NAME', "
    "'timm:NAME', 'hf:REPOSITORY', "
    "an address (https://...), 'package.module:callable', or in Python an nn.Module"
)


@plainly()
def load_model(
    spec: str | os.PathLike[str] | nn.Module | Model,
    *,
    labels: str | os.PathLike[str] | Sequence[str] | None = None,
    prompt: str | Sequence[str] | None = None,
    name: str | None = None,
    input_size: int | Sequence[int] | str | None = None,
    mean: float | Sequence[float] | str | None = None,
    std: float | Sequence[float] | str | None = None,
    value_range: Sequence[float] | str | None = None,
    layout: str | None = None,
    channels: str | None = None,
    max_batch: int | None = None,
    task: Any = None,
    read: Read | None = None,
    ask: Mapping[str, float] | None = None,
) -> Model:
    """Load a model, look at its outputs once, and return it as a function from images
    to logits.

    Options left at None take what the model says of itself, else the defaults named
    here.

    Args:
        spec: ``"reference"`` (the bundled classifier); a path to a `torch.export`
            archive (.pt2) or to TorchScript; ``"package.module:callable"``, which
            returns an `nn.Module` or a `Model`; ``"torchvision:NAME"`` and the like,
            all with ``"@weights.safetensors"`` if wanted; an address, ``"https://..."``
            (docs/addresses.md); an `nn.Module` (copied, its weights shared, unless made
            in `torch.inference_mode`); a `Model`.
        labels: the names in index order, or a label file (see `read_labels`), which a
            network that compares pictures with texts needs. Default "class 0", "class
            1", ...
        prompt: of such a network: the text that each name is put into, with ``{}`` in
            its place; several (a list, or with | between them) are averaged. Default
            `advsearch.models.labels.PROMPT`.
        name: what to call it in messages and results.
        input_size: (height, width) in pixels, or one number; default 224.
        mean: one number, three, or ``"imagenet"``, ``"half"``, ``"clip"``, in units of
            `value_range`; default 0.
        std: likewise; default 1. A preset given for one of `mean` and `std` sets both.
        value_range: (low, high) that black and white are sent to; default (0, 1).
        layout: ``"NCHW"`` (default) or ``"NHWC"``.
        channels: ``"RGB"`` (default) or ``"BGR"``.
        max_batch: the most images at once; default 64, or what the program allows.
        read: what finds the output in what the network returns for so many images,
            where it is not logits: a tensor (N,
            ...) or a list of N things.
        task: as in `attack`. It says how outputs are read. Default: classification,
            unless there is `read`.
        ask: ceilings and prices of a model behind an address (docs/addresses.md).

    Raises:
        UnknownNameError: `spec` is a name that means nothing; near matches are given.
        FileFormatError: a model or label file is missing, empty, truncated, a pickle,
            or of another kind.
        InputError: an option is out of range, or the number of labels is not the number
            of classes.
        ModelError: the model cannot be built or run, or does not return finite logits
            (N, classes).

    Warns:
        ModelWarning: see `advsearch.models.probe.probe`.
    """
    options = {
        "input_size": input_size,
        "mean": mean,
        "std": std,
        "value_range": value_range,
    }
    options |= {"layout": layout, "channels": channels, "max_batch": max_batch}
    given = {key: value for key, value in options.items() if value is not None}
    read = read or (task and task.reader)
    names = None if labels is None else read_labels(labels)
    origin = find_labels_origin(labels)
    if names is not None and task and task.names_from:
        raise InputError(
            f"labels: the names of task {task.name} are those of "
            f"{task.names_from}; leave `labels` out"
        )
    prompts = read_prompts(prompt)  # first, because loading a model takes seconds
    wanted = task.name if task else "classification"
    lengths = (getattr(task, "tokens", 16), getattr(task, "times", 1))
    source = _find(spec, Purpose(wanted, names, prompts, *lengths, ask or {}))
    switches = turned_by_code()
    reads_text = (
        source.reads_text
        if isinstance(source, Source)
        else isinstance(source.module, RemoteNetwork)
    )
    if prompts is not None and (source is spec or not reads_text):
        raise InputError(
            f"prompt: model {source.name} has classes of its own and "
            "reads no text; leave `prompt` out"
        )
    if isinstance(source, Source) and isinstance(source.module, nn.Module):
        called_under(source.module, switches)
    if task:
        source = replace(source, module=task.wrapped(source.module))
    if (
        isinstance(source, Source)
        and source.takes_more
        and not isinstance(source.module, WithState)
    ):
        raise ModelError(
            f"model {source.name}: takes more than pictures; give task "
            "command the `state` that it takes"
        )
    if isinstance(source, Model):
        if given:
            raise InputError(
                f"model {source.name} brings its own preprocessing: leave out "
                f"{', '.join(given)}, or load its network "
                "anew"
            )
        asked = source.asked if names is None and name is None else None
        model = replace(
            source, name=name or source.name, read=read or source.read, asked=asked
        )
        if names is not None:
            if model.read is None:  # the classes of others are counted by their task
                names = fitting_labels(model.classes, names, origin, model.name)
            model = replace(model, labels=names, named=True)
    else:
        # YOLO's have names, and `args` from training
        if read is not None and isinstance(source.module, nn.Module):
            args = getattr(source.module, "args", None)
            side = args.get("imgsz") if isinstance(args, Mapping) else None
            size = (side, side) if isinstance(side, int) and side > 1 else None
            its_names = names_in(getattr(source.module, "names", None))
            source = replace(
                source,
                labels=source.labels or its_names,
                input_size=source.input_size or size,
            )
        if max_batch is not None and (
            isinstance(max_batch, bool)
            or not isinstance(max_batch, int)
            or max_batch < 1
        ):
            raise InputError(
                f"max_batch: expected a whole number of at least 1, got {max_batch!r}"
            )
        low, high = source.batch_limits
        preprocessing = _preprocessing(source, given)
        bare = Model(
            module=_of_images_alone(source, preprocessing),
            name=name or source.name,
            labels=(),
            preprocessing=preprocessing,
            batch_limits=(low, max(low, min(high, max_batch or high))),
            dtype=source.dtype,
            device=source.device,
            read=read,
        )
        model = probe(bare, source.labels if names is None else names, origin)
    alone = (
        isinstance(spec, (str, os.PathLike))
        and not given
        and labels is None
        and name is None
    )
    return replace(model, asked=os.fspath(spec)) if alone else model  # type: ignore[arg-type]


def _of_images_alone(
    source: Source, preprocessing: Preprocessing
) -> Callable[[Tensor], Any]:
    """Return the network of a source as one that is called with pictures alone."""
    if source.size_type is None or isinstance(source.module, WithState):
        return source.module
    return WithImageSize(source.module, source.size_type, preprocessing.layout)


def named_code(spec: str) -> str | None:
    """Return the "package.module:attribute" that a model's name imports; None of one
    that imports none.
    """
    text = spec.strip()
    if text.partition(":")[0].lower() in SOURCES or not re.fullmatch(
        r"[^\W\d][\w.]*:[^\W\d][\w.]*(@.+)?", text
    ):
        return None
    return split_weights(text)[0]


def _find(spec: object, purpose: Purpose) -> Source | Model:
    if isinstance(spec, Model):
        return spec
    if isinstance(spec, nn.Module):
        return _find_library_source(spec, purpose) or source_of(
            spec, type(spec).__name__
        )
    if isinstance(spec, os.PathLike):
        return files.load_file(Path(spec))
    if not isinstance(spec, str):
        got = (
            f"the class {spec.__name__} (pass an instance)"
            if isinstance(spec, type)
            else type(spec).__name__
        )
        raise InputError(
            "model: expected a name, a path, an nn.Module or a Model, "
            f"got {got}. {FORMS}"
        )
    text = spec.strip()
    network, weights = split_weights(text)
    if network == "reference":
        return reference.load(weights=weights)
    source = text.partition(":")[0].lower()
    if ":" in text and source in SOURCES:
        return (
            SOURCES[source](text, purpose)
            if source in FOR_A_PURPOSE
            else SOURCES[source](text)
        )
    if re.fullmatch(r"[\w.-]+\.py:[\w.]+", text):
        raise InputError(
            f"model {text!r}: write {text.replace('.py:', ':')!r}, without the '.py'"
        )
    if named_code(text) is not None:
        return load_callable(text, SOURCES)
    if (
        Path(text).suffix.lower() in files.SUFFIXES
        or "/" in text
        or os.sep in text
        or os.path.exists(text)
    ):
        return files.load_file(Path(text))
    forms = {
        "hf": "hf:REPOSITORY",
        "http": "http://ADDRESS",
        "https": "https://ADDRESS",
    }
    names = ["reference", *(forms.get(source, f"{source}:NAME") for source in SOURCES)]
    hint = FORMS
    # it may be a library's
    if re.fullmatch(r"[\w.-]+", text) and not resembling(text, ["reference"]):
        hint = (
            "A library's network is written with its library: "
            f"'torchvision:{text}' "
            f"or 'timm:{text}'. {FORMS}"
        )
    raise UnknownNameError("model", text, names, hint)


def _find_library_source(network: nn.Module, purpose: Purpose) -> Source | None:
    """Return the source of a network of transformers or timm; None of any other."""
    for library, recognizer in list_built_ins("recognizer").items():
        if library in sys.modules:
            recognize: Callable[[nn.Module, Purpose], Source | None] = imported(
                recognizer.target
            )
            source = recognize(network, purpose)
            if source is not None:
                return source
    return None


def _preprocessing(source: Source, given: Mapping[str, object]) -> Preprocessing:
    """What is done to pictures, by what a user writes (Python values, or strings from a
    command line), or else by the source.
    """
    instead = [
        key
        for key in ("mean", "std", "value_range", "channels")
        if source.processor and key in given
    ]
    if instead:
        raise InputError(
            f"{instead[0]}: model {source.name} has a processor that does "
            "all of this; leave it out"
        )
    fields: dict[str, Any] = {
        key: getattr(source, key)
        for key in ("mean", "std", "layout", "channels", "processor")
    }
    fields["input_size"] = source.input_size or DEFAULT_INPUT_SIZE
    if "input_size" in given:
        sides = _numbers(
            "input_size",
            given["input_size"],
            (1, 2),
            "one whole number or (height, width)",
        )
        if any(side != int(side) or side < 1 for side in sides):
            raise InputError(
                "input_size: expected whole numbers of at least 1, got "
                f"{given['input_size']!r}"
            )
        fields["input_size"] = int(sides[0]), int(sides[-1])
    if source.value_range is not None:
        fields["value_range"] = source.value_range
    for key in ("mean", "std"):
        value = given.get(key)
        # it fills the other too, if that is not given
        if isinstance(value, str) and value.strip().lower() in PRESETS:
            preset = zip(("mean", "std"), PRESETS[value.strip().lower()], strict=True)
            fields |= {
                name: numbers
                for name, numbers in preset
                if name == key or name not in given
            }
        elif value is not None:
            numbers = _numbers(
                key,
                value,
                (1, 3),
                f"one number, three numbers, or one of {', '.join(PRESETS)}",
            )
            fields[key] = (numbers[0], numbers[len(numbers) // 2], numbers[-1])
    if any(number <= 0 for number in fields["std"] or ()):
        raise InputError(
            "std: expected numbers greater than 0, got "
            f"{given.get('std', fields['std'])!r}"
        )
    if "value_range" in given:
        expected = "two numbers (low, high), such as (0, 255)"
        low, high = _numbers("value_range", given["value_range"], (2,), expected)
        if low >= high:
            raise InputError(
                f"value_range: expected low < high, got {given['value_range']!r}"
            )
        fields["value_range"] = (low, high)
    if isinstance(source.module, EightBitInput):
        _check_eight_bit(source.name, fields, given)
    for key, choices in {
        "layout": ("NCHW", "NHWC"),
        "channels": ("RGB", "BGR"),
    }.items():
        if key in given:
            fields[key] = str(given[key]).strip().upper()
            if fields[key] not in choices:
                raise InputError(
                    f"{key}: expected one of {', '.join(choices)}, got {given[key]!r}"
                )
    return Preprocessing(**{key: value for key, value in fields.items() if value})


def _check_eight_bit(
    name: str, fields: Mapping[str, Any], given: Mapping[str, object]
) -> None:
    """Raise InputError where pictures are not to be whole numbers from 0 to 255, of a
    network that takes these.
    """
    wrong = [key for key in ("mean", "std") if key in given]
    if fields["value_range"] != (0.0, 255.0):
        wrong.append("value_range")
    if wrong:
        raise InputError(
            f"{wrong[0]}: model {name} takes whole numbers from 0 to 255 (uint8), got "
            f"{given[wrong[0]]!r}; leave it out"
        )


def _numbers(
    key: str, value: Any, counts: tuple[int, ...], expected: str
) -> tuple[float, ...]:
    """Return finite numbers from a number, a sequence, or comma-separated text; their
    count is one of `counts`.
    """
    problem = InputError(f"{key}: expected {expected}, got {value!r}")
    value = (
        value.split(",")
        if isinstance(value, str)
        else value.tolist()
        if hasattr(value, "tolist")
        else value
    )
    parts = list(value) if isinstance(value, Sequence) else [value]
    try:
        numbers = tuple(float(part) for part in parts)
    except (TypeError, ValueError):
        raise problem from None
    if len(numbers) not in counts or not all(
        math.isfinite(number) for number in numbers
    ):
        raise problem
    return numbers
