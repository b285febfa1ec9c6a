"""Measure which fraction of a mesh an image shows.

It is a fraction of the mesh's outline, as it were if nothing stood before it and the
image went on: the mesh is projected and rasterised without a renderer.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from advsearch.scene.assets import BoolArray, Float64Array
from advsearch.scene.camera_model import EQUIRECTANGULAR
from advsearch.scene.description import SceneDescription
from advsearch.scene.formation import Surfaces
from advsearch.scene.geometry import camera_to_world, project_points
from advsearch.scene.raster import rasterize_triangles
from advsearch.scene.renderer import Renderer

# largest width of an outline in cells; in a larger one a cell is several pixels wide
MAX_OUTLINE_SIZE = 2048
# fraction of the visible pixels that have to be in an outline, within one cell, or it
# is not trusted
MIN_MATCHING_FRACTION = 0.98


@dataclass(frozen=True, eq=False)
class VisibleMesh:
    """What an image shows of one mesh."""

    name: str
    mask: BoolArray  # (H, W) the pixels in which it is seen first
    # fraction of its outline that these are, in (0, 1]; None where the outline is not
    # known
    visible_fraction: float | None
    # whether the outline goes on beyond the image; None where it is not known
    is_truncated: bool | None
    # along the ray to its nearest visible point, in metres; object sizes where its size
    # is not known
    distance: float

    @property
    def box(self) -> tuple[int, int, int, int]:
        """The smallest box around the mask.

        That is x0, y0, x1, y1 in pixels from the top left, with x0 <= x < x1.
        """
        rows = np.flatnonzero(self.mask.any(axis=1))
        columns = np.flatnonzero(self.mask.any(axis=0))
        return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def find_visible_meshes(
    renderer: Renderer, u: Tensor, names: Collection[str] | None = None
) -> list[VisibleMesh]:
    """Return the meshes that are visible in the image of a configuration.

    A mesh is visible if it is the nearest surface in at least one pixel.

    Args:
        renderer: renderer of the scene.
        u: (d,) configuration.
        names: the meshes that are considered; None for all.
    """
    description = renderer.scene.description_and_filter[0]
    surfaces = renderer.find_surfaces(u)
    with torch.no_grad():
        inputs = renderer.scene.input_assembler(renderer.space.inputs(u))
    visible = []
    for name in description.meshes if names is None else names:
        mesh = _find_visible_mesh(renderer, inputs, surfaces, name)
        if mesh is not None:
            visible.append(mesh)
    return visible


def _find_visible_mesh(
    renderer: Renderer, inputs: Mapping[str, Tensor], surfaces: Surfaces, name: str
) -> VisibleMesh | None:
    """Return what of a mesh is visible; None if it is the nearest surface in no pixel.

    Args:
        renderer: renderer of the scene.
        inputs: inputs of the scene, assembled.
        surfaces: first surface that the camera sees in each pixel.
        name: name of the mesh.
    """
    if name not in surfaces.shape_names:
        return None
    mask = surfaces.visible_mask(name).numpy()
    if not mask.any():
        return None
    fraction, is_truncated = _compare_outline(renderer, inputs, name, mask)
    distance = float(surfaces.depth.numpy()[mask].min())
    return VisibleMesh(name, mask, fraction, is_truncated, distance)


def _compare_outline(
    renderer: Renderer, inputs: Mapping[str, Tensor], name: str, mask: BoolArray
) -> tuple[float | None, bool | None]:
    """Compare the visible pixels of a mesh with its outline.

    Args:
        renderer: renderer of the scene.
        inputs: inputs of the scene, assembled.
        name: name of the mesh.
        mask: (H, W) bool, the pixels in which the mesh is the nearest surface.

    Returns:
        The fraction of the outline that is visible, and whether the outline extends
        beyond the image. Both are None if the outline is not known: the faces cannot be
        projected, or the outline does not cover the visible pixels.
    """
    height, width = mask.shape
    corners = _project_faces(renderer, inputs, name, (height, width))
    if corners is None:
        return None, None
    outline = _rasterise_outline(corners)
    if not outline.covers(mask):
        return None, None
    return _measure_outline(outline, mask)


def _measure_outline(outline: _Outline, mask: BoolArray) -> tuple[float, bool]:
    """Return which fraction of an outline is visible, and whether it leaves the image.

    `mask` (H, W) are the visible pixels.
    """
    height, width = mask.shape
    row, column = np.nonzero(outline.cells)
    x = outline.left + (column + 0.5) * outline.step
    y = outline.top + (row + 0.5) * outline.step
    is_inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    # of the full outline, also beyond the image; a cell is `step` pixels wide and high
    n_outline_pixels = len(row) * outline.step**2
    fraction = float(mask.sum()) / n_outline_pixels
    is_truncated = bool((~is_inside).any())
    return min(1.0, fraction), is_truncated


def _select_camera_inputs(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the inputs that are the camera's, on the CPU and without derivatives."""
    return {
        key: value.detach().cpu()
        for key, value in inputs.items()
        if key.startswith("camera.")
    }


