"""What things stand on beside a plain table: the floor of the environment's photograph,
a road, or a place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from advsearch.scene import settings
from advsearch.scene.assets import BoolArray, EnvironmentAsset, Float64Array
from advsearch.scene.geometry import camera_to_world, compute_center
from advsearch.scene.parts import MeshPart, Place
from advsearch.scene.photographed_ground import compute_open_sky_irradiance
from advsearch.scene.places.place_file import load_bundled_place, make_place_parts
from advsearch.scene.places.schema import PictureEntry
from advsearch.scene.scene_data import AnyScene, SceneData

# shares of linear red, green and blue in luminance (Rec. ITU-R BT.709)
LUMINANCE = (0.2126, 0.7152, 0.0722)


def is_paved(scene: SceneData) -> bool:
    """Return whether the object stands on a road, or on the ground of a place."""
    return any(part.is_ground for part in scene.surrounding_meshes.values())


def has_lanes(scene: SceneData) -> bool:
    """Return whether the object stands in a lane, where what faces +x drives along
    it.
    """
    place = find_place(scene)
    return place is not None and place.file.lane_width is not None


LANE_WIDTH = 3.5  # metres, of the lane that the object stands in where no place says it
# metres above the road up to which a camera in the lane may be that of a car
MAX_CAR_CAMERA_HEIGHT = 2.5


def is_against_traffic(scene: SceneData, camera: Float64Array) -> bool:
    """Return whether a camera would drive against the traffic, towards the object.

    That is so if the object is a vehicle in a lane, and the camera is in front of it,
    at most half a lane to the side, and no higher than the camera of a car. Lanes run
    along x, and the object faces +x.

    Args:
        scene: the scene.
        camera: (4, 4) pose of the camera.
    """
    # The camera is mounted in a car in the object's lane, or the place has lanes.
    has_traffic = scene.is_in_lane or has_lanes(scene)
    if not (scene.object.drives and has_traffic):
        return False
    # along x and y, since the object faces +x
    distance_ahead, distance_aside = (
        camera[:2, 3] - compute_center(scene)[:2]
    ) * scene.size_in_metres
    height = float(camera[2, 3]) * scene.size_in_metres
    width = _find_lane_width(scene)
    return bool(
        distance_ahead > 0.0
        and abs(distance_aside) <= width / 2.0
        and height <= MAX_CAR_CAMERA_HEIGHT
    )


def _find_lane_width(scene: SceneData) -> float:
    """Return the width of the lane in which the object stands, metres."""
    site = find_place(scene)
    if site is None or site.file.lane_width is None:
        return LANE_WIDTH
    return site.file.lane_width


def make_traffic_remark(scene: SceneData) -> str:
    """Return the remark on a camera that drives against the traffic."""
    azimuth_behind = (180.0 - scene.azimuth_zero) % 360.0
    return (
        f"The camera is in the lane of {scene.object.name} and looks at its front, "
        f"against the traffic; behind it is `set` camera.azimuth={azimuth_behind:g}"
    )


def is_enclosed(scene: SceneData) -> bool:
    """Return whether houses or trees stand around the object.

    They enclose the scene, so that light paths seldom leave it. Only some places have
    such meshes.
    """
    # `is_laid_ground` is true for all meshes of a road or a place, and `is_ground` for
    # those that are the ground itself.
    return any(
        part.is_laid_ground and not part.is_ground
        for part in scene.surrounding_meshes.values()
    )


PLACE_BY_GROUND_KIND: Mapping[str, tuple[str, str | None]] = {
    settings.DRY_ROAD: ("road", None),
    settings.WET_ROAD: ("road", "wet"),
    settings.DRY_AVENUE: ("avenue", None),
    settings.WET_AVENUE: ("avenue", "wet"),
    settings.SNOW_AVENUE: ("avenue", "snow"),
    settings.CROSSING: ("crossing", None),
    settings.CAR_PARK: ("car-park", None),
    settings.ROOM: ("room", None),
    settings.LIT_ROOM: ("room", "evening"),
}
"""The bundled place, and its variant, of each kind of ground that is one."""


def find_ground_kind(scene: SceneData) -> str | None:
    """Return the kind of ground that settings or the environment require.

    It is None if the ground has the size 0. Otherwise the setting `ground.kind` counts,
    and without it the environment's own kind. The latter is ignored if settings
    describe a table. It is None if neither names a kind.
    """
    requested = scene.values.get("ground.kind")
    if scene.get_number("ground.size") <= 0.0:
        return None
    if requested is not None:
        return settings.GROUND_KINDS[int(requested)]
    if scene.environment is None or not scene.requested.isdisjoint(
        settings.TABLE_SETTINGS
    ):
        return None
    return scene.environment.ground


def find_place(scene: SceneData) -> Place | None:
    """Return the place that a scene has around its object; None where it has none."""
    return next(
        (
            part.place
            for part in scene.surrounding_meshes.values()
            if part.place is not None
        ),
        None,
    )


def load_requested_place(scene: SceneData) -> Place | None:
    """Return the place that settings or the environment require; None for none.

    A kind of ground, if there is one, decides alone: it is a bundled place, or no place
    (a table, for example). Otherwise the environment may have a place, which is ignored
    if settings describe a table or the ground has the size 0.
    """
    kind = find_ground_kind(scene)
    if kind is not None:
        return _load_bundled_surroundings(kind)
    if scene.environment is None:
        return None
    has_table_settings = not scene.requested.isdisjoint(settings.TABLE_SETTINGS)
    has_no_ground = scene.get_number("ground.size") <= 0.0
    if has_table_settings or has_no_ground:
        return None
    surroundings: Place | None = scene.environment.place
    return surroundings


def _load_bundled_surroundings(kind: str) -> Place | None:
    """Return the bundled place of a kind of ground; None for a kind that is no place."""
    if kind not in PLACE_BY_GROUND_KIND:
        return None
    bundled_name, variant = PLACE_BY_GROUND_KIND[kind]
    return load_bundled_place(bundled_name, variant)


def with_requested_ground(scene: AnyScene) -> AnyScene:
    """Return the scene with the road or the place that its settings request.

    A road or place that the scene has already is replaced. The place's lamps are on if
    the environment is dark.
    """
    other_parts = tuple(
        part
        for part in scene.parts
        if not (isinstance(part, MeshPart) and part.is_laid_ground)
    )
    # A photograph behind the object shows a ground already.
    place = None
    if scene.backdrop_photograph is None:
        place = load_requested_place(scene)
    if place is None:
        if len(other_parts) == len(scene.parts):
            return scene
        return replace(scene, parts=other_parts)
    laid_parts = _make_surrounding_parts(place, scene)
    return replace(scene, parts=(*other_parts, *laid_parts))


def _make_surrounding_parts(
    surroundings: Place, scene: SceneData
) -> tuple[MeshPart, ...]:
    """Return the parts of a place; its lamps are on if the environment is dark."""
    environment = scene.environment
    radiance_unit = None if environment is None else environment.candelas
    # Nothing but lamps depends on darkness.
    is_dark = bool(surroundings.file.lamps) and _is_dark(environment)
    return make_place_parts(
        surroundings, scene.size_in_metres, radiance_unit, is_dark=is_dark
    )


def _is_dark(environment: EnvironmentAsset | None) -> bool:
    """Return whether level ground has less illuminance than `DUSK_ILLUMINANCE`.

    The result is False if that is not known: without an environment, or if its light
    has no unit.
    """
    if environment is None or environment.candelas is None:
        return False
    # of level ground, (3,)
    irradiance = compute_open_sky_irradiance(
        torch.from_numpy(environment.radiance.copy())
    )
    weighted_irradiance = float(irradiance @ torch.tensor(LUMINANCE))
    # `candelas` is the luminance of a radiance of 1, cd/m2: the product is in lux.
    illuminance = environment.candelas * weighted_irradiance
    return illuminance < DUSK_ILLUMINANCE


DUSK_ILLUMINANCE = (
    70.0  # illuminance of the open sky at which street lamps are switched on, lux
)


# --------------------------------------------------------------------------------------
# How far and how high a camera may go before the picture around a scene no longer fits
# the ground that is laid in it.
#
# The map of a street, or a photograph of your own, is one picture, taken from a height
# h0 above the place of the object. The renderer shows it as if it were infinitely far
# away; only the ground is laid as a plane. From elsewhere:
#
# - What stands at a distance R behind the object is seen as large as from there, and
# would be seen R / (R + d) times as
#   large from a camera that is d away. Up to d = R it is at most twice too large.
# - Where the ground ends at a distance G from the object, on the side of the camera,
# the picture shows ground of its
#   own nearer than that end, and the feet of what stands around below it. A camera of
# height h whose picture ends b
#   degrees below the horizon sees nothing nearer than h / tan(b): up to d = G + h /
# tan(b) the end is out of sight.
# - From a height h, the foot of what stands at R is h / R below the horizon, and is
# shown h0 / R below it. Up to
#   h = 2 h0 it is at most twice too high.

MAX_SCALE_ERROR = 2.0  # how much too large, or too high, what stands around may be
# how far from a photograph's camera its floor is empty, in heights of it, where nothing
# says so
DEFAULT_EMPTY_RADIUS = 5.0
# degrees that a street's map may be turned by: its houses then stand beside its road
MAX_MAP_ROTATION = 2.0
# the range of distance and height of a picture that fits no camera
NO_RANGE = (0.0, 0.0)
Box = tuple[float, float, float, float]
"""From and to in x, from and to in y, metres or object sizes, with the object at (0,
0).
"""


@dataclass(frozen=True)
class Surroundings:
    """What is known of the place in an environment's picture.

    In the lengths of the camera's distance.
    """

    # above the ground from which it was taken; infinite where nothing near is shown
    height: float
    nearest_distance: Box | float  # how far away what stands around is
    ground_extent: (
        Box | float
    )  # how far the ground reaches that is laid under the object
    rotation: float = 0.0  # degrees that the picture is turned by against the ground


class CameraView(NamedTuple):
    """How a camera looks.

    Its place around the object and where it looks to, degrees of azimuth; its
    horizontal distance and its height above the ground; and how far below the horizon
    its picture ends, degrees.
    """

    azimuth: float
    view_azimuth: float
    distance: float
    height: float
    lower_angle: float


def find_valid_range(
    surroundings: Surroundings, camera: CameraView
) -> tuple[float, float]:
    """Return the largest distance and height of a camera for an environment's picture.

    The distance has two bounds: beyond the first, things in the picture look too large
    by the factor `MAX_SCALE_ERROR`; beyond the second, the end of the ground comes into
    sight. They depend on the camera's height and direction, not on its own distance.

    Args:
        surroundings: the place that the picture shows.
        camera: position and direction of the camera.

    Returns:
        Distance and height in the unit of `surroundings`, infinite if there is no
        bound; `NO_RANGE` if the picture is rotated against the ground.
    """
    # from -180 to 180 degrees
    rotation = (surroundings.rotation + 180.0) % 360.0 - 180.0
    if abs(rotation) > MAX_MAP_ROTATION:
        return NO_RANGE
    # A camera that moves back by d sees things at a distance r too large by the factor
    # (r + d) / r. The nearest things count in its direction of view (`view_azimuth`).
    max_scale_distance = (MAX_SCALE_ERROR - 1.0) * _reach_of_area(
        surroundings.nearest_distance, camera.view_azimuth
    )
    hidden_ground_distance = _compute_hidden_ground(camera)
    # The ground ends where the camera stands, at its azimuth from the object.
    ground_distance = _reach_of_area(surroundings.ground_extent, camera.azimuth)
    max_distance = min(max_scale_distance, ground_distance + hidden_ground_distance)
    max_height = MAX_SCALE_ERROR * surroundings.height
    return max(0.0, max_distance), max_height


def _compute_hidden_ground(camera: CameraView) -> float:
    """Return the length of the ground before a camera that is below its image."""
    if not camera.lower_angle > 0.0:
        return math.inf
    # Beyond 90 degrees the distance is negative; at 180 it would be infinite.
    lower_angle = math.radians(min(camera.lower_angle, 179.0))
    return camera.height / math.tan(lower_angle)


def _reach_of_area(area: Box | float, azimuth: float) -> float:
    """Return how far an area reaches from the object in a direction, by its azimuth.

    `area` is a box around the object, or a number: the same in all directions. The
    azimuth is in degrees.
    """
    if isinstance(area, float):
        return area
    x = math.cos(math.radians(azimuth))
    y = math.sin(math.radians(azimuth))
    x_from, x_to, y_from, y_to = area
    x_side = x_to if x > 0.0 else -x_from
    y_side = y_to if y > 0.0 else -y_from
    # A ray leaves the box at the first of its sides.
    reach_to_x_side = x_side / max(abs(x), 1e-12)
    reach_to_y_side = y_side / max(abs(y), 1e-12)
    return min(reach_to_x_side, reach_to_y_side)


def find_surroundings(scene: SceneData) -> Surroundings | None:
    """Return the dimensions of the place that a scene's environment is a picture of.

    A picture looks right only from near the point where it was taken. The result has
    the height of that point, the distance of the nearest things in the picture, and the
    extent of the ground, in meters. It is None if the scene has no ground to which the
    picture has to fit.
    """
    environment = scene.environment
    # An enclosing place is geometry, which looks right from everywhere.
    if environment is None or scene.backdrop or is_enclosed(scene):
        return None
    place = find_place(scene)
    extent: Box | float = math.inf if place is None else bound_ground(place)
    picture = _find_map_picture(environment)
    # The near part of the place is geometry, and the far part a picture, whose limits
    # the place's file states.
    if place is not None and picture is not None:
        return _bound_picture(scene, picture, extent)
    if environment.photographed and (is_paved(scene) or scene.photograph is not None):
        return _bound_photographed_map(scene, extent)
    if not is_paved(scene):
        return None
    # Any other map is taken for infinitely far: only the end of the ground counts.
    return Surroundings(
        height=math.inf, nearest_distance=math.inf, ground_extent=extent
    )


def _bound_picture(
    scene: SceneData, picture: PictureEntry, extent: Box | float
) -> Surroundings:
    """Return the limits of a picture around a ground of an extent, metres."""
    # a `Box`: from and to in x, and in y
    nearest_things: Box = (*picture.x, *picture.y)
    return Surroundings(
        height=picture.height,
        nearest_distance=nearest_things,
        ground_extent=extent,
        rotation=scene.get_number("environment.rotation"),
    )


def _find_map_picture(environment: EnvironmentAsset) -> PictureEntry | None:
    """Return what is known of the picture of a place in an environment's map."""
    bundled = PLACE_BY_GROUND_KIND.get(environment.ground or "")
    captured_site = (
        environment.place if bundled is None else load_bundled_place(*bundled)
    )
    if captured_site is None:
        return None
    picture: PictureEntry | None = captured_site.file.picture
    return picture


