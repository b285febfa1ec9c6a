"""Load a `Model` from whatever names it: `load_model`."""

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

from advsearch.calls import drop_unset
from advsearch.catalog import list_built_ins
from advsearch.errors import (
    InputError,
    ModelError,
    UnknownNameError,
    find_similar_names,
)
from advsearch.models import files, reference
from advsearch.models.inputs import EightBitInput, WithImageSize, WithState
from advsearch.models.labels import (
    LabelsOrigin,
    find_labels_origin,
    fit_labels,
    parse_names,
    read_labels,
    read_prompts,
)
from advsearch.models.model import PRESETS, Model, Preprocessing, Read, RemoteNetwork
from advsearch.models.probe import probe_model
from advsearch.models.source import (
    Purpose,
    Source,
    load_callable,
    make_source,
    split_weights,
)
from advsearch.registry import Registry, load_attribute
from advsearch.trust.foreign_code import (
    find_expected_torch_state,
    use_default_torch_state,
    use_torch_state_in_calls,
)

DEFAULT_INPUT_SIZE = (224, 224)  # if neither the model nor the caller states one

SOURCES: Registry[Callable[..., Source | Model]] = Registry(
    "advsearch.models",
    list_built_ins("model source"),
    "a function from the whole text, such as 'zoo:resnet18', to a Source or a Model",
    lambda name, entry: callable(entry),
)
"""Loaders of ``SOURCE:NAME`` by source."""

# Sources whose loader takes a `Purpose`.
SOURCES_WITH_PURPOSE = ("timm", "hf", "http", "https")

# The forms of a model's name, for messages.
FORMS = (
    "A model is 'reference', a file (.pt2, TorchScript or .onnx), 'torchvision:NAME', "
    "'timm:NAME', 'hf:REPOSITORY', "
    "an address (https://...), 'package.module:callable', or in Python an nn.Module"
)


@use_default_torch_state()
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
    """Load a model and probe its outputs once.

    The result is a function from images to logits. For an option that is None, the
    value that the model itself states is used, or else the default that is listed here.

    Args:
        spec: ``"reference"`` (the bundled classifier); a path to a `torch.export`
            archive (.pt2) or to TorchScript; ``"package.module:callable"``, which
            returns an `nn.Module` or a `Model`; ``"torchvision:NAME"`` and the like,
            with ``"@weights.safetensors"`` behind any of them for other weights; an
            address, ``"https://..."`` (docs/addresses.md); an `nn.Module` (it is
            copied, and the copy shares its weights, unless they were created in
            `torch.inference_mode`); or a `Model`.
        labels: the names of classes in index order, or a label file (see
            `read_labels`). A network that compares images with texts needs them.
            Default "class 0", "class 1", ...
        prompt: text into which a network that compares images with texts puts each
            name, with ``{}`` in its place. Multiple prompts (a list, or a text with |
            between them) are averaged. Default `advsearch.models.labels.PROMPT`.
        name: name of the model in messages and results.
        input_size: (height, width) in pixels, or one number; default 224.
        mean: one number, three, or ``"imagenet"``, ``"half"``, ``"clip"``, in units of
            `value_range`; default 0.
        std: standard deviation in the same forms; default 1. The name of a preset for
            `mean` or `std` sets both.
        value_range: (low, high), the values of black and white; default (0, 1).
        layout: ``"NCHW"`` (default) or ``"NHWC"``.
        channels: ``"RGB"`` (default) or ``"BGR"``.
        max_batch: maximum batch size; default 64, or what the program allows.
        task: as in `attack`. It defines how outputs are read. Default: classification,
            unless there is `read`.
        read: finds the output in what the network returns for a number of images, if
            it is not logits: a tensor (N, ...) or a list of N elements.
        ask: limits and prices of a model behind an address (docs/addresses.md), such as
            {"calls": 500}.

    Raises:
        UnknownNameError: `spec` is an unknown name; the message has similar names.
        FileFormatError: a model or label file is missing, empty, truncated, a pickle,
            or of another kind.
        InputError: an option is out of range, or the number of labels is not the number
            of classes.
        ModelError: the model cannot be built or run, or does not return finite logits
            (N, classes).

    Warns:
        ModelWarning: see `advsearch.models.probe.probe_model`.
    """
    options = drop_unset(
        {
            "input_size": input_size,
            "mean": mean,
            "std": std,
            "value_range": value_range,
            "layout": layout,
            "channels": channels,
            "max_batch": max_batch,
        }
    )
    # A function that the caller gives takes precedence over that of the task. None
    # means that the output is logits.
    read = read or (task and task.output_reader)
    names = None if labels is None else read_labels(labels)
    origin = find_labels_origin(labels)
    _check_names_source(names, task)
    prompts = read_prompts(prompt)  # first, because loading a model takes seconds
    source = _find_source(spec, _state_purpose(task, names, prompts, ask))
    switches = find_expected_torch_state()
    if prompts is not None:
        _check_reads_text(source, spec)
    # `switches` are those of torch that the code of the network expects.
    if isinstance(source, Source) and isinstance(source.module, nn.Module):
        use_torch_state_in_calls(source.module, switches)
    if task:
        source = replace(source, module=task.wrap_network(source.module))
    if isinstance(source, Model):
        model = _adapt_model(source, options, read, name, names, origin)
    else:
        source = _complete_source(source, read)
        _check_max_batch(max_batch)
        model = _probe_source(source, options, read, name, names, origin)
    # The model can be loaded again from its name alone, such as in a resumed run, only
    # if the user set nothing else.
    is_defined_by_spec = not options and labels is None and name is None
    if isinstance(spec, (str, os.PathLike)) and is_defined_by_spec:
        return replace(model, spec=os.fspath(spec))
    return model


