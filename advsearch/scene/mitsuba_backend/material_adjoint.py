"""The material form of the geometric adjoint: samples stick to the moving surface, and
their positions on the film move.

The loss `sum(cotangent * radiance)` is an integral over the film, `integral of W(s)
L(s) ds`, where W is the cotangent as a function of the film position s in pixels. Over
the visible part M of the moving meshes it is written in coordinates m that stick to the
surface. There textures, facets and glossy lobes do not slide under the sample:

    integral over M of  W(s(m)) L(m) J(m) dm,        J = |N . (p - o)| / z^3

(p: the surface point, N: normal of its triangle times the triangle's area, o: the eye,
z: depth). Then

    d loss =   sum over samples of  d[W(s(p)) L J] / J   at fixed m          (interior)
             - integral over outlines of
                   W L_behind  n . (ds_edge - ds_behind)  dl                 (outlines)
             - integral over edges and directions d of
                   W f J' sin(d, edge) (L_past - L_hit)
                   n . (dp_edge - dp_lit)  dd dl                             (shadows)

In the interior term the directions of incoming light are fixed in the world, and what
arrives along them is a constant. L_behind is what an outline hides, and ds_behind its
motion on the film, zero if it stands still. In the shadow term the line through an edge
along d ends at a lit point that the camera sees: f is its reflectance towards the
camera, J' = |N . (p_lit - o)| / z^3 there, with a unit normal, and L_past and L_hit are
the radiances on either side of the edge.

All three are linear in the motion of the vertices, so one backward pass serves any
number of geometric dimensions.

Source: the material form is that of Zhang, Miller, Yan, Gkioulekas and Zhao,
"Path-Space Differentiable Rendering" (2020), section 4; sampling edges follows Li,
Aittala, Durand and Lehtinen (2018). Unlike both, geometry counts only at the first hit
and its shadow ray; see `LIMITS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.material_view import (
    INTERIOR,
    Camera,
    FilmView,
    compute_outline_term,
    compute_shadow_term,
    make_sampler,
    make_stream,
)
from advsearch.scene.mitsuba_backend.variant import dr, mi

LIMITS: Mapping[str, str] = {
    (
        "without shadow samples the shadows of the mesh, on the ground and on itself, "
        "do not move"
    ): (
        "mug on the ground, direct light: cosine 0.65 without, 0.995 with 4 shadow "
        "samples a pixel"
    ),
    (
        "light that reaches the camera over more than one surface is a constant at "
        "the first, and its shadows stay"
    ): (
        "mug on the ground, 6 segments: error 0.34, cosine 0.95 (smooth cotangent), "
        "0.09 and 0.997 (2 pixels); chair on the ground: 0.34, 0.97 and 0.43, 0.92"
    ),
    (
        "a cotangent that changes from pixel to pixel is smoothed by a tent two "
        "pixels wide, and the noise grows"
    ): (
        "variance x time against central differences of 16 samples, six axes: 15 "
        "times better for cotangents smooth over 16 pixels, 4 to 14 times over 2 "
        "pixels, 0.1 to 1 times for white ones, which are off by 0.33"
    ),
    (
        "polished surfaces are noisy, since directions of light are fixed in the "
        "world; a mirror's reflections stay"
    ): (
        "roughness 0.3, 0.1, 0.02: noise of a rotation 0.1, 0.4, 4.5 where the "
        "gradient is 4"
    ),
    (
        "direct sun: shadow samples ignore where the light comes from, so they are "
        "noisy"
    ): (
        "low sun, ground alone, 16 shadow samples a pixel: noise 0.16 where the "
        "gradient is 0.23"
    ),
    "a deformation that is not rigid reads low, for a reason not found yet": (
        "smooth deformation of a mug or ball: 4 to 5 % low with normals that follow, "
        "7 to 13 % with normals held"
    ),
    "shadows of point, spot and directional lights stay where they are": (
        "not measured: derivative 0"
    ),
    (
        "a surface that cuts through another: the line where they meet is taken for "
        "fixed"
    ): "not measured: about 0",
    (
        "a thin lens counts as a pinhole; participating media and what shines on the "
        "mesh itself are left out"
    ): "not measured",
}
"""Limits of the estimator, and the error that each causes, as far as measured.

