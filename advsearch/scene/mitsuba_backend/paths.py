"""Trace samples of an image, and separate the light that depends on some surfaces.

`trace_paths` is Mitsuba's integrator `path` (next-event estimation and BSDF sampling,
weighted by the power heuristic) with two additions. It takes the indices of the samples
of an image that it traces: each sample has the random numbers that it has in the full
image. And it returns the radiance of a sample in two parts. The second part, what a
path collects from its first vertex on one of some shapes on, depends on the surfaces of
these shapes; the first one does not.

So if only these surfaces change, only the samples whose paths have met them are traced
again (`advsearch.scene.mitsuba_backend.shared_paths`).

Import this only where a Mitsuba scene is built, which needs the variant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

from advsearch.scene.mitsuba_backend.variant import dr, mi

MAX_SURVIVAL = 0.95  # largest probability to survive Russian roulette, as in Mitsuba


class PathSamples:
    """Random numbers of some samples of an image, equal to those of Mitsuba's samplers.

    It is the sampler `multijitter` (Kensler 2013), or `independent`, for any samples of
    an image. Mitsuba's own samplers always begin with the first sample.

    Attributes:
        rng: random-number generator of each sample.
        permutation: seed of the permutations of each sample's pixel.
        index: index of each sample in its pixel.
        dimension: how many numbers or pairs were drawn.
        spp: samples per pixel.
        is_stratified: whether the sampler is `multijitter`.

    Args:
        seed: seed of the image, a number of Dr.Jit.
        sample: indices of the samples in the image; those of a pixel follow one
            another.
        spp: samples per pixel, as rounded for the sampler.
        is_stratified: whether the sampler is `multijitter`, else `independent`.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {
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
        """Seed the generators; Dr.Jit calls it without arguments to make an empty one.

        Args:
            seed: seed of the image, a number of Dr.Jit.
            sample: indices of the samples in the image.
            spp: samples per pixel.
            is_stratified: whether the sampler is `multijitter`, else `independent`.
        """
        if sample is None:
            return
        # The hashes (`sample_tea_32`) and their arguments are those of Mitsuba's
        # samplers, so that the numbers are the same.
        state, increment = mi.sample_tea_32(seed, sample)
        self.rng = mi.PCG32(initstate=state, initseq=increment)
        self.index = sample % spp
        # All samples of a pixel have one permutation seed, made from the image's seed
        # and the index of the pixel's first sample.
        first_sample = sample - self.index
        self.permutation, _ = mi.sample_tea_32(0, first_sample + seed)
        self.dimension = mi.UInt32(0)
        self.spp = spp
        self.is_stratified = is_stratified

    def next_1d(self) -> Any:
        """Draw a number in [0, 1) for each sample."""
        if not self.is_stratified:
            return self.rng.next_float32()
        seed = self._next_permutation_seed()
        stratum = mi.permute_kensler(self.index, self.spp, seed * 0x45FBE943)
        return (mi.Float(stratum) + self.rng.next_float32()) * (1.0 / self.spp)

    def next_2d(self) -> Any:
        """Draw a point in [0, 1)^2 for each sample.

        With stratification, the samples of a pixel have one point in each stratum of a
        grid. They also have one point in each of `spp` narrow columns, and one in each
        of `spp` narrow rows (correlated multi-jittered sampling, Kensler 2013). The
        constants are those of Mitsuba's `multijitter`, so that the numbers are the
        same.
        """
        if not self.is_stratified:
            x = self.rng.next_float32()
            return mi.Point2f(x, self.rng.next_float32())
        columns, rows = self.strata
        seed = self._next_permutation_seed()
        stratum = mi.permute_kensler(self.index, self.spp, seed * 0x51633E2D)
        row = stratum // columns
        column = stratum - row * columns
        # A column of strata has `rows` samples, one in each row. It is divided into
        # `rows` narrow columns, and each sample gets the one with its permuted row: so
        # no two have the same. Narrow rows are assigned by columns in the same manner.
        narrow_row = mi.permute_kensler(column, columns, seed * 0x68BC21EB)
        narrow_column = mi.permute_kensler(row, rows, seed * 0x02E5BE93)
        x_in_stratum = (mi.Float(narrow_column) + self.rng.next_float32()) * (
            1.0 / rows
        )
        y_in_stratum = (mi.Float(narrow_row) + self.rng.next_float32()) * (
            1.0 / columns
        )
        return mi.Point2f(
            (mi.Float(column) + x_in_stratum) * (1.0 / columns),
            (mi.Float(row) + y_in_stratum) * (1.0 / rows),
        )

    @property
    def strata(self) -> tuple[int, int]:
        """Columns and rows of the strata of a pixel."""
        rows = math.isqrt(self.spp)
        return math.ceil(self.spp / rows), rows

    def _next_permutation_seed(self) -> Any:
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


class LightPath:
    """Light paths on their way from the camera, with the radiance collected so far.

    Some shapes of the scene are `changed`: their surfaces may differ from image to
    image. A path's light is collected in two parts, up to the first changed surface and
    from there on.

    Attributes:
        ray: next segment of the path.
        throughput: throughput up to that segment.
        eta: product of the indices of refraction of the surfaces that were passed,
            relative to the camera's medium.
        depth: number of surfaces that the path has met.
        vertex: last vertex.
        pdf: density of the direction in which the path left the last vertex.
        is_delta: whether no other direction was possible, as at a mirror.
        active: whether the path goes on.
        radiance: radiance collected since the first changed surface; if the path has
            not met any, since the camera.
        radiance_before: radiance collected before the first changed surface; 0 if the
            path has not met any.
        has_met: whether the path has met a changed surface.
        has_met_first: whether its first hit was on a changed surface.
        albedo: reflectance of the first hit.
        normal: shading normal of the first hit.
    """

    DRJIT_STRUCT: ClassVar[dict[str, Any]] = {
        "ray": mi.Ray3f,
        "throughput": mi.Spectrum,
        "eta": mi.Float,
        "depth": mi.UInt32,
        "vertex": mi.Interaction3f,
        "pdf": mi.Float,
        "is_delta": mi.Bool,
        "active": mi.Bool,
        "radiance": mi.Spectrum,
        "radiance_before": mi.Spectrum,
        "has_met": mi.Bool,
        "has_met_first": mi.Bool,
        "albedo": mi.Color3f,
        "normal": mi.Normal3f,
    }

    def __init__(self, ray: Any = None) -> None:
        """Start at the camera.

        The camera counts as a vertex with a single direction (`is_delta`), so that the
        emission of the first hit has all the weight.

        Args:
            ray: camera rays. Dr.Jit calls the function without them, to make an object
                that it fills itself.
        """
        if ray is None:
            return
        self.ray = mi.Ray3f(ray)
        self.throughput = mi.Spectrum(1.0)
        self.eta = mi.Float(1.0)
        self.depth = mi.UInt32(0)
        self.vertex = dr.zeros(mi.Interaction3f)
        self.pdf = mi.Float(1.0)
        self.is_delta = mi.Bool(True)
        self.active = mi.Bool(True)
        self.radiance = mi.Spectrum(0.0)
        self.radiance_before = mi.Spectrum(0.0)
        self.has_met = mi.Bool(False)
        self.has_met_first = mi.Bool(False)
        self.albedo = mi.Color3f(0.0)
        self.normal = mi.Normal3f(0.0)

    def add_emission(self, scene: Any, si: Any) -> None:
        """Add what is emitted where the path arrives, by its MIS weight.

        Args:
            scene: Mitsuba's scene.
            si: surface interaction where the path arrives.
        """
        ds = mi.DirectionSample3f(scene, si, self.vertex)
        # A mirror samples no emitter (`is_delta`): there this density is 0, so that the
        # weight below is 1.
        emitter_pdf = scene.pdf_emitter_direction(self.vertex, ds, ~self.is_delta)
        # Where the last surface sampled no direction, nothing arrives.
        has_direction = self.pdf > 0.0
        emitted = ds.emitter.eval(si, has_direction)
        emitted *= _compute_weight(self.pdf, emitter_pdf)
        self.radiance = dr.fma(self.throughput, emitted, self.radiance)

    def meet(self, si: Any, bsdf: Any, changed: Sequence[Any]) -> None:
        """Record whether the path has arrived at one of the changed shapes.

        At the first changed surface of a path, the radiance collected so far, with what
        the surface itself emits, becomes `radiance_before`, and `radiance` begins anew.
        At the first hit, the guides of the denoiser are recorded.

        Args:
            si: surface interaction where the path arrives.
            bsdf: the BSDF there.
            changed: shapes whose surfaces may have changed.
        """
        is_changed = si.is_valid() & _is_among(si.shape, changed)
        is_new = is_changed & ~self.has_met
        self.radiance_before = dr.select(is_new, self.radiance, self.radiance_before)
        self.radiance = dr.select(is_new, 0.0, self.radiance)
        self.has_met |= is_changed

        is_first = (self.depth == 0) & si.is_valid()
        albedo = bsdf.eval_diffuse_reflectance(si, is_first)
        self.albedo = dr.select(is_first, albedo, self.albedo)
        self.normal = dr.select(is_first, si.sh_frame.n, self.normal)
        self.has_met_first |= is_first & is_changed

    def reflect(
        self, scene: Any, si: Any, bsdf: Any, numbers: PathSamples, max_depth: int
    ) -> None:
        """Add the light of an emitter that a surface reflects, and leave the surface.

        The path ends there if it has `max_depth` segments, or has left the scene.

        Args:
            scene: Mitsuba's scene.
            si: surface interaction where the path has arrived.
            bsdf: the BSDF there.
            numbers: random numbers.
            max_depth: longest path in segments.
        """
        self.active = (self.depth + 1 < max_depth) & si.is_valid()
        is_lit = self.active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = scene.sample_emitter_direction(
            si, numbers.next_2d(), test_visibility=True, active=is_lit
        )
        is_lit &= ds.pdf != 0.0
        # Drawn in this order, as in Mitsuba's `path`.
        component_number = numbers.next_1d()
        direction_numbers = numbers.next_2d()
        value, pdf, sample, weight = bsdf.eval_pdf_sample(
            mi.BSDFContext(),
            si,
            si.to_local(ds.d),
            component_number,
            direction_numbers,
            self.active,
        )
        # A BSDF sample cannot meet a point light, whose sample has all the weight.
        light *= dr.select(ds.delta, 1.0, _compute_weight(ds.pdf, pdf))
        radiance = dr.fma(self.throughput, value * light, self.radiance)
        self.radiance = dr.select(is_lit, radiance, self.radiance)
        self._leave(si, sample, weight)

    def _leave(self, si: Any, sample: Any, weight: Any) -> None:
        """Leave a surface in the direction of a BSDF sample with a weight."""
        # the next segment; what it meets is weighted by the vertex and the density here
        self.ray = si.spawn_ray(si.to_world(sample.wo))
        self.throughput *= weight
        self.eta *= sample.eta
        self.vertex = mi.Interaction3f(si)
        self.pdf = sample.pdf
        self.is_delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        self.depth = dr.select(si.is_valid(), self.depth + 1, self.depth)

    def survive(self, numbers: PathSamples, roulette_depth: int) -> None:
        """End paths by Russian roulette from a number of bounces on.

        As in Mitsuba's `path`, the probability to survive is the throughput times the
        square of the index of refraction. The throughput of a path that enters glass
        falls by that square, although no light is lost.
        """
        max_throughput = dr.max(self.throughput)  # over the color channels
        survival = dr.minimum(max_throughput * dr.square(self.eta), MAX_SURVIVAL)
        has_roulette = self.depth >= roulette_depth
        survives = ~has_roulette | (numbers.next_1d() < survival)
        # Where the survival is 0, this is NaN; such a path ends in the last line.
        self.throughput = dr.select(
            has_roulette, self.throughput * dr.rcp(survival), self.throughput
        )
        self.active &= survives & (max_throughput != 0.0)

    def list_channels(self) -> tuple[list[Any], list[Any]]:
        """Return the channels in two parts, which add up to those of the image.

        The first part does not depend on the changed surfaces, the second one does.
        Each has nine channels: radiance, albedo and normal.
        """
        guides = [*self.albedo, *self.normal]
        # A path that has met no changed surface has all its light in `radiance`, and
        # nothing in `radiance_before`.
        unchanged = [
            *dr.select(self.has_met, self.radiance_before, self.radiance),
            *(dr.select(self.has_met_first, 0.0, channel) for channel in guides),
        ]
        changing = [
            *dr.select(self.has_met, self.radiance, 0.0),
            *(dr.select(self.has_met_first, channel, 0.0) for channel in guides),
        ]
        return unchanged, changing


@dr.syntax  # type: ignore[untyped-decorator]
def trace_paths(
    scene: Any,
    ray: Any,
    numbers: PathSamples,
    changed_shapes: Sequence[Any],
    max_depth: int,
    roulette_depth: int,
) -> Any:
    """Trace radiance and guides of the denoiser, each in two parts that add up.

    Args:
        scene: scene without media and cut-outs, whose emitters are not hidden.
        ray: camera rays.
        numbers: random numbers of the paths.
        changed_shapes: shapes whose surfaces may have changed.
        max_depth: longest path in segments.
        roulette_depth: bounces from which on Russian roulette may end a path.

    Returns:
        Nine channels that do not depend on the changed surfaces: radiance, and albedo
        and shading normal of the first hit. Nine such channels that do. And whether
        each path has met a changed surface.
    """
    path = LightPath(ray)
    while dr.hint(path.active, max_iterations=max_depth, label="Paths of an image"):
        is_coherent = path.depth == 0  # camera rays, whose neighbors are similar
        si = scene.ray_intersect(path.ray, mi.RayFlags.All, is_coherent)
        bsdf = si.bsdf(path.ray)
        path.add_emission(scene, si)
        path.meet(si, bsdf, changed_shapes)
        path.reflect(scene, si, bsdf, numbers, max_depth)
        path.survive(numbers, roulette_depth)
    unchanged, changing = path.list_channels()
    return unchanged, changing, path.has_met


def _is_among(shape: Any, changed: Sequence[Any]) -> Any:
    """Return whether each shape is one of several."""
    result = mi.Bool(False)
    for candidate in changed:
        result |= shape == mi.ShapePtr(candidate)
    return result


def _compute_weight(pdf: Any, other_pdf: Any) -> Any:
    """Return the power heuristic's weight of a sample (Veach 1997, section 9.2)."""
    square = pdf * pdf
    weight = square / dr.fma(other_pdf, other_pdf, square)
    return dr.detach(dr.select(dr.isfinite(weight), weight, 0.0))
