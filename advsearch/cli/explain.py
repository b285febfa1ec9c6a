"""`advsearch explain`: where a model is wrong and why, in words, from the rows of sweeps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.output import as_notes
from advsearch.cli.question import Positional, QuestionCommand

if TYPE_CHECKING:
    from advsearch.runs.results.explain import ExplainResult

HELP = "say in words where a model is wrong, from the rows of sweeps, and confirm it by fresh renders"
EXAMPLES = (
    "explain mug-sweep-001",
    "explain mug-sweep-001 mug-sweep-002 --confirm 200 --accuracy 0.9",
    "explain mug-sweep-001 --confirm 0 --pairs 0 --json",
)


def answer(result: ExplainResult) -> str:
    """Return the rules, what matters, the envelope and the cost."""
    from advsearch.report import wording
    from advsearch.report.explanations import (
        WEIGHT_HEADS,
        cluster_text,
        clusters_text,
        envelope_text,
        explain_text,
        not_told_text,
        pair_text,
        pairs_text,
        right_share_text,
        rule_text,
        weight_rows,
    )
    from advsearch.runs.directory import REPORT

    parts = [explain_text(result)]
    parts += [f"{number + 1}. {rule_text(number, rule)}" for number, rule in enumerate(result.rules)]
    parts += [not_told_text(result)] if result.not_told else []
    if result.importance:
        heads = "What decides: share of the answers' variance, by which part of its values a parameter lies in"
        parts.append(f"{heads}\n{output.aligned([list(WEIGHT_HEADS), *weight_rows(result)])}")
    parts.append(f"Envelope. {envelope_text(result)}")
    parts += [f"One thing changed. {pairs_text(result)}"] if result.pairs_sought else []
    parts += [f"One thing changed. {pair_text(pair)}" for pair in result.pairs]
    if result.clusters is not None:
        parts.append(f"Kinds. {clusters_text(result.clusters)}")
        parts.append(output.aligned([[one.picture, cluster_text(one)] for one in result.clusters.listed]))
    facts = [
        ["rows", f"right in {right_share_text(result)}"],
        ["renders", str(result.renders)],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["page", f"{result.run}/{REPORT}"],
    ]
    parts.append(output.aligned(facts))
    parts += ["Interrupted."] if result.goes_on else []
    return "\n\n".join(parts) + as_notes(result.warnings)


COMMAND = QuestionCommand(
    "explain", answer, about="sweeps", place=Positional("RUN", "the run of a sweep", several=True)
)
