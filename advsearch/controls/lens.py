"""The `lens` control: translucent dots on the camera's lens, as on a sticker.

    opacity_k(p) = opacity_k * exp(-(|p - centre_k|^2 / radius_k^2) ^ falloff)
    light(p)    <- (1 - opacity_k(p)) light(p) + opacity_k(p) color_k,     for each dot k in turn

The dots are those of Li, Schmidt and Kolter (Adversarial camera stickers, ICML 2019,
arXiv 1904.00759, section 3). There display values are blended, here linear light. The
dots are drawn on the finished image, without rendering it again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from advsearch.extend import Choice, Control, OneOf, Parameter, Values, color

DEFAULT_DOTS = 4
MAX_DOTS = 64
POSITION_PARAMETERS = ("x", "y")
# side in pixels of the image of the sticker that is stored with a result
STICKER_SIDE = 256
# limit of the exponent, so that powers do not overflow; exp(-40) is 4e-18, invisible
_MAX_EXPONENT = 40.0


def _make_dot_parameter(
    name: str,
    unit: str,
    default: float,
    text: str,
    search: tuple[float, float] = (0.0, 1.0),
    low: float = 0.0,
    *,
    log: bool = False,
) -> Parameter:
    """Return a parameter with one number for each dot.

    Args:
        name: name of the parameter.
        unit: unit of the numbers.
        default: value of each number.
        text: description for the user.
        search: range that is searched by default.
        low: lower bound; the upper one is 1.
        log: whether it is searched on a logarithmic scale.
    """
    return Parameter(
        name=name,
        shape=(None,),  # the number of dots is a choice, see `resolve_parameter`
        unit=unit,
        low=low,
        high=1.0,
        default=default,
        description=text,
        search=search,
        log=log,
        estimators=("image",),
    )


class LensControl(Control):
    """Translucent, blurred dots on the camera's lens: positions, sizes, colours and
    opacities.
    """

    kind = "lens"
    strength_parameter = "opacity"
    parameters = (
        _make_dot_parameter(
            "x", "picture widths", 0.5, "Centre of each dot, from the left edge."
        ),
        _make_dot_parameter(
            "y", "picture heights", 0.5, "Centre of each dot, from the top edge."
        ),
        _make_dot_parameter(
            "radius",
            "picture sizes",
            0.12,
            "Distance from the centre at which a dot has lost 63 % of its opacity, as a "
            "fraction of the picture's shorter side.",
            (0.03, 0.25),
            0.01,
            log=True,
        ),
        *(
            _make_dot_parameter(name, "sRGB", 0.5, f"{name.capitalize()} of each dot.")
            for name in color.CHANNELS
        ),
        _make_dot_parameter(
            "opacity",
            "1",
            0.0,
            "Opacity at the centre of each dot; 0 is no dot.",
            (0.0, 0.5),
        ),
        Parameter.number(
            ("image",),
            "falloff",
            "1",
            1.0,
            8.0,
            1.0,
            "How sharp the edges are: 1 is a Gaussian blob, 8 nearly a disc.",
        ),
    )
    choices = (
        Choice(
            "dots",
            DEFAULT_DOTS,
            f"Number of dots, 1 to {MAX_DOTS}.",
            integer_bounds=(1, MAX_DOTS),
        ),
    )

    @property
    def n_dots(self) -> int:
        """Number of dots."""
        return int(self.choice_values["dots"])

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        is_per_dot = bool(parameter.shape)
        return replace(parameter, shape=(self.n_dots,)) if is_per_dot else parameter

    def bind_parameters(self) -> None:
        """Spread the dots over the image at the start."""
        super().bind_parameters()
        positions = spread_positions(self.n_dots)
        for slot in self.parameter_slots:
            name = slot.parameter.name
            # A range has a coordinate for each dot, a list of values a single one.
            is_range = slot.n_coordinates > 0 and not isinstance(
                slot.parameter_spec, OneOf
            )
            if name in POSITION_PARAMETERS and is_range:
                coordinates = slice(
                    slot.coordinate_offset, slot.coordinate_offset + slot.n_coordinates
                )
                self.start[coordinates] = positions[POSITION_PARAMETERS.index(name)]

    def on_picture(self, values: Values, image: Tensor) -> Tensor:
        return draw_dots(image, self._spread_dots(values))

    def make_artifact_images(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the sticker as it looks on a grey checkerboard."""
        square = torch.arange(STICKER_SIDE) // (STICKER_SIDE // 16)
        is_dark = (square[:, None] + square[None, :]) % 2
        checkerboard = (0.6 - 0.2 * is_dark)[..., None].repeat(1, 1, 3)
        return {self.name: draw_dots(checkerboard, self._spread_dots(values))}

    def _spread_dots(self, values: Values) -> dict[str, Tensor]:
        """Return the values with dots spread along the axes that are fixed by default.

        The user may set a range of another parameter than x or y. Then x and y are
        fixed, and all dots would be at the same default position.
        """
        are_default_ranges_searched = not self.has_requested_range
        if are_default_ranges_searched:
            return dict(values)  # `bind_parameters` has spread the start of x and y
        positions = spread_positions(self.n_dots)
        spread_values = dict(values)
        for axis, name in enumerate(POSITION_PARAMETERS):
            if name not in self.specs:
                spread_values[name] = positions[axis].to(values[name].device)
        return spread_values


