"""The `material` control: reflection, tint and named materials of the object's surface.

    base_color = linear(tint) * (the object's texture, or the named material's pattern)

The numbers are those of the principled BSDF (Burley, *Physically based shading at
Disney*, SIGGRAPH 2012 course notes). A named material, such as "wood", has a seamless
pattern and other numbers, as in 3DB (Leclerc et al. 2021, arXiv 2106.03805).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from advsearch.controls.base import Control, Values
from advsearch.controls.ranges import ParameterValue
from advsearch.errors import InputError
from advsearch.scene import color
from advsearch.scene.assets import Float32Array, Float64Array, Material, Mesh
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.raster import look_up_texture, rasterize_charts
from advsearch.scene.settings import CHANNELS, MATERIAL, Parameter

# --------------------------------------------------------------------------------------
# Procedural materials: patterns, and how they cover an object.
#
# Each pattern is a square tile that repeats without a visible seam (3DB, Leclerc et al.
# 2021, arXiv 2106.03805, section 4), made of periodic gradient noise (Perlin 1985), cells
# (Worley 1996), and iterated band-pass filtering (Turing 1952; Young 1984).

Grid = tuple[Float64Array, Float64Array]
"""Coordinates x (to the right) and y (down) of texel centers, each (SIDE, SIDE) in (0,
1).
"""

TILE_SIDE = 512  # side of a tile in texels
# The weight of each of the three projections of a tile is this power of a component of
# the normal. The larger it is, the sharper are the borders between projections.
BLEND_EXPONENT = 20.0


@dataclass(frozen=True)
class Pattern:
    """A named material.

    Attributes:
        name: name, such as "wood".
        tile_size: side of the tile on the object, in object sizes.
        material: surface numbers, such as the roughness.
        paint: function that returns the tile (SIDE, SIDE, 3), display-referred sRGB,
            at the texels of a `Grid`. Values outside of [0, 1] are clipped later.
    """

    name: str
    tile_size: float
    material: Material
    paint: Callable[[Grid], Float64Array]


PATTERNS: dict[str, Pattern] = {}  # all named materials by name


def register_pattern(
    *, tile_size: float, **surface: float
) -> Callable[[Callable[[Grid], Float64Array]], None]:
    """Return a decorator that registers a function as a named material.

    The material gets the name of the function, which is then called through `PATTERNS`
    only.

    Args:
        tile_size: side of the tile on the object, in object sizes.
        **surface: numbers of the `Material`, such as the roughness.
    """

    def register(paint: Callable[[Grid], Float64Array]) -> None:
        PATTERNS[paint.__name__] = Pattern(
            paint.__name__, tile_size, Material(**surface), paint
        )

    return register


# ---- building blocks, periodic with the period 1 in x and y


def _noise(grid: Grid, cells: tuple[int, int], seed: int) -> Float64Array:
    """Return gradient noise (Perlin 1985) on a tile: about -1 to 1, with mean 0.

    The noise is periodic, so that tiles meet without a seam.

    Args:
        grid: x and y of the texels, where the tile has length 1.
        cells: number of lattice cells along x and along y. With few along x and many
            along y, features are long in x.
        seed: seed of the gradients.
    """
    columns, rows = cells
    generator = np.random.Generator(np.random.PCG64(seed))
    angle = generator.uniform(0.0, 2.0 * np.pi, (rows, columns))
    left = np.floor(grid[0] * columns)
    top = np.floor(grid[1] * rows)
    x = grid[0] * columns - left
    y = grid[1] * rows - top
    lattice = _Lattice(angle, left.astype(np.int64), top.astype(np.int64), x, y)
    x_weight = _fade(x)
    y_weight = _fade(y)
    upper = lattice.mix_corners(0, x_weight)
    lower = lattice.mix_corners(1, x_weight)
    # times 1.5, since such sums of unit gradients rarely exceed 2 / 3
    return np.asarray((upper * (1.0 - y_weight) + lower * y_weight) * 1.5)


class _Lattice(NamedTuple):
    """A periodic lattice of gradients, and the position of each texel in it.

    Attributes:
        angle: (rows, columns) angle of the gradient at each corner of cells, radians.
        column: (SIDE, SIDE) column of the cell that each texel is in.
        row: (SIDE, SIDE) row of this cell.
        x: (SIDE, SIDE) position of each texel in the cell, 0 at the left and 1 at the
            right.
        y: (SIDE, SIDE) the same, 0 at the top.
    """

    angle: Float64Array
    column: npt.NDArray[np.int64]
    row: npt.NDArray[np.int64]
    x: Float64Array
    y: Float64Array

    def mix_corners(self, below: int, right_weight: Float64Array) -> Float64Array:
        """Return the mean of the left and the right corner, by the weight of the right.

        `below` is 0 for the upper corners of the cell, and 1 for the lower ones.
        """
        left = self.project_gradient(0, below)
        right = self.project_gradient(1, below)
        return left * (1.0 - right_weight) + right * right_weight

    def project_gradient(self, right: int, below: int) -> Float64Array:
        """Return the dot product of a corner's gradient and the offset from it.

        `right` and `below` are 0 or 1: the corner of the cell, from its upper left.
        """
        rows, columns = self.angle.shape
        # the lattice is periodic
        turn = self.angle[(self.row + below) % rows, (self.column + right) % columns]
        x_part = np.cos(turn) * (self.x - right)
        y_part = np.sin(turn) * (self.y - below)
        return np.asarray(x_part + y_part)


def _fade(position: Float64Array) -> Float64Array:
    """Return the weight of the right or lower corner at a position in a lattice cell.

    It rises smoothly from 0 at the position 0 to 1 at the position 1.
    """
    cubed = position * position * position
    return np.asarray(cubed * (position * (position * 6.0 - 15.0) + 10.0))


def _clouds(
    grid: Grid, cells: tuple[int, int], octaves: int, seed: int
) -> Float64Array:
    """Return the sum of octaves of noise, from about -1 to 1.

    Each octave is twice as fine and half as strong as the one before.

    Args:
        grid: x and y of the texels, where the tile has length 1.
        cells: number of cells of the first octave along x and along y.
        octaves: number of octaves.
        seed: seed of the noise.
    """
    total = np.zeros_like(grid[0])
    for octave in range(octaves):
        total += 0.5**octave * _noise(
            grid,
            cells=(cells[0] << octave, cells[1] << octave),
            seed=seed + 101 * octave,
        )
    sum_of_weights = 2.0 - 0.5 ** (octaves - 1)
    return total / sum_of_weights


def _warp_grid(grid: Grid, cells: int, amount: float, seed: int) -> Grid:
    """Return coordinates displaced by noise, so that a pattern becomes irregular.

    Args:
        grid: x and y of the texels, where the tile has length 1.
        cells: number of cells of the noise along each side.
        amount: largest displacement, about.
        seed: seed of the noise.
    """
    right = _clouds(grid, cells=(cells, cells), octaves=2, seed=seed)
    down = _clouds(grid, cells=(cells, cells), octaves=2, seed=seed + 7)
    return grid[0] + amount * right, grid[1] + amount * down


def _scatter_points(count: int, seed: int) -> Float64Array:
    """Return irregular points of a torus, far from each other: (count, 2) in [0, 1).

    This is best candidate sampling (Mitchell 1991): of 16 random candidates, the one
    that is farthest from all points so far becomes the next point.
    """
    generator = np.random.Generator(np.random.PCG64(seed))
    points = generator.random((1, 2))
    while len(points) < count:
        candidates = generator.random((16, 2))
        offset = np.abs(candidates[:, None] - points[None])  # (16, N, 2)
        offset = np.minimum(offset, 1.0 - offset)  # shorter direction on the torus
        nearest_distance = (offset**2).sum(-1).min(1)
        farthest = np.argmax(nearest_distance)
        points = np.concatenate([points, candidates[[farthest]]])
    return np.asarray(points)


def _find_nearest_points(
    grid: Grid, points: Float64Array, count: int = 2
) -> tuple[Float64Array, npt.NDArray[np.int64]]:
    """Find the points that are nearest to each texel of a tile, nearest first.

    The tile is a torus: distances go on across its borders.

    Args:
        grid: coordinates of the texels, in tiles.
        points: (N, 2) in [0, 1).
        count: how many of the nearest points are returned.

    Returns:
        Distances (SIDE, SIDE, count) in tiles, and indices of the points.
    """
    positions = np.stack([grid[0] % 1.0, grid[1] % 1.0], axis=-1)
    # The tree needs positions below 1, but a remainder may be rounded to 1.
    positions = np.minimum(positions, np.nextafter(1.0, 0.0))
    distance, index = cKDTree(points, boxsize=1.0).query(positions, k=count)
    return np.asarray(distance), np.asarray(index, dtype=np.int64)


def _grow_turing_pattern(
    wavelength: tuple[float, float], bias: float, seed: int, rounds: int = 12
) -> Float64Array:
    """Return animal stripes or spots (SIDE, SIDE) in [-1, 1].

    Noise is filtered to waves of about one length and then saturated, many times. After
    about ten rounds the pattern no longer changes.

    Args:
        wavelength: wavelength along x and along y, in tiles. If they differ, stripes
            repeat along the direction of the shorter one.
        bias: number that is added before saturation. If it is not near 0, the result is
            spots instead of stripes.
        seed: seed of the noise.
        rounds: number of filterings.
    """
    band = _make_band_filter(wavelength)
    generator = np.random.Generator(np.random.PCG64(seed))
    field = generator.standard_normal((TILE_SIDE, TILE_SIDE))
    for _ in range(rounds):
        field = np.fft.ifft2(np.fft.fft2(field) * band).real
        # the larger the factor, the harder the edges of stripes
        field = np.tanh(2.5 * field / field.std() + bias)
    return np.asarray(field)


def _make_band_filter(wavelength: tuple[float, float]) -> Float64Array:
    """Return the factor (SIDE, SIDE) of each frequency in a filter for some waves.

    It passes frequencies within about 22 % of one wave per wavelength, which is along x
    and along y, in tiles.
    """
    frequency = np.fft.fftfreq(TILE_SIDE, 1.0 / TILE_SIDE)
    x_waves = frequency[None, :] * wavelength[0]
    y_waves = frequency[:, None] * wavelength[1]
    radius = np.hypot(x_waves, y_waves)
    return np.asarray(np.exp(-(((radius - 1.0) / 0.22) ** 2)))


def _step(value: Float64Array, edge: float | Float64Array, soft: float) -> Float64Array:
    """Return 0 below the edge and 1 above it, with a smooth ramp `soft` wide."""
    fraction = np.clip((value - edge) / soft + 0.5, 0.0, 1.0)
    return np.asarray(fraction * fraction * (3.0 - 2.0 * fraction))


def _color(code: str) -> Float64Array:
    return np.array([int(code[i : i + 2], 16) / 255.0 for i in (0, 2, 4)])


def _mix(
    first: Float64Array, second: Float64Array, fraction: Float64Array
) -> Float64Array:
    """Interpolate from the first color to the second.

    Colors are (3,) or (SIDE, SIDE, 3), fractions (SIDE, SIDE).
    """
    return np.asarray(first + (second - first) * fraction[..., None])


def _ramp(value: Float64Array, *codes: str) -> Float64Array:
    """Interpolate colors that are evenly spaced over values from 0 to 1."""
    colors = np.stack([_color(code) for code in codes])
    stops = np.linspace(0.0, 1.0, len(codes))
    return np.stack(
        [np.interp(value, stops, colors[:, channel]) for channel in range(3)], axis=-1
    )


# ---- the patterns


@register_pattern(tile_size=1.0, roughness=0.5)
def plain(grid: Grid) -> Float64Array:
    return np.ones((TILE_SIDE, TILE_SIDE, 3))


@register_pattern(tile_size=0.6, roughness=0.45)
def wood(grid: Grid) -> Float64Array:
    """Paint wood with rings, fibers and pores along y, (SIDE, SIDE, 3) sRGB.

    Frequencies, strengths and colors are chosen by eye.
    """
    x, y = grid
    bend = _bend_rings(grid)
    rings = 9.0 * (x + bend) + 0.25 * _noise(grid, cells=(5, 2), seed=17)
    late_wood = _paint_late_wood(rings % 1.0)
    bent_grid = (x + 0.6 * bend, y)
    coarse_fibre = _noise(bent_grid, cells=(120, 3), seed=13)
    fibre = coarse_fibre + 0.6 * _noise(bent_grid, cells=(240, 5), seed=18)
    pores = _step(_noise(bent_grid, cells=(170, 12), seed=14), edge=0.5, soft=0.2)
    shade = _noise(grid, cells=(3, 1), seed=15)
    tone = 0.30 + 0.42 * late_wood + 0.13 * fibre + 0.16 * shade
    grain = _ramp(tone, "dcb27a", "c8955a", "a06c38", "784824")
    return _mix(grain, _color("5a3519"), 0.4 * pores)


def _bend_rings(grid: Grid) -> Float64Array:
    """Return how far the rings of wood are shifted along x at each texel, in tiles."""
    wide_bend = _clouds(grid, cells=(2, 1), octaves=2, seed=11)
    narrow_bend = _noise(grid, cells=(8, 3), seed=12)
    return 0.16 * wide_bend + 0.012 * narrow_bend


def _paint_late_wood(phase: Float64Array) -> Float64Array:
    """Return how dark wood is, 0 to 1, at a phase of the year from 0 to 1.

    A ring darkens slowly during a year, and ends suddenly.
    """
    darkening = _step(phase, edge=0.66, soft=0.6)
    end_of_year = _step(phase, edge=0.96, soft=0.08)
    return darkening * (1.0 - end_of_year)


@register_pattern(tile_size=0.9, roughness=0.15)
def marble(grid: Grid) -> Float64Array:
    """Paint marble, light clouds with dark veins, (SIDE, SIDE, 3) sRGB.

    Frequencies, strengths and colors are chosen by eye.
    """
    warped = _warp_grid(grid, cells=2, amount=0.22, seed=21)
    finely_warped = _warp_grid(warped, cells=6, amount=0.03, seed=22)
    clouds = 0.5 + 0.5 * _clouds(warped, cells=(3, 3), octaves=4, seed=25)
    grayness = 0.8 * _step(clouds, edge=0.58, soft=0.8)
    clouded = _mix(_color("f4f2ee"), _color("c6c8ca"), grayness)
    veins = _paint_all_veins(warped, finely_warped)
    return _mix(clouded, _color("4c5159"), np.clip(veins, 0.0, 0.9))


def _paint_all_veins(warped: Grid, finely_warped: Grid) -> Float64Array:
    """Return how dark three families of veins make each texel, (SIDE, SIDE).

    The families go from wide and dark to fine and pale; see `_paint_veins`.
    """
    paint_veins = partial(_paint_veins, warped, finely_warped)
    return (
        paint_veins(n_right=1, n_down=1, width=0.05, depth=0.75, seed=23)
        + paint_veins(n_right=2, n_down=1, width=0.02, depth=0.45, seed=24)
        + paint_veins(n_right=1, n_down=3, width=0.012, depth=0.3, seed=26)
    )


def _paint_veins(
    warped: Grid,
    finely_warped: Grid,
    *,
    n_right: int,
    n_down: int,
    width: float,
    depth: float,
    seed: int,
) -> Float64Array:
    """Return how dark a family of parallel veins makes each texel, (SIDE, SIDE).

    Args:
        warped: warped coordinates of the texels, for the strength along the veins.
        finely_warped: coordinates with finer warps, for the shape of the veins.
        n_right: number of veins that a line along x crosses in a tile.
        n_down: number of veins that a line along y crosses in a tile.
        width: width of a vein, see `_compute_vein_profile`.
        depth: darkness of a vein where it is strongest.
        seed: seed of the noise.
    """
    turbulence = 0.5 * _clouds(finely_warped, cells=(2, 2), octaves=4, seed=seed)
    patches = _clouds(warped, cells=(3, 3), octaves=2, seed=seed + 50)
    strength = 0.25 + 0.75 * _step(patches, edge=0.0, soft=0.8)
    x, y = finely_warped
    # The numbers of veins are integers, so that veins continue across the tile's borders.
    phase = n_right * x + n_down * y + turbulence
    return np.asarray(depth * strength * _compute_vein_profile(phase, width))


def _compute_vein_profile(phase: Float64Array, width: float) -> Float64Array:
    """Return how dark a texel is: veins with a core and a halo at integer phases.

    Args:
        phase: (SIDE, SIDE) phase, which increases by 1 from vein to vein.
        width: width of the core. The unit is that of `distance`.
    """
    # 0 on a vein, 1 halfway between two veins
    distance = np.abs(np.sin(np.pi * phase))
    core = np.exp(-((distance / width) ** 2))
    # weaker than the core and four times as wide, chosen by eye
    halo = 0.3 * np.exp(-(distance / (4.0 * width)))
    return np.asarray(core + halo)


@register_pattern(tile_size=0.6, roughness=0.9, specular=0.2)
def brick(grid: Grid) -> Float64Array:
    """Paint a wall of bricks with mortar, (SIDE, SIDE, 3) sRGB.

    Frequencies, strengths and colors are chosen by eye.
    """
    x, y = _warp_grid(grid, cells=12, amount=0.0035, seed=31)
    rows = 8
    columns = 4
    row = np.floor(y * rows)
    # every other course is shifted by half a brick
    course_x = x * columns + 0.5 * (row % 2.0)
    column = np.floor(course_x) % columns
    solid = _find_solid(grid, course_x, y * rows)
    tone = np.random.Generator(np.random.PCG64(33)).random((rows, columns))
    brick_tone = tone[row.astype(np.int64) % rows, column.astype(np.int64)]
    grain = _clouds(grid, cells=(80, 80), octaves=2, seed=36)
    mortar = _color("c3bbac") + 0.10 * grain[..., None]
    return _mix(mortar, _paint_fired_clay(grid, brick_tone), solid)


def _find_solid(
    grid: Grid, x_in_bricks: Float64Array, y_in_bricks: Float64Array
) -> Float64Array:
    """Return 1 on a brick, and 0 near its edges, where the mortar is, (SIDE, SIDE).

    Args:
        grid: coordinates of the texels.
        x_in_bricks: (SIDE, SIDE) position of each texel, in lengths of a brick.
        y_in_bricks: (SIDE, SIDE) position of each texel, in heights of a brick.
    """
    # Distances to the edges of the brick, as fractions of its height. It is twice as
    # long as high, so that a fraction of its length is doubled.
    edge_x = 2.0 * (0.5 - np.abs(x_in_bricks % 1.0 - 0.5))
    edge_y = 0.5 - np.abs(y_in_bricks % 1.0 - 0.5)
    roughness = 0.02 * _noise(grid, cells=(60, 60), seed=32)
    return _step(np.minimum(edge_x, edge_y) + roughness, edge=0.075, soft=0.05)


def _paint_fired_clay(grid: Grid, brick_tone: Float64Array) -> Float64Array:
    """Return the color (SIDE, SIDE, 3) of bricks, with grain and dark stains.

    `brick_tone` (SIDE, SIDE) in [0, 1] is the random tone of each brick.
    """
    grain = _clouds(grid, cells=(40, 40), octaves=3, seed=34)
    clay = _ramp(
        brick_tone + 0.22 * grain, "7c2f22", "9a3f2b", "ad4d35", "bd6547", "a5553c"
    )
    stains = 0.5 * _step(
        _clouds(grid, cells=(70, 70), octaves=2, seed=35), edge=0.35, soft=0.2
    )
    return _mix(clay, _color("4f211a"), stains)


@register_pattern(tile_size=0.45, roughness=0.95, specular=0.1)
def fabric(grid: Grid) -> Float64Array:
    """Paint a plain weave of two threads, (SIDE, SIDE, 3) sRGB.

    Frequencies, strengths and colors are chosen by eye.
    """
    x, y = _warp_grid(grid, cells=6, amount=0.004, seed=41)
    count = 16  # threads in each direction
    thread_x = x * count
    thread_y = y * count
    # The warp is the upright thread. In a plain weave it lies over the level thread in
    # every second cell, like the fields of a chessboard.
    warp_is_over = (np.floor(thread_x) + np.floor(thread_y)) % 2.0 > 0.5
    height = _compute_thread_height(thread_x, thread_y, warp_is_over)
    warp_fibres = _noise((x, y), cells=(count * 8, count), seed=42)
    weft_fibres = _noise((x, y), cells=(count, count * 8), seed=43)
    fibres = np.where(warp_is_over, warp_fibres, weft_fibres)
    generator = np.random.Generator(np.random.PCG64(44))
    warp = _color("b9a77f") * _draw_thread_tones(generator, thread_x, count)
    weft = _color("3f5f86") * _draw_thread_tones(generator, thread_y, count)
    thread = np.where(warp_is_over[..., None], warp, weft)
    return thread * (0.25 + 0.75 * height**0.7 + 0.14 * fibres)[..., None]


def _compute_thread_height(
    thread_x: Float64Array, thread_y: Float64Array, warp_is_over: npt.NDArray[np.bool_]
) -> Float64Array:
    """Return the height (SIDE, SIDE) of the upper thread, from 0 to 1.

    Args:
        thread_x: (SIDE, SIDE) position across the warp threads, in threads.
        thread_y: (SIDE, SIDE) position across the weft threads, in threads.
        warp_is_over: (SIDE, SIDE) whether the warp is the upper thread.
    """
    # height of the round warp and weft threads across their widths, from 0 to 1
    round_x = np.sin(np.pi * (thread_x % 1.0))
    round_y = np.sin(np.pi * (thread_y % 1.0))
    # The upper thread is highest in the middle of the lower one, and bends down at its
    # sides.
    warp_height = round_x * (0.55 + 0.45 * round_y)
    weft_height = round_y * (0.55 + 0.45 * round_x)
    return np.where(warp_is_over, warp_height, weft_height)


def _draw_thread_tones(
    generator: np.random.Generator, position: Float64Array, count: int
) -> Float64Array:
    """Return the random tone (SIDE, SIDE, 1) of the thread that each texel is in.

    Args:
        generator: generator of random numbers; it advances.
        position: (SIDE, SIDE) position of each texel, in threads.
        count: number of different threads.
    """
    tone = generator.uniform(0.8, 1.1, count)
    return np.asarray(tone[np.floor(position).astype(np.int64) % count][..., None])


@register_pattern(tile_size=0.7, roughness=0.8, specular=0.2)
def leopard(grid: Grid) -> Float64Array:
    """Paint a leopard's rosettes with dots between them, (SIDE, SIDE, 3) sRGB.

    Numbers and colors are chosen by eye; lengths are in tiles.
    """
    broadly_warped = _warp_grid(grid, cells=4, amount=0.03, seed=51)
    warped = _warp_grid(broadly_warped, cells=12, amount=0.012, seed=52)
    points = _scatter_points(count=42, seed=53)
    distances, indices = _find_nearest_points(warped, points)
    # distance and index of the rosette that each texel belongs to
    distance = distances[..., 0]
    index = indices[..., 0]
    rosettes, core = _draw_rosettes(warped, points, distance, index)
    fur = _clouds(grid, cells=(24, 90), octaves=2, seed=55)
    coat = _mix(_paint_coat(grid), _color("a9692f"), 0.75 * core)
    between_rosettes = _step(distance, edge=0.07, soft=0.012)
    spots = np.clip(rosettes + _draw_dots(warped) * between_rosettes, 0.0, 1.0)
    return _mix(coat * (1.0 + 0.10 * fur)[..., None], _color("221710"), spots)


def _paint_coat(grid: Grid) -> Float64Array:
    """Return the color (SIDE, SIDE, 3) of a leopard's coat between its spots."""
    shade = 0.5 + 0.5 * _clouds(grid, cells=(3, 3), octaves=2, seed=56)
    return _mix(_color("d8a861"), _color("e7c58c"), shade)


