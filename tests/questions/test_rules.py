"""Rules, importance and envelopes of rows whose law is known."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import fisher_exact

from advsearch.questions.explain.clusters import find_clusters
from advsearch.questions.explain.envelope import find_envelope, list_factor_peels
from advsearch.questions.explain.importance import find_importance
from advsearch.rules import CountedRule, RuleCondition, estimate_interval, find_covered, find_rules, split_in_halves
from stored_sweeps import seen

pytestmark = pytest.mark.island("advsearch.questions.explain")

NOISE = 0.05
"""Share of the answers that are turned round."""


def planted(law: str, seed: int = 0, rows: int = 2000) -> pd.DataFrame:
    """Rows of a model that is wrong by a law, and now and then without one."""
    generator = np.random.default_rng(seed)
    numbers = generator.uniform((5.0, 0.0, 0.0, 1.0, 0.0), (85.0, 2.0, 360.0, 4.0, 3.0), (rows, 5))
    elevation, power, yaw, distance, colour = numbers.T
    wrong = {
        "dim from above": (elevation > 60.0) & (power < 0.8),
        "red": colour >= 2.0,
        "either but not both": (yaw > 180.0) != (distance > 2.5),
        "none": np.zeros(rows, dtype=bool),
    }[law]
    names = np.array(["blue", "green", "red"])[colour.astype(int)]
    values = {"camera.elevation": elevation, "light.power": power, "pose.yaw": yaw, "camera.distance": distance}
    return seen({**values, "colour": names}, ~(wrong ^ (generator.random(rows) < NOISE)))


def told(rules: list[CountedRule]) -> list[str]:
    return [" and ".join(one.row.text for one in rule.conditions) for rule in rules]


def counts(rule: CountedRule) -> tuple[int, int, int, int]:
    """Right answers and rows under it, and elsewhere."""
    inside, elsewhere = rule.inside["correct"], rule.elsewhere["correct"]
    return int(inside.sum()), len(inside), int(elsewhere.sum()), len(elsewhere)


@pytest.mark.medium
def test_a_planted_rule_is_told() -> None:
    (rule,) = find_rules(*split_in_halves(planted("dim from above"), 0), seed=0).accepted
    elevation, power = rule.conditions
    assert (elevation.factor, power.factor) == ("camera.elevation", "light.power")
    assert elevation.low == pytest.approx(60.0, abs=2.0) and elevation.high == np.inf
    assert power.high == pytest.approx(0.8, abs=0.05) and power.low == -np.inf
    right, rows, right_elsewhere, others = counts(rule)
    assert right < 0.2 * rows and right_elsewhere > 0.9 * others and rows + others == 1000


def test_a_rule_names_options() -> None:
    assert told(find_rules(*split_in_halves(planted("red"), 0), seed=0).accepted) == ["colour red"]


@pytest.mark.medium
def test_two_parameters_that_matter_only_together_are_told_as_two_rules() -> None:
    first, second = find_rules(*split_in_halves(planted("either but not both"), 1), seed=0).accepted
    assert (
        {one.factor for one in first.conditions}
        == {one.factor for one in second.conditions}
        == {"pose.yaw", "camera.distance"}
    )
    under_first, under_second = (find_covered(rule.conditions, planted("red")) for rule in (first, second))
    assert (under_first & under_second).mean() <= 0.03


@pytest.mark.parametrize("seed", range(3))
def test_no_rule_is_told_where_there_is_none(seed: int) -> None:
    assert find_rules(*split_in_halves(planted("none", seed), seed), seed=seed).accepted == []


def around(law: str, seed: int, rows: int = 2000) -> pd.DataFrame:
    """Rows of a model that is wrong in some directions, some of them from afar."""
    generator = np.random.default_rng(seed)
    azimuth, distance = generator.uniform((0.0, 5.0), (360.0, 60.0), (rows, 2)).T
    aside = np.abs((azimuth + 90.0) % 180.0 - 90.0)
    wrong = {
        "in front": (azimuth > 335.0) | (azimuth < 25.0),
        "end-on": aside < 20.0,
        "end-on and far": (aside < 30.0) & (distance > 30.0),
        "none": np.zeros(rows, dtype=bool),
    }[law]
    values = {"camera.azimuth": azimuth, "camera.distance": distance}
    return seen(values, ~(wrong ^ (generator.random(rows) < NOISE)), of={"camera.azimuth": "degrees"})


@pytest.mark.medium
@pytest.mark.parametrize("seed", range(2))
def test_an_angle_that_goes_round_has_rules_through_0_and_of_both_ends(seed: int) -> None:
    front, end_on, far = (
        find_rules(*split_in_halves(around(law, seed), seed), seed=seed).accepted[0].conditions
        for law in ("in front", "end-on", "end-on and far")
    )
    for (found, *_), expected in ((front, (360, 335, 25)), (end_on, (180, 160, 20))):
        assert [found.turn, found.low, found.high] == pytest.approx(expected, abs=8)
    assert len(front) == len(end_on) == 1
    assert [one.factor for one in far] == ["camera.azimuth", "camera.distance"] and far[0].turn == 180.0
    assert far[1].low == pytest.approx(30, abs=6)
    assert find_rules(*split_in_halves(around("none", seed), seed), seed=seed).accepted == []


@pytest.mark.medium
def test_few_rows_tell_a_clear_rule_and_say_how_many_a_faint_one_takes() -> None:
    """Right in 28 % end-on and in 71 % from the side, as a detector of cars is."""

    def rows(count: int, seed: int) -> pd.DataFrame:
        generator = np.random.default_rng(seed)
        yaw, distance, place = generator.uniform((0.0, 1.5, 0.0), (90.0, 30.0, 3.0), (count, 3)).T
        names = np.array(["cafe", "canteen", "workshop"])[place.astype(int)]
        right = generator.random(count) < np.where(yaw < 37.5, 0.28, 0.71)
        return seen({"pose.yaw": yaw, "camera.distance": distance, "environment": names}, right)

    found = [find_rules(*split_in_halves(rows(120, seed), seed), seed=seed) for seed in range(8)]
    told = [one.accepted[0] for one in found if one.accepted]
    assert 3 <= len(told) < 8 and all({one.factor for one in rule.conditions} == {"pose.yaw"} for rule in told)
    for one in found:
        if not one.accepted:
            assert one.best_rejected is not None and not one.best_rejected.holds
    needed = [one.best_rejected.find_needed_factor() for one in found if not one.accepted and one.best_rejected]
    assert all(times is None or times > 1.0 for times in needed) and any(needed)
    exact = fisher_exact([[7, 18], [25, 10]], alternative="less").pvalue
    assert ruled(7, 25, 25, 35).p_value == pytest.approx(exact)
    assert ruled(7, 25, 25, 35).holds and not ruled(10, 25, 20, 35).holds
    assert ruled(10, 25, 20, 35).find_needed_factor() == pytest.approx(3.5, abs=0.5)
    assert ruled(20, 25, 20, 35).find_needed_factor() is None, "it is right more often there"


def ruled(right: int, of: int, others: int, rest: int) -> CountedRule:
    """A rule on independent rows, by its counts under it and elsewhere."""
    right_under, right_beside = np.arange(of) < right, np.arange(rest) < others
    table = pd.DataFrame({"correct": np.concatenate([right_under, right_beside]), "unit": np.arange(of + rest)})
    return CountedRule((), table[:of], table[of:])


def test_what_decides_and_what_does_only_together() -> None:
    found = find_importance(planted("either but not both", rows=4000))
    alone = {one.parameters[0]: one for one in found if len(one.parameters) == 1}
    assert len(alone) == 5 and all(one.interval[0] <= 0.005 and one.interval[1] < 0.02 for one in alone.values())
    (pair,) = (one for one in found if len(one.parameters) == 2)
    assert (
        pair.parameters == ["pose.yaw", "camera.distance"]
        and pair.interval[0] > 0.5
        and pair.share == pytest.approx(0.75, abs=0.05)
    )


def test_what_explains_nothing_is_not_shown_to() -> None:
    found = find_importance(planted("none"))
    assert len(found) == 5 and all(one.interval[0] < 0.003 and one.interval[1] < 0.03 for one in found)


@pytest.mark.medium
@pytest.mark.parametrize(("accuracy", "rows"), [((0.05, 0.12, 0.22), 120), ((0.1, 0.5, 0.9), 120), ((0.7, 0.72), 600)])
def test_intervals_of_what_decides_hold(accuracy: tuple[float, ...], rows: int) -> None:
    """In 95 of 100 samples the interval has the true share, where steps of the accuracy are steps of the parts."""
    steps, names = np.array(accuracy), np.array(list("abcdef"))
    true = float(steps.var() / (steps.mean() * (1.0 - steps.mean())))
    covered_true, samples = np.zeros(2), 200
    chance = list[tuple[float, float]]()
    for seed in range(samples):
        generator = np.random.default_rng(seed)
        x, which = generator.random(rows), generator.integers(0, len(steps), rows)
        right = generator.random(rows) < steps[which]
        for one in find_importance(seen({"x": x, "which": names[which]}, right)):
            if len(one.parameters) == 1:
                at, place = (0.0, 0) if one.parameters == ["x"] else (true, 1)
                covered_true[place] += one.interval[0] <= at <= one.interval[1]
            if one.parameters == ["x"]:
                chance.append((one.share, (one.parts - 1) / rows))
    assert (covered_true >= 0.93 * samples).all(), covered_true / samples
    share, added = np.mean(chance, axis=0)
    assert share < 0.5 * added, "what decides nothing has what chance adds, less that: under 0 it counts as 0"


def test_the_envelope_leaves_out_what_fails_and_little_else() -> None:
    box = find_envelope(*split_in_halves(planted("red"), 0), accuracy=0.9)
    assert box is not None and box.confirmed and box.interval[0] >= 0.9
    assert [one.text for one in box.conditions] == ["colour blue or green"]
    whole = find_envelope(*split_in_halves(planted("none"), 0), accuracy=0.9)
    assert whole is not None and whole.confirmed and whole.conditions == []
    assert find_envelope(*split_in_halves(planted("red"), 0), accuracy=0.99) is None


def of_drives(seed: int, drives: int = 40, frames: int = 10, twice: bool = False) -> pd.DataFrame:
    """Frames of drives that are right in shares of their own, whatever the parameters; or pictures that two models see
    and answer alike."""
    rng = np.random.default_rng(seed)
    own, right = rng.beta(0.7, 0.3, drives), rng.random((drives, 1)) < 0.7
    yaw, elevation = np.repeat(rng.random((drives, 2)), frames, axis=0).T
    values = {"pose.yaw": yaw, "camera.elevation": elevation}
    if not twice:
        values["path.time"] = np.tile(np.linspace(0.0, 1.0, frames), drives)
    answers = np.repeat(right, frames, axis=1) if twice else rng.random((drives, frames)) < own[:, None]
    return seen(values, answers.ravel(), np.repeat(np.arange(drives), frames))


@pytest.mark.medium
@pytest.mark.parametrize("twice", [False, True])
def test_where_drives_differ_by_themselves_nothing_is_told(twice: bool) -> None:
    """Counted row by row, a rule is told in about a half of these and a parameter decides in nearly all."""
    found = [of_drives(seed, *((120, 2) if twice else (40, 10)), twice=twice) for seed in range(40)]
    rules = [find_rules(*split_in_halves(one, seed), seed=seed).accepted for seed, one in enumerate(found[:10])]
    assert sum(map(bool, rules)) <= 1
    decides = [one.interval[0] > 0.0 for each in found for one in find_importance(each) if len(one.parameters) == 1]
    assert np.mean(decides) < 0.08  # 2.5 % each
    assert all(find_envelope(*split_in_halves(one, 0), accuracy=0.95) is None for one in found[:10])


def test_a_law_over_drives_is_told_and_its_intervals_are_over_drives() -> None:
    given = of_drives(0, drives=160)
    found = given.assign(correct=(given["pose.yaw"] <= 0.6) | (given["path.time"] <= 0.5))
    (rule,) = find_rules(*split_in_halves(found, 0), seed=0).accepted
    assert {one.factor for one in rule.conditions} == {"pose.yaw", "path.time"} and not rule.inside["correct"].any()
    assert estimate_interval(rule.inside)[1] > 2 * 3.7 / len(rule.inside), (
        "an interval of as many rows would end sooner"
    )
    assert find_importance(found)[0].interval[0] > 0.05


@pytest.mark.medium
@pytest.mark.parametrize("kinds", [2, 3])
def test_planted_kinds_are_told_with_the_most_typical_first(kinds: int) -> None:
    generator = np.random.default_rng(kinds)
    centres, sizes = generator.standard_normal((kinds, 40)), [20, 12, 9][:kinds]
    truth = np.repeat(np.arange(kinds), sizes)
    noise = 0.35 * generator.standard_normal((len(truth), 40))
    noise[np.cumsum(sizes) - 1] = 0.0
    found = find_clusters(3.0 * (centres[truth] + noise), 0)
    assert found.are_separated and found.silhouette is not None and found.silhouette > 0.3
    assert [set(truth[list(members)]) for members in found.members] == [{k} for k in range(kinds)]
    assert [members[0] for members in found.members] == list(np.cumsum(sizes) - 1)


def test_peels_take_a_twentieth_at_each_end() -> None:
    values = np.linspace(0.0, 100.0, 101)
    lower, upper = list_factor_peels(RuleCondition("camera.azimuth", "degrees"), pd.Series(values))
    assert (lower.low, upper.high) == (5.0, 95.0)
