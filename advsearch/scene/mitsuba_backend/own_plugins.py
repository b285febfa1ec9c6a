"""Custom Mitsuba plugins: a path tracer for haze, denoiser guides, a camera with a
lens.

Import this only where a Mitsuba scene is built: it registers the plugins, which needs
the variant that `variant.mitsuba` sets.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from advsearch.scene.assets import Float32Array, Float64Array, IntArray
from advsearch.scene.backdrop import compute_refractive_index
from advsearch.scene.camera_model import NUMBER_NAMES, CameraModel
from advsearch.scene.mitsuba_backend.variant import dr, mi

# Raindrops on a sheet of glass before the camera: small lenses that refract rays.
#
# A drop is a spherical cap of water on the outer side of the sheet. A camera ray in
# direction d meets the sheet at DISTANCE, shifted by its position in the aperture (the
# camera is focused far away, so that drops are blurred as in a photograph). It is
# refracted into the water (Snell's law; the sheet itself is plane and changes no
# direction) and out of it at the cap, or is lost where it would be totally reflected.
# Where caps overlap, the higher one counts. The transmittance is Fresnel's for
# unpolarized light (Born and Wolf, Principles of Optics, section 1.5).
#
# Only directions change: the scene is taken to be far away compared to the sheet.

WATER_IOR = 1.33  # index of refraction
SHEET_DISTANCE = 60.0  # distance of the sheet from the camera, millimeters
APERTURE_RADIUS = 1.0  # radius of the camera's aperture, millimeters
# range of angles between a drop's surface and the glass at its rim, degrees
CONTACT_ANGLES = (25.0, 42.0)
LOG_RADIUS_SPREAD = 0.45  # standard deviation of the logarithm of radii
# width of the square with drops divided by the width that the camera sees of the sheet
SHEET_WIDTH_FACTOR = 1.1
GRID_SIZE = 1024  # cells along each side of the grid that holds the drop of a position


def sample_raindrops(
    count: int, size: float, seed: int, tangent: float
) -> tuple[float, Float32Array, IntArray]:
    """Sample raindrops on a square of the glass sheet before a camera.

    Args:
        count: number of drops.
        size: median radius of a drop on the sheet, millimeters.
        seed: seed of the positions and radii.
        tangent: tangent of half the camera's field of view along its larger side.

    Returns:
        Half the width of the square, millimeters; the camera looks at its center.
        (count, 4) float32, for each drop the x and y of its center, its radius on the
        sheet and the radius of its curvature, millimeters.
        (GRID_SIZE, GRID_SIZE) index of the drop that is highest at the center of each
        cell of the square, rows along y; `count` where there is none.
    """
    random = np.random.default_rng(seed)
    half_visible_width = SHEET_DISTANCE * tangent
    half_width = SHEET_WIDTH_FACTOR * half_visible_width
    centers = random.uniform(-half_width, half_width, (count, 2))
    # The logarithm of a radius is normal; the limit leaves out huge and tiny drops.
    log_factors = LOG_RADIUS_SPREAD * random.standard_normal(count).clip(-2.5, 2.5)
    radii = size * np.exp(log_factors)
    contact_angles = np.radians(random.uniform(*CONTACT_ANGLES, count))
    curvature_radii = radii / np.sin(contact_angles)
    drops = np.column_stack([centers, radii, curvature_radii])
    highest_drop = _find_highest_drops(drops, half_width)
    return half_width, drops.astype(np.float32), highest_drop


def _compute_cap_height(
    distance_squared: Float64Array, radius: float, curvature_radius: float
) -> Float64Array:
    """Return the height of a drop's surface over the sheet, in millimeters.

    A drop is the cap that the sheet cuts off a sphere. The height is negative outside
    of the drop's circle; callers mask that.

    Args:
        distance_squared: squared distances of points on the sheet from the drop's
            center.
        radius: radius of the drop's circle on the sheet.
        curvature_radius: radius of the sphere.
    """
    # Both heights are measured from the center of the sphere.
    cut_height = math.sqrt(curvature_radius**2 - radius**2)
    sphere_height = np.sqrt(np.maximum(curvature_radius**2 - distance_squared, 0.0))
    return np.asarray(sphere_height - cut_height)


def _find_highest_drops(drops: Float64Array, half_width: float) -> IntArray:
    """Return the index (GRID, GRID) of the highest drop at the center of each cell.

    Rows are along y. A cell without a drop has the index `count`.

    Args:
        drops: (count, 4) x and y of each drop's center, its radius on the sheet, and
            the radius of its curvature, millimeters.
        half_width: half the width of the grid, which is around 0, millimeters.
    """
    # coordinates of the cells' centers, the same for x and y
    cell_centers = (
        np.arange(GRID_SIZE) + 0.5
    ) / GRID_SIZE * 2.0 * half_width - half_width
    highest_drop = np.full((GRID_SIZE, GRID_SIZE), len(drops))  # no drop
    max_height = np.zeros((GRID_SIZE, GRID_SIZE))
    for index, drop in enumerate(drops):
        _put_drop(highest_drop, max_height, cell_centers, index, drop)
    return highest_drop


def _put_drop(
    highest_drop: IntArray,
    max_height: Float64Array,
    cell_centers: Float64Array,
    index: int,
    drop: Float64Array,
) -> None:
    """Put a drop into a grid where it is higher than the drops so far.

    Args:
        highest_drop: (GRID, GRID) index of the highest drop so far; is changed.
        max_height: (GRID, GRID) its height, millimeters, 0 without one; is changed.
        cell_centers: (GRID,) coordinates of the cells' centers, the same for x and y.
        index: index of the drop.
        drop: (4,) x, y, radius on the sheet, and radius of curvature.
    """
    x, y, radius, curvature_radius = drop
    # only the cells in the square around the drop are computed
    rows = np.flatnonzero(np.abs(cell_centers - y) <= radius)
    columns = np.flatnonzero(np.abs(cell_centers - x) <= radius)
    dy = cell_centers[rows] - y
    dx = cell_centers[columns] - x
    distance_squared = dy[:, None] ** 2 + dx[None] ** 2
    height = _compute_cap_height(distance_squared, radius, curvature_radius)
    cells = np.ix_(rows, columns)
    is_higher = (distance_squared < radius**2) & (height > max_height[cells])
    highest_drop[cells] = np.where(is_higher, index, highest_drop[cells])
    max_height[cells] = np.where(is_higher, height, max_height[cells])


common: Any = mi.ad.integrators.common
PRBIntegrator: Any = mi.ad.integrators.prb.PRBIntegrator
PLANE_SHAPE = "ground"  # Mitsuba's id of the plane that receives the shadow
COAT_FRACTION = 0.5  # fraction of the paths from a coated plane that leave its coat
MIN_DENSITY = 1e-20  # smallest density to divide by, per steradian
ISOTROPIC_PHASE = 1.0 / (4.0 * math.pi)  # isotropic phase function, per steradian
MIN_EXTINCTION = 1e-20  # smallest extinction to divide by
MAX_SCATTERINGS = 8
"""Largest number of scatterings in the haze along a path.

