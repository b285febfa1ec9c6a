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
        """Return the things that an image shows, each with the index of its category.

        The labels become those of the first image; things that no label names are added
        to `unnamed`.

        Raises:
            InputError: another image of the run has other labels.
        """
        task = image.task
        facts = image.facts
        # several models have their tasks; the classes are those of the first
        if isinstance(task, tasks.EnsembleTask):
            task = task.tasks[0]
        labels: tuple[str, ...] = (facts.label or facts.object_label or facts.object,)
        object_category = 0
        if isinstance(task, tasks.ClassTask) and task.labels:
            labels = task.labels
            # the first of the classes that are right for the object
            object_category = task.find_right_classes(facts)[0]
        # empty before the first image
        if self.labels not in ((), labels):
            raise InputError(
                f"RUN: its parts have other categories, {facts.object} among them; "
                "export one of its parts"
            )
        self.labels = labels
        things = []
        for thing in image.list_things():
            try:
                category = object_category
                if thing.name != "object":
                    label_set = models.find_label_set(image.get_label(thing), labels)
                    category = label_set.indices[0]
                things.append((thing, category))
            except InputError:
                self.unnamed.add(thing.name)
        return things


def write_dataset(
    run: str, out: Path, format: str, *, every: bool, progress: Progress
) -> tuple[int, list[str]]:
    """Write the pictures of a run as a dataset, with what is true of them.

    It is written whole or not at all; where there are no pictures, nothing is written.

    Args:
        run: run of `sweep` or `attack`, or with such parts (a suite, a study).
        out: the folder, which is made, or empty.
        format: "coco" or "yolo".
        every: also write pictures that all models are right about.
        progress: progress of the rows.

    Returns:
        How many pictures there are, and sentences that a reader has to know.

    Raises:
        InputError: the scene of the run is not to be had any more, or `out` is not
            empty.
        FileFormatError: the run is of another command, or has not ended.
    """
    writing.check_free_folder(out, "out")
    directory.find_run(run)  # raises if there is none, before anything is written
    categories = Categories()
    with writing.name_setting_in_errors("out"):
        with writing.storage_errors(out):
            out.parent.mkdir(parents=True, exist_ok=True)
            temporary = tempfile.TemporaryDirectory(prefix=".export-", dir=out.parent)
        with temporary:
            folder = Path(temporary.name) / "dataset"
            images = list[dict[str, Any]]()
            annotations = list[dict[str, Any]]()
            n_changed = 0  # images that are not as they were in the run
            rendered = exports.render_rows(run, every=every, progress=progress)
            for image_id, image in enumerate(rendered, 1):
                things = categories.find_things(image)
                path = folder / IMAGES / f"{image.name}.png"
                Exporter.write_png(path, image.picture.numpy())
                images.append(make_image(image_id, image))
                annotations += make_things(len(annotations) + 1, image_id, things)
                n_changed += not image.is_reproduced
                if format == "yolo":
                    labels = make_yolo_labels(image, things)
                    writing.write_text(folder / LABELS / f"{image.name}.txt", labels)
            if not images:
                return 0, []
            if format == "yolo":
                write_yolo_index(folder, categories)
            else:
                write_coco_index(folder, categories, images, annotations)
            # all at once, so that an interrupt leaves no half of it
            with writing.storage_errors(out):
                os.replace(folder, out)
    return len(images), make_notes(categories, n_changed)


def make_yolo_labels(image: Any, things: list[tuple[Any, int]]) -> str:
    """Return the labels of a picture for YOLO, a line for each thing: ``CATEGORY X Y
    WIDTH HEIGHT``.

    X and Y are the center of the box; all four are fractions of the picture.
    """
    (image_height, image_width) = image.picture.shape[:2]
    lines = []
    for thing, category in things:
        x, y, width, height = find_box(thing)
        box = (
            (x + width / 2) / image_width,
            (y + height / 2) / image_height,
            width / image_width,
            height / image_height,
        )
        numbers = " ".join(f"{value:.6f}" for value in box)
        lines.append(f"{category} {numbers}\n")
    return "".join(lines)


