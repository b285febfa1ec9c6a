"""The models room: preprocessing, label sets, the probe, every loader, the reference network."""

from __future__ import annotations

import json
import os
import pickle
import sys
import types
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reference_training as training
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

import conftest
from advsearch import load_model
from advsearch.errors import FileFormatError, InputError, ModelError, UnknownNameError
from advsearch.models import (
    LabelSet,
    Model,
    ModelWarning,
    Preprocessing,
    find_label_set,
    read_labels,
    reference,
)
from advsearch.models.labels import LabelsOrigin, fit_labels, list_sets_of_size
from advsearch.tasks import make_task

DATA = conftest.DATA / "models"
MOBILENET = DATA / "mobilenet_v2_imagenet.pt2"
needs_data = pytest.mark.skipif(not MOBILENET.is_file(), reason=f"real model {MOBILENET} is absent")


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Small tensors are slower with more threads, much slower if others want the processor too."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class Tiny(nn.Module):
    """Logits of three classes that depend smoothly on where and in which channel the image is bright."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.weight = nn.Parameter(torch.randn((3, 12), generator=generator))

    def forward(self, x: Tensor) -> Tensor:
        cells = nn.functional.adaptive_avg_pool2d(torch.tanh(x), 2).flatten(1)
        return cells @ self.weight.T


class Channels(nn.Module):
    """Answers with the mean of each channel, as it arrives: shows what preprocessing did."""

    def forward(self, x: Tensor) -> Tensor:
        return x.mean(dim=(2, 3))


def tiny(**options: Any) -> Model:
    return load_model(Tiny(), **{"input_size": (8, 8), **options})


def images(count: int = 2, height: int = 8, width: int = 8, seed: int = 0) -> Tensor:
    return torch.rand((count, height, width, 3), generator=torch.Generator().manual_seed(seed))


# ---------------------------------------------------------------------------------------------------------------------
# the function from images to logits


def test_one_image_and_a_batch_give_the_same_rows() -> None:
    model = tiny()
    batch = images(3)
    logits = model(batch)
    assert logits.shape == (3, 3) and logits.dtype == torch.float32
    torch.testing.assert_close(model(batch[1]), logits[1:2])


@pytest.mark.parametrize("height, width", [(8, 8), (13, 21), (5, 6)])
def test_gradient_agrees_with_central_differences(height: int, width: int) -> None:
    model = tiny(mean="imagenet", value_range=(-1, 1))
    image = 0.25 + 0.5 * images(1, height, width)[0]
    direction = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    direction /= direction.abs().max()
    leaf = image.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(model(leaf)[0, 1], leaf)
    step = 1e-2
    with torch.no_grad():
        difference = (model(image + step * direction) - model(image - step * direction))[0, 1] / (2 * step)
    # float32 rounding of the two logits over the step is the larger part of the error
    assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=2e-3, abs=2e-4)


def test_loss_linear_in_the_image_changes_by_step_times_gradient() -> None:
    model = load_model(Channels(), input_size=4)
    leaf = images(1, 4, 4).requires_grad_()
    (gradient,) = torch.autograd.grad(model(leaf)[0, 0], leaf)
    moved = model(leaf.detach() + 0.003 * gradient)[0, 0] - model(leaf.detach())[0, 0]
    assert float(moved) == pytest.approx(0.003 * float((gradient**2).sum()), rel=1e-3)


def test_resize_is_antialiased_and_keeps_the_mean() -> None:
    stripes = torch.zeros(64, 64, 3)
    stripes[:, ::2] = 1.0
    small = Preprocessing((16, 16))(stripes[None])
    assert small.shape == (1, 3, 16, 16)
    assert float((small - 0.5).abs().max()) < 0.1  # without antialiasing every sample is 0 or 1, or aliased


def test_same_size_is_not_resampled() -> None:
    batch = images(1)
    assert torch.equal(Preprocessing((8, 8))(batch), batch.permute(0, 3, 1, 2))


@pytest.mark.parametrize(
    "options, expected",
    [
        ({}, (0.2, 0.4, 0.6)),
        ({"value_range": (0, 255)}, (51.0, 102.0, 153.0)),
        ({"value_range": "-1,1"}, (-0.6, -0.2, 0.2)),
        ({"channels": "bgr"}, (0.6, 0.4, 0.2)),
        ({"mean": 0.5, "std": 0.25}, (-1.2, -0.4, 0.4)),
        ({"mean": "half"}, (-0.6, -0.2, 0.2)),
        ({"std": "0.1,0.2,0.3", "mean": [0.1, 0.2, 0.3]}, (1.0, 1.0, 1.0)),
        ({"channels": "BGR", "value_range": (0, 255), "mean": (103, 102, 51), "std": 1}, (50.0, 0.0, 0.0)),
        ({"mean": "imagenet"}, ((0.2 - 0.485) / 0.229, (0.4 - 0.456) / 0.224, (0.6 - 0.406) / 0.225)),
    ],
)
def test_value_range_channels_and_normalisation(options: dict[str, Any], expected: tuple[float, ...]) -> None:
    model = load_model(Channels(), input_size=4, **options)
    colour = torch.tensor([0.2, 0.4, 0.6]).expand(4, 4, 3)
    torch.testing.assert_close(model(colour)[0], torch.tensor(expected), rtol=1e-4, atol=1e-5)


def test_layout_nhwc_reaches_the_network_as_such() -> None:
    class Last(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            assert x.shape[1:] == (6, 4, 3) and x.is_contiguous()
            return x.mean(dim=(1, 2))

    model = load_model(Last(), input_size=(6, 4), layout="nhwc")
    colour = torch.tensor([0.2, 0.4, 0.6]).expand(6, 4, 3)
    torch.testing.assert_close(model(colour)[0], colour[0, 0])


@pytest.mark.parametrize(
    "options, message",
    [
        ({"input_size": 0}, "input_size: expected whole numbers of at least 1, got 0"),
        ({"input_size": (1, 2, 3)}, "input_size: expected one whole number"),
        ({"mean": "imagnet"}, "mean: expected one number, three numbers, or one of imagenet"),
        ({"std": 0}, "std: expected numbers greater than 0, got 0"),
        ({"std": float("nan")}, "std: expected one number"),
        ({"value_range": (1, 0)}, "value_range: expected low < high"),
        ({"layout": "CHWN"}, "layout: expected one of NCHW, NHWC, got 'CHWN'"),
        ({"channels": "GRB"}, "channels: expected one of RGB, BGR"),
        ({"max_batch": 0}, "max_batch: expected a whole number of at least 1, got 0"),
    ],
)
def test_options_out_of_range(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_model(Tiny(), **options)


@pytest.mark.parametrize(
    "bad, message",
    [
        (torch.zeros(3, 8, 8), "got the shape \\(3, 8, 8\\); channels come last"),
        (torch.zeros(8, 8), "got the shape"),
        (torch.zeros(0, 8, 8, 3), "got the shape"),
        (torch.zeros(8, 8, 3, dtype=torch.uint8), "divide 8-bit values by 255"),
        (torch.full((8, 8, 3), 128.0), "got values from 128 to 128"),
        (torch.full((8, 8, 3), -0.5), "got values from -0.5 to -0.5"),
        (np.zeros((8, 8, 3)), "got ndarray; convert it with torch.from_numpy"),
    ],
)
def test_what_is_not_an_image_is_refused(bad: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        tiny()(bad)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_non_finite_images_are_data(value: float) -> None:
    batch = images(2)
    batch[0, 0, 0, 0] = value
    logits = tiny()(batch)
    assert logits.shape == (2, 3) and bool(torch.isfinite(logits[1]).all())


def test_batches_are_cut_and_padded() -> None:
    sizes: list[int] = []

    class Counting(Tiny):
        def forward(self, x: Tensor) -> Tensor:
            sizes.append(len(x))
            return super().forward(x)

    model = load_model(Counting(), input_size=8, max_batch=4)
    sizes.clear()
    batch = images(10)
    logits = model(batch)
    assert sizes == [4, 4, 2] and logits.shape == (10, 3)
    torch.testing.assert_close(logits, tiny()(batch))


def test_other_floating_types_work_on_both_sides() -> None:
    half = load_model(Tiny().to(torch.bfloat16), input_size=8)
    assert half.dtype == torch.bfloat16
    leaf = images(1).double().requires_grad_()
    logits = half(leaf)
    logits.sum().backward()
    assert logits.dtype == torch.float32 and leaf.grad is not None and leaf.grad.dtype == torch.float64
    torch.testing.assert_close(logits.detach(), tiny()(leaf.detach()), rtol=0.05, atol=0.05)


# ---------------------------------------------------------------------------------------------------------------------
# the network that was passed stays the caller's own


def test_evaluation_mode_and_frozen_without_touching_the_original() -> None:
    first, second = nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4)
    original = nn.Sequential(first, second, nn.Dropout(0.9), nn.AdaptiveAvgPool2d(1), nn.Flatten())
    assert first.bias is not None and second.running_mean is not None
    model = load_model(original, input_size=8)
    leaf = images(4).requires_grad_()
    model(leaf).sum().backward()
    assert leaf.grad is not None and float(leaf.grad.abs().sum()) > 0
    assert all(p.requires_grad and p.grad is None for p in original.parameters())
    assert all(module.training for module in original.modules())
    assert float(second.running_mean.abs().sum()) == 0.0  # no statistics were taken
    with torch.no_grad():
        first.bias += 1.0  # in place, as an optimiser would
        before = model(leaf)
        first.bias -= 1.0
    assert not torch.allclose(before, model(leaf))


def test_a_module_that_cannot_be_copied_is_frozen_itself_with_a_warning() -> None:
    class Holding(Tiny):
        def __init__(self) -> None:
            super().__init__()
            self.file = open(os.devnull)

    net = Holding()
    with pytest.warns(ModelWarning, match=r"model Holding cannot be copied .* its parameters are frozen"):
        load_model(net, input_size=8)
    net.file.close()
    assert not net.weight.requires_grad and not net.training


def test_a_model_passes_through_and_can_be_relabelled() -> None:
    model = tiny()
    assert load_model(model) is not None and load_model(model).module is model.module
    renamed = load_model(model, labels=["mug", "bowl", "vase"], name="mine")
    assert (renamed.name, renamed.labels, renamed.named) == ("mine", ("mug", "bowl", "vase"), True)
    with pytest.raises(InputError, match=r"labels: 2 labels, but model Tiny has 3 classes"):
        load_model(model, labels=["a", "b"])
    with pytest.raises(InputError, match=r"model Tiny brings its own preprocessing: leave out mean"):
        load_model(model, mean=0.5)


# ---------------------------------------------------------------------------------------------------------------------
# the probe


class Answering(nn.Module):
    """Answers with whatever a function makes of the logits of `Tiny`."""

    def __init__(self, answer: Any) -> None:
        super().__init__()
        self.net, self.answer = Tiny(), answer

    def forward(self, x: Tensor) -> Any:
        return self.answer(self.net(x))


@pytest.mark.parametrize(
    "answer",
    [
        lambda z: (z, "features"),
        lambda z: [z],
        lambda z: {"loss": None, "logits": z},
        lambda z: types.SimpleNamespace(logits=z),
    ],
)
def test_usual_containers_of_logits_are_opened(answer: Any) -> None:
    model = load_model(Answering(answer), input_size=8)
    torch.testing.assert_close(model(images()), tiny()(images()))


@pytest.mark.parametrize(
    "answer, message",
    [
        (
            lambda z: z[:, :, None, None],
            r"logits of shape \(1, classes\), got \(1, 3, 1, 1\); a score for each pixel .*: use `task=segmentation`",
        ),
        (lambda z: (z[:, :, None].expand(-1, -1, 4), z), "boxes are what a detector gives: use `task=detection`"),
        (lambda z: [{"boxes": z}], "boxes are what a detector gives: use `task=detection`"),
        (lambda z: {"out": z[:, :, None, None]}, "got dict; a score for each pixel .*: use `task=segmentation`"),
        (lambda z: z[0], r"got \(3,\); the network dropped its batch dimension"),
        (lambda z: z[:, :1], r"got \(1, 1\); one score is not enough"),
        (lambda z: torch.cat([z, z]), r"got \(2, 3\); wrap the network"),
        (lambda z: z.argmax(1, keepdim=True).expand(-1, 3), "floating type, got torch.int64; return scores"),
        (lambda z: {"scores": z}, "got dict; wrap the network"),
        (lambda z: None, "got NoneType"),
        (lambda z: z * float("nan"), "expected finite logits, got NaN or infinity for a grey image"),
    ],
)
def test_outputs_that_are_not_logits(answer: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        load_model(Answering(answer), input_size=8)


@pytest.mark.parametrize(
    "task, answer, message",
    [
        ("detection", lambda z: z, "expected boxes .* a row of scores is what a classifier gives: use `task=classific"),
        (
            "detection",
            lambda z: z[:, :, None, None],
            "expected boxes .* what a segmenter gives: use `task=segmentation",
        ),
        ("detection", lambda z: (z[:, :, None].expand(-1, -1, 4), z), "expected boxes .* tuple; wrap the network, or"),
        ("segmentation", lambda z: z, "expected logits .* what a classifier gives: use `task=classification`"),
        ("segmentation", lambda z: [{"boxes": z}], "expected logits .* what a detector gives: use `task=detection`"),
        ("segmentation", lambda z: z[:, :1, None, None], r"expected logits .*1, 1, 1, 1\); wrap the network, or ask"),
    ],
)
def test_outputs_of_another_task_name_it(task: str, answer: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        load_model(Answering(answer), input_size=8, read=make_task(task).reader)


def test_wrong_input_size_says_what_to_pass() -> None:
    net = nn.Sequential(nn.Flatten(), nn.Linear(3 * 8 * 8, 3))
    with pytest.raises(
        ModelError, match=r"cannot be run on a RGB image of 224 x 224 .*Give the `input_size` and `layout`"
    ):
        load_model(net)
    assert load_model(net, input_size=8).input_size == (8, 8)


def test_probabilities_become_log_odds_with_one_warning() -> None:
    with pytest.warns(ModelWarning, match=r"returns probabilities") as caught:
        model = load_model(Answering(lambda z: z.softmax(1)), input_size=8)
        logits = model(images())
    assert len(caught) == 1 and model.probabilities
    torch.testing.assert_close(logits, tiny()(images()).log_softmax(1))


def test_a_probability_of_zero_keeps_a_finite_gradient() -> None:
    with pytest.warns(ModelWarning, match=r"probabilities"):
        model = load_model(Answering(lambda z: (1000 * z).softmax(1)), input_size=8)
    leaf = images(1).requires_grad_()
    model(leaf)[0].max().backward()
    assert leaf.grad is not None and bool(torch.isfinite(leaf.grad).all())


def test_log_probabilities_are_logits_already() -> None:
    model = load_model(Answering(lambda z: z.log_softmax(1)), input_size=8)
    assert not model.probabilities


def test_percentages_are_probabilities_times_100() -> None:
    with pytest.warns(ModelWarning, match=r"returns percentages that sum to 100\. Their logarithm is used"):
        model = load_model(Answering(lambda z: 100.0 * z.softmax(1)), input_size=8)
    torch.testing.assert_close(model(images()).softmax(1), tiny()(images()).softmax(1))
    with pytest.warns(ModelWarning, match=r"percentages"):
        load_model(Answering(lambda z: 100.0 * z.softmax(1) + 0.02), input_size=8)


@pytest.mark.parametrize(
    ("function", "text"),
    [
        (torch.sigmoid, r"scores in \[0, 1\] that do not sum to 1, as after a sigmoid .* They are taken for logits"),
        (lambda z: -z.log_softmax(1), r"costs, of which the least is meant"),
    ],
)
def test_scores_that_are_neither_logits_nor_probabilities_are_warned_of(
    function: Callable[[Tensor], Tensor], text: str
) -> None:
    with pytest.warns(ModelWarning, match=text):
        assert not load_model(Answering(function), input_size=8).probabilities


def test_logits_that_are_small_are_no_such_scores() -> None:
    """As those of a network that is not trained."""

    class Untrained(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return 0.4 + 0.1 * x.mean(dim=(2, 3))

    assert not load_model(Untrained(), input_size=8).probabilities


def test_a_sigmoid_is_told_where_colours_outside_of_a_picture_are_refused() -> None:
    class Refusing(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            assert bool(((x >= 0.0) & (x <= 1.0)).all()), "no picture"
            return x.mean(dim=(2, 3)).sigmoid()

    with pytest.warns(ModelWarning, match="as after a sigmoid"):
        load_model(Refusing(), input_size=8)


def test_a_random_model_is_named_as_such() -> None:
    with pytest.warns(ModelWarning, match=r"differs each time on the same image"):
        load_model(Answering(lambda z: z + torch.rand_like(z)), input_size=8)


def test_a_model_that_mixes_its_batch_is_named_as_such() -> None:
    with pytest.warns(ModelWarning, match=r"sees an image differently in a batch: was it exported in training mode"):
        load_model(Answering(lambda z: z - 0.5 * z.mean(0)), input_size=8)


@pytest.mark.parametrize(
    "answer, why",
    [
        (lambda z: torch.from_numpy(z.detach().numpy()), "does not require grad"),
        (lambda z: 0.0 * z + torch.arange(3.0), "it is zero everywhere"),
    ],
)
def test_a_model_without_gradient_is_named_as_such(answer: Any, why: str) -> None:
    with pytest.warns(ModelWarning, match=f"no gradient of model Answering reaches .*{why}"):
        model = load_model(Answering(answer), input_size=8)
    assert not model.differentiable and model(images()).shape == (2, 3)


def test_a_network_for_single_images_is_asked_one_at_a_time() -> None:
    class Single(Tiny):
        def forward(self, x: Tensor) -> Tensor:
            return super().forward(x.view(1, 3, 8, 8))

    model = load_model(Single(), input_size=8)
    assert model.batch_limits == (1, 1)
    torch.testing.assert_close(model(images(3)), tiny()(images(3)))


# ---------------------------------------------------------------------------------------------------------------------
# labels and label sets

LABELS = ("tench, Tinca tinca", "Coffee Mug", "cup", "crane", "teapot", "crane", "7", "missile", "projectile, missile")


@pytest.mark.parametrize(
    "text, indices",
    [
        ("coffee mug,cup", (1, 2)),
        ("  CUP , coffee   mug,cup", (2, 1)),
        ("tinca TINCA", (0,)),
        ("tench, Tinca tinca", (0,)),
        ("#3", (3,)),
        ("4", (4,)),
        ("7", (6,)),
        ("#7", (7,)),
        (5, (5,)),
        (["cup", 4], (2, 4)),
    ],
)
def test_label_sets(text: Any, indices: tuple[int, ...]) -> None:
    assert find_label_set(text, LABELS) == LabelSet(tuple(LABELS[i] for i in indices), indices)


@pytest.mark.parametrize(
    "text, message",
    [
        ("crane", r"label 'crane' names 2 classes: #3 \(crane\), #5 \(crane\). Give the index, e.g. '#3'"),
        ("missile", r"names 2 classes: #7 \(missile\), #8 \(projectile, missile\)"),
        ("tea pot", r"no label 'tea pot'. Did you mean 'teapot' \(#4\)"),
        ("zzz", "no label 'zzz'. Its 9 labels: tench, Tinca tinca, Coffee Mug"),
        (" , ", "expected at least one label name or class index"),
        ("#9", "expected a class index from 0 to 8, got 9"),
        ("-1", "expected a class index from 0 to 8, got -1"),
    ],
)
def test_label_sets_that_are_errors(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_label_set(text, LABELS)


def test_labels_default_to_placeholders() -> None:
    model = tiny()
    assert model.labels == ("class 0", "class 1", "class 2") and model.label_set("2").indices == (2,)
    with pytest.raises(InputError, match=r"no label 'mug'. Its 3 classes have no names: give a label file"):
        model.label_set("mug")


@pytest.mark.parametrize(
    "name, text",
    [
        ("a.json", '["mug", "bowl", "vase"]'),
        ("b.json", '{"2": "vase", "0": "mug", "1": "bowl"}'),
        ("c.txt", "mug\nbowl\r\nvase\n"),
        ("d.labels", '["mug", "bowl", "vase"]'),
    ],
)
def test_label_files(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert tiny(labels=path).labels == read_labels(str(path)) == ("mug", "bowl", "vase")


def test_labels_in_a_text_with_commas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert tiny(labels="mug, bowl,vase").labels == ("mug", "bowl", "vase")
    with pytest.raises(InputError, match=r"^labels: 2 labels, but model Net has 3 classes"):
        tiny(labels="mug,bowl", name="Net")
    monkeypatch.chdir(tmp_path)
    Path("mug,bowl").write_text("one\ntwo\nthree\n")
    assert tiny(labels="mug,bowl").labels == ("one", "two", "three"), "a file that is there goes first"


def test_a_prompt_is_not_for_classes_of_its_own() -> None:
    for given in ("reference", nn.Sequential(nn.Flatten(), nn.Linear(3 * 8 * 8, 3))):
        with pytest.raises(InputError, match=r"^prompt: model \w+ has classes of its own and reads no text; leave"):
            load_model(given, prompt="a {}", input_size=8 if given != "reference" else None)


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("a.json", b"", "expected label names, got an empty file"),
        ("a.json", b'["mug", ', "not valid JSON"),
        ("a.json", b'"mug"', "expected a list of names or an object"),
        ("a.json", b'{"1": "mug", "2": "bowl"}', "keys to be the indices 0 to 1, each once"),
        ("a.json", b'["mug", 3]', "for class 1, got 3"),
        ("a.json", b"[]", "got an empty list"),
        ("a.txt", b"mug\n\nbowl\n", "for class 1, got ''"),
        ("a.txt", b"\xff\xfe\x00", "expected a label file in UTF-8"),
        ("a.txt", b"mug\nbowl\n", "2 labels, but model Tiny has 3 classes"),
    ],
)
def test_label_files_that_are_errors(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message) as caught:
        tiny(labels=path)
    assert str(path) in str(caught.value)


def test_labels_that_are_errors(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"label file .*none.json: cannot be read"):
        tiny(labels=tmp_path / "none.json")
    with pytest.raises(InputError, match=r"labels: 4 labels, but model Tiny has 3 classes; give one per class"):
        tiny(labels=["a", "b", "c", "d"])
    with pytest.raises(InputError, match=r"^labels: 21 labels, but model Tiny has 3 classes; .* in index order$"):
        tiny(labels="voc")
    with pytest.raises(InputError, match=r"labels: expected a name .* for class 1, got 5"):
        tiny(labels=["a", 5, "c"])


# ---------------------------------------------------------------------------------------------------------------------
# files


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "tiny.pt2"
    batch = torch.export.Dim("batch", min=1, max=4)
    program = torch.export.export(Tiny().eval(), (torch.rand(2, 3, 10, 12),), dynamic_shapes=({0: batch},))
    torch.export.save(program, path)
    return path


def test_exported_program_tells_its_size_and_batch(exported: Path) -> None:
    model = load_model(str(exported), labels=["a", "b", "c"])
    assert (model.name, model.input_size, model.batch_limits) == ("tiny", (10, 12), (1, 4))
    leaf = images(6, 10, 12).requires_grad_()
    logits = model(leaf)
    torch.testing.assert_close(logits, load_model(Tiny(), input_size=(10, 12))(leaf))
    logits.sum().backward()
    assert leaf.grad is not None and float(leaf.grad.abs().min(dim=0).values.max()) > 0


def test_exported_program_with_a_fixed_batch_in_nhwc(tmp_path: Path) -> None:
    class Last(Tiny):
        def forward(self, x: Tensor) -> Tensor:
            return super().forward(x.permute(0, 3, 1, 2))

    path = tmp_path / "last.pt2"
    torch.export.save(torch.export.export(Last().eval(), (torch.rand(2, 8, 9, 3),)), path)
    model = load_model(path)
    assert (model.batch_limits, model.input_size, model.preprocessing.layout) == ((2, 2), (8, 9), "NHWC")
    torch.testing.assert_close(model(images(3, 8, 9)), load_model(Tiny(), input_size=(8, 9))(images(3, 8, 9)))


def test_exported_program_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "rows.pt2"
    torch.export.save(torch.export.export(nn.Linear(4, 3), (torch.rand(2, 4),)), path)
    with pytest.raises(
        ModelError, match=r"model rows: expected a program with one input, a batch of images of 4 dimensions"
    ):
        load_model(path)


def test_torchscript(tmp_path: Path) -> None:
    path = tmp_path / "tiny.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.trace(Tiny(), torch.rand(1, 3, 8, 8)).save(str(path))
    model = load_model(path, input_size=8)
    leaf = images(3).requires_grad_()
    logits = model(leaf)
    torch.testing.assert_close(logits, tiny()(images(3)))
    logits.sum().backward()
    assert leaf.grad is not None and float(leaf.grad.abs().sum()) > 0


class SideEffect:
    """Unpickling this makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("name", ["net.pt", "net.pth", "net.bin", "net.pt2", "net.ts"])
