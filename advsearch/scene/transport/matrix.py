"""Light transport as a matrix from the texels of a base color to pixels, and renderers
that use it.

Where camera, meshes and lights stand still, the radiance of a pixel is, to first order
in the base color,

    radiance = base + J (base color - base color there)

    J: pixels x texels, one weight for each color channel

and J is sparse: a pixel sees few texels directly, in a mirror or through glass
(bilinear look-ups), and many a little (light from the object to the object), for which
coarse cells of `CELL_SIZE` x `CELL_SIZE` texels are enough. What a pixel sees of the
texels hardly depends on the color of the light, so that a row of J is stored as
fractions of texels, which add up to one, times a color. A matrix that is one of many
stores its fractions in 16 bits; one that serves a full search stores them in 32, by
rows and by columns, so that a product with it is one call.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
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
from advsearch.scene.mitsuba_backend.transport import Paths, Vertices, average_passes
from advsearch.scene.parts import PATTERN_SUFFIX
from advsearch.scene.predictor import MAX_BYTES, LinearMap, Predictor
from advsearch.scene.renderer import InputSpace, Renderer
from advsearch.trust.stored_files import scale_limit

# from a noisy image (H, W, 3) to one without noise
Smooth = Callable[[Tensor], Tensor]
# multiples of its mean at which an image is clipped; any exposure has clipped them long
# before
MAX_MEANS = 6e4
CELL_SIZE = 8  # width of the cells of later vertices, in texels


class PackedImage:
    """An image, of any shape, stored in 16 bits per number.

    The numbers are multiples of its mean, so that the image may have any brightness.

    Args:
        image: the image.
        is_small: unpack it at each call; otherwise it is unpacked once, for a search
            that needs it in every step.
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

    Its rows are fractions that add up to one, times a color. It is filled by `add`, and
    then `finish` is called once.

    Args:
        rows, columns: its size.
        small: store it in 16 bits per fraction, and as many per column where there are
            no more than 65,536, and unpack it for each product.

    Attributes:
        entries: how many fractions are stored.
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
        # the matrix of fractions and its transpose, after `finish`, if not small
        self._csr_pair: tuple[Tensor, Tensor] | None = None
        # the sum of all that was added, before `finish`
        self._sum = scipy.sparse.csr_matrix(self._shape, dtype=np.float32)
        self._packed: _PackedRows | None = None
        has_small_columns = small and columns <= 1 << 16
        self._column_type = np.dtype(np.uint16 if has_small_columns else np.int32)
        self._colors: Float32Array = np.zeros((rows, 3), dtype=np.float32)
        self._stored_colors = PackedImage(torch.zeros(0))

    @property
    def bytes(self) -> int:
        """Memory after `finish`.

        Packed, an entry has a fraction (2 bytes) and its column, a row its start (4)
        and color (6). If it is not small, the unpacked matrix and its transpose are
        stored as well: 10 bytes more for each entry, float32 colors (12), and the
        starts of the transpose's rows (4).
        """
        n_rows, n_columns = self._shape
        packed = (2 + self._column_type.itemsize) * self.entries + (4 + 6) * n_rows
        if self._small:
            return packed
        return packed + 10 * self.entries + 12 * n_rows + 4 * n_columns

    def add(
        self,
        rows: IntArray,
        columns: IntArray,
        fractions: Float32Array,
        weights: Float32Array,
    ) -> None:
        """Add samples to rows of the matrix.

        A sample distributes its color over k columns by fractions. A row stores the sum
        of its samples' colors, and one set of fractions for all three channels: the
        mean of the samples' fractions, each weighted by the mean of its color's
        channels.

        Args:
            rows: (n,) row of each sample, ascending.
            columns: (n, k) columns of each sample; several may be the same.
            fractions: (n, k) fractions of the columns.
            weights: (n, 3) color of each sample.
        """
        if not len(rows):
            return
        # Rows are ascending, so that the entries are in the order of compressed rows
        # already. The matrix is made of where the entries of each row begin.
        first_samples = np.searchsorted(rows, np.arange(self._shape[0] + 1))
        first_entries = first_samples * columns.shape[1]
        entry_weights = (
            fractions * np.abs(weights).mean(axis=1, keepdims=True)
        ).ravel()
        added_matrix = scipy.sparse.csr_matrix(
            (
                entry_weights,
                columns.ravel().astype(np.int32),
                first_entries.astype(np.int32),
            ),
            self._shape,
        )
        added_matrix.sum_duplicates()
        self._sum = self._sum + added_matrix if self._sum.nnz else added_matrix
        self.entries = int(self._sum.nnz)
        for channel in range(3):
            self._colors[:, channel] += np.bincount(
                rows, weights[:, channel], minlength=self._shape[0]
            )

    def finish(self, image_shape: tuple[int, int], smooth: Smooth | None) -> None:
        """Get ready to multiply: scale rows to add up to one, and store them.

        What `add` has collected is released; nothing may be added afterwards.

        Args:
            image_shape: height and width of the image whose pixels are the rows.
            smooth: removes the noise from the image (H, W, 3) of all rows' colors;
                None leaves it as it is.
        """
        row_sums = np.asarray(self._sum.sum(axis=1)).ravel()
        # a row without entries stays empty
        row_scales = np.where(row_sums > 0.0, 1.0 / np.maximum(row_sums, 1e-30), 0.0)
        entries_per_row = np.diff(self._sum.indptr)
        fractions = self._sum.data * np.repeat(row_scales, entries_per_row)
        if self._small:  # in 16 bits, unpacked for each product
            self._packed = _PackedRows(
                fractions.astype(np.float16),
                self._sum.indices.astype(self._column_type),
                self._sum.indptr,
            )
        else:  # ready, with its transpose
            matrix = scipy.sparse.csr_matrix(
                (fractions, self._sum.indices, self._sum.indptr), self._shape
            )
            self._csr_pair = to_torch_csr(matrix), to_torch_csr(matrix.T.tocsr())
        self._sum = scipy.sparse.csr_matrix(self._shape, dtype=np.float32)
        colors = torch.from_numpy(self._colors).reshape(*image_shape, 3)
        if smooth is not None:
            colors = smooth(colors)
        self._stored_colors = PackedImage(colors, self._small)
        self._colors = np.zeros((0, 3), dtype=np.float32)

    def multiply(self, values: Tensor) -> Tensor:
        """Return the matrix times (columns, 3): (rows, 3)."""
        if self._csr_pair is not None:
            product = self._csr_pair[0] @ values
        else:
            product = torch.from_numpy(self._unpack() @ values.numpy())
        return product.mul_(self._stored_colors().reshape(-1, 3))

    def multiply_transposed(self, values: Tensor) -> Tensor:
        """Return the transposed matrix times (rows, 3): (columns, 3)."""
        colored = values * self._stored_colors().reshape(-1, 3)
        if self._csr_pair is not None:
            return self._csr_pair[1] @ colored
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
        small: take as little memory as there is room for one of many matrices.
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
        cell_heights = _compute_cell_sizes(texture_shape[0], self._cell_shape[0])
        cell_widths = _compute_cell_sizes(texture_shape[1], self._cell_shape[1])
        self._texels_in_cell = (cell_heights[:, None] * cell_widths[None, :])[
            :, :, None
        ]
        n_pixels = image_shape[0] * image_shape[1]
        n_texels = texture_shape[0] * texture_shape[1]
        n_cells = self._cell_shape[0] * self._cell_shape[1]
        # from texels that a pixel sees sharply; and from cells, by scattered light
        self._sharp = ColoredRows(n_pixels, n_texels, small)
        self._scattered = ColoredRows(n_pixels, n_cells, small)

    @property
    def entries(self) -> int:
        """Number of entries of both matrices."""
        return self._sharp.entries + self._scattered.entries

    @property
    def bytes(self) -> int:
        """Memory of both matrices when they are finished."""
        return self._sharp.bytes + self._scattered.bytes

    def add_pass(self, vertices: Sequence[Vertices], fraction: float) -> None:
        """Add the vertices of one pass of paths to both matrices.

        A vertex that a pixel sees sharply counts for the four texels of a bilinear
        look-up. Any other vertex, which a pixel sees only by scattered light, counts
        for the cell that it lies in.

        Args:
            vertices: the first vertices of all paths, then the second ones, and so on.
            fraction: fraction of all samples that this pass has.
        """
        n_rows, n_columns = self._cell_shape
        for vertex in vertices:
            sharp = vertex.select(vertex.is_sharp)
            texels, fractions = find_bilinear_weights(
                sharp.uv.numpy(), self._texture_shape
            )
            self._sharp.add(
                sharp.pixel.numpy(),
                texels.astype(np.int64),
                fractions,
                sharp.weight.numpy() * np.float32(fraction),
            )
            scattered = vertex.select(~vertex.is_sharp)
            uv = scattered.uv.numpy() % 1.0  # the texture repeats
            column = np.floor(uv[:, 0] * n_columns).astype(np.int64)
            row = np.floor(uv[:, 1] * n_rows).astype(np.int64)
            cell = row.clip(0, n_rows - 1) * n_columns + column.clip(0, n_columns - 1)
            cell = cell[:, None]  # (n, 1): one for each vertex, of weight 1
            self._scattered.add(
                scattered.pixel.numpy(),
                cell,
                np.ones_like(cell, dtype=np.float32),
                scattered.weight.numpy() * np.float32(fraction),
            )

    def finish(self, smooth: Smooth | None = None) -> None:
        """Get both matrices ready to multiply; nothing may be added afterwards.

        Args:
            smooth: removes the noise from the colors of a matrix's rows, which are an
                image: the change of the image when all texels change by one. None
                leaves the noise in them.
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
        cell_values = cell_values / self._texels_in_cell
        # each cell's value in all of its texels
        spread_cells = cell_values[:, None, :, None].expand(
            -1, CELL_SIZE, -1, CELL_SIZE, -1
        )
        spread_cells = spread_cells.reshape(self._cell_shape[0] * CELL_SIZE, -1, 3)
        # The last cells may reach beyond the texture: that part is cut off.
        n_rows, n_columns = self._texture_shape
        return texel_values + spread_cells[:n_rows, :n_columns]


def _compute_cell_sizes(n_texels: int, n_cells: int) -> Tensor:
    """Return how many texels each cell has along one axis; the last may have fewer."""
    first_texels = CELL_SIZE * torch.arange(n_cells)
    return (n_texels - first_texels).clamp(max=CELL_SIZE).float()


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
SAMPLES_PER_PASS = (
    2**20
)  # samples of all pixels in one pass; its vertices are held in memory
MAX_CORRECTION = (
    4.0  # largest factor by which the noise of the base image corrects a row
)
TOO_LARGE = "the matrix would take more than"
LINEAR_SUFFIXES = (".base_color", PATTERN_SUFFIX)
"""Ends of names of inputs to which radiance is linear.

