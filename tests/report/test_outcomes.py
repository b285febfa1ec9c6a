"""What becomes of an object in a detector's boxes, as headlines, tables and counts tell it."""

from typing import Any

import numpy as np

from advsearch.options import OUT_OF_VIEW, Outcome
from advsearch.questions.sweep.result import OUTCOMES, Predictions, TableAxis
from advsearch.tasks import Judgement, Prediction


def judged(right: bool, label: str, outcome: Outcome | None) -> Judgement:
    payload: Any = {"box": None, "found": []} | ({} if outcome is None else {"outcome": outcome.value})
    margin = 1.0 if right else -1.0
    return Judgement(-margin, margin, right, Prediction(label), payload)


def test_rows_of_a_sweep_are_counted_by_outcome() -> None:
    predictions = Predictions(6)
    predictions.add(0, judged(True, "cup", Outcome.FOUND))
    predictions.add(1, judged(False, "no cup", Outcome.MISSED))
    predictions.add(2, judged(False, "cup in a loose box", Outcome.LOOSE))
    predictions.add(3, judged(False, "cup in a loose box", Outcome.LOOSE))
    predictions.add(4, judged(True, OUT_OF_VIEW, Outcome.PHANTOM))
    predictions.add(5, judged(True, OUT_OF_VIEW, None))
    assert predictions.n_phantoms_out_of_view == 1 and predictions.is_out_of_view.sum() == 2
    numbers = np.flatnonzero(predictions.is_counted)
    axis = TableAxis("camera.distance", "metres", [5.0, 9.0], np.array([0, 0, 1, 1]))
    near, far = axis.make_rows(predictions.is_right[numbers], numbers, predictions.outcome[numbers])
    assert near.outcomes == {"missed": 1} and far.outcomes == {"loose": 2}
    assert OUTCOMES[predictions.outcome[0]] is Outcome.FOUND
