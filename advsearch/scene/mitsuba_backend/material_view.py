"""The material form's view of a scene: camera, meshes, path tracer and random
numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.meshes import FACES, POSITIONS
from advsearch.scene.mitsuba_backend.variant import dr, mi

_OUTLINES = 1  # streams of random numbers of one seed; the interior has number 0
_PATHS = 2
_SHADOWS = 3


class Camera:
    """A pinhole camera, from Mitsuba's sensor: its Dr.Jit transforms, and its size in
    pixels.
    """

    def __init__(self, sensor: Any) -> None:
        to_world = sensor.world_transform()
        self.width, self.height = (int(side) for side in sensor.film().crop_size())
        self.pixels = self.width * self.height
        self.eye = to_world @ mi.Point3f(0.0)
        self.forward = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
        self.to_film, self.to_local = sensor.projection_transform(), to_world.inverse()

    def project(self, point: Any) -> Any:
        """Film position in pixels of a point, differentiable."""
        seen = self.to_film @ (self.to_local @ mi.Point3f(point))
        return mi.Point2f(seen.x * self.width, seen.y * self.height)

    def depth(self, point: Any) -> Any:
        """Distance along the viewing axis."""
        return dr.dot(point - self.eye, self.forward)

    def ray(self, film: Any) -> Any:
        """The ray through a film position in pixels."""
        near = self.to_film.inverse() @ mi.Point3f(
            film.x / self.width, film.y / self.height, 0.0
        )
        return mi.Ray3f(
            self.eye, dr.normalize(self.to_local.inverse() @ mi.Vector3f(near))
        )

    def shows(self, film: Any) -> Any:
        """Whether a film position can count: the cotangent reaches half a pixel past
        the border.
        """
        inside = (film.x > -0.5) & (film.y > -0.5)
        return inside & (film.x < self.width + 0.5) & (film.y < self.height + 0.5)


@dataclass(frozen=True)
class TriMesh:
    """A mesh, for Dr.Jit and for torch: Mitsuba's pointer, flat Dr.Jit arrays,
    positions and vertex normals with gradients enabled if it moves; whether shading
    normals are interpolated; corners (F, 3) int64 and places (V, 3) float64.
    """

    name: str
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
        """Points on edges, attached; ends (n, 2) vertices, part (n,) in [0, 1] of the
        way.
        """
        sides = (
            mi.UInt32(ends[:, side].to(torch.int32).contiguous()) for side in (0, 1)
        )
        a, b = (dr.gather(mi.Point3f, self.positions, side) for side in sides)
        return dr.fma(b - a, as_numbers(part), a)

    def gradients(self) -> dict[str, Tensor]:
        """Return those by the vertices and by the normals, (V, 3) each."""
        both = {
            f"{self.name}.vertices": self.positions,
            f"{self.name}.normals": self.normals,
        }
        return {
            name: dr.grad(values).torch().reshape(-1, 3).cpu().clone()
            for name, values in both.items()
        }


class FilmView:
    """What the three terms share: the cotangent with a border of zeros, flat; the
    meshes that move, in the order of their vertices, and those that stand still but may
    hide or shade them, of which a single rectangle is left out.
    """

    def __init__(
        self,
        scene: Any,
        sensor: Any,
        parameters: Any,
        moving: Mapping[str, Tensor],
        cotangent: Tensor,
        max_depth: int,
    ) -> None:
        self.scene, self.camera, self.max_depth = scene, Camera(sensor), max_depth
        self.weights = as_array(
            torch.nn.functional.pad(cotangent.detach(), (0, 0, 1, 1, 1, 1))
        )
        moves = dict[str, TriMesh]()
        self.still = list[TriMesh]()
        for shape in scene.shapes():
            name = shape.id()
            if f"{name}.vertices" in moving:
                places = moving[f"{name}.vertices"]
                normals = moving[f"{name}.normals"]
            elif shape.is_mesh() and shape.face_count() > 2:
                places = (
                    parameters[f"{name}.{POSITIONS}"].torch().reshape(-1, 3).clone()
                )
                normals = torch.zeros_like(places)
            else:
                continue
            faces = parameters[f"{name}.{FACES}"]
            smooth = bool(shape.has_vertex_normals())
            corners = faces.torch().reshape(-1, 3).to("cpu", torch.int64)
            arrays = as_array(places), as_array(normals), faces, smooth
            mesh = TriMesh(
                name,
                mi.ShapePtr(shape),
                *arrays,
                corners,
                places.detach().to("cpu", torch.float64),
            )
            if f"{name}.vertices" in moving:
                dr.enable_grad(mesh.positions, mesh.normals)
                moves[f"{name}.vertices"] = mesh
            else:
                self.still.append(mesh)
        self.meshes = [moves[name] for name in moving if name in moves]

    def weight(self, film: Any, active: Any) -> Any:
        """The cotangent at a film position, bilinear between pixel centres, zero
        outside; differentiable in it.
        """
        width = self.camera.width
        height = self.camera.height
        active = active & self.camera.shows(dr.detach(film))
        at = film + 0.5
        base = dr.floor(dr.detach(at))
        cell = mi.Point2u(dr.clip(base.x, 0, width), dr.clip(base.y, 0, height))
        part = at - mi.Point2f(cell)
        corner = cell.y * (width + 2) + cell.x
        texels = [
            dr.gather(mi.Color3f, self.weights, corner + i, active)
            for i in (0, 1, width + 2, width + 3)
        ]
        top = dr.lerp(texels[0], texels[1], part.x)
        bottom = dr.lerp(texels[2], texels[3], part.x)
        return dr.lerp(top, bottom, part.y) & active

    def follow(self, hit: Any) -> tuple[Any, Any, Any, Any]:
        """Return a hit's place, triangle normal (times twice the area) and shading
        normal, attached to the vertices, and whether it is on a moving mesh at all;
        elsewhere they mean nothing.
        """
        place = mi.Point3f(0)
        facet = mi.Normal3f(0, 0, 1)
        bent = mi.Normal3f(0, 0, 1)
        moves = mi.Bool(False)
        u, v = hit.prim_uv
        for mesh in self.meshes:
            on = hit.is_valid() & (hit.shape == mesh.shape)
            corners = dr.gather(mi.Point3u, mesh.faces, hit.prim_index, on)
            a, b, c = (
                dr.gather(mi.Point3f, mesh.positions, corner, on) for corner in corners
            )
            normal = mi.Normal3f(dr.cross(b - a, c - a))
            place = dr.select(on, dr.fma(b - a, u, dr.fma(c - a, v, a)), place)
            facet = dr.select(on, normal, facet)
            if mesh.smooth:
                a, b, c = (
                    dr.gather(mi.Normal3f, mesh.normals, corner, on)
                    for corner in corners
                )
                normal = dr.fma(b - a, u, dr.fma(c - a, v, a))
            bent = dr.select(on, normal, bent)
            moves = moves | on
        return place, facet, bent, moves

    def radiance(self, ray: Any, sampler: Any, depth: int, active: Any) -> Any:
        """One sample of what arrives along a ray, over paths of up to `depth` segments;
        a constant.
        """
        tracer = _path_tracer(max(depth, 1))
        return tracer.sample(
            dr.ADMode.Primal, self.scene, sampler, ray, None, None, active
        )[0]


@cache
def _path_tracer(depth: int) -> Any:
    return mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": 1000})


# ---- random numbers, and the way between torch and Dr.Jit
# -----------------------------------------------------------


class _Sampler:
    """What a path tracer asks of a sampler, over a generator whose state is ours to
    share.
    """

    DRJIT_STRUCT = {"rng": mi.PCG32}  # noqa: RUF012 (Dr.Jit wants a plain dictionary)

    def __init__(self) -> None:
        self.rng = mi.PCG32()

    def next_1d(self, active: Any = True) -> Any:
        return self.rng.next_float32()

    def next_2d(self, active: Any = True) -> Any:
        return mi.Point2f(self.rng.next_float32(), self.rng.next_float32())


def sampler_of(stream: int, count: int, index: Any = None) -> Any:
    """One of `count` streams of numbers for every lane, by an index (else its own);
    lanes of one index draw alike.
    """
    base = mi.PCG32(count, mi.UInt64(stream))
    index = dr.arange(mi.UInt32, count) if index is None else index
    sampler = _Sampler()
    sampler.rng.state, sampler.rng.inc = (
        dr.gather(mi.UInt64, values, index) for values in (base.state, base.inc)
    )
    return sampler


def stream_of(seed: int, purpose: int, number: int = 0) -> int:
    """A starting state below 2^63, well apart for neighbouring seeds."""
    return (((seed * 64 + number) * 4 + purpose + 1) * 0x9E3779B97F4A7C15) % 2**63


def uniform_numbers(stream: int, count: int, dimensions: int) -> Tensor:
    """(count, dimensions) float64 in [0, 1)."""
    return torch.rand(
        count,
        dimensions,
        generator=torch.Generator().manual_seed(stream),
        dtype=torch.float64,
    )


def as_array(tensor: Tensor) -> Any:
    return mi.TensorXf(tensor.detach().to("cpu", torch.float32).contiguous()).array


def as_numbers(tensor: Tensor) -> Any:
    return mi.Float(tensor.to(torch.float32).contiguous())


def as_vectors(kind: Any, tensor: Tensor) -> Any:
    return kind(*(as_numbers(tensor[:, axis]) for axis in range(3)))


def film_places(camera: Camera, places: Tensor) -> Tensor:
    """(n, 2) float64 film positions of (n, 3) points."""
    film = camera.project(as_vectors(mi.Point3f, places))
    return torch.stack([film.x.torch(), film.y.torch()], dim=1).to("cpu", torch.float64)


# ---- Boundary terms of the material form: outlines and shadows, by sampled edges (see
# `adjoint`) --------------------

EDGE_OFFSET = 0.01  # how far beside an outline we look for what is behind it, in pixels
# something hides an edge if it is nearer than this fraction of the distance
DEPTH_TOLERANCE = 1e-3
# how far beside an edge a shadow ray passes, in extents of the mesh
SHADOW_OFFSET = 1e-4
GRAZING = 0.02  # smallest cosine at a lit point that is divided by
# smallest depth of an edge that is used, in world units; there is no clipping of edges
NEAREST = 1e-3


def outline_terms(
    view: FilmView, mesh: TriMesh, seed: int, number: int, spp: int
) -> Any:
    """A number whose gradient is the outline term's, for the edges of one mesh, which
    has a number.
    """
    stream = stream_of(seed, _OUTLINES, number)
    sampled = _sampled_outline(
        view.camera, mesh, uniform_numbers(stream, spp * view.camera.pixels, 1)[:, 0]
    )
    if sampled is None:
        return mi.Float(0)
    ends, part, normal, share = sampled
    n = mi.Vector2f(as_numbers(normal[:, 0]), as_numbers(normal[:, 1]))
    edge = mesh.point(ends, part)
    film = view.camera.project(edge)
    with dr.suspend_grad():
        ray = view.camera.ray(dr.detach(film) + EDGE_OFFSET * n)
        hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
        reach = dr.norm(dr.detach(edge) - view.camera.eye) * (1.0 - DEPTH_TOLERANCE)
        visible = ~hit.is_valid() | (hit.t > reach)
        behind = view.radiance(
            ray, sampler_of(stream + _PATHS, len(part)), view.max_depth, visible
        )
        strength = dr.sum(view.weight(film, visible) * behind)
        strength = dr.select(visible & dr.isfinite(strength), strength, 0.0)
        dr.eval(strength, hit)
    place, _, _, moves = view.follow(hit)
    speed = dr.dot(n, film - dr.select(moves, view.camera.project(place), 0.0))
    return dr.sum(strength * speed) * -share


def _sampled_outline(
    camera: Camera, mesh: TriMesh, numbers: Tensor
) -> tuple[Tensor, Tensor, Tensor, float] | None:
    """Sample the outline evenly by its length on the film, hidden parts included, by
    numbers (n,) in [0, 1).

    Returns:
        None if nothing is in the picture; else (n, 2) vertices of the edge, (n,) part
        of the way along it in space, (n,
        2) unit normal on the film away from the mesh, and the length in pixels for each
        sample.
    """
    eye, forward = (
        torch.tensor([axis[0] for axis in way], dtype=torch.float64)
        for way in (camera.eye, camera.forward)
    )

    # Edges all of whose faces lie on one side of the plane through the edge and the
    # eye, and that plane's normal
    ends, owner, across = _edges(mesh.places, mesh.corners)
    plane = torch.linalg.cross(
        mesh.places[ends[:, 0]] - eye, mesh.places[ends[:, 1]] - eye
    )
    plane = torch.nn.functional.normalize(plane, dim=1)
    side = (plane[owner] * (mesh.places[across] - eye)).sum(dim=1)
    lowest = torch.full((len(ends),), torch.inf, dtype=side.dtype).scatter_reduce(
        0, owner, side, "amin"
    )
    highest = torch.full((len(ends),), -torch.inf, dtype=side.dtype).scatter_reduce(
        0, owner, side, "amax"
    )
    on = (lowest > 0.0) | (highest < 0.0)
    ends = ends[on]
    away = plane[on] * torch.where(lowest[on] > 0.0, -1.0, 1.0)[:, None]
    if len(ends) == 0 or len(numbers) == 0:
        return None
    a = film_places(camera, mesh.places[ends[:, 0]])
    b = film_places(camera, mesh.places[ends[:, 1]])
    depth = (mesh.places[ends] - eye) @ forward
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    on_film = (torch.maximum(a, b) > -0.5) & (torch.minimum(a, b) < size + 0.5)
    length = torch.where(
        (depth > NEAREST).all(dim=1) & on_film.all(dim=1), (b - a).norm(dim=1), 0.0
    )
    if not float(length.sum()) > 0.0:
        return None
    pick, part = _along(length, numbers)
    along = b[pick] - a[pick]
    normal = torch.nn.functional.normalize(
        torch.stack([along[:, 1], -along[:, 0]], dim=1), dim=1
    )
    middle = mesh.places[ends].mean(dim=1)
    step = film_places(camera, middle + 1e-3 * mesh.extent * away) - film_places(
        camera, middle
    )
    normal = normal * torch.where(
        (normal * step[pick]).sum(dim=1, keepdim=True) < 0.0, -1.0, 1.0
    )
    z = depth[pick]
    # halfway on the film is not halfway in space
    part = part * z[:, 0] / (part * z[:, 0] + (1.0 - part) * z[:, 1])
    return ends[pick], part, normal, float(length.sum()) / len(numbers)


def _along(length: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Spread n stratified samples over segments of given lengths: (n,) which segment,
    (n,) which part of it.
    """
    sums = length.cumsum(dim=0)
    at = (torch.arange(len(numbers)) + numbers) / len(numbers) * sums[-1]
    pick = torch.searchsorted(sums, at, right=True).clamp_max(
        int(length.nonzero().max())
    )
    return pick, (1.0 - (sums[pick] - at) / length[pick]).clamp(0.0, 1.0)


