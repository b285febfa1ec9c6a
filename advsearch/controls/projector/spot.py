"""The `spot` control: the light of a torch or a laser on the object.

It only adds light. It is a projector with the image of a round spot, so that no outline
moves and its parameters have an adjoint:

    image = color exp(-r^2 / (2 s^2)) image's area / (2 pi s^2)
    width = 2 s sqrt(2 ln 2)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from advsearch.controls.projector.projector import (
    DEFAULT_LUMENS,
    MAX_AMBIENT_FACTOR,
    ProjectorControl,
)
from advsearch.extend import (
    Choice,
    Control,
    Fixed,
    OneOf,
    Parameter,
    Range,
    Value,
    Values,
    color,
)

SOURCE_PARAMETERS = ("azimuth", "elevation", "distance", "ambient", "flicker", "phase")
DEFAULT_WIDTH = 0.3  # object sizes
WIDTH_PER_DEVIATION = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Diameter in which half of a round Gaussian of standard deviation 1 lies."""


NO_INPUTS: Mapping[str, Tensor] = MappingProxyType({})
_lit = partial(Parameter.number, Parameter.LIT)


class SpotControl(ProjectorControl):
    """The spot of a torch or a laser on the object."""

    kind = "spot"
    strength_parameter = "lumens"
    parameters = (
        _lit(
            "x",
            "object sizes",
            -10.0,
            10.0,
            0.0,
            "Shift of its centre to the right, seen from the light.",
            (-0.5, 0.5),
        ),
        _lit(
            "y",
            "object sizes",
            -10.0,
            10.0,
            0.0,
            "Shift of its centre upwards.",
            (-0.5, 0.5),
        ),
        _lit(
            "width",
            "object sizes",
            0.02,
            10.0,
            DEFAULT_WIDTH,
            "Diameter of the circle that has half of its light.",
            (0.05, 0.6),
            log=True,
        ),
        *Parameter.colors("of its light.", (0.0, 1.0)),
        _lit(
            "lumens",
            "lumens",
            0.0,
            1e6,
            "0, or 20 times as bright as the ambient light",
            "Total light of the spot.",
            (0.0, DEFAULT_LUMENS),
        ),
        *(
            parameter
            for parameter in ProjectorControl.parameters
            if parameter.name in SOURCE_PARAMETERS
        ),
    )
    choices = (
        Choice(
            "resolution",
            64,
            "Rows of texels of the projected picture.",
            integer_bounds=(2, 512),
        ),
        Choice(
            "fov",
            None,
            "Angle in which the spot can be, degrees; by default it just "
            "covers the object.",
            max_value=150.0,
        ),
    )

    # There is no image among its parameters. So it has the methods of `Control` instead
    # of those of `PictureControl`.

    def get_parameter_spec(self, parameter: Parameter) -> Fixed | Range | OneOf:
        return Control.get_parameter_spec(self, parameter)

    def get_budget(self, parameter: Parameter) -> Any:
        return Control.get_budget(self, parameter)

    def compute_values(self, u: Tensor) -> dict[str, Tensor]:
        return Control.compute_values(self, u)

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        return Control.describe(self, u, earlier_inputs)

    def make_artifact_images(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        return Control.make_artifact_images(self, values, earlier_inputs)

    def check_choices(self) -> None:
        # choices of the projector that a spot does not have
        self.choice_values = {"aspect": 1.0, "picture": None, **self.choice_values}

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter for the scene.

        Lumens are searched from 0 to a maximum: `DEFAULT_LUMENS`, or less if a spot of
        the default width would be more than `MAX_AMBIENT_FACTOR` times as bright as the
        ambient light. The default of the lumens is 0. But if only other parameters are
        searched, the default is the maximum, because a spot without light has no
        effect.
        """
        if parameter.name != "lumens":
            return super().resolve_parameter(parameter)
        max_lumens = self._find_max_lumens()
        default = 0.0
        if self.has_requested_range and not self.is_searched("lumens"):
            default = max_lumens
        return replace(parameter, search=(0.0, max_lumens), default=default)

    def _find_max_lumens(self) -> float:
        """Return the upper bound of the range in which lumens are searched."""
        # The spot is a Gaussian: standard deviation in metres, and integral in squared
        # metres if its peak is 1.
        std = DEFAULT_WIDTH / WIDTH_PER_DEVIATION * self.scene.size_in_metres
        effective_area = 2.0 * math.pi * std**2
        ambient_lux = float(self.get_clean_value("ambient"))
        max_bright_lumens = MAX_AMBIENT_FACTOR * ambient_lux * effective_area
        return min(DEFAULT_LUMENS, max_bright_lumens)

    def get_value_without_control(self, parameter: Parameter) -> float | str:
        return 0.0  # only that of the lumens is used (`strength_parameter`)

    def compute_projected_image(self, values: Values) -> Tensor:
        """Return the projected image (h, w, 3) of the round spot, linear.

        The image lies in the plane through the object's center, at right angles to the
        projector's direction. The spot is a Gaussian, scaled so that its total light
        does not depend on the width.
        """
        # half the width of the projector's square image in the plane through the
        # object's center, object sizes
        half_width = (
            math.tan(math.radians(self.projector_part.fov) / 2.0)
            * values["distance"].detach()
            / self.scene.size_in_metres
        )
        squared_distance = self._compute_squared_distance(values, half_width)
        std = values["width"] / WIDTH_PER_DEVIATION
        gaussian = torch.exp(-0.5 * squared_distance / std**2)
        # The Gaussian is scaled so that the mean of the image is about 1.
        image_area = (2.0 * half_width) ** 2
        integral = 2.0 * math.pi * std**2
        spot = gaussian * image_area / integral
        return spot[..., None] * color.combine_channels(values)

    def _compute_squared_distance(self, values: Values, half_width: Tensor) -> Tensor:
        """Return the squared distance (h, w) of each texel from the spot's center.

        `half_width` () is half the width of the image, in object sizes.
        """
        rows, columns = self.projector_part.sides
        # Positions of the texels' centers in the plane of the image. Rows go downwards,
        # but `y` goes upwards.
        right = _compute_texel_centers(columns).to(half_width) * half_width
        down = _compute_texel_centers(rows).to(half_width) * half_width
        x_offset = right[None] - values["x"]
        y_offset = -down[:, None] - values["y"]
        return x_offset**2 + y_offset**2

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return the brightness of the brightest point of the spot."""
        brightest = float(self.compute_projected_image(values).detach().max())
        lux = brightest * float(self._compute_white_lux(values))
        ratio = brightest * float(self._compute_ambient_ratio(values))
        return {
            "lux": Value(value=lux, unit="lux, where it is brightest"),
            "beside_ambient": Value(value=ratio, unit="times the ambient light"),
        }


def _compute_texel_centers(count: int) -> Tensor:
    """Return the centers (count,) of texels along a side that goes from -1 to 1."""
    # Of evenly spaced points every second one is a center; the others are edges.
    return torch.linspace(-1.0, 1.0, 2 * count + 1)[1::2]
