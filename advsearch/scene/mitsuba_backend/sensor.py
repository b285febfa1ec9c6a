"""A camera with a model of its own inside Mitsuba. Import it only where a scene has one.

The directions of rays are kept on a grid over the picture, from Newton's method, and in between are bilinear: the grid
is so fine that this is off by less than a hundredth of a pixel, but for the last pixels before a fold. Every sample of
a picture has a ray of its own, so that edges are as sharp as a pinhole's.
"""

from __future__ import annotations

from typing import Any

import torch

from advsearch.scene.cameras.model import NUMBERS, CameraModel
from advsearch.scene.mitsuba_backend.variant import mitsuba

mi: Any = mitsuba()

import drjit  # noqa: E402  (needs the variant that is set above)

dr: Any = drjit

CELLS = (128, 512)
"""Fewest and most cells along a side of the grid."""


class ModelledCamera(mi.Sensor):  # type: ignore[misc]
    """The sensor `advsearch_camera`: a `CameraModel` at a place.

    Parameters: `to_world`; `lens`, its numbers in the order of `NUMBERS`.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        numbers = tuple(float(props[name]) for name in NUMBERS)
        self._model = CameraModel(str(props["kind"]), numbers, reach=float(props["reach"]))
        self._near, self._far = float(props["near_clip"]), float(props["far_clip"])
        self._cells = tuple(max(CELLS[0], min(CELLS[1], int(side))) for side in self.film().crop_size())
        self.pose = mi.Transform4f(super().world_transform())
        self.lens = mi.TensorXf(list(numbers), (len(NUMBERS),))
        self.rays = mi.Float()
        self._make_rays()

    def traverse(self, cb: Any) -> None:
        """See `mi.Object.traverse`."""
        super().traverse(cb)
        cb.put("to_world", self.pose, mi.ParamFlags.NonDifferentiable)
        cb.put("lens", self.lens, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: Any) -> None:
        """See `mi.Object.parameters_changed`."""
        if not keys or "lens" in keys:
            self._make_rays()
        super().parameters_changed(keys)

    def world_transform(self) -> Any:
        """The pose."""
        return self.pose

    def sample_ray_differential(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
        """See `mi.Sensor.sample_ray_differential`; where the lens sees nothing, a ray of weight 0 that hits nothing."""
        ahead, inside = self._looked_up(sample2)
        ray = dr.zeros(mi.RayDifferential3f)  # all of it, or it would be ragged for derivatives
        ray.time = time
        ray.o = self.pose @ mi.Point3f(self._near * ahead)
        ray.d = self.pose @ mi.Vector3f(ahead)
        ray.maxt = dr.select(inside, mi.Float(self._far), 0.0)
        return ray, dr.select(inside, mi.Spectrum(1.0), 0.0)

    def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
        """See `mi.Sensor.sample_ray`."""
        ray, weight = self.sample_ray_differential(time, sample1, sample2, sample3, active)
        return mi.Ray3f(ray), weight

    def to_string(self) -> str:
        """See `mi.Object.to_string`."""
        return f"ModelledCamera[{self._model.kind}]"

    def _make_rays(self) -> None:
        wide, tall = self._cells
        across, down = (torch.linspace(0.0, 1.0, cells + 1, dtype=torch.float64) for cells in (wide, tall))
        places = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1).reshape(-1, 2)
        with torch.no_grad():
            directions, inside = self._model.with_numbers(self.lens.torch().cpu()).rays(places)
        directions = directions * torch.tensor([-1.0, -1.0, 1.0])  # Mitsuba's x is to the left and its y up
        table = torch.cat([directions, inside[:, None]], dim=-1).to(torch.float32)
        self.rays = mi.Float(table.reshape(-1).contiguous())
        dr.eval(self.rays)

    def _looked_up(self, place: Any) -> tuple[Any, Any]:
        """Direction at a place in the picture, and whether the lens sees anything there."""
        wide, tall = self._cells
        x, y = place.x * wide, place.y * tall
        column = dr.clip(mi.Int32(dr.floor(x)), 0, wide - 1)
        row = dr.clip(mi.Int32(dr.floor(y)), 0, tall - 1)
        right, down = x - mi.Float(column), y - mi.Float(row)
        first = mi.UInt32(row * (wide + 1) + column)
        upper, lower = (
            dr.lerp(dr.gather(mi.Vector4f, self.rays, at), dr.gather(mi.Vector4f, self.rays, at + 1), right)
            for at in (first, first + (wide + 1))
        )
        found = dr.lerp(upper, lower, down)
        return dr.normalize(mi.Vector3f(found.x, found.y, found.z)), found.w > 0.0


mi.register_sensor("advsearch_camera", ModelledCamera)
