"""Pictures with nothing of the object in them: no share of right predictions counts them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import small_models

import advsearch
from advsearch.attacks import clopper_pearson
from advsearch.questions.report.evidence import conditions_of
from advsearch.questions.sweep.display import distance_of
from advsearch.questions.sweep.result import Predictions
from advsearch.runs.summary import read_result
from advsearch.tasks import Judgement, Prediction
from advsearch.viewer.columns import UNKNOWN, packed, read_columns

pytestmark = pytest.mark.usefixtures("two_threads")


def test_the_worst_is_a_picture_that_shows_it() -> None:
    found = Predictions(4)
    for number, (label, margin) in enumerate([("car", -3.0), ("out of view", -1.0), ("no car", 2.0)]):
        found.add(number, Judgement.of(margin, -margin, Prediction(label)))
    assert found.hidden.tolist() == [False, True, False, False] and found.worst == 2
    found = Predictions(2)
    for number, (label, margin) in enumerate([("car", -3.0), ("out of view", -1.0)]):
        found.add(number, Judgement.of(margin, -margin, Prediction(label)))
    assert found.worst == 0


def test_they_are_told_and_not_counted(tmp_path: Path) -> None:
    """Shifted far to the side, the mug is out of view, which a detector cannot get wrong."""
    found = advsearch.sweep(
        "mug", small_models.finds_cars(), {"pose.y": [0.0, 60.0], "camera.distance": [0.3, 0.5]}, task="detection",
        label="car", spp=1, denoise="none", trials=0, run=tmp_path / "run", keep_pictures="none",
    ).summary  # fmt: skip
    assert (found.planned, found.configurations, found.out_of_view, found.looked_at) == (4, 2, 2, 4)
    assert found.interval == pytest.approx(clopper_pearson(found.correct, 2))
    assert any("In 2 of 4 pictures nothing of the object is to be seen" in one for one in found.warnings)
    assert {one.value: one.total for one in conditions_of(found)} == {"0.3": 1, "0.5": 1, "0": 2}
    seen = distance_of(found)
    assert seen is not None and len(seen.shares) == 2
    rows = read_columns(tmp_path / "run")
    hidden = rows["label"] == "out of view"
    assert hidden.sum() == 2 and rows["correct"][hidden].eq(1).all()  # a row says what the task said
    data = packed(rows)
    size = int.from_bytes(data[:4], "little")
    (right,) = (one for one in json.loads(data[4 : 4 + size])["columns"] if one["name"] == "right")
    begin = 4 + size + right["at"]
    assert [one == UNKNOWN for one in data[begin : begin + 4]] == hidden.tolist()
    assert read_result(tmp_path / "run") == found


def test_pairs_of_a_comparison_are_of_pictures_that_show_it(tmp_path: Path) -> None:
    for name in ("one", "other"):
        advsearch.sweep(
            "mug", small_models.finds_cars(), {"pose.y": [0.0, 60.0]}, task="detection", label="car", spp=1,
            denoise="none", trials=0, run=tmp_path / name, keep_pictures="none", environment="studio",
        )  # fmt: skip
    paired = advsearch.compare(f"{tmp_path / 'one'},{tmp_path / 'other'}", pictures=0, run=tmp_path / "both")
    assert [side.configurations for side in paired.sides] == [1, 1]
