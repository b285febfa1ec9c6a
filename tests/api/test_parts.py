"""The attacks of a study that others carry out: their folders come back as those of attacks that were made here."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from advsearch.cluster import BatchResult, WorkerStats, WorkerTask
from advsearch.experiment import RunContext, run_and_save
from advsearch.questions.attack import studies as parts
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.studies import curve, make_chains
from advsearch.runs.summary import read_configuration
from stored_sweeps import all_rows

SMALL = AttackConfig(
    object="mug,bowl",
    controls={"pose": {"yaw": [-30, 30]}},
    policy="random",
    resolution=16,
    denoise="none",
    spp=1,
    steps=2,
    trials=6,
    verify_spp=2,
    average=6,
    baseline=False,
    deterministic=True,
)


class Backwards:
    """Carries out the last range first, in this process; `lost` says of what it dies."""

    stats = WorkerStats(workers=1)

    def __init__(self, work: WorkerTask, lost: str) -> None:
        self.call, self.lost = parts.make_chain_worker(work.settings), lost
        assert work.function_path == "advsearch.questions.attack.studies:make_chain_worker"

    def compute(self, ranges: Iterable[range]) -> Iterator[BatchResult]:
        for one in reversed(list(ranges)):
            yield BatchResult(one, None if self.lost else self.call(one), "elsewhere", failure_reason=self.lost)


def elsewhere(monkeypatch: pytest.MonkeyPatch, lost: str = "") -> None:
    @contextmanager
    def opened(work: WorkerTask, **asked: Any) -> Iterator[Any]:
        assert (asked["workers"], asked["cluster"]) in ((2, None), (None, None))
        yield None if asked["workers"] is None else Backwards(work, lost)

    monkeypatch.setattr(parts, "open_workers", opened)


@pytest.mark.medium
def test_a_shared_study_is_the_one_that_was_made_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = run_and_save(curve, RunContext(SMALL.model_copy(update={"run": str(tmp_path / "alone")})))
    elsewhere(monkeypatch)
    shared = run_and_save(curve, RunContext(SMALL.model_copy(update={"run": str(tmp_path / "shared"), "workers": 2})))
    assert [(row.object, row.ending, row.margin, row.average) for row in shared.table] == [
        (row.object, row.ending, row.margin, row.average) for row in alone.table
    ]
    assert [row.average and row.average.configurations for row in shared.table] == [6, 6]
    for name in (part.name for (part,) in make_chains(SMALL)):
        here, there = (tmp_path / one / "parts" / name for one in ("alone", "shared"))
        assert all_rows(there) == all_rows(here) and (read_configuration(there) == read_configuration(here)).all()
        assert {one.name for one in there.iterdir()} >= {"run.yaml", "summary.json", "report.html", "images"}
        assert "advsearch-part-" not in (there / "summary.json").read_text()
        assert str(there) in [one.run for one in shared.table]
