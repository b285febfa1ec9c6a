"""The road of a street that is a picture: asphalt with markings between two pavements,
dry or wet.

Lengths are metres. It runs along x; the object stands in the lane of those who drive
towards +x, on the right. Beyond the pavements, and far ahead, the environment's map is
seen.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from advsearch.scene.assets import Float32Array, Float64Array, Material, Mesh
from advsearch.scene.color import linear_to_srgb
from scenes.places.models import Look, Node, PlaceModel, Primitive

KERBS = (-2.3, 5.8)  # where the road ends on the right and on the left
EDGES = (-10.0, 13.6)  # where the pavements end: a multiple of their slabs
EYE = 1.5
FRONTS = (-12.0, 15.6)
STREET_ENDS = 170.0
"""Of the streets' maps: the height above the road that they are seen from, where the
fronts of the houses stand on the right and on the left, and how far the street goes on.
"""
PERIOD = 12.0  # the pattern repeats along the road
LENGTH = 120.0
TEXEL = 0.02
DRY = Material(roughness=0.9, specular=0.3)
WET = Material(roughness=0.16, specular=0.5)
WETNESS = 0.45
"""How dark wet asphalt is beside dry asphalt (Jensen et al. 1999, Rendering of Wet
Materials: about a half).
"""


def reflectance(
    x: Float64Array, y: Float64Array, grain: Float64Array | None = None
) -> Float64Array:
    """Return the linear reflectance (N, 3) of the ground at x along the road and y
    across; `grain` makes it uneven.
    """
    grain = np.zeros_like(x) if grain is None else grain
    wheels = np.exp(-(((np.abs(y) - 0.75) / 0.3) ** 2)) + np.exp(
        -(((np.abs(y - 3.5) - 0.75) / 0.3) ** 2)
    )
    value = 0.085 * (1.0 - 0.12 * wheels) * (1.0 + grain)
    color = value[:, None] * np.array([1.0, 0.99, 0.97])
    dashed = (np.abs(y - 1.75) < 0.07) & (x % 6.0 < 3.0)
    solid = (np.abs(y - KERBS[0] - 0.45) < 0.06) | (np.abs(y - KERBS[1] + 0.45) < 0.06)
    worn = (0.55 * (1.0 + 0.5 * grain))[:, None] * np.array([1.0, 0.99, 0.95])
    color = np.where((dashed | solid)[:, None], worn, color)
    off = np.maximum(KERBS[0] - y, y - KERBS[1])
    joint = (np.minimum(x % 0.6, (y + 10.0) % 0.4) < 0.016)[:, None]
    slabs = (
        (0.3 * (1.0 + 0.35 * grain))[:, None]
        * np.array([1.0, 0.97, 0.92])
        * np.where(joint, 0.6, 1.0)
    )
    kerb = (0.38 * (1.0 + 0.3 * grain))[:, None] * np.where(
        (x % 1.0 < 0.02)[:, None], 0.6, np.ones(3)
    )
    shade: Float64Array = np.where(
        (off > 0.0)[:, None], np.where((off > 0.16)[:, None], slabs, kerb), color
    )
    return np.where((np.abs(off) < 0.012)[:, None], 0.05, shade)


def make_road() -> PlaceModel:
    """Return the road, dark and reflecting where it is wet, with the streets' maps
    around it.
    """
    corners = np.array(
        [[-1.0, EDGES[0]], [1.0, EDGES[0]], [1.0, EDGES[1]], [-1.0, EDGES[1]]]
    )
    places = corners * np.array([LENGTH / 2, 1.0])
    uvs = np.stack(
        [places[:, 0] / PERIOD, (places[:, 1] - EDGES[0]) / (EDGES[1] - EDGES[0])],
        axis=1,
    )
    mesh = Mesh(
        np.concatenate([places, np.zeros((4, 1))], axis=1).astype(np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        np.tile(np.array([[0, 0, 1]], np.float32), (4, 1)),
        uvs.astype(np.float32),
    )
    looks = {"road": Look(_texture(False), DRY), "wet-road": Look(_texture(True), WET)}
    file = {
        "ground": ["road"],
        "lane_width": 3.5,
        "lights": {
            "day": {"map": "street"},
            "wet": {"map": "street-wet", "variant": "wet"},
            "dusk": {"map": "street-dusk"},
        },
        "picture": {"height": EYE, "x": [-STREET_ENDS, STREET_ENDS], "y": list(FRONTS)},
    }
    return PlaceModel(
        looks, [Node([Primitive(mesh, "road", {"wet": "wet-road"})])], file
    )


def _texture(wet: bool) -> Float32Array:
    """One period of the road, (h, w, 3) display-referred, multiples of 1/255, row 0 on
    the left.
    """
    width = round(PERIOD / TEXEL)
    height = round((EDGES[1] - EDGES[0]) / TEXEL)
    fine = np.random.Generator(np.random.PCG64(7)).random((height, width))
    grain = np.zeros_like(fine)
    # means over squares of texels, stretched to the spread of one texel's
    for share, side in ((0.9, 3), (0.8, 25)):
        blurred = uniform_filter(fine, side, mode="wrap")
        grain += share * 0.12 * (blurred - blurred.mean()) / blurred.std()
    x, y = np.meshgrid(
        (np.arange(width) + 0.5) * TEXEL, EDGES[1] - (np.arange(height) + 0.5) * TEXEL
    )
    linear = reflectance(x.ravel(), y.ravel(), grain.ravel()).reshape(
        height, width, 3
    ) * (WETNESS if wet else 1.0)
    return shown(np.round(linear, 5).astype(np.float32))


def shown(linear: Float32Array) -> Float32Array:
    """Return linear values as display-referred multiples of 1/255."""
    return np.asarray(
        np.round(linear_to_srgb(linear) * np.float32(255.0)) / np.float32(255.0),
        np.float32,
    )
