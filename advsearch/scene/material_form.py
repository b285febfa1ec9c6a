"""The material form of the geometric adjoint: follow the moving surface, and let its place on the film move instead.

The loss `sum(cotangent * radiance)` is an integral over the film, `integral of W(s) L(s) ds`, with W the cotangent as
a function of the film position s in pixels. Over the visible part M of the moving meshes it is written in coordinates
m that stick to the surface, where textures, facets and glossy lobes do not slide under the sample:

    integral over M of  W(s(m)) L(m) J(m) dm,        J = |N . (p - o)| / z^3

(p: place of the surface point, N: normal of its triangle times the triangle's area, o: the eye, z: depth). Then

    d loss = sum over samples of  d[W(s(p)) L J] / J   at fixed m                                          (interior)
           - integral over outlines of  W L_behind  n . (ds_edge - ds_behind)  dl                          (outlines)
           - integral over edges and directions d of  W f J' sin(d, edge) (L_past - L_hit)
                                                        n . (dp_edge - dp_lit)  dd dl                      (shadows)

In the interior term the directions of incoming light are fixed in the world, and what arrives along them is a
constant. L_behind is what an outline hides, and ds_behind its motion on the film, zero if it stands still. In the
shadow term the line through an edge along d ends at a lit point that the camera sees: f is its reflectance towards
the camera, J' = |N . (p_lit - o)| / z^3 there, with a unit normal, and L_past and L_hit are seen on either side.

All three are linear in the motion of the vertices, so one backward pass serves any number of geometric dimensions.

Source: the material form is that of Zhang, Miller, Yan, Gkioulekas and Zhao, "Path-Space Differentiable Rendering"
(2020), section 4; sampling edges follows Li, Aittala, Durand and Lehtinen (2018). We depart from both in that geometry
counts at the first hit and its shadow ray only; see `LIMITS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.backend import mitsuba

EDGE_OFFSET = 0.01
"""How far beside an outline we look for what is behind it, in pixels."""
DEPTH_TOLERANCE = 1e-3
"""Something hides an edge if it is nearer than this fraction of the distance."""
SHADOW_OFFSET = 1e-4
"""How far beside an edge a shadow ray passes, in extents of the mesh."""
GRAZING = 0.02
"""Smallest cosine at a lit point that is divided by."""
NEAREST = 1e-3
"""Smallest depth of an edge that is used, in world units; there is no clipping of edges."""
ROUGH_COTANGENT = 0.5
"""A cotangent whose neighbours are less correlated than this counts as rough."""
ROUGH_TILE = 16
"""Pixels along a tile that shares its random numbers, for a rough cotangent."""
_OUTLINES, _PATHS, _SHADOWS = 1, 2, 3
"""Streams of random numbers of one seed; the interior has number 0."""


@dataclass(frozen=True)
class Limit:
    """Something that the estimator does not cover.

    Attributes:
        what: in words.
        measured: what it costs, as measured at 128 x 128 pixels, 16 samples a pixel.
    """

    what: str
    measured: str


LIMITS: tuple[Limit, ...] = (
    Limit(
        "without shadow samples the shadows of the mesh, on the ground and on itself, do not move",
        "mug on the ground, direct light: cosine 0.65 without, 0.995 with 4 shadow samples a pixel",
    ),
    Limit(
        "light that reaches the camera over more than one surface is a constant at the first, and its shadows stay",
        "mug on the ground, 6 segments: error 0.34, cosine 0.95 (smooth cotangent), 0.09 and 0.997 (2 pixels); "
        "chair on the ground: 0.34, 0.97 and 0.43, 0.92",
    ),
    Limit(
        "a cotangent that changes from pixel to pixel is smoothed by a tent two pixels wide, and the noise grows",
        "variance x time against central differences of 16 samples, six axes: 15 times better for cotangents smooth "
        "over 16 pixels, 4 to 14 times over 2 pixels, 0.1 to 1 times for white ones, which are off by 0.33",
    ),
    Limit(
        "polished surfaces are noisy, since directions of light are fixed in the world; a mirror's reflections stay",
        "roughness 0.3, 0.1, 0.02: noise of a rotation 0.1, 0.4, 4.5 where the gradient is 4",
    ),
    Limit(
        "direct sun: shadow samples ignore where the light comes from, so they are noisy",
        "low sun, ground alone, 16 shadow samples a pixel: noise 0.16 where the gradient is 0.23",
    ),
    Limit(
        "a deformation that is not rigid reads low, for a reason not found yet",
        "smooth deformation of a mug or ball: 4 to 5 % low with normals that follow, 7 to 13 % with normals held",
    ),
    Limit("shadows of point, spot and directional lights stay where they are", "not measured: derivative 0"),
    Limit("a surface that cuts through another: the line where they meet is taken for fixed", "not measured: about 0"),
    Limit(
        "a thin lens counts as a pinhole; participating media and what shines on the mesh itself are left out",
        "not measured",
    ),
)
"""What the estimator does not cover, and what that cost where it was measured. Errors are relative, of the mean of
several seeds over six pose axes; noise is the standard deviation of one estimate."""


# ---- the public function --------------------------------------------------------------------------------------------


def material_adjoint(
    scene: Any,
    sensor: Any,
    parameters: Any,
    *,
    mesh_key: str | Sequence[str],
    vertices: Any,
    normals: Any,
    cotangent: Tensor,
    seed: int,
    spp: int,
    boundary_spp: int = 4,
    max_depth: int = 6,
    shadow_spp: int = 0,
) -> Any:
    """Return the gradient of `sum(cotangent * radiance)` with respect to vertex places and vertex normals.

    The scene is only read. Nothing is recorded with `dr.freeze`. The first call for a depth makes a path tracer.

    Args:
        scene: Mitsuba's scene, loaded with `optimize=False`.
        sensor: a perspective camera of it; a thin lens is taken for a pinhole.
        parameters: `mi.traverse(scene)`.
        mesh_key: name of the moving mesh; a list for several that move.
        vertices: (V, 3) float32, world units, as the scene has them; a list if `mesh_key` is one.
        normals: (V, 3) float32, as the scene has them; a list if `mesh_key` is one.
        cotangent: (H, W, 3) float32, derivative of the loss by the radiance of box-filtered pixels.
        seed: number of the noise, at least 0.
        spp: samples a pixel of the interior term.
        boundary_spp: samples of the outlines of each mesh, in multiples of the number of pixels; 0 leaves them out.
        max_depth: longest light path in segments, of which only the first two move with the vertices.
        shadow_spp: samples of the edges that cast shadows, in multiples of the number of pixels; 0 leaves them out.

    Returns:
        The gradients by the vertices and by the normals, (V, 3) float32 each; two lists if `mesh_key` is one.
    """
    _, dr = _backend()
    single = isinstance(mesh_key, str)
    keys: list[str] = [mesh_key] if isinstance(mesh_key, str) else list(mesh_key)
    places, bent = ([vertices], [normals]) if single else (vertices, normals)
    meshes = [_moving_mesh(scene, parameters, *one) for one in zip(keys, places, bent, strict=True)]
    still = _still_meshes(scene, parameters, keys)
    view = _View(scene, _camera(sensor), meshes, still, _flat(_padded(cotangent)), max_depth)
    total = mitsuba().Float(0)
    if spp > 0:
        total += _interior(view, seed, spp, ROUGH_TILE if _rough(cotangent) else 1)
    for number, mesh in enumerate([*meshes, *still]):
        total += _outlines(view, mesh, _stream(seed, _OUTLINES, number), boundary_spp)
        total += _shadows(view, mesh, _stream(seed, _SHADOWS, number), shadow_spp)
    if dr.grad_enabled(total):
        dr.backward(total)
    found = [(_gradient(mesh.positions), _gradient(mesh.normals)) for mesh in meshes]
    return found[0] if single else tuple(list(one) for one in zip(*found, strict=True))


def _backend() -> tuple[Any, Any]:
    """Mitsuba and Dr.Jit, untyped: what Dr.Jit says of its types is incomplete."""
    mi = mitsuba()
    import drjit

    return mi, drjit


# ---- the scene as we see it -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Camera:
    """A pinhole camera: its Dr.Jit transforms, and what torch needs of it."""

    eye: Any
    forward: Any
    to_film: Any
    to_local: Any
    width: int
    height: int

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def project(self, point: Any) -> Any:
        """Film position in pixels of a point, differentiable."""
        mi = mitsuba()
        seen = self.to_film @ (self.to_local @ mi.Point3f(point))
        return mi.Point2f(seen.x * self.width, seen.y * self.height)

    def depth(self, point: Any) -> Any:
        """Distance along the viewing axis."""
        _, dr = _backend()
        return dr.dot(point - self.eye, self.forward)

    def ray(self, film: Any) -> Any:
        """The ray through a film position in pixels."""
        mi, dr = _backend()
        near = self.to_film.inverse() @ mi.Point3f(film.x / self.width, film.y / self.height, 0.0)
        return mi.Ray3f(self.eye, dr.normalize(self.to_local.inverse() @ mi.Vector3f(near)))

    def shows(self, film: Any) -> Any:
        """Whether a film position can count: the cotangent reaches half a pixel past the border."""
        inside = (film.x > -0.5) & (film.y > -0.5)
        return inside & (film.x < self.width + 0.5) & (film.y < self.height + 0.5)

    @property
    def focal_area(self) -> float:
        """Pixels per unit of tangent, horizontally times vertically."""
        matrix = self.to_film.matrix
        return abs(float(matrix[0, 0][0]) * self.width * float(matrix[1, 1][0]) * self.height)


def _camera(sensor: Any) -> _Camera:
    mi, dr = _backend()
    to_world = sensor.world_transform()
    width, height = (int(side) for side in sensor.film().crop_size())
    forward = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
    film = sensor.projection_transform()
    return _Camera(to_world @ mi.Point3f(0.0), forward, film, to_world.inverse(), width, height)


@dataclass(frozen=True)
class _Mesh:
    """A mesh, for Dr.Jit and for torch.

    Attributes:
        shape: Mitsuba's pointer.
        positions: flat Dr.Jit array, with gradients enabled if the mesh moves.
        normals: the same for the vertex normals.
        faces: flat Dr.Jit array.
        smooth: shading normals are interpolated.
        corners: (F, 3) int64.
        places: (V, 3) float64.
    """

    shape: Any
    positions: Any
    normals: Any
    faces: Any
    smooth: bool
    corners: Tensor
    places: Tensor

    @property
    def extent(self) -> float:
        return float((self.places.amax(dim=0) - self.places.amin(dim=0)).max())

    def point(self, ends: Tensor, part: Tensor) -> Any:
        """Points on edges, attached; ends (n, 2) vertices, part (n,) in [0, 1] of the way."""
        mi, dr = _backend()
        a, b = (dr.gather(mi.Point3f, self.positions, _indices(ends[:, side])) for side in (0, 1))
        return dr.fma(b - a, _numbers(part), a)


def _mesh(shape: Any, faces: Any, vertices: Tensor, normals: Tensor) -> _Mesh:
    corners = faces.torch().reshape(-1, 3).to("cpu", torch.int64)
    smooth = bool(shape.has_vertex_normals())
    places = vertices.detach().to("cpu", torch.float64)
    return _Mesh(mitsuba().ShapePtr(shape), _flat(vertices), _flat(normals), faces, smooth, corners, places)


def _moving_mesh(scene: Any, parameters: Any, key: str, vertices: Tensor, normals: Tensor) -> _Mesh:
    _, dr = _backend()
    shape = next(shape for shape in scene.shapes() if shape.id() == key)
    mesh = _mesh(shape, parameters[f"{key}.faces"], vertices, normals)
    dr.enable_grad(mesh.positions, mesh.normals)
    return mesh


def _still_meshes(scene: Any, parameters: Any, moving: Sequence[str]) -> list[_Mesh]:
    """Meshes that stand still but may hide a moving one, or shade it. A single rectangle is left out."""
    found = []
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() > 2 and shape.id() not in moving:
            places = parameters[f"{shape.id()}.vertex_positions"].torch().reshape(-1, 3).clone()
            found.append(_mesh(shape, parameters[f"{shape.id()}.faces"], places, torch.zeros_like(places)))
    return found


@dataclass(frozen=True)
class _View:
    """What the three terms share: `weights` is the cotangent with a border of zeros, flat."""

    scene: Any
    camera: _Camera
    meshes: Sequence[_Mesh]
    still: Sequence[_Mesh]
    weights: Any
    max_depth: int

    def weight(self, film: Any, active: Any) -> Any:
        """The cotangent at a film position, bilinear between pixel centres, zero outside; differentiable in it."""
        mi, dr = _backend()
        width, height = self.camera.width, self.camera.height
        active = active & self.camera.shows(dr.detach(film))
        at = film + 0.5
        base = dr.floor(dr.detach(at))
        cell = mi.Point2u(dr.clip(base.x, 0, width), dr.clip(base.y, 0, height))
        part = at - mi.Point2f(cell)
        corner = cell.y * (width + 2) + cell.x
        texels = [dr.gather(mi.Color3f, self.weights, corner + i, active) for i in (0, 1, width + 2, width + 3)]
        top, bottom = dr.lerp(texels[0], texels[1], part.x), dr.lerp(texels[2], texels[3], part.x)
        return dr.lerp(top, bottom, part.y) & active

    def follow(self, hit: Any) -> tuple[Any, Any, Any, Any]:
        """Return a hit's place, triangle normal (times twice the area) and shading normal, attached to the vertices,
        and whether it is on a moving mesh at all; elsewhere they mean nothing."""
        mi, dr = _backend()
        place, facet, bent, moves = mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1), mi.Bool(False)
        u, v = hit.prim_uv
        for mesh in self.meshes:
            on = hit.is_valid() & (hit.shape == mesh.shape)
            corner = dr.gather(mi.Point3u, mesh.faces, hit.prim_index, on)
            a, b, c = (dr.gather(mi.Point3f, mesh.positions, one, on) for one in corner)
            normal = mi.Normal3f(dr.cross(b - a, c - a))
            place = dr.select(on, dr.fma(b - a, u, dr.fma(c - a, v, a)), place)
            facet = dr.select(on, normal, facet)
            if mesh.smooth:
                a, b, c = (dr.gather(mi.Normal3f, mesh.normals, one, on) for one in corner)
                normal = dr.fma(b - a, u, dr.fma(c - a, v, a))
            bent, moves = dr.select(on, normal, bent), moves | on
        return place, facet, bent, moves

    def radiance(self, ray: Any, sampler: Any, depth: int, active: Any) -> Any:
        """One sample of what arrives along a ray, over paths of up to `depth` segments; a constant."""
        _, dr = _backend()
        tracer = _path_tracer(max(depth, 1))
        return tracer.sample(dr.ADMode.Primal, self.scene, sampler, ray, None, None, active)[0]


@cache
def _path_tracer(depth: int) -> Any:
    return mitsuba().load_dict({"type": "prb", "max_depth": depth, "rr_depth": 1000})


# ---- random numbers, and the way between torch and Dr.Jit -----------------------------------------------------------


@cache
def _sampler_type() -> Any:
    mi = mitsuba()

    class Sampler:
        """What a path tracer asks of a sampler, over a generator whose state is ours to share."""

        DRJIT_STRUCT = {"rng": mi.PCG32}  # noqa: RUF012 (Dr.Jit wants a plain dictionary)

        def __init__(self) -> None:
            self.rng = mi.PCG32()

        def next_1d(self, active: Any = True) -> Any:
            return self.rng.next_float32()

        def next_2d(self, active: Any = True) -> Any:
            return mi.Point2f(self.rng.next_float32(), self.rng.next_float32())

    return Sampler


def _sampler(stream: int, count: int, index: Any) -> Any:
    """One of `count` streams of numbers for every lane; lanes of the same index draw the same numbers."""
    mi, dr = _backend()
    base = mi.PCG32(count, mi.UInt64(stream))
    sampler = _sampler_type()()
    sampler.rng.state = dr.gather(mi.UInt64, base.state, index)
    sampler.rng.inc = dr.gather(mi.UInt64, base.inc, index)
    return sampler


def _own_sampler(stream: int, count: int) -> Any:
    mi, dr = _backend()
    return _sampler(stream, count, dr.arange(mi.UInt32, count))


def _stream(seed: int, purpose: int, number: int = 0) -> int:
    """A starting state below 2^63, well apart for neighbouring seeds."""
    return (((seed * 64 + number) * 4 + purpose + 1) * 0x9E3779B97F4A7C15) % 2**63


def _uniform(stream: int, count: int, dimensions: int) -> Tensor:
    """(count, dimensions) float64 in [0, 1)."""
    return torch.rand(count, dimensions, generator=torch.Generator().manual_seed(stream), dtype=torch.float64)


def _flat(tensor: Tensor) -> Any:
    return mitsuba().TensorXf(tensor.detach().to("cpu", torch.float32).contiguous()).array


def _numbers(tensor: Tensor) -> Any:
    return mitsuba().Float(tensor.to(torch.float32).contiguous())


def _indices(tensor: Tensor) -> Any:
    return mitsuba().UInt32(tensor.to(torch.int32).contiguous())


def _vectors(kind: Any, tensor: Tensor) -> Any:
    return kind(*(_numbers(tensor[:, axis]) for axis in range(3)))


def _vector(value: Any) -> Tensor:
    """(3,) float64 of a single Dr.Jit vector."""
    return torch.tensor([value.x[0], value.y[0], value.z[0]], dtype=torch.float64)


def _films(camera: _Camera, places: Tensor) -> Tensor:
    """(n, 2) float64 film positions of (n, 3) points."""
    mi = mitsuba()
    film = camera.project(_vectors(mi.Point3f, places))
    return torch.stack([film.x.torch(), film.y.torch()], dim=1).to("cpu", torch.float64)


def _gradient(value: Any) -> Tensor:
    _, dr = _backend()
    found: Tensor = dr.grad(value).torch().reshape(-1, 3).cpu().clone()
    return found


def _padded(cotangent: Tensor) -> Tensor:
    return torch.nn.functional.pad(cotangent.detach(), (0, 0, 1, 1, 1, 1))


def _rough(cotangent: Tensor) -> bool:
    """Whether neighbouring pixels ask for nearly unrelated things.

    The gradient of such a cotangent has no preferred sign within a few pixels. Then the noise of the radiance cancels
    if it is the same there; for a smooth cotangent it averages out better if it is not.
    """
    values = cotangent.detach().to(torch.float64)
    right, down = (torch.diff(values, dim=dim).square().mean() for dim in (1, 0))
    return bool(right + down > 4.0 * (1.0 - ROUGH_COTANGENT) * values.square().mean())


# ---- inside the outlines --------------------------------------------------------------------------------------------


def _interior(view: _View, seed: int, spp: int, tile: int) -> Any:
    """A number whose gradient is the interior term's."""
    mi, dr = _backend()
    with dr.suspend_grad():
        film, hit, sampler = _first_hits(view, seed, spp, tile)
        if dr.width(film) == 0:
            return mi.Float(0)
        si = hit.compute_surface_interaction(view.camera.ray(film), mi.RayFlags.All)
    attached = view.follow(hit)[:3]
    loose = [type(one)(dr.detach(one)) for one in attached]
    dr.enable_grad(loose)
    dr.backward(_contributions(view, film, si, sampler, *loose))
    total = mi.Float(0)
    for one, free in zip(attached, loose, strict=True):
        pull = dr.grad(free)
        usable = dr.all(dr.isfinite(pull))
        total += dr.sum(dr.select(usable, dr.dot(one, dr.select(usable, pull, 0)), 0))
    return total / spp


