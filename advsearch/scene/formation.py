"""Image formation: from linear radiance to the display-referred picture that the model
sees.

    display = sRGB(clip(gain * denoised(radiance), 0, 1))          (IEC 61966-2-1 transfer)

It is part of a run, named and stored, and the same in search and verification
(docs/design.md, "Image formation"). Verification then rounds to 8 bits, as a file
would.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import Doubles, EnvironmentAsset, Floats, Ints, face_vectors
from advsearch.scene.color import LOW_END, linear_to_srgb, srgb_to_linear
from advsearch.scene.geometry import (
    NEAREST,
    Frame,
    camera_to_world,
    object_to_world,
    rotation,
    standing,
)
from advsearch.scene.grounds import paved
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import looked_up, pixels_in
from advsearch.scene.settings import ORBIT_CAMERA, resolve

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription

DENOISERS = ("oidn", "none")
# samplers of a run's image formation; `advsearch precision` compares more
SAMPLERS = ("independent", "multijitter")
# the one that is taken where nobody asks: its pictures are as good with a third of the
# samples
SAMPLER = "multijitter"
PRIMES = (
    2,
    3,
    5,
    7,
    11,
    13,
    17,
    19,
    23,
    29,
    31,
    37,
    41,
    43,
    47,
    53,
    59,
    61,
    67,
    71,
    73,
    79,
    83,
    89,
    97,
    101,
)
# keeps the slope of a power finite in black; half of one of 255 levels comes of it
DARK = 1e-6


@dataclass(frozen=True)
class ImageFormation:
    """How a picture is formed."""

    # or "none": Intel Open Image Denoise with albedo and normals as guides
    denoiser: str = "oidn"
    # of reconstruction: all others correlate pixels, and then the denoiser does nothing
    filter: ClassVar[str] = "box"
    # how samples are spread over a pixel: "multijitter" (Kensler 2013, Correlated
    # multi-jittered sampling), or "independent", whose noise is more
    sampler: str = SAMPLER
    # stops over the metered exposure; kept for the record, `gain` is what is applied
    exposure: float = 0.0
    resolution: tuple[int, int] = (128, 128)  # (height, width) in pixels
    gain: float = 1.0  # factor from radiance to display-linear values
    # or "gamma", a power of 1/2.2 in its place; "reinhard", sRGB after x / (1 + x),
    # which clips nothing (Reinhard, Stark, Shirley and Ferwerda 2002, Photographic tone
    # reproduction for digital images, equation 3); or "linear", neither clipped nor
    # encoded, for checks of derivatives: the mean of a noisy picture after a curve is
    # not the curve of the mean
    transfer: str = "srgb"
    # the denoiser takes some 0.6 of its time and leaves a little more error
    quick: bool = False

    def __post_init__(self) -> None:
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

    def display(self, radiance: Tensor) -> Tensor:
        """Map linear radiance (..., 3) to display-referred sRGB in [0, 1];
        differentiable, flat where clipped.
        """
        if self.transfer == "linear":
            return radiance * self.gain
        if self.transfer == "gamma":
            return (radiance * self.gain).clamp(DARK, 1.0) ** (1.0 / 2.2)
        if self.transfer == "reinhard":
            light = (radiance * self.gain).clamp_min(0.0)
            return linear_to_srgb(light / (1.0 + light))
        shown: Tensor = _Shown.apply(radiance, self.gain)  # type: ignore[no-untyped-call]
        return shown


class _Shown(torch.autograd.Function):
    """`linear_to_srgb(radiance * gain)` with its derivative, bit for bit, over a third
    of the memory: beside a small model, what autograd keeps of each operation costs as
    much as a product with a matrix of light transport.
    """

    @staticmethod
    def forward(ctx: Any, radiance: Tensor, gain: float) -> Tensor:
        ctx.save_for_backward(radiance)
        ctx.gain = gain
        clipped = (radiance * gain).clamp_(0.0, 1.0)
        low = clipped <= LOW_END
        curve = clipped.clamp(min=LOW_END).pow_(1.0 / 2.4).mul_(1.055).sub_(0.055)
        return torch.where(low, clipped.mul_(12.92), curve)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor, None]:
        (radiance,) = ctx.saved_tensors
        if torch.is_grad_enabled():  # somebody takes a second derivative
            shown = linear_to_srgb(radiance * ctx.gain)
            return torch.autograd.grad(shown, radiance, cotangent, create_graph=True)[
                0
            ], None
        linear = radiance * ctx.gain
        inside = (linear >= 0.0) & (linear <= 1.0)
        slope = (
            linear.clamp(LOW_END, 1.0)
            .pow_(1.0 / 2.4 - 1.0)
            .mul_(1.0 / 2.4)
            .mul_(cotangent * 1.055)
        )
        slope = torch.where(linear <= LOW_END, cotangent * 12.92, slope)
        return torch.where(inside, slope, 0.0).mul_(ctx.gain), None


@lru_cache(maxsize=64)
def next_count(sampler: str, samples: float) -> int:
    """Return the number of samples that a sampler takes when it is asked for at least
    so many. Independent samples come in any number; stratified ones in squares,
    multi-jittered ones in products of two near numbers, orthogonal arrays in squares of
    primes, the low-discrepancy sequence in powers of four.
    """
    whole = max(1, math.ceil(samples - 1e-9))
    root = math.isqrt(whole - 1) + 1
    wide = max(1, math.isqrt(whole))
    if sampler == "stratified":
        return root**2
    if sampler == "multijitter":
        return wide * math.ceil(whole / wide)
    if sampler == "orthogonal":
        return next((prime for prime in PRIMES if prime >= root), PRIMES[-1]) ** 2
    if sampler == "ldsampler":
        return int(4 ** math.ceil(math.log(max(4, whole), 4) - 1e-9))
    return whole


ITEMS: Mapping[str, str] = {
    "tracing": "tracing a render anew: it is recorded once and replayed",
    "uploads": "writing inputs that are as they were, with the sampling tables and the "
    "ray tracing tree that follow",
    "gradients": "derivatives of inputs that no coordinate reaches",
    "boundary": "boundary terms of an adjoint where nothing that it differentiates "
    "moves an outline",
    "lobes": "lobes of the object's surface that have no strength",
    "emitters": "samples of lamps that emit nothing",
}
"""What a scene inside Mitsuba leaves out because a search doesn't need it, by name;
each can be put back.

