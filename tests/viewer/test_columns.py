"""Rows of a sweep as columns of numbers."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advsearch.options import Value
from advsearch.runs.store import Row
from advsearch.runs.tables import make_sweep_frame
from advsearch.viewer.columns import Boxes, pack_columns, read_columns
from advsearch.viewer.thumbnails import find_thumbnails, thumbnail_path
from stored_sweeps import make_sweep


def row(step: int, **values: Any) -> Row:
    """A row with values in degrees, or names."""
    units = {name: "" if isinstance(value, str) else "degrees" for name, value in values.items()}
    named: dict[str, Value] = {name: {"value": value, "unit": units[name]} for name, value in values.items()}
    label, right = f"a{step % 3}", step % 2 == 0
    return Row("sweep", step, correct=right, margin=step - 1.5, label=label, probability=0.25, values=named)


def unpacked(rows: Iterable[Row]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Head and columns as a reader of the bytes finds them."""
    data = pack_columns(make_sweep_frame(rows))
    size = int.from_bytes(data[:4], "little")
    head = json.loads(data[4 : 4 + size])
    kinds = {one["name"]: (np.dtype(one["type"]), one["at"]) for one in head["columns"]}
    return head, {
        name: np.frombuffer(data, kind.newbyteorder("<"), head["count"], 4 + size + at)
        for name, (kind, at) in kinds.items()
    }


def test_a_page_embeds_the_pictures_of_the_worst_margins(tmp_path: Path) -> None:
    run = make_sweep(tmp_path / "run", keep="all")
    kept, columns = find_thumbnails(run), read_columns(run)
    assert kept is not None
    wrong = [step for step, right in zip(columns["step"], columns["correct"], strict=True) if not right]
    first = [number for number, _ in kept.list_data_urls(columns, max_bytes=1 << 20)][: len(wrong)]
    assert first == [str(step) for step in sorted(wrong, reverse=True)]  # the margin of a wrong one falls with its step
    size = len(thumbnail_path(run, max(wrong)).read_bytes()) * 4 // 3
    assert [number for number, _ in kept.list_data_urls(columns, max_bytes=size)] == first[:1]


def test_what_is_packed_is_what_the_rows_are() -> None:
    head, columns = unpacked(row(k, yaw=10.0 * k, environment="ab"[k % 2]) for k in range(5))
    assert head["count"] == 5
    assert list(columns["step"]) == [0, 1, 2, 3, 4]
    assert list(columns["right"]) == [1, 0, 1, 0, 1]
    assert [head["answers"][k] for k in columns["answer"]] == ["a0", "a1", "a2", "a0", "a1"]
    assert list(columns["probability"]) == [2500] * 5
    assert np.allclose(columns["margin"], [-1.5, -0.5, 0.5, 1.5, 2.5])
    yaw, environment = head["parameters"]
    assert (yaw["name"], yaw["unit"], yaw["levels"]) == ("yaw", "degrees", None)
    assert list(columns["parameter 0"]) == [0, 10, 20, 30, 40]
    assert [environment["levels"][k] for k in columns["parameter 1"]] == ["a", "b", "a", "b", "a"]


def test_names_of_boxes_beyond_the_limit_are_shown_as_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.viewer.columns.MAX_LEVELS", 3)
    boxes = Boxes()
    boxes.add({"found": [{"box": (0, 0, 1, 1), "label": name, "score": 1.0} for name in "abcda"]})
    assert list(boxes.names) == ["a", "b", "others"]
    assert list(boxes.values[4::6]) == [0, 1, 2, 2, 0]
