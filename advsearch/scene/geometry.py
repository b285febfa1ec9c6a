"""Poses of the object and of the camera: 4 x 4 matrices (column vectors, z up).

Framing chooses the distance of a camera for which the user has set none. The distance
depends only on the object, the field of view and the shape of the image, and not on the
direction of the camera. So a configuration has the same image whether its azimuth is a
setting, a fixed value or a point of a grid. It is the smallest distance at which

- from the default direction the object reaches at most `FRAME_FILL` of the way to the
  edge of the image,
- from every azimuth at the default elevation all of the object is in the image, so that
  a search over azimuths cannot cut off the end of a long object, and
- the camera is outside the sphere around the object.

A vertex at offset `o` from the middle projects to `(o.left, o.up) / (distance -
o.outwards)`. So each vertex requires `distance >= o.outwards + max(|o.left| / tx,
|o.up| / ty)`, where tx and ty are the tangents of half the angles of view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull
from torch import Tensor

from advsearch.scene.assets import Float64Array, make_pose
from advsearch.scene.camera_model import CameraModel as CameraModel
from advsearch.scene.camera_model import make_pinhole as make_pinhole
from advsearch.scene.parts import CAMERA, BeamLamp, Footprint, Lamp, ScenePart
from advsearch.scene.poses import apply_settings as apply_settings
from advsearch.scene.poses import compute_base_vertices as compute_base_vertices
from advsearch.scene.poses import make_rotation as make_rotation
from advsearch.scene.rigged import PERSON_PARAMETERS as PERSON_PARAMETERS
from advsearch.scene.rigged import TIME as TIME
from advsearch.scene.rigged import find_rig_parameter as find_rig_parameter
from advsearch.scene.scene_data import SceneData
from advsearch.scene.scene_data import cache_per_scene as cache_per_scene
from advsearch.scene.scene_data import (
    compute_object_to_world as compute_object_to_world,
)
from advsearch.scene.settings import ORBIT_CAMERA, SETTINGS
from advsearch.scene.skeleton import (
    compute_rotation_entries as compute_rotation_entries,
)

# Fraction of half the image's width or height that the object may reach when the
# distance is computed.
FRAME_FILL = 0.86
# Smallest distance, in object sizes, to the sphere around the object.
MIN_SPHERE_DISTANCE = 0.02
# Sine of the largest elevation, for a height that would need a steeper one.
MAX_ELEVATION_SINE = math.sin(math.radians(89.0))
MIN_DEPTH = 1e-3  # depth up to which points are not projected
NO_OVERLAP = (math.inf, -math.inf)  # interval of shifts at which there is no overlap
DEFAULT_VIEW = ("camera.azimuth", "camera.elevation", "camera.roll")


@dataclass(frozen=True)
class Frame:
    """The field of view of an image, as ranges of tangents to the right and upwards.

    A direction is (x, y, 1): x to the right, y up, and 1 ahead.
    """

    left: float
    right: float
    low: float
    high: float

    @staticmethod
    def from_fov(
        fov: float, aspect: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)
    ) -> Frame:
        """Return the frame of a camera.

        Args:
            fov: field of view along the larger side, degrees.
            aspect: width over height.
            shift: shift of the frame to the right, in widths of the image, and
                downwards, in heights. The contents of the image move the other way.
        """
        # the tangent of half the larger side; the smaller side follows by the aspect
        half_tangent = math.tan(math.radians(fov) / 2.0)
        half_width = half_tangent * min(1.0, aspect)
        half_height = half_tangent * min(1.0, 1.0 / aspect)
        # Shifts are fractions of the full width and height.
        right_shift = 2.0 * half_width * shift[0]
        down_shift = 2.0 * half_height * shift[1]
        # A frame measures upwards, so that a shift downwards is subtracted.
        return Frame(
            left=-half_width + right_shift,
            right=half_width + right_shift,
            low=-half_height - down_shift,
            high=half_height - down_shift,
        )

    def corners(self) -> Float64Array:
        """Return unit directions (4, 3) to the corners."""
        tangents = [
            (x, y, 1.0) for x in (self.left, self.right) for y in (self.low, self.high)
        ]
        corners = np.array(tangents)
        return np.asarray(corners / np.linalg.norm(corners, axis=-1, keepdims=True))


def _compute_edge_tangents(
    description: SceneData, fov: Tensor, aspect: float
) -> Tensor:
    """Return the tangents (2,) of the angles from the middle of an image to its edges.

    The first is to the side, the second to the top.

    Args:
        description: the scene; if the user has chosen a lens, it replaces `fov`.
        fov: () field of view along the larger side of the image, degrees.
        aspect: width over height.
    """
    model = description.camera_model
    # A model without a name is a pinhole whose focal length follows from `fov`.
    if model is not None and model.name:
        # the largest rectangle around the axis that is in the image
        return torch.tensor(
            model.inner_half_tangents, dtype=torch.float64, device=fov.device
        )
    # half the width and half the height, as fractions of half the larger side
    shape = torch.tensor(
        [min(1.0, aspect), min(1.0, 1.0 / aspect)],
        dtype=torch.float64,
        device=fov.device,
    )
    return torch.tan(torch.deg2rad(fov.double()) / 2.0) * shape


def compute_framing_distance(
    description: SceneData, fov: Tensor, aspect: float
) -> Tensor:
    """Return the distance () at which a camera frames the object by default.

    It is the smallest distance from the middle of the object that meets three
    conditions. From the default direction, the object fills at most `FRAME_FILL` of the
    image's width and height. From every azimuth, all of it is in the image. And the
    camera is outside of the sphere around the object.

    The distance is in object sizes, float64, and differentiable in the field of view.
    If the user has chosen a lens, it replaces the field of view.

    Args:
        description: the scene.
        fov: () field of view along the larger side of the image, degrees.
        aspect: width over height.
    """
    offsets = torch.from_numpy(
        description.object.mesh.vertices.astype(np.float64)
        - compute_center(description)
    ).to(fov.device)
    edge_tangents = _compute_edge_tangents(description, fov, aspect)
    from_default_view = _compute_default_framing_distance(offsets, edge_tangents)
    elevation = float(SETTINGS["camera.elevation"].default or 0.0)
    from_all_around = _compute_framing_distance_all_around(
        offsets, elevation, edge_tangents
    )
    return torch.maximum(from_default_view, from_all_around).clamp_min(
        float(offsets.norm(dim=1).max()) + MIN_SPHERE_DISTANCE
    )


def _compute_default_framing_distance(offsets: Tensor, edge_tangents: Tensor) -> Tensor:
    """Return the distance () from which the object fills the image by default.

    Args:
        offsets: (V, 3) from the middle of the object to its vertices.
        edge_tangents: (2,) of the angles to the edges of the image.
    """
    azimuth, elevation, roll = (
        float(SETTINGS[name].default or 0.0) for name in DEFAULT_VIEW
    )
    axes = torch.from_numpy(compute_camera_axes(azimuth, elevation, roll)).T.to(offsets)
    (left, up, outwards) = offsets.matmul(axes).unbind(dim=1)
    (half_width, half_height) = edge_tangents * FRAME_FILL
    # A camera at the distance d sees a vertex at the tangent left / (d - outwards).
    # That is at most half_width if d >= outwards + left / half_width.
    distance = (
        outwards + torch.maximum(left.abs() / half_width, up.abs() / half_height)
    ).max()
    return distance


def compute_camera_axes(azimuth: float, elevation: float, roll: float) -> Float64Array:
    """Return the axes (3, 3) of a camera on an orbit.

    The rows are its directions left and up, and that from the object to the camera.

    Args:
        azimuth: azimuth of the camera around the object, degrees.
        elevation: elevation of the camera above the ground plane, degrees.
        roll: rotation of the image, counter-clockwise, degrees.
    """
    azimuth = math.radians(azimuth)
    roll = math.radians(roll)
    outwards = _compute_orbit_direction(azimuth, math.radians(elevation))
    left = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    upright = np.cross(-outwards, left)
    rolled_axes = (
        math.cos(roll) * left + math.sin(roll) * upright,
        math.cos(roll) * upright - math.sin(roll) * left,
    )
    return np.stack([*rolled_axes, outwards])


def _compute_orbit_direction(azimuth: float, elevation: float) -> Float64Array:
    """Return the unit vector (3,) at an azimuth and an elevation, in radians."""
    horizontal = math.cos(elevation)
    vertical = math.sin(elevation)
    return np.array(
        [horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), vertical]
    )


def compute_center(description: SceneData) -> Float64Array:
    """Return the point that the camera looks at.

    It is the middle (3,) of the object's bounding box in its default pose.
    """
    vertices = description.object.mesh.vertices.astype(np.float64)
    return np.asarray((vertices.min(axis=0) + vertices.max(axis=0)) / 2.0)


def _compute_framing_distance_all_around(
    offsets: Tensor, elevation: float, tangents: Tensor
) -> Tensor:
    """Return the distance at which every vertex is in the image from every azimuth.

    While the camera goes around the object, a vertex at height z and at the distance
    rho from the vertical axis has every azimuth a relative to the camera. In the axes
    of a camera at the elevation e its offset is

        outwards = rho cos(e) cos(a) + z sin(e)      towards the camera
        left     = rho sin(a)
        up       = z cos(e) - rho sin(e) cos(a)

    From a camera at the distance d, the vertex has the tangent left / (d - outwards).
    So it is within the left edge if d >= outwards + left / tangent, and within the top
    edge if d >= outwards + up / tangent. For the right and the bottom edge, left and up
    have the opposite sign. Each of these limits is A sin(a) + B cos(a) + C, whose
    largest value over all a is sqrt(A^2 + B^2) + C. The result is the largest limit
    over all vertices and edges, in the unit of the offsets.

    Args:
        offsets: (V, 3) from the middle of the object to its vertices.
        elevation: elevation of the camera, degrees.
        tangents: (2,) of the angles to the edges of the image.
    """
    rho = offsets[:, :2].norm(dim=1)
    z = offsets[:, 2]
    cosine = math.cos(math.radians(elevation))
    sine = math.sin(math.radians(elevation))
    inverse_width = 1.0 / tangents[0]
    inverse_height = 1.0 / tangents[1]

    # Left edge: A = rho / tangent, B = rho cos(e), C = z sin(e). The right edge has the
    # opposite A, and so the same largest value.
    sides_amplitude = rho * torch.sqrt(inverse_width**2 + cosine**2)
    distance_for_sides = sides_amplitude + z * sine

    # Top edge: A = 0, B = rho (cos(e) - sin(e) / tangent).
    top_amplitude = rho * (cosine - sine * inverse_height).abs()
    distance_for_top = top_amplitude + z * (sine + cosine * inverse_height)

    # Bottom edge: as for the top, with the opposite sign of `up`.
    bottom_amplitude = rho * (cosine + sine * inverse_height).abs()
    distance_for_bottom = bottom_amplitude + z * (sine - cosine * inverse_height)

    return torch.stack(
        [distance_for_sides.max(), distance_for_top.max(), distance_for_bottom.max()]
    ).max()


def make_affine(linear: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Return the pose (4, 4) of `v -> linear @ v + translation`.

    Differentiable in the matrix (3, 3) and the translation (3,).
    """
    top = torch.cat([linear, translation[:, None]], dim=1)
    return torch.cat([top, torch.tensor([[0.0, 0.0, 0.0, 1.0]]).to(linear)])


