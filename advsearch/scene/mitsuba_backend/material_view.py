"""Camera, meshes, path tracer and random numbers of the material form of the adjoint,
and its boundary terms.
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

# purposes of random numbers: each has streams of its own, see `make_stream`
INTERIOR = 0
_OUTLINES = 1
_PATHS = 2
_SHADOWS = 3


class Camera:
    """A pinhole camera, from Mitsuba's sensor.

    Attributes:
        width, height: width and height of the film in pixels.
        pixels: number of pixels.
        eye: position of the camera.
        forward: unit vector of the viewing axis.
        to_film: projection from the camera's axes to the film, in fractions of its
            size.
        to_local: transform from the world to the camera's axes.
    """

    def __init__(self, sensor: Any) -> None:
        """Read size, position and projections of a Mitsuba sensor."""
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
        near_point = self.to_film.inverse() @ mi.Point3f(
            film.x / self.width, film.y / self.height, 0.0
        )
        direction = self.to_local.inverse() @ mi.Vector3f(near_point)
        return mi.Ray3f(self.eye, dr.normalize(direction))

    def is_in_frame(self, film: Any) -> Any:
        """Return whether the cotangent may differ from 0 at a film position.

        By interpolation it reaches half a pixel past the border.
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
        first_index = mi.UInt32(ends[:, 0].to(torch.int32).contiguous())
        second_index = mi.UInt32(ends[:, 1].to(torch.int32).contiguous())
        first_end = dr.gather(mi.Point3f, self.positions, first_index)
        second_end = dr.gather(mi.Point3f, self.positions, second_index)
        return dr.fma(second_end - first_end, to_drjit_float(fraction), first_end)

    def get_gradients(self) -> dict[str, Tensor]:
        """Return the gradients by `NAME.vertices` and `NAME.normals`, (V, 3) each."""
        arrays = {
            f"{self.name}.vertices": self.positions,
            f"{self.name}.normals": self.normals,
        }
        return {
            name: dr.grad(values).torch().reshape(-1, 3).cpu().clone()
            for name, values in arrays.items()
        }


