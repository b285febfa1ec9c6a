"""What code of others is handed is its own copy, so that nothing that it writes into is
looked at again.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, MutableMapping
from dataclasses import fields, is_dataclass
from functools import wraps
from types import FunctionType, MappingProxyType, SimpleNamespace
from typing import Any, TypeVar

import numpy as np

Value = TypeVar("Value")


def copy_value(value: Value) -> Value:
    """Return a value in which tensors (with their graphs) and arrays are copies, and so
    are the lists, mappings and dataclasses that hold them.

    Anything else stays as it is. So does a dataclass that `gives_copies` of what it
    holds (`Facts`), and a mapping that nobody can write into and that makes its values
    on demand.
    """
    original: Any = value
    copy_of_value: Any = original
    if hasattr(original, "requires_grad"):
        copy_of_value = original.clone()
    elif isinstance(original, np.ndarray):
        copy_of_value = original.copy()
    elif isinstance(original, MutableMapping):
        copy_of_value = copy.copy(original)
        copy_of_value.update(
            {key: copy_value(inner) for key, inner in original.items()}
        )
    elif isinstance(original, MappingProxyType):
        copy_of_value = MappingProxyType(
            {key: copy_value(inner) for key, inner in original.items()}
        )
    elif isinstance(original, list):
        copy_of_value = copy.copy(original)
        copy_of_value[:] = map(copy_value, original)
    elif isinstance(original, tuple):
        copied_items = map(copy_value, original)
        copy_of_value = (
            type(original)(*copied_items)
            # a named tuple takes its items one by one
            if hasattr(original, "_fields")
            else type(original)(copied_items)
        )
    elif isinstance(original, SimpleNamespace):
        copy_of_value = SimpleNamespace(**copy_value(vars(original)))
    elif (
        is_dataclass(original)
        and not isinstance(original, type)
        and not getattr(original, "gives_copies", False)
    ):
        copy_of_value = copy.copy(original)
        for field in fields(original):
            # also in a frozen dataclass
            object.__setattr__(
                copy_of_value, field.name, copy_value(getattr(original, field.name))
            )
    return copy_of_value  # type: ignore[no-any-return]


def is_ours(kind: type) -> bool:
    """Return whether this package defines a class."""
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


def hand_copies(kind: type, **argument_slices: slice) -> None:
    """Replace methods of a class from outside of this package by ones that are called
    with copies of their arguments.

    So code of others can change what it is given without harm.

    Args:
        kind: the class; one of this package is left as it is.
        argument_slices: the positional arguments after `self` that are copied, by the
            name of the method. All keyword arguments are copied.
    """
    if is_ours(kind):
        return
    for name, argument_slice in argument_slices.items():
        method = vars(kind).get(name)
        if isinstance(method, FunctionType):
            setattr(kind, name, _wrap_with_copies(method, argument_slice))


def _wrap_with_copies(method: Callable[..., Any], which: slice) -> Callable[..., Any]:
    """Return a method that is called with copies: of the positional arguments `which`,
    after `self`, and of all keyword arguments.
    """

    @wraps(method)
    def handed(self: Any, *args: Any, **named: Any) -> Any:
        copied_args = [*args]
        copied_args[which] = map(copy_value, copied_args[which])
        return method(self, *copied_args, **copy_value(named))

    return handed
