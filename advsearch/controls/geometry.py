"""The `geometry` control: a bounded, smooth change of the object's shape.

    modes          d = sum_k a_k m_k,  a = 2 u - 1
    large-steps    d = g R (I + lambda L)^-2 (2 u - 1)
    offsets        epsilon s(d) d

The m_k are the smoothest displacement fields of the mesh. In the form large-steps each
vertex is pushed, and the push is spread over its neighborhood. The factor s keeps the
mesh intact: for any u, no vertex moves by more than epsilon, no face turns over, and the
two sides of a wall do not meet.

A mode varies slowly over space, not over the surface, so that both sides of a wall move
together. Modes are diffusion maps (Coifman and Lafon 2006, "Diffusion maps", sections 2
and 3, alpha = 1) of points spread over the surface, extended to the vertices by the
Nystrom formula, without rigid motions. R (I + lambda L)^-2 is from Nicolet et al. (2021,
"Large Steps in Inverse Rendering of Geometry", section 3.2). Here edges are weighted by
their length, and L has additional links through thin walls.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
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
    make_value_with_unit,
)
from advsearch.scene.assembly import MovingMesh
from advsearch.scene.assets import (
    BoolArray,
    Float64Array,
    IntArray,
    Mesh,
    compute_area_vectors,
)
from advsearch.scene.raster import weld_vertices

CELL_SIZE = 0.035
"""Side of the cubic cells with one landmark each, in extents of the mesh. It is increased
if there are more than `MAX_LANDMARKS`.
"""
MAX_LANDMARKS = 900  # largest number of landmarks
N_SURFACE_SAMPLES = 20000
"""Number of points on the surface that are averaged to landmarks. They are spread evenly,
so that large triangles get more of them.
"""
BANDWIDTH = 1.8  # standard deviation of the kernel, in cells
MIN_EIGENVALUE = 0.05  # lower limit of the eigenvalues in a division; the largest is 1
# largest displacement gradient along a face; below 1 no face can turn over
MAX_FACE_STRAIN = 0.7
# largest change of the distance between the two sides of a wall, as a fraction of it
MAX_WALL_STRAIN = 0.5
# largest distance between the two sides of a wall, in extents
MAX_WALL_DISTANCE = 0.3
# largest cosine between the normals of the two sides of a wall
MAX_OPPOSITE_COSINE = -0.3
MIN_FACE_HEIGHT = 2e-3
"""Faces whose height is less than this fraction of their longest edge are slivers. Their
strain is not limited, since it would be huge for a tiny displacement.
"""
NORM_EXPONENT = 32  # exponent p of the norm that approximates a maximum; even
# distance over which a push on a vertex is spread, in extents (form large-steps)
SMOOTHING_LENGTH = 0.1
WALL_WEIGHT = 4.0  # weight of a link through a wall, in edges of the mesh


class WeldedMesh:
    """A mesh whose seams are welded, so that a displacement can't open them.

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

        Seams are edges at which the mesh has several vertices at the same position, e.g.
        with other texture coordinates: these become one position. Walls are pairs of
        positions on opposite sides of thin parts. Faces without area are left out. The
        normal of a position is the mean of its faces' normals, weighted by their areas.
        """
        self.position_of_vertex, count = weld_vertices(mesh)
        self.positions = np.zeros((count, 3))
        # All vertices of a position have the same coordinates.
        self.positions[self.position_of_vertex] = mesh.vertices
        self.extent = float(np.ptp(self.positions, axis=0).max())
        faces = self.position_of_vertex[mesh.faces]
        area_vectors = compute_area_vectors(self.positions[faces])
        self.faces = faces[np.linalg.norm(area_vectors, axis=1) > 0.0]
        # A face without area adds the zero vector.
        summed = np.zeros((count, 3))
        np.add.at(summed, faces.reshape(-1), np.repeat(area_vectors, 3, axis=0))
        lengths = np.linalg.norm(summed, axis=1, keepdims=True)
        self.normals = summed / np.maximum(lengths, 1e-20)
        self.walls = self._find_walls()

    def _find_walls(self) -> IntArray:
        """Return pairs (W, 2) of positions on opposite sides of a wall or of a gap.

        For a position x with the normal n, the partner is the position y, with the
        normal m, that minimizes |x - y|^2 + b^2 |n + m|^2. Here b is a tenth of the
        mesh's extent; a k-d tree in six dimensions finds it. A pair is a wall if both
        normals are nearly opposite and the distance is not too large, and not 0.
        """
        scaled_normals = 0.1 * self.extent * self.normals  # b n
        # The distance between the points (x, -b n) and (y, b m), squared, is the sum that
        # is minimized. A position may be its own partner; its distance is then 0.
        tree = cKDTree(np.hstack([self.positions, scaled_normals]))
        _, partner = tree.query(np.hstack([self.positions, -scaled_normals]))
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


get_welded_mesh = lru_cache(maxsize=8)(WeldedMesh)  # cached by the mesh


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

    Functions that vary slowly over the surface are computed at some of its points, the
    landmarks, by a diffusion map (Coifman and Lafon 2006, alpha = 1). The fields are
    combinations of these functions, extended from the landmarks to all positions of the
    mesh (Nystrom). The result is cached.

    Args:
        mesh: mesh in object sizes.
        count: number of fields.

    Returns:
        (P, 3, count), for each position of `get_welded_mesh(mesh)`, smoothest first;
        the largest length is 1 in each.
    """
    welded_mesh = get_welded_mesh(mesh)
    landmarks, cell_size = _sample_landmarks(welded_mesh)
    kernel_width = BANDWIDTH * cell_size
    kernel, density = _compute_kernel(landmarks, kernel_width)
    mass = kernel.sum(axis=1)
    # Each function gives three fields, one along each axis, and three fields are removed
    # as rotations. So at least one more function is needed than the fields require.
    n_functions = min(math.ceil(count / 3) + 2, len(landmarks) - 1)
    functions, eigenvalues = _compute_smooth_functions(kernel, mass, n_functions)
    # Approximate eigenvalues of the Laplacian: 0 for a constant function, and larger
    # for functions that vary faster.
    energy = (1.0 - eigenvalues) / kernel_width**2
    # (functions, 3, count)
    combination = _combine_without_rotation(landmarks, functions, mass, energy, count)
    weights = _compute_landmark_weights(
        welded_mesh.positions, landmarks, kernel_width, density
    )
    return _extend_fields(weights, functions, eigenvalues, combination)


