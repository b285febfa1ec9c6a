"""One sample a pixel, and gradients with heavy tails.

The rule of the searches against heavy tails is *normalisation*: PGD divides every gradient by the mean of its absolute
values before it is added to the ones before, so that one of a million times the size counts once, like any other; Adam
divides by a running root mean square. What that costs is a bias, since large and small gradients count alike. It is
measured here beside two estimators of a mean, which a policy that averages may use:

    median of means   the median, element by element, of the means of k groups (Nemirovski and Yudin 1983)
    clipping          the mean of the samples, each shortened to at most `CLIP` times the median length

Both are biased where the distribution is skewed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, make_policy, search
from advsearch.evaluation.gradients import probes, reference, smooth_loss
from advsearch.evaluation.stability_case import Case, Check, Findings, holds
from advsearch.evaluation.stability_scene import REFERENCE_SPP, compared, examine, small
from advsearch.evaluation.stability_search import Toy

SAMPLES, GROUPS_OF_MEANS, CLIP = 24, 6, 3.0
EXPERIMENTS = 4000
TAIL = 1.5
"""Index of the Pareto and t distributions: a mean, and no variance."""

Estimator = Callable[[Tensor], Tensor]
"""From samples (..., n, d) to their centre (..., d)."""


def plain_mean(samples: Tensor) -> Tensor:
    """The mean."""
    return samples.mean(dim=-2)


def median_of_means(samples: Tensor, groups: int = GROUPS_OF_MEANS) -> Tensor:
    """The median of the means of groups, element by element; samples (..., n, d), n a multiple of the groups."""
    *lead, count, size = samples.shape
    return samples.reshape(*lead, groups, count // groups, size).mean(dim=-2).quantile(0.5, dim=-2)


def clipped_mean(samples: Tensor, factor: float = CLIP) -> Tensor:
    """The mean of samples (..., n, d), each shortened to at most `factor` times the median length."""
    lengths = samples.norm(dim=-1, keepdim=True)
    limit = factor * lengths.median(dim=-2, keepdim=True).values
    return (samples * (limit / lengths.clamp_min(1e-30)).clamp(max=1.0)).mean(dim=-2)


def normalised_mean(samples: Tensor) -> Tensor:
    """The mean of samples (..., n, d) over their mean absolute values each: what PGD's momentum adds up. A direction."""
    return (samples / samples.abs().mean(dim=-1, keepdim=True).clamp_min(1e-30)).mean(dim=-2)


ESTIMATORS: dict[str, Estimator] = {
    "mean": plain_mean,
    "median of means": median_of_means,
    "clipping": clipped_mean,
}


