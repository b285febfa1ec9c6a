"""The report of `advsearch precision`: points, slopes, references, warnings and recommendations as plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from advsearch.questions.precision.answer import (
    NotMeasured,
    PrecisionPoint,
    PrecisionReference,
    PrecisionResult,
    Recommended,
    SettingPlace,
    busy,
)
from advsearch.questions.precision.benches import OIDN, PREDICTED, PolicyCurve, missing, sooner
from advsearch.questions.precision.gradient import COUNTS_OF, SURFACE_LIGHT
from advsearch.questions.precision.points import (
    Against,
    MeasuredSetting,
    Point,
    ReferenceValue,
    RoundUp,
    Theory,
    confirm_recommendation,
    fit_line,
    recommend,
    warning_of,
)
from advsearch.scene.formation import next_count

TableLine = tuple[str, str, str]
AGAINST: tuple[Against, ...] = ("samples", "seconds")
FAMILIES = {"raw": "without denoiser", "oidn": "with denoiser", "depth": "by path depth", PREDICTED: "predicted"}


@dataclass
class MeasuredLine:
    """What was measured of one line of a diagram (quantity, control, series), in one measure, by rising samples.

    Attributes:
        theory: what its slope should be.
        family: of a line of the image: what it is recommended among.
        again: the setting that was recommended, from measurements after that.
    """

    line: TableLine
    measure: str
    points: list[Point]
    theory: Theory
    family: str = ""
    again: Point | None = None


@dataclass
class Section:
    """What was measured: of one part of the work, or of several. `sampler` is that of the run's pixels, which gradients
    are taken with, and `start` the verified objective before any search."""

    sampler: str
    lines: list[MeasuredLine] = field(default_factory=list)
    references: list[PrecisionReference] = field(default_factory=list)
    curves: list[tuple[MeasuredSetting, PolicyCurve]] = field(default_factory=list)
    start: float = math.nan
    left_out: tuple[MeasuredSetting, ...] = ()
    warnings: list[str] = field(default_factory=list)

    def extend(self, more: Section) -> None:
        """Add what was measured in another part of the work."""
        self.lines += more.lines
        self.references += more.references
        self.curves += more.curves
        self.start = self.start if math.isnan(more.start) else more.start
        self.left_out += more.left_out
        self.warnings += more.warnings

    def recommended(self, quantity: str, control: str, goal: float) -> Recommended | None:
        """Return the setting that reaches a goal soonest, by what was measured so far."""
        found = (one for one in _recommended(self, goal) if (one.quantity, one.control) == (quantity, control or None))
        return next((one for one in found if one.estimator is not None), None)

    def refer(
        self,
        quantity: str,
        name: str,
        control: str,
        one: ReferenceValue,
        spp: int,
        margin: ReferenceValue | None = None,
    ) -> None:
        """Keep what a reference is, and how far off it may be."""
        self.references.append(
            PrecisionReference(
                quantity=quantity,
                reference=name,
                error=one.error,
                parts=one.parts,
                spp=spp * one.parts,
                control=control or None,
                margin=None if margin is None else float(margin.value[0]),
                margin_error=None if margin is None else margin.error,
            )
        )


def report_of(section: Section, goal: float, **asked: Any) -> PrecisionResult:
    """Return the report: what was measured, what follows from it, and what was asked for; no figures yet."""
    slopes, warnings = [], list(section.warnings)
    for one in section.lines:
        for against in AGAINST:
            if (slope := fit_line(one.points, against, one.theory)) is not None:
                slopes.append(slope)
                warnings += filter(None, [warning_of(slope, one.points)])
    points = _points(section)
    warnings += filter(None, [busy(points), _heavy(points)])
    return PrecisionResult(
        **asked,
        goal=goal,
        points=points,
        slopes=slopes,
        references=section.references,
        recommendations=_recommended(section, goal) + _policy(section, goal),
        warnings=warnings,
        left_out=[NotMeasured(**vars(_place(one)), reason="did not fit into the time") for one in section.left_out],
        figures=[],
    )


def _heavy(points: Sequence[PrecisionPoint]) -> str | None:
    names = sorted({one.estimator for one in points if one.heavy_tailed})
    if not names:
        return None
    return (
        f"{', '.join(names)}: a few pixels hold most of the error (fireflies), so that repeats say too little and it "
        "has no interval; a denoiser or more `rounds` help"
    )


def _points(section: Section) -> list[PrecisionPoint]:
    """One entry a setting; the margin's error stands beside the picture's."""
    found: dict[tuple[TableLine, int], dict[str, Point]] = {}
    families = {one.line: one.family for one in section.lines if one.family}
    for one in section.lines:
        for point in one.points:
            found.setdefault((one.line, point.setting.spp), {})[one.measure] = point
    points = [_together(by_measure, families.get(line)) for (line, _), by_measure in found.items()]
    return [*points, *_objective_points(section)]


def _together(by_measure: Mapping[str, Point], family: str | None) -> PrecisionPoint:
    """The entry of a setting: its error, and the margin's where that was measured too."""
    point, margin, last = by_measure["error"], by_measure.get("margin_error"), [*by_measure.values()][-1]
    return PrecisionPoint(
        **vars(_place(point.setting)),
        error=point.error,
        interval=None if point.heavy else point.interval,
        heavy_tailed=point.heavy or None,
        known=point.known,
        reference_error=point.floor,
        margin_error=None if margin is None else margin.error,
        margin_interval=None if margin is None else margin.interval,
        margin_known=None if margin is None else margin.known,
        margin_reference_error=None if margin is None else margin.floor,
        seconds=last.seconds,
        wall_seconds=last.more.get("wall_seconds"),
        repeats=last.repeats,
        cosine=last.more.get("cosine"),
        later_seconds=last.more.get("later_seconds"),
        family=family,
    )


