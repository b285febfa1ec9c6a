"""Collect light transport: the change of a pixel by the base color at each vertex of
its light paths.

One pass traces the paths of an image as the path integrator does (next-event
estimation and BSDF sampling, weighted by the power heuristic; Veach 1997, section 9.2)
and stores, for each vertex on a surface whose base color is an input,

    weight = throughput before the vertex x d BSDF / d base color x radiance that
    arrives there,

so that, to first order, the radiance of the pixel changes by the sum of weight x change
of the base color at the vertex. The derivative of the BSDF is a difference: the BSDF is
evaluated once more with all texels `COLOR_STEP` larger. For a base color in which the
BSDF is affine (the diffuse and the metallic lobe of the principled BSDF) that is exact.
Dr.Jit's forward mode finds the same, at the price of more kernels. For a projector's
image, the weight is that of white projected light at the vertex. The whole path is one
kernel, which also computes the image itself and the guides of its denoiser.

`find_first_hits` finds the surface that the camera sees first in each pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from advsearch.scene.formation import Surfaces
from advsearch.scene.mitsuba_backend.variant import dr, mi

# how much the base color is changed for the derivative of a BSDF with respect to it
COLOR_STEP = 0.0625
MAX_SURVIVAL = 0.95  # probability to survive Russian roulette, as in Mitsuba
ROUNDING_ERROR = 1e-4  # relative change of a BSDF that counts as no change


@dataclass(frozen=True, eq=False)
class PathVertices:
    """Vertices of light paths that have the same index in their path."""

    pixel: Tensor  # (n,) int64, row by row
    # (n, 2) float32 texture coordinates as Mitsuba has them: row 0 of a base color
    # lies at v = 0
    uv: Tensor
    # (n, 3) float32, divided by the samples per pixel, so that a pixel's sum is what
    # counts
    weight: Tensor
    # (n,) bool: the camera sees the vertex directly, or through mirrors and clear glass
    is_sharp: Tensor

    def select(self, mask: Tensor) -> PathVertices:
        """Return the vertices that a mask (n,) selects."""
        if bool(mask.all()):
            return self
        return PathVertices(
            self.pixel[mask], self.uv[mask], self.weight[mask], self.is_sharp[mask]
        )


@dataclass(frozen=True, eq=False)
class TracedPaths:
    """The images and the vertices of one pass of light paths."""

    # (H, W, 3) float32, with the same noise as the weights; the environment is in it
    radiance: Tensor
    coverage: Tensor  # (H, W, 1), the fraction of each pixel that surfaces cover
    # (H, W, 3), the part of the radiance that is the environment seen by the camera
    background: Tensor
    # (H, W, 3), reflectance in [0, 1] of the first hit that light does not pass
    albedo: Tensor
    normal: Tensor  # (H, W, 3), and its shading normal
    vertices: list[PathVertices]  # vertices by their index in the path


def average_passes(passes: Sequence[TracedPaths]) -> TracedPaths:
    """Return the mean images of passes with equal sample counts, without vertices."""
    names = ("radiance", "coverage", "background", "albedo", "normal")
    means = {
        name: torch.stack([getattr(paths, name) for paths in passes]).mean(dim=0)
        for name in names
    }
    return TracedPaths(**means, vertices=[])


def collect_paths(
    scene: Any,
    parameters: Any,
    key: str,
    noise: Any,
    size: tuple[int, int],
    depth: int,
    spp: int,
    projector: Any,
    unseen: Any = None,
    roulette_depth: int | None = None,
) -> TracedPaths:
    """Trace one pass of light paths and collect their vertices.

    It is not recorded: Dr.Jit 1.5.0 crashes when it replays so long a kernel. The
    texture is changed on the way, and restored. Radiance that is not finite is replaced
    by zero.

    Args:
        scene: Mitsuba's scene.
        parameters: what `mi.traverse` returns for the scene.
        key: Mitsuba's key of a texture (h, w, 3): a base color, or the image of the
            projector.
        noise: a sampler that is seeded for `spp` samples per pixel.
        size: height and width of the image.
        depth: maximum length of a path in segments.
        spp: samples per pixel.
        projector: Mitsuba's projector whose image `key` is; None for a base color.
        unseen: Mitsuba's shape whose pixels are black: camera rays that meet it first
            are not traced. None if there is none.
        roulette_depth: bounces from which on Russian roulette may end a path; None if
            it never does.
    """
    ray, weight = _sample_camera_rays(scene.sensors()[0], noise, size, spp)
    if unseen is not None:
        weight = dr.select(_find_hits(scene, ray, unseen), 0.0, weight)
    # From the bounce `depth` on there is no roulette, since paths end before.
    first_hit_channels, emitted, bounces = _trace_paths(
        scene, ray, weight, noise, depth, roulette_depth=roulette_depth or depth
    )

    if projector is None:
        slopes = _compute_slopes(parameters, key, bounces)
        reflected, vertices = _accumulate_radiance(bounces, emitted, slopes)
    else:
        vertices = _light_by_projector(scene, parameters, key, projector, bounces)
        # Only the radiance is used here. The vertices are those of the projector above.
        no_slopes = [(0.0, 0.0)] * len(bounces)
        reflected, _ = _accumulate_radiance(bounces, emitted, no_slopes)
    reflected = dr.select(dr.isfinite(reflected), reflected, 0.0)
    # `emitted[0]` is what the camera sees directly: emission of the first hit, or the
    # environment.
    radiance = reflected + emitted[0]
    return _fetch_paths([*radiance, *first_hit_channels], vertices, size, spp)


def _compute_slopes(
    parameters: Any, key: str, bounces: Sequence[Bounce]
) -> list[tuple[Any, Any]]:
    """Return for each bounce the derivatives by the base color of what it reflects.

    There are two, see `Bounce.compute_slopes`. They are differences: the BSDFs are
    evaluated once more with all texels larger by `COLOR_STEP`.

    Args:
        parameters: what `mi.traverse` returns for the scene.
        key: Mitsuba's key of the base color's texture.
        bounces: the bounces of the paths.
    """
    larger_color = mi.TensorXf(parameters[key]) + COLOR_STEP
    with _set_texture(parameters, key, larger_color):
        return [bounce.compute_slopes() for bounce in bounces]


def _light_by_projector(
    scene: Any, parameters: Any, key: str, projector: Any, bounces: Sequence[Bounce]
) -> list[tuple[Any, Any, Any]]:
    """Return the vertices of paths as a projector with a white image lights them.

    Light is proportional to the image. So the light of a white image is the weight of
    the texel that falls on the vertex.

    A vertex has its texture coordinates in the projector's image, its weight, and
    whether the camera sees it sharply, as from `_accumulate_radiance`. Other light does
    not count.

    Args:
        scene: Mitsuba's scene.
        parameters: what `mi.traverse` returns for it.
        key: Mitsuba's key of the projector's image.
        projector: Mitsuba's projector.
        bounces: the bounces of the paths.
    """
    white = dr.full(mi.TensorXf, 1.0, mi.TensorXf(parameters[key]).shape)
    with _set_texture(parameters, key, white):
        projected = [bounce.eval_projector(scene, projector) for bounce in bounces]
    return [
        (uv, bounce.throughput * light, bounce.is_sharp)
        for bounce, (uv, light) in zip(bounces, projected, strict=True)
    ]


@contextmanager
def _set_texture(parameters: Any, key: str, value: Any) -> Iterator[None]:
    """Set a texture of Mitsuba's scene inside the `with`.

    `parameters` are what `mi.traverse` returns, and `key` is that of the texture.
    """
    texture = mi.TensorXf(parameters[key])
    try:
        parameters[key] = value
        parameters.update()
        yield
    finally:
        parameters[key] = texture
        parameters.update()


def _find_hits(scene: Any, ray: Any, shape: Any) -> Any:
    """Return which rays meet one of Mitsuba's shapes first."""
    hit = scene.ray_intersect_preliminary(ray, coherent=True)
    return hit.is_valid() & (hit.shape == mi.ShapePtr(shape))


