"""Figures of how often: right or wrong predictions, photographs that agree with
renderings, pictures a second, and parts of a surface that go with wrong predictions.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pandas as pd
from pandas.api.types import is_numeric_dtype
from pydantic import BaseModel, ConfigDict, Field

from advsearch.extend import (
    InputError,
    RunDirectory,
    Store,
    figures,
    results,
    statistics,
    wording,
    workbench,
)
from advsearch.questions.recipe.description import PHOTOGRAPHS

# ---------------------------------------------------------------------------------------------------------------------
# The rows of a recipe's runs as one frame, and what all figures make of it: counts,
# sentences, a picture.

PREDICTION = "answer"
GROUP = "group"
PART = "part"
TRIAL = "trial"
MODEL = "model"
WORKERS = "workers"
"""Columns beside parameters: what the model said, the group that an object is in, the
part of the recipe, which trial of an attack it is, the model, and the number of
processes that shared a sweep, of sweeps that say it.
"""

OTHERS = "other objects"

TRIALS = {"first control": "clean scene", "control": "clean scene", "verification": "answer",
          "baseline verification": "random search"}  # fmt: skip
"""The rows of an attack that are in the frame, and what figures call them."""

# columns of a count behind the one of what is counted
COUNT = ["of", "share", "low", "high"]
Cell = str | int | float | None
Numbers = npt.NDArray[np.float64]
Rows = Any  # pd.DataFrame, which has no types


def read_rows(
    part: str, folder: Path, summary: Any, seed: int, kinds: Sequence[str], **more: Cell
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return the rows of some kinds that a run has stored, and the units of their parameters. Each has what it shows
    (`object`, `environment`, `model`, and parameters), what was said of it (`answer`, `correct`, `margin`), the `time`
    when it was stored, seconds since 1970, and the `unit` of what it shares with rows that are not independent of it:
    draws of one seed are the same ones, also in another part."""
    rows = list[dict[str, Any]]()
    units = dict[str, str]()
    drawn = None
    with Store.open_to_read(folder) as store:
        if summary.command == "sweep":
            drawn = workbench.units_of(store, is_drawn=summary.sampler is not None)
        for row in store.rows():
            if row.kind not in kinds or (row.kind == "sweep" and row.is_out_of_view):
                continue
            values: dict[str, Any] = {
                name: about["value"] for name, about in row.values.items()
            }
            units |= {name: about["unit"] for name, about in row.values.items()}
            unit = f"{folder.name} {row.kind} {row.id}"
            if row.kind == "sweep" and drawn is not None:
                unit = f"{seed} {drawn.of(row.step)}"
            if summary.command == "attack":
                values[TRIAL], unit = TRIALS[row.kind], f"{seed} {row.step}"
            for name in ("object", "environment", MODEL):
                values[name] = wording.figure_value(
                    str(values.get(name, getattr(summary, name)))
                )
            values |= {
                PREDICTION: row.label or "none",
                "correct": bool(row.correct),
                "margin": row.margin,
            }
            rows.append({**values, "time": row.time, PART: part, "unit": unit, **more})
    return rows, units


def frame_of(
    rows: Iterable[Mapping[str, Any]], groups: Mapping[str, Sequence[str]], **facts: Any
) -> Rows:
    """Return rows as a frame, with the groups that name their objects if there are any;
    its ``attrs`` are the facts.
    """
    frame = pd.DataFrame(rows)
    if groups:
        named = {
            name: group
            for group, objects in reversed(list(groups.items()))
            for name in objects
        }
        frame[GROUP] = [named.get(name, OTHERS) for name in frame["object"]]
    frame.attrs = facts
    return frame


def column(rows: Rows, name: str) -> Any:
    """Return what each row has in a column; an InputError where some have nothing."""
    if name not in rows or rows[name].isna().any():
        named = rows.columns.drop(["correct", "margin", "time", "unit"])
        known = ", ".join(other for other in named if rows[other].notna().all())
        raise InputError(f"figures: expected one of {known}, got {name[:60]!r}")
    return rows[name]


