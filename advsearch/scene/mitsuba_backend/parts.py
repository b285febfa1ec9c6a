"""Translate a described scene to Mitsuba: plugins and inputs of each part."""

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
from advsearch.scene.assets import Float32Array, Float64Array
from advsearch.scene.backdrop import compute_refractive_index, has_plane
from advsearch.scene.camera_model import NUMBER_NAMES, CameraModel
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.grounds import is_paved
from advsearch.scene.mitsuba_backend import meshes
from advsearch.scene.mitsuba_backend.variant import (
    Plugin,
    dr,
    mi,
    scene_registry,
    suppress_warnings,
)
from advsearch.scene.photographed_ground import PhotographedGround

Write = Callable[[Any], Any]
"""Converts a Dr.Jit `TensorXf` to the type that the Mitsuba parameter takes.

Gradients may be enabled.
"""
# a single number, or a vertex buffer, which Mitsuba takes flat
to_flat_array: Write = attrgetter("array")


def to_constant(value: Any) -> float:
    """Return a single number that is a constant of the kernel.

    It has no derivative, and a recorded kernel would keep its value.
    """
    return float(value.array[0])


def to_color(value: Any) -> Any:
    """Convert three numbers to a Mitsuba color."""
    return mi.Color3f(*_get_entries(value, 3))


def to_point(value: Any) -> Any:
    """Convert three numbers to a Mitsuba point."""
    return mi.Point3f(*_get_entries(value, 3))


def to_transform(value: Any) -> Any:
    """Convert a (4, 4) matrix to a Mitsuba transform."""
    entries = _get_entries(value, 16)
    return mi.Transform4f(
        mi.Matrix4f([entries[4 * row : 4 * row + 4] for row in range(4)])
    )


def to_torch(value: Any) -> Tensor:
    """Convert a Dr.Jit value to a torch tensor with memory of its own."""
    # A color or point becomes its three components, one after the other. Dr.Jit's own
    # conversion of a color is not used: its result has six entries.
    if isinstance(value, (mi.Color3f, mi.Point3f)):
        return torch.cat([to_torch(component) for component in value])
    value = getattr(value, "matrix", value)  # of a transform
    if hasattr(value, "torch"):
        tensor: Tensor = value.torch()
    else:
        tensor = torch.tensor(np.array(value, dtype=np.float32))
    return tensor.clone()


def _get_entries(value: Any, count: int) -> list[Any]:
    """Return the first entries of a Dr.Jit tensor, one array for each.

    They are gathered one by one so that derivatives reach them.
    """
    return [
        dr.gather(mi.Float, value.array, mi.UInt32(entry)) for entry in range(count)
    ]


@dataclass(frozen=True)
class SceneInput:
    """One named input of a scene."""

    name: str  # the input's name, e.g. "key.position"
    # key of Mitsuba's parameter; an asterisk stands for any text, as in
    # "mug.*.base_color.data"
    key: str
    # function that converts the tensor to Mitsuba's type; None if Mitsuba takes a
    # tensor, as for textures and grids
    convert_to_mitsuba: Write | None = None
    # whether the interior adjoint (`prb`) differentiates it correctly
    has_interior_adjoint: bool = False
    # shape of the tensor; None takes it from Mitsuba's own value
    shape: tuple[int, ...] | None = None
    # Mitsuba's object that has the parameter, if several may match `key`
    parameter_owner: Any = None
    # range of values that are rendered; a value outside is clamped to it, and keeps its
    # derivative
    rendered_range: tuple[float, float] | None = None

    def to_rendered(self, value: Tensor) -> Tensor:
        """Return what is set for a value: contiguous float32 within the range."""
        value = value.detach().to(torch.float32).contiguous()
        return value.clamp(*self.rendered_range) if self.rendered_range else value


