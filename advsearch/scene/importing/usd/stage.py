"""OpenUSD stages as binary glTF, by `usd-core`, in a process of its own that runs this
module (`blender.converted`).

Layers are looked at before anything is composed of them: all that they name has to be a
layer in the folder of the first one or below. What glTF as we read it has no place for
is named in `asset.extras` of the file.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from advsearch.extend import errors, reading, stored_files
from advsearch.scene.importing.usd import PACKAGE
from advsearch.scene.importing.usd.layers import check_layers, unpacked
from advsearch.scene.importing.usd.surface import (
    FIRST,
    BoundMaterial,
    Layout,
    PrimvarUse,
    UsdSurfaces,
)

# colours and opacities of faces that are materials of their own; of more, colours are
# of vertices
MOST_TINTS = 16
PARTICLES = "ParticleField"  # how the types of Gaussian splats and their like begin
PURPOSES = ("default", "render")
Array = npt.NDArray[Any]


def main(source: str, target: str, folder: str) -> None:
    """Write a file as binary glTF, and print the files that it was read from; a package
    is unpacked into a folder first. Raises FileFormatError, which tells the file by its
    name.
    """
    file = Path(source)
    if file.suffix.lower() == PACKAGE:
        file = unpacked(file, Path(folder))
    layers = check_layers(file)
    stage = Usd.Stage.Open(str(file))
    made = Conversion(stage, file.parent.resolve(), Path(source).name, layers)
    Path(target).write_bytes(made.glb())
    print(json.dumps(made.read if file == Path(source) else []))


# ---- the stage
# ------------------------------------------------------------------------------------------------------


@dataclass
class Conversion:
    """Makes glTF of a stage, whose files lie in a folder; `source` is what messages
    call it.
    """

    stage: Any
    folder: Path
    source: str
    read: list[str]
    left: Counter[str] = field(default_factory=Counter)
    buffer: reading.GlbBuffer = field(default_factory=reading.GlbBuffer)
    triangles: int = 0

    def __post_init__(self) -> None:
        self.header: dict[str, Any] = {
            name: [] for name in ("nodes", "meshes", "materials", "textures", "images")
        }
        self.header |= {
            "samplers": [],
            "cameras": [],
            "asset": {"version": "2.0", "generator": reading.gltf_entries.GENERATOR},
        }
        self.lights: list[dict[str, Any]] = []
        self._surfaces = UsdSurfaces(
            self.folder, self.header, self.buffer, self.left, self.read
        )
        self._skins = UsdSkel.Cache()
        for prim in self._prims():
            if prim.IsA(UsdSkel.Root):
                self._skins.Populate(UsdSkel.Root(prim), Usd.TraverseInstanceProxies())

    def _prims(self) -> Iterator[Any]:
        for number, prim in enumerate(
            Usd.PrimRange(self.stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
        ):
            stored_files.check_most(
                self.source,
                number,
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
            yield prim

    def glb(self) -> bytes:
        unit = UsdGeom.GetStageMetersPerUnit(self.stage)
        if not 0.0 < unit < math.inf:
            raise errors.FileFormatError(
                f"{self.source}: expected metersPerUnit greater than 0, got {unit}"
            )
        if not UsdGeom.StageHasAuthoredMetersPerUnit(self.stage):
            self._leave("does not say its unit, which USD takes for centimetres")
        if self.stage.HasAuthoredTimeCodeRange():
            self._leave("is animated; what is there first is read")
        self.unit = unit
        upright = np.eye(4) if UsdGeom.GetStageUpAxis(self.stage) == "Y" else _TO_Y_UP
        matrix = upright @ np.diag([unit, unit, unit, 1.0])
        nodes = self.header["nodes"]
        header = self.header
        nodes.append(
            {"name": "stage", "matrix": matrix.T.ravel().tolist(), "children": []}
        )
        names = Counter(prim.GetName() for prim in self._prims())
        places: dict[Any, int] = {}
        has_splats = False
        for prim in self._prims():
            kind = str(prim.GetTypeName())
            if kind.startswith(PARTICLES):
                has_splats = True
            elif (
                prim.IsA(UsdGeom.Gprim) and not prim.IsA(UsdGeom.Mesh)
            ) or kind == "PointInstancer":
                self._leave(
                    f"has a {kind}, which is no mesh: left out; make meshes of "
                    "it where the file is from"
                )
            if (
                prim.HasAPI(UsdSkel.BindingAPI)
                and UsdSkel.BindingAPI(prim).GetBlendShapesAttr().HasAuthoredValue()
            ):
                self._leave("has a mesh with blend shapes, which are left out")
            if kind == "SkelAnimation":
                self._leave("has an animation of a skeleton, which is shown at rest")
            if not prim.IsA(UsdGeom.Imageable) or prim.IsA(UsdGeom.Subset):
                continue
            name = (
                prim.GetName()
                if names[prim.GetName()] == 1
                else str(prim.GetPath()).lstrip("/")
            )
            node: dict[str, Any] = {"name": name, "children": []}
            parent = 0
            moves = UsdGeom.Xformable(prim)
            if moves:
                # rows, as glTF's columns
                local = np.array(moves.GetLocalTransformation(FIRST))
                if not np.isfinite(local).all():
                    raise errors.FileFormatError(
                        f"{self.source}: expected finite transforms, got others at "
                        f"{prim.GetPath()}"
                    )
                node["matrix"] = local.ravel().tolist()
            if not (moves and moves.GetResetXformStack()):
                parent = next(
                    (
                        places[at]
                        for at in prim.GetPath().GetAncestorsRange()
                        if at in places
                    ),
                    0,
                )
            self._fill(prim, node)
            if "moved" in node:
                node["matrix"], parent = node.pop("moved"), 0
            places[prim.GetPath()] = len(nodes)
            nodes[parent]["children"].append(len(nodes))
            nodes.append(node)
        for node in nodes:
            if not node["children"]:
                del node["children"]
        header["scenes"], header["scene"] = [{"nodes": [0]}], 0
        if has_splats and not header["meshes"]:
            what = (
                "expected a mesh with faces, got Gaussian splats, a model that "
                f"{reading.SPLATS}"
            )
            raise errors.FileFormatError(f"{self.source}: {what}")
        if self.lights:
            header["extensions"] = {"KHR_lights_punctual": {"lights": self.lights}}
        notes = [
            what if count == 1 else f"{what} ({count:,} times)"
            for what, count in self.left.items()
        ]
        if has_splats:
            notes.insert(
                0,
                "has Gaussian splats, which are left out: a model that "
                f"{reading.SPLATS}",
            )
        header["asset"]["extras"] = {"left_out": notes[:100]}
        return self.buffer.file(
            {key: value for key, value in header.items() if value or key == "asset"}
        )

    def _leave(self, what: str) -> None:
        self.left[what] += 1

    def _fill(self, prim: Any, node: dict[str, Any]) -> None:
        imageable = UsdGeom.Imageable(prim)
        if not (
            prim.IsA(UsdGeom.Mesh)
            or prim.IsA(UsdGeom.Camera)
            or prim.HasAPI(UsdLux.LightAPI)
        ):
            return
        if imageable.ComputeVisibility(FIRST) == UsdGeom.Tokens.invisible:
            self._leave("has something invisible, which is left out")
        elif imageable.ComputePurpose() not in PURPOSES:
            self._leave(
                "has something for the purpose "
                f"{imageable.ComputePurpose()!r}, which is left out"
            )
        elif prim.IsA(UsdGeom.Mesh):
            self._mesh(prim, node)
        elif prim.IsA(UsdGeom.Camera):
            self._camera(UsdGeom.Camera(prim), node)
        else:
            self._light(prim, node)

    # ---- cameras and lights
    # ------------------------------------------------------------------------------------------

    def _camera(self, camera: Any, node: dict[str, Any]) -> None:
        wide, high, focal = (
            _first(camera, name)
            for name in ("HorizontalAperture", "VerticalAperture", "FocalLength")
        )
        entry: dict[str, Any] = {"name": node["name"], "type": "orthographic"}
        if (
            _first(camera, "Projection") == UsdGeom.Tokens.perspective
            and min(wide, high, focal) > 0.0
        ):
            if _first(camera, "HorizontalApertureOffset") or _first(
                camera, "VerticalApertureOffset"
            ):
                self._leave(
                    "has a camera whose aperture is shifted; the shift is left out"
                )
            view = {
                "yfov": 2.0 * math.atan(high / (2.0 * focal)),
                "aspectRatio": wide / high,
                "znear": 0.01,
            }
            entry |= {"type": "perspective", "perspective": view}
        node["camera"] = len(self.header["cameras"])
        self.header["cameras"].append(entry)

    def _light(self, prim: Any, node: dict[str, Any]) -> None:
        light = UsdLux.LightAPI(prim)
        kind = prim.GetTypeName()
        power = _first(light, "Intensity") * 2.0 ** _first(light, "Exposure")
        normalised = _first(light, "Normalize")
        color = np.array(_first(light, "Color"), np.float64)
        if _first(light, "EnableColorTemperature"):
            color *= np.array(
                UsdLux.BlackbodyTemperatureAsRgb(_first(light, "ColorTemperature"))
            )
        if kind == "DistantLight":
            half = math.radians(_first(UsdLux.DistantLight(prim), "Angle")) / 2.0
            entry: dict[str, Any] = {"type": "directional"}
            power *= 1.0 if normalised or half <= 0.0 else math.pi * math.sin(half) ** 2
        elif kind == "SphereLight":
            # radiance times the disk that is seen; normalised, what is emitted is
            # divided by the area of the sphere
            power *= (
                0.25
                if normalised
                else math.pi * _first(UsdLux.SphereLight(prim), "Radius") ** 2
            )
            power *= self.unit**2
            entry = {"type": "point"}
            shaping = UsdLux.ShapingAPI(prim)
            cone = (
                _first(shaping, "ShapingConeAngle")
                if prim.HasAPI(UsdLux.ShapingAPI)
                else 90.0
            )
            if cone is not None and cone < 90.0:
                soft = _first(shaping, "ShapingConeSoftness") or 0.0
                outer = math.radians(max(cone, 0.1))
                cone_angles = {
                    "outerConeAngle": outer,
                    "innerConeAngle": outer * (1.0 - min(soft, 1.0)),
                }
                entry = {"type": "spot", "spot": cone_angles}
            self._leave("has a SphereLight, which shines from its middle here")
        else:
            self._leave(
                f"has a {kind}, which is left out; `environment` and "
                "`controls=light` light a scene"
            )
            return
        if not (
            math.isfinite(power)
            and power >= 0.0
            and np.isfinite(color).all()
            and (color >= 0.0).all()
        ):
            raise errors.FileFormatError(
                f"{self.source}: expected the light {node['name']} to have a power of "
                "at least 0"
            )
        node["extensions"] = {"KHR_lights_punctual": {"light": len(self.lights)}}
        self.lights.append(
            {**entry, "name": node["name"], "color": color.tolist(), "intensity": power}
        )

    # ---- meshes
    # ------------------------------------------------------------------------------------------------------

    def _mesh(self, prim: Any, node: dict[str, Any]) -> None:
        mesh = UsdGeom.Mesh(prim)
        path = str(prim.GetPath())
        points = _array(_first(mesh, "Points"), np.float64, 3)
        counts, corners, holes = (
            _array(_first(mesh, name), np.int64)
            for name in ("FaceVertexCounts", "FaceVertexIndices", "HoleIndices")
        )
        if not len(points) or not len(counts):
            return
        if (
            (counts < 0).any()
            or counts.sum() != len(corners)
            or corners.min() < 0
            or corners.max() >= len(points)
        ):
            raise errors.FileFormatError(
                f"{self.source}: expected faces of the points of {path}, got others; "
                "export it again"
            )
        moved, points = self._at_rest(prim, points)
        if moved is not None:
            node["moved"] = moved.ravel().tolist()
        self.triangles += int(np.maximum(counts - 2, 0).sum())
        reading.check_faces(self.source, self.triangles, "more")
        picked, face, _ = reading.triangulated(points[corners], counts)
        keep = ~np.isin(face, holes)
        picked = picked[keep]
        face = face[keep]
        if _first(mesh, "Orientation") == UsdGeom.Tokens.leftHanded:
            picked = picked[:, ::-1]
        primvars = UsdGeom.PrimvarsAPI(prim)
        normals = _flattened(primvars.GetPrimvar("normals"), 3)
        if normals is None and len(
            own := _array(_first(mesh, "Normals"), np.float64, 3)
        ):
            normals = own, str(mesh.GetNormalsInterpolation())
        if _first(mesh, "SubdivisionScheme") != UsdGeom.Tokens.none:
            self._leave(
                "has a mesh that is to be subdivided, which is shown as it is, "
                "and smooth"
            )
            normals = _smooth(points, corners[picked]), "vertex"
        primitives = []
        for bound, faces in self._groups(prim, mesh, len(counts)):
            for material, colors, tinted in self._tinted(
                bound, primvars, faces, counts, corners
            ):
                mine = np.isin(face, tinted)
                at = picked[mine].reshape(-1)
                if not len(at):
                    continue
                held: dict[str, tuple[Array, str] | None] = {
                    "NORMAL": normals,
                    "COLOR_0": colors,
                }
                for number, layout in enumerate(bound.layouts):
                    held[f"TEXCOORD_{number}"] = self._uvs(primvars, layout)
                entry = self._primitive(path, points, corners, at, face[mine], held)
                primitives.append({**entry, "material": material})
        if primitives:
            node["mesh"] = len(self.header["meshes"])
            self.header["meshes"].append(
                {"name": node["name"], "primitives": primitives}
            )

    def _primitive(
        self,
        path: str,
        points: Array,
        corners: Array,
        at: Array,
        face: Array,
        held: dict[str, tuple[Array, str] | None],
    ) -> dict[str, Any]:
        """Return a primitive of some corners, `at`, of faces, with the values that it
        has by what each belongs to.
        """
        by = {
            "vertex": corners[at],
            "varying": corners[at],
            "faceVarying": at,
            "uniform": face.repeat(3),
        }
        index = [corners[at]]
        none = np.zeros(len(at), np.int64)
        for values, per in (given or (None, "") for given in held.values()):
            index.append(none if values is None else by.get(per, none))
            if values is not None and index[-1].max() >= len(values):
                raise errors.FileFormatError(
                    f"{self.source}: expected as many values "
                    f"as corners on {path}, got fewer"
                )
        rows, inverse = np.unique(np.stack(index, axis=1), axis=0, return_inverse=True)
        attributes = {
            "POSITION": self.buffer.accessor(
                points[rows[:, 0]].astype(np.float32), "VEC3", bounds=True
            )
        }
        for column, (name, given) in enumerate(held.items(), 1):
            if given is not None:
                values = given[0][rows[:, column]].astype(np.float32)
                attributes[name] = self.buffer.accessor(values, f"VEC{values.shape[1]}")
        indices = self.buffer.accessor(inverse.reshape(-1).astype(np.uint32), "SCALAR")
        return {"attributes": attributes, "mode": 4, "indices": indices}

    def _uvs(self, primvars: Any, layout: Layout) -> tuple[Array, str] | None:
        """Return texture coordinates as glTF has them, v down, with the transform that
        the material asks for.
        """
        values = None
        if layout.primvar:
            values = _flattened(primvars.FindPrimvarWithInheritance(layout.primvar), 2)
        if values is None:
            if layout.fallback is None:
                return None
            if layout.primvar:
                name = layout.primvar[:50]
                self._leave(
                    f"has a mesh without the primvar {name!r} of a texture, of "
                    "which one texel is shown"
                )
            values = np.array([layout.fallback]), "constant"
        moved = layout.moved(values[0])
        return np.stack([moved[:, 0], 1.0 - moved[:, 1]], axis=1), values[1]

    def _tinted(
        self,
        bound: BoundMaterial,
        primvars: Any,
        faces: Array,
        counts: Array,
        corners: Array,
    ) -> Iterator[tuple[int, tuple[Array, str] | None, Array]]:
        """Yield materials, vertex colours and faces: by the primvars that a surface
        takes colour and opacity from.
        """
        if bound.color is None and bound.opacity is None:
            yield bound.number, None, faces
            return
        if bound.is_default:
            has_color = primvars.FindPrimvarWithInheritance("displayColor").HasValue()
            color_words = (
                ": of its displayColor"
                if has_color
                else " and displayColor: grey (0.18)"
            )
            self._leave(
                f"has a mesh without material{color_words}, with roughness 0.5 "
                "and no metal, as USD's default"
            )
        colors, shares = (
            _primvar_values(primvars, use) for use in (bound.color, bound.opacity)
        )
        start = np.cumsum(counts) - counts

        def per_face(given: tuple[Array, str]) -> Array:
            """The values (F, C) of faces; of those of corners, the means."""
            values, per = given
            if per in ("constant", "uniform"):
                index = faces if per == "uniform" else np.zeros(len(faces), np.int64)
                return values[np.minimum(index, len(values) - 1)]
            at = corners if per in ("vertex", "varying") else np.arange(len(corners))
            all_values = values[np.minimum(at, len(values) - 1)]
            sums = np.add.reduceat(
                np.concatenate([all_values, np.zeros((1, values.shape[1]))]), start
            )
            return np.asarray((sums / np.maximum(counts, 1)[:, None])[faces])

        opacity = np.full((len(faces), 1), np.nan)  # as the material has it
        if shares is not None:
            opacity = np.round(per_face(shares).clip(0.0, 1.0) * 255.0) / 255.0
            if (
                shares[1] not in ("constant", "uniform")
                and len(np.unique(shares[0])) > 1
            ):
                self._leave("has an opacity of vertices, of which faces have the mean")
        if len(np.unique(opacity)) > MOST_TINTS:
            self._leave(
                f"has more than {MOST_TINTS} opacities of faces, of which the "
                "mean is read"
            )
            opacity = np.full_like(opacity, opacity.mean())
        tints = np.full((len(faces), 3), np.nan)
        vertex_colors = colors
        if colors is not None and colors[1] in ("constant", "uniform"):
            face_colors = per_face(colors)
            if len(np.unique(face_colors, axis=0)) <= MOST_TINTS:
                tints = face_colors
                vertex_colors = None
        keys = np.nan_to_num(np.concatenate([tints, opacity], axis=1), nan=-1.0)
        for key in np.unique(keys, axis=0):
            chosen = (keys == key).all(axis=1)
            color = None if colors is None else key[:3]
            if vertex_colors is not None:
                color = np.ones(3)  # which the vertices multiply
            number = self._surfaces.tinted(
                bound, color, None if key[3] < 0.0 else key[3]
            )
            yield number, vertex_colors, faces[chosen]

    def _groups(
        self, prim: Any, mesh: Any, faces: int
    ) -> Iterator[tuple[BoundMaterial, Array]]:
        """Yield the materials of a mesh and their faces."""
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        rest = np.ones(faces, bool)
        for subset in subsets:
            chosen = np.unique(_array(_first(subset, "Indices"), np.int64))
            chosen = chosen[(chosen >= 0) & (chosen < faces)]
            chosen = chosen[rest[chosen]]
            rest[chosen] = False
            yield self._surfaces.bound_to(subset.GetPrim()), chosen
        if rest.any():
            yield self._surfaces.bound_to(prim), np.flatnonzero(rest)

    def _at_rest(self, prim: Any, points: Array) -> tuple[Array | None, Array]:
        """Points of a mesh whose skeleton is at rest, and where they lie (4, 4), rows;
        (None, points) without one.
        """
        skin = self._skins.GetSkinningQuery(prim)
        if not skin or not skin.HasJointInfluences():
            return None, points
        bound = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
        query = self._skins.GetSkelQuery(bound) if bound else None
        if not query:
            return None, points
        rest = query.ComputeJointSkelTransforms(FIRST, atRest=True)
        binding = query.GetJointWorldBindTransforms()
        if not rest or len(rest) != len(binding):
            return None, points
        moves = [
            bind.GetInverse() * place for bind, place in zip(binding, rest, strict=True)
        ]
        mapper = skin.GetJointMapper()
        if mapper and not mapper.IsNull() and not mapper.IsIdentity():
            moves = mapper.RemapTransforms(type(rest)(moves))
        skinned = Vt.Vec3fArray([Gf.Vec3f(*map(float, point)) for point in points])
        if not skin.ComputeSkinnedPoints(Vt.Matrix4dArray(list(moves)), skinned, FIRST):
            return None, points
        place = UsdGeom.Xformable(bound.GetPrim()).ComputeLocalToWorldTransform(FIRST)
        return np.array(place), _array(skinned, np.float64, 3)


_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])


def _first(schema: Any, name: str) -> Any:
    return getattr(schema, f"Get{name}Attr")().Get(FIRST)


def _flattened(primvar: Any, width: int) -> tuple[Array, str] | None:
    """The values (N, width) of a primvar, and what each belongs to; None where there
    are none.
    """
    if not primvar or not primvar.HasValue():
        return None
    return _array(primvar.ComputeFlattened(FIRST), np.float64, width), str(
        primvar.GetInterpolation()
    )


def _primvar_values(primvars: Any, use: PrimvarUse | None) -> tuple[Array, str] | None:
    """Return the values (N, C) of a primvar that a surface uses, and what each belongs
    to; else the fallback.
    """
    if use is None:
        return None
    values = (
        _flattened(primvars.FindPrimvarWithInheritance(use.name), len(use.fallback))
        if use.name
        else None
    )
    if values is None or not len(values[0]):
        return np.array([use.fallback]), "constant"
    return np.nan_to_num(values[0]), values[1]


def _array(values: Any, kind: Any, width: int = 0) -> Array:
    array = np.asarray([] if values is None else values, dtype=kind)
    return array.reshape(-1, width) if width else array


def _smooth(points: Array, faces: Array) -> Array:
    """Normals (P, 3) of points: the mean of those of their triangles (T, 3), by
    area.
    """
    across = reading.face_vectors(points[faces])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(
        lengths > 0.0, normals / np.maximum(lengths, 1e-30), [0.0, 0.0, 1.0]
    )


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except errors.FileFormatError as error:
        sys.exit(f"refused: {error}")
