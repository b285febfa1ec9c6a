"""What the camera sees first through the middle of each pixel: ground truth beside a picture, without noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from advsearch.errors import UnknownNameError

AOVS: Mapping[str, str] = {
    "mask": "1 where the object is seen first, else 0",
    "depth": "distance from the camera along the ray, metres (object sizes where the object's size is not known); "
    "infinite where there is nothing",
    "normal": "unit shading normal, world space (z up); 0 where there is nothing",
    "uv": "texture coordinates, v = 0 at the bottom row of the texture; 0 where there is nothing",
    "id": "number of the mesh; 0 where there is nothing",
}
"""What can be asked for, and what its values mean."""
CHANNELS: Mapping[str, str] = {"mask": "Y", "depth": "Z", "normal": "XYZ", "uv": "UV", "id": "Y"}
"""The channels of each layer, as EXR calls them."""


def aovs_of(text: str | None) -> tuple[str, ...]:
    """Return the names in a list separated by commas, each once. Raises UnknownNameError: one is not of `AOVS`."""
    names = dict.fromkeys(part.strip() for part in (text or "").split(",") if part.strip())
    for name in names:
        if name not in AOVS:
            raise UnknownNameError("aov", name, AOVS)
    return tuple(names)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surface in each pixel, by the ray through its middle."""

    names: tuple[str, ...]  # of the shapes
    id: Tensor  # (H, W) int64: 1 for the first of the names and so on, 0 where there is nothing
    # (H, W) distance from the camera, infinite where there is nothing: metres, as renderers say it; object sizes where
    # the object's size is not known, and as Mitsuba's scenes say it
    depth: Tensor
    z_depth: Tensor  # (H, W) the part of it that lies along the camera's axis
    normal: Tensor  # (H, W, 3) unit shading normal in world space
    uv: Tensor  # (H, W, 2) texture coordinates; v = 0 is the bottom row
    face: Tensor  # (H, W) int64 number of the triangle in its mesh

    def seen(self, name: str) -> Tensor:
        """Return where a shape is what is seen, (H, W) bool."""
        return self.id == self.names.index(name) + 1

    def layers(self, aovs: Sequence[str], mask: str) -> dict[str, Tensor]:
        """Return the channels (H, W) of layers of `AOVS`, such as ``normal.X``; `mask` names the shape of it."""
        channels: dict[str, Tensor] = {}
        for name in aovs:
            value = self.seen(mask).float() if name == "mask" else getattr(self, name)
            planes = value[..., None] if value.ndim == 2 else value
            channels |= {f"{name}.{channel}": planes[..., number] for number, channel in enumerate(CHANNELS[name])}
        return channels

    def notes(self, aovs: Sequence[str]) -> dict[str, str]:
        """Return what the values of the layers mean, by name."""
        numbers = ", ".join(f"{number} is {name}" for number, name in enumerate(self.names, 1))
        return {name: AOVS[name] + (f"; {numbers}" if name == "id" else "") for name in aovs}
