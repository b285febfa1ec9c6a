"""The `geometry` control: a smooth change of the object's shape, at most so far.

    modes          d = sum_k a_k m_k,  a = 2 u - 1
    large-steps    d = g R (I + lambda L)^-2 (2 u - 1)
    offsets        epsilon s(d) d

The m_k are the smoothest displacement fields of the mesh. In the form large-steps each
vertex has a push, which is spread out over its surroundings. s is one factor that keeps
the mesh whole.

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
    NO_INPUTS,
    Choice,
    Control,
    Group,
    Parameter,
    Value,
    make_value,
)
from advsearch.scene.assembly import MovingMesh
from advsearch.scene.assets import Float64Array, IntArray, Mesh, compute_area_vectors
from advsearch.scene.raster import weld_vertices

CELL_SIZE = 0.035
"""Side of the cubes that the surface is thinned to one point in, in extents of the
mesh; larger if that is too many.
"""
MAX_LANDMARKS = 900  # largest number of such points
N_SURFACE_SAMPLES = 20000
"""Points spread over the surface before they are thinned, so that large triangles count
as what they cover.
"""
BANDWIDTH = 1.8  # standard deviation of the kernel, in cells
MIN_EIGENVALUE = 0.05  # smallest one that a function is divided by; the largest is 1
# largest displacement gradient along a face; below 1 no face can turn over
MAX_FACE_STRAIN = 0.7
# largest change of the distance between the two sides of a wall, as a fraction of it
MAX_WALL_STRAIN = 0.5
# sides that are further apart than this, in extents, count as no wall
MAX_WALL_DISTANCE = 0.3
# largest cosine between the normals of the two sides of a wall
MAX_OPPOSITE_COSINE = -0.3
MIN_FACE_HEIGHT = 2e-3
"""Faces whose height is less than this fraction of their longest edge are slivers,
whose strain is not limited.
"""
NORM_EXPONENT = 32  # exponent p of the norm that stands in for a maximum
# distance over which a push on one vertex spreads, in extents (form large-steps)
SMOOTHING_LENGTH = 0.1
WALL_WEIGHT = 4.0  # weight of a link through a wall, in edges of the mesh


class WeldedMesh:
    """A mesh whose seams are welded: what a displacement acts on.

    Attributes:
        position_of_vertex: (V,) index of the position of each vertex.
        positions: (P, 3) distinct positions of vertices.
        extent: largest side of the bounding box.
        faces: (F, 3) indices of positions, without faces that have no area.
        normals: (P, 3) unit normals, the mean of the faces' weighted by area.
        walls: (W, 2) indices of positions on opposite sides of a wall or of a gap.
    """

    def __init__(self, mesh: Mesh) -> None:
        """Weld the seams of a mesh, and find its walls.

        Vertices at the same position become one position. Faces without area are left
        out. The normal of a position is the mean of its faces' normals, weighted by
        their areas.
        """
        self.position_of_vertex, count = weld_vertices(mesh)
        self.positions = np.zeros((count, 3))
        self.positions[self.position_of_vertex] = mesh.vertices
        self.extent = float(np.ptp(self.positions, axis=0).max())
        faces = self.position_of_vertex[mesh.faces]
        area_vectors = compute_area_vectors(self.positions[faces])
        self.faces = faces[np.linalg.norm(area_vectors, axis=1) > 0.0]
        summed = np.zeros((count, 3))
        np.add.at(summed, faces.reshape(-1), np.repeat(area_vectors, 3, axis=0))
        lengths = np.linalg.norm(summed, axis=1, keepdims=True)
        self.normals = summed / np.maximum(lengths, 1e-20)
        self.walls = self._find_walls()

    def _find_walls(self) -> IntArray:
        """Return pairs (W, 2) of positions on opposite sides of a wall or of a gap.

        For a position x with the normal n, the partner is the position y, with the
        normal m, that minimises |x - y|^2 + b^2 |n + m|^2. Here b is a tenth of the
        mesh's extent; a k-d tree in six dimensions finds it. A pair is a wall if both
        normals are nearly opposite and the distance is not too large, and not 0.
        """
        scaled_normals = 0.1 * self.extent * self.normals  # b n
        tree = cKDTree(np.hstack([self.positions, scaled_normals]))
        partner = tree.query(np.hstack([self.positions, -scaled_normals]))[1]
        distance = np.linalg.norm(self.positions - self.positions[partner], axis=1)
        cosine = (self.normals * self.normals[partner]).sum(axis=1)
        is_wall = (
            (cosine < MAX_OPPOSITE_COSINE)
            & (distance > 1e-5 * self.extent)  # not 0
            & (distance < MAX_WALL_DISTANCE * self.extent)
        )
        position = np.flatnonzero(is_wall)
        return np.stack([position, partner[position]], axis=1)


# ---- modes over space


get_welded_mesh = lru_cache(maxsize=8)(WeldedMesh)  # of a mesh; cached


def _compute_landmark_weights(
    positions: Float64Array, points: Float64Array, width: float, density: Float64Array
) -> Float64Array:
    """Return the normalized weights (P, N) of landmarks (N, 3) at positions (P, 3).

    Args:
        positions: positions of a mesh.
        points: positions of the landmarks.
        width: standard deviation of the Gaussian kernel.
        density: (N,) density of the landmarks, by which the kernel is divided.
    """
    # The largest exponent is subtracted, so that far positions do not underflow to 0.
    exponent = -cdist(positions, points, "sqeuclidean") / (2.0 * width**2)
    weights = np.exp(exponent - exponent.max(axis=1, keepdims=True)) / density
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


@lru_cache(maxsize=8)
def compute_shape_modes(mesh: Mesh, count: int) -> Float64Array:
    """Return the smoothest displacement fields of a mesh that are no rigid motion.

    Some points of the surface, the landmarks, get a diffusion map: functions that vary
    slowly over the surface. The fields are combinations of these, extended from the
    landmarks to all positions of the mesh (Nystrom). The result is cached.

    Args:
        mesh: mesh in object sizes.
        count: number of fields.

    Returns:
        (P, 3, count), for each position of `get_welded_mesh(mesh)`, smoothest first;
        the largest length is 1 in each.
    """
    welded_mesh = get_welded_mesh(mesh)
    points, cell = _sample_landmarks(welded_mesh)
    # each function gives three fields, one for each axis; two functions more than
    # needed, for the rotations that are removed
    n_scalars = min(math.ceil(count / 3) + 2, len(points) - 1)
    width = BANDWIDTH * cell
    density, functions, mass, values = _diffusion_map(points, width, n_scalars)
    # eigenvalues of the Laplacian, to which the kernel converges: 0 for a constant
    # function
    energy = (1.0 - values) / width**2
    combination = _without_rotation(points, functions, mass, energy, count)

    # Nystrom extension from the landmarks to all positions; small eigenvalues are
    # limited, since a division by them amplifies noise
    weights = _compute_landmark_weights(welded_mesh.positions, points, width, density)
    extended = weights @ (functions / np.maximum(values, MIN_EIGENVALUE))
    # p positions, s scalar functions, c axes, k fields
    fields = np.einsum("ps,sck->pck", extended, combination)
    return np.asarray(fields / np.linalg.norm(fields, axis=1).max(axis=0))


def _diffusion_map(
    points: Float64Array, width: float, n_scalars: int
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Compute the diffusion map of points (Coifman and Lafon 2006, alpha = 1).

    Args:
        points: (N, 3) landmarks.
        width: standard deviation of the Gaussian kernel.
        n_scalars: number of functions, without the constant one.

    Returns:
        The kernel density (N,) at the points; the most slowly varying functions (N,
        n_scalars), orthonormal under the mass; the mass (N,) of the points; and the
        eigenvalues (n_scalars,) of the functions, descending.
    """
    kernel = np.exp(-cdist(points, points, "sqeuclidean") / (2.0 * width**2))
    density = kernel.sum(axis=1)
    # alpha = 1 makes the result independent of the density of landmarks
    kernel /= density[:, None] * density[None, :]
    mass = kernel.sum(axis=1)
    symmetric = kernel / np.sqrt(mass[:, None] * mass[None, :])
    # A sparse matrix without negligible entries, for the Lanczos method: dense solvers
    # wait for all threads, which takes ten times as long on a busy machine.
    matrix = sparse.csr_matrix(
        np.where(symmetric > 1e-7 * symmetric.max(), symmetric, 0.0)
    )
    # a fixed start, so that the result does not depend on chance
    first_vector = np.cos(np.arange(len(points)))
    n_lanczos = min(len(points), 4 * (n_scalars + 1))
    values, vectors = sparse_linalg.eigsh(
        matrix, n_scalars + 1, which="LA", v0=first_vector, ncv=n_lanczos
    )
    descending = np.argsort(-values)[1:]  # the function of the first is constant
    functions = _fix_signs(vectors[:, descending]) / np.sqrt(mass)[:, None]
    return density, functions, mass, values[descending]


