"""`advsearch test`: claims about a model, each held, failed or undecided; a gate at every change."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.cli.main import QuestionCommand
from advsearch.cli.output import at_work
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.questions.test.result import SuiteResult
    from advsearch.settings import Config

HELP = "test claims about a model, each found held, failed or undecided: a gate at every change"
EXAMPLES = (
    "test suites/mug.yaml",
    "test suites/mug.yaml --model model.pt2 --junit junit.xml --sarif robustness.sarif",
    "test suites/mug.yaml --only counterexamples",
    "test suites/mug.yaml --add mug-texture-001",
    "test suites/mug.yaml --fresh --seconds 600 --json",
)


class _Test(QuestionCommand):
    """The command: its exit status is the suite's verdict, and machines get their files."""

    def carry_out(self, config: Config, *, as_json: bool, quiet: bool, resumed: Path | None = None) -> int:
        """Try the claims, print their verdicts, write the files, and return the exit status."""
        _check_files(config)
        with at_work(as_json=as_json, quiet=quiet) as progress:
            # late, so that --help answers at once
            from advsearch.question import carry_out

            result: Any = carry_out(config, progress=progress, resumed=resumed)
        write_files(config, result)
        return output.finish(result, self.text, as_json=as_json) or result.status


def _files(config: Config) -> dict[str, Path]:
    return {name: Path(given) for name in ("junit", "sarif", "markdown") if (given := getattr(config, name))}


def _check_files(config: Config) -> None:
    """Refuse, by an InputError, files that cannot be written before anything is rendered."""
    for name, path in _files(config).items():
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise InputError(f"{name}: expected a file in a folder that is there, got {path}; make the folder first")


def write_files(config: Config, result: SuiteResult) -> None:
    """Write the files for machines that a configuration asks for."""
    # late, so that --help answers at once
    from advsearch.questions.test import result as room
    from advsearch.runs.files import write_text

    for name, path in _files(config).items():
        write_text(path, getattr(room, name)(result), durable=False)


COMMAND = _Test("test", about="suite", expected=("SUITE", "a suite, a YAML file"), examples=EXAMPLES)
