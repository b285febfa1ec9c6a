"""Networks by a library's name and in ONNX files: with small stand-ins, and with the libraries where they are."""

import os
import socket
import struct
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from advsearch.errors import FileFormatError, ModelError, UnknownNameError
from advsearch.models import ModelWarning, load_model
from advsearch.models.zoo.library import report_library_errors
from advsearch.tasks import Detection
from advsearch.trust.code import allow_code_in_settings, restrict_allowed_code
from fuzz import onnx_files

pytestmark = pytest.mark.island("advsearch.models.zoo")

IMAGES = torch.rand((2, 8, 8, 3), generator=torch.Generator().manual_seed(0))


class Net(nn.Module):
    """Logits of three classes; `num_classes` and `pretrained_cfg` are what timm gives its networks."""

    num_classes = 3

    def __init__(self) -> None:
        super().__init__()
        self.pretrained_cfg: dict[str, Any] = {"label_names": ["mug", "bowl", "vase"]}
        self.weight = nn.Parameter(torch.randn((3, 3), generator=torch.Generator().manual_seed(3)))
        self.bias = nn.Parameter(torch.zeros(3))

    def forward(self, x: Tensor) -> Tensor:
        return x.mean(dim=(2, 3)) @ self.weight.T + self.bias


class Pixels(Net):
    """Logits of three classes for every pixel, as torchvision's networks give them."""

    def forward(self, x: Tensor) -> Any:
        return {"out": torch.einsum("nchw,kc->nkhw", x, self.weight), "aux": x}


class Finds(Net):
    """One box for each of a list of pictures, over the whole of it: the interface of torchvision's detectors."""

    def __init__(self, fixed_size: tuple[int, int] | None, min_size: tuple[int, ...] | int) -> None:
        super().__init__()
        self.transform = types.SimpleNamespace(fixed_size=fixed_size, min_size=min_size)

    def forward(self, images: Any) -> Any:
        assert isinstance(images, list) and len(images) <= 4
        return [self.found(image) for image in images]

    def found(self, image: Tensor) -> dict[str, Tensor]:
        _, height, width = image.shape
        return {
            "boxes": torch.tensor([[0.0, 0.0, width, height]]),
            "labels": torch.tensor([1]),
            "scores": image.mean()[None],
            "masks": image[None, :1],
        }


def expected(scale: float, shift: float, bias: Tensor) -> Tensor:
    return ((IMAGES - shift) / scale).mean(dim=(1, 2)) @ Net().weight.detach().T + bias


def unpickles(*_: object, **__: object) -> nn.Module:
    """What a library does whose weights are a pickle."""
    path = Path(sys.modules["torchvision"].weights)
    torch.load(path, weights_only=False)
    return Net()


