"""The scenes that the reference model is trained and tested on: this pipeline's own,
with everything randomised.

Varied are the instance (proportions, texture, material), pose, camera, exposure,
ground, environment, its rotation, tint and one added soft light; the camera comes as
near as the object fits from where it looks. Training and test differ in the instances
(disjoint seeds) and in the environments (the library's "train" and "heldout" halves),
not in the ranges.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from advsearch.controls import Space
from advsearch.questions.harden.changed_light import vary_environment
from advsearch.questions.harden.objects import HOUSEHOLD
from advsearch.scene import library
from advsearch.scene.assets import Float32Array, ObjectAsset
from advsearch.scene.description import SceneDescription
from advsearch.scene.formation import ALL_OMISSIONS, ImageFormation
from advsearch.scene.geometry import (
    DEFAULT_VIEW,
    FRAME_FILL,
    compute_camera_axes,
    compute_center,
)
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.renderer import Renderer
from advsearch.scene.settings import resolve_settings

CLASSES = tuple(sorted(HOUSEHOLD))
"""Object names in the order of the class indices."""
SPLITS = {"train": 0, "validation": 1, "heldout": 2}
"""Which seeds a split draws its instances from; validation shares the training
environments.
"""
SIZE = (128, 128)
SPP = 8
RAW_SHARE = 0.25
"""Part of the pictures that stays undenoised, so that the model has seen noise."""

Picture = np.ndarray[tuple[int, ...], np.dtype[np.uint8]]


def labels() -> tuple[str, ...]:
    """Return the class names in index order."""
    return tuple(name.replace("-", " ") for name in CLASSES)


def class_of(index: int) -> int:
    """Return the class index of a split's picture `index`; classes take turns."""
    return index % len(CLASSES)


def picture(split: str, index: int, seed: int = 0) -> Picture:
    """Render picture `index` of a split: (128, 128, 3) uint8, display-referred sRGB;
    repeatable.
    """
    rng = np.random.default_rng([seed, SPLITS[split], index])
    description = random_scene(
        CLASSES[class_of(index)], "heldout" if split == "heldout" else "train", rng
    )
    denoiser = "none" if rng.random() < RAW_SHARE else "oidn"
    formation = ImageFormation(
        denoiser=denoiser, resolution=SIZE, gain=description.gain
    )
    scene = MitsubaScene(description, SIZE, leave_out=ALL_OMISSIONS - {"tracing"})
    renderer = Renderer(scene, Space(()), formation, root_seed=seed)
    with torch.no_grad():
        display = renderer(
            torch.zeros(0), seed=index, spp=SPP * (2 if denoiser == "none" else 1)
        )
    return (display * 255.0).round().to(torch.uint8).numpy()


def random_scene(
    name: str, environments: str, rng: np.random.Generator
) -> SceneDescription:
    """Draw a scene with an object of a class, lit by an environment of one half of the
    library.
    """
    asset = _recoloured(HOUSEHOLD[name].generate(rng), rng)
    names = library.list_environments(environments)
    environment = vary_environment(
        library.load_environment(names[int(rng.integers(len(names)))]), rng
    )
    ground = rng.uniform(0.1, 0.9) + rng.normal(0.0, 0.08, 3)
    given = {
        "camera.azimuth": rng.uniform(0.0, 360.0),
        "camera.elevation": rng.uniform(8.0, 55.0),
        "camera.roll": rng.normal(0.0, 4.0),
        "camera.fov": rng.uniform(22.0, 50.0),
        "camera.exposure": rng.uniform(-0.8, 0.5),
        "pose.scale": rng.uniform(0.72, 1.06),
        "pose.pitch": rng.normal(0.0, 2.0),
        "pose.roll": rng.normal(0.0, 2.0),
        "pose.x": rng.normal(0.0, 0.03),
        "pose.y": rng.normal(0.0, 0.03),
        "environment.rotation": rng.uniform(0.0, 360.0),
        "ground.size": 0.0 if rng.random() < 0.08 else rng.uniform(2.0, 7.0),
        **dict(
            zip(
                ("ground.red", "ground.green", "ground.blue"),
                np.clip(ground, 0.02, 0.98),
                strict=True,
            )
        ),
    }
    scene = SceneDescription(
        asset,
        environment,
        resolve_settings({key: float(value) for key, value in given.items()}),
    )
    # as far away as the object just fits into a square picture
    offsets = scene.object.mesh.vertices.astype(np.float64) - compute_center(scene)
    left, up, outwards = (
        compute_camera_axes(*(scene.get_number(name) for name in DEFAULT_VIEW))
        @ offsets.T
    )
    tangent = FRAME_FILL * math.tan(math.radians(scene.get_number("camera.fov")) / 2.0)
    distance = (outwards + np.maximum(np.abs(left), np.abs(up)) / tangent).max()
    return scene.with_values(camera__distance=float(distance))


def _recoloured(asset: ObjectAsset, rng: np.random.Generator) -> ObjectAsset:
    """Sometimes shift the texture's colours or add smooth blotches, so that colour
    alone does not tell the class.
    """
    color = asset.base_color
    if rng.random() < 0.5:
        color = color * rng.uniform(0.75, 1.2, 3).astype(np.float32)
    if rng.random() < 0.4:
        color = color + rng.uniform(0.02, 0.12) * _blotches(color.shape[:2], rng)
    return replace(asset, base_color=np.clip(color, 0.0, 1.0).astype(np.float32))


def _blotches(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Smooth colour noise with values around -1 to 1, from a coarse grid."""
    cells = int(rng.integers(3, 24))
    coarse = torch.from_numpy(
        rng.uniform(-1.0, 1.0, (1, 3, cells, cells)).astype(np.float32)
    )
    fine = torch.nn.functional.interpolate(
        coarse, size=tuple(shape), mode="bilinear", align_corners=False
    )
    return np.ascontiguousarray(fine[0].permute(1, 2, 0).numpy())
