"""`test`: the claims of a suite one after the other, counterexamples first."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import advsearch.questions.test.counterexamples as beside
import advsearch.questions.test.result as room
import advsearch.questions.test.settings as suites
from advsearch.config import SceneConfig
from advsearch.engine.record import Results
from advsearch.errors import InputError, UnknownNameError
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress
from advsearch.questions.attack.carry_out import check_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.test.claims import Trial, check_pictures
from advsearch.questions.test.counterexamples import Counterexample
from advsearch.questions.test.result import FAILED, NOT_TRIED, NOT_YET, STOPPED, TIME_OVER, ClaimResult, SuiteResult
from advsearch.questions.test.settings import COUNTEREXAMPLES, NotBrokenClaim, NoWorseClaim, Suite, SuiteConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import INTERRUPTED, OUT_OF_TIME
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from advsearch.viewer.pages import keep_result

NOTE = "suite"  # under which a run's store keeps the suite with its seed, so that it goes on as it began
SETTINGS_NOTE = "counterexamples"  # under which it keeps what counterexamples are judged with, by name


@dataclass(frozen=True)
class PlannedClaim:
    """A claim or a counterexample, and what it is tried with."""

    name: str
    kind: str
    config: SceneConfig
    example: Counterexample | None = None
    refusal: str = ""  # why a counterexample cannot be tried on the model; its own model's settings stand in `config`


def test_from_config(
    config: SuiteConfig, *, progress: Progress | None = None, resumed: Path | None = None, suite: Suite | None = None
) -> SuiteResult:
    """Try the claims of the suite that a configuration names, or of another one; what is decided is not tried again. An
    InputError where the suite names something that is not there, contradicts itself, or could not be judged; nothing is
    rendered then."""
    begun, progress = time.perf_counter(), progress or NullProgress()
    progress.stage("reading the suite")
    noted = None
    if resumed is not None and (resumed / STORE).is_file():  # a run that was stopped at once has noted no suite
        with Store(resumed / STORE, read_only=True) as store:
            noted = store.noted(NOTE)
    described = suites.suite_of(noted, f"{resumed}: the suite that it began with") if noted is not None else suite
    if described is None:
        described = suites.read_suite(config.suite)
        seed = secrets.randbelow(2**31) if config.fresh else described.seed if config.seed is None else config.seed
        described = described.model_copy(update={"seed": seed})
    added = None if config.add is None else beside.add(config.suite, config.add)
    try:
        planned = _planned(described, config, added)
        for claim in planned if described is not suite else ():
            claim.config.check_powers(f"claims.{claim.name}.settings")
        remarks = _check(planned, described)
    except InputError as error:
        if added is not None:
            beside.remove(added)
        raise InputError(f"{config.suite}: {error}") from None
    with RunDirectory.of(config, resumed) as run:
        run.store.set_note(NOTE, json.dumps(described.model_dump(mode="json")))
        judged_with = {claim.name: claim.config.deciding() for claim in planned if claim.example is not None}
        run.store.set_note(SETTINGS_NOTE, json.dumps(judged_with))
        for claim in planned:
            run.note_sitting(claim.config)
            tested = None if claim.example is not None else described.claims[claim.name]
            if isinstance(tested, NoWorseClaim):
                run.note_sitting(claim.config.model_copy(update={"model": tested.than}))
        for remark in remarks:
            progress.message(remark)
        trial = Trial(run, config, described, begun, progress, remarks)
        suite_run = _SuiteRun(trial, planned, beside.read_expected(config.suite))
        ending = suite_run.carry_out()
        if added is not None and suite_run.results[0].answer != FAILED:
            beside.remove(added)
            raise InputError(f"add: the adversarial scene of {config.add} is not kept: {suite_run.results[0].reason}")
        return keep_result(run, suite_run.result(ending, added))


@dataclass
class _SuiteRun:
    """A suite on its way."""

    trial: Trial
    planned: Sequence[PlannedClaim]
    expected: Mapping[str, str]
    results: list[ClaimResult] = field(default_factory=list)

    def carry_out(self) -> str:
        trial, stored = self.trial, Results(self.trial.run)
        try:
            with interruptible():
                for number, claim in enumerate(self.planned, start=1):
                    self._add(claim, self._tried(claim, stored))
                    trial.progress.message(f"{claim.name}: {self.results[-1].answer}: {self.results[-1].reason}")
                    if number < len(self.planned):
                        trial.run.write_summary(self.result(INTERRUPTED, None))  # what a kill leaves
        except KeyboardInterrupt:
            for claim in self.planned[len(self.results) :]:
                self._add(claim, self._not_tried(claim, STOPPED))
            return INTERRUPTED
        if any(tried.reason == NOT_TRIED for tried in self.results):
            trial.warnings.append("A counterexample failed, so that no claim was tried; `all` goes on with them.")
        return OUT_OF_TIME if any(TIME_OVER in tried.reason for tried in self.results) else "done"

    def _tried(self, claim: PlannedClaim, results: Results) -> ClaimResult:
        key, trial = f"claim {claim.name}", self.trial
        if (stored := results.stored(key)) is not None:
            return ClaimResult.of(stored)
        failed = any(known.kind == "counterexample" and not known.accepted for known in self.results)
        if failed and claim.example is None and not trial.config.all:
            return self._not_tried(claim, NOT_TRIED)
        if trial.late:
            return self._not_tried(claim, f"{TIME_OVER} before it began")
        if claim.refusal:
            return self._not_tried(claim, claim.refusal)
        asked, begun = self._not_tried(claim, ""), time.perf_counter()
        if claim.example is None:
            tried = trial.claim(asked, trial.suite.claims[claim.name], claim.config)
        else:
            assert isinstance(claim.config, AttackConfig)
            tried = trial.counterexample(asked, claim.example, claim.config)
        if tried.reason == STOPPED:
            raise KeyboardInterrupt
        tried = tried.model_copy(update={"seconds": time.perf_counter() - begun})
        if TIME_OVER not in tried.reason:
            results.put(key, tried.to_dict())
        return tried

    def _not_tried(self, claim: PlannedClaim, reason: str) -> ClaimResult:
        text = room.statement(self.trial.suite.claims[claim.name], claim.config) if claim.example is None else ""
        return ClaimResult(name=claim.name, kind=claim.kind, statement=text, answer=room.UNDECIDED, reason=reason)

    def _add(self, claim: PlannedClaim, tried: ClaimResult) -> None:
        no = {"add": None, "run": None, "junit": None, "sarif": None, "markdown": None}
        repeat = self._repeat(only=claim.name, update=False, overwrite=False, **no)
        expected = self.expected.get(claim.name, "held")
        self.results.append(tried.model_copy(update={"expected": expected, "repeat": repeat}))

    def _repeat(self, **changes: object) -> str:
        config = self.trial.config
        asked = config.model_copy(update={"seed": self.trial.suite.seed, "fresh": False, **changes})
        return asked.with_only_here(config.only_here).command_line()

    def result(self, ending: str, added: Counterexample | None) -> SuiteResult:
        config, suite = self.trial.config, self.trial.suite
        configs, changes = [claim.config for claim in self.planned], list[str]()
        results = [*self.results, *(self._not_tried(claim, NOT_YET) for claim in self.planned[len(self.results) :])]
        if config.update and ending == "done":
            now = {tried.name: tried.answer for tried in results if NOT_TRIED not in tried.reason}
            changes = beside.write_expected(config.suite, now)
            results = [tried.model_copy(update={"expected": now.get(tried.name, tried.expected)}) for tried in results]
        return SuiteResult(
            run=str(self.trial.run.path), suite=config.suite, title=suite.title,
            object=",".join(dict.fromkeys(config.object for config in configs)),
            model=",".join(dict.fromkeys(config.model for config in configs)),
            environment=",".join(dict.fromkeys(config.lit_by for config in configs)),
            controls=list(dict.fromkeys(name for config in configs for name in config.controls)),
            answer=room.verdict(results), confidence=suite.confidence, claims=results, ending=ending,
            added=None if added is None else str(added.path), changes=changes,
            warnings=list(dict.fromkeys(self.trial.warnings)), seconds={"total": self.trial.passed}, seed=suite.seed,
            command_line=self._repeat(),
        )  # fmt: skip


def _planned(suite: Suite, config: SuiteConfig, added: Counterexample | None) -> list[PlannedClaim]:
    changes = {"model": config.model, "threads": config.threads, "deterministic": config.deterministic or None}
    examples = beside.counterexamples(config.suite) if added is None else [added]
    planned = [_planned_example(example, suite, changes) for example in examples]
    if twice := [example.name for example in planned if example.name in suite.claims]:
        raise InputError(f"claims.{twice[0]}: a counterexample is called so, too; call the claim something else")
    if added is not None:
        return planned
    for name, claim in suite.claims.items():
        claim_config = suite.config_of(name, **changes).with_python_parts_of(config)
        planned.append(PlannedClaim(name, claim.claim, claim_config))
    known = [*(claim.name for claim in planned), COUNTEREXAMPLES]
    for name in config.chosen:
        if name not in known:
            raise UnknownNameError("claim in `only`", name, known)
    every = not config.chosen
    chosen = [
        claim
        for claim in planned
        if every or claim.name in config.chosen or (claim.example is not None and COUNTEREXAMPLES in config.chosen)
    ]
    if not chosen:
        raise InputError(
            f"only: expected {COUNTEREXAMPLES} in {beside.folder_of(config.suite)}, got none, so that nothing would be "
            "tested; keep the adversarial scene of a run with `add`, or leave `only` out"
        )
    return chosen


def _planned_example(example: Counterexample, suite: Suite, changes: Mapping[str, object]) -> PlannedClaim:
    refusal = ""
    try:
        config = example.config_for(suite, changes)
    except InputError as error:
        config = example.config
        refusal = room.cannot_be_judged(str(error))
    return PlannedClaim(example.name, "counterexample", config, example, refusal)


def _check(planned: Sequence[PlannedClaim], suite: Suite) -> list[str]:
    """Load everything that claims name, and refuse what could not be judged or decided; a wrong name would end minutes
    of rendering. Return what has to be said before."""
    known = list[AttackConfig]()
    own = [(each, suite.claims[each.name]) for each in planned if each.example is None]
    # what is beside the suite is loaded when it is tried, at once
    remarks = [check_pictures(each.name, claim, suite.confidence) for each, claim in own]
    for each, claim in own:
        config = each.config if isinstance(each.config, AttackConfig) else AttackConfig.of(each.config)
        for setting, wrong, why in (
            ("object", len(config.objects) > 1, "one object; make a claim of each"),
            ("epsilon", len(config.epsilons) > 1, "one epsilon; make a claim of each"),
            ("model", config.is_study, "one model; make a claim of each"),
            ("smallest", config.smallest, "a budget, which the claim is about; leave it out"),
            ("minimise", config.minimise, "a search that makes the model wrong; leave it out"),
            ("target", config.target is not None, "any wrong prediction; leave it out"),
        ):
            if wrong and isinstance(claim, NotBrokenClaim):
                raise InputError(f"claims.{each.name}.settings: {setting}: expected {why}")
        than = [config.model_copy(update={"model": claim.than})] if isinstance(claim, NoWorseClaim) else []
        for wanted in (config, *than):
            if wanted not in known:
                try:
                    check_from_config(wanted)
                except InputError as error:
                    raise InputError(f"claims.{each.name}: {error}") from None
                known.append(wanted)
    return [remark for remark in remarks if remark]