They do not count as bounces off surfaces, so that haze of density 0 changes nothing. If
the haze's optical radius is 1.2, the light of longer paths is below 1 %.
"""


class HazePath(common.RBIntegrator):  # type: ignore[misc]
    """Trace paths through a uniform haze in a ball around the scene, with an adjoint.

    It is the integrator `advsearch_haze`:

        L(x, w) = e^(-s l) L_o + integral_0^l s a e^(-s t) L_i(x + t w) dt
        L_i = mean of L over the sphere of directions

    with extinction s (grey, per object size), single-scattering albedo a (per channel),
    l the length of the segment inside the ball, and L_o what leaves the next surface or
    comes from outside. Distances are sampled in proportion to `s e^(-s t)`, the
    transmittance of the haze towards emitters is exact, and the derivative is path
    replay backpropagation (Vicini et al. 2021, Path Replay Backpropagation, sections 4
    and 5) with detached samples.

    Mitsuba's `prbvolpath` cannot be used: it starts every path outside of all media, so
    that a camera inside haze sees none up to the first surface (its source has the note
    "TODO: support sensors inside media"). Since there is one uniform medium in one
    ball, no intersections with the ball's surface are traced either.

    Derivatives are right for the haze's color, for emission, for everything that
    surfaces look up, and for the density where it is greater than 0. There is no
    derivative by moving geometry.

    Attributes:
        haze: medium that fills the ball.
        radius: radius of the ball, which is around the origin.

    Properties in addition to those of `prb`: `medium`, a homogeneous medium with grey
    extinction, and `radius`, the radius of the ball.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.haze = props["medium"]
        self.radius = props["radius"]

    @dr.syntax  # type: ignore[untyped-decorator]
    def sample(
        self,
        mode: Any,
        scene: Any,
        sampler: Any,
        ray: Any,
        δL: Any,
        state_in: Any,
        active: Any,
        **rest: Any,
    ) -> Any:
        """Sample paths, or in the adjoint modes replay them and backpropagate.

        Each round of the loop is one event: the path meets a surface, leaves the scene,
        or is scattered in the haze. β is the throughput up to it, Le its emission, and
        Lr_dir the light of emitters that it reflects or scatters. L adds them up; in
        the adjoint modes it begins with the sum, so that what is left of it is the
        light of later events, and δL is the cotangent.

        The argument names and the letters are those of Mitsuba's `prb`.

        Args:
            mode: primal (trace the image) or an adjoint mode of Dr.Jit.
            scene, sampler: Mitsuba's scene and random numbers.
            ray: camera rays, one in each lane.
            δL: cotangent of the radiance, in the adjoint modes.
            state_in: the radiance of each path as the primal pass found it, in the
                adjoint modes.
            active: lanes that are traced.
            rest: further arguments of Mitsuba, which are not used.

        Returns:
            The radiance (or δL), whether anything was met, no further channels, and
            the state for the adjoint pass.
        """
        primal = mode == dr.ADMode.Primal
        context = mi.BSDFContext()

        ray = mi.Ray3f(dr.detach(ray))
        bounces = mi.UInt32(0)
        scatterings = mi.UInt32(0)
        L = mi.Spectrum(0 if primal else state_in)
        δL = mi.Spectrum(δL if δL is not None else 0)
        β = mi.Spectrum(1)
        active = mi.Bool(active)
        # The event before. The camera counts as one with a single direction: it cannot
        # sample emitters, so the emission of the first hit has all the weight.
        prev = dr.zeros(mi.Interaction3f)
        prev_pdf = mi.Float(1)
        prev_delta = mi.Bool(True)

        max_events = self.max_depth + MAX_SCATTERINGS
        while dr.hint(
            active, max_iterations=max_events, label=f"Haze path ({mode.name})"
        ):
            # ---- the next event: a surface, the outside, or the haze before it
            is_first = bounces + scatterings == 0
            si = self._intersect(scene, ray, is_first, active)
            haze_start, haze_length = self._find_haze_segment(ray.o, ray.d, si.t)
            with dr.resume_grad(when=not primal):
                scattered, flight, weight, albedo, extinction = self._sample_flight(
                    sampler, haze_length, active
                )
            # Distances are sampled in proportion to the extinction times the
            # transmittance, so that only the albedo remains as a factor.
            β = dr.select(scattered, β * albedo, β)
            at_surface = active & ~scattered
            event = _make_event(ray, si, scattered, haze_start + flight)

            # ---- emission of the surface or of the outside
            active_e = at_surface
            if dr.hint(self.hide_emitters, mode="scalar"):
                # the camera does not see what is outside
                active_e = at_surface & ~(is_first & ~si.is_valid())
            ds = mi.DirectionSample3f(scene, si, prev)
            mis = common.mis_weight(
                prev_pdf, scene.pdf_emitter_direction(prev, ds, active_e & ~prev_delta)
            )
            with dr.resume_grad(when=not primal):
                Le = β * mis * ds.emitter.eval(si, active_e)

            # ---- direct light of emitters, through the haze
            may_bounce = si.is_valid() & (bounces + 1 < self.max_depth)
            may_scatter = scatterings < MAX_SCATTERINGS
            active_next = active & (
                (scattered & may_scatter) | (~scattered & may_bounce)
            )
            at_surface &= active_next
            bsdf = si.bsdf(ray)
            active_em = active_next & (
                scattered | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            )
            ds_em, em_weight, em_haze_length, active_em = self._sample_emitter(
                scene, sampler, event, active_em, primal
            )
            with dr.resume_grad(when=not primal):
                mis_value_em = _eval_towards_emitter(
                    bsdf, si, ds_em, scattered, active_em & at_surface, β
                )
                transmittance = dr.exp(-extinction * em_haze_length)
                Lr_dir = dr.select(
                    active_em, mis_value_em * em_weight * transmittance, 0.0
                )

            # ---- the direction in which the path goes on
            bsdf_sample, bsdf_weight = bsdf.sample(
                context, si, sampler.next_1d(), sampler.next_2d(), at_surface
            )
            scattered_direction = mi.warp.square_to_uniform_sphere(sampler.next_2d())
            direction = dr.select(
                scattered, scattered_direction, si.to_world(bsdf_sample.wo)
            )
            L = (L + Le + Lr_dir) if primal else (L - Le - Lr_dir)
            β = dr.select(scattered, β, β * bsdf_weight)
            active_next &= dr.max(β) != 0.0

            # ---- derivatives
            if dr.hint(not primal, mode="scalar"):
                with dr.resume_grad():
                    # the light of later events, as it depends on this one's surface
                    reflected = bsdf.eval(
                        context, si, bsdf_sample.wo, active_next & at_surface
                    )
                    L_further = dr.select(
                        at_surface, L * dr.relative_grad(reflected), L
                    )
                    # all of it depends on the flight through the haze
                    Lo = (Le + Lr_dir + L_further) * dr.relative_grad(weight)
                    if dr.hint(dr.grad_enabled(Lo), mode="scalar"):
                        dr.backward_from(δL * Lo)

            ray = event.spawn_ray(direction)
            prev = event
            prev_pdf = dr.select(scattered, ISOTROPIC_PHASE, bsdf_sample.pdf)
            prev_delta = ~scattered & mi.has_flag(
                bsdf_sample.sampled_type, mi.BSDFFlags.Delta
            )
            scatterings[scattered] += 1
            bounces[~scattered & si.is_valid()] += 1
            active = active_next

        return (L if primal else δL, bounces + scatterings != 0, [], L)

    def _intersect(self, scene: Any, ray: Any, is_first: Any, active: Any) -> Any:
        """Return Mitsuba's surface interaction of what a ray hits first.

        Where the integrator hides emitters, a ray from the camera goes on through the
        surfaces that emit, and hits what is behind them.

        Args:
            scene: Mitsuba's scene.
            ray: the rays, one in each lane.
            is_first: whether a ray comes from the camera.
            active: lanes that are traced.
        """
        si = scene.ray_intersect(ray, mi.RayFlags.All, is_first, active)
        if self.hide_emitters:
            is_emitter = si.shape.emitter() != None  # noqa: E711 (for each lane)
            skipped = active & is_first & si.is_valid() & is_emitter
            behind_ray = si.spawn_ray(ray.d)
            is_coherent = True
            next_hit = self.skip_area_emitters(scene, behind_ray, is_coherent, skipped)
            # The haze in front of the skipped surface counts, too. So the hit becomes
            # one of the camera's ray: its distance is measured from the camera.
            next_hit.t += si.t
            si[skipped] = next_hit.compute_surface_interaction(
                ray, mi.RayFlags.All, skipped
            )
        return si

    def _find_haze_segment(
        self, origin: Any, direction: Any, max_distance: Any
    ) -> tuple[Any, Any]:
        """Find where a segment is in the haze, a ball around the coordinates' origin.

        Args:
            origin, direction: origin and direction of the segment; the direction has
                length 1.
            max_distance: length of the segment.

        Returns:
            The distance at which the haze begins, and the length in it, 0 if there is
            none.
        """
        # along the ray, where it is nearest to the center of the ball
        closest_distance = -dr.dot(origin, direction)
        # half the length in the ball, 0 where the ray passes it
        half_chord = dr.sqrt(
            dr.maximum(
                dr.square(closest_distance) - dr.squared_norm(origin) + self.radius**2,
                0.0,
            )
        )
        start = dr.maximum(closest_distance - half_chord, 0.0)
        end = dr.minimum(closest_distance + half_chord, max_distance)
        return start, dr.maximum(end - start, 0.0)

    def _sample_flight(
        self, sampler: Any, haze_length: Any, active: Any
    ) -> tuple[Any, Any, Any, Any, Any]:
        """Sample how far light flies through the haze before it is scattered.

        Args:
            sampler: Mitsuba's random numbers.
            haze_length: length of the segment inside the haze.
            active: lanes that are traced.

        Returns:
            Whether it is scattered within the haze; the distance; a weight, attached to
            the haze's parameters; the detached albedo per channel; and the extinction,
            which is grey.

            The weight is the integrand of the flight: transmittance, times scattering
            coefficient if light is scattered. It is not divided by the sampling
            density, since callers use only its relative gradient (`dr.relative_grad`).
        """
        scattering, _, extinction = self.haze.get_scattering_coefficients(
            dr.zeros(mi.MediumInteraction3f)
        )
        extinction = extinction[0]  # grey: all channels are equal
        # Invert the distribution 1 - exp(-extinction distance). `MIN_EXTINCTION` avoids
        # a division by 0: a haze of extinction 0 scatters very far away.
        flight = -dr.log(1.0 - sampler.next_1d()) / dr.maximum(
            dr.detach(extinction), MIN_EXTINCTION
        )
        scattered = active & (flight < haze_length)
        transmittance = dr.exp(-extinction * dr.minimum(flight, haze_length))
        weight = dr.select(scattered, scattering * transmittance, transmittance)
        albedo = dr.detach(scattering) / dr.maximum(
            dr.detach(extinction), MIN_EXTINCTION
        )
        return scattered, flight, weight, albedo, extinction

    def _sample_emitter(
        self, scene: Any, sampler: Any, event: Any, active: Any, primal: bool
    ) -> tuple[Any, Any, Any, Any]:
        """Sample a direction to an emitter from an event of the path.

        Args:
            scene, sampler: Mitsuba's scene and random numbers.
            event: the event, at a surface or in the haze.
            active: lanes that are sampled.
            primal: whether no derivatives are needed.

        Returns:
            Mitsuba's direction sample; radiance over density, attached to the emitter's
            parameters if not `primal`; the length of the haze in between; and in which
            lanes there is a sample.
        """
        ds, weight = scene.sample_emitter_direction(
            event, sampler.next_2d(), test_visibility=True, active=active
        )
        active = active & (ds.pdf != 0.0)
        # Towards the environment the haze goes on up to the border of the ball. There
        # `ds.dist` is only a distance outside of the scene.
        is_environment = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        distance = dr.select(is_environment, dr.inf, ds.dist)
        _, haze_length = self._find_haze_segment(event.p, ds.d, distance)
        if not primal:
            weight = _attach_sampled_light(scene, event, ds, weight, active)
        return ds, weight, haze_length, active


