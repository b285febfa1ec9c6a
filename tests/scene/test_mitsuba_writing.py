"""Scenes as Mitsuba's XML: what is written is what is read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.mitsuba_backend.writing import write_xml
from advsearch.scene.mitsuba_backend.xml_files import read_scene

pytestmark = pytest.mark.usefixtures("two_threads")


def test_a_dictionary_written_and_read_is_the_same(tmp_path: Path) -> None:
    mi = import_mitsuba()
    matrix = np.array([[0.1, 0, 0, 1 / 3], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    scene = {
        "type": "scene",
        "lamp": {"type": "point", "position": [0.1, 2.0, 1e-7], "intensity": {"type": "rgb", "value": [1.0, 0.3, 0.0]}},
        "ball": {
            "type": "sphere",
            "to_world": mi.ScalarTransform4f(matrix),
            "flip_normals": True,
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
        },
    }
    write_xml(tmp_path / "two.xml", scene, {}, "a -- note")
    read = read_scene(tmp_path / "two.xml")
    assert [shape.id() for shape in mi.load_file(str(tmp_path / "two.xml")).shapes()] == ["ball"]
    assert read["lamp"] == scene["lamp"]
    ball = read["ball"]
    np.testing.assert_array_equal(ball.pop("to_world"), np.array(mi.ScalarTransform4f(matrix).matrix))
    assert ball == {"type": "sphere", "flip_normals": True, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}


WRITER = """
import sys
from pathlib import Path
import numpy as np
from advsearch import threads
from advsearch.scene.mitsuba_backend.writing import write_xml
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
threads.configure(1)
values = np.linspace(0, 2, 8 * 16 * 4, dtype=np.float32).reshape(8, 16, 4)
bitmaps = {f"picture-{n}": import_mitsuba().Bitmap(values[..., :n]) for n in (1, 3, 4)}
pictures = {name: {"type": "bitmap", "bitmap": bitmap, "raw": True} for name, bitmap in bitmaps.items()}
write_xml(Path(sys.argv[1]), {"type": "scene", **pictures}, {}, "")
"""


@pytest.mark.medium
def test_pictures_are_written_in_a_pool_of_one_thread_too(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITER, str(tmp_path / "scene.xml")]
    subprocess.run(command, check=True, timeout=600)
    values = np.linspace(0, 2, 8 * 16 * 4, dtype=np.float32).reshape(8, 16, 4)
    for path in sorted(tmp_path.glob("*.exr")):
        with OpenEXR.File(str(path)) as file:
            (channel,) = file.channels().values()
            found = channel.pixels.reshape(8, 16, -1)
        np.testing.assert_array_equal(found, values[..., : found.shape[2]])
    assert len(list(tmp_path.glob("*.exr"))) == 3
