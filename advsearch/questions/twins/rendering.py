"""Render twins: objects as photographs show them, over the photograph or in a place.

A twin is rendered by the pinhole that took the photograph, in a window: a rectangle of
whole pixels of the photograph. Both are brought to the size that the model takes by the
same function, so that they are as blurred.

The scene has the coordinates of the mesh: the object stands as its file stands, with z
up, and the camera is where the photograph's was.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import InputError, assets, color, reading, seeds, workbench
from advsearch.questions.twins.listing import PhotographedObject
from advsearch.questions.twins.result import COMPOSED, HOLE, PHOTOGRAPH

Float64Array = npt.NDArray[np.float64]
OBJECT = "object"  # the mesh under test
MIN_FILM = 64  # pixels of a film's longer side
MAX_FILM = 512
FILM_STEP = 32
MIN_SILHOUETTE = 4.0  # pixels of a silhouette's longer side
# camera coordinates of OpenCV (y down) to ours (+x to the left, +y up)
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])


class PhotoWindow(NamedTuple):
    """A rectangle of pixels of a photograph."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Twin:
    """Images of an object in a photograph and of its twins, at the model's size.

    Attributes:
        images: (H, W, 3) sRGB in [0, 1], by what surrounds the object.
        sight: what is visible of the object, for tasks.
        coverage: (h, w) of the twin in the window, in the photograph's pixels.
        size: square root of the silhouette's area, pixels of the photograph.
        brightness: mean of the twin less that of the photograph where the twin covers
            it, in sRGB.
        contrast: standard deviation of the photograph around the object, in sRGB.
    """

    images: Mapping[str, Tensor]
    sight: Any
    coverage: Tensor
    size: float
    brightness: float
    contrast: float


def project_object(item: PhotographedObject, asset: assets.ObjectAsset) -> Float64Array:
    """Return the positions (V, 2) of an object's vertices in its photograph, pixels.

    Raises:
        InputError: a part of the object is behind the camera.
    """
    to_camera = compute_mesh_to_camera(item, asset)
    points = asset.mesh.vertices.astype(np.float64) @ to_camera[:3, :3].T
    points += to_camera[:3, 3]
    if points[:, 2].min() <= 0.0:
        raise InputError(
            f"{item.photograph}: a part of {item.object} is behind the camera; check "
            "the pose and its unit"
        )
    camera = item.camera
    x = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    y = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    return np.stack([x, y], axis=1)


def choose_window(
    positions: Float64Array,
    photo_size: tuple[int, int],
    model_size: tuple[int, int],
    margin: float,
) -> PhotoWindow | None:
    """Return the window around an object, which has the shape that the model takes.

    The box of the full silhouette, whether it is hidden or not, is widened by `margin`
    times its longer side on each side and to the model's shape, and moved into the
    photograph; where it is larger than the photograph, it is shrunk.

    Args:
        positions: (V, 2) of the vertices, pixels.
        photo_size: (height, width) of the photograph in pixels.
        model_size: (height, width) that the model takes.
        margin: 0 or more.

    Returns:
        None where the object is out of view, or smaller than `MIN_SILHOUETTE`.
    """
    low = positions.min(axis=0)
    high = positions.max(axis=0)
    photo_height, photo_width = photo_size
    longer = float((high - low).max())
    is_outside = high.min() <= 0.0 or low[0] >= photo_width or low[1] >= photo_height
    if is_outside or longer < MIN_SILHOUETTE:
        return None
    shape = np.array([model_size[1], model_size[0]], np.float64)
    size = shape * float(((high - low + 2.0 * margin * longer) / shape).max())
    size *= min(1.0, photo_width / size[0], photo_height / size[1])
    width, height = (max(1, math.floor(side)) for side in size)
    corner = (low + high) / 2.0 - np.array([width, height]) / 2.0
    x = min(max(round(float(corner[0])), 0), photo_width - width)
    y = min(max(round(float(corner[1])), 0), photo_height - height)
    return PhotoWindow(x, y, width, height)


