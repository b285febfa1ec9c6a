"""A run as evidence: its claims, what it was about, what varied, how it was measured, what is left out.

For a page and as Markdown.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from advsearch import rooms
from advsearch.questions.photographs.answer import PhotoAgreement
from advsearch.questions.report.answer import Evidence, EvidenceRun
from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.report.shown import Claim, Extent, claim, nothing_claimed, share_text
from advsearch.report.wording import interval_text
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import Result, VariedValue
from advsearch.runs.results.sweep import SweepSummary
from advsearch.viewer.document import again, document, facts_table, heading, study_table

RULES = (
    "Each claim is about the run's own model, object, environment, label and settings, and about nothing else.",
    "`found`: fresh renders confirm a configuration that a search found; how many others there are is not known.",
    "`not found`: a search of so many renders found none; another policy or more renders may find one.",
    "`measured`: a share of what was counted; its interval has 95 % confidence (Clopper-Pearson) and holds for the "
    "distribution that was drawn from.",
    "`nothing claimed`: the run does not carry a claim, for the reason that it gives.",
    "Renderings are not photographs: a claim is about reality only as far as photographs were compared.",
)
"""How claims are to be read."""

QUICK = "Made by a quick recipe: few and small pictures, to see what comes out; no result."


def claims_of(result: Result) -> list[Claim]:
    """Return what a run stands for; one that stands for nothing says so in a claim of that kind."""
    if result.goes_on:
        told = f"; so far: {result.brief}" if result.brief else ""
        return [nothing_claimed(f"the run was stopped before its end{told}")]
    if own := rooms.in_room(result.command, "words", "claims"):
        return list(own(result)) or [nothing_claimed("nothing in this run came to its end")]
    return [nothing_claimed(f"the command {result.command} measures something else than how often a model is right")]


def photo_claims(photos: PhotoAgreement) -> list[Claim]:
    """Return what photographs of a run's renderings say."""
    if not photos.photos or photos.interval is None:
        return []
    agreeing = photos.right_right + photos.wrong_wrong
    extent = Extent(what="photographs that agree", count=agreeing, total=photos.photos, interval=photos.interval)
    said = "Photographs and renderings agree (both right, or both wrong) in "
    return [claim("measured", f"{said}{share_text(extent)}. The interval takes photographs as independent.", extent)]


def warnings_over(models: Sequence[str], digests: Sequence[str]) -> list[str]:
    """Return what has to be known of runs together.

    Args:
        models: of each run.
        digests: of each run's model files, one text a run; empty where none is known.
    """
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
    """Return a run with what a reader needs to judge its claims.

    Args:
        name: of the run.
        result: what it answered.
        claims: what it stands for.
        settings: as its run.yaml has them.
        made: versions and digests, as the run noted them; empty of older runs.
        judged_by: the options of its task by name, such as thresholds.
    """
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
        lines.append(wording.changed_text(result))
        lines += [
            f"{name}: {one.low:.4g} to {one.high:.4g} {one.unit}".rstrip()
            for name, one in (result.configuration or {}).items()
            if one.low is not None and one.high is not None
        ]
        lines += [wording.over_text(result)] if result.over else []
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
        lines += [one for one in wording.remarks(result) if one not in result.warnings]
        bad = result.non_finite
        if bad.objectives or bad.gradient_elements:
            lines.append(f"Not finite: {bad.objectives} objectives, {bad.gradient_elements} numbers of gradients.")
        lines += [
            f"The clean scene has {one.parameter} {wording.number_text(one.used)} {one.unit} in place of "
            f"{wording.number_text(one.scene)}: the control leaves that out."
            for one in result.clean.moved
        ]
    if isinstance(result, SweepSummary) and result.not_finite:
        lines.append(f"{result.not_finite} answers were not numbers; they count as not right.")
    if isinstance(result, SweepSummary) and result.configurations < result.planned:
        lines.append(f"Only {result.configurations} of {result.planned} planned configurations were looked at.")
    if all(one.kind == "nothing claimed" for one in claims):
        lines.append("The run carries no claim; it is listed so that it is not left out unseen.")
    return lines + list(getattr(result, "warnings", ()))


