"""The `background` control: a plain color behind the object.

It replaces the environment in the image:

    sRGB = hsv(hue, saturation, value);   backdrop = linear(sRGB)

The environment still lights the object (Xiao et al. 2020, Noise or signal, arXiv
2006.09994). Hue, saturation and value are the hexcone model of Smith (Color gamut
transform pairs, SIGGRAPH 1978), in display-referred values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from advsearch.extend import (
    Choice,
    Control,
    Fixed,
    InputError,
    Parameter,
    SceneDescription,
    Value,
    Values,
    color,
)

BACKDROP_COLOR = (
    "backdrop.color"  # the scene input: (3,) display-linear values in [0, 1]
)
BACKDROPS = ("colour", "environment")
COLOR_PARAMETERS = ("hue", "saturation", "value")

_image = partial(Parameter.number, ("image",))


class BackgroundControl(Control):
    """A plain colour behind the object; the environment keeps lighting it."""

    kind = "background"
    photograph_refusal = "the photograph is the background"
    strength_parameter = "what"
    parameters = (
        Parameter.named(
            "what",
            BACKDROPS,
            "colour",
            "Whether the background is the colour or the environment.",
        ),
        _image(
            "hue",
            "degrees",
            0.0,
            360.0,
            0.0,
            "Hue: 0 is red, 120 green, 240 blue.",
            (0.0, 360.0),
            periodic=True,
        ),
        _image("saturation", "1", 0.0, 1.0, 0.0, "Saturation: 0 is grey.", (0.0, 1.0)),
        _image(
            "value",
            "sRGB",
            0.0,
            1.0,
            0.5,
            "The largest of red, green and blue: 0 is black.",
            (0.0, 1.0),
        ),
    )
    choices = (
        Choice(
            "ground",
            "hide",
            "Whether the ground plane stays in the picture: keep or hide.",
            options=("keep", "hide"),
        ),
    )

    def __init__(self, name: str | None = None, **settings: object) -> None:
        """Read the settings, and check that something can be searched.

        Args:
            name: name of the control; by default its kind.
            **settings: values of its parameters.

        Raises:
            InputError: `what` is fixed at the environment, which shows no color.
        """
        super().__init__(name, **settings)
        # `Control` searches the default ranges unless the user has requested a range.
        # Here only a range of the color counts: with a list of values of `what` alone,
        # the color is still searched over its default range.
        self.has_requested_range = any(
            not isinstance(self.specs[parameter_name], Fixed)
            for parameter_name in COLOR_PARAMETERS
            if parameter_name in self.specs
        )
        if self.specs.get("what") == Fixed("environment"):
            raise InputError(
                f"{self.name}.what: environment alone leaves nothing to search; use "
                "what=[colour, environment], or "
                f"leave the control out"
            )

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter; `what` is the environment by default, if that is allowed."""
        if parameter.name == "what" and "environment" in self.list_allowed_values(
            "what"
        ):
            return replace(parameter, default="environment")
        return parameter

    def get_value_without_control(self, parameter: Parameter) -> float | str:
        return "environment" if parameter.name == "what" else parameter.default

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        scene = replace(scene, backdrop=True)
        return (
            scene.without_ground() if self.choice_values["ground"] == "hide" else scene
        )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the linear color (3,) of the background.

        There is no input if the background is the environment.
        """
        if BACKDROPS[int(values["what"])] == "environment":
            return {}
        return {
            BACKDROP_COLOR: color.srgb_to_linear(
                hsv_to_rgb(*(values[name] for name in COLOR_PARAMETERS))
            )
        }

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return red, green and blue of the color, in sRGB."""
        levels = hsv_to_rgb(*(values[name] for name in COLOR_PARAMETERS))
        channels = zip(color.CHANNELS, levels, strict=True)
        return {
            name: Value(value=float(level), unit="sRGB") for name, level in channels
        }


def hsv_to_rgb(hue: Tensor, saturation: Tensor, value: Tensor) -> Tensor:
    """Return the color (3,) of a hue in degrees, a saturation and a value in [0, 1].

    All are display-referred. The color is piecewise linear in each argument, so
    differentiable almost everywhere. The derivative of a gray by its hue is 0.
    """
    # The color circle has six sectors of 60 degrees. The same function of the position
    # on the circle gives each channel. The offsets put pure red, green and blue (0, 120
    # and 240 degrees) at the position 5 of their own channel, where it has its full
    # value.
    offsets = torch.tensor([5.0, 3.0, 1.0]).to(hue)
    sector = torch.remainder(offsets + hue / 60.0, 6.0)
    # 0 where the channel has its full value (two sectors), and 1 where the saturation
    # darkens it most (two sectors); linear in between.
    darkening = torch.minimum(sector, 4.0 - sector).clamp(0.0, 1.0)
    return value * (1.0 - saturation * darkening)
