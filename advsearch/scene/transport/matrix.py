"""The matrix of light transport from the texels of a base colour to the pixels of a
picture, and renderers by it.

Where camera, meshes and lights stand still, the radiance of a pixel is, to first order
in the base colour,

    radiance = base + J (base colour - base colour there),        J: pixels x texels, one weight a colour channel,

and J is sparse: a pixel sees few texels directly, in a mirror or through glass
(bilinear lookups), and many a little (light from the object to the object), for which
coarse cells of `COARSE` texels a side are enough. What a pixel sees of the texels
hardly depends on the colour of the light, so that a row of J is kept as shares of
texels, which add up to one, times a colour. A matrix that is one of many keeps its
shares in 16 bits; one that serves a whole search keeps them in 32, by rows and by
columns, so that a product with it is one call.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch import seeds
from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.assets import Floats, Ints
from advsearch.scene.mitsuba_backend.denoise import denoise
from advsearch.scene.mitsuba_backend.transport import Paths, Vertices, mean_of
from advsearch.scene.parts import PATTERN
from advsearch.scene.predictor import MOST_BYTES, LinearMap, Predictor
from advsearch.scene.renderer import InputSpace, Renderer
from advsearch.trust.stored_files import scaled

# from a noisy picture (H, W, 3) to one without noise
Smooth = Callable[[Tensor], Tensor]
# multiples of its mean up to which a picture is kept; any exposure has clipped them
# long before
MOST_MEANS = 6e4
COARSE = 8  # side of the cells of later vertices, in texels


class Halves:
    """A picture, of any shape, in 16 bits a number, in multiples of its mean, so that
    it may be as bright as it likes; if `small` it is unpacked each time it is asked
    for, otherwise once, where each step of a search asks.
    """

    def __init__(self, picture: Tensor, small: bool = True) -> None:
        mean = float(picture.abs().mean()) if picture.numel() else 0.0
        self._scale = mean if 0.0 < mean < float("inf") else 1.0
        self._values = (picture / self._scale).clamp(-MOST_MEANS, MOST_MEANS).half()
        self._unpacked = None if small else self._values.float() * self._scale

    def __call__(self) -> Tensor:
        return (
            self._values.float() * self._scale
            if self._unpacked is None
            else self._unpacked
        )


class ColouredRows:
    """A sparse matrix (rows, columns) for three colour channels whose rows are shares
    times a colour; filled by `add`, then finished. If `small`, it is kept in 16 bits a
    share, and as many a column where there are no more than 65,536, and unpacked for
    each product.
    """

    def __init__(self, rows: int, columns: int, small: bool) -> None:
        self._shape = (rows, columns)
        self._small = small
        self.entries = 0
        self._both_ways: tuple[Tensor, Tensor] | None = None
        self._sum = scipy.sparse.csr_matrix(self._shape, dtype=np.float32)
        self._kept: (
            tuple[
                npt.NDArray[np.float16],
                npt.NDArray[np.integer[Any]],
                npt.NDArray[np.int32],
            ]
            | None
        ) = None
        self._column = np.dtype(np.uint16 if small and columns <= 1 << 16 else np.int32)
        self._colours: Floats = np.zeros((rows, 3), dtype=np.float32)
        self._kept_colours = Halves(torch.zeros(0))

    @property
    def bytes(self) -> int:
        """Memory when it is finished: a share and its column an entry, a beginning and
        a colour a row; a share and its row an entry, a beginning a column and the
        unpacked colours as well, where it is kept both ways.
        """
        small = (2 + self._column.itemsize) * self.entries + (4 + 6) * self._shape[0]
        return (
            small
            if self._small
            else small + 10 * self.entries + 12 * self._shape[0] + 4 * self._shape[1]
        )

    def add(self, rows: Ints, columns: Ints, shares: Floats, weights: Floats) -> None:
        """Add entries in rows (n,), ascending: the columns (n, k) that take part in
        each, several of which may be the same, with shares (n, k), and weights (n, 3).
        """
        if not len(rows):
            return
        begin = np.searchsorted(rows, np.arange(self._shape[0] + 1)) * columns.shape[1]
        values = (shares * np.abs(weights).mean(axis=1, keepdims=True)).ravel()
        more = scipy.sparse.csr_matrix(
            (values, columns.ravel().astype(np.int32), begin.astype(np.int32)),
            self._shape,
        )
        more.sum_duplicates()
        self._sum = self._sum + more if self._sum.nnz else more
        self.entries = int(self._sum.nnz)
        for channel in range(3):
            self._colours[:, channel] += np.bincount(
                rows, weights[:, channel], minlength=self._shape[0]
            )

    def finish(self, picture: tuple[int, int], smooth: Smooth | None) -> None:
        """Be ready to multiply; `smooth` takes the noise out of the picture of all
        colours.
        """
        sums = np.asarray(self._sum.sum(axis=1)).ravel()
        factors = np.where(sums > 0.0, 1.0 / np.maximum(sums, 1e-30), 0.0)
        shares = self._sum.data * np.repeat(factors, np.diff(self._sum.indptr))
        if self._small:
            self._kept = (
                shares.astype(np.float16),
                self._sum.indices.astype(self._column),
                self._sum.indptr,
            )
        else:
            rows = scipy.sparse.csr_matrix(
                (shares, self._sum.indices, self._sum.indptr), self._shape
            )
            self._both_ways = by_rows(rows), by_rows(rows.T.tocsr())
        self._sum = scipy.sparse.csr_matrix(self._shape, dtype=np.float32)
        colours = torch.from_numpy(self._colours).reshape(*picture, 3)
        self._kept_colours = Halves(
            colours if smooth is None else smooth(colours), self._small
        )
        self._colours = np.zeros((0, 3), dtype=np.float32)

    def times(self, values: Tensor) -> Tensor:
        """Return the matrix times (columns, 3): (rows, 3)."""
        ours = self._both_ways
        product = (
            ours[0] @ values
            if ours
            else torch.from_numpy(self._shares() @ values.numpy())
        )
        return product.mul_(self._kept_colours().reshape(-1, 3))

    def transposed_times(self, values: Tensor) -> Tensor:
        coloured = values * self._kept_colours().reshape(-1, 3)
        ours = self._both_ways
        return (
            ours[1] @ coloured
            if ours
            else torch.from_numpy(self._shares().T @ coloured.numpy())
        )

    def _shares(self) -> scipy.sparse.csr_matrix:
        assert self._kept is not None, "finish it first"
        shares, columns, begin = self._kept
        return scipy.sparse.csr_matrix(
            (shares.astype(np.float32), columns.astype(np.int32), begin), self._shape
        )


class TextureTransport:
    """From a change of a base colour (height and width in texels) to the change of
    radiance (in pixels), and back. Filled by `add`, then finished; if `small`, in as
    little memory as there is room for one of many matrices.
    """

    def __init__(
        self, picture: tuple[int, int], texture: tuple[int, int], *, small: bool = False
    ) -> None:
        self._picture = picture
        self._texture = texture
        self._cells = (-(-texture[0] // COARSE), -(-texture[1] // COARSE))
        # texels of each cell along one side, of which the last one may have fewer
        sides = zip(texture, self._cells, strict=True)
        tall, wide = (
            (texels - COARSE * torch.arange(cells)).clamp(max=COARSE).float()
            for texels, cells in sides
        )
        self._in_cell = (tall[:, None] * wide[None, :])[:, :, None]
        pixels = picture[0] * picture[1]
        self._first = ColouredRows(pixels, texture[0] * texture[1], small)
        self._later = ColouredRows(pixels, self._cells[0] * self._cells[1], small)

    @property
    def entries(self) -> int:
        return self._first.entries + self._later.entries

    @property
    def bytes(self) -> int:
        return self._first.bytes + self._later.bytes

    def add(self, vertices: Sequence[Vertices], share: float) -> None:
        """Add a pass of paths, vertices by their place in the path; it counts as this
        share of the samples.
        """
        rows, columns = self._cells
        for vertex in vertices:
            seen = vertex.only(vertex.sharp)
            scattered = vertex.only(~vertex.sharp)
            texels, shares = bilinear(seen.uv.numpy(), self._texture)
            weights = seen.weight.numpy() * np.float32(share)
            self._first.add(
                seen.pixel.numpy(), texels.astype(np.int64), shares, weights
            )
            uv = scattered.uv.numpy() % 1.0
            column = np.floor(uv[:, 0] * columns).astype(np.int64).clip(0, columns - 1)
            row = np.floor(uv[:, 1] * rows).astype(np.int64).clip(0, rows - 1)
            cell = (row * columns + column)[:, None]
            weights = scattered.weight.numpy() * np.float32(share)
            self._later.add(
                scattered.pixel.numpy(),
                cell,
                np.ones_like(cell, dtype=np.float32),
                weights,
            )

    def finish(self, smooth: Smooth | None = None) -> None:
        """End the collecting. `smooth` takes the noise out of a picture: what a change
        of all texels by one does to the picture is one. None leaves the colours of the
        rows as they were sampled.
        """
        self._first.finish(self._picture, smooth)
        self._later.finish(self._picture, smooth)

    def __call__(self, change: Tensor) -> Tensor:
        """Return the change of radiance (H, W, 3) for a change of the base colour (h,
        w, 3); differentiable.
        """
        radiance: Tensor = LinearMap.apply(self.times, self.transposed_times, change)  # type: ignore[no-untyped-call]
        return radiance

    def times(self, change: Tensor) -> Tensor:
        """Return J times (h, w, 3), as (H, W, 3)."""
        rows, columns = self._cells
        below, right = (
            COARSE * cells - texels
            for cells, texels in zip(self._cells, self._texture, strict=True)
        )
        whole = (
            functional.pad(change, (0, 0, 0, right, 0, below))
            if right or below
            else change
        )
        across = whole.reshape(rows * COARSE, columns, COARSE, 3).sum(dim=2)
        pooled = across.reshape(rows, COARSE, columns, 3).sum(dim=1) / self._in_cell
        radiance = self._first.times(change.reshape(-1, 3)).add_(
            self._later.times(pooled.reshape(-1, 3))
        )
        return radiance.reshape(*self._picture, 3)

    def transposed_times(self, cotangent: Tensor) -> Tensor:
        """Return the transpose of J times (H, W, 3), as (h, w, 3)."""
        flat = cotangent.reshape(-1, 3)
        near = self._first.transposed_times(flat).reshape(*self._texture, 3)
        far = (
            self._later.transposed_times(flat).reshape(*self._cells, 3) / self._in_cell
        )
        spread = far[:, None, :, None].expand(-1, COARSE, -1, COARSE, -1)
        return (
            near
            + spread.reshape(self._cells[0] * COARSE, -1, 3)[
                : self._texture[0], : self._texture[1]
            ]
        )


def by_rows(matrix: scipy.sparse.csr_matrix) -> Tensor:
    """The same for torch, whose products with it are twice as fast as scipy's."""
    parts = [
        torch.from_numpy(part) for part in (matrix.indptr, matrix.indices, matrix.data)
    ]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            parts[0], parts[1], parts[2], matrix.shape, check_invariants=False
        )


