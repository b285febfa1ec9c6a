"""Image formation: from linear radiance to the display-referred image of the model.

    display = sRGB(clip(gain * denoised(radiance), 0, 1))       (IEC 61966-2-1 transfer)

It is part of a run, named and stored, and the same in search and verification
(docs/design.md, "Image formation"). Verification then rounds to 8 bits, as a file
would.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import (
    BoolArray,
    EnvironmentAsset,
    Float32Array,
    Float64Array,
    IntArray,
    compute_area_vectors,
)
from advsearch.scene.color import LINEAR_LIMIT, linear_to_srgb, srgb_to_linear
from advsearch.scene.geometry import (
    MIN_DEPTH,
    Frame,
    camera_to_world,
    compute_base_vertices,
    compute_object_to_world,
    list_lamps,
    make_rotation,
)
from advsearch.scene.grounds import is_paved
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import look_up_texture, rasterize_triangles
from advsearch.scene.scene_data import SceneData, cache_per_scene
from advsearch.scene.settings import ORBIT_CAMERA, resolve_settings

DENOISERS = ("oidn", "none")
# samplers of a run's image formation; `advsearch precision` compares more
SAMPLERS = ("independent", "multijitter")
# the default sampler: its images are as good with a third of the samples
SAMPLER = "multijitter"
PRIMES = (
    *(2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41),
    *(43, 47, 53, 59, 61, 67, 71, 73, 79, 83, 89, 97, 101),
)
# Smallest value to which the gamma curve is applied, so that its slope is finite in
# black. It changes a value by at most half of one of 255 levels.
MIN_GAMMA_VALUE = 1e-6


@dataclass(frozen=True)
class ImageFormation:
    """How an image is formed."""

    # "oidn", Intel Open Image Denoise with albedo and normals as guides, or "none"
    denoiser: str = "oidn"
    # Reconstruction filter. Other filters correlate pixels, and then the denoiser has
    # no effect.
    filter: ClassVar[str] = "box"
    # how samples are spread over a pixel: "multijitter" (Kensler 2013, Correlated
    # multi-jittered sampling), or "independent", which has more noise
    sampler: str = SAMPLER
    # Stops above the metered exposure. They are only stored for the record: `gain`
    # includes them.
    exposure: float = 0.0
    resolution: tuple[int, int] = (128, 128)  # (height, width) in pixels
    gain: float = 1.0  # factor from radiance to display-linear values
    # "srgb"; "gamma", a power of 1/2.2 instead; "reinhard", sRGB after x / (1 + x),
    # which clips nothing (Reinhard, Stark, Shirley and Ferwerda 2002, Photographic tone
    # reproduction for digital images, equation 3); or "linear", neither clipped nor
    # encoded, for checks of derivatives: the mean of a noisy image after a curve is not
    # the curve of the mean
    transfer: str = "srgb"
    # whether the denoiser runs in about 0.6 of its time, with a slightly larger error
    quick: bool = False

    def __post_init__(self) -> None:
        """Check the fields.

        Raises InputError: the denoiser or the sampler is unknown, or the resolution is
        too small or too large.
        """
        if self.denoiser not in DENOISERS:
            raise InputError(
                f"denoise: expected one of {', '.join(DENOISERS)}, got "
                f"{self.denoiser!r}"
            )
        if self.sampler not in SAMPLERS:
            raise InputError(
                f"pixel_sampler: expected one of {', '.join(SAMPLERS)}, "
                f"got {self.sampler!r}"
            )
        if min(self.resolution) < 8 or max(self.resolution) > 4096:
            raise InputError(
                f"resolution: expected 8 to 4096 pixels, got {self.resolution}"
            )

    def map_to_display(self, radiance: Tensor) -> Tensor:
        """Map linear radiance (..., 3) to display-referred values in [0, 1].

        Radiance is multiplied by `gain` and goes through the tone curve `transfer`:
        "srgb", "gamma" (1 / 2.2) or "reinhard", which is x / (1 + x) before sRGB's
        curve. "linear" has no curve and is not clipped. The result is differentiable;
        clipped values have the derivative 0.
        """
        if self.transfer == "linear":
            return radiance * self.gain
        if self.transfer == "gamma":
            return (radiance * self.gain).clamp(MIN_GAMMA_VALUE, 1.0) ** (1.0 / 2.2)
        if self.transfer == "reinhard":
            light = (radiance * self.gain).clamp_min(0.0)
            return linear_to_srgb(light / (1.0 + light))
        image: Tensor = _SrgbDisplay.apply(radiance, self.gain)  # type: ignore[no-untyped-call]
        return image


class _SrgbDisplay(torch.autograd.Function):
    """`linear_to_srgb(radiance * gain)` with its derivative in a third of the memory.

    The result is the same bit for bit. With a small model, what autograd stores of each
    operation costs as much as a product with a matrix of light transport.
    """

    @staticmethod
    def forward(ctx: Any, radiance: Tensor, gain: float) -> Tensor:
        """Return the sRGB image of radiance times a gain.

        The result is that of `linear_to_srgb`. Operations are in place to save memory.

        Args:
            ctx: autograd's context, which stores the arguments for `backward`.
            radiance: (..., 3) linear radiance.
            gain: factor from radiance to display-linear values.
        """
        ctx.save_for_backward(radiance)
        ctx.gain = gain
        clipped = (radiance * gain).clamp_(0.0, 1.0)
        is_low = clipped <= LINEAR_LIMIT
        curve = clipped.clamp(min=LINEAR_LIMIT).pow_(1.0 / 2.4).mul_(1.055).sub_(0.055)
        return torch.where(is_low, clipped.mul_(12.92), curve)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor, None]:
        """Return the derivative with respect to the radiance; none for the gain.

        The curve is 12.92 x in the dark and 1.055 x^(1 / 2.4) - 0.055 above; where it
        is clipped the derivative is 0.
        """
        (radiance,) = ctx.saved_tensors
        if torch.is_grad_enabled():
            return _differentiate_display(radiance, ctx.gain, cotangent), None
        linear = radiance * ctx.gain
        is_inside = (linear >= 0.0) & (linear <= 1.0)
        is_dark = linear <= LINEAR_LIMIT
        # The slope of the power is infinite at 0; values that the clamp changes are
        # replaced below. Operations are in place to save memory.
        gradient = linear.clamp(LINEAR_LIMIT, 1.0).pow_(1.0 / 2.4 - 1.0)
        gradient = gradient.mul_(1.0 / 2.4).mul_(cotangent * 1.055)
        gradient = torch.where(is_dark, cotangent * 12.92, gradient)
        gradient = torch.where(is_inside, gradient, 0.0)
        return gradient.mul_(ctx.gain), None


def _differentiate_display(radiance: Tensor, gain: float, cotangent: Tensor) -> Tensor:
    """Return the derivative of an sRGB image by the radiance, with a graph.

    For a second derivative autograd differentiates the plain formula. The saved
    radiance is the input itself, so that it requires a gradient.
    """
    image = linear_to_srgb(radiance * gain)
    (gradient,) = torch.autograd.grad(image, radiance, cotangent, create_graph=True)
    return gradient


@lru_cache(maxsize=64)
def round_sample_count(sampler: str, samples: float) -> int:
    """Round a number of samples up to one that a sampler can take.

    Samplers of Mitsuba take only certain numbers: "stratified" squares, "multijitter"
    products of two similar numbers, "orthogonal" squares of primes, "ldsampler" powers
    of four. "independent" takes any number.

    Args:
        sampler: name of the sampler.
        samples: smallest number of samples per pixel.
    """
    # Here and below 1e-9 is subtracted before rounding up: a number that is above an
    # integer only by a rounding error needs no further sample.
    count = max(1, math.ceil(samples - 1e-9))
    root = math.isqrt(count - 1) + 1  # the square root of the count, rounded up
    if sampler == "stratified":
        return root**2
    if sampler == "multijitter":
        width = max(1, math.isqrt(count))
        return width * math.ceil(count / width)
    if sampler == "orthogonal":
        return next((prime for prime in PRIMES if prime >= root), PRIMES[-1]) ** 2
    if sampler == "ldsampler":
        exponent = math.ceil(math.log(max(4, count), 4) - 1e-9)
        return int(4**exponent)
    return count


OMISSIONS: Mapping[str, str] = {
    "tracing": "tracing a render anew: it is recorded once and replayed",
    "uploads": "writing inputs that are as they were, with the sampling tables and the "
    "ray tracing tree that follow",
    "gradients": "derivatives of inputs that no coordinate reaches",
    "boundary": "boundary terms of an adjoint where nothing that it differentiates "
    "moves an outline",
    "lobes": "lobes of the object's surface that have no strength",
    "emitters": "samples of lamps that emit nothing",
}
"""Steps that a scene inside Mitsuba omits because a search doesn't need them.