def _check_names_source(names: tuple[str, ...] | None, task: Any) -> None:
    """Raise InputError if a user gave names to a task that has names of its own."""
    if names is not None and task and task.names_source:
        raise InputError(
            f"labels: the names of task {task.name} are those of "
            f"{task.names_source}; leave `labels` out"
        )


def _complete_source(source: Source, read: Read | None) -> Source:
    """Return a source with what it stores of its training, if its outputs are read.

    Raises:
        ModelError: the network takes more than images.
    """
    _check_takes_images_alone(source)
    if read is not None and isinstance(source.module, nn.Module):
        return _add_training_arguments(source)
    return source


def _state_purpose(
    task: Any,
    names: tuple[str, ...] | None,
    prompts: tuple[str, ...] | None,
    ask: Mapping[str, float] | None,
) -> Purpose:
    """Return what a model is loaded for, which the loaders of some sources need.

    Args:
        task: task that reads the model; None for classification.
        names: names of classes; None if the user gave none.
        prompts: texts with ``{}`` that each name is put into; None for the default.
        ask: limits and prices of a model behind an address, such as {"calls": 500}.
    """
    return Purpose(
        task=task.name if task else "classification",
        names=names,
        prompts=prompts,
        # Only tasks that read answers in words have these two: the maximum length of an
        # answer in tokens, and the number of answers per image.
        tokens=getattr(task, "tokens", 16),
        times=getattr(task, "times", 1),
        ask=ask or {},
    )


def _add_training_arguments(source: Source) -> Source:
    """Return a source completed by what YOLO networks store of their training.

    They have the names of classes in `names` and the image size in `args["imgsz"]`.
    Labels and size that the source itself states take precedence.
    """
    arguments = getattr(source.module, "args", None)
    size = arguments.get("imgsz") if isinstance(arguments, Mapping) else None
    input_size = (size, size) if isinstance(size, int) and size > 1 else None
    return replace(
        source,
        labels=source.labels or parse_names(getattr(source.module, "names", None)),
        input_size=source.input_size or input_size,
    )


def _check_max_batch(max_batch: object) -> None:
    """Raise InputError if a value is neither None nor an integer of at least 1."""
    if max_batch is None:
        return
    is_integer = isinstance(max_batch, int) and not isinstance(max_batch, bool)
    if not is_integer or max_batch < 1:  # type: ignore[operator]
        raise InputError(
            f"max_batch: expected a whole number of at least 1, got {max_batch!r}"
        )


