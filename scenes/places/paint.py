"""What walls, windows and the road of a street look like: textures that the script
paints. Lengths are metres.

A picture is cut into strips, one above the other, each of which repeats along its
length.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from advsearch.scene.assets import Float32Array, Float64Array
from scenes.places.road import WETNESS, reflectance

Color = tuple[float, float, float]
PERIOD = 5.2  # strips repeat along this: two bays of a front
TEXEL = 0.025
COLUMNS = round(PERIOD / TEXEL)
BAY = 2.6
GROUND_FLOOR = 3.9
FLOOR = 3.1
HIGHEST = 17.0  # height of a strip of a front
WALLS: tuple[tuple[str, Color, Color], ...] = (
    ("bricks", (0.235, 0.085, 0.052), (0.40, 0.38, 0.33)), ("plaster", (0.55, 0.47, 0.33), (0.30, 0.28, 0.25)),
    ("stones", (0.46, 0.42, 0.34), (0.36, 0.33, 0.28)), ("plaster", (0.62, 0.58, 0.50), (0.42, 0.24, 0.17)),
    ("bricks", (0.30, 0.17, 0.10), (0.22, 0.21, 0.20)), ("plaster", (0.50, 0.33, 0.24), (0.46, 0.43, 0.38)),
    ("stones", (0.36, 0.36, 0.34), (0.22, 0.23, 0.24)), ("plaster", (0.42, 0.46, 0.45), (0.50, 0.47, 0.42)),
)  # fmt: skip
"""How the upper floors of each kind of front are laid, their linear reflectance, and
that of the ground floor.
"""
# stone, white and dark paint, doors, chimneys, signs of shops: strips `TRIM` high
TRIMS: tuple[Color, ...] = (
    (0.55, 0.52, 0.45), (0.66, 0.65, 0.61), (0.055, 0.06, 0.065), (0.10, 0.16, 0.11), (0.16, 0.055, 0.04),
    (0.06, 0.09, 0.15), (0.30, 0.28, 0.25), (0.45, 0.30, 0.10), (0.52, 0.10, 0.08), (0.05, 0.17, 0.20),
)  # fmt: skip
TRIM = 0.6
TILES = 6.0
STONE, WHITE, DARK, GREEN, RED, BLUE, GREY = range(7)
HEIGHT = HIGHEST * len(WALLS) + TRIM * len(TRIMS) + TILES


def wall_row(kind: int, height: Float64Array) -> Float64Array:
    """Return the texture's v at a height of a kind of front."""
    return np.asarray((HIGHEST * kind + height) / HEIGHT)


def trim_rows(
    kind: Float64Array | int, high: Float64Array | float
) -> tuple[Float64Array, Float64Array]:
    """Return v of the lower and the upper edge of something of a trim's colour that is
    so high.
    """
    low = HIGHEST * len(WALLS) + TRIM * np.asarray(kind) + 0.05
    return low / HEIGHT, (low + np.minimum(high, TRIM - 0.1)) / HEIGHT


def tile_rows(high: float) -> tuple[float, float]:
    """Return v of the lower and the upper edge of a roof."""
    low = HEIGHT - TILES + 0.05
    return low / HEIGHT, (low + min(high, TILES - 0.1)) / HEIGHT


def tint(color: Color | Float64Array) -> Float32Array:
    return np.asarray(color, np.float32)


@lru_cache(maxsize=1)
def walls() -> Float32Array:
    """Paint fronts, trims and roofs: (h, w, 3) linear reflectance, row 0 at v = 1."""
    strips = [_front(*wall, seed) for seed, wall in enumerate(WALLS)]
    rows = round(TRIM / TEXEL)
    grain = _grain(rows * len(TRIMS), COLUMNS, 40)
    strips += [
        tint(color) * (1.0 + 0.22 * grain[rows * k : rows * (k + 1), :, None])
        for k, color in enumerate(TRIMS)
    ]
    rows = round(TILES / TEXEL)
    x, z = _places(rows, COLUMNS)
    _, tone = _courses(x, z, 0.26, 0.3, 0.0, 77)
    shade = (
        (1.0 + 0.25 * tone)
        * np.where(z % 0.3 < 0.05, 0.55, 1.0)
        * (1.0 + 0.15 * _clouds(rows, COLUMNS, 30, 78))
    )
    strips.append(np.asarray(tint((0.19, 0.095, 0.065)) * shade[..., None], np.float32))
    return np.clip(np.concatenate(strips), 0.005, 0.9)[::-1]


