"""Materials of OpenUSD as materials of glTF: preview surfaces, and the pictures that
they show.

What each input means is in the UsdPreviewSurface specification, version 2.6
(openusd.org). An input that is not read is named.
"""

from __future__ import annotations

import io
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from pxr import Ar, Usd, UsdShade

from advsearch.extend import color, errors, reading, stored_files
from advsearch.scene.importing.usd.layers import read_packaged, shorten
from advsearch.scene.importing.usd.pictures import (
    EXR,
    decode_picture,
    has_colors_of_8_bits,
    is_marked_srgb,
    is_of_8_bits,
)

Array = npt.NDArray[Any]
FIRST = Usd.TimeCode.EarliestTime()
PREVIEW_SURFACE = "UsdPreviewSurface"
UV_TEXTURE = "UsdUVTexture"
TRANSFORM = "UsdTransform2d"
READERS_OF_COORDINATES = ("UsdPrimvarReader_float2", "UsdPrimvarReader_vector")
READERS_OF_COLORS = ("UsdPrimvarReader_float3", "UsdPrimvarReader_float4")
READER_OF_NUMBERS = "UsdPrimvarReader_float"
# the linear diffuse colour of a preview surface that says none
GREY = (0.18, 0.18, 0.18)
ROUGHNESS = 0.5  # the same
WRAPS = {
    "repeat": reading.gltf_entries.REPEAT,
    "mirror": reading.gltf_entries.MIRRORED,
    "clamp": reading.gltf_entries.CLAMPED,
    "black": reading.gltf_entries.BORDER,
    "useMetadata": reading.gltf_entries.BORDER,
}
CHANNELS: Mapping[str, Sequence[int]] = {
    **{"rgb": (0, 1, 2), "rgba": (0, 1, 2), "xyz": (0, 1, 2)},
    **{"r": (0,), "g": (1,), "b": (2,), "a": (3,)},
}
"""Channels of a picture by the names of outputs."""
NO_SCALE = (1.0, 1.0, 1.0, 1.0)
NO_BIAS = (0.0, 0.0, 0.0, 0.0)
NORMAL_SCALE = (2.0, 2.0, 2.0, 1.0)
NORMAL_BIAS = (-1.0, -1.0, -1.0, 0.0)
"""What makes normals of the texels of 8 bits."""
UPRIGHT = (0.0, 0.0, 1.0)  # the normal of a surface that says none
WITHOUT_EFFECT: Mapping[str, float | tuple[float, ...]] = {
    **{"clearcoat": 0.0, "displacement": 0.0, "occlusion": 1.0, "ior": 1.5},
    **{"specularColor": (0.0, 0.0, 0.0)},
}
"""Values of inputs that change nothing; those of inputs that are not read are not
named.
"""
MOST_NODES = 32  # shaders from an input to what it shows


@dataclass(frozen=True)
class Layout:
    """How a picture is looked up: by which primvar, and how that is moved."""

    primvar: str = "st"  # empty: everywhere at the same texture coordinates
    # texture coordinates where a mesh has no such primvar
    fallback: tuple[float, float] | None = None
    matrix: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # two rows for (s, t, 1)

    def moved(self, st: Array) -> Array:
        """Return texture coordinates (N, 2) as this looks pictures up."""
        rows = np.array(self.matrix).reshape(2, 3)
        return np.asarray(st @ rows[:, :2].T + rows[:, 2])


@dataclass(frozen=True)
class PrimvarUse:
    """A primvar that a surface has in the place of a number or a colour, and what holds
    where there is none.
    """

    name: str
    fallback: tuple[float, ...]


@dataclass(frozen=True)
class BoundMaterial:
    """The material of some faces."""

    number: int  # of the glTF material
    # texture coordinates by their numbers in glTF
    layouts: tuple[Layout, ...] = (Layout(),)
    color: PrimvarUse | None = None
    opacity: PrimvarUse | None = None
    is_default: bool = False  # whether it stands in for no material


