"""What a run of `test` noted of the settings of its claims and counterexamples, for
`advsearch report`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from advsearch.extend import Store
from advsearch.questions.test.result import Cause, SuiteResult

# under which a run's store keeps the suite with its seed, so that it goes on as it
# began
SUITE_NOTE = "suite"
# under which it keeps what counterexamples are judged with, by name
SETTINGS_NOTE = "counterexamples"


def noted_settings(
    run: Path, result: SuiteResult
) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Return the settings of each claim and counterexample that was tried, by "claim"
    or "counterexample" and name.

    "claim" is missing where the suite cannot be read any more.
    """
    with Store.open_to_read(run) as store:
        suite = store.noted(SUITE_NOTE)
        examples = store.noted(SETTINGS_NOTE)
    not_tried = (Cause.COUNTEREXAMPLE_FAILED, Cause.NOT_REACHED)
    tried = {claim.name for claim in result.claims if claim.cause not in not_tried}
    settings: dict[str, dict[str, Mapping[str, Any]]] = {}
    with suppress(KeyError, AttributeError, TypeError, ValueError):
        settings["claim"] = {
            name: values
            for name, values in _settings_of_claims(suite).items()
            if name in tried
        }
    if isinstance(examples, Mapping):
        settings["counterexample"] = {
            name: values
            for name, values in examples.items()
            if name in tried and isinstance(values, Mapping)
        }
    return settings


def _settings_of_claims(suite: Any) -> dict[str, Mapping[str, Any]]:
    """Return what each claim of a suite is judged with. Raises KeyError, TypeError,
    ...: the suite is damaged.
    """
    common = {name: suite[name] for name in ("seed", "confidence") if name in suite}
    settings: dict[str, Mapping[str, Any]] = {}
    for name, claim in suite["claims"].items():
        of_claim = {key: value for key, value in claim.items() if key != "settings"}
        settings[name] = {
            **common,
            **suite["settings"],
            **of_claim,
            **claim["settings"],
        }
    return settings
