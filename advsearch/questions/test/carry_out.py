"""Test the claims of a suite in order, counterexamples first."""

from __future__ import annotations

import json
import secrets
import shlex
import time
from collections.abc import Iterable, Mapping, Sequence
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
from advsearch.questions.test.claims import ClaimTester, check_pictures
from advsearch.questions.test.counterexamples import Counterexample
from advsearch.questions.test.recorded import SETTINGS_NOTE, SUITE_NOTE
from advsearch.questions.test.result import (
    FAILED,
    INTERRUPTED_REASON,
    NOT_TESTED,
    NOT_TESTED_YET,
    OUT_OF_TIME_REASON,
    UNDECIDED,
    Cause,
    ClaimResult,
    SuiteResult,
    combine_verdicts,
    describe_claim,
    describe_unsuitable,
)
from advsearch.questions.test.settings import (
    ALL_COUNTEREXAMPLES,
    AnyClaim,
    NotBrokenClaim,
    NoWorseClaim,
    Suite,
    SuiteConfig,
)


@dataclass(frozen=True)
class PlannedClaim:
    """A claim or a counterexample that is to be tested.

    Attributes:
        name: name of the claim, or of the counterexample.
        kind: kind of the claim, or "counterexample".
        config: settings with which it is tested.
        counterexample: the counterexample; None for a claim of the suite.
        unsuitable_reason: why a counterexample cannot be tested on the model; empty if
            it can. If it cannot, `config` has the settings with which it was found.
    """

    name: str
    kind: str
    config: SceneConfig
    counterexample: Counterexample | None = None
    unsuitable_reason: str = ""


def try_suite(
    context: RunContext[SuiteConfig], suite: Suite | None = None
) -> SuiteResult:
    """Test the claims of a suite.

    Claims that a resumed run has already decided are not tested again. With the setting
    `add` only the new counterexample is tested. It is deleted again unless its verdict
    is FAILED, which means that the model is wrong on it.

    Args:
        context: context of the experiment; its settings name the suite.
        suite: parsed suite that replaces the file in the settings.

    Raises:
        InputError: the suite names something that does not exist, contradicts itself,
            or cannot be tested. Nothing is rendered then.
    """
    start = time.perf_counter()
    config = context.config
    context.progress.stage("reading the suite")
    _check_twins(config)
    # A resumed run has stored the suite with which it has started, and tests that, even
    # if the file has changed since.
    noted_suite = _read_noted_suite(context.resumed_directory)
    loaded_suite = noted_suite or suite or _read_suite(config)
    added = _add_counterexample(config)
    planned, remarks = _plan_checked_claims(
        loaded_suite, config, added, is_from_caller=loaded_suite is suite
    )
    _note_settings(context, loaded_suite, planned)
    for remark in remarks:
        context.progress.message(remark)
    tester = ClaimTester(context, loaded_suite, start_time=start, warnings=remarks)
    suite_run = _SuiteRun(tester, planned, counterexamples.read_expected(config.suite))
    context.ending = suite_run.run_claims()
    if added is not None:
        # With `add`, the only result is that of the new counterexample.
        _check_added(added, suite_run.results[0], config)
    return suite_run.make_result(context.ending, added)


def _check_twins(config: SuiteConfig) -> None:
    """Raise an error if the run of `twins` that the settings name cannot be read.

    Such a run compares renders with photographs. The error comes before the work begins.
    """
    if config.twins is not None:
        workbench.read_twins(config.twins)


def _check_added(
    added: Counterexample, result: ClaimResult, config: SuiteConfig
) -> None:
    """Delete a new counterexample, and raise an error, unless the model fails on it."""
    if result.verdict != FAILED:
        counterexamples.delete_counterexample(added)
        raise InputError(
            f"add: the adversarial scene of {config.add} is not stored: {result.reason}"
        )


def _add_counterexample(config: SuiteConfig) -> Counterexample | None:
    """Store the counterexample that the setting `add` names; None without it."""
    if config.add is None:
        return None
    return counterexamples.add_counterexample(config.suite, config.add)


