"""The models room: preprocessing, label sets, the probe, every loader, the reference network."""

import json
import os
import pickle
import sys
import types
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from advsearch import load_model
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.models import LabelSet, Model, ModelWarning, Preprocessing, find_label_set, read_labels, reference

pytestmark = pytest.mark.usefixtures("one_thread")


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


def test_resize_is_antialiased_and_keeps_the_mean() -> None:
    stripes = torch.zeros(64, 64, 3)
    stripes[:, ::2] = 1.0
    small = Preprocessing((16, 16))(stripes[None])
    assert small.shape == (1, 3, 16, 16)
    assert float((small - 0.5).abs().max()) < 0.1  # without antialiasing every sample is 0 or 1, or aliased


@pytest.mark.parametrize(
    "options, expected",
    [
        ({}, (0.2, 0.4, 0.6)),
        ({"value_range": "-1,1"}, (-0.6, -0.2, 0.2)),
        ({"channels": "bgr"}, (0.6, 0.4, 0.2)),
        ({"mean": 0.5, "std": 0.25}, (-1.2, -0.4, 0.4)),
        ({"channels": "BGR", "value_range": (0, 255), "mean": (103, 102, 51), "std": 1}, (50.0, 0.0, 0.0)),
        ({"mean": "imagenet"}, ((0.2 - 0.485) / 0.229, (0.4 - 0.456) / 0.224, (0.6 - 0.406) / 0.225)),
    ],
)
def test_value_range_channels_and_normalisation(options: dict[str, Any], expected: tuple[float, ...]) -> None:
    model = load_model(Channels(), input_size=4, **options)
    colour = torch.tensor([0.2, 0.4, 0.6]).expand(4, 4, 3)
    torch.testing.assert_close(model(colour)[0], torch.tensor(expected), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "bad, message",
    [
        (torch.zeros(3, 8, 8), "got the shape \\(3, 8, 8\\); channels come last"),
        (torch.zeros(8, 8, 3, dtype=torch.uint8), "divide 8-bit values by 255"),
        (torch.full((8, 8, 3), 128.0), "got values from 128 to 128"),
        (np.zeros((8, 8, 3)), "got ndarray; convert it with torch.from_numpy"),
    ],
)
def test_what_is_not_an_image_is_refused(bad: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        tiny()(bad)


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
        lambda z: (z, "features"), lambda z: [z], lambda z: {"loss": None, "logits": z},
        lambda z: types.SimpleNamespace(logits=z),
    ],
)  # fmt: skip
def test_usual_containers_of_logits_are_opened(answer: Any) -> None:
    model = load_model(Answering(answer), input_size=8)
    torch.testing.assert_close(model(images()), tiny()(images()))


@pytest.mark.parametrize(
    ("answer", "named"),
    [
        (lambda z: z[:, :, None, None], "task=segmentation"),
        (lambda z: (z[:, :, None].expand(-1, -1, 4), z), "task=detection"), (lambda z: z[0], "batch"),
        (lambda z: z.argmax(1, keepdim=True).expand(-1, 3), "int64"), (lambda z: z * float("nan"), "NaN"),
    ],
)  # fmt: skip
def test_outputs_that_are_not_logits(answer: Any, named: str) -> None:
    with pytest.raises(ModelError, match=named):
        load_model(Answering(answer), input_size=8)


def test_probabilities_become_log_odds_with_one_warning() -> None:
    with pytest.warns(ModelWarning, match=r"returns probabilities") as caught:
        model = load_model(Answering(lambda z: z.softmax(1)), input_size=8)
        logits = model(images())
    assert len(caught) == 1 and model.probabilities
    torch.testing.assert_close(logits, tiny()(images()).log_softmax(1))


@pytest.mark.parametrize(
    "answer",
    [
        torch.sigmoid,
        lambda z: -z.log_softmax(1),
        lambda z: z + torch.rand_like(z),
        lambda z: z - 0.5 * z.mean(0),
        lambda z: torch.from_numpy(z.detach().numpy()),
        lambda z: 0.0 * z + torch.arange(3.0),
    ],
    ids=["sigmoid", "costs", "random", "mixes its batch", "no gradient", "zero gradient"],
)
def test_outputs_that_are_doubtful_logits_are_warned_of(answer: Callable[[Tensor], Tensor]) -> None:
    with pytest.warns(ModelWarning, match="Answering"):
        model = load_model(Answering(answer), input_size=8)
    assert not model.probabilities and model(images()).shape == (2, 3)


