"""The `occlusion` control: a second object between the camera and the object, hiding a
wanted share of it.

The occluder comes in from one side of the picture, on a sphere around the camera, and
stops where it hides as much as was asked for (3DB, Leclerc et al. 2021, arXiv
2106.03805, section 4):

    place = camera + distance * turned(line of sight, direction, angle),    hidden(angle) = coverage

`angle` is found by bisection on rasterised silhouettes (`silhouettes`).
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
"""Below this coverage the occluder slides in from outside the frame, so that the
picture changes without a jump.
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
    # the flutes under the paper
    texels += 0.012 * np.sin(np.arange(64) * math.pi / 2.0)[:, None, None]
    uvs = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], dtype=np.float32)
    vertices = np.concatenate([np.zeros((4, 1)), uvs - 0.5], axis=1)
    normals = np.tile(np.array([1.0, 0.0, 0.0], dtype=np.float32), (4, 1))
    faces = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32)
    mesh = assets.Mesh(vertices.astype(np.float32), faces, normals, uvs)
    base_color = texels.clip(0.0, 1.0).astype(np.float32)
    return assets.ObjectAsset("card", mesh, base_color, assets.Material(roughness=0.9))


@dataclass(frozen=True, eq=False)
class Placement:
    """Where an occluder goes, in the camera's coordinates.

    Lengths are in object sizes.

    Attributes:
        axes: (3, 3) rows right, up and forward of a camera that looks at the center of
            what is visible of the object.
        angle: angle from that center to the occluder, radians.
        size: size of the occluder, made smaller if it would not fit.
        distance: distance from the camera, changed if it would not fit.
        hidden: fraction of the object's area in the image.
        is_out_of_sight: whether the occluder is put away.
    """

    axes: assets.Float64Array
    angle: float
    size: float
    distance: float
    hidden: float
    is_out_of_sight: bool


