"""Searches over base colours under conditions that vary by chance, by a matrix of light
transport for each of a growing bank of them (docs/transport.md).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.domain import Domain, Draws
from advsearch.attacks.evaluation import Query, WhichGradient
from advsearch.attacks.policies.sampling import to_domain
from advsearch.engine.acceptance import ComparedView
from advsearch.engine.transport import PredictedSearch
from advsearch.runs.results import BankOfConditions
from advsearch.scene.color import to_8_bit
from advsearch.scene.predictor import MOST_BYTES
from advsearch.scene.transport.matrix import LinearRenderer, Tick
from advsearch.trust.stored_files import scaled

FIRST = 8  # conditions in the bank at first, in what an evaluation draws
# an evaluation adds a condition for so many that it draws, while the bank grows
GROWTH = 4
EVERY = 100
# conditions that a comparison traces, and as many of the bank that it predicts
UNSEEN = 16
SURE = 1.0  # standard errors by which unseen conditions have to be better for the model
SPP = 4  # samples a pixel of the paths of a condition (see `problem.LIGHT_DEPTH`)
TOGETHER = 16  # pictures that the model is asked about at once
SOBOL_MOST = 64  # numbers of a condition up to which they are stratified


def stratified(domain: Domain, number: int, seed: int) -> Tensor:
    """The condition with this number: as likely as any other, and as far from the ones
    before as may be.
    """
    if domain.dim > SOBOL_MOST or any(block.norm == "l2" for block in domain.blocks):
        generator = torch.Generator().manual_seed(
            seeds.stream(seed, "bank condition", number)
        )
        return domain.sample(generator)[0]
    point = Draws(domain.dim, "sobol", seed, "bank conditions").points(number, 1)[0]
    return to_domain(domain, torch.from_numpy(point).float())


@dataclass(frozen=True, eq=False)
class Condition:
    """A matrix, and the numbers of the conditions that it was made for; `alone` if base
    colours under it depend on what is searched alone.
    """

    number: int
    numbers: Tensor
    renderer: LinearRenderer
    alone: bool


@dataclass
class Bank(PredictedSearch):
    """The matrices of a run whose searches look at conditions that vary by chance.
    After the comparisons `grown`, by evaluation, the bank went on growing; `gaps` are
    by how much the objective was larger in it than under unseen conditions. `trace`
    makes matrices, by workers where there are some.
    """

    trace: Evaluate
    drawn: bool = field(default=True, kw_only=True)
    renewed: int | None = field(default=None, kw_only=True)
    grown: list[int] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    _held: list[Condition] = field(default_factory=list)
    _places: dict[int, Tensor] = field(default_factory=dict)
    _there: dict[str, Tensor] = field(default_factory=dict)
    _still: LinearRenderer | None = None
    _coming: Iterator[Evaluation] = field(default_factory=lambda: iter(()))
    _until: int = 0
    _bytes: int = 0
    _last: int = 0
    _dropped: int = 0

    @property
    def samples(self) -> int:
        return self._wanted(0) * SPP

    def size(self) -> tuple[int, int]:
        return sum(condition.renderer.entries for condition in self._held), self._bytes

    def conditions(self) -> BankOfConditions:
        gap = self.gaps[-1] if self.gaps else None
        grown = len(self.grown)
        return BankOfConditions(
            made=self._wanted(self._last), dropped=self._dropped, grown=grown, gap=gap
        )

    def prepare(self, tick: Tick = lambda samples: None) -> None:
        self._fill(0, tick)

    def passed(self, query: Query) -> None:
        """Compare where that is due, and have the matrices that there are by then."""
        if query.kind == "search" and query.phase == "search":
            self._last = query.number
            if query.number and query.number % EVERY == 0:
                self._compare(query.u, query.number)
        self._fill(self._last)
        if query.keep:
            self._picture(query.u)  # its noise is the same whenever it is made

    def evaluate(self, query: Query) -> Evaluation:
        self.passed(query)
        evaluation = self._evaluated(
            self._drawn(query.kind, query.number), query.u, query.gradient
        )
        return (
            replace(evaluation, picture=to_8_bit(self._picture(query.u)))
            if query.keep
            else evaluation
        )

    def _evaluated(
        self, chosen: Sequence[Condition], u: Tensor, gradient: WhichGradient
    ) -> Evaluation:
        wholes = [torch.cat([u, condition.numbers]) for condition in chosen]
        evaluation = self.problem.mean_under(
            lambda s, at: self._pictures(chosen[s], at), wholes, u, gradient, TOGETHER
        )
        return replace(evaluation, predicted=1)

    def _drawn(self, kind: str, index: int) -> list[Condition]:
        count = min(self.problem.draws, len(self._held))
        before = self._wanted(index - 1 if kind == "search" else self._last)
        new = [condition for condition in self._held if condition.number >= before][
            :count
        ]
        others = [condition for condition in self._held if condition.number < before]
        return new + self._some(others, count - len(new), f"bank {kind}", index)

    def _some(
        self, conditions: Sequence[Condition], count: int, stream: str, index: int
    ) -> list[Condition]:
        generator = torch.Generator().manual_seed(
            seeds.stream(self.problem.seed, stream, index)
        )
        order = torch.randperm(len(conditions), generator=generator).tolist()
        return [conditions[number] for number in order[:count]]

    def _pictures(self, chosen: Sequence[Condition], u: Tensor) -> Tensor:
        inputs = self.problem.searched_space.inputs(u)
        pictures = []
        for condition in chosen:
            whole = torch.cat([u, condition.numbers])
            made = condition.renderer
            alone = (
                {name: inputs[name] for name in made.there} if condition.alone else None
            )
            pictures.append(made(whole) if alone is None else made.shown(alone, whole))
        return torch.stack(pictures)

    def _picture(self, u: Tensor) -> Tensor:
        if self._still is None:
            seed = seeds.stream(self.problem.seed, "bank still")
            self._still = self.problem.linearised(
                self.problem.whole(self.problem.domain.start), seed, SPP
            )
            self.traced += 1
        with torch.no_grad():
            return self._still(self.problem.whole(u))

    def _wanted(self, index: int) -> int:
        """How many conditions have been collected by the evaluation with this index."""
        index = min(index, self.steps // 2 - 1)
        steps = sum(min(max(index - begin + 1, 0), EVERY) for begin in (0, *self.grown))
        return FIRST * self.problem.draws + steps * self.problem.draws // GROWTH

    def _query(self, number: int) -> Query:
        """Asks for the matrix of a condition: near what was searched when the bank last
        began to grow.
        """
        assert self.problem.conditions is not None
        begun = [begin for begin in self.grown if self._wanted(begin - 1) <= number]
        u = self._places[begun[-1]] if begun else self.problem.domain.start
        numbers = stratified(
            self.problem.conditions, number, seeds.stream(self.problem.seed, "bank")
        )
        seed = seeds.stream(self.problem.seed, "bank matrix", number)
        return Query(torch.cat([u, numbers]), seed, spp=SPP, wanted="light")

    def _fill(self, index: int, tick: Tick = lambda samples: None) -> None:
        """Make the matrices that there should be by an evaluation, newest last, as far
        as memory lasts.
        """
        wanted = self._wanted(index)
        first = self._held[-1].number + 1 if self._held else 0
        if first >= wanted:
            return
        with self.timed():
            if self._until <= first:  # as far as the next comparison
                self._until = self._wanted((index // EVERY + 1) * EVERY - 1)
                self._coming = iter(
                    self.trace(
                        [self._query(number) for number in range(first, self._until)]
                    )
                )
            for number in range(first, wanted):
                asked = self._query(number)
                dim = self.problem.domain.dim
                made = self.problem.linearised(
                    asked.u, asked.seed, SPP, next(self._coming).light
                )
                self.traced += 1
                with torch.no_grad():
                    of_searched = self.problem.searched_space.inputs(asked.u[:dim])
                    alone = True
                for name, there in made.there.items():
                    alone = (
                        alone
                        and name in of_searched
                        and torch.equal(of_searched[name], there)
                    )
                    # one tensor for all alike
                    if name in self._there and torch.equal(self._there[name], there):
                        made.there[name] = self._there[name]
                self._there = dict(made.there)
                self._held.append(Condition(number, asked.u[dim:], made, alone))
                self._bytes += made.bytes
                tick(SPP)
                while len(self._held) > 1 and self._bytes > scaled(MOST_BYTES):
                    self._bytes -= self._held.pop(0).renderer.bytes
                    self._dropped += 1

    def _compare(self, u: Tensor, index: int) -> None:
        """Look at unseen conditions and at the bank's own, and let the bank grow while
        the first are clearly better for the model, or predictions of the second are too
        far off.
        """
        problem = self.problem
        with self.timed():
            noise = seeds.stream(problem.seed, "bank check", index)
            draws = [seeds.stream(noise, "draw", number) for number in range(UNSEEN)]
            unseen = [
                problem.evaluated(Query(u, draw), problem.whole(u, draw), draw)[
                    0
                ].objective
                for draw in draws
            ]
            chosen = self._some(self._held, UNSEEN, "bank check", index)
            wholes = [torch.cat([u, condition.numbers]) for condition in chosen]
            judged, _ = problem.judged(
                partial(self._pictures, chosen), wholes, u, False
            )
            seen = [evaluation.objective for evaluation, _ in judged]
            self.gaps.append(statistics.fmean(seen) - statistics.fmean(unseen))
            self.traced += UNSEEN
            error = math.sqrt(
                sum(statistics.pvariance(some) / len(some) for some in (seen, unseen))
            )

        def view(number: int) -> ComparedView:
            which = number % len(chosen)
            return problem.view(
                chosen[which].renderer,
                wholes[which],
                seeds.stream(noise, "view", number),
                SPP,
            )

        if not self.compare(view).good or self.gaps[-1] > SURE * error:
            self._places[index] = u.detach().clone()
            self.grown.append(index)
