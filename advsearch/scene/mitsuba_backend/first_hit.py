"""What the camera sees first through the middle of each pixel, without noise."""

from __future__ import annotations

from typing import Any

import torch

from advsearch.scene.mitsuba_backend.variant import mitsuba_and_drjit
from advsearch.scene.surfaces import Surfaces


def first_hits(scene: Any, sensor: Any, resolution: tuple[int, int]) -> Surfaces:
    """Return the surface in each pixel.

    A thin lens is looked through at its middle. What lets more than half of the light pass and does not shine towards
    the camera, as a lamp that is off or a hole in a leaf, is not seen; haze is no shape.

    Args:
        scene: Mitsuba's.
        sensor: Mitsuba's camera.
        resolution: (height, width) in pixels, which need not be the camera's own.
    """
    mi, dr = mitsuba_and_drjit()

    height, width = resolution
    count = height * width
    pixel = dr.arange(mi.UInt32, count)
    place = mi.Point2f((pixel % width + 0.5) / width, (pixel // width + 0.5) / height)
    ray, weight = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    to_world = sensor.world_transform()
    eye = to_world @ mi.Point3f(0.0)  # rays begin at the near clipping plane
    ahead = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
    active = dr.any(mi.Spectrum(weight) > 0.0) & dr.full(mi.Bool, True, count)
    number, face = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
    depth, z_depth = dr.full(mi.Float, dr.inf, count), dr.full(mi.Float, dr.inf, count)
    normal, uv = dr.zeros(mi.Normal3f, count), dr.zeros(mi.Point2f, count)
    shapes = scene.shapes()
    while dr.any(active):
        hit = scene.ray_intersect(ray, active)
        active &= hit.is_valid()
        shining = dr.max(hit.emitter(scene, active).eval(hit, active)) > 0.0
        flags = hit.bsdf().flags()
        clear = dr.max(hit.bsdf().eval_null_transmission(hit, active)) > 0.5
        passes = active & mi.has_flag(flags, mi.BSDFFlags.Null) & (clear | ~mi.has_flag(flags, mi.BSDFFlags.Smooth))
        passes &= ~shining
        seen = active & ~passes
        for place_of, shape in enumerate(shapes, 1):
            number[seen & (hit.shape == mi.ShapePtr(shape))] = mi.UInt32(place_of)
        face[seen] = hit.prim_index
        depth[seen] = dr.norm(hit.p - eye)
        z_depth[seen] = dr.dot(hit.p - eye, ahead)
        normal[seen] = mi.Normal3f(hit.sh_frame.n)
        uv[seen] = mi.Point2f(hit.uv.x, 1.0 - hit.uv.y)  # Mitsuba's rows of a texture begin at the top
        ray, active = hit.spawn_ray(ray.d), passes
    size = (height, width)
    return Surfaces(
        names=tuple(shape.id() for shape in shapes),
        id=number.torch().reshape(size).long().cpu(),
        depth=depth.torch().reshape(size).cpu(),
        z_depth=z_depth.torch().reshape(size).cpu(),
        normal=torch.stack([one.torch().reshape(size).cpu() for one in normal], dim=-1),
        uv=torch.stack([one.torch().reshape(size).cpu() for one in uv], dim=-1),
        face=face.torch().reshape(size).long().cpu(),
    )
