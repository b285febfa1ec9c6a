"""Which parts of each object, when seen, go with wrong answers: the maps that sweeps of its surface have drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from advsearch.errors import InputError
from advsearch.questions.recipe.answer import SurfaceFigure, SurfaceOf
from advsearch.questions.recipe.figures.base import FigureKind, Options
from advsearch.questions.recipe.table import Table
from advsearch.report.sweeps import surface_sentences
from advsearch.runs.directory import IMAGES, PARTS

SIZE = 6.4, 2.65
"""Of one object's map, width and height in inches."""


def _compute(table: Table, options: Options) -> SurfaceFigure:
    if not table.surfaces:
        raise InputError("figures: surface: expected a sweep with `surface: true` among its parts, got none")
    maps = [SurfaceOf(run=run, tables=found.tables) for run, found in table.surfaces.items()]
    return SurfaceFigure(
        figure="surface",
        title=options.title or "Which parts of the surface go with wrong answers",
        text=[text for found in table.surfaces.values() for text in surface_sentences(found)],
        maps=maps,
    )


def _draw(made: SurfaceFigure, figure: Any, run: Path) -> None:
    from matplotlib.image import imread

    for axes, one in zip(figure.subplots(len(made.maps), squeeze=False)[:, 0], made.maps, strict=True):
        axes.imshow(imread(run / PARTS / one.run / IMAGES / "surface.png"))
        axes.axis("off")


SURFACE = FigureKind(
    Options, SurfaceFigure, _compute, _draw, lambda made: (SIZE[0], SIZE[1] * len(made.maps)), tells_models=True
)
