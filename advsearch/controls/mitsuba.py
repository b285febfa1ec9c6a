"""The `mitsuba` control: any number or color of a scene by Mitsuba's name for it.

Names are keys of `mitsuba.traverse`; the object under test is called `object`. For a
color, each channel is a parameter with the same range; `KEY.red` is a single channel.
Mitsuba's derivative may be wrong for some of them: `advsearch check` compares it with
finite differences.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from advsearch.extend import (
    Control,
    Fixed,
    InputError,
    OneOf,
    Parameter,
    Range,
    SceneDescription,
    Values,
    color,
    mitsuba_data,
    parts,
)


class MitsubaControl(Control):
    """Any number or colour of the scene, by Mitsuba's name for it."""

    kind = "mitsuba"
    parameters = ()  # the settings name them, see `declare_parameters`

    def __init__(self, name: str | None = None, **settings: object) -> None:
        super().__init__(name, **settings)
        if not self._settings:
            raise InputError(
                f"`controls` {self.name}: expected Mitsuba's names, as in "
                "mitsuba:KEY=[low, high]"
            )

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        return tuple(_make_parameter(key) for key in settings)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with a part for the numbers that are set by Mitsuba's names.

        The settings of this control are named by these, e.g. "mug.bsdf.reflectance".

        Raises:
            InputError: the scene has no such number; or it does not belong to the
                object, and the surroundings are a photograph.
        """
        self._check_not_in_photograph(scene)
        numbers = mitsuba_data.find_plugin_numbers(
            scene, self.name, keys=tuple(self._settings)
        )
        return scene.with_part(parts.PluginNumbers(self.name, numbers))

    def _check_not_in_photograph(self, scene: SceneDescription) -> None:
        """Raise InputError for a number of surroundings that are a photograph."""
        keys_outside_object = [
            key for key in self._settings if not key.startswith("object.")
        ]
        if scene.backdrop_photograph is not None and keys_outside_object:
            raise InputError(
                f"`controls` {self.name}:{keys_outside_object[0]} and "
                f"`backdrop={scene.backdrop_photograph.spec}` contradict each other: "
                "everything but the object is the photograph; leave one of the two out"
            )

    def list_parameter_specs(self) -> Iterator[tuple[Parameter, Fixed | Range | OneOf]]:
        """Yield one parameter for each number that was set, with its range or value.

        A color has three parameters, one for each channel.

        Raises:
            InputError: a color is set to a list of values.
        """
        for plugin_number in self._get_numbers():
            # the spec of a single number, or of all channels of a color
            full_spec = self.specs.get(plugin_number.key)
            self._check_is_no_list_of_colors(plugin_number, full_spec)
            parameters = _make_channel_parameters(plugin_number)
            for parameter, value in zip(parameters, plugin_number.values, strict=True):
                # The spec of a channel, such as KEY.red, takes precedence.
                spec = self.specs.get(parameter.name, full_spec or Fixed(value))
                yield replace(parameter, default=value), spec

    def _check_is_no_list_of_colors(
        self, number: parts.PluginNumber, spec: Fixed | Range | OneOf | None
    ) -> None:
        """Raise InputError if a color is set to a list of values."""
        is_color = len(number.values) > 1
        if isinstance(spec, OneOf) and is_color:
            raise InputError(
                f"`controls` {self.name}:{number.key}: expected a range, "
                "because it is a colour; only a channel can have a list of values, "
                "such as "
                f"{self.name}:{number.key}.{color.CHANNELS[0]}"
            )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the numbers and colors by the inputs that set them."""
        inputs = {}
        for plugin_number in self._get_numbers():
            channels = _make_channel_parameters(plugin_number)
            inputs[plugin_number.input] = torch.stack(
                [values[channel.name] for channel in channels]
            )
        return inputs

    def must_start_at_clean_value(
        self, parameter: Parameter, spec: Fixed | Range | OneOf
    ) -> bool:
        return not isinstance(spec, Fixed)

    def _get_numbers(self) -> tuple[parts.PluginNumber, ...]:
        """Return the numbers of the scene that this control sets."""
        return next(
            part.numbers
            for part in self.scene.parts
            if isinstance(part, parts.PluginNumbers) and part.name == self.name
        )


def _make_parameter(
    key: str, estimators: tuple[str, ...] = ("differences",)
) -> Parameter:
    """Return the parameter for a number of a scene.

    Args:
        key: Mitsuba's name for the number.
        estimators: valid estimators of its derivative, the preferred one first.
    """
    return Parameter(
        name=key,
        shape=(),
        unit="1",
        low=-Parameter.MAX_VALUE,
        high=Parameter.MAX_VALUE,
        default="the scene's own",  # in words, until the scene is known
        description=f"Mitsuba's {key}.",
        estimators=estimators,
    )


def _make_channel_parameters(number: parts.PluginNumber) -> list[Parameter]:
    """Return a parameter for a number, or one for each channel of a color."""
    is_color = len(number.values) > 1
    names = [number.key]
    if is_color:
        names = [f"{number.key}.{channel}" for channel in color.CHANNELS]
    estimators = number.valid
    return [_make_parameter(name, estimators) for name in names]
