"""Trace rays from texels, find positions in grids and maps, and measure surfaces.

A grid of texels is laid over each surface (`TexelGrid`). What the texels see of each
other and of the environment does not depend on the light. `Lobes` are tables of the
reflection of a surface by the angle of view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.extend import assets, prediction

Float32Array: TypeAlias = assets.Float32Array
Float64Array: TypeAlias = assets.Float64Array

dr = prediction.dr
mi = prediction.mi

Ints = npt.NDArray[np.int32]
Grids: TypeAlias = "Sequence[TexelGrid]"
RAY_OFFSET = 1e-4  # distance from a surface at which rays begin, object sizes
RAYS_PER_LAUNCH = 1 << 20  # rays of one launch of `trace_texel_rays`
N_OUTSIDE_RAYS = 1 << 13  # rays of `is_visible_from_behind`: enough for a percent
# largest number of cut-outs that a ray goes through; the next surface stops it
MAX_CUT_OUT_LAYERS = 4
# Backs of a shape's faces count as visible if more than this fraction of the hits from
# outside is on backs.
MIN_BACK_FRACTION = 0.02


@dataclass(frozen=True)
class TexelGrid:
    """Grid of texels over one surface: a shape in Mitsuba's scene."""

    name: str  # name of the shape
    first_cell_index: int  # index of its first cell among the cells of all grids
    shape: tuple[int, int]  # rows and columns
    # None for a grid over texture coordinates. For a grid over a level ground, (center
    # x, center y, scale, rate): its cells are small at the center, with coordinate =
    # center + scale sinh(rate s), s in [-1, 1]
    ground_warp: tuple[float, float, float, float] | None = None
    # side of the faces that the grid is on: 1 the front, -1 the back, 0 both
    face_side: int = 0

    @property
    def is_ground(self) -> bool:
        """Whether the grid is over a ground, and not over texture coordinates."""
        return self.ground_warp is not None

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]