class FilmView:
    """Scene, camera and cotangent, which the three terms of the adjoint share.

    Args:
        scene, sensor, parameters: as in `material_adjoint`.
        moving: vertices and normals of the meshes that move, as in `material_adjoint`.
        cotangent: (H, W, 3) derivative of the loss by the radiance.
        max_depth: longest light path in segments.

    Attributes:
        scene: Mitsuba's scene.
        camera: camera of the scene.
        max_depth: longest light path in segments.
        padded_cotangent: flat cotangent with a border of zeros.
        moving_meshes: meshes that move, in the order of their vertices in `moving`.
        still_meshes: meshes that do not move but may hide or shade those that do. A
            single rectangle, such as the ground, is left out.
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
        """Sort the scene's meshes into those that move and others, as `TriMesh`.

        Args:
            scene, sensor, parameters: Mitsuba's scene, its camera, and what
                `mi.traverse` returns for the scene.
            moving: vertices and normals (V, 3) of the meshes that move, by names such
                as "object.vertices" and "object.normals".
            cotangent: (H, W, 3) derivative of the loss by the radiance.
            max_depth: longest light path in segments.
        """
        self.scene = scene
        self.camera = Camera(sensor)
        self.max_depth = max_depth
        # One pixel of zeros on each side. `pad` counts from the last axis, the
        # channels, to which nothing is added.
        self.padded_cotangent = to_drjit_array(
            torch.nn.functional.pad(cotangent.detach(), (0, 0, 1, 1, 1, 1))
        )
        self._sort_meshes(parameters, moving)

    def _sort_meshes(self, parameters: Any, moving: Mapping[str, Tensor]) -> None:
        """Set the meshes that move and those that do not, from the scene's shapes.

        The arguments are those of the class.
        """
        moving_meshes = dict[str, TriMesh]()
        self.still_meshes = list[TriMesh]()
        for shape in self.scene.shapes():
            vertices_name = f"{shape.id()}.vertices"
            if vertices_name in moving:
                moving_meshes[vertices_name] = _make_moving_mesh(
                    shape, parameters, moving
                )
            # all other meshes but single rectangles, which have two faces, such as the
            # ground
            elif shape.is_mesh() and shape.face_count() > 2:
                self.still_meshes.append(_make_still_mesh(shape, parameters))
        # In the order of `moving`, which decides the random numbers of each mesh. The
        # names of normals, which are in `moving` too, are skipped.
        self.moving_meshes = [
            moving_meshes[name] for name in moving if name in moving_meshes
        ]

    def interpolate_cotangent(self, film: Any, active: Any) -> Any:
        """Return the cotangent at a film position, differentiable in the position.

        The cotangent (the derivative of the loss by the image) is bilinear between
        pixel centers, and zero outside of the film.
        """
        width = self.camera.width
        height = self.camera.height
        active = active & self.camera.is_in_frame(dr.detach(film))
        # Cells lie between the centers of pixels. In the image padded by 1 pixel, the
        # center of the first pixel is the position 0. So 1 is added for the border, and
        # 0.5 subtracted for the center.
        padded_film = film + 0.5
        cell_position = dr.floor(dr.detach(padded_film))
        cell = mi.Point2u(
            dr.clip(cell_position.x, 0, width), dr.clip(cell_position.y, 0, height)
        )
        fraction = padded_film - mi.Point2f(cell)
        # index of the cell's upper left corner in the padded image
        corner = cell.y * (width + 2) + cell.x
        # In Dr.Jit, a value & a mask is 0 where the mask is False.
        return self._interpolate_in_cell(corner, fraction, active) & active

    def _interpolate_in_cell(self, corner: Any, fraction: Any, active: Any) -> Any:
        """Return the padded cotangent in cells, bilinear between their four corners.

        Args:
            corner: index of each cell's upper left corner in the padded image.
            fraction: position in the cell, in [0, 1]^2.
            active: lanes that are read.
        """
        upper_left, upper_right, lower_left, lower_right = self._gather_cell_corners(
            corner, active
        )
        top = dr.lerp(upper_left, upper_right, fraction.x)
        bottom = dr.lerp(lower_left, lower_right, fraction.x)
        return dr.lerp(top, bottom, fraction.y)

    def _gather_cell_corners(self, corner: Any, active: Any) -> list[Any]:
        """Return the padded cotangent at four corners of cells, in the order of rows.

        `corner` is the index of each cell's upper left corner in the padded image.
        """
        padded_width = self.camera.width + 2
        return [
            dr.gather(mi.Color3f, self.padded_cotangent, corner + offset, active)
            for offset in (0, 1, padded_width, padded_width + 1)
        ]

    def attach_hit(self, hit: Any) -> tuple[Any, Any, Any, Any]:
        """Return the surface point of a hit, attached to the vertices of moving meshes.

        When the vertices move, the point moves with its triangle: its barycentric
        coordinates stay the same. `hit` is Mitsuba's preliminary intersection.

        Returns:
            The point; the normal of its triangle, with twice the triangle's area as its
            length; the shading normal; and whether the hit is on a moving mesh. Where
            it is not, the first three values are placeholders.
        """
        point = mi.Point3f(0)
        scaled_normal = mi.Normal3f(0, 0, 1)
        shading_normal = mi.Normal3f(0, 0, 1)
        is_moving = mi.Bool(False)
        for mesh in self.moving_meshes:
            on_mesh = hit.is_valid() & (hit.shape == mesh.shape)
            mesh_point, face_normal, mesh_shading_normal = _attach_to_mesh(
                mesh, hit, on_mesh
            )
            point = dr.select(on_mesh, mesh_point, point)
            scaled_normal = dr.select(on_mesh, face_normal, scaled_normal)
            shading_normal = dr.select(on_mesh, mesh_shading_normal, shading_normal)
            is_moving = is_moving | on_mesh
        return point, scaled_normal, shading_normal, is_moving

    def sample_radiance(self, ray: Any, sampler: Any, depth: int, active: Any) -> Any:
        """Sample the radiance that arrives along a ray, as a constant.

        Args:
            ray: the rays, one in each lane.
            sampler: random numbers of the paths.
            depth: longest path in segments; less than 1 counts as 1.
            active: lanes that are traced.
        """
        tracer = _make_path_tracer(max(depth, 1))
        # without derivatives and state, which only the adjoint modes take
        derivative = None
        state = None
        radiance, *_ = tracer.sample(
            dr.ADMode.Primal, self.scene, sampler, ray, derivative, state, active
        )
        return radiance


def _attach_to_mesh(mesh: TriMesh, hit: Any, on_mesh: Any) -> tuple[Any, Any, Any]:
    """Return points, normals and shading normals of hits, attached to a mesh.

    They are those of `FilmView.attach_hit`. `on_mesh` are the lanes whose hit is on
    this mesh.
    """
    corners = dr.gather(mi.Point3u, mesh.faces, hit.prim_index, on_mesh)
    triangle = _gather_triangle(mi.Point3f, mesh.positions, corners, on_mesh)
    a, b, c = triangle
    face_normal = mi.Normal3f(dr.cross(b - a, c - a))
    point = _interpolate_triangle(triangle, hit.prim_uv)
    if not mesh.is_smooth:
        return point, face_normal, face_normal
    normals = _gather_triangle(mi.Normal3f, mesh.normals, corners, on_mesh)
    return point, face_normal, _interpolate_triangle(normals, hit.prim_uv)


def _gather_triangle(kind: Any, buffer: Any, corners: Any, active: Any) -> list[Any]:
    """Return the values of a type at the three corners of faces, from a flat buffer."""
    return [dr.gather(kind, buffer, corner, active) for corner in corners]


def _interpolate_triangle(values: list[Any], uv: Any) -> Any:
    """Interpolate the values at three corners by barycentric coordinates."""
    a, b, c = values
    u, v = uv
    return dr.fma(b - a, u, dr.fma(c - a, v, a))


def _make_moving_mesh(
    shape: Any, parameters: Any, moving: Mapping[str, Tensor]
) -> TriMesh:
    """Make the mesh of a shape with the positions and normals in `moving`."""
    positions = moving[f"{shape.id()}.vertices"]
    normals = moving[f"{shape.id()}.normals"]
    mesh = _make_mesh(shape, parameters, positions, normals)
    dr.enable_grad(mesh.positions, mesh.normals)
    return mesh


def _make_still_mesh(shape: Any, parameters: Any) -> TriMesh:
    """Make the mesh of a shape as it is; its normals are 0, since they are not used."""
    buffer = parameters[f"{shape.id()}.{POSITIONS}"]
    positions = buffer.torch().reshape(-1, 3).clone()
    normals = torch.zeros_like(positions)
    return _make_mesh(shape, parameters, positions, normals)


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
def _make_path_tracer(depth: int) -> Any:
    # rr_depth: no path ends by chance before `max_depth`
    return mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": 1000})


# ---- random numbers, and conversion between torch and Dr.Jit


class _Sampler:
    """The part of a sampler that a path tracer needs, with a generator of ours.

    Dr.Jit needs `DRJIT_STRUCT` to carry its state through loops.
    """

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

    Args:
        stream: starting state, as from `make_stream`.
        count: number of streams; without an index, also the number of lanes.
        index: stream of each lane.
    """
    base = mi.PCG32(count, mi.UInt64(stream))
    index = dr.arange(mi.UInt32, count) if index is None else index
    sampler = _Sampler()
    sampler.rng.state = dr.gather(mi.UInt64, base.state, index)
    sampler.rng.inc = dr.gather(mi.UInt64, base.inc, index)
    return sampler