def _check_reads_text(source: Source | Model, spec: object) -> None:
    """Raise InputError if a model cannot use a prompt.

    A network that reads no text cannot, nor can a `Model` that the user passed, since
    it is complete.

    Args:
        source: what was found for `spec`.
        spec: what the user passed to `load_model`. If that is a `Model`, then `source`
            is the same object.
    """
    if isinstance(source, Source):
        reads_text = source.reads_text
    else:
        # a language model behind an address
        reads_text = isinstance(source.module, RemoteNetwork)
    is_model_of_user = source is spec
    if is_model_of_user or not reads_text:
        raise InputError(
            f"prompt: model {source.name} has its own classes and "
            "reads no text; leave `prompt` out"
        )


def _check_takes_images_alone(source: Source) -> None:
    """Raise ModelError if a network takes more than images and nothing provides it."""
    if source.takes_more and not isinstance(source.module, WithState):
        raise ModelError(
            f"model {source.name}: takes more than pictures; give task "
            "command the `state` that it takes"
        )


def _adapt_model(
    model: Model,
    options: Mapping[str, Any],
    read: Read | None,
    name: str | None,
    names: tuple[str, ...] | None,
    origin: LabelsOrigin,
) -> Model:
    """Return a complete model with another name, other names of classes, or reader.

    Args:
        model: the model, whose preprocessing stays.
        options: options of the preprocessing that the user set. Each of them is an
            error, as the model already has its preprocessing.
        read: finds the output in what the network returns; None for the model's own
            reader.
        name: name of the model; None for its own.
        names: names of classes; None for its own.
        origin: where the names come from, for messages.

    Raises:
        InputError: there are options, or the number of names is not that of classes.
    """
    if options:
        raise InputError(
            f"model {model.name} has its own preprocessing: leave out "
            f"{', '.join(options)}, or load its network again"
        )
    # `spec` alone does not load the model with another name or other labels. Another
    # `read` does not matter, since it usually follows from the task.
    has_same_names = names is None and name is None
    spec = model.spec if has_same_names else None
    read = read or model.read
    model = replace(model, name=name or model.name, read=read, spec=spec)
    return model if names is None else _replace_labels(model, names, origin)


def _replace_labels(
    model: Model, names: tuple[str, ...], origin: LabelsOrigin
) -> Model:
    """Return a model with other names of its classes.

    Args:
        model: the model.
        names: names of classes.
        origin: where the names come from, for messages.

    Raises:
        InputError: the number of names is not that of classes.
    """
    returns_logits = model.read is None
    if returns_logits:
        # Only logits have a known number of classes, which the names must fit.
        names = fit_labels(model.classes, names, origin, model.name)
    return replace(model, labels=names, named=True)


def _probe_source(
    source: Source,
    options: Mapping[str, Any],
    read: Read | None,
    name: str | None,
    names: tuple[str, ...] | None,
    origin: LabelsOrigin,
) -> Model:
    """Create a model from a source and the options of `load_model`, and probe it.

    Args:
        source: source of the network.
        options: options that are set.
        read: finds the output in what the network returns; None for logits.
        name: name of the model; None for that of the source.
        names: names of classes; None for those of the source.
        origin: where the names come from, for messages.
    """
    preprocessing = _make_preprocessing(source, options)
    model = Model(
        module=_adapt_to_images_alone(source, preprocessing),
        name=name or source.name,
        labels=(),  # `probe_model` sets them, when the number of classes is known
        preprocessing=preprocessing,
        batch_limits=_limit_batch_size(source, options.get("max_batch")),
        dtype=source.dtype,
        device=source.device,
        read=read,
    )
    class_names = source.labels if names is None else names
    return probe_model(model, class_names, origin)


def _limit_batch_size(source: Source, max_batch: int | None) -> tuple[int, int]:
    """Return the minimum and maximum batch size of a network.

    The option `max_batch` cannot go below what the network needs.
    """
    min_size, max_size = source.batch_limits
    if max_batch:
        max_size = min(max_size, max_batch)
    return min_size, max(min_size, max_size)


