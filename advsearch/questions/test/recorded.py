"""Read the settings of claims and counterexamples that a run of `test` has stored."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from advsearch.extend import Store
from advsearch.questions.test.result import Cause, SuiteResult

# key of the suite and its seed in the store of a run, so that a resumed run repeats it
SUITE_NOTE = "suite"
# key of the settings of counterexamples by name
SETTINGS_NOTE = "counterexamples"


def read_noted_settings(
    run: Path, result: SuiteResult
) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Return the settings of each claim and counterexample that was tested.

    The result is indexed by the kind, "claim" or "counterexample", and then by the
    name. If the stored suite cannot be read, "claim" is missing.

    Args:
        run: directory of the run.
        result: result of the run, which states what was tested.
    """
    with Store.open_to_read(run) as store:
        suite = store.read_json_note(SUITE_NOTE)
        settings_of_examples = store.read_json_note(SETTINGS_NOTE)
    tested = _list_tested(result)
    settings: dict[str, dict[str, Mapping[str, Any]]] = {}
    # A stored suite that is corrupt causes one of these errors.
    with suppress(KeyError, AttributeError, TypeError, ValueError):
        settings["claim"] = {
            name: values
            for name, values in _settings_of_claims(suite).items()
            if name in tested
        }
    if isinstance(settings_of_examples, Mapping):
        settings["counterexample"] = {
            name: values
            for name, values in settings_of_examples.items()
            if name in tested and isinstance(values, Mapping)
        }
    return settings


def _list_tested(result: SuiteResult) -> set[str]:
    """Return the names of the claims and counterexamples that were tested."""
    # all others have one of these two causes
    return {
        claim.name
        for claim in result.claims
        if claim.cause not in (Cause.COUNTEREXAMPLE_FAILED, Cause.NOT_REACHED)
    }


def _settings_of_claims(suite: Any) -> dict[str, Mapping[str, Any]]:
    """Return the settings that each claim of a suite is tested with, by its name.

    Settings of the claim override those of the suite.

    Raises:
        KeyError, TypeError, AttributeError, ValueError: if the suite is corrupt.
    """
    common = {name: suite[name] for name in ("seed", "confidence") if name in suite}
    settings: dict[str, Mapping[str, Any]] = {}
    for name, claim in suite["claims"].items():
        fields = {key: value for key, value in claim.items() if key != "settings"}
        settings[name] = {**common, **suite["settings"], **fields, **claim["settings"]}
    return settings
