"""Compute the light on an object and its surroundings that stand still.

If object, surroundings and lights do not move, the irradiance E of a point is the same
for every camera, so that

    radiance(pixel) = mean over its rays of
                          diffuse(angle) base color E / pi
                          + gloss(angle) x light in its lobe,
                      or of the environment where a ray escapes

with `diffuse`, `gloss` and the lobe of the surface measured by sampling its BSDF.
Images have no noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
import scipy.sparse
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.extend import assets, color, prediction
from advsearch.predictors.surface_light import texels
from advsearch.predictors.surface_light.texel_rays import (
    Ints,
    Lobes,
    compute_visible_cosines,
    get_world_to_map,
    is_visible_from_behind,
    measure_lobes,
    trace_texel_rays,
)
from advsearch.predictors.surface_light.view_rays import (
    RAYS_PER_PIXEL,
    LightMaps,
    ViewSamples,
    ViewTracer,
    make_light_maps,
)

BoolArray: TypeAlias = assets.BoolArray
Float32Array: TypeAlias = assets.Float32Array
IntArray: TypeAlias = assets.IntArray


class SurfaceView:
    """View of one camera: a matrix from light on the object to pixels.

    Attributes:
        base_radiance: (H, W, 3) radiance of everything but the object's base color.
        coverage: (H, W, 1) fraction of each pixel that surfaces cover.
        matrix: sparse (pixels, sides x cells of the fine grid). If the object's back
            stores light of its own, the second half of the columns is the back.

    Args:
        samples: samples of all cameras.
        camera_index: index of the camera.
        shape: rows and columns of the fine grid.
        sides: number of sides of the object that store light of their own.
    """

    def __init__(
        self,
        samples: ViewSamples,
        camera_index: int,
        shape: tuple[int, int],
        sides: int = 1,
    ) -> None:
        """Make the sparse matrix from light on the surface to the pixels of one camera.

        Its rows are the pixels, its columns the cells of the fine grid. Each ray that
        hits the surface adds four entries to its pixel's row: the weights of a bilinear
        look-up, each times the weight of the ray.

        Args:
            samples: rays of all cameras of one launch that hit the object.
            camera_index: index of this view's camera in that launch.
            shape: rows and columns of the fine grid.
            sides: number of sides of the surface that have light of their own, 1 or 2.
        """
        self.base_radiance = samples.radiance[camera_index]
        self.coverage = samples.coverage[camera_index]
        n_pixels = self.base_radiance.shape[0] * self.base_radiance.shape[1]
        n_cells = shape[0] * shape[1]
        selected = _find_camera_samples(samples, camera_index, n_pixels)
        first_ray = camera_index * n_pixels * RAYS_PER_PIXEL
        pixel = (samples.ray_index[selected] - first_ray) // RAYS_PER_PIXEL
        columns, weights = _find_cell_weights(samples, selected, shape)
        # The samples are sorted by pixel, and each has four entries. So the entries of
        # row p begin at 4 times the number of samples in the pixels before p.
        row_starts = np.searchsorted(pixel.numpy(), np.arange(n_pixels + 1)) * 4
        self.matrix = scipy.sparse.csr_matrix(
            (weights.ravel(), columns.ravel(), row_starts.astype(np.int32)),
            (n_pixels, sides * n_cells),
            copy=False,
        )

    def compute_radiance(self, reflected: Tensor) -> Tensor:
        """Return the radiance (H, W, 3) of the view, differentiable in `reflected`.

        Args:
            reflected: (sides x cells, 3) radiance that the base color reflects in each
                cell of the object's texture grid, from
                `ArrangementLight.compute_reflected`.
        """
        from_object = multiply_sparse(self.matrix, reflected)
        return self.base_radiance + from_object.reshape(self.base_radiance.shape)


def _find_camera_samples(
    samples: ViewSamples, camera_index: int, n_pixels: int
) -> slice:
    """Return which samples are those of a camera's rays.

    Rays are numbered camera after camera, and `samples.ray_index`, the ray of each
    sample, is ascending. So the camera's samples lie between those of its first ray and
    of the next camera's first ray.

    Args:
        samples: samples of all cameras.
        camera_index: index of the camera.
        n_pixels: number of pixels of each camera.
    """
    n_rays = n_pixels * RAYS_PER_PIXEL
    first_rays = torch.tensor([camera_index, camera_index + 1]) * n_rays
    start, end = torch.searchsorted(samples.ray_index, first_rays).tolist()
    return slice(start, end)


def _find_cell_weights(
    samples: ViewSamples, selected: slice, shape: tuple[int, int]
) -> tuple[Ints, Float32Array]:
    """Return the four cells of the fine grid that each sample reads, and their weights.

    Both are (n, 4). The cells of the back follow those of the front.

    Args:
        samples: samples of all cameras.
        selected: the n samples of one camera.
        shape: rows and columns of the fine grid.
    """
    cells, fractions = prediction.find_bilinear_weights(
        samples.uv[selected].numpy(), shape
    )
    is_back = samples.is_back[selected].numpy()
    cells += np.int32(shape[0] * shape[1]) * is_back[:, None]
    return cells, fractions * samples.diffuse_weight[selected].numpy()[:, None]


def multiply_sparse(matrix: scipy.sparse.csr_matrix, columns: Tensor) -> Tensor:
    """Multiply a sparse matrix (n, k) by columns (k, 3); differentiable in the columns.

    PyTorch has no derivative for scipy's matrices, so that the backward pass multiplies
    by the transpose.
    """

    def multiply(factor: scipy.sparse.csr_matrix, values: Tensor) -> Tensor:
        return torch.from_numpy(factor @ values.numpy())

    times = partial(multiply, matrix)
    transposed_times = partial(multiply, matrix.T)
    rows: Tensor = prediction.LinearMap.apply(times, transposed_times, columns)  # type: ignore[no-untyped-call]
    return rows


OBJECT_TEXELS = 160  # texels along each side of the searched object's texture
RAYS_PER_TEXEL = 256  # rays from each texel that sample what it sees
# A texel lies inside something if more than this fraction of its rays meet the back of
# a surface.
BURIED_FRACTION = 0.3
BOUNCES = 4
"""How often light goes from texel to texel.

