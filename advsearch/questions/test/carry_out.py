"""`test`: the claims of a suite one after the other, counterexamples first."""

from __future__ import annotations

import json
import math
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from advsearch.config import SceneConfig
from advsearch.engine.record import Results
from advsearch.errors import InputError, UnknownNameError
from advsearch.interrupts import interruptible
from advsearch.progress import NullProgress, Progress
from advsearch.questions.attack.carry_out import check_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.test.claims import Trial, check_pictures
from advsearch.questions.test.counterexamples import (
    Counterexample,
    add,
    counterexamples,
    read_expected,
    remove,
    write_expected,
)
from advsearch.questions.test.result import (
    FAILED,
    NOT_TRIED,
    NOT_YET,
    STOPPED,
    TIME_OVER,
    UNDECIDED,
    ClaimResult,
    SuiteResult,
    statement,
    verdict,
)
from advsearch.questions.test.settings import (
    COUNTEREXAMPLES,
    NotBrokenClaim,
    NoWorseClaim,
    Suite,
    SuiteConfig,
    read_suite,
    suite_of,
)
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results import INTERRUPTED, OUT_OF_TIME
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Store
from advsearch.viewer.pages import keep_result

NOTE = "suite"
"""Under which a run's store keeps the suite with its seed, so that it goes on as it began."""


@dataclass(frozen=True)
class PlannedClaim:
    """A claim or a counterexample, and what it is tried with."""

    name: str
    kind: str
    config: SceneConfig
    one: Counterexample | None = None


def test_from_config(
    config: SuiteConfig, *, progress: Progress | None = None, resumed: Path | None = None, suite: Suite | None = None
) -> SuiteResult:
    """Try the claims of the suite that a configuration names, or of another one; what is decided is not tried again.

    Raises:
        InputError: the suite names something that is not there, contradicts itself, or could not be judged; nothing is
            rendered then.
    """
    begun, progress = time.perf_counter(), progress or NullProgress()
    progress.stage("reading the suite")
    noted = None if resumed is None else _noted(resumed)
    described = noted or suite
    if described is None:
        described = read_suite(config.suite)
        seed = secrets.randbelow(2**31) if config.fresh else described.seed if config.seed is None else config.seed
        described = described.model_copy(update={"seed": seed})
    seconds = config.seconds or described.seconds or math.inf
    added = None if config.add is None else add(config.suite, config.add)
    try:
        planned = _planned(described, config, added)
        for one in planned if described is not suite else ():
            one.config.check_powers(f"claims.{one.name}.settings")
        remarks = _check(planned, described)
    except InputError as error:
        if added is not None:
            remove(added)
        raise InputError(f"{config.suite}: {error}") from None

    def left() -> float:
        return max(0.001, seconds - (time.perf_counter() - begun))

    with RunDirectory.of(config, resumed) as run:
        run.store.set_note(NOTE, json.dumps(described.model_dump(mode="json")))
        for one in planned:
            run.note_sitting(one.config)
        trial = Trial(
            run,
            described.confidence,
            lambda: time.perf_counter() - begun >= seconds,
            left,
            config.workers,
            config.cluster,
            progress,
            remarks,
        )
        for remark in remarks:
            progress.message(remark)
        suite_run = _SuiteRun(config, described, planned, trial, read_expected(config.suite))
        ending = suite_run.carry_out()
        if added is not None and suite_run.results[0].answer != FAILED:
            remove(added)
            raise InputError(f"add: the adversarial scene of {config.add} is not kept: {suite_run.results[0].reason}")
        result = suite_run.result(ending, time.perf_counter() - begun, added)
        return keep_result(run, result)


