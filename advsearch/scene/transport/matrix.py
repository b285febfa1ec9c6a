"""Light transport as a matrix from the texels of a base color to pixels, and renderers
that use it.

Where camera, meshes and lights stand still, the radiance of a pixel is, to first order
in the base color,

    radiance = base + J (base color - base color there)

    J: pixels x texels, one weight for each color channel

and J is sparse. A pixel sees few texels sharply: directly, in a mirror or through
glass. These are bilinear look-ups. It sees many more by scattered light, such as light
from the object to itself, for which coarse cells of `CELL_SIZE` x `CELL_SIZE` texels
are enough. Which texels a pixel sees hardly depends on the color of the light. So a row
of J is stored as fractions of texels, which add up to one, times a color. If there are
many matrices, fractions are stored in 16 bits. A matrix for a full search stores them
in 32 bits, by rows and by columns, so that a product with it is one call.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch import seeds
from advsearch.scene.assembly import IMAGE_INPUTS
from advsearch.scene.assets import Float32Array, IntArray
from advsearch.scene.mitsuba_backend.denoise import denoise
from advsearch.scene.mitsuba_backend.transport import (
    PathVertices,
    TracedPaths,
    average_passes,
)
from advsearch.scene.parts import PATTERN_SUFFIX
from advsearch.scene.predictor import MAX_BYTES, LinearMap, Predictor
from advsearch.scene.renderer import InputSpace, Renderer
from advsearch.trust.stored_files import scale_limit

# from a noisy image (H, W, 3) to one without noise
Smooth = Callable[[Tensor], Tensor]
# largest value of an image that is stored, in multiples of its mean; any exposure clips
# such values anyway
MAX_MEANS = 6e4
CELL_SIZE = 8  # width in texels of the cells for scattered light


class PackedImage:
    """An image, of any shape, stored in 16 bits per number.

    The numbers are multiples of its mean, so that the image may have any brightness.

    Args:
        image: the image.
        is_small: whether to unpack it at each call. Otherwise it is unpacked once, for
            a search that needs it in every step.
    """

    def __init__(self, image: Tensor, is_small: bool = True) -> None:
        mean = float(image.abs().mean()) if image.numel() else 0.0
        self._scale = mean if 0.0 < mean < float("inf") else 1.0
        self._values = (image / self._scale).clamp(-MAX_MEANS, MAX_MEANS).half()
        self._unpacked = None if is_small else self._values.float() * self._scale

    def __call__(self) -> Tensor:
        """Return the image in float32."""
        if self._unpacked is not None:
            return self._unpacked
        return self._values.float() * self._scale


class _PackedRows(NamedTuple):
    """A sparse matrix by rows in little memory."""

    fractions: npt.NDArray[np.float16]
    columns: npt.NDArray[np.integer[Any]]
    row_starts: npt.NDArray[np.int32]


class ColoredRows:
    """A sparse matrix (rows, columns) for three color channels.

    Instead of one matrix for each channel, it has one matrix of fractions, whose rows
    add up to one, and a color for each row. An entry of a channel's matrix is the
    fraction times that channel of the color. It is filled by `add`, and then `finish`
    is called once.

    Args:
        rows: number of rows.
        columns: number of columns.
        small: whether to store it in little memory, and to unpack it for each product:
            16 bits for a fraction, and 16 for its column if there are no more than
            65,536.

    Attributes:
        entries: number of fractions.
    """

    def __init__(self, rows: int, columns: int, small: bool) -> None:
        """Make an empty matrix.

        Args:
            rows: number of rows.
            columns: number of columns.
            small: store it in 16 bits, and unpack it for each product.
        """
        self._shape = (rows, columns)
        self._small = small
        self.entries = 0
        has_small_columns = small and columns <= 1 << 16
        self._column_type = np.dtype(np.uint16 if has_small_columns else np.int32)
        # Until `finish`: the sums of what was added. They are released then.
        self._sum = scipy.sparse.csr_matrix(self._shape, dtype=np.float32)
        self._colors: Float32Array = np.zeros((rows, 3), dtype=np.float32)
        # After `finish`: the fractions, packed if small (then there is no pair), and
        # else as a matrix and its transpose; and the colors.
        self._packed: _PackedRows | None = None
        self._csr_pair: tuple[Tensor, Tensor] | None = None
        self._stored_colors = PackedImage(torch.zeros(0))

    @property
    def bytes(self) -> int:
        """Memory after `finish`, bytes.

        A start of a row takes 4 bytes, and its color in 16 bits 6. If the matrix is
        small, an entry is a fraction in 16 bits and its column. Otherwise an entry is
        stored twice, in the matrix and its transpose, each time as a fraction of 4
        bytes and an index of 4; and the colors are also stored in float32.
        """
        n_rows, n_columns = self._shape
        if self._small:
            return (2 + self._column_type.itemsize) * self.entries + (4 + 6) * n_rows
        row_bytes = 4 + 6 + 12  # start, and color in 16 bits and in float32
        transposed_row_bytes = 4
        return (
            2 * (4 + 4) * self.entries
            + row_bytes * n_rows
            + transposed_row_bytes * n_columns
        )

    def add(
        self,
        rows: IntArray,
        columns: IntArray,
        fractions: Float32Array,
        colors: Float32Array,
    ) -> None:
        """Add samples to rows of the matrix.

        A sample distributes its color over k columns by fractions. A row adds up the
        colors of its samples. It has one set of fractions for all three channels: the
        mean of its samples' fractions. In that mean a sample counts by the brightness
        of its color, the mean of the channels' magnitudes.

        Args:
            rows: (n,) row of each sample, ascending.
            columns: (n, k) columns of each sample; some may be equal.
            fractions: (n, k) fractions of the columns.
            colors: (n, 3) color of each sample.
        """
        if not len(rows):
            return
        # A color may be negative, as a derivative; its magnitude counts.
        brightness = np.abs(colors).mean(axis=1, keepdims=True)
        added_matrix = self._make_matrix(rows, columns, fractions * brightness)
        self._sum = self._sum + added_matrix if self._sum.nnz else added_matrix
        self.entries = int(self._sum.nnz)
        for channel in range(3):
            self._colors[:, channel] += np.bincount(
                rows, colors[:, channel], minlength=self._shape[0]
            )

    def _make_matrix(
        self, rows: IntArray, columns: IntArray, values: Float32Array
    ) -> scipy.sparse.csr_matrix:
        """Return a matrix of values (n, k) at ascending rows (n,) and columns (n, k).

        Values at the same row and column are added up.
        """
        # Rows are ascending, so that the entries are in the order of compressed rows
        # already. Only the first entry of each row has to be found.
        first_samples = np.searchsorted(rows, np.arange(self._shape[0] + 1))
        first_entries = first_samples * columns.shape[1]
        # scipy takes the values, their columns, and the first entry of each row.
        matrix = scipy.sparse.csr_matrix(
            (
                values.ravel(),
                columns.ravel().astype(np.int32),
                first_entries.astype(np.int32),
            ),
            self._shape,
        )
        matrix.sum_duplicates()
        return matrix

    def finish(self, image_shape: tuple[int, int], smooth: Smooth | None) -> None:
        """Store the matrix in the form in which it is multiplied.

        The rows of fractions are scaled to add up to one. The sums that `add` has
        collected are released; nothing may be added afterwards.

        Args:
            image_shape: height and width of the image whose pixels are the rows.
            smooth: function that removes the noise from the image (H, W, 3) of all
                rows' colors; None leaves it as it is.
        """
        fractions = self._compute_fractions()  # of `_sum`, before it is released
        self._store_fractions(fractions, self._sum)
        self._sum = scipy.sparse.csr_matrix(self._shape, dtype=np.float32)
        colors = torch.from_numpy(self._colors).reshape(*image_shape, 3)
        if smooth is not None:
            colors = smooth(colors)
        self._stored_colors = PackedImage(colors, self._small)
        self._colors = np.zeros((0, 3), dtype=np.float32)

    def _compute_fractions(self) -> npt.NDArray[Any]:
        """Return the entries of the collected sum, with rows scaled to add up to 1."""
        row_sums = np.asarray(self._sum.sum(axis=1)).ravel()
        # A row without entries stays empty.
        row_scales = np.where(row_sums > 0.0, 1.0 / np.maximum(row_sums, 1e-30), 0.0)
        entries_per_row = np.diff(self._sum.indptr)
        scaled: npt.NDArray[Any] = self._sum.data * np.repeat(
            row_scales, entries_per_row
        )
        return scaled

    def _store_fractions(
        self, fractions: npt.NDArray[Any], like: scipy.sparse.csr_matrix
    ) -> None:
        """Store fractions, packed if the matrix is small, and else with the transpose.

        Args:
            fractions: values of the entries.
            like: matrix with the columns and row starts of the entries.
        """
        if self._small:
            self._packed = _PackedRows(
                fractions=fractions.astype(np.float16),
                columns=like.indices.astype(self._column_type),
                row_starts=like.indptr,
            )
            return
        matrix = scipy.sparse.csr_matrix(
            (fractions, like.indices, like.indptr), self._shape
        )
        transposed = matrix.T.tocsr()
        self._csr_pair = (to_torch_csr(matrix), to_torch_csr(transposed))

    def multiply(self, values: Tensor) -> Tensor:
        """Return the product (rows, 3) of the matrix and `values` (columns, 3)."""
        if self._csr_pair is not None:
            matrix, _transposed = self._csr_pair
            product = matrix @ values
        else:
            product = torch.from_numpy(self._unpack() @ values.numpy())
        # The rows of fractions times the colors of the rows: the full matrix.
        return product.mul_(self._stored_colors().reshape(-1, 3))

    def multiply_transposed(self, values: Tensor) -> Tensor:
        """Return the product (columns, 3) of the transpose and `values` (rows, 3)."""
        colored = values * self._stored_colors().reshape(-1, 3)
        if self._csr_pair is not None:
            _matrix, transposed = self._csr_pair
            return transposed @ colored
        return torch.from_numpy(self._unpack().T @ colored.numpy())

    def _unpack(self) -> scipy.sparse.csr_matrix:
        """Return the matrix of fractions in float32, from the 16 bits in which it is
        stored.
        """
        assert self._packed is not None, "finish it first"
        fractions, columns, row_starts = self._packed
        return scipy.sparse.csr_matrix(
            (fractions.astype(np.float32), columns.astype(np.int32), row_starts),
            self._shape,
        )


class TextureTransport:
    """Linear map from a change of a base color to the change of radiance, and back.

    It is filled by `add_pass`, and then `finish` is called once.

    Args:
        image_shape: height and width of the radiance in pixels.
        texture_shape: height and width of the base color in texels.
        small: whether to take little memory, for one of many matrices.
    """

    def __init__(
        self,
        image_shape: tuple[int, int],
        texture_shape: tuple[int, int],
        *,
        small: bool = False,
    ) -> None:
        """Make empty matrices: from texels, and from cells of `CELL_SIZE` texels.

        Args:
            image_shape: (height, width) of the image, whose pixels are the rows.
            texture_shape: (height, width) of the texture.
            small: store the finished matrices in 16 bits to save memory, and unpack
                them for each product.
        """
        self._image_shape = image_shape
        self._texture_shape = texture_shape
        # the last cells of rows and columns may have fewer texels
        self._cell_shape = (
            math.ceil(texture_shape[0] / CELL_SIZE),
            math.ceil(texture_shape[1] / CELL_SIZE),
        )
        self._texels_in_cell = _count_texels_in_cells(texture_shape, self._cell_shape)
        n_pixels = image_shape[0] * image_shape[1]
        n_texels = texture_shape[0] * texture_shape[1]
        n_cells = self._cell_shape[0] * self._cell_shape[1]
        # from texels that a pixel sees sharply; and from cells, by scattered light
        self._sharp = ColoredRows(n_pixels, n_texels, small)
        self._scattered = ColoredRows(n_pixels, n_cells, small)

    @property
    def n_entries(self) -> int:
        """Number of entries of both matrices."""
        return self._sharp.entries + self._scattered.entries

    @property
    def n_bytes(self) -> int:
        """Memory of both matrices when they are finished."""
        return self._sharp.bytes + self._scattered.bytes

    def add_pass(self, vertices: Sequence[PathVertices], pass_weight: float) -> None:
        """Add the vertices of one pass of paths to both matrices.

        A vertex that a pixel sees sharply counts for the four texels of a bilinear
        look-up. Any other vertex, which a pixel sees only by scattered light, counts
        for the cell that it lies in.

        Args:
            vertices: the first vertices of all paths, then the second ones, and so on.
            pass_weight: weight of this pass in the mean over all passes.
        """
        for vertex in vertices:
            self._add_sharp(vertex.select(vertex.is_sharp), pass_weight)
            self._add_scattered(vertex.select(~vertex.is_sharp), pass_weight)

    def _add_sharp(self, sharp: PathVertices, pass_weight: float) -> None:
        """Add vertices that pixels see sharply, with the weight of their pass."""
        texels, fractions = find_bilinear_weights(sharp.uv.numpy(), self._texture_shape)
        self._sharp.add(
            sharp.pixel.numpy(),
            texels.astype(np.int64),
            fractions,
            colors=sharp.weight.numpy() * np.float32(pass_weight),
        )

    def _add_scattered(self, scattered: PathVertices, pass_weight: float) -> None:
        """Add vertices that pixels see by scattered light, with their pass's weight."""
        n_rows, n_columns = self._cell_shape
        uv = scattered.uv.numpy() % 1.0  # the texture repeats
        # Rounding may make a coordinate 1, whose cell would be outside.
        column = np.floor(uv[:, 0] * n_columns).astype(np.int64)
        column = column.clip(0, n_columns - 1)
        row = np.floor(uv[:, 1] * n_rows).astype(np.int64).clip(0, n_rows - 1)
        cell = (row * n_columns + column)[:, None]  # (n, 1): one for each vertex
        self._scattered.add(
            scattered.pixel.numpy(),
            cell,
            np.ones_like(cell, dtype=np.float32),
            colors=scattered.weight.numpy() * np.float32(pass_weight),
        )

    def finish(self, smooth: Smooth | None = None) -> None:
        """Store both matrices for products; nothing may be added afterwards.

        Args:
            smooth: function that removes the noise from the colors of a matrix's rows.
                The color of a row is the change of its pixel if all texels change by
                one, so that the colors are an image. None leaves the noise in them.
        """
        self._sharp.finish(self._image_shape, smooth)
        self._scattered.finish(self._image_shape, smooth)

    def __call__(self, change: Tensor) -> Tensor:
        """Return the change of radiance (H, W, 3) for one of the base color (h, w, 3).

        Differentiable: the transposed product is the derivative.
        """
        radiance: Tensor = LinearMap.apply(
            self.multiply, self.multiply_transposed, change
        )  # type: ignore[no-untyped-call]
        return radiance

    def multiply(self, change: Tensor) -> Tensor:
        """Return the change of radiance (H, W, 3) for one of the base color (h, w, 3).

        What a pixel sees sharply changes by texels, scattered light by the means of
        cells.
        """
        sharp_change = self._sharp.multiply(change.reshape(-1, 3))
        cell_means = self._average_cells(change)
        scattered_change = self._scattered.multiply(cell_means.reshape(-1, 3))
        radiance = sharp_change.add_(scattered_change)
        return radiance.reshape(*self._image_shape, 3)

    def _average_cells(self, values: Tensor) -> Tensor:
        """Return the mean of the texels in each cell.

        Args:
            values: (h, w, 3) values of the texels.

        Returns:
            (rows, columns, 3) one mean for each cell.
        """
        n_rows, n_columns = self._cell_shape
        # The last cells may have fewer texels: they are filled up with zeros, which add
        # nothing to the sum.
        bottom = CELL_SIZE * n_rows - self._texture_shape[0]
        right = CELL_SIZE * n_columns - self._texture_shape[1]
        padded = values
        if right or bottom:
            padded = functional.pad(values, (0, 0, 0, right, 0, bottom))
        row_sums = padded.reshape(n_rows * CELL_SIZE, n_columns, CELL_SIZE, 3).sum(
            dim=2
        )
        cell_sums = row_sums.reshape(n_rows, CELL_SIZE, n_columns, 3).sum(dim=1)
        return cell_sums / self._texels_in_cell

    def multiply_transposed(self, cotangent: Tensor) -> Tensor:
        """Return the product (h, w, 3) of the transposed matrices and a cotangent.

        The cotangent (H, W, 3) is the derivative of a loss by the radiance of each
        pixel, and the product is that by each texel of the base color. What a cell gets
        is spread evenly over its texels, since the cell's value is their mean.
        """
        pixel_cotangent = cotangent.reshape(-1, 3)
        texel_values = self._sharp.multiply_transposed(pixel_cotangent).reshape(
            *self._texture_shape, 3
        )
        cell_values = self._scattered.multiply_transposed(pixel_cotangent).reshape(
            *self._cell_shape, 3
        )
        return texel_values + self._spread_cells(cell_values / self._texels_in_cell)

    def _spread_cells(self, cell_values: Tensor) -> Tensor:
        """Return the value of each cell (rows, columns, 3) in its texels, (h, w, 3)."""
        spread_cells = cell_values[:, None, :, None].expand(
            -1, CELL_SIZE, -1, CELL_SIZE, -1
        )
        spread_cells = spread_cells.reshape(self._cell_shape[0] * CELL_SIZE, -1, 3)
        # The last cells may reach beyond the texture: that part is cut off.
        n_rows, n_columns = self._texture_shape
        return spread_cells[:n_rows, :n_columns]


