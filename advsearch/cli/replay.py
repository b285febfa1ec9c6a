"""`advsearch replay`: the answer of a run under other conditions, in one table."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.runs.results.replay import ReplayResult

HELP = "render the answer of a run under other conditions, each beside the clean scene"


class _Replay(QuestionCommand):
    """The command, which takes the run by its place, or by `--answer`."""

    def add_parser(self, subparsers: argparse._SubParsersAction[Any]) -> argparse.ArgumentParser:
        """Add the command."""
        parser = super().add_parser(subparsers)
        parser.add_argument("answer", metavar="RUN", nargs="?", default=argparse.SUPPRESS, help="as `--answer`")
        output.add_code_flag(parser)
        return parser

    def run(self, args: argparse.Namespace) -> int:
        """Render the answer again and print the table."""
        from advsearch.registry import only_named_code
        from advsearch.runs.directory import CONFIG, find_run

        if "answer" not in args:
            raise InputError("advsearch replay: expected a run; see advsearch replay --help")
        given = [name.strip() for name in getattr(args, "model", "").split(",")]
        with only_named_code(find_run(args.answer) / CONFIG, [*args.code, *(one.partition("@")[0] for one in given)]):
            return super().run(args)


def answer(result: ReplayResult) -> str:
    """Return the table of conditions."""
    from advsearch.report import wording
    from advsearch.report.replays import HEADS, replay_rows, replay_text

    facts = [
        ["renders", str(result.renders)],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["run", str(result.run)],
    ]
    parts = [replay_text(result), output.columns([HEADS, *replay_rows(result)]), output.columns(facts)]
    parts += ["Interrupted."] if result.ending == "interrupted" else []
    return "\n\n".join(parts) + "".join(f"\n\nNote: {text}" for text in result.warnings)


COMMAND = _Replay(
    "replay",
    HELP,
    answer,
    (
        "replay mug-texture-001",
        "replay mug-texture-001 --ways jpeg,sensor --model torchvision:resnet18 --json",
    ),
)
