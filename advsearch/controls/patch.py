"""The `patch` control: a printed square stuck onto the object, whose pixels, place,
size and turn may be searched.

After Brown et al. (2017, "Adversarial Patch", arXiv 1712.09665, section 2): the pixels
are free, and what is around them stays. There the patch is pasted into pictures; here
it lies on the surface, under the scene's light, and bends with it. It is part of the
base colour, so that no outline moves and the adjoint is right.

    base colour = (1 - m) base colour + m linear(pixels at (a, b)),     m = soft square in (a, b), front of the surface

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
BASE_SIDES = (512, 1024)
REACH = 0.75
"""Radius around the middle, in sides of the square, within which the surface is
painted: its corners are at 0.7071.
"""
# cosines between the surface and the square's normal between which it fades in
FACING = (0.1, 0.3)
EDGE_TEXELS = 2.0  # width of the soft edge in texels


class PatchControl(PictureControl):
    """A printed square stuck onto the object: its pixels, place, size and turn.

    Numbers that are not given are fixed, and pixels are searched unless they are a grey
    or a picture.
    """

    kind = "patch"
    shown = "pixels"
    parameters = (
        Parameter("pixels", (None, None, 3), "sRGB", 0.0, 1.0, "the object's own texture underneath",
                  "Display-referred colours of the patch; a narrower range is a "
                  "printer's gamut.", search=(0.0, 1.0),
                  estimators=("adjoint",)),
        Parameter.number(("differences",), "azimuth", "degrees", 0.0, 360.0, "towards the camera",
                         "Side of the object that the patch is on.", periodic=True),
        Parameter.number(("differences",), "height", "1", 0.0, 1.0, "towards the camera",
                         "Where it is from the middle of the underside (0) over the "
                         "sides (0.5) to the middle of the "
                         "top (1)."),
        Parameter.number(Parameter.LIT, "size", "object sizes", 0.05, 0.6, 0.3, "Side of the patch.", log=True),
        Parameter.number(Parameter.LIT, "rotation", "degrees", -180.0, 180.0, 0.0,
                         "Turn of the patch on the surface, counter-clockwise; upright "
                         "at 0.", periodic=True),
    )  # fmt: skip
    choices = (
        Choice("resolution", 32, "Side of the patch in pixels.", whole=(2, 512)),
        Choice("norm", "box",
               "How far pixels may go: box (anywhere), linf (the default with an "
               "epsilon) or l2 (a ball around what "
               "is underneath).", "norm", "pixels", options=NORMS),
        Choice("epsilon", None, "Radius of that ball, display-referred; by default 0.1 "
                                "a pixel value.", "epsilon",
               "pixels", most=PictureControl.LARGEST_EPSILON),
        Choice("picture", None, "A picture file to stick on as it is; then pixels are "
                                "not searched.", fixes="pixels"),
    )  # fmt: skip

    refines = frozenset({BASE_COLOR})
    on_top = True

    def __init__(self, name: str | None = None, **settings: object) -> None:
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
                one
                for one in ("epsilon", "norm")
                if self.chosen[one] not in (None, "box")
            ),
            None,
        )
        if ball and not self.free:
            raise InputError(
                f"{self.name}.{ball}: is of the ball that searched pixels stay in, and "
                "these are fixed; leave it out, "
                f"or leave out {self.name}.{'picture' if picture is not None else 'pixels'}"
            )

    def check_choices(self) -> None:
        epsilon = self.chosen["epsilon"]
        if "norm" not in self._given and epsilon is not None:
            self.chosen["norm"] = "linf"
        if self.chosen["norm"] == "box" and epsilon is not None:
            raise InputError(
                f"{self.name}.epsilon: expected none with norm box, got {epsilon:g}; "
                "set norm to linf or l2"
            )

    # ---- in a scene
    # -------------------------------------------------------------------------------------------------

    def in_scene(self, parameter: Parameter) -> Parameter:
        if parameter.name not in ("azimuth", "height"):
            return super().in_scene(parameter)
        return replace(
            parameter, default=towards_camera(self.scene)[parameter.name == "height"]
        )

    def fit(self) -> None:
        super().fit()
        if not self.groups:
            raise InputError(
                f"`controls` {self.name}: the pixels are fixed, so there is nothing to "
                "search; give another parameter "
                f"a range, such as {self.name}={{azimuth: [0, 360]}}"
            )
        side = self.sides[0]
        pixels = self.slots[0]
        picture = self.read_picture()
        self._picture = None if picture is None else images.resampled(picture, side)
        resting = {
            name: float(value)
            for name, value in self.values(self.start).items()
            if name != "pixels"
        }
        self._sticker = Sticker(self.scene, resting, side)
        if isinstance(pixels.spec, Range):
            low = pixels.spec.low
            high = pixels.spec.high
            wanted = (self._sticker.underneath() - low) / (high - low)
            self.start[: pixels.width] = wanted.clamp(0.0, 1.0).reshape(-1)
            if not torch.allclose(wanted.clamp(0.0, 1.0), wanted, atol=1e-5):
                self.note_moved(
                    pixels.parameter,
                    "the texture underneath",
                    f"the nearest {pixels.spec}",
                )

    def is_compared(self, parameter: Parameter, spec: Fixed | Range | OneOf) -> bool:
        # at the start searched pixels show no patch
        return not self.free and parameter.name != "pixels"

    def scene_inputs(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        return {
            BASE_COLOR: self._sticker.paint(
                so_far.get(BASE_COLOR), values["pixels"], values
            )
        }

    def printed(self, u: Tensor) -> Tensor | None:
        return self.values(u)["pixels"] if self.free else None

    def kept_pictures(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        pixels = values["pixels"]
        return {
            self.name: images.enlarged(pixels, -(-images.PRINT_SIDE // len(pixels))),
            f"{self.name}-pixels": pixels,
        }


# ---- on the surface
# --------------------------------------------------------------------------------------------------


def towards_camera(scene: SceneDescription) -> tuple[float, float]:
    """Return azimuth (degrees) and height (0 to 1) of the place in the middle of the
    object as the camera sees it.
    """
    middle, radius, half = _shape(scene.object.mesh)
    camera = geometry.camera_to_world(scene)[:3, 3]
    x, y, z = (
        np.linalg.solve(geometry.object_to_world(scene), np.append(camera, 1.0))[:3]
        - middle
    )
    lift = math.atan2(z * radius, max(math.hypot(x, y), 1e-12) * half)
    return math.degrees(math.atan2(y, x)) % 360.0, 0.5 + lift / math.pi


def _shape(mesh: assets.Mesh) -> tuple[assets.Doubles, float, float]:
    """Middle (3,) of a mesh, its largest half-width and its half-height."""
    low = mesh.vertices.min(axis=0).astype(np.float64)
    high = mesh.vertices.max(axis=0).astype(np.float64)
    half = np.maximum((high - low) / 2.0, 1e-6)
    return (low + high) / 2.0, float(half[:2].max()), float(half[2])


@dataclass(frozen=True, eq=False)
class Spot:
    """A place for a patch: the texels that it may cover and their coordinates around
    it.
    """

    texels: Tensor  # (N,) their numbers, row by row
    flat: Tensor  # (N, 2) their coordinates to the right and upwards, object sizes
    cover: Tensor  # (N,) in [0, 1]: how much they face the patch
    spacing: float  # distance between neighbouring texels on the surface, object sizes


class Sticker:
    """Paints a patch of `side` pixels into the object's base-colour map; the resting
    numbers are those at the start.
    """

    def __init__(
        self, scene: SceneDescription, resting: Mapping[str, float], side: int
    ) -> None:
        mesh = scene.object.mesh
        if mesh.repeats:
            raise InputError(
                "`controls` patch: the object's texture repeats on it, and so would a "
                "patch that is painted into it; "
                "leave patch out, or search the whole texture"
            )
        self._shape = _shape(mesh)
        self._resting = resting
        self._side = side
        self._surface = images.MeshSurface(mesh)
        own = color.srgb_to_linear(torch.from_numpy(scene.object.base_color.copy()))
        smallest, largest = BASE_SIDES
        # sides of a map whose texels are smaller than the pixels
        least = wanted = max(smallest, *own.shape[:2])
        charts = images.rasterised(mesh, least)
        areas = charts.areas()
        spacing = math.sqrt(float(np.median(areas[areas > 0.0])))
        while (
            2 * wanted <= largest and spacing * least / wanted > resting["size"] / side
        ):
            wanted *= 2
        charts = charts if wanted == least else images.rasterised(mesh, wanted)
        self._own = _fitted(own, len(charts.face))
        mask = charts.touched
        self._texels = np.flatnonzero(mask)
        self._faces = charts.face[mask]
        self._positions, self._normals, self._areas = (
            array[mask].astype(np.float64)
            for array in (charts.positions(), charts.normals(), charts.areas())
        )
        self._spot = lru_cache(maxsize=4)(self._find_spot)

    def paint(
        self, base: Tensor | None, pixels: Tensor, numbers: Mapping[str, Tensor]
    ) -> Tensor:
        """Return the base colour (h, w, 3), linear, with the patch of pixels (n, n, 3)
        sRGB on it; differentiable except in the place (azimuth, height, size and
        rotation). The base is what other controls made of it; None takes the object's
        own.
        """
        device = pixels.device
        base = self._own.to(device) if base is None else _fitted(base, len(self._own))
        size = numbers["size"]
        spot = self._spot(
            *(float(numbers[name].detach()) for name in ("azimuth", "height", "size"))
        )
        texels = spot.texels.to(device)
        across = _turned(spot.flat.to(device), numbers["rotation"]) / size
        edge = (0.5 - across.abs().amax(dim=1)) * size / (
            EDGE_TEXELS * spot.spacing
        ) + 0.5
        cover = (spot.cover.to(device) * _smooth(edge))[:, None]
        grid = (across * across.new_tensor([2.0, -2.0]))[None, None]
        linear = images.planes(color.srgb_to_linear(pixels))
        ink = F.grid_sample(
            linear, grid, mode="bilinear", padding_mode="border", align_corners=False
        )[0, :, 0].T
        flat = base.reshape(-1, 3)
        under = flat.index_select(0, texels)
        return flat.index_copy(0, texels, under + cover * (ink - under)).reshape(
            base.shape
        )

    def underneath(self) -> Tensor:
        """Return what the object's own texture shows where the patch starts, as a patch
        (n, n, 3) sRGB.
        """
        resting = self._resting
        side = self._side
        spot = self._spot(resting["azimuth"], resting["height"], resting["size"])
        across = _turned(spot.flat, torch.tensor(resting["rotation"])) / resting["size"]
        inside = (across.abs().amax(dim=1) < 0.5) & (spot.cover > 0.0)
        if not bool(inside.any()):
            return torch.full((side, side, 3), 0.5)
        own_color = self._own.reshape(-1, 3)[spot.texels[inside]]
        place = across[inside] * torch.tensor([1.0, -1.0]) + 0.5
        column, row = (place * side).long().clamp(0, side - 1).T
        index = row * side + column
        sums = torch.zeros(side * side, 3).index_add(0, index, own_color)
        counts = torch.zeros(side * side).index_add(0, index, torch.ones(len(index)))
        colors = sums / counts.clamp_min(1.0)[:, None]
        centres = torch.stack(
            torch.meshgrid(*[torch.arange(side) + 0.5] * 2, indexing="ij"), dim=-1
        ).reshape(-1, 2)
        nearest = spatial.cKDTree(place.flip(1).numpy()).query(centres.numpy() / side)[
            1
        ]
        colors = torch.where(
            counts[:, None] > 0.0, colors, own_color[torch.from_numpy(nearest)]
        )
        return color.linear_to_srgb(colors).reshape(side, side, 3)

    def _find_spot(self, azimuth: float, height: float, size: float) -> Spot:
        middle, radius, half = self._shape
        angle = math.radians(azimuth)
        lift = (height - 0.5) * math.pi
        outwards = np.array(
            [
                math.cos(lift) * radius * math.cos(angle),
                math.cos(lift) * radius * math.sin(angle),
                0.0,
            ]
        )
        outwards[2] = math.sin(lift) * half
        outwards /= np.linalg.norm(outwards)
        face, point = self._surface.hit(
            middle + 4.0 * (radius + half) * outwards, -outwards
        )
        side = 1.0 if float(self._surface.normals[face] @ outwards) >= 0.0 else -1.0
        # the mean normal over half of the patch's side at the start
        normal = self._surface.normals[face]
        near_by = 0.5 * self._resting["size"]
        near = self._surface.region(face, point, normal, near_by)[self._faces]
        fall = (
            np.maximum(
                1.0 - ((self._positions[near] - point) ** 2).sum(axis=1) / near_by**2,
                0.0,
            )
            ** 2
        )
        total = (self._normals[near] * (fall * self._areas[near])[:, None]).sum(axis=0)
        length = float(np.linalg.norm(total))
        normal = total / length if length > 1e-12 else normal
        level = math.hypot(outwards[0], outwards[1])
        upwards = np.array(
            [-outwards[2] * math.cos(angle), -outwards[2] * math.sin(angle), level]
        )
        frame = _frame(side * normal, upwards)
        reach = REACH * size
        chosen = np.flatnonzero(
            self._surface.region(face, point, side * frame[2], reach)[self._faces]
        )
        offsets = self._positions[chosen] - point
        close = (offsets**2).sum(axis=1) <= reach**2
        chosen = chosen[close]
        offsets = offsets[close]
        flat, cosine = unrolled(offsets, side * self._normals[chosen], frame)
        low, high = FACING
        areas = self._areas[chosen]
        return Spot(
            torch.from_numpy(self._texels[chosen]),
            torch.from_numpy(flat.astype(np.float32)),
            _smooth(
                torch.from_numpy(((cosine - low) / (high - low)).astype(np.float32))
            ),
            math.sqrt(float(np.median(areas[areas > 0.0])))
            if (areas > 0.0).any()
            else 1.0 / len(self._own),
        )


def _frame(normal: assets.Doubles, upwards: assets.Doubles) -> assets.Doubles:
    """Rows right, up, normal (3, 3) of a right-handed frame with `up` as near to a
    direction as the normal lets it.
    """
    up = upwards - float(upwards @ normal) * normal
    if float(np.linalg.norm(up)) < 1e-6:
        up = np.eye(3)[int(np.abs(normal).argmin())]
        up = up - float(up @ normal) * normal
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, normal), up, normal])


def unrolled(
    offsets: assets.Doubles, normals: assets.Doubles, frame: assets.Doubles
) -> tuple[assets.Doubles, assets.Doubles]:
    """Return coordinates (N, 2) of points along a surface, to the right and upwards,
    and normals' cosines (N,).

    In the tangent plane a point of a circle of radius R lies at `R sin(phi)` where its
    arc is `R phi`, phi being the angle that the normal has turned. So the component
    along the direction of turning is stretched by `phi / sin(phi)`. Offsets are (N, 3)
    from the middle; the rows of `frame` are right, up and normal there.
    """
    plane = offsets @ frame[:2].T
    tilt = normals @ frame[:2].T
    cosine = normals @ frame[2]
    sine = np.linalg.norm(tilt, axis=1)
    towards = tilt / np.maximum(sine, 1e-9)[:, None]
    turned = np.arctan2(sine, np.maximum(cosine, 0.1))
    stretch = np.where(sine > 1e-4, turned / np.maximum(np.sin(turned), 1e-9), 1.0)
    along = (plane * towards).sum(axis=1)
    return plane + ((stretch - 1.0) * along)[:, None] * towards, cosine


def _turned(flat: Tensor, degrees: Tensor) -> Tensor:
    """Coordinates (N, 2) on a patch that is turned counter-clockwise."""
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


def _smooth(share: Tensor) -> Tensor:
    """The step `3 t^2 - 2 t^3` between 0 and 1."""
    clipped = share.clamp(0.0, 1.0)
    return clipped.square() * (3.0 - 2.0 * clipped)


def _fitted(base: Tensor, side: int) -> Tensor:
    """Resize a base colour (h, w, 3) to (side, side, 3); differentiable."""
    return images.resized(base, side, side, antialias=max(base.shape[:2]) > side)
