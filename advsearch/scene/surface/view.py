"""What one camera sees of the searched texture: a sparse matrix that serves every light and every texture."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.surface import RAYS, Seen


class View:
    """What one camera sees: `rest`, and a sparse matrix from the fine grid to the pixels.

    Args:
        seen: by several cameras.
        number: of this one.
        shape: rows and columns of the fine grid.
    """

    def __init__(self, seen: Seen, number: int, shape: tuple[int, int]) -> None:
        self.rest, self.covered = seen.rest[number], seen.covered[number]
        height, width = self.rest.shape[:2]
        ends = torch.tensor([number, number + 1]) * (height * width * RAYS)
        begin, end = torch.searchsorted(seen.sample, ends).tolist()
        pixel = (seen.sample[begin:end] - int(ends[0])) // RAYS
        columns, shares = bilinear(seen.uv[begin:end].numpy(), shape)
        weights = shares * seen.weight[begin:end].numpy()[:, None]
        starts = np.searchsorted(pixel.numpy(), np.arange(height * width + 1)) * 4
        size = height * width, shape[0] * shape[1]
        self.matrix = scipy.sparse.csr_matrix(
            (weights.ravel(), columns.ravel(), starts.astype(np.int32)), size, copy=False
        )

    def radiance(self, reflected: Tensor) -> Tensor:
        """Return (H, W, 3) for what the fine grid reflects (cells, 3); differentiable in it."""
        found: Tensor = Product.apply(self.matrix, reflected)  # type: ignore[no-untyped-call]
        return self.rest + found.reshape(self.rest.shape)


class Product(torch.autograd.Function):
    """A sparse matrix times columns, with its transpose as the derivative."""

    @staticmethod
    def forward(ctx: Any, matrix: scipy.sparse.csr_matrix, values: Tensor) -> Tensor:
        ctx.matrix = matrix
        return torch.from_numpy(matrix @ values.detach().numpy())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[None, Tensor]:
        return None, torch.from_numpy(ctx.matrix.T @ cotangent.numpy())


def bilinear(uv: npt.NDArray[np.float32], shape: tuple[int, int]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """The four texels (n, 4) of the look-up at texture coordinates (n, 2), which repeats at the border, and their
    shares (n, 4)."""
    rows, columns = shape
    x, y = uv[:, 0] * np.float32(columns) - np.float32(0.5), uv[:, 1] * np.float32(rows) - np.float32(0.5)
    left, low = np.floor(x), np.floor(y)
    across, up = x - left, y - low
    left, low = left.astype(np.int32), low.astype(np.int32)
    x0, x1, y0, y1 = left % columns, (left + 1) % columns, low % rows * columns, (low + 1) % rows * columns
    places = np.stack([y0 + x0, y0 + x1, y1 + x0, y1 + x1], axis=1)
    down, beside = 1.0 - up, 1.0 - across
    shares = np.stack([down * beside, down * across, up * beside, up * across], axis=1)
    return places, shares
