"""`advsearch render`: pictures before anything is searched, and what the model says of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch

import advsearch
import samples
from advsearch.cli.main import main
from advsearch.runs.files import read_png
from advsearch.scene.color import linear_to_srgb

SMALL = ["--resolution", "16", "--spp", "1", "--quiet"]


def render(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    """Type the command and return the JSON that it prints."""
    status = main(["render", *SMALL, *words, "--json"])
    out, err = capsys.readouterr()
    assert status == 0, err
    found: dict[str, Any] = json.loads(out)
    return found


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Type the command and return the message with which it is refused."""
    assert main(["render", *words, *SMALL]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    return err


@pytest.mark.medium
def test_a_picture_and_the_five_first_predictions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    png, exr = tmp_path / "new" / "a.png", tmp_path / "a.exr"
    found = render(capsys, "--object", "mug", "--out", str(png))
    assert (found["out"], found["size"], found["object"]) == (str(png), [16, 16], "mug")
    assert found["image_formation"]["gain"] > 0.0 and not found.keys() & found["image_formation"].keys()
    (view,) = found["views"]
    answers = view["answers"]
    model = advsearch.load_model("reference")
    picture = torch.from_numpy(read_png(png))
    probabilities = model(picture)[0].softmax(dim=0)
    assert [one["index"] for one in answers] == probabilities.topk(5).indices.tolist()
    assert [one["label"] for one in answers] == [model.labels[one["index"]] for one in answers]
    assert answers[0]["probability"] == pytest.approx(float(probabilities.max()), abs=1e-5)
    render(capsys, "--object", "mug", "--out", str(exr))
    linear = samples.exr(exr)  # the same picture before the tone curve
    assert np.abs(linear_to_srgb(linear) - picture.numpy()).max() <= 0.5 / 255 + 1e-4


def test_ground_truth_lies_beside_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    render(capsys, "--object", "mug", "--out", str(tmp_path / "a.png"), "--aov", "mask,normal")
    with OpenEXR.File(str(tmp_path / "a.aov.exr"), separate_channels=True) as file:
        found = {name: one.pixels for name, one in file.channels().items()}
    assert sorted(found) == ["mask.Y", "normal.X", "normal.Y", "normal.Z"]
    assert 0.1 < found["mask.Y"].mean() < 0.9
    assert "leave --around out" in refused(
        capsys, "--object", "mug", "--out", str(tmp_path / "b.png"), "--aov", "mask", "--around", "2"
    )
