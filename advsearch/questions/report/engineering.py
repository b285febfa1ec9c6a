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
from advsearch.questions.sweep.summary import AxisRow, AxisValue, SweepSummary
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

Exposure = Mapping[str, Mapping[str, float]]  # how common the values of axes are: weights by axis and value


def conditions_of(result: Result) -> list[ConditionShare]:
    """Return the share of right predictions by each value of each axis of a sweep."""
    rows = result.axes if isinstance(result, SweepSummary) else ()
    return [
        _condition(row, row.correct, row.configurations, row.interval)
        for row in rows
        if row.configurations and row.interval is not None
    ]


def photograph_conditions(result: Result, photographs: Iterable[Row]) -> list[ConditionShare]:
    """Return the share of photographs that agree with the rendering that they were aligned with, by each value of each
    axis of a sweep: right in both or wrong in both."""
    rows, conditions = list(photographs), list[ConditionShare]()
    for at in result.axes if isinstance(result, SweepSummary) else ():
        agree = []
        for row in rows:
            kept: Any = row.payload
            if at.axis in row.values and _has(row.values[at.axis]["value"], at.value):
                agree.append(bool(row.correct) == bool(kept["photo"]["right"]))
        if agree:
            conditions.append(_condition(at, sum(agree), len(agree), clopper_pearson(sum(agree), len(agree))))
    return conditions


def _condition(row: AxisRow, right: int, total: int, interval: Interval) -> ConditionShare:
    value, unit = _value(row.value), "" if row.unit == "1" else row.unit
    name = f"{row.axis} {value} {unit}".strip()
    return ConditionShare(condition=name, axis=row.axis, value=value, right=right, total=total, interval=interval)


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
    rules, lines = result.rules if isinstance(result, ExplainResult) else [], []
    for number, rule in enumerate(rules, start=1):
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
    extents = [claim.extent for claim in claims if claim.extent is not None]
    lines = [
        f"At least {percent(criterion)}: {met(criterion, extent.interval)} by {extent.count} of {extent.total} "
        f"{extent.what}, 95 % interval {interval_text(extent.interval)}."
        for extent in extents
        if "right" in extent.what or "held-out" in extent.what
    ]
    short = [row.condition for row in conditions if met(criterion, row.interval) == "not met"]
    return lines + ([f"Not met where: {', '.join(short)}."] if short else [])


def read_exposure(path: str) -> dict[str, dict[str, float]]:
    """Return what a YAML file says of how common values are, such as ``environment: {street: 0.8, street-wet: 0.2}``;
    an InputError where it is missing, or says something else."""
    exposure: dict[str, dict[str, float]] = {}
    for axis, weights in read_yaml(path).items():
        if not isinstance(weights, Mapping) or not weights:
            raise InputError(f"exposure: {path}: {axis}: expected values with a weight each, such as {{street: 0.8}}")
        for value, weight in weights.items():
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not 0.0 <= weight <= 1e9:
                raise InputError(f"exposure: {path}: {axis}: {value}: expected a number of at least 0, got {weight!r}")
        exposure[str(axis)] = {str(value): float(weight) for value, weight in weights.items()}
        if sum(exposure[str(axis)].values()) <= 0.0:
            raise InputError(f"exposure: {path}: {axis}: expected a weight over 0")
    return exposure


def exposure_lines(result: Result, conditions: Sequence[ConditionShare], exposure: Exposure) -> list[str]:
    """Return the share of right predictions where the values of an axis are as common as weights say: the weighted mean
    of the shares, between those of the ends of intervals that hold together (Bonferroni)."""
    lines = []
    independent = isinstance(result, SweepSummary) and result.units is None
    for axis, weights in exposure.items():
        rows = {row.value: row for row in conditions if row.axis == axis}
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
    """Return what an operational design domain consists of, in words: within what each part varied, or what it was."""
    things = str(settings.get("things") or "")
    fixed = {
        "place": str(getattr(result, "environment", "") or settings.get("environment") or ""),
        "road users and things": "; ".join(filter(None, [str(getattr(result, "object", "") or ""), things])),
        "camera and picture": str(settings.get("camera") or ""),
    }
    drives = getattr(result, "drives", None) or []
    moving = [*getattr(result, "controls", ()), *getattr(result, "over", ())]
    domain = {}

    def beginning(lines: Sequence[str], names: Sequence[str]) -> list[str]:
        return [line for line in lines if (word := re.match(r"\w+", line)) and word[0] in names]

    for part, names in DOMAIN.items():
        varied = beginning(searched, names) or beginning(moving, names)  # one of several that a sentence is about
        if part == "ways and speeds":
            varied += [f"{each.drives} drives of {each.seconds:g} s, {each.frames} frames each" for each in drives[:1]]
        alone = f"not varied: {fixed[part]}" if fixed.get(part) else "not varied"
        domain[part] = "; ".join(varied) or alone
    if not domain["place"].startswith("not varied"):
        for part in ("light", "weather"):
            domain[part] = domain[part].replace("not varied", "as each environment has it")
    return domain


def not_shown(domain: Mapping[str, str], photographs: int, *, weighted: bool = False) -> list[str]:
    """Return what a reader must not take from a run; `weighted` where shares are weighted by how common values are."""
    still = [part for part, text in domain.items() if text.startswith("not varied")]
    compared = f"Only {photographs} photographs were" if photographs else "No photograph was"
    return [
        f"{compared} compared with renderings: all else is about renderings.",
        *([f"Nothing is said of other values of: {', '.join(still)}."] if still else []),
        "How common the conditions are is what the weights say, of their axes alone."
        if weighted
        else "Nothing is said of how common the conditions are: no weights were given.",
    ]


def pictures_of(run: Path) -> list[Path]:
    """Return the pictures of a run that say most of what it found."""
    names = ("drive", "clean", "adversarial", "worst", "sweep")
    files = [run / "images" / f"{name}.png" for name in names]
    return [file for file in files if file.is_file() and not file.is_symlink()][:3]
