"""Environments of one's own in the control `environment`: in lists, as an axis, for every picture, and refused."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

import advsearch

SIZE = 16


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Two rooms: a red one as .exr, and a blue one as .hdr."""
    folder = tmp_path_factory.mktemp("rooms")
    red, blue = folder / "red.exr", folder / "blue.hdr"
    radiance = np.random.default_rng(0).random((8, 16, 3), dtype=np.float32) * (1.0, 0.3, 0.2)
    OpenEXR.File({}, {"RGB": radiance.astype(np.float32)}).write(str(red))
    pixels = np.full((8, 16, 4), (40, 90, 200, 129), np.uint8)
    pixels[:3] = (90, 120, 250, 130)
    blue.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n" + pixels.tobytes())
    return str(red), str(blue)


def shown(scene: advsearch.Scene, controls: object, u: list[float] | None = None) -> torch.Tensor:
    renderer = scene.renderer(controls, resolution=SIZE, denoise="none")  # type: ignore[arg-type]
    return renderer(renderer.start if u is None else torch.tensor(u), 0, 16).detach()


@pytest.mark.medium
def test_each_looks_as_the_scene_in_it(maps: tuple[str, str]) -> None:
    """Floor and exposure too: the first of one's own files is the clean scene."""
    space = {"environment": {"which": list(maps)}}
    for number, name in enumerate(maps):
        alone = shown(advsearch.load_scene("mug", environment=name), "pose")
        chosen = shown(advsearch.load_scene("mug"), space, [(number + 0.5) / 2])
        np.testing.assert_allclose(chosen, alone, atol=2e-5)
    assert float((shown(advsearch.load_scene("mug"), space) - chosen).abs().mean()) > 0.05
    fixed = {"environment": {"which": maps[1]}, "pose": {"yaw": [0, 90]}}
    np.testing.assert_allclose(shown(advsearch.load_scene("mug"), fixed), chosen, atol=2e-5)


def test_a_file_that_changed_is_read_again(maps: tuple[str, str], tmp_path: Path) -> None:
    path = tmp_path / "room.exr"
    found = []
    for factor in (0.2, 1.0):
        radiance = np.full((8, 16, 3), 0.5, np.float32) * np.array([1.0, factor, factor], np.float32)
        OpenEXR.File({}, {"RGB": radiance}).write(str(path))
        found.append(shown(advsearch.load_scene("mug"), {"environment": {"which": [maps[0], str(path)]}}, [0.75]))
    assert float((found[0] - found[1]).abs().mean()) > 0.02
