"""What is compared, read from stored sweeps: for every side its rows, and two sides counted pair by pair; with pictures
of pairs that one side alone gets right.

Pictures of a sweep are numbered, and the draw of a picture follows from its number. So sweeps with the same seed, grid
and controls have the same draws, and pictures with the same number are a pair, whatever else differs. Pairs are counted
in all, by each parameter, and where one side is worse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from advsearch import seeds
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.experiment import RunContext
from advsearch.questions.compare.result import ComparedPair, CountOf, PairPart, PairPicture, PairRule
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.questions.sweep.job import OpenScenes
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.report.wording import short_names
from advsearch.rules import FEWEST_ROWS, find_rules, halves, interval_of, is_shown, observed, share_of
from advsearch.runs.directory import CONFIG
from advsearch.runs.summary import read_result
from advsearch.runs.tables import read_sweep
from advsearch.statistics.clustered import mean_share, paired_by_unit, per_unit
from advsearch.trust.writing import write_bytes
from advsearch.viewer import thumbnails

DRAWS = ("grid", "controls", "samples", "sampler", "seed")  # The settings that decide what is drawn
OF_THE_SIDE = ("object", "model", "answer")  # What may tell sides apart, as rows have it
FOLLOWS = (
    *(*DRAWS, "label", "labels", "prompt", "up", "facing", "size", "unit", "batch", "keep_pictures", "trials"),
    *("verify_spp", "specialise", "value_range"),
)
"""Settings that do not tell sweeps apart: of draws, along with object and model, or of no adversarial scene."""
TOLERANCE = 1e-4  # Of a value, relative to the largest in its column: values come from single precision
MOST_VALUES = 64  # Different numbers of a parameter, beyond which it has no table unless the sweep says how it is cut
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Side:
    """One of the things that are compared: what tells it from the others; its sweep; object, model and adversarial
    scene; and its rows as `runs.tables` has them, one for each picture in their order, with the `number` of the
    picture."""

    name: str
    folder: Path
    config: SweepConfig
    summary: SweepSummary
    named: dict[str, str]
    rows: pd.DataFrame

    @property
    def right(self) -> Mask:
        """Whether the model is right (n,)."""
        return np.asarray(self.rows["correct"])

    @property
    def varying(self) -> list[str]:
        """The parameters that have more than one value; not what names the side."""
        names = [name for name in self.rows.attrs["units"] if name not in ("model", "answer")]
        return [name for name in names if self.rows[name].nunique() > 1]


def read_sides(folders: Sequence[Path]) -> list[Side]:
    """Return what the sweeps in some folders compare, each side with a name of its own. A sweep has a side for each of
    its models. The sweep of an adversarial scene has these without it and with it; beside other sweeps, only with it.
    Raises FileFormatError where a folder has another run, or a sweep that has not ended, and InputError where there is
    nothing to compare, or sweeps are of other draws."""
    sides = [side for folder in folders for side in _sides_of(folder, alone=len(folders) == 1)]
    if len(sides) < 2:
        raise InputError(
            f"compared: expected a sweep of several models, or several sweeps, got {folders[0]}, a sweep of one model; "
            "name another sweep of the same draws beside it, or give `model` two models when you sweep"
        )
    for side in sides[1:]:
        _check_pair(sides[0], side)
    telling = [what for what in OF_THE_SIDE if len({side.named[what] for side in sides}) > 1]
    names = [", ".join(short_names(side.named[what]) or "as it is" for what in telling) for side in sides]
    if len(set(names)) < len(names):
        names = [", ".join(filter(None, (side.folder.name, name))) for side, name in zip(sides, names, strict=True)]
    if len(set(names)) < len(names):
        names = [f"{number + 1}: {name}" for number, name in enumerate(names)]
    shown = np.logical_and.reduce([is_shown(side.rows) for side in sides])
    if not shown.any():
        raise InputError(f"compared: expected pictures with the object in them, got none in {folders[0]}")
    return [
        replace(side, name=name, rows=side.rows[shown].reset_index(drop=True))
        for side, name in zip(sides, names, strict=True)
    ]


def _sides_of(folder: Path, *, alone: bool) -> Iterator[Side]:
    summary = read_result(folder)
    if not isinstance(summary, SweepSummary):
        raise FileFormatError(f"{folder}: expected the run of a sweep, got one of {summary.command}; sweep first")
    if summary.goes_on or summary.looked_at != summary.planned:
        raise FileFormatError(
            f"{folder}: expected a sweep that has ended, got one with {summary.looked_at} of {summary.planned} "
            f"predictions; go on with it: advsearch resume {folder}"
        )
    config, rows = SweepConfig.from_yaml(folder / CONFIG), read_sweep(folder, is_drawn=summary.sampler is not None)
    if len(rows) != summary.planned or not rows["step"].is_unique:
        raise FileFormatError(
            f"{folder}: expected {summary.planned} rows, as its summary says, got {len(rows)}; sweep again"
        )
    models = len(config.models)
    rows = rows.sort_values("step", ignore_index=True)
    rows["correct"] = rows["correct"] == 1
    rows["number"], model_of = rows["step"] // models, rows["step"] % models
    halves_of = [rows["number"] >= 0]
    if config.adversarial_of:
        with_adversarial = rows["number"] >= summary.planned // models // 2
        halves_of = [~with_adversarial, with_adversarial] if alone else [with_adversarial]
    for half in halves_of:
        for model, name in enumerate(config.models):
            mine = rows[half & (model_of == model)].reset_index(drop=True)
            named = {"object": summary.object, "model": name, "answer": ""}
            named |= {what: ",".join(mine[what].unique()) for what in OF_THE_SIDE if what in mine}
            yield Side("", folder, config, summary, named, mine)


def _check_pair(first: Side, other: Side) -> None:
    if first.folder == other.folder:
        return
    where = f"{first.folder} and {other.folder}"
    for name in DRAWS:
        if first.config.deciding()[name] != other.config.deciding()[name]:
            raise InputError(
                f"compared: expected sweeps of the same draws, got {where}, whose `{name}` differ; sweep one of them "
                "again with the settings of the other"
            )
    if len(first.rows) != len(other.rows):
        raise InputError(
            f"compared: expected sweeps with as many pictures, got {len(first.rows)} and {len(other.rows)} in {where}; "
            "sweep as many objects and environments in both"
        )
    if first.named["object"] != other.named["object"]:
        return  # ranges may follow from the object
    for name in first.rows.attrs["units"]:
        in_both = name not in (*OF_THE_SIDE, "environment") and name in other.rows.attrs["units"]
        if in_both and not _same(first.rows[name], other.rows[name]):
            raise InputError(
                f"compared: expected sweeps of the same draws, got {where} with other values of {name}; sweep both "
                "again"
            )


def _same(one: pd.Series, other: pd.Series) -> bool:
    if one.dtype == "category" or other.dtype == "category":
        return bool((one.astype(object) == other.astype(object)).all())
    scale = float(np.nanmax(np.abs(one), initial=0.0))
    return bool(np.allclose(one, other, rtol=0.0, atol=TOLERANCE * scale, equal_nan=True))


def differing(sides: Sequence[Side]) -> list[str]:
    """Return the settings in which the sweeps of some sides differ and that decide predictions."""
    first, *others = (side.config.deciding() for side in sides)
    names = {name for other in others for name in other if other[name] != first[name]}
    names |= {name for name in OF_THE_SIDE if len({side.named[name] for side in sides}) > 1}
    names |= {name for name in ("object", "model") if len({getattr(side.config, name) for side in sides}) > 1}
    return sorted(names - {*FOLLOWS, "adversarial_of"})


def compared(first: Side, second: Side, seed: int, *, rules: bool = True) -> ComparedPair:
    """Return what the pairs of two sides say, without pictures; an InputError where rules are sought and scikit-learn
    is missing. `seed` says which half of the pairs chooses rules, and which counts them."""
    shared = [n for n in first.varying if n in second.rows.attrs["units"] and _same(first.rows[n], second.rows[n])]
    right, other, units = first.right, second.right, first.rows["unit"].to_numpy()
    draws = len(np.unique(units))
    table = observed(first.rows, shared)
    worse, better = (
        _rules(table.assign(correct=~alone), seed) if rules else None for alone in (right & ~other, ~right & other)
    )
    return ComparedPair(
        first=first.name,
        second=second.name,
        units=None if draws == len(units) else draws,
        unit=first.rows.attrs["unit name"],
        **_counts(right, other, units),
        p=paired_by_unit(right, other, units)[2],
        worse=worse,
        better=better,
        parts=[
            PairPart(
                parameter=name,
                unit="" if first.rows[name].dtype == "category" else first.rows.attrs["units"][name],
                value=value,
                **_counts(right[inside], other[inside], units[inside]),
            )
            for name in shared
            for value, inside in _parts(first.rows[name], first.rows.attrs["edges"].get(name))
            if inside.any()
        ],
        shown=[],
    )


def _counts(first: Mask, second: Mask, units: npt.NDArray[np.int64]) -> dict[str, Any]:
    difference, interval, _ = paired_by_unit(first, second, units)
    pairs = {
        "both": first & second,
        "first_only": first & ~second,
        "second_only": ~first & second,
        "neither": ~first & ~second,
    }
    counts = {name: int(those.sum()) for name, those in pairs.items()}
    of = per_unit(np.ones(len(units)), units)
    shares = tuple(mean_share(per_unit(right, units), of) for right in (first, second))
    return {**counts, "shares": shares, "difference": difference, "interval": interval}


def _parts(column: pd.Series, edges: Sequence[float] | None) -> Iterator[tuple[Any, Mask]]:
    """The values of a parameter, or the parts of its range that the sweep's tables have, and which pairs have them."""
    if column.dtype == "category":
        yield from ((name, np.asarray(column == name)) for name in column.cat.categories)
    elif edges is not None:
        part = np.clip(np.searchsorted(edges, column, side="right") - 1, 0, len(edges) - 2)
        yield from ((ends, part == k) for k, ends in enumerate(pairwise(edges)))
    elif column.nunique() <= MOST_VALUES:
        yield from ((float(f"{value:.6g}"), np.asarray(column == value)) for value in np.unique(column))


