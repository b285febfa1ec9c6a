"""Look up light on surfaces through many cameras, by rays in one recorded launch.

A ray of a pixel meets a texel, or the environment. From a glossy surface a second ray,
in the mean direction of its gloss, finds what is reflected. The rays have the same
positions in all pixels, so that nothing is random.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.extend import assets, prediction
from advsearch.predictors.surface_light import texel_rays

Float32Array: TypeAlias = assets.Float32Array

dr = prediction.dr
mi = prediction.mi

# Spreads of gloss, radians. Up to the first one a single ray finds the reflection of
# the ground; from the second one on it is taken from the blurred map.
MIN_BLENDED_SPREAD = 0.15
MAX_BLENDED_SPREAD = 0.4
CAMERA_SIZE = 16  # numbers of a camera in the kernel, see `_make_camera_numbers`
RAY_PATTERN = ((0.125, 0.375), (0.375, 0.875), (0.625, 0.125), (0.875, 0.625))
"""Positions (x, y) of the rays in their pixel, in pixels.

It is a rotated grid, which samples upright and level edges at four positions.
"""
RAYS_PER_PIXEL = len(RAY_PATTERN)
# the kernel's channels for each pixel, which come before those of the layers: three of
# radiance, and coverage
N_IMAGE_CHANNELS = 4
# A ray ends if less than this fraction of its light passes the cut-outs before it.
MIN_TRANSMITTANCE = 1e-3


@dataclass(frozen=True, eq=False)
class LightMaps:
    """Light of one environment, in maps for `ViewTracer`.

    The maps are flat Dr.Jit arrays with four numbers for each color, of which the last
    is unused; see `_gather_color`.
    """

    # for each cell of all grids the radiance of its texel, followed by that of the
    # ground beyond all texels; for a photographed ground, a factor on the photograph
    texels: Any
    sky: Any  # the environment's map, with the copied columns at both ends
    sky_shape: tuple[int, int]
    # environment and ground around the object, blurred by each of `widths`
    blurred: Any
    blurred_shape: tuple[int, int]

    @property
    def size(self) -> int:
        """Number of floats in all maps."""
        return len(self.texels) + len(self.sky) + len(self.blurred)


def make_light_maps(texels: Tensor, padded: Tensor, blurred: Tensor) -> LightMaps:
    """Make light maps for look-ups, in memory of their own.

    Args:
        texels: (cells of all grids and one more, 3) radiance.
        padded: (H, W + 2, 3) map of the environment.
        blurred: (widths, h, w, 3) its blurred maps.
    """

    def flatten(colors: Tensor) -> Any:
        # Each color (the last axis) gets a fourth number, 0, see `_gather_color`.
        return mi.Float(functional.pad(colors, (0, 1)).numpy().ravel())

    return LightMaps(
        texels=flatten(texels),
        sky=flatten(padded),
        sky_shape=(padded.shape[-3], padded.shape[-2]),
        blurred=flatten(blurred),
        blurred_shape=(blurred.shape[-3], blurred.shape[-2]),
    )


@dataclass(frozen=True, eq=False)
class ViewSamples:
    """Images of n cameras, and k samples of the searched texture in them."""

    # (n, H, W, 3) radiance without what the searched texture reflects diffusely
    radiance: Tensor
    coverage: Tensor  # (n, H, W, 1) fraction of each pixel that surfaces cover
    # (k,) int64 index of the ray of each sample, ascending. Each pixel has
    # `RAYS_PER_PIXEL` rays; pixels are in the order of camera, row, column. A ray that
    # goes through cut-outs may have several samples
    ray_index: Tensor
    uv: Tensor  # (k, 2) texture coordinates, with v as in Mitsuba
    diffuse_weight: (
        Tensor  # (k,) diffuse fraction over pi, and over the rays of a pixel
    )
    is_back: Tensor  # (k,) bool, whether the ray meets the surface from behind


def _select_ray_offset(ray_index: Any) -> tuple[Any, Any]:
    """Return the position of each ray in its pixel, in pixels to the right and down.

    `ray_index` is the index of the ray in `RAY_PATTERN`.
    """
    x_offset = mi.Float(RAY_PATTERN[0][0])
    y_offset = mi.Float(RAY_PATTERN[0][1])
    for index, offset in enumerate(RAY_PATTERN[1:], 1):
        x_offset = dr.select(ray_index == index, offset[0], x_offset)
        y_offset = dr.select(ray_index == index, offset[1], y_offset)
    return x_offset, y_offset


class ViewTracer:
    """Trace rays through many cameras of a scene in one recorded launch.

    Args:
        scene: the scene; the inputs of the arrangement have to be set at a call.
        grids: grid of texels of each surface, those of the searched texture first.
        lobes: reflection tables of each surface.
        widths: root mean square angles of the blurred maps, radians; each is twice the
            one before. The maps are blurred as seen from `center`.
        photograph_height: height of the camera that photographed the ground; None for
            a plain ground.
        model: lens model of all cameras; None for pinholes, which have a field of view
            each.
        center: (3,) center of the object, from which the blurred maps are seen.
    """

    def __init__(
        self,
        scene: prediction.MitsubaScene,
        grids: Sequence[texel_rays.TexelGrid],
        lobes: Sequence[texel_rays.Lobes],
        widths: Sequence[float],
        photograph_height: float | None,
        model: prediction.CameraModel | None,
        center: Float32Array,
    ) -> None:
        """Prepare the tables of all surfaces and of the lens for the kernel.

        Args:
            scene: the scene.
            grids, lobes: texel grid and reflection tables of each surface.
            widths: root mean square angles of the blurred maps, radians.
            photograph_height: height of the camera that photographed the ground; None
                for a plain ground.
            model: lens model of all cameras; None for pinholes.
            center: (3,) center of the object, from which the blurred maps are seen.
        """
        self._scene = scene
        self._grids = tuple(grids)
        self._widths = tuple(widths)
        self._photograph_height = photograph_height
        self._center = center.tolist()
        self._lobe_tables = _join_lobe_tables(lobes)
        self._lens = None if model is None else self._make_lens_table(model)
        self._recordings = prediction.Recordings()

    def _make_lens_table(self, model: prediction.CameraModel) -> Float32Array:
        """Return the lens's rays through each pixel, flat, four numbers each.

        The first three are the direction in the camera's axes; the fourth is above 0
        if the lens has a ray there. Rays are in the order of lanes: row, column, ray of
        the pixel.
        """
        height, width = self._scene.resolution
        row, column, ray_index = np.meshgrid(
            np.arange(height),
            np.arange(width),
            np.arange(RAYS_PER_PIXEL),
            indexing="ij",
        )
        x_offset, y_offset = np.array(RAY_PATTERN)[ray_index.ravel()].T
        x = (column.ravel() + x_offset) / width
        y = (row.ravel() + y_offset) / height
        positions = torch.from_numpy(np.stack([x, y], axis=1))
        table: Float32Array = model.make_ray_table(positions).numpy().ravel()
        return table

    def __call__(
        self, cameras: Sequence[Mapping[str, Tensor]], lit: LightMaps
    ) -> Callable[[], ViewSamples]:
        """Start to trace a lit scene through cameras.

        Args:
            cameras: inputs of each camera: `camera.to_world` (4, 4), and of a pinhole
                `camera.fov`, `camera.shift_x` and `camera.shift_y` (1,).
            lit: the light.

        Returns:
            A function that waits for the result and returns it; until it is called the
            processor may do other things.
        """
        with prediction.mitsuba_lock:
            height, width = self._scene.resolution
            count = len(cameras)
            camera_numbers = _join_camera_numbers(cameras, height, width)
            trace = self._make_ray_tracer(lit)
            recording = self._recordings.get_or_record(
                (count, lit.sky_shape, lit.blurred_shape), trace, media=[]
            )
            # without a lens a single 0, since the kernel's argument cannot be empty
            lens = np.zeros(1, np.float32) if self._lens is None else self._lens
            lane = dr.arange(mi.UInt32, count * height * width * RAYS_PER_PIXEL)
            # A recording has as many lanes as its evaluated arguments have entries. If
            # the indices of the lanes were not evaluated, these would be the entries of
            # the environment's map.
            dr.eval(lane)
            channels = recording(
                self._scene._scene,
                lane,
                mi.Float(self._lobe_tables),
                mi.Float(camera_numbers),
                mi.Float(lens),
                lit.texels,
                lit.sky,
                lit.blurred,
            )
        return lambda: _fetch(channels, (count, height, width))

    def _make_ray_tracer(self, lit: LightMaps) -> Callable[..., Any]:
        """Return the function that traces all rays, which Dr.Jit records.

        Maps are arguments of the recorded function, so that the recording also works
        for other light whose maps have the same sizes.
        """

        def trace(
            mitsuba_scene: Any,
            lane: Any,
            tables: Any,
            camera_numbers: Any,
            lens: Any,
            texels: Any,
            sky: Any,
            blurred: Any,
        ) -> Any:
            """Trace all rays; arguments are Dr.Jit arrays, see `_trace`."""
            light_maps = replace(lit, texels=texels, sky=sky, blurred=blurred)
            return self._trace(
                mitsuba_scene, lane, tables, camera_numbers, lens, light_maps
            )

        return trace

    def _trace(
        self,
        mitsuba_scene: Any,
        lane: Any,
        tables: Any,
        camera_numbers: Any,
        lens: Any,
        lit: LightMaps,
    ) -> list[Any]:
        """Trace all rays: the recorded kernel.

        Rays go through cut-outs layer by layer. Each layer stops a fraction of the
        light that is left of a ray; the last layer stops all of it.

        Args:
            mitsuba_scene: the scene.
            lane: index of each ray; rays are in the order of camera, row, column, and
                ray of the pixel.
            tables: tables of `Lobes` of all surfaces, flat.
            camera_numbers: `CAMERA_SIZE` numbers for each camera, flat.
            lens: flat table, as from `_make_lens_table`.
            lit: the light.

        Returns:
            For each pixel the three channels of radiance without what the searched
            texture reflects diffusely, and coverage. Then for each layer and each ray
            u, v and weight of the searched texture. The weight is 0 where the ray does
            not meet the texture, and negative where it meets its back.
        """
        ray, active = self._make_rays(lane, camera_numbers, lens)
        direction = ray.d
        to_local = texel_rays.get_world_to_map(self._scene)
        ray_flags = mi.RayFlags.UV | mi.RayFlags.ShadingFrame

        # number of layers of cut-outs; one opaque layer follows
        n_layers = texel_rays.count_cut_out_layers(self._scene)
        texture_channels = []
        radiance = mi.Color3f(0.0)
        coverage = mi.Float(0.0)
        transmittance = mi.Float(1.0)  # fraction of a ray's light that is left
        for layer in range(n_layers + 1):
            # Camera rays are coherent: neighbors take similar paths.
            si = mitsuba_scene.ray_intersect(
                ray, ray_flags, coherent=layer == 0, active=active
            )
            is_hit = active & si.is_valid()
            is_last = layer == n_layers
            stopped_fraction = _compute_stopped_light(
                si, is_hit, transmittance, is_last=is_last
            )
            surface_radiance, diffuse, side = self._shade(
                mitsuba_scene, si, is_hit, direction, tables, lit
            )
            radiance += dr.select(is_hit, stopped_fraction * surface_radiance, 0.0)
            # What is left of a ray that meets nothing more is the sky. It is not active
            # in the next layers.
            escapes = active & ~si.is_valid()
            sky_radiance = _look_up_sky(lit, direction, to_local)
            radiance += dr.select(escapes, transmittance * sky_radiance, 0.0)
            coverage += dr.select(is_hit, stopped_fraction / RAYS_PER_PIXEL, 0.0)
            texture_channels += _list_texture_channels(
                si, side, stopped_fraction, diffuse
            )
            transmittance = transmittance - stopped_fraction
            active = is_hit & (transmittance > MIN_TRANSMITTANCE)
            ray = si.spawn_ray(direction)
        radiance /= RAYS_PER_PIXEL
        # Evaluated at once: otherwise the kernel of each channel's sum would trace all
        # rays again.
        dr.eval(radiance, coverage, texture_channels)
        return [*_sum_over_pixels([*radiance, coverage]), *texture_channels]

    def _make_rays(self, lane: Any, camera_numbers: Any, lens: Any) -> tuple[Any, Any]:
        """Return the ray of each lane, and whether the lens has one there.

        Args:
            lane: index of each ray; rays are in the order of camera, row, column, and
                ray of the pixel.
            camera_numbers: `CAMERA_SIZE` numbers for each camera, flat, as from
                `_make_camera_numbers`.
            lens: four numbers for each ray of an image, as from `_make_lens_table`.
        """
        height, width = self._scene.resolution
        camera_index = lane // RAYS_PER_PIXEL // (height * width)
        camera = _gather_camera(camera_numbers, camera_index)
        if self._lens is None:
            x, y, z = self._compute_pinhole_direction(lane, camera.film_numbers)
            active = mi.Bool(True)
        else:
            x, y, z, active = self._look_up_lens_direction(lane, lens)
        axes = zip(camera.left, camera.up, camera.forward, strict=True)
        direction = mi.Vector3f(
            *(left * x + up * y + forward * z for left, up, forward in axes)
        )
        return mi.Ray3f(mi.Point3f(*camera.position), dr.normalize(direction)), active

    def _look_up_lens_direction(
        self, lane: Any, lens: Any
    ) -> tuple[Any, Any, Any, Any]:
        """Return the direction of each ray of a lens in the camera's axes.

        The fourth value is whether the lens has a ray there. The arguments are those of
        `_make_rays`.
        """
        height, width = self._scene.resolution
        # The table, four numbers for each ray, is the same for all cameras.
        entry = 4 * (lane % (height * width * RAYS_PER_PIXEL))
        x = dr.gather(mi.Float, lens, entry)
        y = dr.gather(mi.Float, lens, entry + 1)
        z = dr.gather(mi.Float, lens, entry + 2)
        active = dr.gather(mi.Float, lens, entry + 3) > 0.0
        return x, y, z, active

    def _compute_pinhole_direction(
        self, lane: Any, film_numbers: Sequence[Any]
    ) -> tuple[Any, Any, Any]:
        """Return the direction of each ray of a pinhole in the camera's axes.

        The axes are left, up and forward. The direction has the length 1 forward.

        Args:
            lane: index of each ray.
            film_numbers: the last four numbers from `_make_camera_numbers`.
        """
        height, width = self._scene.resolution
        pixel = lane // RAYS_PER_PIXEL % (height * width)
        x_offset, y_offset = _select_ray_offset(lane % RAYS_PER_PIXEL)
        half_width, half_height, center_x, center_y = film_numbers
        # Columns count from the left and rows from the top. The camera's x points to
        # the left and its y up, so both are subtracted. The center is at 1 of an image
        # that is 2 wide.
        column = mi.Float(pixel % width) + x_offset
        row = mi.Float(pixel // width) + y_offset
        x = (center_x - 2.0 * column / width) * half_width
        y = (center_y - 2.0 * row / height) * half_height
        return x, y, mi.Float(1.0)

    def _shade(
        self,
        mitsuba_scene: Any,
        si: Any,
        is_hit: Any,
        direction: Any,
        tables: Any,
        lit: LightMaps,
    ) -> tuple[Any, Any, Any]:
        """Shade the surface that each ray hits.

        Args:
            mitsuba_scene: the scene.
            si: surface interactions of the rays.
            is_hit: lanes in which the ray hits a surface.
            direction: unit directions of the rays.
            tables: tables of `Lobes` of all surfaces, flat.
            lit: the light.

        Returns:
            The radiance of the surface, without what the searched texture reflects
            diffusely; the diffuse fraction of its reflection; and 1 on the front of the
            searched texture, -1 on its back, 0 elsewhere.
        """
        to_local = texel_rays.get_world_to_map(self._scene)
        grid_masks = texel_rays.find_hit_grids(
            mitsuba_scene, self._grids, si, direction
        )
        masks = [mask & is_hit for mask in grid_masks]
        normal = _turn_to_viewer(si.sh_frame.n, direction)
        cosine = -dr.dot(normal, direction)
        # in the order of `LOBE_TABLES`: up, along, core and tail follow
        diffuse, gloss, *lobe_shape = self._look_up_lobes(masks, cosine, tables)

        # Diffuse light. That of the texture that is searched is left to the matrix.
        diffuse_radiance = self._look_up_diffuse(si, masks, lit, to_local)
        side = self._find_texture_side(masks)
        radiance = dr.select(
            side != 0.0, 0.0, diffuse_radiance * dr.select(is_hit, diffuse, 1.0)
        )

        is_glossy = is_hit & (gloss > 1e-4)  # less is not visible
        reflected = self._reflect(
            mitsuba_scene, si, direction, normal, lobe_shape, is_glossy, lit
        )
        radiance += dr.select(is_glossy, gloss * reflected, 0.0)
        return radiance, diffuse, side

    def _find_texture_side(self, masks: Sequence[Any]) -> Any:
        """Return 1 on the front of the searched texture, -1 on its back, else 0.

        All grids but the ground's are on the object, which has the texture.

        Args:
            masks: for each grid whether a hit is on it.
        """
        side = mi.Float(0.0)
        for grid, mask in zip(self._grids, masks, strict=True):
            if not grid.is_ground:
                # A single grid of both sides (0) counts as the front.
                grid_side = -1.0 if grid.face_side < 0 else 1.0
                side = dr.select(mask, grid_side, side)
        return side

    def _look_up_lobes(
        self, masks: Sequence[Any], cosine: Any, tables: Any
    ) -> list[Any]:
        """Look up the tables of `Lobes` at a cosine of the angle of view.

        Between its entries a table is interpolated linearly.

        Args:
            masks: for each surface whether it was hit. If none was, the values are
                those of the first surface.
            cosine: cosine of the angle between the normal and the viewer.
            tables: tables of all surfaces, one after the other, flat.

        Returns:
            One value for each of `LOBE_TABLES`.
        """
        n_tables = len(texel_rays.LOBE_TABLES)
        surface_start = _find_lobe_tables(masks)  # first entry of the surface's tables
        # entry i is for the cosine (i + 0.5) / N_ANGLES
        position = dr.clip(
            cosine * texel_rays.N_ANGLES - 0.5, 0.0, texel_rays.N_ANGLES - 1.0
        )
        lower = dr.minimum(mi.UInt32(position), texel_rays.N_ANGLES - 2)
        fraction = position - mi.Float(lower)
        values = []
        for index in range(n_tables):
            entry = surface_start + index * texel_rays.N_ANGLES + lower
            values.append(_lerp_entries(tables, entry, fraction))
        return values

    def _reflect(
        self,
        mitsuba_scene: Any,
        si: Any,
        view_direction: Any,
        normal: Any,
        lobe_shape: Sequence[Any],
        active: Any,
        lit: LightMaps,
    ) -> Any:
        """Return the radiance that the gloss of a surface reflects.

        A second ray, in the mean direction of the lobe, finds what is reflected. If the
        ray meets the object, that is one texel. If it meets nothing, it is the
        environment, blurred by the width of the lobe. If it meets the ground, it is a
        mixture of both: the wider the lobe, the more the blurred environment counts.

        Args:
            mitsuba_scene: the scene.
            si: surface interactions of the rays that hit the surface.
            view_direction: unit directions of these rays.
            normal: unit shading normals, towards the viewer.
            lobe_shape: up, along, core and tail of `Lobes` at the angle of view: the
                components of the mean direction along normal and tangent, and the
                angles by which the two halves of the lobe spread.
            active: lanes in which there is any gloss.
            lit: the light.
        """
        up, along, core, tail = lobe_shape
        direction = _compute_lobe_direction(view_direction, normal, up, along)
        hit = texel_rays.find_opaque_hits(
            mitsuba_scene,
            mi.Ray3f(si.p + normal * texel_rays.RAY_OFFSET, direction),
            texel_rays.count_cut_out_layers(self._scene),
            active=active,
        )
        masks = texel_rays.find_hit_grids(mitsuba_scene, self._grids, hit, direction)
        blurred = self._look_up_lobe(si, direction, core, tail, lit)
        texel = self._look_up_texel(hit, masks, lit)
        is_ground = self._is_on_ground(masks)
        # `texel` is one of the ground where `is_ground`; elsewhere this is not used.
        ground = self._blend_ground(hit, masks, texel, blurred, (core, tail), lit)
        surface = dr.select(is_ground, ground, texel)
        return dr.select(hit.is_valid(), surface, blurred)

    def _is_on_ground(self, masks: Sequence[Any]) -> Any:
        """Return whether a hit is on a ground, by the masks of hits on all grids."""
        is_ground = mi.Bool(False)
        for grid, mask in zip(self._grids, masks, strict=True):
            is_ground |= mask & grid.is_ground
        return is_ground

    def _look_up_lobe(
        self, si: Any, direction: Any, core: Any, tail: Any, lit: LightMaps
    ) -> Any:
        """Return the radiance of the blurred surroundings in a lobe.

        Half of the gloss is in the core of the lobe, half in its tail.

        Args:
            si: surface interactions from which the lobes go out.
            direction: mean directions of the lobes.
            core, tail: angles by which both halves spread, radians.
            lit: the light.
        """
        to_local = texel_rays.get_world_to_map(self._scene)
        map_direction = self._correct_parallax(si, direction)
        return 0.5 * sum(
            _look_up_blurred(lit, map_direction, to_local, spread, self._widths)
            for spread in (core, tail)
        )

    def _blend_ground(
        self,
        hit: Any,
        masks: Sequence[Any],
        texel: Any,
        blurred: Any,
        spreads: tuple[Any, Any],
        lit: LightMaps,
    ) -> Any:
        """Return the radiance that a lobe reflects of the ground.

        A wide lobe reflects much of the ground, but one ray meets a single point of it.
        So the wider the lobe, the more the blurred map of the surroundings counts. It
        is multiplied by the brightness of the ground at this point, which the object
        may shade, relative to that far away.

        Args:
            hit: surface interactions of the reflected rays.
            masks: for each grid whether the hit is on it.
            texel: value of the texel that is hit.
            blurred: radiance of the blurred surroundings in the lobe.
            spreads: angles by which core and tail of the lobe spread, radians.
            lit: the light.
        """
        # The cell after those of all grids is the ground far away, which is lit by the
        # environment alone.
        far_cell = mi.UInt32(self._grids[-1].first_cell_index + self._grids[-1].n_cells)
        far_texel = _gather_color(lit.texels, far_cell)
        relative_brightness = texel / far_texel
        to_local = texel_rays.get_world_to_map(self._scene)
        ground = self._look_up_diffuse(hit, masks, lit, to_local)
        wideness = _compute_wideness(*spreads)
        return ground + wideness * (blurred * relative_brightness - ground)

    def _correct_parallax(self, si: Any, direction: Any) -> Any:
        """Return the direction in which to look up the blurred maps for a ray from a
        hit.

        The maps show what surrounds the object as seen from its center. Where the ray
        meets the ground (z = 0), the result is the direction from the center to the
        same point. A direction that is level or goes up, or a scene without ground,
        needs no correction.
        """
        if not any(grid.is_ground for grid in self._grids):
            return direction
        # along the ray to z = 0; 1e-3 avoids a division by 0
        distance = si.p.z / dr.maximum(-direction.z, 1e-3)
        from_center = si.p + direction * distance - mi.Point3f(*self._center)
        return dr.select(direction.z < -1e-3, dr.normalize(from_center), direction)

    def _look_up_diffuse(
        self, si: Any, masks: Sequence[Any], lit: LightMaps, to_local: Any
    ) -> Any:
        """Return the diffuse radiance of what was hit.

        On a photographed ground the texels hold factors instead of radiance. They are
        multiplied by the photograph, in the direction from the point where it was
        taken.

        Args:
            si: the hit.
            masks: for each grid whether the hit is on it.
            lit: the light.
            to_local: rotation from the world to the map, as from `get_world_to_map`.
        """
        radiance = self._look_up_texel(si, masks, lit)
        if self._photograph_height is not None:
            below = dr.normalize(si.p - mi.Point3f(0.0, 0.0, self._photograph_height))
            for grid, mask in zip(self._grids, masks, strict=True):
                if grid.is_ground:
                    photograph = _look_up_sky(lit, below, to_local)
                    radiance = dr.select(mask, radiance * photograph, radiance)
        return radiance

    def _look_up_texel(self, si: Any, masks: Sequence[Any], lit: LightMaps) -> Any:
        """Look up the radiance of the texels around a hit, bilinearly; 0 on no grid.

        `LightMaps.texels` holds a color for each cell of all grids.

        Args:
            si: surface interaction of the hit.
            masks: for each grid whether the hit is on it.
            lit: the light.
        """
        position = self._find_grid_positions(si, masks)
        # Rows and columns are integers at the centers of cells.
        row = position.y * mi.Float(position.n_rows) - 0.5
        column = position.x * mi.Float(position.n_columns) - 0.5
        radiance = _look_up_bilinear(
            lit.texels,
            position.first_cell,
            position.n_rows,
            position.n_columns,
            row,
            column,
        )
        return dr.select(position.on_any_grid, radiance, 0.0)

    def _find_grid_positions(self, si: Any, masks: Sequence[Any]) -> _GridPosition:
        """Return the grid of texels on which each hit is, and where in that grid.

        Args:
            si: surface interaction of the hit.
            masks: for each grid whether the hit is on it.
        """
        first_cell = mi.UInt32(0)
        n_rows = mi.UInt32(1)
        n_columns = mi.UInt32(1)
        y = mi.Float(0.0)
        x = mi.Float(0.0)
        on_any_grid = mi.Bool(False)
        for grid, mask in zip(self._grids, masks, strict=True):
            grid_y, grid_x = texel_rays.compute_grid_position(grid, si.p, si.uv)
            y = dr.select(mask, grid_y, y)
            x = dr.select(mask, grid_x, x)
            on_any_grid = on_any_grid | mask
            first_cell = dr.select(mask, mi.UInt32(grid.first_cell_index), first_cell)
            n_rows = dr.select(mask, mi.UInt32(grid.shape[0]), n_rows)
            n_columns = dr.select(mask, mi.UInt32(grid.shape[1]), n_columns)
        return _GridPosition(first_cell, n_rows, n_columns, y, x, on_any_grid)


def _join_lobe_tables(lobes: Sequence[texel_rays.Lobes]) -> Float32Array:
    """Return the tables of all surfaces, flat: the six of the first, then the next.

    The tables of a surface are in the order of `LOBE_TABLES`.
    """
    tables_of_surfaces = [
        np.concatenate([getattr(surface, name) for name in texel_rays.LOBE_TABLES])
        for surface in lobes
    ]
    return np.concatenate(tables_of_surfaces).astype(np.float32)


class _GridPosition(NamedTuple):
    """Where hits lie in grids of texels, one value in each lane.

    A hit on no grid has a grid of a single cell.
    """

    first_cell: Any  # index of the grid's first cell among the cells of all grids
    n_rows: Any
    n_columns: Any
    y: Any  # fraction of the grid's height
    x: Any  # fraction of its width
    on_any_grid: Any  # whether the hit is on a grid


def _lerp_entries(table: Any, entry: Any, fraction: Any) -> Any:
    """Interpolate between an entry of a flat table and the next one."""
    lower_value = dr.gather(mi.Float, table, entry)
    upper_value = dr.gather(mi.Float, table, entry + 1)
    return lower_value + fraction * (upper_value - lower_value)


class _CameraNumbers(NamedTuple):
    """The numbers of a camera, one value in each lane, see `_make_camera_numbers`."""

    left: list[Any]  # x, y and z of the axis to the left
    up: list[Any]
    forward: list[Any]
    position: list[Any]
    film_numbers: list[Any]  # the last four, which only a pinhole needs


def _gather_camera(camera_numbers: Any, camera_index: Any) -> _CameraNumbers:
    """Return the numbers of each lane's camera, from a flat array for all cameras."""
    first = camera_index * CAMERA_SIZE
    numbers = [
        dr.gather(mi.Float, camera_numbers, first + index)
        for index in range(CAMERA_SIZE)
    ]
    return _CameraNumbers(
        left=numbers[0:3],
        up=numbers[3:6],
        forward=numbers[6:9],
        position=numbers[9:12],
        film_numbers=numbers[12:],
    )


