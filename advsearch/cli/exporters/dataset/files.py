"""Export the images of a run as a dataset, to browse it, label it or train on it.

The images have the size of the model's input, and are rendered again from the values in
the rows of the run. Each visible object gets an annotation, in the format of COCO or
YOLO.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable
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

OBJECT = "object"  # the name of the run's object among the objects in an image
# Folders and files of a dataset.
IMAGES = "images"
LABELS = "labels"
COCO = "annotations.json"
YOLO = "data.yaml"


@dataclass
class Categories:
    """The categories of a dataset.

    Attributes:
        labels: names of the categories, by index. They are the labels of the model; if
            the model has none, the only category is the name of the object. Empty
            before the first image.
        unnamed: names of objects in the images that belong to no category, since they
            are not among the labels.
    """

    labels: tuple[str, ...] = ()
    unnamed: set[str] = field(default_factory=set)

    def find_things(self, image: Any) -> list[tuple[Any, int]]:
        """Return the things that an image shows, each with the index of its category.

        The first image decides `labels`. Things that no label names are left out, and
        added to `unnamed`.

        Raises:
            InputError: another image of the run has other labels.
        """
        labels, object_category = _find_object_category(image)
        is_first_image = not self.labels
        if labels != self.labels and not is_first_image:
            raise InputError(
                f"RUN: its parts have other categories, {image.facts.object} among "
                "them; export one of its parts"
            )
        self.labels = labels
        return self._find_categories(image, object_category)

    def _find_categories(
        self, image: Any, object_category: int
    ) -> list[tuple[Any, int]]:
        """Return the things of an image that have a category, each with its index."""
        things = []
        for thing in image.list_things():
            category: int | None = object_category
            if thing.name != OBJECT:
                category = _find_category(image.get_label(thing), self.labels)
            if category is None:
                self.unnamed.add(thing.name)
            else:
                things.append((thing, category))
        return things


def _find_object_category(image: Any) -> tuple[tuple[str, ...], int]:
    """Return the labels of the categories, and the index of the object's category.

    The labels are those of the model. If it has none, the object's name is the only
    one.

    Args:
        image: the rendered image, with its task and the facts about its scene.
    """
    task = image.task
    facts = image.facts
    # an ensemble has a task for each model; the classes of the first one are used
    if isinstance(task, tasks.EnsembleTask):
        task = task.tasks[0]
    if isinstance(task, tasks.ClassTask) and task.labels:
        # several classes may be right for the object: the first of them
        return task.labels, task.find_right_classes(facts)[0]
    # The model has no labels, so the only category is the object: by the label in the
    # settings, else by the label in the file of the object, else by its name.
    name = facts.label or facts.object_label or facts.object
    return (name,), 0


def _find_category(label: str, labels: tuple[str, ...]) -> int | None:
    """Return the index of the first of `labels` that a label means; None if none is."""
    try:
        label_set = models.find_label_set(label, labels)
    except InputError:
        return None
    return int(label_set.indices[0])


def write_dataset(
    run: str, out: Path, format: str, *, every: bool, progress: Progress
) -> tuple[int, list[str]]:
    """Write the pictures of a run as a dataset, with their ground truth.

    The dataset is written in full or not at all. If there are no pictures, nothing is
    written.

    Args:
        run: run of `sweep` or `attack`, or with such parts (a suite, a study).
        out: the folder, which is made, or empty.
        format: "coco" or "yolo".
        every: whether to write all pictures; otherwise only those about which a model
            is wrong.
        progress: progress of the rows.

    Returns:
        The number of pictures, and sentences that users of the dataset should know.

    Raises:
        InputError: the scene of the run does not exist any more, or `out` is not empty.
        FileFormatError: the run is of another command, or has not ended.
    """
    writing.check_free_folder(out, "out")
    directory.find_run(run)  # raises if there is none, before anything is written
    categories = Categories()
    with writing.name_setting_in_errors("out"):
        with _make_temporary_folder(out) as temporary:
            folder = Path(temporary) / "dataset"
            rendered = exports.render_rows(run, every=every, progress=progress)
            n_images, n_changed = _write_files(folder, rendered, categories, format)
            if not n_images:
                return 0, []
            # moved as one, so that an interrupt leaves no half of it
            with writing.storage_errors(out):
                os.replace(folder, out)
    return n_images, make_notes(categories, n_changed)


def _make_temporary_folder(out: Path) -> tempfile.TemporaryDirectory[str]:
    """Make a temporary folder next to a dataset, and return its context manager.

    Args:
        out: folder of the dataset, whose parent is made if it is missing.

    Raises:
        StorageError: a folder cannot be made.
    """
    with writing.storage_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryDirectory(prefix=".export-", dir=out.parent)


def _write_files(
    folder: Path, rendered: Iterable[Any], categories: Categories, format: str
) -> tuple[int, int]:
    """Write pictures, labels and the index of a dataset; without pictures, nothing.

    Args:
        folder: folder of the dataset.
        rendered: the images of the run.
        categories: is filled with the categories of the images.
        format: "coco" or "yolo".

    Returns:
        The number of pictures, and in how many of them the prediction differs from that
        of the run.
    """
    images = list[dict[str, Any]]()
    annotations = list[dict[str, Any]]()
    n_changed = 0
    for image_id, image in enumerate(rendered, 1):
        things = categories.find_things(image)
        _write_dataset_image(folder, image)
        images.append(make_image(image_id, image))
        annotations += make_things(len(annotations) + 1, image_id, things)
        n_changed += int(not image.is_reproduced)
        if format == "yolo":
            _write_yolo_labels(folder, image, things)
    if images and format == "yolo":
        write_yolo_index(folder, categories)
    elif images:
        write_coco_index(folder, categories, images, annotations)
    return len(images), n_changed


def _write_dataset_image(folder: Path, image: Any) -> None:
    """Write a rendered image as PNG into the folder of a dataset."""
    path = folder / IMAGES / f"{image.name}.png"
    Exporter.write_png(path, image.picture.numpy())


def _write_yolo_labels(folder: Path, image: Any, things: list[tuple[Any, int]]) -> None:
    """Write the file of a YOLO dataset with the labels of an image."""
    labels = make_yolo_labels(image, things)
    writing.write_text(folder / LABELS / f"{image.name}.txt", labels)


def make_yolo_labels(image: Any, things: list[tuple[Any, int]]) -> str:
    """Return the labels of a picture for YOLO: ``CATEGORY X Y WIDTH HEIGHT`` lines.

    There is a line for each thing. X and Y are the center of its box; all four are
    fractions of the picture.

    Args:
        image: the image.
        things: the things that it shows, each with the index of its category.
    """
    lines = []
    for thing, category in things:
        numbers = " ".join(
            f"{value:.6f}" for value in _compute_center_and_size(image, thing)
        )
        lines.append(f"{category} {numbers}\n")
    return "".join(lines)


def _compute_center_and_size(
    image: Any, thing: Any
) -> tuple[float, float, float, float]:
    """Return X and Y of a box's center, and its width and height.

    All are fractions of the picture, as YOLO has them.
    """
    image_height, image_width = image.picture.shape[:2]
    left, top, width, height = find_box(thing)
    return (
        (left + width / 2) / image_width,
        (top + height / 2) / image_height,
        width / image_width,
        height / image_height,
    )


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

    A label that names nothing, such as a background, is no category. The ids of all
    other categories are their indices among the labels.

    Args:
        folder: folder of the dataset.
        categories: the categories of the images.
        images: entries of the images.
        annotations: entries of the things in all images.
    """
    dataset: dict[str, Any] = {
        "info": {
            "description": "pictures of advsearch",
            "version": advsearch.__version__,
        },
        "licenses": [],
        "images": images,
        "annotations": annotations,
        "categories": _make_category_entries(categories),
    }
    writing.write_text(folder / COCO, json.dumps(dataset, allow_nan=False))


