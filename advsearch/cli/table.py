"""The last thing `attack` prints: what was found, in a table that a person reads in five seconds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from advsearch.cli.output import columns
from advsearch.report import wording

Summary = Mapping[str, Any]


def answer(summary: Summary) -> str:
    """Return the verdict, the rates, the cost and the place of the pictures.

    Args:
        summary: as in `summary.json` (docs/design.md, "summary.json"); what is missing is left out.
    """
    found = (_clean(summary), _adversarial(summary), _random(summary), _average(summary))
    rates = [row for row in found if row]
    facts = [[name, text] for name, text in _facts(summary).items() if text]
    parts = [wording.verdict(summary), columns(rates), columns(facts)]
    return "\n\n".join(part for part in parts if part) + "".join(f"\n\nNote: {text}" for text in _notes(summary))


def _clean(summary: Summary) -> list[str]:
    clean = summary.get("clean") or {}
    control = clean.get("control") or {}
    return ["clean", *_answer(clean), *_rate("right", control, "correct")] if clean else []


def _adversarial(summary: Summary) -> list[str]:
    found, verified = summary.get("adversarial") or {}, summary.get("verified") or {}
    return ["adversarial", *_answer(found), *_rate(wording.success(summary), verified)] if found else []


def _random(summary: Summary) -> list[str]:
    baseline = summary.get("baseline") or {}
    if not baseline:
        return []
    renders = f"{baseline['renders']} renders" if baseline.get("renders") else ""
    return ["random search", renders, "", *_rate(wording.success(summary), baseline.get("verified") or {})]


def _average(summary: Summary) -> list[str]:
    average = summary.get("average") or {}
    if not average:
        return []
    drawn = wording.count(average["configurations"], "configuration")
    return ["average case", drawn, "", wording.average_text(summary), wording.interval_text(average)]


def _answer(answer: Summary) -> list[str]:
    known = answer.get("probability") is not None
    return [str(answer.get("label") or "?"), wording.percent(answer["probability"]) if known else ""]


def _rate(what: str, rated: Summary, key: str = "successes") -> list[str]:
    if not rated.get("trials"):
        return ["not verified"]
    return [f"{what} in {wording.tally(rated, key)}", wording.interval_text(rated)]


def _facts(summary: Summary) -> dict[str, str]:
    seconds = (summary.get("seconds") or {}).get("total")
    searched = f"{summary.get('policy')}, {wording.count(summary.get('steps'), 'step')}: {summary.get('ending')}"
    return {
        "wanted": wording.goal_text(summary),
        "changed": wording.changed_text(summary),
        "over": wording.over_text(summary),
        "smallest": wording.smallest_text(summary),
        "search": searched,
        "renders": wording.renders_text(summary),
        "time": wording.seconds_text(seconds) if seconds is not None else "",
        "pictures": str(summary.get("run") or ""),
    }


def _notes(summary: Summary) -> list[str]:
    return wording.remarks(summary)