def _compute_cell_sizes(n_texels: int, n_cells: int) -> Tensor:
    """Return how many texels each cell has along one axis; the last may have fewer."""
    first_texels = CELL_SIZE * torch.arange(n_cells)
    return (n_texels - first_texels).clamp(max=CELL_SIZE).float()


def _count_texels_in_cells(
    texture_shape: tuple[int, int], cell_shape: tuple[int, int]
) -> Tensor:
    """Return the number of texels of each cell, (rows, columns, 1)."""
    cell_heights = _compute_cell_sizes(texture_shape[0], cell_shape[0])
    cell_widths = _compute_cell_sizes(texture_shape[1], cell_shape[1])
    return (cell_heights[:, None] * cell_widths[None, :])[:, :, None]


def to_torch_csr(matrix: scipy.sparse.csr_matrix) -> Tensor:
    """Convert a sparse matrix to torch, whose products are twice as fast as scipy's."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr),
            torch.from_numpy(matrix.indices),
            torch.from_numpy(matrix.data),
            matrix.shape,
            check_invariants=False,
        )


def find_bilinear_weights(
    uv: Float32Array, texture: tuple[int, int]
) -> tuple[npt.NDArray[np.int32], Float32Array]:
    """Return the four texels of each bilinear look-up, and their fractions.

    The center of the first texel is half a texel from the border, and the texture
    repeats across the border.

    Args:
        uv: (n, 2) texture coordinates.
        texture: height and width in texels.

    Returns:
        (n, 4) indices in the flat texture, and (n, 4) fractions.
    """
    height, width = texture
    columns, column_fractions = _find_linear_weights(uv[:, 0] * width - 0.5, width)
    rows, row_fractions = _find_linear_weights(uv[:, 1] * height - 0.5, height)
    texels = [row * width + column for row in rows for column in columns]
    weights = [
        row_fraction * column_fraction
        for row_fraction in row_fractions
        for column_fraction in column_fractions
    ]
    return np.stack(texels, axis=1), np.stack(weights, axis=1)


def _find_linear_weights(
    position: Float32Array, count: int
) -> tuple[list[npt.NDArray[np.int32]], list[Float32Array]]:
    """Return the two neighbours of positions (n,) among `count`, and their fractions.

    After the last one comes the first again.
    """
    lower = np.floor(position).astype(np.int32)
    fraction = (position - np.floor(position)).astype(np.float32)
    return [lower % count, (lower + 1) % count], [1.0 - fraction, fraction]


COLLECTED_SPP = 128
"""Samples per pixel of the paths that make the matrix and the base image.