def _draw_dots(grid: Grid) -> Float64Array:
    """Return the opacity (SIDE, SIDE) of scattered dots, from 0 to 1."""
    points = _scatter_points(count=150, seed=57)
    # (SIDE, SIDE): SciPy returns no axis of neighbors if there is only one.
    distance, _ = _find_nearest_points(grid, points, count=1)
    return 1.0 - _step(distance, edge=0.011, soft=0.006)


def _draw_rosettes(
    grid: Grid,
    points: Float64Array,
    distance: Float64Array,
    index: npt.NDArray[np.int64],
) -> tuple[Float64Array, Float64Array]:
    """Draw rings with gaps around points, and the cores inside of the rings.

    All numbers are chosen by eye; lengths are in tiles.

    Args:
        grid: coordinates of the texels.
        points: (N, 2) centers of the rings, on the torus.
        distance: (SIDE, SIDE) from each texel to the nearest point.
        index: (SIDE, SIDE) index of that point.

    Returns:
        Opacity of the rings and of the cores, from 0 to 1, (SIDE, SIDE) each.
    """
    generator = np.random.Generator(np.random.PCG64(seed=54))
    # Each rosette has a size and a turn; these are the ones of each texel's rosette.
    size = generator.uniform(0.85, 1.15, len(points))[index]
    turn = generator.uniform(0.0, 2.0 * np.pi, len(points))[index]
    radius = distance / size
    angle = _compute_angles(grid, points[index])
    ring = _draw_broken_rings(radius, angle, turn)
    # The core reaches below the ring, and is visible in its gaps.
    core = 1.0 - _step(radius, edge=0.042, soft=0.02)
    return ring, core