def _compute_stopped_light(
    si: Any, is_hit: Any, transmittance: Any, *, is_last: bool
) -> Any:
    """Return the fraction of a ray's light that one layer of surfaces stops.

    Args:
        si: surface interactions of the rays in this layer.
        is_hit: lanes in which the ray hits a surface.
        transmittance: fraction of the light that is left before the layer.
        is_last: whether this layer is the last one, which stops all that is left.
    """
    if is_last:
        return transmittance
    opacity = 1.0 - texel_rays.eval_transmittance(si, is_hit)
    return transmittance * opacity


def _sum_over_pixels(channels: list[Any]) -> list[Any]:
    """Return the sum over the rays of each pixel, for channels with one value a ray."""
    return [dr.block_sum(channel, RAYS_PER_PIXEL) for channel in channels]


def _list_texture_channels(
    si: Any, side: Any, stopped_fraction: Any, diffuse: Any
) -> list[Any]:
    """Return u, v and weight of the searched texture for one layer of all rays.

    Args:
        si: surface interactions of the rays.
        side: 1 on the texture's front, -1 on its back, 0 elsewhere, so that u and v
            there do not matter.
        stopped_fraction: fraction of a ray's light that the surface stops.
        diffuse: diffuse fraction of its reflection.
    """
    # The diffuse radiance of a base color c under an irradiance E is diffuse c E / pi.
    weight = side * stopped_fraction * diffuse / (math.pi * RAYS_PER_PIXEL)
    return [si.uv.x, si.uv.y, weight]