def _sample_camera_rays(
    sensor: Any, noise: Any, size: tuple[int, int], spp: int
) -> tuple[Any, Any]:
    """Sample `spp` camera rays per pixel, row by row; return rays and weights.

    Samples of a pixel follow one another. For a camera without an aperture, the center
    of the aperture is passed, which has no effect.
    """
    height, width = size
    pixel = dr.arange(mi.UInt32, height * width * spp) // spp
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    position = (corner + noise.next_2d()) / mi.Point2f(width, height)
    aperture = noise.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, weight = sensor.sample_ray(0.0, 0.5, position, aperture)
    return ray, weight


def _accumulate_radiance(
    bounces: Sequence[Bounce], emitted: Sequence[Any], slopes: Sequence[tuple[Any, Any]]
) -> tuple[Any, list[tuple[Any, Any, Any]]]:
    """Accumulate radiance from the last vertex back to the camera.

    Args:
        bounces: bounces of the vertices but for the last, from the camera on.
        emitted: what each vertex emits; one more than bounces.
        slopes: for each bounce the two derivatives of `Bounce.compute_slopes`.

    Returns:
        The radiance that leaves the first vertex, without its emission; and for each
        vertex its texture coordinates, its weight (the change of the pixel by the base
        color there, see the top of the module), and whether the camera sees it sharply.
    """
    reflected = mi.Spectrum(0.0)
    vertices = list[tuple[Any, Any, Any]]()
    # From the last vertex to the first. Each bounce receives what the vertex after it
    # emits, so that `emitted[0]` is left out: the caller adds it.
    for bounce, emitted_next, (slope_em, slope_bsdf) in zip(
        reversed(bounces), reversed(emitted[1:]), reversed(slopes), strict=True
    ):
        # `next_weight` makes up for paths that Russian roulette has ended here.
        incoming = (emitted_next + reflected) * bounce.next_weight
        weight = bounce.throughput * (
            slope_em * bounce.em_weight + slope_bsdf * incoming
        )
        vertices.append((mi.Point2f(bounce.si.uv), weight, bounce.is_sharp))
        reflected = (
            bounce.bsdf_value_em * bounce.em_weight + bounce.bsdf_weight * incoming
        )
    vertices.reverse()
    return reflected, vertices