@pytest.mark.parametrize("form", ["zip", "legacy", "plain"])
def test_pickles_are_refused_and_not_executed(tmp_path: Path, name: str, form: str) -> None:
    path, trace = tmp_path / name, tmp_path / "executed"
    if form == "plain":
        path.write_bytes(pickle.dumps(SideEffect(trace)))
    else:
        torch.save(SideEffect(trace), path, _use_new_zipfile_serialization=form == "zip")
    with pytest.raises(
        FileFormatError, match=r"is a pickle.* never opened. Export the network instead: torch.export.save"
    ):
        load_model(path)
    assert not trace.exists()


def _repacked(source: Path, target: Path, ending: str, content: bytes) -> None:
    """Copy a zip archive with the content of the member that ends so replaced, or with a new member."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        root = old.namelist()[0].partition("/")[0]
        names = old.namelist()
        if not any(name.endswith(ending) for name in names):
            new.writestr(f"{root}/{ending}", content)
        for name in names:
            new.writestr(name, content if name.endswith(ending) else old.read(name))


def test_pickles_inside_an_exported_program_are_not_executed(tmp_path: Path, exported: Path) -> None:
    trace = tmp_path / "executed"
    torch.save(SideEffect(trace), tmp_path / "evil.pt")
    evil = (tmp_path / "evil.pt").read_bytes()
    _repacked(exported, tmp_path / "inputs.pt2", "data/sample_inputs/model.pt", evil)
    with pytest.raises(
        FileFormatError, match=r"inputs.pt2: cannot be read as torch.export .* unpickling, which is never done"
    ):
        load_model(tmp_path / "inputs.pt2")
    _repacked(exported, tmp_path / "weights.pt2", "data/weights/model.pt", evil)
    with pytest.raises(FileFormatError, match=r"unpickling, which is never done"):
        load_model(tmp_path / "weights.pt2")
    _repacked(exported, tmp_path / "object.pt2", "data/constants/opaque_obj_0", pickle.dumps(SideEffect(trace)))
    with pytest.raises(FileFormatError, match=r"holds 'data/constants/opaque_obj_0', which is a pickled object"):
        load_model(tmp_path / "object.pt2")
    assert not trace.exists() and "TORCH_FORCE_WEIGHTS_ONLY_LOAD" not in os.environ


def test_damaged_files(tmp_path: Path, exported: Path) -> None:
    content = exported.read_bytes()
    cases = {
        "empty.pt2": (b"", "expected a model, got an empty file"),
        "short.pt2": (content[: len(content) // 2], "truncated or damaged archive"),
        "text.pt2": (b"hello there", "expected a torch.export archive .* got other bytes"),
        "garbage.pth": (b"hello there", "is a pickle, or something like it"),
    }
    for name, (damaged, message) in cases.items():
        path = tmp_path / name
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=message) as caught:
            load_model(str(path))
        assert str(path) in str(caught.value)
    _repacked(exported, tmp_path / "graph.pt2", "models/model.json", b"{}")
    with pytest.raises(FileFormatError, match=r"graph.pt2: cannot be read as torch.export"):
        load_model(tmp_path / "graph.pt2")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("hello.txt", "hello")
    with pytest.raises(FileFormatError, match=r"a zip archive, but neither torch.export nor TorchScript"):
        load_model(tmp_path / "other.zip")
    with pytest.raises(FileFormatError, match=r"expected a model file, got a directory"):
        load_model(tmp_path)


def test_missing_files_name_their_neighbours(exported: Path) -> None:
    with pytest.raises(FileFormatError, match=r"tniy.pt2: no such file. Did you mean '.*tiny.pt2'"):
        load_model(exported.with_name("tniy.pt2"))
    with pytest.raises(FileFormatError, match=r"The folder .*nowhere does not exist either"):
        load_model(str(exported.parent / "nowhere" / "tiny.pt2"))


def test_safetensors_alone_are_not_a_model(tmp_path: Path) -> None:
    save_file(Tiny().state_dict(), tmp_path / "tiny.safetensors")
    with pytest.raises(FileFormatError, match=r"weights but no network; name what builds it"):
        load_model(tmp_path / "tiny.safetensors")


class _Boxes(dict[str, Tensor]):
    """What a library returns: a kind of dict that torch's trees do not know."""


