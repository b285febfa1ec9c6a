"""The parameters that every scene has: `--set` fixes them, and the control of the same
family searches them.

A control takes its declarations from here (`POSE`, `CAMERA`, ...) and adds those that
only it knows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, TypeGuard

from advsearch.errors import InputError, UnknownNameError

CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class Parameter:
    """One coordinate of a search: a named, bounded number, tensor or choice.

    Settings of a scene and parameters of controls are both this, so that what `--set`
    fixes today a control can search tomorrow under the same name.
    """

    name: str  # short; `control.name` addresses it everywhere
    # Shape of its value; () for a number, None where it depends on the scene or a
    # choice.
    shape: tuple[int | None, ...]
    # "degrees", "metres", "object sizes", "sRGB", "stops", "name", ..., or "1"
    unit: str
    low: float  # smallest allowed value (0 for a choice among names)
    high: float  # largest allowed value (number of names - 1 for a choice among names)
    # the value that leaves the scene as it is, in words if it depends on the scene
    default: float | str
    description: str  # one sentence
    # the value and the value plus 360 degrees (`high - low` of a full turn) are the
    # same
    periodic: bool = False
    # it can move an outline in the picture, so interior adjoints miss a term
    moves_silhouettes: bool = False
    # range that is searched by default; None: it stays at its default
    search: tuple[float, float] | None = None
    # the unit interval runs over the logarithm of the value (scales, powers, distances)
    log: bool = False
    # the names of a discrete choice, which has no derivative; empty for numbers
    options: tuple[str, ...] = ()
    # valid ways to differentiate it, preferred first
    estimators: tuple[str, ...] = ("differences",)

    # no quantity of a scene is larger; the square of one that is has no float32
    MAX_VALUE: ClassVar[float] = 1e30
    GEOMETRIC: ClassVar[tuple[str, ...]] = ("secant", "differences", "material")
    """Valid estimators for what moves a mesh."""
    ORBIT: ClassVar[tuple[str, ...]] = ("secant", "differences")
    """Of a camera, which is differentiated by differences: Mitsuba has no derivative of
    sensors.
    """
    LIT: ClassVar[tuple[str, ...]] = ("adjoint", "differences")
    """Of what changes only light and colors."""

    @staticmethod
    def is_number(value: object) -> TypeGuard[float]:
        """Return whether a value is a number that float32 has.

        It is an int or a float from -`MAX_VALUE` to `MAX_VALUE`. Booleans and NaN, for
        which the comparison is false, are none.
        """
        is_real = isinstance(value, (int, float)) and not isinstance(value, bool)
        return is_real and abs(value) <= Parameter.MAX_VALUE  # type: ignore[arg-type]

    @classmethod
    def number(
        cls,
        estimators: tuple[str, ...],
        name: str,
        unit: str,
        low: float,
        high: float,
        default: float | str,
        text: str,
        search: tuple[float, float] | None = None,
        *,
        periodic: bool = False,
        log: bool = False,
    ) -> Parameter:
        """Make a parameter that is one number and moves no outlines in the image.

        `Parameter.moving` makes one that does.

        Args:
            estimators: valid estimators of its derivative, the preferred one first.
            name: name without the control's, such as "roughness".
            unit: unit, such as "degrees"; "1" for none.
            low: smallest value.
            high: largest value.
            default: default value; a text says how the scene computes it.
            text: description for the user.
            search: range that is searched by default; None: the value stays at its
                default.
            periodic: whether `high` is the same as `low`, as for an angle.
            log: whether a search takes even steps of the logarithm.
        """
        return cls(
            name=name,
            shape=(),
            unit=unit,
            low=low,
            high=high,
            default=default,
            description=text,
            periodic=periodic,
            moves_silhouettes=False,
            search=search,
            log=log,
            estimators=estimators,
        )

    @classmethod
    def moving(
        cls,
        estimators: tuple[str, ...],
        name: str,
        unit: str,
        low: float,
        high: float,
        default: float | str,
        text: str,
        search: tuple[float, float] | None = None,
        *,
        periodic: bool = False,
        log: bool = False,
    ) -> Parameter:
        """Make a parameter that is one number and can move an outline in the image.

        Args:
            estimators: valid estimators of its derivative, the preferred one first.
            name: name without the control's, such as "yaw".
            unit: unit, such as "degrees"; "1" for none.
            low: smallest value.
            high: largest value.
            default: default value; a text says how the scene computes it.
            text: description for the user.
            search: range that is searched by default; None: the value stays at its
                default.
            periodic: whether `high` is the same as `low`, as for an angle.
            log: whether a search takes even steps of the logarithm.
        """
        still = cls.number(
            estimators,
            name,
            unit,
            low,
            high,
            default,
            text,
            search,
            periodic=periodic,
            log=log,
        )
        return replace(still, moves_silhouettes=True)

    @classmethod
    def named(
        cls,
        name: str,
        options: tuple[str, ...],
        default: str,
        text: str,
        *,
        estimators: tuple[str, ...] = (),
        moves_silhouettes: bool = False,
    ) -> Parameter:
        """Make a parameter that is a choice among names.

        Its value is the index of an option.

        Args:
            name: name without the control's, such as "kind".
            options: names to choose from.
            default: what the scene has without a choice, in words. It may be one of the
                options, such as "off", or a description, such as "the file's own".
            text: description for the user.
            estimators: valid estimators of the derivative, the preferred one first. By
                default there is none: a choice has no derivative.
            moves_silhouettes: whether it can move an outline in the image.
        """
        return cls(
            name=name,
            shape=(),
            unit="name",
            low=0.0,  # the value is an index of `options`
            high=len(options) - 1.0,
            default=default,
            description=text,
            periodic=False,
            moves_silhouettes=moves_silhouettes,
            options=options,
            estimators=estimators,
        )

    @classmethod
    def colors(
        cls,
        text: str,
        search: tuple[float, float] | None = None,
        *,
        low: float = 0.0,
        defaults: tuple[float, float, float] = (1.0, 1.0, 1.0),
        estimators: tuple[str, ...] = LIT,
    ) -> tuple[Parameter, ...]:
        """Make the three parameters of a color, display-referred sRGB.

        Args:
            text: description for the user, to which "Red", "Green" or "Blue" is the
                beginning: "of the ground" becomes "Red of the ground".
            search: range that a search covers if the user names none. None: the color
                is not searched unless the user gives a range.
            low: smallest value of each channel; the largest is 1.
            defaults: default values of red, green and blue.
            estimators: valid estimators of the derivative, the preferred one first.
        """
        return tuple(
            cls(
                name=name,
                shape=(),
                unit="sRGB",
                low=low,
                high=1.0,
                default=default,
                description=f"{name.capitalize()} {text}",
                search=search,
                estimators=estimators,
            )
            for name, default in zip(CHANNELS, defaults, strict=True)
        )


def _make_surface_parameter(
    name: str, text: str, search: tuple[float, float]
) -> Parameter:
    """Return a parameter of the principled surface, a number from 0 to 1.

    Args:
        name: name of Mitsuba's parameter, such as "roughness".
        text: description for the user.
        search: range that is searched by default.
    """
    return Parameter(
        name=name,
        shape=(),
        unit="1",
        low=0.0,
        high=1.0,
        default="the material's own",
        description=text,
        search=search,
        estimators=Parameter.LIT,
    )


_make_pose_parameter = partial(Parameter.moving, Parameter.GEOMETRIC)
_make_camera_parameter = partial(Parameter.moving, Parameter.ORBIT)

POSE = (
    _make_pose_parameter(
        "yaw",
        unit="degrees",
        low=-3600.0,
        high=3600.0,
        default=0.0,
        text="Rotation about the vertical.",
        search=(0.0, 360.0),
        periodic=True,
    ),
    _make_pose_parameter(
        "pitch",
        unit="degrees",
        low=-360.0,
        high=360.0,
        default=0.0,
        text="Rotation about the object's y axis.",
        search=(-15.0, 15.0),
        periodic=True,
    ),
    _make_pose_parameter(
        "roll",
        unit="degrees",
        low=-360.0,
        high=360.0,
        default=0.0,
        text="Rotation about the object's x axis.",
        search=(-15.0, 15.0),
        periodic=True,
    ),
    _make_pose_parameter(
        "x",
        unit="object sizes",
        low=-1e4,
        high=1e4,
        default=0.0,
        text="Shift of the object along x.",
        search=(-0.15, 0.15),
    ),
    _make_pose_parameter(
        "y",
        unit="object sizes",
        low=-1e4,
        high=1e4,
        default=0.0,
        text="Shift of the object along y.",
        search=(-0.15, 0.15),
    ),
    _make_pose_parameter(
        "z",
        unit="object sizes",
        low=-1e4,
        high=1e4,
        default=0.0,
        text="Height of the lowest point above the ground.",
    ),
    _make_pose_parameter(
        "scale",
        unit="1",
        low=0.01,
        high=100.0,
        default=1.0,
        text="Size relative to the default.",
        search=(0.8, 1.25),
        log=True,
    ),
)
# the camera that the settings `camera.*` describe: on a sphere around the object,
# looking at it
ORBIT_CAMERA = "orbit"

CAMERA = (
    _make_camera_parameter(
        "azimuth",
        unit="degrees",
        low=-3600.0,
        high=3600.0,
        default=40.0,
        text="Direction of the camera around the object.",
        search=(0.0, 360.0),
        periodic=True,
    ),
    _make_camera_parameter(
        "elevation",
        unit="degrees",
        low=-89.0,
        high=89.0,
        default=25.0,
        text="Height of the camera above the ground plane.",
        search=(5.0, 60.0),
    ),
    _make_camera_parameter(
        "roll",
        unit="degrees",
        low=-360.0,
        high=360.0,
        default=0.0,
        text="Rotation of the picture, counter-clockwise.",
        search=(-15.0, 15.0),
        periodic=True,
    ),
    _make_camera_parameter(
        "distance",
        unit="metres",
        low=1e-4,
        high=1e5,
        default="fits the object",
        text="Distance to the object's middle; in object sizes where its size in "
        "metres is not known.",
        search=(0.8, 1.5),
        log=True,
    ),
    _make_camera_parameter(
        "height",
        unit="metres",
        low=-1e4,
        high=1e5,
        default="as the elevation says",
        text="Height of the lens above the ground, in place of `elevation`; in object "
        "sizes as `distance`.",
    ),
    _make_camera_parameter(
        "fov",
        unit="degrees",
        low=1.0,
        high=170.0,
        default=35.0,
        text="Field of view along the larger side of the picture.",
    ),
    Parameter(
        "exposure",
        shape=(),
        unit="stops",
        low=-10.0,
        high=10.0,
        default=0.0,
        description="Brightness over the metered exposure.",
        estimators=("image",),
    ),
)
EXPOSURE_VALUE = Parameter(
    "ev",
    shape=(),
    unit="EV at ISO 100",
    low=-10.0,
    high=24.0,
    default="metered",
    description="Absolute exposure in place of the metered one, in the avenue: 14 is "
    "for sun, 5 for lit streets.",
    estimators=(),
)
RAINDROPS = (
    Parameter(
        "drops",
        shape=(),
        unit="1",
        low=0.0,
        high=2000.0,
        default=0.0,
        description="Raindrops on a sheet of glass 6 cm before the camera.",
        estimators=(),
    ),
    Parameter(
        "drop_size",
        shape=(),
        unit="mm",
        low=0.2,
        high=10.0,
        default=1.5,
        description="Median of the radii of these drops.",
        estimators=(),
    ),
    Parameter(
        "drop_seed",
        shape=(),
        unit="1",
        low=0.0,
        high=1e6,
        default=0.0,
        description="Where they are, and how large: a whole number.",
        estimators=(),
    ),
)
# what the lamps of a car may be: with either beam its tail lamps shine too
LAMPS = ("off", "low", "high")
LAMPS_OFF = LAMPS[0]


def _make_lamp_parameter(whose: str) -> Parameter:
    """Return the parameter for the lamps of a car: off, low beam or high beam.

    Args:
        whose: the car, for the description, such as "the object".
    """
    text = (
        f"Headlamps of {whose}, with its tail lamps: the low beam, or the high "
        "beam. They need an environment whose light has a unit, such as the avenue."
    )
    return Parameter(
        name="lamps",
        shape=(),
        unit="name",
        low=0.0,
        high=len(LAMPS) - 1.0,
        default=LAMPS_OFF,
        description=text,
        options=LAMPS,
        estimators=(),
    )


ENVIRONMENT = (
    Parameter(
        "rotation",
        shape=(),
        unit="degrees",
        low=-3600.0,
        high=3600.0,
        default=0.0,
        description="Rotation about the vertical.",
        periodic=True,
        search=(0.0, 360.0),
        estimators=Parameter.LIT,
    ),
    Parameter(
        "exposure",
        shape=(),
        unit="stops",
        low=-10.0,
        high=10.0,
        default=0.0,
        description="Brightness, after metering.",
        search=(-1.0, 1.0),
        estimators=Parameter.LIT,
    ),
)
GROUND_KINDS = (
    TABLE,
    PHOTOGRAPH,
    DRY_ROAD,
    WET_ROAD,
    DRY_AVENUE,
    WET_AVENUE,
    CROSSING,
    CAR_PARK,
    ROOM,
    LIT_ROOM,
    SNOW_AVENUE,
) = (
    "table",
    "photograph",
    "road",
    "wet-road",
    "avenue",
    "wet-avenue",
    "crossing",
    "car-park",
    "room",
    "lit-room",
    "snow-avenue",
)
ROAD_KINDS = (DRY_ROAD, WET_ROAD)
PLACE_KINDS = (DRY_AVENUE, WET_AVENUE, SNOW_AVENUE, CROSSING, CAR_PARK, ROOM, LIT_ROOM)
# height above the floor of the camera of a photograph, where sizes are not known
DEFAULT_PHOTOGRAPH_HEIGHT = 3.0
# settings that only a table has
TABLE_SETTINGS = ("ground.size", *(f"ground.{channel}" for channel in CHANNELS))
GROUND = (
    Parameter(
        "kind",
        shape=(),
        unit="name",
        low=0.0,
        high=len(GROUND_KINDS) - 1.0,
        default="what the environment has: photograph where the map is a file, a road "
        "in a street, else table",
        description="What the object stands on: a square table, the floor that the "
        "environment's photograph shows, a road, "
        "or a place with all that stands in it: an avenue, a crossing, a car "
        "park or a room.",
        options=GROUND_KINDS,
    ),
    Parameter(
        "size",
        shape=(),
        unit="object sizes",
        low=0.0,
        high=1000.0,
        default=3.0,
        description="Side of the table; 0 leaves the ground out.",
    ),
    Parameter(
        "level",
        shape=(),
        unit="object sizes",
        low=-1e4,
        high=1e4,
        default=0.0,
        description="Height of the ground that receives the shadow in a photograph "
        "(`backdrop`).",
    ),
    Parameter(
        "gloss",
        shape=(),
        unit="1",
        low=0.0,
        high=1.0,
        default=0.0,
        description="What a coat on that ground reflects at a right angle: 0 is matt, 0.02 "
        "water, 0.04 varnish, 1 a mirror.",
    ),
    Parameter(
        "roughness",
        shape=(),
        unit="1",
        low=0.05,
        high=1.0,
        default=0.2,
        description="Roughness of the coat: 0.05 is polished, 1 blurs all.",
    ),
    *Parameter.colors(
        "of the table.", defaults=(0.55, 0.45, 0.37), estimators=("differences",)
    ),
    Parameter(
        "height",
        shape=(),
        unit="metres",
        low=1e-3,
        high=1000.0,
        default=f"1.6, or {DEFAULT_PHOTOGRAPH_HEIGHT:g} object sizes",
        description="Height above the floor from which the photograph was taken; in "
        "object sizes as `camera.distance`.",
    ),
    Parameter(
        "radius",
        shape=(),
        unit="metres",
        low=1e-3,
        high=1e5,
        default="5 heights",
        description="How far from the photograph's camera its floor is empty; in "
        "object sizes as `camera.distance`.",
    ),
)
MATERIAL = (
    _make_surface_parameter(
        "roughness", "Roughness of the surface: 0 is polished, 1 is matt.", (0.1, 1.0)
    ),
    _make_surface_parameter(
        "metallic",
        "How metallic it is: 0 is paint, wood or glaze, 1 is bare metal.",
        (0.0, 1.0),
    ),
    _make_surface_parameter(
        "specular", "Strength of the reflection off what is not metal.", (0.0, 1.0)
    ),
    _make_surface_parameter(
        "clearcoat", "Strength of a clear coat on top.", (0.0, 1.0)
    ),
)
# how what is rendered into a photograph is made to look like the rest of it
BACKDROP = (
    Parameter(
        "noise",
        shape=(),
        unit="levels of 255",
        low=0.0,
        high=100.0,
        default="as the photograph has",
        description="Noise of what is rendered into a photograph (`backdrop`).",
        estimators=(),
    ),
    Parameter(
        "blur",
        shape=(),
        unit="pixels",
        low=0.0,
        high=20.0,
        default="as the photograph has",
        description="Blur of what is rendered into a photograph, a standard deviation.",
        estimators=(),
    ),
)
FAMILIES = {
    "camera": (
        *CAMERA,
        EXPOSURE_VALUE,
        *RAINDROPS,
        _make_lamp_parameter("the car that the camera is in"),
    ),
    "pose": POSE,
    "environment": ENVIRONMENT,
    "ground": GROUND,
    "backdrop": BACKDROP,
    "material": MATERIAL,
    "object": (_make_lamp_parameter("the object, a car"),),
}

SETTINGS: Mapping[str, Parameter] = {
    f"{family}.{setting.name}": setting
    for family, parameters in FAMILIES.items()
    for setting in parameters
}
"""Every setting by `family.parameter`; of no other control's parameters."""
# families that a scene has again for each mesh around the object: ``pose:chair.yaw``
MESH_FAMILIES = ("pose", "material")
# settings by name; `resolve_settings` refuses what is no number
SettingValues = Mapping[str, float | str | Sequence[float]]


