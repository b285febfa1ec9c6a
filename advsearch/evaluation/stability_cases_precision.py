"""32-bit numbers, many steps, several threads."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds, threads
from advsearch.attacks import Block, Domain, make_policy, search
from advsearch.attacks.projections import project_l2_box
from advsearch.evaluation.gradients import smooth_loss
from advsearch.evaluation.stability_case import Case, Check, Findings, holds
from advsearch.evaluation.stability_scene import SIZE, small
from advsearch.evaluation.stability_search import Toy
from advsearch.models import load_model
from advsearch.scene.formation import linear_to_srgb, to_8_bit

LONG = 10_000
LOGITS = 1e-3
"""Difference in logits that single precision may make: a thousandth of what noise moves a margin by (DESIGN 5.2)."""
BISECTIONS = 24


def verdicts() -> Findings:
    """The reference model in single and in double precision, on pictures on its own decision boundaries.

    Between two pictures with different answers the boundary is found by bisection in single precision; there the two
    may disagree, and what matters is how far from the boundary they still do.
    """
    model = load_model("reference")
    exact = copy.deepcopy(model.module).double()
    generator = torch.Generator().manual_seed(0)
    tones = torch.rand(12, 4, 4, 3, generator=generator).permute(0, 3, 1, 2)
    size = model.input_size
    pictures = torch.nn.functional.interpolate(tones, size=size, mode="bicubic").clamp(0.0, 1.0).permute(0, 2, 3, 1)

    def answers(images: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            x = model.preprocessing(images)
            return model.module(x), exact(x.double())

    apart, flips, farthest, pairs = 0.0, 0, 0.0, 0
    first = answers(pictures)[0].argmax(dim=1)
    for i in range(len(pictures) - 1):
        if first[i] == first[i + 1]:
            continue
        pairs += 1
        low, high = pictures[i], pictures[i + 1]
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if answers(middle[None])[0].argmax() == first[i]:
                low = middle
            else:
                high = middle
        single, double = answers(torch.stack([low, high]))
        apart = max(apart, float((single.double() - double).abs().max()))
        top = double.topk(2, dim=1).values
        wrong = single.argmax(dim=1) != double.argmax(dim=1)
        flips += int(wrong.sum())
        farthest = max(farthest, float(((top[:, 0] - top[:, 1]) * wrong).max()))
    return Findings(
        (
            Check("boundaries that were found", float(pairs), least=2.0),
            Check("largest margin at which the answers differ, logits", farthest, most=LOGITS),
            Check("largest difference of a logit", apart, most=LOGITS),
        ),
        relative_error=apart,
        measured={"answers that differ on a boundary": float(flips)},
    )


def picture_bytes() -> Findings:
    """The tone curve and the rounding to 8 bits in single and in double precision, and what that does to the model."""
    model = load_model("reference")
    radiance = 1.2 * torch.rand(*model.input_size, 3, generator=torch.Generator().manual_seed(1))
    single, double = to_8_bit(linear_to_srgb(radiance)), to_8_bit(linear_to_srgb(radiance.double()))
    levels = float((single.double() - double).abs().max()) * 255.0
    with torch.no_grad():
        apart = float((model(single) - model(double.float())).abs().max())
    other = float((single.double() != double).double().mean())
    return Findings(
        (
            Check("largest difference in 8-bit levels", levels, most=1.0 + 1e-6),
            Check("share of bytes that differ", other, most=1e-4),
            Check("what they do to a logit", apart, most=LOGITS),
        ),
        relative_error=other,
    )


def large_ball(size: int = 1_000_000) -> Findings:
    """The projection of a million numbers onto an L2 ball, its norm in double precision."""
    generator = torch.Generator().manual_seed(0)
    start = torch.rand(size, generator=generator)
    radius = 0.1 * math.sqrt(size)
    domain = Domain(start, (Block(size, "l2", radius),))
    projected = project_l2_box(start + torch.randn(size, generator=generator), start, radius, 0.0, 1.0)
    norm = float((projected.double() - start.double()).norm())
    return Findings(
        (
            Check("norm over the radius, in double precision", norm / radius, most=1.0 + 1e-5),
            Check("excess that the domain sees", domain.violation(projected), most=2e-6),
        ),
        relative_error=max(0.0, norm / radius - 1.0),
    )


def many_steps(name: str) -> Findings:
    """A search of 10,000 steps: it never leaves its budget, accumulates nothing that is wrong, and seeds never meet."""
    target = torch.full((52,), 0.8).double()
    domain = Domain(
        torch.full((52,), 0.3), (Block(1, name="box"), Block(1, periodic=True, name="angle"), Block(50, "l2", 1.0))
    )
    best = domain.project(target.float())

    def value(u: Tensor) -> Tensor:
        turned = torch.cos((u[1] - target[1]) * 2.0 * math.pi)
        return turned - (u[0] - target[0]).square() - (u[2:] - target[2:]).square().mean()

    times: list[float] = []
    begun = time.perf_counter()
    result = search(
        Toy(value, domain),
        domain,
        make_policy(name),
        steps=LONG,
        seed=0,
        candidates=0,
        on_step=lambda record, u, found: times.append(time.perf_counter()),
    )
    gap = float(value(best.double())) - result.best_objective
    late, early = times[-1] - times[-LONG // 5], times[LONG // 5] - begun
    return Findings(
        (
            Check("evaluations", float(len(result.history)), LONG, LONG),
            Check("distance outside the budget", domain.violation(result.best_u), most=2e-6),
            Check("gap to the optimum", gap, most=1e-3),
            Check("steps that were not finite", float(result.non_finite_objectives), 0.0, 0.0),
        ),
        bool(torch.isfinite(result.best_u).all()),
        gap,
        result.ending.value,
        {"time of the last fifth over the first": late / early},
    )


def accumulation() -> Findings:
    """10,000 small steps of an angle around its circle, in single against double precision, and 10,000 seeds."""
    domain = Domain(torch.zeros(1), (Block(1, periodic=True, name="angle"),))
    u, exact, step = torch.zeros(1), 0.0, 0.000_731
    for _ in range(LONG):
        u = domain.project(u + step)
        exact = (exact + step) % 1.0
    drift = abs(float(u) - exact)
    drift = min(drift, 1.0 - drift)
    different = len({seeds.stream(0, "search", index) for index in range(LONG)})
    return Findings(
        (
            Check("drift of the angle, in turns", drift, most=1e-3),
            Check("different seeds of 10,000 steps", float(different), least=LONG - 1),
        ),
        relative_error=drift,
    )


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Give Dr.Jit and torch a number of threads for a while."""
    import drjit

    before, torchs = drjit.thread_count(), torch.get_num_threads()
    threads.configure(count, rendering=False)
    try:
        yield
    finally:
        threads.configure(before)
        torch.set_num_threads(torchs)