@dataclass
class _SuiteRun:
    """A suite on its way."""

    config: SuiteConfig
    suite: Suite
    planned: Sequence[PlannedClaim]
    trial: Trial
    expected: Mapping[str, str]

    def __post_init__(self) -> None:
        self.results: list[ClaimResult] = []

    def carry_out(self) -> str:
        """Try what is planned, and return how it ended."""
        results, begun = Results(self.trial.run), time.perf_counter()
        try:
            with interruptible():
                for number, one in enumerate(self.planned):
                    self._add(one, self._tried(one, results))
                    progress = f"{one.name}: {self.results[-1].answer}: {self.results[-1].reason}"
                    self.trial.progress.message(progress)
                    if number + 1 < len(self.planned):
                        seconds = time.perf_counter() - begun
                        self.trial.run.write_summary(self.result(INTERRUPTED, seconds, None))  # what a kill leaves
        except KeyboardInterrupt:
            for one in self.planned[len(self.results) :]:
                self._add(one, self._not_tried(one, STOPPED))
            return INTERRUPTED
        if any(one.reason == NOT_TRIED for one in self.results):
            self.trial.warnings.append("A counterexample failed, so that no claim was tried; `all` goes on with them.")
        return OUT_OF_TIME if any(TIME_OVER in one.reason for one in self.results) else "done"

    def _tried(self, one: PlannedClaim, results: Results) -> ClaimResult:
        """What a claim says; what is decided, or has used its pictures, is stored."""
        key = f"claim {one.name}"
        if (stored := results.stored(key)) is not None:
            return ClaimResult.of(stored)
        failed = [known for known in self.results if known.kind == "counterexample" and not known.accepted]
        if failed and one.one is None and not self.config.all:
            return self._not_tried(one, NOT_TRIED)
        if self.trial.late():
            return self._not_tried(one, f"{TIME_OVER} before it began")
        asked, begun = self._not_tried(one, ""), time.perf_counter()
        if one.one is None:
            found = self.trial.claim(asked, self.suite.claims[one.name], one.config)
        else:
            assert isinstance(one.config, AttackConfig)
            found = self.trial.counterexample(asked, one.one, one.config, added=self.config.add is not None)
        found = found.model_copy(update={"seconds": time.perf_counter() - begun})
        if TIME_OVER not in found.reason and found.reason != STOPPED:
            results.put(key, found.to_dict())
        if found.reason == STOPPED:
            raise KeyboardInterrupt
        return found

    def _not_tried(self, one: PlannedClaim, reason: str) -> ClaimResult:
        claim = self.suite.claims.get(one.name)
        said = "" if claim is None or one.one is not None else statement(claim, one.config)
        return ClaimResult(name=one.name, kind=one.kind, statement=said, answer=UNDECIDED, reason=reason)

    def _add(self, one: PlannedClaim, found: ClaimResult) -> None:
        only = {"only": one.name, "seed": self.suite.seed, "fresh": False, "add": None, "update": False, "run": None}
        files = {"junit": None, "sarif": None, "markdown": None, "overwrite": False}
        again = self.config.model_copy(update={**only, **files}).with_only_here(self.config.only_here)
        expected = self.expected.get(one.name, "held")
        self.results.append(found.model_copy(update={"expected": expected, "repeat": again.command_line()}))

    def result(self, ending: str, seconds: float, added: Counterexample | None) -> SuiteResult:
        """Return what the claims so far come to."""
        configs = [one.config for one in self.planned]
        changes: list[str] = []
        rest = [self._not_tried(one, NOT_YET) for one in self.planned[len(self.results) :]]
        results = [*self.results, *rest]
        if self.config.update and ending == "done":
            now = {one.name: one.answer for one in results if NOT_TRIED not in one.reason}
            changes = write_expected(self.config.suite, now)
            results = [one.model_copy(update={"expected": now.get(one.name, one.expected)}) for one in results]
        return SuiteResult(
            run=str(self.trial.run.path),
            suite=self.config.suite,
            title=self.suite.title,
            object=",".join(dict.fromkeys(one.object for one in configs)),
            model=",".join(dict.fromkeys(one.model for one in configs)),
            environment=",".join(dict.fromkeys(one.lit_by for one in configs)),
            controls=list(dict.fromkeys(name for one in configs for name in one.controls)),
            answer=verdict(results),
            confidence=self.suite.confidence,
            claims=results,
            ending=ending,
            added=None if added is None else str(added.path),
            changes=changes,
            warnings=list(dict.fromkeys(self.trial.warnings)),
            seconds={"total": seconds},
            seed=self.suite.seed,
            command_line=self.config.model_copy(update={"seed": self.suite.seed, "fresh": False})
            .with_only_here(self.config.only_here)
            .command_line(),
        )


