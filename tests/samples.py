"""Whole results that tests change in one place: what a command could have answered, made without doing any work."""

from __future__ import annotations

import csv
import json
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import OpenEXR

from advsearch.engine.loading import Scene, load_scene
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import AttackSummary, CurveResult, MatrixResult, load_attack_summary
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.runs.summary import write_configuration
from advsearch.viewer.pages import write_page

if TYPE_CHECKING:
    from advsearch.questions.region.result import RegionResult

PHOTOGRAPHS = Path(__file__).resolve().parent.parent / "scenes" / "photographs"
"""Two objects in twelve photographs of 128 x 96 pixels."""


def exr(path: Path) -> np.ndarray:
    """Return the values, (H, W, 3) or (H, W) float32, in an EXR of a run."""
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        return np.array((channels["RGB"] if "RGB" in channels else channels["Y"]).pixels, dtype=np.float32)


FORMATION: dict[str, Any] = {
    "denoiser": "oidn", "filter": "box", "sampler": "multijitter", "exposure": 0.0, "resolution": [128, 128],
    "gain": 1.0,
}  # fmt: skip
RUN: dict[str, Any] = {
    "environment": "studio", "ending": "done", "seconds": {"total": 9.0}, "seed": 0, "command_line": "", "warnings": [],
}  # fmt: skip
ACCURACY = {"accuracy": 0.75, "interval": [0.35, 0.97]}
AVERAGE = {"configurations": 200, "correct": 150, "accuracy": 0.75, "interval": [0.684, 0.8084], "margin": -1.0,
           "worst_margin": 2.5}  # fmt: skip


def rated(successes: int = 20, low: float = 0.8316, high: float = 1.0, **changes: Any) -> dict[str, Any]:
    """Return a rate over 20 trials, without the answers that were given."""
    own = {"successes": successes, "trials": 20, "rate": successes / 20, "interval": [low, high], "spp": 64}
    return {**own, "labels": {}, "margin": 1.0, **changes}


