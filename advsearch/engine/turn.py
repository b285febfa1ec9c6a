"""One question at a time in a process, with torch as a search needs it, and as the caller had it afterwards."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from advsearch import threads

_TURN = threading.RLock()
"""Held by the question at work: the threads of torch and Dr.Jit, and warnings that are caught, are the process's."""


@contextmanager
def in_turn() -> Iterator[None]:
    """Do what a question does inside the block, after those of other threads.

    Derivatives are on in it, whatever the caller has switched off (`torch.no_grad`, `torch.inference_mode`). torch and
    Dr.Jit have their threads again after it.
    """
    with _TURN, threads.given_back(), differentiating():
        yield


@contextmanager
def differentiating() -> Iterator[None]:
    """Make tensors inside the block of which derivatives can be taken."""
    with torch.inference_mode(False), torch.enable_grad():
        yield
