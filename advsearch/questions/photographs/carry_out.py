"""Photographs of the real thing, aligned with a run's renderings: judged by its models and task, kept, and counted."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from advsearch import seeds
from advsearch.attacks import clopper_pearson
from advsearch.calls import helped
from advsearch.config import AttackConfig, SweepConfig
from advsearch.described import Value
from advsearch.engine.attack_parts import judged_alone, problem_from_config
from advsearch.engine.judging import facts_of, judgements
from advsearch.engine.naming import in_turn, load_models, scene_of
from advsearch.engine.record import judged
from advsearch.engine.verifier import kept_answer
from advsearch.errors import FileFormatError, InputError
from advsearch.files import JsonObject, read_bytes
from advsearch.models import Model
from advsearch.questions.photographs.answer import (
    FOLDER,
    LARGEST,
    LOOSE_PHOTO,
    PHOTO,
    PhotoAgreement,
    PhotographedRendering,
    photo_name,
    rendering_file,
    sound_photo,
)
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.runs.directory import CONFIG, IMAGES, RunDirectory, find_run
from advsearch.runs.files import write_bytes
from advsearch.runs.store import NAME, Row, Store
from advsearch.settings import read_yaml
from advsearch.tasks import AnyTask, Judgement, Task, make_task
from advsearch.tasks.base import Truth
from advsearch.tasks.together import Together

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
"""Of the files in a folder that are photographs."""

_ALIGNED = re.compile(r"rendering-([0-9]{1,12})(?:-.*)?")
"""The name of a file with a photograph that was aligned with a rendering."""


@helped
@in_turn()
def photo_agreement(run: str | Path) -> PhotoAgreement:
    """Return how the photographs that were taken for a run agree with its renderings (docs/viewer.md).

    Args:
        run: a run's name or folder.

    Raises:
        UnknownNameError: there is no such run.
        FileFormatError: what was kept of a photograph is something else.
    """
    with Store(find_run(run) / NAME, read_only=True) as store:
        return _agreement(list(store.rows(PHOTO)))


def photographs_in(folder: Path, task: AnyTask) -> list[Path]:
    """Return the files in a folder that are photographs by their names; none where there is no such folder.

    Raises:
        InputError: the task asks where the object is, and one of them was aligned with no rendering.
    """
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    found = [file for file in files if file.suffix.lower() in SUFFIXES and file.is_file()]
    loose = [file for file in found if not _ALIGNED.fullmatch(file.stem)]
    if loose and (made := make_task(task)) and (made.varies or made.looks):
        raise InputError(
            f"{loose[0].name}: the task asks where the object is, and only a rendering says that; name the file "
            "rendering-NUMBER.jpg by the rendering that it was aligned with, or take it out"
        )
    return found


class Photographs:
    """Takes photographs in for runs; one at a time, from any thread. What the last run was about stays loaded."""

    def __init__(self) -> None:
        self._judges = lru_cache(maxsize=1)(_judges_of)
        self._thread = ThreadPoolExecutor(1, "photographs")  # a scene is used by the thread that has loaded it

    def add(self, run: Path, rendering: str, data: bytes) -> PhotoAgreement:
        """Judge a photograph by the models and the task of a run, keep both beside the rendering that it was aligned
        with, and return the table.

        Raises:
            InputError: there is no such rendering, it is no photograph, another process works on the run, or its scene
                is another one now.
        """
        return self._thread.submit(self._add, run, rendering, data, "").result()

    def add_files(self, run: Path, files: Sequence[Path]) -> None:
        """Judge the photographs among some files that the run, of a sweep of one object, does not have yet, by their
        names.

        A file ``rendering-12.jpg``, or ``rendering-12-`` and anything, was aligned with the rendering 12. All others
        show the object as it stood by chance: they are judged, but are compared with no single rendering. Errors are
        those of `add`.
        """
        with Store(run / NAME, read_only=True) as store:
            known = {_source(row) for kind in (PHOTO, LOOSE_PHOTO) for row in store.rows(kind)}
        for file in files:
            if file.name in known:
                continue
            aligned = _ALIGNED.fullmatch(file.stem)
            add = partial(self._add, run, aligned[1]) if aligned else partial(self._add_loose, run)
            data = read_bytes(file, "a photograph", LARGEST)
            try:
                self._thread.submit(add, data, file.name).result()
            except InputError as error:
                raise InputError(f"{file.name}: {error}") from None

    def _add(self, run: Path, rendering: str, data: bytes, source: str) -> PhotoAgreement:
        """Judge and keep a photograph that was aligned with a rendering; `source` is the name of its file."""
        file = rendering_file(run, rendering)
        with Image.open(file, formats=("PNG", "JPEG")) as image:
            sound = sound_photo(data, image.size)
        with RunDirectory.resume(run) as held:
            number = held.store.last_step(PHOTO) + 1
            name = photo_name(rendering, number)
            rows = []
            for place, judge in enumerate(self._judges(run)):
                seen = held.store.row("sweep", int(rendering) * judge.several + place) if rendering.isdigit() else None
                values: dict[str, Value] = {} if seen is None else dict(seen.values)
                truth = str(values["object"]["value"]) if "object" in values else judge.object
                right, label = _rendered(judge, rendering, truth, file, seen)
                kept: JsonObject = {"rendering": rendering, "right": right, "label": label, "file": name}
                values["model"] = {"value": judge.model.name, "unit": ""}
                row = judged(Row(PHOTO, number, values=values), judge.judgement(rendering, truth, sound))
                rows.append(replace(row, payload={"photo": {**kept, "source": source}, "answer": row.payload}))
            write_bytes(run / IMAGES / FOLDER / name, sound)
            held.record(*rows)
            return _agreement(list(held.store.rows(PHOTO)))

    def _add_loose(self, run: Path, data: bytes, source: str) -> None:
        """Judge a photograph that was aligned with no rendering; only what the models say of it is kept."""
        with RunDirectory.resume(run) as held:
            number = held.store.last_step(LOOSE_PHOTO) + 1
            rows = []
            for judge in self._judges(run):
                values: dict[str, Value] = {"model": {"value": judge.model.name, "unit": ""}}
                sound = sound_photo(data, judge.size[::-1])
                row = judged(Row(LOOSE_PHOTO, number, values=values), judge.judgement("", judge.object, sound))
                rows.append(replace(row, payload={"photo": {"source": source}, "answer": row.payload}))
            held.record(*rows)

    def agreement(self, run: Path) -> PhotoAgreement:
        """Return the table of a run; see `photo_agreement`."""
        return photo_agreement(run)


@dataclass(frozen=True)
class _PhotoJudge:
    """One of a run's models, and how it is shown pictures.

    Attributes:
        object: what a rendering shows that says nothing else.
        task: on the model.
        size: (height, width) of the run's renderings, in pixels.
        several: models that the run has.
        truth: what is true of a photograph, by the rendering that it was aligned with and the object.
    """

    object: str
    model: Model
    task: Task
    size: tuple[int, int]
    several: int
    truth: Callable[[str, str], Truth]

    def judgement(self, rendering: str, name: str, data: bytes) -> Judgement:
        """What is to be said of a picture, (any size), of an object; it is made as large as the run's renderings are.

        The picture is resized in 8 bits with Lanczos' filter, which averages where it shrinks.
        """
        height, width = self.size
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            small = image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
        pixels = torch.from_numpy(np.asarray(small, dtype=np.float32) / np.float32(255.0))
        truth = self.truth(rendering, name)
        with torch.no_grad():
            (said,) = judgements(self.task, self.model(pixels), pixels[None], [truth])
        return said


def _judges_of(run: Path) -> Sequence[_PhotoJudge]:
    """Who judges the photographs of a run. What depends on where the object is seen is judged by where the rendering
    has it, with which the photograph was aligned."""
    command = read_yaml(run / CONFIG).get("command")
    if command not in ("attack", "sweep"):
        raise InputError(f"{run.name}: photographs belong to renderings of attacks and sweeps, not of {command}")
    config: AttackConfig | SweepConfig
    config = (AttackConfig if command == "attack" else SweepConfig).from_yaml(run / CONFIG)
    made = make_task(config.task)
    if made.varies or made.looks:
        return _by_sweep(config) if isinstance(config, SweepConfig) else _by_attack(run, config)
    models, _ = load_models(config.models, made, config)
    judges = []
    for model in models:
        task = made.on(model)

        def truth(rendering: str, name: str, task: Task = task) -> Truth:
            return task.truth(facts_of(scene_of(config, name), name, config.label, dict))

        judges.append(
            _PhotoJudge(config.objects[0], model, task, config.resolution or model.input_size, len(models), truth)
        )
    return judges


def _by_sweep(config: SweepConfig) -> Sequence[_PhotoJudge]:
    """Who judges by the configurations of a sweep."""
    scenes = scenes_of(config)
    job = scenes.job

    def truth(model: int, rendering: str, name: str) -> Truth:
        number = int(rendering)
        if number >= job.per_scene * len(job.places):
            raise InputError(f"rendering: the sweep has no picture {rendering}; it belongs to another run")
        scene, _, query = job.queries(range(number, number + 1))[model]
        return scenes.named(scene).problems[model].truth(query.u, query.values)

    return [
        _PhotoJudge(config.objects[0], model, task, size, len(job.models), partial(truth, number))
        for number, (model, task, size) in enumerate(zip(job.models, job.tasks, job.sizes, strict=True))
    ]


def _by_attack(run: Path, config: AttackConfig) -> Sequence[_PhotoJudge]:
    """Who judges by the configurations of an attack: the clean one, the answer, and those of its trials."""
    problem, _ = problem_from_config(judged_alone(config))
    task = problem.task
    alone = (task.models, task.tasks) if isinstance(task, Together) else ((problem.model,), (task,))

    def truth(own: Task, rendering: str, name: str) -> Truth:
        u = problem.domain.start if rendering == "clean" else kept_answer(run, problem)
        trial = rendering.rpartition("verification-")[2]
        whole = problem.whole(u, seeds.stream(problem.seed, "verification", int(trial)) if trial.isdigit() else None)
        look = partial(problem.renderer.surfaces, whole)
        return own.truth(problem.facts(partial(problem.space.describe, whole), look))

    return [
        _PhotoJudge(
            config.object, model, own, config.resolution or model.input_size, len(alone[0]), partial(truth, own)
        )
        for model, own in zip(*alone, strict=True)
    ]


def _rendered(judge: _PhotoJudge, rendering: str, name: str, file: Path, row: Row | None) -> tuple[bool, str]:
    """Whether the model is right on a rendering, and its answer: a sweep's as it was stored, others' by its file."""
    if row is not None:
        return bool(row.correct), row.label or ""
    if file.suffix != ".png":
        raise InputError(f"rendering: the results have no row for {file.stem}; it belongs to another run")
    judgement = judge.judgement(rendering, name, file.read_bytes())
    return judgement.right, judgement.answer.label


def _agreement(rows: Sequence[Row]) -> PhotoAgreement:
    counts = {(rendered, photographed): 0 for rendered in (True, False) for photographed in (True, False)}
    groups: dict[tuple[str, str], list[tuple[Row, JsonObject]]] = {}
    for row in rows:
        kept = _kept(row)
        counts[bool(kept["right"]), bool(row.correct)] += 1
        model = str(row.values["model"]["value"]) if "model" in row.values else ""
        groups.setdefault((str(kept["rendering"]), model), []).append((row, kept))
    agreeing = counts[True, True] + counts[False, False]
    return PhotoAgreement(
        photos=len(rows),
        right_right=counts[True, True],
        right_wrong=counts[True, False],
        wrong_right=counts[False, True],
        wrong_wrong=counts[False, False],
        agreement=agreeing / len(rows) if rows else None,
        interval=clopper_pearson(agreeing, len(rows)) if rows else None,
        renderings=[_rendering(name, model, group) for (name, model), group in groups.items()],
    )


def _rendering(name: str, model: str, group: Sequence[tuple[Row, JsonObject]]) -> PhotographedRendering:
    agreeing = sum(bool(row.correct) == bool(kept["right"]) for row, kept in group)
    return PhotographedRendering(
        rendering=name,
        model=model,
        label=str(group[-1][1]["label"]),
        rendering_right=bool(group[-1][1]["right"]),
        photos=len(group),
        photos_right=sum(bool(row.correct) for row, _ in group),
        agreeing=agreeing,
        interval=clopper_pearson(agreeing, len(group)),
        labels=[row.label or "" for row, _ in group],
        files=[str(kept["file"]) for _, kept in group],
    )


def _source(row: Row) -> str:
    """The name of the file that a photograph came from; empty for one from a browser."""
    photo = row.payload.get("photo") if isinstance(row.payload, dict) else None
    return str(photo.get("source", "")) if isinstance(photo, dict) else ""


def _kept(row: Row) -> JsonObject:
    kept = row.payload.get("photo") if isinstance(row.payload, dict) else None
    if not isinstance(kept, dict) or not {"rendering", "right", "label", "file"} <= set(kept):
        raise FileFormatError(f"row {row.id}: expected what was kept of a photograph, got something else")
    return kept