def _draw_broken_rings(
    radius: Float64Array, angle: Float64Array, turn: Float64Array
) -> Float64Array:
    """Return the opacity (SIDE, SIDE), from 0 to 1, of rings with gaps.

    All arguments are (SIDE, SIDE), a value for each texel.

    Args:
        radius: distance from the center of its ring, in tiles, divided by the ring's
            size.
        angle: direction from that center, radians.
        turn: angle by which its ring is turned, radians.
    """
    # A ring is between two edges. The outer one is not quite a circle.
    beyond_inner_edge = _step(radius, edge=0.031, soft=0.008)
    outer_edge = 0.056 + 0.004 * np.cos(angle + turn)
    beyond_outer_edge = _step(radius, edge=outer_edge, soft=0.008)
    ring = beyond_inner_edge * (1.0 - beyond_outer_edge)
    # It has gaps at the angles where the waves are low.
    waves = np.cos(3.0 * angle + turn) + 0.6 * np.cos(2.0 * angle - 2.0 * turn)
    opacity_at_angle = _step(waves, edge=-0.75, soft=0.5)
    return np.asarray(ring * opacity_at_angle)


def _compute_angles(grid: Grid, points: Float64Array) -> Float64Array:
    """Return the angle (SIDE, SIDE), radians, at which each texel is from its point.

    `points` (SIDE, SIDE, 2) are on the torus.
    """
    # offsets from the point, in the shorter direction on the torus: -0.5 to 0.5
    x_offset = (grid[0] - points[..., 0] + 0.5) % 1.0 - 0.5
    y_offset = (grid[1] - points[..., 1] + 0.5) % 1.0 - 0.5
    return np.asarray(np.arctan2(y_offset, x_offset))


