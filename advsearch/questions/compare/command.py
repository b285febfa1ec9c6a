"""`advsearch compare`: two models, objects or answers beside each other, on the same pictures."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from advsearch.cli.output import aligned, as_notes
from advsearch.cli.question import Positional, QuestionCommand

if TYPE_CHECKING:
    from advsearch.questions.compare.answer import ComparedPair, CompareResult

HELP = "compare models, objects or answers on the same pictures, pair by pair"
EXAMPLES = (
    "compare mug-sweep-001",
    "compare mug-sweep-001 mug-sweep-002 --json",
    "compare reference hardened.pt2 --object mug --control pose,camera --samples 200",
)

MOST_TABLES, MOST_PICTURES = 4, 3
"""Parameters, and pictures of what one side alone gets right, that a terminal shows; the page has all."""


class _Compare(QuestionCommand):
    """The command, which is about stored sweeps unless it is said what models are shown."""

    def file(self, args: argparse.Namespace) -> Path | None:
        """Return the settings of the first sweep, if it is about stored ones."""
        return None if {"object", "scene"} & vars(args).keys() else super().file(args)


def answer(result: CompareResult) -> str:
    """Return each side's accuracy, the pairs, where one is worse and the cost."""
    from advsearch.questions.compare.words import SIDE_HEADS, side_rows
    from advsearch.report import wording
    from advsearch.runs.directory import REPORT

    parts = [part for pair in result.pairs for part in _pair(pair)]
    if result.sides:
        parts.insert(1, aligned([list(SIDE_HEADS), *side_rows(result)]))
    facts = [
        ["renders", str(result.renders)],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["page", f"{result.run}/{REPORT}"],
    ]
    parts.append(aligned(facts))
    parts += ["Interrupted."] if result.goes_on else []
    return "\n\n".join(parts) + as_notes(result.warnings)


def _pair(pair: ComparedPair) -> list[str]:
    from advsearch.questions.compare.words import (
        alone_text,
        headline,
        paired_rows,
        part_heads,
        part_rows,
        parts_of,
        picture_text,
        rules_texts,
        telling,
    )

    parts = [f"{headline(pair)} {alone_text(pair)}", aligned(paired_rows(pair)), *rules_texts(pair)]
    tables = parts_of(pair)
    shown = telling(tables, MOST_TABLES)
    parts += [aligned([part_heads(pair, name), *part_rows(rows)]) for name, rows in shown.items()]
    if len(shown) < len(tables):
        parts.append(f"The difference varies most over these; the page has all {len(tables)} parameters.")
    for name in (pair.first, pair.second):
        listed = [one for one in pair.shown if one.right == name][:MOST_PICTURES]
        lines = [f"  {picture_text(one, pair)}" + "".join(f"\n    {file}" for file in one.pictures) for one in listed]
        parts += ["\n".join([f"Only {name} gets right:", *lines])] if lines else []
    return parts


COMMAND = _Compare(
    "compare",
    answer,
    about="compared",
    place=Positional("WHAT", "the run of a sweep, or models and what they are shown", several=True),
)
