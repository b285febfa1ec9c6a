"""A run that is killed at any moment goes on to the same rows; without the renderer, on a problem in closed form."""

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.attacks import Domain, Evaluated, Evaluation, Policy, Proposal, Query, make_policy
from advsearch.engine.journal import Journal, ParallelEvaluator, compute_code_digest
from advsearch.errors import InputError, RunExistsError
from advsearch.progress import NullProgress, Stages
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs import files
from advsearch.runs.directory import RunDirectory, read_python_only
from advsearch.runs.listing import can_resume
from advsearch.runs.store import CachedEvaluation, Row, Store
from advsearch.settings import PythonOnly
from conftest import ROOT
from covering import only
from stand_ins import StandInProblem, attack_on, carry_out, configuration, rows

POLICIES = ("pgd", "auto", "random", "cmaes")


def kill_and_resume(folder: Path, policy: str) -> int:
    """Carry the attack out in children of which each is killed at a random moment, and return how many were.

    One in `folder`'s neighbour `whole` is left alone, first: after it children import nothing and start at once.
    """
    torch.set_num_threads(1)
    carry_out(folder.parent / "whole", configuration(policy))
    moments, kills, begun = random.Random(policy), 0, False
    while kills < 300:
        child = os.fork()
        if child == 0:
            carry_out(folder, configuration(policy), pause=0.003, resume=begun)
            os._exit(0)
        time.sleep(moments.uniform(0.002, 0.06) * (1.0 + kills / 4))  # a policy thinks again: that takes its time
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            assert status == 0, "it ended by itself, and not well"
            return kills
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        kills += 1
        begun = (folder / "run.yaml").exists()
    raise AssertionError("it does not get on")


@pytest.mark.medium
@pytest.mark.parametrize("policy", only(["pgd"], POLICIES))
def test_killed_at_random_moments_it_ends_with_the_same_rows(tmp_path: Path, policy: str) -> None:
    code = "import sys, test_resume as t; print(t.kill_and_resume(t.Path(sys.argv[1]), sys.argv[2]))"
    driver = [
        sys.executable,
        "-c",
        code,
        str(tmp_path / "run"),
        policy,
    ]  # forks, which a process with pytest's threads must not
    done = subprocess.run(
        driver,
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join((str(ROOT / "tests"), str(ROOT)))},
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 5, "it was hardly killed"
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert not can_resume(tmp_path / "run")


def test_what_was_evaluated_is_not_evaluated_again(tmp_path: Path) -> None:
    config, count = configuration(), 0

    def counted() -> None:
        nonlocal count
        count += 1
        if count == 10:
            raise KeyboardInterrupt

    problem: Any = StandInProblem(on_evaluation=counted)
    with RunDirectory.create(tmp_path / "run", config=config) as run:
        assert attack_on(problem, config, make_policy("pgd"), Stages(NullProgress()), run).interrupted
    assert can_resume(tmp_path / "run")
    found = carry_out(tmp_path / "run", config, resume=True)
    assert found.search_result is not None and len(found.search_result.history) == 25
    assert len(found.search_frames) == 25  # those from before the interrupt too
    whole = carry_out(tmp_path / "whole", config)
    assert whole.search_result is not None and torch.equal(whole.search_result.best_u, found.search_result.best_u)
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")


@pytest.mark.parametrize("trials", [5, 13, 16])
def test_an_interrupt_of_the_check_keeps_the_configuration_and_going_on_verifies_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trials: int
) -> None:
    """In the first of what finds the samples, in the control group, and in the trials of the answer."""
    config = configuration().model_copy(update={"verify_spp": None if trials == 5 else 8})
    whole, rendered, once = carry_out(tmp_path / "whole", config), 0, StandInProblem.evaluate
    answered = list[tuple[str, int]]()

    def evaluate(self: Any, query: Query) -> Evaluation:
        nonlocal rendered
        rendered += query.phase is None
        if rendered == trials:
            raise KeyboardInterrupt
        answered.append((query.kind, query.row_index))
        return once(self, query)

    monkeypatch.setattr(StandInProblem, "evaluate", evaluate)
    stopped = carry_out(tmp_path / "run", config)
    assert stopped.interrupted and stopped.verification is None
    assert stopped.search_result is not None and whole.search_result is not None
    assert torch.equal(stopped.search_result.best_u, whole.search_result.best_u)
    resumed = carry_out(tmp_path / "run", config, resume=True)
    assert resumed.verification is not None and whole.verification is not None
    assert resumed.verification.adversarial_counts == whole.verification.adversarial_counts
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    once_each = [number for kind, number in answered if kind == "control"]
    assert once_each == list(range(config.trial_count)), "what was tried is not tried again"


