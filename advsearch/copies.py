"""Copy the arguments of a user's code, so that it may change them in place without an
effect on the search.
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
    """Copy a value together with the tensors and arrays inside of it.

    Lists, tuples, mappings, namespaces and dataclasses are copied with their contents.
    A copy of a tensor stays attached to its graph. Any other value is returned
    unchanged. So is a dataclass whose fields already return copies (its `gives_copies`
    is true, as for `Facts`), and an immutable mapping that makes its values on demand.
    """
    original: Any = value
    copied: Any = original
    is_tensor = hasattr(original, "requires_grad")
    if is_tensor:
        copied = original.clone()
    elif isinstance(original, np.ndarray):
        copied = original.copy()
    elif isinstance(original, MutableMapping):
        copied = copy.copy(original)
        copied.update({key: copy_value(inner) for key, inner in original.items()})
    elif isinstance(original, MappingProxyType):
        copied = MappingProxyType(
            {key: copy_value(inner) for key, inner in original.items()}
        )
    elif isinstance(original, list):
        copied = copy.copy(original)
        copied[:] = map(copy_value, original)
    elif isinstance(original, tuple):
        copied = _copy_tuple(original)
    elif isinstance(original, SimpleNamespace):
        copied = SimpleNamespace(**copy_value(vars(original)))
    elif is_dataclass(original) and not isinstance(original, type):
        if not getattr(original, "gives_copies", False):
            copied = _copy_dataclass(original)
    return copied  # type: ignore[no-any-return]


def _copy_tuple(original: tuple[Any, ...]) -> Any:
    """Return a tuple of the same type with copies of its items."""
    items = map(copy_value, original)
    is_named = hasattr(original, "_fields")
    # a named tuple takes its items one by one
    return type(original)(*items) if is_named else type(original)(items)


def _copy_dataclass(original: Any) -> Any:
    """Return a dataclass with copies of its fields."""
    copied = copy.copy(original)
    for field in fields(original):
        field_value = copy_value(getattr(original, field.name))
        # also in a frozen dataclass
        object.__setattr__(copied, field.name, field_value)
    return copied


def is_package_class(kind: type) -> bool:
    """Return whether this package defines a class."""
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


def copy_method_arguments(user_class: type, **argument_slices: slice) -> None:
    """Make methods of a user's class get copies of their arguments.

    So code of users may change its arguments in place without harm to the search.

    Args:
        user_class: the class, whose methods are replaced. A class of this package is
            not changed.
        argument_slices: by name of the method, which positional arguments after `self`
            are copied. All keyword arguments are copied.
    """
    if is_package_class(user_class):
        return
    for name, argument_slice in argument_slices.items():
        method = vars(user_class).get(name)
        if isinstance(method, FunctionType):
            setattr(user_class, name, _wrap_with_copies(method, argument_slice))


def _wrap_with_copies(method: Callable[..., Any], which: slice) -> Callable[..., Any]:
    """Return a method that calls another one with copies of arguments.

    Args:
        method: the method that is called.
        which: the positional arguments after `self` that are copied; all keyword
            arguments are.
    """

    @wraps(method)
    def wrapper(self: Any, *args: Any, **keywords: Any) -> Any:
        passed_args = [*args]
        passed_args[which] = map(copy_value, passed_args[which])
        return method(self, *passed_args, **copy_value(keywords))

    return wrapper
