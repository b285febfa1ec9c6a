"""Converter of OpenUSD stages to binary glTF, with `usd-core`.

This module runs in a separate process. Layers are checked before they are composed:
they may only refer to layers in or below the folder of the first one. Notes on prims
and inputs that are not converted are in `asset.extras` of the file.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from advsearch.extend import errors, reading, stored_files
from advsearch.scene.importing.usd import PACKAGE_SUFFIX
from advsearch.scene.importing.usd.layers import list_layer_files, unpack_package
from advsearch.scene.importing.usd.surface import (
    FIRST_TIME,
    BoundMaterial,
    GltfMaterialWriter,
    PrimvarUse,
    TextureLayout,
)

# Limit of the different colors, and of the different opacities, of a mesh's faces that
# become materials.
MAX_TINTS = 16
NO_TINT = -1.0  # entry of a tint without a color or an opacity
PARTICLES_PREFIX = "ParticleField"  # prefix of the types of Gaussian splats
PURPOSES = ("default", "render")  # purposes of prims that are converted
Array = npt.NDArray[Any]


class MeshValues(NamedTuple):
    """Values of a mesh, such as its normals.

    Attributes:
        values: (N, width).
        interpolation: USD's word for the elements that have a value each: the mesh
            ("constant"), faces ("uniform"), points ("vertex", "varying") or corners
            ("faceVarying").
    """

    values: Array
    interpolation: str


class MeshFaces(NamedTuple):
    """The faces of a mesh.

    Attributes:
        points: (P, 3) positions.
        corner_counts: (F,) the number of corners of each face.
        point_of_corner: (C,) indices of the points of the corners of all faces.
        triangles: (T, 3) triangles of the faces, as indices into `point_of_corner`.
        face_of_triangle: (T,) the face of each triangle.
    """

    points: Array
    corner_counts: Array
    point_of_corner: Array
    triangles: Array
    face_of_triangle: Array


def main(source: str, target: str, folder: str) -> None:
    """Write a USD file as binary glTF, and print the files that it was read from.

    Args:
        source: the USD file.
        target: the glTF file.
        folder: the folder in which a package is unpacked.

    Raises:
        FileFormatError: the file cannot be converted; the message begins with its name.
    """
    file = Path(source)
    if file.suffix.lower() == PACKAGE_SUFFIX:
        file = unpack_package(file, Path(folder))
    layers = list_layer_files(file)
    stage = Usd.Stage.Open(str(file))
    conversion = Conversion(
        stage,
        folder=file.parent.resolve(),
        source=Path(source).name,
        files_read=layers,  # images are added
    )
    Path(target).write_bytes(conversion.convert())
    # Files of a package are temporary, and the caller knows the package itself.
    is_unpacked = file != Path(source)
    print(json.dumps([] if is_unpacked else conversion.files_read))


# ---- The stage ----


@dataclass
class Conversion:
    """Converts a stage to glTF.

    Attributes that are no fields:
        header: the JSON part of the glTF file.
        lights: entries of its lights.
        unit: unit of the stage in meters; `convert` sets it.
    """

    stage: Any  # the `Usd.Stage`
    folder: Path  # folder of its files
    source: str  # name of the file, for messages
    files_read: list[str]  # files that were read
    # Notes on what is left out, and how often each occurs.
    note_counts: Counter[str] = field(default_factory=Counter)
    buffer: reading.GlbBuffer = field(default_factory=reading.GlbBuffer)
    triangles: int = 0  # number of triangles so far

    def __post_init__(self) -> None:
        """Start an empty document, and find the skeletons of the stage."""
        self.header: dict[str, Any] = {
            name: [] for name in ("nodes", "meshes", "materials", "textures", "images")
        }
        self.header |= {
            "samplers": [],
            "cameras": [],
            "asset": {"version": "2.0", "generator": reading.gltf_entries.GENERATOR},
        }
        self.lights: list[dict[str, Any]] = []
        self._surfaces = GltfMaterialWriter(
            self.folder, self.header, self.buffer, self.note_counts, self.files_read
        )
        self._skins = self._find_skins()

    def _find_skins(self) -> Any:
        """Return the `UsdSkel.Cache` of all skeletons of the stage."""
        skins = UsdSkel.Cache()
        for prim in self._iterate_prims():
            if prim.IsA(UsdSkel.Root):
                skins.Populate(UsdSkel.Root(prim), Usd.TraverseInstanceProxies())
        return skins

    def _iterate_prims(self) -> Iterator[Any]:
        """Yield the prims of the stage, within limits on their number and depth."""
        prims = Usd.PrimRange(self.stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
        for index, prim in enumerate(prims):
            self._check_prim(index, prim)
            yield prim

    def _check_prim(self, index: int, prim: Any) -> None:
        """Raise FileFormatError if a prim is one too many, or too deep in the tree."""
        stored_files.check_most(
            self.source,
            index,
            reading.LARGEST_TREE,
            "USD of at most {} prims",
            "more",
        )
        depth = prim.GetPath().pathElementCount
        stored_files.check_most(
            self.source,
            depth,
            reading.DEEPEST_TREE,
            "prims of at most {} levels",
            "more",
        )

    def convert(self) -> bytes:
        """Return the stage as a binary glTF file.

        Node 0 rotates and scales the stage to glTF's axes and meters. All prims are
        below it.

        Raises:
            FileFormatError: there is no mesh, only Gaussian splats, or a prim cannot be
                converted.
        """
        self.unit = self._read_unit()
        if self.stage.HasAuthoredTimeCodeRange():
            self._note("is animated; its first frame is read")
        header = self.header
        header["nodes"].append(self._make_stage_node())
        self._add_nodes()
        has_splats = any(map(_is_splats, self._iterate_prims()))
        header["scenes"] = [{"nodes": [0]}]
        if has_splats and not header["meshes"]:
            raise self._make_splats_error()
        self._add_lights_and_notes(has_splats)
        # glTF has no empty lists.
        filled_header = {key: value for key, value in header.items() if value}
        return self.buffer.to_bytes(filled_header)

    def _add_lights_and_notes(self, has_splats: bool) -> None:
        """Add the lights, and the notes on what is left out, to the header."""
        if self.lights:
            extensions = {"KHR_lights_punctual": {"lights": self.lights}}
            self.header["extensions"] = extensions
        notes = self._format_notes(has_splats)
        self.header["asset"]["extras"] = {"left_out": notes}

    def _make_splats_error(self) -> errors.FileFormatError:
        """Return the error for a stage that has Gaussian splats and no mesh."""
        return errors.FileFormatError(
            f"{self.source}: expected a mesh with faces, got Gaussian splats: "
            f"{reading.SPLATS_ADVICE}"
        )

    def _add_nodes(self) -> None:
        """Add the prims below the stage's node, and note those that are left out."""
        name_counts = Counter(prim.GetName() for prim in self._iterate_prims())
        node_of_path: dict[Any, int] = {}
        for prim in self._iterate_prims():
            self._note_left_out(prim)
            if prim.IsA(UsdGeom.Imageable) and not prim.IsA(UsdGeom.Subset):
                is_unique = name_counts[prim.GetName()] == 1
                self._add_node(prim, is_unique, node_of_path)
        for node in self.header["nodes"]:
            if not node["children"]:
                del node["children"]

    def _make_stage_node(self) -> dict[str, Any]:
        """Return the node that rotates and scales the stage to glTF's axes and meters."""
        up_rotation = _TO_Y_UP
        if UsdGeom.GetStageUpAxis(self.stage) == "Y":
            up_rotation = np.eye(4)
        matrix = up_rotation @ np.diag([self.unit, self.unit, self.unit, 1.0])
        # glTF stores columns
        return {"name": "stage", "matrix": matrix.T.ravel().tolist(), "children": []}

    def _read_unit(self) -> float:
        """Return the unit of the stage in meters."""
        unit = float(UsdGeom.GetStageMetersPerUnit(self.stage))
        if not 0.0 < unit < math.inf:
            raise errors.FileFormatError(
                f"{self.source}: expected metersPerUnit greater than 0, got {unit}"
            )
        if not UsdGeom.StageHasAuthoredMetersPerUnit(self.stage):
            self._note("does not state its unit; USD's default is centimetres")
        return unit

    def _note_left_out(self, prim: Any) -> None:
        """Note geometry, blend shapes and animation of a prim that are left out."""
        kind = str(prim.GetTypeName())
        is_other_geometry = prim.IsA(UsdGeom.Gprim) and not prim.IsA(UsdGeom.Mesh)
        is_left_out = is_other_geometry or kind == "PointInstancer"
        # Splats have one note for the file, which `_format_notes` adds.
        if is_left_out and not _is_splats(prim):
            self._note(
                f"has a {kind}, which is no mesh: left out; convert it to meshes in "
                "the program that made the file"
            )
        if prim.HasAPI(UsdSkel.BindingAPI):
            blend_shapes = UsdSkel.BindingAPI(prim).GetBlendShapesAttr()
            if blend_shapes.HasAuthoredValue():
                self._note("has a mesh with blend shapes, which are left out")
        if kind == "SkelAnimation":
            self._note("has an animation of a skeleton, which is shown at rest")

    def _add_node(
        self, prim: Any, is_unique: bool, node_of_path: dict[Any, int]
    ) -> None:
        """Add a prim as a node, with its transform and its mesh, camera or light.

        Its parent is the nearest ancestor that is a node, or the stage's node if the
        prim resets its transform, or if a skeleton poses it in the world.

        Args:
            prim: the prim.
            is_unique: whether its name is unique; otherwise the node is named by its
                path.
            node_of_path: nodes of prims so far, by path; the prim is added.
        """
        nodes = self.header["nodes"]
        path = prim.GetPath()
        name = prim.GetName() if is_unique else str(path).lstrip("/")
        node: dict[str, Any] = {"name": name, "children": []}
        xformable = UsdGeom.Xformable(prim)
        if xformable:
            node["matrix"] = self._read_local_matrix(xformable, path)
        parent = _find_parent(path, xformable, node_of_path)
        skeleton_matrix = self._add_content(prim, node)
        if skeleton_matrix is not None:  # a skeleton poses the mesh in the world
            node["matrix"] = skeleton_matrix.ravel().tolist()
            parent = 0
        node_of_path[path] = len(nodes)
        nodes[parent]["children"].append(len(nodes))
        nodes.append(node)

    def _read_local_matrix(self, xformable: Any, path: Any) -> list[float]:
        """Return the transform of a prim as glTF stores it, column by column.

        Raises FileFormatError, which names its path, if numbers are not finite.
        """
        # USD's rows are glTF's columns.
        local_matrix = np.array(xformable.GetLocalTransformation(FIRST_TIME))
        if not np.isfinite(local_matrix).all():
            raise errors.FileFormatError(
                f"{self.source}: expected finite transforms, got others at {path}"
            )
        matrix: list[float] = local_matrix.ravel().tolist()
        return matrix

    def _format_notes(self, has_splats: bool) -> list[str]:
        """Return at most 100 notes on what is left out, whose subject is the file."""
        notes = [
            sentence if count == 1 else f"{sentence} ({count:,} times)"
            for sentence, count in self.note_counts.items()
        ]
        if has_splats:
            notes.insert(
                0,
                f"has Gaussian splats, which are left out: {reading.SPLATS_ADVICE}",
            )
        return notes[:100]

    def _note(self, what: str) -> None:
        """Count a note on something that is left out: a predicate of the file."""
        self.note_counts[what] += 1

    def _add_content(self, prim: Any, node: dict[str, Any]) -> Array | None:
        """Add the mesh, camera or light of a prim to its node.

        A prim that is invisible, or a guide or a proxy, is left out with a note.

        Returns:
            The matrix (4, 4), for rows, of the skeleton that poses a mesh in the world;
            None if none does, or if the prim is no mesh.
        """
        is_mesh = prim.IsA(UsdGeom.Mesh)
        is_camera = prim.IsA(UsdGeom.Camera)
        if not (is_mesh or is_camera or prim.HasAPI(UsdLux.LightAPI)):
            return None
        if not self._is_rendered(prim):
            return None
        if is_mesh:
            return self._add_mesh(prim, node)
        if is_camera:
            self._add_camera(UsdGeom.Camera(prim), node)
        else:
            self._add_light(prim, node)
        return None

    def _is_rendered(self, prim: Any) -> bool:
        """Return whether a prim is visible and no guide or proxy; note it if not."""
        imageable = UsdGeom.Imageable(prim)
        if imageable.ComputeVisibility(FIRST_TIME) == UsdGeom.Tokens.invisible:
            self._note("has invisible prims, which are left out")
            return False
        if imageable.ComputePurpose() not in PURPOSES:
            self._note(
                f"has prims with the purpose {imageable.ComputePurpose()!r}, which are "
                "left out"
            )
            return False
        return True

    # ---- Cameras and lights ----

    def _add_camera(self, camera: Any, node: dict[str, Any]) -> None:
        """Add a camera to a node.

        A camera without perspective becomes an orthographic entry, which the reader of
        glTF leaves out with a note. A shift of the aperture is left out with a note.

        Args:
            camera: USD's camera.
            node: entry of its node, to which the index of the camera is added.
        """
        entry: dict[str, Any] = {"name": node["name"], "type": "orthographic"}
        perspective = _read_perspective(camera)
        if perspective is not None:
            self._note_shift(camera)
            entry |= {"type": "perspective", "perspective": perspective}
        node["camera"] = len(self.header["cameras"])
        self.header["cameras"].append(entry)

    def _note_shift(self, camera: Any) -> None:
        """Note a shift of a camera's aperture."""
        if _get_first(camera, "HorizontalApertureOffset") or _get_first(
            camera, "VerticalApertureOffset"
        ):
            self._note("has a camera whose aperture is shifted; the shift is left out")

    def _add_light(self, prim: Any, node: dict[str, Any]) -> None:
        """Add a distant or a spherical light to a node; others are noted.

        USD states radiance. glTF states candela, or lux for a distant light, so the
        radiance is integrated over the light's surface or its cone.

        Args:
            prim: prim of the light.
            node: entry of its node, to which the index of the light is added.
        """
        light = UsdLux.LightAPI(prim)
        stops = _get_first(light, "Exposure")  # each doubles the radiance
        radiance = _get_first(light, "Intensity") * 2.0**stops
        color = _read_light_color(light)
        converted = self._convert_light(prim, radiance)
        if converted is None:
            return
        entry, intensity = converted
        self._check_power(node["name"], np.array([*color, intensity]))
        node["extensions"] = {"KHR_lights_punctual": {"light": len(self.lights)}}
        entry |= {"name": node["name"], "color": color.tolist(), "intensity": intensity}
        self.lights.append(entry)

    def _check_power(self, name: str, powers: Array) -> None:
        """Raise FileFormatError if the color or the intensity of a light is invalid.

        `powers` are the numbers of both, (N,).
        """
        if not _is_valid_power(powers):
            raise errors.FileFormatError(
                f"{self.source}: expected the light {name} to have a power of "
                "at least 0"
            )

    def _convert_light(
        self, prim: Any, radiance: float
    ) -> tuple[dict[str, Any], float] | None:
        """Return the entry of a light without name and color, and its intensity.

        Lights that are neither distant nor spherical are noted, and return None.
        """
        kind = prim.GetTypeName()
        if kind == "DistantLight":
            return {"type": "directional"}, _compute_illuminance(prim, radiance)
        if kind == "SphereLight":
            entry = _make_point_light(prim)
            # The area of the disk is in squared units of the stage, and becomes m^2.
            intensity = _integrate_over_sphere(prim, radiance) * self.unit**2
            self._note("has a SphereLight, which is a point light at its center here")
            return entry, intensity
        self._note(
            f"has a {kind}, which is left out; light the scene with `environment` "
            "or `controls=light`"
        )
        return None

    # ---- Meshes ----

    def _add_mesh(self, prim: Any, node: dict[str, Any]) -> Array | None:
        """Add a mesh to a node: one primitive for each material and tint.

        Args:
            prim: prim of the mesh.
            node: entry of its node, to which the index of the mesh is added.

        Returns:
            The matrix (4, 4), for rows, of the skeleton that poses the mesh in the
            world; None if none does.
        """
        mesh = UsdGeom.Mesh(prim)
        points = _to_array(_get_first(mesh, "Points"), np.float64, 3)
        counts = _to_array(_get_first(mesh, "FaceVertexCounts"), np.int64)
        corners = _to_array(_get_first(mesh, "FaceVertexIndices"), np.int64)
        if not len(points) or not len(counts):
            return None
        self._check_corners(prim, len(points), counts, corners)
        skeleton_matrix, points = self._pose_at_rest(prim, points)
        triangles, face = self._triangulate(mesh, points, counts, corners)
        mesh_faces = MeshFaces(points, counts, corners, triangles, face)
        primitives = self._make_primitives(prim, mesh, mesh_faces)
        if primitives:
            node["mesh"] = len(self.header["meshes"])
            entry = {"name": node["name"], "primitives": primitives}
            self.header["meshes"].append(entry)
        return skeleton_matrix

    def _make_primitives(
        self, prim: Any, mesh: Any, mesh_faces: MeshFaces
    ) -> list[dict[str, Any]]:
        """Return one glTF primitive for each material and tint of a mesh.

        A tint is a color and opacity of faces from primvars, which are values of the
        mesh.

        Args:
            prim: prim of the mesh.
            mesh: the same as USD's mesh.
            mesh_faces: its points and faces.
        """
        triangle_points = mesh_faces.point_of_corner[mesh_faces.triangles]
        normals = self._read_normals(
            mesh, UsdGeom.PrimvarsAPI(prim), mesh_faces.points, triangle_points
        )
        primitives = list[dict[str, Any]]()
        n_faces = len(mesh_faces.corner_counts)
        for bound, faces in self._iterate_materials(prim, mesh, n_faces):
            primitives += self._make_material_primitives(
                prim, bound, faces, normals, mesh_faces
            )
        return primitives

    def _make_material_primitives(
        self,
        prim: Any,
        bound: BoundMaterial,
        faces: Array,
        normals: MeshValues | None,
        mesh_faces: MeshFaces,
    ) -> list[dict[str, Any]]:
        """Return one glTF primitive for each tint of the faces with a material.

        Args:
            prim: prim of the mesh.
            bound: the material.
            faces: (F,) the faces.
            normals: normals of the mesh, or None.
            mesh_faces: all points and faces of the mesh.
        """
        path = str(prim.GetPath())
        primvars = UsdGeom.PrimvarsAPI(prim)
        primitives = []
        tints = self._split_by_tint(bound, primvars, faces, mesh_faces)
        for material, colors, tinted_faces in tints:
            is_selected = np.isin(mesh_faces.face_of_triangle, tinted_faces)
            if not is_selected.any():
                continue  # all are holes, or have fewer than 3 corners
            uvs_by_name = self._read_layouts(primvars, bound.layouts)
            attributes = {"NORMAL": normals, "COLOR_0": colors, **uvs_by_name}
            entry = self._make_primitive(path, mesh_faces, is_selected, attributes)
            primitives.append({**entry, "material": material})
        return primitives

    def _check_corners(
        self, prim: Any, n_points: int, counts: Array, corners: Array
    ) -> None:
        """Raise FileFormatError if faces refer to points that do not exist.

        Args:
            prim: prim of the mesh, for messages.
            n_points: number of points of the mesh.
            counts: (F,) number of corners of each face.
            corners: (C,) the points of the corners of all faces.
        """
        if (
            (counts < 0).any()
            or counts.sum() != len(corners)
            or corners.min() < 0
            or corners.max() >= n_points
        ):
            raise errors.FileFormatError(
                f"{self.source}: expected faces of the points of {prim.GetPath()}, got "
                "others; export it again"
            )

    def _triangulate(
        self, mesh: Any, points: Array, counts: Array, corners: Array
    ) -> tuple[Array, Array]:
        """Return the triangles (T, 3) of a mesh, as rows of `corners`, and their faces.

        Faces that the mesh lists as holes are left out. In a left-handed mesh the
        corners are reversed, since glTF's faces are counter-clockwise.

        Args:
            mesh: USD's mesh.
            points: (P, 3) its points.
            counts: (F,) number of corners of each face.
            corners: (C,) the points of the corners of all faces.
        """
        self.triangles += int(np.maximum(counts - 2, 0).sum())
        reading.check_faces(self.source, self.triangles, "more")
        triangles, face, _ = reading.triangulate(points[corners], counts)
        holes = _to_array(_get_first(mesh, "HoleIndices"), np.int64)
        is_solid = ~np.isin(face, holes)
        triangles = triangles[is_solid]
        if _get_first(mesh, "Orientation") == UsdGeom.Tokens.leftHanded:
            triangles = triangles[:, ::-1]
        return triangles, face[is_solid]

    def _read_normals(
        self, mesh: Any, primvars: Any, points: Array, triangles: Array
    ) -> MeshValues | None:
        """Return the normals (N, 3) of a mesh and their interpolation, or None.

        The primvar "normals" is preferred to the attribute. A mesh with a subdivision
        scheme is not subdivided here; it gets smooth normals instead, with a note.

        Args:
            mesh: USD's mesh.
            primvars: its primvars.
            points: (P, 3) its points.
            triangles: (T, 3) points of its triangles.
        """
        normals = _read_mesh_normals(mesh, primvars)
        if _get_first(mesh, "SubdivisionScheme") != UsdGeom.Tokens.none:
            self._note(
                "has a mesh with a subdivision scheme, which is not subdivided, but "
                "shaded smooth"
            )
            normals = MeshValues(_compute_smooth_normals(points, triangles), "vertex")
        return normals

    def _make_primitive(
        self,
        path: str,
        mesh_faces: MeshFaces,
        is_selected: Array,
        attributes: dict[str, MeshValues | None],
    ) -> dict[str, Any]:
        """Return a primitive as an entry of the header; its data goes to the buffer.

        USD has values for points, corners or faces, but glTF only for vertices. So
        corners with the same point and the same value of every attribute become one
        vertex.

        Args:
            path: path of the prim, for messages.
            mesh_faces: the faces of the mesh.
            is_selected: (T,) which triangles the primitive has, one at least.
            attributes: attributes by the names of glTF; None if the mesh lacks one.

        Raises:
            FileFormatError: an attribute has fewer values than the mesh needs.
        """
        # For each corner a row with the index of its point, and the index of its value
        # in each attribute.
        corner_indices = self._index_values(path, mesh_faces, is_selected, attributes)
        vertex_indices, vertex_of_corner = np.unique(
            corner_indices, axis=0, return_inverse=True
        )
        accessors = self._add_vertices(mesh_faces.points, vertex_indices, attributes)
        indices = vertex_of_corner.reshape(-1).astype(np.uint32)
        index_accessor = self.buffer.add_accessor(indices, "SCALAR")
        triangles_mode = 4  # of glTF
        return {
            "attributes": accessors,
            "mode": triangles_mode,
            "indices": index_accessor,
        }

    def _add_vertices(
        self,
        points: Array,
        vertex_indices: Array,
        attributes: dict[str, MeshValues | None],
    ) -> dict[str, int]:
        """Add the attributes of vertices to the buffer, and return their accessors.

        Args:
            points: (P, 3) points of the mesh.
            vertex_indices: (V, columns) for each vertex the index of its point, and of
                its value in each attribute, also of missing ones.
            attributes: attributes by the names of glTF; None if the mesh lacks one.
        """
        positions = points[vertex_indices[:, 0]].astype(np.float32)
        accessors = {
            "POSITION": self.buffer.add_accessor(positions, "VEC3", bounds=True)
        }
        for column, (name, attribute) in enumerate(attributes.items(), start=1):
            if attribute is not None:
                value_index = vertex_indices[:, column]
                values = attribute.values[value_index].astype(np.float32)
                accessor_type = f"VEC{values.shape[1]}"
                accessors[name] = self.buffer.add_accessor(values, accessor_type)
        return accessors

    def _index_values(
        self,
        path: str,
        mesh_faces: MeshFaces,
        is_selected: Array,
        attributes: dict[str, MeshValues | None],
    ) -> Array:
        """Return the indices of the values of selected triangles' corners.

        The result is (3 T, columns), where T is the number of selected triangles. The
        first column is the index of the point. Then each attribute has a column with
        the index of its value. The index is 0 if the attribute is constant, or missing.

        Args:
            path: path of the prim, for messages.
            mesh_faces: the faces of the mesh.
            is_selected: (T,) which triangles are selected.
            attributes: attributes by the names of glTF; None if the mesh lacks one.

        Raises:
            FileFormatError: an attribute has fewer values than the mesh needs.
        """
        index_by_interpolation = _index_corners(mesh_faces, is_selected)
        corner_points = index_by_interpolation["vertex"]
        constant_index = np.zeros(len(corner_points), np.int64)
        columns = [corner_points]
        for attribute in attributes.values():
            index = constant_index
            if attribute is not None:
                kind = attribute.interpolation
                index = index_by_interpolation.get(kind, constant_index)
                self._check_value_count(path, attribute, index)
            columns.append(index)
        return np.stack(columns, axis=1)

    def _check_value_count(
        self, path: str, attribute: MeshValues, index: Array
    ) -> None:
        """Raise FileFormatError if an attribute of a prim has too few values.

        Args:
            path: path of the prim.
            attribute: the attribute.
            index: indices of the values that are used.
        """
        if index.max() >= len(attribute.values):
            raise errors.FileFormatError(
                f"{self.source}: expected as many values "
                f"as corners on {path}, got fewer"
            )

    def _read_uvs(self, primvars: Any, layout: TextureLayout) -> MeshValues | None:
        """Return texture coordinates (N, 2) as glTF has them, v down, or None.

        The material's transform of texture coordinates is applied. If the mesh lacks
        the primvar, the layout's fallback is used everywhere. Without a fallback the
        result is None.

        Args:
            primvars: primvars of the mesh.
            layout: the primvar, its transform and its fallback.
        """
        values = None
        if layout.primvar:
            values = _flatten_primvar(
                primvars.FindPrimvarWithInheritance(layout.primvar), 2
            )
        if values is None:
            values = self._make_fallback_uvs(layout)
        if values is None:
            return None
        transformed = layout.transform(values.values)
        uvs = np.stack([transformed[:, 0], 1.0 - transformed[:, 1]], axis=1)
        return MeshValues(uvs, values.interpolation)

    def _make_fallback_uvs(self, layout: TextureLayout) -> MeshValues | None:
        """Return the fallback of a layout, whose primvar a mesh lacks, or None.

        That the mesh lacks a primvar is noted.
        """
        if layout.fallback is None:
            return None
        if layout.primvar:
            name = layout.primvar[:50]
            self._note(
                f"has a mesh without the primvar {name!r} of a texture, which has "
                "the color of one texel"
            )
        return MeshValues(np.array([layout.fallback]), "constant")

    def _read_layouts(
        self, primvars: Any, layouts: Iterable[TextureLayout]
    ) -> dict[str, MeshValues | None]:
        """Return the texture coordinates of layouts by glTF's names: "TEXCOORD_0"."""
        return {
            f"TEXCOORD_{index}": self._read_uvs(primvars, layout)
            for index, layout in enumerate(layouts)
        }

    def _split_by_tint(
        self,
        bound: BoundMaterial,
        primvars: Any,
        faces: Array,
        mesh_faces: MeshFaces,
    ) -> Iterator[tuple[int, MeshValues | None, Array]]:
        """Split faces with a material by their colors and opacities.

        A material may take both from primvars, which are values of the mesh. If faces
        have at most `MAX_TINTS` different colors, each color becomes a glTF material.
        If there are more, or if colors change within a face, they become vertex colors.
        Opacities always become materials, since our reader ignores the opacity of
        glTF's vertex colors.

        Args:
            bound: the material.
            primvars: primvars of the mesh.
            faces: (F,) faces with the material.
            mesh_faces: all faces of the mesh.

        Yields:
            Index of a glTF material, vertex colors or None, and faces.
        """
        if bound.color is None and bound.opacity is None:
            yield bound.material_index, None, faces
            return
        if bound.is_default:
            self._note_default_material(primvars)
        colors = _read_primvar(primvars, bound.color)
        opacities = _read_primvar(primvars, bound.opacity)
        yield from self._make_tints(bound, colors, opacities, faces, mesh_faces)

    def _make_tints(
        self,
        bound: BoundMaterial,
        colors: MeshValues | None,
        opacities: MeshValues | None,
        faces: Array,
        mesh_faces: MeshFaces,
    ) -> Iterator[tuple[int, MeshValues | None, Array]]:
        """Make a copy of a material for each tint of faces; see `_split_by_tint`.

        Args:
            bound: the material.
            colors: colors of the mesh that replace that of the material, or None.
            opacities: opacities of the mesh that replace that of the material, or None.
            faces: (F,) faces with the material.
            mesh_faces: all faces of the mesh.

        Yields:
            Index of a glTF material, vertex colors or None, and faces.
        """
        face_colors = _find_face_colors(colors, faces, mesh_faces)
        vertex_colors = colors if face_colors is None else None
        face_tints = self._compute_face_tints(face_colors, opacities, faces, mesh_faces)
        for tint in np.unique(face_tints, axis=0):
            material = self._surfaces.make_tinted(
                bound,
                color=_select_tint_color(tint, colors, vertex_colors),
                opacity=None if opacities is None else tint[3],
            )
            has_tint = (face_tints == tint).all(axis=1)
            yield material, vertex_colors, faces[has_tint]

    def _compute_face_tints(
        self,
        face_colors: Array | None,
        opacities: MeshValues | None,
        faces: Array,
        mesh_faces: MeshFaces,
    ) -> Array:
        """Return the color and opacity (F, 4) of faces; `NO_TINT` where there is none.

        Args:
            face_colors: (F, 3) colors of the faces, or None.
            opacities: opacities of the primvar, or None.
            faces: (F,) the faces.
            mesh_faces: all faces of the mesh.
        """
        face_opacities = self._compute_face_opacities(opacities, faces, mesh_faces)
        if face_colors is None:
            face_colors = np.full((len(faces), 3), NO_TINT)
        return np.concatenate([face_colors, face_opacities], axis=1)

    def _note_default_material(self, primvars: Any) -> None:
        """Note that a mesh has no material, and the color that it has instead."""
        has_color = primvars.FindPrimvarWithInheritance("displayColor").HasValue()
        lacking = "material" if has_color else "material and displayColor"
        color_text = "its displayColor" if has_color else "grey (0.18)"
        self._note(
            f"has a mesh without {lacking}: it has USD's default material, {color_text} "
            "with roughness 0.5 and no metal"
        )

    def _compute_face_opacities(
        self, opacities: MeshValues | None, faces: Array, mesh_faces: MeshFaces
    ) -> Array:
        """Return the opacity of each face, (F, 1); `NO_TINT` if there is no primvar.

        Opacities are rounded to 1/255, so that few are different. If there are more
        than `MAX_TINTS`, they are replaced by their mean, with a note.

        Args:
            opacities: opacities of the primvar, or None.
            faces: (F,) the faces.
            mesh_faces: all faces of the mesh.
        """
        if opacities is None:
            return np.full((len(faces), 1), NO_TINT)
        face_values = _compute_face_values(opacities, faces, mesh_faces)
        opacity = np.round(face_values.clip(0.0, 1.0) * 255.0) / 255.0
        # "uniform" values are those of faces.
        is_of_vertices = opacities.interpolation not in ("constant", "uniform")
        if is_of_vertices and len(np.unique(opacities.values)) > 1:
            self._note("has an opacity of vertices; faces have its mean")
        return self._limit_opacities(opacity)

    def _limit_opacities(self, opacity: Array) -> Array:
        """Return opacities (F, 1), or their mean, with a note, if too many are different."""
        if len(np.unique(opacity)) <= MAX_TINTS:
            return opacity
        self._note(
            f"has more than {MAX_TINTS} opacities of faces, which are replaced by "
            "their mean"
        )
        return np.full_like(opacity, opacity.mean())

    def _iterate_materials(
        self, prim: Any, mesh: Any, faces: int
    ) -> Iterator[tuple[BoundMaterial, Array]]:
        """Yield the materials of a mesh and their faces.

        A face has the material of the first subset that contains it, or else the
        material of the mesh.

        Args:
            prim: prim of the mesh.
            mesh: the same as USD's mesh.
            faces: number of faces of the mesh.

        Yields:
            A material, and the indices of its faces.
        """
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        is_unbound = np.ones(faces, bool)
        for subset in subsets:
            selected = np.unique(_to_array(_get_first(subset, "Indices"), np.int64))
            # without indices that do not exist, and faces of earlier subsets
            selected = selected[(selected >= 0) & (selected < faces)]
            selected = selected[is_unbound[selected]]
            is_unbound[selected] = False
            yield self._surfaces.find_material(subset.GetPrim()), selected
        if is_unbound.any():
            yield self._surfaces.find_material(prim), np.flatnonzero(is_unbound)

    def _pose_at_rest(self, prim: Any, points: Array) -> tuple[Array | None, Array]:
        """Pose the points of a mesh by its skeleton at rest.

        Returns:
            The matrix (4, 4) from the skeleton to the world, for row vectors, and the
            points (P, 3) in the skeleton's coordinates. If the mesh has no skeleton
            that can be posed: None, and the points as they are.
        """
        skinning = self._skins.GetSkinningQuery(prim)
        if not skinning or not skinning.HasJointInfluences():
            return None, points
        skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
        skeleton_query = self._skins.GetSkelQuery(skeleton) if skeleton else None
        if not skeleton_query:
            return None, points
        skinned = _skin_points(skinning, skeleton_query, points)
        if skinned is None:
            return None, points
        xformable = UsdGeom.Xformable(skeleton.GetPrim())
        to_world = xformable.ComputeLocalToWorldTransform(FIRST_TIME)
        return np.array(to_world), skinned


