"""The matrix of light transport from the texels of a base colour to the pixels of a picture.

Where camera, meshes and lights stand still, the radiance of a pixel is, to first order in the base colour,

    radiance = base + J (base colour - base colour there),        J: pixels x texels, one weight a colour channel,

and J is sparse: a pixel sees few texels directly (bilinear lookups of the first vertices of its paths) and many a
little (light from the object to the object), for which coarse cells of `COARSE` texels a side are enough.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.scene.mitsuba_backend.transport import Vertices

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float32]
Smooth = Callable[[Tensor], Tensor]
"""From a noisy picture (H, W, 3) to one without noise."""
COARSE = 8
"""Side of the cells of later vertices, in texels."""
MOST = 4.0
"""Factor by which a row is scaled at most."""


class SparseMatrix:
    """A sparse matrix for each colour channel, summed up from entries and then kept in CSR both ways.

    Args:
        rows, columns: its size.
    """

    def __init__(self, rows: int, columns: int) -> None:
        self._shape = (rows, columns)
        self._sums = [scipy.sparse.csr_matrix(self._shape, dtype=np.float32) for _ in range(3)]
        self._forward: list[Tensor] = []
        self._back: list[Tensor] = []

    @property
    def entries(self) -> int:
        """Entries of a channel, the mean of the three."""
        return int(sum(one.nnz for one in self._sums)) // 3

    @property
    def bytes(self) -> int:
        """Memory of all channels, both ways."""
        return 2 * 3 * (8 * self.entries + 4 * (self._shape[0] + self._shape[1]))

    def add(self, rows: Ints, columns: Ints, weights: Floats) -> None:
        """Add entries: (n,) places, several of which may be the same, and (n, 3) weights."""
        for channel in range(3):
            more = scipy.sparse.coo_matrix((weights[:, channel], (rows, columns)), shape=self._shape).tocsr()
            self._sums[channel] = self._sums[channel] + more

    def finish(self, picture: tuple[int, int], smooth: Smooth | None) -> None:
        """Scale each row so that its sum is what the picture of all sums is without noise, and be ready to multiply."""
        sums = np.stack([np.asarray(one.sum(axis=1)).ravel() for one in self._sums], axis=1).astype(np.float32)
        ratio = np.ones_like(sums)
        if smooth is not None:
            wanted = smooth(torch.from_numpy(sums).reshape(*picture, 3)).reshape(-1, 3).numpy()
            ratio = np.where(sums > 0.0, wanted / np.maximum(sums, 1e-12), 1.0).clip(1.0 / MOST, MOST)
        for channel, one in enumerate(self._sums):
            one.data *= np.repeat(ratio[:, channel], np.diff(one.indptr))
            self._forward.append(_torch(one))
            self._back.append(_torch(one.T.tocsr()))

    def times(self, values: Tensor) -> Tensor:
        """Return the matrix times (columns, 3): (rows, 3)."""
        return torch.stack([one @ values[:, channel] for channel, one in enumerate(self._forward)], dim=1)

    def transposed_times(self, values: Tensor) -> Tensor:
        """Return the transpose times (rows, 3): (columns, 3)."""
        return torch.stack([one @ values[:, channel] for channel, one in enumerate(self._back)], dim=1)


def _torch(matrix: scipy.sparse.csr_matrix) -> Tensor:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int32)),
            torch.from_numpy(matrix.indices.astype(np.int32)),
            torch.from_numpy(matrix.data.astype(np.float32)),
            size=matrix.shape,
            check_invariants=False,
        )


class TextureTransport:
    """From a change of a base colour to the change of radiance, and back. Filled by `add`, then finished.

    Args:
        picture: height and width in pixels.
        texture: height and width in texels.
    """

    def __init__(self, picture: tuple[int, int], texture: tuple[int, int]) -> None:
        self._picture, self._texture = picture, texture
        self._cells = (-(-texture[0] // COARSE), -(-texture[1] // COARSE))
        pixels = picture[0] * picture[1]
        self._first = SparseMatrix(pixels, texture[0] * texture[1])
        self._later = SparseMatrix(pixels, self._cells[0] * self._cells[1])

    @property
    def entries(self) -> int:
        return self._first.entries + self._later.entries

    @property
    def bytes(self) -> int:
        return self._first.bytes + self._later.bytes

    def add(self, vertices: Sequence[Vertices], share: float) -> None:
        """Add a pass of paths, vertices by their place in the path; it counts as this share of the samples."""
        self._first.add(*_bilinear(vertices[0], self._texture, share))
        for one in vertices[1:]:
            self._later.add(*_nearest(one, self._cells, share))

    def finish(self, smooth: Smooth | None = None) -> None:
        """End the collecting.

        Args:
            smooth: takes the noise out of a picture. What a change of all texels by one does to the picture is one,
                and each row of the matrix is scaled to what it says; None leaves rows as they were sampled.
        """
        self._first.finish(self._picture, smooth)
        self._later.finish(self._picture, smooth)

    def __call__(self, change: Tensor) -> Tensor:
        """Return the change of radiance (H, W, 3) for a change of the base colour (h, w, 3); differentiable."""
        found: Tensor = _Product.apply(self, change)  # type: ignore[no-untyped-call]
        return found

    def times(self, change: Tensor) -> Tensor:
        """Return J times (h, w, 3), as (H, W, 3)."""
        near = self._first.times(change.reshape(-1, 3))
        far = self._later.times(self._pooled(change).reshape(-1, 3))
        return (near + far).reshape(*self._picture, 3)

    def transposed_times(self, cotangent: Tensor) -> Tensor:
        """Return the transpose of J times (H, W, 3), as (h, w, 3)."""
        flat = cotangent.reshape(-1, 3)
        near = self._first.transposed_times(flat).reshape(*self._texture, 3)
        with torch.enable_grad():
            probe = torch.zeros(*self._texture, 3, requires_grad=True)
            pooled = self._pooled(probe)
        far = self._later.transposed_times(flat).reshape(pooled.shape)
        return near + torch.autograd.grad(pooled, probe, far)[0]

    def _pooled(self, texture: Tensor) -> Tensor:
        """The mean of each cell, (ceil(h / COARSE), ceil(w / COARSE), 3)."""
        planes = texture.permute(2, 0, 1)[None]
        return functional.avg_pool2d(planes, COARSE, ceil_mode=True, count_include_pad=False)[0].permute(1, 2, 0)


class _Product(torch.autograd.Function):
    """J times a change, with its transpose as the derivative."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, transport: TextureTransport, change: Tensor) -> Tensor:
        ctx.transport = transport  # type: ignore[attr-defined]
        return transport.times(change)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, cotangent: Tensor) -> tuple[None, Tensor]:
        return None, ctx.transport.transposed_times(cotangent.contiguous())  # type: ignore[attr-defined]


