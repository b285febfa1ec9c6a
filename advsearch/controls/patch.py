"""The `patch` control: a printed square stuck onto the object, whose pixels, place,
size and turn may be searched.

After Brown et al. (2017, "Adversarial Patch", arXiv 1712.09665, section 2): the pixels
are free, and what is around them stays. There the patch is pasted into pictures; here
it lies on the surface, under the scene's light, and bends with it. It is part of the
base colour, so that no outline moves and the adjoint is right.

    base color = (1 - m) base color + m linear(pixels at (a, b))
    m = soft square in (a, b), on the front of the surface

A place is where a ray from outside towards the middle of the object meets the surface;
(a, b) are those in the tangent plane, unrolled along the direction in which the surface
bends (exact for cylinders and spheres; Schmidt et al. 2006, "Interactive Decal
Compositing with Discrete Exponential Maps"). Only what is connected and faces that way
is painted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from scipy import spatial
from torch import Tensor

from advsearch.extend import (
    Choice,
    Fixed,
    InputError,
    OneOf,
    Parameter,
    PictureControl,
    Range,
    SceneDescription,
    Values,
    assets,
    color,
    geometry,
    images,
)

BASE_COLOR = "object.base_color"
NORMS = ("box", "linf", "l2")
# smallest and largest side of the base-colour map that is painted into, in texels
MAP_SIDES = (512, 1024)
PAINT_RADIUS = 0.75
"""Radius around the middle, in sides of the square, within which the surface is
painted: its corners are at 0.7071.
"""
# cosines between the surface and the square's normal between which it fades in
FACING_COSINES = (0.1, 0.3)
EDGE_TEXELS = 2.0  # width of the soft edge in texels


class PatchControl(PictureControl):
    """A printed square stuck onto the object: its pixels, place, size and turn.

    Numbers that are not given are fixed, and pixels are searched unless they are a grey
    or a picture.
    """

    kind = "patch"
    image_parameter = "pixels"
    parameters = (
        Parameter(
            "pixels",
            (None, None, 3),
            "sRGB",
            0.0,
            1.0,
            "the object's own texture underneath",
            "Display-referred colours of the patch; a narrower range is a "
            "printer's gamut.",
            search=(0.0, 1.0),
            estimators=("adjoint",),
        ),
        Parameter.number(
            ("differences",),
            "azimuth",
            "degrees",
            0.0,
            360.0,
            "towards the camera",
            "Side of the object that the patch is on.",
            periodic=True,
        ),
        Parameter.number(
            ("differences",),
            "height",
            "1",
            0.0,
            1.0,
            "towards the camera",
            "Where it is from the middle of the underside (0) over the "
            "sides (0.5) to the middle of the "
            "top (1).",
        ),
        Parameter.number(
            Parameter.LIT,
            "size",
            "object sizes",
            0.05,
            0.6,
            0.3,
            "Side of the patch.",
            log=True,
        ),
        Parameter.number(
            Parameter.LIT,
            "rotation",
            "degrees",
            -180.0,
            180.0,
            0.0,
            "Turn of the patch on the surface, counter-clockwise; upright at 0.",
            periodic=True,
        ),
    )
    choices = (
        Choice("resolution", 32, "Side of the patch in pixels.", whole=(2, 512)),
        Choice(
            "norm",
            "box",
            "How far pixels may go: box (anywhere), linf (the default with an "
            "epsilon) or l2 (a ball around what "
            "is underneath).",
            "norm",
            "pixels",
            options=NORMS,
        ),
        Choice(
            "epsilon",
            None,
            "Radius of that ball, display-referred; by default 0.1 a pixel value.",
            "epsilon",
            "pixels",
            most=PictureControl.MAX_EPSILON,
        ),
        Choice(
            "picture",
            None,
            "A picture file to stick on as it is; then pixels are not searched.",
            fixes="pixels",
        ),
    )

    refines = frozenset({BASE_COLOR})
    on_top = True

    def __init__(self, name: str | None = None, **settings: object) -> None:
        """Check that the settings of the pixels go together. Raises InputError."""
        super().__init__(name, **settings)
        pixels = self.specs.get("pixels")
        picture = self.chosen["picture"]
        if pixels is not None and picture is not None:
            raise InputError(
                f"{self.name}.pixels: expected none beside "
                f"{self.name}.picture; leave one of them out"
            )
        if (
            pixels is not None
            and not isinstance(pixels, Fixed)
            and type(pixels) is not Range
        ):
            got = (
                f"a list of {len(pixels.values)}"
                if isinstance(pixels, OneOf)
                else "a distribution"
            )
            raise InputError(
                f"{self.name}.pixels: expected [low, high] or one number, got {got}"
            )
        ball = next(
            (
                choice
                for choice in ("epsilon", "norm")
                if self.chosen[choice] not in (None, "box")
            ),
            None,
        )
        if ball and not self.is_searched_image:
            raise InputError(
                f"{self.name}.{ball}: is of the ball that searched pixels stay in, and "
                "these are fixed; leave it out, "
                f"or leave out {self.name}.{'picture' if picture is not None else 'pixels'}"
            )

    def check_choices(self) -> None:
        epsilon = self.chosen["epsilon"]
        if "norm" not in self._settings and epsilon is not None:
            self.chosen["norm"] = "linf"
        if self.chosen["norm"] == "box" and epsilon is not None:
            raise InputError(
                f"{self.name}.epsilon: expected none with norm box, got {epsilon:g}; "
                "set norm to linf or l2"
            )

    # ---- in a scene

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        if parameter.name not in ("azimuth", "height"):
            return super().resolve_parameter(parameter)
        return replace(
            parameter,
            default=find_side_towards_camera(self.scene)[parameter.name == "height"],
        )

    def fit(self) -> None:
        """Prepare the painter, and start from the texture underneath.

        Raises InputError: nothing is searched.
        """
        super().fit()
        if not self.groups:
            raise InputError(
                f"`controls` {self.name}: the pixels are fixed, so there is nothing to "
                "search; give another parameter "
                f"a range, such as {self.name}={{azimuth: [0, 360]}}"
            )
        n_pixels = self.sides[0]
        pixels = self.slots[0]
        picture = self.read_picture()
        self._picture = (
            None if picture is None else images.resize_to_square(picture, n_pixels)
        )
        start_values = {
            name: float(value)
            for name, value in self.values(self.start).items()
            if name != "pixels"
        }
        self._sticker = PatchPainter(self.scene, start_values, n_pixels)
        if isinstance(pixels.spec, Range):
            low = pixels.spec.low
            high = pixels.spec.high
            underneath = (self._sticker.sample_underneath() - low) / (high - low)
            self.start[: pixels.n_coordinates] = underneath.clamp(0.0, 1.0).reshape(-1)
            if not torch.allclose(underneath.clamp(0.0, 1.0), underneath, atol=1e-5):
                self.record_adjusted_default(
                    pixels.parameter,
                    "the texture underneath",
                    f"the nearest {pixels.spec}",
                )

    def must_match_scene(
        self, parameter: Parameter, spec: Fixed | Range | OneOf
    ) -> bool:
        # at the start searched pixels show no patch
        return not self.is_searched_image and parameter.name != "pixels"

    def scene_inputs(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        return {
            BASE_COLOR: self._sticker.paint(
                so_far.get(BASE_COLOR), values["pixels"], values
            )
        }

    def get_printable_colors(self, u: Tensor) -> Tensor | None:
        return self.values(u)["pixels"] if self.is_searched_image else None

    def kept_pictures(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        pixels = values["pixels"]
        return {
            self.name: images.enlarge(pixels, -(-images.MIN_PRINT_SIDE // len(pixels))),
            f"{self.name}-pixels": pixels,
        }


# ---- on the surface


def find_side_towards_camera(scene: SceneDescription) -> tuple[float, float]:
    """Return the side of the object that faces the camera.

    Returns:
        Azimuth in degrees, and height from 0 to 1, as the parameters of the
            control.
    """
    middle, radius, half = _half_sizes(scene.object.mesh)
    camera = geometry.camera_to_world(scene)[:3, 3]
    x, y, z = (
        np.linalg.solve(geometry.object_to_world(scene), np.append(camera, 1.0))[:3]
        - middle
    )
    lift = math.atan2(z * radius, max(math.hypot(x, y), 1e-12) * half)
    return math.degrees(math.atan2(y, x)) % 360.0, 0.5 + lift / math.pi


def _sample_pixels(pixels: Tensor, positions: Tensor) -> Tensor:
    """Interpolate pixels (n, n, 3) sRGB at positions (N, 2) in [-0.5, 0.5]; linear."""
    grid = (positions * positions.new_tensor([2.0, -2.0]))[None, None]
    linear = images.to_planes(color.srgb_to_linear(pixels))
    sampled = F.grid_sample(
        linear, grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


def _half_sizes(mesh: assets.Mesh) -> tuple[assets.Float64Array, float, float]:
    """Return the middle (3,) of a mesh, its largest half-width and its half-height."""
    low = mesh.vertices.min(axis=0).astype(np.float64)
    high = mesh.vertices.max(axis=0).astype(np.float64)
    half = np.maximum((high - low) / 2.0, 1e-6)
    return (low + high) / 2.0, float(half[:2].max()), float(half[2])


@dataclass(frozen=True, eq=False)
class Spot:
    """The texels that a patch may cover, and their coordinates around its middle."""

    texel_indices: Tensor  # (N,) their numbers, row by row
    flat: Tensor  # (N, 2) their coordinates to the right and upwards, object sizes
    cover: Tensor  # (N,) in [0, 1]: how much they face the patch
    spacing: float  # distance between neighbouring texels on the surface, object sizes


class PatchPainter:
    """Paints a patch into the object's base-color map.

    Args:
        scene: with the object.
        resting: azimuth, height, size and rotation at the start.
        side: of the patch, pixels.
    """

    def __init__(
        self, scene: SceneDescription, start_values: Mapping[str, float], side: int
    ) -> None:
        """Prepare the object's map and its surface.

        Raises InputError: its texture repeats.
        """
        mesh = scene.object.mesh
        if mesh.repeats:
            raise InputError(
                "`controls` patch: the object's texture repeats on it, and so would a "
                "patch that is painted into it; "
                "leave patch out, or search the whole texture"
            )
        self._half_sizes = _half_sizes(mesh)
        self._resting = start_values
        self._side = side
        self._surface = images.MeshSurface(mesh)
        object_color = color.srgb_to_linear(
            torch.from_numpy(scene.object.base_color.copy())
        )
        pixel_size = start_values["size"] / side
        charts = _rasterise_finely(mesh, max(object_color.shape[:2]), pixel_size)
        self._object_color = _resize_to_square(object_color, len(charts.face))
        mask = charts.is_readable
        self._texels = np.flatnonzero(mask)
        self._faces = charts.face[mask]
        self._positions = charts.compute_positions()[mask].astype(np.float64)
        self._normals = charts.compute_normals()[mask].astype(np.float64)
        self._areas = charts.compute_areas()[mask].astype(np.float64)
        self._spot = lru_cache(maxsize=4)(self._find_spot)

    def paint(
        self, base: Tensor | None, pixels: Tensor, numbers: Mapping[str, Tensor]
    ) -> Tensor:
        """Return the base color (h, w, 3), linear, with the patch on it.

        Differentiable except in the place (azimuth, height, size and rotation).

        Args:
            base: what other controls made of it; None takes the object's own.
            pixels: (n, n, 3) sRGB, of the patch.
            numbers: azimuth, height, size and rotation of the patch, each ().
        """
        device = pixels.device
        if base is None:
            base = self._object_color.to(device)
        else:
            base = _resize_to_square(base, len(self._object_color))
        size = numbers["size"]
        spot = self._spot(
            *(float(numbers[name].detach()) for name in ("azimuth", "height", "size"))
        )
        texels = spot.texel_indices.to(device)
        on_patch = _rotate(spot.flat.to(device), numbers["rotation"]) / size
        edge_width = EDGE_TEXELS * spot.spacing
        edge = (0.5 - on_patch.abs().amax(dim=1)) * size / edge_width + 0.5
        cover = (spot.cover.to(device) * _smooth_step(edge))[:, None]
        ink = _sample_pixels(pixels, on_patch)
        flat = base.reshape(-1, 3)
        under = flat.index_select(0, texels)
        painted = flat.index_copy(0, texels, under + cover * (ink - under))
        return painted.reshape(base.shape)

    def sample_underneath(self) -> Tensor:
        """Return the object's own texture where the patch starts, as its pixels.

        Returns:
            (n, n, 3) sRGB; a pixel that no texel lies in has the nearest texel's color.
        """
        resting = self._resting
        side = self._side
        spot = self._spot(resting["azimuth"], resting["height"], resting["size"])
        rotation = torch.tensor(resting["rotation"])
        on_patch = _rotate(spot.flat, rotation) / resting["size"]
        inside = (on_patch.abs().amax(dim=1) < 0.5) & (spot.cover > 0.0)
        if not bool(inside.any()):
            return torch.full((side, side, 3), 0.5)
        texel_colors = self._object_color.reshape(-1, 3)[spot.texel_indices[inside]]
        positions = on_patch[inside] * torch.tensor([1.0, -1.0]) + 0.5
        colors = _average_in_pixels(texel_colors, positions, side)
        return color.linear_to_srgb(colors).reshape(side, side, 3)

    def _find_spot(self, azimuth: float, height: float, size: float) -> Spot:
        """Find the texels that a patch of a size covers at an azimuth and a height.

        Args:
            azimuth: degrees around the object.
            height: from 0 (middle of the underside) to 1 (middle of the top).
            size: side of the patch, object sizes.
        """
        middle, radius, half_height = self._half_sizes
        outwards = _outward_direction(azimuth, height, radius, half_height)
        face, point = self._surface.find_hit(
            middle + 4.0 * (radius + half_height) * outwards, -outwards
        )
        faces_outwards = float(self._surface.normals[face] @ outwards) >= 0.0
        side = 1.0 if faces_outwards else -1.0
        normal = self._mean_normal(face, point)
        frame = _frame(side * normal, _upward_direction(azimuth, outwards))
        texel_indices = self._texels_near(
            face, point, side * frame[2], PAINT_RADIUS * size
        )

        offsets = self._positions[texel_indices] - point
        flat, cosine = unroll_surface(
            offsets, side * self._normals[texel_indices], frame
        )
        return Spot(
            torch.from_numpy(self._texels[texel_indices]),
            torch.from_numpy(flat.astype(np.float32)),
            _fade_in(cosine),
            self._texel_spacing(texel_indices),
        )

    def _mean_normal(
        self, face: int, point: assets.Float64Array
    ) -> assets.Float64Array:
        """Return the mean normal (3,) over half of the patch's side at the start."""
        face_normal = self._surface.normals[face]
        reach = 0.5 * self._resting["size"]
        is_near = self._surface.find_region(face, point, face_normal, reach)[
            self._faces
        ]
        squared = ((self._positions[is_near] - point) ** 2).sum(axis=1)
        weight = np.maximum(1.0 - squared / reach**2, 0.0) ** 2
        total = (self._normals[is_near] * (weight * self._areas[is_near])[:, None]).sum(
            axis=0
        )
        length = float(np.linalg.norm(total))
        if length <= 1e-12:
            return np.asarray(face_normal)
        return np.asarray(total / length)

    def _texels_near(
        self,
        face: int,
        point: assets.Float64Array,
        normal: assets.Float64Array,
        reach: float,
    ) -> assets.IntArray:
        """Return which texels (N,) are connected to a point, face its way and are
        close.
        """
        connected = np.flatnonzero(
            self._surface.find_region(face, point, normal, reach)[self._faces]
        )
        offsets = self._positions[connected] - point
        is_close = (offsets**2).sum(axis=1) <= reach**2
        return np.asarray(connected[is_close])

    def _texel_spacing(self, texels: assets.IntArray) -> float:
        """Return the distance of neighbouring texels on the surface, object sizes."""
        areas = self._areas[texels]
        has_area = areas > 0.0
        if not has_area.any():
            return 1.0 / len(self._object_color)
        return math.sqrt(float(np.median(areas[has_area])))