None of it changes what is computed: pictures and gradients with and without agree to
within their noise, and where the random numbers are the same ones, to within rounding,
which `advsearch check` shows on the scene at hand. Bounces of light are another matter
(`engine.gradients.planning`): leaving those out has a bias, so only the search does it,
within a measured bound, and the verification renders all of them.
"""

EVERYTHING = frozenset(ITEMS)  # leave out all that can be
# leave out nothing: what a program has to do that knows neither scene nor search
NOTHING: frozenset[str] = frozenset()


# ---------------------------------------------------------------------------------------------------------------------
# Exposure: an incident-light meter held where the camera sees the object.
#
# A grey card is laid against every piece of the object's surface that the camera sees,
# and the light that arrives there is averaged over the picture: from the environment as
# far as the surface faces it, and from the ground plane, which is lit by the
# environment itself, from lamps, and from surroundings that emit light. What the object
# is made of takes no part, so that a black object stays black; nor do shadows, which
# would need a render.
#
# The meter is held with camera, pose and rotation of the environment as they are by
# default, and then left alone. So a configuration has the same exposure whether its
# camera is a setting, a control's fixed value or a point of a grid.
#
#     E(n) = integral over directions w of L(w) max(n . w, 0),    L(w) = albedo / pi
# E(up) where w ends on the ground

# pixels along the longer side of the picture in which the surface is looked at
RASTER = 32
ROWS = 32  # rows to which an environment is summed up: irradiance varies slowly
WHITE = 0.8  # reflectance of the card that is metered
# linear display value that it gets, on average over what the camera sees of the object
METERED_WHITE = 0.5
_NINTHS = [(a, b) for a in range(4) for b in range(4 - a)]
WITHIN = (
    np.array([(3 * a + 1, 3 * b + 1, 10 - 3 * a - 3 * b) for a, b in _NINTHS]) / 12.0
)
"""Barycentric weights (10, 3) of the places of a face at which its radiance is looked
up.
"""
MOVED = ("camera.", "pose.", "environment.")
"""Settings whose defaults are metered, by the beginning of their names: those that
controls move.
"""


@lru_cache(maxsize=8)
def metered_gain(scene: SceneDescription) -> float:
    """Return the factor on radiance with which the metered white card gets
    `METERED_WHITE`. Where the camera sees nothing of the object, the card lies on the
    ground; where no light arrives the factor is 1.
    """
    default = {
        name: value for name, value in resolve({}).items() if name.startswith(MOVED)
    }
    scene = replace(
        scene,
        values={**scene.values, **default},
        aspect=1.0,
        camera=ORBIT_CAMERA,
        camera_model=None,
    )
    normals = visible_normals(scene)
    metered = float(
        irradiance(
            scene, normals if len(normals) else np.array([[0.0, 0.0, 1.0]])
        ).mean()
    )
    return METERED_WHITE * math.pi / (WHITE * metered) if metered > 0.0 else 1.0


def irradiance(scene: SceneDescription, normals: Doubles) -> Doubles:
    """Return the irradiance (N, 3) on unshadowed surfaces at the middle of the object,
    with normals (N, 3).
    """
    directions, solid, power = arriving(scene)
    upper = directions[:, 2] > 0.0
    on_ground = (power[upper] * directions[upper, 2:]).sum(axis=0)
    bounced = (
        srgb_to_linear(np.array(scene.ground_color, np.float32)) * on_ground / math.pi
    )
    vertices = scene.base_vertices
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    reach = np.abs(
        middle[:2]
        + directions[:, :2] * (middle[2] / np.maximum(-directions[:, 2:], 1e-9))
    )
    # else the map itself says what comes from below
    on_table = scene.photograph is None and not paved(scene)
    hits = on_table & ~upper & (reach <= scene.number("ground.size") / 2.0).all(axis=1)
    power = np.where(hits[:, None], bounced * solid[:, None], power)
    facing = np.maximum(np.einsum("nk,wk->nw", normals, directions), 0.0)
    # no BLAS, whose last bits depend on its threads
    irradiances = np.asarray(np.einsum("nw,wc->nc", facing, power))
    for lamp in scene.lamps.values():
        way, faced = lamp.lighting(middle)
        if faced.any():  # the lamps of controls are dark as they come
            length = max(float(np.linalg.norm(way)), 1e-12)
            irradiances = (
                irradiances + np.maximum(normals @ (way / length), 0.0)[:, None] * faced
            )
    # what the object emits belongs to what it is made of
    for part in (scene.meshes[name] for name in scene.around):
        if part.emission is not None:
            ways, faced = _emitted(part, part.emission, middle)
            facing = np.maximum(np.einsum("nk,fk->nf", normals, ways), 0.0)
            irradiances = irradiances + np.einsum("nf,fc->nc", facing, faced)
    return irradiances


def arriving(scene: SceneDescription) -> tuple[Doubles, Doubles, Doubles]:
    """Return unit directions (N, 3) to the environment's light, solid angles (N,), and
    radiance times these.
    """
    directions, solid, power = _arriving(scene.environment)
    return (
        directions @ rotation(scene.number("environment.rotation"), 0.0, 0.0).T,
        solid,
        power,
    )


def _emitted(
    part: MeshPart, emission: Floats, place: Doubles
) -> tuple[Doubles, Doubles]:
    """Return unit ways (F, 3) from a place (3,) to the faces of a mesh, and the
    irradiance (F, 3) where each is faced. A face is taken for a disk of its mean
    radiance.
    """
    corners = standing(part)[part.mesh.faces]
    area = face_vectors(corners) / 2.0
    way = corners.mean(axis=1) - place
    far = (way * way).sum(axis=1)
    way = way / np.maximum(np.sqrt(far), 1e-12)[:, None]
    uv = np.einsum("pk,fkc->fpc", WITHIN, part.mesh.uvs[part.mesh.faces])
    height, width = emission.shape[:2]
    mean = looked_up(
        emission, uv[..., 0] * width - 0.5, (1.0 - uv[..., 1]) * height - 0.5
    ).mean(axis=1)
    front = np.maximum(-(area * way).sum(axis=1), 0.0)
    return way, mean * (front / (far + np.linalg.norm(area, axis=1) / math.pi))[:, None]


def visible_normals(scene: SceneDescription) -> Doubles:
    """Return the unit normals (N, 3) of the object's surface in the pixels of a small
    picture, towards the camera.
    """
    camera = camera_to_world(scene)
    points = (scene.base_vertices - camera[:3, 3]) @ camera[:3, :3]
    faces = scene.object.mesh.faces.astype(np.int64)
    faces = faces[(points[faces][..., 2] > NEAREST).all(axis=1)]
    frame = Frame.of(scene.number("camera.fov"), scene.aspect)
    pixel = max(frame.right - frame.left, frame.high - frame.low) / RASTER
    shape = (
        round((frame.high - frame.low) / pixel),
        round((frame.right - frame.left) / pixel),
    )
    tangents = points[faces][..., :2] / points[faces][..., 2:]
    face, row, column, weights = pixels_in(
        (tangents - (frame.left, frame.low)) / pixel - 0.5, shape
    )
    # 1 / depth is linear in the picture
    nearness = (weights / points[faces[face]][..., 2]).sum(axis=1)
    order = np.argsort(nearness, kind="stable")
    front = np.full(shape, -1)
    front[row[order], column[order]] = order  # the nearest comes last
    seen = front[front >= 0]
    linear = object_to_world(scene)[:3, :3]
    normals = (
        weights[seen, :, None] * scene.object.mesh.normals[faces[face[seen]]]
    ).sum(axis=1) @ linear.T
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    middle = points[faces[face[seen]]].mean(axis=1) @ camera[:3, :3].T
    return np.asarray(
        np.where((normals * middle).sum(axis=1, keepdims=True) > 0.0, -normals, normals)
    )


@lru_cache(maxsize=8)
def _arriving(environment: EnvironmentAsset | None) -> tuple[Doubles, Doubles, Doubles]:
    """Unit directions (N, 3) of a coarse map's texels, z up; their solid angles (N,);
    radiance times these (N, 3).
    """
    if environment is None:
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    height, width = environment.radiance.shape[:2]
    rows = _edges(height, ROWS)
    columns = _edges(width, 2 * ROWS)
    # rows 0 and -1 are the poles
    polar = np.clip((np.arange(height + 1) - 0.5) / (height - 1), 0.0, 1.0) * math.pi
    solid = -np.diff(np.cos(polar)) * (2.0 * math.pi / width)
    fine = (
        np.concatenate([environment.radiance, np.ones((height, width, 1))], axis=2)
        * solid[:, None, None]
    )
    summed = np.add.reduceat(
        np.add.reduceat(fine, rows, axis=0), columns, axis=1
    ).reshape(-1, 4)
    ends_r = np.append(rows[1:], height)
    ends_c = np.append(columns[1:], width)
    theta = (rows + ends_r - 1)[:, None] * (0.5 * math.pi / (height - 1))
    azimuth = 0.5 * math.pi - (columns + ends_c) * (math.pi / width)
    up = np.broadcast_to(np.cos(theta), (len(rows), len(columns)))
    directions = np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), up], axis=-1
    )
    return directions.reshape(-1, 3), summed[:, 3], summed[:, :3]


def _edges(size: int, count: int) -> Ints:
    return np.unique(np.linspace(0, size, min(count, size) + 1).astype(np.int64)[:-1])


# ---------------------------------------------------------------------------------------------------------------------
# When the rows of a picture are exposed: an open shutter (motion blur) and rows that
# are read one after the other.
#
# A row r of H is exposed for `shutter` seconds, and rows are read within `rolling`
# seconds, the first at the top, or at the bottom where that is below 0; the middle of
# the picture's exposure is the time of the configuration. What a sensor counts is
# light, so a row is the mean of linear radiance over its exposure, before the denoiser
# and the tone curve. The mean is over M moments, evenly spaced, of which each row takes
# those in its own exposure.

FEWEST = 8
MOST = 64
# moments for each pixel that the fastest point of the picture moves while it is taken
A_PIXEL = 2


class Later(Protocol):
    """Maps a configuration to scene inputs, as `InputSpace` does, at another time."""

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u (d,) to scene inputs by torch operations; differentiable."""


