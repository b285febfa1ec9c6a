"""What things stand on beside a plain table: the floor of the environment's photograph, a road, or a place."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from advsearch.scene import settings
from advsearch.scene.assets import EnvironmentAsset, Floats, Mesh
from advsearch.scene.parts import MeshPart
from advsearch.scene.places.avenue import AVENUE, built
from advsearch.scene.places.crossing import CAR_PARK, CROSSING
from advsearch.scene.places.quads import LAID, ROAD, road
from advsearch.scene.places.room import room

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription


LUMINANCE = (0.2126, 0.7152, 0.0722)  # shares of linear red, green and blue in luminance (Rec. ITU-R BT.709)
SECTORS = 128
RINGS = 64
NEAREST, FARTHEST = 0.01, 1000.0
"""Radii of the innermost and the outermost ring of vertices, in heights of the camera. Beyond, the map itself is seen,
less than 0.06 degrees below the horizon."""


class Photograph:
    """The ground that shows an equirectangular map's photograph and catches what the scene does to its light.

    A photographed environment shows the floor that its camera stood on. That part of the map is projected from the
    height of the camera onto the plane z = 0, and the plane gets the reflectance that shows the photograph where
    nothing is in the way of the light:

        reflectance(p) = pi map(from (0, 0, height) to p) / E,   E = irradiance of the map's upper half on the plane

    A diffuse surface in the irradiance E' looks like `reflectance E' / pi = map E' / E`: the photograph times what
    the scene leaves of the light, and adds to it. That is the quotient form of differential rendering (Debevec,
    Rendering synthetic objects into real scenes, SIGGRAPH 1998, section 5) in one render instead of two, and an
    ordinary scene: every derivative, guide and mask is that of a plane with a texture.

    Where the photograph shows what is brighter than a white floor in this light, a lamp, a window low down or its
    reflection, the reflectance is above 1. Such texels still look as photographed.

    It is made of linear radiance (H, W, 3), row 0 straight up, the camera's height above the ground in object sizes,
    and the map's rotation about the vertical in degrees.
    """

    def __init__(self, radiance: Floats, height: float, rotation: float) -> None:
        self._rows = radiance.shape[0]
        self._first = (self._rows - 1) // 2
        # rings around the point below the camera, with the map's own coordinates as texture coordinates
        radii = np.concatenate([[0.0], np.geomspace(NEAREST, FARTHEST, RINGS)])
        turns = np.linspace(0.0, 1.0, SECTORS + 1)
        radius, turn = np.meshgrid(radii, turns, indexing="ij")
        azimuth = 0.5 * math.pi - 2.0 * math.pi * turn + math.radians(rotation)
        polar = math.pi - np.arctan(radius)
        vertices = height * np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.0 * radius], axis=-1)
        texels = self._rows - self._first
        row = polar / math.pi * (self._rows - 1) - self._first
        uvs = np.stack([turn, 1.0 - (row + 0.5) / texels], axis=-1)
        inner = (np.arange(RINGS)[:, None] * (SECTORS + 1) + np.arange(SECTORS)).ravel()
        outer = inner + SECTORS + 1
        further = np.stack([inner, inner + 1, outer + 1], axis=1)[SECTORS:]
        faces = np.concatenate([np.stack([outer, inner, outer + 1], axis=1), further]).astype(np.uint32)
        normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (vertices.size // 3, 1))
        places, texture = vertices.reshape(-1, 3).astype(np.float32), uvs.reshape(-1, 2).astype(np.float32)
        self.mesh = Mesh(places, faces, normals, texture)
        self.base = self.reflectance(torch.from_numpy(np.asarray(radiance, dtype=np.float32)))

    def reflectance(self, radiance: Tensor) -> Tensor:
        """Return the plane's texture (h, W, 3) for a map of any size; 0 where no light comes from above.
        Differentiable; row 0 is the horizon, the last one is straight down, and columns are those of the map."""
        rows = radiance.shape[0]
        at = torch.arange(self._first, self._rows, device=radiance.device) * ((rows - 1) / (self._rows - 1))
        upper = at.floor().long().clamp_max(rows - 2)
        share = (at - upper)[:, None, None].to(radiance.dtype)
        lower_half = radiance[upper] + share * (radiance[upper + 1] - radiance[upper])
        arriving = irradiance(radiance)
        return torch.where(arriving > 0.0, lower_half * math.pi / arriving.clamp_min(1e-30), 0.0)


@lru_cache(maxsize=4)
def photograph_of(environment: EnvironmentAsset, height: float, rotation: float) -> Photograph:
    return Photograph(environment.radiance, height, rotation)


def irradiance(radiance: Tensor) -> Tensor:
    """Return the irradiance (3,) of a map (H, W, 3) on an unshadowed horizontal surface; differentiable."""
    rows, columns = radiance.shape[:2]
    edges = (torch.arange(rows + 1, device=radiance.device, dtype=torch.float64) - 0.5) * (math.pi / (rows - 1))
    within = edges.clamp(0.0, math.pi / 2.0).sin().square() / 2.0  # the integral of cos sin
    weights = (within.diff() * (2.0 * math.pi / columns)).to(radiance.dtype)
    return (radiance.sum(dim=1) * weights[:, None]).sum(dim=0)


def paved(scene: SceneDescription) -> bool:
    """Tell whether the object stands on the road, or in a room."""
    return not scene.around.keys().isdisjoint(LAID)


def enclosed(scene: SceneDescription) -> bool:
    """Tell whether so much stands around the object that light paths seldom leave the scene."""
    return any(part.laid and part.name != ROAD for part in scene.around.values())


PLACES: Mapping[str, Callable[..., tuple[MeshPart, ...]]] = {
    settings.DRY_AVENUE: partial(built, AVENUE), settings.WET_AVENUE: partial(built, AVENUE),
    settings.SNOW_AVENUE: partial(built, AVENUE, snow=True), settings.CROSSING: partial(built, CROSSING),
    settings.CAR_PARK: partial(built, CAR_PARK), settings.ROOM: room, settings.LIT_ROOM: room,
}  # fmt: skip
"""What makes the meshes of each kind of ground that is a place."""


def on_its_ground(scene: SceneDescription) -> SceneDescription:
    """Return the scene with the road or the place that its environment and its settings ask for, and no other."""
    kind, asked = None, scene.values.get("ground.kind")
    if scene.number("ground.size") > 0.0 and asked is not None:
        kind = settings.GROUND_KINDS[int(asked)]
    elif scene.number("ground.size") > 0.0 and scene.given.isdisjoint(settings.TABLE_SETTINGS):
        kind = None if scene.environment is None else scene.environment.ground
    others = tuple(part for part in scene.parts if not (isinstance(part, MeshPart) and part.laid))
    if kind in settings.PLACES:
        light, dark = scene.environment, kind == settings.LIT_ROOM
        unit = None if light is None else light.candelas
        if light is not None and unit is not None and kind not in (settings.ROOM, settings.LIT_ROOM):
            arriving = irradiance(torch.from_numpy(light.radiance.copy()))
            dark = unit * float(arriving @ torch.tensor(LUMINANCE)) < DUSK
        place = PLACES[kind](scene.metres, unit, wet=kind == settings.WET_AVENUE, dark=dark)
        return replace(scene, parts=(*others, *place))
    if kind in settings.ROADS:
        return replace(scene, parts=(*others, road(kind == settings.WET_ROAD, scene.metres)))
    return scene if len(others) == len(scene.parts) else replace(scene, parts=others)


DUSK = 70.0  # illuminance of the open sky at which street lamps are switched on, lux