def _extend_fields(
    weights: Float64Array,
    functions: Float64Array,
    eigenvalues: Float64Array,
    combination: Float64Array,
) -> Float64Array:
    """Extend fields from landmarks to all positions of a mesh (Nystrom).

    A field becomes a weighted mean, divided by the eigenvalue. Small eigenvalues would
    amplify noise.

    Args:
        weights: (P, N) weights of the landmarks at the positions.
        functions: (N, S) functions at the landmarks.
        eigenvalues: (S,) eigenvalue of each function.
        combination: (S, 3, K) weight of each function in each component of a field.

    Returns:
        (P, 3, K) fields, each with a largest length of 1.
    """
    extended = weights @ (functions / np.maximum(eigenvalues, MIN_EIGENVALUE))
    # p positions, s scalar functions, c axes, k fields
    fields = np.einsum("ps,sck->pck", extended, combination)
    # each field is divided by its largest length
    return np.asarray(fields / np.linalg.norm(fields, axis=1).max(axis=0))


def _compute_kernel(
    points: Float64Array, width: float
) -> tuple[Float64Array, Float64Array]:
    """Compute a Gaussian kernel between points, independent of their density.

    Args:
        points: (N, 3) landmarks.
        width: standard deviation of the Gaussian.

    Returns:
        The kernel (N, N), divided by the densities of both points (alpha = 1); and the
        density (N,) at each point.
    """
    gaussian = np.exp(-cdist(points, points, "sqeuclidean") / (2.0 * width**2))
    density = gaussian.sum(axis=1)
    return gaussian / (density[:, None] * density[None, :]), density


