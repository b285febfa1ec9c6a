"""Answers that are NaN or infinite are called that wherever trials are kept, counted and told."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
import samples
from advsearch.attacks import Trials
from advsearch.engine.record import make_control_group, make_rate, make_trial_row, read_judgement
from advsearch.errors import InputError
from advsearch.options import Outcome
from advsearch.questions.attack import wording
from advsearch.questions.attack.summary import AttackSummary
from advsearch.report.wording import format_mistake, format_prediction_cells, format_tally
from advsearch.tasks import Judgement, Prediction

NOTHING = Judgement.of(math.nan, math.nan, Prediction("tench", 0, math.nan))
RIGHT, WRONG = Judgement.of(-1.0, -1.0, Prediction("mug", 1, 0.9)), Judgement.of(3.0, 3.0, Prediction("vase", 2, 0.8))


def test_a_row_has_no_name_and_comes_back_as_what_it_was() -> None:
    row = make_trial_row("verification", 0, 1, 4, NOTHING)
    assert (row.label, row.label_index, row.margin, row.objective, row.probability) == (None,) * 5
    assert row.correct is False and row.success is False
    again = read_judgement(row)
    assert again.is_not_a_number and again.prediction == NOTHING.prediction == Prediction("not a number")
    assert not read_judgement(make_trial_row("verification", 0, 1, 4, RIGHT)).is_not_a_number


def test_trials_without_a_number_are_counted_and_means_are_of_the_others() -> None:
    trials = [NOTHING, WRONG, RIGHT, NOTHING]
    rate = make_rate(Trials(1, 4, 16), trials, [WRONG])
    assert (rate.not_a_number, rate.margin, rate.labels) == (2, -1.0, {"vase": 1})
    control = make_control_group(trials, 16)
    assert (control.correct, control.trials, control.not_a_number) == (1, 4, 2)
    assert math.isnan(make_rate(Trials(0, 2, 16), [NOTHING, NOTHING], []).margin)
    assert "not_a_number" not in make_rate(Trials(1, 2, 16), [WRONG, RIGHT], [WRONG]).to_dict()


def told(successes: int, nothing: int) -> AttackSummary:
    rate = samples.rated(successes, 0.0, 0.2, not_a_number=nothing)
    return samples.attack(ending="budget spent", verified=rate, baseline=None)


def test_the_headline_never_calls_it_right_or_wrong() -> None:
    assert wording.attack_verdict(told(0, 0)).endswith(
        "in 0 of 20 fresh renders (95 % interval 0-20 %). The budget is spent."
    )
    all_of_them = wording.attack_verdict(told(0, 20))
    assert "it is wrong in none of 20 fresh renders: in 20 its output is not a number." in all_of_them
    assert "0 of 20 fresh" not in all_of_them.replace("none of 20", "")
    some = wording.attack_verdict(told(2, 5))
    assert "in 2 of 20 fresh renders (95 % interval 0-20 %), and in 5 its output is not a number." in some
    assert format_tally("wrong", 0, 20, 20) == "not a number in 20 of 20"
    assert format_tally("wrong", 2, 20, 5) == "wrong in 2, not a number in 5 of 20"
    assert format_tally("wrong", 2, 20) == "wrong in 2 of 20"


def test_a_clean_scene_without_a_number_is_said_as_such() -> None:
    clean = {**samples.ATTACK["clean"], "label": "not a number", "index": None, "probability": None, "correct": False}
    clean["control"] = {**clean["control"], "correct": 0, "rate": 0.0, "not_a_number": 20}
    verdict = wording.attack_verdict(samples.attack(ending="already wrong", clean=clean))
    assert verdict.startswith("The model already predicts nothing for this mug, for its output is not a number")
    clean["control"] = {**clean["control"], "correct": 17, "not_a_number": 2}
    (first, *_) = wording.make_remarks(samples.attack(clean=clean))
    assert "fails 3 of its 20 trials; in 2 the output is not a number." in first
    for task in ("classification", "detection", "segmentation", "depth"):
        assert (
            format_mistake(task, "this mug", "not a number")
            == "predicts nothing for this mug, for its output is not a number"
        )
        assert format_prediction_cells(task, Prediction("not a number")) == ["not a number", ""]
    assert format_mistake("segmentation", "this bottle", "no bottle", Outcome.MISSED) == "finds no bottle"


class Broken(nn.Module):
    """Always right, but NaN in dark pictures."""

    def forward(self, x: Tensor) -> Tensor:
        bright = x.mean(dim=(1, 2, 3))
        logits = torch.stack([10.0 + bright, 5.0 * bright, bright], dim=1)
        return torch.where((bright < 0.1)[:, None], logits * math.nan, logits)


@pytest.mark.medium
def test_a_region_has_no_verdict_where_the_model_says_nothing(tmp_path: Path) -> None:
    labels = tmp_path / "labels.txt"
    labels.write_text("mug\nbowl\nvase\n")
    settings: Any = {"vary": "pose.yaw", "verify_spp": 1, "samples": 8, "resolution": 16, "labels": labels}
    with pytest.raises(
        InputError, match=r"the model's prediction is not a number in [0-9]+ of [0-9]+ trials at the cent"
    ):
        advsearch.region(
            "mug", "test_not_a_number:Broken", controls={"pose": {}}, exposure=-8.0, run=tmp_path / "run", **settings
        )


@pytest.mark.medium
def test_an_attack_keeps_what_the_model_could_not_say(tmp_path: Path) -> None:
    labels = ["mug", "bowl", "vase"]
    model = advsearch.load_model(Broken(), input_size=16, labels=labels)
    options: Any = {"exposure": -8.0, "spp": 1, "trials": 6, "verify_spp": 1, "steps": 2, "baseline": False}
    result = advsearch.attack("mug", model, run=tmp_path / "run", **options)
    summary = result.summary
    assert summary.ending == "already wrong" and summary.clean.label == "not a number"
    assert summary.clean.control is not None and summary.clean.control.not_a_number == summary.clean.control.trials
    assert {(row.label, row.label_index, row.correct) for row in result.rows()} == {(None, None, False)}
