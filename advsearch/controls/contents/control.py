"""The `contents` control: what a vessel is filled with, and how high: water, coffee and milk in any proportions.

The surface of the liquid is a level disc that follows the inside of the vessel (`vessel`). Its colour
is worked out in linear light from the proportions: absorption and scattering of coffee and milk add up by their
amounts (Kubelka and Munk 1931), and water lets the vessel show through:

    K / S = sum(p_i K_i) / sum(p_i S_i),   milky coffee = 1 + K/S - sqrt((K/S)^2 + 2 K/S)
    color = opacity * milky coffee + (1 - opacity) * vessel * tint of water,   opacity = 1 - exp(-DENSITY (1 - water))

Proportions add up to one in every configuration. The two that are free are cut off a stick of length one in turn, each
from what the ones before leave; a range for an ingredient narrows where the stick may be cut.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import NOTHING, Parameter, Value
from advsearch.controls.contents.vessel import COLUMNS, Vessel, interior
from advsearch.controls.numbers import BoundNumbers, NumberControl, Values
from advsearch.controls.values import Fixed, Number, OneOf, Range, Spec
from advsearch.errors import InputError
from advsearch.scene.assets import Floats, Material, Mesh
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import object_to_world
from advsearch.scene.parts import MeshPart
from advsearch.scene.settings import ORBIT, moving

INGREDIENTS = ("water", "milk", "coffee")
"""In the order in which they are cut off the stick; what the first two leave is coffee."""
REFLECTANCE = {"milk": (0.84, 0.80, 0.70), "coffee": (0.040, 0.016, 0.007)}
"""Linear reflectance of a deep cup of each."""
SCATTERING = {"milk": 1.0, "coffee": 0.10}
"""How strongly each scatters, relative to milk."""
WATER = (0.86, 0.94, 0.95)
"""What a cup of water leaves of the light that has been to the bottom and back."""
DENSITY = 7.0
"""How fast coffee and milk make water opaque: a tenth of them hides half of the vessel's floor."""
TOTAL = 1e-6
"""How far proportions may miss one."""
RADIUS = 0.995
"""The disc ends this close to the wall, as a share of its distance."""
FIRST = 0.02
"""Below this level the disc is drawn together and sunk into the floor, so that an empty vessel shows none of it."""
SURFACE = Material(roughness=0.08, specular=0.5)


def _ingredient(name: str, default: float, text: str) -> Parameter:
    return Parameter(name, (), "1", 0.0, 1.0, default, text, search=(0.0, 1.0), estimators=("adjoint", "differences"))