def _bound_photographed_map(scene: SceneData, extent: Box | float) -> Surroundings:
    """Return the limits of a photographed map over a ground of an extent, metres.

    They are the height of its camera, and the radius of the empty floor around it.
    """
    height = scene.capture_height * scene.size_in_metres
    radius = scene.values.get("ground.radius")
    if radius is None:
        radius = DEFAULT_EMPTY_RADIUS * height
    return Surroundings(height=height, nearest_distance=radius, ground_extent=extent)


def bound_ground(place: Place) -> Box:
    """Return the bounds of the ground of a place, metres: x from, to, y from, to."""
    vertices = np.concatenate(
        [part.mesh.vertices for part in place.parts if part.is_ground]
    )
    (x0, y0) = vertices[:, :2].min(axis=0).tolist()
    (x1, y1) = vertices[:, :2].max(axis=0).tolist()
    return x0, x1, y0, y1


def make_camera_view(
    scene: SceneData,
    to_world: Float64Array | None = None,
    fov: float | None = None,
) -> CameraView:
    """Return where a camera is, in metres, and in which direction it looks.

    A camera that looks straight down counts as looking towards the object.

    Args:
        scene: the scene.
        to_world: (4, 4) pose of the camera; None: the scene's.
        fov: field of view along the larger side, degrees; None: the scene's.
    """
    pose = camera_to_world(scene) if to_world is None else to_world
    # An object of unknown size counts as 1 m large.
    x, y, z = pose[:3, 3] * scene.size_in_metres
    forward = pose[:3, 2]
    half_height_angle = _compute_half_height_angle(scene, fov)
    azimuth = math.degrees(math.atan2(y, x))
    view_azimuth = _compute_view_azimuth(forward, azimuth)
    # how far below the horizon the lower border of the image is
    lower_angle = half_height_angle - _compute_view_elevation(forward)
    return CameraView(
        azimuth=azimuth,
        view_azimuth=view_azimuth,
        distance=math.hypot(x, y),
        height=float(z),
        lower_angle=lower_angle,
    )


