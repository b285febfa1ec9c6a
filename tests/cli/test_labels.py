"""Finding the name of a class: what is like a word, `advsearch labels`, and what an object without a label is told."""

import json
import re
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch import models
from advsearch.cli.main import main
from advsearch.errors import InputError
from advsearch.models import read_labels
from advsearch.models.labels import SETS

LABELS = ("pug", "coffee mug", "frying pan, frypan", "giant panda", "cup", "mosque", "crane", "crane", "glasses")


def test_labels_are_listed_from_the_file_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "labels.json"
    file.write_text(json.dumps(LABELS), encoding="utf-8")
    monkeypatch.setattr(models, "load_model", None)
    assert main(["labels", "mug", "--model", "large.pt2", "--labels", str(file), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["labels"]
    assert found == [{"index": 1, "label": "coffee mug"}, {"index": 4, "label": "cup"}]
    assert main(["labels", "pan", "--labels", str(file)]) == 0
    assert capsys.readouterr().out == "  #2   frying pan, frypan\n  #3   giant panda\n"
    assert main(["labels", "xyzzy", "--labels", str(file)]) == 2 and "'xyzzy'" in capsys.readouterr().err


class Always(nn.Module):
    """Answers nearly the same to everything."""

    def forward(self, images: Tensor) -> Tensor:
        mean = images.mean(dim=(1, 2, 3))[:, None]
        return torch.tensor([0.0, 2.0, 1.0, -0.1, -0.2, -1.0, -2.0]) + 1e-4 * mean * torch.arange(7)


TRIANGLE = "v -1 0 0\nv 1 0 0\nv 0 0 1\nv 0 1 0\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n"


@pytest.mark.parametrize("question", ["attack", "sweep"])
def test_an_object_without_a_label_is_shown_to_the_model(question: str, tmp_path: Path) -> None:
    mesh = tmp_path / "thing.obj"
    mesh.write_text(TRIANGLE, encoding="utf-8")
    model = advsearch.load_model(Always(), labels=["a", "coffee mug", "pan, pot", "c", "d", "e", "f"], input_size=16)
    message = (
        r"^label: expected the right labels for .*thing\.obj, got none; model Always calls a clean picture of it "
        r"'coffee mug' 55 %, 'pan, pot' 20 %, 'a' 7 %, 'c' 7 %, 'd' 6 %; name what is right, such "
        r'as `label="coffee mug"`$'
    )
    with pytest.raises(InputError, match=message):
        getattr(advsearch, question)(mesh, model, controls="pose", resolution=16)
    with pytest.raises(InputError, match="coffee mug"):
        getattr(advsearch, question)("mug", model, controls="pose", resolution=16)


def test_label_sets_have_the_order_of_their_data_sets() -> None:
    sizes = {"imagenet": 1000, "cifar10": 10, "cifar100": 100, "coco": 80, "coco90": 90, "coco91": 91, "voc": 21}
    assert {name: len(read_labels(name)) for name in SETS} == sizes
    assert [read_labels("imagenet")[index] for index in (0, 504, 968, 999)] == [
        "tench", "coffee mug", "cup", "toilet tissue"
    ]  # fmt: skip
    assert [read_labels("coco91")[index] for index in (0, 1, 47, 90)] == ["background", "person", "cup", "toothbrush"]
    assert read_labels("coco90") == read_labels("coco91")[1:]
    assert [read_labels("coco")[index] for index in (0, 41, 79)] == ["person", "cup", "toothbrush"]
    assert [read_labels("cifar100")[index] for index in (0, 99)] == ["apple", "worm"]
    assert [read_labels("voc")[index] for index in (0, 5, 20)] == ["background", "bottle", "tvmonitor"]


def test_the_names_of_real_networks_are_in_the_same_order(real_data: Path) -> None:
    for name, file in (("imagenet", "imagenet_labels.json"), ("voc", "deeplabv3_mnv2_dm05_pascal_257.labels.json")):
        real = read_labels(real_data / "models" / file)
        ours = read_labels(name)
        words = [set(re.findall(r"\w+", one.casefold())) for one in ours]
        theirs = [set(re.findall(r"\w+", one.casefold())) for one in real]
        same = sum(bool(a & b) for a, b in zip(words, theirs, strict=True))
        assert same > 0.98 * len(real), name
