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
    """Return the rows of a sweep as a table: factors, whether the model was right, and
    units.

    Args:
        rows: rows of a sweep (`runs.tables.make_sweep_frame`); a prediction that was
            not judged counts as not right.
        names: names of parameters; those that vary, and that all rows have, become
            factors.

    Returns:
        The table as the module describes it, with `outcome` if rows have it.
    """
    columns = dict[str, pd.Series]()
    units = dict[str, str]()
    for name in names:
        column = rows[name]
        has_names = column.dtype == "category"
        if has_names:
            # in alphabetical order, whatever order the rows came in
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
    """Return how many rows that are not right have each outcome (`Outcome`), by name;
    None if there are none.
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
    """Return a table in which units with a row of the same configuration are one unit.

    Such rows are the same draw, made twice, if independent draws are never the same by
    chance. That is so if some factor is a number with at least half as many values as
    there are rows. Otherwise the table stays: values of a grid, and names, repeat in
    independent draws.
    """
    factors = list(table.attrs["units"])
    is_continuous = any(
        table[name].dtype != "category" and 2 * table[name].nunique() >= len(table)
        for name in factors
    )
    if not is_continuous:
        return table
    # the same number for rows with the same values of all factors
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
    """Return the group (n,) of each row, where rows are in one group if they have the
    same `first` or the same `second` number, or are linked by other rows.

    Both are (n,) with numbers from 0. A group has the lowest `first` number in it.
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
    """Return two random halves of a table, with whole units: rules are chosen on the
    first and tested on the second.

    Args:
        table: the table.
        seed: root seed of the choice.
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
        """Return in which rows (n,) it holds."""
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
        """The arcs of a full turn in which it holds, (start, end) in degrees; none for
        a factor that is no angle.

        With a `turn` of 180 there are two arcs, opposite each other.
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
        """Return how many times as many rows, with the same rates of right ones, would
        show the rule; None if no number of rows up to `MAX_NEEDED` would.
        """
        has_gap = self.gap >= MIN_GAP
        if not has_gap:  # no number of rows makes it larger
            return None
        factor = 1.0
        n_rows = len(self.inside) + len(self.elsewhere)
        while n_rows * factor <= MAX_NEEDED:
            if self._compute_p_value(factor) <= SIGNIFICANCE:
                return factor
            factor *= 1.05
        return None

    def _compute_p_value(self, factor: float) -> float:
        """Return the p-value of the rule if there were `factor` times as many rows with
        the same rates of right ones.
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

    Each rule is chosen on some rows and tested on others; the rows that it covers are
    left out for the next rule. The search ends at the first rule that does not hold.

    Args:
        choosing: rows to choose rules on.
        counting: rows to test rules on.
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
    """Return the conditions with the best score (`ConditionScorer`), without those that
    add little to it, and with adjusted bounds.

    There are none if too few rows are left, or no conditions are better than chance.
    """
    n_wrong = int((~table["correct"].to_numpy()).sum())
    min_rows = find_min_rows(table)
    has_both_answers = 0 < n_wrong < len(table)
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
    """Return conditions without those that add little to their score, left out one at
    a time.
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
        # a loss within its standard error may be chance
        standard_error = math.sqrt(n_added * variance) / len(table)
        loss = score - scorer.score(shorter)
        if loss > max((1.0 - RETAINED_ACCURACY) * score, standard_error):
            break
        conditions = shorter
    return conditions


def adjust_bounds(
    conditions: RuleConditions, scorer: ConditionScorer
) -> RuleConditions:
    """Return conditions with bounds at which their score is larger: one bound is
    adjusted after the other, and all of them several times.
    """
    for _ in range(N_ADJUSTMENTS):
        for index in range(len(conditions)):
            adjusted = [
                (*conditions[:index], condition, *conditions[index + 1 :])
                for condition in list_adjusted(conditions[index], scorer.table)
            ]
            # the present ones first: `max` returns the first of equally good ones
            conditions = max([conditions, *adjusted], key=scorer.score)
    return conditions


def list_adjusted(
    condition: RuleCondition, table: pd.DataFrame
) -> Iterator[RuleCondition]:
    """Yield a condition with one of its bounds at other quantiles of the factor; none
    for a condition on names.

    A tree chooses a bound together with those that it has chosen before; once these are
    adjusted, another bound may be better.
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
        """Return a condition on the column as one on the factor: bounds of an angle are
        measured from 0 again, and not from `zero`.
        """
        turn = self.full_condition.turn
        if not turn:
            return condition
        low = max(condition.low, 0.0) + self.zero
        high = min(condition.high, turn) + self.zero
        end = high % turn
        if end == 0.0:  # of an arc that ends with the full turn
            end = turn
        return replace(condition, low=low % turn, high=end)


def find_candidates(
    table: pd.DataFrame, min_rows: int, seed: int
) -> Iterator[RuleConditions]:
    """Yield the conditions that lead to the nodes of trees, each once."""
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
    """Yield the conditions that lead to a node, with one for each factor at most.

    A node may have conditions on several columns of one angle. A rule takes one of
    them, so each is tried; its bounds are adjusted later.

    Args:
        node: the conditions that lead to it, by column.
        factors: names of all factors, in the order that conditions have.
    """
    conditions_of_factor: dict[str, list[RuleCondition]] = {
        name: [] for name in factors
    }
    for column, condition in node.items():
        conditions_of_factor[condition.factor].append(column.to_factor(condition))
    yield from product(*filter(None, conditions_of_factor.values()))


def list_columns(table: pd.DataFrame) -> list[TreeColumn]:
    """Return the columns of data for trees: one for each factor of numbers, and one for
    each name of a factor of names.

    An angle that goes all the way round has further columns, each measured from another
    zero (`ARCS`).
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
    """Return trees of scikit-learn that predict whether the model is right, each with
    the columns of its data.

    They are one tree of all columns, those of a random forest, and one for each column
    of an angle with a `turn`, of that column alone.
    """
    make_tree = import_library("sklearn.tree").DecisionTreeClassifier
    make_forest = import_library("sklearn.ensemble").RandomForestClassifier
    columns = list_columns(table)
    data = np.stack([column.read_values(table) for column in columns], axis=1)
    is_right = table["correct"].to_numpy()
    shape = {"max_depth": MAX_CONDITIONS, "min_samples_leaf": min_rows}
    random_state = seed % 2**32
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
    """Yield the conditions that lead to each node of a tree, by column.

    The columns of the names of one factor share a condition, so that it stands under
    the column without its name.

    Args:
        tree: `tree_` of scikit-learn.
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