def trace_texel_rays(
    scene: prediction.MitsubaScene,
    grids: Grids,
    sky_shape: tuple[int, int],
    positions: Float32Array,
    normals: Float32Array,
    n_rays: int,
    seed: int,
) -> Ints:
    """Trace cosine-weighted rays from texels and return what they meet.

    All texels have the same well-spread points on the hemisphere, shifted at random for
    each texel.

    Args:
        scene: the scene, with its inputs set.
        grids: grids of texels of all surfaces.
        sky_shape: rows and columns of the cells of the environment.
        positions, normals: (n, 3) of the texels, with unit shading normals.
        n_rays: rays from each texel.
        seed: seed of the shifts.

    Returns:
        (n, n_rays) indices of what rays meet. The cells of all grids are counted first,
        then those of the environment; -1 is where there is no light: the back of a
        surface that has texels, or a shape that has none.
    """
    points = _to_drjit_points(mi.Point2f, _spread_points(n_rays))
    n_texels = len(positions)
    shifts = np.random.default_rng(seed).random((n_texels, 2), dtype=np.float32)
    met_cells = np.empty((n_texels, n_rays), dtype=np.int32)
    texels_per_launch = max(1, RAYS_PER_LAUNCH // n_rays)
    for start in range(0, n_texels, texels_per_launch):
        batch = slice(start, min(n_texels, start + texels_per_launch))
        # one lane for each ray, texel by texel
        lane = dr.arange(mi.UInt32, (batch.stop - start) * n_rays)
        texel = lane // n_rays
        square = _shift_points(points, lane % n_rays, shifts[batch], texel)
        met = _trace_batch(
            scene,
            grids,
            sky_shape,
            normal=_to_drjit_points(mi.Normal3f, normals[batch], texel),
            position=_to_drjit_points(mi.Point3f, positions[batch], texel),
            square=square,
            seed=(seed, start),
        )
        met_cells[batch] = met.numpy().reshape(-1, n_rays)
    return met_cells


def _shift_points(points: Any, ray_index: Any, shifts: Float32Array, texel: Any) -> Any:
    """Return the point of each ray, shifted by its texel's shift in the unit square.

    Args:
        points: points that all texels have.
        ray_index: index of each ray's point.
        shifts: (n, 2) shift of each texel.
        texel: index of each ray's texel.
    """
    shift = _to_drjit_points(mi.Point2f, shifts, texel)
    square = dr.gather(mi.Point2f, points, ray_index) + shift
    square -= dr.floor(square)  # shifted points come in at the other edge
    return square


def _spread_points(count: int) -> Float64Array:
    """Return points (count, 2) that fill the unit square evenly.

    They are the additive recurrence of the plastic number (Roberts 2018, The
    unreasonable effectiveness of quasirandom sequences).
    """
    # 1 / p and 1 / p^2, where p^3 = p + 1
    increments = np.array([0.7548776662466927, 0.5698402909980532])
    return np.asarray((np.arange(1, count + 1)[:, None] * increments) % 1.0)


def _find_sky_cell(
    scene: prediction.MitsubaScene, direction: Any, sky_shape: tuple[int, int]
) -> Any:
    """Return the index of the environment's cell that lies in a direction.

    Args:
        scene: the scene.
        direction: unit directions in the world.
        sky_shape: rows and columns of the environment's cells, counted row by row.
    """
    n_rows, n_columns = sky_shape
    # fractions of the map's width and height
    x, y = compute_map_position(direction, get_world_to_map(scene))
    # The map wraps around from side to side, and ends at the poles.
    sky_column = mi.UInt32(x * n_columns) % n_columns
    sky_row = mi.UInt32(dr.minimum(y * n_rows, n_rows - 1))
    return sky_row * n_columns + sky_column


def _find_nearest_cell(grid: TexelGrid, si: Any) -> Any:
    """Return the cell of a grid that is nearest to a hit on its surface."""
    n_rows, n_columns = grid.shape
    y_fraction, x_fraction = compute_grid_position(grid, si.p, si.uv)
    row = _compute_cell_index(y_fraction, n_rows)
    column = _compute_cell_index(x_fraction, n_columns)
    return mi.Int32(grid.first_cell_index + row * n_columns + column)


def _trace_batch(
    scene: prediction.MitsubaScene,
    grids: Grids,
    sky_shape: tuple[int, int],
    normal: Any,
    position: Any,
    square: Any,
    seed: tuple[int, int],
) -> Any:
    """Trace one launch of `trace_texel_rays`, and return the cell that each ray meets.

    Args:
        scene: the scene, with its inputs set.
        grids: grids of texels of all surfaces.
        sky_shape: rows and columns of the cells of the environment.
        normal, position: normal and position of the texel, for each ray.
        square: point of the unit square from which the direction is made, for each ray.
        seed: seed of the random numbers that decide whether a ray passes a cut-out, and
            index of the first texel.

    Returns:
        For each ray the index of the cell, int32; -1 where there is no light.
    """
    mitsuba_scene = scene._scene
    n_layers = count_cut_out_layers(scene)
    direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(square))
    ray = mi.Ray3f(position + normal * RAY_OFFSET, direction)
    thresholds = _sample_thresholds(n_layers, dr.width(square), seed)
    si = find_opaque_hits(mitsuba_scene, ray, n_layers, thresholds)

    # Rays that leave the scene meet a cell of the environment. Its cells are counted
    # after those of all grids.
    n_grid_cells = grids[-1].first_cell_index + grids[-1].n_cells
    sky_cell = mi.Int32(n_grid_cells + _find_sky_cell(scene, direction, sky_shape))
    met = dr.select(si.is_valid(), mi.Int32(-1), sky_cell)

    # Other rays meet a texel, or a shape without texels, which counts as dark (-1).
    return _put_texel_cells(mitsuba_scene, grids, si, direction, met)


