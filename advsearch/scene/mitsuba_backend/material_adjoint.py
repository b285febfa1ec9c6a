"""The material form of the geometric adjoint: follow the moving surface, and let its
place on the film move instead.

The loss `sum(cotangent * radiance)` is an integral over the film, `integral of W(s)
L(s) ds`, with W the cotangent as a function of the film position s in pixels. Over the
visible part M of the moving meshes it is written in coordinates
m that stick to the surface, where textures, facets and glossy lobes do not slide under the sample:

    integral over M of  W(s(m)) L(m) J(m) dm,        J = |N . (p - o)| / z^3

(p: place of the surface point, N: normal of its triangle times the triangle's area, o:
the eye, z: depth). Then

    d loss = sum over samples of  d[W(s(p)) L J] / J   at fixed m                                          (interior)
           - integral over outlines of  W L_behind  n . (ds_edge - ds_behind)  dl
           (outlines)
           - integral over edges and directions d of  W f J' sin(d, edge) (L_past -
           L_hit)
                                                        n . (dp_edge - dp_lit)  dd dl                      (shadows)

In the interior term the directions of incoming light are fixed in the world, and what
arrives along them is a constant. L_behind is what an outline hides, and ds_behind its
motion on the film, zero if it stands still. In the shadow term the line through an edge
along d ends at a lit point that the camera sees: f is its reflectance towards the
camera, J' = |N . (p_lit - o)| / z^3 there, with a unit normal, and L_past and L_hit are
seen on either side.

All three are linear in the motion of the vertices, so one backward pass serves any
number of geometric dimensions.

Source: the material form is that of Zhang, Miller, Yan, Gkioulekas and Zhao,
"Path-Space Differentiable Rendering" (2020), section 4; sampling edges follows Li,
Aittala, Durand and Lehtinen (2018). We depart from both in that geometry counts at the
first hit and its shadow ray only; see `LIMITS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.material_view import (
    FilmView,
    outline_terms,
    sampler_of,
    shadow_terms,
    stream_of,
)
from advsearch.scene.mitsuba_backend.variant import dr, mi

LIMITS: Mapping[str, str] = {
    "without shadow samples the shadows of the mesh, on the ground and on itself, do "
    "not move":
        "mug on the ground, direct light: cosine 0.65 without, 0.995 with 4 shadow "
        "samples a pixel",
    "light that reaches the camera over more than one surface is a constant at the "
    "first, and its shadows stay":
        "mug on the ground, 6 segments: error 0.34, cosine 0.95 (smooth cotangent), "
        "0.09 and 0.997 (2 pixels); chair "
        "on the ground: 0.34, 0.97 and 0.43, 0.92",
    "a cotangent that changes from pixel to pixel is smoothed by a tent two pixels "
    "wide, and the noise grows":
        "variance x time against central differences of 16 samples, six axes: 15 times "
        "better for cotangents smooth "
        "over 16 pixels, 4 to 14 times over 2 pixels, 0.1 to 1 times for white ones, "
        "which are off by 0.33",
    "polished surfaces are noisy, since directions of light are fixed in the world; a "
    "mirror's reflections stay":
        "roughness 0.3, 0.1, 0.02: noise of a rotation 0.1, 0.4, 4.5 where the "
        "gradient is 4",
    "direct sun: shadow samples ignore where the light comes from, so they are noisy":
        "low sun, ground alone, 16 shadow samples a pixel: noise 0.16 where the "
        "gradient is 0.23",
    "a deformation that is not rigid reads low, for a reason not found yet":
        "smooth deformation of a mug or ball: 4 to 5 % low with normals that follow, 7 "
        "to 13 % with normals held",
    "shadows of point, spot and directional lights stay where they are": "not measured: derivative 0",
    "a surface that cuts through another: the line where they meet is taken for fixed": "not measured: about 0",
    "a thin lens counts as a pinhole; participating media and what shines on the mesh "
    "itself are left out":
        "not measured",
}  # fmt: skip
"""What the estimator does not cover, and what that cost where it was measured. Errors
are relative, of the mean of several seeds over six pose axes; noise is the standard
deviation of one estimate.
"""
# a cotangent whose neighbours are less correlated than this counts as rough
ROUGH_COTANGENT = 0.5
# pixels along a tile that shares its random numbers, for a rough cotangent
ROUGH_TILE = 16


def material_adjoint(
    scene: Any,
    sensor: Any,
    parameters: Any,
    moving: Mapping[str, Tensor],
    *,
    cotangent: Tensor,
    seed: int,
    spp: int,
    boundary_spp: int = 4,
    max_depth: int = 6,
    shadow_spp: int = 0,
) -> dict[str, Tensor]:
    """Return the gradient of `sum(cotangent * radiance)` with respect to vertex places
    and vertex normals.

    The scene is only read. Nothing is recorded with `dr.freeze`. The first call for a
    depth makes a path tracer.

    Args:
        scene, sensor, parameters: Mitsuba's scene, loaded with `optimize=False`, a
            perspective camera of it (a thin lens is taken for a pinhole), and what
            `mi.traverse` says of it.
        moving: `NAME.vertices` and `NAME.normals` of each moving mesh, (V, 3) float32,
            world units, as the scene has them.
        cotangent: (H, W, 3) float32, derivative of the loss by the radiance of
            box-filtered pixels.
        spp: samples a pixel of the interior term.
        boundary_spp, shadow_spp: samples of the outlines of each mesh and of the edges
            that cast shadows, in multiples of the number of pixels; 0 leaves them out.
        max_depth: longest light path in segments, of which only the first two move with
            the vertices.

    Returns:
        The gradients by the vertices and by the normals of each mesh, under the same
        names, (V, 3) float32.
    """
    view = FilmView(scene, sensor, parameters, moving, cotangent, max_depth)
    total = mi.Float(0)
    if spp > 0:
        # The gradient of a rough cotangent has no preferred sign within a few pixels:
        # the noise of the radiance cancels if it is the same there; for a smooth one it
        # averages out better if it is not
        values = cotangent.detach().to(torch.float64)
        right, down = (torch.diff(values, dim=dim).square().mean() for dim in (1, 0))
        rough = bool(
            right + down > 4.0 * (1.0 - ROUGH_COTANGENT) * values.square().mean()
        )
        total += _interior(view, seed, spp, ROUGH_TILE if rough else 1)
    for number, mesh in enumerate([*view.meshes, *view.still]):
        total += outline_terms(view, mesh, seed, number, boundary_spp)
        total += shadow_terms(view, mesh, seed, number, shadow_spp)
    if dr.grad_enabled(total):
        dr.backward(total)
    return {
        name: gradient
        for mesh in view.meshes
        for name, gradient in mesh.gradients().items()
    }


def _interior(view: FilmView, seed: int, spp: int, tile: int) -> Any:
    with dr.suspend_grad():
        film, hit, sampler = _first_hits(view, seed, spp, tile)
        if dr.width(film) == 0:
            return mi.Float(0)
        si = hit.compute_surface_interaction(view.camera.ray(film), mi.RayFlags.All)
    attached = view.follow(hit)[:3]
    loose = [type(value)(dr.detach(value)) for value in attached]
    dr.enable_grad(loose)
    place, facet, bent = loose
    # Sum of W L J / J over all samples, attached to these places and normals
    spread = dr.dot(facet, place - view.camera.eye) / view.camera.depth(place) ** 3
    weight = view.weight(
        dr.replace_grad(film, view.camera.project(place)), mi.Bool(True)
    )
    radiance = _reflected(view, _attached(view, si, place, facet, bent), si, sampler)
    dr.backward(dr.sum(dr.sum(weight * radiance) * _relative(spread)))
    total = mi.Float(0)
    for value, free in zip(attached, loose, strict=True):
        pull = dr.grad(free)
        usable = dr.all(dr.isfinite(pull))
        total += dr.sum(dr.select(usable, dr.dot(value, dr.select(usable, pull, 0)), 0))
    return total / spp


def _first_hits(view: FilmView, seed: int, spp: int, tile: int) -> tuple[Any, Any, Any]:
    """Film positions that see a moving mesh, the hits, and the random numbers from
    there on.

    The film is cut into cells between pixel centres, `spp` samples in each, stratified.
    """
    columns = view.camera.width + 1
    rows = view.camera.height + 1
    lane = dr.arange(mi.UInt32, columns * rows * spp)
    cell = lane // spp
    sample = lane % spp
    column = cell % columns
    row = cell // columns
    tiles = -(-columns // tile)
    group = (row // tile * tiles + column // tile) * spp + sample
    sampler = sampler_of(stream_of(seed, 0), tiles * -(-rows // tile) * spp, group)
    across = max(n for n in range(1, int(spp**0.5) + 1) if spp % n == 0)
    strata = mi.Point2f(sample % across, sample // across)
    film = (
        mi.Point2f(column, row)
        - 0.5
        + (strata + sampler.next_2d()) / mi.Point2f(across, spp // across)
    )
    hit = view.scene.ray_intersect_preliminary(view.camera.ray(film), coherent=True)
    on = mi.Bool(False)
    for mesh in view.meshes:
        on |= hit.is_valid() & (hit.shape == mesh.shape)
    dr.eval(on, film, hit, sampler)
    kept = dr.compress(on)
    film, hit, sampler.rng = (
        dr.gather(type(value), value, kept) for value in (film, hit, sampler.rng)
    )
    return film, hit, sampler


def _relative(value: Any) -> Any:
    """1 with the relative gradient of a value; without gradient where the value is all
    but zero.
    """
    fixed = dr.detach(value)
    usable = dr.abs(fixed) > 1e-20
    return dr.replace_grad(
        dr.full(type(fixed), 1.0),
        dr.select(usable, value / dr.select(usable, fixed, 1.0), 1.0),
    )


def _attached(view: FilmView, si: Any, place: Any, facet: Any, bent: Any) -> Any:
    """Mitsuba's surface interaction, moving with the surface and turning with its
    normals.
    """

    def turned(fixed: Any, normal: Any) -> Any:
        """A normal with the gradient of ours, which may point the other way."""
        return dr.replace_grad(
            fixed, dr.mulsign(dr.normalize(normal), dr.dot(dr.detach(normal), fixed))
        )

    at = mi.SurfaceInteraction3f(si)
    at.p = dr.replace_grad(si.p, place)
    at.n = turned(si.n, facet)
    normal = turned(si.sh_frame.n, bent)
    s = si.sh_frame.s
    s = dr.replace_grad(s, dr.normalize(dr.fma(-normal, dr.dot(normal, s), s)))
    at.sh_frame = mi.Frame3f(s, dr.cross(normal, s), normal)
    at.wi = dr.replace_grad(
        si.wi, at.sh_frame.to_local(dr.normalize(view.camera.eye - place))
    )
    return at


def _reflected(view: FilmView, at: Any, si: Any, sampler: Any) -> Any:
    """One sample of the light reflected towards the camera, from directions fixed in
    the world.
    """
    context = mi.BSDFContext()
    bsdf = si.bsdf()
    mis_weight = mi.ad.integrators.common.mis_weight
    with dr.suspend_grad():  # both directions are drawn where the surface is, and stay
        active = mi.Bool(view.max_depth > 1)
        active_em = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, em_weight = view.scene.sample_emitter_direction(
            si, sampler.next_2d(), True, active_em
        )
        active_em &= ds.pdf != 0.0
        bsdf_sample, bsdf_weight = bsdf.sample(
            context, si, sampler.next_1d(), sampler.next_2d(), active
        )
        active &= dr.any(bsdf_weight != 0.0)
        wo = si.to_world(bsdf_sample.wo)
        smooth = ~mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(wo)
        # with all of what the next surface emits
        L = view.radiance(ray, sampler, view.max_depth - 1, active)
        si_next = view.scene.ray_intersect(ray, active)
        ds_next = mi.DirectionSample3f(view.scene, si=si_next, ref=si)
        em_pdf = view.scene.pdf_emitter_direction(si, ds_next, active & smooth)
        L -= (1.0 - mis_weight(bsdf_sample.pdf, em_pdf)) * ds_next.emitter.eval(
            si_next, active & smooth
        )
        arriving = bsdf_weight * L

    # ---- light that was sampled, from the moving point: its distance and the BSDF
    # change, unless it is infinitely far
    near = active_em & ~mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    surface = near & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
    ds.d = dr.select(near, dr.replace_grad(ds.d, dr.normalize(ds.p - at.p)), ds.d)
    shining = view.scene.eval_emitter_direction(at, ds, near)
    shining = dr.select(near, shining / dr.select(near, ds.pdf, 1.0), em_weight)
    fall = dr.dot(ds.n, ds.d) / dr.select(surface, dr.squared_norm(ds.p - at.p), 1.0)
    em_weight = dr.replace_grad(em_weight, shining) * dr.select(
        surface, _relative(fall), 1.0
    )
    bsdf_value_em, bsdf_pdf_em = bsdf.eval_pdf(
        context, at, at.to_local(ds.d), active_em
    )
    mis = dr.select(ds.delta, 1.0, mis_weight(ds.pdf, bsdf_pdf_em))
    total = dr.select(active_em, bsdf_value_em * em_weight * mis, 0.0)

    # ---- light along the sampled direction: a constant, of which the BSDF passes more
    # or less; a mirror's stays
    bsdf_value = bsdf.eval(context, at, at.to_local(wo), active & smooth)
    relative = mi.Color3f(
        *(_relative(dr.select(smooth, channel, 1.0)) for channel in bsdf_value)
    )
    return total + dr.select(active, arriving * relative, 0.0)
