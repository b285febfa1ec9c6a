"""Races of several searches, and discrete choices for a policy that only searches
numbers: each combination of options has its own search, and these race.

A race is successive halving (Karnin, Koren and Somekh 2013, "Almost optimal exploration
in multi-armed bandits"; Jamieson and Talwalkar 2016). It has 1 + ceil(log2 n) rounds
with equally many renders, divided equally among the searches that are left. In a round
the searches take turns: the one with the most renders left comes next. A proposal is
charged with the largest cost that it may have.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from advsearch.attacks.candidates import Failures
from advsearch.attacks.domain import Block, Distribution, Domain, option_center
from advsearch.attacks.evaluation import (
    NO_COUNTS,
    CorrectionCounts,
    Evaluated,
    Policy,
    Proposal,
    draw_seed,
    seeded,
)
from advsearch.attacks.policies.sampling import Random


@dataclass(frozen=True, eq=False)
class Runner:
    """One search in a race.

    Attributes:
        policy: policy that searches.
        domain: domain that it searches.
        state: state of the policy.
        renders_left: renders that it may still use in this round.
        best_objective: the largest objective of the search so far.
        is_over: whether it has nothing more to propose.
    """

    policy: Policy[Any]
    domain: Domain
    state: Any
    renders_left: int = 0
    best_objective: float = -math.inf
    is_over: bool = False

    def propose(self, limit: int) -> tuple[tuple[Proposal, ...], Runner]:
        """Return at most `limit` proposals, and the search in the state after them."""
        n = min(limit, self.renders_left)
        proposals, state = self.policy.propose(self.state, n)
        return proposals, replace(self, state=state)

    def charge(self, proposal: Proposal) -> Runner:
        """Return the search after it has paid for one of its proposals."""
        cost = proposal.max_cost(self.domain)
        return replace(self, renders_left=self.renders_left - cost)

    def update(self, evaluated: Evaluated) -> Runner:
        """Return the search after the evaluations of some of its proposals."""
        best = max(evaluation.objective for _, evaluation in evaluated)
        state = self.policy.update(self.state, evaluated)
        best_objective = max(self.best_objective, best)
        return replace(self, state=state, best_objective=best_objective)


Racing = TypeVar("Racing", bound="Race")


@dataclass(frozen=True, eq=False)
class Race:
    """The state of a race. In its methods, k is the index of a search in `runners`.

    Attributes:
        runners: the searches.
        steps: renders of the race.
        n_rounds: number of rounds of the race.
        active_runners: indices of the searches that take part in this round, the best
            first.
        round: index of the current round.
        renders_spent: number of renders of the evaluations so far.
        runner_of_proposal: for each of the latest proposals, the index of its search.
    """

    runners: tuple[Runner, ...]
    steps: int
    n_rounds: int
    active_runners: tuple[int, ...] = ()
    round: int = 0
    renders_spent: int = 0
    runner_of_proposal: tuple[int, ...] = ()

    @property
    def leader(self) -> int:
        """Index of the search with the largest objective so far; the first if several
        are equal.
        """
        return max(
            range(len(self.runners)), key=lambda k: self.runners[k].best_objective
        )

    def begin_round(self: Racing, runners_left: Iterable[int], number: int) -> Racing:
        """Return the race at the beginning of a round.

        Args:
            runners_left: indices of the searches that take part; they get equal
                renders.
            number: index of the round.
        """
        active_runners = tuple(runners_left)
        rounds_left = self.n_rounds - number
        renders_of_round = (self.steps - self.renders_spent) // rounds_left
        renders_each = max(1, renders_of_round // len(active_runners))
        runners = [
            replace(runner, renders_left=renders_each if index in active_runners else 0)
            for index, runner in enumerate(self.runners)
        ]
        return replace(
            self, runners=tuple(runners), active_runners=active_runners, round=number
        )

    def propose(self: Racing, n: int) -> tuple[tuple[Proposal, ...], Racing]:
        """Return up to n proposals of this round that do not depend on each other.

        There are none if the round is over. Each search makes its proposals in one
        call: n divided by the number of searches.

        Args:
            n: largest number of proposals.
        """
        batch = _Batch(self, list(self.runners))
        batch.max_proposals = math.ceil(n / max(1, len(batch.find_waiting())))
        while batch.find_waiting() and len(batch.proposals) < n:
            if not batch.add_next():
                break
        batch.drop_unused()
        return tuple(batch.proposals), replace(
            self,
            runners=tuple(batch.runners),
            runner_of_proposal=tuple(batch.runner_of_proposal),
        )


@dataclass(eq=False)
class _Batch:
    """The proposals of a race that are evaluated together, while they are collected.

    They are collected one by one, the next always from the search with the most renders
    left. The batch ends when it is the turn of a search whose proposals are used up,
    because its next ones depend on evaluations of this batch.

    Attributes:
        race: the race before the batch.
        runners: its searches, in their states so far.
        max_proposals: largest number of proposals of each search.
        proposals: the proposals of the batch.
        runner_of_proposal: for each of them, the index of its search.
        available: all proposals that a search has made, by the index of the search.
        n_used: how many of them are in the batch.
    """

    race: Race
    runners: list[Runner]
    max_proposals: int = 0
    proposals: list[Proposal] = field(default_factory=list)
    runner_of_proposal: list[int] = field(default_factory=list)
    available: dict[int, tuple[Proposal, ...]] = field(default_factory=dict)
    n_used: Counter[int] = field(default_factory=Counter)

    def find_waiting(self) -> list[int]:
        """Return the indices of active runners that have renders left."""
        active_runners = self.race.active_runners
        return [index for index in active_runners if self.runners[index].renders_left]

    def add_next(self) -> bool:
        """Add a proposal of the search whose turn it is, or retire this search.

        Returns:
            False if the batch ends, because the proposals of the search are used up.
        """
        k = max(self.find_waiting(), key=lambda index: self.runners[index].renders_left)
        proposer = self.runners[k]
        if k not in self.available:
            # `_add_proposal` stores the new state in `runners`. A search without a proposal
            # stays in its state before.
            self.available[k], proposer = proposer.propose(self.max_proposals)
        if not self.available[k]:  # nothing to propose
            self._retire(k)
            return True
        if self.n_used[k] == len(self.available[k]):
            return False
        self._add_proposal(k, proposer)
        return True

    def _add_proposal(self, k: int, proposer: Runner) -> None:
        """Add the next proposal of search k, which is charged for it."""
        proposal = self._limit_proposal(self.available[k][self.n_used[k]], proposer)
        self.proposals.append(proposal)
        self.runner_of_proposal.append(k)
        self.n_used[k] += 1
        self.runners[k] = proposer.charge(proposal)

    def _limit_proposal(self, proposal: Proposal, runner: Runner) -> Proposal:
        """Return a proposal that the renders of its runner can pay."""
        proposal = replace(proposal, samples=min(runner.renders_left, proposal.samples))
        renders_left = runner.renders_left
        has_later_round = self.race.round + 1 < self.race.n_rounds
        # `limit_cost` drops a gradient that uses up the renders, because no step could
        # follow it. If there is a later round, its renders follow. Then a gradient that
        # exactly uses up those of this round is kept, by one render more.
        if has_later_round:
            renders_left += 1
        return proposal.limit_cost(runner.domain, renders_left)

    def _retire(self, k: int) -> None:
        """End search k, which has nothing more to propose.

        Its renders are divided among the searches that are left in the round.
        """
        runners = self.runners
        renders = runners[k].renders_left
        runners[k] = replace(runners[k], renders_left=0, is_over=True)
        active_runners = self.race.active_runners
        others = [other for other in active_runners if not runners[other].is_over]
        if not others:
            return
        renders_each, remainder = divmod(renders, len(others))
        for position, other in enumerate(others):
            # the remainder goes to the first ones, one render each
            added = renders_each + 1 if position < remainder else renders_each
            renders_left = runners[other].renders_left + added
            runners[other] = replace(runners[other], renders_left=renders_left)

    def drop_unused(self) -> None:
        """Move each search back to where it has made no more proposals than are used.

        A search expects evaluations of all its proposals. If not all were used, it
        proposes again from its state before the batch, only as many as were used.
        """
        for k, count in self.n_used.items():
            if count < len(self.available[k]):
                runner = self.race.runners[k]
                _, state = runner.policy.propose(runner.state, count)
                self.runners[k] = replace(self.runners[k], state=state)


def count_rounds(runners: int) -> int:
    """Return how many rounds a race has: 1 + ceil(log2 runners).

    Each round halves the searches; in the last one a single search is left.
    """
    return 1 + (runners - 1).bit_length()


def max_runners(steps: int, each: int, limit: int) -> int:
    """Return the largest number of searches for which the renders of a race suffice.

    It is at least 1, even if the renders do not suffice for that.

    Args:
        steps: renders of the race.
        each: renders that a search needs in every round.
        limit: upper limit of the result.
    """

    def count_renders(n_searches: int) -> int:
        # All rounds have as many renders as the first, in which all searches take part.
        return count_rounds(n_searches) * n_searches * each

    count = 1
    while count < limit and count_renders(count + 1) <= steps:
        count += 1
    return count


def start_race(
    searches: Sequence[tuple[Policy[Any], Domain]],
    steps: int,
    seed: int,
    *,
    rounds: int | None = None,
) -> Race:
    """Start all searches of a race, and begin its first round.

    After each round the worse half of the searches is dropped (successive halving).

    Args:
        searches: policies, each with the domain that it searches.
        steps: renders of the race.
        seed: seed of random numbers.
        rounds: number of rounds; by default as many as leave a single search.
    """
    steps = max(1, steps)
    if rounds is None:
        rounds = count_rounds(len(searches))
    renders = max(1, int(_plan_renders(len(searches), steps, rounds)))
    runners = _start_runners(searches, renders, seed)
    race = Race(runners, steps, n_rounds=rounds)
    all_runners = range(len(runners))
    return race.begin_round(all_runners, number=0)


def _start_runners(
    searches: Sequence[tuple[Policy[Any], Domain]], renders: int, seed: int
) -> tuple[Runner, ...]:
    """Return the searches of a race in their first states.

    Args:
        searches: policies, each with the domain that it searches.
        renders: renders that each plans for.
        seed: seed of random numbers; each search gets other ones.
    """
    runners = []
    for number, (policy, domain) in enumerate(searches):
        state = policy.start(domain, seeded(seed, number), renders)
        runners.append(Runner(policy, domain, state))
    return tuple(runners)


def _plan_renders(n_searches: int, steps: int, rounds: int) -> float:
    """Return the number of renders of a search that is never dropped from a race.

    It is its part of each round. All rounds have equally many renders.

    Args:
        n_searches: number of searches in the first round.
        steps: renders of the race.
        rounds: number of rounds.
    """
    planned_renders = 0.0
    n_active = n_searches
    for _ in range(rounds):
        planned_renders += steps / rounds / n_active
        n_active = math.ceil(n_active / 2)
    return planned_renders


class RacingPolicy(Policy[Racing]):
    """A policy that is a race, which its `start` makes."""

    def propose(self, state: Racing, n: int) -> tuple[tuple[Proposal, ...], Racing]:
        """Return the next proposals, at most n.

        If the round is over, the next one begins. There are no proposals once all
        searches are over.
        """
        while True:
            batch, state = state.propose(n)
            if batch or all(runner.is_over for runner in state.runners):
                return batch, state
            # An empty batch means that the round is over. After the last round some
            # renders may be left, as proposals may have cost less than they were
            # charged. Then another round begins, with the index of the last.
            last_round = state.n_rounds - 1
            next_round = min(state.round + 1, last_round)
            continuing = self._select_continuing(state)
            state = state.begin_round(continuing, next_round)

    @staticmethod
    def _select_continuing(race: Race) -> list[int]:
        """Return the indices of the searches of the next round, the best first.

        The better half of this round continues, without searches that are over. Two
        cases are different: this was the last round, or the whole better half is over.
        Then a single search continues. It is the best of all that are not over, also of
        those that were dropped in an earlier round.
        """
        runners = race.runners
        ranked = sorted(
            race.active_runners, key=lambda k: runners[k].best_objective, reverse=True
        )
        better_half = ranked[: math.ceil(len(ranked) / 2)]
        continuing = [k for k in better_half if not runners[k].is_over]
        has_later_round = race.round + 1 < race.n_rounds
        if continuing and has_later_round:
            return continuing
        remaining = [k for k, runner in enumerate(runners) if not runner.is_over]
        return sorted(remaining, key=lambda k: -runners[k].best_objective)[:1]

    def update(self, state: Racing, evaluated: Evaluated) -> Racing:
        """Update each search with the evaluations of its proposals.

        Args:
            state: state of the race.
            evaluated: configurations and their evaluations, in the order of the latest
                proposals; there may be fewer, if the search is interrupted.
        """
        runners = list(state.runners)
        for k, runner_evaluated in self._group_by_runner(state, evaluated).items():
            runners[k] = runners[k].update(runner_evaluated)
        cost = sum(evaluation.cost for _, evaluation in evaluated)
        return replace(
            state,
            runners=tuple(runners),
            renders_spent=state.renders_spent + cost,
            runner_of_proposal=(),
        )

    @staticmethod
    def _group_by_runner(race: Race, evaluated: Evaluated) -> dict[int, list[Any]]:
        """Return the evaluated proposals of each search, by the index of the search."""
        evaluated_by_runner = defaultdict[int, list[Any]](list)
        # there may be fewer evaluations than proposals
        pairs = zip(race.runner_of_proposal, evaluated, strict=False)
        for k, evaluated_proposal in pairs:
            evaluated_by_runner[k].append(evaluated_proposal)
        return evaluated_by_runner

    def distribution(self, state: Racing) -> Distribution | None:
        runner = state.runners[state.leader]
        return runner.policy.distribution(runner.state)

    def failures(self, state: Racing) -> Failures | None:
        """Return the failures of the search that has met the most of them, or None if
        no search looks for different failures.
        """
        failures_of_runners = [
            runner.policy.failures(runner.state) for runner in state.runners
        ]
        return max(
            filter(None, failures_of_runners),
            key=lambda failures: failures.n_failures,
            default=None,
        )

    def counts(self, state: Racing) -> CorrectionCounts:
        return sum(
            (runner.policy.counts(runner.state) for runner in state.runners), NO_COUNTS
        )


# Limits of the combinations of options that take part: their number, and the number of
# elements that all their configurations have together, as searches store these.
MAX_COMBINATIONS = 256
MAX_NUMBERS = 2**24
# Up to this many combinations are always listed, and not sampled.
MIN_LISTED_COMBINATIONS = 1024


@dataclass(frozen=True, eq=False, kw_only=True)
class ChoicesState(Race):
    """State of the search: a race with one search for each combination of options.

    The searches of the race only have the numbers of the domain. Search k has
    combination k.

    Attributes:
        domain: domain of numbers and choices.
        numbers: (k,) indices of the numbers in u.
        choices: (c,) indices of the discrete choices in u.
        combinations: (n, c) elements of u that are choices, for each search.
    """

    domain: Domain
    numbers: Tensor
    choices: Tensor
    combinations: Tensor

    def join_choices(self, numbers: Tensor, combination: int) -> Tensor:
        """Return the configuration (d,) of a search's numbers and options.

        Args:
            numbers: (k,) elements of u that are numbers. If the domain has none, this
                is a dummy, and ignored.
            combination: index of the combination of options. The search of it has the
                same index.
        """
        u = self.domain.initial_point.clone()
        u[self.numbers] = numbers[: len(self.numbers)]  # nothing of a dummy
        u[self.choices] = self.combinations[combination]
        return u


@dataclass(frozen=True)
class Choices(RacingPolicy[ChoicesState]):
    """Searches discrete choices with a policy that only searches numbers.

    Every combination of options has its own search over the numbers, and these race.
    The renders have to suffice for an evaluation (with its gradient) of every
    combination in each of its rounds. If there are too many, a random subset takes
    part, which always includes the combination of the start. `search` wraps every
    policy whose `handles_choices` is false in this, also those of users.
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
        """Start one search of the numbers for each combination of options.

        If all parameters are choices, the searches have no numbers. But a policy needs
        one, so each is a random search of a dummy number, which is dropped from its
        proposals (`ChoicesState.join_choices`).

        Args:
            domain: domain of numbers and choices.
            generator: source of the seed.
            steps: renders of the search.
        """
        seed = draw_seed(generator)
        is_choice = domain.option_counts > 0  # a number has 0 options
        numbers = (~is_choice).nonzero().flatten()
        choices = is_choice.nonzero().flatten()
        policy, inner_domain = self._make_inner_search(domain, numbers)
        max_combinations = _count_affordable_combinations(domain, policy, steps)
        combinations = _select_combinations(
            domain, choices, max_combinations, generator=seeded(seed, 0)
        )
        # one search for each combination, all of the same numbers
        searches = [(policy, inner_domain)] * len(combinations)
        race = start_race(searches, steps, seed)
        return ChoicesState(
            **vars(race),  # all fields of `Race`, which `ChoicesState` inherits
            domain=domain,
            numbers=numbers,
            choices=choices,
            combinations=combinations,
        )

    def _make_inner_search(
        self, domain: Domain, numbers: Tensor
    ) -> tuple[Policy[Any], Domain]:
        """Return the policy and the domain of each search of a combination.

        Args:
            domain: domain of numbers and choices.
            numbers: (k,) indices of the numbers; if there are none, the search is a
                random search of a dummy number.
        """
        if len(numbers):
            return self.policy, _drop_choices(domain, numbers)
        return Random(), Domain(torch.zeros(1), (Block(1),))

    def propose(
        self, state: ChoicesState, n: int
    ) -> tuple[tuple[Proposal, ...], ChoicesState]:
        """Propose what the race proposes, each with the options of its search."""
        # The proposals of the race only have numbers. The state that it returns says
        # which search made each of them; search k has combination k.
        inner_proposals, state = super().propose(state, n)
        proposals = []
        for proposal, k in zip(inner_proposals, state.runner_of_proposal, strict=True):
            u = state.join_choices(proposal.u, combination=k)
            proposals.append(replace(proposal, u=u))
        return tuple(proposals), state

    def update(self, state: ChoicesState, evaluated: Evaluated) -> ChoicesState:
        """Update each inner search with the evaluations of its proposals.

        The inner searches have no choices, so configurations and gradients are reduced
        to the numbers.
        """
        inner_evaluated = []
        numbers = state.numbers
        for u, evaluation in evaluated:
            gradient = evaluation.gradient
            if gradient is not None:
                gradient = gradient[numbers]
            inner_evaluated.append((u[numbers], replace(evaluation, gradient=gradient)))
        return super().update(state, inner_evaluated)

    def distribution(self, state: ChoicesState) -> Distribution | None:
        """Return the distribution (d,) of the leading search.

        That search only has the numbers of the domain. Its options are added to the
        mean, with a standard deviation of zero.
        """
        # that of the leading search, which has the index `state.leader`
        inner_distribution = super().distribution(state)
        if inner_distribution is None:
            return None
        deviation = torch.zeros_like(state.domain.start)
        number_indices = state.numbers
        deviation[number_indices] = inner_distribution.deviation
        # search k has combination k
        mean = state.join_choices(inner_distribution.mean, combination=state.leader)
        return Distribution(mean, deviation)

    def failures(self, state: ChoicesState) -> None:
        """Return None: the failures of an inner search lack their choices."""