def _index_corners(mesh_faces: MeshFaces, is_selected: Array) -> dict[str, Array]:
    """Return the indices (3 T,) of values at selected triangles' corners.

    They are by the interpolation of the values, for those that are not constant.

    Args:
        mesh_faces: the faces of the mesh.
        is_selected: which of its triangles are selected.
    """
    corner_rows = mesh_faces.triangles[is_selected].reshape(-1)
    corner_points = mesh_faces.point_of_corner[corner_rows]
    return {
        "vertex": corner_points,
        "varying": corner_points,
        "faceVarying": corner_rows,
        "uniform": mesh_faces.face_of_triangle[is_selected].repeat(3),
    }


def _read_mesh_normals(mesh: Any, primvars: Any) -> MeshValues | None:
    """Return the normals (N, 3) that a mesh states, as a primvar or an attribute, or None."""
    normals = _flatten_primvar(primvars.GetPrimvar("normals"), 3)
    if normals is not None:
        return normals
    values = _to_array(_get_first(mesh, "Normals"), np.float64, 3)
    if not len(values):
        return None
    return MeshValues(values, str(mesh.GetNormalsInterpolation()))


def _find_parent(path: Any, xformable: Any, node_of_path: dict[Any, int]) -> int:
    """Return the node of the nearest ancestor of a path, or 0, the stage's node.

    It is 0 also if the prim resets its transform.
    """
    if xformable and xformable.GetResetXformStack():
        return 0
    ancestors = path.GetAncestorsRange()
    return next((node_of_path[at] for at in ancestors if at in node_of_path), 0)


