"""What a scene is made of before Mitsuba sees it: meshes, materials, environments, as
plain numpy arrays.

This module imports numpy only, so that the families of bundled objects and the
importers can share it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from advsearch.errors import InputError
from advsearch.options import format_rounded

if TYPE_CHECKING:
    from torch import Tensor

    from advsearch.options import Value
    from advsearch.scene.settings import Parameter

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
# how far texture coordinates of a texture that does not repeat may lie beyond its edges
UV_TOLERANCE = 1e-3


class MeshRig(Protocol):
    """What moves the vertices of a mesh: joints, shapes of a body, clips."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What can be asked for, each a number."""

    @property
    def defaults(self) -> Mapping[str, float]:
        """What the mesh has where nothing is said, by name."""

    @property
    def clips(self) -> tuple[str, ...]:
        """Names of its animations."""

    def offsets(self, values: Mapping[str, Tensor], clip: str | None = None) -> Tensor:
        """Return how far each vertex goes from the mesh's own, (V, 3) in its units.

        Differentiable.
        """

    def get_measurements(
        self, values: Mapping[str, Tensor], clip: str | None = None
    ) -> Mapping[str, Value]:
        """Return what else is worth storing, by name."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with one UV chart set.

    V = 0 is the BOTTOM row of the texture image (the OBJ convention). UVs are in [0,
    1], but for meshes of Mitsuba scenes, whose textures may go on beyond their edges.
    """

    vertices: Float32Array  # (V, 3) positions, z up, in the author's units
    # (F, 3) vertices, counter-clockwise seen from outside
    faces: npt.NDArray[np.uint32]
    normals: Float32Array  # (V, 3) unit shading normals, pointing outwards
    uvs: Float32Array  # (V, 2)
    # further numbers of Mitsuba's meshes, (V, n) or (F, n), by its names, which begin
    # with "vertex_" or "face_"
    attributes: Mapping[str, Float32Array] = field(default_factory=dict)
    # the faces (N,) of each material that its file names, by that name; each face is in
    # one at most
    materials: Mapping[str, IntArray] = field(default_factory=dict)
    # what moves its vertices, for the control `body`; None for what has no joints
    rig: MeshRig | None = None

    @property
    def repeats(self) -> bool:
        """Whether its texture coordinates leave [0, 1], so that a texture repeats."""
        return not (
            self.uvs.min() >= -UV_TOLERANCE and self.uvs.max() <= 1.0 + UV_TOLERANCE
        )

    def __post_init__(self) -> None:
        """Check shapes and values.

        Raises InputError: vertices, normals or UVs have different lengths, or values
        that are not finite; or faces are no triangles of these vertices.
        """
        count = len(self.vertices)
        for name, array, width in (
            ("vertices", self.vertices, 3),
            ("normals", self.normals, 3),
            ("uvs", self.uvs, 2),
        ):
            _check_rows(name, array, (count, width))
        _check_faces(self.faces, count)


def _check_rows(name: str, array: Float32Array, shape: tuple[int, int]) -> None:
    """Raise InputError if an array of a mesh has another shape, or bad values."""
    if array.shape != shape:
        raise InputError(
            f"mesh {name}: expected shape ({shape[0]}, {shape[1]}), got {array.shape}"
        )
    if not np.isfinite(array).all():
        raise InputError(f"mesh {name}: found NaN or infinite values; repair the mesh")


def _check_faces(faces: npt.NDArray[np.uint32], n_vertices: int) -> None:
    """Raise InputError if faces are no triangles of so many vertices."""
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise InputError(
            "mesh faces: expected shape (F, 3) with F > 0, got "
            f"{faces.shape}; export triangles"
        )
    if int(faces.max()) >= n_vertices:
        raise InputError(
            f"mesh faces: index {int(faces.max())} is past the "
            f"last vertex {n_vertices - 1}"
        )


@dataclass(frozen=True)
class Material:
    """Parameters of the principled BSDF other than base colour.

    All in [0, 1] (Burley 2012, Disney principled).
    """

    roughness: float = 0.5
    metallic: float = 0.0
    specular: float = 0.5
    clearcoat: float = 0.0

    def with_values(self, values: Mapping[str, float | None], prefix: str) -> Material:
        """Return the material with some settings over it.

        Their names are `prefix` and the attribute's, such as ``material.roughness``.
        Others, and None, change nothing.
        """
        new_values = {name: values.get(prefix + name) for name in vars(self)}
        replaced = {
            name: value for name, value in new_values.items() if value is not None
        }
        return replace(self, **replaced)