def _outward_direction(
    azimuth: float, height: float, radius: float, half_height: float
) -> assets.Float64Array:
    """Return the unit vector (3,) from the middle of an object to a patch on it."""
    angle = math.radians(azimuth)
    lift = (height - 0.5) * math.pi
    outwards = np.array(
        [
            math.cos(lift) * radius * math.cos(angle),
            math.cos(lift) * radius * math.sin(angle),
            math.sin(lift) * half_height,
        ]
    )
    outwards /= np.linalg.norm(outwards)
    return outwards


def _upward_direction(
    azimuth: float, outwards: assets.Float64Array
) -> assets.Float64Array:
    """Return the unit vector (3,) that is upright and across the outward direction."""
    angle = math.radians(azimuth)
    level = math.hypot(outwards[0], outwards[1])
    return np.array(
        [-outwards[2] * math.cos(angle), -outwards[2] * math.sin(angle), level]
    )


def _fade_in(cosine: assets.Float64Array) -> Tensor:
    """Return how much texels are covered by the cosines (N,) of their normals."""
    low, high = FACING_COSINES
    return _smooth_step(
        torch.from_numpy(((cosine - low) / (high - low)).astype(np.float32))
    )


def _frame(
    normal: assets.Float64Array, upwards: assets.Float64Array
) -> assets.Float64Array:
    """Return a right-handed frame (3, 3): rows right, up and normal.

    `up` is as near to a direction as the normal lets it.
    """
    up = upwards - float(upwards @ normal) * normal
    if float(np.linalg.norm(up)) < 1e-6:
        up = np.eye(3)[int(np.abs(normal).argmin())]
        up = up - float(up @ normal) * normal
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, normal), up, normal])


