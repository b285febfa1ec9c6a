"""Runs that an earlier version wrote are read, shown, reported, replayed and gone on with.

`earlier/` has an attack and a sweep of version 0.1.0 as of 24 November 2026, as its commands wrote them at 16 x 16
pixels: `run.yaml` with `step_size`, results of version 5 as SQL, and summaries without what came later.
"""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

import advsearch
from advsearch.api import carry_out
from advsearch.cli.main import main
from advsearch.config import AttackConfig, SweepConfig
from advsearch.engine.attack_result import AttackResult
from advsearch.engine.sweeps.summary import SweepResult
from advsearch.runs.directory import CONFIG
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import NAME, Store
from advsearch.runs.summary import NAME as SUMMARY
from advsearch.runs.summary import read_result

EARLIER = Path(__file__).with_name("earlier")


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The runs as folders in `runs/`."""
    shutil.copytree(EARLIER, tmp_path / "runs")
    for text in (tmp_path / "runs").rglob("results.sql"):
        with closing(sqlite3.connect(text.with_name(NAME))) as made:
            made.executescript(text.read_text("utf-8"))
        text.unlink()
    monkeypatch.chdir(tmp_path)
    return tmp_path / "runs"


def stopped(run: Path, *left: str) -> None:
    """Make of a run one that was killed: without its summary, and without some of its rows."""
    (run / SUMMARY).unlink()
    with closing(sqlite3.connect(run / NAME)) as results:
        for rows in left:
            results.execute(f"DELETE FROM evaluations WHERE {rows}")
        results.commit()


def test_they_are_loaded_shown_and_reported(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    attacked, swept = advsearch.load_run("texture"), advsearch.load_run("sweep")
    assert isinstance(attacked, AttackResult) and attacked.u.shape == (16 * 16 * 3,)
    assert attacked.summary.ending == "already wrong" and attacked.summary.verified is not None
    assert [row.step for row in attacked.rows("control")] == list(range(6))
    assert isinstance(swept, SweepResult) and len(list(swept.rows())) == swept.summary.configurations == 2
    for run, said in (("texture", "The model already calls this mug a dumbbell"), ("sweep", "The model is right in ")):
        assert main(["show", run]) == 0 and capsys.readouterr().out.startswith(said)
    assert main(["report", "texture", "sweep", "--evidence", "--out", "card"]) == 0
    assert "the model is wrong about the clean scene already" in Path("card/evidence.md").read_text("utf-8")


def test_a_setting_that_is_an_option_now_is_read_as_that(runs: Path) -> None:
    assert AttackConfig.from_yaml(runs / "texture" / CONFIG).policy == {"name": "pgd", "step_size": 0.25}
    without = (runs / "texture" / CONFIG).read_text().replace("step_size: 0.25", "step_size: null")
    (runs / "texture" / CONFIG).write_text(without)
    assert AttackConfig.from_yaml(runs / "texture" / CONFIG).policy == "pgd"


def test_an_answer_is_replayed(runs: Path) -> None:
    assert main(["replay", "texture", "--trials", "6", "--run", "again", "--quiet"]) == 0
    assert read_result(Path("runs/again")).to_dict()["command"] == "replay"


def test_a_verification_that_was_stopped_goes_on(runs: Path) -> None:
    before = read_result(runs / "texture")
    assert isinstance(before, AttackSummary)
    stopped(runs / "texture", "kind = 'verification' AND step > 2")
    found = carry_out(AttackConfig.from_yaml(runs / "texture" / CONFIG), resumed=runs / "texture")
    assert isinstance(found, AttackSummary) and found.ending == before.ending
    assert found.clean.control == before.clean.control
    with Store(runs / "texture" / NAME, read_only=True) as results:
        assert results.last_step("verification") == 5
        assert [row.step for row in results.rows("search")] == list(range(9)), "nothing is searched again"


def test_a_sweep_that_was_stopped_goes_on(runs: Path) -> None:
    before = read_result(runs / "sweep")
    stopped(runs / "sweep", "kind = 'sweep' AND step > 0", "kind <> 'sweep'")
    after = carry_out(SweepConfig.from_yaml(runs / "sweep" / CONFIG), resumed=runs / "sweep")
    assert isinstance(before, SweepSummary) and isinstance(after, SweepSummary)
    assert (after.configurations, after.correct, after.axes) == (before.configurations, before.correct, before.axes)
