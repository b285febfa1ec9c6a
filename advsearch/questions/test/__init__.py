"""`advsearch test`: claims about a model, each held, failed or undecided; a gate at every change."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.cli.main import QuestionCommand
from advsearch.cli.output import at_work
from advsearch.errors import InputError

if TYPE_CHECKING:
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
        files = {name: Path(file) for name in ("junit", "sarif", "markdown") if (file := getattr(config, name))}
        for name, path in files.items():  # before anything is rendered
            if path.is_dir() or not path.absolute().parent.is_dir():
                raise InputError(
                    f"{name}: expected a file in a folder that is there, got {path}; make the folder first"
                )
        with at_work(as_json=as_json, quiet=quiet) as progress:
            # late, so that --help answers at once
            from advsearch.question import carry_out
            from advsearch.questions.test import result as room
            from advsearch.runs.files import write_text

            result: Any = carry_out(config, progress=progress, resumed=resumed)
        for name, path in files.items():
            write_text(path, getattr(room, name)(result), durable=False)
        return output.finish(result, self.text, as_json=as_json) or result.status


COMMAND = _Test("test", about="suite", expected=("SUITE", "a suite, a YAML file"), examples=EXAMPLES)
