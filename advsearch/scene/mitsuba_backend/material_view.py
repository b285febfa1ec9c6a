"""What the material form of the adjoint needs of a scene: camera, meshes, path tracer
and random numbers; and its boundary terms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.meshes import FACES, POSITIONS
from advsearch.scene.mitsuba_backend.variant import dr, mi

# streams of random numbers of one seed; the interior term has stream 0
_OUTLINES = 1
_PATHS = 2
_SHADOWS = 3


class Camera:
    """A pinhole camera, from Mitsuba's sensor: its transforms and its size in
    pixels.
    """

    def __init__(self, sensor: Any) -> None:
        to_world = sensor.world_transform()
        self.width, self.height = (int(size) for size in sensor.film().crop_size())
        self.pixels = self.width * self.height
        self.eye = to_world @ mi.Point3f(0.0)
        self.forward = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
        self.to_film = sensor.projection_transform()
        self.to_local = to_world.inverse()

    def project(self, point: Any) -> Any:
        """Return the film position of a point in pixels, differentiable."""
        position = self.to_film @ (self.to_local @ mi.Point3f(point))
        return mi.Point2f(position.x * self.width, position.y * self.height)

    def compute_depth(self, point: Any) -> Any:
        """Return the distance of a point along the viewing axis."""
        return dr.dot(point - self.eye, self.forward)

    def make_ray(self, film: Any) -> Any:
        """Return the ray through a film position in pixels."""
        near = self.to_film.inverse() @ mi.Point3f(
            film.x / self.width, film.y / self.height, 0.0
        )
        direction = self.to_local.inverse() @ mi.Vector3f(near)
        return mi.Ray3f(self.eye, dr.normalize(direction))

    def is_in_frame(self, film: Any) -> Any:
        """Return whether a film position can count.

        The cotangent reaches half a pixel past the border.
        """
        inside = (film.x > -0.5) & (film.y > -0.5)
        return inside & (film.x < self.width + 0.5) & (film.y < self.height + 0.5)


@dataclass(frozen=True)
class TriMesh:
    """A triangle mesh, for Dr.Jit and for torch.

    If it moves, gradients of its positions and normals are enabled.
    """

    name: str
    shape: Any  # Mitsuba's pointer
    positions: Any  # flat Dr.Jit arrays, as the next two
    normals: Any
    faces: Any
    is_smooth: bool  # whether shading normals are interpolated
    corners: Tensor  # (F, 3) int64
    vertices: Tensor  # (V, 3) float64

    @property
    def extent(self) -> float:
        """Largest width along an axis."""
        return float((self.vertices.amax(dim=0) - self.vertices.amin(dim=0)).max())

    def interpolate_edge(self, ends: Tensor, fraction: Tensor) -> Any:
        """Return points on edges, attached to the vertices.

        Args:
            ends: (n, 2) vertices of each edge.
            fraction: (n,) position along the edge in [0, 1].
        """
        first = mi.UInt32(ends[:, 0].to(torch.int32).contiguous())
        second = mi.UInt32(ends[:, 1].to(torch.int32).contiguous())
        a = dr.gather(mi.Point3f, self.positions, first)
        b = dr.gather(mi.Point3f, self.positions, second)
        return dr.fma(b - a, to_drjit_float(fraction), a)

    def get_gradients(self) -> dict[str, Tensor]:
        """Return the gradients by vertices and by normals, (V, 3) each."""
        arrays = {
            f"{self.name}.vertices": self.positions,
            f"{self.name}.normals": self.normals,
        }
        return {
            name: dr.grad(values).torch().reshape(-1, 3).cpu().clone()
            for name, values in arrays.items()
        }


class FilmView:
    """What the three terms of the adjoint share.

    Args:
        scene, sensor, parameters: as in `material_adjoint`.
        moving: vertices and normals of the meshes that move, as in `material_adjoint`.
        cotangent: (H, W, 3) derivative of the loss by the radiance.
        max_depth: longest light path in segments.

    Attributes:
        padded_cotangent: the cotangent with a border of zeros, flat.
        moving_meshes: those that move, in the order of their vertices in `moving`.
        still_meshes: those that stand still but may hide or shade them; a single
            rectangle is left out.
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
        self.scene = scene
        self.camera = Camera(sensor)
        self.max_depth = max_depth
        self.padded_cotangent = to_drjit_array(
            torch.nn.functional.pad(cotangent.detach(), (0, 0, 1, 1, 1, 1))
        )
        moving_meshes = dict[str, TriMesh]()
        self.still_meshes = list[TriMesh]()
        for shape in scene.shapes():
            vertices_name = f"{shape.id()}.vertices"
            if vertices_name in moving:
                positions = moving[vertices_name]
                normals = moving[f"{shape.id()}.normals"]
                mesh = _make_mesh(shape, parameters, positions, normals)
                dr.enable_grad(mesh.positions, mesh.normals)
                moving_meshes[vertices_name] = mesh
            elif shape.is_mesh() and shape.face_count() > 2:
                buffer = parameters[f"{shape.id()}.{POSITIONS}"]
                positions = buffer.torch().reshape(-1, 3).clone()
                normals = torch.zeros_like(positions)
                self.still_meshes.append(
                    _make_mesh(shape, parameters, positions, normals)
                )
        self.moving_meshes = [
            moving_meshes[name] for name in moving if name in moving_meshes
        ]

    def interpolate_cotangent(self, film: Any, active: Any) -> Any:
        """Return the cotangent at a film position, differentiable in the position.

        It is bilinear between pixel centers, and zero outside.
        """
        width = self.camera.width
        height = self.camera.height
        active = active & self.camera.is_in_frame(dr.detach(film))
        padded = film + 0.5
        base = dr.floor(dr.detach(padded))
        cell = mi.Point2u(dr.clip(base.x, 0, width), dr.clip(base.y, 0, height))
        fraction = padded - mi.Point2f(cell)
        corner = cell.y * (width + 2) + cell.x
        texels = [
            dr.gather(mi.Color3f, self.padded_cotangent, corner + offset, active)
            for offset in (0, 1, width + 2, width + 3)
        ]
        top = dr.lerp(texels[0], texels[1], fraction.x)
        bottom = dr.lerp(texels[2], texels[3], fraction.x)
        return dr.lerp(top, bottom, fraction.y) & active

    def attach_hit(self, hit: Any) -> tuple[Any, Any, Any, Any]:
        """Return the surface point of a hit, attached to the vertices.

        Returns:
            The point; the normal of its triangle, times twice the area; the shading
            normal; and whether it is on a moving mesh: elsewhere the three mean
            nothing.
        """
        point = mi.Point3f(0)
        facet = mi.Normal3f(0, 0, 1)
        shading_normal = mi.Normal3f(0, 0, 1)
        moves = mi.Bool(False)
        u, v = hit.prim_uv
        for mesh in self.moving_meshes:
            on_mesh = hit.is_valid() & (hit.shape == mesh.shape)
            corners = dr.gather(mi.Point3u, mesh.faces, hit.prim_index, on_mesh)
            a, b, c = (
                dr.gather(mi.Point3f, mesh.positions, corner, on_mesh)
                for corner in corners
            )
            normal = mi.Normal3f(dr.cross(b - a, c - a))
            mesh_point = dr.fma(b - a, u, dr.fma(c - a, v, a))
            point = dr.select(on_mesh, mesh_point, point)
            facet = dr.select(on_mesh, normal, facet)
            if mesh.is_smooth:
                a, b, c = (
                    dr.gather(mi.Normal3f, mesh.normals, corner, on_mesh)
                    for corner in corners
                )
                normal = dr.fma(b - a, u, dr.fma(c - a, v, a))
            shading_normal = dr.select(on_mesh, normal, shading_normal)
            moves = moves | on_mesh
        return point, facet, shading_normal, moves

    def sample_radiance(self, ray: Any, sampler: Any, depth: int, active: Any) -> Any:
        """Sample the radiance that arrives along a ray, as a constant.

        Paths have up to `depth` segments.
        """
        tracer = _path_tracer(max(depth, 1))
        return tracer.sample(
            dr.ADMode.Primal, self.scene, sampler, ray, None, None, active
        )[0]


