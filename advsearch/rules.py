"""Where a model is wrong, as rules over a table of rows.

A rule is a combination of conditions, such as "distance over 10 and light.power at most
0.3". Candidates are the nodes of decision trees (Breiman et al. 1984) that are fitted
to one half of the rows. The best candidate by weighted relative accuracy (Lavrac, Flach
and Zupan 1999) is shortened where that costs little, and tested on the other half. Then
the rows that it covers are removed, and the next rule is searched (sequential covering;
Friedman and Fisher 1999).

    table = rules.make_table(rows, ["pose.yaw", "light.power"])
    choosing, counting = rules.split_in_halves(table, seed=0)
    for rule in rules.find_rules(choosing, counting, seed=0).accepted:
        print([condition.row.text for condition in rule.conditions])
        print(rules.estimate_rate(rule.inside))

A *table* is a pandas frame. A *factor* is a parameter of the scene; its column is
float64, or a category of names in alphabetical order. Column `correct` says whether the
model was right. Column `unit` is the index of a group of rows that are not independent,
such as the frames of a drive (`runs.tables.Units`). ``attrs["units"]`` is something
else: the unit of measurement of each factor. Its keys are the factors.
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

# smallest number of rows that can be divided into a half to choose rules and a half to
# test them
MIN_ROWS = 100
MAX_RULES = 5
MAX_CONDITIONS = 3  # of a rule
N_TREES = 24
MIN_COVERED_FRACTION = 0.01
MIN_COVERED_ROWS = 12
MIN_COVERED_UNITS = 3
"""A rule has to cover this fraction and this number of the rows on which it is chosen,
and as many rows as this number of units have on average (`find_min_rows`).
"""
RETAINED_ACCURACY = 0.97
"""A condition is removed from a rule if the rule retains this fraction of its weighted
relative accuracy.
"""
N_ADJUSTMENTS = 3  # how often all bounds of a rule are adjusted
N_BOUNDS = 250  # number of quantiles of a factor that are tried as a bound
SIGNIFICANCE = 0.01
"""Largest probability that any rule is accepted by chance. Rules are tested in order,
each only if all before it were accepted. So each may be tested at the full level (a
fixed sequence: Maurer, Hothorn and Lehmacher 1995).
"""
# Largest number of rows for which it is computed whether a rule would be accepted.
MAX_NEEDED = 1_000_000
# The rate of right predictions has to be lower by this much under a rule than
# elsewhere.
MIN_GAP = 0.1
MIN_ANGLE_RANGE = 270.0
"""If the values of an angle span at least this many degrees, they cover a full turn. A
grid of four values does.
"""
ARCS = ((360.0, 180.0), (180.0, 0.0), (180.0, 90.0))
"""(turn, zero) of the further columns of an angle that covers a full turn, in degrees.
In such a column the angle is measured from `zero`, modulo `turn`. With a zero of 180 an
arc through 0 degrees is one interval. With a turn of 180 opposite directions, such as
the front and the back at 0 and 180 degrees, are the same value.
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
        column = _sort_categories(rows[name])
        if column.nunique() > 1 and not column.isna().any():
            columns[name] = column
            has_names = column.dtype == "category"
            units[name] = "" if has_names else rows.attrs["units"][name]
    if "outcome" in rows:
        # If a factor has the name "outcome", its column stays.
        columns.setdefault("outcome", rows["outcome"])
    # In `rows.attrs` units are those of measurement; column "unit" is the group of
    # rows.
    table = pd.DataFrame(
        {**columns, "correct": rows["correct"] == 1, "unit": rows["unit"]}
    )
    table.attrs["units"] = units
    return table


def _sort_categories(column: pd.Series) -> pd.Series:
    """Return a column of names with these in alphabetical order; others unchanged.

    So the order of the rows does not change a result.
    """
    if column.dtype != "category":
        return column
    return column.cat.set_categories(sorted(column.unique()))