def _bilinear(vertices: Vertices, texture: tuple[int, int], share: float) -> tuple[Ints, Ints, Floats]:
    """Spread entries over the four texels of a bilinear lookup that repeats at the border."""
    height, width = texture
    pixel, uv, weight = vertices.pixel.numpy(), vertices.uv.numpy(), vertices.weight.numpy() * share
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    left, low = np.floor(x), np.floor(y)
    right_share, high_share = (x - left).astype(np.float32), (y - low).astype(np.float32)
    columns, shares = [], []
    for down in (0, 1):
        for across in (0, 1):
            row = (low.astype(np.int64) + down) % height
            columns.append(row * width + (left.astype(np.int64) + across) % width)
            shares.append((right_share if across else 1.0 - right_share) * (high_share if down else 1.0 - high_share))
    weights = np.concatenate([weight * one[:, None] for one in shares])
    return np.tile(pixel, 4), np.concatenate(columns), weights


def _nearest(vertices: Vertices, cells: tuple[int, int], share: float) -> tuple[Ints, Ints, Floats]:
    """Give each entry to the cell that its vertex lies in."""
    uv = vertices.uv.numpy() % 1.0
    column = np.floor(uv[:, 0] * cells[1]).astype(np.int64).clip(0, cells[1] - 1)
    row = np.floor(uv[:, 1] * cells[0]).astype(np.int64).clip(0, cells[0] - 1)
    return vertices.pixel.numpy(), row * cells[1] + column, vertices.weight.numpy() * np.float32(share)