def _noted(path: Path) -> Suite | None:
    """The suite that a run began with; None of one that was stopped at once."""
    if not (path / STORE).is_file():
        return None
    with Store(path / STORE, read_only=True) as store:
        noted = store.noted(NOTE)
    return None if noted is None else suite_of(noted, f"{path}: the suite that it began with")


def _planned(suite: Suite, config: SuiteConfig, added: Counterexample | None) -> list[PlannedClaim]:
    changes = {"model": config.model, "threads": config.threads, "deterministic": config.deterministic or None}
    kept = counterexamples(config.suite) if added is None else [added]
    first = [PlannedClaim(one.name, "counterexample", one.config_for(suite, changes), one) for one in kept]
    if twice := [one.name for one in first if one.name in suite.claims]:
        raise InputError(f"claims.{twice[0]}: a counterexample is called so, too; call the claim something else")
    if added is not None:
        return first
    rest = [
        PlannedClaim(name, one.claim, suite.config_of(name, **changes).with_only_here(config.only_here))
        for name, one in suite.claims.items()
    ]
    chosen, planned = config.chosen, [*first, *rest]
    known = [one.name for one in planned]
    for name in chosen:
        if name not in (*known, COUNTEREXAMPLES):
            raise UnknownNameError("claim in `only`", name, [*known, COUNTEREXAMPLES])
    if not chosen:
        return planned
    return [one for one in planned if one.name in chosen or (one.one is not None and COUNTEREXAMPLES in chosen)]


def _check(planned: Sequence[PlannedClaim], suite: Suite) -> list[str]:
    """Load everything that claims name, and refuse what could not be judged or decided; a wrong name would end minutes
    of rendering. Return what has to be said before."""
    known: list[AttackConfig] = []
    claims = {one.name: suite.claims[one.name] for one in planned if one.one is None}
    remarks = [check_pictures(name, claim, suite.confidence) for name, claim in claims.items()]
    for one in planned:
        if one.one is not None:
            continue  # what is beside the suite is loaded when it is tried, at once
        claim = claims[one.name]
        if isinstance(claim, NotBrokenClaim):
            _check_search(one.name, one.config)
        whole = one.config if isinstance(one.config, AttackConfig) else AttackConfig.of(one.config)
        wanted = [whole]
        if isinstance(claim, NoWorseClaim):
            wanted.append(whole.model_copy(update={"model": claim.than}))
        for config in wanted:
            if config not in known:
                try:
                    check_from_config(config)
                except InputError as error:
                    raise InputError(f"claims.{one.name}: {error}") from None
                known.append(config)
    return [remark for remark in remarks if remark]


def _check_search(name: str, config: SceneConfig) -> None:
    assert isinstance(config, AttackConfig)
    for setting, wrong, why in (
        ("object", len(config.objects) > 1, "one object; make a claim of each"),
        ("epsilon", len(config.epsilons) > 1, "one epsilon; make a claim of each"),
        ("model", config.is_study, "one model; make a claim of each"),
        ("smallest", config.smallest, "a budget, which the claim is about; leave it out"),
        ("minimise", config.minimise, "a search that makes the model wrong; leave it out"),
        ("target", config.target is not None, "any wrong prediction; leave it out"),
    ):
        if wrong:
            raise InputError(f"claims.{name}.settings: {setting}: expected {why}")