def find_parameter(name: str) -> Parameter | None:
    """Return the parameter of a setting by its name; None if there is none.

    A mesh around the object has the same parameters as the object. So the parameter of
    ``pose:chair.yaw`` is that of ``pose.yaw``.
    """
    family, _, mesh_and_parameter = name.partition(":")
    if mesh_and_parameter and family in MESH_FAMILIES:
        # The name of the mesh may have dots itself.
        parameter_name = mesh_and_parameter.rpartition(".")[2]
        name = f"{family}.{parameter_name}"
    return SETTINGS.get(name)


def parse_mesh_name(name: str) -> str | None:
    """Return the mesh whose setting a name is: ``chair`` of ``pose:chair.yaw``.

    None for settings of the scene.
    """
    mesh, dot, _ = name.partition(":")[2].rpartition(".")
    return mesh if dot else None


def resolve_settings(settings: SettingValues) -> dict[str, float | None]:
    """Return every setting's value: the user's, or else the default.

    The value is None if the scene computes it, as the camera's distance from the
    object. The value of a choice is the index of its option. Settings of meshes around
    the object are included only if the user has given them.

    Args:
        settings: the user's values by name, such as {"camera.fov": 40}.

    Raises:
        InputError: a value is not a finite number inside its range, or two settings
            contradict each other.
        UnknownNameError: a name is not a setting.
    """
    if "camera.elevation" in settings and "camera.height" in settings:
        raise InputError(
            "`set` camera.elevation and camera.height determine each other; "
            "leave one of them out"
        )
    # A default in words, such as "as far as needed", is computed from the scene.
    values = {
        name: None if isinstance(parameter.default, str) else parameter.default
        for name, parameter in SETTINGS.items()
    }
    for name, value in settings.items():
        values[name] = _convert_setting(name, value)
    return values


