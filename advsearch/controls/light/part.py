"""A lamp as a part of a scene: a point, or a ball that glows.

A ball needs no orientation, and Mitsuba samples the cone under which it is seen: as quiet as a disk, and simpler. Its
surface is `null`: light of others passes through it, so that a lamp of power 0 changes nothing, wherever it stands.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from advsearch.scene.mitsuba_backend.variant import mitsuba
from advsearch.scene.parts import Part, PartInput, color, point, transform

BLACK = {"type": "rgb", "value": [0.0, 0.0, 0.0]}


@dataclass(frozen=True, eq=False)
class PointLightPart(Part):
    """A point that shines equally in all directions; the camera does not see it.

    Takes `NAME.position` (3,) in object sizes and `NAME.intensity` (3,) linear radiant intensity. The interior adjoint
    is right for the intensity; for a position Mitsuba raises.

    Attributes:
        name: of the lamp.
        dark: its intensity is 0 whatever happens.
    """

    name: str
    dark: bool = False

    def plugins(self) -> dict[str, Any]:
        return {self.name: {"type": "point", "position": [0.0, 0.0, 2.0], "intensity": BLACK}}

    def inputs(self) -> tuple[PartInput, ...]:
        return (
            PartInput(f"{self.name}.position", f"{self.name}.position", point, shape=(3,)),
            PartInput(f"{self.name}.intensity", f"{self.name}.intensity.value", color, interior=True, shape=(3,)),
        )


@dataclass(frozen=True, eq=False)
class BallLightPart(Part):
    """A ball that shines outwards with the same radiance everywhere; the camera sees it where it is in view.

    Takes `NAME.ball` (4, 4), the pose of the unit ball (a shift and one scale for all axes), and `NAME.radiance` (3,)
    linear radiance. The interior adjoint is right for the radiance; for the pose it is silently 0.

    Attributes:
        name: of the lamp.
        dark: its radiance is 0 whatever happens.
    """

    name: str
    dark: bool = False

    def plugins(self) -> dict[str, Any]:
        ball = {
            "type": "sphere",
            "to_world": mitsuba().ScalarTransform4f().translate([0.0, 0.0, 2.0]).scale(0.1),
            "bsdf": {"type": "null"},
            "emitter": {"type": "area", "radiance": BLACK},
        }
        return {self.name: ball}

    def inputs(self) -> tuple[PartInput, ...]:
        return (
            PartInput(f"{self.name}.ball", f"{self.name}.to_world", transform, shape=(4, 4)),
            PartInput(f"{self.name}.radiance", f"{self.name}.emitter.radiance.value", color, interior=True, shape=(3,)),
        )
