"""What YOLO's networks answer, in each form that they have: one cup at a known place, and noise everywhere else."""

from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch.errors import InputError
from advsearch.models import ModelWarning, load_model
from advsearch.models.labels import read_labels
from advsearch.tasks import Detection
from advsearch.tasks.boxes import DetectionTruth, compute_iou, suppress_class

CUP = (20.0, 40.0, 60.0, 90.0)
PICTURE = torch.full((100, 100, 3), 0.25)
TRUTH = DetectionTruth((1,), (20, 40, 60, 90), (100, 100))
NAMES = ("bowl", "cup", "dog")
PLACES = 21


def grid(x: Tensor, classes: int, objectness: float | None) -> Tensor:
    """Numbers of each place (N, PLACES, 4 + classes), or 5 with objectness, in pixels of a picture of 100 x 100.

    The cup, of the class before the last, is in place 5 with a probability of 0.8; a worse box of it beside that.
    """
    noise = noisy(len(x), PLACES, 4 + classes).abs() / 3.0
    boxes = torch.cat([noise[..., :2] * 100.0, noise[..., 2:4] * 20.0 + 5.0], dim=2)
    scores = 0.05 * noise[..., 4:]
    boxes[:, 5], boxes[:, 6] = torch.tensor([40.0, 65.0, 40.0, 50.0]), torch.tensor([42.0, 65.0, 40.0, 50.0])
    scores[:, 5, cup(classes)], scores[:, 6, cup(classes)] = 0.8, 0.7
    scores = (scores + 1e-3 * x.mean(dim=(1, 2, 3))[:, None, None] - 0.25e-3).clamp(0.0, 1.0)
    if objectness is None:
        return torch.cat([boxes, scores], dim=2)
    there = torch.full((len(x), PLACES, 1), 0.3)
    there[:, 5:7] = objectness
    return torch.cat([boxes, there, scores], dim=2)


def cup(classes: int) -> int:
    return max(classes - 2, 0)