def _compute_smooth_functions(
    kernel: Float64Array, mass: Float64Array, n_functions: int
) -> tuple[Float64Array, Float64Array]:
    """Compute the functions on points that a diffusion by a kernel changes least.

    They are the eigenvectors of `kernel / mass[:, None]` with the largest eigenvalues,
    without the largest one, whose function is constant.

    Args:
        kernel: (N, N) symmetric kernel between the points.
        mass: (N,) sum of each row of the kernel.
        n_functions: number of functions.

    Returns:
        The functions (N, n_functions), orthonormal under the mass, the most slowly
        varying first; and their eigenvalues (n_functions,), descending.
    """
    # A symmetric matrix with the same eigenvalues. Its eigenvectors are those functions
    # times the square root of the mass.
    symmetric = kernel / np.sqrt(mass[:, None] * mass[None, :])
    # The Lanczos method takes a sparse matrix. Dense solvers run in many threads, and
    # take ten times as long on a busy machine.
    matrix = sparse.csr_matrix(_drop_negligible_entries(symmetric))
    # a fixed start, so that the result is deterministic
    first_vector = np.cos(np.arange(len(mass)))
    n_lanczos_vectors = min(len(mass), 4 * (n_functions + 1))
    eigenvalues, vectors = sparse_linalg.eigsh(
        matrix, n_functions + 1, which="LA", v0=first_vector, ncv=n_lanczos_vectors
    )
    # in descending order, without the first one, whose function is constant
    selected = np.argsort(-eigenvalues)[1:]
    functions = _fix_signs(vectors[:, selected]) / np.sqrt(mass)[:, None]
    return functions, eigenvalues[selected]


def _drop_negligible_entries(matrix: Float64Array) -> Float64Array:
    """Return a matrix (N, N) whose entries below 1e-7 of the largest one are 0."""
    return np.asarray(np.where(matrix > 1e-7 * matrix.max(), matrix, 0.0))


def _fix_signs(vectors: Float64Array) -> Float64Array:
    """Return columns with the sign that makes their largest entry positive.

    Solvers return an eigenvector with either sign.
    """
    largest = vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])]
    return np.asarray(vectors * np.where(largest < 0.0, -1.0, 1.0))


def _sample_landmarks(welded_mesh: WeldedMesh) -> tuple[Float64Array, float]:
    """Return points (N, 3) spread evenly over a surface, and the size of their cells.

    The surface is sampled evenly by area, and its vertices are added. Space is divided
    into cubic cells, and all points in one cell are averaged to one landmark. Cells are
    enlarged until there are at most `MAX_LANDMARKS`; their final size is returned.
    """
    samples = _sample_surface(welded_mesh)
    pool = np.concatenate([samples, welded_mesh.positions])
    cell_size = CELL_SIZE * welded_mesh.extent
    while True:
        cell_index = _find_cells(pool, cell_size)
        n_cells = int(cell_index.max()) + 1
        if n_cells <= MAX_LANDMARKS:
            break
        cell_size *= 1.15
    sums = [np.bincount(cell_index, pool[:, axis]) for axis in range(3)]
    return np.stack(sums, axis=1) / np.bincount(cell_index)[:, None], cell_size


