"""From what controls say to what Mitsuba takes: poses and displacements to vertices,
environments to padded maps.

Controls speak of an object's pose (`NAME.to_world`) and shape (`NAME.offsets`)
separately, so that they compose; Mitsuba takes world-space vertices and normals.
Everything here is torch, so gradients of vertices reach both.

And how fast each coordinate of u moves points in the picture (`Motion`), with
derivatives by differences of a width that fits. A smooth loss is best differenced over
about one pixel of motion of the fastest outline, never over a fixed length in the world
(docs/gradients.md, "The estimators"): narrower and noise wins, wider and the loss
bends. For a classifier's see `gradients.SEARCH_STEP`. The renders of a difference share
their random numbers, and have no graph.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assets import Mesh, Shape
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.geometry import camera_to_world, driving, projected, seated
from advsearch.scene.gradients import Group
from advsearch.scene.parts import CAMERA, BeamLamp, LampGlass, MeshPart

# inputs that the renderer applies to radiance
ON_PICTURE = frozenset({"backdrop.color", "camera.exposure"})


class MovingMesh:
    """One mesh, in its own coordinates, whose vertices and normals follow a pose (4, 4)
    and a displacement.
    """

    def __init__(self, mesh: Mesh, to_world: np.ndarray) -> None:
        self._mesh = mesh
        self.vertices = torch.from_numpy(mesh.vertices.astype(np.float32))
        self.normals = torch.from_numpy(mesh.normals.astype(np.float32))
        self.to_world = torch.from_numpy(to_world.astype(np.float32))

    def place(
        self, to_world: Tensor | None, offsets: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return world-space vertices and unit normals, both (V, 3), under an
        invertible affine map (4, 4), None for the base pose, and with a displacement
        (V, 3) in mesh coordinates, or None.
        """
        moving = to_world if to_world is not None else offsets
        device = self.vertices.device if moving is None else moving.device
        matrix = self.to_world.to(device) if to_world is None else to_world
        vertices = self.vertices.to(device)
        normals = self.normals.to(device)
        # the author's normals turn by as much as those that follow from the faces
        if offsets is not None:
            turned = self._area_normals(
                vertices + offsets
            ) - self._original_area_normals.to(device)
            vertices = vertices + offsets
            normals = normals + turned
        moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        turned = normals @ torch.linalg.inv(matrix[:3, :3])
        return moved, turned / turned.norm(dim=1, keepdim=True).clamp_min(1e-12)

    def _area_normals(self, vertices: Tensor) -> Tensor:
        """Area-weighted normals over vertices that share place and normal, so that
        creases stay creases.
        """
        faces, groups = (numbers.to(vertices.device) for numbers in self._sharing)
        first, second, third = (
            vertices.index_select(0, faces[:, corner]) for corner in range(3)
        )
        normals = torch.linalg.cross(second - first, third - first)
        summed = vertices.new_zeros(int(groups.max()) + 1, 3)
        summed = summed.index_add(0, groups[faces].T.reshape(-1), normals.repeat(3, 1))[
            groups
        ]
        return summed / (summed.square().sum(dim=1, keepdim=True) + 1e-24).sqrt()

    @cached_property
    def _original_area_normals(self) -> Tensor:
        return self._area_normals(self.vertices)

    @cached_property
    def _sharing(self) -> tuple[Tensor, Tensor]:
        rounded = np.round(
            np.concatenate(
                [self._mesh.vertices * 1e5, self._mesh.normals * 1e3], axis=1
            )
        )
        groups = np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1)
        return torch.from_numpy(self._mesh.faces.astype(np.int64)), torch.from_numpy(
            groups.astype(np.int64)
        )


def posed(part: MeshPart, inputs: Mapping[str, Tensor]) -> Shape:
    """Return a mesh of a scene as its inputs, those of `MitsubaScene` that differ from
    the base values, have it: in world space, z up.
    """
    begin = f"{part.name}."
    own = {
        key.removeprefix(begin): value.detach().cpu()
        for key, value in inputs.items()
        if key.startswith(begin)
    }
    places = dict(
        zip(
            ("vertices", "normals"),
            MovingMesh(part.mesh, part.to_world).place(None, None),
            strict=True,
        )
    )
    rows = {
        name: own.get(name, flat).reshape(-1, 3).to(torch.float32).numpy()
        for name, flat in places.items()
    }
    mesh = replace(part.mesh, vertices=rows["vertices"], normals=rows["normals"])
    color = part.base_color
    if "base_color" in own:
        color = linear_to_srgb(own["base_color"].clamp(0.0, 1.0)).numpy()
    material = replace(
        part.material,
        **{key: float(own[key]) for key in vars(part.material) if key in own},
    )
    return replace(
        part, mesh=mesh, base_color=color, material=material, to_world=np.eye(4)
    )


