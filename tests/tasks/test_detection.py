"""Object detection: what a detector may return, and when the object counts as found, mislabelled, displaced."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch.attacks.objectives import get_objective
from advsearch.errors import InputError
from advsearch.models import load_model
from advsearch.options import NOT_A_NUMBER, Outcome, get_outcome
from advsearch.tasks import Detection, Facts, Judgement, Prediction, Sight
from advsearch.tasks.boxes import DetectionTruth, compute_fraction_inside, compute_iou, to_corners
from advsearch.tasks.detection import GOALS
from advsearch.tasks.detector_outputs import read_detections

NAMES = ("cup", "bowl", "dog")
HERE, NEAR, AWAY = [0.2, 0.2, 0.6, 0.6], [0.3, 0.2, 0.7, 0.6], [0.7, 0.7, 0.9, 0.9]
TASK = Detection(labels=NAMES, unit="fractions")
TRUTH = DetectionTruth((0,), (4, 4, 12, 12), (20, 20))
"""The object is where `HERE` says; `NEAR` overlaps it by 0.6."""


def dense(*rows: tuple[list[float], list[float]]) -> list[dict[str, Tensor]]:
    """What a detector says of one picture: boxes with scores of all classes."""
    return [{"boxes": torch.tensor([box for box, _ in rows]), "scores": torch.tensor([scores for _, scores in rows])}]


def sparse(*rows: tuple[list[float], int, float]) -> list[dict[str, Tensor]]:
    """The same of boxes with one class each; of a picture without any, too."""
    boxes = torch.tensor([box for box, _, _ in rows]).reshape(-1, 4)
    labels, scores = torch.tensor([k for _, k, _ in rows]).long(), torch.tensor([s for *_, s in rows]).float()
    return [{"boxes": boxes, "labels": labels, "scores": scores}]


def judged(task: Detection, output: list[dict[str, Tensor]], truth: DetectionTruth = TRUTH) -> Judgement:
    (found,) = task.judge(output, truth)
    assert found.score == pytest.approx(float(task.score(output, truth)))
    assert found.margin == pytest.approx(-float(task.loss(output, truth)))
    return found


def test_boxes_overlap_by_the_share_of_their_union() -> None:
    box = torch.tensor(HERE)
    boxes = torch.tensor([HERE, NEAR, AWAY, [0.2, 0.2, 0.4, 0.6], [0.6, 0.6, 0.2, 0.2]])
    assert compute_iou(boxes, box).tolist() == pytest.approx([1.0, 0.6, 0.0, 0.5, 0.0], abs=1e-5)
    assert compute_fraction_inside(boxes, box).tolist() == pytest.approx([1.0, 0.75, 0.0, 1.0, 0.0], abs=1e-5)


def test_all_forms_of_a_box_are_the_same_corners() -> None:
    forms = {"xyxy": [1, 2, 5, 8], "xywh": [1, 2, 4, 6], "cxcywh": [3, 5, 4, 6], "yxyx": [2, 1, 8, 5]}
    for form, numbers in forms.items():
        assert to_corners(torch.tensor(numbers).float(), form).tolist() == [1, 2, 5, 8]


BOXES, SCORES = torch.tensor([[HERE, AWAY]] * 2), torch.rand(2, 2, 3, generator=torch.Generator().manual_seed(1))
LABELS, ONE = torch.tensor([[0, 2], [1, 1]]), torch.tensor([[0.9, 0.2], [0.4, 0.3]])


class Output:
    """An answer with names, as libraries return it."""

    def __init__(self, **parts: Tensor) -> None:
        self.__dict__.update(parts)


@pytest.mark.parametrize(
    "answer",
    [
        (BOXES, SCORES), {"boxes": BOXES, "scores": SCORES}, Output(boxes=BOXES, scores=SCORES),
        [{"boxes": BOXES[k], "scores": SCORES[k]} for k in range(2)],
    ],
)  # fmt: skip
def test_scores_of_all_classes_are_read_in_every_form(answer: Any) -> None:
    found = read_detections(answer, 2)
    assert [sorted(one) for one in found] == [["boxes", "scores"]] * 2
    for k, one in enumerate(found):
        assert one["boxes"].equal(BOXES[k]) and one["scores"].equal(SCORES[k])


@pytest.mark.parametrize(
    "answer",
    [
        (BOXES, ONE, LABELS), {"boxes": BOXES, "labels": LABELS, "scores": ONE},
        [(BOXES[k], LABELS[k], ONE[k]) for k in range(2)],
    ],
)  # fmt: skip
def test_one_label_a_box_is_read_in_every_form(answer: Any) -> None:
    for k, one in enumerate(read_detections(answer, 2)):
        assert one["boxes"].equal(BOXES[k]) and one["labels"].equal(LABELS[k]) and one["scores"].equal(ONE[k])


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        ((BOXES, SCORES[:1]), "expected boxes"), ((BOXES[..., :3], SCORES), "expected boxes"),
        ((BOXES, 3.0 * SCORES - 1.0), r"probabilities in \[0, 1\]; apply a sigmoid"),
    ],
)  # fmt: skip
def test_what_is_no_detection_is_refused(answer: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        read_detections(answer, 2)


FAR = [0.34, 0.2, 0.74, 0.6]
"""Overlaps `NEAR` by 0.82, and the object by 0.48: not where it is."""


def test_a_right_box_that_suppression_drops_is_no_right_prediction() -> None:
    """A better cup beside the object takes the right box away; that is no success either, for the box was there."""
    output = dense((NEAR, [0.7, 0.0, 0.0]), (FAR, [0.9, 0.0, 0.0]))
    found = judged(TASK, output)
    assert not found.right and not found.success and found.prediction.label == "cup in a loose box"
    assert judged(replace(TASK, suppression=1.0), output).right, "every box counts where none is suppressed"
    assert judged(TASK, sparse((NEAR, 0, 0.7), (FAR, 0, 0.9))).right, "boxes with labels have been through it"
    assert judged(TASK, dense((NEAR, [0.7, 0.0, 0.0]), (FAR, [0.0, 0.9, 0.0]))).right, "another class drops nothing"
    assert judged(TASK, dense((NEAR, [0.9, 0.0, 0.0]), (FAR, [0.7, 0.0, 0.0]))).right, "a worse box drops nothing"


@pytest.mark.parametrize("seek", ["mislabel", "create"])
def test_a_box_that_suppression_drops_is_no_success(seek: str) -> None:
    """Each time the wrong box is there before suppression, and a better one of its class takes it away."""
    if seek == "mislabel":
        output = dense((NEAR, [0.0, 0.7, 0.0]), (FAR, [0.0, 0.9, 0.0]))
    else:  # mostly off the object, beside a better box that frames it
        output = dense(([0.42, 0.2, 0.82, 0.6], [0.0, 0.0, 0.7]), ([0.32, 0.2, 0.72, 0.6], [0.0, 0.0, 0.9]))
    task = replace(TASK, seek=seek)
    assert not judged(task, output).success
    assert judged(replace(task, suppression=1.0), output).success


def test_what_is_left_has_a_derivative_and_what_is_dropped_has_none() -> None:
    scores = torch.tensor([[0.7, 0.0, 0.0], [0.9, 0.0, 0.0]], requires_grad=True)
    output = [{"boxes": torch.tensor([NEAR, HERE]), "scores": scores}]
    TASK.loss(output, TRUTH).sum().backward()
    assert scores.grad is not None and scores.grad[0].tolist() == [0.0, 0.0, 0.0] and float(scores.grad[1, 0]) < 0.0


FOUND = dense((HERE, [0.8, 0.1, 0.0]), (AWAY, [0.1, 0.2, 0.1]))


@pytest.mark.parametrize(
    ("output", "answer", "right"),
    [
        (FOUND, Prediction("cup", 0, 0.8), True),
        (dense((HERE, [0.5, 0.6, 0.0])), Prediction("cup", 0, 0.5), True),
        (dense((HERE, [0.3, 0.6, 0.0])), Prediction("bowl", 1, 0.6), False),
        (dense((HERE, [0.3, 0.4, 0.0]), (AWAY, [0.7, 0.0, 0.0])), Prediction("cup elsewhere", None, 0.7), False),
        (dense((HERE, [0.3, 0.4, 0.0]), (AWAY, [0.4, 0.9, 0.0])), Prediction("no cup", None, 0.3), False),
        (sparse((HERE, 1, 0.8), (AWAY, 0, 0.4)), Prediction("bowl", 1, 0.8), False),
        (sparse(), Prediction("no cup", None, 0.0), False),
    ],
)
def test_the_object_is_found_by_a_right_box_with_a_right_name(
    output: list[dict[str, Tensor]], answer: Prediction, right: bool
) -> None:
    found = judged(TASK, output)
    assert (found.prediction.label, found.prediction.index, found.right) == (answer.label, answer.index, right)
    assert found.prediction.probability == pytest.approx(answer.probability)
    assert found.success is not right


LOOSE = [0.325, 0.25, 0.725, 0.65]  # overlaps the true box by .43
WIDE = [0.5, 0.5, 0.9, 0.9]  # overlaps it by .03


@pytest.mark.parametrize(
    ("output", "outcome", "label", "iou"),
    [
        (dense((HERE, [0.8, 0.6, 0.0])), Outcome.FOUND, "cup", 1.0),
        (dense((LOOSE, [0.8, 0.0, 0.0])), Outcome.LOOSE, "cup in a loose box", 0.43),
        (dense((LOOSE, [0.6, 0.0, 0.0]), (AWAY, [0.9, 0.0, 0.0])), Outcome.LOOSE, "cup in a loose box", 0.43),
        (dense((HERE, [0.3, 0.6, 0.0])), Outcome.WRONG_CLASS, "bowl", 1.0),
        (dense((HERE, [0.0, 0.6, 0.0]), (LOOSE, [0.8, 0.0, 0.0])), Outcome.WRONG_CLASS, "bowl", 1.0),
        (dense((LOOSE, [0.3, 0.9, 0.0])), Outcome.MISSED, "no cup", None),
        (dense((WIDE, [0.7, 0.0, 0.0])), Outcome.PHANTOM, "cup elsewhere", 0.032),
        (dense((AWAY, [0.7, 0.9, 0.0])), Outcome.PHANTOM, "cup elsewhere", 0.0),
        (sparse(), Outcome.MISSED, "no cup", None),
    ],
)
def test_missed_loose_wrong_and_phantom_are_told_apart(
    output: list[dict[str, Tensor]], outcome: Outcome, label: str, iou: float | None
) -> None:
    found = judged(TASK, output)
    payload: Any = found.payload
    assert (get_outcome(payload), found.prediction.label) == (outcome, label)
    assert found.right is (outcome is Outcome.FOUND)
    assert payload["iou"] == (None if iou is None else pytest.approx(iou, abs=0.001))
    assert payload["class"] == ("bowl" if outcome is Outcome.WRONG_CLASS else "cup")


def test_a_box_on_another_thing_of_the_class_is_no_phantom() -> None:
    """Nor is one on it a loose box of the object: the object is missed."""
    two = replace(TRUTH, other_boxes=((14, 14, 18, 18), (7, 5, 15, 13)))
    assert get_outcome(judged(TASK, dense((AWAY, [0.9, 0.0, 0.0])), two).payload) is Outcome.MISSED
    assert get_outcome(judged(TASK, dense((LOOSE, [0.9, 0.0, 0.0])), two).payload) is Outcome.MISSED
    third = [0.0, 0.8, 0.2, 1.0]
    assert get_outcome(judged(TASK, dense((third, [0.9, 0.0, 0.0])), two).payload) is Outcome.PHANTOM


def test_what_is_found_where_the_object_is_not_visible_is_a_phantom() -> None:
    """The picture counts for nothing, as any that does not show the object; what is kept says that it was found."""
    hidden = replace(TRUTH, box=None)
    found = judged(TASK, FOUND, hidden)
    assert (found.right, found.prediction.label, get_outcome(found.payload)) == (True, "out of view", Outcome.PHANTOM)
    nothing = judged(TASK, sparse(), hidden)
    assert nothing.prediction.label == "out of view" and get_outcome(nothing.payload) is None


def test_a_loose_box_of_the_object_creates_nothing() -> None:
    task = TASK.with_objective("create")
    beside = [0.45, 0.2, 0.85, 0.6]  # of it less than half is on the object, which it overlaps by .23
    assert not judged(task, dense((beside, [0.9, 0.0, 0.0]))).success
    assert judged(task, dense((beside, [0.0, 0.0, 0.9]))).success, "a dog is no loose cup"
    assert judged(task, dense((AWAY, [0.9, 0.0, 0.0]))).success


def test_the_margin_is_in_log_odds_of_the_score_that_counts() -> None:
    assert judged(TASK, FOUND).margin == pytest.approx(math.log(4.0), abs=1e-5)
    strict = replace(TASK, confidence=0.9)
    assert judged(strict, FOUND).margin == pytest.approx(math.log(4.0) - math.log(9.0), abs=1e-5)
    assert not judged(replace(TASK, iou=0.7), dense((NEAR, [0.9, 0.0, 0.0]))).right
    assert judged(replace(TASK, iou=0.55), dense((NEAR, [0.9, 0.0, 0.0]))).right


@pytest.mark.parametrize(
    ("seek", "output", "success"),
    [
        ("vanish", FOUND, False),
        ("vanish", dense((HERE, [0.4, 0.0, 0.0])), True),
        ("mislabel", dense((HERE, [0.4, 0.4, 0.0])), False),
        ("mislabel", dense((HERE, [0.4, 0.6, 0.0])), True),
        ("mislabel", sparse((HERE, 2, 0.6), (AWAY, 0, 0.9)), True),
        ("displace", dense((HERE, [0.4, 0.0, 0.0])), False),
        ("displace", dense((HERE, [0.4, 0.0, 0.0]), (AWAY, [0.6, 0.0, 0.0])), True),
        ("displace", dense((HERE, [0.6, 0.0, 0.0]), (AWAY, [0.9, 0.0, 0.0])), False),
        ("create", dense((HERE, [0.8, 0.6, 0.0]), (AWAY, [0.0, 0.0, 0.6])), True),
        ("create", dense((HERE, [0.8, 0.6, 0.0]), ([0.25, 0.25, 0.35, 0.35], [0.9, 0.9, 0.0])), False),
    ],
)
def test_an_objective_says_what_is_a_success(seek: str, output: list[dict[str, Tensor]], success: bool) -> None:
    task = TASK.with_objective(seek)
    assert task.seek == seek and judged(task, output).success is success
    assert (
        get_objective(seek, task)(output, torch.zeros(1, 4, 4, 3), TRUTH).tolist() == task.score(output, TRUTH).tolist()
    )


def test_a_target_is_a_name_for_the_box() -> None:
    dog = replace(TASK, seek="mislabel", target=(2,))
    assert not judged(dog, dense((HERE, [0.1, 0.9, 0.3]))).success
    assert judged(dog, dense((HERE, [0.1, 0.9, 0.6]))).success and dog.target_names == ("dog",)
    created = replace(TASK, seek="create", target=(2,))
    assert not judged(created, dense((AWAY, [0.0, 0.9, 0.3]))).success
    assert judged(created, dense((AWAY, [0.0, 0.1, 0.6]))).success
    with pytest.raises(InputError, match="target"):
        replace(TASK, target=(2,))
    with pytest.raises(InputError, match="minimise"):
        replace(TASK, minimise=True, seek="create")


def test_where_nothing_of_the_object_is_seen_nothing_is_missed() -> None:
    hidden = DetectionTruth((0,), None, (20, 20))
    for seek in ("vanish", "mislabel", "displace"):
        found = judged(TASK.with_objective(seek), FOUND, hidden)
        assert found.right and not found.success and found.prediction == Prediction("out of view")
    assert judged(TASK.with_objective("create"), dense((HERE, [0.0, 0.7, 0.0])), hidden).success


@pytest.mark.parametrize("seek", GOALS)
def test_every_objective_has_a_derivative(seek: str) -> None:
    boxes = torch.tensor([[0.22, 0.2, 0.6, 0.6], NEAR, AWAY], requires_grad=True)
    scores = torch.tensor([[0.7, 0.2, 0.1], [0.6, 0.3, 0.1], [0.2, 0.3, 0.4]], requires_grad=True)
    value = TASK.with_objective(seek).score([{"boxes": boxes, "scores": scores}], TRUTH).sum()
    found = torch.autograd.grad(value, [boxes, scores], allow_unused=True)
    moved = [one is not None and bool(one.abs().sum() > 0.0) for one in found]
    assert moved == ([True, False] if seek == "displace" else [False, True])
    empty = sparse()
    empty[0]["scores"].requires_grad_()
    torch.autograd.grad(TASK.with_objective(seek).score(empty, TRUTH).sum(), empty[0]["scores"])


def test_the_payload_has_all_boxes_in_pixels_and_marks_show_those_that_count() -> None:
    payload: Any = judged(
        TASK, dense((HERE, [0.8, 0.15, 0.0]), (NEAR, [0.6, 0.0, 0.0]), (AWAY, [0.1, 0.05, 0.6]))
    ).payload
    assert payload["box"] == [4, 4, 12, 12]
    assert [(one["label"], one["score"]) for one in payload["found"]] == [
        ("cup", 0.8), ("dog", 0.6), ("bowl", 0.15), ("cup", 0.1),
    ]  # fmt: skip
    assert payload["found"][1]["box"] == pytest.approx([14.0, 14.0, 18.0, 18.0])
    (marks,) = TASK.marks(FOUND, TRUTH)
    assert [(one.text, one.true) for one in marks] == [("cup", True), ("cup 0.80", False)]
    assert [one.box for one in marks] == [pytest.approx((4.0, 4.0, 12.0, 12.0))] * 2


class Pixels(nn.Module):
    """One box in pixels of an input of 8 x 16, and scores of three classes."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        boxes = torch.tensor([[[2.0, 2.0, 6.0, 6.0]]]).expand(len(x), -1, -1)
        return boxes, torch.stack([x.mean(dim=(1, 2, 3)), *[0.0 * x.sum(dim=(1, 2, 3))] * 2], dim=1)[:, None]


