"""Shared by all tests: where the optional real data is, and how long tests take.

`make test` leaves out the tests marked `medium`. `pytest --measure` counts the CPU seconds of each test, which other
work on the machine changes little, and lists the tests whose marker is wrong.

`pytest -m slow --one-in 10` runs a tenth of the slow tests, another one every day.
"""

from __future__ import annotations

import ast
import gc
import os
import resource
import sys
import zlib
from collections import defaultdict
from collections.abc import Generator, Iterator
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from PIL import Image

import hidden_islands

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
"""Meshes, environments and an ImageNet classifier that nobody on this project made; see README. May be absent."""
if "PYTEST_XDIST_WORKER" in os.environ:
    # Side by side, tests render on one thread each: a second one polls for work, which takes a third of all the time.
    # `two_threads` is for what waits forever on one.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
WITH_CHARTS = ("report", "viewer", "api", "test_jobs.py", "test_docs.py")
"""Folders and files whose tests look at charts."""
QUICK = 0.15
"""CPU seconds that a test without the marker `medium` should take at most."""


@pytest.fixture(scope="session", autouse=True)
def own_models() -> None:
    """Allow the small models of the tests, which configurations of theirs name as files do. A command allows nothing
    but what it names."""
    from advsearch.trust.code import allow_code

    allow_code(*(f"small_models:{name}" for name in ("blind", "easy", "finder", "hard", "near", "strange", "Colours")))


@pytest.fixture(scope="module", autouse=True)
def empty_charts(request: pytest.FixtureRequest) -> Iterator[None]:
    """Draw no charts where no test looks at them: they take a third of a small attack and half of a small sweep."""
    if request.path.relative_to(ROOT / "tests").parts[0] in WITH_CHARTS:
        yield
        return
    from matplotlib.figure import Figure

    draw_and_save = Figure.savefig

    def save(figure: Figure, stream: Any, **options: Any) -> None:
        if options["format"] == "svg":
            stream.write(b"<svg><g ></g></svg>")
        elif options["format"] == "png":
            Image.new("RGB", (1, 1)).save(stream, "png")
        else:
            draw_and_save(figure, stream, **options)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Figure, "savefig", save)
        yield


@pytest.fixture(scope="module")
def scene() -> SceneDescription:
    """The bundled mug by itself; files that need another scene have a fixture of this name of their own."""
    from advsearch.scene.description import load_description

    return load_description("mug")


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


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """For a file of small tensors, which are slower with more threads, much slower where others want the processor."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of those that it started and that have ended."""
    own, others = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


class CpuTimes:
    """Sums the CPU seconds of each test and reports the slowest, and those whose marker does not fit."""

    def __init__(self) -> None:
        self.start = 0.0
        self.seconds: dict[str, float] = defaultdict(float)
        self.is_medium: dict[str, bool] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self) -> None:
        self.start = cpu_seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        now = cpu_seconds()
        # user properties go from a worker to the process that prints
        report.user_properties.append(("cpu", now - self.start))
        report.user_properties.append(("medium", item.get_closest_marker("medium") is not None))
        self.start = now
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        properties = dict(report.user_properties)
        self.seconds[report.nodeid] += float(str(properties["cpu"]))
        self.is_medium[report.nodeid] = bool(properties["medium"])

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        total = sum(self.seconds.values())
        terminalreporter.write_line(f"{total:.0f} CPU seconds in {len(self.seconds)} tests")
        for name, seconds in sorted(self.seconds.items(), key=lambda pair: -pair[1])[:20]:
            terminalreporter.write_line(f"{seconds:6.1f} {name}")
        unmarked = [name for name, seconds in self.seconds.items() if seconds > QUICK and not self.is_medium[name]]
        for name in sorted(unmarked, key=lambda name: -self.seconds[name]):
            terminalreporter.write_line(f"not marked medium: {self.seconds[name]:6.2f} {name}")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--without-islands", help="modules or kinds of islands that are hidden; all of them by `all`")
    parser.addoption("--measure", action="store_true", help="count CPU seconds, and list tests whose marker is wrong")
    parser.addoption("--one-in", type=int, default=1, help="of the slow tests run one in so many, others every day")
    parser.addoption("--day", type=date.fromisoformat, default=date.today(), help="which day's; as 2030-12-31")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--measure"):
        config.pluginmanager.register(CpuTimes())
    if config.getoption("--without-islands"):
        config.pluginmanager.register(WithoutIslands(config.getoption("--without-islands")))


class NotImported(pytest.Module):
    """A file of tests that is left out as a whole."""

    def collect(self) -> list[pytest.Item | pytest.Collector]:
        return []


class WithoutIslands:
    """Hides islands before the package is imported, and leaves out the tests that need them."""

    def __init__(self, asked: str) -> None:
        from test_islands import ELSEWHERE, island_of_module

        try:
            self.islands = hidden_islands.choose_islands(asked, island_of_module())
        except ValueError as error:
            raise pytest.UsageError(f"--without-islands: {error}") from None
        assert "advsearch" not in sys.modules  # it would have seen the islands already
        self.needs = {"all", *self.islands}
        modules = [*self.islands, *(name for name, island in ELSEWHERE.items() if island in self.islands)]
        hidden_islands.hide(modules)
        hidden_islands.hide_from_children(modules)

    def pytest_pycollect_makemodule(self, module_path: Path, parent: pytest.Collector) -> pytest.Module | None:
        """Do not import a file that needs a hidden island."""
        tree = ast.parse(module_path.read_text("utf-8"))
        if hidden_islands.list_marks_of_file(tree) & self.needs:
            return NotImported.from_parent(parent, path=module_path)
        return None

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Leave out the other tests that need one."""
        needing = [one for one in items if any(self.needs.intersection(m.args) for m in one.iter_markers("island"))]
        config.hook.pytest_deselected(items=needing)
        left_out = set(needing)
        items[:] = [one for one in items if one not in left_out]

    def pytest_report_header(self) -> str:
        return f"{len(self.islands)} islands are hidden"


def of_the_day(name: str, day: int, parts: int) -> bool:
    """Whether a slow test is one of those of a day: in as many days as there are parts, each is once."""
    return (zlib.crc32(name.encode()) + day) % parts == 0


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out slow tests that are not of the day."""
    parts = config.getoption("--one-in")
    day = config.getoption("--day").toordinal()
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
