"""Runs as evidence: their claims, what they were about, what varied, how it was
measured, what is left out.
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
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard, cast

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
    CLAIM,
    RecordedSettings,
    attacks_read,
    made_with,
    noted_settings,
    own_settings,
    recorded_settings,
    stated,
    sweeps_read,
)
from advsearch.questions.report.result import ConditionShare, Evidence, EvidenceRun

if TYPE_CHECKING:
    from advsearch.extend import workbench

# ---------------------------------------------------------------------------------------------------------------------
# What an engineer reads of a run beside its claims: shares by condition, whether a
# criterion is met, how common conditions are, the operational design domain in words,
# and what is not shown.

DOMAIN = {
    "place": ("environment", "background"),
    "light": ("light", "sky", "exposure", "shadow", "projector", "spot"),
    "weather": ("haze",),
    "road users and things": (
        "object",
        "answer",
        "things",
        "pose",
        "body",
        "occlusion",
        "contents",
    ),
    "surfaces": ("texture", "material", "patch", "geometry", "ground"),
    "ways and speeds": ("path",),
    "camera and picture": ("camera", "lens", "sensor", "corruption"),
}
"""The parts of an operational design domain, and the axes and controls that each is
about.
"""
OTHER = "other"  # the part of what belongs to none of them

# how common the values of axes are: weights by axis and value
Exposure = Mapping[str, Mapping[str, float]]


def is_attack(result: results.Result) -> TypeGuard[workbench.AttackSummary]:
    """Whether a result is that of one attack, and not of a study of several."""
    return isinstance(result, workbench.get_experiment("attack").result)


def is_sweep(result: results.Result) -> TypeGuard[workbench.SweepSummary]:
    """Whether a result is that of a sweep."""
    return isinstance(result, workbench.get_experiment("sweep").result)


def nothing_claimed(why: str) -> views.Claim:
    return views.Claim(
        kind="nothing claimed", statement=f"Nothing is claimed: {why}.", extent=None
    )


def conditions_of(
    result: results.Result, photographs: Sequence[Any] | None = None
) -> list[ConditionShare]:
    """Return the share of right predictions by each value of each axis of a sweep; or
    that of its photographs which agree with the rendering that they were aligned with:
    right in both or wrong in both.
    """
    conditions = []
    for row in result.axes if is_sweep(result) else ():
        right = row.correct
        total = row.configurations
        # none of one draw
        interval: tuple[float, float] | None = row.interval or (0.0, 1.0)
        if photographs is not None:
            agree = [
                bool(photo.correct) == bool(cast(Any, photo.payload)["photo"]["right"])
                for photo in photographs
                if row.axis in photo.values
                and _has(photo.values[row.axis]["value"], row.value)
            ]
            right = sum(agree)
            total = len(agree)
            interval = (
                statistics.intervals.clopper_pearson(right, total) if total else None
            )
        if total and interval is not None:
            value = " to ".join(
                map(
                    wording.number_text,
                    row.value if isinstance(row.value, tuple) else (row.value,),
                )
            )
            unit = "" if row.unit == "1" else row.unit
            conditions.append(
                ConditionShare(
                    condition=f"{row.axis} {value} {unit}".strip(), axis=row.axis, value=value, right=right,
                    total=total, interval=interval,
                )
            )  # fmt: skip
    return conditions


def _has(value: float | str, of: workbench.AxisValue) -> bool:
    if isinstance(value, str) or isinstance(of, str):
        return value == of
    return of[0] <= value <= of[1] if isinstance(of, tuple) else math.isclose(value, of)


def triggering_conditions(result: results.Result) -> list[str]:
    triggering = workbench.get_experiment(result.command).triggering
    return [] if triggering is None else list(triggering(result))


def met(criterion: float, interval: results.Interval) -> str:
    """Return whether a share is surely at least as large as asked, surely not, or
    neither.
    """
    return (
        "met"
        if interval[0] >= criterion
        else "not met"
        if interval[1] < criterion
        else "open"
    )


def chosen_axes(result: results.Result) -> list[str]:
    """Return the axes of a sweep whose several values somebody chose: they are not
    drawn, so that a share over them is one of these values.
    """
    counts = Counter[str]()
    if is_sweep(result):
        counts.update(row.axis for row in result.axes if row.axis not in result.drawn)
    return [
        axis
        for axis, count in counts.items()
        if count > 1 and axis not in ("model", "answer")
    ]


def criterion_lines(
    claims: Sequence[views.Claim],
    conditions: Sequence[ConditionShare],
    criterion: float,
    chosen: Sequence[str] = (),
) -> list[str]:
    """Return what a criterion, that so large a share is right, comes to. A share of
    failures has none.

    Where the values of axes are `chosen`, each condition is judged by itself: a share
    over all of them would change with the choice. Without conditions, the share says
    that it is over these values.
    """
    lines = []
    if not (chosen and conditions):
        over = (
            (
                f" Over the values of {', '.join(chosen)} that were chosen: others "
                "give "
                "another share."
            )
            if chosen
            else ""
        )
        lines = [
            f"At least {wording.percent(criterion)}: {met(criterion, extent.interval)} "
            f"by {extent.count} of "
            f"{extent.total} {extent.what}, 95 % interval "
            f"{wording.interval_text(extent.interval)}.{over}"
            for extent in (claim.extent for claim in claims if claim.extent is not None)
            if "right" in extent.what or "held-out" in extent.what
        ]
    verdicts = {row.condition: met(criterion, row.interval) for row in conditions}
    if chosen and conditions:
        named = ", ".join(chosen)
        counts = Counter(verdicts.values())
        lines.append(
            f"At least {wording.percent(criterion)}, each condition by its own 95 % "
            f"interval: met in {counts['met']}, "
            f"not met in {counts['not met']} and open in {counts['open']} of "
            f"{len(verdicts)}. There is no verdict over "
            f"all: the values of {named} were chosen."
        )
    for verdict in ("not met", "open") if chosen else ("not met",):
        if where := [
            condition for condition, told in verdicts.items() if told == verdict
        ]:
            lines.append(f"{verdict.capitalize()} where: {', '.join(where)}.")
    return lines


def read_exposure(path: str) -> dict[str, dict[str, float]]:
    """Return what a YAML file says of how common values are, such as ``environment:
    {street: 0.8, street-wet: 0.2}``; an InputError where it is missing, or says
    something else.
    """
    exposure: dict[str, dict[str, float]] = {}
    for axis, weights in settings.read_yaml(path).items():
        if not isinstance(weights, Mapping) or not weights:
            raise InputError(
                f"exposure: {path}: {axis}: expected values with a weight "
                f"each, such as {{street: 0.8}}"
            )
        for value, weight in weights.items():
            if (
                isinstance(weight, bool)
                or not isinstance(weight, (int, float))
                or not 0.0 <= weight <= 1e9
            ):
                raise InputError(
                    f"exposure: {path}: {axis}: {value}: expected a "
                    f"number of at least 0, got {weight!r}"
                )
        exposure[str(axis)] = {
            str(value): float(weight) for value, weight in weights.items()
        }
        if sum(exposure[str(axis)].values()) <= 0.0:
            raise InputError(f"exposure: {path}: {axis}: expected a weight over 0")
    return exposure


def exposure_lines(
    result: results.Result, conditions: Sequence[ConditionShare], exposure: Exposure
) -> list[str]:
    """Return the share of right predictions where the values of an axis are as common
    as weights say: the weighted mean of the shares, between those of the ends of
    intervals that hold together (Bonferroni).
    """
    lines = []
    independent = is_sweep(result) and result.units is None
    for axis, weights in exposure.items():
        rows = {row.value: row for row in conditions if row.axis == axis}
        if not rows:
            continue
        for value in weights:
            if value not in rows:
                raise errors.UnknownNameError(
                    f"value of {axis} in the exposure", value, rows
                )
        total = sum(weights.values())
        if not independent:
            lines.append(
                f"Weighted by {axis}: not told, as predictions share draws "
                "(frames of a drive do)."
            )
            continue
        sure = 1.0 - 0.05 / len(weights)
        mean = low = high = 0.0
        for value, weight in weights.items():
            row = rows[value]
            part = weight / total
            ends = statistics.intervals.clopper_pearson(row.right, row.total, sure)
            mean = mean + part * row.right / row.total
            low = low + part * ends[0]
            high = high + part * ends[1]
        shares = ", ".join(
            f"{value} {wording.percent(weight / total)}"
            for value, weight in weights.items()
        )
        lines.append(
            f"Weighted by {axis} ({shares}): right in {wording.percent(mean)}, "
            f"95 % interval {wording.interval_text((low, high))}."
        )
    return lines


class Variation(Enum):
    """Whether a part of an operational design domain varied."""

    VARIED = ""
    WITH_PLACE = "as each environment has it"
    FIXED = "not varied"


class DomainPart(NamedTuple):
    """What a part of an operational design domain was, in words, and whether that
    varied.
    """

    variation: Variation
    description: str

    @property
    def text(self) -> str:
        return ": ".join(filter(None, (self.variation.value, self.description)))


def domain_of(
    result: results.Result,
    recorded: Sequence[RecordedSettings],
    searched: Sequence[str],
) -> dict[str, DomainPart]:
    """Return the parts of an operational design domain by name: within what each
    varied, or what it was.
    """
    fixed = defaultdict[str, list[str]](list)
    fixed["place"].append(
        str(getattr(result, "environment", "") or stated(recorded, "environment"))
    )
    things = filter(
        None, (str(getattr(result, "object", "") or ""), stated(recorded, "things"))
    )
    fixed["road users and things"].append("; ".join(things))
    fixed["camera and picture"].append(stated(recorded, "camera"))
    values = dict.fromkeys(
        (str(name), str(value))
        for settings in recorded
        if isinstance(given := settings.values.get("set"), Mapping)
        for name, value in given.items()
    )
    for name, value in values:
        fixed[part_of_domain(name)].append(f"{name} {value}")
    moving = [*getattr(result, "controls", ()), *getattr(result, "over", ())]
    domain = dict[str, DomainPart]()
    for part in (*DOMAIN, OTHER):
        varied = [line for line in searched if part_of_domain(line) == part]
        varied = varied or [name for name in moving if part_of_domain(name) == part]
        for drive in (
            (getattr(result, "drives", None) or [])[:1]
            if part == "ways and speeds"
            else ()
        ):
            varied.append(
                f"{drive.drives} drives of {drive.seconds:g} s, "
                f"{drive.frames} frames each"
            )
        was = "; ".join(filter(None, fixed[part]))
        if varied:
            domain[part] = DomainPart(Variation.VARIED, "; ".join(varied))
        elif part != OTHER or was:
            domain[part] = DomainPart(Variation.FIXED, was)
    if domain["place"].variation is Variation.VARIED:
        for part in ("light", "weather"):
            if domain[part].variation is Variation.FIXED:
                domain[part] = domain[part]._replace(variation=Variation.WITH_PLACE)
    return domain


def part_of_domain(name: str) -> str:
    """Return the part of a domain that an axis, a control or a parameter of a scene is
    about.
    """
    begins = re.match(r"\w+", name)
    for part, names in DOMAIN.items():
        if begins is not None and begins[0] in names:
            return part
    return OTHER


# of a run that say most of what it found, best first
PICTURES = ("drive", "clean", "adversarial", "worst", "sweep")

RULES = (
    "Each claim is about the run's own model, object, environment, label and settings, "
    "and about nothing else.",
    "`found`: fresh renders confirm a configuration that a search found; how many "
    "others there are is not known.",
    "`not found`: a search of so many renders found none; another policy or more "
    "renders may find one.",
    "`measured`: a share of what was counted; its interval has 95 % confidence "
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


def claims_of(result: results.Result) -> list[views.Claim]:
    if result.goes_on:
        state = (
            "is running"
            if getattr(result, "ending", "") == results.RUNNING
            else "is not finished"
        )
        return [
            nothing_claimed(
                f"the run {state}"
                + (f"; so far: {result.brief}" if result.brief else "")
            )
        ]
    if claims := workbench.get_experiment(result.command).claims:
        return list(claims(result)) or [
            nothing_claimed("nothing in this run came to its end")
        ]
    return [
        nothing_claimed(
            f"the command {result.command} does not measure how often a model is right"
        )
    ]


def photo_claims(photos: Any) -> list[views.Claim]:
    """Return the claim of a table of agreement (`advsearch.photo_agreement`); none
    where it is empty.
    """
    if not photos.photos or photos.interval is None:
        return []
    agreeing = photos.right_right + photos.wrong_wrong
    extent = results.Extent.from_count(
        "photographs that agree", agreeing, photos.photos, photos.interval
    )
    text = (
        "Photographs and renderings agree (both right, or both wrong) in "
        f"{wording.share_text(extent)}."
    )
    return [
        views.Claim(
            kind="measured",
            statement=f"{text} The interval takes photographs as independent.",
            extent=extent,
        )
    ]


def warnings_over(models: Sequence[str], digests: Sequence[str]) -> list[str]:
    """Return what has to be known of runs together, from their models and the digests
    of these files, a text a run.
    """
    warnings = []
    names = sorted(set(models))
    if len(names) > 1:
        different = f"The runs are of different models: {', '.join(names)}."
        warnings.append(f"{different} A claim about one is none about another.")
    for name in names:
        known = {
            text
            for model, text in zip(models, digests, strict=True)
            if model == name and text
        }
        if len(known) > 1:
            warnings.append(
                f"{name}: its file was not the same in all runs, so that "
                f"they are of {len(known)} models."
            )
    return warnings


NOT_NOTED = "not noted"
NO_MAP = "none"  # the environment of a scene that has lights of its own
NO_CLAIM = "The run carries no claim; it is listed so that it is not left out unseen."
WEIGHTED = "How common the conditions are is what the weights say, of their axes alone."
NOT_WEIGHTED = (
    "Nothing is said of how common the conditions are: no weights were given."
)


def evidence_of(
    name: str,
    result: results.Result,
    claims: Sequence[views.Claim],
    recorded: Sequence[RecordedSettings],
    made: Mapping[str, str],
) -> EvidenceRun:
    """Return a run with what a reader needs to judge its claims: the settings that it
    recorded, its own first, and versions and digests as it noted them.
    """
    settings = recorded[0].values if recorded else {}
    values = {field: getattr(result, field) for field in type(result).model_fields}
    objects = values.get("object") or ", ".join(values.get("objects") or ())
    right = values.get("label_set") or stated(
        recorded, "label", "the object's own label"
    )
    lit_by = str(values.get("environment") or "")
    moving = {
        name.partition(":")[0]
        for which in ("over", "controls")
        for name in values.get(which) or ()
    }
    if lit_by and {"environment", "sky"} & moving:
        attacked = is_attack(result)
        lit_by = (
            f"varied, see below; the clean scene has {lit_by}"
            if attacked
            else f"{lit_by}, varied"
        )
    about = {
        "Object": str(objects or ""),
        "Environment": lit_by,
        "Model": str(values.get("model") or ""),
        "Names of its classes": stated(recorded, "labels"),
        "Prompt": stated(recorded, "prompt"),
        "Range of its input": stated(recorded, "value_range"),
        "Task": str(values.get("task") or ""),
        "Judged thing": stated(recorded, "judge"),
        "Counts as right": ", ".join(right) if isinstance(right, list) else right,
        "Sought": str(values.get("goal") or ""),
    }
    renders = values.get("renders")
    seconds = values.get("seconds") or {}
    if isinstance(renders, Mapping):
        renders = (
            ", ".join(f"{number} {name}" for name, number in renders.items() if number)
            or "none"
        )
    return EvidenceRun(
        run=name, command=result.command, ending=str(values.get("ending") or "done"), claims=list(claims),
        about={key: text for key, text in about.items() if text}, searched=searched_lines(result, settings),
        measured=_measured(result, settings, recorded), excluded=_excluded(result, claims),
        settings={name: text for one in recorded for name, text in one.as_text().items()},
        cost={
            "Renders": "those of its parts" if renders is None else str(renders),
            "Time": wording.seconds_text(seconds.get("total")),
        },
        made_with=dict(made) or {"versions and files": NOT_NOTED}, command_line=str(values.get("command_line") or ""),
    )  # fmt: skip


def searched_lines(result: results.Result, settings: Mapping[str, object]) -> list[str]:
    lines = []
    if is_attack(result):
        lines.append(
            workbench.get_experiment(result.command).view(result).facts["changed"]
        )
        lines += [
            f"{name}: {found.low:.4g} to {found.high:.4g} {found.unit}".rstrip()
            for name, found in (result.configuration or {}).items()
            if found.low is not None and found.high is not None
        ]
        lines += (
            [f"{' and '.join(result.over)}, drawn anew for every picture"]
            if result.over
            else []
        )
        lines += [
            f"{name}: {_span(varied)}, by chance"
            for name, varied in result.conditions.items()
        ]
    elif is_sweep(result):
        axes = dict[tuple[str, str], list[Any]]()
        for row in result.axes:
            if row.axis not in result.drawn:
                axes.setdefault((row.axis, row.unit), []).append(row.value)
        for (axis, unit), values in axes.items():
            text = ", ".join(map(wording.number_text, values))
            if all(isinstance(value, tuple) for value in values):  # parts of one range
                text = (
                    f"{min(low for low, _ in values):.4g} to "
                    f"{max(high for _, high in values):.4g}"
                )
            lines.append(f"{axis}: {text} {unit}".rstrip())
        lines += [
            f"{name}: {_span(varied)}, drawn by chance"
            for name, varied in result.drawn.items()
        ]
    controls = settings.get("controls") or {}
    for control in getattr(result, "controls", ()):
        given = controls.get(control) if isinstance(controls, Mapping) else None
        if given:
            lines.append(f"{control}, as set: {json.dumps(given, ensure_ascii=False)}")
        elif not any(line.startswith((control, f"{control}.")) for line in lines):
            lines.append(f"{control}: everything that it searches by default")
    for name in () if is_attack(result) else ("epsilon", "epsilons"):
        if settings.get(name) is not None:
            lines.append(f"{name}: {json.dumps(settings[name])}")
    return lines


def _span(varied: results.VariedValue) -> str:
    if varied.low is None or varied.high is None:
        return " or ".join(varied.names or ["something"])
    return (
        f"{varied.low:.4g} to {varied.high:.4g} "
        f"{'' if varied.unit == '1' else varied.unit}"
    ).rstrip()


def _measured(
    result: results.Result,
    settings: Mapping[str, object],
    recorded: Sequence[RecordedSettings],
) -> dict[str, str]:
    tasks = [one.task for one in recorded if one.is_of_scene]
    trials = "Trials of the worst configuration" if is_sweep(result) else "Trials"
    facts = {
        "Policy": getattr(result, "policy", None),
        "Objective": getattr(result, "objective", None),
        "Sampler": getattr(result, "sampler", None),
        "Steps": settings.get("steps"),
        "Seed": getattr(result, "seed", None),
        "Samples a pixel": getattr(result, "spp", None) or settings.get("spp"),
        trials: settings.get("trials"),
        "Judged with": "; ".join(dict.fromkeys(tasks)),
    }
    named = {
        name: str(value) for name, value in facts.items() if value not in (None, "")
    }
    if is_attack(result) and result.verified is not None:
        rated = result.verified
        control = result.clean.control
        counting = f"{rated.trials} renders with fresh seeds"
        if result.over and control is not None and control.trials > rated.trials:
            counting += (
                f" that count, those of {control.trials} in which the clean "
                "scene is right"
            )
        named["Verification"] = f"{counting}, {rated.spp} samples a pixel"
    formation = getattr(result, "image_formation", None)
    gains = getattr(result, "gains", None)
    return (
        {**named, "Pictures": wording.formation_text(formation, gains)}
        if formation
        else named
    )


def _excluded(result: results.Result, claims: Sequence[views.Claim]) -> list[str]:
    lines = [
        "Nothing varied but what stands under What varied, and the noise of the "
        "renders."
    ]
    if is_attack(result):
        lines += workbench.get_experiment(result.command).view(result).cautions
        bad = result.non_finite
        if bad.objectives or bad.gradient_elements:
            lines.append(
                f"Not finite: {bad.objectives} objectives, "
                f"{bad.gradient_elements} numbers of gradients."
            )
        lines += [
            f"The clean scene has {moved.parameter} {wording.number_text(moved.used)} "
            f"{moved.unit} in place of "
            f"{wording.number_text(moved.scene)}: the control leaves that out."
            for moved in result.clean.moved
        ]
    if is_sweep(result) and result.not_finite:
        lines.append(
            f"{result.not_finite} predictions were not numbers; they count as "
            "not right."
        )
    if is_sweep(result) and result.looked_at < result.planned:
        lines.append(
            f"Only {result.looked_at} of {result.planned} planned "
            "configurations were looked at."
        )
    if all(claim.kind == "nothing claimed" for claim in claims):
        lines.append(NO_CLAIM)
    return lines + list(getattr(result, "warnings", ()))


MOST_OF_PICTURE = 16 << 20  # bytes of a picture that is taken along


def collected(
    runs: list[str],
    *,
    criterion: float | None = None,
    exposure: Exposure | None = None,
    by: str = "",
) -> tuple[Evidence, dict[str, bytes]]:
    """Return runs, by their names or folders, as evidence, with the pictures that it
    names; `criterion` is the share of right predictions that is asked for, `exposure`
    how common the values of axes are, and `by` who answers for it.
    """
    told = list[EvidenceRun]()
    pictures = dict[str, bytes]()
    folders = dict[Path, Path]()
    models = list[str]()
    digests = list[str]()
    for folder in map(directory.find_run, runs):
        parts = [
            part
            for part in sorted((folder / directory.PARTS).glob("*"))
            if directory.is_run(part)
        ]
        # the runs that it consists of
        of_recipe = parts and own_settings(folder).get("command") == "recipe"
        folders |= {part.resolve(): part for part in (parts if of_recipe else [folder])}
    for number, folder in enumerate(folders.values(), 1):
        files = [folder / directory.IMAGES / f"{name}.png" for name in PICTURES]
        files = [file for file in files if file.is_file() and not file.is_symlink()][:3]
        own = {
            f"pictures/{number}-{file.name}": stored_files.read_bytes(
                file, "a picture", MOST_OF_PICTURE
            )
            for file in files
        }
        pictures |= own
        run = _run(folder, criterion, exposure or {})
        begun = ""
        with suppress(OSError):  # when its settings were written
            written = datetime.fromtimestamp(
                (folder / directory.CONFIG).stat().st_mtime, timezone.utc
            )
            begun = f"{written:%Y-%m-%d %H:%M} UTC"
        told.append(run.model_copy(update={"pictures": list(own), "begun": begun}))
        if model := run.about.get("Model"):
            of_model = model, model.rpartition("@")[2]
            models.append(model)
            digests.append(
                " ".join(
                    text for name, text in run.made_with.items() if name in of_model
                )
            )
    unused = set(exposure or {}) - {row.axis for run in told for row in run.conditions}
    warnings = [
        *warnings_over(models, digests),
        *(f"exposure: no run has the axis {axis}." for axis in sorted(unused)),
    ]
    evidence = Evidence(
        runs=told, warnings=warnings, rules=list(RULES), version=__version__, by=by, criterion=criterion,
        written=f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
    )  # fmt: skip
    return evidence, pictures


def _run(folder: Path, criterion: float | None, exposure: Exposure) -> EvidenceRun:
    """One run; of one that has no summary, that it claims nothing."""
    settings = own_settings(folder)
    if not (folder / directory.summary.NAME).is_file():
        facts = {
            "Object": str(settings.get("object") or ""),
            "Model": str(settings.get("model") or ""),
        }
        return EvidenceRun(
            run=directory.typed_name(folder), command=str(settings.get("command") or "unknown"), ending="none yet",
            claims=[nothing_claimed("the run has no result yet: it is still working, "
                                    "or was stopped")],
            about={key: text for key, text in facts.items() if text}, searched=[], measured={}, excluded=[NO_CLAIM],
            cost={}, made_with=made_with(folder, []) or {"versions and files": NOT_NOTED},
            settings=RecordedSettings("", settings).as_text(),
            command_line=f"advsearch run {folder / directory.CONFIG}",
        )  # fmt: skip
    result = read_result(folder)
    photographs = list[views.Claim]()
    rows = list[Any]()
    if (folder / directory.PHOTOGRAPHS).is_dir():
        from advsearch.extend import workbench  # it brings torch, which takes a second

        photographs = photo_claims(workbench.load_photographs().agreement(folder))
        with Store.open_to_read(folder) as store:
            rows = list(store.rows("photo")) if photographs else []
    claims = [*claims_of(result), *photographs]
    sweeps = sweeps_read(result)
    read = [*sweeps, *attacks_read(settings)]
    recorded = recorded_settings(folder, result, read)
    made = made_with(folder, read)
    if getattr(result, "environment", "") == NO_MAP:
        from advsearch.extend import workbench  # it brings torch, which takes a second

        made.pop(f"bundled environment {workbench.DEFAULT_ENVIRONMENT}", None)
    run = evidence_of(directory.typed_name(folder), result, claims, recorded, made)
    outer = own_settings(folder.resolve().parent.parent)
    few = (
        [QUICK]
        if outer.get("command") == "recipe" and outer.get("quick") is True
        else []
    )
    basis = []  # the sweeps whose rows it reads: it is about what varied there
    for path in sweeps:
        with suppress(errors.AdvsearchError):
            basis.append((read_result(path), own_settings(path)))
    searched = list(
        dict.fromkeys(line for one in basis for line in searched_lines(*one))
    )
    if (noted_parts := noted_settings(folder, result)) is not None:
        searched = _searched_by_claims(noted_parts.get(CLAIM))
    searched = searched or run.searched
    domain = domain_of(basis[0][0] if basis else result, recorded, searched)
    chosen = list(
        dict.fromkeys(
            axis
            for one in (result, *(swept for swept, _ in basis))
            for axis in chosen_axes(one)
        )
    )
    conditions = conditions_of(result)
    weighted = exposure_lines(result, conditions, exposure)
    compared = sum(claim.extent.total for claim in photographs if claim.extent)
    photographed = (
        f"Only {compared} photographs were" if compared else "No photograph was"
    )
    not_shown = [
        f"{photographed} compared with renderings: all else is about renderings."
    ]
    if still := [
        name for name, part in domain.items() if part.variation is Variation.FIXED
    ]:
        not_shown.append(f"Nothing is said of other values of: {', '.join(still)}.")
    not_shown.append(WEIGHTED if weighted else NOT_WEIGHTED)
    more = {
        "searched": searched,
        "excluded": [*few, *run.excluded],
        "criterion": []
        if criterion is None
        else criterion_lines(claims, conditions, criterion, chosen),
        "triggering": triggering_conditions(result),
        "exposure": weighted,
        "conditions": conditions,
        "photographs": conditions_of(result, rows),
        "domain": {name: part.text for name, part in domain.items()},
        "not_shown": not_shown,
    }
    return run.model_copy(update=more)


def _searched_by_claims(claims: Mapping[str, Mapping[str, Any]] | None) -> list[str]:
    """Return what varied in the claims of a suite, by the settings of each; None for
    settings that can't be read.
    """
    if claims is None:
        return ["as the claims of its suite say, which cannot be read any more"]
    lines = defaultdict[str, list[str]](list)
    for name, claim_settings in claims.items():
        controls = claim_settings.get("controls") or {}
        if not isinstance(controls, Mapping):
            controls = dict.fromkeys(str(controls).split(","))
        for control, given in controls.items():
            text = (
                json.dumps(given, ensure_ascii=False)
                if given
                else "everything it searches by default"
            )
            lines[f"{control}: {text}"].append(name)
        if claim_settings.get("environment"):
            lines[f"environment: {claim_settings['environment']}"].append(name)
    return [f"{line} ({', '.join(names)})" for line, names in lines.items()]
