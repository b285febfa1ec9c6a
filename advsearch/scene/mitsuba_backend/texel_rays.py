"""Rays from texels: what they see of each other and of the environment; and where in
grids and its map things lie.

A grid of texels is laid over each surface (`TexelGrid`). Nothing here depends on the
light.

And what a surface does to light, as tables over the angle of view (`Lobes`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.scene.assets import Doubles, Floats
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import dr, mi, one_at_a_time

Ints = npt.NDArray[np.int32]
Grids: TypeAlias = "Sequence[TexelGrid]"
SHIFT = 1e-4  # how far from a surface rays begin, object sizes
PASS = 1 << 20  # rays of one launch of `gather`
# cut-outs that a ray goes through; what comes after them is taken for opaque
LAYERS = 4
# share of what is seen of a shape from outside, from which on the backs of its faces
# count
FROM_BEHIND = 0.02


@dataclass(frozen=True)
class TexelGrid:
    """The texels over one surface, of a shape in Mitsuba's scene; `first` is their
    first number among all grids.
    """

    name: str
    first: int
    shape: tuple[int, int]  # rows and columns
    # None where it lies over texture coordinates; else (middle x, middle y, scale,
    # rate) of a level plane whose cells are small about its middle: coordinate = middle
    # + scale sinh(rate s), s in [-1, 1]
    warp: tuple[float, float, float, float] | None = None
    side: int = 0  # of the faces that it lies on: 1 the front, -1 the back, 0 both

    @property
    def count(self) -> int:
        return self.shape[0] * self.shape[1]


def gather(
    scene: MitsubaScene,
    grids: Grids,
    cells: tuple[int, int],
    places: Floats,
    normals: Floats,
    rays: int,
    seed: int,
) -> Ints:
    """Return what rays from texels of all grids in a scene with its inputs set see,
    over the cosine, as numbers (n, rays) of texels; from the count of all texels on, of
    cells of the environment, which has so many rows and columns; or -1, where there is
    no light: the back of a surface that has texels, or a shape that has none.

    The texels lie at places (n, 3) with unit shading normals. All have the same
    well-spread points, shifted by chance, of which `seed` is the number.
    """
    held = scene._scene
    to_local = to_map(scene)
    layers = layers_of(scene)
    count = len(places)
    texels = grids[-1].first + grids[-1].count
    steps = (
        np.arange(1, rays + 1)[:, None]
        * np.array([0.7548776662466927, 0.5698402909980532])
    ) % 1.0
    points = _points(mi.Point2f, steps)
    shifts = np.random.default_rng(seed).random((count, 2), dtype=np.float32)
    seen_by_rays = np.empty((count, rays), dtype=np.int32)
    for begin in range(0, count, max(1, PASS // rays)):
        some = slice(begin, min(count, begin + max(1, PASS // rays)))
        lane = dr.arange(mi.UInt32, (some.stop - begin) * rays)
        texel = lane // rays
        number = lane % rays

        # The same points for every texel, each shifted around the square by chance;
        # over the cosine
        shift = _points(mi.Point2f, shifts[some], texel)
        square = dr.gather(mi.Point2f, points, number) + shift
        square -= dr.floor(square)
        normal = _points(mi.Normal3f, normals[some], texel)
        place = _points(mi.Point3f, places[some], texel)
        way = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(square))
        si = stopped(
            held,
            mi.Ray3f(place + normal * SHIFT, way),
            layers,
            _chance(layers, len(lane), (seed, begin)),
        )

        # What escapes sees a cell of the environment; what stops sees a texel, or a
        # shape that has no light
        column, row = map_place(way, to_local)
        across = mi.UInt32(column * cells[1]) % cells[1]
        down = mi.UInt32(dr.minimum(row * cells[0], cells[0] - 1))
        seen = dr.select(
            si.is_valid(), mi.Int32(-1), mi.Int32(texels + down * cells[1] + across)
        )
        for grid, on in zip(grids, on_grids(held, grids, si, way), strict=True):
            if grid.warp is None and grid.side == 0:
                on &= dr.dot(si.n, way) < 0.0
            y, x = grid_place(grid, si.p, si.uv)
            nearest = mi.Int32(
                grid.first
                + _cell(y, grid.shape[0]) * grid.shape[1]
                + _cell(x, grid.shape[1])
            )
            seen = dr.select(on, nearest, seen)
        seen_by_rays[some] = seen.numpy().reshape(-1, rays)
    return seen_by_rays


def towards(
    scene: MitsubaScene, places: Floats, normals: Floats, ways: Floats
) -> Floats:
    """Return how much of what comes from unit directions (k, 3), in the axes of the
    environment's map, texels receive: (n, k) cosines; 0 where something is in between.
    The others as of `gather`.
    """
    # the transpose turns back
    world = (ways @ np.array(to_map(scene))).astype(np.float32)
    lane = dr.arange(mi.UInt32, len(places) * len(world))
    texel = lane // len(world)
    number = lane % len(world)
    place = _points(mi.Point3f, places, texel)
    normal = _points(mi.Normal3f, normals, texel)
    way = _points(mi.Vector3f, world, number)
    cosine = dr.dot(normal, way)
    active = above = cosine > 0.0
    ray = mi.Ray3f(place + normal * SHIFT, way)
    share = mi.Float(1.0)
    for _ in range(layers_of(scene)):  # cut-outs in the way
        si = scene._scene.ray_intersect(ray, mi.RayFlags.UV, False, active)
        active = active & si.is_valid()
        share = dr.select(active, share * passed(si, active), share)
        active = active & (share > 0.0)
        ray = si.spawn_ray(ray.d)
    share = dr.select(scene._scene.ray_test(ray, active), 0.0, share)
    return np.asarray(
        dr.select(above, cosine * share, 0.0).numpy().reshape(len(places), len(world))
    )


def seen_from_behind(scene: MitsubaScene, name: str, places: Floats) -> bool:
    """Whether backs of the faces of a shape, with places (n, 3) on it, are seen from
    outside, as through a window.
    """
    generator = np.random.default_rng(0)
    ways = generator.standard_normal((PASS >> 7, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ways[:, 2] = np.abs(ways[:, 2])
    targets = places[generator.integers(len(places), size=len(ways))]
    reach = 2.0 * float(np.ptp(places, axis=0).max())
    way = _points(mi.Vector3f, (-ways).astype(np.float32))
    ray = mi.Ray3f(
        _points(mi.Point3f, (targets + reach * ways).astype(np.float32)), way
    )
    layers = layers_of(scene)
    si = stopped(scene._scene, ray, layers, _chance(layers, len(ways), (0,)))
    (on,) = on_grids(scene._scene, [TexelGrid(name, 0, (1, 1))], si, way)
    behind = np.asarray((on & (dr.dot(si.n, way) > 0.0)).numpy())
    return bool(behind.sum() > FROM_BEHIND * np.asarray(on.numpy()).sum())


def layers_of(scene: MitsubaScene) -> int:
    """How many cut-outs its rays go through; 0 where it has none."""
    return LAYERS if scene.made[0].cut_out else 0


def stopped(
    held: Any, ray: Any, layers: int, chance: Any = 0.5, active: Any = True
) -> Any:
    """Return the first hits of rays in Mitsuba's scene that light does not pass. A ray
    goes on through cut-outs, up to `layers`, as long as the share of light that passes
    all it has met is larger than its chance in [0, 1].
    """
    si = held.ray_intersect(ray, mi.RayFlags.UV, False, active)
    share = mi.Float(1.0)
    for _ in range(layers):
        share *= passed(si, active)
        active = active & si.is_valid() & (share > chance)
        following = held.ray_intersect(
            si.spawn_ray(ray.d), mi.RayFlags.UV, False, active
        )
        si = dr.select(active, following, si)
    return si


def passed(si: Any, active: Any) -> Any:
    """The share of light that passes what was hit."""
    return dr.mean(si.bsdf().eval_null_transmission(si, active & si.is_valid()))


def _chance(layers: int, count: int, seed: tuple[int, ...]) -> Any:
    return (
        mi.Float(np.random.default_rng([*seed, 1]).random(count, dtype=np.float32))
        if layers
        else 0.5
    )


def on_grids(held: Any, grids: Grids, si: Any, way: Any) -> list[Any]:
    """Whether hits of rays in a direction lie on each grid."""
    front = dr.dot(si.n, way) < 0.0
    shapes = {shape.id(): shape for shape in held.shapes()}
    sides = {0: True, 1: front, -1: ~front}
    return [
        si.is_valid() & (si.shape == mi.ShapePtr(shapes[grid.name])) & sides[grid.side]
        for grid in grids
    ]


def to_map(scene: MitsubaScene) -> Any:
    """The turn from the world to the axes of the environment's map, three rows."""
    matrix = scene.parameters["environment.to_world"].matrix
    return np.array(matrix, dtype=np.float64).reshape(4, 4)[:3, :3].T.tolist()


