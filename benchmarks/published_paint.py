"""A published camouflage, from your disk, beside the plain paint on the same draws.

    python benchmarks/published_paint.py --object car.obj --paint camouflage.png --label "sports car" --model net.pt2
        [--task detection] [--plain white.png] [--control pose,camera,environment] [--samples 200] [--seed 0]

    python benchmarks/published_paint.py --self-test

Papers on camouflage (RAUCA, FCA, DTA, ...) give a texture for a mesh, and mostly a detection rate on pictures of
their own. Here both paints are put on the same mesh and rendered under the same draws of pose, camera and light, with
the same noise, so each pair of pictures differs in the paint alone. Printed are how often the model is right with each,
and the difference of the two with its 95 % interval for pairs (Newcombe), as `advsearch compare` has it. Nothing of
these papers is in this repository: give the files that you have. A texture made for other texture coordinates than the
mesh's looks wrong, so look at the two pictures first that are written, RUN-plain.png and RUN-paint.png.

The self-test paints the bundled mug red and, once more, as it is, for a model that knows mugs by their blue: the first
has to be seen less often, and the second as often as the plain one, pair by pair.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor, nn

import advsearch

RANGES: dict[str, dict[str, object]] = {
    "pose": {"yaw": [0, 360]},
    "camera": {"elevation": [5, 45], "distance": [1.5, 3.0]},
    "environment": {"rotation": [0, 360]},
}
"""How far what is drawn goes; a control that is not named here, over its own whole range."""


def main() -> int:
    args = parsed()
    if args.self_test:
        return self_test()
    print(text(measured(args)))
    return 0


def parsed(words: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", help="the mesh")
    parser.add_argument("--paint", help="the published texture, a picture")
    parser.add_argument("--plain", help="the plain paint, a picture (default: what the mesh has)")
    parser.add_argument("--label", help="the labels that count as right")
    parser.add_argument("--model", default="reference", help="the network, as `advsearch attack` takes it")
    parser.add_argument("--labels", help="names of the model's classes")
    parser.add_argument("--task", default="classification", help="what the model does")
    parser.add_argument("--environment", default="studio", help="what lights the scene")
    parser.add_argument("--control", default="pose,camera,environment", help="what is drawn, separated by commas")
    parser.add_argument("--samples", type=int, default=200, help="pairs of pictures (default 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resolution", type=int, help="side of the pictures (default: what the model takes)")
    parser.add_argument("--run", default="published-paint", help="how the runs are called")
    parser.add_argument("--self-test", action="store_true")
    args = parser.parse_args(words)
    if not args.self_test and (args.object is None or args.paint is None):
        parser.error("--object and --paint are needed")
    return args


def measured(args: argparse.Namespace) -> Any:
    """Return what `advsearch.compare` says of the two paints; writes a picture of each."""
    runs = []
    for name, texture in (("plain", args.plain), ("paint", args.paint)):
        scene = advsearch.load_scene(args.object, args.environment, texture=texture)
        renderer = scene.renderer(["pose"], resolution=256)
        picture = renderer(renderer.start, seed=args.seed, spp=32).detach().numpy()
        imageio.imwrite(f"{args.run}-{name}.png", np.uint8(picture * 255.0 + 0.5))
        advsearch.sweep(
            scene,
            args.model,
            controls={one: RANGES.get(one, {}) for one in args.control.split(",")},
            samples=args.samples,
            trials=0,
            seed=args.seed,
            task=args.task,
            label=args.label,
            labels=args.labels,
            resolution=args.resolution,
            run=f"{args.run}-{name}",
            overwrite=True,
        )
        runs.append(f"{args.run}-{name}")
    return advsearch.compare(runs, pictures=0, run=f"{args.run}-compare", overwrite=True)


def text(result: Any) -> str:
    plain, paint = result.sides
    (pair,) = result.pairs
    low, high = pair.interval
    return (
        f"plain paint: right in {plain.correct} of {plain.configurations}; published paint: right in {paint.correct} "
        f"of {paint.configurations}; difference {100 * pair.difference:+.1f} points (95 % interval {100 * low:+.1f} to "
        f"{100 * high:+.1f})"
    )


class Blue(nn.Module):
    """Calls what is not red in the middle of the picture a mug."""

    def forward(self, images: Tensor) -> Tensor:
        middle = images[:, :, 12:20, 12:20].mean(dim=(2, 3))
        lead = 20.0 * (middle[:, 2] - middle[:, 0] + 0.25)
        return torch.stack([lead, -lead], dim=1)


def self_test() -> int:
    """Return 1 where the red paint is seen as often as the plain one, or its own texture is another; else 0."""
    with tempfile.TemporaryDirectory() as folder:
        place, failed = Path(folder), 0
        own = advsearch.load_scene("mug").description.object.base_color
        imageio.imwrite(place / "own.png", np.uint8(np.clip(own, 0.0, 1.0) * 255.0 + 0.5))
        imageio.imwrite(place / "red.png", np.full((8, 8, 3), (200, 30, 30), np.uint8))
        for name in ("own", "red"):
            words = ["--object", "mug", "--samples", "12", "--run", str(place / name), "--label", "mug"]
            args = parsed([*words, "--paint", str(place / f"{name}.png")])
            args.model = advsearch.load_model(Blue(), labels=["mug", "bowl"], input_size=32)
            result = measured(args)
            print(f"{name}: {text(result)}", flush=True)
            (pair,) = result.pairs
            failed += pair.difference != 0.0 if name == "own" else pair.interval[1] >= 0.0
        return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
