"""The contract of a policy: the rule that proposes configurations.

A policy is three functions over a state that is passed and never kept, so that a policy can be shared, wrapped,
replayed and resumed. `search` owns everything else: the budget, stopping, the best so far, logging. A policy knows no
physics and no seeds, only a `Domain` and numbers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from advsearch.attacks.candidates import Failures
from advsearch.attacks.domain import Distribution, Domain
from advsearch.attacks.evaluation import Evaluation, WhichGradient
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
        samples: render with so many times the search's samples per pixel, at least 1, for as many times the renders.
            A wish too: the end of a budget gets what is left.
    """

    u: Tensor
    gradient: WhichGradient = False
    step_size: float = math.nan
    samples: int = 1

    def cost(self, domain: Domain) -> int:
        """Return the renders that this takes at most."""
        return self.samples * (1 + (domain.gradient_cost if self.gradient is True else 0))


@dataclass(frozen=True)
class Counts:
    """What a policy had to do about the evaluations it was told; for the summary of a run.

    Attributes:
        cut: gradients of which single numbers were outliers and cut (see `pgd.clipped`).
        shortened: gradients that were outliers as a whole.
        rejected: steps that were taken back: the search went on from a configuration before them.
    """

    cut: int = 0
    shortened: int = 0
    rejected: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.cut + other.cut, self.shortened + other.shortened, self.rejected + other.rejected)


NO_COUNTS = Counts()


Evaluated = Sequence[tuple[Tensor, Evaluation]]
"""Configurations with what a render of each said, in the order in which they were proposed."""


class Policy(ABC, Generic[State]):
    """Proposes configurations, in batches. Write a new one by implementing the three methods below.

    Attributes:
        name: for messages and the log.
        handles_choices: whether it searches discrete choices (`Block.options`) itself. `search` wraps one that does
            not in `Choices`, so that it never sees any.
    """

    name: ClassVar[str]
    handles_choices: ClassVar[bool] = False

    @property
    @abstractmethod
    def uses_gradient(self) -> bool:
        """Whether it ever asks for a gradient. A class with a fixed answer just sets the attribute."""

    @abstractmethod
    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> State:
        """Return the state before the first proposal.

        Args:
            domain: where to search; begin at `domain.begin`.
            generator: the search's source of randomness, to draw a seed from; use `seeded` for numbers later on.
            steps: how many renders there will be at most, those of gradients included: a plan for schedules, never to
                be counted on.
        """

    @abstractmethod
    def propose(self, state: State, n: int) -> tuple[tuple[Proposal, ...], State]:
        """Return the next configurations, and the state until `update`.

        Args:
            state: after the latest `update`, or as `start` returned it.
            n: how many can be evaluated before the next `update`, at least 1.

        Returns:
            Up to n that do not wait for each other's evaluations: a sample of a population is one of many, a step
            along a gradient is alone. None at all if there is nothing more to propose (a grid that is done, a flat
            objective). Asked with another n, a policy proposes the same configurations in the same order, provided
            that `update` is told of all of them.
        """

    @abstractmethod
    def update(self, state: State, evaluated: Evaluated) -> State:
        """Return the state after what was proposed last was evaluated, all of it, or the first of it where the budget
        ends.

        Every evaluation is `usable`: its gradient (None where it was not asked for or could not be paid) is finite, and
        its objective is finite or -inf, which stands for "could not be evaluated". The objective is noisy: the same u
        with another seed gives another value, and a maximum over many is biased upwards.
        """

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        """Return whether, in `steps` renders, it may ask for gradients of a domain that cost renders."""
        return self.uses_gradient and domain.gradient_cost > 0

    def counts(self, state: State) -> Counts:
        """Return what the policy did about the evaluations so far; nothing where it takes them as they come."""
        return NO_COUNTS

    def answer(self, state: State) -> Distribution | None:
        """Return the distribution that the search has reached, where that is its answer beside the best configuration
        that it met; None where there is none (yet)."""
        return None

    def failures(self, state: State) -> Failures | None:
        """Return the different failures that the policy has met, if it looks for more than one."""
        return None


def affordable(proposal: Proposal, domain: Domain, left: int) -> Proposal:
    """Return the proposal as far as `left` renders, at least 1, allow: no more samples than these, and no gradient
    after which no render would be left to use it."""
    if proposal.samples > left:
        proposal = replace(proposal, samples=left)
    if proposal.gradient and proposal.cost(domain) >= left:
        return replace(proposal, gradient=False)
    return proposal


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
