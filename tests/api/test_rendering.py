"""`advsearch render`: pictures before anything is searched, and what the model says of them."""

from __future__ import annotations

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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--object", "mug"], "--out: expected the path of a .png or .exr file, got nothing"),
        (
            ["--object", "mug", "--out", "room.exr/a.png"],
            "a file of that name stands where a folder is needed; choose another place with --out",
        ),
        (["--object", "mug", "--out", "a.exr", "--around", "4"], "--out: a sheet of several views has text in it"),
        (["--object", "mug", "--environment", "room.exr", "--out", "./room.exr"], "--out: would replace room.exr"),
    ],
)
def test_what_can_be_put_right_is_one_sentence(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.exr").write_bytes(b"a room")
    assert message in refused(capsys, *words)
    assert (tmp_path / "room.exr").read_bytes() == b"a room" and not (tmp_path / "a.png").exists()


def test_ground_truth_lies_beside_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    render(capsys, "--object", "mug", "--out", str(tmp_path / "a.png"), "--aov", "mask,normal")
    with OpenEXR.File(str(tmp_path / "a.aov.exr"), separate_channels=True) as file:
        found = {name: one.pixels for name, one in file.channels().items()}
    assert sorted(found) == ["mask.Y", "normal.X", "normal.Y", "normal.Z"]
    assert 0.1 < found["mask.Y"].mean() < 0.9
    assert "leave --around out" in refused(
        capsys, "--object", "mug", "--out", str(tmp_path / "b.png"), "--aov", "mask", "--around", "2"
    )