def _find_weighted_samples(
    vertices: list[tuple[Any, Any, Any]], n_samples: int
) -> list[Any]:
    """Return for each vertex of a path which samples count there: (n_samples,) bool.

    Those are the ones with a weight that is finite and not 0.
    """
    every_sample = dr.full(mi.Bool, True, n_samples)
    return [
        # a weight may be one number for all samples
        every_sample & dr.any(weight != 0.0) & dr.all(dr.isfinite(weight))
        for _, weight, _ in vertices
    ]


def _fetch_paths(
    channels: list[Any],
    vertices: list[tuple[Any, Any, Any]],
    size: tuple[int, int],
    spp: int,
) -> TracedPaths:
    """Evaluate the kernel of a pass and fetch images and vertices into torch.

    Args:
        channels: channels of the radiance and of the other images of `TracedPaths`, in
            their order, for each sample.
        vertices: for each vertex its texture coordinates, its weight, and whether the
            camera sees it sharply.
        size: height and width of the image.
        spp: samples per pixel, which follow one another.
    """
    n_samples = size[0] * size[1] * spp
    has_weight = _find_weighted_samples(vertices, n_samples)
    dr.eval(channels, vertices, has_weight)  # one kernel for the whole path
    image = _average_samples(channels, size, spp)
    radiance, coverage, background, albedo, normal = torch.split(
        image, [3, 1, 3, 3, 3], dim=-1
    )
    return TracedPaths(
        radiance=radiance.contiguous(),
        coverage=coverage.contiguous(),
        background=background.contiguous(),
        albedo=albedo.contiguous(),
        normal=normal.contiguous(),
        vertices=[
            _fetch_vertices(*vertex, mask, spp)
            for vertex, mask in zip(vertices, has_weight, strict=True)
        ],
    )


