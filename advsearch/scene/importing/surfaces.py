"""What the parts of a mesh file look like: textures, base colours, roughness and metallic."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing import gltf
from advsearch.scene.importing.files import shown
from advsearch.scene.importing.gltf_entries import CUT_OUTS, CUTOFF, Header, MaterialEntry, NormalUse
from advsearch.scene.importing.material_lines import color_of, last_number, radiance_of, scale_and_name
from advsearch.scene.importing.normal_maps import holds_normals, normal_map
from advsearch.scene.importing.pictures import Pictures
from advsearch.scene.importing.references import Named

if TYPE_CHECKING:
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

Floats = npt.NDArray[np.float32]

NEUTRAL = 0.5
"""Display-referred grey of an object without material."""

UNNAMED = "material_0"
"""The name that trimesh gives to a material that the file does not name."""


BRIGHTEST = 1e5
"""Largest radiance that a surface may emit; white in the light of a bundled environment is about 1."""


@dataclass(frozen=True, eq=False)
class ImportedSurface:
    """What a part looks like; every colour is display-referred sRGB in [0, 1].

    Attributes:
        color: (3,) float32 base colour where there is no texture; None when the file gives none. Where light passes
            through the part, (4,) with its opacity in [0, 1].
        texture: (H, W, 3) float32 base colour, row 0 on top, or (H, W, 4) with the opacity; or None.
        roughness: in [0, 1], or None when the file gives none.
        metallic: in [0, 1], or None when the file gives none.
        normal_map: (H, W, 3) float32 of `advsearch.scene.importing.normal_maps`, row 0 on top; or None.
        emission: (H, W, 3) float32 linear radiance, row 0 on top; (1, 1, 3) where it is the same everywhere, None where
            there is none.
        name: of the material in the file; empty where it has none.
    """

    color: Floats | None = None
    texture: Floats | None = None
    roughness: float | None = None
    metallic: float | None = None
    normal_map: Floats | None = None
    emission: Floats | None = None
    name: str = ""

    @property
    def pictures(self) -> tuple[Floats, ...]:
        """What is looked up by texture coordinates."""
        glow = None if self.emission is None or self.emission.shape == (1, 1, 3) else self.emission
        return tuple(one for one in (self.texture, self.normal_map, glow) if one is not None)

    def same_maps(self, other: ImportedSurface) -> bool:
        """Tell whether two surfaces have the same base colour, normal map and emission everywhere."""
        ours = (self.color, self.texture, self.normal_map, self.emission)
        pairs = zip(ours, (other.color, other.texture, other.normal_map, other.emission), strict=True)
        return all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)


@dataclass
class SurfaceReader:
    """Turns the materials of one file, as trimesh parsed them, into surfaces; each material once.

    Attributes:
        source: the file's name, for warnings.
        named: for each material that names a texture: the file that names it, and the texture's name.
        pictures: decodes those that it names.
        header: of a glTF file; None of others.
        notes: the warnings so far.
    """

    source: str
    named: Named
    pictures: Pictures
    header: Header | None = None
    notes: list[str] = field(default_factory=list)
    _known: dict[int, ImportedSurface] = field(default_factory=dict)

    def surface(self, visual: Any) -> ImportedSurface:
        """Return the surface of a parsed mesh's visual; an empty one where the file gives no material."""
        material = getattr(visual, "material", None)
        if id(material) not in self._known:
            self._known[id(material)] = replace(self._read(material), name=self._name(material))
        return self._known[id(material)]

    def _name(self, material: Any) -> str:
        name = getattr(material, "name", None)
        if self.header is None:
            return "" if name in (None, UNNAMED) else str(name)
        entry = gltf.entry_of(self.header, name)
        return "" if entry is None else entry.name or str(name)

    def _read(self, material: Any) -> ImportedSurface:
        from trimesh.visual.material import PBRMaterial, SimpleMaterial

        if isinstance(material, PBRMaterial):
            return self._gltf(material)
        if isinstance(material, SimpleMaterial):
            # The Kd of a textured material is an exporter's default more often than a tint: the texture stands alone.
            color = color_of(material.kwargs.get("kd"))
            texture = self._texture(material, material.image, color)
            found = ImportedSurface(_unless_white(color, material, self.named), texture)
            found = replace(self._see_through(material, found), normal_map=self._bumps(material))
            return replace(found, emission=self._glow(material))
        return ImportedSurface()

    def _see_through(self, material: SimpleMaterial, surface: ImportedSurface) -> ImportedSurface:
        """Give a surface the opacity that a material file says by ``d``, a number, and ``map_d``, a picture: its alpha,
        or its grey where it has none."""
        factor, map = last_number(material.kwargs.get("d"), 1.0), self._opacity(material)
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
        found = self.pictures.of_file(name, "colours and alpha")
        if isinstance(found, np.ndarray):
            return found[:, :, 3] if found[:, :, 3].min() < 1.0 else found[:, :, :3].mean(axis=2)
        self._note(f"{self.source}: the opacity {shown(name)} {found}; it is opaque instead")
        return None

    def _bumps(self, material: SimpleMaterial) -> Floats | None:
        """The normal map of a material file: ``norm``, or ``map_Bump`` or ``bump`` where these hold normals."""
        for key in ("norm", "map_bump", "bump"):
            scale, name = scale_and_name(material.kwargs.get(key) or [])
            if not name:
                continue
            picture = self.pictures.of_file(name, "numbers")
            if isinstance(picture, np.ndarray):
                if key == "norm" or holds_normals(picture):
                    return normal_map(picture, scale)
                picture = "holds heights, and no normals"
            self._without_normals(name, picture)
        return None

    def _without_normals(self, name: str, why: str) -> None:
        self._note(f"{self.source}: the normal map {shown(name)} {why}; it is left out")

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
        packed = self.pictures.decoded(material.metallicRoughnessTexture)
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
        found = ImportedSurface(kept, texture, _unit(roughness), _unit(metallic))
        entry = None if self.header is None else gltf.entry_of(self.header, material.name)
        if self.header is None or entry is None:
            return found
        normals = self._normals(self.header, entry.plain().normalTexture, material.normalTexture)
        return replace(found, normal_map=normals, emission=self._emission(self.header, entry, material))

    def _normals(self, header: Header, use: NormalUse | None, image: Image.Image | None) -> Floats | None:
        """The normal map of a glTF material; warn where it cannot be had."""
        if use is None:
            return None
        found = self.pictures.decoded(image, "numbers")
        if isinstance(found, np.ndarray):
            return normal_map(found, use.scale)
        name = gltf.image_name(header, use) or ""
        self._without_normals(name, self.pictures.why(name, found))
        return None

    def _emission(self, header: Header, entry: MaterialEntry, material: PBRMaterial) -> Floats | None:
        """The radiance of a glTF material (section 3.9.3, and KHR_materials_emissive_strength), in the unit of
        environments, as Blender has it."""
        factor = np.array(entry.emission)
        if not factor.any() or (entry.emissiveTexture is not None and entry.plain().emissiveTexture is None):
            return None
        if entry.emissiveTexture is None:
            return self._radiance(factor)
        found = self.pictures.decoded(material.emissiveTexture)
        if isinstance(found, np.ndarray):
            return self._radiance(factor, found)
        name = gltf.image_name(header, entry.emissiveTexture) or ""
        self._without_emission(name, self.pictures.why(name, found))
        return None

    def _glow(self, material: SimpleMaterial) -> Floats | None:
        """The radiance that a material file says by ``Ke`` and ``map_Ke``; where it has both, their product."""
        words, name = material.kwargs.get("ke") or [], " ".join(material.kwargs.get("map_ke") or [])
        factor = radiance_of(words)
        if factor is None:
            self._note(f"{self.source}: the emission {shown(' '.join(words))} is no colour; it is left out")
            return None
        if not name:
            return self._radiance(factor)
        found = self.pictures.of_file(name, "colours")
        if isinstance(found, np.ndarray):
            return self._radiance(factor if factor.any() else np.ones(3), found)
        self._without_emission(name, found)
        return None

    def _radiance(self, factor: npt.NDArray[np.float64], picture: Floats | None = None) -> Floats | None:
        """Return a factor (3,) times the linear values of a picture (H, W, 3); None where it is dark."""
        if factor.max() > BRIGHTEST:
            self._note(f"{self.source}: emission brighter than {BRIGHTEST:g} is cut to that")
            factor = np.minimum(factor, BRIGHTEST)
        linear = np.ones((1, 1, 3), np.float32) if picture is None else srgb_to_linear(picture)
        found = (linear * factor).astype(np.float32)
        return found if found.any() else None

    def _without_emission(self, name: str, why: str) -> None:
        self._note(f"{self.source}: the texture {shown(name)} of the emission {why}; it is left out")

    def _texture(
        self, material: Any, image: Image.Image | None, color: Floats | None, *, alpha: bool = False
    ) -> Floats | None:
        """Return the base colour texture; where the material names one that cannot be had, warn."""
        texture = self.pictures.decoded(image, "colours and alpha" if alpha else "colours")
        if isinstance(texture, np.ndarray):
            return texture
        if material.name in self.named:
            file, name = self.named[material.name]
            why = self.pictures.why(name, texture)
            kept = _unless_white(color, material, self.named)
            instead = "neutral grey" if kept is None else f"its base colour ({', '.join(f'{c:.2f}' for c in kept)})"
            where = "" if file == self.source else f"{self.source}: "
            self._note(f"{where}{file} names the texture {shown(name)}, which {why}; {instead} is used instead")
        return None

    def _note(self, message: str) -> None:
        if message not in self.notes:
            self.notes.append(message)


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


def _unit(value: float | None) -> float | None:
    """Clip a factor to [0, 1]; None and NaN become None."""
    return None if value is None or value != value else min(max(float(value), 0.0), 1.0)
