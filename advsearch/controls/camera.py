"""The `camera` control: an orbit around the object, the lens, and the exposure.

The camera looks at the center of the object in its default pose. If a distortion
coefficient is set, or a camera file has some, the lens is a calibrated one with
distortion: see `advsearch.scene.camera_model`. If the distance is neither searched nor
set, it follows the field of view, so that the object keeps its size in the image (a
dolly zoom). The camera stays outside of the sphere around the object: see
`advsearch.scene.geometry`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from advsearch.controls.base import Control, Values
from advsearch.controls.ranges import Fixed, ParameterValue
from advsearch.errors import InputError
from advsearch.scene.assets import is_road_vehicle
from advsearch.scene.camera_entries import PRESETS, CameraPreset
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

# range of a camera's height around road vehicles, metres: from a bumper to the roof of a
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
"""Pairs of parameters that determine the same number."""
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
            "Field of view as the focal length for a sensor 36 mm wide.",
            log=True,
        ),
        _moving(
            "sizes",
            "object sizes",
            1e-4,
            1e5,
            "as distance",
            "Distance in object sizes, instead of `distance`.",
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
            "Distance at which the image is sharp.",
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
        """Return the scene with the lens that the settings need, after checking them.

        Distortion coefficients need a camera model; if there is none, that of a pinhole
        is added. An aperture or a focus needs a thin lens, which is possible only
        without a camera model. If the camera would always drive against the traffic, a
        remark is added.

        Raises:
            InputError: the scene's camera is not the orbit camera, two settings
                determine the same number, or the lens does not support a setting.
        """
        self._check_can_orbit(scene)
        if self._sets_thin_lens:
            self._check_not_shifted()
        if "azimuth" in self.specs and self._drives_against_traffic(scene):
            scene = replace(scene, remarks=(*scene.remarks, make_traffic_remark(scene)))
        distortion_names = [name for name in COEFFICIENTS if name in self.specs]
        if distortion_names and scene.camera_model is None:
            pinhole = make_pinhole(scene.get_number("camera.fov"), scene.aspect)
            scene = replace(scene, camera_model=pinhole)
        if scene.camera_model is not None:
            # raises if the settings need a thin lens as well
            self._check_lens(scene.camera_model, distortion_names)
        elif self._sets_thin_lens:
            scene = replace(scene, thin_lens=True)
        return scene

    @property
    def _sets_thin_lens(self) -> bool:
        """Whether a setting needs a thin lens: an aperture, or a distance in focus."""
        return "aperture" in self.specs or "focus" in self.specs

    def _check_not_shifted(self) -> None:
        """Raise InputError if the image is shifted, which a thin lens can't do."""
        if self._sets_shift:
            raise InputError(
                f"`controls` {self.name}: a shifted picture together with an aperture "
                "is not supported; leave one of them out"
            )

    def _check_can_orbit(self, scene: SceneDescription) -> None:
        """Check that the scene's camera orbits, and that no number is set twice.

        Raises:
            InputError: the scene fixes the camera; or two settings that determine the
                same number, such as `distance` and `sizes`, are both set.
        """
        if scene.camera != ORBIT_CAMERA:
            raise InputError(
                f"`controls` {self.name}: moves the camera along an orbit around the "
                f"object, and the scene uses its own camera {scene.camera!r}; leave "
                f"the control out, or set the camera to {ORBIT_CAMERA!r}"
            )
        for first, second in EQUIVALENT_PARAMETERS:
            if first in self.specs and second in self.specs:
                raise InputError(
                    f"`controls` {self.name}: {first} and {second} determine the same "
                    "number; leave one of them out"
                )

    def _check_lens(self, model: CameraModel, distortion_names: Sequence[str]) -> None:
        """Check that a lens has all the numbers that the settings change.

        Args:
            model: lens from a camera file; or a model with an empty name, which is a
                pinhole that has a model because of distortion or raindrops on it.
            distortion_names: distortion coefficients that were set, such as "k1".

        Raises:
            InputError: this kind of lens does not have a number that was set.
        """
        supported_names = COEFFICIENTS_OF_KIND[model.kind]
        self._check_coefficients(model.kind, distortion_names)
        unsupported_names = ["aperture", "focus"]
        is_from_file = model.name != ""
        if is_from_file:  # it has its own focal length
            unsupported_names += ["fov", "focal_length"]
        # Only an equirectangular image has no coefficients. It shows all directions.
        is_equirectangular = not supported_names
        if is_equirectangular:
            unsupported_names += ["shift_x", "shift_y"]
        lens = "a lens with distortion, or raindrops"
        if is_from_file:
            lens = f"the lens of `camera={model.name}`"
        self._check_is_unset(unsupported_names, lens)

    def _check_coefficients(self, kind: str, names: Sequence[str]) -> None:
        """Raise InputError for a distortion coefficient that a kind of lens lacks."""
        supported_names = COEFFICIENTS_OF_KIND[kind]
        for name in names:
            if name not in supported_names:
                coefficients = ", ".join(supported_names) or "none"
                raise InputError(
                    f"`controls` {self.name}: a {kind} lens has the "
                    f"coefficients {coefficients}, not {name}"
                )

    def _check_is_unset(self, names: Sequence[str], lens: str) -> None:
        """Raise InputError if the user set one of some parameters, with this lens."""
        for name in names:
            if name in self.specs:
                raise InputError(
                    f"`controls` {self.name}: {name} is not supported "
                    f"with {lens}; leave one of them out"
                )

    def _drives_against_traffic(self, scene: SceneDescription) -> bool:
        """Return whether the camera seems to drive against the traffic in all images.

        Only three configurations are checked: all parameters at the lower bound, all at
        the center and all at the upper bound of their ranges.
        """
        control = self.bind(scene)  # a copy for this check
        configurations = (
            torch.full_like(control.start, coordinate) for coordinate in (0.0, 0.5, 1.0)
        )
        poses = [
            control.inputs(u)["camera.to_world"].detach().double().numpy()
            for u in configurations
        ]
        return all(is_against_traffic(scene, pose) for pose in poses)

    @property
    def _sets_shift(self) -> bool:
        return "shift_x" in self.specs or "shift_y" in self.specs

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter with the default and the range of the scene's own camera.

        Lengths are in metres if the size of the object is known, else in object sizes.
        """
        has_metres = self.scene.object.size_in_metres is not None
        parameter = adapt_length_unit(super().resolve_parameter(parameter), has_metres)
        default = self._find_default(parameter)
        search = self._find_search_range(parameter, default)
        return replace(parameter, default=default, search=search)

    def _find_default(self, parameter: Parameter) -> ParameterValue:
        """Return the value of a parameter in the scene, by its lens and its pose.

        Args:
            parameter: the parameter; if the scene does not determine its value, its
                own default is returned.
        """
        scene = self.scene
        name = parameter.name
        if name in COEFFICIENTS and scene.camera_model is not None:
            return scene.camera_model.intrinsic_by_name[name]
        # The camera is focused on the object. So all three are the distance of the object:
        # "sizes" in object sizes, the others in metres if the object's size is known.
        # (`size_in_metres` of the scene is 1 if it is not.)
        if name == "sizes":
            return self._find_default_distance()
        if name in ("distance", "focus"):
            return self._find_default_distance() * scene.size_in_metres
        if name == "height":
            return self._find_default_height()
        if name == "focal_length":
            half_fov = math.radians(scene.get_number("camera.fov")) / 2.0
            return SENSOR_WIDTH / 2.0 / math.tan(half_fov)
        return parameter.default

    def _find_default_height(self) -> float:
        """Return the height of the camera in the scene.

        It is in metres if the object's size is known, else in object sizes.
        """
        camera_height = float(camera_to_world(self._with_fixed_lens())[2, 3])
        return camera_height * self.scene.size_in_metres

    def _find_default_distance(self) -> float:
        """Return the camera's distance from the object's center, in object sizes.

        It depends on the field of view.
        """
        fixed_lens_scene = self._with_fixed_lens()
        camera_position = camera_to_world(fixed_lens_scene)[:3, 3]
        offset = camera_position - compute_center(fixed_lens_scene)
        return float(np.linalg.norm(offset))

    def _find_search_range(
        self, parameter: Parameter, default: ParameterValue
    ) -> tuple[float, float] | None:
        """Return the range that a parameter is searched over if the user sets none.

        If the scene has a preset, only ranges of the preset are searched. Otherwise,
        around a road vehicle, the camera's height is searched over the eye heights of
        road users, and the elevation is not searched. The declared `search` of the
        distance is a pair of factors, by which its default is multiplied; that of other
        parameters is the range itself.

        Args:
            parameter: the parameter.
            default: its value in the scene.

        Returns:
            Lower and upper bound; None if the parameter is not searched by default.
        """
        name = parameter.name
        search = parameter.search
        preset = PRESETS.get(self.scene.preset)
        if preset is not None:
            return self._find_preset_range(preset, name)
        is_around_vehicle = is_road_vehicle(self.scene.object)
        if is_around_vehicle and name == "elevation":
            return None
        if is_around_vehicle and name == "height":
            # A road vehicle has a size in metres, so the height is in metres. The range
            # is extended if the camera's default height is above it.
            return ROAD_USER_HEIGHTS[0], max(ROAD_USER_HEIGHTS[1], float(default))
        if name == "distance" and search is not None:
            return search[0] * float(default), search[1] * float(default)
        return search

    def _find_preset_range(
        self, preset: CameraPreset, name: str
    ) -> tuple[float, float] | None:
        """Return the range of a parameter by a preset; None if it is not searched."""
        if name != "azimuth":
            return preset.search_ranges.get(name)
        max_turn = preset.search_azimuth
        if max_turn >= 180.0:
            return 0.0, 360.0
        scene_azimuth = self.scene.get_number("camera.azimuth")
        return scene_azimuth - max_turn, scene_azimuth + max_turn

    def get_setting_name(self, parameter: Parameter) -> str:
        equivalent_settings = {"focal_length": "camera.fov", "sizes": "camera.distance"}
        return equivalent_settings.get(
            parameter.name, super().get_setting_name(parameter)
        )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the camera's pose, lens, focus, shift and exposure.

        With a camera model, "camera.lens" replaces the field of view and the shift.

        Args:
            values: values of the control by parameter.
            earlier_inputs: inputs of earlier controls, which are not used.
        """
        scene = self.scene
        fov = self._select_fov(values)
        distance = self._compute_distance(values, fov)
        inputs = {"camera.to_world": self._compute_pose(values, distance)}
        inputs |= self._compute_lens_inputs(values, fov)
        if scene.thin_lens and self._sets_thin_lens:
            inputs |= self._compute_thin_lens_inputs(values, distance)
        if scene.camera_model is None and self._sets_shift:
            inputs["camera.shift"] = torch.stack([values["shift_x"], values["shift_y"]])
        if "exposure" in self.specs:
            # The renderer applies the scene's own exposure already.
            scene_exposure = scene.get_number("camera.exposure")
            inputs["camera.exposure"] = values["exposure"] - scene_exposure
        return inputs

    def _select_fov(self, values: Values) -> Tensor:
        """Return the field of view () in degrees, that of the focal length if it is set."""
        if "focal_length" in self.specs:
            return _compute_fov(values["focal_length"])
        return values["fov"]

    def _compute_lens_inputs(self, values: Values, fov: Tensor) -> dict[str, Tensor]:
        """Return the numbers of the camera model, or without one the field of view."""
        model = self.scene.camera_model
        if model is None:
            return {"camera.fov": fov.reshape(1)}
        return {"camera.lens": self._compute_model_numbers(model, values, fov)}

    def _compute_thin_lens_inputs(
        self, values: Values, distance: Tensor
    ) -> dict[str, Tensor]:
        """Return aperture and focus (1,), both in object sizes.

        Without a stated focus, it is the distance () of the object.
        """
        # A thin lens needs a positive aperture.
        aperture = values["aperture"].clamp_min(1e-5).reshape(1)
        focus = distance
        if "focus" in self.specs:  # in metres
            focus = values["focus"] / self.scene.size_in_metres
        return {"camera.aperture": aperture, "camera.focus": focus.reshape(1)}

    def _compute_model_numbers(
        self, model: CameraModel, values: Values, fov: Tensor
    ) -> Tensor:
        """Return the numbers (17,) of the camera model, in the order of `NUMBER_NAMES`.

        Distortion coefficients that were set replace those of the model.

        Args:
            model: lens from a camera file; or a model with an empty name, which is a
                pinhole whose focal lengths follow from the field of view.
            values: values of the control by parameter.
            fov: () field of view along the longer side of the image, degrees.
        """
        model_values = {
            name: torch.tensor(value) for name, value in model.intrinsic_by_name.items()
        }
        is_pinhole = model.name == ""
        if is_pinhole:
            model_values |= self._compute_focal_lengths(fov)
        coefficients_set_by_user = [name for name in COEFFICIENTS if name in self.specs]
        model_values |= {name: values[name] for name in coefficients_set_by_user}
        model_values |= {
            "cx": model_values["cx"] + values["shift_x"],
            "cy": model_values["cy"] + values["shift_y"],
        }
        return torch.stack([model_values[name].to(fov) for name in NUMBER_NAMES])

    def _compute_focal_lengths(self, fov: Tensor) -> dict[str, Tensor]:
        """Return the focal lengths () "fx" and "fy" of a pinhole by its field of view.

        They are in widths and in heights of the image.
        """
        aspect = self.scene.aspect  # width over height
        # in lengths of the longer side, which the field of view is along
        focal = 0.5 / torch.tan(torch.deg2rad(fov) / 2.0)
        longer_side_in_widths = max(1.0, 1.0 / aspect)
        longer_side_in_heights = max(1.0, aspect)
        return {
            "fx": focal * longer_side_in_widths,
            "fy": focal * longer_side_in_heights,
        }

    def _with_fixed_lens(self) -> SceneDescription:
        """Return the scene with the field of view of this control, if it is fixed.

        The default distance of the camera depends on the field of view, because the
        object fills the image. So it has to be computed with this one.
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

    def _compute_distance(self, values: Values, fov: Tensor) -> Tensor:
        """Return the camera's distance () from the object's center, in object sizes.

        It is the value of `sizes` if the user sets that. Else it is the value of
        `distance` if the user or the scene sets that, or if it is searched by default.
        Otherwise it is the distance at which the object fills the image.

        Args:
            values: values of the control by parameter.
            fov: () field of view, degrees.
        """
        scene = self.scene
        if "sizes" in self.specs:
            return values["sizes"]
        scene_has_distance = scene.values.get("camera.distance") is not None
        # Default ranges are searched only if the user requests no range.
        searches_default_ranges = not self.has_requested_range
        if "distance" in self.specs or searches_default_ranges or scene_has_distance:
            # from metres to object sizes
            return values["distance"] / scene.size_in_metres
        return compute_framing_distance(scene, fov, scene.aspect).float()

    def _compute_elevation(self, values: Values, distance: Tensor) -> Tensor:
        """Return the elevation () of the camera over the object's center, radians.

        It is the value of `elevation`, or follows from the `height`.

        Args:
            values: values of the control by parameter.
            distance: () distance from the object's center, object sizes.
        """
        if not self._uses_height():
            return torch.deg2rad(values["elevation"])
        center_height = float(compute_center(self.scene)[2])
        height_over_center = (
            values["height"] / self.scene.size_in_metres - center_height
        )
        sine = height_over_center / distance
        return torch.asin(sine.clamp(-MAX_ELEVATION_SINE, MAX_ELEVATION_SINE))

    def _uses_height(self) -> bool:
        """Return whether the camera's height, not its elevation, determines its pose.

        A setting of the user decides. Without one, the height is used if the scene
        states it, or if it is searched by default.
        """
        if "height" in self.specs:
            return True
        if "elevation" in self.specs:
            return False
        if self.scene.values.get("camera.height") is not None:
            return True
        return any(
            slot.n_coordinates > 0
            for slot in self.parameter_slots
            if slot.parameter.name == "height"
        )

    def _compute_pose(self, values: Values, distance: Tensor) -> Tensor:
        """Return the pose (4, 4) on the orbit, at a distance () in object sizes.

        The columns of its rotation are the camera's left, up and forward directions.
        """
        azimuth = torch.deg2rad(self.scene.azimuth_zero + values["azimuth"])
        elevation = self._compute_elevation(values, distance)
        roll = torch.deg2rad(values["roll"])
        outwards = _compute_orbit_direction(azimuth, elevation)
        level_left, level_up = _compute_level_axes(azimuth, outwards)
        # A positive roll turns the camera clockwise, as seen from behind it: its left
        # axis turns towards up, and its up axis towards the right.
        left = roll.cos() * level_left + roll.sin() * level_up
        up = roll.cos() * level_up - roll.sin() * level_left
        forward = -outwards
        center = torch.from_numpy(compute_center(self.scene)).to(distance)
        position = center + distance * outwards
        return make_affine(torch.stack([left, up, forward], dim=1), position)


def _compute_level_axes(azimuth: Tensor, outwards: Tensor) -> tuple[Tensor, Tensor]:
    """Return the axes left and up (3,) of a camera on the orbit that has no roll.

    Left is level, and up is at right angles to left and to the direction of view. E.g.
    at azimuth 0 the camera is at +x and looks along -x, so that -y is on its left.

    Args:
        azimuth: () angle of the camera around the object, radians.
        outwards: (3,) unit direction from the object's center to the camera.
    """
    zero = torch.zeros_like(azimuth)
    level_left = torch.stack([azimuth.sin(), -azimuth.cos(), zero])
    level_up = torch.linalg.cross(-outwards, level_left)
    return level_left, level_up


def _compute_orbit_direction(azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Return the direction (3,) from the object's center to the camera.

    Both angles () are in radians.
    """
    return torch.stack(
        [
            elevation.cos() * azimuth.cos(),
            elevation.cos() * azimuth.sin(),
            elevation.sin(),
        ]
    )


def adapt_length_unit(parameter: Parameter, has_metres: bool) -> Parameter:
    """Return a parameter whose unit of length fits the scene.

    Without a size of the object in metres, lengths are in object sizes.
    """
    if parameter.unit == "metres" and not has_metres:
        return replace(parameter, unit="object sizes")
    return parameter


def _compute_fov(focal_length: Tensor) -> Tensor:
    """Return the field of view, degrees, of a lens of a focal length in millimetres."""
    return torch.rad2deg(2.0 * torch.atan(SENSOR_WIDTH / 2.0 / focal_length))