def _attach_sampled_light(
    scene: Any, event: Any, ds: Any, weight: Any, active: Any
) -> Any:
    """Return the weights of emitter samples, attached to the emitters' parameters.

    A sampled weight has no gradient. The emitter is evaluated again with gradients; the
    value stays that of the sample.

    Args:
        scene: Mitsuba's scene.
        event: the event from which the emitters were sampled.
        ds: Mitsuba's direction sample.
        weight: radiance over density of the sample.
        active: lanes in which there is a sample.
    """
    with dr.resume_grad():
        radiance = scene.eval_emitter_direction(event, ds, active)
        inverse_density = dr.select(active, dr.rcp(ds.pdf), 0.0)
        return dr.replace_grad(weight, radiance * inverse_density)


def _eval_towards_emitter(
    bsdf: Any, si: Any, ds: Any, scattered: Any, active: Any, throughput: Any
) -> Any:
    """Return throughput times MIS weight times value of an event towards an emitter.

    The value is that of the phase function where light is `scattered` in the haze, else
    that of the BSDF.

    Args:
        bsdf, si: the BSDF and the interaction of the surface.
        ds: the direction sample of the emitter.
        scattered: where the event is in the haze.
        active: lanes at a surface in which the BSDF is evaluated; elsewhere its value
            is 0, unless light is scattered.
        throughput: throughput of the path up to the event.
    """
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
    # The phase function is sampled exactly: its value is its density.
    value = dr.select(scattered, ISOTROPIC_PHASE, value)
    pdf = dr.select(scattered, ISOTROPIC_PHASE, pdf)
    # no scattered ray can meet a point light by chance: its sample has all the weight
    mis = dr.select(ds.delta, 1.0, common.mis_weight(ds.pdf, pdf))
    return throughput * mis * value


def _make_event(ray: Any, si: Any, scattered: Any, distance: Any) -> Any:
    """Return the interaction of one event of a path.

    Args:
        ray: the segment that leads to the event.
        si: the surface interaction at its end.
        scattered: whether the event is a scattering in the haze before that.
        distance: distance of that scattering along the ray.
    """
    event = dr.zeros(mi.Interaction3f)
    event.t = dr.select(scattered, distance, si.t)
    event.p = dr.select(scattered, ray(distance), si.p)
    # without a normal, no offset is added to rays that start in the haze
    event.n = dr.select(scattered, mi.Normal3f(0.0), si.n)
    event.time = ray.time
    event.wavelengths = ray.wavelengths
    return event


mi.register_integrator("advsearch_haze", lambda props: HazePath(props))


