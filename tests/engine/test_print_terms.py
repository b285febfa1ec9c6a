"""What `printable` takes from an objective."""

from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch.engine.judging import mean_variation, printable_distance
from advsearch.progress import Stages
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.wording import print_cost_text
from small_models import easy

SHORT: dict[str, Any] = {
    "controls": {"texture": {"epsilon": 0.3}}, "steps": 30, "trials": 6, "verify_spp": 4, "spp": 2, "denoise": "none",
    "baseline": False, "measure": "no",
}  # fmt: skip


def test_one_colour_is_smooth_and_the_set_is_printable() -> None:
    flat = torch.full((4, 4, 3), 0.3)
    assert float(mean_variation(flat)) == 0.0 and float(printable_distance(flat)) == pytest.approx(0.0, abs=1e-6)
    assert float(printable_distance(torch.ones(2, 2, 3))) == pytest.approx(0.1 * 3**0.5)
    board = torch.tensor([[0.0, 1.0], [0.0, 1.0]])[..., None].expand(2, 2, 3)
    assert float(mean_variation(board)) == pytest.approx(0.5)  # half of the pixels have a neighbour of another colour


@pytest.mark.medium
def test_predictions_are_nearer_to_ink() -> None:
    with_terms = advsearch.attack("mug", easy(), printable=True, **SHORT)
    without = advsearch.attack("mug", easy(), **SHORT)
    found = with_terms.summary.printability
    assert found is not None and found.adversarial is not None and without.summary.printability is None
    plain = without.artifacts["texture"]
    cost = found.adversarial.variation + found.adversarial.off_print
    assert cost < 0.6 * float(mean_variation(plain) + printable_distance(plain))
    assert found.adversarial.off_print < 0.3 * float(printable_distance(plain))
    assert with_terms.found and without.found
    clean = with_terms.artifacts["texture-original"]
    priced = found.cost
    assert priced is not None and priced.steps == 30 and priced.verified.trials == 6
    ours, plainly = with_terms.summary.verified, without.summary.verified
    assert ours is not None and plainly is not None and priced.margin_with == ours.margin
    assert priced.cost == pytest.approx(priced.margin_with - priced.margin_without) and priced.cost > 0.0
    assert priced.margin_without == pytest.approx(plainly.margin, rel=0.1), "as of an attack without"
    assert priced.terms.variation + priced.terms.off_print > found.adversarial.variation + found.adversarial.off_print
    spent, plain_spent = with_terms.summary.renders, without.summary.renders
    assert spent["products"] == 2 * plain_spent["products"] and "unprinted" not in plain_spent
    assert spent["verification"] == plain_spent["verification"] + 6
    assert found.clean.variation == pytest.approx(float(mean_variation(clean)), rel=1e-4)


@pytest.mark.medium
def test_a_stopped_run_tells_the_same_cost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {**SHORT, "steps": 6, "object": "mug", "model": "small_models:easy", "printable": True}
    config = AttackConfig(**settings, run=str(tmp_path / "stopped"))
    whole = attack_once(AttackConfig(**settings, run=str(tmp_path / "whole"))).summary
    real = Stages.begin

    def stopping(self: Stages, name: str, title: str, *given: Any, **named: Any) -> None:
        if title.startswith("searching without print terms"):
            raise KeyboardInterrupt
        real(self, name, title, *given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(Stages, "begin", stopping)
        stopped = attack_once(config).summary
    assert stopped.ending == "interrupted" and stopped.printability is not None and stopped.printability.cost is None
    assert stopped.printability.adversarial is not None and print_cost_text(stopped) == ""
    resumed = attack_once(config, resumed=tmp_path / "stopped").summary
    assert resumed.printability == whole.printability and whole.printability is not None
    assert whole.printability.cost is not None and whole.printability.cost.steps == 6