def test_a_network_for_single_images_is_asked_one_at_a_time() -> None:
    class Single(Tiny):
        def forward(self, x: Tensor) -> Tensor:
            return super().forward(x.view(1, 3, 8, 8))

    model = load_model(Single(), input_size=8)
    assert model.batch_limits == (1, 1)
    torch.testing.assert_close(model(images(3)), tiny()(images(3)))


LABELS = ("tench, Tinca tinca", "Coffee Mug", "cup", "crane", "teapot", "crane", "7", "missile", "projectile, missile")


@pytest.mark.parametrize(
    "text, indices",
    [
        ("coffee mug,cup", (1, 2)), ("tinca TINCA", (0,)), ("#3", (3,)), ("4", (4,)), ("7", (6,)), (["cup", 4], (2, 4)),
    ],
)  # fmt: skip
def test_label_sets(text: Any, indices: tuple[int, ...]) -> None:
    assert find_label_set(text, LABELS) == LabelSet(tuple(LABELS[i] for i in indices), indices)


@pytest.mark.parametrize(
    "text, message",
    [
        ("crane", r"label 'crane' names 2 classes: #3 \(crane\), #5 \(crane\). Give the index, e.g. '#3'"),
        ("tea pot", r"no label 'tea pot'. Did you mean 'teapot' \(#4\)"),
        ("#9", "expected a class index from 0 to 8, got 9"),
    ],
)
def test_label_sets_that_are_errors(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_label_set(text, LABELS)


@pytest.mark.parametrize(
    "name, text",
    [
        ("a.json", '["mug", "bowl", "vase"]'), ("b.json", '{"2": "vase", "0": "mug", "1": "bowl"}'),
        ("c.txt", "mug\nbowl\r\nvase\n"),
    ],
)  # fmt: skip
def test_label_files(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert tiny(labels=path).labels == read_labels(str(path)) == ("mug", "bowl", "vase")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", b'["mug", '), ("a.json", b'{"1": "mug", "2": "bowl"}'), ("a.txt", b"\xff\xfe"),
        ("a.txt", b"mug\nbowl\n"),
    ],
)  # fmt: skip
def test_label_files_that_are_errors(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=name):
        tiny(labels=tmp_path / name)


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
    with pytest.raises(FileFormatError, match=name):
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
    with pytest.raises(FileFormatError, match=r"inputs\.pt2"):
        load_model(tmp_path / "inputs.pt2")
    _repacked(exported, tmp_path / "weights.pt2", "data/weights/model.pt", evil)
    with pytest.raises(FileFormatError, match=r"unpickled, which is never done"):
        load_model(tmp_path / "weights.pt2")
    _repacked(exported, tmp_path / "object.pt2", "data/constants/opaque_obj_0", pickle.dumps(SideEffect(trace)))
    with pytest.raises(FileFormatError, match="opaque_obj_0"):
        load_model(tmp_path / "object.pt2")
    assert not trace.exists() and "TORCH_FORCE_WEIGHTS_ONLY_LOAD" not in os.environ


def test_damaged_files(tmp_path: Path, exported: Path) -> None:
    content = exported.read_bytes()
    half = content[: len(content) // 2]
    files = {"empty.pt2": b"", "short.pt2": half, "text.pt2": b"hello there", "garbage.pth": b"hello there"}
    for name, damaged in files.items():
        (tmp_path / name).write_bytes(damaged)
    _repacked(exported, tmp_path / "graph.pt2", "models/model.json", b"{}")
    for name in (*files, "graph.pt2"):
        with pytest.raises(FileFormatError, match=name):
            load_model(tmp_path / name)


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


@pytest.mark.parametrize(
    ("spec", "named"),
    [
        ("no_such_nets:Net", "no_such_nets"), ("needy_nets:Net", "not_there_at_all"),
        ("wrong_nets:Net", "ZeroDivisionError"), ("my_nets:nothing", "NoneType"),
    ],
)  # fmt: skip
def test_callables_that_are_errors(nets: Path, spec: str, named: str) -> None:
    with pytest.raises(ModelError, match=named):
        load_model(spec)
    sys.modules.pop("my_nets", None)


@pytest.mark.island("advsearch.questions.harden")
def test_reference_is_stored_and_loaded(tmp_path: Path) -> None:
    import reference_training as training

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
