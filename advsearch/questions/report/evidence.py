"""Runs as evidence: their claims, what they were about, what varied, how it was measured, what is left out."""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import advsearch.questions.report.evidence as engineering
from advsearch import __version__, registry
from advsearch.attacks import clopper_pearson
from advsearch.errors import AdvsearchError, InputError, UnknownNameError
from advsearch.files import read_bytes
from advsearch.options import FROM_RUN
from advsearch.questions.attack import wording as attack_wording
from advsearch.questions.attack.summary import AttackSummary
from advsearch.questions.explain.result import ExplainResult, rule_text
from advsearch.questions.photographs.result import FOLDER, PHOTO, PhotoAgreement
from advsearch.questions.report.result import CROSSWALK, CROSSWALK_HEADS, ConditionShare, Evidence, EvidenceRun
from advsearch.questions.sweep.summary import AxisRow, AxisValue, SweepSummary
from advsearch.report import wording
from advsearch.report.shown import Claim, Extent, claim, nothing_claimed, share_text
from advsearch.report.wording import interval_text, number_text, percent
from advsearch.runs.directory import CONFIG, IMAGES, PARTS, find_run, is_run, typed_name
from advsearch.runs.results import RUNNING, Interval, Result, VariedValue
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Row, Store
from advsearch.runs.summary import MADE_WITH, read_result
from advsearch.runs.summary import NAME as SUMMARY
from advsearch.settings import read_yaml

# ---------------------------------------------------------------------------------------------------------------------
# What an engineer reads of a run beside its claims: shares by condition, whether a criterion is met, how common
# conditions are, the operational design domain in words, and what is not shown.

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


RULES = (
    "Each claim is about the run's own model, object, environment, label and settings, and about nothing else.",
    "`found`: fresh renders confirm a configuration that a search found; how many others there are is not known.",
    "`not found`: a search of so many renders found none; another policy or more renders may find one.",
    "`measured`: a share of what was counted; its interval has 95 % confidence (Clopper-Pearson's; where predictions "
    "share a draw, as frames of a drive do, one over draws, by bets) and holds for the distribution that was drawn "
    "from.",
    "`nothing claimed`: the run does not carry a claim, for the reason that it gives.",
    "Renderings are not photographs: a claim is about reality only as far as photographs were compared.",
)

QUICK = "Made by a quick recipe: few and small pictures, to see what comes out; no result."


def claims_of(result: Result) -> list[Claim]:
    """Return what a run stands for; one that stands for nothing says so in a claim of that kind."""
    if result.goes_on:
        told = f"; so far: {result.brief}" if result.brief else ""
        state = "is running" if getattr(result, "ending", "") == RUNNING else "is not finished"
        return [nothing_claimed(f"the run {state}{told}")]
    if claims := registry.part_of(result.command, "claims"):
        return list(claims(result)) or [nothing_claimed("nothing in this run came to its end")]
    return [nothing_claimed(f"the command {result.command} does not measure how often a model is right")]


def photo_claims(photos: PhotoAgreement) -> list[Claim]:
    """Return what photographs of a run's renderings say."""
    if not photos.photos or photos.interval is None:
        return []
    agreeing = photos.right_right + photos.wrong_wrong
    extent = Extent(what="photographs that agree", count=agreeing, total=photos.photos, interval=photos.interval)
    said = "Photographs and renderings agree (both right, or both wrong) in "
    return [claim("measured", f"{said}{share_text(extent)}. The interval takes photographs as independent.", extent)]


def warnings_over(models: Sequence[str], digests: Sequence[str]) -> list[str]:
    """Return what has to be known of runs together, from their models and the digests of these files, a text a run."""
    warnings, names = [], sorted(set(models))
    if len(names) > 1:
        different = f"The runs are of different models: {', '.join(names)}."
        warnings.append(f"{different} A claim about one is none about another.")
    for name in names:
        known = {text for model, text in zip(models, digests, strict=True) if model == name and text}
        if len(known) > 1:
            warnings.append(f"{name}: its file was not the same in all runs, so that they are of {len(known)} models.")
    return warnings


NOT_NOTED = "not noted: the run is older than that"


