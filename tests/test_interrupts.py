"""Ctrl-C is answered wherever it strikes, once."""

import os
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from advsearch.cli.output import InterruptCheckingProgress
from advsearch.interrupts import (
    DUPLICATE_SECONDS,
    INTERRUPTS,
    Interrupts,
    report_unraisable_error,
    reraise_lost_interrupt,
)
from advsearch.progress import NullProgress
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from conftest import ROOT
from simulated_cluster import Simulated, SimulatedWorkers
from small_models import easy


def strike() -> None:
    """Press Ctrl-C, and let the handler run here."""
    signal.raise_signal(signal.SIGINT)
    sum(range(1000))


class Struck:
    def __del__(self) -> None:
        strike()


def in_a_destructor() -> None:
    Struck()


def in_a_callback() -> None:
    gone = type("Gone", (), {})()
    reference = weakref.ref(gone, lambda _: strike())
    del gone
    assert reference() is None


def in_a_library() -> None:
    try:
        strike()
    except:  # noqa: E722 (as theirs)
        pass


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Handler, hook and counts are as before afterwards."""
    monkeypatch.setattr(sys, "unraisablehook", report_unraisable_error)
    for name in ("n_received", "n_handled", "is_work_done", "_last_signal"):
        monkeypatch.setattr(INTERRUPTS, name, vars(Interrupts())[name])
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


LOST = [in_a_destructor, in_a_callback, in_a_library]


@pytest.mark.parametrize("lost", LOST)
def test_one_that_is_lost_is_raised_at_the_next_look_and_answered_once(lost: Callable[[], None]) -> None:
    steps = 0
    with pytest.raises(KeyboardInterrupt):
        with reraise_lost_interrupt():
            for steps in range(10):
                INTERRUPTS.raise_pending()
                if steps == 4:
                    lost()
    assert steps == 5
    INTERRUPTS.raise_pending()  # answered
    with pytest.raises(KeyboardInterrupt):
        with reraise_lost_interrupt():
            INTERRUPTS._last_signal = -1.0  # another Ctrl-C, later
            lost()
    with reraise_lost_interrupt():
        INTERRUPTS.raise_pending()


def test_what_was_made_of_one_is_the_interrupt_that_it_is() -> None:
    with pytest.raises(KeyboardInterrupt), reraise_lost_interrupt():
        in_a_library()
        raise RuntimeError("what native code says")
    with pytest.raises(ValueError, match="of its own"), reraise_lost_interrupt():
        raise ValueError("of its own")


def test_nested_blocks_answer_it_together() -> None:
    reached = []
    with reraise_lost_interrupt():
        try:
            with reraise_lost_interrupt():
                in_a_destructor()
                INTERRUPTS.raise_pending()
        except KeyboardInterrupt:
            reached.append("inner")
        INTERRUPTS.raise_pending()
        reached.append("what follows")
    assert reached == ["inner", "what follows"]


def scene_pictures() -> Any:
    return MitsubaScene.render_images(object.__new__(MitsubaScene), {}, {}, 1)


def model_answers() -> Any:
    model = easy()
    return model.run_network(model.prepare(torch.zeros(1, 8, 8, 3)))


def workers_results() -> Any:
    return list(SimulatedWorkers(Simulated()).compute([range(2)]))


def progress_advances() -> None:
    InterruptCheckingProgress(NullProgress()).advance()


def progress_stages() -> None:
    InterruptCheckingProgress(NullProgress()).stage("next")


@pytest.mark.medium
@pytest.mark.parametrize("look", [scene_pictures, model_answers, workers_results, progress_advances, progress_stages])
def test_whatever_takes_time_looks(look: Callable[[], Any]) -> None:
    with pytest.raises(KeyboardInterrupt):
        with reraise_lost_interrupt():
            in_a_destructor()
            with pytest.raises(KeyboardInterrupt):
                look()


SECOND = """
import hashlib, signal, sys, threading
from advsearch.cli import main
def given(argv):
    threading.Timer(1.0, print, ["begun"], {"flush": True}).start()  # an interrupt before the next line would end this
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # native code that knows no signals
main._run_and_report_errors, sys.argv = given, ["advsearch"]
sys.exit(main.main())
"""


@pytest.mark.medium
def test_a_second_one_ends_native_code_at_once_and_one_that_is_passed_on_does_not() -> None:
    words, environment = [sys.executable, "-c", SECOND], {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "begun\n"
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGINT)
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(1.0)
            process.send_signal(signal.SIGINT)
            assert process.wait(600) == 130
            assert process.stderr is not None and process.stderr.read() == "advsearch: interrupted\n"
        finally:
            process.kill()


def test_one_that_is_passed_on_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([5.0, 5.0 + DUPLICATE_SECONDS / 2, 6.0 + DUPLICATE_SECONDS])
    monkeypatch.setattr("advsearch.interrupts.time.monotonic", lambda: next(times))
    handler = Interrupts()
    with pytest.raises(KeyboardInterrupt):
        handler(2, None)
    handler(2, None)
    assert handler.n_received == 1
    with pytest.raises(KeyboardInterrupt):
        handler(2, None)
    assert handler.n_received == 2


SWALLOWING = """
import importlib.abc, importlib.util, os, signal, sys

Done = {'ending': 'found'}

def interrupted():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        while True:
            pass
    except KeyboardInterrupt:
        print("swallowed", flush=True)

def carry_out(config, *, progress, resumed_directory):
    import heavy
    {loading}
    print("searched", flush=True)
    sys.exit("expected nothing to be searched")

class Swallows(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path, target=None):
        return importlib.util.spec_from_loader(name, self) if name == "heavy" else None

    def exec_module(self, module):
        {importing}

sys.meta_path.insert(0, Swallows())
sys.argv[1:] = ["attack", "--object", "mug", "--json", *sys.argv[1:]]
import advsearch.experiment
from advsearch.cli.main import main
advsearch.experiment.run_experiment = carry_out
sys.exit(main())
"""


@pytest.mark.medium
@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
@pytest.mark.parametrize(
    "where",
    [
        {"importing": "interrupted()", "loading": "progress.stage('loading')"},
        {"importing": "pass", "loading": "progress.stage('loading'); interrupted(); progress.stage('searching', 9)"},
        {"importing": "pass", "loading": "interrupted(); return Done"},
    ],
    ids=["importing", "loading", "without a stage"],
)
def test_an_interrupt_that_an_import_swallows_is_not_lost(where: dict[str, str], quiet: list[str]) -> None:
    """Imports of others catch everything, so that what came meanwhile is raised when the stage ends."""
    code = SWALLOWING.replace("{importing}", where["importing"]).replace("{loading}", where["loading"])
    done = subprocess.run([sys.executable, "-c", code, *quiet], capture_output=True, text=True, timeout=600)
    assert done.returncode == 130 and "searched" not in done.stdout + done.stderr
    assert "swallowed" in done.stdout + done.stderr and done.stderr.endswith("advsearch: interrupted\n")


def test_an_interrupted_process_ends_without_the_interpreters_own_end() -> None:
    """What an interrupt inside native code leaves behind aborts there: status 134 and a dump of threads."""
    code = "import atexit, os; from advsearch.cli import main; "
    code += "main._run_to_status = lambda given: print('answer') or 130; "
    code += "atexit.register(os.abort); from advsearch.__main__ import start; start()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stdout, done.stderr) == (130, "answer\n", "")