def _find_lobe_tables(masks: Sequence[Any]) -> Any:
    """Return the index of the first entry of the tables of the surface that was hit.

    `masks` are for each surface whether it was hit. The tables are those of
    `LOBE_TABLES`, one surface after the other.
    """
    n_entries = len(texel_rays.LOBE_TABLES) * texel_rays.N_ANGLES
    surface_start = mi.UInt32(0)
    for index, mask in enumerate(masks):
        surface_start = dr.select(mask, mi.UInt32(index * n_entries), surface_start)
    return surface_start


def _compute_lobe_direction(
    view_direction: Any, normal: Any, up: Any, along: Any
) -> Any:
    """Return the mean direction of a lobe by its components, see `Lobes`.

    Args:
        view_direction: unit directions from the viewer to the surface.
        normal: unit shading normals, towards the viewer.
        up, along: components of the mean direction along normal and tangent.
    """
    cosine = -dr.dot(normal, view_direction)
    # The part of the direction along the surface. A ray along the normal has none,
    # and without the 1e-8 its zeros would be normalized to NaN.
    tangent = dr.normalize(view_direction + normal * cosine + 1e-8)
    return dr.normalize(normal * up + tangent * along)


def _turn_to_viewer(normal: Any, direction: Any) -> Any:
    """Return normals turned over where a ray in a direction comes from behind."""
    is_from_behind = dr.dot(normal, direction) > 0.0
    return dr.select(is_from_behind, -normal, normal)


