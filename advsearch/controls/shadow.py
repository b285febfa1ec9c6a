"""The `shadow` control: a dark card between the strongest light and the object.

The card is a polygon around a center, in the plane at a right angle to the light:

    center = center of the object + distance towards the light + (x, y)
    corner k = size radius_k at k / n turns

The card is part of the scene, so that the size of the light and the distance of the card
determine how soft its shadow is. If the camera would see the card, it is moved farther
from the object, up to `MAX_DISTANCE_FACTOR` times as far. If that is not enough, the card
is hidden behind the camera.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

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

MIN_SIZE = 0.01  # a smaller card is hidden
MAX_DISTANCE_FACTOR = 8.0
N_DISTANCES = 12
"""Largest factor of the requested distance with which the card is hidden from the camera,
and number of distances that are tried.
"""
MAX_LAMP_FRACTION = 0.7  # largest distance, as a fraction of that of the lamp
# smallest elevation, in degrees, of light and card: a lower card would be in the ground
MIN_ELEVATION = 5.0


_moving = partial(Parameter.moving, ("differences",))


class ShadowControl(Control):
    """A dark card that casts a shadow onto the object, outside of the picture."""

    kind = "shadow"
    strength_parameter = "size"
    # They are only read: so the control is evaluated after those that move the camera.
    refines = frozenset(geometry.OCCLUDER_INPUTS)
    parameters = (
        _moving(
            "x",
            "object sizes",
            -10.0,
            10.0,
            0.0,
            "Shift of the shadow to the right, seen from the light.",
            (-0.5, 0.5),
        ),
        _moving(
            "y",
            "object sizes",
            -10.0,
            10.0,
            0.0,
            "Shift of the shadow upwards.",
            (-0.5, 0.5),
        ),
        _moving(
            "size",
            "object sizes",
            0.0,
            10.0,
            0.0,
            "Radius of the card; at 0 there is no card.",
            (0.0, 0.6),
        ),
        _moving(
            "turn",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Rotation of the card, counter-clockwise.",
            (0.0, 360.0),
            periodic=True,
        ),
        Parameter(
            "radii",
            (None,),
            "1",
            0.05,
            1.0,
            1.0,
            "Radius at each corner, as a fraction of the size.",
            moves_silhouettes=True,
            search=(0.2, 1.0),
        ),
        _moving(
            "azimuth",
            "degrees",
            -3600.0,
            3600.0,
            "the strongest light's",
            "Direction from the object to the card.",
            periodic=True,
        ),
        _moving(
            "elevation",
            "degrees",
            MIN_ELEVATION,
            90.0,
            "the strongest light's",
            "Height of that direction above the ground plane.",
        ),
        _moving(
            "distance",
            "object sizes",
            0.1,
            1000.0,
            2.0,
            "Distance from the object's centre to the card; larger if the camera would "
            "see the card.",
            log=True,
        ),
    )
    choices = (
        Choice("corners", 6, "Number of corners of the card.", integer_bounds=(3, 64)),
    )

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with the card, out of sight; `scene_inputs` moves it."""
        # a dark grey texture, the same everywhere
        texels = np.full((2, 2, 3), 0.1, dtype=np.float32)
        camera_pose = torch.from_numpy(geometry.camera_to_world(scene))
        hidden_pose = geometry.make_hidden_pose(camera_pose).numpy()
        card = parts.make_polygon(int(self.choice_values["corners"]))
        material = assets.Material(roughness=1.0)
        return scene.with_part(
            parts.MeshPart(self.name, card, texels, material, to_world=hidden_pose)
        )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter for the scene.

        The default azimuth and elevation are those of the strongest light, so that the
        card is between it and the object. There is one radius for each corner.
        """
        light_direction, _ = find_strongest_light(self.scene)
        x, y, z = light_direction
        match parameter.name:
            case "radii":
                return replace(parameter, shape=(int(self.choice_values["corners"]),))
            case "azimuth":
                return replace(parameter, default=math.degrees(math.atan2(y, x)))
            case "elevation":
                elevation = math.degrees(math.asin(min(z, 1.0)))
                return replace(parameter, default=max(elevation, MIN_ELEVATION))
        return parameter

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the pose of the card that casts the shadow, and its corners' offsets.

        A radius of 1 leaves a corner at the distance 1 from the center, where the mesh
        has it, and 0 moves it to the center. The card is hidden if it has no size, or if
        the camera would see it at all distances.
        """
        radii = values["radii"]
        distance = self._find_distance(values, earlier_inputs)
        if distance is None:
            camera_pose = geometry.get_camera_pose(self.scene, earlier_inputs)
            pose = geometry.make_hidden_pose(camera_pose.to(radii))
        else:
            pose = self._compute_pose(values, distance)
        offsets = _compute_corner_offsets(radii)
        return {f"{self.name}.to_world": pose, f"{self.name}.offsets": offsets}

    def _compute_pose(self, values: Values, distance: float) -> Tensor:
        """Return the card's pose (4, 4) at a distance from the object's center.

        The card faces the object. It is shifted by x and y in its plane, and turned
        about the line to the object.

        Args:
            values: values of the control by parameter.
            distance: distance in object sizes.
        """
        axes = torch.from_numpy(self._compute_axes(values)).to(values["x"])
        right, up, outwards = axes
        turn = torch.deg2rad(values["turn"])
        size = values["size"].clamp_min(MIN_SIZE)
        first_axis = torch.cos(turn) * right + torch.sin(turn) * up
        second_axis = torch.cos(turn) * up - torch.sin(turn) * right
        object_center = torch.from_numpy(geometry.compute_center(self.scene)).to(right)
        center = object_center + distance * outwards
        center = center + values["x"] * right + values["y"] * up
        # The card's third axis, its normal, points to the object: -outwards. With two
        # axes as they are and one reversed, the pose would be a reflection. So the second
        # axis is reversed, too.
        card_axes = torch.stack([first_axis, -second_axis, -outwards], dim=1)
        return geometry.make_affine(size * card_axes, center)

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return the actual distance of the card that casts the shadow.

        It may be larger than requested, and is 0 if the card is hidden, see
        `_find_distance`.
        """
        distance = self._find_distance(values, earlier_inputs)
        return {
            "true_distance": Value(
                value=0.0 if distance is None else float(distance),
                unit="object sizes, 0 where it is put away",
            )
        }

    def _compute_axes(self, values: Values) -> assets.Float64Array:
        """Return the axes (3, 3) of a viewer at the light who looks at the object.

        Rows are right and up, as that viewer sees them, and the direction from the
        object to the light.
        """
        left, up, outwards = geometry.compute_camera_axes(
            float(values["azimuth"].detach()), float(values["elevation"].detach()), 0.0
        )
        return np.stack([-left, up, outwards])

    def _find_distance(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> float | None:
        """Find the smallest distance at which the camera does not see the card.

        Distances from the requested one upwards are tried, or only the largest distance
        (`_compute_max_distance`) if the requested one is beyond it. The camera does not
        see the card if a ball around it, whose radius is the card's size, is outside of
        the cone through the corners of the image.

        Args:
            values: values of the control by parameter.
            earlier_inputs: inputs of earlier controls, which may move the camera.

        Returns:
            The distance in object sizes; None if the card has to be hidden, because it
            has no size or is visible at all distances.
        """
        size = float(values["size"].detach())
        requested = float(values["distance"].detach())
        if size < MIN_SIZE:
            return None
        right, up, outwards = self._compute_axes(values)
        offset = float(values["x"].detach()) * right + float(values["y"].detach()) * up
        camera_pose = geometry.get_camera_pose(self.scene, earlier_inputs)
        camera = camera_pose.detach().double().cpu().numpy()
        cone_angle = self._compute_image_cone_angle(earlier_inputs)
        for distance in self._list_distances(requested):
            card = geometry.compute_center(self.scene) + distance * outwards + offset
            # components along the camera's axes, the columns of its pose
            in_camera = (card - camera[:3, 3]) @ camera[:3, :3]
            if _is_outside_cone(in_camera, radius=size, angle=cone_angle):
                return float(distance)
        return None

    def _list_distances(self, requested: float) -> list[float]:
        """List the distances of the card to try, ascending, in object sizes.

        They begin at the requested one. From some factor on, each is the largest
        distance.
        """
        max_distance = self._compute_max_distance()
        factors = np.geomspace(1.0, MAX_DISTANCE_FACTOR, N_DISTANCES)
        return [min(requested * factor, max_distance) for factor in factors]

    def _compute_max_distance(self) -> float:
        """Return the distance up to which the card stays nearer than the lamp."""
        _, lamp_distance = find_strongest_light(self.scene)
        return MAX_LAMP_FRACTION * lamp_distance

    def _compute_image_cone_angle(self, earlier_inputs: Mapping[str, Tensor]) -> float:
        """Return the angle of the image's corners from the camera's axis, radians.

        With a camera model, or with a shift, it is an upper bound.
        """
        aspect = self.scene.aspect
        fov = self._find_image_fov(earlier_inputs)
        # The field of view is along the longer side. At most 3.0 radians (172 degrees),
        # as the tangent is infinite at 180 degrees.
        half_tangent = math.tan(min(fov, 3.0) / 2.0)
        shorter_over_longer = min(aspect, 1.0 / aspect)
        corner = math.atan(half_tangent * math.hypot(1.0, shorter_over_longer))
        shift = earlier_inputs.get("camera.shift")
        if shift is not None:
            # A shift is in image sizes; two radians for each are more than enough.
            corner += 2.0 * float(shift.detach().abs().max())
        return corner

    def _find_image_fov(self, earlier_inputs: Mapping[str, Tensor]) -> float:
        """Return the field of view, radians; with a camera model an upper bound."""
        model = self.scene.camera_model
        fov_input = earlier_inputs.get("camera.fov")
        if model is not None:
            # The angle between opposite corners of the visible rectangle, in place of that
            # of its longer side. So a corner that is computed from it is farther from the
            # axis than the true one.
            return 2.0 * math.atan(math.hypot(*model.inner_half_tangents))
        if fov_input is not None:
            return math.radians(float(fov_input.detach()))
        return math.radians(self.scene.get_number("camera.fov"))


def _compute_corner_offsets(radii: Tensor) -> Tensor:
    """Return the offsets (1 + n, 3) of the card's vertices for its radii (n,).

    The first vertex is the center, which stays.
    """
    corners = parts.make_polygon(len(radii)).vertices[1:]
    rim = torch.from_numpy(corners.copy()).to(radii)
    return torch.cat([torch.zeros(1, 3).to(radii), rim * (radii[:, None] - 1.0)])


def _is_outside_cone(center: assets.Float64Array, radius: float, angle: float) -> bool:
    """Return whether a ball is outside of a cone about the camera's axis.

    Args:
        center: (3,) center of the ball in camera coordinates; z is the cone's axis.
        radius: radius of the ball.
        angle: angle between axis and side of the cone, radians.
    """
    distance = float(np.linalg.norm(center))
    if distance <= radius:
        return False
    center_angle = math.acos(min(max(center[2] / distance, -1.0), 1.0))
    return center_angle - math.asin(radius / distance) >= angle


@geometry.cache_per_scene
def find_strongest_light(scene: SceneDescription) -> tuple[assets.Float64Array, float]:
    """Find the light that gives most irradiance to a surface that faces it.

    Returns:
        The unit direction (3,) from the object's center to a lamp, or to the brightest
        part of the environment above `MIN_ELEVATION`; and the distance of the light,
        infinite for the environment. Without any light the direction is straight up.
    """
    direction, max_irradiance = _find_brightest_part(scene)
    distance = math.inf
    for lamp in scene.lamps.values():
        to_lamp, lamp_irradiance = lamp.compute_lighting(geometry.compute_center(scene))
        is_above_center = to_lamp[2] > 0.0
        if float(lamp_irradiance.mean()) > max_irradiance and is_above_center:
            distance = float(np.linalg.norm(to_lamp))
            direction = to_lamp / distance
            max_irradiance = float(lamp_irradiance.mean())
    return direction, distance


def _find_brightest_part(scene: SceneDescription) -> tuple[assets.Float64Array, float]:
    """Return the direction (3,) and the irradiance of the environment's brightest part.

    Only parts above `MIN_ELEVATION` count. Without any, the direction is straight up.
    """
    # `power` (N, 3) is the radiance of each part of the environment times its solid
    # angle: the irradiance on a surface that faces it.
    directions, _, power = scene.list_environment_light()
    is_above = directions[:, 2] >= math.sin(math.radians(MIN_ELEVATION))
    if not is_above.any():
        return np.array([0.0, 0.0, 1.0]), 0.0
    irradiance = np.where(is_above, power.mean(axis=1), 0.0)
    return directions[int(irradiance.argmax())], float(irradiance.max())
