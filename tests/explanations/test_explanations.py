"""Rules, importance and envelopes of rows whose law is known."""

from __future__ import annotations

import numpy as np
import pytest

from advsearch.errors import InputError
from advsearch.explanations import libraries
from advsearch.explanations.envelope import find_envelope
from advsearch.explanations.importance import find_importance
from advsearch.explanations.observations import Factor, Observations, observed
from advsearch.explanations.rules import CountedRule, RuleCondition, covered, find_rules

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
    (rule,) = find_rules(*planted("dim from above").halves(0), seed=0)
    elevation, power = rule.conditions
    assert (elevation.place, power.place) == (0, 1)
    assert elevation.low == pytest.approx(60.0, abs=2.0) and elevation.high == np.inf
    assert power.high == pytest.approx(0.8, abs=0.05) and power.low == -np.inf
    assert rule.right < 0.2 * rule.of and rule.right_elsewhere > 0.9 * rule.of_elsewhere
    assert rule.of + rule.of_elsewhere == 1000


def test_a_rule_names_options() -> None:
    assert told(find_rules(*planted("red").halves(0), seed=0)) == ["colour red"]


def test_two_parameters_that_matter_only_together_are_told_as_two_rules() -> None:
    first, second = find_rules(*planted("either but not both").halves(1), seed=0)
    assert {one.place for one in first.conditions} == {one.place for one in second.conditions} == {2, 3}
    assert not (covered(first.conditions, planted("red")) & covered(second.conditions, planted("red"))).mean() > 0.03


@pytest.mark.parametrize("seed", range(3))
def test_no_rule_is_told_where_there_is_none(seed: int) -> None:
    assert find_rules(*planted("none", seed).halves(seed), seed=seed) == []


def test_answers_that_are_all_the_same_have_no_rule() -> None:
    found = planted("none")
    same = Observations(found.factors, found.values, np.ones(len(found), dtype=bool))
    assert find_rules(*same.halves(0), seed=0) == [] and find_importance(*same.halves(0), seed=0) is None


def test_what_decides_and_what_does_only_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.explanations.importance.BASE_POINTS", 128)
    found = find_importance(*planted("either but not both", rows=4000).halves(0), seed=0)
    assert found is not None and found.explained > 0.5
    totals = {one.places: one.total for one in found.weights if len(one.places) == 1}
    assert min(totals[2,], totals[3,]) > 0.5 > 0.1 > max(totals[0,], totals[1,], totals[4,])
    pair = next(one for one in found.weights if len(one.places) == 2)
    assert pair.places == (2, 3) and pair.share > 0.5


def test_what_explains_nothing_has_no_importance() -> None:
    found = find_importance(*planted("none").halves(0), seed=0)
    assert found is not None and found.explained < 0.02 and found.weights == ()


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
        libraries.library("sklearn.tree")
