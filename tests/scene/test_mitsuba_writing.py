"""Scenes as Mitsuba's XML: what is written is what is read."""

from pathlib import Path

import numpy as np
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
            "type": "sphere", "to_world": mi.ScalarTransform4f(matrix), "flip_normals": True,
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
        },
    }  # fmt: skip
    write_xml(tmp_path / "two.xml", scene, {}, "a -- note")
    read = read_scene(tmp_path / "two.xml")
    assert [shape.id() for shape in mi.load_file(str(tmp_path / "two.xml")).shapes()] == ["ball"]
    assert read["lamp"] == scene["lamp"]
    ball = read["ball"]
    np.testing.assert_array_equal(ball.pop("to_world"), np.array(mi.ScalarTransform4f(matrix).matrix))
    assert ball == {"type": "sphere", "flip_normals": True, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