def _fix_signs(vectors: Float64Array) -> Float64Array:
    """Return columns with the sign that makes their largest entry positive, since
    solvers return either sign.
    """
    largest = vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])]
    return np.asarray(vectors * np.where(largest < 0.0, -1.0, 1.0))


def _sample_landmarks(welded_mesh: WeldedMesh) -> tuple[Float64Array, float]:
    """Return points (N, 3) spread evenly over a surface, and the size of their cells.

    The surface is sampled evenly by area, and its vertices are added. All points in one
    cubic cell are averaged to one landmark. Cells are enlarged until there are at most
    `MAX_LANDMARKS`.
    """
    corners = welded_mesh.positions[welded_mesh.faces]
    areas = np.linalg.norm(compute_area_vectors(corners), axis=1)
    generator = np.random.default_rng(0)
    # The face of each sample, by its area: samples are even steps along the sum of all
    # areas.
    quantiles = (np.arange(N_SURFACE_SAMPLES) + 0.5) / N_SURFACE_SAMPLES
    face = np.searchsorted(np.cumsum(areas) / areas.sum(), quantiles)
    face = face.clip(max=len(areas) - 1)
    barycentric = generator.dirichlet((1.0, 1.0, 1.0), N_SURFACE_SAMPLES)
    samples = np.einsum("nk,nkc->nc", barycentric, corners[face])
    pool = np.concatenate([samples, welded_mesh.positions])
    cell = CELL_SIZE * welded_mesh.extent
    while True:
        cubes = np.floor((pool - pool.min(axis=0)) / cell).astype(np.int64)
        # index of the occupied cell that each point lies in
        cell_index = np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)
        if int(cell_index.max()) + 1 <= MAX_LANDMARKS:
            break
        cell *= 1.15
    n_members = np.bincount(cell_index)
    means = [np.bincount(cell_index, pool[:, axis]) / n_members for axis in range(3)]
    return np.stack(means, axis=1), cell