def bilinear(
    uv: Floats, texture: tuple[int, int]
) -> tuple[npt.NDArray[np.int32], Floats]:
    """The four texels (n, 4) of the bilinear lookup at texture coordinates (n, 2),
    which repeats at the border, by their places in the flat texture; and their shares
    (n, 4).
    """

    def both(
        at: Floats, count: int
    ) -> tuple[list[npt.NDArray[np.int32]], list[Floats]]:
        first = np.floor(at).astype(np.int32)
        share = (at - np.floor(at)).astype(np.float32)
        return [first % count, (first + 1) % count], [1.0 - share, share]

    height, width = texture
    (across, wide) = both(uv[:, 0] * width - 0.5, width)
    (down, tall) = both(uv[:, 1] * height - 0.5, height)
    columns = np.stack(
        [row * width + column for row in down for column in across], axis=1
    )
    return columns, np.stack([high * broad for high in tall for broad in wide], axis=1)


SPP = 128
"""Samples a pixel of the paths whose vertices become the matrix and which make the base
picture; what noise the denoiser leaves in it is in all predicted pictures.
"""
PASS = 2**20  # samples of all pixels in one pass; its vertices are held in memory
MOST = 4.0  # factor by which the noise of the base picture corrects a row at most
TOO_LARGE = "the matrix would take more than"
LINEAR = (".base_color", PATTERN)
"""What the names of inputs end in to which radiance is linear, but for light that meets
a base colour twice.
"""

