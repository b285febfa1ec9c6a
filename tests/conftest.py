"""Shared by all tests: where the optional real data is, and which tests `make test-quick` leaves out.

`pytest --measure` counts the CPU seconds of each test, which other work on the machine does not change, and keeps the
names of those that are not quick in tests/medium.txt.

`pytest -m slow --one-in 10` runs a tenth of the slow tests, another one every day.
"""

from __future__ import annotations

import gc
import os
import resource
import zlib
from collections import defaultdict
from collections.abc import Generator, Iterator
from datetime import date
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
"""Meshes, environments and an ImageNet classifier that nobody on this project made; see README. May be absent."""
MEDIUM = Path(__file__).with_name("medium.txt")
if "PYTEST_XDIST_WORKER" in os.environ:
    # Side by side, tests render on one thread each: a second one polls for work, which takes a third of all the time.
    # `two_threads` is for what waits forever on one.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
QUICK, QUICKEST = 0.15, 5.0
"""CPU seconds of a quick test, at most; and of the quickest of a file, which is quick all the same."""


@pytest.fixture(scope="session", autouse=True)
def own_models() -> None:
    """Allow the small models of the tests, which configurations of theirs name as files do. A command allows nothing
    but what it names."""
    from advsearch.trust.code import allow_code

    allow_code(*(f"small_models:{name}" for name in ("easy", "hard", "near", "strange", "Colours")))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real test data, or a skip that says what is missing."""
    if not (DATA / "models").is_dir():
        pytest.skip("the folder ../shared/data with real meshes, environments and a classifier is not here")
    return DATA


@pytest.fixture(scope="module")
def two_threads() -> Iterator[None]:
    """For a file whose tests let Mitsuba load files by itself, which waits forever where Dr.Jit has one thread."""
    from advsearch import threads

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(threads, "_USERS_COUNT", "2")
        threads.configure()
        yield
    threads.configure()


def medium() -> set[str]:
    """Return the names of the tests that are not quick, as pytest has them."""
    return set(MEDIUM.read_text("utf-8").splitlines())


def is_there(name: str) -> bool:
    """Whether there is a test of that name, whatever its parameters are."""
    file, _, function = name.partition("[")[0].partition("::")
    return (ROOT / file).exists() and f"\ndef {function}(" in (ROOT / file).read_text("utf-8")


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of those that it started and that have ended."""
    own, others = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


class Measured:
    """Sums the CPU seconds of each test and keeps the names of those that are not quick."""

    def __init__(self) -> None:
        self.begun = 0.0
        self.spent: dict[str, float] = defaultdict(float)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self) -> None:
        self.begun = cpu_seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        now = cpu_seconds()
        report.user_properties.append(("cpu", now - self.begun))  # goes from a worker to the process that writes
        self.begun = now
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.spent[report.nodeid] += sum(float(str(value)) for name, value in report.user_properties if name == "cpu")

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        quickest = dict[str, float]()
        for name, seconds in self.spent.items():
            file = name.partition("::")[0]
            quickest[file] = min(seconds, quickest.get(file, QUICKEST))
        kept = {name for name in medium() if name not in self.spent and is_there(name)}
        bounds = {name: max(QUICK, quickest[name.partition("::")[0]]) for name in self.spent}
        found = kept | {name for name, seconds in self.spent.items() if seconds > bounds[name]}
        MEDIUM.write_text("".join(f"{name}\n" for name in sorted(found)), encoding="utf-8")
        terminalreporter.write_line(f"{sum(self.spent.values()):.0f} CPU seconds in {len(self.spent)} tests")
        for name, seconds in sorted(self.spent.items(), key=lambda pair: -pair[1])[:20]:
            terminalreporter.write_line(f"{seconds:6.1f} {name}")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--measure", action="store_true", help="count CPU seconds and renew tests/medium.txt")
    parser.addoption("--one-in", type=int, default=1, help="of the slow tests run one in so many, others every day")
    parser.addoption("--day", type=date.fromisoformat, default=date.today(), help="which day's; as 2030-12-31")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--measure"):
        config.pluginmanager.register(Measured())


def of_the_day(name: str, day: int, parts: int) -> bool:
    """Whether a slow test is one of those of a day: in as many days as there are parts, each is once."""
    return (zlib.crc32(name.encode()) + day) % parts == 0


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests that are not quick, and leave out slow ones that are not of the day."""
    known, parts, day = medium(), config.getoption("--one-in"), config.getoption("--day").toordinal()
    for item in items:
        if item.nodeid in known:
            item.add_marker("medium")
    kept = [one for one in items if not one.get_closest_marker("slow") or of_the_day(one.nodeid, day, parts)]
    config.hook.pytest_deselected(items=[*set(items).difference(kept)])
    items[:] = kept


def pytest_collection_finish() -> None:
    """Let the garbage collector, which every change of Mitsuba's scenes calls, pass over all that was imported."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, None, None]:
    """The same after each file, of what its tests have imported."""
    yield
    if nextitem is not None and nextitem.path != item.path:
        gc.collect()
        gc.freeze()