def one_and_two_threads() -> Findings:
    """A picture, a denoised one, an adjoint and differences, with one thread and with two."""
    loss = smooth_loss((SIZE, SIZE))
    renderers = {
        "raw": small("mug", {"texture": {"resolution": 16}}),
        "denoised": small("mug", {"pose": {"x": [-0.3, 0.3]}}, denoise="oidn"),
    }
    found: dict[int, dict[str, Tensor]] = {}
    for count in (1, 2):
        with _threads(count):
            found[count] = {}
            for name, renderer in renderers.items():
                with torch.no_grad():
                    found[count][name] = renderer(renderer.start, 0, 8)
                found[count][f"{name} gradient"] = renderer.gradient(loss, renderer.start, 0, 8)[1]
    with _threads(1):
        again = renderers["raw"].gradient(loss, renderers["raw"].start, 0, 8)[1]
    adjoints = found[1]["raw gradient"], found[2]["raw gradient"]
    error = float((adjoints[0] - adjoints[1]).abs().max() / adjoints[0].abs().max())
    return Findings(
        (
            *(
                holds(f"{name}: the same bits with 1 and 2 threads", torch.equal(found[1][name], found[2][name]))
                for name in ("raw", "denoised", "denoised gradient")
            ),
            holds("adjoint: the same bits each time with 1 thread", torch.equal(again, adjoints[0])),
            Check("adjoint: relative difference between 1 and 2 threads", error, most=1e-5),
        ),
        relative_error=error,
    )


CASES = (
    Case(
        "verdicts-in-single-precision",
        "precision",
        "single against double where the difference can change a verdict",
        "The model's answers in single and double precision differ only where the margin is under 0.001 logits.",
        "20 trials with fresh noise, which moves margins a thousand times more",
        verdicts,
    ),
    Case(
        "bytes-in-single-precision",
        "precision",
        "single against double where the difference can change a verdict",
        "The 8-bit picture is the same but for ties, and the model does not notice.",
        "values on the edge of two levels take either",
        picture_bytes,
    ),
    Case(
        "ball-of-a-million-numbers",
        "precision",
        "single against double where the difference can change a verdict",
        "A projection in single precision lies inside the ball in double precision.",
        "Domain.TOLERANCE: 2e-6 of the radius",
        large_ball,
    ),
    *(
        Case(
            f"ten-thousand-steps-{name}",
            "precision",
            "accumulation over 10,000 steps",
            "The search stays inside its budget and at its peak.",
            "momentum forgets; each step is projected anew",
            partial(many_steps, name),
            cheap=False,
        )
        for name in ("pgd", "adam")
    ),
    Case(
        "ten-thousand-turns",
        "precision",
        "accumulation over 10,000 steps",
        "An angle that goes round in small steps does not drift, and no two steps have one seed.",
        "wrapped at every step, so it stays small",
        accumulation,
    ),
    Case(
        "one-and-two-threads",
        "precision",
        "determinism under 1 and 2 threads",
        "Pictures and differences have the same bits; an adjoint differs in its last ones, with one thread in none.",
        "box filter; --deterministic takes one thread",
        one_and_two_threads,
        "texture, pose",
    ),
)
"""Every case about arithmetic."""