def _put_texel_cells(
    mitsuba_scene: Any, grids: Grids, si: Any, direction: Any, met: Any
) -> Any:
    """Return the cells that rays meet, with those of texels put in.

    Args:
        mitsuba_scene: the scene.
        grids: grids of texels of all surfaces.
        si: first hits of the rays.
        direction: their unit directions.
        met: cells of the rays that meet no texel.
    """
    masks = find_hit_grids(mitsuba_scene, grids, si, direction)
    for grid, is_hit in zip(grids, masks, strict=True):
        # A grid with the side 0 has hits on both sides of its faces.
        is_for_both_sides = not grid.is_ground and grid.face_side == 0
        if is_for_both_sides:
            # Its texels have the light of the front only: hits on the back stay -1.
            is_hit &= dr.dot(si.n, direction) < 0.0
        met = dr.select(is_hit, _find_nearest_cell(grid, si), met)
    return met


def compute_visible_cosines(
    scene: prediction.MitsubaScene,
    positions: Float32Array,
    normals: Float32Array,
    directions: Float32Array,
) -> Float32Array:
    """Return how much light from several directions arrives at texels.

    It is the cosine to the normal, times the fraction of light that passes cut-outs.

    Args:
        scene: the scene, with its inputs set.
        positions, normals: (n, 3) positions and unit shading normals of the texels.
        directions: (k, 3) unit vectors in the axes of the environment's map.

    Returns:
        (n, k) cosines; 0 where something blocks the light.
    """
    world_directions = _rotate_to_world(scene, directions)
    n_directions = len(world_directions)
    lane = dr.arange(mi.UInt32, len(positions) * n_directions)
    texel = lane // n_directions
    position = _to_drjit_points(mi.Point3f, positions, texel)
    normal = _to_drjit_points(mi.Normal3f, normals, texel)
    direction = _to_drjit_points(mi.Vector3f, world_directions, lane % n_directions)
    cosine = dr.dot(normal, direction)
    is_above = cosine > 0.0  # light from below the surface does not count
    ray = mi.Ray3f(position + normal * RAY_OFFSET, direction)
    transmittance = _trace_transmittance(scene, ray, is_above)
    received = dr.select(is_above, cosine * transmittance, 0.0)
    return np.asarray(received.numpy().reshape(len(positions), n_directions))


def _rotate_to_world(
    scene: prediction.MitsubaScene, directions: Float32Array
) -> Float32Array:
    """Return directions (k, 3) in the world, from the axes of the environment's map."""
    world_to_map = np.array(get_world_to_map(scene))
    # For rows v, `v @ world_to_map` is v turned from the map's axes to the world's.
    world_directions: Float32Array = (directions @ world_to_map).astype(np.float32)
    return world_directions


def _trace_transmittance(scene: prediction.MitsubaScene, ray: Any, active: Any) -> Any:
    """Return the fraction of light along rays that passes cut-outs; 0 if it is blocked.

    `active` are the lanes that are traced.
    """
    transmittance = mi.Float(1.0)
    # A ray that meets nothing more is not blocked, and keeps its transmittance.
    for _ in range(count_cut_out_layers(scene)):
        si = scene._scene.ray_intersect(
            ray, mi.RayFlags.UV, coherent=False, active=active
        )
        active = active & si.is_valid()
        transmittance = dr.select(
            active, transmittance * eval_transmittance(si, active), transmittance
        )
        active = active & (transmittance > 0.0)
        ray = si.spawn_ray(ray.d)
    # What is left of a ray after all layers is stopped by any further surface.
    is_blocked = scene._scene.ray_test(ray, active)
    return dr.select(is_blocked, 0.0, transmittance)


def is_visible_from_behind(
    scene: prediction.MitsubaScene, name: str, positions: Float32Array
) -> bool:
    """Return whether backs of a shape's faces are visible from outside.

    They are visible through a window, for example. Rays from outside and above aim at
    random points of the shape. Backs count as visible if they are more than the
    fraction `MIN_BACK_FRACTION` of all hits on the shape.

    Args:
        scene: the scene, with its inputs set.
        name: name of the shape.
        positions: (n, 3) points on it.
    """
    ray = _sample_outside_rays(positions)
    n_layers = count_cut_out_layers(scene)
    thresholds = _sample_thresholds(n_layers, N_OUTSIDE_RAYS, seed=(0,))
    si = find_opaque_hits(scene._scene, ray, n_layers, thresholds)
    # `find_hit_grids` finds the hits on the shape by a grid; its cells do not matter.
    grid = TexelGrid(name, first_cell_index=0, shape=(1, 1), face_side=0)
    (is_hit,) = find_hit_grids(scene._scene, [grid], si, ray.d)
    # The normal `si.n` is that of the face, which is not turned towards the ray.
    is_back = is_hit & (dr.dot(si.n, ray.d) > 0.0)
    n_hits = np.asarray(is_hit.numpy()).sum()
    n_back_hits = np.asarray(is_back.numpy()).sum()
    return bool(n_back_hits > MIN_BACK_FRACTION * n_hits)


