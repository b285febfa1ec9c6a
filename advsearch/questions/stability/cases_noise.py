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
from advsearch.engine.gradients import probes, reference, smooth_loss
from advsearch.questions.stability.case import CaseGroup, Check, Outcome, Toy, holds
from advsearch.questions.stability.scene import REFERENCE_SPP, ControlSettings, compared, examine_gradient, small

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

GROUP = CaseGroup("noise")
_RULE = (
    "outliers are clipped: elements at 3 medians in an l-infinity ball and 10 in an l2 ball, the whole gradient at 3 "
    "medians of the latest lengths"
)


def plain_mean(samples: Tensor) -> Tensor:
    """The mean."""
    return samples.mean(dim=-2)


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


def estimators(kind: str) -> Outcome:
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
    checks = [
        Check(f"{name}: error, its bias included, over that of the mean", errors[name] / errors["mean"], most=0.7)
        for name in ("median of means", "clipping")
    ]
    if kind == "symmetric":  # a skewed distribution has a bias whatever is done; it is printed
        checks.append(Check("median of means: bias", measured["median of means: bias"], most=0.02))
        checks.append(Check("normalisation: cosine of its mean with the truth", cosine, least=0.99))
    return Outcome(
        tuple(checks),
        relative_error=measured["median of means: bias"],
        measured=measured,
    )


for kind in ("symmetric", "skewed"):
    GROUP.case(
        f"heavy-tails-{kind}",
        "Median of means and clipping beat the mean; their bias and that of normalisation are known.",
        "median of means of 6 groups; clipping at 3 median lengths; normalisation",
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
    return Outcome(tuple(checks), relative_error=error, measured=measured)


for kind, result in (
    ("elements", "the result with gaussian noise of the same median, with a heavy tail in every element."),
    ("lengths", "the result with gaussian noise of the same median, with a heavy tail in its size."),
    ("spike", "the optimum, with one gradient 1e12 times too large."),
):
    GROUP.case(f"heavy-tailed-search-{kind}", "Within 1.25 of " + result, _RULE)(partial(heavy_search, kind))


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
        return _noise("symmetric", (size,), generator).float()
    return normal * float(_noise("symmetric", (1,), generator).abs()) if kind == "lengths" else normal


@GROUP.case(
    "one-sample-a-pixel",
    "Finite; the mean of 48 gradients is right; the denoiser copes.",
    "a new seed at every step, and momentum over steps",
    "texture, environment, pose",
    cheap=False,
)
def one_sample() -> Outcome:
    """One sample a pixel: the mean of many gradients is that of a quiet one, and the denoiser takes such a picture."""
    controls: ControlSettings = {
        "texture": {"resolution": 8},
        "environment": {"exposure": [-1.0, 1.0]},
        "pose": {"y": [-0.3, 0.3]},
    }
    renderer = small("mug", controls)
    seen = examine_gradient(renderer, compare=False, spp=1)
    beside = compared(renderer, renderer.start, spp=1, repeats=48)
    denoised = examine_gradient(small("mug", {"texture": {"resolution": 8}}, denoise="oidn"), compare=False, spp=1)
    findings = replace(seen, compared=beside).findings(
        holds("the denoised picture and its gradient are finite", denoised.finite)
    )
    return findings


@GROUP.case(
    "heavy-tails-of-a-moving-mesh",
    "The plan takes differences of the loss for what moves a mesh, which have no heavy tail.",
    "the plan prefers differences of the loss for what moves a mesh",
    "pose",
    cheap=False,
)
def heavy_render(count: int = SAMPLES) -> Outcome:
    """Gradients of a shift at 4 samples a pixel: how heavy their tails are, and what each rule makes of them."""
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
    return Outcome(checks, bad == 0, off, measured=measured)
