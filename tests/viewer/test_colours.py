"""Colours that mean something, as people see them who do not tell red from green, or blue from yellow."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from advsearch.viewer.document import read_asset

Doubles = NDArray[np.float64]

VISIONS: dict[str, Doubles] = {
    "usual": np.eye(3),
    "no red": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no green": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "no blue": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""Of linear sRGB, for whom a kind of cones is missing altogether (Machado, Oliveira and Fernandes 2009)."""

XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = XYZ.sum(axis=1)


def lab(colour: Sequence[float], vision: str) -> Doubles:
    """A colour (3,) sRGB in [0, 1] in CIELAB, as it is seen."""
    values = np.asarray(colour)
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(np.maximum(XYZ @ np.clip(VISIONS[vision] @ linear, 0.0, 1.0) / WHITE, 0.008856))
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


def colours(pattern: str) -> list[list[float]]:
    """Colours of the style sheet, by a pattern that names their digits."""
    return [
        [int(text[k : k + 2], 16) / 255.0 for k in (0, 2, 4)] for text in re.findall(pattern, read_asset("viewer.css"))
    ]


@pytest.mark.parametrize("vision", VISIONS)
def test_the_colours_of_a_map_go_from_dark_to_light(vision: str) -> None:
    shades = json.loads(re.findall(r"const MAP = (.*?);", read_asset("sweep.js"))[0])
    lightness = [lab([value / 255.0 for value in shade], vision)[0] for shade in shades]
    assert min(np.diff(lightness)) > 7.0


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("dark", [False, True])
def test_series_and_borders_are_told_apart(vision: str, dark: bool) -> None:
    """By a difference of 2.3 in CIELAB they would just be; each series has a mark of its own besides."""
    series = colours(r"\.s[0-5] \{ color: #([0-9a-f]{6})")
    assert len(series) == 12
    shown = series[6:] if dark else series[:6]
    apart = min(np.linalg.norm(lab(a, vision) - lab(b, vision)) for a, b in itertools.combinations(shown, 2))
    assert apart > 12.0
    right, wrong = (colours(rf"--{name}: #([0-9a-f]{{6}})")[dark] for name in ("right", "wrong"))
    assert np.linalg.norm(lab(right, vision) - lab(wrong, vision)) > 60.0
