"""Mitsuba's dictionary of a described scene: its camera, its environment and the ground; objects come as parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from advsearch.errors import InputError
from advsearch.scene.cameras.model import NUMBERS
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.meshes import matt, mitsuba_mesh
from advsearch.scene.mitsuba_backend.parts import SceneInput, number, transform
from advsearch.scene.mitsuba_backend.variant import Plugin, fewer_warnings, mitsuba
from advsearch.scene.parts import PluginPart
from advsearch.scene.road import paved

GROUND = "ground"
GROUND_INPUT = SceneInput("ground.reflectance", f"{GROUND}.*.reflectance.data", interior=True)
"""(h, w, 3): the texture of a ground that shows the environment's photograph (`advsearch.scene.photograph`)."""


def scene_dict(description: SceneDescription, resolution: tuple[int, int], filter: str, sampler: str) -> Plugin:
    """Everything but the object and the parts."""
    mi = mitsuba()
    place = mi.ScalarTransform4f
    number = description.number
    scene: Plugin = {
        "type": "scene",
        "camera": _camera(description, resolution, filter, sampler),
    }
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


def loaded(plugins: Plugin, description: SceneDescription) -> Any:
    """Return Mitsuba's scene of a dictionary.

    Raises:
        InputError: Mitsuba refuses plugins of the user's.
    """
    try:
        with fewer_warnings():
            return mitsuba().load_dict(plugins, optimize=False)
    except RuntimeError as error:
        if not any(isinstance(part, PluginPart) for part in description.parts):
            raise
        raise InputError(f"{description.object_name}: Mitsuba refuses the scene: {error}; change it there") from error


def _camera(description: SceneDescription, resolution: tuple[int, int], filter: str, sampler: str) -> Plugin:
    height, width = resolution
    camera: Plugin = {
        **_lens(description),
        "near_clip": 0.01,
        "far_clip": 1e5,
        "to_world": mitsuba().ScalarTransform4f(camera_to_world(description, width / height)),
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
        if description.backdrop and (model.black > 0.0 or not model.name):  # a searched lens may fold
            raise InputError(
                "background: it would show where the camera's lens sees nothing as well; leave the plain background "
                "out, or take a lens that fills the picture"
            )
        import advsearch.scene.mitsuba_backend.sensor  # noqa: F401  (registers the sensor)

        return {"type": "advsearch_camera", "kind": model.kind, "reach": model.reach, **model.values}
    pinhole: Plugin = {"type": "perspective", "fov": description.number("camera.fov"), "fov_axis": "larger"}
    if description.thin_lens:
        pinhole |= {"type": "thinlens", "aperture_radius": 1e-4, "focus_distance": 1.0}
    return pinhole


def camera_inputs(resolution: tuple[int, int]) -> tuple[SceneInput, ...]:
    """The camera's inputs. Our field of view is along the larger side, Mitsuba's parameter along the width."""
    height, width = resolution

    def along_width(value: Any) -> Any:
        # not before `mitsuba()`, which sees to libLLVM
        import drjit as dr

        half = dr.deg2rad(value.array) / 2.0
        return mitsuba().Float(2.0 * dr.rad2deg(dr.atan(dr.tan(half) * min(1.0, width / height))))

    return (
        SceneInput("camera.to_world", "camera.to_world", transform, shape=(4, 4)),
        SceneInput("camera.fov", "camera.x_fov", along_width, shape=(1,)),
        SceneInput("camera.shift_x", "camera.principal_point_offset_x", number, shape=(1,)),
        SceneInput("camera.shift_y", "camera.principal_point_offset_y", number, shape=(1,)),
        SceneInput("camera.aperture", "camera.aperture_radius", number, shape=(1,)),
        SceneInput("camera.lens", "camera.lens", shape=(len(NUMBERS),)),
        SceneInput("camera.focus", "camera.focus_distance", number, shape=(1,)),
    )