def _make_category_entries(categories: Categories) -> list[dict[str, Any]]:
    """Return the entries of the categories in COCO's JSON."""
    return [
        {"id": index, "name": name, "supercategory": ""}
        for index, name in enumerate(categories.labels)
        if not models.is_nothing_name(name)
    ]


def make_notes(categories: Categories, n_changed: int) -> list[str]:
    """Return sentences that users of the dataset should know.

    Args:
        categories: the categories of the dataset.
        n_changed: number of images for which the model is now right and was wrong in
            the run, or the reverse.
    """
    notes = []
    if categories.unnamed:
        notes.append(
            "These objects have no category, since the model has no such label: "
            f"{', '.join(sorted(categories.unnamed))}."
        )
    if n_changed:
        notes.append(
            f"For {n_changed} of the pictures the prediction is not as in the run: "
            "something has changed since."
        )
    return notes


def make_image(image_id: int, image: Any) -> dict[str, Any]:
    """Return the entry of a picture in COCO's JSON.

    Its field "advsearch", which is not part of COCO, has the predictions of all models
    and the values of the parameters.

    Args:
        image_id: id of the picture.
        image: the rendered image, with the rows that store its predictions.
    """
    height, width = image.picture.shape[:2]
    return {
        "id": image_id,
        "file_name": f"{image.name}.png",
        "height": height,
        "width": width,
        "advsearch": _describe_image(image),
    }