@register_pattern(tile_size=0.8, roughness=0.8, specular=0.2)
def zebra(grid: Grid) -> Float64Array:
    """Paint a zebra's stripes, which are long in x, (SIDE, SIDE, 3) sRGB.

    Frequencies, strengths and colors are chosen by eye.
    """
    stripes = _grow_turing_pattern(wavelength=(0.42, 0.125), bias=0.0, seed=61)
    black = _step(
        stripes + 0.12 * _noise(grid, cells=(10, 40), seed=62), edge=0.0, soft=0.7
    )
    fur = 1.0 + 0.06 * _clouds(grid, cells=(30, 110), octaves=2, seed=63)
    return _mix(_color("efeae0"), _color("17140f"), black) * fur[..., None]


@register_pattern(tile_size=0.5, roughness=0.4)
def checker(grid: Grid) -> Float64Array:
    """Paint a checkerboard of 4 by 4 squares, (SIDE, SIDE, 3) sRGB."""
    x, y = grid
    is_dark = (np.floor(4.0 * x) + np.floor(4.0 * y)) % 2.0
    return _mix(_color("f2f2f0"), _color("191919"), is_dark)


@register_pattern(tile_size=0.7, roughness=0.85, metallic=0.1, specular=0.3)
def rust(grid: Grid) -> Float64Array:
    """Paint rust under flakes of paint, (SIDE, SIDE, 3) sRGB.

    Frequencies, strengths and colors are chosen by eye.
    """
    warped = _warp_grid(grid, cells=4, amount=0.06, seed=71)
    oxide = _paint_oxide(grid, warped)
    paint_grain = _clouds(grid, cells=(20, 20), octaves=2, seed=74)
    paint = _color("5d6668") + 0.05 * paint_grain[..., None]
    finely_warped = _warp_grid(warped, cells=16, amount=0.015, seed=75)
    flakes = _clouds(finely_warped, cells=(4, 4), octaves=4, seed=76)
    surface = _cover_with_flakes(oxide, paint, flakes)
    pits = _step(_noise(grid, cells=(70, 70), seed=77), edge=0.5, soft=0.15)
    return _mix(surface, _color("1b0d09"), 0.6 * pits)