def wrap_choices(policy: Policy[Any], domain: Domain) -> Policy[Any]:
    """Return a policy that can search a domain with discrete choices.

    If the domain has choices and the policy only searches numbers, it is wrapped in
    `Choices`. Otherwise the policy itself is returned.
    """
    has_choices = any(block.n_options for block in domain.blocks)
    if has_choices and not policy.handles_choices:
        return Choices(policy)
    return policy


def _drop_choices(domain: Domain, numbers: Tensor) -> Domain:
    """Return a domain without its discrete choices; `numbers` are the other indices."""
    restart_point = domain.restart_point
    if restart_point is not None:
        restart_point = restart_point[numbers]
    return replace(
        domain,
        start=domain.start[numbers],
        blocks=tuple(block for block in domain.blocks if not block.n_options),
        restart_point=restart_point,
    )


def _count_affordable_combinations(
    domain: Domain, policy: Policy[Any], steps: int
) -> int:
    """Return how many combinations of options can be searched in `steps` renders."""
    n_combinations = math.prod(domain.option_counts[domain.option_counts > 0].tolist())
    # Each search stores configurations of `dim` numbers. There may be two in any case.
    max_in_memory = max(2, MAX_NUMBERS // domain.dim)
    limit = min(MAX_COMBINATIONS, n_combinations, max_in_memory)
    renders_per_evaluation = 1
    if policy.uses_gradient:
        renders_per_evaluation += domain.gradient_cost
    return max_runners(steps, each=renders_per_evaluation, limit=limit)


def _select_combinations(
    domain: Domain, choices: Tensor, max_combinations: int, generator: torch.Generator
) -> Tensor:
    """Select combinations of options, the initial one first.

    If there are few combinations, all are listed, and the others follow the initial one
    in a random order. Otherwise different ones are sampled, and follow in ascending
    order.

    Args:
        domain: domain of numbers and choices.
        choices: (c,) indices of the choices in u.
        max_combinations: largest number of combinations.
        generator: generator of random numbers; it advances.

    Returns:
        (n, c) elements of u: those of the initial point as they are, then others at the
        centers of the options.
    """
    n_options = domain.option_counts[choices].tolist()
    sizes = torch.tensor(n_options)
    initial_point = domain.initial_point[choices]
    # index of the option of each choice; u = 1 belongs to the last
    initial = torch.floor(initial_point * sizes).long().clamp(max=sizes - 1)
    selected = _select_others(n_options, initial, max_combinations, generator)
    # `selected` has indices; option i of n has the center (i + 1/2) / n
    centers = option_center((selected + 0.5) / sizes, sizes)
    return torch.cat([initial_point[None], centers.to(initial_point.dtype)])


def _select_others(
    n_options: list[int],
    initial: Tensor,
    max_combinations: int,
    generator: torch.Generator,
) -> Tensor:
    """Return the indices of options (n, c) of combinations other than the initial one.

    Args:
        n_options: number of options of each of the c choices.
        initial: (c,) index of the option of each choice in the initial combination.
        max_combinations: largest number of combinations, with the initial one.
        generator: generator of random numbers; it advances.
    """
    # With more combinations than this, samples are rarely equal, so that drawing until
    # enough of them differ takes few draws.
    max_listed = max(MIN_LISTED_COMBINATIONS, 4 * max_combinations)
    if math.prod(n_options) <= max_listed:
        combinations = _shuffle_combinations(n_options, generator)
        is_initial = (combinations == initial).all(dim=1)
        return combinations[~is_initial][: max_combinations - 1]
    initial_options = tuple(initial.tolist())
    return _sample_combinations(
        n_options, initial_options, max_combinations - 1, generator
    )


def _shuffle_combinations(n_options: list[int], generator: torch.Generator) -> Tensor:
    """Return all combinations of options (n, c), as their indices, in a random order.

    `n_options` has the number of options of each of the c choices.
    """
    total = math.prod(n_options)
    axes = [torch.arange(count) for count in n_options]
    combinations = torch.cartesian_prod(*axes).reshape(total, len(n_options))
    return combinations[torch.randperm(total, generator=generator)]


def _sample_combinations(
    n_options: list[int],
    initial: tuple[int, ...],
    count: int,
    generator: torch.Generator,
) -> Tensor:
    """Sample different combinations of options.

    Args:
        n_options: number of options of each of the c choices. There must be far more
            combinations than `count`, or this would take long.
        initial: index of the option of each choice in a combination to leave out.
        count: number of combinations.
        generator: generator of random numbers; it advances.

    Returns:
        (count, c) indices of options; rows in ascending order.
    """
    sampled = set[tuple[int, ...]]()
    while len(sampled) < count:
        options = tuple(
            int(torch.randint(size, (1,), generator=generator)) for size in n_options
        )
        if options != initial:
            sampled.add(options)
    return torch.tensor(sorted(sampled)).reshape(-1, len(n_options))