def numbers(rows: Rows, name: str) -> Any:
    """Return what each row has in a column of numbers; an InputError where it has
    names.
    """
    if not pd.api.types.is_numeric_dtype(column(rows, name)):
        raise InputError(
            f"figures: {name}: expected a parameter with numbers, got names"
        )
    return rows[name]


def unit_of(rows: Rows, name: str) -> str:
    """Return the unit of a column as it stands behind a number: a space and the unit,
    or nothing.
    """
    return (
        ""
        if (unit := rows.attrs["units"].get(name, "")) in ("", "1", "name")
        else f" {unit}"
    )


def by(rows: Rows, name: str) -> dict[str, Rows]:
    """Return the rows by what they have in a column, in the order in which that first
    comes; numbers by size.
    """
    size = pd.api.types.is_numeric_dtype(column(rows, name))
    return {
        wording.figure_value(value): some
        for value, some in rows.groupby(name, sort=size)
    }


def most_frequent(predictions: Iterable[str]) -> list[tuple[str, int]]:
    """Return predictions with how often each was given, the most frequent first."""
    return sorted(Counter(predictions).items(), key=lambda item: (-item[1], item[0]))


class Tally:
    """How many of some rows are counted: of each independent unit, such as a drive,
    `counted` (n,) of its `of` (n,); in all `times` of `total`, and the mean over units
    of their share, None where there are no rows.
    """

    def __init__(self, name: str, counted: Numbers, of: Numbers) -> None:
        self.name = name
        self.counted = counted
        self.of = of
        self.times, self.total = round(float(counted.sum())), round(float(of.sum()))
        self.share = (
            statistics.clustered.mean_share(counted, of) if self.total else None
        )

    @classmethod
    def over(cls, name: str, rows: Rows, flags: Any = None) -> Tally:
        """Count rows: those with right predictions, or those that flags (n,) say."""
        counted = np.asarray(
            rows["correct"] if flags is None else flags, dtype=np.float64
        )
        units = pd.factorize(rows["unit"])[0]
        of_units = statistics.clustered.per_unit(np.ones(len(rows)), units)
        return cls(name, statistics.clustered.per_unit(counted, units), of_units)

    def called(self, name: str) -> Tally:
        return Tally(name, self.counted, self.of)

    @property
    def cells(self) -> list[Cell]:
        return [self.times, self.total, self.share, *(self.interval() or (None, None))]

    @property
    def drawn(self) -> tuple[float, results.Interval] | None:
        return (
            None if self.share is None else (self.share, self.interval() or (0.0, 1.0))
        )

    def interval(self, among: int = 1) -> results.Interval | None:
        """Return the 95 % interval of the share, widened for a choice among so many
        (Bonferroni).
        """
        if not self.total:
            return None
        confidence = 1.0 - (1.0 - statistics.intervals.CONFIDENCE) / max(among, 1)
        return statistics.clustered.share_interval(self.counted, self.of, confidence)

    def told(self, verb: str = "right") -> str:
        """Return ``right in 12 of 20 (60 %, 95 % interval 36-81 %)``; `verb` is what is
        counted.
        """
        share = (
            f"{wording.percent(self.share)}, 95 % interval "
            f"{wording.interval_text(self.interval())}"
        )
        return f"{verb} in {self.times} of {self.total} ({share})"

    def below(self, other: Tally, among: int = 1) -> bool:
        """Return whether the interval of this share lies below that of another, both
        widened.
        """
        lower = self.interval(among)
        upper = other.interval(among)
        return lower is not None and upper is not None and lower[1] < upper[0]