@dataclass(frozen=True, eq=False)
class Moment:
    """A part of an exposure: what the scene is then, its share (H,) of each row, which
    adds up to 1 over all moments, and its share of the samples a pixel.
    """

    space: Later
    rows: Tensor
    samples: float


def moments_of(
    shutter: float, rolling: float, height: int, count: int
) -> tuple[Tensor, Tensor, float]:
    """Return when so many moments M are, in seconds from the middle of the exposure
    (M,); their shares of the rows of a picture (M, H), whose columns add up to 1; and
    the part of a pixel's samples that each takes. Each row is exposed for `shutter`
    seconds, at least 0, and rows are read within `rolling` seconds, from the bottom
    where that is below 0; with as many moments as rows and no shutter, each row has the
    moment of its own.
    """
    is_from_bottom = rolling < 0.0
    rolling = abs(rolling)
    cell = (shutter + rolling) / count
    begins = torch.arange(count, dtype=torch.float64) * cell
    opens = rolling * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    if shutter < cell:  # a row lies within one moment
        nearest = ((opens + shutter / 2.0) / cell).long().clamp_max(count - 1)
        shares = torch.nn.functional.one_hot(nearest, count).T.double()
    else:
        ends = torch.minimum(begins[:, None] + cell, opens + shutter)
        shares = (ends - torch.maximum(begins[:, None], opens)).clamp_min(0.0)
    shares = shares / shares.sum(dim=0)
    if is_from_bottom:
        shares = shares.flip(1)
    offsets = begins + cell / 2.0 - (shutter + rolling) / 2.0
    return offsets, shares.float(), min(1.0, cell / shutter if shutter else 1.0)