ATTACK: dict[str, Any] = {
    **RUN, "schema": 2, "command": "attack", "run": "runs/mug-texture-001", "object": "mug", "model": "reference",
    "task": "classification",
    "controls": ["texture"], "epsilon": 0.1, "norm": "linf", "objective": "margin", "policy": "pgd", "ending": "found",
    "label_set": ["mug"], "goal": "a wrong answer", "target": None, "over": [], "image_formation": FORMATION,
    "gradient_plan": {"renders_per_gradient": 0, "spp": None, "groups": []},
    "light_path_segments": {"search": 6, "verification": 6},
    "clean": {"label": "mug", "index": 0, "probability": 0.98, "correct": True, "moved": [],
              "control": {"correct": 20, "trials": 20, "rate": 1.0, "interval": [0.8316, 1.0]}},
    "adversarial": {"label": "vase", "index": 7, "probability": 0.913},
    "verified": rated(labels={"vase": 20}),
    "baseline": {"policy": "random", "renders": 40, "verified": rated(1, 0.0013, 0.249)},
    "renders": {"search": 40, "gradient": 40, "verification": 21}, "steps": 40,
    "non_finite": {"objectives": 0, "gradient_elements": 0},
    "seconds": {"setup": 3.1, "search": 9.0, "verification": 2.2, "total": 14.6},
}  # fmt: skip
TARGET: dict[str, Any] = {"goal": "a target answer", "target": ["vase"]}
EASIER: dict[str, Any] = {"goal": "a right answer", "target": None}
SWEEP: dict[str, Any] = {
    **RUN, "schema": 2, "command": "sweep", "run": "runs/mug-sweep-001", "object": "mug", "model": "reference",
    "task": "classification",
    "controls": [], "ending": "finished", "image_formation": FORMATION, "configurations": 8, "planned": 8, "correct": 6,
    **ACCURACY, "not_finite": 0, "answers": {}, "axes": [], "cells": None, "worst": None, "grid": {}, "samples": 1,
    "sampler": None, "spp": 16, "renders": {"sweep": 8, "verification": 0}, "renders_per_second": None,
}  # fmt: skip
STUDY: dict[str, Any] = {
    **RUN,
    "schema": 2,
    "model": "reference",
    "task": "classification",
    "policy": "auto",
    "parts": ["a"],
}
CURVE: dict[str, Any] = {
    **STUDY, "command": "attack", "run": "runs/mug-texture-001", "objects": ["mug", "bowl"], "controls": ["texture"],
    "epsilons": [0.01, 0.1],
    "table": [
        {"object": "mug", "clean": ATTACK["clean"]["control"], "ending": "found", "epsilon": 0.1, "flips_at": 0.1,
         "verified": rated(19), "margin": 1.5},
        {"object": "bowl", "clean": None, "flips_at": None},
    ],
    "curve": [
        {"epsilon": 0.01, "objects": 4, "robust": 3, "found": 0, "already_wrong": 1, **ACCURACY},
        {"epsilon": 0.1, "objects": 0, "robust": 0, "found": 0, "already_wrong": 0, "accuracy": None,
         "interval": [0.0, 1.0]},
    ],
}  # fmt: skip
MATRIX: dict[str, Any] = {
    **STUDY, "command": "attack", "run": "runs/mug-texture-003", "objects": ["mug"], "controls": ["texture"],
    "models": ["reference", "other"], "ensemble": None, "parts": ["reference", "other"],
    "tested": [
        {"model": name, "labels": ["mug"], "input_size": [128, 128], "spp": 64, "clean": ATTACK["clean"]["control"]}
        for name in ("reference", "other")
    ],
    "table": [
        {"attacked": name, "ending": "found", "run": f"parts/{name}", "renders": {"search": 40},
         "tested": [
             {"model": other, "ending": "found" if other == name else "budget spent",
              "verified": rated(20) if other == name else rated(4, 0.057, 0.437)} for other in ("reference", "other")]}
        for name in ("reference", "other")
    ],
}  # fmt: skip
REGION: dict[str, Any] = {
    **RUN, "schema": 2, "command": "region", "run": "runs/mug-pose-002", "object": "mug", "controls": ["pose"],
    "model": "reference", "task": "classification", "verdict": "wrong", "n_same": 200, "samples": 200, "rate": 1.0,
    "interval": [0.982, 1.0],
    "volume": 0.12, "spp": 64, "image_formation": FORMATION, "clean": {"moved": []}, "renders": {"verification": 300},
    "box": [{"name": "pose.yaw", "unit": "degrees", "low": 10.0, "high": 55.5, "centre": 30.0}],
}  # fmt: skip

COUNTED = {"right": 3, "of": 97, "interval": [0.01, 0.09]}
HIGH = {"parameter": "camera.elevation", "unit": "degrees", "over": 60.0, "at_most": None, "options": [],
        "text": "camera.elevation over 60 degrees"}  # fmt: skip
