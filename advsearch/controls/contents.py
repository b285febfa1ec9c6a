"""The `contents` control: a vessel is filled with water, coffee and milk.

The inside of a vessel is where rain could not run off: the largest basin of a height map
(Barnes, Lehman and Mulla 2014, arXiv 1511.04463, section 2). Rays from its axis find the
wall. Colors are linear (Kubelka and Munk 1931):

    K / S = sum(p_i K_i) / sum(p_i S_i),   milky coffee = 1 + K/S - sqrt((K/S)^2 + 2 K/S)
    color = opacity * milky coffee + (1 - opacity) * vessel * tint of water
    opacity = 1 - exp(-DENSITY (1 - water))

Proportions add up to 1: two of them are cut off a stick of length 1, one after the
other, and the third is the remainder.
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

GRID_CELLS = 128  # cells of the height map along the longer side of the mesh
WALL_ROWS = 40  # number of heights at which the wall is found
WALL_DIRECTIONS = 96  # number of directions in which it is found
MIN_DEPTH = 0.03  # smallest depth of a vessel in object sizes
MIN_OPENING = 5e-4  # smallest opening of a vessel in squared object sizes
MIN_HIT_FRACTION = 0.97  # smallest fraction of rays that have to hit the wall
FILL_LIMIT = 0.985  # fraction of its depth to which a full vessel is filled
# The lowest rays start this fraction of the depth above the floor: along a flat floor
# they would graze it.
MIN_RAY_HEIGHT = 0.004

INGREDIENTS = ("water", "milk", "coffee")
"""In the order in which they are cut off the stick; coffee is the remainder."""
# linear reflectance of an infinitely deep layer; water has none, as it is clear
REFLECTANCE = {"milk": (0.84, 0.80, 0.70), "coffee": (0.040, 0.016, 0.007)}
# how strongly each scatters, relative to milk
SCATTERING = {"milk": 1.0, "coffee": 0.10}
# fraction of the light that is left after the way through water to the floor and back
WATER_TINT = (0.86, 0.94, 0.95)
# how fast coffee and milk make water opaque: a tenth of them hides half of the vessel's
# floor
OPACITY_RATE = 7.0
SUM_TOLERANCE = 1e-6  # tolerance of the sum of proportions, which is 1
# radius of the disk as a fraction of the distance of the wall
DISK_RADIUS_FRACTION = 0.995
SINKING_LEVEL = 0.02
"""Below this level the disk shrinks and sinks into the floor, so that it can't be seen
in an empty vessel.
"""
LIQUID_MATERIAL = assets.Material(roughness=0.08, specular=0.5)


_lit = partial(Parameter.number, Parameter.LIT)


@dataclass(frozen=True, eq=False)
class Vessel:
    """The inside of a vessel that stands upright."""

    axis: assets.Float64Array  # (2,) x and y of the vertical axis
    heights: assets.Float64Array  # (R,) evenly spaced z, from the floor to the brim
    # (R, K) distance of the wall from the axis, in K even directions from +x
    # counter-clockwise
    radii: assets.Float64Array
    color: assets.Float64Array  # (3,) linear reflectance of the wall's lower half


@lru_cache(maxsize=8)
def find_vessel(asset: assets.ObjectAsset) -> Vessel | None:
    """Find the inside of an object in its default pose; None if it is no vessel.

    The largest basin of a height map is where most water would stand. Its wall is found
    by level rays from the axis of the basin, at evenly spaced heights. The object is no
    vessel if it has no basin, or if too many rays leave it without hitting a wall.
    """
    mesh = asset.mesh
    basin = _find_basin(mesh)
    if basin is None:
        return None
    axis, floor, rim = basin
    depth = rim - floor
    highest_level = floor + FILL_LIMIT * depth
    heights = np.linspace(floor, highest_level, WALL_ROWS)
    # The lowest rays are cast a little above the floor, and stand for the wall at the
    # floor.
    min_height = floor + MIN_RAY_HEIGHT * depth
    rows = [_find_wall(mesh, axis, max(float(z), min_height)) for z in heights]
    radii = _fill_missed_radii(np.stack([distances for distances, _ in rows]))
    if radii is None:
        return None
    wall_color = _compute_wall_color(asset, [faces for _, faces in rows])
    return Vessel(axis, heights, radii, wall_color)


def _compute_wall_color(
    asset: assets.ObjectAsset, face_rows: list[assets.IntArray]
) -> assets.Float64Array:
    """Return the mean color (3,) of a vessel's wall, linear, as seen through a liquid.

    Args:
        asset: the vessel.
        face_rows: index of the face that each ray hit, -1 for none; one array (rays,)
            for each height, ascending.
    """
    # Through the liquid, mostly the lower half of the wall is visible.
    lower_faces = np.concatenate(face_rows[: WALL_ROWS // 2])
    return _mean_face_color(asset, lower_faces[lower_faces >= 0])


def _fill_missed_radii(radii: assets.Float64Array) -> assets.Float64Array | None:
    """Replace the distance of each ray that missed the wall by the median at its
    height.

    Args:
        radii: (rows, rays) distances from the axis to the wall, not finite where a ray
            hit nothing. A row is a height.

    Returns:
        (rows, rays); None if too few rays hit a wall.
    """
    is_hit = np.isfinite(radii)
    if is_hit.mean() < MIN_HIT_FRACTION or not is_hit.any(axis=1).all():
        return None
    medians = np.array([np.median(row[np.isfinite(row)]) for row in radii])
    return np.where(is_hit, radii, medians[:, None])


def _mean_face_color(
    asset: assets.ObjectAsset, faces: assets.IntArray
) -> assets.Float64Array:
    """Return the mean linear color (3,) of the texture at the centers of faces (N,)."""
    mesh = asset.mesh
    centers = mesh.uvs[mesh.faces[faces].astype(np.int64)].mean(axis=1)
    if mesh.repeats:  # the texture repeats outside of [0, 1]
        centers -= np.floor(centers)
    height, width = asset.base_color.shape[:2]
    column = np.clip((centers[:, 0] * width).astype(np.int64), 0, width - 1)
    # Row 0 of the texture is at v = 1.
    row = np.clip(((1.0 - centers[:, 1]) * height).astype(np.int64), 0, height - 1)
    mean = color.srgb_to_linear(asset.base_color[row, column]).mean(axis=0)
    return np.asarray(mean, dtype=np.float64)


def _find_basin(mesh: assets.Mesh) -> tuple[assets.Float64Array, float, float] | None:
    """Find the largest basin of a mesh: where most water would stand.

    Returns:
        Its axis (2,), which is the center of the water from above, weighted by depth;
        the height of its floor; and the height of its rim. None if it is too shallow or
        its opening too small.
    """
    # ground: height of the mesh in each cell; water: level at which water would stand
    corner, cell, ground = _compute_height_map(mesh)
    water = _fill_with_water(ground)
    water_depth = water - ground
    # Connected cells with water; 0 is dry, basins count from 1. A film of less than a
    # thousandth of the object is dry as well.
    labels, count = ndimage.label(water_depth > 1e-3)
    if count == 0:
        return None
    volumes = ndimage.sum_labels(water_depth, labels, np.arange(1, count + 1))
    is_largest = labels == 1 + int(np.argmax(volumes))
    depth = np.where(is_largest, water_depth, 0.0)
    if depth.max() < MIN_DEPTH or is_largest.sum() * cell * cell < MIN_OPENING:
        return None
    axis = _find_weighted_center(depth, corner, cell)
    return axis, float(ground[is_largest].min()), float(water[is_largest].max())


def _compute_height_map(
    mesh: assets.Mesh,
) -> tuple[assets.Float64Array, float, assets.Float64Array]:
    """Compute the height of the highest surface in each cell of a grid, seen from
    above.

    Around the mesh there is a margin of empty cells, lower than all of it. Edges are
    drawn as well as faces, so that a thin upright wall is not missed between two cells.

    Returns:
        Position (2,) of the center of cell (0, 0), side of a cell, and heights (h, w).
    """
    vertices = mesh.vertices.astype(np.float64)
    lower = vertices[:, :2].min(axis=0)
    upper = vertices[:, :2].max(axis=0)
    cell = float((upper - lower).max()) / GRID_CELLS
    # At least one empty cell on each side, over which water runs off. `lower` becomes the
    # center of cell (0, 0), whose upper bound is then one cell below the mesh.
    lower = lower - 1.5 * cell
    width, height = (np.ceil((upper - lower) / cell).astype(np.int64) + 2).tolist()
    below_mesh = vertices[:, 2].min() - 1.0
    heights = np.full((height, width), below_mesh)
    corners = vertices[mesh.faces.astype(np.int64)]
    in_cells = (corners[..., :2] - lower) / cell
    _draw_faces(heights, in_cells, corners[..., 2])
    _draw_edges(heights, in_cells, corners[..., 2])
    return lower, cell, heights


def _draw_faces(
    ground: assets.Float64Array,
    positions: assets.Float64Array,
    heights: assets.Float64Array,
) -> None:
    """Raise a height map (h, w) to triangles, in place.

    Args:
        ground: (h, w) height map.
        positions: (F, 3, 2) x and y of the corners, in cells.
        heights: (F, 3) heights of the corners.
    """
    height, width = ground.shape
    face, row, column, weights = images.rasterize_triangles(positions, (height, width))
    # several faces may lie over a cell: the highest one counts
    np.maximum.at(ground, (row, column), (weights * heights[face]).sum(axis=1))


def _draw_edges(
    ground: assets.Float64Array,
    positions: assets.Float64Array,
    heights: assets.Float64Array,
) -> None:
    """Raise a height map (h, w) to the edges of triangles, in place.

    Args:
        ground: (h, w) height map; it is changed.
        positions: (F, 3, 2) column and row of the corners of triangles, in cells.
        heights: (F, 3) heights of the corners.
    """
    # 9 points on each edge
    for fraction in np.linspace(0.0, 1.0, 9):
        for begin, end in ((0, 1), (1, 2), (2, 0)):
            edge = positions[:, end] - positions[:, begin]
            cell = np.rint(positions[:, begin] + fraction * edge).astype(np.int64)
            rise = heights[:, end] - heights[:, begin]
            height = heights[:, begin] + fraction * rise
            np.maximum.at(ground, (cell[:, 1], cell[:, 0]), height)


def _fill_with_water(ground: assets.Float64Array) -> assets.Float64Array:
    """Return the level (h, w) at which water stands on a height map after heavy rain.

    Water runs off over the edges of the map. At first the level is infinite inside, and
    that of the ground at the edges. Then the level of each cell falls to that of its
    lowest neighbor, but not below the ground, until nothing changes.

    Args:
        ground: (h, w) height map.
    """
    water = np.full_like(ground, np.inf)
    water[[0, -1]] = ground[[0, -1]]
    water[:, [0, -1]] = ground[:, [0, -1]]
    while True:
        lowest = _find_lowest_neighbor(water)
        level = np.maximum(ground[1:-1, 1:-1], np.minimum(lowest, water[1:-1, 1:-1]))
        has_settled = np.array_equal(level, water[1:-1, 1:-1])
        if has_settled:
            return water
        water[1:-1, 1:-1] = level


def _find_lowest_neighbor(levels: assets.Float64Array) -> assets.Float64Array:
    """Return the lowest of the four neighbors of each inner cell, (h - 2, w - 2)."""
    above = levels[:-2, 1:-1]
    below = levels[2:, 1:-1]
    left = levels[1:-1, :-2]
    right = levels[1:-1, 2:]
    lowest: assets.Float64Array = np.minimum.reduce((above, below, left, right))
    return lowest


def _find_weighted_center(
    weights: assets.Float64Array, corner: assets.Float64Array, cell: float
) -> assets.Float64Array:
    """Return the center (2,) of the cells of a grid, by their weights (rows, columns).

    `corner` (2,) is the middle of the first cell, `cell` the side of each.
    """
    row, column = np.nonzero(weights)
    weight = weights[row, column]
    moments = np.array([(column * weight).sum(), (row * weight).sum()])
    center: assets.Float64Array = corner + cell * moments / weight.sum()
    return center


def _find_wall(
    mesh: assets.Mesh, axis: assets.Float64Array, height: float
) -> tuple[assets.Float64Array, assets.IntArray]:
    """Cast level rays from the axis at a height, in K = `WALL_DIRECTIONS` directions.

    The level plane cuts a face in a segment. A ray hits the segment if its two ends lie
    on different sides of the ray's line, and the crossing is in front of the axis.

    Args:
        mesh: mesh of the object.
        axis: (2,) x and y of the vertical axis, where the rays begin.
        height: z of the rays.

    Returns:
        Distance (K,) of the first surface in each direction, infinite if there is none;
        and its face (K,), or -1.
    """
    face, first_end, second_end = _cut_faces(mesh, height)
    if not len(face):
        return np.full(WALL_DIRECTIONS, np.inf), np.full(WALL_DIRECTIONS, -1)
    along_ray = _cross_segments(first_end - axis, second_end - axis)
    nearest = along_ray.argmin(axis=1)
    distance = along_ray[np.arange(WALL_DIRECTIONS), nearest]
    return distance, np.where(np.isfinite(distance), face[nearest], -1)


def _cross_segments(
    first_end: assets.Float64Array, second_end: assets.Float64Array
) -> assets.Float64Array:
    """Return how far along each ray from the origin S segments are crossed.

    Args:
        first_end: (S, 2) one end of each segment.
        second_end: (S, 2) its other end.

    Returns:
        (K, S) distances, infinite if a ray does not hit a segment.
    """
    ray = _make_directions()
    # (K, S) cross products with the ends: positive on the left of a ray, negative on the
    # right, and proportional to the distance from the ray's line.
    first_side = ray[:, :1] * first_end[:, 1] - ray[:, 1:] * first_end[:, 0]
    second_side = ray[:, :1] * second_end[:, 1] - ray[:, 1:] * second_end[:, 0]
    is_crossed = (first_side > 0.0) != (second_side > 0.0)
    # where the ray's line crosses the segment, from 0 at its first end to 1
    fraction = first_side / np.where(is_crossed, first_side - second_side, 1.0)
    along_ray = (ray @ first_end.T) * (1.0 - fraction) + (ray @ second_end.T) * fraction
    return np.where(is_crossed & (along_ray > 0.0), along_ray, np.inf)


def _make_directions() -> assets.Float64Array:
    """Return K = `WALL_DIRECTIONS` even directions (K, 2) from +x counter-clockwise."""
    angle = np.arange(WALL_DIRECTIONS) * 2.0 * np.pi / WALL_DIRECTIONS
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _cut_faces(
    mesh: assets.Mesh, height: float
) -> tuple[assets.IntArray, assets.Float64Array, assets.Float64Array]:
    """Cut the faces of a mesh by a level plane.

    Returns:
        (S,) indices of the faces that the plane cuts, and (S, 2) x and y of both ends
        of each cut.
    """
    corners = mesh.vertices[mesh.faces.astype(np.int64)].astype(np.float64)
    is_above = corners[..., 2] > height
    face = np.nonzero(is_above.any(axis=1) & ~is_above.all(axis=1))[0]
    corners = corners[face]
    apex_corner = _find_apex(is_above[face])
    index = np.arange(len(face))
    apex = corners[index, apex_corner]
    # both edges that the plane cuts begin at the apex
    first_other = corners[index, (apex_corner + 1) % 3]
    second_other = corners[index, (apex_corner + 2) % 3]
    first_end = _cut_edges(apex, first_other, height)
    second_end = _cut_edges(apex, second_other, height)
    return face, first_end, second_end


def _find_apex(is_above: assets.BoolArray) -> assets.IntArray:
    """Return the corner (S,), 0 to 2, that is alone on its side of a plane.

    `is_above` (S, 3) states which corners of a face are above the plane.
    """
    is_alone_above = is_above.sum(axis=1) == 1
    apex: assets.IntArray = np.where(
        is_alone_above, is_above.argmax(axis=1), (~is_above).argmax(axis=1)
    )
    return apex


def _cut_edges(
    apex: assets.Float64Array, other: assets.Float64Array, height: float
) -> assets.Float64Array:
    """Return x and y (S, 2) at a height on the edges from corners (S, 3) to others."""
    # never 0, because the other corner is on the other side of the plane
    rise = other[:, 2] - apex[:, 2]
    fraction = (height - apex[:, 2]) / rise
    return apex[:, :2] + fraction[:, None] * (other[:, :2] - apex[:, :2])


class ContentsControl(Control):
    """What a vessel is filled with, and how high: water, coffee and milk.

    Proportions add up to 1 in every configuration: a stick of length 1 is cut into them,
    one ingredient after the other. The coordinate of an ingredient, its cut, goes from 0
    for the smallest proportion that is still possible to 1 for the largest.

    Attributes:
        proportion_bounds: lower and upper bound of the proportion of each ingredient.
    """

    kind = "contents"
    strength_parameter = "level"
    # The pose is only read: so the control is evaluated after those that move the
    # vessel.
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
                f"Fraction of {name}.",
                (0.0, 1.0),
            )
            for name in INGREDIENTS
        ),
    )

    def __init__(self, name: str | None = None, **settings: object) -> None:
        """Read the settings, and find the bounds of each proportion.

        Args:
            name: name of the control; by default its kind.
            **settings: values of its parameters; proportions that are not set get
                bounds too.

        Raises:
            InputError: the proportions can't add up to 1.
        """
        super().__init__(name, **settings)
        self.proportion_bounds = self._read_bounds()
        min_total = sum(lower for lower, _ in self.proportion_bounds.values())
        self._check_total(min_total)
        self._add_default_bounds(rest=max(0.0, 1.0 - min_total))

    def _add_default_bounds(self, rest: float) -> None:
        """Add the bounds of the proportions that are not set.

        If proportions are searched, their bounds are 0 and the rest. Otherwise they are
        fixed: the first of coffee, water and milk that is not set gets all of the rest,
        and the others get 0.

        Args:
            rest: 1 minus the lower bounds of the proportions that are set.
        """
        # All parameters are searched unless the user sets a range for some.
        are_searched = not self.has_requested_range or any(
            isinstance(self.specs.get(name), Range) for name in INGREDIENTS
        )
        # Coffee comes first: by default, `parameters` describe a cup of coffee.
        for name in ("coffee", "water", "milk"):
            if name in self.proportion_bounds:
                continue
            if are_searched:
                self.proportion_bounds[name] = (0.0, rest)
            else:
                self.proportion_bounds[name] = (rest, rest)
                rest = 0.0  # for the next ones

    def _read_bounds(self) -> dict[str, tuple[float, float]]:
        """Return the smallest and largest proportion of each ingredient that is set.

        Raises:
            InputError: one has a list of values or a distribution, with which the
                proportions would not add up to 1.
        """
        bounds = dict[str, tuple[float, float]]()
        for name in INGREDIENTS:
            spec = self.specs.get(name)
            if spec is not None:
                bounds[name] = self._get_proportion_bounds(name, spec)
        return bounds

    def _get_proportion_bounds(
        self, name: str, spec: Fixed | Range | OneOf
    ) -> tuple[float, float]:
        """Return the smallest and largest proportion of an ingredient by its spec."""
        if isinstance(spec, Fixed):
            return float(spec.value), float(spec.value)
        if type(spec) is Range:  # a distribution is a subclass
            return spec.low, spec.high
        got = "a list of values" if isinstance(spec, OneOf) else "a distribution"
        raise InputError(
            f"{self.name}.{name}: expected a number or a range [low, high], "
            f"got {got}, with which proportions would not add up to 1"
        )

    def _check_total(self, min_total: float) -> None:
        """Check that the proportions can add up to 1.

        Args:
            min_total: sum of the lower bounds of the proportions that are set.

        Raises:
            InputError: they can't.
        """
        max_total = sum(upper for _, upper in self.proportion_bounds.values())
        all_set = len(self.proportion_bounds) == len(INGREDIENTS)
        # A maximum below 1 is only an error if all are set: otherwise the proportions that
        # are not set get the rest.
        is_too_little = all_set and max_total < 1.0 - SUM_TOLERANCE
        is_too_much = min_total > 1.0 + SUM_TOLERANCE
        if not is_too_little and not is_too_much:
            return
        raise InputError(
            f"`controls` {self.name}: expected proportions of water, milk and "
            f"coffee that add up to 1, got {self._describe_bounds()}; "
            "change one of them or leave one out"
        )

    def _describe_bounds(self) -> str:
        """Return the proportions that are set, such as "water 0.2 to 0.5, milk 0.1"."""
        stated = []
        for name in INGREDIENTS:
            if name in self.proportion_bounds:
                lower, upper = self.proportion_bounds[name]
                text = f"{lower:g} to {upper:g}"
                if f"{lower:g}" == f"{upper:g}":
                    text = f"{lower:g}"
                stated.append(f"{name} {text}")
        return ", ".join(stated)

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with a mesh for the surface of the liquid.

        The mesh is a disk at half the height; `scene_inputs` moves its vertices.

        Raises:
            InputError: the object is no vessel.
        """
        vessel = self._require_vessel(scene)
        mesh = _make_liquid_mesh(vessel)
        black = np.zeros((4, 4, 3), dtype=np.float32)
        pose = geometry.compute_object_to_world(scene)
        return scene.with_part(
            parts.MeshPart(self.name, mesh, black, LIQUID_MATERIAL, to_world=pose)
        )

    def _require_vessel(self, scene: SceneDescription) -> Vessel:
        """Return the inside of a scene's object; raise InputError if it has none."""
        vessel = find_vessel(scene.object)
        if vessel is None:
            raise InputError(
                f"`controls` {self.name}: expected a vessel, open at the top and "
                "closed around and below (a mug, a "
                f"bowl, a glass), got {scene.object.name!r}; choose another object or "
                "leave the control out"
            )
        return vessel

    def bind_parameters(self) -> None:
        """Start from the default proportions, or the nearest that are possible."""
        super().bind_parameters()
        defaults = {
            parameter.name: float(parameter.default)
            for parameter in self.parameters
            if parameter.name in INGREDIENTS
        }
        cuts = self.find_cuts(defaults)
        for slot in self.parameter_slots:
            if slot.n_coordinates and slot.parameter.name in cuts:
                self.start[slot.coordinate_offset] = cuts[slot.parameter.name]

    def compute_values(self, u: Tensor) -> dict[str, Tensor]:
        cuts_and_level = super().compute_values(u)
        return {**cuts_and_level, **self.cut_proportions(cuts_and_level)}

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        return {
            name: Value(value=float(values[name]), unit="1") for name in INGREDIENTS
        }

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the offsets, the pose and the color of the liquid's surface."""
        vessel = find_vessel(self.scene.object)
        assert vessel is not None  # `prepare` has checked it
        # Offsets are relative to the mesh, which `prepare` has made at this level.
        mesh_level = torch.full_like(values["level"], 0.5)
        base = _make_liquid_surface(vessel, mesh_level)
        surface = _make_liquid_surface(vessel, values["level"])
        inputs = {f"{self.name}.offsets": surface - base}
        if "object.to_world" in earlier_inputs:
            inputs[f"{self.name}.to_world"] = earlier_inputs["object.to_world"]
        liquid_color = _compute_liquid_color(values, vessel)
        # the size of the black texture of `prepare`
        inputs[f"{self.name}.base_color"] = liquid_color.expand(4, 4, 3)
        return inputs

    # ---- proportions

    def get_parameter_spec(self, parameter: Parameter) -> Fixed | Range | OneOf:
        """Return the range of a parameter; for an ingredient, that of its cut.

        A cut is a coordinate from 0 to 1 that decides the proportion of an ingredient
        (`cut_proportions`). The last ingredient whose proportion has a range has no
        cut: it gets what the others leave. An ingredient without a cut, which may have
        a fixed proportion, has a placeholder of 0.
        """
        if parameter.name not in INGREDIENTS:
            return super().get_parameter_spec(parameter)
        ranged = []
        for name in INGREDIENTS:
            lower, upper = self.proportion_bounds[name]
            if upper > lower:
                ranged.append(name)
        has_cut = parameter.name in ranged[:-1]
        return Range(0.0, 1.0) if has_cut else Fixed(0.0)

    def cut_proportions(self, cuts: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the proportion of each ingredient for its cut; they add up to 1.

        Ingredients are cut off a stick of length 1, one after the other. A cut of 0 is
        the smallest proportion that is still possible, a cut of 1 the largest. The
        result is differentiable in the cuts.

        Args:
            cuts: coordinates in [0, 1] by ingredient.
        """
        remainder = torch.ones_like(cuts[INGREDIENTS[0]])
        proportions = dict[str, Tensor]()
        for name in INGREDIENTS:
            lower, upper = self._possible_range(name, remainder)
            proportions[name] = lower + (upper - lower).clamp_min(0.0) * cuts[name]
            remainder = remainder - proportions[name]
        return proportions

    def find_cuts(self, proportions: Mapping[str, float]) -> dict[str, float]:
        """Return the cuts that give certain proportions, to invert `cut_proportions`.

        A proportion that is not possible is clipped to the nearest possible one.

        Args:
            proportions: proportion by ingredient.
        """
        remainder = torch.ones(())
        cuts = dict[str, float]()
        for name in INGREDIENTS:
            lower, upper = map(float, self._possible_range(name, remainder))
            upper = max(lower, upper)  # rounding may leave it below
            proportion = min(max(proportions[name], lower), upper)
            cuts[name] = 0.0
            if upper > lower:
                cuts[name] = (proportion - lower) / (upper - lower)
            remainder = remainder - proportion
        return cuts

    def _possible_range(self, name: str, remainder: Tensor) -> tuple[Tensor, Tensor]:
        """Return the smallest and largest proportion () that an ingredient may have.

        They are its bounds, narrowed so that the ingredients after it can still add up
        to what is left.

        Args:
            name: name of the ingredient.
            remainder: () 1 minus the proportions of the ingredients before it.
        """
        index = INGREDIENTS.index(name)
        limits = remainder.new_tensor(
            [self.proportion_bounds[ingredient] for ingredient in INGREDIENTS]
        )
        lower, upper = limits[index]
        # bounds of the sum of all ingredients after this one
        rest_lower, rest_upper = limits[index + 1 :].sum(dim=0)
        smallest = torch.maximum(lower, remainder - rest_upper)
        largest = torch.minimum(upper, remainder - rest_lower)
        return smallest, largest


# ---- appearance


def mix_liquid_color(proportions: Tensor, vessel_color: Tensor) -> Tensor:
    """Return the linear reflectance (3,) of a cup of water, milk and coffee.

    By Kubelka and Munk (1931): a layer absorbs and scatters light, and the coefficients
    of a mixture are sums over its ingredients. Only milk and coffee absorb, scatter and
    hide the vessel; the vessel is visible through the rest, tinted by water.

    Args:
        proportions: proportions (3,) in the order of `INGREDIENTS`.
        vessel_color: linear reflectance (3,) of the vessel's inside.
    """
    amounts = dict(zip(INGREDIENTS, proportions, strict=True))
    ratio = _compute_absorption_ratio(amounts)
    # reflectance of an infinitely deep mixture; 1e-9 keeps the derivative finite at 0
    mixed_color = 1.0 + ratio - (ratio.square() + 2.0 * ratio + 1e-9).sqrt()
    opacity = 1.0 - torch.exp(-OPACITY_RATE * (amounts["milk"] + amounts["coffee"]))
    floor_color = (1.0 - opacity) * vessel_color * proportions.new_tensor(WATER_TINT)
    return opacity * mixed_color + floor_color


def _compute_absorption_ratio(amounts: Mapping[str, Tensor]) -> Tensor:
    """Return the absorption over the scattering (3,) of a mixture.

    `amounts` are the proportions () by ingredient.
    """
    milk = amounts["milk"]
    absorption = milk.new_zeros(3)
    # Pure water does not scatter. A tiny number avoids a division by 0.
    scattering = milk.new_tensor(1e-6)
    for name, reflectance in REFLECTANCE.items():  # milk and coffee
        deep_reflectance = milk.new_tensor(reflectance)
        added_scattering = amounts[name] * SCATTERING[name]
        # Kubelka and Munk: K / S = (1 - R)^2 / (2 R), by the reflectance R of an
        # infinitely deep layer of the ingredient.
        absorption = absorption + added_scattering * (
            1.0 - deep_reflectance
        ).square() / (2.0 * deep_reflectance)
        scattering = scattering + added_scattering
    return absorption / scattering


def _make_liquid_mesh(vessel: Vessel) -> assets.Mesh:
    """Return the surface of the liquid at half the height, a disk with K corners."""
    circle = _make_directions()
    # Texture coordinates in the order of the vertices: the center, then the circle.
    # `ContentsControl.scene_inputs` replaces the texture.
    uvs = np.concatenate([[(0.5, 0.5)], 0.5 + 0.45 * circle])
    vertices = _make_liquid_surface(vessel, torch.tensor(0.5)).numpy()
    return replace(
        parts.make_polygon(WALL_DIRECTIONS),
        vertices=vertices,
        uvs=uvs.astype(np.float32),
    )


def _compute_liquid_color(values: Values, vessel: Vessel) -> Tensor:
    """Return the color (3,) of the liquid in a vessel, linear.

    Args:
        values: values of the control, the proportion of each ingredient among them.
        vessel: inside of the vessel, whose color is seen through the liquid.
    """
    proportions = torch.stack([values[name] for name in INGREDIENTS])
    vessel_color = torch.from_numpy(vessel.color).to(proportions)
    return mix_liquid_color(proportions, vessel_color)


def _make_liquid_surface(vessel: Vessel, level: Tensor) -> Tensor:
    """Return the vertices (1 + K, 3) of the liquid's surface, the center first.

    They are in mesh coordinates, and differentiable in the level, with kinks at the
    heights at which the wall is known. Below `SINKING_LEVEL` the surface shrinks and
    sinks into the floor, so that it can't be seen in an empty vessel.

    Args:
        vessel: inside of the vessel; its wall is known in K directions at some heights.
        level: () from 0 at the floor to 1 at the highest level.
    """
    radius = _interpolate_radius(vessel, level)
    # Factor on the disk's radius: 1 from `SINKING_LEVEL` upwards, and smaller below. It is
    # never 0, so that its faces keep an area.
    shrinkage = (level / SINKING_LEVEL).clamp(1e-3, 1.0)
    heights = torch.from_numpy(vessel.heights).to(level)
    depth = heights[-1] - heights[0]
    # The disk sinks as it shrinks. At level 0 it is `SINKING_LEVEL` of the depth below the
    # floor (a little less, as the factor is not 0).
    height = heights[0] + level * depth - (1.0 - shrinkage) * SINKING_LEVEL * depth
    rim = _make_unit_circle(level.device) * (radius * shrinkage)[:, None]
    axis = torch.from_numpy(vessel.axis).to(level)
    positions = torch.cat([rim.new_zeros(1, 2), rim]) + axis  # (1 + K, 2)
    return torch.cat([positions, height.expand(len(positions), 1)], dim=1)


def _interpolate_radius(vessel: Vessel, level: Tensor) -> Tensor:
    """Return the radius (K,) of the liquid's surface in each direction, at a level ()."""
    radii = torch.from_numpy(vessel.radii).to(level)  # (n heights, K)
    # a fractional index into the heights, which are evenly spaced
    position = level * (len(radii) - 1)
    row = int(position.detach().clamp(0, len(radii) - 2))
    wall_radius = torch.lerp(radii[row], radii[row + 1], position - row)
    return wall_radius * DISK_RADIUS_FRACTION


def _make_unit_circle(device: torch.device) -> Tensor:
    """Return x and y (K, 2) of the directions in which a vessel's wall is known."""
    step = 2.0 * torch.pi / WALL_DIRECTIONS
    angle = torch.arange(WALL_DIRECTIONS, device=device) * step
    return torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
