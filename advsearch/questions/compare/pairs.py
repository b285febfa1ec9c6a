"""Count the pairs of two sides: in all, by parameter, and by rules."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from advsearch.extend import rules, seeds, statistics
from advsearch.questions.compare.result import ComparedPair, CountOf, PairPart, PairRule
from advsearch.questions.compare.sides import Side, has_same_values

# A parameter with more different numbers has no table, unless the sweep defines how
# its range is divided.
MAX_VALUES = 64

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


def compare_sides(
    first: Side, second: Side, seed: int, *, with_rules: bool = True
) -> ComparedPair:
    """Count the pairs of two sides, and test whether they differ.

    A side is a set of predictions, such as those of one model. In the result, `worse`
    has the rules under which only the first side is right (the second is worse), and
    `better` those under which only the second is. Both are None if rules are not
    sought. `discordant_pictures` is empty: the caller fills it.

    Args:
        first, second: sides with the same sampled scenes, in the same order.
        seed: seed that splits the pairs in halves: rules are found in one half and
            counted in the other, so that the counts are not biased.
        with_rules: whether to search for rules.

    Raises:
        InputError: rules are sought and scikit-learn is missing.
    """
    shared_parameters = _find_shared_parameters(first, second)
    # Pairs of one unit, such as the frames of a drive, are not independent.
    unit_of_pair = first.rows["unit"].to_numpy()
    # `count_pairs` has the difference and its interval.
    _, _, p_value = statistics.clustered.compare_paired(
        first.is_right, second.is_right, unit_of_pair
    )
    rule_fields: dict[str, Any] = {"worse": None, "better": None}
    if with_rules:
        rule_fields = _find_rules_of_sides(first, second, shared_parameters, seed)
    parts = list[PairPart]()
    for name in shared_parameters:
        parts += count_by_parameter(first, second, name)
    return ComparedPair(
        first=first.name,
        second=second.name,
        units=_count_shared_units(unit_of_pair),
        unit=first.rows.attrs["unit name"],
        **count_pairs(first.is_right, second.is_right, unit_of_pair),
        p=p_value,
        **rule_fields,
        parts=parts,
        discordant_pictures=[],
    )


def _count_shared_units(unit_of_pair: IntArray) -> int | None:
    """Return the number of units of pairs (n,); None if each pair is a unit by itself."""
    n_units = len(np.unique(unit_of_pair))
    has_single_pairs = n_units == len(unit_of_pair)
    return None if has_single_pairs else n_units


def _find_shared_parameters(first: Side, second: Side) -> list[str]:
    """Return the parameters that both sides sampled, with the same value in each pair."""
    return [
        name
        for name in first.varying_parameters
        if name in second.rows.attrs["units"]
        and has_same_values(first.rows[name], second.rows[name])
    ]


def _find_rules_of_sides(
    first: Side, second: Side, parameters: list[str], seed: int
) -> dict[str, list[PairRule] | None]:
    """Return the fields `worse` and `better` of a pair of sides.

    Args:
        first, second: sides with the same sampled scenes, in the same order.
        parameters: parameters that both sampled.
        seed: seed that splits the pairs in halves.
    """
    table = rules.make_table(first.rows, parameters)
    only_first_right = first.is_right & ~second.is_right
    only_second_right = ~first.is_right & second.is_right
    return {
        "worse": find_pair_rules(table, only_first_right, seed),
        "better": find_pair_rules(table, only_second_right, seed),
    }


def count_by_parameter(first: Side, second: Side, name: str) -> Iterator[PairPart]:
    """Yield the counts of pairs for each value of a parameter, or part of its range.

    Values that no pair has are left out.

    Args:
        first, second: the sides, with rows in the same order.
        name: name of the parameter.
    """
    column = first.rows[name]
    unit_of_measure = ""
    if column.dtype != "category":
        unit_of_measure = first.rows.attrs["units"][name]
    # Pairs of one unit, such as the frames of a drive, are not independent.
    unit_of_pair = first.rows["unit"].to_numpy()
    edges = first.rows.attrs["edges"].get(name)  # of parts of a range; None for values
    for value, mask in split_by_value(column, edges):
        if mask.any():
            counts = count_pairs(
                first.is_right[mask], second.is_right[mask], unit_of_pair[mask]
            )
            yield PairPart(parameter=name, unit=unit_of_measure, value=value, **counts)


def count_pairs(
    first_right: BoolArray, second_right: BoolArray, unit_of_pair: IntArray
) -> dict[str, Any]:
    """Return the fields of `PairCounts`: counts, accuracies, and their difference.

    Args:
        first_right, second_right: whether each side is right (n,).
        unit_of_pair: the unit of each pair (n,), such as the drive that a frame is of;
            pairs of one unit are not independent.
    """
    # The p-value is computed once for all pairs (`compare_sides`) and not for parts.
    difference, interval, _ = statistics.clustered.compare_paired(
        first_right, second_right, unit_of_pair
    )
    first_accuracy = _estimate_accuracy(first_right, unit_of_pair)
    second_accuracy = _estimate_accuracy(second_right, unit_of_pair)
    return {
        "both": int((first_right & second_right).sum()),
        "first_only": int((first_right & ~second_right).sum()),
        "second_only": int((~first_right & second_right).sum()),
        "neither": int((~first_right & ~second_right).sum()),
        "shares": (first_accuracy, second_accuracy),
        "difference": difference,
        "interval": interval,
    }


def _estimate_accuracy(is_right: BoolArray, unit_of_pair: IntArray) -> float:
    """Return the mean over units of the fraction of right pairs in each.

    Args:
        is_right: whether a side is right in each pair (n,).
        unit_of_pair: the unit of each pair (n,).
    """
    n_pairs_of_unit = statistics.clustered.sum_per_unit(
        np.ones(len(unit_of_pair)), unit_of_pair
    )
    n_right_of_unit = statistics.clustered.sum_per_unit(is_right, unit_of_pair)
    return statistics.clustered.mean_rate(n_right_of_unit, n_pairs_of_unit)


def split_by_value(
    column: pd.Series, edges: Sequence[float] | None
) -> Iterator[tuple[Any, BoolArray]]:
    """Yield the values of a parameter, or parts of its range, with masks of their rows.

    Each name is a value. Numbers are divided at the edges, if there are any. Without
    edges each number is a value, or nothing is yielded if there are more than
    `MAX_VALUES` different ones. A mask is (n,).

    Args:
        column: value of the parameter in each row (n,).
        edges: ascending bounds of the parts of the range, as the sweep defines them;
            None if it defines none.
    """
    has_names = column.dtype == "category"
    if has_names:
        for name in column.cat.categories:
            yield name, np.asarray(column == name)
    elif edges is not None:
        yield from _split_at_edges(column, edges)
    elif column.nunique() <= MAX_VALUES:
        for value in np.unique(column):
            # so that 0.1 is not printed as 0.10000000149, its nearest float32
            rounded_value = float(f"{value:.6g}")
            yield rounded_value, np.asarray(column == value)


def _split_at_edges(
    column: pd.Series, edges: Sequence[float]
) -> Iterator[tuple[tuple[float, float], BoolArray]]:
    """Yield the bounds of each part of a range, and the mask (n,) of the rows in it.

    Args:
        column: number in each row (n,).
        edges: ascending bounds of the parts.
    """
    bins = np.searchsorted(edges, column, side="right") - 1
    # Values at the last edge, or beyond one by rounding, are in the part next to it.
    bins = np.clip(bins, 0, len(edges) - 2)
    for index, bounds in enumerate(pairwise(edges)):
        yield bounds, bins == index


def find_pair_rules(
    table: pd.DataFrame, is_only_right: BoolArray, seed: int
) -> list[PairRule] | None:
    """Find rules under which only one side is right more often than elsewhere.

    A rule is a combination of conditions, such as "distance above 3 m and night". The
    result is None if there are too few pairs, or no parameters.

    Args:
        table: table of pairs, as `rules.make_table` makes it.
        is_only_right: whether, in each pair, the one side is right and the other is
            wrong (n,).
        seed: seed that splits the pairs in halves: one finds the rules, the other
            counts them.
    """
    parameters = table.attrs["units"]
    if len(table) < rules.MIN_ROWS or not parameters:
        return None
    # `rules.find_rules` finds where `correct` is rarely true. Here it has to find the
    # pairs that only the one side gets right, so these are not `correct`.
    table = table.assign(correct=~is_only_right)
    choosing, counting = rules.split_in_halves(table, seed)
    found_rules = rules.find_rules(
        choosing, counting, seeds.derive_seed(seed, "compare")
    )
    return [_make_pair_rule(rule) for rule in found_rules.accepted]


def _make_pair_rule(rule: Any) -> PairRule:
    """Return the conditions of a rule that was found, with its counts."""
    # `inside` and `elsewhere` are the pairs that meet the rule, and the others.
    inside = count_exceptions(rule.inside)
    return PairRule(
        conditions=[condition.row for condition in rule.conditions],
        elsewhere=count_exceptions(rule.elsewhere),
        **vars(inside),  # count, total, interval and share
    )


def count_exceptions(pairs: pd.DataFrame) -> CountOf:
    """Count the pairs that are not `correct`, with their fraction and its interval.

    These are the exceptions: pairs that only one side gets right (`find_pair_rules`).
    """
    lower, upper = rules.estimate_interval(pairs)  # of the correct ones
    fraction = None
    if not pairs.empty:
        fraction = 1.0 - rules.estimate_rate(pairs)
    n_exceptions = int((~pairs["correct"]).sum())
    return CountOf(
        count=n_exceptions,
        total=len(pairs),
        interval=(1.0 - upper, 1.0 - lower),
        share=fraction,
    )