def _noise(kind: str, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Noise of mean 0 without a variance, its median size about 1.

    - "symmetric": a normal over the root of a gamma: Student's t with `TAIL` degrees of freedom;
    - "skewed": Pareto with index `TAIL`, less its mean: mostly a little under 0, seldom far over it.
    """
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64).clamp_min(1e-12)
    if kind == "skewed":
        return uniform.pow(-1.0 / TAIL) - TAIL / (TAIL - 1.0)
    signs = torch.randint(0, 2, shape, generator=generator, dtype=torch.float64) * 2.0 - 1.0
    return signs * (uniform.pow(-1.0 / TAIL) - 1.0) / 0.59


def estimators(kind: str) -> Findings:
    """Bias and typical error of each estimator, from 24 samples of a gradient whose mean is known."""
    truth = torch.tensor([1.0, 0.5, -0.25, 0.1]).double()
    generator = torch.Generator().manual_seed(0)
    samples = truth + 0.5 * _noise(kind, (EXPERIMENTS, SAMPLES, 4), generator)
    measured, errors = {}, {}
    for name, estimator in ESTIMATORS.items():
        off = estimator(samples) - truth
        bias = float(off.mean(dim=0).norm() / truth.norm())
        errors[name] = float(off.norm(dim=1).square().mean().sqrt() / truth.norm())
        measured[f"{name}: bias"], measured[f"{name}: error"] = bias, errors[name]
    way = normalised_mean(samples).mean(dim=0)
    cosine = float(way @ truth / (way.norm() * truth.norm()))
    measured["normalisation: cosine of its mean with the truth"] = cosine
    allowed = 0.02 if kind == "symmetric" else 0.6
    return Findings(
        (
            Check("median of means: error over that of the mean", errors["median of means"] / errors["mean"], most=0.7),
            Check("clipping: error over that of the mean", errors["clipping"] / errors["mean"], most=0.7),
            Check("median of means: bias", measured["median of means: bias"], most=allowed),
            Check("normalisation: cosine", cosine, least=0.99 if kind == "symmetric" else 0.7),
        ),
        relative_error=measured["median of means: bias"],
        measured=measured,
    )


def heavy_search(kind: str) -> Findings:
    """A search whose gradients have heavy tails, of twice the gradient's own size in the median."""
    size, reach = 60, 1.0
    start = torch.full((size,), 0.5)
    domain = Domain(start, (Block(size - 1, "l2", reach), Block(1, name="number")))
    weights = torch.linspace(-1.0, 1.0, size).double()

    def value(u: Tensor) -> Tensor:
        return (weights * (u - 0.5)).sum()

    best = float(value(domain.project(start + 1e3 * weights.float()).double()))
    checks, measured = [], {}
    for name in ("pgd", "adam"):
        shares = []
        for seed in range(5):

            def disturb(slope: Tensor, index: int, seed: int = seed) -> Tensor:
                generator = torch.Generator().manual_seed(1000 * seed + index)
                if kind == "spike":
                    return slope if index != 20 else 1e12 * torch.randn(slope.shape, generator=generator)
                loud = 2.0 * slope.abs().mean()
                return slope + loud * _noise("symmetric", tuple(slope.shape), generator).float()

            result = search(
                Toy(value, domain, disturb=disturb), domain, make_policy(name), steps=100, seed=seed, candidates=0
            )
            shares.append(result.best_objective / best)
        share = sorted(shares)[2]
        measured[f"{name}: share of the optimum"] = share
        checks.append(Check(f"{name}: median share of the optimum", share, least=0.9))
    return Findings(tuple(checks), relative_error=1.0 - min(measured.values()), measured=measured)


def one_sample() -> Findings:
    """One sample a pixel: the mean of many gradients is that of a quiet one, and the denoiser takes such a picture."""
    controls = {"texture": {"resolution": 8}, "environment": {"exposure": [-1.0, 1.0]}, "pose": {"y": [-0.3, 0.3]}}
    renderer = small("mug", controls)
    seen = examine(renderer, compare=False, spp=1)
    beside = compared(renderer, renderer.start, spp=1, repeats=48)
    denoised = examine(small("mug", {"texture": {"resolution": 8}}, denoise="oidn"), compare=False, spp=1)
    findings = replace(seen, compared=beside).findings(
        holds("the denoised picture and its gradient are finite", denoised.finite)
    )
    return findings


def heavy_render(count: int = SAMPLES) -> Findings:
    """Gradients of a shift at 4 samples a pixel: how heavy their tails are, and what each estimator makes of them.

    "boundary" is the estimator with the heavy tail (DESIGN 5.1), which no plan takes by itself; "secant" the plan's.
    """
    renderer = small("mug", {"pose": {"x": [-0.3, 0.3]}})
    renderer.formation = replace(renderer.formation, transfer="linear")
    loss, u = smooth_loss(renderer.formation.resolution), renderer.start
    probe = probes(renderer, loss, u, 0, 4)[0]
    wanted = reference(renderer, loss, u, probe, seed=1, spp=REFERENCE_SPP, repeats=(8, 16))
    measured, checks = {"reference": wanted.value, "noise of the reference": wanted.noise}, []
    plan = renderer.plan
    for name in ("secant", "boundary"):
        renderer.plan = plan.with_estimator({"pose.x": name}, "measured")
        samples = torch.stack([renderer.gradient(loss, u, seed, 4)[1] for seed in range(count)]).double()
        away = (samples - samples.median()).abs()
        measured[f"{name}: farthest over the median distance"] = float(away.max() / away.median())
        for how, estimator in ESTIMATORS.items():
            measured[f"{name}, {how}: bias"] = float(estimator(samples)) / wanted.value - 1.0
        spread = float(samples.std()) / abs(wanted.value)
        measured[f"{name}: noise of one gradient"] = spread
    spread = measured["secant: noise of one gradient"]
    doubt = 2.5 * math.hypot(spread / math.sqrt(count), wanted.noise / abs(wanted.value))
    off = abs(measured["secant, median of means: bias"])
    checks = [
        Check("secant, median of means: bias beyond the noise", max(0.0, off - doubt), most=0.1),
        Check(
            "secant: noise of one gradient over boundary's",
            spread / measured["boundary: noise of one gradient"],
            most=1.0,
        ),
        holds("the plan takes secant", plan.groups[0].estimator == "secant"),
    ]
    return Findings(tuple(checks), renderer.non_finite == 0, off, measured=measured)


_RULE = "every gradient is divided by the mean of its absolute values (pgd) or by a running root mean square (adam)"

CASES = (
    Case(
        "one-sample-a-pixel",
        "noise",
        "1 sample per pixel",
        "Finite; the mean of 48 gradients is right; the denoiser copes.",
        "a new seed at every step, and momentum over steps",
        one_sample,
        "texture, environment, pose",
        cheap=False,
    ),
    *(
        Case(
            f"heavy-tails-{kind}",
            "noise",
            "heavy-tailed gradients: median of means or clipping, its bias measured",
            "Median of means and clipping beat the mean; their bias and that of normalisation are known.",
            "median of means of 6 groups; clipping at 3 median lengths; normalisation",
            partial(estimators, kind),
        )
        for kind in ("symmetric", "skewed")
    ),
    *(
        Case(
            f"heavy-tailed-search-{kind}",
            "noise",
            "heavy-tailed gradients: median of means or clipping, its bias measured",
            "Nine tenths of the optimum in 100 evaluations "
            + ("with noise that has no variance." if kind == "tails" else "with one gradient 1e12 times too large."),
            _RULE,
            partial(heavy_search, kind),
        )
        for kind in ("tails", "spike")
    ),
    Case(
        "heavy-tails-of-a-moving-mesh",
        "noise",
        "heavy-tailed gradients: median of means or clipping, its bias measured",
        "The plan takes the estimator without the tail; the bias of each rule on the other is printed.",
        "the plan prefers differences of the loss for what moves a mesh",
        heavy_render,
        "pose",
        cheap=False,
    ),
)
"""Every case about noise."""
