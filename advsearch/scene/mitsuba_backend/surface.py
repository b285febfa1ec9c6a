"""What cameras see of light on surfaces, by rays and look-ups in one recorded launch.

A ray of a pixel sees a texel, or the environment; another one, in the mean direction of
the surface's gloss, sees what is reflected. Where a pixel's rays go through it is the
same for all pixels, so that nothing is random.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.scene.assets import Floats
from advsearch.scene.camera_model import CameraModel
from advsearch.scene.mitsuba_backend import texel_rays
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import Recordings, dr, mi, one_at_a_time

# spreads of gloss between which one ray to the ground gives way to what surrounds the
# object
SHARP = 0.15
WIDE = 0.4
CAMERA = 16  # numbers of a camera
PATTERN = ((0.125, 0.375), (0.375, 0.875), (0.625, 0.125), (0.875, 0.625))
"""Where the rays of a pixel go through it: a turned grid, which sees upright and level
edges at four places.
"""
RAYS = len(PATTERN)
# share of a ray's light under which what is behind a cut-out does not count
LEAST = 1e-3


@dataclass(frozen=True, eq=False)
class Lit:
    """The light of one moment, as `Views` looks it up: flat arrays, three numbers each,
    and sizes of the maps.
    """

    # radiance that leaves each texel of all grids, and in the end that of the ground
    # far off; of a photographed ground, the share of the photograph that it shows
    texels: Any
    sky: Any  # the environment's map, with the copied columns at both ends
    sky_shape: tuple[int, int]
    # what surrounds the object, the ground too, blurred by each of `widths`
    blurred: Any
    blurred_shape: tuple[int, int]

    @property
    def numbers(self) -> int:
        """How many numbers there are."""
        return len(self.texels) + len(self.sky) + len(self.blurred)


def lit_arrays(texels: Tensor, padded: Tensor, blurred: Tensor) -> Lit:
    """Return light for look-ups, in memory of its own: of the texels (cells of all
    grids, 3), the environment (H, W + 2, 3), and its blurred maps (widths, h, w, 3).
    """
    flat = [
        mi.Float(functional.pad(values, (0, 1)).numpy().ravel())
        for values in (texels, padded, blurred)
    ]
    shapes = [(values.shape[-3], values.shape[-2]) for values in (padded, blurred)]
    return Lit(flat[0], flat[1], shapes[0], flat[2], shapes[1])


@dataclass(frozen=True, eq=False)
class Seen:
    """What cameras see."""

    # (n, H, W, 3) radiance but for what the searched texture reflects diffusely
    rest: Tensor
    covered: Tensor  # (n, H, W, 1) share of each pixel that shows surfaces
    # (k,) int64, the rays that see the searched texture, ascending; `RAYS` a pixel, row
    # by row. One that goes through cut-outs sees it several times
    sample: Tensor
    uv: Tensor  # (k, 2) where, as Mitsuba has them
    weight: Tensor  # (k,) the diffuse share over pi, and over the rays of a pixel
    back: Tensor  # (k,) whether it is seen from behind


class Views:
    """Looks through many cameras of a scene in one launch, which is recorded; the
    inputs that it is asked with have to be set in the scene.

    Grids and lobes are those of all surfaces that take part, the searched texture's
    first. `widths` are the root mean square angles, radians, of maps blurred as seen
    from the middle (3,) of the object, each twice the one before. A ground is
    photographed from a height. A lens model is that of all cameras; pinholes each have
    a field of view.
    """

    def __init__(
        self,
        scene: MitsubaScene,
        grids: Sequence[texel_rays.TexelGrid],
        lobes: Sequence[texel_rays.Lobes],
        widths: Sequence[float],
        photographed: float | None,
        model: CameraModel | None,
        middle: Floats,
    ) -> None:
        self._scene = scene
        self._grids = tuple(grids)
        self._widths = tuple(widths)
        self._photographed = photographed
        self._middle = middle.tolist()
        tables = [
            np.concatenate([getattr(surface, name) for name in texel_rays.TABLES])
            for surface in lobes
        ]
        self._tables = np.concatenate(tables).astype(np.float32)
        self._lens: Floats | None = None
        if model is not None:  # where the rays of each pixel go through it
            height, width = scene.resolution
            row, column, ray = np.meshgrid(
                np.arange(height), np.arange(width), np.arange(RAYS), indexing="ij"
            )
            across, down = np.array(PATTERN)[ray.ravel()].T
            places = np.stack(
                [(column.ravel() + across) / width, (row.ravel() + down) / height],
                axis=1,
            )
            self._lens = model.table(torch.from_numpy(places)).numpy().ravel()
        self._recorded = Recordings()

    def __call__(
        self, cameras: Sequence[Mapping[str, Tensor]], lit: Lit
    ) -> Callable[[], Seen]:
        """Begin to look at a lit scene through cameras, by the inputs of each:
        `camera.to_world` (4, 4), and of a pinhole `camera.fov`, `camera.shift_x` and
        `camera.shift_y` (1,). What is returned waits until Dr.Jit has done all that was
        asked, and says what is seen; until then the processor may do other things.
        """
        with one_at_a_time:
            height, width = self._scene.resolution
            count = len(cameras)
            rows = np.stack(
                [_camera(inputs, height, width) for inputs in cameras]
            ).astype(np.float32)

            def look(
                held: Any, lane: Any, tables: Any, cameras: Any, lens: Any, *arrays: Any
            ) -> Any:
                there = Lit(
                    arrays[0], arrays[1], lit.sky_shape, arrays[2], lit.blurred_shape
                )
                return self._look(held, lane, tables, cameras, lens, there)

            recording = self._recorded.of(
                (count, lit.sky_shape, lit.blurred_shape), look, []
            )
            lens = np.zeros(1, np.float32) if self._lens is None else self._lens
            arrays = [mi.Float(values) for values in (self._tables, rows.ravel(), lens)]
            lane = dr.arange(mi.UInt32, count * height * width * RAYS)
            # a recording takes its size from what it is given, the size of the scene's
            # map else
            dr.eval(lane)
            channels = recording(
                self._scene._scene, lane, *arrays, lit.texels, lit.sky, lit.blurred
            )
        return lambda: _seen(channels, (count, height, width))

    def _look(
        self, held: Any, lane: Any, tables: Any, cameras: Any, lens: Any, lit: Lit
    ) -> list[Any]:
        """The kernel: radiance but for the searched texture, coverage, and where and
        how much each ray sees of it.
        """
        height, width = self._scene.resolution
        pixel = lane // RAYS
        number = lane % RAYS
        view = pixel // (height * width)
        pixel = pixel % (height * width)
        across = mi.Float(PATTERN[0][0])
        down = mi.Float(PATTERN[0][1])
        for index, place in enumerate(PATTERN[1:], 1):
            across, down = (
                dr.select(number == index, a, b)
                for a, b in zip(place, (across, down), strict=True)
            )
        camera = [
            dr.gather(mi.Float, cameras, view * CAMERA + k) for k in range(CAMERA)
        ]
        if self._lens is None:
            x = (
                camera[14] - 2.0 * (mi.Float(pixel % width) + across) / width
            ) * camera[12]
            y = (
                camera[15] - 2.0 * (mi.Float(pixel // width) + down) / height
            ) * camera[13]
            z = mi.Float(1.0)
            active = mi.Bool(True)
        else:
            x, y, z, within = (
                dr.gather(mi.Float, lens, 4 * (pixel * RAYS + number) + k)
                for k in range(4)
            )
            active = within > 0.0
        d = dr.normalize(
            mi.Vector3f(
                *(
                    camera[k] * x + camera[3 + k] * y + camera[6 + k] * z
                    for k in range(3)
                )
            )
        )
        ray = mi.Ray3f(mi.Point3f(*camera[9:12]), d)
        wanted = mi.RayFlags.UV | mi.RayFlags.ShadingFrame

        # Through cut-outs, layer by layer; of each, what light passes is left for those
        # behind it
        layers = texel_rays.layers_of(self._scene)
        texture = []
        radiance = mi.Color3f(0.0)
        covered = mi.Float(0.0)
        left = mi.Float(1.0)
        for layer in range(layers + 1):
            si = held.ray_intersect(ray, wanted, layer == 0, active)
            valid = active & si.is_valid()
            share = (
                left * (1.0 - texel_rays.passed(si, valid)) if layer < layers else left
            )
            shown, diffuse, side = self._shaded(held, si, valid, d, tables, lit)
            radiance += dr.select(valid, share * shown, 0.0)
            radiance += dr.select(
                active & ~si.is_valid(),
                left * _sky(lit, d, texel_rays.to_map(self._scene)),
                0.0,
            )
            covered += dr.select(valid, share / RAYS, 0.0)
            texture += [si.uv.x, si.uv.y, side * share * diffuse / (math.pi * RAYS)]
            left, active = left - share, valid & (left - share > LEAST)
            ray = si.spawn_ray(d)
        radiance /= RAYS
        # a sum of its own kernel each would send all rays again
        dr.eval(radiance, covered, texture)
        return [
            *(dr.block_sum(channel, RAYS) for channel in (*radiance, covered)),
            *texture,
        ]

    def _shaded(
        self, held: Any, si: Any, valid: Any, d: Any, tables: Any, lit: Lit
    ) -> tuple[Any, Any, Any]:
        """What a ray in direction d hit: its radiance, but for what the searched
        texture reflects diffusely; its diffuse share; and 1 on the front of the
        searched texture, -1 on its back, 0 elsewhere.
        """
        to_local = texel_rays.to_map(self._scene)
        layers = texel_rays.layers_of(self._scene)
        on = [at & valid for at in texel_rays.on_grids(held, self._grids, si, d)]
        # towards the viewer
        n = dr.select(dr.dot(si.sh_frame.n, d) > 0.0, -si.sh_frame.n, si.sh_frame.n)
        cosine = -dr.dot(n, d)

        # The tables of the surface, between their two entries next to the angle
        table = mi.UInt32(0)
        for number, at in enumerate(on):
            table = dr.select(
                at,
                mi.UInt32(number * len(texel_rays.TABLES) * texel_rays.ANGLES),
                table,
            )
        place = dr.clip(cosine * texel_rays.ANGLES - 0.5, 0.0, texel_rays.ANGLES - 1.0)
        low = dr.minimum(mi.UInt32(place), texel_rays.ANGLES - 2)
        between = place - mi.Float(low)
        entries = []
        for number in range(len(texel_rays.TABLES)):
            entry = table + number * texel_rays.ANGLES + low
            first = dr.gather(mi.Float, tables, entry)
            second = dr.gather(mi.Float, tables, entry + 1)
            entries.append(first + between * (second - first))
        diffuse, gloss, up, along, core, tail = entries

        # Diffuse light; that of the searched texture is left to the matrix
        shown = self._shown(si, on, lit, to_local)
        side = mi.Float(0.0)
        for grid, at in zip(self._grids, on, strict=True):
            side = (
                dr.select(at, -1.0 if grid.side < 0 else 1.0, side)
                if grid.warp is None
                else side
            )
        radiance = dr.select(side != 0.0, 0.0, shown * dr.select(valid, diffuse, 1.0))

        # The gloss: a ray in the mean direction of the lobe says what is there, the
        # blurred map how bright it is
        glossy = valid & (gloss > 1e-4)
        beside = dr.normalize(d + n * cosine + 1e-8)
        wo = dr.normalize(n * up + beside * along)
        si_wo = texel_rays.stopped(
            held, mi.Ray3f(si.p + n * texel_rays.SHIFT, wo), layers, active=glossy
        )
        on_wo = texel_rays.on_grids(held, self._grids, si_wo, wo)
        # or the direction in which the middle of the object sees the ground that is
        # seen from here
        seen_in = wo
        if any(grid.warp is not None for grid in self._grids):
            far = si.p.z / dr.maximum(-wo.z, 1e-3)
            seen_in = dr.select(
                wo.z < -1e-3,
                dr.normalize(si.p + wo * far - mi.Point3f(*self._middle)),
                wo,
            )
        blurred = 0.5 * sum(
            _blurred(lit, seen_in, to_local, spread, self._widths)
            for spread in (core, tail)
        )
        texel = self._texel(si_wo, on_wo, lit)

        # On the ground one ray meets a single place: the wider the lobe, the more
        # counts what surrounds the object, which is darker where the ground is darker
        # there than far off
        shade = texel / _gathered(
            lit.texels, mi.UInt32(self._grids[-1].first + self._grids[-1].count)
        )
        level = mi.Bool(False)
        for grid, at in zip(self._grids, on_wo, strict=True):
            level |= at & (grid.warp is not None)
        wide = dr.clip(
            (dr.sqrt(0.5 * (core * core + tail * tail)) - SHARP) / (WIDE - SHARP),
            0.0,
            1.0,
        )
        traced = self._shown(si_wo, on_wo, lit, to_local)
        ground = traced + wide * (blurred * shade - traced)
        reflected = dr.select(
            si_wo.is_valid(), dr.select(level, ground, texel), blurred
        )
        radiance += dr.select(glossy, gloss * reflected, 0.0)
        return radiance, diffuse, side

    def _shown(self, si: Any, on: Sequence[Any], lit: Lit, to_local: Any) -> Any:
        """Diffuse radiance of what was hit: that of a photographed ground is a share of
        its photograph.
        """
        radiance = self._texel(si, on, lit)
        if self._photographed is not None:
            below = dr.normalize(si.p - mi.Point3f(0.0, 0.0, self._photographed))
            for grid, at in zip(self._grids, on, strict=True):
                if grid.warp is not None:
                    radiance = dr.select(
                        at, radiance * _sky(lit, below, to_local), radiance
                    )
        return radiance

    def _texel(self, si: Any, on: Sequence[Any], lit: Lit) -> Any:
        first = mi.UInt32(0)
        rows = mi.UInt32(1)
        columns = mi.UInt32(1)
        y = mi.Float(0.0)
        x = mi.Float(0.0)
        known = mi.Bool(False)
        for grid, at in zip(self._grids, on, strict=True):
            down, across = texel_rays.grid_place(grid, si.p, si.uv)
            y = dr.select(at, down, y)
            x = dr.select(at, across, x)
            known = known | at
            first = dr.select(at, mi.UInt32(grid.first), first)
            rows = dr.select(at, mi.UInt32(grid.shape[0]), rows)
            columns = dr.select(at, mi.UInt32(grid.shape[1]), columns)
        radiance = _bilinear(
            lit.texels,
            first,
            rows,
            columns,
            y * mi.Float(rows) - 0.5,
            x * mi.Float(columns) - 0.5,
        )
        return dr.select(known, radiance, 0.0)


def _camera(inputs: Mapping[str, Tensor], height: int, width: int) -> Floats:
    """The 16 numbers of a camera: its axes to the left, up and forward, its place, half
    its extent, its middle.
    """
    matrix = inputs["camera.to_world"].detach().double().numpy()
    half = (
        math.tan(math.radians(float(inputs["camera.fov"])) / 2.0)
        if "camera.fov" in inputs
        else 0.0
    )
    extent = [half * side / max(height, width) for side in (width, height)]
    middle = [
        1.0 - 2.0 * float(inputs.get(f"camera.shift_{axis}", 0.0)) for axis in "xy"
    ]
    return np.concatenate([matrix[:3, :3].T.ravel(), matrix[:3, 3], extent, middle])


def _seen(channels: Sequence[Any], size: tuple[int, int, int]) -> Seen:
    """What the kernel has found, in memory of torch's own; `size` in cameras, rows and
    columns.
    """
    with one_at_a_time:
        # of three channels a layer, all layers of a ray, ray by ray
        u, v, weight = (
            np.stack([layer.numpy() for layer in channels[k::3]], axis=1).ravel()
            for k in (4, 5, 6)
        )
        (met,) = np.nonzero(weight)
        rest = np.stack([channel.numpy() for channel in channels[:3]], axis=-1)
        return Seen(
            rest=torch.from_numpy(rest).reshape(*size, 3),
            covered=torch.from_numpy(channels[3].numpy().copy()).reshape(*size, 1),
            sample=torch.from_numpy(met // (len(weight) // (math.prod(size) * RAYS))),
            uv=torch.from_numpy(np.stack([u[met], v[met]], axis=1)),
            weight=torch.from_numpy(np.abs(weight[met])),
            back=torch.from_numpy(weight[met] < 0.0),
        )


def _bilinear(
    values: Any,
    first: Any,
    rows: Any,
    columns: Any,
    y: Any,
    x: Any,
    *,
    wraps: bool = False,
) -> Any:
    """Look three numbers up in a grid of a flat array, which ends at its border or goes
    round in its columns.
    """
    y = dr.clip(y, 0.0, mi.Float(rows) - 1.0)
    upper = mi.UInt32(y)
    share = y - dr.floor(y)
    lower = dr.minimum(upper + 1, rows - 1)
    x = (
        dr.select(x < 0.0, x + mi.Float(columns), x)
        if wraps
        else dr.clip(x, 0.0, mi.Float(columns) - 1.0)
    )
    left = mi.UInt32(x)
    across = x - dr.floor(x)
    right = (left + 1) % columns if wraps else dr.minimum(left + 1, columns - 1)
    left = left % columns if wraps else left

    def along(row: Any) -> Any:
        begin = first + row * columns
        return (
            _gathered(values, begin + left) * (1.0 - across)
            + _gathered(values, begin + right) * across
        )

    return along(upper) * (1.0 - share) + along(lower) * share


def _gathered(values: Any, number: Any) -> Any:
    """The three numbers with a number; four at once is what the processor reads
    fastest.
    """
    return mi.Color3f(*dr.gather(mi.Vector4f, values, number)[:3])


def _sky(lit: Lit, way: Any, to_local: Any) -> Any:
    """The environment in a direction, as Mitsuba has it: rows from pole to pole,
    columns with a copy at both ends.
    """
    rows, columns = lit.sky_shape
    across, down = texel_rays.map_place(way, to_local)
    x = across * (columns - 2) + 0.5
    y = down * (rows - 1)
    return _bilinear(lit.sky, mi.UInt32(0), mi.UInt32(rows), mi.UInt32(columns), y, x)


def _blurred(
    lit: Lit, way: Any, to_local: Any, spread: Any, widths: Sequence[float]
) -> Any:
    """The environment in a direction, blurred by an angle (root mean square)."""
    rows, columns = lit.blurred_shape
    level = dr.clip(
        dr.log2(dr.maximum(spread, 1e-4) / widths[0]), 0.0, len(widths) - 1.0
    )
    low = dr.minimum(mi.UInt32(level), max(0, len(widths) - 2))
    across, down = texel_rays.map_place(way, to_local)
    y = down * rows - 0.5
    x = across * columns - 0.5
    narrow, wide = (
        _bilinear(
            lit.blurred,
            (low + k) * (rows * columns),
            mi.UInt32(rows),
            mi.UInt32(columns),
            y,
            x,
            wraps=True,
        )
        for k in (0, 1)
    )
    return narrow + (level - mi.Float(low)) * (wide - narrow)
