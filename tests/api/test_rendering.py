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
from advsearch.errors import InputError
from advsearch.report.figures import GAP, LINE, MIN_TILE_WIDTH, choose_column_count, make_contact_sheet
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


@pytest.mark.medium
def test_settings_and_fixed_values_of_controls_are_in_the_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.png"
    pictures = []
    for flags in ([], ["--control", "pose={yaw: 90}"], ["--set", "pose.yaw=90"], ["--control", "pose.yaw,texture"]):
        render(capsys, "--object", "mug", "--out", str(out), *flags)
        pictures.append(read_png(out))
    plain, fixed, set_, searched = pictures
    assert np.abs(plain - fixed).max() > 0.1
    assert np.abs(fixed - set_).max() <= 2 / 255
    assert np.abs(plain - searched).max() <= 2 / 255  # a range stays where a search starts


@pytest.mark.medium
def test_around_is_one_sheet_at_one_exposure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sheet.png"
    found = render(capsys, "--object", "mug", "--out", str(out), "--around", "4", "--set", "camera.azimuth=130")
    assert [view["azimuth"] for view in found["views"]] == [130.0, 220.0, 310.0, 40.0]
    assert all(len(view["answers"]) == 5 for view in found["views"])
    sheet = read_png(out)
    assert list(sheet.shape[:2]) == found["size"]
    tile = sheet[GAP : GAP + MIN_TILE_WIDTH, GAP : GAP + MIN_TILE_WIDTH]
    scene = advsearch.load_scene("mug", settings={"camera.azimuth": 130.0})
    alone = advsearch.render(scene, resolution=16, spp=1)
    np.testing.assert_allclose(tile[::10, ::10], alone.views[0].picture.numpy(), atol=1e-6)


def test_a_person_reads_what_was_written_and_what_the_model_sees(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.png"
    assert main(["render", "--object", "mug", "--out", str(out), *SMALL]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{out}: 16 x 16 pixels" and "Model reference sees" in lines
    assert len(lines) == 3 + 5 + 2 and lines[7].endswith(" %") and lines[-1].split() == ["environment", "studio"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--object", "mug"], "--out: expected the path of a .png or .exr file, got nothing"),
        (["--object", "mug", "--out", "a.jpg"], "--out: expected the path of a .png or .exr file, got a.jpg"),
        (["--object", "mug", "--out", "folder.png"], "--out: expected the name of a file, got the folder folder.png"),
        (
            ["--object", "mug", "--out", "room.exr/a.png"],
            "a file of that name stands where a folder is needed; choose another place with --out",
        ),
        (["--object", "mug", "--out", "a.exr", "--around", "4"], "--out: a sheet of several views has text in it"),
        (["--object", "mug", "--out", "a.png", "--around", "1"], "--around: expected a whole number from 2 to 64"),
        (
            ["--object", "mug", "--out", "a.png", "--around", "4", "--control", "camera={azimuth: 3}"],
            "--around: sets camera.azimuth itself, and --control fixes it",
        ),
        (["--object", "mug", "--environment", "room.exr", "--out", "./room.exr"], "--out: would replace room.exr"),
        (["--object", "mugg", "--out", "a.png"], "unknown object 'mugg'"),
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
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "room.exr").write_bytes(b"a room")
    assert message in refused(capsys, *words)
    assert (tmp_path / "room.exr").read_bytes() == b"a room" and not (tmp_path / "a.png").exists()


def test_from_python_a_scene_or_a_name(tmp_path: Path) -> None:
    found = advsearch.render("bowl", controls={"camera": {"elevation": 60.0}}, resolution=(16, 24), spp=1)
    (view,) = found.views
    assert view.picture.shape == view.linear.shape == (16, 24, 3)
    first, second = (one.probability for one in view.predictions[:2])
    assert first is not None and second is not None and first >= second
    assert found.save(tmp_path / "a.png") == (16, 24)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), view.picture.numpy())
    with pytest.raises(InputError, match=r"expected the path of a \.png or \.exr file"):
        found.save(tmp_path / "a.txt")


def test_a_sheet_has_few_holes_and_cuts_long_names() -> None:
    assert [choose_column_count(count) for count in (1, 2, 3, 4, 6, 7, 8, 12, 24)] == [1, 2, 3, 2, 3, 3, 4, 4, 6]
    picture = np.full((16, 16, 3), 0.5, dtype=np.float32)
    sheet = make_contact_sheet([picture] * 2, [["azimuth 40", "x" * 5000], ["azimuth 220"]])
    assert sheet.shape == (2 * GAP + MIN_TILE_WIDTH + 2 * LINE, GAP + 2 * (MIN_TILE_WIDTH + GAP), 3)
    text = sheet[GAP + MIN_TILE_WIDTH :, :, 0] < 0.5
    assert (
        text[:, GAP : GAP + MIN_TILE_WIDTH].any() and not text[:, GAP + MIN_TILE_WIDTH : 2 * GAP + MIN_TILE_WIDTH].any()
    )


@pytest.mark.medium
def test_a_file_of_ones_own_with_a_network_of_ones_own(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = real_data / "models"
    found = render(
        capsys,
        *("--object", str(real_data / "objects" / "mug.obj")),
        *("--environment", str(real_data / "environments" / "comfy_cafe_1k.hdr")),
        *("--model", str(models / "mobilenet_v2_imagenet.pt2"), "--labels", str(models / "imagenet_labels.json")),
        *("--out", str(tmp_path / "a.png"), "--resolution", "224x224", "--spp", "4"),
    )
    assert {one["label"] for one in found["views"][0]["answers"]} >= {"coffee mug", "cup"}


def test_ground_truth_lies_beside_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    render(capsys, "--object", "mug", "--out", str(tmp_path / "a.png"), "--aov", "mask,normal")
    with OpenEXR.File(str(tmp_path / "a.aov.exr"), separate_channels=True) as file:
        found = {name: one.pixels for name, one in file.channels().items()}
    assert sorted(found) == ["mask.Y", "normal.X", "normal.Y", "normal.Z"]
    assert 0.1 < found["mask.Y"].mean() < 0.9
    assert "leave --around out" in refused(
        capsys, "--object", "mug", "--out", str(tmp_path / "b.png"), "--aov", "mask", "--around", "2"
    )
