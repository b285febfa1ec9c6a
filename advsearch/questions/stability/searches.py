"""What a model may answer: huge logits, ties, certainty, NaN at some step, a constant, noise. Pure torch."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from advsearch.attacks import POLICIES, Block, Domain, Ending, make_policy, search, verify
from advsearch.attacks.evaluation import Evaluation, Query
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.engine.gradients import probes, reference, smooth_loss
from advsearch.files import JsonObject
from advsearch.models.model import Model, Preprocessing
from advsearch.questions.stability.scene import (
    REFERENCE_SPP,
    CaseGroup,
    Check,
    ControlSettings,
    Outcome,
    Toy,
    box_domain,
    compared,
    examine_gradient,
    holds,
    quadratic,
    small,
)
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

OBJECTIVE = CaseGroup("objective")
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
            off = float((slope - wanted).abs().max() / wanted.abs().max().clamp(min=1e-12))
            worst = max(worst, abs(value - exact) / max(1.0, abs(exact)), off)
    return Outcome(
        Check("objectives without a gradient", float(lost), 0.0, 0.0),
        Check("error against double", worst, most=same),
        finite=finite,
        relative_error=worst,
        measured={"objectives": float(len(FORMS)), "answers": float(len(rows))},
    )


OBJECTIVE.case(
    "logits-of-10000",
    _LOGITS,
    holds="Every objective and its gradient are finite, not lost, and as in double precision.",
)(partial(logits_like, [[1e4, -1e4, 0.0, 5e3], [-1e4, 1e4, 9e3, 0.0], [1e4, 9999.0, 9998.0, -1e4]], same=SPACING))


@OBJECTIVE.case("ties", _LOGITS)
def ties() -> Outcome:
    """Tied logits share the gradient, and a tie is no success."""
    rows = [[1.0, 1.0, 0.0, -1.0], [2.0, 2.0, 2.0, 2.0], [0.0, 3.0, 3.0, 3.0]]
    found = logits_like(rows)
    task = Classification()
    tied = torch.tensor(rows[:2])
    _, slope = _differentiated(torch.tensor([rows[2]]), FORMS["margin"], torch.float32)
    return found.with_checks(
        holds("a tie is no success", not bool((task.score(tied, LABELS) > 0.0).any())),
        holds("a tie is right", all(one.right for one in task.judge(tied, LABELS))),
        Check("gradient of each of three tied rivals", float(slope[1:].min()), 1.0 / 3.0 - 1e-6, 1.0 / 3.0 + 1e-6),
        measured={},
    )


class _Certain(nn.Module):
    """Answers with probabilities that are exactly 1 and 0, or with NaN from a given call on."""

    def __init__(self, sharpness: float) -> None:
        super().__init__()
        self.sharpness = sharpness

    def forward(self, x: Tensor) -> Tensor:
        light = x.mean(dim=(1, 2, 3))
        return torch.stack([light, 0.5 - light, torch.zeros_like(light)], dim=1).mul(self.sharpness).softmax(dim=1)


@OBJECTIVE.case("probabilities-0-and-1", _LOGITS)
def certain() -> Outcome:
    """Nothing is infinite, and where the model is flat the search goes elsewhere or says so."""
    model = Model(_Certain(1e4), "certain", ("a", "b", "c"), Preprocessing((8, 8)), probabilities=True)
    image = torch.full((8, 8, 3), 0.9, requires_grad=True)
    logits = model(image)
    value = FORMS["margin"](logits, IMAGE, LABELS)[0]
    (slope,) = torch.autograd.grad(value, image)
    probabilities = model.module(image.permute(2, 0, 1)[None]).detach()

    def light(u: Tensor) -> Tensor:
        answer = model(u.float().expand(8, 8, 3))
        return FORMS["margin"](answer, IMAGE, LABELS)[0].double()

    domain = box_domain([0.9])
    flat = search(partial(map, Toy(light, domain)), domain, make_policy("pgd"), steps=STEPS, seed=0, candidates=0)
    left = flat.ending is Ending.STALLED or float((flat.best_u - 0.9).abs().max()) > 0.1
    found = logits_like([[200.0, -200.0, 0.0, -300.0], [-200.0, 200.0, 0.0, -300.0]])
    return found.with_checks(
        holds("the model's probabilities are exactly 0 and 1", set(probabilities.flatten().tolist()) == {0.0, 1.0}),
        holds("logits and gradient are finite", bool(torch.isfinite(logits).all() & torch.isfinite(slope).all())),
        holds("a search without any gradient goes elsewhere or says 'stalled'", left),
        ending=flat.ending.value,
        measured={},
    )


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
        Check("policies that went wrong" + (": " + ", ".join(broken) if broken else ""), len(broken), 0.0, 0.0),
        holds("every answer is finite", finite),
        ending=", ".join(sorted(endings)),
        measured={"policies": float(len(POLICIES))},
    )


OBJECTIVE.case("nan-at-step-0", _NAN, holds="Every policy counts it and goes on.")(
    partial(nan_at, frozenset({0}), ends=False)
)
OBJECTIVE.case("nan-at-steps-7-and-8", _NAN, holds="Every policy counts them and goes on.")(
    partial(nan_at, frozenset({7, 8}), ends=False)
)
OBJECTIVE.case("nan-three-times-in-a-row", _NAN, holds="Every search ends as non-finite, with what it had.")(
    partial(nan_at, frozenset({3, 4, 5}), ends=True)
)


@OBJECTIVE.case("constant-model", _FLAT)
def constant_model() -> Outcome:
    """Nothing is found; policies that follow gradients end as stalled."""
    wrong, endings = [], set()
    for name in POLICIES:
        toy = Toy(lambda u: 0.0 * u.sum() - 1.0, box_domain([0.2, 0.2]), threshold=0.0)
        policy = make_policy(name, **WITH_OPTIONS.get(name, {}))
        result = search(partial(map, toy), toy.domain, policy, steps=STEPS, seed=1)
        endings.add(f"{result.ending.value}")
        if result.success_rate > 0.0 or (name in ("pgd", "adam") and result.ending is not Ending.STALLED):
            wrong.append(name)
    label = "policies that went wrong" + (": " + ", ".join(wrong) if wrong else "")
    return Outcome(Check(label, float(len(wrong)), 0.0, 0.0), ending=", ".join(sorted(endings)))


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
        Check(f"findings in {runs} runs", float(found), 0.0, 0.0),
        ending="not verified, or already wrong",
        measured={"claims of the search": float(claimed)},
    )


for rate in (0.1, 0.5, 0.9):
    OBJECTIVE.case(
        f"random-model-wrong-{round(100 * rate)}-percent",
        "fresh trials of the answer and of the clean configuration (advsearch.attacks.verification)",
        holds="What the search claims is never verified.",
    )(partial(chance, rate))


SAMPLES, GROUPS_OF_MEANS, CLIP = 24, 6, 3.0
EXPERIMENTS = 4000
RATIO = 1.25
"""Factor by which tails may make the result of a search worse than gaussian noise of the same median does."""
HEAVY = 12.0
"""Distance of the farthest of `SAMPLES` gradients from their median, over the median distance, from which a tail is
called heavy: of as many Gaussian numbers less than one lot in 1,000 has more."""
TAIL = 1.5
"""Index of the Pareto and t distributions: a mean, and no variance."""

Estimator = Callable[[Tensor], Tensor]
"""From samples (..., n, d) to their centre (..., d)."""

NOISE = CaseGroup("noise")
_RULE = (
    "outliers are clipped: elements at 3 medians in an l-infinity ball and 10 in an l2 ball, the whole gradient at 3 "
    "medians of the latest lengths"
)


def median_of_means(samples: Tensor, groups: int = GROUPS_OF_MEANS) -> Tensor:
    """The median of the means of groups, element by element; samples (..., n, d), n a multiple of the groups."""
    *lead, count, size = samples.shape
    means = samples.reshape(*lead, groups, count // groups, size).mean(dim=-2)
    return torch.quantile(means, 0.5, dim=-2)


def clipped_mean(samples: Tensor, factor: float = CLIP) -> Tensor:
    """The mean of samples (..., n, d), each shortened to at most `factor` times the median length."""
    lengths = samples.norm(dim=-1, keepdim=True)
    limit: Tensor = factor * lengths.median(dim=-2, keepdim=True).values
    shortened: Tensor = samples * (limit / lengths.clamp_min(1e-30)).clamp(max=1.0)
    return shortened.mean(dim=-2)


def normalised_mean(samples: Tensor) -> Tensor:
    """The mean of samples (..., n, d) over their mean absolute values each: a direction, PGD's."""
    return (samples / samples.abs().mean(dim=-1, keepdim=True).clamp_min(1e-30)).mean(dim=-2)


