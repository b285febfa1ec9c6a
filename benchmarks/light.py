"""Light as the attack: gradients of a projector's pattern in five scenes, a step by its
matrix, a stop sign at dusk.

    python benchmarks/light.py gradients [--size 64]
    python benchmarks/light.py step [--object mug] [--environment studio] [--model
        reference] [--label mug]
    python benchmarks/light.py sign --model ssd.pt2 --labels ssd.labels.json [--lumens 3000]
        [--steps 60]
    python benchmarks/light.py shadow --object bowl --environment sky --steps 150

- `gradients`: derivatives by the adjoint along smooth patterns beside central
  differences with other seeds and four times the samples: the cosine of both, and the
  ratio of their lengths.
- `step`: a search step by the matrix, and a rendered one, over the model's own forward
  and backward pass; then the same attack by both, in seconds, with the verified margin.
- `sign`: a detector that no longer finds a stop sign at dusk under a projector 5 m
  away: verified, random beside it, and in which ambient light it ends. The model is not
  part of this repository.
- `shadow`: an object under a clear sky, or in an environment, that a model gets wrong
in a shadow; random beside it.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from advsearch import threads

threads.configure()

import transport

import advsearch
from advsearch.controls import make_control
from advsearch.questions.attack.result import AttackResult
from advsearch.runs.files import to_8bit
from advsearch.scene.renderer import Renderer

SCENES = (
    ("mug", "studio"),
    ("bowl", "kitchen"),
    ("bottle", "noon"),
    ("stop-sign", "avenue-dusk"),
    ("car", "street"),
)
SIDE = 64
"""Texels along the pattern."""
DIRECTIONS = 8
SEEDS = 4
SPP = 64
CARD = {
    "size": [0, 1],
    "distance": 1,
    "x": [-0.6, 0.6],
    "y": [-0.6, 0.6],
    "turn": [0, 360],
    "radii": [0.1, 1],
}
SKY = {"elevation": 30, "azimuth": 20, "turbidity": 2}
SIGN = {
    "camera.azimuth": 10.0,
    "camera.height": 1.4,
    "camera.distance": 5.0,
    "camera.fov": 25.0,
}
GREY: dict[str, Any] = {"start": "grey"}


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("part", choices=("gradients", "step", "sign", "shadow"))
    parser.add_argument("--object", default="mug")
    parser.add_argument("--environment", default="studio")
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--label", default="mug")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--lumens", type=float, default=3000.0)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--picture", help="file for the pictures of the sign, side by side"
    )
    args = parser.parse_args()
    if args.part == "gradients":
        for object, environment in SCENES:
            scene = advsearch.load_scene(object, environment)
            cosine, ratio = compared(
                scene.renderer([make_control("projector", GREY)], resolution=args.size)
            )
            print(
                f"{object:10s} {environment:12s} cosine {cosine:.4f}, length "
                f"{ratio:.3f}",
                flush=True,
            )
    elif args.part == "step":
        step(args)
    elif args.part == "sign":
        sign(args)
    else:
        shadow(args)


def smooth(seed: int) -> Tensor:
    """A random pattern (SIDE, SIDE, 3) of blocks of 16 x 16 texels."""
    blocks = torch.randn(
        SIDE // 16, SIDE // 16, 3, generator=torch.Generator().manual_seed(seed)
    )
    return blocks.repeat_interleave(16, 0).repeat_interleave(16, 1)


def compared(renderer: Renderer) -> tuple[float, float]:
    """Return the cosine of derivatives by the adjoint with those by differences, along
    smooth patterns, and the ratio of their lengths.
    """
    scene = renderer.scene
    inputs = scene.assembly(renderer.space.inputs(renderer.start))
    pattern = inputs["projector.pattern"]
    name = "projector.pattern"
    height, width = renderer.formation.resolution
    weight = torch.randn(
        1, 3, height, width, generator=torch.Generator().manual_seed(1)
    )
    weight = F.avg_pool2d(weight, 9, 1, 4)[0].permute(1, 2, 0)
    gradient = (
        sum(
            scene.render_adjoint(inputs, weight, seed, SPP, wrt=[name])[name]
            for seed in range(SEEDS)
        )
        / SEEDS
    )
    ours = []
    theirs = []
    for number in range(DIRECTIONS):
        change = 0.25 * pattern.mean() * smooth(number)
        ours.append((gradient * change).sum())
        ends = [{**inputs, name: pattern + sign * change} for sign in (-0.5, 0.5)]
        low, high = (
            torch.stack(
                [
                    (scene.render_radiance(one, 100 + seed, 4 * SPP) * weight).sum()
                    for seed in range(SEEDS)
                ]
            ).mean()
            for one in ends
        )
        theirs.append(high - low)
    a = torch.stack(ours)
    b = torch.stack(theirs)
    return float(F.cosine_similarity(a, b, dim=0)), float(a.norm() / b.norm())


def step(args: argparse.Namespace) -> None:
    """Print what a step takes, and the same attack by the matrix and by rendering each
    step.
    """
    model = advsearch.load_model(args.model, labels=args.labels)
    right = model.label_set(args.label).indices[0]
    scene = advsearch.load_scene(args.object, args.environment)
    renderer = scene.renderer(
        [make_control("projector", GREY)], resolution=model.input_size
    )
    print(
        f"{args.object} in {args.environment}, {model.name}; medians of {args.repeats}"
    )
    transport.times(renderer, lambda picture: -model(picture)[0, right], args.repeats)
    for title, specialise in (("by the matrix", True), ("rendered", False)):
        begun = time.perf_counter()
        result = advsearch.attack(
            scene, model, controls={"projector": {"epsilon": 0.3}}, steps=args.steps, label=args.label,
            specialise=specialise, measure="no", baseline=False, trials=6,
        )  # fmt: skip
        searched = result.summary.seconds["search"] + result.summary.seconds.get(
            "transport", 0.0
        )
        rated = result.summary.verified
        print(
            f"  {args.steps} steps {title}: search {searched:.1f} s of "
            f"{time.perf_counter() - begun:.1f} s, "
            f"{result.summary.ending}, margin "
            f"{rated.margin if rated else float('nan'):.2f}", flush=True,
        )  # fmt: skip


def sign(args: argparse.Namespace) -> None:
    """Print what a detector sees of the sign."""
    model = advsearch.load_model(args.model, labels=args.labels, task="detection")
    scene = advsearch.load_scene("stop-sign", "avenue-dusk", settings=SIGN)
    settings = {"distance": 5, "lumens": args.lumens, "black": 0.001}
    result = advsearch.attack(
        scene,
        model,
        task="detection",
        controls={"projector": settings},
        steps=args.steps,
        run="runs/light-sign",
    )
    summary = result.summary
    print(
        f"{args.lumens:g} lumens: {summary.ending}, {summary.brief}; random search "
        f"{summary.baseline}"
    )
    if args.picture:
        strip(result).save(args.picture, optimize=True)
    if summary.ambient is not None:
        for point in summary.ambient.points:
            print(
                f"  {point.lux:8.3g} lux: {point.verified.successes} of "
                f"{point.verified.trials}"
            )
        print(
            f"  up to {summary.ambient.holds_to:.3g} lux, not at "
            f"{summary.ambient.ends_at} lux"
        )


def shadow(args: argparse.Namespace) -> None:
    """Print what a model sees of an object in a shadow."""
    sky = args.environment == "sky"
    low = {"environment.rotation": -30.0} if args.environment == "low-sun" else {}
    result = advsearch.attack(
        advsearch.load_scene(
            args.object, None if sky else args.environment, settings=low
        ),
        advsearch.load_model(args.model, labels=args.labels),
        controls={"shadow": CARD, **({"sky": SKY} if sky else {})},
        label=args.label.split(",") if args.model != "reference" else None,
        resolution=96 if args.model == "reference" else None,
        steps=args.steps,
    )
    summary = result.summary
    labels = None if summary.verified is None else summary.verified.labels
    print(
        f"{args.object}, {args.environment}: {summary.ending}, {summary.brief} "
        f"{labels}; random {summary.baseline}"
    )


def strip(result: AttackResult) -> Image.Image:
    """Return the clean scene, the adversarial one and the pattern side by side."""
    side = len(result.clean)
    gap = np.full((side, 6, 3), 255, np.uint8)
    pattern = Image.fromarray(to_8bit(result.artifacts["projector"])).resize(
        (side, side), Image.Resampling.NEAREST
    )
    parts = [
        to_8bit(result.clean),
        gap,
        to_8bit(result.adversarial),
        gap,
        np.asarray(pattern),
    ]
    # noise makes a large file otherwise
    return Image.fromarray(np.concatenate(parts, axis=1)).quantize(96)


if __name__ == "__main__":
    main()
