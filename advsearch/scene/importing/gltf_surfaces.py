"""What the materials of a glTF file look like (glTF 2.0, section 3.9), and how their textures go on (section 3.8.4)."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.pictures import FORMATS
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import References, shown
from advsearch.scene.importing.gltf import Buffers
from advsearch.scene.importing.gltf_entries import (
    CLAMPED,
    CUT_OUTS,
    MIRRORED,
    NEAREST,
    Header,
    MaterialEntry,
    Sampler,
    TextureUse,
)
from advsearch.scene.importing.normal_maps import normal_map
from advsearch.scene.importing.pictures import Kind, Pictures
from advsearch.scene.importing.surfaces import ImportedSurface, limited_radiance, unit, with_opacity

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Fit = Callable[[Array], Array]
"""Takes texture coordinates (V, 2) of the format to those of the pictures that were made."""

BEYOND = 1e-4
"""How far texture coordinates may lie outside of a texture before it matters how that goes on."""
SMALL = 256
"""Texels a side up to which half a texel at an edge is seen."""

EDGES = " has textures that do not repeat beyond their edges; where they differ, or reach far, they do here"
BLURRED = " has textures with sharp texels (filter NEAREST); those above {most} texels a side are filtered"


@dataclass
class GltfSurfaces:
    """Turns the materials of one file into surfaces.

    Attributes:
        source: the file's name, for warnings.
        header: of the file.
        buffers: reads its pictures.
        references: the files that it names.
        notes: the warnings so far.
    """

    source: str
    header: Header
    buffers: Buffers
    references: References
    notes: list[str] = field(default_factory=list)
    _opened: dict[tuple[str | None, int | None], Image.Image | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._pictures = Pictures(len(self.header.materials), self.references.get, self.references.refused)

    def surface(self, number: int | None, uvs: Sequence[Array]) -> tuple[ImportedSurface, Fit]:
        """Return the surface of a material, and how texture coordinates fit its pictures.

        Args:
            number: of the material; None for the format's default.
            uvs: all texture coordinates (V, 2) by which it is looked up.
        """
        material = MaterialEntry() if number is None else self.header.materials[number]
        given = material.surface
        scaled = np.array([1.0] * 4 if given.baseColorFactor is None else given.baseColorFactor, np.float32).clip(0, 1)
        factor, alpha = scaled[:3], material.alphaMode in CUT_OUTS
        color = linear_to_srgb(factor)
        textured = given.baseColorTexture is not None and bool((color > 0.999).all())
        instead = "neutral grey" if textured else f"its base colour ({', '.join(f'{c:.2f}' for c in color)})"
        texture = self._picture(
            given.baseColorTexture,
            "colours and alpha" if alpha else "colours",
            " names the texture {name}, which {why}; " + instead + " is used instead",
        )
        if texture is not None and (factor != 1.0).any():
            tinted = linear_to_srgb(srgb_to_linear(texture[:, :, :3]) * factor)
            texture = np.concatenate([tinted, texture[:, :, 3:]], axis=2)
        kept: Floats | None = None if textured else color
        if alpha:
            cutoff = None if material.alphaMode == "BLEND" else material.alphaCutoff
            kept, texture = with_opacity(kept, scaled[3:], cutoff), with_opacity(texture, scaled[3:], cutoff)
        roughness, metallic = given.roughnessFactor, given.metallicFactor
        packed = self._picture(
            given.metallicRoughnessTexture,
            "numbers",
            ": the texture {name} of roughness and metallic {why}; it is left out",
        )
        if packed is not None:
            self._note(": textures of roughness and metallic are replaced by their means")
            roughness, metallic = roughness * float(packed[:, :, 1].mean()), metallic * float(packed[:, :, 2].mean())
        normals = None
        if material.normalTexture is not None and material.reads(material.normalTexture):
            words = ": the normal map {name} {why}; it is left out"
            normals = self._picture(material.normalTexture, "numbers", words)
            normals = None if normals is None else normal_map(normals, material.normalTexture.scale)
        name = "" if number is None else material.name or f"material {number}"
        found = ImportedSurface(kept, texture, unit(roughness), unit(metallic), normals, self._emission(material), name)
        return self._fitted(found, material, uvs)

    def _emission(self, material: MaterialEntry) -> Floats | None:
        """The radiance of a material (section 3.9.3, and KHR_materials_emissive_strength), in the unit of
        environments, as Blender has it."""
        factor, picture = np.array(material.emission), None
        if not factor.any() or not material.reads(material.emissiveTexture):
            return None
        if material.emissiveTexture is not None:
            words = ": the texture {name} of the emission {why}; it is left out"
            picture = self._picture(material.emissiveTexture, "colours", words)
            if picture is None:
                return None
        found, note = limited_radiance(factor, picture)
        self._note(f": {note}" if note else "")
        return found

    # --- pictures ----------------------------------------

    def _picture(self, use: TextureUse | None, kind: Kind, words: str) -> Floats | None:
        """Return the values of a texture, each texel as often as its filter asks for; say why it cannot be had."""
        if use is None:
            return None
        number = self.header.textures[use.index].image
        uri = None if number is None else self.header.images[number].uri
        name = "(embedded)" if uri is None or uri.startswith("data:") else uri
        if number is None:
            found: Floats | str | None = "has a picture of a kind that is not understood"
        else:
            found = self._pictures.decoded(self._image(number), kind, name)
        if not isinstance(found, np.ndarray):
            why = self._pictures.why(name, found)
            self._note(words.format(name=shown(name), why=why))
            return None
        self.notes += [
            f"{self.source}: {note}" for note in self._pictures.notes if f"{self.source}: {note}" not in self.notes
        ]
        if self._sampler(use).magFilter != NEAREST or min(found.shape[:2]) == max(found.shape[:2]) == 1:
            return found
        sharp = self._pictures.side // 2  # so many that filtering does not show
        times = sharp // max(found.shape[:2])
        if times < 2:
            self._note(BLURRED.format(most=sharp // 2))
            return found
        return found.repeat(times, axis=0).repeat(times, axis=1)

    def _image(self, number: int) -> Image.Image | None:
        """Open a picture of the file; None where it cannot be had."""
        entry, opened = self.header.images[number], None
        if (entry.uri, entry.bufferView) not in self._opened:
            try:
                if entry.uri is not None:
                    data = self.buffers.uri(entry.uri)
                else:
                    data = b"" if entry.bufferView is None else bytes(self.buffers.view(entry.bufferView))
                opened = Image.open(io.BytesIO(data), formats=FORMATS)
            except (OSError, ValueError, SyntaxError):
                pass
            self._opened[entry.uri, entry.bufferView] = opened
        return self._opened[entry.uri, entry.bufferView]

    def _sampler(self, use: TextureUse) -> Sampler:
        number = self.header.textures[use.index].sampler
        return Sampler() if number is None else self.header.samplers[number]

    # --- beyond the edges ----------------------------------------

    def _fitted(
        self, surface: ImportedSurface, material: MaterialEntry, uvs: Sequence[Array]
    ) -> tuple[ImportedSurface, Fit]:
        """Give the pictures of a surface what lies beyond their edges, where they do not repeat there."""
        places = np.concatenate([*uvs, np.zeros((0, 2))])
        samplers = [self._sampler(use) for use in material.textures]
        if not surface.pictures or not len(places) or not np.isfinite(places).all():
            return surface, lambda given: given
        scale, shift = np.ones(2), np.zeros(2)
        pictures, changed = list(surface.pictures), False
        for axis, wraps in enumerate(([one.wrapS for one in samplers], [one.wrapT for one in samplers])):
            low, high = float(places[:, axis].min()), float(places[:, axis].max())
            side = 1 - axis  # rows of pictures come first
            sizes = [one.shape[side] for one in pictures]
            out = low < -BEYOND or high > 1.0 + BEYOND
            if out and len(set(wraps)) > 1:
                self._note(EDGES)
            if wraps[0] == MIRRORED and out:
                pictures = [np.concatenate([one, np.flip(one, side)], axis=side) for one in pictures]
                scale[axis], changed = 0.5, True
            elif wraps[0] in (CLAMPED, MIRRORED) and (out or _differ_at_edges(pictures, side)):
                unit_size = int(np.gcd.reduce(sizes))  # pads are whole texels of each
                before, after = (max(0, int(np.ceil(beyond * unit_size))) + 1 for beyond in (-low, high - 1.0))
                total = unit_size + before + after
                if total * (max(sizes) // unit_size) > 2 * self._pictures.side:
                    self._note(EDGES)
                    continue
                pictures = [
                    np.take(
                        one,
                        np.clip(np.arange(-before * step, (unit_size + after) * step), 0, one.shape[side] - 1),
                        side,
                    )
                    for one, step in ((one, one.shape[side] // unit_size) for one in pictures)
                ]
                scale[axis], shift[axis], changed = unit_size / total, before / total, True
        if not changed:
            return surface, lambda given: given
        left = iter(pictures)
        replaced = replace(
            surface,
            texture=None if surface.texture is None else next(left),
            normal_map=None if surface.normal_map is None else next(left),
            emission=next(left, surface.emission),
        )
        return replaced, lambda given: given * scale + shift

    def _note(self, words: str) -> None:
        message = self.source + words
        if words and message not in self.notes:
            self.notes.append(message)


def _differ_at_edges(pictures: Sequence[Floats], side: int) -> bool:
    """Whether small pictures would be filtered across their edges, and look otherwise for it."""
    return any(
        one.shape[side] <= SMALL and not np.array_equal(np.take(one, 0, side), np.take(one, -1, side))
        for one in pictures
    )
