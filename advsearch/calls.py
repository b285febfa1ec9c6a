"""What calls from Python give: keywords of other libraries are told what they are
called here, and wrong types are refused in a sentence.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, TypeVar

from advsearch.errors import InputError, resembling
from advsearch.files import either
from advsearch.options import told

OTHER_TERMS = {"eot": "over", "minimal_perturbation": "smallest"}
"""Terms of the literature for settings that are called otherwise here."""
DEVICES = ("device", "cuda", "gpu", "use_cuda")

NOWHERE = {
    **dict.fromkeys(
        DEVICES,
        "pictures are made on the processor, and a model stays on "
        "the device that it is on",
    ),
    **dict.fromkeys(
        ("lr", "learning_rate", "step_size", "alpha", "momentum"),
        "steps are an option of a policy",
    ),
}

WORDS = {
    "str": "a text", "Path": "a path", "bool": "True or False", "int": "a whole number", "float": "a number",
    "None": "None", "Mapping": "a mapping", "Sequence": "a list", "Callable": "a function",
}  # fmt: skip

ALIASES = {
    *"Controls Watched Given Texture Read MakeOptimiser Examples Unpack Literal "
    "Names Named Tensor".split()
}
"""Names in annotations that are of no class."""
Function = TypeVar("Function", bound=Callable[..., Any])


def unexpected(
    function: str, given: Mapping[str, object], known: Sequence[str]
) -> TypeError | None:
    """Return the error for the first keyword that a function has not, with what it may
    be called here; or None.
    """
    for name in given:
        if name in known:
            continue
        meant, reason = meant_by(name, known)
        meant = meant or (
            [] if name.lower() in DEVICES else resembling(name, known)[:2]
        )
        hint = (
            f"; did you mean {' or '.join(f'`{known}`' for known in meant)}?"
            if meant
            else ""
        )
        reason = f" ({reason})" if reason else ""
        return TypeError(
            f"{function}() got an unexpected keyword argument {name!r}{hint}{reason}"
        )
    return None


def meant_by(name: str, known: Sequence[str]) -> tuple[list[str], str]:
    """Return the known keywords that the literature calls so, and why there is none
    like it here.
    """
    meant = OTHER_TERMS.get(name.lower())
    return [meant] if meant is not None and meant in known else [], NOWHERE.get(
        name.lower(), ""
    )


def check_types(
    parameters: Mapping[str, inspect.Parameter], given: Mapping[str, object]
) -> None:
    """Check values against the annotations of a function's own parameters, as far as
    these name types and classes. Raises InputError where a value is of none of them.
    """
    for name, value in given.items():
        parameter = parameters.get(name)
        if parameter is None or value is parameter.default or hasattr(value, "tolist"):
            continue
        kinds = _kinds(str(parameter.annotation))
        if kinds and not any(_fits(kind, value) for kind in kinds):
            expected = either(
                [WORDS.get(kind, f"a {kind.rpartition('.')[2]}") for kind in kinds]
            )
            raise InputError(f"{name}: expected {expected}, got {told(value)}")
        if name == "run" and isinstance(value, str) and not value.strip():
            raise InputError(
                "run: expected the name of a run or a folder, got an "
                "empty text; leave it out for no run"
            )


def _kinds(annotation: str) -> list[str]:
    plain = annotation
    count = 1
    while count:
        plain, count = re.subn(r"\[[^][]*\]", "", plain)
    kinds = dict.fromkeys(
        kind.strip().replace("os.PathLike", "Path") for kind in plain.split("|")
    )
    return (
        []
        if kinds.keys() & ALIASES or any(kind.startswith("Any") for kind in kinds)
        else list(kinds)
    )


def _fits(kind: str, value: object) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    fits = {
        "None": value is None,
        "int": number and value == value // 1,  # type: ignore[operator]
        "float": number,
        "Path": hasattr(value, "__fspath__"),
        "Callable": callable(value),
        "Mapping": isinstance(value, Mapping),
        "Sequence": isinstance(value, Sequence) and not isinstance(value, (str, bytes)),
    }
    return fits.get(
        kind, kind.rpartition(".")[2] in [base.__name__ for base in type(value).__mro__]
    )


def helped(function: Function) -> Function:
    """Have a function of the interface refuse keywords that it has not, and values of
    wrong types, as said above.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def called(*args: Any, **given: Any) -> Any:
        if error := unexpected(function.__name__, given, list(signature.parameters)):
            raise error
        check_types(
            signature.parameters,
            {**dict(zip(signature.parameters, args, strict=False)), **given},
        )
        return function(*args, **given)

    return called  # type: ignore[return-value]
