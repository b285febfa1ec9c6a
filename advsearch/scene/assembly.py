"""Assemble Mitsuba's inputs from those of controls, and measure motion in the image.

Controls set an object's pose (`NAME.to_world`) and shape (`NAME.offsets`) separately,
so that they compose; Mitsuba takes world-space vertices and normals, and padded maps of
the environment. Everything here is torch, so gradients of vertices reach both.

`Motion` measures how fast each coordinate of u moves points in the image, so that
differences have a width that fits. A smooth loss is best differenced over about one
pixel of motion of the fastest outline, never over a fixed length in the world
(docs/gradients.md, "The estimators"): narrower and noise wins, wider and the loss
bends. For a classifier's loss see `gradients.SEARCH_STEP`. The renders of a difference
share their random numbers, and have no graph.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assets import Float32Array, IntArray, Material, Mesh, Shape
from advsearch.scene.backdrop import make_image_inputs
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.geometry import (
    camera_to_world,
    compute_car_pose,
    compute_carried_pose,
    project_points,
)
from advsearch.scene.gradients import Group
from advsearch.scene.parts import (
    CAMERA,
    PHOTOGRAPH_INPUT,
    BeamLamp,
    LampGlass,
    MeshPart,
)

PLANE_INPUT = "backdrop.plane"
# inputs that the renderer applies to radiance
IMAGE_INPUTS = frozenset(
    {
        "backdrop.blur",
        "backdrop.color",
        "backdrop.depth",
        "backdrop.front",
        "backdrop.noise",
        "backdrop.plane",
        "camera.exposure",
    }
)


class MovingMesh:
    """A mesh whose vertices and normals follow a pose (4, 4) and a displacement."""

    def __init__(self, mesh: Mesh, to_world: np.ndarray) -> None:
        self._mesh = mesh
        self.vertices = torch.from_numpy(mesh.vertices.astype(np.float32))
        self.normals = torch.from_numpy(mesh.normals.astype(np.float32))
        self.to_world = torch.from_numpy(to_world.astype(np.float32))

    def transform_mesh(
        self, to_world: Tensor | None, offsets: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return world-space vertices and unit normals, both (V, 3).

        Args:
            to_world: invertible affine map (4, 4); None for the mesh's base pose.
            offsets: displacement (V, 3) of the vertices in mesh coordinates; None for
                none.
        """
        moving = to_world if to_world is not None else offsets
        device = self.vertices.device if moving is None else moving.device
        matrix = self.to_world.to(device) if to_world is None else to_world
        vertices = self.vertices.to(device)
        normals = self.normals.to(device)
        if offsets is not None:
            vertices, normals = self._displace(vertices, normals, offsets)
        world_vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        # Normals are transformed by the inverse transpose, here as rows: n M^-1.
        world_normals = normals @ torch.linalg.inv(matrix[:3, :3])
        lengths = world_normals.norm(dim=1, keepdim=True).clamp_min(1e-12)
        return world_vertices, world_normals / lengths

    def _displace(
        self, vertices: Tensor, normals: Tensor, offsets: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return vertices moved by offsets, and their normals, all (V, 3).

        The file's normals may differ from those of its faces, for example if they are
        smoothed. So they are not replaced: the change of the faces' unit normals is
        added to them.
        """
        original = self._original_face_normals.to(vertices.device)
        change = self._average_face_normals(vertices + offsets) - original
        return vertices + offsets, normals + change

    def _average_face_normals(self, vertices: Tensor) -> Tensor:
        """Return the unit normals (V, 3) that follow from the faces, weighted by area.

        At a UV seam there are several vertices at one position with one normal. They
        form a group (`_faces_and_groups`), and share the mean over all faces of the
        group. Vertices at one position with different normals do not, so that creases
        stay sharp.

        Args:
            vertices: (V, 3) positions of the mesh's vertices.
        """
        # (F, 3) vertices of the faces, and (V,) the group of vertices that share a mean
        faces, groups = (
            indices.to(vertices.device) for indices in self._faces_and_groups
        )
        face_normals = _compute_area_normals(vertices, faces)
        # Each face counts for the groups of its three corners. Both tensors have first
        # the first corners of all faces, then the second and the third ones.
        group_of_corner = groups[faces].T.reshape(-1)
        normal_of_corner = face_normals.repeat(3, 1)
        n_groups = int(groups.max()) + 1
        group_sums = vertices.new_zeros(n_groups, 3).index_add(
            0, group_of_corner, normal_of_corner
        )
        sums = group_sums[groups]
        # 1e-24 keeps the derivative finite where a sum is 0
        return sums / (sums.square().sum(dim=1, keepdim=True) + 1e-24).sqrt()

    @cached_property
    def _original_face_normals(self) -> Tensor:
        return self._average_face_normals(self.vertices)

    @cached_property
    def _faces_and_groups(self) -> tuple[Tensor, Tensor]:
        """The faces (F, 3), and the group (V,) of vertices that each vertex is in.

        The vertices of a group have their normal in common. They are in one group if
        their positions and their normals are the same, the positions to 1e-5 of the
        mesh's unit and the normals to 1e-3.
        """
        rounded = np.round(
            np.concatenate(
                [self._mesh.vertices * 1e5, self._mesh.normals * 1e3], axis=1
            )
        )
        groups = np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1)
        faces = self._mesh.faces.astype(np.int64)
        return torch.from_numpy(faces), torch.from_numpy(groups.astype(np.int64))


def _compute_area_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return the normals (F, 3) of faces, as long as twice the face's area.

    A sum of them weights faces by area.
    """
    first, second, third = (
        vertices.index_select(0, faces[:, corner]) for corner in range(3)
    )
    normals: Tensor = torch.linalg.cross(second - first, third - first)
    return normals


def pose_mesh(part: MeshPart, inputs: Mapping[str, Tensor]) -> Shape:
    """Return a mesh of a scene with its inputs applied, in world space, z up.

    Args:
        part: the mesh as the scene describes it.
        inputs: assembled inputs of all meshes by name, such as "object.vertices". What
            is missing keeps its base value.
    """
    values = _select_inputs_of(part.name, inputs)
    base_mesh = MovingMesh(part.mesh, part.to_world)
    base_vertices, base_normals = base_mesh.transform_mesh(None, None)

    mesh = replace(
        part.mesh,
        vertices=_to_vector_rows(values.get("vertices", base_vertices)),
        normals=_to_vector_rows(values.get("normals", base_normals)),
    )
    color = part.base_color
    if "base_color" in values:
        color = linear_to_srgb(values["base_color"].clamp(0.0, 1.0)).numpy()
    material = _update_material(part.material, values)
    return replace(
        part, mesh=mesh, base_color=color, material=material, to_world=np.eye(4)
    )


def _update_material(material: Material, values: Mapping[str, Tensor]) -> Material:
    """Return a material with those of its numbers replaced that `values` has by name."""
    numbers = {key: float(values[key]) for key in vars(material) if key in values}
    return replace(material, **numbers)


def _select_inputs_of(name: str, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the inputs of the part with a name, without that name before the dot."""
    prefix = f"{name}."
    return {
        key.removeprefix(prefix): value.detach().cpu()
        for key, value in inputs.items()
        if key.startswith(prefix)
    }


def _to_vector_rows(tensor: Tensor) -> Float32Array:
    """Convert a tensor of vectors to an array (n, 3)."""
    rows: Float32Array = tensor.reshape(-1, 3).to(torch.float32).numpy()
    return rows


# distance in object sizes to the side, at which an object is less than a pixel wide
HIDDEN_OFFSET = 1000.0


class InputAssembler:
    """Turn the inputs of a space into those of `MitsubaScene`, for a scene's parts.

    Args:
        description: the scene.
        resolution: height and width in pixels of the image, for a scene that is
            rendered into a photograph; None leaves the photograph out.

    Attributes:
        is_object_hidden: put the object so far away that neither it nor its shadow is
            in the image. The bounds of a scene in which this was set once change the
            last bits of every later image: use it for such images alone.
    """

    is_object_hidden = False

    def __init__(
        self,
        description: SceneDescription,
        resolution: tuple[int, int] | None = None,
    ) -> None:
        """Collect the scene's meshes, the lamps of its cars, and its photographs.

        Args:
            description: the scene.
            resolution: height and width of the image; None if no image is made of it,
                and so no inputs of a photograph are needed.
        """
        self.meshes = {
            name: MovingMesh(part.mesh, part.to_world)
            for name, part in description.meshes.items()
        }
        self._carried = [
            part
            for part in description.parts
            if isinstance(part, (BeamLamp, LampGlass))
        ]
        self._photograph = description.photograph
        self._photograph_scenes = _list_photograph_scenes(description)
        self._resolution = resolution
        # inputs of the finished image by the index of the photograph; those of further
        # photographs are computed on first use, see `_get_image_inputs`
        self._image_inputs_of: dict[int, dict[str, Tensor]] = {}
        # The radiance of the plane that receives the shadow. There is one plane, and
        # one light on it, for all photographs.
        self._plane_input: dict[str, Tensor] = {}
        if resolution is not None:
            self._store_image_inputs(description, resolution)

    def _store_image_inputs(
        self, description: SceneDescription, resolution: tuple[int, int]
    ) -> None:
        """Store the inputs of the finished image for the first photograph."""
        image_inputs = make_image_inputs(description, resolution)
        self._image_inputs_of[0] = image_inputs
        if PLANE_INPUT in image_inputs:
            self._plane_input = {PLANE_INPUT: image_inputs[PLANE_INPUT]}

    def __call__(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the inputs with poses, displacements and maps applied.

        Some inputs are replaced by those that Mitsuba's scene has. `NAME.to_world` and
        `NAME.offsets` become `NAME.vertices` and `NAME.normals`. `camera.shift` (2,)
        becomes `camera.shift_x` and `camera.shift_y`. `environment.data` (H, W, 3)
        becomes `environment.padded` (H, W + 2, 3) and, with a photographed ground,
        `ground.reflectance`. All are differentiable torch operations.
        """
        if self.is_object_hidden:
            inputs = self._hide_object(inputs)
        # Inputs of the space, which are replaced one after the other by those of
        # Mitsuba's scene.
        parameters = dict(inputs)
        photograph_index = int(parameters.pop(PHOTOGRAPH_INPUT, 0))
        parameters |= self._get_image_inputs(photograph_index)
        # Lamps move with the car that carries them, whose pose is in `inputs`. From
        # `parameters` it is removed below.
        for part in self._carried:
            parameters |= _move_carried(part, inputs)
        self._put_meshes(parameters)
        if "camera.shift" in parameters:
            shift = parameters.pop("camera.shift")
            parameters["camera.shift_x"] = shift[:1]
            parameters["camera.shift_y"] = shift[1:]
        if "environment.data" in parameters:
            self._put_environment(parameters, parameters.pop("environment.data"))
        return parameters

    def _put_meshes(self, parameters: dict[str, Tensor]) -> None:
        """Replace poses and offsets of meshes by vertices and normals, in place."""
        for name, mesh in self.meshes.items():
            to_world = parameters.pop(f"{name}.to_world", None)
            offsets = parameters.pop(f"{name}.offsets", None)
            if to_world is not None or offsets is not None:
                vertices, normals = mesh.transform_mesh(to_world, offsets)
                parameters[f"{name}.vertices"] = vertices
                parameters[f"{name}.normals"] = normals

    def _put_environment(self, parameters: dict[str, Tensor], data: Tensor) -> None:
        """Add the inputs of an environment's map (H, W, 3), and of a ground in it."""
        if self._photograph is not None:
            reflectance = self._photograph.compute_reflectance(data)
            parameters["ground.reflectance"] = reflectance
        # the last column before the first, and the first behind the last, so that
        # interpolation has no seam
        parameters["environment.padded"] = torch.cat(
            [data[:, -1:], data, data[:, :1]], dim=1
        )

    def _hide_object(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return inputs in which the object is far away to the side."""
        name = f"{OBJECT}.to_world"
        pose = inputs.get(name, self.meshes[OBJECT].to_world).clone()
        pose[1, 3] += HIDDEN_OFFSET
        return {**inputs, name: pose}

    def _get_image_inputs(self, photograph: int) -> dict[str, Tensor]:
        """Return the inputs that a photograph adds to the finished image.

        They are computed on first use, and stored.

        Args:
            photograph: index of the photograph in the scene's folder; 0 if the scene
                has no folder of photographs.
        """
        if self._resolution is None:
            return {}
        if photograph not in self._image_inputs_of:
            photograph_scene = self._photograph_scenes[photograph]
            image_inputs = make_image_inputs(photograph_scene, self._resolution)
            # The plane has the light of the scene itself.
            image_inputs.pop(PLANE_INPUT, None)
            self._image_inputs_of[photograph] = image_inputs | self._plane_input
        return self._image_inputs_of[photograph]

    def get_vertices(self, name: str, assembled: Mapping[str, Tensor]) -> Tensor:
        """Return the vertices (V, 3) of a mesh in world space.

        `assembled` is the result of calling this object with inputs of the space.
        """
        vertices = assembled.get(f"{name}.vertices")
        if vertices is None:  # nothing moves the mesh
            vertices, _normals = self.meshes[name].transform_mesh(
                to_world=None, offsets=None
            )
        return vertices


def _list_photograph_scenes(description: SceneDescription) -> list[SceneDescription]:
    """Return the scene of each photograph into which a scene may be rendered.

    Each has its own camera. Without a folder of photographs it is the scene itself.
    """
    if description.photographs is None:
        return [description]
    return list(description.photographs.scenes.values())


def _move_carried(
    part: BeamLamp | LampGlass, inputs: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return the inputs that move a lamp with the car that carries it.

    The glass of a lamp is in the carrier's coordinates. It gets the carrier's pose, and
    the offsets of the carrier's vertices on which it lies. A beam is a point at a fixed
    pose on the carrier, and does not follow a deformation. The result is empty if
    nothing moves the carrier.

    Args:
        part: the beam or the glass.
        inputs: inputs of the scene, with the carrier's `to_world` and `offsets` if it
            moves.
    """
    carrier_pose = inputs.get(f"{part.carrier}.to_world")
    offsets = inputs.get(f"{part.carrier}.offsets")
    if isinstance(part, LampGlass):
        return _move_glass(part, carrier_pose, offsets)
    if carrier_pose is None:
        return {}
    return _move_beam(part, carrier_pose)


def _move_glass(
    part: LampGlass, carrier_pose: Tensor | None, offsets: Tensor | None
) -> dict[str, Tensor]:
    """Return the inputs that move the glass of a lamp.

    They are its carrier's pose (4, 4), and the offsets (V, 3) of the carrier's vertices
    on which it lies. None is for what does not move.
    """
    moved_inputs: dict[str, Tensor] = {}
    if offsets is not None:
        # the vertex of the carrier with which each vertex of the glass moves
        carrier_vertex = torch.from_numpy(part.vertex_of_carrier).to(offsets.device)
        moved_inputs[f"{part.name}.offsets"] = offsets[carrier_vertex]
    if carrier_pose is not None:
        moved_inputs[f"{part.name}.to_world"] = carrier_pose
    return moved_inputs


def _move_beam(part: BeamLamp, carrier_pose: Tensor) -> dict[str, Tensor]:
    """Return the input that moves a beam with its carrier, which has a pose (4, 4)."""
    car_pose = carrier_pose
    if part.carrier == CAMERA:
        # The camera looks out of a car, whose pose follows from the camera's.
        car_pose = compute_car_pose(carrier_pose)
    # The same dtype and device as the carrier's pose.
    pose_on_carrier = torch.from_numpy(part.pose_on_carrier).to(carrier_pose)
    beam_pose = compute_carried_pose(car_pose, pose_on_carrier)
    return {f"{part.name}.to_world": beam_pose}


# from a configuration (d,) to one number, at one seed
ScalarFunction = Callable[[Tensor], Tensor]


def write_central_differences(
    value: ScalarFunction, group: Group, u: Tensor, derivative: Tensor
) -> None:
    """Write the central differences of a function into a derivative, in place.

    A difference is the rise of the function between two points, divided by their
    distance. The distance is twice the step. At the border of the unit cube one of the
    points is clipped, so that it is less, but not 0.

    Args:
        value: function from a configuration (d,) to a scalar.
        group: the coordinates, and the step, which is half the distance.
        u: (d,) configuration.
        derivative: (d,) tensor into which the slopes of the group are written.
    """
    # the coordinates of the group, which are consecutive
    for coordinate in range(group.begin, group.begin + group.size):
        step = torch.zeros_like(u)
        step[coordinate] = group.step
        above, step_up = step_in_box(u, step, group.periodic)
        below, step_down = step_in_box(u, -step, group.periodic)
        rise = value(above) - value(below)
        run = (step_up - step_down)[coordinate]
        derivative[coordinate] = float(rise) / float(run)


def step_in_box(
    u: Tensor, step: Tensor, periodic: bool | Tensor
) -> tuple[Tensor, Tensor]:
    """Return u + step brought back into the unit box, and the step actually taken.

    Periodic coordinates wrap around, so that they can go the full step.
    """
    target = u + step
    clipped = target.clamp(0.0, 1.0)
    is_periodic = torch.as_tensor(periodic).expand(u.shape)
    position = torch.where(is_periodic, torch.remainder(target, 1.0), clipped)
    return position, torch.where(is_periodic, step, clipped - u)


N_VERTICES = 400  # largest number of vertices of a mesh that are followed
NUDGES = (2e-3, 2e-4, 2e-5, 2e-6)
"""Changes of u over which the speed is measured, largest first.

The first one is used after which a moved point is still in the frame.
"""
# directions in which the environment is followed: some hundred of them lie in a frame
N_DIRECTIONS = 4000
N_EDGE_POINTS = 25  # points that are followed along each side of the ground plane
ENVIRONMENT_DISTANCE = 1e4  # distance of the environment's points, in scene units


class Motion:
    """Measure how fast coordinates of u move points in the image.

    The points are a scene's vertices, the edge of the table or the floor, and what is
    visible of the environment. A camera that goes around an object hardly moves the
    object's outline, but all that lies behind it.

    Args:
        description: the scene.
        resolution: height and width in pixels.
        assembly: makes vertices from poses.
    """

    def __init__(
        self,
        description: SceneDescription,
        resolution: tuple[int, int],
        assembly: InputAssembler,
    ) -> None:
        """Choose the points whose motion in the image is followed.

        Args:
            description: the scene.
            resolution: height and width of the image.
            assembly: turns inputs into vertices.
        """
        self._description = description
        self._resolution = resolution
        self._assembly = assembly
        aspect = resolution[1] / resolution[0]
        pose = camera_to_world(description, aspect)
        self._camera = torch.from_numpy(pose).double()
        self._choose_ground_points(description)
        self._environment_points = _sample_environment(description)
        # indices of the vertices of each mesh that are followed
        self._followed_vertices = {
            name: torch.from_numpy(_spread_indices(len(mesh.vertices), N_VERTICES))
            for name, mesh in assembly.meshes.items()
        }

    def _choose_ground_points(self, description: SceneDescription) -> None:
        """Set half the width of the square ground, and points (n, 3) that are followed.

        They are the ground's edge, or all vertices if its texture is a photograph.
        """
        if description.photograph is None:
            self._ground_half_width = description.get_number("ground.size") / 2.0
            self._ground_points = _sample_square_edge(self._ground_half_width)
        else:
            vertices = description.photograph.mesh.vertices
            # The ground is level and around the origin, so that the largest coordinate
            # is half its width.
            self._ground_half_width = float(vertices.max())
            self._ground_points = torch.from_numpy(vertices).double()

    def project_points(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return where the followed points lie in the image.

        The first points are vertices of meshes, then come those of the ground, and then
        those of the environment. `inputs` are assembled inputs of Mitsuba's scene.

        Returns:
            (N, 2) pixels from the center, and (N,) whether each is in or near the
            frame.
        """
        camera = self._camera
        if "camera.to_world" in inputs:
            camera = inputs["camera.to_world"].double()
        points = self._collect_points(inputs)
        eye = camera[:3, 3]
        # The columns of the rotation are the camera's axes: this product is the points
        # in its coordinates.
        relative = (points - eye) @ camera[:3, :3]
        positions, is_visible = project_points(
            self._description, inputs, relative, self._resolution
        )
        # The ground hides points of the environment, which are the last ones. That
        # other surfaces hide points is not taken into account.
        first_of_environment = len(is_visible) - len(self._environment_points)
        is_visible[first_of_environment:] &= ~self._is_hidden_by_ground(eye)
        half_size = torch.tensor(self._resolution[::-1], dtype=torch.float64) / 2.0
        # A point is near the frame if it is outside by at most a fifth of half a side.
        near_frame = (positions.abs() <= 1.2 * half_size).all(dim=1)
        return positions, is_visible & near_frame

    def _collect_points(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the followed points (N, 3) in the world, those of meshes first."""
        mesh_points = [
            self._assembly.get_vertices(name, inputs)[followed].double()
            for name, followed in self._followed_vertices.items()
        ]
        return torch.cat([*mesh_points, self._ground_points, self._environment_points])

    def _is_hidden_by_ground(self, eye: Tensor) -> Tensor:
        """Return which points of the environment, (n,), the ground hides from the eye.

        The ground is a square at z = 0, and hides nothing from an eye below it.
        """
        directions = self._environment_points - eye
        goes_down = directions[:, 2] < 0.0
        # where the line of sight meets z = 0; means nothing for lines that go up
        distance = -eye[2] / directions[:, 2].clamp_max(-1e-9)
        hit = eye + distance[:, None] * directions
        on_ground = (hit[:, :2].abs() <= self._ground_half_width).all(dim=1)
        is_eye_above = bool(eye[2] > 0.0)
        return goes_down & is_eye_above & on_ground

    def measure_speeds(
        self,
        make_inputs: Callable[[Tensor], Mapping[str, Tensor]],
        u: Tensor,
        coordinates: list[int],
    ) -> Tensor:
        """Return the speed (d,) of the fastest point in the frame.

        It is in pixels per unit of u, and 0 for coordinates that are not requested.

        Args:
            make_inputs: maps a configuration to assembled inputs.
            u: (d,) configuration at which speeds are measured, by small changes of it.
            coordinates: indices of the coordinates whose speed is measured.
        """
        speeds = torch.zeros(len(u))
        with torch.no_grad():
            positions, is_visible = self.project_points(make_inputs(u))
            for coordinate in coordinates:
                speeds[coordinate] = self._measure_speed(
                    make_inputs, u, coordinate, positions, is_visible
                )
        return speeds

    def _measure_speed(
        self,
        make_inputs: Callable[[Tensor], Mapping[str, Tensor]],
        u: Tensor,
        coordinate: int,
        positions: Tensor,
        is_visible: Tensor,
    ) -> float:
        """Return the speed of the fastest point in the frame by one coordinate.

        Args:
            make_inputs: maps a configuration to assembled inputs.
            u: (d,) configuration.
            coordinate: index of the coordinate.
            positions, is_visible: what `project_points` returns at `u`.
        """
        for nudge in NUDGES:  # changes of u, largest first
            nudged = _nudge_coordinate(u, coordinate, nudge)
            new_positions, still_visible = self.project_points(make_inputs(nudged))
            shifts = (new_positions - positions)[is_visible & still_visible]
            distances = shifts.norm(dim=1)
            # If no visible point has moved, all that moved may have left the frame.
            # Then the next, smaller change is tried.
            if bool((distances > 0.0).any()):
                return float(distances.max()) / nudge
        return 0.0


def _nudge_coordinate(u: Tensor, coordinate: int, nudge: float) -> Tensor:
    """Return a configuration (d,) of which one coordinate is changed by `nudge`.

    At the upper border of the unit cube the change goes backwards.
    """
    nudged = u.clone()
    sign = 1.0 if float(u[coordinate]) + nudge <= 1.0 else -1.0
    nudged[coordinate] += sign * nudge
    return nudged


def _sample_environment(description: SceneDescription) -> Tensor:
    """Return points (n, 3) of the environment; none if the camera does not see it."""
    is_hidden = description.backdrop or description.environment is None
    directions = _sample_sphere(0 if is_hidden else N_DIRECTIONS)
    return directions * ENVIRONMENT_DISTANCE


def _sample_square_edge(half_width: float) -> Tensor:
    """Return points (n, 3) along the edge of a level square at height 0."""
    count = N_EDGE_POINTS if half_width > 0.0 else 0
    along = torch.linspace(-half_width, half_width, count, dtype=torch.float64)
    side = torch.full_like(along, half_width)
    zero = torch.zeros_like(along)
    sides = [(along, side), (along, -side), (side, along), (-side, along)]
    return torch.cat([torch.stack([x, y, zero], dim=1) for x, y in sides])


def _sample_sphere(count: int) -> Tensor:
    """Return (count, 3) directions evenly spread over the sphere (Fibonacci spiral).

    From one to the next the azimuth turns by the golden angle, pi (3 - sqrt 5).

    Args:
        count: `N_DIRECTIONS`, or 0 for none.
    """
    index = torch.arange(count, dtype=torch.float64)
    # The fixed divisor avoids a division by 0 if `count` is 0.
    z = 1.0 - (2.0 * index + 1.0) / N_DIRECTIONS
    azimuth = index * torch.pi * (3.0 - 5.0**0.5)
    radius = (1.0 - z**2).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=1)


def _spread_indices(count: int, limit: int) -> IntArray:
    """Return at most `limit` indices evenly spread over [0, count)."""
    return np.linspace(0, count - 1, min(limit, count)).astype(int)
