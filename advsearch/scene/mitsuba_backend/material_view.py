"""The material form's view of a scene: camera, meshes, path tracer and random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.meshes import FACES, POSITIONS
from advsearch.scene.mitsuba_backend.variant import dr, mi

ROUGH_COTANGENT = 0.5
"""A cotangent whose neighbours are less correlated than this counts as rough."""
_OUTLINES, _PATHS, _SHADOWS = 1, 2, 3
"""Streams of random numbers of one seed; the interior has number 0."""


# ---- the scene as we see it -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
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
        seen = self.to_film @ (self.to_local @ mi.Point3f(point))
        return mi.Point2f(seen.x * self.width, seen.y * self.height)

    def depth(self, point: Any) -> Any:
        """Distance along the viewing axis."""
        return dr.dot(point - self.eye, self.forward)

    def ray(self, film: Any) -> Any:
        """The ray through a film position in pixels."""
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


def read_camera(sensor: Any) -> Camera:
    to_world = sensor.world_transform()
    width, height = (int(side) for side in sensor.film().crop_size())
    forward = dr.normalize(to_world @ mi.Vector3f(0.0, 0.0, 1.0))
    film = sensor.projection_transform()
    return Camera(to_world @ mi.Point3f(0.0), forward, film, to_world.inverse(), width, height)


@dataclass(frozen=True)
class TriMesh:
    """A mesh, for Dr.Jit and for torch: Mitsuba's pointer, flat Dr.Jit arrays, positions and vertex normals with
    gradients enabled if it moves; whether shading normals are interpolated; corners (F, 3) int64 and places (V, 3)
    float64."""

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
        sides = (mi.UInt32(ends[:, side].to(torch.int32).contiguous()) for side in (0, 1))
        a, b = (dr.gather(mi.Point3f, self.positions, side) for side in sides)
        return dr.fma(b - a, as_numbers(part), a)


def _mesh(shape: Any, faces: Any, vertices: Tensor, normals: Tensor) -> TriMesh:
    corners = faces.torch().reshape(-1, 3).to("cpu", torch.int64)
    smooth = bool(shape.has_vertex_normals())
    places = vertices.detach().to("cpu", torch.float64)
    return TriMesh(mi.ShapePtr(shape), as_array(vertices), as_array(normals), faces, smooth, corners, places)


def moving_mesh(scene: Any, parameters: Any, key: str, vertices: Tensor, normals: Tensor) -> TriMesh:
    shape = next(shape for shape in scene.shapes() if shape.id() == key)
    mesh = _mesh(shape, parameters[f"{key}.{FACES}"], vertices, normals)
    dr.enable_grad(mesh.positions, mesh.normals)
    return mesh


def still_meshes(scene: Any, parameters: Any, moving: Sequence[str]) -> list[TriMesh]:
    """Meshes that stand still but may hide a moving one, or shade it. A single rectangle is left out."""
    meshes = []
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() > 2 and shape.id() not in moving:
            places = parameters[f"{shape.id()}.{POSITIONS}"].torch().reshape(-1, 3).clone()
            meshes.append(_mesh(shape, parameters[f"{shape.id()}.{FACES}"], places, torch.zeros_like(places)))
    return meshes


@dataclass(frozen=True)
class FilmView:
    """What the three terms share: `weights` is the cotangent with a border of zeros, flat; `meshes` are those that
    move."""

    scene: Any
    camera: Camera
    meshes: Sequence[TriMesh]
    weights: Any
    max_depth: int

    def weight(self, film: Any, active: Any) -> Any:
        """The cotangent at a film position, bilinear between pixel centres, zero outside; differentiable in it."""
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
        place, facet, bent, moves = mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1), mi.Bool(False)
        u, v = hit.prim_uv
        for mesh in self.meshes:
            on = hit.is_valid() & (hit.shape == mesh.shape)
            corners = dr.gather(mi.Point3u, mesh.faces, hit.prim_index, on)
            a, b, c = (dr.gather(mi.Point3f, mesh.positions, corner, on) for corner in corners)
            normal = mi.Normal3f(dr.cross(b - a, c - a))
            place = dr.select(on, dr.fma(b - a, u, dr.fma(c - a, v, a)), place)
            facet = dr.select(on, normal, facet)
            if mesh.smooth:
                a, b, c = (dr.gather(mi.Normal3f, mesh.normals, corner, on) for corner in corners)
                normal = dr.fma(b - a, u, dr.fma(c - a, v, a))
            bent, moves = dr.select(on, normal, bent), moves | on
        return place, facet, bent, moves

    def radiance(self, ray: Any, sampler: Any, depth: int, active: Any) -> Any:
        """One sample of what arrives along a ray, over paths of up to `depth` segments; a constant."""
        tracer = _path_tracer(max(depth, 1))
        return tracer.sample(dr.ADMode.Primal, self.scene, sampler, ray, None, None, active)[0]


@cache
def _path_tracer(depth: int) -> Any:
    return mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": 1000})


# ---- random numbers, and the way between torch and Dr.Jit -----------------------------------------------------------


class _Sampler:
    """What a path tracer asks of a sampler, over a generator whose state is ours to share."""

    DRJIT_STRUCT = {"rng": mi.PCG32}  # noqa: RUF012 (Dr.Jit wants a plain dictionary)

    def __init__(self) -> None:
        self.rng = mi.PCG32()

    def next_1d(self, active: Any = True) -> Any:
        return self.rng.next_float32()

    def next_2d(self, active: Any = True) -> Any:
        return mi.Point2f(self.rng.next_float32(), self.rng.next_float32())


def shared_sampler(stream: int, count: int, index: Any) -> Any:
    """One of `count` streams of numbers for every lane; lanes of the same index draw the same."""
    base = mi.PCG32(count, mi.UInt64(stream))
    sampler = _Sampler()
    sampler.rng.state = dr.gather(mi.UInt64, base.state, index)
    sampler.rng.inc = dr.gather(mi.UInt64, base.inc, index)
    return sampler


def own_sampler(stream: int, count: int) -> Any:
    return shared_sampler(stream, count, dr.arange(mi.UInt32, count))


def stream_of(seed: int, purpose: int, number: int = 0) -> int:
    """A starting state below 2^63, well apart for neighbouring seeds."""
    return (((seed * 64 + number) * 4 + purpose + 1) * 0x9E3779B97F4A7C15) % 2**63


def uniform_numbers(stream: int, count: int, dimensions: int) -> Tensor:
    """(count, dimensions) float64 in [0, 1)."""
    return torch.rand(count, dimensions, generator=torch.Generator().manual_seed(stream), dtype=torch.float64)


def as_array(tensor: Tensor) -> Any:
    return mi.TensorXf(tensor.detach().to("cpu", torch.float32).contiguous()).array


def as_numbers(tensor: Tensor) -> Any:
    return mi.Float(tensor.to(torch.float32).contiguous())


def as_vectors(kind: Any, tensor: Tensor) -> Any:
    return kind(*(as_numbers(tensor[:, axis]) for axis in range(3)))


def from_vector(value: Any) -> Tensor:
    """(3,) float64 of a single Dr.Jit vector."""
    return torch.tensor([value.x[0], value.y[0], value.z[0]], dtype=torch.float64)


def film_places(camera: Camera, places: Tensor) -> Tensor:
    """(n, 2) float64 film positions of (n, 3) points."""
    film = camera.project(as_vectors(mi.Point3f, places))
    return torch.stack([film.x.torch(), film.y.torch()], dim=1).to("cpu", torch.float64)


def gradient_of(value: Any) -> Tensor:
    gradient: Tensor = dr.grad(value).torch().reshape(-1, 3).cpu().clone()
    return gradient


def is_rough(cotangent: Tensor) -> bool:
    """Whether neighbouring pixels ask for nearly unrelated things.

    The gradient of such a cotangent has no preferred sign within a few pixels. Then the noise of the radiance cancels
    if it is the same there; for a smooth cotangent it averages out better if it is not.
    """
    values = cotangent.detach().to(torch.float64)
    right, down = (torch.diff(values, dim=dim).square().mean() for dim in (1, 0))
    return bool(right + down > 4.0 * (1.0 - ROUGH_COTANGENT) * values.square().mean())