The noise that the denoiser leaves in the base image is in all predicted images.
"""
# samples of all pixels in one pass, whose vertices are in memory at the same time
SAMPLES_PER_PASS = 2**20
# largest factor by which the ratio of the denoised to the noisy base image corrects the
# color of a row
MAX_CORRECTION = 4.0
TOO_LARGE = "the matrix would take more than"
LINEAR_SUFFIXES = (".base_color", PATTERN_SUFFIX)
"""Suffixes of the names of inputs to which radiance is linear.

Radiance is linear in them except for light that meets a base color twice.
"""

Inputs = Mapping[str, Tensor]
OptionalNames = Collection[str] | None
# called with samples per pixel as they are traced
ProgressCallback = Callable[[int], None]


def ignore_progress(samples: int) -> None:
    """Ignore progress: the default of what is called with samples per pixel."""


class TransportTooLargeError(Exception):
    """A matrix would take more memory than `MAX_BYTES`."""


@dataclass(frozen=True, eq=False)
class LinearizedScene:
    """Base image and matrices of a `LinearRenderer`.

    It can be sent to another process.
    """

    transport_by_input: Mapping[str, TextureTransport]  # finished matrices by input
    # values of the inputs with a matrix, at which the image is linearized
    linearized_at: dict[str, Tensor]
    image_inputs: Inputs  # inputs of the finished image, not of the scene
    # linear radiance at `linearized_at`; with a backdrop also coverage
    base_image: PackedImage
    n_non_finite: int = 0  # how many values were not finite


class LinearRenderer(Predictor):
    """Predict images by a matrix for each base color, linearized at a configuration.

    Args:
        traced: renderer of the scene.
        u: (d,) configuration at which the image is linearized.
        seed: seed of the noise.
        tick: called with the samples per pixel of each pass as it is done; they add up
            to `count_samples`.
        spp: samples per pixel.
        quick: whether to remove the noise of the matrices as that of the base image,
            which they resemble, and not by the denoiser; and to store them in 16 bits.
        names: inputs that get a matrix; None for all base colors that the space sets.
            If it is empty, there is only the base image.
        light: scene inputs that replace those of u.
        collected: result of another renderer with the same arguments; then nothing is
            traced.

    Attributes:
        linearized_at: values of the inputs with a matrix, at which the image is
            linearized, by name.
        n_non_finite: how many numbers were not finite, and were replaced by 0.

    Raises:
        TransportTooLargeError: the matrices would take more than `MAX_BYTES`.
    """

    def __init__(
        self,
        traced: Renderer,
        u: Tensor,
        seed: int,
        tick: ProgressCallback = ignore_progress,
        *,
        spp: int = COLLECTED_SPP,
        quick: bool = False,
        names: OptionalNames = None,
        light: Inputs = MappingProxyType({}),
        collected: LinearizedScene | None = None,
    ) -> None:
        """Trace the base image and the matrices, unless they were collected elsewhere.

        Args:
            traced: renderer of the scene.
            u: (d,) configuration at which the image is linearized.
            seed: seed of the noise.
            tick: called with the samples per pixel of each pass as it is done.
            spp: samples per pixel.
            quick: denoise the matrices by a cheaper method, and store them in 16 bits.
            names: inputs that get a matrix; None for all base colors.
            light: scene inputs that replace those of u.
            collected: result of another renderer with the same arguments.
        """
        super().__init__(traced)
        if collected is None:
            with torch.no_grad():
                collected = _collect(
                    renderer=traced.copy_with(),
                    u=u,
                    seed=seed,
                    tick=tick,
                    spp=spp,
                    quick=quick,
                    names=names,
                    light=light,
                )
        self.collected = collected
        self.n_non_finite = collected.n_non_finite
        self.linearized_at = collected.linearized_at

    @property
    def n_entries(self) -> int:
        """Number of entries of all matrices."""
        transports = self.collected.transport_by_input.values()
        return sum(transport.n_entries for transport in transports)

    @property
    def n_bytes(self) -> int:
        """Memory of all matrices and the base image, 8 bytes a pixel."""
        height, width = self.path_renderer.formation.resolution
        transports = self.collected.transport_by_input.values()
        return sum(transport.n_bytes for transport in transports) + 8 * height * width

    def release_scene(self, space: InputSpace) -> None:
        """Release the scene, which only tracing needs. Predictions stay possible.

        Args:
            space: copy of the space that does not refer to the scene.
        """
        # The scene is removed from a copy: other objects may use the same renderer.
        self.path_renderer = self.path_renderer.copy_with()
        del self.path_renderer.scene
        self.path_renderer.space = space

    def predict_radiance(self, inputs: Inputs) -> Tensor:
        """Return the radiance (H, W, 3) of scene inputs; with a backdrop more channels.

        It is the base image plus the change by each base color: its matrix times its
        difference from the value at which the image was linearized. The channels after
        the first three, such as coverage, stay as they are.

        Args:
            inputs: scene inputs; only those that have a matrix count.
        """
        base = self.collected.base_image()
        radiance = base[..., :3]
        crop = self.path_renderer.crop
        for name, transport in self.collected.transport_by_input.items():
            color_change = inputs[name] - self.linearized_at[name]
            change = transport(color_change)  # the product with the matrix
            if crop is not None:
                # The matrix covers the window of the crop, the base the full image.
                change = crop.window.pad(change, (base.shape[0], base.shape[1]))
            radiance = radiance + change
        further_channels = base[..., 3:]
        if further_channels.shape[-1] == 0:
            return radiance
        return torch.cat([radiance, further_channels], dim=-1)

    def predict_image(self, inputs: Inputs, u: Tensor) -> Tensor:
        """Return the image (H, W, 3) sRGB of scene inputs.

        Only inputs to which radiance is linear count; what controls do to the finished
        image comes from `u`.
        """
        return self.path_renderer.finish_image(
            self.predict_radiance(inputs), self.collected.image_inputs, u
        )


def _collect(
    renderer: Renderer,
    u: Tensor,
    seed: int,
    tick: ProgressCallback,
    spp: int,
    quick: bool,
    names: OptionalNames,
    light: Inputs,
) -> LinearizedScene:
    """Trace the base image and the matrices of a `LinearRenderer`.

    If no input gets a matrix, the base image is an ordinary render. Otherwise it is the
    mean of the paths that fill the matrices. With a backdrop, radiance leaves out the
    background, and coverage is its fourth channel.

    Args:
        renderer: renderer of the scene; it counts what is traced.
        u: (d,) configuration at which the image is linearized.
        seed: seed of the noise.
        tick: called with the samples per pixel of each pass as it is done.
        spp: samples per pixel.
        quick: denoise the matrices by a cheaper method, and store them in 16 bits.
        names: inputs that get a matrix; None for all base colors.
        light: scene inputs that replace those of u.
    """
    # The renderer counts the values of all calls; those of this call are the increase.
    non_finite_before = renderer.n_non_finite
    image_inputs, scene_inputs = _assemble_inputs(renderer, u, light)
    linearized_at = _copy_linear_inputs(renderer, scene_inputs, names)
    transports = _make_transports(_get_traced_size(renderer), linearized_at, quick)
    has_backdrop = "backdrop.color" in image_inputs
    if transports:
        base = _trace_matrices(
            renderer,
            transports,
            scene_inputs,
            seed=seed,
            tick=tick,
            spp=spp,
            quick=quick,
            has_backdrop=has_backdrop,
        )
    else:
        base = renderer.render_radiance(scene_inputs, seed, spp, has_backdrop)
        tick(spp)
    return LinearizedScene(
        transport_by_input=transports,
        linearized_at=linearized_at,
        image_inputs=image_inputs,
        base_image=PackedImage(base, is_small=quick),
        n_non_finite=renderer.n_non_finite - non_finite_before,
    )


def _assemble_inputs(
    renderer: Renderer, u: Tensor, light: Inputs
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the inputs of the finished image, and those of the scene.

    They are those of a configuration (d,), but `light` replaces inputs of the scene.
    """
    # This also replaces the depth of a photograph by what is in front of the object.
    inputs = renderer.replace_photograph_depth(
        renderer.scene.input_assembler(renderer.space.inputs(u))
    )
    image_inputs = {
        name: value for name, value in inputs.items() if name in IMAGE_INPUTS
    }
    scene_inputs = {
        name: value for name, value in inputs.items() if name not in IMAGE_INPUTS
    }
    return image_inputs, scene_inputs | dict(light)