def _join_camera_numbers(
    cameras: Sequence[Mapping[str, Tensor]], height: int, width: int
) -> Float32Array:
    """Return the `CAMERA_SIZE` numbers of all cameras, one after the other, flat.

    Args:
        cameras: inputs of each camera, as for `_make_camera_numbers`.
        height, width: size of the image in pixels.
    """
    rows = [_make_camera_numbers(inputs, height, width) for inputs in cameras]
    return np.stack(rows).astype(np.float32).ravel()


def _make_camera_numbers(
    inputs: Mapping[str, Tensor], height: int, width: int
) -> Float32Array:
    """Return the `CAMERA_SIZE` numbers of a camera as the kernel takes them.

    They are its axes to the left, up and forward (9 numbers), its position (3), half
    the width and half the height of the image at distance 1 (2), and the x and y of the
    image's center (2), which are 1 without a shift. The last four are used only for a
    pinhole.

    Args:
        inputs: the camera's inputs: `camera.to_world` (4, 4), and for a pinhole
            `camera.fov` in degrees, `camera.shift_x` and `camera.shift_y`.
        height, width: size of the image in pixels.
    """
    matrix = inputs["camera.to_world"].detach().double().numpy()
    half_tangent = 0.0
    if "camera.fov" in inputs:
        half_tangent = math.tan(math.radians(float(inputs["camera.fov"])) / 2.0)
    # The field of view is along the larger side.
    larger_side = max(height, width)
    half_extent = [half_tangent * size / larger_side for size in (width, height)]
    # The viewing axis meets the image at the fraction 0.5 - shift of its width and
    # height. Here both are 2, which gives 1 - 2 shift.
    shifts = [float(inputs.get(f"camera.shift_{axis}", 0.0)) for axis in "xy"]
    center = [1.0 - 2.0 * shift for shift in shifts]
    # The columns of the matrix are the axes. Transposed, they follow one another.
    axes = matrix[:3, :3].T.ravel()
    position = matrix[:3, 3]
    return np.concatenate([axes, position, half_extent, center])