def _project_faces(
    renderer: Renderer,
    inputs: Mapping[str, Tensor],
    name: str,
    size: tuple[int, int],
) -> Float64Array | None:
    """Project the corners of a mesh's faces to pixels (F, 3, 2) from the top left.

    The result is None if the faces do not tell the outline: the mesh has cut-outs or
    reaches behind the camera, or the image is a panorama, at whose seam a face is
    divided.

    Args:
        renderer: renderer of the scene.
        inputs: inputs of the scene, assembled.
        name: name of the mesh.
        size: height and width of the image.
    """
    height, width = size
    description = renderer.scene.description_and_filter[0]
    part = description.meshes[name]
    vertices = renderer.scene.input_assembler.get_vertices(name, inputs)
    camera = _get_camera_pose(description, inputs, aspect=width / height)
    points = _to_camera_points(vertices, camera)
    positions, is_before = project_points(
        description, _select_camera_inputs(inputs), points, size
    )
    model = description.camera_model
    has_seam = model is not None and model.kind == EQUIRECTANGULAR
    faces = torch.from_numpy(part.mesh.faces.astype(np.int64))
    # an opacity means cut-outs
    if part.opacity is not None or has_seam or not bool(is_before[faces].all()):
        return None
    # positions count from the center of the image
    center = (width / 2.0, height / 2.0)
    return np.asarray(positions.numpy()[faces.numpy()] + center)


def _get_camera_pose(
    description: SceneDescription, inputs: Mapping[str, Tensor], aspect: float
) -> Tensor:
    """Return the pose (4, 4) of the camera of inputs, or else that of the scene.

    `aspect` is width over height of the image.
    """
    camera = inputs.get("camera.to_world")
    if camera is None:
        return torch.from_numpy(camera_to_world(description, aspect))
    return camera


def _to_camera_points(vertices: Tensor, camera: Tensor) -> Tensor:
    """Return vertices (V, 3) in the axes of a camera (4, 4): left, up and ahead."""
    camera = camera.detach().double().cpu()
    return (vertices.detach().double().cpu() - camera[:3, 3]) @ camera[:3, :3]


@dataclass(frozen=True, eq=False)
class _Outline:
    """A rasterised outline, in cells of one or more pixels."""

    cells: BoolArray  # (rows, columns)
    # position of the first cell's corner, in pixels from the image's top left
    left: float
    top: float
    step: int  # width of a cell in pixels

    def covers(self, mask: BoolArray) -> bool:
        """Return whether the visible pixels of a mask (H, W) lie in the outline.

        At least `MIN_MATCHING_FRACTION` of them have to lie in a cell of the outline,
        or in a neighbor of one. Otherwise the outline, which was made by projecting the
        faces, is not that of the rendered mesh. The mask has at least one pixel.
        """
        n_rows, n_columns = self.cells.shape
        pixel_row, pixel_column = np.nonzero(mask)
        # the cell in which the center of each pixel lies
        row = ((pixel_row + 0.5 - self.top) // self.step).astype(np.int64)
        column = ((pixel_column + 0.5 - self.left) // self.step).astype(np.int64)
        is_inside = (row >= 0) & (row < n_rows) & (column >= 0) & (column < n_columns)
        outline_and_neighbours = ndimage.binary_dilation(self.cells, np.ones((3, 3)))
        # clipped only so that pixels outside of the cells have an index
        is_near_outline = outline_and_neighbours[
            row.clip(0, n_rows - 1), column.clip(0, n_columns - 1)
        ]
        return bool((is_inside & is_near_outline).mean() >= MIN_MATCHING_FRACTION)


def _rasterise_outline(corners: Float64Array) -> _Outline:
    """Rasterise the outline of faces with corners (F, 3, 2) in pixels.

    A cell is a pixel, or a square of several where the outline is wider or higher than
    `MAX_OUTLINE_SIZE` pixels.
    """
    lower = np.floor(corners.min(axis=(0, 1)))
    upper = np.ceil(corners.max(axis=(0, 1)))
    cell_width = max(1, math.ceil(float((upper - lower).max()) / MAX_OUTLINE_SIZE))
    # one more, for what is left of a cell at the right and at the bottom
    n_columns, n_rows = map(int, (upper - lower) // cell_width + 1)
    # the rasteriser has the center of the first cell at 0
    corners_in_cells = (corners - lower) / cell_width - 0.5
    _, row, column, _ = rasterize_triangles(corners_in_cells, (n_rows, n_columns))
    cells = np.zeros((n_rows, n_columns), np.bool_)
    cells[row, column] = True
    return _Outline(cells, left=lower[0], top=lower[1], step=cell_width)