def map_place(way: Any, to_local: Any) -> tuple[Any, Any]:
    """Where in the environment's map a direction lies: shares of its width and of its
    height.
    """
    x, y, z = (row[0] * way.x + row[1] * way.y + row[2] * way.z for row in to_local)
    across = dr.atan2(x, -z) / (2.0 * math.pi)
    return across - dr.floor(across), dr.safe_acos(y) / math.pi


def grid_place(grid: TexelGrid, place: Any, uv: Any) -> tuple[Any, Any]:
    """Where in a grid something lies: shares of its height and of its width."""
    if grid.warp is None:
        return uv.y - dr.floor(uv.y), uv.x - dr.floor(uv.x)
    middle_x, middle_y, scale, rate = grid.warp

    def share(far: Any) -> Any:
        return dr.clip(0.5 + dr.asinh(far) / (2.0 * rate), 0.0, 1.0)

    return share((place.y - middle_y) / scale), share((place.x - middle_x) / scale)


def _cell(share: Any, count: int) -> Any:
    return mi.Int32(dr.minimum(share * count, count - 1.0))


def _points(kind: Any, values: Floats | Doubles, index: Any = None) -> Any:
    """Rows of numbers as Dr.Jit's points, vectors or normals; of an index, one for each
    lane.
    """
    points = kind(
        *(
            mi.Float(np.ascontiguousarray(column, dtype=np.float32))
            for column in values.T
        )
    )
    return points if index is None else dr.gather(kind, points, index)


