"""What an engineer reads of a run beside its claims: shares by condition, whether a criterion is met, how common
conditions are, the operational design domain in words, and what is not shown."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from advsearch.attacks import clopper_pearson
from advsearch.errors import InputError, UnknownNameError
from advsearch.questions.explain.result import ExplainResult, rule_text
from advsearch.questions.report.result import ConditionShare
from advsearch.questions.sweep.summary import AxisValue, SweepSummary
from advsearch.report.shown import Claim
from advsearch.report.wording import interval_text, number_text, percent
from advsearch.runs.results import Interval, Result
from advsearch.runs.store import Row
from advsearch.settings import read_yaml

DOMAIN = {
    "place": ("environment", "background"),
    "light": ("light", "sky", "exposure", "shadow", "projector", "spot"),
    "weather": ("haze",),
    "road users and things": ("object", "answer", "things", "pose", "body", "occlusion", "contents"),
    "surfaces": ("texture", "material", "patch", "geometry"),
    "ways and speeds": ("path",),
    "camera and picture": ("camera", "lens", "sensor", "corruption"),
}
"""The parts of an operational design domain, and the axes and controls that each is about."""

Exposure = Mapping[str, Mapping[str, float]]
"""How common the values of axes are: weights by axis and value."""


def conditions_of(result: Result) -> list[ConditionShare]:
    """Return the share of right predictions by each value of each axis of a sweep, and under each rule of `explain`."""
    if isinstance(result, SweepSummary):
        return [
            ConditionShare(
                condition=f"{row.axis} {_value(row.value)} {'' if row.unit == '1' else row.unit}".strip(),
                axis=row.axis,
                value=_value(row.value),
                right=row.correct,
                total=row.configurations,
                interval=row.interval,
            )
            for row in result.axes
            if row.configurations and row.interval is not None
        ]
    return []


def photograph_conditions(result: Result, photographs: Iterable[Row]) -> list[ConditionShare]:
    """Return the share of photographs that agree with the rendering that they were aligned with, by each value of each
    axis of a sweep: right in both or wrong in both."""
    rows, found = list(photographs), list[ConditionShare]()
    for one in result.axes if isinstance(result, SweepSummary) else ():
        of_it = [row for row in rows if one.axis in row.values and _has(row.values[one.axis]["value"], one.value)]
        payloads: list[Any] = [row.payload for row in of_it]
        agreeing = sum(
            bool(row.correct) == bool(kept["photo"]["right"]) for row, kept in zip(of_it, payloads, strict=True)
        )
        if of_it:
            found.append(
                ConditionShare(
                    condition=f"{one.axis} {_value(one.value)} {'' if one.unit == '1' else one.unit}".strip(),
                    axis=one.axis,
                    value=_value(one.value),
                    right=agreeing,
                    total=len(of_it),
                    interval=clopper_pearson(agreeing, len(of_it)),
                )
            )
    return found


def _agrees(photograph: Row) -> bool:
    kept: Any = photograph.payload
    return bool(photograph.correct) == bool(kept["photo"]["right"])


def _has(value: float | str, of: AxisValue) -> bool:
    """Whether a value of a row is that of an axis, or lies in that part of its range."""
    if isinstance(value, str) or isinstance(of, str):
        return value == of
    return of[0] <= value <= of[1] if isinstance(of, tuple) else math.isclose(value, of)


def _value(value: object) -> str:
    if isinstance(value, tuple):
        return f"{value[0]:.4g} to {value[1]:.4g}"
    return number_text(value) if isinstance(value, float) else str(value)


def triggering_conditions(result: Result) -> list[str]:
    """Return the rules of `explain`, and whether fresh renders confirm each."""
    lines = []
    for number, rule in enumerate(result.rules if isinstance(result, ExplainResult) else [], 1):
        state = "Counted on rows that did not choose it, not rendered"
        if rule.confirmed is not None:
            state = "Confirmed" if rule.confirmed.held else "Not confirmed"
        lines.append(f"{state}: {rule_text(number, rule)}")
    return lines


def met(criterion: float, interval: Interval) -> str:
    """Return whether a share is surely at least as large as asked, surely not, or neither."""
    return "met" if interval[0] >= criterion else "not met" if interval[1] < criterion else "open"


def criterion_lines(claims: Sequence[Claim], conditions: Sequence[ConditionShare], criterion: float) -> list[str]:
    """Return what a criterion, that so large a share is right, comes to: of each share of right predictions that is
    measured, and which conditions fall short. A share of failures has none."""
    lines = []
    for one in claims:
        if one.extent is not None and ("right" in one.extent.what or "held-out" in one.extent.what):
            lines.append(
                f"At least {percent(criterion)}: {met(criterion, one.extent.interval)} by {one.extent.count} of "
                f"{one.extent.total} {one.extent.what}, 95 % interval {interval_text(one.extent.interval)}."
            )
    short = [one.condition for one in conditions if met(criterion, one.interval) == "not met"]
    if short:
        lines.append(f"Not met where: {', '.join(short)}.")
    return lines


def read_exposure(path: str) -> dict[str, dict[str, float]]:
    """Return what a YAML file says of how common values are, such as ``environment: {street: 0.8, street-wet: 0.2}``.

    Raises:
        InputError: the file is missing, or says something else.
    """
    found: dict[str, dict[str, float]] = {}
    for axis, weights in read_yaml(path).items():
        if not isinstance(weights, Mapping) or not weights:
            raise InputError(f"exposure: {path}: {axis}: expected values with a weight each, such as {{street: 0.8}}")
        for value, weight in weights.items():
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not 0.0 <= weight <= 1e9:
                raise InputError(f"exposure: {path}: {axis}: {value}: expected a number of at least 0, got {weight!r}")
        found[str(axis)] = {str(value): float(weight) for value, weight in weights.items()}
        if sum(found[str(axis)].values()) <= 0.0:
            raise InputError(f"exposure: {path}: {axis}: expected a weight over 0")
    return found


def exposure_lines(result: Result, conditions: Sequence[ConditionShare], exposure: Exposure) -> list[str]:
    """Return the share of right predictions where the values of an axis are as common as weights say: the weighted mean
    of the shares, between those of the ends of intervals that hold together (Bonferroni)."""
    lines = []
    independent = isinstance(result, SweepSummary) and result.units is None
    for axis, weights in exposure.items():
        rows = {one.value: one for one in conditions if one.axis == axis}
        if not rows:
            continue
        for value in weights:
            if value not in rows:
                raise UnknownNameError(f"value of {axis} in the exposure", value, rows)
        total = sum(weights.values())
        if not independent:
            lines.append(f"Weighted by {axis}: not told, as predictions share draws (frames of a drive do).")
            continue
        sure = 1.0 - 0.05 / len(weights)
        mean = low = high = 0.0
        for value, weight in weights.items():
            row, part = rows[value], weight / total
            ends = clopper_pearson(row.right, row.total, sure)
            mean, low, high = mean + part * row.right / row.total, low + part * ends[0], high + part * ends[1]
        shares = ", ".join(f"{value} {percent(weight / total)}" for value, weight in weights.items())
        lines.append(
            f"Weighted by {axis} ({shares}): right in {percent(mean)}, 95 % interval {interval_text((low, high))}."
        )
    return lines


def domain_of(result: Result, settings: Mapping[str, object], searched: Sequence[str]) -> dict[str, str]:
    """Return what an operational design domain consists of, in words: within what each part of it varied, or what it
    was."""
    things = str(settings.get("things") or "")
    fixed = {
        "place": str(getattr(result, "environment", "") or settings.get("environment") or ""),
        "road users and things": "; ".join(filter(None, [str(getattr(result, "object", "") or ""), things])),
        "camera and picture": str(settings.get("camera") or ""),
    }
    drives = getattr(result, "drives", None) or []
    moving = [*getattr(result, "controls", ()), *getattr(result, "over", ())]
    found = {}
    for part, names in DOMAIN.items():
        varied = [one for one in searched if _first_word(one) in names]
        if not varied:  # one of several that a sentence is about
            varied = [one for one in moving if _first_word(one) in names]
        if part == "ways and speeds":
            varied += [f"{one.drives} drives of {one.seconds:g} s, {one.frames} frames each" for one in drives[:1]]
        alone = f"not varied: {fixed[part]}" if fixed.get(part) else "not varied"
        found[part] = "; ".join(varied) or alone
    if not found["place"].startswith("not varied"):
        for part in ("light", "weather"):
            found[part] = found[part].replace("not varied", "as each environment has it")
    return found


def _first_word(line: str) -> str:
    match = re.match(r"\w+", line)
    return match[0] if match else ""


def not_shown(domain: Mapping[str, str], photographs: int, *, weighted: bool = False) -> list[str]:
    """Return what a reader must not take from a run; `weighted` where shares are weighted by how common values are."""
    still = [part for part, text in domain.items() if text.startswith("not varied")]
    compared = f"Only {photographs} photographs were compared with renderings" if photographs else "No photograph was"
    return [
        f"{compared}{'' if photographs else ' compared with renderings'}: all else is about renderings.",
        *([f"Nothing is said of other values of: {', '.join(still)}."] if still else []),
        "How common the conditions are is what the weights say, of their axes alone."
        if weighted
        else "Nothing is said of how common the conditions are: no weights were given.",
    ]


def pictures_of(run: Path) -> list[Path]:
    """Return the pictures of a run that say most of what it found."""
    names = ("drive", "clean", "adversarial", "worst", "sweep")
    there = [run / "images" / f"{name}.png" for name in names]
    return [one for one in there if one.is_file() and not one.is_symlink()][:3]
