"""A function of the user's as an objective: what it is given, and its mistakes in words; docs/objectives.md.

It is called with `(output, images, truth)`, or `(output, labels)` as losses of torch are, and asks for more by the
names of further parameters.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from advsearch.errors import InputError

ASKED = ("u", "texture", "textures", "inputs", "configuration")
"""What a function may ask for by the names of further parameters."""

TRUTHS = ("target", "targets", "labels", "label", "truth")
"""What the second of two parameters is called in a loss of outputs and right answers alone."""

More = Callable[[str], Any]
"""Gives what is asked for by one of the names in `ASKED`, at the configuration of each picture."""


class Objective(Protocol):
    """The signature of an objective, called by position; see `advsearch.attacks.objectives`."""

    def __call__(self, output: Any, images: Tensor, truth: Any, more: More = ..., /) -> Tensor:
        """Return (N,) values to maximise."""
        ...


def nothing_more(name: str) -> Any:
    """Refuse what is asked for where there is no configuration."""
    raise InputError(f"objective: asks for `{name}`, and there is no configuration here; pass `more`, which gives it")


@dataclass(frozen=True)
class Form:
    """Which arguments a function takes.

    Attributes:
        images: whether it takes (output, images, truth); else it takes (output, truth).
        asked: what it asks for beside them, of `ASKED`.
    """

    images: bool = True
    asked: tuple[str, ...] = ()


def form_of(function: Callable[..., Any]) -> Form:
    """Return which arguments a function takes.

    The names of its first two parameters ask for nothing, nor does a third one in the place of the truth.

    Raises:
        InputError: it takes others.
    """
    try:
        signature = inspect.signature(function.forward if isinstance(function, nn.Module) else function)
    except ValueError:  # built in: nothing to look at
        return Form()
    by_position = [one.name for one in signature.parameters.values() if one.kind in (0, 1)]
    asked = tuple(
        one.name for one in signature.parameters.values() if one.name in ASKED and one.name not in by_position[:2]
    )
    own = [name for name in by_position if name not in asked]
    images = not (len(own) >= 2 and own[1] in TRUTHS)
    try:
        signature.bind(*([None] * (3 if images else 2)), **dict.fromkeys(asked))
    except TypeError as error:
        raise InputError(
            f"objective {name_of(function)!r}: expected a function that takes (output, images, truth) or (output, "
            f"labels), and beside them any of {', '.join(ASKED)} by name: {error}"
        ) from None
    return Form(images, asked)


def checked(function: Callable[..., Tensor]) -> Objective:
    """Wrap a user's function: a scalar becomes (1,), and a wrong type, shape or a lost gradient is an InputError.

    The function returns (N,), or a scalar, for which it is called with one picture at a time. A label set of one class
    comes as (N,) int64, as torch's losses take it. What it raises itself passes through. NaN values pass too: a search
    has a rule for them.

    Raises:
        InputError: the function takes other arguments; see `form_of`.
    """
    name, form = name_of(function), form_of(function)

    def objective(output: Any, images: Tensor, truth: Any, more: More = nothing_more, /) -> Tensor:
        asked, count = {one: more(one) for one in form.asked}, images.shape[0]
        given = (output, images, _labels(truth, output, count))
        try:
            values = function(*(given if form.images else given[::2]), **asked)
        except TypeError as error:
            if not (isinstance(given[2], tuple) and "not tuple" in str(error)):
                raise
            raise InputError(
                f"objective {name!r}: expected one right answer for a loss of torch, got {len(truth)} (indices "
                f"{truth}); use those of advsearch.losses, or name one with `label`"
            ) from error
        if isinstance(values, Tensor) and values.ndim == 0 and count > 1:
            each = [objective(output[k : k + 1], images[k : k + 1], truth, _part(asked, k)) for k in range(count)]
            values = torch.cat(each)
        values = _values(name, values, count)
        seen = [one for one in (images, output, *asked.values()) if isinstance(one, Tensor)]
        wanted = torch.is_grad_enabled() and any(one.requires_grad for one in seen)
        if wanted and not values.requires_grad:
            raise InputError(
                f"objective {name!r}: the result does not depend on the output or the images differentiably; "
                "remove .detach(), torch.no_grad() or argmax, or choose a policy without gradients (random)"
            )
        return values

    return objective


def name_of(function: Callable[..., Any]) -> str:
    """Return what a function is called in messages."""
    return getattr(function, "__name__", type(function).__name__)


def _values(name: str, values: Any, count: int) -> Tensor:
    """What a function returned, as (N,)."""
    if not isinstance(values, Tensor):
        raise InputError(
            f"objective {name!r}: expected a torch tensor of shape ({count},), got {type(values).__name__}; "
            "compute it with torch operations and don't call .item(), float() or .numpy()"
        )
    if not values.is_floating_point():
        raise InputError(
            f"objective {name!r}: expected floating-point values, got {values.dtype}; a count or a comparison has "
            "no gradient"
        )
    found: Tensor = values.reshape(1) if values.ndim == 0 and count == 1 else values
    if found.shape != (count,):
        raise InputError(
            f"objective {name!r}: expected one value per image, shape ({count},), got {tuple(found.shape)}; "
            "reduce over everything but the first axis"
        )
    return found


def _labels(truth: Any, output: Any, count: int) -> Any:
    """The truth as a function gets it: a label set of one class as (N,) int64, anything else as it is."""
    if isinstance(truth, tuple) and len(truth) == 1 and isinstance(truth[0], int) and isinstance(output, Tensor):
        return torch.full((count,), truth[0], device=output.device)
    return truth


def _part(asked: Mapping[str, Any], picture: int) -> More:
    """Return what gives what was asked for of several pictures for one of them."""
    one = slice(picture, picture + 1)

    def more(name: str) -> Any:
        found = asked[name]
        return found[one] if isinstance(found, Tensor) else {key: value[one] for key, value in found.items()}

    return more
