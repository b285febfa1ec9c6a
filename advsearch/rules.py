"""Where a model is wrong, as rules over a table of rows.

Rules are nodes of decision trees (Breiman et al. 1984) of one half of the rows, the
best by weighted relative accuracy (Lavrac, Flach and Zupan 1999), made shorter where
that costs nothing, one after the other (sequential covering; Friedman and Fisher 1999).
The other half says whether a rule holds.

    table = rules.make_table(rows, ["pose.yaw", "light.power"])
    choosing, counting = rules.split_in_halves(table, seed=0)
    for rule in rules.find_rules(choosing, counting, seed=0).accepted:
        print([condition.row.text for condition in rule.conditions])
        print(rules.estimate_share(rule.inside))

A *table* is a pandas frame with a column for each factor, float64 or a category of
names in alphabetical order; `correct`, whether the model was right; and `unit`, of what
draw a row is: rows of one unit are not independent (`runs.tables.Units`).
``attrs["units"]`` has the unit of each factor, so its keys are the factors.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Iterator, Mapping
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
from advsearch.statistics.clustered import (
    mean_rate,
    one_sided_p_value,
    rate_interval,
    sum_per_unit,
)

MIN_ROWS = 100  # rows of which one half can choose and the other can count
MAX_RULES = 5
MAX_CONDITIONS = 3  # of a rule
N_TREES = 24
MIN_COVERED_SHARE = 0.01
MIN_COVERED_ROWS = 12
MIN_COVERED_UNITS = 3
"""Of the rows that choose, a rule covers at least so many, and as many as so many units
have.
"""
RETAINED_ACCURACY = 0.97
"""Share of its weighted relative accuracy that a rule retains when a condition is left
out.
"""
N_ADJUSTMENTS = 3  # how often all bounds of a rule are adjusted
N_BOUNDS = 250  # to how many quantiles of their factor
SIGNIFICANCE = 0.01
"""Probability that any rule is accepted that is none. Rules are tested one after the
other, each only where all before it were accepted, so that each may be tested at all of
it (a fixed sequence: Maurer, Hothorn and Lehmacher 1995).
"""
MAX_NEEDED = 1_000_000  # rows up to which it is said how many a rule would take
MIN_GAP = 0.1  # by how much more often the model is wrong under a rule than elsewhere
MIN_ANGLE_RANGE = 270.0
"""Degrees that the values of an angle span where it goes all the way round: a grid of
four values does.
"""
ARCS = ((360.0, 180.0), (180.0, 0.0), (180.0, 90.0))
"""Of an angle that goes all the way round, trees have it once more by turn and zero,
degrees: an arc through 0 is one interval there, and so is what lies end-on, at 0 and at
180.
"""

Mask = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


# ---- tables


def make_table(rows: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    """Make a table of factors and right predictions from the rows of a sweep.

    Args:
        rows: rows of a sweep (`runs.tables.make_sweep_frame`). A prediction that was
            not judged counts as not right.
        names: names of parameters. A parameter becomes a factor if it varies and all
            rows have a value of it.

    Returns:
        A column for each factor, "correct" (whether the prediction is right), "unit"
        (rows of one unit may depend on each other), and "outcome" if the rows have it.
        `attrs["units"]` has the units of measurement by factor.
    """
    columns = dict[str, pd.Series]()
    units = dict[str, str]()
    for name in names:
        column = rows[name]
        has_names = column.dtype == "category"
        if has_names:
            # alphabetical, so that the order of the rows does not change the result
            column = column.cat.set_categories(sorted(column.unique()))
        if column.nunique() > 1 and not column.isna().any():
            columns[name] = column
            units[name] = "" if has_names else rows.attrs["units"][name]
    if "outcome" in rows:
        columns.setdefault("outcome", rows["outcome"])
    table = pd.DataFrame(
        {**columns, "correct": rows["correct"] == 1, "unit": rows["unit"]}
    )
    table.attrs["units"] = units  # of measurement, by factor
    return table


def is_in_view(rows: pd.DataFrame) -> Mask:
    """Return in which rows of a sweep (n,) the judged object is in the image."""
    return np.asarray(rows["label"] != OUT_OF_VIEW)


def count_wrong_outcomes(rows: pd.DataFrame) -> dict[str, int] | None:
    """Count the wrong rows by their outcome, such as "missed" or "wrong class".

    The result is None if the rows have no outcomes, or none is wrong.
    """
    if "outcome" not in rows:
        return None
    counts = rows.loc[rows["correct"] != 1, "outcome"].astype(str).value_counts()
    counts_by_name = {
        outcome.value: int(counts[outcome.value])
        for outcome in Outcome
        if outcome.value in counts
    }
    return counts_by_name or None


def estimate_interval(table: pd.DataFrame) -> tuple[float, float]:
    """Return the 95 % interval of `estimate_rate`; 0 to 1 where there is no row."""
    if table.empty:
        return 0.0, 1.0
    return rate_interval(*count_per_unit(table))


def estimate_rate(table: pd.DataFrame) -> float:
    """Return the mean over units of the share of right predictions of each; NaN where
    there is no row.
    """
    return mean_rate(*count_per_unit(table))


def count_per_unit(table: pd.DataFrame) -> tuple[FloatArray, FloatArray]:
    """Return the right predictions and the predictions of each unit (m,)."""
    n_right = sum_per_unit(table["correct"], table["unit"])
    n_rows = sum_per_unit(np.ones(len(table)), table["unit"])
    return n_right, n_rows


def merge_repeats(table: pd.DataFrame) -> pd.DataFrame:
    """Merge units that have a row with the same configuration.

    Such rows are no independent samples, but the same sample twice, if equal samples do
    not occur by chance. That is assumed if some numerical factor has at least half as
    many values as there are rows. Otherwise the table is returned unchanged: values of
    a grid, and names, also repeat in independent samples.
    """
    factors = list(table.attrs["units"])
    is_continuous = any(
        table[name].dtype != "category" and 2 * table[name].nunique() >= len(table)
        for name in factors
    )
    if not is_continuous:
        return table
    # Rows with the same values of all factors get the same number.
    configuration = (
        table.groupby(factors, sort=False, observed=True).ngroup().to_numpy()
    )
    n_configurations = int(configuration.max()) + 1
    if n_configurations == len(table):  # all are different
        return table
    unit_index = np.unique(table["unit"], return_inverse=True)[1]
    merged = table.assign(unit=find_connected(unit_index, configuration))
    merged.attrs = table.attrs
    return merged


def find_connected(first: IntArray, second: IntArray) -> IntArray:
    """Find the connected components of rows that share a number.

    Two rows are connected if they have the same `first` number or the same `second`
    number, or if other rows connect them.

    Args:
        first, second: (n,) numbers from 0 of each row.

    Returns:
        The group of each row (n,), named by the lowest `first` number in it.
    """
    group = first
    # the lowest number of a group spreads from row to row until nothing changes
    while True:
        linked = group
        for number in (second, first):
            # the lowest group of all rows with each number
            lowest = np.full(int(number.max()) + 1, len(group))
            np.minimum.at(lowest, number, linked)
            linked = lowest[number]
        if (linked == group).all():
            return group
        group = linked


def split_in_halves(
    table: pd.DataFrame, seed: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Split a table into two random halves; no unit is split.

    Rules are chosen on the first half and tested on the second. So the test does not
    depend on the choice.

    Args:
        table: table from `make_table`.
        seed: root seed of the random split.
    """
    table = merge_repeats(table)
    units, unit_index = np.unique(table["unit"], return_inverse=True)
    order = np.random.default_rng(seeds.stream(seed, "halves")).permutation(len(units))
    is_in_first = np.isin(unit_index, order[: len(units) // 2])
    return table[is_in_first], table[~is_in_first]


# ---- rules


@dataclass(frozen=True)
class RuleCondition:
    """A part of the values of one factor: over `low` and at most `high`, or some of its
    names.

    Attributes:
        factor: its name.
        unit: unit of the factor.
        low, high: bounds of numbers.
        options: names; None for numbers.
        turn: 360 or 180 degrees after which values of an angle repeat; then, where
            `low` is over `high`, the part goes through 0. Else 0.
    """

    factor: str
    unit: str = ""
    low: float = -np.inf
    high: float = np.inf
    options: frozenset[str] | None = None
    turn: float = 0.0

    def holds(self, table: pd.DataFrame) -> Mask:
        """Return in which rows the condition holds, (n,) bool.

        A condition on an angle may hold from 350 to 10 degrees, through zero; then its
        low bound is over its high bound.
        """
        column = table[self.factor]
        if self.options is not None:
            return np.asarray(column.isin(self.options))
        values = column.to_numpy()
        if self.turn:
            values = values % self.turn
        is_over = values > self.low
        is_at_most = values <= self.high
        goes_through_zero = self.turn and self.low > self.high
        if goes_through_zero:
            return np.asarray(is_over | is_at_most)
        return np.asarray(is_over & is_at_most)

    @property
    def arcs(self) -> tuple[tuple[float, float], ...]:
        """The arcs in which a condition on an angle holds, (start, end) in degrees.

        With a `turn` of 180 the condition repeats after 180 degrees, so that there are
        two arcs, opposite each other. A factor that is no angle has none.
        """
        if not self.turn:
            return ()
        width = (self.high - self.low) % self.turn
        starts = [
            self.low + offset for offset in np.arange(0.0, 360.0, self.turn).tolist()
        ]
        return tuple((start, start + width) for start in starts)

    @property
    def row(self) -> ConditionRow:
        """The condition as a result stores it."""
        return ConditionRow(
            parameter=self.factor,
            unit=self.unit,
            over=self.low if np.isfinite(self.low) else None,
            at_most=self.high if np.isfinite(self.high) else None,
            options=sorted(self.options or ()),
            turn=self.turn or None,
            text=f"{self.factor} {self._values_text}",
        )

    @property
    def _values_text(self) -> str:
        """The values that fulfil the condition, as text: names, arcs of a turn, or bounds."""
        if self.options:
            return " or ".join(sorted(self.options))
        bounds = []
        if self.turn:
            arcs = [
                f"from {start % 360:g} to {end % 360:g}" for start, end in self.arcs
            ]
            bounds.append(" or ".join(arcs))
        else:
            if np.isfinite(self.low):
                bounds.append(f"over {self.low:g}")
            if np.isfinite(self.high):
                bounds.append(f"at most {self.high:g}")
        has_unit = self.unit not in ("", "1")  # "1" is that of a plain number
        return " and ".join(bounds) + (f" {self.unit}" if has_unit else "")


# all of which hold, at most one for each factor
RuleConditions = tuple[RuleCondition, ...]


def find_covered(conditions: RuleConditions, table: pd.DataFrame) -> Mask:
    """Return which rows (n,) lie under all conditions."""
    mask = np.ones(len(table), dtype=bool)
    for condition in conditions:
        mask &= condition.holds(table)
    return mask


@dataclass(frozen=True, eq=False)
class CountedRule:
    """A rule, and the rows inside it and elsewhere, of those that did not choose it and
    lie under no rule before.
    """

    conditions: RuleConditions
    inside: pd.DataFrame
    elsewhere: pd.DataFrame

    @property
    def gap(self) -> float:
        """How much higher the rate of right predictions is elsewhere than under the
        rule; all units weigh the same. 0 without rows in either.
        """
        if self.inside.empty or self.elsewhere.empty:
            return 0.0
        return estimate_rate(self.elsewhere) - estimate_rate(self.inside)

    @cached_property
    def p_value(self) -> float:
        """The probability of so few right predictions under it, or fewer, if they were
        spread by chance.
        """
        return self._compute_p_value(1.0)

    @property
    def holds(self) -> bool:
        """Whether rows that did not choose it show it, and more than chance would."""
        return self.gap >= MIN_GAP and self.p_value <= SIGNIFICANCE

    def find_needed_factor(self) -> float | None:
        """Return by which factor the number of rows has to grow to show the rule.

        The rates of right rows are assumed to stay the same. The result is None if no
        number of rows up to `MAX_NEEDED` is enough.
        """
        has_gap = self.gap >= MIN_GAP
        if not has_gap:  # the rates do not change, so more rows do not help
            return None
        factor = 1.0
        n_rows = len(self.inside) + len(self.elsewhere)
        while n_rows * factor <= MAX_NEEDED:
            if self._compute_p_value(factor) <= SIGNIFICANCE:
                return factor
            factor *= 1.05  # precise to 5 %
        return None

    def _compute_p_value(self, factor: float) -> float:
        """Return the p-value of the rule for a larger number of rows.

        Args:
            factor: how many times as many rows there would be, with the same rates of
                right rows; 1 for the present ones.
        """
        units = np.concatenate([self.inside["unit"], self.elsewhere["unit"]])
        is_right = np.concatenate([self.inside["correct"], self.elsewhere["correct"]])
        is_inside = np.arange(len(units)) < len(self.inside)
        right_inside = sum_per_unit(is_inside & is_right, units)
        rows_inside = sum_per_unit(is_inside, units)
        right_elsewhere = sum_per_unit(~is_inside & is_right, units)
        rows_elsewhere = sum_per_unit(~is_inside, units)
        return one_sided_p_value(
            right_inside, rows_inside, right_elsewhere, rows_elsewhere, factor
        )


@dataclass(frozen=True)
class FoundRules:
    """Rules, and the best one that is none.

    Attributes:
        accepted: the rules that hold, the weightiest first.
        best_rejected: the best one after these, if there is one to test.
    """

    accepted: list[CountedRule]
    best_rejected: CountedRule | None


def find_rules(choosing: pd.DataFrame, counting: pd.DataFrame, seed: int) -> FoundRules:
    """Find rules under which the model is wrong more often.

    Each rule is chosen on some rows and tested on others. The rows that it covers are
    left out when the next rule is chosen. The search ends at the first rule that the
    test does not confirm.

    Args:
        choosing: table of the rows on which rules are chosen.
        counting: table of the rows on which rules are tested.
        seed: seed of the trees.

    Raises:
        InputError: scikit-learn is missing.
    """
    accepted: list[CountedRule] = []
    for number in range(MAX_RULES):
        conditions = find_best_conditions(choosing, seeds.stream(seed, "rules", number))
        if not conditions:
            return FoundRules(accepted, None)
        inside = find_covered(conditions, counting)
        rule = CountedRule(conditions, counting[inside], counting[~inside])
        if not rule.holds:
            return FoundRules(accepted, rule)
        accepted.append(rule)
        # both without the rows of this rule
        choosing = choosing[~find_covered(conditions, choosing)]
        counting = rule.elsewhere
    return FoundRules(accepted, None)


# ---- the best conditions


def find_best_conditions(table: pd.DataFrame, seed: int) -> RuleConditions:
    """Find the combination of conditions that selects wrong predictions best.

    Trees suggest combinations, and `ConditionScorer` scores them. From the best one,
    conditions that add little are removed, and its bounds are adjusted. The result is
    empty if too few rows are left, or if no combination is better than chance.

    Args:
        table: table of the rows.
        seed: seed of the trees.
    """
    n_wrong = int((~table["correct"].to_numpy()).sum())
    min_rows = find_min_rows(table)
    has_both_answers = 0 < n_wrong < len(table)
    # Both sides of a condition need `min_rows` rows.
    if len(table) < 2 * min_rows or not has_both_answers:
        return ()
    scorer = ConditionScorer(table, min_rows)
    best = max(find_candidates(table, min_rows, seed), key=scorer.score, default=())
    if not best or scorer.score(best) <= 0.0:
        return ()
    return adjust_bounds(shorten_conditions(best, scorer), scorer)


def find_min_rows(table: pd.DataFrame) -> int:
    """Return how many rows a rule has to cover at least.

    Rows of one unit are not independent: if units have several rows, it is also at
    least as many rows as `MIN_COVERED_UNITS` units have on average.
    """
    min_rows = max(MIN_COVERED_ROWS, round(MIN_COVERED_SHARE * len(table)))
    if table["unit"].is_unique:
        return min_rows
    rows_of_units: float = MIN_COVERED_UNITS * len(table) / table["unit"].nunique()
    return max(min_rows, round(rows_of_units))


class ConditionScorer:
    """Scores conditions by their weighted relative accuracy in a table: of the model's
    being wrong.
    """

    def __init__(self, table: pd.DataFrame, min_rows: int) -> None:
        self.table = table
        self._min_rows = min_rows
        is_wrong = ~table["correct"].to_numpy()
        self._excess = is_wrong - is_wrong.mean()

    def score(self, conditions: RuleConditions) -> float:
        """Return the score: the fraction of rows that lie under the conditions, times by
        how much more of them are wrong than of all; -1 if they are too few.
        """
        is_covered = find_covered(conditions, self.table)
        if int(is_covered.sum()) < self._min_rows:
            return -1.0
        return float(self._excess[is_covered].sum()) / len(self.table)


def shorten_conditions(
    conditions: RuleConditions, scorer: ConditionScorer
) -> RuleConditions:
    """Remove conditions that add little to the score, one at a time.

    In each step the condition is removed whose removal costs least. The steps end when
    the loss exceeds a fraction of the score and its own standard error.
    """
    table = scorer.table
    score = scorer.score(conditions)
    variance = float(table["correct"].to_numpy().var())
    while len(conditions) > 1:
        candidates = [
            conditions[:index] + conditions[index + 1 :]
            for index in range(len(conditions))
        ]
        shorter = max(candidates, key=scorer.score)
        is_added = find_covered(shorter, table) & ~find_covered(conditions, table)
        n_added = int(is_added.sum())
        # A loss below its standard error may be chance. It depends on the rows that the
        # shorter conditions cover in addition.
        standard_error = math.sqrt(n_added * variance) / len(table)
        loss = score - scorer.score(shorter)
        if loss > max((1.0 - RETAINED_ACCURACY) * score, standard_error):
            break
        conditions = shorter
    return conditions


def adjust_bounds(
    conditions: RuleConditions, scorer: ConditionScorer
) -> RuleConditions:
    """Adjust the bounds of conditions so that their score increases.

    One bound after the other is moved to the best quantile of its factor (coordinate
    descent). All of them are adjusted several times, since they depend on each other.
    """
    for _ in range(N_ADJUSTMENTS):
        for index in range(len(conditions)):
            adjusted = [
                (*conditions[:index], condition, *conditions[index + 1 :])
                for condition in list_adjusted(conditions[index], scorer.table)
            ]
            # The present conditions come first, since `max` returns the first of
            # several with the best score.
            conditions = max([conditions, *adjusted], key=scorer.score)
    return conditions


def list_adjusted(
    condition: RuleCondition, table: pd.DataFrame
) -> Iterator[RuleCondition]:
    """Yield copies of a condition with one bound moved to a quantile of its factor.

    A tree chooses each bound for the bounds that it chose before. After these were
    adjusted, another bound may be better. A condition on names has no bounds, and
    nothing is yielded for it.

    Args:
        condition: condition on a factor.
        table: table with the values of the factor.
    """
    if condition.options is not None:
        return
    values = table[condition.factor].to_numpy()
    if condition.turn:
        values = values % condition.turn
    # without the smallest and the largest value, which bound nothing
    quantiles = np.quantile(values, np.linspace(0, 1, N_BOUNDS + 1)[1:-1])
    # a bound that is infinite stays so
    has_low = condition.low > -np.inf
    has_high = condition.high < np.inf
    is_angle = bool(condition.turn)  # its low bound may be over the high one
    for bound in dict.fromkeys(float(f"{quantile:.3g}") for quantile in quantiles):
        if bound in (condition.low, condition.high):
            continue
        if has_low and (is_angle or bound < condition.high):
            yield replace(condition, low=bound)
        if has_high and (is_angle or bound > condition.low):
            yield replace(condition, high=bound)


# ---- candidates from trees


class TreeColumn(NamedTuple):
    """What a column of the trees' data is of.

    Attributes:
        full_condition: full condition of the factor, without bounds.
        name: name that the column is 1 of; None for numbers.
        zero: zero of an angle, degrees.
    """

    full_condition: RuleCondition
    name: str | None = None
    zero: float = 0.0

    def read_values(self, table: pd.DataFrame) -> FloatArray:
        """Return the values (n,) of the column: for a name, 1 in rows that have it and
        0 in others; for numbers these, for an angle measured from `zero`.
        """
        column = table[self.full_condition.factor]
        if self.name is not None:
            return np.asarray(column == self.name, np.float64)
        values: FloatArray = column.to_numpy()
        if self.full_condition.turn:
            values = (values - self.zero) % self.full_condition.turn
        return values

    def to_factor(self, condition: RuleCondition) -> RuleCondition:
        """Convert a condition on the column to a condition on its factor.

        A column of an angle measures it from `zero`, such as 90 degrees, so that the
        bounds of an arc through 0 degrees are ordered there. The bounds of the result
        are measured from 0 degrees.
        """
        turn = self.full_condition.turn
        if not turn:
            return condition
        low = max(condition.low, 0.0) + self.zero
        high = min(condition.high, turn) + self.zero
        end = high % turn
        if end == 0.0:  # the arc ends at the full turn, which modulo makes 0
            end = turn
        return replace(condition, low=low % turn, high=end)


def find_candidates(
    table: pd.DataFrame, min_rows: int, seed: int
) -> Iterator[RuleConditions]:
    """Yield combinations of conditions that may describe wrong predictions.

    They are the conditions on the paths from the roots of trees to their nodes. Equal
    combinations are yielded once.

    Args:
        table: table of the rows.
        min_rows: minimum number of rows in a node.
        seed: seed of the trees.
    """
    # the root has no conditions, and is left out
    yielded_conditions: set[RuleConditions] = {()}
    for tree, columns in grow_trees(table, min_rows, seed):
        for node in walk_tree(tree, columns):
            for conditions in _list_rules_of_node(node, table.attrs["units"]):
                if conditions not in yielded_conditions:
                    yielded_conditions.add(conditions)
                    yield conditions


def _list_rules_of_node(
    node: Mapping[TreeColumn, RuleCondition], factors: Iterable[str]
) -> Iterator[RuleConditions]:
    """Yield the conditions that lead to a node, with at most one for each factor.

    A path may have conditions on several columns of the same angle. A rule can have
    only one of them, so each is tried; its bounds are adjusted later.

    Args:
        node: conditions on the path to the node, by column.
        factors: names of all factors; they determine the order of the conditions.
    """
    conditions_of_factor: dict[str, list[RuleCondition]] = {
        name: [] for name in factors
    }
    for column, condition in node.items():
        conditions_of_factor[condition.factor].append(column.to_factor(condition))
    yield from product(*filter(None, conditions_of_factor.values()))


def list_columns(table: pd.DataFrame) -> list[TreeColumn]:
    """Return the columns of data for trees.

    A numerical factor has one column, and a factor of names has one for each name. A
    tree splits a column at a threshold, which cannot select an arc through 0 degrees.
    So an angle that covers nearly a full turn has further columns, each measured from
    another zero (`ARCS`).
    """
    columns = []
    for factor, unit in table.attrs["units"].items():
        values = table[factor]
        full_condition = RuleCondition(factor, unit)
        if values.dtype == "category":
            names = values.cat.categories.tolist()
            full_condition = replace(full_condition, options=frozenset(names))
            columns += [TreeColumn(full_condition, name) for name in names]
            continue
        columns.append(TreeColumn(full_condition))
        if unit == "degrees" and np.ptp(values.to_numpy()) >= MIN_ANGLE_RANGE:
            columns += [
                TreeColumn(replace(full_condition, turn=turn), zero=zero)
                for turn, zero in ARCS
            ]
    return columns


def grow_trees(
    table: pd.DataFrame, min_rows: int, seed: int
) -> list[tuple[Any, list[TreeColumn]]]:
    """Fit trees of scikit-learn that predict whether the model is right.

    They are one tree on all columns, the trees of a random forest, and for each column
    of an angle that is measured from another zero a tree on that column alone.

    Args:
        table: table of the rows.
        min_rows: minimum number of rows in a leaf.
        seed: seed of the trees.

    Returns:
        Each tree (`tree_` of scikit-learn) with the columns of its data.
    """
    make_tree = import_library("sklearn.tree").DecisionTreeClassifier
    make_forest = import_library("sklearn.ensemble").RandomForestClassifier
    columns = list_columns(table)
    data = np.stack([column.read_values(table) for column in columns], axis=1)
    is_right = table["correct"].to_numpy()
    shape = {"max_depth": MAX_CONDITIONS, "min_samples_leaf": min_rows}
    random_state = seed % 2**32  # scikit-learn takes 32 bits
    single_tree = make_tree(**shape, random_state=random_state).fit(data, is_right)
    forest = make_forest(
        N_TREES, **shape, max_features=0.6, random_state=random_state
    ).fit(data, is_right)
    trees = [
        (estimator.tree_, columns) for estimator in (single_tree, *forest.estimators_)
    ]
    for index, column in enumerate(columns):
        if column.full_condition.turn:
            # alone, since in a tree of all columns other splits of the angle come first
            tree = make_tree(**shape).fit(data[:, [index]], is_right).tree_
            trees.append((tree, [column]))
    return trees


def walk_tree(
    tree: Any, columns: list[TreeColumn]
) -> Iterator[dict[TreeColumn, RuleCondition]]:
    """Yield the conditions on the path to each node of a tree, by column.

    A factor of names has a column for each name, but a single condition, which lists
    the names that remain. It is stored under the column with the name None.

    Args:
        tree: `tree_` of scikit-learn, which has arrays with the split of each node.
        columns: columns of its data, by index.
    """
    open_nodes: list[tuple[int, dict[TreeColumn, RuleCondition]]] = [(0, {})]
    while open_nodes:
        node, conditions = open_nodes.pop()
        yield conditions
        left = int(tree.children_left[node])
        right = int(tree.children_right[node])
        is_leaf = left == right  # both are -1
        if is_leaf:
            continue
        column = columns[tree.feature[node]]
        key = column._replace(name=None)  # shared by all names of the factor
        condition = conditions.get(key, column.full_condition)
        if column.name is None or condition.options is None:
            threshold = float(f"{tree.threshold[node]:.3g}")  # as it is reported
            below = replace(condition, high=min(condition.high, threshold))
            above = replace(condition, low=max(condition.low, threshold))
        else:
            # a row with the name has 1 in the column, and is above; others have 0
            below = replace(condition, options=condition.options - {column.name})
            above = replace(condition, options=condition.options & {column.name})
        open_nodes.append((left, {**conditions, key: below}))
        open_nodes.append((right, {**conditions, key: above}))


def import_library(name: str) -> Any:
    """Return a module of scikit-learn, such as ``sklearn.tree``.

    Raises:
        InputError: it is missing.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            "explain needs scikit-learn, which cannot be imported: pip install "
            "'advsearch[explain]'"
        ) from error