def _compute_view_elevation(forward: Float64Array) -> float:
    """Return how far above the horizon a camera looks, degrees.

    `forward` (3,) is the unit vector of its axis. Its z may be beyond 1 by rounding.
    """
    sine = float(np.clip(forward[2], -1.0, 1.0))
    return math.degrees(math.asin(sine))


def _compute_view_azimuth(forward: Float64Array, azimuth: float) -> float:
    """Return the azimuth, degrees, in which a camera looks; `azimuth` is its own.

    `forward` is its direction (3,). Straight down counts as towards the object.
    """
    if math.hypot(forward[0], forward[1]) > 1e-6:
        return math.degrees(math.atan2(forward[1], forward[0]))
    return azimuth + 180.0


def _compute_half_height_angle(scene: SceneData, fov: float | None) -> float:
    """Return half of the angle of view along an image's height, in degrees.

    `fov` is the field of view along the larger side, degrees; None is the scene's.
    """
    # A lens that the user has chosen has a name. It may have any field of view, and so
    # show the ground straight below the camera.
    if scene.camera_model is not None and scene.camera_model.name:
        return 90.0
    if fov is None:
        fov = scene.get_number("camera.fov")
    half_fov = math.radians(fov) / 2.0
    # The field of view is along the larger side. In a wide image the height is smaller
    # than that by the aspect.
    height_to_larger_side = min(1.0, 1.0 / scene.aspect)
    half_tangent = math.tan(half_fov) * height_to_larger_side
    return math.degrees(math.atan(half_tangent))