class _Coat:
    """A rough, clear coat (GGX, Walter et al. 2007) without color.

    Args:
        reflectance: reflectance at a right angle, in [0, 1]. At other angles it follows
            Fresnel's equations.
        roughness: square root of the distribution's width, in [0, 1].
    """

    def __init__(self, reflectance: float, roughness: float) -> None:
        """Convert the reflectance at a right angle to an index of refraction."""
        self._index = compute_refractive_index(reflectance)
        self._alpha = roughness**2

    def sample(self, incident: Any, point: Any) -> Any:
        """Sample a direction of light; all directions are local, z is the normal.

        `evaluate` returns the density of a direction.

        Args:
            incident: unit direction to the viewer.
            point: two random numbers.
        """
        normal, _normal_density = self._make_distribution().sample(incident, point)
        return mi.reflect(incident, normal)

    def evaluate(self, incident: Any, direction: Any) -> tuple[Any, Any]:
        """Return the reflected fraction times the cosine, and the density of `sample`.

        Args:
            incident: unit direction to the viewer.
            direction: unit direction to the light.
        """
        # The microfacet model: F D G / (4 cos_i cos_o) times cos_o, with the half
        # vector as the normal of the facets that reflect (Walter et al. 2007, eq. 20).
        half = dr.normalize(incident + direction)
        cosine = dr.dot(incident, half)
        is_above = (incident.z > 0.0) & (direction.z > 0.0) & (cosine > 0.0)
        distribution = self._make_distribution()
        value = mi.fresnel(cosine, self._index)[0] * distribution.eval(half)
        value *= distribution.G(incident, direction, half) / (4.0 * incident.z)
        density = distribution.pdf(incident, half) / (4.0 * cosine)
        return dr.select(is_above, value, 0.0), dr.select(is_above, density, 0.0)

    def _make_distribution(self) -> Any:
        return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self._alpha)


