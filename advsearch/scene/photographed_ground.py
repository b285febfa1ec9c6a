"""A ground plane with the photographed floor of an environment map."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.scene.assets import (
    EnvironmentAsset,
    Float32Array,
    Float64Array,
    Mesh,
)

N_SECTORS = 128
N_RINGS = 64
MIN_RING_RADIUS = 0.01  # radius of the innermost ring of vertices, in camera heights
# Radius of the outermost ring, in camera heights. Beyond it the map itself is visible,
# less than 0.06 degrees below the horizon.
MAX_RING_RADIUS = 1000.0


class PhotographedGround:
    """A ground plane with the photographed floor of an equirectangular map.

    The object's shadow and reflected light change the plane, as they would change the
    photographed floor.

    A photographed environment includes the floor on which its camera stood. That part
    of the map is projected from the height of the camera onto the plane z = 0. The
    reflectance of the plane is such that it looks as photographed where the scene does
    not change the light:

        reflectance(p) = pi map(from (0, 0, height) to p) / E
        E = irradiance of the map's upper half on the plane

    The radiance of a diffuse surface with the irradiance E' is `reflectance E' / pi =
    map E' / E`: the photograph times the ratio of the light in the scene to that of the
    map. That is the quotient form of differential rendering (Debevec, Rendering
    synthetic objects into real scenes, SIGGRAPH 1998, section 5) in one render instead
    of two. Derivatives, guides and masks are those of an ordinary plane with a texture.

    The reflectance is above 1 where the photograph is brighter than a white floor in
    this light: at a lamp, a low window or its reflection. Such texels look as
    photographed, too.

    Attributes:
        mesh: the plane.
        base_color: its texture, see `compute_reflectance`.
    """

    def __init__(self, radiance: Float32Array, height: float, rotation: float) -> None:
        """Make the plane and its texture.

        Args:
            radiance: (H, W, 3) linear radiance of the map, row 0 straight up.
            height: height of the camera above the ground, object sizes.
            rotation: rotation of the map about the vertical, degrees.
        """
        # The methods below use these two rows.
        self._map_rows = radiance.shape[0]
        # the last row at or above the horizon, where the plane's texture begins
        self._horizon_row = (self._map_rows - 1) // 2
        self.mesh = self._make_mesh(height, rotation)
        self.base_color = self.compute_reflectance(
            torch.from_numpy(np.asarray(radiance, dtype=np.float32))
        )

    def _make_mesh(self, height: float, rotation: float) -> Mesh:
        """Make rings of faces around the point below the camera.

        Radii are in heights of the camera. The camera sees a ring of radius r at the
        angle atan(r) from straight down, and that angle is its row in the map. The
        plane's texture is the lower half of the map, and the texture coordinates of a
        vertex are its column and row in it.

        Args:
            height: height of the camera, object sizes.
            rotation: rotation of the map about the vertical, degrees.
        """
        radii = np.concatenate(
            [[0.0], np.geomspace(MIN_RING_RADIUS, MAX_RING_RADIUS, N_RINGS)]
        )
        map_columns = np.linspace(0.0, 1.0, N_SECTORS + 1)
        radius, map_column = np.meshgrid(radii, map_columns, indexing="ij")
        # Columns of a map begin at +y, and continue over +x, -y and -x.
        azimuth = 0.5 * math.pi - 2.0 * math.pi * map_column + math.radians(rotation)
        x = radius * np.cos(azimuth)
        y = radius * np.sin(azimuth)
        vertices = height * np.stack([x, y, np.zeros_like(radius)], axis=-1)
        uvs = np.stack([map_column, self._compute_texture_v(radius)], axis=-1)
        upwards = np.array([0.0, 0.0, 1.0], np.float32)
        return Mesh(
            vertices=vertices.reshape(-1, 3).astype(np.float32),
            faces=_make_ring_faces(),
            normals=np.tile(upwards, (vertices.size // 3, 1)),
            uvs=uvs.reshape(-1, 2).astype(np.float32),
        )

    def _compute_texture_v(self, radius: Float64Array) -> Float64Array:
        """Return the texture coordinate v at radii, in heights of the camera."""
        # Rows of the map are counted at their centers: row 0 is straight up, and the
        # last one straight down.
        angle_from_up = math.pi - np.arctan(radius)
        map_row = angle_from_up / math.pi * (self._map_rows - 1)
        # Row 0 of the texture is `_horizon_row` of the map. v is 1 at the upper border
        # of row 0, half a row above its center.
        texture_row = map_row - self._horizon_row
        n_texture_rows = self._map_rows - self._horizon_row
        v: Float64Array = 1.0 - (texture_row + 0.5) / n_texture_rows
        return v

    def compute_reflectance(self, radiance: Tensor) -> Tensor:
        """Return the plane's texture (h, W, 3) for a map (H, W, 3) of any size.

        Row 0 is the horizon, the last row is straight down, and columns are those of
        the map. h is half of the height of the map for which the plane was made; the
        rows of a map with another height are interpolated. The reflectance is pi *
        radiance / irradiance, so that the lit plane looks like the map. It is 0 if no
        light comes from above. The result is differentiable.
        """
        rows = radiance.shape[0]
        # the rows of the plane's map, as rows of this one
        map_row = torch.arange(
            self._horizon_row, self._map_rows, device=radiance.device
        ) * ((rows - 1) / (self._map_rows - 1))
        lower_half = _interpolate_rows(radiance, map_row)
        irradiance = compute_open_sky_irradiance(radiance)
        return torch.where(
            irradiance > 0.0, lower_half * math.pi / irradiance.clamp_min(1e-30), 0.0
        )


def _interpolate_rows(values: Tensor, row: Tensor) -> Tensor:
    """Return values (h, W, C) of a map (H, W, C) at positions (h,) among its rows."""
    # The row above is at most the last but one, so that there is a next row.
    upper = row.floor().long().clamp_max(values.shape[0] - 2)
    fraction = (row - upper)[:, None, None].to(values.dtype)
    return values[upper] + fraction * (values[upper + 1] - values[upper])


def _make_ring_faces() -> npt.NDArray[np.uint32]:
    """Return the faces (F, 3) of the rings around the point below the camera.

    Between two rings each sector has two triangles. Vertices are stored ring by ring.
    Each ring has `N_SECTORS` + 1, of which the last is at the position of the first.
    The first ring of vertices has a radius of 0, so that a sector next to it has only
    one triangle: the other one would have no area.
    """
    ring_starts = np.arange(N_RINGS)[:, None] * (N_SECTORS + 1)
    inner = (ring_starts + np.arange(N_SECTORS)).ravel()
    outer = inner + N_SECTORS + 1
    outer_triangles = np.stack([outer, inner, outer + 1], axis=1)
    inner_triangles = np.stack([inner, inner + 1, outer + 1], axis=1)
    inner_triangles = inner_triangles[
        N_SECTORS:
    ]  # those of the first ring have no area
    return np.concatenate([outer_triangles, inner_triangles]).astype(np.uint32)


@lru_cache(maxsize=4)
def get_photographed_ground(
    environment: EnvironmentAsset, height: float, rotation: float
) -> PhotographedGround:
    return PhotographedGround(environment.radiance, height, rotation)


def compute_open_sky_irradiance(radiance: Tensor) -> Tensor:
    """Return the irradiance (3,) of a map (H, W, 3) on unshadowed level ground.

    It is the integral of radiance times the cosine of the angle from straight up, over
    the upper half. Row 0 is straight up, the last one straight down. Differentiable.
    """
    rows, columns = radiance.shape[:2]
    # Angles from straight up at which rows begin and end, half a row before and after
    # their centers. The centers of the first and the last row are the poles.
    row_bounds = (
        torch.arange(rows + 1, device=radiance.device, dtype=torch.float64) - 0.5
    ) * (math.pi / (rows - 1))
    # The integral of cos(a) sin(a) over an angle a is sin(a)^2 / 2, where sin(a) is the
    # length of a row. Angles are clamped, since light from below does not count.
    antiderivative = row_bounds.clamp(0.0, math.pi / 2.0).sin().square() / 2.0
    weights = (antiderivative.diff() * (2.0 * math.pi / columns)).to(radiance.dtype)
    return (radiance.sum(dim=1) * weights[:, None]).sum(dim=0)
