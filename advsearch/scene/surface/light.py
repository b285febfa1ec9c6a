"""Light on the texels of a scene: radiosity between them, and of the environment (Goral et al. 1984).

What a texel sees of the others and of the environment is found once, by rays (`gather`), and is a sparse matrix:

    E = S sky + F (reflectance E) / pi,        S: texels x cells of the environment, F: texels x texels

so that the irradiance E under any environment and for any texture takes a few sparse products. Light of small bright
lamps in the map, which few rays would meet, is found by rays towards them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.scene.transport.matrix import by_rows

CELLS = (32, 64)
"""Rows and columns of the cells of the environment."""
WIDTHS = (math.radians(3.0), math.radians(6.0), math.radians(12.0), math.radians(24.0), math.radians(48.0))
"""By which the environment is blurred for gloss, radians."""
BLURRED = (64, 128)
"""Rows and columns of the blurred maps."""
HOT = 8.0
"""Multiples of the mean luminance above which light of the environment is found by rays of its own."""
HOT_RAYS = 48
"""Rays from each texel towards such light."""
SPREAD = (7, 11)
"""Steps, down and across, of a lattice of so many points: 11 / 7 is 29 of 48, the golden ratio's neighbour, and both
coordinates are even."""
LITTLE = 0.02
"""Share of the light up to which it is left to the cells."""
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True, eq=False)
class SkyLight:
    """An environment, cut for look-ups.

    Attributes:
        padded: (H, W + 2, 3), as the scene takes it.
        cells: (rows x columns, 3) mean radiance of each of `CELLS`, without what is hot.
        map: `BLURRED`, (h, w, 3).
        hot: (k, 3) unit directions in the map's own axes towards what is hot, and (k, 3) radiance times solid angle
            of each.
    """

    padded: Tensor
    cells: Tensor
    map: Tensor
    hot: tuple[Tensor, Tensor]


def sky_of(padded: Tensor) -> SkyLight:
    """Cut an environment (H, W + 2, 3) for look-ups."""
    radiance = padded[:, 1:-1].detach()
    rows, columns = radiance.shape[:2]
    polar = torch.linspace(0.0, math.pi, rows)
    sine = polar.sin().clamp_min(math.sin(0.25 * math.pi / rows))[:, None].expand(rows, columns)
    luminance = radiance @ LUMINANCE
    mean = float((luminance * sine).sum() / sine.sum())
    spare = (1.0 - HOT * mean / luminance.clamp_min(1e-12)).clamp_min(0.0)
    power = spare * luminance * sine
    if float(power.sum()) > LITTLE * mean * float(sine.sum()):
        hot = _hot(radiance * spare[..., None], power)
        even = radiance * (1.0 - spare[..., None])
    else:
        hot, even = (torch.zeros(0, 3), torch.zeros(0, 3)), radiance
    return SkyLight(padded, _pooled(even, sine, CELLS).reshape(-1, 3), _pooled(radiance, sine, BLURRED), hot)


def _hot(radiance: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
    """Directions spread over what is hot by its power, and what comes from each.

    A map is looked up between its texels, so that each shines over a tent that reaches its neighbours. Directions are
    spread over that by `SPREAD`: a sun of one texel has a soft shadow.
    """
    rows, columns = power.shape
    total = power.sum()
    order = torch.cumsum(power.double().reshape(-1), 0)
    steps = (torch.arange(HOT_RAYS, dtype=torch.float64) + 0.5) / HOT_RAYS * order[-1]
    index = torch.searchsorted(order, steps).clamp_max(power.numel() - 1)
    row, column = index // columns, index % columns
    number = torch.arange(HOT_RAYS, dtype=torch.float64)
    down, beside = (_tent((number * step % HOT_RAYS + 0.5) / HOT_RAYS) for step in SPREAD)
    polar = ((row + down) * (math.pi / (rows - 1))).clamp(0.0, math.pi)
    across = (column + 0.5 + beside) * (2.0 * math.pi / columns)
    ways = torch.stack([polar.sin() * across.sin(), polar.cos(), -polar.sin() * across.cos()], dim=1).float()
    angle = math.pi / (rows - 1) * 2.0 * math.pi / columns
    colour = radiance[row, column] / (radiance[row, column] @ LUMINANCE)[:, None].clamp_min(1e-12)
    return ways, colour * (float(total) * angle / HOT_RAYS)


def _tent(even: Tensor) -> Tensor:
    """Numbers in [-1, 1] with a tent's density, from even ones in [0, 1]."""
    return torch.where(even < 0.5, (2.0 * even).sqrt() - 1.0, 1.0 - (2.0 - 2.0 * even).sqrt())


