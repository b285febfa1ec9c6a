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
NUDGE = 2e-3
"""Change of u that the speed is measured over."""


class Motion:
    """Projects the vertices of a scene's meshes into the picture.

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
                there = u.clone()
                nudge = NUDGE if float(u[number]) + NUDGE <= 1.0 else -NUDGE
                there[number] += nudge
                moved, still = self.pixels(inputs(there))
                both = seen & still
                if bool(both.any()):
                    speeds[number] = float((moved - here)[both].norm(dim=1).max()) / NUDGE
        return speeds


def steps_for(speeds: Tensor, pixels: float = DEFAULT_PIXELS) -> Tensor:
    """Return half-widths of differences in u: `pixels` of motion, or `DEFAULT_STEP` where nothing moves."""
    moving = speeds > 1e-3
    wanted = torch.where(moving, pixels / speeds.clamp_min(1e-3), torch.full_like(speeds, DEFAULT_STEP))
    return wanted.clamp(*STEP_RANGE)