def _average_samples(channels: list[Any], size: tuple[int, int], spp: int) -> Tensor:
    """Return the mean (H, W, channels) of each pixel's samples.

    The arguments are those of `_fetch_paths`.
    """
    means = [dr.block_sum(channel, spp) / spp for channel in channels]
    dr.eval(means)
    stacked = torch.stack([mean.torch() for mean in means], dim=1)
    return stacked.reshape(*size, -1)


def _fetch_vertices(
    uv: Any, weight: Any, is_sharp: Any, mask: Any, spp: int
) -> PathVertices:
    """Fetch one vertex of those paths that a mask selects.

    Args:
        uv: texture coordinates of the vertex of each sample.
        weight: its weight.
        is_sharp: whether the camera sees it directly, or through mirrors and clear
            glass only.
        mask: samples that are fetched.
        spp: samples per pixel, by which weights are divided, so that they add up to the
            mean of a pixel.
    """
    sample: Any = dr.compress(mask)
    if dr.width(sample) == 0:
        return _make_no_vertices()
    uv = dr.gather(mi.Point2f, uv, sample)
    weight = dr.gather(mi.Color3f, weight, sample) / spp
    pixel = sample // spp  # the samples of a pixel follow one another
    is_sharp = dr.gather(mi.Bool, is_sharp, sample)
    dr.eval(uv, weight, pixel, is_sharp)
    return PathVertices(
        pixel.torch().long(),
        torch.stack([axis.torch() for axis in uv], dim=1),
        torch.stack([channel.torch() for channel in weight], dim=1),
        is_sharp.torch().bool(),
    )


def _make_no_vertices() -> PathVertices:
    """Return vertices of no path."""
    empty = torch.zeros(0)
    return PathVertices(
        empty.long(), empty.reshape(0, 2), empty.reshape(0, 3), empty.bool()
    )


@dataclass
class Bounce:
    """One vertex of all paths, at which they are reflected."""

    si: Any  # surface interaction
    bsdf: Any  # BSDF there
    throughput: Any  # throughput of the path before the vertex
    is_sharp: Any  # whether no vertex before it scatters light
    wo_em: Any  # direction to the light that was sampled
    active_em: Any  # lanes in which a light was sampled
    # radiance of that light over the density, with its MIS weight against BSDF sampling
    em_weight: Any
    bsdf_value_em: Any  # the BSDF times the cosine for the direction to the light
    bsdf_sample: Any  # direction in which the path goes on
    active_bsdf: Any  # lanes in which that direction has a density
    # the BSDF times the cosine for that direction, over its density
    bsdf_weight: Any
    # factor on what arrives from the next vertex: 1 over the probability to survive
    # Russian roulette, and 0 where the path has ended
    next_weight: Any = 1.0

    def compute_slopes(self) -> tuple[Any, Any]:
        """Return the derivatives by the base color of what a bounce reflects.

        They are differences: the caller has made the base color larger by `COLOR_STEP`,
        after the bounce was sampled.

        Returns:
            The derivative of `bsdf_value_em`, for the light that was sampled, and that
            of `bsdf_weight`, for the direction in which the path goes on.
        """
        # The weight is the value over the density. The difference is that of the value.
        bsdf_value = self.bsdf_weight * self.bsdf_sample.pdf
        slope_em = self._compute_slope(self.wo_em, self.bsdf_value_em, self.active_em)
        slope_bsdf = self._compute_slope(
            self.bsdf_sample.wo, bsdf_value, self.active_bsdf
        )
        # 1 instead of a density of 0 to divide by, where there is no derivative anyway
        pdf = dr.select(self.active_bsdf, self.bsdf_sample.pdf, 1.0)
        return slope_em, slope_bsdf / pdf

    def _compute_slope(self, wo: Any, value_before: Any, active: Any) -> Any:
        """Return the derivative of a BSDF value by the base color, as a difference
        quotient.

        The base color is larger by `COLOR_STEP` now; `value_before` is the value
        before. A change that is no larger than rounding errors counts as 0: the BSDF
        may not depend on the color.
        """
        value = self.bsdf.eval(mi.BSDFContext(), self.si, wo, active)
        change = value - value_before
        exceeds_rounding = dr.max(dr.abs(change)) > ROUNDING_ERROR * dr.max(
            dr.abs(value_before)
        )
        return dr.select(active & exceeds_rounding, change / COLOR_STEP, 0.0)

    def eval_projector(self, scene: Any, projector: Any) -> tuple[Any, Any]:
        """Return how a projector lights the vertex with a white image.

        With a white image, the light is the derivative by the texel of the image that
        falls there.

        Returns:
            The position in the projector's image, and the light that the vertex
            reflects along the path; 0 where the projector does not reach it.
        """
        # A projector is a point: the sample (0.5, 0.5) has no effect.
        is_lit = self.si.is_valid()
        ds, light = projector.sample_direction(self.si, mi.Point2f(0.5), is_lit)
        is_lit &= dr.any(light != 0.0)
        is_lit &= ~scene.ray_test(self.si.spawn_ray_to(ds.p), is_lit)
        wo = self.si.to_local(ds.d)
        value = self.bsdf.eval(mi.BSDFContext(), self.si, wo, is_lit)
        return mi.Point2f(ds.uv), dr.select(is_lit, value * light, 0.0)


