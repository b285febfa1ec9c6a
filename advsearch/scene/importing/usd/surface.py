"""Converter of OpenUSD materials (preview surfaces) to glTF materials.

Inputs are those of the UsdPreviewSurface specification, version 2.6 (openusd.org). An
input that is not read is noted.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image
from pxr import Ar, Usd, UsdShade

from advsearch.extend import color, errors, reading, stored_files
from advsearch.scene.importing.usd.layers import format_error, read_packaged
from advsearch.scene.importing.usd.pictures import (
    EXR,
    decode_image,
    has_colors_of_8_bits,
    is_marked_srgb,
    is_of_8_bits,
)

Array = npt.NDArray[Any]
FIRST_TIME = Usd.TimeCode.EarliestTime()
PREVIEW_SURFACE = "UsdPreviewSurface"
UV_TEXTURE = "UsdUVTexture"
TRANSFORM = "UsdTransform2d"
READERS_OF_COORDINATES = ("UsdPrimvarReader_float2", "UsdPrimvarReader_vector")
READERS_OF_COLORS = ("UsdPrimvarReader_float3", "UsdPrimvarReader_float4")
READER_OF_NUMBERS = "UsdPrimvarReader_float"
# Defaults of a preview surface; the color is linear.
DEFAULT_COLOR = (0.18, 0.18, 0.18)
DEFAULT_ROUGHNESS = 0.5
WRAP_MODES = {
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
"""Channels of an image by the names of outputs."""
NO_SCALE = (1.0, 1.0, 1.0, 1.0)
NO_BIAS = (0.0, 0.0, 0.0, 0.0)
NORMAL_SCALE = (2.0, 2.0, 2.0, 1.0)
NORMAL_BIAS = (-1.0, -1.0, -1.0, 0.0)
"""Scale and bias that convert texels of 8 bits to normals."""
UPRIGHT = (0.0, 0.0, 1.0)  # default of the input "normal"
NEUTRAL_VALUES: Mapping[str, float | tuple[float, ...]] = {
    **{"clearcoat": 0.0, "displacement": 0.0, "occlusion": 1.0, "ior": 1.5},
    **{"specularColor": (0.0, 0.0, 0.0)},
}
"""Values of inputs that change nothing: with these, unread inputs need no note."""
MAX_SHADERS = 32  # limit of the shaders that are connected one after the other


@dataclass(frozen=True)
class TextureLayout:
    """The texture coordinates of an image: a primvar and its transform."""

    primvar: str = "st"  # "" for the same texture coordinates everywhere
    # Texture coordinates if a mesh has no such primvar.
    fallback: tuple[float, float] | None = None
    matrix: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # two rows for (s, t, 1)

    def transform(self, st: Array) -> Array:
        """Return texture coordinates (N, 2) after the transform."""
        rows = np.array(self.matrix).reshape(2, 3)
        return np.asarray(st @ rows[:, :2].T + rows[:, 2])


@dataclass(frozen=True)
class PrimvarUse:
    """A primvar that replaces a number or a color, and the fallback without it."""

    name: str
    fallback: tuple[float, ...]


@dataclass(frozen=True)
class BoundMaterial:
    """The material of a mesh or a subset of its faces."""

    material_index: int  # index of the glTF material
    # Texture coordinates by their index in glTF.
    layouts: tuple[TextureLayout, ...] = (TextureLayout(),)
    color: PrimvarUse | None = None  # primvar that replaces the base color
    opacity: PrimvarUse | None = None  # primvar that replaces the opacity
    is_default: bool = False  # whether the prim has no material


@dataclass
class Shader:
    """A shader, with a record of which inputs are read.

    Attributes:
        prim: its `UsdShade.Shader`.
        inputs: its inputs by name.
    """

    prim: Any
    inputs: reading.TrackedKeys[Any]

    @classmethod
    def from_prim(cls, prim: Any) -> Shader:
        """Return the shader of a prim."""
        inputs = {
            shader_input.GetBaseName(): shader_input
            for shader_input in prim.GetInputs()
        }
        return cls(prim, reading.TrackedKeys(inputs))

    @property
    def kind(self) -> str:
        """The id of the shader, such as UsdUVTexture."""
        return str(self.prim.GetIdAttr().Get() or "a shader without an id")

    def _find_producers(self, name: str) -> Sequence[Any]:
        """Return the attributes that produce the value of an input."""
        shader_input = self.inputs.get(name)
        if not shader_input:
            return ()
        producers: Sequence[Any] = UsdShade.Utils.GetValueProducingAttributes(
            shader_input
        )
        return producers

    def find_source(self, name: str) -> tuple[Shader, str] | None:
        """Return the shader to which an input is connected, and its output, or None."""
        for attribute in self._find_producers(name):
            prim = UsdShade.Shader(attribute.GetPrim())
            if prim and _is_output(attribute):
                output, _ = UsdShade.Utils.GetBaseNameAndType(attribute.GetName())
                return Shader.from_prim(prim), output
        return None

    def get_value(self, name: str) -> Any:
        """Return the value of an input; None if it has none, or is connected."""
        if self.find_source(name) is not None:
            return None
        return next(
            (attribute.Get(FIRST_TIME) for attribute in self._find_producers(name)),
            None,
        )

    def get_numbers(self, name: str, default: Sequence[float]) -> tuple[float, ...]:
        """Return as many finite numbers of an input as `default` has, or `default`.

        Further numbers are left out. If there are too few, or some are not finite, the
        default is returned.
        """
        value = self.get_value(name)
        if value is None:
            return tuple(default)
        try:
            numbers = np.array(value, np.float64).reshape(-1)[: len(default)]
        except (TypeError, ValueError):
            return tuple(default)
        if len(numbers) < len(default) or not np.isfinite(numbers).all():
            return tuple(default)
        return tuple(map(float, numbers))

    def get_number(self, name: str, default: float) -> float:
        """Return the finite number of an input, or `default`."""
        return self.get_numbers(name, (default,))[0]


def _is_neutral(attribute: Any, neutral: float | tuple[float, ...]) -> bool:
    """Return whether an attribute that produces an input has no or a neutral value."""
    if _is_output(attribute):  # of another shader
        return False
    value = attribute.Get(FIRST_TIME)
    return value is None or np.allclose(np.array(value, np.float64), neutral, atol=1e-3)


def _is_output(attribute: Any) -> bool:
    """Return whether an attribute is an output of a shader, and no input."""
    kind = UsdShade.Utils.GetType(attribute.GetName())
    return bool(kind == UsdShade.AttributeType.Output)


@dataclass(frozen=True, eq=False)
class UsdTextureUse:
    """An image to which an input is connected."""

    path: str  # path as it is written in the USD file
    data: bytes  # the image file
    is_srgb: bool  # whether its colors are decoded from sRGB
    channels: Sequence[int]  # channels of the image that the input uses
    scale: tuple[float, ...]  # (4,) factors of the channels
    bias: tuple[float, ...]  # (4,) numbers that are added after scaling
    layout: TextureLayout  # layout of its texture coordinates
    wraps: tuple[int, int]  # wrap modes along s and t, as in glTF

    @property
    def is_plain(self) -> bool:
        """Whether values are those of the image, without scale and bias."""
        return self.bias == NO_BIAS and self.scale == NO_SCALE

    @property
    def sampler(self) -> dict[str, int]:
        """The sampler of glTF with its wrap modes."""
        return {"wrapS": self.wraps[0], "wrapT": self.wraps[1]}


@dataclass
class GltfMaterialWriter:
    """Writes the materials of a stage to the header of a glTF file."""

    folder: Path
    header: dict[str, Any]
    buffer: reading.GlbBuffer
    note_counts: Counter[str]  # notes on what is left out, and how often each occurs
    files_read: list[str]  # files that were read
    # Materials by path; "" for prims without one.
    _materials: dict[str, BoundMaterial] = field(default_factory=dict)
    # Decoded images by file content and whether it is sRGB.
    _texels: dict[tuple[bytes, bool], Array] = field(default_factory=dict)

    def note(self, what: str) -> None:
        """Count a note on something that is left out: a predicate of the file."""
        self.note_counts[what] += 1

    def find_material(self, prim: Any) -> BoundMaterial:
        """Return the material of a prim, or its display color.

        A material for previews is preferred to one for all purposes. Each material is
        converted only once.
        """
        binding = UsdShade.MaterialBindingAPI(prim)
        material = (
            binding.ComputeBoundMaterial(UsdShade.Tokens.preview)[0]
            or binding.ComputeBoundMaterial()[0]
        )
        path = str(material.GetPath()) if material else ""
        if path not in self._materials:
            self._materials[path] = (
                self._convert(material) if material else self._make_default_material()
            )
        return self._materials[path]

    def _make_default_material(self) -> BoundMaterial:
        """Add the material of prims without one, whose color is their display color.

        The display color is a primvar of each mesh, so it is not known here: faces are
        tinted when the mesh is converted.
        """
        index = self._add_plain_material("displayColor", [*DEFAULT_COLOR, 1.0])
        color = PrimvarUse("displayColor", DEFAULT_COLOR)
        return BoundMaterial(
            index,
            color=color,
            opacity=PrimvarUse("displayOpacity", (1.0,)),
            is_default=True,
        )

    def add_material(self, entry: dict[str, Any]) -> int:
        """Add a two-sided material to the header, and return its index."""
        self.header["materials"].append({**entry, "doubleSided": True})
        return len(self.header["materials"]) - 1

    def make_tinted(
        self, bound: BoundMaterial, color: Sequence[float] | None, opacity: float | None
    ) -> int:
        """Return the index of a glTF material with another color and opacity.

        It is a changed copy of the bound material's entry, which is added unless there
        is an equal one. It is blended if its opacity is below 1.

        Args:
            bound: the material.
            color: (3,) linear, clipped to [0, 1]; None for the color of the material.
            opacity: clipped to [0, 1]; None for the opacity of the material.
        """
        entry = dict(self.header["materials"][bound.material_index])
        surface = dict(entry["pbrMetallicRoughness"])
        factor = list(surface["baseColorFactor"])
        if color is not None:
            factor[:3] = [min(max(float(channel), 0.0), 1.0) for channel in color]
        if opacity is not None:
            factor[3] = min(max(float(opacity), 0.0), 1.0)
        entry["pbrMetallicRoughness"] = {**surface, "baseColorFactor": factor}
        if factor[3] < 1.0 and "alphaMode" not in entry:
            entry["alphaMode"] = "BLEND"
        return self._find_or_add("materials", entry)

    def _convert(self, material: Any) -> BoundMaterial:
        """Convert a material.

        A material that is no preview surface becomes grey, with a note. The decoded
        images of the previous material are released.
        """
        name = str(material.GetPrim().GetName())
        self._texels.clear()  # they take memory
        shader = material.ComputeSurfaceSource()[0]
        if not shader or shader.GetIdAttr().Get() != PREVIEW_SURFACE:
            self.note("has a material that is no UsdPreviewSurface, which is grey here")
            return self._make_grey_material(name)
        return PreviewSurface(self, Shader.from_prim(shader), name).convert()

    def _make_grey_material(self, name: str) -> BoundMaterial:
        """Add a grey material of a name."""
        grey = [0.2140, 0.2140, 0.2140, 1.0]  # linear: 0.5 in sRGB; and opaque
        return BoundMaterial(self._add_plain_material(name, grey))

    def _add_plain_material(self, name: str, factor: list[float]) -> int:
        """Add a material without metal and textures, and return its index.

        Args:
            name: name of the material.
            factor: (4,) its linear color and its opacity.
        """
        surface = {
            "baseColorFactor": factor,
            "metallicFactor": 0.0,
            "roughnessFactor": DEFAULT_ROUGHNESS,
        }
        return self.add_material({"name": name, "pbrMetallicRoughness": surface})

    # ---- Images ----

    def load_image(self, asset: Any, name: str) -> bytes | None:
        """Return the bytes of an image in the folder; None, with a note, if missing.

        Links are followed before a path is tested, so that an image outside of the
        folder is not read. It may be in a package (`.usdz`) in the folder.

        Args:
            asset: the asset path.
            name: the material that uses it, for the note.
        """
        path = str(asset.path)
        resolved = str(asset.resolvedPath) or str(self.folder / path)
        outer, inner = Ar.SplitPackageRelativePathOuter(resolved)
        outer = os.path.realpath(outer)
        is_in_folder = reading.is_inside(outer, self.folder)
        data = _read_picture(outer, inner) if is_in_folder else None
        if data is None:
            reason = reading.MISSING if is_in_folder else reading.OUTSIDE
            self.note(f"the texture {path[:100]!r} of {name} {reason}")
            return None
        self.files_read.append(outer)
        return data

    def load_texels(self, use: UsdTextureUse) -> Array | None:
        """Return an image (H, W, 4) in linear values, before scale and bias.

        The result is None, with a note, if it cannot be decoded. Images are cached
        until the next material is converted, so that a material which uses one twice
        decodes it once.
        """
        key = (use.data, use.is_srgb)
        if key not in self._texels:
            texels = self._decode_texture(use)
            if texels is None:
                return None
            self._texels[key] = texels
        return self._texels[key]

    def _decode_texture(self, use: UsdTextureUse) -> Array | None:
        """Return the linear values (H, W, 4) of an image; None, with a note, if wrong."""
        try:
            return decode_image(use.data, use.path, is_srgb=use.is_srgb)
        except (
            OSError,
            ValueError,
            SyntaxError,
            EOFError,
            errors.FileFormatError,
        ) as error:
            self.note(
                f"the texture {use.path[:100]!r} cannot be read ({format_error(error)})"
            )
            return None

    def compute_values(self, use: UsdTextureUse | None) -> Array | None:
        """Return the values (H, W, C) of an image after scale and bias.

        The result is None for no image, and, with a note, if it cannot be decoded.
        """
        if use is None:
            return None
        texels = self.load_texels(use)
        if texels is None:
            return None
        scale = np.array(use.scale, np.float32)
        bias = np.array(use.bias, np.float32)
        return np.asarray((texels * scale + bias)[:, :, list(use.channels)])

    def add_image(self, levels: Array, sampler: Mapping[str, int]) -> int:
        """Add an image of display values in [0, 1], (H, W, 3 or 4).

        Returns the index of its texture.
        """
        clipped = np.clip(np.nan_to_num(levels), 0.0, 1.0)
        file = io.BytesIO()
        Image.fromarray(np.uint8(clipped * 255.0 + 0.5)).save(file, "PNG")
        return self.add_texture(file.getvalue(), sampler)

    def add_texture(self, data: bytes, sampler: Mapping[str, int]) -> int:
        """Add an image file with a sampler, and return the index of its texture."""
        entry = {
            "mimeType": reading.find_mime_type(data),
            "bufferView": self.buffer.add_view(data),
        }
        image = self._find_or_add("images", entry)
        return self._find_or_add(
            "textures",
            {"source": image, "sampler": self._find_or_add("samplers", sampler)},
        )

    def _find_or_add(self, kind: str, entry: Mapping[str, Any]) -> int:
        """Return the index of an entry of the header, which is added if it is new."""
        entries: list[Mapping[str, Any]] = self.header[kind]
        if entry not in entries:
            entries.append(entry)
        return entries.index(entry)


def _read_picture(path: str, inner: str) -> bytes | None:
    """Return the bytes of an image file, or None if there is none.

    Args:
        path: the file.
        inner: path of the image in that file if it is a package, otherwise "".
    """
    if not os.path.isfile(path):
        return None
    if not inner:
        return stored_files.read_bytes(
            Path(path), "a picture", stored_files.LARGEST_FILE
        )
    with contextlib.suppress(KeyError):  # it is not in the package
        return read_packaged(Ar.JoinPackageRelativePath(path, inner))
    return None


class _TextureInputs(NamedTuple):
    """The inputs of the shader of a texture.

    Attributes:
        asset: asset path of the image, or None.
        color_space: "raw", "sRGB", or "auto".
        scale: (4,) factors of the channels.
        bias: (4,) numbers that are added after scaling.
        layout: its texture coordinates.
        wraps: wrap modes along s and t, as in glTF.
        fallback: (4,) the color that replaces a missing image, or None.
    """

    asset: Any
    color_space: str
    scale: tuple[float, ...]
    bias: tuple[float, ...]
    layout: TextureLayout
    wraps: tuple[int, int]
    fallback: tuple[float, ...] | None


def _read_fallback(node: Shader) -> tuple[float, ...] | None:
    """Return the color (4,) that replaces a missing image; None if there is none."""
    if node.get_value("fallback") is None:
        return None
    return node.get_numbers("fallback", NO_SCALE)


class _BaseInputs(NamedTuple):
    """The base color and the opacity of a surface.

    Attributes:
        color: (3,) linear color if there is no texture of it.
        opacity: opacity if there is no texture of it.
        color_use: the texture of the color, or None.
        opacity_use: the texture of the opacity, or None.
    """

    color: tuple[float, ...]
    opacity: float
    color_use: UsdTextureUse | None
    opacity_use: UsdTextureUse | None


def _select_fallback(
    inputs: _TextureInputs, channels: Sequence[int]
) -> tuple[float, ...] | None:
    """Return the numbers, one for each channel, that replace a missing image, or None."""
    if inputs.fallback is None:
        return None
    return tuple(inputs.fallback[channel] for channel in channels)


def _is_input_without_effect(is_specular: bool, name: str, shader_input: Any) -> bool:
    """Return whether an input of a surface changes nothing.

    `is_specular` is whether the surface has a specular workflow.
    """
    if name == "specularColor" and not is_specular:
        return True  # only a specular workflow uses it
    producers = UsdShade.Utils.GetValueProducingAttributes(shader_input)
    if name not in NEUTRAL_VALUES:
        return len(producers) == 0  # it has no value
    neutral = NEUTRAL_VALUES[name]
    return all(_is_neutral(attribute, neutral) for attribute in producers)


@dataclass
class PreviewSurface:
    """Converts one preview surface to a glTF material.

    Attributes:
        surfaces: writes the material, and counts notes.
        shader: the preview surface.
        name: name of the material.
        layouts: its texture coordinates so far, by their index in glTF.
        nodes: shaders that are read, by path.
    """

    surfaces: GltfMaterialWriter
    shader: Shader
    name: str
    layouts: list[TextureLayout] = field(default_factory=list)
    nodes: dict[str, Shader] = field(default_factory=dict)

    def convert(self) -> BoundMaterial:
        """Write the material, and note the inputs that are not read.

        A specular workflow is read as a metallic one without metal.
        """
        is_specular = bool(self.shader.get_number("useSpecularWorkflow", 0.0))
        surface: dict[str, Any] = {}
        entry: dict[str, Any] = {"name": self.name, "pbrMetallicRoughness": surface}
        color_primvar, opacity_primvar = self._add_base(entry, surface)
        self._add_roughness_and_metallic(surface, is_specular=is_specular)
        self._add_normal(entry)
        self._add_emission(entry)
        self._note_simplifications(entry, is_specular=is_specular)
        self._note_unread(is_specular=is_specular)
        index = self.surfaces.add_material(entry)
        # `_make_slot` has added the layouts of all textures.
        layouts = tuple(self.layouts) or (TextureLayout(),)
        return BoundMaterial(
            index, layouts=layouts, color=color_primvar, opacity=opacity_primvar
        )

    def _note_simplifications(
        self, entry: dict[str, Any], *, is_specular: bool
    ) -> None:
        """Note a specular workflow, and an opacity that means transmission.

        `entry` is the complete glTF material.
        """
        if is_specular:
            self.surfaces.note(
                "has materials with a specular workflow, of which only the diffuse "
                "colour is read"
            )
        # The note about a clearcoat that is left out includes its roughness.
        self.shader.inputs.mark_read("clearcoatRoughness")
        opacity_mode = str(self.shader.get_value("opacityMode") or "presence")
        if opacity_mode != "presence" and entry.get("alphaMode") == "BLEND":
            self.surfaces.note(
                "has materials with opacityMode transparent; here the opacity also "
                "reduces highlights"
            )

    def _note_unread(self, *, is_specular: bool) -> None:
        """Note the inputs that are not read, of the surface and of its shaders.

        Inputs of the surface need no note if they have no value, or one that changes
        nothing.
        """
        is_without_effect = partial(_is_input_without_effect, is_specular)
        for name in self.shader.inputs.find_unread(is_without_effect):
            label = "an ior other than 1.5" if name == "ior" else name
            self.surfaces.note(f"has materials with {label[:100]}, which is left out")
        for node in self.nodes.values():
            unread = node.inputs.find_unread()
            if unread:
                self.surfaces.note(
                    f"has a {node.kind[:50]} with "
                    f"{reading.join_names(unread, 5)}, which is not "
                    "read"
                )

    # ---- Connections of inputs ----

    def _track_shader(self, source: Shader) -> Shader:
        """Return the tracked shader of the same prim, which is `source` at first.

        So the inputs that are read are recorded in one place, and `_note_unread` notes
        the others.
        """
        return self.nodes.setdefault(str(source.prim.GetPath()), source)

    def _find_primvar(
        self, name: str, kinds: Sequence[str], default: tuple[float, ...]
    ) -> PrimvarUse | None:
        """Return the primvar to which an input is connected, or None.

        Args:
            name: the input.
            kinds: ids of shaders that read primvars of the right type, such as
                "UsdPrimvarReader_float3"; for other shaders the result is None.
            default: the default of the input. Only its number of channels is used.
        """
        source = self.shader.find_source(name)
        if source is None:
            return None
        source_shader, _ = source
        if source_shader.kind not in kinds:
            return None
        reader = self._track_shader(source_shader)
        primvar = str(reader.get_value("varname") or "")
        return PrimvarUse(primvar, reader.get_numbers("fallback", [0.0] * len(default)))

    def _is_srgb(self, color_space: str, data: bytes) -> bool:
        """Return whether an image is in sRGB, by the shader or else by the image.

        `color_space` is the shader's: "raw", "sRGB", or "auto" if the file decides.
        """
        if color_space not in ("auto", "raw", "sRGB"):
            self.surfaces.note(
                f"has a texture with the sourceColorSpace {color_space[:50]!r}, which "
                "is read as auto"
            )
        if color_space in ("raw", "sRGB"):
            return color_space == "sRGB"
        return is_marked_srgb(data)

    def _find_texture(self, name: str) -> UsdTextureUse | tuple[float, ...] | None:
        """Return the texture to which an input is connected.

        Returns:
            The texture; or the numbers, one for each channel, that replace a missing
            image; or None if the input is not connected, or if its texture is left out,
            which is noted.
        """
        source = self.shader.find_source(name)
        if source is None:
            return None
        source_shader, output = source
        node = self._track_shader(source_shader)
        if node.kind != UV_TEXTURE:
            self.surfaces.note(f"has a {name} of {node.kind[:100]}, which is left out")
            return None
        # Inputs are read even if the texture is left out below, which has a note of its
        # own. Otherwise they would be noted as unread inputs, too.
        inputs = self._read_texture_inputs(node)
        if output not in CHANNELS:
            self.surfaces.note(
                f"has a {name} of the output {output[:50]!r} of a picture, which is "
                "left out"
            )
            return None
        return self._load_texture(name, inputs, CHANNELS[output])

    def _read_texture_inputs(self, node: Shader) -> _TextureInputs:
        """Return the inputs of the shader of a texture, which are marked as read."""
        return _TextureInputs(
            asset=node.get_value("file"),
            color_space=str(node.get_value("sourceColorSpace") or "auto"),
            scale=node.get_numbers("scale", NO_SCALE),
            bias=node.get_numbers("bias", NO_BIAS),
            layout=self._find_layout(node),
            wraps=self._read_wraps(node),
            fallback=_read_fallback(node),
        )

    def _load_texture(
        self, name: str, inputs: _TextureInputs, channels: Sequence[int]
    ) -> UsdTextureUse | tuple[float, ...] | None:
        """Return a texture with the bytes of its image.

        Args:
            name: the input of the surface.
            inputs: inputs of the texture's shader.
            channels: channels of the image that the surface uses.

        Returns:
            The texture; or the numbers, one for each channel, that replace a missing
            image; or None, with a note.
        """
        path = "" if inputs.asset is None else str(inputs.asset.path)
        data = self._load_image(inputs.asset, path, name)
        if data is None:  # `_load_image` has noted why
            return _select_fallback(inputs, channels)
        if channels == CHANNELS["a"] and data.startswith(EXR):
            self.surfaces.note(
                f"has a {name} of the alpha of an .exr picture, which is left out"
            )
            return None
        return UsdTextureUse(
            path=path,
            data=data,
            is_srgb=self._is_srgb(inputs.color_space, data),
            channels=channels,
            scale=inputs.scale,
            bias=inputs.bias,
            layout=inputs.layout,
            wraps=inputs.wraps,
        )

    def _find_texture_or_value(
        self, name: str, value: tuple[float, ...]
    ) -> tuple[UsdTextureUse | None, tuple[float, ...]]:
        """Return the texture to which an input is connected, if any, and a value.

        Args:
            name: the input.
            value: its value without a texture.

        Returns:
            The texture or None; and `value`, or the numbers that replace a missing
            image. The value is of use only without a texture.
        """
        # a texture, the numbers that replace a missing image, or None
        texture_or_numbers = self._find_texture(name)
        if isinstance(texture_or_numbers, tuple):
            return None, texture_or_numbers
        return texture_or_numbers, value

    def _load_image(self, asset: Any, path: str, name: str) -> bytes | None:
        """Return the bytes of the image of an input; None, with a note, if missing."""
        if "<UDIM>" in path:
            self.surfaces.note(
                "has UDIM textures, which are left out; export .obj, or join them to "
                "one texture"
            )
            return None
        if not path:
            self.surfaces.note(f"has a {name} of a picture without a file")
            return None
        return self.surfaces.load_image(asset, self.name)

    def _read_wraps(self, node: Shader) -> tuple[int, int]:
        """Return the wrap modes of a texture along s and t, as in glTF."""
        wraps = []
        for axis in ("wrapS", "wrapT"):
            mode = str(node.get_value(axis) or "useMetadata")
            if mode not in WRAP_MODES:
                self.surfaces.note(
                    f"has a texture with the {axis} {mode[:50]!r}, which is read as "
                    "repeat"
                )
            wraps.append(WRAP_MODES.get(mode, reading.gltf_entries.REPEAT))
        return wraps[0], wraps[1]

    def _find_layout(self, node: Shader) -> TextureLayout:
        """Return the texture coordinates of a texture: a primvar and its transforms.

        The shaders are followed from the texture back to the primvar. Texture
        coordinates go the other way, so the transform that is found last is applied
        first: it is the last factor of the matrix product. A shader of another kind is
        replaced by a reader of the primvar "st", with a note; transforms stay.

        Raises:
            FileFormatError: more than `MAX_SHADERS` shaders are connected one after the
                other.
        """
        matrix = np.eye(3)
        input_name = "st"
        for _ in range(MAX_SHADERS):
            source = node.find_source(input_name)
            if source is None:  # the input has a constant value
                return self._make_constant_layout(node, input_name, matrix)
            source_shader, _output = source
            node = self._track_shader(source_shader)
            if node.kind != TRANSFORM:
                return self._make_primvar_layout(node, matrix)
            matrix = matrix @ _compute_transform(node)
            input_name = "in"
        raise errors.FileFormatError(
            f"the material {self.name}: expected at most {MAX_SHADERS} shaders in a "
            "row, got more"
        )

    def _make_primvar_layout(self, node: Shader, matrix: Array) -> TextureLayout:
        """Return the layout of a texture with coordinates of a primvar.

        Args:
            node: the shader that reads the primvar; one of another kind is replaced by
                a reader of "st", with a note.
            matrix: (3, 3) the transforms after it.
        """
        matrix_rows = tuple(map(float, matrix[:2].ravel()))
        if node.kind in READERS_OF_COORDINATES:
            primvar = str(node.get_value("varname") or "st")
            s, t = node.get_numbers("fallback", (0.0, 0.0))
            return TextureLayout(primvar, fallback=(s, t), matrix=matrix_rows)
        self.surfaces.note(
            f"has a texture whose coordinates are from {node.kind[:100]}; st is "
            "used instead"
        )
        return TextureLayout("st", fallback=None, matrix=matrix_rows)

    def _make_constant_layout(
        self, node: Shader, input_name: str, matrix: Array
    ) -> TextureLayout:
        """Return the layout of a texture with constant coordinates, with a note.

        Its matrix multiplies texture coordinates by 0, and adds the transformed value.

        Args:
            node: the shader with the value.
            input_name: its input.
            matrix: (3, 3) the transforms after it.
        """
        self.surfaces.note(
            "has a texture without texture coordinates (st), which has the color of "
            "one texel"
        )
        s, t = node.get_numbers(input_name, (0.0, 0.0))
        u, v, _ = matrix @ np.array([s, t, 1.0])
        return TextureLayout(
            primvar="",
            fallback=(0.0, 0.0),
            matrix=(0.0, 0.0, float(u), 0.0, 0.0, float(v)),
        )

    def _make_slot(self, texture: int, layout: TextureLayout) -> dict[str, int]:
        """Return the entry that refers to a texture by its index, with a layout."""
        if layout not in self.layouts:
            self.layouts.append(layout)
        return {"index": texture, "texCoord": self.layouts.index(layout)}

    # ---- Properties of the material ----

    def _add_base(
        self, entry: dict[str, Any], surface: dict[str, Any]
    ) -> tuple[PrimvarUse | None, PrimvarUse | None]:
        """Fill in color and opacity.

        Each comes from a primvar (values of the mesh), a texture or a value. If a
        primvar replaces it, the value is written to the glTF material, and faces get
        copies of the material with the primvar's values. glTF has one texture for both,
        so an opacity texture with other texture coordinates than the color's is left
        out. If the material has an opacity threshold, the opacity is a mask; otherwise
        it is blended.

        Args:
            entry: the glTF material.
            surface: its pbrMetallicRoughness.

        Returns:
            The primvars that replace color and opacity, or None.
        """
        color_primvar = self._find_primvar(
            "diffuseColor", READERS_OF_COLORS, DEFAULT_COLOR
        )
        opacity_primvar = self._find_primvar("opacity", (READER_OF_NUMBERS,), (1.0,))
        base = self._read_base(color_primvar, opacity_primvar)
        threshold = self.shader.get_number("opacityThreshold", 0.0)
        has_opacity_map = self._fill_base_color(base, surface)
        opacity_factor = surface["baseColorFactor"][3]
        if has_opacity_map or opacity_factor < 1.0 or opacity_primvar is not None:
            _set_alpha_mode(entry, threshold)
        return color_primvar, opacity_primvar

    def _fill_base_color(self, base: _BaseInputs, surface: dict[str, Any]) -> bool:
        """Fill in the texture of color and opacity, and the factor (4,) of both.

        Args:
            base: the color and the opacity.
            surface: pbrMetallicRoughness of the glTF material.

        Returns:
            Whether the texture has the opacity.
        """
        texture, color_factor = self._add_base_texture(
            base.color_use, base.opacity_use, list(base.color)
        )
        if texture is not None:
            first_use = base.color_use or base.opacity_use
            assert first_use is not None
            surface["baseColorTexture"] = self._make_slot(texture, first_use.layout)
        has_opacity_map = texture is not None and base.opacity_use is not None
        opacity_factor = 1.0 if has_opacity_map else base.opacity
        factor = [min(max(part, 0.0), 1.0) for part in (*color_factor, opacity_factor)]
        surface["baseColorFactor"] = factor
        return has_opacity_map

    def _read_base(
        self, color_primvar: PrimvarUse | None, opacity_primvar: PrimvarUse | None
    ) -> _BaseInputs:
        """Return the values and textures of color and opacity.

        An input that a primvar replaces, if it is not None, has no texture.
        """
        color_use = None
        opacity_use = None
        color = self.shader.get_numbers("diffuseColor", DEFAULT_COLOR)
        opacity = self.shader.get_numbers("opacity", (1.0,))
        if color_primvar is None:
            color_use, color = self._find_texture_or_value("diffuseColor", color)
        if opacity_primvar is None:
            opacity_use, opacity = self._find_texture_or_value("opacity", opacity)
        opacity_use = self._drop_other_layout(opacity_use, color_use)
        # If the color is connected to one channel of a missing image, the fallback has
        # one number, a grey.
        color = tuple(map(float, np.broadcast_to(color, 3)))
        return _BaseInputs(color, opacity[0], color_use, opacity_use)

    def _drop_other_layout(
        self, opacity_use: UsdTextureUse | None, color_use: UsdTextureUse | None
    ) -> UsdTextureUse | None:
        """Return the texture of the opacity if it has the coordinates of the color's.

        Otherwise the result is None, with a note.
        """
        if opacity_use is None or color_use is None:
            return opacity_use
        if opacity_use.layout == color_use.layout:
            return opacity_use
        self.surfaces.note(
            "has an opacity with other texture coordinates than the "
            "colour's, which is left out"
        )
        return None

    def _add_base_texture(
        self,
        color_use: UsdTextureUse | None,
        opacity_use: UsdTextureUse | None,
        color: list[float],
    ) -> tuple[int | None, list[float]]:
        """Add the texture of color and opacity: the image itself, or a baked one.

        The image itself is used if its sRGB texels are only scaled, and if the opacity
        is its alpha or is not textured.

        Args:
            color_use: the texture of the color, or None.
            opacity_use: the texture of the opacity, or None.
            color: (3,) linear color if there is no texture of it.

        Returns:
            The index of the texture, or None; and the factor (3,) of its color, which
            is 1 for a baked one.
        """
        first_use = color_use or opacity_use
        if first_use is None:
            return None, color
        is_alpha_of_color = opacity_use is None or (
            color_use is not None and _is_alpha_of(opacity_use, color_use)
        )
        if color_use is not None and _is_scaled_texel(color_use) and is_alpha_of_color:
            texture = self.surfaces.add_texture(color_use.data, color_use.sampler)
            return texture, list(color_use.scale[:3])
        levels = self._bake(color_use, opacity_use, color)
        if levels is None:
            return None, color
        texture = self.surfaces.add_image(levels, first_use.sampler)
        return texture, [1.0, 1.0, 1.0]

    def _bake(
        self,
        color_use: UsdTextureUse | None,
        opacity_use: UsdTextureUse | None,
        factor: Sequence[float],
    ) -> Array | None:
        """Return display-referred values (H, W, 3 or 4) of color and opacity.

        Images of two sizes are both resized to the larger width and the larger height.
        The result is None if neither image can be read.

        Args:
            color_use: the texture of the color, or None.
            opacity_use: the texture of the opacity, or None.
            factor: (3,) linear color, used if there is no image of it.
        """
        colors = self.surfaces.compute_values(color_use)
        opacities = self.surfaces.compute_values(opacity_use)
        if colors is None:
            if opacities is None:
                return None
            shape = (*opacities.shape[:2], 3)
            colors = np.broadcast_to(np.array(factor, np.float32), shape)
        display_colors = color.linear_to_srgb(
            np.broadcast_to(colors, (*colors.shape[:2], 3)).astype(np.float32)
        )
        if opacities is None:
            return display_colors
        return _join_color_and_opacity(display_colors, opacities)

    def _add_roughness_and_metallic(
        self, surface: dict[str, Any], *, is_specular: bool
    ) -> None:
        """Fill in roughness and metallic of the glTF material.

        glTF has one image for both, in which each is a channel. If only one of them has
        an image, the number of the other one fills its channel.

        Args:
            surface: its pbrMetallicRoughness.
            is_specular: whether the material has the workflow without metals.
        """
        factor_by_name, plane_by_name, texture_use = self._find_planes()
        if is_specular:  # this workflow has no metals
            factor_by_name["metallic"] = 0.0
            plane_by_name.pop("metallic", None)
        if not plane_by_name or texture_use is None:
            surface["metallicFactor"] = factor_by_name["metallic"]
            surface["roughnessFactor"] = factor_by_name["roughness"]
            return
        packed = _pack_planes(plane_by_name, factor_by_name)
        texture = self.surfaces.add_image(packed, texture_use.sampler)
        # Factors multiply the image, which has the numbers already.
        surface["metallicFactor"] = 1.0
        surface["roughnessFactor"] = 1.0
        slot = self._make_slot(texture, texture_use.layout)
        surface["metallicRoughnessTexture"] = slot

    def _find_planes(
        self,
    ) -> tuple[dict[str, float], dict[str, Array], UsdTextureUse | None]:
        """Find the numbers and the images of roughness and metallic.

        An image with other texture coordinates than the first is replaced by its mean,
        and a primvar by its fallback, with a note.

        Returns:
            The numbers by name; the values (H, W) of images by name; and a texture with
            the coordinates and the wrap modes for these, None if there are no images.
            If both have an image, it is that of metallic.
        """
        factor_by_name: dict[str, float] = {}
        plane_by_name: dict[str, Array] = {}
        texture_use: UsdTextureUse | None = None
        for name, default in (("roughness", DEFAULT_ROUGHNESS), ("metallic", 0.0)):
            number, image = self._read_number_or_image(name, default)
            factor_by_name[name] = number
            if image is None:
                continue
            use, plane = image
            if texture_use is None or use.layout == texture_use.layout:
                plane_by_name[name] = plane
                texture_use = use
            else:
                factor_by_name[name] = float(plane.mean())
                self._note_mean(name)
        return factor_by_name, plane_by_name, texture_use

    def _note_mean(self, name: str) -> None:
        """Note that an image is replaced by its mean, since its coordinates differ."""
        self.surfaces.note(
            f"has a {name} with other texture coordinates, which is replaced by "
            "its mean"
        )

    def _read_number_or_image(
        self, name: str, default: float
    ) -> tuple[float, tuple[UsdTextureUse, Array] | None]:
        """Return the number of an input, and the image to which it is connected, if any.

        A primvar is replaced by its fallback, with a note. So is a missing image.

        Args:
            name: the input, "roughness" or "metallic".
            default: its value if the shader has none.

        Returns:
            The number; and None, or the texture and its values (H, W) in [0, 1].
        """
        number = self.shader.get_number(name, default)
        primvar = self._find_primvar(name, (READER_OF_NUMBERS,), (0.0,))
        if primvar is not None:
            self._note_fallback(name, primvar)
            return primvar.fallback[0], None
        use = self._find_texture(name)
        if isinstance(use, tuple):  # the number that replaces a missing image
            return use[0], None
        values = self.surfaces.compute_values(use)
        if use is None or values is None:
            return number, None
        self._note_srgb(name, use)
        return number, (use, np.clip(values[:, :, 0], 0.0, 1.0))

    def _note_fallback(self, name: str, primvar: PrimvarUse) -> None:
        """Note that an input has the fallback of a primvar, which is not read."""
        self.surfaces.note(
            f"has a {name} of the primvar {primvar.name[:50]!r}, which is replaced "
            "by its fallback"
        )

    def _note_srgb(self, name: str, use: UsdTextureUse) -> None:
        """Note that numbers are decoded from sRGB, unless they are an alpha."""
        if use.is_srgb and use.channels != CHANNELS["a"]:
            self.surfaces.note(
                f"has a {name} that is decoded from sRGB, as its sourceColorSpace "
                "states; write raw if it holds numbers"
            )

    def _note_constant_normal(self) -> None:
        """Note a normal that is no image, unless it is upright."""
        normal = self.shader.get_numbers("normal", UPRIGHT)
        if not np.allclose(normal, UPRIGHT, atol=1e-3):
            self.surfaces.note(
                "has materials with one normal everywhere, which is left out"
            )

    def _add_normal(self, entry: dict[str, Any]) -> None:
        """Fill in the normal map.

        An image of 8 bits is copied if its scale and bias are 2 and -1, as glTF
        implies. Others are decoded and written anew. A single normal for all of the
        surface, or an image of one channel, is left out with a note.

        Args:
            entry: the glTF material.
        """
        use = self._find_normal_texture()
        if use is None:
            return
        use = self._complete_normal_scale(use)
        if _has_implied_normal_scale(use) and is_of_8_bits(use.data):
            texture = self.surfaces.add_texture(use.data, use.sampler)
            entry["normalTexture"] = self._make_slot(texture, use.layout)
            return
        self._note_srgb("normal", use)
        normals = self.surfaces.compute_values(use)
        if normals is not None:
            # glTF stores a component n in [-1, 1] as (n + 1) / 2.
            texture = self.surfaces.add_image(normals * 0.5 + 0.5, use.sampler)
            entry["normalTexture"] = self._make_slot(texture, use.layout)

    def _find_normal_texture(self) -> UsdTextureUse | None:
        """Return the texture of the normals, or None; a normal left out is noted."""
        if self.shader.find_source("normal") is None:
            self._note_constant_normal()
            return None
        use = self._find_texture("normal")
        if isinstance(use, tuple) or use is None:
            return None
        if len(use.channels) != 3:
            self.surfaces.note(
                "has a normal of one channel of a picture, which is left out"
            )
            return None
        return use

    def _complete_normal_scale(self, use: UsdTextureUse) -> UsdTextureUse:
        """Return a normal map with the scale and bias that texels of 8 bits need.

        USD requires them, and many exporters leave them out. They are added, with a
        note, if there are none and the stored numbers are normals. Then the image is
        not sRGB, whatever the file states.
        """
        if not use.is_plain or not is_of_8_bits(use.data):
            return use
        raw_use = replace(use, is_srgb=False)
        texels = self.surfaces.load_texels(raw_use)
        if texels is None or not reading.has_normals(texels[:, :, :3]):
            return use
        self.surfaces.note(
            "has a normal map of 8 bits without scale (2, 2, 2, 1) and bias "
            "(-1, -1, -1, 0), which are added"
        )
        return replace(raw_use, scale=NORMAL_SCALE, bias=NORMAL_BIAS)

    def _add_emission(self, entry: dict[str, Any]) -> None:
        """Fill in the emission, whose factor may be larger than 1.

        An image whose sRGB texels are only scaled is copied; another one is written
        anew. An image that cannot be decoded, which is noted, leaves no emission.

        Args:
            entry: the glTF material.
        """
        black = (0.0, 0.0, 0.0)
        stated_color = self.shader.get_numbers("emissiveColor", black)
        use, plain_color = self._find_texture_or_value("emissiveColor", stated_color)
        # Without a texture the factor is the color. If a missing image is replaced by
        # the fallback of one of its channels, the color is a grey.
        factor: Sequence[float] = list(map(float, np.broadcast_to(plain_color, 3)))
        if use is not None:
            texture_and_factor = self._add_emission_texture(use)
            if texture_and_factor is None:
                return
            texture, factor = texture_and_factor
            entry["emissiveTexture"] = self._make_slot(texture, use.layout)
        _write_emission_factor(entry, [max(channel, 0.0) for channel in factor])

    def _add_emission_texture(
        self, use: UsdTextureUse
    ) -> tuple[int, Sequence[float]] | None:
        """Add the image of the emission; see `_add_emission`.

        Returns:
            The index of its texture, and the factor (3,) of its colors; None if it
            cannot be decoded.
        """
        if _is_scaled_texel(use, max_scale=math.inf):
            texture = self.surfaces.add_texture(use.data, use.sampler)
            return texture, use.scale[:3]
        values = self.surfaces.compute_values(use)
        if values is None:
            return None
        # The image is divided by its largest value, which becomes the factor.
        largest = max(float(np.maximum(np.nan_to_num(values), 0.0).max()), 1e-6)
        levels = _normalize_emission(values, largest)
        return self.surfaces.add_image(levels, use.sampler), [largest] * 3


def _has_implied_normal_scale(use: UsdTextureUse) -> bool:
    """Return whether a normal map has raw texels, and the scale 2 and bias -1 of glTF."""
    return (
        not use.is_srgb
        and use.scale[:3] == NORMAL_SCALE[:3]
        and use.bias[:3] == NORMAL_BIAS[:3]
    )


def _normalize_emission(values: Array, largest: float) -> Array:
    """Return emission (H, W, C), divided by a number, as display-referred colors.

    The result is (H, W, 3). Numbers below 0 and NaN are black.
    """
    radiance = np.maximum(np.nan_to_num(values), 0.0)
    rgb = np.broadcast_to(radiance, (*values.shape[:2], 3))
    return color.linear_to_srgb((rgb / largest).astype(np.float32))


def _join_color_and_opacity(colors: Array, opacities: Array) -> Array:
    """Return colors (H, W, 3) with opacities (h, w, C), the first channel, as a fourth.

    Images of two sizes are both resized to the larger width and the larger height.
    """
    if opacities.shape[:2] != colors.shape[:2]:
        width = max(opacities.shape[1], colors.shape[1])
        height = max(opacities.shape[0], colors.shape[0])
        opacities = _resize(opacities, (width, height))
        colors = _resize(colors, (width, height))
    return np.concatenate([colors, opacities[:, :, :1]], axis=2)


def _set_alpha_mode(entry: dict[str, Any], threshold: float) -> None:
    """Make the opacity of a glTF material a mask if there is a threshold above 0."""
    if threshold > 0.0:
        entry.update({"alphaMode": "MASK", "alphaCutoff": threshold})
    else:
        entry["alphaMode"] = "BLEND"


def _write_emission_factor(entry: dict[str, Any], factor: Sequence[float]) -> None:
    """Fill in the factor of the emission of a glTF material, unless it is black.

    glTF's factors are at most 1. If one is larger, all are divided by the largest one,
    which is written to an extension.
    """
    strength = max(factor)
    if strength <= 0.0:
        return
    entry["emissiveFactor"] = [channel / max(strength, 1.0) for channel in factor]
    if strength > 1.0:
        entry["extensions"] = {
            "KHR_materials_emissive_strength": {"emissiveStrength": strength}
        }


def _pack_planes(planes: Mapping[str, Array], factors: Mapping[str, float]) -> Array:
    """Return an image (H, W, 3) of roughness (green) and metallic (blue).

    The image has the size of the wider plane, or of the higher one if both are equally
    wide. Red is 1.

    Args:
        planes: values (h, w) in [0, 1], by "roughness" and "metallic".
        factors: numbers by the same names, used for a channel without a plane.
    """
    width, height = max((plane.shape[1], plane.shape[0]) for plane in planes.values())
    packed = np.ones((height, width, 3), np.float32)
    for channel, name in ((1, "roughness"), (2, "metallic")):
        packed[:, :, channel] = min(max(factors[name], 0.0), 1.0)
        if name in planes:
            packed[:, :, channel] = _resize(planes[name], (width, height))
    return packed


def _compute_transform(node: Shader) -> Array:
    """Return the matrix (3, 3) of a UsdTransform2d: scale, rotate, then translate."""
    scale = node.get_numbers("scale", (1.0, 1.0))
    shift = node.get_numbers("translation", (0.0, 0.0))
    angle = math.radians(node.get_number("rotation", 0.0))
    rotation = np.array(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    matrix = np.eye(3)
    matrix[:2, :2] = rotation @ np.diag(scale)
    matrix[:2, 2] = shift
    return matrix


def _is_scaled_texel(use: UsdTextureUse, max_scale: float = 1.0) -> bool:
    """Return whether colors are sRGB texels of 8 bits times factors up to `max_scale`.

    glTF has such textures, so that the image needs no conversion.
    """
    is_color = use.is_srgb and len(use.channels) == 3 and use.bias[:3] == NO_BIAS[:3]
    return (
        is_color
        and has_colors_of_8_bits(use.data)
        and all(0.0 <= scale <= max_scale for scale in use.scale[:3])
    )


def _is_alpha_of(opacity_use: UsdTextureUse, color_use: UsdTextureUse) -> bool:
    """Return whether an opacity is the alpha of the color's image, not scaled."""
    alpha = 3  # index of the channel
    is_unchanged_alpha = (
        opacity_use.channels == CHANNELS["a"]
        and opacity_use.scale[alpha] == 1.0
        and opacity_use.bias[alpha] == 0.0
    )
    has_same_image = opacity_use.data == color_use.data  # the bytes of the files
    return is_unchanged_alpha and has_same_image


def _resize(values: Array, size: tuple[int, int]) -> Array:
    """Return an image (H, W) or (H, W, C) resized to (width, height), bilinearly."""
    if values.ndim == 3:
        channels = [
            _resize(values[:, :, channel], size) for channel in range(values.shape[2])
        ]
        return np.stack(channels, axis=2)
    if (values.shape[1], values.shape[0]) == size:
        return values
    image = Image.fromarray(values.astype(np.float32))
    return np.asarray(image.resize(size, Image.Resampling.BILINEAR))
