"""Scenes with media beside each other in one process: each renders as it does alone."""

from typing import Any

import pytest
import torch

import advsearch
from advsearch.scene.renderer import Renderer


def smoke() -> Renderer:
    medium = {"type": "homogeneous", "sigma_t": 1.0, "albedo": {"type": "rgb", "value": [0.8, 0.7, 0.6]}}
    scene: dict[str, Any] = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60.0},
        "lamp": {"type": "point", "position": [0.0, 3.0, 2.0], "intensity": {"type": "rgb", "value": [9.0, 9.0, 9.0]}},
        "thing": {"type": "sphere", "center": [0.0, 0.0, 6.0], "bsdf": {"type": "diffuse"}},
        "smoke": {"type": "sphere", "center": [0, 0, 6], "radius": 2.0, "bsdf": {"type": "null"}, "interior": medium},
    }
    return advsearch.load_scene("thing", scene=scene).renderer("pose", resolution=8, denoise="none")


def shown(renderer: Renderer) -> torch.Tensor:
    """The third picture: the first is not recorded, the second is."""
    return [renderer(renderer.start, seed=seed, spp=4) for seed in (1, 2, 3)][-1]


@pytest.mark.medium
def test_scenes_with_media_do_not_disturb_each_other() -> None:
    alone = shown(smoke())
    assert 0.0 < float(alone.mean()) < 1.0
    haze = advsearch.load_scene("mug").renderer({"haze": {"density": [0.1, 0.3]}}, resolution=8, denoise="none")
    hazy = shown(haze)
    beside = smoke()
    assert torch.equal(shown(beside), alone)
    assert torch.equal(shown(haze), hazy)
    del haze
    assert torch.equal(shown(smoke()), alone)