class _FirstHit:
    """What the camera sees first on each path: a surface, or the background.

    Attributes:
        coverage: 1 where a path meets a surface first, else 0.
        background: emission of the environment where it meets none.
        albedo, normal: reflectance and shading normal of the surface.
    """

    def __init__(self, count: int) -> None:
        """Start with black, and no normal, for `count` paths."""
        self.coverage = dr.zeros(mi.Float, count)
        self.background = dr.zeros(mi.Spectrum, count)
        self.albedo = dr.zeros(mi.Color3f, count)
        self.normal = dr.zeros(mi.Normal3f, count)

    def put(self, si: Any, bsdf: Any, mask: Any) -> None:
        """Store reflectance and normal of a hit in the lanes of a mask."""
        reflectance = bsdf.eval_diffuse_reflectance(si, mask)
        self.albedo = dr.select(mask, reflectance, self.albedo)
        self.normal = dr.select(mask, si.sh_frame.n, self.normal)

    def separate_background(self, is_covered: Any, emission: Any) -> None:
        """Store which paths meet a surface first, and the emission behind the others."""
        self.coverage = dr.select(is_covered, mi.Float(1.0), 0.0)
        self.background = dr.select(is_covered, 0.0, emission)

    def split_channels(self) -> list[Any]:
        """Return coverage, background, reflectance and normal, channel by channel."""
        return [self.coverage, *self.background, *self.albedo, *self.normal]


def _has_cut_outs(scene: Any) -> bool:
    """Return whether light goes straight through some surface, such as a cut-out."""
    return any(
        mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)
        for shape in scene.shapes()
        if shape.bsdf()
    )