ANGLES = 32  # entries of a table over the cosine of the angle of view
LOBE_SAMPLES = 4096
# the tables of `Lobes`, in their order
TABLES = ("diffuse", "gloss", "up", "along", "core", "tail")


@dataclass(frozen=True, eq=False)
class Lobes:
    """What a surface does to light, by the cosine of the angle of view (`ANGLES`
    entries, the first at grazing).
    """

    # (k,) share of even light that it reflects for a base colour of one, without the
    # gloss
    diffuse: Floats
    gloss: Floats  # (k,) share of even light that it reflects whatever the base colour
    up: Floats  # (k,) of the gloss's mean direction: its part along the normal
    along: Floats  # (k,) and its part away from the viewer
    # (k,) root mean square angle about that direction, radians, of the nearer half of
    # the gloss
    core: Floats
    # (k,) and of the other half: a lobe has longer tails than a normal distribution
    tail: Floats

    @classmethod
    def matt(cls) -> Lobes:
        """Those of a diffuse surface."""
        whole = np.ones(ANGLES, dtype=np.float32)
        none = np.zeros(ANGLES, dtype=np.float32)
        return cls(whole, none, whole, none, none, none)

    @property
    def mean_shares(self) -> tuple[float, float]:
        """Both shares under even light from everywhere, over all angles of view."""
        weight = (np.arange(ANGLES) + 0.5) * 2.0 / ANGLES**2
        return float((weight * self.diffuse).sum()), float((weight * self.gloss).sum())


