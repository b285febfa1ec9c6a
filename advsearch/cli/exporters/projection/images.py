"""Export a projector of an adversarial scene, to repeat it with a real projector.

The files are the projected image, an image of marks to align the projector by, a render
of the scene with these marks, and a text with the settings.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

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

MIN_HEIGHT = 1024  # minimum height of the images to project, in pixels
# Positions of the nine marks, as fractions of the width and of the height.
MARK_POSITIONS = (1 / 8, 1 / 2, 7 / 8)
MARKS_SPP = 64  # samples per pixel of the render of the scene with the marks


class MarkedTexel(NamedTuple):
    """A texel of a pattern with a mark at its center.

    Attributes:
        row: row of the texel.
        column: column of the texel.
        x: distance of its center from the left edge, as a fraction of the width of the
            image.
        y: distance of its center from the upper edge, as a fraction of the height.
    """

    row: int
    column: int
    x: float
    y: float


def write_projection(run: str | Path, out: Path) -> list[str]:
    """Write a folder with the images to project, for each projector of a run.

    The settings of the projectors are those in the adversarial scene. The folder has
    `picture.png` to project, `texels.png` with the exact values, `marks.png` with
    numbered crosses to project first, `seen.png` with these crosses as the run's camera
    sees them, and `README.txt`.

    Args:
        run: name or folder of the run.
        out: the folder, which must not exist.

    Returns:
        Sentences about the settings of the projectors.

    Raises:
        InputError: the scene has no projector, or the folder is there already; other
            errors as for `AdversarialRun.load`.
    """
    if os.path.lexists(out):
        raise InputError(f"out: {out} is there already; choose another name")
    adversarial = exports.AdversarialRun.load(run)
    projectors = _list_projectors(adversarial)
    notes: list[str] = []
    with writing.name_setting_in_errors("out"), writing.storage_errors(out):
        for control, u in projectors:
            # several projectors have a folder each
            folder = out / control.name_in_files if len(projectors) > 1 else out
            folder.mkdir(parents=True)
            values = control.compute_values(u)
            notes += write_projector(folder, adversarial, control, values)
    return notes


def _list_projectors(adversarial: Any) -> list[tuple[Any, Tensor]]:
    """Return the projectors of an `AdversarialRun`, each with its values in [0, 1].

    Raises:
        InputError: there is none.
    """
    slices = adversarial.problem.space.split_by_control(adversarial.u)
    projectors = [(control, u) for control, u in slices if has_pattern(control)]
    if not projectors:
        raise InputError(
            f"{adversarial.folder}: it has no projector, so that there is "
            "nothing to project"
        )
    return projectors


def write_projector(
    folder: Path, adversarial: Any, control: Any, values: dict[str, Tensor]
) -> list[str]:
    """Write the files of one projector, and return sentences about its settings.

    Args:
        folder: folder to write into.
        adversarial: the `AdversarialRun` with the scene.
        control: the projector.
        values: values of the projector by name; "pattern" is (rows, columns, 3) in
            sRGB.
    """
    pattern = values["pattern"]
    n_rows, n_columns = pattern.shape[:2]
    # pixels per texel, rounded up: images are at least MIN_HEIGHT pixels high
    factor = math.ceil(MIN_HEIGHT / n_rows)
    # an image of nine crosses, and the texels at their centers
    marks, marked_texels = make_marks((n_rows, n_columns), factor)
    texel_marks = _average_per_texel(marks, factor)
    Exporter.write_png(folder / "picture.png", images.enlarge(pattern, factor))
    Exporter.write_png(folder / "texels.png", pattern)
    Exporter.write_png(folder / "marks.png", color.linear_to_srgb(marks))
    marked_values = {**values, "pattern": color.linear_to_srgb(texel_marks)}
    view = _render_marks(adversarial, control, marked_values)
    Exporter.write_png(folder / "seen.png", view)
    settings = describe_settings(control, values)
    text = _make_readme(settings, describe_marks(control, marked_texels))
    writing.write_text(folder / "README.txt", text, durable=False)
    return settings


def _average_per_texel(marks: Tensor, factor: int) -> Tensor:
    """Return the mean of a picture (h, w, 3) over each texel, (rows, columns, 3).

    Args:
        marks: the picture, linear.
        factor: width and height of a texel in pixels of the picture.
    """
    # `avg_pool2d` takes and returns images as (1, 3, H, W).
    pooled_marks: Tensor = torch.nn.functional.avg_pool2d(
        marks.permute(2, 0, 1)[None], factor
    )
    return pooled_marks[0].permute(1, 2, 0)


def _render_marks(
    adversarial: Any, control: Any, marked_values: dict[str, Tensor]
) -> Any:
    """Render the scene as the run has it, but with marks in the place of the pattern.

    Args:
        adversarial: the `AdversarialRun` with the scene.
        control: the projector.
        marked_values: values of the projector by name, with the marks as "pattern".
    """
    inputs_with_marks = control.scene_inputs(marked_values, earlier_inputs={})
    seed = seeds.derive_seed(adversarial.problem.seed, "marks")
    return adversarial.render(
        {**adversarial.inputs, **inputs_with_marks}, seed, MARKS_SPP
    )


def _make_readme(settings: Sequence[str], mark_lines: Sequence[str]) -> str:
    """Return the text with the settings of a projector and the positions of marks."""
    lines = [
        "Set:",
        *settings,
        "",
        "Marks of marks.png, by texel from the upper left:",
        *mark_lines,
        "",
    ]
    return "\n".join(lines)


def describe_settings(control: Any, values: dict[str, Tensor]) -> list[str]:
    """Return the settings of a projector and of the room as sentences.

    Args:
        control: the projector.
        values: values of the projector by name; only single numbers are read.
    """
    numbers = {name: float(value) for name, value in values.items() if value.ndim == 0}
    unit = "m" if control.scene.object.size_in_metres is not None else "object sizes"
    # illuminance of the object by a white image, in lux
    measurements = control.compute_measurements(values, {})
    white = measurements["white"]["value"]
    return [
        f"{numbers['lumens']:g} lumens for a white picture, "
        f"{numbers['distance']:.3g} {unit} from the object's "
        "middle",
        _describe_picture_shape(control),
        f"azimuth {numbers['azimuth'] % 360.0:.4g} and elevation "
        f"{numbers['elevation']:.4g} degrees around the "
        "object",
        f"ambient light of {numbers['ambient']:.4g} lux; white is {white:.4g} "
        "lux on the object",
    ]


def _describe_picture_shape(control: Any) -> str:
    """Return the width of a projector's picture in degrees, and its aspect, as text."""
    fov = control.projector_part.fov  # horizontal field of view in degrees
    # Half the width of the picture at distance 1. The throw ratio of a projector is
    # distance / width, which is 1 / (2 half_width).
    half_width = math.tan(math.radians(fov) / 2.0)
    throw_ratio = 0.5 / half_width
    return (
        f"a picture {fov:.3g} degrees wide (throw ratio {throw_ratio:.2f}), "
        f"{control.projector_part.aspect:.3g} times as wide as high"
    )


