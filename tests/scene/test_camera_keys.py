"""Every key of every kind of camera file: it changes what is seen, is on the list of those that do not, or is told."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from advsearch.errors import FileFormatError
from advsearch.scene.camera_entries import IGNORED_KEYS, normalize_key
from advsearch.scene.camera_files import read_camera
from advsearch.scene.camera_model import CameraModel

FRAME = {"file_path": "a.png", "transform_matrix": [[1.0, 0.0, 0.0, 0.0]] * 4, "sharpness": 9.0}

KINDS: dict[str, dict[str, Any]] = yaml.safe_load(Path(__file__).with_name("camera_keys.yaml").read_text("utf-8"))
"""A camera in the files of many tools, each with every key that it has."""


def read(tmp_path: Path, data: dict[str, Any], which: str = "") -> CameraModel:
    (tmp_path / "camera.json").write_text(json.dumps(data))
    return read_camera(f"{tmp_path / 'camera.json'}{which}")


def numbers(data: object, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all numbers that are not 0."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield from numbers(value, (*path, key))
    if isinstance(data, (int, float)) and not isinstance(data, bool) and data:
        yield path


def harmless(path: tuple[Any, ...]) -> bool:
    last = [one for one in path if isinstance(one, str) and one != "frames"]
    places = "aabb_scale scale applied_scale transform_matrix sharpness rows cols roi fisheye_model".split()
    return any(IGNORED_KEYS.fullmatch(normalize_key(one)) or one in places for one in last)


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_number_that_is_changed_is_seen_or_told(kind: str, tmp_path: Path) -> None:
    """Also where it is one of a matrix; what is on the list of those without effect has none."""
    whole = read(tmp_path, KINDS[kind])
    assert whole.reading_notes == ()
    for path in numbers(KINDS[kind]):
        data = copy.deepcopy(KINDS[kind])
        inner: Any = data
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = inner[path[-1]] * 3 if isinstance(inner[path[-1]], int) else inner[path[-1]] * 1.03
        try:
            found = read(tmp_path, data)
        except FileFormatError:
            assert not harmless(path) or "roi" in path, path
            continue
        changed = (found.intrinsics, found.calibrated_shape) != (
            whole.intrinsics,
            whole.calibrated_shape,
        ) or found.reading_notes != ()
        assert changed != harmless(path), path


def everywhere(kind: str, key: str, value: object) -> Iterator[dict[str, Any]]:
    """The file with a key more, at its top and in each of its mappings that says something of the camera."""
    yield KINDS[kind] | {key: value}
    for name, inner in KINDS[kind].items():
        if isinstance(inner, dict) and name not in ("header", "T_BS", "extrinsic_parameters"):
            yield KINDS[kind] | {name: inner | {key: value}}
        if name == "frames" and inner:
            yield KINDS[kind] | {name: [one | {key: value} for one in inner]}


@pytest.mark.parametrize("kind", list(KINDS))
def test_an_unknown_key_is_told(kind: str, tmp_path: Path) -> None:
    for data in everywhere(kind, "zoominess", 1.5):
        told = read(tmp_path, data).reading_notes
        assert len(told) == 1 and "zoominess" in told[0], data


@pytest.mark.parametrize("key", ["xi", "skew", "k7", "crop"])
@pytest.mark.parametrize("kind", list(KINDS))
def test_a_key_that_makes_another_picture_is_refused_by_name(kind: str, key: str, tmp_path: Path) -> None:
    for data in everywhere(kind, key, 1.5):
        inside_a_matrix = any(isinstance(one, dict) and "data" in one and key in one for one in data.values())
        if inside_a_matrix:
            assert key in read(tmp_path, data).reading_notes[0]
            continue
        with pytest.raises(FileFormatError, match=key):
            read(tmp_path, data)
    assert read(tmp_path, KINDS[kind] | {key: 0.0}).intrinsics == read(tmp_path, KINDS[kind]).intrinsics


@pytest.mark.parametrize(
    ("roi", "whole"),
    [
        ({"x_offset": 0, "y_offset": 0, "height": 480, "width": 640}, True),
        ({"x_offset": 0, "y_offset": 0, "height": 0, "width": 0}, True),
        ({"x_offset": 0, "y_offset": 0, "height": 480, "width": 320}, False),
        ({"x_offset": 2, "y_offset": 0, "height": 480, "width": 640}, False),
    ],
)
def test_a_roi_is_the_whole_picture_or_refused(roi: dict[str, int], whole: bool, tmp_path: Path) -> None:
    if whole:
        assert read(tmp_path, KINDS["ros"] | {"roi": roi}) == read(tmp_path, KINDS["ros"])
        return
    with pytest.raises(FileFormatError, match="roi"):
        read(tmp_path, KINDS["ros"] | {"roi": roi})


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"camera_angle_x": 0.7, "frames": [FRAME]}, "expected w"),
        (KINDS["nerfstudio"] | {"camera_model": "FISHEYE624"}, "got 'FISHEYE624'"),
        (KINDS["scalars"] | {"camera_model": "fisheye", "distortion_model": "plumb_bob"}, "contradicts the dist"),
        (KINDS["opencv"] | {"distortion_model": "none"}, "its distortion_model is none"),
        (KINDS["opencv"] | {"flip_horizontal": True}, "flip_horizontal"),
        (KINDS["vins"] | {"mirror_parameters": {"xi": 1.6}}, "xi"),
    ],
)
def test_what_contradicts_itself_or_is_another_model_is_refused(data: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=words):
        read(tmp_path, data)
