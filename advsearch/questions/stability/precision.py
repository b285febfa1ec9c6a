"""32-bit numbers, many steps, several threads."""

from __future__ import annotations

import copy
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch import seeds, threads
from advsearch.attacks import Block, Domain, make_policy, search
from advsearch.attacks.domain import project_l2_box
from advsearch.attacks.evaluation import one_thread
from advsearch.engine.gradients import smooth_loss
from advsearch.models import load_model
from advsearch.questions.stability.scene import SIZE, CaseGroup, Check, ControlSettings, Outcome, Toy, holds, small
from advsearch.registry import OWN_FOLDER
from advsearch.scene.assets import Floats
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.formation import to_8_bit

LONG = 10_000
BITS = 1e-5
"""Difference that is one of the last bits: a 400th of an 8-bit level."""
MOVES = 40
"""Pictures of a moved mesh that are compared: that their last bits differ is a matter of chance."""
LOGITS = 1e-3
"""Difference in logits that single precision may make: a thousandth of what noise moves a margin by."""
BISECTIONS = 24
TEXTURE: ControlSettings = {"texture": {"resolution": 16}}
SHIFT: ControlSettings = {"pose": {"x": [-0.3, 0.3]}}

PRECISION = CaseGroup("precision")


@PRECISION.case("verdicts-in-single-precision", "20 trials with fresh noise, which moves margins a thousand times more")
def verdicts() -> Outcome:
    """The model's answers in single and double precision differ only where the margin is under 0.001 logits.

    Between two pictures with different answers the boundary is found by bisection in single precision; there the two
    may disagree, and what matters is how far from the boundary they still do.
    """
    model = load_model("reference")
    exact: Any = copy.deepcopy(model.module)
    exact = exact.double()
    generator = torch.Generator().manual_seed(0)
    tones = torch.rand(12, 4, 4, 3, generator=generator).permute(0, 3, 1, 2)
    size = model.input_size
    pictures = torch.nn.functional.interpolate(tones, size=size, mode="bicubic").clamp(0.0, 1.0).permute(0, 2, 3, 1)

    def answers(images: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad(), one_thread():
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
    return Outcome(
        Check("boundaries that were found", float(pairs), least=2.0),
        Check("largest margin at which the answers differ, logits", farthest, most=LOGITS),
        Check("largest difference of a logit", apart, most=LOGITS),
        relative_error=apart,
        measured={"answers that differ on a boundary": float(flips)},
    )


@PRECISION.case("bytes-in-single-precision", "values on the edge of two levels take either")
def picture_bytes() -> Outcome:
    """The 8-bit picture is the same but for ties, and the model does not notice."""
    model = load_model("reference")
    radiance = 1.2 * torch.rand(*model.input_size, 3, generator=torch.Generator().manual_seed(1))
    single, double = to_8_bit(linear_to_srgb(radiance)), to_8_bit(linear_to_srgb(radiance.double()))
    off = ((single.double() - double) * 255.0).abs().round()
    with torch.no_grad():
        apart = float((model(single) - model(double.float())).abs().max())
    other = float((off > 0.0).double().mean())
    return Outcome(
        Check("largest difference in 8-bit levels", float(off.max()), most=1.0),
        Check("share of bytes that differ", other, most=1e-4),
        Check("what they do to a logit", apart, most=LOGITS),
        relative_error=other,
    )


@PRECISION.case("ball-of-a-million-numbers", "Domain.TOLERANCE: 2e-6 of the radius")
def large_ball(size: int = 1_000_000) -> Outcome:
    """A projection in single precision lies inside the ball in double precision."""
    generator = torch.Generator().manual_seed(0)
    start = torch.rand(size, generator=generator)
    radius = 0.1 * math.sqrt(size)
    domain = Domain(start, (Block(size, "l2", radius),))
    projected = project_l2_box(start + torch.randn(size, generator=generator), start, radius, 0.0, 1.0)
    norm = float((projected.double() - start.double()).norm())
    return Outcome(
        Check("norm over the radius, in double precision", norm / radius, most=1.0 + 1e-5),
        Check("excess that the domain sees", domain.violation(projected), most=2e-6),
        relative_error=max(0.0, norm / radius - 1.0),
    )


def many_steps(name: str) -> Outcome:
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

    def note(record: object, u: Tensor, found: object) -> None:
        times.append(time.perf_counter())

    policy = make_policy(name)
    result = search(partial(map, Toy(value, domain)), domain, policy, steps=LONG, seed=0, candidates=0, on_step=note)
    gap = float(value(best.double())) - result.best_objective
    late, early = times[-1] - times[-LONG // 5], times[LONG // 5] - begun
    return Outcome(
        Check("evaluations", float(len(result.history)), LONG, LONG),
        Check("distance outside the budget", domain.violation(result.best_u), most=2e-6),
        Check("gap to the optimum", gap, most=1e-3),
        Check("steps that were not finite", float(result.non_finite_objectives), 0.0, 0.0),
        finite=bool(torch.isfinite(result.best_u).all()),
        relative_error=gap,
        ending=result.ending.value,
        measured={"time of the last fifth over the first": late / early},
    )


for name in ("pgd", "adam"):
    PRECISION.case(
        f"ten-thousand-steps-{name}",
        "momentum forgets; each step is projected anew",
        holds="The search stays inside its budget and at its peak.",
        cheap=False,
    )(partial(many_steps, name))


@PRECISION.case("ten-thousand-turns", "wrapped at every step, so it stays small")
def accumulation() -> Outcome:
    """An angle that goes round in small steps does not drift, and no two steps have one seed."""
    domain = Domain(torch.zeros(1), (Block(1, periodic=True, name="angle"),))
    u, exact, step = torch.zeros(1), 0.0, 0.000_731
    for _ in range(LONG):
        u = domain.project(u + step)
        exact = (exact + step) % 1.0
    drift = abs(float(u) - exact)
    drift = min(drift, 1.0 - drift)
    different = len({seeds.stream(0, "search", index) for index in range(LONG)})
    return Outcome(
        Check("drift of the angle, in turns", drift, most=1e-3),
        Check("different seeds of 10,000 steps", float(different), least=LONG - 1),
        relative_error=drift,
    )


def rendered(path: str, count: int) -> None:
    """Render with so many threads of Dr.Jit and save what comes out in an .npz file; run in a process of its own."""
    threads.configure(count)
    loss = smooth_loss((SIZE, SIZE))
    raw, denoised = small("mug", TEXTURE), small("mug", SHIFT, denoise="oidn")
    with torch.no_grad():
        found = {"raw": raw(raw.start, 0, 8), "denoised": denoised(denoised.start, 0, 8)}
        places = torch.linspace(0.1, 0.9, MOVES)
        found["moved"] = torch.stack([denoised(place[None], 0, 8) for place in places])
    found["adjoint"], found["again"] = (raw.gradient(loss, raw.start, 0, 8)[1] for _ in range(2))
    np.savez(path, allow_pickle=False, **{name: one.numpy() for name, one in found.items()})


@PRECISION.case("one-and-two-threads", "box filter; `deterministic` takes one thread", "texture, pose", cheap=False)
def one_and_two_threads() -> Outcome:
    """The same bits every time with one thread; with two, adjoints may differ in the last.

    A moved mesh is sorted anew by all threads, which could decide which of two triangles a ray meets on their common
    edge (seen in no picture so far); so the limit is `BITS` there.
    """
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for number, count in enumerate((1, 1, 2)):
            path = str(Path(folder) / f"{number}.npz")
            status, said = _in_a_process(f"from {__name__} import rendered; rendered({path!r}, {count})")
            if status:
                return Outcome(Check(f"exit status with {count} threads ({said})", float(status), 0.0, 0.0))
            with np.load(path) as arrays:
                found.append(dict(arrays))
    one, again, two = found
    moved = float(np.abs(one["moved"] - two["moved"]).max())
    error = float(np.abs(one["adjoint"] - two["adjoint"]).max() / np.abs(one["adjoint"]).max())
    return Outcome(
        *(holds(f"{name}: the same bits with 1 thread each time", _equal(one[name], again[name])) for name in one),
        holds("adjoint: the same bits each time with 1 thread", _equal(one["adjoint"], one["again"])),
        *(
            holds(f"{name}: the same bits with 1 and 2 threads", _equal(one[name], two[name]))
            for name in ("raw", "denoised")
        ),
        Check("adjoint: relative difference between 1 and 2 threads", error, most=BITS),
        Check("pictures of a moved mesh: largest difference between 1 and 2 threads", moved, most=BITS),
        finite=all(bool(np.isfinite(array).all()) for made in found for array in made.values()),
        relative_error=error,
        measured={"moved mesh, 1 against 2 threads": moved, "adjoint, 1 against 2 threads": error},
    )


def _equal(one: Floats, other: Floats) -> bool:
    return bool((one == other).all())


def changed_threads(counts: Sequence[int] = (2, 1, 2, 1, 2, 1)) -> None:
    """Render a scene again and again while the number of threads changes; run in a process of its own."""
    threads.configure(counts[0])
    renderer = small("mug", SHIFT)
    for count in counts:
        threads.configure(count)
        with torch.no_grad():
            renderer(renderer.start, 0, 8)


@PRECISION.case(
    "threads-change-under-a-scene",
    "a recorded kernel is made anew when the number of threads changes",
    "pose",
    cheap=False,
)
def threads_under_a_scene() -> Outcome:
    """Changing the number of threads while a scene is in use does not end the process."""
    status, said = _in_a_process(f"from {__name__} import changed_threads; changed_threads()")
    return Outcome(
        Check("exit status of the process" + (f" ({said})" if said else ""), float(status), 0.0, 0.0),
        ending="survived" if status == 0 else "crashed",
    )


def _in_a_process(code: str) -> tuple[int, str]:
    """Run Python code in a process of its own; return its exit status and the last line of its errors."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, cwd=OWN_FOLDER)
    lines = done.stderr.strip().splitlines()
    return done.returncode, lines[-1][:80] if done.returncode and lines else ""