def _fetch(channels: Sequence[Any], size: tuple[int, int, int]) -> ViewSamples:
    """Copy the kernel's results from Dr.Jit to torch.

    Samples without weight are left out.

    Args:
        channels: what `ViewTracer._trace` returns: three channels of radiance, the
            coverage, and then u, v and weight for each layer of cut-outs. A negative
            weight is that of a back.
        size: number of cameras, rows and columns.
    """
    with prediction.mitsuba_lock:
        # The first channels are three of radiance, and the coverage.
        radiance = np.stack([channel.numpy() for channel in channels[:3]], axis=-1)
        # A copy, since `numpy` may return memory that belongs to Dr.Jit.
        coverage = channels[3].numpy().copy()
        n_layers = (len(channels) - N_IMAGE_CHANNELS) // 3
        u, v, weight = _stack_layers(channels[N_IMAGE_CHANNELS:])
        (hits,) = np.nonzero(weight)
        # A hit is an index into these: ray * n_layers + layer.
        ray = hits // n_layers
        return ViewSamples(
            radiance=torch.from_numpy(radiance).reshape(*size, 3),
            coverage=torch.from_numpy(coverage).reshape(*size, 1),
            ray_index=torch.from_numpy(ray),
            uv=torch.from_numpy(np.stack([u[hits], v[hits]], axis=1)),
            diffuse_weight=torch.from_numpy(np.abs(weight[hits])),
            is_back=torch.from_numpy(weight[hits] < 0.0),
        )


