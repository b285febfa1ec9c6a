"""Collects light transport: what every vertex of a light path adds to its pixel for a
unit more of a base colour.

One pass traces the paths of a picture as the path integrator does (next-event
estimation and BSDF sampling, weighted by the power heuristic; Veach 1997, section 9.2)
and keeps, for each vertex on a surface whose base colour is an input,

    weight = throughput before the vertex x d BSDF / d base colour x radiance that
    arrives there,

so that, to first order, the radiance of the pixel changes by the sum of weight x change
of the base colour at the vertex. The derivative of the BSDF is a difference: it is
evaluated with all texels `STEP` larger too. For a base colour in which the BSDF is
affine (the diffuse and the metallic lobe of the principled BSDF) that is exact.
Dr.Jit's forward mode finds the same, at the price of more kernels. Of a projector's
picture the weight is that of its light, white, at the vertex. The whole path is one
kernel, which also makes the picture itself and what guides its denoiser.

And `first_hits`: what the camera sees first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.formation import Surfaces
from advsearch.scene.mitsuba_backend.variant import dr, mi

# how much the base colour is changed for the derivative of a BSDF with respect to it
STEP = 0.0625
ROUNDING = 1e-4  # relative change of a BSDF under which it counts as none


@dataclass(frozen=True, eq=False)
class Vertices:
    """Vertices of light paths, those with the same place in their path."""

    pixel: Tensor  # (n,) int64, row by row
    # (n, 2) float32 texture coordinates as Mitsuba has them: row 0 of a base colour
    # lies at v = 0
    uv: Tensor
    # (n, 3) float32, divided by the samples a pixel, so that a pixel's sum is what
    # counts
    weight: Tensor
    # (n,) bool: the camera sees it directly, or through mirrors and glass
    sharp: Tensor

    def only(self, mask: Tensor) -> Vertices:
        """Return those that a mask (n,) has."""
        if bool(mask.all()):
            return self
        return Vertices(
            self.pixel[mask], self.uv[mask], self.weight[mask], self.sharp[mask]
        )


@dataclass(frozen=True, eq=False)
class Paths:
    """What the paths of one picture say."""

    # (H, W, 3) float32, with the same noise as the weights; the environment is in it
    radiance: Tensor
    coverage: Tensor  # (H, W, 1), the share of each pixel that shows surfaces
    # (H, W, 3), what of the radiance is the environment as the camera sees it
    background: Tensor
    # (H, W, 3), reflectance in [0, 1] of the first hit that light does not pass
    albedo: Tensor
    normal: Tensor  # (H, W, 3), and its shading normal
    vertices: list[Vertices]  # by their place in the path


def mean_of(passes: Sequence[Paths]) -> Paths:
    """Return the mean pictures of passes with as many samples each; it has no
    vertices.
    """
    names = ("radiance", "coverage", "background", "albedo", "normal")
    means = [
        torch.stack([getattr(paths, name) for paths in passes]).mean(dim=0)
        for name in names
    ]
    return Paths(means[0], means[1], means[2], means[3], means[4], [])


def collect(
    scene: Any,
    parameters: Any,
    key: str,
    noise: Any,
    size: tuple[int, int],
    depth: int,
    spp: int,
    projector: Any,
) -> Paths:
    """Trace one pass, of paths of at most `depth` segments, of a picture of a size
    (height and width), with a sampler that is seeded for `spp` samples a pixel; the
    texture (h, w, 3) with Mitsuba's key is a base colour, or the picture of a
    projector. It is not recorded: Dr.Jit 1.5.0 crashes when it replays so long a
    kernel.
    """
    height, width = size
    sensor = scene.sensors()[0]
    pixel = dr.arange(mi.UInt32, height * width * spp) // spp
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    place = (corner + noise.next_2d()) / mi.Point2f(width, height)
    aperture = noise.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, weight = sensor.sample_ray(0.0, 0.5, place, aperture)
    first_hit, emitted, bounces = _traced(scene, ray, weight, noise, depth)

    # The same BSDFs once more, now that the base colour is larger by `STEP`: their
    # differences are the derivatives. Or the light of the projector alone, now that it
    # throws white
    texture = mi.TensorXf(parameters[key])
    slopes = [(0.0, 0.0)] * len(bounces)
    lit = list[tuple[Any, Any]]()
    try:
        parameters[key] = (
            texture + STEP
            if projector is None
            else dr.full(mi.TensorXf, 1.0, texture.shape)
        )
        parameters.update()
        if projector is None:
            slopes = [bounce.slopes() for bounce in bounces]
        else:
            lit = [bounce.lit_by(scene, projector) for bounce in bounces]
    finally:
        parameters[key] = texture
        parameters.update()

    # From the last vertex back to the camera: what leaves each towards the one before
    # it, and what of that is a base colour's
    L = mi.Spectrum(0.0)
    vertices = list[tuple[Any, Any, Any]]()
    for bounce, emitted_next, (slope_em, slope_bsdf) in zip(
        bounces[::-1], emitted[:0:-1], slopes[::-1], strict=True
    ):
        incoming = emitted_next + L
        weight = bounce.throughput * (
            slope_em * bounce.em_weight + slope_bsdf * incoming
        )
        vertices.append((mi.Point2f(bounce.si.uv), weight, bounce.sharp))
        L = bounce.bsdf_value_em * bounce.em_weight + bounce.bsdf_weight * incoming
    vertices.reverse()
    if projector is not None:
        vertices = [
            (uv, b.throughput * light, b.sharp)
            for b, (uv, light) in zip(bounces, lit, strict=True)
        ]
    L = dr.select(dr.isfinite(L), L, 0.0)

    every = dr.full(mi.Bool, True, height * width * spp)
    channels = [*(L + emitted[0]), *first_hit]
    taking_part = [
        every & dr.any(weight != 0.0) & dr.all(dr.isfinite(weight))
        for _, weight, _ in vertices
    ]
    dr.eval(channels, vertices, taking_part)  # one kernel for the whole path
    means = [dr.block_sum(channel, spp) / spp for channel in channels]
    dr.eval(means)
    picture = torch.stack([mean.torch() for mean in means], dim=1).reshape(*size, -1)
    parts = [
        part.contiguous() for part in torch.split(picture, [3, 1, 3, 3, 3], dim=-1)
    ]
    kept = list[Vertices]()
    for (uv, weight, sharp), taken in zip(vertices, taking_part, strict=True):
        index: Any = dr.compress(taken)
        if dr.width(index) == 0:
            none = torch.zeros(0)
            kept.append(
                Vertices(
                    none.long(), none.reshape(0, 2), none.reshape(0, 3), none.bool()
                )
            )
            continue
        uv = dr.gather(mi.Point2f, uv, index)
        weight = dr.gather(mi.Color3f, weight, index) / spp
        pixel = index // spp
        sharp = dr.gather(mi.Bool, sharp, index)
        dr.eval(uv, weight, pixel, sharp)
        places, weights = (
            torch.stack([axis.torch() for axis in axes], dim=1) for axes in (uv, weight)
        )
        kept.append(
            Vertices(pixel.torch().long(), places, weights, sharp.torch().bool())
        )
    return Paths(parts[0], parts[1], parts[2], parts[3], parts[4], kept)


@dataclass(frozen=True)
class Bounce:
    """One vertex of all paths."""

    si: Any  # surface interaction
    bsdf: Any  # its BSDF
    throughput: Any  # of the path before it
    sharp: Any  # no vertex before it scatters light
    wo_em: Any  # direction to the light that was sampled
    active_em: Any  # in which lanes there is one
    # radiance from there over the density, with its weight beside BSDF sampling
    em_weight: Any
    bsdf_value_em: Any  # the BSDF times the cosine for the direction to the light
    bsdf_sample: Any  # the path's direction
    active_bsdf: Any  # in which lanes it has a density
    # the same for the path's direction over its density: the throughput of the vertex
    bsdf_weight: Any

    def slopes(self) -> tuple[Any, Any]:
        """The derivatives of both values by the base colour, larger by `STEP` now; the
        second over the density.
        """
        bsdf_value = self.bsdf_weight * self.bsdf_sample.pdf
        slopes = []
        for wo, before, active in (
            (self.wo_em, self.bsdf_value_em, self.active_em),
            (self.bsdf_sample.wo, bsdf_value, self.active_bsdf),
        ):
            change = self.bsdf.eval(mi.BSDFContext(), self.si, wo, active) - before
            # not by rounding alone
            changed = dr.max(dr.abs(change)) > ROUNDING * dr.max(dr.abs(before))
            slopes.append(dr.select(active & changed, change / STEP, 0.0))
        return slopes[0], slopes[1] / dr.select(
            self.active_bsdf, self.bsdf_sample.pdf, 1.0
        )

    def lit_by(self, scene: Any, projector: Any) -> tuple[Any, Any]:
        """Where in its picture the vertex sees a projector, and what of that light
        leaves it along the path.
        """
        seen = self.si.is_valid()
        ds, light = projector.sample_direction(self.si, mi.Point2f(0.5), seen)
        seen &= dr.any(light != 0.0)
        seen &= ~scene.ray_test(self.si.spawn_ray_to(ds.p), seen)
        value = self.bsdf.eval(mi.BSDFContext(), self.si, self.si.to_local(ds.d), seen)
        return mi.Point2f(ds.uv), dr.select(seen, value * light, 0.0)


def _traced(
    scene: Any, ray: Any, weight: Any, noise: Any, depth: int
) -> tuple[list[Any], list[Any], list[Bounce]]:
    """Trace paths; return what the camera sees, channel by channel in the order of the
    pictures of `Paths` after the radiance, and from the first vertex on what each emits
    and, but for the last, how it reflects light. Rays of weight 0 see nothing.
    """
    context = mi.BSDFContext()
    count = dr.width(ray.o)
    mis_weight = mi.ad.integrators.common.mis_weight
    active = dr.any(weight > 0.0) & dr.full(mi.Bool, True, count)
    sharp = dr.full(mi.Bool, True, count)  # no vertex so far scatters light
    throughput = mi.Spectrum(1.0)
    cut_outs = any(
        mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)
        for shape in scene.shapes()
        if shape.bsdf()
    )
    straight = mi.Bool(cut_outs)  # the path has gone through cut-outs alone

    albedo = dr.zeros(mi.Color3f, count)
    normal = dr.zeros(mi.Normal3f, count)

    def stops(si: Any, bsdf: Any, where: Any) -> None:
        """Take reflectance and normal of a hit that light does not pass for those of
        the picture.
        """
        nonlocal albedo, normal
        albedo = dr.select(where, bsdf.eval_diffuse_reflectance(si, where), albedo)
        normal = dr.select(where, si.sh_frame.n, normal)

    # Of the vertex before: the camera counts as one that reflects in one direction
    # alone
    prev_si = dr.zeros(mi.SurfaceInteraction3f)
    prev_pdf = mi.Float(1.0)
    prev_delta = mi.Bool(True)
    emitted = list[Any]()
    bounces = list[Bounce]()
    for segment in range(depth):
        si = scene.ray_intersect(ray, active)

        # ---- emission of what was hit: the vertex before may have sampled the same
        # light, so the two share it
        ds = mi.DirectionSample3f(scene, si, prev_si)
        em_pdf = scene.pdf_emitter_direction(prev_si, ds, active & ~prev_delta)
        mis = dr.select(prev_delta, 1.0, mis_weight(prev_pdf, em_pdf))
        emitted.append(
            dr.select(active, mis * si.emitter(scene, active).eval(si, active), 0.0)
        )

        # ---- what the camera sees first; through cut-outs it sees what is behind them
        bsdf = si.bsdf(ray)
        if segment == 0:
            covered = si.is_valid()
            coverage = dr.select(covered, mi.Float(1.0), 0.0)
            background = dr.select(covered, 0.0, emitted[0])
            if not cut_outs:
                stops(si, bsdf, covered)
        active &= si.is_valid() & mi.Bool(segment + 1 < depth)
        if segment + 1 == depth:  # the last vertex takes light along, and reflects none
            break

        # ---- light that is sampled directly: one that a BSDF sample can't meet (a
        # point) has all of the weight
        ds, em_weight = scene.sample_emitter_direction(
            si, noise.next_2d(active), True, active
        )
        active_em = active & (ds.pdf > 0.0)
        wo_em = si.to_local(ds.d)
        bsdf_value_em, bsdf_pdf_em = bsdf.eval_pdf(context, si, wo_em, active_em)
        mis = dr.select(ds.delta, 1.0, mis_weight(ds.pdf, bsdf_pdf_em))
        em_weight = dr.select(active_em, em_weight * mis, 0.0)

        # ---- the direction in which the path goes on
        bsdf_sample, bsdf_weight = bsdf.sample(
            context, si, noise.next_1d(active), noise.next_2d(active), active
        )
        active_next = active & (bsdf_sample.pdf > 0.0)
        delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
        # a mirror's value has no derivative that could be evaluated
        active_bsdf = active_next & ~delta
        if cut_outs:
            through = active_next & mi.has_flag(
                bsdf_sample.sampled_type, mi.BSDFFlags.Null
            )
            stops(si, bsdf, straight & active & ~through)
            straight &= through
        bsdf_weight = dr.select(active_next, bsdf_weight, 0.0)
        light = wo_em, active_em, em_weight, bsdf_value_em
        bounces.append(
            Bounce(
                si,
                bsdf,
                throughput,
                sharp,
                *light,
                bsdf_sample,
                active_bsdf,
                bsdf_weight,
            )
        )

        # ---- on to the next vertex
        throughput = throughput * bsdf_weight
        active &= active_next
        sharp = sharp & delta
        prev_si = si
        prev_pdf = bsdf_sample.pdf
        prev_delta = delta
        ray = si.spawn_ray(si.to_world(bsdf_sample.wo))
    return [coverage, *background, *albedo, *normal], emitted, bounces


def first_hits(scene: Any, sensor: Any, resolution: tuple[int, int]) -> Surfaces:
    """Return the surface that the camera sees first through the middle of each pixel,
    of a resolution (height, width) that need not be the camera's own, without noise.

    A thin lens is looked through at its middle. What lets more than half of the light
    pass and does not shine towards the camera, as a lamp that is off or a hole in a
    leaf, is not seen; haze is no shape.
    """
    height, width = resolution
    count = height * width
    pixel = dr.arange(mi.UInt32, count)
    place = mi.Point2f((pixel % width + 0.5) / width, (pixel // width + 0.5) / height)
    clear = getattr(sensor, "without_drops", None)
    ray, weight = (
        sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
        if clear is None
        else clear(0.0, place)
    )
    to_world = sensor.world_transform()
    eye = to_world @ mi.Point3f(0.0)  # rays begin at the near clipping plane
    ahead = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
    active = dr.any(mi.Spectrum(weight) > 0.0) & dr.full(mi.Bool, True, count)
    number = dr.zeros(mi.UInt32, count)
    face = dr.zeros(mi.UInt32, count)
    depth = dr.full(mi.Float, dr.inf, count)
    z_depth = dr.full(mi.Float, dr.inf, count)
    normal = dr.zeros(mi.Normal3f, count)
    uv = dr.zeros(mi.Point2f, count)
    shapes = scene.shapes()
    while dr.any(active):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf()

        # Most of the light passes, as through a hole in a leaf, and nothing shines: the
        # ray goes on behind it
        shining = dr.max(si.emitter(scene, active).eval(si, active)) > 0.0
        clear = dr.max(bsdf.eval_null_transmission(si, active)) > 0.5
        # nothing is there but what lets light pass
        alone = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        passes = (
            active
            & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            & (clear | alone)
            & ~shining
        )

        seen = active & ~passes
        for place_of, shape in enumerate(shapes, 1):
            number[seen & (si.shape == mi.ShapePtr(shape))] = mi.UInt32(place_of)
        face[seen] = si.prim_index
        depth[seen] = dr.norm(si.p - eye)
        z_depth[seen] = dr.dot(si.p - eye, ahead)
        normal[seen] = mi.Normal3f(si.sh_frame.n)
        # Mitsuba's rows of a texture begin at the top
        uv[seen] = mi.Point2f(si.uv.x, 1.0 - si.uv.y)
        ray = si.spawn_ray(ray.d)
        active = passes

    def picture(value: Any) -> Tensor:
        made: Tensor = value.torch().reshape(height, width).cpu()
        return made

    return Surfaces(
        names=tuple(shape.id() for shape in shapes), id=picture(number).long(), depth=picture(depth),
        z_depth=picture(z_depth), normal=torch.stack([picture(axis) for axis in normal], dim=-1),
        uv=torch.stack([picture(axis) for axis in uv], dim=-1), face=picture(face).long(),
    )  # fmt: skip