def _without_rotation(
    points: Float64Array,
    functions: Float64Array,
    mass: Float64Array,
    energy: Float64Array,
    count: int,
) -> Float64Array:
    """Combine scalar functions to vector fields without rotation, smoothest first.

    A field has three components, each a weighted sum of the functions. Only fields
    orthogonal to the three rotations about the center are used, sorted by how fast they
    vary (their energy). Shifts need not be removed, because the constant function is
    not among the functions.

    Args:
        points: (N, 3) landmarks.
        functions: (N, S) scalar functions, orthonormal under `mass`.
        mass: (N,) weight of each point.
        energy: (S,) how fast each function varies.
        count: number of fields.

    Returns:
        (S, 3, count), the weight of each function in each component of a field.
    """
    n_scalars = functions.shape[1]
    center = (points * mass[:, None]).sum(axis=0) / mass.sum()
    # (N, 3) displacements by a small rotation about each axis
    turns = [np.cross(axis, points - center) for axis in np.eye(3)]
    # (3, 3 S) coefficients of the rotations in the functions
    rotations = np.stack(
        [(functions.T @ (mass[:, None] * turn)).reshape(-1) for turn in turns]
    )
    # (3 S, M) basis of the fields without rotation, and their energy in it
    basis = linalg.null_space(rotations)
    basis_energy = basis.T @ (np.repeat(energy, 3)[:, None] * basis)
    _, vectors = linalg.eigh(basis_energy)  # ascending energy
    n_fields = min(count, basis.shape[1])
    combined = _fix_signs(basis @ vectors[:, :n_fields])
    return np.asarray(combined.reshape(n_scalars, 3, -1))