def _read_perspective(camera: Any) -> dict[str, float] | None:
    """Return the perspective of a camera as glTF's entry; None for another projection."""
    # lengths in the same unit
    width = _get_first(camera, "HorizontalAperture")
    height = _get_first(camera, "VerticalAperture")
    focal_length = _get_first(camera, "FocalLength")
    is_perspective = _get_first(camera, "Projection") == UsdGeom.Tokens.perspective
    if not is_perspective or not min(width, height, focal_length) > 0.0:
        return None
    return {
        "yfov": 2.0 * math.atan(height / (2.0 * focal_length)),
        "aspectRatio": width / height,
        "znear": 0.01,
    }


def _skin_points(skinning: Any, skeleton_query: Any, points: Array) -> Array | None:
    """Return points (P, 3) moved by the joints of a skin at rest.

    The result is None if the skeleton lacks transforms, or if USD cannot move them.

    Args:
        skinning: query of the skin.
        skeleton_query: query of the skeleton.
        points: the points.
    """
    transforms = _compute_joint_transforms(skinning, skeleton_query)
    if transforms is None:
        return None
    skinned = Vt.Vec3fArray([Gf.Vec3f(*map(float, point)) for point in points])
    matrices = Vt.Matrix4dArray(transforms)
    if not skinning.ComputeSkinnedPoints(matrices, skinned, FIRST_TIME):
        return None
    return _to_array(skinned, np.float64, 3)


