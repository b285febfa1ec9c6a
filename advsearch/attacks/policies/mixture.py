"""The distribution of failures: learnt as a mixture, drawn from, and weighed to tell
how large a share fails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.extend import InputError, Policy, policies

MOST = 50  # more numbers are refused: there would never be enough draws to learn from
WINDOW = 1000
ELITE = 0.1
FEWEST = 10
"""Where fewer draws failed, those with the largest objectives stand in for failures: a
tenth of them, ten at least.
"""

ROUNDS = 8
EVEN = 12**-0.5
PRIOR = 3.0
"""Deviation of the even distribution in shares of a range; it counts for so many draws
of each component, so that what does not matter stays wide.
"""

NARROWEST = 0.02  # deviations of a number, in shares of its range, at least and at most
FLAT = 10.0
TELLING = 0.5
"""A number tells a component apart where its deviation is under so much of the even
one's; an option, where it has more than so much of the probability.
"""


@dataclass(frozen=True, eq=False)
class Ranges:
    """The d elements of u in shares of their ranges: options (d,) of each choice, 0 of
    a number, and which (d,) are angles.
    """

    counts: Tensor
    around: Tensor

    def away(self, x: Tensor, mean: Tensor) -> Tensor:
        """Return how far x is from a mean; of an angle the shorter way, within a
        half.
        """
        plain = x - mean
        return torch.where(self.around, torch.remainder(plain + 0.5, 1.0) - 0.5, plain)

    def ends(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        half = torch.full_like(mean, 0.5)
        return torch.where(self.around, -half, -mean), torch.where(
            self.around, half, 1.0 - mean
        )


@dataclass(frozen=True, eq=False)
class Components:
    """A mixture of k products: normal distributions (k, d) cut to their ranges, in
    shares of these, and probabilities of options (k, d, most options); the weights (k,)
    have the sum 1.
    """

    weights: Tensor
    means: Tensor
    deviations: Tensor
    options: Tensor

    def logs(self, x: Tensor, ranges: Ranges) -> Tensor:
        """Return (n, k) logarithms of weight times density at (n, d) x, relative to the
        even density.
        """
        low, high = (
            torch.special.ndtr(end / self.deviations) for end in ranges.ends(self.means)
        )
        scaled = ranges.away(x[:, None], self.means) / self.deviations
        numbers = -0.5 * scaled.square() - torch.log(
            self.deviations * math.sqrt(2.0 * math.pi) * (high - low)
        )
        chosen = (x * ranges.counts).long().clamp(max=self.options.shape[2] - 1)
        picked = self.options.expand(len(x), *self.options.shape).gather(
            3, chosen[:, None, :, None].expand(-1, len(self.weights), -1, 1)
        )
        each = torch.where(
            ranges.counts > 0,
            torch.log(picked[..., 0] * ranges.counts.clamp(min=1)),
            numbers,
        )
        return self.weights.log() + each.sum(dim=2)

    def draw(self, generator: torch.Generator, ranges: Ranges) -> Tensor:
        k = int(torch.multinomial(self.weights, 1, generator=generator))
        mean = self.means[k]
        deviation = self.deviations[k]
        low, high = (torch.special.ndtr(end / deviation) for end in ranges.ends(mean))
        at = torch.lerp(
            low, high, torch.rand(len(mean), generator=generator, dtype=torch.float64)
        )
        x = mean + deviation * torch.special.ndtri(at)
        x = torch.where(
            ranges.around, torch.remainder(x, 1.0), x.nan_to_num(0.5).clamp(0.0, 1.0)
        )
        option = torch.multinomial(self.options[k], 1, generator=generator)[:, 0]
        return torch.where(
            ranges.counts > 0, (option + 0.5) / ranges.counts.clamp(min=1), x
        )

    def maximised(
        self, x: Tensor, weights: Tensor, ranges: Ranges, even: Tensor
    ) -> Components:
        """Return the components that make the weighted draws (n, d) x likelier, each
        with its prior; `even` is that of options (k, d, most options).
        """
        shared = self.logs(x, ranges).softmax(dim=1) * weights[:, None]
        counts = shared.sum(dim=0)
        portion = (shared / counts.clamp(min=1e-12)).T
        away = ranges.away(x[:, None], self.means)
        shift = torch.einsum("kn,nkd->kd", portion, away)
        spread = torch.einsum("kn,nkd->kd", portion, (away - shift).square())
        own = counts[:, None]
        variance = ((own * spread + PRIOR * EVEN**2) / (own + PRIOR)).clamp(
            max=0.999 * EVEN**2
        )
        # the even one divided out
        deviations = (
            (1.0 / (1.0 / variance - 1.0 / EVEN**2)).sqrt().clamp(NARROWEST, FLAT)
        )
        means = self.means + shift
        tilted = (deviations.square() * (means / variance - 0.5 / EVEN**2)).clamp(
            0.0, 1.0
        )
        means = torch.where(ranges.around, torch.remainder(means, 1.0), tilted)
        chosen = torch.nn.functional.one_hot(
            (x * ranges.counts).long().clamp(max=even.shape[2] - 1), even.shape[2]
        )
        often = torch.einsum("kn,ndo->kdo", portion, chosen.double())
        options = (own[..., None] * often + PRIOR * even) / (own[..., None] + PRIOR)
        share = counts / counts.sum()
        return Components(0.75 * share + 0.25 / len(share), means, deviations, options)


@dataclass(frozen=True, eq=False)
class MixtureState:
    """Where the search stands: the mixtures of the generations in the window (None of
    an even one), this generation's draws (n, d) and the latest `WINDOW` that were
    evaluated (m, d), in shares of each range, and of all draws objective, failed,
    unknown, weight and largest weight; see `failure_share`.
    """

    domain: policies.Domain
    seed: int
    ranges: Ranges
    generation: int
    learnt: tuple[Components | None, ...]
    points: Tensor
    seen: Tensor
    log: Tensor
    told: int = 0

    def configuration(self, x: Tensor) -> Tensor:
        return self.domain.project(
            (self.domain.lower + x * (self.domain.upper - self.domain.lower)).float()
        )

    def telling(self, mixture: Components, k: int) -> dict[int, tuple[float, float]]:
        """Return the ranges that tell a component apart: two deviations to both sides,
        or the likeliest option.
        """
        lower = self.domain.lower.double()
        width = (self.domain.upper - self.domain.lower).double()
        ranges: dict[int, tuple[float, float]] = {}
        for place, count in enumerate(self.ranges.counts.tolist()):
            if count:
                likeliest = int(mixture.options[k, place].argmax())
                ends = (likeliest / count, (likeliest + 1) / count)
                telling = float(mixture.options[k, place, likeliest]) > TELLING
            else:
                mean = float(mixture.means[k, place])
                reach = 2.0 * float(mixture.deviations[k, place])
                ends = (max(0.0, mean - reach), min(1.0, mean + reach))
                across = bool(self.ranges.around[place]) and (
                    mean - reach < 0.0 or mean + reach > 1.0
                )
                telling = reach < 2.0 * TELLING * EVEN and not across
            if telling:
                low, high = (float(lower[place] + end * width[place]) for end in ends)
                ranges[place] = low, high
        return ranges


@dataclass(frozen=True)
class Mixture(Policy[MixtureState]):
    """Cross-entropy method (Rubinstein and Kroese 2004, "The cross-entropy method")
    with a mixture, as in the population Monte Carlo of Cappe, Douc, Guillin, Marin and
    Robert 2008, "Adaptive importance sampling in general mixture classes".

    Each generation is drawn from a mixture of as many products of normal distributions,
    cut to the ranges, and of probabilities of options, with a share that is drawn
    evenly whatever was learnt (Hesterberg 1995, "Weighted average importance sampling
    and defensive mixture distributions"). The first is even. The next is fitted by
    expectation and maximisation to the draws that failed (as long as these are few, to
    those with the largest objectives), weighed by the even density over the mean
    density that they came from (the balance heuristic of Veach and Guibas 1995).

    Its result is a failure for each component, and with the share of all configurations
    that fail: see `failure_share`. That share is of single renders with the search's
    samples. In an l2 ball no share is told.

    Attributes:
        components: of the mixture, 1 to 20.
        even: share of the draws that is even, 0.05 to 1; weights are 1 / even at most.
        population: draws a generation, at least 2.
    """

    components: int = 4
    even: float = 0.2
    population: int = 20

    name: ClassVar[str] = "mixture"
    uses_gradient: ClassVar[bool] = False
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 1 <= self.components <= 20:
            raise InputError(
                "components: expected 1 to 20 parts of a mixture, got "
                f"{self.components}"
            )
        if not 0.05 <= self.even <= 1.0:
            raise InputError(
                "even: expected a number in [0.05, 1], a share of the "
                f"draws, got {self.even}"
            )
        if self.population < 2:
            raise InputError(f"population: expected at least 2, got {self.population}")

    def start(
        self, domain: policies.Domain, generator: torch.Generator, steps: int
    ) -> MixtureState:
        if domain.dim > MOST:
            raise InputError(
                f"policy 'mixture': expected at most {MOST} numbers, got "
                f"{domain.dim}; use pgd or auto"
            )
        ranges = Ranges(domain.options, policies.wraps(domain))
        nothing = torch.empty(0, domain.dim, dtype=torch.float64)
        log = torch.empty(0, 5, dtype=torch.float64)
        state = MixtureState(
            domain, policies.draw_seed(generator), ranges, 0, (), nothing, nothing, log
        )
        return self._drawn(state, None)

    def propose(
        self, state: MixtureState, n: int
    ) -> tuple[tuple[policies.Proposal, ...], MixtureState]:
        return tuple(
            policies.Proposal(state.configuration(x))
            for x in state.points[state.told :][:n]
        ), state

    def update(
        self, state: MixtureState, evaluated: policies.Evaluated
    ) -> MixtureState:
        points = state.points[state.told :][: len(evaluated)]
        current = state.learnt[-1]
        with policies.one_thread():
            weights = (1.0 / self._density(current, points, state.ranges)).tolist()
        bound = 1.0 if current is None else 1.0 / self.even
        rows = [
            (
                evaluation.objective,
                evaluation.success,
                not math.isfinite(evaluation.objective),
                weight,
                bound,
            )
            for (_, evaluation), weight in zip(evaluated, weights, strict=True)
        ]
        log = torch.cat([state.log, torch.tensor(rows, dtype=torch.float64)])
        state = replace(
            state,
            log=log,
            seen=torch.cat([state.seen, points]),
            told=state.told + len(evaluated),
        )
        return (
            state
            if state.told < self.population
            else self._drawn(state, self._fitted(state))
        )

    def failures(self, state: MixtureState) -> policies.Failures:
        """Return a failure for each component that has some, and the share of all that
        fail.
        """
        log = state.log[-len(state.seen) :]
        current = state.learnt[-1]
        failed = log[:, 1].bool() & ~log[:, 2].bool()
        points = state.seen[failed]
        objectives = log[failed, 0]
        listed = []
        nearest = torch.zeros(len(points))
        order = [0] if len(points) else []
        if current is not None and len(points):
            weights = current.weights
            nearest = current.logs(points, state.ranges).argmax(dim=1)
            order = sorted(set(nearest.tolist()), key=lambda k: -float(weights[k]))
        for k in order:
            members = (nearest == k).nonzero().flatten()
            worst = int(members[objectives[members].argmax()])
            ranges = {} if current is None else state.telling(current, k)
            listed.append(
                policies.FoundFailure(
                    state.configuration(points[worst]), float(objectives[worst]), ranges
                )
            )
        whole = all(block.norm != "l2" for block in state.domain.blocks)
        with policies.one_thread():
            share = policies.failure_share(
                state.log[:, 3],
                state.log[:, 4],
                state.log[:, 1] > 0,
                state.log[:, 2] > 0,
            )
        found = int((state.log[:, 1] * (1.0 - state.log[:, 2])).sum())
        return policies.Failures(
            tuple(listed), (), found, len(state.log), None, share if whole else None
        )

    def _drawn(self, state: MixtureState, mixture: Components | None) -> MixtureState:
        """Begin the next generation: its draws come from the mixture, and some of them
        are even.
        """
        number = state.generation + 1
        rng = policies.seeded(state.seed, number)
        counts = state.ranges.counts
        points = torch.rand(
            self.population, len(counts), generator=rng, dtype=torch.float64
        )
        points = torch.where(
            counts > 0, policies.centre_of_option(points, counts.clamp(min=1)), points
        )
        for row in range(self.population):
            if mixture is not None and float(torch.rand(1, generator=rng)) >= self.even:
                points[row] = mixture.draw(rng, state.ranges)
        kept = WINDOW // self.population * self.population or self.population
        learnt = (*state.learnt, mixture)[-(kept // self.population) - 1 :]
        return replace(
            state,
            generation=number,
            points=points,
            learnt=learnt,
            seen=state.seen[-kept:],
            told=0,
        )

    def _density(self, mixture: Components | None, x: Tensor, ranges: Ranges) -> Tensor:
        """Return (n,) density of a generation at (n, d) x, relative to the even one."""
        if mixture is None:
            return torch.ones(len(x), dtype=torch.float64)
        return (
            self.even
            + (1.0 - self.even) * mixture.logs(x, ranges).logsumexp(dim=1).exp()
        )

    def _fitted(self, state: MixtureState) -> Components | None:
        """Return the mixture fitted to the failures in the window; None where nothing
        could be evaluated.
        """
        log = state.log[-len(state.seen) :]
        ranges = state.ranges
        known = ~log[:, 2].bool()
        failed = known & log[:, 1].bool()
        if int(failed.sum()) < FEWEST:
            count = min(int(known.sum()), max(FEWEST, math.ceil(ELITE * len(log))))
            failed[torch.where(known, log[:, 0], -math.inf).topk(count).indices] = True
        x = state.seen[failed]
        objectives = log[failed, 0]
        if not len(x):
            return None
        with policies.one_thread():
            density = torch.stack(
                [self._density(mixture, x, ranges) for mixture in state.learnt]
            ).mean(dim=0)
            weights = 1.0 / density
            # they add up to what they are worth
            weights *= weights.sum() / weights.square().sum()
            picked = policies.most_different(
                x,
                objectives.tolist(),
                ranges.around,
                ranges.counts > 0,
                self.components,
            )
            means = x[picked]
            options = torch.ones(
                len(means),
                len(ranges.counts),
                max(1, int(ranges.counts.max())),
                dtype=torch.float64,
            )
            options *= (
                torch.arange(options.shape[2]) < ranges.counts.clamp(min=1)[:, None]
            )
            even = options / options.sum(dim=2, keepdim=True)
            start = torch.full((len(means),), 1.0 / len(means), dtype=torch.float64)
            mixture = Components(start, means, torch.full_like(means, 0.5 * EVEN), even)
            for _ in range(ROUNDS):
                mixture = mixture.maximised(x, weights, ranges, even)
        return mixture
