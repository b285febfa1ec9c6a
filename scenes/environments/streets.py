"""Streets: rows of houses on both sides of a road, by day, in the rain's wake and at
dusk. Lengths are metres.

The viewer stands in the right lane of a road along x, 1.5 above it. What lies on the
ground is what `advsearch.scene.grounds` lays under the object, so that the two go on
into each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scenes.places.road import EYE, FRONTS, WETNESS, reflectance
from scenes.places.road import STREET_ENDS as END

from .panorama import Array, EnvironmentFamily

Bools = npt.NDArray[np.bool_]

WALLS = np.array(
    [
        (0.42, 0.30, 0.22), (0.55, 0.50, 0.42), (0.36, 0.17, 0.12), (0.48, 0.44, 0.40), (0.60, 0.52, 0.36),
        (0.30, 0.29, 0.28), (0.45, 0.24, 0.17), (0.52, 0.53, 0.52),
    ]
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Weather:
    """What the light does: radiances and irradiances over pi, in units of which white
    in the open by day is about 1.

    Attributes:
        sky: from unit directions (N, 3) to radiance (N, 3).
        sunny: light (3,) on the fronts on the left, which face -y.
        shady: light (3,) on the fronts on the right.
        ground: light (3,) on the road.
        windows: the share of windows that are lit from inside.
        wet: the road mirrors the sky.
        lamps: radiance (3,) of street lamps; 0 by day.
    """

    sky: Callable[[Array], Array]
    sunny: Array
    shady: Array
    ground: Array
    windows: float = 0.0
    wet: bool = False
    lamps: float = 0.0


def _hashed(*numbers: Array) -> Array:
    """A number in [0, 1) for whole numbers (N,), the same for the same ones."""
    total = np.zeros(len(numbers[0]))
    for k, one in enumerate(numbers):
        total = total + one * (12.9898, 78.233, 37.719)[k]
    return np.round((np.sin(total * 0.731 + 1.7) * 43.7585) % 1.0, 6) % 1.0


def _front(x: Array, z: Array, side: int, weather: Weather) -> tuple[Array, Bools]:
    """Radiance (N, 3) of a row of houses at places along and up its front, and (N,)
    whether a house is there.
    """
    house = np.floor((x + 5.0 * side) / 13.0)
    along = (x + 5.0 * side) - 13.0 * house
    number = house + 100.0 * side
    floors = 3.0 + np.floor(3.0 * _hashed(number))
    height = 1.0 + 3.1 * floors
    light = weather.sunny if side else weather.shady
    wall = WALLS[np.floor(8 * _hashed(number, number * 0 + 3.0)).astype(int)]
    level = np.floor((z - 0.6) / 3.1)
    up = (z - 0.6) - 3.1 * level
    bay = np.floor(along / 2.6)
    across = along - 2.6 * bay
    window = (
        (across > 0.7)
        & (across < 1.9)
        & (up > 0.75)
        & (up < 2.35)
        & (level < floors)
        & (z > 3.6)
    )
    shop = (z > 0.5) & (z < 3.1) & (across > 0.25) & (across < 2.35)
    color = wall * light * (0.85 + 0.15 * np.clip(z / 12.0, 0.0, 1.0))[:, None]
    color = np.where(
        (np.abs(z - 3.4) < 0.16)[:, None] | (np.abs(z - height + 0.25) < 0.25)[:, None],
        0.55 * light,
        color,
    )
    pick = _hashed(number, bay, level)
    lit = (pick < weather.windows)[:, None]
    mirrored = weather.sky(
        np.stack(
            [0 * x, np.full_like(x, -0.7 if side else 0.7), np.full_like(x, 0.7)],
            axis=1,
        )
    )
    pane = np.where(
        lit,
        np.array([0.75, 0.46, 0.2])
        * (0.4 + pick / max(weather.windows, 0.01))[:, None],
        0.22 * mirrored,
    )
    pane = pane + 0.02 * light
    shown = np.where(
        (pick < 1.6 * weather.windows)[:, None],
        np.array([0.7, 0.5, 0.3]),
        0.12 * mirrored + 0.04 * light,
    )
    color = np.where(window[:, None], pane, color)
    color = np.where(shop[:, None], shown, color)
    return color, (z < height) & (z > 0.0)


def _trees(rays: Array, light: Array) -> tuple[Array, Bools]:
    """The end of the street: radiance (N, 3) and (N,) whether something is there."""
    a = np.arctan2(rays[:, 1], np.abs(rays[:, 0]))
    crown = (
        0.05
        + 0.012 * np.sin(31.0 * a + 0.7)
        + 0.008 * np.sin(67.0 * a)
        + 0.02 * np.cos(9.0 * a)
    )
    leaves = (
        np.array([0.06, 0.085, 0.04])
        * light
        * (0.8 + 0.3 * np.sin(90.0 * a) * np.sin(150.0 * rays[:, 2]))[:, None]
    )
    return leaves, rays[:, 2] < crown


def street(rays: Array, weather: Weather) -> Array:
    """What arrives against unit directions (N, 3): sky, houses, road and lamps."""
    radiance = weather.sky(rays)
    trees, there = _trees(rays, 0.5 * (weather.sunny + weather.shady))
    radiance = np.where(there[:, None], trees, radiance)
    for side, y in enumerate(FRONTS):
        t = np.where(
            rays[:, 1] * y > 1e-6,
            y / np.where(np.abs(rays[:, 1]) > 1e-6, rays[:, 1], 1.0),
            1e9,
        )
        x = t * rays[:, 0]
        z = EYE + t * rays[:, 2]
        near = np.abs(x) < END
        color, built = _front(
            np.where(near, x, 0.0), np.where(near, z, -1.0), side, weather
        )
        haze = 1.0 - np.exp(-np.abs(x) / 400.0)[:, None]
        color = color * (1.0 - haze) + haze * 0.6 * weather.ground
        radiance = np.where((near & built)[:, None], color, radiance)
    return _with_lamps(rays, _with_ground(rays, radiance, weather), weather)


def _with_ground(rays: Array, radiance: Array, weather: Weather) -> Array:
    """The same over the road and the pavements."""
    t = EYE / np.maximum(-rays[:, 2], 1e-6)
    x = t * rays[:, 0]
    y = t * rays[:, 1]
    here = (rays[:, 2] < 0.0) & (y > FRONTS[0]) & (y < FRONTS[1]) & (np.abs(x) < 600.0)
    x = np.where(here, x, 0.0)
    y = np.where(here, y, 0.0)
    far = np.abs(x) > 25.0  # markings are finer than the map there
    color = reflectance(np.where(far, 4.0, x), y) * weather.ground
    if weather.wet:
        up = rays * np.array([1.0, 1.0, -1.0])
        grazing = (0.02 + 0.98 * (1.0 - np.clip(up[:, 2], 0.0, 1.0)) ** 5)[:, None]
        color = WETNESS * color + grazing * np.minimum(weather.sky(up), 2.0) * 0.6
    return np.where(here[:, None], color, radiance)


def _with_lamps(rays: Array, radiance: Array, weather: Weather) -> Array:
    """The same with street lamps, round and bright."""
    if weather.lamps == 0.0:
        return radiance
    total: Array = radiance.copy()
    for x in np.arange(-52.0, 60.0, 15.0):
        for y in (-4.0, 7.4):
            place = np.array([x, y, 5.5 - EYE])
            far = float(np.linalg.norm(place))
            width = max(0.25 / far, 0.012)
            glow = (
                np.exp((rays @ (place / far) - 1.0) / width**2)
                * (0.25 / far / width) ** 2
            )
            total += glow[:, None] * weather.lamps * np.array([1.0, 0.72, 0.4])
    return total


# -------------------------------------------------------------------------------------------------------
# weathers


def _clouds(rays: Array) -> Array:
    """(N,) cover of soft clouds in [0, 1]."""
    up = np.clip(rays[:, 2], 0.0, 1.0)
    x = rays[:, 0] / (up + 0.25)
    y = rays[:, 1] / (up + 0.25)
    wave = np.sin(1.3 * x + 1.7 * np.sin(0.9 * y)) * np.sin(
        1.5 * y + 1.2 * np.sin(1.1 * x + 2.0)
    )
    wave = wave + 0.45 * np.sin(3.7 * x + 2.0 * np.sin(2.9 * y)) * np.sin(3.3 * y - x)
    cover: Array = np.clip(0.5 + 0.9 * wave, 0.0, 1.0) ** 2
    return cover


def _spot(rays: Array, azimuth: float, elevation: float, degrees: float) -> Array:
    """A spot of a width around a direction that integrates to one over the sphere,
    (N,).
    """
    a = np.radians(azimuth)
    e = np.radians(elevation)
    width = np.radians(degrees)
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    spot: Array = np.exp((rays @ towards - 1.0) / width**2) / (2 * np.pi * width**2)
    return spot


def _day_sky(rays: Array) -> Array:
    up = np.clip(rays[:, 2], 0.0, 1.0)[:, None]
    blue = np.array([0.16, 0.33, 0.72]) + np.array([0.55, 0.5, 0.3]) * np.exp(
        -up / 0.22
    )
    cover = 0.85 * _clouds(rays)[:, None]
    sky = blue * (1.0 - cover) + cover * np.array([1.0, 1.0, 1.02])
    seen: Array = sky + _spot(rays, -68.0, 48.0, 3.0)[:, None] * np.array(
        [3.4, 3.2, 2.9]
    )
    return seen


def _grey_sky(rays: Array) -> Array:
    up = np.clip(rays[:, 2], 0.0, 1.0)[:, None]
    veil = (0.45 + 0.55 * up) * (0.85 + 0.3 * _clouds(rays)[:, None])
    seen: Array = veil * np.array([0.9, 0.96, 1.04])
    return seen


def _dusk_sky(rays: Array) -> Array:
    up = np.clip(rays[:, 2], 0.0, 1.0)[:, None]
    west = (0.5 + 0.5 * rays[:, :1]) ** 3
    low = (
        np.array([0.30, 0.26, 0.34]) * (1.0 - west) + np.array([1.5, 0.62, 0.22]) * west
    )
    sky = (
        np.array([0.07, 0.11, 0.25])
        + low * np.exp(-up / 0.16)
        + 0.25 * west * np.exp(-up / 0.5) * np.array([1, 0.5, 0.5])
    )
    cover = 0.6 * _clouds(rays)[:, None] * np.exp(-((up - 0.25) ** 2) / 0.04)
    seen: Array = sky * (1.0 - cover) + cover * (
        np.array([0.16, 0.13, 0.2]) + west * np.array([0.5, 0.2, 0.12])
    )
    return seen


DAY = Weather(
    _day_sky,
    np.array([1.25, 1.2, 1.12]),
    np.array([0.4, 0.45, 0.52]),
    np.array([1.1, 1.08, 1.05]),
)
RAIN = Weather(
    _grey_sky, np.full(3, 0.5), np.full(3, 0.48), np.full(3, 0.75), 0.12, True
)
DUSK = Weather(
    _dusk_sky,
    np.array([0.16, 0.13, 0.13]),
    np.array([0.1, 0.1, 0.14]),
    np.array([0.3, 0.22, 0.17]),
    0.22,
    False,
    30.0,
)

_SCRIPT = "scenes/environments/streets.py"
ROWS = 320


# ------------------------------------------------------------------------- skies of the
# avenue, which is geometry


def _open(rays: Array, sky: Array, field: float) -> Array:
    """A sky over a plain, whose brightness goes over into that of the horizon in haze;
    `field` is the plain's.
    """
    far = np.exp(np.minimum(rays[:, 2:], 0.0) / 0.02)
    plain = field * (
        np.array([0.075, 0.095, 0.045]) * (1.0 - far)
        + np.array([0.22, 0.24, 0.25]) * far
    )
    return np.where(rays[:, 2:] > 0.0, sky, plain)


def _cumulus(rays: Array) -> Array:
    """(N,) cover of clouds in heaps, denser towards the horizon."""
    up = np.clip(rays[:, 2], 0.0, 1.0)
    x = 2.2 * rays[:, 0] / (up + 0.18)
    y = 2.2 * rays[:, 1] / (up + 0.18)
    wave = np.zeros_like(x)
    high = 1.0
    for octave in range(5):
        a = 0.7 + 1.1 * octave
        x, y = np.cos(a) * x - np.sin(a) * y + 1.7, np.sin(a) * x + np.cos(a) * y + 0.6
        wave = wave + high * np.sin(x + 1.2 * np.sin(0.8 * y + a)) * np.sin(
            y + 0.9 * np.sin(1.1 * x)
        )
        x = 1.9 * x
        y = 1.9 * y
        high = 0.52 * high
    cover: Array = np.clip(1.5 * (wave - 0.15), 0.0, 1.0)
    return cover


def _open_day(rays: Array) -> Array:
    up = np.clip(rays[:, 2], 0.0, 1.0)[:, None]
    blue = np.array([0.13, 0.27, 0.62]) + np.array([0.50, 0.48, 0.30]) * np.exp(
        -up / 0.2
    )
    cover = 0.8 * _cumulus(rays)[:, None]
    sky = blue * (1.0 - cover) + cover * (0.75 + 0.35 * up) * np.array([1.0, 1.0, 1.03])
    radiance: Array = _open(rays, sky, 1.6) + _spot(rays, -42.0, 55.0, 1.2)[
        :, None
    ] * np.array([5.6, 5.2, 4.6])
    return radiance


def _open_grey(rays: Array) -> Array:
    return _open(rays, _grey_sky(rays), 0.8)


def _open_dusk(rays: Array) -> Array:
    return _open(rays, _dusk_sky(rays), 0.25)


def _open_night(rays: Array) -> Array:
    """The glow of a town over its roofs."""
    up = np.clip(rays[:, 2], 0.0, 1.0)[:, None]
    glow = np.array([0.35, 0.38, 0.55]) + np.array([1.4, 1.0, 0.7]) * np.exp(-up / 0.12)
    return _open(rays, glow * (1.0 + 0.4 * _cumulus(rays)[:, None]), 1.0)


def _even(rays: Array) -> Array:
    return np.where(rays[:, 2:] > 0.0, 1.0, 0.8) * np.ones(3)


STREETS: tuple[EnvironmentFamily, ...] = (
    EnvironmentFamily(
        "street",
        "street",
        lambda rays: street(rays, DAY),
        _SCRIPT,
        height=ROWS,
        ground="road",
    ),
    EnvironmentFamily(
        "street-wet",
        "street",
        lambda rays: street(rays, RAIN),
        _SCRIPT,
        height=ROWS,
        ground="wet-road",
    ),
    EnvironmentFamily(
        "street-dusk",
        "street",
        lambda rays: street(rays, DUSK),
        _SCRIPT,
        height=ROWS,
        ground="road",
    ),
    EnvironmentFamily(
        "avenue",
        "street",
        _open_day,
        _SCRIPT,
        height=ROWS,
        ground="avenue",
        lux=75000.0,
    ),
    EnvironmentFamily(
        "avenue-wet", "street", _open_grey, _SCRIPT, ground="wet-avenue", lux=9000.0
    ),
    EnvironmentFamily(
        "avenue-snow",
        "street",
        _open_grey,
        _SCRIPT,
        ground="snow-avenue",
        lux=9000.0,
        map="avenue-wet",
    ),
    EnvironmentFamily(
        "avenue-dusk", "street", _open_dusk, _SCRIPT, ground="avenue", lux=12.0
    ),
    EnvironmentFamily(
        "avenue-night", "street", _open_night, _SCRIPT, ground="avenue", lux=0.3
    ),
)
STREETS += tuple(
    replace(
        one,
        name=one.name.replace("avenue", place),
        split="place",
        ground=place,
        map=one.name,
    )
    for place in ("crossing", "car-park")
    for one in STREETS
    if one.ground == "avenue"
)
# the room is closed: the map stands for what its walls throw back, which exposure is
# metered with
STREETS += (
    EnvironmentFamily(
        "room", "place", _even, _SCRIPT, height=4, ground="room", lux=200.0
    ),
    EnvironmentFamily(
        "room-evening", "place", _even, _SCRIPT, height=4, ground="lit-room", lux=120.0
    ),
)
