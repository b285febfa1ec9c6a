"""The last thing `sweep` prints: how often the model was right, where it was not, and what it cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from advsearch.cli.output import columns
from advsearch.report import wording

Summary = Mapping[str, Any]

READING = "How often it is right at each value, over all others, with the 95 % interval:"
"""What the tables show."""

BAR = 20
"""Width of a bar in characters."""

MOST_ROWS = 24
"""Values of an axis that are all shown; of more, half as many: those where the model does worst."""


def answer(summary: Summary) -> str:
    """Return accuracy in total and by axis, the worst configuration and the cost.

    Args:
        summary: as in `summary.json` of a sweep.
    """
    facts = [[name, text] for name, text in _facts(summary).items() if text]
    parts = [_verdict(summary), *_tables(summary), columns(facts)]
    notes = [*map(str, summary.get("warnings") or ())]
    return "\n\n".join(part for part in parts if part) + "".join(f"\n\nNote: {text}" for text in notes)


def _verdict(summary: Summary) -> str:
    seen = summary.get("configurations") or 0
    if not seen:
        return "Interrupted before the first configuration."
    rate = f"{wording.percent(summary['accuracy'])}, 95 % interval {wording.interval_text(summary)}"
    of = f"{summary['correct']} of {wording.count(seen, 'configuration')}"
    if summary.get("ending") == "interrupted" and seen < summary.get("planned", seen):
        return (
            f"Interrupted after {seen} of {summary['planned']} configurations: right in {summary['correct']} ({rate})."
        )
    return f"The model is right in {of} ({rate})."


def _tables(summary: Summary) -> list[str]:
    by_axis: dict[str, list[Summary]] = {}
    for row in summary.get("axes") or ():
        by_axis.setdefault(str(row["axis"]), []).append(row)
    return [READING, *(_table(name, rows) for name, rows in by_axis.items())] if by_axis else []


def _table(name: str, rows: Sequence[Summary]) -> str:
    """One axis: a bar and a rate for each value."""
    shown, title = list(rows), name + (f", {rows[0]['unit']}" if rows[0].get("unit") not in ("", "name", "1") else "")
    if len(rows) > MOST_ROWS:
        worst = sorted(range(len(rows)), key=lambda number: rows[number]["accuracy"])[: MOST_ROWS // 2]
        shown = [rows[number] for number in sorted(worst)]
        title += f" (the {len(shown)} of {len(rows)} values where the model is right least often)"
    lines = [
        [
            _value(row["value"]),
            _bar(row["accuracy"]),
            wording.percent(row["accuracy"]),
            f"{row['correct']} of {row['configurations']}",
            wording.interval_text(row),
        ]
        for row in shown
    ]
    return f"{title}\n{columns(lines)}"


def _bar(share: float) -> str:
    filled = round(share * BAR)
    return "#" * filled + "." * (BAR - filled)


def _value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return " to ".join(_value(end) for end in value)
    return f"{value:.4g}" if isinstance(value, float) else wording.short_name(value)


def _facts(summary: Summary) -> dict[str, str]:
    worst = summary.get("worst") or {}
    seconds = (summary.get("seconds") or {}).get("total")
    speed = summary.get("renders_per_second")
    renders = summary.get("renders") or {}
    return {
        "worst": _configuration(worst),
        "": _said(summary),
        "renders": f"{renders.get('sweep', 0)}" + (f", {speed:.3g} a second" if speed else ""),
        "time": wording.seconds_text(seconds) if seconds is not None else "",
        "kept in": str(summary.get("run") or ""),
    }


def _configuration(worst: Summary) -> str:
    outer = ("object", "environment", "model")
    values = {name: one for name, one in (worst.get("values") or {}).items() if name not in outer}
    names = [f"{name} {_value(one['value'])}" for name, one in values.items()]
    return ", ".join([*(wording.short_name(worst["values"][name]["value"]) for name in outer), *names]) if worst else ""


def _said(summary: Summary) -> str:
    worst = summary.get("worst") or {}
    if not worst:
        return ""
    claim, checked = worst["claimed"], worst.get("verified")
    text = f"answer {claim['label']}" + (f" ({wording.percent(claim['probability'])})" if claim["probability"] else "")
    text += f"; margin ({wording.margin_text(summary)}) {claim['margin']:.3g}; "
    return f"{text}wrong in {wording.rate_text(checked)}" if checked else f"{text}not verified"
