"""The entries of the YAML file of a place, see `place_file`."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from advsearch.scene.assets import Float64Array
from advsearch.scene.footprint import Footprint

MAX_SOLIDS = 2000  # outlines of a place
N_CIRCLE_CORNERS = 8  # of the outline of what is round
MAX_LENGTH = 1e5  # largest length, metres

Length = Annotated[
    float, Field(strict=True, ge=-MAX_LENGTH, le=MAX_LENGTH, allow_inf_nan=False)
]
Positive = Annotated[
    float, Field(strict=True, gt=0.0, le=MAX_LENGTH, allow_inf_nan=False)
]
Luminance = Annotated[float, Field(strict=True, ge=0.0, le=1e9, allow_inf_nan=False)]
Illuminance = Annotated[float, Field(strict=True, gt=0.0, le=1e9, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Bounds = tuple[Length, Length]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


def _is_convex(corners: Float64Array) -> bool:
    """Return whether an outline is convex and has an area.

    It is convex if it turns only left or only right at its corners. A corner at which
    it goes straight on, within rounding, does not count. If all corners are on one
    line, it has no area.

    Args:
        corners: (K, 2) in their order around the outline.
    """
    edges = np.roll(corners, -1, axis=0) - corners
    # cross products of successive edges
    cross_products = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(
        edges[:, 0], -1
    )
    smallest = float(cross_products.min())
    largest = float(cross_products.max())
    rounding = 1e-9 * max(-smallest, largest)
    return rounding > 0.0 and (smallest >= -rounding or largest <= rounding)


class SolidEntry(_Entry):
    """What nothing else can be in.

    A convex outline on the ground, or a round one at some positions.
    """

    name: Name  # as a sentence has it: "a house"
    outline: (
        Annotated[list[tuple[Length, Length]], Field(min_length=3, max_length=64)]
        | None
    ) = None
    at: (
        Annotated[
            list[tuple[Length, Length]], Field(min_length=1, max_length=MAX_SOLIDS)
        ]
        | None
    ) = None
    radius: Positive | None = None
    heights: Bounds  # heights from and to

    @model_validator(mode="after")
    def _check_form(self) -> SolidEntry:
        """Check that an entry has one convex outline, or a radius and positions.

        Raises ValueError, which pydantic reports: the entry has both or neither, the
        lower height is not first, the outline is not convex, or the name is not a
        single line of text.
        """
        if not (self._is_round() or self._is_outlined()):
            raise ValueError(
                "expected either an outline, or a radius and the positions that it is "
                "at"
            )
        if self.heights[0] >= self.heights[1]:
            raise ValueError("heights: expected the lower one first")
        if not self.name.isprintable():
            raise ValueError("name: expected a line of text, such as 'a house'")
        if self.outline is not None and not _is_convex(np.array(self.outline)):
            raise ValueError(
                "outline: expected the corners of a convex outline in "
                "turn; split it into convex ones"
            )
        return self

    def _is_round(self) -> bool:
        """Return whether the entry has a radius and positions, and no outline."""
        has_positions = self.at is not None
        return self.radius is not None and has_positions and self.outline is None

    def _is_outlined(self) -> bool:
        """Return whether the entry has an outline, and neither radius nor positions."""
        has_outline = self.outline is not None
        return has_outline and self.radius is None and self.at is None

    def list_footprints(self) -> list[Footprint]:
        """Return the outline, or a round one at each position, in metres.

        A round outline is a regular polygon with its corners on the circle.
        """
        if self.outline is not None:
            return [Footprint(np.array(self.outline), *self.heights)]
        # `_check_form` has checked that there are a radius and positions.
        turn = np.arange(N_CIRCLE_CORNERS) * (2.0 * np.pi / N_CIRCLE_CORNERS)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        return [
            Footprint(np.array(center) + (self.radius or 0.0) * circle, *self.heights)
            for center in self.at or ()
        ]


class ValidEntry(_Entry):
    """The box in which a camera has to be; what is not bounded is left out."""

    x: Bounds | None = None
    y: Bounds | None = None
    z: Bounds | None = None

    @model_validator(mode="after")
    def _check_order(self) -> ValidEntry:
        """Check that bounds have the lower one first."""
        for axis, bounds in (("x", self.x), ("y", self.y), ("z", self.z)):
            if bounds is not None and bounds[0] >= bounds[1]:
                raise ValueError(f"{axis}: expected the lower bound first")
        return self


class PictureEntry(_Entry):
    """What stands around, where the maps of the light show it.

    It fits the ground from near that place only.
    """

    height: Positive  # above the ground from which the maps were taken
    x: Bounds  # position from and to, of what stands nearest
    y: Bounds

    @model_validator(mode="after")
    def _check_inside(self) -> PictureEntry:
        """Check that the object, at 0, is between the bounds."""
        for axis, (low, high) in (("x", self.x), ("y", self.y)):
            if not low < 0.0 < high:
                raise ValueError(
                    f"{axis}: expected bounds on both sides of the object, at 0"
                )
        return self


class PlaceLight(_Entry):
    """A light that the place may stand in."""

    # an .hdr or .exr file in the folder, or the name of a bundled environment
    map: Name
    lux: Illuminance | None = None  # lux of level ground under open sky
    variant: Name | None = None  # variant of the materials


class PlaceFile(_Entry):
    """What a place's file says."""

    mesh: Name  # a .glb or .gltf file in the folder
    # meshes that things stand on
    ground: Annotated[list[Name], Field(min_length=1, max_length=64)]
    # the first is taken by itself
    lights: Annotated[dict[Name, PlaceLight], Field(min_length=1, max_length=64)]
    # Lane width of the lane that the object drives in; None: there is none.
    lane_width: Positive | None = None
    # height of the floor that cameras stand on, where the object stands on something
    floor: Length = 0.0
    lamps: Annotated[
        dict[Name, tuple[Luminance, Luminance, Luminance]], Field(max_length=64)
    ] = {}
    """Luminance in cd/m2, for each colour channel, of meshes that shine when it is
    dark, and only then.
    """
    solids: Annotated[list[SolidEntry], Field(max_length=MAX_SOLIDS)] = []
    valid: ValidEntry = ValidEntry()
    picture: PictureEntry | None = None  # None: nothing near is in the maps alone