def evidence_of(
    name: str,
    result: Result,
    claims: Sequence[Claim],
    settings: Mapping[str, object],
    made: Mapping[str, str],
    judged_by: Mapping[str, object] | None = None,
) -> EvidenceRun:
    """Return a run with what a reader needs to judge its claims: settings as its run.yaml has them, versions and
    digests as it noted them (empty of older runs), and the options of its task, such as thresholds."""
    values = {field: getattr(result, field) for field in type(result).model_fields}
    objects = values.get("object") or ", ".join(values.get("objects") or ())
    right = values.get("label_set") or settings.get("label")
    about = {
        "Object": str(objects or ""),
        "Environment": _lit_by(result),
        "Model": str(values.get("model") or ""),
        "Names of its classes": str(settings.get("labels") or ""),
        "Prompt": str(settings.get("prompt") or ""),
        "Task": str(values.get("task") or ""),
        "Counts as right": ", ".join(right) if isinstance(right, list) else str(right or "the object's own label"),
        "Sought": str(values.get("goal") or ""),
    }
    renders, seconds = values.get("renders"), values.get("seconds") or {}
    if isinstance(renders, Mapping):
        renders = ", ".join(f"{number} {name}" for name, number in renders.items() if number) or "none"
    return EvidenceRun(
        run=name,
        command=result.command,
        ending=str(values.get("ending") or "done"),
        claims=list(claims),
        about={key: text for key, text in about.items() if text},
        searched=searched_lines(result, settings),
        measured=_measured(result, settings, judged_by or {}),
        excluded=_excluded(result, claims),
        cost={
            "Renders": "those of its parts" if renders is None else str(renders),
            "Time": wording.seconds_text(seconds.get("total")),
        },
        made_with=dict(made) or {"versions and files": NOT_NOTED},
        command_line=str(values.get("command_line") or ""),
    )


def _lit_by(result: Result) -> str:
    """What lights it, or that this is among what varied."""
    name = str(getattr(result, "environment", "") or "")
    moving = [*getattr(result, "over", ()), *getattr(result, "controls", ())]
    if not {"environment", "sky"} & {control.partition(":")[0] for control in moving} or not name:
        return name
    return f"varied, see below; the clean scene has {name}" if isinstance(result, AttackSummary) else f"{name}, varied"


def searched_lines(result: Result, settings: Mapping[str, object]) -> list[str]:
    """Return what could change and how far, a line for each part of it."""
    lines = []
    if isinstance(result, AttackSummary):
        lines.append(attack_wording.changed_text(result))
        lines += [
            f"{name}: {found.low:.4g} to {found.high:.4g} {found.unit}".rstrip()
            for name, found in (result.configuration or {}).items()
            if found.low is not None and found.high is not None
        ]
        lines += [attack_wording.over_text(result)] if result.over else []
        lines += [f"{name}: {_span(varied)}, by chance" for name, varied in result.conditions.items()]
    elif isinstance(result, SweepSummary):
        lines += _axes(result)
    controls = settings.get("controls") or {}
    for control in getattr(result, "controls", ()):
        given = controls.get(control) if isinstance(controls, Mapping) else None
        if given:
            lines.append(f"{control}, as set: {json.dumps(given, ensure_ascii=False)}")
        elif not any(line.startswith((control, f"{control}.")) for line in lines):
            lines.append(f"{control}: everything that it searches by default")
    for name in () if isinstance(result, AttackSummary) else ("epsilon", "epsilons"):
        if settings.get(name) is not None:
            lines.append(f"{name}: {json.dumps(settings[name])}")
    return lines


def _axes(result: SweepSummary) -> list[str]:
    """The values of each axis of a sweep: a declared range, or names."""
    spans, units, lines = dict[str, list[Any]](), {row.axis: row.unit for row in result.axes}, []
    for row in result.axes:
        if row.axis not in result.drawn:
            spans.setdefault(row.axis, []).append(row.value)
    for axis, values in spans.items():
        if not all(isinstance(value, tuple) for value in values):
            text = ", ".join(map(wording.number_text, values))
        else:
            text = f"{min(low for low, _ in values):.4g} to {max(high for _, high in values):.4g}"
        lines.append(f"{axis}: {text} {units[axis]}".rstrip())
    return lines + [f"{name}: {_span(varied)}, drawn by chance" for name, varied in result.drawn.items()]


def _span(varied: VariedValue) -> str:
    if varied.low is None or varied.high is None:
        return " or ".join(varied.names or ["something"])
    return f"{varied.low:.4g} to {varied.high:.4g} {'' if varied.unit == '1' else varied.unit}".rstrip()


def _measured(result: Result, settings: Mapping[str, object], judged_by: Mapping[str, object]) -> dict[str, str]:
    worst = isinstance(result, SweepSummary)
    facts = {
        "Policy": getattr(result, "policy", None),
        "Objective": getattr(result, "objective", None),
        "Sampler": getattr(result, "sampler", None),
        "Steps": settings.get("steps"),
        "Seed": getattr(result, "seed", None),
        "Samples a pixel": getattr(result, "spp", None) or settings.get("spp"),
        "Trials of the worst configuration" if worst else "Trials": settings.get("trials"),
        "Judged with": ", ".join(f"{name} {wording.number_text(one)}" for name, one in judged_by.items() if one),
    }
    named = {name: str(value) for name, value in facts.items() if value not in (None, "")}
    if isinstance(result, AttackSummary) and result.verified is not None:
        rated, control = result.verified, result.clean.control
        counting = f"{rated.trials} renders with fresh seeds"
        if result.over and control is not None and control.trials > rated.trials:
            counting += f" that count, those of {control.trials} in which the clean scene is right"
        named["Verification"] = f"{counting}, {rated.spp} samples a pixel"
    formation = getattr(result, "image_formation", None)
    gains = getattr(result, "gains", None)
    return {**named, "Pictures": wording.formation_text(formation, gains)} if formation else named