class OcclusionControl(Control):
    """A second object between the camera and the object, hiding a fraction of it."""

    kind = "occlusion"
    strength_parameter = "coverage"
    # none is changed; but it comes after whatever moves the camera or the object
    refines = frozenset(geometry.OCCLUDER_INPUTS)
    parameters = (
        Parameter.named(
            "which",
            OPTIONS,
            "card",
            "What it is: a piece of cardboard, a grey sphere, or a bundled object.",
            estimators=("differences",),
            moves_silhouettes=True,
        ),
        _moving(
            "coverage",
            "1",
            0.0,
            0.9,
            0.0,
            "Share of the object's picture area that it hides; at 0 it is out of "
            "the frame.",
            (0.0, 0.5),
        ),
        _moving(
            "direction",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Side of the picture it comes in from: 0 is the right, 90 the top, "
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
            "Where between the camera and the object's middle: 0 is the camera, 1 "
            "the middle.",
            (0.3, 0.7),
        ),
        _moving(
            "turn",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Rotation of the occluder about its own upright axis.",
            periodic=True,
        ),
    )
    choices = (
        Choice(
            "object",
            None,
            "Another occluder in place of `which`: any bundled "
            "object, or a path to a mesh file.",
        ),
    )

    def check_choices(self) -> None:
        """Check the choice `object`, an occluder of the user's.

        Raises:
            InputError: it is no name or path, or `which` is set as well.
        """
        occluder = self.chosen["object"]
        if occluder is None:
            return
        if not isinstance(occluder, (str, Path)) or not str(occluder).strip():
            raise InputError(
                f"{self.name}.object: expected the name of a bundled object or a path "
                f"to a mesh file, got {occluder!r}"
            )
        if "which" in self._settings:
            raise InputError(
                f"{self.name}: object and which both say what the "
                "occluder is; leave one of them out"
            )
        self._settings["object"] = self.chosen["object"] = str(occluder)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with a mesh for every occluder that may be chosen.

        They are placed out of sight; `scene_inputs` moves the one that is used.
        """
        hidden_pose = geometry.make_hidden_pose(
            torch.from_numpy(geometry.camera_to_world(scene))
        ).numpy()
        for option in self._list_options():
            asset = _load_asset(option)
            appearance = asset.base_color, asset.material, asset.label
            scene = scene.with_part(
                parts.MeshPart(
                    self._part_name(option),
                    asset.mesh,
                    *appearance,
                    to_world=hidden_pose,
                )
            )
        return scene

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
        measurements = {"hidden": Value(value=float(placement.hidden), unit="1")}
        if not placement.is_out_of_sight:
            lengths = {"true_size": placement.size, "true_distance": placement.distance}
            for name, length in lengths.items():
                measurements[name] = Value(value=float(length), unit="object sizes")
        return measurements

    def _list_options(self) -> tuple[str, ...]:
        """Return every occluder that can be chosen; each is a part of the scene."""
        if self.chosen["object"] is not None:
            return (str(self.chosen["object"]),)
        return tuple(map(str, self.list_allowed_values("which", PRIMITIVES[0])))

    def _select_option(self, values: Values) -> str:
        """Return the occluder of a configuration."""
        if self.chosen["object"] is not None:
            return self._list_options()[0]
        return OPTIONS[int(values["which"])]

    def _part_name(self, option: str) -> str:
        """Return the name of an occluder's part of the scene.

        The instance's name, with the option where there are several.
        """
        return self.name if len(self._list_options()) == 1 else f"{self.name}-{option}"

    def find_placement(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> Placement:
        """Find where the occluder goes, without derivatives.

        It moves into the image from the side that "direction" states, until it hides
        the fraction "coverage" of the object. It is placed out of sight if the object
        is not in the image, or nothing is to be hidden.

        Args:
            values: values of the control, by parameter.
            earlier_inputs: inputs of earlier controls, which may have moved camera and
                object.
        """
        requested = {name: float(value.detach()) for name, value in values.items()}
        view = _ObjectView.from_scene(self.scene, earlier_inputs)
        # "distance" is a fraction of the distance from the camera to the object
        requested_distance = requested["distance"] * view.center_distance
        if view.directions is None or requested["coverage"] <= 0.0:
            return _make_hidden_placement(requested["size"], requested_distance)
        mesh = _load_asset(self._select_option(values)).mesh
        turn = geometry.make_rotation(requested["turn"], 0.0, 0.0)
        # vertices of the turned occluder, centered on the origin, largest extent 1
        points = mesh.vertices.astype(np.float64) @ turn.T
        size, distance = _fit_occluder(
            points, requested["size"], requested_distance, view.nearest_distance
        )
        cover = silhouettes.rasterise_silhouette(
            _to_facing_camera(points, size, distance), mesh.faces
        )
        if cover is None:
            return _make_hidden_placement(size, distance)
        passage = silhouettes.Passage(
            view.directions,
            cover,
            silhouettes.compute_center_axes(view.directions),
            requested["direction"],
        )
        angle = _find_covering_angle(view, passage, requested["coverage"])
        # what it hides there, which may be less than requested
        hidden = float(passage.compute_coverage(np.array([angle]))[0])
        return Placement(
            passage.axes, angle, size, distance, hidden, is_out_of_sight=False
        )


# ---- what the camera sees


def _find_covering_angle(
    view: _ObjectView, passage: silhouettes.Passage, coverage: float
) -> float:
    """Find the angle, in radians, at which an occluder hides a fraction of the object.

    The angle is that between the occluder's and the object's centers, seen from the
    camera. For fractions below `EASE_IN_COVERAGE` it is interpolated from the angle
    outside of the image, so that the occluder does not jump in at a tiny fraction.

    Args:
        view: the object as the camera sees it.
        passage: the occluder and the line on which it moves.
        coverage: fraction of the visible object that should be hidden, over 0.
    """
    outside = silhouettes.find_angle_outside(
        view.directions_of_image,
        view.rim,
        passage.cover,
        passage.axes,
        passage.direction,
    )
    angle = passage.find_angle(max(coverage, EASE_IN_COVERAGE), outside)
    if coverage < EASE_IN_COVERAGE:
        angle = outside + (angle - outside) * coverage / EASE_IN_COVERAGE
    return angle


def _make_hidden_placement(size: float, distance: float) -> Placement:
    """Return the placement of an occluder that is out of sight."""
    return Placement(
        np.eye(3),
        angle=0.0,
        size=size,
        distance=distance,
        hidden=0.0,
        is_out_of_sight=True,
    )


@dataclass(frozen=True, eq=False)
class _ObjectView:
    """The object as the camera sees it."""

    # (N, 3) in which it is visible, each for the same area; None if it is not in the
    # image
    directions: assets.Float64Array | None
    # (M, 3) directions spread over the full image
    directions_of_image: assets.Float64Array
    rim: assets.Float64Array  # (K, 3) those at its edge
    nearest_distance: float  # distance of its nearest vertex from the camera
    center_distance: float  # distance of the middle of its bounding box

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
        faces = scene.object.mesh.faces
        model = scene.camera_model
        if model is not None:
            if "camera.lens" in earlier_inputs:
                model = model.with_numbers(earlier_inputs["camera.lens"].detach().cpu())
            directions_of_image = _spread_directions(
                model, (0.0, 1.0), (0.0, 1.0), silhouettes.DIRECTION_GRID
            )
            # The edge of a distorted image is not computed: all directions are used.
            rim = directions_of_image
            directions = _directions_through_lens(model, points, faces)
        else:
            frame = _image_frame(scene, earlier_inputs)
            silhouette = silhouettes.rasterise_silhouette(points, faces, frame)
            directions_of_image = silhouettes.spread_directions(frame)
            rim = frame.corners()
            directions = None if silhouette is None else silhouette.list_directions()
        middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        near = float(np.linalg.norm(points, axis=1).min())
        far = float(np.linalg.norm(middle))
        return _ObjectView(directions, directions_of_image, rim, near, far)


def _object_in_camera(
    scene: SceneDescription, earlier_inputs: Mapping[str, Tensor]
) -> assets.Float64Array:
    """Return the object's vertices (V, 3) in camera coordinates: right, up, forward.

    Args:
        scene: the scene.
        earlier_inputs: inputs of earlier controls: the poses of camera and object, and
            offsets (V, 3) of the vertices. What is missing is as in the scene.
    """
    camera = (
        geometry.get_camera_pose(scene, earlier_inputs).detach().double().cpu().numpy()
    )
    pose = _input_or(earlier_inputs, "object.to_world", geometry.object_to_world(scene))
    offsets = _input_or(earlier_inputs, "object.offsets", np.zeros(3))
    vertices = scene.object.mesh.vertices.astype(np.float64) + offsets
    world = vertices @ pose[:3, :3].T + pose[:3, 3]
    # a sensor's own x axis points to the left
    in_camera = (world - camera[:3, 3]) @ camera[:3, :3] * (-1.0, 1.0, 1.0)
    return np.asarray(in_camera)


def _image_frame(
    scene: SceneDescription, earlier_inputs: Mapping[str, Tensor]
) -> geometry.Frame:
    """Return what the image of a camera without distortion shows."""
    scene_fov = np.array([scene.get_number("camera.fov")])
    fov = float(_input_or(earlier_inputs, "camera.fov", scene_fov)[0])
    shift = _input_or(earlier_inputs, "camera.shift", np.zeros(2))
    return geometry.Frame.from_fov(
        fov, scene.aspect, (float(shift[0]), float(shift[1]))
    )


def _directions_through_lens(
    model: geometry.CameraModel,
    points: assets.Float64Array,
    faces: npt.NDArray[np.uint32],
) -> assets.Float64Array | None:
    """Return the directions in which a mesh is seen through a lens.

    Args:
        model: model of the camera.
        points: (V, 3) vertices in camera coordinates.
        faces: (F, 3) vertex indices of the mesh.

    Returns:
        Unit directions (N, 3), each for the same area of the image; None if the mesh is
        not in the image.
    """
    # A pinhole camera that looks at the mesh gives its silhouette. Directions through
    # the lens that hit the silhouette are those in which the mesh is seen.
    vertex_directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    axes = silhouettes.compute_center_axes(vertex_directions)
    cover = silhouettes.rasterise_silhouette(points @ axes.T, faces)
    if cover is None:
        return None
    # a camera model has y downwards
    positions, is_visible = model.project(torch.from_numpy(points * (1.0, -1.0, 1.0)))
    # the part of the image to look at: the box of the vertices, if all are visible
    columns = (0.0, 1.0)
    rows = (0.0, 1.0)
    if bool(is_visible.all()):
        left, top = positions.amin(dim=0).clamp(0.0, 1.0).tolist()
        right, bottom = positions.amax(dim=0).clamp(0.0, 1.0).tolist()
        columns = (left, right)
        rows = (top, bottom)
    directions = _spread_directions(model, columns, rows, silhouettes.RASTER)
    directions_on_mesh = directions[cover.contains(*(directions @ axes.T).T)]
    return directions_on_mesh if len(directions_on_mesh) else None


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
    row, column = np.divmod(np.arange(count * count), count)
    index = np.arange(count * count)
    # 1 / g and 1 / g^2 of the plastic number g (Roberts 2018)
    x_in_cells = column + (0.5 + 0.7548777 * index) % 1.0
    y_in_cells = row + (0.5 + 0.5698403 * index) % 1.0
    x = across[0] + x_in_cells / count * (across[1] - across[0])
    y = down[0] + y_in_cells / count * (down[1] - down[0])
    directions, inside = model.compute_rays(torch.from_numpy(np.stack([x, y], axis=1)))
    # from y downwards to y upwards
    visible = directions[inside > 0.0].numpy() * (1.0, -1.0, 1.0)
    return np.asarray(visible / np.linalg.norm(visible, axis=1, keepdims=True))


def _input_or(
    inputs: Mapping[str, Tensor], name: str, otherwise: assets.Float64Array
) -> assets.Float64Array:
    return inputs[name].detach().double().cpu().numpy() if name in inputs else otherwise


# ---- where the occluder goes


def _fit_occluder(
    points: assets.Float64Array, size: float, distance: float, near: float
) -> tuple[float, float]:
    """Fit an occluder between the camera and the object.

    It keeps `MIN_CAMERA_DISTANCE` from the camera, and none of its vertices is farther
    from the camera than the object's nearest one. It is made smaller until it fits.

    Args:
        points: (V, 3) vertices of the occluder, centered on the origin, largest extent
            1; x points to the camera.
        size: requested size.
        distance: requested distance from the camera.
        near: distance of the object's nearest vertex from the camera.

    Returns:
        Its size, and its distance from the camera.
    """
    front = float(points[:, 0].max())
    back = float(-points[:, 0].min())
    half_width = float(np.hypot(points[:, 1], points[:, 2]).max())
    # An object very close to the camera would leave no room for any occluder.
    near = max(near, 3.0 * MIN_CAMERA_DISTANCE)
    # 0.95 to the 200th is 1 / 28,000: by then anything fits
    for _ in range(200):
        min_distance = MIN_CAMERA_DISTANCE + size * front
        # The back corners lie on a sphere of radius `near` around the camera.
        squared_back_distance = near * near - (size * half_width) ** 2
        max_distance = 0.0
        if squared_back_distance > 0.0:
            max_distance = math.sqrt(squared_back_distance) - size * back
        if max_distance >= min_distance:
            break
        # not enough room: try a smaller one
        size *= 0.95
    return size, min(max(distance, min_distance), max_distance)


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
    what the placement was found from. So gradients of this control are estimated by
    finite differences.

    Args:
        camera: (4, 4) pose of the camera.
        placement: where the occluder goes.
        values: values of the control, with "direction" and "turn" in degrees.
    """
    right, up, forward = torch.from_numpy(placement.axes).to(camera)
    direction = torch.deg2rad(values["direction"])
    # in the image: towards the occluder, and at a right angle to that
    outwards = torch.cos(direction) * right + torch.sin(direction) * up
    sideways = -torch.sin(direction) * right + torch.cos(direction) * up
    to_occluder, outwards = _rotate_pair(forward, outwards, placement.angle)
    # right and up as seen by a camera that looks at the occluder
    right = torch.cos(direction) * outwards - torch.sin(direction) * sideways
    up = torch.sin(direction) * outwards + torch.cos(direction) * sideways
    # axes of the occluder, whose front (x) is towards the camera before it is turned
    turn = torch.deg2rad(values["turn"])
    x = -torch.cos(turn) * to_occluder + torch.sin(turn) * right
    y = torch.sin(turn) * to_occluder + torch.cos(turn) * right
    # a sensor's own x axis points to the left
    to_world = camera[:3, :3] * torch.tensor([-1.0, 1.0, 1.0]).to(camera)
    linear = placement.size * to_world @ torch.stack([x, y, up], dim=1)
    center = camera[:3, 3] + placement.distance * (to_world @ to_occluder)
    return geometry.make_affine(linear, center)
