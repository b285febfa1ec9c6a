"""`test`: the claims of a suite one after the other, counterexamples first."""

from __future__ import annotations

import json
import secrets
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from advsearch.extend import (
    AttackConfig,
    InputError,
    RunContext,
    SceneConfig,
    Store,
    errors,
    results,
    workbench,
)
from advsearch.questions.test import counterexamples, settings
from advsearch.questions.test.claims import Trial, check_pictures
from advsearch.questions.test.counterexamples import Counterexample
from advsearch.questions.test.recorded import SETTINGS_NOTE, SUITE_NOTE
from advsearch.questions.test.result import (
    FAILED,
    NOT_TRIED,
    NOT_YET,
    STOPPED,
    TIME_OVER,
    UNDECIDED,
    Cause,
    ClaimResult,
    SuiteResult,
    cannot_be_judged,
    statement,
    verdict,
)
from advsearch.questions.test.settings import (
    COUNTEREXAMPLES,
    NotBrokenClaim,
    NoWorseClaim,
    Suite,
    SuiteConfig,
)


@dataclass(frozen=True)
class PlannedClaim:
    """A claim or a counterexample, and what it is tried with."""

    name: str
    kind: str
    config: SceneConfig
    example: Counterexample | None = None
    # why a counterexample cannot be tried on the model; its own model's settings stand
    # in `config`
    refusal: str = ""


def try_suite(
    context: RunContext[SuiteConfig], suite: Suite | None = None
) -> SuiteResult:
    """Try the claims of a suite; what is decided is not tried again.

    Args:
        context: of the experiment; its settings name the suite.
        suite: in place of the one that the settings name.

    Raises:
        InputError: the suite names something that is not there, contradicts itself, or
            could not be judged; nothing is rendered then.
    """
    begun = time.perf_counter()
    config = context.config
    context.progress.stage("reading the suite")
    described = _read_noted_suite(context.resumed) or suite or _read_suite(config)
    added = (
        None if config.add is None else counterexamples.add(config.suite, config.add)
    )
    try:
        planned = _planned(described, config, added)
        for claim in planned if described is not suite else ():
            claim.config.check_powers(f"claims.{claim.name}.settings")
        remarks = _check(planned, described)
    except InputError as error:
        if added is not None:
            counterexamples.remove(added)
        raise InputError(f"{config.suite}: {error}") from None
    _note_settings(context, described, planned)
    for remark in remarks:
        context.progress.message(remark)
    trial = Trial(context, described, begun, remarks)
    suite_run = _SuiteRun(trial, planned, counterexamples.read_expected(config.suite))
    context.ending = suite_run.carry_out()
    if added is not None and suite_run.results[0].answer != FAILED:
        counterexamples.remove(added)
        raise InputError(
            f"add: the adversarial scene of {config.add} is not kept: "
            f"{suite_run.results[0].reason}"
        )
    return suite_run.result(context.ending, added)


def _read_noted_suite(resumed: Path | None) -> Suite | None:
    """Return the suite that a run began with; None for a new run, and for one that was
    stopped before it noted any.
    """
    if resumed is None or not Store.is_in(resumed):
        return None
    with Store.open_to_read(resumed) as store:
        noted = store.noted(SUITE_NOTE)
    return (
        None
        if noted is None
        else settings.suite_of(noted, f"{resumed}: the suite that it began with")
    )


def _read_suite(config: SuiteConfig) -> Suite:
    """Return the suite that settings name, with the seed that they state, or a fresh
    one.
    """
    described = settings.read_suite(config.suite)
    seed = described.seed if config.seed is None else config.seed
    return described.model_copy(
        update={"seed": secrets.randbelow(2**31) if config.fresh else seed}
    )


def _note_settings(
    context: RunContext[SuiteConfig], suite: Suite, planned: Sequence[PlannedClaim]
) -> None:
    """Make the run, and note what its claims are judged with, so that it goes on as it
    began.
    """
    run = context.run
    run.store.set_note(SUITE_NOTE, json.dumps(suite.model_dump(mode="json")))
    judged_with = {
        claim.name: claim.config.deciding()
        for claim in planned
        if claim.example is not None
    }
    run.store.set_note(SETTINGS_NOTE, json.dumps(judged_with))
    used_settings = list[dict[str, Any]]()
    for claim in planned:
        used_settings.append(claim.config.plain())
        tested = None if claim.example is not None else suite.claims[claim.name]
        if isinstance(tested, NoWorseClaim):
            used_settings.append({"model": tested.than})
    run.check_files_unchanged(used_settings)


