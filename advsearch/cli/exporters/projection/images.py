"""What a projector needs for an adversarial scene: the image, marks to line it up by,
and what to set.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from advsearch.extend import (
    Control,
    Exporter,
    InputError,
    color,
    exports,
    images,
    seeds,
    writing,
)

ROWS = 1024  # least height of the pictures to project, in pixels
# where the nine marks are in a picture, of its width and height
SHARES = (1 / 8, 1 / 2, 7 / 8)
SPP = 64  # samples a pixel of the picture of the scene with the marks


def write_projection(run: str | Path, out: Path) -> list[str]:
    """Write a folder for each projector of a run's adversarial scene: `picture.png` to
    project, `texels.png` with the exact values, `marks.png` to project first,
    `seen.png`, where the run's camera sees these marks, and `README.txt`; return
    sentences about what to set. Raises errors as `AdversarialRun.load`, and InputError
    where it has no projector, or the folder is there already.
    """
    if os.path.lexists(out):
        raise InputError(f"out: {out} is there already; choose another name")
    adversarial = exports.AdversarialRun.load(run)
    slices = adversarial.problem.space.split_by_control(adversarial.u)
    projectors: list[tuple[Any, Tensor]] = [
        (control, part) for control, part in slices if has_pattern(control)
    ]
    if not projectors:
        raise InputError(
            f"{adversarial.folder}: it has no projector, so that there is "
            "nothing to project"
        )
    notes: list[str] = []
    with writing.placed_by("out"), writing.storage_errors(out):
        for control, part in projectors:
            folder = out / control.file_name if len(projectors) > 1 else out
            folder.mkdir(parents=True)
            values = control.values(part)
            pattern = values["pattern"]
            factor = -(-ROWS // len(pattern))
            marks, places = marked((len(pattern), pattern.shape[1]), factor)
            small = torch.nn.functional.avg_pool2d(
                marks.permute(2, 0, 1)[None], factor
            )[0].permute(1, 2, 0)
            Exporter.write_png(folder / "picture.png", images.enlarge(pattern, factor))
            Exporter.write_png(folder / "texels.png", pattern)
            Exporter.write_png(folder / "marks.png", color.linear_to_srgb(marks))
            lit = control.scene_inputs(
                {**values, "pattern": color.linear_to_srgb(small)}, {}
            )
            seed = seeds.stream(adversarial.problem.seed, "marks")
            Exporter.write_png(
                folder / "seen.png",
                adversarial.render({**adversarial.inputs, **lit}, seed, SPP),
            )
            number = {
                name: float(value) for name, value in values.items() if value.ndim == 0
            }
            unit = "m" if control.scene.object.metres is not None else "object sizes"
            fov = control.part.fov
            aspect = control.part.aspect
            white = control.measured(values, {})["white"]["value"]
            half = math.tan(math.radians(fov) / 2.0)
            settings = [
                f"{number['lumens']:g} lumens for a white picture, "
                f"{number['distance']:.3g} {unit} from the object's "
                "middle",
                f"a picture {fov:.3g} degrees wide (throw ratio {0.5 / half:.2f}), "
                f"{aspect:.3g} times as wide as high",
                f"azimuth {number['azimuth'] % 360.0:.4g} and elevation "
                f"{number['elevation']:.4g} degrees around the "
                "object",
                f"ambient light of {number['ambient']:.4g} lux; white is {white:.4g} "
                "lux on the object",
            ]
            where = []
            for mark, (row, column, x, y) in enumerate(places, 1):
                right, up = (
                    math.degrees(math.atan(at))
                    for at in ((2 * x - 1) * half, (1 - 2 * y) * half / aspect)
                )
                at = f"{mark}: row {row}, column {column}"
                where.append(
                    f"{at}; {right:.2f} degrees to the right of the middle, {up:.2f} up"
                )
            text = [
                "Set:",
                *settings,
                "",
                "Marks of marks.png, by texel from the upper left:",
                *where,
                "",
            ]
            writing.write_text(folder / "README.txt", "\n".join(text), durable=False)
            notes += settings
    return notes


def has_pattern(control: Control) -> bool:
    """Return whether a control throws an image whose texels are known, as the control
    projector does.
    """
    return control.competes_with_ambient and any(
        slot.parameter.name == "pattern" for slot in control.slots
    )


def marked(
    sides: tuple[int, int], factor: int
) -> tuple[Tensor, list[tuple[int, int, float, float]]]:
    """Return a picture of a frame and nine numbered crosses on black, (h, w, 3) linear
    in [0, 1], so many times as large as a pattern of `sides` rows and columns, and of
    each cross row and column of its texel and their middle as shares of the picture's
    width and height.
    """
    height = sides[0] * factor
    width = sides[1] * factor
    picture = Image.new("L", (width, height))
    draw = ImageDraw.Draw(picture)
    line = max(2, height // 200)
    arm = height // 24
    draw.rectangle((0, 0, width - 1, height - 1), outline=255, width=2 * line)
    places = []
    for down in SHARES:
        for across in SHARES:
            row = int(down * sides[0])
            column = int(across * sides[1])
            x = (column + 0.5) * factor
            y = (row + 0.5) * factor
            draw.line((x - arm, y, x + arm, y), fill=255, width=line)
            draw.line((x, y - arm, x, y + arm), fill=255, width=line)
            places.append(
                (row, column, (column + 0.5) / sides[1], (row + 0.5) / sides[0])
            )
            draw.text((x + line, y + line), str(len(places)), fill=255, font_size=arm)
    levels = torch.frombuffer(bytearray(picture.tobytes()), dtype=torch.uint8).reshape(
        height, width, 1
    )
    return levels.expand(-1, -1, 3) / 255.0, places
