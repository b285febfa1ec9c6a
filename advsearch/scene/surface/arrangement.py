"""Object and surroundings as they stand, with the light that arrives on them.

Where object, surroundings and lights stand still, the irradiance E of a point is the
same for every camera, so that

    radiance(pixel) = mean over its rays of [ share(angle) base colour E / pi +
                      gloss(angle) x light in its lobe ] or of the environment where a
                      ray escapes

with the shares and the lobe of the surface measured by sampling its BSDF. Nothing in it
is random.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.scene.assembly import ON_PICTURE
from advsearch.scene.assets import Bools
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import OBJECT
from advsearch.scene.grounds import irradiance as unshadowed
from advsearch.scene.mitsuba_backend.surface import RAYS, Lit, Seen, Views, lit_arrays
from advsearch.scene.mitsuba_backend.texel_rays import (
    Ints,
    Lobes,
    compute_visible_cosines,
    is_visible_from_behind,
    measured,
    trace_texel_rays,
    world_to_map,
)
from advsearch.scene.predictor import LinearMap
from advsearch.scene.raster import rasterised
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface import texels
from advsearch.scene.transport.matrix import bilinear


class SurfaceView:
    """What one of several cameras sees: `rest`, and a sparse matrix from the fine grid,
    front and (where it has light of its own, 2 sides) back, to the pixels.
    """

    def __init__(
        self, seen: Seen, number: int, shape: tuple[int, int], sides: int = 1
    ) -> None:
        self.rest = seen.rest[number]
        self.covered = seen.covered[number]
        height, width = self.rest.shape[:2]
        ends = torch.tensor([number, number + 1]) * (height * width * RAYS)
        begin, end = torch.searchsorted(seen.sample, ends).tolist()
        pixel = (seen.sample[begin:end] - int(ends[0])) // RAYS
        columns, shares = bilinear(seen.uv[begin:end].numpy(), shape)
        columns += np.int32(shape[0] * shape[1]) * seen.back[begin:end].numpy()[:, None]
        weights = shares * seen.weight[begin:end].numpy()[:, None]
        starts = np.searchsorted(pixel.numpy(), np.arange(height * width + 1)) * 4
        size = height * width, sides * shape[0] * shape[1]
        entries = weights.ravel(), columns.ravel(), starts.astype(np.int32)
        self.matrix = scipy.sparse.csr_matrix(entries, size, copy=False)

    def radiance(self, reflected: Tensor) -> Tensor:
        """Return (H, W, 3) for what the fine grid reflects (sides x cells, 3);
        differentiable in it.
        """
        return self.rest + product(self.matrix, reflected).reshape(self.rest.shape)


def product(matrix: scipy.sparse.csr_matrix, columns: Tensor) -> Tensor:
    """Return a sparse matrix times columns (k, 3); differentiable in these."""

    def times(of: scipy.sparse.csr_matrix, values: Tensor) -> Tensor:
        return torch.from_numpy(of @ values.numpy())

    both_ways = partial(times, matrix), partial(times, matrix.T)
    rows: Tensor = LinearMap.apply(*both_ways, columns)  # type: ignore[no-untyped-call]
    return rows


SIDE = 160  # texels a side over the searched object
GATHERED = 256  # rays from each texel that say what it sees
# share of a texel's rays that meet the back of a surface from which on it lies inside
# of something
BURIED = 0.3
BOUNCES = 4
"""How often light goes from texel to texel: that and the camera's and the sky's
segments make a path of `MAX_DEPTH`.
"""
FINE = 192  # least side of the grid on which base colour and light are multiplied
# reflectance that a photographed ground has at most, where light goes from surface to
# surface
WHITE = 0.95
COLOR = f"{OBJECT}.base_color"
MAP = "environment.padded"
GROUND = "ground"
CAMERAS = frozenset(
    {"camera.to_world", "camera.fov", "camera.shift_x", "camera.shift_y"}
)
FREE = CAMERAS | ON_PICTURE | {MAP, COLOR, "ground.reflectance"}
"""Inputs that may change without anything being found anew but the light."""


@dataclass(frozen=True, eq=False)
class Light:
    """Light on the surfaces: (cells of the fine grid, 3) irradiance of the object's
    front, and then of its back where that has its own; and the rest, for look-ups.
    """

    on_object: Tensor
    lit: Lit

    @property
    def bytes(self) -> int:
        return 4 * (self.on_object.numel() + self.lit.numbers)

    def reflected(self, fine: Tensor) -> Tensor:
        """Return what a base colour (cells of the fine grid, 3) reflects, on each side;
        differentiable.
        """
        return fine.repeat(len(self.on_object) // len(fine), 1) * self.on_object


class Arrangement:
    """Object and surroundings as they stand, and what they see of each other and of the
    environment. The inputs are the scene's own, assembled, but for what may change; the
    texture's size is that of the base colour, the seed that of the rays.
    """

    def __init__(
        self,
        renderer: Renderer,
        inputs: Mapping[str, Tensor],
        texture: tuple[int, int],
        seed: int,
    ) -> None:
        scene = renderer.scene
        self._scene = scene
        self.inputs = {name: inputs[name] for name in inputs if name not in ON_PICTURE}
        scene.held(self.inputs)
        description = scene.made[0]
        names = (f"{OBJECT}.vertices", f"{OBJECT}.normals")
        shape = [
            self.inputs[name] if name in self.inputs else scene.base(name)
            for name in names
        ]
        vertices, normals = (values.reshape(-1, 3).numpy() for values in shape)
        charts = rasterised(description.meshes[OBJECT].mesh, SIDE)
        some = [texels.on_mesh(OBJECT, charts, vertices, normals)]
        if is_visible_from_behind(scene, OBJECT, some[0].places):
            some = [
                texels.on_mesh(OBJECT, charts, vertices, side * normals, side)
                for side in (1, -1)
            ]
        self.sides = len(some)
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        photograph = description.photograph
        if description.number("ground.size") > 0.0:
            reach = (
                math.inf
                if photograph is not None
                else description.number("ground.size") / 2.0
            )
            some.append(
                texels.on_ground(
                    GROUND, 0.0, reach, (float(middle[0]), float(middle[1]))
                )
            )
        self._has_ground = len(some) > self.sides
        self.texels: texels.LitTexels = texels.together(some)
        factor = max(1, math.ceil(FINE / min(texture)))
        self.fine = texture[0] * factor, texture[1] * factor
        # from the texels of a small texture to the fine grid
        self._finer: scipy.sparse.csr_matrix | None = None
        if factor > 1:
            rows, columns = self.fine
            y, x = np.meshgrid(
                (np.arange(rows) + 0.5) / rows,
                (np.arange(columns) + 0.5) / columns,
                indexing="ij",
            )
            of_texel, shares = bilinear(
                np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32), texture
            )
            entries = (
                shares.ravel(),
                of_texel.ravel(),
                np.arange(rows * columns + 1, dtype=np.int32) * 4,
            )
            self._finer = scipy.sparse.csr_matrix(
                entries, (rows * columns, texture[0] * texture[1])
            )
        places = self.texels.places
        facing = self.texels.normals
        seen = trace_texel_rays(
            scene, self.texels.grids, texels.CELLS, places, facing, GATHERED, seed
        )
        self._sees = texels.seen_of(seen, self.texels.of_cell, len(places))
        self._between = [
            texels.between(
                some[side],
                charts,
                self.fine,
                vertices,
                (1 - 2 * side) * normals,
                self._buried(seen, side),
            )
            for side in range(self.sides)
        ]
        if self._has_ground:
            above = np.asarray(
                (seen[self.texels.of(self.sides)] >= len(self.texels.of_cell)).any(
                    axis=1
                )
            )
            self._smooth = texels.smoothed(some[-1], above)
        self.lobes = [self._measured()] * self.sides + [Lobes.matt()] * (
            len(some) - self.sides
        )
        self._photographed = None if photograph is None else description.capture_height
        self.to_map = torch.tensor(world_to_map(scene), dtype=torch.float32)
        self._below = self._seen_below(middle)
        model = description.camera_model
        if model is not None and "camera.lens" in self.inputs:
            model = model.with_numbers(self.inputs["camera.lens"])
        self._views = Views(
            scene,
            self.texels.grids,
            self.lobes,
            texels.WIDTHS,
            self._photographed,
            model,
            middle,
        )

    def _buried(self, seen: Ints, side: int) -> Bools:
        """Which texels of a side of the object lie inside of something: they see
        nothing but backs, or much of them and no sky where backs have light of their
        own.
        """
        here = seen[self.texels.of(side)]
        if self.sides == 1:
            return np.asarray((here < 0).mean(axis=1) > BURIED)
        back = self.texels.grids[1]
        inside = (here >= back.first) & (here < back.first + back.count)
        return np.asarray(
            (inside.mean(axis=1) > BURIED)
            & ~(here >= len(self.texels.of_cell)).any(axis=1)
        )

    def _measured(self) -> Lobes:
        here = self.texels.of(0)
        opacity = self._scene.made[0].meshes[OBJECT].opacity
        every = np.arange(here.start, here.stop)
        if opacity is not None:
            rows, columns = self.texels.grids[0].shape
            row, column = np.divmod(self.texels.cells[here], columns)
            opaque = opacity[
                row * opacity.shape[0] // rows, column * opacity.shape[1] // columns
            ]
            every = every[opaque >= opaque.max()]
        at = every[len(every) // 2]
        return measured(
            self._scene,
            self.inputs,
            self.texels.grids[0],
            self.texels.places[at],
            self.texels.normals[at],
        )

    def _seen_below(self, middle: np.ndarray) -> tuple[Tensor, Tensor]:
        """Which cells of the blurred maps (h, w) the ground hides, seen from the
        object's middle, and the directions (h, w, 3) in the map's axes in which its
        photograph has what is seen there.
        """
        ways = texels.directions(texels.BLURRED)
        world = ways @ self.to_map
        if not self._has_ground:
            return torch.zeros(texels.BLURRED, dtype=torch.bool), ways
        far = float(middle[2]) / (-world[..., 2]).clamp_min(1e-6)
        places = torch.from_numpy(middle).float() + world * far[..., None]
        reach = (
            self._scene.made[0].number("ground.size") / 2.0
            if self._photographed is None
            else math.inf
        )
        hidden = (world[..., 2] < -1e-3) & (places[..., :2].abs() <= reach).all(dim=-1)
        camera = torch.tensor([0.0, 0.0, self._photographed or 0.0])
        return hidden, (places - camera) @ self.to_map.T

    @property
    def entries(self) -> int:
        """Of all matrices, for one colour channel."""
        return sum(
            int(matrix.values().numel()) for matrix in (*self._sees, *self._between)
        )

    @property
    def bytes(self) -> int:
        return 8 * self.entries

    def look(
        self, cameras: Sequence[Mapping[str, Tensor]], light: Light
    ) -> Callable[[], Seen]:
        """Begin to look through cameras under a light; see `Views`."""
        self._scene.stand(self.inputs)
        return self._views(cameras, light.lit)

    def view(self, seen: Seen, number: int) -> SurfaceView:
        return SurfaceView(seen, number, self.fine, self.sides)

    def finer(self, color: Tensor) -> Tensor:
        """Return a base colour (h, w, 3) on the fine grid, (cells, 3);
        differentiable.
        """
        flat = color.reshape(-1, 3)
        return flat if self._finer is None else product(self._finer, flat)

    def light(self, padded: Tensor, color: Tensor) -> Light:
        """Return the light of an environment (H, W + 2, 3) where the object has a base
        colour (h, w, 3).
        """
        with torch.no_grad():
            sky = texels.sky_of(padded)
            direct = None
            if len(sky.hot[0]):
                self._scene.stand(self.inputs)
                cosines = compute_visible_cosines(
                    self._scene,
                    self.texels.places,
                    self.texels.normals,
                    sky.hot[0].numpy(),
                )
                direct = torch.from_numpy(cosines)
            reflectance = self._reflectance(color, padded)
            arriving = texels.irradiance(self._sees, sky, direct, reflectance, BOUNCES)
            leaving = reflectance * arriving / math.pi
            shown = sky.map
            unhidden = torch.ones(1, 3)
            if self._has_ground:
                ground = self.texels.of(self.sides)
                (hidden, below) = self._below
                if self._photographed is not None:
                    leaving[ground] = arriving[ground] / unshadowed(
                        padded[:, 1:-1]
                    ).clamp_min(1e-12)
                leaving[ground] = self._smooth @ leaving[ground]
                cells = leaving[ground].reshape(*self.texels.grids[-1].shape, 3)
                # the object hides little of it
                rim = torch.cat([cells[0], cells[-1], cells[:, 0], cells[:, -1]])
                unhidden = rim.mean(dim=0, keepdim=True).clamp_min(1e-9)
                seen = unhidden
                if self._photographed is not None:
                    seen = unhidden * texels.looked_up(
                        padded, below.reshape(-1, 3)
                    ).reshape(*texels.BLURRED, 3)
                shown = torch.where(hidden[..., None], seen, shown)
            on_object = torch.cat(
                [
                    fine @ arriving[self.texels.of(side)]
                    for side, fine in enumerate(self._between)
                ]
            )
            cells = torch.cat(
                [leaving[torch.from_numpy(self.texels.of_cell)], unhidden]
            )
            return Light(on_object, lit_arrays(cells, padded, texels.blurred(shown)))

    def _reflectance(self, color: Tensor, padded: Tensor) -> Tensor:
        rows, columns = self.texels.grids[0].shape
        fine = self.finer(color).reshape(*self.fine, 3).permute(2, 0, 1)[None]
        pooled = (
            functional.adaptive_avg_pool2d(fine, (rows, columns))[0]
            .permute(1, 2, 0)
            .reshape(-1, 3)
        )
        colors = [
            pooled[torch.from_numpy(self.texels.cells[self.texels.of(0)])]
        ] * self.sides
        if self._has_ground:
            ground = self.texels.places[self.texels.of(self.sides)]
            if self._photographed is None:
                colors.append(
                    srgb_to_linear(
                        torch.tensor(self._scene.made[0].ground_color)
                    ).expand(len(ground), 3)
                )
            else:
                below = torch.from_numpy(ground) - torch.tensor(
                    [0.0, 0.0, self._photographed]
                )
                shown = texels.looked_up(padded, below @ self.to_map.T)
                colors.append(
                    (
                        shown * math.pi / unshadowed(padded[:, 1:-1]).clamp_min(1e-12)
                    ).clamp_max(WHITE)
                )
        shares = [torch.tensor(surface.mean_shares) for surface in self.lobes]
        return torch.cat(
            [
                color * share[0] + share[1]
                for color, share in zip(colors, shares, strict=True)
            ]
        )