With the camera's and the sky's segments that makes a path of `MAX_DEPTH`.
"""
# smallest width of the fine grid, on which base color and light are multiplied
MIN_FINE_SIZE = 192
# largest reflectance of a photographed ground for light between surfaces
MAX_GROUND_REFLECTANCE = 0.95
COLOR_INPUT = f"{prediction.OBJECT}.base_color"
ENVIRONMENT_INPUT = "environment.padded"
GROUND_NAME = "ground"
CAMERA_INPUTS = frozenset(
    {"camera.to_world", "camera.fov", "camera.shift_x", "camera.shift_y"}
)
FREE_INPUTS = (
    CAMERA_INPUTS
    | prediction.IMAGE_INPUTS
    | {ENVIRONMENT_INPUT, COLOR_INPUT, "ground.reflectance"}
)
"""Scene inputs that may change without tracing the rays of texels again.

A change of the environment or of a color only needs the light computed again.
"""


@dataclass(frozen=True, eq=False)
class ArrangementLight:
    """Light on the surfaces of an arrangement under one environment."""

    # (sides x cells of the fine grid, 3) irradiance of the object's front, followed by
    # that of its back if the back stores its own
    object_irradiance: Tensor
    maps: LightMaps  # all other light, for look-ups

    @property
    def n_bytes(self) -> int:
        """Memory of the light, bytes."""
        return 4 * (self.object_irradiance.numel() + self.maps.size)

    def compute_reflected(self, fine_color: Tensor) -> Tensor:
        """Return what a base color (cells of the fine grid, 3) reflects on each side.

        The result is differentiable.
        """
        n_sides = len(self.object_irradiance) // len(fine_color)
        return fine_color.repeat(n_sides, 1) * self.object_irradiance


class Arrangement:
    """Object and surroundings in fixed positions, and what their surfaces see.

    Args:
        renderer: renderer of the scene.
        inputs: assembled inputs of the scene, without `FREE_INPUTS`.
        texture_shape: rows and columns of the base color.
        seed: seed of the rays.

    Attributes:
        inputs: scene inputs that do not change.
        texels: texels of all surfaces, in this order: the object's front, its back if
            it stores light of its own, and the ground.
        n_sides: number of sides of the object that store light of their own, 1 or 2.
        fine_shape: rows and columns of the fine grid.
        lobes: lobes of each surface.
        world_to_map: (3, 3) rotation to the axes of the environment's map.
    """

    def __init__(
        self,
        renderer: prediction.Renderer,
        inputs: Mapping[str, Tensor],
        texture_shape: tuple[int, int],
        seed: int,
    ) -> None:
        """Lay texels over all surfaces, trace their views, and measure reflection.

        Args:
            renderer: renderer of the scene.
            inputs: scene inputs, which fix where everything stands. Those that change
                only the finished image are ignored.
            texture_shape: rows and columns of the texture whose color is searched.
            seed: seed of the rays.
        """
        self._scene = renderer.scene
        self.inputs = {
            name: inputs[name] for name in inputs if name not in prediction.IMAGE_INPUTS
        }
        self._scene.set_inputs(self.inputs)
        description = self._scene.description_and_filter[0]
        self._has_ground = description.get_number("ground.size") > 0.0
        # height of the camera that photographed the ground; None for a plain ground
        self._capture_height = (
            None if description.photograph is None else description.capture_height
        )
        self.fine_shape, self._upsampling = _make_fine_grid(texture_shape)
        object_center = self._lay_texels(seed)
        self.lobes = self._measure_lobes()
        self.world_to_map = torch.tensor(
            get_world_to_map(self._scene), dtype=torch.float32
        )
        self._ground_below = self._find_ground_below(object_center)
        self._views = self._make_view_tracer(object_center)

    def _measure_lobes(self) -> list[Lobes]:
        """Return the lobes of each surface.

        Both sides of the object have the same gloss, and the ground has none.
        """
        n_grounds = len(self.texels.grids) - self.n_sides
        object_lobes = [self._measure_object_lobes()] * self.n_sides
        return object_lobes + [Lobes.make_diffuse()] * n_grounds

    def _lay_texels(self, seed: int) -> Float32Array:
        """Lay texels over all surfaces, and find what they see of sky and each other.

        Returns:
            The center (3,) of the object in world space.
        """
        vertices = self._get_object_buffer("vertices")
        normals = self._get_object_buffer("normals")
        object_center: Float32Array = 0.5 * (
            vertices.min(axis=0) + vertices.max(axis=0)
        )
        object_mesh = (
            self._scene.description_and_filter[0].meshes[prediction.OBJECT].mesh
        )
        charts = prediction.rasterize_charts(object_mesh, OBJECT_TEXELS)
        surfaces = self._make_object_texels(charts, vertices, normals)
        self.n_sides = len(surfaces)
        # The ground comes after the sides of the object, so that its index among the
        # grids is `n_sides`.
        if self._has_ground:
            surfaces.append(self._make_ground_texels(object_center))
        self.texels: texels.LitTexels = texels.join_texels(surfaces)
        met_cells = self._trace_texels(seed)
        self._view_matrices = texels.make_view_matrices(
            met_cells, self.texels.texel_of_cell, len(self.texels.positions)
        )
        self._to_fine = self._make_lookup_matrices(
            surfaces, charts, vertices, normals, met_cells
        )
        if self._has_ground:
            self._smooth = self._make_ground_smoothing(surfaces[-1], met_cells)
        return object_center

    def _make_lookup_matrices(
        self,
        surfaces: Sequence[texels.LitTexels],
        charts: prediction.Charts,
        vertices: Float32Array,
        normals: Float32Array,
        met_cells: Ints,
    ) -> list[Tensor]:
        """Return for each side of the object a matrix from texels to the fine grid.

        Args:
            surfaces: texels of each surface; the sides of the object come first.
            charts: rasterized texture coordinates of the object.
            vertices: (V, 3) in world space.
            normals: (V, 3) in world space.
            met_cells: (texels, rays) cells that rays from all texels met.
        """
        # The back has the same texels as the front, but the opposite normals.
        return [
            texels.make_lookup_matrix(
                surfaces[side],
                charts,
                shape=self.fine_shape,
                vertices=vertices,
                normals=normals if side == 0 else -normals,
                buried=self._find_buried(met_cells, side),
            )
            for side in range(self.n_sides)
        ]

    def _make_ground_texels(self, object_center: Float32Array) -> texels.LitTexels:
        """Return the texels of the ground, which goes on from below the object (3,)."""
        is_photographed = self._scene.description_and_filter[0].photograph is not None
        reach = self._compute_ground_reach(is_photographed)
        center = (float(object_center[0]), float(object_center[1]))
        return texels.make_ground_texels(GROUND_NAME, 0.0, reach, center)

    def _trace_texels(self, seed: int) -> Ints:
        """Trace rays from all texels, and return the cells (n, rays) that they meet."""
        return trace_texel_rays(
            self._scene,
            self.texels.grids,
            sky_shape=texels.SKY_SHAPE,
            positions=self.texels.positions,
            normals=self.texels.normals,
            n_rays=RAYS_PER_TEXEL,
            seed=seed,
        )

    def _make_view_tracer(self, object_center: Float32Array) -> ViewTracer:
        """Return the tracer of camera rays, with the lens that the inputs set.

        Args:
            object_center: (3,) center of the object in world space.
        """
        model = self._scene.description_and_filter[0].camera_model
        if model is not None and "camera.lens" in self.inputs:
            model = model.with_intrinsics(self.inputs["camera.lens"])
        return ViewTracer(
            self._scene,
            self.texels.grids,
            self.lobes,
            widths=texels.BLUR_WIDTHS,
            photograph_height=self._capture_height,
            model=model,
            center=object_center,
        )

    def _select_ground(self) -> slice:
        """Return the texels of the ground; it follows the sides of the object."""
        return self.texels.select_grid(self.n_sides)

    def _is_sky(self, cells: Ints) -> BoolArray:
        """Return which of the cells that rays met are the sky's.

        The cells of the sky are numbered after those of all surfaces.
        """
        return np.asarray(cells >= len(self.texels.texel_of_cell))

    def _make_ground_smoothing(
        self, ground: texels.LitTexels, met_cells: Ints
    ) -> Tensor:
        """Return the matrix that smooths the light of the ground.

        Args:
            ground: texels of the ground.
            met_cells: (texels, rays) cells that rays from all texels met.
        """
        # Texels that see nothing of the sky lie under something, and are left out.
        sees_sky = self._is_sky(met_cells[self._select_ground()]).any(axis=1)
        return texels.make_smoothing_matrix(ground, np.asarray(sees_sky))

    def _get_object_buffer(self, buffer: str) -> Float32Array:
        """Return the object's "vertices" or "normals" (V, 3).

        They are those of the inputs, or else of the scene as it was loaded.
        """
        name = f"{prediction.OBJECT}.{buffer}"
        values = (
            self.inputs[name]
            if name in self.inputs
            else self._scene.get_base_value(name)
        )
        rows: Float32Array = values.reshape(-1, 3).numpy()
        return rows

    def _make_object_texels(
        self,
        charts: prediction.Charts,
        vertices: Float32Array,
        normals: Float32Array,
    ) -> list[texels.LitTexels]:
        """Return the texels of the object, as one surface.

        If the back of its faces is visible from outside, there are two surfaces: the
        front and the back. They have the same texels with opposite normals.

        Args:
            charts: rasterised texture coordinates of the object.
            vertices: (V, 3) in world space.
            normals: (V, 3) in world space.
        """
        # The side of a grid says which hits it has: 0 those on both sides of the faces,
        # 1 those on the front, -1 those on the back.
        shared = texels.make_mesh_texels(
            prediction.OBJECT, charts, vertices, normals, side=0
        )
        if not is_visible_from_behind(self._scene, prediction.OBJECT, shared.positions):
            return [shared]
        front = texels.make_mesh_texels(
            prediction.OBJECT, charts, vertices, normals, side=1
        )
        back = texels.make_mesh_texels(
            prediction.OBJECT, charts, vertices, -normals, side=-1
        )
        return [front, back]

    def _compute_ground_reach(self, is_photographed: bool) -> float:
        """Return half the width of the ground; a photographed one has no end."""
        if is_photographed:
            return math.inf
        return self._scene.description_and_filter[0].get_number("ground.size") / 2.0

    def _find_buried(self, met_cells: Ints, side: int) -> BoolArray:
        """Return which texels (n,) of one side of the object lie inside something.

        A ray inside of something meets the back of a face. A texel is buried if more
        than `BURIED_FRACTION` of its rays meet backs. If backs have texels too (two
        sides), the object may be an open shell: then a texel that sees the sky is not
        buried.

        Args:
            met_cells: (n, rays) cell that each ray of a texel met. A negative number is
                something without light, usually a back without texels.
            side: 0 for the front of the object, 1 for its back.
        """
        cells = met_cells[self.texels.select_grid(side)]
        if self.n_sides == 1:
            is_back = cells < 0
            return np.asarray(is_back.mean(axis=1) > BURIED_FRACTION)
        # the grids are the object's front, its back, and the ground's
        back_grid = self.texels.grids[1]
        is_back = (cells >= back_grid.first_cell_index) & (
            cells < back_grid.first_cell_index + back_grid.n_cells
        )
        sees_sky = self._is_sky(cells).any(axis=1)
        return np.asarray((is_back.mean(axis=1) > BURIED_FRACTION) & ~sees_sky)

    def _measure_object_lobes(self) -> Lobes:
        """Measure the reflection of the object at one texel that represents all.

        If the object has an opacity map, one of its most opaque texels is measured:
        where the surface is cut out there is nothing to measure.
        """
        # The object's front is the first grid, so that its texels and cells are
        # numbered from 0.
        front = self.texels.select_grid(0)
        candidates = self._find_opaque_texels(front)
        # Any candidate would do: the gloss is the same all over the object.
        texel = candidates[len(candidates) // 2]
        return measure_lobes(
            self._scene,
            self.inputs,
            self.texels.grids[0],
            self.texels.positions[texel],
            self.texels.normals[texel],
        )

    def _find_opaque_texels(self, front: slice) -> IntArray:
        """Return the texels of the object's front with the largest opacity.

        Without an opacity map these are all. The front is the first grid, so that its
        texels and cells are numbered from 0.
        """
        opacity = (
            self._scene.description_and_filter[0].meshes[prediction.OBJECT].opacity
        )
        candidates = np.arange(front.start, front.stop)
        if opacity is None:
            return candidates
        n_rows, n_columns = self.texels.grids[0].shape
        row, column = np.divmod(self.texels.cell_of_texel[front], n_columns)
        opacity_row = row * opacity.shape[0] // n_rows
        opacity_column = column * opacity.shape[1] // n_columns
        texel_opacity = opacity[opacity_row, opacity_column]
        opaque_texels: IntArray = candidates[texel_opacity >= texel_opacity.max()]
        return opaque_texels

    def _find_ground_below(self, center: Float32Array) -> tuple[Tensor, Tensor]:
        """Find where the blurred maps, seen from the object's center, show the ground.

        A photographed ground takes its color from the environment's map. The color of a
        point is that in its direction from the camera that took the photograph, which
        is not its direction from the object.

        Args:
            center: (3,) center of the object in world space.

        Returns:
            (h, w) whether the ground is visible in each direction of a map; and
            (h, w, 3) the direction from the photograph's camera to that point of the
            ground, in the map's axes. Without a ground the first is False everywhere,
            and the directions mean nothing.
        """
        # Vectors are rows: `v @ world_to_map.T` turns v from the world's axes to the
        # map's, and `v @ world_to_map` turns it back.
        map_directions = texels.compute_directions(texels.BLURRED_SHAPE)
        world_directions = map_directions @ self.world_to_map
        if not self._has_ground:
            is_ground = torch.zeros(texels.BLURRED_SHAPE, dtype=torch.bool)
            return is_ground, map_directions
        goes_down = world_directions[..., 2] < -1e-3
        # The ray from the center meets the ground, z = 0, at this distance. Where a
        # direction does not go down, the point means nothing.
        distance = float(center[2]) / (-world_directions[..., 2]).clamp_min(1e-6)
        points = (
            torch.from_numpy(center).float() + world_directions * distance[..., None]
        )
        is_photographed = self._capture_height is not None
        reach = self._compute_ground_reach(is_photographed)
        is_in_reach = (points[..., :2].abs() <= reach).all(dim=-1)
        # For a plain ground, the directions from here are not used.
        capture_position = torch.tensor([0.0, 0.0, self._capture_height or 0.0])
        photograph_directions = (points - capture_position) @ self.world_to_map.T
        return goes_down & is_in_reach, photograph_directions

    @property
    def n_entries(self) -> int:
        """Number of entries of all matrices, for one color channel."""
        matrices = (*self._view_matrices, *self._to_fine)
        return sum(int(matrix.values().numel()) for matrix in matrices)

    @property
    def n_bytes(self) -> int:
        """Memory of the matrices, bytes: a column index and a value for each entry."""
        return 8 * self.n_entries

    def start_tracing(
        self, cameras: Sequence[Mapping[str, Tensor]], light: ArrangementLight
    ) -> Callable[[], ViewSamples]:
        """Start to trace rays through cameras under a light; see `ViewTracer`."""
        self._scene.set_geometry(self.inputs)
        return self._views(cameras, light.maps)

    def make_view(self, samples: ViewSamples, camera_index: int) -> SurfaceView:
        """Return the view of the camera with an index."""
        return SurfaceView(samples, camera_index, self.fine_shape, self.n_sides)

    def upsample(self, color: Tensor) -> Tensor:
        """Return a base color (h, w, 3) on the fine grid, (cells, 3).

        The result is differentiable.
        """
        flat_color = color.reshape(-1, 3)
        if self._upsampling is None:  # the fine grid has the shape of the texture
            return flat_color
        return multiply_sparse(self._upsampling, flat_color)

    def compute_light(self, padded: Tensor, color: Tensor) -> ArrangementLight:
        """Return the light of an environment, for a base color of the object.

        The base color counts for light between surfaces; what the object itself
        reflects to the camera is left to `ArrangementLight.compute_reflected`.

        Args:
            padded: (H, W + 2, 3) radiance map of the environment, with one more column
                at each end, so that interpolation has no seam.
            color: (h, w, 3) base color of the object, linear.
        """
        with torch.no_grad():
            sky = texels.prepare_sky(padded)
            reflectance = self._compute_reflectance(color, padded)
            irradiance = texels.compute_irradiance(
                self._view_matrices,
                sky,
                self._compute_hot_cosines(sky),
                reflectance,
                BOUNCES,
            )
            # The grids of the object's sides come first.
            side_irradiances = [
                to_fine @ irradiance[self.texels.select_grid(side)]
                for side, to_fine in enumerate(self._to_fine)
            ]
            light_maps = self._make_light_maps(sky, reflectance, irradiance, padded)
            return ArrangementLight(torch.cat(side_irradiances), light_maps)

    def _make_light_maps(
        self,
        sky: texels.SkyLight,
        reflectance: Tensor,
        irradiance: Tensor,
        padded: Tensor,
    ) -> LightMaps:
        """Return the maps in which rays of cameras look up light.

        Args:
            sky: the environment.
            reflectance: (n, 3) reflectance of all texels.
            irradiance: (n, 3) irradiance of all texels.
            padded: (H, W + 2, 3) map of the environment.
        """
        # What a camera sees of each texel: the radiance of a diffuse surface. The
        # texels of a photographed ground get a factor on the photograph instead.
        visible_light = reflectance * irradiance / math.pi
        gloss_map = sky.coarse_map  # what gloss on the object reflects
        # Without a ground the value does not matter: no ray looks it up.
        far_ground = torch.ones(1, 3)
        if self._has_ground:
            ground = self._select_ground()
            visible_light[ground] = self._compute_visible_ground(
                irradiance, visible_light, padded
            )
            far_ground = self._compute_far_ground(visible_light[ground])
            gloss_map = self._put_ground(gloss_map, far_ground, padded)
        texel_of_cell = torch.from_numpy(self.texels.texel_of_cell)
        # One more cell, the last, is the ground beyond all texels.
        cells = torch.cat([visible_light[texel_of_cell], far_ground])
        return make_light_maps(cells, padded, texels.blur_map(gloss_map))

    def _compute_hot_cosines(self, sky: texels.SkyLight) -> Tensor | None:
        """Return the cosines (n, k) of n texels towards k directions of hot light.

        Hot light is far brighter than the map's mean, such as that of the sun. A cosine
        is 0 if something hides the direction from the texel.

        Args:
            sky: the environment, with the directions of its hot light.

        Returns:
            The cosines, or None if nothing is hot.
        """
        hot_directions = sky.hot_directions
        if not len(hot_directions):
            return None
        self._scene.set_geometry(self.inputs)
        cosines = compute_visible_cosines(
            self._scene,
            self.texels.positions,
            self.texels.normals,
            hot_directions.numpy(),
        )
        return torch.from_numpy(cosines)

    def _compute_visible_ground(
        self, irradiance: Tensor, leaving_radiance: Tensor, padded: Tensor
    ) -> Tensor:
        """Return what the camera sees of the ground's texels (n, 3), smoothed.

        For a plain ground that is the radiance that leaves its texels. For a
        photographed ground it is the factor on the photograph, which a shadow darkens:
        the irradiance divided by that under the open sky.

        Args:
            irradiance: (N, 3) irradiance of all texels; the ground's are the last.
            leaving_radiance: (N, 3) radiance that leaves all texels.
            padded: (H, W + 2, 3) map of the environment.
        """
        ground = self._select_ground()
        is_plain = self._capture_height is None
        if is_plain:
            return self._smooth @ leaving_radiance[ground]
        open_irradiance = prediction.compute_open_sky_irradiance(
            padded[:, 1:-1]
        ).clamp_min(1e-12)
        return self._smooth @ (irradiance[ground] / open_irradiance)

    def _compute_far_ground(self, visible_ground: Tensor) -> Tensor:
        """Return what the camera sees of the ground beyond all texels, (1, 3).

        It is the mean of the texels at the border, where the object hides little. The
        four corners are on two sides each, and count twice.

        Args:
            visible_ground: (n, 3) what the camera sees of the ground's texels; every
                cell of the ground's grid is a texel.
        """
        ground_grid = self.texels.grids[-1]
        cells = visible_ground.reshape(*ground_grid.shape, 3)
        border = torch.cat([cells[0], cells[-1], cells[:, 0], cells[:, -1]])
        # Positive, since the view tracer divides by it.
        return border.mean(dim=0, keepdim=True).clamp_min(1e-9)

    def _put_ground(
        self, surroundings: Tensor, far_ground: Tensor, padded: Tensor
    ) -> Tensor:
        """Put the ground into a map (h, w, 3) of what surrounds the object.

        The map is for gloss, and so coarse that all of the ground may have one value.

        Args:
            surroundings: (h, w, 3) map of the environment alone.
            far_ground: (1, 3) value of the ground's far end: a radiance, or for a
                photographed ground the factor on the photograph.
            padded: (H, W + 2, 3) map of the environment.
        """
        is_ground, photograph_directions = self._ground_below
        ground = far_ground
        if self._capture_height is not None:
            # Here `far_ground` is the factor on the photograph.
            photograph = texels.look_up_environment(
                padded, photograph_directions.reshape(-1, 3)
            )
            ground = far_ground * photograph.reshape(*texels.BLURRED_SHAPE, 3)
        return torch.where(is_ground[..., None], ground, surroundings)

    def _compute_reflectance(self, color: Tensor, padded: Tensor) -> Tensor:
        """Return the fraction (n, 3) of light that each texel reflects.

        For light that is the same from all directions it is the base color times the
        diffuse fraction, plus the fraction of the gloss.

        Args:
            color: (h, w, 3) base color of the object.
            padded: (H, W + 2, 3) map of the environment, for a photographed ground.
        """
        # in the order of surfaces and of `lobes`: the object's sides, then the ground
        colors = [self._compute_object_color(color)] * self.n_sides
        if self._has_ground:
            colors.append(self._compute_ground_color(padded))
        reflectances = []
        for surface_color, lobes in zip(colors, self.lobes, strict=True):
            diffuse, gloss = torch.tensor(lobes.mean_reflectances)
            reflectances.append(surface_color * diffuse + gloss)
        return torch.cat(reflectances)

    def _compute_object_color(self, color: Tensor) -> Tensor:
        """Return the mean of a base color (h, w, 3) in each texel (n, 3) of a side."""
        # A small texture has fewer texels than the grid. So the interpolated color is
        # pooled, as it is on the fine grid.
        fine = self.upsample(color).reshape(*self.fine_shape, 3).permute(2, 0, 1)[None]
        front_grid = self.texels.grids[0]
        pooled = functional.adaptive_avg_pool2d(fine, front_grid.shape)[0]
        cell_colors = pooled.permute(1, 2, 0).reshape(-1, 3)
        # The cells of the first grid are numbered from 0.
        front_cells = self.texels.cell_of_texel[self.texels.select_grid(0)]
        return cell_colors[torch.from_numpy(front_cells)]

    def _compute_ground_color(self, padded: Tensor) -> Tensor:
        """Return the base color (n, 3) of the ground's texels.

        A photographed ground has the color with which it looks like its photograph
        under the full sky: radiance = color E / pi, where E is the irradiance.

        Args:
            padded: (H, W + 2, 3) map of the environment.
        """
        ground_points = self.texels.positions[self._select_ground()]
        if self._capture_height is None:  # a plain ground
            srgb = torch.tensor(self._scene.description_and_filter[0].ground_color)
            return color.srgb_to_linear(srgb).expand(len(ground_points), 3)
        capture_position = torch.tensor([0.0, 0.0, self._capture_height])
        world_directions = torch.from_numpy(ground_points) - capture_position
        map_directions = world_directions @ self.world_to_map.T
        photograph = texels.look_up_environment(padded, map_directions)
        open_irradiance = prediction.compute_open_sky_irradiance(
            padded[:, 1:-1]
        ).clamp_min(1e-12)
        return (photograph * math.pi / open_irradiance).clamp_max(
            MAX_GROUND_REFLECTANCE
        )


def _make_fine_grid(
    texture_shape: tuple[int, int],
) -> tuple[tuple[int, int], scipy.sparse.csr_matrix | None]:
    """Return rows and columns of the fine grid, and the matrix from the texture to it.

    The matrix is None if the fine grid has the shape of the texture.
    """
    # The fine grid has this number of cells along each side of a texel.
    refinement = max(1, math.ceil(MIN_FINE_SIZE / min(texture_shape)))
    fine_shape = (texture_shape[0] * refinement, texture_shape[1] * refinement)
    if refinement == 1:
        return fine_shape, None
    return fine_shape, _make_upsampling_matrix(texture_shape, fine_shape)


def _make_upsampling_matrix(
    texture: tuple[int, int], fine: tuple[int, int]
) -> scipy.sparse.csr_matrix:
    """Return the matrix from the texels of a small texture to those of the fine grid.

    The interpolation is bilinear, so that each row of the matrix has four entries.

    Args:
        texture: rows and columns of the texture.
        fine: rows and columns of the fine grid.
    """
    texel, fractions = prediction.find_bilinear_weights(
        _compute_cell_centers(fine), texture
    )
    n_fine = fine[0] * fine[1]
    row_starts = np.arange(n_fine + 1, dtype=np.int32) * 4
    entries = (fractions.ravel(), texel.ravel(), row_starts)
    return scipy.sparse.csr_matrix(entries, (n_fine, texture[0] * texture[1]))


def _compute_cell_centers(shape: tuple[int, int]) -> Float32Array:
    """Return the centers (cells, 2) of a grid's cells, as columns and rows in [0, 1]."""
    n_rows, n_columns = shape
    y, x = np.meshgrid(
        (np.arange(n_rows) + 0.5) / n_rows,
        (np.arange(n_columns) + 0.5) / n_columns,
        indexing="ij",
    )
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)
