"""What things stand on beside a plain table: the floor of the environment's photograph, and the road."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from advsearch.scene import settings
from advsearch.scene.assets import Doubles, EnvironmentAsset, Floats, Material, Mesh
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.parts import MeshPart

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription


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

    Args:
        radiance: (H, W, 3) linear radiance, row 0 straight up.
        height: of the camera above the ground, object sizes.
        rotation: of the map about the vertical, degrees.
    """

    def __init__(self, radiance: Floats, height: float, rotation: float) -> None:
        self._rows = radiance.shape[0]
        self._first = (self._rows - 1) // 2
        self.mesh = self._plane(height, math.radians(rotation))
        self.base = self.reflectance(torch.from_numpy(np.asarray(radiance, dtype=np.float32)))

    def reflectance(self, radiance: Tensor) -> Tensor:
        """Return the plane's texture (h, W, 3) for a map of any size; 0 where no light comes from above.

        Differentiable; row 0 is the horizon, the last one is straight down, and columns are those of the map.
        """
        rows = radiance.shape[0]
        at = torch.arange(self._first, self._rows, device=radiance.device) * ((rows - 1) / (self._rows - 1))
        upper = at.floor().long().clamp_max(rows - 2)
        share = (at - upper)[:, None, None].to(radiance.dtype)
        lower_half = radiance[upper] + share * (radiance[upper + 1] - radiance[upper])
        arriving = irradiance(radiance)
        return torch.where(arriving > 0.0, lower_half * math.pi / arriving.clamp_min(1e-30), 0.0)

    def _plane(self, height: float, rotation: float) -> Mesh:
        """Rings around the point below the camera, with the map's own coordinates as texture coordinates."""
        radii = np.concatenate([[0.0], np.geomspace(NEAREST, FARTHEST, RINGS)])
        turns = np.linspace(0.0, 1.0, SECTORS + 1)
        radius, turn = np.meshgrid(radii, turns, indexing="ij")
        azimuth = 0.5 * math.pi - 2.0 * math.pi * turn + rotation
        polar = math.pi - np.arctan(radius)
        vertices = height * np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.0 * radius], axis=-1)
        texels = self._rows - self._first
        row = polar / math.pi * (self._rows - 1) - self._first
        uvs = np.stack([turn, 1.0 - (row + 0.5) / texels], axis=-1)
        corner = np.arange(RINGS + 1)[:-1, None] * (SECTORS + 1) + np.arange(SECTORS)
        inner, outer = corner.ravel(), corner.ravel() + SECTORS + 1
        faces = np.concatenate(
            [np.stack([outer, inner, outer + 1], axis=1), np.stack([inner, inner + 1, outer + 1], axis=1)[SECTORS:]]
        )
        normals = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (vertices.size // 3, 3))
        return Mesh(
            vertices=vertices.reshape(-1, 3).astype(np.float32),
            faces=faces.astype(np.uint32),
            normals=normals.astype(np.float32),
            uvs=uvs.reshape(-1, 2).astype(np.float32),
        )


@lru_cache(maxsize=4)
def photograph_of(environment: EnvironmentAsset, height: float, rotation: float) -> Photograph:
    """Return the floor of an environment; arguments as of `Photograph`."""
    return Photograph(environment.radiance, height, rotation)


def irradiance(radiance: Tensor) -> Tensor:
    """Return the irradiance (3,) of a map (H, W, 3) on an unshadowed horizontal surface; differentiable."""
    rows, columns = radiance.shape[:2]
    edges = (torch.arange(rows + 1, device=radiance.device, dtype=torch.float64) - 0.5) * (math.pi / (rows - 1))
    within = edges.clamp(0.0, math.pi / 2.0).sin().square() / 2.0  # the integral of cos sin
    weights = (within.diff() * (2.0 * math.pi / columns)).to(radiance.dtype)
    return (radiance.sum(dim=1) * weights[:, None]).sum(dim=0)


# ---- the road -------------------------------------------------------------------------------------------------------
#
# Lengths are metres. It runs along x; the object stands in the lane of those who drive towards +x, on the right. Beyond
# the pavements, and far ahead, the environment's map is seen.

ROAD = "road"
"""Name of the mesh: asphalt with markings between two pavements, dry or wet."""
KERBS = (-2.3, 5.8)
"""Where the road ends on the right and on the left."""
EDGES = (-10.0, 13.6)
"""Where the pavements end: a multiple of their slabs."""
EYE, FRONTS, STREET_ENDS = 1.5, (-12.0, 15.6), 170.0
"""Of the streets' maps: the height above the road that they are seen from, where the fronts of the houses stand on the
right and on the left, and how far the street goes on."""
PERIOD = 12.0
"""The pattern repeats along the road."""
LENGTH = 120.0
TEXEL = 0.02
DRY, WET = Material(roughness=0.9, specular=0.3), Material(roughness=0.16, specular=0.5)
WETNESS = 0.45
"""How dark wet asphalt is beside dry asphalt (Jensen et al. 1999, Rendering of Wet Materials: about a half)."""


def reflectance(x: Doubles, y: Doubles, grain: Doubles | None = None) -> Doubles:
    """Return the linear reflectance (N, 3) of the ground at places (N,).

    Args:
        x: along the road.
        y: across it.
        grain: (N,) about 0, what makes asphalt uneven.
    """
    grain = np.zeros_like(x) if grain is None else grain
    wheels = np.exp(-(((np.abs(y) - 0.75) / 0.3) ** 2)) + np.exp(-(((np.abs(y - 3.5) - 0.75) / 0.3) ** 2))
    value = 0.085 * (1.0 - 0.12 * wheels) * (1.0 + grain)
    color = value[:, None] * np.array([1.0, 0.99, 0.97])
    dashed = (np.abs(y - 1.75) < 0.07) & (x % 6.0 < 3.0)
    solid = (np.abs(y - KERBS[0] - 0.45) < 0.06) | (np.abs(y - KERBS[1] + 0.45) < 0.06)
    worn = (0.55 * (1.0 + 0.5 * grain))[:, None] * np.array([1.0, 0.99, 0.95])
    color = np.where((dashed | solid)[:, None], worn, color)
    off = np.maximum(KERBS[0] - y, y - KERBS[1])
    joint = (np.minimum(x % 0.6, (y + 10.0) % 0.4) < 0.016)[:, None]
    slabs = (0.3 * (1.0 + 0.35 * grain))[:, None] * np.array([1.0, 0.97, 0.92]) * np.where(joint, 0.6, 1.0)
    kerb = (0.38 * (1.0 + 0.3 * grain))[:, None] * np.where((x % 1.0 < 0.02)[:, None], 0.6, np.ones(3))
    found: Doubles = np.where((off > 0.0)[:, None], np.where((off > 0.16)[:, None], slabs, kerb), color)
    return np.where((np.abs(off) < 0.012)[:, None], 0.05, found)


def paved(scene: SceneDescription) -> bool:
    """Tell whether the object stands on the road."""
    return ROAD in scene.around


def on_its_ground(scene: SceneDescription) -> SceneDescription:
    """Return the scene with the road that its environment and its settings ask for, and no other."""
    kind = _kind(scene)
    if kind not in settings.ROADS and not paved(scene):
        return scene
    others = tuple(part for part in scene.parts if part.name != ROAD)
    laid = (road(kind == settings.WET_ROAD, scene.metres),) if kind in settings.ROADS else ()
    return replace(scene, parts=(*others, *laid))


def _kind(scene: SceneDescription) -> str | None:
    """What the object stands on: as was asked, or else what belongs to the environment, unless a table is described."""
    kind = scene.values.get("ground.kind")
    if scene.number("ground.size") == 0.0:
        return None
    if kind is not None:
        return settings.GROUND_KINDS[int(kind)]
    if scene.environment is None or not scene.given.isdisjoint(settings.TABLE_SETTINGS):
        return None
    return scene.environment.ground


@lru_cache(maxsize=4)
def road(wet: bool, metres: float) -> MeshPart:
    """Return the road.

    Args:
        wet: whether it is dark and reflects.
        metres: of one object size, the scene's unit of length.
    """
    corners = np.array([[-1.0, EDGES[0]], [1.0, EDGES[0]], [1.0, EDGES[1]], [-1.0, EDGES[1]]])
    places = corners * np.array([LENGTH / 2, 1.0])
    uvs = np.stack([places[:, 0] / PERIOD, (places[:, 1] - EDGES[0]) / (EDGES[1] - EDGES[0])], axis=1)
    mesh = Mesh(
        np.concatenate([places, np.zeros((4, 1))], axis=1).astype(np.float32) / np.float32(metres),
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        np.tile(np.array([[0, 0, 1]], np.float32), (4, 1)),
        uvs.astype(np.float32),
    )
    return MeshPart(ROAD, mesh, _texture(wet), WET if wet else DRY)


@lru_cache(maxsize=2)
def _texture(wet: bool) -> Floats:
    """One period of the road, (h, w, 3) display-referred, multiples of 1/255, row 0 on the left."""
    width, height = round(PERIOD / TEXEL), round((EDGES[1] - EDGES[0]) / TEXEL)
    fine = np.random.Generator(np.random.PCG64(7)).random((height, width))
    grain = 0.9 * (_blurred(fine, 1) - 0.5) + 0.8 * (_blurred(fine, 12) - 0.5)
    x, y = np.meshgrid((np.arange(width) + 0.5) * TEXEL, EDGES[1] - (np.arange(height) + 0.5) * TEXEL)
    linear = reflectance(x.ravel(), y.ravel(), grain.ravel()).reshape(height, width, 3) * (WETNESS if wet else 1.0)
    levels = np.round(linear_to_srgb(np.round(linear, 5).astype(np.float32)) * 255.0)
    shown: Floats = np.asarray(levels, np.float32) / np.float32(255.0)
    return shown


def _blurred(values: Doubles, reach: int) -> Doubles:
    """Means over squares of 2 reach + 1 texels, periodic, stretched to the same spread as one texel's."""
    for axis in (0, 1):
        values = np.mean([np.roll(values, shift, axis) for shift in range(-reach, reach + 1)], axis=0)
    return np.asarray((values - values.mean()) / values.std() * 0.12 + 0.5)
