"""A window of an image: the rectangle of pixels that a renderer traces."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional


class Window(NamedTuple):
    """A rectangle of pixels; rows are counted from the top."""

    top: int
    left: int
    height: int
    width: int

    @classmethod
    def from_mask(cls, mask: Tensor) -> Window | None:
        """Return the smallest window around a mask (H, W); None if it is empty."""
        rows = mask.any(dim=1).nonzero().flatten()
        columns = mask.any(dim=0).nonzero().flatten()
        if not len(rows):
            return None
        top = int(rows[0])
        left = int(columns[0])
        return cls(top, left, int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left)

    @property
    def area(self) -> int:
        """Number of pixels."""
        return self.height * self.width

    def grow(self, margin: int, resolution: tuple[int, int]) -> Window:
        """Return the window with a margin of pixels, as far as the image reaches."""
        top = max(0, self.top - margin)
        left = max(0, self.left - margin)
        bottom = min(resolution[0], self.top + self.height + margin)
        right = min(resolution[1], self.left + self.width + margin)
        return Window(top, left, bottom - top, right - left)

    def crop_image(self, image: Tensor) -> Tensor:
        """Return the pixels (h, w, ...) of the window in an image (H, W, ...)."""
        rows = slice(self.top, self.top + self.height)
        columns = slice(self.left, self.left + self.width)
        return image[rows, columns]

    def paste(self, pixels: Tensor, image: Tensor) -> Tensor:
        """Return an image (H, W, ...) in which the window has other pixels.

        It is differentiable with respect to these (h, w, ...).
        """
        pasted = image.clone()
        window_of_pasted = self.crop_image(pasted)  # a view of its memory
        window_of_pasted[...] = pixels
        return pasted

    def pad(self, pixels: Tensor, resolution: tuple[int, int]) -> Tensor:
        """Return an image (H, W, c) that is zero outside of the window.

        It is differentiable with respect to the window's pixels (h, w, c).
        """
        bottom = resolution[0] - self.top - self.height
        right = resolution[1] - self.left - self.width
        return functional.pad(pixels, (0, 0, self.left, right, self.top, bottom))

    def make_outside_mask(self, resolution: tuple[int, int]) -> Tensor:
        """Return which pixels of an image are outside of the window, (H, W) bool."""
        outside = torch.ones(resolution, dtype=torch.bool)
        self.crop_image(outside)[...] = False  # a view, as in `paste`
        return outside
