"""An attack whose trials and plain evaluations workers make beforehand: the same rows, whatever happens to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch

import advsearch
from advsearch.api import attack as attacking
from advsearch.api.attack import announced_of, attack_once
from advsearch.attacks import Evaluation, make_policy, search
from advsearch.attacks.domain import Block, Domain
from advsearch.attacks.evaluation import Wanted
from advsearch.cli.attack import answer
from advsearch.cluster.executor import Done, InProcess, Workforce
from advsearch.config import AttackConfig
from advsearch.engine.ahead import Ahead, TrialAhead
from advsearch.engine.outcome import AttackResult
from advsearch.errors import InputError
from advsearch.runs.store import Row, Store

SMALL: dict[str, Any] = {
    "object": "mug", "controls": {"pose": {}}, "policy": "cmaes", "steps": 9, "trials": 6, "average": 3,
    "resolution": 24, "spp": 1, "verify_spp": 1, "denoise": "none", "measure": "no", "specialise": False,
}  # fmt: skip


@dataclass
class Ready:
    """Carries everything out in another problem that it has made from the settings, as a worker does."""

    made: InProcess
    lost: tuple[int, ...] = ()
    given: list[int] = field(default_factory=list)
    facts: Workforce | None = field(default_factory=lambda: Workforce(workers=2, most=2, busy=1.0, alive=2.0))

    def results(self, ranges: Iterable[range], given: Sequence[Any] | None = None) -> Iterator[Done]:
        assert given is not None
        first = len(self.given)
        for place, done in enumerate(self.made.results(reversed(list(ranges)), given)):
            self.given.append(done.numbers.start)
            away = "it died" if first + place in self.lost else ""
            yield Done(done.numbers, None if away else done.value, "tcp://1", "ab12" if place else None, away)


def rows(run: Path) -> list[Row]:
    """What a run has stored, but for times and machines."""
    with Store(run / "results.sqlite", read_only=True) as store:
        found = [row for kind in store.counts() for row in store.rows(kind)]
    return [replace(row, seconds=None, time=None, machine=None, id=None) for row in found]


def shared(monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], **more: Any) -> Ready:
    ready = Ready(InProcess(announced_of(settings)), **more)
    monkeypatch.setattr(attacking, "executor_of", lambda work, **_: nullcontext(ready))
    return ready


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> AttackResult:
    """The attack without workers."""
    return attack_once(AttackConfig(**SMALL, run=str(tmp_path_factory.mktemp("alone") / "run")))


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
    assert "2 at most, busy 50 %" in answer(result.summary) and result.summary.shared is not None
    assert alone.summary.shared is None


def test_a_picture_of_which_every_worker_dies_is_a_row_that_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**SMALL, "steps": 2, "policy": "random", "average": 0}
    shared(monkeypatch, settings, lost=(0, 9))
    result = attack_once(AttackConfig(**settings, workers=2, run=str(tmp_path / "run")))
    told = [row for row in rows(tmp_path / "run") if row.label == "(no answer)"]
    assert len(told) == 2 and all(row.correct is False and row.payload == {"lost": "it died"} for row in told)
    assert any("2 pictures have no answer" in text for text in result.summary.warnings)


def test_what_is_stored_is_not_asked_of_workers(
    alone: AttackResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Impatient(advsearch.progress.NullProgress):
        done = 0

        def advance(self, n: int = 1, **info: float | str) -> None:
            self.done += n
            if self.done > 20:
                raise KeyboardInterrupt

    config = AttackConfig(**SMALL, workers=2, run=str(tmp_path / "run"))
    whole = shared(monkeypatch, SMALL)
    assert attack_once(config, progress=Impatient()).summary.ending == "interrupted"
    rest = shared(monkeypatch, SMALL)
    attack_once(config, resumed=tmp_path / "run")
    assert alone.run is not None and rows(tmp_path / "run") == rows(alone.run)
    assert 0 < len(rest.given) < 9 + 9 + 2 * 6 + 6 + 3 and whole.given


def test_what_was_not_announced_is_done_here() -> None:
    ahead, u = Ahead(), torch.zeros(2)
    ahead.begin([TrialAhead(u, 1, 1), TrialAhead(u, 2, 1)])
    assert ahead.take(TrialAhead(u, 1, 1)) is None and ahead.facts is None and ahead.told == {}


@pytest.mark.parametrize("name", ["random", "cmaes", "sobol", "pgd"])
def test_announcements_are_what_comes_next(name: str) -> None:
    """Of a population as many as are left of it; of a policy that takes derivatives only the ranking."""
    domain = Domain(torch.full((3,), 0.5), (Block(3),))
    seen, told = list[tuple[tuple[float, ...], int]](), list[tuple[tuple[float, ...], int]]()

    def announce(coming: Sequence[tuple[torch.Tensor, int]]) -> None:
        told.extend((tuple(u.tolist()), index) for u, index in coming)

    def evaluate(u: torch.Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
        seen.append((tuple(u.tolist()), index))
        return Evaluation(float(u[0]), torch.tensor([1.0, 0.0, 0.0]) if gradient else None, False)

    search(evaluate, domain, make_policy(name), steps=11, seed=0, announce=announce, together=4)
    plain = [one for one in seen if name != "pgd" or one[1] >= 11]
    assert told == plain and len(told) > 3


@pytest.mark.slow
def test_two_processes_have_the_rows_of_none(alone: AttackResult, tmp_path: Path) -> None:
    attack_once(AttackConfig(**SMALL, workers=2, run=str(tmp_path / "run")))
    assert alone.run is not None and rows(tmp_path / "run") == rows(alone.run)


def test_what_is_loaded_already_is_not_shared() -> None:
    with pytest.raises(InputError, match="workers: expected names of objects, models and an objective"):
        advsearch.attack(advsearch.load_scene("mug"), workers=2)
