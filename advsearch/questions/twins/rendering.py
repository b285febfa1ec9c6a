"""Render twins: objects as in photographs, over the photograph or in an environment.

A twin is rendered by the pinhole camera that took the photograph, in a window: a
rectangle of pixels of the photograph. It is laid over the photograph as over any
backdrop (`advsearch.scene.backdrop`). Photograph and twin are resized to the model's
size by the same function, so that they are equally blurred.

The scene has the coordinates of the mesh: the object stands as in its file, with z up,
and the camera is where that of the photograph was.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import InputError, assets, reading, seeds, workbench
from advsearch.questions.twins import counting
from advsearch.questions.twins.listing import PhotographedObject
from advsearch.questions.twins.result import COMPOSED, HOLE, PHOTOGRAPH

Float64Array = npt.NDArray[np.float64]
OBJECT = "object"  # the mesh under test
MIN_FILM = 64  # minimum length of a film's longer side in pixels
MAX_FILM = 512
FILM_STEP = 32  # films of similar windows get the same size
MIN_SILHOUETTE = 4.0  # minimum length of a silhouette's longer side in pixels
# from camera coordinates of OpenCV (+x to the right, +y down) to those of our scenes
# (+x to the left, +y up)
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
        images: (H, W, 3) sRGB images in [0, 1], by the name of the surroundings.
        visible_surface: what is visible of the object, for tasks.
        coverage: (h, w) how much of each pixel of the window the twin covers, hidden
            parts included.
        silhouette_size_pixels: square root of the silhouette's area, in pixels of the photograph.
        brightness: mean of the twin minus that of the photograph where the twin covers
            it, in sRGB.
        contrast: standard deviation of the photograph around the object, in sRGB.
        texture_correlation: correlation of the luminance of twin and photograph where the twin
            covers it, in sRGB; None if one of them is uniform.
    """

    images: Mapping[str, Tensor]
    visible_surface: Any
    coverage: Tensor
    silhouette_size_pixels: float
    brightness: float
    contrast: float
    texture_correlation: float | None


