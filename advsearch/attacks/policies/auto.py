"""The policy to use first.

It explores the domain evenly, then searches where a surrogate of the objective is
promising, then follows the gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.attacks.evaluation import (
    NO_COUNTS,
    CorrectionCounts,
    Evaluated,
    Policy,
    Proposal,
    WhichGradient,
    draw_seed,
    limit_to_single_thread,
    seeded,
)
from advsearch.attacks.policies.pgd import PGD, Ascent
from advsearch.attacks.policies.surrogate import (
    BoxCoordinates,
    Observations,
    Surrogate,
    find_box_coordinates,
)

# Fraction of the renders that the screen takes. The screen are evenly spread points
# that are evaluated first. "Mixed" domains have norm balls besides box coordinates.
SCREEN_FRACTION = 0.5
SCREEN_FRACTION_MIXED = 0.25
# fraction of the renders after which the gradient ascent begins, if there is one
ASCENT_START = 0.75
ASCENT_START_MIXED = 0.5
LOW_DIM = 10
"""Largest number of box coordinates that is worth the full screen. Evenly spread points
tell less about more coordinates. So, if gradients cost nothing, the screen is shortened
in proportion and the ascent follows at once.
"""

MIN_DERIVATIVES_PER_RENDER = 4
MIN_GRADIENTS = 4
"""In a domain without norm balls, there is a gradient ascent only if a gradient yields
at least `MIN_DERIVATIVES_PER_RENDER` derivatives for each render that it costs, and at
least `MIN_GRADIENTS` gradients fit into the ascent. Gradients by differences are never
worth it: they yield half a derivative for each render, and the surrogate was better on
average.
"""

# Unit step of the ascent in a box, as a fraction of the usual one. It is small, because
# the screen has explored the rest of the box.
ASCENT_REACH = 0.1
EXACT_MOMENTUM = 0.75
RANDOM_CONDITIONS_MOMENTUM = 0.95
"""Momentum of PGD if evaluations have no noise, and if each one draws new conditions.
With noise PGD's default is better.
"""

UCB_KAPPA = 2.0
"""Number of standard deviations of the surrogate that are added to the mean of a
candidate. Without noise 1 is as good. If the noise is as large as all differences, 1
settles too soon on a lucky point.
"""

N_NEAR_CANDIDATES = 256  # number of random moves of the best points
N_FAR_CANDIDATES = 128  # number of uniform points
N_CENTERS = 4  # number of best points that are moved
UNAFFORDABLE_COST = (
    1 << 30
)  # a cost of a gradient that exceeds the renders of any search


@dataclass(frozen=True)
class BudgetPlan:
    """How the renders of a search are divided among its phases.

    The surrogate gets the renders between the screen and the ascent.

    Attributes:
        steps: renders in all.
        screen: renders of the screen.
        ascent_start: renders after which the ascent begins; `steps` if it never does.
        gradient: which gradient the ascent requests.
    """

    steps: int
    screen: int
    ascent_start: int
    gradient: WhichGradient


def make_plan(domain: Domain, box: BoxCoordinates, steps: int) -> BudgetPlan:
    """Divide the renders of a search among its three phases.

    The phases are a screen of evenly spread points, a surrogate (Gaussian process), and
    a gradient ascent. Box coordinates are numbers and choices that do not belong to a
    norm ball. Without them there is only the ascent. With norm balls as well, there
    always is an ascent. With box coordinates alone, there is one only if gradients are
    cheap enough (`MIN_DERIVATIVES_PER_RENDER`).

    Args:
        domain: domain of the search.
        box: box coordinates of the domain.
        steps: renders of the search.
    """
    if box.count == 0:
        return BudgetPlan(steps, screen=0, ascent_start=0, gradient=True)
    has_norm_balls = box.count < domain.dim
    if has_norm_balls:
        return _plan_mixed(domain, steps)
    plan = _plan_box_ascent(box, steps)
    if _is_ascent_worthwhile(domain, box, steps - plan.ascent_start):
        return plan
    # `ascent_start=steps` means that the ascent never begins. Nothing has to be saved
    # for it, so the screen may be longer.
    screen = math.ceil(SCREEN_FRACTION * steps)
    return replace(plan, screen=screen, ascent_start=steps)


def _plan_mixed(domain: Domain, steps: int) -> BudgetPlan:
    """Divide renders in a domain of box coordinates and norm balls."""
    # A "free" gradient leaves out the elements whose derivatives cost renders.
    can_avoid_cost = domain.gradient_cost > 0 and domain.partial_gradients
    return BudgetPlan(
        steps,
        screen=math.ceil(SCREEN_FRACTION_MIXED * steps),
        ascent_start=math.ceil(ASCENT_START_MIXED * steps),
        gradient="free" if can_avoid_cost else True,
    )


def _is_ascent_worthwhile(domain: Domain, box: BoxCoordinates, renders: int) -> bool:
    """Return whether a gradient ascent in box coordinates is worth its renders.

    Args:
        domain: domain of the search.
        box: box coordinates of the domain.
        renders: renders of the ascent.
    """
    n_numbers = _count_numbers(box)  # number of derivatives of a gradient
    cost = domain.gradient_cost
    is_worth_renders = MIN_DERIVATIVES_PER_RENDER * cost <= n_numbers
    # the configuration is rendered as well, which is the 1
    renders_needed = MIN_GRADIENTS * (1 + cost)
    return bool(n_numbers) and is_worth_renders and renders_needed <= renders


def _count_numbers(box: BoxCoordinates) -> int:
    """Return the number of box coordinates that have a derivative: no choices."""
    return int((box.option_counts == 0).sum())


def _plan_box_ascent(box: BoxCoordinates, steps: int) -> BudgetPlan:
    """Divide renders in a domain of box coordinates alone, with an ascent.

    With more than `LOW_DIM` numbers, evenly spread points say little about the
    objective. Then the screen is shorter, and the ascent follows it without a
    surrogate.

    Args:
        box: box coordinates of the domain.
        steps: renders of the search.
    """
    n_numbers = _count_numbers(box)
    shortening = min(1.0, LOW_DIM / max(n_numbers, 1))
    screen = math.ceil(SCREEN_FRACTION * steps * shortening)
    if n_numbers <= LOW_DIM:
        ascent_start = math.ceil(ASCENT_START * steps)
    else:
        ascent_start = screen  # directly after the screen
    return BudgetPlan(steps, screen, ascent_start, gradient=True)


def _make_pgd(domain: Domain) -> PGD:
    """Return the policy of the ascent, with the momentum that suits the noise."""
    if domain.draws_conditions:
        return PGD(momentum=RANDOM_CONDITIONS_MOMENTUM)
    return PGD(momentum=EXACT_MOMENTUM) if domain.is_noise_free else PGD()


@dataclass(frozen=True, eq=False)
class AutoState:
    """State of the search.

    Attributes:
        domain: domain of the search.
        observations: evaluations of the screen and the surrogate. Norm balls are at
            their start in these.
        plan: how the renders are divided.
        seed: seed of random numbers.
        screen: (m, k) box coordinates of the points of the screen. The initial point,
            which is evaluated before them, is not included.
        renders_spent: number of renders of the evaluations so far.
        ascent: state of PGD; None before the ascent.
        is_climbing: whether the latest proposal is one of the ascent.
        latest_objective: objective of the latest evaluation of the ascent.
        box_before_trial: (k,) box coordinates before the latest proposal moved them at
            random; None if it did not.
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
        return self.observations.box

    @property
    def has_norm_balls(self) -> bool:
        """Whether the domain has more than box coordinates."""
        return self.box.count < self.domain.dim

    def to_configuration(self, x: Tensor) -> Tensor:
        """Return the configuration (d,) whose box coordinates are x and whose norm
        balls are at their start.
        """
        return self.domain.project(
            self.box.to_configuration(self.domain.initial_point, x)
        )