def spread_positions(count: int) -> Tensor:
    """Return positions spread evenly over the middle 80 % of the image.

    They are a lattice with the two irrational steps of the plastic number, a
    two-dimensional golden ratio (Roberts 2018, The unreasonable effectiveness of
    quasirandom sequences, R2); the first is in the image's center.

    Returns:
        (2, count) float32: x and y in [0.1, 0.9].
    """
    plastic = 1.324717957244746
    steps = torch.tensor([[1.0 / plastic], [1.0 / plastic**2]], dtype=torch.float64)
    lattice = torch.remainder(0.5 + steps * torch.arange(count), 1.0)
    return (0.1 + 0.8 * lattice).float()


def draw_dots(image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
    """Return an image as it looks through a lens with dots on it.

    Args:
        image: (H, W, 3) display-referred sRGB in [0, 1].
        values: `x`, `y`, `radius`, `red`, `green`, `blue`, `opacity` of shape (dots,)
            and `falloff` of shape (), as in `LensControl.parameters`.

    Returns:
        (H, W, 3) sRGB in [0, 1]; differentiable in the image and in every value.
    """
    levels = torch.stack([values[channel] for channel in color.CHANNELS], dim=-1)
    dot_colors = color.srgb_to_linear(levels).to(image.device)
    height, width = image.shape[:2]
    covers = _compute_covers(height, width, values).to(image.device)
    light = color.srgb_to_linear(image)
    for cover, dot_color in zip(covers, dot_colors, strict=True):
        light = light + cover[..., None] * (dot_color - light)
    return color.linear_to_srgb(light)


def _compute_covers(height: int, width: int, values: Mapping[str, Tensor]) -> Tensor:
    """Return the opacity (dots, H, W) of each dot in each pixel.

    It is opacity * exp(-(r^2)^falloff), where r is the distance from the dot's center,
    divided by the dot's radius.

    Args:
        height, width: size of the image, pixels.
        values: `x`, `y`, `radius` and `opacity` (dots,), and `falloff` (). x and y are
            fractions of width and height, the radius of the shorter side.
    """
    squared_radii = _compute_squared_radii(height, width, values)
    falloff = values["falloff"]
    # Here r^2 to the falloff is `_MAX_EXPONENT`. Beyond, the exponential is practically 0,
    # and its derivative would not be finite.
    max_squared_radii = float(_MAX_EXPONENT ** (1.0 / falloff.detach()))
    # at least 1e-12, as a power has no derivative at 0
    limited = squared_radii.clamp(1e-12, max_squared_radii)
    fading = torch.exp(-(limited**falloff))
    return values["opacity"][:, None, None] * fading


def _compute_squared_radii(
    height: int, width: int, values: Mapping[str, Tensor]
) -> Tensor:
    """Return the squared distance (dots, H, W) of each pixel from each dot, in radii.

    The arguments are those of `_compute_covers`.
    """
    shorter_side = min(height, width)
    device = values["x"].device
    column = torch.arange(width, device=device) + 0.5
    row = torch.arange(height, device=device) + 0.5
    x_offset = (column - values["x"][:, None] * width) / shorter_side
    y_offset = (row - values["y"][:, None] * height) / shorter_side
    squared_distance = y_offset[:, :, None] ** 2 + x_offset[:, None, :] ** 2
    return squared_distance / values["radius"][:, None, None] ** 2
