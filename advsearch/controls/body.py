"""The `body` control: what someone is like and how they stand or walk, by the rig of the object or another mesh."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from advsearch.controls.base import Parameter, Value
from advsearch.controls.numbers import NumberControl, Values
from advsearch.controls.values import Number
from advsearch.errors import InputError
from advsearch.scene.assets import Rig
from advsearch.scene.people import PARAMETERS


class BodyControl(NumberControl):
    """What a person is like, and how they stand or walk."""

    kind = "body"
    of_a_mesh = True
    summary = "What a person is like, and how they stand or walk."
    parameters = PARAMETERS

    @property
    def rig(self) -> Rig:
        """What moves the mesh."""
        mesh = self.mesh_in(self.scene)
        if mesh.mesh.rig is None:
            raise InputError(f"`controls` {self.name}: {mesh.name} has no joints; take `object=person`")
        return mesh.mesh.rig

    def fit(self) -> None:
        self.rig  # noqa: B018 - refuses a mesh without
        super().fit()

    def default(self, parameter: Parameter) -> Number:
        return self.rig.defaults.get(parameter.name, super().default(parameter))

    def scene_inputs(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {f"{self.mesh}.offsets": self.rig.offsets(values)}

    def measured(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Value]:
        return dict(self.rig.measured(values))