def _sample_outside_rays(positions: Float32Array) -> Any:
    """Return `N_OUTSIDE_RAYS` random rays from above onto positions (n, 3)."""
    generator = np.random.default_rng(0)
    to_origin = generator.standard_normal((N_OUTSIDE_RAYS, 3))
    to_origin /= np.linalg.norm(to_origin, axis=1, keepdims=True)
    to_origin[:, 2] = np.abs(to_origin[:, 2])  # not from below
    targets = positions[generator.integers(len(positions), size=N_OUTSIDE_RAYS)]
    # twice the largest extent, so that the origins are outside of the shape
    distance = 2.0 * float(np.ptp(positions, axis=0).max())
    origins = (targets + distance * to_origin).astype(np.float32)
    inwards = _to_drjit_points(mi.Vector3f, (-to_origin).astype(np.float32))
    return mi.Ray3f(_to_drjit_points(mi.Point3f, origins), inwards)


def count_cut_out_layers(scene: prediction.MitsubaScene) -> int:
    """Return how many cut-outs a scene's rays go through; 0 where it has none."""
    return MAX_CUT_OUT_LAYERS if scene.description_and_filter[0].has_opacity else 0


def find_opaque_hits(
    mitsuba_scene: Any,
    ray: Any,
    n_layers: int,
    threshold: Any = 0.5,
    active: Any = True,
) -> Any:
    """Return the first hits of rays that stop them; rays pass transparent cut-outs.

    A ray goes on while the fraction of light that passes everything it has met is
    larger than `threshold`. Random thresholds let rays pass as often as light does; 0.5
    lets a ray pass where most light does.

    Args:
        mitsuba_scene: the scene.
        ray: the rays.
        n_layers: largest number of cut-outs that a ray passes.
        threshold: one number in [0, 1], or one for each ray.
        active: lanes that are traced.
    """
    si = mitsuba_scene.ray_intersect(ray, mi.RayFlags.UV, coherent=False, active=active)
    transmittance = mi.Float(1.0)
    for _ in range(n_layers):
        transmittance *= eval_transmittance(si, active)
        active = active & si.is_valid() & (transmittance > threshold)
        next_hit = mitsuba_scene.ray_intersect(
            si.spawn_ray(ray.d), mi.RayFlags.UV, coherent=False, active=active
        )
        si = dr.select(active, next_hit, si)
    return si


def eval_transmittance(si: Any, active: Any) -> Any:
    """Return the fraction of light that passes what was hit."""
    return dr.mean(si.bsdf().eval_null_transmission(si, active & si.is_valid()))


def _sample_thresholds(n_layers: int, count: int, seed: tuple[int, ...]) -> Any:
    """Return a random threshold in [0, 1) for each ray, see `find_opaque_hits`."""
    if not n_layers:  # there are no cut-outs, and the threshold is not used
        return 0.5
    generator = np.random.default_rng([*seed, 1])
    return mi.Float(generator.random(count, dtype=np.float32))


def find_hit_grids(
    mitsuba_scene: Any, grids: Grids, si: Any, direction: Any
) -> list[Any]:
    """Return for each grid a mask of the hits that lie on it.

    A grid belongs to a shape, and perhaps to only one side of its faces.

    Args:
        mitsuba_scene: the scene.
        grids: the grids.
        si: surface interactions of the hits.
        direction: unit directions of the rays. A ray against the normal hits the front
            of a face.
    """
    is_front = dr.dot(si.n, direction) < 0.0
    shapes = {shape.id(): shape for shape in mitsuba_scene.shapes()}
    # by `TexelGrid.face_side`; 0 accepts both sides
    side_masks = {0: True, 1: is_front, -1: ~is_front}
    return [
        si.is_valid()
        & (si.shape == mi.ShapePtr(shapes[grid.name]))
        & side_masks[grid.face_side]
        for grid in grids
    ]


