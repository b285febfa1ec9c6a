"""Objects of several materials: one surface whose roughness, metal and clear coat differ from part to part."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from advsearch.scene.assets import Material, Mesh
from advsearch.scene.parts import BASE_COLOR
from advsearch.scene.surface_map import rasterised

SIDE = 256
"""Texels along the maps of roughness, metal and clear coat."""


def finished(mesh: Mesh, finishes: Mapping[str, Material], main: Material) -> dict[str, object]:
    """Return a principled surface, in Mitsuba's words, as `ObjectAsset.surface` has it.

    Args:
        mesh: with texture coordinates and the faces of each material by name.
        finishes: what each of these materials is like.
        main: what all other faces are like; its `specular` holds for all.
    """
    faces = np.tile([main.roughness, main.metallic, main.clearcoat], (len(mesh.faces), 1))
    for name, one in finishes.items():
        faces[mesh.materials[name]] = one.roughness, one.metallic, one.clearcoat
    maps = faces[rasterised(mesh, SIDE).face].astype(np.float32)
    surface: dict[str, object] = {
        "type": "principled",
        "base_color": {"type": BASE_COLOR, "filter_type": "bilinear"},
        "specular": main.specular,
        "clearcoat_gloss": 1.0,
    }
    for channel, name in enumerate(("roughness", "metallic", "clearcoat")):
        picture = maps[:, :, channel : channel + 1]
        surface[name] = {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "nearest"}
    return {"type": "twosided", "bsdf": surface}
