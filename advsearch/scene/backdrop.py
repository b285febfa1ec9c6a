"""Photographs that a scene is rendered into, and the camera that took them.

    display-linear = rendered + shade * photograph + reflection
    shade = 1 - coverage + change of the plane's radiance / its radiance

`rendered` is the object's light times its coverage. The plane is a matt ground below
the object that is itself invisible. Where the object blocks or adds light on the plane,
the photograph is scaled by the same ratio (Debevec 1998, Rendering synthetic objects
into real scenes, section 5, adds the difference instead). Light that a matt surface
reflects is its albedo times the light that arrives. So the ratio is right for any
albedo of the ground at that pixel, and it is never below zero. A difference is right
only where the albedo of the plane is that of the ground, and makes dark ground
negative.

Light that a clear coat on the ground (``ground.gloss``) reflects does not have the
ground's color. Its change, light of the object minus that of the environment behind it,
is added. The part of the photograph that the coat reflects of the environment is not
darkened by a shadow.

The photograph is decoded from sRGB, and averaged over the area of each pixel of the
film. A part of it may be cut out, `photo.jpg#X,Y,WIDTH,HEIGHT` in pixels from its top
left corner. The intrinsics of the camera are adapted to the part.
"""

from __future__ import annotations

import hashlib
import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image, ImageOps
from torch import Tensor

from advsearch.errors import FileFormatError, InputError
from advsearch.pictures import check_decodable, open_image, to_8bit_levels
from advsearch.scene import rendered_channels as channels
from advsearch.scene.assets import Float64Array, ObjectAsset
from advsearch.scene.backdrop_photograph import (
    BackdropPhotograph as BackdropPhotograph,
)
from advsearch.scene.backdrop_photograph import decode_all_levels
from advsearch.scene.camera_model import (
    BROWN_CONRADY,
    EQUIRECTANGULAR,
    LINEAR_PARAMETERS,
    NUMBER_NAMES,
    CameraModel,
    make_bundled_models,
    make_pinhole,
)
from advsearch.scene.color import CHANNELS, linear_to_srgb, srgb_to_linear
from advsearch.scene.depth_pictures import check_no_depth, is_depth, read_depth
from advsearch.scene.formation import Surfaces
from advsearch.scene.geometry import (
    camera_to_world,
    compute_object_to_world,
    project_points,
)
from advsearch.scene.image_quality import measure_blur
from advsearch.scene.scene_data import AnyScene, SceneData
from advsearch.trust.stored_files import (
    LARGEST_FILE,
    record_opened,
    track_opened_files,
)

MAX_ELEVATION = 89.0  # largest elevation of a camera that orbits the object, degrees
MIN_SIDE = 8  # smallest width and height of a photograph or its used part, pixels
# largest error of a product of two rows of a rotation matrix, which should be 0 or 1
ROTATION_TOLERANCE = 1e-3
# largest relative difference between the shapes of a photograph and of its camera
SHAPE_TOLERANCE = 0.01
PHOTOGRAPH_CAMERA = "photograph"  # name of the pinhole of a part of a photograph
# settings of the plane that receives the shadow
PLANE_SETTINGS = frozenset(
    (
        *("ground.size", "ground.level", "ground.gloss", "ground.roughness"),
        *(f"ground.{channel}" for channel in CHANNELS),
    )
)
# A surface of the photograph hides a point only if it is nearer by more than this
# fraction of the depth: so surfaces that touch do not hide each other.
DEPTH_TOLERANCE = 0.01
MIN_BLUR = 0.15  # smallest standard deviation of a visible blur, pixels
PLANE_SIZE = 12.0  # side of the plane, object sizes
# assumed mean reflectance of what a photograph shows, from which its exposure follows:
# that of the grey card to which cameras meter
GREY_CARD = 0.18
ALBEDO_RANGE = (0.05, 0.8)  # smallest and largest albedo of the plane
# radii around the object, in object sizes, between which the plane's color is measured
CONTACT_RING = (0.5, 1.5)
N_CONTACT_POINTS = 400
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of red, green and blue (BT.709)
GROUND = "ground"  # name of the plane that receives the shadow, among surfaces
LIGHT_SUFFIXES = (".hdr", ".exr")
CROP = re.compile(r"(?P<path>.+)#(?P<numbers>\d+,\d+,\d+,\d+)")


def read_backdrop(spec: str | Path) -> BackdropPhotograph:
    """Read a photograph that a scene is to be rendered into.

    Args:
        spec: path of a picture. A part of it is named behind the path, in pixels from
            the top left corner: ``photo.jpg#X,Y,WIDTH,HEIGHT``.

    Raises:
        FileFormatError: the file is missing, no picture, too large, corrupt, too small
            or transparent.
        InputError: the part leaves the photograph.
    """
    text = str(spec)
    part = CROP.fullmatch(text)
    path = Path(part["path"] if part else text)
    with track_opened_files(path), open_image(path, LARGEST_FILE) as image:
        levels = _decode_photograph(image, path)
    height, width = levels.shape[:2]
    crop = (0, 0, width, height)
    if part:
        crop = _parse_crop(part["numbers"], text, (height, width))
    _check_crop_size(crop, path)
    return make_backdrop(levels, text, crop)