def get_camera_position(view: CameraView) -> Float64Array:
    """Return where a camera is, (3,) metres, with the object at the origin."""
    azimuth = math.radians(view.azimuth)
    return np.array(
        [
            view.distance * math.cos(azimuth),
            view.distance * math.sin(azimuth),
            view.height,
        ]
    )


def _describe_views_beyond(n_beyond: int, n_views: int) -> str:
    """Return the subject of the remark about views that are too far or too high."""
    if n_views == 1:
        return "the camera is"
    percentage = 100.0 * (n_beyond / n_views)
    return f"{percentage:.0f} % of the views are past that, up to"


def list_view_remarks(
    scene: SceneData, views: Sequence[CameraView], *, rotates_map: bool = False
) -> tuple[str, ...]:
    """Return a remark if views go beyond what an environment's picture is valid for.

    At most one remark is returned, the first of these that applies: views are outside
    of the place; the map is rotated against the road; views are too far or too high.

    Args:
        scene: the scene.
        views: positions and directions of its camera, at least one.
        rotates_map: whether the map's rotation differs from view to view.
    """
    surroundings = find_surroundings(scene)
    place = find_place(scene)
    outside = () if place is None else list_outside_remarks(scene, place, views)
    if outside or surroundings is None:
        return outside
    # Whether the range is `NO_RANGE` depends on the map's rotation alone, and so is the
    # same for all views.
    is_against_road = find_valid_range(surroundings, views[0]) == NO_RANGE
    # Only houses along a road have a `Box`. Other surroundings are equally far in all
    # directions, and have a number.
    has_houses = isinstance(surroundings.nearest_distance, tuple)
    if is_against_road or (rotates_map and has_houses):
        return (
            f"{scene.environment_name}: its houses are a picture, which "
            "`environment.rotation` turns against the road: they then stand "
            "across it; leave the rotation out",
        )
    return _list_range_remarks(scene, surroundings, views)


