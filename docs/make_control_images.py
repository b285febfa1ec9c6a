"""Renders one example picture for every control: `docs/images/controls/NAME.png`.

    python docs/make_control_images.py [NAME ...] [--size 144]

Four configurations of the bundled mug (or of an object that suits the control) stand
side by side: the scene as it is, and three of what the control can do.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from advsearch import load_scene
from advsearch.catalog import list_built_ins
from advsearch.controls import make_space
from advsearch.engine.loading import make_controls, make_renderer
from advsearch.scene.color import round_to_8_bit

FOLDER = Path(__file__).resolve().parent / "images" / "controls"
SPP = 128
WITHOUT_PICTURE = ("backdrop",)  # it needs photographs


def main(argv: Sequence[str] | None = None) -> int:
    """Render and write; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="controls (default: all)"
    )
    parser.add_argument(
        "--size", type=int, default=144, help="side of one picture (default 144)"
    )
    args = parser.parse_args(argv)
    FOLDER.mkdir(parents=True, exist_ok=True)
    drawn = [name for name in list_built_ins("control") if name not in WITHOUT_PICTURE]
    for name in args.names or drawn:
        path = FOLDER / f"{name}.png"
        row(name, args.size).save(path, optimize=True)
        print(
            f"written: {path.relative_to(FOLDER.parent.parent.parent)}", file=sys.stderr
        )
    return 0


SCENES: Mapping[str, tuple[str, str | None, dict[str, float]]] = {
    "contents": ("mug", "day-room", {"camera.elevation": 45.0}),
    "sky": ("bowl", None, {}),
    "background": ("wine-glass", "studio", {}),
    "camera": ("teapot", "day-room", {}),
    "shadow": ("mug", "low-sun", {"environment.rotation": -30.0}),
    "path": ("teapot", "day-room", {}),
    "occlusion": ("teapot", "kitchen", {}),
    "things": ("mug", "room", {"camera.distance": 0.75, "camera.elevation": 20.0}),
    "body": ("person", "street", {"camera.elevation": 6.0, "camera.azimuth": 30.0}),
}
"""Object, environment and settings where the mug in the studio does not show it
well.
"""

BESIDE = {
    "things": "bottle@0.05,-0.2; book@0.15,0.2,heading=30; banana@0.2,0,heading=70"
}
"""What stands beside it."""

CONTROLS: Mapping[str, Mapping[str, Any]] = {
    "camera": {
        "camera": {
            "azimuth": [0, 360],
            "elevation": [5, 70],
            "roll": [-20, 20],
            "fov": [20, 70],
        }
    },
    "path": {"path": {"path": "approach", "reach": 4.0}},
    "environment": {
        "environment": {
            "which": ["own", "kitchen", "noon", "loft"],
            "rotation": [0, 360],
        }
    },
    "light": {
        "key": {"kind": "light", "power": [0.5, 4], "x": [-2, 2], "y": [-2, 2]},
        "fill": {"kind": "light", "red": [0, 1], "blue": [0, 1], "power": [0.5, 4]},
    },
    "material": {"material.which": {}},
    "occlusion": {
        "occlusion": {
            "which": ["vase", "banana", "book", "card"],
            "coverage": [0.0, 0.5],
        }
    },
    "things": {
        "things": {"x": [-0.15, 0.15], "y": [-0.15, 0.15], "heading": [-180, 180]}
    },
    "geometry": {"geometry": {"epsilon": 0.12}},
    "haze": {"haze": {"density": [0.0, 0.6]}},
    "mitsuba": {
        "mitsuba:ground.bsdf.brdf_0.reflectance.value": [0.01, 0.6],
        "mitsuba:environment.scale": [0.3, 2.0],
    },
    "projector": {"projector": {"resolution": 16, "lumens": 4}},
    "shadow": {"shadow": {"size": [0.3, 0.6], "distance": 1.0}},
    "sensor": {
        "sensor": {
            "shot": [0.0, 0.15],
            "mosaic": [0, 1],
            "red": [-1, 1],
            "blue": [-1, 1],
            "compression": [0, 95],
        }
    },
}
"""What is varied where it is not simply the control with its defaults."""


def row(name: str, size: int) -> Image.Image:
    """Return the pictures of one control side by side."""
    spec, environment, given = SCENES.get(name, ("mug", None, {}))
    scene = load_scene(spec, environment, settings=given, things=BESIDE.get(name))
    controls = dict(CONTROLS.get(name, {name: {}}))
    space = make_space(make_controls(controls), scene.description)
    render = make_renderer(scene.description, space, size, "oidn", 0)
    pictures = [
        render.start,
        *(_example(space.start, space.groups, number) for number in range(1, 4)),
    ]
    with torch.no_grad():
        shown = [round_to_8_bit(render(u, seed=0, spp=SPP)) for u in pictures]
    gap = torch.ones(size, 6, 3)
    strip = torch.cat(
        [part for picture in shown for part in (picture, gap)][:-1], dim=1
    )
    return Image.fromarray((strip * 255.0).round().to(torch.uint8).numpy())


def _example(start: Tensor, groups: Any, number: int) -> Tensor:
    """A configuration that shows something: random numbers, the options in turn, balls
    left for the most part.
    """
    generator = torch.Generator().manual_seed(number)
    u = start.clone()
    for group in groups:
        part = group.coordinates
        if group.options:
            u[part] = (
                (number * max(1, group.options // 4)) % group.options + 0.5
            ) / group.options
        elif group.budget.norm == "box":
            u[part] = torch.rand(group.size, generator=generator)
        elif group.budget.norm == "linf":
            move = torch.rand(group.size, generator=generator).round() * 2.0 - 1.0
            u[part] = (start[part] + group.budget.epsilon * move).clamp(0.0, 1.0)
        else:
            move = torch.randn(group.size, generator=generator)
            u[part] = (start[part] + group.budget.epsilon * move / move.norm()).clamp(
                0.0, 1.0
            )
    return u


if __name__ == "__main__":
    sys.exit(main())