class _PlaneHits:
    """Camera rays that meet the plane first, and where their paths go on.

    The plane stands for ground in a photograph, which already contains the light of the
    environment. What is computed is the change of the ground's radiance by the objects
    and lamps in the scene, in one or three quantities of three channels each:

        0. the change of the light that the matt ground reflects
        1. with a coat, the change of the light that the coat reflects
        2. with a coat, the light that the coat reflects of the environment if no object
           hides any of it

    Args:
        scene, sampler: Mitsuba's scene and random numbers.
        ray: camera rays.
        active: lanes that are traced.
        coat: coat of the plane; None if it is matt.

    Attributes:
        is_hit: whether a ray meets the plane first.
        direct_changes: for each quantity its part from blocked light of the environment
            and from lamps.
        weights: for each quantity the weight of the light that arrives along the next
            segment of the path, which other surfaces send to the plane.
        path_ray: next segment of a path that met the plane, as a ray. For a camera ray
            that did not, the camera ray itself.
        is_traced: whether `path_ray` has to be traced.
    """

    def __init__(
        self, scene: Any, sampler: Any, ray: Any, active: Any, coat: _Coat | None
    ) -> None:
        """Intersect camera rays with the plane, and sample what it does to the light.

        Args:
            scene, sampler: Mitsuba's scene and random numbers.
            ray: camera rays.
            active: lanes that are traced.
            coat: coat of the plane; None if it is matt.
        """
        self._intersect_plane(scene, ray, active)
        self._coat = coat
        # The reflectance of the matt part. What a coat takes from it is left out: the
        # changes are used as ratios to the plane's radiance, in which it cancels.
        self._albedo = self._si.bsdf().eval_diffuse_reflectance(self._si, self.is_hit)
        # The call also sets `_factors`, one for each quantity of the class.
        light = self._sample_emitter(scene, sampler)
        self.direct_changes = [
            dr.select(self.is_hit, factor * light, 0.0) for factor in self._factors
        ]
        self._continue_path(scene, sampler, ray, active)

    def _intersect_plane(self, scene: Any, ray: Any, active: Any) -> None:
        """Set where camera rays meet the plane first, `is_hit` and `_si`."""
        plane = next(shape for shape in scene.shapes() if shape.id() == PLANE_SHAPE)
        hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        self.is_hit = active & hit.is_valid() & (hit.shape == mi.ShapePtr(plane))
        self._si = hit.compute_surface_interaction(ray, mi.RayFlags.All, self.is_hit)

    def _continue_path(self, scene: Any, sampler: Any, ray: Any, active: Any) -> None:
        """Sample where paths go on, and set `weights`, `path_ray` and `is_traced`.

        With a coat this also adds to `direct_changes`. The arguments are those of the
        class.
        """
        # The random number is drawn even without a coat, where it has no effect.
        leaves_coat = sampler.next_1d() < COAT_FRACTION
        # The density is in proportion to the cosine, so that the weight of a path from
        # the matt ground is its albedo alone.
        direction = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        self.weights = [self._albedo]
        is_bounced = direction.z > 0.0
        if self._coat is not None:
            direction, is_bounced = self._choose_bounce(
                self._coat, direction, leaves_coat, sampler
            )
        bounced_ray = self._si.spawn_ray(self._si.to_world(direction))
        self.path_ray = dr.select(self.is_hit, bounced_ray, ray)
        self.is_traced = active & (~self.is_hit | is_bounced)
        if self._coat is not None:
            self._reflect_environment(scene, self._coat, direction)

    def _sample_emitter(self, scene: Any, sampler: Any) -> Any:
        """Sample an emitter from the plane, and return its radiance over the density.

        This also sets `_factors`, by which that radiance is multiplied for each of the
        quantities: the change of the matt ground, and with a coat also the change of
        the coat and the environment in it. A factor is the fraction of the light that
        is reflected. For the two changes it has a sign, see `_find_light_signs`.
        """
        si = self._si
        ds, light = scene.sample_emitter_direction(
            si, sampler.next_2d(), test_visibility=False, active=self.is_hit
        )
        is_sampled = self.is_hit & (ds.pdf != 0.0)
        is_environment = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        sign = self._find_light_signs(scene, ds.p, is_sampled, is_environment)
        direction = si.to_local(ds.d)
        matt_fraction = self._albedo * dr.inv_pi * dr.maximum(direction.z, 0.0)
        self._emitter_sample = ds
        self._factors = [dr.select(is_sampled, sign * matt_fraction, 0.0)]
        if self._coat is not None:
            self._factors += self._compute_coat_factors(
                self._coat, direction, sign, is_sampled, is_environment
            )
        return light

    def _find_light_signs(
        self, scene: Any, light_point: Any, is_sampled: Any, is_environment: Any
    ) -> Any:
        """Return the sign with which the light of each sample changes the photograph.

        - Light of the environment is already in the photograph: -1 where something
          blocks it, else 0.
        - Light of a lamp is not: 1, or 0 where something blocks it.

        Args:
            scene: Mitsuba's scene.
            light_point: sampled points on the emitters.
            is_sampled: lanes in which there is a sample.
            is_environment: lanes whose emitter is the environment.
        """
        ray = self._si.spawn_ray_to(light_point)
        is_blocked = scene.ray_test(ray, is_sampled)
        visibility = dr.select(is_blocked, 0.0, 1.0)
        return dr.select(is_environment, visibility - 1.0, visibility)

    def _compute_coat_factors(
        self,
        coat: _Coat,
        direction: Any,
        sign: Any,
        is_sampled: Any,
        is_environment: Any,
    ) -> list[Any]:
        """Return the factors of an emitter sample's light for both quantities of the
        coat.

        Args:
            coat: coat of the plane.
            direction: local direction to the emitter.
            sign: sign of the change, see `_find_light_signs`.
            is_sampled: lanes in which there is a sample.
            is_environment: lanes whose emitter is the environment.
        """
        density = self._emitter_sample.pdf
        coat_fraction = self._compute_coat_fraction(
            coat, direction, density, is_environment
        )
        change = dr.select(is_sampled, sign * coat_fraction, 0.0)
        environment = dr.select(is_sampled & is_environment, coat_fraction, 0.0)
        return [mi.Color3f(change), mi.Color3f(environment)]

    def _compute_coat_fraction(
        self, coat: _Coat, direction: Any, emitter_density: Any, is_environment: Any
    ) -> Any:
        """Return the fraction of an emitter sample's light that the coat reflects.

        A path that leaves from the coat finds the same light of the environment
        (`_reflect_environment`). Its density is `COAT_FRACTION`, the probability of
        such a path, times that of the direction. Each of the two samples is weighted by
        its fraction of both densities, the balance heuristic (Veach 1997). A path
        cannot meet a lamp, whose sample counts in full.

        Args:
            coat: coat of the plane.
            direction: local direction to the emitter.
            emitter_density: density of the emitter sample.
            is_environment: lanes in which the emitter is the environment.
        """
        fraction, coat_density = coat.evaluate(self._si.wi, direction)
        mis_weight = emitter_density / (emitter_density + COAT_FRACTION * coat_density)
        return fraction * dr.select(is_environment, mis_weight, 1.0)

    def _choose_bounce(
        self, coat: _Coat, matt_direction: Any, leaves_coat: Any, sampler: Any
    ) -> tuple[Any, Any]:
        """Choose whether a path goes on from the matt ground or from its coat.

        This sets `weights`, one for each quantity of the class. In each lane only the
        weight of the chosen bounce is not 0. It is divided by the probability of the
        choice.

        Args:
            coat: coat of the plane.
            matt_direction: local direction of a path from the matt ground.
            leaves_coat: lanes whose path goes on from the coat.
            sampler: Mitsuba's random numbers.

        Returns:
            The local direction of the path, and whether there is one.
        """
        reflected = coat.sample(self._si.wi, sampler.next_2d())
        value, density = coat.evaluate(self._si.wi, reflected)
        is_reflected = density > 0.0
        coat_weight = dr.select(is_reflected, value / density, 0.0) / COAT_FRACTION
        matt_weight = self._albedo / (1.0 - COAT_FRACTION)
        self.weights = [
            dr.select(leaves_coat, 0.0, matt_weight),
            mi.Color3f(dr.select(leaves_coat, coat_weight, 0.0)),
            # The environment in the coat is that without objects: no light that other
            # surfaces send is in it.
            mi.Color3f(0.0),
        ]
        direction = dr.select(leaves_coat, reflected, matt_direction)
        is_bounced = dr.select(leaves_coat, is_reflected, matt_direction.z > 0.0)
        return direction, is_bounced

    def _reflect_environment(self, scene: Any, coat: _Coat, direction: Any) -> None:
        """Add the light of the environment that a bounce off the coat would meet.

        It is added to the environment in the coat (`direct_changes[2]`). Where an
        object blocks it, it is subtracted from the change of the coat
        (`direct_changes[1]`).

        The emitter sample finds the same light, see `_compute_coat_fraction`.

        Args:
            scene: Mitsuba's scene.
            coat: coat of the plane.
            direction: direction of the bounce, in the plane's local axes.
        """
        environment = scene.environment()
        ds = self._make_bounce_sample(environment)
        is_bounced = self.is_hit & self.is_traced
        mis_weight = self._weigh_bounce(scene, coat, direction, ds)
        light = environment.eval(self._make_escaped(ds.d), is_bounced)
        # `weights[1]` is 0 in lanes where the path leaves the matt ground.
        reflected = self.weights[1] * mis_weight * light
        reflected = dr.select(is_bounced, reflected, 0.0)
        is_blocked = scene.ray_test(self.path_ray, is_bounced)
        self.direct_changes[1] -= dr.select(is_blocked, reflected, 0.0)
        self.direct_changes[2] += reflected

    def _make_bounce_sample(self, environment: Any) -> Any:
        """Return a direction sample of the environment along the next segment."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = self.path_ray.d
        ds.emitter = mi.EmitterPtr(environment)
        return ds

    def _weigh_bounce(self, scene: Any, coat: _Coat, direction: Any, ds: Any) -> Any:
        """Return the MIS weight of a bounce off the coat against samples at emitters.

        Args:
            scene: Mitsuba's scene.
            coat: coat of the plane.
            direction: direction of the bounce, in the plane's local axes.
            ds: the same as a direction sample of the environment.
        """
        is_bounced = self.is_hit & self.is_traced
        _value, coat_density = coat.evaluate(self._si.wi, direction)
        density = COAT_FRACTION * coat_density
        both_densities = density + scene.pdf_emitter_direction(self._si, ds, is_bounced)
        return density / dr.maximum(both_densities, MIN_DENSITY)

    def _make_escaped(self, direction: Any) -> Any:
        """Return the interaction of rays in a direction that leave the scene."""
        escaped = dr.zeros(mi.SurfaceInteraction3f)
        escaped.wi = -direction
        escaped.wavelengths = self._si.wavelengths
        return escaped

    def list_changes(self, path_radiance: Any) -> list[Any]:
        """Return the one or three quantities of the class, three channels each.

        They are the direct changes, and the light that other surfaces send to the
        plane.

        Args:
            path_radiance: radiance that arrives along the path's next segment.
        """
        channels: list[Any] = []
        for weight, change in zip(self.weights, self.direct_changes, strict=True):
            full_change = weight * path_radiance + change
            channels.extend(dr.select(self.is_hit, full_change, 0.0))
        return channels

    def backpropagate(self, scene: Any, cotangents: list[Any]) -> Any:
        """Add the derivatives of the direct changes by the lights' parameters.

        The emitter sample is evaluated again with gradients. The light of the
        environment that a bounce meets has no derivative, since the environment of a
        photograph is fixed.

        Args:
            scene: Mitsuba's scene.
            cotangents: cotangents of the channels that `list_changes` returns.

        Returns:
            The cotangent of the path's radiance.
        """
        ds = self._emitter_sample
        is_sampled = self.is_hit & (ds.pdf != 0.0)
        with dr.resume_grad():
            light = scene.eval_emitter_direction(self._si, ds, is_sampled)
            light *= dr.select(is_sampled, dr.rcp(ds.pdf), 0.0)
        path_cotangent = mi.Spectrum(0.0)
        # one factor and one weight for each quantity of the class
        for index, factor in enumerate(self._factors):
            cotangent = mi.Spectrum(*cotangents[3 * index : 3 * index + 3])
            path_cotangent += self.weights[index] * cotangent
            with dr.resume_grad():
                change = cotangent * factor * light
                if dr.grad_enabled(change):
                    # Of the graph, only interior edges are cleared: the replay of the
                    # path still needs those at the lights' parameters.
                    dr.backward_from(change, dr.ADFlag.ClearInterior)
        return path_cotangent


class PhotographPath(PRBIntegrator):  # type: ignore[misc]
    """Trace paths for a scene that is rendered into a photograph, with an adjoint.

    It is the integrator `advsearch_photograph`. The shape `ground` is a plane that
    receives shadows, and is itself invisible. Where a camera ray meets it first, three
    more channels contain the change of the plane's radiance by everything else in the
    scene but the environment:

        - light of the environment that is blocked + light of lamps
        + light that other surfaces send to the plane

    The change is exactly zero where nothing blocks or sends light, so that the
    photograph there stays as it is, without noise. Other surfaces see the plane as any
    other surface.

    With a `reflectance` above 0 (and a `roughness`) the plane has a clear coat. Then
    six further channels contain the same change of the light that the coat reflects,
    and the environment in the coat without the object. Other surfaces see the plane's
    own plugin, which may differ.

    The derivative is that of `prb` for the rest of the path.
    """

    def __init__(self, props: Any) -> None:
        """Read the coat; `props` are Mitsuba's."""
        super().__init__(props)
        reflectance = props.get("reflectance", 0.0)
        roughness = props.get("roughness", 1.0)
        self.coat = _Coat(reflectance, roughness) if reflectance > 0.0 else None

    def sample(
        self,
        mode: Any,
        scene: Any,
        sampler: Any,
        ray: Any,
        δL: Any,
        state_in: Any,
        active: Any,
        δaovs: Any = None,
        **rest: Any,
    ) -> Any:
        """Sample paths of light, or in the adjoint modes replay them.

        Most work is done by the `sample` of the base class, `prb`. It traces a camera
        ray that does not meet the plane first. If a ray does, it traces the path that
        goes on from the plane. The radiance of that path is part of the further
        channels, see `_PlaneHits.list_changes`, and the color of the ray is 0.

        Args:
            mode: primal (trace the image) or an adjoint mode of Dr.Jit.
            scene, sampler: Mitsuba's scene and random numbers.
            ray: camera rays.
            δL: cotangent of the radiance, in the adjoint modes.
            state_in: what the primal pass returned last, in the adjoint modes.
            active: lanes that are traced.
            δaovs: cotangents of the further channels, in the adjoint modes.
            rest: further arguments, which go on to Mitsuba's `prb`.

        Returns:
            The color, whether a ray hits anything but the plane, the further channels,
            and the state for the adjoint pass.
        """
        camera_ray = mi.Ray3f(dr.detach(ray))
        plane = _PlaneHits(scene, sampler, camera_ray, mi.Bool(active), self.coat)
        if mode != dr.ADMode.Primal:
            # Where the plane is hit, the radiance that `prb` traces affects the further
            # channels only, whose cotangents are those of `δaovs`.
            path_cotangent = plane.backpropagate(scene, δaovs)
            δL = dr.select(plane.is_hit, path_cotangent, δL)
        L, valid, _channels, state_out = super().sample(
            mode=mode,
            scene=scene,
            sampler=sampler,
            ray=plane.path_ray,
            δL=δL,
            state_in=state_in,
            active=plane.is_traced,
            **rest,
        )
        color = dr.select(plane.is_hit, 0.0, L)
        return color, valid & ~plane.is_hit, plane.list_changes(L), state_out

    def sample_rays(self, scene: Any, sensor: Any, sampler: Any, **rest: Any) -> Any:
        """Return rays, weights and positions, with weights of one channel.

        Mitsuba's weights have three channels. `render_backward` of Mitsuba 3.9.1
        multiplies each further channel, a plain number, by them, which fails. The
        weights of our cameras are equal in all channels.
        """
        ray, weight, position = super().sample_rays(scene, sensor, sampler, **rest)
        return ray, mi.Float(weight[0]), position

    def aov_names(self) -> list[str]:
        names = ["plane"]
        if self.coat is not None:
            names += ["coat", "environment"]
        return [f"{name}.{channel}" for name in names for channel in "RGB"]