def _list_range_remarks(
    scene: SceneData, surroundings: Surroundings, views: Sequence[CameraView]
) -> tuple[str, ...]:
    """Return a remark if views are too far or too high for an environment's picture.

    The result is empty if all views are within the limits.

    Args:
        scene: the scene.
        surroundings: the place that the environment is a picture of.
        views: positions and directions of its camera, at least one.
    """
    limits = [find_valid_range(surroundings, view) for view in views]
    views_beyond = _select_views_beyond(views, limits)
    if not views_beyond:
        return ()
    unit = "m" if scene.object.size_in_metres is not None else "object sizes"
    subject = _describe_views_beyond(len(views_beyond), len(views))
    farthest = max(view.distance for view in views_beyond)
    highest = max(view.height for view in views_beyond)
    return (
        f"{scene.environment_name}: the place around the object is a picture, which "
        f"fits a camera up to {_describe_limits(limits, unit)}; {subject} "
        f"{farthest:.3g} {unit} away and {highest:.3g} {unit} high. There what stands "
        "around is more than twice too large or too high, or the ground ends in sight: "
        "predictions from there are about the picture, not about a real place",
    )


def _select_views_beyond(
    views: Sequence[CameraView], limits: Sequence[tuple[float, float]]
) -> list[CameraView]:
    """Return the views that are beyond their largest distance or height."""
    return [
        view
        for view, (max_distance, max_height) in zip(views, limits, strict=True)
        if view.distance > max_distance or view.height > max_height
    ]


