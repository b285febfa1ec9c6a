"""Plugins of our own for Mitsuba: a path tracer for haze, guides of the denoiser, a
camera with a lens.

Import this only inside Mitsuba's scenes: it registers them, which takes the variant
that `variant.mitsuba` sets.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from advsearch.scene.assets import Floats, Ints
from advsearch.scene.camera_model import NUMBERS, CameraModel
from advsearch.scene.mitsuba_backend.variant import dr, mi

# ---------------------------------------------------------------------------------------------------------------------
# Raindrops on a sheet of glass before the camera: small lenses through which rays are
# refracted.
#
# A drop is a spherical cap of water on the outer side of the sheet. A ray that leaves
# the camera in the direction d meets the sheet at a distance of D, shifted by its place
# in the aperture (the camera is focused far away, so that drops are blurred as in a
# photograph), is refracted into the water (Snell's law; the sheet itself is plane and
# changes no direction), and out of it at the cap, or is lost where it would be
# reflected there. Where caps overlap, the higher one counts. The light that passes is
# Fresnel's, unpolarised (Born and Wolf, Principles of Optics, section 1.5).
#
# Only directions change: the scene is taken to be far away compared to the sheet.

WATER = 1.33  # index of refraction
# of the sheet from the camera, and radius of the camera's aperture, millimetres
DISTANCE = 60.0
APERTURE = 1.0
# angles between a drop's surface and the glass at its rim, degrees
CONTACT = (25.0, 42.0)
SPREAD = 0.45  # of the logarithm of radii
BEYOND = 1.1  # how far over the edge of the picture the drops go, in half widths
GRID = 1024  # along a side of the grid that says which drop is where


def raindrops(
    count: int, size: float, seed: int, tangent: float
) -> tuple[float, Floats, Ints]:
    """Make drops on a square of the sheet for a camera with the tangent of half its
    field of view along the larger side, with a median radius of `size`; the seed says
    where they are, and how large. All in millimetres.

    Returns:
        Half a side of the square, in whose middle the camera looks; (N, 4) float32, of
        each drop the x and y of its middle, its radius on the sheet and that of its
        curvature; and (GRID, GRID) the number of the drop that is highest in the middle
        of each cell, rows along y, or N for none.
    """
    random = np.random.default_rng(seed)
    half = BEYOND * DISTANCE * tangent
    places = random.uniform(-half, half, (count, 2))
    radii = size * np.exp(SPREAD * random.standard_normal(count).clip(-2.5, 2.5))
    curvature = radii / np.sin(np.radians(random.uniform(*CONTACT, count)))
    at = (np.arange(GRID) + 0.5) / GRID * 2.0 * half - half
    grid = np.full((GRID, GRID), count)
    height = np.zeros((GRID, GRID))
    for number, ((x, y), radius, curve) in enumerate(
        zip(places, radii, curvature, strict=True)
    ):
        rows, columns = (
            np.flatnonzero(np.abs(at - middle) <= radius) for middle in (y, x)
        )
        away = (at[rows] - y)[:, None] ** 2 + (at[columns] - x)[None] ** 2
        tall = np.sqrt(np.maximum(curve**2 - away, 0.0)) - math.sqrt(
            curve**2 - radius**2
        )
        place = np.ix_(rows, columns)
        above = (away < radius**2) & (tall > height[place])
        grid[place] = np.where(above, number, grid[place])
        height[place] = np.where(above, tall, height[place])
    return half, np.column_stack([places, radii, curvature]).astype(np.float32), grid


common: Any = mi.ad.integrators.common
PHASE = 1.0 / (4.0 * math.pi)  # isotropic phase function, per steradian
NO_EXTINCTION = 1e-20
MOST_SCATTERINGS = 8
"""Longest chain of scatterings in the haze along a path. They do not count as bounces
off surfaces, so that haze of density 0 is no haze. Where the haze's optical radius is
1.2, what is cut off is below 1 % of the light.
"""


class HazePath(common.RBIntegrator):  # type: ignore[misc]
    """The integrator `advsearch_haze`: a path tracer for a uniform haze in a ball
    around the scene, with its adjoint.

        L(x, w) = e^(-s l) L_o + integral_0^l s a e^(-s t) L_i(x + t w) dt,      L_i = mean over the sphere of L

    with extinction s (grey, per object size), single-scattering albedo a (per channel),
    l the length of the segment inside the ball, and L_o what leaves the next surface or
    comes from outside. Distances are sampled in proportion to `s e^(-s t)`, light from
    emitters through the haze is worked out exactly, and the derivative is path replay
    backpropagation (Vicini et al. 2021, Path Replay Backpropagation, sections 4 and 5)
    with detached samples.

    Why not Mitsuba's `prbvolpath`: it starts every path outside of all media, so a
    camera inside haze sees none up to the first surface (its source says so: "TODO:
    support sensors inside media"). Knowing that there is one uniform medium in one ball
    also spares the boundary's intersections and the walk through them towards emitters.

    Derivatives are right for the haze's colour, for emission and for everything that
    surfaces look up; for the density where it is greater than 0. Moving geometry has
    none.

    Properties beside those of `prb`: `medium`, a homogeneous medium with grey
    extinction, and `radius`, that of the ball around the origin which it fills.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.haze = props["medium"]
        self.radius = props["radius"]

    def stretch(self, origin: Any, towards: Any, distance: Any) -> tuple[Any, Any]:
        """Return where the haze begins on a segment, and for how long it lasts (0 if it
        misses the ball).
        """
        middle = -dr.dot(origin, towards)
        half = dr.sqrt(
            dr.maximum(
                dr.square(middle) - dr.squared_norm(origin) + self.radius**2, 0.0
            )
        )
        begin = dr.maximum(middle - half, 0.0)
        return begin, dr.maximum(dr.minimum(middle + half, distance) - begin, 0.0)

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
        primal = mode == dr.ADMode.Primal
        context = mi.BSDFContext()

        ray = mi.Ray3f(dr.detach(ray))
        bounces = mi.UInt32(0)
        scatterings = mi.UInt32(0)
        L = mi.Spectrum(0 if primal else state_in)
        δL = mi.Spectrum(δL if δL is not None else 0)
        β = mi.Spectrum(1)
        active = mi.Bool(active)
        prev = dr.zeros(mi.Interaction3f)
        prev_pdf = mi.Float(1)
        prev_delta = mi.Bool(True)

        longest = self.max_depth + MOST_SCATTERINGS
        while dr.hint(active, max_iterations=longest, label=f"Haze path ({mode.name})"):
            # ---- the next event: a surface, the outside, or the haze in between
            # -------------------------------------
            first = bounces + scatterings == 0
            si = scene.ray_intersect(ray, mi.RayFlags.All, first, active)
            if dr.hint(self.hide_emitters, mode="scalar"):
                skipped = active & first & si.is_valid() & (si.shape.emitter() != None)  # noqa: E711
                beyond = self.skip_area_emitters(
                    scene, si.spawn_ray(ray.d), True, skipped
                )
                si[skipped] = beyond.compute_surface_interaction(
                    ray, mi.RayFlags.All, skipped
                )
            begin, length = self.stretch(ray.o, ray.d, si.t)
            with dr.resume_grad(when=not primal):
                scattering, _, extinction = self.haze.get_scattering_coefficients(
                    dr.zeros(mi.MediumInteraction3f)
                )
                extinction = extinction[0]  # it is grey
                flight = -dr.log(1.0 - sampler.next_1d()) / dr.maximum(
                    dr.detach(extinction), NO_EXTINCTION
                )
                scattered = active & (flight < length)
                passed = dr.exp(-extinction * dr.minimum(flight, length))
                weight = dr.select(scattered, scattering * passed, passed)
            albedo = dr.detach(scattering) / dr.maximum(
                dr.detach(extinction), NO_EXTINCTION
            )
            β = dr.select(scattered, β * albedo, β)
            at_surface = active & ~scattered

            here = dr.zeros(mi.Interaction3f)
            here.t = dr.select(scattered, begin + flight, si.t)
            here.p = dr.select(scattered, ray(begin + flight), si.p)
            here.n = dr.select(scattered, mi.Normal3f(0.0), si.n)
            here.time = ray.time
            here.wavelengths = ray.wavelengths

            # ---- emission of the surface or of the outside
            # ----------------------------------------------------------
            active_e = at_surface
            if dr.hint(self.hide_emitters, mode="scalar"):
                active_e = at_surface & ~(first & ~si.is_valid())
            ds = mi.DirectionSample3f(scene, si, prev)
            mis = common.mis_weight(
                prev_pdf, scene.pdf_emitter_direction(prev, ds, active_e & ~prev_delta)
            )
            with dr.resume_grad(when=not primal):
                Le = β * mis * ds.emitter.eval(si, active_e)

            # ---- light that emitters send here, through the haze
            # ----------------------------------------------------
            may_bounce = si.is_valid() & (bounces + 1 < self.max_depth)
            may_scatter = scatterings < MOST_SCATTERINGS
            active_next = active & (
                (scattered & may_scatter) | (~scattered & may_bounce)
            )
            at_surface &= active_next
            bsdf = si.bsdf(ray)
            active_em = active_next & (
                scattered | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            )
            ds_em, em_weight = scene.sample_emitter_direction(
                here, sampler.next_2d(), True, active_em
            )
            active_em &= ds_em.pdf != 0.0
            outside = mi.has_flag(ds_em.emitter.flags(), mi.EmitterFlags.Infinite)
            _, hazy = self.stretch(
                here.p, ds_em.d, dr.select(outside, dr.inf, ds_em.dist)
            )
            with dr.resume_grad(when=not primal):
                if dr.hint(not primal, mode="scalar"):
                    attached = scene.eval_emitter_direction(here, ds_em, active_em)
                    em_weight = dr.replace_grad(
                        em_weight,
                        attached * dr.select(active_em, dr.rcp(ds_em.pdf), 0.0),
                    )
                bsdf_value_em, bsdf_pdf_em = bsdf.eval_pdf(
                    context, si, si.to_local(ds_em.d), active_em & at_surface
                )
                bsdf_value_em = dr.select(scattered, PHASE, bsdf_value_em)
                bsdf_pdf_em = dr.select(scattered, PHASE, bsdf_pdf_em)
                mis = dr.select(
                    ds_em.delta, 1.0, common.mis_weight(ds_em.pdf, bsdf_pdf_em)
                )
                Lr_dir = dr.select(
                    active_em,
                    β * mis * bsdf_value_em * em_weight * dr.exp(-extinction * hazy),
                    0.0,
                )

            # ---- the direction to go on
            # -----------------------------------------------------------------------------
            bsdf_sample, bsdf_weight = bsdf.sample(
                context, si, sampler.next_1d(), sampler.next_2d(), at_surface
            )
            anywhere = mi.warp.square_to_uniform_sphere(sampler.next_2d())
            towards = dr.select(scattered, anywhere, si.to_world(bsdf_sample.wo))
            L = (L + Le + Lr_dir) if primal else (L - Le - Lr_dir)
            β = dr.select(scattered, β, β * bsdf_weight)
            active_next &= dr.max(β) != 0.0

            # ---- derivatives
            # ----------------------------------------------------------------------------------------
            if dr.hint(not primal, mode="scalar"):
                with dr.resume_grad():
                    reflected = bsdf.eval(
                        context, si, bsdf_sample.wo, active_next & at_surface
                    )
                    further = dr.select(at_surface, L * dr.relative_grad(reflected), L)
                    Lo = (Le + Lr_dir + further) * dr.relative_grad(weight)
                    if dr.hint(dr.grad_enabled(Lo), mode="scalar"):
                        dr.backward_from(δL * Lo)

            ray = here.spawn_ray(towards)
            prev = here
            prev_pdf = dr.select(scattered, PHASE, bsdf_sample.pdf)
            prev_delta = ~scattered & mi.has_flag(
                bsdf_sample.sampled_type, mi.BSDFFlags.Delta
            )
            scatterings[scattered] += 1
            bounces[~scattered & si.is_valid()] += 1
            active = active_next

        return (L if primal else δL, bounces + scatterings != 0, [], L)


mi.register_integrator("advsearch_haze", lambda props: HazePath(props))


class Guides(mi.SamplingIntegrator):  # type: ignore[misc]
    """The integrator `advsearch_guides`: diffuse reflectance and shading normal, three
    channels each, of the first hit that light does not pass. Mitsuba's `aov` takes the
    first one, and the outline of what is cut off would show.
    """

    @dr.syntax  # type: ignore[untyped-decorator]
    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> Any:
        going = mi.Bool(active)
        ray = mi.Ray3f(ray)
        covered = mi.Bool(False)
        albedo = mi.Spectrum(0.0)
        normal = mi.Normal3f(0.0)
        while going:
            si = scene.ray_intersect(ray, going)
            going &= si.is_valid()
            bsdf = si.bsdf()
            clear = dr.max(bsdf.eval_null_transmission(si, going))
            passes = going & (sampler.next_1d(going) < clear)
            seen = going & ~passes
            albedo[seen] = bsdf.eval_diffuse_reflectance(si, seen)
            normal[seen] = si.sh_frame.n
            covered |= seen
            ray = si.spawn_ray(ray.d)
            going = passes
        return albedo, covered, [*albedo, *normal]

    def aov_names(self) -> list[str]:
        return [
            f"{name}.{channel}" for name in ("albedo", "normal") for channel in "XYZ"
        ]


mi.register_integrator("advsearch_guides", Guides)


CELLS = (128, 512)  # fewest and most cells along a side of the grid


def _transmitted(before: Any, behind: Any, first: float, second: float) -> Any:
    """Fresnel's share of unpolarised light that passes from a medium with the index of
    refraction `first` into one with `second`, where the angles to the normal have these
    cosines.
    """
    across = (first * before - second * behind) / (first * before + second * behind)
    along = (second * before - first * behind) / (second * before + first * behind)
    return 1.0 - 0.5 * (across * across + along * along)


class ModelledCamera(mi.Sensor):  # type: ignore[misc]
    """The sensor `advsearch_camera`: a `CameraModel` at a place.

    The directions of rays are kept on a grid over the picture, from Newton's method,
    and in between are bilinear: the grid is so fine that this is off by less than a
    hundredth of a pixel, but for the last pixels before a fold. Every sample of a
    picture has a ray of its own, so that edges are as sharp as a pinhole's.

    Drops of rain before it bend the rays:
    `advsearch.scene.mitsuba_backend.own_plugins`.

    Parameters: `to_world`; `lens`, its numbers in the order of `NUMBERS`.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        numbers = tuple(float(props[name]) for name in NUMBERS)
        self._model = CameraModel(
            str(props["kind"]), numbers, reach=float(props["reach"])
        )
        self._near = float(props["near_clip"])
        self._far = float(props["far_clip"])
        self._cells = tuple(
            max(CELLS[0], min(CELLS[1], int(side))) for side in self.film().crop_size()
        )
        self.pose = mi.Transform4f(super().world_transform())
        self.lens = mi.TensorXf(list(numbers), (len(NUMBERS),))
        self._make_rays()
        self._half = 0.0  # of the square with drops, where there are some
        if "drops" in props:
            asked = (
                int(props["drops"]),
                float(props["drop_size"]),
                int(props["drop_seed"]),
            )
            self._half, drops, grid = raindrops(*asked, float(props["drop_tangent"]))
            self._which = mi.UInt32(grid.reshape(-1).astype("uint32"))
            none = [[0.0, 0.0, -1.0, 1.0]]  # a drop without inside, where there is none
            self._caps = mi.Float(
                np.concatenate([drops, none]).astype("float32").reshape(-1)
            )
            dr.eval(self._which, self._caps)
            self.m_needs_sample_3 = True

    def traverse(self, cb: Any) -> None:
        super().traverse(cb)
        cb.put("to_world", self.pose, mi.ParamFlags.NonDifferentiable)
        cb.put("lens", self.lens, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: Any) -> None:
        if not keys or "lens" in keys:
            self._make_rays()
        super().parameters_changed(keys)

    def world_transform(self) -> Any:
        return self.pose

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> Any:
        """See `mi.Sensor.sample_ray_differential`; where the lens sees nothing, a ray
        of weight 0 that hits nothing.
        """
        ahead, inside = self._looked_up(sample2)
        passed = mi.Float(1.0)
        if self._half > 0.0:
            ahead, passed = self._through_drops(ahead, sample3)
        weight = dr.select(inside, passed, 0.0)
        # all of it, or it would be ragged for derivatives
        ray = dr.zeros(mi.RayDifferential3f)
        ray.time = time
        ray.o = self.pose @ mi.Point3f(self._near * ahead)
        ray.d = self.pose @ mi.Vector3f(ahead)
        ray.maxt = dr.select(weight > 0.0, mi.Float(self._far), 0.0)
        return ray, mi.Spectrum(weight)

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> Any:
        ray, weight = self.sample_ray_differential(
            time, sample1, sample2, sample3, active
        )
        return mi.Ray3f(ray), weight

    def without_drops(self, time: Any, place: Any) -> Any:
        """`sample_ray` where no drop is before the camera: what is true of a picture is
        so of the scene.
        """
        half = self._half
        self._half = 0.0
        try:
            return self.sample_ray(time, 0.5, place, mi.Point2f(0.5))
        finally:
            self._half = half

    def _through_drops(self, ahead: Any, sample: Any) -> tuple[Any, Any]:
        lens = APERTURE * mi.warp.square_to_uniform_disk_concentric(sample)
        half = self._half
        reach = DISTANCE / dr.maximum(ahead.z, 1e-3)
        x = ahead.x * reach + lens.x
        y = ahead.y * reach + lens.y
        column, row = ((at + half) * (GRID / (2.0 * half)) for at in (x, y))
        there = (
            (ahead.z > 0.1)
            & (column >= 0.0)
            & (column < GRID)
            & (row >= 0.0)
            & (row < GRID)
        )
        cell = mi.UInt32(dr.clip(row, 0.0, GRID - 1.0)) * GRID + mi.UInt32(
            dr.clip(column, 0.0, GRID - 1.0)
        )
        cap = dr.gather(
            mi.Vector4f, self._caps, dr.gather(mi.UInt32, self._which, cell, there)
        )
        dx = x - cap.x
        dy = y - cap.y
        wet = there & (cap.z > 0.0) & (dx * dx + dy * dy < cap.z * cap.z)

        inner = mi.Vector3f(ahead.x / WATER, ahead.y / WATER, 0.0)
        inner.z = dr.safe_sqrt(1.0 - inner.x * inner.x - inner.y * inner.y)
        # from the middle of the curvature
        start = mi.Vector3f(dx, dy, dr.safe_sqrt(cap.w * cap.w - cap.z * cap.z))
        along = dr.dot(start, inner)
        out = start + inner * (
            dr.safe_sqrt(along * along - dr.squared_norm(start) + cap.w * cap.w) - along
        )
        normal = out / cap.w
        cosine = dr.dot(inner, normal)
        beyond = 1.0 - WATER * WATER * (1.0 - cosine * cosine)
        leaving = dr.safe_sqrt(beyond)
        outer = WATER * inner + (leaving - WATER * cosine) * normal
        passed = _transmitted(ahead.z, inner.z, 1.0, WATER) * _transmitted(
            cosine, leaving, WATER, 1.0
        )
        lost = (beyond <= 0.0) | (outer.z <= 0.0)  # reflected inside
        weight = dr.select(wet, dr.select(lost, 0.0, passed), 1.0)
        return dr.select(wet & ~lost, dr.normalize(outer), ahead), weight

    def _make_rays(self) -> None:
        wide, tall = self._cells
        across, down = (
            torch.linspace(0.0, 1.0, cells + 1, dtype=torch.float64)
            for cells in (wide, tall)
        )
        places = torch.stack(
            torch.meshgrid(across, down, indexing="xy"), dim=-1
        ).reshape(-1, 2)
        with torch.no_grad():
            table = self._model.with_numbers(self.lens.torch().cpu()).table(places)
        self.rays = mi.Float(table.reshape(-1).contiguous())
        dr.eval(self.rays)

    def _looked_up(self, place: Any) -> tuple[Any, Any]:
        """Direction at a place in the picture, and whether the lens sees anything
        there.
        """
        wide, tall = self._cells
        x = place.x * wide
        y = place.y * tall
        column = dr.clip(mi.Int32(dr.floor(x)), 0, wide - 1)
        row = dr.clip(mi.Int32(dr.floor(y)), 0, tall - 1)
        right = x - mi.Float(column)
        down = y - mi.Float(row)
        first = mi.UInt32(row * (wide + 1) + column)
        upper, lower = (
            dr.lerp(
                dr.gather(mi.Vector4f, self.rays, at),
                dr.gather(mi.Vector4f, self.rays, at + 1),
                right,
            )
            for at in (first, first + (wide + 1))
        )
        ray = dr.lerp(upper, lower, down)
        return dr.normalize(mi.Vector3f(ray.x, ray.y, ray.z)), ray.w > 0.0


mi.register_sensor("advsearch_camera", ModelledCamera)