mi.register_integrator("advsearch_photograph", lambda props: PhotographPath(props))


class Guides(mi.SamplingIntegrator):  # type: ignore[misc]
    """Render the guides of the denoiser: diffuse reflectance and shading normal.

    It is the integrator `advsearch_guides`. Each guide has three channels, of the first
    hit that light does not pass. Mitsuba's `aov` uses the very first hit: then the
    guides would contain the outlines of cut-out surfaces.
    """

    @dr.syntax  # type: ignore[untyped-decorator]
    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> Any:
        """Return color, coverage and further channels of camera rays.

        Mitsuba expects a color, which is the reflectance here. The further channels are
        the guides: the reflectance again, and the normal. A ray goes on through a
        surface with the probability with which light passes it.

        Args:
            scene, sampler: Mitsuba's scene and random numbers.
            ray: camera rays.
            medium: Mitsuba's argument, which is not used.
            active: lanes that are traced.
        """
        active = mi.Bool(active)
        ray = mi.Ray3f(ray)
        is_covered = mi.Bool(False)
        albedo = mi.Spectrum(0.0)
        normal = mi.Normal3f(0.0)
        while active:
            si = scene.ray_intersect(ray, active)
            active &= si.is_valid()
            bsdf = si.bsdf()
            transmittance = dr.max(bsdf.eval_null_transmission(si, active))
            passes_through = active & (sampler.next_1d(active) < transmittance)
            is_stopped = active & ~passes_through
            albedo[is_stopped] = bsdf.eval_diffuse_reflectance(si, is_stopped)
            normal[is_stopped] = si.sh_frame.n
            is_covered |= is_stopped
            # the same direction from the hit on
            ray = si.spawn_ray(ray.d)
            active = passes_through
        return albedo, is_covered, [*albedo, *normal]

    def aov_names(self) -> list[str]:
        """Names of the channels after reflectance: of albedo and normal."""
        names = ("albedo", "normal")
        return [f"{name}.{channel}" for name in names for channel in "XYZ"]


mi.register_integrator("advsearch_guides", Guides)


MIN_CELLS = 128  # smallest number of cells along a side of the grid of ray directions
MAX_CELLS = 512  # largest number
# x and y of the center, radius and curvature radius. The radius below 0 marks that
# there is no drop.
NO_DROP = (0.0, 0.0, -1.0, 1.0)


def _compute_transmittance(
    cos_incident: Any, cos_refracted: Any, ior_incident: float, ior_refracted: float
) -> Any:
    """Return Fresnel's transmittance of unpolarized light between two media.

    It is 1 minus the mean reflectance of the two polarisations.

    Args:
        cos_incident, cos_refracted: cosines of the angles to the normal.
        ior_incident, ior_refracted: indices of refraction of the two media.
    """
    s_polarized = (ior_incident * cos_incident - ior_refracted * cos_refracted) / (
        ior_incident * cos_incident + ior_refracted * cos_refracted
    )
    p_polarized = (ior_refracted * cos_incident - ior_incident * cos_refracted) / (
        ior_refracted * cos_incident + ior_incident * cos_refracted
    )
    return 1.0 - 0.5 * (s_polarized * s_polarized + p_polarized * p_polarized)