@dataclass(frozen=True, eq=False)
class Layer:
    """An object alone, as the camera of a photograph sees it in a window.

    Attributes:
        radiance: (h, w, 3) display-linear, times its alpha, at the film's size.
        alpha: (h, w) what the object covers.
        sight: what is visible of it, at the model's size.
    """

    radiance: Tensor
    alpha: Tensor
    sight: Any


class LayerRenderer:
    """Render layers of one object.

    Args:
        asset: the object, with `up` z and `front` +x.
        unit: of its file.
        light: environment that lights it.
        film: (height, width) of renders in pixels.
        spp: samples per pixel.
        seed: of the noise.
    """

    def __init__(
        self,
        asset: assets.ObjectAsset,
        unit: str,
        light: str,
        film: tuple[int, int],
        *,
        spp: int,
        seed: int,
    ) -> None:
        self._asset = asset
        self._spp = spp
        self._seed = seed
        self._renderer = workbench.load_scene(asset, light, unit=unit).renderer(
            {"background": {"ground": "hide"}}, resolution=film, seed=seed
        )

    def render(
        self,
        item: PhotographedObject,
        window: PhotoWindow,
        model_size: tuple[int, int],
        number: int = 0,
    ) -> Layer:
        """Render the object in a photograph.

        Args:
            item: the object; its mesh is that of this renderer.
            window: of the photograph.
            model_size: (height, width) of what is visible.
            number: of the row, which has noise of its own.
        """
        renderer = self._renderer
        inputs = renderer.scene.assembly(make_camera_inputs(item, self._asset, window))
        seed = seeds.stream(self._seed, "layer", number)
        with torch.no_grad():
            rendered = renderer.render_radiance(inputs, seed, self._spp, True)
            surfaces = renderer.scene.find_surfaces(inputs)
        radiance = rendered[..., :3] * renderer.formation.gain
        sight = _make_sight(surfaces, self._asset.size_in_metres, model_size)
        return Layer(radiance, rendered[..., 3], sight)


class SurroundedRenderer:
    """Render one object in an environment; arguments as for `LayerRenderer`."""

    def __init__(
        self,
        asset: assets.ObjectAsset,
        unit: str,
        environment: str,
        film: tuple[int, int],
        *,
        spp: int,
        seed: int,
    ) -> None:
        self._asset = asset
        self._spp = spp
        self._seed = seed
        self._renderer = workbench.load_scene(asset, environment, unit=unit).renderer(
            "camera", resolution=film, seed=seed
        )

    def render(
        self, item: PhotographedObject, window: PhotoWindow, number: int = 0
    ) -> Tensor:
        """Render the object as a photograph shows it, sRGB (h, w, 3) of the film's
        size; arguments as for `LayerRenderer.render`.
        """
        renderer = self._renderer
        inputs = renderer.scene.assembly(make_camera_inputs(item, self._asset, window))
        seed = seeds.stream(self._seed, "surrounded", number)
        with torch.no_grad():
            radiance = renderer.render_radiance(inputs, seed, self._spp, False)
            image: Tensor = renderer.formation.display(radiance)
        return image