def get_world_to_map(scene: prediction.MitsubaScene) -> Any:
    """Return the rotation from the world to the axes of the environment's map.

    It is a list of three rows of floats, which kernels read as constants: the transpose
    of the rotation `environment.to_world`, which is its inverse.
    """
    matrix = scene.parameters["environment.to_world"].matrix
    map_to_world = np.array(matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    return map_to_world.T.tolist()


def compute_map_position(direction: Any, to_local: Any) -> tuple[Any, Any]:
    """Return where a direction lies in the environment's map.

    The position is a fraction of the map's width and one of its height, from the left
    and from the top, which is straight up; `to_local` is that of `get_world_to_map`.
    """
    x, y, z = (
        row[0] * direction.x + row[1] * direction.y + row[2] * direction.z
        for row in to_local
    )
    # Mitsuba's `envmap`: u is the azimuth around y, from -z towards x
    azimuth = dr.atan2(x, -z) / (2.0 * math.pi)
    return azimuth - dr.floor(azimuth), dr.safe_acos(y) / math.pi


def compute_grid_position(grid: TexelGrid, position: Any, uv: Any) -> tuple[Any, Any]:
    """Return where in a grid something lies: fractions of its height and its width.

    On a mesh it is found by the texture coordinates, which repeat. On a plane it is
    found by the inverse of the grid's warp,

        coordinate = center + scale sinh(rate s), with s = 2 fraction - 1 in [-1, 1]

    A point outside of a plane's grid gets the fraction 0 or 1, at the border.

    Args:
        grid: the grid.
        position: points in the world, which a plane needs.
        uv: their texture coordinates, which a mesh needs.
    """
    if grid.ground_warp is None:
        return uv.y - dr.floor(uv.y), uv.x - dr.floor(uv.x)
    center_x, center_y, scale, rate = grid.ground_warp

    def unwarp(offset: Any) -> Any:
        return dr.clip(0.5 + dr.asinh(offset) / (2.0 * rate), 0.0, 1.0)

    row = unwarp((position.y - center_y) / scale)
    column = unwarp((position.x - center_x) / scale)
    return row, column


def _compute_cell_index(fraction: Any, count: int) -> Any:
    """Return the cell, of `count` along an axis, at a fraction in [0, 1] of it."""
    return mi.Int32(dr.minimum(fraction * count, count - 1.0))


def _to_drjit_points(
    kind: Any, rows: Float32Array | Float64Array, index: Any = None
) -> Any:
    """Convert rows of numbers to Dr.Jit's points, vectors or normals.

    With an index, return the row with that index in each lane.
    """
    columns = [
        mi.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in rows.T
    ]
    points = kind(*columns)
    return points if index is None else dr.gather(kind, points, index)


N_ANGLES = 32  # entries of a table over the cosine of the angle of view
N_LOBE_SAMPLES = 4096
# the tables of `Lobes`, in their order
LOBE_TABLES = ("diffuse", "gloss", "up", "along", "core", "tail")


@dataclass(frozen=True, eq=False)
class Lobes:
    """Reflectance and gloss of a surface by the cosine of the angle of view.

    Each table has `N_ANGLES` entries, the first at grazing angles. The gloss is a lobe
    around a mean direction. Half of its light is in the core of the lobe, nearer to
    that direction, and half in its tail: a lobe has longer tails than a normal
    distribution.
    """

    # (k,) fraction of even light that is reflected diffusely for a base color of 1
    diffuse: Float32Array
    gloss: Float32Array  # (k,) fraction of even light reflected for any base color
    up: Float32Array  # (k,) component of the gloss's mean direction along the normal
    along: Float32Array  # (k,) its component along the surface, away from the viewer
    core: Float32Array  # (k,) root mean square angle about it in the core, radians
    tail: Float32Array  # (k,) root mean square angle about it in the tail, radians

    @classmethod
    def make_diffuse(cls) -> Lobes:
        """Return the tables of a diffuse surface: no gloss, at any angle of view.

        Since there is no gloss, its direction has no effect. It is the normal.
        """
        ones = np.ones(N_ANGLES, dtype=np.float32)
        zeros = np.zeros(N_ANGLES, dtype=np.float32)
        return cls(
            diffuse=ones, gloss=zeros, up=ones, along=zeros, core=zeros, tail=zeros
        )

    @property
    def mean_reflectances(self) -> tuple[float, float]:
        """Diffuse and glossy fractions under even light, over all angles of view."""
        # proportional to the cosine, with the sum 1
        weight = (np.arange(N_ANGLES) + 0.5) * 2.0 / N_ANGLES**2
        return float((weight * self.diffuse).sum()), float((weight * self.gloss).sum())


class _BsdfSamples(NamedTuple):
    """Samples of a BSDF, each (N_ANGLES, N_LOBE_SAMPLES) float64.

    `grey` and `black` are values at directions sampled by the cosine, divided by the
    density. `weight`, `x` and `z` belong to directions sampled by the BSDF of the black
    surface, which only has gloss.
    """

    grey: Float64Array  # for a base color of 0.5
    black: Float64Array  # for a base color of 0
    weight: Float64Array  # value over density of the direction; its mean is the gloss
    x: Float64Array  # component of the direction along the surface, towards the viewer
    z: Float64Array  # component of the direction along the normal


def measure_lobes(
    scene: prediction.MitsubaScene,
    inputs: Mapping[str, Tensor],
    grid: TexelGrid,
    position: Float32Array,
    normal: Float32Array,
) -> Lobes:
    """Measure how a shape reflects at one of its texels, by sampling its BSDF.

    For each angle of view it finds the diffuse fraction, the fraction of the gloss, the
    mean direction of the gloss (up and along), and the angles by which it spreads.

    Args:
        scene: the scene.
        inputs: inputs of the scene; the base color is replaced.
        grid: grid of the shape.
        position, normal: (3,) of the texel; the normal has length 1.
    """
    cosine = (np.arange(N_ANGLES) + 0.5) / N_ANGLES
    with prediction.mitsuba_lock:
        samples = _sample_bsdf(scene, inputs, grid, position, normal, cosine)
    gloss = samples.weight.mean(axis=1)
    towards_viewer, up = _measure_mean_direction(samples, gloss, cosine)
    squared_angle = _measure_squared_angles(samples, towards_viewer, up)
    core, tail = _measure_spreads(samples.weight, squared_angle)
    return Lobes(
        diffuse=_measure_diffuse_fraction(samples).astype(np.float32),
        gloss=gloss.astype(np.float32),
        up=up.astype(np.float32),
        along=(-towards_viewer).astype(np.float32),
        core=core.astype(np.float32),
        tail=tail.astype(np.float32),
    )


def _measure_squared_angles(
    samples: _BsdfSamples, towards_viewer: Float64Array, up: Float64Array
) -> Float64Array:
    """Return the squared angle from each sample of the gloss to its mean direction.

    It is approximated by the squared distance of unit vectors, 2 - 2 cos(angle).

    Args:
        samples: samples of the BSDF.
        towards_viewer, up: (N_ANGLES,) components of the mean direction.
    """
    half_square = 1.0 - samples.x * towards_viewer[:, None] - samples.z * up[:, None]
    return np.asarray(2.0 * np.maximum(0.0, half_square))


def _measure_diffuse_fraction(samples: _BsdfSamples) -> Float64Array:
    """Return the fraction (N_ANGLES,) of even light reflected diffusely, for a base color of 1.

    The base color of `grey` is 0.5 and that of `black` is 0. Their difference is the
    diffuse part; dividing by 0.5 gives it for a base color of 1.
    """
    by_color = samples.grey.mean(axis=1) - samples.black.mean(axis=1)
    return np.asarray(np.maximum(by_color, 0.0) / 0.5)


def _measure_mean_direction(
    samples: _BsdfSamples, gloss: Float64Array, cosine: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return both components (N_ANGLES,) of the mean direction of gloss.

    They are along the surface towards the viewer, and along the normal. Without gloss
    the mirrored direction stands for it.

    Args:
        samples: samples of the BSDF.
        gloss: (N_ANGLES,) fraction of the gloss.
        cosine: (N_ANGLES,) cosine of the angle of view.
    """
    mean_x = (samples.weight * samples.x).mean(axis=1)
    mean_z = (samples.weight * samples.z).mean(axis=1)
    length = np.linalg.norm(np.stack([mean_x, mean_z]), axis=0)
    no_gloss = gloss < 1e-6
    towards_viewer = np.where(
        no_gloss, -np.sqrt(1.0 - cosine**2), mean_x / np.maximum(length, 1e-12)
    )
    up = np.where(no_gloss, cosine, mean_z / np.maximum(length, 1e-12))
    return towards_viewer, up


def _sample_bsdf(
    scene: prediction.MitsubaScene,
    inputs: Mapping[str, Tensor],
    grid: TexelGrid,
    position: Float32Array,
    normal: Float32Array,
    cosines: Float64Array,
) -> _BsdfSamples:
    """Sample the BSDF at a point for each cosine (N_ANGLES,) of the angle of view.

    Values are divided by the opacity, so that they are those of a surface without
    cut-outs. The same random numbers are used for both base colors, 0.5 and 0.

    Args:
        scene: the scene.
        inputs: inputs of the scene; the base color is replaced.
        grid: grid of the shape.
        position, normal: (3,) point on the shape and its unit normal.
        cosines: cosines of the angle of view.
    """
    to_viewer = _make_viewer_directions(cosines)
    noise = mi.load_dict({"type": "independent"})
    noise.seed(0, N_ANGLES * N_LOBE_SAMPLES)
    sample1 = noise.next_1d()
    sample2 = noise.next_2d()
    cosine_direction = mi.warp.square_to_cosine_hemisphere(sample2)

    mitsuba_scene = _set_base_color(scene, inputs, grid.name, 0.5)
    si = _hit_point(mitsuba_scene, position, normal, to_viewer)
    grey = _eval_opaque_bsdf(si, cosine_direction, _eval_opacity(si))

    mitsuba_scene = _set_base_color(scene, inputs, grid.name, 0.0)
    si = _hit_point(mitsuba_scene, position, normal, to_viewer)
    opacity = _eval_opacity(si)
    black = _eval_opaque_bsdf(si, cosine_direction, opacity)
    bsdf_sample, weight = _sample_gloss(si, opacity, sample1, sample2)

    # density of `cosine_direction`, by which the values of `grey` and `black` are
    # divided
    density = _to_table(cosine_direction.z.numpy() / math.pi)
    return _BsdfSamples(
        grey=_to_table(grey.numpy()) / density,
        black=_to_table(black.numpy()) / density,
        weight=_to_table(weight.numpy()),
        x=_to_table(bsdf_sample.wo.x.numpy()),
        z=_to_table(bsdf_sample.wo.z.numpy()),
    )


def _make_viewer_directions(cosines: Float64Array) -> Any:
    """Return directions to viewers, one lane for each sample, angle by angle.

    They are in the frame of the surface, whose z is the normal. `cosines` (N_ANGLES,)
    are those of the angles of view.
    """
    cosine = dr.repeat(mi.Float(cosines.astype(np.float32)), N_LOBE_SAMPLES)
    return mi.Vector3f(dr.sqrt(1.0 - cosine * cosine), 0.0, cosine)


def _eval_opaque_bsdf(si: Any, direction: Any, opacity: Any) -> Any:
    """Return the grey value of a BSDF, as that of a surface without cut-outs.

    `opacity` is the fraction of light that the surface stops, see `_eval_opacity`.
    """
    return dr.mean(si.bsdf().eval(mi.BSDFContext(), si, direction) / opacity)


def _sample_gloss(si: Any, opacity: Any, sample1: Any, sample2: Any) -> tuple[Any, Any]:
    """Sample the BSDF of a black surface, and return samples and weights.

    A black surface reflects nothing but gloss, so that samples of its BSDF are samples
    of the gloss. A direction below the surface (z < 0) is transmitted, and is none.

    Args:
        si: surface interactions.
        opacity: fraction of light that the surface stops.
        sample1, sample2: random numbers that choose the lobe and the direction.
    """
    context = mi.BSDFContext()
    bsdf_sample, bsdf_weight = si.bsdf().sample(context, si, sample1, sample2)
    is_reflected = (bsdf_sample.pdf > 0.0) & (bsdf_sample.wo.z > 0.0)
    weight = dr.select(is_reflected, dr.mean(bsdf_weight) / opacity, 0.0)
    weight = dr.select(dr.isfinite(weight), weight, 0.0)
    return bsdf_sample, weight


def _set_base_color(
    scene: prediction.MitsubaScene, inputs: Mapping[str, Tensor], name: str, grey: float
) -> Any:
    """Set a scene's inputs with one grey as the base color of a shape, if it has one.

    Args:
        scene: the scene.
        inputs: inputs that are set; a base color of the shape is replaced.
        name: name of the shape.
        grey: linear reflectance of all texels.

    Returns:
        Mitsuba's scene.
    """
    key = f"{name}.base_color"
    changed = dict(inputs)
    if key in scene.input_names:
        changed[key] = torch.full_like(scene.get_base_value(key), grey)
    return scene.set_inputs(changed)


def _hit_point(
    mitsuba_scene: Any,
    position: Float32Array,
    normal: Float32Array,
    to_viewer: Any,
) -> Any:
    """Return the surface interaction at a point (3,), as seen by viewers.

    A ray from just above hits the point. Then the direction to the viewer is replaced
    in the interaction.

    Args:
        mitsuba_scene: the scene.
        position, normal: (3,) the point and its unit normal.
        to_viewer: unit vectors in the frame of the surface, one for each lane.
    """
    # The ray starts so near to the point that nothing else is in between.
    start = mi.Point3f([float(x) for x in position + 1e-3 * normal])
    ray = mi.Ray3f(start, mi.Vector3f([float(-x) for x in normal]))
    # The ray has one lane. To gather lane 0 in every lane copies it to all of them.
    lane_zero = dr.zeros(mi.UInt32, dr.width(to_viewer))
    si = mitsuba_scene.ray_intersect(dr.gather(mi.Ray3f, ray, lane_zero))
    si.wi = to_viewer
    return si


def _eval_opacity(si: Any) -> Any:
    """Return the fraction of light that a surface stops, at least 0.001."""
    return dr.maximum(1.0 - eval_transmittance(si, True), 1e-3)


def _measure_spreads(
    weight: Float64Array, squared_angle: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return root mean square angles (k,) of both halves of weighted samples (k, n).

    The halves have equal weight. The first half has the samples with smaller angles,
    the second half the others. The weight of a sample at the median is split between
    both.
    """
    order = np.argsort(squared_angle, axis=1)
    weight = np.take_along_axis(weight, order, axis=1)
    squared_angle = np.take_along_axis(squared_angle, order, axis=1)
    total = weight.sum(axis=1, keepdims=True)
    # weight of all samples with smaller angles
    weight_before = weight.cumsum(axis=1) - weight
    # The first half takes samples in this order until it has half of the total. So a
    # sample counts there by what is missing of that half before it: by its full weight,
    # or by a part of it at the median, or by 0.
    inner_weight = np.clip(0.5 * total - weight_before, 0.0, weight)
    half_weight = np.maximum(0.5 * total[:, 0], 1e-12)
    core = np.sqrt((inner_weight * squared_angle).sum(axis=1) / half_weight)
    tail = np.sqrt(((weight - inner_weight) * squared_angle).sum(axis=1) / half_weight)
    return core, tail


def _to_table(values: npt.NDArray[Any]) -> Float64Array:
    """Convert numbers of all lanes to a table (N_ANGLES, N_LOBE_SAMPLES)."""
    return np.asarray(values, dtype=np.float64).reshape(N_ANGLES, N_LOBE_SAMPLES)