EXPLAIN: dict[str, Any] = {
    **RUN, "run": "runs/mug-explain-001", "controls": ["camera"], "right": 396, "of": 600, "interval": [0.62, 0.7],
    "sweeps": ["runs/mug-sweep-001"], "object": "mug", "model": "reference", "parameters": ["camera.elevation"],
    "rules": [{**COUNTED, "conditions": [HIGH], "elsewhere": COUNTED, "confirmed": COUNTED}],
    "rejected_rule": {**COUNTED, "conditions": [HIGH], "elsewhere": COUNTED, "chance": 0.03, "p_value_limit": 0.01,
        "rows": 460},
    "importance": [{"parameters": ["camera.elevation", "light.power"], "share": 0.9, "interval": [0.8, 1.0],
                    "parts": 36}],
    "envelope": {**COUNTED, "conditions": [HIGH], "accuracy": 0.9, "confirmed": True}, "pairs": [], "renders": 0,
}  # fmt: skip
SHARE = {"accuracy": 0.75, "interval": [0.35, 0.97], "right": 6, "count": 8}
SIDE = {"objects": ["mug", "bowl"], "environments": ["studio", "noon"], "scenes": 4, "views": 8}
HARDEN: dict[str, Any] = {
    **RUN, "run": "runs/harden-texture-001", "controls": ["texture", "pose"], "objects": ["mug", "bowl"],
    "model": "reference", "task": "classification", "before": SHARE, "after": SHARE, "clean_before": SHARE,
    "clean_after": SHARE,
    "table": [
        {"control": name, "before": SHARE, "stronger_before": SHARE, "after": SHARE, "stronger": SHARE}
        for name in ("texture", "pose")
    ],
    "search": "auto, 16 steps", "stronger_search": "portfolio, 48 steps",
    "split": {"training": SIDE, "validation": SIDE, "held out": SIDE},
    "rounds": [
        {"lessons": 8 * n, "part": 0.7 * n, "clean": 1.0, "robust": 0.5, "is_selected": n == 1} for n in range(2)
    ],
    "hardened": "reference@hardened.safetensors", "weights": "hardened.safetensors", "pictures": "artifacts/pictures",
}  # fmt: skip
REPLAY: dict[str, Any] = {
    **RUN, "run": "runs/mug-replay-001", "controls": ["texture"],
    "adversarial_run": "runs/mug-texture-001", "run_ending": "found",
    "object": "mug", "model": "reference", "task": "classification", "renders": 80,
    "table": [
        {"change": "curve", "condition": "reinhard, highlights rolled off, x / (1 + x)", "ending": "found",
         "clean": ATTACK["clean"]["control"], "verified": rated()},
        {"change": "cycles", "condition": "Blender's Cycles", "ending": "not done",
         "reason": "there is no Blender here"},
    ],
}  # fmt: skip
RECIPE: dict[str, Any] = {
    **RUN, "run": "runs/recipe-001", "controls": [], "recipe": "mine.yaml", "title": "Is the mug seen?", "about": "",
    "quick": True, "objects": ["mug"], "model": "reference",
    "parts": [{"name": "views-00", "part": "views", "command": "sweep", "object": "mug", "ending": "finished",
               "renders": 8}],
    "figures": [{"figure": "rates", "title": "Accuracy by environment", "text": ["All have the same share."],
                 "columns": ["environment", "right", "of", "share", "low", "high"],
                 "rows": [["studio", 6, 8, 0.75, 0.35, 0.97]]}],
}  # fmt: skip
STABILITY: dict[str, Any] = {
    "run": "", "ending": "done", "not_run": [], "seconds": {"total": 9.0}, "command_line": "advsearch stability",
    "rows": [
        {"case": "ties", "group": "objective", "control": "pose", "finite": True, "relative_error": 0.0125,
         "ending": "found", "rule": "<b>a tie is not wrong</b>", "status": "ok", "decides": "", "holds": "",
         "checks": [], "measurements": {"condition number": 12.5}, "seconds": 1.5}],
}  # fmt: skip


def attack(**changes: Any) -> AttackSummary:
    """Return an attack's result with other fields."""
    return AttackSummary.from_values({**ATTACK, **changes})


def sweep(**changes: Any) -> SweepSummary:
    """Return a sweep's result with other fields."""
    return SweepSummary.from_values({**SWEEP, **changes})


def curve(**changes: Any) -> CurveResult:
    """Return a curve's result with other fields."""
    return CurveResult.from_values({**CURVE, **changes})


def matrix(**changes: Any) -> MatrixResult:
    """Return the result of several models with other fields."""
    return MatrixResult.from_values({**MATRIX, **changes})


def region(**changes: Any) -> RegionResult:
    """Return a region's result with other fields."""
    from advsearch.questions.region.result import RegionResult

    return RegionResult.from_values({**REGION, **changes})


