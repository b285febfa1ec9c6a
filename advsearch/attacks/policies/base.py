"""The contract of a policy: the rule that proposes configurations.

A policy is three functions over a state that is passed and never kept, so that a policy can be shared, wrapped,
replayed and resumed. `search` owns everything else: the budget, stopping, the best so far, logging. A policy knows no
physics and no seeds, only a `Domain` and numbers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.evaluation import Evaluation, Wanted
from advsearch.seeds import stream

State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class Proposal:
    """A configuration to evaluate next.

    Attributes:
        u: (d,) float32 inside the domain; the caller must not write to it.
        gradient: whether the policy wants the derivative there: not, all of it (`Domain.gradient_cost` more pictures),
            or what is "free" (only where the domain has `partial_gradients`). A wish: the last evaluations of a budget
            get none, and `update` sees None.
        step_size: the step that led here in units of each block's radius, for the log; NaN where there is none.
    """

    u: Tensor
    gradient: Wanted = False
    step_size: float = math.nan


class Policy(ABC, Generic[State]):
    """Proposes configurations, one at a time. Write a new one by implementing the three methods below."""

    name: ClassVar[str]
    uses_gradient: ClassVar[bool]

    @abstractmethod
    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> State:
        """Return the state before the first proposal.

        Args:
            domain: where to search.
            generator: the search's source of randomness, to draw a seed from; use `seeded` for numbers later on.
            steps: how many renders there will be at most, those of gradients included: a plan for schedules, never to
                be counted on.
        """

    @abstractmethod
    def propose(self, state: State) -> tuple[Proposal | None, State]:
        """Return the next configuration, or None if there is nothing more to propose (a grid that is done, a flat
        objective), and the state from then on."""

    @abstractmethod
    def update(self, state: State, u: Tensor, evaluation: Evaluation) -> State:
        """Return the state after `u`, the latest proposal, was evaluated.

        The evaluation is `usable`: its gradient (None where it was not asked for or could not be paid) is finite, and
        its objective is finite or -inf, which stands for "could not be evaluated". The objective is noisy: the same u
        with another seed gives another value, and a maximum over many is biased upwards.
        """


def draw_seed(generator: torch.Generator) -> int:
    """Take one seed for `seeded` from the search's generator."""
    return int(torch.randint(2**31, (1,), generator=generator))


def seeded(seed: int, number: int) -> torch.Generator:
    """Return the generator for draw `number` of a policy: it depends on nothing else, so that a state can be
    replayed."""
    return torch.Generator().manual_seed(stream(seed, "policy", number))


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread for a while.

    For small matrices it is faster, on a busy machine many times so, and the last bits are the same whatever the number
    of threads. Setting the number costs less than a microsecond.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
