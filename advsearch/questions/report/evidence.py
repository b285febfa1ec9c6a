"""Runs as evidence: their claims, what they were about, what varied, how it was measured, what is left out."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from advsearch import __version__, rooms
from advsearch.errors import AdvsearchError
from advsearch.files import read_bytes
from advsearch.options import FROM_RUN
from advsearch.questions.attack import wording as attack_wording
from advsearch.questions.attack.summary import AttackSummary
from advsearch.questions.photographs.result import FOLDER, PHOTO, PhotoAgreement
from advsearch.questions.report.engineering import (
    Exposure,
    conditions_of,
    criterion_lines,
    domain_of,
    exposure_lines,
    not_shown,
    photograph_conditions,
    pictures_of,
    triggering_conditions,
)
from advsearch.questions.report.result import CROSSWALK, CROSSWALK_HEADS, Evidence, EvidenceRun
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.report import wording
from advsearch.report.shown import Claim, Extent, claim, nothing_claimed, share_text
from advsearch.runs.directory import CONFIG, IMAGES, PARTS, find_run, is_run, typed_name
from advsearch.runs.results import RUNNING, Result, VariedValue
from advsearch.runs.store import NAME as STORE
from advsearch.runs.store import Row, Store
from advsearch.runs.summary import MADE_WITH, read_result
from advsearch.runs.summary import NAME as SUMMARY
from advsearch.settings import read_yaml

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
    room = rooms.room(result.command)
    if room and room.claims:
        return list(room.claims(result)) or [nothing_claimed("nothing in this run came to its end")]
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
    """Return what has to be known of runs together: their models, and the digests of each run's model files, one text a
    run; empty where none is known."""
    said = []
    if len(set(models)) > 1:
        names = ", ".join(sorted(set(models)))
        said.append(f"The runs are of different models: {names}. A claim about one is none about another.")
    for model in sorted(set(models)):
        known = {text for one, text in zip(models, digests, strict=True) if one == model and text}
        if len(known) > 1:
            said.append(f"{model}: its file was not the same in all runs, so that they are of {len(known)} models.")
    return said


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
    seconds = values.get("seconds") or {}
    return EvidenceRun(
        run=name,
        command=result.command,
        ending=str(values.get("ending") or "done"),
        claims=list(claims),
        about={key: text for key, text in about.items() if text},
        searched=searched_lines(result, settings),
        measured=_measured(result, settings, judged_by or {}),
        excluded=_excluded(result, claims),
        cost={"Renders": _renders(values.get("renders")), "Time": wording.seconds_text(seconds.get("total"))},
        made_with=dict(made) or {"versions and files": NOT_NOTED},
        command_line=str(values.get("command_line") or ""),
    )


def _lit_by(result: Result) -> str:
    """What lights it, or that this is among what varied."""
    name = str(getattr(result, "environment", "") or "")
    moving = [*getattr(result, "over", ()), *getattr(result, "controls", ())]
    if not {"environment", "sky"} & {one.partition(":")[0] for one in moving} or not name:
        return name
    return f"varied, see below; the clean scene has {name}" if isinstance(result, AttackSummary) else f"{name}, varied"


def searched_lines(result: Result, settings: Mapping[str, object]) -> list[str]:
    """Return what could change and how far, a line for each part of it."""
    lines = []
    if isinstance(result, AttackSummary):
        lines.append(attack_wording.changed_text(result))
        lines += [
            f"{name}: {one.low:.4g} to {one.high:.4g} {one.unit}".rstrip()
            for name, one in (result.configuration or {}).items()
            if one.low is not None and one.high is not None
        ]
        lines += [attack_wording.over_text(result)] if result.over else []
        lines += [f"{name}: {_span(one)}, by chance" for name, one in result.conditions.items()]
    elif isinstance(result, SweepSummary):
        lines += _axes(result)
    given = settings.get("controls") or {}
    for control in getattr(result, "controls", ()):
        own = given.get(control) if isinstance(given, Mapping) else None
        if own:
            lines.append(f"{control}, as set: {json.dumps(own, ensure_ascii=False)}")
        elif not any(line.startswith((control, f"{control}.")) for line in lines):
            lines.append(f"{control}: everything that it searches by default")
    for name in ("epsilon", "epsilons"):
        value = settings.get(name)
        if value is not None and not isinstance(result, AttackSummary):
            lines.append(f"{name}: {json.dumps(value)}")
    return lines


def _axes(result: SweepSummary) -> list[str]:
    """The values of each axis of a sweep: a declared range, or names."""
    spans: dict[str, list[Any]] = {}
    units = {row.axis: row.unit for row in result.axes}
    for row in result.axes:
        spans.setdefault(row.axis, []).append(row.value)
    lines = []
    for axis, values in spans.items():
        if axis in result.drawn:
            continue
        if all(isinstance(one, tuple) for one in values):
            low, high = min(one[0] for one in values), max(one[1] for one in values)
            lines.append(f"{axis}: {low:.4g} to {high:.4g} {units[axis]}".rstrip())
        else:
            lines.append(f"{axis}: {', '.join(map(wording.number_text, values))} {units[axis]}".rstrip())
    return lines + [f"{name}: {_span(one)}, drawn by chance" for name, one in result.drawn.items()]


def _span(one: VariedValue) -> str:
    if one.low is None or one.high is None:
        return " or ".join(one.names or ["something"])
    return f"{one.low:.4g} to {one.high:.4g} {'' if one.unit == '1' else one.unit}".rstrip()


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
        lines += [one for one in attack_wording.remarks(result) if one not in result.warnings]
        bad = result.non_finite
        if bad.objectives or bad.gradient_elements:
            lines.append(f"Not finite: {bad.objectives} objectives, {bad.gradient_elements} numbers of gradients.")
        lines += [
            f"The clean scene has {one.parameter} {wording.number_text(one.used)} {one.unit} in place of "
            f"{wording.number_text(one.scene)}: the control leaves that out."
            for one in result.clean.moved
        ]
    if isinstance(result, SweepSummary) and result.not_finite:
        lines.append(f"{result.not_finite} predictions were not numbers; they count as not right.")
    if isinstance(result, SweepSummary) and result.looked_at < result.planned:
        lines.append(f"Only {result.looked_at} of {result.planned} planned configurations were looked at.")
    if all(one.kind == "nothing claimed" for one in claims):
        lines.append("The run carries no claim; it is listed so that it is not left out unseen.")
    return lines + list(getattr(result, "warnings", ()))


def _renders(renders: object) -> str:
    if isinstance(renders, Mapping):
        return ", ".join(f"{number} {name}" for name, number in renders.items() if number) or "none"
    return "those of its parts" if renders is None else str(renders)


SUITE = "suite"
"""The note of a run of `test` that has its claims."""

MOST_OF_PICTURE = 16 << 20
"""Bytes of a picture that is taken along."""


def collected(
    runs: list[str], *, criterion: float | None = None, exposure: Exposure | None = None, by: str = ""
) -> tuple[Evidence, dict[str, bytes]]:
    """Return runs, by their names or folders, as evidence, with the pictures that it names.

    Args:
        criterion: share of right predictions that is asked for.
        exposure: how common the values of axes are (`answer.read_exposure`).
        by: who answers for it.
    """
    folders = {part.resolve(): part for name in runs for part in _with_parts(find_run(name))}
    found, pictures = list[EvidenceRun](), dict[str, bytes]()
    for number, folder in enumerate(folders.values(), 1):
        shown = {f"pictures/{number}-{one.name}": read_bytes(one, "a picture", MOST_OF_PICTURE)
                 for one in pictures_of(folder)}  # fmt: skip
        pictures |= shown
        one = _run(folder, criterion, exposure or {})
        found.append(one.model_copy(update={"pictures": list(shown), "begun": _begun(folder)}))
    models = [one.about.get("Model", "") for one in found]
    files = [(model, model.rpartition("@")[2]) for model in models]
    digests = [
        " ".join(text for name, text in one.made_with.items() if name in own)
        for one, own in zip(found, files, strict=True)
    ]
    warnings = warnings_over([one for one in models if one], [d for d, m in zip(digests, models, strict=True) if m])
    unused = set(exposure or {}) - {row.axis for one in found for row in one.conditions}
    warnings += [f"exposure: no run has the axis {axis}." for axis in sorted(unused)]
    evidence = Evidence(
        runs=found,
        warnings=warnings,
        rules=list(RULES),
        version=__version__,
        written=f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
        by=by,
        criterion=criterion,
        crosswalk=[dict(zip(CROSSWALK_HEADS, row, strict=True)) for row in CROSSWALK],
    )
    return evidence, pictures


def _begun(folder: Path) -> str:
    """When its settings were written, in UTC."""
    with suppress(OSError):
        return f"{datetime.fromtimestamp((folder / CONFIG).stat().st_mtime, timezone.utc):%Y-%m-%d %H:%M} UTC"
    return ""


def _with_parts(folder: Path) -> Iterator[Path]:
    """A run; in place of a recipe, the runs that it consists of."""
    parts = [one for one in sorted((folder / PARTS).glob("*")) if is_run(one)]
    if parts and _settings(folder).get("command") == "recipe":
        yield from parts
    else:
        yield folder


def _of_quick_recipe(folder: Path) -> bool:
    """Whether a run is a part of a recipe that was made with `quick`."""
    outer = _settings(folder.resolve().parent.parent)
    return outer.get("command") == "recipe" and outer.get("quick") is True


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
    result = read_result(folder)
    photographs = _photos(folder)
    found = evidence_of(name, result, [*claims_of(result), *photographs], settings, made, _judged_by(settings))
    few = [QUICK] if _of_quick_recipe(folder) else []
    basis = list(_read_by(result))
    searched = list(dict.fromkeys(line for one in basis for line in searched_lines(*one)))
    searched = searched or (_of_a_suite(folder) if result.command == "test" else found.searched)
    domain, conditions = domain_of(basis[0][0] if basis else result, settings, searched), conditions_of(result)
    weighted = exposure_lines(result, conditions, exposure)
    return found.model_copy(
        update={
            "searched": searched,
            "excluded": [*few, *found.excluded],
            "criterion": [] if criterion is None else criterion_lines(found.claims, conditions, criterion),
            "triggering": triggering_conditions(result),
            "exposure": weighted,
            "conditions": conditions,
            "photographs": photograph_conditions(result, _photograph_rows(folder)) if photographs else [],
            "domain": domain,
            "not_shown": not_shown(
                domain, sum(one.extent.total for one in photographs if one.extent), weighted=bool(weighted)
            ),
        }
    )


def _read_by(result: Result) -> Iterator[tuple[Result, Mapping[str, object]]]:
    """The sweeps whose rows a run reads, with their settings, as far as they are to be had: it is about what varied
    there."""
    for name in dict.fromkeys([*getattr(result, "sweeps", ()), *(one.run for one in getattr(result, "sides", ()))]):
        with suppress(AdvsearchError):
            folder = find_run(str(name))
            yield read_result(folder), _settings(folder)


def _of_a_suite(folder: Path) -> list[str]:
    """What the claims of a suite vary, as the run has kept it."""
    lines = dict[str, list[str]]()
    try:
        with Store(folder / STORE, read_only=True) as store:
            suite: Any = store.noted(SUITE)
        for name, claim in suite["claims"].items():
            given = {**suite["settings"], **claim["settings"]}
            controls = given.get("controls") or {}
            for control in controls if isinstance(controls, Mapping) else str(controls).split(","):
                own = controls[control] if isinstance(controls, Mapping) else None
                said = json.dumps(own, ensure_ascii=False) if own else "everything it searches by default"
                lines.setdefault(f"{control}: {said}", []).append(str(name))
            if given.get("environment"):
                lines.setdefault(f"environment: {given['environment']}", []).append(str(name))
    except (AdvsearchError, KeyError, AttributeError, TypeError, ValueError):
        return ["as the claims of its suite say, which cannot be read any more"]
    return [f"{told} ({', '.join(names)})" for told, names in lines.items()]


def _judged_by(settings: Mapping[str, object]) -> dict[str, object]:
    """The options of the task that a run was judged by; nothing of one that is not to be had here."""
    given: Any = settings.get("task")
    if given is None:
        return {}
    from advsearch.tasks import make_task  # they bring torch, which takes a second
    from advsearch.tasks.together import Together

    with suppress(AdvsearchError):
        task = make_task(given)
        alone = [("", task)] if not isinstance(task, Together) else [(f"{one.name}.", one) for one in task.parts]
        return {
            f"{of}{option.name}": getattr(one, option.name)
            for of, one in alone
            for option in fields(one)
            if option.metadata != FROM_RUN
        }
    return {}


def _photos(folder: Path) -> list[Claim]:
    if not (folder / IMAGES / FOLDER).is_dir():
        return []
    from advsearch.questions.photographs.carry_out import photo_agreement  # it brings torch, which takes a second

    return photo_claims(photo_agreement(folder))


def _photograph_rows(folder: Path) -> list[Row]:
    with Store(folder / STORE, read_only=True) as store:
        return list(store.rows(PHOTO))


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
