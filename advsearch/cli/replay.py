"""`advsearch replay`: the answer of a run under other conditions, in one table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.output import as_notes
from advsearch.cli.question import Positional, QuestionCommand

if TYPE_CHECKING:
    from advsearch.runs.results.replay import ReplayResult

HELP = "render the answer of a run again under other conditions, beside the clean scene"
EXAMPLES = (
    "replay mug-texture-001",
    "replay mug-texture-001 --ways jpeg,sensor --model torchvision:resnet18 --json",
)


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
    return "\n\n".join(parts) + as_notes(result.warnings)


COMMAND = QuestionCommand("replay", answer, about="answer", place=Positional("RUN", "a run"))
