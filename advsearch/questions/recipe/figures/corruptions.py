"""Errors under common corruptions, and the mean corruption error of ImageNet-C (Hendrycks and Dietterich 2019)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.errors import InputError
from advsearch.explanations.observations import Answered
from advsearch.questions.recipe.answer import CorruptionFigure, CorruptionModel, NamedCount
from advsearch.questions.recipe.figures.base import FigureKind, Options, extremes, intervals_apart, rate_with_interval
from advsearch.questions.recipe.figures.curve import COLOURS
from advsearch.questions.recipe.table import Table, count_of


class CorruptionOptions(Options):
    """Options of corruption errors.

    Attributes:
        which: the parameter that names the corruption.
        clean: the part with pictures that have none.
    """

    which: str = "corruption.which"
    clean: str = Field(default="clean", max_length=40)


def _compute(table: Table, options: CorruptionOptions) -> CorruptionFigure:
    models: list[CorruptionModel] = []
    for name, rows in table.by("model").items():
        models.append(_model(name, Table(rows, table.groups), options, models[0] if models else None))
    return CorruptionFigure(
        figure="corruption error",
        title=options.title or "Error under each corruption, mean over severities",
        text=[text for one in models for text in _said(one, models[0].model)],
        models=models,
    )


def _model(name: str, table: Table, options: CorruptionOptions, base: CorruptionModel | None) -> CorruptionModel:
    clean = [row for row in table.rows if row.part == options.clean]
    corrupted = Table([row for row in table.rows if row.part != options.clean], table.groups)
    if not corrupted.rows:
        raise InputError(f"figures: corruption error: expected rows of a part beside {options.clean!r}, got none")
    errors = [_wrong(which, rows) for which, rows in corrupted.by(options.which).items()]
    if len({one.configurations for one in errors}) > 1:
        raise InputError("figures: corruption error: expected as many pictures of each corruption")
    return CorruptionModel(
        model=name,
        clean=_wrong("clean", clean) if clean else None,
        errors=errors,
        error=_wrong("mean", corrupted.rows),
        relative=None if base is None else _relative(errors, base),
    )


def _wrong(name: str, rows: Sequence[Answered]) -> NamedCount:
    return count_of(name, sum(not row.correct for row in rows), len(rows))


def _relative(errors: Sequence[NamedCount], base: CorruptionModel) -> float | None:
    """The mean over corruptions of the error over that of another model, in %; those without any error are left out."""
    under = {one.name: one.correct / one.configurations for one in base.errors}
    ratios = [100.0 * one.correct / one.configurations / under[one.name] for one in errors if under.get(one.name)]
    return sum(ratios) / len(ratios) if ratios else None


def _said(one: CorruptionModel, first: str) -> list[str]:
    """The mean error with the interval of its pictures, which are as many of each corruption."""
    said = [f"{one.model}: {rate_with_interval(one.error, 'wrong')}, the mean corruption error."]
    if one.clean is not None:
        more = (
            "That is more than without"
            if intervals_apart(one.clean, one.error)
            else "No difference is shown to pictures without"
        )
        said.append(f"{more}: {rate_with_interval(one.clean, 'wrong')}.")
    if one.relative is not None:
        said.append(f"Relative to {first}, which takes the place of AlexNet, its mCE is {one.relative:.0f} %.")
    return [*said, *extremes(one.errors, "The most harmless", "the most harmful", "corruptions", "wrong")]


def _draw(made: CorruptionFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    names = [one.name for one in sorted(made.models[0].errors, key=lambda one: one.accuracy or 0.0)]
    thick = 0.8 / len(made.models)
    for number, model in enumerate(made.models):
        by_name = {one.name: one for one in model.errors}
        colour = COLOURS[number % len(COLOURS)]
        for place, name in enumerate(names):
            one, at = by_name[name], place + 0.4 - (number + 0.5) * thick
            axes.barh(at, one.accuracy or 0.0, height=thick * 0.9, color=colour, alpha=0.55,
                      label=model.model if not place else "_")  # fmt: skip
            if one.interval:
                axes.plot(one.interval, [at, at], color="#1c1d20", linewidth=1.0)
        if model.clean is not None and model.clean.accuracy is not None:
            axes.axvline(model.clean.accuracy, color=colour, linestyle="--", linewidth=1)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="error, with 95 % interval; dashed: without corruption", xlim=(0.0, 1.0))
    axes.set_title(made.title)
    axes.grid(True, axis="x")
    if len(made.models) > 1:
        figure.legend(loc="outside lower center", ncols=min(len(made.models), 2))


CORRUPTION_ERROR = FigureKind(
    CorruptionOptions,
    CorruptionFigure,
    _compute,
    _draw,
    lambda made: (6.0, 1.4 + (0.2 + 0.09 * len(made.models)) * len(made.models[0].errors)),
    tells_models=True,
)
