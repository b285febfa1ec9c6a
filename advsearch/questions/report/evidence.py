"""Runs as evidence: claims, subject, what varied, how it was measured, what is
excluded.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard, cast

from advsearch.extend import (
    InputError,
    Store,
    __version__,
    directory,
    errors,
    read_result,
    results,
    settings,
    statistics,
    stored_files,
    views,
    wording,
    workbench,
)
from advsearch.questions.report.recorded import (
    CLAIM_KIND,
    RecordedSettings,
    collect_settings,
    collect_versions,
    find_read_attacks,
    find_read_sweeps,
    join_setting_values,
    read_noted_settings,
    read_run_settings,
)
from advsearch.questions.report.result import ConditionShare, Evidence, EvidenceRun

DRIVES_PART = "ways and speeds"
THINGS_PART = "road users and things"
CAMERA_PART = "camera and picture"
DOMAIN = {
    "place": ("environment", "background"),
    "light": ("light", "sky", "exposure", "shadow", "projector", "spot"),
    "weather": ("haze",),
    THINGS_PART: (
        "object",
        "answer",
        "things",
        "pose",
        "body",
        "occlusion",
        "contents",
    ),
    "surfaces": ("texture", "material", "patch", "geometry", "ground"),
    DRIVES_PART: ("path",),
    CAMERA_PART: ("camera", "lens", "sensor", "corruption"),
}
"""The parts of an operational design domain: for each its axes and controls."""
# for axes and controls that belong to no other part
OTHER = "other"

# how common values are in use: weights by axis and value
Exposure = Mapping[str, Mapping[str, float]]


def is_attack(result: results.Result) -> TypeGuard[workbench.AttackSummary]:
    """Return whether a result is that of a single attack, not of a study of several."""
    return isinstance(result, workbench.get_experiment("attack").result)


def is_sweep(result: results.Result) -> TypeGuard[workbench.SweepSummary]:
    """Return whether a result is that of a sweep."""
    return isinstance(result, workbench.get_experiment("sweep").result)


def make_empty_claim(reason: str) -> views.Claim:
    """Return the claim of a run that has no claims, with the reason."""
    return views.Claim(
        kind="nothing claimed", statement=f"Nothing is claimed: {reason}.", extent=None
    )


# the interval of a fraction if nothing is known about it
UNKNOWN_FRACTION = (0.0, 1.0)


def count_conditions(
    result: results.Result, photographs: Sequence[Any] | None = None
) -> list[ConditionShare]:
    """Count right predictions by each value of each axis of a sweep.

    With rows of photographs, the photographs are counted that agree with their
    rendering instead: the model is right about both or wrong about both. Values without
    any counts are left out. Results of other commands than `sweep` have no axes, so the
    list is empty.

    Args:
        result: result of the run.
        photographs: rows of the photographs of the run; None counts the renderings.
    """
    if not is_sweep(result):
        return []
    conditions = []
    for row in result.axes:
        if photographs is None:
            condition = _count_renderings(row)
        else:
            condition = _count_photographs(row, photographs)
        if condition.total:
            conditions.append(condition)
    return conditions


def _count_renderings(row: Any) -> ConditionShare:
    """Count right predictions about renderings with one value of an axis."""
    # A single image has no interval, so nothing is known of the fraction.
    interval = row.interval or UNKNOWN_FRACTION
    return _make_condition(row, row.correct, row.configurations, interval)


def _count_photographs(row: Any, photographs: Sequence[Any]) -> ConditionShare:
    """Count photographs with one value of an axis that agree with their rendering."""
    n_agreeing, total = _count_agreeing(photographs, row.axis, row.value)
    interval = UNKNOWN_FRACTION
    if total:
        interval = statistics.intervals.clopper_pearson(n_agreeing, total)
    return _make_condition(row, n_agreeing, total, interval)


def _make_condition(
    row: Any, right: int, total: int, interval: results.Interval
) -> ConditionShare:
    """Return the count of right predictions for one value of an axis.

    Args:
        row: row of a sweep's result about this value.
        right: number of right predictions, or of photographs that agree.
        total: number of predictions or photographs.
        interval: 95 % interval of the fraction.
    """
    bounds = row.value if isinstance(row.value, tuple) else (row.value,)
    value = " to ".join(map(wording.format_number, bounds))
    unit = "" if row.unit == "1" else row.unit  # "1": a number without a unit
    return ConditionShare(
        condition=f"{row.axis} {value} {unit}".strip(),
        axis=row.axis,
        value=value,
        right=right,
        total=total,
        interval=interval,
    )


def _count_agreeing(
    photographs: Sequence[Any], axis: str, value: workbench.AxisValue
) -> tuple[int, int]:
    """Count photographs under a condition: those that agree, and all.

    A photograph agrees if the model is right about it and about its rendering, or wrong
    about both.

    Args:
        photographs: rows of the photographs.
        axis: name of a parameter of the rendering.
        value: value of the parameter in the renderings to count.
    """
    agrees = []
    for photo in photographs:
        if axis in photo.values and _has_value(photo.values[axis]["value"], value):
            # `correct` is about the photograph. The payload has what is stored about
            # its rendering.
            rendering = cast(Any, photo.payload)["photo"]
            rendering_is_right = bool(rendering["right"])
            agrees.append(bool(photo.correct) == rendering_is_right)
    return sum(agrees), len(agrees)


def _has_value(value: float | str, axis_value: workbench.AxisValue) -> bool:
    """Return whether a value is that of an axis, or in its range, ends included."""
    if isinstance(value, str) or isinstance(axis_value, str):
        return value == axis_value
    if isinstance(axis_value, tuple):
        lower, upper = axis_value
        return lower <= value <= upper
    return math.isclose(value, axis_value)


def list_triggering_conditions(result: results.Result) -> list[str]:
    """Return the rules, if any, under which the model is wrong more often."""
    triggering = workbench.get_experiment(result.command).triggering
    return [] if triggering is None else list(triggering(result))


def evaluate_criterion(criterion: float, interval: results.Interval) -> str:
    """Compare the interval of a fraction with a criterion.

    Returns:
        "met" if the interval is above the criterion, "not met" if it is below, else
        "open".
    """
    lower, upper = interval
    if lower >= criterion:
        return "met"
    return "not met" if upper < criterion else "open"


def find_selected_axes(result: results.Result) -> list[str]:
    """Return the axes of a sweep that have several selected values.

    Selected values are not sampled, so that a fraction over them depends on the
    selection. Models and adversarial scenes (axis "answer") are no conditions, and are
    left out.
    """
    if not is_sweep(result):
        return []
    # `drawn` are the sampled parameters.
    no_conditions = {"model", "answer", *result.drawn}
    n_values = Counter(row.axis for row in result.axes)
    return [
        axis
        for axis, count in n_values.items()
        if count > 1 and axis not in no_conditions
    ]


def describe_criterion(
    claims: Sequence[views.Claim],
    conditions: Sequence[ConditionShare],
    criterion: float,
    selected_axes: Sequence[str] = (),
) -> list[str]:
    """Describe whether a criterion is met: a minimum fraction of right predictions.

    If the user selected the values of an axis, each condition is evaluated separately,
    since a fraction over all conditions would depend on the selection. Otherwise, or if
    there are no conditions, each claimed fraction of right predictions is evaluated. In
    either case, the conditions in which the criterion is not met are listed.

    Args:
        claims: claims of the run.
        conditions: fraction of right predictions under each condition, such as
            "weather: rain".
        criterion: the minimum fraction.
        selected_axes: names of axes whose values the user selected.
    """
    verdict_of_condition = {
        row.condition: evaluate_criterion(criterion, row.interval) for row in conditions
    }
    listed_verdicts = ["not met"]
    if selected_axes:
        # Each condition is evaluated, also those whose interval contains the criterion.
        listed_verdicts.append("open")
    if selected_axes and conditions:
        lines = [_count_verdicts(verdict_of_condition, criterion, selected_axes)]
    else:
        lines = _describe_criterion_of_claims(claims, criterion, selected_axes)
    return lines + _list_by_verdict(verdict_of_condition, listed_verdicts)


def _list_by_verdict(
    verdict_of_condition: Mapping[str, str], listed_verdicts: Sequence[str]
) -> list[str]:
    """Return a sentence for each verdict that some conditions have, with their names.

    Args:
        verdict_of_condition: "met", "not met" or "open" for each condition.
        listed_verdicts: the verdicts to list.
    """
    lines = []
    for listed in listed_verdicts:
        names = [
            condition
            for condition, verdict in verdict_of_condition.items()
            if verdict == listed
        ]
        if names:
            lines.append(f"{listed.capitalize()} where: {', '.join(names)}.")
    return lines


def _count_verdicts(
    verdict_of_condition: Mapping[str, str],
    criterion: float,
    selected_axes: Sequence[str],
) -> str:
    """Describe in how many conditions a criterion is met, not met, or open.

    Args:
        verdict_of_condition: "met", "not met" or "open" for each condition.
        criterion: minimum fraction of right predictions.
        selected_axes: names of axes whose values the user selected.
    """
    counts = Counter(verdict_of_condition.values())
    return (
        f"At least {wording.percent(criterion)}, each condition by its own 95 % "
        f"interval: met in {counts['met']}, "
        f"not met in {counts['not met']} and open in {counts['open']} of "
        f"{len(verdict_of_condition)}. There is no verdict over "
        f"all: the values of {', '.join(selected_axes)} were chosen."
    )


def _describe_criterion_of_claims(
    claims: Sequence[views.Claim], criterion: float, selected_axes: Sequence[str]
) -> list[str]:
    """Describe for each claimed fraction of right predictions if a criterion is met.

    Args:
        claims: claims of the run.
        criterion: minimum fraction of right predictions.
        selected_axes: names of axes whose values the user selected.
    """
    remark = ""
    if selected_axes:
        remark = (
            f" Over the values of {', '.join(selected_axes)} that were chosen: others "
            "give another share."
        )
    # `extent` has the counted numbers of a claim; None if it counts nothing. A
    # criterion is about right predictions, not about failures.
    return [
        f"{_describe_claim_verdict(claim.extent, criterion)}{remark}"
        for claim in claims
        if claim.extent is not None and claim.extent.counts_right
    ]


def _describe_claim_verdict(extent: results.Extent, criterion: float) -> str:
    """Describe whether a claimed fraction of right predictions meets a criterion."""
    verdict = evaluate_criterion(criterion, extent.interval)
    return (
        f"At least {wording.percent(criterion)}: "
        f"{verdict} by {extent.count} of {extent.total} {extent.what}, "
        f"95 % interval {wording.format_interval(extent.interval)}."
    )


def read_exposure(path: str) -> dict[str, dict[str, float]]:
    """Read how common the values of each axis are in use, from a YAML file.

    For example, ``environment: {street: 0.8, wet: 0.2}``. Weights need not add up to 1.

    Raises:
        InputError: if the YAML file is missing, or has no weights.
    """
    exposure: dict[str, dict[str, float]] = {}
    for axis, weights in settings.read_yaml(path).items():
        where = f"exposure: {path}: {axis}"
        exposure[str(axis)] = _read_axis_weights(weights, where)
        if sum(exposure[str(axis)].values()) <= 0.0:
            raise InputError(f"{where}: expected a weight over 0")
    return exposure


def _read_axis_weights(weights: object, where: str) -> dict[str, float]:
    """Return the weights of the values of one axis.

    Args:
        weights: the weights as the YAML file states them.
        where: file and axis, for messages.

    Raises:
        InputError: they are no values with a weight each.
    """
    if not isinstance(weights, Mapping) or not weights:
        raise InputError(
            f"{where}: expected values with a weight each, such as {{street: 0.8}}"
        )
    for value, weight in weights.items():
        if not _is_weight(weight):
            raise InputError(
                f"{where}: {value}: expected a number of at least 0, got {weight!r}"
            )
    return {str(value): float(weight) for value, weight in weights.items()}


def _is_weight(value: Any) -> bool:
    """Return whether a value read from YAML is a weight: a number of 0 to 1e9.

    Booleans are numbers in Python, but no weights.
    """
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and bool(0.0 <= value <= 1e9)


DEPENDENT_PREDICTIONS = (
    "Weighted by {axis}: not computed, as predictions are not independent (frames of a "
    "drive are not)."
)


def describe_exposure(
    result: results.Result, conditions: Sequence[ConditionShare], exposure: Exposure
) -> list[str]:
    """Describe the fraction of right predictions weighted by how common values are.

    For each axis this is the mean of the fractions of its values, weighted by the
    exposure. Each fraction has an interval, and all intervals hold jointly
    (Bonferroni). The bounds of the weighted mean are the weighted means of their lower
    and upper bounds. If predictions are not independent, a sentence states that.

    Args:
        result: result of the run.
        conditions: fraction of right predictions for each value of each axis.
        exposure: weights by axis and value: how common each value is in use.

    Raises:
        UnknownNameError: an axis does not have a value that the exposure weights.
    """
    lines = []
    # The intervals need independent predictions. Frames of a drive are not independent,
    # and results other than sweeps may have selected their images.
    is_independent = is_sweep(result) and result.units is None
    for axis, weights in exposure.items():
        # The keys are values as text.
        rows = {row.value: row for row in conditions if row.axis == axis}
        if not rows:
            # The run does not vary this axis.
            continue
        _check_weighted_values(axis, weights, rows)
        if is_independent:
            lines.append(_describe_weighted(axis, rows, weights))
        else:
            lines.append(DEPENDENT_PREDICTIONS.format(axis=axis))
    return lines


def _check_weighted_values(
    axis: str, weights: Mapping[str, float], rows: Mapping[str, ConditionShare]
) -> None:
    """Raise an error if the exposure weights a value that an axis does not have."""
    for value in weights:
        if value not in rows:
            raise errors.UnknownNameError(
                f"value of {axis} in the exposure", value, rows
            )


def _describe_weighted(
    axis: str, rows: Mapping[str, ConditionShare], weights: Mapping[str, float]
) -> str:
    """Describe the weighted fraction of right predictions over the values of an axis.

    Args:
        axis: name of the axis.
        rows: counts of right predictions by value.
        weights: weights by value; they need not add up to 1.
    """
    mean, lower, upper = _compute_weighted_mean(rows, weights)
    total = sum(weights.values())
    fractions = ", ".join(
        f"{value} {wording.percent(weight / total)}"
        for value, weight in weights.items()
    )
    return (
        f"Weighted by {axis} ({fractions}): right in {wording.percent(mean)}, "
        f"95 % interval {wording.format_interval((lower, upper))}."
    )


def _compute_weighted_mean(
    rows: Mapping[str, ConditionShare], weights: Mapping[str, float]
) -> tuple[float, float, float]:
    """Return the weighted mean of the fractions of right predictions, with its bounds.

    The mean is sum(weight * fraction) / sum(weight). Each of the k fractions has an
    interval with confidence 1 - 0.05 / k, so that all intervals hold jointly with 95 %
    (Bonferroni). The lower bound of the mean is the weighted mean of their lower
    bounds; the upper bound likewise.

    Args:
        rows: counts of right predictions by the value of an axis.
        weights: weights by value; they need not add up to 1.

    Returns:
        Mean, lower and upper bound.
    """
    total = sum(weights.values())
    confidence = 1.0 - 0.05 / len(weights)
    mean = 0.0
    lower = 0.0
    upper = 0.0
    for value, weight in weights.items():
        row = rows[value]
        fraction = weight / total
        lower_bound, upper_bound = statistics.intervals.clopper_pearson(
            row.right, row.total, confidence
        )
        mean = mean + fraction * row.right / row.total
        lower = lower + fraction * lower_bound
        upper = upper + fraction * upper_bound
    return mean, lower, upper


class Variation(Enum):
    """Whether a part of an operational design domain varied; the value is a text."""

    VARIED = ""
    WITH_ENVIRONMENT = "as each environment has it"
    FIXED = "not varied"


class DomainPart(NamedTuple):
    """Whether a part of an operational design domain varied, and a description."""

    variation: Variation
    description: str

    @property
    def text(self) -> str:
        """The description with the variation before it."""
        return ": ".join(filter(None, (self.variation.value, self.description)))


def describe_domain(
    result: results.Result,
    recorded: Sequence[RecordedSettings],
    searched: Sequence[str],
) -> dict[str, DomainPart]:
    """Describe an operational design domain: what varied, and what was fixed.

    An operational design domain lists the conditions that a system is made for, in
    parts such as "place", "light" and "weather". A part varied if one of the sentences
    in `searched` is about it, or else if a control of the run belongs to it, or if the
    run is over drives. If the place varied, fixed light and weather are described as
    those of each environment. What belongs to no part is under `OTHER`, if there is
    anything.

    Args:
        result: result of the run.
        recorded: settings that the run recorded.
        searched: sentences about what varied, from `describe_searched`.
    """
    fixed = _describe_fixed(result, recorded)
    domain = dict[str, DomainPart]()
    for part in (*DOMAIN, OTHER):
        varied = _list_varied(part, result, searched)
        fixed_text = "; ".join(filter(None, fixed[part]))
        if varied:
            domain[part] = DomainPart(Variation.VARIED, "; ".join(varied))
        elif part != OTHER or fixed_text:
            domain[part] = DomainPart(Variation.FIXED, fixed_text)
    if domain["place"].variation is Variation.VARIED:
        for part in ("light", "weather"):
            domain[part] = _tie_to_environment(domain[part])
    return domain


def _tie_to_environment(part: DomainPart) -> DomainPart:
    """Return a fixed part as one that each environment has; a varied part as it is."""
    if part.variation is Variation.FIXED:
        return DomainPart(Variation.WITH_ENVIRONMENT, part.description)
    return part


def _list_varied(
    part: str, result: results.Result, searched: Sequence[str]
) -> list[str]:
    """Return what varied in a part of the domain: sentences, or names of controls.

    Args:
        part: name of the part.
        result: result of the run.
        searched: sentences about what varied.
    """
    varied = [line for line in searched if find_domain_part(line) == part]
    if not varied:
        # `over` are the controls that vary at random in an attack. Not every result has
        # these fields.
        controls = [*getattr(result, "controls", ()), *getattr(result, "over", ())]
        varied = [name for name in controls if find_domain_part(name) == part]
    if part == DRIVES_PART:
        varied += _describe_drives(result)
    return varied


def _describe_drives(result: results.Result) -> list[str]:
    """Describe how many drives a sweep was over; empty if it was over none.

    A sweep has a row about drives for each model. All models have the same drives, so
    the first row is used.
    """
    rows = getattr(result, "drives", None) or []
    return [
        f"{row.drives} drives of {row.seconds:g} s, {row.frames} frames each"
        for row in rows[:1]
    ]


def _describe_fixed(
    result: results.Result, recorded: Sequence[RecordedSettings]
) -> dict[str, list[str]]:
    """Return texts about what is fixed in a run, by the part of the design domain.

    Args:
        result: result of the run.
        recorded: settings that the run recorded; its own come first, then those of runs
            that it is based on.
    """
    fixed = defaultdict[str, list[str]](list)
    environment = getattr(result, "environment", "") or join_setting_values(
        recorded, "environment"
    )
    fixed["place"].append(str(environment))
    object_name = str(getattr(result, "object", "") or "")
    things = (object_name, join_setting_values(recorded, "things"))
    fixed[THINGS_PART].append("; ".join(filter(None, things)))
    fixed[CAMERA_PART].append(join_setting_values(recorded, "camera"))
    fixed[CAMERA_PART].append(join_setting_values(recorded, "backdrop"))
    for name, value in _list_fixed_parameters(recorded):
        fixed[find_domain_part(name)].append(f"{name} {value}")
    return fixed


def _list_fixed_parameters(
    recorded: Sequence[RecordedSettings],
) -> list[tuple[str, str]]:
    """Return the parameters that settings fix, as (name, value), each pair once."""
    # The setting `set` has fixed values of parameters by name. The keys of this dict
    # are a set that keeps the order, so that each pair is listed once.
    parameters = dict[tuple[str, str], None]()
    for run_settings in recorded:
        fixed_values = run_settings.values.get("set")
        if isinstance(fixed_values, Mapping):
            for name, value in fixed_values.items():
                parameters[str(name), str(value)] = None
    return list(parameters)


def find_domain_part(name: str) -> str:
    """Return the part of a domain that an axis, a control or a parameter belongs to.

    The first word decides, for example "camera" in ``camera.azimuth``. So a sentence
    that begins with such a name may be passed, too. `OTHER` if no part has it.
    """
    first_word = re.match(r"\w+", name)
    if first_word is not None:
        for part, axes_and_controls in DOMAIN.items():
            if first_word[0] in axes_and_controls:
                return part
    return OTHER


# names of images in a run, those that show most of its result first
PICTURES = ("drive", "clean", "adversarial", "worst", "sweep")

RULES = (
    "Each claim is about the run's own model, object, environment, label and settings, "
    "and about nothing else.",
    "`found`: fresh renders confirm a configuration that a search found; how many "
    "others there are is unknown.",
    "`not found`: a search with the stated number of renders found none; another "
    "policy or more renders may find one.",
    "`measured`: a fraction of what was counted; its interval has 95 % confidence "
    "(Clopper-Pearson's; where predictions "
    "share a draw, as frames of a drive do, one over draws, by bets) and holds for the "
    "distribution that was drawn "
    "from.",
    "`nothing claimed`: the run does not carry a claim, for the reason that it gives.",
    "Renderings are not photographs: a claim is about reality only as far as "
    "photographs were compared.",
)

QUICK = (
    "Made by a quick recipe: few and small pictures, to see what comes out; no result."
)


def collect_claims(result: results.Result) -> list[views.Claim]:
    """Return the claims of a run; if it has none, a claim that states the reason."""
    if result.is_unfinished:
        return [make_empty_claim(_explain_unfinished(result))]
    # the function of the command's experiment that makes claims of a result
    make_claims = workbench.get_experiment(result.command).claims
    if not make_claims:
        return [
            make_empty_claim(
                f"the command {result.command} does not measure how often a model is "
                "right"
            )
        ]
    return list(make_claims(result)) or [
        make_empty_claim("nothing in this run came to its end")
    ]


def _explain_unfinished(result: results.Result) -> str:
    """Return why an unfinished run has no claims, with its outcome so far."""
    is_running = getattr(result, "ending", "") == results.RUNNING
    reason = "the run is running" if is_running else "the run is not finished"
    if result.outcome_summary:
        reason += f"; so far: {result.outcome_summary}"
    return reason


def list_photograph_claims(photos: Any) -> list[views.Claim]:
    """Return the claim about photographs; empty if there are none.

    Args:
        photos: table of agreement from `advsearch.photo_agreement`.
    """
    if not photos.photos or photos.interval is None:
        return []
    agreeing = photos.right_right + photos.wrong_wrong
    extent = results.Extent.from_count(
        "photographs that agree", agreeing, photos.photos, photos.interval
    )
    statement = (
        "Photographs and renderings agree (both right, or both wrong) in "
        f"{wording.format_extent(extent)}. "
        "The interval takes photographs as independent."
    )
    return [views.Claim(kind="measured", statement=statement, extent=extent)]


def warn_of_different_models(
    models: Sequence[str], digests: Sequence[str]
) -> list[str]:
    """Return warnings if several runs are of different models.

    Args:
        models: name of the model of each run.
        digests: digests of the model's files of each run, as a text; empty if not
            recorded.
    """
    warnings = []
    names = sorted(set(models))
    if len(names) > 1:
        warnings.append(
            f"The runs are of different models: {', '.join(names)}. "
            "A claim about one is none about another."
        )
    digests_of_model = _group_digests(models, digests)
    for name in names:
        n_versions = len(digests_of_model[name])
        if n_versions > 1:
            warnings.append(
                f"{name}: its file was not the same in all runs, so that "
                f"they are of {n_versions} models."
            )
    return warnings


def _group_digests(
    models: Sequence[str], digests: Sequence[str]
) -> Mapping[str, set[str]]:
    """Return the recorded digests of each model; none for a model without any."""
    digests_of_model = defaultdict[str, set[str]](set)
    for model, digest in zip(models, digests, strict=True):
        if digest:
            digests_of_model[model].add(digest)
    return digests_of_model


NOT_NOTED = "not noted"
# name of the environment of a scene with lights of its own
NO_ENVIRONMENT_MAP = "none"
NO_CLAIM = (
    "The run carries no claim; it is listed so that the list of runs is complete."
)
NO_RESULT = "the run has no result yet: it is still working, or was stopped"
WEIGHTED = (
    "How common the conditions are is stated by the weights, for their axes only."
)
NOT_WEIGHTED = (
    "Nothing is stated about how common the conditions are: no weights were given."
)


def describe_run(
    name: str,
    result: results.Result,
    claims: Sequence[views.Claim],
    recorded: Sequence[RecordedSettings],
    versions: Mapping[str, str],
) -> EvidenceRun:
    """Return a run with what a reader needs to evaluate its claims.

    Args:
        name: name of the run.
        result: its result.
        claims: its claims.
        recorded: settings that the run recorded; its own come first, then those of runs
            that it is based on.
        versions: versions of packages and digests of files that the run recorded, by
            name.
    """
    run_settings = recorded[0].values if recorded else {}
    values = _get_fields(result)
    return EvidenceRun(
        run=name,
        command=result.command,
        ending=str(values.get("ending") or "done"),
        claims=list(claims),
        about=_describe_subject(result, recorded),
        searched=describe_searched(result, run_settings),
        method=_describe_measurement(result, run_settings, recorded),
        excluded=_describe_excluded(result, claims),
        settings=_list_setting_texts(recorded),
        cost=_describe_cost(values),
        made_with=dict(versions) or {"versions and files": NOT_NOTED},
        command_line=str(values.get("command_line") or ""),
    )


def _list_setting_texts(recorded: Sequence[RecordedSettings]) -> dict[str, str]:
    """Return all recorded settings that have an effect as text, by name."""
    setting_texts = dict[str, str]()
    for source_settings in recorded:
        setting_texts |= source_settings.as_text()
    return setting_texts


def _describe_cost(values: Mapping[str, Any]) -> dict[str, str]:
    """Describe how many renders a run took, and how long.

    Args:
        values: fields of its result by name.
    """
    seconds = values.get("seconds") or {}
    return {
        "Renders": _format_renders(values.get("renders")),
        "Time": wording.format_seconds(seconds.get("total")),
    }


def _get_fields(result: results.Result) -> dict[str, Any]:
    """Return the fields of a result by name, without its properties."""
    return {field: getattr(result, field) for field in type(result).model_fields}


def _format_renders(renders: int | Mapping[str, int] | None) -> str:
    """Format how many renders a run took.

    Results state a number, or a number for each purpose. A result without either was
    made from other runs.
    """
    if renders is None:
        return "those of its parts"
    if isinstance(renders, Mapping):
        counts = [
            f"{number} {purpose}" for purpose, number in renders.items() if number
        ]
        return ", ".join(counts) or "none"
    return str(renders)


def _describe_subject(
    result: results.Result, recorded: Sequence[RecordedSettings]
) -> dict[str, str]:
    """Return object, environment, model, task and right labels as text, by name.

    Unknown values are left out.

    Args:
        result: result of the run.
        recorded: settings that the run recorded; its own come first, then those of runs
            that it is based on.
    """
    values = _get_fields(result)
    objects = values.get("object") or ", ".join(values.get("objects") or ())
    subject = {
        "Object": str(objects or ""),
        "Environment": _describe_environment(result),
        "Model": str(values.get("model") or ""),
        "Names of its classes": join_setting_values(recorded, "labels"),
        "Prompt": join_setting_values(recorded, "prompt"),
        "Range of its input": join_setting_values(recorded, "value_range"),
        "Task": str(values.get("task") or ""),
        "Judged thing": join_setting_values(recorded, "judge"),
        "Counts as right": _describe_right_labels(values, recorded),
        "Sought": str(values.get("goal") or ""),
    }
    return {name: text for name, text in subject.items() if text}


def _describe_right_labels(
    values: Mapping[str, Any], recorded: Sequence[RecordedSettings]
) -> Any:
    """Return the names that count as right, as a text.

    Args:
        values: fields of the result by name.
        recorded: settings that the run recorded.
    """
    # a list from the result, or a text from settings
    right_labels = values.get("label_set") or join_setting_values(
        recorded, "label", otherwise="the object's own label"
    )
    if isinstance(right_labels, list):
        return ", ".join(right_labels)
    return right_labels


def _describe_environment(result: results.Result) -> str:
    """Return the environment of a result; empty if it has none.

    If a control varied the environment, the text states that.
    """
    values = _get_fields(result)
    environment = str(values.get("environment") or "")
    varied_controls = set[str]()
    for field in ("over", "controls"):
        for name in values.get(field) or ():
            # the kind of the control, which is "environment" in "environment:names"
            varied_controls.add(name.partition(":")[0])
    # The control "sky" replaces the environment, too.
    is_varied = bool({"environment", "sky"} & varied_controls)
    if not environment or not is_varied:
        return environment
    if is_attack(result):
        return f"varied, see below; the clean scene has {environment}"
    return f"{environment}, varied"


def describe_searched(
    result: results.Result, run_settings: Mapping[str, object]
) -> list[str]:
    """Describe what varied in a run: parameters with ranges, and controls.

    A control is described by the ranges that the settings state. If they state none,
    and no other sentence is about the control, it varied over its default ranges.

    Args:
        result: result of the run.
        run_settings: settings of the run.
    """
    lines = []
    if is_attack(result):
        lines += _describe_searched_by_attack(result)
    elif is_sweep(result):
        lines += _describe_searched_by_sweep(result)
    lines += _describe_controls(result, run_settings, lines)
    # An attack's own sentences state its budgets.
    if not is_attack(result):
        for name in ("epsilon", "epsilons"):
            if run_settings.get(name) is not None:
                lines.append(f"{name}: {json.dumps(run_settings[name])}")
    return lines


def _describe_controls(
    result: results.Result,
    run_settings: Mapping[str, object],
    other_lines: Sequence[str],
) -> list[str]:
    """Describe the controls with the ranges that the settings state, or the default.

    Args:
        result: result of the run.
        run_settings: settings of the run.
        other_lines: sentences about parameters. A control that they describe, and that
            has no stated ranges, is left out.
    """
    ranges_of_control = run_settings.get("controls")
    if not isinstance(ranges_of_control, Mapping):  # only names, without ranges
        ranges_of_control = {}
    lines = list[str]()
    for control in getattr(result, "controls", ()):
        ranges = ranges_of_control.get(control)
        # A sentence about a parameter begins with its name, as "pose.yaw".
        is_described = any(line.startswith(control) for line in (*other_lines, *lines))
        if ranges:
            lines.append(f"{control}, as set: {json.dumps(ranges, ensure_ascii=False)}")
        elif not is_described:
            lines.append(f"{control}: everything that it searches by default")
    return lines


def _describe_searched_by_attack(result: workbench.AttackSummary) -> list[str]:
    """Describe what an attack searched, and under which random conditions."""
    view = workbench.get_experiment(result.command).view
    changed_text = view(result).facts["changed"]  # for example "pose and texture"
    lines = [changed_text]
    # the searched parameters; only numbers have bounds
    for name, value in (result.configuration or {}).items():
        if value.low is not None and value.high is not None:
            lines.append(
                f"{name}: {value.low:.4g} to {value.high:.4g} {value.unit}".rstrip()
            )
    # controls that vary at random, and then the parameters of these with their ranges
    if result.over:
        lines.append(f"{' and '.join(result.over)}, drawn anew for every picture")
    for name, varied in result.conditions.items():
        lines.append(f"{name}: {_format_range(varied)}, by chance")
    return lines


def _describe_searched_by_sweep(result: workbench.SweepSummary) -> list[str]:
    """Describe the axes of a sweep, and what it sampled.

    Models and adversarial scenes are axes, too.
    """
    values_of_axis = dict[tuple[str, str], list[Any]]()
    # `drawn` are the sampled parameters.
    for row in result.axes:
        if row.axis not in result.drawn:
            values_of_axis.setdefault((row.axis, row.unit), []).append(row.value)
    lines = []
    for (axis, unit), values in values_of_axis.items():
        text = _format_axis_values(values)
        lines.append(f"{axis}: {text} {unit}".rstrip())
    for name, varied in result.drawn.items():
        lines.append(f"{name}: {_format_range(varied)}, drawn by chance")
    return lines


def _format_axis_values(values: Sequence[Any]) -> str:
    """Format the values of an axis; parts of a range as the full range."""
    if all(isinstance(value, tuple) for value in values):  # bounds of parts
        lower = min(low for low, _ in values)
        upper = max(high for _, high in values)
        return f"{lower:.4g} to {upper:.4g}"
    return ", ".join(map(wording.format_number, values))


def _format_range(varied: results.VariedValue) -> str:
    """Format the range of a sampled parameter, or its options."""
    if varied.low is None or varied.high is None:
        return " or ".join(varied.names or ["something"])
    unit = "" if varied.unit == "1" else varied.unit
    return f"{varied.low:.4g} to {varied.high:.4g} {unit}".rstrip()


def _describe_measurement(
    result: results.Result,
    run_settings: Mapping[str, object],
    recorded: Sequence[RecordedSettings],
) -> dict[str, str]:
    """Return how a run measured: policy, seed, samples and so on, as text by name.

    Values that the run does not have are left out.

    Args:
        result: result of the run.
        run_settings: settings of the run.
        recorded: all settings that the run recorded, also those of other runs.
    """
    values = _list_measurement_values(result, run_settings)
    # Settings that only name other runs have no task.
    tasks = [other.task for other in recorded if other.is_of_scene]
    values["Judged with"] = "; ".join(dict.fromkeys(tasks))
    texts = {
        name: str(value) for name, value in values.items() if value not in (None, "")
    }
    if is_attack(result) and result.verified is not None:
        texts["Verification"] = _describe_verification(result)
    formation = getattr(result, "image_formation", None)
    if formation:
        gains = getattr(result, "gains", None)
        texts["Pictures"] = wording.format_formation(formation, gains)
    return texts


def _list_measurement_values(
    result: results.Result, run_settings: Mapping[str, object]
) -> dict[str, object]:
    """Return how a run measured, by the headings under which a report lists it.

    A value that the run does not have is None.
    """
    # A sweep renders only its worst configuration again.
    trials_heading = (
        "Trials of the worst configuration" if is_sweep(result) else "Trials"
    )
    return {
        "Policy": getattr(result, "policy", None),
        "Objective": getattr(result, "objective", None),
        "Sampler": getattr(result, "sampler", None),
        "Steps": run_settings.get("steps"),
        "Seed": getattr(result, "seed", None),
        "Samples a pixel": getattr(result, "spp", None) or run_settings.get("spp"),
        trials_heading: run_settings.get("trials"),
    }


def _describe_verification(result: workbench.AttackSummary) -> str:
    """Describe how many fresh renders verify what an attack found.

    If conditions are sampled anew for each render, a render counts only if the model is
    right about the clean scene under the same conditions. The control (the clean scene)
    is rendered once for each of them, so that it has the number of all renders.
    """
    verified = result.verified
    assert verified is not None
    counts = f"{verified.trials} renders with fresh seeds"
    control = result.clean.control
    n_renders = control.trials if control is not None else verified.trials
    if result.over and n_renders > verified.trials:
        counts += f" that count, those of {n_renders} in which the clean scene is right"
    return f"{counts}, {verified.spp} samples a pixel"


def _describe_excluded(
    result: results.Result, claims: Sequence[views.Claim]
) -> list[str]:
    """Describe what was not varied, was rejected, or went wrong."""
    lines = [
        "Nothing varied but what stands under What varied, and the noise of the "
        "renders."
    ]
    if is_attack(result):
        lines += _describe_excluded_by_attack(result)
    if is_sweep(result):
        lines += _describe_excluded_by_sweep(result)
    if all(claim.kind == "nothing claimed" for claim in claims):
        lines.append(NO_CLAIM)
    return lines + list(getattr(result, "warnings", ()))


def _describe_excluded_by_sweep(result: workbench.SweepSummary) -> list[str]:
    """Describe predictions of a sweep that were not finite, and what it left out."""
    lines = []
    if result.not_finite:
        lines.append(
            f"{result.not_finite} predictions were not numbers; they count as "
            "not right."
        )
    if result.looked_at < result.planned:
        lines.append(
            f"Only {result.looked_at} of {result.planned} planned "
            "configurations were looked at."
        )
    return lines


def _describe_excluded_by_attack(result: workbench.AttackSummary) -> list[str]:
    """Describe cautions of an attack, values that were not finite, and adjustments of
    the clean scene.
    """
    lines = list(workbench.get_experiment(result.command).view(result).cautions)
    non_finite = result.non_finite
    if non_finite.objectives or non_finite.gradient_elements:
        lines.append(
            f"Not finite: {non_finite.objectives} objectives, "
            f"{non_finite.gradient_elements} numbers of gradients."
        )
    for adjusted in result.clean.moved:
        # The scene's own value, `scene`, is outside of the range of the control. So the
        # clean scene has the value `used`.
        used = f"{wording.format_number(adjusted.used)} {adjusted.unit}"
        lines.append(
            f"The clean scene has {adjusted.parameter} {used} in place of "
            f"{wording.format_number(adjusted.scene)}: the control leaves that out."
        )
    return lines


# maximum size of a picture that is copied, and maximum number of pictures of a run
MAX_PICTURE_BYTES = 16 << 20
MAX_PICTURES = 3


def collect_evidence(
    runs: list[str],
    *,
    criterion: float | None = None,
    exposure: Exposure | None = None,
    by: str = "",
    twins: str | None = None,
) -> tuple[Evidence, dict[str, bytes]]:
    """Return the claims of runs as evidence, and the pictures that it names.

    The pictures are PNG files as bytes, by name.

    Args:
        runs: names or directories of the runs.
        criterion: the required minimum fraction of right predictions; None for none.
        exposure: weights by axis and value, such as ``{"weather": {"rain": 0.2}}``: how
            common each value is in use.
        by: who is responsible for the evidence.
        twins: name or directory of a run of `advsearch twins`, which compares
            photographs with renders. None takes the runs that the settings of the runs
            name.
    """
    evidence_runs = list[EvidenceRun]()
    pictures = dict[str, bytes]()
    weights = exposure or {}
    for number, folder in enumerate(_list_folders(runs), 1):
        run_pictures = _read_pictures(folder, number)
        pictures |= run_pictures
        run = _make_evidence_run(folder, criterion, weights, twins)
        update = {"pictures": list(run_pictures), "started": _format_start(folder)}
        evidence_runs.append(run.model_copy(update=update))
    warnings = _compare_models(evidence_runs)
    warnings += _warn_of_unknown_axes(weights, evidence_runs)
    evidence = Evidence(
        runs=evidence_runs,
        warnings=warnings,
        rules=list(RULES),
        version=__version__,
        by=by,
        criterion=criterion,
        written=f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
    )
    return evidence, pictures


def _warn_of_unknown_axes(exposure: Exposure, runs: Sequence[EvidenceRun]) -> list[str]:
    """Return a warning for each weighted axis that no run has.

    A misspelled axis would otherwise be ignored silently.
    """
    known_axes = {row.axis for run in runs for row in run.conditions}
    return [
        f"exposure: no run has the axis {axis}."
        for axis in sorted(set(exposure) - known_axes)
    ]


def _list_folders(runs: Sequence[str]) -> list[Path]:
    """Return the directories of runs, each once; for a recipe, those of its parts."""
    # by the resolved path, so that two names of one directory count once
    folders = dict[Path, Path]()
    for folder in map(directory.find_run, runs):
        candidates = sorted((folder / directory.PARTS).glob("*"))
        parts = [part for part in candidates if directory.is_run(part)]
        if parts and read_run_settings(folder).get("command") == "recipe":
            folders |= {part.resolve(): part for part in parts}
        else:
            folders[folder.resolve()] = folder
    return list(folders.values())


def _read_pictures(folder: Path, number: int) -> dict[str, bytes]:
    """Read up to `MAX_PICTURES` pictures of a run, by their names in the evidence.

    Args:
        folder: folder of the run.
        number: number of the run, which makes the names of its pictures unique.
    """
    files = [folder / directory.IMAGES / f"{name}.png" for name in PICTURES]
    # A link may lead out of the run.
    files = [file for file in files if file.is_file() and not file.is_symlink()]
    return {
        f"pictures/{number}-{file.name}": stored_files.read_bytes(
            file, "a picture", MAX_PICTURE_BYTES
        )
        for file in files[:MAX_PICTURES]
    }


def _format_start(folder: Path) -> str:
    """Format when the settings of a run were written; empty if unknown."""
    with suppress(OSError):
        seconds = (folder / directory.CONFIG).stat().st_mtime
        return f"{datetime.fromtimestamp(seconds, timezone.utc):%Y-%m-%d %H:%M} UTC"
    return ""


def _compare_models(runs: Sequence[EvidenceRun]) -> list[str]:
    """Warn if runs are of different models.

    They are if the names differ, or the digests of the models' files. A digest is noted
    under the name of the model, or under the name of the file in "MODEL@FILE".
    """
    models = list[str]()
    digests = list[str]()
    for run in runs:
        model = run.about.get("Model")
        if not model:
            continue
        file_name = model.rpartition("@")[2]  # the full name without "@"
        digest_names = (model, file_name)
        # `made_with` has versions and digests by name.
        digest_texts = [
            text for name, text in run.made_with.items() if name in digest_names
        ]
        models.append(model)
        digests.append(" ".join(digest_texts))
    return warn_of_different_models(models, digests)


def _make_evidence_run(
    folder: Path, criterion: float | None, exposure: Exposure, twins: str | None
) -> EvidenceRun:
    """Return a run as evidence; without a summary it has not ended, and claims nothing.

    Args:
        folder: directory of the run.
        criterion: minimum fraction of right predictions; None for none.
        exposure: weights of values by axis: how common each value is in use.
        twins: a run that compares photographs with renders; None takes the one that the
            settings of this run name.
    """
    if not (folder / directory.summary.NAME).is_file():
        return _make_unfinished_run(folder)
    result = read_result(folder)
    claims_of_photographs, photo_rows = _read_photographs(folder)
    claims = [*collect_claims(result), *claims_of_photographs]
    recorded_settings, run = _describe_stored_run(folder, result, claims)

    sweeps = _read_sweeps(result)
    searched = _list_searched(folder, result, sweeps) or run.searched
    # A result that was made from sweeps is about their domain, which is the same for
    # all of them: so the first is described.
    domain = describe_domain(
        sweeps[0].result if sweeps else result, recorded_settings, searched
    )
    conditions = count_conditions(result)
    exposure_lines = describe_exposure(result, conditions, exposure)
    criterion_lines = list[str]()
    if criterion is not None:
        axes = _list_selected_axes(result, sweeps)
        criterion_lines = describe_criterion(claims, conditions, criterion, axes)
    further_values = {
        "searched": searched,
        "excluded": [*_list_quick_remarks(folder), *run.excluded],
        "criterion": criterion_lines,
        "triggering": list_triggering_conditions(result),
        "exposure": exposure_lines,
        "conditions": conditions,
        "photographs": count_conditions(result, photo_rows),
        "twins": _find_twins(folder, result, twins),
        **_describe_bounds(claims_of_photographs, domain, exposure_lines),
    }
    return run.model_copy(update=further_values)


def _describe_bounds(
    claims_of_photographs: Sequence[views.Claim],
    domain: Mapping[str, DomainPart],
    exposure_lines: Sequence[str],
) -> dict[str, object]:
    """Return the domain of a run, and what must not be concluded from it, as fields."""
    limitations = _describe_limits(
        claims_of_photographs, domain, is_weighted=bool(exposure_lines)
    )
    return {
        "domain": {name: part.text for name, part in domain.items()},
        "limitations": limitations,
    }


def _find_twins(
    folder: Path, result: results.Result, twins: str | None
) -> results.TwinEvidence | None:
    """Return how far a run's verdict holds for photographs; None if it is not stated.

    Args:
        folder: directory of the run.
        result: result of the run.
        twins: a run of twins; None takes the evidence that the result states.
    """
    stored: results.TwinEvidence | None = getattr(result, "twins", None)
    # The evidence is about a model, and some results are about none.
    if twins is None or not hasattr(result, "model"):
        return stored
    return workbench.find_twin_evidence(
        twins,
        model=str(getattr(result, "model", "")),
        task=str(getattr(result, "task", "classification")),
        object_name=str(getattr(result, "object", "")),
        environment=str(getattr(result, "environment", "")),
        in_photograph=bool(read_run_settings(folder).get("backdrop")),
    )


def _describe_stored_run(
    folder: Path, result: results.Result, claims: Sequence[views.Claim]
) -> tuple[list[RecordedSettings], EvidenceRun]:
    """Return the settings that a run recorded, and the run as evidence.

    The recorded settings are those of the run, then those of the claims that it tested,
    then those of the runs that it read (see `collect_settings`).

    Args:
        folder: directory of the run.
        result: result of the run.
        claims: claims of the run.
    """
    read_paths = [
        *find_read_sweeps(result),
        *find_read_attacks(read_run_settings(folder)),
    ]
    recorded = collect_settings(folder, result, read_paths)
    versions = _collect_versions(folder, result, read_paths)
    run = describe_run(
        directory.format_run_name(folder),
        result,
        claims=claims,
        recorded=recorded,
        versions=versions,
    )
    return recorded, run


def _collect_versions(
    folder: Path, result: results.Result, read_paths: Sequence[Path]
) -> dict[str, str]:
    """Return versions and digests of files, without an environment that is not used.

    The default environment may be noted although the scene has none.
    """
    versions = collect_versions(folder, read_paths)
    if getattr(result, "environment", "") == NO_ENVIRONMENT_MAP:
        versions.pop(f"bundled environment {workbench.DEFAULT_ENVIRONMENT}", None)
    return versions


class _ReadSweep(NamedTuple):
    """A sweep that another result was made from, with its settings."""

    result: results.Result
    settings: Mapping[str, Any]


def _read_sweeps(result: results.Result) -> list[_ReadSweep]:
    """Read the sweeps that a result was made from.

    The result is about what varied in them. Sweeps that cannot be read are left out.
    """
    sweeps = list[_ReadSweep]()
    for path in find_read_sweeps(result):
        with suppress(errors.AdvsearchError):
            sweeps.append(_ReadSweep(read_result(path), read_run_settings(path)))
    return sweeps


def _list_selected_axes(
    result: results.Result, sweeps: Sequence[_ReadSweep]
) -> list[str]:
    """Return the axes with selected values, of a run and of sweeps, each once."""
    axes = find_selected_axes(result)
    for sweep in sweeps:
        axes += find_selected_axes(sweep.result)
    return list(dict.fromkeys(axes))


def _make_unfinished_run(folder: Path) -> EvidenceRun:
    """Return a run without a summary as evidence, with the claim that nothing is
    claimed.
    """
    run_settings = read_run_settings(folder)
    subject = {
        "Object": str(run_settings.get("object") or ""),
        "Model": str(run_settings.get("model") or ""),
    }
    return EvidenceRun(
        run=directory.format_run_name(folder),
        command=str(run_settings.get("command") or "unknown"),
        ending="none yet",
        claims=[make_empty_claim(NO_RESULT)],
        about={name: text for name, text in subject.items() if text},
        searched=[],
        method={},
        excluded=[NO_CLAIM],
        cost={},
        made_with=collect_versions(folder, []) or {"versions and files": NOT_NOTED},
        settings=RecordedSettings(source="", values=run_settings).as_text(),
        command_line=f"advsearch run {folder / directory.CONFIG}",
    )


def _read_photographs(folder: Path) -> tuple[list[views.Claim], list[Any]]:
    """Return the claims and the rows of a run's photographs."""
    if not (folder / directory.PHOTOGRAPHS).is_dir():
        return [], []
    claims = list_photograph_claims(workbench.load_photographs().agreement(folder))
    with Store.open_to_read(folder) as store:
        rows = list(store.rows("photo")) if claims else []
    return claims, rows


