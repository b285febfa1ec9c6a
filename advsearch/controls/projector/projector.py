"""The `projector` control: an image that is projected onto the object.

Its texels can be searched. It only adds light. A white image of a projector of `lumens`,
which is w wide and h high at distance 1, has the illuminance `lumens / (w h D^2)` lux at
a distance of D metres. Its brightness in the scene is relative to the ambient light: the
camera's exposure is metered for an irradiance of `ambient` lux. So with more ambient
light the projector is darker in an equally bright image, as for a camera with automatic
exposure.

    pattern = linear(texels) (1 - black) + black
    E(D) = E(ambient) lumens / (w h D^2 ambient) pattern
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from advsearch.extend import (
    Choice,
    Fixed,
    InputError,
    Parameter,
    PictureControl,
    Range,
    SceneDescription,
    Value,
    Values,
    color,
    geometry,
    images,
    parts,
)

if TYPE_CHECKING:
    from typing_extensions import Self

# default angle around the object between camera and projector, degrees
DEFAULT_CAMERA_ANGLE = 15.0
# ambient light of an environment without a unit, lux: a lit hall, a street at late dusk
DEFAULT_AMBIENT_LUX = 100.0
DEFAULT_LUMENS = 3000.0
MAX_AMBIENT_FACTOR = 20.0
"""Limit of the default light of a projector, as a multiple of the ambient light."""
MAX_DEFAULT_FOV = 150.0  # degrees
START_GREY = 0.5
DUTY_CYCLE = 0.5  # fraction of a period in which a flashing light is on


_lit = partial(Parameter.number, Parameter.LIT)
_moving = partial(Parameter.moving, ("differences",))


class ProjectorControl(PictureControl):
    """A picture that a projector throws onto the object.

    Its texels are searched, and those numbers for which the user sets a range.

    Attributes:
        projector_part: projector in the scene. Set by `bind_parameters`.
    """

    projector_part: parts.ProjectorPart
    _time_shift = 0.0  # seconds by which `advance_time` has moved the time
    kind = "projector"
    competes_with_ambient = True
    image_parameter = "pattern"
    default_epsilon = 1.0  # the ball has all images
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "pattern",
            (None, None, 3),
            "sRGB",
            0.0,
            1.0,
            "black, or grey",
            "Display-referred texels of the picture, rounded to 8 bits.",
            search=(0.0, 1.0),
            estimators=("adjoint",),
        ),
        _moving(
            "azimuth",
            "degrees",
            -3600.0,
            3600.0,
            f"{DEFAULT_CAMERA_ANGLE:g} from the camera",
            "Direction of the projector around the object.",
            periodic=True,
        ),
        _moving(
            "elevation",
            "degrees",
            -89.0,
            89.0,
            "the camera's",
            "Height of the projector above the ground plane.",
        ),
        _moving(
            "distance",
            "object sizes",
            0.01,
            1e4,
            "the camera's",
            "Distance to the object's centre; in metres if the object's size is known.",
            log=True,
        ),
        _lit(
            "lumens",
            "lumens",
            0.0,
            1e6,
            f"{DEFAULT_LUMENS:g}, or less: {MAX_AMBIENT_FACTOR:g} times as bright as "
            "the ambient light",
            "Light of a white picture.",
        ),
        _lit(
            "ambient",
            "lux",
            1e-3,
            2e5,
            f"that of the environment, or {DEFAULT_AMBIENT_LUX:g}",
            "Light on the object without the projector.",
            log=True,
        ),
        _lit(
            "black",
            "1",
            0.0,
            1.0,
            0.0,
            "Light of a black texel, as a fraction of white: 0.001 for a contrast of "
            "1000.",
        ),
        _lit(
            "blur",
            "texels",
            0.0,
            64.0,
            0.0,
            "Standard deviation of the blur, if the projector is out of focus.",
        ),
        Parameter.number(
            ("differences",),
            "flicker",
            "Hz",
            0.0,
            1e5,
            0.0,
            "Flashes per second, with light in one half of each period; 0 is a "
            "constant light.",
        ),
        Parameter.number(
            ("differences",),
            "phase",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Phase of a flashing light at the time of the picture; up to 180 degrees "
            "it is on.",
            periodic=True,
        ),
    )
    choices: ClassVar[tuple[Choice, ...]] = (
        Choice("resolution", 64, "Rows of texels.", integer_bounds=(2, 512)),
        Choice("aspect", 1.0, "Width of the picture over its height.", max_value=4.0),
        Choice(
            "fov",
            None,
            "Angle of the picture's width, degrees; by default the picture just "
            "covers the object.",
            max_value=150.0,
        ),
        Choice(
            "start",
            "black",
            "Picture at the start of the search: black or grey.",
            options=("black", "grey"),
        ),
        Choice(
            "norm",
            "linf",
            "Norm of the ball around that start: linf (per texel "
            "value) or l2 (over all of them).",
            "norm",
            options=("linf", "l2"),
        ),
        Choice(
            "epsilon",
            None,
            "Radius of that ball, display-referred; by default the ball has all "
            "pictures.",
            "epsilon",
            max_value=PictureControl.MAX_EPSILON,
        ),
        Choice(
            "picture",
            None,
            "A picture file to project; the pattern is not searched then.",
            fixes="pattern",
        ),
    )

    def check_choices(self) -> None:
        """Check that the choices of pattern, picture and norm ball fit each other.

        Raises:
            InputError: a picture is set together with a choice for searched texels, or
                the pattern has another range than its full one.
        """
        self._check_pattern()
        picture = self.choice_values["picture"]
        if picture is None:
            return
        if not isinstance(picture, (str, Path)):
            raise InputError(
                f"{self.name}.picture: expected the path of a picture, got {picture!r}"
            )
        # as a string, since settings are stored as JSON
        self._settings["picture"] = str(picture)
        self.choice_values["picture"] = str(picture)
        self._check_fits_picture()

    def _check_fits_picture(self) -> None:
        """Raise InputError if a choice for searched texels is set besides a picture."""
        conflicting = [
            setting
            for setting in ("pattern", "epsilon", "norm", "resolution", "aspect")
            if setting in self._settings
        ]
        if conflicting:
            raise InputError(
                f"{self.name}.{conflicting[0]}: expected none together with "
                f"{self.name}.picture; "
                "leave one of them out"
            )

    def _check_pattern(self) -> None:
        """Check that the pattern, if it is set, is fixed at 0 or has its full range.

        Smaller changes are requested by `epsilon`, not by a narrower range.

        Raises:
            InputError: it has another value or range.
        """
        pattern = self._settings.get("pattern")
        if isinstance(pattern, (list, tuple)):
            is_valid = [*pattern] == [0.0, 1.0]
        else:
            is_missing = pattern is None
            is_fixed_black = not is_missing and not pattern  # a 0
            is_valid = is_missing or is_fixed_black
        if not is_valid:
            raise InputError(
                f"{self.name}.pattern: expected no value but [0, 1], got {pattern!r}; "
                f"set a file with {self.name}.picture, "
                f"and how far texels may go with {self.name}.epsilon"
            )

    # ---- in a scene

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with the projector.

        By default its field of view is as wide as the object seen from the projector at
        the start, at most `MAX_DEFAULT_FOV`. A remark is added if the scene's
        brightness has no unit, as lumens can't be compared with it then.
        """
        rows, columns = self._find_sides()
        fov = self.choice_values["fov"]
        if fov is None:
            fov = self._compute_covering_fov(scene, aspect=columns / rows)
        part = parts.ProjectorPart(self.name, float(fov), (rows, columns))
        scene = replace(scene, remarks=(*scene.remarks, *self._list_unit_notes(scene)))
        return scene.with_part(part)

    def _list_unit_notes(self, scene: SceneDescription) -> list[str]:
        """List the note that the brightness of a scene's environment has no unit."""
        # With candelas per unit of radiance, light in the scene can be converted to lux.
        has_unit = (
            scene.environment is not None and scene.environment.candelas is not None
        )
        if has_unit or "ambient" in self.specs:
            return []
        return [
            "The environment's brightness has no unit: its light is taken as "
            f"{DEFAULT_AMBIENT_LUX:g} lux, unless {self.name}.ambient is set."
        ]

    def _find_sides(self) -> tuple[int, int]:
        """Return the rows and columns of texels of the projected image."""
        picture = self.read_picture()
        if picture is not None:
            rows, columns = picture.shape[:2]
            return rows, columns
        rows = int(self.choice_values["resolution"])
        # An image has at least two texels along each side.
        columns = max(2, round(rows * self.choice_values["aspect"]))
        return rows, columns

    def _compute_covering_fov(self, scene: SceneDescription, aspect: float) -> float:
        """Return the angle of the image's width at which it just covers the object.

        It is at most `MAX_DEFAULT_FOV` degrees.

        Args:
            scene: scene with the object.
            aspect: width of the image over its height.
        """
        offsets = scene.base_vertices - geometry.compute_center(scene)
        object_radius = float(np.linalg.norm(offsets, axis=1).max())
        # The shorter side of the image has to cover the object. In a wide image that is
        # the height, and the width is larger by the aspect.
        half_width = object_radius * max(1.0, aspect) * scene.size_in_metres
        distance = self.with_scene(scene)._start_distance()  # in metres
        covering_fov = math.degrees(2.0 * math.atan(half_width / distance))
        return min(covering_fov, MAX_DEFAULT_FOV)

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter with its default in this scene.

        By default the projector has the distance and the elevation of the scene's
        camera, and another azimuth, by `DEFAULT_CAMERA_ANGLE`.
        """
        parameter = super().resolve_parameter(parameter)
        match parameter.name:
            case "pattern":
                grey = START_GREY if self.choice_values["start"] == "grey" else 0.0
                return replace(parameter, default=grey)
            case "ambient":
                return replace(parameter, default=self._compute_ambient_lux())
            case "lumens":
                lumens = min(DEFAULT_LUMENS, self._compute_max_lumens())
                return replace(parameter, default=lumens)
            case "azimuth" | "elevation" | "distance":
                return self._resolve_position(parameter)
        return parameter

    def _resolve_position(self, parameter: Parameter) -> Parameter:
        """Return a parameter of the position with its default, near the camera."""
        scene = self.scene
        camera_position = geometry.camera_to_world(scene)[:3, 3]
        camera_offset = camera_position - geometry.compute_center(scene)
        camera_distance = float(np.linalg.norm(camera_offset))
        x, y, z = camera_offset
        if parameter.name == "azimuth":
            azimuth = math.degrees(math.atan2(y, x))
            return replace(parameter, default=azimuth + DEFAULT_CAMERA_ANGLE)
        if parameter.name == "elevation":
            elevation = math.degrees(math.asin(z / camera_distance))
            # within the bounds of the parameter
            return replace(parameter, default=min(max(elevation, -89.0), 89.0))
        has_metres = scene.object.size_in_metres is not None
        return replace(
            parameter,
            default=camera_distance * scene.size_in_metres,
            unit="metres" if has_metres else "object sizes",
        )

    def _compute_ambient_lux(self) -> float:
        """Return the illuminance by the environment, lux.

        It is `DEFAULT_AMBIENT_LUX` if the environment's radiance has no unit.
        """
        environment = self.scene.environment
        if environment is None or environment.candelas is None:
            return DEFAULT_AMBIENT_LUX
        # `candelas` are those per square metre for a radiance of 1
        lux = environment.candelas * self.scene.metered_irradiance
        return min(max(lux, 1e-3), 2e5)  # the parameter's range

    def _compute_max_lumens(self) -> float:
        """Return the lumens at which white is `MAX_AMBIENT_FACTOR` times the ambient light.

        Lumens are lux times the area of the image, which grows with the squared
        distance; `self.projector_part.area` is the area at a distance of 1.
        """
        ambient_lux = float(self.get_clean_value("ambient"))
        return (
            MAX_AMBIENT_FACTOR
            * ambient_lux
            * self.projector_part.area
            * self._start_distance() ** 2
        )

    @property
    def image_shape(self) -> tuple[int, int]:
        return self.projector_part.sides

    def _start_distance(self) -> float:
        """Return the projector's distance at the start, in the parameter's unit."""
        spec = self.specs.get("distance")
        if isinstance(spec, Fixed):
            return float(spec.value)
        return float(self.get_clean_value("distance"))

    def bind_parameters(self) -> None:
        """Find the projector's part of the scene, and its largest flash rate.

        The rate, `flashes`, is the upper bound of the parameter "flicker".
        """
        (self.projector_part,) = (
            part
            for part in self.scene.parts
            if isinstance(part, parts.ProjectorPart) and part.name == self.name
        )
        self._picture = self.read_picture()
        super().bind_parameters()
        self.flashes = self._find_max_flicker()

    def _find_max_flicker(self) -> float:
        """Return the largest number of flashes per second."""
        flicker = next(
            slot.parameter_spec
            for slot in self.parameter_slots
            if slot.parameter.name == "flicker"
        )
        if isinstance(flicker, Range):
            return flicker.high
        # 0 Hz if the user did not set it
        rates = self.list_allowed_values("flicker", 0.0)
        return max(map(float, rates))

    def read_picture(self) -> Tensor | None:
        """Return the image (h, w, 3) sRGB of the `picture` file, or None.

        Raises:
            InputError: a side has only one texel.
        """
        picture = super().read_picture()
        if picture is not None and min(picture.shape[:2]) < 2:
            got = f"{picture.shape[1]} x {picture.shape[0]}"
            raise InputError(
                f"{self.name}.picture: expected at least 2 texels a side, got {got}"
            )
        return picture

    @property
    def ambient_lux(self) -> float | None:
        slot = next(
            slot for slot in self.parameter_slots if slot.parameter.name == "ambient"
        )
        return (
            float(slot.parameter_spec.value)
            if isinstance(slot.parameter_spec, Fixed)
            else None
        )

    def scale_ambient(self, factor: float) -> Self:
        if self.ambient_lux is None:
            return self
        scaled = copy.copy(self)
        scaled.specs = {**self.specs, "ambient": Fixed(factor * self.ambient_lux)}
        scaled.bind_parameters()
        return scaled

    def advance_time(self, seconds: float) -> Self:
        shifted = copy.copy(self)
        shifted._time_shift = self._time_shift + seconds
        return shifted

    # ---- at a configuration

    def compute_values(self, u: Tensor) -> dict[str, Tensor]:
        """Return the values by parameter; the pattern is rounded to 8 bits, with the
        derivative of the identity.
        """
        values = super().compute_values(u)
        pattern = values["pattern"]
        # the rounding is added as a constant, which has no derivative
        rounded = pattern + (images.round_to_8_bit(pattern.detach()) - pattern.detach())
        return values | {"pattern": rounded}

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the projector's pose and the light of its texels.

        The light is 0 while a flickering projector is off. It is in the scene's unit of
        radiance, at a distance of one scene unit from the projector.
        """
        pose = self._compute_pose_from_values(values)
        light = self.compute_projected_image(values)
        if self._flashes_off(values):
            light = 0.0 * light  # still depends on the pattern, for its derivative
        white = self._compute_white_radiance(values)
        return {f"{self.name}.pose": pose, f"{self.name}.pattern": light * white}

    def _compute_pose_from_values(self, values: Values) -> Tensor:
        """Return the pose (4, 4) of the projector, a copy without derivatives."""
        pose = make_projector_pose(
            self.scene,
            float(values["azimuth"].detach()),
            float(values["elevation"].detach()),
            float(values["distance"].detach()),
        )
        return pose.to(values["distance"], copy=True)

    def _compute_white_radiance(self, values: Values) -> Tensor:
        """Return the radiance () of a white texel, in the scene's unit.

        The projector's input is the radiance of a white diffuse screen at a distance of
        one scene unit, which is the irradiance over pi.
        """
        distance_in_units = values["distance"].detach() / self.scene.size_in_metres
        # The irradiance of a white texel at a distance of one scene unit. It is that at the
        # object (the ratio to the ambient light times `metered_irradiance`) times the
        # squared distance.
        white_irradiance = (
            self._compute_ambient_ratio(values)
            * distance_in_units**2
            * self.scene.metered_irradiance
        )
        return white_irradiance / math.pi

    def _flashes_off(self, values: Values) -> bool:
        """Return whether the light is off at this moment of its flicker."""
        rate = float(values["flicker"].detach())
        phase = float(values["phase"].detach()) / 360.0
        # from 0 at the beginning of a flash to 1 at the beginning of the next one
        cycle_position = (rate * self._time_shift + phase) % 1.0
        return rate != 0.0 and cycle_position >= DUTY_CYCLE

    def compute_projected_image(self, values: Values) -> Tensor:
        """Return the projected image (h, w, 3), linear, as fractions of white.

        Black texels have the light of `black`, and the image is blurred.
        """
        pattern = color.srgb_to_linear(values["pattern"])
        light = pattern * (1.0 - values["black"]) + values["black"]
        return blur_light(light, values["blur"])

    def _compute_white_lux(self, values: Values) -> Tensor:
        """Return the illuminance () of a white image at the object's center, lux."""
        return values["lumens"] / (
            self.projector_part.area * values["distance"].detach() ** 2
        )

    def _compute_ambient_ratio(self, values: Values) -> Tensor:
        """Return the illuminance () of a white image at the object's center, as a
        multiple of the ambient light.
        """
        return self._compute_white_lux(values) / values["ambient"]

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return the brightness of a white image at the object, and the pattern's mean.

        The brightness is in lux, and relative to the ambient light; the mean is a
        fraction of white.
        """
        white_lux = float(self._compute_white_lux(values))
        ratio = float(self._compute_ambient_ratio(values))
        mean = float(color.srgb_to_linear(values["pattern"]).mean())
        return {
            "white": Value(value=white_lux, unit="lux"),
            "beside_ambient": Value(value=ratio, unit="times the ambient light"),
            "mean": Value(value=mean, unit="of white"),
        }

    def make_artifact_images(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the pattern, and the pattern enlarged for printing."""
        pattern = values["pattern"]
        print_scale = math.ceil(images.MIN_PRINT_SIDE / len(pattern))
        return {
            self.name: pattern,
            f"{self.name}-large": images.enlarge(pattern, print_scale),
        }