def _excluded(result: Result, claims: Sequence[Claim]) -> list[str]:
    """What a reader has to know beside the claims: what stood still, what failed, the run's own warnings."""
    lines = ["Nothing varied but what stands under What varied, and the noise of the renders."]
    if isinstance(result, AttackSummary):
        lines += [remark for remark in attack_wording.remarks(result) if remark not in result.warnings]
        bad = result.non_finite
        if bad.objectives or bad.gradient_elements:
            lines.append(f"Not finite: {bad.objectives} objectives, {bad.gradient_elements} numbers of gradients.")
        lines += [
            f"The clean scene has {moved.parameter} {wording.number_text(moved.used)} {moved.unit} in place of "
            f"{wording.number_text(moved.scene)}: the control leaves that out."
            for moved in result.clean.moved
        ]
    if isinstance(result, SweepSummary) and result.not_finite:
        lines.append(f"{result.not_finite} predictions were not numbers; they count as not right.")
    if isinstance(result, SweepSummary) and result.looked_at < result.planned:
        lines.append(f"Only {result.looked_at} of {result.planned} planned configurations were looked at.")
    if all(claim.kind == "nothing claimed" for claim in claims):
        lines.append("The run carries no claim; it is listed so that it is not left out unseen.")
    return lines + list(getattr(result, "warnings", ()))


SUITE = "suite"  # the note of a run of `test` that has its claims

MOST_OF_PICTURE = 16 << 20  # bytes of a picture that is taken along


def collected(
    runs: list[str], *, criterion: float | None = None, exposure: Exposure | None = None, by: str = ""
) -> tuple[Evidence, dict[str, bytes]]:
    """Return runs, by their names or folders, as evidence, with the pictures that it names; `criterion` is the share of
    right predictions that is asked for, `exposure` how common the values of axes are, and `by` who answers for it."""
    told, pictures, folders = list[EvidenceRun](), dict[str, bytes](), dict[Path, Path]()
    models, digests = list[str](), list[str]()
    for folder in map(find_run, runs):
        parts = [part for part in sorted((folder / PARTS).glob("*")) if is_run(part)]
        of_recipe = parts and _settings(folder).get("command") == "recipe"  # the runs that it consists of
        folders |= {part.resolve(): part for part in (parts if of_recipe else [folder])}
    for number, folder in enumerate(folders.values(), 1):
        shown = {f"pictures/{number}-{file.name}": read_bytes(file, "a picture", MOST_OF_PICTURE)
                 for file in engineering.pictures_of(folder)}  # fmt: skip
        pictures |= shown
        run, begun = _run(folder, criterion, exposure or {}), ""
        with suppress(OSError):  # when its settings were written
            begun = f"{datetime.fromtimestamp((folder / CONFIG).stat().st_mtime, timezone.utc):%Y-%m-%d %H:%M} UTC"
        told.append(run.model_copy(update={"pictures": list(shown), "begun": begun}))
        if model := run.about.get("Model"):
            files = model, model.rpartition("@")[2]
            models.append(model)
            digests.append(" ".join(text for name, text in run.made_with.items() if name in files))
    warnings = warnings_over(models, digests)
    unused = set(exposure or {}) - {row.axis for run in told for row in run.conditions}
    warnings += [f"exposure: no run has the axis {axis}." for axis in sorted(unused)]
    evidence = Evidence(
        runs=told, warnings=warnings, rules=list(RULES), version=__version__, by=by, criterion=criterion,
        written=f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
        crosswalk=[dict(zip(CROSSWALK_HEADS, row, strict=True)) for row in CROSSWALK],
    )  # fmt: skip
    return evidence, pictures


def _settings(folder: Path) -> Mapping[str, object]:
    """What its run.yaml says; nothing where there is none that can be read."""
    with suppress(AdvsearchError):
        return read_yaml(folder / CONFIG)
    return {}


