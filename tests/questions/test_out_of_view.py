"""Pictures with nothing of the object in them: no share of right predictions counts them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import advsearch
import small_models
from advsearch.errors import InputError
from advsearch.questions.report.evidence import count_conditions
from advsearch.questions.sweep.display import find_detection_distance
from advsearch.runs.summary import read_result
from advsearch.statistics.intervals import clopper_pearson
from advsearch.testing import assert_no_worse, assert_suite
from advsearch.trust.code import allow_code
from advsearch.viewer.columns import read_columns

pytestmark = [
    pytest.mark.usefixtures("two_threads"),
    pytest.mark.medium,
    pytest.mark.island("advsearch.questions.report", "advsearch.questions.test"),
]


def test_they_are_told_and_not_counted(tmp_path: Path) -> None:
    """Shifted far to the side, the mug is out of view, which a detector cannot get wrong."""
    found = advsearch.sweep(
        "mug", small_models.finds_cars(), {"pose.y": [0.0, 60.0], "camera.distance": [0.3, 0.5]}, task="detection",
        label="car", spp=1, denoise="none", trials=0, run=tmp_path / "run", keep_pictures="none", surface=True,
        must_not_change="exposure",
    ).summary  # fmt: skip
    assert (found.planned, found.configurations, found.out_of_view, found.looked_at) == (4, 2, 2, 4)
    assert [one.configurations for one in found.changes or ()] == [2]
    with np.load(tmp_path / "run" / "artifacts" / "surface.npz") as counts:
        assert counts["pictures_0"].tolist() == [2] and counts["failures_0"].tolist() == [2 - found.correct]
    assert found.interval == pytest.approx(clopper_pearson(found.correct, 2))
    assert {one.value: one.total for one in count_conditions(found)} == {"0.3": 1, "0.5": 1, "0": 2}
    seen = find_detection_distance(found)
    assert seen is not None and len(seen.right_fractions) == 2
    rows = read_columns(tmp_path / "run")
    hidden = rows["label"] == "out of view"
    assert hidden.sum() == 2 and rows["correct"][hidden].eq(1).all()  # a row says what the task said
    assert read_result(tmp_path / "run") == found


DETECTED: dict[str, Any] = {"task": "detection", "label": "car", "verify_spp": 1, "denoise": "none"}
BESIDE = {"pose": {"y": [40.0, 60.0]}}  # never in the picture


def test_claims_count_pictures_that_show_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that is "right" where there is nothing to see would be shown to be no worse, and to be steady."""
    monkeypatch.chdir(tmp_path)
    some: dict[str, Any] = {"pictures": 32, "confidence": 0.6, "controls": BESIDE, **DETECTED}
    hidden = r"undecided: no picture.*; the object is not to be seen in 32 more"
    with pytest.raises(AssertionError, match=hidden):
        assert_no_worse("mug", small_models.finds_cars(), small_models.finds_cars(), points=90.0, **some)
    steady = {"claim": "must_not_change", "when": "exposure", "at_least": 0.2, "pictures": 32}
    allow_code("small_models:finds_cars")
    settings = {"object": "mug", "model": "small_models:finds_cars", "controls": BESIDE, **DETECTED}
    Path("suite.yaml").write_text(
        json.dumps({"title": "steady", "settings": settings, "confidence": 0.6, "claims": {"steady": steady}})
    )
    with pytest.raises(AssertionError, match=f"steady: {hidden}"):
        assert_suite("suite.yaml")


def test_a_region_ends_where_the_object_leaves_the_picture(tmp_path: Path) -> None:
    """A detector that is right about the object cannot be wrong where it is not, and the box would take all of that."""
    small: dict[str, Any] = {"samples": 20, "set": {"camera.distance": 0.4}, "exposure": -3.0, **DETECTED}
    model = small_models.finds_cars()
    found = advsearch.region("mug", model, controls={"pose": {"y": [-3.0, 3.0]}}, run=tmp_path / "run", **small)
    assert found.verdict == "right" and found.box is not None and found.n_same == found.samples
    assert -1.0 < found.box[0].low < found.box[0].high < 1.0, found.box
    with pytest.raises(InputError, match="20 of 20"):
        advsearch.region("mug", model, controls=BESIDE, run=tmp_path / "none", **small)
