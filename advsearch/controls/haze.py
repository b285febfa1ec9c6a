"""The `haze` control: density and color of a uniform haze around camera and object.

Over a distance l, haze removes the fraction `1 - exp(-density * l)` of the light (Beer
and Lambert), and adds scattered light: see
`advsearch.scene.mitsuba_backend.own_plugins` for the equation. The color is the fraction
of the removed light that is scattered and not absorbed, per channel: white haze absorbs
nothing, dark haze is smoke. Haze fills a ball; the environment is outside.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from torch import Tensor

from advsearch.extend import (
    Control,
    Parameter,
    Range,
    SceneDescription,
    Values,
    color,
    geometry,
    parts,
)

# smallest radius of the ball of haze, object sizes
MIN_RADIUS = 4.0
# smallest radius as a multiple of the camera's distance from the origin
CAMERA_DISTANCE_FACTOR = 1.5
DEFAULT_DENSITY = 0.1  # density if only the color is searched


class HazeControl(Control):
    """A uniform haze around camera and object: its density and colour."""

    kind = "haze"
    photograph_refusal = "haze would cover the object, but not the photograph"
    strength_parameter = "density"
    parameters = (
        Parameter.number(
            Parameter.LIT,
            "density",
            "per object size",
            0.0,
            2.0,
            0.0,
            "Extinction: over a distance of 1 / density the haze removes 63 % of the "
            "light of a ray.",
            (0.0, 0.3),
        ),
        *Parameter.colors(
            "of the haze: the light that it scatters and does not absorb.",
            (0.6, 1.0),
            low=0.02,
        ),
    )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter with the value of the scene's own haze, if it has one."""
        scene_haze = _find_haze(self.scene)
        if parameter.name == "density":
            return self._resolve_density(parameter, scene_haze)
        if scene_haze is None:
            return parameter
        # The other parameters are the channels of the color: "red", "green" and "blue".
        linear_albedo = np.asarray(scene_haze.albedo, np.float32)
        albedo = color.linear_to_srgb(linear_albedo).tolist()
        channel = color.CHANNELS.index(parameter.name)
        return replace(parameter, default=albedo[channel])

    def _resolve_density(
        self, parameter: Parameter, scene_haze: parts.HazePart | None
    ) -> Parameter:
        """Return the density with its default and its estimators in this scene.

        Without haze in the scene the default is 0. But if only the color is searched,
        it is `DEFAULT_DENSITY`, because the color of no haze has no effect.

        Args:
            parameter: the density.
            scene_haze: haze of the scene, or None.
        """
        default = parameter.default
        if scene_haze is not None:
            default = scene_haze.density
        elif self.has_requested_range and not self.is_searched("density"):
            default = DEFAULT_DENSITY
        # The adjoint needs a positive density. Without a range of the user, the range
        # includes 0.
        spec = self.specs.get("density")
        has_adjoint = isinstance(spec, Range) and spec.low > 0.0
        estimators = Parameter.LIT if has_adjoint else ("differences",)
        return replace(parameter, default=default, estimators=estimators)

    def get_value_without_control(self, parameter: Parameter) -> float | str:
        # Only the value of the density is used (`strength_parameter`).
        return 0.0 if _find_haze(self.scene) is None else parameter.default

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with a ball of haze around camera and object.

        If the scene has a haze already, that is used and only renamed.
        """
        scene_haze = _find_haze(scene)
        if scene_haze is not None:
            renamed = replace(scene_haze, name=self.name)
            return replace(
                scene,
                parts=tuple(
                    renamed if part is scene_haze else part for part in scene.parts
                ),
            )
        # from the origin, the center of the ball
        camera_distance = float(np.linalg.norm(geometry.camera_to_world(scene)[:3, 3]))
        radius = max(MIN_RADIUS, CAMERA_DISTANCE_FACTOR * camera_distance)
        return scene.with_part(parts.HazePart(self.name, radius))

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the density (1,) and the albedo (3,) of the haze."""
        albedo = color.combine_channels(values)
        return {
            f"{self.name}.density": values["density"].reshape(1),
            f"{self.name}.albedo": albedo,
        }


def _find_haze(scene: SceneDescription) -> parts.HazePart | None:
    """Return the haze of a scene; None if it has none, or only one of density 0."""
    return next(
        (
            part
            for part in scene.parts
            if isinstance(part, parts.HazePart) and part.density
        ),
        None,
    )