def camera_to_world(
    description: SceneData, aspect: float | None = None
) -> Float64Array:
    """Return the pose (4, 4) of the camera in use.

    By default it is on an orbit around the middle of the object, looking at it. The
    camera looks along its own +z with +y up and +x to the left, as Mitsuba's sensors
    do. It frames the object in its default pose, so that a shifted or scaled object
    moves in the image. If `camera.distance` is set, it replaces the framing distance.
    If `camera.height` is set, the elevation is the one at which the camera has this
    height at its distance, but no steeper than 89 degrees.

    Args:
        description: the scene.
        aspect: width over height of the image; None for the scene's.
    """
    if description.camera != ORBIT_CAMERA:
        return description.cameras[description.camera].to_world
    aspect = description.aspect if aspect is None else aspect
    distance = _compute_orbit_distance(description, aspect)
    elevation = _compute_orbit_elevation(description, distance)
    azimuth = description.azimuth_zero + description.get_number("camera.azimuth")
    # left, up, and from the object to the camera, which looks the other way
    roll = description.get_number("camera.roll")
    axes = compute_camera_axes(azimuth, elevation, roll)
    return make_pose(
        np.stack([axes[0], axes[1], -axes[2]], axis=1),
        compute_center(description) + distance * axes[2],
    )


def _compute_orbit_distance(description: SceneData, aspect: float) -> float:
    """Return the distance of the camera on an orbit, in object sizes.

    `aspect` is width over height of the image.
    """
    requested_distance = description.values["camera.distance"]
    if requested_distance is not None:
        return requested_distance / description.size_in_metres
    fov = torch.tensor(description.get_number("camera.fov"), dtype=torch.float64)
    return float(compute_framing_distance(description, fov, aspect))