def _pooled(radiance: Tensor, sine: Tensor, size: tuple[int, int]) -> Tensor:
    """The mean of each cell (h, w, 3) by solid angle."""
    weighted = torch.cat([radiance * sine[..., None], sine[..., None]], dim=-1).permute(2, 0, 1)[None]
    pooled = functional.adaptive_avg_pool2d(weighted, size)[0].permute(1, 2, 0)
    return pooled[..., :3] / pooled[..., 3:].clamp_min(1e-12)


def blurred(radiance: Tensor) -> Tensor:
    """Blur a map (h, w, 3) by each of `WIDTHS`, root mean square over both directions: (widths, h, w, 3).

    Along rows and columns one after the other, wider along rows towards the poles.
    """
    rows, columns = radiance.shape[:2]
    polar = (torch.arange(rows) + 0.5) * math.pi / rows
    frequency = torch.arange(columns // 2 + 1)
    found = []
    for width in WIDTHS:
        sigma = width / math.sqrt(2.0)
        apart = (polar[:, None] - polar[None, :]).square() / (2.0 * sigma**2)
        down = torch.exp(-apart) * polar.sin()[None, :]
        down = down / down.sum(dim=1, keepdim=True)
        across = torch.exp(-0.5 * (frequency[None, :] * sigma / polar.sin()[:, None]).square())
        spectrum = torch.fft.rfft((down @ radiance.reshape(rows, -1)).reshape(rows, columns, 3), dim=1)
        found.append(torch.fft.irfft(spectrum * across[..., None], n=columns, dim=1))
    return torch.stack(found).clamp_min(0.0)


def directions(size: tuple[int, int]) -> Tensor:
    """Return the unit directions (h, w, 3) of the cells of a map, in its own axes."""
    rows, columns = size
    polar, across = (torch.arange(rows) + 0.5) * math.pi / rows, (torch.arange(columns) + 0.5) * 2.0 * math.pi / columns
    polar, across = torch.meshgrid(polar, across, indexing="ij")
    return torch.stack([polar.sin() * across.sin(), polar.cos(), -polar.sin() * across.cos()], dim=-1)


def irradiance(
    seen: tuple[Tensor, Tensor], sky: SkyLight, direct: Tensor | None, reflectance: Tensor, bounces: int
) -> Tensor:
    """Return the irradiance (n, 3) of texels.

    Args:
        seen: what they see: of the sky (n, cells) and of each other (n, n), sparse, times the cosine and pi.
        sky: the environment.
        direct: (n, k) cosines towards what is hot where it is visible; None where nothing is.
        reflectance: (n, 3) of the texels.
        bounces: how often light goes from texel to texel.
    """
    of_sky, of_each_other = seen
    first = of_sky @ sky.cells
    if direct is not None:
        first = first + direct @ sky.hot[1]
    found = first
    for _ in range(bounces):
        found = first + of_each_other @ (reflectance * found / math.pi)
    return found


def seen_of(columns: npt.NDArray[np.int32], of_cell: npt.NDArray[np.int64], texels: int) -> tuple[Tensor, Tensor]:
    """Return the sparse matrices of `irradiance` from what rays met, as `gather` has it."""
    count, rays = columns.shape
    row = np.repeat(np.arange(count), rays)
    flat = columns.ravel()
    found = []
    of_sky, of_texel = flat >= len(of_cell), (flat >= 0) & (flat < len(of_cell))
    for taken, column, width in (
        (of_sky, flat[of_sky] - len(of_cell), CELLS[0] * CELLS[1]),
        (of_texel, of_cell[flat[of_texel]], texels),
    ):
        values = np.full(len(column), math.pi / rays, dtype=np.float32)
        found.append(by_rows(scipy.sparse.coo_matrix((values, (row[taken], column)), (count, width)).tocsr()))
    return found[0], found[1]


def looked_up(padded: Tensor, ways: Tensor) -> Tensor:
    """Return what an environment (H, W + 2, 3) has in directions (n, 3) in the map's own axes, the nearest texel."""
    rows, columns = padded.shape[0], padded.shape[1] - 2
    x, y, z = (ways / ways.norm(dim=1, keepdim=True)).unbind(dim=1)
    across = torch.remainder(torch.atan2(x, -z) / (2.0 * math.pi), 1.0)
    row = (torch.acos(y.clamp(-1.0, 1.0)) * ((rows - 1) / math.pi)).round().long()
    return padded[row, 1 + (across * columns).long().clamp_max(columns - 1)]