def _front(laid: str, upper: Color, lower: Color, seed: int) -> Float32Array:
    """One kind of front, row 0 below."""
    rows = round(HIGHEST / TEXEL)
    x, z = _places(rows, COLUMNS)
    grain = _grain(rows, COLUMNS, seed)
    cloud = _clouds(rows, COLUMNS, 24, seed)
    ground = (z < GROUND_FLOOR)[..., None]
    if laid == "bricks":
        joint, tone = _courses(x, z, 0.26, 0.075, 0.014, seed)
        plain = tint(upper) * (1.0 + 0.45 * tone)[..., None]
        plain = np.where(joint[..., None], tint((0.33, 0.30, 0.26)), plain)
    elif laid == "stones":
        joint, tone = _courses(x, z, 0.65, 0.31, 0.016, seed)
        plain = tint(upper) * np.where(joint, 0.55, 1.0 + 0.12 * tone)[..., None]
    else:
        plain = tint(upper) * np.ones_like(x)[..., None]
    joint, tone = _courses(x, z, 1.3, 0.44, 0.03, seed + 9)
    shop = tint(lower) * np.where(joint, 0.6, 1.0 + 0.08 * tone)[..., None]
    color = np.where(ground, shop, plain)
    # rain has washed soot from the sills down the wall, dust splashes up from the
    # pavement
    up = (z - GROUND_FLOOR) % FLOOR
    across = np.abs(x % BAY - BAY / 2)
    under = (
        np.clip(1.0 - np.abs(across - 0.62) / 0.16, 0.0, 1.0)
        * np.clip(up / 0.9, 0.0, 1.0)
        * (up < 0.9)
    )
    streaks = under * (z > GROUND_FLOOR) * np.clip(0.5 + cloud, 0.0, 1.0)
    splash = np.exp(-z / 0.35)
    worn = (
        (1.0 - 0.30 * streaks)
        * (1.0 - 0.35 * splash)
        * (1.0 + 0.07 * cloud)
        * (1.0 + 0.10 * grain)
    )
    return np.asarray(color * worn[..., None], np.float32)


def _courses(
    x: Float32Array, z: Float32Array, long: float, high: float, joint: float, seed: int
) -> tuple[Float64Array, Float32Array]:
    """Where the joints of stones are, each course half a stone on, and a number from -1
    to 1 for each stone.
    """
    course = np.floor(z / high).astype(np.int64)
    along = x / long + 0.5 * (course % 2)
    number = np.floor(along).astype(np.int64) % round(PERIOD / long)
    tone = (
        np.random.Generator(np.random.PCG64(seed + 100)).random((256, 64), np.float32)
        * 2.0
        - 1.0
    )
    edge = (np.minimum(along % 1.0 * long, z % high)) < joint
    return edge, tone[course % 256, number]


PANES = 8  # kinds of panes, side by side: four of dwellings and four of shops