def _plan_checked_claims(
    suite: Suite,
    config: SuiteConfig,
    added: Counterexample | None,
    *,
    is_from_caller: bool,
) -> tuple[list[PlannedClaim], list[str]]:
    """Plan what is tested, and check it; after an error `added` is deleted.

    Args:
        suite: the suite.
        config: settings of the command.
        added: the new counterexample; None if there is none.
        is_from_caller: whether the caller has passed the suite.

    Returns:
        What is tested, and remarks about it.

    Raises:
        InputError: something cannot be tested, or needs a permission.
    """
    try:
        planned = _plan_claims(suite, config, added)
        if not is_from_caller:
            # A file, or a stored run, may come from others. Without permission of the
            # user, its settings must not run code or have other effects outside of the
            # run.
            for claim in planned:
                claim.config.check_no_effects(f"claims.{claim.name}.settings")
        return planned, _check_claims(planned, suite)
    except InputError as error:
        if added is not None:
            counterexamples.delete_counterexample(added)
        raise InputError(f"{config.suite}: {error}") from None


def _read_noted_suite(resumed: Path | None) -> Suite | None:
    """Read the suite with which a resumed run has started.

    None for a new run, and for a run that was stopped before it stored its suite.
    """
    if resumed is None or not Store.is_in(resumed):
        return None
    with Store.open_to_read(resumed) as store:
        noted = store.read_json_note(SUITE_NOTE)
    if noted is None:
        return None
    return settings.parse_suite(noted, f"{resumed}: the suite that it began with")


def _read_suite(config: SuiteConfig) -> Suite:
    """Read the suite in the settings, and set its seed.

    The seed is that of the suite, that of the settings if they have one, or a new
    random one with the setting `fresh`.
    """
    suite = settings.read_suite(config.suite)
    seed = suite.seed if config.seed is None else config.seed
    if config.fresh:
        seed = secrets.randbelow(2**31)
    return suite.model_copy(update={"seed": seed})


def _note_settings(
    context: RunContext[SuiteConfig], suite: Suite, planned: Sequence[PlannedClaim]
) -> None:
    """Store the settings of claims, so that a resumed run tests with the same ones.

    Args:
        context: the settings and the run.
        suite: the suite that is tested.
        planned: its claims and counterexamples.
    """
    run = context.run
    run.store.write_note(SUITE_NOTE, json.dumps(suite.model_dump(mode="json")))
    settings_of_examples = {
        claim.name: claim.config.get_deciding_settings()
        for claim in planned
        if claim.counterexample is not None
    }
    run.store.write_note(SETTINGS_NOTE, json.dumps(settings_of_examples))
    # A new run stores the digests of the files in these settings, and a resumed run
    # compares them: they must not change before the run is resumed.
    run.check_files_unchanged(_list_used_settings(suite, planned))


def _list_used_settings(
    suite: Suite, planned: Sequence[PlannedClaim]
) -> list[dict[str, Any]]:
    """Return all settings that name files: those of what is tested, and other models."""
    used_settings = list[dict[str, Any]]()
    for planned_claim in planned:
        used_settings.append(planned_claim.config.to_json())
        if planned_claim.counterexample is not None:
            continue
        claim = suite.claims[planned_claim.name]
        if isinstance(claim, NoWorseClaim):
            used_settings.append({"model": claim.than})
    return used_settings