def _adapt_to_images_alone(
    source: Source, preprocessing: Preprocessing
) -> Callable[[Tensor], Any]:
    """Return the network of a source as one that is called with images alone.

    Some networks also take the size of the images (`size_type` is the type in which
    they take it): the result passes it to them. The inputs of a network with a state,
    such as a speed, are already complete: `WithState` passes all of them.

    Args:
        source: source of the network.
        preprocessing: states the layout of the images.
    """
    if source.size_type is None or isinstance(source.module, WithState):
        return source.module
    return WithImageSize(source.module, source.size_type, preprocessing.layout)


def parse_code_reference(spec: str) -> str | None:
    """Return the "package.module:attribute" that a model's name imports.

    None if it imports nothing: a source such as "timm:resnet18", a path, or
    "reference". A file of weights behind an @ is left out.
    """
    text = spec.strip()
    is_source = text.partition(":")[0].lower() in SOURCES
    # two dotted names of Python with a colon between them, perhaps with weights
    is_reference = re.fullmatch(r"[^\W\d][\w.]*:[^\W\d][\w.]*(@.+)?", text) is not None
    if is_source or not is_reference:
        return None
    return split_weights(text)[0]


def _find_source(spec: object, purpose: Purpose) -> Source | Model:
    """Find the source of a model, or the model itself.

    Args:
        spec: what the user passed to `load_model`: a name, a path, a network, or a
            `Model`.
        purpose: what the model is loaded for.

    Raises:
        InputError: `spec` is something else, or an unknown name.
    """
    if isinstance(spec, Model):
        return spec
    if isinstance(spec, nn.Module):
        library_source = _find_library_source(spec, purpose)
        return library_source or make_source(spec, type(spec).__name__)
    if isinstance(spec, os.PathLike):
        return files.load_file(Path(spec))
    if isinstance(spec, str):
        return _find_named_source(spec.strip(), purpose)
    got = type(spec).__name__
    if isinstance(spec, type):
        got = f"the class {spec.__name__} (pass an instance)"
    raise InputError(
        f"model: expected a name, a path, an nn.Module or a Model, got {got}. {FORMS}"
    )


def _find_named_source(text: str, purpose: Purpose) -> Source | Model:
    """Find the source of a model that a text names, or the model itself.

    The forms are tried in this order: the bundled "reference", "SOURCE:NAME",
    "package.module:callable", a path.

    Args:
        text: the name, perhaps with "@weights.safetensors" behind it.
        purpose: what the model is loaded for, such as the task.

    Raises:
        UnknownNameError: the text has none of these forms.
        InputError: it names a Python file instead of a module ("nets.py:build").
    """
    name, weights = split_weights(text)  # weights are the file behind an @
    if name == "reference":
        return reference.load(weights=weights)
    prefix = text.partition(":")[0].lower()
    if ":" in text and prefix in SOURCES:
        load = SOURCES[prefix]
        return load(text, purpose) if prefix in SOURCES_WITH_PURPOSE else load(text)
    if re.fullmatch(r"[\w.-]+\.py:[\w.]+", text):
        raise InputError(
            f"model {text!r}: write {text.replace('.py:', ':')!r}, without the '.py'"
        )
    if parse_code_reference(text) is not None:
        # If there is no such package, it may be a misspelt source: the message of the
        # error then has similar names of `SOURCES`.
        return load_callable(text, SOURCES)
    if _is_model_path(text):
        return files.load_file(Path(text))
    raise _make_unknown_error(text)


def _is_model_path(text: str) -> bool:
    """Return whether a text is meant as the path of a model file."""
    return (
        Path(text).suffix.lower() in files.SUFFIXES
        or "/" in text
        or os.sep in text
        or os.path.exists(text)
    )


