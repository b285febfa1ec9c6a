"""Sweeps over cameras: pictures that differ in nothing else come from light on surfaces, once that pays."""

import random
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch.api import prediction
from advsearch.attacks.domain import ProductIndex
from advsearch.cluster import BatchResult, WorkerStats
from advsearch.engine import acceptance
from advsearch.engine.image_groups import Groups
from advsearch.engine.journal import make_worker_call
from advsearch.predictors.surface_light import arrangement, texels
from advsearch.predictors.surface_light.renderer import SurfaceRenderer
from advsearch.progress import NullProgress
from advsearch.questions.sweep.carry_out import load_job
from advsearch.questions.sweep.job import SceneLoader, SweptScene
from advsearch.questions.sweep.loop import Sweep
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import RunDirectory
from stand_ins import rows

pytestmark = pytest.mark.island("advsearch.predictors.surface_light")

SMALL: dict[str, Any] = {"resolution": 24, "trials": 0, "batch": 4}


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[SurfaceRenderer]]:
    """Few texels and rays, which pay at once, and are near enough; those that are made."""
    monkeypatch.setattr(texels, "GROUND_TEXELS", 24)
    for name, value in {"OBJECT_TEXELS": 32, "RAYS_PER_TEXEL": 48}.items():
        monkeypatch.setattr(arrangement, name, value)
    monkeypatch.setattr(prediction, "MIN_SAVING_FACTOR", 0.0)
    for name, number in {"CHECK_SPP": 2, "MIN_ALLOWED_LEVELS": 50.0, "MAX_MARGIN_BIAS": 50.0}.items():
        monkeypatch.setattr(acceptance, name, number)
    made, make = list[SurfaceRenderer](), SurfaceRenderer.__init__

    def counted(self: SurfaceRenderer, *given: Any) -> None:
        made.append(self)
        make(self, *given)

    monkeypatch.setattr(SurfaceRenderer, "__init__", counted)
    yield made


def swept(**more: Any) -> Any:
    return advsearch.sweep("mug", **{**SMALL, **more})


def test_all_frames_of_a_drive_are_a_group_and_draws_tell_drives_apart() -> None:
    """Of time x pose with three draws, where cameras do not share what is drawn."""
    groups = Groups(ProductIndex((5, 2)), 3, (True, False), False, frame_axis=0)
    assert (groups.group_size, groups.n_groups, groups.n_groups_to_cache) == (5, 6, 6)
    found: dict[int, list[int]] = {}
    for number in range(30):
        found.setdefault(groups.find_group_of_image(number), []).append(number)
    assert sorted(found) == list(range(6)) and all(len({one % 6 for one in some}) == 1 for some in found.values())
    for members in found.values():
        assert [groups.find_image_of_group(members[-1], place) for place in range(5)] == members


@pytest.mark.medium
def test_pictures_are_those_that_are_rendered() -> None:
    """Each nearer to its own traced picture than to that of any other row."""
    scene = SweptScene(
        load_job(SweepConfig(object="mug", **SMALL, grid={"camera.azimuth": "0:360:4", "camera.elevation": [5, 60]})), 0
    )
    queries = [query for _, _, query in scene.job.make_queries(range(8))]
    predicted = torch.stack([scene.render_image(query) for query in queries])
    traced = torch.stack([scene.problems[0].picture(query.u, seed=9, spp=64) for query in queries])
    apart = 255.0 * ((predicted[:, None] - traced[None]) ** 2).mean(dim=(2, 3, 4)).sqrt()
    assert apart.argmin(dim=1).tolist() == list(range(8))
    assert float(apart.diagonal().mean()) < 9.0


class Two:
    """Two workers, which carry out batches in any order, each with scenes of its own."""

    stats = WorkerStats(max_running=2)

    def __init__(self, job: Any) -> None:
        self.scenes = [SceneLoader(job), SceneLoader(job)]

    def compute(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        pieces = list(batches)
        random.Random(1).shuffle(pieces)
        for number, items in enumerate(pieces):
            yield BatchResult(
                items, make_worker_call(self.scenes[number % 2].load_by_name)(items), f"worker {number % 2}"
            )


@pytest.mark.medium
def test_a_sweep_that_was_stopped_and_goes_on_by_workers_has_the_same_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each of them finds the same light."""
    grid = {"camera.azimuth": "0:360:4", "camera.sizes": [2, 3, 4]}
    whole, answers = swept(grid=grid, run=tmp_path / "whole").summary, SweptScene.evaluate_all
    looked = iter(range(3))

    def stopped(self: SweptScene, *given: Any) -> Any:
        if next(looked) == 1:
            raise KeyboardInterrupt
        return answers(self, *given)

    with monkeypatch.context() as patch:
        patch.setattr(SweptScene, "evaluate_all", stopped)
        assert swept(grid=grid, run=tmp_path / "parts").summary.configurations == 4
    job = load_job(SweepConfig(object="mug", **SMALL, grid=grid))
    with RunDirectory.resume(tmp_path / "parts") as run:
        again = Sweep(job, run, NullProgress(), Two(job)).execute().summary
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole") and again.renders == whole.renders