ESTIMATORS: dict[str, Estimator] = {
    "mean": lambda samples: samples.mean(dim=-2),
    "median of means": median_of_means,
    "clipping": clipped_mean,
}


def _heavy_noise(kind: str, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Noise of mean 0 without a variance, its median size about 1.

    - "symmetric": a normal over the root of a gamma: Student's t with `TAIL` degrees of freedom;
    - "skewed": Pareto with index `TAIL`, less its mean: mostly a little under 0, seldom far over it.
    """
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64).clamp_min(1e-12)
    if kind == "skewed":
        return uniform.pow(-1.0 / TAIL) - TAIL / (TAIL - 1.0)
    signs = torch.randint(0, 2, shape, generator=generator, dtype=torch.float64) * 2.0 - 1.0
    return signs * (uniform.pow(-1.0 / TAIL) - 1.0) / 0.59


def estimators(kind: str) -> Outcome:
    """Bias and typical error of each estimator, from 24 samples of a gradient whose mean is known."""
    truth = torch.tensor([1.0, 0.5, -0.25, 0.1]).double()
    generator = torch.Generator().manual_seed(0)
    samples = truth + 0.5 * _heavy_noise(kind, (EXPERIMENTS, SAMPLES, 4), generator)
    measured, errors = {}, {}
    for name, estimator in ESTIMATORS.items():
        off = estimator(samples) - truth
        bias = float(off.mean(dim=0).norm() / truth.norm())
        errors[name] = float(off.norm(dim=1).square().mean().sqrt() / truth.norm())
        measured[f"{name}: bias"], measured[f"{name}: error"] = bias, errors[name]
    way = normalised_mean(samples).mean(dim=0)
    cosine = float(way @ truth / (way.norm() * truth.norm()))
    measured["normalisation: cosine of its mean with the truth"] = cosine
    checks = [
        Check(f"{name}: error, its bias included, over that of the mean", errors[name] / errors["mean"], most=0.7)
        for name in ("median of means", "clipping")
    ]
    if kind == "symmetric":  # a skewed distribution has a bias whatever is done; it is printed
        checks.append(Check("median of means: bias", measured["median of means: bias"], most=0.02))
        checks.append(Check("normalisation: cosine of its mean with the truth", cosine, least=0.99))
    return Outcome(*checks, relative_error=measured["median of means: bias"], measured=measured)


for kind in ("symmetric", "skewed"):
    NOISE.case(
        f"heavy-tails-{kind}",
        "median of means of 6 groups; clipping at 3 median lengths; normalisation",
        holds="Median of means and clipping beat the mean; their bias and that of normalisation are known.",
    )(partial(estimators, kind))


def heavy_search(kind: str) -> Outcome:
    """Searches with noisy gradients, the noise in the median twice as large as the gradient.

    Args:
        kind: "elements", every element has a heavy tail of its own; "lengths", the noise of one evaluation is gaussian
            and its size has one; "spike", no noise but one gradient that is nothing but noise, 1e12 times too large.
    """
    checks, measured = [], {}
    for name in ("pgd", "adam"):
        share = _share_of_optimum(name, kind)
        measured[f"{name}: share of the optimum"] = share
        if kind == "spike":
            checks.append(Check(f"{name}: share of the optimum", share, least=1.0 / RATIO))
            continue
        usual = _share_of_optimum(name, "gaussian")
        measured[f"{name}: share with gaussian noise"] = usual
        checks.append(Check(f"{name}: share with gaussian noise over that with tails", usual / share, most=RATIO))
    error = 1.0 - min(value for key, value in measured.items() if key.endswith("optimum"))
    return Outcome(*checks, relative_error=error, measured=measured)


for kind, result in (
    ("elements", "the result with gaussian noise of the same median, with a heavy tail in every element."),
    ("lengths", "the result with gaussian noise of the same median, with a heavy tail in its size."),
    ("spike", "the optimum, with one gradient 1e12 times too large."),
):
    NOISE.case(f"heavy-tailed-search-{kind}", _RULE, holds="Within 1.25 of " + result)(partial(heavy_search, kind))


def _share_of_optimum(name: str, kind: str, seeds: int = 9) -> float:
    """Median over seeds of what a search in 60 numbers reaches of the largest value of a linear objective."""
    size = 60
    start = torch.full((size,), 0.5)
    domain = Domain(start, (Block(size - 1, "l2", 1.0), Block(1, name="number")))
    weights = torch.linspace(-1.0, 1.0, size).double()

    def value(u: Tensor) -> Tensor:
        return (weights * (u - 0.5)).sum()

    best = float(value(domain.project(start + 1e3 * weights.float()).double()))
    shares = []
    for seed in range(seeds):

        def disturb(slope: Tensor, index: int, seed: int = seed) -> Tensor:
            generator = torch.Generator().manual_seed(1000 * seed + index)
            return slope + 2.0 * slope.abs().mean() * _disturbance(kind, index, len(slope), generator)

        toy = Toy(value, domain, disturb=disturb)
        result = search(partial(map, toy), domain, make_policy(name), steps=100, seed=seed, candidates=0)
        shares.append(result.best_objective / best)
    return sorted(shares)[seeds // 2]


def _disturbance(kind: str, index: int, size: int, generator: torch.Generator) -> Tensor:
    """Noise (size,) float32 of one gradient, its median absolute value 1."""
    normal = torch.randn(size, generator=generator) / 0.674
    if kind == "spike":
        return 1e12 * normal if index == 20 else 0.0 * normal
    if kind == "elements":
        return _heavy_noise("symmetric", (size,), generator).float()
    return normal * float(_heavy_noise("symmetric", (1,), generator).abs()) if kind == "lengths" else normal


@NOISE.case(
    "one-sample-a-pixel", "a new seed at every step, and momentum over steps", "texture, environment, pose", cheap=False
)
def one_sample() -> Outcome:
    """Finite; the mean of 48 gradients is right; the denoiser copes."""
    controls: ControlSettings = {
        "texture": {"resolution": 8},
        "environment": {"exposure": [-1.0, 1.0]},
        "pose": {"y": [-0.3, 0.3]},
    }
    renderer = small("mug", controls)
    seen = examine_gradient(renderer, compare=False, spp=1)
    beside = compared(renderer, renderer.start, spp=1, repeats=48)
    denoised = examine_gradient(small("mug", {"texture": {"resolution": 8}}, denoise="oidn"), compare=False, spp=1)
    finite = holds("the denoised picture and its gradient are finite", denoised.finite)
    return replace(seen, compared=beside).findings(finite)


@NOISE.case(
    "heavy-tails-of-a-moving-mesh",
    "the plan prefers differences of the loss for what moves a mesh",
    "pose",
    cheap=False,
)
def heavy_render(count: int = SAMPLES) -> Outcome:
    """The plan takes differences of the loss for what moves a mesh, which have no heavy tail."""
    renderer = small("mug", {"pose": {"x": [-0.3, 0.3]}})
    renderer.formation = replace(renderer.formation, transfer="linear")
    loss, u = smooth_loss(renderer.formation.resolution), renderer.start
    probe = probes(renderer, loss, u, 0, 4)[0]
    wanted = reference(renderer, loss, u, probe, seed=1, spp=REFERENCE_SPP, repeats=(8, 16))
    before = renderer.non_finite
    samples = torch.stack([renderer.gradient(loss, u, seed, 4)[1] for seed in range(count)]).double()
    bad = renderer.non_finite - before
    away = (samples - samples.median()).abs()
    bias = {how: float(estimator(samples)) / wanted.value - 1.0 for how, estimator in ESTIMATORS.items()}
    tail, spread = float(away.max() / away.median()), float(samples.std()) / abs(wanted.value)
    doubt = 2.5 * math.hypot(spread / math.sqrt(count), wanted.noise / abs(wanted.value))
    off = abs(bias["median of means"])
    checks = (
        Check("median of means: bias beyond the noise", max(0.0, off - doubt), most=0.1),
        Check("farthest over the median distance", tail, most=HEAVY),
        holds("the plan takes secant", renderer.plan.groups[0].estimator == "secant"),
    )
    measured = {"reference": wanted.value, "noise of the reference": wanted.noise, "noise of one gradient": spread}
    measured |= {f"{how}: bias": value for how, value in bias.items()}
    return Outcome(*checks, finite=bad == 0, relative_error=off, measured=measured)
