"""The `mitsuba` control: any number or colour of a scene by Mitsuba's own name, a key
of `mitsuba.traverse`.

The object under test is called `object` there. Of a colour, each channel is a number in
the same range; `KEY.red` is one. Whether Mitsuba's derivative is right nobody knows
beforehand: `advsearch check` compares it with differences.
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
    """Anything else in the scene: numbers and colours by Mitsuba's own names."""

    kind = "mitsuba"
    parameters = ()

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

        A name is e.g. "mug.bsdf.reflectance".

        Raises:
            InputError: the scene has no such number; or it does not belong to the
                object, and the surroundings are a photograph.
        """
        others = [key for key in self._settings if not key.startswith("object.")]
        if scene.backdrop_photograph is not None and others:
            raise InputError(
                f"`controls` {self.name}:{others[0]} and "
                f"`backdrop={scene.backdrop_photograph.spec}` contradict each other: "
                "the photograph shows what is not the object; leave one of the two out"
            )
        return scene.with_part(
            parts.PluginNumbers(
                self.name,
                mitsuba_data.find_plugin_numbers(
                    scene, self.name, tuple(self._settings)
                ),
            )
        )

    def list_parameter_specs(self) -> Iterator[tuple[Parameter, Fixed | Range | OneOf]]:
        """Yield one parameter for each number that was set, with its range or value.

        A color has three parameters, one for each channel.

        Raises:
            InputError: a color was given a list of values.
        """
        for plugin_number in self._get_numbers():
            color_spec = self.specs.get(plugin_number.key)
            if isinstance(color_spec, OneOf) and len(plugin_number.values) > 1:
                raise InputError(
                    f"`controls` {self.name}:{plugin_number.key}: expected a range, "
                    "because "
                    "it is a colour; values one by one "
                    "are for one channel, such as "
                    f"{self.name}:{plugin_number.key}.{color.CHANNELS[0]}"
                )
            for parameter, value in zip(
                _make_channel_parameters(plugin_number),
                plugin_number.values,
                strict=True,
            ):
                spec = self.specs.get(parameter.name, color_spec or Fixed(value))
                yield replace(parameter, default=value), spec

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

    def must_match_scene(
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


def _make_parameter(key: str, valid: tuple[str, ...] = ("differences",)) -> Parameter:
    """Return the parameter of a number by Mitsuba's name for it."""
    return Parameter(
        key,
        (),
        "1",
        -Parameter.MAX_VALUE,
        Parameter.MAX_VALUE,
        "the scene's own",
        f"Mitsuba's {key}.",
        estimators=valid,
    )


def _make_channel_parameters(number: parts.PluginNumber) -> list[Parameter]:
    """Return a parameter for each number."""
    names = (
        [f"{number.key}.{channel}" for channel in color.CHANNELS]
        if len(number.values) > 1
        else [number.key]
    )
    return [_make_parameter(name, number.valid) for name in names]
