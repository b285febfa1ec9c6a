"""The `material` control: how the object's surface reflects, its tint, and which named material it is made of.

    base_color = linear(tint) * (the object's texture, or the named material's pattern)

The numbers are those of the principled BSDF (Burley, *Physically based shading at Disney*, SIGGRAPH 2012 course notes).
A named material has a seamless pattern and numbers of its own, as in 3DB (Leclerc et al. 2021, arXiv 2106.03805).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import torch
from torch import Tensor

from advsearch.controls.base import Parameter
from advsearch.controls.material_patterns import PATTERNS, covering
from advsearch.controls.numbers import NumberControl, Values
from advsearch.controls.values import Number
from advsearch.errors import InputError
from advsearch.scene.assets import Material, Mesh
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.settings import CHANNELS, MATERIAL, colors

OWN = "own"
NUMBERS = tuple(one.name for one in MATERIAL)


class MaterialControl(NumberControl):
    """The object's gloss, metal, coat and tint, and which named material covers it."""

    kind = "material"
    of_a_mesh = True
    summary = "The object's gloss, metal, coat and tint, and which named material covers it."
    parameters = (
        Parameter(
            "which", (), "name", 0.0, float(len(PATTERNS)), OWN,
            "The object's own surface, or a named material in its place.", options=(OWN, *PATTERNS),
        ),
        *MATERIAL,
        *colors("of the tint that multiplies the colour; 1 leaves it.", (0.3, 1.0)),
    )  # fmt: skip

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        numbers = [name for name in NUMBERS if self._varies(name)]
        if self.mesh_in(scene).surface is not None and (numbers or self._names != (OWN,)):
            raise InputError(
                f"`controls` {self.name}: the {self.mesh} has a surface of Mitsuba's own; search red, green or blue, "
                f"or its numbers by Mitsuba's names, mitsuba:{self.mesh}.bsdf.KEY=[low, high]"
            )
        return scene

    def default(self, parameter: Parameter) -> Number:
        if parameter.name in NUMBERS:
            first = OWN if OWN in self._names else str(self._names[0])  # the fixed or first material
            return float(getattr(self._own(first), parameter.name))
        return parameter.default

    def unchanged(self, parameter: Parameter) -> Number:
        given = self.setting(parameter) in self.scene.given
        return self.scene.number(self.setting(parameter)) if given else self.default(parameter)

    @property
    def refines(self) -> frozenset[str]:
        return frozenset({self._base_color}) if self._colours() else frozenset()

    def scene_inputs(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        which = (OWN, *PATTERNS)[int(values["which"])]
        material = self._own(which)
        inputs: dict[str, Tensor] = {}
        for name in NUMBERS:
            if self._varies(name):
                inputs[f"{self.mesh}.{name}"] = values[name].reshape(1)
            elif self._names != (OWN,):
                inputs[f"{self.mesh}.{name}"] = values["which"].new_tensor([float(getattr(material, name))])
        if self._colours():
            tint = torch.stack([values[name] for name in CHANNELS])
            inputs[self._base_color] = srgb_to_linear(tint) * self._reflectance(which, so_far).to(tint.device)
        return inputs

    def kept_pictures(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        if not self._colours():
            return {}
        return {self.name: linear_to_srgb(self.scene_inputs(values, so_far)[self._base_color])}

    @property
    def _base_color(self) -> str:
        return f"{self.mesh}.base_color"

    @property
    def _names(self) -> tuple[Number, ...]:
        return self.allowed("which", OWN)

    def _varies(self, name: str) -> bool:
        """Whether a parameter was set or is searched; otherwise it is the named material's own."""
        return name in self.specs or not self.asked

    def _colours(self) -> bool:
        return self._names != (OWN,) or any(self._varies(name) for name in CHANNELS)

    def _own(self, which: str) -> Material:
        return self.mesh_in(self.scene).material if which == OWN else PATTERNS[which].material

    def _reflectance(self, which: str, so_far: Mapping[str, Tensor]) -> Tensor:
        """Linear reflectance (h, w, 3) before the tint: what the controls before made of the texture, or a pattern."""
        if which == OWN:
            before = so_far.get(self._base_color)
            own = self.mesh_in(self.scene).base_color
            return srgb_to_linear(torch.from_numpy(own.copy())) if before is None else before
        return _linear_covering(self.mesh_in(self.scene).mesh, which)


@lru_cache(maxsize=len(PATTERNS))
def _linear_covering(mesh: Mesh, which: str) -> Tensor:
    return srgb_to_linear(torch.from_numpy(covering(mesh, which)))
