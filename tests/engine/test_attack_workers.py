"""An attack whose trials and plain evaluations workers make beforehand: the same rows, whatever happens to them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch.cli.output import format_result as text_of
from advsearch.questions.attack.result import AttackResult
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.store import Row, Store
from stand_ins import shared

SMALL: dict[str, Any] = {
    "object": "mug", "controls": {"pose": {}}, "policy": "cmaes", "steps": 9, "trials": 6, "average": 3,
    "resolution": 24, "spp": 1, "verify_spp": 1, "denoise": "none", "measure": "no",
}  # fmt: skip


def rows(run: Path) -> list[Row]:
    """What a run has stored, but for times and machines."""
    with Store(run / "results.sqlite", read_only=True) as store:
        found = [row for kind in store.count_by_kind() for row in store.rows(kind)]
    return [replace(row, seconds=None, time=None, machine=None, id=None) for row in found]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> AttackResult:
    """The attack without workers."""
    return attack_once(AttackConfig(**SMALL, run=str(tmp_path_factory.mktemp("alone") / "run")))


@pytest.mark.medium
def test_workers_have_the_rows_of_none(alone: AttackResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done beforehand: populations, the random search, both rankings, the trials of all groups, the average."""
    ready = shared(monkeypatch, SMALL)
    result = attack_once(AttackConfig(**SMALL, workers=2, run=str(tmp_path / "run")))
    assert alone.run is not None and rows(tmp_path / "run") == rows(alone.run)
    assert result.summary.model_dump(exclude={"run", "seconds", "shared", "command_line", "warnings"}) == (
        alone.summary.model_dump(exclude={"run", "seconds", "shared", "command_line", "warnings"})
    )
    assert len(ready.given) >= 9 + 9 + 2 * 6 + 6 + 3 and torch.equal(result.adversarial, alone.adversarial)
    assert all((tmp_path / "run" / "images" / one.name).exists() for one in (alone.run / "images").iterdir())
    with Store(tmp_path / "run" / "results.sqlite", read_only=True) as store:
        assert {row.machine for row in store.rows("verification")} == {None, "ab12"}
    assert any("machines that are not alike" in text for text in result.summary.warnings)
    assert "2 at most, busy 50 %" in text_of(result.summary) and result.summary.shared is not None
    assert alone.summary.shared is None


@pytest.mark.medium
def test_a_picture_of_which_every_worker_dies_is_a_row_that_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**SMALL, "steps": 2, "policy": "random", "average": 0}
    shared(monkeypatch, settings, lost=(0, 9))
    result = attack_once(AttackConfig(**settings, workers=2, run=str(tmp_path / "run")))
    told = [row for row in rows(tmp_path / "run") if row.label == "(no answer)"]
    assert len(told) == 2 and all(row.correct is False and row.payload == {"lost": "it died"} for row in told)
    assert any("2 pictures have no answer" in text for text in result.summary.warnings)


class Impatient(advsearch.progress.NullProgress):
    done = 0

    def advance(self, n: int = 1, **info: float | str) -> None:
        self.done += n
        if self.done > 20:
            raise KeyboardInterrupt


@pytest.mark.medium
def test_what_is_stored_is_not_asked_of_workers(
    alone: AttackResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = AttackConfig(**SMALL, workers=2, run=str(tmp_path / "run"))
    whole = shared(monkeypatch, SMALL)
    assert attack_once(config, progress=Impatient()).summary.ending == "interrupted"
    rest = shared(monkeypatch, SMALL)
    attack_once(config, resumed=tmp_path / "run")
    assert alone.run is not None and rows(tmp_path / "run") == rows(alone.run)
    assert 0 < len(rest.given) < 9 + 9 + 2 * 6 + 6 + 3 and whole.given


@pytest.mark.medium
def test_light_is_searched_by_workers_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {**SMALL, "environment": "low-sun", "controls": {"projector": {"resolution": 2}}}
    attack_once(AttackConfig(**settings, run=str(tmp_path / "alone")))
    config = AttackConfig(**settings, workers=2, run=str(tmp_path / "run"))
    shared(monkeypatch, settings)
    assert attack_once(config, progress=Impatient()).summary.ending == "interrupted"
    rest = shared(monkeypatch, settings)
    attack_once(config, resumed=tmp_path / "run")
    assert rest.given and rows(tmp_path / "run") == rows(tmp_path / "alone")


RESTARTS = {"name": "restarts", "times": 3}


@pytest.mark.medium
def test_searches_side_by_side_have_the_rows_of_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Restarts along derivatives, by differences here, each evaluation after the one before in its restart."""
    settings = {**SMALL, "policy": RESTARTS, "steps": 30, "average": 0, "baseline": False}
    attack_once(AttackConfig(**settings, run=str(tmp_path / "run")))
    ready, found = shared(monkeypatch, settings), rows(tmp_path / "run")
    attack_once(AttackConfig(**settings, workers=2, run=str(tmp_path / "workers")))
    assert rows(tmp_path / "workers") == found and max(row.renders or 0 for row in found) > 1
    assert len(ready.given) >= 0.9 * len(found), "hardly any is rendered here"


@pytest.mark.slow
def test_two_processes_have_the_rows_of_none(tmp_path: Path) -> None:
    settings = {**SMALL, "policy": RESTARTS, "steps": 24}
    attack_once(AttackConfig(**settings, run=str(tmp_path / "alone")))
    attack_once(AttackConfig(**settings, workers=2, run=str(tmp_path / "run")))
    assert rows(tmp_path / "run") == rows(tmp_path / "alone")
