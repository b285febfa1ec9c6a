"""The base class of controls of an image: patches and projectors."""

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
from advsearch.controls.support.norms import DEFAULT_EPSILON, compute_default_radius
from advsearch.errors import FileFormatError
from advsearch.scene.importing.pictures import read_image
from advsearch.scene.settings import Parameter


class PictureControl(Control):
    """Base class for controls of an image, which is searched or read from a file.

    Other parameters are numbers, which are fixed at their defaults if they are not set.

    Its choices are `resolution`, `picture` (an image file), `norm` ("box" for any
    color, "linf" or "l2") and `epsilon`.

    Attributes:
        image_parameter: name of the parameter that is the image.
        default_epsilon: radius of the ball of colors if `epsilon` is not set.
        _picture: image (H, W, 3) sRGB from the file; None if the image is searched or
            a constant color. A subclass sets it in `fit`.
    """

    MAX_EPSILON: ClassVar[float] = MAX_EPSILON
    image_parameter: ClassVar[str]
    default_epsilon: ClassVar[float] = DEFAULT_EPSILON
    _picture: Tensor | None

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return (int(self.choice_values["resolution"]),) * 2

    @property
    def is_image_searched(self) -> bool:
        """Whether the image is searched: no file is set, and no constant color."""
        return self.choice_values["picture"] is None and not isinstance(
            self.specs.get(self.image_parameter), Fixed
        )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        if parameter.name != self.image_parameter:
            return parameter
        return replace(parameter, shape=(*self.image_shape, 3), default=0.0)

    def get_parameter_spec(self, parameter: Parameter) -> Spec:
        """Return the spec that the user set for a parameter, or the default one.

        By default a searched image may have all colors, and a number is fixed at its
        default. An image from a file is fixed, so that it has no coordinates. Its spec
        has the placeholder 0, which is not read.
        """
        if parameter.name in self.specs:
            return self.specs[parameter.name]
        if parameter.name != self.image_parameter:
            return Fixed(parameter.default)
        return Range(0.0, 1.0) if self.is_image_searched else Fixed(0.0)

    def get_budget(self, parameter: Parameter) -> Budget:
        """Return how far the image may go from its start.

        That is the radius `epsilon` in the norm, converted from colors to fractions of
        the range. Parameters other than the image have no limit, and the norm "box" has
        none either.
        """
        norm = self.choice_values["norm"]
        if parameter.name != self.image_parameter or norm == "box":
            return FULL_RANGE
        spec = self.get_parameter_spec(parameter)
        assert isinstance(spec, Range)
        n_values = 3 * math.prod(self.image_shape)  # three channels for each pixel
        radius = self.choice_values["epsilon"]  # in colors, for each norm
        if radius is None:
            radius = compute_default_radius(norm, n_values, self.default_epsilon)
        # Coordinates are colors divided by the width of the range, and so is any norm.
        return Budget(norm, radius / (spec.high - spec.low))

    def compute_values(self, u: Tensor) -> dict[str, Tensor]:
        """Return the values of the parameters by name; the image is (H, W, 3)."""
        values = super().compute_values(u)
        if self._picture is None:
            image = values[self.image_parameter].reshape(*self.image_shape, 3)
        else:
            image = self._picture.to(u.device, copy=True)
        return values | {self.image_parameter: image}

    def read_picture(self) -> Tensor | None:
        """Return the image (h, w, 3) sRGB of the `picture` file; None if none is set.

        Raises:
            FileFormatError: it cannot be read.
        """
        if self.choice_values["picture"] is None:
            return None
        try:
            return torch.from_numpy(read_image(Path(self.choice_values["picture"])))
        except FileFormatError as error:
            raise FileFormatError(f"{self.name}.picture: {error}") from error

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        """Return how much a searched image changes, and the other values."""
        described = super().describe(u, earlier_inputs)
        if not self.is_image_searched:
            return described
        image = self.compute_values(u.detach())[self.image_parameter]
        start_image = self.compute_values(self.start.to(u.device))[self.image_parameter]
        return {**describe_color_change(self.name, image - start_image), **described}