# ---- one push per vertex


class Preconditioner:
    """Spreads pushes over the neighborhood of a welded mesh: `R (I + lambda L)^-2 p`.

    L is the Laplacian of the mesh, and R takes rigid motions out (Nicolet, Jacobson and
    Jakob 2021, "Large steps in inverse rendering of geometry").

    Attributes:
        _factor: factor of the sparse matrix I + lambda L.
        _rigid: (3 P, 6) orthonormal basis of the rigid motions.
    """

    def __init__(self, welded_mesh: WeldedMesh) -> None:
        """Factorise I + lambda L, and compute an orthonormal basis of rigid motions.

        L is the Laplacian of the mesh, and lambda the squared smoothing length.
        """
        positions = welded_mesh.positions
        laplacian, mean_edge_length = _compute_wall_laplacian(welded_mesh)
        # The Laplacian has the mean edge length as its unit.
        smoothing_edges = SMOOTHING_LENGTH * welded_mesh.extent / mean_edge_length
        system = sparse.identity(len(positions)) + smoothing_edges**2 * laplacian
        self._factor = sparse_linalg.splu(system.tocsc())
        # displacement fields (P, 3) by a shift along and a small turn about each axis
        shifts = [np.broadcast_to(axis, positions.shape) for axis in np.eye(3)]
        centered = positions - positions.mean(axis=0)
        turns = [np.cross(axis, centered) for axis in np.eye(3)]
        motions = np.stack([field.reshape(-1) for field in (*shifts, *turns)], axis=1)
        self._rigid = torch.from_numpy(np.asarray(linalg.orth(motions)))

    def __call__(self, pushes: Tensor) -> Tensor:
        """Return displacements (P, 3) for pushes (P, 3), float64; differentiable."""
        solved: Tensor = _Solve.apply(pushes, self._factor)  # type: ignore[no-untyped-call]
        smooth: Tensor = _Solve.apply(solved, self._factor)  # type: ignore[no-untyped-call]
        vector = smooth.reshape(-1)
        rigid = self._rigid.to(vector.device)
        return (vector - rigid @ (rigid.T @ vector)).reshape(smooth.shape)


def _compute_wall_laplacian(welded_mesh: WeldedMesh) -> tuple[Any, float]:
    """Return the Laplacian of a mesh with links through its walls.

    An edge has the weight (mean length / length)^2, a link between both sides of a wall
    the weight `WALL_WEIGHT`, so that both sides move together.

    Returns:
        The sparse Laplacian (P, P), and the mean length of an edge.
    """
    count = len(welded_mesh.positions)
    edges = np.concatenate(
        [
            welded_mesh.faces[:, [0, 1]],
            welded_mesh.faces[:, [1, 2]],
            welded_mesh.faces[:, [2, 0]],
        ]
    )
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    edge_vectors = (
        welded_mesh.positions[edges[:, 0]] - welded_mesh.positions[edges[:, 1]]
    )
    lengths = np.linalg.norm(edge_vectors, axis=1)
    mean_length = float(lengths.mean())
    # 1 for an edge of mean length, at most 100 for very short ones
    edge_weights = (mean_length / lengths.clip(0.1 * mean_length)) ** 2
    wall_weights = np.full(len(welded_mesh.walls), WALL_WEIGHT)
    links = np.concatenate([edges, welded_mesh.walls])
    weights = np.concatenate([edge_weights, wall_weights])
    adjacency = sparse.coo_matrix(
        (weights, (links[:, 0], links[:, 1])), shape=(count, count)
    ).tocsr()
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(axis=1)).reshape(-1)
    return sparse.diags(degree) - adjacency, mean_length