def _run(folder: Path, criterion: float | None, exposure: Exposure) -> EvidenceRun:
    """One run; of one that has no summary, that it claims nothing."""
    name, settings = typed_name(folder), _settings(folder)
    made = _made_with(folder)
    if not (folder / SUMMARY).is_file():
        facts = {"Object": str(settings.get("object") or ""), "Model": str(settings.get("model") or "")}
        return EvidenceRun(
            run=name,
            command=str(settings.get("command") or "unknown"),
            ending="none yet",
            claims=[nothing_claimed("the run has no result yet: it is still working, or was stopped")],
            about={key: text for key, text in facts.items() if text},
            searched=[],
            measured={},
            excluded=["The run carries no claim; it is listed so that it is not left out unseen."],
            cost={},
            made_with=made or {"versions and files": NOT_NOTED},
            command_line=f"advsearch run {folder / CONFIG}",
        )
    result, photographs, rows = read_result(folder), list[Claim](), list[Row]()
    if (folder / IMAGES / FOLDER).is_dir():
        from advsearch.questions.photographs.carry_out import photo_agreement  # it brings torch, which takes a second

        photographs = photo_claims(photo_agreement(folder))
        with Store(folder / STORE, read_only=True) as store:
            rows = list(store.rows(PHOTO)) if photographs else []
    run = evidence_of(name, result, [*claims_of(result), *photographs], settings, made, _judged_by(settings))
    outer = _settings(folder.resolve().parent.parent)
    few = [QUICK] if outer.get("command") == "recipe" and outer.get("quick") is True else []
    basis = list(_read_by(result))
    searched = list(dict.fromkeys(line for read in basis for line in searched_lines(*read)))
    searched = searched or (_of_a_suite(folder) if result.command == "test" else run.searched)
    domain = engineering.domain_of(basis[0][0] if basis else result, settings, searched)
    conditions = engineering.conditions_of(result)
    weighted = engineering.exposure_lines(result, conditions, exposure)
    compared = sum(claim.extent.total for claim in photographs if claim.extent)
    asked = [] if criterion is None else engineering.criterion_lines(run.claims, conditions, criterion)
    more = {
        "searched": searched,
        "excluded": [*few, *run.excluded],
        "criterion": asked,
        "triggering": engineering.triggering_conditions(result),
        "exposure": weighted,
        "conditions": conditions,
        "photographs": engineering.photograph_conditions(result, rows),
        "domain": domain,
        "not_shown": engineering.not_shown(domain, compared, weighted=bool(weighted)),
    }
    return run.model_copy(update=more)


def _read_by(result: Result) -> Iterator[tuple[Result, Mapping[str, object]]]:
    """The sweeps whose rows a run reads, with their settings: it is about what varied there."""
    sides = [side.run for side in getattr(result, "sides", ())]
    for name in dict.fromkeys([*getattr(result, "sweeps", ()), *sides]):
        with suppress(AdvsearchError):
            folder = find_run(str(name))
            yield read_result(folder), _settings(folder)


def _of_a_suite(folder: Path) -> list[str]:
    """What the claims of a suite vary, as the run has kept it."""
    lines = defaultdict[str, list[str]](list)
    try:
        with Store(folder / STORE, read_only=True) as store:
            suite: Any = store.noted(SUITE)
        for name, claim in suite["claims"].items():
            settings = {**suite["settings"], **claim["settings"]}
            controls = settings.get("controls") or {}
            if not isinstance(controls, Mapping):
                controls = dict.fromkeys(str(controls).split(","))
            for control, given in controls.items():
                text = json.dumps(given, ensure_ascii=False) if given else "everything it searches by default"
                lines[f"{control}: {text}"].append(str(name))
            if settings.get("environment"):
                lines[f"environment: {settings['environment']}"].append(str(name))
    except (AdvsearchError, KeyError, AttributeError, TypeError, ValueError):
        return ["as the claims of its suite say, which cannot be read any more"]
    return [f"{line} ({', '.join(names)})" for line, names in lines.items()]


def _judged_by(settings: Mapping[str, object]) -> dict[str, object]:
    """The options of the task that a run was judged by; nothing of one that is not to be had here."""
    given: Any = settings.get("task")
    if given is None:
        return {}
    from advsearch.tasks import make_task  # they bring torch, which takes a second
    from advsearch.tasks.together import Together

    with suppress(AdvsearchError):
        task = make_task(given)
        alone = {f"{part.name}.": part for part in task.parts} if isinstance(task, Together) else {"": task}
        return {
            f"{of}{option.name}": getattr(part, option.name)
            for of, part in alone.items()
            for option in fields(part)
            if option.metadata != FROM_RUN
        }
    return {}


def _made_with(folder: Path) -> dict[str, str]:
    """What the run noted at each sitting; of several that differ, all."""
    try:
        with Store(folder / STORE, read_only=True) as store:
            noted = store.noted(MADE_WITH)
    except AdvsearchError:
        return {}
    facts: dict[str, dict[str, None]] = {}
    for sitting in noted if isinstance(noted, list) else []:
        for name, text in sitting.items() if isinstance(sitting, Mapping) else ():
            facts.setdefault(str(name), {})[str(text)] = None
    return {name: ", then ".join(texts) for name, texts in facts.items()}
