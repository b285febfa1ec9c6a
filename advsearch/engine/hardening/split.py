"""What a model is trained on and what it is measured on: objects and environments of two splits that share nothing.

Of a bundled object every split draws instances of its own (proportions, texture, material) from seeds of its own; a
file is one object, and its split has to be said.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from advsearch import seeds
from advsearch.bundled.objects import OBJECTS
from advsearch.engine.hardening.variation import varied, white_light_changed
from advsearch.engine.loading import Scene, load_scene
from advsearch.errors import InputError
from advsearch.scene.assets import ObjectAsset
from advsearch.scene.settings import Given

TRAINING, FURTHER, VALIDATION, HELD_OUT = "training", "further training", "validation", "held out"
"""The splits: what the weights are fitted to (the second mostly as it is), what chooses among them, and what is
measured in the end."""

ELEVATION = (8.0, 55.0)
FIELD = (25.0, 45.0)
GROUND = (0.1, 0.9)
"""Ranges from which scenes draw the camera's elevation and field of view in degrees, and the ground's colour (sRGB)."""


@dataclass(frozen=True)
class Split:
    """One side of the split.

    Attributes:
        name: one of the above.
        objects: names of bundled objects, or files.
        environments: names or files.
        seed: root of its draws.
        varied: whether each scene has an environment of its own, made from one of these (`variation`).
    """

    name: str
    objects: tuple[str, ...]
    environments: tuple[str, ...]
    seed: int
    varied: bool = False

    def scene(self, number: int, given: Given | None = None) -> tuple[str, Scene]:
        """Return the scene with this number, and the name of its object; the objects take turns.

        An object in a file that brings no label is called as the file: ``coffee-mug.glb`` is a "coffee mug".

        Args:
            number: from 0; equal numbers are equal scenes.
            given: parameters that are fixed in every scene.
        """
        name, rng = self.objects[number % len(self.objects)], self._draws(number)
        made = OBJECTS[name].generate(rng) if name in OBJECTS else Path(name)
        environment = self.environments[int(rng.integers(len(self.environments)))]
        ground = np.clip(rng.uniform(*GROUND) + rng.normal(0.0, 0.05, 3), 0.02, 0.98)
        drawn = {
            "camera.azimuth": rng.uniform(0.0, 360.0),
            "camera.elevation": rng.uniform(*ELEVATION),
            "camera.fov": rng.uniform(*FIELD),
            "environment.rotation": rng.uniform(0.0, 360.0),
            **dict(zip(("ground.red", "ground.green", "ground.blue"), ground, strict=True)),
        }
        settings = {**{key: float(value) for key, value in drawn.items()}, **(given or {})}
        scene = load_scene(made, environment, settings=settings)
        own = scene.description
        if self.varied and own.environment is not None:
            own = replace(own, environment=white_light_changed(varied(own.environment, rng), rng))
            scene = Scene(own)
        if own.object.label is None:
            label = Path(name).stem.replace("-", " ").replace("_", " ")
            scene = Scene(replace(own, object=replace(own.object, label=label)))
        return name, scene

    def _draws(self, number: int) -> np.random.Generator:
        """What a scene is drawn from, its object first."""
        return np.random.default_rng([seeds.stream(self.seed, f"{self.name} scene", number)])

    def assets(self, count: int) -> Iterator[ObjectAsset]:
        """Yield the objects of the first `count` scenes; what a file holds comes once."""
        files = set[str]()
        for number in range(count):
            name = self.objects[number % len(self.objects)]
            if name in OBJECTS:
                yield OBJECTS[name].generate(self._draws(number))
            elif name not in files:
                files.add(name)
                yield self.scene(number)[1].description.object


def fingerprint(asset: ObjectAsset) -> str:
    """Return what is equal for equal shapes with equal textures."""
    found = hashlib.sha256()
    for part in (asset.mesh.vertices, asset.mesh.faces, asset.base_color):
        found.update(np.ascontiguousarray(part).tobytes())
    return found.hexdigest()


def check_disjoint(held: Split, taught: Sequence[Split]) -> None:
    """Refuse to measure what is trained on: one of the training's environments, or one of its files.

    Of each bundled object the first instance is looked at; all others are checked when they are drawn, by
    `check_unmeasured`: to make them takes minutes.

    Args:
        held: what is measured.
        taught: what weights are fitted to and chosen by.

    Raises:
        InputError: they share something; it is named.
    """
    both = sorted({name for split in taught for name in split.environments} & set(held.environments))
    if both:
        raise InputError(f"held_out_environment: {', '.join(both)} is an environment of the training too; name others")
    measured = {fingerprint(asset) for asset in held.assets(len(held.objects))}
    for split in taught:
        for asset in split.assets(len(split.objects)):
            check_unmeasured(asset, measured)


def check_unmeasured(asset: ObjectAsset, measured: Set[str]) -> None:
    """Refuse to train on an object whose fingerprint is among those of what is measured.

    Raises:
        InputError: it is; it is named.
    """
    if fingerprint(asset) in measured:
        raise InputError(f"held_out: {asset.name} is an object of the training too; name others")
