"""What is compared, read from stored sweeps: for every side its rows, and two sides counted pair by pair.

Pictures of a sweep are numbered, and the draw of a picture follows from its number. So sweeps with the same seed, grid
and controls have the same draws, and pictures with the same number are a pair, whatever else differs. Pairs are counted
in all, by each parameter, and where one side is worse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch import seeds
from advsearch.attacks.units import paired_by_unit, per_unit, share_interval
from advsearch.config import SweepConfig
from advsearch.errors import FileFormatError, InputError
from advsearch.explanations import FEWEST_ROWS, CountedRule, Factor, Observations, condition_rows, find_rules
from advsearch.questions.compare.answer import ComparedPair, CountOf, PairPart, PairRule
from advsearch.report.wording import short_names
from advsearch.runs.directory import CONFIG
from advsearch.runs.results.sweep import AxisValue, SweepSummary
from advsearch.runs.store import NAME, Store
from advsearch.runs.summary import read_result
from advsearch.runs.units import units_of
from advsearch.viewer.columns import KIND, Column, read_columns

DRAWS = ("grid", "controls", "samples", "sampler", "seed")
"""The settings that decide what is drawn."""

OF_THE_SIDE = ("object", "model", "answer")
"""What may tell sides apart, as rows have it."""

FOLLOWS = (*DRAWS, "label", "labels", "prompt", "up", "batch", "keep_pictures", "trials", "verify_spp", "specialise")
"""Settings that do not tell sweeps apart: of draws, along with object and model, or of no answer."""

TOLERANCE = 1e-4
"""Of a value, relative to the largest in its column: values come from single precision."""

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Side:
    """One of the things that are compared.

    Attributes:
        name: what tells it from the others.
        folder, config, summary: of its sweep.
        named: object, model and answer.
        numbers: (n,) of the pictures in its sweep.
        units: (n,) of the draws that they are of: frames of a drive have one.
        right: (n,) whether the model is right.
        margin: (n,) float32, over 0 where the answer is wrong; NaN where there was none.
        answers: (n,) in words.
        columns: of the parameters, each with n rows; without what names the side.
        seconds: of an answer.
    """

    name: str
    folder: Path
    config: SweepConfig
    summary: SweepSummary
    named: dict[str, str]
    numbers: npt.NDArray[np.int64]
    units: npt.NDArray[np.int64]
    right: Mask
    margin: npt.NDArray[np.float32]
    answers: npt.NDArray[np.str_]
    columns: tuple[Column, ...]
    seconds: float

    def __len__(self) -> int:
        return len(self.right)


def read_sides(folders: Sequence[Path]) -> list[Side]:
    """Return what the sweeps in some folders compare, each side with a name of its own.

    A sweep has a side for each of its models. The sweep of an answer has these without the answer and with it; beside
    other sweeps, only with it.

    Raises:
        FileFormatError: a folder has another run, or a sweep that has not ended.
        InputError: there is nothing to compare, or sweeps are of other draws.
    """
    sides = [side for folder in folders for side in _sides_of(folder, alone=len(folders) == 1)]
    if len(sides) < 2:
        raise InputError(
            f"compared: expected a sweep of several models, or several sweeps, got {folders[0]}, a sweep of one model; "
            "name another sweep of the same draws beside it, or give `model` two models when you sweep"
        )
    for side in sides[1:]:
        _check_pair(sides[0], side)
    return _with_names(sides)


def differing(sides: Sequence[Side]) -> list[str]:
    """Return the settings in which the sweeps of some sides differ and that decide answers."""
    given = [side.config.deciding() for side in sides]
    several = {name for name in OF_THE_SIDE if len({side.named[name] for side in sides}) > 1}
    names = {name for one in given[1:] for name in one if one[name] != given[0][name]}
    files = {name for name in ("object", "model") if len({getattr(side.config, name) for side in sides}) > 1}
    return sorted((names | several | files) - {*FOLLOWS, "answer_of"})


def shared_columns(first: Side, second: Side) -> list[Column]:
    """Return the parameters in which both sides have the same values, and that vary."""
    others = {one.name: one for one in second.columns}
    return [one for one in varying(first.columns) if one.name in others and _same(one, others[one.name])]


def varying(columns: Sequence[Column]) -> list[Column]:
    """Return those of some columns that have more than one value."""
    return [one for one in columns if len(np.unique(_values(one))) > 1]


def observations(columns: Sequence[Column], right: Mask, units: npt.NDArray[np.int64]) -> Observations | None:
    """Return parameters and a verdict (n,) as rules are sought in them, and the unit (n,) of each; None where nothing
    varies."""
    factors, values = [], []
    for one in columns:
        numbers = one.data.astype(np.float64)
        if one.levels is None and np.isnan(numbers).any():
            continue
        if one.levels is not None:
            names = sorted(one.levels)
            factors.append(Factor(one.name, "", tuple(names)))
            numbers = np.array([names.index(level) for level in one.levels], np.float64)[one.data]
        else:
            factors.append(Factor(one.name, one.unit))
        values.append(numbers)
    return Observations(tuple(factors), np.stack(values, axis=1), right, units) if values else None


def _sides_of(folder: Path, *, alone: bool) -> list[Side]:
    summary = read_result(folder)
    if not isinstance(summary, SweepSummary):
        raise FileFormatError(f"{folder}: expected the run of a sweep, got one of {summary.command}; sweep first")
    if summary.goes_on or summary.configurations != summary.planned:
        raise FileFormatError(
            f"{folder}: expected a sweep that has ended, got one with {summary.configurations} of {summary.planned} "
            f"answers; go on with it: advsearch resume {folder}"
        )
    config, found = SweepConfig.from_yaml(folder / CONFIG), read_columns(folder)
    if len(found.step) != summary.planned or len(np.unique(found.step)) != summary.planned:
        raise FileFormatError(
            f"{folder}: expected {summary.planned} rows, as its summary says, got {len(found.step)}; sweep again"
        )
    order, models = np.argsort(found.step), len(config.models)
    pictures = summary.planned // models
    halves = [range(pictures)]
    if config.answer_of is not None:
        halves = [range(pictures // 2), range(pictures // 2, pictures)][0 if alone else 1 :]
    with Store(folder / NAME, read_only=True) as store:
        units = units_of(store, summary)
    assert units is not None
    seconds, sides = _seconds(folder), []
    for half in halves:
        numbers = np.arange(half.start, half.stop)
        for model in range(models):
            rows = order[numbers * models + model]
            columns = tuple(replace(one, data=one.data[rows]) for one in found.parameters)
            named = {"object": summary.object, "model": config.models[model], "answer": ""}
            named |= {one.name: _together(one) for one in columns if one.name in OF_THE_SIDE}
            sides.append(
                Side(
                    name="",
                    folder=folder,
                    config=config,
                    summary=summary,
                    named=named,
                    numbers=numbers,
                    units=units.draw(numbers),
                    right=found.right[rows] == 1,
                    margin=found.margin[rows],
                    answers=np.array(found.answers)[found.answer[rows]],
                    columns=tuple(one for one in columns if one.name not in ("model", "answer")),
                    seconds=seconds,
                )
            )
    return sides


def _seconds(folder: Path) -> float:
    """Mean seconds of an answer; NaN where rows do not say it."""
    with Store(folder / NAME, read_only=True) as store:
        known = [row.seconds for row in store.rows(KIND) if row.seconds is not None]
    return float(np.mean(known)) if known else float("nan")


def _together(column: Column) -> str:
    """The names in a column, in their order."""
    levels = column.levels or ()
    return ",".join(levels[number] for number in dict.fromkeys(column.data.tolist()) if number < len(levels))


def _check_pair(first: Side, other: Side) -> None:
    if first.folder == other.folder:
        return
    where = f"{first.folder} and {other.folder}"
    for name in DRAWS:
        one, two = (side.config.deciding()[name] for side in (first, other))
        if one != two:
            raise InputError(
                f"compared: expected sweeps of the same draws, got {where}, whose `{name}` differ; sweep one of them "
                "again with the settings of the other"
            )
    if len(first) != len(other):
        raise InputError(
            f"compared: expected sweeps with as many pictures, got {len(first)} and {len(other)} in {where}; sweep as "
            "many objects and environments in both"
        )
    if first.named["object"] != other.named["object"]:
        return  # ranges may follow from the object
    others = {one.name: one for one in other.columns}
    for column in first.columns:
        if column.name not in (*OF_THE_SIDE, "environment") and column.name in others:
            if not _same(column, others[column.name]):
                raise InputError(
                    f"compared: expected sweeps of the same draws, got {where} with other values of {column.name}; "
                    "sweep both again"
                )


def _values(column: Column) -> npt.NDArray[np.generic]:
    return column.data if column.levels is None else np.array(column.levels)[column.data]


def _same(one: Column, other: Column) -> bool:
    if (one.levels is None) != (other.levels is None):
        return False
    if one.levels is not None:
        return bool((_values(one) == _values(other)).all())
    scale = float(np.nanmax(np.abs(one.data), initial=0.0))
    return bool(np.allclose(one.data, other.data, rtol=0.0, atol=TOLERANCE * scale, equal_nan=True))


def _with_names(sides: Sequence[Side]) -> list[Side]:
    """The sides, each called what tells it from the others."""
    told = [name for name in OF_THE_SIDE if len({side.named[name] for side in sides}) > 1]
    names = [", ".join(short_names(side.named[name]) or "as it is" for name in told) for side in sides]
    if len(set(names)) < len(names):
        names = [", ".join(filter(None, (side.folder.name, name))) for side, name in zip(sides, names, strict=True)]
    if len(set(names)) < len(names):
        names = [f"{number + 1}: {name}" for number, name in enumerate(names)]
    return [replace(side, name=name) for side, name in zip(sides, names, strict=True)]


MOST_VALUES = 64
"""Different numbers of a parameter, beyond which it has no table unless the sweep says how it is cut."""


def compared(first: Side, second: Side, seed: int, *, rules: bool = True) -> ComparedPair:
    """Return what the pairs of two sides say, without pictures; an InputError where rules are sought and scikit-learn
    is missing. `seed` says which half of the pairs chooses rules, and which counts them."""
    columns = shared_columns(first, second)
    lost, won, units = first.right & ~second.right, ~first.right & second.right, first.units
    drawn = len(np.unique(units))
    return ComparedPair(
        first=first.name,
        second=second.name,
        units=None if drawn == len(units) else drawn,
        **_counts(first.right, second.right, units),
        p=paired_by_unit(first.right, second.right, units)[2],
        worse=_rules(columns, lost, units, seed) if rules else None,
        better=_rules(columns, won, units, seed) if rules else None,
        parts=[part for one in columns for part in _parts(one, first.right, second.right, units)],
        shown=[],
    )


def far_apart(first: Side, second: Side, most: int) -> list[int]:
    """Return numbers of pairs that one side alone gets right, at most so many of each: first those of the first side,
    where the margins are farthest apart first."""
    apart = np.nan_to_num(second.margin.astype(np.float64) - first.margin, nan=0.0)
    found: list[int] = []
    for alone, sign in ((first.right & ~second.right, -1.0), (~first.right & second.right, 1.0)):
        numbers = np.flatnonzero(alone)
        found += numbers[np.argsort(sign * apart[numbers], kind="stable")][:most].tolist()
    return found


def interval_of(right: Mask, units: npt.NDArray[np.int64]) -> tuple[float, float]:
    """Return the 95 % interval of the share of right answers (n,), over the units that they are of."""
    return share_interval(per_unit(right, units), per_unit(np.ones(len(right)), units)) if len(right) else (0.0, 1.0)


def _counts(first: Mask, second: Mask, units: npt.NDArray[np.int64]) -> dict[str, Any]:
    cells = [int(one.sum()) for one in (first & second, first & ~second, ~first & second, ~first & ~second)]
    difference, interval, _ = paired_by_unit(first, second, units)
    return {
        **dict(zip(("both", "first_only", "second_only", "neither"), cells, strict=True)),
        "difference": difference,
        "interval": interval,
    }


def _parts(column: Column, first: Mask, second: Mask, units: npt.NDArray[np.int64]) -> Iterator[PairPart]:
    """The pairs by the values of a parameter, or by the parts of its range that the sweep's tables have."""
    for value, mask in _masks(column):
        if mask.any():
            counts = _counts(first[mask], second[mask], units[mask])
            yield PairPart(parameter=column.name, unit=column.unit, value=value, **counts)