def make_twin(
    item: PhotographedObject,
    photograph: Tensor,
    window: PhotoWindow,
    layer: Layer,
    surrounded: Mapping[str, Tensor],
    model_size: tuple[int, int],
) -> Twin:
    """Lay a render over its photograph, and bring all images to the model's size.

    Args:
        item: the object.
        photograph: (H, W, 3) sRGB in [0, 1].
        window: of the photograph.
        layer: render of the object alone.
        surrounded: sRGB renders by environment.
        model_size: (height, width) in pixels.
    """
    size = (window.height, window.width)
    alpha = resize(layer.alpha[..., None], size)[..., 0].clamp(0.0, 1.0)
    coverage = alpha * _read_visibility(item, window)
    crop = cut_window(photograph, window)
    composed = compose(crop, resize(layer.radiance, size), alpha, coverage)
    around = crop[coverage < 0.5]
    mean_around = around.mean(dim=0) if len(around) else crop.mean(dim=(0, 1))
    difference = (composed - crop)[coverage >= 0.5]
    images = {
        PHOTOGRAPH: crop,
        COMPOSED: composed,
        **{name: resize(image, size) for name, image in surrounded.items()},
        HOLE: torch.lerp(crop, mean_around.expand_as(crop), coverage[..., None]),
    }
    return Twin(
        {name: resize(image, model_size) for name, image in images.items()},
        layer.sight,
        alpha,
        size=math.sqrt(float(alpha.sum())),
        brightness=float(difference.mean()) if len(difference) else 0.0,
        contrast=float(around.std()) if len(around) > 1 else 0.0,
    )


def _make_sight(
    surfaces: Any, metres: float | None, model_size: tuple[int, int]
) -> Any:
    """Return what is visible of the object, as tasks take it."""
    # imports the tasks
    from advsearch.extend import tasks

    def enlarge(values: Tensor) -> Tensor:
        return F.interpolate(values[None, None].float(), size=model_size)[0, 0]

    return tasks.Sight(
        enlarge(surfaces.visible_mask(OBJECT)) > 0.5,
        enlarge(surfaces.depth) * (metres or 1.0),
        enlarge(surfaces.z_depth) * (metres or 1.0),
        metres,
    )


def choose_film(windows: Sequence[PhotoWindow], pixel_aspect: float) -> tuple[int, int]:
    """Return the (height, width) of a film for windows of one shape, in pixels.

    Pixels of a film are square in angles; those of a photograph with different focal
    lengths are not.

    Args:
        windows: at least one.
        pixel_aspect: fx / fy of the camera.
    """
    largest = max(windows, key=lambda window: window.width * window.height)
    height = largest.height * pixel_aspect
    longer = max(largest.width, height)
    side = min(max(FILM_STEP * math.ceil(longer / FILM_STEP), MIN_FILM), MAX_FILM)
    scale = side / longer
    return max(1, round(height * scale)), max(1, round(largest.width * scale))


def compute_mesh_to_camera(
    item: PhotographedObject, asset: assets.ObjectAsset
) -> Float64Array:
    """Return the rigid map (4, 4) from a mesh to OpenCV's camera coordinates.

    Both are in object sizes, which leaves the image as it is.
    """
    if asset.file_to_mesh is None:
        raise InputError(f"{item.mesh}: expected a mesh file")
    return reading.backdrop.compute_mesh_to_camera(asset.file_to_mesh, item.pose)


def make_camera_inputs(
    item: PhotographedObject, asset: assets.ObjectAsset, window: PhotoWindow
) -> dict[str, Tensor]:
    """Return the scene inputs of the camera that sees a window of a photograph."""
    to_camera = compute_mesh_to_camera(item, asset)
    camera = item.camera
    to_world = np.linalg.inv(FLIP @ to_camera)
    tangent = max(window.width / camera.fx, window.height / camera.fy) / 2.0
    fov = math.degrees(2.0 * math.atan(tangent))
    shift_x = (window.x + window.width / 2.0 - camera.cx) / window.width
    shift_y = (window.y + window.height / 2.0 - camera.cy) / window.height
    return {
        "camera.to_world": torch.from_numpy(to_world).float(),
        "camera.fov": torch.tensor([fov]),
        "camera.shift_x": torch.tensor([shift_x]),
        "camera.shift_y": torch.tensor([shift_y]),
    }


