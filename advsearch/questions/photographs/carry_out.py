"""Photographs of the real thing, aligned with a run's renderings: judged by its models
and task, kept, and counted.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from PIL import Image
from pydantic import JsonValue

from advsearch.extend import (
    AttackConfig,
    InputError,
    Model,
    RunDirectory,
    Store,
    SweepConfig,
    Task,
    directory,
    errors,
    markup,
    seeds,
    settings,
    statistics,
    stored_files,
    tasks,
    workbench,
    writing,
)
from advsearch.questions.photographs import result
from advsearch.questions.photographs.result import (
    LOOSE_PHOTO,
    PHOTO,
    PhotoAgreement,
    PhotographedRendering,
)

# of the files in a folder that are photographs
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
_ALIGNED = re.compile(r"rendering-([0-9]{1,12})(?:-.*)?")
"""The name of a file with a photograph that was aligned with a rendering."""


@workbench.helped
def photo_agreement(run: str | Path) -> PhotoAgreement:
    """Return how the photographs that were taken for a run agree with its renderings
    (docs/viewer.md).

    Args:
        run: a run's name or folder.

    Raises:
        UnknownNameError: there is no such run.
        FileFormatError: what was kept of a photograph is something else.
    """
    kept = ["rendering", "right", "label", "file"]
    rows = list[dict[str, object]]()
    with workbench.in_turn(), Store.open_to_read(directory.find_run(run)) as store:
        for row in store.rows(PHOTO):
            if not {*kept} <= (photo := _photo_of(row)).keys():
                raise errors.FileFormatError(
                    f"row {row.id}: expected what was kept of a photograph, got "
                    "something else"
                )
            model = str(row.values["model"]["value"]) if "model" in row.values else ""
            said = {
                "model": model,
                "correct": bool(row.correct),
                "said": row.label or "",
            }
            rows.append({**photo, "right": bool(photo["right"]), **said})
    table = pd.DataFrame(rows, columns=[*kept, "model", "correct", "said"])
    table["agrees"] = table["right"] == table["correct"]
    four = table.groupby(["right", "correct"]).size()
    agreeing = int(table["agrees"].sum())
    words = {True: "right", False: "wrong"}
    counts = {
        f"{words[a]}_{words[b]}": int(four.get((a, b), 0)) for a in words for b in words
    }
    renderings = []
    for (name, model), group in table.groupby(["rendering", "model"], sort=False):
        photos = len(group)
        last = group.iloc[-1]
        alike = int(group["agrees"].sum())
        renderings.append(
            PhotographedRendering(
                rendering=str(name), model=str(model), label=str(last["label"]), rendering_right=bool(last["right"]),
                photos=photos, photos_right=int(group["correct"].sum()), agreeing=alike,
                interval=statistics.intervals.clopper_pearson(alike, photos), labels=list(group["said"]),
                files=list(map(str, group["file"])),
            )
        )  # fmt: skip
    interval = (
        statistics.intervals.clopper_pearson(agreeing, len(table)) if rows else None
    )
    agreement = agreeing / len(table) if rows else None
    return PhotoAgreement(
        photos=len(table),
        agreement=agreement,
        interval=interval,
        renderings=renderings,
        **counts,
    )


def _photo_of(row: workbench.Row) -> dict[str, Any]:
    """What was kept of a photograph: its file, `source` of one that was no browser's,
    and what its rendering says.
    """
    photo = row.payload.get("photo") if isinstance(row.payload, dict) else None
    return photo if isinstance(photo, dict) else {}


def photographs_in(folder: Path, task: workbench.AnyTask) -> list[Path]:
    """Return the files in a folder that are photographs by their names; none where
    there is no such folder. An InputError where the task asks where the object is, and
    one of them was aligned with no rendering.
    """
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    photographs = [
        file for file in files if file.suffix.lower() in SUFFIXES and file.is_file()
    ]
    loose = [file for file in photographs if not _ALIGNED.fullmatch(file.stem)]
    if (
        loose
        and (made := workbench.make_task(task))
        and (made.varies or made.calibrates)
    ):
        raise InputError(
            f"{loose[0].name}: the task asks where the object is, and only a rendering "
            "says that; name the file "
            "rendering-NUMBER.jpg by the rendering that it was aligned with, or take "
            "it out"
        )
    return photographs


class Photographs:
    """Takes photographs in for runs; one at a time, from any thread. What the last run
    was about stays loaded.

    Attributes:
        row_kinds: the kinds of rows that photographs have in the results of a run.
    """

    row_kinds = (PHOTO, LOOSE_PHOTO)

    def __init__(self) -> None:
        self._judges = lru_cache(maxsize=1)(_judges_of)
        # a scene is used by the thread that has loaded it
        self._thread = ThreadPoolExecutor(1, "photographs")

    def add(self, run: Path, rendering: str, data: bytes) -> PhotoAgreement:
        """Judge a photograph by the models and the task of a run, keep both beside the
        rendering that it was aligned with, and return the table. An InputError where
        there is no such rendering, it is no photograph, another process works on the
        run, or its scene is another one now.
        """
        self._thread.submit(self._add, run, rendering, data, "").result()
        return photo_agreement(run)

    def add_files(self, run: Path, files: Sequence[Path]) -> None:
        """Judge the photographs in some files that the run, a sweep of one object, does
        not have yet, by their names. A file ``rendering-12.jpg``, or ``rendering-12-``
        and anything, was aligned with the rendering 12. All others show the object as
        it stood by chance: they are judged, but are compared with no single rendering.
        """
        with Store.open_to_read(run) as store:
            known = {
                _photo_of(row).get("source")
                for kind in (PHOTO, LOOSE_PHOTO)
                for row in store.rows(kind)
            }
        for file in (file for file in files if file.name not in known):
            aligned = _ALIGNED.fullmatch(file.stem)
            data = stored_files.read_bytes(file, "a photograph", markup.LARGEST_SENT)
            try:
                self._thread.submit(
                    self._add, run, aligned and aligned[1], data, file.name
                ).result()
            except InputError as error:
                raise InputError(f"{file.name}: {error}") from None

    def agreement(self, run: Path) -> PhotoAgreement:
        return photo_agreement(run)

    @staticmethod
    def list_files(folder: Path, task: workbench.AnyTask) -> list[Path]:
        """Return the files in a folder that are photographs; errors as for
        `photographs_in`.
        """
        return photographs_in(folder, task)

    def _add(self, run: Path, rendering: str | None, data: bytes, source: str) -> None:
        """Judge and keep a photograph of the file `source`; without a rendering only
        what the models say is kept.
        """
        file = None
        kind = PHOTO if rendering else LOOSE_PHOTO
        sound = b""
        kept = dict[str, JsonValue](source=source)
        if rendering is not None:
            file = result.rendering_file(run, rendering)
            with Image.open(file, formats=("PNG", "JPEG")) as image:
                # before anything is loaded
                sound = result.sound_photo(data, image.size)
        with RunDirectory.resume(run) as held:
            number = held.store.last_step(kind) + 1
            rows = []
            judges = self._judges(run)
            for place, judge in enumerate(judges):
                values: dict[str, workbench.Value] = {}
                if file is None or rendering is None:
                    sound = result.sound_photo(data, judge.size[::-1])
                else:
                    step = (
                        int(rendering) * len(judges) + place
                        if rendering.isdigit()
                        else None
                    )
                    seen = None if step is None else held.store.row("sweep", step)
                    # a sweep's prediction as it was stored, others' by its file
                    if seen is not None:
                        right = bool(seen.correct)
                        label = seen.label or ""
                        values = dict(seen.values)
                    elif file.suffix == ".png":
                        rendered = judge.judgement(rendering, None, file.read_bytes())
                        right = rendered.right
                        label = rendered.prediction.label
                    else:
                        raise InputError(
                            f"rendering: the results have no row for {file.stem}; it "
                            "belongs to another run"
                        )
                    kept |= {"rendering": rendering, "right": right, "label": label}
                    kept["file"] = f"{rendering}-{number:04d}.jpg"
                # of a sweep over several
                shown = str(values["object"]["value"]) if "object" in values else None
                values["model"] = {"value": judge.model.name, "unit": ""}
                row = workbench.judged(
                    workbench.Row(kind, number, values=values),
                    judge.judgement(rendering, shown, sound),
                )
                rows.append(
                    replace(row, payload={"photo": {**kept}, "answer": row.payload})
                )
            if file is not None:
                writing.write_bytes(
                    run / directory.PHOTOGRAPHS / str(kept["file"]), sound
                )
            held.record(*rows)


@dataclass(frozen=True)
class _PhotoJudge:
    """One of a run's models with its task, how large (height, width) pictures it is
    shown are, and what is true of a photograph by the rendering that it was aligned
    with and the object on it, None for the only ones.
    """

    model: Model
    task: Task
    size: tuple[int, int]
    truth: Callable[[str | None, str | None], workbench.Truth]

    def judgement(
        self, rendering: str | None, name: str | None, data: bytes
    ) -> tasks.Judgement:
        """What is to be said of a picture, made as large as the run's renderings are:
        in 8 bits, with Lanczos' filter, which averages where it shrinks.
        """
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            small = image.convert("RGB").resize(
                self.size[::-1], Image.Resampling.LANCZOS
            )
        pixels = torch.from_numpy(
            np.asarray(small, dtype=np.float32) / np.float32(255.0)
        )
        with torch.no_grad():
            return workbench.judgements(
                self.task,
                self.model(pixels),
                pixels[None],
                [self.truth(rendering, name)],
            )[0]


def _judges_of(run: Path) -> list[_PhotoJudge]:
    """Who judges photographs of a run; where an object is seen is judged by the
    rendering that it was aligned with.
    """
    command = settings.read_yaml(run / directory.CONFIG).get("command")
    if command == "sweep":
        return _by_sweep(SweepConfig.from_yaml(run / directory.CONFIG))
    if command == "attack":
        return _by_attack(run, AttackConfig.from_yaml(run / directory.CONFIG))
    raise InputError(
        f"{run.name}: photographs belong to renderings of attacks and "
        f"sweeps, not of {command}"
    )


def _by_sweep(config: SweepConfig) -> list[_PhotoJudge]:
    scenes = workbench.scenes_of(config)
    job = scenes.job

    def truth(model: int, rendering: str | None, name: str | None) -> workbench.Truth:
        task = job.tasks[model]
        if rendering is None or not (task.varies or task.calibrates):
            place = next(
                (place for place in job.places if place.object == name), job.places[0]
            )
            return task.truth(job.facts(place, {}))
        number = int(rendering)
        if number >= job.per_scene * len(job.places):
            raise InputError(
                f"rendering: the sweep has no picture {rendering}; it "
                "belongs to another run"
            )
        scene, queries = scenes.asked(number)
        return scene.problems[model].truth(queries[model].u, queries[model].values)

    each = enumerate(zip(job.models, job.tasks, job.sizes, strict=True))
    return [
        _PhotoJudge(model, task, size, partial(truth, number))
        for number, (model, task, size) in each
    ]


def _by_attack(run: Path, config: AttackConfig) -> list[_PhotoJudge]:
    problem, _ = workbench.problem_from_config(workbench.judged_alone(config))

    def truth(task: Task, rendering: str | None, _: str | None) -> workbench.Truth:
        """Of the clean configuration, of the adversarial one, or of one of its
        trials.
        """
        known = rendering in (None, "clean") or not (task.varies or task.calibrates)
        u = (
            problem.domain.start
            if known
            else workbench.kept_configuration(run, problem)
        )
        trial = (rendering or "").rpartition("verification-")[2]
        whole = problem.whole(
            u,
            seeds.stream(problem.seed, "verification", int(trial))
            if trial.isdigit()
            else None,
        )
        look = partial(problem.renderer.surfaces, whole)
        return task.truth(problem.facts(partial(problem.space.describe, whole), look))

    alone: list[tuple[Model, Task]] = [(problem.model, problem.task)]
    if isinstance(problem.task, workbench.Together):
        alone = list(zip(problem.task.models, problem.task.tasks, strict=True))
    size = config.resolution
    return [
        _PhotoJudge(model, task, size or model.input_size, partial(truth, task))
        for model, task in alone
    ]
