"""Read options on the command line: those of a policy or a task, which are fields of
its dataclass, and Mitsuba's scene parameters.
"""

from __future__ import annotations

import inspect
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from enum import Enum
from pathlib import Path
from typing import Any, TypedDict

from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonValue

# Metadata of a field that is no option: the run sets it.
FROM_RUN = {"set by": "the run"}
# Maximum value of a number in options. No run has a budget of more renders.
MAX_OPTION = 1_000_000
MITSUBA_CONTROL = "mitsuba"  # the control whose parameters have Mitsuba's names
# Separates the names of joint tasks, one for each of several models.
TASK_SEPARATOR = "+"


def group_mitsuba_keys(controls: Mapping[str, object]) -> dict[str, object]:
    """Bring controls into the form name to options, where a key has a range.

    All keys of Mitsuba's scene parameters become options of a single control:
    ``{"mitsuba:mug.bsdf.reflectance": RANGE}`` becomes ``{"mitsuba":
    {"mug.bsdf.reflectance": RANGE}}``. The range of a single parameter of another
    control becomes a mapping, too: ``{"pose.yaw": RANGE}`` becomes ``{"pose.yaw":
    {"yaw": RANGE}}``.

    Args:
        controls: options or ranges by name of the control.

    Raises:
        InputError: a key has no range, or has two.
    """
    plain = dict[str, object]()
    ranges = dict[str, object]()
    for name, options in controls.items():
        kind, colon, key = str(name).partition(":")
        if kind == MITSUBA_CONTROL and colon:
            _check_mitsuba_range(name, key, options)
            ranges[key] = options
        else:
            plain[name] = _with_parameter(str(name), options)
    if not ranges:
        return plain
    return {
        **plain,
        MITSUBA_CONTROL: _merge_ranges(plain.get(MITSUBA_CONTROL), ranges),
    }


def _merge_ranges(options: object, ranges: Mapping[str, object]) -> dict[str, object]:
    """Return the options of the control of Mitsuba's parameters with further ranges.

    Args:
        options: options of the control; None if it has none.
        ranges: ranges by key of the parameter.

    Raises:
        InputError: the options are no mapping, or a key has two ranges.
    """
    grouped = options or {}
    if not isinstance(grouped, Mapping) or grouped.keys() & ranges.keys():
        raise InputError(
            f"`controls` {MITSUBA_CONTROL}: expected each of Mitsuba's names once, "
            "with a range"
        )
    return {**grouped, **ranges}


def _check_mitsuba_range(name: str, key: str, options: object) -> None:
    """Check that a key of Mitsuba's scene parameters is there, and has a range.

    Args:
        name: the control, "mitsuba:KEY".
        key: the key.
        options: the range.

    Raises:
        InputError: one of them is missing.
    """
    # a control without options has None, {} or ""
    has_range = options is not None and options not in ({}, "")
    if not key or not has_range:
        raise InputError(
            f"`controls` {name}: expected a range, as in "
            f"{MITSUBA_CONTROL}:{key or 'KEY'}=[0.2, 0.8]"
        )


def _with_parameter(name: str, options: object) -> object:
    """Return the options of a control, with a range stored under its parameter.

    For the control "pose.yaw" the range [0, 1] becomes {"yaw": [0, 1]}. Other options
    are returned unchanged.
    """
    _, dot, parameter = name.partition(".")
    is_class = ":" in name  # "package.module:Class", whose dot is of another kind
    if not dot or is_class or options is None:
        return options
    # A range may be a mapping, too. Then it has one of these keys.
    range_keys = {"distribution", "choices", "range"}
    is_range = not isinstance(options, Mapping) or bool(options.keys() & range_keys)
    return {parameter: options} if is_range else options


def format_things(things: object) -> str | None:
    """Return additional objects in a scene as the text of a setting.

    The text is, for example, ``car@12,3.5,heading=180; person@6,-2``. Paths of files in
    it become absolute, so that a run may be resumed in any directory.

    Args:
        things: a text, a mapping, or a list of these; None for none.

    Raises:
        InputError: the value has another type.
    """
    items = _list_items(things)
    if not all(isinstance(item, (str, Mapping)) for item in items):
        raise InputError(
            "things: expected a text such as 'car@12,3.5', a mapping or a list of "
            f"these, got {things!r:.80}"
        )
    text = ";".join(
        _format_thing(item) if isinstance(item, Mapping) else str(item)
        for item in items
    )
    texts = [_make_thing_absolute(part) for part in text.split(";") if part.strip()]
    return "; ".join(texts) or None


