"""The pictures of a run as a dataset to look at, to label and to train on: at the size that the model sees, rendered
again from what the rows say, with every thing in them that has a name: as COCO's JSON, or for trainers of YOLO."""

from __future__ import annotations

import json
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

import advsearch
from advsearch.config import SceneConfig
from advsearch.engine.loading import Scene
from advsearch.engine.rendering import facts_about
from advsearch.engine.verifier import kept_configuration
from advsearch.errors import FileFormatError, InputError
from advsearch.files import JsonObject
from advsearch.models import find_label_set
from advsearch.models.labels import names_nothing
from advsearch.options import Value
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import ROLES_IN_SEARCH, parts_in, problem_of_parts
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import attack_of
from advsearch.questions.sweep.carry_out import scenes_of
from advsearch.questions.sweep.job import KIND
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import CONFIG, PARTS, find_run, is_run, read_python_only
from advsearch.runs.files import write_png
from advsearch.runs.store import NAME, Row, Store
from advsearch.scene.assets import Bools
from advsearch.scene.description import OBJECT
from advsearch.scene.outlines import SeenThing, seen_things
from advsearch.scene.renderer import Renderer
from advsearch.settings import read_yaml
from advsearch.tasks import Facts, Task
from advsearch.tasks.classification import ClassTask
from advsearch.tasks.together import Together
from advsearch.trust.writing import check_free_folder, placed_by, storage_errors, write_text

IMAGES, LABELS, COCO, YOLO = "images", "labels", "annotations.json", "data.yaml"  # what is in the folder of a dataset
CLEAN = ("first control", "control")  # kinds of rows of an attack that look at the clean scene


@dataclass(frozen=True, eq=False)
class Shown:
    """One picture (H, W, 3) of a run, sRGB in [0, 1], rounded to 8 bits as the model sees it: the name of its file
    without ending, the things that it shows, each with the number of its category, what the models of the run say of
    it, the configuration by parameter, and whether the first model is right, or wrong, as its row says."""

    name: str
    picture: Tensor
    things: Sequence[tuple[SeenThing, int]]
    rows: Sequence[Row]
    values: Mapping[str, Value]
    same: bool


@dataclass
class Categories:
    """The labels of the models, in the order of their outputs; of models without, what the object is called; and the
    things that were seen and have no category."""

    labels: tuple[str, ...] = ()
    unnamed: set[str] = field(default_factory=set)

    def things(self, task: Task, facts: Facts, renderer: Renderer, u: Tensor) -> list[tuple[SeenThing, int]]:
        """Return the things that a configuration (d,) shows, each with the number of its category."""
        own = task.tasks[0] if isinstance(task, Together) else task
        labels: tuple[str, ...] = (facts.label or facts.own_label or facts.object,)
        right = 0
        if isinstance(own, ClassTask) and own.labels:
            labels, right = own.labels, own.right_classes(facts)[0]
        if self.labels not in ((), labels):
            raise InputError(
                f"RUN: its parts have other categories, {facts.object} among them; export one of its parts"
            )
        self.labels, meshes, things = labels, renderer.scene.made[0].meshes, []
        for thing in seen_things(renderer, u):
            try:
                name = meshes[thing.name].label or thing.name
                things.append((thing, right if thing.name == OBJECT else find_label_set(name, labels).indices[0]))
            except InputError:
                self.unnamed.add(thing.name)
        return things


