"""The tables of Hosek and Wilkie's sky and sun that Mitsuba ships for its `sunsky` plugin."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.variant import mitsuba


def sunsky_tables() -> tuple[Tensor, Tensor, Tensor]:
    """Read the RGB coefficients.

    Returns:
        (10 turbidities, 2 ground albedos, 6 control points, 3 channels, 9) shape of the dome; (10, 2, 6, 3) its mean
        radiance; and (10, 45 pieces, 3 channels, 4 powers of the elevation, 6 powers of the cosine at the limb)
        radiance of the sun. All float32.
    """
    mi = mitsuba()
    path = Path(str(mi.__file__)).parent / "data" / "sunsky" / "sunsky_datasets.bin"
    with contextlib.redirect_stdout(io.StringIO()):  # the reader prints what it loads
        tables = mi.tensor_io.read(str(path))
    shape, level, sun = (
        torch.from_numpy(tables[name]).float() for name in ("sky_params_rgb", "sky_rad_rgb", "sun_rad_rgb")
    )
    return shape, level, sun
