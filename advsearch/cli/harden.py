"""`advsearch harden`: train a copy of a model on its worst cases, and measure what came of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli.output import columns
from advsearch.cli.question import QuestionCommand
from advsearch.report import wording

if TYPE_CHECKING:
    from advsearch.runs.results.harden import HardenResult

HELP = "train a copy of a model on its worst cases, and measure it before and after on scenes that training never saw"
EXAMPLES = (
    "harden --model reference --control texture --epsilon 0.03 --quick",
    "harden --model mypackage:network@weights.safetensors --labels labels.json --control texture,pose,light",
)


def answer(result: HardenResult) -> str:
    """Return the table of a hardening."""
    from advsearch.report.hardening import HEADS, hardened_rows, hardened_text

    facts = [
        ["searched with", result.search],
        ["stronger", result.stronger_search],
        ["load it with", f"--model {result.hardened}" if result.hardened else ""],
        ["weights", result.weights or ""],
        ["pictures", result.pictures or ""],
        ["workers", wording.workers_text(result.shared)],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["run", str(result.run)],
    ]
    rows = hardened_rows(result)
    parts = [hardened_text(result), columns([list(HEADS), *rows]) if rows else "", columns([f for f in facts if f[1]])]
    return "\n\n".join(part for part in parts if part)


COMMAND = QuestionCommand("harden", answer)