def find_key(parameters: Any, scene_input: SceneInput) -> str | None:
    """Return the key of Mitsuba's parameter for an input; None if there is none.

    The input's key may have an asterisk that stands for any text, as in
    "mug.*.base_color.data". If the input has an owner, only that object's parameters
    count.

    Args:
        parameters: what `mi.traverse` returns for the scene.
        scene_input: the input.

    Raises:
        RuntimeError: several parameters match.
    """
    keys = _match_keys(parameters, scene_input.key)
    owner = scene_input.parameter_owner
    if owner is not None:
        # Mitsuba's properties of a parameter: the third is the object that has it.
        keys = [key for key in keys if parameters.properties[key][2] is owner]
    if len(keys) > 1:
        raise RuntimeError(
            f"expected one Mitsuba parameter {scene_input.key}, found {keys}"
        )
    return keys[0] if keys else None


def _match_keys(parameters: Any, pattern: str) -> list[str]:
    """Return which keys of Mitsuba's parameters match one with an asterisk or not."""
    prefix, asterisk, suffix = pattern.partition("*")
    if not asterisk:
        return [pattern] if pattern in parameters else []
    return [
        key
        for key in parameters.keys()
        if key.startswith(prefix) and key.endswith(suffix)
    ]


SURFACE_KEYS = {
    name: f"{name}.value" for name in ("roughness", "metallic", "clearcoat")
} | {"specular": "specular"}
"""Keys of the principled surface's numbers."""
IDLE_LOBES: Plugin = {
    name: {"type": "uniform", "value": 0.0} for name in ("clearcoat", "sheen")
}
"""Entries of the principled surface that give it lobes of strength 0."""


@dataclass(frozen=True)
class TranslatedPart:
    """A part of a scene inside Mitsuba."""

    # entries of the scene's dictionary by name; one that the scene has already
    # ("environment") is replaced
    plugins: Plugin
    # inputs that may be set; their base values are those of `plugins`
    inputs: tuple[SceneInput, ...] = ()
    # entries that replace those of the path integrator's dictionary; a medium needs
    # another type
    integrator_entries: Plugin = field(default_factory=dict)


@singledispatch
def translate_part(part: parts.ScenePart) -> TranslatedPart:
    """Return the plugins and inputs of a part in Mitsuba.

    Each kind of part registers a function of its own, by `@translate_part.register`,
    which finds the kind from the type of the first argument.
    """
    raise TypeError(
        f"part {part.name}: {type(part).__name__} has no translation for "
        "Mitsuba; register one"
    )


@translate_part.register
def translate_mesh(part: parts.MeshPart, lobes: Plugin | None = None) -> TranslatedPart:
    """Return the shape of a mesh in Mitsuba, and its inputs.

    Args:
        part: the mesh.
        lobes: entries of the principled plugin for further lobes of its reflection,
            such as `IDLE_LOBES`; not used if the mesh has a surface of the user's.
    """
    name = part.name
    inputs = _make_buffer_inputs(part)
    if part.surface is None:
        surface = meshes.make_principled(part, lobes)
        inputs += _make_principled_inputs(name)
    else:
        surface, surface_inputs = _load_user_surface(part, part.surface)
        inputs += surface_inputs
    inputs += _make_emission_inputs(part)
    mesh = meshes.make_mitsuba_mesh(
        name, part.mesh, part.to_world, surface, meshes.make_emitter(part)
    )
    return TranslatedPart({name: mesh}, tuple(inputs))


def _make_buffer_inputs(part: parts.MeshPart) -> list[SceneInput]:
    """Return the inputs of a mesh's vertices and normals."""
    name = part.name
    shape = (len(part.mesh.vertices), 3)
    vertices_key = f"{name}.{meshes.POSITIONS}"
    normals_key = f"{name}.{meshes.NORMALS}"
    return [
        SceneInput(f"{name}.vertices", vertices_key, to_flat_array, shape=shape),
        SceneInput(f"{name}.normals", normals_key, to_flat_array, shape=shape),
    ]


def _make_emission_inputs(part: parts.MeshPart) -> list[SceneInput]:
    """Return the input of the light that a mesh emits, if it emits any.

    It is a texture, or a color if the light is even.
    """
    name = part.name
    if meshes.has_textured_emission(part):
        texture = SceneInput(
            f"{name}.radiance",
            f"{name}.emitter.radiance.data",
            has_interior_adjoint=True,
        )
        return [texture]
    if part.emission is None:
        return []
    return [_make_light_input(name, "radiance", "emitter.radiance")]