def _make_mesh(
    shape: Any, parameters: Any, positions: Tensor, normals: Tensor
) -> TriMesh:
    """Make the mesh of one of Mitsuba's shapes with positions and normals (V, 3)."""
    name = shape.id()
    faces = parameters[f"{name}.{FACES}"]
    return TriMesh(
        name=name,
        shape=mi.ShapePtr(shape),
        positions=to_drjit_array(positions),
        normals=to_drjit_array(normals),
        faces=faces,
        is_smooth=bool(shape.has_vertex_normals()),
        corners=faces.torch().reshape(-1, 3).to("cpu", torch.int64),
        vertices=positions.detach().to("cpu", torch.float64),
    )


@cache
def _path_tracer(depth: int) -> Any:
    return mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": 1000})


# ---- random numbers, and conversion between torch and Dr.Jit


class _Sampler:
    """The part of a sampler that a path tracer needs, with a generator of ours."""

    DRJIT_STRUCT = {"rng": mi.PCG32}  # noqa: RUF012 (Dr.Jit wants a plain dictionary)

    def __init__(self) -> None:
        self.rng = mi.PCG32()

    def next_1d(self, active: Any = True) -> Any:
        return self.rng.next_float32()

    def next_2d(self, active: Any = True) -> Any:
        return mi.Point2f(self.rng.next_float32(), self.rng.next_float32())