def _sample_surface(welded_mesh: WeldedMesh) -> Float64Array:
    """Return `N_SURFACE_SAMPLES` points (N, 3) on a surface, evenly spread by area."""
    corners = welded_mesh.positions[welded_mesh.faces]
    areas = np.linalg.norm(compute_area_vectors(corners), axis=1)
    generator = np.random.default_rng(0)
    # The face of each sample: samples are evenly spaced in the cumulative area.
    quantiles = (np.arange(N_SURFACE_SAMPLES) + 0.5) / N_SURFACE_SAMPLES
    face = np.searchsorted(np.cumsum(areas) / areas.sum(), quantiles)
    face = face.clip(max=len(areas) - 1)  # if the sum is rounded to less than 1
    barycentric = generator.dirichlet((1.0, 1.0, 1.0), N_SURFACE_SAMPLES)
    samples: Float64Array = np.einsum("nk,nkc->nc", barycentric, corners[face])
    return samples


def _find_cells(points: Float64Array, cell_size: float) -> npt.NDArray[np.intp]:
    """Return the index (N,) of the cubic cell, among those with points, of each point."""
    cubes = np.floor((points - points.min(axis=0)) / cell_size).astype(np.int64)
    return np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)


def _combine_without_rotation(
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

    In this function a field is a vector of 3 S coefficients: the weights of function 0
    in the x, y and z component, then those of function 1, and so on.

    Args:
        points: (N, 3) landmarks.
        functions: (N, S) scalar functions, orthonormal under `mass`.
        mass: (N,) weight of each point.
        energy: (S,) how fast each function varies.
        count: number of fields.

    Returns:
        (S, 3, count), the weight of each function in each component of a field.
    """
    n_functions = functions.shape[1]
    rotations = _compute_rotation_coefficients(points, functions, mass)
    # (3 S, M) orthonormal basis of the fields without rotation
    basis = linalg.null_space(rotations)
    # Eigenvectors by ascending energy. The first ones are the smoothest fields.
    _, vectors = linalg.eigh(_compute_basis_energy(basis, energy))
    n_fields = min(count, basis.shape[1])
    fields = _fix_signs(basis @ vectors[:, :n_fields])
    return np.asarray(fields.reshape(n_functions, 3, n_fields))


def _compute_basis_energy(basis: Float64Array, energy: Float64Array) -> Float64Array:
    """Return the energy of fields as a quadratic form (M, M) in a basis of fields.

    The energy of a field is the sum of energy times weight squared over all weights: a
    diagonal quadratic form of the coefficients.

    Args:
        basis: (3 S, M) coefficients of each field of the basis.
        energy: (S,) how fast each function varies.
    """
    energy_of_coefficient = np.repeat(energy, 3)[:, None]
    return np.asarray(basis.T @ (energy_of_coefficient * basis))


def _compute_rotation_coefficients(
    points: Float64Array, functions: Float64Array, mass: Float64Array
) -> Float64Array:
    """Return the coefficients (3, 3 S) of rotations about the three axes.

    They are projections of the rotations of points (N, 3) on functions (N, S), which are
    orthonormal under the mass (N,).
    """
    center = (points * mass[:, None]).sum(axis=0) / mass.sum()
    # (N, 3) displacements by a small rotation about each axis
    turns = [np.cross(axis, points - center) for axis in np.eye(3)]
    return np.stack(
        [(functions.T @ (mass[:, None] * turn)).reshape(-1) for turn in turns]
    )


# ---- one push per vertex


class Preconditioner:
    """Spreads pushes p over the neighborhood on a mesh: `R (I + lambda L)^-2 p`.

    L is the Laplacian of the mesh, and R removes rigid motions (Nicolet, Jacobson and
    Jakob 2021, "Large steps in inverse rendering of geometry").

    Attributes:
        _factor: LU factorization of the sparse matrix I + lambda L.
        _rigid: (3 P, 6) orthonormal basis of the rigid motions.
    """

    def __init__(self, welded_mesh: WeldedMesh) -> None:
        """Factorize I + lambda L, and compute an orthonormal basis of rigid motions.

        L is the Laplacian of the mesh, and lambda the squared smoothing length.
        """
        positions = welded_mesh.positions
        laplacian, mean_edge_length = _compute_wall_laplacian(welded_mesh)
        # The Laplacian is in units of the mean edge length, and so is lambda.
        smoothing_length = SMOOTHING_LENGTH * welded_mesh.extent / mean_edge_length
        system = sparse.identity(len(positions)) + smoothing_length**2 * laplacian
        self._factor = sparse_linalg.splu(system.tocsc())
        # displacement fields (P, 3) by a shift along and a small turn about each axis
        shifts = [np.broadcast_to(axis, positions.shape) for axis in np.eye(3)]
        centered = positions - positions.mean(axis=0)
        turns = [np.cross(axis, centered) for axis in np.eye(3)]
        # (3 P, 6): a column for each motion, in which x, y and z of a position follow
        # each other
        motions = np.stack([field.reshape(-1) for field in (*shifts, *turns)], axis=1)
        self._rigid = torch.from_numpy(np.asarray(linalg.orth(motions)))

    def __call__(self, pushes: Tensor) -> Tensor:
        """Return displacements (P, 3) for pushes (P, 3), float64; differentiable.

        They are smooth, and have no part that is a rigid motion.
        """
        # I + lambda L is inverted twice, as in the formula of the class.
        solved: Tensor = _Solve.apply(pushes, self._factor)  # type: ignore[no-untyped-call]
        smooth: Tensor = _Solve.apply(solved, self._factor)  # type: ignore[no-untyped-call]
        vector = smooth.reshape(-1)
        rigid = self._rigid.to(vector.device)
        rigid_motion = rigid @ (rigid.T @ vector)
        return (vector - rigid_motion).reshape(smooth.shape)


def _compute_wall_laplacian(welded_mesh: WeldedMesh) -> tuple[Any, float]:
    """Return the Laplacian of a mesh with links through its walls.

    An edge has the weight (mean length / length)^2, a link between both sides of a wall
    the weight `WALL_WEIGHT`, so that both sides move together.

    Returns:
        The sparse Laplacian (P, P), and the mean length of an edge.
    """
    edges = _list_edges(welded_mesh.faces)
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
    laplacian = _make_laplacian(links, weights, len(welded_mesh.positions))
    return laplacian, mean_length


def _list_edges(faces: IntArray) -> IntArray:
    """Return the edges (E, 2) of faces (F, 3), each once."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(edges, axis=1), axis=0)


def _make_laplacian(links: IntArray, weights: Float64Array, count: int) -> Any:
    """Return the sparse Laplacian (count, count) of weighted links (L, 2)."""
    adjacency = sparse.coo_matrix(
        (weights, (links[:, 0], links[:, 1])), shape=(count, count)
    ).tocsr()
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(axis=1)).reshape(-1)
    return sparse.diags(degree) - adjacency