def _compute_orbit_elevation(description: SceneData, distance: float) -> float:
    """Return the elevation in degrees of the camera on an orbit at a distance."""
    height = description.values.get("camera.height")
    if height is None:
        return description.get_number("camera.elevation")
    center_height = float(compute_center(description)[2])
    # sine of the elevation: height above the center, over distance
    sine = (height / description.size_in_metres - center_height) / distance
    sine = min(max(sine, -MAX_ELEVATION_SINE), MAX_ELEVATION_SINE)
    return math.degrees(math.asin(sine))


def project_points(
    description: SceneData,
    inputs: Mapping[str, Tensor],
    points: Tensor,
    size: tuple[int, int],
) -> tuple[Tensor, Tensor]:
    """Project points to the image of a scene's camera.

    Points are projected by the camera's lens if it has one. Otherwise the camera is a
    pinhole. Its field of view and shift are those of the inputs. Without them, the
    field of view is the scene's and there is no shift.

    Args:
        description: the scene.
        inputs: inputs of the scene.
        points: (N, 3) float64 in the camera's coordinates: left, up and ahead.
        size: height and width of the image.

    Returns:
        (N, 2) pixels to the right and down from the middle of the image; (N,) bool,
        which points are in front of the camera.
    """
    image_size = torch.tensor(size[::-1], dtype=torch.float64)
    # to the right, down and ahead
    points = points * torch.tensor([-1.0, -1.0, 1.0]).to(points)
    model = description.camera_model
    if model is not None:
        return _project_by_lens(model, inputs, points, image_size)
    return _project_by_pinhole(description, inputs, points, image_size)


