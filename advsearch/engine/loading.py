"""Load a scene from Python, and make a renderer `render(u, seed, spp)` for it."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence, ValuesView
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard, final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.calls import with_checked_arguments
from advsearch.controls import (
    CONTROLS,
    Control,
    Space,
    check_control_settings,
    make_control,
    make_space,
    merge_control_settings,
)
from advsearch.distributions import PythonQuantiles, distribution_to_setting
from advsearch.errors import InputError
from advsearch.options import describe_value, format_things
from advsearch.scene import settings
from advsearch.scene.assembly import InputAssembler, Motion
from advsearch.scene.assets import EnvironmentAsset, Float32Array, ObjectAsset
from advsearch.scene.backdrop import (
    find_photographed_light,
    fit_to_photograph,
)
from advsearch.scene.backdrop_photograph import BackdropPhotograph
from advsearch.scene.camera_model import CameraModel, make_bundled_models, make_pinhole
from advsearch.scene.description import (
    ENVIRONMENT,
    NO_ENVIRONMENT,
    PhotographFolder,
    SceneDescription,
    check_ground,
    check_mesh_names,
    check_single_environment,
    load_description,
)
from advsearch.scene.formation import (
    ALL_OMISSIONS,
    MAX_MOMENTS,
    MIN_MOMENTS,
    MOMENTS_PER_PIXEL,
    SAMPLER,
    ImageFormation,
    Moment,
    divide_exposure,
)
from advsearch.scene.grounds import with_requested_ground
from advsearch.scene.headlamps import add_lamps
from advsearch.scene.importing.pictures import read_image
from advsearch.scene.library import import_environment
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.photograph_files import (
    is_photograph_folder,
    make_photograph_scene,
    read_photograph_folder,
    read_photograph_view,
)
from advsearch.scene.renderer import Renderer
from advsearch.scene.rig import read_photograph_cameras
from advsearch.scene.settings import ORBIT_CAMERA, SettingValues
from advsearch.settings import parse_controls, to_python
from advsearch.trust.code import allow_code_of_call
from advsearch.trust.foreign_code import use_default_torch_state
from advsearch.trust.stored_files import track_opened_files

Controls = str | Control | Sequence[str | Control] | Mapping[str, object]
"""One control or several, by name or instance, or a mapping from names to settings or
instances. A name ``mitsuba:KEY`` has a range instead of settings.
"""

Texture = str | Path | npt.ArrayLike | Tensor

PHOTOGRAPH_SETTINGS = (
    *("ground.level", "ground.gloss", "ground.roughness"),
    *("backdrop.noise", "backdrop.blur"),
)
"""Settings that only apply to a scene that is rendered into a photograph."""

SINGLE_VALUE_KEYS = {"distribution", "choices", "range"}
"""A mapping with one of these keys describes one value, and not the settings of a
control.
"""

DEFAULT_RESOLUTION = 128


@final
@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """An object under an environment, with some parameters fixed. See `load_scene`.

    Attributes:
        description: the scene as data.
        is_session_only: whether it contains Python objects that can't be named in a
            file or a command.
    """

    description: SceneDescription
    is_session_only: bool = False

    @allow_code_of_call
    def renderer(
        self,
        controls: Controls,
        *,
        resolution: int | tuple[int, int] = DEFAULT_RESOLUTION,
        denoise: str = "oidn",
        seed: int = 0,
        estimators: Mapping[str, str] | None = None,
        sampler: str = SAMPLER,
    ) -> Renderer:
        """Return `render(u, seed, spp)` for the space of these controls.

        Args:
            controls: controls that u varies.
            resolution: side, or (height, width), in pixels.
            denoise: "oidn" or "none".
            seed: root of the noise; together with the `seed` of a call, it determines
                the noise of an image.
            estimators: how derivatives are computed, by "control.parameter", "control"
                or "*". `advsearch check` lists the estimators.
            sampler: "multijitter", or "independent", which has more noise.
                "multijitter" rounds sample counts up to products of two similar
                numbers.

        Raises:
            InputError: a control is unknown or impossible in this scene, or an argument
                is out of range.
        """
        resolution = to_python(resolution)
        description = fit_camera(self.description, resolution)
        # global switches of torch that the caller has set do not change the result
        with use_default_torch_state():
            space = make_space(make_controls(controls), description)
            return make_renderer(
                description,
                space,
                resolution,
                denoise,
                seed,
                estimators,
                sampler=sampler,
            )

    def with_environment(self, environment: EnvironmentAsset | None) -> Scene:
        """Return the scene under another environment; None for no environment map.

        The environment then counts as chosen by the user, and not as the default. If
        the scene is in a folder of photographs, the scene in each photograph gets it.

        Args:
            environment: the environment; None for no environment map.

        Raises:
            InputError: the ground of the scene shows the photograph of its environment,
                and the new one has none.
        """
        name = NO_ENVIRONMENT if environment is None else environment.name
        description = self.description
        check_ground(description.requested_values, name)
        if environment is not None:
            check_single_environment(description.parts, f"`environment={name}`")
        relit = replace(
            description,
            environment=environment,
            environment_spec=name,
            requested=description.requested | {ENVIRONMENT},
        )
        if description.photographs is not None:
            folder = _relight_photographs(description.photographs, environment)
            relit = replace(relit, photographs=folder)
        # The lamps of a place are on if the environment is dark, so that ground and
        # lamps are added again.
        grounded = with_requested_ground(relit)
        return Scene(add_lamps(grounded), self.is_session_only)

    def __getattr__(self, name: str) -> Any:
        """Explain what to use instead of `render`; called for a missing attribute."""
        if name == "render":
            raise AttributeError(
                "a scene has no `render`: advsearch.render(scene) makes a picture and "
                "asks a model, and scene.renderer(controls) returns render(u, seed, "
                "spp), which is differentiable"
            )
        raise AttributeError(f"'Scene' object has no attribute {name!r}")

    def __repr__(self) -> str:
        """Return the names of object and environment, and the fixed parameters."""
        description = self.description
        fixed = "".join(
            f", {name}={value!r}"
            for name, value in sorted(description.requested_values.items())
        )
        names = f"{description.object_name!r}, {description.environment_name!r}"
        return f"Scene({names}{fixed})"

    def with_texture(self, texture: Texture) -> Scene:
        """Return the scene with another texture of the object.

        Args:
            texture: a picture file, or (h, w, 3) sRGB in [0, 1] or of 8 bits, row 0 on
                top.

        Raises:
            FileFormatError: the file is no picture.
            InputError: the array is no (h, w, 3) picture in [0, 1].
        """
        if isinstance(texture, (str, Path)):
            texels = read_image(Path(texture), None)
        else:
            texels = _array_to_texels(texture)
        retextured = replace(self.description.object, base_color=texels)
        return Scene(replace(self.description, object=retextured), is_session_only=True)

    def with_settings(self, overrides: SettingValues) -> Scene:
        """Return the scene with some of its parameters fixed to other values.

        Args:
            overrides: new values by parameter, such as {"camera.azimuth": 130.0}.

        Raises:
            InputError: a name is unknown or a value out of range.
        """
        # `resolved` has a value for every parameter, of which those of `overrides`
        # count
        resolved = settings.resolve_settings(overrides)
        description = self.description
        check_mesh_names(description, overrides)
        if description.camera_model is not None:
            # a camera model has focal lengths, and takes no field of view
            description.camera_model.check_no_fov(overrides)
        changed_values = {name: resolved[name] for name in overrides}
        changed = _replace_values(description, changed_values)
        # The settings may request another ground, or switch lamps on or off. So ground
        # and lamps are added anew, in place of the old ones.
        grounded = with_requested_ground(changed)
        return Scene(add_lamps(grounded), self.is_session_only)


def _relight_photographs(
    folder: PhotographFolder, environment: EnvironmentAsset | None
) -> PhotographFolder:
    """Return a folder whose photographs show their scenes under another environment."""
    relit_scenes = {
        photograph: Scene(scene).with_environment(environment).description
        for photograph, scene in folder.scenes.items()
    }
    return replace(folder, scenes=relit_scenes)


def _replace_values(
    description: SceneDescription, changed_values: Mapping[str, Any]
) -> SceneDescription:
    """Return a description in which some parameters have other, requested values."""
    values = {**description.values, **changed_values}
    # A camera that has a height gets its elevation from that. So a stated elevation
    # removes the height.
    if "camera.elevation" in changed_values:
        values["camera.height"] = None
    requested = description.requested | set(changed_values)
    return replace(description, values=values, requested=requested)


@with_checked_arguments
@use_default_torch_state()
def load_scene(
    object: str | Path | ObjectAsset,
    environment: str | Path | EnvironmentAsset | None = None,
    *,
    scene: str | Path | Mapping[str, object] | None = None,
    up: str | None = None,
    facing: str | None = None,
    size: float | None = None,
    unit: str | None = None,
    settings: SettingValues | None = None,
    camera: str | None = None,
    texture: Texture | None = None,
    things: str
    | Mapping[str, object]
    | Sequence[str | Mapping[str, object]]
    | None = None,
    backdrop: str | Path | BackdropPhotograph | None = None,
    occluder: str | Path | None = None,
) -> Scene:
    """Load a scene.

    Args:
        object: a bundled name ("mug"), a path to a mesh (`advsearch.files.MESHES`), or
            an asset.
        environment: a bundled name, a path to an .hdr or .exr file or to the .yaml file
            of a place, or an asset; default "studio".
        scene: a scene file, or a scene dictionary of Mitsuba (`mi.cornell_box()`).
            `object` is then a node or the id of a shape in it. The file may also be
            written before the object: "scene.glb#chair", "box.xml#large-box".
        up: the up axis of a mesh file, "y" or "z"; by default that of its format, or
            else one that is guessed from its shape.
        facing: the axis of a mesh file that its front faces, "+x", "-x", "+y", "-y",
            "+z" or "-z". By default that of its format: +z for glTF and VRM 1, -z for
            VRM 0, and +x for others. The front is rotated towards +x.
        size: size of the object, its longest side in metres, 1e-4 to 1e4. Distances of
            the camera, paths of files and the height of a photograph are in metres if
            the size of the object is known, and otherwise in object sizes.
        unit: unit of the coordinates of the object's file, "mm", "cm", "m" or "in", by
            which its size is known. By default bundled objects and glTF files have a
            unit, and other files have none.
        settings: parameters to fix, e.g. ``{"camera.azimuth": 130.0}``. The size of an
            image is not among them: it is `resolution` of `attack`, `sweep`, `render`
            and `Scene.renderer`.
        camera: a camera file (docs/cameras.md); "fisheye" or "equirectangular", the
            lens of the camera that orbits the object; "dashcam" or "robot", a camera at
            its height above the ground; the name of a camera of a scene file; for a
            `backdrop`, the images.txt of COLMAP or a transforms.json that contains the
            photograph; "orbit" or None for a pinhole that orbits the object.
        texture: texture that replaces that of the object: an image file, or (h, w, 3)
            sRGB in [0, 1] or of 8 bits, row 0 on top, for example
            `result.artifacts["texture"]`.
        things: other objects of the scene. Positions are in metres from the object, x
            forwards and y to its left: a text such as "car@12,3.5,heading=180;
            person@6,-2", or a list of such texts or of mappings, {"object": "car", "x":
            12, "y": 3.5, "heading": 180}; `size` (metres), `name` and `label` are
            optional.
        backdrop: a photograph that the scene is rendered into (docs/cameras.md): an
            image file, taken by `camera`; a part of it,
            ``photo.jpg#X,Y,WIDTH,HEIGHT`` in pixels; or a folder of photographs, of
            which the control `backdrop` selects one. If there is an .hdr or .exr file
            of the same name next to it, that is its default light; a .yaml or .json
            file of the same name is its default camera.
        occluder: a mask of the size of the photograph, white where the photograph shows
            something in front of the object; or the depth of the photograph: an .exr or
            .npy file in metres, or an image with the metres of a level after its name,
            ``depth.png#0.001``.

    Raises:
        InputError: a name is unknown, a file cannot be used, or a value is out of
            range.
    """
    _check_object_is_node(object, scene)
    mitsuba_dict = scene if isinstance(scene, Mapping) else None
    # a node of a scene file is named as "scene.glb#chair"
    object_spec = object
    if scene is not None and mitsuba_dict is None:
        object_spec = f"{scene}#{object}"
    fixed_values = None if settings is None else to_python(settings)
    has_environment = environment is not None
    # In a folder, each photograph has its own light, which is read below.
    if environment is None and not is_photograph_folder(backdrop):
        environment = find_photographed_light(backdrop)
    description = load_description(
        object_spec,
        environment,
        up=up,
        facing=facing,
        size=size,
        setting_values=fixed_values,
        unit=unit,
        plugins=mitsuba_dict,
        things=format_things(things),
    )
    description = _apply_camera_and_backdrop(
        description, camera, backdrop, occluder, has_environment=has_environment
    )
    if backdrop is None:
        _check_no_photograph(fixed_values or {}, occluder)
    is_session_only = mitsuba_dict is not None or _has_asset(
        object, environment, backdrop
    )
    loaded = Scene(description, is_session_only)
    return loaded if texture is None else loaded.with_texture(texture)


def _check_object_is_node(
    object: str | Path | ObjectAsset, scene: str | Path | Mapping[str, object] | None
) -> None:
    """Check that the object of a scene file or dictionary is the name of a node."""
    if scene is not None and not isinstance(object, str):
        raise InputError(
            f"object: expected the name of a node or shape of the scene, got {object!r}"
        )


def _apply_camera_and_backdrop(
    description: SceneDescription,
    camera: str | None,
    backdrop: str | Path | BackdropPhotograph | None,
    occluder: str | Path | None,
    *,
    has_environment: bool,
) -> SceneDescription:
    """Return a scene with its camera, in its photographs if there is a backdrop.

    The arguments are those of `load_scene`. `has_environment` states whether the user
    chose the light.
    """
    if isinstance(backdrop, (str, Path)):
        return _put_into_photographs(
            description, backdrop, camera, occluder, has_environment=has_environment
        )
    if camera is not None:
        description = description.with_camera(camera)
    if isinstance(backdrop, BackdropPhotograph):
        description = description.with_backdrop(backdrop, occluder)
    return description


def _has_asset(*inputs: object) -> bool:
    """Return whether an input is a Python object instead of a name or path.

    No other session can load things that were passed as objects, without a file.
    """
    return any(
        asset is not None and not isinstance(asset, (str, Path)) for asset in inputs
    )


def _put_into_photographs(
    description: SceneDescription,
    spec: str | Path,
    camera: str | None,
    occluder: str | Path | None,
    *,
    has_environment: bool,
) -> SceneDescription:
    """Return a scene in a photograph, or in the photographs of a folder.

    Args:
        description: the scene.
        spec: path of the photograph, or of the folder.
        camera: name or file of the camera that took the photographs; None for the
            camera file next to each photograph.
        occluder: file of a mask, white where the photograph shows what is in front of
            the object; None if nothing is.
        has_environment: whether the user chose the light. If not, the scene in each
            photograph of a folder is lit by the map beside the photograph.
    """
    if not is_photograph_folder(spec):
        # `load_scene` has given the scene the light next to a single photograph.
        view = read_photograph_view(spec)
        return make_photograph_scene(description, view, camera, occluder)
    if occluder is not None:
        raise InputError(
            f"`backdrop={spec}` and `occluder` contradict each other: a mask belongs "
            "to one photograph; state it as `occluder` in the camera file beside that"
        )
    # Files that are opened here belong to the folder.
    with track_opened_files(spec):
        scenes = _make_folder_scenes(
            description, spec, camera, has_environment=has_environment
        )
    folder = PhotographFolder(str(spec), camera, scenes)
    # The scene shows the first photograph, until a control chooses another one.
    return replace(next(iter(scenes.values())), photographs=folder)


def _make_folder_scenes(
    description: SceneDescription,
    spec: str | Path,
    camera: str | None,
    *,
    has_environment: bool,
) -> dict[str, SceneDescription]:
    """Return the scene in each photograph of a folder, by the name of the photograph.

    The arguments are those of `_put_into_photographs`.
    """
    scenes: dict[str, SceneDescription] = {}
    # `camera` may be a file with the cameras of all photographs, which is parsed only
    # once. If it is something else, such as a name, it stays as it is.
    photograph_camera: Any = camera
    if camera is not None:
        photograph_camera = read_photograph_cameras(camera) or camera
    views = read_photograph_folder(spec, has_camera=camera is not None)
    for name, view in views.items():
        light = None if has_environment else find_photographed_light(view.spec)
        lit_scene = description
        if light is not None:
            environment = import_environment(light)
            lit_scene = Scene(description).with_environment(environment).description
        scenes[name] = make_photograph_scene(lit_scene, view, photograph_camera)
    return scenes


def _check_no_photograph(
    fixed_values: SettingValues, occluder: str | Path | None
) -> None:
    """Raise InputError for settings of a photograph in a scene that has none.

    Args:
        fixed_values: parameters that the user fixed, such as "ground.level".
        occluder: the mask that the user stated, if any.
    """
    stated = [name for name in fixed_values if name in PHOTOGRAPH_SETTINGS]
    if occluder is not None:
        stated.append("occluder")
    if stated:
        raise InputError(
            f"{stated[0]}: only applies to a scene that is rendered into a photograph; "
            "set `backdrop`, or leave it out"
        )


def _array_to_texels(texture: npt.ArrayLike | Tensor) -> Float32Array:
    """Return a texture (h, w, 3) as contiguous float32 sRGB in [0, 1].

    Values of dtype uint8 are divided by 255.

    Raises:
        InputError: another shape, or values outside [0, 1].
    """
    array = np.asarray(
        texture.detach().cpu() if isinstance(texture, Tensor) else texture
    )
    max_level = 255.0 if array.dtype == np.uint8 else 1.0
    texels: Float32Array = array.astype(np.float32) / max_level
    _check_texture_shape(texels)
    _check_texture_levels(array, texels)
    return np.ascontiguousarray(texels)


def _check_texture_shape(texels: Float32Array) -> None:
    """Raise InputError if an array is no color image (h, w, 3)."""
    is_image = texels.ndim == 3 and texels.shape[2] == 3
    if not is_image or texels.size == 0:
        raise InputError(
            "texture: expected a picture (h, w, 3), got an array of shape "
            f"{texels.shape}"
        )


def _check_texture_levels(array: npt.NDArray[Any], texels: Float32Array) -> None:
    """Raise InputError if texels are outside [0, 1]; `array` is what they come from."""
    is_in_range = texels.min() >= 0.0 and texels.max() <= 1.0
    if not np.isfinite(texels).all() or not is_in_range:
        raise InputError(
            "texture: expected sRGB in [0, 1], or 8 bits as uint8, got "
            f"{array.dtype} from {array.min():g} to {array.max():g}"
        )


def scene_to_settings(scene: Scene) -> dict[str, Any]:
    """Return the settings by which a configuration names a loaded scene.

    The keys are those of `SceneConfig`. For a scene with `is_session_only` these
    settings are incomplete, since no file can name its Python objects.
    """
    description = scene.description
    backdrop, occluder, camera = _find_photograph_settings(description)
    return {
        "object": description.object_name,
        "environment": description.environment_name,
        "up": description.up,
        "facing": description.facing,
        "size": description.size,
        "unit": description.unit,
        "camera": camera,
        "things": description.things_spec or None,
        "backdrop": backdrop,
        "occluder": occluder,
        "set": description.requested_values,
    }


class _PhotographSettings(NamedTuple):
    """Settings that name the photograph of a scene, its mask and its camera."""

    backdrop: str | None
    occluder: str | None
    camera: str | None


def _find_photograph_settings(description: SceneDescription) -> _PhotographSettings:
    """Return the settings of a scene that depend on whether it is in a photograph."""
    photograph = description.backdrop_photograph
    backdrop = None
    occluder = None
    if photograph is not None:
        backdrop = photograph.spec
        # file of the mask of what is in front of the object; "" without one
        occluder = photograph.front_spec or None
    camera = _camera_setting(description)
    # A scene in a folder of photographs shows one of them. The settings name the
    # folder.
    if description.photographs is not None:
        backdrop = description.photographs.path
        camera = description.photographs.camera
    return _PhotographSettings(backdrop, occluder, camera)


def _camera_setting(description: SceneDescription) -> str | None:
    """Return the value of the `camera` setting that names a scene's camera.

    It is the first of these that the scene has: a rig of several cameras, a preset such
    as "dashcam", a lens such as "fisheye", or a camera of the scene file. None means
    the default, a pinhole that orbits the object.
    """
    if description.rig:
        return description.rig_spec
    if description.preset:
        return description.preset
    model = description.camera_model
    if model is not None and model.name:
        return model.name
    return None if description.camera == ORBIT_CAMERA else description.camera


def _fit_photographs(
    description: SceneDescription,
    photograph: BackdropPhotograph,
    size: tuple[int, int],
) -> SceneDescription:
    """Return a scene whose camera and photographs are fitted to a picture size.

    In a folder of photographs the scene in each of them is fitted.

    Args:
        description: the scene.
        photograph: photograph that the scene is rendered into.
        size: height and width of the picture in pixels.
    """
    folder = description.photographs
    if folder is not None:
        fitted_scenes = {
            name: fit_camera(scene, size) for name, scene in folder.scenes.items()
        }
        folder = replace(folder, scenes=fitted_scenes)
    fitted = fit_to_photograph(description, photograph, size, description.gain)
    return replace(fitted, photographs=folder)


def fit_camera(
    description: SceneDescription, resolution: int | tuple[int, int]
) -> SceneDescription:
    """Return the scene with its camera fitted to a picture size.

    The camera gets the aspect of the picture, and a bundled lens such as "fisheye" is
    made anew for it. A scene with raindrops on the lens gets a camera model if it has
    none. A scene in a photograph is fitted to the size of the photograph instead.

    Args:
        description: the scene.
        resolution: side, or (height, width), in pixels.

    Raises:
        InputError: several cameras and drops on a lens; or the scene is rendered into a
            photograph of another shape.
    """
    height, width = _height_and_width(resolution)
    aspect = width / height
    if description.backdrop_photograph is not None:
        return _fit_photographs(
            description, description.backdrop_photograph, (height, width)
        )
    camera_model = description.camera_model
    if description.get_number("camera.drops") > 0.0:
        camera_model = _find_camera_behind_drops(description, aspect)
    if camera_model is None:
        return replace(description, aspect=aspect, camera_model=None)
    # A bundled lens depends on the aspect, and is found again by its name. Any other
    # camera model stays.
    camera_model = make_bundled_models(aspect).get(camera_model.name, camera_model)
    scaling_remarks = camera_model.describe_scaling((height, width))
    remarks = tuple(dict.fromkeys((*description.remarks, *scaling_remarks)))
    return replace(
        description, aspect=aspect, camera_model=camera_model, remarks=remarks
    )


def _find_camera_behind_drops(
    description: SceneDescription, aspect: float
) -> CameraModel:
    """Return the camera model of a scene with raindrops on the lens.

    Drops bend the ray of each pixel, so they need a camera model, which has a table of
    rays.

    Raises:
        InputError: the scene has several cameras.
    """
    if description.rig:
        raise InputError(
            "`set` camera.drops: of one camera, not of several; leave it out"
        )
    camera_model = description.camera_model
    # A pinhole that is made here has no name. If an earlier call has made it, perhaps
    # for another aspect, it is replaced.
    if camera_model is None or not camera_model.name:
        return make_pinhole(description.get_number("camera.fov"), aspect)
    return camera_model


def _height_and_width(resolution: int | tuple[int, int]) -> tuple[int, int]:
    """Return (height, width) in pixels of a resolution, which may be a single side."""
    if isinstance(resolution, int):
        return resolution, resolution
    return resolution


def _check_is_lit(description: SceneDescription) -> None:
    """Raise InputError for a scene without any light."""
    if not description.is_lit:
        raise InputError(
            "environment: the scene has neither a map nor a lamp, so that every "
            "picture is black; give it one of the two, such as `controls=light`"
        )


def make_renderer(
    description: SceneDescription,
    space: Space,
    resolution: int | tuple[int, int],
    denoise: str,
    seed: int,
    estimators: Mapping[str, str] | None = None,
    leave_out: Collection[str] = ALL_OMISSIONS,
    sampler: str = SAMPLER,
    *,
    differentiated: bool = True,
) -> Renderer:
    """Load a described scene, with what the space's controls need, into Mitsuba.

    Args:
        description: the scene. If a control of the space has changed the scene, the
            changed one is loaded instead.
        space: controls that vary.
        resolution: side, or (height, width), in pixels.
        denoise: "oidn" or "none".
        seed: root of the noise.
        estimators: how derivatives are computed, by "control.parameter", "control" or
            "*".
        leave_out: names of what may be left out of the Mitsuba scene to save time,
            where that changes no image.
        sampler: "multijitter" or "independent".
        differentiated: whether images are differentiated by the coordinates. If not,
            the measurement of how fast each coordinate moves outlines is skipped. This
            saves a third of the time to load a scene and render a few small images.

    Raises:
        InputError: the scene has no light; or its cameras take their images at
            different times, and nothing in the scene moves.
    """
    size = _height_and_width(resolution)
    # a control may have changed the scene, as one that chooses the photograph does
    description = space.scene or description
    _check_is_lit(description)
    formation = _make_formation(description, size, denoise, sampler)
    scene = MitsubaScene(
        description, size, filter=formation.filter, leave_out=leave_out, sampler=sampler
    )
    _check_rig_times(description, space)
    motion = None
    if differentiated:
        motion = Motion(description, size, scene.input_assembler)
    moments = _find_exposure_moments(description, space, size, scene, motion)
    return Renderer(
        scene,
        space,
        formation,
        seed,
        motion=motion,
        estimators=estimators,
        moments=moments,
    )


def _make_formation(
    description: SceneDescription, size: tuple[int, int], denoise: str, sampler: str
) -> ImageFormation:
    """Return how images of a scene are formed; `size` is (height, width) in pixels."""
    return ImageFormation(
        denoiser=denoise,
        sampler=sampler,
        exposure=description.get_number("camera.exposure"),
        resolution=size,
        gain=description.gain,
    )


def _find_exposure_moments(
    description: SceneDescription,
    space: Space,
    size: tuple[int, int],
    scene: MitsubaScene,
    motion: Motion | None,
) -> tuple[Moment, ...]:
    """Return the moments whose images are averaged to an image with motion blur.

    There are none if the controls state no exposure time. `motion` computes how points
    move in the image; without it, another one is made.
    """
    has_exposure_time = any(space.exposure)
    if not has_exposure_time:
        return ()
    exposure_motion = motion or Motion(description, size, scene.input_assembler)
    return choose_moments(space, exposure_motion, scene.input_assembler, height=size[0])


def _check_rig_times(description: SceneDescription, space: Space) -> None:
    """Check a rig in which some cameras take their image later than others.

    Such a rig only makes sense if something in the scene changes with time. It can't
    have motion blur or a rolling shutter.

    Args:
        description: the scene, whose rig states a delay for each camera.
        space: the controls.

    Raises:
        InputError: nothing changes with time, or an image has motion blur.
    """
    has_delays = any(mount.delay for mount in description.rig)
    if not has_delays:
        return
    prefix = (
        f"camera: the pictures of {description.rig_spec} are taken one after the other"
    )
    if any(space.exposure):
        raise InputError(
            f"{prefix}, and can not have motion blur or a rolling shutter; "
            "leave that out"
        )
    if not _changes_with_time(space):
        raise InputError(
            f"{prefix}, but nothing in the scene changes with time; add a `path`"
        )


def _changes_with_time(space: Space) -> bool:
    """Return whether a control changes the scene with time."""
    # One second later: `advance_time` returns the same object for a static control.
    controls_later = space.advance_time(1.0).controls
    return any(
        control is not control_later
        for control, control_later in zip(space.controls, controls_later, strict=True)
    )


MOMENTS_PER_FLASH = 8  # moments of each flash of a light
# random configurations on which motion during an exposure is measured
N_MOTION_SAMPLES = 64


def choose_moments(
    space: Space, motion: Motion, assembly: InputAssembler, height: int
) -> tuple[Moment, ...]:
    """Return the moments of an exposure at which an image is rendered.

    The average of these images has motion blur. The faster points move in the image,
    the more moments there are (`MOMENTS_PER_PIXEL`), so that the blur shows no steps. A
    flashing light needs `MOMENTS_PER_FLASH`, so that it is on in some moments and off
    in others. There are at least `MIN_MOMENTS` and at most `MAX_MOMENTS`.

    Args:
        space: the controls, which state how long an exposure takes.
        motion: projects points of the scene into the image.
        assembly: turns the inputs of the space into those of the scene.
        height: height of the image in pixels.
    """
    # `shutter`: seconds for which each row is exposed. `rolling`: seconds between the
    # first row and the last, negative if rows are read from the bottom up.
    shutter, rolling = space.exposure
    duration = shutter + abs(rolling)
    max_pixels_moved = _measure_max_motion(space, motion, assembly, duration)
    n_moments = _count_moments(space, duration, max_pixels_moved)
    # Time of each moment, and the rows that are exposed at it. The fraction of samples
    # is the same for all moments.
    offsets, rows, sample_fraction = divide_exposure(
        shutter, rolling, height, n_moments
    )
    return tuple(
        Moment(space.advance_time(float(offset)), rows_of_moment, sample_fraction)
        for offset, rows_of_moment in zip(offsets, rows, strict=True)
    )


def _count_moments(space: Space, duration: float, max_pixels_moved: float) -> int:
    """Return how many moments an exposure of `duration` seconds needs."""
    # `flashes` is a number per second
    n_flashes = max(control.flashes for control in space.controls) * duration
    n_for_motion = math.ceil(MOMENTS_PER_PIXEL * max_pixels_moved)
    n_for_flashes = math.ceil(MOMENTS_PER_FLASH * n_flashes)
    return min(max(MIN_MOMENTS, n_for_motion, n_for_flashes), MAX_MOMENTS)


def _measure_max_motion(
    space: Space, motion: Motion, assembly: InputAssembler, duration: float
) -> float:
    """Return how many pixels a point moves in the image at most during an exposure.

    It is measured on `N_MOTION_SAMPLES` random configurations of the controls that
    move. The exposure is centered at time 0. Only points that are visible at its begin
    and at its end count.

    Args:
        space: all controls; static ones are left out.
        motion: projects points of the scene into the image, in pixels.
        assembly: turns the inputs of the space into those of the scene.
        duration: length of the exposure in seconds.
    """
    # only a control that moves has an exposure: (shutter, rolling) in seconds
    moving_controls = tuple(
        control for control in space.controls if any(control.exposure)
    )
    moving_space = replace(space, controls=moving_controls)
    space_at_begin = moving_space.advance_time(-duration / 2.0)
    space_at_end = moving_space.advance_time(duration / 2.0)
    project = partial(_project_configuration, motion, assembly)
    max_moved = 0.0
    for u in _sample_moving_configurations(len(moving_space.start)):
        before, is_visible_before = project(space_at_begin, u)
        after, is_visible_after = project(space_at_end, u)
        is_visible = is_visible_before & is_visible_after
        moved = (after - before)[is_visible].norm(dim=1)
        if len(moved):
            max_moved = max(max_moved, float(moved.max()))
    return max_moved


def _project_configuration(
    motion: Motion, assembly: InputAssembler, space: Space, u: Tensor
) -> tuple[Tensor, Tensor]:
    """Return where points lie in the image of u (d,), and which are in or near it.

    The positions (N, 2) are in pixels from the center.

    Args:
        motion: projects points of the scene into the image.
        assembly: turns the inputs of the space into those of the scene.
        space: space of the configuration.
        u: (d,) the configuration.
    """
    return motion.project_points(assembly(space.inputs(u)))


def _sample_moving_configurations(n_coordinates: int) -> Tensor:
    """Return the random configurations (`N_MOTION_SAMPLES`, d) of a measured motion.

    The seed is fixed: the number of moments of an exposure (`choose_moments`) follows
    from the result, and must not differ between two runs.
    """
    generator = torch.Generator().manual_seed(0)
    return torch.rand(N_MOTION_SAMPLES, n_coordinates, generator=generator)


def controls_to_settings(controls: Controls) -> dict[str, dict[str, object]]:
    """Return the settings of controls by name, as a file stores them.

    Controls may be given as names, instances or a mapping. An instance is written with
    all of its settings, a name only with those that the caller stated.
    """
    # an instance or the stated settings, which are empty for a bare name
    control_by_name = normalize_controls(controls)
    if not isinstance(controls, Mapping):
        # Only to raise an error, e.g. for an unknown name. With a mapping this is done
        # later, when its controls are made.
        make_controls(control_by_name)
    settings_of_control = {}
    for name, control in control_by_name.items():
        if isinstance(control, Control):
            settings_of_control[name] = control.to_settings()
        else:
            settings_of_control[name] = dict(control)
    return settings_of_control


def make_controls(controls: Controls) -> tuple[Control, ...]:
    """Return control instances in the caller's order.

    Args:
        controls: one or several names or instances, or a mapping from names to settings
            or instances.

    Raises:
        InputError: a control is unknown, has wrong settings, or comes twice.
    """
    control_by_name = normalize_controls(controls)
    instances = _select_instances(control_by_name)
    # an instance is entered with empty settings
    named_settings: dict[str, Mapping[str, object]] = {
        name: {} if isinstance(control, Control) else control
        for name, control in control_by_name.items()
    }
    # several names may state parameters of one control
    settings_by_control = merge_control_settings(named_settings)
    _check_instances_have_no_settings(instances, settings_by_control)
    return tuple(
        instances.get(name) or make_control(name, control_settings)
        for name, control_settings in settings_by_control.items()
    )


def _select_instances(control_by_name: Mapping[str, object]) -> dict[str, Control]:
    """Return the controls that are instances, by name, without mere settings."""
    return {
        name: control
        for name, control in control_by_name.items()
        if isinstance(control, Control)
    }


def _check_instances_have_no_settings(
    names: Iterable[str], settings_by_control: Mapping[str, Mapping[str, object]]
) -> None:
    """Raise InputError if a control has settings besides its instance.

    Args:
        names: names of the controls that have an instance.
        settings_by_control: merged settings of each control; those of an instance are
            empty unless a name has stated some.
    """
    for name in names:
        has_settings = bool(settings_by_control[name])
        if has_settings:
            raise InputError(
                f"controls: {name} is given twice, by an instance and by "
                "name; state all of it in one"
            )


def normalize_controls(controls: Controls) -> dict[str, Control | Mapping[str, object]]:
    """Return the instance or the settings of each control by its name.

    They have the caller's order. Controls may be given as names, instances or a
    mapping.

    Raises:
        InputError: something else than names, settings and instances, or a name that
            comes twice.
    """
    if isinstance(controls, Mapping):
        control_by_name = _read_control_mapping(controls)
    else:
        control_by_name = _read_control_list(controls)
    instances = _select_instances(control_by_name)
    # Only settings are checked. To keep the order of the controls, an instance is
    # replaced by None (no settings) for this check, and put back afterwards.
    without_instances = {**control_by_name, **dict.fromkeys(instances)}
    all_settings = check_control_settings(without_instances)
    return {
        name: instances.get(name, control_settings)
        for name, control_settings in all_settings.items()
    }


def _read_control_mapping(controls: Mapping[str, object]) -> dict[str, object]:
    """Return the controls of a mapping by name, each an instance or settings.

    A distribution that is a Python object becomes the setting that describes it.

    Raises:
        InputError: a class, or an instance under another name than its own.
    """
    control_by_name: dict[str, object] = {}
    for name, control in controls.items():
        _check_mapped_control(name, control)
        if isinstance(control, Control):
            control_by_name[name] = control
        elif _is_settings_of_control(control):  # and not of one parameter
            control_by_name[name] = {
                key: distribution_to_setting(value) for key, value in control.items()
            }
        else:
            # the value of a single parameter, as for the name "camera.azimuth"
            control_by_name[name] = distribution_to_setting(control)
    return control_by_name


def _check_mapped_control(name: str, control: object) -> None:
    """Raise InputError for a class, or an instance under another name than its own."""
    is_misnamed = isinstance(control, Control) and control.name != name
    if isinstance(control, type) or is_misnamed:
        got = describe_value(control)
        if isinstance(control, Control):
            got = f"one that is called {control.name}"
        raise InputError(
            f"`controls` {name}: expected settings, or an instance of that "
            f"name, got {got}; instances stand in a list as well, controls=[...]"
        )


def _is_settings_of_control(value: object) -> TypeGuard[Mapping[str, Any]]:
    """Return whether a value is a mapping of settings, and not that of one parameter.

    The value of a parameter may be a mapping as well, such as {"range": [0, 30]}.
    """
    return isinstance(value, Mapping) and not value.keys() & SINGLE_VALUE_KEYS


def _read_control_list(
    controls: str | Control | Sequence[str | Control],
) -> dict[str, object]:
    """Return one control or several by name, each an instance or settings.

    A text is parsed into a name and settings, as on the command line.

    Raises:
        InputError: something else than names and instances, or a name that comes twice.
    """
    control_list: Iterable[object] = [controls]
    if isinstance(controls, Iterable) and not isinstance(controls, (str, Control)):
        control_list = controls
    control_by_name: dict[str, object] = {}
    for control in control_list:
        added = _read_listed_control(control)
        for name in added:
            if name in control_by_name:
                raise InputError(
                    "controls: every instance needs a name of its own, got "
                    f"{name} twice; write KIND:NAME, such as light:key,light:fill"
                )
        control_by_name |= added
    return control_by_name


def _read_listed_control(control: object) -> dict[str, Any]:
    """Return a control of a list by name: an instance, or settings parsed from text."""
    if isinstance(control, str):
        return dict(parse_controls([control], "controls"))
    if isinstance(control, Control):
        return {control.name: control}
    raise InputError(
        f"controls: expected names or Control instances, got {describe_value(control)}"
    )


def list_control_instances(controls: object) -> list[Control]:
    """Return the control instances among controls in any form."""
    items = controls.values() if isinstance(controls, Mapping) else controls
    if not isinstance(items, (list, tuple, ValuesView)):
        items = [items]
    return [control for control in items if isinstance(control, Control)]


def list_session_only_controls(controls: Controls) -> list[str]:
    """List the controls and parameters that exist in this Python session only.

    No file and no other process can load them. These are controls of classes that are
    not registered, and parameters whose values a Python function samples.
    """
    session_only = [
        type(control).__name__
        for control in list_control_instances(controls)
        if CONTROLS.get(control.kind) is not type(control)
    ]
    for name, control_settings in controls_to_settings(controls).items():
        for parameter, value in control_settings.items():
            if isinstance(value, PythonQuantiles):
                # A control of a single parameter may have the name
                # "control.parameter" already.
                full_name = name if "." in name else f"{name}.{parameter}"
                session_only.append(f"{full_name} (drawn by {value['name']})")
    return session_only
