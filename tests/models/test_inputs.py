"""What networks take beside or in place of floating-point pictures: sizes, whole numbers, colors from 0 to 255."""

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch.errors import InputError
from advsearch.models import ModelWarning, load_model
from advsearch.tasks.detection import Detection
from fuzz import onnx_files

HEIGHT = 32
WIDTH = 64
GREY = torch.full((1, HEIGHT, WIDTH, 3), 0.5)
NO_GRADIENT = r"ignore:no gradient of model:advsearch.models.ModelWarning"


class Sized(nn.Module):
    """A detector that is exported as RT-DETR is: one box over the left half of the picture, and its brightness."""

    def forward(self, images: Tensor, orig_target_sizes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        scores = images.mean((1, 2, 3))[:, None]
        part = torch.tensor([0.0, 0.0, 0.5, 1.0])
        boxes = torch.cat([orig_target_sizes, orig_target_sizes], dim=1)[:, None] * part
        return torch.zeros_like(scores).long(), boxes, scores


def example() -> tuple[Tensor, Tensor]:
    return torch.zeros(2, 3, HEIGHT, WIDTH), torch.tensor([[WIDTH, HEIGHT]] * 2)


def exported(network: nn.Module, folder: Path) -> Path:
    path = folder / "net.pt2"
    batch = torch.export.Dim("batch", min=1, max=8)
    shapes = ({0: batch}, {0: batch})
    torch.export.save(torch.export.export(network.eval(), example(), dynamic_shapes=shapes), path)
    return path


def scripted(network: nn.Module, folder: Path) -> Path:
    path = folder / "net.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.trace(network.eval(), example()), str(path))
    return path


def sized_onnx(folder: Path, name: str = "orig_target_sizes") -> Path:
    """Write the detector `Sized`, whose second input has a name."""
    nodes = [
        onnx_files.node("ReduceMean", ["images"], ["m"], onnx_files.numbers("axes", 1, 2, 3)),
        onnx_files.node("Reshape", ["m", "column"], ["scores"]),
        onnx_files.node("Cast", [name], ["size"], onnx_files.number("to", onnx_files.FLOAT)),
        onnx_files.node("Concat", ["size", "size"], ["sizes"], onnx_files.number("axis", 1)),
        onnx_files.node("Unsqueeze", ["sizes", "one"], ["row"]),
        onnx_files.node("Mul", ["row", "part"], ["boxes"]),
        onnx_files.node("Sub", ["scores", "scores"], ["nothing"]),
        onnx_files.node("Cast", ["nothing"], ["labels"], onnx_files.number("to", onnx_files.INT64)),
    ]
    stored = [
        onnx_files.integers("column", -1, 1),
        onnx_files.integers("one", 1),
        onnx_files.floats("part", [0.0, 0.0, 0.5, 1.0], (1, 1, 4)),
    ]
    inputs = [onnx_files.value("images", ["N", 3, HEIGHT, WIDTH]), onnx_files.value(name, ["N", 2], onnx_files.INT64)]
    outputs = [
        onnx_files.value("labels", ["N", 1], onnx_files.INT64),
        onnx_files.value("boxes", ["N", 1, 4]),
        onnx_files.value("scores", ["N", 1]),
    ]
    path = folder / "net.onnx"
    path.write_bytes(onnx_files.model(onnx_files.graph(nodes, stored, inputs, outputs)))
    return path


@pytest.mark.filterwarnings(NO_GRADIENT)
@pytest.mark.parametrize("form", ["module", "exported", "scripted", "onnx"])
def test_a_detector_gets_the_width_and_the_height_of_its_pictures(tmp_path: Path, form: str) -> None:
    spec: Any
    if form == "module":
        spec = Sized()
    elif form == "exported":
        spec = exported(Sized(), tmp_path)
    elif form == "scripted":
        spec = scripted(Sized(), tmp_path)
    else:
        pytest.importorskip("onnxruntime", minversion="1.24")
        spec = sized_onnx(tmp_path)
    model = load_model(spec, input_size=(HEIGHT, WIDTH), labels=["mug", "bowl"], task=Detection())
    (found,) = model(GREY)
    assert found["boxes"].tolist() == [[0.0, 0.0, WIDTH / 2, HEIGHT]]
    assert float(found["scores"][0]) == pytest.approx(0.5)
    assert model.differentiable == (form != "onnx")


class Bright(nn.Module):
    """A classifier by the brightness of pictures from 0 to 255, (N, H, W, 3) in uint8 or (N, 3, H, W) in float32."""

    def forward(self, images: Tensor) -> Tensor:
        score = images.float().mean((1, 2, 3))[:, None] - 127.5
        return torch.cat([-score, score], dim=1)


def eight_bit_onnx(folder: Path) -> Path:
    nodes = [
        onnx_files.node("Cast", ["x"], ["f"], onnx_files.number("to", onnx_files.FLOAT)),
        onnx_files.node("ReduceMean", ["f"], ["m"], onnx_files.numbers("axes", 1, 2, 3)),
        onnx_files.node("Reshape", ["m", "column"], ["c"]),
        onnx_files.node("Sub", ["c", "half"], ["d"]),
        onnx_files.node("Mul", ["d", "signs"], ["y"]),
    ]
    stored = [
        onnx_files.integers("column", -1, 1),
        onnx_files.floats("half", [127.5]),
        onnx_files.floats("signs", [-1.0, 1.0], (1, 2)),
    ]
    inputs = [onnx_files.value("x", ["N", HEIGHT, WIDTH, 3], 2)]
    path = folder / "net.onnx"
    path.write_bytes(onnx_files.model(onnx_files.graph(nodes, stored, inputs, [onnx_files.value("y", ["N", 2])])))
    return path


@pytest.mark.parametrize("form", ["exported", "onnx"])
def test_a_network_of_whole_numbers_gets_these(tmp_path: Path, form: str) -> None:
    if form == "onnx":
        pytest.importorskip("onnxruntime", minversion="1.24")
        path = eight_bit_onnx(tmp_path)
    else:
        path = tmp_path / "net.pt2"
        pictures = torch.zeros(1, HEIGHT, WIDTH, 3, dtype=torch.uint8)
        torch.export.save(torch.export.export(Bright(), (pictures,)), path)
    with pytest.warns(ModelWarning, match="uint8"):
        model = load_model(path)
    # 0.5 is 127.5, which rounds to 128
    torch.testing.assert_close(model(GREY), torch.tensor([[-0.5, 0.5]]))
    assert model.preprocessing.layout == "NHWC" and not model.differentiable
    with pytest.raises(InputError, match="value_range"):
        load_model(path, value_range=(0.0, 1.0))
