"""`--aov`: a sweep keeps ground truth of every configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

import advsearch
from advsearch.errors import InputError, UnknownNameError


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
        assert np.array_equal(masks[-1], render.mask(torch.full_like(render.start, turn)).numpy())
    assert not np.array_equal(*masks)


def test_ground_truth_without_a_run_or_of_another_name_is_refused() -> None:
    with pytest.raises(InputError, match=r"aov.*run"):
        advsearch.sweep("mug", grid={"pose.yaw": [0, 90]}, aov="mask")
    with pytest.raises(UnknownNameError, match=r"unknown aov 'masks'. Did you mean 'mask'"):
        advsearch.sweep("mug", grid={"pose.yaw": [0, 90]}, aov="masks", run="never")