@dataclass
class _SuiteRun:
    """The state of a suite that is being tested.

    Attributes:
        tester: tests claims.
        planned: all claims, counterexamples first.
        expected: the expected verdict of each claim that is not expected to be held.
        results: the results so far, in the order of `planned`.
    """

    tester: ClaimTester
    planned: Sequence[PlannedClaim]
    expected: Mapping[str, str]
    results: list[ClaimResult] = field(default_factory=list)

    def run_claims(self) -> str:
        """Test every claim, and return the status of the run.

        After an interrupt, the remaining claims get undecided results.
        """
        tester = self.tester
        with tester.context.until_interrupted():
            for number, claim in enumerate(self.planned, start=1):
                self._add_result(claim, self._test_claim(claim))
                self._report_last(is_last=number == len(self.planned))
        if tester.context.ending == results.INTERRUPTED:
            self._add_interrupted()
            return results.INTERRUPTED
        causes = {result.cause for result in self.results}
        if Cause.COUNTEREXAMPLE_FAILED in causes:
            tester.warnings.append(
                "A counterexample failed, so that no claim was "
                "tested; with the setting `all` they are tested, too."
            )
        return results.OUT_OF_TIME if Cause.OUT_OF_TIME in causes else "done"

    def _report_last(self, *, is_last: bool) -> None:
        """Show the last result, and write a summary unless it is that of the last claim.

        The summary is written after each claim, so that it can be read even if the run
        is killed: then it states that it was interrupted.
        """
        result = self.results[-1]
        message = f"{result.name}: {result.verdict}: {result.reason}"
        self.tester.progress.message(message)
        if not is_last:
            so_far = self.make_result(results.INTERRUPTED, added=None)
            self.tester.run.write_summary(so_far)

    def _add_interrupted(self) -> None:
        """Add undecided results of the claims that an interrupt left out."""
        for claim in self.planned[len(self.results) :]:
            untested = self._make_untested(claim, INTERRUPTED_REASON, Cause.INTERRUPTED)
            self._add_result(claim, untested)

    def _test_claim(self, claim: PlannedClaim) -> ClaimResult:
        """Return the result of a claim, and test the claim if necessary.

        A resumed run has stored the results of claims that it has tested before. A
        result is not stored if the time ended its test: then a resumed run tests the
        claim again.
        """
        key = f"claim {claim.name}"
        tester = self.tester
        stored_result = tester.run.store.read_json_note(key)
        if stored_result is not None:
            return ClaimResult.from_values(stored_result)
        # a result if it must not be tested, for example because the time is over
        untested = self._refuse_claim(claim)
        if untested is not None:
            return untested
        pending = self._make_untested(claim, "")
        start = time.perf_counter()
        tested = self._run_test(claim, pending)
        if tested.cause is Cause.INTERRUPTED:
            raise KeyboardInterrupt  # Ctrl-C in a part of the run ends all of it
        tested = tested.model_copy(update={"seconds": time.perf_counter() - start})
        if tested.cause is not Cause.OUT_OF_TIME:
            tester.run.store.write_note(key, json.dumps(tested.to_dict()))
        return tested

    def _run_test(self, claim: PlannedClaim, pending: ClaimResult) -> ClaimResult:
        """Test a claim or a counterexample, and return its result.

        Args:
            claim: the claim or the counterexample.
            pending: its result without a verdict.
        """
        tester = self.tester
        if claim.counterexample is None:
            suite_claim = tester.suite.claims[claim.name]
            return tester.test_claim(pending, suite_claim, claim.config)
        assert isinstance(claim.config, AttackConfig)
        return tester.test_counterexample(pending, claim.counterexample, claim.config)

    def _refuse_claim(self, claim: PlannedClaim) -> ClaimResult | None:
        """Return the result of a claim that must not be tested, else None.

        There are three reasons. First, a counterexample has failed unexpectedly: then
        claims are not tested unless the setting `all` is set. Second, the time is over.
        Third, a counterexample does not suit the model (`unsuitable_reason`).
        """
        counterexample_failed = any(
            result.kind == "counterexample" and not result.accepted
            for result in self.results
        )
        is_counterexample = claim.counterexample is not None
        tests_all = self.tester.config.all
        if counterexample_failed and not is_counterexample and not tests_all:
            return self._make_untested(claim, NOT_TESTED, Cause.COUNTEREXAMPLE_FAILED)
        if self.tester.out_of_time:
            return self._make_untested(
                claim, f"{OUT_OF_TIME_REASON} before it began", Cause.OUT_OF_TIME
            )
        if claim.unsuitable_reason:
            return self._make_untested(claim, claim.unsuitable_reason)
        return None

    def _make_untested(
        self, claim: PlannedClaim, reason: str, cause: Cause | None = None
    ) -> ClaimResult:
        """Make the result of a claim before it is tested, or of one that is not tested.

        Args:
            claim: the claim.
            reason: reason why it is not tested; empty if it is about to be tested.
            cause: kind of that reason; None if there is no reason, or another kind.
        """
        # The statement of a counterexample is added when it is tested.
        text = ""
        if claim.counterexample is None:
            text = describe_claim(self.tester.suite.claims[claim.name], claim.config)
        return ClaimResult(
            name=claim.name,
            kind=claim.kind,
            statement=text,
            verdict=UNDECIDED,
            reason=reason,
            cause=cause,
        )

    def _add_result(self, claim: PlannedClaim, tested: ClaimResult) -> None:
        """Add the result of a claim, with its expected verdict and its command."""
        repeat = self._repeat_command(f"only={claim.name}") or ""
        expected = self.expected.get(claim.name, "held")
        self.results.append(
            tested.model_copy(update={"expected": expected, "repeat": repeat})
        )

    def _repeat_command(self, *changes: str) -> str | None:
        """Return the command that tests the claims again with the same seed.

        The command writes only its own run: settings with other effects, such as files
        to write, have their defaults in it. None if no command can repeat the run,
        because it has Python objects.

        Args:
            *changes: further settings of the command, such as "only=NAME".
        """
        config = self.tester.config
        command = config.command_line(self.tester.run.path)
        if command is None:
            return None
        arguments = list(changes)
        # A new random seed would not repeat the run.
        if config.fresh:
            arguments += ["fresh=false", f"seed={self.tester.suite.seed}"]
        # Settings with effects outside of the run get their defaults. The directory of
        # the run itself stays.
        for setting in config.settings_with_effects:
            if setting.name not in ("run", "overwrite"):
                arguments.append(f"{setting.name}={json.dumps(setting.default)}")
        # without the space at the end if there are no arguments
        return f"{command} {shlex.join(arguments)}".rstrip()

    def make_result(self, ending: str, added: Counterexample | None) -> SuiteResult:
        """Make the result of the claims so far.

        With the setting `update`, the verdicts of a complete run are also stored as the
        expected verdicts of the suite.

        Args:
            ending: status of the run.
            added: the counterexample that the run has added; None if there is none.
        """
        tester = self.tester
        config = tester.config
        configs = [claim.config for claim in self.planned]
        controls = [name for config in configs for name in config.controls]
        claims = self._list_all_results()
        changes = list[str]()
        if config.update and ending == "done":
            claims, changes = self._update_expected(claims)
        return SuiteResult(
            run=str(tester.run.path),
            suite=config.suite,
            title=tester.suite.title,
            object=_join_distinct(config.object for config in configs),
            model=_join_distinct(config.model for config in configs),
            environment=_join_distinct(config.environment_name for config in configs),
            controls=list(dict.fromkeys(controls)),
            verdict=combine_verdicts(claims),
            confidence=tester.suite.confidence,
            claims=claims,
            ending=ending,
            added=None if added is None else str(added.path),
            changes=changes,
            warnings=list(dict.fromkeys(tester.warnings)),
            seconds={"total": tester.elapsed_seconds},
            seed=tester.suite.seed,
            command_line=self._repeat_command(),
            python_only=config.python_only,
            twins=self._find_twin_evidence(configs),
        )

    def _list_all_results(self) -> list[ClaimResult]:
        """Return the results so far, and undecided ones of claims after the last one."""
        not_reached = [
            self._make_untested(claim, NOT_TESTED_YET, Cause.NOT_REACHED)
            for claim in self.planned[len(self.results) :]
        ]
        return [*self.results, *not_reached]

    def _update_expected(
        self, claims: Sequence[ClaimResult]
    ) -> tuple[list[ClaimResult], list[str]]:
        """Store the verdicts of claims as expected.

        Claims that were not tested because a counterexample failed keep their expected
        verdicts.

        Returns:
            The claims with their new expected verdicts, and a sentence for each change.
        """
        verdicts = {
            claim.name: claim.verdict
            for claim in claims
            if claim.cause is not Cause.COUNTEREXAMPLE_FAILED
        }
        changes = counterexamples.write_expected(self.tester.config.suite, verdicts)
        updated = [
            claim.model_copy(
                update={"expected": verdicts.get(claim.name, claim.expected)}
            )
            for claim in claims
        ]
        return updated, changes

    def _find_twin_evidence(self, configs: Sequence[SceneConfig]) -> Any:
        """Return how far renders agree with photographs, from a run of `twins`.

        Twins are renders of photographed objects, which are compared with the
        photographs. The result is None if the settings name no run of `twins`.

        Args:
            configs: settings of each claim.
        """
        # the names of loaded models by the setting `model`
        model_names = self.tester.model_names
        # A scene with a backdrop is in a photograph.
        are_all_in_photographs = all(config.backdrop is not None for config in configs)
        return workbench.find_twin_evidence(
            self.tester.config.twins,
            model=_join_distinct(
                model_names.get(config.model, config.model) for config in configs
            ),
            task=_join_distinct(config.task_name for config in configs),
            object_name=_join_distinct(config.object for config in configs),
            environment=_join_distinct(config.environment_name for config in configs),
            in_photograph=are_all_in_photographs,
        )