def _load_user_surface(
    part: parts.MeshPart, surface: Mapping[str, object]
) -> tuple[Plugin, list[SceneInput]]:
    """Return a user's surface with its base color loaded as a texture; and its inputs.

    The only input is the base color, if the surface has one.

    Args:
        part: the mesh.
        surface: Mitsuba's dictionary of the surface, with a placeholder for the base
            color.
    """
    inputs = list[SceneInput]()

    def load_base_texture(options: Mapping[str, object]) -> object:
        """Load the base color, and add the input that owns this texture."""
        texture = mi.load_dict(
            meshes.make_base_texture(part.base_color, options), optimize=False
        )
        inputs.append(_make_texture_input(part.name, texture))
        return texture

    # `load_base_texture` is called here, if there is a base color, and adds the input.
    filled_surface = meshes.fill_base_color(surface, load_base_texture)
    return filled_surface, inputs


def _make_texture_input(name: str, texture: Any) -> SceneInput:
    """Return the input of the base color of the mesh with a name, a texture of its own.

    The surface may have other textures, so that several keys match. That of this
    texture is found by its owner.
    """
    return SceneInput(
        f"{name}.base_color",
        f"{name}.*.data",
        has_interior_adjoint=True,
        parameter_owner=texture,
    )


def _make_principled_inputs(name: str) -> list[SceneInput]:
    """Return the inputs of the principled surface of the mesh with a name.

    They are its base color and its numbers, such as "object.roughness". None of them
    moves an outline, so the interior adjoint differentiates all of them. In the keys,
    the asterisk stands for plugins around the principled one, such as "twosided".
    """
    base_color = SceneInput(
        name=f"{name}.base_color",
        key=f"{name}.*.base_color.data",
        has_interior_adjoint=True,
    )
    numbers = [
        _make_surface_number_input(name, parameter, key)
        for parameter, key in SURFACE_KEYS.items()
    ]
    return [base_color, *numbers]


def _make_surface_number_input(name: str, parameter: str, key: str) -> SceneInput:
    """Return the input of one number of a principled surface.

    Args:
        name: name of the mesh.
        parameter: our name of the number, such as "roughness".
        key: Mitsuba's name of it.
    """
    return SceneInput(
        name=f"{name}.{parameter}",
        key=f"{name}.*.{key}",
        convert_to_mitsuba=to_flat_array,
        has_interior_adjoint=True,
        shape=(1,),
        rendered_range=meshes.RENDERED_RANGES.get(parameter),
    )


def _make_light_input(name: str, parameter: str, key: str) -> SceneInput:
    """Return the input of a part's light, a color (3,).

    Args:
        name: name of the part.
        parameter: name of the input within the part, such as "radiance" in
            "lamp.radiance".
        key: Mitsuba's key of the color within the part.
    """
    return SceneInput(
        f"{name}.{parameter}",
        f"{name}.{key}.value",
        convert_to_mitsuba=to_color,
        has_interior_adjoint=True,
        shape=(3,),
    )


def _make_pose_input(name: str, parameter: str) -> SceneInput:
    """Return the input of a part's pose.

    Args:
        name: name of the part.
        parameter: name of the input within the part: "to_world", or another one for a
            pose that is not the base pose of a mesh. Mitsuba's key is always
            "to_world".
    """
    return SceneInput(
        name=f"{name}.{parameter}",
        key=f"{name}.to_world",
        convert_to_mitsuba=to_transform,
        shape=(4, 4),
    )


@translate_part.register
def _translate_plugin(part: parts.PluginPart) -> TranslatedPart:
    """Return one of Mitsuba's plugins as it is, which has no inputs."""
    integrator = {"type": "prbvolpath"} if part.volumetric else {}
    plugins = {part.name: meshes.to_loadable(part.plugin)}
    return TranslatedPart(plugins, integrator_entries=integrator)


