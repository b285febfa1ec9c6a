"""The `shadow` control: a dark card between the strongest light and the object, out of
the camera's sight.

The card is a polygon around a place in the plane across the way to the light:

    place = middle of the object + distance towards the light + size (x, y),     corner k = size radius_k at k / n turns

It is a real card: how soft its shadow is follows from the light's size and its own
distance. Where the camera would see it, it goes farther from the object, up to
`FARTHEST` times as far; where that does not help it is put away.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import (
    Choice,
    Control,
    Parameter,
    SceneDescription,
    Value,
    Values,
    assets,
    geometry,
    parts,
)

SMALLEST = 0.01  # a smaller card is put away
FARTHEST = 8.0
STEPS = 12
"""How many times as far it may be so that the camera does not see it, and in how many
steps that is looked for.
"""
BELOW_LAMP = 0.7  # where it is at most on the way to a lamp
# degrees above the ground that light counts from: lower, the card would stand on it
LOW = 5.0


_moving = partial(Parameter.moving, ("differences",))


class ShadowControl(Control):
    """A dark card that throws a shadow onto the object, out of the camera's sight."""

    kind = "shadow"
    amount = "size"
    # none is changed; but it comes after whatever moves the camera
    refines = frozenset(geometry.SURROUNDINGS)
    parameters = (
        _moving("x", "object sizes", -10.0, 10.0, 0.0, "Shift of the shadow to the "
                                                       "right, seen from the light.",
                (-0.5, 0.5)),
        _moving("y", "object sizes", -10.0, 10.0, 0.0, "Shift of the shadow upwards.", (-0.5, 0.5)),
        _moving("size", "object sizes", 0.0, 10.0, 0.0, "Radius of the card; at 0 "
                                                        "there is none.", (0.0, 0.6)),
        _moving("turn", "degrees", -3600.0, 3600.0, 0.0, "Turn of the card, counter-clockwise.", (0.0, 360.0),
                periodic=True),
        Parameter("radii", (None,), "1", 0.05, 1.0, 1.0, "Radius at each corner, as a "
                                                         "share of the size.",
                  moves_silhouettes=True, search=(0.2, 1.0)),
        _moving("azimuth", "degrees", -3600.0, 3600.0, "the strongest light's",
                "Direction from the object to the card.", periodic=True),
        _moving("elevation", "degrees", LOW, 90.0, "the strongest light's",
                "Height of that direction above the ground plane."),
        _moving("distance", "object sizes", 0.1, 1000.0, 2.0,
                "From the object's middle to the card; farther where the camera would "
                "see it.", log=True),
    )  # fmt: skip
    choices = (Choice("corners", 6, "Corners of the card.", whole=(3, 64)),)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        texel = np.full((2, 2, 3), 0.1, dtype=np.float32)
        away = geometry.put_away(
            torch.from_numpy(geometry.camera_to_world(scene))
        ).numpy()
        card = parts.polygon(int(self.chosen["corners"]))
        return scene.with_part(
            parts.MeshPart(
                self.name, card, texel, assets.Material(roughness=1.0), to_world=away
            )
        )

    def in_scene(self, parameter: Parameter) -> Parameter:
        x, y, z = strongest_light(self.scene)[0]
        match parameter.name:
            case "radii":
                return replace(parameter, shape=(int(self.chosen["corners"]),))
            case "azimuth":
                return replace(parameter, default=math.degrees(math.atan2(y, x)))
            case "elevation":
                return replace(
                    parameter, default=max(math.degrees(math.asin(min(z, 1.0))), LOW)
                )
        return parameter

    def scene_inputs(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        radii = values["radii"]
        rim = torch.from_numpy(parts.polygon(len(radii)).vertices[1:].copy()).to(radii)
        offsets = torch.cat([torch.zeros(1, 3).to(radii), rim * (radii[:, None] - 1.0)])
        far = self._distance(values, so_far)
        if far is None:
            pose = geometry.put_away(geometry.camera_in(self.scene, so_far).to(radii))
        else:
            right, up, outwards = torch.from_numpy(self._axes(values)).to(values["x"])
            turn = torch.deg2rad(values["turn"])
            size = values["size"].clamp_min(SMALLEST)
            along = torch.cos(turn) * right + torch.sin(turn) * up
            across = torch.cos(turn) * up - torch.sin(turn) * right
            place = (
                torch.from_numpy(geometry.middle(self.scene)).to(right) + far * outwards
            )
            place = place + values["x"] * right + values["y"] * up
            pose = geometry.affine(
                size * torch.stack([along, -across, -outwards], dim=1), place
            )
        return {f"{self.name}.to_world": pose, f"{self.name}.offsets": offsets}

    def measured(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        far = self._distance(values, so_far)
        return {
            "true_distance": Value(
                value=float(0.0 if far is None else far),
                unit="object sizes, 0 where it is put away",
            )
        }

    def _axes(self, values: Values) -> assets.Doubles:
        """Rows: to the right and upwards as seen from the light, and towards it."""
        left, up, outwards = geometry.camera_axes(
            float(values["azimuth"].detach()), float(values["elevation"].detach()), 0.0
        )
        return np.stack([-left, up, outwards])

    def _distance(self, values: Values, so_far: Mapping[str, Tensor]) -> float | None:
        """How far it is, so that a ball around it is not in the picture: outside of the
        cone around its corners; None where it is put away.
        """
        size, asked, x, y = (
            float(values[name].detach()) for name in ("size", "distance", "x", "y")
        )
        if size < SMALLEST:
            return None
        right, up, outwards = self._axes(values)
        aside = x * right + y * up
        camera = geometry.camera_in(self.scene, so_far).detach().double().cpu().numpy()
        model = self.scene.camera_model
        aspect = self.scene.aspect
        fov = so_far.get("camera.fov")
        shift = so_far.get("camera.shift")
        if model is not None:
            widest = 2.0 * math.atan(math.hypot(*model.tangents))
        else:
            widest = math.radians(
                self.scene.number("camera.fov") if fov is None else float(fov.detach())
            )
        corner = math.atan(
            math.tan(min(widest, 3.0) / 2.0)
            * math.hypot(1.0, min(aspect, 1.0 / aspect))
        )
        corner += 0.0 if shift is None else 2.0 * float(shift.detach().abs().max())
        _, lamp = strongest_light(self.scene)
        for share in np.geomspace(1.0, FARTHEST, STEPS):
            far = min(asked * share, BELOW_LAMP * lamp)
            way = (
                geometry.middle(self.scene) + far * outwards + aside - camera[:3, 3]
            ) @ camera[:3, :3]
            away = float(np.linalg.norm(way))
            if (
                away > size
                and math.acos(min(max(way[2] / away, -1.0), 1.0))
                - math.asin(size / away)
                >= corner
            ):
                return float(far)
        return None


@lru_cache(maxsize=8)
def strongest_light(scene: SceneDescription) -> tuple[assets.Doubles, float]:
    """Return the unit way (3,) from the object's middle to what puts most light on a
    surface that faces it, and how far that is: a lamp, or the brightest place of the
    environment above the ground, infinitely far.
    """
    found = np.array([0.0, 0.0, 1.0])
    far = math.inf
    most = 0.0
    directions, _, power = scene.list_environment_light()
    above = directions[:, 2] >= math.sin(math.radians(LOW))
    if above.any():
        strength = np.where(above, power.mean(axis=1), 0.0)
        found = directions[int(strength.argmax())]
        most = float(strength.max())
    for lamp in scene.lamps.values():
        way, lit = lamp.lighting(geometry.middle(scene))
        if float(lit.mean()) > most and way[2] > 0.0:
            far = float(np.linalg.norm(way))
            found = way / far
            most = float(lit.mean())
    return found, far
