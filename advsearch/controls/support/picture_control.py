"""A control of a picture, which patches and projectors are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.controls.base import (
    FULL_RANGE,
    MAX_EPSILON,
    NO_INPUTS,
    Budget,
    Control,
    Value,
    describe_color_change,
)
from advsearch.controls.ranges import Fixed, Range, Spec
from advsearch.controls.support.norms import DEFAULT_EPSILON, compute_radius
from advsearch.errors import FileFormatError
from advsearch.scene.importing.pictures import read_image
from advsearch.scene.settings import Parameter


class PictureControl(Control):
    """A control of a picture, searched or from a file, and of numbers, which are fixed
    where they are not given.

    Its choices are `resolution`, `picture`, `norm` ("box" for any color, "linf" or
    "l2") and `epsilon`.
    """

    MAX_EPSILON: ClassVar[float] = MAX_EPSILON
    image_parameter: ClassVar[str]  # the parameter that is the picture
    # of colors, where none is chosen
    default_epsilon: ClassVar[float] = DEFAULT_EPSILON
    _picture: Tensor | None

    @property
    def sides(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        return (int(self.chosen["resolution"]),) * 2

    @property
    def is_searched_image(self) -> bool:
        """Whether the picture is searched."""
        return self.chosen["picture"] is None and not isinstance(
            self.specs.get(self.image_parameter), Fixed
        )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        return (
            replace(parameter, shape=(*self.sides, 3), default=0.0)
            if parameter.name == self.image_parameter
            else parameter
        )

    def get_spec(self, parameter: Parameter) -> Spec:
        picture = Range(0.0, 1.0) if self.is_searched_image else Fixed(0.0)
        return self.specs.get(
            parameter.name,
            picture
            if parameter.name == self.image_parameter
            else Fixed(parameter.default),
        )

    def get_budget(self, parameter: Parameter) -> Budget:
        norm = self.chosen["norm"]
        if parameter.name != self.image_parameter or norm == "box":
            return FULL_RANGE
        spec = self.get_spec(parameter)
        assert isinstance(spec, Range)
        n_colors = 3 * math.prod(self.sides)
        reach = compute_radius(
            norm, self.chosen["epsilon"], n_colors, self.default_epsilon
        )
        return Budget(norm, reach / (spec.high - spec.low))

    def values(self, u: Tensor) -> dict[str, Tensor]:
        values = super().values(u)
        picture = self._picture
        image = (
            values[self.image_parameter].reshape(*self.sides, 3)
            if picture is None
            else picture.to(u.device, copy=True)
        )
        return values | {self.image_parameter: image}

    def read_picture(self) -> Tensor | None:
        """Return the picture (h, w, 3) sRGB that was chosen; None where none was.

        Raises FileFormatError: it cannot be read.
        """
        if self.chosen["picture"] is None:
            return None
        try:
            return torch.from_numpy(read_image(Path(self.chosen["picture"])))
        except FileFormatError as error:
            raise FileFormatError(f"{self.name}.picture: {error}") from error

    def describe(
        self, u: Tensor, so_far: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        """Return how much a searched image changes, and the other values."""
        described = super().describe(u, so_far)
        if not self.is_searched_image:
            return described
        image, start_image = (
            self.values(point)[self.image_parameter]
            for point in (u.detach(), self.start.to(u.device))
        )
        return {**describe_color_change(self.name, image - start_image), **described}