def _copy_linear_inputs(
    renderer: Renderer, scene_inputs: Inputs, names: OptionalNames
) -> dict[str, Tensor]:
    """Return copies of the scene inputs that get a matrix; None for all base colors."""
    if names is None:
        names = find_linear_inputs(renderer)
    return {
        name: value.clone() for name, value in scene_inputs.items() if name in names
    }


def _make_transports(
    size: tuple[int, int], linearized_at: Inputs, quick: bool
) -> dict[str, TextureTransport]:
    """Return an empty matrix for each input, by its name.

    Args:
        size: height and width of the traced image.
        linearized_at: values of the inputs.
        quick: whether to store the matrices in 16 bits.
    """
    return {
        name: TextureTransport(size, (value.shape[0], value.shape[1]), small=quick)
        for name, value in linearized_at.items()
    }


def _trace_matrices(
    renderer: Renderer,
    transports: Mapping[str, TextureTransport],
    scene_inputs: Inputs,
    *,
    seed: int,
    tick: ProgressCallback,
    spp: int,
    quick: bool,
    has_backdrop: bool,
) -> Tensor:
    """Fill and finish empty matrices, and return the base image of the same paths.

    A renderer with a crop traces only the crop's window. The result is pasted into the
    crop's image of the surroundings.

    Args:
        renderer: renderer of the scene.
        transports: an empty matrix for each input; they are filled and finished.
        scene_inputs: inputs of the scene, without those of the finished image.
        seed: seed of the noise.
        tick: called with the samples per pixel of each pass as it is done.
        spp: samples per pixel of each matrix.
        quick: denoise the matrices by a cheaper method.
        has_backdrop: whether the camera sees a photograph or a plain color instead of
            the environment.

    Returns:
        (H, W, 3) linear radiance; with a backdrop also coverage and, if a plane in the
        scene receives the shadow, the change of its radiance.
    """
    with renderer.scene.limit_window(renderer.window):
        paths = _fill_transports(renderer, transports, scene_inputs, seed, tick, spp)
    base = _finish_transports(
        renderer, transports.values(), paths, quick=quick, has_backdrop=has_backdrop
    )
    if has_backdrop:
        base = _append_plane_change(renderer, base, scene_inputs, seed, spp)
    if renderer.crop is not None:
        base = renderer.crop.window.paste(base, renderer.crop.surrounding_image)
    return base


