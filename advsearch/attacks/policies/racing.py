"""Successive halving between searches: what the wrappers share. Each round, those that reached less are left behind.

Rounds get equal shares of the renders, and within a round every search that is still in gets an equal share, one after
the other. After a round the best 1 / eta of them go on. With n searches there are 1 + ceil(log_eta n) rounds, the last
for one alone, so it gets many times the renders of those that fell first (Karnin, Koren and Somekh 2013, "Almost
optimal exploration in multi-armed bandits"; Jamieson and Talwalkar 2016). With eta = 1 there is one round: all get the
same.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from typing import Any

from advsearch.attacks.distribution import Distribution
from advsearch.attacks.domain import Domain
from advsearch.attacks.failures import Failures
from advsearch.attacks.policies.base import (
    NO_COUNTS,
    Counts,
    Evaluated,
    Policy,
    Proposal,
    affordable,
    seeded,
)


@dataclass(frozen=True, eq=False)
class Runner:
    """One search in a race.

    Attributes:
        policy, domain: what searches where.
        state: the policy's, None until its first turn.
        best: the largest objective it has met.
        lately: the largest in its latest turn.
        over: whether it has nothing more to propose.
    """

    policy: Policy[Any]
    domain: Domain
    state: Any = None
    best: float = -math.inf
    lately: float = -math.inf
    over: bool = False


@dataclass(frozen=True, eq=False)
class Race:
    """Where a race stands.

    Attributes:
        runners: all searches.
        field: numbers of those that are in this round, in the order of their turns.
        steps: renders in all.
        eta: one of so many goes on after a round.
        seed: of the searches' own generators.
        fresh: whether a round's order rests on its own evaluations alone.
        round, rounds: number of the round, from 0, and how many there are.
        turn: position in `field`.
        spent: renders so far.
        turn_ends, round_ends: value of `spent` at which they do.
        asked: numbers of the searches whose proposals wait for their evaluations, one for each.
    """

    runners: tuple[Runner, ...]
    field: tuple[int, ...]
    steps: int
    eta: int
    seed: int
    fresh: bool
    rounds: int
    round: int = 0
    turn: int = 0
    spent: int = 0
    turn_ends: int = 0
    round_ends: int = 0
    asked: tuple[int, ...] = ()

    @property
    def running(self) -> Runner:
        """Whose turn it is."""
        return self.runners[self.field[self.turn]]

    @property
    def left(self) -> int:
        """Renders left in this turn."""
        return self.turn_ends - self.spent


def count_rounds(runners: int, eta: int) -> int:
    """Return how many rounds a race has: 1 + ceil(log_eta runners), one for eta = 1."""
    rounds = 1
    while eta > 1 and runners > 1:
        runners, rounds = -(-runners // eta), rounds + 1
    return rounds


def most_runners(steps: int, eta: int, each: int, limit: int) -> int:
    """Return how many searches, at least 1 and at most `limit`, can have `each` renders in every round."""
    count = 1
    while count < limit and (count + 1) * count_rounds(count + 1, eta) * each <= steps:
        count += 1
    return count


def line_up(runners: tuple[Runner, ...], steps: int, seed: int, *, eta: int, fresh: bool = False) -> Race:
    """Return a race before its first proposal."""
    steps = max(1, steps)
    rounds = count_rounds(len(runners), eta)
    race = Race(runners, tuple(range(len(runners))), steps, eta, seed, fresh, rounds)
    return _begin_turn(replace(race, round_ends=steps // rounds if rounds > 1 else steps), 0)


def once(race: Race) -> int:
    """Return 1: the samples that a search asks for are what it gets."""
    return 1


def propose(race: Race, n: int, samples: Callable[[Race], int] = once) -> tuple[tuple[Proposal, ...], Race]:
    """Return the next proposals of whoever's turn it is, as far as the turn's renders allow.

    Where they are all of its turn, whatever they are worth, those of the next in the same round come along.

    Args:
        race: as it is; the next turn begins where this one is over.
        n: so many at most.
        samples: from the race in that turn to what a proposal's samples are multiplied with.
    """
    spent, batch, asked = race.spent, list[Proposal](), list[int]()
    while len(batch) < n and not all(runner.over for runner in race.runners):
        if race.running.over or race.left <= 0:
            if batch and race.turn + 1 == len(race.field):  # who is in the next round, these evaluations say
                break
            race = _next_turn(race)
            continue
        if race.field[race.turn] in asked:
            break
        race, own = _ask(race, n - len(batch), samples)
        batch += own
        asked += [race.field[race.turn]] * len(own)
        if any(proposal.cost(race.running.domain) > proposal.samples for proposal in own):  # it may cost less
            break
    return tuple(batch), replace(race, spent=spent, asked=tuple(asked))


def update(race: Race, evaluated: Evaluated) -> Race:
    """Tell each search what it asked for; every u and its evaluation are as its own domain has them."""
    for number, group in groupby(zip(race.asked, evaluated, strict=True), key=itemgetter(0)):
        own = [pair for _, pair in group]
        runner = race.runners[number]
        reached = max(evaluation.objective for _, evaluation in own)
        state = runner.policy.update(runner.state, own)
        runner = replace(runner, state=state, best=max(runner.best, reached), lately=max(runner.lately, reached))
        race = _with(race, number, runner)
    return replace(race, spent=race.spent + sum(evaluation.cost for _, evaluation in evaluated), asked=())


def turns(race: Race, samples: Callable[[Race], int] = once) -> list[tuple[Race, int]]:
    """Return the turns that are left in this round, or those of the next, see `Policy.turns`; `samples` as for
    `propose`."""
    found = []
    while race.running.over or race.left <= 0:
        if all(runner.over for runner in race.runners):
            return []
        race = _next_turn(race)
    while True:
        if not race.running.over and race.left > 0:
            found.append((race, _evaluations(race, samples)))
        if race.turn + 1 == len(race.field):
            return found
        race = _begin_turn(replace(race, spent=max(race.spent, race.turn_ends)), race.turn + 1)


def leader(race: Race) -> int:
    """Return the number of the search that has met the largest objective so far, the first of equals."""
    return max(range(len(race.runners)), key=lambda k: race.runners[k].best)


def answer(race: Race) -> Distribution | None:
    """Return the leader's distribution, if it has one."""
    runner = race.runners[leader(race)]
    return None if runner.state is None else runner.policy.answer(runner.state)


