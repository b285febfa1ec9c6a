"""Cameras that are mounted: ``--camera dashcam``, ``--camera robot``. They keep their height and do not roll."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class CameraPreset:
    """How a mounted camera stands, and what the control `camera` searches of it.

    Attributes:
        height: of the lens above the floor or the road, metres.
        fov: field of view along the larger side of the picture, degrees.
        distance: from the object's middle, metres; further where the object would not fit.
        azimuth: where it stands around the object, degrees: before what faces it, and behind a vehicle of the road;
            None for the scene's own.
        aside: how far to either side of it a search goes, degrees; 180 for all around.
        search: the other ranges that are searched by default, by parameter; what has none stays.
    """

    height: float
    fov: float
    distance: float
    azimuth: float | None
    aside: float
    search: Mapping[str, tuple[float, float]]


PRESETS: Mapping[str, CameraPreset] = MappingProxyType(
    {
        # Behind the windscreen of a car, in the lane of the object. What glass and dashboard do to a picture is not
        # in it.
        "dashcam": CameraPreset(
            height=1.3, fov=75.0, distance=10.0, azimuth=0.0, aside=10.0,
            search={"distance": (6.0, 60.0), "fov": (60.0, 90.0)},
        ),
        # The head of a humanoid: the Unitree G1 is 1.32 m tall (its product page), with a RealSense D435i in its face,
        # about a tenth of a metre below the top. The colour picture of that has 69 x 42 degrees, and its depth reaches
        # to 3 m (Clearpath Robotics, documentation of the RealSense D435).
        "robot": CameraPreset(
            height=1.2, fov=69.0, distance=1.0, azimuth=None, aside=180.0, search={"distance": (0.5, 3.0)},
        ),
    }
)  # fmt: skip
"""The mounted cameras by name."""
TABLE, TABLE_SIDE = 0.75, 1.2
"""Height and side in metres of a table, on which the objects of a bundled room stand that are no larger than
`ON_TABLES`."""
ON_TABLES = 0.5
"""Metres of the longest side."""
