"""A uniform haze as a part of a scene: one grey medium in a ball around the origin that camera and object stand in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from advsearch.scene.mitsuba_backend.variant import mitsuba
from advsearch.scene.parts import Part, PartInput, color, number


@dataclass(frozen=True, eq=False)
class HazePart(Part):
    """Haze that scatters light evenly in all directions, up to some distance from the scene's middle.

    Takes `NAME.density` (1,), the extinction per object size, and `NAME.albedo` (3,), the share of the light that is
    scattered and not absorbed. Mitsuba's medium only holds these two for the integrator: no shape refers to it.

    Attributes:
        name: of the haze.
        radius: of the ball that it fills, object sizes.
    """

    name: str
    radius: float
    volumetric: bool = True

    def plugins(self) -> dict[str, Any]:
        albedo = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
        return {self.name: mitsuba().load_dict({"type": "homogeneous", "albedo": albedo, "sigma_t": 0.0})}

    def inputs(self) -> tuple[PartInput, ...]:
        return (
            PartInput(f"{self.name}.density", f"{self.name}.sigma_t.value.value", number, True, (1,)),
            PartInput(f"{self.name}.albedo", f"{self.name}.albedo.value.value", color, True, (3,)),
        )

    def integrator(self, plugins: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the path integrator's dictionary needs instead of `prb`.

        Args:
            plugins: the scene's dictionary, made with what `plugins` returned: the medium has to be the scene's own.
        """
        import advsearch.controls.haze.path  # noqa: F401  (registers the integrator)

        return {"type": "advsearch_haze", "medium": plugins[self.name], "radius": self.radius}
