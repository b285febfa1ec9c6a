"""`advsearch plan`: how every derivative of a search would be obtained and what it would leave out, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand

if TYPE_CHECKING:
    from advsearch.runs.results.plan import GroupDerivative, PlanResult

HELP = "show how a search gets its gradients and what it leaves out, measured on its scene"
EXAMPLES = (
    "plan --object mug --control pose,texture",
    "plan --object mug --control camera --seconds 60 --run derivatives",
    "resume derivatives",
)
READING = (
    "How a search gets the derivative of each parameter, measured on this scene, and why. adjoint: a second render\n"
    "that carries all derivatives back at once; differences, secant: two renders with the parameter moved by a step\n"
    "(a share of its range). A cosine of 1 with the converged gradient means that a gradient points the right way."
)
"""What a plan shows, and how to read it."""


def _step(group: GroupDerivative) -> str:
    """The step of a difference in u, and in the parameter's unit where it has one."""
    if not group.step_reason:
        return ""
    unit = "" if group.unit == "1" else f" {group.unit}"
    own = "" if group.step_in_unit is None else f" ({group.step_in_unit:.3g}{unit})"
    return f"{group.step:.3g}{own}"


def _why(chosen: PlanResult) -> list[str]:
    """Why the estimators and the steps are what they are, each reason once with its parameters."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for group in chosen.groups:
        reasons.setdefault((group.estimator, group.reason), []).append(group.name)
    for group in chosen.groups:
        if group.step_reason:
            reasons.setdefault(("step", group.step_reason), []).append(group.name)
    return [f"{what} of {', '.join(names)}: {reason}" for (what, reason), names in reasons.items()]


def answer(chosen: PlanResult) -> str:
    """Return a plan as text, and where the run is."""
    from advsearch.report import wording
    from advsearch.runs.results.base import OUT_OF_TIME

    rows = [["parameter", "numbers", "estimator", "step"]]
    rows += [[group.name, str(group.size), group.estimator, _step(group)] for group in chosen.groups]
    lines = [
        READING,
        "",
        output.columns(rows),
        "",
        f"renders for one gradient beside the picture itself: {chosen.renders_per_gradient}",
        f"samples a pixel: {chosen.spp}",
        *_why(chosen),
        *_left_out(chosen),
    ]
    if chosen.cosines:
        heads = [
            "control",
            "denoiser",
            "step",
            "samples",
            "cosine with the converged gradient",
            "of converged ones",
            "seconds",
            "status",
        ]
        body = [
            [
                row.control,
                row.denoise,
                f"x {row.factor:.3g}",
                str(row.spp),
                f"{row.cosine:.3f}",
                f"{row.converged:.3f}",
                f"{row.seconds:.2f}",
                row.status,
            ]
            for row in chosen.cosines
        ]
        lines += ["", output.columns([heads, *body])]
        denoise = chosen.denoise
        lines += [
            "",
            f"denoiser asked for: {denoise.asked}; better gradients: {denoise.advised} ({denoise.reason})",
        ]
    if chosen.not_measured:
        why = "the time was up" if chosen.ending == OUT_OF_TIME else "it was stopped"
        lines += ["", f"not measured, {why}:", *(f"  {what}" for what in chosen.not_measured)]
    if chosen.limits:
        lines += ["", "limits of the material form:", *(f"  {limit.what}" for limit in chosen.limits)]
    time = wording.seconds_text(chosen.seconds["total"])
    return "\n".join([*lines, "", output.columns([["time", time], ["run", str(chosen.run)]])])


def _left_out(chosen: PlanResult) -> list[str]:
    """Lines on what the search doesn't compute: sentences, then what was measured."""
    if not chosen.specialised:
        return ["left out: nothing (--no-specialise)"]
    lines = ["not needed:", *(f"  {sentence}" for sentence in chosen.left_out)]
    if chosen.gains:
        rows = [["left out", "a gradient with it takes", "picture differs", "gradient differs"]]
        for row in chosen.gains:
            agrees = _agreement(row.picture_difference), _agreement(row.gradient_difference)
            rows.append([row.what, f"x {row.gain:.2f}", *agrees, *([] if row.safe else ["MORE THAN ITS NOISE"])])
        lines += ["", output.columns(rows), ""]
    if chosen.bounces is not None:
        depth, full = chosen.bounces.depth, chosen.bounces.full
        lines.append(f"longest light path of the search: {depth} segments of {full}: {chosen.bounces.reason}")
    for one in chosen.texels or ():
        enough = (
            f"--texture-resolution {one.enough} would resolve as much"
            if one.enough < one.side
            else f"{one.side} a side is what the pixels resolve"
        )
        lines.append(f"texels of {one.control}: {one.seen} are seen in {one.pixels} pixels; {enough}")
    return lines


def _agreement(share: float) -> str:
    """How a picture or gradient compares with another seed's."""
    return "not at all" if share == 0.0 else f"by {share:.2g} of its noise"


COMMAND = QuestionCommand("plan", answer)