def _edges(places: Tensor, corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Edges of a mesh, vertices at the same place counting as one: (E, 2) vertices of
    each; for each of the 3 F sides of faces, (3 F,) which edge it is and (3 F,) the
    vertex across.
    """
    same = torch.unique(places, dim=0, return_inverse=True)[1]
    sides = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    across = torch.cat([corners[:, 2], corners[:, 0], corners[:, 1]])
    low, high = same[sides].aminmax(dim=1)
    keys, owner = torch.unique(low * len(places) + high, return_inverse=True)
    number = torch.arange(len(owner))
    # repeatable, unlike indexing
    first = torch.full((len(keys),), len(owner)).scatter_reduce(
        0, owner, number, "amin"
    )
    return sides[first], owner, across


def shadow_terms(
    view: FilmView, mesh: TriMesh, seed: int, number: int, spp: int
) -> Any:
    """A number whose gradient is the shadow term's, for the edges of one mesh, which
    has a number.
    """
    stream = stream_of(seed, _SHADOWS, number)
    sampled = _sampled_tangents(
        mesh, uniform_numbers(stream, spp * view.camera.pixels, 4)
    )
    if sampled is None:
        return mi.Float(0)
    ends, part, direction, normal, share = sampled
    p = as_vectors(
        mi.Point3f,
        torch.lerp(mesh.places[ends[:, 0]], mesh.places[ends[:, 1]], part[:, None]),
    )
    d = as_vectors(mi.Vector3f, direction)
    n = as_vectors(mi.Vector3f, normal)
    beside = SHADOW_OFFSET * mesh.extent * n
    with dr.suspend_grad():
        ray = mi.Ray3f(p + beside, -d)
        hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, hit.is_valid())
        lit = _lit_value(view, si, d)
        dr.eval(lit, hit, si, p, beside)
        kept = dr.compress(dr.any(lit != 0.0))
        if dr.width(kept) == 0:
            return mi.Float(0)
        lit, hit, si, p, beside, n = (
            dr.gather(type(value), value, kept)
            for value in (lit, hit, si, p, beside, n)
        )
        strength = dr.sum(lit * _past_minus_hit(view, si, p, beside, stream))
        strength = dr.select(dr.isfinite(strength), strength, 0.0)
        dr.eval(strength, hit)
    chosen = kept.torch().to("cpu", torch.int64)
    place, _, _, moves = view.follow(hit)
    sine = torch.linalg.cross(direction, _unit_edges(mesh.places, ends)).norm(dim=1)
    speed = dr.dot(
        n, mesh.point(ends[chosen], part[chosen]) - dr.select(moves, place, 0.0)
    )
    return dr.sum(strength * as_numbers(sine[chosen]) * speed) * -share


def _lit_value(view: FilmView, si: Any, d: Any) -> Any:
    """W f J' of lit points that the camera sees, for light from d; elsewhere 0."""
    camera = view.camera
    film = camera.project(si.p)
    depth = camera.depth(si.p)
    to_eye = camera.eye - si.p
    active = si.is_valid() & (depth > NEAREST) & camera.shows(film)
    si.wi = si.to_local(dr.normalize(to_eye))
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(d), active)
    active &= dr.any(value > 0.0)
    active &= ~view.scene.ray_test(si.spawn_ray_to(camera.eye), active)
    matrix = camera.to_film.matrix
    # pixels a unit tangent
    area = abs(
        float(matrix[0, 0][0]) * camera.width * float(matrix[1, 1][0]) * camera.height
    )
    scale = dr.abs(dr.dot(si.n, to_eye)) / depth**3 * area
    value *= scale / dr.maximum(dr.abs(dr.dot(si.n, d)), GRAZING)
    return dr.select(active, value * view.weight(film, active), 0.0)