@dataclass
class _SuiteRun:
    """A suite on its way."""

    trial: Trial
    planned: Sequence[PlannedClaim]
    expected: Mapping[str, str]
    results: list[ClaimResult] = field(default_factory=list)

    def carry_out(self) -> str:
        """Try every claim, and return how that ended."""
        trial = self.trial
        with trial.context.until_interrupted():
            for number, claim in enumerate(self.planned, start=1):
                self._add(claim, self._tried(claim))
                trial.progress.message(
                    f"{claim.name}: {self.results[-1].answer}: "
                    f"{self.results[-1].reason}"
                )
                if number < len(self.planned):
                    # what a kill leaves
                    trial.run.write_summary(self.result(results.INTERRUPTED, None))
        if trial.context.ending == results.INTERRUPTED:
            for claim in self.planned[len(self.results) :]:
                self._add(claim, self._not_tried(claim, STOPPED, Cause.INTERRUPTED))
            return results.INTERRUPTED
        causes = {tried.cause for tried in self.results}
        if Cause.COUNTEREXAMPLE_FAILED in causes:
            trial.warnings.append(
                "A counterexample failed, so that no claim was "
                "tried; `all` goes on with them."
            )
        return results.OUT_OF_TIME if Cause.OUT_OF_TIME in causes else "done"

    def _tried(self, claim: PlannedClaim) -> ClaimResult:
        key = f"claim {claim.name}"
        trial = self.trial
        if (stored := trial.run.store.noted(key)) is not None:
            return ClaimResult.of(stored)
        failed = any(
            known.kind == "counterexample" and not known.accepted
            for known in self.results
        )
        if failed and claim.example is None and not trial.config.all:
            return self._not_tried(claim, NOT_TRIED, Cause.COUNTEREXAMPLE_FAILED)
        if trial.late:
            return self._not_tried(
                claim, f"{TIME_OVER} before it began", Cause.OUT_OF_TIME
            )
        if claim.refusal:
            return self._not_tried(claim, claim.refusal)
        asked = self._not_tried(claim, "")
        begun = time.perf_counter()
        if claim.example is None:
            tried = trial.claim(asked, trial.suite.claims[claim.name], claim.config)
        else:
            assert isinstance(claim.config, AttackConfig)
            tried = trial.counterexample(asked, claim.example, claim.config)
        if tried.cause is Cause.INTERRUPTED:
            raise KeyboardInterrupt
        tried = tried.model_copy(update={"seconds": time.perf_counter() - begun})
        if tried.cause is not Cause.OUT_OF_TIME:
            trial.run.store.set_note(key, json.dumps(tried.to_dict()))
        return tried

    def _not_tried(
        self, claim: PlannedClaim, reason: str, cause: Cause | None = None
    ) -> ClaimResult:
        text = (
            statement(self.trial.suite.claims[claim.name], claim.config)
            if claim.example is None
            else ""
        )
        return ClaimResult(
            name=claim.name,
            kind=claim.kind,
            statement=text,
            answer=UNDECIDED,
            reason=reason,
            cause=cause,
        )

    def _add(self, claim: PlannedClaim, tried: ClaimResult) -> None:
        repeat = self._repeat_command(f"only={claim.name}") or ""
        expected = self.expected.get(claim.name, "held")
        self.results.append(
            tried.model_copy(update={"expected": expected, "repeat": repeat})
        )

    def _repeat_command(self, *changes: str) -> str | None:
        """Return the command that tries the claims again with the same seed, and
        changes nothing but its own run.
        """
        config = self.trial.config
        command = config.command_line(self.trial.run.path)
        if command is None:
            return None
        defaults = {
            power.name: power.default
            for power in config.powers
            if power.name not in ("run", "overwrite")
        }
        without = [
            f"{name}={json.dumps(default)}" for name, default in defaults.items()
        ]
        seed = ["fresh=false", f"seed={self.trial.suite.seed}"] if config.fresh else []
        return f"{command} {shlex.join([*changes, *seed, *without])}".rstrip()

    def result(self, ending: str, added: Counterexample | None) -> SuiteResult:
        config = self.trial.config
        suite = self.trial.suite
        configs = [claim.config for claim in self.planned]
        changes = list[str]()
        ahead = self.planned[len(self.results) :]
        claims = [
            *self.results,
            *(self._not_tried(claim, NOT_YET, Cause.NOT_REACHED) for claim in ahead),
        ]
        if config.update and ending == "done":
            now = {
                tried.name: tried.answer
                for tried in claims
                if tried.cause is not Cause.COUNTEREXAMPLE_FAILED
            }
            changes = counterexamples.write_expected(config.suite, now)
            claims = [
                tried.model_copy(
                    update={"expected": now.get(tried.name, tried.expected)}
                )
                for tried in claims
            ]
        return SuiteResult(
            run=str(self.trial.run.path), suite=config.suite, title=suite.title,
            object=",".join(dict.fromkeys(config.object for config in configs)),
            model=",".join(dict.fromkeys(config.model for config in configs)),
            environment=",".join(dict.fromkeys(config.lit_by for config in configs)),
            controls=list(dict.fromkeys(name for config in configs for name in config.controls)),
            answer=verdict(claims), confidence=suite.confidence, claims=claims, ending=ending,
            added=None if added is None else str(added.path), changes=changes,
            warnings=list(dict.fromkeys(self.trial.warnings)), seconds={"total": self.trial.passed}, seed=suite.seed,
            command_line=self._repeat_command(), python_only=config.python_only,
        )  # fmt: skip


