"""What whoever waits is told: every stage has a name in plain words, and no count goes beyond its total."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch

from advsearch.attacks import Evaluation, Query, make_policy
from advsearch.cli.flags import format_as_flags
from advsearch.config import CONFIGS
from advsearch.engine.problem import Problem
from advsearch.engine.record import RunState
from advsearch.experiment import run_experiment as answered
from advsearch.progress import Stages
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.sweep.carry_out import sweep_from_config
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import RunDirectory
from stand_ins import StandInProblem, attack_on, carry_out, configuration, rows

JARGON = re.compile(r"set-up|rerank|adjoint|estimator|baseline|sample count|spp|bounces$|verification", re.IGNORECASE)
"""Words of our own, which nobody who waits should have to know."""


@dataclass
class Stage:
    """One stage as it was told."""

    name: str
    total: int | None
    hint: str
    at_most: bool
    done: int = 0


@dataclass
class Recorded:
    """A watcher that remembers."""

    stages: list[Stage] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        self.stages.append(Stage(name, total, hint, at_most))

    def advance(self, n: int = 1, **info: float | str) -> None:
        self.stages[-1].done += n

    def message(self, text: str) -> None:
        self.messages.append(text)

    def check(self) -> None:
        """Every stage has a name in plain words, and an honest end; what counts says of how many."""
        assert self.stages
        for one in self.stages:
            assert one.name and not JARGON.search(one.name), one
            assert one.total is not None or one.done == 0, f"{one.name} counts {one.done} of nobody knows how many"
            assert one.total is None or one.done <= one.total, f"{one.name} counts {one.done} of {one.total}"

    def named(self, part: str) -> list[Stage]:
        return [one for one in self.stages if part in one.name]


def attacked(config: AttackConfig, problem: Any = None) -> tuple[Recorded, RunState]:
    """An attack without the renderer, in memory."""
    progress = Recorded()
    problem = problem or StandInProblem()
    policy = make_policy(config.policy_name)
    return progress, attack_on(problem, config, policy, Stages(progress))


@pytest.mark.parametrize("policy", ["pgd", "auto", "random", "cmaes"])
def test_an_attack_counts_what_it_says(policy: str) -> None:
    progress, findings = attacked(configuration(policy).model_copy(update={"verify_spp": None}))
    progress.check()
    (checking,) = progress.named("checking what was found")
    beside = findings.baseline_verification
    assert checking.total == 6 * (2 if policy == "random" else 3) and checking.at_most
    assert checking.done == 12 + (len(beside.adversarial_trials) if beside else 0)
    assert "`trials` or `verify_spp` shorten it" in checking.hint and "samples a pixel" in checking.hint
    (search,) = progress.named(f"searching with {policy}")
    assert search.total == 33 and 25 <= search.done <= 33 and "`steps` or `seconds`" in search.hint
    assert progress.named("how many samples")[0].at_most


@dataclass
class Easy(StandInProblem):
    """Wrong wherever it is moved a little."""

    def _logits(self, u: torch.Tensor, seed: int) -> torch.Tensor:
        value = 50.0 * (u - 0.5).abs().max() - 1.0
        return torch.stack([-value, value])


def test_the_smallest_change_counts_what_it_says() -> None:
    problem = Easy()
    blocks = tuple(block for block in problem.domain.blocks if block.epsilon is not None)
    problem.domain = type(problem.domain)(torch.full((4,), 0.5), blocks)
    progress, findings = attacked(configuration(smallest=True), problem)
    assert findings.smallest_change_bracket is not None and findings.smallest_change_bracket.searches > 1
    progress.check()
    assert progress.named("search 1 of at most 12")[0].total == 33
    assert progress.named("trying smaller changes")[0].done > 6


FEW: dict[str, Any] = {"object": "mug", "resolution": 16, "threads": 1}
SMALL: dict[str, Any] = {**FEW, "spp": 1}


@pytest.mark.medium
@pytest.mark.parametrize(
    ("command", "given"),
    [
        ("attack", {**SMALL, "steps": 3, "trials": 6, "average": 2, "verify_spp": 2}),
        ("sweep", {**SMALL, "grid": {"pose.yaw": "0,90"}, "trials": 6}),
        pytest.param(
            "region",
            {**FEW, "controls": {"camera": {}}, "vary": "camera.azimuth", "samples": 8, "verify_spp": 1},
            marks=pytest.mark.island("advsearch.questions.region"),
        ),
        pytest.param(
            "precision",
            {
                **SMALL, "controls": {"light": {}}, "quantities": "image", "seconds": 1, "rounds": 3,
                "samplers": "independent",
            },
            marks=pytest.mark.island("advsearch.questions.precision"),
        ),
    ],
)  # fmt: skip
def test_every_command_says_what_it_does_and_how_far_it_is(tmp_path: Path, command: str, given: dict[str, Any]) -> None:
    progress = Recorded()
    answered(CONFIGS[command](**given, run=str(tmp_path / "run")), progress=progress)
    progress.check()
    hints = [format_as_flags(one.hint) for one in progress.stages]
    assert any("--" in one for one in hints) and not any("`" in one for one in hints)


@pytest.mark.medium
def test_a_resumed_sweep_takes_the_probes_of_its_worst_configuration_from_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SweepConfig(**SMALL, grid={"pose.yaw": "0,90"}, trials=14, run=str(tmp_path / "whole"))
    whole = sweep_from_config(config)
    rendered, stop = 0, 5
    once = Problem.evaluate

    def trial(self: Any, *given: Any) -> Any:
        nonlocal rendered
        rendered += 1
        if rendered == stop:
            raise KeyboardInterrupt
        return once(self, *given)

    monkeypatch.setattr(Problem, "evaluate", trial)
    cut = sweep_from_config(config.model_copy(update={"run": str(tmp_path / "run")}))
    assert cut.summary.ending == "interrupted"
    stop, rendered = 0, 0
    resumed = sweep_from_config(config, resumed=tmp_path / "run")
    assert rendered + 4 == whole.summary.renders["verification"] == resumed.summary.renders["verification"]
    assert resumed.summary.worst == whole.summary.worst
    with RunDirectory.resume(tmp_path / "run") as run, RunDirectory.resume(tmp_path / "whole") as other:
        counts = run.store.count_by_kind()
        assert counts == other.store.count_by_kind() and counts["sample count worst"] + 14 == rendered + 4


def test_a_resumed_run_takes_its_probes_from_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = configuration().model_copy(update={"verify_spp": None})
    whole = carry_out(tmp_path / "whole", config)
    rendered: list[tuple[int, bool]] = []
    once = StandInProblem.evaluate

    def evaluate(self: Any, query: Query) -> Evaluation:
        if query.phase is None:
            rendered.append((query.spp, query.draws_conditions))
            if len(rendered) == stop:
                raise KeyboardInterrupt
        return once(self, query)

    monkeypatch.setattr(StandInProblem, "evaluate", evaluate)
    stop = 4 + 10  # the first look, then in the middle of the probes
    assert carry_out(tmp_path / "run", config).interrupted
    stop, before = 0, len([one for one in rendered if not one[1]])
    rendered.clear()
    resumed = carry_out(tmp_path / "run", config, resume=True)
    again = len([one for one in rendered if not one[1]])
    assert resumed.sample_count == whole.sample_count and whole.sample_count is not None
    assert before - 1 + again == whole.sample_count.renders  # the one that was interrupted is rendered again
    assert resumed.verification_renders == whole.verification_renders
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