def _compute_joint_transforms(skinning: Any, skeleton_query: Any) -> list[Any] | None:
    """Return the matrix by which each joint of a skin moves points at rest, or None.

    It is None if the skeleton lacks transforms. A joint moves points by the inverse of
    its bind transform, followed by its rest transform. USD's matrices multiply row
    vectors, so the first one is on the left.

    Args:
        skinning: query of the skin, which may have another order of joints.
        skeleton_query: query of the skeleton.
    """
    rest_transforms = skeleton_query.ComputeJointSkelTransforms(FIRST_TIME, atRest=True)
    bind_transforms = skeleton_query.GetJointWorldBindTransforms()
    if not rest_transforms or len(rest_transforms) != len(bind_transforms):
        return None
    transforms = [
        bind.GetInverse() * joint
        for bind, joint in zip(bind_transforms, rest_transforms, strict=True)
    ]
    mapper = skinning.GetJointMapper()
    if mapper and not mapper.IsNull() and not mapper.IsIdentity():
        transforms = mapper.RemapTransforms(type(rest_transforms)(transforms))
    return list(transforms)


def _is_splats(prim: Any) -> bool:
    """Return whether a prim has Gaussian splats."""
    return str(prim.GetTypeName()).startswith(PARTICLES_PREFIX)