class _Overwrites(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.memory = torch.zeros(1)

    def forward(self, x: Tensor) -> list[_Boxes]:
        self.memory.fill_(float(x.mean()))
        return [_Boxes(mean=self.memory) for _ in x]


def test_an_output_in_a_librarys_own_kind_of_dict_does_not_change_later() -> None:
    model = Model(_Overwrites(), "overwrites", (), Preprocessing((8, 8)), read=lambda answer, count: answer)
    dark = model(torch.zeros(8, 8, 3))
    model(torch.ones(8, 8, 3))
    assert float(dark[0]["mean"]) == 0.0


def test_unknown_names() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown model 'referense'. Did you mean 'reference'"):
        load_model("referense")
    known = "Known: hf:REPOSITORY, http://ADDRESS, https://ADDRESS, reference, timm:NAME, torchvision:NAME"
    with pytest.raises(UnknownNameError, match=rf"{known}.* library: 'torchvision:resnet50' or 'timm:resnet50'. A mod"):
        load_model("resnet50")
    with pytest.raises(InputError, match=r"write 'nets:build', without the '.py'"):
        load_model("nets.py:build")
    with pytest.raises(InputError, match=r"got the class Tiny; write Tiny\(\)"):
        load_model(Tiny)  # type: ignore[arg-type]


def test_a_count_of_labels_that_is_that_of_a_data_set_names_it() -> None:
    for count, name in ((90, "coco90"), (91, "coco91"), (21, "voc")):
        assert list_sets_of_size(count) == [name]
        with pytest.raises(InputError, match=rf"labels: 80 labels, .* in index order \(`labels={name}` has {count}\)$"):
            fit_labels(count, read_labels("coco"), LabelsOrigin(), "net")
        unnamed = fit_labels(count, None, LabelsOrigin(), "net")
        with pytest.raises(InputError, match=rf"give a label file \(`labels`\) or `labels={name}`, or an index"):
            find_label_set("mug", unnamed, named=False)
    assert list_sets_of_size(3) == []


# ---------------------------------------------------------------------------------------------------------------------
# Python code

NETS = """
import torch
from advsearch.models import load_model

class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(3, 2)
    def forward(self, x):
        return self.layer(x.mean(dim=(2, 3)))

net = Net()
number = 3

def ready():
    return load_model(Net(), input_size=4, labels=["no", "yes"])

def broken():
    raise KeyError("weights")

def nothing():
    return None
"""


@pytest.fixture
def nets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "my_nets.py").write_text(NETS)
    (tmp_path / "needy_nets.py").write_text("import not_there_at_all\n")
    (tmp_path / "wrong_nets.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    for name in ("my_nets", "needy_nets", "wrong_nets"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


def test_callables_from_the_current_directory(nets: Path) -> None:
    path = list(sys.path)
    for spec in ("my_nets:Net", "my_nets:net"):
        assert load_model(spec, input_size=4)(images()).shape == (2, 2)
    ready = load_model("my_nets:ready")
    assert ready.labels == ("no", "yes") and ready.input_size == (4, 4)
    assert sys.path == path
    sys.modules.pop("my_nets")


def test_callables_with_weights(nets: Path) -> None:
    state = {"layer.weight": torch.eye(2, 3), "layer.bias": torch.tensor([0.0, 5.0])}
    save_file(state, nets / "w.safetensors")
    model = load_model("my_nets:Net@w.safetensors", input_size=4)
    colour = torch.tensor([0.2, 0.4, 0.6]).expand(4, 4, 3)
    torch.testing.assert_close(model(colour), torch.tensor([[0.2, 5.4]]))
    save_file({"layer.weight": torch.eye(3), "other": torch.zeros(1)}, nets / "wrong.safetensors")
    message = r"do not fit model my_nets:Net: 1 missing \(layer.bias\); 1 not in the network \(other\); layer.weight is"
    with pytest.raises(ModelError, match=message):
        load_model("my_nets:Net@wrong.safetensors")
    with pytest.raises(FileFormatError, match=r"weights none.safetensors of model my_nets:Net: no such file"):
        load_model("my_nets:Net@none.safetensors")
    (nets / "bad.safetensors").write_bytes(b"hello")
    with pytest.raises(FileFormatError, match=r"expected a complete safetensors file"):
        load_model("my_nets:Net@bad.safetensors")
    sys.modules.pop("my_nets")


@pytest.mark.parametrize(
    "spec, error, message",
    [
        ("no_such_nets:Net", ModelError, "no module named 'no_such_nets' on the Python path or in "),
        ("torchvison:resnet50", ModelError, r"no module named 'torchvison' .*; did you mean 'torchvision:resnet50'\?"),
        ("needy_nets:Net", ModelError, "module 'needy_nets' needs 'not_there_at_all', which is not installed"),
        ("wrong_nets:Net", ModelError, r"importing 'wrong_nets' failed \(ZeroDivisionError: .* at .*wrong_nets.py:1\)"),
        ("my_nets:Nets", UnknownNameError, "unknown attribute of my_nets 'Nets'. Did you mean 'Net'"),
        (
            "my_nets:broken",
            ModelError,
            r"calling it without arguments failed \(KeyError: 'weights' at .*my_nets.py:19\)",
        ),
        ("my_nets:nothing", ModelError, "expected it to return an nn.Module or an advsearch Model, got NoneType"),
        ("my_nets:number", ModelError, "expected a callable or an nn.Module, got int"),
        ("my_nets:ready@w.safetensors", ModelError, "returns a ready Model, weights cannot be put into it"),
    ],
)
def test_callables_that_are_errors(nets: Path, spec: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        load_model(spec)
    sys.modules.pop("my_nets", None)


# ---------------------------------------------------------------------------------------------------------------------
# the real ImageNet classifier


@pytest.mark.medium
@needs_data
def test_mobilenet_from_the_data_folder() -> None:
    model = load_model(MOBILENET, labels=DATA / "imagenet_labels.json")
    assert (model.classes, model.input_size, model.batch_limits) == (1000, (224, 224), (1, 64))
    assert model.label_set("coffee mug,cup") == LabelSet(("coffee mug", "cup"), (504, 968))
    with pytest.raises(InputError, match=r"label 'crane' names 2 classes: #134 .*, #517"):
        model.label_set("crane")
    leaf = images(1, 100, 120).requires_grad_()
    model(leaf)[0, 504].backward()
    assert leaf.grad is not None and float(leaf.grad.abs().sum()) > 0
    flat = images(70, 1, 1).expand(70, 224, 224, 3)
    with torch.no_grad():
        logits = model(flat)
    assert logits.shape == (70, 1000)
    torch.testing.assert_close(logits[66:67], model(flat[66]), rtol=1e-3, atol=1e-3)


# ---------------------------------------------------------------------------------------------------------------------
# the reference network


def test_reference_network_is_small_and_folding_changes_nothing() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        net = reference.build(14)
        for module in net.modules():  # statistics and gains that a folding mistake would show
            if isinstance(module, nn.BatchNorm2d):
                assert module.running_mean is not None and module.running_var is not None
                nn.init.uniform_(module.weight, 0.5, 1.5)
                nn.init.normal_(module.running_mean, std=0.1)
                nn.init.uniform_(module.running_var, 0.5, 1.5)
    assert sum(value.numel() * value.element_size() for value in net.state_dict().values()) < 6e6
    x = images(2, 128, 128).permute(0, 3, 1, 2)
    with torch.no_grad():
        expected, got = net.eval()(x), reference.fold_batch_norms(net)(x)
    torch.testing.assert_close(got, expected, rtol=1e-3, atol=1e-4)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in reference.fold_batch_norms(net).modules())


def test_reference_is_stored_and_loaded(tmp_path: Path) -> None:
    net = reference.build(3)
    state = training.with_temperature(net.state_dict(), 2.0)
    weights, record = training.save(tmp_path, state, ["mug", "bowl", "vase"], {"accuracy": 0.9})
    assert weights.stat().st_size < 6e6 and json.loads(record.read_text())["figures"] == {"accuracy": 0.9}
    model = reference.load(tmp_path)
    assert (model.name, model.labels, model.input_size) == ("reference", ("mug", "bowl", "vase"), (128, 128))
    batch = images(1, 128, 128)
    with torch.no_grad():
        expected = net.eval()(batch.permute(0, 3, 1, 2)) / 2.0
    torch.testing.assert_close(model(batch), expected, rtol=1e-3, atol=1e-5)


def test_reference_files_that_are_wrong(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"the reference model is not there .* run `make reference`"):
        reference.load(tmp_path)
    training.save(tmp_path, reference.build(3).state_dict(), ["a", "b", "c"])
    record = json.loads((tmp_path / reference.METADATA).read_text())
    (tmp_path / reference.METADATA).write_text(json.dumps({**record, "labels": ["a", "b"]}))
    with pytest.raises(ModelError, match=r"are of another network; run `make reference`"):
        reference.load(tmp_path)
    (tmp_path / reference.WEIGHTS).write_bytes(b"short")
    with pytest.raises(ModelError, match=r"cannot be read .* run `make reference`"):
        reference.load(tmp_path)
    with pytest.raises(ModelError, match=r"temperature: expected a finite number greater than 0, got 0"):
        training.with_temperature({}, 0)


def test_bundled_reference_or_what_to_do() -> None:
    if (reference.get_data_folder() / reference.WEIGHTS).is_file():
        model = load_model("reference")
        assert "mug" in model.labels and model(images(1, 128, 128)).shape == (1, model.classes)
    else:
        with pytest.raises(ModelError, match=r"run `make reference`"):
            load_model("reference")