def _join_distinct(names: Iterable[str]) -> str:
    """Join distinct names with commas."""
    return ",".join(dict.fromkeys(names))


def _plan_claims(
    suite: Suite, config: SuiteConfig, added: Counterexample | None
) -> list[PlannedClaim]:
    """Plan what is tested: counterexamples first, then claims.

    If a counterexample is added, only it is tested.

    Args:
        suite: the suite.
        config: settings of the command, which override those of the suite.
        added: the new counterexample; None if there is none.

    Raises:
        InputError: a claim and a counterexample have the same name, or `only` selects
            nothing or has an unknown name.
    """
    changes = _list_changes(config)
    if added is None:
        examples = counterexamples.read_counterexamples(config.suite)
    else:
        examples = [added]
    planned = [_plan_example(example, suite, changes) for example in examples]
    _check_example_names(planned, suite)
    if added is not None:
        return planned
    for name, suite_claim in suite.claims.items():
        claim_config = suite.make_config(name, **changes).with_python_parts_of(config)
        planned.append(PlannedClaim(name, suite_claim.claim, claim_config))
    return _select_claims(planned, config)


def _list_changes(config: SuiteConfig) -> dict[str, Any]:
    """Return the settings of the command that override those of a suite, by name.

    None stands for a setting that is not changed.
    """
    return {
        "model": config.model,
        "threads": config.threads,
        # False is the default, which must not override the suite's setting.
        "deterministic": config.deterministic or None,
    }


