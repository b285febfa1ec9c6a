"""What the parts of a mesh file look like: textures, base colours, roughness and metallic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from advsearch.scene.color import srgb_to_linear

Floats = npt.NDArray[np.float32]

NEUTRAL = 0.5
"""Display-referred grey of an object without material."""


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

    @property
    def clear(self) -> bool:
        """Whether all light passes through it, everywhere."""
        color = self.color if self.texture is None else self.texture
        return color is not None and color.shape[-1] == 4 and not color[..., 3].any()

    def same_maps(self, other: ImportedSurface) -> bool:
        """Tell whether two surfaces have the same base colour, normal map and emission everywhere."""
        ours = (self.color, self.texture, self.normal_map, self.emission)
        pairs = zip(ours, (other.color, other.texture, other.normal_map, other.emission), strict=True)
        return all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)


def limited_radiance(
    factor: npt.NDArray[np.float64], picture: Floats | None = None
) -> tuple[Floats | None, str | None]:
    """Return a factor (3,) times the linear values of a picture (H, W, 3), as in `ImportedSurface`, and a warning where
    that is cut to `BRIGHTEST`."""
    cut = f"emission brighter than {BRIGHTEST:g} is cut to that" if factor.max() > BRIGHTEST else None
    linear = np.ones((1, 1, 3), np.float32) if picture is None else srgb_to_linear(picture)
    found = (linear * np.minimum(factor, BRIGHTEST)).astype(np.float32)
    return (found if found.any() else None), cut


def with_opacity(color: Floats | None, factor: Floats, cutoff: float | None) -> Floats | None:
    """Return a base colour (..., 3 or 4) with its opacity, or as (..., 3) where it is opaque.

    What is cut out of a picture gets the nearest colour that is seen.

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
    if opacity.min() >= 1.0:
        return color[..., :3]
    unseen = opacity[..., 0] == 0.0
    plain = color[..., :3]
    if color.ndim == 3 and not unseen.all():  # lest the colour of what is cut out bleeds over its edges
        plain = plain[tuple(distance_transform_edt(unseen, return_distances=False, return_indices=True))]
    return np.concatenate([plain, opacity], axis=-1)


def unit(value: float | None) -> float | None:
    """Clip a factor to [0, 1]; None and NaN become None."""
    return None if value is None or value != value else min(max(float(value), 0.0), 1.0)
