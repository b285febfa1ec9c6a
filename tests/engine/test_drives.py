"""Drives: frames that share their draws, rates worked out by hand, and what an attack keeps along its path."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from test_sweep import FakeRenderer
from test_sweep_workers import Disorder, summary
from torch import Tensor, nn

import advsearch
from advsearch.engine.journal import make_worker_call
from advsearch.progress import NullProgress
from advsearch.questions.sweep import job as swept_scene
from advsearch.questions.sweep.carry_out import load_job
from advsearch.questions.sweep.drives import summarize_drives
from advsearch.questions.sweep.job import SceneLoader
from advsearch.questions.sweep.loop import Sweep
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.stored import StoredSweep
from advsearch.questions.sweep.summary import DriveRates
from advsearch.runs.directory import RunDirectory
from advsearch.runs.tables import read_sweep
from stored_sweeps import all_rows

SMALL: dict[str, Any] = {"resolution": 16, "spp": 1, "trials": 0, "batch": 4}


@pytest.fixture(autouse=True)
def nothing_is_rendered(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """But in the test of an attack."""
    FakeRenderer.made, FakeRenderer.calls, FakeRenderer.stops_at, FakeRenderer.level = [], 0, None, None
    monkeypatch.setattr(swept_scene, "make_renderer", FakeRenderer)


class Clock(nn.Module):
    """Is shown the time in the picture, and says "mug" at some of the times."""

    def __init__(self, right: str) -> None:
        super().__init__()
        self.right = torch.tensor([float(one) for one in right])

    def forward(self, images: Tensor) -> Tensor:
        frame = (images.mean(dim=(1, 2, 3)) * 25.5).round().long().clamp(max=len(self.right) - 1)
        score = 10.0 * (2.0 * self.right[frame] - 1.0) + 0.001 * images.mean(dim=(1, 2, 3))
        return torch.stack([score, -score], dim=1)


class Timed(FakeRenderer):
    """A picture whose grey level is the number of the configuration that is rendered."""

    def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
        time = float(str(self.space.describe(u)["path.time"]["value"]))
        yaw = float(str(self.space.describe(u).get("pose.yaw", {"value": 0.0})["value"]))
        return torch.full((*self.size, 3), (round(time) + 5 * round(yaw / 90.0)) / 25.5)


def clocked(right: str, **given: Any) -> tuple[list[DriveRates], Any]:
    model = advsearch.load_model(Clock(right), labels=("mug", "vase"), input_size=16, name="clock")
    result = advsearch.sweep("mug", model, **{**SMALL, **given})
    return list(result.summary.drives or ()), result


DRIVE: dict[str, Any] = {"controls": {"path": {"seconds": 4.0, "reach": 5.0}}, "path": "approach", "fps": 1.0}


@pytest.mark.island("advsearch.controls.path")
@pytest.mark.parametrize(
    ("frames", "right", "gap", "flicker", "first"),
    [
        ("00110", 0.4, 2.0, 0.5, 3.0), ("00000", 0.0, 5.0, 0.0, None), ("10001", 0.4, 3.0, 0.5, 5.0),
    ],
)  # fmt: skip
def test_rates_of_one_drive_are_those_worked_out_by_hand(
    frames: str, right: float, gap: float, flicker: float, first: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five frames in four seconds, from five distances away to one, with the camera as high as the object."""
    monkeypatch.setattr(swept_scene, "make_renderer", Timed)
    (said,), _ = clocked(frames, **DRIVE, size=1.0, set={"camera.elevation": 0.0, "camera.distance": 1.0})
    assert (said.drives, said.frames, said.seconds, said.never_right) == (1, 5, 4.0, int(first is None))
    assert (said.right.mean, said.longest_gap.mean, said.flicker.mean) == pytest.approx((right, gap, flicker))
    assert said.right.interval is None and said.right.worst == said.right.mean
    assert (said.first_right and said.first_right.mean) == (None if first is None else pytest.approx(first, abs=1e-3))