def _trace_paths(
    scene: Any, ray: Any, weight: Any, noise: Any, depth: int, roulette_depth: int
) -> tuple[list[Any], list[Any], list[Bounce]]:
    """Trace paths from camera rays; rays of weight 0 see nothing.

    Args:
        scene: Mitsuba's scene.
        ray: camera rays.
        weight: their weights.
        noise: the sampler.
        depth: longest path in segments.
        roulette_depth: bounces from which on a path goes on only with a probability:
            its throughput, but at most `MAX_SURVIVAL`.

    Returns:
        The images of `TracedPaths` after the radiance, in their order, channel by
        channel; what each vertex emits; and the bounces at all vertices but the last.
    """
    count = dr.width(ray.o)
    active = dr.any(weight > 0.0) & dr.full(mi.Bool, True, count)
    is_sharp = dr.full(mi.Bool, True, count)  # no vertex so far scatters light
    throughput = mi.Spectrum(1.0)
    has_cut_outs = _has_cut_outs(scene)
    # lanes whose path has so far gone straight through cut-outs; only used with some
    passed_straight = mi.Bool(has_cut_outs)
    first_hit = _FirstHit(count)

    # The vertex before. The camera counts as a vertex with a single direction, so that
    # the emission of the first hit has all the weight.
    prev_si = dr.zeros(mi.SurfaceInteraction3f)
    prev_pdf = mi.Float(1.0)
    prev_delta = mi.Bool(True)
    emitted = list[Any]()
    bounces = list[Bounce]()
    for segment in range(depth):
        # ---- the vertex at which the segment ends
        si = scene.ray_intersect(ray, active)
        emitted.append(_eval_emission(scene, si, prev_si, prev_pdf, prev_delta, active))
        bsdf = si.bsdf(ray)
        if segment == 0:
            first_hit.separate_background(si.is_valid(), emission=emitted[0])
            if not has_cut_outs:
                first_hit.put(si, bsdf, si.is_valid())
        is_last = segment + 1 == depth
        active &= si.is_valid() & mi.Bool(not is_last)
        if is_last:  # the last vertex emits light, and reflects none
            break

        # ---- its light, and the direction in which the path goes on
        bounce = _sample_bounce(scene, si, bsdf, throughput, is_sharp, noise, active)
        bounces.append(bounce)
        active_next = active & (bounce.bsdf_sample.pdf > 0.0)
        sampled_type = bounce.bsdf_sample.sampled_type
        if has_cut_outs:
            # Through cut-outs the camera sees what is behind them.
            passes_through = active_next & mi.has_flag(sampled_type, mi.BSDFFlags.Null)
            first_hit.put(si, bsdf, passed_straight & active & ~passes_through)
            passed_straight &= passes_through

        # ---- on to the next vertex
        is_delta = mi.has_flag(sampled_type, mi.BSDFFlags.Delta)
        throughput = throughput * bounce.bsdf_weight
        active &= active_next
        # Russian roulette. There is none at the last bounce, after which a path has
        # only one more segment.
        n_bounces = segment + 1
        if roulette_depth <= n_bounces < depth - 1:
            active, throughput = _play_roulette(bounce, throughput, noise, active)
        is_sharp = is_sharp & is_delta
        prev_si = si
        prev_pdf = bounce.bsdf_sample.pdf
        prev_delta = is_delta
        ray = si.spawn_ray(si.to_world(bounce.bsdf_sample.wo))
    return first_hit.split_channels(), emitted, bounces


def _play_roulette(
    bounce: Bounce, throughput: Any, noise: Any, active: Any
) -> tuple[Any, Any]:
    """Play Russian roulette after a bounce, and set the bounce's `next_weight`.

    Args:
        bounce: the bounce.
        throughput: throughput of the path after it.
        noise: the sampler.
        active: lanes whose path goes on so far.

    Returns:
        The lanes whose path goes on, and the throughput.
    """
    survival = dr.minimum(dr.max(throughput), MAX_SURVIVAL)
    active &= noise.next_1d(active) < survival
    bounce.next_weight = dr.select(active, dr.rcp(survival), 0.0)
    throughput = throughput * bounce.next_weight
    return active, throughput


def _eval_emission(
    scene: Any, si: Any, prev_si: Any, prev_pdf: Any, prev_delta: Any, active: Any
) -> Any:
    """Return the light that a hit emits towards the vertex before it.

    The vertex before may also have sampled the same emitter directly. The two samples
    share its light by multiple importance sampling (MIS) weights.

    Args:
        scene: Mitsuba's scene.
        si, prev_si: the hit, and the vertex before.
        prev_pdf: density with which the vertex before has sampled the direction.
        prev_delta: whether it reflects in one direction alone, so that it cannot sample
            lights.
        active: lanes that count.
    """
    mis_weight = mi.ad.integrators.common.mis_weight
    ds = mi.DirectionSample3f(scene, si, prev_si)
    em_pdf = scene.pdf_emitter_direction(prev_si, ds, active & ~prev_delta)
    mis = dr.select(prev_delta, 1.0, mis_weight(prev_pdf, em_pdf))
    emission = mis * si.emitter(scene, active).eval(si, active)
    return dr.select(active, emission, 0.0)


