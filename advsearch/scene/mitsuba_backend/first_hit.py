"""What the camera sees first through the middle of each pixel, without noise."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from advsearch.scene.mitsuba_backend.variant import mitsuba


def first_hits(scene: Any, sensor: Any, name: str, resolution: tuple[int, int]) -> Tensor:
    """Return where a shape is the first that the camera sees, (H, W) bool.

    A thin lens is looked through at its middle. What lets light pass and does not shine towards the camera, as a lamp
    that is off, is not seen; haze is no shape.

    Args:
        scene: Mitsuba's.
        sensor: Mitsuba's camera.
        name: of the shape.
        resolution: (height, width) in pixels.
    """
    mi = mitsuba()
    import drjit as dr

    height, width = resolution
    pixel = dr.arange(mi.UInt32, height * width)
    place = mi.Point2f((pixel % width + 0.5) / width, (pixel // width + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    wanted = mi.ShapePtr(next(shape for shape in scene.shapes() if shape.id() == name))
    seen, active = dr.zeros(mi.Bool, height * width), dr.full(mi.Bool, True, height * width)
    while dr.any(active):
        hit = scene.ray_intersect(ray, active)
        active &= hit.is_valid()
        shining = dr.max(hit.emitter(scene, active).eval(hit, active)) > 0.0
        passes = active & mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.Null) & ~shining
        seen |= active & ~passes & (hit.shape == wanted)
        ray, active = hit.spawn_ray(ray.d), passes
    found: Tensor = seen.torch().reshape(height, width).bool().cpu()
    return found
