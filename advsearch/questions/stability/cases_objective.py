"""What a model may answer: huge logits, ties, certainty, NaN at some step, a constant, noise. Pure torch."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from advsearch.attacks import POLICIES, Ending, make_policy, search, verify
from advsearch.attacks.evaluation import Evaluation, Query
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.files import JsonObject
from advsearch.models.model import Model, Preprocessing
from advsearch.questions.stability.case import CaseGroup, Check, Outcome, Toy, box_domain, holds, quadratic
from advsearch.seeds import stream
from advsearch.tasks import Answer, Classification, Judgement

LABELS = (0,)
IMAGE = torch.zeros(1, 2, 2, 3)
STEPS = 40
SPACING = 2.0**-10
"""Distance of neighbouring 32-bit numbers at 10,000: logits themselves are no more exact than that."""
WITH_OPTIONS: dict[str, JsonObject] = {
    "restarts": {"policy": "pgd", "times": 2},
    "portfolio": {"policies": ["pgd", "cmaes"]},
}
FORMS = {name: kind.plain for name, kind in OBJECTIVE_KINDS.items() if kind.plain is not None}

GROUP = CaseGroup("objective")
_NAN = "an objective that is not finite counts as -inf, its gradient as zero; three in a row end the search"
_LOGITS = "objectives are written for it: no overflow, shared gradients, tangents where a slope would be lost"
_FLAT = "a zero gradient gives a random step; the fifth in a row ends the search as 'stalled'"


def _differentiated(logits: Tensor, objective: Any, dtype: torch.dtype) -> tuple[float, Tensor]:
    at = logits.to(dtype).requires_grad_()
    value = objective(at, IMAGE, LABELS)[0]
    (slope,) = torch.autograd.grad(value, at)
    return float(value.detach()), slope[0]


def logits_like(rows: list[list[float]], *, same: float = 1e-5) -> Outcome:
    """Every objective of logits, in single against double precision."""
    worst, finite, lost = 0.0, True, 0
    for row in rows:
        for objective in FORMS.values():
            value, slope = _differentiated(torch.tensor([row]), objective, torch.float32)
            exact, wanted = _differentiated(torch.tensor([row]), objective, torch.float64)
            finite &= math.isfinite(value) and bool(torch.isfinite(slope).all())
            lost += not bool(slope.any())
            scale = max(1.0, abs(exact))
            error = (
                abs(value - exact) / scale,
                float((slope - wanted).abs().max() / wanted.abs().max().clamp(min=1e-12)),
            )
            worst = max(worst, *error)
    return Outcome(
        (
            Check("objectives without a gradient", float(lost), 0.0, 0.0),
            Check("error against double", worst, most=same),
        ),
        finite,
        worst,
        measured={"objectives": float(len(FORMS)), "answers": float(len(rows))},
    )


GROUP.case(
    "logits-of-10000", "Every objective and its gradient are finite, not lost, and as in double precision.", _LOGITS
)(partial(logits_like, [[1e4, -1e4, 0.0, 5e3], [-1e4, 1e4, 9e3, 0.0], [1e4, 9999.0, 9998.0, -1e4]], same=SPACING))


@GROUP.case("ties", "Tied logits share the gradient, and a tie is no success.", _LOGITS)
def ties() -> Outcome:
    """The largest logits are equal: the gradient is shared, and a tie is no success."""
    rows = [[1.0, 1.0, 0.0, -1.0], [2.0, 2.0, 2.0, 2.0], [0.0, 3.0, 3.0, 3.0]]
    found = logits_like(rows)
    task = Classification()
    tied = torch.tensor(rows[:2])
    _, slope = _differentiated(torch.tensor([rows[2]]), FORMS["margin"], torch.float32)
    return Outcome(
        (
            *found.checks,
            holds("a tie is no success", not bool((task.score(tied, LABELS) > 0.0).any())),
            holds("a tie is right", all(one.right for one in task.judge(tied, LABELS))),
            Check("gradient of each of three tied rivals", float(slope[1:].min()), 1.0 / 3.0 - 1e-6, 1.0 / 3.0 + 1e-6),
        ),
        found.finite,
        found.relative_error,
    )


class _Certain(nn.Module):
    """Answers with probabilities that are exactly 1 and 0, or with NaN from a given call on."""

    def __init__(self, sharpness: float) -> None:
        super().__init__()
        self.sharpness = sharpness

    def forward(self, x: Tensor) -> Tensor:
        light = x.mean(dim=(1, 2, 3))
        return torch.stack([light, 0.5 - light, torch.zeros_like(light)], dim=1).mul(self.sharpness).softmax(dim=1)


@GROUP.case(
    "probabilities-0-and-1",
    "Nothing is infinite, and where the model is flat the search goes elsewhere or says so.",
    _LOGITS,
)
def certain() -> Outcome:
    """A model that answers with probabilities of exactly 0 and 1: finite, and its flatness is named."""
    model = Model(_Certain(1e4), "certain", ("a", "b", "c"), Preprocessing((8, 8)), probabilities=True)
    image = torch.full((8, 8, 3), 0.9, requires_grad=True)
    logits = model(image)
    value = FORMS["margin"](logits, IMAGE, LABELS)[0]
    (slope,) = torch.autograd.grad(value, image)
    probabilities = model.module(image.permute(2, 0, 1)[None]).detach()

    def light(u: Tensor) -> Tensor:
        answer = model(u.float().expand(8, 8, 3))
        return FORMS["margin"](answer, IMAGE, LABELS)[0].double()

    flat = search(
        partial(map, Toy(light, box_domain([0.9]))),
        box_domain([0.9]),
        make_policy("pgd"),
        steps=STEPS,
        seed=0,
        candidates=0,
    )
    found = logits_like([[200.0, -200.0, 0.0, -300.0], [-200.0, 200.0, 0.0, -300.0]])
    return Outcome(
        (
            *found.checks,
            holds("the model's probabilities are exactly 0 and 1", set(probabilities.flatten().tolist()) == {0.0, 1.0}),
            holds("logits and gradient are finite", bool(torch.isfinite(logits).all() & torch.isfinite(slope).all())),
            holds("a search without any gradient goes elsewhere or says 'stalled'", _left(flat.ending, flat.best_u)),
        ),
        found.finite,
        found.relative_error,
        flat.ending.value,
    )


def _left(ending: Ending, u: Tensor) -> bool:
    return ending is Ending.STALLED or float((u - 0.9).abs().max()) > 0.1


def nan_at(steps: frozenset[int], *, ends: bool) -> Outcome:
    """The model answers NaN at some steps; every policy has to go on, or to give up where it is three in a row."""
    broken, endings, finite = [], set(), True
    for name in POLICIES:
        toy = Toy(quadratic([0.7, 0.4], [1.0, 2.0]), box_domain([0.2, 0.2]), broken=steps)
        policy = make_policy(name, **WITH_OPTIONS.get(name, {}))
        result = search(partial(map, toy), toy.domain, policy, steps=STEPS, seed=1, candidates=2, repeats=1)
        seen = len([one for one in result.history if one.step in steps])
        endings.add(result.ending.value)
        finite &= math.isfinite(result.best_objective) and bool(torch.isfinite(result.best_u).all())
        right = result.non_finite_objectives == seen and (result.ending is Ending.NON_FINITE) == ends
        if not right:
            broken.append(name)
    return Outcome(
        (
            Check("policies that went wrong" + (": " + ", ".join(broken) if broken else ""), len(broken), 0.0, 0.0),
            holds("every answer is finite", finite),
        ),
        ending=", ".join(sorted(endings)),
        measured={"policies": float(len(POLICIES))},
    )


GROUP.case("nan-at-step-0", "Every policy counts it and goes on.", _NAN)(partial(nan_at, frozenset({0}), ends=False))
GROUP.case("nan-at-steps-7-and-8", "Every policy counts them and goes on.", _NAN)(
    partial(nan_at, frozenset({7, 8}), ends=False)
)
GROUP.case("nan-three-times-in-a-row", "Every search ends as non-finite, with what it had.", _NAN)(
    partial(nan_at, frozenset({3, 4, 5}), ends=True)
)


@GROUP.case("constant-model", "Nothing is found; policies that follow gradients end as stalled.", _FLAT)
def constant_model() -> Outcome:
    """A model whose answer never changes: nothing is found, and who follows gradients says that there are none."""
    wrong, endings = [], set()
    for name in POLICIES:
        toy = Toy(lambda u: 0.0 * u.sum() - 1.0, box_domain([0.2, 0.2]), threshold=0.0)
        policy = make_policy(name, **WITH_OPTIONS.get(name, {}))
        result = search(partial(map, toy), toy.domain, policy, steps=STEPS, seed=1)
        endings.add(f"{result.ending.value}")
        if result.success_rate > 0.0 or (name in ("pgd", "adam") and result.ending is not Ending.STALLED):
            wrong.append(name)
    label = "policies that went wrong" + (": " + ", ".join(wrong) if wrong else "")
    return Outcome((Check(label, float(len(wrong)), 0.0, 0.0),), ending=", ".join(sorted(endings)))


def chance(rate: float, runs: int = 100) -> Outcome:
    """A model that answers at random, wrong with some probability: a search always claims something; nothing holds."""
    found = claimed = 0
    domain = box_domain([0.5, 0.5])
    for run in range(runs):

        def margin(seed: int) -> float:
            return float(torch.rand(1, generator=torch.Generator().manual_seed(seed))) - (1.0 - rate)

        def noisy(query: Query) -> Evaluation:
            value = margin(query.seed)
            return Evaluation(value, None, value > 0.0)

        def trial(query: Query, run: int = run) -> Evaluation:
            # the picture decides, so another configuration gives another answer
            value = margin(stream(run, f"trial {query.u.tolist()}", query.seed))
            return Evaluation.of(Judgement(value, value, value <= 0.0, Answer("wrong" if value > 0.0 else "right")))

        result = search(partial(map, noisy), domain, make_policy("random"), steps=STEPS, seed=run, noise=run)
        claimed += result.ending is Ending.FOUND
        ending = verify(partial(map, trial), domain, result.best_u, spp=1, seed=run, claim=result.ending).ending
        found += ending is Ending.FOUND
    return Outcome(
        (Check(f"findings in {runs} runs", float(found), 0.0, 0.0),),
        ending="not verified, or already wrong",
        measured={"claims of the search": float(claimed)},
    )


for rate in (0.1, 0.5, 0.9):
    GROUP.case(
        f"random-model-wrong-{round(100 * rate)}-percent",
        "What the search claims is never verified.",
        "fresh trials of the answer and of the clean configuration (advsearch.attacks.verification)",
    )(partial(chance, rate))