def make_sampler(stream: int, count: int, index: Any = None) -> Any:
    """Make a sampler with one of `count` random streams in every lane.

    Lanes with the same index have the same stream; without an index each has its own.
    """
    base = mi.PCG32(count, mi.UInt64(stream))
    index = dr.arange(mi.UInt32, count) if index is None else index
    sampler = _Sampler()
    sampler.rng.state = dr.gather(mi.UInt64, base.state, index)
    sampler.rng.inc = dr.gather(mi.UInt64, base.inc, index)
    return sampler


def make_stream(seed: int, purpose: int, index: int = 0) -> int:
    """Return a starting state below 2^63, far apart for neighbouring seeds."""
    return (((seed * 64 + index) * 4 + purpose + 1) * 0x9E3779B97F4A7C15) % 2**63


def sample_uniform(stream: int, count: int, dimensions: int) -> Tensor:
    """Return (count, dimensions) float64 random numbers in [0, 1)."""
    return torch.rand(
        count,
        dimensions,
        generator=torch.Generator().manual_seed(stream),
        dtype=torch.float64,
    )


def to_drjit_array(tensor: Tensor) -> Any:
    return mi.TensorXf(tensor.detach().to("cpu", torch.float32).contiguous()).array


def to_drjit_float(tensor: Tensor) -> Any:
    return mi.Float(tensor.to(torch.float32).contiguous())


def to_drjit_vectors(kind: Any, tensor: Tensor) -> Any:
    return kind(*(to_drjit_float(tensor[:, axis]) for axis in range(3)))


def project_to_film(camera: Camera, points: Tensor) -> Tensor:
    """Return the (n, 2) float64 film positions of (n, 3) points."""
    film = camera.project(to_drjit_vectors(mi.Point3f, points))
    return torch.stack([film.x.torch(), film.y.torch()], dim=1).to("cpu", torch.float64)


# ---- boundary terms: outlines and shadows, by sampled edges (see `material_adjoint`)

EDGE_OFFSET = 0.01  # pixels past an outline at which we look for what is behind it
# something hides an edge if it is nearer than this fraction of the distance
DEPTH_TOLERANCE = 1e-3
# how far past an edge a shadow ray passes, in extents of the mesh
SHADOW_OFFSET = 1e-4
MIN_COSINE = 0.02  # smallest cosine at a lit point that is divided by
# smallest depth of an edge that is used, in world units; there is no clipping of edges
MIN_DEPTH = 1e-3


