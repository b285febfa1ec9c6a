"""One question at a time in a process, with torch as it comes, and as the caller had it afterwards."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from advsearch import threads
from advsearch.models.guards import plainly

_TURN = threading.RLock()
"""Held by the question at work: the threads of torch and Dr.Jit, and warnings that are caught, are the process's."""


@contextmanager
def in_turn() -> Iterator[None]:
    """Do what a question does inside the block, after those of other threads.

    Derivatives are on in it, whatever the caller has switched off (`torch.no_grad`, `torch.inference_mode`). torch and
    Dr.Jit have their threads again after it.
    """
    with _TURN, threads.given_back(), plainly():
        yield