def is_in_view(rows: pd.DataFrame) -> Mask:
    """Return in which rows of a sweep (n,) the evaluated object is in the image."""
    return np.asarray(rows["label"] != OUT_OF_VIEW)


def count_wrong_outcomes(rows: pd.DataFrame) -> dict[str, int] | None:
    """Count the wrong rows by their outcome, such as "missed" or "wrong class".

    The result is None if the rows have no outcomes, or none is wrong.
    """
    if "outcome" not in rows:
        return None
    # a prediction that was not judged counts as wrong
    is_wrong = rows["correct"] != 1
    counts = rows.loc[is_wrong, "outcome"].astype(str).value_counts()
    counts_by_name = {
        outcome.value: int(counts[outcome.value])
        for outcome in Outcome
        if outcome.value in counts
    }
    return counts_by_name or None


def estimate_interval(table: pd.DataFrame) -> tuple[float, float]:
    """Return the 95 % interval of `estimate_rate`; 0 to 1 without rows."""
    if table.empty:
        return 0.0, 1.0
    return rate_interval(*count_per_unit(table))


def estimate_rate(table: pd.DataFrame) -> float:
    """Return the rate of right predictions: the mean over units of each unit's rate.

    It is NaN without rows.
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
    many values as there are rows. Otherwise the table is returned unchanged: if all
    factors are names or have the values of a grid, independent samples may be equal,
    too.
    """
    factors = list(table.attrs["units"])
    if not _has_continuous_factor(table, factors):
        return table
    # Rows with the same values of all factors get the same number.
    configuration = (
        table.groupby(factors, sort=False, observed=True).ngroup().to_numpy()
    )
    n_configurations = int(configuration.max()) + 1
    if n_configurations == len(table):  # all are different
        return table
    unit_index = np.unique(table["unit"], return_inverse=True)[1]
    # units that share a configuration, directly or by other units
    merged = table.assign(unit=find_connected(unit_index, configuration))
    merged.attrs = table.attrs
    return merged


