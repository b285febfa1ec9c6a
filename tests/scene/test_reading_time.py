"""Reading takes time in proportion to a file: what a hostile one repeats is not compared with all before it."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from advsearch.errors import FileFormatError
from advsearch.scene.importing.files import Notes, UniqueNames
from advsearch.scene.importing.mtl_surfaces import parse_map
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.importing.scenes import list_node_names
from advsearch.scene.importing.wavefront import MAX_MATERIALS
from advsearch.scene.mitsuba_backend.xml_files import MAX_ELEMENTS, read_scene

POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
ENOUGH = 20.0
"""Seconds of processor time; what was quadratic took minutes."""


def read(folder: Path, text: str) -> list[str]:
    path = folder / "a.obj"
    path.write_text(text)
    return read_parts(path, path.read_bytes())[1]


def notes(folder: Path) -> None:
    found = Notes("a.obj")
    for number in range(200_000):
        found.warn(f"note {number}")
        found.warn("the same")
    assert len(list(found)) == 200_001


def names(folder: Path) -> None:
    free = UniqueNames()
    free.make_unique("a-3")
    assert [free.make_unique("a") for _ in range(100_000)][:3] == ["a", "a-2", "a-4"]


def numbers(folder: Path) -> None:
    assert parse_map("-o " + "1" * 100_000 + "x.png") is not None


def material_files(folder: Path) -> None:
    lines = "".join(f"mtllib m{number}.mtl\n" for number in range(MAX_MATERIALS))
    assert len(read(folder, lines + POINTS + "f 1 2 3\n")) == MAX_MATERIALS
    assert len(read(folder, "mtllib m.mtl\n" * 10 * MAX_MATERIALS + POINTS + "f 1 2 3\n")) == 1


def shapes(folder: Path) -> None:
    path = folder / "a.xml"
    path.write_text('<scene version="3.0.0">' + '<shape type="sphere"/>' * (MAX_ELEMENTS - 1) + "</scene>")
    found = read_scene(path)
    assert len(found) == MAX_ELEMENTS and f"sphere-{MAX_ELEMENTS - 1}" in found


def nodes(folder: Path) -> None:
    path, count = folder / "a.gltf", 200
    chain = [{"children": [number + 1]} for number in range(count)]
    wide = [{"children": list(range(count + 1, count + 15_000))}, *({"mesh": 0} for _ in range(14_999))]
    header = {
        "asset": {"version": "2.0"},
        "nodes": [*chain, *wide],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]}],
    }
    path.write_text(json.dumps(header))
    assert len(list_node_names(path)) == count + 15_000


@pytest.mark.medium
@pytest.mark.parametrize("what", [notes, names, numbers, material_files, shapes, nodes])
def test_reading_takes_time_in_proportion(tmp_path: Path, what: Callable[[Path], None]) -> None:
    begun = time.process_time()
    what(tmp_path)
    assert time.process_time() - begun < ENOUGH


def test_a_file_that_names_too_many_is_refused(tmp_path: Path) -> None:
    many = range(MAX_MATERIALS + 1)
    for lines in (
        "".join(f"mtllib m{number}.mtl\n" for number in many),
        "mtllib " + " ".join(f"m{number}.mtl" for number in many) + "\n",
        "".join(f"usemtl m{number}\n" for number in many),
    ):
        with pytest.raises(FileFormatError, match="10,000"):
            read(tmp_path, lines + POINTS + "f 1 2 3\n")