def _parse_crop(
    numbers: str, spec: str, size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return left, top, width and height of the part of a photograph that is used.

    Args:
        numbers: these numbers, as the user gives them.
        spec: the photograph with its part, for errors.
        size: height and width of the photograph in pixels.

    Raises InputError: the part leaves the photograph.
    """
    height, width = size
    left, top, crop_width, crop_height = map(int, numbers.split(","))
    if left + crop_width > width or top + crop_height > height:
        raise InputError(
            f"backdrop: {spec} leaves the photograph, which has {width} x {height} "
            "pixels (width x height); give a part inside it"
        )
    return left, top, crop_width, crop_height


def _check_crop_size(crop: tuple[int, int, int, int], path: Path) -> None:
    """Raise InputError if the part of a photograph that is used is too small."""
    if min(crop[2:]) < MIN_SIDE:
        raise InputError(
            f"backdrop: expected at least {MIN_SIDE} x {MIN_SIDE} pixels of "
            f"{path}, got {crop[2]} x {crop[3]}; take another photograph"
        )


def find_photograph_file(photograph: object) -> Path | None:
    """Return the file of a photograph without the part to use; None if it has none."""
    if not isinstance(photograph, (str, Path)):
        return None
    part = CROP.fullmatch(str(photograph))
    return Path(part["path"] if part else photograph)


def find_photographed_light(photograph: object) -> Path | None:
    """Return the environment map next to a photograph, or None if there is none.

    The map of "kitchen.jpg" is "kitchen.hdr" or "kitchen.exr" in the same folder.

    Args:
        photograph: path of the photograph, or another object that a user may pass as
            one; only a path has a map.
    """
    path = find_photograph_file(photograph)
    if path is None:
        return None
    for suffix in LIGHT_SUFFIXES:
        light = path.with_suffix(suffix)
        is_photograph = light == path  # the photograph itself may be an .exr file
        if light.is_file() and not is_photograph:
            # The map is recorded as a file that belongs to the photograph.
            with track_opened_files(path):
                record_opened(light)
            return light
    return None


def with_front(photograph: BackdropPhotograph, spec: str | Path) -> BackdropPhotograph:
    """Return a photograph with the mask or the depth of what is in front of the object.

    Args:
        photograph: the photograph.
        spec: path of a mask: a picture of the full photograph's size, white where
            something is in front of the object, black elsewhere. Or path of the
            photograph's depth: an .exr or .npy file in meters, or a 16-bit picture with
            the meters that one level stands for, such as "depth.png#0.001".

    Raises:
        FileFormatError: the file cannot be used.
        InputError: it has another size than the photograph.
    """
    if is_depth(spec):
        depth = read_depth(spec)
        _check_front_size(photograph, depth.shape, "depths", spec)
        return replace(photograph, depth=depth, front_spec=str(spec))
    path = Path(spec)
    with track_opened_files(path), open_image(path, LARGEST_FILE) as image:
        check_no_depth(image.mode, path)  # a depth without its meters per level
        levels = _decode_photograph(image, path)
    _check_front_size(photograph, levels.shape, "a mask", spec)
    # All channels of a grey mask are the same: this takes green.
    front = np.ascontiguousarray(levels[..., 1])
    return replace(photograph, front=front, front_spec=str(spec))


def _check_front_size(
    photograph: BackdropPhotograph,
    shape: tuple[int, ...],
    what: str,
    spec: str | Path,
) -> None:
    """Raise InputError if a mask or depth (H, W, ...) has not its photograph's size."""
    height, width = photograph.full_size
    if shape[:2] != (height, width):
        raise InputError(
            f"occluder: expected {what} of {width} x {height} pixels (width x height), "
            f"as the photograph has, got {shape[1]} x {shape[0]} in {spec}"
        )


def make_image_inputs(
    description: SceneData, resolution: tuple[int, int]
) -> dict[str, Tensor]:
    """Return the inputs with which a rendered image is laid over its photograph.

    The result is empty if the scene is not rendered into a photograph.

    Returns:
        Tensors by name. ``backdrop.color`` (H, W, 3) is the photograph, display-linear.
        The others are missing if they do not apply:

        - ``backdrop.plane`` (3,): radiance of the plane without the object;
        - ``backdrop.front`` (H, W, 1): fraction of each pixel that something in front
          of the object covers;
        - ``backdrop.depth`` (H S, W S): depth of the photograph in object sizes, at S x
          S points of each pixel;
        - ``backdrop.noise`` (H, W, 3): noise that is added to the rendered object,
          display-referred; missing if it is 0 everywhere;
        - ``backdrop.blur`` (1,): standard deviation in pixels by which the rendered
          object is blurred; missing if it would not be visible.

    Raises:
        InputError: the photograph has depth, and the object's size in meters is not
            known.
    """
    photograph = description.backdrop_photograph
    if photograph is None:
        return {}
    color = photograph.resample(resolution)
    blur = _find_blur(description, color)
    noise_setting = description.values.get("backdrop.noise")
    noise = photograph.make_noise(resolution, noise_setting)
    depth = _resample_depth_in_sizes(description, photograph, resolution)
    inputs: dict[str, Tensor | None] = {
        "backdrop.color": color,
        "backdrop.plane": compute_plane_radiance(description),
        "backdrop.front": photograph.resample_front(resolution),
        "backdrop.depth": depth,
        "backdrop.noise": noise if bool(noise.any()) else None,
        "backdrop.blur": torch.tensor([blur]) if blur >= MIN_BLUR else None,
    }
    return {name: value for name, value in inputs.items() if value is not None}


def _resample_depth_in_sizes(
    description: SceneData, photograph: BackdropPhotograph, resolution: tuple[int, int]
) -> Tensor | None:
    """Return the depth of a photograph in object sizes; None if it has none.

    Raises InputError: it has depth, and the object's size in meters is not known.
    """
    depth = photograph.resample_depth(resolution)
    if depth is None:
        return None
    _check_has_size(description, photograph)
    return depth / description.size_in_metres


def _find_blur(description: SceneData, color: Tensor) -> float:
    """Return the blur of a photograph in pixels: as the user has set it, or measured.

    `color` (H, W, 3) is the photograph at the size of the image.
    """
    blur = description.values.get("backdrop.blur")
    if blur is None:
        luminance = (color.numpy() * LUMINANCE).sum(axis=-1, dtype=np.float32)
        blur = measure_blur(luminance)
    return blur


def _check_has_size(description: SceneData, photograph: BackdropPhotograph) -> None:
    """Raise InputError if the size of the object in meters is not known."""
    if description.object.size_in_metres is None:
        raise InputError(
            f"occluder: {photograph.front_spec} is in metres, and the size of "
            f"{description.object.name} is not known; give its longest side in "
            "metres, such as `size=0.1`"
        )


def compose_over_photograph(
    rendered: Tensor, behind: Tensor, inputs: Mapping[str, Tensor]
) -> Tensor:
    """Lay rendered radiance over a photograph.

    The photograph is visible where the object does not cover the pixel, and where
    something is in front of the object. On the plane it is darkened by the object's
    shadow, and brightened by light that the object reflects.

    Args:
        rendered: (H, W, C), where C is 4, 7 or 13, with the channels of
            `advsearch.scene.rendered_channels`. The radiance is that of the object
            times its coverage.
        behind: (H, W, 3) radiance of the photograph.
        inputs: result of `make_image_inputs`. The first channel of ``backdrop.front``
            is the fraction of the object that is hidden, the last that of the plane.

    Returns:
        Radiance (H, W, 3).
    """
    radiance, coverage = _cover_object(rendered, inputs.get("backdrop.front"))
    # fraction of each pixel in which the photograph is visible
    uncovered = (1.0 - coverage).clamp(0.0, 1.0)
    if "backdrop.plane" not in inputs:
        return radiance + uncovered * behind

    relative_change, coat_change = _compute_plane_changes(rendered, inputs)
    shade = (uncovered + relative_change).clamp_min(0.0)
    has_coat = coat_change.shape[-1] > 0
    if not has_coat:
        return radiance + shade * behind

    # A shadow darkens only the matt ground. `shade` has also darkened the reflection,
    # and what it has lost is added again.
    lost_reflection = (uncovered - shade) * _compute_coat_reflection(rendered, behind)
    return radiance + (shade * behind + lost_reflection + coat_change).clamp_min(0.0)


def _cover_object(rendered: Tensor, front: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return radiance (H, W, 3) and coverage (H, W, 1) of the object's visible part.

    Args:
        rendered: (H, W, C) image with the channels of
            `advsearch.scene.rendered_channels`.
        front: (H, W, 1) or (H, W, 2), first channel: fraction of the object in each
            pixel that something in front of it hides; None for nothing.
    """
    radiance = rendered[..., channels.RADIANCE]
    coverage = rendered[..., channels.COVERAGE]
    if front is None:
        return radiance, coverage
    visible_object = 1.0 - front[..., :1]
    return visible_object * radiance, visible_object * coverage


def _compute_plane_changes(
    rendered: Tensor, inputs: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the visible changes of the plane, and of the light that its coat reflects.

    The first (H, W, 3) is relative to the plane's radiance, and 0 where the plane is
    covered. The second is radiance (H, W, 3), with no channels without a coat. The
    arguments are those of `compose_over_photograph`.
    """
    relative_change = rendered[..., channels.PLANE_CHANGE] / inputs["backdrop.plane"]
    coat_change = rendered[..., channels.COAT_CHANGE]
    front = inputs.get("backdrop.front")
    if front is None:
        return relative_change, coat_change
    # The last channel of two is the plane's. With one, it holds for both.
    visible_plane = 1.0 - front[..., -1:]
    return visible_plane * relative_change, visible_plane * coat_change


def _compute_coat_reflection(rendered: Tensor, behind: Tensor) -> Tensor:
    """Return the reflection (H, W, 3) of the environment that a photograph contains.

    It was rendered for the fraction of the pixel that the object does not cover: the
    division makes it that of a full pixel. It is at most all light of the photograph.

    Args:
        rendered: (H, W, 13) rendered image.
        behind: (H, W, 3) radiance of the photograph.
    """
    uncovered = (1.0 - rendered[..., channels.COVERAGE]).clamp_min(1e-3)
    return torch.minimum(
        rendered[..., channels.ENVIRONMENT_IN_COAT] / uncovered, behind
    )


def compute_front(
    surfaces: Surfaces, photograph_depth: Tensor, n_points: int, radius: int
) -> Tensor:
    """Return the fractions of object and ground that the photograph's depth hides.

    A point is hidden if the photograph there is nearer than the point by more than
    `DEPTH_TOLERANCE`. If none of a pixel's points is on the object, the fraction is
    that of the pixels around it, since a blurred outline may reach into the pixel. The
    same holds for the ground.

    Args:
        surfaces: first surface that the camera sees at n x n points of each pixel.
        photograph_depth: (H n, W n) at the same points, in the unit of `surfaces`.
        n_points: n.
        radius: radius of the surroundings, pixels.

    Returns:
        (H, W, 2) float32 in [0, 1]: fraction of the object, and of the ground.
    """
    is_hidden = photograph_depth < surfaces.z_depth * (1.0 - DEPTH_TOLERANCE)
    is_covered = _find_covered_points(surfaces)

    # Fractions (2, H, W) of each pixel, for object and ground. Pooled once more they
    # are means of the pixels around; their padding cancels in the quotient below.
    pool = torch.nn.functional.avg_pool2d
    covered = pool(is_covered.float(), n_points)
    hidden = pool((is_covered & is_hidden).float(), n_points)
    covered_around = pool(covered, 2 * radius + 1, stride=1, padding=radius)
    hidden_around = pool(hidden, 2 * radius + 1, stride=1, padding=radius)

    is_in_pixel = covered > 0.0
    covered_nearby = torch.where(is_in_pixel, covered, covered_around)
    hidden_nearby = torch.where(is_in_pixel, hidden, hidden_around)
    front: Tensor = (hidden_nearby / covered_nearby.clamp_min(1e-12)).movedim(0, -1)
    return front


def _find_covered_points(surfaces: Surfaces) -> Tensor:
    """Return the points (2, H, W) of an image that object and ground cover."""
    is_ground = torch.zeros_like(surfaces.z_depth, dtype=torch.bool)
    if GROUND in surfaces.shape_names:
        is_ground = surfaces.visible_mask(GROUND)
    is_object = surfaces.z_depth.isfinite() & ~is_ground
    return torch.stack([is_object, is_ground])


def _decode_photograph(image: Image.Image, path: Path) -> npt.NDArray[np.uint8]:
    """Return the 8-bit levels (H, W, 3) of an opened photograph.

    It is rotated upright, as its EXIF data state.

    Raises FileFormatError: it is damaged, too large, or transparent in some pixels.
    """
    check_decodable(image, path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large images and odd metadata
        image.load()
        upright = ImageOps.exif_transpose(image)
    if image.has_transparency_data and _is_transparent(upright):
        raise FileFormatError(
            f"{path}: expected a photograph, got a picture that is transparent in some "
            "pixels; save it without transparency"
        )
    return np.ascontiguousarray(to_8bit_levels(upright, alpha=False))


def _is_transparent(image: Image.Image) -> bool:
    """Return whether some pixel of an image is not opaque."""
    alpha = to_8bit_levels(image, alpha=True)[:, :, 3]
    return bool((alpha < 255).any())


def make_backdrop(
    levels: npt.NDArray[np.uint8],
    spec: str = "photograph",
    crop: tuple[int, int, int, int] | None = None,
) -> BackdropPhotograph:
    """Make a backdrop of 8-bit sRGB levels (H, W, 3).

    Args:
        levels: levels of the full photograph.
        spec: its name for messages.
        crop: left, top, width and height in pixels of the part to use; None: all.

    Raises:
        InputError: the levels have another shape or type.
    """
    _check_levels(levels)
    levels = np.ascontiguousarray(levels)
    digest = hashlib.sha256(f"{levels.shape}".encode() + levels.tobytes()).hexdigest()
    height, width = levels.shape[:2]
    return BackdropPhotograph(spec, levels, digest, crop or (0, 0, width, height))


def _check_levels(levels: npt.NDArray[np.uint8]) -> None:
    """Raise InputError if an array is no photograph (H, W, 3) of 8-bit levels."""
    if levels.ndim != 3 or levels.shape[2] != 3 or levels.dtype != np.uint8:
        raise InputError(
            "backdrop: expected a photograph (h, w, 3) of uint8, got an array of shape "
            f"{levels.shape} of {levels.dtype}"
        )


# ---- The light of a photograph


def compute_photograph_gain(
    description: SceneData, photograph: BackdropPhotograph
) -> float:
    """Return the factor from a scene's radiance to a photograph's linear values.

    With it a level surface of the reflectance `GREY_CARD`, lit by the environment, has
    the mean luminance of the photograph. The factor is 1 if no environment lights the
    scene.
    """
    irradiance = float(compute_level_irradiance(description) @ LUMINANCE)
    if not irradiance > 0.0:
        return 1.0
    mean_luminance = _measure_mean_luminance(photograph)
    # a matt surface has the radiance reflectance * irradiance / pi
    return mean_luminance * math.pi / (GREY_CARD * irradiance)


def _measure_mean_luminance(photograph: BackdropPhotograph) -> float:
    """Return the mean linear luminance of a photograph, at least 1e-3.

    So a black photograph does not make a factor 0.
    """
    # how many pixels have each of the 256 levels
    histograms = [
        np.bincount(photograph.levels[..., channel].reshape(-1), minlength=256)
        for channel in range(len(CHANNELS))
    ]
    decoded = decode_all_levels()
    channel_means = np.array(
        [np.average(decoded, weights=histogram) for histogram in histograms]
    )
    return max(float(channel_means @ LUMINANCE), 1e-3)


def compute_level_irradiance(description: SceneData) -> Float64Array:
    """Return the irradiance (3,) of a level surface under the environment alone.

    It is the irradiance under the map itself, without the setting
    `environment.exposure`. It is 0 without an environment.
    """
    environment = description.environment
    if environment is None:
        return np.zeros(len(CHANNELS))
    rows = environment.radiance.shape[0]
    # cosines of the angle from straight up at the borders between rows
    edge_cosines = np.cos(np.arange(rows + 1) * math.pi / rows)
    upper_cosines = np.maximum(edge_cosines[:-1], 0.0)
    lower_cosines = np.maximum(edge_cosines[1:], 0.0)
    row_means = environment.radiance.mean(axis=1, dtype=np.float64)
    # the integral of cosine times solid angle over each row: 2 pi times that of
    # cos(t) sin(t) dt. It is 0 below the horizon.
    weights = math.pi * (upper_cosines**2 - lower_cosines**2)
    # by a sum, not by BLAS, whose last bits depend on the number of threads
    return np.asarray((weights[:, None] * row_means).sum(axis=0))


def has_plane(description: SceneData) -> bool:
    """Return whether a scene has a plane that receives the shadow in a photograph.

    The plane needs an environment, whose light the object blocks, and a camera above
    it.
    """
    return (
        description.backdrop_photograph is not None
        and description.get_number("ground.size") > 0.0
        and bool((compute_level_irradiance(description) > 0.0).all())
        and camera_to_world(description)[2, 3] > description.get_number("ground.level")
    )


def compute_refractive_index(gloss: float) -> float:
    """Return the index of refraction of a coat by its reflectance at a right angle.

    A reflectance of 1, which no index has, counts as 0.9996.
    """
    amplitude = min(math.sqrt(gloss), 0.9998)
    return (1.0 + amplitude) / (1.0 - amplitude)


def compute_plane_radiance(description: SceneData) -> Tensor | None:
    """Return the radiance (3,) float32 of the plane without the object.

    A diffuse plane has the radiance albedo * irradiance / pi. The result is None if the
    scene has no plane.
    """
    if not has_plane(description):
        return None
    srgb = np.array(description.ground_color, np.float32)
    albedo = srgb_to_linear(srgb).astype(np.float64)
    # The irradiance below is that of the map without this exposure.
    brightness = 2.0 ** description.get_number("environment.exposure")
    radiance = albedo * brightness * compute_level_irradiance(description) / math.pi
    return torch.from_numpy(radiance).float()


def measure_plane_color(
    description: SceneData, photograph: BackdropPhotograph, gain: float
) -> dict[str, float]:
    """Return the settings of the plane's color, sRGB, measured around the object.

    The albedo is the median color of the photograph around the object, divided by the
    color that a white plane would have there. The result is empty if the user has set
    the color, the scene has no plane, or the photograph shows none of it.

    Args:
        description: the scene, with the camera of the full photograph.
        photograph: photograph that it is rendered into.
        gain: factor from radiance to display-linear values.
    """
    names = [f"ground.{channel}" for channel in CHANNELS]
    if not has_plane(description) or description.requested & set(names):
        return {}
    levels = _look_up_levels(description, photograph, _sample_ring(description))
    if not len(levels):
        return {}
    display = levels.astype(np.float32) / np.float32(255.0)
    # (3,) display-linear values of a plane with an albedo of 1
    white = gain * compute_level_irradiance(description) / math.pi
    albedo = np.median(srgb_to_linear(display), axis=0) / white
    color = linear_to_srgb(np.clip(albedo, *ALBEDO_RANGE).astype(np.float32))
    return dict(zip(names, map(float, color), strict=True))


def _sample_ring(description: SceneData) -> Float64Array:
    """Return random points (N, 3) of the ground plane in a ring around the object.

    Its radii are `CONTACT_RING`. The seed is fixed: every call returns the same points.
    """
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.0, 2.0 * math.pi, N_CONTACT_POINTS)
    radius = rng.uniform(*CONTACT_RING, N_CONTACT_POINTS)
    center = compute_object_to_world(description)[:2, 3]
    x = center[0] + radius * np.cos(angle)
    y = center[1] + radius * np.sin(angle)
    level = np.full(N_CONTACT_POINTS, description.get_number("ground.level"))
    return np.column_stack([x, y, level])


def _look_up_levels(
    description: SceneData, photograph: BackdropPhotograph, points: Float64Array
) -> npt.NDArray[np.uint8]:
    """Return the levels (M, 3) of the pixels of a photograph that show points (N, 3).

    Points outside of the photograph are left out, so that M is at most N.

    Args:
        description: the scene with the camera of the full photograph, not of a part.
        photograph: the photograph.
        points: (N, 3) in world space.
    """
    height, width = photograph.full_size
    positions, is_visible = _project_to_photograph(description, (height, width), points)
    size = np.array([width, height])
    # Positions (x to the right, y down) are counted from the middle of the image,
    # pixels from its top left.
    pixels = np.floor(positions.numpy() + size / 2.0).astype(int)
    is_inside = is_visible.numpy() & ((pixels >= 0) & (pixels < size)).all(axis=1)
    column, row = pixels[is_inside].T
    looked_up: npt.NDArray[np.uint8] = photograph.levels[row, column]
    return looked_up


def _project_to_photograph(
    description: SceneData, full_size: tuple[int, int], points: Float64Array
) -> tuple[Tensor, Tensor]:
    """Return where points (N, 3) lie in a full photograph.

    Args:
        description: the scene with the camera of the full photograph, not of a part.
        full_size: height and width of the photograph in pixels.
        points: (N, 3) in world space.

    Returns:
        (N, 2) pixels from the middle of the image, and (N,) whether the camera sees the
        point.
    """
    height, width = full_size
    camera = camera_to_world(description, width / height)
    # points in the camera's coordinates: left, up and ahead
    relative = (points - camera[:3, 3]) @ camera[:3, :3]
    # Projection needs the aspect of the full photograph; that of the description may
    # be that of a part.
    full_description = replace(description, aspect=width / height)
    no_inputs: dict[str, Tensor] = {}
    return project_points(
        full_description, no_inputs, torch.from_numpy(relative), full_size
    )


# ---- The camera of a photograph


def make_matrix_camera(
    camera_matrix: npt.ArrayLike, size: tuple[int, int]
) -> CameraModel:
    """Return the camera of an intrinsic matrix (3, 3), as OpenCV has it.

    Args:
        camera_matrix: camera matrix in pixels; the center of the first pixel is (0, 0).
        size: height and width in pixels of the photographs that it is for.

    Raises:
        InputError: it is not of the form [[fx, skew, cx], [0, fy, cy], [0, 0, 1]].
    """
    matrix = np.asarray(camera_matrix, np.float64)
    _check_camera_matrix(matrix)
    n_coefficients = len(NUMBER_NAMES) - len(LINEAR_PARAMETERS)
    no_distortion = [0.0] * n_coefficients
    numbers = (*_list_linear_parameters(matrix, size), *no_distortion)
    return CameraModel(BROWN_CONRADY, numbers, PHOTOGRAPH_CAMERA, size)


def _list_linear_parameters(matrix: Float64Array, size: tuple[int, int]) -> list[float]:
    """Return the `LINEAR_PARAMETERS` of a camera matrix (3, 3), in their order.

    They are fx, fy, cx, cy and skew, lengths along x as fractions of the width, those
    along y of the height. Half a pixel is added to the principal point, since our (0,
    0) is the corner of the first pixel, not its center. `size` is height and width in
    pixels.
    """
    height, width = size
    return [
        float(matrix[0, 0] / width),
        float(matrix[1, 1] / height),
        float((matrix[0, 2] + 0.5) / width),
        float((matrix[1, 2] + 0.5) / height),
        float(matrix[0, 1] / width),
    ]


def _check_camera_matrix(matrix: Float64Array) -> None:
    """Raise InputError if an array is no intrinsic matrix of OpenCV."""
    is_camera_matrix = (
        matrix.shape == (3, 3)
        and bool(np.isfinite(matrix).all())
        and matrix[1, 0] == 0.0
        and matrix[2].tolist() == [0.0, 0.0, 1.0]
        and min(matrix[0, 0], matrix[1, 1]) > 0.0
    )
    if not is_camera_matrix:
        raise InputError(
            "camera_matrix: expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in "
            f"pixels, got {matrix.tolist()}"
        )


def fit_to_photograph(
    description: AnyScene,
    photograph: BackdropPhotograph,
    resolution: tuple[int, int],
    gain: float,
) -> AnyScene:
    """Return a scene with the camera of the part of a photograph that is used.

    The color of the plane is measured as well, with the camera of the full photograph,
    since points around the object may be outside of the part.

    Args:
        description: the scene, whose camera took the full photograph.
        photograph: photograph that it is rendered into.
        resolution: height and width of the film, pixels.
        gain: factor from radiance to display-linear values, from which the plane's
            color follows.

    Raises:
        InputError: the film, or the camera's picture, has another shape than the
            photograph.
    """
    _check_film(photograph, resolution)
    _check_gloss(description)
    model = _find_full_camera(description, photograph)
    uncropped = replace(description, camera_model=model)
    color_settings = measure_plane_color(uncropped, photograph, gain)
    if photograph.is_cropped:
        model = _crop_camera_or_pinhole(description, photograph, model)
    film_height, film_width = resolution
    return replace(
        description,
        aspect=film_width / film_height,
        camera_model=model,
        values={**description.values, **color_settings},
    )


def _find_full_camera(
    description: SceneData, photograph: BackdropPhotograph
) -> CameraModel | None:
    """Return the lens model that took a full photograph; None for a pinhole.

    Raises InputError: the camera's pictures have another shape than the photograph.
    """
    model = description.camera_model
    if model is None:
        return None
    full_height, full_width = photograph.full_size
    model = _adapt_bundled_model(model, full_width / full_height)
    _check_camera_shape(photograph, model)
    return model


def _adapt_bundled_model(model: CameraModel, aspect: float) -> CameraModel:
    """Return the model for the shape of a full photograph, width over height.

    A bundled model, such as the fisheye, depends on the shape of the image: it is
    replaced. Other models stay.
    """
    bundled_models = make_bundled_models(aspect)
    return bundled_models.get(model.name, model)


def _crop_camera_or_pinhole(
    description: SceneData, photograph: BackdropPhotograph, model: CameraModel | None
) -> CameraModel:
    """Return the camera that sees the used part of a photograph.

    `model` is the camera of the full photograph; None is for the scene's pinhole.
    """
    if model is None:
        full_height, full_width = photograph.full_size
        fov = description.get_number("camera.fov")
        pinhole = make_pinhole(fov, full_width / full_height)
        model = replace(pinhole, name=PHOTOGRAPH_CAMERA)
    return crop_camera(model, photograph)


def crop_camera(model: CameraModel, photograph: BackdropPhotograph) -> CameraModel:
    """Return the camera that sees the used part of a photograph.

    Focal lengths, skew and center are fractions of the image's width or height. Those
    of a part are larger fractions, since the part is smaller. The center also moves by
    the part's top left corner.

    Args:
        model: camera of the full photograph.
        photograph: the photograph, with the part that is used.

    Raises InputError: the camera is a panorama, which has no parts.
    """
    if model.kind == EQUIRECTANGULAR:
        raise InputError(
            f"backdrop: {photograph.spec} is a part of a picture of {model.name}, which "
            "shows all around; give the full photograph"
        )
    values = model.intrinsic_by_name  # a new dictionary
    _crop_intrinsics(values, photograph)
    numbers = tuple(values[name] for name in NUMBER_NAMES)
    # Without a size: the model's own is that of the full photograph.
    return replace(model, intrinsics=numbers, calibrated_shape=None)


def _crop_intrinsics(values: dict[str, float], photograph: BackdropPhotograph) -> None:
    """Change numbers of a lens, by name, to those for the used part of a photograph."""
    left, top, width, height = photograph.crop
    full_height, full_width = photograph.full_size
    values["fx"] *= full_width / width
    values["skew"] *= full_width / width
    values["cx"] = (values["cx"] * full_width - left) / width
    values["fy"] *= full_height / height
    values["cy"] = (values["cy"] * full_height - top) / height


def _check_film(photograph: BackdropPhotograph, resolution: tuple[int, int]) -> None:
    """Raise InputError if a film has another ratio of sides than the photograph.

    Sides that differ by less than a pixel of the film are accepted, as they come from
    rounding. The message suggests the largest part of the photograph that would fit.

    Args:
        photograph: its used part counts.
        resolution: height and width of the film, pixels.
    """
    height, width = photograph.size
    film_height, film_width = resolution
    # A pixel of the film covers so many pixels of the photograph. Rounding the film's
    # sides changes the width in the photograph by no more than that.
    rounding = max(width / film_width, height / film_height)
    if abs(film_width / film_height * height - width) <= rounding:
        return
    part = _suggest_part(photograph, resolution)
    fitting = _suggest_resolution(photograph, resolution)
    raise InputError(
        f"backdrop: {photograph.spec} has {width} x {height} pixels (width x height) "
        f"and the rendered picture {film_width} x {film_height}, which is another "
        f"shape; give a part of the photograph, such as {part}, or another "
        f"`resolution`, such as {fitting}"
    )


def _suggest_part(photograph: BackdropPhotograph, resolution: tuple[int, int]) -> str:
    """Return the largest part of a photograph with a film's shape, as users give it.

    It is in the middle of the used part.
    """
    height, width = photograph.size
    film_height, film_width = resolution
    scale = min(width / film_width, height / film_height)
    part_width = int(film_width * scale)
    part_height = int(film_height * scale)
    left = photograph.crop[0] + (width - part_width) // 2
    top = photograph.crop[1] + (height - part_height) // 2
    path = photograph.spec.partition("#")[0]
    return f"{path}#{left},{top},{part_width},{part_height}"


def _suggest_resolution(
    photograph: BackdropPhotograph, resolution: tuple[int, int]
) -> str:
    """Return a resolution with a photograph's shape and the larger side of a film.

    The setting `resolution` is height x width, while messages have width x height.
    """
    height, width = photograph.size
    shrinking = max(resolution) / max(width, height)
    return f"{max(round(height * shrinking), 1)}x{max(round(width * shrinking), 1)}"


def _check_gloss(description: SceneData) -> None:
    """Check that a gloss of the ground that the user requests has an effect.

    Raises InputError: a roughness is set without a gloss, or a gloss without a plane
    that could reflect the object.
    """
    is_glossy = description.get_number("ground.gloss") > 0.0
    if "ground.roughness" in description.requested and not is_glossy:
        raise InputError(
            "`set` ground.roughness: the ground is matt; give ground.gloss as well, "
            "0.02 as water or 0.04 as varnish, or leave it out"
        )
    if not is_glossy or has_plane(description):
        return
    reason = _explain_missing_plane(description)
    raise InputError(
        f"`set` ground.gloss: {reason}, so that no plane reflects the object; change "
        "that, or leave ground.gloss out"
    )


def _explain_missing_plane(description: SceneData) -> str:
    """Return why a scene has no plane: the first condition that fails."""
    is_lit = bool((compute_level_irradiance(description) > 0.0).all())
    if description.get_number("ground.size") == 0.0:
        return "ground.size is 0"
    if not is_lit:
        return "no environment lights the scene"
    return "the camera is not above ground.level"


def _check_camera_shape(photograph: BackdropPhotograph, model: CameraModel) -> None:
    """Check that a photograph has the shape of its camera's pictures.

    Raises InputError: their ratios of width and height differ by more than
    `SHAPE_TOLERANCE`. A camera without a size fits any photograph.
    """
    if model.calibrated_shape is None:
        return
    height, width = photograph.full_size
    camera_height, camera_width = model.calibrated_shape
    stretch = camera_width * height / (camera_height * width)
    if abs(stretch - 1.0) > SHAPE_TOLERANCE:
        raise InputError(
            f"backdrop: {photograph.spec.partition('#')[0]} has {width} x {height} "
            f"pixels (width x height) and {model.name} is for {camera_width} x "
            f"{camera_height}, which is another shape: the photograph was turned or "
            "cropped; take it as the camera took it, and give the part to use behind "
            "its name, photo.jpg#X,Y,WIDTH,HEIGHT"
        )


# ---- The pose of a photograph


def compute_view_settings(
    asset: ObjectAsset,
    object_to_camera: npt.ArrayLike,
    up: npt.ArrayLike | None = None,
) -> dict[str, float]:
    """Return the settings of the scene in which a camera sees the object in a pose.

    The camera orbits a point on its axis at the depth of the object's center. Without
    settings the object would stand upright at that point; `pose.*` moves and turns it.

    Args:
        asset: the object, from a file whose unit is known.
        object_to_camera: rigid (4, 4) from coordinates of the object's file to those of
            the camera: x right, y down, z ahead, in the file's unit.
        up: (3,) direction in the camera's coordinates that is up in the world; None:
            the object's own up axis, so that it stands upright.

    Returns:
        Values of ``camera.azimuth``, ``camera.elevation``, ``camera.roll``,
        ``camera.distance``, ``pose.*`` and ``ground.level``, the height of the object's
        lowest point, for `load_scene(settings=)`.

    Raises:
        InputError: the object comes from no file, or its size in metres is not known;
            the pose is not rigid, or puts the object behind the camera.
    """
    mesh_to_camera = _check_and_map(asset, object_to_camera)
    vertices = asset.mesh.vertices.astype(np.float64)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    # center of the object in the camera's coordinates; its z is the depth
    center = mesh_to_camera[:3, :3] @ middle + mesh_to_camera[:3, 3]
    distance = float(center[2])
    if distance <= 0.0:
        raise InputError("object_to_camera: puts the object behind the camera")
    world_axes = _make_world_axes(_find_world_up(mesh_to_camera, up))
    rotation = world_axes @ mesh_to_camera[:3, :3]
    # shift of the object's center from the point that the camera orbits, in the world
    orbit_center = np.array([0.0, 0.0, distance])
    offset = world_axes @ (center - orbit_center)
    # The orbited point is at the height `middle[2]`: the mesh stands on the height 0,
    # and that is the height of its center.
    center_height = float(offset[2] + middle[2])
    lowest = center_height + _measure_lowest(vertices - middle, rotation)
    return {
        **_compute_orbit(world_axes),
        # in meters; `_check_and_map` has checked that the size is known
        "camera.distance": distance * (asset.size_in_metres or 1.0),
        **_decompose_rotation(rotation),
        "pose.x": float(offset[0]),
        "pose.y": float(offset[1]),
        # `pose.z` 0 puts the lowest vertex at the height 0. So it is the height of this
        # vertex, on which the ground lies.
        "pose.z": lowest,
        "ground.level": lowest,
    }


def _find_world_up(
    mesh_to_camera: Float64Array, up: npt.ArrayLike | None
) -> Float64Array:
    """Return the direction (3,) in the camera's coordinates that is up in the world.

    Args:
        mesh_to_camera: (4, 4) from the mesh's coordinates to the camera's.
        up: (3,) the direction; None: the object's own up axis, the z axis of the mesh.
    """
    if up is None:
        return mesh_to_camera[:3, 2]
    return np.asarray(up, np.float64)


def _measure_lowest(vertices: Float64Array, rotation: Float64Array) -> float:
    """Return the smallest height of vertices (V, 3) under a rotation (3, 3)."""
    rotated_vertices = vertices @ rotation.T
    return float(rotated_vertices[:, 2].min())


def _check_and_map(asset: ObjectAsset, object_to_camera: npt.ArrayLike) -> Float64Array:
    """Return the map (4, 4) from an object's mesh to camera coordinates.

    The coordinates on both sides are in object sizes.

    Args:
        asset: the object.
        object_to_camera: pose (4, 4) in the unit of the object's file.

    Raises InputError: the pose is not rigid, the object comes from no file, or its size
    in meters is not known.
    """
    pose = _check_rigid(object_to_camera)
    if asset.file_to_mesh is None or asset.size_in_metres is None:
        raise InputError(
            f"{asset.name}: expected an object from a mesh file with a known unit, to "
            "be seen in a measured pose; give `unit`, such as unit=mm"
        )
    return compute_mesh_to_camera(asset.file_to_mesh, pose)


def compute_mesh_to_camera(
    file_to_mesh: Float64Array, pose: Float64Array
) -> Float64Array:
    """Return the rigid map (4, 4) from a mesh to camera coordinates.

    A mesh is in object sizes: its longest side is 1. The camera coordinates of the
    result are in object sizes, too, so that the map has no scale.

    Args:
        file_to_mesh: (4, 4) from coordinates of the object's file to those of its mesh.
        pose: rigid (4, 4) from the file's coordinates to the camera's, both in the
            file's unit.
    """
    mesh_to_file = np.linalg.inv(file_to_mesh)
    # The object's size in the file's unit: the scale of a map of uniform scale is the
    # cube root of its determinant.
    object_size = float(np.cbrt(np.linalg.det(mesh_to_file[:3, :3])))
    mesh_to_camera: Float64Array = pose @ mesh_to_file
    mesh_to_camera[:3] /= object_size  # the last row, (0, 0, 0, 1), stays
    return mesh_to_camera


def _compute_orbit(world_axes: Float64Array) -> dict[str, float]:
    """Return the settings of a camera on an orbit, by world axes (3, 3).

    The rows are the axes x, y and z of the world in the camera's coordinates (x right,
    y down, z ahead). The angles are in degrees.

    Raises InputError: the camera looks straight up or down.
    """
    # Each column is an axis of the camera (right, down, ahead) in world coordinates.
    # The opposite of "ahead" is the direction from the object to the camera.
    right, _down, ahead = world_axes.T
    outwards = -ahead
    elevation = math.degrees(math.asin(min(max(float(outwards[2]), -1.0), 1.0)))
    _check_elevation(elevation)
    return {
        "camera.azimuth": math.degrees(math.atan2(outwards[1], outwards[0])),
        "camera.elevation": elevation,
        "camera.roll": _compute_roll(-right, outwards),
    }


def _check_elevation(elevation: float) -> None:
    """Raise InputError if a camera looks straight up or down; degrees from level."""
    if abs(elevation) > MAX_ELEVATION:
        raise InputError(
            "object_to_camera: the camera looks straight up or down, more than "
            f"{MAX_ELEVATION:g} degrees from level, which no camera does that orbits "
            "the object; give another `up`"
        )


def _compute_roll(left: Float64Array, outwards: Float64Array) -> float:
    """Return the roll of a camera in degrees.

    Args:
        left: (3,) the camera's own left in the world's axes.
        outwards: (3,) direction from the object to the camera.
    """
    # directions to the left and up of a camera without roll, in the world's axes
    level_left = np.array([outwards[1], -outwards[0], 0.0])
    level_left /= np.linalg.norm(level_left)
    upright = np.cross(-outwards, level_left)
    return math.degrees(math.atan2(left @ upright, left @ level_left))


def _check_rigid(pose: npt.ArrayLike) -> Float64Array:
    """Return a pose (4, 4) as float64.

    Raises InputError: it is not rigid, that is a rotation and a translation alone.
    """
    matrix = np.asarray(pose, np.float64)
    if not _is_rigid(matrix):
        raise InputError(
            "object_to_camera: expected a rotation and a translation as a (4, 4) "
            f"matrix, got {matrix.tolist()}"
        )
    return matrix


def _is_rigid(matrix: Float64Array) -> bool:
    """Return whether a matrix is a pose (4, 4): a rotation and a translation alone."""
    return bool(
        matrix.shape == (4, 4)
        and bool(np.isfinite(matrix).all())
        and matrix[3].tolist() == [0.0, 0.0, 0.0, 1.0]
        and np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max()
        <= ROTATION_TOLERANCE
        and np.linalg.det(matrix[:3, :3]) > 0.0
    )


def _make_world_axes(up: Float64Array) -> Float64Array:
    """Return the axes x, y and z of the world, with z along `up`.

    They are the rows of the result (3, 3), in camera coordinates. +x is the horizontal
    part of the direction from the object to the camera.

    Args:
        up: (3,) direction in camera coordinates: x to the right, y down, z ahead.

    Raises InputError: it is no direction.
    """
    if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
        raise InputError(f"up: expected a direction of three numbers, got {up!r}")
    z_axis = up / np.linalg.norm(up)
    towards_camera = np.array([0.0, 0.0, -1.0])
    x_axis = towards_camera - (towards_camera @ z_axis) * z_axis
    if np.linalg.norm(x_axis) < 1e-6:  # the camera looks straight up or down
        # towards the lower border of the image instead
        down = np.array([0.0, 1.0, 0.0])
        x_axis = down - z_axis[1] * z_axis  # its part at right angles to z
    x_axis /= np.linalg.norm(x_axis)
    return np.stack([x_axis, np.cross(z_axis, x_axis), z_axis])


def _decompose_rotation(rotation: Float64Array) -> dict[str, float]:
    """Return the settings that make a rotation (3, 3), degrees.

    The rotation is `Rz(yaw) Ry(pitch) Rx(roll)`.
    """
    # the entry (2, 0) is -sin pitch; (0, 0), (1, 0) and (2, 1), (2, 2) are cosines and
    # sines of yaw and roll times cos pitch
    pitch = math.asin(min(max(-float(rotation[2, 0]), -1.0), 1.0))
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    # At a pitch of 90 degrees yaw and roll are about the same axis, and only their sum
    # or difference is known. With a roll of 0, (0, 1) is -sin yaw and (1, 1) cos yaw.
    is_vertical = abs(rotation[2, 0]) > 1.0 - 1e-9
    if is_vertical:
        yaw = math.atan2(-rotation[0, 1], rotation[1, 1])
        roll = 0.0
    return {
        "pose.yaw": math.degrees(yaw),
        "pose.pitch": math.degrees(pitch),
        "pose.roll": math.degrees(roll),
    }
