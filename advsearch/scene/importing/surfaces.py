"""What the parts of a mesh file look like: textures, base colours, roughness and metallic."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt
from PIL import Image
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.images import TEXTURE_LIMIT, display_image

Floats = npt.NDArray[np.float32]

Named = dict[str | None, tuple[str, str]]

NEUTRAL = 0.5
"""Display-referred grey of an object without material."""

UNNAMED = "material_0"
"""The name that trimesh gives to a material that the file does not name."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What a part looks like; every colour is display-referred sRGB in [0, 1].

    Attributes:
        color: (3,) float32 base colour where there is no texture; None when the file gives none.
        texture: (H, W, 3) float32 base colour, row 0 on top; or None.
        roughness: in [0, 1], or None when the file gives none.
        metallic: in [0, 1], or None when the file gives none.
    """

    color: Floats | None = None
    texture: Floats | None = None
    roughness: float | None = None
    metallic: float | None = None

    def same_color(self, other: Surface) -> bool:
        """Tell whether two surfaces have the same base colour everywhere."""
        pairs = ((self.color, other.color), (self.texture, other.texture))
        return all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)


def plain_name(name: str) -> str:
    """Return a file name as it is written on this system: no quotes, no percent signs, forward slashes."""
    return unquote(name.strip().strip('"')).replace("\\", "/")


@dataclass
class SurfaceReader:
    """Turns the materials of one file, as trimesh parsed them, into surfaces; each material once.

    Attributes:
        source: the file's name, for warnings.
        named: for each material that names a texture: the file that names it, and the texture's name.
        missing: names of files, as `plain_name` gives them, that were looked for and are not there.
        notes: the warnings so far.
    """

    source: str
    named: Named
    missing: set[str]
    notes: list[str] = field(default_factory=list)
    _known: dict[int, Surface] = field(default_factory=dict)

    def surface(self, visual: Any) -> Surface:
        """Return the surface of a parsed mesh's visual; an empty one where the file gives no material."""
        material = getattr(visual, "material", None)
        if id(material) not in self._known:
            self._known[id(material)] = self._read(material)
        return self._known[id(material)]

    def _read(self, material: Any) -> Surface:
        if isinstance(material, PBRMaterial):
            return self._gltf(material)
        if isinstance(material, SimpleMaterial):
            # The Kd of a textured material is an exporter's default more often than a tint: the texture stands alone.
            color = _color(material.kwargs.get("kd"))
            texture = self._texture(material, material.image, color)
            return Surface(_unless_white(color, material, self.named), texture)
        return Surface()

    def _gltf(self, material: PBRMaterial) -> Surface:
        """Follow glTF 2.0, section 3.9.2: linear factors multiply the textures. Unlike there, no metal by default."""
        given = material.baseColorFactor
        factor = (
            np.ones(3, np.float32) if given is None else np.asarray(given[:3], dtype=np.float32) / np.float32(255.0)
        )
        color = linear_to_srgb(factor)
        texture = self._texture(material, material.baseColorTexture, color)
        if texture is not None and (factor != 1.0).any():
            texture = linear_to_srgb(srgb_to_linear(texture) * factor)
        roughness, metallic = material.roughnessFactor, material.metallicFactor
        packed = self._decoded(material.metallicRoughnessTexture, None)
        if packed is not None:
            self._note(f"{self.source}: textures of roughness and metallic are replaced by their means")
            green, blue = packed[:, :, 1].mean(), packed[:, :, 2].mean()
            roughness = float(green) * (1.0 if roughness is None else roughness)
            metallic = float(blue) * (1.0 if metallic is None else metallic)
        return Surface(_unless_white(color, material, self.named), texture, _unit(roughness), _unit(metallic))

    def _texture(self, material: Any, image: Image.Image | None, color: Floats | None) -> Floats | None:
        """Return the base colour texture; where the material names one that cannot be had, warn."""
        texture = self._decoded(image)
        if texture is not None:
            return texture
        if material.name in self.named:
            file, name = self.named[material.name]
            why = "is missing" if plain_name(name) in self.missing else "cannot be read as a picture"
            kept = _unless_white(color, material, self.named)
            instead = "neutral grey" if kept is None else f"its base colour ({', '.join(f'{c:.2f}' for c in kept)})"
            where = "" if file == self.source else f"{self.source}: "
            self._note(f"{where}{file} names the texture {name!r}, which {why}; {instead} is used instead")
        return None

    def _decoded(self, image: Image.Image | None, limit: int | None = TEXTURE_LIMIT) -> Floats | None:
        """Return a picture's values, or None where there is none; a picture without format is trimesh's invention."""
        if image is None or image.format is None:
            return None
        try:
            return display_image(image, limit)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            return None

    def _note(self, message: str) -> None:
        if message not in self.notes:
            self.notes.append(message)


def _color(given: Any) -> Floats | None:
    """Return a material file's colour as (3,) float32, clipped to [0, 1]; None unless it is one or three numbers."""
    values = np.atleast_1d(np.asarray(given if given is not None else [], dtype=np.float32))
    if values.shape not in ((1,), (3,)) or not np.isfinite(values).all():
        return None
    return np.clip(np.broadcast_to(values, (3,)), 0.0, 1.0).astype(np.float32)


def _unless_white(color: Floats | None, material: Any, named: Named) -> Floats | None:
    """Return a base colour, or None for the plain white of a textured material: that only leaves its texture alone."""
    if color is not None and material.name in named and (color > 0.999).all():
        return None
    return color


def _unit(value: float | None) -> float | None:
    """Clip a factor to [0, 1]; None and NaN become None."""
    return None if value is None or value != value else min(max(float(value), 0.0), 1.0)
