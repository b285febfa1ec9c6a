"""`--aov`: a sweep keeps ground truth of every configuration."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

import advsearch

pytestmark = pytest.mark.medium


def test_ground_truth_of_every_configuration_is_that_of_its_scene(tmp_path: Path) -> None:
    run = tmp_path / "run"
    advsearch.sweep("mug", grid={"pose.yaw": [0, 90]}, trials=0, run=run, aov="mask,depth", resolution=16, spp=1)
    files = sorted((run / "aov").iterdir())
    assert [file.name for file in files] == ["000000.exr", "000001.exr"]
    render = advsearch.load_scene("mug").renderer({"pose": {"yaw": [0.0, 360.0]}}, resolution=16)
    masks = []
    for file, turn in zip(files, (0.0, 0.25), strict=True):
        with OpenEXR.File(str(file), separate_channels=True) as picture:
            found = {name: one.pixels for name, one in picture.channels().items()}
        assert sorted(found) == ["depth.Z", "mask.Y"]
        masks.append(found["mask.Y"] == 1.0)
        assert np.array_equal(masks[-1], render.compute_object_mask(torch.full_like(render.start, turn)).numpy())
    assert not np.array_equal(*masks)


def test_an_attack_keeps_ground_truth_of_the_clean_scene_and_of_its_adversarial_scene(tmp_path: Path) -> None:
    names, scene = "mask,depth,normal,uv,id", advsearch.load_scene("mug")
    controls = {"pose": {"yaw": [0.0, 180.0]}}
    run = tmp_path / "run"
    found = advsearch.attack(
        scene, controls=controls, steps=2, trials=6, spp=1, verify_spp=1, resolution=24, measure="no", baseline=False,
        denoise="none", run=run, aov=names, policy="random",
    )  # fmt: skip
    render = scene.renderer(controls, resolution=24)
    assert not torch.equal(found.u, render.start)
    for name, u in (("clean", render.start), ("adversarial", found.u)):
        with OpenEXR.File(str(run / "images" / f"{name}.aov.exr"), separate_channels=True) as picture:
            layers, header = {key: one.pixels for key, one in picture.channels().items()}, dict(picture.header())
        expected = render.find_surfaces(u).make_layers(names.split(","), "object")
        assert sorted(layers) == sorted(expected) and "metres" in header["depth"]
        for key, value in expected.items():
            assert np.array_equal(layers[key], value.numpy()), key
        assert layers["mask.Y"].sum() > 50
