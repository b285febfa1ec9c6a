"""How often the model is right, by what pictures have in common: values, pairs of them, corruptions, parts seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from advsearch.errors import InputError
from advsearch.explanations import Answered
from advsearch.questions.recipe.along import COLOURS, MARKS
from advsearch.questions.recipe.answer import (
    BarsFigure,
    CorruptionFigure,
    CorruptionModel,
    HeatMapFigure,
    NamedCount,
    PointsFigure,
    SurfaceFigure,
    SurfaceOf,
    bare,
)
from advsearch.questions.recipe.table import (
    FigureKind,
    Options,
    Table,
    count_of,
    counted_by,
    extremes,
    intervals_apart,
    plural,
    rate_with_interval,
)
from advsearch.report.figures import BLUE
from advsearch.report.sweeps import surface_sentences
from advsearch.runs.directory import IMAGES, PARTS


class BarsOptions(Options):
    """Options of bars; what they are says docs/recipes.md, as of the others."""

    by: str


def _compute_bars(table: Table, options: BarsOptions) -> BarsFigure:
    counts = counted_by(table, options.by)
    ordered = sorted(counts, key=lambda one: -(one.accuracy or 0.0))
    return BarsFigure(
        figure="bars",
        title=options.title or f"Accuracy by {options.by}",
        text=extremes(counts, "Hardest", "easiest", plural(options.by)),
        by=options.by,
        bars=ordered,
    )


def _draw_bars(made: BarsFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    rows = made.bars[::-1]
    places = range(len(rows))
    axes.barh(places, [one.accuracy or 0.0 for one in rows], color=BLUE, alpha=0.55, height=0.62)
    for place, one in enumerate(rows):
        if one.interval:
            axes.plot(one.interval, [place, place], color="#1c1d20", linewidth=1.2)
    axes.set_yticks(places, [one.name for one in rows])
    axes.set(xlabel="accuracy, with 95 % interval", xlim=(0.0, 1.0), ylim=(-0.6, len(rows) - 0.4))
    axes.set_title(made.title)
    axes.grid(True, axis="x")


BARS = FigureKind(BarsOptions, BarsFigure, _compute_bars, _draw_bars, lambda made: (6.0, 1.2 + 0.27 * len(made.bars)))


class PointsOptions(Options):
    """Options of points."""

    by: str
    series: str
    names: dict[str, str] = Field(default_factory=dict)


def _compute_points(table: Table, options: PointsOptions) -> PointsFigure:
    series = list(table.by(options.series))
    rows = table.by(options.by)
    named = [options.names.get(name, name) for name in series]
    counts = []
    for inside in rows.values():
        found = {one.name: one for one in counted_by(Table(inside, table.groups), options.series)}
        counts.append([_called(found.get(name), name, options.names) for name in series])
    totals = [_called(one, one.name, options.names) for one in counted_by(table, options.series)]
    return PointsFigure(
        figure="points",
        title=options.title or f"Accuracy by {options.by} and {options.series}",
        text=_said_points(list(rows), counts, totals),
        by=options.by,
        series=options.series,
        names=named,
        rows=list(rows),
        counts=counts,
    )


def _called(one: NamedCount | None, name: str, names: dict[str, str]) -> NamedCount:
    count = one or count_of(name, 0, 0)
    return count.model_copy(update={"name": names.get(name, name)})


def _said_points(rows: list[str], counts: list[list[NamedCount]], totals: list[NamedCount]) -> list[str]:
    """Each series against the first, over all rows and in each."""
    said = ["; ".join(f"{one.name}: {rate_with_interval(one)}" for one in totals if one.configurations) + "."]
    for place, other in enumerate(totals[1:], start=1):
        pairs = [(name, row[0], row[place]) for name, row in zip(rows, counts, strict=True)]
        known = [(name, a, b) for name, a, b in pairs if a.configurations and b.configurations]
        lower = [name for name, a, b in known if intervals_apart(b, a, len(known))]
        higher = [name for name, a, b in known if intervals_apart(a, b, len(known))]
        unshown = [name for name, _, _ in known if name not in (*lower, *higher)]
        told = [f"lower for {', '.join(lower)}"] if lower else []
        told += [f"higher for {', '.join(higher)}"] if higher else []
        told += [f"no difference is shown for {', '.join(unshown)}"] if unshown else []
        if told:
            widened = f", by intervals widened for {len(known)} comparisons" if len(known) > 1 else ""
            said.append(f"{other.name} against {totals[0].name}: {'; '.join(told)}{widened}.")
    return said


def _draw_points(made: PointsFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    for number, name in enumerate(made.names):
        shift = (number - (len(made.names) - 1) / 2) * 0.22
        colour, mark, label = COLOURS[number % len(COLOURS)], MARKS[number % len(MARKS)], name
        for place, row in enumerate(reversed(made.counts)):
            one = row[number]
            if one.interval:
                axes.plot(one.interval, [place - shift] * 2, color=colour, alpha=0.45, linewidth=3)
                axes.plot(one.accuracy, place - shift, mark, color=colour, ms=5, label=label)
                label = "_"
    axes.set_yticks(range(len(made.rows)), made.rows[::-1])
    axes.set(xlabel="accuracy, with 95 % interval", xlim=(-0.03, 1.03), ylim=(-0.6, len(made.rows) - 0.4))
    axes.set_title(made.title)
    axes.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=min(len(made.names), 3))


POINTS = FigureKind(
    PointsOptions, PointsFigure, _compute_points, _draw_points, lambda made: (6.0, 1.5 + 0.34 * len(made.rows))
)


ENOUGH = 20
"""Configurations of a pair of which it is said that none is right: the interval of 0 of 20 ends at 17 %."""

SHORT = 4
"""Letters that stand level under a column."""


class HeatMapOptions(Options):
    """Options of a heat map."""

    rows: str
    columns: str


def _compute_pairs(table: Table, options: HeatMapOptions) -> HeatMapFigure:
    by_row = {name: Table(rows, table.groups).by(options.columns) for name, rows in table.by(options.rows).items()}
    rows, columns = list(by_row), list(table.by(options.columns))
    seen = [[len(by_row[row].get(column, ())) for column in columns] for row in rows]
    correct = [[sum(one.correct for one in by_row[row].get(column, ())) for column in columns] for row in rows]
    cells = [
        count_of(f"{row} with {_named(column, options.columns)}", correct[up][across], seen[up][across])
        for up, row in enumerate(rows)
        for across, column in enumerate(columns)
    ]
    return HeatMapFigure(
        figure="heat map",
        title=options.title or f"Accuracy by {options.rows} and {options.columns}",
        text=_said_pairs(cells, plural(options.rows), plural(options.columns)),
        row=options.rows,
        column=options.columns,
        rows=rows,
        columns=columns,
        configurations=seen,
        correct=correct,
    )


def _named(value: str, column: str) -> str:
    """A number says what it is of: ``severity 3``."""
    return f"{bare(column)} {value}" if value[:1].isdigit() or value[:1] == "-" else value


def _said_pairs(cells: list[NamedCount], rows: str, columns: str) -> list[str]:
    known = [one for one in cells if one.configurations]
    none = [one for one in known if one.correct == 0]
    enough = [one for one in none if one.configurations >= ENOUGH]
    some = "; ".join(f"{one.name} ({rate_with_interval(one)})" for one in enough[:4]) + (
        "; and others" if len(enough) > 4 else ""
    )
    said = [f"No answer is right in {len(enough)} of {len(known)} pairs: {some}."] if enough else []
    if few := len(none) - len(enough):
        have = "have" if few > 1 else "has"
        said.append(f"{few} of the pairs without a right answer {have} under {ENOUGH} configurations: too few to say.")
    return [*extremes(cells, "The lowest pair", "the highest", f"pairs of {rows} and {columns}"), *said]


def _draw_pairs(made: HeatMapFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    shares = [
        [right / seen if seen else float("nan") for right, seen in zip(*pair, strict=True)]
        for pair in zip(made.correct, made.configurations, strict=True)
    ]
    shown = axes.imshow(shares, cmap="RdBu", vmin=0.0, vmax=1.0, aspect="auto")
    for up, row in enumerate(shares):
        for across, share in enumerate(row):
            if share == share:
                colour = "white" if abs(share - 0.5) > 0.3 else "black"
                axes.text(across, up, f"{100 * share:.0f}", ha="center", va="center", color=colour, fontsize=7.5)
    turned = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if max(map(len, made.columns)) > SHORT else {}
    axes.set_xticks(range(len(made.columns)), made.columns, **turned)
    axes.set_yticks(range(len(made.rows)), made.rows)
    axes.set(xlabel=made.column, ylabel=made.row)
    axes.set_title(made.title)
    figure.colorbar(shown, ax=axes, label="accuracy [%]", format=lambda share, _: f"{100 * share:.0f}")


HEAT_MAP = FigureKind(
    HeatMapOptions,
    HeatMapFigure,
    _compute_pairs,
    _draw_pairs,
    lambda made: (max(2.8 + 0.42 * len(made.columns), 5.4), 1.9 + 0.28 * len(made.rows)),
)


class CorruptionOptions(Options):
    """Options of corruption errors: the parameter that names one, and the part with pictures that have none."""

    which: str = "corruption.which"
    clean: str = Field(default="clean", max_length=40)


def _compute_corruptions(table: Table, options: CorruptionOptions) -> CorruptionFigure:
    models: list[CorruptionModel] = []
    for name, rows in table.by("model").items():
        models.append(_model(name, Table(rows, table.groups), options, models[0] if models else None))
    return CorruptionFigure(
        figure="corruption error",
        title=options.title or "Error under each corruption, mean over severities",
        text=[text for one in models for text in _said_corruptions(one, models[0].model)],
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


def _said_corruptions(one: CorruptionModel, first: str) -> list[str]:
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


def _draw_corruptions(made: CorruptionFigure, figure: Any, run: Path) -> None:
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
    _compute_corruptions,
    _draw_corruptions,
    lambda made: (6.0, 1.4 + (0.2 + 0.09 * len(made.models)) * len(made.models[0].errors)),
    tells_models=True,
)


SIZE = 6.4, 2.65
"""Of one object's map, width and height in inches."""


def _compute_surface(table: Table, options: Options) -> SurfaceFigure:
    if not table.surfaces:
        raise InputError("figures: surface: expected a sweep with `surface: true` among its parts, got none")
    maps = [SurfaceOf(run=run, tables=found.tables) for run, found in table.surfaces.items()]
    return SurfaceFigure(
        figure="surface",
        title=options.title or "Which parts of the surface go with wrong answers",
        text=[text for found in table.surfaces.values() for text in surface_sentences(found)],
        maps=maps,
    )


def _draw_surface(made: SurfaceFigure, figure: Any, run: Path) -> None:
    from matplotlib.image import imread  # matplotlib takes half a second

    for axes, one in zip(figure.subplots(len(made.maps), squeeze=False)[:, 0], made.maps, strict=True):
        axes.imshow(imread(run / PARTS / one.run / IMAGES / "surface.png"))
        axes.axis("off")


SURFACE = FigureKind(
    Options,
    SurfaceFigure,
    _compute_surface,
    _draw_surface,
    lambda made: (SIZE[0], SIZE[1] * len(made.maps)),
    tells_models=True,
)
