"""`sweep --surface`: which parts of the surface, when seen, go with wrong predictions."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.cli.main import main
from advsearch.models import Model
from advsearch.questions.sweep import surface
from advsearch.questions.sweep.summary import SurfaceTable, SweepSummary
from advsearch.questions.sweep.surface import MIN_IMAGES, SurfaceCounts
from advsearch.runs import store
from advsearch.scene import library
from advsearch.scene.surface_parts import MAP_SIZE
from advsearch.tasks import make_task

pytestmark = pytest.mark.medium

SIDE = 48
LABELS = ("mug", "vase")
PATCH = (0.34, 0.42, 0.15, 0.3)
"""Ends in u and v of what is blue on the mug."""


def blue(images: Tensor) -> Tensor:
    """Over 0 where something is blue, (N,)."""
    return (images[:, 2] - images[:, :2].amax(dim=1)).amax(dim=(1, 2)) - 0.25


class Startled(nn.Module):
    """Takes the mug for a vase where it sees blue."""

    def forward(self, images: Tensor) -> Tensor:
        score = 40.0 * blue(images)
        return torch.stack([-score, score], dim=1)


class Never(nn.Module):
    """Is always right."""

    def forward(self, images: Tensor) -> Tensor:
        score = 5.0 + images.mean(dim=(1, 2, 3))
        return torch.stack([score, -score], dim=1)


def network(module: nn.Module, size: int, task: Any) -> Model:
    return advsearch.load_model(
        module, labels=LABELS, input_size=size, name=type(module).__name__, read=make_task(task).output_reader
    )


def mug() -> advsearch.Scene:
    """The mug in grey, with a blue patch."""
    asset = library.load_object("mug")
    colours = np.full((128, 128, 3), 0.5, np.float32)
    left, right, low, high = (round(128 * end) for end in PATCH)
    colours[128 - high : 128 - low, left:right] = (0.0, 0.0, 0.9)
    return advsearch.load_scene(replace(asset, base_color=colours))


def swept(run: Path, *modules: nn.Module, **options: Any) -> SweepSummary:
    task = options.get("task", "classification")
    models = [network(one, SIDE - 8 * number, task) for number, one in enumerate(modules)]
    grid = {"pose.yaw": "0:360:20", "camera.elevation": [10]}
    given: dict[str, Any] = {"label": "mug", "spp": 1, "trials": 0, "surface": True, "denoise": "none", **options}
    return advsearch.sweep(mug(), models, grid, run=run, **given).summary


def counts_of(run: Path) -> dict[str, Any]:
    with np.load(run / "artifacts" / "surface.npz", allow_pickle=False) as file:
        return dict(file)


def inside(u: Any, v: Any, margin: float) -> Any:
    left, right, low, high = PATCH
    return (left + margin < u) & (u < right - margin) & (low + margin < v) & (v < high - margin)


def is_the_patch(table: SurfaceTable, run: Path) -> None:
    """Check that a map lights up the patch, and nothing far from it."""
    first = table.strongest[0]
    assert abs(first.u - 0.38) < 0.08 and first.v < 0.4 and first.p <= 0.02  # what is above it is seen with it
    assert first.visible.accuracy is not None and first.visible.accuracy < 0.2 and first.hidden.correct > MIN_IMAGES
    assert first.interval[0] < first.difference <= first.interval[1] and first.interval[0] > 0.3
    found = counts_of(run)
    row, column = np.divmod(np.arange(MAP_SIZE**2), MAP_SIZE)
    middle = inside((column + 0.5) / MAP_SIZE, 1 - (row + 0.5) / MAP_SIZE, 0.01)
    p, difference = (found[f"{name}_0"][0, : MAP_SIZE**2] for name in ("p", "difference"))
    assert middle.sum() > 20 and (p[middle] <= 0.05).mean() > 0.9 and difference[middle].min() > 0.5
    worse = ((p <= 0.05) & (difference > 0)).reshape(MAP_SIZE, MAP_SIZE).sum(axis=0)
    assert (
        worse.sum() == table.worse and worse[round(0.28 * MAP_SIZE) : round(0.52 * MAP_SIZE)].sum() > 0.9 * table.worse
    )


def test_a_patch_that_goes_with_failures_lights_up_and_no_other_model_s(tmp_path: Path) -> None:
    run = tmp_path / "run"
    summary = swept(run, Startled(), Never())
    assert summary.surface is not None
    tables = {(one.model, one.part): one for one in summary.surface.tables}
    assert list(tables) == [(name, part) for name in ("Startled", "Never") for part in ("cell", "face")]
    is_the_patch(tables["Startled", "cell"], run)
    faces = tables["Startled", "face"].strongest
    assert faces[0].p <= 0.02 and faces[0].difference > 0.5 and abs(faces[0].u - 0.38) < 0.08
    for part in ("cell", "face"):
        calm = tables["Never", part]
        assert calm.compared > 300 and not calm.worse + calm.better and not calm.strongest
    found = counts_of(run)
    assert list(found["objects"]) == ["mug"] and list(found["models"]) == ["Startled", "Never"]
    assert found["pictures_0"].tolist() == [20, 20] and found["failures_0"][1] == 0
    assert (found["wrong_0"] <= found["seen_0"]).all() and found["map_0"].shape == (5504, 3, 2)


def test_a_stopped_sweep_and_one_that_is_asked_afterwards_have_the_same_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["sweep", "--object", "mug", "--grid", "pose.yaw=0:360:10", "--resolution", "24", "--spp", "1"]
    asked += ["--trials", "0", "--denoise", "none", "--quiet", "--run"]
    parts, later = tmp_path / "parts", tmp_path / "later"

    def stopped(self: SurfaceCounts, *args: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(surface.SurfaceCounts, "add_image", stopped)
        assert main([*asked, str(parts), "--surface", "--json"]) == 130
    assert "surface" not in json.loads(capsys.readouterr().out)
    assert main(["resume", str(parts), "--quiet"]) == 0
    assert main([*asked, str(later)]) == 0
    with store.Store(later / store.NAME, read_only=True) as results:
        before = [(row.seed, row.margin) for row in results.rows()]
    capsys.readouterr()
    assert main(["resume", str(later), "surface=true", "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)["surface"]
    with store.Store(later / store.NAME, read_only=True) as results:
        assert [(row.seed, row.margin) for row in results.rows()] == before
    assert [one["part"] for one in found["tables"]] == ["cell", "face"] and found["tables"][0]["visible"] > 500
    assert json.loads((parts / "summary.json").read_text())["surface"] == found
    assert (parts / "artifacts" / "surface.npz").read_bytes() == (later / "artifacts" / "surface.npz").read_bytes()