def _rules(table: pd.DataFrame, seed: int) -> list[PairRule] | None:
    """Where one side alone is right more often than elsewhere, by the rules of `explain`; None of too few pairs."""
    if len(table) < FEWEST_ROWS or not table.attrs["units"]:
        return None

    def count(pairs: pd.DataFrame) -> CountOf:
        low, high = interval_of(pairs)
        interval, share = (1.0 - high, 1.0 - low), 1.0 - share_of(pairs) if len(pairs) else None
        return CountOf(count=int((~pairs["correct"]).sum()), total=len(pairs), interval=interval, share=share)

    rules = []
    for rule in find_rules(*halves(table, seed), seeds.stream(seed, "compare")).told:
        conditions = [condition.row for condition in rule.conditions]
        rules.append(PairRule(conditions=conditions, elsewhere=count(rule.elsewhere), **vars(count(rule.inside))))
    return rules


@dataclass
class PairPictures:
    """Small pictures of pairs in the folder of the run: those that sweeps kept, or rendered again."""

    asked: RunContext[Any]
    rendered: int = 0
    warnings: list[str] = field(default_factory=list)
    scenes: dict[str, OpenScenes | None] = field(default_factory=dict)

    def of(self, first: Side, second: Side, pair: int) -> Iterator[PairPicture]:
        """Yield what one side alone gets right, at most so many of each, where the margins are farthest apart first,
        with pictures as far as they are to be had."""
        most, folder = self.asked.config.pictures, self.asked.run.path
        apart = (first.rows["margin"] - second.rows["margin"]).fillna(0.0)
        worse, better = -apart[first.right & ~second.right], apart[~first.right & second.right]
        places = [
            place for alone in (worse, better) for place in alone.sort_values(kind="stable").index[:most].tolist()
        ]
        together = first.folder == second.folder and first.rows["number"].equals(second.rows["number"])
        sides = {"a": first} if together else {"a": first, "b": second}
        files = {(place, side): f"images/pair-{pair}-{place}-{side}.jpg" for place in places for side in sides}
        missing: list[tuple[str, int, Path, Side]] = []
        with self.asked.until_interrupted():
            for (place, which), name in files.items():
                side = sides[which]
                number = int(side.rows["number"][place])
                kept = thumbnails.kept_file(side.folder, number)
                if kept is not None:
                    write_bytes(folder / name, kept.read_bytes(), durable=False)
                elif not (folder / name).is_file():
                    missing.append((str(side.folder), number, folder / name, side))
            self._render(missing)
        for place in places:
            names = [files[place, side] for side in sides]
            values = first.rows.loc[place, first.varying].items()
            yield PairPicture(
                number=place,
                values={name: value if isinstance(value, str) else float(f"{value:.6g}") for name, value in values},
                right=(first if first.right[place] else second).name,
                answers=(first.rows["label"][place], second.rows["label"][place]),
                pictures=names if all((folder / name).is_file() for name in names) else [],
            )

    def _render(self, missing: Sequence[tuple[str, int, Path, Side]]) -> None:
        if missing:
            self.asked.progress.stage("rendering pictures again", len(missing), hint="`pictures` says how many")
        for folder, number, file, side in sorted(missing, key=lambda picture: picture[:2]):
            if folder not in self.scenes:
                self.scenes[folder] = None
                try:
                    self.scenes[folder] = scenes_of(side.config)
                except (InputError, ModelError) as error:  # scene or model are not to be had any more
                    self.warnings.append(f"Pictures of {side.folder.name} are not shown: {error}")
            if (scenes := self.scenes[folder]) is not None:
                write_bytes(file, thumbnails.thumbnail(scenes.picture(number)), durable=False)
                self.rendered += 1
            self.asked.progress.advance(1)
