"""Writes where OpenCV sees some points through some lenses:
tests/scene/camera_reference.json.

    pip install opencv-python-headless
    python tools/camera_reference.py

The test beside it compares ours with these numbers, and with OpenCV itself where it can
be imported.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

OUT = (
    Path(__file__).resolve().parent.parent / "tests" / "scene" / "camera_reference.json"
)
WIDTH = 1280
HEIGHT = 720
MATRIX = (902.5, 0.0, 645.25, 0.0, 911.75, 352.5, 0.0, 0.0, 1.0)
LENSES: dict[str, tuple[float, ...]] = {
    "plumb_bob": (-0.28, 0.07, 0.001, -0.002, 0.01),
    "rational_polynomial": (1.2, 0.7, 0.003, -0.001, 0.1, 1.5, 0.9, 0.2),
    "thin_prism": (
        0.05,
        -0.01,
        0.0,
        0.002,
        0.003,
        0.0,
        0.0,
        0.0,
        0.01,
        -0.02,
        0.005,
        0.01,
    ),
    "equidistant": (0.02, -0.005, 0.001, -0.0002),
}
"""Coefficients in OpenCV's order, by the name that ROS has for their model."""


def points() -> np.ndarray:
    """Points (N, 3) before the camera, up to 53 degrees from its axis."""
    rng = np.random.default_rng(52)
    depth = rng.uniform(0.5, 8.0, (24, 1))
    angle = rng.uniform(0.0, 2.0 * np.pi, (24, 1))
    tangent = rng.uniform(0.0, 0.75, (24, 1))
    return np.round(
        np.concatenate(
            [tangent * np.cos(angle), tangent * np.sin(angle), np.ones((24, 1))], 1
        )
        * depth,
        4,
    )


def projected(
    cv2: Any, model: str, coefficients: tuple[float, ...], at: np.ndarray
) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in OpenCV's own words; the centre of the first
    pixel is (0, 0).
    """
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    still = np.zeros((3, 1))
    matrix = np.array(MATRIX).reshape(3, 3)
    found, _ = project(
        at.reshape(-1, 1, 3), still, still, matrix, np.array(coefficients)
    )
    return np.asarray(found).reshape(-1, 2)


def main() -> None:
    """Write the table."""
    import cv2  # type: ignore[import-not-found]

    at = points()
    lenses = {
        model: {
            "coefficients": list(one),
            "pixels": np.round(projected(cv2, model, one, at), 5).tolist(),
        }
        for model, one in LENSES.items()
    }
    table = {
        "opencv": cv2.__version__,
        "width": WIDTH,
        "height": HEIGHT,
        "matrix": list(MATRIX),
    }
    OUT.write_text(
        json.dumps({**table, "points": at.tolist(), "lenses": lenses}) + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