def make_stream(seed: int, purpose: int, index: int = 0) -> int:
    """Return a starting state below 2^63, far apart for neighbouring seeds.

    The factor is 2^64 over the golden ratio, which spreads consecutive numbers
    (Fibonacci hashing).

    Args:
        seed: seed of the random numbers.
        purpose: one of the four purposes from `INTERIOR` to `_SHADOWS`.
        index: index of a mesh, below 64.
    """
    # A different number for each seed, mesh (0 to 63) and purpose (0 to 3). The 1 is
    # added since the product with 0 would be 0.
    number = (seed * 64 + index) * 4 + purpose + 1
    return (number * 0x9E3779B97F4A7C15) % 2**63


def sample_uniform(stream: int, count: int, dimensions: int) -> Tensor:
    """Return (count, dimensions) float64 random numbers in [0, 1)."""
    return torch.rand(
        count,
        dimensions,
        generator=torch.Generator().manual_seed(stream),
        dtype=torch.float64,
    )


def to_drjit_array(tensor: Tensor) -> Any:
    """Convert a tensor to a flat Dr.Jit array of float32, without its gradient."""
    return mi.TensorXf(tensor.detach().to("cpu", torch.float32).contiguous()).array


def to_drjit_float(tensor: Tensor) -> Any:
    """Convert a tensor (N,) to a Dr.Jit array of float32, one number in each lane."""
    return mi.Float(tensor.to(torch.float32).contiguous())


def to_drjit_vectors(kind: Any, tensor: Tensor) -> Any:
    """Convert a tensor (N, 3) to Dr.Jit's points or vectors of a type `kind`."""
    return kind(*(to_drjit_float(tensor[:, axis]) for axis in range(3)))


def project_to_film(camera: Camera, points: Tensor) -> Tensor:
    """Return the (n, 2) float64 film positions of (n, 3) points."""
    film = camera.project(to_drjit_vectors(mi.Point3f, points))
    return torch.stack([film.x.torch(), film.y.torch()], dim=1).to("cpu", torch.float64)


# ---- boundary terms: outlines and shadows, by sampled edges (see `material_adjoint`)

# distance past an outline, in pixels, of the ray that finds what is behind it
EDGE_OFFSET = 0.01
# A surface hides an edge if it is nearer by more than this fraction of the distance.
DEPTH_TOLERANCE = 1e-3
# distance at which a shadow ray passes an edge, as a fraction of the mesh's extent
SHADOW_OFFSET = 1e-4
MIN_COSINE = 0.02  # smallest cosine at a lit point to divide by
# Smallest depth of an edge that is used, in world units. An edge with an end nearer
# than that is left out, since edges are not clipped.
MIN_DEPTH = 1e-3


def compute_outline_term(
    view: FilmView, mesh: TriMesh, seed: int, mesh_index: int, spp: int
) -> Any:
    """Return a value whose gradient is the outline term of one mesh.

    Where an outline moves outwards on the film, it hides what is behind it. A point on
    the outline contributes the product of three factors: the cotangent at its pixel
    (the derivative of the loss by the image), the radiance behind it, and its speed
    along the outline's normal. If the surface behind moves too, its speed is
    subtracted. A point that another surface hides contributes 0.

    Args:
        view: the scene.
        mesh: mesh that moves, or that stands still and may hide one that moves.
        seed: seed of the samples.
        mesh_index: index of the mesh, which gives it random numbers of its own.
        spp: samples, in multiples of the number of pixels.
    """
    stream = make_stream(seed, _OUTLINES, mesh_index)
    random = sample_uniform(stream, spp * view.camera.pixels, 1)[:, 0]
    sampled = _sample_outline(view.camera, mesh, random)
    if sampled is None:
        return mi.Float(0)
    film_normal = mi.Vector2f(
        to_drjit_float(sampled.normal[:, 0]), to_drjit_float(sampled.normal[:, 1])
    )
    edge_point = mesh.interpolate_edge(sampled.ends, sampled.fraction)
    edge_film = view.camera.project(edge_point)
    hit, strength = _look_past_outline(view, edge_point, edge_film, film_normal, stream)
    film_behind = _locate_on_film(view, hit)
    motion = dr.dot(film_normal, edge_film - film_behind)
    # minus: where the outline moves outwards, the radiance behind is lost
    return dr.sum(strength * motion) * -sampled.pixels_per_sample


def _locate_on_film(view: FilmView, hit: Any) -> Any:
    """Return the film positions of hits in pixels, attached to the vertices.

    Only their gradients are used. So a point that does not move may have any position:
    it is 0. This is called outside of `suspend_grad`, since the motion of the points is
    differentiated.
    """
    point, _normal, _shading_normal, is_moving = view.attach_hit(hit)
    return dr.select(is_moving, view.camera.project(point), 0.0)


def _look_past_outline(
    view: FilmView, edge_point: Any, edge_film: Any, film_normal: Any, stream: int
) -> tuple[Any, Any]:
    """Return what is behind points of an outline, and how much it matters.

    Args:
        view: the scene.
        edge_point: points on the outline, in the world.
        edge_film: their film positions in pixels.
        film_normal: unit normals of the outline on the film, away from the mesh.
        stream: stream of the random numbers, as from `make_stream`.

    Returns:
        The hits just past the outline, and the strengths, see
        `_sample_outline_strength`.
    """
    with dr.suspend_grad():
        # A ray just past the edge, on the side away from the mesh, sees what the edge
        # would hide if it moved outwards.
        ray = view.camera.make_ray(dr.detach(edge_film) + EDGE_OFFSET * film_normal)
        hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
        edge_distance = dr.norm(dr.detach(edge_point) - view.camera.eye)
        # If the ray hits something nearer than the edge, that hides the edge.
        is_visible = ~hit.is_valid() | (hit.t > edge_distance * (1.0 - DEPTH_TOLERANCE))
        strength = _sample_outline_strength(view, ray, edge_film, is_visible, stream)
        # Evaluated here, so that the backward pass does not trace the rays again.
        dr.eval(strength, hit)
    return hit, strength


