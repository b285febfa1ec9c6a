"""A sweep whose batches are carried out by others: the rows and the summary of one that did it all itself."""

import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from test_sweep import FakeRenderer

from advsearch.cli.main import main
from advsearch.cluster import BatchFunction, BatchResult, WorkerStats
from advsearch.engine.journal import make_worker_call
from advsearch.engine.record import LOST_LABEL
from advsearch.progress import NullProgress
from advsearch.questions.sweep import job as swept_scene
from advsearch.questions.sweep.carry_out import load_job
from advsearch.questions.sweep.job import SceneLoader
from advsearch.questions.sweep.loop import Sweep
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import RunDirectory
from stored_sweeps import all_rows

pytestmark = pytest.mark.medium

SMALL = {"object": "mug", "grid": {"pose.yaw": "0:360:3", "camera.elevation": [5, 35]}, "environment": "studio,noon"}
CONFIG = SweepConfig(**SMALL, batch=2, resolution=16, spp=1, trials=0)


@pytest.fixture(autouse=True)
def nothing_is_rendered(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """But in the test with processes of their own."""
    FakeRenderer.made, FakeRenderer.calls, FakeRenderer.stops_at, FakeRenderer.level = [], 0, None, None
    if "two_workers" not in request.node.name:
        monkeypatch.setattr(swept_scene, "make_renderer", FakeRenderer)


@dataclass
class Disorder:
    """Carries out batches in any order, with facts as of two machines."""

    call: BatchFunction
    seed: int = 0
    lose: int | None = None
    stop: int | None = None
    stats: WorkerStats | None = field(
        default_factory=lambda: WorkerStats(max_running=2, lost=1, busy=9.0, alive=10.0, retried=3)
    )

    def compute(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        pieces = list(batches)
        random.Random(self.seed).shuffle(pieces)
        for count, items in enumerate(pieces):
            if count == self.stop:
                raise KeyboardInterrupt
            if self.lose in [query.row_index for _, _, query in items]:
                for one in items:
                    lost = "no answer: 3 workers died of it" if one[2].row_index == self.lose else ""
                    yield BatchResult([one], None if lost else self.call([one]), failure_reason=lost)
            else:
                yield BatchResult(items, self.call(items), f"worker {count % 2}")


def summary(result: Any) -> dict[str, Any]:
    times = ("seconds", "run", "renders_per_second", "shared", "warnings", "command_line")
    return {name: value for name, value in result.summary.to_dict().items() if name not in times}


def shared(path: Path, resumed: bool = False, **given: Any) -> Any:
    job = load_job(CONFIG)
    with RunDirectory.resume(path) if resumed else RunDirectory.create(path) as run:
        executor = Disorder(make_worker_call(SceneLoader(job).load_by_name), **given)
        return Sweep(job, run, NullProgress(), executor).execute()


def test_any_order_any_interrupt_and_any_repetition_end_with_the_same_rows(tmp_path: Path) -> None:
    job = load_job(CONFIG)
    with RunDirectory.create(tmp_path / "alone") as run:
        alone = Sweep(job, run, NullProgress()).execute()
    assert alone.summary.shared is None and len(all_rows(tmp_path / "alone")) == 12
    path = tmp_path / "shared"
    first = shared(path, seed=1, stop=3)
    assert first.summary.configurations == len(all_rows(path)) == 6 and first.summary.ending == "interrupted"
    again = shared(path, resumed=True, seed=7)
    assert all_rows(path) == all_rows(tmp_path / "alone") and summary(again) == summary(alone)


def test_a_configuration_that_kills_every_worker_is_a_row_that_says_so(tmp_path: Path) -> None:
    result = shared(tmp_path / "run", lose=7)
    (lost,) = [row for row in result.rows() if row.label == LOST_LABEL]
    assert lost.step == 7 and lost.payload == {"lost": "no answer: 3 workers died of it"}
    assert (lost.correct, lost.margin, lost.probability, lost.renders) == (False, None, None, 0)
    assert lost.values["pose.yaw"]["value"] in (0.0, 120.0, 240.0) and lost.values["environment"]["value"] == "noon"
    assert result.summary.configurations == 12 and result.summary.renders["sweep"] == 11
    assert any("every worker that took it died" in text for text in result.summary.warnings)
    again = shared(tmp_path / "run", resumed=True)
    assert any("every worker that took it died" in text for text in again.summary.warnings)


def test_rows_of_another_machine_name_it_and_the_run_says_what_it_is(tmp_path: Path) -> None:
    class Two(Disorder):
        def compute(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
            for done in super().compute(batches):
                yield replace(done, machine="ab12" if done.items[0][2].row_index < 4 else None)

    job = load_job(CONFIG)
    stats = WorkerStats(machines={"ab12": {"processor": "another", "LLVM": "19.1"}})
    with RunDirectory.create(tmp_path / "run") as run:
        executor = Two(make_worker_call(SceneLoader(job).load_by_name), stats=stats)
        result = Sweep(job, run, NullProgress(), executor).execute()
        assert run.store.read_json_note("machines") == {"ab12": {"processor": "another", "LLVM": "19.1"}}
    assert [row.machine for row in result.rows()] == ["ab12"] * 4 + [None] * 8
    told = "not alike, so that their last bits may differ; beside the one that kept the run: processor another, LLVM 19"
    assert any(told in text for text in result.summary.warnings)


def test_two_workers_have_the_rows_of_none(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Really rendered, by processes of their own."""
    words = ["sweep", "--object", "mug", "--grid", "pose.yaw=0:360:4", "--grid", "camera.elevation=5:60:2"]
    words += ["--resolution", "32", "--spp", "2", "--batch", "2", "--trials", "0", "--quiet"]
    assert main([*words, "--run", str(tmp_path / "alone")]) == 0
    assert main([*words, "--run", str(tmp_path / "shared"), "--workers", "2"]) == 0
    assert len(all_rows(tmp_path / "alone")) == 8 and all_rows(tmp_path / "shared") == all_rows(tmp_path / "alone")
    out, err = capfd.readouterr()
    assert "workers" in out and "at most, busy" in out and not err