def measured(
    scene: MitsubaScene,
    inputs: Mapping[str, Tensor],
    grid: TexelGrid,
    place: Floats,
    normal: Floats,
) -> Lobes:
    """Measure the BSDF of a shape, by sampling it, at one of its texels: a (3,) place
    and the unit normal there.
    """
    key = f"{grid.name}.base_color"
    with one_at_a_time:
        middle = (np.arange(ANGLES) + 0.5) / ANGLES
        cosine = dr.repeat(mi.Float(middle.astype(np.float32)), LOBE_SAMPLES)
        towards = mi.Vector3f(dr.sqrt(1.0 - cosine * cosine), 0.0, cosine)
        noise = mi.load_dict({"type": "independent"})
        noise.seed(0, ANGLES * LOBE_SAMPLES)
        sample1 = noise.next_1d()
        sample2 = noise.next_2d()
        even = mi.warp.square_to_cosine_hemisphere(sample2)
        sampled = []
        for level in (0.5, 0.0):
            changed = (
                {key: torch.full_like(scene.base(key), level)}
                if key in scene.names
                else {}
            )
            held = scene.held({**inputs, **changed})
            start = mi.Point3f([float(x) for x in place + 1e-3 * normal])
            ray = mi.Ray3f(start, mi.Vector3f([float(-x) for x in normal]))
            si = held.ray_intersect(
                dr.gather(mi.Ray3f, ray, dr.zeros(mi.UInt32, ANGLES * LOBE_SAMPLES))
            )
            bsdf = si.bsdf()
            si.wi = towards
            # of cut-outs, what stops light
            opaque = dr.maximum(1.0 - passed(si, True), 1e-3)
            value = bsdf.eval(mi.BSDFContext(), si, even) / opaque
            if level:
                sampled.append(dr.mean(value))
                continue
            bsdf_sample, bsdf_weight = bsdf.sample(
                mi.BSDFContext(), si, sample1, sample2
            )
            back = dr.select(
                (bsdf_sample.pdf > 0.0) & (bsdf_sample.wo.z > 0.0),
                dr.mean(bsdf_weight) / opaque,
                0.0,
            )
            back = dr.select(dr.isfinite(back), back, 0.0)
            sampled += [dr.mean(value), back, bsdf_sample.wo.x, bsdf_sample.wo.z]
    lit, dark = (
        _rows(value.numpy()) / _rows(even.z.numpy() / math.pi) for value in sampled[:2]
    )
    weight, x, z = (_rows(value.numpy()) for value in sampled[2:])
    share = weight.mean(axis=1)
    mean = np.stack([(weight * x).mean(axis=1), (weight * z).mean(axis=1)])
    length = np.linalg.norm(mean, axis=0)
    mirrored = share < 1e-6
    along = np.where(
        mirrored, -np.sqrt(1.0 - middle**2), mean[0] / np.maximum(length, 1e-12)
    )
    up = np.where(mirrored, middle, mean[1] / np.maximum(length, 1e-12))
    core, tail = _spreads(
        weight, 2.0 * np.maximum(0.0, 1.0 - x * along[:, None] - z * up[:, None])
    )
    diffuse = np.maximum(lit.mean(axis=1) - dark.mean(axis=1), 0.0) / 0.5
    return Lobes(
        *(part.astype(np.float32) for part in (diffuse, share, up, -along, core, tail))
    )


def _spreads(weight: Doubles, apart: Doubles) -> tuple[Doubles, Doubles]:
    """Root mean squares (k,) of the nearer and of the farther half of weighted samples
    (k, n), by squares of angles.
    """
    order = np.argsort(apart, axis=1)
    weight, apart = (
        np.take_along_axis(values, order, axis=1) for values in (weight, apart)
    )
    total = weight.sum(axis=1, keepdims=True)
    near = np.clip(0.5 * total - (weight.cumsum(axis=1) - weight), 0.0, weight)
    half = np.maximum(0.5 * total[:, 0], 1e-12)
    return np.sqrt((near * apart).sum(axis=1) / half), np.sqrt(
        ((weight - near) * apart).sum(axis=1) / half
    )


def _rows(values: npt.NDArray[Any]) -> Doubles:
    return np.asarray(values, dtype=np.float64).reshape(ANGLES, LOBE_SAMPLES)
