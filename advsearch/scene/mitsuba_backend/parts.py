"""What a described scene is inside Mitsuba: plugins and inputs of each part, of camera, environment and ground."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import singledispatch
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.scene.camera_model import NUMBERS
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.grounds import paved
from advsearch.scene.mitsuba_backend.meshes import (
    NORMALS,
    POSITIONS,
    RENDERED,
    base_texture,
    emitter,
    loadable,
    matt,
    mitsuba_mesh,
    own_surface,
    principled,
    texture,
    textured_emission,
)
from advsearch.scene.mitsuba_backend.variant import Plugin, dr, fewer_warnings, mi, population
from advsearch.scene.parts import (
    BallLamp,
    BeamLamp,
    HazePart,
    Lamp,
    MeshPart,
    PluginNumbers,
    PluginPart,
    PointLamp,
    ProjectorPart,
    ScenePart,
    SpotLamp,
)

Write = Callable[[Any], Any]
"""From a Dr.Jit `TensorXf` (perhaps with gradients enabled) to the type that the Mitsuba parameter takes."""


flat: Write = attrgetter("array")
"""Vertex buffers: Mitsuba takes a flat array."""
number: Write = attrgetter("array")
"""A single number."""


def plain_number(value: Any) -> float:
    """A single number that is the same for all light paths."""
    return float(value.array[0])


def color(value: Any) -> Any:
    """Three numbers: an RGB colour."""
    return mi.Color3f(*_entries(value, 3))


def point(value: Any) -> Any:
    """Three numbers: a place."""
    return mi.Point3f(*_entries(value, 3))


def transform(value: Any) -> Any:
    """A 4 x 4 matrix, row by row."""
    found = _entries(value, 16)
    return mi.Transform4f(mi.Matrix4f([found[4 * row : 4 * row + 4] for row in range(4)]))


def as_torch(value: Any) -> Tensor:
    """Return a Dr.Jit value as a torch tensor with memory of its own."""
    if isinstance(value, (mi.Color3f, mi.Point3f)):  # Dr.Jit's own conversion gives a colour six entries
        return torch.cat([as_torch(component) for component in value])
    value = getattr(value, "matrix", value)
    if hasattr(value, "torch"):
        tensor: Tensor = value.torch()
        return tensor.clone()
    return torch.tensor(np.array(value, dtype=np.float32))


def _entries(value: Any, count: int) -> list[Any]:
    return [dr.gather(mi.Float, value.array, mi.UInt32(entry)) for entry in range(count)]


@dataclass(frozen=True)
class SceneInput:
    """One named input of a scene.

    Attributes:
        name: the input's name, e.g. "key.position".
        key: Mitsuba's parameter path, or its beginning and end with one "*" between for an unknown middle.
        write: converts the tensor; None where Mitsuba takes it itself, as for textures and grids.
        interior: the interior adjoint (`prb`) differentiates it correctly.
        shape: of the tensor; None takes it from Mitsuba's own value.
        owner: Mitsuba's object that has the parameter, where `key` alone may mean several.
        within: the range that is rendered; a value beyond is moved to its nearer end, and keeps its derivative.
    """

    name: str
    key: str
    write: Write | None = None
    interior: bool = False
    shape: tuple[int, ...] | None = None
    owner: Any = None
    within: tuple[float, float] | None = None

    def rendered(self, value: Tensor) -> Tensor:
        """Return what is set for a value: float32 with memory in order."""
        value = value.detach().to(torch.float32).contiguous()
        return value.clamp(*self.within) if self.within else value


def key_of(parameters: Any, one: SceneInput) -> str | None:
    """Return the parameter that an input means, or None if the scene has none such.

    Raises:
        RuntimeError: there are several.
    """
    before, star, after = one.key.partition("*")
    found = [
        key
        for key in parameters.keys()
        if (key.startswith(before) and key.endswith(after) if star else key == one.key)
        and (one.owner is None or parameters.properties[key][2] is one.owner)
    ]
    if len(found) > 1:
        raise RuntimeError(f"expected one Mitsuba parameter {one.key}, found {found}")
    return str(found[0]) if found else None


SURFACE_KEYS = {"roughness": "roughness.value", "metallic": "metallic.value", "clearcoat": "clearcoat.value"} | {
    "specular": "specular"
}
"""Where the principled surface has its numbers."""
ABSENT = {"type": "uniform", "value": 0.0}
IDLE_LOBES: Plugin = {name: ABSENT for name in ("clearcoat", "sheen")}
"""Entries of the principled surface that give it lobes of strength 0."""


@dataclass(frozen=True)
class Translation:
    """A part inside Mitsuba.

    Attributes:
        plugins: entries of the scene's dictionary (plugin dictionaries or objects) by name. A name that the scene has
            already ("environment") is replaced.
        inputs: what may be set; the base value of each is whatever `plugins` made.
        integrator: entries that replace those of the path integrator's dictionary (another type, for a medium).
    """

    plugins: Plugin
    inputs: tuple[SceneInput, ...] = ()
    integrator: Plugin = field(default_factory=dict)


@singledispatch
def translation(part: ScenePart) -> Translation:
    """Return what a part is inside Mitsuba. Further kinds of parts are registered: `@translation.register`."""
    raise TypeError(f"part {part.name}: {type(part).__name__} has no translation for Mitsuba; register one")


@translation.register
def mesh_translation(part: MeshPart, lobes: Plugin | None = None) -> Translation:
    """A mesh.

    Args:
        part: the mesh.
        lobes: further entries of the principled plugin's dictionary, such as `IDLE_LOBES`.
    """
    name, count = part.name, len(part.mesh.vertices)
    inputs: tuple[SceneInput, ...] = (
        SceneInput(f"{name}.vertices", f"{name}.{POSITIONS}", flat, shape=(count, 3)),
        SceneInput(f"{name}.normals", f"{name}.{NORMALS}", flat, shape=(count, 3)),
    )
    if part.surface is None:
        surface = principled(part, lobes)
        inputs += (SceneInput(f"{name}.base_color", f"{name}.*.base_color.data", interior=True),)
        inputs += tuple(
            SceneInput(f"{name}.{one}", f"{name}.*.{key}", number, True, (1,), within=RENDERED.get(one))
            for one, key in SURFACE_KEYS.items()
        )
    else:
        textures = []

        def fill(options: Mapping[str, object]) -> object:
            textures.append(mi.load_dict(base_texture(part.base_color, options), optimize=False))
            return textures[-1]

        surface = own_surface(part.surface, fill)
        inputs += tuple(
            SceneInput(f"{name}.base_color", f"{name}.*.data", interior=True, owner=one) for one in textures
        )
    if part.emission is not None:
        inputs += (_radiance(part),)
    return Translation({name: mitsuba_mesh(name, part.mesh, part.to_world, surface, emitter(part))}, inputs)


def _radiance(part: MeshPart) -> SceneInput:
    name, place = f"{part.name}.radiance", f"{part.name}.emitter.radiance"
    if textured_emission(part):
        return SceneInput(name, f"{place}.data", interior=True)
    return SceneInput(name, f"{place}.value", color, interior=True, shape=(3,))


@translation.register
def _plugin(part: PluginPart) -> Translation:
    return Translation({part.name: loadable(part.plugin)}, (), {"type": "prbvolpath"} if part.volumetric else {})


@translation.register
def _numbers(part: PluginNumbers) -> Translation:
    inputs = [
        SceneInput(
            one.input,
            one.key,
            plain_number if one.plain else color if len(one.values) == 3 else number,
            "adjoint" in one.valid,
            (len(one.values),),
            within=RENDERED.get(next((name for name, key in SURFACE_KEYS.items() if one.key.endswith(f".{key}")), "")),
        )
        for one in part.numbers
        if one.input.startswith(f"{part.name}.")
    ]
    return Translation({}, tuple(inputs))


@translation.register
def _point(part: PointLamp) -> Translation:
    name = part.name
    inputs = (
        SceneInput(f"{name}.position", f"{name}.position", point, shape=(3,)),
        SceneInput(f"{name}.intensity", f"{name}.intensity.value", color, interior=True, shape=(3,)),
    )
    lamp = {"type": "point", "position": list(part.position), "intensity": _rgb(part.intensity)}
    return Translation({name: lamp}, inputs)


@translation.register
def _spot(part: SpotLamp) -> Translation:
    name, (cutoff, beam) = part.name, part.cone
    inputs = (SceneInput(f"{name}.intensity", f"{name}.intensity.value", color, interior=True, shape=(3,)),)
    lamp = {
        "type": "spot",
        "to_world": mi.ScalarTransform4f(part.to_world),
        "intensity": _rgb(part.intensity),
        "cutoff_angle": cutoff,
        "beam_width": beam,
    }
    return Translation({name: lamp}, inputs)


@translation.register
def _ball(part: BallLamp) -> Translation:
    name = part.name
    ball = {
        "type": "sphere",
        "to_world": mi.ScalarTransform4f().translate(list(part.place)).scale(part.radius),
        "bsdf": {"type": "null"},
        "emitter": {"type": "area", "radiance": _rgb(part.radiance)},
    }
    inputs = (
        SceneInput(f"{name}.ball", f"{name}.to_world", transform, shape=(4, 4)),
        SceneInput(f"{name}.radiance", f"{name}.emitter.radiance.value", color, interior=True, shape=(3,)),
    )
    return Translation({name: ball}, inputs)


@translation.register
def _projector(part: ProjectorPart) -> Translation:
    """Mitsuba's texture times pi is the irradiance at distance 1, so that it is a white screen's radiance."""
    name = part.name
    inputs = (
        SceneInput(f"{name}.pose", f"{name}.to_world", transform, shape=(4, 4)),
        SceneInput(f"{name}.pattern", f"{name}.irradiance.data", interior=True),
    )
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((*part.sides, 3), np.float32)), "raw": True}
    projector = {"type": "projector", "fov": part.fov, "fov_axis": "x", "irradiance": {**picture, "wrap_mode": "clamp"}}
    return Translation({name: projector}, inputs)


@translation.register
def _beam(part: BeamLamp) -> Translation:
    """Mitsuba's projector puts pi times its texture on a plane before it, where an intensity I puts I cos^3."""
    height, width = part.table.shape
    aside, up = np.linspace(-1.0, 1.0, 2 * width + 1)[1::2], np.linspace(-1.0, 1.0, 2 * height + 1)[1::2]
    cosine = (1.0 + aside[None] ** 2 + (up[:, None] * height / width) ** 2) ** -0.5
    picture = (part.table * cosine**3 / np.pi)[..., None] * np.array(part.tint)
    lamp = {
        "type": "projector",
        "to_world": mi.ScalarTransform4f(part.to_world),
        "fov": 90.0,
        "fov_axis": "x",
        "irradiance": {**texture(picture), "wrap_mode": "clamp"},
        "sampling_weight": part.weight,
    }
    return Translation(
        {part.name: lamp}, (SceneInput(f"{part.name}.to_world", f"{part.name}.to_world", transform, shape=(4, 4)),)
    )


