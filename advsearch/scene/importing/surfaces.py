"""What the parts of a mesh file look like: textures, base colours, roughness and metallic."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import shown
from advsearch.scene.importing.gltf_entries import CUT_OUTS, CUTOFF
from advsearch.scene.importing.images import FORMATS, LARGEST_PIXELS, TEXTURE_LIMIT, check_pixels, display_image
from advsearch.scene.importing.references import Named, plain_name

if TYPE_CHECKING:
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

Floats = npt.NDArray[np.float32]

LARGEST_SUM = 2 * LARGEST_PIXELS
"""Pixels that the textures of a file may have in all, before `advsearch.files.scaled`."""

MOST_TEXTURES = 16
"""Materials whose textures are kept at `TEXTURE_LIMIT`; more are baked into one map, for which less will do."""

NEUTRAL = 0.5
"""Display-referred grey of an object without material."""

UNNAMED = "material_0"
"""The name that trimesh gives to a material that the file does not name."""


@dataclass(frozen=True, eq=False)
class ImportedSurface:
    """What a part looks like; every colour is display-referred sRGB in [0, 1].

    Attributes:
        color: (3,) float32 base colour where there is no texture; None when the file gives none. Where light passes
            through the part, (4,) with its opacity in [0, 1].
        texture: (H, W, 3) float32 base colour, row 0 on top, or (H, W, 4) with the opacity; or None.
        roughness: in [0, 1], or None when the file gives none.
        metallic: in [0, 1], or None when the file gives none.
    """

    color: Floats | None = None
    texture: Floats | None = None
    roughness: float | None = None
    metallic: float | None = None

    def same_color(self, other: ImportedSurface) -> bool:
        """Tell whether two surfaces have the same base colour everywhere."""
        pairs = ((self.color, other.color), (self.texture, other.texture))
        return all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)


@dataclass
class SurfaceReader:
    """Turns the materials of one file, as trimesh parsed them, into surfaces; each material once.

    Attributes:
        source: the file's name, for warnings.
        named: for each material that names a texture: the file that names it, and the texture's name.
        refused: for names of files, as `plain_name` gives them, why they were not read.
        materials: how many the file has.
        read: returns the content of a file that it names; raises FileNotFoundError.
        notes: the warnings so far.
    """

    source: str
    named: Named
    refused: Mapping[str, str]
    materials: int
    read: Callable[[str], bytes]
    notes: list[str] = field(default_factory=list)
    _known: dict[int, ImportedSurface] = field(default_factory=dict)
    _pictures: dict[tuple[int, bool], Floats | str] = field(default_factory=dict)
    _opened: list[Image.Image] = field(default_factory=list)
    _pixels: int = 0

    def surface(self, visual: Any) -> ImportedSurface:
        """Return the surface of a parsed mesh's visual; an empty one where the file gives no material."""
        material = getattr(visual, "material", None)
        if id(material) not in self._known:
            self._known[id(material)] = self._read(material)
        return self._known[id(material)]

    def _read(self, material: Any) -> ImportedSurface:
        from trimesh.visual.material import PBRMaterial, SimpleMaterial

        if isinstance(material, PBRMaterial):
            return self._gltf(material)
        if isinstance(material, SimpleMaterial):
            # The Kd of a textured material is an exporter's default more often than a tint: the texture stands alone.
            color = _color(material.kwargs.get("kd"))
            texture = self._texture(material, material.image, color)
            return self._see_through(material, ImportedSurface(_unless_white(color, material, self.named), texture))
        return ImportedSurface()

    def _see_through(self, material: SimpleMaterial, surface: ImportedSurface) -> ImportedSurface:
        """Give a surface the opacity that a material file says by ``d``, a number, and ``map_d``, a picture: its alpha,
        or its grey where it has none."""
        factor, map = _last_number(material.kwargs.get("d"), 1.0), self._opacity(material)
        if map is None and factor == 1.0:
            return surface
        share, color, texture = np.array([factor], np.float32), surface.color, surface.texture
        if map is not None:
            plain = np.full(3, NEUTRAL, np.float32) if color is None else color
            texture = np.broadcast_to(plain, (*map.shape, 3)) if texture is None else texture
            size = (texture.shape[1], texture.shape[0])
            fitted = np.asarray(Image.fromarray(map).resize(size, Image.Resampling.BILINEAR))
            texture = np.concatenate([texture, fitted[:, :, None]], axis=2)
        return replace(surface, color=_with_opacity(color, share, None), texture=_with_opacity(texture, share, None))

    def _opacity(self, material: SimpleMaterial) -> Floats | None:
        """The (H, W) opacity in [0, 1] that a material's ``map_d`` holds; warn where it cannot be had."""
        name = " ".join(material.kwargs.get("map_d") or [])
        if not name:
            return None
        try:
            image = Image.open(io.BytesIO(self.read(name)), formats=FORMATS)
            found = self._decoded(image, alpha=True)
            self._opened.append(image)  # what is decoded is known by its identity
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            found = None
        if isinstance(found, np.ndarray):
            return found[:, :, 3] if found[:, :, 3].min() < 1.0 else found[:, :, :3].mean(axis=2)
        why = self.refused.get(plain_name(name)) or found or "cannot be read as a picture"
        self._note(f"{self.source}: the opacity {shown(name)} {why}; it is opaque instead")
        return None

    def _gltf(self, material: PBRMaterial) -> ImportedSurface:
        """Follow glTF 2.0, sections 3.9.2 and 3.9.4: linear factors multiply the textures, and alpha is opacity. Unlike
        there, no metal by default."""
        given = material.baseColorFactor
        scaled = np.ones(4, np.float32) if given is None else np.asarray(given, dtype=np.float32) / np.float32(255.0)
        factor, alpha = scaled[:3], material.alphaMode in CUT_OUTS
        color = linear_to_srgb(factor)
        texture = self._texture(material, material.baseColorTexture, color, alpha=alpha)
        if texture is not None and (factor != 1.0).any():
            tinted = linear_to_srgb(srgb_to_linear(texture[:, :, :3]) * factor)
            texture = np.concatenate([tinted, texture[:, :, 3:]], axis=2)
        roughness, metallic = material.roughnessFactor, material.metallicFactor
        packed = self._decoded(material.metallicRoughnessTexture)
        if isinstance(packed, np.ndarray):
            self._note(f"{self.source}: textures of roughness and metallic are replaced by their means")
            green, blue = packed[:, :, 1].mean(), packed[:, :, 2].mean()
            roughness = float(green) * (1.0 if roughness is None else roughness)
            metallic = float(blue) * (1.0 if metallic is None else metallic)
        kept = _unless_white(color, material, self.named)
        if alpha:
            under = material.alphaCutoff
            cutoff = None if material.alphaMode == "BLEND" else CUTOFF if under is None else under
            kept, texture = _with_opacity(color, scaled[3:], cutoff), _with_opacity(texture, scaled[3:], cutoff)
        return ImportedSurface(kept, texture, _unit(roughness), _unit(metallic))

    def _texture(
        self, material: Any, image: Image.Image | None, color: Floats | None, *, alpha: bool = False
    ) -> Floats | None:
        """Return the base colour texture; where the material names one that cannot be had, warn."""
        texture = self._decoded(image, alpha=alpha)
        if isinstance(texture, np.ndarray):
            return texture
        if material.name in self.named:
            file, name = self.named[material.name]
            why = self.refused.get(plain_name(name)) or texture or "cannot be read as a picture"
            kept = _unless_white(color, material, self.named)
            instead = "neutral grey" if kept is None else f"its base colour ({', '.join(f'{c:.2f}' for c in kept)})"
            where = "" if file == self.source else f"{self.source}: "
            self._note(f"{where}{file} names the texture {shown(name)}, which {why}; {instead} is used instead")
        return None

    def _decoded(self, image: Image.Image | None, *, alpha: bool = False) -> Floats | str | None:
        """Return a picture's values, why there are none, or None; a picture without format is trimesh's invention."""
        if image is None or image.format is None:
            return None
        key = id(image), alpha
        if key not in self._pictures:
            self._pictures[key] = self._pixels_of(image, alpha)
        return self._pictures[key]

    def _pixels_of(self, image: Image.Image, alpha: bool) -> Floats | str:
        """Decode a picture, or say why not."""
        width, height = image.size
        try:
            check_pixels("", width, height)
            self._check_sum(self._pixels + width * height)
            texture = display_image(image, _side(self.materials), "", alpha=alpha)
        except FileFormatError as error:
            return f"is not read ({str(error).removeprefix(': ')})"
        except (OSError, ValueError, SyntaxError, EOFError):
            return "cannot be read as a picture"
        self._pixels += width * height
        return texture

    @staticmethod
    def _check_sum(pixels: int) -> None:
        """Refuse a picture that is too much with those before it."""
        most = files.scaled(LARGEST_SUM)
        if pixels > most:
            raise files.too_large("", f"pictures of at most {most:,} pixels", f"{pixels:,} in all")

    def _note(self, message: str) -> None:
        if message not in self.notes:
            self.notes.append(message)