def _check_example_names(planned: Sequence[PlannedClaim], suite: Suite) -> None:
    """Raise an error if a counterexample has the name of a claim."""
    for claim in planned:
        if claim.name in suite.claims:
            raise InputError(
                f"claims.{claim.name}: a counterexample has the same name; rename the "
                "claim"
            )


def _select_claims(
    planned: Sequence[PlannedClaim], config: SuiteConfig
) -> list[PlannedClaim]:
    """Select the claims that the setting `only` names, by default all.

    The name `ALL_COUNTEREXAMPLES` selects all counterexamples.

    Raises:
        InputError: a name is unknown, or there are no counterexamples to select.
    """
    known = [*(claim.name for claim in planned), ALL_COUNTEREXAMPLES]
    for name in config.selected_claims:
        if name not in known:
            raise errors.UnknownNameError("claim in `only`", name, known)
    selected = [claim for claim in planned if _is_selected(claim, config)]
    # Every other name selects something, and a suite has at least one claim.
    if not selected:
        raise InputError(
            f"only: expected {ALL_COUNTEREXAMPLES} in "
            f"{counterexamples.counterexample_directory(config.suite)}, got none, so "
            "that nothing would be tested; keep the adversarial scene of a run with "
            "`add_counterexample`, or leave `only` out"
        )
    return selected


