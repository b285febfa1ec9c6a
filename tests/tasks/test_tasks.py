"""Tasks: what counts as success, what is right, and what is said of an output."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.attacks.objectives import OBJECTIVE_KINDS, get_objective
from advsearch.errors import InputError, UnknownNameError
from advsearch.models import load_model
from advsearch.tasks import TASKS, Classification, Facts, Prediction, Task, make_task

LOGITS = torch.tensor([[3.0, 1.0, 0.0], [0.0, 2.0, 1.0], [0.0, 1.0, 4.0], [2.0, 2.0, 0.0], [math.nan, 0.0, 1.0]])
NAMED = Classification(labels=("mug", "bowl", "vase"))


@pytest.mark.parametrize(
    ("task", "scores", "goal"),
    [
        (NAMED, [-2.0, 2.0, 4.0, 0.0], "a wrong answer"),
        (replace(NAMED, target=(2,)), [-3.0, -1.0, 3.0, -2.0], "a target answer"),
        (replace(NAMED, minimise=True), [2.0, -2.0, -4.0, 0.0], "a right answer"),
    ],
)
def test_a_score_over_zero_is_a_success(task: Classification, scores: list[float], goal: str) -> None:
    found = task.judge(LOGITS, (0,))
    assert [one.score for one in found[:4]] == scores and task.score(LOGITS, (0,))[:4].tolist() == scores
    assert [one.success for one in found] == [score > 0.0 for score in scores] + [False]
    assert [one.right for one in found] == [True, False, False, True, False]
    assert [one.margin for one in found[:4]] == [2.0, -2.0, -4.0, 0.0], "whatever is sought"
    assert math.copysign(1.0, found[3].margin) == 1.0, "no -0.0"
    assert task.success_description == goal


@pytest.mark.parametrize("logits", [[math.nan, 0.0, 1.0], [math.nan] * 3, [1.0, math.inf, 0.0], [math.inf, 0.0, 0.0]])
def test_an_output_that_is_not_a_number_is_called_that(logits: list[float]) -> None:
    output = torch.tensor([logits])
    for task in (NAMED, replace(NAMED, target=(2,)), replace(NAMED, minimise=True)):
        (found,) = task.judge(output, (0,))
        assert found.prediction == Prediction("not a number", None, None) and found.is_non_finite
        assert not found.right and not found.success and math.isnan(found.score) and math.isnan(found.margin)
    assert NAMED.predictions(output, 3) == [(Prediction("not a number"),)]
    (found,) = NAMED.judge(torch.tensor([[1.0, 0.0, -math.inf]]), (0,))
    assert found.right and found.prediction.label == "mug", "a class that is ruled out is a number"


@pytest.mark.parametrize("place", [0, 1, 2])
def test_background_is_no_rival_of_a_class_and_no_prediction(place: int) -> None:
    labels, logits = ["mug", "bowl"], [1.0, 0.5]
    labels.insert(place, "Background")
    logits.insert(place, 9.0)
    task, output = Classification(labels=tuple(labels)), torch.tensor([logits])
    right = (labels.index("mug"),)
    (found,) = task.judge(output, right)
    assert found.right and found.margin == 0.5 and found.prediction.label == "mug"
    assert found.prediction.probability < 0.7  # type: ignore[operator]
    assert [one.label for one in task.predictions(output, 5)[0]] == ["mug", "bowl"]
    for name, kind in OBJECTIVE_KINDS.items():
        if kind.plain is not None and name != "dlr":  # which needs three classes
            value = get_objective(name, task)(output, torch.zeros(1, 2, 2, 3), right)
            beside = output[:, [labels.index("mug"), labels.index("bowl")]]
            assert value.tolist() == kind.plain(beside, torch.zeros(1, 2, 2, 3), (0,)).tolist(), name
    sought = replace(task, target=(place,))
    assert sought.judge(output, right)[0].success and sought.predictions(output, 1)[0][0].label == "Background"
    two = Classification(labels=("mug", "none"))
    assert two.judge(torch.tensor([[0.0, 1.0]]), (0,))[0].prediction.label == "none", "there is no other wrong answer"
    honest = Classification(labels=("mug", "none of the above", "bowl"))
    assert not honest.judge(torch.tensor([[0.0, 1.0, 0.0]]), (0,))[0].right


def test_what_is_right_is_what_was_said_or_else_the_objects_own_label() -> None:
    assert NAMED.truth(Facts("thing", "bowl,vase", "mug")) == (1, 2)
    assert NAMED.truth(Facts("thing", None, "mug")) == (0,) and NAMED.truth_names((0, 2)) == ("mug", "vase")
    with pytest.raises(InputError, match=r"^label"):
        NAMED.truth(Facts("thing"))
    with pytest.raises(InputError, match=r"^label"):
        NAMED.truth(Facts("thing", None, "chair"))


@dataclass(frozen=True, kw_only=True)
class Yaw(Task):
    """Tell how far the object is turned, within a tolerance in degrees."""

    name = "yaw"
    varies = True
    tolerance: float = 10.0

    def truth(self, facts: Facts) -> float:
        return facts.get_number("pose.yaw")

    def loss(self, output: Tensor, truth: float) -> Tensor:
        return (output[:, 0] - truth).abs() - self.tolerance

    def predictions(self, output: Tensor, count: int = 1) -> list[tuple[Prediction, ...]]:
        return [(Prediction(f"{value:.0f} degrees"),) for value in output[:, 0].tolist()]

    def payloads(self, output: Tensor) -> list[Any]:
        return output[:, 0].tolist()


class Level(nn.Module):
    """Answers with one number: the mean of the picture times a hundred."""

    def forward(self, x: Tensor) -> Tensor:
        return 100.0 * x.mean(dim=(1, 2, 3))[:, None]


def at(numbers: Mapping[str, float]) -> Facts:
    return Facts("mug", compute_numbers=lambda: numbers)


def test_three_methods_make_a_task() -> None:
    task, output = Yaw(), torch.tensor([[32.0], [55.0], [math.nan]])
    truth = task.truth(at({"pose.yaw": 30.0}))
    assert truth == 30.0 and task.truth_names(truth) == ("30.0",)
    near, far, lost = task.judge(output, truth)
    assert (near.score, near.right, near.prediction, near.payload) == (-8.0, True, Prediction("32 degrees"), 32.0)
    assert (far.score, far.success, far.right) == (15.0, True, False)
    assert not lost.success and not lost.right
    easier = task.on(load_model(Level(), input_size=8, read=task.output_reader), minimise=True)
    assert [one.success for one in easier.judge(output[:2], truth)] == [True, False]
    assert float(task.average([output[:1], output[1:2]])) == 43.5


def test_its_score_is_what_is_maximised_where_nothing_else_is_said() -> None:
    images, output = torch.zeros(1, 4, 4, 3), torch.tensor([[50.0]], requires_grad=True)
    assert Yaw.objective == "score"
    value = get_objective("score", Yaw())(output, images, 30.0)
    value.sum().backward()
    assert value.tolist() == [10.0] and output.grad is not None and output.grad.tolist() == [[1.0]]
    assert get_objective("score", Yaw(minimise=True))(output, images, 30.0).tolist() == [-10.0]
    assert get_objective("score", Yaw(target=45.0))(output, images, 30.0).tolist() == [5.0]
    assert get_objective("score", NAMED)(LOGITS[:2], images, (0,)).tolist() == [-2.0, 2.0]


@pytest.mark.medium
@pytest.mark.parametrize(("tolerance", "right"), [(1e3, 2), (1e-3, 0)])
def test_python_takes_a_task_with_options_of_its_own(tolerance: float, right: int) -> None:
    network, task = load_model(Level(), input_size=8, read=Yaw().output_reader), Yaw(tolerance=tolerance)
    fast: dict[str, Any] = {"spp": 1, "denoise": "none", "resolution": 16}
    swept = advsearch.sweep("mug", network, {"pose.yaw": [0.0, 90.0]}, task=task, trials=0, **fast).summary
    assert swept.worst is not None
    assert (swept.task, swept.correct, swept.worst.label_set) == ("yaw", right, ["90.0"])
    found = advsearch.attack(
        "mug", network, task=task, controls={"pose": {"yaw": [0, 90]}}, policy="random", steps=3, trials=6,
        verify_spp=1, measure="no", **fast,
    )  # fmt: skip
    assert found.summary.ending == ("budget spent" if right else "already wrong")
    assert (found.summary.task, found.summary.objective) == ("yaw", "score")
    with pytest.raises(InputError, match="model Level"):
        advsearch.attack("mug", network, **fast)


@pytest.fixture
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    """`yaw` is the name of a task."""
    monkeypatch.setattr(TASKS, "built_ins", {"classification": Classification, "yaw": Yaw})


def test_a_task_is_made_with_options(named: None) -> None:
    assert make_task("yaw") == make_task({"name": "yaw"}) == Yaw()
    assert make_task({"name": "yaw", "tolerance": 5}) == Yaw(tolerance=5.0)
    with pytest.raises(UnknownNameError, match="'tolerance'"):
        make_task({"name": "yaw", "tolerence": 5})
    with pytest.raises(InputError, match="tolerance"):
        make_task({"name": "yaw", "tolerance": "wide"})
    for option in ("minimise", "target", "labels", "named"):
        with pytest.raises(UnknownNameError, match="'classification'"):
            make_task({option: True})