def _finish_transports(
    renderer: Renderer,
    transports: Collection[TextureTransport],
    paths: TracedPaths,
    *,
    quick: bool,
    has_backdrop: bool,
) -> Tensor:
    """Denoise and finish filled matrices, and return the denoised image of their paths.

    Args:
        renderer: renderer of the scene.
        transports: the matrices.
        paths: mean of the images of all paths that filled them.
        quick: denoise the matrices by a cheaper method.
        has_backdrop: whether the image leaves out the environment.

    Returns:
        (H, W, 3) linear radiance; with a backdrop, coverage is a fourth channel.
    """
    radiance = _compute_noisy_radiance(renderer, paths, has_backdrop)
    base, smooth = _denoise_base(renderer, radiance, paths, quick)
    for transport in transports:
        transport.finish(smooth)
    if has_backdrop:
        base = torch.cat([base, paths.coverage], dim=-1)
    return base


def _compute_noisy_radiance(
    renderer: Renderer, paths: TracedPaths, has_backdrop: bool
) -> Tensor:
    """Return the mean radiance (H, W, 3) of paths, finite and with its noise.

    With a backdrop the environment behind the object is subtracted. It is subtracted
    before denoising, which would mix it with the object at its outline.
    """
    radiance = paths.radiance
    if has_backdrop:
        radiance = radiance - paths.background
    return renderer.replace_non_finite(radiance)