class _Solve(torch.autograd.Function):
    """Solution of a symmetric sparse system.

    The derivative is the solution of the same system, so that any number of derivatives
    can be computed.
    """

    @staticmethod
    def forward(ctx: Any, right: Tensor, factor: Any) -> Tensor:
        ctx.factor = factor
        solution = factor.solve(right.detach().cpu().numpy())
        return torch.from_numpy(solution).to(right.device)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor, None]:
        return _Solve.apply(cotangent.contiguous(), ctx.factor), None  # type: ignore[no-untyped-call]


# ---- limits


def _find_slivers(edge_1: Float64Array, edge_2: Float64Array) -> BoolArray:
    """Return which faces (F,) are slivers, from two of their edges (F, 3)."""
    edges = np.stack([edge_1, edge_2, edge_1 - edge_2])
    longest = np.linalg.norm(edges, axis=-1).max(axis=0)
    double_area = np.linalg.norm(np.cross(edge_1, edge_2), axis=1)
    # The height over the longest edge is `double_area / longest`.
    is_limited: BoolArray = double_area > MIN_FACE_HEIGHT * longest**2
    return ~is_limited


def _compute_gradient_factors(
    edge_1: Float64Array, edge_2: Float64Array
) -> Float64Array:
    """Return the factors (F, 3) of `DisplacementLimits`, from two edges (F, 3)."""
    double_area = np.linalg.norm(np.cross(edge_1, edge_2), axis=1)
    length_1 = np.linalg.norm(edge_1, axis=1)
    # Edge 2 is a multiple of edge 1, plus the height over edge 1.
    projection = (edge_1 * edge_2).sum(axis=1) / length_1
    multiple = projection / length_1
    inverse_height = length_1 / double_area
    return np.stack([1.0 / length_1, multiple, inverse_height], axis=1)