def project_object(item: PhotographedObject, asset: assets.ObjectAsset) -> Float64Array:
    """Return the pixel coordinates (x, y) of an object's vertices (V, 2).

    They are projected into the photograph by its pinhole camera.

    Args:
        item: the object, with its pose and the camera of the photograph.
        asset: the object's mesh.

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
    """Return the window around an object, with the aspect ratio that the model takes.

    The window begins as the bounding box of the object's silhouette, including parts
    that other objects hide. It is widened on each side by `margin` times its longer
    side, and then to the model's aspect ratio. If it is larger than the photograph, it
    is shrunk. Finally it is moved into the photograph.

    Args:
        positions: pixel coordinates (x, y) of the mesh's vertices in the photograph (V,
            2).
        photo_size: (height, width) of the photograph in pixels.
        model_size: (height, width) of the images that the model takes.
        margin: width that is added on each side, as a fraction of the box's longer
            side.

    Returns:
        The window; None if the object is out of view, or smaller than `MIN_SILHOUETTE`
        pixels.
    """
    low = positions.min(axis=0)
    high = positions.max(axis=0)
    box_size = high - low
    longer_side = float(box_size.max())
    if _is_out_of_view(low, high, photo_size) or longer_side < MIN_SILHOUETTE:
        return None
    photo_height, photo_width = photo_size
    width, height = _compute_window_size(box_size, photo_size, model_size, margin)
    center = (low + high) / 2.0
    return PhotoWindow(
        _center_within(float(center[0]), width, photo_width),
        _center_within(float(center[1]), height, photo_height),
        width,
        height,
    )


def _compute_window_size(
    box_size: Float64Array,
    photo_size: tuple[int, int],
    model_size: tuple[int, int],
    margin: float,
) -> tuple[int, int]:
    """Return width and height of the window around a bounding box, in pixels.

    Args:
        box_size: (width, height) of the box.
        photo_size: (height, width) of the photograph.
        model_size: (height, width) of the images that the model takes.
        margin: width that is added on each side, as a fraction of the box's longer
            side.
    """
    photo_height, photo_width = photo_size
    model_height, model_width = model_size
    # All sizes from here on are (width, height), as that of the box is.
    model_shape = np.array([model_width, model_height], np.float64)
    widened = box_size + 2.0 * margin * float(box_size.max())
    # the smallest size with the model's aspect ratio that contains the widened box
    size = model_shape * float((widened / model_shape).max())
    size *= min(1.0, photo_width / size[0], photo_height / size[1])  # not larger
    width, height = (max(1, math.floor(side)) for side in size)
    return width, height


def _is_out_of_view(
    low: Float64Array, high: Float64Array, photo_size: tuple[int, int]
) -> bool:
    """Return whether a box lies outside of a photograph.

    Args:
        low, high: corners (x, y) of the box in pixels.
        photo_size: (height, width) of the photograph in pixels.
    """
    photo_height, photo_width = photo_size
    is_left_or_above = high[0] <= 0.0 or high[1] <= 0.0
    is_right_or_below = low[0] >= photo_width or low[1] >= photo_height
    return bool(is_left_or_above or is_right_or_below)


def _center_within(center: float, length: int, limit: int) -> int:
    """Return the start of an interval in [0, limit], as near to a center as possible."""
    return min(max(round(center - length / 2.0), 0), limit - length)


@dataclass(frozen=True, eq=False)
class Layer:
    """An object that was rendered into a window of its photograph.

    Attributes:
        composed: (h, w, 3) sRGB in [0, 1], in the photograph's pixels.
        alpha: (h, w) in [0, 1], how much of each pixel the object covers, hidden parts
            included.
        visible_surface: what is visible of the object, for tasks, at the model's size.
    """

    composed: Tensor
    alpha: Tensor
    visible_surface: Any


class LayerRenderer:
    """Renders one object into photographs.

    Args:
        asset: the object, with z up and its front at +x.
        unit: unit of its file.
        light: environment that lights it.
        film: (height, width) of renders in pixels.
        spp: samples per pixel.
        seed: seed of the noise.
        is_matched: whether the object gets the noise and the blur of the photograph, if
            they can be measured.
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
        is_matched: bool = True,
    ) -> None:
        """Load the object and its environment, and make the renderer.

        Args:
            asset: the object, with z up and its front at +x.
            unit: unit of its file, such as "mm".
            light: name of the environment that lights it.
            film: (height, width) of the renders in pixels.
            spp: samples per pixel.
            seed: seed of the noise.
            is_matched: whether the object gets the noise and the blur of the
                photograph.
        """
        self._asset = asset
        self._spp = spp
        self._seed = seed
        # The photograph already has the object's shadow, so no ground is rendered.
        settings = {"ground.size": 0.0}
        scene = workbench.load_scene(asset, light, unit=unit, settings=settings)
        # The control "background" puts a backdrop in place of the environment. Here it
        # is the photograph, which `_make_image_inputs` passes.
        self._renderer = scene.renderer({"background": {}}, resolution=film, seed=seed)
        # used to lay renders over photographs (`_make_image_inputs`)
        self._description = scene.description
        if not is_matched:
            self._description = self._description.with_values(
                backdrop__noise=0.0, backdrop__blur=0.0
            )

    def render(
        self,
        item: PhotographedObject,
        photograph: reading.backdrop.BackdropPhotograph,
        window: PhotoWindow,
        model_size: tuple[int, int],
        number: int = 0,
    ) -> Layer:
        """Render the object into a photograph.

        Args:
            item: the object; its mesh is that of this renderer.
            photograph: photograph that shows it.
            window: window of the photograph around the object.
            model_size: (height, width) of the masks and depths that tasks get.
            number: number of the row, from which the seed of the noise is derived.
        """
        renderer = self._renderer
        scene_inputs = renderer.scene.input_assembler(
            make_camera_inputs(item, self._asset, window)
        )
        with torch.no_grad():
            rendered = self._render_without_environment(scene_inputs, number)
            surfaces = renderer.scene.find_surfaces(scene_inputs)
            rendered = resize(rendered, (window.height, window.width))
            image_inputs = self._make_image_inputs(item, photograph, window)
            # Controls may change the finished image; none varies here.
            composed = renderer.finish_image(rendered, image_inputs, renderer.start)
        sight = _make_sight(surfaces, self._asset.size_in_metres, model_size)
        alpha = rendered[..., 3].clamp(0.0, 1.0)
        return Layer(composed=composed, alpha=alpha, visible_surface=sight)

    def _render_without_environment(self, scene_inputs: Any, number: int) -> Tensor:
        """Render the radiance of the object alone, with an alpha channel: (h, w, 4).

        Args:
            scene_inputs: inputs of the scene, with those of the camera.
            number: number of the row, from which the seed of the noise is derived.
        """
        seed = seeds.derive_seed(self._seed, "layer", number)
        radiance: Tensor = self._renderer.render_radiance(
            scene_inputs, seed, self._spp, hide_environment=True
        )
        return radiance

    def _make_image_inputs(
        self,
        item: PhotographedObject,
        photograph: reading.backdrop.BackdropPhotograph,
        window: PhotoWindow,
    ) -> dict[str, Tensor]:
        """Return the inputs by which a render becomes a window of a photograph.

        They are the photograph's pixels, noise and blur, a mask of what hides the
        object, and the exposure in stops.
        """
        front = read_front(item, photograph)
        in_window = replace(photograph, crop=window, front=front)
        description = self._description.with_backdrop(in_window)
        size = (window.height, window.width)
        # The renderer applies the gain of its scene. The exposure corrects it to that
        # which `with_backdrop` computes for this photograph.
        stops = math.log2(description.gain / self._renderer.formation.gain)
        return {
            **reading.backdrop.make_image_inputs(description, size),
            "camera.exposure": torch.tensor([stops]),
        }


