"""A whole verdict where nobody says how many samples and trials it takes."""

from pathlib import Path
from typing import Any

import pytest

from advsearch.attacks import Ending, Evaluation, Query
from advsearch.attacks.verification import TRIAL_LOOKS
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from stand_ins import StandInProblem, carry_out, configuration, rows

UNASKED: AttackConfig = configuration().model_copy(update={"verify_spp": None, "trials": None, "average": 0})


def noted(monkeypatch: pytest.MonkeyPatch, after: int = -1) -> list[tuple[Any, ...]]:
    """The pictures that trials ask for, the first look left out; somebody presses Ctrl-C after so many."""
    original, made = StandInProblem.evaluate, list[tuple[Any, ...]]()

    def evaluate(self: StandInProblem, query: Query) -> Evaluation:
        if (query.phase is None and query.spp != self.search_spp) or query.kind.startswith("sample count"):
            if len(made) == after:
                raise KeyboardInterrupt
            made.append((query.u.numpy().tobytes(), query.seed, query.spp))
        return original(self, query)

    monkeypatch.setattr(StandInProblem, "evaluate", evaluate)
    return made


def test_the_pictures_that_choose_the_sample_count_are_no_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are looked at until they agree: whoever counted them as trials would find what holds by chance."""
    made = noted(monkeypatch)
    findings = carry_out(tmp_path / "run", UNASKED)
    assert findings.verification is not None and findings.verification.ending is Ending.FOUND
    assert (
        findings.verification.adversarial_counts.n_trials in TRIAL_LOOKS
        and findings.verification.stop_reason == "decided"
    )
    assert len(set(made)) == len(made) == findings.verification_renders, "no picture is made twice"
    with RunDirectory.resume(tmp_path / "run") as run:
        stored = [row for row in run.store.rows() if row.phase is None]
    assert sum(row.renders or 0 for row in stored) == len(stored) == len(made)
    chosen, tried = (
        {row.seed for row in stored if row.kind.startswith("sample count") is choosing} for choosing in (True, False)
    )
    assert chosen and tried and not chosen & tried


@pytest.mark.medium
@pytest.mark.parametrize("after", [3, 9, 21, 30])
def test_stopped_anywhere_it_goes_on_to_the_same_rows_and_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    whole = carry_out(tmp_path / "whole", UNASKED)
    with monkeypatch.context() as patch:
        noted(patch, after)
        assert carry_out(tmp_path / "run", UNASKED).interrupted
    made = noted(monkeypatch)
    found = carry_out(tmp_path / "run", UNASKED, resume=True)
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert len(made) == whole.verification_renders - after
    assert found.verification_renders == whole.verification_renders


def test_trials_that_are_asked_for_are_neither_more_nor_fewer(tmp_path: Path) -> None:
    asked = UNASKED.model_copy(update={"trials": 17})
    findings = carry_out(tmp_path / "run", asked)
    assert findings.verification is not None and findings.verification.stop_reason == "asked for"
    assert (len(findings.clean_trials), findings.verification.adversarial_counts.n_trials) == (17, 17)