def _sample_outline_strength(
    view: FilmView, ray: Any, edge_film: Any, is_visible: Any, stream: int
) -> Any:
    """Return the cotangent at points of an outline times the radiance behind them.

    The radiance of the mesh in front does not count here: what is visible of the mesh
    moves with it, which is in the interior term.

    Args:
        view: the scene.
        ray: camera rays just past the outline.
        edge_film: film positions of the points.
        is_visible: lanes in which nothing hides the point; elsewhere the result is 0.
        stream: stream of the outline's random numbers.
    """
    # other random numbers than those of the points on the outline
    sampler = make_sampler(stream + _PATHS, dr.width(edge_film))
    radiance_behind = view.sample_radiance(ray, sampler, view.max_depth, is_visible)
    cotangent = view.interpolate_cotangent(edge_film, is_visible)
    strength = dr.sum(cotangent * radiance_behind)
    return dr.select(is_visible & dr.isfinite(strength), strength, 0.0)


class _OutlineSamples(NamedTuple):
    """Points sampled on the outline of a mesh."""

    ends: Tensor  # (n, 2) vertices of the edge
    fraction: Tensor  # (n,) position along the edge in space, in [0, 1]
    normal: Tensor  # (n, 2) unit normal on the film, away from the mesh
    pixels_per_sample: float  # length of the outline over the number of samples


def _to_space_fraction(film_fraction: Tensor, depth: Tensor) -> Tensor:
    """Convert positions along edges on the film to positions along edges in space.

    Both are fractions (N,) from the first end of an edge to the second. They differ
    because the nearer half of an edge is longer on the film. With depths d0 and d1 of
    the ends,

        film = space d1 / ((1 - space) d0 + space d1)
        space = film d0 / (film d0 + (1 - film) d1)

    Args:
        film_fraction: (N,) fractions on the film.
        depth: (N, 2) depths of both ends.
    """
    weighted = film_fraction * depth[:, 0]
    return weighted / (weighted + (1.0 - film_fraction) * depth[:, 1])


def _measure_on_film(camera: Camera, a: Tensor, b: Tensor, depth: Tensor) -> Tensor:
    """Return the lengths (N,) of edges on the film, in pixels.

    The length is 0, which leaves the edge out, if an end is too near to the camera, or
    if the edge is outside of the film by more than half a pixel.

    Args:
        camera: the camera.
        a, b: (N, 2) ends of the edges on the film, pixels.
        depth: (N, 2) depths of both ends, in world units.
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
    """Sample points on a mesh's outline, evenly by its length on the film.

    Points that another surface hides are included.

    Args:
        camera: the camera.
        mesh: the mesh.
        random: (n,) numbers in [0, 1), one for each sample.

    Returns:
        The samples; None if no outline is in the image.
    """
    eye = _read_single_vector(camera.eye)
    forward = _read_single_vector(camera.forward)
    ends, outwards = _find_outline(mesh, eye)
    if len(ends) == 0 or len(random) == 0:
        return None
    first_on_film = project_to_film(camera, mesh.vertices[ends[:, 0]])
    second_on_film = project_to_film(camera, mesh.vertices[ends[:, 1]])
    depth = (mesh.vertices[ends] - eye) @ forward
    length = _measure_on_film(camera, first_on_film, second_on_film, depth)
    if not float(length.sum()) > 0.0:  # no edge is on the film
        return None
    edge_index, film_fraction = _sample_along(length, random)

    outwards_on_film = _project_directions(camera, mesh, ends, outwards)
    edge_on_film = second_on_film[edge_index] - first_on_film[edge_index]
    normal = _find_film_normals(edge_on_film, outwards_on_film[edge_index])
    fraction = _to_space_fraction(film_fraction, depth[edge_index])
    pixels_per_sample = float(length.sum()) / len(random)
    return _OutlineSamples(ends[edge_index], fraction, normal, pixels_per_sample)


def _read_single_vector(vector: Any) -> Tensor:
    """Return a point or vector of Dr.Jit with a single lane as (3,) float64."""
    # An axis is an array over lanes, of which there is one.
    return torch.tensor([axis[0] for axis in vector], dtype=torch.float64)


def _project_directions(
    camera: Camera, mesh: TriMesh, ends: Tensor, outwards: Tensor
) -> Tensor:
    """Return directions (E, 2) on the film that lead away from the mesh at its edges.

    Args:
        camera: the camera.
        mesh: the mesh.
        ends: (E, 2) vertices of the edges.
        outwards: (E, 3) unit directions away from the mesh.
    """
    # a short step away from the mesh, projected to the film
    midpoints = mesh.vertices[ends].mean(dim=1)
    outside_points = midpoints + 1e-3 * mesh.extent * outwards
    outside_on_film = project_to_film(camera, outside_points)
    return outside_on_film - project_to_film(camera, midpoints)


def _find_outline(mesh: TriMesh, eye: Tensor) -> tuple[Tensor, Tensor]:
    """Find the edges of a mesh that an eye at a position (3,) may see as its outline.

    All faces at such an edge lie on one side of the plane through the edge and the eye;
    there may be a single face. Edges that another surface hides are included.

    Returns:
        (E, 2) vertices of the edges, and (E, 3) that plane's unit normal, away from the
        mesh.
    """
    edges = _find_edges(mesh.vertices, mesh.corners)
    ends = edges.ends
    plane = _compute_plane_normals(mesh, ends, eye)
    # (3 F,) for each side of a face: signed distance of the face's third corner from
    # the plane of the edge on which the side lies
    corner_from_eye = mesh.vertices[edges.third_corner] - eye
    offset_from_plane = (plane[edges.edge_of_side] * corner_from_eye).sum(dim=1)
    min_offset, max_offset = _find_offset_range(edges, offset_from_plane)
    are_faces_in_front = min_offset > 0.0  # all on the side of the plane's normal
    are_faces_behind = max_offset < 0.0
    on_outline = are_faces_in_front | are_faces_behind
    # turns the normals away from the faces
    sign = torch.where(are_faces_in_front[on_outline], -1.0, 1.0)[:, None]
    return ends[on_outline], plane[on_outline] * sign


def _compute_plane_normals(mesh: TriMesh, ends: Tensor, eye: Tensor) -> Tensor:
    """Return unit normals (E, 3) of the planes through edges (E, 2) and an eye (3,)."""
    normal = torch.linalg.cross(
        mesh.vertices[ends[:, 0]] - eye, mesh.vertices[ends[:, 1]] - eye
    )
    return torch.nn.functional.normalize(normal, dim=1)


def _find_offset_range(edges: _MeshEdges, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest offset (E,) over the faces at each edge.

    `offset` (3 F,) has a number for each side of a face.
    """
    infinite = torch.full((len(edges.ends),), torch.inf, dtype=offset.dtype)
    smallest = infinite.scatter_reduce(0, edges.edge_of_side, offset, "amin")
    largest = (-infinite).scatter_reduce(0, edges.edge_of_side, offset, "amax")
    return smallest, largest


