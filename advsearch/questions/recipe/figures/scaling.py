"""Pictures a second against the number of workers, as 3DB (Leclerc et al. 2022) has them in figure 15b.

A run's rate is that of its rows from the first quarter to the last one: workers load scenes and models before, and not
all at once. Runs are compared with those of the fewest workers about the same object.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from advsearch.errors import InputError
from advsearch.explanations.observations import WORKERS, Answered, figure_value
from advsearch.questions.recipe.answer import ScalingFigure, ScalingPoint
from advsearch.questions.recipe.figures.base import FigureKind, Options
from advsearch.questions.recipe.table import Table
from advsearch.report.figures import BLUE


def _compute(table: Table, options: Options) -> ScalingFigure:
    runs: dict[tuple[int, str, str], list[Answered]] = {}
    for row in table.rows:
        count = row.values.get(WORKERS)
        if isinstance(count, (int, float)):
            runs.setdefault((int(count), row.part, str(row.values["object"])), []).append(row)
    if not runs:
        raise InputError("figures: scaling: expected sweeps with `workers` among the parts, got none")
    rates = {key: _rate(rows) for key, rows in runs.items()}
    fewest = min(count for count, _, _ in rates)
    alone = {name: rate for (count, _, name), rate in rates.items() if count == fewest}
    points = [
        _point(count, [(rate, alone.get(name)) for (other, _, name), rate in rates.items() if other == count])
        for count in sorted({count for count, _, _ in rates})
    ]
    return ScalingFigure(
        figure="scaling",
        title=options.title or "Pictures a second by number of workers",
        text=_said(points, table.cores),
        cores=table.cores,
        points=points,
    )


def _rate(rows: Sequence[Answered]) -> float:
    """Pictures a second; rows of one batch are stored at once."""
    times = sorted(row.time for row in rows if row.time is not None)
    begun = times[len(times) // 4] if times else 0.0
    if not times or times[-1] <= begun:
        raise InputError("figures: scaling: expected runs of several batches; ask for more `samples`, or set `batch`")
    return sum(time > begun for time in times) / (times[-1] - begun)


def _point(workers: int, rates: Sequence[tuple[float, float | None]]) -> ScalingPoint:
    return ScalingPoint(
        workers=workers, rates=[rate for rate, _ in rates], gains=[rate / base for rate, base in rates if base]
    )


def _said(points: Sequence[ScalingPoint], cores: int) -> list[str]:
    first, *others = points
    said = [f"{_workers(first)}: {_spread(first.rates)} pictures a second."]
    said += [
        f"{_workers(one)}: {_spread(one.rates)} pictures a second, {_spread(one.gains)} times as many as "
        f"{_workers(first)} ({100 * statistics.median(one.gains) * first.workers / one.workers:.0f} % of linear)."
        for one in others
        if one.gains
    ]
    runs = min(len(one.rates) for one in points)
    if runs > 1:
        said.append(
            f"Medians of {runs} runs, one of each object, with the lowest and the highest, which enclose the median of "
            f"all such runs with a confidence of {100 * (1 - 0.5 ** (runs - 1)):.3g} %."
        )
    few = f"{cores} core{'s' if cores > 1 else ''}"
    return [*said, f"This machine gives {few}; what other programs took of it meanwhile is in these numbers."]


def _workers(one: ScalingPoint) -> str:
    return f"{one.workers} worker{'s' if one.workers > 1 else ''}"


def _spread(values: Sequence[float]) -> str:
    """The median, and where there are several values the ends of them: ``1.9 (1.8 to 2)``."""
    text = f"{statistics.median(values):.3g}"
    return f"{text} ({min(values):.3g} to {max(values):.3g})" if len(values) > 1 else text


def _draw(made: ScalingFigure, figure: Any, run: Path) -> None:
    axes = figure.subplots()
    workers = [one.workers for one in made.points]
    middle = [statistics.median(one.rates) for one in made.points]
    linear = [middle[0] * count / workers[0] for count in workers]
    axes.plot(workers, linear, color="0.7", label=f"linear, from {_workers(made.points[0])}")
    for one in made.points:
        axes.plot([one.workers] * 2, [min(one.rates), max(one.rates)], color=BLUE, alpha=0.45, linewidth=3)
    axes.plot(workers, middle, "o-", color=BLUE, ms=5, label="median; bar: lowest to highest run")
    axes.set_xticks(workers, [figure_value(float(count)) for count in workers])
    top = max([*linear, *(rate for one in made.points for rate in one.rates)])
    axes.set(xlabel="workers", ylabel="pictures a second", ylim=(0.0, 1.08 * top))
    axes.set_title(made.title)
    axes.grid(True, axis="y")
    figure.legend(loc="outside lower center", ncols=2)


SCALING = FigureKind(Options, ScalingFigure, _compute, _draw, lambda made: (6.0, 3.4), tells_models=True)