def _project_by_lens(
    model: CameraModel, inputs: Mapping[str, Tensor], points: Tensor, size: Tensor
) -> tuple[Tensor, Tensor]:
    """Project points (N, 3), to the right, down and ahead, by the model of a lens.

    `size` (2,) is width and height of the image in pixels. The result is that of
    `project_points`.
    """
    if "camera.lens" in inputs:
        # A lens model computes with plain floats, without derivatives.
        model = model.with_intrinsics(inputs["camera.lens"].detach())
    positions, is_visible = model.project(points)
    # from [0, 1] over the image to pixels from its middle
    return (positions - 0.5) * size, is_visible


def _project_by_pinhole(
    description: SceneData, inputs: Mapping[str, Tensor], points: Tensor, size: Tensor
) -> tuple[Tensor, Tensor]:
    """Project points (N, 3), to the right, down and ahead, by a pinhole.

    The arguments are those of `_project_by_lens`, and the scene.
    """
    fov = (
        inputs.get("camera.fov", torch.tensor(description.get_number("camera.fov")))
        .double()
        .reshape(())
    )
    # in pixels; the field of view is that of the larger side
    focal = float(size.max()) / 2.0 / torch.tan(torch.deg2rad(fov) / 2.0)
    depth = points[:, 2]
    positions = focal * points[:, :2] / depth.clamp_min(MIN_DEPTH)[:, None]
    for axis, name in enumerate(("camera.shift_x", "camera.shift_y")):
        if name in inputs:
            # The frame is shifted to the right or down, so that points in it move to
            # the left or up.
            positions[:, axis] -= size[axis] * inputs[name].double().reshape(())
    return positions, depth > MIN_DEPTH


