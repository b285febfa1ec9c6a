"""Datasets as FiftyOne stores them (its `FiftyOneDataset`, fiftyone/utils/data/importers.py), so that
`fiftyone.Dataset.from_dir` imports them as they are: JSON with MongoDB's words for identities, and a version from which
a newer FiftyOne migrates."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from advsearch.described import NOT_A_NUMBER, Value
from advsearch.errors import FileFormatError, InputError
from advsearch.files import JsonObject, JsonValue, read_bytes
from advsearch.runs.files import placed_by, replacing, write_bytes, write_text
from advsearch.runs.store import Row

METADATA, SAMPLES, DATA = "metadata.json", "samples.json", "data"

VERSION = "1.0.0"
"""Of FiftyOne, whose form is written."""

MASK, GROUND_TRUTH, PREDICTION, PREDICTIONS = "object_mask", "ground_truth", "prediction", "predictions"
"""Fields with labels."""

LARGEST = 1 << 28
"""Most bytes of a picture, or of the layers beside one."""

_TAKEN = (
    *("id", "filepath", "tags", "metadata", "kind", "step", "correct", "margin", "objective", "success"),
    *(MASK, GROUND_TRUTH, PREDICTION, PREDICTIONS, "created_at", "last_modified_at"),
)

_FIELDS, _LABELS = "fiftyone.core.fields.", "fiftyone.core.labels."


@dataclass(frozen=True)
class Pictured:
    """A row that has a picture: the name of the sample's files, the same for the same picture; the EXR with ground
    truth beside it; and the (height, width) of what the model saw, in which boxes are told, if known."""

    name: str
    row: Row
    picture: Path
    layers: Path | None = None
    size: tuple[int, int] | None = None


def write_fiftyone(samples: Callable[[], Iterable[Pictured]], out: Path, name: str, label: str) -> int:
    """Write a dataset, and return how many samples it has.

    A sample has the fields `kind`, `step`, `correct`, `margin`, `objective` and `success` as a row has them;
    `prediction`, a classification; of detection `ground_truth` and `predictions`, with boxes as shares of the picture;
    `object_mask`, a segmentation, where layers were kept; and each value under its name with `_` for what FiftyOne does
    not take, its unit in the description. It is tagged "right" or "wrong".

    Args:
        samples: yields them from the first, as often as it is called.
        out: the folder; made, or empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"out: {out} is there already and not empty; name another folder")
    fields = _ValueFields()
    count = masks = boxes = 0
    for one in samples():
        count, masks = count + 1, masks + (one.layers is not None)
        boxes += _boxes(one) is not None
        fields.add(one.row.values)
    if not count:
        raise InputError(
            "format fiftyone: needs pictures, and this run kept none; an attack keeps them when it ends, a sweep with "
            "`keep_pictures=all`"
        )
    with placed_by("out"):
        with replacing(out / SAMPLES) as part, part.open("w", encoding="utf-8") as file:
            file.write('{"samples": [')
            for number, one in enumerate(samples()):
                text = json.dumps(_sample(one, number, name, label, fields, out), allow_nan=False)
                file.write(",\n" * bool(number) + text)
            file.write("]}\n")
        described = [*_own_fields(bool(masks), bool(boxes)), *fields.described()]
        write_text(out / METADATA, json.dumps(_metadata(name, label, described), indent=1))
    return count


# ---- values ---------------------------------------------------------------------------------------------------------


