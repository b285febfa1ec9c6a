"""The `patch` control: a printed square stuck onto the object, whose pixels, place, size and turn may be searched.

After Brown et al. (2017, "Adversarial Patch", arXiv 1712.09665, section 2): the pixels are free, and what is around
them stays. There the patch is pasted into pictures; here it lies on the surface, under the scene's light, and bends
with it (`sticker`). It is part of the base colour, so that no outline moves and the adjoint is right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.controls.base import NOTHING, WHOLE_RANGE, BoundControl, Budget, Choice, Control, Group, Parameter, Value
from advsearch.controls.numbers import BoundNumbers, NumberControl
from advsearch.controls.patch_sticker import Sticker, towards_camera
from advsearch.controls.ranges import Range
from advsearch.controls.texture import resampled
from advsearch.controls.values import LARGEST_EPSILON, Fixed, Moved, Number, OneOf, in_words, read
from advsearch.errors import FileFormatError, InputError
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.importing.pictures import read_picture

BASE_COLOR = "object.base_color"
NORMS = ("box", "linf", "l2")
DEFAULT_EPSILON = 0.1
"""Default radius of an L-infinity ball; the default L2 ball has the same root-mean-square change at its edge."""
PRINT_SIDE = 512
"""Least side of the picture that is kept for printing, in pixels."""


class PatchControl(Control):
    """A printed square stuck onto the object.

    Args:
        name: the instance's name.
        pixels: [low, high] narrows the colours that are searched; a number makes the patch a plain grey.
        resolution: side of the patch in pixels, 2 to 512.
        norm: "box", "linf" or "l2"; None takes box, or linf where there is an epsilon.
        epsilon: radius of the ball that the pixels stay in, for linf and l2; None takes the norm's default.
        picture: path of a picture to stick on as it is.
        **numbers: azimuth, height, size and rotation: a number, a range or a list; fixed where not given.

    Raises:
        UnknownNameError: no such setting.
        InputError: a value is out of range.
    """

    kind = "patch"
    summary = "A printed square stuck onto the object: its pixels, place, size and turn."
    parameters = (
        Parameter(
            "pixels", (None, None, 3), "sRGB", 0.0, 1.0, "the object's own texture underneath",
            "Display-referred colours of the patch; a narrower range is a printer's gamut.", search=(0.0, 1.0),
            estimators=("adjoint",),
        ),
        Parameter(
            "azimuth", (), "degrees", 0.0, 360.0, "towards the camera", "Side of the object that the patch is on.",
            periodic=True, estimators=("differences",),
        ),
        Parameter(
            "height", (), "1", 0.0, 1.0, "towards the camera",
            "Where it is from the middle of the underside (0) over the sides (0.5) to the middle of the top (1).",
            estimators=("differences",),
        ),
        Parameter(
            "size", (), "object sizes", 0.05, 0.6, 0.3, "Side of the patch.", log=True,
            estimators=("adjoint", "differences"),
        ),
        Parameter(
            "rotation", (), "degrees", -180.0, 180.0, 0.0,
            "Turn of the patch on the surface, counter-clockwise; upright at 0.", periodic=True,
            estimators=("adjoint", "differences"),
        ),
    )  # fmt: skip
    choices = (
        Choice("resolution", 32, "Side of the patch in pixels.", whole=(2, 512)),
        Choice(
            "norm", "box",
            "How far pixels may go: box (anywhere), linf (the default with an epsilon) or l2 (a ball around what is "
            "underneath).",
            "norm", "pixels", options=NORMS,
        ),
        Choice(
            "epsilon", None, "Radius of that ball, display-referred; by default 0.1 a pixel value.", "epsilon",
            "pixels", most=LARGEST_EPSILON,
        ),
        Choice("picture", None, "A picture file to stick on as it is; then pixels are not searched.", fixes="pixels"),
    )  # fmt: skip

    def __init__(
        self,
        name: str | None = None,
        *,
        pixels: object = None,
        resolution: int = 32,
        norm: str | None = None,
        epsilon: float | None = None,
        picture: str | None = None,
        **numbers: object,
    ) -> None:
        self.name = name or self.kind
        self.resolution, self.epsilon, self.picture = resolution, epsilon, picture
        self.norm = norm or ("box" if epsilon is None else "linf")
        for choice in self.choices:
            choice.check(self.name, getattr(self, choice.name))
        if self.norm == "box" and self.epsilon is not None:
            raise InputError(
                f"{self.name}.epsilon: expected none with norm box, got {self.epsilon:g}; set norm to linf or l2"
            )
        self._placement = _Placement(self.name, **numbers)
        self._pixels_given = pixels
        self._pixels = self._pixel_spec()
        ball = "epsilon" if epsilon is not None else "norm" if self.norm != "box" else None
        if ball and isinstance(self._pixels, Fixed):
            raise InputError(
                f"{self.name}.{ball}: is of the ball that searched pixels stay in, and these are fixed; leave it out, "
                f"or leave out {self.name}.{'picture' if picture is not None else 'pixels'}"
            )

    def settings(self) -> dict[str, object]:
        given = {one.name: getattr(self, one.name) for one in self.choices if getattr(self, one.name) != one.default}
        if self._pixels_given is not None:
            given["pixels"] = self._pixels_given
        named = {"kind": self.kind} if self.name != self.kind else {}
        return {**named, **given, **self._placement.given}

    def _pixel_spec(self) -> Range | Fixed:
        """What the pixels are set to; where there is a picture, that takes their place."""
        if self._pixels_given is None:
            return Fixed(0.0) if self.picture is not None else Range(0.0, 1.0)
        if self.picture is not None:
            raise InputError(f"{self.name}.pixels: expected none beside {self.name}.picture; leave one of them out")
        spec = read(f"{self.name}.pixels", self.parameters[0], self._pixels_given)
        if not isinstance(spec, Fixed) and type(spec) is not Range:
            got = f"a list of {len(spec.values)}" if isinstance(spec, OneOf) else "a distribution"
            raise InputError(f"{self.name}.pixels: expected [low, high] or one number, got {got}")
        return spec

    def bind(self, scene: SceneDescription) -> BoundControl:
        spec, placed = self._pixels, self._placement.placed(scene)
        if isinstance(spec, Fixed) and not self._placement.asked:
            raise InputError(
                f"`controls` {self.name}: the pixels are fixed, so there is nothing to search; give another parameter "
                f"a range, such as {self.name}={{azimuth: [0, 360]}}"
            )
        resting = placed.values(placed.start) if isinstance(placed, BoundNumbers) else placed
        side = int(self.resolution)
        sticker = Sticker(scene, {one: float(value) for one, value in resting.items()}, side)
        if isinstance(spec, Fixed):
            pixels = self._fixed_pixels(float(spec.value))
            bound = BoundPatch(self.name, sticker, Range(0.0, 1.0), pixels, None, placed)
            bound.moved = placed.moved if isinstance(placed, BoundNumbers) else ()
            return bound
        wanted = (sticker.underneath() - spec.low) / (spec.high - spec.low)
        start = wanted.clamp(0.0, 1.0)
        group = Group("pixels", start.numel(), ("adjoint",), self._budget(start.numel(), spec))
        bound = BoundPatch(self.name, sticker, spec, start, group, placed)
        if not torch.allclose(start, wanted, atol=1e-5):
            nearest = f"the nearest {in_words(spec)}"
            bound.moved = (Moved(self.name, f"{self.name}.pixels", "sRGB", "the texture underneath", nearest),)
        return bound

    def _fixed_pixels(self, grey: float) -> Tensor:
        """The patch (n, n, 3) sRGB that is not searched: the picture, or else one grey."""
        side = int(self.resolution)
        if self.picture is None:
            return torch.full((side, side, 3), grey)
        path = Path(self.picture)
        try:
            pixels = torch.from_numpy(read_picture(path))
        except FileFormatError as error:
            raise FileFormatError(f"{self.name}.picture: {error}") from error
        return resampled(pixels, side)

    def _budget(self, count: int, spec: Range) -> Budget:
        if self.norm == "box":
            return WHOLE_RANGE
        epsilon = self.epsilon or DEFAULT_EPSILON * (math.sqrt(count) if self.norm == "l2" else 1.0)
        return Budget(self.norm, epsilon / (spec.high - spec.low))


class _Placement(NumberControl):
    """The numbers of a patch; those not given are fixed."""

    kind = PatchControl.kind
    summary = "Where a patch is, how large and how turned."
    parameters = PatchControl.parameters[1:]

    @property
    def given(self) -> dict[str, object]:
        """What was said about the numbers."""
        return self._given

    def default(self, scene: SceneDescription, parameter: Parameter) -> Number:
        if parameter.name in ("azimuth", "height"):
            return dict(zip(("azimuth", "height"), towards_camera(scene), strict=True))[parameter.name]
        return parameter.default

    def placed(self, scene: SceneDescription) -> BoundNumbers | dict[str, Tensor]:
        """The numbers bound to a scene where any is searched, or else their values."""
        if self.asked:
            return self.bind(scene)
        fixed = {name: spec.value for name, spec in self.specs.items() if isinstance(spec, Fixed)}
        return {one.name: torch.tensor(float(fixed.get(one.name, self.default(scene, one)))) for one in self.parameters}


class BoundPatch(BoundControl):
    """A patch on one object.

    Args:
        name: the instance's name.
        sticker: paints it.
        spec: range of the pixels.
        pixels: (n, n, 3) their coordinates in u at the start, or their sRGB values where they are not searched.
        group: the group of the pixels, if they are searched.
        numbers: the other parameters, bound or fixed.
    """

    refines: frozenset[str] = frozenset({BASE_COLOR})
    on_top = True

    def __init__(
        self,
        name: str,
        sticker: Sticker,
        spec: Range,
        pixels: Tensor,
        group: Group | None,
        numbers: BoundNumbers | dict[str, Tensor],
    ) -> None:
        self.name = name
        self._sticker, self._spec, self._pixels, self._numbers = sticker, spec, pixels, numbers
        self._searched = group.size if group else 0
        further = numbers if isinstance(numbers, BoundNumbers) else None
        self.start = torch.cat([pixels.reshape(-1)[: self._searched], further.start if further else torch.zeros(0)])
        self.groups = (*([group] if group else ()), *(further.groups if further else ()))

    def pixels(self, u: Tensor) -> Tensor:
        """Return the patch (n, n, 3), display-referred sRGB in [0, 1]."""
        if not self._searched:
            return self._pixels.to(u.device, copy=True)
        share = u[: self._searched].reshape(self._pixels.shape)
        return self._spec.low + (self._spec.high - self._spec.low) * share

    def numbers(self, u: Tensor) -> Mapping[str, Tensor]:
        """Return place, size and rotation, in their units."""
        if isinstance(self._numbers, BoundNumbers):
            return self._numbers.values(u[self._searched :])
        return {name: number.to(u.device, copy=True) for name, number in self._numbers.items()}

    def inputs(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        return {BASE_COLOR: self._sticker.paint(so_far.get(BASE_COLOR), self.pixels(u), self.numbers(u))}

    def describe(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Value]:
        u = u.detach()
        said: dict[str, Value] = {}
        if self._searched:
            change = self.pixels(u) - self.pixels(self.start.to(u.device))
            said[f"{self.name}.linf"] = {"value": float(change.abs().max()), "unit": "sRGB"}
            said[f"{self.name}.rms"] = {"value": float(change.square().mean().sqrt()), "unit": "sRGB"}
        if isinstance(self._numbers, BoundNumbers):
            said.update(self._numbers.describe(u[self._searched :]))
        return said

    def printed(self, u: Tensor) -> Tensor | None:
        return self.pixels(u) if self._searched else None

    def artifacts(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        pixels = self.pixels(u.detach())
        return {self.name: enlarged(pixels, -(-PRINT_SIDE // len(pixels))), f"{self.name}-pixels": pixels}


def enlarged(pixels: Tensor, factor: int) -> Tensor:
    """Return a picture (h, w, 3) sRGB at a whole multiple of its size, interpolated as the renderer does it."""
    linear = srgb_to_linear(pixels).permute(2, 0, 1)[None]
    larger = F.interpolate(linear, scale_factor=factor, mode="bilinear", align_corners=False)
    return linear_to_srgb(larger[0].permute(1, 2, 0))
