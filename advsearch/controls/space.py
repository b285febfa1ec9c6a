"""The space of a run: its controls composed into one unit box, each a contiguous slice of u."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.controls.base import BoundControl, Value
from advsearch.errors import InputError


@dataclass(frozen=True, eq=False)
class Space:
    """Bound controls in the order of their slices.

    Attributes:
        controls: at least none; an empty space renders the scene as it is.

    Raises:
        InputError: two instances have one name.
    """

    controls: tuple[BoundControl, ...]

    def __post_init__(self) -> None:
        names = [control.name for control in self.controls]
        if len(set(names)) != len(names):
            raise InputError(f"--control: every instance needs a name of its own, got {', '.join(names)}")

    @property
    def start(self) -> Tensor:
        """(d,) float32 in [0, 1]: the configuration that leaves the scene as it is."""
        return torch.cat([control.start for control in self.controls]) if self.controls else torch.zeros(0)

    def slices(self, u: Tensor) -> Sequence[tuple[BoundControl, Tensor]]:
        """Return each control with its slice of u."""
        parts = torch.split(u, [len(control.start) for control in self.controls]) if self.controls else ()
        return list(zip(self.controls, parts, strict=True))

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u to scene inputs, by differentiable torch operations."""
        merged: dict[str, Tensor] = {}
        for control, part in self.slices(u):
            for name, tensor in control.inputs(part).items():
                if name in merged:
                    raise InputError(f"--control: two controls set {name}; leave one of them out")
                merged[name] = tensor
        return merged

    def describe(self, u: Tensor) -> dict[str, Value]:
        """Say a configuration in a few named values with units."""
        return {name: value for control, part in self.slices(u) for name, value in control.describe(part).items()}

    def artifacts(self, u: Tensor) -> dict[str, Tensor]:
        """Return the pictures worth keeping of a configuration, by file stem."""
        return {name: image for control, part in self.slices(u) for name, image in control.artifacts(part).items()}