@lru_cache(maxsize=1)
def panes() -> Float32Array:
    """Paint what is behind the glass: (h, w, 3) linear reflectance, row 0 at v = 1; a
    pane is 1 wide and high.
    """
    side = 96
    u = ((np.arange(side, dtype=np.float32) + 0.5) / side)[None]
    v = 1.0 - u.T
    shown = []
    for kind in range(PANES):
        fine = np.random.Generator(np.random.PCG64(200 + kind))
        color = (
            tint((0.018, 0.02, 0.022))
            * (1.0 + 0.6 * v)[..., None]
            * np.ones((side, side, 1), np.float32)
        )
        if kind < 4:
            fold = 0.8 + 0.2 * np.sin(70.0 * u + 9.0 * kind)
            drawn = np.abs(u - 0.5) > (0.5, 0.32, 0.24, 0.4)[kind]
            cloth = tint(
                (
                    (0.3, 0.3, 0.3),
                    (0.42, 0.40, 0.36),
                    (0.30, 0.22, 0.16),
                    (0.5, 0.5, 0.48),
                )[kind]
            )
            color = np.where(
                drawn[..., None] & np.ones_like(v, bool)[..., None],
                cloth * fold[..., None],
                color,
            )
            blind = v > (0.55, 2.0, 2.0, 0.72)[kind]
            slat = 0.75 + 0.25 * (v * 26.0 % 1.0 > 0.25)
            color = np.where(
                (blind & (u > 0.0))[..., None],
                0.34 * slat[..., None] * np.ones_like(color),
                color,
            )
        else:
            for shelf in (0.12, 0.36, 0.6):  # what a shop has in its window
                for place in np.arange(0.06, 0.94, 0.11):
                    wide = fine.uniform(0.03, 0.055)
                    high = fine.uniform(0.06, 0.2)
                    there = (
                        (np.abs(u - place) < wide) & (v > shelf) & (v < shelf + high)
                    )
                    color = np.where(
                        there[..., None], tint(fine.uniform(0.02, 0.3, 3) ** 1.2), color
                    )
                color = np.where(
                    ((np.abs(v - shelf) < 0.012) & (u > 0))[..., None],
                    np.float32(0.16),
                    color,
                )
        shown.append(color)
    return np.concatenate(shown, axis=1)


GROUND_PERIOD = 24.0
GROUND_TEXEL = 0.03
FRONTS = (-12.0, 15.6)  # y of the fronts of the houses on the right and on the left


@lru_cache(maxsize=3)
def road(wet: bool, snow: bool = False) -> Float32Array:
    """Paint one period of the street's ground, (h, w, 3) linear reflectance, row 0 on
    the left.
    """
    columns = round(GROUND_PERIOD / GROUND_TEXEL)
    rows = round((FRONTS[1] - FRONTS[0]) / GROUND_TEXEL)
    x = (np.arange(columns) + 0.5) * GROUND_TEXEL
    y = FRONTS[1] - (np.arange(rows) + 0.5) * GROUND_TEXEL
    fine = _grain(rows, columns, 300)
    cloud = _clouds(rows, columns, 40, 301)
    grain = 0.13 * fine + 0.10 * cloud
    flat = [
        np.broadcast_to(axis, (rows, columns)).ravel() for axis in (x[None], y[:, None])
    ]
    dry = reflectance(flat[0], flat[1], grain.astype(np.float64).ravel())
    color = dry.reshape(rows, columns, 3).astype(np.float32)
    wide = x[None].astype(np.float32)
    high = y[:, None].astype(np.float32)
    lane = (high > -2.2) & (high < 5.7)
    shade = np.ones((rows, columns), np.float32)
    for left, right, low, up, tone in (
        (3.0, 7.2, -1.9, -0.4, 0.8),
        (14.0, 16.5, 2.3, 4.4, 1.16),
        (18.8, 19.7, -2.2, 5.7, 0.72),
    ):
        inside = (wide > left) & (wide < right) & (high > low) & (high < up)
        rim = inside & (
            (wide < left + 0.05)
            | (wide > right - 0.05)
            | (high < low + 0.05)
            | (high > up - 0.05)
        )
        shade = np.where(rim, 0.55, np.where(inside, tone, shade))
    # cracks
    for place, side, wave in ((1.0, 0.4, 0.9), (10.3, 3.3, 1.7), (12.0, -1.2, 2.6)):
        path = (
            side
            + 0.5 * np.sin(0.8 * wide + wave)
            + 0.16 * np.sin(3.1 * wide + place)
            + 0.05 * np.sin(11.0 * wide)
        )
        shade = np.where(
            (np.abs(high - path) < 0.014) & (np.abs(wide - place - 4.0) < 3.2),
            0.5,
            shade,
        )
    # oil, between the wheels
    shade = np.where(lane & (np.abs(high - 0.0) < 0.35), shade * 0.93, shade)
    gutter = np.minimum(np.abs(high + 2.2), np.abs(high - 5.7))
    shade = shade * (1.0 - 0.25 * np.exp(-((gutter / 0.18) ** 2)))
    color = color * shade[..., None]
    for at, side in ((9.0, 0.9), (21.5, 3.6)):  # covers of drains
        far = np.hypot(wide - at, high - side)
        rings = np.where(
            (far < 0.30) & ((wide * 18.0 % 1.0 < 0.4) != (high * 18.0 % 1.0 < 0.4)),
            0.11,
            0.045,
        )
        color = np.where(
            (far < 0.34)[..., None],
            np.where(far > 0.31, 0.025, rings)[..., None],
            color,
        )
    if snow:
        color = _snowed(color * WETNESS, high, cloud, fine)
    return np.asarray(
        np.clip(color * (WETNESS if wet else 1.0), 0.004, 0.9), np.float32
    )