def extremes(
    counts: Sequence[Tally], worst: str, best: str, thing: str, verb: str = "right"
) -> list[str]:
    """Return which of several has the lowest share and which the highest, and whether
    that is more than chance: the two were chosen among k for being extreme, so that
    they are compared by intervals of confidence 1 - 0.05 / k, which hold for all k
    together. Where these overlap, no difference is shown. `verb` is what is counted.
    """
    known = [count for count in counts if count.total]
    if len(known) < 2:
        return [f"{count.name}: {count.told(verb)}." for count in known]
    shares = [count.share or 0.0 for count in known]
    low = known[int(np.argmin(shares))]
    high = known[int(np.argmax(shares))]
    if low.share == high.share:
        return [
            f"All {len(known)} {thing} have the same share, "
            f"{wording.percent(low.share)}: no difference is shown."
        ]
    named = []
    for tally in (low, high):
        ties = shares.count(tally.share or 0.0) - 1
        also = f" (as {ties} other{'s' if ties > 1 else ''})" if ties else ""
        named.append(f"is {tally.name}{also}: {tally.told(verb)}")
    widened = (
        f"the intervals of the two, widened for having been chosen among {len(known)},"
    )
    return [
        f"{worst} {named[0]}; {best} {named[1]}.",
        f"The difference is shown: {widened} do not overlap."
        if low.below(high, len(known))
        else f"No difference between the {thing} is shown: {widened} overlap.",
    ]


def plural(name: str) -> str:
    """Return what several values of a column are called: ``environments``,
    ``materials``, ``values of pose.yaw``.
    """
    control, _, parameter = name.partition(".")
    return (
        "kinds of trials"
        if name == TRIAL
        else f"{control}s"
        if parameter in ("", "which")
        else f"values of {name}"
    )


def bare(name: str) -> str:
    """Return a parameter's name without its control: ``milk`` for ``contents.milk``."""
    return name.rpartition(".")[2]


