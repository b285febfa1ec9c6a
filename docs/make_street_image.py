"""Renders `docs/images/street.webp`: the car and the stop sign in the streets.

python docs/make_street_image.py [--size 200] [--spp 64]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image

from advsearch import load_scene
from advsearch.controls import Space
from advsearch.engine.loading import framed, make_renderer
from advsearch.scene.formation import to_8_bit

PICTURE = Path(__file__).resolve().parent / "images" / "street.webp"
VIEWS = (
    ("car", "street", 40.0, 12.0), ("car", "street", 205.0, 14.0), ("stop-sign", "street", -20.0, 4.0),
    ("car", "street-wet", 325.0, 10.0), ("car", "street-dusk", 145.0, 8.0), ("stop-sign", "street-dusk", 25.0, 8.0),
)  # fmt: skip
"""Object, environment, azimuth and elevation."""


def main(argv: Sequence[str] | None = None) -> int:
    """Render and write; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=200, help="half the width of one picture (default 200)")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel (default 64)")
    args = parser.parse_args(argv)
    width, height = 2 * args.size, 3 * args.size // 2
    sheet = Image.new("RGB", (3 * width, 2 * height))
    for number, (name, light, azimuth, elevation) in enumerate(VIEWS):
        scene = load_scene(name, light, settings={"camera.azimuth": azimuth, "camera.elevation": elevation})
        renderer = make_renderer(framed(scene.description, (height, width)), Space(()), (height, width), "oidn", 0)
        with torch.no_grad():
            levels = to_8_bit(renderer(renderer.start, 0, args.spp)) * 255.0
        sheet.paste(Image.fromarray(levels.round().byte().numpy()), (number % 3 * width, number // 3 * height))
    sheet.save(PICTURE, quality=86, method=6)
    print(f"written: {PICTURE.name}, {PICTURE.stat().st_size // 1024} KiB", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
