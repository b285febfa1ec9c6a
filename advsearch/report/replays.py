"""A replay in words and tables."""

from __future__ import annotations

from advsearch.report import wording
from advsearch.runs.results.replay import NOT_DONE, ReplayResult, ReplayRow

HEADS = ("changed", "to", "clean right", "95 % interval", "success", "95 % interval", "answer")
"""Of the columns."""


def replay_text(result: ReplayResult) -> str:
    """Return what the table says, in a sentence."""
    changed = [row for row in result.table[1:] if row.ending != NOT_DONE]
    if not result.table:
        return "Nothing was rendered again."
    own = "holds" if result.table[0].ending == "found" else "does not hold"
    held = [row for row in changed if row.ending == "found"]
    worthless = [row for row in changed if row.ending == "already wrong"]
    text = f"As verified, the answer {own}; changed, it holds under {len(held)} of {len(changed)} conditions."
    if worthless:
        names = ", ".join(f"{row.way}: {row.condition}" for row in worthless)
        text += f" The clean scene itself fails under {names}, where an answer says nothing."
    return text


def replay_rows(result: ReplayResult) -> list[list[str]]:
    """Return a row for each condition."""
    return [[row.way, "" if row.way == row.condition else row.condition, *_rates(row)] for row in result.table]


def _rates(row: ReplayRow) -> list[str]:
    clean, rated = row.clean, row.verified
    if clean is None or rated is None:
        return ["", "", "", "", f"{NOT_DONE}: {row.reason}"]
    return [
        f"{clean.correct}/{clean.trials}{wording.no_numbers(clean.not_a_number)}",
        wording.interval_text(clean.interval),
        f"{rated.successes}/{rated.trials}{wording.no_numbers(rated.not_a_number)}",
        wording.interval_text(rated.interval),
        {"found": "holds", "already wrong": "clean is wrong too"}.get(row.ending, "does not hold"),
    ]