def _append_plane_change(
    renderer: Renderer, base: Tensor, scene_inputs: Inputs, seed: int, spp: int
) -> Tensor:
    """Append to a base image the change of the plane that receives the shadow.

    The channels are rendered once, and base colors do not change them. If the scene has
    no such plane, the image is returned as it is.

    Args:
        renderer: renderer of the scene.
        base: (H, W, 4) radiance and coverage; with a crop, of its window.
        scene_inputs: inputs of the scene, without those of the finished image.
        seed: seed of the noise.
        spp: samples per pixel.
    """
    if renderer.scene.plane_radiance is None:
        return base
    image = renderer.render_radiance(scene_inputs, seed, spp, hide_environment=True)
    if renderer.crop is not None:
        image = renderer.crop.window.crop_image(image)
    # The first channels are radiance and coverage, which `base` has already.
    plane_channels = image[..., 4:]
    return torch.cat([base, plane_channels], dim=-1)


def _fill_transports(
    renderer: Renderer,
    transports: Mapping[str, TextureTransport],
    scene_inputs: Inputs,
    seed: int,
    tick: ProgressCallback,
    spp: int,
) -> TracedPaths:
    """Trace paths for each matrix and add them; return the mean images of all.

    The paths of one matrix collect weights at the vertices on its texture. But for
    that, and for the noise, all paths are the same: samples of the same image.

    The vertices of a pass are released when they are added, so that memory holds one
    pass at a time. `tick` is called with the samples per pixel of each pass.

    Raises:
        TransportTooLargeError: all matrices together take more than `MAX_BYTES`.
    """
    samples_per_pass, n_passes = plan_passes(renderer, spp)
    images: list[TracedPaths] = []
    for name, transport in transports.items():
        for index in range(n_passes):
            noise_seed = seeds.derive_seed(seed, f"transport {name}", index)
            paths = renderer.scene.collect_paths(
                scene_inputs, name, noise_seed, samples_per_pass
            )
            transport.add_pass(paths.vertices, pass_weight=1.0 / n_passes)
            _check_memory(transports.values(), _get_traced_size(renderer))
            images.append(replace(paths, vertices=[]))
            tick(samples_per_pass)
    return average_passes(images)


