"""The policy to use first (it looks everywhere, then where a model of what it has seen
promises most, then uphill), and what wraps others: several policies on one budget, or
several starts of one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.evaluation import (
    NO_COUNTS,
    Counts,
    Evaluated,
    Policy,
    Proposal,
    WhichGradient,
    draw_seed,
    limit_to_single_thread,
    seeded,
)
from advsearch.attacks.policies.choices import (
    Race,
    RacingPolicy,
    start_race,
    wrap_choices,
)
from advsearch.attacks.policies.evolution import CMAES
from advsearch.attacks.policies.pgd import PGD, Ascent
from advsearch.attacks.policies.surrogate import (
    BoxCoordinates,
    Observations,
    find_box_coordinates,
)
from advsearch.errors import InputError

# share of the renders that the screen takes, in a box alone and beside a norm ball
SCREEN_FRACTION = 0.5
SCREEN_FRACTION_MIXED = 0.25
ASCENT_START = (
    0.75  # share of the renders after which an ascent takes over, if there is one
)
ASCENT_START_MIXED = 0.5
LOW_DIM = 10
"""Up to so many box coordinates are worth the whole screen. Of more it sees less and
less, so if gradients cost nothing its share shrinks in proportion and the ascent
follows at once.
"""

MIN_DERIVATIVES_PER_RENDER = 4
"""Beside no norm ball, a gradient is worth its renders if it brings so many numbers for
each, and so many gradients fit into the ascent. One by differences never is: half a
number for each, and the surrogate was better on average.
"""

# the ascent's whole step in a box, as a share of half the diagonal: the screen has been
# everywhere else
ASCENT_REACH = 0.1
EXACT_MOMENTUM = 0.75
RANDOM_CONDITIONS_MOMENTUM = 0.95
"""Weight of past gradients where none has noise and all point the same way, and where
each sees other conditions; with noise PGD's own is better.
"""

UCB_KAPPA = 2.0
"""How many standard deviations of the surrogate a candidate gets on top of its mean.
One does as well without noise; with a noise as large as all differences it settles too
soon on a lucky point.
"""

# candidates near the best points, candidates anywhere, and the number of best points
N_NEAR_CANDIDATES = 256
N_FAR_CANDIDATES = 128
N_CENTERS = 4
UNAFFORDABLE_COST = 1 << 30  # renders of a gradient that no search can pay


@dataclass(frozen=True)
class BudgetPlan:
    """What the renders are for: the screen; the ascent, which asks for `gradient`,
    begins after `ascent_start`, or never at `steps`.
    """

    steps: int
    screen: int
    ascent_start: int
    gradient: WhichGradient


def make_plan(domain: Domain, box: BoxCoordinates, steps: int) -> BudgetPlan:
    if box.count == 0:
        return BudgetPlan(steps, 0, 0, True)
    if box.count < domain.dim:
        screen = math.ceil(SCREEN_FRACTION_MIXED * steps)
        until = math.ceil(ASCENT_START_MIXED * steps)
        return BudgetPlan(
            steps,
            screen,
            until,
            "free" if domain.gradient_cost and domain.partial_gradients else True,
        )
    n_continuous = int((box.options == 0).sum())
    screen = math.ceil(
        SCREEN_FRACTION * steps * min(1.0, LOW_DIM / max(n_continuous, 1))
    )
    until = math.ceil(ASCENT_START * steps) if n_continuous <= LOW_DIM else screen
    cost = domain.gradient_cost
    if (
        n_continuous
        and MIN_DERIVATIVES_PER_RENDER * cost <= n_continuous
        and MIN_DERIVATIVES_PER_RENDER * (1 + cost) <= steps - until
    ):
        return BudgetPlan(steps, screen, until, True)
    return BudgetPlan(steps, math.ceil(SCREEN_FRACTION * steps), steps, True)


def _pgd(domain: Domain) -> PGD:
    if domain.draws_conditions:
        return PGD(momentum=RANDOM_CONDITIONS_MOMENTUM)
    return PGD(momentum=EXACT_MOMENTUM) if domain.exact else PGD()


@dataclass(frozen=True, eq=False)
class AutoState:
    """Where the search stands: where the screened box coordinates have been, with norm
    balls at their start, where the screen (m, k) looks next, the renders spent, and,
    once it has begun, the ascent of PGD, its latest objective and where the box
    coordinates stood before the latest proposal moved them at random, if it did
    (`box_before_trial`).
    """

    domain: Domain
    observations: Observations
    plan: BudgetPlan
    seed: int
    screen: Tensor
    renders_spent: int = 0
    ascent: Ascent | None = None
    is_climbing: bool = False
    latest_objective: float = -math.inf
    box_before_trial: Tensor | None = None

    @property
    def box(self) -> BoxCoordinates:
        return self.observations.space

    def to_configuration(self, x: Tensor) -> Tensor:
        """Return the configuration (d,) whose box coordinates are x and whose norm
        balls are at their start.
        """
        return self.domain.project(self.box.to_configuration(self.domain.begin, x))


@dataclass(frozen=True)
class Auto(Policy[AutoState]):
    """What to use first; it has no options.

    - Norm balls alone (a texture): `PGD`, bit for bit; with more momentum where
    evaluations have no noise.
    - Box coordinates alone (poses, cameras, lights, choices): the start and scrambled
      Sobol points take half of the renders. Then a Gaussian process is fitted to all
      that was seen, and the next point is the candidate with the largest mean plus
      `UCB_KAPPA` standard deviations (GP-UCB, Srinivas et al. 2010), among moves of the
      best points, points anywhere, and the best point itself. The process models the
      noise, so a lucky value does not pass for a peak, and rendering the best point
      again is one of its choices. Where gradients cost no renders (adjoints), `PGD`
      with small steps takes the last quarter; with more than `LOW_DIM` coordinates it
      begins right after a shorter screen.
    - Both: screen and surrogate over the box coordinates, with the balls at their
      start, take half of the renders and `PGD` over everything the rest. If the box
      coordinates' gradient costs renders and can be left out
      (`Domain.partial_gradients`), PGD follows what is free, and every second
      evaluation tries a random move of the box coordinates, which is taken back if the
      objective falls.
    """

    name: ClassVar[str] = "auto"
    uses_gradient: ClassVar[bool] = True
    handles_choices: ClassVar[bool] = True

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> AutoState:
        box = find_box_coordinates(domain)
        no_points = torch.empty(0, box.count)
        plan = make_plan(domain, box, steps)
        observations = Observations(box, no_points)
        if box.count == 0:
            return AutoState(
                domain,
                observations,
                plan,
                0,
                no_points,
                ascent=_pgd(domain).start(domain, generator, steps),
            )
        seed = draw_seed(generator)
        with limit_to_single_thread():
            screen = box.sample_screen(seed, max(0, plan.screen - 1))
        return AutoState(domain, observations, plan, seed, screen)

    def propose(
        self, state: AutoState, n: int
    ) -> tuple[tuple[Proposal, ...], AutoState]:
        state = replace(state, is_climbing=False, box_before_trial=None)
        if state.ascent is None and state.renders_spent >= state.plan.ascent_start:
            with limit_to_single_thread():
                state = self._begin_ascent(state)
        if state.ascent is not None:
            steps, ascent = _pgd(state.domain).propose(state.ascent, n)
            if steps:
                (proposal,) = steps
                proposal = replace(proposal, gradient=state.plan.gradient)
                state = replace(state, is_climbing=True)
                if proposal.gradient is True or ascent.count % 2 == 0:
                    return (proposal,), state
                # only the balls have a gradient, so every second one moves in the box
                # too
                box = state.box
                x = state.box.from_configuration(proposal.u)
                moved = box.sample_moves(
                    x[None], seeded(state.seed, state.plan.steps + ascent.count)
                )[0]
                u = state.domain.project(box.to_configuration(proposal.u, moved))
                return (replace(proposal, u=u),), replace(state, box_before_trial=x)
            if state.box.count < state.domain.dim:
                return (), state
        done = len(state.observations.values)
        us = [] if done else [state.domain.begin]
        us += map(
            state.to_configuration, state.screen[max(0, done - 1) :][: n - len(us)]
        )
        if not us:
            with limit_to_single_thread():
                x, state = self._next_point(state)
            us = [state.to_configuration(x)]
        return tuple(map(Proposal, us)), state

    def update(self, state: AutoState, evaluated: Evaluated) -> AutoState:
        state = replace(
            state,
            renders_spent=state.renders_spent
            + sum(evaluation.cost for _, evaluation in evaluated),
        )
        if state.is_climbing and state.ascent is not None:
            ((_, evaluation),) = evaluated
            ascent = _pgd(state.domain).update(state.ascent, evaluated)
            if (
                state.box_before_trial is not None
                and evaluation.objective < state.latest_objective
            ):
                u = state.domain.project(
                    state.box.to_configuration(ascent.u, state.box_before_trial)
                )
                ascent = replace(ascent, u=u, counts=ascent.counts + Counts(rejected=1))
            return replace(state, ascent=ascent, latest_objective=evaluation.objective)
        return replace(state, observations=state.observations.extend(evaluated))

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        plan = make_plan(domain, find_box_coordinates(domain), steps)
        return (
            domain.gradient_cost > 0
            and plan.ascent_start < steps
            and plan.gradient is True
        )

    def counts(self, state: AutoState) -> Counts:
        return NO_COUNTS if state.ascent is None else state.ascent.counts

    def _next_point(self, state: AutoState) -> tuple[Tensor, AutoState]:
        box = state.box
        generator = seeded(state.seed, len(state.observations.values))
        if not state.observations.has_finite:
            return box.normalize(torch.rand(box.count, generator=generator)), state
        surrogate, observations = state.observations.fit_surrogate()
        best_points = surrogate.x[
            surrogate.predict(surrogate.x)[0].argsort(descending=True, stable=True)
        ]
        centres = torch.randint(
            0,
            min(N_CENTERS, len(best_points)),
            (N_NEAR_CANDIDATES,),
            generator=generator,
        )
        centres[: N_NEAR_CANDIDATES // 2] = 0
        near_candidates = box.sample_moves(best_points[centres], generator)
        far_candidates = box.normalize(
            torch.rand(N_FAR_CANDIDATES, box.count, generator=generator)
        )
        candidates = torch.cat([best_points[:1], near_candidates, far_candidates])
        mean, deviation = surrogate.predict(candidates)
        return candidates[int((mean + UCB_KAPPA * deviation).argmax())], replace(
            state, observations=observations
        )

    def _begin_ascent(self, state: AutoState) -> AutoState:
        """Let PGD go on from the best of the points seen so far, with small steps in
        the box.
        """
        x = state.box.from_configuration(state.domain.begin)
        blocks = state.domain.blocks
        if state.observations.has_finite:
            surrogate, observations = state.observations.fit_surrogate()
            state = replace(state, observations=observations)
            x = surrogate.x[int(surrogate.predict(surrogate.x)[0].argmax())]
        ascent_blocks = (
            replace(
                block,
                reach=ASCENT_REACH * block.radius if block.norm == "box" else None,
            )
            for block in blocks
        )
        domain = replace(state.domain, blocks=tuple(ascent_blocks))
        ascent = _pgd(domain).start(
            domain,
            seeded(state.seed, 0),
            max(1, state.plan.steps - state.renders_spent),
        )
        return replace(state, ascent=replace(ascent, u=state.to_configuration(x)))


@dataclass(frozen=True)
class WithoutAscent(Auto):
    """Screen and surrogate of `Auto` alone, over box coordinates, for a model that has
    no gradient.
    """

    uses_gradient: ClassVar[bool] = False

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> AutoState:
        return super().start(
            replace(domain, gradient_cost=UNAFFORDABLE_COST), generator, steps
        )

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        return False


@dataclass(frozen=True)
class Restarts(RacingPolicy[Race]):
    """Lets a policy search `times` times, each with an equal share of the renders; they
    take turns, step by step.

    The first begins where the policy would begin by itself, the others at samples of
    the domain (`Domain.sample`); the norm balls stay where they are. One that has
    nothing more to propose leaves its renders to the rest. For an objective with
    several peaks, where a gradient finds the nearest. Discrete choices are fixed
    outside (`Choices`), so every combination of options has its own restarts.

    Attributes:
        policy: what searches; in `make_policy` a name, or a mapping with a name and
            options.
        times: at least 1; fewer if the renders do not suffice for one evaluation each.
    """

    policy: Policy[Any] = field(default_factory=PGD)
    times: int = 4

    name: ClassVar[str] = "restarts"

    def __post_init__(self) -> None:
        if not isinstance(self.policy, Policy):
            raise InputError(
                "policy of restarts: expected a policy, got "
                f"{self.policy!r}; use make_policy for names"
            )
        if self.times < 1:
            raise InputError(f"times: expected at least 1, got {self.times}")

    @property
    def uses_gradient(self) -> bool:
        return self.policy.uses_gradient

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Race:
        seed = draw_seed(generator)
        each = 1 + (domain.gradient_cost if self.policy.uses_gradient else 0)
        count = max(1, min(self.times, steps // each))
        begins = (
            domain.begin,
            *(domain.sample(seeded(seed, number))[0] for number in range(1, count)),
        )
        return start_race(
            [(self.policy, replace(domain, first=begin)) for begin in begins],
            steps,
            seed,
            rounds=1,
        )


@dataclass(frozen=True)
class Portfolio(RacingPolicy[Race]):
    """Lets several policies search side by side and goes on with those that reached
    more.

    With n policies there are 1 + ceil(log2 n) rounds of equally many renders, see
    `choices`. Within a round every policy that is still in has an equal share; after it
    the better half goes on, by the largest objective so far. So of two policies each
    has a quarter of the renders, and the better one the other half.

    A policy that cannot search the domain (it says so with an InputError: a grid over a
    texture) is left out; if none can, the first one's error is passed on.

    Attributes:
        policies: at least one; in `make_policy` a list of names, or of mappings with a
            name and options.
    """

    policies: tuple[Policy[Any], ...] = (Auto(), CMAES())

    name: ClassVar[str] = "portfolio"
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "policies", tuple(self.policies))
        if not self.policies or not all(
            isinstance(policy, Policy) for policy in self.policies
        ):
            raise InputError(
                "policies of portfolio: expected one policy or more, got "
                f"{self.policies!r}"
            )

    @property
    def uses_gradient(self) -> bool:
        return any(policy.uses_gradient for policy in self.policies)

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        return any(policy.takes_differences(domain, steps) for policy in self.policies)

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Race:
        seed = draw_seed(generator)
        searches = []
        errors = []
        for policy in self.policies:
            wrapped = wrap_choices(policy, domain)
            try:
                wrapped.start(
                    domain, seeded(seed, 0), max(1, steps // len(self.policies))
                )
            except InputError as error:
                errors.append(error)
            else:
                searches.append((wrapped, domain))
        if not searches:
            raise errors[0]
        return start_race(searches, steps, seed)