def _measure_wall_widths(welded_mesh: WeldedMesh) -> Float64Array:
    """Return the distance (W,) between both sides of each wall of a mesh."""
    first_side = welded_mesh.positions[welded_mesh.walls[:, 0]]
    second_side = welded_mesh.positions[welded_mesh.walls[:, 1]]
    return np.asarray(np.linalg.norm(first_side - second_side, axis=1))


class DisplacementLimits:
    """Scales displacements by a common factor, so that the mesh stays intact.

        offsets = epsilon s d,    s = (1 + sum_i r_i^p)^(-1/p)

    r_i is the fraction of each bound that epsilon d would use. There are bounds of the
    length of d at each position (1), of the gradient of the displacement on each face
    (`MAX_FACE_STRAIN`), and of the change between the two sides of each wall
    (`MAX_WALL_STRAIN`). As `s max r < 1`, no position moves farther than epsilon, no
    face turns over (its tangent map is I + B with ||B|| < 1, and so has a positive
    determinant), and walls and gaps keep more than half their width.

    Attributes:
        epsilon: largest displacement, in the mesh's units.
        _faces: (F, 3) indices of positions, without slivers.
        _gradient_factors: (F, 3) numbers of a face that turn differences along its
            edges into a gradient, see `_compute_squared_gradients`.
        _walls: (W, 2) indices of positions.
        _wall_widths: (W,) distances between both sides.
        _positions: (P, 3) positions of the mesh, for `find_thinnest_wall`.
    """

    def __init__(self, welded_mesh: WeldedMesh, epsilon: float) -> None:
        """Compute the properties of faces and walls that the bounds need.

        Args:
            welded_mesh: the mesh.
            epsilon: largest length of a displacement, in object sizes.
        """
        self.epsilon = epsilon
        corners = welded_mesh.positions[welded_mesh.faces]
        edge_1 = corners[:, 1] - corners[:, 0]
        edge_2 = corners[:, 2] - corners[:, 0]
        is_limited = ~_find_slivers(edge_1, edge_2)
        gradient_factors = _compute_gradient_factors(
            edge_1[is_limited], edge_2[is_limited]
        )
        self._faces = torch.from_numpy(welded_mesh.faces[is_limited])
        self._gradient_factors = torch.from_numpy(gradient_factors)
        self._walls = torch.from_numpy(welded_mesh.walls)
        self._wall_widths = torch.from_numpy(_measure_wall_widths(welded_mesh))
        self._positions = torch.from_numpy(welded_mesh.positions)

    def compute_squared_usage(self, field: Tensor) -> Tensor:
        """Return the squared fraction of each bound that a displacement uses.

        The displacement is epsilon d. It is bounded by the length epsilon at each
        position, the strain `MAX_FACE_STRAIN` of each face, and the strain
        `MAX_WALL_STRAIN` across each wall. 1 means that a bound is just reached.

        Args:
            field: (P, 3) the field d, without units.

        Returns:
            (N,): of positions first, then of faces, then of walls.
        """
        squared_gradient = self._compute_squared_gradients(field)
        face_usage = squared_gradient * (self.epsilon / MAX_FACE_STRAIN) ** 2
        wall_usage = self._compute_squared_wall_usage(field)
        # |epsilon d| / epsilon = |d|
        position_usage = field.square().sum(dim=1)
        return torch.cat([position_usage, face_usage, wall_usage])

    def _compute_squared_wall_usage(self, field: Tensor) -> Tensor:
        """Return the squared fraction (W,) of the strain of each wall that is used.

        The displacement is epsilon times the field (P, 3).
        """
        walls = self._walls.to(field.device)
        wall_widths = self._wall_widths.to(field.device)
        # The derivative of `index_select` is ten times faster than that of indexing.
        first_side = field.index_select(0, walls[:, 0])
        second_side = field.index_select(0, walls[:, 1])
        difference = first_side - second_side
        usage_per_unit = self.epsilon / MAX_WALL_STRAIN / wall_widths
        return difference.square().sum(dim=1) * usage_per_unit.square()

    def _compute_squared_gradients(self, field: Tensor) -> Tensor:
        """Return the squared norm (F,) of the gradient of a field (P, 3) on each face.

        The field changes by d1 along edge 1 of the face, and by d2 along edge 2. Edge 2
        is m times edge 1, plus a vector at right angles to it, whose length is the
        height of the face. So the gradient is d1 / length along edge 1, and
        (d2 - m d1) / height at right angles to it. `_gradient_factors` has 1 / length, m
        and 1 / height of each face.

        Args:
            field: (P, 3) vectors at the positions of the mesh.
        """
        factors = self._gradient_factors.to(field.device)
        # (F, 1) each
        inverse_length, multiple, inverse_height = factors.split(1, dim=1)
        face_corners = self._faces.to(field.device)
        # values of the field at the first, second and third corner of each face
        corners = [field.index_select(0, corner) for corner in face_corners.T]
        d1 = corners[1] - corners[0]
        d2 = corners[2] - corners[0]
        along_gradient = d1 * inverse_length
        across_gradient = (d2 - d1 * multiple) * inverse_height
        squared_norm: Tensor = along_gradient.square() + across_gradient.square()
        return squared_norm.sum(dim=1)

    def limit(self, field: Tensor) -> Tensor:
        """Return offsets (P, 3) within all bounds for a field d (P, 3), float64.

        They are epsilon d / (1 + sum r^p)^(1/p), where r are the fractions of the
        bounds that epsilon d uses and p is `NORM_EXPONENT`. Small fields are hardly
        changed, large ones reach the tightest bound, and the result is differentiable.
        """
        squared_usage = self.compute_squared_usage(field)  # r^2
        # To avoid an overflow, all r are divided by R, the largest of them and 1:
        #     1 + sum r^p = R^p total,    total = R^-p + sum (r / R)^p
        # The result does not depend on R, which is therefore a constant for derivatives.
        squared_max = squared_usage.detach().max().clamp_min(1.0)  # R^2
        half_exponent = NORM_EXPONENT // 2  # r^p is the power p / 2 of r^2
        sum_of_powers = (squared_usage / squared_max).pow(half_exponent).sum()
        total = sum_of_powers + squared_max**-half_exponent
        # (1 + sum r^p)^(-1/p)
        scale = total ** (-1.0 / NORM_EXPONENT) / squared_max.sqrt()
        return self.epsilon * field * scale

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
"""Factor of the pushes in the form large-steps. With it, pushes on a neighborhood are
enough to reach the bound of the displacement; not all vertices have to be pushed.
"""
# gradient estimators of both parameters, the preferred one first
ESTIMATORS = ("material", "differences")


