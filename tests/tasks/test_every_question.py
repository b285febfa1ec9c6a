"""Every command with a detector and with a segmenter: small networks of the colours of the bundled mug, as files."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from torch import nn

import advsearch
from advsearch.questions.photographs.carry_out import Photographs
from advsearch.questions.photographs.result import find_rendering
from advsearch.runs.files import read_png
from advsearch.runs.store import Store
from advsearch.tasks import Detection
from small_models import SIDE, Finder, Painter, Slider, answer, save_exported

pytestmark = [pytest.mark.medium, pytest.mark.island("advsearch.questions.photographs", "advsearch.tasks.segmentation")]

ALSO_SLOWLY = pytest.mark.parametrize(
    "asked", ["detection", pytest.param("segmentation", marks=pytest.mark.slow)], indirect=True
)
"""What takes long is asked of segmentation among the slow tests."""


@pytest.fixture(scope="module", params=["detection", "segmentation"])
def asked(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The flags of a task with a model file, at a small size."""
    folder = tmp_path_factory.mktemp(request.param)
    network, names, label = {
        "detection": (Finder(), ["cup", "bowl", "dog"], "cup"),
        "segmentation": (Painter(), ["background", "mug", "dog"], "mug"),
    }[request.param]
    save_exported(network, folder / "net.pt2")
    (folder / "labels.json").write_text(json.dumps(names), "utf-8")
    task = "detection" if request.param == "detection" else "segmentation={accuracy: 0.7}"
    model = ["--task", task, "--model", str(folder / "net.pt2"), "--labels", str(folder / "labels.json")]
    return [*model, "--label", label, "--json"]


def task_of(asked: list[str]) -> str:
    return asked[1].partition("=")[0]


def photographed(taker: Photographs, run: Path, name: str, shift: int = 0) -> list[bool]:
    """Whether the model is right on the rendering, and on a photograph that shows it further to the right by pixels."""
    with Image.open(find_rendering(run, name)) as image, io.BytesIO() as sent:
        Image.fromarray(np.roll(np.asarray(image), shift, axis=1)).save(sent, "PNG")
        taker.add(run, name, sent.getvalue())
    with Store(run / "results.sqlite", read_only=True) as store:
        row = list(store.rows("photo"))[-1]
    assert isinstance(row.payload, dict) and isinstance(row.payload["photo"], dict)
    assert isinstance(row.payload["answer"], dict)
    return [bool(row.payload["photo"]["right"]), bool(row.correct)]


RECIPE = """
title: Is the mug found?
settings: {object: mug, environment: [studio, noon], resolution: 32, spp: 2}
parts:
  views:
    command: sweep
    settings: {controls: {camera: {azimuth: [0, 90]}}, samples: 2, sampler: random, trials: 0}
figures:
  - {figure: rates, by: environment}
"""


