"""How an attack came to its answer, in words and tables: derivatives, light transport, what was cut, and its claims."""

from __future__ import annotations

import math

from advsearch.report.wording import count, number_text, print_cost_text, seconds_text
from advsearch.runs.results.attack import AttackSummary, PrintTerms

PLAN_HEADS = ("parameter", "numbers", "derivative", "why", "step")


def method_facts(summary: AttackSummary) -> dict[str, str]:
    """Return what is known of the search's work by name; texts of what is not known are empty."""
    segments = summary.light_path_segments
    return {
        "The search's claim": _claim(summary),
        "Sample count": _sample_count(summary),
        "Light transport": transport_text(summary),
        "Gradients": _gradients(summary),
        "Cut or taken back": _cut(summary),
        "Not finite": _not_finite(summary),
        "Light paths": f"at most {segments.search} segments in the search, {segments.verification} in the verification",
        "Printability": _printability(summary),
        "Cost of printability": print_cost_text(summary),
        "Moved before": ", ".join(
            f"{one.parameter} from {number_text(one.scene)} to {number_text(one.used)} {one.unit}".rstrip()
            for one in summary.clean.moved
        ),
    }


def transport_text(summary: AttackSummary) -> str:
    """Return whether a matrix predicted the pictures of the searches, and how far it was off; empty: not known."""
    transport = summary.transport
    if transport is None:
        return ""
    if not transport.used:
        return f"every picture was rendered: {transport.reason}" if transport.reason else "every picture was rendered"
    what = "light on surfaces" if transport.way == "surface light" else "a matrix"
    parts = [f"{what} predicted {count(summary.renders.get('products'), 'picture')}"]
    if transport.error is not None:
        levels, logits = map(_short, (transport.error.levels, transport.error.logits))
        parts.append(
            f"at the last comparison with a traced one it was off by {levels} of 255 levels of the picture's change "
            f"(root mean square) and {logits} of the objective"
        )
    if transport.renewed:
        parts.append(f"made anew {count(transport.renewed, 'time')}")
    if transport.seconds is not None:
        parts.append(f"it and the comparisons took {seconds_text(transport.seconds)}")
    return "; ".join([*parts, *filter(None, [transport.reason])])


def plan_text(summary: AttackSummary) -> str:
    """Return what a gradient plan comes to."""
    plan = summary.gradient_plan
    spp = "" if plan.spp is None else f", {count(plan.spp, 'sample')} a pixel"
    renders = count(plan.renders_per_gradient, "render")
    return f"Gradient plan: {count(len(plan.groups), 'parameter')}, {renders} a gradient beside the picture itself{spp}"


def plan_rows(summary: AttackSummary) -> list[list[str]]:
    """Return a row for each parameter of the gradient plan."""
    rows = []
    for group in summary.gradient_plan.groups:
        by_step = group.step_reason != ""
        unit = "" if group.unit in ("", "1") else f" {group.unit}"
        wide = f"{group.step:.3g} of its range" if group.step_in_unit is None else f"{group.step_in_unit:.3g}{unit}"
        step = f"{wide}: {group.step_reason}" if by_step else ""
        rows.append([group.name, str(group.size), group.estimator, group.reason, step])
    return rows


def _short(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "an unknown amount"


def _claim(summary: AttackSummary) -> str:
    claim = summary.claimed
    if claim is None:
        return ""
    again = f"{_short(claim.re_evaluated)} when rendered again" if math.isfinite(claim.re_evaluated) else ""
    return ", ".join(filter(None, (f"{summary.objective} {_short(claim.objective)} in the render that won", again)))


def _sample_count(summary: AttackSummary) -> str:
    chosen = summary.sample_count
    if chosen is None:
        return ""
    enough = "more would leave the " + ("rate about where it is" if summary.over else "margin on its side")
    unknown = "that more would not change it is not shown"
    still = enough if chosen.converged else unknown
    return f"{chosen.spp} a pixel in the verification; {still}"


def _gradients(summary: AttackSummary) -> str:
    seen = summary.gradients
    if seen is None or not seen.count:
        return ""
    cosine = seen.cosine_with_the_one_before
    parts = [f"{seen.count} of the search", f"{seen.zero} of them zero" if seen.zero else ""]
    if cosine is not None and math.isfinite(cosine):
        parts.append(f"median cosine with the one before {cosine:.2f}")
    return ", ".join(filter(None, parts))


def _cut(summary: AttackSummary) -> str:
    """What the policy did about outliers and about steps that failed."""
    seen = summary.gradients
    if seen is None or not (seen.count or seen.rejected):
        return ""
    cut = count(seen.cut, "gradient") + " with single outliers cut"
    return f"{cut}, {seen.shortened} shortened as a whole, {count(seen.rejected, 'step')} taken back"


def _not_finite(summary: AttackSummary) -> str:
    found = summary.non_finite
    if not found.objectives and not found.gradient_elements:
        return ""
    return f"{count(found.objectives, 'objective')}, {count(found.gradient_elements, 'number')} of gradients"


def _printability(summary: AttackSummary) -> str:
    terms = summary.printability
    if terms is None:
        return ""

    def told(one: PrintTerms) -> str:
        return f"step between neighbours {one.variation:.3g}, distance from printable colours {one.off_print:.3g}"

    return f"clean: {told(terms.clean)}" + ("" if terms.answer is None else f"; answer: {told(terms.answer)} (sRGB)")
