"""`advsearch explain`: where a model is wrong and why, in words, from the rows of sweeps."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.runs.results.explain import ExplainResult

HELP = "say in words where a model is wrong, from the rows of sweeps, and confirm it by fresh renders"


class _Explain(QuestionCommand):
    """The command, which takes the runs by their place, or by `--sweeps`."""

    def add_parser(self, subparsers: argparse._SubParsersAction[Any]) -> argparse.ArgumentParser:
        """Add the command."""
        parser = super().add_parser(subparsers)
        parser.add_argument("sweeps", metavar="RUN", nargs="*", default=argparse.SUPPRESS, help="as `--sweeps`")
        output.add_code_flag(parser)
        return parser

    def run(self, args: argparse.Namespace) -> int:
        """Explain the runs and print what is found."""
        from advsearch.registry import only_named_code
        from advsearch.runs.directory import CONFIG, find_run
        from advsearch.settings import split_names

        named = getattr(args, "sweeps", None)
        if not named:
            raise InputError("advsearch explain: expected the run of a sweep; see advsearch explain --help")
        args.sweeps = named if isinstance(named, str) else ",".join(named)
        with only_named_code(find_run(split_names(args.sweeps)[0]) / CONFIG, args.code):
            return super().run(args)


def answer(result: ExplainResult) -> str:
    """Return the rules, what matters, the envelope and the cost."""
    from advsearch.report import wording
    from advsearch.report.explanations import (
        WEIGHT_HEADS,
        envelope_text,
        explain_text,
        explained_text,
        pair_text,
        rule_text,
        share_text,
        weight_rows,
    )
    from advsearch.runs.directory import REPORT

    parts = [explain_text(result)]
    parts += [f"{number + 1}. {rule_text(number, rule)}" for number, rule in enumerate(result.rules)]
    if result.importance:
        heads = f"What decides (Sobol indices; {explained_text(result)} of the answers' variance are explained):"
        parts.append(f"{heads}\n{output.columns([list(WEIGHT_HEADS), *weight_rows(result)])}")
    parts.append(f"Envelope. {envelope_text(result)}")
    parts += [f"One thing changed. {pair_text(pair)}" for pair in result.pairs]
    facts = [
        ["rows", f"right in {share_text(result)}"],
        ["renders", str(result.renders)],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["page", f"{result.run}/{REPORT}"],
    ]
    parts.append(output.columns(facts))
    parts += ["Interrupted."] if result.goes_on else []
    return "\n\n".join(parts) + "".join(f"\n\nNote: {text}" for text in result.warnings)


COMMAND = _Explain(
    "explain",
    HELP,
    answer,
    (
        "explain mug-sweep-001",
        "explain mug-sweep-001 mug-sweep-002 --confirm 200 --accuracy 0.9",
        "explain mug-sweep-001 --confirm 0 --pairs 0 --json",
    ),
)