Errors are relative, of the mean of several seeds over six pose axes; noise is the
standard deviation of one estimate.
"""
# a cotangent whose neighbouring pixels are less correlated than this is rough
ROUGH_COTANGENT = 0.5
# width in pixels of a tile that shares its random numbers, for a rough cotangent
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
    """Return the gradient of `sum(cotangent * radiance)` by vertices and normals.

    The scene is only read. The first call for a `max_depth` makes a path tracer.

    Args:
        scene: Mitsuba's scene, loaded with `optimize=False`.
        sensor: perspective camera of the scene; a thin lens is taken for a pinhole.
        parameters: what `mi.traverse` returns for the scene.
        moving: `NAME.vertices` and `NAME.normals` of each moving mesh, (V, 3) float32,
            in world units, with the values that the scene has.
        cotangent: (H, W, 3) float32, derivative of the loss by the radiance of
            box-filtered pixels.
        seed: seed of all random numbers.
        spp: samples per pixel of the interior term.
        boundary_spp: samples of the outlines of each mesh, in multiples of the number
            of pixels; 0 leaves the outlines out.
        shadow_spp: samples of the edges of each mesh that cast shadows, likewise.
        max_depth: longest light path in segments. Only the first two segments, from the
            camera to a surface and from there on, are differentiated.

    Returns:
        The gradients by the vertices and by the normals of each mesh, under the same
        names, (V, 3) float32.
    """
    view = FilmView(scene, sensor, parameters, moving, cotangent, max_depth)
    total = mi.Float(0)
    if spp > 0:
        # A rough cotangent changes its sign from pixel to pixel. If neighbouring pixels
        # have the same random numbers, the noise of their radiance is the same and
        # cancels. For a smooth cotangent, independent noise averages out better.
        tile = ROUGH_TILE if _is_rough(cotangent) else 1
        total += _compute_interior_term(view, seed, spp, tile)
    total = _add_boundary_terms(total, view, seed, boundary_spp, shadow_spp)
    return _backpropagate_to_meshes(view, total)


def _add_boundary_terms(
    total: Any, view: FilmView, seed: int, outline_spp: int, shadow_spp: int
) -> Any:
    """Return a value plus the outline and shadow terms of all meshes, one by one."""
    # A still mesh may hide a moving one, or cast a shadow on it. The index gives each
    # mesh random numbers of its own.
    for index, mesh in enumerate([*view.moving_meshes, *view.still_meshes]):
        total += compute_outline_term(view, mesh, seed, index, outline_spp)
        total += compute_shadow_term(view, mesh, seed, index, shadow_spp)
    return total


def _backpropagate_to_meshes(view: FilmView, total: Any) -> dict[str, Tensor]:
    """Return the gradients of a value by vertices and normals of the moving meshes."""
    # The value of `total` means nothing: each term is made so that its gradient is the
    # derivative of the loss.
    if dr.grad_enabled(total):
        dr.backward(total)
    gradients = dict[str, Tensor]()
    for mesh in view.moving_meshes:
        gradients |= mesh.get_gradients()
    return gradients


def _is_rough(cotangent: Tensor) -> bool:
    """Return whether neighbouring pixels of a cotangent (H, W, 3) hardly correlate.

    Hardly means that their correlation c is less than `ROUGH_COTANGENT`. The mean
    square of the difference of two neighbours is 2 v (1 - c), where v is the mean
    square of the values.
    """
    values = cotangent.detach().to(torch.float64)
    right_square = torch.diff(values, dim=1).square().mean()
    down_square = torch.diff(values, dim=0).square().mean()
    # the sum of both for a correlation of `ROUGH_COTANGENT`: 2 v (1 - c) twice
    limit = 4.0 * (1.0 - ROUGH_COTANGENT) * values.square().mean()
    return bool(right_square + down_square > limit)


def _compute_interior_term(view: FilmView, seed: int, spp: int, tile: int) -> Any:
    """Return a value whose gradient by the vertices is the interior term.

    The derivative is taken in two steps, since it is not finite for some samples. The
    first step computes the derivatives by the point and the normals of each sample. The
    second one takes those that are finite on to the vertices.

    Args:
        view: the scene.
        seed: seed of the samples.
        spp: samples per pixel.
        tile: width in pixels of a tile in which all pixels have the same random
            numbers.
    """
    with dr.suspend_grad():
        film, hit, sampler = _sample_first_hits(view, seed, spp, tile)
        if dr.width(film) == 0:
            return mi.Float(0)
        si = hit.compute_surface_interaction(
            view.camera.make_ray(film), mi.RayFlags.All
        )
    # Point, normal and shading normal depend on the vertices. The first step is taken
    # on copies that depend on nothing. All hits are on moving meshes.
    *attached_values, _is_moving = view.attach_hit(hit)
    local_values = [type(value)(dr.detach(value)) for value in attached_values]
    dr.enable_grad(local_values)
    sample_loss = _compute_sample_loss(view, si, film, local_values, sampler)
    dr.backward(dr.sum(sample_loss))
    return _carry_gradients_on(attached_values, local_values) / spp


def _compute_sample_loss(
    view: FilmView, si: Any, film: Any, local_values: list[Any], sampler: Any
) -> Any:
    """Return what each sample adds to the loss, W L J / J0, attached to its point.

    W is the cotangent, L the radiance, and J the area on the film of a piece of the
    surface, up to a constant factor. J0 is J without gradient, so that J / J0 has the
    value 1.

    Args:
        view: the scene.
        si: surface interactions of the hits, without gradients.
        film: sampled film positions in pixels.
        local_values: points, normals and shading normals of the hits, with gradients.
        sampler: random numbers.
    """
    point, scaled_normal, shading_normal = local_values
    # J is area cos / depth^2, where the product below has the length depth / cos of the
    # axis: hence the third power.
    film_area = (
        dr.dot(scaled_normal, point - view.camera.eye)
        / view.camera.compute_depth(point) ** 3
    )
    # the sampled film position, which moves with the point
    moving_film = dr.replace_grad(film, view.camera.project(point))
    weight = view.interpolate_cotangent(moving_film, mi.Bool(True))
    moving_si = _attach_interaction(view, si, point, scaled_normal, shading_normal)
    radiance = _sample_reflected(view, moving_si, si, sampler)
    sample_loss = dr.sum(weight * radiance)  # over the color channels
    return sample_loss * _with_relative_gradient(film_area)


def _carry_gradients_on(attached_values: list[Any], local_values: list[Any]) -> Any:
    """Return a value that has the gradients of copies as gradients of the originals.

    The gradient of value * constant by the vertices is the constant, here the gradient
    of the copy, times the derivative of the value. Gradients that are not finite are
    left out.
    """
    total = mi.Float(0)
    for value, local_value in zip(attached_values, local_values, strict=True):
        gradient = dr.grad(local_value)
        is_finite = dr.all(dr.isfinite(gradient))
        product = dr.dot(value, dr.select(is_finite, gradient, 0))
        total += dr.sum(dr.select(is_finite, product, 0))
    return total


def _sample_first_hits(
    view: FilmView, seed: int, spp: int, tile: int
) -> tuple[Any, Any, Any]:
    """Sample film positions that see a moving mesh.

    The film is cut into cells whose corners are the centers of pixels, since the
    cotangent is bilinear between those. The cells reach half a pixel past each border,
    so that there is one more cell than pixels along each side. The samples of a cell
    are stratified.

    Args:
        view: the scene.
        seed: seed of the samples.
        spp: samples in each cell.
        tile: width of a tile in cells. All cells of a tile have the same random
            numbers, so that their noise is the same.

    Returns:
        Film positions in pixels; their hits; and a sampler that goes on with their
        random numbers. Positions that see no moving mesh are left out.
    """
    film, sampler = _sample_film(view.camera, seed, spp, tile)
    hit = view.scene.ray_intersect_preliminary(
        view.camera.make_ray(film), coherent=True
    )
    on_moving = _find_moving_hits(view, hit)
    dr.eval(on_moving, film, hit, sampler)
    # Keep the lanes that see a moving mesh, with the states of their generators.
    selected_lanes = dr.compress(on_moving)
    film = dr.gather(type(film), film, selected_lanes)
    hit = dr.gather(type(hit), hit, selected_lanes)
    sampler.rng = dr.gather(type(sampler.rng), sampler.rng, selected_lanes)
    return film, hit, sampler


def _find_moving_hits(view: FilmView, hit: Any) -> Any:
    """Return whether each hit is on a mesh that moves."""
    on_moving = mi.Bool(False)
    for mesh in view.moving_meshes:
        on_moving |= hit.is_valid() & (hit.shape == mesh.shape)
    return on_moving


def _sample_film(camera: Camera, seed: int, spp: int, tile: int) -> tuple[Any, Any]:
    """Sample positions on the film in pixels, and return them with their sampler.

    The arguments are those of `_sample_first_hits`.
    """
    n_columns = camera.width + 1
    n_rows = camera.height + 1
    lane = dr.arange(mi.UInt32, n_columns * n_rows * spp)
    cell = lane // spp
    sample = lane % spp
    column = cell % n_columns
    row = cell // n_columns

    tiles_across = math.ceil(n_columns / tile)
    n_tiles = tiles_across * math.ceil(n_rows / tile)
    tile_index = row // tile * tiles_across + column // tile
    # Sample i of all cells of a tile has the same stream of random numbers.
    sampler = make_sampler(
        make_stream(seed, INTERIOR),
        count=n_tiles * spp,
        index=tile_index * spp + sample,
    )
    # the first cell begins half a pixel outside of the film
    film = mi.Point2f(column, row) - 0.5 + _sample_in_cell(sampler, sample, spp)
    return film, sampler


def _sample_in_cell(sampler: Any, sample: Any, spp: int) -> Any:
    """Return stratified positions in [0, 1]^2, for sample numbers below `spp`.

    There are as many strata as samples, in an almost square grid.
    """
    strata_across = _find_largest_divisor(spp)
    strata_shape = mi.Point2f(strata_across, spp // strata_across)
    stratum = mi.Point2f(sample % strata_across, sample // strata_across)
    return (stratum + sampler.next_2d()) / strata_shape


def _find_largest_divisor(count: int) -> int:
    """Return the largest divisor of a count that is at most its square root."""
    return max(n for n in range(1, int(count**0.5) + 1) if count % n == 0)


def _with_relative_gradient(value: Any) -> Any:
    """Return 1, with the derivative of `value` divided by the value itself.

    For a factor f of an integrand that was sampled in proportion to f, the sample's
    weight is 1, with the derivative df / f. Where the value is almost zero, the
    derivative is 0.
    """
    constant = dr.detach(value)
    is_usable = dr.abs(constant) > 1e-20  # the rest is not divided by
    ratio = dr.select(is_usable, value / dr.select(is_usable, constant, 1.0), 1.0)
    return dr.replace_grad(dr.full(type(constant), 1.0), ratio)


def _attach_interaction(
    view: FilmView, si: Any, point: Any, scaled_normal: Any, shading_normal: Any
) -> Any:
    """Return Mitsuba's surface interaction, attached to a point and its normals.

    Its values stay those of `si`; only gradients are added. The frame's tangent follows
    the normal without a rotation about it.

    Args:
        view: the scene.
        si: Mitsuba's surface interaction, without gradients.
        point: the same point with gradients.
        scaled_normal: normal of its triangle with gradients, of any length.
        shading_normal: shading normal with gradients, of any length.
    """

    moving_si = mi.SurfaceInteraction3f(si)
    moving_si.p = dr.replace_grad(si.p, point)
    moving_si.n = _attach_normal(si.n, scaled_normal)
    moving_si.sh_frame = _attach_frame(si.sh_frame, shading_normal)
    to_eye = dr.normalize(view.camera.eye - point)
    moving_si.wi = dr.replace_grad(si.wi, moving_si.sh_frame.to_local(to_eye))
    return moving_si


def _attach_normal(fixed: Any, normal: Any) -> Any:
    """Give a fixed normal the gradient of another, which may be its opposite."""
    # Below 0 if the normals are opposite; then `mulsign` turns the second over.
    cosine = dr.dot(dr.detach(normal), fixed)
    return dr.replace_grad(fixed, dr.mulsign(dr.normalize(normal), cosine))


def _attach_frame(fixed_frame: Any, shading_normal: Any) -> Any:
    """Return a shading frame with the gradient of a normal; its values stay."""
    normal = _attach_normal(fixed_frame.n, shading_normal)
    fixed_tangent = fixed_frame.s
    # the part of the tangent t that is perpendicular to the moving normal n:
    # t - n (n . t)
    perpendicular = dr.fma(-normal, dr.dot(normal, fixed_tangent), fixed_tangent)
    tangent = dr.replace_grad(fixed_tangent, dr.normalize(perpendicular))
    # The cross product has the value of the frame's second tangent, `fixed_frame.t`.
    return mi.Frame3f(tangent, dr.cross(normal, tangent), normal)


def _sample_reflected(view: FilmView, moving_si: Any, si: Any, sampler: Any) -> Any:
    """Sample the light reflected towards the camera.

    Directions of incoming light are fixed in the world, so they are sampled at the
    interaction without gradients.

    Args:
        view: the scene.
        moving_si, si: the surface interaction, with and without gradients.
        sampler: random numbers.
    """
    with dr.suspend_grad():
        active = mi.Bool(view.max_depth > 1)
        ds, em_weight, has_light = _sample_light(view, si, sampler, active)
        bsdf_sample, incoming, active = _sample_incoming(view, si, sampler, active)
        wo = si.to_world(bsdf_sample.wo)
        is_smooth = ~mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
    direct = _reflect_light(view, moving_si, si, ds, em_weight, has_light)

    relative_bsdf = _compute_relative_bsdf(moving_si, si, wo, active, is_smooth)
    return direct + dr.select(active, incoming * relative_bsdf, 0.0)


def _compute_relative_bsdf(
    moving_si: Any, si: Any, wo: Any, active: Any, is_smooth: Any
) -> Any:
    """Return 1, with the relative gradient of the BSDF, per color channel.

    The light along a sampled direction is multiplied by the value of the BSDF over the
    density. Only this value changes as the surface turns, so that its relative change
    is multiplied. A mirror has no BSDF value: its factor is 1.

    Args:
        moving_si, si: the surface interaction, with and without gradients.
        wo: direction of the incoming light in the world.
        active: lanes in which there is a sample.
        is_smooth: lanes in which the BSDF has a value.
    """
    bsdf_value = si.bsdf().eval(
        mi.BSDFContext(), moving_si, moving_si.to_local(wo), active & is_smooth
    )
    factors = (
        _with_relative_gradient(dr.select(is_smooth, channel, 1.0))
        for channel in bsdf_value
    )
    return mi.Color3f(*factors)


def _sample_light(
    view: FilmView, si: Any, sampler: Any, active: Any
) -> tuple[Any, Any, Any]:
    """Sample a direction to an emitter from surface points.

    Nothing is sampled at a perfect mirror: it reflects no light of a sampled direction.
    A BSDF has Mitsuba's flag `Smooth` if a part of it is not a perfect mirror.

    Returns:
        Mitsuba's direction sample; the emitter's radiance over the density; and in
        which lanes there is a sample.
    """
    is_smooth = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
    has_light = active & is_smooth
    ds, em_weight = view.scene.sample_emitter_direction(
        si, sampler.next_2d(), test_visibility=True, active=has_light
    )
    has_light &= ds.pdf != 0.0
    return ds, em_weight, has_light


def _sample_incoming(
    view: FilmView, si: Any, sampler: Any, active: Any
) -> tuple[Any, Any, Any]:
    """Sample a direction by the BSDF, and the light that arrives along it.

    Direct light is also sampled at emitters. Here it counts only by its multiple
    importance sampling (MIS) weight.

    Returns:
        The BSDF sample; its weight times the radiance; and where there is a sample.
    """
    bsdf_sample, bsdf_weight = si.bsdf().sample(
        mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active
    )
    active = active & dr.any(bsdf_weight != 0.0)
    is_smooth = ~mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.Delta)
    ray = si.spawn_ray(si.to_world(bsdf_sample.wo))
    radiance = view.sample_radiance(ray, sampler, view.max_depth - 1, active)
    # In the direction of a mirror, samples at emitters cover nothing.
    is_shared = active & is_smooth
    si_next = view.scene.ray_intersect(ray, active)
    radiance -= _compute_covered_emission(view, si, si_next, bsdf_sample.pdf, is_shared)
    return bsdf_sample, bsdf_weight * radiance, active


def _compute_covered_emission(
    view: FilmView, si: Any, si_next: Any, bsdf_pdf: Any, active: Any
) -> Any:
    """Return the emission along rays that is covered by samples at emitters.

    It is the fraction 1 - MIS weight of the emission of the next surface or of the
    environment.

    Args:
        view: the scene.
        si: surface interactions at which the rays begin.
        si_next: surface interactions at which they end.
        bsdf_pdf: densities by which their directions were sampled.
        active: lanes that are computed.
    """
    ds_next = mi.DirectionSample3f(view.scene, si=si_next, ref=si)
    em_pdf = view.scene.pdf_emitter_direction(si, ds_next, active)
    mis = mi.ad.integrators.common.mis_weight(bsdf_pdf, em_pdf)
    return (1.0 - mis) * ds_next.emitter.eval(si_next, active)


def _reflect_light(
    view: FilmView, moving_si: Any, si: Any, ds: Any, em_weight: Any, active: Any
) -> Any:
    """Return the reflected light of sampled emitters, attached to the moving point.

    The point on the emitter stays. As the reflecting point moves, three factors change:
    the direction to the emitter, the falloff with distance, and the BSDF. For an
    infinitely far emitter only the BSDF changes.

    Args:
        view: the scene.
        moving_si, si: the surface interaction, with and without gradients.
        ds: Mitsuba's direction sample of the emitter.
        em_weight: radiance of the emitter divided by the sample's density.
        active: lanes in which there is a sample.
    """
    flags = ds.emitter.flags()
    is_near = active & ~mi.has_flag(flags, mi.EmitterFlags.Infinite)
    to_light = ds.p - moving_si.p
    ds.d = dr.select(is_near, dr.replace_grad(ds.d, dr.normalize(to_light)), ds.d)
    em_weight = _attach_emitter_weight(view, moving_si, ds, em_weight, is_near)
    bsdf_value, bsdf_pdf = si.bsdf().eval_pdf(
        mi.BSDFContext(), moving_si, moving_si.to_local(ds.d), active
    )
    mis_weight = mi.ad.integrators.common.mis_weight
    mis = dr.select(ds.delta, 1.0, mis_weight(ds.pdf, bsdf_pdf))
    return dr.select(active, bsdf_value * em_weight * mis, 0.0)


def _attach_emitter_weight(
    view: FilmView, moving_si: Any, ds: Any, em_weight: Any, is_near: Any
) -> Any:
    """Return the light of sampled emitters with the gradient of the moving point.

    Args:
        view: the scene.
        moving_si: the surface interaction, with gradients.
        ds: Mitsuba's direction sample of the emitter, with a direction that has them.
        em_weight: radiance of the emitter divided by the sample's density.
        is_near: lanes whose emitter is not infinitely far.
    """
    is_surface = is_near & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
    # the emitter's radiance towards the moving point
    moving_radiance = view.scene.eval_emitter_direction(moving_si, ds, is_near)
    moving_weight = moving_radiance / dr.select(is_near, ds.pdf, 1.0)
    moving_weight = dr.select(is_near, moving_weight, em_weight)
    # A sample on an emitting surface is weighted by the solid angle that a piece of the
    # surface covers: the cosine at the emitter over the squared distance. `em_weight`
    # contains that already, so that only the relative change is multiplied. The sign of
    # the cosine cancels. The divisor 1 avoids a division by 0 for other emitters.
    falloff = dr.dot(ds.n, ds.d) / dr.select(
        is_surface, dr.squared_norm(ds.p - moving_si.p), 1.0
    )
    em_weight = dr.replace_grad(em_weight, moving_weight)
    return em_weight * dr.select(is_surface, _with_relative_gradient(falloff), 1.0)
