"""Every range comes back once, whatever becomes of the workers. The workers are simulated, and so is the time."""

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from advsearch.cluster import BatchResult, WorkerTask
from advsearch.cluster.worker import (
    Failure,
    MissingFilesError,
    Reply,
    compute_digests,
    read_files,
    resolve_files,
    write_files,
)
from advsearch.errors import ClusterError
from simulated_cluster import Simulated, SimulatedWorkers

COUNT, SIZE = 400, 16


def ranges(count: int = COUNT) -> Iterator[range]:
    return (range(first, min(first + SIZE, count)) for first in range(0, count, SIZE))


def run_all(pool: Simulated, count: int = COUNT, tell: Callable[[str], None] = lambda text: None) -> list[BatchResult]:
    """What comes back, checked: each number once, and as it should be."""
    results = list(SimulatedWorkers(pool, tell).compute(ranges(count)))
    numbers = [number for result in results for number in result.items]
    assert sorted(numbers) == list(range(count)), "none is lost, and none comes twice"
    assert all(result.value == list(result.items) for result in results if not result.failure_reason)
    return results


def test_ranges_are_shared_and_few_are_under_way() -> None:
    pool = Simulated()
    pool.add(4)
    taken: list[range] = []

    def source() -> Iterator[range]:
        for batch in ranges(20_000):
            taken.append(batch)
            yield batch

    workers = SimulatedWorkers(pool)
    for count, result in enumerate(workers.compute(source()), 1):
        assert len(taken) - count <= 4 and result.items in taken
    assert pool.most <= 4
    facts = workers.stats
    assert facts.max_running == facts.workers == 4 and facts.batches == 1250 and facts.retried == facts.lost == 0
    assert facts.busy / facts.alive > 0.99 and facts.busy == pytest.approx(10_000.0)
    assert facts.loading == 4 * pool.load


@pytest.mark.parametrize("seed", range(20))
def test_kills_at_any_time_change_nothing(seed: int) -> None:
    """Of workers, of all of them at once, and of the scheduler."""
    chance, pool = random.Random(seed), Simulated(load=2.0)
    pool.add(3)

    def strike() -> None:
        what = chance.random()
        if what < 0.7 and pool.alive:
            pool.end(chance.choice(pool.alive))
        elif what < 0.9:
            for worker in pool.alive:
                pool.end(worker)
        else:
            pool.lose_scheduler()
        pool.at(pool.now + chance.expovariate(1 / 15.0), strike)

    pool.at(1.0, strike)
    assert not [result for result in run_all(pool) if result.failure_reason]


def test_a_killed_worker_costs_its_range_again_and_nothing_else() -> None:
    pool = Simulated()
    pool.add(2)
    pool.at(20.0, lambda: pool.end(pool.alive[0]))
    run_all(pool)
    assert pool.stats.batches == len(pool.given) == COUNT // SIZE and pool.stats.lost == 1


def test_a_number_of_which_every_worker_dies_is_found_and_said() -> None:
    """And no other."""
    pool = Simulated(kill={37, 212}, lag=0.1)
    pool.add(2)
    lost = {result.items[0]: result.failure_reason for result in run_all(pool) if result.failure_reason}
    assert lost == {37: "no answer: 3 workers died of it", 212: "no answer: 3 workers died of it"}


@pytest.mark.parametrize("deadly", range(37, 400, 40))
def test_what_is_left_waits_for_a_worker_that_is_not_ready(deadly: int) -> None:
    """The one that dies of a number was the only one that was ready, and another has not got ready yet."""
    pool = Simulated(kill={deadly}, load=36.0, again=8.0, lag=0.6)
    pool.add(2)
    results = SimulatedWorkers(pool).compute(range(first, first + 2) for first in range(0, 400, 2))
    lost = {number: result.failure_reason for result in results for number in result.items}
    assert len(lost) == 400 and [number for number, reason in lost.items() if reason] == [deadly]


def test_workers_that_die_of_everything_end_the_run() -> None:
    """And leave no row that calls a configuration deadly for each."""
    pool = Simulated(kill=range(COUNT))
    pool.add(2)
    with pytest.raises(ClusterError, match="simulated"):
        run_all(pool)
    assert pool.stats.lost < 20


def test_an_error_of_ours_ends_the_run_with_its_words_and_a_bug_with_its_trace() -> None:
    for failure, error, text in (
        (Failure.INPUT, ClusterError, "grid: pose.yaw is out of range"),
        (Failure.UNFIT, ClusterError, "no libLLVM is found"),
        (Failure.BUG, RuntimeError, "on w0:\nTraceback of the worker"),
    ):
        pool = Simulated(replies={"w0": Reply(worker="w0", failure=failure, error=text.rpartition(":\n")[2])})
        pool.add(1)
        with pytest.raises(error, match=text):
            run_all(pool)


def test_results_that_are_given_up_do_not_answer_what_is_asked_next() -> None:
    """Though their ranges are still under way, and though nobody has closed them."""
    pool = Simulated()
    pool.add(2)
    workers = SimulatedWorkers(pool)
    first = workers.compute(ranges(400))
    for _ in range(3):
        next(first)
    batches = iter([range(900, 901), range(901, 902)])
    assert sorted(number for result in workers.compute(batches) for number in result.items) == [900, 901]


def test_files_of_lists_nodes_and_two_paths_are_read_here_and_found_there(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    for name in ("mug.glb", "two+cups.glb", "camera.csv", "object.csv"):
        (here / name).write_text(name)
    given: dict[str, Any] = {
        "object": f"{here}/mug.glb#Cup,bowl, {here}/two+cups.glb#A",
        "path": f"{here}/camera.csv+{here}/object.csv",
    }
    contents = read_files(WorkerTask("a:b", given, ("object", "path")))
    task = WorkerTask("a:b", given, ("object", "path"), digests=compute_digests(contents))
    assert {Path(path).name for path in contents} == {path.name for path in here.iterdir()}
    assert resolve_files(task, there).settings == given and not there.exists()
    here.rename(tmp_path / "gone")
    with pytest.raises(MissingFilesError, match=str(here)):
        resolve_files(task, there)
    write_files(contents, there)
    moved: Any = resolve_files(task, there).settings
    paths = [*moved["object"].split(","), *moved["path"].split("csv+")]
    assert all(path == "bowl" or path.startswith(f"{there}/") for path in paths)
    first, second = moved["path"].split("csv+")
    assert (Path(f"{first}csv").read_text(), Path(second).read_text()) == ("camera.csv", "object.csv")
    assert Path(paths[2].partition("#")[0]).read_text() == "two+cups.glb" and paths[0].endswith("mug.glb#Cup")


def test_of_a_folder_a_place_alone_sends_its_neighbours_and_no_link_leads_out(tmp_path: Path) -> None:
    here, private = tmp_path / "here", tmp_path / "private.png"
    here.mkdir()
    for name in ("place.yaml", "street.glb", "holiday.png", "notes.txt"):
        (here / name).write_text(name)
    private.write_text("private")
    (here / "link.png").symlink_to(private)
    yaml = f"{here}/place.yaml"
    place = read_files(WorkerTask("a:b", {"environment": f"{yaml}#night"}, ("environment",)))
    assert {Path(path).name for path in place} == {"place.yaml", "street.glb", "holiday.png"}
    camera = read_files(WorkerTask("a:b", {"camera": yaml}, ("camera",)))
    assert {Path(path).name for path in camera} == {"place.yaml"}
