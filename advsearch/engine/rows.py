"""Judgements as a run keeps them: rows of its store, there and back, and their counts in a summary."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from advsearch.attacks import Trials, Verification, count_right
from advsearch.described import NOT_A_NUMBER, Value
from advsearch.report.wording import count
from advsearch.runs.results.attack import ControlGroup, VerifiedRate
from advsearch.runs.store import Row
from advsearch.tasks import Answer, Judgement
from advsearch.tasks.base import mean

LOST = "(no answer)"
"""The answer to a picture that nobody could make; what the row keeps beside it says why."""


def no_answer(why: str) -> Judgement:
    """Return what stands for the answer to a picture that nobody could make: neither right nor a success, and why."""
    return Judgement(math.nan, math.nan, right=False, answer=Answer(LOST, None, None), payload={"lost": why})


def lost_remarks(lost: int) -> list[str]:
    """Return what a reader has to know of so many pictures that nobody could make."""
    if not lost:
        return []
    has, it = ("has", "it") if lost == 1 else ("have", "them")
    return [f"{count(lost, 'picture')} {has} no answer, which counts as not right: every worker that took {it} died."]


def trial_row(
    kind: str,
    number: int,
    seed: int | None,
    spp: int,
    trial: Judgement,
    values: Mapping[str, Value] | None = None,
    *,
    sought: bool = True,
    **more: Any,
) -> Row:
    """Return what the store keeps of a trial.

    Args:
        kind: of the rows.
        number: among these.
        seed: of its render; None of a picture that was predicted.
        spp: samples a pixel.
        trial: what came out.
        values: that describe it.
        sought: whether a search sought some answer there, so that there is a success.
        **more: of the row.
    """
    return Row(
        kind=kind,
        step=number,
        seed=seed,
        spp=spp,
        objective=_number(trial.objective),
        success=trial.success if sought else None,
        values=values or {},
        **{"renders": 1, **_said(trial), **more},
    )


def judged(row: Row, judgement: Judgement) -> Row:
    """Return the row with what a task said of its picture."""
    return replace(row, **_said(judgement))


def _said(judgement: Judgement) -> dict[str, Any]:
    answer = judgement.answer
    return {
        "score": _number(judgement.score),
        "correct": judgement.right,
        "margin": _number(judgement.margin),
        "label": None if judgement.not_a_number else answer.label,
        "label_index": answer.index,
        "probability": answer.probability,
        "payload": judgement.payload,
        "metrics": judgement.metrics or {},
    }


def _number(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value


def judgement_of(row: Row) -> Judgement:
    """Return what was said of a trial from its row: nothing where it has no label, for the answer was not a number.

    In an old row, only the score says whether it was right.
    """
    score, margin = (math.nan if one is None else one for one in (row.score, row.margin))
    right = score <= 0.0 if row.correct is None else row.correct
    answer = Answer(row.label or NOT_A_NUMBER, row.label_index, row.probability)
    return Judgement(score, margin, right, answer, row.payload, row.objective, row.metrics or None)


def verified_rate(checked: Verification) -> VerifiedRate:
    """Return the rate of a success, with how often each such answer was given and the mean score of the trials."""
    rated = rate_of(checked.adversarial, checked.counting, checked.successes)
    return rated.model_copy(update={"stopped": checked.stopped})


def rate_of(rate: Trials, trials: Sequence[Judgement], successes: Sequence[Judgement]) -> VerifiedRate:
    """Return a rate with the answers of its successes and the mean score of those that are a number."""
    labels = Counter(trial.answer.label for trial in successes)
    return VerifiedRate(
        successes=rate.successes,
        trials=rate.trials,
        rate=rate.rate,
        interval=rate.interval,
        spp=rate.spp,
        labels=dict(labels.most_common()),
        margin=mean_number(trial.score for trial in trials),
        not_a_number=sum(trial.not_a_number for trial in trials),
    )


def control_group(trials: Sequence[Judgement], spp: int) -> ControlGroup:
    """Return how many trials of the clean scene are right."""
    counted, nothing = count_right(trials, spp), sum(trial.not_a_number for trial in trials)
    rate, interval = counted.rate, counted.interval
    return ControlGroup(
        correct=counted.successes, trials=counted.trials, rate=rate, interval=interval, not_a_number=nothing
    )


def mean_number(values: Iterable[float]) -> float:
    """Return the mean of those that are numbers; NaN where none is."""
    numbers = [value for value in values if not math.isnan(value)]
    return mean(numbers) if numbers else math.nan
