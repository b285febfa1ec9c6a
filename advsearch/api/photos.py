"""Photographs of the real thing, aligned with a run's renderings: classified by its models, kept, and counted."""

from __future__ import annotations

import io
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from advsearch.attacks import clopper_pearson
from advsearch.config import AttackConfig, SweepConfig
from advsearch.described import Value
from advsearch.engine.answers import facts_of
from advsearch.engine.loading import PictureSettings, load_scene
from advsearch.engine.naming import load_models, scene_settings
from advsearch.engine.rows import judged
from advsearch.errors import FileFormatError, InputError
from advsearch.files import JsonObject
from advsearch.models import Model
from advsearch.runs.directory import CONFIG, IMAGES, RunDirectory, find_run
from advsearch.runs.files import write_bytes
from advsearch.runs.results.photos import PhotoAgreement, PhotographedRendering
from advsearch.runs.store import NAME, Row, Store
from advsearch.settings import read_yaml
from advsearch.tasks import Judgement, Task, make_task
from advsearch.tasks.base import Truth
from advsearch.viewer.photos import FOLDER, photo_name, rendering_file, sound_photo

KIND = "photo"
"""Rows of photographs in a run's store: `step` counts them, each model has a row for each."""


def photo_agreement(run: str | Path) -> PhotoAgreement:
    """Return how the photographs that were taken for a run agree with its renderings (docs/viewer.md).

    Args:
        run: a run's name or folder.

    Raises:
        UnknownNameError: there is no such run.
        FileFormatError: what was kept of a photograph is something else.
    """
    with Store(find_run(run) / NAME, read_only=True) as store:
        return _agreement(list(store.rows(KIND)))


class Photographs:
    """Takes photographs in for runs; one at a time, from any thread. The model of the last run stays loaded."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._judges = lru_cache(maxsize=1)(_judges_of)

    def add(self, run: Path, rendering: str, data: bytes) -> PhotoAgreement:
        """Classify a photograph by the models of a run, keep both beside the rendering, and return the new table.

        Args:
            run: its folder.
            rendering: the name of what the photograph was aligned with.
            data: the file as it was sent.

        Raises:
            InputError: there is no such rendering, it is no photograph, another process works on the run, or its task
                cannot judge photographs.
        """
        from PIL import Image

        file = rendering_file(run, rendering)
        with Image.open(file) as image:
            sound = sound_photo(data, image.size)
        with self._lock, RunDirectory.resume(run) as held:
            number = held.store.last_step(KIND) + 1
            name = photo_name(rendering, number)
            rows = []
            for place, judge in enumerate(self._judges(run)):
                seen = held.store.row("sweep", int(rendering) * judge.several + place) if rendering.isdigit() else None
                values: dict[str, Value] = {} if seen is None else dict(seen.values)
                truth = str(values["object"]["value"]) if "object" in values else judge.object
                right, label = _rendered(judge, truth, file, seen)
                kept: JsonObject = {"rendering": rendering, "right": right, "label": label, "file": name}
                values["model"] = {"value": judge.model.name, "unit": ""}
                row = judged(Row(KIND, number, values=values), judge.judgement(truth, sound))
                rows.append(replace(row, payload={"photo": kept, "answer": row.payload}))
            write_bytes(run / IMAGES / FOLDER / name, sound)
            held.record(*rows)
            return _agreement(list(held.store.rows(KIND)))

    def agreement(self, run: Path) -> PhotoAgreement:
        """Return the table of a run; see `photo_agreement`."""
        return photo_agreement(run)


# ---- judging --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _PhotoJudge:
    """One of a run's models, and how it is shown pictures.

    Attributes:
        config: of the run.
        object: what a rendering shows that says nothing else.
        model: loaded.
        task: on it.
        several: models that the run has.
    """

    config: AttackConfig | SweepConfig
    object: str
    model: Model
    task: Task
    several: int

    def judgement(self, name: str, data: bytes) -> Judgement:
        """What is to be said of a picture, (any size), of an object; it is made as large as the run's renderings are.

        The picture is resized in 8 bits with Lanczos' filter, which averages where it shrinks.
        """
        from PIL import Image

        config = self.config
        height, width = PictureSettings(config.resolution, "none", config.pixel_sampler, 0).size(self.model)
        with Image.open(io.BytesIO(data)) as image:
            small = image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
        pixels = torch.from_numpy(np.asarray(small, dtype=np.float32) / np.float32(255.0))
        with torch.no_grad():
            return self.task.judge(self.model(pixels), self._truth(name))[0]

    def _truth(self, name: str) -> Truth:
        config = self.config
        given = scene_settings(config.set_, config.exposure)
        scene = load_scene(name, up=config.up, settings=given, camera=config.camera)
        return self.task.truth(facts_of(scene, name, config.label, dict))


def _judges_of(run: Path) -> Sequence[_PhotoJudge]:
    command = read_yaml(run / CONFIG).get("command")
    if command not in ("attack", "sweep"):
        raise InputError(f"{run.name}: photographs belong to renderings of attacks and sweeps, not of {command}")
    config: AttackConfig | SweepConfig
    config = (AttackConfig if command == "attack" else SweepConfig).from_yaml(run / CONFIG)
    made = make_task(config.task)
    if made.varies:
        raise InputError(
            f"task {config.task_name}: what is right depends on where the object is seen, which a photograph does not "
            "say; photographs are judged for tasks such as classification"
        )
    models, _ = load_models(config.models, made, labels=config.labels, used_threads=config.used_threads)
    return [_PhotoJudge(config, config.objects[0], model, made.on(model), len(models)) for model in models]


def _rendered(judge: _PhotoJudge, name: str, file: Path, row: Row | None) -> tuple[bool, str]:
    """Whether the model is right on a rendering, and its answer: a sweep's as it was stored, others' by its file."""
    if row is not None:
        return bool(row.correct), row.label or ""
    if file.suffix != ".png":
        raise InputError(f"rendering: the results have no row for {file.stem}; it belongs to another run")
    judgement = judge.judgement(name, file.read_bytes())
    return judgement.right, judgement.answer.label


# ---- counting -------------------------------------------------------------------------------------------------------


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


def _kept(row: Row) -> JsonObject:
    kept = row.payload.get("photo") if isinstance(row.payload, dict) else None
    if not isinstance(kept, dict) or not {"rendering", "right", "label", "file"} <= set(kept):
        raise FileFormatError(f"row {row.id}: expected what was kept of a photograph, got something else")
    return kept
