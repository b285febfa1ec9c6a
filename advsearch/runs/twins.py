"""Find out how far the results of a run hold for photographs, by a run of `twins`.

A twin is a render of the scene in a photograph. A run of `advsearch twins` compares the
predictions of a model for photographs and for their twins. `find_twin_evidence` selects
the measurement whose conditions are most similar to those of another run: the same
model and task, then the same object, then the same surroundings.
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
    """Return the result of a run of the command `twins`.

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
    """Return how well renders agree with photographs, for conditions like those of a run.

    A run of `advsearch twins` compares a model's predictions for photographs with those
    for renders of the same scenes. From its table the row is selected whose conditions
    are most similar to those of another run.

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
    rows = _read_rows_with_object(run)
    model_name = _name_model(model)
    rows_of_model = [row for row in rows if _name_model(row.model) == model_name]
    rows_of_task = [row for row in rows_of_model if row.task == task]
    if not rows_of_task:
        return _make_empty(run, _explain_no_row(rows, rows_of_model))
    surroundings = IN_PHOTOGRAPH if in_photograph else environment
    object_stem = PurePath(object_name).stem
    row = _select_most_similar(rows_of_task, object_stem, surroundings)
    return TwinEvidence(
        run=run,
        match=TwinMatch.MEASURED,
        same_object=row.object == object_stem,
        same_surroundings=row.surroundings == surroundings,
        row=row,
    )


def _read_rows_with_object(run: str) -> list[TwinAgreement]:
    """Return the rows with the object in view of the table of a run of twins.

    Args:
        run: name or folder of the run.
    """
    table: Sequence[TwinAgreement] = getattr(read_twins(run), "table", ())
    return [row for row in table if row.surroundings != WITHOUT_OBJECT]


def _select_most_similar(
    rows: Sequence[TwinAgreement], object_stem: str, surroundings: str
) -> TwinAgreement:
    """Return the row whose conditions are most similar to those of another run.

    A row with a condition is about a part of the photographs. For each model and task
    the table also has rows without one, about all of them; only these are compared.

    Args:
        rows: rows of one model and one task.
        object_stem: name of the other run's object.
        surroundings: environment of the other run, or `IN_PHOTOGRAPH`.
    """
    return max(
        (row for row in rows if not row.condition),
        key=lambda row: _rank_similarity(row, object_stem, surroundings),
    )


def _explain_no_row(
    rows: Sequence[TwinAgreement], rows_of_model: Sequence[TwinAgreement]
) -> TwinMatch:
    """Return why no row of a run of twins is about the model and the task.

    Args:
        rows: all rows with the object in view.
        rows_of_model: those about the model.
    """
    if not rows:
        return TwinMatch.NOTHING
    return TwinMatch.OTHER_TASK if rows_of_model else TwinMatch.OTHER_MODEL


def _rank_similarity(
    row: TwinAgreement, object_stem: str, surroundings: str
) -> tuple[bool, ...]:
    """Return how similar the conditions of a row are, as a key for sorting.

    The first entry counts most: the same object, all objects together, the same
    surroundings, and any environment rather than a photograph.

    Args:
        row: row of the table of a run of twins.
        object_stem: name of the object to compare with.
        surroundings: environment to compare with, or `IN_PHOTOGRAPH`.
    """
    is_of_all_objects = not row.object
    return (
        row.object == object_stem,
        is_of_all_objects,
        row.surroundings == surroundings,
        row.surroundings != IN_PHOTOGRAPH,
    )


def _make_empty(run: str, match: TwinMatch) -> TwinEvidence:
    return TwinEvidence(
        run=run, match=match, same_object=False, same_surroundings=False, row=None
    )


def _name_model(model: str) -> str:
    """Return the name that a model is compared by: without folder and suffix."""
    return PurePath(model).stem