def compute_carried_pose(carrier: Tensor, pose_on_carrier: Tensor) -> Tensor:
    """Return the pose (4, 4), without a scale, of an object that is fixed to a carrier.

    Its position is scaled with the carrier; its axes are only rotated.

    Args:
        carrier: (4, 4) pose of the carrier, which may be scaled. The carried object
            keeps its size.
        pose_on_carrier: (4, 4) pose in the carrier's coordinates.
    """
    # the scale of a uniformly scaled rotation is the cube root of its determinant
    scale = torch.linalg.det(carrier[:3, :3]).abs() ** (1.0 / 3.0)
    return make_affine(
        carrier[:3, :3] / scale @ pose_on_carrier[:3, :3],
        carrier[:3, :3] @ pose_on_carrier[:3, 3] + carrier[:3, 3],
    )


def compute_car_pose(camera: Tensor) -> Tensor:
    """Return the pose (4, 4) of a car on which a camera (4, 4) looks ahead.

    The car is level, with its +x ahead and +z up, at the height 0 below the camera. The
    pose is differentiable. A camera looks along its own +z, the third column of its
    pose.
    """
    x, y = camera[:2, 2] / camera[:2, 2].norm().clamp_min(1e-6)
    zero = torch.zeros_like(x)
    unit = torch.ones_like(x)
    # the columns of the rotation: ahead (x, y, 0), to the left (-y, x, 0), and up
    rotation = torch.stack([x, -y, zero, y, x, zero, zero, zero, unit]).reshape(3, 3)
    position = torch.cat([camera[:2, 3], zero[None]])
    return make_affine(rotation, position)


def get_positioned_part(scene: SceneData, part: ScenePart) -> Any:
    """Return a part of a scene in the pose that the settings and the camera define.

    A mesh gets the pose and the material of its settings. A lamp with a beam gets its
    pose from its carrier: a mesh, or the car on which the camera is mounted. Other
    parts are returned as they are.
    """
    if not isinstance(part, BeamLamp):
        # `scene.meshes` has the settings applied. Only meshes are in it.
        return scene.meshes.get(part.name, part)
    if part.carrier == CAMERA:
        carrier = compute_car_pose(torch.from_numpy(camera_to_world(scene)))
    else:
        carrier = torch.from_numpy(scene.meshes[part.carrier].to_world)
    return replace(
        part,
        to_world=compute_carried_pose(
            carrier, torch.from_numpy(part.pose_on_carrier)
        ).numpy(),
    )


def list_lamps(scene: SceneData) -> dict[str, Lamp]:
    """Return every lamp of a scene by name; the environment is none."""
    return {
        part.name: get_positioned_part(scene, part)
        for part in scene.parts
        if isinstance(part, Lamp)
    }


@lru_cache(maxsize=4)
def compute_real_harmonics(height: int, width: int) -> Tensor:
    """Return the nine real spherical harmonics of degrees 0 to 2: (height, width, 9).

    They are evaluated at the texel centers of an equirectangular map: row 0 is around
    +z, and columns run from +x over +y. Each has root mean square 1 over the sphere,
    which is sqrt(4 pi) times the factors of Ramamoorthi and Hanrahan 2001, section 3.
    The last axis has the degrees 0 (one), 1 (y, z, x) and 2 (five).
    """
    x, y, z = _compute_texel_directions(height, width)
    root3 = math.sqrt(3.0)
    root15 = math.sqrt(15.0)
    root5 = math.sqrt(5.0)
    lower_degrees = [torch.ones_like(z), root3 * y, root3 * z, root3 * x]
    degree_two = [
        root15 * x * y,
        root15 * y * z,
        root5 / 2.0 * (3.0 * z * z - 1.0),
        root15 * x * z,
    ]
    return torch.stack(
        [*lower_degrees, *degree_two, root15 / 2.0 * (x * x - y * y)], dim=-1
    )


