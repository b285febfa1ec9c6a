"""The main job on objects, environments and a classifier that nobody on this project made."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from advsearch.attacks.verification import WORST_CASE

pytestmark = pytest.mark.slow

SMALL = ["--resolution", "96", "--steps", "8", "--verify-spp", "8"]
CASES = {
    "small mug": ("mug.obj", "comfy_cafe_1k.hdr", "coffee mug,cup", 0.06, SMALL),
    "mug": ("mug.obj", "comfy_cafe_1k.hdr", "coffee mug,cup", 0.03, []),
    "mug-wide": ("mug.obj", "comfy_cafe_1k.hdr", "coffee mug,cup", 0.1, []),
    "teapot": ("teapot.obj", "artist_workshop_1k.hdr", "teapot,coffeepot", 0.1, ["--up", "y"]),
}
"""By name: mesh, environment, right answers, epsilon, more flags."""


def attack(data: Path, run: Path, case: str) -> dict[str, Any]:
    """Type the command and return what it prints."""
    mesh, environment, label, epsilon, flags = CASES[case]
    command = [sys.executable, "-m", "advsearch", "attack", "--object", str(data / "objects" / mesh)]
    command += ["--environment", str(data / "environments" / environment)]
    command += ["--model", str(data / "models" / "mobilenet_v2_imagenet.pt2")]
    command += ["--labels", str(data / "models" / "imagenet_labels.json"), "--label", label]
    command += ["--control", "texture", "--epsilon", str(epsilon), "--run", str(run), "--json", *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


TASKS = {
    "texture of a cup": ("mug", "detection", "ssd_mobilenet_v1_coco_300", "cup", ["--objective", "vanish"], "texture"),
    "patch on a cup": ("mug", "detection", "ssd_mobilenet_v1_coco_300", "cup", ["--objective", "vanish"], "patch"),
    "texture of a detected bottle": (
        "bottle", "detection", "ssd_mobilenet_v1_coco_300", "bottle", ["--objective", "vanish"], "texture",
    ),
    "patch on a detected bottle": (
        "bottle", "detection", "ssd_mobilenet_v1_coco_300", "bottle", ["--objective", "vanish"], "patch",
    ),
    "texture of a bottle": ("bottle", "segmentation", "deeplabv3_mnv2_dm05_pascal_257", "bottle", [], "texture"),
    "patch on a bottle": ("bottle", "segmentation", "deeplabv3_mnv2_dm05_pascal_257", "bottle", [], "patch"),
}  # fmt: skip
"""By name: object, task, model, right answer, more flags, control."""


@pytest.mark.parametrize("case", TASKS)
def test_a_real_detector_and_a_real_segmenter_are_fooled(case: str, real_data: Path, tmp_path: Path) -> None:
    thing, task, model, label, flags, control = TASKS[case]
    network = real_data / "models" / model
    command = [sys.executable, "-m", "advsearch", "attack", "--object", thing, "--task", task, "--label", label, *flags]
    command += ["--model", f"{network}.pt2", "--labels", f"{network}.labels.json", "--control", control]
    done = subprocess.run(
        [*command, "--run", str(tmp_path / "run"), "--json"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    control = summary["clean"]["control"]
    assert summary["ending"] == "found" and control["correct"] >= WORST_CASE.count_needed_successes(control["trials"])
    assert summary["verified"]["successes"] > summary["baseline"]["verified"]["successes"]
    assert (tmp_path / "run" / "images" / "adversarial-prediction.png").is_file()


@pytest.mark.medium
@pytest.mark.parametrize("case", CASES)
def test_a_real_object_is_fooled_and_verified(case: str, real_data: Path, tmp_path: Path) -> None:
    summary = attack(real_data, tmp_path / case, case)
    assert summary["ending"] == "found"
    assert summary["clean"]["correct"] and summary["clean"]["control"]["rate"] >= 0.95
    assert summary["verified"]["trials"] in (14, 23) and summary["verified"]["rate"] >= 0.95
    assert summary["verified"]["successes"] > summary["baseline"]["verified"]["successes"]