def _describe_image(image: Any) -> dict[str, Any]:
    """Return the predictions for an image and the values of its parameters."""
    predictions = [_describe_prediction(row) for row in image.rows]
    configuration = {
        name: dict(entry) for name, entry in image.values.items() if name != "model"
    }
    return {
        "right": all(row.correct for row in image.rows),
        "answers": predictions,
        "configuration": configuration,
    }


def _describe_prediction(row: Any) -> dict[str, Any]:
    """Return the prediction that a row stores; with the model's name if it has one."""
    prediction = {
        "row": row.id,
        "kind": row.kind,
        "step": row.step,
        "right": row.correct,
        "label": row.label,
        "probability": row.probability,
        "margin": row.margin,
    }
    if "model" in row.values:
        prediction["model"] = row.values["model"]["value"]
    return prediction


def find_box(thing: Any) -> tuple[float, float, float, float]:
    """Return left and upper side, width and height of a thing's box, in pixels."""
    left, top, right, bottom = thing.box
    return left, top, right - left, bottom - top


def make_things(
    first_id: int, image_id: int, things: list[tuple[Any, int]]
) -> list[dict[str, Any]]:
    """Return the annotations of the things in a picture, with ids from `first_id` on.

    Args:
        first_id: id of the first annotation.
        image_id: id of the picture.
        things: the things, each with the index of its category.
    """
    return [
        make_thing(first_id + index, image_id, thing, category)
        for index, (thing, category) in enumerate(things)
    ]


def make_thing(
    annotation_id: int, image_id: int, thing: Any, category: int
) -> dict[str, Any]:
    """Return the annotation of a thing in COCO's JSON; its mask is run-length encoded.

    Args:
        annotation_id: the id of the annotation.
        image_id: the id of its picture.
        thing: its ground truth.
        category: the index of its label.
    """
    fraction = thing.visible_fraction
    return {
        "id": annotation_id,
        "image_id": image_id,
        "category_id": category,
        "bbox": [*find_box(thing)],
        "area": int(thing.mask.sum()),
        "segmentation": _encode_mask(thing.mask),
        "iscrowd": 0,
        "visible_share": None if fraction is None else round(fraction, 4),
        "truncated": thing.is_truncated,
        "name": thing.name,
        "distance": round(thing.distance, 4),
    }


def _encode_mask(mask: NDArray[np.bool_]) -> dict[str, list[int]]:
    """Return a mask (H, W) as COCO's JSON has it, run-length encoded."""
    return {"size": [*mask.shape], "counts": [*find_runs(mask)]}


def find_runs(mask: NDArray[np.bool_]) -> list[int]:
    """Return the run lengths of a mask (H, W), as COCO encodes masks.

    Pixels are taken down each column, the columns from left to right. Runs outside and
    inside of the mask alternate, and the first is outside: it has length 0 if the first
    pixel is inside.
    """
    flat = mask.ravel(order="F")  # column by column
    # indices of pixels that differ from the previous one: there a run begins
    changes = np.flatnonzero(np.diff(flat)) + 1
    bounds = [0, *changes.tolist(), flat.size]
    lengths = np.diff(bounds).tolist()
    begins_inside = bool(flat[0])
    return [0, *lengths] if begins_inside else lengths