def unroll_surface(
    offsets: assets.Float64Array,
    normals: assets.Float64Array,
    frame: assets.Float64Array,
) -> tuple[assets.Float64Array, assets.Float64Array]:
    """Return the coordinates of points along a surface, and their normals' cosines.

    In the tangent plane a point of a circle of radius R lies at `R sin(phi)` where its
    arc is `R phi`, phi being the angle that the normal has turned. So the component
    along the direction of turning is stretched by `phi / sin(phi)`.

    Args:
        offsets: (N, 3) from the middle.
        normals: (N, 3) at the points.
        frame: rows right, up and normal in the middle.

    Returns:
        Coordinates (N, 2) to the right and upwards, and cosines (N,) with the
            normal of the frame.
    """
    plane = offsets @ frame[:2].T
    tilt = normals @ frame[:2].T
    cosine = normals @ frame[2]
    sine = np.linalg.norm(tilt, axis=1)
    towards = tilt / np.maximum(sine, 1e-9)[:, None]
    turned = np.arctan2(sine, np.maximum(cosine, 0.1))
    stretch = np.where(sine > 1e-4, turned / np.maximum(np.sin(turned), 1e-9), 1.0)
    along_turn = (plane * towards).sum(axis=1)
    return plane + ((stretch - 1.0) * along_turn)[:, None] * towards, cosine


