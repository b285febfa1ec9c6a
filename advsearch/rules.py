"""Where a model is wrong, as rules: nodes of decision trees (Breiman et al. 1984) of one half of the rows, the best by
weighted relative accuracy (Lavrac, Flach and Zupan 1999), made shorter where that costs nothing, one after the other
(sequential covering; Friedman and Fisher 1999). The other half says whether a rule holds.

The rows are a *table*, a pandas frame: a column for each factor, float64 or a category of names in alphabetical order;
`correct`, whether the model was right; and `unit`, of what draw a row is: rows of one unit are not independent
(`runs.tables.Units`). ``attrs["units"]`` has the unit of each factor, so its keys are the factors.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from advsearch import seeds
from advsearch.errors import InputError
from advsearch.options import OUT_OF_VIEW, Outcome
from advsearch.runs.results import ConditionRow
from advsearch.statistics.clustered import fewer_by_chance, mean_share, per_unit, share_interval

Mask = npt.NDArray[np.bool_]
FEWEST_ROWS = 100  # rows of which one half can choose and the other can count
MOST_RULES = 5
DEPTH = 3  # conditions of a rule, at most
TREES = 24
LEAST_SHARE, LEAST_ROWS, LEAST_UNITS = 0.01, 12, 3
"""Of the rows that choose, a rule covers at least so many, and as many as so many units have."""
KEPT = 0.97  # share of its weighted relative accuracy that a rule keeps when a condition is left out
PASSES, BOUNDS = 3, 250  # how often all bounds of a rule are moved, and to how many places (quantiles) of their factor
CHANCE = 0.01
"""Probability that any rule is told that is none. Rules are tested one after the other, each only where all before it
were told, so that each may be tested at all of it (a fixed sequence: Maurer, Hothorn and Lehmacher 1995)."""
MOST_NEEDED = 1_000_000  # rows up to which it is said how many a rule would take
LEAST_GAP = 0.1  # by how much more often the model is wrong under a rule than elsewhere, at least
AROUND = 270.0  # degrees that the values of an angle span, at least, where it goes round: a grid of four values does
ARCS = ((360.0, 180.0), (180.0, 0.0), (180.0, 90.0))
"""Of an angle that goes all the way round, trees see it once more by turn and zero, degrees: an arc through 0 is one
interval there, and so is what lies end-on, at 0 and at 180."""


# ---- tables ---------------------------------------------------------------------------------------------------------


def observed(rows: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    """Return a sweep's rows (`runs.tables`) as a table of those of some parameters that vary and that all rows have;
    a prediction that was not judged is not right."""
    table, units = dict[str, pd.Series](), dict[str, str]()
    for name in names:
        column, is_names = rows[name], rows[name].dtype == "category"
        if is_names:
            column = column.cat.set_categories(sorted(column.unique()))
        if column.nunique() > 1 and not column.isna().any():
            table[name], units[name] = column, "" if is_names else rows.attrs["units"][name]
    table |= {"outcome": rows["outcome"]} if "outcome" in rows and "outcome" not in table else {}
    found = pd.DataFrame({**table, "correct": rows["correct"] == 1, "unit": rows["unit"]})
    found.attrs["units"] = units
    return found


def is_in_view(rows: pd.DataFrame) -> Mask:
    """Return in which rows of a sweep (n,) the judged object is in the image."""
    return np.asarray(rows["label"] != OUT_OF_VIEW)


def count_wrong_outcomes(rows: pd.DataFrame) -> dict[str, int] | None:
    """Count the outcomes of the rows that are not right, by name; None where rows have no outcomes."""
    if "outcome" not in rows:
        return None
    counts = rows.loc[rows["correct"] != 1, "outcome"].astype(str).value_counts()
    counts_by_name = {outcome.value: int(counts[outcome.value]) for outcome in Outcome if outcome.value in counts}
    return counts_by_name or None


def interval_of(table: pd.DataFrame) -> tuple[float, float]:
    """Return the 95 % interval of `share_of`; 0 to 1 where there is no row."""
    if table.empty:
        return 0.0, 1.0
    return share_interval(per_unit(table["correct"], table["unit"]), per_unit(np.ones(len(table)), table["unit"]))


def share_of(table: pd.DataFrame) -> float:
    """Return the mean over units of the share of right predictions of each; NaN where there is no row."""
    return mean_share(per_unit(table["correct"], table["unit"]), per_unit(np.ones(len(table)), table["unit"]))


def merge_repeats(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table in which units with a configuration in common are one unit: it is the same draw, come twice.

    That is asked only where two draws are never the same by chance: where some factor is a number with at least half as
    many values as there are rows. Values of a grid, and names, come again in independent draws too.
    """
    factors = list(table.attrs["units"])
    is_continuous = any(table[name].dtype != "category" and 2 * table[name].nunique() >= len(table) for name in factors)
    if not is_continuous:
        return table
    configuration = table.groupby(factors, sort=False, observed=True).ngroup().to_numpy()
    n_configurations = int(configuration.max()) + 1
    if n_configurations == len(table):
        return table
    merged = table.assign(unit=connected(np.unique(table["unit"], return_inverse=True)[1], configuration))
    merged.attrs = table.attrs
    return merged