@translation.register
def _haze(part: HazePart) -> Translation:
    """Mitsuba's medium only holds density and albedo for the integrator: no shape refers to it."""
    name, albedo = part.name, _rgb(part.albedo)
    medium = mi.load_dict({"type": "homogeneous", "albedo": albedo, "sigma_t": part.density}, optimize=False)
    population.keep(medium)
    inputs = (
        SceneInput(f"{name}.density", f"{name}.sigma_t.value.value", number, True, (1,)),
        SceneInput(f"{name}.albedo", f"{name}.albedo.value.value", color, True, (3,)),
    )
    return Translation({name: medium}, inputs, {"type": "advsearch_haze", "medium": medium, "radius": part.radius})


def _rgb(value: Sequence[float]) -> Plugin:
    return {"type": "rgb", "value": list(value)}


def leave_dark_lamps_out(plugins: Plugin, parts: Sequence[ScenePart]) -> None:
    """Take no samples towards lamps that emit nothing.

    A path that arrives at one by chance still counts, with all of the weight, so that nothing is biased should it be
    lit after all.

    Args:
        plugins: Mitsuba's dictionary of the scene; changed.
        parts: of the scene.
    """
    for part in parts:
        if isinstance(part, Lamp) and part.dark:
            plugin = plugins[part.name]
            plugin.get("emitter", plugin)["sampling_weight"] = 0.0