def _list_items(things: object) -> Sequence[object]:
    """Return the items of a list, or a single item as a list; for None an empty one."""
    if things is None:
        return []
    if isinstance(things, (list, tuple)):
        return things
    return [things]


def _make_thing_absolute(thing: str) -> str:
    """Make the path of an object absolute in a text ``OBJECT@OPTIONS``.

    The object may be a node of a file, ``scene.glb#NODE``. The name of a bundled object
    is not changed, and neither is a text without an @, which is rejected later.
    """
    object_name, at, options = thing.strip().rpartition("@")
    object_name = object_name.strip()
    file, mark, node = object_name.partition("#")
    # Names of bundled objects have no suffix: a file of such a name is not used.
    if "." in file and Path(file).is_file():
        object_name = f"{Path(file).resolve()}{mark}{node}"
    return f"{object_name}{at}{options}"


def _format_thing(thing: Mapping[str, Any]) -> str:
    """Return an additional object as text, ``OBJECT@X,Y,OPTION=VALUE``.

    Args:
        thing: mapping with "object", "x", "y" and perhaps options such as "heading".

    Raises:
        InputError: "object", "x" or "y" is missing.
    """
    required = ("object", "x", "y")
    if not thing.keys() >= {*required}:
        raise InputError(
            "things: expected an object, x and y, such as {'object': 'car', 'x': 12, "
            f"'y': 3.5}}, got {dict(thing)!r:.80}"
        )
    # joined with a comma: OBJECT@X,Y
    position = [f"{thing['object']}@{thing['x']}", f"{thing['y']}"]
    options = [f"{name}={thing[name]}" for name in thing if name not in required]
    return ",".join([*position, *options])


def list_declared_options(kind: type[Any]) -> dict[str, Field[Any]]:
    """Return the fields of a dataclass that are options, by name."""
    return {
        field.name: field
        for field in fields(kind)
        if field.init and field.metadata != FROM_RUN
    }


def check_options(
    what: str, name: str, kind: type[Any], options: Mapping[str, object]
) -> None:
    """Check the names of options of a dataclass, and the types of their values.

    The class itself checks that values are in range.

    Args:
        what: kind of the object with the options, such as "policy", for messages.
        name: name of the object, such as "cmaes".
        kind: the dataclass.
        options: values by name.

    Raises:
        UnknownNameError: there is no such option.
        InputError: a value has another type.
    """
    declared = list_declared_options(kind)
    for option, value in options.items():
        if option not in declared:
            raise UnknownNameError(f"option of {what} {name!r}:", option, declared)
        expected = _find_expected(get_option_type(declared[option]), value)
        if expected:
            raise InputError(
                f"{option} of {what} {name}: expected {expected}, got {value!r:.80}"
            )


def _find_expected(option_type: str, value: object) -> str:
    """Return a text with the expected type of an option if its value does not fit.

    The result is "" if the value fits. Only the types float, int, bool and str are
    checked; values of other types pass.

    Args:
        option_type: name of the type, such as "float".
        value: value of the option.
    """
    is_number = _is_number_in_range(value)
    # a float without a fraction, such as 2.0, counts as an int
    is_integral = is_number and value % 1 == 0  # type: ignore[operator]
    if option_type == "float" and not is_number:
        return f"a finite number from {-MAX_OPTION} to {MAX_OPTION}"
    if option_type == "int" and not is_integral:
        return f"a whole number from {-MAX_OPTION} to {MAX_OPTION}"
    if option_type == "bool" and not isinstance(value, bool):
        return "true or false"
    if option_type == "str" and not isinstance(value, str):
        return "a text"
    return ""


def _is_number_in_range(value: object) -> bool:
    """Return whether a value is a number whose size is at most `MAX_OPTION`."""
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return False
    return abs(value) <= MAX_OPTION  # false for NaN


def get_option_type(option: Field[Any]) -> str:
    """Return the name of the type of an option."""
    return str(getattr(option.type, "__name__", option.type))


