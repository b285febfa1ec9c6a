"""Collects light transport: what every vertex of a light path adds to its pixel for a unit more of a base colour.

One pass traces the paths of a picture as the path integrator does (next-event estimation and BSDF sampling, weighted by
the power heuristic; Veach 1997, section 9.2) and keeps, for each vertex on a surface whose base colour is an input,

    weight = throughput before the vertex x d BSDF / d base colour x radiance that arrives there,

so that, to first order, the radiance of the pixel changes by the sum of weight x change of the base colour at the
vertex. The derivative of the BSDF comes from Dr.Jit's forward mode with a tangent of one on all texels; for a base
colour in which the BSDF is affine (the diffuse and the metallic lobe of the principled BSDF) it is exact, otherwise it
holds at the base colour that the scene has. The whole path is one kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.variant import mitsuba


@dataclass(frozen=True, eq=False)
class Vertices:
    """Vertices of light paths, those with the same place in their path.

    Attributes:
        pixel: (n,) int64, row by row.
        uv: (n, 2) float32 texture coordinates as Mitsuba has them: row 0 of a base colour lies at v = 0.
        weight: (n, 3) float32, divided by the samples a pixel, so that a pixel's sum is what counts.
    """

    pixel: Tensor
    uv: Tensor
    weight: Tensor


def collect(scene: Any, parameters: Any, key: str, *, depth: int, seed: int, spp: int, sampler: str) -> list[Vertices]:
    """Trace one pass and return the vertices at which a base colour takes part, one entry for each place in a path.

    Args:
        scene: Mitsuba's, with its camera.
        parameters: of the scene.
        key: Mitsuba's name of the texture, (h, w, 3).
        depth: segments of the longest path.
        seed: number of the noise.
        spp: samples a pixel, a count that the sampler takes.
        sampler: name of the sampler.
    """
    mi = mitsuba()
    import drjit as dr

    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    count = width * height * spp
    noise = mi.load_dict({"type": sampler, "sample_count": spp})
    noise.set_samples_per_wavefront(spp)
    noise.seed(seed, count)
    texture = mi.TensorXf(parameters[key])
    dr.enable_grad(texture)
    parameters[key] = texture
    parameters.update()
    try:
        with dr.suspend_grad():  # type: ignore[no-untyped-call]
            pixel = dr.arange(mi.UInt32, count) // spp
            corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
            place = (corner + noise.next_2d()) / mi.Point2f(width, height)
            aperture = noise.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
            ray, _ = sensor.sample_ray(0.0, 0.5, place, aperture)
            vertices = _trace(scene, texture, ray, noise, depth)
            taking_part = [dr.any(one != 0.0) & dr.all(dr.isfinite(one)) for _, one in vertices]
            dr.eval(vertices, taking_part)
            return [_kept(*one, taken, spp) for one, taken in zip(vertices, taking_part, strict=True)]
    finally:
        parameters[key] = mi.TensorXf(dr.detach(texture))
        parameters.update()


def _kept(uv: Any, weight: Any, taking_part: Any, spp: int) -> Vertices:
    """Take the vertices that take part out of all, as tensors."""
    mi = mitsuba()
    import drjit as dr

    index: Any = dr.compress(taking_part)
    uv, weight = dr.gather(mi.Point2f, uv, index), dr.gather(mi.Color3f, weight, index) / spp
    pixel = index // spp
    dr.eval(uv, weight, pixel)
    places = torch.stack([uv.x.torch(), uv.y.torch()], dim=1)
    return Vertices(pixel.torch().long(), places, torch.stack([one.torch() for one in weight], dim=1))


def _trace(scene: Any, texture: Any, ray: Any, noise: Any, depth: int) -> list[tuple[Any, Any]]:
    """Return texture coordinates and weights of the vertices of each path, first vertex first."""
    mi = mitsuba()
    import drjit as dr

    context = mi.BSDFContext()
    through = mi.Spectrum(1.0)
    active = mi.Bool(True)
    last, last_pdf, last_delta = dr.zeros(mi.SurfaceInteraction3f), mi.Float(1.0), mi.Bool(True)
    steps: list[dict[str, Any]] = []
    for segment in range(depth):
        hit = scene.ray_intersect(ray, active)
        emitter = hit.emitter(scene, active)
        towards = mi.DirectionSample3f(scene, hit, last)
        by_light = scene.pdf_emitter_direction(last, towards, active & ~last_delta)
        shown = dr.select(last_delta, 1.0, _balance(last_pdf, by_light)) * emitter.eval(hit, active)
        if steps:
            steps[-1]["hit"] = dr.select(active, shown, 0.0)
        active &= hit.is_valid() & mi.Bool(segment + 1 < depth)
        if segment + 1 == depth:
            break
        bsdf = hit.bsdf(ray)
        light, arriving = scene.sample_emitter_direction(hit, noise.next_2d(active), True, active)
        lit = active & (light.pdf > 0.0)
        to_light = hit.to_local(light.d)
        value, pdf = bsdf.eval_pdf(context, hit, to_light, lit)
        arriving = dr.select(lit, arriving * dr.select(light.delta, 1.0, _balance(light.pdf, pdf)), 0.0)
        sampled, factor = bsdf.sample(context, hit, noise.next_1d(active), noise.next_2d(active), active)
        going = active & (sampled.pdf > 0.0)
        delta = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        on = going & ~delta
        slope_on = _slope(bsdf, context, hit, sampled.wo, on, texture) / dr.select(on, sampled.pdf, 1.0)
        steps.append(
            {
                "through": through,
                "direct": value * arriving,
                "slope_direct": _slope(bsdf, context, hit, to_light, lit, texture) * arriving,
                "slope_on": dr.select(on, slope_on, 0.0),
                "factor": dr.select(going, factor, 0.0),
                "hit": mi.Spectrum(0.0),
                "uv": mi.Point2f(hit.uv),
            }
        )
        through = through * steps[-1]["factor"]
        active &= going
        last, last_pdf, last_delta = hit, sampled.pdf, delta
        ray = hit.spawn_ray(hit.to_world(sampled.wo))
    beyond = mi.Spectrum(0.0)
    found = []
    for one in reversed(steps):
        incoming = one["hit"] + beyond
        found.append((one["uv"], one["through"] * (one["slope_direct"] + one["slope_on"] * incoming)))
        beyond = one["direct"] + one["factor"] * incoming
    return found[::-1]


def _slope(bsdf: Any, context: Any, hit: Any, direction: Any, active: Any, texture: Any) -> Any:
    """The derivative of a BSDF times the cosine, for a unit more of every texel."""
    import drjit as dr

    with dr.resume_grad():  # type: ignore[no-untyped-call]
        dr.set_grad(texture, 1.0)
        value = bsdf.eval(context, hit, direction, active)
        return dr.detach(dr.forward_to(value, flags=dr.ADFlag.ClearInterior | dr.ADFlag.AllowNoGrad))


def _balance(one: Any, other: Any) -> Any:
    """The power heuristic's weight of a strategy with this density beside another one."""
    import drjit as dr

    total = one * one + other * other
    return dr.select(total > 0.0, one * one / total, 0.0)
