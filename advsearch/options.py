"""Options of what has a name on the command line: the fields of a policy's or a task's
dataclass, Mitsuba's names.
"""

from __future__ import annotations

import inspect
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, Field, fields
from enum import Enum
from pathlib import Path
from typing import Any, TypedDict

from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonValue

# metadata of a field that is no option: what a run works with decides it
FROM_RUN = {"set by": "the run"}
MOST = 1_000_000  # of whatever an option counts: no budget has more renders
BY_KEY = "mitsuba"  # the control whose parameters have Mitsuba's names
JOINED = "+"  # between the names of tasks that are asked of several models at once


def by_key(controls: Mapping[str, object]) -> dict[str, object]:
    """Return controls with ``{"mitsuba:KEY": RANGE}`` as ``{"mitsuba": {KEY: RANGE}}``,
    all keys together. ``{"pose.yaw": RANGE}`` becomes ``{"pose.yaw": {"yaw": RANGE}}``.
    Raises InputError: a key has no range, or two.
    """
    plain = dict[str, object]()
    ranges = dict[str, object]()
    for name, given in controls.items():
        kind, colon, key = str(name).partition(":")
        if kind != BY_KEY or not colon:
            _, dot, parameter = str(name).partition(".")
            spec = isinstance(given, Mapping) and bool(
                given.keys() & {"distribution", "choices", "range"}
            )
            alone = (
                dot
                and ":" not in name
                and not (given is None or (isinstance(given, Mapping) and not spec))
            )
            plain[name] = {parameter: given} if alone else given
        elif not key or given is None or given in ({}, ""):
            raise InputError(
                f"`controls` {name}: expected a range, as in "
                f"{BY_KEY}:{key or 'KEY'}=[0.2, 0.8]"
            )
        else:
            ranges[key] = given
    if not ranges:
        return plain
    together = plain.get(BY_KEY) or {}
    if not isinstance(together, Mapping) or together.keys() & ranges.keys():
        raise InputError(
            f"`controls` {BY_KEY}: expected each of Mitsuba's names once, with a range"
        )
    return {**plain, BY_KEY: {**together, **ranges}}


def things_as_text(things: object) -> str | None:
    """Return things beside an object in the one text that settings have, of a text, a
    mapping, or a list of such: ``car@12,3.5,heading=180; person@6,-2``. Files are named
    by their absolute paths, so that a run may go on from anywhere. Raises InputError
    where it is something else.
    """
    listed = (
        things
        if isinstance(things, (list, tuple))
        else []
        if things is None
        else [things]
    )
    if not all(isinstance(thing, (str, Mapping)) for thing in listed):
        raise InputError(
            "things: expected a text such as 'car@12,3.5', a mapping or a list of "
            f"these, got {things!r:.80}"
        )
    text = ";".join(
        _thing_as_text(thing) if isinstance(thing, Mapping) else str(thing)
        for thing in listed
    )
    named = []
    for part in filter(None, map(str.strip, text.split(";"))):
        what, at, rest = part.rpartition("@")
        file, mark, node = what.strip().partition("#")
        what = (
            f"{Path(file).resolve()}{mark}{node}"
            if "." in file and Path(file).is_file()
            else what.strip()
        )
        named.append(f"{what}{at}{rest}")
    return "; ".join(named) or None


def _thing_as_text(thing: Mapping[str, Any]) -> str:
    needed = ("object", "x", "y")
    if not thing.keys() >= {*needed}:
        raise InputError(
            f"things: expected an object, x and y, such as {{'object': 'car', 'x': 12, "
            f"'y': 3.5}}, "
            f"got {dict(thing)!r:.80}"
        )
    options = [f"{name}={value}" for name, value in thing.items() if name not in needed]
    return ",".join([f"{thing['object']}@{thing['x']}", f"{thing['y']}", *options])


def declared_options(kind: type[Any]) -> dict[str, Field[Any]]:
    return {
        field.name: field
        for field in fields(kind)
        if field.init and field.metadata != FROM_RUN
    }


def check_options(
    what: str, name: str, kind: type[Any], given: Mapping[str, object]
) -> None:
    """Check that a dataclass has such options of `what` ("policy", say), and that a
    number, a truth value or a text is one; ranges are theirs. Raises UnknownNameError:
    there is no such option; InputError: a value is of another type.
    """
    known = declared_options(kind)
    for option, value in given.items():
        if option not in known:
            raise UnknownNameError(f"option of {what} {name!r}:", option, known)
        number = (
            isinstance(value, (int, float))
            and not isinstance(value, bool)
            and not abs(value) > MOST
        )
        whole = number and value % 1 == 0  # type: ignore[operator]
        fits, expected = {
            "float": (number, f"a finite number from {-MOST} to {MOST}"),
            "int": (whole, f"a whole number from {-MOST} to {MOST}"),
            "bool": (isinstance(value, bool), "true or false"),
            "str": (isinstance(value, str), "a text"),
        }.get(type_of(known[option]), (True, ""))
        if not fits:
            raise InputError(
                f"{option} of {what} {name}: expected {expected}, got {value!r:.80}"
            )


