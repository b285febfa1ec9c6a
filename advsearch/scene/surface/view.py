"""What one camera sees of the searched texture: a sparse matrix that serves every light and every texture."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from advsearch.scene.mitsuba_backend.surface import RAYS, Seen
from advsearch.scene.transport.matrix import bilinear


class SurfaceView:
    """What one camera sees: `rest`, and a sparse matrix from the fine grid, front and back, to the pixels.

    Args:
        seen: by several cameras.
        number: of this one.
        shape: rows and columns of the fine grid.
        sides: 2 where the back of the surface has light of its own.
    """

    def __init__(self, seen: Seen, number: int, shape: tuple[int, int], sides: int = 1) -> None:
        self.rest, self.covered = seen.rest[number], seen.covered[number]
        height, width = self.rest.shape[:2]
        ends = torch.tensor([number, number + 1]) * (height * width * RAYS)
        begin, end = torch.searchsorted(seen.sample, ends).tolist()
        pixel = (seen.sample[begin:end] - int(ends[0])) // RAYS
        columns, shares = bilinear(seen.uv[begin:end].numpy(), shape)
        columns += np.int32(shape[0] * shape[1]) * seen.back[begin:end].numpy()[:, None]
        weights = shares * seen.weight[begin:end].numpy()[:, None]
        starts = np.searchsorted(pixel.numpy(), np.arange(height * width + 1)) * 4
        size = height * width, sides * shape[0] * shape[1]
        self.matrix = scipy.sparse.csr_matrix(
            (weights.ravel(), columns.ravel(), starts.astype(np.int32)), size, copy=False
        )

    def radiance(self, reflected: Tensor) -> Tensor:
        """Return (H, W, 3) for what the fine grid reflects (sides x cells, 3); differentiable in it."""
        found: Tensor = SparseProduct.apply(self.matrix, reflected)  # type: ignore[no-untyped-call]
        return self.rest + found.reshape(self.rest.shape)


class SparseProduct(torch.autograd.Function):
    """A sparse matrix times columns, with its transpose as the derivative."""

    @staticmethod
    def forward(ctx: Any, matrix: scipy.sparse.csr_matrix, values: Tensor) -> Tensor:
        ctx.matrix = matrix
        return torch.from_numpy(matrix @ values.detach().numpy())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, cotangent: Tensor) -> tuple[None, Tensor]:
        return None, torch.from_numpy(ctx.matrix.T @ cotangent.numpy())