def compute_outline_term(
    view: FilmView, mesh: TriMesh, seed: int, mesh_index: int, spp: int
) -> Any:
    """Return a value whose gradient is the outline term of one mesh.

    `mesh_index` is the index of the mesh, `spp` the samples in multiples of the number
    of pixels.
    """
    stream = make_stream(seed, _OUTLINES, mesh_index)
    random = sample_uniform(stream, spp * view.camera.pixels, 1)[:, 0]
    sampled = _sample_outline(view.camera, mesh, random)
    if sampled is None:
        return mi.Float(0)
    n = mi.Vector2f(
        to_drjit_float(sampled.normal[:, 0]), to_drjit_float(sampled.normal[:, 1])
    )
    edge = mesh.interpolate_edge(sampled.ends, sampled.fraction)
    film = view.camera.project(edge)
    with dr.suspend_grad():
        ray = view.camera.make_ray(dr.detach(film) + EDGE_OFFSET * n)
        hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
        edge_distance = dr.norm(dr.detach(edge) - view.camera.eye)
        is_visible = ~hit.is_valid() | (hit.t > edge_distance * (1.0 - DEPTH_TOLERANCE))
        sampler = make_sampler(stream + _PATHS, len(sampled.fraction))
        behind = view.sample_radiance(ray, sampler, view.max_depth, is_visible)
        strength = dr.sum(view.interpolate_cotangent(film, is_visible) * behind)
        strength = dr.select(is_visible & dr.isfinite(strength), strength, 0.0)
        dr.eval(strength, hit)
    point_behind, _, _, moves = view.attach_hit(hit)
    film_behind = dr.select(moves, view.camera.project(point_behind), 0.0)
    speed = dr.dot(n, film - film_behind)
    return dr.sum(strength * speed) * -sampled.pixels_per_sample


class _OutlineSamples(NamedTuple):
    """Points sampled on the outline of a mesh."""

    ends: Tensor  # (n, 2) vertices of the edge
    fraction: Tensor  # (n,) position along the edge in space, in [0, 1]
    normal: Tensor  # (n, 2) unit normal on the film, away from the mesh
    pixels_per_sample: float  # length of the outline over the number of samples


def _to_space_fraction(film_fraction: Tensor, depth: Tensor) -> Tensor:
    """Return how far along edges in space points are: halfway on the film is not
    halfway.

    Args:
        film_fraction: (N,) how far along the edges they are on the film.
        depth: (N, 2) of both ends.
    """
    weighted = film_fraction * depth[:, 0]
    return weighted / (weighted + (1.0 - film_fraction) * depth[:, 1])


def _measure_on_film(camera: Camera, a: Tensor, b: Tensor, depth: Tensor) -> Tensor:
    """Return the lengths (N,) of edges on the film; 0 outside of it or too near.

    Args:
        camera: the camera.
        a, b: (N, 2) ends of the edges on the film.
        depth: (N, 2) of both ends.
    """
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    on_film = (torch.maximum(a, b) > -0.5) & (torch.minimum(a, b) < size + 0.5)
    is_used = (depth > MIN_DEPTH).all(dim=1) & on_film.all(dim=1)
    return torch.where(is_used, (b - a).norm(dim=1), 0.0)


def _find_film_normals(edge: Tensor, outwards: Tensor) -> Tensor:
    """Return unit normals (N, 2) of edges on the film that point away from the mesh.

    Args:
        edge: (N, 2) from end to end on the film.
        outwards: (N, 2) steps away from the mesh on the film.
    """
    normal = torch.nn.functional.normalize(
        torch.stack([edge[:, 1], -edge[:, 0]], dim=1), dim=1
    )
    points_inwards = (normal * outwards).sum(dim=1, keepdim=True) < 0.0
    return normal * torch.where(points_inwards, -1.0, 1.0)


def _sample_outline(
    camera: Camera, mesh: TriMesh, random: Tensor
) -> _OutlineSamples | None:
    """Sample the outline evenly by its length on the film, hidden parts included.

    The random numbers are (n,) in [0, 1). None if no outline is in the image.
    """
    eye = torch.tensor([axis[0] for axis in camera.eye], dtype=torch.float64)
    forward = torch.tensor([axis[0] for axis in camera.forward], dtype=torch.float64)
    ends, outwards = _find_outline(mesh, eye)
    if len(ends) == 0 or len(random) == 0:
        return None
    a = project_to_film(camera, mesh.vertices[ends[:, 0]])
    b = project_to_film(camera, mesh.vertices[ends[:, 1]])
    depth = (mesh.vertices[ends] - eye) @ forward
    length = _measure_on_film(camera, a, b, depth)
    if not float(length.sum()) > 0.0:
        return None
    pick, film_fraction = _sample_along(length, random)

    middle = mesh.vertices[ends].mean(dim=1)
    step = project_to_film(
        camera, middle + 1e-3 * mesh.extent * outwards
    ) - project_to_film(camera, middle)
    normal = _find_film_normals(b[pick] - a[pick], step[pick])
    fraction = _to_space_fraction(film_fraction, depth[pick])
    pixels_per_sample = float(length.sum()) / len(random)
    return _OutlineSamples(ends[pick], fraction, normal, pixels_per_sample)