def _is_selected(claim: PlannedClaim, config: SuiteConfig) -> bool:
    """Return whether the setting `only` selects a claim; without names it does."""
    if not config.selected_claims or claim.name in config.selected_claims:
        return True
    all_examples = ALL_COUNTEREXAMPLES in config.selected_claims
    return all_examples and claim.counterexample is not None


def _plan_example(
    example: Counterexample, suite: Suite, changes: Mapping[str, object]
) -> PlannedClaim:
    """Plan the test of a counterexample.

    If it does not suit the suite's model, the plan has the reason, and it is not
    tested.

    Args:
        example: the counterexample.
        suite: the suite.
        changes: settings of the command; None for a setting that is not changed.
    """
    refusal = ""
    try:
        config = example.make_config(suite, changes)
    except InputError as error:
        config = example.config
        refusal = describe_unsuitable(str(error))
    return PlannedClaim(
        name=example.name,
        kind="counterexample",
        config=config,
        counterexample=example,
        unsuitable_reason=refusal,
    )


def _check_claims(planned: Sequence[PlannedClaim], suite: Suite) -> list[str]:
    """Check that claims can be tested, and return remarks about them.

    Everything that claims name is loaded, so that a wrong name is noticed now and not
    after minutes of rendering. Counterexamples are not loaded here, since they are
    tested first anyway.

    Raises:
        InputError: a claim cannot be tested, or its number of images is too small for a
            verdict.
    """
    claims = [
        (planned_claim, suite.claims[planned_claim.name])
        for planned_claim in planned
        if planned_claim.counterexample is None
    ]
    # remarks on numbers of images; "" for a claim without one
    remarks = [
        check_pictures(planned_claim.name, claim, suite.confidence)
        for planned_claim, claim in claims
    ]
    checked = list[AttackConfig]()
    for planned_claim, claim in claims:
        for config in _list_used_configs(planned_claim, claim):
            # Many claims share their settings, which are checked once.
            if config not in checked:
                _check_loading(planned_claim.name, config)
                checked.append(config)
    return list(filter(None, remarks))


def _check_loading(name: str, config: AttackConfig) -> None:
    """Load everything that the settings of a claim name; an error names the claim."""
    try:
        workbench.check_from_config(config)
    except InputError as error:
        raise InputError(f"claims.{name}: {error}") from None


def _list_used_configs(planned: PlannedClaim, claim: AnyClaim) -> list[AttackConfig]:
    """Return the settings with which a claim loads scene and model.

    A claim that compares two models has settings for each of them.

    Raises:
        InputError: the claim is about a search, and its settings are not those of a
            single search.
    """
    config = planned.config
    if not isinstance(config, AttackConfig):
        config = AttackConfig.from_config(config)
    if isinstance(claim, NotBrokenClaim):
        _check_search(planned.name, config)
    if isinstance(claim, NoWorseClaim):
        other_model_config = config.model_copy(update={"model": claim.than})
        return [config, other_model_config]
    return [config]


def _check_search(name: str, config: AttackConfig) -> None:
    """Check that the settings of a claim are those of a single search for an error.

    Args:
        name: name of the claim, for the message.
        config: settings of the search.

    Raises:
        InputError: a setting belongs to another kind of run, such as several attacks.
    """
    for setting, is_wrong, expected in (
        ("object", len(config.objects) > 1, "one object; make a claim of each"),
        ("epsilon", len(config.epsilons) > 1, "one epsilon; make a claim of each"),
        # With one object and one epsilon, only several models make several attacks.
        ("model", config.is_study, "one model; make a claim of each"),
        # A search for the smallest budget has no budget of its own.
        (
            "smallest",
            config.smallest,
            "a budget, which the claim is about; leave it out",
        ),
        # A search that makes the object easier finds no error.
        (
            "minimise",
            config.minimise,
            "a search that makes the model wrong; leave it out",
        ),
        ("target", config.target is not None, "any wrong prediction; leave it out"),
    ):
        if is_wrong:
            raise InputError(f"claims.{name}.settings: {setting}: expected {expected}")
