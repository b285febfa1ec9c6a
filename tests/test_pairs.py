"""What a row stores of a configuration is true of it alone, whatever was rendered before."""

from __future__ import annotations

import pytest
import torch

from advsearch.api.attacking import problem_from_config
from advsearch.config import AttackConfig
from advsearch.controls import make_control, make_space
from advsearch.scene.description import describe

SIZE = 16


def test_an_occluder_is_described_under_the_conditions_of_its_own_draw() -> None:
    config = AttackConfig(
        object="mug", controls={"occlusion": {"coverage": [0.2, 0.4]}}, over={"camera": {"distance": [1, 5]}},
        resolution=SIZE, measure="no",
    )  # fmt: skip
    problem, _ = problem_from_config(config)
    u = torch.tensor([0.5])
    seen = set()
    for seed in (3, 4):
        said = {**problem.describe(u, seed), **problem.conditions_of(u, seed)}
        camera = make_control("camera", {"distance": said["camera.distance"]["value"]})
        alone = describe("mug")
        occlusion = make_control("occlusion", {"coverage": [0.2, 0.4]})
        space = make_space([occlusion, camera], alone)
        fresh = space.describe(torch.cat([u, space.start[1:]]))
        assert said["occlusion.true_distance"]["value"] == pytest.approx(fresh["occlusion.true_distance"]["value"])
        seen.add(said["occlusion.true_distance"]["value"])
    assert len(seen) == 2
