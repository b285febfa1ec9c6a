"""How fast each coordinate of u moves points in the picture, and the width of a difference that follows from it.

A difference is best taken over about one pixel of motion of the fastest outline, never over a fixed length in the world
(DESIGN 5.1): narrower and noise wins, wider and the loss bends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assembly import Assembly
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.plan import DEFAULT_PIXELS, DEFAULT_STEP, STEP_RANGE

POINTS = 400
"""Vertices of a mesh that are followed."""
NUDGES = (2e-3, 2e-4, 2e-5, 2e-6)
"""Changes of u that the speed is measured over: the largest that leaves something in the frame."""


DIRECTIONS = 4000
"""Directions in which the environment is followed: some hundred of them lie in a frame."""
FAR = 1e4
"""How far away its points are taken to be, in scene units."""


class Motion:
    """Projects the vertices of a scene's meshes, and points of the environment behind them, into the picture.

    A camera that goes around an object hardly moves the object's outline, but all that lies behind it.

    Args:
        description: the scene with all its parts.
        resolution: (height, width) in pixels.
        assembly: makes vertices from poses.
    """

    def __init__(self, description: SceneDescription, resolution: tuple[int, int], assembly: Assembly) -> None:
        height, width = resolution
        self._size = max(height, width)
        self._frame = torch.tensor([width, height]) / 2.0
        self._assembly = assembly
        self._camera = torch.from_numpy(camera_to_world(description, width / height)).to(torch.float64)
        self._fov = description.number("camera.fov")
        self._far = _far_points(bool(description.number("ground.size")), description.backdrop is not None)
        self._picks = {
            name: torch.from_numpy(np.linspace(0, len(mesh.vertices) - 1, min(POINTS, len(mesh.vertices))).astype(int))
            for name, mesh in assembly.meshes.items()
        }

    def pixels(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return where the followed vertices lie, (N, 2) pixels from the middle, and which are in or near the frame."""
        camera = inputs["camera.to_world"].double() if "camera.to_world" in inputs else self._camera
        fov = inputs["camera.fov"].double().reshape(()) if "camera.fov" in inputs else torch.tensor(self._fov)
        focal = self._size / 2.0 / torch.tan(torch.deg2rad(fov.double()) / 2.0)
        found = []
        for name, mesh in self._assembly.meshes.items():
            vertices = inputs.get(f"{name}.vertices")
            if vertices is None:
                vertices = mesh.place(None, None)[0]
            found.append(vertices[self._picks[name]].double())
        found.append(self._far)
        relative = (torch.cat(found) - camera[:3, 3]) @ camera[:3, :3]
        depth = relative[:, 2]
        seen = depth > 1e-3
        projected = focal * relative[:, :2] / depth.clamp_min(1e-3)[:, None]
        for axis, name in enumerate(("camera.shift_x", "camera.shift_y")):
            if name in inputs:
                projected[:, axis] += 2.0 * self._frame[axis] * inputs[name].double().reshape(())
        return projected, seen & (projected.abs() <= 1.2 * self._frame.double()).all(dim=1)

    def speeds(self, inputs: Callable[[Tensor], Mapping[str, Tensor]], u: Tensor, coordinates: list[int]) -> Tensor:
        """Return the speed of the fastest point in the frame for each coordinate, in pixels per unit of u.

        Args:
            inputs: from u to assembled inputs.
            u: (d,) where.
            coordinates: which; the others get 0.
        """
        speeds = torch.zeros(len(u))
        with torch.no_grad():
            here, seen = self.pixels(inputs(u))
            for number in coordinates:
                for size in NUDGES:
                    there = u.clone()
                    there[number] += size if float(u[number]) + size <= 1.0 else -size
                    moved, still = self.pixels(inputs(there))
                    both = seen & still
                    if bool(both.any()):
                        speeds[number] = float((moved - here)[both].norm(dim=1).max()) / size
                        break
        return speeds


def _far_points(ground: bool, backdrop: bool) -> Tensor:
    """(N, 3) points of the environment, evenly spread (Fibonacci spiral).

    Above the horizon where there is a ground, none where a plain colour hides them.
    """
    number = torch.arange(0 if backdrop else DIRECTIONS, dtype=torch.float64)
    height = 1.0 - (2.0 * number + 1.0) / DIRECTIONS
    turn = number * torch.pi * (3.0 - 5.0**0.5)
    radius = (1.0 - height**2).sqrt()
    points = torch.stack([radius * turn.cos(), height, radius * turn.sin()], dim=1) * FAR
    return points[points[:, 1] > 0.0] if ground else points


def steps_for(speeds: Tensor, pixels: float = DEFAULT_PIXELS) -> Tensor:
    """Return half-widths of differences in u: `pixels` of motion, or `DEFAULT_STEP` where nothing moves."""
    moving = speeds > 1e-3
    wanted = torch.where(moving, pixels / speeds.clamp_min(1e-3), torch.full_like(speeds, DEFAULT_STEP))
    return wanted.clamp(*STEP_RANGE)
