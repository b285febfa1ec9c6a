"""A run's pictures in a terminal that draws them, by kitty's protocol or Sixel; elsewhere their paths."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from advsearch.cli.screen import raw

HEIGHT = 16
"""Of a picture, in lines."""

EXTRA = "pip install 'advsearch[terminal]'"

FIRST = ("clean", "adversarial")
"""What is shown of an attack; of another run, the first picture there is."""


def best_pictures(run: Path) -> list[Path]:
    """Return the pictures of a run that say most; none where it has none."""
    folder = run / "images"
    files = [folder / f"{name}.png" for name in FIRST]
    if not all(one.is_file() for one in files):
        files = sorted(folder.glob("*.png"))[:1]
    return [one for one in files if not one.is_symlink()]


def show_pictures(files: Sequence[Path]) -> None:
    """Draw pictures where standard output is a terminal that can, and say where each is."""
    if not files:
        print("\nThis run has no pictures.")
        return
    draw, why = _drawing()
    print()
    for file in files:
        if draw is not None:
            try:
                draw(file)
            except Exception as error:  # whatever a terminal answers, the path is said
                draw, why = None, f"The pictures could not be drawn here: {type(error).__name__}: {error}"
        print(f"  picture   {file}")
    if why:
        print(f"\n{why}")


def _drawing() -> tuple[Callable[[Path], None] | None, str]:
    """What draws a picture in this terminal, or None and what to do about it."""
    if not sys.stdout.isatty():
        return None, ""
    try:
        from textual_image import renderable  # asks the terminal when it is imported
    except ImportError:
        return None, f"Terminals with kitty's protocol or Sixel draw them here: {EXTRA}"
    if renderable.Image not in (renderable.SixelImage, renderable.TGPImage):
        return None, "This terminal draws no pictures: it has neither kitty's protocol nor Sixel."
    from rich.console import Console

    console = Console(file=raw(sys.stdout))
    return lambda file: console.print(renderable.Image(file, height=HEIGHT)), ""
