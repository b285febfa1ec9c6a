"""Why a model is wrong, in words: rows of sweeps as one table, and rules found on half of it: nodes of decision trees
(Breiman et al. 1984), the best by weighted relative accuracy (Lavrac, Flach and Zupan 1999), made shorter where that
costs nothing, one after the other (sequential covering; Friedman and Fisher 1999); the other half says whether a rule
holds."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch import seeds
from advsearch.attacks.units import Units, fewer_by_chance, per_unit, share_interval
from advsearch.errors import InputError
from advsearch.report.wording import short_name
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import ConditionRow
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import NAME, Store
from advsearch.runs.units import units_of

PHOTOGRAPHS = "photographs"

ANSWER, GROUP, PART, TRIAL = "answer", "group", "part", "trial"
"""What the model said, the group that an object is in, the part of the recipe, and which trial of an attack it is."""

TRIALS = {
    "first control": "clean scene",
    "control": "clean scene",
    "verification": "answer",
    "baseline verification": "random search",
}
"""The rows of an attack that are in the table, and what figures call them."""

WORKERS = "workers"
"""The number of processes that shared a sweep, in whole; only of sweeps that say it."""

OTHERS = "other objects"


@dataclass(frozen=True)
class Answered:
    """What a model said of one picture of a part of the recipe: what it shows, object, environment, model, and
    parameters in their units; the answer in words, whether it is right, and its margin; when it was stored, seconds
    since 1970; and what it shares with rows that are not independent of it (`runs.units`), None for nothing."""

    part: str
    values: Mapping[str, float | str]
    units: Mapping[str, str]
    answer: str
    correct: bool
    time: float | None = None
    margin: float | None = None
    unit: str | None = None


def figure_value(value: float | str) -> str:
    """Return a value as figures write it; of a file, its name without folder and suffix."""
    if isinstance(value, str):
        return Path(short_name(value)).stem if "/" in value else value
    return f"{value:.4g}"


def rows_of(
    part: str, folder: Path, summary: AttackSummary | SweepSummary, kinds: Sequence[str] | None = None
) -> list[Answered]:
    """Return the answers that a sweep has stored, without those of its worst, or trials of an attack, or some kinds."""
    if kinds is None:
        kinds = ("sweep",) if isinstance(summary, SweepSummary) else tuple(TRIALS)
    outer = {"object": summary.object, "environment": summary.environment, "model": summary.model}
    rows = []
    with Store(folder / NAME, read_only=True) as store:
        units = units_of(store, summary) if isinstance(summary, SweepSummary) else None
        alike = summary.samples if isinstance(summary, SweepSummary) and summary.sampler is None else 1
        for row in store.rows():
            if row.kind not in kinds:
                continue
            values = {name: one["value"] for name, one in row.values.items()}
            values |= {TRIAL: TRIALS[row.kind]} if row.kind in TRIALS else {}
            values |= {"model": summary.model} if part == PHOTOGRAPHS and "," not in summary.model else {}
            named = {name: figure_value(str(values.get(name, of_all))) for name, of_all in outer.items()}
            shown = {name: one["unit"] for name, one in row.values.items() if one["unit"]}
            answer = row.label or "none", bool(row.correct)
            unit = f"trial {row.step}" if row.kind in TRIALS else None
            if row.kind == "sweep" and units is not None:  # without draws, samples of a point differ by noise alone
                unit = f"{units.name} {units.of(row.step) // alike}"
            rows.append(Answered(part, {**values, **named}, shown, *answer, row.time, row.margin, unit))
    return rows


Mask = npt.NDArray[np.bool_]
Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Factor:
    """Something that varied: a parameter with a unit, or, with the names that it takes in alphabetical order, object,
    environment or model."""

    name: str
    unit: str = ""
    options: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Observations:
    """Configurations (n, d) float64, of a factor with options the number of the option, answers (n,): whether the
    model was right, and the unit (n,) of each: rows of one are not independent. Where that is not said, rows are one
    that have the same numbers, but for the time along a path."""

    factors: tuple[Factor, ...]
    values: Numbers
    right: Mask
    units: Units = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        if len(self.units) == len(self.right):
            return
        same = [not one.name.endswith(".time") for one in self.factors]
        if any(not one.options for one, own in zip(self.factors, same, strict=True) if own):
            units = np.unique(self.values[:, same], axis=0, return_inverse=True)[1].reshape(-1)
        else:
            units = np.arange(len(self.right))
        object.__setattr__(self, "units", units)

    def __len__(self) -> int:
        return len(self.right)

    @cached_property
    def independent(self) -> bool:
        """Whether each row is a unit."""
        return self.count == len(self)

    @cached_property
    def count(self) -> int:
        """How many units there are."""
        return len(np.unique(self.units))

    @cached_property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share of right answers, over units; 0 to 1 where there is no row."""
        if not len(self):
            return 0.0, 1.0
        return share_interval(per_unit(self.right, self.units), per_unit(np.ones(len(self)), self.units))

    def where(self, mask: Mask) -> Observations:
        """Return some of the rows, by a mask (n,)."""
        return Observations(self.factors, self.values[mask], self.right[mask], self.units[mask])

    def halves(self, seed: int) -> tuple[Observations, Observations]:
        """Return two halves, drawn by a seed, each of whole units: one to choose on and one to count on."""
        places = np.unique(self.units, return_inverse=True)[1].reshape(-1)
        order = np.random.default_rng(seeds.stream(seed, "halves")).permutation(self.count)
        chosen = np.zeros(self.count, dtype=bool)
        chosen[order[: self.count // 2]] = True
        return self.where(chosen[places]), self.where(~chosen[places])


RowValues = Mapping[str, tuple[float | str, str]]
"""Value and unit of everything that a row shows, by name."""


def observed(rows: Sequence[tuple[RowValues, bool]], units: Sequence[str] | None = None) -> Observations:
    """Return rows as a table of what varies among them, with the unit of each, its own where that is not said; what
    only some have is left out."""
    if not rows:
        raise InputError("runs: expected sweeps with rows, got none")
    shared = [name for name in rows[0][0] if all(name in shown for shown, _ in rows)]
    factors, columns = [], []
    for name in shared:
        column = [shown[name][0] for shown, _ in rows]
        if len(set(column)) < 2:
            continue
        if all(isinstance(value, (int, float)) for value in column):
            factors.append(Factor(name, rows[0][0][name][1]))
            columns.append([float(value) for value in column])
        else:
            options = tuple(sorted({str(value) for value in column}))
            factors.append(Factor(name, "", options))
            columns.append([float(options.index(str(value))) for value in column])
    if not factors:
        raise InputError("runs: expected rows in which something varies, got none that all of them have")
    values = np.array(columns, dtype=np.float64).T
    right = np.array([right for _, right in rows], dtype=bool)
    places = np.arange(len(rows)) if units is None else np.unique(np.array(units), return_inverse=True)[1].reshape(-1)
    return Observations(tuple(factors), values, right, places)


def encoded(found: Observations) -> tuple[Numbers, list[tuple[int, int | None]]]:
    """Return the columns for a tree, (n, k): one for each option of a factor with options, 1 where it is taken; and for
    each the number of its factor and that of the option, None for numbers."""
    columns: list[Numbers] = []
    meaning: list[tuple[int, int | None]] = []
    for place, factor in enumerate(found.factors):
        column = found.values[:, place]
        if not factor.options:
            columns.append(column)
            meaning.append((place, None))
        for number in range(len(factor.options)):
            columns.append((column == number).astype(np.float64))
            meaning.append((place, number))
    return np.stack(columns, axis=1), meaning


FEWEST_ROWS = 100
"""Rows of which one half can choose and the other can count."""


MOST_RULES = 5
DEPTH = 3
"""Conditions of a rule, at most."""
TREES = 24
LEAST_SHARE, LEAST_ROWS, LEAST_UNITS = 0.01, 12, 3
"""Of the rows that choose, a rule covers at least so many, and as many as so many units have."""
KEPT = 0.97
"""Share of its weighted relative accuracy that a rule keeps when a condition is left out."""
PASSES, BOUNDS = 3, 250
"""How often all bounds of a rule are moved, and to how many places (quantiles) of their factor."""
CHANCE = 0.01
"""Probability that any rule is told that is none. Rules are tested one after the other, each only where all before it
were told, so that each may be tested at all of it (a fixed sequence: Maurer, Hothorn and Lehmacher 1995)."""
MOST_NEEDED = 1_000_000
"""Rows up to which it is said how many a rule would take."""
LEAST_GAP = 0.1
"""By how much more often the model is wrong under a rule than elsewhere, at least."""


@dataclass(frozen=True)
class RuleCondition:
    """A part of the values of one factor, by its number: over `low` and at most `high`, or some of its options."""

    place: int
    low: float = -np.inf
    high: float = np.inf
    options: frozenset[int] | None = None

    def holds(self, found: Observations) -> Mask:
        column = found.values[:, self.place]
        if self.options is not None:
            return np.isin(column, list(self.options))
        return (column > self.low) & (column <= self.high)

    def text(self, factor: Factor) -> str:
        unit = f" {factor.unit}" if factor.unit not in ("", "1") else ""
        if self.options is not None:
            return f"{factor.name} {' or '.join(factor.options[one] for one in sorted(self.options))}"
        if self.low == -np.inf:
            return f"{factor.name} at most {self.high:g}{unit}"
        if self.high == np.inf:
            return f"{factor.name} over {self.low:g}{unit}"
        return f"{factor.name} over {self.low:g} and at most {self.high:g}{unit}"


RuleConditions = tuple[RuleCondition, ...]


@dataclass(frozen=True)
class CountedRule:
    """A rule, all of whose conditions hold, at most one for each factor; counted on rows that did not choose it and
    that no rule before it covers."""

    conditions: RuleConditions
    inside: Observations
    elsewhere: Observations

    @property
    def right(self) -> int:
        return int(self.inside.right.sum())

    @property
    def of(self) -> int:
        return len(self.inside)

    @property
    def right_elsewhere(self) -> int:
        return int(self.elsewhere.right.sum())

    @property
    def of_elsewhere(self) -> int:
        return len(self.elsewhere)

    @cached_property
    def chance(self) -> float:
        """The probability of so few right answers under it, or fewer, if they were spread by chance."""
        return self._chance()

    @property
    def holds(self) -> bool:
        """Whether it is told: rows that did not choose it show it, and more than chance would."""
        return self._gap >= LEAST_GAP and self.chance <= CHANCE

    @property
    def _gap(self) -> float:
        if not self.of or not self.of_elsewhere:
            return 0.0
        return self.right_elsewhere / self.of_elsewhere - self.right / self.of

    def times_needed(self) -> float | None:
        """How many times as many rows, of the same shares, would tell it; None where no number would."""
        if self._gap < LEAST_GAP:
            return None
        times, own = 1.0, self.of + self.of_elsewhere
        while own * times <= MOST_NEEDED:
            if self._chance(times) <= CHANCE:
                return times
            times *= 1.05
        return None

    def _chance(self, times: float = 1.0) -> float:
        """That of so many times as many units."""
        units = np.concatenate([self.inside.units, self.elsewhere.units])
        under = np.arange(len(units)) < self.of
        right = np.concatenate([self.inside.right, self.elsewhere.right])
        k, a, r, b = (per_unit(one, units) for one in (under & right, under, ~under & right, ~under))
        return fewer_by_chance(k, a, r, b, times)


@dataclass(frozen=True)
class FoundRules:
    """The rules that are told, the weightiest first, and the best one after these, if there is one to try."""

    told: list[CountedRule]
    next: CountedRule | None


def covered(conditions: RuleConditions, found: Observations) -> Mask:
    """Return which rows (n,) lie under all conditions."""
    mask = np.ones(len(found), dtype=bool)
    for one in conditions:
        mask &= one.holds(found)
    return mask


def find_rules(choosing: Observations, counting: Observations, seed: int) -> FoundRules:
    """Return the rules under which the model is wrong more often than elsewhere, chosen on some rows and counted on
    others with the same factors."""
    rules: list[CountedRule] = []
    for number in range(MOST_RULES):
        conditions = _best(choosing, seeds.stream(seed, "rules", number))
        if not conditions:
            return FoundRules(rules, None)
        inside = covered(conditions, counting)
        rule = CountedRule(conditions, counting.where(inside), counting.where(~inside))
        if not rule.holds:
            return FoundRules(rules, rule)
        rules.append(rule)
        choosing, counting = choosing.where(~covered(conditions, choosing)), counting.where(~inside)
    return FoundRules(rules, None)


def _best(found: Observations, seed: int) -> RuleConditions:
    """The candidate of the largest weighted relative accuracy, as short as it can be; none where all are worthless."""
    wrong = ~found.right
    least = max(LEAST_ROWS, round(LEAST_SHARE * len(found)))
    if not found.independent:
        least = max(least, round(LEAST_UNITS * len(found) / found.count))
    if len(found) < 2 * least or not 0 < int(wrong.sum()) < len(found):
        return ()
    excess = wrong - wrong.mean()

    def weight(conditions: RuleConditions) -> float:
        mask = covered(conditions, found)
        return float(excess[mask].sum()) / len(found) if int(mask.sum()) >= least else -1.0

    best = max(_candidates(found, least, seed), key=weight, default=())
    reached = weight(best) if best else 0.0
    if reached <= 0.0:
        return ()
    while len(best) > 1:
        shorter = max((best[:k] + best[k + 1 :] for k in range(len(best))), key=weight)
        if reached - weight(shorter) > max((1.0 - KEPT) * reached, _error(shorter, best, found)):
            break
        best = shorter
    for _ in range(PASSES):
        for place in range(len(best)):
            moved = [(*best[:place], one, *best[place + 1 :]) for one in _moved(best[place], found)]
            best = max([best, *moved], key=weight)
    return best


def _error(shorter: RuleConditions, longer: RuleConditions, found: Observations) -> float:
    """The standard error of what conditions add to the weighted relative accuracy, so that few rows choose few."""
    left_out = int((covered(shorter, found) & ~covered(longer, found)).sum())
    return math.sqrt(left_out * float(found.right.var())) / len(found)


def _moved(condition: RuleCondition, found: Observations) -> Iterator[RuleCondition]:
    """The condition with its bounds elsewhere: nodes of trees lie where the nodes above them left them."""
    if condition.options is not None:
        return
    quantiles = np.quantile(found.values[:, condition.place], np.linspace(0.0, 1.0, BOUNDS + 1)[1:-1])
    for at in dict.fromkeys(float(f"{one:.3g}") for one in quantiles):
        if condition.low > -np.inf and at < condition.high:
            yield replace(condition, low=at)
        if condition.high < np.inf and at > condition.low:
            yield replace(condition, high=at)


def _candidates(found: Observations, least: int, seed: int) -> Iterator[RuleConditions]:
    """The nodes of one tree of all rows and of a random forest."""
    one_tree = import_library("sklearn.tree").DecisionTreeClassifier
    forest = import_library("sklearn.ensemble").RandomForestClassifier
    columns, meaning = encoded(found)
    shape = {"max_depth": DEPTH, "min_samples_leaf": least}
    alone = one_tree(**shape, random_state=seed % 2**32)
    several = forest(TREES, **shape, max_features=0.6, random_state=seed % 2**32)
    trees = [alone.fit(columns, found.right), *several.fit(columns, found.right).estimators_]
    seen: set[RuleConditions] = set()
    for one in trees:
        for conditions in _nodes(one.tree_, meaning, found.factors):
            if conditions and conditions not in seen:
                seen.add(conditions)
                yield conditions


def _nodes(
    tree: object, meaning: Sequence[tuple[int, int | None]], factors: Sequence[Factor]
) -> Iterator[RuleConditions]:
    left, right = tree.children_left, tree.children_right  # type: ignore[attr-defined]
    columns, thresholds = tree.feature, tree.threshold  # type: ignore[attr-defined]
    open_nodes: list[tuple[int, dict[int, RuleCondition]]] = [(0, {})]
    while open_nodes:
        node, so_far = open_nodes.pop()
        yield tuple(so_far[place] for place in sorted(so_far))
        if left[node] == right[node]:
            continue
        place, option = meaning[columns[node]]
        everything = None if option is None else frozenset(range(len(factors[place].options)))
        before = so_far.get(place, RuleCondition(place, options=everything))
        if option is None:
            at = float(f"{thresholds[node]:.3g}")  # as it is told
            below, above = replace(before, high=min(before.high, at)), replace(before, low=max(before.low, at))
        else:
            assert before.options is not None
            below, above = (
                replace(before, options=before.options - {option}),
                replace(before, options=before.options & {option}),
            )
        open_nodes += [(int(left[node]), {**so_far, place: below}), (int(right[node]), {**so_far, place: above})]


PACKAGES = {"sklearn": "scikit-learn"}
"""Names on the package index, by that of a module."""


def import_library(name: str) -> Any:
    """Return a module of such a library, such as ``sklearn.tree``."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package, command = PACKAGES[name.partition(".")[0]], "pip install 'advsearch[explain]'"
        raise InputError(f"explain needs {package}, which cannot be imported: {command}") from error


def condition_rows(conditions: RuleConditions, factors: Sequence[Factor]) -> list[ConditionRow]:
    """Return conditions with the names of their factors."""
    rows = []
    for one in conditions:
        factor = factors[one.place]
        row = ConditionRow(
            parameter=factor.name,
            unit=factor.unit,
            over=one.low if np.isfinite(one.low) else None,
            at_most=one.high if np.isfinite(one.high) else None,
            options=[factor.options[number] for number in sorted(one.options or ())],
            text=one.text(factor),
        )
        rows.append(row)
    return rows