def _stack_layers(channels: Sequence[Any]) -> list[Float32Array]:
    """Return u, v and weight of all rays and layers, each (rays x layers,).

    The channels are u, v and weight of the first layer, then those of the next one. In
    the result all layers of a ray are side by side.
    """
    layer_channels = [channel.numpy() for channel in channels]
    return [np.stack(layer_channels[index::3], axis=1).ravel() for index in range(3)]


def _look_up_bilinear(
    values: Any,
    first_cell: Any,
    n_rows: Any,
    n_columns: Any,
    y: Any,
    x: Any,
    *,
    wraps: bool = False,
) -> Any:
    """Interpolate a color between the four nearest cells of a grid.

    Args:
        values: flat array of colors, with four numbers for each cell.
        first_cell: index of the grid's first cell in that array.
        n_rows, n_columns: number of rows and number of columns of the grid.
        y, x: row and column, integers at the centers of cells.
        wraps: whether the last column is next to the first; otherwise the grid ends at
            its border.
    """
    # beyond the border the cells at the border count
    y = dr.clip(y, 0.0, mi.Float(n_rows) - 1.0)
    upper = mi.UInt32(y)
    y_fraction = y - dr.floor(y)
    lower = dr.minimum(upper + 1, n_rows - 1)
    left, right, x_fraction = _find_neighbor_columns(x, n_columns, wraps)

    upper_start = first_cell + upper * n_columns
    lower_start = first_cell + lower * n_columns
    above = _lerp_cells(values, upper_start + left, upper_start + right, x_fraction)
    below = _lerp_cells(values, lower_start + left, lower_start + right, x_fraction)
    return above * (1.0 - y_fraction) + below * y_fraction