@pytest.mark.island("advsearch.controls.path")
@pytest.mark.medium
@pytest.mark.parametrize("workers", [False, True])
def test_frames_of_a_drive_of_both_have_their_distances_and_workers_have_the_same(
    tmp_path: Path, workers: bool
) -> None:
    """Level, from 2 metres away: the camera comes from 4 times as far, the object from as far behind its place."""
    config = SweepConfig(
        object="mug", size=1.0, controls={"path": {"seconds": 4.0, "reach": 4.0}}, path="approach+approach", fps=1.0,
        set_={"camera.elevation": 0.0, "camera.distance": 2.0}, resolution=16, spp=1, trials=0, batch=2,
    )  # fmt: skip
    job = load_job(config)
    executor = Disorder(make_worker_call(SceneLoader(job).load_by_name), seed=1) if workers else None
    with RunDirectory.create(tmp_path / "run") as run:
        Sweep(job, run, NullProgress(), executor).execute()
        away = {row.values["path.time"]["value"]: row.values["path.distance"]["value"] for row in run.store.rows()}
    assert away == pytest.approx({0.0: 14.0, 1.0: 11.0, 2.0: 8.0, 3.0: 5.0, 4.0: 2.0}, abs=1e-4)


@pytest.mark.island("advsearch.controls.path")
@pytest.mark.medium
@pytest.mark.parametrize(
    ("grid", "samples"), [({}, 3), ({"path.time": [0, 4, 2], "pose.yaw": [0, 90]}, 1), ({"pose.yaw": [0, 90]}, 3)]
)
def test_frames_of_a_drive_share_their_draws_and_drives_do_not(grid: dict[str, Any], samples: int) -> None:
    result = advsearch.sweep(
        "mug,bowl", grid=grid, controls={"sensor": {"shot": [0.0, 0.15]}, "path": {"seconds": 4.0}},
        path="approach", fps=1, samples=samples, label="mug", **SMALL,
    )  # fmt: skip
    drawn: dict[tuple[Any, ...], list[float]] = {}
    for row in result.rows():
        yaw = row.values.get("pose.yaw", {"value": 0.0})["value"]
        place = (row.values["object"]["value"], yaw, row.step % samples)
        drawn.setdefault(place, []).append(float(str(row.values["sensor.shot"]["value"])))
    frames = 3 if "path.time" in grid else 5
    assert len(drawn) == 2 * samples * (2 if grid else 1) and all(len(one) == frames for one in drawn.values())
    assert all(len(set(one)) == 1 for one in drawn.values()), "the sensor is the same all along a drive"
    assert len({one[0] for one in drawn.values()}) == len(drawn), "and another one on every drive"
    assert result.summary.drives and result.summary.drives[0].drives == len(drawn)


CONFIG = SweepConfig(
    object="mug", environment="studio,noon", grid={"pose.yaw": "0:360:3"}, controls={"sensor": {"shot": [0.0, 0.15]},
    "path": {}}, path="pass", fps=0.2, samples=2, resolution=16, spp=1, trials=0, batch=2,
)  # fmt: skip


@pytest.mark.island("advsearch.controls.path")
@pytest.mark.medium
def test_resumed_and_shared_drives_are_those_of_one_who_did_it_alone(tmp_path: Path) -> None:
    with RunDirectory.create(tmp_path / "alone") as run:
        alone = Sweep(load_job(CONFIG), run, NullProgress()).execute()
    path = tmp_path / "shared"
    for resumed in (False, True):
        job = load_job(CONFIG)
        with RunDirectory.resume(path) if resumed else RunDirectory.create(path) as run:
            executor = Disorder(make_worker_call(SceneLoader(job).load_by_name), seed=3, stop=None if resumed else 4)
            found = Sweep(job, run, NullProgress(), executor).execute()
    assert all_rows(path) == all_rows(tmp_path / "alone") and len(all_rows(path)) == 2 * 3 * 3 * 2
    assert summary(found) == summary(alone) and alone.summary.drives is not None
    assert alone.summary.drives[0].drives == 12 and alone.summary.drives[0].right.interval is not None
    kept = [(one / "images" / "drive.webp").read_bytes() for one in (path, tmp_path / "alone")]
    assert kept[0] == kept[1]


@pytest.mark.parametrize("drives", [3, 5, 10, 30])
@pytest.mark.parametrize("kind", ["any share", "right all the way or seldom", "all or none"])
def test_intervals_over_drives_cover_the_mean_of_few_drives(drives: int, kind: str) -> None:
    rng = np.random.default_rng(drives)
    q, part = rng.random((120, drives)), rng.random((120, drives))
    values, truth = {
        "any share": (rng.beta(2, 5, (120, drives)), 2 / 7),
        "right all the way or seldom": (np.where(q < 0.9, 1.0, part / 2), 0.925),
        "all or none": ((q < 0.95) * 1.0, 0.95),
    }[kind]
    got = [summarize_drives(one, worst=min).interval for one in values]
    assert sum(one is not None and one[0] <= truth <= one[1] for one in got) >= 112  # under 95 % by chance: 1 in 40


REPEATED: dict[str, Any] = {**DRIVE, "samples": 6}