def write_dataset(run: str | Path, out: Path, format: str, *, every: bool, progress: Progress) -> tuple[int, list[str]]:
    """Write the pictures of a run of `sweep` or `attack`, or of one with such parts (a suite, a study), with what is
    true of them, whole or not at all, to a folder that is made, or empty; as "coco" or "yolo", and `every` one or only
    those that not all models are right about. Returns how many there are (of 0, nothing is written), and sentences that
    a reader has to know. Raises InputError where the scene of the run is not to be had any more, or `out` is not empty,
    and FileFormatError where the run is of another command, or has not ended."""
    check_free_folder(out, "out")
    folder, categories = find_run(run), Categories()
    with placed_by("out"):
        with storage_errors(out):
            out.parent.mkdir(parents=True, exist_ok=True)
            kept = tempfile.TemporaryDirectory(prefix=".export-", dir=out.parent)
        with kept:
            place, images = Path(kept.name) / "dataset", list[JsonObject]()
            things, others = list[JsonObject](), 0
            for number, shown in enumerate(_pictures(folder, categories, every, progress), 1):
                write_png(place / IMAGES / f"{shown.name}.png", shown.picture.numpy())
                images.append(_image(number, shown))
                things += [_thing(len(things) + k, number, *one) for k, one in enumerate(shown.things, 1)]
                others += not shown.same
                if format == "yolo":  # the class, the middle of the box and its size, as shares of the picture
                    (height, width), text = shown.picture.shape[:2], ""
                    for thing, category in shown.things:
                        x, y, across, down = _box(thing)
                        box = (x + across / 2) / width, (y + down / 2) / height, across / width, down / height
                        text += f"{category} " + " ".join(f"{side:.6f}" for side in box) + "\n"
                    write_text(place / LABELS / f"{shown.name}.txt", text)
            if not images:
                return 0, []
            if format == "yolo":
                names: JsonObject = {"train": IMAGES, "val": IMAGES, "names": [*categories.labels]}
                write_text(place / YOLO, json.dumps(names, indent=1) + "\n")
            else:
                # labels that name nothing, such as a background, are no categories, and the others keep their numbers
                named = [(number, name) for number, name in enumerate(categories.labels) if not names_nothing(name)]
                dataset: JsonObject = {
                    "info": {"description": "pictures of advsearch", "version": advsearch.__version__},
                    "licenses": [],
                    "images": [*images],
                    "annotations": [*things],
                    "categories": [{"id": number, "name": name, "supercategory": ""} for number, name in named],
                }
                write_text(place / COCO, json.dumps(dataset, allow_nan=False))
            with storage_errors(out):
                os.replace(place, out)
    notes = []
    if categories.unnamed:
        notes.append(f"Without a category, as no label is called so: {', '.join(sorted(categories.unnamed))}.")
    if others:
        notes.append(f"In {others} of them the model says otherwise than the run's rows: something has changed since.")
    return len(images), notes


def _pictures(folder: Path, categories: Categories, every: bool, progress: Progress) -> Iterator[Shown]:
    if parts := [part for part in sorted((folder / PARTS).glob("*")) if is_run(part)]:
        for part in parts:
            for shown in _pictures(part, categories, every, progress):
                yield replace(shown, name=f"{part.name}-{shown.name}")
        return
    command = str(read_yaml(folder / CONFIG).get("command"))
    if command not in READ:
        raise InputError(
            f"{folder}: expected a run of {' or '.join(READ)}, or one with such parts, got one of {command}"
        )
    if needed := [part.text for part in read_python_only(folder) if part.role not in ROLES_IN_SEARCH]:
        raise InputError(f"{folder}: {', '.join(needed)}: only the Python session that asked has what renders it")
    yield from READ[command](folder, categories, every, progress)


