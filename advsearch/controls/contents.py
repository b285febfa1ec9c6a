"""The `contents` control: what a vessel is filled with, and how high: water, coffee and
milk in any proportions.

Rain that cannot run off the mesh (a height map with its basins filled: Barnes, Lehman
and Mulla 2014, arXiv 1511.04463, section 2) marks the inside; rays from its axis find
the wall. Colours are in linear light (Kubelka and Munk 1931):

    K / S = sum(p_i K_i) / sum(p_i S_i),   milky coffee = 1 + K/S - sqrt((K/S)^2 + 2 K/S)
    color = opacity * milky coffee + (1 - opacity) * vessel * tint of water,   opacity = 1 - exp(-DENSITY (1 - water))

Proportions add up to one: the two that are free are cut off a stick of length one in
turn, each from what is left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from advsearch.extend import (
    Control,
    Fixed,
    InputError,
    OneOf,
    Parameter,
    Range,
    SceneDescription,
    Value,
    Values,
    assets,
    color,
    geometry,
    images,
    parts,
)

GRID = 128  # cells of the height map along the longer side of the mesh
ROWS = 40  # heights at which the wall is looked for
COLUMNS = 96  # directions in which it is looked for
SHALLOWEST = 0.03  # smallest depth of a vessel in object sizes
NARROWEST = 5e-4  # smallest opening of a vessel in squared object sizes
CLOSED = 0.97  # share of the rays that have to meet the wall
BRIM = 0.985  # a full vessel is filled to this share of its depth

INGREDIENTS = ("water", "milk", "coffee")
"""In the order in which they are cut off the stick; what the first two leave is
coffee.
"""
# linear reflectance of a deep cup of each
REFLECTANCE = {"milk": (0.84, 0.80, 0.70), "coffee": (0.040, 0.016, 0.007)}
# how strongly each scatters, relative to milk
SCATTERING = {"milk": 1.0, "coffee": 0.10}
# what a cup of water leaves of the light that has been to the bottom and back
WATER = (0.86, 0.94, 0.95)
# how fast coffee and milk make water opaque: a tenth of them hides half of the vessel's
# floor
DENSITY = 7.0
TOTAL = 1e-6  # how far proportions may miss one
RADIUS = 0.995  # the disc ends this close to the wall, as a share of its distance
FIRST = 0.02
"""Below this level the disc is drawn together and sunk into the floor, so that an empty
vessel shows none of it.
"""
SURFACE = assets.Material(roughness=0.08, specular=0.5)


_lit = partial(Parameter.number, Parameter.LIT)


@dataclass(frozen=True, eq=False)
class Vessel:
    """The inside of a vessel that stands upright."""

    axis: assets.Doubles  # (2,) x and y of the line that the wall is seen from
    heights: assets.Doubles  # (R,) evenly spaced z, from the floor to the brim
    # (R, K) distance of the wall from the axis, in K even directions from +x
    # counter-clockwise
    radii: assets.Doubles
    color: assets.Doubles  # (3,) linear reflectance of the wall's lower half


@lru_cache(maxsize=8)
def interior(asset: assets.ObjectAsset) -> Vessel | None:
    """Find the inside of an object in its default pose; None if it is no vessel."""
    mesh = asset.mesh
    basin = _basin(mesh)
    if basin is None:
        return None
    axis, floor, rim = basin
    heights = np.linspace(floor, floor + BRIM * (rim - floor), ROWS)
    inset = 0.004 * (rim - floor)  # a ray along a flat floor would see anything
    rows = [_wall(mesh, axis, max(float(height), floor + inset)) for height in heights]
    radii = np.stack([row[0] for row in rows])
    faces = np.concatenate([row[1] for row in rows[: ROWS // 2]])
    met = np.isfinite(radii)
    if met.mean() < CLOSED or not met.any(axis=1).all():
        return None
    middle = np.array([np.median(row[np.isfinite(row)]) for row in radii])
    # middles of faces in the texture
    places = mesh.uvs[mesh.faces[faces[faces >= 0]].astype(np.int64)].mean(axis=1)
    places -= np.floor(places) if mesh.repeats else 0.0
    height, width = asset.base_color.shape[:2]
    column = np.clip((places[:, 0] * width).astype(np.int64), 0, width - 1)
    row = np.clip(((1.0 - places[:, 1]) * height).astype(np.int64), 0, height - 1)
    wall_color = color.srgb_to_linear(asset.base_color[row, column]).mean(axis=0)
    radii = np.where(met, radii, middle[:, None])
    return Vessel(axis, heights, radii, np.asarray(wall_color, dtype=np.float64))


def _basin(mesh: assets.Mesh) -> tuple[assets.Doubles, float, float] | None:
    """Return the axis (2,), the floor and the rim of the largest basin, or None if
    there is none worth the name.
    """
    low, cell, ground = _height_map(mesh)
    water = _filled(ground)
    labels, count = ndimage.label(water - ground > 1e-3)
    if count == 0:
        return None
    volumes = ndimage.sum_labels(water - ground, labels, np.arange(1, count + 1))
    mine = labels == 1 + int(np.argmax(volumes))
    depth = np.where(mine, water - ground, 0.0)
    if depth.max() < SHALLOWEST or mine.sum() * cell * cell < NARROWEST:
        return None
    row, column = np.nonzero(mine)
    weight = depth[mine]
    axis = (
        low
        + cell
        * np.array([(column * weight).sum(), (row * weight).sum()])
        / weight.sum()
    )
    return axis, float(ground[mine].min()), float(water[mine].max())


def _height_map(mesh: assets.Mesh) -> tuple[assets.Doubles, float, assets.Doubles]:
    """Highest surface over a grid with an empty margin: place of cell (0, 0), side of a
    cell, (h, w) heights. Edges are drawn as well as faces, so that a thin upright wall
    is not missed between two cells.
    """
    vertices = mesh.vertices.astype(np.float64)
    low = vertices[:, :2].min(axis=0)
    high = vertices[:, :2].max(axis=0)
    cell = float((high - low).max()) / GRID
    low = low - 1.5 * cell
    width, height = (np.ceil((high - low) / cell).astype(np.int64) + 2).tolist()
    ground = np.full((height, width), vertices[:, 2].min() - 1.0)
    corners = vertices[mesh.faces.astype(np.int64)]
    placed = (corners[..., :2] - low) / cell
    face, row, column, weights = images.pixels_in(placed, (height, width))
    np.maximum.at(ground, (row, column), (weights * corners[face, :, 2]).sum(axis=1))
    for share in np.linspace(0.0, 1.0, 9):
        for begin, end in ((0, 1), (1, 2), (2, 0)):
            place = np.rint(
                placed[:, begin] + share * (placed[:, end] - placed[:, begin])
            ).astype(np.int64)
            at = corners[:, begin, 2] + share * (
                corners[:, end, 2] - corners[:, begin, 2]
            )
            np.maximum.at(ground, (place[:, 1], place[:, 0]), at)
    return low, cell, ground


def _filled(ground: assets.Doubles) -> assets.Doubles:
    """The level of water on a height map (h, w) from whose edges it runs off. Every
    cell stands as high as its ground or its lowest neighbour's water, whichever is
    higher; repeated until nothing changes.
    """
    water = np.full_like(ground, np.inf)
    water[[0, -1]], water[:, [0, -1]] = ground[[0, -1]], ground[:, [0, -1]]
    while True:
        beside = (water[:-2, 1:-1], water[2:, 1:-1], water[1:-1, :-2], water[1:-1, 2:])
        lowest = np.minimum.reduce(beside)
        level = np.maximum(ground[1:-1, 1:-1], np.minimum(lowest, water[1:-1, 1:-1]))
        if np.array_equal(level, water[1:-1, 1:-1]):
            return water
        water[1:-1, 1:-1] = level


def _wall(
    mesh: assets.Mesh, axis: assets.Doubles, height: float
) -> tuple[assets.Doubles, assets.Ints]:
    """Cast level rays from the axis at one height. Returns the (COLUMNS,) distance of
    the first surface in each direction, infinite where there is none, and its face or
    -1.
    """
    corners = mesh.vertices[mesh.faces.astype(np.int64)].astype(np.float64)
    above = corners[..., 2] > height
    face = np.nonzero(above.any(axis=1) & ~above.all(axis=1))[0]
    if not len(face):
        return np.full(COLUMNS, np.inf), np.full(COLUMNS, -1)
    corners = corners[face]
    above = above[face]
    number = np.arange(len(face))
    # the corner on its side
    alone = np.where(
        above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1)
    )
    apex = corners[number, alone]
    ends = []  # of the cut through each face, from the axis
    for step in (1, 2):
        other = corners[number, (alone + step) % 3]
        share = (height - apex[:, 2]) / np.where(
            other[:, 2] == apex[:, 2], 1.0, other[:, 2] - apex[:, 2]
        )
        ends.append(apex[:, :2] + share[:, None] * (other[:, :2] - apex[:, :2]) - axis)
    angle = np.arange(COLUMNS) * 2.0 * np.pi / COLUMNS
    toward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # sides of rays, (COLUMNS, S)
    first, last = (
        toward[:, :1] * end[:, 1] - toward[:, 1:] * end[:, 0] for end in ends
    )
    crossed = (first > 0.0) != (last > 0.0)
    share = first / np.where(crossed, first - last, 1.0)
    distance = (toward @ ends[0].T) * (1.0 - share) + (toward @ ends[1].T) * share
    distance = np.where(crossed & (distance > 0.0), distance, np.inf)
    nearest = distance.argmin(axis=1)
    distance = distance[np.arange(COLUMNS), nearest]
    return distance, np.where(np.isfinite(distance), face[nearest], -1)


class ContentsControl(Control):
    """What a vessel is filled with, and how high: water, coffee and milk.

    Raises:
        InputError: proportions that cannot add up to one.
    """

    kind = "contents"
    amount = "level"
    # which is not changed; but it comes after whatever moves the vessel
    refines = frozenset({"object.to_world"})
    parameters = (
        Parameter.moving(
            Parameter.ORBIT,
            "level",
            "1",
            0.0,
            1.0,
            0.0,
            "Height of the liquid: 0 is empty, 1 is full to the brim.",
            (0.0, 0.95),
        ),
        *(
            _lit(
                name,
                "1",
                0.0,
                1.0,
                float(name == "coffee"),
                f"Share of {name}.",
                (0.0, 1.0),
            )
            for name in INGREDIENTS
        ),
    )

    def __init__(self, name: str | None = None, **settings: object) -> None:
        super().__init__(name, **settings)
        # of every ingredient: as given; free if not given and searched; or what the
        # given ones leave
        bounds = self.bounds = dict[str, tuple[float, float]]()
        for name in INGREDIENTS:
            spec = self.specs.get(name)
            if (
                spec is not None
                and not isinstance(spec, Fixed)
                and type(spec) is not Range
            ):
                got = (
                    "a list of values; a choice"
                    if isinstance(spec, OneOf)
                    else "a distribution; a draw"
                )
                raise InputError(
                    f"{self.name}.{name}: expected a number or a range [low, high], "
                    f"got {got} among proportions would "
                    "not add up to 1"
                )
            if isinstance(spec, Fixed):
                bounds[name] = (float(spec.value), float(spec.value))
            elif isinstance(spec, Range):
                bounds[name] = (spec.low, spec.high)
        least = sum(low for low, _ in bounds.values())
        most = sum(high for _, high in bounds.values())
        if least > 1.0 + TOTAL or (
            len(bounds) == len(INGREDIENTS) and most < 1.0 - TOTAL
        ):
            ends = {
                name: dict.fromkeys(f"{end:g}" for end in bounds[name])
                for name in INGREDIENTS
                if name in bounds
            }
            got = ", ".join(
                f"{name} {' to '.join(pair)}" for name, pair in ends.items()
            )
            raise InputError(
                f"`controls` {self.name}: expected proportions of water, milk and "
                f"coffee that add up to 1, got {got}; "
                "change one of them or leave one out"
            )
        searched = not self.asked or any(
            isinstance(self.specs.get(name), Range) for name in INGREDIENTS
        )
        rest = max(0.0, 1.0 - least)
        for name in ("coffee", "water", "milk"):
            if name not in bounds:
                bounds[name] = (0.0, rest) if searched else (rest, rest)
                rest = rest if searched else 0.0

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        vessel = interior(scene.object)
        if vessel is None:
            raise InputError(
                f"`controls` {self.name}: expected a vessel, open at the top and "
                "closed around and below (a mug, a "
                f"bowl, a glass), got {scene.object.name!r}; choose another object or "
                "leave the control out"
            )
        angle = np.arange(COLUMNS) * 2.0 * np.pi / COLUMNS
        uvs = np.concatenate(
            [
                [(0.5, 0.5)],
                0.5 + 0.45 * np.stack([np.cos(angle), np.sin(angle)], axis=1),
            ]
        )
        vertices = _surface(vessel, torch.tensor(0.5)).numpy()
        mesh = replace(
            parts.polygon(COLUMNS), vertices=vertices, uvs=uvs.astype(np.float32)
        )
        black = np.zeros((4, 4, 3), dtype=np.float32)
        pose = geometry.object_to_world(scene)
        return scene.with_part(
            parts.MeshPart(self.name, mesh, black, SURFACE, to_world=pose)
        )

    def fit(self) -> None:
        super().fit()
        cuts = self.cuts(
            {
                one.name: float(one.default)
                for one in self.parameters
                if one.name in INGREDIENTS
            }
        )
        for slot in self.slots:
            if slot.width and slot.parameter.name in cuts:
                self.start[slot.begin] = cuts[slot.parameter.name]

    def values(self, u: Tensor) -> dict[str, Tensor]:
        values = super().values(u)  # of ingredients, where the stick is cut
        return {**values, **self.proportions(values)}

    def measured(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        return {
            name: Value(value=float(values[name]), unit="1") for name in INGREDIENTS
        }

    def scene_inputs(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        vessel = interior(self.scene.object)
        assert vessel is not None  # see `prepare`
        base = _surface(vessel, torch.full_like(values["level"], 0.5))
        inputs = {f"{self.name}.offsets": _surface(vessel, values["level"]) - base}
        if "object.to_world" in so_far:
            inputs[f"{self.name}.to_world"] = so_far["object.to_world"]
        shares = torch.stack([values[name] for name in INGREDIENTS])
        liquid_color = liquid(shares, torch.from_numpy(vessel.color).to(shares))
        inputs[f"{self.name}.base_color"] = liquid_color.expand(4, 4, 3)
        return inputs

    # ---- proportions

    def spec(self, parameter: Parameter) -> Fixed | Range | OneOf:
        """An ingredient's coordinate is where the stick is cut, from 0 to 1 of what is
        possible there.
        """
        if parameter.name not in INGREDIENTS:
            return super().spec(parameter)
        wide = [
            name for name in INGREDIENTS if self.bounds[name][1] > self.bounds[name][0]
        ]
        return Range(0.0, 1.0) if parameter.name in wide[:-1] else Fixed(0.0)

    def proportions(self, cuts: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Cut the stick: coordinates in [0, 1] by ingredient to shares that add up to
        one; differentiable.
        """
        left = torch.ones_like(cuts[INGREDIENTS[0]])
        shares = dict[str, Tensor]()
        for name in INGREDIENTS:
            low, high = self._ends(name, left)
            shares[name] = low + (high - low).clamp_min(0.0) * cuts[name]
            left = left - shares[name]
        return shares

    def cuts(self, shares: Mapping[str, float]) -> dict[str, float]:
        """Return the coordinates whose shares are nearest to some, one ingredient after
        the other.
        """
        left = torch.ones(())
        cuts = dict[str, float]()
        for name in INGREDIENTS:
            low, high = map(float, self._ends(name, left))
            share = min(max(shares[name], low), max(low, high))
            cuts[name] = (share - low) / (high - low) if high > low else 0.0
            left = left - share
        return cuts

    def _ends(self, name: str, left: Tensor) -> tuple[Tensor, Tensor]:
        """The least and the most () that an ingredient may have of what is left, so
        that those after it make up one.
        """
        place = INGREDIENTS.index(name)
        limits = left.new_tensor([self.bounds[one] for one in INGREDIENTS])
        (low, high) = limits[place]
        (least, most) = limits[place + 1 :].sum(dim=0)
        return torch.maximum(low, left - most), torch.minimum(high, left - least)