@pytest.mark.island("advsearch.controls.path")
@pytest.mark.medium
def test_repeats_of_one_drive_that_differ_in_noise_are_one_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(swept_scene, "make_renderer", Timed)
    paths = [tmp_path / name for name in ("first", "second")]
    for path, frames in zip(paths, ("11100", "11000"), strict=True):
        (said,), result = clocked(frames, **REPEATED, run=path)
    assert (said.drives, said.repeats) == (1, 6)
    assert said.right.mean == pytest.approx(0.4) and said.right.interval is None
    assert said.first_right is not None and said.first_right.interval is None and said.longest_gap.interval is None
    swept = result.summary
    assert (swept.units, swept.accuracy, swept.interval) == (1, pytest.approx(0.4), None)
    assert "all 6 repeats are of one drive and differ in noise alone" in " ".join(swept.warnings)
    assert set(read_sweep(paths[0])["unit"]) == {0}
    compared = advsearch.compare(f"{paths[0]},{paths[1]}", pictures=0, run=tmp_path / "compared")
    (pair,) = compared.pairs
    assert (pair.units, pair.unit, pair.p) == (1, "drive", 1.0) and pair.interval[0] < -0.5 and pair.interval[1] > 0.5


def swept_parts(folder: Path, *settings: dict[str, Any]) -> list[StoredSweep]:
    """Sweep with each of some settings, as what `explain` reads."""
    paths = [folder / f"part-{number}" for number in range(len(settings))]
    for path, given in zip(paths, settings, strict=True):
        advsearch.sweep("mug", **SMALL, **given, run=path)
    return [StoredSweep.read(path) for path in paths]


@pytest.mark.island("advsearch.questions.explain")
@pytest.mark.island("advsearch.controls.sensor")
@pytest.mark.medium
def test_pictures_of_a_longer_sweep_of_the_same_seed_are_not_counted_twice(tmp_path: Path) -> None:
    """Draws of one seed are the same ones, also where a setting makes other pictures of them."""
    from advsearch.questions.explain.rows import read_predictions

    drawn: dict[str, Any] = {"controls": {"sensor": {"shot": [0.0, 0.15]}}}
    short, long, other = swept_parts(
        tmp_path, *({**drawn, "samples": samples, "seed": seed} for samples, seed in ((6, 3), (9, 3), (6, 4)))
    )
    alone, both = read_predictions([long]), read_predictions([short, long])
    assert len(alone) == len(both) == both["unit"].nunique() == 9
    assert read_predictions([long, other])["unit"].nunique() == 15
    changed = replace(short, config=short.config.model_copy(update={"label": "cup"}))
    mixed = read_predictions([changed, long])
    assert (len(mixed), mixed["unit"].nunique()) == (15, 9), "other settings: other predictions of the same draws"


@pytest.mark.island("advsearch.controls.path")
@pytest.mark.medium
def test_an_attack_over_a_path_keeps_its_adversarial_scene_along_the_drive(tmp_path: Path) -> None:
    path = tmp_path / "run"
    size: dict[str, Any] = {
        "resolution": 16,
        "spp": 1,
        "verify_spp": 1,
        "steps": 3,
        "policy": "pgd",
        "epsilon": 0.5,
        "trials": 6,
        "draws": 1,
    }
    model = advsearch.load_model(Dark(), labels=("mug", "vase"), input_size=16, name="dark")
    over = {"path": {"seconds": 5.0, "reach": 1.5}}
    found = advsearch.attack(
        "mug", model, controls="texture", over=over, path="approach", run=path, baseline=False, denoise="none", **size
    ).summary
    assert found.drive is not None and found.adversarial is not None
    assert (found.drive.frames, found.drive.seconds, found.drive.clean) == (24, 5.0, 24)
    assert found.drive.adversarial is not None and 0 <= found.drive.adversarial <= 24
    for name in ("drive", "drive-clean"):
        with Image.open(path / "images" / f"{name}.webp") as kept:
            assert getattr(kept, "n_frames", 1) == 24
        with Image.open(path / "images" / f"{name}.png") as kept:
            assert kept.size == (8 * 160, 160)
    pictures = [(path / "images" / f"{name}.png").read_bytes() for name in ("drive", "drive-clean")]
    assert pictures[0] != pictures[1]


class Dark(nn.Module):
    """Says "mug" of every picture that is not white, with a slope in its brightness."""

    def forward(self, images: Tensor) -> Tensor:
        score = 3.0 * (2.0 - images.mean(dim=(1, 2, 3)))
        return torch.stack([score, -score], dim=1)