def _make_unknown_error(text: str) -> UnknownNameError:
    """Return the error for an unknown name of a model, with similar names.

    A name without a colon, such as "resnet18", may be that of a library's network. Then
    the message states how it is written with its library.
    """
    # how a model of some sources is written; other sources have "SOURCE:NAME"
    forms = {
        "hf": "hf:REPOSITORY",
        "http": "http://ADDRESS",
        "https": "https://ADDRESS",
    }
    names = ["reference", *(forms.get(source, f"{source}:NAME") for source in SOURCES)]
    hint = FORMS
    may_be_of_library = re.fullmatch(r"[\w.-]+", text)
    is_misspelt_reference = bool(find_similar_names(text, ["reference"]))
    if may_be_of_library and not is_misspelt_reference:
        hint = (
            "A library's network is written with its library: "
            f"'torchvision:{text}' or 'timm:{text}'. {FORMS}"
        )
    return UnknownNameError("model", text, names, hint)


def _find_library_source(network: nn.Module, purpose: Purpose) -> Source | None:
    """Return the source of a network that a known library has built, else None.

    Libraries such as transformers and timm describe their networks: preprocessing and
    names of classes follow from that description.

    Args:
        network: network that the user passed.
        purpose: what the model is loaded for, such as the task.
    """
    for library, recognizer in list_built_ins("recognizer").items():
        # A network of a library that is not imported cannot exist.
        if library in sys.modules:
            recognize: Callable[[nn.Module, Purpose], Source | None] = load_attribute(
                recognizer.import_path
            )
            source = recognize(network, purpose)
            if source is not None:
                return source
    return None


def _check_processor(source: Source, options: Mapping[str, Any]) -> None:
    """Raise InputError for options that repeat what a source's processor does.

    A processor is the preprocessing that a library supplies with a network.

    Args:
        source: source of the network.
        options: options of `load_model` that the user set.
    """
    if not source.processor:
        return
    for key in ("mean", "std", "value_range", "channels"):
        if key in options:
            raise InputError(
                f"{key}: model {source.name} has a processor that does "
                "all of this; leave it out"
            )


def _parse_choice(key: str, value: object, choices: tuple[str, ...]) -> str:
    """Return the choice that the value of an option names, in any case.

    Raises InputError if it is none of them.
    """
    choice = str(value).strip().upper()
    if choice not in choices:
        raise InputError(f"{key}: expected one of {', '.join(choices)}, got {value!r}")
    return choice


def _make_preprocessing(source: Source, options: Mapping[str, Any]) -> Preprocessing:
    """Create the preprocessing of a network.

    An option of the user takes precedence over what the source states, which takes
    precedence over the defaults.

    Args:
        source: source of the network.
        options: options of `load_model`, Python values or strings from a command line.

    Raises:
        InputError: an option is out of range, or the source's processor excludes it.
    """
    _check_processor(source, options)
    fields = _list_source_fields(source)
    if "input_size" in options:
        fields["input_size"] = _parse_input_size(options["input_size"])
    fields |= _parse_normalization(options)
    _check_std(fields["std"], options)
    if "value_range" in options:
        fields["value_range"] = _parse_value_range(options["value_range"])
    if isinstance(source.module, EightBitInput):
        _check_eight_bit(source.name, fields, options)
    for key, choices in (("layout", ("NCHW", "NHWC")), ("channels", ("RGB", "BGR"))):
        if key in options:
            fields[key] = _parse_choice(key, options[key], choices)
    # Fields that neither the source nor the user states are None or empty: for these,
    # `Preprocessing` has defaults.
    stated_fields = {key: value for key, value in fields.items() if value}
    return Preprocessing(**stated_fields)


def _list_source_fields(source: Source) -> dict[str, Any]:
    """Return the fields of `Preprocessing` as a source states them, by name."""
    fields: dict[str, Any] = {
        "mean": source.mean,
        "std": source.std,
        "layout": source.layout,
        "channels": source.channels,
        "processor": source.processor,
        "input_size": source.input_size or DEFAULT_INPUT_SIZE,
    }
    if source.value_range is not None:
        fields["value_range"] = source.value_range
    return fields


def _check_std(std: Any, options: Mapping[str, Any]) -> None:
    """Raise InputError if a standard deviation is not over 0.

    Args:
        std: three numbers, or None if they are not stated.
        options: options of `load_model`, for the message.
    """
    if any(number <= 0 for number in std or ()):
        raise InputError(
            f"std: expected numbers greater than 0, got {options.get('std', std)!r}"
        )