class GeometryControl(Control):
    """A bounded, smooth change of the object's shape.

    Attributes:
        form: one of `FORMS`, the meaning of the coordinates.
        _mesh: mesh that is changed.
        _offsets_input: name of the scene input with the offsets of its vertices.
        _position_of_vertex: (V,) position of each vertex, see `WeldedMesh`.
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
            "Amplitude of each smooth mode of the shape (form modes).",
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
            "Push on each vertex, which is spread over its neighborhood (form "
            "large-steps).",
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

    def bind_parameters(self) -> None:
        """Prepare `self._field`, which maps coordinates to a displacement field.

        In the form "modes" a coordinate is the amplitude of a smooth field. Otherwise
        it is a push on one position along one axis, which a preconditioner spreads.
        """
        self._offsets_input = f"{self.mesh_name}.offsets"
        self._mesh = self.get_mesh(self.scene).mesh
        welded_mesh = get_welded_mesh(self._mesh)
        self._position_of_vertex = torch.from_numpy(welded_mesh.position_of_vertex)
        epsilon = float(self.choice_values["epsilon"])
        self._limits = DisplacementLimits(welded_mesh, epsilon)
        if self.form == "modes":
            group = self._prepare_modes()
        else:
            group = self._prepare_pushes(welded_mesh)
        self.groups = (group,)
        # `compute_offsets` maps 0.5 to no displacement
        self.start = torch.full((group.size,), 0.5)

    def _prepare_modes(self) -> Group:
        """Set the field that is a sum of smooth modes, and return their group."""
        # (P, 3, modes)
        modes = torch.from_numpy(
            compute_shape_modes(self._mesh, int(self.choice_values["modes"]))
        )
        self._field: Callable[[Tensor], Tensor] = lambda amplitudes: (
            modes.to(amplitudes.device) @ amplitudes
        )
        n_modes = modes.shape[2]  # fewer than requested for a small mesh
        return Group("amplitudes", n_modes, ESTIMATORS)

    def _prepare_pushes(self, welded_mesh: WeldedMesh) -> Group:
        """Set the field by pushes on all positions, and return the pushes' group."""
        precondition = Preconditioner(welded_mesh)
        self._field = lambda pushes: PUSH_FACTOR * precondition(pushes.reshape(-1, 3))
        return Group("pushes", 3 * len(welded_mesh.positions), ESTIMATORS)

    def inputs(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        """Return the offset of each vertex, (V, 3)."""
        index = self._position_of_vertex.to(u.device)
        offsets = self.compute_offsets(u).index_select(0, index)
        return {self._offsets_input: offsets.float()}

    def compute_offsets(self, u: Tensor) -> Tensor:
        """Return the displacement of each position, (P, 3) float64."""
        coordinates = 2.0 * u.double() - 1.0  # from [0, 1] to [-1, 1]
        return self._limits.limit(self._field(coordinates))

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        """Return the largest and the root-mean-square offset, and the thinnest wall.

        The latter is the width of the wall as a fraction of its original width.
        """
        offsets = self.compute_offsets(u.detach())
        lengths = offsets.norm(dim=1)
        rms = lengths.square().mean().sqrt()
        thinnest = self._limits.find_thinnest_wall(offsets)
        return {
            f"{self.name}.largest": make_value_with_unit(lengths.max(), "object sizes"),
            f"{self.name}.rms": make_value_with_unit(rms, "object sizes"),
            f"{self.name}.thinnest": make_value_with_unit(thinnest, "1"),
        }

    def get_artifact_files(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, bytes]:
        """Return the displaced mesh as an OBJ file; earlier inputs are not used."""
        in_mesh_coordinates = MovingMesh(self._mesh, np.eye(4))
        offsets = self.inputs(u.detach())[self._offsets_input]
        vertices, normals = in_mesh_coordinates.transform_mesh(
            to_world=None, offsets=offsets
        )
        text = _format_obj(self._mesh, vertices, normals)
        return {f"{self.name}.obj": text.encode("ascii")}


def _format_obj(mesh: Mesh, vertices: Tensor, normals: Tensor) -> str:
    """Return a mesh as the text of an OBJ file, with other vertices and normals (V, 3)."""
    lines = ["# advsearch: z is up; texture coordinates as of the original object"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices.tolist()]
    lines += [f"vt {right:.7g} {upwards:.7g}" for right, upwards in mesh.uvs.tolist()]
    lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in normals.tolist()]
    faces = (mesh.faces.astype(np.int64) + 1).tolist()
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in faces]
    return "\n".join(lines) + "\n"
