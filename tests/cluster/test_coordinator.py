"""Every range comes back once, whatever becomes of the workers. The workers are simulated, and so is the time."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from simulated_cluster import Failure, Simulated, coordinator

from advsearch import threads
from advsearch.cluster import Done, Work
from advsearch.cluster.coordinator import PATIENCE, Coordinator
from advsearch.cluster.worker import (
    MOST_LOADED,
    Carried,
    Files,
    Ready,
    carry_out_batch,
    prepare,
    read_files,
    version,
    write_files,
)
from advsearch.errors import ClusterError

COUNT, SIZE = 400, 16


def ranges(count: int = COUNT) -> Iterator[range]:
    return (range(first, min(first + SIZE, count)) for first in range(0, count, SIZE))


def carried(pool: Simulated, count: int = COUNT, tell: Callable[[str], None] = lambda text: None) -> list[Done]:
    """What comes back, checked: each number once, and as it should be."""
    found = list(coordinator(pool, tell).results(ranges(count)))
    numbers = [number for done in found for number in done.items]
    assert sorted(numbers) == list(range(count)), "none is lost, and none comes twice"
    assert all(done.value == list(done.items) for done in found if not done.lost)
    return found


def test_ranges_are_shared_and_few_are_under_way() -> None:
    pool = Simulated()
    pool.add(4)
    taken: list[range] = []

    def source() -> Iterator[range]:
        for one in ranges(20_000):
            taken.append(one)
            yield one

    shared = coordinator(pool)
    for count, done in enumerate(shared.results(source()), 1):
        assert len(taken) - count <= 4 and done.items in taken
    assert pool.most <= 4
    facts = shared.facts
    assert facts.most == facts.workers == 4 and facts.batches == 1250 and facts.retried == facts.lost == 0
    assert facts.busy / facts.alive > 0.99 and facts.busy == pytest.approx(10_000.0)


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
    found = carried(pool)
    assert not [done for done in found if done.lost]


def test_a_number_of_which_every_worker_dies_is_found_and_said() -> None:
    """And no other."""
    pool = Simulated(kill={37, 212}, lag=0.1)
    pool.add(2)
    lost = {done.items[0]: done.lost for done in carried(pool) if done.lost}
    assert lost == {37: "no answer: 3 workers died of it", 212: "no answer: 3 workers died of it"}


@pytest.mark.parametrize("deadly", range(37, 400, 40))
def test_what_is_left_waits_for_a_worker_that_is_not_ready(deadly: int) -> None:
    """The one that dies of a number was the only one that was ready, and another has not got ready yet."""
    pool = Simulated(kill={deadly}, load=36.0, again=8.0, lag=0.6)
    pool.add(2)
    shared = coordinator(pool).results(range(first, first + 2) for first in range(0, 400, 2))
    found = {number: done.lost for done in shared for number in done.items}
    assert len(found) == 400 and [number for number, lost in found.items() if lost] == [deadly]


def test_a_worker_that_hangs_is_ended_and_its_range_done_elsewhere() -> None:
    told: list[str] = []
    pool = Simulated(hang={90})
    pool.add(2)
    pool.at(300.0, lambda: setattr(pool, "hang", ()))
    found = carried(pool, tell=told.append)
    assert not [done for done in found if done.lost] or pool.hang
    assert any("has not answered for" in text for text in told)


def test_a_number_that_hangs_for_ever_is_given_up() -> None:
    pool = Simulated(hang={90})
    pool.add(2)
    assert [done.items for done in carried(pool) if done.lost] == [range(90, 91)]


def test_late_answers_change_nothing() -> None:
    """A worker that was given up for dead answers after all, and another has answered before."""

    class Stubborn(Simulated):
        def restart(self, worker: str) -> None:
            ended.append(worker)

    ended: list[str] = []
    slow = {200: 150.0}
    pool = Stubborn(seconds=lambda number: slow.pop(number, 0.5))
    pool.add(2)
    carried(pool, 2000)
    assert len(ended) == 1


def test_another_version_is_refused_with_both_versions() -> None:
    told: list[str] = []
    pool = Simulated(answers={"w0": Failure("it has advsearch 2, and 1 asks; install the same on both", unfit=True)})
    pool.add(2)
    found = carried(pool, tell=told.append)
    assert {done.worker for done in found} == {"w1"}
    assert told == ["w0 is given nothing: it has advsearch 2, and 1 asks; install the same on both"]


def test_a_worker_does_nothing_for_another_version() -> None:
    found = prepare("key", Work("nowhere:work", {}), Files({}, {}), "0.0.0")
    text = f"it has advsearch {version()}, and 0.0.0 asks; install the same on both"
    assert found == Failure(text, unfit=True)


def test_workers_none_of_which_can_do_it_end_the_run_with_the_reason() -> None:
    without = Failure("no libLLVM is found; apt install libllvm19", unfit=True)
    pool = Simulated(answers={"w0": without, "w1": without})
    pool.add(2)
    with pytest.raises(ClusterError, match=r"no libLLVM is found; apt install libllvm19.*advsearch resume"):
        carried(pool)
    assert pool.now < 60.0


def test_workers_that_die_while_they_load_are_not_blamed_on_a_batch() -> None:
    pool = Simulated()

    def strike() -> None:
        for worker in pool.alive:
            pool.end(worker)
        pool.at(pool.now + 2.0, strike)

    pool.add(2)
    pool.at(2.0, strike)
    with pytest.raises(ClusterError, match="workers died while they loaded the scene and the model"):
        carried(pool)
    assert not pool.given


def test_nobody_at_all_is_waited_for_and_then_said() -> None:
    pool = Simulated()
    with pytest.raises(ClusterError, match="there was no worker that can do it for 300 s; what was stored is kept"):
        carried(pool)
    assert pool.now > PATIENCE
    late = Simulated()
    late.add(1, after=PATIENCE - 10.0)
    carried(late)


def test_a_scheduler_that_does_not_come_back_says_how_to_go_on() -> None:
    pool = Simulated(returns=False)
    pool.add(2)
    pool.at(30.0, pool.lose_scheduler)
    with pytest.raises(ClusterError, match="go on with advsearch resume"):
        carried(pool)


def test_files_are_sent_only_to_a_worker_that_lacks_them() -> None:
    sent: list[bool] = []

    class Sending(Simulated):
        def submit(self, worker: str, function: Callable[..., object], *args: Any) -> Future[Any]:
            if len(args) == 4:
                sent.append(bool(getattr(args[2], "contents", None)))
                if worker == "w0":
                    lacks = Failure("it lacks mug.obj", missing=True)
                    self.answers[worker] = Ready({"processor": "here"}, 1.0) if sent[-1] else lacks
            return super().submit(worker, function, *args)

    pool = Sending()
    pool.add(2)
    files = Files({"/a/mug.obj": "d"}, {"/a/mug.obj": b"v"})
    shared = Coordinator(pool, Work("a:b", {}), "key", files, "1", {"processor": "here"}, clock=pool.clock)
    assert len(list(shared.results(ranges()))) == COUNT // SIZE
    assert sorted(sent) == [False, False, True]


def test_what_comes_from_another_machine_says_so() -> None:
    told: list[str] = []
    pool = Simulated(answers={"w1": Ready({"processor": "another"}, 5.0)})
    pool.add(2)
    found = carried(pool, tell=told.append)
    marks = {done.worker: done.machine for done in found}
    assert marks["w0"] is None and marks["w1"] is not None and "processor another" in told[0]


def test_an_error_of_ours_ends_the_run_with_its_words_and_a_bug_with_its_trace() -> None:
    for answer, error, text in (
        (Failure("grid: pose.yaw is out of range"), ClusterError, "grid: pose.yaw is out of range"),
        (Failure("KeyError", trace="Traceback of the worker"), RuntimeError, "Traceback of the worker"),
    ):
        pool = Simulated(answers={"w0": answer})
        pool.add(1)
        with pytest.raises(error, match=text):
            carried(pool)


def test_a_worker_that_forgot_gets_ready_again_and_is_counted_once() -> None:
    class Forgetful(Simulated):
        def submit(self, worker: str, function: Callable[..., object], *args: Any) -> Future[Any]:
            if function is carry_out_batch and args[1].start in forgotten and worker in self._free_at:
                forgotten.remove(args[1].start)
                future: Future[Any] = Future()
                self._at[future] = worker
                self._answer(future, 0.1, Failure("it is not ready", forgotten=True))
                return future
            return super().submit(worker, function, *args)

    forgotten: list[object] = [0, 96, 160]
    pool = Forgetful()
    pool.add(2)
    shared = coordinator(pool)
    assert len(list(shared.results(ranges()))) == COUNT // SIZE and not forgotten
    assert shared.facts.workers == shared.facts.most == 2


def test_files_of_lists_nodes_and_two_paths_are_read_here_and_found_there(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    for name in ("mug.glb", "two+cups.glb", "camera.csv", "object.csv"):
        (here / name).write_text(name)
    given: dict[str, Any] = {
        "object": f"{here}/mug.glb#Cup,bowl, {here}/two+cups.glb#A",
        "path": f"{here}/camera.csv+{here}/object.csv",
    }
    work = Work("a:b", given, ("object", "path"))
    files = read_files(work)
    assert {Path(path).name for path in files.digests} == {path.name for path in here.iterdir()}
    assert write_files(work, files, there).settings == given and not there.exists()
    here.rename(tmp_path / "gone")
    moved: Any = write_files(work, files, there).settings
    found = [*moved["object"].split(","), *moved["path"].split("csv+")]
    assert all(one == "bowl" or one.startswith(f"{there}/") for one in found)
    first, second = moved["path"].split("csv+")
    assert (Path(f"{first}csv").read_text(), Path(second).read_text()) == ("camera.csv", "object.csv")
    assert Path(found[2].partition("#")[0]).read_text() == "two+cups.glb" and found[0].endswith("mug.glb#Cup")


def test_a_worker_that_lacks_files_which_it_was_sent_is_refused() -> None:
    pool = Simulated(answers={"w0": Failure("it lacks mug.obj", missing=True)})
    pool.add(2)
    told: list[str] = []
    assert {done.worker for done in carried(pool, tell=told.append)} == {"w1"}
    assert told == ["w0 is given nothing: it lacks mug.obj"]


def test_runs_that_share_a_worker_all_get_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """More of them than works that a worker holds: each range finds its work loaded again, and none is sent away."""
    monkeypatch.setattr("advsearch.cluster.worker._known", {})
    keys = [f"key {number}" for number in range(MOST_LOADED + 2)]
    try:
        for key in keys:
            assert isinstance(prepare(key, Work("cluster_work:squares", {}), Files({}, {}), version()), Ready)
        for key in keys * 2:
            done = carry_out_batch(key, range(3, 5))
            assert isinstance(done, Carried) and done.value == [9, 16]
        unknown = carry_out_batch("another", range(3, 5))
        assert isinstance(unknown, Failure) and unknown.forgotten
    finally:
        threads.configure()


def test_results_that_are_given_up_do_not_answer_what_is_asked_next() -> None:
    """Though their ranges are still under way, and though nobody has closed them."""
    pool = Simulated()
    pool.add(2)
    shared = coordinator(pool)
    first = shared.results(ranges(400))
    for _ in range(3):
        next(first)
    numbers = sorted(
        number for done in shared.results(iter([range(900, 901), range(901, 902)])) for number in done.items
    )
    assert numbers == [900, 901]
    with pytest.raises(RuntimeError, match="given up when others were asked for"):
        next(first)