def _renders(renders: object) -> str:
    if isinstance(renders, Mapping):
        return ", ".join(f"{number} {name}" for name, number in renders.items() if number) or "none"
    return "those of its parts" if renders is None else str(renders)


def markdown(evidence: Evidence) -> str:
    """Return the whole as Markdown, to be put into a model card."""
    lines = ["# Evidence", "", *(f"> {one}" for one in evidence.warnings), "" if evidence.warnings else None]
    for one in evidence.runs:
        lines += [
            f"## {_plain(one.run)}",
            "",
            *(f"- **{claim.kind}**: {_plain(claim.statement)}" for claim in one.claims),
            "",
        ]
        for title, facts in sections(one).items():
            lines += [f"{title}:", "", *(f"- {_plain(text)}" for text in facts), ""]
        lines += (
            ["To repeat it:", "", "```sh", one.command_line.replace("```", "` ` `"), "```", ""]
            if one.command_line
            else []
        )
    lines += ["## How to read this", "", *(f"- {text}" for text in evidence.rules), ""]
    lines.append(f"Written by advsearch {evidence.version}.")
    return "\n".join(line for line in lines if line is not None) + "\n"


def sections(one: EvidenceRun) -> dict[str, list[str]]:
    """Return what stands beside the claims of a run, in lines under their headings."""
    found = {
        "On what": [f"{name}: {text}" for name, text in one.about.items()],
        "What varied": one.searched,
        "Measured how": [f"ended as: {one.ending}", *(f"{name}: {text}" for name, text in one.measured.items())],
        "Excluded, and to be known": one.excluded,
        "Budget": [f"{name}: {text}" for name, text in one.cost.items()],
        "Made with": [f"{name}: {text}" for name, text in one.made_with.items()],
    }
    return {title: lines for title, lines in found.items() if lines}


def _plain(text: str) -> str:
    """Text that Markdown shows as it is."""
    one_line = " ".join(text.split())
    for sign in "\\<>*_[]`|":
        one_line = one_line.replace(sign, f"\\{sign}")
    return one_line


CLAIM_HEADS = ("claim", "in words", "counted", "95 % interval")


def evidence_page(evidence: Evidence) -> str:
    """Return the page."""
    claims = [claim for one in evidence.runs for claim in one.claims]
    carried = sum(claim.kind != "nothing claimed" for claim in claims)
    runs = f"{len(evidence.runs)} run{'' if len(evidence.runs) == 1 else 's'}"
    said = f"What {runs} show{'s' if len(evidence.runs) == 1 else ''}, and no more than that."
    main = element(
        "main",
        *(_run(one) for one in evidence.runs),
        element("h2", "How to read this"),
        element("ul", *(element("li", text.replace("`", "")) for text in evidence.rules)),
    )
    header = heading(f"evidence; {carried} of {len(claims)} statements carry a claim", said, evidence.warnings)
    return document("evidence", header, main, footer="evidence. This page needs no other file.")


def _run(one: EvidenceRun) -> Html:
    rows = [
        [
            claim.kind,
            claim.statement,
            f"{claim.extent.count} of {claim.extent.total}" if claim.extent else "",
            interval_text(claim.extent.interval) if claim.extent else "",
        ]
        for claim in one.claims
    ]
    facts = {name: "; ".join(lines) for name, lines in sections(one).items()}
    beside = element("details", element("summary", "On what, how, and what is left out"), facts_table(facts), open="")
    return join_html(
        element("h2", f"{one.run} ({one.command})"),
        study_table(CLAIM_HEADS, rows),
        beside,
        again(one.command_line) if one.command_line else None,
    )
