"""Attacks on several models: the matrix of attacked on against tested on, and one answer for all."""

from pathlib import Path
from typing import Any

import pytest
import torch

from advsearch.engine.verifier import Retrials
from advsearch.questions.attack import attack
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import MatrixResult
from advsearch.runs.store import Store
from advsearch.runs.summary import read_result
from advsearch.tasks import Classification
from advsearch.tasks.together import EnsembleTask, join_models, regroup_by_model
from small_models import easy, hard

BOTH = "small_models:easy,small_models:hard"
SHORT: dict[str, Any] = {
    "object": "mug", "controls": {"texture": {"epsilon": 0.3}}, "steps": 6, "trials": 6,
    "verify_spp": 4, "spp": 2, "denoise": "none", "baseline": False, "measure": "no",
}  # fmt: skip


def carried_out(run: Path, **more: Any) -> MatrixResult:
    result = attack.run(AttackConfig(**{**SHORT, "model": BOTH, "run": str(run), **more}))
    assert isinstance(result, MatrixResult)
    return result


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> MatrixResult:
    """The matrix of two models of other labels and another input size."""
    return carried_out(tmp_path_factory.mktemp("matrix") / "run")


@pytest.mark.medium
def test_every_adversarial_scene_is_tried_on_every_model(whole: MatrixResult) -> None:
    """What misleads the hard one misleads the easy one too."""
    result, run = whole, Path(str(whole.run))
    names = ["small_models:easy", "small_models:hard"]
    assert [row.attacked for row in result.table] == names and result.models == names
    assert [[cell.model for cell in row.tested] for row in result.table] == [names, names]
    assert [one.input_size for one in result.tested] == [(32, 32), (24, 24)]
    assert [one.clean.correct for one in result.tested] == [6, 6]
    verified = {(row.attacked[13:], cell.model[13:]): cell for row in result.table for cell in row.tested}
    assert verified["easy", "easy"].ending == "found"
    assert verified["hard", "hard"].ending == verified["hard", "easy"].ending == "found"
    assert all(cell.verified.trials == 6 and cell.verified.spp == 4 for cell in verified.values())
    assert read_result(run).to_dict() == result.to_dict()
    with Store(run / "results.sqlite", read_only=True) as store:
        counts = store.count_by_kind()
        seeds = {tuple(row.seed for row in store.rows(kind)) for kind in counts}
    assert len(counts) == 6 and set(counts.values()) == {6} and len(seeds) == 1, "the same seeds for all"
    assert (run / "images" / "attack.svg").is_file()


@pytest.mark.medium
def test_a_matrix_goes_on_with_the_trial_at_which_it_was_stopped(
    whole: MatrixResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, done = Retrials._render, 0

    def stopped(*given: Any) -> Any:
        nonlocal done
        done += 1
        if done == 15:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(Retrials, "_render", stopped)
    first = carried_out(tmp_path / "run")
    assert first.ending == "interrupted" and first.is_unfinished
    again = attack.run(AttackConfig.from_yaml(tmp_path / "run" / "run.yaml"), resumed_directory=tmp_path / "run")
    assert isinstance(again, MatrixResult) and again.ending == "done"
    assert [row.tested for row in again.table] == [row.tested for row in whole.table]
    assert done < 2 * 6 * 3 + 2, "what was tried is not tried again"


def test_an_ensemble_answers_as_its_models_do() -> None:
    models = easy(), hard()
    pictures = torch.rand((3, 32, 32, 3), generator=torch.Generator().manual_seed(0))
    both = join_models(models)
    assert both.input_size == (32, 32) and both.differentiable and len(both(pictures)) == 3
    for own, output in zip(models, regroup_by_model(both(pictures)), strict=True):
        assert torch.equal(output, own(pictures))


@pytest.mark.parametrize(
    ("logits", "score", "right"),
    [
        ([[0.0, 2.0], [0.0, 1.0]], 1.0, False),
        ([[0.0, 2.0], [3.0, 0.0]], -3.0, False),
        ([[1.0, 0.0], [3.0, 0.0]], -3.0, True),
    ],
    ids=["both wrong", "one wrong", "both right"],
)
def test_a_prediction_counts_where_it_does_for_each_model(logits: list[list[float]], score: float, right: bool) -> None:
    """One model that errs is neither a success nor a right answer."""
    tasks = (Classification(labels=("mug", "vase")), Classification(labels=("cup", "jar")))
    task = EnsembleTask(parts=tasks, models=(easy(), hard()), tasks=tasks)
    output = [tuple(torch.tensor([one]) for one in logits)]
    (judged,) = task.judge(output, ((0,), (0,)))
    assert (judged.score, judged.right, judged.success) == (score, right, score > 0.0)
    assert float(task.score(output, ((0,), (0,)))[0]) == score
    assert (judged.margin >= 0.0) == right