@dataclass(frozen=True)
class FileAxis:
    """An axis of a mesh file that is taken for up, or for the front."""

    axis: str  # up: "y" or "z"; front: one of `FRONT_AXES`
    # why, and what to do if it is wrong; empty where the user said it, or the format
    # which is up
    reason: str = ""


FRONT_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Axes of a mesh file along which the front of what is in it may face."""


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh and what it looks like.

    Pictures have row 0 on top, at v = 1. Opacity and normal map are of the principled
    surface; a normal map is `(n + 1) / 2` of unit normals along tangent (along u),
    normal x tangent and normal.
    """

    name: str  # short, used in paths
    mesh: Mesh
    base_color: Float32Array  # (H, W, 3) display-referred sRGB in [0, 1]
    # the remaining surface parameters
    material: Material = field(default_factory=Material)
    # the class it belongs to in the reference model, or None when unknown
    label: str | None = None
    # Surface in place of the principled surface, Mitsuba's dictionary of one, with
    # `parts.BASE_COLOR` where the texture goes.
    surface: Mapping[str, object] | None = None
    # (H, W) in [0, 1], the share of light that does not pass through; None where it is
    # 1
    opacity: Float32Array | None = None
    normal_map: Float32Array | None = None  # (H, W, 3)
    # (H, W, 3) linear radiance of its faces' front; (1, 1, 3): the same everywhere
    emission: Float32Array | None = None


