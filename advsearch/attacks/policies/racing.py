"""Successive halving between searches: what the wrappers share. After each round the better half goes on.

Rounds get equal shares of the renders, and within a round every search that is still in gets an equal share. They take
turns, step by step: next comes whoever has most of its share left, so that steps of different searches, which do not
wait for each other, can be evaluated together. After a round the half that has reached more goes on. With n searches
there are 1 + ceil(log2 n) rounds, the last for one alone, so it gets many times the renders of those that fell first
(Karnin, Koren and Somekh 2013, "Almost optimal exploration in multi-armed bandits"; Jamieson and Talwalkar 2016). With
one round for all, each gets the same. What is left of the renders after the last round is for the best.

A share counts what a proposal may cost, so that the order does not depend on how many are evaluated at once; where one
costs less, the rounds to come get what is left.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from typing import Any

from advsearch.attacks.domain import Distribution, Domain
from advsearch.attacks.failures import Failures
from advsearch.attacks.policies.base import NO_COUNTS, Counts, Evaluated, Policy, Proposal, affordable, seeded


@dataclass(frozen=True, eq=False)
class Runner:
    """One search in a race.

    Attributes:
        policy, domain: what searches where.
        state: the policy's.
        left: renders left of its share of this round.
        best: the largest objective it has met.
        over: whether it has nothing more to propose.
    """

    policy: Policy[Any]
    domain: Domain
    state: Any
    left: int = 0
    best: float = -math.inf
    over: bool = False


@dataclass(frozen=True, eq=False)
class Race:
    """Where a race stands.

    Attributes:
        runners: all searches.
        steps: renders in all.
        rounds: how many there are.
        field: numbers of those that are in this round, the best first.
        round: number of this one, from 0.
        spent: renders that the evaluations so far took.
        asked: numbers of the searches whose proposals wait for their evaluations, one for each.
    """

    runners: tuple[Runner, ...]
    steps: int
    rounds: int
    field: tuple[int, ...] = ()
    round: int = 0
    spent: int = 0
    asked: tuple[int, ...] = ()


def count_rounds(runners: int) -> int:
    """Return how many rounds a race has: 1 + ceil(log2 runners)."""
    return 1 + (runners - 1).bit_length()


def most_runners(steps: int, each: int, limit: int) -> int:
    """Return how many searches, at least 1 and at most `limit`, can have `each` renders in every round."""
    count = 1
    while count < limit and (count + 1) * count_rounds(count + 1) * each <= steps:
        count += 1
    return count


def line_up(
    searches: Sequence[tuple[Policy[Any], Domain]], steps: int, seed: int, *, rounds: int | None = None
) -> Race:
    """Return a race before its first proposal, of `count_rounds` rounds where no other number is given; each search
    plans for the renders that it gets if it stays in to the end."""
    steps, rounds = max(1, steps), rounds or count_rounds(len(searches))
    planned, count = 0.0, len(searches)
    for _ in range(rounds):
        planned += steps / rounds / count
        count = -(-count // 2)
    runners = tuple(
        Runner(policy, domain, policy.start(domain, seeded(seed, number), max(1, int(planned))))
        for number, (policy, domain) in enumerate(searches)
    )
    return _begin(Race(runners, steps, rounds), range(len(runners)), 0)


def propose(race: Race, n: int) -> tuple[tuple[Proposal, ...], Race]:
    """Return the next proposals of this round, up to n; of the next round where this one is done."""
    while True:
        batch, race = _ask(race, n)
        if batch or all(runner.over for runner in race.runners):
            return batch, race
        race = _next_round(race)


def update(race: Race, evaluated: Evaluated) -> Race:
    """Tell each search what came of its proposals, or of the first of them; every u and its evaluation are as its own
    domain has them."""
    told = defaultdict[int, list[Any]](list)
    for number, (u, evaluation) in zip(race.asked, evaluated, strict=False):
        told[number].append((u, evaluation))
    runners = list(race.runners)
    for number, own in told.items():
        runner, reached = runners[number], max(evaluation.objective for _, evaluation in own)
        state = runner.policy.update(runner.state, own)
        runners[number] = replace(runner, state=state, best=max(runner.best, reached))
    spent = race.spent + sum(evaluation.cost for _, evaluation in evaluated)
    return replace(race, runners=tuple(runners), spent=spent, asked=())


def leader(race: Race) -> int:
    """Return the number of the search that has met the largest objective so far, the first of equals."""
    return max(range(len(race.runners)), key=lambda k: race.runners[k].best)


def answer(race: Race) -> Distribution | None:
    """Return the leader's distribution, if it has one."""
    runner = race.runners[leader(race)]
    return runner.policy.answer(runner.state)


