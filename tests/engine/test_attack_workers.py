"""An attack whose trials and plain evaluations workers make beforehand: the same rows, whatever happens to them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from stand_ins import shared

import advsearch
from advsearch.api.attack import attack_once
from advsearch.attacks import Evaluation, Proposal, make_policy, search
from advsearch.attacks.domain import Block, Domain
from advsearch.attacks.evaluation import Wanted
from advsearch.attacks.search import Line
from advsearch.cli.attack import answer
from advsearch.config import AttackConfig
from advsearch.engine.ahead import Ahead, TrialAhead, line_of
from advsearch.engine.attack_result import AttackResult
from advsearch.errors import InputError
from advsearch.runs.store import Row, Store

SMALL: dict[str, Any] = {
    "object": "mug", "controls": {"pose": {}}, "policy": "cmaes", "steps": 9, "trials": 6, "average": 3,
    "resolution": 24, "spp": 1, "verify_spp": 1, "denoise": "none", "measure": "no", "specialise": False,
}  # fmt: skip


def rows(run: Path) -> list[Row]:
    """What a run has stored, but for times and machines."""
    with Store(run / "results.sqlite", read_only=True) as store:
        found = [row for kind in store.counts() for row in store.rows(kind)]
    return [replace(row, seconds=None, time=None, machine=None, id=None) for row in found]


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
    ahead.begin([line_of(TrialAhead(u, 1, 1)), line_of(TrialAhead(u, 2, 1))])
    assert ahead.take(TrialAhead(u, 1, 1)) is None and ahead.facts is None and ahead.told == {}


RESTARTS = {"name": "restarts", "times": 3}


Noted = tuple[tuple[float, ...], int, Wanted, int]


@pytest.mark.parametrize(
    ("policy", "options", "cost", "missed"),
    [
        ({"name": "random"}, 0, 0, 0),
        ({"name": "cmaes"}, 0, 0, 0),
        ({"name": "sobol"}, 0, 0, 0),
        ({"name": "pgd"}, 0, 0, 60),
    ],
)
def test_announcements_are_what_comes_next(policy: dict[str, Any], options: int, cost: int, missed: int) -> None:
    """Of a population as many as are left of it; of a search along derivatives only the ranking."""
    dim = 3 + bool(options)
    blocks = (Block(3), *([Block(1, options=options)] if options else []))
    domain = Domain(torch.full((dim,), 0.5), blocks, gradient_cost=cost)
    told, alone = deque[Noted](), list[Noted]()

    def announce(coming: Callable[[], Sequence[Line]]) -> None:
        if not told:
            told.extend(one for line in coming() for one in carried(line))

    def carried(line: Line) -> Iterator[Noted]:
        coming = next(line, None)
        while coming is not None:
            one = coming.proposal
            yield noted(one, coming.index)
            try:
                coming = line.send(evaluated(one.u, one.gradient, one.samples))
            except StopIteration:
                return

    def noted(proposal: Proposal, index: int) -> Noted:
        return tuple(proposal.u.tolist()), index, proposal.gradient, proposal.samples

    def evaluated(u: torch.Tensor, gradient: Wanted, samples: int) -> Evaluation:
        slope = torch.cos(7.0 * u) if gradient else None
        taken = samples * (1 + (cost if gradient else 0))
        return Evaluation(float(torch.sin(7.0 * u).sum()), slope, False, cost=taken)

    def evaluate(u: torch.Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
        now = noted(Proposal(u, gradient, samples=samples), index)
        if not told or told.popleft() != now:
            alone.append(now)
            told.clear()
        return evaluated(u, gradient, samples)

    search(evaluate, domain, make_policy(**policy), steps=60, seed=0, announce=announce, together=64)
    assert len(alone) == missed


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["cmaes", RESTARTS])
def test_two_processes_have_the_rows_of_none(policy: Any, tmp_path: Path) -> None:
    settings = {**SMALL, "policy": policy, "steps": 24}
    attack_once(AttackConfig(**settings, run=str(tmp_path / "alone")))
    attack_once(AttackConfig(**settings, workers=2, run=str(tmp_path / "run")))
    assert rows(tmp_path / "run") == rows(tmp_path / "alone")


def test_what_is_loaded_already_is_not_shared() -> None:
    with pytest.raises(InputError, match="workers: expected names of objects, models, controls and an objective"):
        advsearch.attack(advsearch.load_scene("mug"), workers=2)