def _lerp_cells(values: Any, left: Any, right: Any, fraction: Any) -> Any:
    """Interpolate between the colors of two cells, by their indices in a flat array."""
    left_color = _gather_color(values, left) * (1.0 - fraction)
    return left_color + _gather_color(values, right) * fraction


def _find_neighbor_columns(x: Any, n_columns: Any, wraps: bool) -> tuple[Any, Any, Any]:
    """Return the columns to the left and right of positions, and the fraction between.

    The arguments are those of `_look_up_bilinear`.
    """
    if wraps:
        x = dr.select(x < 0.0, x + mi.Float(n_columns), x)
        left = mi.UInt32(x)
        return left % n_columns, (left + 1) % n_columns, x - dr.floor(x)
    # beyond the border the cells at the border count
    x = dr.clip(x, 0.0, mi.Float(n_columns) - 1.0)
    left = mi.UInt32(x)
    return left, dr.minimum(left + 1, n_columns - 1), x - dr.floor(x)


def _compute_wideness(core: Any, tail: Any) -> Any:
    """Return how wide a lobe is, from 0 at `MIN_BLENDED_SPREAD` to 1 at the maximum.

    `core` and `tail` are the angles of `Lobes`; the spread of both halves together is
    compared.
    """
    spread = dr.sqrt(0.5 * (core * core + tail * tail))
    return dr.clip(
        (spread - MIN_BLENDED_SPREAD) / (MAX_BLENDED_SPREAD - MIN_BLENDED_SPREAD),
        0.0,
        1.0,
    )


