"""The space of a run: its controls composed into one unit box, each a contiguous slice of u."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.controls.base import BoundControl, Group, Value
from advsearch.errors import InputError
from advsearch.scene.description import SceneDescription
from advsearch.scene.plan import WITH_BOUNDARY, GroupPlan


@dataclass(frozen=True, eq=False)
class Space:
    """Bound controls in the order of their slices.

    Attributes:
        controls: at least none; an empty space renders the scene as it is.
        scene: the scene with everything in it that the controls need; None leaves it to the caller.

    Raises:
        InputError: two instances have one name.
    """

    controls: tuple[BoundControl, ...]
    scene: SceneDescription | None = None

    def __post_init__(self) -> None:
        names = [control.name for control in self.controls]
        if len(set(names)) != len(names):
            raise InputError(f"--control: every instance needs a name of its own, got {', '.join(names)}")

    @property
    def start(self) -> Tensor:
        """(d,) float32 in [0, 1]: the configuration that leaves the scene as it is."""
        return torch.cat([control.start for control in self.controls]) if self.controls else torch.zeros(0)

    @property
    def groups(self) -> tuple[tuple[BoundControl, Group], ...]:
        """Every group of coordinates with its control, in the order of u."""
        return tuple((control, group) for control in self.controls for group in control.groups)

    def group_plans(self) -> tuple[GroupPlan, ...]:
        """Return every group as the gradient plan wants it, without an estimator yet.

        Adjoints with boundary terms know neither a medium nor a backdrop nor a thin lens, so that they are not valid
        beside these.
        """
        scene = self.scene
        unknown = scene is not None and (
            scene.backdrop or scene.thin_lens or any(part.volumetric for part in scene.parts)
        )
        found, begin = [], 0
        for control, group in self.groups:
            valid = tuple(one for one in group.estimators if not (unknown and one in WITH_BOUNDARY))
            one = GroupPlan(control.name, group.name, begin, group.size, "none", valid, periodic=group.periodic)
            found.append(one)
            begin += group.size
        return tuple(found)

    def slices(self, u: Tensor) -> Sequence[tuple[BoundControl, Tensor]]:
        """Return each control with its slice of u."""
        parts = torch.split(u, [len(control.start) for control in self.controls]) if self.controls else ()
        return list(zip(self.controls, parts, strict=True))

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u to scene inputs, by differentiable torch operations.

        Controls that refine what others set come last, whatever the order in which they were asked for.

        Raises:
            InputError: two controls set one input.
        """
        merged: dict[str, Tensor] = {}
        for control, part in sorted(self.slices(u), key=lambda one: bool(one[0].refines)):
            for name, tensor in control.inputs(part, merged).items():
                if name in merged and name not in control.refines:
                    raise InputError(f"--control: two controls set {name}; leave one of them out")
                merged[name] = tensor
        return merged

    def picture(self, u: Tensor, image: Tensor) -> Tensor:
        """Apply what controls do to the finished picture (H, W, 3) sRGB, in their order; differentiable in both."""
        for control, part in self.slices(u):
            image = control.picture(part, image)
        return image

    def describe(self, u: Tensor) -> dict[str, Value]:
        """Say a configuration in a few named values with units."""
        return {name: value for control, part in self.slices(u) for name, value in control.describe(part).items()}

    def artifacts(self, u: Tensor) -> dict[str, Tensor]:
        """Return the pictures worth keeping of a configuration, by file stem."""
        return {name: image for control, part in self.slices(u) for name, image in control.artifacts(part).items()}

    def files(self, u: Tensor) -> dict[str, bytes]:
        """Return the other files worth keeping of a configuration, by name."""
        return {name: data for control, part in self.slices(u) for name, data in control.files(part).items()}