def _objective_points(section: Section) -> list[PrecisionPoint]:
    best = _best(section)
    return [
        PrecisionPoint(
            **vars(_place(setting)),
            renders=renders,
            seconds=seconds,
            repeats=curve.repeats,
            error=share,
            objective=middle,
            quartiles=(low, high),
        )
        for setting, curve in section.curves
        for renders, seconds, (low, middle, high), share in zip(
            curve.renders, curve.seconds, curve.objective, missing(curve, best, section.start), strict=True
        )
    ]


def _best(section: Section) -> float:
    tops = [middle for _, curve in section.curves for _, middle, _ in curve.objective]
    return max((value for value in tops if math.isfinite(value)), default=math.nan)


def _place(setting: MeasuredSetting) -> SettingPlace:
    return SettingPlace(
        quantity=setting.quantity, estimator=setting.series, spp=setting.spp, control=setting.control or None
    )


def _recommended(section: Section, goal: float) -> list[Recommended]:
    """For each thing that can be asked for: the setting that reaches the goal soonest, if any does."""
    asked: dict[tuple[str, str, str, str], dict[TableLine, MeasuredLine]] = {}
    for each in section.lines:
        if each.measure == "margin_error" and each.family == "depth":
            continue
        asked.setdefault((*each.line[:2], each.measure, each.family), {})[each.line] = each
    found = []
    for (quantity, control, measure, family), lines in asked.items():
        round_up = rounding(section, quantity)
        theories = {line: each.theory for line, each in lines.items()}
        one = recommend({line: each.points for line, each in lines.items()}, goal, round_up, theories)
        if one is None:
            one = Recommended(quantity=quantity, control=control or None, measure=measure, among=None, estimator=None)
        chosen = lines.get((quantity, control, one.estimator or ""))
        if chosen is not None and chosen.again is not None:
            one = confirm_recommendation(one, chosen.again, round_up)
        found.append(one.model_copy(update={"among": FAMILIES.get(family)}))
    return found


def rounding(section: Section, quantity: str) -> RoundUp:
    """A line of the picture is named after its sampler; one of a gradient has that of the run. Light on surfaces has
    one count."""

    def up(series: str, samples: float) -> int:
        if series == SURFACE_LIGHT:
            return COUNTS_OF[SURFACE_LIGHT][0]
        return next_count(section.sampler if quantity == "gradient" else series.removesuffix(OIDN), samples)

    return up


def _policy(section: Section, goal: float) -> list[Recommended]:
    if not section.curves:
        return []
    found = sooner([curve for _, curve in section.curves], goal, _best(section), section.start)
    policy, renders, seconds = found or (None, None, None)
    return [
        Recommended(
            quantity="objective",
            control=None,
            measure="error",
            among=None,
            estimator=policy,
            goal=goal if found else None,
            renders=renders,
            seconds=seconds,
            basis="measured" if found else None,
        )
    ]