def compose(
    photograph: Tensor, radiance: Tensor, alpha: Tensor, coverage: Tensor
) -> Tensor:
    """Lay a render over a photograph, in linear light.

    Args:
        photograph: (h, w, 3) sRGB.
        radiance: (h, w, 3) display-linear, of what is rendered times its alpha.
        alpha: (h, w) what the render covers.
        coverage: (h, w) what is visible of that.

    Returns:
        (h, w, 3) sRGB in [0, 1].
    """
    visible = (coverage / alpha.clamp_min(1e-6)).clamp(0.0, 1.0)[..., None]
    linear = color.srgb_to_linear(photograph)
    mixed = radiance * visible + (1.0 - coverage[..., None]) * linear
    return color.linear_to_srgb(mixed.clamp(0.0, 1.0)).clamp(0.0, 1.0)


def resize(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize an image (H, W, C) to (height, width), averaging where it shrinks."""
    if tuple(image.shape[:2]) == size:
        return image
    channels = image.permute(2, 0, 1)[None]
    resized = F.interpolate(
        channels, size=size, mode="bilinear", align_corners=False, antialias=True
    )
    return resized[0].permute(1, 2, 0).contiguous()


def cut_window(image: Tensor, window: PhotoWindow) -> Tensor:
    """Return a window of an image (H, W, ...)."""
    rows = slice(window.y, window.y + window.height)
    return image[rows, window.x : window.x + window.width]


def load_photograph(path: Path) -> Tensor:
    """Read a photograph as sRGB (H, W, 3) in [0, 1].

    Raises:
        FileFormatError: it is no picture, or too large.
    """
    return torch.from_numpy(reading.pictures.read_image(path, None))


def _read_visibility(item: PhotographedObject, window: PhotoWindow) -> Tensor:
    """Return what of a window no other thing hides, (h, w); 1 without a mask.

    The mask is widened by a pixel, since the edges of masks are not smooth.
    """
    if item.visible_mask is None:
        return torch.ones(())
    mask = load_mask(item.visible_mask, window).float()
    return F.max_pool2d(mask[None, None], 3, 1, 1)[0, 0]


def load_mask(path: Path, window: PhotoWindow) -> Tensor:
    """Read a window (h, w) bool of a mask, which is an image over 1/2 inside."""
    values = reading.pictures.read_image(path, None, is_raw=True)
    mask = cut_window(torch.from_numpy(values[..., 0] > 0.5), window)
    if tuple(mask.shape) != (window.height, window.width):
        raise InputError(f"{path}: expected a mask of the photograph's size")
    return mask


def measure_pose(
    item: PhotographedObject, twin: Twin, window: PhotoWindow
) -> float | None:
    """Return how far a twin's silhouette agrees with the data set's, as IoU.

    It is that of masks, or else of their boxes; None where there is neither.
    """
    covered = twin.coverage > 0.5
    if item.mask is not None:
        mask = load_mask(item.mask, window)
        union = int((mask | covered).sum())
        return int((mask & covered).sum()) / union if union else None
    if item.box is None or not bool(covered.any()):
        return None
    columns = covered.any(dim=0).nonzero().flatten()
    rows = covered.any(dim=1).nonzero().flatten()
    left = window.x + float(columns[0])
    top = window.y + float(rows[0])
    box = (
        left,
        top,
        float(columns[-1] - columns[0]) + 1,
        float(rows[-1] - rows[0]) + 1,
    )
    return compute_box_iou(box, item.box)


def compute_box_iou(
    first: tuple[float, float, float, float], second: tuple[float, float, float, float]
) -> float:
    """Return the overlap of two boxes (x, y, width, height) over their union."""
    width = min(first[0] + first[2], second[0] + second[2]) - max(first[0], second[0])
    height = min(first[1] + first[3], second[1] + second[3]) - max(first[1], second[1])
    overlap = max(width, 0.0) * max(height, 0.0)
    return overlap / (first[2] * first[3] + second[2] * second[3] - overlap)


@lru_cache(maxsize=64)
def load_object(mesh: Path, unit: str) -> assets.ObjectAsset:
    """Read the mesh of an object as its file has it, and its size.

    Raises:
        InputError: the file cannot be used.
    """
    scene = workbench.load_scene(mesh, up="z", facing="+x", unit=unit)
    asset: assets.ObjectAsset = scene.description.object
    return asset