AWAY = 1000.0  # object sizes to the side, where a thing is under a pixel wide


class Assembly:
    """Turns the inputs of a space into those of `MitsubaScene`, for a scene with all
    its parts.
    """

    # whether the object is put so far away that neither it nor its shadow is in the
    # picture. A scene in which it was so has bounds from then on that change last bits
    # of every picture: it is for such pictures alone
    away = False

    def __init__(self, description: SceneDescription) -> None:
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

    def __call__(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the inputs with poses, displacements and maps worked out;
        differentiable torch operations.
        """
        if self.away:
            pose = inputs.get(
                f"{OBJECT}.to_world", self.meshes[OBJECT].to_world
            ).clone()
            pose[1, 3] += AWAY
            inputs = {**inputs, f"{OBJECT}.to_world": pose}
        parameters = dict(inputs)
        for part in self._carried:  # what carries it may be moved or deformed
            carrier, offsets = (
                inputs.get(f"{part.carrier}.{what}") for what in ("to_world", "offsets")
            )
            if isinstance(part, LampGlass) and offsets is not None:
                parameters[f"{part.name}.offsets"] = offsets[
                    torch.from_numpy(part.follows).to(offsets.device)
                ]
            if carrier is not None and isinstance(part, BeamLamp):
                car = driving(carrier) if part.carrier == CAMERA else carrier
                carrier = seated(car, torch.from_numpy(part.seat).to(carrier))
            if carrier is not None:
                parameters[f"{part.name}.to_world"] = carrier
        for name, mesh in self.meshes.items():
            to_world = parameters.pop(f"{name}.to_world", None)
            offsets = parameters.pop(f"{name}.offsets", None)
            if to_world is not None or offsets is not None:
                parameters[f"{name}.vertices"], parameters[f"{name}.normals"] = (
                    mesh.place(to_world, offsets)
                )
        if "camera.shift" in parameters:
            shift = parameters.pop("camera.shift")
            parameters["camera.shift_x"], parameters["camera.shift_y"] = (
                shift[:1],
                shift[1:],
            )
        if "environment.data" in parameters:
            data = parameters.pop("environment.data")
            if self._photograph is not None:
                parameters["ground.reflectance"] = self._photograph.reflectance(data)
            parameters["environment.padded"] = torch.cat(
                [data[:, -1:], data, data[:, :1]], dim=1
            )
        return parameters

    def vertices(self, name: str, assembled: Mapping[str, Tensor]) -> Tensor:
        """Return the vertices (V, 3) that a mesh has in world space, by inputs as a
        call returns them.
        """
        moved = assembled.get(f"{name}.vertices")
        return self.meshes[name].place(None, None)[0] if moved is None else moved


# from a configuration (d,) to one number, at one seed
Value = Callable[[Tensor], Tensor]


def central(value: Value, group: Group, u: Tensor, derivative: Tensor) -> None:
    """Put the slopes of a group, each by two values `group.step` to either side, into
    (d,) `derivative`.
    """
    for number in range(group.begin, group.begin + group.size):
        step = torch.zeros_like(u)
        step[number] = group.step
        (above, up) = moved(u, step, group.periodic)
        (below, down) = moved(u, -step, group.periodic)
        rise = value(above) - value(below)
        derivative[number] = float(rise) / float((up - down)[number])


def moved(u: Tensor, step: Tensor, periodic: bool | Tensor) -> tuple[Tensor, Tensor]:
    """Return u + step brought back into the box, and the step that was really taken.
    Periodic coordinates wrap around, so that they can go the whole step.
    """
    there = u + step
    clipped = there.clamp(0.0, 1.0)
    cyclic = torch.as_tensor(periodic).expand(u.shape)
    return torch.where(cyclic, torch.remainder(there, 1.0), clipped), torch.where(
        cyclic, step, clipped - u
    )


POINTS = 400  # vertices of a mesh that are followed
NUDGES = (2e-3, 2e-4, 2e-5, 2e-6)
"""Changes of u that the speed is measured over: the largest that leaves something in
the frame.
"""
# directions in which the environment is followed: some hundred of them lie in a frame
DIRECTIONS = 4000
EDGE = 25  # points that are followed along each side of the ground plane
FAR = 1e4  # how far away its points are taken to be, in scene units


class Motion:
    """Projects a scene's vertices, the table's edge or the floor, and what is seen of
    the environment into the picture, of a resolution (height, width) in pixels; the
    assembly makes vertices from poses. A camera that goes around an object hardly moves
    the object's outline, but all that lies behind it.
    """

    def __init__(
        self,
        description: SceneDescription,
        resolution: tuple[int, int],
        assembly: Assembly,
    ) -> None:
        self._description = description
        self._resolution = resolution
        self._assembly = assembly
        self._camera = torch.from_numpy(
            camera_to_world(description, resolution[1] / resolution[0])
        ).double()
        floor = (
            None
            if description.photograph is None
            else description.photograph.mesh.vertices
        )
        self._ground = (
            description.number("ground.size") / 2.0
            if floor is None
            else float(floor.max())
        )
        if floor is None:  # a square at height 0
            along = torch.linspace(
                -self._ground,
                self._ground,
                EDGE if self._ground > 0.0 else 0,
                dtype=torch.float64,
            )
            side = torch.full_like(along, self._ground)
            zero = torch.zeros_like(along)
            sides = [(along, side), (along, -side), (side, along), (-side, along)]
            self._edge = torch.cat([torch.stack([x, y, zero], dim=1) for x, y in sides])
        else:
            self._edge = torch.from_numpy(floor).double()
        # Points of the environment, evenly spread (Fibonacci spiral); none where
        # nothing shows them
        hidden = description.backdrop or description.environment is None
        number = torch.arange(0 if hidden else DIRECTIONS, dtype=torch.float64)
        up = 1.0 - (2.0 * number + 1.0) / DIRECTIONS
        turn = number * torch.pi * (3.0 - 5.0**0.5)
        radius = (1.0 - up**2).sqrt()
        self._far = (
            torch.stack([radius * turn.cos(), radius * turn.sin(), up], dim=1) * FAR
        )
        self._picks = {
            name: torch.from_numpy(
                np.linspace(
                    0, len(mesh.vertices) - 1, min(POINTS, len(mesh.vertices))
                ).astype(int)
            )
            for name, mesh in assembly.meshes.items()
        }

    def pixels(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return where the followed vertices lie, (N, 2) pixels from the middle, and
        which are in or near the frame.
        """
        camera = (
            inputs["camera.to_world"].double()
            if "camera.to_world" in inputs
            else self._camera
        )
        points = [
            self._assembly.vertices(name, inputs)[picks].double()
            for name, picks in self._picks.items()
        ]
        eye = camera[:3, 3]
        relative = (torch.cat([*points, self._edge, self._far]) - eye) @ camera[:3, :3]
        places, seen = projected(self._description, inputs, relative, self._resolution)
        # Which of the far points the ground plane hides
        ways = self._far - eye
        hit = eye + (-eye[2] / ways[:, 2].clamp_max(-1e-9))[:, None] * ways
        on_ground = (hit[:, :2].abs() <= self._ground).all(dim=1)
        seen[len(seen) - len(self._far) :] &= ~(
            (ways[:, 2] < 0.0) & bool(eye[2] > 0.0) & on_ground
        )
        frame = torch.tensor(self._resolution[::-1], dtype=torch.float64) / 2.0
        return places, seen & (places.abs() <= 1.2 * frame).all(dim=1)

    def speeds(
        self,
        inputs: Callable[[Tensor], Mapping[str, Tensor]],
        u: Tensor,
        coordinates: list[int],
    ) -> Tensor:
        """Return the speed (d,) of the fastest point in the frame for some coordinates
        of u (d,), 0 for the others, in pixels per unit of u; `inputs` maps u to
        assembled inputs.
        """
        speeds = torch.zeros(len(u))
        with torch.no_grad():
            here, seen = self.pixels(inputs(u))
            for number in coordinates:
                for size in NUDGES:
                    there = u.clone()
                    there[number] += size if float(u[number]) + size <= 1.0 else -size
                    moved, still = self.pixels(inputs(there))
                    distances = (moved - here)[seen & still].norm(dim=1)
                    # what stands still says nothing of what has left the frame
                    if bool((distances > 0.0).any()):
                        speeds[number] = float(distances.max()) / size
                        break
        return speeds
