"""The distance at which a detector first sees an object."""

import math

import numpy as np
import pytest

from advsearch.questions.sweep.display import compute_detection_distance, describe_detection_distance
from advsearch.questions.sweep.summary import AxisRow
from advsearch.statistics.intervals import clopper_pearson
from advsearch.statistics.monotone import find_dips

DISTANCES = (5.0, 10.0, 20.0, 40.0, 80.0)


def rows(correct: list[int], of: int = 20, unit: str = "metres") -> list[AxisRow]:
    return [
        AxisRow(axis="camera.distance", unit=unit, value=at, configurations=of, correct=k, accuracy=k / of,
                interval=clopper_pearson(k, of))
        for at, k in zip(DISTANCES, correct, strict=True)
    ]  # fmt: skip


def test_the_distance_lies_where_half_of_the_pictures_show_it() -> None:
    found = compute_detection_distance(rows([20, 20, 15, 5, 0])[::-1])
    assert found.distances == DISTANCES
    assert found.distance == pytest.approx(math.sqrt(20.0 * 40.0))
    assert (found.lower, found.upper) == (10.0, 80.0)
    assert (
        describe_detection_distance(found)
        == "Seen from 28.3 m in half of the pictures, 10 to 80 m with 95 % confidence."
    )


def test_a_share_that_rises_with_the_distance_is_pooled() -> None:
    found = compute_detection_distance(rows([20, 10, 18, 2, 0]))
    pooled = 28 / 40
    part = (pooled - 0.5) / (pooled - 0.1)
    assert found.distance == pytest.approx(20.0 * 2.0**part)


def test_a_range_with_a_dip_has_no_one_distance() -> None:
    found = compute_detection_distance(rows([7, 20, 20, 4, 0]))
    (dip,) = [one for one in found.dips if one.is_significant]
    assert (dip.distance, dip.counts, dip.until, dip.counts_beyond) == (5.0, (7, 20), 20.0, (40, 40))
    assert dip.p_value < 1e-6 and not found.is_monotone
    assert found.distance == pytest.approx(20.0 * 2.0 ** (0.5 / 0.8)), "beyond the dip nothing is pooled with it"
    said = describe_detection_distance(found)
    assert said.startswith("No one distance from which on it is seen: right in 7 of 20 at 5 m, 40 of 40 beyond it")
    assert "Beyond that the share falls below a half at 30.8 m; 20 to 80 m with 95 % confidence." in said


@pytest.mark.parametrize("shares", [(0.5,) * 8, (0.9,) * 8, (0.8,) * 4 + (0.3,) * 4, tuple(np.linspace(0.95, 0.05, 8))])
@pytest.mark.parametrize("of", [8, 40])
def test_a_falling_curve_has_a_shown_dip_in_one_of_twenty_at_most(shares: tuple[float, ...], of: int) -> None:
    rng = np.random.default_rng(7)
    tables, alarms = 300, 0
    for _ in range(tables):
        right = rng.binomial(of, shares)
        alarms += any(dip.is_significant for dip in find_dips(range(1, 9), right, np.full(8, of)))
    assert alarms <= 0.05 * tables


def test_loose_boxes_are_no_misses() -> None:
    loose = {5.0: 12, 20.0: 3}
    listed = [
        row.model_copy(update={"outcomes": {"loose": loose.get(float(row.value), 0), "missed": 2}})  # type: ignore[arg-type]
        for row in rows([8, 20, 15, 5, 0])
    ]
    found = compute_detection_distance(listed)
    assert found.loose_counts == (12, 0, 3, 0, 0)
    said = "Not counted as seen, but not missed either, are loose boxes: 12 of 20 at 5 m, 3 of 20 at 20 m."
    assert describe_detection_distance(found).endswith(said)
    assert "loose" not in describe_detection_distance(compute_detection_distance(rows([8, 20, 15, 5, 0])))


@pytest.mark.parametrize(
    ("correct", "of", "said"),
    [
        ([20] * 5, 20, "Seen in at least half of the pictures up to the farthest distance, 80 m; at least 80 m"),
        ([0] * 5, 20, "Not seen in half of the pictures, even from 5 m; at most 5 m"),
        ([8, 8, 8, 0, 0], 8, "Seen from 28.3 m in half of the pictures, 20 to 40 m with 95 % confidence."),
    ],
)
def test_what_the_pictures_do_not_bound_is_left_open(correct: list[int], of: int, said: str) -> None:
    assert describe_detection_distance(compute_detection_distance(rows(correct, of))).startswith(said)


def test_the_interval_holds_as_often_as_it_says() -> None:
    rng, true = np.random.default_rng(3), 28.0
    held = 0
    for _ in range(200):
        shares = [1.0 / (1.0 + (at / true) ** 4) for at in DISTANCES]
        found = compute_detection_distance(rows([int(rng.binomial(20, share)) for share in shares]))
        held += (found.lower or 0.0) <= true <= (found.upper or math.inf)
    assert held >= 190