SUMMARY = attack()


def make_run(path: Path, summary: AttackSummary = SUMMARY, *, pictures: bool = True, rows: bool = True) -> Path:
    """Return a run directory with stand-in pictures and results."""
    grey = np.full((8, 8, 3), 0.5)
    with RunDirectory.create_for(AttackConfig(object=summary.object, run=str(path))) as run:
        for name in ("clean", "adversarial", "difference", "verification-00", "verification-01") if pictures else ():
            run.save_image(name, grey)
        for name in ("texture", "texture-original") if pictures else ():
            run.save_image(name, grey, folder="artifacts")
        if pictures:
            run.save_animation("search", [grey, grey * 0])
        for step in range(40) if rows else ():
            run.append_rows(
                Row("search", step, objective=step / 10 - 2), Row("baseline", step, objective=-2.0 - step / 100)
            )
        run.write_summary(summary)
    return path


def make_attacked(path: Path, config: AttackConfig, u: np.ndarray) -> Path:
    """Return the directory of an attack that nobody has made, with a configuration (d,) as its answer."""
    with RunDirectory.create_for(config.model_copy(update={"run": str(path)})) as run:
        run.write_summary(attack(run=str(path), object=config.object, controls=list(config.controls)))
    write_configuration(path, np.asarray(u, dtype=np.float32))
    return path


def keep_object(run: Path) -> None:
    """Put the mug, and the same painted black and white, among what a run has to turn."""
    from advsearch.runs.directory import OBJECT_FILE
    from advsearch.scene.assets import Shape
    from advsearch.scene.glb import encode_web_glb
    from advsearch.scene.library import load_object

    mug = load_object("mug")
    squares = np.kron(np.indices((16, 16)).sum(axis=0) % 2, np.ones((8, 8)))[..., None] * np.ones(3)
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), (3.0, 0.0, 0.5)
    clean, painted = (
        Shape("object", mug.mesh, color.astype(np.float32), mug.material) for color in (mug.base_color, squares)
    )
    (run / OBJECT_FILE).parent.mkdir(parents=True, exist_ok=True)
    (run / OBJECT_FILE).write_bytes(encode_web_glb([painted], [clean], camera, "It has fewer faces here."))


def written_page(run: Path) -> Path:
    """Write the page of an attack and return its path."""
    return write_page(run, load_attack_summary(run))


def write_photograph_folder(folder: Path, name: str = "obj_000002", **entries: Any) -> Path:
    """Write the photographs of an object in scenes/photographs, each with its camera file; return the folder.

    Args:
        folder: that is made.
        name: of the object.
        **entries: further ones of the camera files.
    """
    folder.mkdir()
    for row in csv.DictReader((PHOTOGRAPHS / "photographs.csv").read_text("utf-8").splitlines()):
        if Path(row["object"]).stem == name:
            photograph = folder / Path(row["photograph"]).name
            photograph.write_bytes((PHOTOGRAPHS / row["photograph"]).read_bytes())
            camera, pose = (np.array(row[key].split(), dtype=float) for key in ("K", "pose"))
            stated = {
                "image_width": 128,
                "image_height": 96,
                "camera_matrix": camera.reshape(3, 3).tolist(),
                "part": [16, 0, 96, 96],
                "object_to_camera": [*pose.reshape(3, 4).tolist(), [0.0, 0.0, 0.0, 1.0]],
                **entries,
            }
            photograph.with_suffix(".json").write_text(json.dumps(stated), "utf-8")
    return folder


@lru_cache
def load_photographed_box() -> Scene:
    """Return a box in the photographs of a folder, of which the control `backdrop` chooses one."""
    folder = write_photograph_folder(Path(tempfile.mkdtemp()) / "photographs", set={"ground.size": 0.0})
    return load_scene(str(PHOTOGRAPHS / "models" / "obj_000002.ply"), backdrop=folder, unit="mm")