@dataclass
class Shader:
    """A shader whose inputs are tracked."""

    prim: Any
    inputs: reading.TrackedKeys[Any]

    @classmethod
    def of(cls, prim: Any) -> Shader:
        inputs = {given.GetBaseName(): given for given in prim.GetInputs()}
        return cls(prim, reading.TrackedKeys(inputs))

    @property
    def kind(self) -> str:
        return str(self.prim.GetIdAttr().Get() or "a shader without an id")

    def _producers(self, name: str) -> Sequence[Any]:
        given = self.inputs.get(name)
        return UsdShade.Utils.GetValueProducingAttributes(given) if given else ()

    def source(self, name: str) -> tuple[Shader, str] | None:
        """Return the shader, and its output, that an input has in the place of its own
        value.
        """
        for attribute in self._producers(name):
            prim = UsdShade.Shader(attribute.GetPrim())
            is_output = (
                UsdShade.Utils.GetType(attribute.GetName())
                == UsdShade.AttributeType.Output
            )
            if prim and is_output:
                return Shader.of(prim), UsdShade.Utils.GetBaseNameAndType(
                    attribute.GetName()
                )[0]
        return None

    def value(self, name: str) -> Any:
        """Return the value of an input that no shader has; None where there is none."""
        if self.source(name) is not None:
            return None
        return next((attribute.Get(FIRST) for attribute in self._producers(name)), None)

    def numbers(self, name: str, otherwise: Sequence[float]) -> tuple[float, ...]:
        """Return as many finite numbers as there are otherwise."""
        value = self.value(name)
        try:
            given = np.array(value, np.float64).reshape(-1)[: len(otherwise)]
        except (TypeError, ValueError):
            return tuple(otherwise)
        if value is None or len(given) < len(otherwise) or not np.isfinite(given).all():
            return tuple(otherwise)
        return tuple(map(float, given))

    def number(self, name: str, otherwise: float) -> float:
        return self.numbers(name, (otherwise,))[0]


@dataclass(frozen=True, eq=False)
class UsdTextureUse:
    """A picture that an input shows."""

    path: str  # what the file calls it
    data: bytes
    is_srgb: bool
    channels: Sequence[int]
    scale: tuple[float, ...]
    bias: tuple[float, ...]
    layout: Layout
    wraps: tuple[int, int]

    @property
    def is_plain(self) -> bool:
        """Whether values are those of the picture."""
        return self.bias == NO_BIAS and self.scale == NO_SCALE

    @property
    def sampler(self) -> dict[str, int]:
        return {"wrapS": self.wraps[0], "wrapT": self.wraps[1]}