# ---- how it looks


def liquid(shares: Tensor, vessel: Tensor) -> Tensor:
    """Return the linear reflectance (3,) of a cup of water, milk and coffee: of their
    proportions (3,) in the order of `INGREDIENTS`, and the linear reflectance (3,) of
    the vessel's inside.
    """
    amounts = dict(zip(INGREDIENTS, shares, strict=True))
    absorbed = shares.new_zeros(3)
    scattered = shares.new_tensor(1e-6)
    for name, reflectance in REFLECTANCE.items():
        deep = shares.new_tensor(reflectance)
        absorbed = absorbed + amounts[name] * SCATTERING[name] * (
            1.0 - deep
        ).square() / (2.0 * deep)
        scattered = scattered + amounts[name] * SCATTERING[name]
    ratio = absorbed / scattered
    milky = 1.0 + ratio - (ratio.square() + 2.0 * ratio + 1e-9).sqrt()
    opacity = 1.0 - torch.exp(-DENSITY * (amounts["milk"] + amounts["coffee"]))
    return opacity * milky + (1.0 - opacity) * vessel * shares.new_tensor(WATER)


def _surface(vessel: Vessel, level: Tensor) -> Tensor:
    """Vertices (1 + COLUMNS, 3) of the liquid's surface in mesh coordinates, the middle
    first. The wall's distance is interpolated between the heights at which it is known,
    so the vertices are differentiable in the level, with kinks at those heights.
    """
    heights = torch.from_numpy(vessel.heights).to(level)
    radii = torch.from_numpy(vessel.radii).to(level)
    place = level * (len(heights) - 1)
    row = int(place.detach().clamp(0, len(heights) - 2))
    radius = torch.lerp(radii[row], radii[row + 1], place - row) * RADIUS
    there = (level / FIRST).clamp(1e-3, 1.0)
    depth = heights[-1] - heights[0]
    height = heights[0] + level * depth - (1.0 - there) * FIRST * depth
    angle = torch.arange(COLUMNS, device=level.device) * (2.0 * torch.pi / COLUMNS)
    around = (
        torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
        * (radius * there)[:, None]
    )
    flat = torch.cat([around.new_zeros(1, 2), around]) + torch.from_numpy(
        vessel.axis
    ).to(level)
    return torch.cat([flat, height.expand(len(flat), 1)], dim=1)