def _parse_input_size(value: Any) -> tuple[int, int]:
    """Parse (height, width) in pixels from one number or two."""
    expected = "one whole number or (height, width)"
    numbers = _parse_numbers("input_size", value, (1, 2), expected)
    if any(number != int(number) or number < 1 for number in numbers):
        raise InputError(
            f"input_size: expected whole numbers of at least 1, got {value!r}"
        )
    return int(numbers[0]), int(numbers[-1])


def _parse_normalization(options: Mapping[str, Any]) -> dict[str, Any]:
    """Parse the options `mean` and `std`, three numbers each.

    The name of a preset, such as "imagenet", for one of them sets both, unless the user
    stated the other one too.

    Args:
        options: options of `load_model` that the user set.

    Returns:
        Fields of `Preprocessing`, as far as the options determine them.
    """
    fields: dict[str, Any] = {}
    for key in ("mean", "std"):
        value = options.get(key)
        if isinstance(value, str) and value.strip().lower() in PRESETS:
            preset = PRESETS[value.strip().lower()]
            for preset_key, numbers in zip(("mean", "std"), preset, strict=True):
                # The preset does not replace the other option, if the user stated it.
                if preset_key == key or preset_key not in options:
                    fields[preset_key] = numbers
        elif value is not None:
            fields[key] = _parse_channels(key, value)
    return fields


def _parse_channels(key: str, value: Any) -> tuple[float, ...]:
    """Parse three numbers, one for each channel, from one number or three."""
    expected = f"one number, three numbers, or one of {', '.join(PRESETS)}"
    numbers = _parse_numbers(key, value, (1, 3), expected)
    is_single = len(numbers) == 1  # for all channels
    return numbers * 3 if is_single else numbers


def _parse_value_range(value: Any) -> tuple[float, float]:
    """Parse (low, high), the values of black and white."""
    expected = "two numbers (low, high), such as (0, 255)"
    low, high = _parse_numbers("value_range", value, (2,), expected)
    if low >= high:
        raise InputError(f"value_range: expected low < high, got {value!r}")
    return low, high


def _check_eight_bit(
    name: str, fields: Mapping[str, Any], options: Mapping[str, object]
) -> None:
    """Raise InputError if options contradict a network that takes uint8 images.

    Args:
        name: name of the model, for the message.
        fields: fields of the preprocessing, including `value_range`.
        options: options that the user set.
    """
    wrong_keys = [key for key in ("mean", "std") if key in options]
    # The source itself states (0, 255), so that only the option can have changed it.
    if fields["value_range"] != (0.0, 255.0):
        wrong_keys.append("value_range")
    if wrong_keys:
        key = wrong_keys[0]
        raise InputError(
            f"{key}: model {name} takes whole numbers from 0 to 255 (uint8), got "
            f"{options[key]!r}; leave it out"
        )


def _parse_numbers(
    key: str, value: Any, counts: tuple[int, ...], expected: str
) -> tuple[float, ...]:
    """Parse finite numbers from a number, a sequence, or a string with commas.

    Args:
        key: name of the option, for messages.
        value: value to parse.
        counts: allowed counts of numbers, such as (1, 3).
        expected: description of what is expected, for messages.

    Raises:
        InputError: they are no numbers, or their count is none of `counts`.
    """
    problem = InputError(f"{key}: expected {expected}, got {value!r}")
    items = _split_into_items(value)
    try:
        numbers = tuple(float(item) for item in items)
    except (TypeError, ValueError):
        raise problem from None
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise problem
    return numbers


def _split_into_items(value: Any) -> list[Any]:
    """Return the items of a sequence, a tensor or a string with commas; for any other
    value a list with this value.
    """
    if isinstance(value, str):
        value = value.split(",")
    elif hasattr(value, "tolist"):  # a tensor or an array
        value = value.tolist()
    return list(value) if isinstance(value, Sequence) else [value]