@pytest.fixture
def torchvision(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    class Weights:
        meta: dict[str, Any] = {"categories": ["mug", "bowl", "vase"]}  # noqa: RUF012

        @staticmethod
        def transforms() -> Any:
            return types.SimpleNamespace(crop_size=[8], mean=[0.5, 0.5, 0.5], std=[0.25, 0.25, 0.25])

    class OwnResizing(Weights):
        @staticmethod
        def transforms() -> Any:
            return types.SimpleNamespace()

    def get_model(name: str, weights: object, weights_backbone: object = "default") -> nn.Module:
        assert name.startswith("tiny_net") == (weights_backbone == "default")
        library.asked = weights
        return networks[name]()

    networks: dict[str, Callable[[], nn.Module]] = {
        "tiny_net": Net,
        "tiny_pixels": Pixels,
        "tiny_rcnn": lambda: Finds(None, (16, 24)),
        "tiny_fcos": lambda: Finds(None, 20),
        "tiny_ssd": lambda: Finds((12, 10), (10,)),
    }

    library: Any = types.ModuleType("torchvision")
    library.models = types.ModuleType("torchvision.models")
    library.models.segmentation, library.models.detection = object(), object()
    names = {library.models: ["tiny_net", "vgg11"], library.models.segmentation: ["tiny_pixels"]}
    names[library.models.detection] = ["tiny_rcnn", "tiny_fcos", "tiny_ssd"]
    library.models.video, library.models.quantization = object(), object()
    names |= {library.models.video: ["tiny_3d"], library.models.quantization: ["quantized_tiny_net"]}
    library.models.list_models = lambda module: names.get(module, [])
    library.models.get_model = get_model
    library.models.get_model_weights = lambda name: types.SimpleNamespace(
        DEFAULT=(OwnResizing if name in names[library.models.detection] else Weights)()
    )
    library.weights = tmp_path / "weights.pth"
    monkeypatch.setitem(sys.modules, "torchvision", library)
    return library


def test_torchvision_brings_its_weights_and_what_belongs_to_them(torchvision: Any) -> None:
    model = load_model("torchvision:tiny_net")
    assert type(torchvision.asked).__name__ == "Weights"
    assert (model.name, model.labels, model.input_size) == ("tiny_net", ("mug", "bowl", "vase"), (8, 8))
    torch.testing.assert_close(model(IMAGES), expected(0.25, 0.5, torch.zeros(3)))


@pytest.mark.parametrize(("name", "size"), [("tiny_rcnn", (24, 24)), ("tiny_fcos", (20, 20)), ("tiny_ssd", (10, 12))])
def test_torchvision_finds_objects_at_the_size_that_it_would_resize_to(
    torchvision: Any, name: str, size: tuple[int, int]
) -> None:
    model = load_model(f"torchvision:{name}", read=Detection().output_reader)
    assert (model.input_size, model.labels, model.batch_limits) == (size, ("mug", "bowl", "vase"), (1, 4))
    assert (model.preprocessing.mean, model.preprocessing.std) == ((0.0,) * 3, (1.0,) * 3), "it normalises by itself"
    found = model(IMAGES.repeat(3, 1, 1, 1))
    assert len(found) == 6 and found[0]["boxes"].tolist() == [[0.0, 0.0, size[1], size[0]]]
    torch.testing.assert_close(found[1]["scores"], IMAGES[1].mean()[None], atol=0.02, rtol=0.0)
    assert Detection().on(model).predictions(found)[0][0].label == "bowl"
    assert load_model(f"torchvision:{name}", read=Detection().output_reader, input_size=8).input_size == (8, 8)


def test_what_a_library_unpickles_is_refused(torchvision: Any, tmp_path: Path) -> None:
    class SideEffect:
        def __reduce__(self) -> Any:
            return Path.touch, (tmp_path / "executed",)

    torch.save(SideEffect(), torchvision.weights)
    torchvision.models.get_model = unpickles
    with pytest.raises(ModelError, match="unpickled"):
        load_model("torchvision:tiny_net")
    assert not (tmp_path / "executed").exists()


@pytest.fixture
def timm(monkeypatch: pytest.MonkeyPatch) -> Any:
    def create_model(name: str, pretrained: bool) -> nn.Module:
        library.asked = (name, pretrained)
        return Net()

    library: Any = types.ModuleType("timm")
    library.is_model = lambda name: name == "tiny_net"
    library.list_models = lambda: ["tiny_net", "vgg11"]
    library.create_model = create_model
    library.data = types.SimpleNamespace(
        resolve_model_data_config=lambda module: {"input_size": (3, 8, 8), "mean": (0.5,) * 3, "std": (0.25,) * 3},
        infer_imagenet_subset=lambda module: None,
    )
    monkeypatch.setitem(sys.modules, "timm", library)
    return library


def test_a_model_that_only_a_file_names_is_fetched_from_nowhere() -> None:
    """Whatever a library does to reach a server; what it has in its cache is read all the same."""
    with socket.create_server(("127.0.0.1", 0)) as server, restrict_allowed_code():

        def fetch() -> None:
            socket.create_connection(server.getsockname(), 10.0).close()

        with pytest.raises(ModelError, match="timm:tiny"):
            with report_library_errors("timm:tiny", ""):
                fetch()
        with report_library_errors("timm:tiny", ""):
            pass
        fetch()  # outside of the block nothing is changed
        for given in ({"model": "reference,timm:tiny@own.safetensors"}, {"model": ["hf:owner/tiny"]}):
            allow_code_in_settings(given)
        for spec in ("timm:tiny", "timm:tiny@own.safetensors", "hf:owner/tiny"):
            with report_library_errors(spec, ""):
                fetch()


def test_timm_brings_its_weights_and_what_belongs_to_them(timm: Any, tmp_path: Path) -> None:
    model = load_model("timm:tiny_net.a1_in1k")
    assert timm.asked == ("tiny_net.a1_in1k", True)
    assert (model.labels, model.input_size) == (("mug", "bowl", "vase"), (8, 8))
    torch.testing.assert_close(model(IMAGES), expected(0.25, 0.5, torch.zeros(3)))
    path = tmp_path / "tiny.safetensors"
    save_file({"weight": Net().weight.detach(), "bias": torch.ones(3)}, path)
    model = load_model(f"timm:tiny_net@{path}")
    assert timm.asked == ("tiny_net", False)
    torch.testing.assert_close(model(IMAGES), expected(0.25, 0.5, torch.ones(3)))
    with pytest.raises(UnknownNameError, match="tiny_net"):
        load_model("timm:tinynet")


class Session:
    """The few functions of onnxruntime's sessions that are used."""

    shape: tuple[Any, ...] | list[Any] = ("N", 3, 8, 8)

    def __init__(self, path: str, options: object, **more: object) -> None:
        if not Path(path).read_bytes():
            raise RuntimeError("no graph was found in the protobuf")

    def get_inputs(self) -> Any:
        return [types.SimpleNamespace(name="x", type="tensor(float)", shape=list(self.shape))]

    def get_modelmeta(self) -> Any:
        return types.SimpleNamespace(custom_metadata_map={})

    def run(self, _: None, given: dict[str, Any], options: object) -> list[Any]:
        with torch.no_grad():
            return [Net()(torch.from_numpy(given["x"])).numpy()]


def stand_in_runtime(monkeypatch: pytest.MonkeyPatch) -> Any:
    runtime: Any = types.ModuleType("onnxruntime")
    runtime.SessionOptions = runtime.RunOptions = types.SimpleNamespace
    runtime.InferenceSession, runtime.__version__ = Session, "1.24.0"
    monkeypatch.setitem(sys.modules, "onnxruntime", runtime)
    return runtime


def real_onnxruntime() -> None:
    pytest.importorskip("onnxruntime", minversion="1.24", reason="onnxruntime is not installed: advsearch[onnx]")


def onnx_file(folder: Path, content: bytes) -> Path:
    path = folder / "net.onnx"
    path.write_bytes(content)
    return path


def test_onnx_by_the_real_runtime(tmp_path: Path) -> None:
    real_onnxruntime()
    path = onnx_file(tmp_path, onnx_files.weighted(onnx_files.floats("w", [1.0, -2.0, 3.0]), shape=("N", 3, 8, 8)))
    with pytest.warns(ModelWarning, match="no gradient"):
        model = load_model(path)
    torch.testing.assert_close(model(IMAGES), IMAGES.mean(dim=(1, 2)) * torch.tensor([1.0, -2.0, 3.0]))


ELSEWHERE = ["../weights.bin", "/etc/passwd", "/dev/zero", "link.bin", "folder/weights.bin", "*/_ORT_MEM_ADDR_/*"]


@pytest.mark.parametrize("in_a_node", [False, True], ids=["stored", "in a node"])
@pytest.mark.parametrize("place", ELSEWHERE)
def test_onnx_reads_nothing_elsewhere(tmp_path: Path, place: str, in_a_node: bool) -> None:
    real_onnxruntime()
    (tmp_path / "weights.bin").write_bytes(bytes(4096))
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "link.bin").symlink_to("../weights.bin")
    (inside / "folder").symlink_to("..")
    content = onnx_files.weighted(onnx_files.elsewhere("w", [3], place), as_constant=in_a_node)
    with pytest.raises(FileFormatError, match="cannot be read as ONNX"):
        load_model(onnx_file(inside, content))


