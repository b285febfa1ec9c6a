"""Whether a run goes on with the functions and networks that it began with, which settings call by name only."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import CodeType
from typing import Any

import torch

from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.models.ensemble import Ensemble
from advsearch.runs.directory import RunDirectory

NOTE = "made of"
"""The note of functions and weights."""

LONGEST = 10_000
"""Characters of a function's source that are noted."""

NEAR, LEAST = 1e-3, 1e-4
"""Values of one picture are the same within this part of the larger, and this: other versions round differently."""


def check_made_of(
    run: RunDirectory, models: Sequence[Model], functions: Mapping[str, Callable[..., Any] | None] | None = None
) -> None:
    """Note what networks and functions are, or refuse to go on with others than a run began with.

    Args:
        run: open.
        models: by the name that they have in the run.
        functions: of the run, by setting; None where there is none.

    Raises:
        InputError: weights, or the code of a function, are other ones now.
    """
    several = [one.module.models if isinstance(one.module, Ensemble) else (one,) for one in models]
    networks = [one for some in several for one in some]
    now: dict[str, Any] = {f"model {one.name}": {"weights": weights_digest(one)} for one in networks}
    now |= {name: _function(one) for name, one in (functions or {}).items() if one is not None}
    before = run.store.noted(NOTE)
    if not isinstance(before, dict):
        run.store.set_note(NOTE, json.dumps(now))
        return
    for name, facts in now.items():
        noted = before.get(name)
        if not isinstance(noted, dict):
            continue
        for key, what in (("weights", "has other weights"), ("code", "is another function")):
            same_python = key != "code" or noted.get("python") == facts.get("python")
            if same_python and None not in (noted.get(key), facts.get(key)) and noted[key] != facts[key]:
                raise InputError(
                    f"{run.path}: cannot go on: {name} {what} now; take the one that it began with, or {run.again}"
                )


def weights_digest(model: Model) -> str | None:
    """Return the SHA-256 of a network's weights and buffers, with their names; None where it shows none."""
    try:
        state = model.module.state_dict()  # type: ignore[attr-defined]
        tensors = {name: one for name, one in state.items() if isinstance(one, torch.Tensor)}
        digest = hashlib.sha256()
        for name, one in sorted(tensors.items()):
            digest.update(f"{name} {one.dtype} {tuple(one.shape)}\n".encode())
            digest.update(one.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    except (AttributeError, RuntimeError, TypeError, NotImplementedError):
        return None
    return digest.hexdigest() if tensors else None


def same(before: Sequence[float | None], now: Sequence[float | None]) -> bool:
    """Whether values of a picture are those that they were; None is no number."""

    def near(one: float | None, other: float | None) -> bool:
        if one is None or other is None:
            return one is other
        return abs(one - other) <= max(LEAST, NEAR * max(abs(one), abs(other)))

    return len(before) == len(now) and all(map(near, before, now))


def finite(value: float | None) -> float | None:
    """Return a number, None where it is none."""
    return value if value is not None and math.isfinite(value) else None


def _function(function: Callable[..., Any]) -> dict[str, str | None]:
    """What is noted of a function: its source for a reader, and a digest of what it does, whatever it looks like."""
    while isinstance(function, partial):
        function = function.func
    bare = inspect.unwrap(function)
    bare = getattr(bare, "__func__", bare)
    if not hasattr(bare, "__code__"):
        bare = getattr(type(bare), "forward", None) or type(bare).__call__
    try:
        source: str | None = inspect.getsource(bare)[:LONGEST]
    except (OSError, TypeError):
        source = None
    code = getattr(bare, "__code__", None)
    kept = (getattr(bare, "__defaults__", None), [_content(one) for one in getattr(bare, "__closure__", None) or ()])
    said = None if code is None else repr((_parts(code, getattr(bare, "__doc__", None)), *map(_plain, kept)))
    digest = None if said is None else hashlib.sha256(said.encode()).hexdigest()
    return {"source": source, "code": digest, "python": "{}.{}".format(*sys.version_info)}


def _parts(code: CodeType, text: str | None = None) -> tuple[Any, ...]:
    """What a function does, without where it stands, what it is called and the text that describes it."""
    inner = [_parts(one) if isinstance(one, CodeType) else _plain(one) for one in code.co_consts if one != text]
    return code.co_code.hex(), inner, code.co_names, code.co_freevars


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # nothing is in it yet
        return None


def _plain(value: Any) -> Any:
    """Numbers and texts, however deep; of anything else its type, since its text may be another one in each process."""
    if isinstance(value, (tuple, list)):
        return [_plain(one) for one in value]
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    return value if isinstance(value, (int, float, complex, str, bytes, type(None))) else type(value).__name__