def blur_light(light: Tensor, blur: Tensor) -> Tensor:
    """Return an image (h, w, 3) after a Gaussian blur, black outside of its edges.

    Args:
        light: (h, w, 3) linear light.
        blur: () standard deviation in texels. The result is differentiable in both.
    """
    sigma = float(blur.detach())
    if not sigma and not blur.requires_grad:
        return light
    radius = math.ceil(3.0 * sigma) + 1
    kernel = _make_blur_kernel(radius, blur)
    blurred_rows = functional.conv2d(
        images.to_planes(light), kernel, padding=(0, radius), groups=3
    )
    blurred = functional.conv2d(
        blurred_rows, kernel.transpose(2, 3), padding=(radius, 0), groups=3
    )
    return images.to_image(blurred)


def _make_blur_kernel(radius: int, blur: Tensor) -> Tensor:
    """Return a Gaussian kernel (3, 1, 1, 2 radius + 1) for three channels.

    `blur` () is its standard deviation in texels.
    """
    offsets = torch.arange(-radius, radius + 1).to(blur)
    # at least 0.1 texels, which is invisible: the derivative is undefined at 0
    kernel = torch.exp(-0.5 * (offsets / blur.clamp_min(0.1)) ** 2)
    return (kernel / kernel.sum()).expand(3, 1, 1, -1)


@geometry.cache_per_scene
def make_projector_pose(
    scene: SceneDescription, azimuth: float, elevation: float, distance: float
) -> Tensor:
    """Return a pose (4, 4) that looks at the object's center along its own +z axis.

    The result is cached: do not write into it.

    Args:
        scene: scene with the object.
        azimuth: degrees around the object's center.
        elevation: degrees over the object's center.
        distance: metres from the object's center; object sizes if it has no size.
    """
    # axes of a camera there, as rows; `outwards` is from the object to the projector
    left, up, outwards = torch.from_numpy(
        geometry.compute_camera_axes(azimuth, elevation, 0.0)
    ).float()
    position = (
        torch.from_numpy(geometry.compute_center(scene)).float()
        + distance / scene.size_in_metres * outwards
    )
    return geometry.make_affine(torch.stack([left, up, -outwards], dim=1), position)
