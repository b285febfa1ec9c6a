"""The rows of a run that have a picture, with its file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

from advsearch.described import Value
from advsearch.errors import InputError
from advsearch.runs.directory import AOV_FOLDER, CONFIG, IMAGES
from advsearch.runs.fiftyone import Pictured
from advsearch.runs.results.attack import AttackSummary, PicturedAnswer
from advsearch.runs.results.base import Result
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import NAME, Row, Store
from advsearch.runs.summary import read_result
from advsearch.settings import read_yaml, split_names
from advsearch.viewer.thumbnails import kept_pictures, path_of


def pictured(run: Path) -> Iterator[Pictured]:
    """Yield the rows of a sweep or an attack whose pictures were kept.

    Raises:
        InputError: the run is another one.
        FileFormatError: it has not ended, or its results can't be read.
    """
    result = read_result(run)
    if isinstance(result, SweepSummary):
        yield from _swept(run, result)
    elif isinstance(result, AttackSummary):
        yield from _attacked(run, result)
    else:
        raise InputError(f"format fiftyone: belongs to runs of sweep and attack, not of {result.command}")


def name_of_object(run: Path) -> str:
    """Return what the object of a run is called."""
    result: Result = read_result(run)
    return str(getattr(result, "object", "object"))


def _swept(run: Path, summary: SweepSummary) -> Iterator[Pictured]:
    kept = kept_pictures(run)
    settings = read_yaml(run / CONFIG)
    models = len(split_names(str(settings.get("model", "one"))))
    formed = summary.image_formation
    size = formed.resolution if formed and (models == 1 or settings.get("resolution")) else None
    there = set(kept.numbers) if kept else set()
    with Store(run / NAME, read_only=True) as store:
        for row in store.rows("sweep"):
            number = row.step // models
            if number in there:
                layers = run / AOV_FOLDER / f"{number:06d}.exr"
                yield Pictured(str(number), row, path_of(run, number), layers if layers.is_file() else None, size)


def _attacked(run: Path, summary: AttackSummary) -> Iterator[Pictured]:
    size = summary.image_formation.resolution
    found = summary.configuration or {}
    values = {name: cast("Value", {"value": one.value, "unit": one.unit}) for name, one in found.items()}
    shown = [("clean", replace(_row("clean", summary.clean), correct=summary.clean.correct))]
    if summary.adversarial is not None:
        shown.append(("adversarial", replace(_row("adversarial", summary.adversarial), values=values)))
    kind = "baseline verification" if summary.answer_from else "verification"
    with Store(run / NAME, read_only=True) as store:
        trials = [
            (f"verification-{row.step:02d}", replace(row, values=values | dict(row.values))) for row in store.rows(kind)
        ]
    for name, row in (*shown, *trials):
        file = run / IMAGES / f"{name}.png"
        if file.is_file() and not file.is_symlink():
            yield Pictured(name, row, file, None, size)


def _row(kind: str, answer: PicturedAnswer) -> Row:
    """What a model says of a picture as a row."""
    probability = None if answer.probability is None or math.isnan(answer.probability) else answer.probability
    return Row(kind, 0, label=answer.label, label_index=answer.index, probability=probability, payload=answer.payload)