def _masks(column: Column) -> Iterator[tuple[AxisValue, Mask]]:
    if column.levels is not None:
        yield from ((name, column.data == number) for number, name in enumerate(column.levels))
    elif column.edges is not None:
        part = np.clip(np.searchsorted(column.edges, column.data, side="right") - 1, 0, len(column.edges) - 2)
        for number, ends in enumerate(zip(column.edges[:-1], column.edges[1:], strict=True)):
            yield ends, part == number
    else:
        values = np.unique(column.data)
        if len(values) <= MOST_VALUES:
            yield from ((float(f"{value:.6g}"), column.data == value) for value in values)


def _rules(columns: Sequence[Column], alone: Mask, units: npt.NDArray[np.int64], seed: int) -> list[PairRule] | None:
    """Where one side alone is right more often than elsewhere; None of too few pairs, or where nothing varies.

    These are the rules of `explain`, whose wrong answers are the pairs that one side alone gets right.
    """
    found = observations(columns, ~alone, units)
    if len(alone) < FEWEST_ROWS or found is None:
        return None
    choosing, counting = found.halves(seed)
    told = find_rules(choosing, counting, seeds.stream(seed, "compare")).told
    return [_rule(one, found.factors) for one in told]


def _rule(rule: CountedRule, factors: Sequence[Factor]) -> PairRule:
    inside, elsewhere = _count_of(rule.inside), _count_of(rule.elsewhere)
    return PairRule(conditions=condition_rows(rule.conditions, factors), elsewhere=elsewhere, **vars(inside))


def _count_of(pairs: Observations) -> CountOf:
    """How many pairs one side alone gets right, which are those that are not `right`."""
    low, high = pairs.interval
    return CountOf(count=int((~pairs.right).sum()), total=len(pairs), interval=(1.0 - high, 1.0 - low))