def test_a_task_learns_names_size_and_unit_from_its_model() -> None:
    model = load_model(Pixels(), input_size=(8, 16), read=Detection().output_reader, labels=NAMES)
    task = Detection().on(model)
    assert (task.labels, task.has_class_names, task.inferred_unit, task.input_size) == (NAMES, True, "pixels", (8, 16))
    assert model.differentiable
    output = model(torch.full((8, 16, 3), 0.9))
    at = DetectionTruth((0,), (4, 8, 12, 24), (32, 32))
    assert task.judge(output, at)[0].right, "2 to 6 of 16 are 4 to 12 of 32"
    unnamed = Detection(unit="fractions").on(load_model(Pixels(), input_size=(8, 16), read=Detection().output_reader))
    assert unnamed.labels == ("class 0", "class 1", "class 2") and unnamed.unit == "fractions"
    facts = Facts("mug", "#2", compute_sight=lambda: Sight(torch.ones(4, 4).bool(), torch.ones(4, 4), torch.ones(4, 4)))
    assert unnamed.truth(facts) == DetectionTruth((2,), (0, 0, 4, 4), (4, 4))
    assert Detection().on(load_model(replace(model, labels=()), labels=NAMES)).labels == NAMES, "named afterwards"
    with pytest.raises(InputError, match="labels"):
        Detection().on(replace(model, labels=("a", "b")))


def judged_anyway(output: list[dict[str, Tensor]]) -> Judgement:
    return TASK.judge(output, TRUTH)[0]


def test_a_score_that_is_no_number_is_neither_right_nor_a_success() -> None:
    found = judged_anyway(dense((HERE, [math.nan, 0.1, 0.1])))
    assert not found.right and not found.success and found.prediction == Prediction(NOT_A_NUMBER)
