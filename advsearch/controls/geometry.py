"""The `geometry` control: a smooth change of the object's shape, at most so far.

    modes          d = sum_k a_k m_k,  a = 2 u - 1             m_k: the smoothest displacement fields of the mesh
    large-steps    d = g R (I + lambda L)^-2 (2 u - 1)         a push for each vertex, spread out over its surroundings
    offsets        epsilon s(d) d                              s: one factor that keeps the mesh whole

No vertex moves by more than epsilon, no face turns over and no wall meets the other,
for any u. A mode varies slowly over SPACE, so that close walls move together: diffusion
maps (Coifman and Lafon 2006, "Diffusion maps", sections 2 and 3, alpha = 1) of points
spread over the surface, extended to the vertices by the Nystrom formula, without rigid
motions. R (I + lambda L)^-2 is Nicolet et al.'s (2021, "Large Steps in Inverse
Rendering of Geometry", section 3.2), with edges weighted by their length and links
through thin walls added to L.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy import linalg, sparse
from scipy.sparse import linalg as sparse_linalg
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from advsearch.controls.base import (
    NOTHING,
    Choice,
    Control,
    Group,
    Parameter,
    Value,
    measure,
)
from advsearch.scene.assembly import MovingMesh
from advsearch.scene.assets import Doubles, Mesh, face_vectors
from advsearch.scene.raster import welded

CELL = 0.035
"""Side of the cubes that the surface is thinned to one point in, in extents of the
mesh; larger if that is too many.
"""
LANDMARKS = 900  # largest number of such points
SAMPLES = 20000
"""Points spread over the surface before they are thinned, so that large triangles count
as what they cover.
"""
BANDWIDTH = 1.8  # standard deviation of the kernel, in cells
# largest displacement gradient along a face; below 1 no face can turn over
FACE_STRAIN = 0.7
WALL_STRAIN = 0.5  # largest change of the distance between two walls, as a share of it
WALL_REACH = 0.3  # walls further apart than this, in extents, are not held together
OPPOSITE = -0.3  # largest cosine between the normals of the two sides of a wall
THIN_FACE = 2e-3
"""Faces whose height is less than this share of their longest edge are slivers: their
strain is not looked at.
"""
SHARPNESS = 32  # exponent p of the norm that stands in for a maximum
# distance over which a push on one vertex spreads, in extents (form large-steps)
SMOOTHING_LENGTH = 0.1
WALL_WEIGHT = 4.0  # weight of a link through a wall, in edges of the mesh


class Body:
    """A mesh whose seams are welded: what a displacement acts on."""

    def __init__(self, mesh: Mesh) -> None:
        self.index, count = welded(mesh)  # (V,) the place of each vertex
        self.places = np.zeros((count, 3))  # distinct vertex positions
        self.places[self.index] = mesh.vertices
        self.extent = float(np.ptp(self.places, axis=0).max())
        faces = self.index[mesh.faces]
        turned = face_vectors(self.places[faces])
        # over places, without those that have no area
        self.faces = faces[np.linalg.norm(turned, axis=1) > 0.0]
        summed = np.zeros((count, 3))
        np.add.at(summed, faces.reshape(-1), np.repeat(turned, 3, axis=0))
        # by area
        self.normals = summed / np.maximum(
            np.linalg.norm(summed, axis=1, keepdims=True), 1e-20
        )
        # (W, 2) places on opposite sides of a wall or of a gap: for each the nearest
        # with an opposite normal, where there is one, by |x - y|^2 + b^2 |n + m|^2, a
        # search in six dimensions
        turn = 0.1 * self.extent * self.normals
        partner = cKDTree(np.hstack([self.places, turn])).query(
            np.hstack([self.places, -turn])
        )[1]
        distance = np.linalg.norm(self.places - self.places[partner], axis=1)
        opposite = (self.normals * self.normals[partner]).sum(axis=1) < OPPOSITE
        place = np.flatnonzero(
            opposite
            & (distance > 1e-5 * self.extent)
            & (distance < WALL_REACH * self.extent)
        )
        self.walls = np.stack([place, partner[place]], axis=1)


# ---- modes over space
# ------------------------------------------------------------------------------------------------


body = lru_cache(maxsize=8)(Body)  # of a mesh; kept in memory


@lru_cache(maxsize=8)
def shape_modes(mesh: Mesh, count: int) -> Doubles:
    """Return the `count` smoothest displacement fields of a mesh that are no rigid
    motion; kept in memory.

    They are (P, 3, count), for each place of `body(mesh)`, smoothest first; the largest
    length is 1 in each.
    """
    welded_mesh = body(mesh)
    points, cell = _landmarks(welded_mesh)
    scalars = min(math.ceil(count / 3) + 2, len(points) - 1)
    width = BANDWIDTH * cell
    kernel = np.exp(-cdist(points, points, "sqeuclidean") / (2.0 * width**2))
    density = kernel.sum(axis=1)
    kernel /= density[:, None] * density[None, :]
    mass = kernel.sum(axis=1)
    symmetric = kernel / np.sqrt(mass[:, None] * mass[None, :])
    # by Lanczos, without entries too small to matter: dense solvers wait for all
    # threads, which takes ten times as long on a machine with other work
    large = sparse.csr_matrix(
        np.where(symmetric > 1e-7 * symmetric.max(), symmetric, 0.0)
    )
    begin = np.cos(np.arange(len(points)))
    reach = min(len(points), 4 * (scalars + 1))
    values, vectors = sparse_linalg.eigsh(
        large, scalars + 1, which="LA", v0=begin, ncv=reach
    )
    falling = np.argsort(-values)[1:]  # the first is constant
    values = values[falling]
    vectors = _signed(vectors[:, falling])
    functions = vectors / np.sqrt(mass)[:, None]
    combination = _without_rotation(
        points, functions, mass, (1.0 - values) / width**2, count
    )
    near = -cdist(welded_mesh.places, points, "sqeuclidean") / (2.0 * width**2)
    weights = np.exp(near - near.max(axis=1, keepdims=True)) / density
    extended = (weights / weights.sum(axis=1, keepdims=True)) @ (
        functions / np.maximum(values, 0.05)
    )
    fields = np.einsum("ps,sck->pck", extended, combination)
    return np.asarray(fields / np.linalg.norm(fields, axis=1).max(axis=0))


def _signed(vectors: Doubles) -> Doubles:
    largest = vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])]
    return np.asarray(vectors * np.where(largest < 0.0, -1.0, 1.0))


def _landmarks(solid: Body) -> tuple[Doubles, float]:
    """Points (N, 3) evenly spread over the surface, at most `LANDMARKS`, and the side
    of the cubes that hold one.
    """
    corners = solid.places[solid.faces]
    areas = np.linalg.norm(face_vectors(corners), axis=1)
    generator = np.random.default_rng(0)
    face = np.searchsorted(
        np.cumsum(areas) / areas.sum(), (np.arange(SAMPLES) + 0.5) / SAMPLES
    ).clip(max=len(areas) - 1)
    shares = generator.dirichlet((1.0, 1.0, 1.0), SAMPLES)
    pool = np.concatenate(
        [np.einsum("nk,nkc->nc", shares, corners[face]), solid.places]
    )
    cell = CELL * solid.extent
    while True:
        cubes = np.floor((pool - pool.min(axis=0)) / cell).astype(np.int64)
        owner = np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)
        count = int(owner.max()) + 1
        if count <= LANDMARKS:
            break
        cell *= 1.15
    members = np.bincount(owner)
    return np.stack(
        [np.bincount(owner, pool[:, axis]) / members for axis in range(3)], axis=1
    ), cell


def _without_rotation(
    points: Doubles, functions: Doubles, mass: Doubles, energy: Doubles, count: int
) -> Doubles:
    """Combine scalar modes (N, S), orthonormal under `mass` (N,), to vector fields that
    hold no rotation, smoothest first: (S, 3, count), the weight of each mode along each
    axis. `energy` (S,) is how fast each varies.
    """
    scalars = functions.shape[1]
    middle = (points * mass[:, None]).sum(axis=0) / mass.sum()
    turns = [np.cross(axis, points - middle) for axis in np.eye(3)]
    rotations = np.stack(
        [(functions.T @ (mass[:, None] * turn)).reshape(-1) for turn in turns]
    )
    free = linalg.null_space(rotations)
    reduced = free.T @ (np.repeat(energy, 3)[:, None] * free)
    vectors = linalg.eigh(reduced)[1][:, : min(count, free.shape[1])]
    combined = _signed(free @ vectors)
    return np.asarray(combined.reshape(scalars, 3, -1))


# ---- one push per vertex
# ---------------------------------------------------------------------------------------------


class Preconditioner:
    """Spreads pushes over the neighbourhood of a welded mesh and takes rigid motions
    out: `d = R (I + lambda L)^-2 p`.
    """

    def __init__(self, solid: Body) -> None:
        count = len(solid.places)
        edges = np.concatenate(
            [solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]]
        )
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        lengths = np.linalg.norm(
            solid.places[edges[:, 0]] - solid.places[edges[:, 1]], axis=1
        )
        mean = float(lengths.mean())
        links = np.concatenate([edges, solid.walls])
        weights = np.concatenate(
            [
                (mean / lengths.clip(0.1 * mean)) ** 2,
                np.full(len(solid.walls), WALL_WEIGHT),
            ]
        )
        adjacency = sparse.coo_matrix(
            (weights, (links[:, 0], links[:, 1])), shape=(count, count)
        ).tocsr()
        adjacency = adjacency + adjacency.T
        laplacian = (
            sparse.diags(np.asarray(adjacency.sum(axis=1)).reshape(-1)) - adjacency
        )
        strength = (SMOOTHING_LENGTH * solid.extent / mean) ** 2
        self._factor = sparse_linalg.splu(
            (sparse.identity(count) + strength * laplacian).tocsc()
        )
        centred = solid.places - solid.places.mean(axis=0)
        shifts = [np.broadcast_to(axis, solid.places.shape) for axis in np.eye(3)]
        turns = [np.cross(axis, centred) for axis in np.eye(3)]
        rigid_motions = np.asarray(
            linalg.orth(
                np.stack([field.reshape(-1) for field in (*shifts, *turns)], axis=1)
            )
        )
        self._rigid = torch.from_numpy(rigid_motions)

    def __call__(self, pushes: Tensor) -> Tensor:
        """Return displacements (P, 3) for pushes (P, 3), float64; differentiable."""
        once: Tensor = _Solve.apply(pushes, self._factor)  # type: ignore[no-untyped-call]
        smooth: Tensor = _Solve.apply(once, self._factor)  # type: ignore[no-untyped-call]
        flat = smooth.reshape(-1)
        rigid = self._rigid.to(flat.device)
        return (flat - rigid @ (rigid.T @ flat)).reshape(smooth.shape)


class _Solve(torch.autograd.Function):
    """Solution of a symmetric sparse system; its derivative is the same solution, any
    number of times.
    """

    @staticmethod
    def forward(ctx: Any, right: Tensor, factor: Any) -> Tensor:
        ctx.factor = factor
        return torch.from_numpy(factor.solve(right.detach().cpu().numpy())).to(
            right.device
        )

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor, None]:
        return _Solve.apply(cotangent.contiguous(), ctx.factor), None  # type: ignore[no-untyped-call]


# ---- how far
# ---------------------------------------------------------------------------------------------------------


class Limits:
    """Holds displacements where the mesh stays whole, by one factor for all of it.

        offsets = epsilon s d,    s = (1 + sum_i r_i^p)^(-1/p)

    with `r_i` what each bound would be used up to, 1 being all of it: the length of d
    at each place (1), the gradient of the displacement along each face (`FACE_STRAIN`),
    and between the two sides of each wall (`WALL_STRAIN`). As `s max r < 1`, no place
    moves further than epsilon, no face turns over (its tangent map is I + B with ||B||
    < 1, and so has a positive determinant), and walls and gaps between places keep more
    than half their width. Epsilon is in the mesh's units.
    """

    def __init__(self, solid: Body, epsilon: float) -> None:
        self.epsilon = epsilon
        corners = solid.places[solid.faces]
        first = corners[:, 1] - corners[:, 0]
        second = corners[:, 2] - corners[:, 0]
        longest = np.linalg.norm(
            np.stack([first, second, first - second]), axis=-1
        ).max(axis=0)
        double_area = np.linalg.norm(np.cross(first, second), axis=1)
        sound = double_area > THIN_FACE * longest**2
        first = first[sound]
        second = second[sound]
        double_area = double_area[sound]
        length = np.linalg.norm(first, axis=1)
        along = (first * second).sum(axis=1) / length
        # gradient along the face's two axes: [d1 d2] [[length, along], [0, height]]^-1
        self._faces = torch.from_numpy(solid.faces[sound])
        self._across = torch.from_numpy(
            np.stack([1.0 / length, along / length, length / double_area], axis=1)
        )
        self._walls = torch.from_numpy(solid.walls)
        gaps = np.linalg.norm(
            solid.places[solid.walls[:, 0]] - solid.places[solid.walls[:, 1]], axis=1
        )
        self._gaps = torch.from_numpy(gaps)
        self._places = torch.from_numpy(solid.places)

    def used(self, field: Tensor) -> Tensor:
        """Return the squares (N,) of how far each bound is used up by `epsilon d` for d
        (P, 3).
        """
        faces_of, across, walls_of, gaps = (
            held.to(field.device)
            for held in (self._faces, self._across, self._walls, self._gaps)
        )
        # index_select, for its derivative is ten times faster than that of an index
        corners = [field.index_select(0, corner) for corner in faces_of.T]
        first = corners[1] - corners[0]
        second = corners[2] - corners[0]
        along = first * across[:, :1]
        beside = (second - first * across[:, 1:2]) * across[:, 2:]
        faces = (along.square() + beside.square()).sum(dim=1) * (
            self.epsilon / FACE_STRAIN
        ) ** 2
        apart = field.index_select(0, walls_of[:, 0]) - field.index_select(
            0, walls_of[:, 1]
        )
        walls = apart.square().sum(dim=1) * (self.epsilon / WALL_STRAIN / gaps).square()
        return torch.cat([field.square().sum(dim=1), faces, walls])

    def held(self, field: Tensor) -> Tensor:
        """Return the offsets (P, 3) for a field d (P, 3), float64; differentiable."""
        squares = self.used(field)
        # keeps the power within the numbers' range
        largest = squares.detach().max().clamp_min(1.0)
        total = (squares / largest).pow(SHARPNESS // 2).sum() + largest ** (
            -SHARPNESS // 2
        )
        return self.epsilon * field * (total ** (-1.0 / SHARPNESS) / largest.sqrt())

    def thinnest(self, offsets: Tensor) -> float:
        """Return the smallest width of a wall or gap after a displacement (P, 3), as a
        share of what it was.
        """
        if not len(self._walls):
            return 1.0
        moved = (self._places + offsets.cpu())[self._walls]
        return float(((moved[:, 0] - moved[:, 1]).norm(dim=1) / self._gaps).min())


FORMS = ("modes", "large-steps")
DEFAULT_EPSILON = 0.03
LARGEST_EPSILON = 0.5
DEFAULT_MODES = 24
LARGEST_MODES = 200
PUSH = 4.0
"""Factor on the pushes of form large-steps: pushes at their largest over a
neighbourhood pass the bound on the length of d, so that it is reached without every
vertex of the object agreeing.
"""
ESTIMATORS = ("material", "differences")


class GeometryControl(Control):
    """A smooth change of the object's shape, at most so far."""

    kind = "geometry"
    of_a_mesh = True
    parameters = (
        Parameter("amplitudes", (None,), "1", -1.0, 1.0, 0.0,
                  "How much of each smooth mode of the shape is added (form modes).", moves_silhouettes=True,
                  search=(-1.0, 1.0), estimators=ESTIMATORS),
        Parameter("pushes", (None, 3), "1", -1.0, 1.0, 0.0,
                  "Push on each vertex before it is spread out (form large-steps).", moves_silhouettes=True,
                  search=(-1.0, 1.0), estimators=ESTIMATORS),
    )  # fmt: skip
    choices = (
        Choice("epsilon", DEFAULT_EPSILON, "Largest displacement of a vertex, in "
                                           "object sizes.", "epsilon",
               most=LARGEST_EPSILON),
        Choice("modes", DEFAULT_MODES, "Number of smooth modes (form modes).", whole=(1, LARGEST_MODES)),
        Choice("form", "modes", "What is searched: modes (a few smooth fields) or "
                                "large-steps (every vertex)."),
    )  # fmt: skip

    def check_choices(self) -> None:
        self.form = self.chosen_form(FORMS)

    def fit(self) -> None:
        self._offsets, self._mesh = (
            f"{self.mesh}.offsets",
            self.mesh_in(self.scene).mesh,
        )
        solid = body(self._mesh)
        self._index = torch.from_numpy(solid.index)
        self._limits = Limits(solid, float(self.chosen["epsilon"]))
        if self.form == "modes":
            modes = torch.from_numpy(shape_modes(self._mesh, int(self.chosen["modes"])))
            group = Group("amplitudes", modes.shape[2], ESTIMATORS)
            self._field: Callable[[Tensor], Tensor] = lambda a: modes.to(a.device) @ a
        else:
            spread = Preconditioner(solid)
            group = Group("pushes", 3 * len(solid.places), ESTIMATORS)
            self._field = lambda a: PUSH * spread(a.reshape(-1, 3))
        self.groups, self.start = (group,), torch.full((group.size,), 0.5)

    def inputs(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, Tensor]:
        return {
            self._offsets: self.offsets(u)
            .index_select(0, self._index.to(u.device))
            .float()
        }

    def offsets(self, u: Tensor) -> Tensor:
        """Displacement of each place, (P, 3) float64."""
        return self._limits.held(self._field(2.0 * u.double() - 1.0))

    def describe(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, Value]:
        offsets = self.offsets(u.detach())
        lengths = offsets.norm(dim=1)
        return {
            f"{self.name}.largest": measure(lengths.max(), "object sizes"),
            f"{self.name}.rms": measure(lengths.square().mean().sqrt(), "object sizes"),
            f"{self.name}.thinnest": measure(self._limits.thinnest(offsets), "1"),
        }

    def files(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING
    ) -> dict[str, bytes]:
        moving = MovingMesh(self._mesh, np.eye(4))
        vertices, normals = moving.place(None, self.inputs(u.detach())[self._offsets])
        lines = ["# advsearch: z is up; texture coordinates as of the original object"]
        lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices.tolist()]
        lines += [f"vt {u:.7g} {v:.7g}" for u, v in self._mesh.uvs.tolist()]
        lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in normals.tolist()]
        faces = (self._mesh.faces.astype(np.int64) + 1).tolist()
        lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in faces]
        return {f"{self.name}.obj": ("\n".join(lines) + "\n").encode("ascii")}