Inputs = Mapping[str, Tensor]
SomeNames = Collection[str] | None
Tick = Callable[[int], None]  # told of samples a pixel as they are traced


def untold(samples: int) -> None:
    """Tell nobody."""


class TransportTooLargeError(Exception):
    """A matrix that takes more memory than it may."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """What a `LinearRenderer` has collected; it can be sent to another process."""

    transports: Mapping[str, TextureTransport]  # by input, finished
    there: dict[str, Tensor]  # the inputs where it was linearised
    applied: Inputs  # those that belong to the picture, not to the scene
    # the picture there, linear radiance, and coverage where there is a backdrop
    base: Halves
    non_finite: int = 0


class LinearRenderer(Predictor):
    """Predicts pictures by a matrix for each base colour, linearised at u with the
    noise of a seed, of so many samples a pixel, of which `tick` is told as they are
    traced (`samples_to_collect` in all). If `quick`, the noise is taken out of the rows
    of the matrix as out of the base picture, which they resemble, and not by the
    denoiser. `names` are the inputs that get a matrix, None for all base colours that
    the space sets; without any there is the base picture alone. Inputs that are `light`
    stand in the place of those of u. Of what was `collected` elsewhere with the same
    arguments nothing is traced. Raises TransportTooLargeError: a matrix would take more
    than `MOST_BYTES`.
    """

    def __init__(
        self,
        traced: Renderer,
        u: Tensor,
        seed: int,
        tick: Tick = untold,
        *,
        spp: int = SPP,
        quick: bool = False,
        names: SomeNames = None,
        light: Inputs = MappingProxyType({}),
        collected: Linearised | None = None,
    ) -> None:
        super().__init__(traced)
        if collected is None:
            with torch.no_grad():
                collected = _collected(
                    traced.like(), u, seed, tick, spp, quick, names, light
                )
        self.collected = collected
        self.non_finite = collected.non_finite
        self.there = collected.there

    @property
    def entries(self) -> int:
        return sum(
            transport.entries for transport in self.collected.transports.values()
        )

    @property
    def bytes(self) -> int:
        height, width = self.traced.formation.resolution
        return (
            sum(transport.bytes for transport in self.collected.transports.values())
            + 8 * height * width
        )

    def let_go(self, space: InputSpace) -> None:
        """Let go of the scene, which only tracing takes; the pictures stay, and `space`
        is the same without a scene.
        """
        self.traced = self.traced.like()
        del self.traced.scene
        self.traced.space = space

    def radiance(self, inputs: Inputs) -> Tensor:
        base = self.collected.base()
        radiance = base[..., :3]
        for name, transport in self.collected.transports.items():
            radiance = radiance + transport(inputs[name] - self.there[name])
        return (
            radiance
            if base.shape[-1] == 3
            else torch.cat([radiance, base[..., 3:]], dim=-1)
        )

    def shown(self, inputs: Inputs, u: Tensor) -> Tensor:
        """The picture (H, W, 3) sRGB of scene inputs, of which only those to which
        radiance is linear count; what controls do to the finished picture comes from
        `u`.
        """
        return self.traced.finished(self.radiance(inputs), self.collected.applied, u)


def _collected(
    renderer: Renderer,
    u: Tensor,
    seed: int,
    tick: Tick,
    spp: int,
    quick: bool,
    names: SomeNames,
    light: Inputs,
) -> Linearised:
    before = renderer.non_finite
    (height, width) = renderer.formation.resolution
    inputs = renderer.scene.assembly(renderer.space.inputs(u))
    applied = {name: value for name, value in inputs.items() if name in ON_PICTURE}
    traced = {
        name: value for name, value in inputs.items() if name not in ON_PICTURE
    } | dict(light)
    linear = linear_inputs(renderer) if names is None else names
    there = {name: value.clone() for name, value in traced.items() if name in linear}
    transports = {
        name: TextureTransport(
            (height, width), (value.shape[0], value.shape[1]), small=quick
        )
        for name, value in there.items()
    }
    hide = "backdrop.color" in applied

    def finished(base: Tensor) -> Linearised:
        return Linearised(
            transports,
            there,
            applied,
            Halves(base, small=quick),
            renderer.non_finite - before,
        )

    if not transports:
        base = renderer.rendered(traced, seed, spp, hide)
        tick(spp)
        return finished(base)
    samples, count = passes(renderer, spp)
    traces: list[Paths] = []
    for name, transport in transports.items():
        for number in range(count):
            noise = seeds.stream(seed, f"transport {name}", number)
            paths = renderer.scene.transport(traced, name, noise, samples)
            transport.add(paths.vertices, 1.0 / count)
            if sum(
                kept.bytes for kept in transports.values()
            ) + 8 * height * width > scaled(MOST_BYTES):
                raise TransportTooLargeError(
                    f"{TOO_LARGE} {scaled(MOST_BYTES) / 2**30:g} GiB"
                )
            traces.append(replace(paths, vertices=[]))
            tick(samples)
    seen = mean_of(traces)
    radiance = clean = renderer.finite(
        seen.radiance - seen.background if hide else seen.radiance
    )
    smooth: Smooth | None = None
    if renderer.formation.denoiser == "oidn":
        clean = denoise(radiance, seen.albedo.clamp(0.0, 1.0), seen.normal)
        ratio = (clean / radiance.clamp_min(1e-12)).clamp(1.0 / MOST, MOST)
        even = (
            (seen.albedo.sum(dim=-1, keepdim=True) > 0.0)
            .to(torch.float32)
            .expand(-1, -1, 3)
            .contiguous()
        )

        def smooth(picture: Tensor) -> Tensor:
            return (
                picture * ratio
                if quick
                else denoise(picture.contiguous(), even, seen.normal)
            )

    for transport in transports.values():
        transport.finish(smooth)
    return finished(torch.cat([clean, seen.coverage], dim=-1) if hide else clean)


def linear_inputs(renderer: Renderer) -> frozenset[str]:
    return frozenset(name for name in renderer.scene.names if name.endswith(LINEAR))


def passes(renderer: Renderer, spp: int) -> tuple[int, int]:
    """Samples a pixel of a pass, and how many passes there are."""
    height, width = renderer.formation.resolution
    samples = max(1, min(spp, PASS // (height * width)))
    return samples, -(-spp // samples)