def _average_in_pixels(colors: Tensor, positions: Tensor, side: int) -> Tensor:
    """Average colors (N, 3) at positions (N, 2) in [0, 1] over side x side pixels.

    Returns:
        (side * side, 3), row by row; a pixel without any has the nearest color.
    """
    column, row = (positions * side).long().clamp(0, side - 1).T
    index = row * side + column
    sums = torch.zeros(side * side, 3).index_add(0, index, colors)
    counts = torch.zeros(side * side).index_add(0, index, torch.ones(len(index)))
    means = sums / counts.clamp_min(1.0)[:, None]
    grid = torch.meshgrid(*[torch.arange(side) + 0.5] * 2, indexing="ij")
    centers = torch.stack(grid, dim=-1).reshape(-1, 2)
    tree = spatial.cKDTree(positions.flip(1).numpy())
    nearest = tree.query(centers.numpy() / side)[1]
    return torch.where(counts[:, None] > 0.0, means, colors[torch.from_numpy(nearest)])


def _rotate(flat: Tensor, degrees: Tensor) -> Tensor:
    """Return coordinates (N, 2) on a patch that is turned counter-clockwise."""
    angle = torch.deg2rad(degrees)
    cosine = torch.cos(angle)
    sine = torch.sin(angle)
    return torch.stack(
        [
            flat[:, 0] * cosine + flat[:, 1] * sine,
            flat[:, 1] * cosine - flat[:, 0] * sine,
        ],
        dim=1,
    )


