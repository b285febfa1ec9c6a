"""What a described scene is inside Mitsuba: plugins and inputs of each part, of camera,
environment and ground.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import singledispatch
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.scene import parts
from advsearch.scene.camera_model import NUMBERS
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.grounds import paved
from advsearch.scene.mitsuba_backend import meshes
from advsearch.scene.mitsuba_backend.variant import (
    Plugin,
    dr,
    fewer_warnings,
    mi,
    population,
)

Write = Callable[[Any], Any]
"""From a Dr.Jit `TensorXf` (perhaps with gradients enabled) to the type that the
Mitsuba parameter takes.
"""
# a single number, or a vertex buffer, which Mitsuba takes flat
number: Write = attrgetter("array")


def plain_number(value: Any) -> float:
    """A single number that is the same for all light paths."""
    return float(value.array[0])


def color(value: Any) -> Any:
    return mi.Color3f(*_entries(value, 3))


def point(value: Any) -> Any:
    return mi.Point3f(*_entries(value, 3))


def transform(value: Any) -> Any:
    entries = _entries(value, 16)
    return mi.Transform4f(
        mi.Matrix4f([entries[4 * row : 4 * row + 4] for row in range(4)])
    )


def as_torch(value: Any) -> Tensor:
    """Return a Dr.Jit value as a torch tensor with memory of its own."""
    # Dr.Jit's own conversion gives a colour six entries
    if isinstance(value, (mi.Color3f, mi.Point3f)):
        return torch.cat([as_torch(component) for component in value])
    value = getattr(value, "matrix", value)
    tensor: Tensor = (
        value.torch()
        if hasattr(value, "torch")
        else torch.tensor(np.array(value, dtype=np.float32))
    )
    return tensor.clone()


def _entries(value: Any, count: int) -> list[Any]:
    return [
        dr.gather(mi.Float, value.array, mi.UInt32(entry)) for entry in range(count)
    ]


@dataclass(frozen=True)
class SceneInput:
    """One named input of a scene."""

    name: str  # the input's name, e.g. "key.position"
    # Mitsuba's parameter path, or its beginning and end with one "*" between for an
    # unknown middle
    key: str
    # converts the tensor; None where Mitsuba takes it itself, as for textures and grids
    write: Write | None = None
    interior: bool = False  # the interior adjoint (`prb`) differentiates it correctly
    # of the tensor; None takes it from Mitsuba's own value
    shape: tuple[int, ...] | None = None
    # Mitsuba's object that has the parameter, where `key` alone may mean several
    owner: Any = None
    # the range that is rendered; a value beyond is moved to its nearer end, and keeps
    # its derivative
    within: tuple[float, float] | None = None

    def rendered(self, value: Tensor) -> Tensor:
        """Return what is set for a value: float32 with memory in order."""
        value = value.detach().to(torch.float32).contiguous()
        return value.clamp(*self.within) if self.within else value


def key_of(parameters: Any, scene_input: SceneInput) -> str | None:
    """Return the one parameter that an input means, or None if the scene has none
    such.
    """
    before, star, after = scene_input.key.partition("*")
    keys = [
        str(key)
        for key in parameters.keys()
        if (
            key.startswith(before) and key.endswith(after)
            if star
            else key == scene_input.key
        )
        and (
            scene_input.owner is None
            or parameters.properties[key][2] is scene_input.owner
        )
    ]
    if len(keys) > 1:
        raise RuntimeError(
            f"expected one Mitsuba parameter {scene_input.key}, found {keys}"
        )
    return keys[0] if keys else None


SURFACE_KEYS = {
    name: f"{name}.value" for name in ("roughness", "metallic", "clearcoat")
} | {"specular": "specular"}
"""Where the principled surface has its numbers."""
IDLE_LOBES: Plugin = {
    name: {"type": "uniform", "value": 0.0} for name in ("clearcoat", "sheen")
}
"""Entries of the principled surface that give it lobes of strength 0."""


@dataclass(frozen=True)
class Translation:
    """A part inside Mitsuba: entries of the scene's dictionary by name, of which one
    that the scene has already ("environment") is replaced; what may be set, with base
    values that `plugins` made; and entries that replace those of the path integrator's
    dictionary (another type, for a medium).
    """

    plugins: Plugin
    inputs: tuple[SceneInput, ...] = ()
    integrator: Plugin = field(default_factory=dict)


@singledispatch
def translation(part: parts.ScenePart) -> Translation:
    """Return what a part is inside Mitsuba. Further kinds of parts are registered:
    `@translation.register`.
    """
    raise TypeError(
        f"part {part.name}: {type(part).__name__} has no translation for "
        "Mitsuba; register one"
    )


@translation.register
def mesh_translation(part: parts.MeshPart, lobes: Plugin | None = None) -> Translation:
    """A mesh; `lobes` are further entries of the principled plugin, such as
    `IDLE_LOBES`.
    """
    name = part.name
    count = len(part.mesh.vertices)
    inputs = [
        SceneInput(
            f"{name}.vertices", f"{name}.{meshes.POSITIONS}", number, shape=(count, 3)
        ),
        SceneInput(
            f"{name}.normals", f"{name}.{meshes.NORMALS}", number, shape=(count, 3)
        ),
    ]
    if part.surface is None:
        surface = meshes.principled(part, lobes)
        inputs.append(
            SceneInput(f"{name}.base_color", f"{name}.*.base_color.data", interior=True)
        )
        inputs += [
            SceneInput(
                f"{name}.{what}",
                f"{name}.*.{key}",
                number,
                True,
                (1,),
                within=meshes.RENDERED.get(what),
            )
            for what, key in SURFACE_KEYS.items()
        ]
    else:

        def fill(options: Mapping[str, object]) -> object:
            made = mi.load_dict(
                meshes.base_texture(part.base_color, options), optimize=False
            )
            inputs.append(
                SceneInput(
                    f"{name}.base_color", f"{name}.*.data", interior=True, owner=made
                )
            )
            return made

        surface = meshes.own_surface(part.surface, fill)
    if meshes.textured_emission(part):
        inputs.append(
            SceneInput(
                f"{name}.radiance", f"{name}.emitter.radiance.data", interior=True
            )
        )
    elif part.emission is not None:
        inputs.append(_light(name, "radiance", "emitter.radiance"))
    return Translation(
        {
            name: meshes.mitsuba_mesh(
                name, part.mesh, part.to_world, surface, meshes.emitter(part)
            )
        },
        tuple(inputs),
    )


def _light(name: str, what: str, key: str) -> SceneInput:
    return SceneInput(f"{name}.{what}", f"{name}.{key}.value", color, True, (3,))


def _pose(name: str, what: str) -> SceneInput:
    return SceneInput(f"{name}.{what}", f"{name}.to_world", transform, shape=(4, 4))


@translation.register
def _plugin(part: parts.PluginPart) -> Translation:
    return Translation(
        {part.name: meshes.loadable(part.plugin)},
        (),
        {"type": "prbvolpath"} if part.volumetric else {},
    )


@translation.register
def _numbers(part: parts.PluginNumbers) -> Translation:
    inputs = []
    for own in part.numbers:
        if own.input.startswith(f"{part.name}."):
            write = (
                plain_number if own.plain else color if len(own.values) == 3 else number
            )
            surface = next(
                (
                    name
                    for name, key in SURFACE_KEYS.items()
                    if own.key.endswith(f".{key}")
                ),
                "",
            )
            exact = "adjoint" in own.valid
            shape = (len(own.values),)
            inputs.append(
                SceneInput(
                    own.input,
                    own.key,
                    write,
                    exact,
                    shape,
                    within=meshes.RENDERED.get(surface),
                )
            )
    return Translation({}, tuple(inputs))


@translation.register
def _point(part: parts.PointLamp) -> Translation:
    name = part.name
    lamp = {
        "type": "point",
        "position": list(part.position),
        "intensity": _rgb(part.intensity),
    }
    position = SceneInput(f"{name}.position", f"{name}.position", point, shape=(3,))
    return Translation({name: lamp}, (position, _light(name, "intensity", "intensity")))


@translation.register
def _spot(part: parts.SpotLamp) -> Translation:
    cutoff, beam = part.cone
    lamp = {
        "type": "spot", "to_world": mi.ScalarTransform4f(part.to_world), "intensity": _rgb(part.intensity),
        "cutoff_angle": cutoff, "beam_width": beam,
    }  # fmt: skip
    return Translation(
        {part.name: lamp}, (_light(part.name, "intensity", "intensity"),)
    )


@translation.register
def _ball(part: parts.BallLamp) -> Translation:
    ball = {
        "type": "sphere", "to_world": mi.ScalarTransform4f().translate(list(part.place)).scale(part.radius),
        "bsdf": {"type": "null"}, "emitter": {"type": "area", "radiance": _rgb(part.radiance)},
    }  # fmt: skip
    inputs = _pose(part.name, "ball"), _light(part.name, "radiance", "emitter.radiance")
    return Translation({part.name: ball}, inputs)


@translation.register
def _projector(part: parts.ProjectorPart) -> Translation:
    """Mitsuba's texture times pi is the irradiance at distance 1, so that it is a white
    screen's radiance.
    """
    name = part.name
    picture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.zeros((*part.sides, 3), np.float32)),
        "raw": True,
    }
    projector = {
        "type": "projector",
        "fov": part.fov,
        "fov_axis": "x",
        "irradiance": {**picture, "wrap_mode": "clamp"},
    }
    pattern = SceneInput(f"{name}.pattern", f"{name}.irradiance.data", interior=True)
    return Translation({name: projector}, (_pose(name, "pose"), pattern))


@translation.register
def _beam(part: parts.BeamLamp) -> Translation:
    """Mitsuba's projector puts pi times its texture on a plane before it, where an
    intensity I puts I cos^3.
    """
    height, width = part.table.shape
    aside = np.linspace(-1.0, 1.0, 2 * width + 1)[1::2]
    up = np.linspace(-1.0, 1.0, 2 * height + 1)[1::2]
    cosine = (1.0 + aside[None] ** 2 + (up[:, None] * height / width) ** 2) ** -0.5
    picture = (part.table * cosine**3 / np.pi)[..., None] * np.array(part.tint)
    lamp = {
        "type": "projector", "to_world": mi.ScalarTransform4f(part.to_world), "fov": 90.0, "fov_axis": "x",
        "irradiance": {**meshes.texture(picture), "wrap_mode": "clamp"}, "sampling_weight": part.weight,
    }  # fmt: skip
    return Translation({part.name: lamp}, (_pose(part.name, "to_world"),))


@translation.register
def _haze(part: parts.HazePart) -> Translation:
    """Mitsuba's medium only holds density and albedo for the integrator: no shape
    refers to it.
    """
    name = part.name
    albedo = _rgb(part.albedo)
    medium = mi.load_dict(
        {"type": "homogeneous", "albedo": albedo, "sigma_t": part.density},
        optimize=False,
    )
    # for good: Mitsuba does not let go of it
    population.add(population, media=(medium,))
    inputs = (
        SceneInput(
            f"{name}.density", f"{name}.sigma_t.value.value", number, True, (1,)
        ),
        SceneInput(f"{name}.albedo", f"{name}.albedo.value.value", color, True, (3,)),
    )
    return Translation(
        {name: medium},
        inputs,
        {"type": "advsearch_haze", "medium": medium, "radius": part.radius},
    )


def _rgb(value: Sequence[float]) -> Plugin:
    return {"type": "rgb", "value": list(value)}


GROUND = "ground"


def scene_dict(
    description: SceneDescription,
    resolution: tuple[int, int],
    filter: str,
    sampler: str,
) -> Plugin:
    """Mitsuba's dictionary of a scene: its camera, its environment and the ground;
    objects come as parts.
    """
    height, width = resolution
    place = mi.ScalarTransform4f
    number = description.number
    film = {
        "type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgba" if description.backdrop else "rgb",
        "component_format": "float32", "rfilter": {"type": filter},
    }  # fmt: skip
    camera: Plugin = {
        **_lens(description), "near_clip": 0.01, "far_clip": 1e5,
        "to_world": place(camera_to_world(description, width / height)), "film": film, "sampler": {"type": sampler},
    }  # fmt: skip
    scene: Plugin = {"type": "scene", "camera": camera}
    if description.environment is not None:
        scene["environment"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(
                np.ascontiguousarray(description.environment.radiance, dtype=np.float32)
            ),
            "scale": 2.0 ** number("environment.exposure"),
            "to_world": place()
            .rotate([0, 0, 1], number("environment.rotation"))
            .rotate([1, 0, 0], 90),
        }
    photograph = description.photograph
    if photograph is not None:
        scene[GROUND] = meshes.mitsuba_mesh(
            GROUND, photograph.mesh, np.eye(4), meshes.matt(photograph.base.numpy())
        )
    elif number("ground.size") > 0.0 and not paved(description):
        reflectance = _rgb(
            srgb_to_linear(np.array(description.ground_color, np.float32)).tolist()
        )
        scene[GROUND] = {
            "type": "rectangle",
            "to_world": place().scale(number("ground.size") / 2.0),
            "bsdf": {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": reflectance},
            },
        }
    return scene


@contextlib.contextmanager
def refusing(description: SceneDescription) -> Iterator[None]:
    """What Mitsuba says of plugins that are the user's, the object's surface among
    them, while they are loaded inside.

    Raises:
        InputError: Mitsuba refuses them.
    """
    own = description.object.surface is not None and not description.object.finishes
    try:
        with fewer_warnings():
            yield
    except (RuntimeError, TypeError, ValueError) as error:
        if not own and not any(
            isinstance(part, parts.PluginPart) for part in description.parts
        ):
            raise
        reason = " ".join(str(error).split())
        raise InputError(
            f"{description.object_name}: Mitsuba refuses the scene: "
            f"{reason}; change it there"
        ) from error


def _lens(description: SceneDescription) -> Plugin:
    model = description.camera_model
    drops = description.number("camera.drops")
    if model is None:
        pinhole: Plugin = {
            "type": "perspective",
            "fov": description.number("camera.fov"),
            "fov_axis": "larger",
        }
        thin = {"type": "thinlens", "aperture_radius": 1e-4, "focus_distance": 1.0}
        return pinhole | thin if description.thin_lens else pinhole
    if description.backdrop and drops > 0.0:
        raise InputError(
            "background: raindrops have no plain background behind them; "
            "leave one of the two out"
        )
    # a searched lens may fold
    if description.backdrop and (model.black > 0.0 or not model.name):
        raise InputError(
            "background: it would show where the camera's lens sees nothing as well; "
            "leave the plain background out, "
            "or take a lens that fills the picture"
        )
    camera: Plugin = {
        "type": "advsearch_camera",
        "kind": model.kind,
        "reach": model.reach,
        **model.values,
    }
    if drops > 0.0:
        camera |= {
            name: description.number(f"camera.{name}")
            for name in ("drops", "drop_size", "drop_seed")
        }
        half = math.radians(description.number("camera.fov")) / 2.0
        camera["drop_tangent"] = max(model.tangents) if model.name else math.tan(half)
    return camera


# what Mitsuba calls numbers of the camera, by the names of our inputs
CAMERA_NUMBERS = {
    "shift_x": "principal_point_offset_x", "shift_y": "principal_point_offset_y", "aperture": "aperture_radius",
    "focus": "focus_distance",
}  # fmt: skip


def scene_inputs(resolution: tuple[int, int]) -> tuple[SceneInput, ...]:
    """The inputs of camera, environment and ground; our field of view is along the
    larger side, Mitsuba's the width.
    """
    height, width = resolution

    def along_width(value: Any) -> Any:
        half = dr.deg2rad(value.array) / 2.0
        return mi.Float(
            2.0 * dr.rad2deg(dr.atan(dr.tan(half) * min(1.0, width / height)))
        )

    return (
        _pose("camera", "to_world"),
        SceneInput("camera.fov", "camera.x_fov", along_width, shape=(1,)),
        SceneInput("camera.lens", "camera.lens", shape=(len(NUMBERS),)),
        *(
            SceneInput(f"camera.{name}", f"camera.{key}", number, shape=(1,))
            for name, key in CAMERA_NUMBERS.items()
        ),
        # (H, W + 2, 3): a copy of the last column before the first, and of the first
        # after the last
        SceneInput("environment.padded", "environment.data", interior=True),
        # (h, w, 3): of a ground that shows the environment's photograph
        # (`advsearch.scene.grounds`)
        SceneInput("ground.reflectance", f"{GROUND}.*.reflectance.data", interior=True),
    )
