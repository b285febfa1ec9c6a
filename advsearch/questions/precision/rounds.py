"""Measures settings in interleaved rounds inside a time budget, cheapest first; nothing here knows how to render.

Every setting is measured once, then every setting again, so that a machine that slows down does so for all of them.
"""

from __future__ import annotations

import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from advsearch import seeds, threads
from advsearch.cluster import Executor
from advsearch.cluster.worker import processor
from advsearch.errors import ClusterError
from advsearch.questions.precision.answer import Machine
from advsearch.questions.precision.points import Array, MeasuredSetting

Result = TypeVar("Result")
Measure = Callable[[MeasuredSetting, int], tuple[Result, float]]
"""From a setting and a seed to what came out and the processor time that it took, in seconds."""

LEAST = 5
"""Calls of a setting that have to fit into the budget for it to be begun."""
CLAIM = 0.25
"""Share of the time left that one setting may lay claim to."""
MOST_PARTS = 64
"""Independent parts of a reference, at most."""


class Stopwatch:
    """Counts processor time, of all threads of this process, and wall time, from now on."""

    def __init__(self) -> None:
        self._processor, self._wall = time.process_time(), time.perf_counter()

    @property
    def processor(self) -> float:
        """Seconds of processor time: what other processes take does not count."""
        return time.process_time() - self._processor

    @property
    def wall(self) -> float:
        """Seconds by the clock."""
        return time.perf_counter() - self._wall