GROUND = "ground"
GROUND_INPUT = SceneInput("ground.reflectance", f"{GROUND}.*.reflectance.data", interior=True)
"""(h, w, 3): the texture of a ground that shows the environment's photograph (`advsearch.scene.grounds`)."""


def scene_dict(description: SceneDescription, resolution: tuple[int, int], filter: str, sampler: str) -> Plugin:
    """Mitsuba's dictionary of a scene: its camera, its environment and the ground; objects come as parts."""
    place = mi.ScalarTransform4f
    number = description.number
    scene: Plugin = {"type": "scene", "camera": _camera(description, resolution, filter, sampler)}
    if description.environment is not None:
        scene["environment"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(description.environment.radiance, dtype=np.float32)),
            "scale": 2.0 ** number("environment.exposure"),
            "to_world": place().rotate([0, 0, 1], number("environment.rotation")).rotate([1, 0, 0], 90),
        }
    photograph = description.photograph
    if photograph is not None:
        scene[GROUND] = mitsuba_mesh(GROUND, photograph.mesh, np.eye(4), matt(photograph.base.numpy()))
    elif number("ground.size") > 0.0 and not paved(description):
        reflectance = srgb_to_linear(np.array(description.ground_color, np.float32)).tolist()
        scene[GROUND] = {
            "type": "rectangle",
            "to_world": place().scale(number("ground.size") / 2.0),
            "bsdf": {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}},
            },
        }
    return scene