def _swept(folder: Path, categories: Categories, every: bool, progress: Progress) -> Iterator[Shown]:
    scenes = scenes_of(SweepConfig.from_yaml(folder / CONFIG).model_copy(update={"metrics": {}}))
    job, rows = scenes.job, defaultdict[int, list[Row]](list)
    with Store(folder / NAME, read_only=True) as store:
        for row in store.rows(KIND):
            rows[row.step // len(job.models)].append(row)
    chosen = sorted(number for number, some in rows.items() if every or not all(row.correct for row in some))
    count = job.per_scene * len(job.places)
    if chosen and not 0 <= chosen[0] <= chosen[-1] < count:
        raise FileFormatError(f"{folder / NAME}: expected rows of its {count} pictures, got one of another")
    progress.stage("rendering pictures", len(chosen))
    for number in chosen:
        view, (query, *_) = scenes.asked(number)
        place, some = job.places[view.number], sorted(rows[number], key=lambda row: row.step)
        facts, size = object_facts(place.scene, place.object, job.config), job.sizes[0]
        picture = view.picture(query)
        things = categories.things(job.tasks[0], facts, view.renderers[size], query.u)
        first = next((row.correct for row in some if row.step % len(job.models) == 0), None)
        same = first in (None, view.problems[0].judge(picture, query.u).right)
        yield Shown(f"{number:06d}", picture, things, some, some[0].values, same)
        progress.advance(1)


def _attacked(folder: Path, categories: Categories, every: bool, progress: Progress) -> Iterator[Shown]:
    """The trials of an attack's adversarial scene, and of the clean one; where nothing varies, the first of each."""
    summary, parts = attack_of(folder), parts_in(folder)
    problem, _ = problem_of_parts(parts)
    kinds = dict.fromkeys(CLEAN, problem.domain.start)
    if summary.adversarial is not None:
        kinds["baseline verification" if summary.answer_from else "verification"] = kept_configuration(folder, problem)
    with Store(folder / NAME, read_only=True) as store:
        tried = {kind: [row for row in store.rows(kind) if every or not row.correct] for kind in kinds}
    chosen = [row for rows in tried.values() for row in (rows if problem.conditions else rows[:1])]
    progress.stage("rendering pictures", len(chosen))
    for row in chosen:
        u, seed, spp = kinds[row.kind], max(0, row.seed or 0), row.spp or problem.spp
        picture, whole = problem.picture(u, seed, spp), problem.whole(u, seed)
        facts = object_facts(parts.scene, parts.config.object, parts.config)
        things = categories.things(problem.task, facts, problem.renderer, whole)
        same = row.correct in (None, problem.judge(picture, whole).right)
        values = {**problem.describe(u, seed), **row.values}
        yield Shown(f"{row.kind.replace(' ', '-')}-{row.step:02d}", picture, things, [row], values, same)
        progress.advance(1)


def object_facts(scene: Scene, name: str, config: SceneConfig) -> Facts:
    """What is known of the object, whatever the run judges: a label that was given is that of the judged thing."""
    judges_object = config.judge not in scene.description.things
    return facts_about(scene.description, name, config.label if judges_object else None, dict)


READ = {SweepConfig.command: _swept, AttackConfig.command: _attacked}


def _image(number: int, shown: Shown) -> JsonObject:
    height, width = shown.picture.shape[:2]
    predictions: list[dict[str, Any]] = [
        {
            "row": row.id, "kind": row.kind, "step": row.step, "right": row.correct, "label": row.label,
            "probability": row.probability, "margin": row.margin,
            **{name: one["value"] for name, one in row.values.items() if name == "model"},
        }
        for row in shown.rows
    ]  # fmt: skip
    extras: dict[str, Any] = {
        "right": all(row.correct for row in shown.rows), "answers": predictions,
        "configuration": {name: dict(one) for name, one in shown.values.items() if name != "model"},
    }  # fmt: skip
    return {"id": number, "file_name": f"{shown.name}.png", "height": height, "width": width, "advsearch": extras}


def _box(thing: SeenThing) -> tuple[float, float, float, float]:
    """Its left and upper side, width and height, in pixels."""
    left, top, right, bottom = thing.box
    return left, top, right - left, bottom - top


def _thing(number: int, image: int, thing: SeenThing, category: int) -> JsonObject:
    return {
        "id": number,
        "image_id": image,
        "category_id": category,
        "bbox": [*_box(thing)],
        "area": int(thing.mask.sum()),
        "segmentation": {"size": [*thing.mask.shape], "counts": [*_runs(thing.mask)]},
        "iscrowd": 0,
        "visible_share": None if thing.share is None else round(thing.share, 4),
        "truncated": thing.truncated,
        "name": thing.name,
        "distance": round(thing.distance, 4),
    }


def _runs(mask: Bools) -> list[int]:
    """The lengths of runs down the columns of a mask, from left to right, the first of pixels outside of it."""
    flat = mask.ravel(order="F")
    ends = [0, *(np.flatnonzero(np.diff(flat)) + 1).tolist(), flat.size]
    return [*[0][: int(flat[0])], *map(int, np.diff(ends))]