def test_onnx_reads_weights_beside_it(tmp_path: Path) -> None:
    real_onnxruntime()
    (tmp_path / "own.bin").write_bytes(struct.pack("<4f", 0.0, 1.0, -2.0, 3.0))
    content = onnx_files.weighted(onnx_files.elsewhere("w", [3], "own.bin", offset="4"), shape=("N", 3, 8, 8))
    with pytest.warns(ModelWarning, match="no gradient"):
        model = load_model(onnx_file(tmp_path, content))
    torch.testing.assert_close(model(IMAGES), IMAGES.mean(dim=(1, 2)) * torch.tensor([1.0, -2.0, 3.0]))


@pytest.mark.parametrize("version", ["1.23.2", "1.9.0", "unknown"])
def test_an_onnxruntime_that_reads_elsewhere_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, version: str
) -> None:
    runtime = stand_in_runtime(monkeypatch)
    runtime.__version__ = version
    with pytest.raises(ModelError, match=version):
        load_model(onnx_file(tmp_path, b"\x08\x09"))


@pytest.mark.medium
@pytest.mark.parametrize(
    "content", [onnx_files.endless(), onnx_files.multiplied(3_000, 1_000)], ids=["loop", "products"]
)
def test_onnx_without_an_end_ends_with_one_sentence(tmp_path: Path, content: bytes) -> None:
    real_onnxruntime()
    code = "import sys; from advsearch.cli.main import main; from advsearch.trust import foreign_code; "
    code += "foreign_code.LONGEST = 40; sys.exit(main(['labels', 'mug', '--model', sys.argv[1]]))"
    command = [sys.executable, "-c", code, str(onnx_file(tmp_path, content))]
    environment = {**os.environ, "ADVSEARCH_LIMITS": "0.03"}  # 1 second
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    said = [line for line in done.stderr.splitlines() if line.startswith("advsearch: error")]
    assert done.returncode == 2 and len(said) == 1, done.stderr
    assert "no answer within 1 seconds; if you trust it, ADVSEARCH_LIMITS=10 in the environment" in said[0]


@pytest.mark.parametrize(
    ("shape", "named"), [(["N", 3, 1 << 30, 1 << 30], "67,108,864 pixels"), (["N", 3, 8], "net.onnx")]
)
def test_an_input_of_onnx_that_is_no_picture(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, shape: list[Any], named: str
) -> None:
    stand_in_runtime(monkeypatch)
    monkeypatch.setattr(Session, "shape", shape)
    with pytest.raises(ModelError, match=named):
        load_model(onnx_file(tmp_path, b"\x08\x09"))


class Steps(nn.Module):
    """Answers by colours that are rounded; a gradient comes from a slight slope."""

    def forward(self, x: Tensor) -> Tensor:
        rounded = (4.0 * x).round() / 4.0
        weight = torch.randn((192, 3), generator=torch.Generator().manual_seed(0))
        return (rounded + 1e-3 * x).flatten(1) @ weight


def test_a_masked_gradient_is_told() -> None:
    with pytest.warns(ModelWarning, match="does not say how its outputs change"):
        load_model(Steps(), input_size=8)