def _snowed(
    color: Float32Array, y: Float32Array, cloud: Float32Array, fine: Float32Array
) -> Float32Array:
    """Snow on wet ground: wheels have left two tracks in each lane, grey slush lies
    between them.
    """
    far = np.minimum(np.abs(np.abs(y) - 0.75), np.abs(np.abs(y - 3.5) - 0.75))
    wheels = np.clip(1.6 - (far + 0.12 * cloud) / 0.2, 0.0, 1.0)
    driven = np.clip((5.2 - np.abs(y - 1.75) * 2.0) / 1.2 + 1.0, 0.0, 1.0)[..., None]
    clean = (
        0.8 * (1.0 + 0.05 * cloud + 0.04 * fine)[..., None] * tint((0.97, 0.985, 1.0))
    )
    slush = (0.5 + 0.16 * cloud + 0.08 * fine)[..., None] * tint((0.98, 0.98, 1.0))
    snow = clean + driven * (slush - clean)
    return np.asarray(snow + 0.85 * wheels[..., None] * (color - snow), np.float32)


def _places(rows: int, columns: int) -> tuple[Float32Array, Float32Array]:
    """Along and up of the middles of texels (rows, columns), row 0 below."""
    x = (np.arange(columns, dtype=np.float32) + 0.5) * TEXEL
    z = (np.arange(rows, dtype=np.float32) + 0.5) * TEXEL
    return np.broadcast_to(x, (rows, columns)), np.broadcast_to(
        z[:, None], (rows, columns)
    )


def _grain(rows: int, columns: int, seed: int) -> Float32Array:
    """Noise of one texel, about 0, from -1 to 1."""
    return (
        np.random.Generator(np.random.PCG64(seed)).random((rows, columns), np.float32)
        * 2.0
        - 1.0
    )


def _clouds(rows: int, columns: int, cell: int, seed: int) -> Float32Array:
    """Smooth noise of some octaves from `cell` texels down, periodic along rows, about
    -1 to 1.
    """
    total = np.zeros((rows, columns), np.float32)
    for octave in range(3):
        size = max(cell >> octave, 2)
        coarse = _grain(
            -(-rows // size) + 2, max(columns // size, 1), seed + 7 * octave
        )
        for axis, count in ((0, rows), (1, columns)):
            at = np.arange(count, dtype=np.float32) * (
                (coarse.shape[axis] - (2, 0)[axis]) / count
            )
            low = at.astype(np.int64)
            share = (at - low) ** 2 * (3.0 - 2.0 * (at - low))
            share = share.reshape((-1, 1) if axis == 0 else (1, -1))
            near = np.take(coarse, low % coarse.shape[axis], axis)
            coarse = near + share * (
                np.take(coarse, (low + 1) % coarse.shape[axis], axis) - near
            )
        total += coarse * (0.6, 0.3, 0.2)[octave]
    return total
