"""`advsearch check`: every derivative of a scene against differences, as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand
from advsearch.report import wording

if TYPE_CHECKING:
    from advsearch.runs.results.check import CheckedRow, CheckResult, DerivativeRow

HELP = "check the gradient of every parameter of a scene against finite differences"
MORE = ". Exit status 3 if one is biased or noisy"
EXAMPLES = (
    "check --object mug --control pose",
    "check --object mug --control environment.rotation --loss linear --json",
    "check --all --resolution 128 --loss linear --seconds 600 --run gradients",
    "resume gradients",
)
READING = (
    "Each row sets a derivative as a search gets it (gradient) beside one that takes far more renders (reference).\n"
    "ok: they agree within 5 %, and one gradient scatters by less than 20 % (noise); biased: they disagree; noisy: it\n"
    "scatters more; reference unusable: the reference is too noisy to tell. adjoint: a second render that carries all\n"
    "derivatives back at once; differences, secant: two renders with the parameter moved by a step."
)
"""What the table shows, and how to read it."""
SINGLE = (
    "object",
    "parameter",
    "estimator",
    "step",
    "gradient",
    "reference",
    "error",
    "noise",
    "seconds",
    "status",
)
"""Heads of a table of single parameters."""


def fell_short(result: CheckResult) -> bool:
    """Whether a parameter has no good gradient by any estimator."""
    return any(row.short for row in _best(result.rows))


def answer(result: CheckResult) -> str:
    """Return what the table shows and how to read it, the table, and where the run is."""
    from advsearch.runs.results.base import OUT_OF_TIME

    rows, left = result.rows, result.planned - result.measured
    parts = [READING, table(rows)] if rows else []
    if left:
        why = "The time was up" if result.ending == OUT_OF_TIME else "Stopped"
        done = f"{result.measured} of {result.planned}"
        parts.append(f"{why} after {done} parts (a scene, its controls and a loss).")
    short = _short(rows)
    if short:
        parts.append(f"No estimator is good enough for {', '.join(short)}.")
    elif rows:
        parts.append("Every parameter so far has a good gradient." if left else "Every parameter has a good gradient.")
    time = wording.seconds_text(result.seconds["total"])
    return "\n\n".join([*parts, output.columns([["time", time], ["run", str(result.run)]])])


def _short(rows: Sequence[CheckedRow]) -> list[str]:
    """Names of what no estimator is good enough for, each once."""
    return list(dict.fromkeys(f"{row.name} ({row.status})" for row in _best(rows) if row.short))


def _best(rows: Sequence[CheckedRow]) -> list[CheckedRow]:
    """For each parameter and loss the row with the best status: an estimator that no plan would take may fall short.

    Of the model's loss the rows of whole controls count: what matters is where their gradient points.
    """
    from advsearch.runs.results.check import DirectionRow

    rows = [row for row in rows if row.loss == "linear" or isinstance(row, DirectionRow)]
    order = ("ok", "reference unusable", "noisy", "biased")
    best: dict[tuple[str, ...], CheckedRow] = {}
    for row in rows:
        key = row.object, row.environment, row.loss, row.control, row.parameter
        if key not in best or order.index(row.status) < order.index(best[key].status):
            best[key] = row
    return list(best.values())


def table(rows: Sequence[CheckedRow]) -> str:
    """Return the rows as text: one table for each loss."""
    from advsearch.runs.results.check import DerivativeRow, DirectionRow

    parts = []
    for loss, title in (
        ("linear", "smooth linear loss of the raw picture"),
        ("model", "the model's loss, each parameter in the setting that is taken"),
    ):
        single = [row for row in rows if row.loss == loss and isinstance(row, DerivativeRow)]
        if single:
            parts.append(f"{title}:\n" + output.columns([SINGLE, *map(_single, single)]))
    cosine = [row for row in rows if isinstance(row, DirectionRow)]
    if cosine:
        heads = ["object", "control", "estimator", "step", "samples", "cosine", "converged", "seconds", "status"]
        body = [
            [
                row.object,
                row.control,
                row.estimator,
                f"x {row.factor:.3g}",
                str(row.spp),
                f"{row.cosine:.3f}",
                f"{row.converged:.3f}",
                f"{row.seconds:.2f}",
                row.status,
            ]
            for row in cosine
        ]
        parts.append("the model's loss, cosine with the converged gradient:\n" + output.columns([heads, *body]))
    return "\n\n".join(parts)


def _single(row: DerivativeRow) -> list[str]:
    return [
        row.object,
        row.name,
        row.estimator,
        f"x {row.factor:.2g}",
        f"{row.gradient:.3g}",
        f"{row.reference:.3g} +- {row.reference_noise:.1g}",
        f"{100 * row.relative_error:.1f} %",
        f"{100 * row.noise:.0f} %",
        f"{row.seconds:.2f}",
        row.status,
    ]


COMMAND = QuestionCommand("check", answer, short=fell_short)