def _sample_along(length: Tensor, random: Tensor) -> tuple[Tensor, Tensor]:
    """Spread n stratified samples over segments in proportion to their lengths.

    Args:
        length: (E,) lengths of the segments, of which at least one is positive; a
            segment of length 0 gets no sample.
        random: (n,) random numbers in [0, 1).

    Returns:
        (n,) index of the segment, and (n,) position along it in [0, 1].
    """
    # Stratified: sample i lies in the i-th of n equal parts of the total length.
    length_sums = length.cumsum(dim=0)
    distance = (torch.arange(len(random)) + random) / len(random) * length_sums[-1]
    last_segment = int(length.nonzero().max())
    # Clamped: rounding may place a sample past the last segment with a length.
    segment = torch.searchsorted(length_sums, distance, right=True).clamp_max(
        last_segment
    )
    fraction = (1.0 - (length_sums[segment] - distance) / length[segment]).clamp(
        0.0, 1.0
    )
    return segment, fraction


class _MeshEdges(NamedTuple):
    """The E edges of a mesh, and the 3 F sides of its faces that lie on them."""

    ends: Tensor  # (E, 2) vertices of each edge
    edge_of_side: Tensor  # (3 F,) index of the edge on which each side lies
    third_corner: Tensor  # (3 F,) vertex of the side's face that is not on the side


def _find_edges(vertices: Tensor, corners: Tensor) -> _MeshEdges:
    """Find the edges of a mesh, each with all faces on it.

    Vertices at the same position count as one.

    Args:
        vertices: (V, 3) positions.
        corners: (F, 3) vertices of the faces.
    """
    # (V,) numbers, which are equal for vertices at the same position
    position_id = torch.unique(vertices, dim=0, return_inverse=True)[1]
    face_sides = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    third_corner = torch.cat([corners[:, 2], corners[:, 0], corners[:, 1]])
    lower, higher = position_id[face_sides].aminmax(dim=1)
    # one number for each pair of positions, in either direction
    edge_keys, edge_of_side = torch.unique(
        lower * len(vertices) + higher, return_inverse=True
    )
    side_index = torch.arange(len(edge_of_side))
    # An edge has the vertices of the first side that lies on it. To assign them by
    # index would take those of any side, not the same one in each call.
    first_side = torch.full((len(edge_keys),), len(edge_of_side)).scatter_reduce(
        0, edge_of_side, side_index, "amin"
    )
    return _MeshEdges(face_sides[first_side], edge_of_side, third_corner)


def compute_shadow_term(
    view: FilmView, mesh: TriMesh, seed: int, mesh_index: int, spp: int
) -> Any:
    """Return a value whose gradient is the shadow term of one mesh.

    A line that touches the mesh at an edge separates light that passes from light that
    is blocked. It comes from the light, and ends at a lit point on another surface,
    where the border of the shadow lies. The contribution of a line is the product of
    two factors: how much the light past the edge adds to the loss through the image
    (`strength`), and the speed of the edge, relative to the lit point if that moves
    too.

    Args:
        view: the scene.
        mesh: mesh that moves, or that stands still and may cast a shadow.
        seed: seed of the samples.
        mesh_index: index of the mesh, which gives it random numbers of its own.
        spp: samples, in multiples of the number of pixels.
    """
    stream = make_stream(seed, _SHADOWS, mesh_index)
    random = sample_uniform(stream, spp * view.camera.pixels, 4)
    lines = _sample_tangents(mesh, random)
    if lines is None:
        return mi.Float(0)
    with dr.suspend_grad():
        shadow = _sample_shadow_borders(view, mesh, lines, stream)
    if shadow is None:
        return mi.Float(0)
    motion = _compute_border_motion(view, mesh, lines, shadow)
    sine = _compute_edge_sines(mesh, lines)
    strength = shadow.strength * to_drjit_float(sine[shadow.line_index])
    # minus: where the edge moves outwards, light is blocked
    return dr.sum(strength * motion) * -lines.measure_per_sample


def _compute_border_motion(
    view: FilmView, mesh: TriMesh, lines: _TangentLines, shadow: _ShadowBorders
) -> Any:
    """Return a value whose gradient is the motion of edges relative to lit points.

    It is the component along the edges' normals.
    """
    # Only the gradient of the motion is used. So a lit point that does not move may
    # have any position: it is 0.
    index = shadow.line_index
    lit_point, _normal, _shading_normal, lit_point_moves = view.attach_hit(shadow.hit)
    edge_point = mesh.interpolate_edge(lines.ends[index], lines.fraction[index])
    moving_lit_point = dr.select(lit_point_moves, lit_point, 0.0)
    return dr.dot(shadow.edge_normal, edge_point - moving_lit_point)


