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
        if not self._given:
            raise InputError(
                f"`controls` {self.name}: expected Mitsuba's names, as in "
                "mitsuba:KEY=[low, high]"
            )

    @classmethod
    def declared(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        return tuple(_parameter(key) for key in settings)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        return scene.with_part(
            parts.PluginNumbers(
                self.name,
                mitsuba_data.plugin_numbers(scene, self.name, tuple(self._given)),
            )
        )

    def laid_out(self) -> Iterator[tuple[Parameter, Fixed | Range | OneOf]]:
        """Yield one parameter for each number of what was set, with its spec.

        Raises InputError: a color has a list of values.
        """
        for number in self._numbers():
            whole = self.specs.get(number.key)
            if isinstance(whole, OneOf) and len(number.values) > 1:
                raise InputError(
                    f"`controls` {self.name}:{number.key}: expected a range, because "
                    "it is a colour; values one by one "
                    "are for one channel, such as "
                    f"{self.name}:{number.key}.{color.CHANNELS[0]}"
                )
            for parameter, value in zip(_channels(number), number.values, strict=True):
                spec = self.specs.get(parameter.name, whole or Fixed(value))
                yield replace(parameter, default=value), spec

    def scene_inputs(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        return {
            number.input: torch.stack(
                [values[channel.name] for channel in _channels(number)]
            )
            for number in self._numbers()
        }

    def is_compared(self, parameter: Parameter, spec: Fixed | Range | OneOf) -> bool:
        return not isinstance(spec, Fixed)

    def _numbers(self) -> tuple[parts.PluginNumber, ...]:
        return next(
            one.numbers
            for one in self.scene.parts
            if isinstance(one, parts.PluginNumbers) and one.name == self.name
        )


def _parameter(key: str, valid: tuple[str, ...] = ("differences",)) -> Parameter:
    """Return the parameter of a number by Mitsuba's name for it."""
    return Parameter(
        key,
        (),
        "1",
        -Parameter.LARGEST,
        Parameter.LARGEST,
        "the scene's own",
        f"Mitsuba's {key}.",
        estimators=valid,
    )


def _channels(one: parts.PluginNumber) -> list[Parameter]:
    """Return a parameter for each number."""
    names = (
        [f"{one.key}.{channel}" for channel in color.CHANNELS]
        if len(one.values) > 1
        else [one.key]
    )
    return [_parameter(name, one.valid) for name in names]