@dataclass
class UsdSurfaces:
    """Writes the materials of a stage, whose files lie in a folder, into the header of
    a glTF file.
    """

    folder: Path
    header: dict[str, Any]
    buffer: reading.GlbBuffer
    left: Counter[str]  # sentences about what is left out
    read: list[str]  # files that were read
    _bound: dict[str, BoundMaterial] = field(default_factory=dict)
    _texels: dict[tuple[bytes, bool], Array] = field(default_factory=dict)

    def leave(self, what: str) -> None:
        self.left[what] += 1

    def bound_to(self, prim: Any) -> BoundMaterial:
        """Return what a prim is made of: a material, or its display colour."""
        binding = UsdShade.MaterialBindingAPI(prim)
        material = (
            binding.ComputeBoundMaterial(UsdShade.Tokens.preview)[0]
            or binding.ComputeBoundMaterial()[0]
        )
        path = str(material.GetPath()) if material else ""
        if path not in self._bound:
            self._bound[path] = (
                self._convert(material) if material else self._without_material()
            )
        return self._bound[path]

    def _without_material(self) -> BoundMaterial:
        surface = {
            "baseColorFactor": [*GREY, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": ROUGHNESS,
        }
        number = self._add_material(
            {"name": "displayColor", "pbrMetallicRoughness": surface}
        )
        color = PrimvarUse("displayColor", GREY)
        return BoundMaterial(
            number,
            color=color,
            opacity=PrimvarUse("displayOpacity", (1.0,)),
            is_default=True,
        )

    def _add_material(self, entry: dict[str, Any]) -> int:
        self.header["materials"].append({**entry, "doubleSided": True})
        return len(self.header["materials"]) - 1

    def tinted(
        self, bound: BoundMaterial, color: Sequence[float] | None, opacity: float | None
    ) -> int:
        """Return the number of a material with another colour and opacity, linear
        values in [0, 1].
        """
        entry = dict(self.header["materials"][bound.number])
        surface = dict(entry["pbrMetallicRoughness"])
        factor = list(surface["baseColorFactor"])
        if color is not None:
            factor[:3] = [min(max(float(channel), 0.0), 1.0) for channel in color]
        if opacity is not None:
            factor[3] = min(max(float(opacity), 0.0), 1.0)
        entry["pbrMetallicRoughness"] = {**surface, "baseColorFactor": factor}
        if factor[3] < 1.0 and "alphaMode" not in entry:
            entry["alphaMode"] = "BLEND"
        return self._numbered("materials", entry)

    def _convert(self, material: Any) -> BoundMaterial:
        name = str(material.GetPrim().GetName())
        self._texels.clear()  # they take memory
        shader = material.ComputeSurfaceSource()[0]
        if not shader or shader.GetIdAttr().Get() != PREVIEW_SURFACE:
            self.leave(
                "has a material that is no UsdPreviewSurface, which is grey here"
            )
            grey = [0.2140, 0.2140, 0.2140, 1.0]
            surface = {
                "baseColorFactor": grey,
                "metallicFactor": 0.0,
                "roughnessFactor": ROUGHNESS,
            }
            return BoundMaterial(
                self._add_material({"name": name, "pbrMetallicRoughness": surface})
            )
        return PreviewSurface(self, Shader.of(shader), name).convert()

    # ---- pictures
    # ----------------------------------------------------------------------------------------------------

    def image(self, asset: Any, name: str) -> bytes | None:
        """Return the bytes of a picture in the folder; None, and a note, of one that is
        not there.
        """
        path = str(asset.path)
        resolved = str(asset.resolvedPath) or str(self.folder / path)
        outer, inner = Ar.SplitPackageRelativePathOuter(resolved)
        outer = os.path.realpath(outer)
        is_own = reading.is_inside(outer, self.folder)
        data = None
        if is_own and os.path.isfile(outer):
            try:
                packaged = Ar.JoinPackageRelativePath(outer, inner) if inner else ""
                data = (
                    read_packaged(packaged)
                    if inner
                    else stored_files.read_bytes(
                        Path(outer), "a picture", stored_files.LARGEST_FILE
                    )
                )
            except KeyError:
                data = None
        if data is None:
            why = reading.MISSING if is_own else reading.OUTSIDE
            self.leave(f"the texture {path[:100]!r} of {name} {why}")
            return None
        self.read.append(outer)
        return data

    def texels(self, use: UsdTextureUse) -> Array | None:
        """Return a picture (H, W, 4) in linear values, before scale and bias; None, and
        a note, of none.
        """
        key = (use.data, use.is_srgb)
        if key not in self._texels:
            try:
                self._texels[key] = decode_picture(
                    use.data, use.path, is_srgb=use.is_srgb
                )
            except (
                OSError,
                ValueError,
                SyntaxError,
                EOFError,
                errors.FileFormatError,
            ) as error:
                self.leave(
                    f"the texture {use.path[:100]!r} cannot be read ({shorten(error)})"
                )
                return None
        return self._texels[key]

    def values(self, use: UsdTextureUse) -> Array | None:
        """Return what a picture yields, (H, W, C) for its channels."""
        texels = self.texels(use)
        if texels is None:
            return None
        values = texels * np.array(use.scale, np.float32) + np.array(
            use.bias, np.float32
        )
        return np.asarray(values[:, :, list(use.channels)])

    def add_picture(self, levels: Array, sampler: Mapping[str, int]) -> int:
        """Add a picture of display values in [0, 1], (H, W, 3 or 4), and return the
        number of its texture.
        """
        file = io.BytesIO()
        Image.fromarray(
            np.uint8(np.clip(np.nan_to_num(levels), 0.0, 1.0) * 255.0 + 0.5)
        ).save(file, "PNG")
        return self.add_texture(file.getvalue(), sampler)

    def add_texture(self, data: bytes, sampler: Mapping[str, int]) -> int:
        image = self._numbered(
            "images",
            {"mimeType": reading.mime_type(data), "bufferView": self.buffer.view(data)},
        )
        return self._numbered(
            "textures",
            {"source": image, "sampler": self._numbered("samplers", sampler)},
        )

    def _numbered(self, kind: str, entry: Mapping[str, Any]) -> int:
        entries: list[Mapping[str, Any]] = self.header[kind]
        if entry not in entries:
            entries.append(entry)
        return entries.index(entry)


@dataclass
class PreviewSurface:
    """Makes a glTF material of a preview surface."""

    surfaces: UsdSurfaces
    shader: Shader
    name: str
    layouts: list[Layout] = field(default_factory=list)
    # shaders that are read, by their paths
    nodes: dict[str, Shader] = field(default_factory=dict)

    def convert(self) -> BoundMaterial:
        """Write the material, and name the inputs that are not read."""
        shader = self.shader
        is_specular = bool(shader.number("useSpecularWorkflow", 0.0))
        surface: dict[str, Any] = {}
        entry: dict[str, Any] = {"name": self.name, "pbrMetallicRoughness": surface}
        color, opacity = self._base(entry, surface)
        self._numbers(surface, is_specular=is_specular)
        self._normal(entry)
        self._emission(entry)
        if is_specular:
            self.surfaces.leave(
                "has materials with a specular workflow, of which the "
                "diffuse colour is read"
            )
        shader.inputs.mark_read("clearcoatRoughness")  # named with the clearcoat
        if (
            str(shader.value("opacityMode") or "presence") != "presence"
            and entry.get("alphaMode") == "BLEND"
        ):
            self.surfaces.leave(
                "has materials with opacityMode transparent; here "
                "highlights fade with the opacity too"
            )
        self._name_unread(is_specular=is_specular)
        number = self.surfaces._add_material(entry)
        return BoundMaterial(number, tuple(self.layouts) or (Layout(),), color, opacity)

    def _name_unread(self, *, is_specular: bool) -> None:
        def is_quiet(name: str, given: Any) -> bool:
            if name == "specularColor" and not is_specular:
                return True
            usual = WITHOUT_EFFECT.get(name)
            for attribute in UsdShade.Utils.GetValueProducingAttributes(given):
                is_output = (
                    UsdShade.Utils.GetType(attribute.GetName())
                    == UsdShade.AttributeType.Output
                )
                value = attribute.Get(FIRST)
                if is_output or usual is None:
                    return False
                if value is not None and not np.allclose(
                    np.array(value, np.float64), usual, atol=1e-3
                ):
                    return False
            return True

        for name in self.shader.inputs.unread(is_quiet):
            what = "an ior other than 1.5" if name == "ior" else name
            self.surfaces.leave(f"has materials with {what[:100]}, which is left out")
        for node in self.nodes.values():
            if unread := node.inputs.unread():
                self.surfaces.leave(
                    f"has a {node.kind[:50]} with "
                    f"{reading.join_names(unread, 5)}, which is not "
                    "read"
                )

    # ---- what inputs show
    # --------------------------------------------------------------------------------------------

    def _node(self, source: Shader) -> Shader:
        return self.nodes.setdefault(str(source.prim.GetPath()), source)

    def _primvar(
        self, name: str, kinds: Sequence[str], otherwise: tuple[float, ...]
    ) -> PrimvarUse | None:
        """Return the primvar that an input shows; None where it shows none."""
        source = self.shader.source(name)
        if source is None or source[0].kind not in kinds:
            return None
        reader = self._node(source[0])
        primvar = str(reader.value("varname") or "")
        return PrimvarUse(primvar, reader.numbers("fallback", [0.0] * len(otherwise)))

    def _texture(self, name: str) -> UsdTextureUse | tuple[float, ...] | None:
        """Return the picture that an input shows, or the four numbers in its place;
        None where it shows none.
        """
        source = self.shader.source(name)
        if source is None:
            return None
        node = self._node(source[0])
        output = source[1]
        leave = self.surfaces.leave
        if node.kind != UV_TEXTURE:
            leave(f"has a {name} of {node.kind[:100]}, which is left out")
            return None
        fallback = (
            None
            if node.value("fallback") is None
            else node.numbers("fallback", NO_SCALE)
        )
        scale = node.numbers("scale", NO_SCALE)
        bias = node.numbers("bias", NO_BIAS)
        layout = self._layout(node)
        wraps = self._wraps(node)
        space = str(node.value("sourceColorSpace") or "auto")
        asset = node.value("file")
        if output not in CHANNELS:
            leave(
                f"has a {name} of the output {output[:50]!r} of a picture, which is "
                "left out"
            )
            return None
        channels = CHANNELS[output]
        data = None
        path = "" if asset is None else str(asset.path)
        if "<UDIM>" in path:
            leave(
                "has UDIM textures, which are left out; make .obj or one texture of "
                "them"
            )
        elif path:
            data = self.surfaces.image(asset, self.name)
        else:
            leave(f"has a {name} of a picture without a file")
        if data is None:
            return (
                None
                if fallback is None
                else tuple(fallback[channel] for channel in channels)
            )
        if channels == CHANNELS["a"] and data.startswith(EXR):
            leave(f"has a {name} of the alpha of an .exr picture, which is left out")
            return None
        if space not in ("auto", "raw", "sRGB"):
            leave(
                f"has a texture with the sourceColorSpace {space[:50]!r}, which is "
                "taken for auto"
            )
        is_srgb = space == "sRGB" or (space != "raw" and is_marked_srgb(data))
        return UsdTextureUse(path, data, is_srgb, channels, scale, bias, layout, wraps)

    def _wraps(self, node: Shader) -> tuple[int, int]:
        wraps = []
        for axis in ("wrapS", "wrapT"):
            word = str(node.value(axis) or "useMetadata")
            if word not in WRAPS:
                self.surfaces.leave(
                    f"has a texture with the {axis} {word[:50]!r}, "
                    "which is taken for repeat"
                )
            wraps.append(WRAPS.get(word, reading.gltf_entries.REPEAT))
        return wraps[0], wraps[1]

    def _layout(self, node: Shader) -> Layout:
        """Return how a picture is looked up: through transforms, by a reader of a
        primvar.
        """
        matrix = np.eye(3)
        name = "st"
        for _ in range(MOST_NODES):
            source = node.source(name)
            if source is None:
                return self._constant_layout(node, name, matrix)
            node = self._node(source[0])
            rows = tuple(map(float, matrix[:2].ravel()))
            if node.kind == TRANSFORM:
                matrix = matrix @ _transform_of(node)
                name = "in"
            elif node.kind in READERS_OF_COORDINATES:
                primvar = str(node.value("varname") or "st")
                fallback = node.numbers("fallback", (0.0, 0.0))
                return Layout(primvar, (fallback[0], fallback[1]), rows)
            else:
                self.surfaces.leave(
                    "has a texture that is looked up by "
                    f"{node.kind[:100]}; st is taken for it"
                )
                return Layout("st", None, rows)
        raise errors.FileFormatError(
            f"the material {self.name}: expected at most {MOST_NODES} shaders in a "
            "row, got more"
        )

    def _constant_layout(self, node: Shader, name: str, matrix: Array) -> Layout:
        self.surfaces.leave(
            "has a texture without texture coordinates (st), of which "
            "one texel is shown"
        )
        s, t = node.numbers(name, (0.0, 0.0))
        u, v, _ = matrix @ np.array([s, t, 1.0])
        return Layout("", (0.0, 0.0), (0.0, 0.0, float(u), 0.0, 0.0, float(v)))

    def _slot(self, texture: int, layout: Layout) -> dict[str, int]:
        if layout not in self.layouts:
            self.layouts.append(layout)
        return {"index": texture, "texCoord": self.layouts.index(layout)}

    # ---- the parts of the material
    # -----------------------------------------------------------------------------------

    def _base(
        self, entry: dict[str, Any], surface: dict[str, Any]
    ) -> tuple[PrimvarUse | None, PrimvarUse | None]:
        """Fill in colour and opacity; return the primvars that are in their places."""
        shader = self.shader
        surfaces = self.surfaces
        color_primvar = self._primvar("diffuseColor", READERS_OF_COLORS, GREY)
        opacity_primvar = self._primvar("opacity", (READER_OF_NUMBERS,), (1.0,))
        shown = None if color_primvar else self._texture("diffuseColor")
        cut = None if opacity_primvar else self._texture("opacity")
        threshold = shader.number("opacityThreshold", 0.0)
        color = list(shader.numbers("diffuseColor", GREY))
        opacity = shader.number("opacity", 1.0)
        if isinstance(shown, tuple):
            color = list(np.broadcast_to(shown, 3))
            shown = None
        if isinstance(cut, tuple):
            opacity = cut[0]
            cut = None
        if cut is not None and shown is not None and cut.layout != shown.layout:
            surfaces.leave(
                "has an opacity with other texture coordinates than the "
                "colour's, which is left out"
            )
            cut = None
        texture = None
        if (
            shown is not None
            and _is_factor(shown)
            and (cut is None or _is_its_alpha(cut, shown))
        ):
            texture = surfaces.add_texture(shown.data, shown.sampler)
            color = list(shown.scale[:3])
        elif shown is not None or cut is not None:
            levels = self._baked(shown, cut, color)
            if levels is not None:
                sampler = (shown or cut).sampler  # type: ignore[union-attr]
                texture = surfaces.add_picture(levels, sampler)
                color = [1.0, 1.0, 1.0]
        if texture is not None:
            surface["baseColorTexture"] = self._slot(texture, (shown or cut).layout)  # type: ignore[union-attr]
        is_cut = texture is not None and cut is not None
        factor = [
            min(max(channel, 0.0), 1.0)
            for channel in (*color, 1.0 if is_cut else opacity)
        ]
        surface["baseColorFactor"] = factor
        if is_cut or factor[3] < 1.0 or opacity_primvar is not None:
            masked = {"alphaMode": "MASK", "alphaCutoff": threshold}
            entry.update(masked if threshold > 0.0 else {"alphaMode": "BLEND"})
        return color_primvar, opacity_primvar

    def _baked(
        self,
        shown: UsdTextureUse | None,
        cut: UsdTextureUse | None,
        factor: Sequence[float],
    ) -> Array | None:
        """Return display values (H, W, 3 or 4) of colour and opacity; None where
        neither picture can be read.
        """
        colors = None if shown is None else self.surfaces.values(shown)
        shares = None if cut is None else self.surfaces.values(cut)
        if colors is None and shares is None:
            return None
        if colors is None and shares is not None:
            colors = np.broadcast_to(
                np.array(factor, np.float32), (*shares.shape[:2], 3)
            )
        assert colors is not None
        levels = color.linear_to_srgb(
            np.broadcast_to(colors, (*colors.shape[:2], 3)).astype(np.float32)
        )
        if shares is None:
            return levels
        if shares.shape[:2] != levels.shape[:2]:
            size = (
                max(shares.shape[1], levels.shape[1]),
                max(shares.shape[0], levels.shape[0]),
            )
            shares = _resized(shares, size)
            levels = _resized(levels, size)
        return np.concatenate([levels, shares[:, :, :1]], axis=2)

    def _numbers(self, surface: dict[str, Any], *, is_specular: bool) -> None:
        """Fill in roughness and metallic; pictures of them are put into one."""
        shader = self.shader
        factors = {
            "roughness": shader.number("roughness", ROUGHNESS),
            "metallic": shader.number("metallic", 0.0),
        }
        planes: dict[str, Array] = {}
        first: UsdTextureUse | None = None
        for name in factors:
            primvar = self._primvar(name, (READER_OF_NUMBERS,), (0.0,))
            use = None if primvar is not None else self._texture(name)
            if primvar is not None:
                factors[name] = primvar.fallback[0]
                self.surfaces.leave(
                    f"has a {name} of the primvar "
                    f"{primvar.name[:50]!r}, of which the fallback is "
                    "read"
                )
            elif isinstance(use, tuple):
                factors[name] = use[0]
            elif use is not None and (values := self.surfaces.values(use)) is not None:
                self._name_srgb(name, use)
                plane = np.clip(values[:, :, 0], 0.0, 1.0)
                if first is not None and use.layout != first.layout:
                    factors[name] = float(plane.mean())
                    self.surfaces.leave(
                        f"has a {name} with other texture coordinates, "
                        "of which the mean is read"
                    )
                    continue
                planes[name] = plane
                first = use
        if is_specular:  # which has no metals
            factors["metallic"] = 0.0
            planes.pop("metallic", None)
        if not planes or first is None:
            surface.update(
                {
                    "metallicFactor": factors["metallic"],
                    "roughnessFactor": factors["roughness"],
                }
            )
            return
        size = max((plane.shape[1], plane.shape[0]) for plane in planes.values())
        packed = np.ones((size[1], size[0], 3), np.float32)
        for channel, name in ((1, "roughness"), (2, "metallic")):
            packed[:, :, channel] = min(max(factors[name], 0.0), 1.0)
            if name in planes:
                packed[:, :, channel] = _resized(planes[name], size)
        texture = self.surfaces.add_picture(packed, first.sampler)
        slot = self._slot(texture, first.layout)
        surface.update(
            {
                "metallicFactor": 1.0,
                "roughnessFactor": 1.0,
                "metallicRoughnessTexture": slot,
            }
        )

    def _name_srgb(self, name: str, use: UsdTextureUse) -> None:
        if use.is_srgb and use.channels != CHANNELS["a"]:
            self.surfaces.leave(
                f"has a {name} that is decoded from sRGB, as its sourceColorSpace "
                "says; write raw if it holds numbers"
            )

    def _normal(self, entry: dict[str, Any]) -> None:
        if self.shader.source("normal") is None:
            if not np.allclose(
                self.shader.numbers("normal", UPRIGHT), UPRIGHT, atol=1e-3
            ):
                self.surfaces.leave(
                    "has materials with one normal everywhere, which is left out"
                )
            return
        use = self._texture("normal")
        if isinstance(use, tuple) or use is None:
            return
        if len(use.channels) != 3:
            self.surfaces.leave(
                "has a normal of one channel of a picture, which is left out"
            )
            return
        # USD asks for both, which many exporters leave out
        if use.is_plain and is_of_8_bits(use.data):
            texels = self.surfaces.texels(replace(use, is_srgb=False))
            if texels is not None and reading.holds_normals(texels[:, :, :3]):
                use = replace(use, scale=NORMAL_SCALE, bias=NORMAL_BIAS, is_srgb=False)
                self.surfaces.leave(
                    "has a normal map of 8 bits without scale (2, 2, 2, 1) and bias "
                    "(-1, -1, -1, 0), which are added"
                )
        if (
            not use.is_srgb
            and use.scale[:3] == NORMAL_SCALE[:3]
            and use.bias[:3] == NORMAL_BIAS[:3]
        ):
            if is_of_8_bits(use.data):
                entry["normalTexture"] = self._slot(
                    self.surfaces.add_texture(use.data, use.sampler), use.layout
                )
                return
        self._name_srgb("normal", use)
        normals = self.surfaces.values(use)
        if normals is not None:
            texture = self.surfaces.add_picture(normals * 0.5 + 0.5, use.sampler)
            entry["normalTexture"] = self._slot(texture, use.layout)

    def _emission(self, entry: dict[str, Any]) -> None:
        glow: Sequence[float] = self.shader.numbers("emissiveColor", (0.0, 0.0, 0.0))
        use = self._texture("emissiveColor")
        if isinstance(use, tuple):
            glow = list(np.broadcast_to(use, 3))
            use = None
        if use is not None and _is_factor(use, most=math.inf):
            entry["emissiveTexture"] = self._slot(
                self.surfaces.add_texture(use.data, use.sampler), use.layout
            )
            glow = use.scale[:3]
        elif use is not None:
            values = self.surfaces.values(use)
            if values is None:
                return
            values = np.broadcast_to(
                np.maximum(np.nan_to_num(values), 0.0), (*values.shape[:2], 3)
            )
            most = max(float(values.max()), 1e-6)
            texture = self.surfaces.add_picture(
                color.linear_to_srgb((values / most).astype(np.float32)), use.sampler
            )
            entry["emissiveTexture"] = self._slot(texture, use.layout)
            glow = [most] * 3
        glow = [max(channel, 0.0) for channel in glow]
        if (most := max(glow)) > 0.0:
            entry["emissiveFactor"] = [channel / max(most, 1.0) for channel in glow]
            if most > 1.0:
                entry["extensions"] = {
                    "KHR_materials_emissive_strength": {"emissiveStrength": most}
                }


def _transform_of(node: Shader) -> Array:
    """Return the matrix (3, 3) of a transform: scaled, then turned counter-clockwise,
    then moved.
    """
    scale = node.numbers("scale", (1.0, 1.0))
    shift = node.numbers("translation", (0.0, 0.0))
    angle = math.radians(node.number("rotation", 0.0))
    turn = np.array(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    matrix = np.eye(3)
    matrix[:2, :2] = turn @ np.diag(scale)
    matrix[:2, 2] = shift
    return matrix


def _is_factor(use: UsdTextureUse, most: float = 1.0) -> bool:
    """Whether the colours of a picture are its texels in sRGB, times a factor."""
    is_color = use.is_srgb and len(use.channels) == 3 and use.bias[:3] == NO_BIAS[:3]
    return (
        is_color
        and has_colors_of_8_bits(use.data)
        and all(0.0 <= scale <= most for scale in use.scale[:3])
    )


def _is_its_alpha(cut: UsdTextureUse, shown: UsdTextureUse) -> bool:
    """Whether an opacity is the alpha of the picture of the colour."""
    is_alpha = (
        cut.channels == CHANNELS["a"] and cut.scale[3] == 1.0 and cut.bias[3] == 0.0
    )
    return is_alpha and cut.data == shown.data


def _resized(values: Array, size: tuple[int, int]) -> Array:
    """Return a picture (H, W) or (H, W, C) in another size (width, height)."""
    if values.ndim == 3:
        return np.stack(
            [
                _resized(values[:, :, channel], size)
                for channel in range(values.shape[2])
            ],
            axis=2,
        )
    if (values.shape[1], values.shape[0]) == size:
        return values
    return np.asarray(
        Image.fromarray(values.astype(np.float32)).resize(
            size, Image.Resampling.BILINEAR
        )
    )