class _ValueFields:
    """Fields for the values of rows; a field with a text anywhere holds texts."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}
        self._types: dict[str, str] = {}
        self._units: dict[str, str] = {}

    def add(self, values: Mapping[str, Value]) -> None:
        for name, told in values.items():
            value = told["value"]
            listed = isinstance(value, (list, tuple))
            kind = "StringField" if isinstance(value, str) else "ListField" if listed else "FloatField"
            known = self._types.setdefault(name, kind)
            self._types[name] = kind if known == kind else "StringField"
            self._units.setdefault(name, told["unit"])
            if name not in self._names:
                self._names[name] = self._free(re.sub(r"[^A-Za-z0-9_]+", "_", name).strip("_") or "value")

    def _free(self, name: str) -> str:
        name = f"value_{name}" if name[0].isdigit() else name
        taken = (*_TAKEN, *self._names.values())
        return next(one for one in (name, *(f"{name}_{k}" for k in range(2, 1 << 20))) if one not in taken)

    def described(self) -> list[JsonObject]:
        found = []
        for name, field in self._names.items():
            kind, unit = self._types[name], self._units[name]
            told = name + (f", {unit}" if unit not in ("", "1", "name") else "")
            found.append(_field(field, kind, "FloatField" if kind == "ListField" else None, description=told))
        return found

    def of(self, values: Mapping[str, Value]) -> JsonObject:
        found: JsonObject = {}
        for name, told in values.items():
            value = told["value"]
            kind = self._types[name]
            if kind == "StringField":
                found[self._names[name]] = str(value)
            elif kind == "ListField":
                found[self._names[name]] = [float(one) for one in value]  # type: ignore[union-attr]
            else:
                found[self._names[name]] = float(value)
        return found


# ---- samples --------------------------------------------------------------------------------------------------------


def _sample(one: Pictured, number: int, dataset: str, label: str, fields: _ValueFields, out: Path) -> JsonObject:
    row, key = one.row, f"{dataset} {number}"
    path = f"{DATA}/{one.name}{one.picture.suffix}"
    if not (out / path).exists():
        write_bytes(out / path, read_bytes(one.picture, "a picture of the run", LARGEST), durable=False)
    said = row.label or NOT_A_NUMBER
    tags: list[JsonValue] = [] if row.correct is None else ["right" if row.correct else "wrong"]
    sample: JsonObject = {
        "_id": _identity(key), "_media_type": "image", "_rand": int(_digest(key)[:8], 16) / 2**32, "filepath": path,
        "tags": tags, "metadata": None, "kind": row.kind, "step": row.step, "correct": row.correct,
        "margin": row.margin, "objective": row.objective, "success": row.success,
        PREDICTION: _label(key, "Classification", PREDICTION, label=said, confidence=row.probability),
    }  # fmt: skip
    boxes = _boxes(one)
    if boxes is not None:
        truth, found = boxes
        sample[GROUND_TRUTH] = _detections(key, GROUND_TRUTH, [] if truth is None else [(label, truth, None)])
        sample[PREDICTIONS] = _detections(key, PREDICTIONS, found)
    if one.layers is not None:
        place = f"fields/{MASK}/{one.name}.png"
        if not (out / place).exists():
            write_bytes(out / place, _mask_png(one.layers), durable=False)
        sample[MASK] = _label(key, "Segmentation", MASK, mask_path=place)
    return {**sample, **fields.of(row.values)}


Box = tuple[float, float, float, float]
Detected = tuple[str, Box, float | None]


def _boxes(one: Pictured) -> tuple[Box | None, list[Detected]] | None:
    """The true box and those that were found, as x, y, width and height in shares of the picture; None without."""
    kept = one.row.payload
    if one.size is None or not isinstance(kept, dict) or not isinstance(kept.get("found"), list):
        return None
    height, width = one.size

    def relative(box: JsonValue) -> Box:
        x0, y0, x1, y1 = (float(side) for side in box)  # type: ignore[union-attr,arg-type]
        return x0 / width, y0 / height, (x1 - x0) / width, (y1 - y0) / height

    try:
        found: list[Detected] = [
            (str(each["label"]), relative(each["box"]), float(each["score"]))  # type: ignore[index,call-overload,arg-type]
            for each in kept["found"]  # type: ignore[union-attr]
        ]
        return None if kept["box"] is None else relative(kept["box"]), found
    except (LookupError, TypeError, ValueError):
        raise FileFormatError(f"row {one.row.id}: expected boxes as detection keeps them, got something else") from None


def _detections(key: str, field: str, found: Sequence[Detected]) -> JsonObject:
    listed: list[JsonValue] = [
        _label(f"{key} {number}", "Detection", field, label=label, bounding_box=list(box), confidence=score,
               attributes={})
        for number, (label, box, score) in enumerate(found)
    ]  # fmt: skip
    return {"_cls": "Detections", "detections": listed}


def _label(key: str, kind: str, field: str, **values: JsonValue) -> JsonObject:
    return {"_id": _identity(f"{key} {field}"), "_cls": kind, "tags": [], **values}


def _identity(key: str) -> JsonObject:
    return {"$oid": _digest(key)[:24]}


def _digest(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()


def _mask_png(layers: Path) -> bytes:
    """Return the mask in an EXR with layers as a PNG of one channel: 1 where the object is."""
    # late: OpenEXR takes long to import
    import OpenEXR

    try:
        with OpenEXR.File(str(layers), separate_channels=True) as file:
            mask = np.asarray(file.channels()["mask.Y"].pixels)
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise FileFormatError(f"{layers}: expected a layer called mask, got {str(error)[:80]}") from None
    stream = io.BytesIO()
    Image.fromarray((mask > 0).astype(np.uint8)).save(stream, "PNG")
    return stream.getvalue()


# ---- what describes them --------------------------------------------------------------------------------------------


def _metadata(name: str, label: str, fields: Sequence[JsonObject]) -> JsonObject:
    empty: JsonObject = {
        "app_config": {}, "classes": {}, "default_classes": [], "mask_targets": {}, "skeletons": {},
        "frame_fields": [], "saved_views": [], "annotation_runs": {}, "brain_methods": {}, "evaluations": {},
        "runs": {}, "group_media_types": {}, "tags": [],
    }  # fmt: skip
    targets: JsonObject = {"1": label}
    return {
        **empty,
        "name": name,
        "version": VERSION,
        "media_type": "image",
        "persistent": False,
        "info": {"made by": "advsearch"},
        "default_mask_targets": targets,
        "sample_fields": list(fields),
    }


def _own_fields(masks: bool, boxes: bool) -> list[JsonObject]:
    """The fields that every sample has."""
    label = [_field("id", "ObjectIdField", db="_id"), _field("tags", "ListField", "StringField")]
    text, number = _field("label", "StringField"), _field("confidence", "FloatField")
    fields = [
        _field("id", "ObjectIdField", db="_id"),
        _field("filepath", "StringField"),
        _field("tags", "ListField", "StringField"),
        _field("metadata", "EmbeddedDocumentField", embedded="fiftyone.core.metadata.ImageMetadata"),
        _field("_media_type", "StringField"),
        _field("_rand", "FloatField"),
        _field("_dataset_id", "ObjectIdField"),
        _field("created_at", "DateTimeField", read_only=True),
        _field("last_modified_at", "DateTimeField", read_only=True),
        _field("kind", "StringField", description="what it was evaluated for"),
        _field("step", "IntField", description="number of the configuration or trial"),
        _field("correct", "BooleanField", description="whether the model is right"),
        _field("margin", "FloatField", description="how wrong the answer is, over 0 where it is not right"),
        _field("objective", "FloatField", description="what an attack maximised"),
        _field("success", "BooleanField", description="whether the answer is what an attack sought"),
        _embedded(PREDICTION, "Classification", [*label, text, number]),
    ]
    if boxes:
        box = [
            *label,
            text,
            number,
            _field("bounding_box", "ListField", "FloatField"),
            _field("attributes", "DictField"),
        ]
        inner = _field("detections", "ListField", "EmbeddedDocumentField", embedded=f"{_LABELS}Detection", fields=box)
        fields += [_embedded(name, "Detections", [inner]) for name in (GROUND_TRUTH, PREDICTIONS)]
    if masks:
        fields.append(_embedded(MASK, "Segmentation", [*label, _field("mask_path", "StringField")]))
    return fields


def _embedded(name: str, kind: str, fields: Sequence[JsonObject]) -> JsonObject:
    return _field(name, "EmbeddedDocumentField", embedded=f"{_LABELS}{kind}", fields=fields)


def _field(
    name: str,
    kind: str,
    inner: str | None = None,
    *,
    db: str | None = None,
    embedded: str | None = None,
    fields: Sequence[JsonObject] = (),
    description: str | None = None,
    read_only: bool = False,
) -> JsonObject:
    return {
        "name": name,
        "ftype": _FIELDS + kind,
        "embedded_doc_type": embedded,
        "subfield": None if inner is None else _FIELDS + inner,
        "fields": list(fields),
        "db_field": db or name,
        "description": description,
        "info": None,
        "read_only": read_only,
    }
