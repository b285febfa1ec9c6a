"""Robust accuracy against epsilon: attacks on several objects with several epsilons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from advsearch.api.studies import SETTLED, StudyRun, carry_out_study
from advsearch.attacks import clopper_pearson
from advsearch.attacks.verification import WORST_CASE
from advsearch.config import AttackConfig
from advsearch.engine.transport import CleanMatrix
from advsearch.progress import Progress
from advsearch.questions.attack.answer import CurvePoint, CurveResult, ObjectRow
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.study import StudyResult


def curve_from_config(
    config: AttackConfig, *, progress: Progress | None = None, resumed: Path | None = None
) -> CurveResult:
    """Robust accuracy against epsilon, over objects.

    The epsilons are tried from the smallest. An object that flips at one of them flips at every larger one, whose ball
    has the same configuration in it, so it is not attacked again. An object that is wrong as it is counts as not robust
    at any epsilon, and is told apart from those that were found.

    Args:
        config: with one or several objects and epsilons.
        progress: told how far it is.
        resumed: folder of the run to go on with.
    """
    epsilons: Sequence[float | None] = sorted(config.epsilons) or [None]

    def result(rows: list[ObjectRow], common: StudyResult) -> CurveResult:
        curve = [_accuracy(rows, epsilon) for epsilon in epsilons]
        return CurveResult(**vars(common), epsilons=list(epsilons), table=rows, curve=curve)

    return carry_out_study(config, _curve, result, progress, resumed)


def _curve(study: StudyRun) -> list[ObjectRow]:
    rows = []
    for chain in study.chains:
        row, clean = ObjectRow(object=chain[0].of, clean=None, flips_at=None), CleanMatrix()
        renders: Counter[str] = Counter()
        for one in chain:
            summary = study.attack(one, clean)
            if summary is None:
                break
            renders.update(summary.renders)
            row = _seen(one.of, summary, one.epsilon).model_copy(update={"renders": dict(renders)})
            if row.ending in SETTLED:
                break
        rows.append(row)
    return rows


def _seen(name: str, summary: AttackSummary, tried: float | None) -> ObjectRow:
    epsilon = summary.epsilon if tried is None else tried
    return ObjectRow(
        object=name,
        clean=summary.clean.control,
        ending=summary.ending,
        epsilon=epsilon,
        flips_at=epsilon if summary.ending == "found" else None,
        verified=summary.verified,
        margin=summary.verified.margin if summary.verified else None,
        run=summary.run,
        tried=tried,
    )


def _known(row: ObjectRow, epsilon: float | None) -> bool:
    """Whether a row says anything about an epsilon: it was tried there, or had flipped before.

    What ended without a number says nothing, and neither does an object that its own noise makes wrong too often for
    any answer to be verified.
    """
    if row.ending in (None, "non-finite objective"):
        return False
    if row.ending in SETTLED:
        return True
    steady = row.clean is not None and row.clean.correct >= WORST_CASE.needed(row.clean.trials)
    return steady and (epsilon is None or (row.tried is not None and row.tried >= epsilon))


def _accuracy(rows: Sequence[ObjectRow], epsilon: float | None) -> CurvePoint:
    """How many objects are still recognised at an epsilon."""
    known = [row for row in rows if _known(row, epsilon)]
    wrong = sum(row.ending == "already wrong" for row in known)
    found = sum(row.ending == "found" and _flips_within(row, epsilon) for row in known)
    robust = len(known) - wrong - found
    return CurvePoint(
        epsilon=epsilon,
        objects=len(known),
        robust=robust,
        found=found,
        already_wrong=wrong,
        accuracy=robust / len(known) if known else None,
        interval=clopper_pearson(robust, len(known)) if known else (0.0, 1.0),
    )


def _flips_within(row: ObjectRow, epsilon: float | None) -> bool:
    return epsilon is None or (isinstance(row.flips_at, float) and row.flips_at <= epsilon)