def _first_hits(view: _View, seed: int, spp: int, tile: int) -> tuple[Any, Any, Any]:
    """Film positions that see a moving mesh, the hits, and the random numbers from there on.

    The film is cut into cells between pixel centres, `spp` samples in each, stratified.
    """
    mi, dr = _backend()
    columns, rows = view.camera.width + 1, view.camera.height + 1
    lane = dr.arange(mi.UInt32, columns * rows * spp)
    cell, sample = lane // spp, lane % spp
    column, row = cell % columns, cell // columns
    tiles = -(-columns // tile)
    group = (row // tile * tiles + column // tile) * spp + sample
    sampler = _sampler(_stream(seed, 0), tiles * -(-rows // tile) * spp, group)
    across = max(n for n in range(1, int(spp**0.5) + 1) if spp % n == 0)
    strata = mi.Point2f(sample % across, sample // across)
    film = mi.Point2f(column, row) - 0.5 + (strata + sampler.next_2d()) / mi.Point2f(across, spp // across)
    hit = view.scene.ray_intersect_preliminary(view.camera.ray(film), coherent=True)
    on = mi.Bool(False)
    for mesh in view.meshes:
        on |= hit.is_valid() & (hit.shape == mesh.shape)
    dr.eval(on, film, hit, sampler)
    kept = dr.compress(on)
    film, hit, sampler.rng = (dr.gather(type(one), one, kept) for one in (film, hit, sampler.rng))
    return film, hit, sampler


def _contributions(view: _View, film: Any, si: Any, sampler: Any, place: Any, facet: Any, bent: Any) -> Any:
    """Sum of W L J / J over all samples, attached to the given places and normals."""
    mi, dr = _backend()
    camera = view.camera
    spread = dr.dot(facet, place - camera.eye) / camera.depth(place) ** 3
    seen = dr.replace_grad(film, camera.project(place))
    weight = view.weight(seen, mi.Bool(True))
    radiance = _reflected(view, _attached(camera, si, place, facet, bent), si, sampler)
    return dr.sum(dr.sum(weight * radiance) * _relative(spread))


def _relative(value: Any) -> Any:
    """1 with the relative gradient of a value; without gradient where the value is all but zero."""
    _, dr = _backend()
    fixed = dr.detach(value)
    usable = dr.abs(fixed) > 1e-20
    return dr.replace_grad(dr.full(type(fixed), 1.0), dr.select(usable, value / dr.select(usable, fixed, 1.0), 1.0))


def _attached(camera: _Camera, si: Any, place: Any, facet: Any, bent: Any) -> Any:
    """Mitsuba's surface interaction, moving with the surface and turning with its normals."""
    mi, dr = _backend()

    def turned(fixed: Any, normal: Any) -> Any:
        """A normal with the gradient of ours, which may point the other way."""
        return dr.replace_grad(fixed, dr.mulsign(dr.normalize(normal), dr.dot(dr.detach(normal), fixed)))

    at = mi.SurfaceInteraction3f(si)
    at.p = dr.replace_grad(si.p, place)
    at.n = turned(si.n, facet)
    normal, s = turned(si.sh_frame.n, bent), si.sh_frame.s
    s = dr.replace_grad(s, dr.normalize(dr.fma(-normal, dr.dot(normal, s), s)))
    at.sh_frame = mi.Frame3f(s, dr.cross(normal, s), normal)
    at.wi = dr.replace_grad(si.wi, at.sh_frame.to_local(dr.normalize(camera.eye - place)))
    return at


def _reflected(view: _View, at: Any, si: Any, sampler: Any) -> Any:
    """One sample of the light reflected towards the camera, from directions fixed in the world."""
    mi, dr = _backend()
    context, bsdf = mi.BSDFContext(), si.bsdf()
    with dr.suspend_grad():
        active = mi.Bool(view.max_depth > 1)
        lit = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = view.scene.sample_emitter_direction(si, sampler.next_2d(), True, lit)
        lit &= ds.pdf != 0.0
        picked, through = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        active &= dr.any(through != 0.0)
        direction = si.to_world(picked.wo)
        smooth = ~mi.has_flag(picked.sampled_type, mi.BSDFFlags.Delta)
        arriving = through * _arriving(view, si, direction, picked.pdf, smooth, sampler, active)
    ds, light = _attached_light(view, at, ds, light, lit)
    value, pdf = bsdf.eval_pdf(context, at, at.to_local(ds.d), lit)
    mis = dr.select(ds.delta, 1.0, _mis(ds.pdf, dr.detach(pdf)))
    total = dr.select(lit, value * light * mis, 0.0)
    value = bsdf.eval(context, at, at.to_local(direction), active & smooth)
    relative = mi.Color3f(*(_relative(dr.select(smooth, channel, 1.0)) for channel in value))
    return total + dr.select(active, arriving * relative, 0.0)


def _attached_light(view: _View, at: Any, ds: Any, light: Any, lit: Any) -> tuple[Any, Any]:
    """A light sample seen from a moving point. What is infinitely far away does not change."""
    mi, dr = _backend()
    near = lit & ~mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    surface = near & mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
    moved = dr.copy(ds)
    moved.d = dr.select(near, dr.replace_grad(ds.d, dr.normalize(ds.p - at.p)), ds.d)
    shining = view.scene.eval_emitter_direction(at, moved, near)
    shining = dr.select(near, shining / dr.select(near, ds.pdf, 1.0), light)
    fall = dr.dot(ds.n, moved.d) / dr.select(surface, dr.squared_norm(ds.p - at.p), 1.0)
    return moved, dr.replace_grad(light, shining) * dr.select(surface, _relative(fall), 1.0)


def _arriving(view: _View, si: Any, direction: Any, pdf: Any, smooth: Any, sampler: Any, active: Any) -> Any:
    """Radiance from a sampled direction; what shines there itself is weighted against light sampling."""
    mi = mitsuba()

    ray = si.spawn_ray(direction)
    everything = view.radiance(ray, sampler, view.max_depth - 1, active)
    there = view.scene.ray_intersect(ray, active)
    ds = mi.DirectionSample3f(view.scene, si=there, ref=si)
    other = view.scene.pdf_emitter_direction(si, ds, active & smooth)
    return everything - (1.0 - _mis(pdf, other)) * ds.emitter.eval(there, active & smooth)


def _mis(own: Any, other: Any) -> Any:
    """Power heuristic."""
    _, dr = _backend()
    weight = dr.fma(own, own, other * other)
    return dr.select(weight > 0.0, own * own / weight, 0.0)


# ---- outlines -------------------------------------------------------------------------------------------------------


def _outlines(view: _View, mesh: _Mesh, stream: int, spp: int) -> Any:
    """A number whose gradient is the outline term's, for the edges of one mesh."""
    mi, dr = _backend()
    found = _sampled_outline(view.camera, mesh, _uniform(stream, spp * view.camera.pixels, 1)[:, 0])
    if found is None:
        return mi.Float(0)
    ends, part, normal, share = found
    n = mi.Vector2f(_numbers(normal[:, 0]), _numbers(normal[:, 1]))
    edge = mesh.point(ends, part)
    film = view.camera.project(edge)
    with dr.suspend_grad():
        ray = view.camera.ray(dr.detach(film) + EDGE_OFFSET * n)
        hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
        reach = dr.norm(dr.detach(edge) - view.camera.eye) * (1.0 - DEPTH_TOLERANCE)
        visible = ~hit.is_valid() | (hit.t > reach)
        behind = view.radiance(ray, _own_sampler(stream + _PATHS, len(part)), view.max_depth, visible)
        strength = dr.sum(view.weight(film, visible) * behind)
        strength = dr.select(visible & dr.isfinite(strength), strength, 0.0)
        dr.eval(strength, hit)
    place, _, _, moves = view.follow(hit)
    speed = dr.dot(n, film - dr.select(moves, view.camera.project(place), 0.0))
    return dr.sum(strength * speed) * -share


def _sampled_outline(camera: _Camera, mesh: _Mesh, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, float] | None:
    """Sample the outline evenly by its length on the film, hidden parts included.

    Args:
        camera: the camera.
        mesh: the mesh.
        numbers: (n,) in [0, 1), one for each sample.

    Returns:
        None if nothing is in the picture; else (n, 2) vertices of the edge, (n,) part of the way along it in space,
        (n, 2) unit normal on the film away from the mesh, and the length in pixels for each sample.
    """
    eye, forward = _vector(camera.eye), _vector(camera.forward)
    ends, away = _silhouette(mesh.places, mesh.corners, eye)
    if len(ends) == 0 or len(numbers) == 0:
        return None
    a, b = _films(camera, mesh.places[ends[:, 0]]), _films(camera, mesh.places[ends[:, 1]])
    depth = (mesh.places[ends] - eye) @ forward
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    shown = (depth > NEAREST).all(dim=1) & ((torch.maximum(a, b) > -0.5) & (torch.minimum(a, b) < size + 0.5)).all(
        dim=1
    )
    length = torch.where(shown, (b - a).norm(dim=1), 0.0)
    if not float(length.sum()) > 0.0:
        return None
    pick, part = _along(length, numbers)
    along = b[pick] - a[pick]
    normal = torch.nn.functional.normalize(torch.stack([along[:, 1], -along[:, 0]], dim=1), dim=1)
    middle = mesh.places[ends].mean(dim=1)
    step = _films(camera, middle + 1e-3 * mesh.extent * away) - _films(camera, middle)
    normal = normal * torch.where((normal * step[pick]).sum(dim=1, keepdim=True) < 0.0, -1.0, 1.0)
    z = depth[pick]
    part = part * z[:, 0] / (part * z[:, 0] + (1.0 - part) * z[:, 1])  # halfway on the film is not halfway in space
    return ends[pick], part, normal, float(length.sum()) / len(numbers)


def _along(length: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Spread n stratified samples over segments of given lengths: (n,) which segment, (n,) which part of it."""
    sums = length.cumsum(dim=0)
    at = (torch.arange(len(numbers)) + numbers) / len(numbers) * sums[-1]
    pick = torch.searchsorted(sums, at, right=True).clamp_max(int(length.nonzero().max()))
    return pick, (1.0 - (sums[pick] - at) / length[pick]).clamp(0.0, 1.0)


def _edges(places: Tensor, corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Edges of a mesh, vertices at the same place counting as one.

    Returns:
        (E, 2) vertices of each edge; for each of the 3 F sides of faces, (3 F,) which edge it is and (3 F,) the
        vertex across.
    """
    same = torch.unique(places, dim=0, return_inverse=True)[1]
    sides = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    across = torch.cat([corners[:, 2], corners[:, 0], corners[:, 1]])
    low, high = same[sides].aminmax(dim=1)
    keys, owner = torch.unique(low * len(places) + high, return_inverse=True)
    number = torch.arange(len(owner))
    first = torch.full((len(keys),), len(owner)).scatter_reduce(0, owner, number, "amin")  # repeatable, unlike indexing
    return sides[first], owner, across


def _silhouette(places: Tensor, corners: Tensor, eye: Tensor) -> tuple[Tensor, Tensor]:
    """Edges all of whose faces lie on one side of the plane through the edge and the eye.

    Returns:
        (n, 2) vertices of each, and (n, 3) the unit normal of that plane, away from the faces.
    """
    ends, owner, across = _edges(places, corners)
    plane = torch.linalg.cross(places[ends[:, 0]] - eye, places[ends[:, 1]] - eye)
    plane = torch.nn.functional.normalize(plane, dim=1)
    side = (plane[owner] * (places[across] - eye)).sum(dim=1)
    lowest = torch.full((len(ends),), torch.inf, dtype=side.dtype).scatter_reduce(0, owner, side, "amin")
    highest = torch.full((len(ends),), -torch.inf, dtype=side.dtype).scatter_reduce(0, owner, side, "amax")
    on = (lowest > 0.0) | (highest < 0.0)
    return ends[on], plane[on] * torch.where(lowest[on] > 0.0, -1.0, 1.0)[:, None]


# ---- shadows --------------------------------------------------------------------------------------------------------


def _shadows(view: _View, mesh: _Mesh, stream: int, spp: int) -> Any:
    """A number whose gradient is the shadow term's, for the edges of one mesh."""
    mi, dr = _backend()
    found = _sampled_tangents(mesh, _uniform(stream, spp * view.camera.pixels, 4))
    if found is None:
        return mi.Float(0)
    ends, part, direction, normal, share = found
    p = _vectors(mi.Point3f, torch.lerp(mesh.places[ends[:, 0]], mesh.places[ends[:, 1]], part[:, None]))
    d, n = _vectors(mi.Vector3f, direction), _vectors(mi.Vector3f, normal)
    beside = SHADOW_OFFSET * mesh.extent * n
    with dr.suspend_grad():
        ray = mi.Ray3f(p + beside, -d)
        hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, hit.is_valid())
        value = _lit_value(view, si, d)
        dr.eval(value, hit, si, p, beside)
        kept = dr.compress(dr.any(value != 0.0))
        if dr.width(kept) == 0:
            return mi.Float(0)
        value, hit, si, p, beside, n = (dr.gather(type(one), one, kept) for one in (value, hit, si, p, beside, n))
        strength = dr.sum(value * _past_minus_hit(view, si, p, beside, stream))
        strength = dr.select(dr.isfinite(strength), strength, 0.0)
        dr.eval(strength, hit)
    chosen = kept.torch().to("cpu", torch.int64)
    place, _, _, moves = view.follow(hit)
    sine = torch.linalg.cross(direction, _unit_edges(mesh.places, ends)).norm(dim=1)
    speed = dr.dot(n, mesh.point(ends[chosen], part[chosen]) - dr.select(moves, place, 0.0))
    return dr.sum(strength * _numbers(sine[chosen]) * speed) * -share


def _lit_value(view: _View, si: Any, d: Any) -> Any:
    """W f J' of lit points that the camera sees, for light from d; elsewhere 0."""
    mi, dr = _backend()
    camera = view.camera
    film, depth, to_eye = camera.project(si.p), camera.depth(si.p), camera.eye - si.p
    active = si.is_valid() & (depth > NEAREST) & camera.shows(film)
    si.wi = si.to_local(dr.normalize(to_eye))
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(d), active)
    active &= dr.any(value > 0.0)
    active &= ~view.scene.ray_test(si.spawn_ray_to(camera.eye), active)
    scale = dr.abs(dr.dot(si.n, to_eye)) / depth**3 * camera.focal_area
    value *= scale / dr.maximum(dr.abs(dr.dot(si.n, d)), GRAZING)
    return dr.select(active, value * view.weight(film, active), 0.0)


def _past_minus_hit(view: _View, si: Any, p: Any, beside: Any, stream: int) -> Any:
    """Difference of the radiance that arrives at a lit point just past an edge and just inside it."""
    mi, dr = _backend()

    def seen(target: Any, active: Any) -> Any:
        ray = towards(target)
        return view.radiance(ray, _own_sampler(stream + _PATHS, dr.width(p)), view.max_depth - 1, active)

    def towards(target: Any) -> Any:
        ray = si.spawn_ray_to(target)
        return mi.Ray3f(ray.o, ray.d)

    first = view.scene.ray_intersect_preliminary(towards(p + beside), coherent=False)
    reach = dr.norm(p - si.p) * (1.0 - DEPTH_TOLERANCE) - 2.0 * dr.norm(beside)
    free = ~first.is_valid() | (first.t > reach)
    return dr.select(free, seen(p + beside, free) - seen(p - beside, free), 0.0)


def _sampled_tangents(mesh: _Mesh, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, float] | None:
    """Sample points on edges and lines through them that touch the mesh there, evenly.

    The lines through a point of an edge that have both faces on one side fill the exterior angle of the edge, to
    either side. An edge with one face lets every line pass.

    Args:
        mesh: the mesh.
        numbers: (n, 4) in [0, 1).

    Returns:
        None if there is nothing to sample; else (n, 2) vertices of the edge, (n,) part of the way along it, (n, 3)
        unit direction of the line, (n, 3) unit normal of edge and line away from the mesh, and the measure (world
        units times steradians) for each sample.
    """
    ends, one, two, single = _folds(mesh.places, mesh.corners)
    cosine = (one * two).sum(dim=1, keepdim=True)
    rest = one - cosine * two
    axis = _unit_edges(mesh.places, ends)
    turned = torch.where(single[:, None], torch.linalg.cross(axis, two), -torch.nn.functional.normalize(rest, dim=1))
    angle = torch.pi - torch.atan2(rest.norm(dim=1), cosine[:, 0])
    measure = (mesh.places[ends[:, 1]] - mesh.places[ends[:, 0]]).norm(dim=1) * angle
    if len(numbers) == 0 or not float(measure.sum()) > 0.0:
        return None
    pick, _ = _along(measure, numbers[:, 0])
    ends, one, two, turned, axis = (tensor[pick] for tensor in (ends, one, two, turned, axis))
    turn = numbers[:, 2:3] * angle[pick][:, None]
    across = torch.cos(turn) * two + torch.sin(turn) * turned
    height = 4.0 * numbers[:, 3:4] - 2.0  # the sign chooses the side, the rest is the cosine with the edge
    across, height = torch.where(height < 0.0, -across, across), height.abs() - 1.0
    direction = height * axis + (1.0 - height.square()).clamp_min(0.0).sqrt() * across
    normal = torch.linalg.cross(axis, across)
    normal = normal * torch.where((normal * (one + two)).sum(dim=1, keepdim=True) > 0.0, -1.0, 1.0)
    return ends, numbers[:, 1], direction, normal, 4.0 * float(measure.sum()) / len(numbers)


def _folds(places: Tensor, corners: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Edges of one or two faces: (E, 2) vertices, (E, 3) unit vectors along one face and along the other, both
    perpendicular to the edge, and (E,) whether there is only one face."""
    ends, owner, across = _edges(places, corners)
    order = torch.argsort(owner, stable=True)
    number = torch.bincount(owner, minlength=len(ends))
    last = number.cumsum(dim=0) - 1
    proper = (number <= 2) & ((places[ends[:, 1]] - places[ends[:, 0]]).norm(dim=1) > 0.0)
    ends, axis = ends[proper], _unit_edges(places, ends[proper])

    def perpendicular(corner: Tensor) -> Tensor:
        vector = places[corner] - places[ends[:, 0]]
        return torch.nn.functional.normalize(vector - (vector * axis).sum(dim=1, keepdim=True) * axis, dim=1)

    one, two = (perpendicular(across[order[at[proper]]]) for at in (last - number + 1, last))
    return ends, one, two, number[proper] == 1


def _unit_edges(places: Tensor, ends: Tensor) -> Tensor:
    return torch.nn.functional.normalize(places[ends[:, 1]] - places[ends[:, 0]], dim=1)
