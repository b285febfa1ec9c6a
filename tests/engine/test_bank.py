"""Searches under conditions that vary by chance, by a matrix for each condition of a bank."""

from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch.api import prediction
from advsearch.attacks.domain import Block, Domain
from advsearch.engine import acceptance
from advsearch.engine.prediction import sample_condition
from advsearch.engine.problem import compute_condition_weights
from advsearch.predictors import bank
from advsearch.predictors.bank import Bank
from advsearch.predictors.surface_light import renderer as surface_renderer
from advsearch.questions.attack.result import AttackResult
from advsearch.scene.predictor import Refusal
from stand_ins import Impatient, rows

pytestmark = pytest.mark.island("advsearch.predictors.bank", "advsearch.predictors.surface_light")

SMALL: dict[str, Any] = {
    "resolution": 32,
    "controls": {"texture": {"resolution": 4}},
    "over": ["camera", "environment"],
    "draws": 2,
    "steps": 18,
    "trials": 6,
    "verify_spp": 2,
    "baseline": False,
    "deterministic": True,
}


def test_conditions_are_stratified_and_numbered() -> None:
    """Sixteen of them: of each number, one in each sixteenth of its range; the same in any order. A choice has its
    middle, and a ball of a norm is drawn from."""
    box = Domain(torch.full((3,), 0.5), (Block(2, low=0.2, high=0.6), Block(1)))
    drawn = torch.stack([sample_condition(box, number, seed=3) for number in range(16)])
    shares = (drawn - box.lower_bounds) / (box.upper_bounds - box.lower_bounds)
    assert all(sorted((shares[:, one] * 16).floor().tolist()) == list(range(16)) for one in range(3))
    assert torch.equal(sample_condition(box, 7, seed=3), drawn[7])
    assert not torch.equal(sample_condition(box, 7, seed=4), drawn[7])
    choice = Domain(torch.tensor([0.25]), (Block(1, n_options=2),))
    assert {float(sample_condition(choice, number, seed=0)) for number in range(8)} == {0.25, 0.75}
    ball = Domain(torch.full((4,), 0.5), (Block(4, norm="l2", epsilon=0.1),))
    assert ball.contains(sample_condition(ball, 5, seed=0)) and sample_condition(ball, 5, seed=0).ne(0.5).any()


def grow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let it compare every six evaluations, and go on growing after each comparison."""
    sizes = {"COMPARISON_INTERVAL": 6, "N_COMPARED": 2, "INITIAL_CONDITIONS": 3, "DRAWS_PER_CONDITION": 4}
    for name, value in {**sizes, "MIN_STANDARD_ERRORS": -1e9}.items():
        monkeypatch.setattr(bank, name, value)
    monkeypatch.setattr(acceptance, "CHECK_SPP", 4)
    monkeypatch.setattr(surface_renderer, "find_refusal", lambda renderer, varying: Refusal("matrices are tested"))


@pytest.fixture(autouse=True)
def by_matrices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing be predicted by light on surfaces."""
    monkeypatch.setattr(surface_renderer, "find_refusal", lambda renderer, varying: Refusal("matrices are tested"))


@pytest.fixture
def growing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bank that grows."""
    grow(monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AttackResult]:
    """A run that nobody disturbed, and its result."""
    run = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patched:
        grow(patched)
        return run, advsearch.attack("mug", run=run, **SMALL)


@pytest.mark.medium
@pytest.mark.usefixtures("growing")
def test_a_search_that_goes_on_ends_with_the_same_rows(whole: tuple[Path, AttackResult], tmp_path: Path) -> None:
    stopped = advsearch.attack("mug", run=tmp_path / "parts", progress=Impatient(14), **SMALL)
    assert stopped.summary.ending == "interrupted"
    advsearch.attack("mug", run=tmp_path / "parts", resume=True, **SMALL)
    assert rows(tmp_path / "parts") == rows(whole[0])


@pytest.mark.medium
@pytest.mark.slow
@pytest.mark.usefixtures("growing")
def test_a_run_that_was_killed_between_a_comparison_and_its_evaluation_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """That the bank grows is stored by then, and where it grew is what is evaluated next."""
    fill = Bank._fill

    def killed(self: Bank, index: int, *more: Any) -> None:
        if index == 6:
            raise KeyboardInterrupt
        fill(self, index, *more)

    monkeypatch.setattr(Bank, "_fill", killed)
    advsearch.attack("mug", run=tmp_path / "a", **SMALL)
    monkeypatch.setattr(Bank, "_fill", fill)
    found = advsearch.attack("mug", run=tmp_path / "a", resume=True, **SMALL)
    assert found.summary.steps == 18
    assert found.summary.transport is not None and found.summary.transport.conditions is not None
    assert found.summary.transport.conditions.grown == 2


@pytest.mark.medium
def test_its_pictures_are_those_that_are_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under each condition, but for noise and what a matrix leaves out; and the derivative is the weighted mean."""
    seen: list[Bank] = []
    monkeypatch.setattr(Bank, "prepare", lambda self, tick: seen.append(self))
    monkeypatch.setattr(bank, "INITIAL_CONDITIONS", 2)
    monkeypatch.setattr(bank, "SPP", 64)
    advsearch.attack("mug", **{**SMALL, "steps": 16, "epsilon": 0.3})
    made, problem = seen[0], seen[0].problem
    made._fill(0)
    generator = torch.Generator().manual_seed(1)
    u = problem.domain.sample(generator)[0]
    with torch.no_grad():
        before, after = (made._predict_images(made._conditions, at) for at in (problem.domain.start, u))
        for one, change in zip(made._conditions, after - before, strict=True):
            wholes = (torch.cat([at, one.u]) for at in (problem.domain.start, u))
            first, second = (problem.renderer(whole, seed=1, spp=64) for whole in wholes)
            assert float((change - second + first).square().mean()) < 0.1 * float((second - first).square().mean())
    each = [made._evaluate_under([one], u, True) for one in made._conditions]
    values, gradients = torch.tensor([one.objective for one in each]), [one.gradient for one in each]
    weights = compute_condition_weights(values)
    assert float(weights.mean()) == pytest.approx(1.0) and int(weights.argmax()) == int(values.argmin())
    mean = sum(weight * one for weight, one in zip(weights, gradients, strict=True) if one is not None) / len(each)
    torch.testing.assert_close(made._evaluate_under(made._conditions, u, True).gradient, mean, rtol=1e-3, atol=1e-7)


@pytest.mark.medium
@pytest.mark.usefixtures("growing")
def test_the_oldest_conditions_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is memory for two or three, the newest are kept and nothing fails."""
    monkeypatch.setattr(prediction, "MAX_BYTES", 150_000)
    kept: list[list[int]] = []
    drawn = Bank._choose_conditions

    def watched(self: Bank, kind: str, index: int) -> Any:
        kept.append([one.index for one in self._conditions])
        return drawn(self, kind, index)

    monkeypatch.setattr(Bank, "_choose_conditions", watched)
    told = advsearch.attack("mug", **SMALL).summary.transport
    assert told is not None and told.conditions is not None and told.bytes is not None
    assert told.conditions.dropped == 10 - len(kept[-1]) and told.bytes <= 150_000
    assert kept[-1] == list(range(10 - len(kept[-1]), 10))
