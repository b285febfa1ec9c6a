"""Figures that pair or measure whole runs: photographs beside renderings, workers beside each other, surfaces."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from pydantic import Field

from advsearch.errors import InputError
from advsearch.questions.recipe.answer import PHOTOGRAPHS, Cell
from advsearch.questions.recipe.table import (
    ANSWER,
    COUNT,
    PART,
    WORKERS,
    MadeFigure,
    Options,
    Rows,
    Table,
    Tally,
    draw_bars,
)
from advsearch.questions.sweep.answer import surface_sentences
from advsearch.report.figures import BLUE
from advsearch.report.wording import count, percent, short_name
from advsearch.runs.directory import IMAGES, PARTS

NO_PHOTOGRAPHS = (
    "There are no photographs yet: nothing is said about reality here. Take some with advsearch dashboard and the "
    "runs in parts/, or name a folder of them (photographs=FOLDER), and let advsearch resume go on with this run."
)
ALL = "all objects"


class AgreementOptions(Options):
    """Options of agreements: the part whose renderings are compared with photographs, and parts that picture the same
    configurations under other conditions."""

    of: tuple[str, ...] = Field(min_length=1)
    names: dict[str, str] = Field(default_factory=dict)

    @property
    def parts(self) -> tuple[str, ...]:
        """Those, and photographs."""
        return (*self.of, PHOTOGRAPHS)


def agreement(table: Table, options: AgreementOptions) -> MadeFigure:
    """Count in how many pairs the model is right, or wrong, about a rendering and another picture of the same alike."""
    renderings = table.rows[table.rows[PART] == options.of[0]].dropna(axis=1, how="all")
    if renderings.empty:
        raise InputError(f"figures: agreement: expected answers of a part {options.of[0]!r}, got none")
    # the values that renderings have; other pictures may have more
    names = [name for name in renderings if name not in (ANSWER, PART, "correct", "margin", "time", "unit")]
    objects = [ALL, *renderings["object"].unique()]
    text, rows, series = list[str](), list[list[Cell]](), dict[str, dict[str, Tally]]()
    for part in (PHOTOGRAPHS, *options.of[1:]):
        others, name = table.rows[table.rows[PART] == part], options.names.get(part, part)
        pairs = others.merge(renderings, on=names, suffixes=("", " rendered"))
        alone = len(others) - len(pairs)
        if part != PHOTOGRAPHS and alone:
            raise InputError(f"figures: agreement: expected {part} to have the configurations of {options.of[0]}")
        if part == PHOTOGRAPHS and others.empty:
            text.append(NO_PHOTOGRAPHS)
            continue
        series[name] = {}
        for thing in objects:
            some = pairs if thing == ALL else pairs[pairs["object"] == thing]
            first, second = some["correct rendered"], some["correct"]
            same_answer = int((some[f"{ANSWER} rendered"] == some[ANSWER]).sum())
            agreeing = Tally.over(thing, some, first == second)
            series[name][thing] = agreeing
            four = [int(((first == a) & (second == b)).sum()) for a in (True, False) for b in (True, False)]
            rows.append([name, thing, *four, same_answer, *agreeing.cells])
            if thing == ALL and len(some):
                same = f"{same_answer} of {len(some)} ({percent(same_answer / len(some))})"
                text.append(
                    f"Renderings and {name}: {agreeing.told('right about both or wrong about both')}. "
                    f"{_where(True, some)} {_where(False, some)} The answer is the same in {same}."
                )
        if part == PHOTOGRAPHS:
            text += ["The intervals take photographs as independent."] if len(pairs) else []
            belong = "belongs" if alone == 1 else "belong"
            text += [f"{alone} of the photographs {belong} to no rendering and so to no pair."] if alone else []
    title = options.title or "Renderings and other pictures of the same"

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        draw_bars(axes, {thing: [counts[thing] for counts in series.values()] for thing in objects}, list(series))
        axes.set(xlabel="share that agrees, with 95 % interval")
        figure.legend(loc="outside lower center", ncols=1)

    both = ["right, right", "right, wrong", "wrong, right", "wrong, wrong"]
    columns = ["rendering and", "object", *both, "same answer", "agree", *COUNT]
    return MadeFigure(title, text, columns, rows, draw, (6.0, 1.7 + 0.2 * len(series) + 0.34 * (len(objects) - 1)))


def _where(right: bool, pairs: Rows) -> str:
    """How often the model is right, or wrong, about the other picture where it is so about the rendering."""
    verb, some = "right" if right else "wrong", pairs[pairs["correct rendered"] == right]
    if some.empty:
        return f"It is {verb} about none of the renderings."
    told = Tally.over("", some, some["correct"] == right).told(verb)
    return f"Where it is {verb} about the rendering, it is {told} about the other."


def scaling(table: Table, options: Options) -> MadeFigure:
    """Say how many more pictures a second more workers make, each beside the fewest with the same object."""
    if WORKERS not in table.rows:
        raise InputError("figures: scaling: expected sweeps with `workers` among the parts, got none")
    runs = table.rows.groupby([WORKERS, "object"], sort=False)["time"]  # without rows of sweeps that say none
    rates = {(int(workers), str(name)): _rate(sorted(times)) for (workers, name), times in runs}
    counts = sorted({workers for workers, _ in rates})
    by_count = {each: [rate for (workers, _), rate in rates.items() if workers == each] for each in counts}
    linear = statistics.median(by_count[counts[0]]) / counts[0]
    text, rows = list[str](), list[list[Cell]]()
    for each in counts:
        gained = {
            name: rate / rates[counts[0], name]
            for (workers, name), rate in rates.items()
            if workers == each and (counts[0], name) in rates
        }
        gains = list(gained.values())
        rows += [[each, name, rate, gained.get(name)] for (workers, name), rate in rates.items() if workers == each]
        told = f"{count(each, 'worker')}: {_spread(by_count[each])} pictures a second"
        if each > counts[0] and gains:
            share = 100 * statistics.median(gains) * counts[0] / each
            told += f", {_spread(gains)} times as many as {count(counts[0], 'worker')} ({share:.0f} % of linear)"
        text.append(f"{told}.")
    few = min(map(len, by_count.values()))
    if few > 1:
        text.append(
            f"Medians of {few} runs, one of each object, with the lowest and the highest, which enclose the median of "
            f"all such runs with a confidence of {100 * (1 - 0.5 ** (few - 1)):.3g} %."
        )
    cores = count(table.cores, "core")
    text.append(f"This machine gives {cores}; what other programs took of it meanwhile is in these numbers.")
    title = options.title or "Pictures a second by number of workers"

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        straight = [linear * each for each in counts]
        axes.plot(counts, straight, color="0.7", label=f"linear, from {count(counts[0], 'worker')}")
        for each, own in by_count.items():
            axes.plot([each] * 2, [min(own), max(own)], color=BLUE, alpha=0.45, linewidth=3)
        middle = [statistics.median(own) for own in by_count.values()]
        axes.plot(counts, middle, "o-", color=BLUE, ms=5, label="median; bar: lowest to highest run")
        axes.set_xticks(counts, [str(each) for each in counts])
        axes.set(xlabel="workers", ylabel="pictures a second", ylim=(0.0, 1.08 * max([*straight, *rates.values()])))
        axes.grid(True, axis="y")
        figure.legend(loc="outside lower center", ncols=2)

    columns = ["workers", "object", "pictures a second", "times as many as the fewest workers"]
    return MadeFigure(title, text, columns, rows, draw, (6.0, 3.4))


def _rate(times: Sequence[float]) -> float:
    """Pictures a second, without the first quarter, in which workers load; rows of one batch are stored at once."""
    begun = times[len(times) // 4]
    if times[-1] <= begun:
        raise InputError("figures: scaling: expected runs of several batches; ask for more `samples`, or set `batch`")
    return sum(time > begun for time in times) / (times[-1] - begun)


def _spread(values: Sequence[float]) -> str:
    """The median, and where there are several values the ends of them: ``1.9 (1.8 to 2)``."""
    text = f"{statistics.median(values):.3g}"
    return f"{text} ({min(values):.3g} to {max(values):.3g})" if len(values) > 1 else text


SIZE = 6.4, 2.65
"""Of one object's map, width and height in inches."""


def surface(table: Table, options: Options) -> MadeFigure:
    """Show which parts of each object, when seen, go with wrong answers."""
    if not table.surfaces:
        raise InputError("figures: surface: expected a sweep with `surface: true` among its parts, got none")

    def draw(figure: Any) -> None:
        from matplotlib.image import imread  # matplotlib takes half a second

        for axes, run in zip(figure.subplots(len(table.surfaces), squeeze=False)[:, 0], table.surfaces, strict=True):
            axes.imshow(imread(table.folder / PARTS / run / IMAGES / "surface.png"))
            axes.axis("off")

    rows: list[list[Cell]] = [
        [one.object, short_name(one.model), one.part, one.seen, one.compared, one.worse, one.better]
        for each in table.surfaces.values()
        for one in each.tables
    ]
    columns = ["object", "model", "parts", "seen", "compared", "with wrong answers", "with right answers"]
    text = [sentence for each in table.surfaces.values() for sentence in surface_sentences(each)]
    title = options.title or "Which parts of the surface go with wrong answers"
    return MadeFigure(title, text, columns, rows, draw, (SIZE[0], SIZE[1] * len(table.surfaces)))
