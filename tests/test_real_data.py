"""The main job on objects, environments and a classifier that nobody on this project made."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from scipy.stats import binomtest

from advsearch.attacks.verification import WORST_CASE
from advsearch.runs.store import Row, Store

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


@pytest.mark.slow
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
    assert summary["ending"] == "found" and control["correct"] >= WORST_CASE.count_needed(control["trials"])
    assert summary["verified"]["successes"] > summary["baseline"]["verified"]["successes"]
    assert (tmp_path / "run" / "images" / "adversarial-prediction.png").is_file()


THINGS = {
    "detection": ("mug", "ssd_mobilenet_v1_coco_300", "cup"),
    "segmentation": ("bottle", "deeplabv3_mnv2_dm05_pascal_257", "bottle"),
}
"""By task: object, model, right answer."""


def short_attack(data: Path, run: Path, task: str, control: str, *flags: str) -> tuple[dict[str, Any], list[Row]]:
    """Search for a few steps and verify in six trials; return what is printed and the rows of both sorts of trials."""
    thing, model, label = THINGS[task]
    network = data / "models" / model
    command = [sys.executable, "-m", "advsearch", "attack", "--object", thing, "--task", task, "--label", label, *flags]
    command += ["--model", f"{network}.pt2", "--labels", f"{network}.labels.json", "--control", control]
    command += ["--steps", "6", "--spp", "8", "--trials", "6", "--verify-spp", "16", "--no-baseline"]
    done = subprocess.run([*command, "--run", str(run), "--json"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with Store(run / "results.sqlite", read_only=True) as store:
        return json.loads(done.stdout), [*store.rows("control"), *store.rows("verification")]


def boxes_in_place(payload: Any) -> set[str]:
    """The names of boxes with a score of a half that overlap the true box by a half, by the numbers that are kept."""
    true = payload["box"]
    names = set()
    for one in payload["found"]:
        sides = [min(true[k + 2], one["box"][k + 2]) - max(true[k], one["box"][k]) for k in (0, 1)]
        common = max(0.0, sides[0]) * max(0.0, sides[1])
        areas = [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in (true, one["box"])]
        if one["score"] >= 0.5 and common >= 0.5 * (sum(areas) - common):
            names.add(one["label"])
    return names


def check_outcome(summary: dict[str, Any], rows: list[Row]) -> None:
    """Whatever was found: counts are those of the rows, intervals those of the counts, and the ending follows."""
    trials = [row for row in rows if row.kind == "verification"]
    clean, verified = summary["clean"]["control"], summary["verified"]
    counts = sum(bool(row.correct) for row in rows if row.kind == "control"), sum(bool(row.success) for row in trials)
    assert (clean["correct"], verified["successes"]) == counts and len(rows) == 12
    for one, count in ((clean, counts[0]), (verified, counts[1])):
        assert one["interval"] == pytest.approx(binomtest(count, 6).proportion_ci(method="exact"), abs=1e-6)
    assert summary["clean"]["correct"] and counts[0] == 6
    assert summary["ending"] == ("found" if counts[1] == 6 else "budget spent")
    assert sum(verified["labels"].values()) == counts[1]
    scores = [row.score for row in trials if row.score is not None]
    assert verified["margin"] == pytest.approx(-sum(scores) / 6, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("control", ["pose", "light", "lens"])
def test_what_a_real_detector_does_not_see_is_in_no_box(control: str, real_data: Path, tmp_path: Path) -> None:
    summary, rows = short_attack(real_data, tmp_path / "run", "detection", control, "--objective", "vanish")
    check_outcome(summary, rows)
    for row in rows:
        right = "cup" in boxes_in_place(row.payload)
        assert right or not row.correct
        assert not right or row.kind == "control" or not row.success
    clean, moved = (summary[side]["payload"]["box"] for side in ("clean", "adversarial"))
    assert (clean != moved) == (control == "pose"), "light and dots on the lens move nothing"
    if control == "pose":
        assert summary["verified"]["margin"] < mean_margin(rows, "control") - 0.2, "the search got somewhere"


@pytest.mark.slow
@pytest.mark.parametrize("control", ["pose", "light", "lens"])
def test_what_a_real_segmenter_misses_is_most_of_the_object(control: str, real_data: Path, tmp_path: Path) -> None:
    summary, rows = short_attack(real_data, tmp_path / "run", "segmentation", control)
    check_outcome(summary, rows)
    for row in rows:
        payload: Any = row.payload
        assert row.correct == (payload["accuracy"] >= 0.5) and sum(payload["pixels"].values()) == pytest.approx(
            1, abs=0.01
        )
        assert row.probability == pytest.approx(payload["accuracy"], abs=1e-3)
        assert payload["pixels"].get("bottle", 0.0) == pytest.approx(payload["accuracy"], abs=1e-3)
    if control == "pose":
        assert summary["verified"]["margin"] < mean_margin(rows, "control") - 1.0, "the search got somewhere"


def mean_margin(rows: list[Row], kind: str) -> float:
    """The mean margin of the rows of one sort."""
    margins = [row.margin for row in rows if row.kind == kind and row.margin is not None]
    return sum(margins) / len(margins)


@pytest.mark.medium
@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_real_object_is_fooled_and_verified(case: str, real_data: Path, tmp_path: Path) -> None:
    summary = attack(real_data, tmp_path / case, case)
    assert summary["ending"] == "found"
    assert summary["clean"]["correct"] and summary["clean"]["control"]["rate"] >= 0.95
    assert summary["verified"]["trials"] in (14, 23) and summary["verified"]["rate"] >= 0.95
    assert summary["verified"]["successes"] > summary["baseline"]["verified"]["successes"]
