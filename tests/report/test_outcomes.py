"""What becomes of an object in a detector's boxes, as headlines, tables and counts tell it."""

from __future__ import annotations

import re
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

from advsearch.options import OUT_OF_VIEW, Outcome
from advsearch.questions.attack.outcome import name_objective
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.wording import attack_verdict, make_remarks
from advsearch.questions.explain.result import ExplainResult
from advsearch.questions.harden.result import HardenResult
from advsearch.questions.sweep.page import verdict_text
from advsearch.questions.sweep.result import OUTCOMES, Predictions, TableAxis
from advsearch.questions.test.result import FAILED, describe_fraction, describe_trials, evaluate_search
from advsearch.report.views import get_view
from advsearch.report.wording import format_goal
from advsearch.rules import count_wrong_outcomes
from advsearch.runs.store import Row
from advsearch.runs.tables import make_sweep_frame
from advsearch.statistics.intervals import clopper_pearson
from advsearch.tasks import Judgement, Prediction
from advsearch.tasks.depth import Depth
from advsearch.tasks.detection import Detection
from samples import EXPLAIN, HARDEN, SHARE, attack, rated, sweep

COUNTS = {"missed": 2, "loose": 3}
SAID = "2 missed, 3 in a loose box"


def judged(right: bool, label: str, outcome: Outcome | None) -> Judgement:
    payload: Any = {"box": None, "found": []} | ({} if outcome is None else {"outcome": outcome.value})
    margin = 1.0 if right else -1.0
    return Judgement(-margin, margin, right, Prediction(label), payload)


def test_a_goal_in_the_task_is_named_as_one_in_the_objective_is() -> None:
    """`detection={seek: create}` looks for what the objective `create` looks for, and not for a miss."""
    created = name_objective(Detection(seek="create"), "score")
    assert created == "create" == name_objective(Detection(), "create")
    assert format_goal(created, "this mug") == "makes the model see beside this mug what is not there"
    assert name_objective(Detection(), None) == "score" == name_objective(Depth(), "score")
    assert name_objective(Depth(seek="nearer"), None) == "nearer"


def test_an_attack_says_that_a_loose_box_is_no_miss() -> None:
    loose = attack(
        object="person",
        task="detection",
        verified=rated(labels={"person in a loose box": 20}, outcomes={"loose": 20}),
    )
    said = attack_verdict(loose)
    assert said.startswith("The model sees this person, but in a loose box in 20 of 20 fresh renders")
    assert "where there is none" not in said
    labels = {"person in a loose box": 15, "no person": 5}
    verified = rated(labels=labels, outcomes={"missed": 5, "loose": 15})
    said = attack_verdict(attack(object="person", task="detection", verified=verified))
    assert said.startswith("The model is wrong about this person (5 missed, 15 in a loose box) in 20 of 20 fresh")


def test_a_clean_scene_that_fails_says_how() -> None:
    control = {"correct": 3, "trials": 8, "rate": 0.375, "interval": [0.1, 0.8], "outcomes": COUNTS}
    summary = attack(task="detection", clean={**cast(Any, attack().to_dict()["clean"]), "control": control})
    assert f"The clean scene itself fails 5 of its 8 trials ({SAID})." in make_remarks(summary)


def test_a_sweep_says_how_the_others_fail() -> None:
    summary = sweep(task="detection", configurations=12, correct=7, accuracy=7 / 12, outcomes=COUNTS)
    assert f"of the others, {SAID}." in verdict_text(summary)
    assert f"of the others, {SAID}." in get_view(summary).statement
    assert "of the others" not in verdict_text(sweep(task="detection"))


def test_rows_of_a_sweep_are_counted_by_outcome() -> None:
    predictions = Predictions(6)
    predictions.add(0, judged(True, "cup", Outcome.FOUND))
    predictions.add(1, judged(False, "no cup", Outcome.MISSED))
    predictions.add(2, judged(False, "cup in a loose box", Outcome.LOOSE))
    predictions.add(3, judged(False, "cup in a loose box", Outcome.LOOSE))
    predictions.add(4, judged(True, OUT_OF_VIEW, Outcome.PHANTOM))
    predictions.add(5, judged(True, OUT_OF_VIEW, None))
    assert predictions.n_phantoms_out_of_view == 1 and predictions.is_hidden.sum() == 2
    numbers = np.flatnonzero(predictions.is_counted)
    axis = TableAxis("camera.distance", "metres", [5.0, 9.0], np.array([0, 0, 1, 1]))
    near, far = axis.make_rows(predictions.is_right[numbers], numbers, predictions.outcome[numbers])
    assert near.outcomes == {"missed": 1} and far.outcomes == {"loose": 2}
    assert OUTCOMES[predictions.outcome[0]] is Outcome.FOUND


def test_a_frame_of_rows_has_the_outcome() -> None:
    kinds = [(True, Outcome.FOUND), (False, Outcome.LOOSE), (False, Outcome.MISSED), (False, Outcome.LOOSE)]
    rows = [
        Row("sweep", number, correct=right, margin=0.0, label="x", payload={"outcome": outcome.value})
        for number, (right, outcome) in enumerate(kinds)
    ]
    frame = make_sweep_frame(rows)
    assert list(frame["outcome"]) == ["found", "loose", "missed", "loose"]
    assert count_wrong_outcomes(frame) == {"loose": 2, "missed": 1}
    assert count_wrong_outcomes(pd.DataFrame({"correct": [0, 1]})) is None
    plain = make_sweep_frame([Row("sweep", 0, correct=False, margin=0.0, label="vase")])
    assert count_wrong_outcomes(plain) is None


def test_claims_say_how_a_detector_fails() -> None:
    found = attack(task="detection", ending="found", verified=rated(labels={"no cup": 20}, outcomes={"missed": 20}))
    verdict, reason, _ = evaluate_search(found, AttackConfig(object="mug"))
    assert verdict == FAILED and reason.endswith(": 20 missed") and "a no cup" not in reason
    interval = clopper_pearson(0, 8)
    reason = describe_trials(FAILED, (0, 8, 0), "no cup", interval, over=False, outcomes="8 missed")
    assert reason.endswith(": 8 missed")
    assert SAID in describe_fraction("right", FAILED, 7, 12, (0.2, 0.8), "most wrong where it says no cup", SAID)


def test_rules_and_hardening_say_it_too() -> None:
    under = {**EXPLAIN["rules"][0], "outcomes": {"missed": 90, "loose": 4}}
    texts = " ".join(part for section in get_view(ExplainResult.of({**EXPLAIN, "rules": [under]})).sections
                     for part in section.text)  # fmt: skip
    assert "of 97 (90 missed, 4 loose)" in texts
    after = {**SHARE, "outcomes": {"loose": 2}}
    said = get_view(HardenResult.of({**HARDEN, "task": "detection", "clean_after": after})).statement
    assert "Now, the other plain pictures are 2 in a loose box." in said


@pytest.mark.parametrize("outcomes", [{"loose": 1, "unknown": 4}, {}])
def test_an_unknown_outcome_of_a_file_is_passed_over(outcomes: dict[str, int]) -> None:
    said = verdict_text(sweep(task="detection", outcomes=outcomes))
    assert bool(re.search("1 in a loose box", said)) is bool(outcomes) and "unknown" not in said
