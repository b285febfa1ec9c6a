"""How far motion blur is off, by the number of moments that it is averaged of, told apart from the noise of samples.

    python benchmarks/moments.py [--size 48] [--shutter 0.15] [--spp 2048]

The bundled mug on an orbit of two seconds, without the denoiser, against the mean of 512 moments. With pictures a, b of
as many moments and references r, s, each of its own noise, the mean of (a - r) (b - s) is the square of what the
moments are off; the mean of (a - b)^2 / 2 is that of the noise of one picture. Both are printed as levels of 255.
"""

from __future__ import annotations

import argparse
import math

from advsearch import threads

threads.configure(1)

import torch  # noqa: E402
from torch import Tensor  # noqa: E402

from advsearch import seeds  # noqa: E402
from advsearch.controls import compose  # noqa: E402
from advsearch.controls.path import PathControl  # noqa: E402
from advsearch.engine.loading import make_renderer  # noqa: E402
from advsearch.scene.description import describe  # noqa: E402
from advsearch.scene.formation import Moment, moments_of  # noqa: E402

SECONDS, MIDDLE = 2.0, 0.9
COUNTS, REFERENCE = (1, 2, 4, 8, 16, 32, 64), 512


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=48, help="height and width in pixels")
    parser.add_argument("--shutter", type=float, default=0.15, help="seconds")
    parser.add_argument("--spp", type=int, default=2048, help="samples of a pixel, over all moments")
    given = parser.parse_args()
    scene = describe("mug")
    space = compose([PathControl(path="orbit", seconds=SECONDS, time=MIDDLE, shutter=given.shutter)], scene)
    renderer = make_renderer(scene, space, given.size, "none", 0)
    print(f"{len(renderer.moments)} moments are taken by default: half a pixel from one to the next, 8 to 64 of them")

    def blurred(count: int, seed: int) -> Tensor:
        offsets, rows, samples = moments_of(given.shutter, 0.0, given.size, count)
        each = zip(offsets, rows, strict=True)
        renderer.moments = tuple(Moment(space.later(float(at)), one, samples) for at, one in each)
        with torch.no_grad():
            picture: Tensor = 255.0 * renderer(renderer.start, seeds.stream(0, "blur", seed), given.spp)
        return picture

    first, second = blurred(REFERENCE, 0), blurred(REFERENCE, 1)
    print(f"| moments | samples each | moments are off by | noise |\n|{' --- |' * 4}")
    for count in COUNTS:
        one, other = blurred(count, 2), blurred(count, 3)
        off = float(((one - first) * (other - second)).mean())
        noise = float((one - other).square().mean() / 2.0)
        said = f"{math.sqrt(off):.2f}" if off > 0.0 else "0.00"
        print(f"| {count} | {math.ceil(given.spp / count)} | {said} | {math.sqrt(noise):.2f} |", flush=True)


if __name__ == "__main__":
    main()