def _side(materials: int) -> int:
    """Return the longest side of the textures of so many materials; all together they take a bounded memory."""
    side = TEXTURE_LIMIT
    while side > 64 and materials * side * side > MOST_TEXTURES * TEXTURE_LIMIT * TEXTURE_LIMIT:
        side //= 2
    return side


def _color(given: Any) -> Floats | None:
    """Return a material file's colour as (3,) float32, clipped to [0, 1]; None unless it is one or three numbers."""
    values = np.atleast_1d(np.asarray(given if given is not None else [], dtype=np.float32))
    if values.shape not in ((1,), (3,)) or not np.isfinite(values).all():
        return None
    return np.clip(np.broadcast_to(values, (3,)), 0.0, 1.0).astype(np.float32)


def _with_opacity(color: Floats | None, factor: Floats, cutoff: float | None) -> Floats | None:
    """Return a base colour (..., 3 or 4) with its opacity, or as (..., 3) where it is opaque.

    Args:
        color: with or without alpha; None stays None.
        factor: (1,) of alpha.
        cutoff: the alpha from which it is opaque, and under which there is nothing; None for shares in between.
    """
    if color is None:
        return None
    opacity = (color[..., 3:] if color.shape[-1] == 4 else np.ones_like(color[..., :1])) * factor
    if cutoff is not None:
        opacity = (opacity >= cutoff).astype(np.float32)
    return color[..., :3] if opacity.min() >= 1.0 else np.concatenate([color[..., :3], opacity], axis=-1)


def _unless_white(color: Floats | None, material: Any, named: Named) -> Floats | None:
    """Return a base colour, or None for the plain white of a textured material: that only leaves its texture alone."""
    if color is not None and material.name in named and (color > 0.999).all():
        return None
    return color


def _last_number(words: list[str] | None, otherwise: float) -> float:
    """Return the last word of a line as a number in [0, 1], or what holds otherwise."""
    try:
        number = float((words or [""])[-1])
    except ValueError:
        return otherwise
    return min(max(number, 0.0), 1.0) if math.isfinite(number) else otherwise


def _unit(value: float | None) -> float | None:
    """Clip a factor to [0, 1]; None and NaN become None."""
    return None if value is None or value != value else min(max(float(value), 0.0), 1.0)