class SurroundedRenderer:
    """Renders one object in an environment; arguments as for `LayerRenderer`."""

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
        """Load the object in its environment, and make the renderer.

        Args:
            asset: the object, with z up and its front at +x.
            unit: unit of its file, such as "mm".
            environment: name of the environment that surrounds it.
            film: (height, width) of the renders in pixels.
            spp: samples per pixel.
            seed: seed of the noise.
        """
        self._asset = asset
        self._spp = spp
        self._seed = seed
        scene = workbench.load_scene(asset, environment, unit=unit)
        self._renderer = scene.renderer("camera", resolution=film, seed=seed)

    def render(
        self, item: PhotographedObject, window: PhotoWindow, number: int = 0
    ) -> Tensor:
        """Render the object in the environment, sRGB (h, w, 3) of the film's size.

        Args:
            item: the object, with its pose and the camera of the photograph.
            window: window of the photograph around the object.
            number: number of the row, from which the seed of the noise is derived.
        """
        renderer = self._renderer
        scene_inputs = renderer.scene.input_assembler(
            make_camera_inputs(item, self._asset, window)
        )
        seed = seeds.derive_seed(self._seed, "surrounded", number)
        with torch.no_grad():
            radiance = renderer.render_radiance(
                scene_inputs, seed, self._spp, hide_environment=False
            )
            image: Tensor = renderer.formation.map_to_display(radiance)
        return image


def make_twin(
    item: PhotographedObject,
    photograph: reading.backdrop.BackdropPhotograph,
    window: PhotoWindow,
    layer: Layer,
    render_of_environment: Mapping[str, Tensor],
    model_size: tuple[int, int],
) -> Twin:
    """Resize a photograph and its twins to the model's size.

    The images are the photograph, the object rendered into the photograph, the object
    in each environment, and the photograph with the object replaced by a mean color.
    The last one shows whether the model uses the surroundings.

    Args:
        item: the object.
        photograph: photograph that shows it.
        window: window of the photograph around the object.
        layer: the object rendered into the photograph, and its coverage of each pixel.
        render_of_environment: sRGB renders (H, W, 3) of the object, by environment.
        model_size: (height, width) in pixels.
    """
    crop = cut_photograph(photograph, window)
    visible_coverage = _compute_visible_coverage(item, photograph, window, layer)
    around = crop[visible_coverage < 0.5]
    window_size = (window.height, window.width)
    images = {
        PHOTOGRAPH: crop,
        COMPOSED: layer.composed,
        **_resize_all(render_of_environment, window_size),
        HOLE: _replace_by_mean(crop, around, visible_coverage),
    }
    is_covered = visible_coverage >= 0.5
    difference = (layer.composed - crop)[is_covered]
    return Twin(
        images=_resize_all(images, model_size),
        visible_surface=layer.visible_surface,
        # The full silhouette, with hidden parts, is compared with the data's mask.
        coverage=layer.alpha,
        # the side in pixels of a square with the object's area
        silhouette_size_pixels=math.sqrt(float(layer.alpha.sum())),
        brightness=float(difference.mean()) if len(difference) else 0.0,
        contrast=float(around.std()) if len(around) > 1 else 0.0,
        texture_correlation=correlate_luminance(
            layer.composed[is_covered], crop[is_covered]
        ),
    )


def _resize_all(
    images: Mapping[str, Tensor], size: tuple[int, int]
) -> dict[str, Tensor]:
    """Resize images (H, W, C) by name to (height, width)."""
    return {name: resize(image, size) for name, image in images.items()}