def _describe_limits(limits: Sequence[tuple[float, float]], unit: str) -> str:
    """Return up to where an environment's picture fits a camera, for a message.

    Args:
        limits: largest distance and height of each view.
        unit: their unit, such as "m".
    """
    distances = [distance for distance, _ in limits]
    smallest = min(distances)
    largest = max(distances)
    text = f"{smallest:.3g} {unit}"
    if largest >= 1.05 * smallest:  # else they are the same, for a reader
        text = f"{smallest:.3g} to {largest:.3g} {unit} (by where it looks)"
    text += " away"
    # the height does not depend on the view
    max_height = limits[0][1]
    if math.isfinite(max_height):
        text += f" and {max_height:.3g} {unit} high"
    return text


def _describe_position(position: Float64Array) -> str:
    """Return the coordinates of a position (3,) in metres as text."""
    x, y, z = position
    return f"x {x:.3g}, y {y:.3g}, z {z:.3g} m"


def list_outside_remarks(
    scene: SceneData, place: Place, views: Sequence[CameraView]
) -> tuple[str, ...]:
    """Return a remark if cameras are outside of the box that a place is made for.

    From there its image is not that of a real place. The result is empty if all views
    are inside.

    Args:
        scene: the scene.
        place: its place, whose file states the box.
        views: positions and directions of its camera, at least one.
    """
    # `valid` is a model with the fields x, y and z; iterating it yields names and
    # values. An axis without limits is None.
    axis_limits = [
        (axis, limits) for axis, limits in place.file.valid if limits is not None
    ]
    positions = np.array([get_camera_position(view) for view in views])
    is_outside = _find_outside(positions, axis_limits)
    if not is_outside.any():
        return ()
    box = " and ".join(
        f"{axis} {lower:g} to {upper:g} m" for axis, (lower, upper) in axis_limits
    )
    outside_views = _describe_outside_views(positions, is_outside)
    return (
        f"{scene.environment_name}: the place holds for a camera at {box} from the "
        f"object; {outside_views}. Predictions from there are not about a real place",
    )


def _find_outside(
    positions: Float64Array, axis_limits: Sequence[tuple[str, tuple[float, float]]]
) -> BoolArray:
    """Return which positions (N, 3) are outside of limits along named axes."""
    is_outside = np.zeros(len(positions), bool)
    for axis, (lower, upper) in axis_limits:
        coordinate = positions[:, "xyz".index(axis)]
        is_outside |= (coordinate < lower) | (coordinate > upper)
    return is_outside


def _describe_outside_views(positions: Float64Array, is_outside: BoolArray) -> str:
    """Return a clause about the cameras, at positions (N, 3), that are outside."""
    first_position = _describe_position(positions[int(is_outside.argmax())])
    if len(positions) == 1:
        return f"the camera is outside, at {first_position}"
    return (
        f"{100.0 * is_outside.mean():.0f} % of the views are outside, the "
        f"first at {first_position}"
    )