class ContentsControl(NumberControl):
    """What a vessel is filled with, and how high.

    Raises:
        InputError: proportions that cannot add up to one.
    """

    kind: ClassVar[str] = "contents"
    amount: ClassVar[str | None] = "level"
    summary: ClassVar[str] = "What a vessel is filled with, and how high: water, coffee and milk."
    parameters: ClassVar[tuple[Parameter, ...]] = (
        moving(
            ORBIT, "level", "1", 0.0, 1.0, 0.0, "Height of the liquid: 0 is empty, 1 is full to the brim.", (0.0, 0.95)
        ),
        _ingredient("water", 0.0, "Share of water."),
        _ingredient("milk", 0.0, "Share of milk."),
        _ingredient("coffee", 1.0, "Share of coffee."),
    )

    def __init__(self, name: str | None = None, **settings: object) -> None:
        super().__init__(name, **settings)
        self.bounds = self._feasible()

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        vessel = self._vessel(scene)
        mesh = _disc(_surface(vessel, torch.tensor(0.5)).numpy())
        color = np.zeros((4, 4, 3), dtype=np.float32)
        return scene.with_part(MeshPart(self.name, mesh, object_to_world(scene), color, SURFACE))

    def bind(self, scene: SceneDescription) -> BoundContents:
        return BoundContents(self, super().bind(scene))

    def refines(self, scene: SceneDescription) -> frozenset[str]:
        """Nothing is changed; but it has to come after whatever moves the vessel."""
        return frozenset({"object.to_world"})

    def scene_inputs(self, scene: SceneDescription, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        vessel = self._vessel(scene)
        base = _surface(vessel, torch.full_like(values["level"], 0.5))
        inputs = {f"{self.name}.offsets": _surface(vessel, values["level"]) - base}
        if "object.to_world" in so_far:
            inputs[f"{self.name}.to_world"] = so_far["object.to_world"]
        shares = torch.stack([values[name] for name in INGREDIENTS])
        color = liquid(shares, torch.from_numpy(vessel.color).to(shares))
        inputs[f"{self.name}.base_color"] = color.expand(4, 4, 3)
        return inputs

    # ---- proportions ------------------------------------------------------------------------------------------------

    def _feasible(self) -> dict[str, tuple[float, float]]:
        """The range of every ingredient: as given; free if not given and searched; or what the given ones leave."""
        bounds: dict[str, tuple[float, float]] = {}
        for name in INGREDIENTS:
            spec = self.specs.get(name)
            if isinstance(spec, OneOf):
                raise InputError(
                    f"{self.name}.{name}: expected a number or a range [low, high], got a list of values; a choice "
                    "among proportions would not add up to 1"
                )
            if isinstance(spec, Fixed):
                bounds[name] = (float(spec.value), float(spec.value))
            elif isinstance(spec, Range):
                bounds[name] = (spec.low, spec.high)
        least, most = sum(low for low, _ in bounds.values()), sum(high for _, high in bounds.values())
        if least > 1.0 + TOTAL or (len(bounds) == len(INGREDIENTS) and most < 1.0 - TOTAL):
            said = ", ".join(f"{name} {_said(*bounds[name])}" for name in INGREDIENTS if name in bounds)
            raise InputError(
                f"`controls` {self.name}: expected proportions of water, milk and coffee that add up to 1, got {said}; "
                "change one of them or leave one out"
            )
        searched = not self.asked or any(isinstance(self.specs.get(name), Range) for name in INGREDIENTS)
        rest = max(0.0, 1.0 - least)
        for name in ("coffee", "water", "milk"):
            if name not in bounds:
                bounds[name] = (0.0, rest) if searched else (rest, rest)
                rest = rest if searched else 0.0
        return bounds

    def _spec(self, scene: SceneDescription, parameter: Parameter, value: Number) -> Spec:
        """An ingredient's coordinate is where the stick is cut, from 0 to 1 of what is possible there."""
        if parameter.name not in INGREDIENTS:
            return super()._spec(scene, parameter, value)
        return Range(0.0, 1.0) if parameter.name in self._free() else Fixed(0.0)

    def _free(self) -> tuple[str, ...]:
        """The ingredients that have a coordinate."""
        wide = [name for name in INGREDIENTS if self.bounds[name][1] > self.bounds[name][0]]
        return tuple(wide[:-1])

    def proportions(self, cuts: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Cut the stick: coordinates in [0, 1] by ingredient to shares that add up to one; differentiable."""
        bounds = self._bounds(cuts[INGREDIENTS[0]].device)
        left, shares = torch.ones_like(bounds[0][0]), []
        for number, name in enumerate(INGREDIENTS):
            low, high = self._range(bounds, number, left)
            shares.append(low + (high - low).clamp_min(0.0) * cuts[name])
            left = left - shares[-1]
        return dict(zip(INGREDIENTS, shares, strict=True))

    def cuts(self, shares: Mapping[str, float]) -> dict[str, float]:
        """Return the coordinates whose shares are nearest to some, one ingredient after the other."""
        bounds = self._bounds(torch.device("cpu"))
        left, found = torch.ones_like(bounds[0][0]), {}
        for number, name in enumerate(INGREDIENTS):
            low, high = (float(one) for one in self._range(bounds, number, left))
            share = min(max(shares[name], low), max(low, high))
            found[name] = (share - low) / (high - low) if high > low else 0.0
            left = left - share
        return found

    def _bounds(self, device: torch.device) -> list[tuple[Tensor, Tensor]]:
        """The least and the most of every ingredient, each ()."""
        limits = torch.tensor([self.bounds[name] for name in INGREDIENTS]).to(device)
        return [(low, high) for low, high in limits]

    @staticmethod
    def _range(bounds: list[tuple[Tensor, Tensor]], number: int, left: Tensor) -> tuple[Tensor, Tensor]:
        """What one ingredient may have of what is left, so that those after it can make up one."""
        low, high = bounds[number]
        after = bounds[number + 1 :]
        least, most = (
            sum((one for one, _ in after), torch.zeros_like(left)),
            sum((one for _, one in after), torch.zeros_like(left)),
        )
        return torch.maximum(low, left - most), torch.minimum(high, left - least)

    # ---- the vessel -------------------------------------------------------------------------------------------------

    def _vessel(self, scene: SceneDescription) -> Vessel:
        found = interior(scene.object)
        if found is None:
            raise InputError(
                f"`controls` {self.name}: expected a vessel, open at the top and closed around and below (a mug, a "
                f"bowl, a glass), got {scene.object.name!r}; choose another object or leave the control out"
            )
        return found


class BoundContents(BoundNumbers):
    """A filled vessel: coordinates are cuts of a stick, values are proportions.

    Args:
        control: the control.
        bound: the same, bound as plain numbers.
    """

    control: ContentsControl

    def __init__(self, control: ContentsControl, bound: BoundNumbers) -> None:
        super().__init__(control, bound.scene, bound.slots)
        wanted = {one.name: float(one.default) for one in control.parameters if one.name in INGREDIENTS}
        cuts = control.cuts(wanted)
        for slot in self.slots:
            if slot.width and slot.parameter.name in cuts:
                self.start[slot.begin] = cuts[slot.parameter.name]

    def values(self, u: Tensor) -> dict[str, Tensor]:
        values = super().values(u)
        return {**values, **self.control.proportions(values)}

    def describe(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Value]:
        values = self.values(u.detach())
        said = super().describe(u, so_far)
        for name in INGREDIENTS:
            said[f"{self.name}.{name}"] = {"value": float(values[name]), "unit": "1"}
        return said


def _said(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


# ---- how it looks ---------------------------------------------------------------------------------------------------


def liquid(shares: Tensor, vessel: Tensor) -> Tensor:
    """Return the linear reflectance (3,) of a cup of water, milk and coffee.

    Args:
        shares: (3,) proportions in the order of `INGREDIENTS`.
        vessel: (3,) linear reflectance of the vessel's inside.
    """
    amounts = dict(zip(INGREDIENTS, shares, strict=True))
    absorbed, scattered = shares.new_zeros(3), shares.new_tensor(1e-6)
    for name, reflectance in REFLECTANCE.items():
        deep = shares.new_tensor(reflectance)
        absorbed = absorbed + amounts[name] * SCATTERING[name] * (1.0 - deep).square() / (2.0 * deep)
        scattered = scattered + amounts[name] * SCATTERING[name]
    ratio = absorbed / scattered
    milky = 1.0 + ratio - (ratio.square() + 2.0 * ratio + 1e-9).sqrt()
    opacity = 1.0 - torch.exp(-DENSITY * (amounts["milk"] + amounts["coffee"]))
    return opacity * milky + (1.0 - opacity) * vessel * shares.new_tensor(WATER)


def _surface(vessel: Vessel, level: Tensor) -> Tensor:
    """Vertices (1 + COLUMNS, 3) of the liquid's surface in mesh coordinates, the middle first.

    The wall's distance is interpolated between the heights at which it is known, so the vertices are differentiable in
    the level, with kinks at those heights.
    """
    heights, radii = torch.from_numpy(vessel.heights).to(level), torch.from_numpy(vessel.radii).to(level)
    place = level * (len(heights) - 1)
    row = int(place.detach().clamp(0, len(heights) - 2))
    radius = torch.lerp(radii[row], radii[row + 1], place - row) * RADIUS
    there = (level / FIRST).clamp(1e-3, 1.0)
    depth = heights[-1] - heights[0]
    height = heights[0] + level * depth - (1.0 - there) * FIRST * depth
    angle = torch.arange(COLUMNS, device=level.device) * (2.0 * torch.pi / COLUMNS)
    around = torch.stack([torch.cos(angle), torch.sin(angle)], dim=1) * (radius * there)[:, None]
    flat = torch.cat([around.new_zeros(1, 2), around]) + torch.from_numpy(vessel.axis).to(level)
    return torch.cat([flat, height.expand(len(flat), 1)], dim=1)


def _disc(vertices: Floats) -> Mesh:
    """The surface as a mesh: a fan around its middle, facing upwards."""
    ring = np.arange(COLUMNS)
    faces = np.stack([np.zeros_like(ring), 1 + ring, 1 + (ring + 1) % COLUMNS], axis=1)
    angle = ring * 2.0 * np.pi / COLUMNS
    around = 0.5 + 0.45 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    uvs = np.concatenate([[(0.5, 0.5)], around])
    normals = np.tile(np.array([0.0, 0.0, 1.0], dtype=np.float32), (len(vertices), 1))
    return Mesh(vertices.astype(np.float32), faces.astype(np.uint32), normals, uvs.astype(np.float32))
