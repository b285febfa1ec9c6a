"""Renders `docs/images/street.webp`: the car and the stop sign in the streets; and
`validity.webp`: how far they hold.

python docs/make_street_image.py [--size 200] [--spp 64] [--only validity]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image

from advsearch import load_scene
from advsearch.controls import Space
from advsearch.engine.loading import fit_camera, make_renderer
from advsearch.scene.color import round_to_8_bit

IMAGES = Path(__file__).resolve().parent / "images"
VIEWS = (
    ("car", "street", 40.0, 12.0), ("car", "street", 205.0, 14.0), ("stop-sign", "street", -20.0, 4.0),
    ("car", "street-wet", 325.0, 10.0), ("car", "street-dusk", 145.0, 8.0), ("stop-sign", "street-dusk", 25.0, 8.0),
)  # fmt: skip
"""Object, environment, azimuth and elevation."""


FROM = ((90.0, 12.0), (90.0, 25.0), (90.0, 60.0), (0.0, 60.0))
"""Azimuth and distance in metres of a camera that is `HEIGHT` high."""
HEIGHT = 1.6


def picture(
    name: str, light: str, settings: dict[str, float], size: tuple[int, int], spp: int
) -> Image.Image:
    """One picture of a height and width."""
    scene = load_scene(name, light, settings=settings)
    renderer = make_renderer(
        fit_camera(scene.description, size), Space(()), size, "oidn", 0
    )
    with torch.no_grad():
        levels = round_to_8_bit(renderer(renderer.start, 0, spp)) * 255.0
    return Image.fromarray(levels.round().byte().numpy())


def main(argv: Sequence[str] | None = None) -> int:
    """Render and write; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--size",
        type=int,
        default=200,
        help="half the width of one picture (default 200)",
    )
    parser.add_argument(
        "--spp", type=int, default=64, help="samples per pixel (default 64)"
    )
    parser.add_argument(
        "--only", choices=("street", "validity"), help="one of the two (default: both)"
    )
    args = parser.parse_args(argv)
    width = 2 * args.size
    height = 3 * args.size // 2
    if args.only != "validity":
        sheet = Image.new("RGB", (3 * width, 2 * height))
        for number, (name, light, azimuth, elevation) in enumerate(VIEWS):
            given = {"camera.azimuth": azimuth, "camera.elevation": elevation}
            one = picture(name, light, given, (height, width), args.spp)
            sheet.paste(one, (number % 3 * width, number // 3 * height))
        write(sheet, "street.webp")
    if args.only != "street":
        side = width * 3 // 4
        sheet = Image.new("RGB", (3 * width, width * 3 // 4))
        for number, (azimuth, away) in enumerate(FROM):
            middle = 0.73  # height of the car's, metres
            elevation = math.degrees(math.asin((HEIGHT - middle) / away))
            given = {
                "camera.azimuth": azimuth,
                "camera.elevation": elevation,
                "camera.distance": away,
            }
            sheet.paste(
                picture("car", "street", given, (side, side), args.spp),
                (number * side, 0),
            )
        write(sheet, "validity.webp")
    return 0


def write(sheet: Image.Image, name: str) -> None:
    sheet.save(IMAGES / name, quality=86, method=6)
    print(
        f"written: {name}, {(IMAGES / name).stat().st_size // 1024} KiB",
        file=sys.stderr,
    )


if __name__ == "__main__":
    sys.exit(main())