def noisy(count: int, *shape: int) -> Tensor:
    """The same numbers for each picture, (count, *shape), in [-3, 3]."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(0)).clamp(-3.0, 3.0).expand(count, *shape).clone()


class Head(nn.Module):
    """Answers with a grid as `form` says."""

    def __init__(self, form: Callable[[Tensor], Any], classes: int = 3, objectness: float | None = None) -> None:
        super().__init__()
        self.form, self.classes, self.objectness = form, classes, objectness

    def forward(self, x: Tensor) -> Any:
        return self.form(grid(x, self.classes, self.objectness))


def feature_maps(numbers: Tensor) -> list[Tensor]:
    return [noisy(len(numbers), 64 + 3, side, side) for side in (8, 4, 2)]


def with_masks(numbers: Tensor) -> Tensor:
    return torch.cat([numbers, noisy(len(numbers), PLACES, 32)], dim=2)


def prototypes(numbers: Tensor) -> Tensor:
    return noisy(len(numbers), 32, 16, 16)


def free_of_suppression(numbers: Tensor) -> Tensor:
    """Rows of two corners, a score and a class by falling scores."""
    middle, size = numbers[..., :2], numbers[..., 2:4]
    best, label = numbers[..., 4:].max(dim=2)
    rows = torch.cat([middle - size / 2, middle + size / 2, best[..., None], label[..., None].float()], dim=2)
    return torch.stack([one[one[:, 4].argsort(descending=True)] for one in rows])


def first(numbers: Tensor) -> Tensor:
    return numbers.transpose(1, 2)


V8, V8_LAST, V5 = "boxes scores channels first", "boxes scores channels last", "boxes objectness scores channels last"

FORMS: dict[str, tuple[Callable[[Tensor], Any], float | None, str]] = {
    "v8": (first, None, V8),
    "v8 in training form": (lambda n: (first(n), feature_maps(n)), None, V8),
    "v8 with a mapping": (lambda n: (first(n), {"boxes": n[..., :4], "feats": feature_maps(n)}), None, V8),
    "RT-DETR": (lambda n: torch.cat([n[..., :4] / 100.0, n[..., 4:]], dim=2), None, V8_LAST),
    "RT-DETR in training form": (
        lambda n: (torch.cat([n[..., :4] / 100.0, n[..., 4:]], dim=2), (noisy(6, len(n), PLACES, 4), n[..., :4], None)),
        None,
        V8_LAST,
    ),
    "v5": (lambda n: n, 0.9, V5),
    "v5 in training form": (lambda n: (n, [noisy(len(n), 3, 8, 8, 8)]), 0.9, V5),
    "v5 of a file": (lambda n: (n, noisy(len(n), 3, 8, 8, 8), noisy(len(n), 3, 4, 4, 8)), 0.9, V5),
    "v8 with masks": (lambda n: (first(with_masks(n)), prototypes(n)), None, V8),
    "v8 with masks in training form": (
        lambda n: (first(with_masks(n)), (feature_maps(n), noisy(len(n), 32, PLACES), prototypes(n))), None, V8,
    ),
    "v5 with masks": (lambda n: (with_masks(n), prototypes(n)), 0.9, V5),
    "v10": (free_of_suppression, None, "boxes scores labels"),
    "v10 in training form": (
        lambda n: (free_of_suppression(n), {"one2many": feature_maps(n), "one2one": feature_maps(n)}),
        None,
        "boxes scores labels",
    ),
    "without suppression, with masks": (
        lambda n: (with_masks(free_of_suppression(n)), prototypes(n)), None, "boxes scores labels",
    ),
}  # fmt: skip


def on(network: nn.Module, labels: Any = NAMES, **options: Any) -> tuple[Detection, Any]:
    """The task after it has seen the picture, and the answer to it."""
    task = Detection(**options)
    model = load_model(network, input_size=100, read=task.output_reader, labels=labels)
    output = model(PICTURE)
    names = tuple(labels)
    return task.on(model).after_calibration(
        output, DetectionTruth((cup(len(names)),), TRUTH.box, TRUTH.image_size)
    ), output


@pytest.mark.filterwarnings("ignore:no gradient")
@pytest.mark.parametrize("classes", [1, 2, 3, 80])
@pytest.mark.parametrize("form", FORMS)
def test_each_form_is_read_right(form: str, classes: int) -> None:
    made, objectness, order = FORMS[form]
    names = read_labels("coco") if classes == 80 else tuple(f"thing {k}" for k in range(classes))
    task, output = on(Head(made, classes, objectness), names)
    truth = DetectionTruth((cup(classes),), TRUTH.box, TRUTH.image_size)
    (found,) = task.judge(output, truth)
    score = 0.8 * (objectness or 1.0)
    assert found.right and astuple(found.prediction) == (
        names[cup(classes)],
        cup(classes),
        pytest.approx(score, abs=1e-4),
    )
    best: Any = found.payload
    assert best["found"][0]["box"] == pytest.approx(CUP, abs=0.1)
    assert task.inferred_order == order and task.inferred_unit == ("fractions" if "RT-DETR" in form else "pixels")
    assert not task.ambiguity_message and not task.format_doubts


def more(columns: int, span: float = 0.9) -> Callable[[Tensor], Tensor]:
    """A grid with so many numbers more after those of each place, in [-span, span]."""
    return lambda n: first(torch.cat([n, noisy(len(n), PLACES, columns) / 3.0 * span], dim=2))


@pytest.mark.parametrize(
    ("form", "labels", "text"),
    [
        (more(1, span=3.0), NAMES, "angle"),
        (lambda n: first(torch.cat([n[..., :4], 9.0 * n[..., 4:] - 4.0], dim=2)), NAMES, "sigmoid"),
        (first, ["a"], "labels"),
    ],
)
@pytest.mark.filterwarnings("ignore:no gradient")
def test_other_heads_are_refused_in_a_sentence(form: Callable[[Tensor], Any], labels: Any, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        on(Head(form), labels)
    assert "\n" not in str(caught.value)


def square(numbers: Tensor) -> Tensor:
    """As many places as numbers, and boxes in shares: nothing tells one from the other."""
    return first(torch.cat([numbers[..., :4] / 100.0, numbers[..., 4:]], dim=2))


def test_what_fits_twice_is_asked_for() -> None:
    names = [f"thing {k}" for k in range(PLACES - 4)]
    with pytest.raises(InputError, match=f"{V8}.*or .*{V8_LAST}"):
        on(Head(square, len(names)), names)
    task, output = on(Head(square, len(names)), names, order=V8)
    truth = DetectionTruth((cup(len(names)),), TRUTH.box, TRUTH.image_size)
    assert (
        task.judge(output, truth)[0].prediction.probability == pytest.approx(0.8, abs=1e-4) and not task.output_remarks
    )


@pytest.mark.parametrize("order", ["boxes objectness scores", "boxes, objectness, scores, channels, first"])
def test_an_order_says_what_a_head_is(order: str) -> None:
    task, output = on(Head(first, objectness=0.9), order=order)
    assert astuple(task.judge(output, TRUTH)[0].prediction) == ("cup", 1, pytest.approx(0.72, abs=1e-4))
    assert not task.output_remarks
    with pytest.raises(InputError, match="order"):
        Detection(order="boxes objectness")


def test_a_head_of_unknown_order_has_no_masks_that_are_known() -> None:
    assert not Detection()._has_mask_coefficients([{"grid": torch.zeros(40, 21)}], order="")


@pytest.mark.parametrize("names", [dict(enumerate(NAMES)), list(NAMES)])
def test_names_and_size_come_from_the_network(names: Any) -> None:
    network: Any = Head(first)
    network.names, network.args = names, {"imgsz": 96}
    model = load_model(network, read=Detection().output_reader)
    assert model.labels == NAMES and model.input_size == (96, 96)
    assert load_model(network, read=Detection().output_reader, labels=["x", "y", "z"], input_size=64).labels == (
        "x",
        "y",
        "z",
    )


@pytest.mark.parametrize("iou", [0.3, 0.7])
def test_suppression_in_rounds_leaves_what_the_greedy_one_does(iou: float) -> None:
    numbers = torch.rand(300, 5, generator=torch.Generator().manual_seed(1))
    boxes = torch.cat([numbers[:, :2], numbers[:, :2] + 0.4 * numbers[:, 2:4]], dim=1)
    left = suppress_class(boxes, numbers[:, 4], iou).nonzero().flatten().tolist()
    waiting, greedy = numbers[:, 4].argsort(descending=True), list[int]()
    while len(waiting):
        best, waiting = waiting[0], waiting[1:]
        greedy.append(int(best))
        waiting = waiting[compute_iou(boxes[waiting], boxes[best]) < iou]
    assert left == sorted(greedy) and 10 < len(left) < 295


def test_many_boxes_that_overlap_are_suppressed_at_once() -> None:
    """8400 boxes of 80 classes: the memory of the overlaps of all pairs would be a gigabyte, one by one a minute."""
    raw = torch.rand(1, 84, 8400, generator=torch.Generator().manual_seed(0))
    raw[:, :2], raw[:, 2:4] = raw[:, :2] * 6.0 + 52.0, raw[:, 2:4] * 10.0 + 30.0
    raw[:, 4:] *= 0.09
    raw[:, 4 + 41] = raw[:, 4 + 41] * 10.0
    task = Detection(labels=read_labels("coco"), unit="pixels", order=V8, input_size=(640, 640), confidence=0.25)
    truth = DetectionTruth((41,), (35, 35, 75, 75), (640, 640))
    (found,) = task.judge(task.read(raw, 1), truth)
    assert found.prediction.label == "cup" and found.right


def test_a_file_of_onnx_says_names_and_size(tmp_path: Path) -> None:
    """As ultralytics' exporter writes it, of free sides: a constant grid, to which a little of the picture is added."""
    onnx, _ = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    make = onnx.helper
    numbers = first(grid(torch.full((1, 3, 100, 100), 0.25), 3, None))
    nodes = [
        make.make_node("ReduceMean", ["images"], ["mean"], axes=[1, 2, 3], keepdims=0),
        make.make_node("Mul", ["mean", "little"], ["add"]),
        make.make_node("Unsqueeze", ["add", "ends"], ["wide"]),
        make.make_node("Add", ["grid", "wide"], ["sum"]),
        make.make_node("Clip", ["sum", "zero"], ["output0"]),
    ]
    constants = [
        onnx.numpy_helper.from_array(numbers.numpy(), "grid"),
        onnx.numpy_helper.from_array(torch.tensor([1e-5]).numpy(), "little"),
        onnx.numpy_helper.from_array(torch.tensor(0.0).numpy(), "zero"),
        onnx.numpy_helper.from_array(torch.tensor([1, 2]).numpy(), "ends"),
    ]
    inputs = [make.make_tensor_value_info("images", 1, ["batch", 3, "height", "width"])]
    outputs = [make.make_tensor_value_info("output0", 1, ["batch", 7, PLACES])]
    graph = make.make_graph(nodes, "head", inputs, outputs, constants)
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8)
    make.set_model_props(model, {"names": str(dict(enumerate(NAMES))), "imgsz": "[100, 100]", "stride": "32"})
    onnx.save(model, str(tmp_path / "head.onnx"))
    with pytest.warns(ModelWarning, match="no gradient"):
        loaded = load_model(tmp_path / "head.onnx", read=Detection().output_reader)
    assert loaded.labels == NAMES and loaded.input_size == (100, 100)
    output = loaded(PICTURE)
    task = Detection().on(loaded).after_calibration(output, TRUTH)
    assert (
        astuple(task.judge(output, TRUTH)[0].prediction) == ("cup", 1, pytest.approx(0.8, abs=1e-3))
        and not task.format_doubts
    )