def _check_memory(
    transports: Collection[TextureTransport], image_shape: tuple[int, int]
) -> None:
    """Raise TransportTooLargeError if matrices and base image are over `MAX_BYTES`."""
    height, width = image_shape
    base_image_bytes = 2 * 4 * height * width  # up to four channels of 16 bits
    matrix_bytes = sum(transport.n_bytes for transport in transports)
    if matrix_bytes + base_image_bytes > scale_limit(MAX_BYTES):
        raise TransportTooLargeError(
            f"{TOO_LARGE} {scale_limit(MAX_BYTES) / 2**30:g} GiB"
        )


def _denoise_base(
    renderer: Renderer, radiance: Tensor, paths: TracedPaths, quick: bool
) -> tuple[Tensor, Smooth | None]:
    """Denoise the base image; also return the function that denoises a matrix's colors.

    The function takes and returns an image (H, W, 3). Without a denoiser the base image
    is returned as it is, and None.

    Args:
        renderer: renderer of the scene.
        radiance: (H, W, 3) base image with its noise.
        paths: images of the same paths, with the guides of the denoiser.
        quick: whether the function only multiplies by a ratio: the denoised base image
            over the noisy one, from 1 / `MAX_CORRECTION` to `MAX_CORRECTION`. Otherwise
            it runs the denoiser, guided by normals and by the outlines of surfaces.
    """
    if renderer.formation.denoiser != "oidn":
        return radiance, None
    clean = denoise(radiance, paths.albedo.clamp(0.0, 1.0), paths.normal)
    if quick:
        return clean, partial(_scale_colors, _compute_correction(clean, radiance))
    # The denoiser retains the edges of its guides, one of which is usually the base
    # color. The pattern of the base color is not in the colors of a matrix. So here the
    # guide is the same on all surfaces: 1.
    is_surface = paths.albedo.sum(dim=-1, keepdim=True) > 0.0
    even_albedo = is_surface.to(torch.float32).expand(-1, -1, 3).contiguous()
    return clean, partial(_denoise_colors, even_albedo, paths.normal)