def _sample_bounce(
    scene: Any,
    si: Any,
    bsdf: Any,
    throughput: Any,
    sharp: Any,
    noise: Any,
    active: Any,
) -> Bounce:
    """Sample light towards a vertex, and the direction in which the path goes on.

    Args:
        scene: Mitsuba's scene.
        si, bsdf: the vertex and its BSDF.
        throughput: throughput of the path before it.
        sharp: whether no vertex before it scatters light.
        noise: the sampler.
        active: lanes whose path goes on here.
    """
    light = _sample_light_of_bounce(scene, si, bsdf, noise.next_2d(active), active)
    bsdf_sample, bsdf_weight = bsdf.sample(
        mi.BSDFContext(), si, noise.next_1d(active), noise.next_2d(active), active
    )
    active_next = active & (bsdf_sample.pdf > 0.0)
    is_delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
    return Bounce(
        si=si,
        bsdf=bsdf,
        throughput=throughput,
        is_sharp=sharp,
        wo_em=light.wo,
        active_em=light.active,
        em_weight=light.weight,
        bsdf_value_em=light.bsdf_value,
        bsdf_sample=bsdf_sample,
        # a mirror's value has no derivative that could be evaluated
        active_bsdf=active_next & ~is_delta,
        bsdf_weight=dr.select(active_next, bsdf_weight, 0.0),
    )


class _LightSample(NamedTuple):
    """A light that was sampled from a vertex; the fields are those of `Bounce`."""

    wo: Any  # direction to the light, in the frame of the surface
    active: Any  # lanes in which a light was sampled
    weight: Any  # radiance over the density, with its MIS weight
    bsdf_value: Any  # the BSDF times the cosine for the direction


def _sample_light_of_bounce(
    scene: Any, si: Any, bsdf: Any, numbers: Any, active: Any
) -> _LightSample:
    """Sample a light from a vertex.

    A BSDF sample cannot meet a point light, whose sample has all of the MIS weight.

    Args:
        scene: Mitsuba's scene.
        si, bsdf: the vertex and its BSDF.
        numbers: random numbers in [0, 1)^2.
        active: lanes whose path goes on here.
    """
    mis_weight = mi.ad.integrators.common.mis_weight
    ds, weight = scene.sample_emitter_direction(
        si, numbers, test_visibility=True, active=active
    )
    active = active & (ds.pdf > 0.0)
    wo = si.to_local(ds.d)
    bsdf_value, bsdf_pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    mis = dr.select(ds.delta, 1.0, mis_weight(ds.pdf, bsdf_pdf))
    weight = dr.select(active, weight * mis, 0.0)
    return _LightSample(wo=wo, active=active, weight=weight, bsdf_value=bsdf_value)


def find_first_hits(scene: Any, sensor: Any, resolution: tuple[int, int]) -> Surfaces:
    """Find the surface that the camera sees first through the center of each pixel.

    There is no noise: rays go through the center of a thin lens. A surface that lets
    more than half of the light pass and does not emit light towards the camera is
    skipped, such as a hole in a leaf or the glass of a lamp that is off. Haze is no
    shape, and is skipped too.

    Args:
        scene, sensor: Mitsuba's scene and its camera.
        resolution: height and width, which need not be those of the sensor.
    """
    height, width = resolution
    count = height * width
    ray, weight = _sample_center_rays(sensor, resolution)
    to_world = sensor.world_transform()
    # Depths count from here, not from the rays' origins on the near clipping plane.
    eye = to_world @ mi.Point3f(0.0)
    forward = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
    # The weight may be one number for all rays; `full` makes one entry for each.
    active = dr.any(mi.Spectrum(weight) > 0.0) & dr.full(mi.Bool, True, count)
    layers = _SurfaceLayers(scene.shapes(), count)
    while dr.any(active):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        passes_through = _passes_camera_ray(scene, si, active)
        layers.put(si, eye, forward, active & ~passes_through)
        ray = si.spawn_ray(ray.d)
        active = passes_through
    return layers.to_surfaces(resolution)


