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


def copied(value: Value) -> Value:
    """Return a copy of all tensors, with their graphs, and arrays in a value, and of
    the lists, mappings and dataclasses that hold them. Anything else is as it is, and
    so is a dataclass that `gives_copies` of what it holds (`Facts`) and a mapping that
    nobody can write into and that makes its values on demand.
    """
    original: Any = value
    made: Any = original
    if hasattr(original, "requires_grad"):
        made = original.clone()
    elif isinstance(original, np.ndarray):
        made = original.copy()
    elif isinstance(original, MutableMapping):
        made = copy.copy(original)
        made.update({key: copied(inner) for key, inner in original.items()})
    elif isinstance(original, MappingProxyType):
        made = MappingProxyType({key: copied(inner) for key, inner in original.items()})
    elif isinstance(original, list):
        made = copy.copy(original)
        made[:] = map(copied, original)
    elif isinstance(original, tuple):
        parts = map(copied, original)
        made = (
            type(original)(*parts)
            if hasattr(original, "_fields")
            else type(original)(parts)
        )
    elif isinstance(original, SimpleNamespace):
        made = SimpleNamespace(**copied(vars(original)))
    elif (
        is_dataclass(original)
        and not isinstance(original, type)
        and not getattr(original, "gives_copies", False)
    ):
        made = copy.copy(original)
        for field in fields(original):
            object.__setattr__(made, field.name, copied(getattr(original, field.name)))
    return made  # type: ignore[no-any-return]


def is_ours(kind: type) -> bool:
    """Return whether this package defines a class."""
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


def hand_copies(kind: type, **places: slice) -> None:
    """Have methods that a class outside of this package defines called with copies of
    their arguments: by name, of which after `self`, and of all by keyword.
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
        handed_on = [*args]
        handed_on[which] = map(copied, handed_on[which])
        return method(self, *handed_on, **copied(named))

    return handed
