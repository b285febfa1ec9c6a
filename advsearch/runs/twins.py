"""What a run of `twins` measured, for results of other commands.

A run of twins compares what a model says of photographs with what it says of their
renders. `find_twin_evidence` picks the conditions that are nearest to those of another
run: the same model and task, then the same object, then the same surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

from advsearch.errors import InputError
from advsearch.runs.directory import find_run
from advsearch.runs.results import (
    IN_PHOTOGRAPH,
    WITHOUT_OBJECT,
    Result,
    TwinAgreement,
    TwinEvidence,
    TwinMatch,
)
from advsearch.runs.summary import read_result

COMMAND = "twins"


def read_twins(run: str) -> Result:
    """Return the result of a run of twins.

    Args:
        run: its name or folder.

    Raises:
        InputError: there is none, or it is a run of another command.
    """
    result = read_result(find_run(run))
    if result.command != COMMAND:
        raise InputError(
            f"twins: expected a run of advsearch twins, got {run}, which is one of "
            f"{result.command}"
        )
    return result


def find_twin_evidence(
    run: str | None,
    *,
    model: str,
    task: str,
    object_name: str,
    environment: str,
    in_photograph: bool = False,
) -> TwinEvidence | None:
    """Return how well renders agreed with photographs, for conditions like those given.

    A run of `advsearch twins` compares a model's predictions on photographs with those
    on renders of the same scenes. The row of its table is chosen that is nearest to the
    conditions of another run.

    Args:
        run: name or folder of the run of twins; None if there is none.
        model: name of the model of the other run.
        task: name of the task of the other run.
        object_name: object of the other run, a bundled name or a file.
        environment: name of the environment of the other run.
        in_photograph: whether the other run renders into a photograph.

    Returns:
        The row, or why no row fits; None without a run of twins.

    Raises:
        InputError: there is no such run, or it is a run of another command.
    """
    if run is None:
        return None
    result = read_twins(run)
    table: Sequence[TwinAgreement] = getattr(result, "table", ())
    rows = [row for row in table if row.surroundings != WITHOUT_OBJECT]
    if not rows:
        return _make_empty(run, TwinMatch.NOTHING)
    rows = [row for row in rows if _name_model(row.model) == _name_model(model)]
    if not rows:
        return _make_empty(run, TwinMatch.OTHER_MODEL)
    rows = [row for row in rows if row.task == task]
    if not rows:
        return _make_empty(run, TwinMatch.OTHER_TASK)
    surroundings = IN_PHOTOGRAPH if in_photograph else environment
    stem = PurePath(object_name).stem
    # The nearest row is that of the same object, or else that of all objects together,
    # which has no object. Among several, it is that of the same surroundings, or else
    # one that is not in a photograph.
    row = max(
        (row for row in rows if not row.condition),
        # tuples are compared by the first entry in which they differ
        key=lambda row: (
            row.object == stem,
            not row.object,
            row.surroundings == surroundings,
            row.surroundings != IN_PHOTOGRAPH,
        ),
    )
    return TwinEvidence(
        run=run,
        match=TwinMatch.MEASURED,
        same_object=row.object == stem,
        same_surroundings=row.surroundings == surroundings,
        row=row,
    )


def _make_empty(run: str, match: TwinMatch) -> TwinEvidence:
    return TwinEvidence(
        run=run, match=match, same_object=False, same_surroundings=False, row=None
    )


def _name_model(model: str) -> str:
    """Return the name that a model is compared by: without folder and suffix."""
    return PurePath(model).stem
