"""Rules, importance and envelopes of rows whose law is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import fisher_exact

from advsearch import explanations
from advsearch.errors import InputError
from advsearch.explanations import CountedRule, Factor, Observations, RuleCondition, covered, find_rules, observed
from advsearch.questions.explain.findings import find_clusters, find_envelope, find_importance

FACTORS = (
    Factor("camera.elevation", "degrees"),
    Factor("light.power", "1"),
    Factor("pose.yaw", "degrees"),
    Factor("camera.distance", "object sizes"),
    Factor("colour", "", ("blue", "green", "red")),
)
NOISE = 0.05
"""Share of the answers that are turned round."""


def planted(law: str, seed: int = 0, rows: int = 2000) -> Observations:
    """Rows of a model that is wrong by a law, and now and then without one."""
    generator = np.random.default_rng(seed)
    values = generator.uniform((5.0, 0.0, 0.0, 1.0, 0.0), (85.0, 2.0, 360.0, 4.0, 3.0), (rows, 5))
    values[:, 4] = values[:, 4].astype(int)
    elevation, power, yaw, distance, colour = values.T
    wrong = {
        "dim from above": (elevation > 60.0) & (power < 0.8),
        "red": colour == 2,
        "either but not both": (yaw > 180.0) != (distance > 2.5),
        "none": np.zeros(rows, dtype=bool),
    }[law]
    return Observations(FACTORS, values, ~(wrong ^ (generator.random(rows) < NOISE)))


def told(rules: list[CountedRule]) -> list[str]:
    return [" and ".join(one.text(FACTORS[one.place]) for one in rule.conditions) for rule in rules]


def test_a_planted_rule_is_told() -> None:
    (rule,) = find_rules(*planted("dim from above").halves(0), seed=0).told
    elevation, power = rule.conditions
    assert (elevation.place, power.place) == (0, 1)
    assert elevation.low == pytest.approx(60.0, abs=2.0) and elevation.high == np.inf
    assert power.high == pytest.approx(0.8, abs=0.05) and power.low == -np.inf
    assert rule.right < 0.2 * rule.of and rule.right_elsewhere > 0.9 * rule.of_elsewhere
    assert rule.of + rule.of_elsewhere == 1000


def test_a_rule_names_options() -> None:
    assert told(find_rules(*planted("red").halves(0), seed=0).told) == ["colour red"]


def test_two_parameters_that_matter_only_together_are_told_as_two_rules() -> None:
    first, second = find_rules(*planted("either but not both").halves(1), seed=0).told
    assert {one.place for one in first.conditions} == {one.place for one in second.conditions} == {2, 3}
    assert not (covered(first.conditions, planted("red")) & covered(second.conditions, planted("red"))).mean() > 0.03


@pytest.mark.parametrize("seed", range(3))
def test_no_rule_is_told_where_there_is_none(seed: int) -> None:
    assert find_rules(*planted("none", seed).halves(seed), seed=seed).told == []


def test_answers_that_are_all_the_same_have_no_rule() -> None:
    found = planted("none")
    same = Observations(found.factors, found.values, np.ones(len(found), dtype=bool))
    assert find_rules(*same.halves(0), seed=0).told == [] and find_importance(same) == ()


def test_few_rows_tell_a_clear_rule_and_say_how_many_a_faint_one_takes() -> None:
    """Right in 28 % end-on and in 71 % from the side, as a detector of cars is."""

    def rows(count: int, seed: int) -> Observations:
        generator = np.random.default_rng(seed)
        values = generator.uniform((0.0, 1.5, 0.0), (90.0, 30.0, 3.0), (count, 3))
        values[:, 2] = values[:, 2].astype(int)
        factors = (FACTORS[2], FACTORS[3], Factor("environment", "", ("cafe", "canteen", "workshop")))
        right = generator.random(count) < np.where(values[:, 0] < 37.5, 0.28, 0.71)
        return Observations(factors, values, right)

    found = [find_rules(*rows(120, seed).halves(seed), seed=seed) for seed in range(8)]
    told = [one.told[0] for one in found if one.told]
    assert 3 <= len(told) < 8 and all({one.place for one in rule.conditions} == {0} for rule in told)
    for one in found:
        if not one.told:
            assert one.next is not None and not one.next.holds
    needed = [one.next.times_needed() for one in found if not one.told and one.next]
    assert all(times is None or times > 1.0 for times in needed) and any(needed)
    exact = fisher_exact([[7, 18], [25, 10]], alternative="less").pvalue
    assert ruled(7, 25, 25, 35).chance == pytest.approx(exact)
    assert ruled(7, 25, 25, 35).holds and not ruled(10, 25, 20, 35).holds
    assert ruled(10, 25, 20, 35).times_needed() == pytest.approx(3.5, abs=0.5)
    assert ruled(20, 25, 20, 35).times_needed() is None, "it is right more often there"


def ruled(right: int, of: int, others: int, rest: int) -> CountedRule:
    """A rule on independent rows, by its counts under it and elsewhere."""
    under, beside = (np.arange(n) < k for k, n in ((right, of), (others, rest)))
    sides = ((under, np.arange(of)), (beside, of + np.arange(rest)))
    return CountedRule((), *(Observations((), np.zeros((len(one), 0)), one, units) for one, units in sides))


@pytest.mark.parametrize(
    ("right", "elsewhere", "rows"), [(0.28, 0.71, 80), (0.4, 0.7, 160), (0.5, 0.7, 320), (0.6, 0.7, 1350)]
)
def test_the_rows_that_the_page_names_tell_a_rule(right: float, elsewhere: float, rows: int) -> None:
    """docs/explain.md, "How many rows it takes": under two fifths of the rows."""

    def counted(rows: int) -> CountedRule:
        under = round(0.4 * rows / 2)
        others = rows // 2 - under
        return ruled(round(right * under), under, round(elsewhere * others), others)

    assert counted(rows).holds and not counted(round(0.6 * rows)).holds


def test_what_decides_and_what_does_only_together() -> None:
    found = find_importance(planted("either but not both", rows=4000))
    alone = {one.places: one for one in found if len(one.places) == 1}
    assert len(alone) == 5 and all(one.interval[0] <= 0.005 and one.interval[1] < 0.02 for one in alone.values())
    (pair,) = (one for one in found if len(one.places) == 2)
    assert pair.places == (2, 3) and pair.interval[0] > 0.5 and pair.share == pytest.approx(0.75, abs=0.05)


def test_what_explains_nothing_is_not_shown_to() -> None:
    found = find_importance(planted("none"))
    assert len(found) == 5 and all(one.interval[0] < 0.003 and one.interval[1] < 0.03 for one in found)


@pytest.mark.parametrize(("accuracy", "rows"), [((0.05, 0.12, 0.22), 120), ((0.1, 0.5, 0.9), 120), ((0.7, 0.72), 600)])
def test_intervals_of_what_decides_hold(accuracy: tuple[float, ...], rows: int) -> None:
    """In 95 of 100 samples the interval has the true share, where steps of the accuracy are steps of the parts."""
    steps, factors = np.array(accuracy), (Factor("x"), Factor("which", "", tuple("abcdef"[: len(accuracy)])))
    true = float(steps.var() / (steps.mean() * (1.0 - steps.mean())))
    covered_true, samples = np.zeros(2), 200
    chance = list[tuple[float, float]]()
    for seed in range(samples):
        generator = np.random.default_rng(seed)
        values = np.stack([generator.random(rows), generator.integers(0, len(steps), rows)], axis=1)
        right = generator.random(rows) < steps[values[:, 1].astype(int)]
        for one in find_importance(Observations(factors, values, right)):
            if len(one.places) == 1:
                at = 0.0 if one.places == (0,) else true
                covered_true[one.places[0]] += one.interval[0] <= at <= one.interval[1]
            if one.places == (0,):
                chance.append((one.share, (one.parts - 1) / rows))
    assert (covered_true >= 0.93 * samples).all(), covered_true / samples
    share, added = np.mean(chance, axis=0)
    assert share < 0.5 * added, "what decides nothing has what chance adds, less that: under 0 it counts as 0"


def test_the_envelope_leaves_out_what_fails_and_little_else() -> None:
    box = find_envelope(*planted("red").halves(0), accuracy=0.9)
    assert box is not None and box.held and box.at_least >= 0.9
    assert [one.text(FACTORS[one.place]) for one in box.conditions] == ["colour blue or green"]
    whole = find_envelope(*planted("none").halves(0), accuracy=0.9)
    assert whole is not None and whole.held and whole.conditions == ()
    assert find_envelope(*planted("red").halves(0), accuracy=0.99) is None


def test_rows_are_a_table_of_what_varies() -> None:
    rows: list[tuple[dict[str, tuple[float | str, str]], bool]] = [
        ({"x": (1.0, "m"), "same": (3.0, ""), "which": ("b", ""), "own": (1.0, "")}, True),
        ({"x": (2, "m"), "same": (3.0, ""), "which": ("a", "")}, False),
    ]
    found = observed(rows)
    assert found.factors == (Factor("x", "m"), Factor("which", "", ("a", "b")))
    assert found.values.tolist() == [[1.0, 1.0], [2.0, 0.0]] and found.right.tolist() == [True, False]
    with pytest.raises(InputError, match="in which something varies"):
        observed([({"x": (1.0, "")}, True), ({"x": (1.0, "")}, False)])
    with pytest.raises(InputError, match="expected sweeps with rows"):
        observed([])


def of_drives(seed: int, drives: int = 40, frames: int = 10, twice: bool = False) -> Observations:
    """Frames of drives that are right in shares of their own, whatever the parameters; or pictures that two models see
    and answer alike."""
    rng = np.random.default_rng(seed)
    own, right = rng.beta(0.7, 0.3, drives), rng.random((drives, 1)) < 0.7
    values = np.repeat(rng.random((drives, 2)), frames, axis=0)
    times = np.tile(np.linspace(0.0, 1.0, frames), drives)[:, None]
    factors = (Factor("pose.yaw"), Factor("camera.elevation"), *([] if twice else [Factor("path.time")]))
    answers = np.repeat(right, frames, axis=1) if twice else rng.random((drives, frames)) < own[:, None]
    table = values if twice else np.concatenate([values, times], axis=1)
    return Observations(factors, table, answers.ravel(), np.repeat(np.arange(drives), frames))


@pytest.mark.parametrize("twice", [False, True])
def test_where_drives_differ_by_themselves_nothing_is_told(twice: bool) -> None:
    """Counted row by row, a rule is told in about a half of these and a parameter decides in nearly all."""
    found = [of_drives(seed, *((120, 2) if twice else (40, 10)), twice=twice) for seed in range(40)]
    rules = [find_rules(*one.halves(seed), seed=seed).told for seed, one in enumerate(found[:10])]
    assert sum(map(bool, rules)) <= 1
    decides = [one.interval[0] > 0.0 for each in found for one in find_importance(each) if len(one.places) == 1]
    assert np.mean(decides) < 0.08  # 2.5 % each
    assert all(find_envelope(*one.halves(0), accuracy=0.95) is None for one in found[:10])


def test_a_law_over_drives_is_told_and_its_intervals_are_over_drives() -> None:
    given = of_drives(0, drives=160)
    wrong = (given.values[:, 0] > 0.6) & (given.values[:, 2] > 0.5)
    found = Observations(given.factors, given.values, ~wrong, given.units)
    (rule,) = find_rules(*found.halves(0), seed=0).told
    assert {one.place for one in rule.conditions} == {0, 2} and rule.right == 0
    assert rule.inside.interval[1] > 2 * 3.7 / rule.of, "an interval of as many rows would end sooner"
    assert find_importance(found)[0].interval[0] > 0.05


def test_halves_are_of_whole_units_and_rows_that_are_alike_but_for_the_time_are_one() -> None:
    found = of_drives(3, drives=9)
    one, other = found.halves(1)
    assert not set(one.units) & set(other.units) and (one.count, other.count) == (4, 5)
    unsaid = Observations(found.factors, found.values, found.right)
    assert unsaid.count == 9 and not unsaid.independent and unsaid.interval == found.interval


def test_halves_share_no_row() -> None:
    found = planted("none", rows=11)
    one, other = found.halves(3)
    assert len(one) == 5 and len(other) == 6
    assert sorted([*one.values[:, 0], *other.values[:, 0]]) == sorted(found.values[:, 0])


@pytest.mark.parametrize(
    ("condition", "text"),
    [
        (RuleCondition(0, low=60.0), "camera.elevation over 60 degrees"),
        (RuleCondition(1, high=0.5), "light.power at most 0.5"),
        (RuleCondition(0, 10.0, 20.0), "camera.elevation over 10 and at most 20 degrees"),
        (RuleCondition(4, options=frozenset({0, 2})), "colour blue or red"),
    ],
)
def test_conditions_in_words(condition: RuleCondition, text: str) -> None:
    assert condition.text(FACTORS[condition.place]) == text


def test_a_library_that_is_missing_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", absent)
    with pytest.raises(InputError, match=r"needs scikit-learn.*pip install 'advsearch\[explain\]'"):
        explanations.import_library("sklearn.tree")


@pytest.mark.parametrize("kinds", [2, 3])
def test_planted_kinds_are_told_with_the_most_typical_first(kinds: int) -> None:
    generator = np.random.default_rng(kinds)
    centres, sizes = generator.standard_normal((kinds, 40)), [20, 12, 9][:kinds]
    truth = np.repeat(np.arange(kinds), sizes)
    noise = 0.35 * generator.standard_normal((len(truth), 40))
    noise[np.cumsum(sizes) - 1] = 0.0
    found = find_clusters(3.0 * (centres[truth] + noise), 0)
    assert found.apart and found.silhouette is not None and found.silhouette > 0.3
    assert [set(truth[list(members)]) for members in found.members] == [{k} for k in range(kinds)]
    assert [members[0] for members in found.members] == list(np.cumsum(sizes) - 1)


def test_groups_of_a_cloud_are_not_called_apart() -> None:
    told = [
        find_clusters(np.random.default_rng(seed).standard_normal((60, 30)) + 1.0, seed).apart for seed in range(10)
    ]
    assert sum(told) <= 2


def test_few_or_equal_failures_are_one_kind() -> None:
    one = find_clusters(np.ones((1, 5)), 0)
    assert one.members == ((0,),) and one.silhouette is None and not one.apart
    assert [len(members) for members in find_clusters(np.ones((30, 5)), 0).members] == [30]
    assert len(find_clusters(np.random.default_rng(0).standard_normal((7, 4)), 0).members) == 1