class Options(BaseModel):
    """Options that every figure has: a title in place of its own, and the parts whose
    rows it shows; all where none is named.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = Field(default="", max_length=200)
    of: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[str, ...]:
        return self.of


@dataclass(frozen=True)
class MadeFigure:
    """A figure: title, sentences, a table of its numbers, what draws all but the title,
    and its size in inches.
    """

    title: str
    text: Sequence[str]
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    draw: Callable[[Any], None]
    size: tuple[float, float]


# parts of a range where lines are drawn along it, and letters that stand level under a
# column
BINS = 12
FITTING = 4
Cells = Mapping[str, Sequence[Tally]]  # counts by the name of a row, one of each series


class RatesOptions(Options):
    """What the shares are by, and how they are drawn; docs/recipes.md has each."""

    by: str
    series: str | None = None
    form: Literal["bars", "lines", "map"] = "bars"
    bins: int | None = Field(default=None, ge=1, le=100)
    range: tuple[float, float] | None = None
    names: dict[str, str] = Field(default_factory=dict)
    wrong: bool = False
    beside: str | None = None
    away_from: float | None = None
    turn: float | None = Field(default=None, gt=0.0)

    @property
    def parts(self) -> tuple[str, ...]:
        return (*self.of, *([self.beside] if self.beside and self.of else []))

    @property
    def what(self) -> str:
        if self.away_from is None:
            return self.by
        return f"the distance of {self.by} from {wording.figure_value(self.away_from)}"


def rates(rows: Rows, options: RatesOptions) -> MadeFigure:
    verb = "wrong" if options.wrong else "right"
    form = options.form
    second = options.series
    beside = rows[rows[PART] == options.beside]
    rows = rows[rows[PART] != options.beside]
    if rows.empty:
        raise InputError(
            "figures: rates: expected rows of a part beside "
            f"{options.beside!r}, got none"
        )
    lines = list(by(rows, second)) if second else [""]
    groups, middles = _groups(rows, options)

    def called(name: str) -> str:
        return options.names.get(name, name)

    def counts(name: str, some: Rows) -> list[Tally]:
        split = by(some, second) if second and len(some) else {"": some}
        each = [split.get(line, some[:0]) for line in lines]
        return [
            Tally.over(name, part, part["correct"] != options.wrong) for part in each
        ]

    cells = {called(name): counts(name, some) for name, some in groups.items()}
    if (
        form == "bars"
        and middles is None
        and not is_numeric_dtype(column(rows, options.by))
    ):
        cells = dict(sorted(cells.items(), key=lambda item: -(item[1][0].share or 0.0)))
    series = [called(name) for name in lines]
    totals = counts("all", rows)
    of_what = f"{bare(second or '')} "  # a number says what it is of: "severity 3"
    of_series = [of_what * (name[:1] in tuple("-0123456789")) + name for name in series]
    thing = plural(options.by) + (f" and {plural(second)}" if second else "")
    apart = (
        {called(options.beside): counts("", beside)}
        if options.beside and len(beside)
        else {}
    )
    text = list[str]()
    if form == "map":
        pairs = [
            tally.called(f"{row} with {name}")
            for row, each in cells.items()
            for name, tally in zip(of_series, each, strict=True)
        ]
        text += extremes(
            pairs, "The lowest pair", "the highest", f"pairs of {thing}", verb
        )
    else:
        where = f" where {options.what}" if middles else ""
        for number, name in enumerate(series):
            along = [each[number].called(row) for row, each in cells.items()]
            # of one row all is said below
            if len(series) < 2 or sum(tally.total > 0 for tally in along) > 1:
                worst = f"For {name}, lowest" if len(series) > 1 else "Lowest"
                text += extremes(
                    along,
                    f"{worst}{where}",
                    f"highest{where}",
                    plural(options.by),
                    verb,
                )
    # in one text, so that figures by other columns do not repeat it
    if second and len(series) > 1:
        overall = [
            tally.called(f"that of {name}")
            for name, tally in zip(of_series, totals, strict=True)
        ]
        of_all = extremes(
            overall, "Over all, the lowest share", "the highest", plural(second), verb
        )
        text.append(" ".join(of_all))
    for number, name in enumerate(
        series[1:] if options.wrong and second == MODEL else (), start=1
    ):
        # the mean over rows of each model's errors over those of the first; rows
        # without any of that are left out
        if ratios := [
            (each[number].share or 0.0) / each[0].share
            for each in cells.values()
            if each[0].share
        ]:
            mean = 100.0 * sum(ratios) / len(ratios)
            text.append(
                f"Relative to {series[0]}, in AlexNet's place, the mCE of "
                f"{name} is {mean:.0f} %."
            )
    for name, alone in apart.items():
        for line, tally, total in zip(series, alone, totals, strict=True):
            more = (
                "is shown"
                if tally.below(total) or total.below(tally)
                else "is not shown"
            )
            whose = f"{line}, " if len(series) > 1 else ""
            text.append(
                f"{whose}{name}: {tally.told(verb)}; the others: "
                f"{total.told(verb)}. A difference {more}."
            )
    every = {**apart, **cells, **({"all": totals} if second else {})}
    counted = [
        (name, line, tally)
        for name, each in every.items()
        for line, tally in zip(series, each, strict=True)
    ]
    table = [
        [name, *([line] if second else []), *tally.cells]
        for name, line, tally in counted
    ]

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        label = f"{verb}, share"
        if form == "map":
            _draw_map(axes, cells, series, label)
            axes.set(ylabel=options.by, xlabel=second or "")
        elif form == "lines":
            _draw_lines(axes, cells, series, middles or range(len(cells)))
            unit = unit_of(rows, options.by)
            across = f"{options.what} [{unit[1:]}]" if unit else options.what
            axes.set(xlabel=across, ylabel=f"{label} with 95 % interval")
        else:
            shares = {
                name: [tally.drawn for tally in each]
                for name, each in {**apart, **cells}.items()
            }
            figures.draw_shares(axes, shares, series)
            axes.set(xlabel=f"{label} with 95 % interval")
        if len(series) > 1 and form != "map":
            figure.legend(loc="outside lower center", ncols=min(len(series), 3))

    size = (
        (6.0, 3.4)
        if form == "lines"
        else (6.0, 1.4 + (0.2 + 0.09 * len(series)) * len({**apart, **cells}))
    )
    if form == "map":
        size = max(2.8 + 0.42 * len(series), 5.4), 1.9 + 0.28 * len(cells)
    title = f"{'Error' if options.wrong else 'Accuracy'} by {thing}"
    return MadeFigure(
        title,
        text,
        [options.by, *([second] if second else []), verb, *COUNT],
        table,
        draw,
        size,
    )


def _groups(
    rows: Rows, options: RatesOptions
) -> tuple[Mapping[str, Rows], list[float] | None]:
    """The rows by their values, or by the parts of a range with the middle of each."""
    if options.bins is None and options.form != "lines":
        return by(rows, options.by), None
    values = numbers(rows, options.by)
    bins = options.bins or BINS
    unit = unit_of(rows, options.by)
    if options.away_from is not None:
        values = (values - options.away_from).abs()
        if options.turn is not None:  # the shorter way round
            values = np.minimum(
                values % options.turn, options.turn - values % options.turn
            )
    low, high = options.range or (values.min(), values.max())
    if not high > low:
        raise InputError(
            f"figures: rates: expected values of {options.by} that "
            f"differ, got {low:g} to {high:g}"
        )
    places = ((values - low) / (high - low) * bins).clip(upper=bins - 1).where(
        values.between(low, high)
    ) // 1
    ends = list(
        pairwise(low + (high - low) * number / bins for number in range(bins + 1))
    )
    named = [
        f"{wording.figure_value(begin)} to {wording.figure_value(end)}{unit}"
        for begin, end in ends
    ]
    return {name: rows[places == place] for place, name in enumerate(named)}, [
        (a + b) / 2 for a, b in ends
    ]


def _draw_map(axes: Any, cells: Cells, series: Sequence[str], label: str) -> None:
    shares = [
        [math.nan if tally.share is None else tally.share for tally in each]
        for each in cells.values()
    ]
    image = axes.imshow(shares, cmap="RdBu", vmin=0.0, vmax=1.0, aspect="auto")
    for (up, across), share in np.ndenumerate(shares):
        if not math.isnan(share):
            colour = "white" if abs(share - 0.5) > 0.3 else "black"
            axes.text(
                across,
                up,
                f"{100 * share:.0f}",
                ha="center",
                va="center",
                color=colour,
                fontsize=7.5,
            )
    turned = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(
        range(len(series)),
        series,
        **(turned if max(map(len, series)) > FITTING else {}),
    )
    axes.set_yticks(range(len(cells)), list(cells))
    axes.figure.colorbar(
        image,
        ax=axes,
        label=f"{label} [%]",
        format=lambda share, _: f"{100 * share:.0f}",
    )


def _draw_lines(
    axes: Any, cells: Cells, series: Sequence[str], middles: Sequence[float]
) -> None:
    for number, name in enumerate(series):
        known = [
            (at, each[number])
            for at, each in zip(middles, cells.values(), strict=True)
            if each[number].total
        ]
        at = [place for place, _ in known]
        colour = figures.SERIES[number % len(figures.SERIES)]
        low, high = (
            [(tally.interval() or (0.0, 1.0))[end] for _, tally in known]
            for end in (0, 1)
        )
        axes.fill_between(at, low, high, color=colour, alpha=0.15, linewidth=0)
        mark = figures.MARKS[number % len(figures.MARKS)]
        axes.plot(
            at,
            [tally.share for _, tally in known],
            color=colour,
            marker=mark,
            ms=4,
            label=name,
        )
    axes.set(ylim=(-0.03, 1.03))
    axes.grid(True, axis="y")


NO_PHOTOGRAPHS = (
    "There are no photographs yet: nothing is said about reality here. Take some with "
    "advsearch dashboard and the "
    "runs in parts/, or name a folder of them (photographs=FOLDER), and let advsearch "
    "resume go on with this run."
)
ALL = "all objects"


class AgreementOptions(Options):
    """Options of agreements: the part whose renderings are compared with photographs,
    and parts that picture the same configurations under other conditions.
    """

    of: tuple[str, ...] = Field(min_length=1)
    names: dict[str, str] = Field(default_factory=dict)

    @property
    def parts(self) -> tuple[str, ...]:
        return (*self.of, PHOTOGRAPHS)


def agreement(rows: Rows, options: AgreementOptions) -> MadeFigure:
    """Count in how many pairs the model is right, or wrong, about a rendering and
    another picture of the same alike.
    """
    renderings = rows[rows[PART] == options.of[0]].dropna(axis=1, how="all")
    if renderings.empty:
        raise InputError(
            "figures: agreement: expected predictions of a part "
            f"{options.of[0]!r}, got none"
        )
    of_each = {PREDICTION, PART, "correct", "margin", "time", "unit"}
    # the values of renderings; others may have more
    shared = [name for name in renderings if name not in of_each]
    text = list[str]()
    table = list[list[Cell]]()
    series = list[str]()
    bars: dict[str, list[Tally]] = {
        thing: [] for thing in (ALL, *renderings["object"].unique())
    }
    for part in (PHOTOGRAPHS, *options.of[1:]):
        others = rows[rows[PART] == part]
        name = options.names.get(part, part)
        pairs = others.merge(renderings, on=shared, suffixes=("", " rendered"))
        alone = len(others) - len(pairs)
        if part == PHOTOGRAPHS and others.empty:
            text.append(NO_PHOTOGRAPHS)
            continue
        if part != PHOTOGRAPHS and alone:
            raise InputError(
                f"figures: agreement: expected {part} to have the "
                f"configurations of {options.of[0]}"
            )
        series.append(name)
        for thing, tallies in bars.items():
            some = pairs if thing == ALL else pairs[pairs["object"] == thing]
            first = some["correct rendered"]
            second = some["correct"]
            four = [
                int(((first == a) & (second == b)).sum())
                for a in (True, False)
                for b in (True, False)
            ]
            same = int((some[f"{PREDICTION} rendered"] == some[PREDICTION]).sum())
            tallies.append(tally := Tally.over(thing, some, first == second))
            table.append([name, thing, *four, same, *tally.cells])
            if thing == ALL and len(some):
                text.append(
                    f"Renderings and {name}: "
                    f"{tally.told('right about both or wrong about both')}. "
                    f"{_where(True, some)} {_where(False, some)} "
                    f"The prediction is the same in {same} of {len(some)} "
                    f"({wording.percent(same / len(some))})."
                )
        if part == PHOTOGRAPHS:
            text += (
                ["The intervals take photographs as independent."] if len(pairs) else []
            )
            belong = "belongs" if alone == 1 else "belong"
            text += (
                [
                    f"{alone} of the photographs {belong} to no rendering and so to "
                    "no pair."
                ]
                if alone
                else []
            )

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        shares = {name: [tally.drawn for tally in each] for name, each in bars.items()}
        figures.draw_shares(axes, shares, series)
        axes.set(xlabel="share that agrees, with 95 % interval")
        figure.legend(loc="outside lower center", ncols=1)

    four_heads = ["right, right", "right, wrong", "wrong, right", "wrong, wrong"]
    heads = ["rendering and", "object", *four_heads, "same prediction", "agree", *COUNT]
    size = 6.0, 1.7 + 0.2 * len(series) + 0.34 * (len(bars) - 1)
    return MadeFigure(
        "Renderings and other pictures of the same", text, heads, table, draw, size
    )


def _where(right: bool, pairs: Rows) -> str:
    verb = "right" if right else "wrong"
    some = pairs[pairs["correct rendered"] == right]
    if some.empty:
        return f"It is {verb} about none of the renderings."
    told = Tally.over("", some, some["correct"] == right).told(verb)
    return f"Where it is {verb} about the rendering, it is {told} about the other."


def scaling(rows: Rows, options: Options) -> MadeFigure:
    """Measure the pictures a second of sweeps by the number of workers that shared
    them.
    """
    if WORKERS not in rows:
        raise InputError(
            "figures: scaling: expected sweeps with `workers` among the parts, got none"
        )
    # without rows of sweeps that say none
    runs = rows.groupby([WORKERS, "object"], sort=False)["time"].agg(_rate)
    by_count = {
        int(workers): found.droplevel(0) for workers, found in runs.groupby(level=0)
    }
    fewest, slowest = next(iter(by_count.items()))
    text = list[str]()
    table = list[list[Cell]]()
    for workers, found in by_count.items():
        gains = (found / slowest.reindex(found.index)).dropna()
        table += [
            [workers, str(name), float(rate), gains.get(name)]
            for name, rate in found.items()
        ]
        told = f"{wording.count(workers, 'worker')}: {_spread(found)} pictures a second"
        if workers > fewest and len(gains):
            share = 100 * gains.median() * fewest / workers
            told += (
                f", {_spread(gains)} times as many as "
                f"{wording.count(fewest, 'worker')} ({share:.0f} % of linear)"
            )
        text.append(f"{told}.")
    if (few := min(map(len, by_count.values()))) > 1:
        text.append(
            f"Medians of {few} runs, one of each object, with the lowest and the "
            "highest, which enclose the median of "
            f"all such runs with a confidence of {100 * (1 - 0.5 ** (few - 1)):.3g} %."
        )
    cores = wording.count(rows.attrs["cores"], "core")
    text.append(
        f"This machine gives {cores}; what other programs took of it meanwhile "
        "is in these numbers."
    )

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        counts = list(by_count)
        straight = [slowest.median() / fewest * workers for workers in counts]
        axes.plot(
            counts,
            straight,
            color="0.7",
            label=f"linear, from {wording.count(fewest, 'worker')}",
        )
        for workers, found in by_count.items():
            axes.plot(
                [workers] * 2,
                [found.min(), found.max()],
                color=figures.BLUE,
                alpha=0.45,
                linewidth=3,
            )
        middle = [found.median() for found in by_count.values()]
        axes.plot(
            counts,
            middle,
            "o-",
            color=figures.BLUE,
            ms=5,
            label="median; bar: lowest to highest run",
        )
        axes.set_xticks(counts, list(map(str, counts)))
        axes.set(
            xlabel="workers",
            ylabel="pictures a second",
            ylim=(0.0, 1.08 * max(*straight, runs.max())),
        )
        axes.grid(True, axis="y")
        figure.legend(loc="outside lower center", ncols=2)

    heads = [
        "workers",
        "object",
        "pictures a second",
        "times as many as the fewest workers",
    ]
    return MadeFigure(
        "Pictures a second by number of workers", text, heads, table, draw, (6.0, 3.4)
    )


def _rate(times: Any) -> float:
    """Pictures a second, without the first quarter, in which workers load; rows of one
    batch are stored at once.
    """
    times = np.sort(times)
    begun = times[len(times) // 4]
    if times[-1] <= begun:
        raise InputError(
            "figures: scaling: expected runs of several batches; ask for "
            "more `samples`, or set `batch`"
        )
    return float((times > begun).sum() / (times[-1] - begun))


def _spread(values: Any) -> str:
    """The median, and where there are several values the ends of them: ``1.9 (1.8 to
    2)``.
    """
    text = f"{values.median():.3g}"
    return (
        f"{text} ({values.min():.3g} to {values.max():.3g})"
        if len(values) > 1
        else text
    )


def surface(rows: Rows, options: Options) -> MadeFigure:
    """Show which parts of each object, when seen, go with wrong predictions."""
    surfaces = rows.attrs["surfaces"]
    if not surfaces:
        raise InputError(
            "figures: surface: expected a sweep with `surface: true` "
            "among its parts, got none"
        )

    def draw(figure: Any) -> None:
        from matplotlib.image import imread  # matplotlib takes half a second

        for axes, run in zip(
            figure.subplots(len(surfaces), squeeze=False)[:, 0], surfaces, strict=True
        ):
            axes.imshow(
                imread(
                    RunDirectory.locate_part(rows.attrs["folder"], run)
                    / "images"
                    / "surface.png"
                )
            )
            axes.axis("off")

    table: list[list[Cell]] = [
        [
            part.object,
            wording.short_name(part.model),
            part.part,
            part.seen,
            part.compared,
            part.worse,
            part.better,
        ]
        for found in surfaces.values()
        for part in found.tables
    ]
    heads = [
        "object",
        "model",
        "parts",
        "seen",
        "compared",
        "with wrong predictions",
        "with right predictions",
    ]
    text = [
        sentence
        for found in surfaces.values()
        for sentence in workbench.surface_sentences(found)
    ]
    title = "Which parts of the surface go with wrong predictions"
    return MadeFigure(title, text, heads, table, draw, (6.4, 2.65 * len(surfaces)))
