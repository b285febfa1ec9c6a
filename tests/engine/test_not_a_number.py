"""Answers that are NaN or infinite are called that wherever trials are kept, counted and told."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.attacks import TrialCounts
from advsearch.engine.record import make_control_group, make_rate
from advsearch.tasks import Judgement, Prediction

NOTHING = Judgement.from_margin(math.nan, math.nan, Prediction("tench", 0, math.nan))
RIGHT = Judgement.from_margin(-1.0, -1.0, Prediction("mug", 1, 0.9))
WRONG = Judgement.from_margin(3.0, 3.0, Prediction("vase", 2, 0.8))


def test_trials_without_a_number_are_counted_and_means_are_of_the_others() -> None:
    trials = [NOTHING, WRONG, RIGHT, NOTHING]
    rate = make_rate(TrialCounts(1, 4, 16), trials, [WRONG])
    assert (rate.not_a_number, rate.margin, rate.labels) == (2, -1.0, {"vase": 1})
    control = make_control_group(trials, 16)
    assert (control.correct, control.trials, control.not_a_number) == (1, 4, 2)
    assert math.isnan(make_rate(TrialCounts(0, 2, 16), [NOTHING, NOTHING], []).margin)
    assert "not_a_number" not in make_rate(TrialCounts(1, 2, 16), [WRONG, RIGHT], [WRONG]).to_dict()


class Broken(nn.Module):
    """Always right, but NaN in dark pictures."""

    def forward(self, x: Tensor) -> Tensor:
        bright = x.mean(dim=(1, 2, 3))
        logits = torch.stack([10.0 + bright, 5.0 * bright, bright], dim=1)
        return torch.where((bright < 0.1)[:, None], logits * math.nan, logits)


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