def _compute_texel_directions(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return x, y and z (height, width) of unit vectors to the texels of a map.

    Row 0 of the equirectangular map is around +z, and columns run from +x over +y.
    """
    theta = (torch.arange(height) + 0.5) * math.pi / height  # the angle from +z
    phi = (torch.arange(width) + 0.5) * 2.0 * math.pi / width
    x = theta.sin()[:, None] * phi.cos()[None]
    y = theta.sin()[:, None] * phi.sin()[None]
    z = theta.cos()[:, None].expand(height, width)
    return x, y, z


def make_euler_rotation(yaw: Tensor, pitch: Tensor, roll: Tensor) -> Tensor:
    """Return `Rz(yaw) Ry(pitch) Rx(roll)`, angles in degrees, as a (3, 3) matrix.

    Differentiable.
    """
    zero = torch.zeros_like(yaw)
    unit = torch.ones_like(yaw)
    (cz, sz), (cy, sy), (cx, sx) = (
        (torch.cos(a), torch.sin(a)) for a in map(torch.deg2rad, (yaw, pitch, roll))
    )
    # row by row
    about_z = torch.stack([cz, -sz, zero, sz, cz, zero, zero, zero, unit]).reshape(3, 3)
    about_y = torch.stack([cy, zero, sy, zero, unit, zero, -sy, zero, cy]).reshape(3, 3)
    about_x = torch.stack([unit, zero, zero, zero, cx, -sx, zero, sx, cx]).reshape(3, 3)
    return about_z @ about_y @ about_x


def make_vector_rotation(degrees: Tensor) -> Tensor:
    """Return the rotation (3, 3) about a vector (3,) by its length in degrees.

    This is Rodrigues' formula, R = 1 + sin(a) / a K + (1 - cos(a)) / a^2 K^2, where K
    is the matrix of the cross product with the vector. Near a = 0, where the quotients
    are NaN, they are replaced by series, so that value and derivative are right. The
    derivative of `torch.where` would be NaN even if only the branch that is not taken
    is NaN. So the quotients are computed with an angle of 1 there.
    """
    vector = degrees * (math.pi / 180.0)
    squared_angle = vector.square().sum()
    is_small = squared_angle < 1e-6
    angle = torch.sqrt(
        torch.where(is_small, torch.ones_like(squared_angle), squared_angle)
    )
    # sin a / a and (1 - cos a) / a^2, by their first two terms where a is small
    sine_factor = torch.where(
        is_small, 1.0 - squared_angle / 6.0, torch.sin(angle) / angle
    )
    cosine_factor = torch.where(
        is_small, 0.5 - squared_angle / 24.0, (1.0 - torch.cos(angle)) / angle.square()
    )
    cross = _make_cross_matrix(vector)
    return (
        torch.eye(3).to(degrees) + sine_factor * cross + cosine_factor * (cross @ cross)
    )


def _make_cross_matrix(vector: Tensor) -> Tensor:
    """Return the matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = vector
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


HIDDEN_SCALE = 1e-3  # scale of an occluder that is hidden behind the camera
OCCLUDER_INPUTS = (
    "camera.to_world",
    "camera.fov",
    "camera.shift",
    "camera.lens",
    "object.to_world",
    "object.offsets",
)
"""Inputs of other controls on which the pose of an occluder depends."""


def get_camera_pose(scene: SceneData, earlier_inputs: Mapping[str, Tensor]) -> Tensor:
    """Return the pose (4, 4) of the camera after earlier controls have moved it."""
    return earlier_inputs.get(
        "camera.to_world", torch.from_numpy(camera_to_world(scene))
    )


def make_hidden_pose(camera: Tensor) -> Tensor:
    """Return a pose (4, 4) that hides an object: tiny, behind a camera (4, 4)."""
    return make_affine(
        HIDDEN_SCALE * torch.eye(3).to(camera), camera[:3, 3] - camera[:3, 2]
    )


def compute_footprint(points: Float64Array) -> Footprint:
    """Return the convex outline from above and the height range of points (N, 3)."""
    # QJ jogs the points slightly, so that points on a line have a (thin) hull, too
    corners = ConvexHull(points[:, :2], qhull_options="QJ").vertices
    return Footprint(
        points[corners, :2], float(points[:, 2].min()), float(points[:, 2].max())
    )


def is_overlapping(first: Footprint, second: Footprint) -> bool:
    """Return whether two footprints overlap, seen from above, and in height."""
    # They overlap now if they do so at a shift of 0, along any direction.
    first_shift, last_shift = find_overlap_interval(first, second, np.array([1.0, 0.0]))
    return first_shift < 0.0 < last_shift


def find_overlap_interval(
    first: Footprint, second: Footprint, direction: Float64Array
) -> tuple[float, float]:
    """Return the interval of shifts at which one footprint overlaps another.

    The method is that of separating axes (Ericson 2005, Real-Time Collision Detection,
    section 5.2.1). Projected on the normal of an edge, both footprints are intervals,
    and they overlap for an interval of the shift. The footprints overlap if their
    projections on all normals do. Touching is no overlap.

    Args:
        first: the footprint that is shifted horizontally.
        second: the footprint that stays.
        direction: (2,) a shift of t moves the first footprint by t times this.

    Returns:
        The first and the last t; (inf, -inf) if they never overlap.
    """
    has_common_height = min(first.upper, second.upper) > max(first.lower, second.lower)
    if not has_common_height:
        return NO_OVERLAP
    normals = _compute_edge_normals(first, second)
    distances = _measure_overlap_distances(first, second, normals)
    # (k,) how far a shift of 1 moves the first along each normal
    speeds = normals @ direction
    # Along a normal at a right angle to the shift the first does not move. If its
    # projection does not overlap before the shift, it never does.
    is_still = speeds == 0.0
    distance_to_begin, distance_to_end = distances
    is_separated = (distance_to_begin >= 0.0) | (distance_to_end <= 0.0)
    if (is_still & is_separated).any():
        return NO_OVERLAP
    return _intersect_overlaps(distances[:, ~is_still], speeds[~is_still])


def _measure_overlap_distances(
    first: Footprint, second: Footprint, normals: Float64Array
) -> Float64Array:
    """Return how far a footprint has to move along normals (k, 2) to overlap another.

    Returns:
        (2, k) distances until the projection of the first on each normal begins to
        overlap that of the second, and until it no longer overlaps.
    """
    # positions (corners, k) of the corners along each normal
    first_positions = first.outline @ normals.T
    second_positions = second.outline @ normals.T
    distance_to_begin = second_positions.min(axis=0) - first_positions.max(axis=0)
    distance_to_end = second_positions.max(axis=0) - first_positions.min(axis=0)
    return np.stack([distance_to_begin, distance_to_end])


def _intersect_overlaps(
    distances: Float64Array, speeds: Float64Array
) -> tuple[float, float]:
    """Return the interval of shifts at which projections overlap on all normals.

    Args:
        distances: (2, k) how far the first footprint has to move along each normal
            until the overlap begins, and until it ends.
        speeds: (k,) how far a shift of 1 moves it along each normal, not 0.

    Returns:
        The first and the last shift; (inf, -inf) if there is none.
    """
    # Distance over speed is the shift. A negative speed swaps the shifts at which an
    # overlap begins and ends, and so they are sorted.
    shifts = np.sort(distances / speeds, axis=0)
    # All projections overlap after the last begin and before the first end.
    start = float(shifts[0].max())
    end = float(shifts[1].min())
    return (start, end) if start < end else NO_OVERLAP


def _compute_edge_normals(first: Footprint, second: Footprint) -> Float64Array:
    """Return the normals (k, 2) of the edges of two outlines.

    Edges between two corners at the same point have no normal, and are left out.
    """
    outlines = (first.outline, second.outline)
    edges = np.concatenate(
        [np.roll(outline, -1, axis=0) - outline for outline in outlines]
    )
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    return np.asarray(normals[edges.any(axis=1)])