def _find_face_colors(
    colors: MeshValues | None, faces: Array, mesh_faces: MeshFaces
) -> Array | None:
    """Return the color of each face, (F, 3), if they can become materials.

    The result is None if there are no colors, if they may change within a face, or if
    more than `MAX_TINTS` are different.

    Args:
        colors: colors of the primvar, or None.
        faces: (F,) the faces.
        mesh_faces: all faces of the mesh.
    """
    if colors is None or colors.interpolation not in ("constant", "uniform"):
        return None
    face_colors = _compute_face_values(colors, faces, mesh_faces)
    if len(np.unique(face_colors, axis=0)) > MAX_TINTS:
        return None
    return face_colors


def _select_tint_color(
    tint: Array, colors: MeshValues | None, vertex_colors: MeshValues | None
) -> list[float] | None:
    """Return the color (3,) that replaces that of a material; None if none does.

    Args:
        tint: (4,) color and opacity of the material's copy for some faces.
        colors: colors of the mesh's primvar, or None. Then the material keeps its own.
        vertex_colors: the same colors, if they become vertex colors; otherwise None.
    """
    if colors is None:
        return None
    if vertex_colors is not None:
        # The renderer multiplies vertex colors by that of the material: it is white.
        return [1.0, 1.0, 1.0]
    return list(map(float, tint[:3]))


