"""Discrete choices around a policy that knows only numbers: options outside, the
continuous search inside. Searches race by successive halving (Karnin, Koren and Somekh
2013, "Almost optimal exploration in multi-armed bandits"; Jamieson and Talwalkar 2016):
1 + ceil(log2 n) rounds with equal shares of the renders, and within a round equal
shares for all that are still in, who take turns, whoever has most left first. A share
counts what a proposal may cost.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from advsearch.attacks.candidates import Failures
from advsearch.attacks.domain import Block, Distribution, Domain, option_center
from advsearch.attacks.evaluation import (
    NO_COUNTS,
    Counts,
    Evaluated,
    Policy,
    Proposal,
    draw_seed,
    seeded,
)
from advsearch.attacks.policies.sampling import Random


@dataclass(frozen=True, eq=False)
class Runner:
    """One search in a race: a policy and its state, renders left of its share of this
    round, the largest objective it has met, and whether it has nothing more to propose
    (`is_over`).
    """

    policy: Policy[Any]
    domain: Domain
    state: Any
    renders_left: int = 0
    best_objective: float = -math.inf
    is_over: bool = False


Racing = TypeVar("Racing", bound="Race")


@dataclass(frozen=True, eq=False)
class Race:
    """Where a race of so many steps and rounds stands: the numbers of those that are in
    this round, the best first (`active_runners`), renders that the evaluations so far
    took, and the searches whose proposals wait for theirs (`runner_of_proposal`).
    """

    runners: tuple[Runner, ...]
    steps: int
    n_rounds: int
    active_runners: tuple[int, ...] = ()
    round: int = 0
    spent: int = 0
    runner_of_proposal: tuple[int, ...] = ()

    @property
    def leader(self) -> int:
        """The index of the search with the largest objective so far, the first of
        equals.
        """
        return max(
            range(len(self.runners)), key=lambda k: self.runners[k].best_objective
        )

    def begin_round(self: Racing, field: Iterable[int], number: int) -> Racing:
        """Return the race at the beginning of a round.

        Args:
            field: the runners that are in it, which get equal renders.
            number: index of the round.
        """
        field = tuple(field)
        rounds_left = self.n_rounds - number
        renders_each = max(1, (self.steps - self.spent) // rounds_left // len(field))
        runners = [
            replace(runner, renders_left=renders_each if index in field else 0)
            for index, runner in enumerate(self.runners)
        ]
        return replace(self, runners=tuple(runners), active_runners=field, round=number)

    def propose(self: Racing, n: int) -> tuple[tuple[Proposal, ...], Racing]:
        """Return up to n proposals of this round that do not wait for each other.

        There are none where the round is over.
        """
        runners = list(self.runners)
        waiting = self._find_waiting(runners)
        proposals_each = -(-n // max(1, len(waiting)))
        proposals = dict[int, tuple[Proposal, ...]]()
        n_used = Counter[int]()
        batch = list[Proposal]()
        runner_of_proposal = list[int]()
        while waiting and len(batch) < n:
            k = max(
                waiting, key=lambda k: runners[k].renders_left
            )  # the first of equals
            proposer = runners[k]
            if k not in proposals:
                proposals[k], state = proposer.policy.propose(
                    proposer.state, min(proposals_each, proposer.renders_left)
                )
                # The runner is changed only where its proposals are used.
                proposer = replace(proposer, state=state)
            if not proposals[k]:
                self._retire(runners, k)
            elif n_used[k] == len(proposals[k]):
                # What it proposes next depends on these evaluations.
                break
            else:
                proposal = self._limit_proposal(proposals[k][n_used[k]], proposer)
                batch.append(proposal)
                runner_of_proposal.append(k)
                n_used[k] += 1
                cost = proposal.max_cost(proposer.domain)
                runners[k] = replace(
                    proposer, renders_left=proposer.renders_left - cost
                )
            waiting = self._find_waiting(runners)
        for k, count in n_used.items():
            if count < len(proposals[k]):
                # Its state must not count on more proposals than were used.
                _, state = runners[k].policy.propose(self.runners[k].state, count)
                runners[k] = replace(runners[k], state=state)
        return tuple(batch), replace(
            self, runners=tuple(runners), runner_of_proposal=tuple(runner_of_proposal)
        )

    def _find_waiting(self, runners: Sequence[Runner]) -> list[int]:
        """Return the indices of active runners that have renders left."""
        return [index for index in self.active_runners if runners[index].renders_left]

    def _retire(self, runners: list[Runner], k: int) -> None:
        """End a search that has nothing more to propose, in a list of runners.

        Its renders go to those that are left in the round.
        """
        renders = runners[k].renders_left
        runners[k] = replace(runners[k], renders_left=0, is_over=True)
        others = [other for other in self.active_runners if not runners[other].is_over]
        for other in others:
            renders_left = runners[other].renders_left + renders // len(others)
            runners[other] = replace(runners[other], renders_left=renders_left)

    def _limit_proposal(self, proposal: Proposal, runner: Runner) -> Proposal:
        """Return a proposal that the renders of its runner can pay."""
        proposal = replace(proposal, samples=min(runner.renders_left, proposal.samples))
        # Before the last round there will be renders to use a gradient.
        has_later_round = self.round + 1 < self.n_rounds
        return proposal.limit_cost(runner.domain, runner.renders_left + has_later_round)


def count_rounds(runners: int) -> int:
    """Return how many rounds a race has: 1 + ceil(log2 runners)."""
    return 1 + (runners - 1).bit_length()


def max_runners(steps: int, each: int, limit: int) -> int:
    """Return how many searches, at least 1 and at most `limit`, can have `each` renders
    in every round.
    """
    count = 1
    while count < limit and (count + 1) * count_rounds(count + 1) * each <= steps:
        count += 1
    return count


def start_race(
    searches: Sequence[tuple[Policy[Any], Domain]],
    steps: int,
    seed: int,
    *,
    rounds: int | None = None,
) -> Race:
    """Return a race before its first proposal, of `count_rounds` rounds where no other
    number is given; each search plans for the renders that it gets if it stays in to
    the end.
    """
    steps = max(1, steps)
    rounds = rounds or count_rounds(len(searches))
    planned = 0.0
    count = len(searches)
    for _ in range(rounds):
        planned += steps / rounds / count
        count = -(-count // 2)
    runners = tuple(
        Runner(
            policy,
            domain,
            policy.start(domain, seeded(seed, number), max(1, int(planned))),
        )
        for number, (policy, domain) in enumerate(searches)
    )
    return Race(runners, steps, rounds).begin_round(range(len(runners)), 0)


class RacingPolicy(Policy[Racing]):
    """A policy that is a race; its `start` lines it up."""

    def propose(self, state: Racing, n: int) -> tuple[tuple[Proposal, ...], Racing]:
        """Return the next proposals of this round, up to n; of the next round where
        this one is done.
        """
        while True:
            batch, state = state.propose(n)
            runners = state.runners
            if batch or all(runner.is_over for runner in runners):
                return batch, state
            ranked = sorted(
                state.active_runners,
                key=lambda k: runners[k].best_objective,
                reverse=True,
            )
            continuing = [
                k for k in ranked[: -(-len(ranked) // 2)] if not runners[k].is_over
            ]
            # nobody left who can go on: the rest is for whoever can
            if state.round + 1 >= state.n_rounds or not continuing:
                remaining = (
                    k for k, runner in enumerate(runners) if not runner.is_over
                )
                continuing = sorted(
                    remaining, key=lambda k: -runners[k].best_objective
                )[:1]
            state = state.begin_round(
                continuing, min(state.round + 1, state.n_rounds - 1)
            )

    def update(self, state: Racing, evaluated: Evaluated) -> Racing:
        """Update each search with the evaluations of its proposals.

        Both are as its own domain has them. There may be fewer evaluations than
        proposals.
        """
        evaluated_by_runner = defaultdict[int, list[Any]](list)
        for k, (u, evaluation) in zip(
            state.runner_of_proposal, evaluated, strict=False
        ):
            evaluated_by_runner[k].append((u, evaluation))
        runners = list(state.runners)
        for k, runner_evaluated in evaluated_by_runner.items():
            runner = runners[k]
            best = max(evaluation.objective for _, evaluation in runner_evaluated)
            runner_state = runner.policy.update(runner.state, runner_evaluated)
            runners[k] = replace(
                runner,
                state=runner_state,
                best_objective=max(runner.best_objective, best),
            )
        spent = state.spent + sum(evaluation.cost for _, evaluation in evaluated)
        return replace(
            state, runners=tuple(runners), spent=spent, runner_of_proposal=()
        )

    def distribution(self, state: Racing) -> Distribution | None:
        runner = state.runners[state.leader]
        return runner.policy.distribution(runner.state)

    def failures(self, state: Racing) -> Failures | None:
        """Return the different failures of the search that has met the most; None where
        none looks for such.
        """
        known = [runner.policy.failures(runner.state) for runner in state.runners]
        return max(
            filter(None, known), key=lambda failures: failures.n_failures, default=None
        )

    def counts(self, state: Racing) -> Counts:
        return sum(
            (runner.policy.counts(runner.state) for runner in state.runners), NO_COUNTS
        )


MAX_COMBINATIONS = 256  # no more combinations than this take part
# nor more, but two, that have so many numbers together: each search keeps some such
# vectors
MAX_NUMBERS = 2**24


@dataclass(frozen=True, eq=False, kw_only=True)
class ChoicesState(Race):
    """Where the search stands: a race over the numbers alone, positions in u of numbers
    (k,) and choices (c,), and the choices' elements (n, c) of each search in it.
    """

    domain: Domain
    numbers: Tensor
    choices: Tensor
    combinations: Tensor

    def join_choices(self, numbers: Tensor, combination: int) -> Tensor:
        u = self.domain.begin.clone()
        u[self.numbers] = numbers[: len(self.numbers)]
        u[self.choices] = self.combinations[combination]
        return u


@dataclass(frozen=True)
class Choices(RacingPolicy[ChoicesState]):
    """Searches combinations of options outside and, with another policy, the numbers
    inside.

    Every combination of options has a search of its own over the numbers, and the
    combinations race. If there are more combinations than can have a whole evaluation
    in every round, a random choice of them takes part, the start's among them always.
    `search` puts this around every policy whose `handles_choices` is false, a user's
    own included.
    """

    policy: Policy[Any]

    name: ClassVar[str] = "choices"
    handles_choices: ClassVar[bool] = True

    @property
    def uses_gradient(self) -> bool:
        return self.policy.uses_gradient

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        return self.policy.takes_differences(domain, steps)

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> ChoicesState:
        seed = draw_seed(generator)
        options = domain.options
        numbers = (options == 0).nonzero().flatten()
        choices = options.nonzero().flatten()
        # of one number that is dropped, where nothing but choices may vary
        policy: Policy[Any] = Random()
        inner = Domain(torch.zeros(1), (Block(1),))
        if len(numbers):
            first = None if domain.first is None else domain.first[numbers]
            blocks = tuple(block for block in domain.blocks if not block.options)
            policy = self.policy
            inner = replace(
                domain, start=domain.start[numbers], blocks=blocks, first=first
            )
        combinations = _select_combinations(
            options[choices].tolist(),
            domain.begin[choices],
            _count_runners(domain, policy, steps),
            seeded(seed, 0),
        )
        race = start_race([(policy, inner)] * len(combinations), steps, seed)
        return ChoicesState(
            **vars(race),
            domain=domain,
            numbers=numbers,
            choices=choices,
            combinations=combinations,
        )

    def propose(
        self, state: ChoicesState, n: int
    ) -> tuple[tuple[Proposal, ...], ChoicesState]:
        proposals, state = super().propose(state, n)
        joined = tuple(
            replace(proposal, u=state.join_choices(proposal.u, runner))
            for proposal, runner in zip(
                proposals, state.runner_of_proposal, strict=True
            )
        )
        return joined, state

    def update(self, state: ChoicesState, evaluated: Evaluated) -> ChoicesState:
        inner = []
        numbers = state.numbers
        for u, evaluation in evaluated:
            gradient = (
                None if evaluation.gradient is None else evaluation.gradient[numbers]
            )
            inner.append((u[numbers], replace(evaluation, gradient=gradient)))
        return super().update(state, inner)

    def distribution(self, state: ChoicesState) -> Distribution | None:
        inner = super().distribution(state)
        if inner is None:
            return None
        deviation = torch.zeros_like(state.domain.start)
        deviation[state.numbers] = inner.deviation
        return Distribution(state.join_choices(inner.mean, state.leader), deviation)

    def failures(self, state: ChoicesState) -> None:
        """None: those of a search are without their choices."""


def wrap_choices(policy: Policy[Any], domain: Domain) -> Policy[Any]:
    """Return the policy, inside `Choices` if the domain has discrete choices that it
    does not handle itself.
    """
    discrete = any(block.options for block in domain.blocks)
    return Choices(policy) if discrete and not policy.handles_choices else policy


def _count_runners(domain: Domain, policy: Policy[Any], steps: int) -> int:
    """Return how many combinations of options can be searched in `steps` renders."""
    n_combinations = math.prod(domain.options[domain.options > 0].tolist())
    limit = min(MAX_COMBINATIONS, n_combinations, max(2, MAX_NUMBERS // domain.dim))
    cost = 1 + (domain.gradient_cost if policy.uses_gradient else 0)
    return max_runners(steps, cost, limit)


def _select_combinations(
    counts: list[int], begin: Tensor, most: int, generator: torch.Generator
) -> Tensor:
    """Return (n, c) elements of u, that of the start first: all combinations in a
    random order, or `most` of them.
    """
    sizes = torch.tensor(counts)
    total = math.prod(counts)
    start = torch.floor(begin * sizes).long().clamp(max=sizes - 1)
    if total <= max(1024, 4 * most):
        all_combinations = torch.cartesian_prod(
            *(torch.arange(count) for count in counts)
        ).reshape(total, len(counts))
        all_combinations = all_combinations[torch.randperm(total, generator=generator)]
        selected = all_combinations[~(all_combinations == start).all(dim=1)][: most - 1]
    else:
        first = tuple(start.tolist())
        sampled = {first}
        while len(sampled) < most:
            sampled.add(
                tuple(
                    int(torch.randint(count, (1,), generator=generator))
                    for count in counts
                )
            )
        selected = torch.tensor(sorted(sampled - {first})).reshape(-1, len(counts))
    centers = option_center((selected + 0.5) / sizes, sizes)
    return torch.cat([begin[None], centers.to(begin.dtype)])
