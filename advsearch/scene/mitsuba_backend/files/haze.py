"""Haze in a Mitsuba scene: one grey medium in a ball that the camera stands in, which is the house's own haze.

Mitsuba's `prbvolpath` sees nothing of a medium up to the first surface where the camera is inside it, so such a scene
is rendered as one with a `HazePart`. All other media stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from advsearch.scene.parts import HazePart

Plugins = Mapping[str, Mapping[str, object]]

MOST, DARKEST = 2.0, 1e-3
"""Of a haze: the largest extinction per object size, and the least share of the light that is scattered."""
OFF = 0.05
"""By what share of its radius the ball's middle may lie beside the object's; its edge is in the far background."""

_OF_BALL = {"type", "id", "radius", "center", "to_world", "bsdf", "interior"}
_OF_MEDIUM = {"type", "id", "sigma_t", "albedo", "scale", "phase"}


def haze_in(named: Plugins, matrix: npt.NDArray[np.float64]) -> tuple[HazePart, frozenset[str]] | None:
    """Return the haze of a scene and the names of the plugins that it is made of; None where there is none.

    Args:
        named: the plugins at the top of the scene.
        matrix: (4, 4) from the scene to the object's coordinates, with one scale for all directions.
    """
    inside = {_reference(one.get("medium")) for one in named.values()} - {None}
    balls = [
        name for name, one in named.items() if one["type"] == "sphere" and _reference(one.get("interior")) in inside
    ]
    media = [name for name, one in named.items() if one["type"] in ("homogeneous", "heterogeneous")]
    if len(inside) != 1 or len(balls) != 1 or len(media) != 1:
        return None
    ball, medium = named[balls[0]], named[media[0]]
    bsdf, phase = ball.get("bsdf"), medium.get("phase", {"type": "isotropic"})
    plain = set(ball) <= _OF_BALL and set(medium) <= _OF_MEDIUM and medium["type"] == "homogeneous"
    if not plain or bsdf != {"type": "null"} or phase != {"type": "isotropic"} or inside != {media[0]}:
        return None
    told = [_numbers(ball.get(key, otherwise)) for key, otherwise in (("radius", 1.0), ("center", np.zeros(3)))]
    told += [
        _numbers(medium.get(key, otherwise)) for key, otherwise in (("sigma_t", 1.0), ("albedo", 0.75), ("scale", 1.0))
    ]
    across, middle, density, albedo, scale = (np.full(1, np.nan) if one is None else one for one in told)
    own = matrix @ np.asarray(ball.get("to_world", np.eye(4)), np.float64)
    place = own @ np.append(np.broadcast_to(middle, (3,)), 1.0)
    radius = float(across[0]) * float(np.cbrt(abs(np.linalg.det(own[:3, :3]))))
    size = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    extinction, (red, green, blue) = density * scale / size, np.broadcast_to(albedo, (3,)).tolist()
    grey = 0.0 < float(extinction.min()) == float(extinction.max()) <= MOST
    if not (grey and DARKEST <= min(red, green, blue) and max(red, green, blue) <= 1.0):
        return None
    if not (radius > 0.0 and float(np.linalg.norm(place[:3])) <= OFF * radius):
        return None
    return HazePart(balls[0], radius, float(extinction[0]), (red, green, blue)), frozenset((balls[0], media[0]))


def _reference(given: object) -> str | None:
    return str(given["id"]) if isinstance(given, Mapping) and given.get("type") == "ref" else None


def _numbers(given: object) -> npt.NDArray[np.float64] | None:
    """Return a number, or the three of a colour; None of anything else."""
    if isinstance(given, Mapping):
        given = (
            given.get("value") if given.get("type") in ("rgb", "uniform") and set(given) <= {"type", "value"} else None
        )
    try:
        found = np.atleast_1d(np.asarray(given, np.float64))
    except (TypeError, ValueError):
        return None
    return found if found.shape in ((1,), (3,)) and bool(np.isfinite(found).all()) else None