@dataclass(frozen=True)
class Auto(Policy[AutoState]):
    """What to use first; it has no options.

    - Only norm balls (a texture): `PGD`, bit for bit; with more momentum if evaluations
      have no noise.
    - Only box coordinates (poses, cameras, lights, choices): the start and scrambled
      Sobol points take half of the renders. Then a Gaussian process is fitted to all
      evaluations. The next point is the candidate with the largest mean plus
      `UCB_KAPPA` standard deviations (GP-UCB, Srinivas et al. 2010). Candidates are
      random moves of the best points, uniform points, and the best point itself, which
      may be rendered again. The process models the noise, so that a lucky value is not
      taken for a peak. If gradients cost no renders (adjoints), `PGD` with small steps
      takes the last quarter. With more than `LOW_DIM` coordinates it begins right after
      a shorter screen.
    - Both: screen and surrogate over the box coordinates, with the balls at their
      start, take half of the renders. `PGD` over everything takes the rest. If the
      gradient of the box coordinates costs renders and can be left out
      (`Domain.partial_gradients`), PGD follows the free gradient, and every second
      evaluation tries a random move of the box coordinates. The move is taken back if
      the objective falls.
    """

    name: ClassVar[str] = "auto"
    uses_gradient: ClassVar[bool] = True
    handles_choices: ClassVar[bool] = True

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> AutoState:
        """Divide the renders among the phases, and start the first one.

        That is the screen: evenly spread points of the box coordinates. These are the
        numbers and choices that do not belong to a norm ball. Without box coordinates
        the first phase is the gradient ascent.

        Args:
            domain: domain of the search.
            generator: source of the seed.
            steps: renders of the search.
        """
        box = find_box_coordinates(domain)
        no_points = torch.empty(0, box.count)
        plan = make_plan(domain, box, steps)
        observations = Observations(box, no_points)
        state = AutoState(domain, observations, plan, seed=0, screen=no_points)
        if box.count == 0:
            # the ascent draws a seed of its own
            ascent = _make_pgd(domain).start(domain, generator, steps)
            return replace(state, ascent=ascent)
        seed = draw_seed(generator)
        with limit_to_single_thread():
            # one render less: that of the initial point, which comes first
            screen = box.sample_screen(seed, max(0, plan.screen - 1))
        return replace(state, seed=seed, screen=screen)

    def propose(
        self, state: AutoState, n: int
    ) -> tuple[tuple[Proposal, ...], AutoState]:
        """Propose what the current phase has next: screen, surrogate or ascent.

        If the ascent has nothing more to propose, the search ends in a domain with norm
        balls. In box coordinates alone the surrogate continues.

        Args:
            state: state of the search.
            n: largest number of proposals.
        """
        state = replace(state, is_climbing=False, box_before_trial=None)
        if state.ascent is None and state.renders_spent >= state.plan.ascent_start:
            with limit_to_single_thread():
                state = self._begin_ascent(state)
        if state.ascent is not None:
            # This domain only tells whether evaluations have noise. The ascent has its
            # own domain, with shorter steps, in its state.
            steps, ascent = _make_pgd(state.domain).propose(state.ascent, n)
            if steps:
                (proposal,) = steps
                return self._propose_ascent_step(state, proposal, ascent.n_evaluations)
            if state.has_norm_balls:
                return (), state
        return self._propose_box_points(state, n)

    def _propose_box_points(
        self, state: AutoState, n: int
    ) -> tuple[tuple[Proposal, ...], AutoState]:
        """Propose at most n points of the screen; after it, one of the surrogate."""
        points = self._list_screen(state, n)
        is_screen_complete = not points
        if is_screen_complete:
            with limit_to_single_thread():
                x, state = self._choose_next_point(state)
            points = [state.to_configuration(x)]
        return tuple(map(Proposal, points)), state

    @staticmethod
    def _list_screen(state: AutoState, n: int) -> list[Tensor]:
        """Return the next configurations (d,) of the screen, at most n.

        They are the initial point, then the points of the screen; an empty list if all
        of them were evaluated.
        """
        n_observed = len(state.observations.values)
        points = []
        if n_observed == 0:
            points.append(state.domain.initial_point)
        # All earlier proposals are evaluated. The initial point was the first of them,
        # and is not one of `state.screen`.
        n_screened = max(0, n_observed - 1)
        next_points = state.screen[n_screened:]
        n_requested = n - len(points)
        points += map(state.to_configuration, next_points[:n_requested])
        return points

    def _propose_ascent_step(
        self, state: AutoState, proposal: Proposal, count: int
    ) -> tuple[tuple[Proposal, ...], AutoState]:
        """Propose a step of the ascent, with the gradient of the plan.

        The plan may request a "free" gradient, that of the norm balls only. Then every
        second step also moves the box coordinates at random. `_update_ascent` takes the
        move back if the objective falls.

        Args:
            state: state of the search.
            proposal: proposal of projected gradient ascent (PGD).
            count: number of evaluations of the ascent so far.
        """
        proposal = replace(proposal, gradient=state.plan.gradient)
        state = replace(state, is_climbing=True)
        has_full_gradient = proposal.gradient is True  # not "free"
        moves_box = not has_full_gradient and count % 2 == 1  # every second step
        if not moves_box:
            return (proposal,), state
        x = state.box.from_configuration(proposal.u)
        u = self._move_box(state, proposal.u, x, count)
        return (replace(proposal, u=u),), replace(state, box_before_trial=x)

    @staticmethod
    def _move_box(state: AutoState, u: Tensor, x: Tensor, count: int) -> Tensor:
        """Return a configuration u (d,) with its box coordinates x (k,) moved at random.

        `count`, the number of evaluations of the ascent so far, gives each move its own
        random numbers.
        """
        # The surrogate draws with numbers below `plan.steps`, so that this one is new.
        rng = seeded(state.seed, state.plan.steps + count)
        moved_x = state.box.sample_moves(x[None], rng)[0]
        return state.domain.project(state.box.to_configuration(u, moved_x))

    def update(self, state: AutoState, evaluated: Evaluated) -> AutoState:
        """Pass evaluations to the ascent, or add them to the observations."""
        cost = sum(evaluation.cost for _, evaluation in evaluated)
        state = replace(state, renders_spent=state.renders_spent + cost)
        if state.is_climbing and state.ascent is not None:
            return self._update_ascent(state, state.ascent, evaluated)
        return replace(state, observations=state.observations.extend(evaluated))

    @staticmethod
    def _update_ascent(
        state: AutoState, ascent: Ascent, evaluated: Evaluated
    ) -> AutoState:
        """Pass the evaluation of a step to the ascent.

        If the step also moved the box coordinates at random, and the objective fell
        since the evaluation before, that move is taken back. Norm balls keep their
        step. The next step is compared with this evaluation, even if its move was taken
        back.
        """
        ((_, evaluation),) = evaluated  # an ascent proposes one at a time
        # After this, `ascent.u` is the configuration of the next step.
        ascent = _make_pgd(state.domain).update(ascent, evaluated)
        has_fallen = evaluation.objective < state.latest_objective
        if state.box_before_trial is not None and has_fallen:
            restored_u = state.box.to_configuration(ascent.u, state.box_before_trial)
            counts = ascent.counts + CorrectionCounts(rejected=1)
            u = state.domain.project(restored_u)
            ascent = replace(ascent, u=u, counts=counts)
        return replace(state, ascent=ascent, latest_objective=evaluation.objective)

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        """See `Policy.takes_differences`: only an ascent with full gradients does."""
        plan = make_plan(domain, find_box_coordinates(domain), steps)
        has_ascent = plan.ascent_start < steps
        has_full_gradient = plan.gradient is True
        return domain.gradient_cost > 0 and has_ascent and has_full_gradient

    def counts(self, state: AutoState) -> CorrectionCounts:
        return NO_COUNTS if state.ascent is None else state.ascent.counts

    def _choose_next_point(self, state: AutoState) -> tuple[Tensor, AutoState]:
        """Return the point (k,) of the unit box [0, 1]^k to evaluate next.

        It is the candidate with the largest upper confidence bound, mean + `UCB_KAPPA`
        standard deviations of the surrogate. As long as no objective is finite, it is a
        random point.
        """
        box = state.box
        # The number of evaluations gives every point new random numbers.
        generator = seeded(state.seed, len(state.observations.values))
        if not state.observations.has_finite:
            random_point = torch.rand(box.count, generator=generator)
            # `normalize` moves discrete choices to the centers of their options
            return box.normalize(random_point), state
        surrogate, observations = state.observations.fit_surrogate()
        candidates = _sample_candidates(surrogate, generator)
        mean, std = surrogate.predict(candidates)
        upper_bound = mean + UCB_KAPPA * std
        best_candidate = candidates[int(upper_bound.argmax())]
        return best_candidate, replace(state, observations=observations)

    def _begin_ascent(self, state: AutoState) -> AutoState:
        """Start gradient ascent (PGD) at the best point that was observed.

        The best is the point with the largest mean of the surrogate, as single
        objectives are noisy. It is the initial point if no objective is finite. Norm
        balls begin at their start. In box coordinates, steps are smaller than usual
        (`ASCENT_REACH`), because the screen has explored the rest of the box already.
        """
        x, state = self._find_best_point(state)
        domain = _shorten_box_steps(state.domain)
        renders_left = max(1, state.plan.steps - state.renders_spent)
        ascent = _make_pgd(domain).start(domain, seeded(state.seed, 0), renders_left)
        # PGD starts at the initial point of the domain, so it is moved to the best
        # point. `to_configuration` puts norm balls at their start.
        return replace(state, ascent=replace(ascent, u=state.to_configuration(x)))

    @staticmethod
    def _find_best_point(state: AutoState) -> tuple[Tensor, AutoState]:
        """Return the box coordinates (k,) of the best point that was observed.

        That is the one with the largest mean of the surrogate, or the initial point if
        no objective is finite. The state has the surrogate's observations.
        """
        if not state.observations.has_finite:
            return state.box.from_configuration(state.domain.initial_point), state
        surrogate, observations = state.observations.fit_surrogate()
        observed_points = surrogate.x  # those to which it was fitted
        mean, _ = surrogate.predict(observed_points)
        best_point = observed_points[int(mean.argmax())]
        return best_point, replace(state, observations=observations)