def _compute_edge_sines(mesh: TriMesh, lines: _TangentLines) -> Tensor:
    """Return the sine (n,) of the angle between each line and its edge.

    An edge along the line sweeps no area.
    """
    edge_direction = _compute_edge_directions(mesh.vertices, lines.ends)
    sine: Tensor = torch.linalg.cross(lines.direction, edge_direction).norm(dim=1)
    return sine


class _ShadowBorders(NamedTuple):
    """Points on the borders of shadows that the camera sees, for m of the lines."""

    line_index: Tensor  # (m,) index of the line, among all sampled lines
    hit: Any  # the lit point, where the line past the edge ends
    edge_normal: Any  # unit vector, away from the mesh at the edge
    strength: Any  # derivative of the loss by the light that passes the edge


def _sample_shadow_borders(
    view: FilmView, mesh: TriMesh, lines: _TangentLines, stream: int
) -> _ShadowBorders | None:
    """Find the lines whose lit points the camera sees; None if there is none.

    A line comes from the light, touches the mesh at an edge and ends at the lit point,
    on the next surface.

    Args:
        view: the scene.
        mesh: the mesh with the edges.
        lines: sampled edge points, and lines through them.
        stream: stream of the random numbers, as from `make_stream`.
    """
    edge_position = to_drjit_vectors(mi.Point3f, _locate_edge_points(mesh, lines))
    to_light = to_drjit_vectors(mi.Vector3f, lines.direction)
    edge_normal = to_drjit_vectors(mi.Vector3f, lines.normal)
    offset = SHADOW_OFFSET * mesh.extent * edge_normal
    # The ray starts just past the edge, and goes the way of the light to the lit point.
    ray = mi.Ray3f(edge_position + offset, -to_light)
    hit = view.scene.ray_intersect_preliminary(ray, coherent=False)
    si = hit.compute_surface_interaction(ray, mi.RayFlags.All, hit.is_valid())
    light_weight = _weigh_lit_points(view, si, to_light)
    dr.eval(light_weight, hit, si, edge_position, offset)
    # Most lines end where the camera sees nothing, and are dropped here.
    line_index = dr.compress(dr.any(light_weight != 0.0))
    if dr.width(line_index) == 0:
        return None
    light_weight, hit, si, edge_position, offset, edge_normal = _select_lanes(
        line_index, light_weight, hit, si, edge_position, offset, edge_normal
    )
    # how much the loss changes as the lit point passes the shadow's border
    difference = _sample_radiance_difference(view, si, edge_position, offset, stream)
    strength = _multiply_finite(light_weight, difference)
    dr.eval(strength, hit)
    return _ShadowBorders(
        line_index=line_index.torch().to("cpu", torch.int64),
        hit=hit,
        edge_normal=edge_normal,
        strength=strength,
    )


def _select_lanes(lanes: Any, *values: Any) -> list[Any]:
    """Return each of some values of Dr.Jit with only the lanes of these indices."""
    return [dr.gather(type(value), value, lanes) for value in values]


def _locate_edge_points(mesh: TriMesh, lines: _TangentLines) -> Tensor:
    """Return the points (n, 3) of the mesh's edges through which the lines go."""
    first_end = mesh.vertices[lines.ends[:, 0]]
    second_end = mesh.vertices[lines.ends[:, 1]]
    return torch.lerp(first_end, second_end, lines.fraction[:, None])


def _multiply_finite(light_weight: Any, difference: Any) -> Any:
    """Return the sum over the color channels of the products, 0 if it is not finite.

    So a bad sample does not spoil the sum over all samples.
    """
    strength = dr.sum(light_weight * difference)
    return dr.select(dr.isfinite(strength), strength, 0.0)


def _weigh_lit_points(view: FilmView, si: Any, to_light: Any) -> Any:
    """Return the derivative (RGB) of the loss by light along lines to lit points.

    It is the product of three factors:

    - the cotangent at the point's pixel,
    - the BSDF towards the camera, times the cosine at which the light arrives,
    - the area on the film that a bundle of lines around this one covers, per unit of
      area across the bundle.

    It is 0 where the camera does not see the point.

    Args:
        view: the scene.
        si: surface interactions of the lit points; their `wi` is set to the camera.
        to_light: unit directions from which the light comes.
    """
    camera = view.camera
    film = camera.project(si.p)
    depth = camera.compute_depth(si.p)
    to_eye = camera.eye - si.p
    is_visible = si.is_valid() & (depth > MIN_DEPTH) & camera.is_in_frame(film)
    si.wi = si.to_local(dr.normalize(to_eye))
    # In Mitsuba, the value of a BSDF contains the cosine.
    weight = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(to_light), is_visible)
    is_visible &= dr.any(weight > 0.0)
    is_visible &= ~view.scene.ray_test(si.spawn_ray_to(camera.eye), is_visible)
    film_area = _compute_film_area(camera, si, to_eye, depth)
    # An area across the bundle covers 1 / cosine of the surface where the light
    # arrives.
    cosine = dr.abs(dr.dot(si.n, to_light))
    weight *= film_area / dr.maximum(cosine, MIN_COSINE)
    cotangent = view.interpolate_cotangent(film, is_visible)
    return dr.select(is_visible, weight * cotangent, 0.0)