def _replace_by_mean(crop: Tensor, around: Tensor, visible_coverage: Tensor) -> Tensor:
    """Return a photograph (h, w, 3) with the object replaced by the mean around it.

    Args:
        crop: the photograph.
        around: (n, 3) the pixels around the object; there may be none.
        visible_coverage: (h, w) how much of each pixel the object covers.
    """
    # If the object fills the window, the mean of the window is the best guess.
    mean_around = around.mean(dim=0) if len(around) else crop.mean(dim=(0, 1))
    return torch.lerp(crop, mean_around.expand_as(crop), visible_coverage[..., None])


def _compute_visible_coverage(
    item: PhotographedObject,
    photograph: reading.backdrop.BackdropPhotograph,
    window: PhotoWindow,
    layer: Layer,
) -> Tensor:
    """Return how much of each pixel a visible object covers (h, w), in [0, 1].

    Parts that other things hide in the photograph do not count.
    """
    hiding_levels = read_front(item, photograph)  # 255 where a thing hides the object
    if hiding_levels is None:
        return layer.alpha
    hidden = cut_window(torch.from_numpy(hiding_levels), window) / 255.0
    return layer.alpha * (1.0 - hidden)


def correlate_luminance(first: Tensor, second: Tensor) -> float | None:
    """Return the correlation of the luminance of two lists of pixels (N, 3).

    None if one of them is uniform.
    """
    weights = torch.from_numpy(reading.backdrop.LUMINANCE).to(first)
    values = torch.stack([first @ weights, second @ weights])
    if len(first) < 2 or bool((values.std(dim=1) < 1e-6).any()):
        return None
    return float(torch.corrcoef(values)[0, 1])


def _make_sight(
    surfaces: Any, size_in_metres: float | None, model_size: tuple[int, int]
) -> Any:
    """Return the visible mask and the depths of the object, as tasks take them.

    Args:
        surfaces: first surface and depth in each pixel of the film.
        size_in_metres: size of the object in meters, which is the unit of the scene's
            depths; None if it is unknown.
        model_size: (height, width) of the result.
    """
    from advsearch.extend import tasks  # loads the tasks only when one is needed

    def scale(values: Tensor) -> Tensor:
        """Scale values of pixels (h, w) to the model's size, by the nearest pixel."""
        return F.interpolate(values[None, None].float(), size=model_size)[0, 0]

    # If the size is unknown, depths stay in units of the object's size.
    metres_per_unit = size_in_metres or 1.0
    return tasks.Sight(
        scale(surfaces.visible_mask(OBJECT)) > 0.5,
        scale(surfaces.depth) * metres_per_unit,  # distance from the camera
        scale(surfaces.z_depth) * metres_per_unit,  # along the camera's axis
        size_in_metres,
    )


def choose_film(windows: Sequence[PhotoWindow], pixel_aspect: float) -> tuple[int, int]:
    """Return the (height, width) of a film for windows of one shape, in pixels.

    Pixels of a film are square in angles. Those of a photograph are not if its two
    focal lengths differ.

    Args:
        windows: the windows, at least one.
        pixel_aspect: fx / fy of the camera.
    """
    largest = max(windows, key=lambda window: window.width * window.height)
    # A pixel of the photograph is `pixel_aspect` times as high as wide. The unit of
    # this height is the width of a pixel.
    height = largest.height * pixel_aspect
    longer = max(largest.width, height)
    side = FILM_STEP * math.ceil(longer / FILM_STEP)  # rounded up
    side = min(max(side, MIN_FILM), MAX_FILM)
    scale = side / longer
    return max(1, round(height * scale)), max(1, round(largest.width * scale))


def compute_mesh_to_camera(
    item: PhotographedObject, asset: assets.ObjectAsset
) -> Float64Array:
    """Return the rigid map (4, 4) from a mesh to OpenCV's camera coordinates.

    Lengths on both sides are in units of the object's size. The image does not depend
    on the unit.

    Raises:
        InputError: the object is a bundled one, which has no file coordinates.
    """
    if asset.file_to_mesh is None:
        raise InputError(f"{item.mesh}: expected a mesh file")
    return reading.backdrop.compute_mesh_to_camera(asset.file_to_mesh, item.pose)