def _cover_with_flakes(
    oxide: Float64Array, paint: Float64Array, flakes: Float64Array
) -> Float64Array:
    """Return oxide under flakes of paint that have dark rims, (SIDE, SIDE, 3) sRGB.

    Args:
        oxide: (SIDE, SIDE, 3) sRGB color of the oxide.
        paint: (SIDE, SIDE, 3) sRGB color of the paint.
        flakes: (SIDE, SIDE) noise; paint is left where it is high.
    """
    # The remaining paint, and a dark rim around it: a slightly larger area without the
    # paint itself.
    paint_left = _step(flakes, edge=0.26, soft=0.05)
    paint_and_rim = _step(flakes, edge=0.20, soft=0.10)
    rim = paint_and_rim - paint_left
    rimmed_oxide = _mix(oxide, _color("20100b"), 0.7 * np.clip(rim, 0.0, 1.0))
    return _mix(rimmed_oxide, paint, 0.85 * paint_left)


def _paint_oxide(grid: Grid, warped: Grid) -> Float64Array:
    """Return the color (SIDE, SIDE, 3) of bare rust."""
    broad = 0.5 + 0.5 * _clouds(warped, cells=(3, 3), octaves=5, seed=72)
    grain = _clouds(grid, cells=(48, 48), octaves=3, seed=73)
    tone = np.clip(1.5 * (broad - 0.5) + 0.5 + 0.22 * grain, 0.0, 1.0)
    return _ramp(tone, "2e1710", "5a2712", "8b3f16", "b5591d", "cf7b33")