def _compute_film_area(camera: Camera, si: Any, to_eye: Any, depth: Any) -> Any:
    """Return the area in pixels that a unit area of the surface covers on the film.

    Args:
        camera: the camera.
        si: surface interactions of points.
        to_eye: vectors from the points to the camera.
        depth: depths of the points.
    """
    matrix = camera.to_film.matrix
    # Area in pixels of a unit square at depth 1 that faces the camera. An entry of the
    # matrix is an array with one lane.
    film_widths_per_unit = float(matrix[0, 0][0])
    film_heights_per_unit = float(matrix[1, 1][0])
    pixels_at_unit_depth = abs(
        film_widths_per_unit * camera.width * film_heights_per_unit * camera.height
    )
    # The cosine at the surface over the squared depth would hold on the camera's axis;
    # away from it the product with `to_eye`, which is longer than the depth, needs the
    # third power.
    return dr.abs(dr.dot(si.n, to_eye)) / depth**3 * pixels_at_unit_depth


def _sample_radiance_difference(
    view: FilmView, si: Any, edge_point: Any, offset: Any, stream: int
) -> Any:
    """Return the radiance that a lit point gets just past an edge minus just inside.

    The difference is 0 where something else hides the edge from the lit point. That is
    tested on the ray past the edge only: the other one hits the mesh itself.

    Args:
        view: the scene.
        si: the lit point.
        edge_point: the point on the edge.
        offset: the step from the edge to just past it.
        stream: stream of random numbers; both sides have the same.
    """

    past_edge = edge_point + offset
    inside_edge = edge_point - offset
    is_free = _is_edge_free(view, si, edge_point, offset)
    past = _sample_radiance_from(view, si, past_edge, stream, is_free)
    inside = _sample_radiance_from(view, si, inside_edge, stream, is_free)
    difference = past - inside
    return dr.select(is_free, difference, 0.0)


def _is_edge_free(view: FilmView, si: Any, edge_point: Any, offset: Any) -> Any:
    """Return whether nothing but the mesh itself hides an edge from lit points.

    The arguments are those of `_sample_radiance_difference`.
    """
    ray = _make_endless_ray(si, edge_point + offset)
    occluder = view.scene.ray_intersect_preliminary(ray, coherent=False)
    # The mesh itself, at the edge or within two offsets of it, is no occluder.
    max_distance = dr.norm(edge_point - si.p) * (1.0 - DEPTH_TOLERANCE)
    max_distance -= 2.0 * dr.norm(offset)
    return ~occluder.is_valid() | (occluder.t > max_distance)


def _sample_radiance_from(
    view: FilmView, si: Any, target: Any, stream: int, active: Any
) -> Any:
    """Return the radiance at lit points from the direction of targets.

    The noise is the same in each call with the same `stream`.
    """
    sampler = make_sampler(stream + _PATHS, dr.width(target))
    ray = _make_endless_ray(si, target)
    # The camera's segment is one of the path's `max_depth`.
    return view.sample_radiance(ray, sampler, view.max_depth - 1, active)


def _make_endless_ray(si: Any, target: Any) -> Any:
    """Return a ray from a lit point that does not end at the target."""
    ray = si.spawn_ray_to(target)
    return mi.Ray3f(ray.o, ray.d)


class _TangentLines(NamedTuple):
    """Points sampled on edges of a mesh, and lines through them that touch the mesh."""

    ends: Tensor  # (n, 2) vertices of the edge
    fraction: Tensor  # (n,) position along the edge, in [0, 1]
    direction: Tensor  # (n, 3) unit direction of the line
    normal: Tensor  # (n, 3) unit normal of edge and line, away from the mesh
    # all lines that could be sampled (length times solid angle: world units times
    # steradians), divided by the number of samples
    measure_per_sample: float


def _orient_outwards(vectors: Tensor, directions: Tensor) -> Tensor:
    """Return vectors (N, 3), turned over where they point along a direction (N, 3)."""
    points_inwards = (vectors * directions).sum(dim=1, keepdim=True) > 0.0
    return vectors * torch.where(points_inwards, -1.0, 1.0)


def _sample_tangents(mesh: TriMesh, random: Tensor) -> _TangentLines | None:
    """Sample lines that touch the mesh at points of its edges, evenly.

    A line through a point of an edge touches the mesh if both faces at the edge are on
    one side of it. In a cross-section of the edge, such lines lie within the exterior
    angle, between one face and the continuation of the other, or in the opposite of
    that angle. At an edge with a single face every line touches the mesh.

    Args:
        mesh: the mesh.
        random: (n, 4) random numbers in [0, 1). They choose the edge, the point on it,
            the angle around the edge, and the angle to the edge.

    Returns:
        The samples; None if there is nothing to sample.
    """
    edges = _measure_exterior_angles(mesh)
    # length times exterior angle of each edge
    measure = _compute_edge_vectors(mesh.vertices, edges.ends).norm(dim=1)
    measure = measure * edges.angle
    if len(random) == 0 or not float(measure.sum()) > 0.0:
        return None
    # Only the choice of the edge is used: the point on it has a random number of its
    # own.
    edge_index, _fraction = _sample_along(measure, random[:, 0])
    axis = edges.axis[edge_index]
    along_second = edges.along_second[edge_index]
    # Both faces go from the edge to the side where the mesh is.
    inwards = edges.along_first[edge_index] + along_second

    perpendicular = _sample_exterior_angle(edges, edge_index, random[:, 2:3])
    # The last random number is scaled to -2 to 2. Its sign chooses the exterior angle
    # or the opposite one, and its magnitude minus 1 is the cosine of line and edge.
    signed_choice = 4.0 * random[:, 3:4] - 2.0
    perpendicular = torch.where(signed_choice < 0.0, -perpendicular, perpendicular)
    direction = _tilt_to_edges(perpendicular, axis, signed_choice.abs() - 1.0)

    normal = _orient_outwards(torch.linalg.cross(axis, perpendicular), inwards)
    # `measure` contains the edge's length and the exterior angle. The range of
    # `signed_choice`, 4, is the rest: cosines from -1 to 1, for two opposite angles.
    return _TangentLines(
        ends=edges.ends[edge_index],
        fraction=random[:, 1],
        direction=direction,
        normal=normal,
        measure_per_sample=4.0 * float(measure.sum()) / len(random),
    )


