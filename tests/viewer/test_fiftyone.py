"""Datasets for FiftyOne: the form that its importer reads (1.22's source), and what stands in the fields."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from samples import make_run
from stored_sweeps import make_sweep

from advsearch.cli.main import main
from advsearch.errors import FileFormatError
from advsearch.runs.directory import RunDirectory
from advsearch.runs.fiftyone import Pictured, write_fiftyone
from advsearch.runs.images import write_layers
from advsearch.runs.store import Row

FOUND: Any = {"box": [16, 32, 48, 64], "found": [{"box": [0, 0, 64, 32], "label": "cup", "score": 0.9}]}

PYTHON: dict[str, type] = {
    "StringField": str, "FloatField": float, "IntField": int, "BooleanField": bool, "ListField": list,
    "EmbeddedDocumentField": dict, "ObjectIdField": dict, "DateTimeField": dict, "DictField": dict,
}  # fmt: skip


def exported(run: Path, out: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Metadata and samples of what the command writes."""
    assert main(["export", str(run), "--format", "fiftyone", "--out", str(out)]) == 0
    return read(out)


def read(out: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Metadata and samples, of which every field is described and of its type."""
    metadata = json.loads((out / "metadata.json").read_text())
    samples = json.loads((out / "samples.json").read_text())["samples"]
    for sample in samples:
        check(sample, metadata["sample_fields"])
        assert (out / sample["filepath"]).is_file()
        assert not Path(sample["filepath"]).is_absolute()
    assert len({one["_id"]["$oid"] for one in samples}) == len(samples)
    return metadata, samples


def check(document: Any, fields: list[dict[str, Any]]) -> None:
    """What FiftyOne's fields would say of a document."""
    known = {one["db_field"]: one for one in fields}
    assert set(document) - {"_cls"} <= set(known)
    for name, value in document.items():
        if name == "_cls" or value is None:
            continue
        field: dict[str, Any] = known[name]
        assert type(value) is PYTHON[field["ftype"].removeprefix("fiftyone.core.fields.")], name
        if field["embedded_doc_type"] is not None:
            listed: list[Any] = value if isinstance(value, list) else [value]
            for one in listed:
                assert one["_cls"] == field["embedded_doc_type"].rpartition(".")[2]
                check(one, field["fields"])
        if name == "_id":
            assert len(bytes.fromhex(document["_id"]["$oid"])) == 12


def test_a_sweep_becomes_a_dataset(tmp_path: Path) -> None:
    run = make_sweep(tmp_path / "mug sweep", keep="wrong")
    write_layers(run / "aov/000002.exr", {"mask.Y": np.eye(8, dtype=np.int64)}, {})
    metadata, samples = exported(run, tmp_path / "out")
    assert metadata["name"] == "mug sweep"
    assert metadata["default_mask_targets"] == {"1": "mug"}
    fields = {one["name"]: one for one in metadata["sample_fields"]}
    assert fields["pose_yaw"]["description"] == "pose.yaw, degrees"
    assert fields["environment"]["ftype"].endswith("StringField")
    assert [one["step"] for one in samples] == [2, 3, 6, 7, 10, 11]
    first = samples[0]
    assert (first["tags"], first["correct"], first["camera_elevation"]) == (["wrong"], False, 40.0)
    assert first["prediction"] | {"_id": 0} == {
        "_cls": "Classification", "_id": 0, "tags": [], "label": "cup", "confidence": 0.9,
    }  # fmt: skip
    assert (tmp_path / "out" / first["filepath"]).read_bytes() == (run / "images/rows/0000/2.jpg").read_bytes()
    assert ["object_mask" in one for one in samples] == [True, *[False] * 5]
    with Image.open(tmp_path / "out" / first["object_mask"]["mask_path"]) as mask:
        assert np.array_equal(np.asarray(mask), np.eye(8))


def test_boxes_are_shares_of_the_picture(tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    Image.new("RGB", (64, 128)).save(picture)
    to: list[Any] = [{"to": {"value": one, "unit": "m"}} for one in ([1, 2.5], [0, 1])]
    rows = [
        Row("sweep", 0, correct=False, label="cup", payload=FOUND, values=to[0]),
        Row("sweep", 1, correct=True, payload={"box": None, "found": []}, values=to[1]),
    ]
    some = [Pictured(str(row.step), row, picture, None, (128, 64)) for row in rows]
    assert write_fiftyone(lambda: some, tmp_path / "out", "a", "mug") == 2
    _, (first, second) = read(tmp_path / "out")
    (truth,), (found,) = first["ground_truth"]["detections"], first["predictions"]["detections"]
    assert (truth["label"], truth["bounding_box"]) == ("mug", [0.25, 0.25, 0.5, 0.25])
    assert (found["label"], found["bounding_box"], found["confidence"]) == ("cup", [0.0, 0.0, 1.0, 0.25], 0.9)
    assert second["ground_truth"]["detections"] == second["predictions"]["detections"] == []
    assert first["to"] == [1.0, 2.5]


def test_names_that_fiftyone_does_not_take_are_changed(tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    Image.new("RGB", (8, 8)).save(picture)
    names = ("a.b", "a_b", "id", "tags", "2nd", "_x", "..", "mixed")
    values: dict[str, Any] = {name: {"value": 1.0, "unit": "1"} for name in names}
    other = {**values, "mixed": {"value": "none", "unit": ""}}
    some = [Pictured(str(k), Row("sweep", k, values=told), picture) for k, told in enumerate((values, other))]
    write_fiftyone(lambda: some, tmp_path / "out", "a", "mug")
    _, samples = read(tmp_path / "out")
    assert {"a_b", "a_b_2", "id_2", "tags_2", "value_2nd", "x", "value", "mixed"} <= set(samples[0])
    assert [one["mixed"] for one in samples] == ["1.0", "none"]


def test_an_attack_becomes_a_dataset(tmp_path: Path) -> None:
    run = make_run(tmp_path / "attack")
    with RunDirectory.resume(run) as held:
        held.record(Row("verification", 0, success=True, correct=False, label="vase", probability=0.5, margin=2.0))
    _, samples = exported(run, tmp_path / "out")
    assert [one["kind"] for one in samples] == ["clean", "adversarial", "verification"]
    assert [one["prediction"]["label"] for one in samples] == ["mug", "vase", "vase"]
    assert samples[2]["success"] is True


def test_without_pictures_it_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = make_sweep(tmp_path / "run"), tmp_path / "out"
    assert main(["export", str(run), "--format", "fiftyone", "--out", str(out)]) == 2
    assert "--keep-pictures all" in capsys.readouterr().err
    assert not out.exists()
    out.mkdir()
    (out / "mine").touch()
    assert main(["export", str(run), "--format", "fiftyone", "--out", str(out)]) == 2
    assert "not empty" in capsys.readouterr().err


def test_damaged_boxes_are_told(tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    Image.new("RGB", (8, 8)).save(picture)
    row = Row("sweep", 0, payload={"box": ["x"], "found": []})
    with pytest.raises(FileFormatError, match="expected boxes"):
        write_fiftyone(lambda: [Pictured("0", row, picture, None, (8, 8))], tmp_path / "out", "a", "mug")
