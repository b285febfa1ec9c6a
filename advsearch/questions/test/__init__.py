"""Test claims about a model. The verdict of each is held, failed or undecided."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.extend import (
    InputError,
    PositionalArgument,
    RunContext,
    experiment,
    writing,
)
from advsearch.questions.test import result as results
from advsearch.questions.test.recorded import read_noted_settings
from advsearch.questions.test.result import SuiteResult
from advsearch.questions.test.settings import SuiteConfig, parse_suite

FILE_FORMATS = {
    "junit": results.format_junit,
    "sarif": results.format_sarif,
    "markdown": results.format_markdown,
}
"""Settings that name a file for other programs, and the functions that format it."""


@experiment(
    "test suites/mug.yaml",
    "test suites/mug.yaml --model model.pt2 --junit junit.xml --sarif robustness.sarif",
    "test suites/mug.yaml --only counterexamples",
    "test suites/mug.yaml --add mug-texture-001",
    "test suites/mug.yaml --fresh --seconds 600 --json",
    positional_args=("suite",),
    about="suite",
    positional=PositionalArgument("SUITE", "a suite, a YAML file"),
    exit_status=lambda result: result.status,
    view=results.make_view,
    claims=results.list_claims,
    noted_settings=read_noted_settings,
)
def test(
    context: RunContext[SuiteConfig], suite: Mapping[str, Any] | None = None
) -> SuiteResult:
    """Test the claims of a suite, counterexamples first (docs/testing.md).

    Claims are not tested if a counterexample fails, unless `all` is set. Reports for
    other programs, such as JUnit XML and SARIF, are written at the end.

    Args:
        suite: path of the suite's YAML file, or its content as Python mappings.
    """
    from advsearch.questions.test.carry_out import try_suite  # imports torch

    config = context.config
    # Files are checked before the test, which may take hours.
    files = _find_report_files(config)
    parsed_suite = None if suite is None else parse_suite(suite, config.suite)
    result = try_suite(context, parsed_suite)
    for name, path in files.items():
        writing.write_text(path, FILE_FORMATS[name](result), durable=False)
    return result


def _find_report_files(config: SuiteConfig) -> dict[str, Path]:
    """Return the files for other programs, by the settings that name them.

    Raises:
        InputError: the folder of a file does not exist.
    """
    files: dict[str, Path] = {}
    for name in FILE_FORMATS:
        file = getattr(config, name)
        if file:
            files[name] = Path(file)
    for name, path in files.items():
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise InputError(
                f"{name}: expected a file in a folder that exists, got "
                f"{path}; make the folder first"
            )
    return files
