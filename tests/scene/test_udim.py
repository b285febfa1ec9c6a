"""Pictures of one square of texture coordinates each (UDIM), faces of too few corners, and means over what is shown."""

from pathlib import Path

import numpy as np
import pytest
from test_wavefront import picture, read

from advsearch.scene.importing.texture import average_over_faces

RED, BLUE = np.full((4, 4, 3), (255, 0, 0)), np.full((4, 4, 3), (0, 0, 255))
TWO = (
    "mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\n"
    "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 2 0\nvt 2 1\nf 1/1 2/2 3/3 4/4\nf 2/2 5/5 6/6 3/3\n"
)
"""Two squares side by side, in 1001 and 1002."""


@pytest.mark.parametrize("name", ["skin.1001.png", "skin.<UDIM>.png", "skin_1001.png", "-s 1 1 1 skin.1001.png"])
def test_each_square_has_its_own_picture(name: str, tmp_path: Path) -> None:
    file = name.rpartition(" ")[2]
    for number, pixels in ((1001, RED), (1002, BLUE)):
        picture(tmp_path, file.replace("<UDIM>", "1001").replace("1001", str(number)), pixels)
    parts, notes = read(tmp_path, TWO, a=f"newmtl m\nmap_Kd {name}\n")
    assert notes == []
    shown = {}
    for part in parts:
        assert part.surface.texture is not None and part.uvs is not None
        assert part.uvs.min() == 0.0 and part.uvs.max() == 1.0
        shown[float(part.vertices[:, 0].max())] = part.surface.texture[0, 0].tolist()
    assert shown == {1.0: [1.0, 0.0, 0.0], 2.0: [0.0, 0.0, 1.0]}
    assert {part.surface.name for part in parts} == {"m"}


def test_a_mean_weighs_faces_by_their_area() -> None:
    columns = np.arange(64, dtype=np.float32)[None, :, None].repeat(64, axis=0) / 64.0
    left = np.array([[0.0, 0.0], [0.25, 0.0], [0.0, 1.0]])
    right = left + np.array([0.5, 0.0])
    uvs = np.stack([left, right])
    lone = [float(average_over_faces(columns, one[None], np.ones(1))[0]) for one in (left, right)]
    assert lone == pytest.approx([0.25 / 3, 0.5 + 0.25 / 3], abs=0.01)
    both = float(average_over_faces(columns, uvs, np.array([3.0, 1.0]))[0])
    assert both == pytest.approx(0.75 * lone[0] + 0.25 * lone[1], abs=1e-3)
    assert float(average_over_faces(columns, np.full((2, 3, 2), np.nan), np.ones(2))[0]) == pytest.approx(
        columns.mean()
    )