@ALSO_SLOWLY
def test_a_recipe_is_carried_out(asked: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(RECIPE)
    found = answer(capsys, "recipe", str(tmp_path / "mine.yaml"), "--run", str(tmp_path / "run"), *asked)
    (bars,) = found["figures"]
    assert bars["columns"][1:3] == ["right", "of"]
    assert [row[2] for row in bars["rows"]] == [2, 2] and sum(row[1] for row in bars["rows"]) > 0
    (part,) = (tmp_path / "run" / "parts").iterdir()
    assert json.loads((part / "summary.json").read_text())["task"] == task_of(asked)


SHORT = ["--spp", "2", "--verify-spp", "4", "--measure", "no", "--denoise", "none"]


def test_a_search_predicts_verifies_and_draws(
    asked: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """By a matrix of light transport; rows have the payload, blue and orange are in the pictures, and photographs are
    judged by where the object is seen in them."""
    run, detects = tmp_path / "run", task_of(asked) == "detection"
    flags = ["--epsilon", "0.2", "--steps", "16", "--trials", "6", "--spp", "2", "--verify-spp", "4", "--run", str(run)]
    found = answer(capsys, "attack", "--object", "mug", *asked, *flags)
    assert found["ending"] == "found" and found["transport"]["used"] and found["clean"]["correct"]
    assert found["objective"] == ("score" if detects else "pixel_margin")
    assert set(found["verified"]["labels"]) <= ({"bowl"} if detects else {"no mug", "mug in part"})
    kept = {"box", "found", "class"} if detects else {"accuracy", "pixels"}
    assert found["adversarial"]["payload"].keys() == {"outcome", "iou", *kept}
    with Store(run / "results.sqlite", read_only=True) as store:
        assert {type(row.payload) for row in store.rows("verification")} == {dict}
    plain, drawn = (read_png(run / "images" / f"{name}.png") for name in ("adversarial", "adversarial-prediction"))
    assert max(drawn.shape) == 512 and np.array_equal(plain, np.rint(plain * 255) / np.float32(255))
    blue = (np.abs(drawn - np.array([0, 190, 255]) / 255) < 1 / 255).all(axis=2)
    assert blue.sum() > 100, "the true box, or the outline of the mask"
    taker = Photographs()
    assert [photographed(taker, run, name) for name in ("clean", "adversarial", "verification-00")] == [
        [True, True], [False, False], [False, False]
    ]  # fmt: skip
    assert photographed(taker, run, "clean", SIDE // 2) == [True, False]


@ALSO_SLOWLY
def test_a_stopped_search_goes_on_with_the_same_words(
    asked: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    command = ["attack", "--object", "mug", "--control", "pose", *asked, *SHORT, "--policy", "random", "--steps", "4"]
    first = answer(capsys, *command, "--trials", "6", "--run", str(tmp_path / "run"))
    (tmp_path / "run" / "summary.json").unlink()
    again = answer(capsys, "resume", str(tmp_path / "run"), "--json")
    for name in ("clean", "adversarial", "verified", "ending"):
        assert again[name] == first[name]


def test_a_sweep_counts_and_keeps_the_worst(
    asked: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    swept = answer(
        capsys, "sweep", "--object", "mug", *asked, "--grid", "pose.yaw=0,180", "--grid", "camera.elevation=25,85",
        "--denoise", "none", "--spp", "2", "--trials", "6", "--verify-spp", "4", "--surface", "--keep-pictures", "all",
        "--run", str(tmp_path / "run"),
    )  # fmt: skip
    tables = swept["surface"]["tables"]
    assert {table["part"]: table["visible"] > 500 for table in tables} == {"cell": True, "face": True}
    assert swept["configurations"] == 4 and swept["worst"]["claimed"]["payload"] is not None
    assert (tmp_path / "run" / "images" / "worst-prediction.png").is_file()
    taker = Photographs()
    assert photographed(taker, tmp_path / "run", "0") == [True, True]
    assert photographed(taker, tmp_path / "run", "0", SIDE // 2) == [True, False]


@ALSO_SLOWLY
def test_a_configuration_that_holds_for_many_conditions(
    asked: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Every condition has a true box or mask of its own."""
    flags = ["--over", "camera={azimuth: [35, 45]}", "--draws", "2", "--steps", "4", "--trials", "8"]
    found = answer(
        capsys, "attack", "--object", "mug", "--epsilon", "0.3", *asked, *SHORT, *flags, "--run", str(tmp_path / "run")
    )
    assert found["verified"]["trials"] == 8 and found["over"] == ["camera"]


@pytest.mark.parametrize(
    ("objective", "network", "controls", "said"),
    [
        ("displace", Slider(), {"texture": {"epsilon": 0.4}}, "cup elsewhere"),
        ("create", Finder(), {"background": {}}, "dog elsewhere"),
    ],
)
def test_a_box_elsewhere_is_sought_by_its_objective(
    objective: str, network: nn.Module, controls: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """From the search to the drawn picture, with the clean scene right and no such box in it."""
    names = ["cup", "bowl", "dog"][: 2 if objective == "displace" else 3]
    model = advsearch.load_model(
        network, labels=names, input_size=SIDE, read=Detection().output_reader, name="stand-in"
    )  # fmt: skip
    result = advsearch.attack(
        "mug", model, task="detection", label="cup", objective=objective, controls=controls, steps=24, trials=6, spp=2,
        verify_spp=4, denoise="none", measure="no", baseline=False, run=tmp_path / "run",
        policy="random" if objective == "create" else "auto",
    )  # fmt: skip
    summary = result.summary
    assert summary.ending == "found" and summary.clean.control and summary.clean.control.correct == 6
    assert summary.clean.label == "cup" and summary.verified and set(summary.verified.labels) == {said}
    assert (tmp_path / "run" / "images" / "adversarial-prediction.png").is_file()