@translate_part.register
def _translate_numbers(part: parts.PluginNumbers) -> TranslatedPart:
    """Return the inputs of numbers of Mitsuba's plugins, and no plugin.

    The input of a number may belong to another part, as "object.roughness" belongs to
    the object. That part has the input already, so that it is left out here.
    """
    inputs = [
        _make_number_input(plugin_number)
        for plugin_number in part.numbers
        if plugin_number.input.startswith(f"{part.name}.")
    ]
    return TranslatedPart(plugins={}, inputs=tuple(inputs))


def _make_number_input(plugin_number: parts.PluginNumber) -> SceneInput:
    """Return the input of a number or a color of a Mitsuba scene.

    A plain number is a constant that Mitsuba compiles into its kernels. A number with
    the key of one of a principled surface, such as "roughness", is clamped to the range
    that Mitsuba renders correctly.
    """
    return SceneInput(
        plugin_number.input,
        plugin_number.key,
        _choose_conversion(plugin_number),
        # if the adjoint is among the estimators that are valid for it
        has_interior_adjoint="adjoint" in plugin_number.valid,
        shape=(len(plugin_number.values),),
        rendered_range=_find_rendered_range(plugin_number.key),
    )


def _choose_conversion(plugin_number: parts.PluginNumber) -> Write:
    """Return the function that converts a tensor to the type that Mitsuba has there."""
    if plugin_number.plain:
        return to_constant
    if len(plugin_number.values) == 3:
        return to_color
    return to_flat_array


def _find_rendered_range(key: str) -> tuple[float, float] | None:
    """Return the range that Mitsuba renders correctly for a number by its key.

    None if any number is rendered as it is.
    """
    # the name that such a number has in our materials, at most one
    surface_parameters = [
        parameter
        for parameter, key_in_surface in SURFACE_KEYS.items()
        if key.endswith(f".{key_in_surface}")
    ]
    if not surface_parameters:
        return None
    return meshes.RENDERED_RANGES.get(surface_parameters[0])


@translate_part.register
def _translate_point_lamp(part: parts.PointLamp) -> TranslatedPart:
    """Return a lamp that is a point."""
    name = part.name
    lamp = {
        "type": "point",
        "position": list(part.position),
        "intensity": _make_rgb(part.intensity),
    }
    position = SceneInput(
        name=f"{name}.position",
        key=f"{name}.position",
        convert_to_mitsuba=to_point,
        shape=(3,),
    )
    intensity = _make_light_input(name, parameter="intensity", key="intensity")
    return TranslatedPart({name: lamp}, (position, intensity))


@translate_part.register
def _translate_spot_lamp(part: parts.SpotLamp) -> TranslatedPart:
    """Return a lamp with a cone."""
    cutoff, beam = part.cone
    lamp = {
        "type": "spot",
        "to_world": mi.ScalarTransform4f(part.to_world),
        "intensity": _make_rgb(part.intensity),
        "cutoff_angle": cutoff,
        "beam_width": beam,
    }
    intensity = _make_light_input(part.name, parameter="intensity", key="intensity")
    return TranslatedPart({part.name: lamp}, (intensity,))


@translate_part.register
def _translate_ball_lamp(part: parts.BallLamp) -> TranslatedPart:
    """Return a lamp that is a shining ball.

    It is a unit sphere under a pose that scales and moves it. It has no surface of its
    own ("null"), so that light passes it.
    """
    pose = mi.ScalarTransform4f().translate(list(part.center)).scale(part.radius)
    ball = {
        "type": "sphere",
        "to_world": pose,
        "bsdf": {"type": "null"},
        "emitter": {"type": "area", "radiance": _make_rgb(part.radiance)},
    }
    inputs = (
        # not "to_world", which is the name for the base pose of a mesh
        _make_pose_input(part.name, "ball"),
        _make_light_input(part.name, parameter="radiance", key="emitter.radiance"),
    )
    return TranslatedPart({part.name: ball}, inputs)