def _shorten_box_steps(domain: Domain) -> Domain:
    """Return the domain with unit steps of boxes that are shorter than usual
    (`ASCENT_REACH`).
    """
    blocks = []
    for block in domain.blocks:
        # the reach of a box is its unit step; a norm ball has none
        reach = ASCENT_REACH * block.radius if block.norm == "box" else None
        blocks.append(replace(block, unit_step_length=reach))
    return replace(domain, blocks=tuple(blocks))


def _sample_candidates(surrogate: Surrogate, generator: torch.Generator) -> Tensor:
    """Return points (n, k) of the box to choose the next one from.

    They are the best known point, by the surrogate's mean; random moves of it; as many
    random moves of the `N_CENTERS` best known points; and uniform points.

    Args:
        surrogate: process fitted to the known points.
        generator: generator of random numbers; it advances.
    """
    box = surrogate.box
    known_mean, _ = surrogate.predict(surrogate.x)
    ranked_points = surrogate.x[known_mean.argsort(descending=True, stable=True)]
    n_centers = min(N_CENTERS, len(ranked_points))
    # for each move, the rank of the point that is moved: 0, the best, in the first half
    center_rank = torch.randint(0, n_centers, (N_NEAR_CANDIDATES,), generator=generator)
    center_rank[: N_NEAR_CANDIDATES // 2] = 0
    near_candidates = box.sample_moves(ranked_points[center_rank], generator)
    far_candidates = box.normalize(
        torch.rand(N_FAR_CANDIDATES, box.count, generator=generator)
    )
    return torch.cat([ranked_points[:1], near_candidates, far_candidates])


@dataclass(frozen=True)
class WithoutAscent(Auto):
    """`Auto` without its gradient ascent, for a model that has no gradient: screen and
    surrogate over box coordinates.
    """

    uses_gradient: ClassVar[bool] = False

    def start(
        self, domain: Domain, generator: torch.Generator, steps: int
    ) -> AutoState:
        """Start like `Auto`, with gradients that cost more than all renders.

        So its plan has no ascent.
        """
        return super().start(
            replace(domain, gradient_cost=UNAFFORDABLE_COST), generator, steps
        )

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        return False