def _rasterise_finely(
    mesh: assets.Mesh, texture_side: int, pixel_size: float
) -> images.Charts:
    """Rasterise a mesh into a map whose texels are smaller than pixels of the patch.

    Args:
        mesh: the object's.
        texture_side: longer side of its own texture, texels.
        pixel_size: side of a pixel, object sizes.
    """
    smallest, largest = MAP_SIDES
    first_side = max(smallest, texture_side)
    charts = images.rasterize_charts(mesh, first_side)
    areas = charts.compute_areas()
    spacing = math.sqrt(float(np.median(areas[areas > 0.0])))
    map_side = first_side
    while 2 * map_side <= largest and spacing * first_side / map_side > pixel_size:
        map_side *= 2
    return charts if map_side == first_side else images.rasterize_charts(mesh, map_side)


def _smooth_step(value: Tensor) -> Tensor:
    """Return the smooth step `3 t^2 - 2 t^3` from 0 at 0 to 1 at 1."""
    clipped = value.clamp(0.0, 1.0)
    return clipped.square() * (3.0 - 2.0 * clipped)


def _resize_to_square(base: Tensor, side: int) -> Tensor:
    """Resize a base colour (h, w, 3) to (side, side, 3); differentiable."""
    return images.resized(base, side, side, antialias=max(base.shape[:2]) > side)