@translate_part.register
def _translate_projector(part: parts.ProjectorPart) -> TranslatedPart:
    """Return a projector.

    The irradiance that Mitsuba's projector gives at distance 1 is pi times its texture.
    So a texel is the radiance of a white screen there.
    """
    name = part.name
    projector = {
        "type": "projector",
        "fov": part.fov,
        "fov_axis": "x",
        "irradiance": _make_black_image(part.sides),
    }
    pattern = SceneInput(
        name=f"{name}.pattern",
        key=f"{name}.irradiance.data",
        has_interior_adjoint=True,
    )
    return TranslatedPart({name: projector}, (_make_pose_input(name, "pose"), pattern))


def _make_black_image(sides: tuple[int, int]) -> Plugin:
    """Return the image of a projector until its input `pattern` is set."""
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.zeros((*sides, 3), np.float32)),
        "raw": True,
        "wrap_mode": "clamp",
    }


@translate_part.register
def _translate_beam(part: parts.BeamLamp) -> TranslatedPart:
    """Return a headlamp's beam as a projector.

    The table has the intensity of each direction.
    """
    lamp = {
        "type": "projector",
        "to_world": mi.ScalarTransform4f(part.to_world),
        "fov": 90.0,
        "fov_axis": "x",
        "irradiance": {
            **meshes.make_texture(_make_beam_image(part)),
            "wrap_mode": "clamp",
        },
        "sampling_weight": part.weight,
    }
    return TranslatedPart({part.name: lamp}, (_make_pose_input(part.name, "to_world"),))


def _make_beam_image(part: parts.BeamLamp) -> Float32Array:
    """Return the texture (h, w, 3) of the projector of a headlamp's beam.

    On a plane at distance 1, at an angle a to the axis, the distance is 1 / cos a and
    the plane is tilted by a. So the irradiance there is I cos a / (1 / cos a)^2 = I
    cos^3 a, for the intensity I in the table. Mitsuba's projector makes pi times its
    texture there, so the texture is I cos^3 a / pi.
    """
    height, width = part.table.shape
    # Centers of the table's cells on that plane, in fractions of half its width and
    # height. The points of `linspace` are half a cell apart: borders and centers of
    # cells alternate, and the first is a border.
    x = np.linspace(-1.0, 1.0, 2 * width + 1)[1::2]
    y = np.linspace(-1.0, 1.0, 2 * height + 1)[1::2]
    # The field of view is 90 degrees along the width: at distance 1, half the width is
    # 1, and half the height is height / width.
    cosine = (1.0 + x[None] ** 2 + (y[:, None] * height / width) ** 2) ** -0.5
    image: Float64Array = (part.table * cosine**3 / np.pi)[..., None] * np.array(
        part.tint
    )
    return image.astype(np.float32)


@translate_part.register
def _translate_haze(part: parts.HazePart) -> TranslatedPart:
    """Return a haze.

    No shape refers to Mitsuba's medium. It only holds density and albedo, as parameters
    that can be set, for our integrator.
    """
    medium = _load_haze_medium(part)
    # Mitsuba does not release media. So the medium is held as long as the registry
    # itself, that is forever.
    scene_registry.hold_objects(scene_registry, media=(medium,))
    return TranslatedPart(
        plugins={part.name: medium},
        inputs=_make_haze_inputs(part.name),
        integrator_entries={
            "type": "advsearch_haze",
            "medium": medium,
            "radius": part.radius,
        },
    )


def _load_haze_medium(part: parts.HazePart) -> Any:
    """Return Mitsuba's medium of a haze."""
    albedo = _make_rgb(part.albedo)
    return mi.load_dict(
        {"type": "homogeneous", "albedo": albedo, "sigma_t": part.density},
        optimize=False,
    )


def _make_haze_inputs(name: str) -> tuple[SceneInput, ...]:
    """Return the inputs of the haze with a name: its density and its albedo."""
    return (
        SceneInput(
            name=f"{name}.density",
            key=f"{name}.sigma_t.value.value",
            convert_to_mitsuba=to_flat_array,
            has_interior_adjoint=True,
            shape=(1,),
        ),
        SceneInput(
            name=f"{name}.albedo",
            key=f"{name}.albedo.value.value",
            convert_to_mitsuba=to_color,
            has_interior_adjoint=True,
            shape=(3,),
        ),
    )