def write_yolo_index(folder: Path, categories: Categories) -> None:
    """Write the YAML that names the folders and classes of a YOLO dataset."""
    index: dict[str, Any] = {
        "train": IMAGES,
        "val": IMAGES,
        "names": [*categories.labels],
    }
    # JSON is YAML, too
    writing.write_text(folder / YOLO, json.dumps(index, indent=1) + "\n")


def write_coco_index(
    folder: Path,
    categories: Categories,
    images: list[dict[str, Any]],
    annotations: list[dict[str, Any]],
) -> None:
    """Write the JSON of a COCO dataset.

    A label that names nothing, such as a background, is no category; the others keep
    their indices as ids.
    """
    category_entries = [
        {"id": index, "name": name, "supercategory": ""}
        for index, name in enumerate(categories.labels)
        if not models.is_nothing_name(name)
    ]
    dataset: dict[str, Any] = {
        "info": {
            "description": "pictures of advsearch",
            "version": advsearch.__version__,
        },
        "licenses": [],
        "images": images,
        "annotations": annotations,
        "categories": category_entries,
    }
    writing.write_text(folder / COCO, json.dumps(dataset, allow_nan=False))


def make_notes(categories: Categories, n_changed: int) -> list[str]:
    """Return sentences about things without a category, and about pictures that the
    model judges in another way than when the run was made.
    """
    notes = []
    if categories.unnamed:
        notes.append(
            "Without a category, as no label is called so: "
            f"{', '.join(sorted(categories.unnamed))}."
        )
    if n_changed:
        notes.append(
            f"In {n_changed} of them the model says otherwise than the run's "
            "rows: something has changed since."
        )
    return notes


def make_image(image_id: int, image: Any) -> dict[str, Any]:
    """Return the entry of a picture in COCO's JSON.

    Under "advsearch", which is not COCO's, it has the predictions of all models and the
    values of the parameters.
    """
    height, width = image.picture.shape[:2]
    predictions: list[dict[str, Any]] = [
        {
            "row": row.id,
            "kind": row.kind,
            "step": row.step,
            "right": row.correct,
            "label": row.label,
            "probability": row.probability,
            "margin": row.margin,
            **{
                name: entry["value"]
                for name, entry in row.values.items()
                if name == "model"
            },
        }
        for row in image.rows
    ]
    configuration = {
        name: dict(entry) for name, entry in image.values.items() if name != "model"
    }
    extras: dict[str, Any] = {
        "right": all(row.correct for row in image.rows),
        "answers": predictions,
        "configuration": configuration,
    }
    return {
        "id": image_id,
        "file_name": f"{image.name}.png",
        "height": height,
        "width": width,
        "advsearch": extras,
    }


def find_box(thing: Any) -> tuple[float, float, float, float]:
    """Its left and upper side, width and height, in pixels."""
    left, top, right, bottom = thing.box
    return left, top, right - left, bottom - top


def make_things(
    first_id: int, image_id: int, things: list[tuple[Any, int]]
) -> list[dict[str, Any]]:
    """Return the annotations of the things in a picture, with ids from `first_id`
    on.
    """
    return [
        make_thing(first_id + index, image_id, thing, category)
        for index, (thing, category) in enumerate(things)
    ]


def make_thing(number: int, image: int, thing: Any, category: int) -> dict[str, Any]:
    """Return the annotation of a thing in COCO's JSON; its mask is run-length encoded.

    Args:
        number: the id of the annotation.
        image: the id of its picture.
        thing: what is true of it.
        category: the index of its label.
    """
    fraction = thing.visible_fraction
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
        "visible_share": None if fraction is None else round(fraction, 4),
        "truncated": thing.is_truncated,
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