def _refract_through_drop(
    direction: Any, dx: Any, dy: Any, drop: Any
) -> tuple[Any, Any, Any]:
    """Refract rays into a drop's flat side and out of its cap.

    Args:
        direction: unit direction before the drop.
        dx, dy: where the ray enters, from the drop's center, millimeters.
        drop: x and y of the center, radius on the sheet, and radius of the sphere of
            which the drop is a cap, as in `sample_raindrops`.

    Returns:
        The direction behind the drop, not normalized; the fraction of the light that
        passes; and whether the ray is lost by total reflection.
    """
    curvature_radius = drop.w

    inside_direction = _refract_into_water(direction)

    entry = _locate_entry(dx, dy, drop)
    exit_distance = _measure_path_in_drop(entry, inside_direction, curvature_radius)
    exit_point = entry + inside_direction * exit_distance
    normal = exit_point / curvature_radius  # of the cap, outwards

    cos_inside = dr.dot(inside_direction, normal)
    # Snell's law at the cap; below 0 is total reflection
    cos_outside_squared = 1.0 - WATER_IOR * WATER_IOR * (1.0 - cos_inside * cos_inside)
    cos_outside = dr.safe_sqrt(cos_outside_squared)
    outside_direction = (
        WATER_IOR * inside_direction + (cos_outside - WATER_IOR * cos_inside) * normal
    )
    transmitted = _compute_drop_transmittance(
        direction.z, inside_direction.z, cos_inside, cos_outside
    )
    # A ray that leaves the cap towards the sheet does not reach the scene.
    is_lost = (cos_outside_squared <= 0.0) | (outside_direction.z <= 0.0)
    return outside_direction, transmitted, is_lost


def _compute_drop_transmittance(
    cos_before: Any, cos_entered: Any, cos_inside: Any, cos_outside: Any
) -> Any:
    """Return the fraction of the light that passes both surfaces of a drop.

    Args:
        cos_before, cos_entered: cosines at the flat side, outside and inside.
        cos_inside, cos_outside: cosines at the cap.
    """
    transmitted = _compute_transmittance(
        cos_incident=cos_before,
        cos_refracted=cos_entered,
        ior_incident=1.0,
        ior_refracted=WATER_IOR,
    )
    transmitted *= _compute_transmittance(
        cos_incident=cos_inside,
        cos_refracted=cos_outside,
        ior_incident=WATER_IOR,
        ior_refracted=1.0,
    )
    return transmitted


def _refract_into_water(direction: Any) -> Any:
    """Refract unit directions at a drop's flat side, whose normal is z."""
    inside_direction = mi.Vector3f(
        direction.x / WATER_IOR, direction.y / WATER_IOR, 0.0
    )
    inside_direction.z = dr.safe_sqrt(
        1.0
        - inside_direction.x * inside_direction.x
        - inside_direction.y * inside_direction.y
    )
    return inside_direction


def _locate_entry(dx: Any, dy: Any, drop: Any) -> Any:
    """Return where rays enter a drop, from the center of the sphere of its cap.

    The arguments are those of `_refract_through_drop`.
    """
    radius_on_sheet = drop.z
    curvature_radius = drop.w
    center_distance = dr.safe_sqrt(
        curvature_radius * curvature_radius - radius_on_sheet * radius_on_sheet
    )
    return mi.Vector3f(dx, dy, center_distance)


def _measure_path_in_drop(entry: Any, direction: Any, curvature_radius: Any) -> Any:
    """Return the lengths of rays inside a drop, from the entry up to the sphere.

    It is the larger root of |entry + t direction| = curvature radius.
    """
    entry_cosine = dr.dot(entry, direction)
    discriminant = (
        entry_cosine * entry_cosine
        - dr.squared_norm(entry)
        + curvature_radius * curvature_radius
    )
    return dr.safe_sqrt(discriminant) - entry_cosine