def _is_valid_power(powers: Array) -> bool:
    """Return whether all powers (N,) are finite and at least 0."""
    return bool((np.isfinite(powers) & (powers >= 0.0)).all())


def _read_light_color(light: Any) -> Array:
    """Return the linear color (3,) of a light: its color times that of its temperature."""
    color = np.array(_get_first(light, "Color"), np.float64)
    if _get_first(light, "EnableColorTemperature"):
        temperature = _get_first(light, "ColorTemperature")
        color *= np.array(UsdLux.BlackbodyTemperatureAsRgb(temperature))
    return color


def _make_point_light(prim: Any) -> dict[str, Any]:
    """Return the entry of a point light, or of a spot light if the prim has a cone.

    Light fades from the inner to the outer angle. The softness is the distance of these
    as a fraction of the outer angle.
    """
    if not prim.HasAPI(UsdLux.ShapingAPI):
        return {"type": "point"}
    shaping = UsdLux.ShapingAPI(prim)
    cone = _get_first(shaping, "ShapingConeAngle")
    if cone is None or cone >= 90.0:  # glTF has no wider cones
        return {"type": "point"}
    softness = _get_first(shaping, "ShapingConeSoftness") or 0.0
    outer = math.radians(max(cone, 0.1))
    inner = outer * (1.0 - min(softness, 1.0))
    return {"type": "spot", "spot": {"outerConeAngle": outer, "innerConeAngle": inner}}


