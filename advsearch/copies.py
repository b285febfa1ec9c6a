"""What code of others is handed is its own copy, so that nothing that it writes into is looked at again."""

from __future__ import annotations

import copy
from collections.abc import Callable, MutableMapping
from dataclasses import fields, is_dataclass
from functools import wraps
from types import FunctionType, MappingProxyType, SimpleNamespace
from typing import Any, TypeVar

import numpy as np

Value = TypeVar("Value")

OURS = __name__.partition(".")[0]


def copied(value: Value) -> Value:
    """Return a copy of all tensors, with their graphs, and arrays in a value, and of the lists, mappings and
    dataclasses that hold them. Anything else is as it is, and so is a dataclass that `gives_copies` of what it holds
    (`Facts`) and a mapping that nobody can write into and that makes its values on demand."""
    return _copied(value)  # type: ignore[no-any-return]


def _copied(value: Any) -> Any:
    made: Any
    if hasattr(value, "requires_grad"):
        return value.clone()
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, MutableMapping):
        made = copy.copy(value)
        made.update({key: _copied(one) for key, one in value.items()})
        return made
    if isinstance(value, MappingProxyType):
        return MappingProxyType({key: _copied(one) for key, one in value.items()})
    if isinstance(value, list):
        entries = copy.copy(value)
        entries[:] = [_copied(one) for one in value]
        return entries
    if isinstance(value, tuple):
        parts = [_copied(one) for one in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    if isinstance(value, SimpleNamespace):
        return SimpleNamespace(**_copied(vars(value)))
    if is_dataclass(value) and not isinstance(value, type) and not getattr(value, "gives_copies", False):
        other = copy.copy(value)
        for one in fields(value):
            object.__setattr__(other, one.name, _copied(getattr(value, one.name)))
        return other
    return value


def is_ours(kind: type) -> bool:
    """Return whether this package defines a class."""
    return kind.__module__.partition(".")[0] == OURS


def hand_copies(kind: type, **places: slice) -> None:
    """Have methods that a class outside of this package defines called with copies of their arguments.

    Args:
        kind: that defines them.
        places: by name of the method, which of its arguments after `self`; those by keyword always are.
    """
    if is_ours(kind):
        return
    for name, which in places.items():
        method = vars(kind).get(name)
        if isinstance(method, FunctionType):
            setattr(kind, name, _handing(method, which))


def _handing(method: Callable[..., Any], which: slice) -> Callable[..., Any]:
    @wraps(method)
    def handed(self: Any, *args: Any, **named: Any) -> Any:
        given = [*args]
        given[which] = [_copied(one) for one in given[which]]
        return method(self, *given, **{name: _copied(one) for name, one in named.items()})

    return handed