def _past_minus_hit(view: FilmView, si: Any, p: Any, beside: Any, stream: int) -> Any:
    """Difference of the radiance that arrives at a lit point just past an edge and just
    inside it.
    """

    def towards(target: Any) -> Any:
        ray = si.spawn_ray_to(target)
        return mi.Ray3f(ray.o, ray.d)

    first = view.scene.ray_intersect_preliminary(towards(p + beside), coherent=False)
    reach = dr.norm(p - si.p) * (1.0 - DEPTH_TOLERANCE) - 2.0 * dr.norm(beside)
    free = ~first.is_valid() | (first.t > reach)

    def radiance(target: Any) -> Any:
        sampler = sampler_of(stream + _PATHS, dr.width(p))
        return view.radiance(towards(target), sampler, view.max_depth - 1, free)

    return dr.select(free, radiance(p + beside) - radiance(p - beside), 0.0)


def _sampled_tangents(
    mesh: TriMesh, numbers: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, float] | None:
    """Sample points on edges and lines through them that touch the mesh there, evenly,
    by numbers (n, 4) in [0, 1).

    The lines through a point of an edge that have both faces on one side fill the
    exterior angle of the edge, to either side. An edge with one face lets every line
    pass.

    Returns:
        None if there is nothing to sample; else (n, 2) vertices of the edge, (n,) part
        of the way along it, (n, 3) unit direction of the line, (n, 3) unit normal of
        edge and line away from the mesh, and the measure (world units times steradians)
        for each sample.
    """
    places = mesh.places
    ends, owner, across = _edges(places, mesh.corners)
    order = torch.argsort(owner, stable=True)
    number = torch.bincount(owner, minlength=len(ends))
    last = number.cumsum(dim=0) - 1
    proper = (number <= 2) & (
        (places[ends[:, 1]] - places[ends[:, 0]]).norm(dim=1) > 0.0
    )
    ends = ends[proper]
    single = number[proper] == 1
    axis = _unit_edges(places, ends)

    def along_face(entry: Tensor) -> Tensor:
        """Unit vectors along one of an edge's faces, perpendicular to the edge."""
        vector = places[across[order[entry[proper]]]] - places[ends[:, 0]]
        return torch.nn.functional.normalize(
            vector - (vector * axis).sum(dim=1, keepdim=True) * axis, dim=1
        )

    first = along_face(last - number + 1)
    second = along_face(last)
    cosine = (first * second).sum(dim=1, keepdim=True)
    rest = first - cosine * second
    turned = torch.where(
        single[:, None],
        torch.linalg.cross(axis, second),
        -torch.nn.functional.normalize(rest, dim=1),
    )
    angle = torch.pi - torch.atan2(rest.norm(dim=1), cosine[:, 0])
    measure = (places[ends[:, 1]] - places[ends[:, 0]]).norm(dim=1) * angle
    if len(numbers) == 0 or not float(measure.sum()) > 0.0:
        return None
    pick, _ = _along(measure, numbers[:, 0])
    ends, first, second, turned, axis = (
        tensor[pick] for tensor in (ends, first, second, turned, axis)
    )
    turn = numbers[:, 2:3] * angle[pick][:, None]
    aside = torch.cos(turn) * second + torch.sin(turn) * turned
    # the sign chooses the side, the rest is the cosine with the edge
    height = 4.0 * numbers[:, 3:4] - 2.0
    aside = torch.where(height < 0.0, -aside, aside)
    height = height.abs() - 1.0
    direction = height * axis + (1.0 - height.square()).clamp_min(0.0).sqrt() * aside
    normal = torch.linalg.cross(axis, aside)
    normal = normal * torch.where(
        (normal * (first + second)).sum(dim=1, keepdim=True) > 0.0, -1.0, 1.0
    )
    return (
        ends,
        numbers[:, 1],
        direction,
        normal,
        4.0 * float(measure.sum()) / len(numbers),
    )


def _unit_edges(places: Tensor, ends: Tensor) -> Tensor:
    return torch.nn.functional.normalize(places[ends[:, 1]] - places[ends[:, 0]], dim=1)