Each step can be put back by its name. None of them changes the result: images and
gradients agree to within their noise with and without it, and to within rounding if the
random numbers are the same; `advsearch check` verifies that for a scene. Omitting
bounces of light is different (`engine.gradients.planning`), since it has a bias. So
only the search does it, within a measured bound, and the verification renders all
bounces.
"""

ALL_OMISSIONS = frozenset(OMISSIONS)
# For a program that knows neither the scene nor the search.
NO_OMISSIONS: frozenset[str] = frozenset()


# ----------------------------------------------------------------------------------
# Exposure: an incident-light meter at the visible surface of the object.
#
# The irradiance of every visible piece of the object's surface is computed, and
# averaged over the image. It has light from the environment, from the ground plane
# (which the environment lights), from lamps, and from surroundings that emit light. The
# material of the object is ignored, so that a black object stays black. So are shadows,
# which would need a render.
#
# Camera, pose and rotation of the environment have their default values while the
# exposure is metered. So a configuration has the same exposure whether its camera is a
# setting, a control's fixed value or a point of a grid.
#
#     E(n) = integral over directions w of L(w) max(n . w, 0)
#
# where n is the normal of the surface, and L(w) the radiance from the direction w. It
# is albedo / pi * E(up) if w ends on the ground.

# pixels along the longer side of the image in which the surface is sampled
METERING_SIZE = 32
METERING_ROWS = 32  # rows of a coarse environment: irradiance varies slowly
CARD_REFLECTANCE = 0.8  # reflectance of the card that is metered
# linear display value of the card, on average over the visible surface of the object
CARD_DISPLAY_VALUE = 0.5
_BARYCENTRIC_STEPS = [(a, b) for a in range(4) for b in range(4 - a)]
FACE_SAMPLE_WEIGHTS = (
    np.array(
        [(3 * a + 1, 3 * b + 1, 10 - 3 * a - 3 * b) for a, b in _BARYCENTRIC_STEPS]
    )
    / 12.0
)
"""Barycentric weights (10, 3) of the points of a face at which its radiance is read."""
METERED_DEFAULTS = ("camera.", "pose.", "environment.")
"""Prefixes of the settings that have their defaults while the exposure is metered, such
as "camera.azimuth": controls change these.
"""


@cache_per_scene
def compute_metered_gain(scene: SceneData) -> float:
    """Return the factor from radiance to display values, as an exposure meter would.

    With it a card of the reflectance `CARD_REFLECTANCE` has the display-linear value
    `CARD_DISPLAY_VALUE`, on average over the orientations of the visible surface of the
    object. Camera, pose and light are the default ones. If the object is not visible,
    the card lies flat on the ground. If no light arrives, the factor is 1.
    """
    default_scene = _make_default_view(scene)
    normals = compute_visible_normals(default_scene)
    if not len(normals):  # the object is not visible
        normals = np.array([[0.0, 0.0, 1.0]])
    irradiance = float(compute_irradiance(default_scene, normals).mean())
    has_light = irradiance > 0.0
    if not has_light:
        return 1.0
    # The card is diffuse: its radiance is reflectance * irradiance / pi.
    return CARD_DISPLAY_VALUE * math.pi / (CARD_REFLECTANCE * irradiance)


def _make_default_view(scene: SceneData) -> SceneData:
    """Return a scene with the default camera, pose and light, in a square image.

    The gain must not depend on the camera in use: here it is a pinhole on an orbit.
    """
    default_values = {
        name: value
        for name, value in resolve_settings({}).items()
        if name.startswith(METERED_DEFAULTS)
    }
    return replace(
        scene,
        values={**scene.values, **default_values},
        aspect=1.0,
        camera=ORBIT_CAMERA,
        camera_model=None,
    )


def compute_irradiance(scene: SceneData, normals: Float64Array) -> Float64Array:
    """Return the irradiance (N, 3) on unshadowed surfaces at the object's center.

    It is the sum of the light of environment and ground, of lamps, and of meshes around
    the object that emit light.

    Args:
        scene: the scene.
        normals: (N, 3) unit normals of the surfaces.
    """
    vertices = scene.base_vertices
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    directions, power = _compute_distant_light(scene, center)
    irradiances = _sum_irradiance(normals, directions, power)
    irradiances = _add_lamp_light(irradiances, scene, normals, center)
    # The object's own emission is left out: it does not light the object from outside.
    for name in scene.surrounding_meshes:
        part = scene.meshes[name]
        if part.emission is not None:
            directions, power = _compute_emitted_light(part, part.emission, center)
            irradiances = irradiances + _sum_irradiance(normals, directions, power)
    return irradiances


def _sum_irradiance(
    normals: Float64Array, directions: Float64Array, power: Float64Array
) -> Float64Array:
    """Return the irradiance (N, 3) of surfaces with unit normals (N, 3).

    Args:
        normals: normals of the surfaces.
        directions: (W, 3) unit directions to the light.
        power: (W, 3) irradiance that it causes on a surface turned towards it.
    """
    cosines = np.maximum(np.einsum("nk,wk->nw", normals, directions), 0.0)
    # by `einsum`, not by BLAS, whose last bits depend on the number of threads
    return np.asarray(np.einsum("nw,wc->nc", cosines, power))


def _add_lamp_light(
    irradiances: Float64Array,
    scene: SceneData,
    normals: Float64Array,
    center: Float64Array,
) -> Float64Array:
    """Return irradiances (N, 3) at a point (3,) plus those of lamps.

    `normals` (N, 3) are unit normals of the surfaces.
    """
    for lamp in list_lamps(scene).values():
        to_lamp, lamp_irradiance = lamp.compute_lighting(center)
        if lamp_irradiance.any():  # lamps that a search sets are dark by default
            distance = max(float(np.linalg.norm(to_lamp)), 1e-12)
            cosine = np.maximum(normals @ (to_lamp / distance), 0.0)
            irradiances = irradiances + cosine[:, None] * lamp_irradiance
    return irradiances


def _compute_distant_light(
    scene: SceneData, center: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the light that arrives at a point from environment and ground.

    The ground is a matt square at height 0, lit by the upper half of the environment.
    Its reflected light replaces the environment in directions that hit it.

    Args:
        scene: the scene.
        center: (3,) where the light arrives.

    Returns:
        Unit directions (N, 3) to the light, and its radiance times solid angle (N, 3).
    """
    directions, solid_angle, power = compute_environment_light(scene)
    is_up = directions[:, 2] > 0.0
    # Irradiance is radiance times solid angle times cosine. On level ground the cosine
    # is the z of the direction.
    ground_irradiance = (power[is_up] * directions[is_up, 2:]).sum(axis=0)
    albedo = srgb_to_linear(np.array(scene.ground_color, np.float32))
    reflected_radiance = albedo * ground_irradiance / math.pi
    hits_ground = ~is_up & _find_ground_hits(scene, center, directions)
    power = np.where(
        hits_ground[:, None], reflected_radiance * solid_angle[:, None], power
    )
    return directions, power