class ModelledCamera(mi.Sensor):  # type: ignore[misc]
    """Sample rays of a `CameraModel` at a pose: the sensor `advsearch_camera`.

    The directions of rays are computed by Newton's method on a grid over the image, and
    interpolated bilinearly in between. The grid is so fine that the error is less than
    a hundredth of a pixel, except in the last pixels before the lens folds. Every
    sample of an image has a ray of its own, so that edges are as sharp as a pinhole's.

    Raindrops before the camera bend the rays, see the comment at the top.

    Parameters: `to_world`; `lens`, the lens's numbers in the order of `NUMBER_NAMES`.

    Attributes:
        pose: Mitsuba's transform from the camera's axes (left, up, ahead) to the world.
        lens: numbers of the lens.
        rays: four numbers for each grid point, row by row: direction and margin, see
            `CameraModel.make_ray_table`.
    """

    def __init__(self, props: Any) -> None:
        """Read model, clipping and perhaps drops from the sensor's properties."""
        super().__init__(props)
        values = tuple(float(props[name]) for name in NUMBER_NAMES)
        # the largest angle to the axis at which the lens has rays, degrees
        reach = float(props["reach"])
        self._model = CameraModel(str(props["kind"]), values, max_angle_degrees=reach)
        self._near = float(props["near_clip"])
        self._far = float(props["far_clip"])
        # columns and rows of the grid of ray directions
        self._grid_cells = _choose_grid_cells(self.film().crop_size())
        # The transform that Mitsuba read from the properties. From here on
        # `world_transform` returns `pose`.
        self.pose = mi.Transform4f(super().world_transform())
        self.lens = mi.TensorXf(list(values), (len(NUMBER_NAMES),))
        self._make_rays()
        # half the width of the square with drops, millimeters; 0 without drops
        self._sheet_half_width = 0.0
        if "drops" in props:
            self._make_drops(props)

    def _make_drops(self, props: Any) -> None:
        """Sample the raindrops that the sensor's properties describe.

        From then on rays need a sample of the aperture (`sample3`).
        """
        self._sheet_half_width, drops, grid = sample_raindrops(
            count=int(props["drops"]),
            size=float(props["drop_size"]),
            seed=int(props["drop_seed"]),
            tangent=float(props["drop_tangent"]),
        )
        self._drop_of_cell = mi.UInt32(grid.reshape(-1).astype("uint32"))
        # A cell without a drop has the index after the last drop, which is `NO_DROP`.
        table = np.concatenate([drops, [NO_DROP]]).astype("float32")
        self._drops = mi.Float(table.reshape(-1))
        dr.eval(self._drop_of_cell, self._drops)
        # Mitsuba's integrators read this flag, and sample the aperture if it is set.
        self.m_needs_sample_3 = True

    def traverse(self, cb: Any) -> None:
        """Report to Mitsuba the parameters that may be set."""
        super().traverse(cb)
        cb.put("to_world", self.pose, mi.ParamFlags.NonDifferentiable)
        cb.put("lens", self.lens, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: Any) -> None:
        """Compute the rays again after the lens may have changed.

        Mitsuba passes no keys if it does not know what has changed.
        """
        if not keys or "lens" in keys:
            self._make_rays()
        super().parameters_changed(keys)

    def world_transform(self) -> Any:
        """Return the pose; Mitsuba's own is not updated."""
        return self.pose

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> Any:
        """Sample camera rays and their weights.

        Where the lens has no direction, the ray has weight 0 and hits nothing.

        Args:
            time: time of the rays.
            sample1: sample of the wavelength, which is not used.
            sample2: position in the image, in [0, 1]^2.
            sample3: sample of the aperture, used only for raindrops.
            active: lanes that are sampled; all of them are.
        """
        direction, is_inside = self._look_up_direction(sample2)
        transmitted = mi.Float(1.0)
        if self._sheet_half_width > 0.0:
            direction, transmitted = self._bend_by_drops(direction, sample3)
        weight = dr.select(is_inside, transmitted, 0.0)
        ray = self._make_sampled_ray(time, direction, weight > 0.0)
        return ray, mi.Spectrum(weight)

    def _make_sampled_ray(self, time: Any, direction: Any, has_light: Any) -> Any:
        """Return rays in the world, along directions in the camera's axes.

        Args:
            time: time of the rays.
            direction: unit directions.
            has_light: lanes whose ray may meet something; others have the length 0.
        """
        # Each field has one entry a lane, `maxt` too: Dr.Jit cannot differentiate a ray
        # whose fields have different lengths.
        ray = dr.zeros(mi.RayDifferential3f)
        ray.time = time
        # Near and far are distances along the ray, since a wide lens has no planes.
        ray.o = self.pose @ mi.Point3f(self._near * direction)
        ray.d = self.pose @ mi.Vector3f(direction)
        ray.maxt = dr.select(has_light, mi.Float(self._far), 0.0)
        return ray

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> Any:
        """Sample camera rays and their weights, without differentials.

        The arguments are those of `sample_ray_differential`: time, wavelength sample,
        position in the image, aperture sample, and active lanes.
        """
        ray, weight = self.sample_ray_differential(
            time, sample1, sample2, sample3, active
        )
        return mi.Ray3f(ray), weight

    def sample_ray_without_drops(self, time: Any, position: Any) -> Any:
        """Sample rays as if there were no drops before the camera.

        Ground truth, such as depth, describes the scene behind the drops.
        """
        half_width = self._sheet_half_width
        self._sheet_half_width = 0.0  # no sheet, so no drops
        try:
            return self.sample_ray(time, 0.5, position, mi.Point2f(0.5))
        finally:
            self._sheet_half_width = half_width

    def _bend_by_drops(self, direction: Any, sample: Any) -> tuple[Any, Any]:
        """Refract the rays that pass through a raindrop on the sheet before the camera.

        Rays meet the sheet shifted by points of the aperture, which `sample` chooses.
        So drops, which are near, are out of focus. The directions of rays are those of
        a pinhole, so that the scene is sharp.

        Returns:
            The unit directions, and the fraction of the light that passes: 1 without a
            drop, 0 where a drop reflects all of it inside.
        """
        aperture_point = APERTURE_RADIUS * mi.warp.square_to_uniform_disk_concentric(
            sample
        )
        # length of the ray up to the sheet; 1e-3 avoids a division by 0
        sheet_distance = SHEET_DISTANCE / dr.maximum(direction.z, 1e-3)
        x = direction.x * sheet_distance + aperture_point.x
        y = direction.y * sheet_distance + aperture_point.y
        # 0.1: rays that go almost along the sheet meet no drop
        drop, dx, dy, is_hit = self._find_drop(x, y, direction.z > 0.1)
        refracted, transmitted, is_lost = _refract_through_drop(direction, dx, dy, drop)
        weight = dr.select(is_hit, dr.select(is_lost, 0.0, transmitted), 1.0)
        refracted_direction = dr.select(
            is_hit & ~is_lost, dr.normalize(refracted), direction
        )
        return refracted_direction, weight

    def _find_drop(self, x: Any, y: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """Find the drop at a point of the sheet, in millimeters.

        Args:
            x, y: the point; (0, 0) is on the camera's axis.
            active: lanes that can meet a drop.

        Returns:
            The drop's four numbers, as in `sample_raindrops`; the point's x and y from
            the drop's center; and whether there is a drop at all.
        """
        drop_index, on_grid = self._look_up_drop(x, y, active)
        drop = dr.gather(mi.Vector4f, self._drops, drop_index)
        dx = x - drop.x
        dy = y - drop.y
        radius = drop.z  # below 0 in a cell without a drop, see `NO_DROP`
        is_hit = on_grid & (radius > 0.0) & (dx * dx + dy * dy < radius * radius)
        return drop, dx, dy, is_hit

    def _look_up_drop(self, x: Any, y: Any, active: Any) -> tuple[Any, Any]:
        """Return the index of the drop at a point of the sheet, and whether it is on
        the grid.

        The arguments are those of `_find_drop`. A cell without a drop has the index
        after the last drop.
        """
        half_width = self._sheet_half_width
        cells_per_mm = GRID_SIZE / (2.0 * half_width)
        column = (x + half_width) * cells_per_mm
        row = (y + half_width) * cells_per_mm
        has_column = (column >= 0.0) & (column < GRID_SIZE)
        has_row = (row >= 0.0) & (row < GRID_SIZE)
        on_grid = active & has_column & has_row
        row_index = mi.UInt32(dr.clip(row, 0.0, GRID_SIZE - 1.0))
        column_index = mi.UInt32(dr.clip(column, 0.0, GRID_SIZE - 1.0))
        cell = row_index * GRID_SIZE + column_index
        drop_index = dr.gather(mi.UInt32, self._drop_of_cell, cell, on_grid)
        return drop_index, on_grid

    def _make_rays(self) -> None:
        """Compute the grid of ray directions from the lens's numbers."""
        n_columns, n_rows = self._grid_cells
        # corners of the cells, one more than cells along each side
        x = torch.linspace(0.0, 1.0, n_columns + 1, dtype=torch.float64)
        y = torch.linspace(0.0, 1.0, n_rows + 1, dtype=torch.float64)
        positions = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        with torch.no_grad():
            model = self._model.with_intrinsics(self.lens.torch().cpu())
            table = model.make_ray_table(positions.reshape(-1, 2))
        self.rays = mi.Float(table.reshape(-1).contiguous())
        dr.eval(self.rays)

    def _look_up_direction(self, position: Any) -> tuple[Any, Any]:
        """Return the ray direction at a position in [0, 1]^2 of the image.

        It is interpolated between the four nearest points of the ray table. The second
        value is whether the lens has a direction there at all.
        """
        n_columns, n_rows = self._grid_cells
        x = position.x * n_columns
        y = position.y * n_rows
        column = dr.clip(mi.Int32(dr.floor(x)), 0, n_columns - 1)
        row = dr.clip(mi.Int32(dr.floor(y)), 0, n_rows - 1)
        x_fraction = x - mi.Float(column)
        y_fraction = y - mi.Float(row)
        # n cells have n + 1 grid points along a row
        upper_left = mi.UInt32(row * (n_columns + 1) + column)
        upper = self._lerp_rays(upper_left, x_fraction)
        lower = self._lerp_rays(upper_left + (n_columns + 1), x_fraction)
        ray = dr.lerp(upper, lower, y_fraction)
        has_direction = ray.w > 0.0  # the margin, see `rays`
        return dr.normalize(mi.Vector3f(ray.x, ray.y, ray.z)), has_direction

    def _lerp_rays(self, left: Any, fraction: Any) -> Any:
        """Interpolate between an entry of the grid and the next one in its row."""
        return dr.lerp(
            dr.gather(mi.Vector4f, self.rays, left),
            dr.gather(mi.Vector4f, self.rays, left + 1),
            fraction,
        )


def _choose_grid_cells(film_size: Any) -> tuple[int, ...]:
    """Return columns and rows of a grid of ray directions, about one for each pixel."""
    return tuple(max(MIN_CELLS, min(MAX_CELLS, int(size))) for size in film_size)


mi.register_sensor("advsearch_camera", ModelledCamera)
