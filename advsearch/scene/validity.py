"""How far and how high a camera may go before the picture around a scene no longer fits the ground that is laid in it.

The map of a street, or a photograph of your own, is one picture, taken from a height h0 above the place of the object.
The renderer shows it as if it were infinitely far away; only the ground is laid as a plane. From elsewhere:

- What stands at a distance R behind the object is seen as large as from there, and would be seen R / (R + d) times as
  large from a camera that is d away. Up to d = R it is at most twice too large.
- Where the ground ends at a distance G from the object, on the side of the camera, the picture shows ground of its own
  nearer than that end, and the feet of what stands around below it. A camera of height h whose picture ends b degrees
  below the horizon sees nothing nearer than h / tan(b): up to d = G + h / tan(b) the end is out of sight.
- From a height h, the foot of what stands at R is h / R below the horizon, and is shown h0 / R below it. Up to
  h = 2 h0 it is at most twice too high.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from advsearch.scene.assets import Doubles
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.grounds import enclosed, paved
from advsearch.scene.library import BUNDLED_ENVIRONMENT
from advsearch.scene.places.quads import EDGES, EYE, FRONTS, LENGTH, STREET_ENDS

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription

FACTOR = 2.0  # how much too large, or too high, what stands around may be
RADIUS = 5.0  # how far from a photograph's camera its floor is empty, in heights of it, where nothing says so
TURNED = 2.0  # degrees that a street's map may be turned by: its houses then stand beside its road
Box = tuple[float, float, float, float]
"""From and to in x, from and to in y, metres or object sizes, with the object at (0, 0)."""


@dataclass(frozen=True)
class Surroundings:
    """What is known of the place in an environment's picture, in the lengths of the camera's distance."""

    height: float  # above the ground from which it was taken; infinite where nothing near is shown
    stands: Box | float  # how far away what stands around is
    laid: Box | float  # how far the ground reaches that is laid under the object
    turned: float = 0.0  # degrees that the picture is turned by against the ground


class CameraView(NamedTuple):
    """How a camera looks: its place around the object and where it looks to, degrees of azimuth; its horizontal
    distance and its height above the ground; and how far below the horizon its picture ends, degrees."""

    azimuth: float
    towards: float
    distance: float
    height: float
    lowest: float


def valid(environment: Surroundings, camera: CameraView) -> tuple[float, float]:
    """Return up to which horizontal distance from the object, and up to which height above the ground, an environment's
    picture fits a camera that looks as this one does (its own distance does not count): in the lengths of
    `environment`, infinite without a bound, 0 where it fits nowhere. See the top of this file."""
    if abs((environment.turned + 180.0) % 360.0 - 180.0) > TURNED:
        return 0.0, 0.0
    behind = (FACTOR - 1.0) * _reach(environment.stands, camera.towards)
    unseen = math.inf if camera.lowest <= 0.0 else camera.height / math.tan(math.radians(min(camera.lowest, 179.0)))
    return max(0.0, min(behind, _reach(environment.laid, camera.azimuth) + unseen)), FACTOR * environment.height


def _reach(area: Box | float, azimuth: float) -> float:
    if isinstance(area, float):
        return area
    x, y = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
    across = (area[1] if x > 0.0 else -area[0]) / max(abs(x), 1e-12)
    return min(across, (area[3] if y > 0.0 else -area[2]) / max(abs(y), 1e-12))


def surroundings_of(scene: SceneDescription) -> Surroundings | None:
    """Return what is known of the place in a scene's environment; None where nothing of it has to fit a ground."""
    lit = scene.environment
    if lit is None or scene.backdrop or enclosed(scene):  # what encloses the object is geometry, true from everywhere
        return None
    laid: Box | float = (-LENGTH / 2.0, LENGTH / 2.0, *EDGES) if paved(scene) else math.inf
    if lit.ground is not None and lit.source == BUNDLED_ENVIRONMENT and paved(scene):
        stands = (-STREET_ENDS, STREET_ENDS, *FRONTS)
        return Surroundings(EYE, stands, laid, scene.number("environment.rotation"))
    if lit.photographed and (paved(scene) or scene.photograph is not None):
        height, radius = scene.capture_height * scene.metres, scene.values.get("ground.radius")
        return Surroundings(height, RADIUS * height if radius is None else radius, laid)
    return Surroundings(math.inf, math.inf, laid) if paved(scene) else None


def view_of(scene: SceneDescription, to_world: Doubles | None = None, fov: float | None = None) -> CameraView:
    """Return how a scene is looked at: by its own camera, or by one with another pose (4, 4) or field of view."""
    pose = camera_to_world(scene) if to_world is None else to_world
    x, y, z = pose[:3, 3] * scene.metres
    ahead = pose[:3, 2]
    half = math.radians(scene.number("camera.fov") if fov is None else fov) / 2.0
    below = math.degrees(math.atan(math.tan(half) * min(1.0, 1.0 / scene.aspect)))
    if scene.camera_model is not None and scene.camera_model.name:
        below = 90.0
    azimuth = math.degrees(math.atan2(y, x))
    level = math.hypot(ahead[0], ahead[1])
    towards = math.degrees(math.atan2(ahead[1], ahead[0])) if level > 1e-6 else azimuth + 180.0
    lowest = below - math.degrees(math.asin(float(np.clip(ahead[2], -1.0, 1.0))))
    return CameraView(azimuth, towards, math.hypot(x, y), float(z), lowest)


def past(scene: SceneDescription, views: Sequence[CameraView], *, turns: bool = False) -> tuple[str, ...]:
    """Return what is said where views of a scene, at least one, go past what its environment's picture is valid for;
    `turns`: that is turned from view to view."""
    around = surroundings_of(scene)
    if around is None:
        return ()
    name, unit = scene.environment_name, "m" if scene.object.metres is not None else "object sizes"
    if valid(around, views[0]) == (0.0, 0.0) or (turns and isinstance(around.stands, tuple)):
        return (
            f"{name}: its houses are a picture, which `environment.rotation` turns against the road: they then stand "
            "across it; leave the rotation out",
        )
    limits = [valid(around, view) for view in views]
    each = zip(views, limits, strict=True)
    beyond = [view for view, (far, high) in each if view.distance > far or view.height > high]
    if not beyond:
        return ()
    near, far = min(limits)[0], max(limits)[0]
    which = f"{near:.3g} {unit}" if far < 1.05 * near else f"{near:.3g} to {far:.3g} {unit} (by where it looks)"
    high = f" and {limits[0][1]:.3g} {unit} high" if math.isfinite(limits[0][1]) else ""
    reach, top = max(view.distance for view in beyond), max(view.height for view in beyond)
    share = len(beyond) / len(views)
    there = "the camera is" if len(views) == 1 else f"{100.0 * share:.0f} % of the views are past that, up to"
    return (
        f"{name}: the place around the object is a picture, which fits a camera up to {which} away{high}; {there} "
        f"{reach:.3g} {unit} away and {top:.3g} {unit} high. There what stands around is more than twice too large or "
        "too high, or the ground ends in sight: predictions from there are about the picture, not about a real place",
    )
