"""How much of a thing a picture shows: of all that there would be of it if nothing stood before it and the picture went
on, by its mesh, projected and rasterised without a renderer."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from advsearch.scene.assets import Bools, Doubles
from advsearch.scene.camera_model import EQUIRECTANGULAR
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.raster import pixels_in
from advsearch.scene.renderer import Renderer

NEAREST = 1e-3
"""Points nearer to the camera plane than this, or behind it, have no place in the picture."""
RASTER = 2048
"""Most pixels along a side of an outline; of a larger one each stands for several of the picture."""
WITHIN = 0.98
"""Share of the pixels that are seen which an outline has to have, give or take one, or it is not believed."""


@dataclass(frozen=True, eq=False)
class SeenThing:
    """What a picture shows of one mesh.

    Attributes:
        name: of the mesh.
        mask: (H, W) bool, the pixels that it is first seen in.
        share: of its outline that these are, in (0, 1]; None where the outline is not known.
        truncated: whether the outline goes on beyond the picture; None where it is not known.
        distance: of the nearest point that is seen from the camera, along the ray; in metres, or in object sizes where
            the object's size is not known.
    """

    name: str
    mask: Bools
    share: float | None
    truncated: bool | None
    distance: float

    @property
    def box(self) -> tuple[int, int, int, int]:
        """The smallest box round the mask: x0, y0, x1, y1 in pixels from the top left, with x0 <= x < x1."""
        rows, columns = (np.flatnonzero(self.mask.any(axis=side)) for side in (1, 0))
        return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def seen_things(renderer: Renderer, u: Tensor, names: Collection[str] | None = None) -> list[SeenThing]:
    """Return the meshes, or those of some names, that the picture of a configuration (d,) shows."""
    description, surfaces = renderer.scene.made[0], renderer.surfaces(u)
    with torch.no_grad():
        inputs = renderer.scene.assembly(renderer.space.inputs(u))
    found = []
    for name in description.meshes if names is None else names:
        mask = surfaces.seen(name).numpy() if name in surfaces.names else np.zeros(surfaces.id.shape, np.bool_)
        if mask.any():
            near = float(surfaces.depth.numpy()[mask].min())
            found.append(SeenThing(name, mask, *_outline(renderer, description, inputs, name, mask), near))
    return found


def _outline(
    renderer: Renderer, description: SceneDescription, inputs: Mapping[str, Tensor], name: str, mask: Bools
) -> tuple[float | None, bool | None]:
    """The share of an outline that is seen, and whether it goes on beyond the picture."""
    part, (height, width) = description.meshes[name], mask.shape
    vertices = inputs.get(f"{name}.vertices")
    if vertices is None:
        vertices = renderer.scene.assembly.meshes[name].place(None, None)[0]
    places, before = _places(description, inputs, vertices.detach().double().cpu(), (height, width))
    faces = part.mesh.faces.astype(np.int64)
    if part.opacity is not None or not before[np.unique(faces)].all():
        return None, None  # of a cut-out the mesh is no outline, and what reaches behind the camera has none
    corners = places[faces]
    low, high = np.floor(corners.min(axis=(0, 1))), np.ceil(corners.max(axis=(0, 1)))
    step = max(1, math.ceil(float((high - low).max()) / RASTER))
    columns, rows = (int(one) for one in (high - low) // step + 1)
    _, row, column, _ = pixels_in((corners - low) / step - 0.5, (rows, columns))
    outline = np.zeros((rows, columns), np.bool_)
    outline[row, column] = True
    row, column = np.nonzero(outline)
    x, y = low[0] + (column + 0.5) * step, low[1] + (row + 0.5) * step
    inside = (x > 0) & (x < width) & (y > 0) & (y < height)
    seen_row, seen_column = np.nonzero(mask)
    near = ndimage.binary_dilation(outline, np.ones((3, 3)))
    at = ((seen_row + 0.5 - low[1]) // step).astype(np.int64), ((seen_column + 0.5 - low[0]) // step).astype(np.int64)
    within = (at[0] >= 0) & (at[0] < rows) & (at[1] >= 0) & (at[1] < columns)
    here = within & near[at[0].clip(0, rows - 1), at[1].clip(0, columns - 1)]
    if here.mean() < WITHIN:
        return None, None
    return min(1.0, float(mask.sum()) / (len(row) * step**2)), bool((~inside).any())


def _places(
    description: SceneDescription, inputs: Mapping[str, Tensor], vertices: Tensor, size: tuple[int, int]
) -> tuple[Doubles, Bools]:
    """Where vertices (V, 3) in world space are seen, (V, 2) column and row in pixels from the top left corner, and
    which are before the camera."""
    height, width = size
    camera = inputs.get("camera.to_world", torch.from_numpy(camera_to_world(description, width / height)))
    camera = camera.detach().double().cpu()
    points = (vertices - camera[:3, 3]) @ camera[:3, :3] * torch.tensor([-1.0, -1.0, 1.0])  # right, down, forward
    sides = torch.tensor([width, height]).double()
    if (model := description.camera_model) is not None:
        model = model.with_numbers(inputs["camera.lens"].detach().cpu()) if "camera.lens" in inputs else model
        places, seen = model.project(points)
        return (places * sides).numpy(), (seen & (model.kind != EQUIRECTANGULAR)).numpy()  # a panorama has a seam
    fov = float(inputs["camera.fov"]) if "camera.fov" in inputs else description.number("camera.fov")
    focal, depth = max(size) / 2.0 / math.tan(math.radians(fov) / 2.0), points[:, 2:]
    shift = [float(inputs[f"camera.shift_{one}"]) if f"camera.shift_{one}" in inputs else 0.0 for one in "xy"]
    places = focal * points[:, :2] / depth.clamp_min(NEAREST) + sides * (0.5 - torch.tensor(shift).double())
    return places.numpy(), (depth[:, 0] > NEAREST).numpy()