def _convert_setting(name: str, value: object) -> float:
    """Return the number of a setting; that of a choice is the index of its option.

    Raises:
        InputError: the value is not valid for the setting.
        UnknownNameError: there is no such setting.
    """
    setting = find_parameter(name)
    if setting is None:
        raise UnknownNameError(
            "scene parameter", name, SETTINGS, "Write it as `set` NAME=VALUE."
        )
    if setting.options:
        value = _find_option_index(name, setting.options, value)
    return _convert_number(name, setting, value)


def _find_option_index(name: str, options: tuple[str, ...], value: object) -> int:
    """Return the index of a choice among names.

    Args:
        name: name of the setting, for the message.
        options: the names.
        value: the choice.

    Raises:
        UnknownNameError: it is none of them.
    """
    if value not in options:
        raise UnknownNameError(
            name, str(value), options, "Write it as `set` NAME=VALUE."
        )
    return options.index(str(value))


def _convert_number(name: str, setting: Parameter, value: object) -> float:
    """Return the value of a setting as a number.

    Args:
        name: name of the setting, for messages.
        setting: its parameter, which has the range.
        value: the value.

    Raises:
        InputError: it is not a finite number inside the range.
    """
    unit = "" if setting.unit == "1" else f" ({setting.unit})"
    allowed_range = f"{setting.low:g} to {setting.high:g}{unit}"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(
            f"`set` {name}: expected a number from {allowed_range}, got {value!r}"
        )
    number = float(value)
    if not setting.low <= value <= setting.high:  # NaN fails, too
        raise InputError(
            f"`set` {name}: expected a number from {allowed_range}, got {value:g}"
        )
    return number