def test_another_configuration_than_was_stored_is_refused(tmp_path: Path) -> None:
    with RunDirectory.create(tmp_path / "run") as run:
        problem: Any = StandInProblem()
        query = Query(torch.full((6,), 0.5), 1, phase="search")
        (found,) = Journal(run, ParallelEvaluator(problem)).evaluate_all([query])
        (again,) = Journal(run, ParallelEvaluator(problem)).evaluate_all([query])
        assert again.objective == found.objective
        for other in (replace(query, u=torch.full((6,), 0.4)), replace(query, seed=2)):
            with pytest.raises(InputError, match="cannot resume"):
                list(Journal(run, ParallelEvaluator(problem)).evaluate_all([other]))


CHANGES: dict[str, Any] = {
    "seed": 1, "steps": 26, "trials": 40, "spp": 7, "epsilon": 0.05, "exposure": 1.0, "set": {"camera.azimuth": 9.0},
    "label": "bowl", "task": "fading", "model": "torchvision:resnet18",
    "policy": {"name": "pgd", "momentum": 0.5}, "average": 6,
    "controls": {"texture": {"resolution": 8}}, "denoise": "none", "deterministic": True, "baseline": False,
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_a_run_goes_on_with_the_settings_that_it_began_with(tmp_path: Path, name: str) -> None:
    with RunDirectory.create(tmp_path / "run", config=configuration()) as run:
        run.append_rows(Row(kind="search", step=0))
    recipe = tmp_path / "run" / "run.yaml"
    edited = AttackConfig.from_yaml(recipe, {name: CHANGES[name]})
    with pytest.raises(InputError, match=rf"with something else than the run began with: {name}\b.*; restore it"):
        RunDirectory.resume(tmp_path / "run", edited)
    with RunDirectory.resume(tmp_path / "run", AttackConfig.from_yaml(recipe)):  # and nothing is locked any more
        pass


def test_a_run_goes_on_elsewhere_on_other_threads_and_with_files_that_were_moved(tmp_path: Path) -> None:
    for folder in ("old", "new"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "net.pt2").touch()
    with RunDirectory.create(tmp_path / "run", config=configuration(model=str(tmp_path / "old" / "net.pt2"))):
        pass
    moved = configuration(model=str(tmp_path / "new" / "net.pt2"), threads=1, run="other", overwrite=True)
    with RunDirectory.resume(tmp_path / "run", moved):
        pass
    with pytest.raises(InputError, match="began with"):
        RunDirectory.resume(tmp_path / "run", configuration(model="other.pt2"))


def test_what_a_search_was_told_comes_back_bit_for_bit_until_the_run_is_done(tmp_path: Path) -> None:
    gradient, picture = np.arange(5, dtype=np.float32) / np.float32(3), np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    row = Row("search", 0, objective=0.1 + 0.2, margin=-2.5, correct=True, payload={"boxes": [[0.1, 2]]})
    with Store(tmp_path / "results.sqlite") as store:
        store.append([row], CachedEvaluation(3, b"12", 0, 2, gradient, picture))
        store.append([replace(row, step=1)], CachedEvaluation(4, b"13", 1, 1))
        store.append([replace(row, kind="control")])
        assert store.has_cached and store.read_cached("search", 2) is None and store.read_cached("control", 0) is None
        stored = store.read_cached("search", 0)
        assert stored is not None
        again, told = stored
        assert (again.objective, again.margin, again.payload) == (0.1 + 0.2, -2.5, row.payload)
        assert told.gradient is not None and np.array_equal(told.gradient, gradient)
        assert told.picture is not None and np.array_equal(told.picture, picture)
        assert (told.number, told.u, told.cost) == (3, b"12", 2)
        assert [number for number, _ in store.iterate_images("search", 0, 9)] == [3]
        store.append([row, replace(row, step=2)])
        assert store.read_cached("search", 2) is None, "it was told nothing"
        store.delete_cached()
        assert store.read_cached("search", 0) is None and store.count_rows() == 4
    assert not can_resume(tmp_path)


@pytest.mark.medium
def test_two_processes_on_one_run_are_refused(tmp_path: Path) -> None:
    code = (
        "import sys; from advsearch.runs.directory import RunDirectory\n"
        f"try: RunDirectory.resume({str(tmp_path / 'run')!r})\n"
        "except Exception as error: print(error); sys.exit(7)\n"
    )
    with RunDirectory.create(tmp_path / "run", config=configuration()):
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert other.returncode == 7 and f"process {os.getpid()} is working on this run" in other.stdout


@dataclass(frozen=True)
class Sleeper(Policy[Domain]):
    """Never leaves the start."""

    name: ClassVar[str] = "sleeper"
    uses_gradient: ClassVar[bool] = False

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Domain:
        return domain

    def propose(self, state: Domain, n: int) -> tuple[tuple[Proposal, ...], Domain]:
        return (Proposal(state.start),) * n, state

    def update(self, state: Domain, evaluated: Evaluated) -> Domain:
        return state


class Weaker(StandInProblem):
    """Wrong so near the start that a random search finds it."""

    def _logits(self, u: torch.Tensor, seed: int) -> torch.Tensor:
        return super()._logits(u, seed) + torch.tensor([-0.11, 0.11])


@pytest.mark.parametrize(("policy", "beaten"), [(Sleeper(), True), (make_policy("pgd"), False)])
def test_the_random_searchs_configuration_is_taken_where_it_is_the_worse_one(policy: Policy[Any], beaten: bool) -> None:
    problem: Any = Weaker()
    config = configuration().model_copy(update={"steps": 200})
    findings = attack_on(problem, config, policy, Stages(NullProgress()))
    assert (
        findings.search_result is not None
        and findings.random_search_result is not None
        and findings.verification is not None
    )
    assert (findings.outdone_verification is not None) == beaten
    random = findings.random_search_result.best_u
    assert torch.equal(findings.search_result.best_u, random) == beaten
    assert torch.equal(findings.verification.u, problem.domain.project(random)) == beaten


def test_a_run_that_was_killed_before_it_had_results_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with RunDirectory.create(folder, config=configuration()):
        pass
    (folder / "results.sqlite").unlink()
    with RunDirectory.resume(folder, configuration()) as run:
        assert run.store.read_json_note("settings") == configuration().get_deciding_settings()
    with closing(sqlite3.connect(tmp_path / "results.sqlite")) as made:
        made.execute(f"PRAGMA application_id = {files.APPLICATION_ID}")
        made.execute("CREATE TABLE others (text)")
    folder.joinpath("run.yaml").unlink()
    (tmp_path / "results.sqlite").replace(folder / "results.sqlite")
    with pytest.raises(RunExistsError):  # what somebody else made is not thrown away
        RunDirectory.create(folder)


def test_a_run_that_was_killed_before_its_notes_knows_what_exists_only_in_python(tmp_path: Path) -> None:
    config = configuration().with_python_only_parts([PythonOnly("scene")])
    with RunDirectory.create(tmp_path / "run", config=config):
        pass
    (tmp_path / "run" / "results.sqlite").unlink()
    with RunDirectory.resume(tmp_path / "run", config):
        pass
    assert read_python_only(tmp_path / "run") == [PythonOnly("scene")]


def test_arguments_of_a_partial_are_part_of_what_a_function_does() -> None:
    def scale(values: Tensor, factor: float) -> Tensor:
        return factor * values

    twice, thrice = (compute_code_digest(partial(scale, factor=factor)) for factor in (2.0, 3.0))
    assert twice == compute_code_digest(partial(scale, factor=2.0))
    assert len({twice, thrice, compute_code_digest(scale)}) == 3