def _compute_face_values(
    primvar: MeshValues, faces: Array, mesh_faces: MeshFaces
) -> Array:
    """Return the values (F, C) of faces.

    Values of points or corners are averaged over the face. If a corrupt mesh has too
    few values, the last one is repeated.

    Args:
        primvar: values (N, C) of the mesh.
        faces: (F,) faces.
        mesh_faces: all faces of the mesh.
    """
    values = primvar.values
    last_index = len(values) - 1
    if primvar.interpolation == "constant":
        return np.asarray(values[np.zeros(len(faces), np.int64)])
    if primvar.interpolation == "uniform":
        return np.asarray(values[np.minimum(faces, last_index)])
    corner_index = np.arange(len(mesh_faces.point_of_corner))
    if primvar.interpolation in ("vertex", "varying"):
        corner_index = mesh_faces.point_of_corner
    corner_values = values[np.minimum(corner_index, last_index)]
    means = _average_corners(corner_values, mesh_faces.corner_counts)
    return np.asarray(means[faces])


def _average_corners(values: Array, counts: Array) -> Array:
    """Return the mean (F, C) of values (corners, C) over the corners of each face.

    Faces without corners get a wrong value, but have no triangles.

    Args:
        values: values of the corners of all faces, one face after the other.
        counts: (F,) number of corners of each face.
    """
    # `reduceat` sums the rows from the start of a face to that of the next one. A row
    # of zeros is appended, since faces without corners at the end begin after the last
    # row.
    padded_values = np.concatenate([values, np.zeros((1, values.shape[1]))])
    starts = np.cumsum(counts) - counts
    sums = np.add.reduceat(padded_values, starts)
    means: Array = sums / np.maximum(counts, 1)[:, None]
    return means