def _list_searched(
    folder: Path, result: results.Result, sweeps: Sequence[_ReadSweep]
) -> list[str]:
    """Describe what varied in the claims that a suite tested, or in the sweeps that a
    result was made from; empty for any other run.
    """
    noted = read_noted_settings(folder, result)
    if noted is not None:  # the run is one of a suite
        return _describe_searched_by_claims(noted.get(CLAIM_KIND))
    lines = []
    for sweep in sweeps:
        lines += describe_searched(sweep.result, sweep.settings)
    return list(dict.fromkeys(lines))


def _list_quick_remarks(folder: Path) -> list[str]:
    """Return a remark if a run is a part of a quick recipe."""
    # The directory of a part is in the directory "parts" of the recipe's run.
    recipe_settings = read_run_settings(folder.resolve().parent.parent)
    is_recipe = recipe_settings.get("command") == "recipe"
    is_quick = is_recipe and recipe_settings.get("quick") is True
    return [QUICK] if is_quick else []


def _describe_limits(
    claims_of_photographs: Sequence[views.Claim],
    domain: Mapping[str, DomainPart],
    *,
    is_weighted: bool,
) -> list[str]:
    """Describe what a reader must not conclude from a run.

    Args:
        claims_of_photographs: claims that compare photographs with renderings.
        domain: what varied and what was fixed, by the part of the domain.
        is_weighted: whether fractions were weighted by exposure.
    """
    # Each claim counts pairs of a photograph and its rendering.
    n_compared = sum(
        claim.extent.total for claim in claims_of_photographs if claim.extent
    )
    photographed = "No photograph was"
    if n_compared:
        photographed = f"Only {n_compared} photographs were"
    lines = [f"{photographed} compared with renderings: all else is about renderings."]
    fixed = [name for name, part in domain.items() if part.variation is Variation.FIXED]
    if fixed:
        lines.append(f"Nothing is shown about other values of: {', '.join(fixed)}.")
    lines.append(WEIGHTED if is_weighted else NOT_WEIGHTED)
    return lines


def _describe_searched_by_claims(
    claims: Mapping[str, Mapping[str, Any]] | None,
) -> list[str]:
    """Describe what varied in the claims of a suite: a line for each control and range.

    Args:
        claims: the settings of each claim by its name; None if they cannot be read.
    """
    if claims is None:
        return ["what the claims of its suite state, which cannot be read any more"]
    names_of_line = defaultdict[str, list[str]](list)
    for name, claim_settings in claims.items():
        for line in _list_varied_by_claim(claim_settings):
            names_of_line[line].append(name)
    return [f"{line} ({', '.join(names)})" for line, names in names_of_line.items()]


def _list_varied_by_claim(claim_settings: Mapping[str, Any]) -> list[str]:
    """Describe what the settings of a claim vary: each control, and the environment."""
    controls = claim_settings.get("controls") or {}
    if not isinstance(controls, Mapping):  # names alone, separated by commas
        controls = dict.fromkeys(str(controls).split(","))
    lines = []
    for control, ranges in controls.items():
        text = "everything it searches by default"
        if ranges:
            text = json.dumps(ranges, ensure_ascii=False)
        lines.append(f"{control}: {text}")
    if claim_settings.get("environment"):
        lines.append(f"environment: {claim_settings['environment']}")
    return lines
