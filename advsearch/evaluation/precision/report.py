"""The report of `advsearch precision`: points, slopes, references, warnings and recommendations as plain data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from advsearch.evaluation.precision.fits import (
    Against,
    RoundUp,
    Theory,
    confirmed,
    fit,
    recommend,
    warning_of,
)
from advsearch.evaluation.precision.image import OIDN
from advsearch.evaluation.precision.objective import PolicyCurve, missing, sooner
from advsearch.evaluation.precision.points import MeasuredSetting, Point, ReferenceValue
from advsearch.files import Json
from advsearch.runs.results.precision import (
    NotMeasured,
    PrecisionPoint,
    PrecisionReference,
    PrecisionResult,
    PrecisionSlope,
    Recommended,
)
from advsearch.scene.mitsuba_backend.samplers import next_count

Line = tuple[str, str, str]
AGAINST: tuple[Against, ...] = ("samples", "seconds")
FAMILIES = {"raw": "without denoiser", "oidn": "with denoiser", "depth": "by path depth"}


@dataclass
class Section:
    """What was measured so far.

    Attributes:
        sampler: of the run's pixels, which gradients are taken with.
        points: of each line and measure.
        theories: of each line.
        families: of each line of the image: what it is recommended among.
        again: points of settings that were recommended, from measurements after that.
        references: as the report holds them.
        curves: of each policy.
        start: verified objective before any search.
        left_out: settings that did not fit into the time.
        warnings: sentences.
        interrupted: whether the user stopped it.
    """

    sampler: str
    points: dict[tuple[Line, str], list[Point]] = field(default_factory=dict)
    theories: dict[Line, Theory] = field(default_factory=dict)
    families: dict[Line, str] = field(default_factory=dict)
    again: dict[tuple[Line, str], Point] = field(default_factory=dict)
    references: list[PrecisionReference] = field(default_factory=list)
    curves: list[tuple[MeasuredSetting, PolicyCurve]] = field(default_factory=list)
    start: float = math.nan
    left_out: tuple[MeasuredSetting, ...] = ()
    warnings: list[str] = field(default_factory=list)
    interrupted: bool = False

    def add(self, line: Line, points: Sequence[Point], theory: Theory) -> None:
        """Keep the points of one line, all of one measure."""
        self.points[line, points[0].measure] = sorted(points, key=lambda point: point.setting.spp)
        self.theories[line] = theory

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


def report_of(head: Json, section: Section, goal: float, seconds: Mapping[str, float]) -> PrecisionResult:
    """Return the report: what was asked for (`head`), what was measured and what follows from it; no figures yet."""
    slopes = _slopes(section)
    for slope in slopes:
        line = (slope.quantity, slope.control or "", slope.estimator)
        said = warning_of(slope, section.points[line, slope.measure])
        section.warnings += [said] if said else []
    return PrecisionResult(
        **head,
        goal=goal,
        points=_points(section),
        slopes=slopes,
        references=section.references,
        recommendations=_recommended(section, goal) + _policy(section, goal),
        warnings=section.warnings + (["interrupted: only a part was measured"] if section.interrupted else []),
        left_out=[NotMeasured(**_place(one), reason="did not fit into the time") for one in section.left_out],
        seconds=dict(seconds),
        interrupted=section.interrupted,
        figures=[],
    )


# ---- inside ---------------------------------------------------------------------------------------------------------


def _slopes(section: Section) -> list[PrecisionSlope]:
    found = []
    for (line, _), points in section.points.items():
        for against in AGAINST:
            slope = fit(points, against, section.theories[line])
            if slope is not None:
                found.append(slope)
    return found


def _points(section: Section) -> list[PrecisionPoint]:
    """One entry a setting; the margin's error stands beside the picture's."""
    found: dict[tuple[Line, int], Json] = {}
    for (line, measure), points in section.points.items():
        for point in points:
            entry = found.setdefault((line, point.setting.spp), _place(point.setting))
            own = measure.removesuffix("error")  # "margin_", or nothing
            entry |= {measure: point.error, f"{own}interval": point.interval, f"{own}known": point.known}
            entry[f"{own}reference_error"] = point.floor
            entry |= {"seconds": point.seconds, "repeats": point.repeats, **point.more}
            if line in section.families:
                entry["family"] = section.families[line]
    return [*map(PrecisionPoint.of, found.values()), *_objective_points(section)]


def _objective_points(section: Section) -> list[PrecisionPoint]:
    best = _best(section)
    found = []
    for setting, curve in section.curves:
        shares = missing(curve, best, section.start)
        for renders, seconds, (low, middle, high), share in zip(
            curve.renders, curve.seconds, curve.objective, shares, strict=True
        ):
            place = {**_place(setting), "renders": renders, "seconds": seconds, "repeats": curve.repeats}
            found.append(PrecisionPoint(**place, error=share, objective=middle, quartiles=(low, high)))
    return found


def _best(section: Section) -> float:
    """The best median of any policy."""
    tops = [middle for _, curve in section.curves for _, middle, _ in curve.objective]
    return max((value for value in tops if math.isfinite(value)), default=math.nan)


def _place(setting: MeasuredSetting) -> Json:
    place = {"quantity": setting.quantity, "estimator": setting.series, "spp": setting.spp}
    return {**place, "control": setting.control or None}


def _recommended(section: Section, goal: float) -> list[Recommended]:
    """For each thing that can be asked for: the setting that reaches the goal soonest, if any does."""
    asked: dict[tuple[str, str, str, str], dict[Line, Sequence[Point]]] = {}
    for (line, measure), points in section.points.items():
        family = section.families.get(line, "")
        if measure == "margin_error" and family == "depth":
            continue
        asked.setdefault((line[0], line[1], measure, family), {})[line] = points
    found = []
    for (quantity, control, measure, family), lines in asked.items():
        round_up = rounding(section, quantity)
        one = recommend(lines, goal, round_up)
        if one is None:
            one = Recommended(quantity=quantity, control=control or None, measure=measure, among=None, estimator=None)
        again = section.again.get(((quantity, control, one.estimator or ""), measure))
        if again is not None:
            one = confirmed(one, again, round_up)
        found.append(one.model_copy(update={"among": FAMILIES.get(family)}))
    return found


def rounding(section: Section, quantity: str) -> RoundUp:
    """A line of the picture is named after its sampler; one of a gradient has that of the run."""
    return lambda series, samples: next_count(
        section.sampler if quantity == "gradient" else series.removesuffix(OIDN), samples
    )


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
