"""How much of a thing a picture shows: of all that there would be of it if nothing
stood before it and the picture went on, by its mesh, projected and rasterised without a
renderer.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from advsearch.scene.assets import Bools
from advsearch.scene.camera_model import EQUIRECTANGULAR
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world, projected
from advsearch.scene.raster import pixels_in
from advsearch.scene.renderer import Renderer

# most pixels along a side of an outline; of a larger one each stands for several of the
# picture
RASTER = 2048
# share of the pixels that are seen which an outline has to have, give or take one, or
# it is not believed
WITHIN = 0.98


@dataclass(frozen=True, eq=False)
class SeenThing:
    """What a picture shows of one mesh."""

    name: str
    mask: Bools  # (H, W) the pixels that it is first seen in
    # of its outline that these are, in (0, 1]; None where the outline is not known
    share: float | None
    # whether the outline goes on beyond the picture; None where it is not known
    truncated: bool | None
    # along the ray to its nearest seen point, in metres; object sizes where its size is
    # not known
    distance: float

    @property
    def box(self) -> tuple[int, int, int, int]:
        """The smallest box round the mask: x0, y0, x1, y1 in pixels from the top left,
        with x0 <= x < x1.
        """
        rows, columns = (np.flatnonzero(self.mask.any(axis=side)) for side in (1, 0))
        return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def seen_things(
    renderer: Renderer, u: Tensor, names: Collection[str] | None = None
) -> list[SeenThing]:
    """Return the meshes, or those of some names, that the picture of a configuration
    (d,) shows.
    """
    description = renderer.scene.made[0]
    surfaces = renderer.surfaces(u)
    with torch.no_grad():
        inputs = renderer.scene.assembly(renderer.space.inputs(u))
    things = []
    for name in description.meshes if names is None else names:
        mask = (
            surfaces.seen(name).numpy()
            if name in surfaces.names
            else np.zeros(surfaces.id.shape, np.bool_)
        )
        if mask.any():
            near = float(surfaces.depth.numpy()[mask].min())
            things.append(
                SeenThing(
                    name,
                    mask,
                    *_outline(renderer, description, inputs, name, mask),
                    near,
                )
            )
    return things


def _outline(
    renderer: Renderer,
    description: SceneDescription,
    inputs: Mapping[str, Tensor],
    name: str,
    mask: Bools,
) -> tuple[float | None, bool | None]:
    # the share of an outline that is seen, and whether it goes on beyond the picture
    part = description.meshes[name]
    (height, width) = mask.shape
    vertices = renderer.scene.assembly.vertices(name, inputs)
    camera = inputs.get(
        "camera.to_world",
        torch.from_numpy(camera_to_world(description, width / height)),
    )
    camera = camera.detach().double().cpu()
    points = (vertices.detach().double().cpu() - camera[:3, 3]) @ camera[:3, :3]
    inputs = {
        name: value.detach().cpu()
        for name, value in inputs.items()
        if name.startswith("camera.")
    }
    places, before = projected(description, inputs, points, (height, width))
    model = description.camera_model
    faces = torch.from_numpy(part.mesh.faces.astype(np.int64))
    seam = model is not None and model.kind == EQUIRECTANGULAR
    if part.opacity is not None or seam or not bool(before[faces].all()):
        # of a cut-out the mesh is no outline, and what reaches behind the camera has
        # none
        return None, None
    corners = places.numpy()[faces.numpy()] + (width / 2.0, height / 2.0)
    low = np.floor(corners.min(axis=(0, 1)))
    high = np.ceil(corners.max(axis=(0, 1)))
    step = max(1, math.ceil(float((high - low).max()) / RASTER))
    columns, rows = map(int, (high - low) // step + 1)
    _, row, column, _ = pixels_in((corners - low) / step - 0.5, (rows, columns))
    outline = np.zeros((rows, columns), np.bool_)
    outline[row, column] = True
    row, column = np.nonzero(outline)
    x = low[0] + (column + 0.5) * step
    y = low[1] + (row + 0.5) * step
    inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    seen_row, seen_column = np.nonzero(mask)
    near = ndimage.binary_dilation(outline, np.ones((3, 3)))
    at = (
        ((seen_row + 0.5 - low[1]) // step).astype(np.int64),
        ((seen_column + 0.5 - low[0]) // step).astype(np.int64),
    )
    within = (at[0] >= 0) & (at[0] < rows) & (at[1] >= 0) & (at[1] < columns)
    here = within & near[at[0].clip(0, rows - 1), at[1].clip(0, columns - 1)]
    if here.mean() < WITHIN:
        return None, None
    return min(1.0, float(mask.sum()) / (len(row) * step**2)), bool((~inside).any())
