"""The `patch` control: a printed square stuck onto the object, whose pixels, place, size and turn may be searched.

After Brown et al. (2017, "Adversarial Patch", arXiv 1712.09665, section 2): the pixels are free, and what is around
them stays. There the patch is pasted into pictures; here it lies on the surface, under the scene's light, and bends
with it (`sticker`). It is part of the base colour, so that no outline moves and the adjoint is right.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.controls.base import NOTHING, WHOLE_RANGE, Budget, Choice, Parameter, Value, change_in_colour
from advsearch.controls.numbers import NumberControl, Slot, Values
from advsearch.controls.patch_sticker import Sticker, towards_camera
from advsearch.controls.texture import radius, resampled
from advsearch.controls.values import LARGEST_EPSILON, Fixed, Moved, Number, OneOf, Range, Spec, in_words
from advsearch.errors import FileFormatError, InputError
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.pictures import read_picture

BASE_COLOR = "object.base_color"
NORMS = ("box", "linf", "l2")
PRINT_SIDE = 512
"""Least side of the picture that is kept for printing, in pixels."""


class PatchControl(NumberControl):
    """A printed square stuck onto the object: numbers that are not given are fixed, and pixels are searched unless they
    are a grey or a picture."""

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

    refines = frozenset({BASE_COLOR})
    on_top = True

    def __init__(self, name: str | None = None, **settings: object) -> None:
        super().__init__(name, **settings)
        pixels, picture = self.specs.get("pixels"), self.chosen["picture"]
        if pixels is not None and picture is not None:
            raise InputError(f"{self.name}.pixels: expected none beside {self.name}.picture; leave one of them out")
        if pixels is not None and not isinstance(pixels, Fixed) and type(pixels) is not Range:
            got = f"a list of {len(pixels.values)}" if isinstance(pixels, OneOf) else "a distribution"
            raise InputError(f"{self.name}.pixels: expected [low, high] or one number, got {got}")
        self._free = picture is None and not isinstance(pixels, Fixed)
        ball = next((one for one in ("epsilon", "norm") if self.chosen[one] not in (None, "box")), None)
        if ball and not self._free:
            raise InputError(
                f"{self.name}.{ball}: is of the ball that searched pixels stay in, and these are fixed; leave it out, "
                f"or leave out {self.name}.{'picture' if picture is not None else 'pixels'}"
            )

    def check_choices(self) -> None:
        epsilon = self.chosen["epsilon"]
        if "norm" not in self._given and epsilon is not None:
            self.chosen["norm"] = "linf"
        if self.chosen["norm"] == "box" and epsilon is not None:
            raise InputError(
                f"{self.name}.epsilon: expected none with norm box, got {epsilon:g}; set norm to linf or l2"
            )

    # ---- in a scene -------------------------------------------------------------------------------------------------

    def size(self, parameter: Parameter) -> int:
        return 3 * int(self.chosen["resolution"]) ** 2 if parameter.shape else 1

    def default(self, parameter: Parameter) -> Number:
        if parameter.name in ("azimuth", "height"):
            return towards_camera(self.scene)[parameter.name == "height"]
        return 0.0 if parameter.name == "pixels" else parameter.default  # what is underneath takes their place

    def spec(self, parameter: Parameter, value: Number) -> Spec:
        if parameter.name == "pixels" and "pixels" not in self.specs:
            return Range(0.0, 1.0) if self._free else Fixed(0.0)
        return self.specs.get(parameter.name, Fixed(value))

    def budget_of(self, parameter: Parameter) -> Budget:
        norm = self.chosen["norm"]
        if parameter.name != "pixels" or norm == "box":
            return WHOLE_RANGE
        spec = self.specs.get("pixels", Range(0.0, 1.0))
        assert isinstance(spec, Range)
        return Budget(norm, radius(norm, self.chosen["epsilon"], self.size(parameter)) / (spec.high - spec.low))

    def fit(self) -> None:
        super().fit()
        if not self.groups:
            raise InputError(
                f"`controls` {self.name}: the pixels are fixed, so there is nothing to search; give another parameter "
                f"a range, such as {self.name}={{azimuth: [0, 360]}}"
            )
        side, pixels = int(self.chosen["resolution"]), self.slots[0]
        self._picture = None if self.chosen["picture"] is None else resampled(self._read(), side)
        resting = {name: float(value) for name, value in self.values(self.start).items() if name != "pixels"}
        self._sticker = Sticker(self.scene, resting, side)
        if isinstance(pixels.spec, Range):
            low, high = pixels.spec.low, pixels.spec.high
            wanted = (self._sticker.underneath() - low) / (high - low)
            self.start[: pixels.width] = wanted.clamp(0.0, 1.0).reshape(-1)
            moved = not torch.allclose(wanted.clamp(0.0, 1.0), wanted, atol=1e-5)
            nearest = f"the nearest {in_words(pixels.spec)}"
            self.moved = (Moved(self.name, f"{self.name}.pixels", "sRGB", "the texture underneath", nearest),) * moved

    def left_out(self, slots: Sequence[Slot]) -> Iterator[Moved]:
        return super().left_out(() if self._free else slots[1:])  # at the start searched pixels show no patch

    def _read(self) -> Tensor:
        try:
            return torch.from_numpy(read_picture(Path(self.chosen["picture"])))
        except FileFormatError as error:
            raise FileFormatError(f"{self.name}.picture: {error}") from error

    def values(self, u: Tensor) -> dict[str, Tensor]:
        values, side = super().values(u), int(self.chosen["resolution"])
        if self._picture is not None:
            return values | {"pixels": self._picture.to(u.device, copy=True)}
        return values | {"pixels": values["pixels"].reshape(side, side, 3)}

    def scene_inputs(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {BASE_COLOR: self._sticker.paint(so_far.get(BASE_COLOR), values["pixels"], values)}

    def describe(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Value]:
        said = super().describe(u, so_far)
        if not self._free:
            return said
        here, start = (self.values(at)["pixels"] for at in (u.detach(), self.start.to(u.device)))
        return {**change_in_colour(self.name, here - start), **said}

    def printed(self, u: Tensor) -> Tensor | None:
        return self.values(u)["pixels"] if self._free else None

    def kept_pictures(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        pixels = values["pixels"]
        return {self.name: enlarged(pixels, -(-PRINT_SIDE // len(pixels))), f"{self.name}-pixels": pixels}


def enlarged(pixels: Tensor, factor: int) -> Tensor:
    """Return a picture (h, w, 3) sRGB at a whole multiple of its size, interpolated as the renderer does it."""
    linear = srgb_to_linear(pixels).permute(2, 0, 1)[None]
    larger = F.interpolate(linear, scale_factor=factor, mode="bilinear", align_corners=False)
    return linear_to_srgb(larger[0].permute(1, 2, 0))