def _find_outline(mesh: TriMesh, eye: Tensor) -> tuple[Tensor, Tensor]:
    """Find the edges that the eye may see as an outline.

    All faces of such an edge lie on one side of the plane through the edge and the eye.

    Returns:
        (E, 2) vertices of the edges, and (E, 3) that plane's unit normal, away from the
        mesh.
    """
    ends, owner, across = _find_edges(mesh.vertices, mesh.corners)
    plane = torch.linalg.cross(
        mesh.vertices[ends[:, 0]] - eye, mesh.vertices[ends[:, 1]] - eye
    )
    plane = torch.nn.functional.normalize(plane, dim=1)
    side = (plane[owner] * (mesh.vertices[across] - eye)).sum(dim=1)
    lowest = torch.full((len(ends),), torch.inf, dtype=side.dtype).scatter_reduce(
        0, owner, side, "amin"
    )
    highest = torch.full((len(ends),), -torch.inf, dtype=side.dtype).scatter_reduce(
        0, owner, side, "amax"
    )
    on_outline = (lowest > 0.0) | (highest < 0.0)
    sign = torch.where(lowest[on_outline] > 0.0, -1.0, 1.0)[:, None]
    return ends[on_outline], plane[on_outline] * sign


def _sample_along(length: Tensor, random: Tensor) -> tuple[Tensor, Tensor]:
    """Spread n stratified samples over segments with given lengths.

    Returns:
        (n,) index of the segment, and (n,) position along it in [0, 1].
    """
    sums = length.cumsum(dim=0)
    distance = (torch.arange(len(random)) + random) / len(random) * sums[-1]
    last = int(length.nonzero().max())
    pick = torch.searchsorted(sums, distance, right=True).clamp_max(last)
    fraction = (1.0 - (sums[pick] - distance) / length[pick]).clamp(0.0, 1.0)
    return pick, fraction