def connected(first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the group (n,) of each row: rows with the same number (n,) from 0 of either kind are in one group."""
    group = first
    while True:
        linked = group
        for number in (second, first):
            lowest = np.full(int(number.max()) + 1, len(group))
            np.minimum.at(lowest, number, linked)
            linked = lowest[number]
        if (linked == group).all():
            return group
        group = linked


def halves(table: pd.DataFrame, seed: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return two halves, drawn by a seed, each of whole units: one to choose on and one to count on."""
    table = merge_repeats(table)
    units, places = np.unique(table["unit"], return_inverse=True)
    order = np.random.default_rng(seeds.stream(seed, "halves")).permutation(len(units))
    chosen = np.isin(places, order[: len(units) // 2])
    return table[chosen], table[~chosen]


# ---- rules ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RuleCondition:
    """A part of the values of one factor: over `low` and at most `high`, or some of its names. With a `turn`, 360 or
    180 degrees, values repeat after it, and where `low` is over `high` the part goes through 0."""

    factor: str
    unit: str = ""
    low: float = -np.inf
    high: float = np.inf
    options: frozenset[str] | None = None
    turn: float = 0.0

    def holds(self, table: pd.DataFrame) -> Mask:
        """Return in which rows (n,) it does."""
        column = table[self.factor]
        if self.options is not None:
            return np.asarray(column.isin(self.options))
        values = column.to_numpy()
        if self.turn:
            values = values % self.turn
            if self.low > self.high:
                return np.asarray((values > self.low) | (values <= self.high))
        return np.asarray((values > self.low) & (values <= self.high))

    @property
    def arcs(self) -> tuple[tuple[float, float], ...]:
        """Where it holds of an angle, from and to in degrees, each once in a turn of 360; none without a `turn`."""
        if not self.turn:
            return ()
        width = (self.high - self.low) % self.turn
        return tuple((self.low + at, self.low + at + width) for at in np.arange(0.0, 360.0, self.turn).tolist())

    @property
    def row(self) -> ConditionRow:
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        names, over, at_most = sorted(self.options or ()), f"over {self.low:g}", f"at most {self.high:g}"
        bounds = [text for text, end in ((over, self.low), (at_most, self.high)) if np.isfinite(end)]
        if self.turn:
            bounds = [" or ".join(f"from {low % 360:g} to {high % 360:g}" for low, high in self.arcs)]
        return ConditionRow(
            parameter=self.factor,
            unit=self.unit,
            over=self.low if np.isfinite(self.low) else None,
            at_most=self.high if np.isfinite(self.high) else None,
            options=names,
            turn=self.turn or None,
            text=f"{self.factor} {' or '.join(names) if names else ' and '.join(bounds) + unit}",
        )


RuleConditions = tuple[RuleCondition, ...]  # all of which hold, at most one for each factor


def covered(conditions: RuleConditions, table: pd.DataFrame) -> Mask:
    """Return which rows (n,) lie under all conditions."""
    mask = np.ones(len(table), dtype=bool)
    for one in conditions:
        mask &= one.holds(table)
    return mask


@dataclass(frozen=True, eq=False)
class CountedRule:
    """A rule, and the rows inside it and elsewhere, of those that did not choose it and lie under no rule before."""

    conditions: RuleConditions
    inside: pd.DataFrame
    elsewhere: pd.DataFrame

    @property
    def gap(self) -> float:
        """By how much more often the model is right elsewhere than under it, with equal weight of all units."""
        if self.inside.empty or self.elsewhere.empty:
            return 0.0
        return share_of(self.elsewhere) - share_of(self.inside)

    @cached_property
    def chance(self) -> float:
        """The probability of so few right predictions under it, or fewer, if they were spread by chance."""
        return self._chance(1.0)

    @property
    def holds(self) -> bool:
        """Whether it is told: rows that did not choose it show it, and more than chance would."""
        return self.gap >= LEAST_GAP and self.chance <= CHANCE

    def times_needed(self) -> float | None:
        """Return how many times as many rows, of the same shares, would tell it; None where no number would."""
        times, rows = 1.0, len(self.inside) + len(self.elsewhere)
        while self.gap >= LEAST_GAP and rows * times <= MOST_NEEDED:
            if self._chance(times) <= CHANCE:
                return times
            times *= 1.05
        return None

    def _chance(self, times: float) -> float:
        units, right = (np.concatenate([self.inside[name], self.elsewhere[name]]) for name in ("unit", "correct"))
        under = np.arange(len(units)) < len(self.inside)
        k, a, r, b = (per_unit(one, units) for one in (under & right, under, ~under & right, ~under))
        return fewer_by_chance(k, a, r, b, times)


@dataclass(frozen=True)
class FoundRules:
    """The rules that are told, the weightiest first, and the best one after these, if there is one to try."""

    told: list[CountedRule]
    next: CountedRule | None


def find_rules(choosing: pd.DataFrame, counting: pd.DataFrame, seed: int) -> FoundRules:
    """Return the rules under which the model is wrong more often, chosen on some rows and counted on others."""
    rules: list[CountedRule] = []
    for number in range(MOST_RULES):
        conditions = _best(choosing, seeds.stream(seed, "rules", number))
        if not conditions:
            return FoundRules(rules, None)
        inside = covered(conditions, counting)
        rule = CountedRule(conditions, counting[inside], counting[~inside])
        if not rule.holds:
            return FoundRules(rules, rule)
        rules.append(rule)
        choosing, counting = choosing[~covered(conditions, choosing)], rule.elsewhere
    return FoundRules(rules, None)


def _best(table: pd.DataFrame, seed: int) -> RuleConditions:
    """The candidate of the largest weighted relative accuracy, as short as it can be; none where all are worthless."""
    wrong = ~table["correct"].to_numpy()
    least = max(LEAST_ROWS, round(LEAST_SHARE * len(table)))
    if not table["unit"].is_unique:
        least = max(least, round(LEAST_UNITS * len(table) / table["unit"].nunique()))
    if len(table) < 2 * least or not 0 < int(wrong.sum()) < len(table):
        return ()
    excess = wrong - wrong.mean()

    def weight(conditions: RuleConditions) -> float:
        mask = covered(conditions, table)
        return float(excess[mask].sum()) / len(table) if int(mask.sum()) >= least else -1.0

    best = max(_candidates(table, least, seed), key=weight, default=())
    reached = weight(best) if best else 0.0
    if reached <= 0.0:
        return ()
    while len(best) > 1:
        shorter = max((best[:k] + best[k + 1 :] for k in range(len(best))), key=weight)
        left_out = int((covered(shorter, table) & ~covered(best, table)).sum())
        # the standard error of what is lost, so that few rows choose few conditions
        error = math.sqrt(left_out * float(table["correct"].to_numpy().var())) / len(table)
        if reached - weight(shorter) > max((1.0 - KEPT) * reached, error):
            break
        best = shorter
    for _ in range(PASSES):
        for place in range(len(best)):
            moved = [(*best[:place], one, *best[place + 1 :]) for one in _moved(best[place], table)]
            best = max([best, *moved], key=weight)
    return best


def _moved(condition: RuleCondition, table: pd.DataFrame) -> Iterator[RuleCondition]:
    """The condition with its bounds elsewhere: nodes of trees lie where the nodes above them left them."""
    if condition.options is not None:
        return
    values = table[condition.factor].to_numpy()
    quantiles = np.quantile(values % condition.turn if condition.turn else values, np.linspace(0, 1, BOUNDS + 1)[1:-1])
    for at in dict.fromkeys(float(f"{one:.3g}") for one in quantiles):
        if at in (condition.low, condition.high):
            continue
        if condition.low > -np.inf and (condition.turn or at < condition.high):
            yield replace(condition, low=at)
        if condition.high < np.inf and (condition.turn or at > condition.low):
            yield replace(condition, high=at)


class TreeColumn(NamedTuple):
    """What a column of the trees' data is of: a factor's values, the name that it is 1 of, an angle's zero."""

    whole: RuleCondition
    name: str | None = None
    zero: float = 0.0

    def told(self, condition: RuleCondition) -> RuleCondition:
        """A condition on the column as one on the factor."""
        turn = self.whole.turn
        if not turn:
            return condition
        low, high = max(condition.low, 0.0) + self.zero, min(condition.high, turn) + self.zero
        return replace(condition, low=low % turn, high=high % turn or turn)


def _candidates(table: pd.DataFrame, least: int, seed: int) -> Iterator[RuleConditions]:
    trees_of, forests = (import_library(f"sklearn.{part}") for part in ("tree", "ensemble"))
    one_tree, forest = trees_of.DecisionTreeClassifier, forests.RandomForestClassifier
    columns: list[tuple[npt.NDArray[np.float64], TreeColumn]] = []
    for factor, unit in table.attrs["units"].items():
        column, whole = table[factor], RuleCondition(factor, unit)
        if column.dtype == "category":
            names = column.cat.categories.tolist()
            whole = replace(whole, options=frozenset(names))
            columns += [((column == name).to_numpy(np.float64), TreeColumn(whole, name)) for name in names]
            continue
        columns.append((values := column.to_numpy(), TreeColumn(whole)))
        if unit == "degrees" and np.ptp(values) >= AROUND:
            arcs = [(replace(whole, turn=turn), zero) for turn, zero in ARCS]
            columns += [((values - zero) % arc.turn, TreeColumn(arc, zero=zero)) for arc, zero in arcs]
    data, right = np.stack([values for values, _ in columns], axis=1), table["correct"].to_numpy()
    splits = [split for _, split in columns]
    shape = {"max_depth": DEPTH, "min_samples_leaf": least}
    alone = one_tree(**shape, random_state=seed % 2**32)
    several = forest(TREES, **shape, max_features=0.6, random_state=seed % 2**32)
    trees = [(one.tree_, splits) for one in (alone.fit(data, right), *several.fit(data, right).estimators_)]
    for place, split in enumerate(splits):
        if split.whole.turn:  # by itself too: in a tree of all columns other splits of the same angle come first
            trees.append((one_tree(**shape).fit(data[:, [place]], right).tree_, [split]))
    seen: set[RuleConditions] = {()}
    for tree, own in trees:
        for node in _nodes(tree, own):
            factors: dict[str, list[RuleCondition]] = {name: [] for name in table.attrs["units"]}
            for split, condition in node.items():
                factors[condition.factor].append(split.told(condition))
            # of several parts of one angle, each in turn: their bounds are moved later
            for conditions in product(*filter(None, factors.values())):
                if conditions not in seen:
                    seen.add(conditions)
                    yield conditions


def _nodes(tree: Any, splits: list[TreeColumn]) -> Iterator[dict[TreeColumn, RuleCondition]]:
    open_nodes: list[tuple[int, dict[TreeColumn, RuleCondition]]] = [(0, {})]
    while open_nodes:
        node, conditions = open_nodes.pop()
        yield conditions
        left, right = int(tree.children_left[node]), int(tree.children_right[node])
        if left == right:
            continue
        split = splits[tree.feature[node]]
        key = split._replace(name=None)
        before = conditions.get(key, split.whole)
        if split.name is None or before.options is None:
            at = float(f"{tree.threshold[node]:.3g}")  # as it is told
            below, above = replace(before, high=min(before.high, at)), replace(before, low=max(before.low, at))
        else:
            names = before.options
            below, above = (replace(before, options=one) for one in (names - {split.name}, names & {split.name}))
        open_nodes += [(left, {**conditions, key: below}), (right, {**conditions, key: above})]


def import_library(name: str) -> Any:
    """Return a module of scikit-learn, such as ``sklearn.tree``."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            "explain needs scikit-learn, which cannot be imported: pip install 'advsearch[explain]'"
        ) from error