def describe_marks(control: Any, marked_texels: Sequence[MarkedTexel]) -> list[str]:
    """Return a line for each mark: its texel, and its direction in degrees.

    The direction is relative to the projector's axis.

    Args:
        control: the projector.
        marked_texels: the texels with a mark.
    """
    lines = []
    for index, texel in enumerate(marked_texels, 1):
        right, up = _compute_mark_angles(texel, control.projector_part)
        lines.append(
            f"{index}: row {texel.row}, column {texel.column}; {right:.2f} degrees to "
            f"the right of the middle, {up:.2f} up"
        )
    return lines


def _compute_mark_angles(
    texel: MarkedTexel, projector_part: Any
) -> tuple[float, float]:
    """Return how far a mark is to the right and up from the projector's axis, in degrees.

    Args:
        texel: the texel with the mark.
        projector_part: the projector, with its field of view and aspect.
    """
    # half the width of the picture at distance 1
    half_width = math.tan(math.radians(projector_part.fov) / 2.0)
    # Position in the picture, from -1 to 1 around its middle. Multiplied by the half
    # width or the half height, it is the tangent of the angle.
    right_of_middle = 2 * texel.x - 1
    above_middle = 1 - 2 * texel.y
    right = math.degrees(math.atan(right_of_middle * half_width))
    up = math.degrees(math.atan(above_middle * half_width / projector_part.aspect))
    return right, up


def has_pattern(control: Control) -> bool:
    """Return whether a control projects an image (`pattern`), as the control projector
    does.
    """
    return control.competes_with_ambient and any(
        slot.parameter.name == "pattern" for slot in control.parameter_slots
    )


def make_marks(shape: tuple[int, int], factor: int) -> tuple[Tensor, list[MarkedTexel]]:
    """Return a picture of a frame and nine numbered crosses, and their positions.

    Args:
        shape: rows and columns of the projector's pattern.
        factor: width and height of a texel in pixels of the picture.

    Returns:
        The picture, white on black, (h, w, 3) linear in [0, 1]; and the texel at the
        center of each cross.
    """
    n_rows, n_columns = shape
    width = n_columns * factor
    height = n_rows * factor
    picture = Image.new("L", (width, height))
    draw = ImageDraw.Draw(picture)
    line = max(2, height // 200)  # width of the lines of the crosses, in pixels
    draw.rectangle((0, 0, width - 1, height - 1), outline=255, width=2 * line)
    marked_texels = _choose_marked_texels(n_rows, n_columns)
    for number, texel in enumerate(marked_texels, 1):
        center = ((texel.column + 0.5) * factor, (texel.row + 0.5) * factor)
        draw_cross(draw, center, height // 24, line, text=str(number))
    levels = torch.frombuffer(bytearray(picture.tobytes()), dtype=torch.uint8)
    levels = levels.reshape(height, width, 1).expand(-1, -1, 3)
    return levels / 255.0, marked_texels


def _choose_marked_texels(n_rows: int, n_columns: int) -> list[MarkedTexel]:
    """Return the nine texels of a pattern at `MARK_POSITIONS`, row by row."""
    marked_texels = []
    for fraction_down, fraction_across in itertools.product(
        MARK_POSITIONS, MARK_POSITIONS
    ):
        row = int(fraction_down * n_rows)
        column = int(fraction_across * n_columns)
        marked_texels.append(
            MarkedTexel(row, column, (column + 0.5) / n_columns, (row + 0.5) / n_rows)
        )
    return marked_texels


def draw_cross(
    draw: ImageDraw.ImageDraw,
    center: tuple[float, float],
    arm: int,
    line: int,
    text: str,
) -> None:
    """Draw a white cross with its number.

    Args:
        draw: draws on the picture.
        center: center of the cross (x, y) in pixels.
        arm: length of an arm in pixels, also the size of the number.
        line: width of the lines in pixels.
        text: the number.
    """
    x, y = center
    draw.line((x - arm, y, x + arm, y), fill=255, width=line)
    draw.line((x, y - arm, x, y + arm), fill=255, width=line)
    draw.text((x + line, y + line), text, fill=255, font_size=arm)