# ---------------------------------------------------------------------------------------------------------------------
# What the camera sees first through the middle of each pixel: ground truth beside a
# picture, without noise.

AOVS: Mapping[str, str] = {
    "mask": "1 where the object is seen first, else 0",
    "depth": "distance from the camera along the ray, metres (object sizes where the "
    "object's size is not known); "
    "infinite where there is nothing",
    "normal": "unit shading normal, world space (z up); 0 where there is nothing",
    "uv": "texture coordinates, v = 0 at the bottom row of the texture; 0 where there "
    "is nothing",
    "id": "number of the mesh; 0 where there is nothing",
}
"""What can be asked for, and what its values mean."""
CHANNELS: Mapping[str, str] = {
    "mask": "Y",
    "depth": "Z",
    "normal": "XYZ",
    "uv": "UV",
    "id": "Y",
}
"""The channels of each layer, as EXR calls them."""


def aovs_of(text: str | None) -> tuple[str, ...]:
    """Return the names in a list separated by commas, each once. Raises
    UnknownNameError: one is not of `AOVS`.
    """
    names = dict.fromkeys(
        part.strip() for part in (text or "").split(",") if part.strip()
    )
    for name in names:
        if name not in AOVS:
            raise UnknownNameError("aov", name, AOVS)
    return tuple(names)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surface in each pixel, by the ray through its middle."""

    names: tuple[str, ...]  # of the shapes
    # (H, W) int64: 1 for the first of the names and so on, 0 where there is nothing
    id: Tensor
    # (H, W) distance from the camera, infinite where there is nothing: metres, as
    # renderers say it; object sizes where the object's size is not known, and as
    # Mitsuba's scenes say it
    depth: Tensor
    z_depth: Tensor  # (H, W) the part of it that lies along the camera's axis
    normal: Tensor  # (H, W, 3) unit shading normal in world space
    uv: Tensor  # (H, W, 2) texture coordinates; v = 0 is the bottom row
    face: Tensor  # (H, W) int64 number of the triangle in its mesh

    def seen(self, name: str) -> Tensor:
        """Return where a shape is what is seen, (H, W) bool."""
        return self.id == self.names.index(name) + 1

    def layers(self, aovs: Sequence[str], mask: str) -> dict[str, Tensor]:
        """Return the channels (H, W) of layers of `AOVS`, such as ``normal.X``; `mask`
        names the shape of it.
        """
        channels: dict[str, Tensor] = {}
        for name in aovs:
            value = self.seen(mask).float() if name == "mask" else getattr(self, name)
            planes = value[..., None] if value.ndim == 2 else value
            channels |= {
                f"{name}.{channel}": planes[..., number]
                for number, channel in enumerate(CHANNELS[name])
            }
        return channels

    def notes(self, aovs: Sequence[str]) -> dict[str, str]:
        """Return what the values of the layers mean, by name."""
        numbers = ", ".join(
            f"{number} is {name}" for number, name in enumerate(self.names, 1)
        )
        return {
            name: AOVS[name] + (f"; {numbers}" if name == "id" else "") for name in aovs
        }