def _has_continuous_factor(table: pd.DataFrame, factors: Iterable[str]) -> bool:
    """Return whether a numerical factor has at least half as many values as rows."""
    return any(
        table[name].dtype != "category" and 2 * table[name].nunique() >= len(table)
        for name in factors
    )


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
    # The lowest number of a group spreads from row to row until nothing changes. In
    # each round it spreads to rows with the same `second` number, then with the same
    # `first`.
    while True:
        linked = group
        for number in (second, first):
            # for each number, the lowest group of its rows; at first larger than all
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
    order = np.random.default_rng(seeds.derive_seed(seed, "halves")).permutation(
        len(units)
    )
    is_in_first = np.isin(unit_index, order[: len(units) // 2])
    return table[is_in_first], table[~is_in_first]


# ---- rules


@dataclass(frozen=True)
class RuleCondition:
    """A condition on the value of one factor.

    A number has to be over `low` and at most `high`; a name has to be one of `options`.

    Attributes:
        factor: name of the factor.
        unit: unit of measurement of the factor.
        low, high: bounds of numbers; infinite without a bound.
        options: names that fulfil the condition; None for numbers.
        turn: for an angle, the degrees after which it repeats, 360 or 180: the bounds
            are those of the angle modulo `turn`. If `low` is over `high`, the range
            goes through 0. Otherwise 0.
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
        low bound is over its high bound. Angles are compared modulo `turn`.
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
        # modulo `turn`, as the range may go through 0
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
            turn=self.turn or None,  # 0 means that it is no angle
            text=f"{self.factor} {self._values_text}",
        )

    @property
    def _values_text(self) -> str:
        """The values that fulfil the condition, as text: names, arcs or bounds."""
        if self.options:
            return " or ".join(sorted(self.options))
        is_angle = self.turn > 0.0
        values_text = self._arcs_text if is_angle else self._bounds_text
        has_unit = self.unit not in ("", "1")  # "1" means a number without a unit
        return f"{values_text} {self.unit}" if has_unit else values_text

    @property
    def _arcs_text(self) -> str:
        """The arcs of an angle that fulfil the condition, in degrees, as text."""
        arcs = [f"from {start % 360:g} to {end % 360:g}" for start, end in self.arcs]
        return " or ".join(arcs)

    @property
    def _bounds_text(self) -> str:
        """The finite bounds of the condition, as text without a unit."""
        bounds = []
        if np.isfinite(self.low):
            bounds.append(f"over {self.low:g}")
        if np.isfinite(self.high):
            bounds.append(f"at most {self.high:g}")
        return " and ".join(bounds)


# The conditions of a rule, at most one for each factor. All of them have to hold.
RuleConditions = tuple[RuleCondition, ...]


def find_covered(conditions: RuleConditions, table: pd.DataFrame) -> Mask:
    """Return which rows (n,) fulfil all conditions."""
    mask = np.ones(len(table), dtype=bool)
    for condition in conditions:
        mask &= condition.holds(table)
    return mask


@dataclass(frozen=True, eq=False)
class CountedRule:
    """A rule, and the rows on which it is tested.

    The rule was not chosen on these rows, and no earlier rule covers them.

    Attributes:
        conditions: conditions of the rule.
        inside: table of the rows that the rule covers.
        elsewhere: table of the other rows.
    """

    conditions: RuleConditions
    inside: pd.DataFrame
    elsewhere: pd.DataFrame

    @property
    def gap(self) -> float:
        """Rate of right predictions elsewhere minus that under the rule.

        In both rates all units, which are groups of dependent rows, have equal weights
        (`estimate_rate`). The gap is 0 if there are no rows on one side.
        """
        if self.inside.empty or self.elsewhere.empty:
            return 0.0
        return estimate_rate(self.elsewhere) - estimate_rate(self.inside)

    @cached_property
    def p_value(self) -> float:
        """Probability of at most as many right predictions under the rule, if chance
        decided which predictions are right.
        """
        return self._compute_p_value(factor=1.0)

    @property
    def holds(self) -> bool:
        """Whether the rows on which it is tested confirm the rule.

        The gap has to be large enough, and not explained by chance.
        """
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
            factor: factor of the number of rows, with the same rates of right rows; 1
                for the rows of the rule.
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
    """The result of a search for rules.

    Attributes:
        accepted: rules that hold, in the order in which they were chosen, the best
            first.
        best_rejected: the next candidate, which does not hold; None if there was none.
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
        conditions = find_best_conditions(
            choosing, seeds.derive_seed(seed, "rules", number)
        )
        if not conditions:
            return FoundRules(accepted, best_rejected=None)
        inside = find_covered(conditions, counting)
        rule = CountedRule(conditions, counting[inside], counting[~inside])
        if not rule.holds:
            return FoundRules(accepted, best_rejected=rule)
        accepted.append(rule)
        # both without the rows of this rule
        choosing = choosing[~find_covered(conditions, choosing)]
        counting = rule.elsewhere
    return FoundRules(accepted, best_rejected=None)


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

    There are up to three lower limits: a number of rows, a fraction of the table, and,
    if units have several rows, the average number of rows of `MIN_COVERED_UNITS` units.
    The last is because the rows of a unit are not independent.
    """
    min_rows = max(MIN_COVERED_ROWS, round(MIN_COVERED_FRACTION * len(table)))
    if table["unit"].is_unique:
        return min_rows
    n_units = table["unit"].nunique()
    rows_of_units: float = MIN_COVERED_UNITS * len(table) / n_units
    return max(min_rows, round(rows_of_units))


class ConditionScorer:
    """Scores conditions by their weighted relative accuracy: how well they select the
    rows of a table in which the model is wrong.
    """

    def __init__(self, table: pd.DataFrame, min_rows: int) -> None:
        self.table = table
        self._min_rows = min_rows
        is_wrong = ~table["correct"].to_numpy()
        # (n,) whether a row is wrong, 1 or 0, minus the rate of wrong rows in the table
        self._excess = is_wrong - is_wrong.mean()

    def score(self, conditions: RuleConditions) -> float:
        """Return the weighted relative accuracy of conditions; -1 for too few rows.

        It is a product: the fraction of rows that the conditions cover, times the rate
        of wrong rows among these minus that in the table.
        """
        is_covered = find_covered(conditions, self.table)
        if int(is_covered.sum()) < self._min_rows:
            return -1.0
        # The excess of a row is 1 if it is wrong, else 0, minus the rate in the table.
        # The product is equal to its sum over the covered rows, divided by the number
        # of all rows.
        return float(self._excess[is_covered].sum()) / len(self.table)


def shorten_conditions(
    conditions: RuleConditions, scorer: ConditionScorer
) -> RuleConditions:
    """Remove conditions that add little to the score, one at a time.

    In each step the condition is removed whose removal costs least. The loss is the
    score of all conditions, before the first step, minus the score of those that are
    left. The steps end when it exceeds both a fraction of the first score and its own
    standard error.
    """
    full_score = scorer.score(conditions)
    while len(conditions) > 1:
        shorter = max(_remove_each_condition(conditions), key=scorer.score)
        loss = full_score - scorer.score(shorter)
        tolerated_loss = (1.0 - RETAINED_ACCURACY) * full_score
        # A loss below its standard error may be chance.
        standard_error = _estimate_loss_error(scorer.table, conditions, shorter)
        if loss > max(tolerated_loss, standard_error):
            break
        conditions = shorter
    return conditions


def _remove_each_condition(conditions: RuleConditions) -> list[RuleConditions]:
    """Return, for each condition, all others."""
    return [
        conditions[:index] + conditions[index + 1 :] for index in range(len(conditions))
    ]


def _estimate_loss_error(
    table: pd.DataFrame, conditions: RuleConditions, shorter: RuleConditions
) -> float:
    """Return the standard error of the loss of score if a condition is removed.

    Every row that is covered in addition changes the score by the row's wrongness minus
    the mean, divided by the number of all rows. The variances of these changes add up.

    Args:
        table: table of the rows.
        conditions: the conditions before.
        shorter: the conditions without one.
    """
    variance = float(table["correct"].to_numpy().var())  # of a single row
    is_added = find_covered(shorter, table) & ~find_covered(conditions, table)
    n_added = int(is_added.sum())
    return math.sqrt(n_added * variance) / len(table)


def adjust_bounds(
    conditions: RuleConditions, scorer: ConditionScorer
) -> RuleConditions:
    """Adjust the bounds of conditions so that their score increases.

    One bound after the other is moved to the best quantile of its factor (coordinate
    descent). All of them are adjusted several times, since they depend on each other.
    """
    for _ in range(N_ADJUSTMENTS):
        for index in range(len(conditions)):
            # with another lower or upper bound of this condition; none for names
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
    """Yield copies of a condition, each with one bound changed to a quantile.

    They are quantiles of the factor in the table. A condition on names has no bounds,
    and nothing is yielded for it.

    Args:
        condition: condition on a factor.
        table: table with the values of the factor.
    """
    if condition.options is not None:
        return
    # an infinite bound is not changed
    has_low = condition.low > -np.inf
    has_high = condition.high < np.inf
    is_angle = bool(condition.turn)  # its low bound may be over the high one
    for bound in _list_bounds(condition, table):
        if bound in (condition.low, condition.high):
            continue
        if has_low and (is_angle or bound < condition.high):
            yield replace(condition, low=bound)
        if has_high and (is_angle or bound > condition.low):
            yield replace(condition, high=bound)


def _list_bounds(condition: RuleCondition, table: pd.DataFrame) -> list[float]:
    """Return quantiles of the factor of a condition, with three digits, as bounds."""
    values = table[condition.factor].to_numpy()
    if condition.turn:
        values = values % condition.turn  # bounds of an angle are modulo its turn
    # without the smallest and the largest value, which bound nothing
    quantiles = np.quantile(values, np.linspace(0, 1, N_BOUNDS + 1)[1:-1])
    return list(dict.fromkeys(float(f"{quantile:.3g}") for quantile in quantiles))


# ---- candidates from trees


class TreeColumn(NamedTuple):
    """A column of the data that trees are fitted to.

    Attributes:
        full_condition: condition on the column's factor that all rows fulfil: without
            bounds, or with all names. For an angle it has the column's `turn`.
        name: for a factor of names, the name whose rows have a 1 in the column; None
            for numbers.
        zero: for an angle, the degrees from which the column measures it.
    """

    full_condition: RuleCondition
    name: str | None = None
    zero: float = 0.0

    def read_values(self, table: pd.DataFrame) -> FloatArray:
        """Return the values (n,) of the column.

        - For a name: 1 in rows that have it and 0 in others.
        - For an angle with a turn: the angle measured from `zero`, modulo the turn.
        - For other numbers: the values of the factor.
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

        A column of an angle measures it from `zero`, such as 180 degrees, so that the
        bounds of an arc through 0 degrees are ordered there. The bounds of the result
        are measured from 0 degrees. For an arc through 0 the lower one is larger than
        the upper one, which `RuleCondition.holds` allows.
        """
        turn = self.full_condition.turn
        if not turn:
            return condition
        # An infinite bound becomes 0 or `turn`. Both bounds are then measured from 0.
        low = max(condition.low, 0.0) + self.zero
        high = min(condition.high, turn) + self.zero
        start = low % turn
        end = high % turn
        if end == 0.0:  # the arc ends at the full turn, which modulo makes 0
            end = turn
        return replace(condition, low=start, high=end)


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
    factors = list(table.attrs["units"])
    for tree, columns in grow_trees(table, min_rows, seed):
        for condition_of_column in walk_tree(tree, columns):
            # several, if the path has conditions on several columns of an angle
            for conditions in _list_rules_of_node(condition_of_column, factors):
                if conditions not in yielded_conditions:
                    yielded_conditions.add(conditions)
                    yield conditions


def _list_rules_of_node(
    condition_of_column: Mapping[TreeColumn, RuleCondition], factors: Iterable[str]
) -> Iterator[RuleConditions]:
    """Yield the conditions that lead to a node, with at most one for each factor.

    A path may have conditions on several columns of the same angle, but a rule can only
    have one of them. So a rule is yielded for each combination that takes one condition
    of every factor. Bounds are adjusted later.

    Args:
        condition_of_column: conditions on the path to the node, by column of the tree's
            data.
        factors: names of all factors; they determine the order of the conditions.
    """
    conditions_of_factor: dict[str, list[RuleCondition]] = {
        name: [] for name in factors
    }
    for column, condition in condition_of_column.items():
        # the same condition by the factor itself, e.g. with angles from 0 degrees
        factor_condition = column.to_factor(condition)
        conditions_of_factor[condition.factor].append(factor_condition)
    # factors without a condition are left out
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
        columns += _list_columns_of_factor(factor, unit, table[factor])
    return columns


def _list_columns_of_factor(
    factor: str, unit: str, values: pd.Series
) -> list[TreeColumn]:
    """Return the columns of data of one factor.

    Args:
        factor: its name.
        unit: its unit.
        values: its values.
    """
    full_condition = RuleCondition(factor, unit)  # without bounds: all rows fulfil it
    if values.dtype == "category":
        names = values.cat.categories.tolist()
        full_condition = replace(full_condition, options=frozenset(names))
        return [TreeColumn(full_condition, name) for name in names]
    columns = [TreeColumn(full_condition)]
    if unit == "degrees" and np.ptp(values.to_numpy()) >= MIN_ANGLE_RANGE:
        for turn, zero in ARCS:  # modulo `turn` degrees, measured from `zero`
            condition = replace(full_condition, turn=turn)
            columns.append(TreeColumn(condition, zero=zero))
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
    limits = {"max_depth": MAX_CONDITIONS, "min_samples_leaf": min_rows}
    random_state = seed % 2**32  # scikit-learn takes 32 bits
    single_tree = make_tree(**limits, random_state=random_state).fit(data, is_right)
    # each split of the forest may use a random 60 % of the columns
    forest = make_forest(
        N_TREES, **limits, max_features=0.6, random_state=random_state
    ).fit(data, is_right)
    trees = [(single_tree.tree_, columns)]
    trees += [(estimator.tree_, columns) for estimator in forest.estimators_]
    for index, column in enumerate(columns):
        # only a column that is measured from another zero has a `turn`
        if column.full_condition.turn > 0.0:
            # A tree of all columns would first split another column of the same angle.
            tree = make_tree(**limits).fit(data[:, [index]], is_right).tree_
            trees.append((tree, [column]))
    return trees


def walk_tree(
    tree: Any, columns: list[TreeColumn]
) -> Iterator[dict[TreeColumn, RuleCondition]]:
    """Yield the conditions on the path to each node of a tree, by column.

    A node splits the rows by a threshold of one column. A condition on numbers has
    bounds, and each split tightens one of them. A factor of names has a column for each
    name, but one condition, with the set of remaining names; each split removes names
    from it. So the columns of such a factor share a key: the column without its `name`.

    Args:
        tree: `tree_` of scikit-learn, which has arrays with the split of each node.
        columns: columns of its data, by index.
    """
    open_nodes: list[tuple[int, dict[TreeColumn, RuleCondition]]] = [(0, {})]
    while open_nodes:
        node, conditions = open_nodes.pop()
        yield conditions
        open_nodes += _list_child_nodes(tree, columns, node, conditions)


def _list_child_nodes(
    tree: Any,
    columns: list[TreeColumn],
    node: int,
    conditions: dict[TreeColumn, RuleCondition],
) -> list[tuple[int, dict[TreeColumn, RuleCondition]]]:
    """Return the two nodes below a node with their conditions; none below a leaf.

    Args:
        tree: `tree_` of scikit-learn.
        columns: columns of its data, by index.
        node: index of the node.
        conditions: conditions on the path to the node.
    """
    left = int(tree.children_left[node])
    right = int(tree.children_right[node])
    is_leaf = left == right  # both are -1
    if is_leaf:
        return []
    column = columns[tree.feature[node]]
    key = column._replace(name=None)  # shared by all names of the factor
    condition = conditions.get(key, column.full_condition)
    threshold = float(f"{tree.threshold[node]:.3g}")  # as it is reported
    below, above = _split_condition(condition, column.name, threshold)
    return [(left, {**conditions, key: below}), (right, {**conditions, key: above})]


def _split_condition(
    condition: RuleCondition, name: str | None, threshold: float
) -> tuple[RuleCondition, RuleCondition]:
    """Return the conditions of the rows below and above a threshold.

    Args:
        condition: the condition of all rows.
        name: the name whose column is split; None for a column of numbers.
        threshold: the threshold of the column.
    """
    # Numbers have neither a name nor options, and factors of names have both.
    if name is None or condition.options is None:
        below = replace(condition, high=min(condition.high, threshold))
        above = replace(condition, low=max(condition.low, threshold))
    else:
        # Rows with the name have a 1 in the column and are above the threshold.
        below = replace(condition, options=condition.options - {name})
        above = replace(condition, options=condition.options & {name})
    return below, above


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
