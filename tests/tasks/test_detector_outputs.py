"""What detectors return: which output is what, which rows count, in what unit and form boxes are."""

import json
import math
from collections.abc import Callable
from dataclasses import astuple
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch.errors import InputError
from advsearch.models import load_model
from advsearch.options import NOT_A_NUMBER
from advsearch.tasks import Detection, Prediction
from advsearch.tasks.boxes import Detections, DetectionTruth

CUP, BOWL = [20.0, 40.0, 60.0, 90.0], [65.0, 10.0, 90.0, 35.0]
NAMES = ("cup", "bowl")
PICTURE = torch.full((100, 100, 3), 0.25)
"""In which the detectors below find something, and nothing in brighter ones."""

TRUTH = DetectionTruth((0,), (20, 40, 60, 90), (100, 100))
NAN = math.nan

Rows = tuple[Tensor, Tensor, Tensor]


class Shaped(nn.Module):
    """Finds a cup and a bowl in a dark picture, in rows that are filled up to five, and answers as `form` says."""

    def __init__(
        self, form: Callable[..., Any], fill: float = 0.0, classes: tuple[int, int] = (0, 1), scores: Any = (0.8, 0.6)
    ) -> None:
        super().__init__()
        self.form, self.fill, self.classes, self.scores = form, fill, classes, scores

    def forward(self, x: Tensor) -> Any:
        boxes, scores, classes = torch.full((len(x), 5, 4), self.fill), torch.zeros(len(x), 5), torch.zeros(len(x), 5)
        classes += self.fill
        for k in (x.mean(dim=(1, 2, 3)) < 0.4).nonzero().flatten().tolist():
            boxes[k, :2], scores[k, :2] = torch.tensor([CUP, BOWL]), torch.tensor(self.scores)
            classes[k, :2] = torch.tensor(self.classes).float()
        return self.form(boxes, scores + 0.0 * x.sum(), classes)


def on(network: nn.Module, **options: Any) -> tuple[Detection, list[Detections]]:
    """The task after it has seen the picture, and the answer to it."""
    task = Detection(**options)
    model = load_model(network, input_size=100, read=task.output_reader, labels=NAMES)
    output = model(PICTURE)
    return task.on(model).after_calibration(output, TRUTH), output


def rows(boxes: Tensor, scores: Tensor, classes: Tensor, order: str = "bsc") -> Tensor:
    parts = {"b": boxes, "s": scores[..., None], "c": classes[..., None]}
    return torch.cat([parts[one] for one in order], dim=-1)


def numbered(b: Tensor, s: Tensor, c: Tensor) -> Tensor:
    """Rows of what is found, with the number of the picture first and the class before the score."""
    pictures = torch.arange(len(b))[:, None].expand(len(b), 5).float()
    return torch.cat([pictures[..., None], rows(b, s, c, "bcs")], dim=-1)[s > 0.0]


FORMS: dict[str, Callable[[Tensor, Tensor, Tensor], Any]] = {
    "boxes scores classes": lambda b, s, c: (b, s, c),
    "boxes classes scores": lambda b, s, c: (b, c, s),
    "scores boxes classes": lambda b, s, c: (s, b, c),
    "classes last of all, one column each": lambda b, s, c: (s[..., None], b, c[..., None]),
    "whole classes": lambda b, s, c: (b, s, c.long()),
    "with a count": lambda b, s, c: ((s > 0).sum(dim=1, keepdim=True).int(), b, s, c.int()),
    "other names": lambda b, s, c: {"bboxes": b, "conf": s, "cls": c},
    "names of TensorFlow": lambda b, s, c: {"detection_boxes": b, "detection_scores": s, "detection_classes": c},
    "names that say nothing": lambda b, s, c: {"x": s, "y": b, "z": c},
    "rows": rows,
    "rows, class first": lambda b, s, c: rows(b, s, c, "bcs"),
    "rows of all pictures": numbered,
    "rows of each picture": lambda b, s, c: [one[one[:, 4] > 0.0] for one in rows(b, s, c)],
    "None where nothing is": lambda b, s, c: [one if bool((one[:, 4] > 0.0).any()) else None for one in rows(b, s, c)],
    "a tuple of each picture": lambda b, s, c: list(zip(b, c, s, strict=True)),
}


PADDED = [form for form in FORMS if form != "rows of all pictures"]


@pytest.mark.filterwarnings("ignore:no gradient")
@pytest.mark.parametrize(
    ("form", "fill"), [(form, fill) for form in FORMS for fill in (0.0, -1.0, NAN) if form in PADDED or fill == 0.0]
)
def test_scores_and_classes_are_told_apart_and_rows_that_fill_up_are_nothing(form: str, fill: float) -> None:
    def made(boxes: Tensor, scores: Tensor, classes: Tensor) -> Any:
        filled = scores if fill == 0.0 else torch.where(scores > 0.0, scores, fill)
        whole = torch.where(classes.isnan(), -1.0, classes) if form in ("whole classes", "with a count") else classes
        return FORMS[form](boxes, filled, whole)

    task, output = on(Shaped(made, fill))
    (found,) = task.judge(output, TRUTH)
    assert found.right and astuple(found.prediction) == ("cup", 0, pytest.approx(0.8))
    assert task.inferred_unit == "pixels" and not task.ambiguity_message and not task.format_doubts
    assert [one.label for one in task.predictions(output, 5)[0]] == ["cup", "bowl"]
    nothing = task.judge(load_model(Shaped(made, fill), input_size=100, read=task.output_reader)(PICTURE * 2.0), TRUTH)
    assert nothing[0].prediction == Prediction("no cup", None, 0.0), "rows that fill up are no answer of NaN"