def make_camera_inputs(
    item: PhotographedObject, asset: assets.ObjectAsset, window: PhotoWindow
) -> dict[str, Tensor]:
    """Return the scene inputs of the camera that sees a window of a photograph.

    World coordinates are those of the mesh. The angle of view is that of the longer
    side of the window: 2 * atan(side / (2 * focal length)). The shifts lead from the
    camera's principal point to the window's center, as fractions of the window's width
    (to the right) and height (down).

    Args:
        item: the object, with its pose and the camera of the photograph.
        asset: the object's mesh.
        window: window of the photograph around the object.
    """
    mesh_to_camera = FLIP @ compute_mesh_to_camera(item, asset)
    camera_to_world = np.linalg.inv(mesh_to_camera)
    camera = item.camera
    # The longer side is compared in tangents, as the two focal lengths may differ.
    half_tangent = max(window.width / camera.fx, window.height / camera.fy) / 2.0
    fov = math.degrees(2.0 * math.atan(half_tangent))
    center_x = window.x + window.width / 2.0
    center_y = window.y + window.height / 2.0
    shift_x = (center_x - camera.cx) / window.width
    shift_y = (center_y - camera.cy) / window.height
    return {
        "camera.to_world": torch.from_numpy(camera_to_world).float(),
        "camera.fov": torch.tensor([fov]),
        "camera.shift_x": torch.tensor([shift_x]),
        "camera.shift_y": torch.tensor([shift_y]),
    }


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


def cut_photograph(
    photograph: reading.backdrop.BackdropPhotograph, window: PhotoWindow
) -> Tensor:
    """Return a window (h, w, 3) of a photograph, sRGB in [0, 1]."""
    rows = slice(window.y, window.y + window.height)
    columns = slice(window.x, window.x + window.width)
    levels = photograph.levels[rows, columns]
    return torch.from_numpy(levels.astype(np.float32) / np.float32(255.0))


def load_photograph(path: Path) -> reading.backdrop.BackdropPhotograph:
    """Read a photograph.

    Raises:
        FileFormatError: it is no picture, or too large.
    """
    return reading.backdrop.read_backdrop(path)


def read_front(
    item: PhotographedObject, photograph: reading.backdrop.BackdropPhotograph
) -> npt.NDArray[np.uint8] | None:
    """Return levels (H, W), 255 where another thing hides the object; None if unknown.

    The mask of the object's visible part is widened by a pixel first: its edge is
    jagged, and would otherwise cut into the object.
    """
    if item.visible_mask is None:
        return None
    height, width = photograph.full_size
    all_pixels = PhotoWindow(0, 0, width, height)
    visible = load_mask(item.visible_mask, all_pixels).float()
    widened = F.max_pool2d(visible[None, None], kernel_size=3, stride=1, padding=1)
    hidden = 1.0 - widened[0, 0]
    front: npt.NDArray[np.uint8] = (255.0 * hidden).to(torch.uint8).numpy()
    return front


def load_mask(path: Path, window: PhotoWindow) -> Tensor:
    """Read a window (h, w) bool of a mask; its file is an image, over 1/2 inside."""
    values = reading.pictures.read_image(path, None, is_raw=True)
    mask = cut_window(torch.from_numpy(values[..., 0] > 0.5), window)
    if tuple(mask.shape) != (window.height, window.width):
        raise InputError(f"{path}: expected a mask of the photograph's size")
    return mask


def measure_pose(
    item: PhotographedObject, twin: Twin, window: PhotoWindow
) -> float | None:
    """Return how well a twin's silhouette agrees with that of the data set.

    It is the intersection over union (IoU) of the masks, or else of the boxes. It is
    None if the data set has neither. A low value means that the pose is wrong.
    """
    covered = twin.coverage > 0.5  # in pixels of the window
    if item.mask is not None:
        mask = load_mask(item.mask, window)
        union = int((mask | covered).sum())
        return int((mask & covered).sum()) / union if union else None
    if item.box is None or not bool(covered.any()):
        return None
    return counting.compute_box_iou(_find_box(covered, window), item.box)


def _find_box(covered: Tensor, window: PhotoWindow) -> counting.Box:
    """Return the box in the photograph around covered pixels (h, w) of a window."""
    columns = covered.any(dim=0).nonzero().flatten()
    rows = covered.any(dim=1).nonzero().flatten()
    left = window.x + float(columns[0])
    top = window.y + float(rows[0])
    # The last pixel is part of the box.
    width = float(columns[-1] - columns[0]) + 1
    height = float(rows[-1] - rows[0]) + 1
    return left, top, width, height


@lru_cache(maxsize=64)
def load_object(mesh: Path, unit: str) -> assets.ObjectAsset:
    """Read the mesh of an object in the coordinates of its file.

    Raises:
        InputError: the file cannot be used.
    """
    # These are the directions of the scene, so that the mesh is not rotated.
    scene = workbench.load_scene(mesh, up="z", facing="+x", unit=unit)
    asset: assets.ObjectAsset = scene.description.object
    return asset