class _Solve(torch.autograd.Function):
    """Solution of a symmetric sparse system.

    Its derivative is the same solution, any number of times.
    """

    @staticmethod
    def forward(ctx: Any, right: Tensor, factor: Any) -> Tensor:
        ctx.factor = factor
        solution = factor.solve(right.detach().cpu().numpy())
        return torch.from_numpy(solution).to(right.device)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor, None]:
        return _Solve.apply(cotangent.contiguous(), ctx.factor), None  # type: ignore[no-untyped-call]


# ---- how far


class DisplacementLimits:
    """Scales displacements by a common factor, so that the mesh stays intact.

        offsets = epsilon s d,    s = (1 + sum_i r_i^p)^(-1/p)

    with r_i the fraction of each bound that epsilon d would use up: of the length of d
    at each position (1), the gradient of the displacement along each face
    (`MAX_FACE_STRAIN`), and the change between the two sides of each wall
    (`MAX_WALL_STRAIN`). As `s max r < 1`, no position moves further than epsilon, no
    face turns over (its tangent map is I + B with ||B|| < 1, and so has a positive
    determinant), and walls and gaps keep more than half their width.

    Attributes:
        epsilon: largest displacement, in the mesh's units.
        _faces: (F, 3) indices of positions, without slivers.
        _inverse_axes: (F, 3) numbers of a face that turn differences along its edges
            into a gradient, see `_compute_squared_gradients`.
        _walls: (W, 2) indices of positions.
        _wall_widths: (W,) distances of the sides.
        _positions: (P, 3) of the mesh.
    """

    def __init__(self, welded_mesh: WeldedMesh, epsilon: float) -> None:
        """Compute from the mesh what each bound needs: edges, heights and wall widths.

        Args:
            welded_mesh: the mesh.
            epsilon: largest length of a displacement, in object sizes.
        """
        self.epsilon = epsilon
        corners = welded_mesh.positions[welded_mesh.faces]
        edge_1 = corners[:, 1] - corners[:, 0]
        edge_2 = corners[:, 2] - corners[:, 0]
        edges = np.stack([edge_1, edge_2, edge_1 - edge_2])
        longest = np.linalg.norm(edges, axis=-1).max(axis=0)
        double_area = np.linalg.norm(np.cross(edge_1, edge_2), axis=1)
        # The strain of a face that is almost a line would be huge, and is not bounded.
        is_sound = double_area > MIN_FACE_HEIGHT * longest**2
        edge_1 = edge_1[is_sound]
        edge_2 = edge_2[is_sound]
        double_area = double_area[is_sound]
        # see `_compute_squared_gradients`
        length = np.linalg.norm(edge_1, axis=1)
        edge_2_along = (edge_1 * edge_2).sum(axis=1) / length
        inverse_height = length / double_area
        self._faces = torch.from_numpy(welded_mesh.faces[is_sound])
        self._inverse_axes = torch.from_numpy(
            np.stack([1.0 / length, edge_2_along / length, inverse_height], axis=1)
        )
        self._walls = torch.from_numpy(welded_mesh.walls)
        wall_vectors = (
            welded_mesh.positions[welded_mesh.walls[:, 0]]
            - welded_mesh.positions[welded_mesh.walls[:, 1]]
        )
        self._wall_widths = torch.from_numpy(np.linalg.norm(wall_vectors, axis=1))
        self._positions = torch.from_numpy(welded_mesh.positions)

    def compute_squared_usage(self, field: Tensor) -> Tensor:
        """Return the squared fraction of each bound that a displacement uses up.

        The displacement is epsilon d. It is bounded by the length epsilon at each
        position, the strain `MAX_FACE_STRAIN` of each face, and the strain
        `MAX_WALL_STRAIN` across each wall. 1 means that a bound is just reached.

        Args:
            field: (P, 3) the field d, without units.

        Returns:
            (N,): positions first, then faces, then walls.
        """
        walls = self._walls.to(field.device)
        wall_widths = self._wall_widths.to(field.device)
        squared_gradient = self._compute_squared_gradients(field)
        face_usage = squared_gradient * (self.epsilon / MAX_FACE_STRAIN) ** 2
        # The derivative of `index_select` is ten times faster than that of indexing.
        difference = field.index_select(0, walls[:, 0]) - field.index_select(
            0, walls[:, 1]
        )
        wall_usage = (
            difference.square().sum(dim=1)
            * (self.epsilon / MAX_WALL_STRAIN / wall_widths).square()
        )
        return torch.cat([field.square().sum(dim=1), face_usage, wall_usage])

    def _compute_squared_gradients(self, field: Tensor) -> Tensor:
        """Return the squared norm (F,) of the gradient of a field (P, 3) on each face.

        The field changes by d1 along edge 1 of the face, and by d2 along edge 2. Edge 2
        is `along` times edge 1 plus a height across it. So the field changes by d1 /
        length per unit along edge 1, and by (d2 - along d1) / height across it.

        Args:
            field: (P, 3) vectors at the positions of the mesh.
        """
        inverse_axes = self._inverse_axes.to(field.device)
        # (F, 1) each: 1 / length, along, and 1 / height
        inverse_length, along, inverse_height = inverse_axes.split(1, dim=1)
        face_corners = self._faces.to(field.device)
        corners = [field.index_select(0, corner) for corner in face_corners.T]
        d1 = corners[1] - corners[0]
        d2 = corners[2] - corners[0]
        along_gradient = d1 * inverse_length
        across_gradient = (d2 - d1 * along) * inverse_height
        squared_norm: Tensor = along_gradient.square() + across_gradient.square()
        return squared_norm.sum(dim=1)

    def limit(self, field: Tensor) -> Tensor:
        """Return offsets (P, 3) within all bounds for a field d (P, 3), float64.

        They are epsilon d / (1 + sum r^p)^(1/p), where r are the fractions of the
        bounds that epsilon d uses up and p is `NORM_EXPONENT`: small fields stay as
        they are, large ones reach the tightest bound, and all is differentiable.
        """
        squared_usage = self.compute_squared_usage(field)
        # The r are divided by the largest one, so that powers do not overflow.
        # `largest` is a square: 1 + sum r^p = largest^(p/2) * total.
        largest = squared_usage.detach().max().clamp_min(1.0)
        powers = (squared_usage / largest).pow(NORM_EXPONENT // 2).sum()
        total = powers + largest ** (-NORM_EXPONENT // 2)
        return self.epsilon * field * (total ** (-1.0 / NORM_EXPONENT) / largest.sqrt())

    def find_thinnest_wall(self, offsets: Tensor) -> float:
        """Return the smallest width of a wall or gap after a displacement (P, 3).

        It is a fraction of the width before.
        """
        if not len(self._walls):
            return 1.0
        wall_ends = (self._positions + offsets.cpu())[self._walls]
        widths = (wall_ends[:, 0] - wall_ends[:, 1]).norm(dim=1)
        return float((widths / self._wall_widths).min())


FORMS = ("modes", "large-steps")
DEFAULT_EPSILON = 0.03
MAX_EPSILON = 0.5
DEFAULT_MODES = 24
MAX_MODES = 200
PUSH_FACTOR = 4.0
"""Factor on the pushes of form large-steps: pushes at their largest over a
neighbourhood pass the bound on the length of d, so that it is reached without every
vertex of the object agreeing.
"""
ESTIMATORS = ("material", "differences")


class GeometryControl(Control):
    """A smooth change of the object's shape, at most so far.

    Attributes:
        form: one of `FORMS`, what the coordinates are.
        _mesh: mesh that is changed.
        _offsets_input: name of the scene input with the offsets of its vertices.
        _index: (V,) position of each vertex, see `WeldedMesh`.
        _limits: limits of the displacement.
        _field: map from coordinates in [-1, 1] to a displacement (P, 3), not limited.
    """

    kind = "geometry"
    targets_mesh = True
    parameters = (
        Parameter(
            "amplitudes",
            (None,),
            "1",
            -1.0,
            1.0,
            0.0,
            "How much of each smooth mode of the shape is added (form modes).",
            moves_silhouettes=True,
            search=(-1.0, 1.0),
            estimators=ESTIMATORS,
        ),
        Parameter(
            "pushes",
            (None, 3),
            "1",
            -1.0,
            1.0,
            0.0,
            "Push on each vertex before it is spread out (form large-steps).",
            moves_silhouettes=True,
            search=(-1.0, 1.0),
            estimators=ESTIMATORS,
        ),
    )
    choices = (
        Choice(
            "epsilon",
            DEFAULT_EPSILON,
            "Largest displacement of a vertex, in object sizes.",
            "epsilon",
            max_value=MAX_EPSILON,
        ),
        Choice(
            "modes",
            DEFAULT_MODES,
            "Number of smooth modes (form modes).",
            integer_bounds=(1, MAX_MODES),
        ),
        Choice(
            "form",
            "modes",
            "What is searched: modes (a few smooth fields) or "
            "large-steps (every vertex).",
        ),
    )

    def check_choices(self) -> None:
        self.form = self.select_form(FORMS)

    def fit(self) -> None:
        """Compute what turns coordinates into a displacement field of the mesh.

        In the form "modes" a coordinate is the amplitude of a smooth field. Otherwise
        it is a push on one position along one axis, which a preconditioner spreads.
        """
        self._offsets_input = f"{self.mesh}.offsets"
        self._mesh = self.get_mesh(self.scene).mesh
        welded_mesh = get_welded_mesh(self._mesh)
        self._index = torch.from_numpy(welded_mesh.position_of_vertex)
        self._limits = DisplacementLimits(welded_mesh, float(self.chosen["epsilon"]))
        if self.form == "modes":
            modes = torch.from_numpy(
                compute_shape_modes(self._mesh, int(self.chosen["modes"]))
            )
            group = Group("amplitudes", modes.shape[2], ESTIMATORS)
            self._field: Callable[[Tensor], Tensor] = lambda amplitudes: (
                modes.to(amplitudes.device) @ amplitudes
            )
        else:
            precondition = Preconditioner(welded_mesh)
            group = Group("pushes", 3 * len(welded_mesh.positions), ESTIMATORS)
            self._field = lambda pushes: (
                PUSH_FACTOR * precondition(pushes.reshape(-1, 3))
            )
        self.groups = (group,)
        self.start = torch.full((group.size,), 0.5)

    def inputs(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        """Return the offset of each vertex, (V, 3)."""
        offsets = self.compute_offsets(u).index_select(0, self._index.to(u.device))
        return {self._offsets_input: offsets.float()}

    def compute_offsets(self, u: Tensor) -> Tensor:
        """Return the displacement of each position, (P, 3) float64."""
        return self._limits.limit(self._field(2.0 * u.double() - 1.0))

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        """Return how far vertices move, and how much the thinnest wall has lost."""
        offsets = self.compute_offsets(u.detach())
        lengths = offsets.norm(dim=1)
        return {
            f"{self.name}.largest": make_value(lengths.max(), "object sizes"),
            f"{self.name}.rms": make_value(
                lengths.square().mean().sqrt(), "object sizes"
            ),
            f"{self.name}.thinnest": make_value(
                self._limits.find_thinnest_wall(offsets), "1"
            ),
        }

    def get_artifact_files(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, bytes]:
        """Return the displaced mesh as an OBJ file."""
        moving = MovingMesh(self._mesh, np.eye(4))
        offsets = self.inputs(u.detach())[self._offsets_input]
        vertices, normals = moving.transform_mesh(None, offsets)
        lines = ["# advsearch: z is up; texture coordinates as of the original object"]
        lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices.tolist()]
        lines += [f"vt {u:.7g} {v:.7g}" for u, v in self._mesh.uvs.tolist()]
        lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in normals.tolist()]
        faces = (self._mesh.faces.astype(np.int64) + 1).tolist()
        lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in faces]
        return {f"{self.name}.obj": ("\n".join(lines) + "\n").encode("ascii")}