def test_what_the_numbers_leave_open_is_asked_for() -> None:
    network = Shaped(rows, classes=(1, 0), scores=(1.0, 1.0))
    with pytest.raises(
        InputError, match=r"the output does not show which of a box's two numbers is its score; say `task='detection="
    ):
        on(network)
    task, output = on(network, order="boxes scores labels")
    assert [(one.label, one.probability) for one in task.predictions(output, 2)[0]] == [("cup", 1.0), ("bowl", 1.0)]
    task, output = on(Shaped(rows, classes=(0, 1), scores=(1.0, 1.0)))
    assert task.inferred_order == "boxes scores labels", "what suppression leaves comes by falling scores"


def three() -> Rows:
    return torch.tensor([[CUP, BOWL]]), torch.tensor([[0.8, 0.6]]), torch.tensor([[0.0, 1.0]])


def middle(boxes: Tensor) -> Tensor:
    return torch.cat([(boxes[..., :2] + boxes[..., 2:]) / 2.0, boxes[..., 2:] - boxes[..., :2]], dim=-1)


@pytest.mark.parametrize(
    ("form", "unit", "doubts"),
    [
        (lambda b: b, "pixels", ""),
        (lambda b: b / 100.0, "fractions", ""),
        (middle, "pixels", "boxes: cxcywh"),
        (lambda b: torch.cat([b[..., :2], b[..., 2:] - b[..., :2]], dim=-1), "pixels", "boxes: xywh"),
        (lambda b: b[..., [1, 0, 3, 2]], "pixels", "boxes: yxyx"),
        (lambda b: 10.0 * b, "pixels", "far outside the picture"),
    ],
)
def test_the_unit_is_read_from_boxes_that_count_and_an_odd_form_is_named(
    form: Callable[[Tensor], Tensor], unit: str, doubts: str
) -> None:
    task, _ = on(Shaped(lambda b, s, c: (form(b), s, c.long())))
    assert task.inferred_unit == unit and (doubts in task.format_doubts if doubts else not task.format_doubts)
    assert [doubts in one and "may be read wrongly" in one for one in task.output_remarks] == [True] * bool(doubts)


def dense(*scores: list[float]) -> list[Detections]:
    return [{"boxes": torch.tensor([[0.2, 0.4, 0.6, 0.9]] * len(scores)), "scores": torch.tensor(scores)}]


@pytest.mark.parametrize("name", ["background", "__background__", "No Object", "N/A", "none", "no-object", "???"])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_background_is_no_prediction_wherever_it_stands(name: str, place: int) -> None:
    labels, scores = ["cup", "bowl"], [0.1, 0.2]
    labels.insert(place, name)
    scores.insert(place, 0.9)
    task = Detection(labels=tuple(labels), unit="fractions", seek="mislabel")
    truth = DetectionTruth((labels.index("cup"),), (20, 40, 60, 90), (100, 100))
    box = torch.tensor([[0.2, 0.4, 0.6, 0.9]])
    named = [{"boxes": box, "labels": torch.tensor([place]), "scores": torch.tensor([0.9])}]
    for output in (dense(scores), named):
        (found,) = task.judge(output, truth)
        assert not found.success and found.prediction.label == "no cup"
        assert isinstance(found.payload, dict) and f'"{name}"' not in json.dumps(found.payload["found"])
        assert all(one.label != name for one in task.predictions(output, 5)[0])
        hidden = DetectionTruth(truth.labels, None, (100, 100))
        assert not task.with_objective("create").judge(output, hidden)[0].success
    honest = Detection(labels=("cup", "none of the above"), unit="fractions", seek="mislabel")
    assert honest.judge(dense([0.1, 0.9]), DetectionTruth((0,), truth.box, truth.image_size))[0].success


@pytest.mark.parametrize(
    ("one", "label"),
    [
        ({"boxes": [[NAN] * 4, [0.2, 0.4, 0.6, 0.9]], "scores": [[NAN, NAN], [0.8, 0.1]]}, "cup"),
        ({"boxes": [[0.7, 0.7, 0.8, 0.8], [0.2, 0.4, 0.6, 0.9]], "scores": [[NAN, 0.1], [0.8, 0.1]]}, NOT_A_NUMBER),
        ({"boxes": [[NAN, 0.7, 0.8, 0.8], [0.2, 0.4, 0.6, 0.9]], "scores": [[0.9, 0.1], [0.8, 0.1]]}, NOT_A_NUMBER),
        ({"boxes": [[NAN, 0.7, 0.8, 0.8], [0.2, 0.4, 0.6, 0.9]], "scores": [[0.01, 0.0], [0.8, 0.1]]}, "cup"),
        ({"boxes": [[0.2, 0.4, 0.6, 0.9]], "scores": [[math.inf, 0.1]]}, NOT_A_NUMBER),
    ],
)
def test_what_is_not_a_number_is_called_that_and_what_fills_up_is_left_out(one: Any, label: str) -> None:
    task = Detection(labels=NAMES, unit="fractions")
    output = task.read([{name: torch.tensor(part) for name, part in one.items()}], 1)
    (found,) = task.judge(output, TRUTH)
    assert found.prediction.label == label and found.right is (label == "cup") and not found.success
    assert found.is_non_finite is (label == NOT_A_NUMBER) is math.isnan(found.margin)
    assert task.predictions(output)[0][0].label == label
