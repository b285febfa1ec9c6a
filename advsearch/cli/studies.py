"""What studies print last: robust accuracy against epsilon, and the worst case beside the average."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from advsearch.cli.output import columns
from advsearch.report import wording

Summary = Mapping[str, Any]


def _margin(summary: Summary) -> str:
    return f"\n  margin: {wording.margin_text(summary)}, in the trials of the worst case"


def answer(summary: Summary) -> str:
    """Return the tables of a study's summary."""
    parts = [_gap(summary)] if summary.get("command") == "gap" else [_objects(summary), _curve(summary)]
    facts = [["time", wording.seconds_text(summary["seconds"]["total"])], ["run", str(summary["run"])]]
    ending = "Interrupted." if summary.get("ending") == "interrupted" else ""
    return "\n\n".join(part for part in (*parts, columns(facts), ending) if part)


def _objects(summary: Summary) -> str:
    heads = ["object", "clean right", "ending", "epsilon", "wrong", "margin"]
    return columns([heads, *([row["object"], *_seen(row)] for row in summary["table"])]) + _margin(summary)


def _seen(row: Summary) -> list[str]:
    if row.get("ending") is None:
        return ["not reached"]
    clean, verified = row.get("clean") or {}, row.get("verified") or {}
    return [
        f"{clean['correct']}/{clean['trials']}" if clean else "",
        str(row["ending"]),
        _plain(row.get("epsilon")),
        f"{verified['successes']}/{verified['trials']}" if verified else "",
        f"{row['margin']:.2f}" if row.get("margin") is not None else "",
    ]


def _curve(summary: Summary) -> str:
    heads = ["epsilon", "robust", "accuracy", "95 % interval", "wrong already"]
    rows = [
        [
            _plain(one["epsilon"]) or "own",
            f"{one['robust']}/{one['objects']}",
            wording.percent(one["accuracy"]),
            wording.interval_text(one),
            str(one["already_wrong"]),
        ]
        for one in summary["curve"]
        if one["accuracy"] is not None
    ]
    return columns([heads, *rows]) if rows else ""


def _gap(summary: Summary) -> str:
    heads = ["object", "control", "right on average", "95 % interval", "worst: wrong", "margin", "ending"]
    rows = []
    for row in summary["table"]:
        average, worst = row["average"], row["worst"] or {}
        rows.append(
            [
                row["object"],
                row["control"],
                f"{average['correct']}/{average['configurations']} ({wording.percent(average['accuracy'])})",
                wording.interval_text(average),
                f"{worst['successes']}/{worst['trials']}" if worst else "",
                f"{row['margin']:.2f}" if row["margin"] is not None else "",
                str(row["ending"]),
            ]
        )
    return columns([heads, *rows]) + _margin(summary)


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ",".join(f"{name}={_plain(one)}" for name, one in value.items())
    return "" if value is None else wording.number_text(value)
