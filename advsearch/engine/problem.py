"""What a search works on: scene, space, model, task and objective, joined into the
calls that `attacks` asks for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Domain, Evaluation, Objective
from advsearch.attacks.evaluation import Query, WhichGradient
from advsearch.attacks.verification import EASIER, OVER_CONDITIONS, WORST_CASE, Rule
from advsearch.controls import Space
from advsearch.engine.acceptance import ComparedView, view_of
from advsearch.engine.judging import (
    ConfigurationInputs,
    Described,
    Looked,
    Metrics,
    domain_of,
    judgements,
    mean_metrics,
    with_things,
)
from advsearch.engine.rendering import looks_at, things_seen
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.options import Value
from advsearch.runs.results import GroupDerivative, PlannedGradient
from advsearch.scene.color import to_8_bit
from advsearch.scene.description import NO_MAP
from advsearch.scene.gradients import GradientPlan
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.lights import why_not
from advsearch.scene.transport.matrix import Linearised, LinearRenderer, linear_inputs
from advsearch.tasks import Facts, Judgement, Mark, Task
from advsearch.tasks.base import Output, Truth, mean, typical


class Prepared(NamedTuple):
    """What is measured before a search; the longest light path is in segments, None for
    the scene's.
    """

    spp: int
    search_depth: int | None
    plan: GradientPlan


LIGHT_DEPTH = 4
"""Segments of the longest path of light that is collected under one of many conditions:
many with some noise and without the last light teach more than few that are right.
"""

MOST_NUMBERS = 64
MOST = 512
"""Numbers, beside base colours, of a configuration whose truth is remembered; and
truths that are.
"""


def _keep(kept: dict[bytes, Any], key: bytes, value: Any) -> None:
    while len(kept) >= MOST:  # the oldest ones make room
        del kept[next(iter(kept))]
    kept[key] = value


BY_CHANCE = "forced: it varies by chance, so nobody asks for its derivative"


@dataclass
class Problem:
    """The joint of rendering, model and search."""

    renderer: Renderer  # `render(u, seed, spp)` of the whole space
    # the controls behind the whole of u: those that are searched, then those that vary
    # by chance
    space: Space
    model: Model
    task: Task  # judges the model's output; says what counts as success
    # what it judges by, from what describes and what sees a configuration
    facts: Callable[[Described, Looked], Facts]
    objective: Objective | None  # what is maximised; None of a sweep
    spp: int  # samples a pixel while searching
    seed: int
    # how many of the controls are searched, None for all; the others are the
    # conditions, which are drawn anew from their whole range for every picture
    searched: int | None = None
    steps: int = 0  # renders of a search
    # conditions that one evaluation looks at, where there are any; the objective is
    # their mean
    draws: int = 1
    # longest light path in segments of a search's renders; None for the scene's
    search_depth: int | None = None
    # layers of ground truth that are kept of clean and adversarial scene
    # (`formation.AOVS`)
    aovs: tuple[str, ...] = ()
    # numbers of every picture beside what the task says
    metrics: Metrics = field(default_factory=dict)
    domain: Domain = field(init=False)  # where a search may look: the searched controls
    # where the others are drawn from; None where there are none
    conditions: Domain | None = field(init=False)

    def __post_init__(self) -> None:
        self.plan = self.renderer.plan
        self._truths: dict[bytes, Truth] = {}
        self._things: dict[bytes, JsonObject | None] = {}

    @property
    def plan(self) -> GradientPlan:
        return self.renderer.plan

    @plan.setter
    def plan(self, plan: GradientPlan) -> None:
        """Take a plan: nothing is computed for the conditions, and the domain's cost
        follows.
        """
        count = len(self.space.controls) if self.searched is None else self.searched
        searched = self.space.controls[:count]
        by_chance = self.space.controls[count:]
        names = {control.name for control in by_chance}
        none = {group.name: "none" for group in plan.groups if group.control in names}
        self.renderer.plan = plan.with_estimator(none, BY_CHANCE)
        self.domain = domain_of(
            searched, gradient_cost=self.renderer.plan.renders, partial_gradients=True
        )
        self.conditions = domain_of(by_chance) if by_chance else None

    @property
    def prepared(self) -> Prepared:
        return Prepared(self.spp, self.search_depth, self.plan)

    @cached_property
    def searched_space(self) -> Space:
        """The controls that are searched, as a space of their own: it describes and
        keeps what was found.
        """
        return replace(self.space, controls=self.space.controls[: self.searched])

    @property
    def environment(self) -> str:
        scene = self.space.scene
        return self.space.environment or (
            NO_MAP if scene is None else scene.environment_name
        )

    @property
    def is_linear(self) -> bool:
        """Whether matrices of light transport tell the images of what is searched
        (`linearised`).
        """
        by_chance = self.space.controls[self.searched :]
        return why_not(self.renderer, [control.name for control in by_chance]) is None

    @property
    def rule(self) -> Rule:
        if self.task.minimise:
            return EASIER
        return WORST_CASE if self.conditions is None else OVER_CONDITIONS

    # ---- pictures
    # ---------------------------------------------------------------------------------------------------

    def whole(self, u: Tensor, draw: int | None = None) -> Tensor:
        """Return the configuration of the whole space: u, and the conditions of one
        draw, by its seed; without, those that leave the scene as it is.
        """
        if self.conditions is None:
            return u
        if draw is None:
            return torch.cat([u, self.conditions.start])
        generator = torch.Generator().manual_seed(seeds.stream(draw, "conditions"))
        return torch.cat([u, self.conditions.sample(generator)[0]])

    def picture(self, u: Tensor, seed: int, spp: int, *, drawn: bool = True) -> Tensor:
        """Render a configuration as a file would hold it: (H, W, 3) sRGB in [0, 1],
        rounded to 8 bits. The seed is that of the noise and, if they are `drawn`, of
        the conditions; otherwise the scene has those it comes with.
        """
        with torch.no_grad():
            return to_8_bit(
                self.renderer(
                    self.whole(u, seed if drawn else None), seed=seed, spp=spp
                )
            )

    def judge(self, picture: Tensor, whole: Tensor) -> Judgement:
        """Return what task and objective say of the model's output for a picture (H, W,
        3), of the whole space at `whole`.
        """
        if self.objective is None:
            return self.judge_several(picture[None], [whole], [{}])[0]
        with torch.no_grad():
            output = self.model(picture)
            truth = self.truth(whole)
            objective = float(
                self.objective(output, picture[None], truth, self.asked(whole))[0]
            )
            (said,) = self._judged(output, picture[None], [truth], [whole])
            return replace(said, objective=objective)

    def judge_several(
        self,
        pictures: Tensor,
        wholes: Sequence[Tensor],
        listed: Sequence[Mapping[str, Value]],
    ) -> list[Judgement]:
        """Return what the task says of pictures (N, H, W, 3) that the model sees at
        once, without an objective; values of each configuration as they were `listed`,
        as for `truth`. A margin that is not finite becomes NaN.
        """
        with torch.no_grad():
            output = self.model(pictures)
            truths = (
                [self.truth()]
                if not self.task.varies
                else list(map(self.truth, wholes, listed))
            )
            judged = self._judged(output, pictures, truths, wholes)
        plain = [
            Judgement.of(each.score, each.margin, each.prediction, each.payload)
            for each in judged
        ]
        return [
            replace(judgement, metrics=each.metrics)
            for judgement, each in zip(plain, judged, strict=True)
        ]

    def _judged(
        self,
        output: Output,
        pictures: Tensor,
        truths: Sequence[Truth],
        wholes: Sequence[Tensor],
    ) -> list[Judgement]:
        """What task and metrics say of pictures (N, H, W, 3), and what these show of
        each thing.
        """
        judged = list(judgements(self.task, output, pictures, truths, self.metrics))
        if self.space.scene is None or not self.space.scene.things:
            return judged
        for number, whole in enumerate(wholes):
            key = whole.detach()[self._rest].numpy().tobytes()
            if key not in self._things:
                _keep(self._things, key, things_seen(self.renderer, whole))
            judged[number] = with_things(judged[number], self._things[key])
        return judged

    def view(
        self,
        predict: Callable[[Tensor], Tensor],
        whole: Tensor,
        seed: int,
        spp: int,
        *,
        drawn: Tensor | None = None,
    ) -> ComparedView:
        """Compare a picture (H, W, 3) that is predicted of the whole space at `whole`
        with traced ones; `spp` are the samples a pixel of a rendered one. Of what is
        searched, the search has not moved what is `drawn`, (d,) bool.
        """
        with torch.no_grad():
            predicted = predict(whole)
            start = torch.cat([self.domain.start, whole[self.domain.dim :]])
            if drawn is not None:
                start[: self.domain.dim][drawn] = whole[: self.domain.dim][drawn]
            before = None if torch.equal(start, whole) else predict(start)
        return view_of(
            self.renderer,
            predicted,
            whole,
            seed,
            spp,
            lambda *at: self.judge(*at).margin,
            before,
        )

    def marks(self, picture: Tensor, whole: Tensor) -> list[Mark]:
        """Return what shows the model's prediction of a picture (H, W, 3) of the whole
        space at `whole`.
        """
        return self.seen(picture, whole)[1]

    def seen(self, picture: Tensor, whole: Tensor) -> tuple[bool, list[Mark]]:
        """Return whether the model's prediction of a picture (H, W, 3) at `whole` is
        right, and what shows it.
        """
        with torch.no_grad():
            output = self.model(picture)
            truth = self.truth(whole)
            return self.task.judge(output, truth)[0].right, self.task.marks(
                output, truth
            )[0]

    def truth(
        self, whole: Tensor | None = None, listed: Mapping[str, Value] | None = None
    ) -> Truth:
        """Return what is true of the scene at a configuration of the whole space; None
        for the start. Values that are `listed` count as they are there, not as what
        single precision makes of them.
        """
        if whole is None or not self.task.varies:
            return self._start_truth
        # what the camera sees first has nothing to do with base colours, so that a
        # truth is remembered where the rest is a few numbers, unless the task asks for
        # numbers
        rest = whole.detach()[self._rest]
        key = rest.numpy().tobytes()
        if not listed and key in self._truths:
            return self._truths[key]

        def values() -> dict[str, Value]:
            return {
                name: (listed or {}).get(name, value)
                for name, value in self.space.describe(whole).items()
            }

        rig = () if self.space.scene is None else self.space.scene.rig
        facts, *views = [
            self.facts(values, look)
            for look in looks_at(self.renderer, whole, len(rig))
        ]
        facts = replace(facts, views=tuple(views))
        truth = self.task.truth(facts)
        if not listed and len(rest) <= MOST_NUMBERS and "numbers" not in vars(facts):
            _keep(self._truths, key, truth)
        return truth

    @cached_property
    def _start_truth(self) -> Truth:
        start = self.whole(self.domain.start)
        if self.task.varies:
            return self.truth(start)
        return self.task.truth(
            self.facts(
                lambda: self.space.describe(start),
                lambda: self.renderer.surfaces(start),
            )
        )

    @cached_property
    def _rest(self) -> Tensor:
        """Which coordinates do more than to colour surfaces, (d,) bool."""
        linear = linear_inputs(self.renderer)
        rest = torch.ones(len(self.space.start), dtype=torch.bool)
        for group in self.space.groups:
            route = self.renderer.routes.get(group.name)
            rest[group.coordinates] = not route or not route <= linear
        return rest

    def asked(self, *wholes: Tensor) -> ConfigurationInputs:
        """Return what gives the objective more than pictures, at configurations of the
        whole space.
        """
        return ConfigurationInputs(self.space, self.searched_space, wholes)

    def describe(self, u: Tensor, draw: int | None = None) -> dict[str, Value]:
        """Say a configuration of the searched controls in named values with units,
        under the conditions of a draw, by its seed; without, those that the scene comes
        with.
        """
        return self.space.describe(
            self.whole(u, draw), self.space.controls[: self.searched]
        )

    def plan_summary(self, plan: GradientPlan) -> PlannedGradient:
        """Return what a result holds of a plan: what is stored of it, and each step in
        its parameter's unit.
        """
        groups = []
        for group, row in zip(plan.groups, plan.to_dict()["groups"], strict=True):
            u = self.whole(self.domain.start).clone()
            half = min(group.step, 0.5)
            ends = list[Value | None]()
            for side in (
                (0.5 - half, 0.5 + half)
                if group.step_reason and group.size == 1
                else ()
            ):
                u[group.coordinates] = side  # in the middle of its range
                ends.append(self.space.describe(u).get(group.name))
            low, high = ends or (None, None)
            step = None
            unit = ""
            if (
                low is not None
                and high is not None
                and isinstance(low["value"], (int, float))
            ):
                step = abs(float(high["value"]) - float(low["value"])) / 2.0
                unit = low["unit"]
            groups.append(GroupDerivative(**row, step_in_unit=step, unit=unit))
        return PlannedGradient(
            renders_per_gradient=plan.renders, spp=plan.spp, groups=groups
        )

    def conditions_of(self, u: Tensor, draw: int) -> dict[str, Value]:
        """Say the conditions of a draw in named values with units; empty where there
        are none.
        """
        if self.conditions is None:
            return {}
        return self.space.describe(
            self.whole(u, draw), self.space.controls[self.searched :]
        )

    # ---- evaluations
    # ------------------------------------------------------------------------------------------------

    def evaluate_all(
        self, queries: Sequence[Query], prepared: Prepared | None = None
    ) -> Iterator[Evaluation]:
        """Answer queries, each when it is asked for, as another process has prepared
        the same problem.
        """
        if prepared is not None:
            self.spp = prepared.spp
            self.search_depth = prepared.search_depth
            if self.plan != prepared.plan:
                self.plan = prepared.plan
        return map(self.evaluate, queries)

    def evaluate(self, query: Query) -> Evaluation:
        """Answer one query: the only place where a run renders, asks and judges."""
        u = query.u
        seed = query.seed
        before = self.renderer.non_finite
        if query.wanted == "light":
            evaluation = Evaluation(
                math.nan,
                None,
                False,
                light=self.linearised(u, seed, query.spp).collected,
            )
        elif query.wanted == "picture":
            evaluation = Evaluation(
                math.nan, None, False, picture=self.picture(u, seed, query.spp)
            )
        elif query.phase is None:
            picture = self.picture(u, seed, query.spp, drawn=query.drawn)
            whole = self.whole(u, seed if query.drawn else None)
            evaluation = Evaluation.of(
                self.judge(picture, whole), picture=picture if query.keep else None
            )
        elif self.conditions is None:
            evaluation = self.evaluated(query, u, seed)[0]
        else:
            draws = [seeds.stream(seed, "draw", number) for number in range(self.draws)]
            alone = replace(query, keep=False)
            evaluation = self.mean(
                [self.evaluated(alone, self.whole(u, draw), draw) for draw in draws], u
            )
            if query.keep:
                evaluation = replace(
                    evaluation, picture=self.picture(u, seed, self.spp, drawn=False)
                )
        lost = self.renderer.non_finite - before
        return replace(evaluation, non_finite=lost) if lost else evaluation

    def _values(
        self,
        outputs: Output,
        pictures: Tensor,
        truth: Truth,
        asked: ConfigurationInputs,
    ) -> Tensor:
        if self.objective is None:
            raise RuntimeError("a sweep has no objective")
        return self.objective(outputs, pictures, truth, asked)

    def linearised(
        self, whole: Tensor, seed: int, spp: int, collected: Linearised | None = None
    ) -> LinearRenderer:
        """Return what predicts pictures near a configuration of the whole space, from
        light that was collected there or is collected now.
        """
        own = {control.name for control in self.searched_space.controls}
        groups = [group.name for group in self.plan.groups if group.control in own]
        names = frozenset().union(
            *(self.renderer.routes.get(name, frozenset()) for name in groups)
        )
        names &= linear_inputs(self.renderer)
        with self.renderer.scene.shorter(
            min(LIGHT_DEPTH, self.search_depth or LIGHT_DEPTH)
        ):
            return LinearRenderer(
                self.renderer,
                whole,
                seed,
                spp=spp,
                quick=True,
                names=names,
                collected=collected,
            )

    def evaluated(
        self, query: Query, whole: Tensor, seed: int, renderer: Renderer | None = None
    ) -> tuple[Evaluation, Output]:
        """Answer a query of a search by one picture of the whole space, by the
        problem's renderer or by another one; and return the model's output.
        """
        renderer = self.renderer if renderer is None else renderer
        before = renderer.non_finite
        renders = renderer.renders
        truth = self.truth(whole)
        gradient = query.gradient
        samples = query.samples
        seen: list[tuple[Tensor, Output]] = []
        at = whole.detach().clone().requires_grad_(bool(gradient))
        asked = self.asked(at)
        slope = torch.zeros(())

        def loss(image: Tensor) -> Tensor:
            nonlocal slope
            output = self.model(image)
            seen.append((image.detach(), output))
            value = self._values(output, image[None], truth, asked)[0]
            # exact, whatever the plan does with the picture
            if asked.used and len(seen) == 1 and value.requires_grad:
                (by_input,) = torch.autograd.grad(
                    value, at, retain_graph=True, allow_unused=True
                )
                slope = slope if by_input is None else by_input
            return value

        spp = self.spp * samples
        depth = self.search_depth
        derivative = None
        with nullcontext() if depth is None else renderer.scene.shorter(depth):
            if gradient:
                value, derivative = renderer.gradient(
                    loss, whole, seed, spp, free=gradient == "free"
                )
                derivative = derivative + slope if asked.used else derivative
            else:
                with torch.no_grad():
                    value = loss(renderer(whole, seed=seed, spp=spp))
        image, output = seen[0]
        (judgement,) = self._judged(output, image[None], [truth], [whole])
        evaluation = Evaluation(
            float(value),
            derivative,
            judgement.success,
            renderer.non_finite - before,
            cost=max(1, renderer.renders - renders) * samples,
            judgement=judgement,
            picture=to_8_bit(image) if query.keep else None,
        )
        return evaluation, output

    def judged(
        self,
        render: Callable[[Tensor], Tensor],
        wholes: Sequence[Tensor],
        u: Tensor,
        gradient: WhichGradient,
    ) -> tuple[list[tuple[Evaluation, Output]], Tensor | None]:
        """Ask the model about several pictures at once: those that `render` makes of u,
        (N, H, W, 3) with a graph, each of a configuration of the whole space. Returns
        an evaluation without derivative and the model's output for each, and the
        derivative (d,) of the sum of their objectives, weighted by `hard_first`.
        """
        at = u.detach().clone().requires_grad_(bool(gradient))
        with torch.set_grad_enabled(bool(gradient)):
            pictures = render(at)
            outputs = self.model(pictures)
            each = [outputs[number : number + 1] for number in range(len(wholes))]
            truths = [self.truth(whole) for whole in wholes]
            places = [torch.cat([at, whole[len(at) :]]) for whole in wholes]
            if self.task.varies:
                of_each = zip(
                    each,
                    pictures.split(1),
                    truths,
                    map(self.asked, places),
                    strict=True,
                )
                values = torch.cat([self._values(*picture) for picture in of_each])
            else:
                values = self._values(outputs, pictures, truths[0], self.asked(*places))
            derivative = torch.zeros_like(u) if gradient else None
            if values.requires_grad:
                derivative = torch.autograd.grad(
                    (values * hard_first(values)).sum(), at
                )[0]
        evaluations = []
        judged = self._judged(outputs, pictures, truths, wholes)
        for value, judgement, output in zip(values.detach(), judged, each, strict=True):
            evaluations.append(
                (
                    Evaluation(
                        float(value), None, judgement.success, judgement=judgement
                    ),
                    output,
                )
            )
        return evaluations, derivative

    def mean_under(
        self,
        render: Callable[[slice, Tensor], Tensor],
        wholes: Sequence[Tensor],
        u: Tensor,
        gradient: WhichGradient,
        at_once: int,
    ) -> Evaluation:
        """Return the mean over conditions whose pictures are predicted: `render` goes
        from some of them and u to pictures (N, H, W, 3), with a graph. The model is
        asked about `at_once` of them at once.
        """
        evaluated = []
        total = None
        for begin in range(0, len(wholes), at_once):
            some = slice(begin, begin + at_once)
            each, derivative = self.judged(
                partial(render, some), wholes[some], u, gradient
            )
            evaluated += each
            if derivative is not None:
                total = derivative if total is None else total + derivative
        return self.mean(evaluated, u, None if total is None else total / len(wholes))

    def mean(
        self,
        evaluated: Sequence[tuple[Evaluation, Output]],
        u: Tensor,
        gradient: Tensor | None = None,
    ) -> Evaluation:
        """Return the mean over conditions, from evaluations with the model's outputs,
        and the gradient of the mean where these have none. Its cost is counted in
        evaluations, each of which takes a picture a draw.
        """
        each, outputs = zip(*evaluated, strict=True)
        gradients = [
            evaluation.gradient[: u.numel()]
            for evaluation in each
            if evaluation.gradient is not None
        ]
        judged = [
            evaluation.judgement
            for evaluation in each
            if evaluation.judgement is not None
        ]
        if self.task.varies:  # each condition has a truth of its own
            usual = typical(judged)
            score = mean([judgement.score for judgement in judged])
            margin = mean([judgement.margin for judgement in judged])
            judgement = Judgement.of(score, margin, usual.prediction, usual.payload)
        else:
            with torch.no_grad():
                judgement = self.task.judge(
                    self.task.average(list(outputs)), self.truth()
                )[0]
        return Evaluation(
            sum(evaluation.objective for evaluation in each) / len(each),
            torch.stack(gradients).mean(dim=0) if gradients else gradient,
            sum(evaluation.success for evaluation in each)
            >= OVER_CONDITIONS.share(len(each)),
            non_finite=sum(evaluation.non_finite for evaluation in each),
            cost=max(one.cost for one in each),
            judgement=replace(judgement, metrics=mean_metrics(judged)),
        )

    def loss(self, image: Tensor) -> Tensor:
        """The objective of a picture (H, W, 3) sRGB near the start, as a number with a
        graph.
        """
        start = self.asked(self.whole(self.domain.start))
        return self._values(self.model(image), image[None], self.truth(), start)[0]


def hard_first(values: Tensor) -> Tensor:
    """Return how much each of several conditions counts in a derivative (n,), by its
    objective: the smaller that is among the others, the more. All count 1 on average.

    The mean of all would be raised most easily where the prediction is wrong already.
    Weights of exp(-z), where z is the objective in standard deviations, raise it where
    that is not so (Li et al. 2021, *Tilted Empirical Risk Minimization*, section 2,
    with a tilt of the opposite sign).
    """
    known = values.detach()
    spread = known.std() if len(known) > 1 else known.new_zeros(())
    if not bool(torch.isfinite(spread)) or float(spread) == 0.0:
        return torch.ones_like(known)
    return len(known) * torch.softmax(-known / spread, dim=0)