That is but for light that meets a base color twice.
"""

Inputs = Mapping[str, Tensor]
OptionalNames = Collection[str] | None
ProgressCallback = Callable[
    [int], None
]  # called with samples per pixel as they are traced


def ignore_progress(samples: int) -> None:
    """Ignore progress: the default of what is called with samples per pixel."""


class TransportTooLargeError(Exception):
    """A matrix that takes more memory than it may."""


@dataclass(frozen=True, eq=False)
class LinearizedScene:
    """What a `LinearRenderer` has collected; it can be sent to another process."""

    transports: Mapping[str, TextureTransport]  # transports by input, finished
    linearized_at: dict[str, Tensor]  # the inputs where it was linearised
    image_inputs: Inputs  # those that belong to the finished image, not to the scene
    # the image there, linear radiance, and coverage where there is a backdrop
    base_image: PackedImage
    non_finite: int = 0  # values that were not finite


class LinearRenderer(Predictor):
    """Predict images by a matrix for each base color, linearised at a configuration.

    Args:
        traced: renderer of the scene.
        u: (d,) configuration at which it is linearised.
        seed: seed of the noise.
        tick: is called with samples per pixel as they are traced; there are
            `count_samples` in all.
        spp: samples per pixel.
        quick: remove the noise from the rows of the matrix as from the base image,
            which they resemble, and not by the denoiser.
        names: inputs that get a matrix; None for all base colors that the space sets.
            Without any there is the base image alone.
        light: inputs that replace those of u.
        collected: what was collected elsewhere with the same arguments; then nothing is
            traced.

    Attributes:
        linearized_at: the inputs where it is linearised, by name.
        non_finite: numbers that were not finite, and were replaced by 0.

    Raises:
        TransportTooLargeError: a matrix would take more than `MAX_BYTES`.
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
            u: (d,) configuration at which the image is linearised.
            seed: seed of the noise.
            tick: called with the samples per pixel of each pass as it is done.
            spp: samples per pixel.
            quick: denoise the matrices by a cheaper method, and store them in 16 bits.
            names: inputs that get a matrix; None for all base colors.
            light: scene inputs that replace those of u.
            collected: what was collected elsewhere with the same arguments.
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
        self.non_finite = collected.non_finite
        self.linearized_at = collected.linearized_at

    @property
    def n_entries(self) -> int:
        """Number of entries of all matrices."""
        transports = self.collected.transports.values()
        return sum(transport.entries for transport in transports)

    @property
    def n_bytes(self) -> int:
        """Memory of all matrices and the base image, 8 bytes a pixel."""
        height, width = self.path_renderer.formation.resolution
        transports = self.collected.transports.values()
        return sum(transport.bytes for transport in transports) + 8 * height * width

    def release_scene(self, space: InputSpace) -> None:
        """Release the scene, which only tracing needs; the images stay.

        The renderer is a copy, so that others that share it keep their scene. `space`
        is the same space without a scene.
        """
        self.path_renderer = self.path_renderer.copy_with()
        del self.path_renderer.scene
        self.path_renderer.space = space

    def predict_radiance(self, inputs: Inputs) -> Tensor:
        """Return the radiance (H, W, 3) of scene inputs; with a backdrop more channels.

        It is the base image plus the change by each base color: its matrix times its
        difference from the value at which the image was linearised. The channels behind
        the first three, such as coverage, stay as they are.

        Args:
            inputs: scene inputs; only those that have a matrix count.
        """
        base = self.collected.base_image()
        radiance = base[..., :3]
        crop = self.path_renderer.crop
        for name, transport in self.collected.transports.items():
            change = transport(inputs[name] - self.linearized_at[name])
            if crop is not None:
                change = crop.window.pad(change, (base.shape[0], base.shape[1]))
            radiance = radiance + change
        if base.shape[-1] == 3:
            return radiance
        return torch.cat([radiance, base[..., 3:]], dim=-1)

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
    """Trace what a `LinearRenderer` needs: its base image and its matrices.

    If no input gets a matrix, the base image is an ordinary render. Otherwise it is the
    mean of the paths that fill the matrices. With a backdrop, radiance leaves out the
    background, and coverage is its fourth channel.

    Args:
        renderer: renderer of the scene; it counts what is traced.
        u: (d,) configuration at which the image is linearised.
        seed: seed of the noise.
        tick: called with the samples per pixel of each pass as it is done.
        spp: samples per pixel.
        quick: denoise the matrices by a cheaper method, and store them in 16 bits.
        names: inputs that get a matrix; None for all base colors.
        light: scene inputs that replace those of u.
    """
    # the renderer counts on; the difference is the count of this call
    non_finite_before = renderer.non_finite
    inputs = renderer.find_front(renderer.scene.assembly(renderer.space.inputs(u)))
    # those that belong to the finished image, not to the scene
    image_inputs = {
        name: value for name, value in inputs.items() if name in IMAGE_INPUTS
    }
    scene_inputs = {
        name: value for name, value in inputs.items() if name not in IMAGE_INPUTS
    }
    scene_inputs |= dict(light)
    if names is None:
        names = find_linear_inputs(renderer)
    linearized_at = {
        name: value.clone() for name, value in scene_inputs.items() if name in names
    }
    size = _get_traced_size(renderer)
    transports = {
        name: TextureTransport(size, (value.shape[0], value.shape[1]), small=quick)
        for name, value in linearized_at.items()
    }
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
        transports=transports,
        linearized_at=linearized_at,
        image_inputs=image_inputs,
        base_image=PackedImage(base, is_small=quick),
        non_finite=renderer.non_finite - non_finite_before,
    )


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

    A renderer that has a crop traces its window only, and the rest of the image is
    pasted around it.

    Args:
        renderer: renderer of the scene.
        transports: an empty matrix for each input; they are filled and finished.
        scene_inputs: inputs of the scene, without those of the finished image.
        seed: seed of the noise.
        tick: called with the samples per pixel of each pass as it is done.
        spp: samples per pixel of each matrix.
        quick: denoise the matrices by a cheaper method.
        has_backdrop: whether a photograph takes the place of the environment.

    Returns:
        (H, W, 3) linear radiance; with a backdrop also coverage and, where a plane
        takes the shadow, the change of its radiance.
    """
    with renderer.scene.limit_window(renderer.window):
        paths = _fill_transports(renderer, transports, scene_inputs, seed, tick, spp)
    radiance = paths.radiance
    if has_backdrop:  # which takes the place of the environment
        radiance = radiance - paths.background
    radiance = renderer.replace_non_finite(radiance)
    base, smooth = _make_smooth(renderer, radiance, paths, quick)
    for transport in transports.values():
        transport.finish(smooth)
    if has_backdrop:
        base = torch.cat([base, paths.coverage], dim=-1)
        base = _append_plane_change(renderer, base, scene_inputs, seed, spp)
    if renderer.crop is not None:
        base = renderer.crop.window.paste(base, renderer.crop.surroundings)
    return base


def _append_plane_change(
    renderer: Renderer, base: Tensor, traced: Inputs, seed: int, spp: int
) -> Tensor:
    """Append to a base image the change of the plane that takes the shadow.

    The channels are rendered once, since no base color changes them. If the scene has
    no such plane, the image is returned as it is.

    Args:
        renderer: renderer of the scene.
        base: (H, W, 4) radiance and coverage.
        traced: inputs of the scene, without those of the finished image.
        seed: seed of the noise.
        spp: samples per pixel.
    """
    if renderer.scene.plane_radiance is None:
        return base
    image = renderer.render_radiance(traced, seed, spp, True)
    if renderer.crop is not None:
        image = renderer.crop.window.select(image)
    return torch.cat([base, image[..., 4:]], dim=-1)


def _fill_transports(
    renderer: Renderer,
    transports: Mapping[str, TextureTransport],
    scene_inputs: Inputs,
    seed: int,
    tick: ProgressCallback,
    spp: int,
) -> Paths:
    """Trace paths for each matrix and add them; return the mean images of all.

    The vertices of a pass are released when they are added, so that memory holds one
    pass at a time. `tick` is called with the samples per pixel of each pass.

    Raises:
        TransportTooLargeError: all matrices together take more than `MAX_BYTES`.
    """
    samples, n_passes = plan_passes(renderer, spp)
    height, width = _get_traced_size(renderer)
    images: list[Paths] = []
    for name, transport in transports.items():
        for index in range(n_passes):
            noise_seed = seeds.stream(seed, f"transport {name}", index)
            paths = renderer.scene.collect_paths(
                scene_inputs, name, noise_seed, samples
            )
            transport.add_pass(paths.vertices, 1.0 / n_passes)
            size = sum(filled.bytes for filled in transports.values())
            # 8 bytes a pixel are for the base image: up to four channels of 16 bits
            if size + 8 * height * width > scale_limit(MAX_BYTES):
                raise TransportTooLargeError(
                    f"{TOO_LARGE} {scale_limit(MAX_BYTES) / 2**30:g} GiB"
                )
            images.append(replace(paths, vertices=[]))
            tick(samples)
    return average_passes(images)


def _make_smooth(
    renderer: Renderer, radiance: Tensor, paths: Paths, quick: bool
) -> tuple[Tensor, Smooth | None]:
    """Denoise the base image; also return the function that denoises a matrix's colors.

    The function takes and returns an image (H, W, 3). Without a denoiser the base image
    is returned as it is, and None.

    Args:
        renderer: renderer of the scene.
        radiance: (H, W, 3) the base image with its noise.
        paths: the paths that it is made of, with what guides the denoiser.
        quick: the function multiplies by the ratio of the denoised and the noisy base
            image, within a factor `MAX_CORRECTION` either way; otherwise it runs the
            denoiser, guided by the normals and by where surfaces are.
    """
    if renderer.formation.denoiser != "oidn":
        return radiance, None
    clean = denoise(radiance, paths.albedo.clamp(0.0, 1.0), paths.normal)
    ratio = (clean / radiance.clamp_min(1e-12)).clamp(
        1.0 / MAX_CORRECTION, MAX_CORRECTION
    )
    is_surface = paths.albedo.sum(dim=-1, keepdim=True) > 0.0
    # The denoiser keeps the edges of its guide image. The base color's pattern is not
    # in a matrix's colors, so that the guide is 1 on all surfaces, whatever their
    # color.
    even_albedo = is_surface.to(torch.float32).expand(-1, -1, 3).contiguous()

    def smooth(image: Tensor) -> Tensor:
        if quick:
            return image * ratio
        return denoise(image.contiguous(), even_albedo, paths.normal)

    return clean, smooth


def find_linear_inputs(renderer: Renderer) -> frozenset[str]:
    """Return the names of a scene's inputs to which radiance is linear."""
    return frozenset(
        name for name in renderer.scene.input_names if name.endswith(LINEAR_SUFFIXES)
    )


def _get_traced_size(renderer: Renderer) -> tuple[int, int]:
    """Return height and width of what is traced of an image, in pixels."""
    if renderer.crop is None:
        return renderer.formation.resolution
    return renderer.crop.window.height, renderer.crop.window.width


def plan_passes(renderer: Renderer, spp: int) -> tuple[int, int]:
    """Return the samples per pixel of a pass, and the number of passes."""
    height, width = _get_traced_size(renderer)
    samples = max(1, min(spp, SAMPLES_PER_PASS // (height * width)))
    return samples, math.ceil(spp / samples)