def _gather_color(values: Any, index: Any) -> Any:
    """Return the colors with indices in a flat array, which has four numbers for each.

    The last number is not used. To gather four is faster on the processor than three.
    """
    return mi.Color3f(*dr.gather(mi.Vector4f, values, index)[:3])


def _look_up_sky(lit: LightMaps, direction: Any, to_local: Any) -> Any:
    """Look up the environment in a direction, as Mitsuba does.

    The first row of the map is centered at one pole, the last row at the other. The map
    has a copy of the opposite column at each end, so that a look-up there needs no
    wrapping.

    Args:
        lit: the light.
        direction: unit directions in the world.
        to_local: rotation from the world to the map, as from `get_world_to_map`.
    """
    n_rows, n_columns = lit.sky_shape
    x, y = texel_rays.compute_map_position(direction, to_local)
    # n - 2 columns without the copies; + 1 for the copy at the left, and - 0.5 to the
    # center of a column
    column = x * (n_columns - 2) + 0.5
    row = y * (n_rows - 1)
    return _look_up_bilinear(
        lit.sky, mi.UInt32(0), mi.UInt32(n_rows), mi.UInt32(n_columns), row, column
    )


def _look_up_blurred(
    lit: LightMaps, direction: Any, to_local: Any, spread: Any, widths: Sequence[float]
) -> Any:
    """Look up the environment blurred by a root mean square angle `spread`, in radians.

    There is a map for each of `widths`. Each width is twice the one before, so the
    logarithm to base 2 finds the two maps between which the value is interpolated. For
    a spread below or above all widths it is the first or the last map.

    Args:
        lit: the light, with the blurred maps.
        direction: unit directions in the world.
        to_local: rotation from the world to the map, as from `get_world_to_map`.
        spread: the angle, one in each lane.
        widths: root mean square angles of the maps, radians.
    """
    n_rows, n_columns = lit.blurred_shape
    level = _compute_blur_level(spread, widths)
    # at most the last but one, so that there is a next map
    lower_level = dr.minimum(mi.UInt32(level), max(0, len(widths) - 2))
    x, y = texel_rays.compute_map_position(direction, to_local)
    row = y * n_rows - 0.5
    column = x * n_columns - 0.5
    narrow = _look_up_level(lit, lower_level, row, column)
    # if there is one width, this counts 0
    wide = _look_up_level(lit, lower_level + 1, row, column)
    return narrow + (level - mi.Float(lower_level)) * (wide - narrow)


def _look_up_level(lit: LightMaps, index: Any, row: Any, column: Any) -> Any:
    """Look up the blurred map with an index; maps follow one another in memory.

    Rows and columns are integers at the centers of texels.
    """
    n_rows, n_columns = lit.blurred_shape
    return _look_up_bilinear(
        lit.blurred,
        index * (n_rows * n_columns),
        mi.UInt32(n_rows),
        mi.UInt32(n_columns),
        row,
        column,
        wraps=True,
    )


def _compute_blur_level(spread: Any, widths: Sequence[float]) -> Any:
    """Return the index of the blurred map for a spread, with a fraction between maps.

    The arguments are those of `_look_up_blurred`.
    """
    level = dr.log2(dr.maximum(spread, 1e-4) / widths[0])
    return dr.clip(level, 0.0, len(widths) - 1.0)