class TimeBudget:
    """Seconds from now on that may be spent, by a clock."""

    def __init__(self, seconds: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self._end = clock() + seconds

    @property
    def left(self) -> float:
        """Seconds left, not below 0."""
        return max(0.0, self._end - self.clock())

    def share(self, part: float) -> TimeBudget:
        """Return a budget of a part, in [0, 1], of what is left."""
        return TimeBudget(part * self.left, self.clock)


@dataclass
class Rounds(Generic[Result]):
    """What was measured: what came out and its processor time, for each setting; the seconds of each call by the clock;
    what did not fit into the budget at all; and whether every setting had all its rounds."""

    results: dict[MeasuredSetting, list[tuple[Result, float]]] = field(default_factory=dict)
    walls: dict[MeasuredSetting, list[float]] = field(default_factory=dict)
    left_out: tuple[MeasuredSetting, ...] = ()
    complete: bool = True


def in_rounds(
    settings: Iterable[MeasuredSetting],
    measure: Measure[Result],
    budget: TimeBudget,
    *,
    rounds: int,
    seed: int,
    least: int = LEAST,
    warm_up: int = 1,
    on_done: Callable[[MeasuredSetting], None] | None = None,
) -> Rounds[Result]:
    """Measure settings, cheapest first, in rounds until these are done or the budget is used up; the first is always
    measured.

    In the first round a setting is begun only if `least` calls of it, and those that the settings before it still need
    for as many, fit into what is left (see `Forecast`). The first call compiles and records kernels, so that every
    setting has `warm_up` calls more: without one, nothing would be known of its time. A call that should not fit is not
    begun: a budget is kept to within a setting's first calls. Each call has a seed of its own.
    """
    ordered = sorted(settings, key=lambda one: one.cost)
    found: Rounds[Result] = Rounds()
    forecast = Forecast(found.walls, cold=warm_up + 1 if warm_up else 0)

    def call(setting: MeasuredSetting) -> None:
        taken = found.results.setdefault(setting, [])
        name = f"precision {'/'.join(setting.line)}/{setting.spp}"
        begun = budget.clock()
        taken.append(measure(setting, seeds.stream(seed, name, len(taken))))
        found.walls.setdefault(setting, []).append(budget.clock() - begun)
        if on_done is not None:
            on_done(setting)

    for setting in ordered:
        needed = forecast.first() + least * forecast.seconds(setting) + forecast.owed(least, budget.left)
        if found.results and needed > budget.left:
            continue
        call(setting)
        for _ in range(warm_up):
            call(setting)
    begun = [one for one in ordered if one in found.results]
    for _ in range(1, rounds):
        for setting in begun:
            if forecast.seconds(setting) > budget.left:
                found.complete = False
            else:
                call(setting)
    found.left_out = tuple(one for one in ordered if one not in found.results)
    found.complete = found.complete and not found.left_out
    return found


class Forecast:
    """What a call should take by the clock, judged by those before it (seconds by setting), whose `cold` first ones
    take longer and say little."""

    def __init__(self, walls: dict[MeasuredSetting, list[float]], cold: int) -> None:
        self._walls, self._cold = walls, cold

    def seconds(self, setting: MeasuredSetting) -> float:
        """A call but the first: as the setting's own, else in proportion to its line's dearest setting, else at the
        highest rate of any line; 0 where nothing is known."""
        if setting in self._walls:
            return self._warm(setting)
        rates: dict[tuple[str, str, str], tuple[float, float]] = {}
        for one in self._walls:
            rates[one.line] = max(rates.get(one.line, (0.0, 0.0)), (one.cost, self._warm(one) / one.cost))
        if setting.line in rates:
            return rates[setting.line][1] * setting.cost
        return max((rate for _, rate in rates.values()), default=0.0) * setting.cost

    def first(self) -> float:
        """What the first calls take beyond that: the median so far."""
        more = [
            sum(taken[: self._cold]) - self._cold * self._warm(one)
            for one, taken in self._walls.items()
            if len(taken) > self._cold
        ]
        return max(0.0, statistics.median(more)) if more else 0.0

    def owed(self, least: int, left: float) -> float:
        """What the settings begun still need for as many calls each. One that needs more than a share `CLAIM` of what
        is left turned out too dear, and waits until the end."""
        needs = [max(0, least - len(taken)) * self._warm(one) for one, taken in self._walls.items()]
        return sum(need for need in needs if need <= CLAIM * left)

    def _warm(self, setting: MeasuredSetting) -> float:
        taken = self._walls[setting]
        return statistics.median((taken[self._cold :] or taken[-1:])[-3:])


Parts = Callable[[Iterator[int]], Iterator[tuple[int, Array]]]
"""From seeds to each seed with what came of it, in any order; asks for another seed only when it begins with it."""


def one_by_one(part: Callable[[int], Array]) -> Parts:
    """Return what carries out parts in this process, one after the other."""
    return lambda wanted: ((seed, part(seed)) for seed in wanted)


def gather(
    parts: Parts,
    budget: TimeBudget,
    *,
    seed: int,
    name: str = "reference",
    least: int = 2,
    most: int = MOST_PARTS,
    on_done: Callable[[], None] | None = None,
) -> list[Array]:
    """Return independent parts of a reference, each from a seed of its own, as many as fit into a budget.

    There are at least `least`, whatever they take: without two, nothing is known about the error.
    """
    found: list[Array] = []
    begun: dict[int, float] = {}
    slowest = 0.0

    def wanted() -> Iterator[int]:
        for number in range(most):
            if number >= least and slowest >= budget.left:
                return
            one = seeds.stream(seed, name, number)
            begun[one] = budget.left
            yield one

    for one, array in parts(wanted()):
        found.append(array)
        slowest = max(begun[one] - budget.left, 0.5 * slowest)
        if on_done is not None:
            on_done()
    return found


def part_samples(rate: float, seconds: float, *, parts: int = 4, counts: Sequence[int] = (16, 64, 256, 1024)) -> int:
    """Return the largest of some rising sample counts of which `parts` parts fit into some seconds; the least if none
    does. `rate` is seconds a sample."""
    fitting = [count for count in counts if parts * count * rate <= seconds]
    return fitting[-1] if fitting else counts[0]


def seconds_a_sample(call: Callable[[int], object], *, pilot: int = 16, calls: int = 2) -> float:
    """Return the seconds a sample of the last of some calls, each of so many samples."""
    for _ in range(calls):
        begun = time.perf_counter()
        call(pilot)
        seconds = time.perf_counter() - begun
    return seconds / pilot


@dataclass(frozen=True)
class ReferencePart:
    """A part of a reference: of what sitting, what of it or how it is taken (see `PictureBench.part` and
    `GradientBench.part_of`), samples a pixel, and the seed of its noise."""

    name: str
    by: str
    spp: int
    seed: int


def shared_parts(executor: Executor | None, name: str, by: str, spp: int) -> Parts | None:
    """Return what has workers carry out parts, or raises ClusterError if each dies of one; None where there are no
    workers."""
    if executor is None:
        return None

    def parts(wanted: Iterator[int]) -> Iterator[tuple[int, Array]]:
        results: Any = executor.results([ReferencePart(name, by, spp, seed)] for seed in wanted)
        with closing(results):
            for done in results:
                if done.lost:
                    raise ClusterError(f"{name}, a part of its reference: {done.lost}; leave `workers` out")
                yield done.items[0].seed, done.value[0]

    return parts


_CPU_INFO = Path("/proc/cpuinfo")


def timing_machine(cpu_info: Path = _CPU_INFO) -> Machine:
    """Return what a time has to be read with: the processor (of Linux's description), its cores, and the threads in
    use."""
    return Machine(
        cpu=processor(cpu_info),
        cores=threads.cores(),
        threads=_threads(),
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
    )


def _threads() -> dict[str, int]:
    """Threads of the renderer and of torch, as far as they are loaded."""
    found = {}
    if "drjit" in sys.modules:
        found["render"] = int(sys.modules["drjit"].thread_count())
    if "torch" in sys.modules:
        found["torch"] = int(sys.modules["torch"].get_num_threads())
    return found
