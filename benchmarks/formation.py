"""How much the noise of rendering moves a model's margin, with and without the denoiser: the ground for the default.

    python benchmarks/formation.py [--seeds 6] [--object mug] [--environment studio] [--model reference] [--label mug]
                                   [--labels FILE] [--up y]

For each formation and sample count: the mean margin of the right label over the rest (logits), its drift from the
margin at the highest sample count of the same formation, the standard deviation over seeds, and the time of a render
over the time of a raw render with as many samples. A search at a sample count is honest where drift and deviation are
small."""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from advsearch import threads

threads.configure()

from advsearch.attacks import margin  # noqa: E402
from advsearch.engine.loading import load_scene  # noqa: E402
from advsearch.models import load_model  # noqa: E402

COUNTS = (4, 8, 16, 64, 256)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", default="mug")
    parser.add_argument("--environment", default=None)
    parser.add_argument("--up", default=None)
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels", default=None)
    parser.add_argument("--label", default=None)
    parser.add_argument("--seeds", type=int, default=6, help="renders of each kind (default 6)")
    args = parser.parse_args()
    scene = load_scene(args.object, args.environment, up=args.up)
    model = load_model(args.model, labels=args.labels)
    right = model.label_set(args.label or scene.description.object.label or args.object).indices
    print(f"{args.object}, {model.name}, {model.input_size[0]} pixels: logits of the right label over the rest")
    print("  formation  samples   margin    drift   deviation   time over raw")
    table: dict[tuple[str, int], list[float]] = {}
    over_raw: dict[tuple[str, int], float] = {}
    raw_seconds: dict[int, float] = {}
    for denoise in ("none", "oidn"):
        render = scene.renderer("texture", resolution=model.input_size, denoise=denoise)
        for spp in COUNTS:
            values, seconds = [], []
            for seed in range(-1, args.seeds):
                begun = time.perf_counter()
                with torch.no_grad():
                    picture = render(render.start, seed=seed + 1, spp=spp)
                seconds.append(time.perf_counter() - begun)
                logits = model(picture)
                if seed >= 0:
                    values.append(-float(margin(logits, picture[None], right)[0]))
            table[denoise, spp] = values
            middle = statistics.median(seconds[1:])
            raw_seconds.setdefault(spp, middle)
            over_raw[denoise, spp] = middle / raw_seconds[spp]
        settled = statistics.mean(table[denoise, COUNTS[-1]])
        for spp in COUNTS:
            values = table[denoise, spp]
            mean = statistics.mean(values)
            print(
                f"  {denoise:9s}  {spp:7d}   {mean:6.2f}   {mean - settled:6.2f}   {statistics.stdev(values):9.2f}"
                f"   {over_raw[denoise, spp]:13.2f}"
            )


if __name__ == "__main__":
    main()