def _bend_blades(
    root: Float64Array,
    lean: Float64Array,
    bend: Float64Array,
    length: Float64Array,
    along: Float64Array,
    across: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return x and y (blades, along, across) of the samples of bent blades.

    Args:
        root: (blades, 1, 1, 2) positions of their roots, in tiles.
        lean: (blades, 1, 1) direction at the root, radians.
        bend: (blades, 1, 1) angle by which they turn from the root to the tip, radians.
        length: (blades, 1, 1) lengths, in tiles.
        along: (1, along, 1) positions of the samples along a blade, 0 to 1.
        across: (1, 1, across) positions across a blade, -1 to 1.
    """
    # half the width of a blade is 0.0042 tiles at the root (by eye), and 0 at the tip
    offset = across * 0.0042 * (1.0 - along**2)
    # A blade is an arc of a circle. The chord from the root to a sample points halfway
    # between the headings at its ends; its length is almost that of the arc.
    heading = lean + bend * along
    chord_heading = lean + 0.5 * bend * along
    chord = length * along
    x = root[..., 0] + chord * np.cos(chord_heading) - offset * np.sin(heading)
    y = root[..., 1] + chord * np.sin(chord_heading) + offset * np.cos(heading)
    return x, y


@register_pattern(tile_size=0.5, roughness=0.9, specular=0.1)
def grass(grid: Grid) -> Float64Array:
    """Paint bent blades of grass over each other, (SIDE, SIDE, 3) sRGB.

    They are lighter towards the tip; later ones lie on top. Numbers and colors are
    chosen by eye; lengths are in tiles.
    """
    generator = np.random.Generator(np.random.PCG64(81))
    n_blades = 2600
    root = generator.random((n_blades, 1, 1, 2))
    # -pi / 2 is upwards, since y points down
    lean = generator.normal(-np.pi / 2, 0.55, (n_blades, 1, 1))
    bend = generator.normal(0.0, 0.9, (n_blades, 1, 1))
    length = generator.uniform(0.08, 0.17, (n_blades, 1, 1))
    # from green to yellow; most blades are green
    yellowness = generator.random((n_blades, 1, 1, 1)) ** 1.5
    # positions of the samples: along a blade from 0 to 1, across it from -1 to 1
    along = np.linspace(0.0, 1.0, 64)[None, :, None]
    across = np.linspace(-1.0, 1.0, 5)[None, None, :]
    x, y = _bend_blades(root, lean, bend, length, along, across)
    brightness = 0.30 + 0.70 * along + 0.12 * across
    blade_color = _color("3f7a1e") + (_color("a5b446") - _color("3f7a1e")) * yellowness
    colors = np.broadcast_to(blade_color * brightness[..., None], (*x.shape, 3))
    return _draw_points(x.reshape(-1), y.reshape(-1), colors.reshape(-1, 3))


def _draw_points(
    x: Float64Array, y: Float64Array, colors: Float64Array
) -> Float64Array:
    """Draw points on a tile of dark soil; return the tile (SIDE, SIDE, 3).

    Args:
        x, y: (N,) positions in tiles; those outside of the tile wrap around.
        colors: (N, 3); of several points in a texel the last one is visible.
    """
    column = np.floor(x * TILE_SIDE).astype(np.int64) % TILE_SIDE
    row = np.floor(y * TILE_SIDE).astype(np.int64) % TILE_SIDE
    texels = np.broadcast_to(_color("14240b"), (TILE_SIDE * TILE_SIDE, 3)).copy()
    topmost = np.full(TILE_SIDE * TILE_SIDE, -1)
    np.maximum.at(topmost, row * TILE_SIDE + column, np.arange(len(x)))
    is_covered = topmost >= 0
    texels[is_covered] = colors[topmost[is_covered]]
    return np.asarray(texels.reshape(TILE_SIDE, TILE_SIDE, 3))


@register_pattern(tile_size=0.5, roughness=0.85, specular=0.2)
def elephant(grid: Grid) -> Float64Array:
    """Paint an elephant's skin with folds, (SIDE, SIDE, 3) sRGB.

    Frequencies, strengths and colors are chosen by eye.
    """
    broadly_warped = _warp_grid(grid, cells=3, amount=0.05, seed=91)
    warped = _warp_grid(broadly_warped, cells=14, amount=0.012, seed=92)
    folds = _paint_fold_nets(warped)
    # long folds along x, where noise changes its sign
    fold_grid = _warp_grid(grid, cells=5, amount=0.04, seed=95)
    waves = _clouds(fold_grid, cells=(3, 14), octaves=3, seed=96)
    folds += 0.55 * np.exp(-((np.abs(waves) / 0.035) ** 2))
    patches = _clouds(warped, cells=(3, 3), octaves=3, seed=97)
    grains = _clouds(grid, cells=(60, 60), octaves=2, seed=98)
    tone = 0.55 + 0.25 * patches + 0.16 * grains
    hide = _ramp(tone, "5f5850", "7d756c", "958d84", "a9a29a")
    return _mix(hide, _color("342f2b"), np.clip(folds, 0.0, 0.9))


def _paint_fold_nets(grid: Grid) -> Float64Array:
    """Return how dark a coarse and a fine net of folds make each texel, (SIDE, SIDE)."""
    folds = np.zeros((TILE_SIDE, TILE_SIDE))
    # A fold is where the two nearest of some scattered points are at the same distance:
    # at the borders of their cells.
    for n_cells, width, depth, seed in ((45, 0.013, 0.75, 93), (320, 0.006, 0.42, 94)):
        points = _scatter_points(n_cells, seed)
        distance, _ = _find_nearest_points(grid, points)
        border_distance = distance[..., 1] - distance[..., 0]
        folds += depth * np.exp(-((border_distance / width) ** 2))
    return folds


@register_pattern(tile_size=0.5, roughness=0.32, metallic=1.0)
def steel(grid: Grid) -> Float64Array:
    """Paint brushed steel with scratches along x, (SIDE, SIDE, 3) sRGB.

    Numbers are chosen by eye.
    """
    # Noise with few cells along x and many along y looks like scratches along x.
    scratches = (
        _noise(grid, cells=(3, 240), seed=101)
        + 0.6 * _noise(grid, cells=(7, 120), seed=102)
        + 0.4 * _noise(grid, cells=(2, 256), seed=103)
    )
    tone = 0.72 + 0.09 * scratches + 0.03 * _noise(grid, cells=(2, 2), seed=104)
    return np.asarray(tone[..., None] * _color("fbfdff"))


@cache
def make_tile(name: str) -> Float32Array:
    """Return one tile of a pattern.

    (SIDE, SIDE, 3) float32 display-referred sRGB in [0, 1]; do not change it.
    """
    line = (np.arange(TILE_SIDE) + 0.5) / TILE_SIDE
    x, y = np.meshgrid(line, line)
    painted = np.clip(PATTERNS[name].paint((x, y)), 0.0, 1.0).astype(np.float32)
    painted.setflags(write=False)
    return painted


# ---- on an object


def make_covering(mesh: Mesh, name: str, side: int = TILE_SIDE) -> Float32Array:
    """Return the texture that covers a mesh with a pattern at one scale.

    Each texel is projected along the three axes into the pattern's tile, and the three
    colors are weighted by the normal ("triplanar" mapping; Geiss, GPU Gems 3, 2007,
    section 1.5). So there are no seams between charts of the texture, and the pattern
    has the same scale on all of them. The tile is upright on vertical walls.

    Args:
        mesh: mesh in its own coordinates, with the largest extent 1.
        name: name of the pattern, a key of `PATTERNS`, e.g. "wood".
        side: number of texels along a side of the texture.

    Returns:
        (side, side, 3) float32 display-referred sRGB in [0, 1]. Row 0 is at the texture
        coordinate v = 1.
    """
    positions, normals = _compute_texel_surface(mesh, side)
    texels_per_object_size = TILE_SIDE / PATTERNS[name].tile_size
    weights = np.abs(normals) ** BLEND_EXPONENT
    weights /= weights.sum(axis=-1, keepdims=True)
    texels = np.zeros((side, side, 3), dtype=np.float32)
    # For each axis of projection (x, y, z): the axes to the right and upwards in the tile.
    # One of two opposite walls gets the mirrored tile.
    axes_in_tile = ((1, 2), (0, 2), (0, 1))
    for axis, (right, up) in enumerate(axes_in_tile):
        column = positions[..., right] * texels_per_object_size
        row = -positions[..., up] * texels_per_object_size  # rows go down
        projected = look_up_texture(make_tile(name), column, row)
        texels += weights[..., axis, None] * projected
    return texels


@lru_cache(maxsize=2)
def _compute_texel_surface(mesh: Mesh, side: int) -> tuple[Float32Array, Float32Array]:
    """Return the position and the normal (side, side, 3) of the texels of a mesh."""
    charts = rasterize_charts(mesh, side)
    return charts.compute_positions(), charts.compute_normals()


OBJECT_SURFACE = "own"
SURFACE_PARAMETERS = tuple(parameter.name for parameter in MATERIAL)


class MaterialControl(Control):
    """The surface of the object: roughness, metal, coat, tint, or a named material."""

    kind = "material"
    targets_mesh = True
    parameters = (
        Parameter.named(
            "which",
            (OBJECT_SURFACE, *PATTERNS),
            OBJECT_SURFACE,
            "The object's own surface, or a named material instead.",
            estimators=("differences",),
        ),
        *MATERIAL,
        *Parameter.colors(
            "of the tint, a factor on the colour; 1 has no effect.", (0.3, 1.0)
        ),
    )

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene, after checking that the mesh has a principled surface.

        A tint needs none, as it only changes the texture.

        Raises:
            InputError: the mesh has another surface of a Mitsuba scene.
        """
        varies_surface = any(self._is_set(name) for name in SURFACE_PARAMETERS)
        has_mitsuba_surface = self.get_mesh(scene).surface is not None
        if has_mitsuba_surface and (varies_surface or self._may_change_material):
            raise InputError(
                f"`controls` {self.name}: the {self.mesh_name} has another surface, from a "
                "Mitsuba scene; search red, green or blue, "
                "or its numbers by Mitsuba's names, "
                f"mitsuba:{self.mesh_name}.bsdf.KEY=[low, high]"
            )
        return scene

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter for the scene.

        The default of a surface parameter, such as the roughness, is that of the
        object's own surface if it is among the allowed materials, or else that of the
        first allowed material.
        """
        if parameter.name not in SURFACE_PARAMETERS:
            return parameter
        name = str(self._material_names[0])
        if OBJECT_SURFACE in self._material_names:
            name = OBJECT_SURFACE
        material = self._get_material(name)
        return replace(parameter, default=float(getattr(material, parameter.name)))

    def get_value_without_control(self, parameter: Parameter) -> ParameterValue:
        setting = self.get_setting_name(parameter)
        if setting in self.scene.requested:
            return self.scene.get_number(setting)
        return parameter.default

    @property
    def refines(self) -> frozenset[str]:
        return (
            frozenset({self._base_color_input})
            if self._changes_color()
            else frozenset()
        )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the numbers of the surface, and its tinted base color.

        Only inputs that the control changes are returned.

        Args:
            values: values of the control by parameter; "which" is the index of the
                material.
            earlier_inputs: inputs of earlier controls, which may have painted the
                object's texture.
        """
        which = (OBJECT_SURFACE, *PATTERNS)[int(values["which"])]
        inputs = self._compute_surface_inputs(which, values)
        if self._changes_color():
            tint = color.combine_channels(values)
            base = self._compute_base_color(which, earlier_inputs)
            inputs[self._base_color_input] = tint * base.to(tint.device)
        return inputs

    def _compute_surface_inputs(self, which: str, values: Values) -> dict[str, Tensor]:
        """Return the numbers (1,) of a material that the control changes."""
        material = self._get_material(which)
        inputs: dict[str, Tensor] = {}
        for name in SURFACE_PARAMETERS:
            input_name = f"{self.mesh_name}.{name}"
            if self._is_set(name):
                inputs[input_name] = values[name].reshape(1)
            elif self._may_change_material:
                number = float(getattr(material, name))
                inputs[input_name] = values["which"].new_tensor([number])
        return inputs

    def _compute_base_color(
        self, which: str, earlier_inputs: Mapping[str, Tensor]
    ) -> Tensor:
        """Return the linear base color (h, w, 3) of a material, without the tint.

        It is the pattern of a named material; or for the object's own surface, the
        texture that an earlier control has set, or else that of the mesh.
        """
        mesh = self.get_mesh(self.scene)
        if which != OBJECT_SURFACE:
            return _make_linear_covering(mesh.mesh, which)
        if self._base_color_input in earlier_inputs:
            return earlier_inputs[self._base_color_input]
        return srgb_to_linear(torch.from_numpy(mesh.base_color.copy()))

    def make_artifact_images(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the texture if the control changes it."""
        if not self._changes_color():
            return {}
        inputs = self.scene_inputs(values, earlier_inputs)
        return {self.name: linear_to_srgb(inputs[self._base_color_input])}

    @property
    def _base_color_input(self) -> str:
        """Name of the scene input for the texture."""
        return f"{self.mesh_name}.base_color"

    @property
    def _material_names(self) -> tuple[ParameterValue, ...]:
        return self.list_allowed_values("which", OBJECT_SURFACE)

    @property
    def _may_change_material(self) -> bool:
        """Whether another material than the object's own surface can be chosen."""
        return self._material_names != (OBJECT_SURFACE,)

    def _is_set(self, name: str) -> bool:
        """Return whether the control sets a parameter.

        It does if the user set the parameter, or if all parameters are searched.
        Otherwise the parameter has the value of the material.
        """
        return name in self.specs or not self.has_requested_range

    def _changes_color(self) -> bool:
        is_tinted = any(self._is_set(name) for name in CHANNELS)
        return self._may_change_material or is_tinted

    def _get_material(self, which: str) -> Material:
        if which == OBJECT_SURFACE:
            return self.get_mesh(self.scene).material
        return PATTERNS[which].material


@lru_cache(maxsize=len(PATTERNS))
def _make_linear_covering(mesh: Mesh, which: str) -> Tensor:
    return srgb_to_linear(torch.from_numpy(make_covering(mesh, which)))