def type_of(option: Field[Any]) -> str:
    return str(getattr(option.type, "__name__", option.type))


def default_of(option: Field[Any]) -> Any:
    """Return what an option is by default; None where it has to be given."""
    if option.default is not MISSING:
        return option.default
    return None if option.default_factory is MISSING else option.default_factory()


def _as_json(value: object) -> JsonValue:
    if isinstance(value, Mapping):
        mapping = {
            name: _as_json(inner)
            for name, inner in value.items()
            if isinstance(name, str)
        }
        return (
            mapping
            if len(mapping) == len(value) and None not in mapping.values()
            else None
        )
    if isinstance(value, (list, tuple)):
        listed = [_as_json(inner) for inner in value]
        return None if None in listed else listed
    finite = isinstance(value, float) and math.isfinite(value)
    return value if finite or isinstance(value, (bool, int, str)) else None  # type: ignore[return-value]


def as_setting(entry: Any) -> str | dict[str, JsonValue]:
    """Return what a file says of a policy or a task: its name, with the options that
    differ from their defaults; but for those that are no finite number, truth value,
    text, or list or mapping of these.
    """
    name = str(entry.name)
    options = {}
    for option, declared in declared_options(type(entry)).items():
        value = getattr(entry, option)
        if (plain := _as_json(value)) is not None and value != default_of(declared):
            options[option] = plain
    return {"name": name, **options} if options else name


def told(given: object) -> str:
    """Return in words what was given in the place of an instance; of a class, what
    makes one of it.
    """
    return (
        f"the class {given.__name__}; write {given.__name__}()"
        if isinstance(given, type)
        else f"{given!r:.80}"
    )


def check_takes(what: str, function: Callable[..., object], *names: str) -> None:
    """Check, by an InputError, that a user's function ("metrics: f") takes arguments of
    these names by position.
    """
    try:
        inspect.signature(function).bind(*names)
    except ValueError:  # built in: nothing to look at
        return
    except TypeError as error:
        raise InputError(
            f"{what}: expected a function of ({', '.join(names)}): {error}"
        ) from None


# ---- A configuration in words: named values with units, as controls say them and runs
# keep them ---------------------


class Value(TypedDict):
    """One value of a configuration."""

    value: float | str
    unit: str


# what an output of a model is called that has NaN or infinity in it: it has said
# nothing
NOT_A_NUMBER = "not a number"
OUT_OF_VIEW = "out of view"
"""What a prediction is called where nothing of what is judged is in the picture. It is
not a success of a search, and no share of right predictions counts it.
"""


class Outcome(Enum):
    """What becomes of the object in a detector's boxes, or in a segmentation's pixels.

    The types of errors of TIDE (Bolya et al. 2020, section 2.2), as one object meets
    them. The value is what JSON holds. Every count and every sentence about a detector
    draws from this, and none from the text of a prediction.
    """

    FOUND = "found"  # a right box
    # a box of the right class on the object, which overlaps it too little; of pixels,
    # too few
    LOOSE = "loose"
    WRONG_CLASS = "wrong class"  # a good box of another class
    # a box of the class away from the object, or where nothing of it is to be seen
    PHANTOM = "phantom"
    MISSED = "missed"  # no box that counts


OUTCOME = "outcome"  # under which a payload has the value of one


def get_outcome(payload: object) -> Outcome | None:
    """Return the outcome that the payload of a prediction states; None where it states
    none.
    """
    value = payload.get(OUTCOME) if isinstance(payload, Mapping) else None
    try:
        return Outcome(value)
    except (TypeError, ValueError):
        return None


def count_outcomes(payloads: Iterable[object]) -> dict[str, int] | None:
    """Count the outcomes of predictions that are not right, by value; None where no
    payload states one.
    """
    counts = Counter(get_outcome(payload) for payload in payloads)
    named = {outcome.value: counts[outcome] for outcome in Outcome if counts[outcome]}
    return named or None


def rounded(number: float) -> str:
    """Return a number that was worked out as sentences have it: with three significant
    digits.
    """
    return f"{float(f'{number:.3g}'):g}"
