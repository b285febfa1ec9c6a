"""Collects light transport: what every vertex of a light path adds to its pixel for a unit more of a base colour.

One pass traces the paths of a picture as the path integrator does (next-event estimation and BSDF sampling, weighted by
the power heuristic; Veach 1997, section 9.2) and keeps, for each vertex on a surface whose base colour is an input,

    weight = throughput before the vertex x d BSDF / d base colour x radiance that arrives there,

so that, to first order, the radiance of the pixel changes by the sum of weight x change of the base colour at the
vertex. The derivative of the BSDF is a difference: it is evaluated with all texels `STEP` larger too. For a base colour
in which the BSDF is affine (the diffuse and the metallic lobe of the principled BSDF) that is exact. Dr.Jit's forward
mode finds the same, at the price of more kernels. The whole path is one kernel, which also makes the picture itself and
what guides its denoiser.

And `first_hits`: what the camera sees first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.variant import dr, mi
from advsearch.scene.surfaces import Surfaces

STEP = 0.0625
"""How much the base colour is changed for the derivative of a BSDF with respect to it."""
ROUNDING = 1e-4
"""Relative change of a BSDF under which it counts as none."""


@dataclass(frozen=True, eq=False)
class Vertices:
    """Vertices of light paths, those with the same place in their path.

    Attributes:
        pixel: (n,) int64, row by row.
        uv: (n, 2) float32 texture coordinates as Mitsuba has them: row 0 of a base colour lies at v = 0.
        weight: (n, 3) float32, divided by the samples a pixel, so that a pixel's sum is what counts.
        sharp: (n,) bool: the camera sees it directly, or through mirrors and glass.
    """

    pixel: Tensor
    uv: Tensor
    weight: Tensor
    sharp: Tensor

    def only(self, mask: Tensor) -> Vertices:
        """Return those that a mask (n,) has."""
        if bool(mask.all()):
            return self
        return Vertices(self.pixel[mask], self.uv[mask], self.weight[mask], self.sharp[mask])


@dataclass(frozen=True, eq=False)
class Paths:
    """What the paths of one picture say.

    Attributes:
        radiance: (H, W, 3) float32, with the same noise as the weights; the environment is in it.
        coverage: (H, W, 1), the share of each pixel that shows surfaces.
        background: (H, W, 3), what of the radiance is the environment as the camera sees it.
        albedo: (H, W, 3), reflectance in [0, 1] of the first hit that light does not pass, as `guides` has it.
        normal: (H, W, 3), shading normal there.
        vertices: by their place in the path.
    """

    radiance: Tensor
    coverage: Tensor
    background: Tensor
    albedo: Tensor
    normal: Tensor
    vertices: list[Vertices]


def mean_of(passes: Sequence[Paths]) -> Paths:
    """Return the mean pictures of passes with as many samples each; it has no vertices."""

    def mean(name: str) -> Tensor:
        return torch.stack([getattr(one, name) for one in passes]).mean(dim=0)

    return Paths(mean("radiance"), mean("coverage"), mean("background"), mean("albedo"), mean("normal"), [])


def collect(scene: Any, parameters: Any, key: str, noise: Any, size: tuple[int, int], *, depth: int, spp: int) -> Paths:
    """Trace one pass. It is not recorded: Dr.Jit 1.5.0 crashes when it replays so long a kernel.

    Args:
        scene: Mitsuba's, with its camera.
        parameters: of the scene.
        key: Mitsuba's name of the texture, (h, w, 3).
        noise: the sampler, seeded.
        size: height and width in pixels.
        depth: segments of the longest path.
        spp: samples a pixel, those of the sampler.
    """
    height, width = size
    sensor = scene.sensors()[0]
    pixel = dr.arange(mi.UInt32, height * width * spp) // spp
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    place = (corner + noise.next_2d()) / mi.Point2f(width, height)
    aperture = noise.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, weight = sensor.sample_ray(0.0, 0.5, place, aperture)
    first, steps = _walk(scene, ray, weight, noise, depth)
    there = mi.TensorXf(parameters[key])
    try:
        parameters[key] = there + STEP
        parameters.update()
        for one in steps:
            one.slopes()
    finally:
        parameters[key] = there
        parameters.update()
    radiance, vertices = _gathered(steps)
    pictures = [*(radiance + first.shown), *first.others]
    all_of_them = dr.full(mi.Bool, True, height * width * spp)
    taking_part = [all_of_them & dr.any(one != 0.0) & dr.all(dr.isfinite(one)) for _, one, _ in vertices]
    dr.eval(pictures, vertices, taking_part)
    means = [dr.block_sum(channel, spp) / spp for channel in pictures]
    dr.eval(means)
    picture = torch.stack([one.torch() for one in means], dim=1).reshape(*size, -1)
    radiance, coverage, background, albedo, normal = (
        one.contiguous() for one in torch.split(picture, [3, 1, 3, 3, 3], dim=-1)
    )
    found = [_kept(*vertex, taken, spp) for vertex, taken in zip(vertices, taking_part, strict=True)]
    return Paths(radiance, coverage, background, albedo, normal, found)


def _kept(uv: Any, weight: Any, sharp: Any, taking_part: Any, spp: int) -> Vertices:
    """Take the vertices that take part out of all, as tensors."""
    index: Any = dr.compress(taking_part)
    if dr.width(index) == 0:
        none = torch.zeros(0)
        return Vertices(none.long(), none.reshape(0, 2), none.reshape(0, 3), none.bool())
    uv, weight = dr.gather(mi.Point2f, uv, index), dr.gather(mi.Color3f, weight, index) / spp
    pixel, sharp = index // spp, dr.gather(mi.Bool, sharp, index)
    dr.eval(uv, weight, pixel, sharp)
    places = torch.stack([uv.x.torch(), uv.y.torch()], dim=1)
    return Vertices(
        pixel.torch().long(), places, torch.stack([one.torch() for one in weight], dim=1), sharp.torch().bool()
    )


@dataclass
class _First:
    """What the camera sees.

    Attributes:
        shown: light that it sees directly.
        covered, behind: the channels of `Paths.coverage` and `Paths.background`.
        albedo, normal: those of the first hit that light does not pass.
    """

    shown: Any
    covered: Any
    behind: Any
    albedo: Any
    normal: Any

    def stops(self, hit: Any, bsdf: Any, where: Any) -> None:
        """Take reflectance and normal of a hit for those of the picture."""
        self.albedo = dr.select(where, bsdf.eval_diffuse_reflectance(hit, where), self.albedo)
        self.normal = dr.select(where, hit.sh_frame.n, self.normal)

    @property
    def others(self) -> list[Any]:
        """The other pictures of `Paths` by channel."""
        return [self.covered, *self.behind, *self.albedo, *self.normal]


@dataclass
class _Step:
    """One vertex of all paths.

    Attributes:
        through: throughput before it.
        sharp: no vertex before it scatters light.
        to_light, on: directions to the light that was sampled and of the path; with which of them count.
        arriving: radiance that arrives from the light over the density, weighted.
        value, value_on: the BSDF times the cosine for both.
        factor: throughput of the vertex.
        hit: radiance that the path's next vertex emits, weighted.
    """

    bsdf: Any
    at: Any
    through: Any
    sharp: Any
    to_light: Any
    lit: Any
    arriving: Any
    value: Any
    on: Any
    going_on: Any
    pdf: Any
    value_on: Any
    factor: Any
    hit: Any
    slope: Any = None
    slope_on: Any = None

    def slopes(self) -> None:
        """Find the derivatives of the BSDF, now that the base colour is larger by `STEP`."""
        context = mi.BSDFContext()
        value = self.bsdf.eval(context, self.at, self.to_light, self.lit)
        self.slope = _difference(value, self.value, self.lit)
        value = self.bsdf.eval(context, self.at, self.on, self.going_on)
        self.slope_on = _difference(value, self.value_on, self.going_on) / dr.select(self.going_on, self.pdf, 1.0)


def _walk(scene: Any, ray: Any, weight: Any, noise: Any, depth: int) -> tuple[_First, list[_Step]]:
    """Trace paths; return what the camera sees, and the vertices, the first one first. Rays of weight 0 see nothing."""
    context = mi.BSDFContext()
    through = mi.Spectrum(1.0)
    active, sharp = (
        dr.any(weight > 0.0) & dr.full(mi.Bool, True, dr.width(ray.o)),
        dr.full(mi.Bool, True, dr.width(ray.o)),
    )
    cut_out = any(mi.has_flag(one.bsdf().flags(), mi.BSDFFlags.Null) for one in scene.shapes() if one.bsdf())
    passed = mi.Bool(cut_out)
    last, last_pdf, last_delta = dr.zeros(mi.SurfaceInteraction3f), mi.Float(1.0), mi.Bool(True)
    steps: list[_Step] = []
    first: _First | None = None
    for segment in range(depth):
        hit = scene.ray_intersect(ray, active)
        emitter = hit.emitter(scene, active)
        towards = mi.DirectionSample3f(scene, hit, last)
        by_light = scene.pdf_emitter_direction(last, towards, active & ~last_delta)
        shown = dr.select(last_delta, 1.0, _balance(last_pdf, by_light)) * emitter.eval(hit, active)
        shown = dr.select(active, shown, 0.0)
        if steps:
            steps[-1].hit = shown
        bsdf = hit.bsdf(ray)
        if first is None:
            first = _seen(hit, shown)
            if not cut_out:
                first.stops(hit, bsdf, hit.is_valid())
        active &= hit.is_valid() & mi.Bool(segment + 1 < depth)
        if segment + 1 == depth:
            break
        light, arriving = scene.sample_emitter_direction(hit, noise.next_2d(active), True, active)
        lit = active & (light.pdf > 0.0)
        to_light = hit.to_local(light.d)
        value, pdf = bsdf.eval_pdf(context, hit, to_light, lit)
        arriving = dr.select(lit, arriving * dr.select(light.delta, 1.0, _balance(light.pdf, pdf)), 0.0)
        sampled, factor = bsdf.sample(context, hit, noise.next_1d(active), noise.next_2d(active), active)
        going = active & (sampled.pdf > 0.0)
        delta = mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        if cut_out:
            through_it = going & mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Null)
            first.stops(hit, bsdf, passed & active & ~through_it)
            passed &= through_it
        factor = dr.select(going, factor, 0.0)
        made = _Step(
            bsdf=bsdf,
            at=hit,
            through=through,
            sharp=sharp,
            to_light=to_light,
            lit=lit,
            arriving=arriving,
            value=value,
            on=sampled.wo,
            going_on=going & ~delta,
            pdf=sampled.pdf,
            value_on=factor * sampled.pdf,
            factor=factor,
            hit=mi.Spectrum(0.0),
        )
        steps.append(made)
        through = through * factor
        active &= going
        sharp = sharp & delta
        last, last_pdf, last_delta = hit, sampled.pdf, delta
        ray = hit.spawn_ray(hit.to_world(sampled.wo))
    assert first is not None
    return first, steps


def _seen(hit: Any, shown: Any) -> _First:
    """What the camera sees at the first vertices, and the radiance that these emit."""
    covered, none = hit.is_valid(), dr.zeros(mi.Color3f, dr.width(hit.p))
    behind = dr.select(covered, 0.0, shown)
    return _First(shown, dr.select(covered, mi.Float(1.0), 0.0), behind, none, mi.Normal3f(none))


def _gathered(steps: list[_Step]) -> tuple[Any, list[tuple[Any, Any, Any]]]:
    """Return the radiance that leaves the first vertices, and texture coordinates, weights and sharpness of all."""
    beyond = mi.Spectrum(0.0)
    found: list[tuple[Any, Any, Any]] = []
    for one in reversed(steps):
        incoming = one.hit + beyond
        weight = one.through * (one.slope * one.arriving + one.slope_on * incoming)
        found.append((mi.Point2f(one.at.uv), weight, one.sharp))
        beyond = one.value * one.arriving + one.factor * incoming
    return dr.select(dr.isfinite(beyond), beyond, 0.0), found[::-1]


def _difference(after: Any, before: Any, active: Any) -> Any:
    """The derivative of a BSDF from two values; zero where they differ by rounding alone, as on other surfaces."""
    change = after - before
    return dr.select(active & (dr.max(dr.abs(change)) > ROUNDING * dr.max(dr.abs(before))), change / STEP, 0.0)


def _balance(one: Any, other: Any) -> Any:
    """The power heuristic's weight of a strategy with this density beside another one."""
    total = one * one + other * other
    return dr.select(total > 0.0, one * one / total, 0.0)


def first_hits(scene: Any, sensor: Any, resolution: tuple[int, int]) -> Surfaces:
    """Return the surface that the camera sees first through the middle of each pixel, without noise.

    A thin lens is looked through at its middle. What lets more than half of the light pass and does not shine towards
    the camera, as a lamp that is off or a hole in a leaf, is not seen; haze is no shape.

    Args:
        scene: Mitsuba's.
        sensor: Mitsuba's camera.
        resolution: (height, width) in pixels, which need not be the camera's own.
    """
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
