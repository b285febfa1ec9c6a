"""Searching textures by a matrix of light transport: a step, what the matrix costs, and
how far its pictures are off.

    python benchmarks/transport.py [--object mug] [--environment studio] [--model reference]
        [--label mug] [--repeats 5]

Each figure is the median of turns that are taken one after the other in one process; of
steps by the matrix and the
model alone, of the ratio of their processor time in each turn, which other programs disturb least:

- a step (picture, model, derivative) by the matrix, and by rendering and the adjoint,
  over the model's forward and backward pass alone;
- making the matrix, in rendered steps;
- the error of a predicted change of the picture within epsilon 0.1 (levels of 255, root
  mean square): random signs, and the whole texture lighter and darker. The reference is
  traced without the denoiser, which smooths random signs away, and the same noise is in
  both of its pictures; beside the error stands what of it is the reference's own noise.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from advsearch import threads

threads.configure()

from advsearch.engine.loading import load_scene
from advsearch.models import load_model
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import LinearRenderer

EPSILON = 0.1
SPP = 8
QUICK = 20
TRACED = 512
HALVES = 2


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--object", default="mug")
    parser.add_argument("--environment", default="studio")
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--label", default="mug")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    model = load_model(args.model, labels=args.labels)
    right = model.label_set(args.label).indices[0]
    size = model.input_size
    renderer = load_scene(args.object, args.environment).renderer(
        ["texture"], resolution=(size[0], size[1])
    )

    def loss(picture: Tensor) -> Tensor:
        score: Tensor = -model(picture)[0, right]
        return score

    print(
        f"{args.object} in {args.environment}, {model.name}, {size[0]} x {size[1]}; "
        f"medians of {args.repeats}"
    )
    times(renderer, loss, args.repeats)
    errors(renderer)


def times(renderer: Renderer, loss: Callable[[Tensor], Tensor], repeats: int) -> None:
    """Print what a step and a matrix take."""
    linear = LinearRenderer(renderer, renderer.start, seed=1)
    still = renderer(renderer.start, seed=0, spp=SPP).detach()
    u = changed(renderer, "signs")

    def alone() -> None:
        loss(still.clone().requires_grad_()).backward()

    turns: dict[str, Callable[[], object]] = {
        "model": alone,
        "matrix": lambda: linear.renderer.gradient(loss, u, 0, SPP),
        "rendered": lambda: renderer.gradient(loss, u, 0, SPP),
        "making": lambda: LinearRenderer(renderer, renderer.start, seed=2),
    }
    seconds: dict[str, list[float]] = {name: [] for name in turns}
    busy: dict[str, list[float]] = {name: [] for name in turns}
    # what takes milliseconds is looked at more often
    for turn in range(QUICK * repeats + 1):
        for name in (
            ("model", "matrix", "rendered", "making")
            if turn <= repeats
            else ("model", "matrix")
        ):
            begun = time.perf_counter()
            spent = time.process_time()
            turns[name]()
            if turn:
                seconds[name].append(time.perf_counter() - begun)
                busy[name].append(time.process_time() - spent)
    middle = {name: statistics.median(found) for name, found in seconds.items()}
    each = [by / alone for alone, by in zip(busy["model"], busy["matrix"], strict=True)]
    low, ratio, high = statistics.quantiles(each, n=4)
    print(
        f"  a step by the matrix, over the model alone       {ratio:8.2f} (quartiles "
        f"{low:.2f} to {high:.2f})"
    )
    print(
        "  a rendered step, over the model alone            "
        f"{middle['rendered'] / middle['model']:8.2f}"
    )
    print(
        "  making the matrix, in rendered steps             "
        f"{middle['making'] / middle['rendered']:8.2f}"
    )
    print(f"  entries {linear.n_entries:,}, {linear.n_bytes / 2**20:.0f} MiB")


def errors(renderer: Renderer) -> None:
    """Print how far predicted changes are off."""
    linear = LinearRenderer(renderer, renderer.start, seed=1)
    undenoised = renderer.copy_with(denoiser="none")

    def traced(u: Tensor, seed: int) -> Tensor:
        """Radiance of `TRACED` samples."""
        return torch.stack(
            [
                undenoised.radiance(u, 1000 * seed + part, 128)
                for part in range(TRACED // 128)
            ]
        ).mean(0)

    with torch.no_grad():
        display = renderer.formation.map_to_display
        start = renderer.start
        before = [traced(start, half) for half in range(HALVES)]
        for kind in ("signs", "lighter", "darker"):
            u = changed(renderer, kind)
            after = [traced(u, half) for half in range(HALVES)]
            halves = [
                display(one) - display(other)
                for one, other in zip(after, before, strict=True)
            ]
            change = display(torch.stack(after).mean(0)) - display(
                torch.stack(before).mean(0)
            )
            off = levels(linear(u) - linear(start), change)
            noise = levels(halves[0], halves[1]) / 2.0
            size = levels(change, torch.zeros_like(change))
            print(
                f"  {kind:8s} predicted change off by {off:5.2f} levels (noise "
                f"{noise:.2f}) of {size:5.2f}"
            )


def changed(renderer: Renderer, kind: str) -> Tensor:
    """A texture `EPSILON` of display-referred sRGB from the start."""
    signs = (
        torch.randint(
            0, 2, renderer.start.shape, generator=torch.Generator().manual_seed(0)
        )
        * 2.0
        - 1.0
    )
    way = {
        "signs": signs,
        "lighter": torch.ones_like(signs),
        "darker": -torch.ones_like(signs),
    }[kind]
    return (renderer.start + EPSILON * way).clamp(0.0, 1.0)


def levels(one: Tensor, other: Tensor) -> float:
    """Root mean square difference in levels of 255."""
    return 255.0 * float(((one - other) ** 2).mean().sqrt())


if __name__ == "__main__":
    main()
