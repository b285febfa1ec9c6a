"""The `occlusion` control: an occluder that hides a fraction of the object.

The occluder moves on a sphere around the camera, from one side of the image towards the
object, and stops when it hides the requested fraction (3DB, Leclerc et al. 2021, arXiv
2106.03805, section 4):

    position = camera + distance * turned(line of sight, direction, angle)
    hidden(angle) = coverage

`angle` is found by bisection on rasterized silhouettes (`silhouettes`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.controls.occlusion import silhouettes
from advsearch.extend import (
    Choice,
    Control,
    InputError,
    Parameter,
    SceneDescription,
    Value,
    Values,
    assets,
    geometry,
    parts,
)

_moving = partial(Parameter.moving, Parameter.ORBIT)

PRIMITIVES = ("card", "sphere")
BUNDLED = ("book", "bottle", "vase", "chair", "banana", "hammer")
OPTIONS = (*PRIMITIVES, *BUNDLED)
EASE_IN_COVERAGE = 0.02
"""Below this coverage the occluder moves in from outside of the image, so that the image
changes without a jump.
"""
# smallest distance in object sizes between the camera and the occluder
MIN_CAMERA_DISTANCE = 0.05


@cache
def load_occluder(name: str) -> assets.ObjectAsset:
    """Return an object, its largest extent 1, centered on the origin.

    Args:
        name: name of a bundled object, or the path of a mesh file.

    Raises:
        InputError: there is no such object, or the file cannot be used.
    """
    asset = SceneDescription.load_object(name)
    mesh = assets.normalise_mesh(asset.mesh)
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2.0
    return replace(
        asset, mesh=replace(mesh, vertices=(mesh.vertices - middle).astype(np.float32))
    )


def _load_asset(option: str) -> assets.ObjectAsset:
    return make_primitive(option) if option in PRIMITIVES else load_occluder(option)


@cache
def make_primitive(name: str) -> assets.ObjectAsset:
    """Return the "card" or the "sphere", one object size large around the origin."""
    if name == "card":
        return _make_card()
    grey = np.full((4, 4, 3), 0.5, dtype=np.float32)
    return assets.ObjectAsset(
        name, parts.make_sphere(24, 48), grey, assets.Material(roughness=0.6)
    )


def _make_card() -> assets.ObjectAsset:
    """Return a square piece of cardboard in the plane x = 0."""
    generator = np.random.Generator(np.random.PCG64(7))
    grain = generator.normal(0.0, 0.012, (64, 64, 1)) * np.ones(3)
    texels = np.array([0.70, 0.53, 0.36]) + grain
    # Corrugations are visible through the paper as horizontal stripes, with a period of
    # four rows.
    row = np.arange(64)
    texels += 0.012 * np.sin(row * math.pi / 2.0)[:, None, None]
    uvs = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], dtype=np.float32)
    vertices = np.concatenate([np.zeros((4, 1)), uvs - 0.5], axis=1)
    normals = np.tile(np.array([1.0, 0.0, 0.0], dtype=np.float32), (4, 1))
    faces = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32)
    mesh = assets.Mesh(vertices.astype(np.float32), faces, normals, uvs)
    base_color = texels.clip(0.0, 1.0).astype(np.float32)
    return assets.ObjectAsset("card", mesh, base_color, assets.Material(roughness=0.9))


@dataclass(frozen=True, eq=False)
class Placement:
    """Position and size of an occluder, in the camera's coordinates.

    Lengths are in object sizes.

    Attributes:
        axes: (3, 3) rows right, up and forward of a camera that looks at the center of
            the visible part of the object.
        angle: angle from that center to the occluder, radians.
        size: size of the occluder; smaller than requested if it would not fit.
        distance: distance from the camera; not the requested one if it would not fit.
        hidden_fraction: fraction of the object's area in the image that is hidden.
        is_out_of_sight: whether the occluder is behind the camera, and hides nothing.
    """

    axes: assets.Float64Array
    angle: float
    size: float
    distance: float
    hidden_fraction: float
    is_out_of_sight: bool


class OcclusionControl(Control):
    """A second object between camera and object, which hides a fraction of the object."""

    kind = "occlusion"
    strength_parameter = "coverage"
    # They are only read: so the control is evaluated after those that move the camera or
    # the object.
    refines = frozenset(geometry.OCCLUDER_INPUTS)
    parameters = (
        Parameter.named(
            "which",
            OPTIONS,
            "card",
            "The occluder: a piece of cardboard, a grey sphere, or a bundled object.",
            estimators=("differences",),
            moves_silhouettes=True,
        ),
        _moving(
            "coverage",
            "1",
            0.0,
            0.9,
            0.0,
            "Fraction of the object's area in the picture that it hides; at 0 it is "
            "outside of the picture.",
            (0.0, 0.5),
        ),
        _moving(
            "direction",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Side of the picture from which it comes: 0 is the right, 90 the top, "
            "counter-clockwise.",
            (0.0, 360.0),
            periodic=True,
        ),
        _moving(
            "size",
            "object sizes",
            0.05,
            5.0,
            0.6,
            "Its largest extent.",
            (0.3, 1.0),
            log=True,
        ),
        _moving(
            "distance",
            "1",
            0.1,
            0.9,
            0.5,
            "Position between the camera (0) and the object's centre (1).",
            (0.3, 0.7),
        ),
        _moving(
            "turn",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Rotation of the occluder about its vertical axis.",
            periodic=True,
        ),
    )
    choices = (
        Choice(
            "object",
            None,
            "Another occluder instead of `which`: any bundled "
            "object, or the path of a mesh file.",
        ),
    )

    def check_choices(self) -> None:
        """Check the choice `object`, an occluder of the user's.

        Raises:
            InputError: it is no name or path, or `which` is set as well.
        """
        occluder = self.choice_values["object"]
        if occluder is None:
            return
        _check_is_name_or_path(f"{self.name}.object", occluder)
        if "which" in self._settings:
            raise InputError(
                f"{self.name}: object and which both state the "
                "occluder; leave one of them out"
            )
        self._settings["object"] = self.choice_values["object"] = str(occluder)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with a mesh for every occluder that may be chosen.

        They are placed out of sight; `scene_inputs` moves the one that is used.
        """
        camera_pose = torch.from_numpy(geometry.camera_to_world(scene))
        hidden_pose = geometry.make_hidden_pose(camera_pose).numpy()
        for option in self._list_options():
            scene = scene.with_part(self._make_occluder_part(option, hidden_pose))
        return scene

    def _make_occluder_part(
        self, option: str, pose: assets.Float64Array
    ) -> parts.MeshPart:
        """Return the mesh of an occluder, a part of the scene, at a pose (4, 4)."""
        asset = _load_asset(option)
        return parts.MeshPart(
            self._part_name(option),
            asset.mesh,
            asset.base_color,
            asset.material,
            asset.label,
            to_world=pose,
        )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the poses of all occluders; those that are not used are out of
        sight.
        """
        camera = geometry.get_camera_pose(self.scene, earlier_inputs).to(values["turn"])
        inputs = {
            f"{self._part_name(option)}.to_world": geometry.make_hidden_pose(camera)
            for option in self._list_options()
        }
        placement = self.find_placement(values, earlier_inputs)
        if not placement.is_out_of_sight:
            part = self._part_name(self._select_option(values))
            inputs[f"{part}.to_world"] = _compute_pose(camera, placement, values)
        return inputs

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return how much is hidden, and the true size and distance of the occluder."""
        placement = self.find_placement(values, earlier_inputs)
        measurements = {
            "hidden": Value(value=float(placement.hidden_fraction), unit="1")
        }
        if not placement.is_out_of_sight:
            lengths = {"true_size": placement.size, "true_distance": placement.distance}
            for name, length in lengths.items():
                measurements[name] = Value(value=float(length), unit="object sizes")
        return measurements

    def _list_options(self) -> tuple[str, ...]:
        """Return every occluder that can be chosen; each is a part of the scene."""
        if self.choice_values["object"] is not None:
            return (str(self.choice_values["object"]),)
        return tuple(map(str, self.list_allowed_values("which", PRIMITIVES[0])))

    def _select_option(self, values: Values) -> str:
        """Return the occluder of a configuration."""
        if self.choice_values["object"] is not None:
            return self._list_options()[0]
        return OPTIONS[int(values["which"])]

    def _part_name(self, option: str) -> str:
        """Return the name of an occluder's part of the scene.

        It is the name of the control, with the option if there are several.
        """
        return self.name if len(self._list_options()) == 1 else f"{self.name}-{option}"

    def find_placement(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> Placement:
        """Find the position of the occluder, without derivatives.

        It moves into the image from the side that "direction" states, until it hides
        the fraction "coverage" of the object. It is placed out of sight if the object
        is not in the image, or if the coverage is 0.

        1. The size and the distance are reduced until the occluder fits between camera
           and object.
        2. Its silhouette is rasterized, in front of a camera that looks at it.
        3. The angle between occluder and object is searched at which this silhouette
           covers the fraction of the directions in which the object is visible.

        Args:
            values: values of the control, by parameter.
            earlier_inputs: inputs of earlier controls, which may have moved camera and
                object.
        """
        requested = {name: float(value.detach()) for name, value in values.items()}
        view = _ObjectView.from_scene(self.scene, earlier_inputs)
        # "distance" is a fraction of the distance from the camera to the object
        requested["distance"] *= view.center_distance
        if view.directions is None or requested["coverage"] <= 0.0:
            return _make_hidden_placement(requested["size"], requested["distance"])
        mesh = _load_asset(self._select_option(values)).mesh
        return _find_occluder_placement(mesh, requested, view, view.directions)


def _find_occluder_placement(
    mesh: assets.Mesh,
    requested: Mapping[str, float],
    view: _ObjectView,
    directions: assets.Float64Array,
) -> Placement:
    """Return the placement at which an occluder hides a fraction of the object.

    It is out of sight if the occluder has no silhouette.

    Args:
        mesh: mesh of the occluder.
        requested: values of the control, by parameter; the distance is that from the
            camera, in object sizes.
        view: the object as the camera sees it.
        directions: (N, 3) directions in which the object is visible.
    """
    points = _turn_vertices(mesh, requested["turn"])
    size, distance = _fit_occluder(
        points, requested["size"], requested["distance"], view.nearest_distance
    )
    placement = _make_hidden_placement(size, distance)
    points_facing_camera = _to_facing_camera(points, size, distance)
    silhouette = silhouettes.rasterise_silhouette(points_facing_camera, mesh.faces)
    if silhouette is None:
        return placement
    passage = _make_passage(directions, silhouette, requested["direction"])
    angle = _find_covering_angle(view, passage, requested["coverage"])
    return _move_into_view(placement, passage, angle)


def _turn_vertices(mesh: assets.Mesh, degrees: float) -> assets.Float64Array:
    """Return the vertices (V, 3) of an occluder after a turn about its vertical axis.

    They are centered on the origin, and their largest extent is 1.
    """
    turn = geometry.make_rotation(degrees, 0.0, 0.0)
    turned: assets.Float64Array = mesh.vertices.astype(np.float64) @ turn.T
    return turned


def _make_passage(
    directions: assets.Float64Array,
    silhouette: silhouettes.Silhouette,
    direction: float,
) -> silhouettes.Passage:
    """Return the passage of an occluder past the object.

    Args:
        directions: (N, 3) directions in which the object is visible.
        silhouette: silhouette of the occluder, straight ahead of a camera.
        direction: side that it comes from, degrees.
    """
    return silhouettes.Passage(
        target_directions=directions,
        occluder_silhouette=silhouette,
        axes=silhouettes.compute_center_axes(directions),
        direction=direction,
    )


def _move_into_view(
    placement: Placement, passage: silhouettes.Passage, angle: float
) -> Placement:
    """Return the placement of an occluder at an angle, radians, on its passage."""
    # less than requested if the occluder is too small
    hidden_fraction = float(passage.compute_coverage(np.array([angle]))[0])
    return replace(
        placement,
        axes=passage.axes,
        angle=angle,
        hidden_fraction=hidden_fraction,
        is_out_of_sight=False,
    )


def _check_is_name_or_path(label: str, occluder: object) -> None:
    """Raise InputError if an occluder is no name of an object and no path."""
    if not isinstance(occluder, (str, Path)) or not str(occluder).strip():
        raise InputError(
            f"{label}: expected the name of a bundled object or a path "
            f"to a mesh file, got {occluder!r}"
        )


# ---- the view of the camera


def _find_covering_angle(
    view: _ObjectView, passage: silhouettes.Passage, coverage: float
) -> float:
    """Find the angle, in radians, at which an occluder hides a fraction of the object.

    The angle is that between the occluder's and the object's centers, seen from the
    camera. Below `EASE_IN_COVERAGE` it is interpolated linearly: from the angle at which
    the occluder is just outside of the image, for a coverage of 0, to the angle for
    `EASE_IN_COVERAGE`. So the occluder does not jump into the image at a tiny coverage.

    Args:
        view: the object as the camera sees it.
        passage: the occluder, the object and the direction of movement.
        coverage: fraction of the visible object that should be hidden, over 0.
    """
    angle_outside = silhouettes.find_angle_outside(
        view.directions_of_image,
        view.rim,
        passage.occluder_silhouette,
        passage.axes,
        passage.direction,
    )
    if coverage >= EASE_IN_COVERAGE:
        return passage.find_angle(coverage, angle_outside)
    end_of_ease_in = passage.find_angle(EASE_IN_COVERAGE, angle_outside)
    angle_inside = end_of_ease_in - angle_outside
    return angle_outside + angle_inside * coverage / EASE_IN_COVERAGE


def _make_hidden_placement(size: float, distance: float) -> Placement:
    """Return the placement of an occluder that is out of sight."""
    return Placement(
        np.eye(3),
        angle=0.0,
        size=size,
        distance=distance,
        hidden_fraction=0.0,
        is_out_of_sight=True,
    )


@dataclass(frozen=True, eq=False)
class _ObjectView:
    """The object as the camera sees it.

    Directions are unit vectors in camera coordinates: right, up and forward.
    """

    # (N, 3) directions in which the object is visible, each for the same area of the
    # image; None if it is not in the image
    directions: assets.Float64Array | None
    # (M, 3) directions spread over the full image, to test if an occluder is outside
    directions_of_image: assets.Float64Array
    # (K, 3) directions at the edge of the image, which give its largest angle
    rim: assets.Float64Array
    nearest_distance: float  # distance of the object's nearest vertex from the camera
    center_distance: float  # distance of the center of its bounding box

    @staticmethod
    def from_scene(
        scene: SceneDescription, earlier_inputs: Mapping[str, Tensor]
    ) -> _ObjectView:
        """Compute how the camera sees a scene's object, without derivatives.

        Args:
            scene: the scene.
            earlier_inputs: inputs of earlier controls, which may have moved camera and
                object, or changed the lens.
        """
        points = _object_in_camera(scene, earlier_inputs)
        if scene.camera_model is not None:
            return _view_through_lens(scene, scene.camera_model, points, earlier_inputs)
        frame = _image_frame(scene, earlier_inputs)
        silhouette = silhouettes.rasterise_silhouette(
            points, scene.object.mesh.faces, frame
        )
        return _make_object_view(
            points,
            directions=None if silhouette is None else silhouette.list_directions(),
            directions_of_image=silhouettes.spread_directions(frame),
            rim=frame.corners(),
        )


def _view_through_lens(
    scene: SceneDescription,
    model: geometry.CameraModel,
    points: assets.Float64Array,
    earlier_inputs: Mapping[str, Tensor],
) -> _ObjectView:
    """Compute how a camera with a lens model sees a scene's object.

    Args:
        scene: the scene.
        model: its camera model.
        points: (V, 3) vertices of the object in camera coordinates.
        earlier_inputs: inputs of earlier controls, which may have changed the lens.
    """
    if "camera.lens" in earlier_inputs:
        model = model.with_intrinsics(earlier_inputs["camera.lens"].detach().cpu())
    directions_of_image = _spread_directions(
        model, across=(0.0, 1.0), down=(0.0, 1.0), count=silhouettes.DIRECTION_GRID
    )
    return _make_object_view(
        points,
        directions=_directions_through_lens(model, points, scene.object.mesh.faces),
        directions_of_image=directions_of_image,
        # `rim` may have further directions than those at the edge. For a distorted
        # image it has all, as the edge is not computed.
        rim=directions_of_image,
    )


def _make_object_view(
    points: assets.Float64Array,
    directions: assets.Float64Array | None,
    directions_of_image: assets.Float64Array,
    rim: assets.Float64Array,
) -> _ObjectView:
    """Return the view of an object by its vertices (V, 3) in camera coordinates.

    The other arguments are fields of `_ObjectView`.
    """
    center = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return _ObjectView(
        directions=directions,
        directions_of_image=directions_of_image,
        rim=rim,
        nearest_distance=float(np.linalg.norm(points, axis=1).min()),
        center_distance=float(np.linalg.norm(center)),
    )


def _object_in_camera(
    scene: SceneDescription, earlier_inputs: Mapping[str, Tensor]
) -> assets.Float64Array:
    """Return the object's vertices (V, 3) in camera coordinates: right, up, forward.

    Args:
        scene: the scene.
        earlier_inputs: inputs of earlier controls: the poses of camera and object, and
            offsets (V, 3) of the vertices. Those of the scene replace missing ones.
    """
    camera_pose = geometry.get_camera_pose(scene, earlier_inputs)
    camera = camera_pose.detach().double().cpu().numpy()
    object_pose = geometry.compute_object_to_world(scene)
    pose = _get_array(earlier_inputs, "object.to_world", object_pose)
    offsets = _get_array(earlier_inputs, "object.offsets", np.zeros(3))
    vertices = scene.object.mesh.vertices.astype(np.float64) + offsets
    in_world = vertices @ pose[:3, :3].T + pose[:3, 3]
    # The columns of a camera's rotation are its axes: left, up and forward.
    left_up_forward = (in_world - camera[:3, 3]) @ camera[:3, :3]
    return np.asarray(left_up_forward * (-1.0, 1.0, 1.0))


def _image_frame(
    scene: SceneDescription, earlier_inputs: Mapping[str, Tensor]
) -> geometry.Frame:
    """Return the bounds of the image of a camera without distortion."""
    scene_fov = np.array([scene.get_number("camera.fov")])
    fov = float(_get_array(earlier_inputs, "camera.fov", scene_fov)[0])
    shift = _get_array(earlier_inputs, "camera.shift", np.zeros(2))
    return geometry.Frame.from_fov(
        fov, scene.aspect, (float(shift[0]), float(shift[1]))
    )


def _directions_through_lens(
    model: geometry.CameraModel,
    points: assets.Float64Array,
    faces: npt.NDArray[np.uint32],
) -> assets.Float64Array | None:
    """Return the directions in which a mesh is seen through a lens.

    Directions through the lens are spread evenly over the image, and those in which the
    mesh is seen are returned. A pinhole camera decides that: it looks at the center of
    the mesh, whose silhouette is rasterized for it.

    Args:
        model: model of the camera.
        points: (V, 3) vertices in camera coordinates.
        faces: (F, 3) vertex indices of the mesh.

    Returns:
        Unit directions (N, 3), each for the same area of the image; None if the mesh is
        not in the image.
    """
    vertex_directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    # rows right, up and forward of the pinhole camera
    pinhole_axes = silhouettes.compute_center_axes(vertex_directions)
    silhouette = silhouettes.rasterise_silhouette(points @ pinhole_axes.T, faces)
    if silhouette is None:
        return None
    across, down = _find_image_box(model, points)
    directions = _spread_directions(model, across, down, count=silhouettes.RASTER)
    right, up, forward = (directions @ pinhole_axes.T).T
    directions_on_mesh = directions[silhouette.contains(right, up, forward)]
    return directions_on_mesh if len(directions_on_mesh) else None


def _find_image_box(
    model: geometry.CameraModel, points: assets.Float64Array
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the part of the image that contains a mesh, as seen through a lens.

    Args:
        model: model of the camera.
        points: (V, 3) vertices in camera coordinates.

    Returns:
        Left and right bound as fractions of the width, and upper and lower bound as
        fractions of the height. They are those of the full image if the lens does not
        see all vertices.
    """
    y_downwards = points * (1.0, -1.0, 1.0)  # as a camera model has it
    positions, is_visible = model.project(torch.from_numpy(y_downwards))
    if not bool(is_visible.all()):
        return (0.0, 1.0), (0.0, 1.0)
    left, top = positions.amin(dim=0).clamp(0.0, 1.0).tolist()
    right, bottom = positions.amax(dim=0).clamp(0.0, 1.0).tolist()
    return (left, right), (top, bottom)


def _spread_directions(
    model: geometry.CameraModel,
    across: tuple[float, float],
    down: tuple[float, float],
    count: int,
) -> assets.Float64Array:
    """Return unit directions (N, 3) in which a lens sees a part of the image.

    There is one in each cell of a grid, at a position from a low-discrepancy sequence.
    Cells that the lens does not see, such as the corners of a fisheye, are left out.

    Args:
        model: model of the camera.
        across: left and right bound of the part, as fractions of the width.
        down: upper and lower bound of the part, as fractions of the height.
        count: number of rows, and of columns, of the grid.
    """
    x_fraction, y_fraction = _spread_over_cells(count)
    x = across[0] + x_fraction * (across[1] - across[0])
    y = down[0] + y_fraction * (down[1] - down[0])
    directions, inside = model.compute_rays(torch.from_numpy(np.stack([x, y], axis=1)))
    # from y downwards to y upwards
    visible = directions[inside > 0.0].numpy() * (1.0, -1.0, 1.0)
    return np.asarray(visible / np.linalg.norm(visible, axis=1, keepdims=True))


def _spread_over_cells(count: int) -> tuple[assets.Float64Array, assets.Float64Array]:
    """Return x and y (count * count,), from 0 to 1, of a point in each cell of a grid.

    Positions in the cells are from a low-discrepancy sequence (Roberts 2018): multiples
    of 1 / g and 1 / g^2 modulo 1, where g is the plastic number.
    """
    index = np.arange(count * count)
    row, column = np.divmod(index, count)
    x_in_cells = column + (0.5 + 0.7548777 * index) % 1.0
    y_in_cells = row + (0.5 + 0.5698403 * index) % 1.0
    return x_in_cells / count, y_in_cells / count


def _get_array(
    inputs: Mapping[str, Tensor], name: str, default: assets.Float64Array
) -> assets.Float64Array:
    """Return a scene input as a NumPy array, or the default if it is missing."""
    return inputs[name].detach().double().cpu().numpy() if name in inputs else default


# ---- the position of the occluder


def _fit_occluder(
    points: assets.Float64Array, size: float, distance: float, nearest_distance: float
) -> tuple[float, float]:
    """Fit an occluder between the camera and the object.

    It keeps `MIN_CAMERA_DISTANCE` from the camera, and none of its vertices is farther
    from the camera than the object's nearest vertex. It is made smaller until it fits.
    Here it is replaced by a cylinder around it, whose axis points to the camera.

    Args:
        points: (V, 3) vertices of the occluder, centered on the origin, largest extent
            1; x points to the camera.
        size: requested size.
        distance: requested distance from the camera.
        nearest_distance: distance of the object's nearest vertex from the camera.

    Returns:
        Its size, and its distance from the camera.
    """
    # of the cylinder at size 1: from its center to its front and back, and its radius
    to_front = float(points[:, 0].max())
    to_back = float(-points[:, 0].min())
    radius = float(np.hypot(points[:, 1], points[:, 2]).max())
    # Largest distance of a vertex from the camera. An object very close to the camera
    # leaves no room for any occluder, which may then be farther than its nearest vertex.
    limit = max(nearest_distance, 3.0 * MIN_CAMERA_DISTANCE)
    max_steps = 200  # 0.95 to the 200th is 1 / 28,000: by then any occluder fits
    for _ in range(max_steps):
        min_distance = MIN_CAMERA_DISTANCE + size * to_front
        max_distance = _find_max_distance(limit, size * radius, size * to_back)
        if max_distance >= min_distance:
            break
        size *= 0.95
    return size, min(max(distance, min_distance), max_distance)


def _find_max_distance(limit: float, radius: float, to_back: float) -> float:
    """Return the largest distance of a cylinder from the camera, 0 if it does not fit.

    Args:
        limit: largest distance of any of its points from the camera.
        radius: radius of the cylinder, whose axis points to the camera.
        to_back: distance from its center to its back.
    """
    # Pythagoras: the edge of the cylinder's back is `limit` away from the camera.
    squared_back_distance = limit * limit - radius**2
    if squared_back_distance > 0.0:
        return math.sqrt(squared_back_distance) - to_back
    return 0.0


def _to_facing_camera(
    points: assets.Float64Array, size: float, distance: float
) -> assets.Float64Array:
    """Return an occluder's points in the axes of a camera that looks at its center.

    Args:
        points: (N, 3) points of the occluder, whose x axis points to the camera.
        size: factor of the points.
        distance: distance of the camera from the occluder's center.

    Returns:
        (N, 3), right, up and forward.
    """
    right = points[:, 1] * size
    up = points[:, 2] * size
    forward = distance - points[:, 0] * size
    return np.stack([right, up, forward], axis=1)


def _rotate_pair(first: Tensor, second: Tensor, angle: float) -> tuple[Tensor, Tensor]:
    """Rotate two perpendicular vectors in their plane, the first towards the second."""
    sine = math.sin(angle)
    cosine = math.cos(angle)
    return cosine * first + sine * second, cosine * second - sine * first


def _compute_pose(camera: Tensor, placement: Placement, values: Values) -> Tensor:
    """Return the occluder's pose (4, 4).

    It is differentiable in the camera's pose, the direction and the turn, but not in
    the placement, which depends on all values. So gradients of this control are
    estimated by finite differences.

    Args:
        camera: (4, 4) pose of the camera.
        placement: position and size of the occluder.
        values: values of the control, with "direction" and "turn" in degrees.
    """
    axes = torch.from_numpy(placement.axes).to(camera)
    direction = torch.deg2rad(values["direction"])
    right, up, to_occluder = _turn_axes(axes, direction, placement.angle)
    # Axes of the occluder. Without a turn, its front (x) faces the camera, and y is to the
    # right. A turn rotates x towards y.
    turn = torch.deg2rad(values["turn"])
    x = -torch.cos(turn) * to_occluder + torch.sin(turn) * right
    y = torch.sin(turn) * to_occluder + torch.cos(turn) * right
    # Directions have components to the right, up and forward, but the first column of a
    # camera's pose is its left.
    to_world = camera[:3, :3] * torch.tensor([-1.0, 1.0, 1.0]).to(camera)
    linear = placement.size * to_world @ torch.stack([x, y, up], dim=1)
    center = camera[:3, 3] + placement.distance * (to_world @ to_occluder)
    return geometry.make_affine(linear, center)


def _turn_axes(
    axes: Tensor, direction: Tensor, angle: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Turn a camera that looks at the object until it looks at the occluder.

    Args:
        axes: (3, 3) rows right, up and forward of the camera.
        direction: () where in the image the camera turns to, radians: 0 is to the right,
            pi / 2 up.
        angle: how far it turns, radians.

    Returns:
        Right, up and forward (3,) of the turned camera.
    """
    right, up, forward = axes
    # Axes in the image: towards the occluder, and at a right angle to that. The camera
    # turns about the latter, so that only the other two axes change.
    outwards = torch.cos(direction) * right + torch.sin(direction) * up
    sideways = -torch.sin(direction) * right + torch.cos(direction) * up
    # `forward` is rotated towards `outwards`
    turned_forward, turned_outwards = _rotate_pair(forward, outwards, angle)
    # back from the axes in the image to right and up
    turned_right = (
        torch.cos(direction) * turned_outwards - torch.sin(direction) * sideways
    )
    turned_up = torch.sin(direction) * turned_outwards + torch.cos(direction) * sideways
    return turned_right, turned_up, turned_forward
