"""Check the arguments of calls from Python.

An unknown keyword is reported with the keyword that is probably meant, such as one that
other libraries use. A value of a wrong type is reported with the expected types.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, TypeVar

from advsearch.errors import InputError, find_similar_names
from advsearch.files import join_alternatives
from advsearch.options import describe_value

OTHER_TERMS = {"eot": "over", "minimal_perturbation": "smallest"}
"""Terms of the literature for settings that have another name here."""
DEVICES = ("device", "cuda", "gpu", "use_cuda")
# Why keywords of other libraries do not exist here.
UNSUPPORTED_KEYWORDS = {
    **dict.fromkeys(
        DEVICES,
        "pictures are made on the processor, and a model stays on the device that it "
        "is on",
    ),
    **dict.fromkeys(
        ("lr", "learning_rate", "step_size", "alpha", "momentum"),
        "steps are an option of a policy",
    ),
}

TYPE_WORDS = {
    "str": "a text",
    "Path": "a path",
    "bool": "True or False",
    "int": "a whole number",
    "float": "a number",
    "None": "None",
    "Mapping": "a mapping",
    "Sequence": "a list",
    "Callable": "a function",
}
"""Types by name, for messages."""

ALIASES = {
    *"Controls Loss ProgressOption SettingValues Texture Read MakeOptimizer "
    "Examples Unpack Literal UniqueNames StackedTensors Names Named Tensor".split()
}
"""Names in annotations that are no classes. Their values are not checked."""
Function = TypeVar("Function", bound=Callable[..., Any])


def make_unexpected_error(
    function: str, keywords: Mapping[str, object], known: Sequence[str]
) -> TypeError | None:
    """Return the error for an unknown keyword of a call; None if all are known.

    The error is about the first such keyword. Its message suggests the keyword that is
    probably meant.

    Args:
        function: name of the function.
        keywords: keywords of the call, by name.
        known: names of the function's parameters.
    """
    for name in keywords:
        if name not in known:
            hint = _suggest_known_keyword(name, known)
            return TypeError(
                f"{function}() got an unexpected keyword argument {name!r}{hint}"
            )
    return None


def _suggest_known_keyword(name: str, known: Sequence[str]) -> str:
    """Return the end of a message about an unknown keyword: what is probably meant.

    Args:
        name: the unknown keyword.
        known: names of the function's parameters.
    """
    # the keyword that the literature calls so, or why there is none
    suggestions, reason = suggest_keyword(name, known)
    # No keyword chooses a device, so a similarly spelled one would be a wrong
    # suggestion for `device`.
    chooses_device = name.lower() in DEVICES
    if not suggestions and not chooses_device:
        suggestions = find_similar_names(name, known)[:2]
    hint = ""
    if suggestions:
        names = " or ".join(f"`{suggestion}`" for suggestion in suggestions)
        hint = f"; did you mean {names}?"
    if reason:
        hint += f" ({reason})"
    return hint


def suggest_keyword(name: str, known: Sequence[str]) -> tuple[list[str], str]:
    """Return the keyword that is meant by a term of the literature or other libraries.

    Args:
        name: the term, such as "eot".
        known: names of the keywords that exist.

    Returns:
        The keyword in a list, which is empty if none is meant; and the reason why there
        is no such keyword here, "" if there is none.
    """
    term = OTHER_TERMS.get(name.lower())
    suggestions = [term] if term is not None and term in known else []
    return suggestions, UNSUPPORTED_KEYWORDS.get(name.lower(), "")


def check_types(
    parameters: Mapping[str, inspect.Parameter], values: Mapping[str, object]
) -> None:
    """Check that values of arguments have the types of their annotations.

    Annotations that are not types or classes are not checked. Arrays and tensors always
    pass, since they may stand for numbers and lists.

    Args:
        parameters: parameters by name.
        values: arguments by name of the parameter; unknown names are not checked.

    Raises:
        InputError: a value has none of the annotated types, or `run` is an empty text.
    """
    for name, value in values.items():
        parameter = parameters.get(name)
        if parameter is None or value is parameter.default:
            continue
        is_array = hasattr(value, "tolist")
        if is_array:
            continue
        _check_type(name, value, str(parameter.annotation))
        if name == "run":
            _check_run_name(value)


def _check_run_name(run: object) -> None:
    """Check that the name of a run is no empty text.

    Raises:
        InputError: it is.
    """
    if isinstance(run, str) and not run.strip():
        raise InputError(
            "run: expected the name of a run or a folder, got an empty text; leave "
            "it out for no run"
        )


def _check_type(name: str, value: object, annotation: str) -> None:
    """Check that the value of an argument has a type that its annotation allows.

    Raises:
        InputError: it has another type.
    """
    type_names = _parse_annotation(annotation)
    if type_names and not any(_has_type(kind, value) for kind in type_names):
        words = [
            # a class by its name, without its module
            TYPE_WORDS.get(kind, f"a {kind.rpartition('.')[2]}")
            for kind in type_names
        ]
        expected = join_alternatives(words)
        raise InputError(f"{name}: expected {expected}, got {describe_value(value)}")


def _parse_annotation(annotation: str) -> list[str]:
    """Return the names of the types that an annotation allows.

    ``"Sequence[str] | None"`` gives ``["Sequence", "None"]``. The list is empty if the
    annotation allows anything, or has an alias whose types are not known here.
    """
    # Remove [...]: the elements of a Sequence or Mapping are not checked. The innermost
    # brackets are removed first, until there are none.
    without_parameters = annotation
    n_replaced = 1
    while n_replaced:
        without_parameters, n_replaced = re.subn(r"\[[^][]*\]", "", without_parameters)
    names = [
        name.strip().replace("os.PathLike", "Path")
        for name in without_parameters.split("|")
    ]
    if ALIASES & set(names) or any(name.startswith("Any") for name in names):
        return []
    return list(dict.fromkeys(names))


def _has_type(kind: str, value: object) -> bool:
    """Return whether a value is of the type or class with this name.

    An int counts as a float, and a float without a fraction, such as 2.0, as an int.

    Args:
        kind: name such as "int", "Mapping" or "advsearch.engine.loading.Scene".
        value: the value.
    """
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    is_text = isinstance(value, (str, bytes))
    fits = {
        "None": value is None,
        # false for numbers with a fraction, NaN and infinity
        "int": is_number and value == value // 1,  # type: ignore[operator]
        "float": is_number,
        "Path": hasattr(value, "__fspath__"),
        "Callable": callable(value),
        "Mapping": isinstance(value, Mapping),
        "Sequence": isinstance(value, Sequence) and not is_text,
    }
    if kind in fits:
        return fits[kind]
    # a class, "package.module.Class", or one that is derived from it
    class_names = [base.__name__ for base in type(value).__mro__]
    return kind.rpartition(".")[2] in class_names


def with_checked_arguments(function: Function) -> Function:
    """Make a function reject unknown keywords and values of wrong types.

    The messages say what was probably meant (`make_unexpected_error`, `check_types`).
    """
    signature = inspect.signature(function)
    parameters = signature.parameters

    @wraps(function)
    def wrapper(*args: Any, **keywords: Any) -> Any:
        error = make_unexpected_error(function.__name__, keywords, list(parameters))
        if error:
            raise error
        positional = dict(zip(parameters, args, strict=False))
        check_types(parameters, {**positional, **keywords})
        return function(*args, **keywords)

    return wrapper  # type: ignore[return-value]


def drop_unset(keywords: Mapping[str, object]) -> dict[str, Any]:
    """Return the settings that a caller passed as keywords; None counts as not passed."""
    return {name: value for name, value in keywords.items() if value is not None}