def _find_ground_hits(
    scene: SceneData, center: Float64Array, directions: Float64Array
) -> BoolArray:
    """Return which directions (N, 3) from a point (3,) meet a plain ground.

    The result has no meaning for directions that point up.
    """
    # (N, 2) distances along x and y from the middle of the ground at which a direction
    # meets the height 0
    distance = center[2] / np.maximum(-directions[:, 2:], 1e-9)
    offset = np.abs(center[:2] + directions[:, :2] * distance)
    # A photographed or paved ground is a part of the environment map: the light from
    # below is in its lower half.
    has_plain_ground = scene.photograph is None and not is_paved(scene)
    is_on_square = (offset <= scene.get_number("ground.size") / 2.0).all(axis=1)
    hits_ground: BoolArray = has_plain_ground & is_on_square
    return hits_ground


def compute_environment_light(
    scene: SceneData,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the environment's light in a coarse map.

    Returns:
        Unit directions (N, 3) to the light, solid angles (N,), and radiance times solid
        angle (N, 3).
    """
    directions, solid_angle, power = _compute_unrotated_light(scene.environment)
    turn = make_rotation(scene.get_number("environment.rotation"), 0.0, 0.0)
    return directions @ turn.T, solid_angle, power


def _compute_emitted_light(
    part: MeshPart, emission: Float32Array, point: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the light that arrives at a point (3,) from the faces of a mesh.

    A face is approximated by a disk of the same area and mean radiance, which emits
    from its front only. Unlike area / distance^2, the form factor of a disk is finite
    at any distance.

    Args:
        part: the mesh, in its base pose.
        emission: (H, W, 3) radiance map of its texture coordinates.
        point: (3,) in world space.

    Returns:
        Unit directions (F, 3) to the faces; and for each face the irradiance (F, 3)
        that it causes on a surface turned towards it.
    """
    corners = compute_base_vertices(part)[part.mesh.faces]
    area = compute_area_vectors(corners) / 2.0  # (F, 3) along the normals
    offset = corners.mean(axis=1) - point
    squared_distance = (offset * offset).sum(axis=1)
    direction = offset / np.maximum(np.sqrt(squared_distance), 1e-12)[:, None]
    mean_radiance = _measure_face_radiance(part, emission)
    # The direction points to the face, so that a face turned to the point has a
    # negative product. The back of a face emits nothing.
    projected_area = np.maximum(-(area * direction).sum(axis=1), 0.0)
    # the form factor of a disk: area / (distance^2 + area / pi)
    disk_divisor = squared_distance + np.linalg.norm(area, axis=1) / math.pi
    return direction, mean_radiance * (projected_area / disk_divisor)[:, None]


def _measure_face_radiance(part: MeshPart, emission: Float32Array) -> Float32Array:
    """Return the mean radiance (F, 3) float32 of the faces of a mesh.

    `emission` is the radiance map (H, W, 3) of its texture coordinates.
    """
    # (F, P, 2) of P points on each face
    uv = np.einsum("pk,fkc->fpc", FACE_SAMPLE_WEIGHTS, part.mesh.uvs[part.mesh.faces])
    # In columns and rows, which are integers at texel centers. v points up, and rows
    # are numbered downwards.
    height, width = emission.shape[:2]
    column = uv[..., 0] * width - 0.5
    row = (1.0 - uv[..., 1]) * height - 0.5
    return np.asarray(look_up_texture(emission, column, row).mean(axis=1))


def _choose_metering_shape(frame: Frame) -> tuple[float, tuple[int, int]]:
    """Return the width of a pixel of a small image, as a tangent, and its shape."""
    width = frame.right - frame.left
    height = frame.high - frame.low
    pixel_width = max(width, height) / METERING_SIZE
    return pixel_width, (round(height / pixel_width), round(width / pixel_width))


def _find_nearest(
    nearness: Float64Array, row: IntArray, column: IntArray, shape: tuple[int, int]
) -> IntArray:
    """Return the index of the nearest sample in each pixel that has one, (K,).

    The pixels are in the order of the image, row by row.

    Args:
        nearness: (S,) 1 / depth of each sample, which is larger for nearer ones.
        row: (S,) row of the pixel of each sample.
        column: (S,) column of the pixel of each sample.
        shape: height and width of the image.
    """
    order = np.argsort(nearness, kind="stable")
    front_sample = np.full(shape, -1)
    # Samples are written from the farthest to the nearest, so that the nearest sample
    # of a pixel overwrites the others.
    front_sample[row[order], column[order]] = order
    return np.asarray(front_sample[front_sample >= 0])


def compute_visible_normals(scene: SceneData) -> Float64Array:
    """Return the object's unit normals (N, 3) in the pixels of a small image.

    N is the number of pixels that show the object, which nothing else hides. A pixel
    has a normal of the face nearest to the camera, interpolated between its corners, in
    world space. Normals are reversed if they point away from the camera. The image has
    `METERING_SIZE` pixels along its longer side.
    """
    camera = camera_to_world(scene)
    camera_axes = camera[:3, :3]
    # (V, 3) in the camera's coordinates: left, up and ahead
    points = (scene.base_vertices - camera[:3, 3]) @ camera_axes
    faces = scene.object.mesh.faces.astype(np.int64)
    is_ahead = (points[faces][..., 2] > MIN_DEPTH).all(axis=1)
    faces = faces[is_ahead]
    frame = Frame.from_fov(scene.get_number("camera.fov"), scene.aspect)
    pixel_width, shape = _choose_metering_shape(frame)
    pixel_coordinates = _locate_in_raster(points[faces], frame, pixel_width)
    face, row, column, weights = rasterize_triangles(pixel_coordinates, shape)
    # 1 / depth, unlike depth, may be interpolated linearly over the image
    nearness = (weights / points[faces[face]][..., 2]).sum(axis=1)
    visible = _find_nearest(nearness, row, column, shape)

    corners = faces[face[visible]]
    normals = _interpolate_normals(scene, corners, weights[visible])
    # from the camera to the middle of the visible face, in world space
    from_camera = points[corners].mean(axis=1) @ camera_axes.T
    return _turn_against(normals, from_camera)


def _turn_against(normals: Float64Array, directions: Float64Array) -> Float64Array:
    """Return normals (N, 3), reversed where they point along directions (N, 3)."""
    is_along = (normals * directions).sum(axis=1, keepdims=True) > 0.0
    return np.asarray(np.where(is_along, -normals, normals))


def _locate_in_raster(
    points: Float64Array, frame: Frame, pixel_width: float
) -> Float64Array:
    """Return positions (..., 2) of points (..., 3) in the raster of an image, in pixels.

    The image is mirrored and upside down: its columns go to the left and its rows up,
    as the camera's coordinates do. That changes no normal. The frame is symmetric, so
    that the image begins at the same tangents in these directions.

    Args:
        points: points in the camera's coordinates: left, up and ahead.
        frame: frame of the image.
        pixel_width: width of a pixel at distance 1.
    """
    tangents = points[..., :2] / points[..., 2:]
    from_first_corner = tangents - (frame.left, frame.low)
    # The raster's coordinates are 0 at the center of its first pixel, not at the
    # border.
    return np.asarray(from_first_corner / pixel_width - 0.5)


def _interpolate_normals(
    scene: SceneData, corners: IntArray, weights: Float64Array
) -> Float64Array:
    """Return unit normals (N, 3) in world space of points on the object's faces.

    Args:
        scene: scene with the object.
        corners: (N, 3) vertices of the face that each point is on.
        weights: (N, 3) barycentric weights of the corners at the point.
    """
    normals = (weights[:, :, None] * scene.object.mesh.normals[corners]).sum(axis=1)
    normals = normals @ compute_object_to_world(scene)[:3, :3].T
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.asarray(normals)


@lru_cache(maxsize=8)
def _compute_unrotated_light(
    environment: EnvironmentAsset | None,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return an environment's light without its rotation; z is up.

    The map is divided into blocks of texels: up to `METERING_ROWS` rows of blocks, and
    twice as many columns. The light of each block is summed up.

    Returns:
        For N blocks: unit directions (N, 3), solid angles (N,) in steradians, and
        radiance times solid angle (N, 3). N is 0 without an environment.
    """
    if environment is None:
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    height, width = environment.radiance.shape[:2]
    rows = _find_block_starts(height, METERING_ROWS)
    columns = _find_block_starts(width, 2 * METERING_ROWS)
    solid_angle = _compute_texel_solid_angles(height, width)
    # The fourth channel, of ones, becomes the solid angle.
    ones = np.ones((height, width, 1))
    padded_radiance = np.concatenate([environment.radiance, ones], axis=2)
    sums = _sum_over_blocks(padded_radiance * solid_angle[:, None, None], rows, columns)
    directions = _compute_block_directions(rows, columns, (height, width))
    return directions, sums[:, 3], sums[:, :3]


def _sum_over_blocks(
    texels: Float64Array, rows: IntArray, columns: IntArray
) -> Float64Array:
    """Return the sums (blocks, c) of a map (H, W, c) over blocks of texels.

    `rows` and `columns` are the first ones of each block. Blocks are summed over their
    rows, and then over their columns.
    """
    row_sums = np.add.reduceat(texels, rows, axis=0)
    sums = np.add.reduceat(row_sums, columns, axis=1)
    return np.asarray(sums.reshape(-1, texels.shape[2]))


def _compute_texel_solid_angles(height: int, width: int) -> Float64Array:
    """Return the solid angle (H,) of a texel in each row of an environment map.

    The center of row r is at the angle r * pi / (height - 1) from straight up, and its
    borders are half a row before and after it. Half of the first and of the last row is
    beyond a pole, and is cut off.
    """
    border_row = np.arange(height + 1) - 0.5
    border_angle = np.clip(border_row / (height - 1), 0.0, 1.0) * math.pi
    return np.asarray(-np.diff(np.cos(border_angle)) * (2.0 * math.pi / width))


def _compute_block_directions(
    rows: IntArray, columns: IntArray, shape: tuple[int, int]
) -> Float64Array:
    """Return the directions (blocks, 3) of the centers of blocks of an environment map.

    The first row of the map is straight up. Its first column begins at +y, and columns
    continue over +x, -y and -x.

    Args:
        rows: the first row of each block.
        columns: the first column of each block.
        shape: rows and columns of the map, whose first and last row are the poles.
    """
    height, width = shape
    row_ends = np.append(rows[1:], height)
    column_ends = np.append(columns[1:], width)
    # Angle from straight up: row r is at r * pi / (height - 1). The rows of a block,
    # from start to end - 1, have the mean (start + end - 1) / 2.
    doubled_row = rows + row_ends - 1
    polar_angle = doubled_row[:, None] * (0.5 * math.pi / (height - 1))
    # Angle from +y towards +x: column c is at (c + 0.5) * 2 pi / width. The mean of
    # c + 0.5 over a block is (start + end) / 2.
    doubled_column = columns + column_ends
    # An azimuth is measured from +x towards +y.
    azimuth = 0.5 * math.pi - doubled_column * (math.pi / width)
    z = np.broadcast_to(np.cos(polar_angle), (len(rows), len(columns)))
    x = np.sin(polar_angle) * np.cos(azimuth)
    y = np.sin(polar_angle) * np.sin(azimuth)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def _find_block_starts(size: int, count: int) -> IntArray:
    """Return the first row (or column) of each of `count` blocks of about equal size.

    If there are fewer than `count` rows, each is a block.
    """
    bounds = np.linspace(0, size, min(count, size) + 1).astype(np.int64)
    return np.unique(bounds[:-1])


# ----------------------------------------------------------------------------------
# Times at which the rows of an image are exposed: an open shutter (motion blur), and
# rows that are read one after the other (rolling shutter).
#
# Each row is exposed for `shutter` seconds. Rows are read within `rolling` seconds,
# from the top, or from the bottom if `rolling` is negative. The middle of the image's
# exposure is the time of the configuration. A sensor adds up light, so a row is the
# mean of linear radiance over its exposure, before the denoiser and the tone curve. The
# mean is taken over moments, evenly spaced, of which each row has those in its own
# exposure.

MIN_MOMENTS = 8
MAX_MOMENTS = 64
# moments for each pixel that the fastest point of the image moves during the exposure
MOMENTS_PER_PIXEL = 2


class InputMapping(Protocol):
    """Maps a configuration to scene inputs, as `InputSpace` does, at some moment."""

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u (d,) to scene inputs by torch operations; differentiable."""


@dataclass(frozen=True, eq=False)
class Moment:
    """A part of an exposure."""

    input_mapping: InputMapping  # maps configurations to scene inputs at that time
    row_fractions: Tensor  # (H,) its weight in each row; 1 in sum over all moments
    sample_fraction: float  # its fraction of the samples per pixel


def divide_exposure(
    shutter: float, rolling: float, height: int, count: int
) -> tuple[Tensor, Tensor, float]:
    """Divide an exposure into moments.

    The exposure lasts shutter + rolling seconds, from the first row's opening to the
    last row's closing. It is cut into moments of equal length, and a row of the image
    is a weighted mean of them. A moment's weight is proportional to the time for which
    it overlaps with the row's own exposure.

    Args:
        shutter: seconds for which each row is exposed, at least 0.
        rolling: seconds within which rows are read one after the other. If it is
            negative, the lowest row comes first.
        height: height of the image.
        count: M, number of moments.

    Returns:
        (M,) seconds from the middle of the exposure to each moment; (M, H) the weight
        of each moment in each row, 1 in sum over moments; and the fraction of a
        pixel's samples that each moment takes.
    """
    is_from_bottom = rolling < 0.0
    rolling = abs(rolling)
    moment_duration = (shutter + rolling) / count
    moment_starts = torch.arange(count, dtype=torch.float64) * moment_duration
    # (H,) when each row opens, in seconds. The time of reading is divided into one part
    # for each row, and each row opens in the middle of its part.
    row_opens = rolling * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    weights = _weigh_moments(shutter, moment_starts, moment_duration, row_opens)
    weights = weights / weights.sum(dim=0)
    if is_from_bottom:
        row_dimension = 1
        weights = weights.flip(row_dimension)
    # from the middle of the exposure to the middle of each moment
    offsets = moment_starts + moment_duration / 2.0 - (shutter + rolling) / 2.0
    # A row overlaps with shutter / moment_duration moments, each of which takes this
    # fraction of its samples. Without a shutter one moment takes all of them.
    sample_fraction = min(1.0, moment_duration / shutter) if shutter else 1.0
    return offsets, weights.float(), sample_fraction


def _weigh_moments(
    shutter: float, moment_starts: Tensor, moment_duration: float, row_opens: Tensor
) -> Tensor:
    """Return weights (M, H) of moments in rows, not yet 1 in sum.

    Args:
        shutter: seconds for which each row is exposed.
        moment_starts: (M,) when each moment begins, in seconds.
        moment_duration: how long each lasts, in seconds.
        row_opens: (H,) when each row opens, in seconds.
    """
    if shutter < moment_duration:
        # A row is exposed for less than a moment, and belongs to only one: that in
        # which the middle of its exposure is.
        row_middle = row_opens + shutter / 2.0
        moment = (row_middle / moment_duration).long().clamp_max(len(moment_starts) - 1)
        weights: Tensor = torch.nn.functional.one_hot(moment, len(moment_starts))
        return weights.T.double()
    # (M, H) seconds for which moment and row overlap
    moment_ends = moment_starts + moment_duration
    overlap_start = torch.maximum(moment_starts[:, None], row_opens)
    overlap_end = torch.minimum(moment_ends[:, None], row_opens + shutter)
    return (overlap_end - overlap_start).clamp_min(0.0)


# ----------------------------------------------------------------------------------
# The surface that the ray through the center of each pixel hits first: ground truth of
# an image, without noise.

AOVS: Mapping[str, str] = {
    "mask": "1 where the object is visible, else 0",
    "depth": "distance from the camera along the ray, metres (object sizes if the "
    "object's size is not known); "
    "infinite where there is nothing",
    "normal": "unit shading normal, world space (z up); 0 where there is nothing",
    "uv": "texture coordinates, v = 0 at the bottom row of the texture; 0 where there "
    "is nothing",
    "id": "index of the mesh, from 1; 0 where there is nothing",
}
"""Layers that can be requested, and what their values mean."""
CHANNELS: Mapping[str, str] = {
    "mask": "Y",
    "depth": "Z",
    "normal": "XYZ",
    "uv": "UV",
    "id": "Y",
}
"""The channels of each layer, by EXR's names."""


def parse_aovs(text: str | None) -> tuple[str, ...]:
    """Parse a list of layers such as "depth,normal"; each is returned once.

    Args:
        text: names separated by commas; None or empty for no layers.

    Raises:
        UnknownNameError: a name is not in `AOVS`.
    """
    stripped = [name.strip() for name in (text or "").split(",")]
    names = tuple(dict.fromkeys(name for name in stripped if name))
    for name in names:
        if name not in AOVS:
            raise UnknownNameError("aov", name, AOVS)
    return names


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surface in each pixel, by the ray through its center."""

    shape_names: tuple[str, ...]  # names of the shapes
    # (H, W) int64: 1 for the first of the names and so on, 0 where there is nothing
    id: Tensor
    # (H, W) distance from the camera, infinite where there is nothing. Renderers return
    # it in meters, or in object sizes if the object's size is not known; Mitsuba's
    # scenes always return object sizes.
    depth: Tensor
    z_depth: Tensor  # (H, W) component of the distance along the camera's axis
    normal: Tensor  # (H, W, 3) unit shading normal in world space
    uv: Tensor  # (H, W, 2) texture coordinates; v = 0 is the bottom row
    face_index: Tensor  # (H, W) int64 index of the triangle in its mesh

    def visible_mask(self, name: str) -> Tensor:
        """Return where a shape is visible, (H, W) bool."""
        return self.id == self.shape_names.index(name) + 1

    def make_layers(self, aovs: Sequence[str], mask: str) -> dict[str, Tensor]:
        """Return the channels (H, W) of layers, such as ``normal.X``.

        Args:
            aovs: names from `AOVS`.
            mask: the shape whose mask is the layer "mask".
        """
        channels: dict[str, Tensor] = {}
        for name in aovs:
            if name == "mask":
                layer = self.visible_mask(mask).float()
            else:
                layer = getattr(self, name)
            lacks_channel_axis = layer.ndim == 2
            planes = layer[..., None] if lacks_channel_axis else layer
            for index, channel in enumerate(CHANNELS[name]):
                channels[f"{name}.{channel}"] = planes[..., index]
        return channels

    def describe_layers(self, aovs: Sequence[str]) -> dict[str, str]:
        """Return what the values of the layers mean, by name."""
        notes = {name: AOVS[name] for name in aovs}
        if "id" in notes:
            meanings = [
                f"{index} is {name}" for index, name in enumerate(self.shape_names, 1)
            ]
            notes["id"] += f"; {', '.join(meanings)}"
        return notes
