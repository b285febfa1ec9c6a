"""OpenUSD stages as binary glTF, by `usd-core`, in a process of its own that runs this module (`blender.converted`).

Layers are looked at before anything is composed of them: all that they name has to be a layer in the folder of the
first one or below. What glTF as we read it has no place for is named in `asset.extras` of the file.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
import sys
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.pictures import FORMATS, check_decodable
from advsearch.scene.assets import face_vectors
from advsearch.scene.glb import GlbBuffer, mime_type
from advsearch.scene.importing.blender import GENERATOR, LAYERS, PACKAGE
from advsearch.scene.importing.files import LARGEST_FILE, check_faces, check_most
from advsearch.scene.importing.geometry import triangulated
from advsearch.scene.importing.gltf import DEEPEST_TREE, LARGEST_TREE

FIRST = Usd.TimeCode.EarliestTime()
MOST_LAYERS = 1000
MOST_ENTRIES = 10_000
PURPOSES = ("default", "render")
WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071, "black": 33071, "useMetadata": 10497}
COAT = ("clearcoat", "displacement", "occlusion", "specularColor")
"""Inputs of a preview surface that our surfaces have nothing for."""
Array = npt.NDArray[Any]


def main(source: str, target: str, folder: str) -> None:
    """Write a file as binary glTF, and print the files that it was read from; a package is unpacked into a folder
    first. Raises FileFormatError, which tells the file by its name."""
    file = Path(source)
    if file.suffix.lower() == PACKAGE:
        file = unpacked(file, Path(folder))
    layers = checked_layers(file)
    stage = Usd.Stage.Open(str(file))
    made = Conversion(stage, file.parent.resolve(), Path(source).name)
    made.read = layers
    Path(target).write_bytes(made.glb())
    print(json.dumps(made.read if file == Path(source) else []))


# ---- what a file may name -------------------------------------------------------------------------------------------


def unpacked(package: Path, folder: Path) -> Path:
    """Unpack a .usdz file, and return its first layer."""
    try:
        with zipfile.ZipFile(package) as archive:
            entries = archive.infolist()
            got = f"{len(entries):,} of {(size := sum(entry.file_size for entry in entries)):,}"
            most = f"at most {files.scaled(MOST_ENTRIES):,} files of {files.scaled(LARGEST_FILE):,} bytes in all"
            check_most(package.name, len(entries), MOST_ENTRIES, most, got)
            check_most(package.name, size, LARGEST_FILE, most, got)
            for entry in entries:
                place = PurePosixPath(entry.filename)
                odd = place.is_absolute() or ".." in place.parts or "\\" in entry.filename or ":" in entry.filename
                if odd or entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                    raise FileFormatError(
                        f"{package.name}: expected files that lie in it as they are, got {entry.filename[:80]!r}, "
                        "which is packed or lies elsewhere; make it again with usdzip"
                    )
                if not entry.is_dir():
                    goal = folder / place
                    goal.parent.mkdir(parents=True, exist_ok=True)
                    goal.write_bytes(archive.read(entry))
    except (zipfile.BadZipFile, OSError, EOFError, ValueError, NotImplementedError) as error:
        raise FileFormatError(f"{package.name}: expected a .usdz archive, got one that is damaged ({error})") from None
    first = next((entry.filename for entry in entries if not entry.is_dir()), "")
    if Path(first).suffix.lower() not in LAYERS:
        raise FileFormatError(f"{package.name}: expected a USD layer first in it, got {first[:80]!r}")
    return folder / first


def checked_layers(file: Path) -> list[str]:
    """Return the files of all layers that a file is made of, itself first; refuse what it names elsewhere."""
    folder, waiting, known, size = file.parent.resolve(), [file.resolve()], dict[Path, None](), 0
    while waiting:
        path = waiting.pop()
        if path in known:
            continue
        known[path], size = None, size + path.stat().st_size
        most = f"at most {files.scaled(MOST_LAYERS):,} layers"
        for count, limit in ((len(known), MOST_LAYERS), (size, LARGEST_FILE)):
            check_most(file.name, count, limit, most, "more, or larger ones")
        try:
            layer = Sdf.Layer.FindOrOpen(str(path))
        except Exception as error:  # Tf.ErrorException, of which there are many kinds
            raise FileFormatError(f"{path.name}: expected a USD layer, got {_short(error)}") from None
        if layer is None:
            raise FileFormatError(f"{path.name}: expected a USD layer, got none that can be read")
        for name in filter(None, layer.GetCompositionAssetDependencies()):
            plain = not any(sign in name for sign in "`[]:\0") and Path(name).suffix.lower() in LAYERS
            named = Path(os.path.realpath(path.parent / name)) if plain else folder
            if not plain or not named.is_relative_to(folder):
                raise FileFormatError(
                    f"{file.name}: names the layer {name[:100]!r}, which is no USD file in its folder and is not read; "
                    "put it there, or make one file of all with usdcat"
                )
            if not named.is_file():
                raise FileFormatError(f"{file.name}: needs {name[:100]!r}, which is missing; put that file beside it")
            waiting.append(named)

        def check(at: Any, layer: Any = layer) -> None:
            spec = layer.GetObjectAtPath(at) if at.IsPrimPath() else None
            if spec is not None and "clips" in spec.ListInfoKeys():
                what = f"has value clips ({at}), which are not read"
                raise FileFormatError(f"{file.name}: {what}; make one file of all with usdcat")

        layer.Traverse(Sdf.Path.absoluteRootPath, check)
    return [str(path) for path in known]


def _short(error: Exception) -> str:
    said = re.findall(r":(\d+:\d+: .+)", str(error)) or re.findall(r" : '(.+)", str(error))
    lines = said or [line.strip() for line in str(error).splitlines() if len(line.strip()) > 3]
    return (lines[-1] if lines else type(error).__name__)[:200]


# ---- the stage ------------------------------------------------------------------------------------------------------


@dataclass
class Conversion:
    """Makes glTF of a stage, whose files lie in a folder; `source` is what messages call it."""

    stage: Any
    folder: Path
    source: str
    read: list[str] = field(default_factory=list)
    left: Counter[str] = field(default_factory=Counter)
    buffer: GlbBuffer = field(default_factory=GlbBuffer)
    triangles: int = 0

    def __post_init__(self) -> None:
        self.header: dict[str, Any] = {name: [] for name in ("nodes", "meshes", "materials", "textures", "images")}
        self.header |= {"samplers": [], "cameras": [], "asset": {"version": "2.0", "generator": GENERATOR}}
        self.lights: list[dict[str, Any]] = []
        self._materials: dict[str, tuple[int, str]] = {}
        self._skins, self.transforms = UsdSkel.Cache(), dict[int | None, Array]()
        for prim in self._prims():
            if prim.IsA(UsdSkel.Root):
                self._skins.Populate(UsdSkel.Root(prim), Usd.TraverseInstanceProxies())

    def _prims(self) -> Iterator[Any]:
        for number, prim in enumerate(Usd.PrimRange(self.stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())):
            check_most(self.source, number, LARGEST_TREE, "USD of at most {} prims", "more")
            depth = prim.GetPath().pathElementCount
            check_most(self.source, depth, DEEPEST_TREE, "prims of at most {} levels", "more")
            yield prim

    def glb(self) -> bytes:
        unit = UsdGeom.GetStageMetersPerUnit(self.stage)
        if not 0.0 < unit < math.inf:
            raise FileFormatError(f"{self.source}: expected metersPerUnit greater than 0, got {unit}")
        if not UsdGeom.StageHasAuthoredMetersPerUnit(self.stage):
            self._leave("does not say its unit, which USD takes for centimetres")
        if self.stage.HasAuthoredTimeCodeRange():
            self._leave("is animated; what is there first is read")
        self.unit = unit
        upright = np.eye(4) if UsdGeom.GetStageUpAxis(self.stage) == "Y" else _TO_Y_UP
        matrix = upright @ np.diag([unit, unit, unit, 1.0])
        nodes, header = self.header["nodes"], self.header
        nodes.append({"name": "stage", "matrix": matrix.T.ravel().tolist(), "children": []})
        names = Counter(prim.GetName() for prim in self._prims())
        places: dict[Any, int] = {}
        for prim in self._prims():
            kind = prim.GetTypeName()
            if (prim.IsA(UsdGeom.Gprim) and not prim.IsA(UsdGeom.Mesh)) or kind == "PointInstancer":
                self._leave(f"has a {kind}, which is no mesh: left out; make meshes of it where the file is from")
            if prim.HasAPI(UsdSkel.BindingAPI) and UsdSkel.BindingAPI(prim).GetBlendShapesAttr().HasAuthoredValue():
                self._leave("has a mesh with blend shapes, which are left out")
            if kind == "SkelAnimation":
                self._leave("has an animation of a skeleton, which is shown at rest")
            if not prim.IsA(UsdGeom.Imageable) or prim.IsA(UsdGeom.Subset):
                continue
            name = prim.GetName() if names[prim.GetName()] == 1 else str(prim.GetPath()).lstrip("/")
            node: dict[str, Any] = {"name": name, "children": []}
            parent, moves = 0, UsdGeom.Xformable(prim)
            if moves:
                local = np.array(moves.GetLocalTransformation(FIRST))  # rows, as glTF's columns
                if not np.isfinite(local).all():
                    raise FileFormatError(f"{self.source}: expected finite transforms, got others at {prim.GetPath()}")
                node["matrix"] = local.ravel().tolist()
            if not (moves and moves.GetResetXformStack()):
                parent = next((places[at] for at in prim.GetPath().GetAncestorsRange() if at in places), 0)
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
        if self.lights:
            header["extensions"] = {"KHR_lights_punctual": {"lights": self.lights}}
        notes = [what if count == 1 else f"{what} ({count:,} times)" for what, count in self.left.items()]
        header["asset"]["extras"] = {"left_out": notes[:100]}
        return self.buffer.file({key: value for key, value in header.items() if value or key == "asset"})

    def _leave(self, what: str) -> None:
        self.left[what] += 1

    def _fill(self, prim: Any, node: dict[str, Any]) -> None:
        imageable = UsdGeom.Imageable(prim)
        if not (prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdGeom.Camera) or prim.HasAPI(UsdLux.LightAPI)):
            return
        if imageable.ComputeVisibility(FIRST) == UsdGeom.Tokens.invisible:
            self._leave("has something invisible, which is left out")
        elif imageable.ComputePurpose() not in PURPOSES:
            self._leave(f"has something for the purpose {imageable.ComputePurpose()!r}, which is left out")
        elif prim.IsA(UsdGeom.Mesh):
            self._mesh(prim, node)
        elif prim.IsA(UsdGeom.Camera):
            self._camera(UsdGeom.Camera(prim), node)
        else:
            self._light(prim, node)

    # ---- cameras and lights ------------------------------------------------------------------------------------------

    def _camera(self, camera: Any, node: dict[str, Any]) -> None:
        wide, high, focal = (_first(camera, name) for name in ("HorizontalAperture", "VerticalAperture", "FocalLength"))
        entry: dict[str, Any] = {"name": node["name"], "type": "orthographic"}
        if _first(camera, "Projection") == UsdGeom.Tokens.perspective and min(wide, high, focal) > 0.0:
            if _first(camera, "HorizontalApertureOffset") or _first(camera, "VerticalApertureOffset"):
                self._leave("has a camera whose aperture is shifted; the shift is left out")
            view = {"yfov": 2.0 * math.atan(high / (2.0 * focal)), "aspectRatio": wide / high, "znear": 0.01}
            entry |= {"type": "perspective", "perspective": view}
        node["camera"] = len(self.header["cameras"])
        self.header["cameras"].append(entry)

    def _light(self, prim: Any, node: dict[str, Any]) -> None:
        light, kind = UsdLux.LightAPI(prim), prim.GetTypeName()
        power = _first(light, "Intensity") * 2.0 ** _first(light, "Exposure")
        normalised = _first(light, "Normalize")
        color = np.array(_first(light, "Color"), np.float64)
        if _first(light, "EnableColorTemperature"):
            color *= np.array(UsdLux.BlackbodyTemperatureAsRgb(_first(light, "ColorTemperature")))
        if kind == "DistantLight":
            half = math.radians(_first(UsdLux.DistantLight(prim), "Angle")) / 2.0
            entry: dict[str, Any] = {"type": "directional"}
            power *= 1.0 if normalised or half <= 0.0 else math.pi * math.sin(half) ** 2
        elif kind == "SphereLight":
            # radiance times the disk that is seen; normalised, what is emitted is divided by the area of the sphere
            power *= 0.25 if normalised else math.pi * _first(UsdLux.SphereLight(prim), "Radius") ** 2
            power *= self.unit**2
            entry, shaping = {"type": "point"}, UsdLux.ShapingAPI(prim)
            cone = _first(shaping, "ShapingConeAngle") if prim.HasAPI(UsdLux.ShapingAPI) else 90.0
            if cone is not None and cone < 90.0:
                soft, outer = _first(shaping, "ShapingConeSoftness") or 0.0, math.radians(max(cone, 0.1))
                cone_angles = {"outerConeAngle": outer, "innerConeAngle": outer * (1.0 - min(soft, 1.0))}
                entry = {"type": "spot", "spot": cone_angles}
            self._leave("has a SphereLight, which shines from its middle here")
        else:
            self._leave(f"has a {kind}, which is left out; `environment` and `controls=light` light a scene")
            return
        if not (math.isfinite(power) and power >= 0.0 and np.isfinite(color).all() and (color >= 0.0).all()):
            raise FileFormatError(f"{self.source}: expected the light {node['name']} to have a power of at least 0")
        node["extensions"] = {"KHR_lights_punctual": {"light": len(self.lights)}}
        self.lights.append({**entry, "name": node["name"], "color": color.tolist(), "intensity": power})

    # ---- meshes ------------------------------------------------------------------------------------------------------

    def _mesh(self, prim: Any, node: dict[str, Any]) -> None:
        mesh, path = UsdGeom.Mesh(prim), str(prim.GetPath())
        points = _array(_first(mesh, "Points"), np.float64, 3)
        counts, corners, holes = (
            _array(_first(mesh, name), np.int64) for name in ("FaceVertexCounts", "FaceVertexIndices", "HoleIndices")
        )
        if not len(points) or not len(counts):
            return
        if (counts < 0).any() or counts.sum() != len(corners) or corners.min() < 0 or corners.max() >= len(points):
            raise FileFormatError(f"{self.source}: expected faces of the points of {path}, got others; export it again")
        moved, points = self._at_rest(prim, points)
        if moved is not None:
            node["moved"] = moved.ravel().tolist()
        self.triangles += int(np.maximum(counts - 2, 0).sum())
        check_faces(self.source, self.triangles, "more")
        picked, face, _ = triangulated(points[corners], counts)
        keep = ~np.isin(face, holes)
        picked, face = picked[keep], face[keep]
        if _first(mesh, "Orientation") == UsdGeom.Tokens.leftHanded:
            picked = picked[:, ::-1]
        primvars = UsdGeom.PrimvarsAPI(prim)
        normals = _flattened(primvars.GetPrimvar("normals"), 3)
        if normals is None and len(own := _array(_first(mesh, "Normals"), np.float64, 3)):
            normals = own, str(mesh.GetNormalsInterpolation())
        if _first(mesh, "SubdivisionScheme") != UsdGeom.Tokens.none:
            self._leave("has a mesh that is to be subdivided, which is shown as it is, and smooth")
            normals = _smooth(points, corners[picked]), "vertex"
        primitives = []
        for material, uv_name, faces in self._groups(prim, mesh, len(counts)):
            mine = np.isin(face, faces) if faces is not None else np.ones(len(face), bool)
            at = picked[mine].reshape(-1)
            if not len(at):
                continue
            uvs = _flattened(primvars.FindPrimvarWithInheritance(uv_name), 2)
            if uvs is not None:  # as glTF has them, v down, with the transform that the material asks for
                turned = self.transforms.get(material, np.eye(3)) if material is not None else np.eye(3)
                moved_uvs = uvs[0] @ turned[:2, :2].T + turned[:2, 2]
                uvs = np.stack([moved_uvs[:, 0], 1.0 - moved_uvs[:, 1]], axis=1), uvs[1]
            colors = None  # which only count where there is no material
            if material is None:
                colors = _flattened(primvars.FindPrimvarWithInheritance("displayColor"), 3)
            by = {"vertex": corners[at], "varying": corners[at], "faceVarying": at, "uniform": face[mine].repeat(3)}
            held = {"NORMAL": normals, "TEXCOORD_0": uvs, "COLOR_0": colors}
            index, none = [corners[at]], np.zeros(len(at), np.int64)
            for values, per in (given or (None, "") for given in held.values()):
                index.append(none if values is None else by.get(per, none))
                if values is not None and index[-1].max() >= len(values):
                    raise FileFormatError(f"{self.source}: expected as many values as corners on {path}, got fewer")
            rows, inverse = np.unique(np.stack(index, axis=1), axis=0, return_inverse=True)
            attributes = {"POSITION": self.buffer.accessor(points[rows[:, 0]].astype(np.float32), "VEC3", bounds=True)}
            for column, (name, given) in enumerate(held.items(), 1):
                if given is not None:
                    values = given[0][rows[:, column]].astype(np.float32)
                    attributes[name] = self.buffer.accessor(values, f"VEC{values.shape[1]}")
            entry = {"attributes": attributes, "mode": 4}
            entry["indices"] = self.buffer.accessor(inverse.reshape(-1).astype(np.uint32), "SCALAR")
            primitives.append(entry if material is None else {**entry, "material": material})
        if primitives:
            node["mesh"] = len(self.header["meshes"])
            self.header["meshes"].append({"name": node["name"], "primitives": primitives})

    def _groups(self, prim: Any, mesh: Any, faces: int) -> Iterator[tuple[int | None, str, Array | None]]:
        """Yield the materials of a mesh: number, name of the texture coordinates, and faces (None for all)."""
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        rest = np.ones(faces, bool)
        for subset in subsets:
            chosen = _array(_first(subset, "Indices"), np.int64)
            chosen = chosen[(chosen >= 0) & (chosen < faces)]
            chosen = chosen[rest[chosen]]
            rest[chosen] = False
            yield *self._material(subset.GetPrim()), chosen
        if rest.any():
            yield *self._material(prim), np.flatnonzero(rest) if subsets else None

    def _at_rest(self, prim: Any, points: Array) -> tuple[Array | None, Array]:
        """Points of a mesh whose skeleton is at rest, and where they lie (4, 4), rows; (None, points) without one."""
        skin = self._skins.GetSkinningQuery(prim)
        if not skin or not skin.HasJointInfluences():
            return None, points
        bound = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
        query = self._skins.GetSkelQuery(bound) if bound else None
        if not query:
            return None, points
        rest, binding = query.ComputeJointSkelTransforms(FIRST, atRest=True), query.GetJointWorldBindTransforms()
        if not rest or len(rest) != len(binding):
            return None, points
        moves = [bind.GetInverse() * place for bind, place in zip(binding, rest, strict=True)]
        mapper = skin.GetJointMapper()
        if mapper and not mapper.IsNull() and not mapper.IsIdentity():
            moves = mapper.RemapTransforms(type(rest)(moves))
        skinned = Vt.Vec3fArray([Gf.Vec3f(*map(float, point)) for point in points])
        if not skin.ComputeSkinnedPoints(Vt.Matrix4dArray(list(moves)), skinned, FIRST):
            return None, points
        place = UsdGeom.Xformable(bound.GetPrim()).ComputeLocalToWorldTransform(FIRST)
        return np.array(place), _array(skinned, np.float64, 3)

    # ---- materials ---------------------------------------------------------------------------------------------------

    def _material(self, prim: Any) -> tuple[int | None, str]:
        """The number of what a prim is made of, and the name of its texture coordinates; (None, "st") of none."""
        binding = UsdShade.MaterialBindingAPI(prim)
        bound = binding.ComputeBoundMaterial(UsdShade.Tokens.preview)[0] or binding.ComputeBoundMaterial()[0]
        if not bound:
            return None, "st"
        path = str(bound.GetPath())
        if path not in self._materials:
            entry: dict[str, Any] = {"name": str(bound.GetPrim().GetName()), "doubleSided": True}
            number = len(self.header["materials"])
            self.header["materials"].append(entry)
            self._materials[path] = number, self._look(bound.ComputeSurfaceSource()[0], number, entry)
        return self._materials[path]

    def _look(self, shader: Any, number: int, entry: dict[str, Any]) -> str:
        """Fill the entry of a material; return the name of its texture coordinates."""
        surface = entry["pbrMetallicRoughness"] = dict[str, Any]()
        if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
            self._leave("has a material that is no UsdPreviewSurface, which is grey here")
            grey = [0.2140, 0.2140, 0.2140, 1.0]
            surface |= {"baseColorFactor": grey, "metallicFactor": 0.0, "roughnessFactor": 0.5}
            return "st"
        inputs = Inputs(self, shader, number)
        color, base = inputs.color("diffuseColor", (0.18, 0.18, 0.18)), inputs.texture("diffuseColor", "rgb")
        opacity, cutoff = inputs.number("opacity", 1.0), inputs.number("opacityThreshold", 0.0)
        cut = inputs.texture("opacity", "a")
        if base is not None:
            surface["baseColorTexture"] = {"index": base}
        if cut is not None and cut != base:
            self._leave("has an opacity of another picture than the colour's, which is left out")
        if cut is not None or inputs.source("opacity") is not None:
            opacity = 1.0
        surface["baseColorFactor"] = [*color, opacity]
        if opacity < 1.0 or (cut is not None and cut == base):
            entry |= {"alphaMode": "MASK", "alphaCutoff": cutoff} if cutoff > 0.0 else {"alphaMode": "BLEND"}
        rough, metallic = inputs.number("roughness", 0.5), inputs.number("metallic", 0.0)
        packed = self._packed(inputs, rough, metallic)
        if packed is None:
            surface |= {"metallicFactor": metallic, "roughnessFactor": rough}
        else:
            surface |= {"metallicFactor": 1.0, "roughnessFactor": 1.0, "metallicRoughnessTexture": {"index": packed}}
        for slot, name in {"normalTexture": "normal", "emissiveTexture": "emissiveColor"}.items():
            if (texture := inputs.texture(name, "rgb")) is not None:
                entry[slot] = {"index": texture}
        glow = inputs.color("emissiveColor", (0.0, 0.0, 0.0))
        if (most := max(glow)) > 0.0:
            entry["emissiveFactor"] = [channel / max(most, 1.0) for channel in glow]
            if most > 1.0:
                entry["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": most}}
        specular = bool(inputs.number("useSpecularWorkflow", 0.0))
        for name in COAT:
            value, usual = inputs.value(name), {"occlusion": 1.0, "specularColor": None}.get(name, 0.0)
            set_to = inputs.source(name) is not None or (value is not None and value != usual)
            if set_to and (specular or name != "specularColor"):
                self._leave(f"has materials with {name}, which is left out")
        if specular:
            self._leave("has materials with a specular workflow, of which the diffuse colour is read")
        if abs(inputs.number("ior", 1.5) - 1.5) > 1e-3:
            self._leave("has materials with an ior other than 1.5, which is left out")
        return inputs.uv_name

    def _packed(self, inputs: Inputs, rough: float, metallic: float) -> int | None:
        planes = [inputs.plane(name) for name in ("roughness", "metallic")]
        size = next((plane.size for plane in planes if plane is not None), None)
        if size is None:
            return None
        channels = [
            Image.new("L", size, round(255 * min(max(value, 0.0), 1.0))) if plane is None else plane.resize(size)
            for plane, value in zip(planes, (rough, metallic), strict=True)
        ]
        file = io.BytesIO()
        Image.merge("RGB", [Image.new("L", size, 255), *channels]).save(file, "PNG")
        return self.add_texture(file.getvalue(), {"wrapS": 10497, "wrapT": 10497})

    def image(self, asset: Any, name: str) -> bytes | None:
        """The bytes of a picture in the folder; None, and a note, of one that is not there."""
        path = str(asset.path)
        resolved = os.path.realpath(str(asset.resolvedPath) or str(self.folder / path))
        inside = Path(resolved).is_relative_to(self.folder)
        if not inside or not os.path.isfile(resolved):
            why = "is missing" if inside else "is outside its folder and is not read"
            self._leave(f"the texture {path[:100]!r} of {name} {why}")
            return None
        self.read.append(resolved)
        return files.read_bytes(Path(resolved), "a picture", LARGEST_FILE)

    def add_texture(self, data: bytes, sampler: Mapping[str, int]) -> int:
        image = self._numbered("images", {"mimeType": mime_type(data), "bufferView": self.buffer.view(data)})
        return self._numbered("textures", {"source": image, "sampler": self._numbered("samplers", sampler)})

    def _numbered(self, kind: str, entry: Mapping[str, Any]) -> int:
        entries: list[Mapping[str, Any]] = self.header[kind]
        if entry not in entries:
            entries.append(entry)
        return entries.index(entry)


@dataclass
class Inputs:
    """The inputs of a preview surface: numbers, and the pictures that they are connected to."""

    conversion: Conversion
    shader: Any
    material: int
    uv_name: str = "st"

    def source(self, name: str) -> tuple[Any, str] | None:
        """The shader, and its output, that an input has in place of its own value."""
        for attribute in _producing(self.shader, name):
            prim = UsdShade.Shader(attribute.GetPrim())
            if prim and UsdShade.Utils.GetType(attribute.GetName()) == UsdShade.AttributeType.Output:
                return prim, UsdShade.Utils.GetBaseNameAndType(attribute.GetName())[0]
        return None

    def value(self, name: str) -> Any:
        return None if self.source(name) is not None else _produced(self.shader, name)

    def number(self, name: str, otherwise: float) -> float:
        """A number; that of the format where the surface says none."""
        value = self.value(name)
        number = otherwise if value is None else float(value)
        return number if math.isfinite(number) else otherwise

    def color(self, name: str, otherwise: tuple[float, float, float]) -> tuple[float, ...]:
        """A linear colour: of a picture, what it is multiplied by."""
        source = self.source(name)
        if source is not None:
            scale = source[0].GetInput("scale")
            value, otherwise = (scale.Get(FIRST) if scale else None), (1.0, 1.0, 1.0)
        else:
            value = self.value(name)
        return otherwise if value is None else tuple(map(float, value[:3]))

    def _picture(self, name: str) -> tuple[bytes, Any, str] | None:
        source = self.source(name)
        if source is None:
            return None
        texture, output = source
        if texture.GetIdAttr().Get() != "UsdUVTexture":
            self.conversion._leave(f"has a {name} of {texture.GetIdAttr().Get()}, which is left out")
            return None
        path = _produced(texture, "file")
        if path is None:
            return None
        if "<UDIM>" in str(path.path):
            self.conversion._leave("has UDIM textures, which are left out; make .obj or one texture of them")
            return None
        data = self.conversion.image(path, self.shader.GetPrim().GetParent().GetName())
        return None if data is None else (data, texture, output)

    def texture(self, name: str, output: str) -> int | None:
        """The number of the texture that an input shows; None where there is none, or it cannot be read."""
        picture = self._picture(name)
        if picture is None:
            return None
        data, texture, shown = picture
        if shown != output:
            self.conversion._leave(f"has a {name} of the output {shown!r} of a picture, which is left out")
            return None
        return self.conversion.add_texture(data, self._sampler(texture, name))

    def plane(self, name: str) -> Image.Image | None:
        """The picture of 8 bits of an input that is one number."""
        picture = self._picture(name)
        if picture is None:
            return None
        data, texture, output = picture
        self._sampler(texture, name)
        try:
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                check_decodable(image, name)
                planes: tuple[Image.Image, ...] = image.convert("RGBA").split()
        except (OSError, ValueError, SyntaxError) as error:
            self.conversion._leave(f"has a picture of {name} that cannot be read ({_short(error)})")
            return None
        return planes["rgba".index(output)] if output in tuple("rgba") else planes[0]

    def _sampler(self, texture: Any, name: str) -> dict[str, int]:
        wraps = []
        for axis in ("wrapS", "wrapT"):
            given = texture.GetInput(axis)
            word = str(given.Get(FIRST)) if given and given.Get(FIRST) is not None else "useMetadata"
            if word == "black":
                self.conversion._leave("has a texture that is black beyond its edges, which goes on as at them here")
            wraps.append(WRAPS.get(word, 10497))
        turned, reader = np.eye(3), self._st(texture)
        if reader is not None and reader.GetIdAttr().Get() == "UsdTransform2d":
            inputs = (reader.GetInput(name) for name in ("scale", "rotation", "translation"))
            scale, rotation, shift = (value.Get(FIRST) if value else None for value in inputs)
            angle = math.radians(rotation or 0.0)  # counter-clockwise
            turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
            turned[:2, :2], turned[:2, 2] = turn @ np.diag(scale or (1.0, 1.0)), shift or (0.0, 0.0)
            reader = self._st(reader, "in")
        if reader is not None and reader.GetInput("varname"):
            self.uv_name = str(_produced(reader, "varname") or "st")
        known = self.conversion.transforms.setdefault(self.material, turned)
        if not np.array_equal(known, turned):
            another = f"has a {name} with another UsdTransform2d than the first texture's"
            self.conversion._leave(f"{another}, which is left out")
        return {"wrapS": wraps[0], "wrapT": wraps[1]}

    def _st(self, shader: Any, name: str = "st") -> Any:
        prim = next((attribute.GetPrim() for attribute in _producing(shader, name)), shader.GetPrim())
        return UsdShade.Shader(prim) if prim != shader.GetPrim() else None


_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])


def _first(schema: Any, name: str) -> Any:
    return getattr(schema, f"Get{name}Attr")().Get(FIRST)


def _producing(shader: Any, name: str) -> Sequence[Any]:
    given = shader.GetInput(name)
    return UsdShade.Utils.GetValueProducingAttributes(given) if given else ()


def _produced(shader: Any, name: str) -> Any:
    return next((attribute.Get(FIRST) for attribute in _producing(shader, name)), None)


def _flattened(primvar: Any, width: int) -> tuple[Array, str] | None:
    """The values (N, width) of a primvar, and what each belongs to; None where there are none."""
    if not primvar or not primvar.HasValue():
        return None
    return _array(primvar.ComputeFlattened(FIRST), np.float64, width), str(primvar.GetInterpolation())


def _array(values: Any, kind: Any, width: int = 0) -> Array:
    array = np.asarray([] if values is None else values, dtype=kind)
    return array.reshape(-1, width) if width else array


def _smooth(points: Array, faces: Array) -> Array:
    """Normals (P, 3) of points: the mean of those of their triangles (T, 3), by area."""
    across = face_vectors(points[faces])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 0.0, normals / np.maximum(lengths, 1e-30), [0.0, 0.0, 1.0])


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except FileFormatError as error:
        sys.exit(f"refused: {error}")