@dataclass(frozen=True, eq=False)
class ObjectAsset(Shape):
    """The object a model should recognise.

    A None is what is not known, or does not come from a file.
    """

    source: str = ""  # where it came from, for messages and logs
    # what the importer had to repair or leave out, one sentence each
    warnings: tuple[str, ...] = ()
    up: FileAxis | None = None  # the axis of the file that was taken for up
    # the axis of the file that was taken for its front, which is +x here
    front: FileAxis | None = None
    # Finishes of several materials, what each of `mesh.materials` is like beside its
    # base colour; `material` covers the rest.
    finishes: Mapping[str, Material] = field(default_factory=dict)
    # its largest extent, where distances of the camera are in metres (see below)
    size_in_metres: float | None = None
    extent: float | None = None  # its largest extent in the coordinates of its file
    # (4, 4) from the coordinates of its file to those of `mesh`
    file_to_mesh: Float64Array | None = None
    # Drives in a lane it faces as the traffic drives; otherwise it faces those who
    # come, as signs do.
    drives: bool = True

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of how it was read.

        The up axis where that was guessed, and the warnings.
        """
        guessed = (self.up.reason,) if self.up is not None and self.up.reason else ()
        return (*guessed, *self.warnings)


@dataclass(frozen=True, eq=False)
class EnvironmentAsset:
    """A light from everywhere: an equirectangular map.

    Row 0 looks straight up, and columns run as in a photograph (a file's own order).
    Raises InputError: a texel is negative, NaN or infinite.
    """

    name: str  # short, used in paths
    radiance: Float32Array  # (H, W, 3) linear radiance
    source: str = ""  # where it came from
    # what the importer had to repair or leave out, one sentence each
    warnings: tuple[str, ...] = ()
    # it shows the floor of a real place: the ground that things stand on is that by
    # itself
    photographed: bool = False
    # the kind of ground (`settings.GROUND_KINDS`) that belongs to it; None for the
    # usual one
    ground: str | None = None
    # luminance of a radiance of 1, cd/m2; None where its brightness means nothing
    candelas: float | None = None
    # `parts.Place`: what stands around the object, from a file of the user's
    place: Any = None

    def __post_init__(self) -> None:
        """Check the radiance. Raises InputError: a texel is negative, NaN or
        infinite.
        """
        is_bad = ~(np.isfinite(self.radiance) & (self.radiance >= 0.0)).all(axis=2)
        if is_bad.any():
            row, column = np.unravel_index(int(is_bad.argmax()), is_bad.shape)
            bad_texels = (
                f"{int(is_bad.sum())} of {is_bad.size} texels that are negative, NaN "
                "or infinite"
            )
            raise InputError(
                f"environment {self.name!r}: expected finite radiance of at least 0, "
                f"got {bad_texels} (the first in row {row}, column {column}); clamp "
                "them"
            )


ROWS_IN_BLOCK = 4096  # of `multiply_rows`


def compute_area_vectors(corners: Float64Array) -> Float64Array:
    """Return the outward vectors (F, 3) of triangles (F, 3, 3), counter-clockwise.

    They are twice as long as the areas.
    """
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def multiply_rows(rows: Float64Array, matrix: Float64Array) -> Float64Array:
    """Return rows (N, k) times a matrix (k, m), as `rows @ matrix` does.

    Many rows are multiplied in blocks. For a large product numpy's library of linear
    algebra wakes threads, which afterwards wait for more in a loop: that took thirty
    times as much processor time as the product.
    """
    product = np.empty((len(rows), matrix.shape[1]))
    for start in range(0, len(rows), ROWS_IN_BLOCK):
        block = slice(start, start + ROWS_IN_BLOCK)
        np.matmul(rows[block], matrix, out=product[block])
    return product


def compute_lengths(vectors: Float64Array) -> Float64Array:
    """Return the lengths (N, 1) of vectors (N, 3).

    The numbers are those of `numpy.linalg.norm`, which takes four times as long.
    """
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x * x + y * y + z * z)[:, None])


def make_pose(linear: npt.ArrayLike, translation: npt.ArrayLike) -> Float64Array:
    """Return the pose (4, 4) of `v -> linear @ v + translation`.

    The matrix is (3, 3), the translation (3,).
    """
    pose = np.eye(4)
    pose[:3, :3] = linear
    pose[:3, 3] = translation
    return pose


def find_footing(points: Float64Array) -> tuple[Float64Array, float]:
    """Return where points (N, 3) stand, and their extent.

    That is the point (3,) in the middle of their bounding box in x and y and at its
    lowest z; and the largest side of the box.
    """
    lower = points.min(axis=0)
    upper = points.max(axis=0)
    middle_x, middle_y = (lower[:2] + upper[:2]) / 2.0
    extent = float((upper - lower).max())
    return np.array([middle_x, middle_y, lower[2]]), extent


def group_indices(group_of: IntArray) -> list[IntArray]:
    """Return the rising indices (n,) of each group, from 0 to the largest one.

    `group_of` (N,) is the group of each index; a group may be empty.
    """
    return np.split(
        np.argsort(group_of, kind="stable"), np.cumsum(np.bincount(group_of))[:-1]
    )


def normalise_mesh(mesh: Mesh) -> Mesh:
    """Return the mesh with its largest extent 1, standing on z = 0 and centered.

    Raises InputError: all vertices coincide, so there is no size to normalise.
    """
    vertices = mesh.vertices.astype(np.float64)
    origin, size = find_footing(vertices)
    if not size > 0.0:
        raise InputError(
            "mesh has no extent: all its vertices coincide; export the mesh again"
        )
    return replace(mesh, vertices=((vertices - origin) / size).astype(np.float32))


# cells along the mesh's largest extent, tried in turn
SIMPLIFICATION_GRIDS = (384, 256, 192, 128, 96, 64, 48, 32, 24, 16, 12, 8)
# of the texture along each side: vertices of one place in different ones stay apart, as
# at seams
TEXTURE_CELLS = 32


def _merge_clusters(mesh: Mesh, cluster_of: IntArray) -> tuple[IntArray, IntArray]:
    """Merge the vertices of each cluster that are in one cell of the texture.

    The texture is divided into cells so that vertices on both sides of a seam, which
    are far apart in it, stay distinct.

    Args:
        mesh: the full mesh.
        cluster_of: (V,) cluster of each vertex.

    Returns:
        (N,) for each new vertex the index of one of the vertices that it replaces; and
        the faces (F, 3) of new vertices. Faces with two corners in one cluster are left
        out.
    """
    # (V, 2) column and row of the texture's cell in which each vertex is
    texture_cell = np.floor(mesh.uvs.astype(np.float64) * TEXTURE_CELLS).astype(
        np.int64
    )
    cluster_and_cell = _encode_rows(np.column_stack([cluster_of, texture_cell]))
    _, representative, new_vertex = np.unique(
        cluster_and_cell, return_index=True, return_inverse=True
    )
    faces = new_vertex.reshape(-1)[mesh.faces]
    cluster_of_new = cluster_of[representative]
    is_face = _find_distinct_triples(cluster_of_new[faces])
    return representative, faces[is_face]


def _find_distinct_triples(triples: IntArray) -> BoolArray:
    """Return in which rows (F, 3) all three numbers differ."""
    first, second, third = triples.T
    return np.asarray((first != second) & (second != third) & (third != first))


def make_simplifier(mesh: Mesh, max_faces: int) -> Callable[[Mesh], Mesh] | None:
    """Return a function that simplifies a mesh in any of its poses.

    The method is that of Rossignac and Borrel (1993, "Multi-resolution 3D
    approximations for rendering complex scenes"). The cells of a grid divide the
    vertices into clusters, each of which moves to the mean of its vertices. A face is
    left out if two of its corners are in one cluster. At a seam of the texture the
    vertices of both sides stay distinct, but are in one cluster, so that no gap opens.
    The grid is the finest that leaves at most `max_faces` faces.

    Args:
        mesh: the full mesh.
        max_faces: largest number of faces. If even the coarsest grid leaves more, that
            grid is used.

    Returns:
        A function that takes the mesh with other positions of its vertices; None if the
        mesh has at most `max_faces` faces, and need not be simplified.
    """
    if len(mesh.faces) <= max_faces:
        return None
    cluster_of, representative, faces = _cluster_to_limit(mesh, max_faces)
    distinct_faces = np.unique(faces, axis=0).astype(np.uint32)
    simplifier = _Simplifier(
        cluster_of,
        cluster_size=np.bincount(cluster_of),
        cluster_of_new=cluster_of[representative],
        representative=representative,
        faces=distinct_faces,
    )
    return simplifier.simplify


def _cluster_to_limit(
    mesh: Mesh, max_faces: int
) -> tuple[IntArray, IntArray, IntArray]:
    """Cluster a mesh by the finest grid that leaves at most `max_faces` faces.

    If no grid does, it is the coarsest.

    Returns:
        (V,) the cluster of each vertex; (N,) for each new vertex the index of an old
        one that it represents; and the faces (F, 3) of new vertices. The two sides of a
        texture seam have a new vertex each, in one cluster.
    """
    for grid in SIMPLIFICATION_GRIDS:  # from the finest to the coarsest
        cluster_of = _cluster_vertices(mesh, grid)
        representative, faces = _merge_clusters(mesh, cluster_of)
        if len(faces) <= max_faces:
            break
    return cluster_of, representative, faces


@dataclass(frozen=True, eq=False)
class _Simplifier:
    """Simplifies meshes that have the same vertices elsewhere in the same manner."""

    cluster_of: IntArray  # (V,) cluster of each vertex
    cluster_size: IntArray  # number of vertices in each cluster
    cluster_of_new: IntArray  # (N,) cluster of each new vertex
    representative: IntArray  # (N,) for each new vertex an old one of its cluster
    faces: npt.NDArray[np.uint32]  # (F, 3) faces of new vertices

    def simplify(self, full: Mesh) -> Mesh:
        """Return a mesh with the same vertices elsewhere, simplified.

        A new vertex is at the mean of its cluster's vertices, and has the normal and
        the texture coordinates of one of them.
        """
        sums = [
            np.bincount(self.cluster_of, full.vertices[:, axis]) for axis in range(3)
        ]
        cluster_mean = np.stack([total / self.cluster_size for total in sums], axis=1)
        return Mesh(
            cluster_mean[self.cluster_of_new].astype(np.float32),
            self.faces,
            full.normals[self.representative],
            full.uvs[self.representative],
        )


def _cluster_vertices(mesh: Mesh, grid: int) -> IntArray:
    """Return the cluster (V,) of each vertex: the cell of a grid that it is in.

    Args:
        mesh: mesh with V vertices.
        grid: cells along its largest extent.
    """
    lower = mesh.vertices.min(axis=0)
    extent = max(float((mesh.vertices.max(axis=0) - lower).max()), 1e-12)
    # Cells are centered at integers: the lowest point, 0, and the far end of the
    # largest extent, grid - 1, are in the middle of a cell.
    scaled = (mesh.vertices - lower) / extent * (grid - 1)
    cells = np.floor(scaled + 0.5).astype(np.int64)
    _cell_codes, cluster_of = np.unique(_encode_rows(cells), return_inverse=True)
    return np.asarray(cluster_of.reshape(-1))


def _encode_rows(rows: IntArray) -> IntArray:
    """Return one number for each row of whole numbers, the same for equal rows only.

    It is the row read as digits, each column with a base of its own.
    """
    smallest = rows.min(axis=0)
    sizes = rows.max(axis=0) - smallest + 1
    code = np.zeros(len(rows), np.int64)
    for column, size in zip((rows - smallest).T, sizes, strict=True):
        code = code * size + column
    return code


# --------------------------------------------------------------------------------------
# How large things really are: an object's longest side in metres, from what is said of
# it or from its file.
#
# A scene is as large as its object is 1. `ObjectAsset.size_in_metres` is the one number
# that makes metres of it: whatever speaks of metres (distances of the camera, the road,
# what stands beside the object) divides by `SceneDescription.size_in_metres`.

# metres of the units that a mesh may be in
METRES_PER_UNIT = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}
# metres above the floor from which photographed environments are taken, where nobody
# says it
TRIPOD_HEIGHT = 1.6
MIN_METRES = 1e-4  # metres of an object's longest side
MAX_METRES = 1e4
# metres that the longest side of an object of any name usually has
PLAUSIBLE_SIZES = (0.005, 100.0)
USUAL_SIZES = {
    "airplane": (6.0, 75.0),
    "apple": (0.05, 0.12),
    "backpack": (0.3, 0.8),
    "ball": (0.03, 0.4),
    "banana": (0.12, 0.3),
    "bed": (1.6, 2.4),
    "bench": (1.0, 2.5),
    "bicycle": (1.3, 2.0),
    "bike": (1.3, 2.3),
    "boat": (2.0, 40.0),
    "book": (0.12, 0.4),
    "bottle": (0.1, 0.4),
    "bowl": (0.08, 0.4),
    "bus": (6.0, 20.0),
    "car": (2.5, 6.0),
    "cat": (0.25, 0.8),
    "chair": (0.6, 1.4),
    "cow": (1.5, 3.0),
    "cup": (0.05, 0.2),
    "dog": (0.3, 1.4),
    "hammer": (0.15, 0.6),
    "horse": (1.6, 3.0),
    "hydrant": (0.5, 1.2),
    "keyboard": (0.2, 0.5),
    "lamp": (0.2, 2.2),
    "laptop": (0.25, 0.5),
    "man": (1.4, 2.1),
    "motorcycle": (1.6, 2.7),
    "mug": (0.07, 0.2),
    "pan": (0.25, 0.6),
    "person": (0.8, 2.1),
    "phone": (0.1, 0.2),
    "pickup": (4.0, 7.0),
    "sedan": (3.8, 5.5),
    "shoe": (0.15, 0.4),
    "sign": (0.5, 4.0),
    "sofa": (1.3, 3.5),
    "suv": (3.8, 5.6),
    "table": (0.5, 3.0),
    "teapot": (0.12, 0.4),
    "tractor": (2.5, 8.0),
    "train": (15.0, 400.0),
    "truck": (4.5, 20.0),
    "van": (3.8, 7.5),
    "vase": (0.1, 0.9),
    "vehicle": (2.0, 20.0),
    "woman": (1.3, 2.0),
}
"""Metres that the longest side of a thing lies between, by the word for it in the name
of a file: wide, to tell one unit from another.
"""
ROAD_VEHICLES = frozenset(
    "bicycle bike bus car lorry motorcycle pickup sedan suv "
    "tractor truck van vehicle".split()
)
"""Words for what is seen from the height of other road users, in the name or the label
of an object.
"""


def is_road_vehicle(asset: ObjectAsset) -> bool:
    """Tell whether an object is a vehicle of the road whose size is known."""
    words = re.split(r"[^a-z]+", f"{asset.name} {asset.label or ''}".lower())
    return asset.size_in_metres is not None and not ROAD_VEHICLES.isdisjoint(words)


def with_size(asset: ObjectAsset, size: float | None, unit: str | None) -> ObjectAsset:
    """Return an object with the size in metres that the user states, if any.

    Args:
        asset: the object.
        size: its longest side in metres; None if the user does not state it.
        unit: unit of its file, "mm", "cm", "m" or "in"; None likewise.

    Raises:
        InputError: both are given, the size is out of range, or the object comes
            from no file that could have a unit.
    """
    if size is not None and unit is not None:
        raise InputError(
            "size and unit: both say how large the object is; leave one of them out"
        )
    if size is not None:
        longest_side = float(size)
        statement = f"size={size:g}"
    elif unit is not None:
        longest_side = _convert_extent(asset, unit)
        statement = f"unit={unit} for a mesh of {asset.extent:.4g}"
    else:
        return asset
    _check_longest_side(longest_side, statement)
    return replace(asset, size_in_metres=longest_side)


def _check_longest_side(longest_side: float, statement: str) -> None:
    """Raise InputError if a longest side in metres, as a user states it, is no size."""
    if not MIN_METRES <= longest_side <= MAX_METRES:
        raise InputError(
            f"{statement}: expected a longest side of {MIN_METRES:g} to {MAX_METRES:g} "
            f"metres, got {longest_side:.4g}; give it in metres, such as size=4.9"
        )


def _convert_extent(asset: ObjectAsset, unit: str) -> float:
    """Return the longest side of an object, metres, by the unit of its file.

    Raises InputError: there is no such unit, or the object comes from no mesh file.
    """
    if unit not in METRES_PER_UNIT:
        raise InputError(
            f"unit: expected one of {', '.join(METRES_PER_UNIT)}, got {unit!r}"
        )
    if asset.extent is None:
        raise InputError(
            f"unit: {asset.name} is no mesh file; give its longest side "
            "in metres, such as size=0.1"
        )
    return asset.extent * METRES_PER_UNIT[unit]


def describe_size_doubts(
    asset: ObjectAsset, *, has_user_size: bool, needs_metres: bool
) -> tuple[str, ...]:
    """Return a remark where an object's size is unusual for its name, or unknown.

    An unknown size matters if something in the scene is in metres, or if the name and
    the file's extent tell which unit would fit: a "car" of extent 450 is in
    centimetres. A size that the user has given is never doubted.

    Args:
        asset: the object.
        has_user_size: whether the user has given its size.
        needs_metres: whether something in the scene is in metres, such as the road.

    Returns:
        One remark, or none.
    """
    kind = _find_usual_kind(asset.name)
    usual_sizes = PLAUSIBLE_SIZES if kind is None else USUAL_SIZES[kind]
    min_size, max_size = usual_sizes
    size = asset.size_in_metres
    # The file's extent suggests a unit only for a kind of object with a usual size.
    extent = None if kind is None else asset.extent
    is_unusual = size is not None and not min_size <= size <= max_size
    is_missing = size is None and (needs_metres or extent is not None)
    if has_user_size or not (is_unusual or is_missing):
        return ()
    clauses = _list_size_clauses(size, extent, kind, needs_metres)
    remedy = _describe_size_remedy(extent, usual_sizes)
    beginning = "If that is wrong, give" if is_unusual else "Give"
    return (f"{asset.name}: {'; '.join(clauses)}. {beginning} {remedy}",)


def _list_size_clauses(
    size: float | None, extent: float | None, kind: str | None, needs_metres: bool
) -> list[str]:
    """Return clauses about an object's size that is unusual or not known.

    Args:
        size: its longest side in metres; None if it is not known.
        extent: the same in its file's unit; None if that suggests no unit.
        kind: the word in `USUAL_SIZES` for it, if there is one.
        needs_metres: whether something in the scene is in metres.
    """
    clauses = []
    if size is not None:
        clauses.append(f"its longest side is {format_rounded(size)} m")
    else:
        clauses.append("its size in metres is not known")
        if extent:
            clauses.append(f"it is {format_rounded(extent)} in its file")
    if kind is not None:
        min_size, max_size = USUAL_SIZES[kind]
        clauses.append(f"a {kind}'s is {min_size:g} to {max_size:g} m")
    if size is None and needs_metres:
        clauses.append("it is taken for 1 m, as the road is in metres")
    return clauses


def _find_usual_kind(name: str) -> str | None:
    """Return the last word of an object's name that `USUAL_SIZES` has, or None."""
    for word in reversed(re.split(r"[^a-z]+", name.lower())):
        if word in USUAL_SIZES:
            return word
    return None


def _describe_size_remedy(
    extent: float | None, usual_sizes: tuple[float, float]
) -> str:
    """Return the end of a remark: what the user may give to state an object's size.

    Args:
        extent: longest side of the object in the unit of its file, if that is known.
        usual_sizes: smallest and largest size that is usual, metres.
    """
    min_size, max_size = usual_sizes
    example = (min_size * max_size) ** 0.5  # the geometric mean
    remedy = f"its longest side in metres, such as `size={example:.2g}`"
    for unit, metres in METRES_PER_UNIT.items():
        if extent is not None and min_size <= extent * metres <= max_size:
            return (
                f"{remedy}, or `unit={unit}`, which makes it "
                f"{format_rounded(extent * metres)} m"
            )
    return remedy