def get_option_default(option: Field[Any]) -> Any:
    """Return the default of an option; None if it has none."""
    if option.default is not MISSING:
        return option.default
    if option.default_factory is not MISSING:
        return option.default_factory()
    return None


def _to_json(value: object) -> JsonValue:
    """Return a value as a JSON value.

    The result is None if the value or a part of it has no JSON form, such as an
    infinite number, a tensor, or None itself.
    """
    if isinstance(value, Mapping):
        mapping = {
            name: _to_json(inner)
            for name, inner in value.items()
            if isinstance(name, str)
        }
        is_complete = len(mapping) == len(value) and None not in mapping.values()
        return mapping if is_complete else None
    if isinstance(value, (list, tuple)):
        items = [_to_json(inner) for inner in value]
        return None if None in items else items
    is_finite = isinstance(value, float) and math.isfinite(value)
    if is_finite or isinstance(value, (bool, int, str)):
        return value  # type: ignore[return-value]
    return None


def convert_to_setting(entry: Any) -> str | dict[str, JsonValue]:
    """Return a policy or a task as a setting that a file can hold.

    The setting is its name, or a mapping with its name and the options that differ from
    their defaults. Options without a JSON form are left out.
    """
    name = str(entry.name)
    options = {}
    for option, declared in list_declared_options(type(entry)).items():
        value = getattr(entry, option)
        json_value = _to_json(value)
        if json_value is not None and value != get_option_default(declared):
            options[option] = json_value
    return {"name": name, **options} if options else name


def describe_value(value: object) -> str:
    """Describe a value that is not the expected instance; for a class, how to create
    one.
    """
    if isinstance(value, type):
        return f"the class {value.__name__}; write {value.__name__}()"
    return f"{value!r:.80}"


def check_takes_arguments(
    function_title: str, function: Callable[..., object], *names: str
) -> None:
    """Check that a user's function takes arguments of these names by position.

    Args:
        function_title: setting and name of the function, for messages ("metrics: f").
        function: function to check.
        *names: names of the arguments.

    Raises:
        InputError: the function does not take them.
    """
    try:
        inspect.signature(function).bind(*names)
    except ValueError:  # a built-in function without a signature cannot be checked
        return
    except TypeError as error:
        raise InputError(
            f"{function_title}: expected a function of ({', '.join(names)}): {error}"
        ) from None


# ---- A configuration as named values with units, as controls make them and runs store
# them ---------------------


class Value(TypedDict):
    """The value of a parameter in a configuration, with its unit."""

    value: float | str
    unit: str


# Label for an output with NaN or infinity, which is no prediction.
NOT_A_NUMBER = "not a number"
OUT_OF_VIEW = "out of view"
"""Label of a prediction for an image in which the evaluated object is not visible. It
counts neither as a success of a search nor in accuracies.
"""


class Outcome(Enum):
    """How a detector or a segmentation model finds, or does not find, the object.

    These are the types of errors of TIDE (Bolya et al. 2020, section 2.2) for a single
    object. JSON files contain the value. All counts and sentences about a detector are
    computed from these, not from the text of a prediction.
    """

    FOUND = "found"  # a right box, or enough right pixels
    # A box of a right class overlaps the object too little, or too few pixels are
    # right.
    LOOSE = "loose"
    WRONG_CLASS = "wrong class"  # a good box of another class
    # A box of a right class is somewhere else, or the object is not visible.
    PHANTOM = "phantom"
    MISSED = "missed"  # no box that counts


OUTCOME = "outcome"  # key of a payload under which it has the value of an `Outcome`


def get_outcome(payload: object) -> Outcome | None:
    """Return the outcome that the payload of a prediction states; None if it states
    none.
    """
    value = payload.get(OUTCOME) if isinstance(payload, Mapping) else None
    try:
        return Outcome(value)
    except (TypeError, ValueError):
        return None


def count_outcomes(payloads: Iterable[object]) -> dict[str, int] | None:
    """Count the outcomes of predictions by value; None if no payload states one.

    Args:
        payloads: payloads of the predictions, such as those that are wrong.
    """
    counts = Counter(get_outcome(payload) for payload in payloads)
    named = {outcome.value: counts[outcome] for outcome in Outcome if counts[outcome]}
    return named or None


def format_rounded(number: float) -> str:
    """Format a computed number for sentences: with three significant digits."""
    return f"{float(f'{number:.3g}'):g}"
