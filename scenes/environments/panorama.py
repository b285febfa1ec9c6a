"""Directions of an equirectangular map, its brightness, and how families of
environments are described.

Row 0 looks straight up. Columns run as in a photograph: from left to right the view
turns clockwise seen from above. The left edge of a map looks along azimuth 90 degrees
(+y), a quarter in along azimuth 0 (+x), the middle along -y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import EnvironmentAsset

Array = npt.NDArray[np.float64]

HEIGHT = 192
WIDTH = 384
# irradiance, in the map's units, that every environment is scaled to; see `brightness`
LEVEL = 0.75 * np.pi
SUPERSAMPLING = 2
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class EnvironmentFamily:
    """A bundled environment.

    Attributes:
        name: usable on the command line.
        split: "train" when models may be trained under it, "heldout" when it is kept for
            testing; "street" for streets,
            which the reference model never sees; "place" for those whose map is nothing by
                itself.
        paint: maps unit directions (N, 3), z up, to linear radiance (N, 3).
        script: the file that makes it, within this repository.
        needs_mitsuba: whether making it runs Mitsuba.
        height: rows of the map; it has twice as many columns.
        ground: the kind of ground that belongs to it; None for the usual table.
        lux: illuminance on an open level surface, where the map stands for light of a known
            strength.
        map: the environment whose map it has; its own unless given.
    """

    name: str
    split: Literal["train", "heldout", "street", "place"]
    paint: Callable[[Array], Array]
    script: str
    needs_mitsuba: bool = False
    height: int = HEIGHT
    ground: str | None = None
    lux: float | None = None
    map: str = ""

    def make(self) -> EnvironmentAsset:
        """Return the (height, 2 height, 3) map at the common brightness, every value a
        half-precision number.
        """
        rows = self.height
        columns = 2 * self.height
        fine = self.paint(
            directions(rows * SUPERSAMPLING, columns * SUPERSAMPLING).reshape(-1, 3)
        )
        radiance = fine.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, 3).mean(
            axis=(1, 3)
        )
        scaled = radiance * (LEVEL / round(brightness(radiance), 6))
        # a step far above what machines disagree by
        coarse = np.ldexp(np.round(np.ldexp(scaled, 12)), -12)
        half = np.minimum(coarse, 65000.0).astype(np.float16)
        kept = half.astype(np.float32)
        level = float(irradiance(kept, np.array([0.0, 0.0, 1.0])) @ LUMINANCE)
        candelas = None if self.lux is None else float(f"{self.lux / level:.4g}")
        return EnvironmentAsset(
            self.name, kept, source=self.script, ground=self.ground, candelas=candelas
        )


def directions(height: int, width: int) -> Array:
    """Return the (height, width, 3) unit directions of the middles of the pixels."""
    azimuth = np.radians(90.0 - 360.0 * (np.arange(width) + 0.5) / width)
    elevation = np.radians(90.0 - 180.0 * (np.arange(height) + 0.5) / height)[:, None]
    flat = np.cos(elevation)
    up = np.broadcast_to(np.sin(elevation), (height, width))
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1)


def irradiance(radiance: Array, normal: Array) -> Array:
    """Return the (3,) irradiance of a map (H, W, 3) on a surface with a unit normal
    (3,), by quadrature.
    """
    height, width = radiance.shape[:2]
    towards = directions(height, width)
    solid = (2 * np.pi / width) * (np.pi / height) * np.sqrt(1.0 - towards[..., 2] ** 2)
    total: Array = (
        radiance * (np.maximum(towards @ normal, 0.0) * solid)[..., None]
    ).sum(axis=(0, 1))
    return total


def brightness(radiance: Array) -> float:
    """Return the mean luminance irradiance on a level surface and on the brightest of
    eight upright ones.

    A level surface alone would let a low sun, which hardly lights the floor, burn out
    whatever stands on it.
    """
    level = float(irradiance(radiance, np.array([0.0, 0.0, 1.0])) @ LUMINANCE)
    turns = np.radians(np.arange(0.0, 360.0, 45.0))
    upright = max(
        float(irradiance(radiance, np.array([np.cos(a), np.sin(a), 0.0])) @ LUMINANCE)
        for a in turns
    )
    return (level + upright) / 2