def failures(race: Race) -> Failures | None:
    """Return the different failures of the search that has met the most; None where none looks for such."""
    found = (runner.policy.failures(runner.state) for runner in race.runners)
    return max((one for one in found if one is not None), key=lambda one: one.found, default=None)


def counts(race: Race) -> Counts:
    """Return the sum over all searches."""
    return sum((runner.policy.counts(runner.state) for runner in race.runners), NO_COUNTS)


class Raced(Policy[Race]):
    """A policy that is a race; its `start` lines it up."""

    def propose(self, state: Race, n: int) -> tuple[tuple[Proposal, ...], Race]:
        return propose(state, n)

    def update(self, state: Race, evaluated: Evaluated) -> Race:
        return update(state, evaluated)

    def answer(self, state: Race) -> Distribution | None:
        return answer(state)

    def failures(self, state: Race) -> Failures | None:
        return failures(state)

    def counts(self, state: Race) -> Counts:
        return counts(state)


# ---- turns and rounds -----------------------------------------------------------------------------------------------


def _begin(race: Race, field: Iterable[int], number: int) -> Race:
    """Begin a round of what is left of the renders, with equal shares for those that are in."""
    field = tuple(field)
    share = max(1, (race.steps - race.spent) // (race.rounds - number) // len(field))
    runners = [replace(runner, left=0) for runner in race.runners]
    for k in field:
        runners[k] = replace(runners[k], left=share)
    return replace(race, runners=tuple(runners), field=field, round=number)


def _next_round(race: Race) -> Race:
    """Begin the next round with the best of this one."""
    runners = race.runners
    ranked = sorted(race.field, key=lambda k: runners[k].best, reverse=True)
    able = [k for k in ranked[: -(-len(ranked) // 2)] if not runners[k].over]
    if race.round + 1 >= race.rounds or not able:  # nobody left who can go on: the renders are for whoever still can
        able = sorted((k for k, runner in enumerate(runners) if not runner.over), key=lambda k: -runners[k].best)[:1]
    return _begin(race, able, min(race.round + 1, race.rounds - 1))


def _ask(race: Race, n: int) -> tuple[tuple[Proposal, ...], Race]:
    """Return up to n proposals of this round that do not wait for each other; none where it is done."""
    runners, field = list(race.runners), race.field
    queue = _queue(runners, field)
    each = -(-n // max(1, len(queue)))
    given, taken = dict[int, tuple[Proposal, ...]](), Counter[int]()
    batch, asked = list[Proposal](), list[int]()
    while queue and len(batch) < n:
        _, place = queue[0]
        k = field[place]
        runner = runners[k]
        if k not in given:
            given[k], state = runner.policy.propose(runner.state, min(each, runner.left))
            runner = replace(runner, state=state)
        if not given[k]:
            # take out a search that has nothing more to propose; its share is for those that are left in the round
            share, runners[k] = runners[k].left, replace(runners[k], left=0, over=True)
            others = [other for other in field if not runners[other].over]
            for other in others:
                runners[other] = replace(runners[other], left=runners[other].left + share // len(others))
            queue = _queue(runners, field)
            continue
        if taken[k] == len(given[k]):  # what it proposes next, these evaluations say
            break
        wanted = given[k][taken[k]]
        capped = replace(wanted, samples=min(runner.left, wanted.samples))
        later = race.round + 1 < race.rounds  # there will be renders to use a gradient
        batch.append(affordable(capped, runner.domain, runner.left + later))
        asked.append(k)
        taken[k] += 1
        runners[k] = replace(runner, left=runner.left - batch[-1].cost(runner.domain))
        heappop(queue)
        if runners[k].left:
            heappush(queue, (-runners[k].left, place))
    for k, count in taken.items():
        if count < len(given[k]):  # it shall not count on more than was taken
            _, state = runners[k].policy.propose(race.runners[k].state, count)
            runners[k] = replace(runners[k], state=state)
    return tuple(batch), replace(race, runners=tuple(runners), asked=tuple(asked))


def _queue(runners: Sequence[Runner], field: Sequence[int]) -> list[tuple[int, int]]:
    """Return a heap of places in the field, first that of whoever has most left: the first of equals."""
    queue = [(-runners[k].left, place) for place, k in enumerate(field) if runners[k].left]
    heapify(queue)
    return queue