def _compute_correction(clean: Tensor, noisy: Tensor) -> Tensor:
    """Return the ratio (H, W, 3) of a denoised base image to the noisy one, clamped.

    The paths of a matrix are those of the base image, so that both have about the same
    noise: this ratio removes it from the matrix too.
    """
    ratio = clean / noisy.clamp_min(1e-12)
    return ratio.clamp(1.0 / MAX_CORRECTION, MAX_CORRECTION)


def _scale_colors(ratio: Tensor, image: Tensor) -> Tensor:
    """Remove the noise from the colors (H, W, 3) of a matrix, by a ratio (H, W, 3)."""
    return image * ratio


def _denoise_colors(albedo: Tensor, normal: Tensor, image: Tensor) -> Tensor:
    """Remove the noise from the colors (H, W, 3) of a matrix, by guides (H, W, 3)."""
    return denoise(image.contiguous(), albedo, normal)


def find_linear_inputs(renderer: Renderer) -> frozenset[str]:
    """Return the names of a scene's inputs to which radiance is linear."""
    return frozenset(
        name for name in renderer.scene.input_names if name.endswith(LINEAR_SUFFIXES)
    )


def _get_traced_size(renderer: Renderer) -> tuple[int, int]:
    """Return height and width of the traced part of an image, in pixels."""
    if renderer.crop is None:
        return renderer.formation.resolution
    return renderer.crop.window.height, renderer.crop.window.width


def plan_passes(renderer: Renderer, spp: int) -> tuple[int, int]:
    """Return the samples per pixel of a pass, and the number of passes."""
    height, width = _get_traced_size(renderer)
    samples = max(1, min(spp, SAMPLES_PER_PASS // (height * width)))
    return samples, math.ceil(spp / samples)