def _make_rgb(value: Sequence[float]) -> Plugin:
    """Return the plugin of a color."""
    return {"type": "rgb", "value": list(value)}


GROUND_NAME = "ground"
# smallest roughness of the plane's coat in a photograph, as other surfaces see it: a
# smoother coat would make fireflies on them
MIN_PLANE_ROUGHNESS = 0.3


def make_scene_dict(
    description: SceneDescription,
    resolution: tuple[int, int],
    filter: str,
    sampler: str,
) -> Plugin:
    """Return Mitsuba's dictionary of a scene's camera, environment and ground.

    Objects come as parts. With a backdrop the film has an alpha channel, by which the
    backdrop is put behind the image.

    Args:
        description: the scene.
        resolution: height and width.
        filter, sampler: Mitsuba's types of reconstruction filter and sampler.
    """
    camera = _make_camera_plugin(description, resolution, filter, sampler)
    scene: Plugin = {"type": "scene", "camera": camera}
    if description.environment is not None:
        scene["environment"] = _make_environment(
            description, description.environment.radiance
        )
    ground = _make_ground(description)
    if ground is not None:
        scene[GROUND_NAME] = ground
    return scene


def _make_camera_plugin(
    description: SceneDescription,
    resolution: tuple[int, int],
    filter: str,
    sampler: str,
) -> Plugin:
    """Return the dictionary of a scene's camera, with pose, film and sampler.

    The arguments are those of `make_scene_dict`.
    """
    height, width = resolution
    to_world = camera_to_world(description, width / height)
    return {
        **_make_lens(description),
        # object sizes
        "near_clip": 0.01,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": _make_film(description, resolution, filter),
        "sampler": {"type": sampler},
    }


def _make_film(
    description: SceneDescription, resolution: tuple[int, int], filter: str
) -> Plugin:
    """Return the film of a size (height, width), with a reconstruction filter."""
    height, width = resolution
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgba" if description.backdrop else "rgb",
        "component_format": "float32",
        "rfilter": {"type": filter},
    }


def _make_environment(description: SceneDescription, radiance: Float32Array) -> Plugin:
    """Return the light of the surroundings, by a map (h, w, 3) of their radiance."""
    rotation = description.get_number("environment.rotation")
    # Mitsuba's maps have y up. The last rotation is applied first: it turns y to z.
    # Then the map is rotated about z.
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(radiance, dtype=np.float32)),
        "scale": 2.0 ** description.get_number("environment.exposure"),
        "to_world": mi.ScalarTransform4f()
        .rotate([0, 0, 1], rotation)
        .rotate([1, 0, 0], 90),
    }


def _make_ground(description: SceneDescription) -> Any:
    """Return the ground, or None if the scene has none.

    There are two kinds of photographs. The map of the environment may be one that shows
    its ground (`photograph`): then that ground is a mesh with its colors. Or the scene
    is rendered into a photograph (`backdrop_photograph`): then the ground is an
    invisible plane that receives the shadow. Otherwise it is a plain square.

    The invisible plane and the plain ground are two-sided squares of the width
    `ground.size`. The result is None if that is 0, or if the ground is a road or a
    place, which has meshes of its own.
    """
    if description.photograph is not None:
        return _make_photographed_mesh(description.photograph)
    size = description.get_number("ground.size")
    if not size > 0.0 or is_paved(description):
        return None
    level = 0.0
    if description.backdrop_photograph is not None:
        if not has_plane(description):
            return None
        level = description.get_number("ground.level")
    return _make_square(size, level, _make_ground_surface(description))


def _make_square(size: float, level: float, bsdf: Plugin) -> Plugin:
    """Return a two-sided horizontal square of a width, at a height above 0."""
    pose = mi.ScalarTransform4f().translate([0.0, 0.0, level])
    return {
        "type": "rectangle",
        "to_world": pose.scale(size / 2.0),  # Mitsuba's rectangle is 2 wide
        "bsdf": {"type": "twosided", "bsdf": bsdf},
    }