def failures(race: Race) -> Failures | None:
    """Return the different failures of the search that has met the most; None where none looks for such."""
    begun = [runner.policy.failures(runner.state) for runner in race.runners if runner.state is not None]
    return max((one for one in begun if one is not None), key=lambda one: one.found, default=None)


def counts(race: Race) -> Counts:
    """Return the sum over all searches."""
    begun = [runner for runner in race.runners if runner.state is not None]
    return sum((runner.policy.counts(runner.state) for runner in begun), NO_COUNTS)


class Raced(Policy[Race]):
    """A policy that is a race; its `start` lines it up."""

    def propose(self, state: Race, n: int) -> tuple[tuple[Proposal, ...], Race]:
        return propose(state, n)

    def update(self, state: Race, evaluated: Evaluated) -> Race:
        return update(state, evaluated)

    def turns(self, state: Race) -> list[tuple[Race, int]]:
        return turns(state)

    def answer(self, state: Race) -> Distribution | None:
        return answer(state)

    def failures(self, state: Race) -> Failures | None:
        return failures(state)

    def counts(self, state: Race) -> Counts:
        return counts(state)


# ---- turns and rounds -----------------------------------------------------------------------------------------------


def _with(race: Race, k: int, runner: Runner) -> Race:
    return replace(race, runners=(*race.runners[:k], runner, *race.runners[k + 1 :]))


def _ask(race: Race, n: int, samples: Callable[[Race], int]) -> tuple[Race, tuple[Proposal, ...]]:
    """Let whoever's turn it is propose up to n, and return the race as it is when they have cost what they may."""
    runner, later = race.running, race.round + 1 < race.rounds
    if runner.state is None:
        generator = seeded(race.seed, race.field[race.turn])
        runner = replace(runner, state=runner.policy.start(runner.domain, generator, _planned(race)))
    if samples(race) > 1:  # a race inside this one counts renders as it asks for them, and would begin turns too soon
        n = 1
    while True:
        proposals, state = runner.policy.propose(runner.state, n)
        ahead, own = race, list[Proposal]()
        for proposal in proposals:
            if ahead.left > 0:
                more = replace(proposal, samples=proposal.samples * samples(ahead))
                own.append(affordable(more, runner.domain, ahead.left + later))
                ahead = replace(ahead, spent=ahead.spent + own[-1].cost(runner.domain))
        if len(own) == len(proposals):
            runner = replace(runner, state=state, over=not own)
            return _with(ahead, race.field[race.turn], runner), tuple(own)
        n = len(own)  # the turn does not pay for more


def _evaluations(race: Race, samples: Callable[[Race], int]) -> int:
    """Return how many evaluations the renders left in this turn suffice for, if each wants a gradient where the policy
    uses them."""
    runner, later, count = race.running, race.round + 1 < race.rounds, 0
    while race.left > 0:
        proposal = Proposal(runner.domain.start, gradient=runner.policy.uses_gradient, samples=samples(race))
        cost = affordable(proposal, runner.domain, race.left + later).cost(runner.domain)
        race, count = replace(race, spent=race.spent + cost), count + 1
    return count


def _planned(race: Race) -> int:
    """Return the renders that the search gets if it stays in to the end."""
    total, count = 0.0, len(race.field)
    for _ in range(race.round, race.rounds):
        total += race.steps / race.rounds / count
        count = -(-count // race.eta)
    return max(1, int(total))


def _begin_turn(race: Race, turn: int) -> Race:
    """Give a search its share of what is left of the round."""
    race = replace(race, turn=turn)
    share = (race.round_ends - race.spent) // (len(race.field) - turn)
    race = _with(race, race.field[turn], replace(race.running, lately=-math.inf))
    return replace(race, turn_ends=race.spent + max(1, share))


def _next_turn(race: Race) -> Race:
    """Go on to the next search, or to the next round with the best of this one."""
    if race.turn + 1 < len(race.field):
        return _begin_turn(race, race.turn + 1)

    def reached(k: int) -> float:
        return race.runners[k].lately if race.fresh else race.runners[k].best

    ranked = sorted(race.field, key=reached, reverse=True)
    able = [k for k in ranked[: -(-len(ranked) // race.eta)] if not race.runners[k].over]
    if race.round + 1 >= race.rounds or not able:  # nobody left who can go on: the renders are for whoever still can
        others = [k for k in range(len(race.runners)) if not race.runners[k].over]
        able = sorted(others, key=lambda k: race.runners[k].best, reverse=True)[:1]
    if not able:
        return race
    number = min(race.round + 1, race.rounds - 1)
    last = number + 1 == race.rounds
    ends = race.steps if last else race.spent + max(1, (race.steps - race.spent) // (race.rounds - number))
    return _begin_turn(replace(race, field=tuple(able), round=number, round_ends=max(ends, race.spent + 1)), 0)