def _find_edges(vertices: Tensor, corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the edges of a mesh; vertices at the same position count as one.

    Returns:
        (E, 2) vertices of each edge; and for each of the 3 F sides of faces, (3 F,) the
        index of its edge and (3 F,) the vertex across.
    """
    position_id = torch.unique(vertices, dim=0, return_inverse=True)[1]
    sides = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    across = torch.cat([corners[:, 2], corners[:, 0], corners[:, 1]])
    lower, higher = position_id[sides].aminmax(dim=1)
    keys, owner = torch.unique(lower * len(vertices) + higher, return_inverse=True)
    side_index = torch.arange(len(owner))
    # repeatable, unlike indexing
    first = torch.full((len(keys),), len(owner)).scatter_reduce(
        0, owner, side_index, "amin"
    )
    return sides[first], owner, across


def compute_shadow_term(
    view: FilmView, mesh: TriMesh, seed: int, mesh_index: int, spp: int
) -> Any:
    """Return a value whose gradient is the shadow term of one mesh.

    `mesh_index` is the index of the mesh, `spp` the samples in multiples of the number
    of pixels.
    """
    stream = make_stream(seed, _SHADOWS, mesh_index)
    random = sample_uniform(stream, spp * view.camera.pixels, 4)
    sampled = _sample_tangents(mesh, random)
    if sampled is None:
        return mi.Float(0)
    ends = sampled.ends
    fraction = sampled.fraction
    direction = sampled.direction
    edge_points = torch.lerp(
        mesh.vertices[ends[:, 0]], mesh.vertices[ends[:, 1]], fraction[:, None]
    )
    p = to_drjit_vectors(mi.Point3f, edge_points)
    d = to_drjit_vectors(mi.Vector3f, direction)
    n = to_drjit_vectors(mi.Vector3f, sampled.normal)
    offset = SHADOW_OFFSET * mesh.extent * n
    with dr.suspend_grad():
        ray = mi.Ray3f(p + offset, -d)
        hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, hit.is_valid())
        lit = _eval_lit_points(view, si, d)
        dr.eval(lit, hit, si, p, offset)
        lit_index = dr.compress(dr.any(lit != 0.0))
        if dr.width(lit_index) == 0:
            return mi.Float(0)
        lit, hit, si, p, offset, n = (
            dr.gather(type(value), value, lit_index)
            for value in (lit, hit, si, p, offset, n)
        )
        strength = dr.sum(
            lit * _sample_radiance_difference(view, si, p, offset, stream)
        )
        strength = dr.select(dr.isfinite(strength), strength, 0.0)
        dr.eval(strength, hit)
    selected = lit_index.torch().to("cpu", torch.int64)
    lit_point, _, _, moves = view.attach_hit(hit)
    sine = torch.linalg.cross(
        direction, _compute_edge_directions(mesh.vertices, ends)
    ).norm(dim=1)
    edge_point = mesh.interpolate_edge(ends[selected], fraction[selected])
    speed = dr.dot(n, edge_point - dr.select(moves, lit_point, 0.0))
    return (
        dr.sum(strength * to_drjit_float(sine[selected]) * speed)
        * -sampled.measure_per_sample
    )


def _eval_lit_points(view: FilmView, si: Any, d: Any) -> Any:
    """Return W f J' of lit points that the camera sees, for light from d; else 0."""
    camera = view.camera
    film = camera.project(si.p)
    depth = camera.compute_depth(si.p)
    to_eye = camera.eye - si.p
    active = si.is_valid() & (depth > MIN_DEPTH) & camera.is_in_frame(film)
    si.wi = si.to_local(dr.normalize(to_eye))
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(d), active)
    active &= dr.any(value > 0.0)
    active &= ~view.scene.ray_test(si.spawn_ray_to(camera.eye), active)
    matrix = camera.to_film.matrix
    # pixels per unit of the tangent, along both axes
    pixel_area = abs(
        float(matrix[0, 0][0]) * camera.width * float(matrix[1, 1][0]) * camera.height
    )
    scale = dr.abs(dr.dot(si.n, to_eye)) / depth**3 * pixel_area
    value *= scale / dr.maximum(dr.abs(dr.dot(si.n, d)), MIN_COSINE)
    return dr.select(active, value * view.interpolate_cotangent(film, active), 0.0)


def _sample_radiance_difference(
    view: FilmView, si: Any, p: Any, offset: Any, stream: int
) -> Any:
    """Return the radiance that a lit point gets just past an edge minus just inside."""

    def make_ray(target: Any) -> Any:
        ray = si.spawn_ray_to(target)
        return mi.Ray3f(ray.o, ray.d)

    first = view.scene.ray_intersect_preliminary(make_ray(p + offset), coherent=False)
    reach = dr.norm(p - si.p) * (1.0 - DEPTH_TOLERANCE) - 2.0 * dr.norm(offset)
    is_free = ~first.is_valid() | (first.t > reach)

    def sample_radiance(target: Any) -> Any:
        sampler = make_sampler(stream + _PATHS, dr.width(p))
        return view.sample_radiance(
            make_ray(target), sampler, view.max_depth - 1, is_free
        )

    past = sample_radiance(p + offset)
    inside = sample_radiance(p - offset)
    return dr.select(is_free, past - inside, 0.0)


class _TangentSamples(NamedTuple):
    """Points sampled on edges of a mesh, and lines through them that touch the mesh."""

    ends: Tensor  # (n, 2) vertices of the edge
    fraction: Tensor  # (n,) position along the edge, in [0, 1]
    direction: Tensor  # (n, 3) unit direction of the line
    normal: Tensor  # (n, 3) unit normal of edge and line, away from the mesh
    measure_per_sample: float  # world units times steradians


def _orient_outwards(vectors: Tensor, directions: Tensor) -> Tensor:
    """Return vectors (N, 3), turned over where they point in a direction (N, 3)."""
    points_inwards = (vectors * directions).sum(dim=1, keepdim=True) > 0.0
    return vectors * torch.where(points_inwards, -1.0, 1.0)