def _make_photographed_mesh(ground: PhotographedGround) -> Any:
    """Return the ground that the map of the environment shows, as a mesh."""
    surface = meshes.make_diffuse(ground.base_color.numpy())
    return meshes.make_mitsuba_mesh(GROUND_NAME, ground.mesh, np.eye(4), surface)


def _make_ground_surface(description: SceneDescription) -> Plugin:
    """Return the diffuse surface of the ground, in a photograph perhaps with a coat."""
    srgb = np.array(description.ground_color, np.float32)
    reflectance = _make_rgb(srgb_to_linear(srgb).tolist())
    gloss = description.get_number("ground.gloss")
    if description.backdrop_photograph is None or not gloss > 0.0:
        return {"type": "diffuse", "reflectance": reflectance}
    roughness = description.get_number("ground.roughness")
    # a diffuse ground under a clear coat
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": max(roughness, MIN_PLANE_ROUGHNESS) ** 2,  # as in `_Coat`
        "int_ior": compute_refractive_index(gloss),
        "ext_ior": 1.0,
        "diffuse_reflectance": reflectance,
    }


@contextlib.contextmanager
def convert_refusals(description: SceneDescription) -> Iterator[None]:
    """Turn Mitsuba's errors about the user's plugins into input errors.

    The object's surface may be such a plugin. They are loaded inside the `with`.

    Raises:
        InputError: Mitsuba refuses them.
    """
    has_user_plugins = _has_user_plugins(description)
    try:
        with suppress_warnings():
            yield
    except (RuntimeError, TypeError, ValueError) as error:
        if not has_user_plugins:
            raise  # it is our own mistake
        reason = " ".join(str(error).split())
        raise InputError(
            f"{description.object_name}: Mitsuba refuses the scene: {reason}; change "
            "it there"
        ) from error


def _has_user_plugins(description: SceneDescription) -> bool:
    """Return whether the object's surface or a part is one of the user's plugins."""
    object_asset = description.object
    # An object with finishes has a surface that we made from a table of materials.
    if object_asset.surface is not None and not object_asset.finishes:
        return True
    return any(isinstance(part, parts.PluginPart) for part in description.parts)


def _check_background(
    description: SceneDescription, model: CameraModel, drops: float
) -> None:
    """Raise InputError if a background does not go with a lens and its raindrops.

    Args:
        description: the scene.
        model: model of the camera's lens.
        drops: number of raindrops before it.
    """
    if description.backdrop and drops > 0.0:
        raise InputError(
            "background: raindrops have no plain background behind them; "
            "leave one of the two out"
        )
    has_plain_backdrop = description.backdrop and not description.backdrop_photograph
    if has_plain_backdrop and _may_leave_black(model):
        raise InputError(
            "background: it would show where the camera's lens sees nothing as well; "
            "leave the plain background out, or take a lens that fills the picture"
        )


def _may_leave_black(model: CameraModel) -> bool:
    """Return whether parts of the image may be black since a lens sees nothing there.

    A lens has no name if its numbers are searched. Some numbers make a lens that folds
    (two directions fall on one point of the image), and leaves other parts black.
    """
    is_searched = not model.name
    return model.black_fraction > 0.0 or is_searched


def _make_lens(description: SceneDescription) -> Plugin:
    """Return the plugin of the camera's lens, without pose and film.

    It is a pinhole, a thin lens, or our own sensor for a lens model, with raindrops if
    there are any.

    Raises:
        InputError: a plain background with raindrops, or with a lens that leaves parts
            of the image black.
    """
    model = description.camera_model
    drops = description.get_number("camera.drops")
    if model is None:
        return _make_perspective_lens(description)
    _check_background(description, model, drops)
    camera: Plugin = {
        "type": "advsearch_camera",
        "kind": model.kind,
        "reach": model.max_angle_degrees,  # largest angle to the axis
        **model.intrinsic_by_name,
    }
    if drops > 0.0:
        camera |= _make_drop_entries(description, model)
    return camera


