"""The pictures of a run as a dataset to look at, to label and to train on: at the size
that the model sees, rendered again from what the rows say, with every thing in them
that has a name: as COCO's JSON, or for trainers of YOLO.
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import advsearch
from advsearch.extend import (
    Exporter,
    InputError,
    Progress,
    directory,
    exports,
    models,
    tasks,
    writing,
)

IMAGES = "images"  # what is in the folder of a dataset
LABELS = "labels"
COCO = "annotations.json"
YOLO = "data.yaml"


@dataclass
class Categories:
    """The labels of the models, in the order of their outputs; of models without, what
    the object is called; and the things that were seen and have no category.
    """

    labels: tuple[str, ...] = ()
    unnamed: set[str] = field(default_factory=set)

    def find_things(self, image: Any) -> list[tuple[Any, int]]:
        """Return the things that an image shows, each with the number of its
        category.
        """
        own = image.task
        facts = image.facts
        if isinstance(own, tasks.EnsembleTask):
            own = own.tasks[0]
        labels: tuple[str, ...] = (facts.label or facts.object_label or facts.object,)
        right = 0
        if isinstance(own, tasks.ClassTask) and own.labels:
            labels = own.labels
            right = own.find_right_classes(facts)[0]
        if self.labels not in ((), labels):
            raise InputError(
                f"RUN: its parts have other categories, {facts.object} among them; "
                "export one of its parts"
            )
        self.labels = labels
        things = []
        for thing in image.list_things():
            try:
                is_object = thing.name == "object"
                category = (
                    right
                    if is_object
                    else models.find_label_set(image.get_label(thing), labels).indices[
                        0
                    ]
                )
                things.append((thing, category))
            except InputError:
                self.unnamed.add(thing.name)
        return things


def write_dataset(
    run: str, out: Path, format: str, *, every: bool, progress: Progress
) -> tuple[int, list[str]]:
    """Write the pictures of a run of `sweep` or `attack`, or of one with such parts (a
    suite, a study), with what is true of them, whole or not at all, to a folder that is
    made, or empty; as "coco" or "yolo", and `every` one or only those that not all
    models are right about. Returns how many there are (of 0, nothing is written), and
    sentences that a reader has to know. Raises InputError where the scene of the run is
    not to be had any more, or `out` is not empty, and FileFormatError where the run is
    of another command, or has not ended.
    """
    writing.check_free_folder(out, "out")
    directory.find_run(run)  # refuses before anything is written
    categories = Categories()
    with writing.placed_by("out"):
        with writing.storage_errors(out):
            out.parent.mkdir(parents=True, exist_ok=True)
            kept = tempfile.TemporaryDirectory(prefix=".export-", dir=out.parent)
        with kept:
            place = Path(kept.name) / "dataset"
            images = list[dict[str, Any]]()
            things = list[dict[str, Any]]()
            others = 0
            for number, shown in enumerate(
                exports.render_rows(run, every=every, progress=progress), 1
            ):
                seen = categories.find_things(shown)
                Exporter.write_png(
                    place / IMAGES / f"{shown.name}.png", shown.picture.numpy()
                )
                images.append(make_image(number, shown))
                things += [
                    make_thing(len(things) + k, number, *one)
                    for k, one in enumerate(seen, 1)
                ]
                others += not shown.is_reproduced
                # the class, the middle of the box and its size, as shares of the
                # picture
                if format == "yolo":
                    (height, width) = shown.picture.shape[:2]
                    text = ""
                    for thing, category in seen:
                        x, y, across, down = find_box(thing)
                        box = (
                            (x + across / 2) / width,
                            (y + down / 2) / height,
                            across / width,
                            down / height,
                        )
                        text += (
                            f"{category} "
                            + " ".join(f"{side:.6f}" for side in box)
                            + "\n"
                        )
                    writing.write_text(place / LABELS / f"{shown.name}.txt", text)
            if not images:
                return 0, []
            if format == "yolo":
                names: dict[str, Any] = {
                    "train": IMAGES,
                    "val": IMAGES,
                    "names": [*categories.labels],
                }
                writing.write_text(place / YOLO, json.dumps(names, indent=1) + "\n")
            else:
                # labels that name nothing, such as a background, are no categories, and
                # the others keep their numbers
                named = [
                    (number, name)
                    for number, name in enumerate(categories.labels)
                    if not models.is_nothing_name(name)
                ]
                dataset: dict[str, Any] = {
                    "info": {
                        "description": "pictures of advsearch",
                        "version": advsearch.__version__,
                    },
                    "licenses": [],
                    "images": [*images],
                    "annotations": [*things],
                    "categories": [
                        {"id": number, "name": name, "supercategory": ""}
                        for number, name in named
                    ],
                }
                writing.write_text(place / COCO, json.dumps(dataset, allow_nan=False))
            with writing.storage_errors(out):
                os.replace(place, out)
    notes = []
    if categories.unnamed:
        notes.append(
            "Without a category, as no label is called so: "
            f"{', '.join(sorted(categories.unnamed))}."
        )
    if others:
        notes.append(
            f"In {others} of them the model says otherwise than the run's "
            "rows: something has changed since."
        )
    return len(images), notes


def make_image(number: int, shown: Any) -> dict[str, Any]:
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
    return {
        "id": number,
        "file_name": f"{shown.name}.png",
        "height": height,
        "width": width,
        "advsearch": extras,
    }


def find_box(thing: Any) -> tuple[float, float, float, float]:
    """Its left and upper side, width and height, in pixels."""
    left, top, right, bottom = thing.box
    return left, top, right - left, bottom - top


def make_thing(number: int, image: int, thing: Any, category: int) -> dict[str, Any]:
    return {
        "id": number,
        "image_id": image,
        "category_id": category,
        "bbox": [*find_box(thing)],
        "area": int(thing.mask.sum()),
        "segmentation": {
            "size": [*thing.mask.shape],
            "counts": [*find_runs(thing.mask)],
        },
        "iscrowd": 0,
        "visible_share": None if thing.share is None else round(thing.share, 4),
        "truncated": thing.truncated,
        "name": thing.name,
        "distance": round(thing.distance, 4),
    }


def find_runs(mask: NDArray[np.bool_]) -> list[int]:
    """The lengths of runs down the columns of a mask, from left to right, the first of
    pixels outside of it.
    """
    flat = mask.ravel(order="F")
    ends = [0, *(np.flatnonzero(np.diff(flat)) + 1).tolist(), flat.size]
    return [*[0][: int(flat[0])], *map(int, np.diff(ends))]
