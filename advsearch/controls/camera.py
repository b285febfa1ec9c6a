"""The `camera` control: an orbit around the object, the lens, and the exposure.

The camera looks at the middle of the object in its default pose. Its lens bends as a
calibrated one does where a coefficient is asked for, or a camera file has one: see
`advsearch.scene.camera_model`. While the distance is not searched or set, it follows
the field of view so that the object keeps its place in the picture (a dolly zoom), down
to where the camera would enter the sphere around the object: see
`advsearch.scene.geometry`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import Control, Values
from advsearch.controls.ranges import Fixed
from advsearch.errors import InputError
from advsearch.scene.assets import is_road_vehicle
from advsearch.scene.camera_entries import PRESETS
from advsearch.scene.camera_model import (
    COEFFICIENTS,
    COEFFICIENTS_OF_KIND,
    NUMBER_NAMES,
    CameraModel,
    make_pinhole,
)
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import (
    MAX_ELEVATION_SINE,
    camera_to_world,
    compute_center,
    compute_framing_distance,
    make_affine,
)
from advsearch.scene.grounds import is_against_traffic, make_traffic_remark
from advsearch.scene.settings import CAMERA, ORBIT_CAMERA, Parameter

# metres above the road from which vehicles are seen: from a bumper to the roof of a
# lorry
ROAD_USER_HEIGHTS = (0.5, 4.0)
DISTORTION_KINDS = {"k": "Radial", "p": "Tangential", "s": "Thin-prism"}
# width in millimetres of the full-frame sensor that a focal length refers to
SENSOR_WIDTH = 36.0


EQUIVALENT_PARAMETERS = (
    ("fov", "focal_length"),
    ("elevation", "height"),
    ("distance", "sizes"),
)
"""Pairs of parameters that say the same thing."""
_moving = partial(Parameter.moving, Parameter.ORBIT)
_number = partial(Parameter.number, Parameter.ORBIT)


class CameraControl(Control):
    """An orbit around the object, the lens, and the exposure."""

    kind = "camera"
    photograph_refusal = (
        "the photograph was taken from one place, through one lens, at one exposure"
    )
    parameters = (
        *CAMERA[:-1],
        _moving(
            "focal_length",
            "mm",
            1.5,
            2100.0,
            "as fov",
            "The same for a sensor 36 mm wide.",
            log=True,
        ),
        _moving(
            "sizes",
            "object sizes",
            1e-4,
            1e5,
            "as distance",
            "The same as `distance`.",
            log=True,
        ),
        _moving(
            "shift_x",
            "picture widths",
            -2.0,
            2.0,
            0.0,
            "Shift of the picture to the right.",
        ),
        _moving(
            "shift_y",
            "picture heights",
            -2.0,
            2.0,
            0.0,
            "Shift of the picture downwards.",
        ),
        _number(
            "aperture",
            "object sizes",
            0.0,
            10.0,
            0.0,
            "Radius of the lens; 0 is a pinhole.",
        ),
        _number(
            "focus",
            "metres",
            1e-4,
            1e5,
            "the object's middle",
            "Distance in focus.",
            log=True,
        ),
        *(
            _moving(
                name,
                "1",
                -100.0,
                100.0,
                0.0,
                f"{DISTORTION_KINDS[name[0]]} distortion, as OpenCV has it.",
            )
            for name in COEFFICIENTS
        ),
        CAMERA[-1],
    )

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Check the settings against the scene, and add the lens that they need.

        Distortion coefficients need a camera model: without one, a pinhole's is added.
        An aperture or a focus needs a thin lens, in a scene without a camera model. If
        the camera would always drive against the traffic, a remark is added.

        Raises:
            InputError: the scene has another camera, two settings are the same thing,
                or its lens does not support one.
        """
        if scene.camera != ORBIT_CAMERA:
            raise InputError(
                f"`controls` {self.name}: moves along an orbit around the object, and "
                "the scene is seen by its camera "
                f"{scene.camera!r}; leave the control out, or have it seen by "
                f"{ORBIT_CAMERA!r}"
            )
        for first, second in EQUIVALENT_PARAMETERS:
            if first in self.specs and second in self.specs:
                raise InputError(
                    f"`controls` {self.name}: {first} and {second} say the same thing; "
                    "leave one of them out"
                )
        if "azimuth" in self.specs and self._drives_against_traffic(scene):
            scene = replace(scene, remarks=(*scene.remarks, make_traffic_remark(scene)))
        has_thin_lens = "aperture" in self.specs or "focus" in self.specs
        if has_thin_lens and self._is_shifted:
            raise InputError(
                f"`controls` {self.name}: a shifted picture together with an aperture "
                "is not supported; leave one out"
            )
        # coefficients of the distortion that were set
        bent_coefficients = [name for name in COEFFICIENTS if name in self.specs]
        if bent_coefficients and scene.camera_model is None:
            scene = replace(
                scene,
                camera_model=make_pinhole(scene.get_number("camera.fov"), scene.aspect),
            )
        model = scene.camera_model
        if model is None:
            return replace(scene, thin_lens=True) if has_thin_lens else scene
        for name in bent_coefficients:
            if name not in COEFFICIENTS_OF_KIND[model.kind]:
                coefficients = ", ".join(COEFFICIENTS_OF_KIND[model.kind]) or "none"
                raise InputError(
                    f"`controls` {self.name}: a {model.kind} lens has the "
                    f"coefficients {coefficients}, not {name}"
                )
        lens_parameters = ("fov", "focal_length") if model.name else ()
        shift_parameters = (
            () if COEFFICIENTS_OF_KIND[model.kind] else ("shift_x", "shift_y")
        )
        for name in (*lens_parameters, *shift_parameters, "aperture", "focus"):
            if name in self.specs:
                lens = (
                    f"the lens of `camera={model.name}`"
                    if model.name
                    else "a lens with distortion, or raindrops"
                )
                raise InputError(
                    f"`controls` {self.name}: {name} is not supported "
                    f"with {lens}; leave one of them out"
                )
        return scene

    def _drives_against_traffic(self, scene: SceneDescription) -> bool:
        """Return whether the camera always drives against the traffic.

        That is at the lower end, the center and the upper end of all its ranges.
        """
        control = self.bind(scene)
        configurations = (
            torch.full_like(control.start, value) for value in (0.0, 0.5, 1.0)
        )
        poses = [
            control.inputs(u)["camera.to_world"].detach().double().numpy()
            for u in configurations
        ]
        return all(is_against_traffic(scene, pose) for pose in poses)

    @property
    def _is_shifted(self) -> bool:
        return "shift_x" in self.specs or "shift_y" in self.specs

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter with the default and the range of the scene's own camera.

        Defaults are those of the scene's lens and pose. The range is the preset's, if
        the scene has one; around a road vehicle it is that of heights of road users in
        place of the elevation; a distance has a multiple of its default.
        """
        parameter = adapt_length_unit(
            super().resolve_parameter(parameter),
            self.scene.object.size_in_metres is not None,
        )
        scene = self.scene
        name = parameter.name
        default = parameter.default
        search = parameter.search
        if name in COEFFICIENTS and scene.camera_model is not None:
            default = scene.camera_model.values[name]
        elif name in ("distance", "focus", "sizes"):
            fixed_lens_scene = self._with_fixed_lens()
            camera_position = camera_to_world(fixed_lens_scene)[:3, 3]
            offset = camera_position - compute_center(fixed_lens_scene)
            distance = float(np.linalg.norm(offset))
            default = distance * (1.0 if name == "sizes" else scene.size_in_metres)
        elif name == "height":
            camera_height = float(camera_to_world(self._with_fixed_lens())[2, 3])
            default = camera_height * scene.size_in_metres
        elif name == "focal_length":
            half_fov = math.radians(scene.get_number("camera.fov")) / 2.0
            default = SENSOR_WIDTH / 2.0 / math.tan(half_fov)
        preset = PRESETS.get(scene.preset)
        if preset is not None and name == "azimuth":
            reach = preset.search_azimuth
            scene_azimuth = scene.get_number("camera.azimuth")
            search = (scene_azimuth - reach, scene_azimuth + reach)
            if reach >= 180.0:
                search = (0.0, 360.0)
        elif preset is not None:
            search = preset.search_ranges.get(name)
        elif is_road_vehicle(scene.object) and name == "elevation":
            search = None
        elif is_road_vehicle(scene.object) and name == "height":
            search = ROAD_USER_HEIGHTS[0], max(ROAD_USER_HEIGHTS[1], float(default))
        elif name == "distance" and search is not None:
            search = search[0] * float(default), search[1] * float(default)
        return replace(parameter, default=default, search=search)

    def setting_name(self, parameter: Parameter) -> str:
        equivalent_settings = {"focal_length": "camera.fov", "sizes": "camera.distance"}
        return equivalent_settings.get(parameter.name, super().setting_name(parameter))

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the camera's pose, lens, focus, shift and exposure.

        The distance is that of `sizes` or `distance`, if the user set one of them, or
        the scene's setting; else the object is framed as the field of view requires. A
        camera model has its own numbers in place of the field of view and the shift.
        """
        scene = self.scene
        fov = values["fov"]
        if "focal_length" in self.specs:
            fov = _compute_fov(values["focal_length"])
        if "sizes" in self.specs:
            distance = values["sizes"]
        elif (
            "distance" in self.specs
            or not self.has_requested_search
            or scene.values.get("camera.distance") is not None
        ):
            distance = values["distance"] / scene.size_in_metres
        else:
            distance = compute_framing_distance(scene, fov, scene.aspect).float()
        inputs = {"camera.to_world": self._compute_pose(values, distance)}
        if scene.camera_model is not None:
            inputs["camera.lens"] = self._compute_model_numbers(
                scene.camera_model, values, fov
            )
        else:
            inputs["camera.fov"] = fov.reshape(1)
        if scene.thin_lens and ("aperture" in self.specs or "focus" in self.specs):
            inputs["camera.aperture"] = values["aperture"].clamp_min(1e-5).reshape(1)
            focus = (
                values["focus"] / scene.size_in_metres
                if "focus" in self.specs
                else distance
            )
            inputs["camera.focus"] = focus.reshape(1)
        if scene.camera_model is None and self._is_shifted:
            inputs["camera.shift"] = torch.stack([values["shift_x"], values["shift_y"]])
        if "exposure" in self.specs:
            inputs["camera.exposure"] = values["exposure"] - scene.get_number(
                "camera.exposure"
            )
        return inputs

    def _compute_model_numbers(
        self, model: CameraModel, values: Values, fov: Tensor
    ) -> Tensor:
        """Return the numbers (17,) of the camera's model, in the order of
        `NUMBER_NAMES`.

        A model without a name is a pinhole whose focal lengths are those of the field
        of view; coefficients that were set replace the model's.
        """
        model_values = {
            name: torch.tensor(value) for name, value in model.values.items()
        }
        if not model.name:
            aspect = self.scene.aspect
            # as a fraction of the larger side, along which the field of view is
            focal = 0.5 / torch.tan(torch.deg2rad(fov) / 2.0)
            model_values |= {
                # fx is a fraction of the width, fy of the height
                "fx": focal * max(1.0, 1.0 / aspect),
                "fy": focal * max(1.0, aspect),
            }
        model_values |= {
            name: values[name] for name in COEFFICIENTS if name in self.specs
        }
        model_values |= {
            "cx": model_values["cx"] + values["shift_x"],
            "cy": model_values["cy"] + values["shift_y"],
        }
        return torch.stack([model_values[name].to(fov) for name in NUMBER_NAMES])

    def _with_fixed_lens(self) -> SceneDescription:
        """Return the scene with the field of view to which the control fixes it, if it
        does.

        The camera's distance depends on the field of view, so that it is computed for
        this one.
        """
        fov = self.specs.get("fov")
        focal_length = self.specs.get("focal_length")
        if isinstance(fov, Fixed):
            return self.scene.with_values(camera__fov=float(fov.value))
        if isinstance(focal_length, Fixed):
            return self.scene.with_values(
                camera__fov=_compute_fov(torch.tensor(float(focal_length.value))).item()
            )
        return self.scene

    def _compute_pose(self, values: Values, distance: Tensor) -> Tensor:
        """Return the pose (4, 4) on the orbit, at a distance () in object sizes.

        The elevation follows from the height in two cases: the user set the height; or
        set neither of the two, and the scene states a height or the height is searched.
        """
        azimuth = torch.deg2rad(self.scene.azimuth_zero + values["azimuth"])
        elevation = torch.deg2rad(values["elevation"])
        roll = torch.deg2rad(values["roll"])
        keeps_height = "height" in self.specs
        if not {"elevation", "height"} & self.specs.keys():
            is_height_searched = any(
                slot.n_coordinates
                for slot in self.slots
                if slot.parameter.name == "height"
            )
            keeps_height = (
                self.scene.values.get("camera.height") is not None or is_height_searched
            )
        if keeps_height:
            height_above_center = values["height"] / self.scene.size_in_metres - float(
                compute_center(self.scene)[2]
            )
            elevation = torch.asin(
                (height_above_center / distance).clamp(
                    -MAX_ELEVATION_SINE, MAX_ELEVATION_SINE
                )
            )
        zero = torch.zeros_like(azimuth)
        outwards = torch.stack(
            [
                elevation.cos() * azimuth.cos(),
                elevation.cos() * azimuth.sin(),
                elevation.sin(),
            ]
        )
        level_left = torch.stack([azimuth.sin(), -azimuth.cos(), zero])
        level_up = torch.linalg.cross(-outwards, level_left)
        # turned by the roll about the direction of view
        left = roll.cos() * level_left + roll.sin() * level_up
        up = roll.cos() * level_up - roll.sin() * level_left
        position = (
            torch.from_numpy(compute_center(self.scene)).to(distance)
            + distance * outwards
        )
        return make_affine(torch.stack([left, up, -outwards], dim=1), position)


def adapt_length_unit(parameter: Parameter, has_metres: bool) -> Parameter:
    """Return a parameter whose unit of length fits the scene.

    Without a size of the object in metres, lengths are in object sizes.
    """
    return (
        replace(parameter, unit="object sizes")
        if parameter.unit == "metres" and not has_metres
        else parameter
    )


def _compute_fov(focal_length: Tensor) -> Tensor:
    """Return the field of view, degrees, of a lens of a focal length in millimetres."""
    return torch.rad2deg(2.0 * torch.atan(SENSOR_WIDTH / 2.0 / focal_length))
