"""Trace light paths of an image one by one, and tell which ones meet some surfaces.

`trace_paths` is Mitsuba's integrator `path` (next-event estimation and BSDF sampling,
weighted by the power heuristic) with two additions. It takes the indices of the samples
of an image that it traces: each sample has the random numbers that it has in the full
image. And it returns the part of a sample that depends on the surfaces of some shapes
apart from the rest: what a path carries from its first vertex on such a shape on.

So an image in which only these surfaces have changed needs only those samples again
that have met them (`advsearch.scene.mitsuba_backend.shared_paths`).

Import this only where a Mitsuba scene is built, which needs the variant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from advsearch.scene.mitsuba_backend.variant import dr, mi

MAX_SURVIVAL = 0.95  # largest probability to survive Russian roulette, as in Mitsuba


class PathSamples:
    """Random numbers of some samples of an image, those of Mitsuba's samplers.

    It is the sampler `multijitter` (Kensler 2013), or `independent`, for samples whose
    indices in the image are given; Mitsuba's own begin at the first.

    Attributes:
        rng: random-number generator of each sample.
        permutation: seed of the permutations of each sample's pixel.
        index: index of each sample in its pixel.
        dimension: how many numbers or pairs were drawn.
        spp: samples per pixel.
        is_stratified: whether it is `multijitter`.

    Args:
        seed: seed of the image, a number of Dr.Jit.
        sample: indices of the samples in the image; those of a pixel follow one
            another.
        spp: samples per pixel, rounded for the sampler.
        is_stratified: as the attribute.
    """

    DRJIT_STRUCT = {
        "rng": mi.PCG32,
        "permutation": mi.UInt32,
        "index": mi.UInt32,
        "dimension": mi.UInt32,
        "spp": int,
        "is_stratified": bool,
    }

    def __init__(
        self,
        seed: Any = None,
        sample: Any = None,
        spp: int = 1,
        is_stratified: bool = True,
    ) -> None:
        """Seed the generators; Dr.Jit calls it without arguments."""
        if sample is None:
            return
        state, increment = mi.sample_tea_32(seed, sample)
        self.rng = mi.PCG32(initstate=state, initseq=increment)
        self.index = sample % spp
        # the seed of a pixel is that of its first sample
        self.permutation = mi.sample_tea_32(0, sample - self.index + seed)[0]
        self.dimension = mi.UInt32(0)
        self.spp = spp
        self.is_stratified = is_stratified

    def next_1d(self) -> Any:
        """Draw a number in [0, 1) for each sample."""
        if not self.is_stratified:
            return self.rng.next_float32()
        seed = self._next_permutation()
        stratum = mi.permute_kensler(self.index, self.spp, seed * 0x45FBE943)
        return (mi.Float(stratum) + self.rng.next_float32()) * (1.0 / self.spp)

    def next_2d(self) -> Any:
        """Draw a point in [0, 1)^2 for each sample."""
        if not self.is_stratified:
            x = self.rng.next_float32()
            return mi.Point2f(x, self.rng.next_float32())
        columns, rows = self.strata
        seed = self._next_permutation()
        stratum = mi.permute_kensler(self.index, self.spp, seed * 0x51633E2D)
        y = stratum // columns
        x = stratum - y * columns
        jitter_x = mi.permute_kensler(x, columns, seed * 0x68BC21EB)
        jitter_y = mi.permute_kensler(y, rows, seed * 0x02E5BE93)
        fine_x = (mi.Float(jitter_y) + self.rng.next_float32()) * (1.0 / rows)
        fine_y = (mi.Float(jitter_x) + self.rng.next_float32()) * (1.0 / columns)
        return mi.Point2f(
            (mi.Float(x) + fine_x) * (1.0 / columns),
            (mi.Float(y) + fine_y) * (1.0 / rows),
        )

    @property
    def strata(self) -> tuple[int, int]:
        """Columns and rows of the strata of a pixel."""
        rows = math.isqrt(self.spp)
        return math.ceil(self.spp / rows), rows

    def _next_permutation(self) -> Any:
        """Return the seed of the next permutation of each pixel."""
        seed = self.permutation + self.dimension
        self.dimension += 1
        return seed


def sample_rays(sensor: Any, numbers: PathSamples, sample: Any) -> Any:
    """Sample the camera rays of some samples of an image, as Mitsuba's `render` does.

    Args:
        sensor: pinhole camera, whose film has a box filter.
        numbers: random numbers of the samples.
        sample: indices of the samples in the image.

    Returns:
        The rays, all of weight 1.
    """
    width, height = sensor.film().crop_size()
    pixel = sample // numbers.spp
    row = pixel // width
    corner = mi.Point2f(mi.Float(pixel - row * width), mi.Float(row))
    position = (corner + numbers.next_2d()) / mi.Point2f(width, height)
    return sensor.sample_ray(0.0, 0.0, position, mi.Point2f(0.5))[0]


@dr.syntax  # type: ignore[untyped-decorator]
def trace_paths(
    scene: Any,
    ray: Any,
    numbers: PathSamples,
    changed: Sequence[Any],
    max_depth: int,
    roulette_depth: int,
) -> Any:
    """Trace radiance, and what guides the denoiser, in two parts.

    Args:
        scene: scene without media and cut-outs, whose emitters are not hidden.
        ray: camera rays.
        numbers: random numbers of the paths.
        changed: shapes whose surfaces may have changed.
        max_depth: longest path in segments.
        roulette_depth: bounces from which on Russian roulette may end a path.

    Returns:
        Nine channels that do not depend on the changed surfaces: radiance, and albedo
        and shading normal of the first hit. The same that do. And whether a path has
        met one of them.
    """
    context = mi.BSDFContext()
    ray = mi.Ray3f(ray)
    throughput = mi.Spectrum(1.0)
    radiance = mi.Spectrum(0.0)
    before = mi.Spectrum(0.0)  # radiance of the vertices before the first changed one
    has_met = mi.Bool(False)
    eta = mi.Float(1.0)
    depth = mi.UInt32(0)
    previous = dr.zeros(mi.Interaction3f)
    previous_pdf = mi.Float(1.0)
    is_previous_delta = mi.Bool(True)
    active = mi.Bool(True)
    albedo = mi.Color3f(0.0)
    normal = mi.Normal3f(0.0)
    is_first_changed = mi.Bool(False)

    while dr.hint(active, max_iterations=max_depth, label="Paths of an image"):
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0)

        # emission of what is hit
        ds = mi.DirectionSample3f(scene, si, previous)
        emitter_pdf = scene.pdf_emitter_direction(previous, ds, ~is_previous_delta)
        weight = _weigh(previous_pdf, emitter_pdf)
        emitted = ds.emitter.eval(si, previous_pdf > 0.0)
        radiance = dr.fma(throughput, emitted * weight, radiance)

        is_changed = si.is_valid() & _is_one_of(si.shape, changed)
        is_first = is_changed & ~has_met
        before = dr.select(is_first, radiance, before)
        radiance = dr.select(is_first, 0.0, radiance)
        has_met |= is_changed

        active_next = (depth + 1 < max_depth) & si.is_valid()
        bsdf = si.bsdf(ray)

        # what guides the denoiser
        is_camera_hit = (depth == 0) & si.is_valid()
        reflectance = bsdf.eval_diffuse_reflectance(si, is_camera_hit)
        albedo = dr.select(is_camera_hit, reflectance, albedo)
        normal = dr.select(is_camera_hit, si.sh_frame.n, normal)
        is_first_changed |= is_camera_hit & is_changed
        # light of an emitter
        active_em = active_next & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, emitter_weight = scene.sample_emitter_direction(
            si, numbers.next_2d(), True, active_em
        )
        active_em &= ds.pdf != 0.0
        direction = si.to_local(ds.d)

        choice = numbers.next_1d()
        point = numbers.next_2d()
        bsdf_value, bsdf_pdf, bsdf_sample, bsdf_weight = bsdf.eval_pdf_sample(
            context, si, direction, choice, point, active_next
        )
        weight = dr.select(ds.delta, 1.0, _weigh(ds.pdf, bsdf_pdf))
        direct = bsdf_value * emitter_weight * weight
        radiance = dr.select(active_em, dr.fma(throughput, direct, radiance), radiance)

        # the next segment
        ray = si.spawn_ray(si.to_world(bsdf_sample.wo))
        throughput *= bsdf_weight
        eta *= bsdf_sample.eta
        previous = mi.Interaction3f(si)
        previous_pdf = bsdf_sample.pdf
        is_previous_delta = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
        depth = dr.select(si.is_valid(), depth + 1, depth)

        largest = dr.max(throughput)
        survival = dr.minimum(largest * dr.square(eta), MAX_SURVIVAL)
        has_roulette = depth >= roulette_depth
        survives = numbers.next_1d() < survival
        throughput = dr.select(has_roulette, throughput * dr.rcp(survival), throughput)
        active = active_next & (~has_roulette | survives) & (largest != 0.0)

    guides = [*albedo, *normal]
    unchanged = [
        *dr.select(has_met, before, radiance),
        *(dr.select(is_first_changed, 0.0, channel) for channel in guides),
    ]
    changing = [
        *dr.select(has_met, radiance, 0.0),
        *(dr.select(is_first_changed, channel, 0.0) for channel in guides),
    ]
    return unchanged, changing, has_met


def _is_one_of(shape: Any, changed: Sequence[Any]) -> Any:
    """Return whether each shape is one of several."""
    result = mi.Bool(False)
    for candidate in changed:
        result |= shape == mi.ShapePtr(candidate)
    return result


def _weigh(pdf: Any, other_pdf: Any) -> Any:
    """Return the power heuristic's weight of a sample (Veach 1997, section 9.2)."""
    square = pdf * pdf
    weight = square / dr.fma(other_pdf, other_pdf, square)
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0.0))