class _SurfaceLayers:
    """Images of the surface that the camera sees first, the layers of `Surfaces`.

    Args:
        shapes: Mitsuba's shapes of the scene.
        count: number of pixels.
    """

    def __init__(self, shapes: Sequence[Any], count: int) -> None:
        """Start with pixels without a surface, infinitely far away."""
        self._shapes = shapes
        self._shape_id = dr.zeros(mi.UInt32, count)  # 0: no shape
        self._face = dr.zeros(mi.UInt32, count)
        self._depth = dr.full(mi.Float, dr.inf, count)
        self._z_depth = dr.full(mi.Float, dr.inf, count)
        self._normal = dr.zeros(mi.Normal3f, count)
        self._uv = dr.zeros(mi.Point2f, count)

    def put(self, si: Any, eye: Any, forward: Any, mask: Any) -> None:
        """Store hits in the pixels of a mask.

        Args:
            si: the hits.
            eye: position of the camera.
            forward: unit direction in which it looks.
            mask: whether each pixel's hit is what the camera sees first.
        """
        for index, shape in enumerate(self._shapes, 1):
            is_shape = si.shape == mi.ShapePtr(shape)
            self._shape_id[mask & is_shape] = mi.UInt32(index)
        self._face[mask] = si.prim_index
        self._depth[mask] = dr.norm(si.p - eye)
        self._z_depth[mask] = dr.dot(si.p - eye, forward)
        self._normal[mask] = mi.Normal3f(si.sh_frame.n)
        # Mitsuba's rows of a texture begin at the top
        self._uv[mask] = mi.Point2f(si.uv.x, 1.0 - si.uv.y)

    def to_surfaces(self, resolution: tuple[int, int]) -> Surfaces:
        """Return the layers as images of a height and a width."""

        def to_image(value: Any) -> Tensor:
            image: Tensor = value.torch().reshape(resolution).cpu()
            return image

        return Surfaces(
            shape_names=tuple(shape.id() for shape in self._shapes),
            id=to_image(self._shape_id).long(),
            depth=to_image(self._depth),
            z_depth=to_image(self._z_depth),
            normal=torch.stack([to_image(axis) for axis in self._normal], dim=-1),
            uv=torch.stack([to_image(axis) for axis in self._uv], dim=-1),
            face_index=to_image(self._face).long(),
        )


def _sample_center_rays(sensor: Any, resolution: tuple[int, int]) -> tuple[Any, Any]:
    """Return the ray and weight through the center of each pixel.

    They are in the order of rows. Raindrops before the camera are left out.
    """
    height, width = resolution
    pixel = dr.arange(mi.UInt32, height * width)
    position = mi.Point2f(
        (pixel % width + 0.5) / width, (pixel // width + 0.5) / height
    )
    if hasattr(sensor, "sample_ray_without_drops"):
        ray, weight = sensor.sample_ray_without_drops(0.0, position)
    else:
        ray, weight = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    return ray, weight


def _passes_camera_ray(scene: Any, si: Any, active: Any) -> Any:
    """Return where a camera ray goes on through what it hit.

    It does if the surface emits no light, and if one of two things holds: more than
    half of the light passes, as in a hole of a leaf, or the surface does nothing but
    let light pass.

    Args:
        scene: Mitsuba's scene.
        si: surface interactions of the hits.
        active: lanes with a hit.
    """
    bsdf = si.bsdf()
    shining = dr.max(si.emitter(scene, active).eval(si, active)) > 0.0
    is_clear = dr.max(bsdf.eval_null_transmission(si, active)) > 0.5
    # it reflects nothing
    only_passes = ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    return (
        active
        & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        & (is_clear | only_passes)
        & ~shining
    )