@contextlib.contextmanager
def refusing(description: SceneDescription) -> Iterator[None]:
    """What Mitsuba says of plugins that are the user's, the object's surface among them, while they are loaded inside.

    Raises:
        InputError: Mitsuba refuses them.
    """
    own = description.object.surface is not None and not description.object.finishes
    try:
        with fewer_warnings():
            yield
    except (RuntimeError, TypeError, ValueError) as error:
        if not own and not any(isinstance(part, PluginPart) for part in description.parts):
            raise
        said = " ".join(str(error).split())
        raise InputError(f"{description.object_name}: Mitsuba refuses the scene: {said}; change it there") from error


def _camera(description: SceneDescription, resolution: tuple[int, int], filter: str, sampler: str) -> Plugin:
    height, width = resolution
    camera: Plugin = {
        **_lens(description),
        "near_clip": 0.01,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(camera_to_world(description, width / height)),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba" if description.backdrop else "rgb",
            "component_format": "float32",
            "rfilter": {"type": filter},
        },
        "sampler": {"type": sampler},
    }
    return camera


def _lens(description: SceneDescription) -> Plugin:
    """The plugin of a camera, with what is before its place and its film."""
    model = description.camera_model
    if model is not None:
        if description.backdrop and description.number("camera.drops") > 0.0:
            raise InputError("background: raindrops have no plain background behind them; leave one of the two out")
        if description.backdrop and (model.black > 0.0 or not model.name):  # a searched lens may fold
            raise InputError(
                "background: it would show where the camera's lens sees nothing as well; leave the plain background "
                "out, or take a lens that fills the picture"
            )
        drops = {name: description.number(f"camera.{name}") for name in ("drops", "drop_size", "drop_seed")}
        tangent = max(model.tangents) if model.name else math.tan(math.radians(description.number("camera.fov")) / 2.0)
        drops |= {"drop_tangent": tangent}
        return {"type": "advsearch_camera", "kind": model.kind, "reach": model.reach, **model.values, **drops}
    pinhole: Plugin = {"type": "perspective", "fov": description.number("camera.fov"), "fov_axis": "larger"}
    if description.thin_lens:
        pinhole |= {"type": "thinlens", "aperture_radius": 1e-4, "focus_distance": 1.0}
    return pinhole


def camera_inputs(resolution: tuple[int, int]) -> tuple[SceneInput, ...]:
    """The camera's inputs. Our field of view is along the larger side, Mitsuba's parameter along the width."""
    height, width = resolution

    def along_width(value: Any) -> Any:
        half = dr.deg2rad(value.array) / 2.0
        return mi.Float(2.0 * dr.rad2deg(dr.atan(dr.tan(half) * min(1.0, width / height))))

    return (
        SceneInput("camera.to_world", "camera.to_world", transform, shape=(4, 4)),
        SceneInput("camera.fov", "camera.x_fov", along_width, shape=(1,)),
        SceneInput("camera.shift_x", "camera.principal_point_offset_x", number, shape=(1,)),
        SceneInput("camera.shift_y", "camera.principal_point_offset_y", number, shape=(1,)),
        SceneInput("camera.aperture", "camera.aperture_radius", number, shape=(1,)),
        SceneInput("camera.lens", "camera.lens", shape=(len(NUMBERS),)),
        SceneInput("camera.focus", "camera.focus_distance", number, shape=(1,)),
    )


def sunsky_tables() -> tuple[Tensor, Tensor, Tensor]:
    """Read the RGB coefficients of Hosek and Wilkie's sky and sun that Mitsuba ships for its `sunsky` plugin.

    Returns:
        (10 turbidities, 2 ground albedos, 6 control points, 3 channels, 9) shape of the dome; (10, 2, 6, 3) its mean
        radiance; and (10, 45 pieces, 3 channels, 4 powers of the elevation, 6 powers of the cosine at the limb)
        radiance of the sun. All float32.
    """
    path = Path(str(mi.__file__)).parent / "data" / "sunsky" / "sunsky_datasets.bin"
    with contextlib.redirect_stdout(io.StringIO()):  # the reader prints what it loads
        tables = mi.tensor_io.read(str(path))
    shape, level, sun = (
        torch.from_numpy(tables[name]).float() for name in ("sky_params_rgb", "sky_rad_rgb", "sun_rad_rgb")
    )
    return shape, level, sun
