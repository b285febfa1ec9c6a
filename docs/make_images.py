"""Makes from a finished run what README.md shows of it.

    python docs/make_images.py RUN

RUN is the folder of a run with the control `texture`. Written are
`docs/images/attack-mug.png` (the clean picture, the adversarial one and the texture,
side by side) and, in README.md, the result that the run printed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from advsearch.cli.output import format_result as text_of
from advsearch.questions.attack.summary import (
    AttackSummary,
    PicturedPrediction,
    load_attack_summary,
)
from advsearch.report.wording import CLASSIFICATION, format_prediction
from advsearch.runs.directory import make_default_name

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "images" / "attack-mug.png"
BEGIN = "<!-- made by docs/make_images.py -->\n"
END = "<!-- end -->"
SIDE = 288
GAP = 12
CAPTION = 30


def main(argv: Sequence[str] | None = None) -> int:
    """Write both files; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "run", type=Path, help="folder of a finished run with the control texture"
    )
    run = parser.parse_args(argv).run
    summary = load_attack_summary(run)
    side_by_side(run, summary).save(PICTURE, optimize=True)
    readme = ROOT / "README.md"
    readme.write_text(
        with_adversarial(readme.read_text(encoding="utf-8"), summary), encoding="utf-8"
    )
    print(
        f"written: {PICTURE.relative_to(ROOT)}, {readme.relative_to(ROOT)}",
        file=sys.stderr,
    )
    return 0


def side_by_side(run: Path, summary: AttackSummary) -> Image.Image:
    """Return the clean and the adversarial picture with the model's predictions, and
    the texture, on white.
    """
    panels = [
        ("images/clean.png", f"clean: {_said(summary.clean)}"),
        ("images/adversarial.png", f"adversarial: {_said(summary.adversarial)}"),
        ("artifacts/texture.png", "the texture"),
    ]
    sheet = Image.new(
        "RGB", (len(panels) * SIDE + (len(panels) - 1) * GAP, SIDE + CAPTION), "white"
    )
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(15)
    for number, (name, caption) in enumerate(panels):
        left = number * (SIDE + GAP)
        with Image.open(run / name) as picture:
            sheet.paste(_fitted(picture.convert("RGB")), (left, 0))
        draw.text(
            (left + SIDE / 2, SIDE + CAPTION / 2),
            caption,
            fill="black",
            font=font,
            anchor="mm",
        )
    return sheet


def _fitted(picture: Image.Image) -> Image.Image:
    """Return the picture on a white square of SIDE pixels, as large as it goes in
    there.
    """
    scale = SIDE / max(picture.size)
    size = round(picture.width * scale), round(picture.height * scale)
    square = Image.new("RGB", (SIDE, SIDE), "white")
    corner = (SIDE - size[0]) // 2, (SIDE - size[1]) // 2
    square.paste(picture.resize(size, Image.Resampling.LANCZOS), corner)
    return square


def _said(prediction: PicturedPrediction | None) -> str:
    return (
        format_prediction(CLASSIFICATION, prediction) if prediction else "no prediction"
    )


def with_adversarial(readme: str, summary: AttackSummary) -> str:
    """Return the text of README.md with the run's result in the marked place; the run
    gets its usual name in `runs/`.

    Raises:
        ValueError: there is no such place, or more than one.
    """
    if readme.count(BEGIN) != 1 or readme.count(END) != 1:
        raise ValueError("README.md: expected one part made by docs/make_images.py")
    place = f"runs/{make_default_name(summary.object, summary.controls)}-001"
    before, rest = readme.split(BEGIN)
    block = f"```text\n{text_of(summary.model_copy(update={'run': place}))}\n```\n"
    return f"{before}{BEGIN}{block}{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    sys.exit(main())