def _planned(
    suite: Suite, config: SuiteConfig, added: Counterexample | None
) -> list[PlannedClaim]:
    changes = {
        "model": config.model,
        "threads": config.threads,
        "deterministic": config.deterministic or None,
    }
    examples = (
        counterexamples.counterexamples(config.suite) if added is None else [added]
    )
    planned = [_planned_example(example, suite, changes) for example in examples]
    if twice := [example.name for example in planned if example.name in suite.claims]:
        raise InputError(
            f"claims.{twice[0]}: a counterexample is called so, too; call "
            "the claim something else"
        )
    if added is not None:
        return planned
    for name, claim in suite.claims.items():
        claim_config = suite.config_of(name, **changes).with_python_parts_of(config)
        planned.append(PlannedClaim(name, claim.claim, claim_config))
    known = [*(claim.name for claim in planned), COUNTEREXAMPLES]
    for name in config.chosen:
        if name not in known:
            raise errors.UnknownNameError("claim in `only`", name, known)
    every = not config.chosen
    chosen = [
        claim
        for claim in planned
        if every
        or claim.name in config.chosen
        or (claim.example is not None and COUNTEREXAMPLES in config.chosen)
    ]
    if not chosen:
        raise InputError(
            f"only: expected {COUNTEREXAMPLES} in "
            f"{counterexamples.folder_of(config.suite)}, got none, so that nothing "
            "would be tested; keep the adversarial scene of a run with `add`, or leave "
            "`only` out"
        )
    return chosen


def _planned_example(
    example: Counterexample, suite: Suite, changes: Mapping[str, object]
) -> PlannedClaim:
    refusal = ""
    try:
        config = example.config_for(suite, changes)
    except InputError as error:
        config = example.config
        refusal = cannot_be_judged(str(error))
    return PlannedClaim(example.name, "counterexample", config, example, refusal)


def _check(planned: Sequence[PlannedClaim], suite: Suite) -> list[str]:
    """Load everything that claims name, and refuse what could not be judged or decided;
    a wrong name would end minutes of rendering. Return what has to be said before.
    """
    known = list[AttackConfig]()
    own = [(each, suite.claims[each.name]) for each in planned if each.example is None]
    # what is beside the suite is loaded when it is tried, at once
    remarks = [
        check_pictures(each.name, claim, suite.confidence) for each, claim in own
    ]
    for each, claim in own:
        config = (
            each.config
            if isinstance(each.config, AttackConfig)
            else AttackConfig.of(each.config)
        )
        for setting, wrong, why in (
            ("object", len(config.objects) > 1, "one object; make a claim of each"),
            ("epsilon", len(config.epsilons) > 1, "one epsilon; make a claim of each"),
            ("model", config.is_study, "one model; make a claim of each"),
            (
                "smallest",
                config.smallest,
                "a budget, which the claim is about; leave it out",
            ),
            (
                "minimise",
                config.minimise,
                "a search that makes the model wrong; leave it out",
            ),
            ("target", config.target is not None, "any wrong prediction; leave it out"),
        ):
            if wrong and isinstance(claim, NotBrokenClaim):
                raise InputError(
                    f"claims.{each.name}.settings: {setting}: expected {why}"
                )
        than = (
            [config.model_copy(update={"model": claim.than})]
            if isinstance(claim, NoWorseClaim)
            else []
        )
        for wanted in (config, *than):
            if wanted not in known:
                try:
                    workbench.check_from_config(wanted)
                except InputError as error:
                    raise InputError(f"claims.{each.name}: {error}") from None
                known.append(wanted)
    return [remark for remark in remarks if remark]