def _sample_exterior_angle(
    edges: _ExteriorAngles, edge_index: Tensor, random: Tensor
) -> Tensor:
    """Sample unit directions (n, 3) perpendicular to edges, in their exterior angles.

    Args:
        edges: the edges.
        edge_index: (n,) index of the edge of each sample.
        random: (n, 1) numbers in [0, 1).
    """
    # `along_second` rotated about the edge towards `opening`
    angle = random * edges.angle[edge_index][:, None]
    along_second = edges.along_second[edge_index]
    opening = edges.opening[edge_index]
    return torch.cos(angle) * along_second + torch.sin(angle) * opening


def _tilt_to_edges(perpendicular: Tensor, axis: Tensor, edge_cosine: Tensor) -> Tensor:
    """Return unit directions (n, 3) that have a cosine (n, 1) with the edges' axes.

    `perpendicular` and `axis` are unit vectors (n, 3), perpendicular to each other.
    """
    edge_sine = (1.0 - edge_cosine.square()).clamp_min(0.0).sqrt()
    return edge_cosine * axis + edge_sine * perpendicular


class _ExteriorAngles(NamedTuple):
    """The exterior angles of the edges of a mesh that have one face or two."""

    ends: Tensor  # (E, 2) vertices
    axis: Tensor  # (E, 3) unit vector along the edge
    # (E, 3) unit vectors along both faces, perpendicular to the edge; the same vector
    # twice where there is one face
    along_first: Tensor
    along_second: Tensor
    # (E, 3) unit vector, perpendicular to the edge and to `along_second`, to which the
    # angle opens
    opening: Tensor
    angle: Tensor  # (E,) exterior angle, radians


def _measure_exterior_angles(mesh: TriMesh) -> _ExteriorAngles:
    """Measure the exterior angles of the edges of a mesh that have one face or two.

    Edges with more faces, or of length 0, are left out.
    """
    vertices = mesh.vertices
    edges = _find_edges(vertices, mesh.corners)
    n_faces = torch.bincount(edges.edge_of_side, minlength=len(edges.ends))
    first_side, last_side = _find_outer_sides(edges, n_faces)
    length = _compute_edge_vectors(vertices, edges.ends).norm(dim=1)
    is_measured = (n_faces <= 2) & (length > 0.0)
    ends = edges.ends[is_measured]
    axis = _compute_edge_directions(vertices, ends)
    start = vertices[ends[:, 0]]

    first_corner = vertices[edges.third_corner[first_side[is_measured]]]
    last_corner = vertices[edges.third_corner[last_side[is_measured]]]
    along_first = _remove_component(first_corner - start, axis)
    along_second = _remove_component(last_corner - start, axis)
    is_single = n_faces[is_measured] == 1
    opening, angle = _measure_between_faces(along_first, along_second, axis, is_single)
    return _ExteriorAngles(
        ends=ends,
        axis=axis,
        along_first=along_first,
        along_second=along_second,
        opening=opening,
        angle=angle,
    )


def _find_outer_sides(edges: _MeshEdges, n_faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return for each edge the first and the last side (E,) of a face on it.

    They belong to the two faces at the edge; at an edge with a single face they are the
    same. `n_faces` (E,) is the number of faces at each edge.
    """
    # Sort the sides of faces by their edge, so that those of one edge follow one
    # another.
    sorted_sides = torch.argsort(edges.edge_of_side, stable=True)
    # (E,) where the sides of each edge begin and end in `sorted_sides`
    last_index = n_faces.cumsum(dim=0) - 1
    first_index = last_index - n_faces + 1
    return sorted_sides[first_index], sorted_sides[last_index]


def _remove_component(vectors: Tensor, axis: Tensor) -> Tensor:
    """Return unit vectors (N, 3): the parts of vectors perpendicular to unit axes."""
    along_axis = (vectors * axis).sum(dim=1, keepdim=True) * axis
    return torch.nn.functional.normalize(vectors - along_axis, dim=1)


def _measure_between_faces(
    along_first: Tensor, along_second: Tensor, axis: Tensor, is_single: Tensor
) -> tuple[Tensor, Tensor]:
    """Measure the exterior angles of edges: pi minus the angle between both faces.

    At an edge with a single face it is pi.

    Args:
        along_first, along_second: (N, 3) unit vectors along both faces, perpendicular
            to the edge.
        axis: (N, 3) unit vectors along the edges.
        is_single: (N,) whether an edge has only one face.

    Returns:
        (N, 3) unit vectors `opening`, and (N,) angles: the directions within an
        exterior angle are cos(t) along_second + sin(t) opening, for t from 0 to the
        angle.
    """
    cosine = (along_first * along_second).sum(dim=1, keepdim=True)
    # the part of the first direction that is perpendicular to the second
    perpendicular = along_first - cosine * along_second
    # From the second face the exterior angle opens away from the first one (hence the
    # minus). At a single face it is half a turn, and may open to either side.
    opening = torch.where(
        is_single[:, None],
        torch.linalg.cross(axis, along_second),
        -torch.nn.functional.normalize(perpendicular, dim=1),
    )
    # At a single face both directions are the same: sine 0 and cosine 1 make an
    # interior angle of 0.
    interior_angle = torch.atan2(perpendicular.norm(dim=1), cosine[:, 0])
    return opening, torch.pi - interior_angle


def _compute_edge_vectors(vertices: Tensor, ends: Tensor) -> Tensor:
    """Return vectors (n, 3) from the first to the second vertex of edges (n, 2)."""
    return vertices[ends[:, 1]] - vertices[ends[:, 0]]


def _compute_edge_directions(vertices: Tensor, ends: Tensor) -> Tensor:
    """Return unit vectors (n, 3) along edges with vertices (n, 2)."""
    return torch.nn.functional.normalize(_compute_edge_vectors(vertices, ends), dim=1)