def _make_perspective_lens(description: SceneDescription) -> Plugin:
    """Return the plugin of a pinhole or of a thin lens."""
    pinhole: Plugin = {
        "type": "perspective",
        "fov": description.get_number("camera.fov"),
        "fov_axis": "larger",
    }
    if not description.thin_lens:
        return pinhole
    # Aperture and focus are inputs, which are set later. The type replaces the
    # pinhole's, whose field of view stays.
    thin_lens = {"type": "thinlens", "aperture_radius": 1e-4, "focus_distance": 1.0}
    return pinhole | thin_lens


def _make_drop_entries(description: SceneDescription, model: CameraModel) -> Plugin:
    """Return the entries of our sensor for raindrops before a lens.

    Drops cover the part of the glass through which the lens sees.
    """
    drops: Plugin = {
        name: description.get_number(f"camera.{name}")
        for name in ("drops", "drop_size", "drop_seed")
    }
    # A lens has no name if its numbers are searched. Then its view changes, and it gets
    # the drops of a pinhole with the camera's field of view.
    is_searched = not model.name
    if is_searched:
        half_fov = math.radians(description.get_number("camera.fov")) / 2.0
        drops["drop_tangent"] = math.tan(half_fov)
    else:
        # the larger one of width and height
        drops["drop_tangent"] = max(model.inner_half_tangents)
    return drops


# Mitsuba's names of numbers of the camera, by the names of our inputs
CAMERA_KEYS = {
    "shift_x": "principal_point_offset_x",
    "shift_y": "principal_point_offset_y",
    "aperture": "aperture_radius",
    "focus": "focus_distance",
}


def make_scene_inputs(resolution: tuple[int, int]) -> tuple[SceneInput, ...]:
    """Return the inputs of camera, environment and ground.

    Args:
        resolution: (height, width) of the image. `camera.fov` is along its larger side,
            and is converted to Mitsuba's, which is along the width.
    """
    return (
        _make_pose_input("camera", "to_world"),
        SceneInput(
            name="camera.fov",
            key="camera.x_fov",
            convert_to_mitsuba=_make_fov_conversion(resolution),
            shape=(1,),
        ),
        SceneInput("camera.lens", "camera.lens", shape=(len(NUMBER_NAMES),)),
        *_make_camera_number_inputs(),
        # (H, W + 2, 3): a copy of the last column before the first, and of the first
        # after the last
        SceneInput("environment.padded", "environment.data", has_interior_adjoint=True),
        # pose of the plane that receives the shadow in a photograph
        _make_pose_input(GROUND_NAME, "to_world"),
        # (h, w, 3): colors of a ground that the map of the environment shows
        SceneInput(
            name="ground.reflectance",
            key=f"{GROUND_NAME}.*.reflectance.data",
            has_interior_adjoint=True,
        ),
    )


def _make_fov_conversion(resolution: tuple[int, int]) -> Write:
    """Return a function that converts a field of view to Mitsuba's.

    Args:
        resolution: (height, width) of the image.
    """
    height, width = resolution

    def to_horizontal_fov(value: Any) -> Any:
        """Convert a field of view along the larger side to one along the width."""
        half_angle = dr.deg2rad(value.array) / 2.0
        # In an upright image the width is smaller than the larger side. The tangents
        # are in proportion to the sides.
        width_to_larger_side = min(1.0, width / height)
        half_tangent = dr.tan(half_angle) * width_to_larger_side
        return mi.Float(2.0 * dr.rad2deg(dr.atan(half_tangent)))

    return to_horizontal_fov


def _make_camera_number_inputs() -> list[SceneInput]:
    """Return the inputs of the camera's numbers in `CAMERA_KEYS`."""
    return [
        SceneInput(
            f"camera.{name}",
            f"camera.{key}",
            convert_to_mitsuba=to_flat_array,
            shape=(1,),
        )
        for name, key in CAMERA_KEYS.items()
    ]
