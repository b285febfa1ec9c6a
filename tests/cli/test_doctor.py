"""`advsearch doctor`: what it says of parts that work, are missing, are broken, or take their process down."""

import os
import sys
from argparse import Namespace
from collections.abc import Iterator

import pytest

from advsearch.cli import doctor
from advsearch.cli.doctor_probe import TRIALS
from advsearch.scene.mitsuba_backend import llvm

ALL_WELL = {name: (True, "tried") for name in TRIALS} | {"": (True, "")}


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    """No choice of a libLLVM is remembered from another test or left to one."""
    llvm.ensure_llvm.cache_clear()
    yield
    llvm.ensure_llvm.cache_clear()


@pytest.fixture
def well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every part works, and nothing is really tried."""
    monkeypatch.setattr(doctor, "run_probe", lambda: ALL_WELL)
    monkeypatch.setattr(doctor, "check_reference_weights", lambda: doctor.Component("reference model", "", doctor.OK))


def process_that(code: str) -> tuple[str, ...]:
    """A command that stands for the probe."""
    return (sys.executable, "-c", code)


def test_a_part_that_does_not_work_is_told_with_what_to_do_and_status_3(
    well: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "run_probe", lambda: ALL_WELL | {"xatlas": (False, "ImportError: no such file")})
    assert doctor.doctor.run(Namespace(json=False)) == 3
    text = capsys.readouterr().out
    assert "broken" in text and "ImportError: no such file" in text
    assert "xatlas: pip install --force-reinstall --no-deps xatlas" in text
    assert "Something necessary does not work." in text


def test_a_process_that_is_taken_down_leaves_the_parts_before_it_and_how_it_ended() -> None:
    code = (
        "import json, os, sys; print('a library says hello')\n"
        "print(json.dumps({'name': 'numpy', 'ok': True, 'detail': ''}), flush=True)\n"
        "print('LLVM ERROR: Cannot select: f32 = fminimum', file=sys.stderr, flush=True); os.abort()"
    )
    tried = doctor.run_probe(process_that(code))
    assert set(tried) == {"numpy", ""}
    parts = {part.name: part for part in doctor.check_packages(tried)}
    assert parts["numpy"].status == doctor.OK
    assert parts["render"].status == doctor.BROKEN
    assert "SIGABRT (LLVM ERROR: Cannot select" in parts["render"].detail
    assert parts["render"].fix == "see libLLVM below"


@pytest.mark.medium
def test_every_part_really_works_here() -> None:
    """The only test that tries them: imports, a render with its gradient, a denoised picture."""
    tried = doctor.run_probe()
    assert {name for name, (worked, _) in tried.items() if not worked} == set(), tried
    assert set(tried) == set(ALL_WELL)


@pytest.mark.medium
def test_an_old_llvm_takes_the_probe_down_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the guard switched off, as a user has it who calls Mitsuba by hand."""
    old = [c.path for c in llvm.find_libraries() if c.version and c.version[0] in (15, 16)]
    if not old:
        pytest.skip("no libLLVM 15 or 16 on this machine")
    code = (
        "import runpy, advsearch.scene.mitsuba_backend.llvm as llvm, advsearch.cli.doctor_probe as probe\n"
        "llvm.MIN_VERSION = 15; probe.TRIALS = {'render': probe.probe_renderer}; probe.main()"
    )
    monkeypatch.setenv(llvm.ENVIRONMENT_VARIABLE, str(old[0]))
    monkeypatch.setenv("HOME", os.devnull + "/none")  # no kernels from an earlier render
    tried = doctor.run_probe(process_that(code))
    if tried.get("render", (False, ""))[0]:
        pytest.skip("this processor can do without the operation that old versions lack")
    assert "signal SIGABRT" in tried[""][1] or "fminimum" in tried[""][1]