def _sample_tangents(mesh: TriMesh, random: Tensor) -> _TangentSamples | None:
    """Sample points on edges and lines through them that touch the mesh there, evenly.

    The lines through a point of an edge that have both faces on one side fill the
    exterior angle of the edge, to either side. An edge with one face lets every line
    pass.

    Args:
        random: (n, 4) in [0, 1).

    Returns:
        The samples; None if there is nothing to sample.
    """
    vertices = mesh.vertices
    edges = _measure_exterior_angles(mesh)
    edge_length = (vertices[edges.ends[:, 1]] - vertices[edges.ends[:, 0]]).norm(dim=1)
    measure = edge_length * edges.angle
    if len(random) == 0 or not float(measure.sum()) > 0.0:
        return None
    pick, _ = _sample_along(measure, random[:, 0])
    axis = edges.axis[pick]
    first = edges.first[pick]
    second = edges.second[pick]

    # A direction perpendicular to the edge, within the exterior angle.
    turn = random[:, 2:3] * edges.angle[pick][:, None]
    aside = torch.cos(turn) * second + torch.sin(turn) * edges.turned[pick]
    # The sign chooses the side, the rest is the cosine with the edge.
    height = 4.0 * random[:, 3:4] - 2.0
    aside = torch.where(height < 0.0, -aside, aside)
    height = height.abs() - 1.0
    direction = height * axis + (1.0 - height.square()).clamp_min(0.0).sqrt() * aside

    normal = _orient_outwards(torch.linalg.cross(axis, aside), first + second)
    return _TangentSamples(
        ends=edges.ends[pick],
        fraction=random[:, 1],
        direction=direction,
        normal=normal,
        measure_per_sample=4.0 * float(measure.sum()) / len(random),
    )


class _ExteriorAngles(NamedTuple):
    """The exterior angles of the edges of a mesh that have one face or two."""

    ends: Tensor  # (E, 2) vertices
    axis: Tensor  # (E, 3) unit vector along the edge
    first: Tensor  # (E, 3) unit vectors along both faces, perpendicular to the edge
    second: Tensor
    # (E, 3) unit vector, perpendicular to edge and `second`, to which the angle opens
    turned: Tensor
    angle: Tensor  # (E,) exterior angle, radians


def _measure_exterior_angles(mesh: TriMesh) -> _ExteriorAngles:
    vertices = mesh.vertices
    ends, owner, across = _find_edges(vertices, mesh.corners)
    order = torch.argsort(owner, stable=True)
    n_faces = torch.bincount(owner, minlength=len(ends))
    last = n_faces.cumsum(dim=0) - 1
    length = (vertices[ends[:, 1]] - vertices[ends[:, 0]]).norm(dim=1)
    proper = (n_faces <= 2) & (length > 0.0)
    ends = ends[proper]
    is_single = n_faces[proper] == 1
    axis = _compute_edge_directions(vertices, ends)

    def along_face(entry: Tensor) -> Tensor:
        """Return unit vectors along one of an edge's faces, perpendicular to it."""
        vector = vertices[across[order[entry[proper]]]] - vertices[ends[:, 0]]
        return torch.nn.functional.normalize(
            vector - (vector * axis).sum(dim=1, keepdim=True) * axis, dim=1
        )

    first = along_face(last - n_faces + 1)
    second = along_face(last)
    turned, angle = _measure_between_faces(first, second, axis, is_single)
    return _ExteriorAngles(ends, axis, first, second, turned, angle)


def _measure_between_faces(
    first: Tensor, second: Tensor, axis: Tensor, is_single: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the second axis (N, 3) of the exterior angles of edges, and these (N,).

    Args:
        first, second: (N, 3) unit vectors along both faces, perpendicular to the edge.
        axis: (N, 3) unit vectors along the edges.
        is_single: (N,) whether an edge has only one face.
    """
    cosine = (first * second).sum(dim=1, keepdim=True)
    rest = first - cosine * second
    turned = torch.where(
        is_single[:, None],
        torch.linalg.cross(axis, second),
        -torch.nn.functional.normalize(rest, dim=1),
    )
    angle = torch.pi - torch.atan2(rest.norm(dim=1), cosine[:, 0])
    return turned, angle


def _compute_edge_directions(vertices: Tensor, ends: Tensor) -> Tensor:
    """Return unit vectors (n, 3) along edges with vertices (n, 2)."""
    return torch.nn.functional.normalize(
        vertices[ends[:, 1]] - vertices[ends[:, 0]], dim=1
    )
