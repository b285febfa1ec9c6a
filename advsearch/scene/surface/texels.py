"""The texels of light that lie over the surfaces of a scene, and the light on them.

What a texel sees of the others and of the environment is found once, by rays
(`gather`), and is a sparse matrix:

    E = S sky + F (reflectance E) / pi,        S: texels x cells of the environment, F: texels x texels

so that the irradiance E under any environment and for any texture takes a few sparse
products: radiosity (Goral et al.
1984). Light of small bright lamps in the map, which few rays would meet, is found by rays towards them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.scene.assets import Bools, Floats, Ints
from advsearch.scene.mitsuba_backend.texel_rays import TexelGrid
from advsearch.scene.raster import BORDER, Charts, rasterised
from advsearch.scene.transport.matrix import by_rows

GROUND = 112  # texels a side over the ground
# half the side of the ground that has texels, object sizes; further out there is the
# light of its border
NEAR = 12.0
FINEST = 0.01
"""Side of the ground's texels under the middle of the object, object sizes: contact
shadows are that sharp.
"""
REACH = 2  # texels to each side that the light of a place is taken from
WIDTH = 0.8  # standard deviation of the weight of these, texels
SAME = 1.5
"""Standard deviation of the weight of their distance in space, sides of a texel: those
of another chart take no part, nor those of the other wall of a cup.
"""

BINOMIAL = (1, 4, 6, 4, 1)


@dataclass(frozen=True, eq=False)
class LitTexels:
    """Where light is kept: those cells of all grids that lie on a surface."""

    grids: tuple[TexelGrid, ...]  # of each surface, the searched one first
    places: Floats  # (n, 3) in world space
    normals: Floats  # (n, 3)
    cells: Ints  # (n,) the cell of all grids that each lies in
    # (cells of all grids,) number of the texel that each cell has the light of, the
    # nearest one
    of_cell: Ints
    begin: tuple[int, ...]  # of each grid its first texel, and the number of all

    def of(self, number: int) -> slice:
        return slice(self.begin[number], self.begin[number + 1])


def together(some: Sequence[LitTexels]) -> LitTexels:
    first = np.cumsum([0] + [len(each.places) for each in some])
    cells = np.cumsum([0] + [each.grids[0].count for each in some])
    return LitTexels(
        grids=tuple(
            replace(each.grids[0], first=int(cell))
            for each, cell in zip(some, cells[:-1], strict=True)
        ),
        places=np.concatenate([each.places for each in some]),
        normals=np.concatenate([each.normals for each in some]),
        cells=np.concatenate(
            [each.cells + cell for each, cell in zip(some, cells[:-1], strict=True)]
        ),
        of_cell=np.concatenate(
            [each.of_cell + begin for each, begin in zip(some, first[:-1], strict=True)]
        ),
        begin=tuple(int(each) for each in first),
    )


def on_mesh(
    name: str, charts: Charts, vertices: Floats, normals: Floats, side: int = 0
) -> LitTexels:
    """Return the texels over a mesh with vertices and normals (V, 3) in world space and
    rasterised texture coordinates; the side of its faces as `TexelGrid` has it.
    """
    place, normal = _surface(charts, vertices, normals)
    number = np.cumsum(charts.covered.ravel()) - 1
    rows, columns = np.nonzero(charts.covered)
    return LitTexels(
        grids=(TexelGrid(name, 0, charts.covered.shape, None, side),),
        places=place[rows, columns],
        normals=normal[rows, columns],
        cells=np.flatnonzero(charts.covered),
        of_cell=number[_nearest(charts.covered)],
        begin=(0, len(rows)),
    )


def on_ground(
    name: str, height: float, reach: float, middle: tuple[float, float]
) -> LitTexels:
    """Return the texels over a level plane at a height, with half its side as `reach`:
    small under the object's middle (x, y), and large far off.
    """
    reach = min(reach, NEAR)
    ratio = reach / (FINEST * GROUND / 2.0)
    rate = 1e-3
    high = 20.0
    # bisect for sinh(rate) / rate = ratio; the rate stays small where that is 1 or less
    for _ in range(60):
        half = 0.5 * (rate + high)
        rate, high = (half, high) if math.sinh(half) / half < ratio else (rate, half)
    scale = reach / math.sinh(rate)
    share = (np.arange(GROUND) + 0.5) * 2.0 / GROUND - 1.0
    along = scale * np.sinh(rate * share)
    y, x = np.meshgrid(along + middle[1], along + middle[0], indexing="ij")
    places = (
        np.stack([x, y, np.full_like(x, height)], axis=-1)
        .reshape(-1, 3)
        .astype(np.float32)
    )
    up = np.broadcast_to(
        np.array([0.0, 0.0, 1.0], dtype=np.float32), places.shape
    ).copy()
    grid = TexelGrid(name, 0, (GROUND, GROUND), (middle[0], middle[1], scale, rate))
    every = np.arange(GROUND * GROUND)
    return LitTexels((grid,), places, up, every, every, (0, GROUND * GROUND))


def between(
    texels: LitTexels,
    charts: Charts,
    shape: tuple[int, int],
    vertices: Floats,
    normals: Floats,
    buried: Bools,
) -> Tensor:
    """Return the matrix (cells of a finer grid of a `shape` x texels of the first
    surface) that smooths light and looks it up, for texels of a mesh, alone or the
    first, with vertices and normals (V, 3) in world space and its charts. The weights
    are those of a joint bilateral filter (Petschnigg et al. 2004, section 4.1): near in
    the grid, near in space, facing the same way. The darkness of texels that are buried
    (n,) in something does not count outside.
    """
    buried = buried & ~buried.all()
    fine = rasterised(charts.mesh, shape)
    place, normal = _surface(fine, vertices, normals)
    rows, columns = np.nonzero(fine.distance <= BORDER)
    at = place[rows, columns]
    facing = normal[rows, columns]
    scale = np.ptp(vertices, axis=0).max() / max(
        float(np.ptp(charts.mesh.vertices, axis=0).max()), 1e-12
    )
    # of a texel, there
    side = math.sqrt(
        max(float(charts.areas()[charts.covered].mean()) * float(scale) ** 2, 1e-12)
    )
    tall, wide = charts.covered.shape
    y = (rows + 0.5) * tall / shape[0] - 0.5
    x = (columns + 0.5) * wide / shape[1] - 0.5
    number = np.where(
        charts.covered,
        np.cumsum(charts.covered.ravel()).reshape(charts.covered.shape) - 1,
        -1,
    )
    corners = []
    weights = []
    for down in range(-REACH, REACH + 1):
        for across in range(-REACH, REACH + 1):
            row = np.round(y).astype(int) + down
            column = np.round(x).astype(int) + across
            inside = (row >= 0) & (row < tall) & (column >= 0) & (column < wide)
            one = np.where(
                inside, number[row.clip(0, tall - 1), column.clip(0, wide - 1)], -1
            )
            far = ((row - y) ** 2 + (column - x) ** 2) / (2.0 * WIDTH**2)
            apart = ((texels.places[one] - at) ** 2).sum(axis=1) / (
                2.0 * (SAME * side) ** 2
            )
            alike = np.clip((texels.normals[one] * facing).sum(axis=1), 0.0, 1.0) ** 8
            corners.append(one)
            weights.append(
                np.where((one >= 0) & ~buried[one], np.exp(-far - apart) * alike, 0.0)
            )
    chosen = np.stack(corners, axis=1)
    weight = np.stack(weights, axis=1)
    lost = weight.sum(axis=1) < 1e-6
    chosen[lost, 0] = texels.of_cell[
        np.round(y[lost]).astype(int).clip(0, tall - 1) * wide
        + np.round(x[lost]).astype(int).clip(0, wide - 1)
    ]
    weight[lost, 0] = 1.0
    weight /= weight.sum(axis=1, keepdims=True)
    taken = weight > 1e-3
    cell = np.broadcast_to((rows * shape[1] + columns)[:, None], chosen.shape)[taken]
    size = shape[0] * shape[1], texels.begin[1]
    return by_rows(
        scipy.sparse.coo_matrix(
            (weight[taken].astype(np.float32), (cell, chosen[taken])), size
        ).tocsr()
    )


def smoothed(ground: LitTexels, lit: Bools) -> Tensor:
    """Return the matrix (cells x texels of a ground) that smooths its light, by the
    binomial of 5 x 5 texels.

    Those that see nothing of the sky (not `lit`, (n,); none is the same as all) lie
    under something. What is next to it takes no part of their darkness, which a look-up
    beside the edge would mix in.
    """
    side = ground.grids[0].shape[0]
    inside = (lit if lit.any() else ~lit).reshape(side, side)
    source = _nearest(inside)
    band = scipy.sparse.diags_array(
        BINOMIAL, offsets=range(-2, 3), shape=(side, side), dtype=np.float64
    )
    every = scipy.sparse.csr_array(
        scipy.sparse.kron(band, band)
        @ scipy.sparse.diags_array(inside.ravel().astype(float))
    )
    every.data /= np.maximum(np.repeat(every.sum(axis=1), np.diff(every.indptr)), 1e-12)
    return by_rows(every.astype(np.float32)[source])


def _surface(
    charts: Charts, vertices: Floats, normals: Floats
) -> tuple[Floats, Floats]:
    corners = charts.mesh.faces[charts.face]
    place = np.einsum("hwk,hwkc->hwc", charts.weights, vertices[corners])
    normal = np.einsum("hwk,hwkc->hwc", charts.weights, normals[corners])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return place.astype(np.float32), (normal / np.maximum(length, 1e-12)).astype(
        np.float32
    )


def _nearest(covered: Bools) -> Ints:
    """For each cell of a grid the nearest covered one, by their places in the flat
    grid.
    """
    # takes long to import
    from scipy import ndimage

    rows, columns = ndimage.distance_transform_edt(
        ~covered, return_distances=False, return_indices=True
    )
    nearest: Ints = (rows * covered.shape[1] + columns).ravel()
    return nearest


CELLS = (32, 64)  # rows and columns of the cells of the environment
WIDTHS = (
    math.radians(3.0),
    math.radians(6.0),
    math.radians(12.0),
    math.radians(24.0),
    math.radians(48.0),
)
"""By which the environment is blurred for gloss, radians."""
BLURRED = (64, 128)  # rows and columns of the blurred maps
# multiples of the mean luminance above which light of the environment is found by rays
# of its own
HOT = 8.0
HOT_RAYS = 48  # rays from each texel towards such light
SPREAD = (7, 11)
"""Steps, down and across, of a lattice of so many points: 11 / 7 is 29 of 48, the
golden ratio's neighbour, and both coordinates are even.
"""
LITTLE = 0.02  # share of the light up to which it is left to the cells
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True, eq=False)
class SkyLight:
    """An environment, as the scene takes it, cut for look-ups."""

    padded: Tensor  # (H, W + 2, 3)
    # (rows x columns, 3) mean radiance of each of `CELLS`, without what is hot
    cells: Tensor
    map: Tensor  # `BLURRED`, (h, w, 3)
    hot: tuple[Tensor, Tensor]
    """(k, 3) unit directions in the map's own axes towards what is hot, and (k, 3)
    radiance times solid angle.
    """


def sky_of(padded: Tensor) -> SkyLight:
    radiance = padded[:, 1:-1].detach()
    rows, columns = radiance.shape[:2]
    polar = torch.linspace(0.0, math.pi, rows)
    sine = (
        polar.sin()
        .clamp_min(math.sin(0.25 * math.pi / rows))[:, None]
        .expand(rows, columns)
    )
    luminance = radiance @ LUMINANCE
    mean = float((luminance * sine).sum() / sine.sum())
    spare = (1.0 - HOT * mean / luminance.clamp_min(1e-12)).clamp_min(0.0)
    power = spare * luminance * sine
    if float(power.sum()) > LITTLE * mean * float(sine.sum()):
        hot = _hot(radiance * spare[..., None], power)
        even = radiance * (1.0 - spare[..., None])
    else:
        hot = (torch.zeros(0, 3), torch.zeros(0, 3))
        even = radiance
    return SkyLight(
        padded,
        _pooled(even, sine, CELLS).reshape(-1, 3),
        _pooled(radiance, sine, BLURRED),
        hot,
    )


def _hot(radiance: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
    """Directions spread over what is hot by its power, and what comes from each.

    A map is looked up between its texels, so that each shines over a tent that reaches
    its neighbours. Directions are spread over that by `SPREAD`: a sun of one texel has
    a soft shadow.
    """
    rows, columns = power.shape
    total = power.sum()
    order = torch.cumsum(power.double().reshape(-1), 0)
    steps = (torch.arange(HOT_RAYS, dtype=torch.float64) + 0.5) / HOT_RAYS * order[-1]
    index = torch.searchsorted(order, steps).clamp_max(power.numel() - 1)
    row = index // columns
    column = index % columns
    number = torch.arange(HOT_RAYS, dtype=torch.float64)
    even = [(number * step % HOT_RAYS + 0.5) / HOT_RAYS for step in SPREAD]
    down, beside = (
        torch.where(
            part < 0.5, (2.0 * part).sqrt() - 1.0, 1.0 - (2.0 - 2.0 * part).sqrt()
        )
        for part in even
    )  # with a tent's density in [-1, 1]
    polar = ((row + down) * (math.pi / (rows - 1))).clamp(0.0, math.pi)
    across = (column + 0.5 + beside) * (2.0 * math.pi / columns)
    ways = torch.stack(
        [polar.sin() * across.sin(), polar.cos(), -polar.sin() * across.cos()], dim=1
    ).float()
    angle = math.pi / (rows - 1) * 2.0 * math.pi / columns
    colour = radiance[row, column] / (radiance[row, column] @ LUMINANCE)[
        :, None
    ].clamp_min(1e-12)
    return ways, colour * (float(total) * angle / HOT_RAYS)


def _pooled(radiance: Tensor, sine: Tensor, size: tuple[int, int]) -> Tensor:
    weighted = torch.cat([radiance * sine[..., None], sine[..., None]], dim=-1).permute(
        2, 0, 1
    )[None]
    pooled = functional.adaptive_avg_pool2d(weighted, size)[0].permute(1, 2, 0)
    return pooled[..., :3] / pooled[..., 3:].clamp_min(1e-12)


def blurred(radiance: Tensor) -> Tensor:
    """Blur a map (h, w, 3) by each of `WIDTHS`, root mean square over both directions:
    (widths, h, w, 3).

    Along rows and columns one after the other, wider along rows towards the poles.
    """
    rows, columns = radiance.shape[:2]
    polar = (torch.arange(rows) + 0.5) * math.pi / rows
    frequency = torch.arange(columns // 2 + 1)
    maps = []
    for width in WIDTHS:
        sigma = width / math.sqrt(2.0)
        apart = (polar[:, None] - polar[None, :]).square() / (2.0 * sigma**2)
        down = torch.exp(-apart) * polar.sin()[None, :]
        down = down / down.sum(dim=1, keepdim=True)
        across = torch.exp(
            -0.5 * (frequency[None, :] * sigma / polar.sin()[:, None]).square()
        )
        spectrum = torch.fft.rfft(
            (down @ radiance.reshape(rows, -1)).reshape(rows, columns, 3), dim=1
        )
        maps.append(torch.fft.irfft(spectrum * across[..., None], n=columns, dim=1))
    return torch.stack(maps).clamp_min(0.0)


def directions(size: tuple[int, int]) -> Tensor:
    """Return the unit directions (h, w, 3) of the cells of a map, in its own axes."""
    rows, columns = size
    polar = (torch.arange(rows) + 0.5) * math.pi / rows
    across = (torch.arange(columns) + 0.5) * 2.0 * math.pi / columns
    polar, across = torch.meshgrid(polar, across, indexing="ij")
    return torch.stack(
        [polar.sin() * across.sin(), polar.cos(), -polar.sin() * across.cos()], dim=-1
    )


def irradiance(
    seen: tuple[Tensor, Tensor],
    sky: SkyLight,
    direct: Tensor | None,
    reflectance: Tensor,
    bounces: int,
) -> Tensor:
    """Return the irradiance (n, 3) of texels with some reflectance (n, 3), after so
    many bounces from texel to texel. `seen` are their views of the sky (n, cells) and
    of each other (n, n), sparse, times the cosine and pi; `direct` the (n, k) cosines
    towards what is hot where it is visible, None where nothing is.
    """
    of_sky, of_each_other = seen
    first = of_sky @ sky.cells
    if direct is not None:
        first = first + direct @ sky.hot[1]
    arriving = first
    for _ in range(bounces):
        arriving = first + of_each_other @ (reflectance * arriving / math.pi)
    return arriving


def seen_of(
    columns: npt.NDArray[np.int32], of_cell: Ints, texels: int
) -> tuple[Tensor, Tensor]:
    """Return the sparse matrices of `irradiance` from what rays met, as `gather` has
    it.
    """
    count, rays = columns.shape
    row = np.repeat(np.arange(count), rays)
    flat = columns.ravel()
    of_sky = flat >= len(of_cell)
    of_texel = (flat >= 0) & (flat < len(of_cell))

    def matrix(
        taken: Bools, column: npt.NDArray[np.integer[Any]], width: int
    ) -> Tensor:
        values = np.full(len(column), math.pi / rays, dtype=np.float32)
        return by_rows(
            scipy.sparse.coo_matrix(
                (values, (row[taken], column)), (count, width)
            ).tocsr()
        )

    sky = matrix(of_sky, flat[of_sky] - len(of_cell), CELLS[0] * CELLS[1])
    return sky, matrix(of_texel, of_cell[flat[of_texel]], texels)


def looked_up(padded: Tensor, ways: Tensor) -> Tensor:
    """Return what an environment (H, W + 2, 3) has in directions (n, 3) in the map's
    own axes, the nearest texel.
    """
    rows = padded.shape[0]
    columns = padded.shape[1] - 2
    x, y, z = (ways / ways.norm(dim=1, keepdim=True)).unbind(dim=1)
    across = torch.remainder(torch.atan2(x, -z) / (2.0 * math.pi), 1.0)
    row = (torch.acos(y.clamp(-1.0, 1.0)) * ((rows - 1) / math.pi)).round().long()
    return padded[row, 1 + (across * columns).long().clamp_max(columns - 1)]