def _compute_illuminance(prim: Any, radiance: float) -> float:
    """Return the lux of a distant light on a surface that faces it.

    Its radiance is integrated over the cone of directions that it covers: L pi sin^2 of
    the half angle. The value that a "normalized" light of USD states is not a radiance,
    but its illuminance already. So is that of a light without an angle.
    """
    angle = _get_first(UsdLux.DistantLight(prim), "Angle")
    half_angle = math.radians(angle) / 2.0
    is_normalized = _get_first(UsdLux.LightAPI(prim), "Normalize")
    if is_normalized or not half_angle > 0.0:  # also for NaN
        return radiance
    return radiance * (math.pi * math.sin(half_angle) ** 2)


def _integrate_over_sphere(prim: Any, radiance: float) -> float:
    """Return the radiance of a spherical light times the area of its visible disk.

    The area is pi r^2. A "normalized" light of USD has a power that does not depend on
    its size: its radiance is divided by the area of the sphere, 4 pi r^2.
    """
    is_normalized = _get_first(UsdLux.LightAPI(prim), "Normalize")
    if is_normalized:
        return radiance * 0.25  # pi r^2 / (4 pi r^2)
    radius: float = _get_first(UsdLux.SphereLight(prim), "Radius")
    return radiance * (math.pi * radius**2)


# Rotation from a stage with z up to glTF, where y is up.
_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])


def _get_first(schema: Any, name: str) -> Any:
    """Return the first value in time of an attribute."""
    return getattr(schema, f"Get{name}Attr")().Get(FIRST_TIME)


def _flatten_primvar(primvar: Any, width: int) -> MeshValues | None:
    """Return the values (N, width) of a primvar, or None if it has none."""
    if not primvar or not primvar.HasValue():
        return None
    values = _to_array(primvar.ComputeFlattened(FIRST_TIME), np.float64, width)
    return MeshValues(values, str(primvar.GetInterpolation()))


def _read_primvar(primvars: Any, use: PrimvarUse | None) -> MeshValues | None:
    """Return the values (N, C) of a primvar that a surface uses, or its fallback.

    The result is None if the surface uses no primvar.
    """
    if use is None:
        return None
    values = None
    if use.name:
        primvar = primvars.FindPrimvarWithInheritance(use.name)
        values = _flatten_primvar(primvar, len(use.fallback))
    if values is None or not len(values.values):
        return MeshValues(np.array([use.fallback]), "constant")
    return MeshValues(np.nan_to_num(values.values), values.interpolation)


def _to_array(values: Any, kind: Any, width: int = 0) -> Array:
    """Return values as an array (N,), or (N, width); empty for None."""
    array = np.asarray([] if values is None else values, dtype=kind)
    return array.reshape(-1, width) if width else array


def _compute_smooth_normals(points: Array, faces: Array) -> Array:
    """Return normals (P, 3) of points: the area-weighted mean of their triangles'."""
    vectors = reading.compute_area_vectors(points[faces])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], vectors)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(
        lengths > 0.0, normals / np.maximum(lengths, 1e-30), [0.0, 0.0, 1.0]
    )


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except errors.FileFormatError as error:
        sys.exit(f"refused: {error}")
