"""Declare the settings of runs, which may come from YAML files, flags and Python calls.

Each setting declares its flag, unit, range and default once. The help of the command
line and the docs are made from these declarations (`settings`). This module contains
the settings that many commands share, and those of `render`. Each experiment declares
its other settings. Names of objects, controls and policies are not checked here, but
when they are loaded, so that this module imports little.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, JsonValue, field_validator, model_validator

from advsearch import registry
from advsearch.errors import InputError
from advsearch.files import MESHES, join_alternatives
from advsearch.options import TASK_SEPARATOR, format_things, group_mitsuba_keys
from advsearch.settings import Clash, Config, setting, setting_as_in
from advsearch.settings import values as written
from advsearch.trust import powers

PATH_OPTIONS = ("references", "state")
"""Options of a task or policy that are the path of a directory or a file. The absolute
path is stored, so that a run may be resumed from any directory.
"""


def parse_name_with_options(value: Any, setting: str, default_name: str) -> Any:
    """Read a setting that is a name, or a name with options.

    ``NAME={OPTION: VALUE}`` becomes ``{"name": NAME, OPTION: VALUE}``, and a mapping
    with nothing but a name becomes the name. Options that are paths become absolute.

    Args:
        value: ``NAME``, ``NAME={OPTION: VALUE}`` or a mapping; anything else is
            returned as it is.
        setting: name of the setting, for messages.
        default_name: name for a mapping that has none.
    """
    if isinstance(value, str) and "=" in value:
        name, options = written.parse_assignment(value, setting)
        if not isinstance(options, Mapping):
            # A text such as "detection=3" has no names of options. It is stored under
            # "", which no option is called, so that the check of options rejects it.
            options = {"": options}
        value = {"name": name, **options}
    if not isinstance(value, Mapping):
        return value
    options = _make_paths_absolute(value)
    name = value.get("name", default_name)
    return {"name": name, **options} if options else name


def _make_paths_absolute(value: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return the options in a mapping with a name, with absolute paths."""
    options = {key: option for key, option in value.items() if key != "name"}
    for key in PATH_OPTIONS:
        path = options.get(key)
        if isinstance(path, (str, os.PathLike)) and path:
            options[key] = str(Path(path).expanduser().absolute())
    return options


def _split_joined_names(text: str) -> list[str]:
    """Split a text at each + that is not inside of braces."""
    return re.split(r"\+(?![^{]*\})", text)


def parse_joined_names(value: Any, setting: str, default_name: str) -> Any:
    """Read a setting that is one name, or several names joined with + or in a list.

    Each name may have options, as in ``detection={iou: 0.7}+depth``. The result has the
    joined names, and under each name its options: ``{"name": "detection+depth",
    "detection": {"iou": 0.7}}``. A single name is read by `parse_name_with_options`.

    Args:
        value: value of the setting; a value of another form is returned unchanged, to
            be checked later.
        setting: name of the setting, for messages.
        default_name: name for a mapping that has none.
    """
    entries = _split_joined_names(value) if isinstance(value, str) else value
    has_several_names = isinstance(entries, (list, tuple)) and len(entries) > 1
    if not has_several_names:
        return parse_name_with_options(value, setting, default_name)
    named_options = _parse_joined_entries(entries, setting, default_name)
    if named_options is None:
        return value  # it has another form, and is rejected later
    names = [name for name, _ in named_options]
    options = {
        name: options_of_name
        for name, options_of_name in named_options
        if options_of_name
    }
    joined_options = _distribute_last_options(names, options)
    joined: dict[str, Any] = {**joined_options, "name": TASK_SEPARATOR.join(names)}
    return parse_name_with_options(joined, setting, default_name)


def _parse_joined_entries(
    entries: Sequence[Any], setting: str, default_name: str
) -> list[tuple[str, dict[str, Any]]] | None:
    """Return the name of each entry with its options; None if an entry has no name.

    Args:
        entries: names, names with options, or mappings.
        setting: name of the setting, for messages.
        default_name: name for a mapping that has none.
    """
    named_options = []
    for entry in entries:
        name, options = _parse_joined_entry(entry, setting, default_name)
        if not isinstance(name, str) or not name:
            return None
        named_options.append((name, options))
    return named_options


def _parse_joined_entry(
    entry: Any, setting: str, default_name: str
) -> tuple[Any, dict[Any, Any]]:
    """Return the name and the options of one of several joined names.

    The arguments are those of `parse_name_with_options`.
    """
    text = entry.strip() if isinstance(entry, str) else entry
    named = parse_name_with_options(text, setting, default_name)
    mapping = dict(named) if isinstance(named, Mapping) else {"name": named}
    return mapping.pop("name", None), mapping


def _distribute_last_options(
    names: Sequence[str], options: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Return the options of each name, some of which may follow the last name.

    In stored command lines the options of all names follow the last name, each under
    its own name: detection+depth={depth: {seek: gone}}. They belong to all names if
    their keys are names; otherwise they are options of the last name only.

    Args:
        names: the joined names.
        options: options by the name that they follow; this mapping may be changed.
    """
    last_name = names[-1]
    last_options = options.get(last_name, {})
    is_keyed_by_names = last_options.keys() <= set(names)  # also if there are none
    if is_keyed_by_names:
        options[last_name] = {}
        options.update(last_options)
    # names without options are left out
    return {
        name: name_options for name, name_options in options.items() if name_options
    }


def has_model_url(model: str) -> bool:
    """Return whether the name of a model, or one of several names, is an address."""
    names = written.split_names(model)
    return any(re.match("https?:", name, re.IGNORECASE) for name in names)


def get_name_without_options(name_with_options: str | Mapping[str, object]) -> str:
    """Return the name in a setting that is a name, or a mapping with a name and options.

    This is the form that `parse_name_with_options` returns.
    """
    if isinstance(name_with_options, str):
        return name_with_options
    return str(name_with_options["name"])


DEFAULT_ENVIRONMENT = "studio"
"""The environment that lights a scene by default. Equal to
`scene.description.DEFAULT_ENVIRONMENT`, as a test checks.
"""
LIST_SETTINGS = (
    "object",
    "environment",
    "model",
    "labels",
    "label",
    "target",
    "held_out",
    "held_out_environment",
)
"""Settings that may have several names, if the command allows it."""
TEXT_SETTINGS = (
    *LIST_SETTINGS,
    *("task", "up", "camera", "backdrop", "occluder", "run", "objective"),
)
"""Settings that are stored as strings. Paths, numbers and lists are converted."""

# Controls by name, each with its options.
ControlsByName = dict[str, dict[str, object]]

SEARCH_SPP = {"oidn": 8, "none": 16}
"""Default number of samples per pixel of a search, with the denoiser and without."""
# With `--spp auto`, the default number of samples is divided by this.
AUTO_SPP_DIVISOR = 2
# With `--spp auto`, a candidate is rendered at most this many times more, as long as it
# may still be the best.
MAX_EXTRA_REPEATS = 4


class SceneConfig(Config):
    """The settings of every command with a scene and a model.

    Paths are relative to the current directory. A setting that is None is chosen
    automatically, as its description says.
    """

    changeable_settings: ClassVar[tuple[str, ...]] = (
        *Config.changeable_settings,
        "ask",
    )
    default_environment: ClassVar[str] = DEFAULT_ENVIRONMENT
    # those of object, environment and model that may have several names, with commas
    list_settings: ClassVar[tuple[str, ...]] = ()
    clashes: ClassVar[tuple[Clash, ...]] = (
        Clash(
            "threads",
            lambda config: config.deterministic and config.threads != 1,
            "`deterministic` uses one thread; leave one of them out",
        ),
        Clash(
            "overwrite",
            lambda config: config.run is None,
            "replaces the run that `run` names, but `run` is not set; set it, or leave "
            "`overwrite` out",
        ),
    )

    object: str = setting(
        ...,
        "scene",
        "the object that the model should recognise",
        f"the name of an object or a {join_alternatives(MESHES)} file",
    )
    environment: str | None = setting(
        None,
        "scene",
        "the environment map that lights the scene",
        "the name of an environment, a .hdr or .exr file, the .yaml file of a place, "
        "or none",
        otherwise=DEFAULT_ENVIRONMENT,
    )
    up: Literal["y", "z"] | None = setting(
        None,
        "scene",
        "which axis of an imported object points up",
        otherwise="that of the file format, or else the axis along which the object "
        "stands best",
    )
    facing: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = setting(
        None,
        "scene",
        "the axis of an imported file along which the front of the object points; in "
        "the scene it points along +x",
        otherwise="that of the format (+z in glTF and VRM 1, -z in VRM 0), +x for other "
        "formats",
    )
    size: float | None = setting(
        None,
        "scene",
        "the length of the longest side of the object; distances are then in metres",
        "a number of metres from 1e-4 to 1e4",
        otherwise="that of the bundled object or of the file: glTF is in metres",
        ge=1e-4,
        le=1e4,
    )
    unit: Literal["mm", "cm", "m", "in"] | None = setting(
        None,
        "scene",
        "unit of the coordinates in the object's file, which determines its size",
        otherwise="that of the file: glTF is in metres",
    )
    camera: str | None = setting(
        None,
        "scene",
        "the camera that takes the picture: a camera of a scene file, a built-in one, "
        "or one with the lens of a camera file",
        "a name that advsearch import lists, orbit, dashcam, robot, fisheye, "
        "equirectangular, or a camera file of OpenCV, Kalibr, ROS, COLMAP or "
        "nerfstudio",
        metavar="NAME",
        otherwise="orbit, a pinhole camera around the object with the parameters "
        "camera.*",
        min_length=1,
    )
    set_: dict[str, float | str | tuple[float, ...]] = setting(
        dict,
        "scene",
        "fix a parameter of the scene, such as camera.azimuth=130; may be repeated",
        "PARAMETER=VALUE with a finite number, a name or a list of numbers",
        alias="set",
        flag="--set",
        metavar="PARAMETER=VALUE",
    )
    things: str | None = setting(
        None,
        "scene",
        "other objects in the scene, at X metres in front of the object and Y metres "
        "to its left",
        "OBJECT@X,Y, perhaps followed by heading=DEGREES, size=METRES, name=NAME or "
        "label=LABEL with commas between them; several with ; between them",
        flag="--with",
        otherwise="none",
    )
    backdrop: str | None = setting(
        None,
        "scene",
        "a photograph that the object is rendered into, taken by the camera of the "
        "scene",
        "a picture file, a part of one as photo.jpg#X,Y,WIDTH,HEIGHT in pixels, or a "
        "folder of photographs with their camera files",
        metavar="FILE",
        otherwise="the environment is behind the object",
        min_length=1,
    )
    occluder: str | None = setting(
        None,
        "scene",
        "a mask or a depth map of what is in front of the object in the photograph of "
        "`backdrop`",
        "a mask as a picture of the photograph's size, white where something is in "
        "front of the object; or a depth map: .exr or .npy in metres, or "
        "depth.png#METRES, the metres of one level",
        metavar="FILE",
        otherwise="nothing is in front of the object",
        min_length=1,
    )
    judge: str = setting(
        "object",
        "model",
        "the object whose label the model should predict",
        "object, the name of another object in the scene, or all",
        min_length=1,
    )
    exposure: float = setting(
        0.0,
        "scene",
        "brightness, relative to the metered exposure",
        unit="stops",
        ge=-10.0,
        le=10.0,
    )
    resolution: tuple[int, int] | None = setting(
        None,
        "scene",
        "size of the rendered picture",
        "SIDE or HEIGHTxWIDTH, each from 8 to 4096",
        otherwise="the input size of the model",
        unit="pixels",
    )

    model: str = setting(
        "reference",
        "model",
        "the network under test",
        "reference, a .pt2, TorchScript or .onnx file, torchvision:NAME, timm:NAME, "
        "hf:REPOSITORY, an address such as http://localhost:8000, or "
        "package.module:callable",
    )
    labels: str | None = setting(
        None,
        "model",
        "names of the model's classes",
        "a JSON or text file, imagenet, cifar10, cifar100, coco, coco90, coco91, voc, "
        "or the names with commas between them",
        metavar="FILE",
        otherwise="the model's own",
    )
    prompt: str | None = setting(
        None,
        "model",
        "text for a model that takes text in addition to the picture: for CLIP the "
        "caption with which a picture is compared, one for each label; for a model such "
        "as LLaVA the question",
        "a text, for CLIP with {} in place of the label, or several with | between them",
        otherwise="a photo of a {}, or What is this?",
        metavar="TEXT",
    )
    value_range: tuple[float, float] | None = setting(
        None,
        "model",
        "the values of black and white in the input of the model",
        "LOW,HIGH with LOW below HIGH, such as 0,255",
        otherwise="those that the model states, or 0,1",
        metavar="LOW,HIGH",
    )
    ask: dict[str, float] = setting(
        dict,
        "model",
        "a limit for a model at an address, such as calls=500: calls (2000), tokens and "
        "money of a run, seconds for an answer (120), requests at_once (4), and the "
        "prices per_call, per_million_in and per_million_out; may be repeated",
        "LIMIT=NUMBER",
        metavar="LIMIT=NUMBER",
    )
    task: str | dict[str, JsonValue] = setting(
        "classification",
        "model",
        "what the model does, and how its predictions are evaluated; for several models "
        "one task each, with + between them",
        "the name of a task, or NAME={OPTION: VALUE}",
    )
    label: str | None = setting(
        None,
        "model",
        "the labels that count as right, separated by commas",
        'names of classes or their numbers, such as "coffee mug,cup" or #504',
        otherwise="the object's label",
    )

    controls: ControlsByName = setting(
        lambda: {"texture": {}},
        "search",
        "what may change in the scene, separated by commas",
        "names of controls, or NAME={PARAMETER: VALUE or [LOW, HIGH]}",
        flag="--control",
        metavar="NAME",
        read_texts=written.parse_controls,
        min_length=1,
    )
    texture_resolution: int | None = setting(
        None,
        "search",
        "side length of the searched texture",
        unit="texels",
        otherwise="chosen by the resolution of the object's texture",
        ge=2,
        le=4096,
    )
    spp: Annotated[int, Field(ge=1, le=65536)] | Literal["auto"] | None = setting(
        None,
        "search",
        "samples per pixel of a render of the search; auto uses half of the default, "
        "and renders the best candidates again as long as they are close",
        "a whole number from 1 to 65536, or auto",
        otherwise="8 with the denoiser, 16 without",
        unit="samples",
    )
    denoise: Literal["oidn", "none"] = setting(
        "oidn", "search", "denoiser of every render, in search and verification"
    )
    pixel_sampler: Literal["independent", "multijitter"] = setting(
        "multijitter",
        "search",
        "how samples are distributed over a pixel, in search and verification; "
        "multijitter has less noise, and rounds the number of samples up to a product "
        "of two similar numbers",
    )

    seed: int = setting(
        0,
        "run",
        "seed of all random numbers",
        "a whole number from 0 to 2**63 - 1",
        ge=0,
        le=2**63 - 1,
    )
    threads: int | None = setting(
        None, "run", "number of processor threads", otherwise="all", ge=1, le=1024
    )
    deterministic: bool = setting(
        False,
        "run",
        "use one thread, so that repeated runs are equal bit for bit; slower",
    )
    run: str | None = setting(
        None,
        "run",
        "where the run is stored",
        "a name (for a folder in runs/) or the path of a folder",
        otherwise="runs/OBJECT-CONTROL-NNN",
        min_length=1,
        power=powers.describe_location,
    )
    overwrite: bool = setting(
        False,
        "run",
        "replace a run that exists already",
        power=powers.describe_overwrite,
    )

    @model_validator(mode="after")
    def _check_counts(self) -> SceneConfig:
        """Check that settings for a single name do not have several.

        Several tasks, as "detection+depth", are an exception: each needs one model.
        """
        tasks = self.task_name.split(TASK_SEPARATOR)
        for setting_name in ("object", "environment", "model"):
            names = written.split_names(getattr(self, setting_name) or "")
            needs_model_per_task = setting_name == "model" and len(tasks) > 1
            if needs_model_per_task:
                _check_model_per_task(names, tasks)
            elif len(names) > 1 and setting_name not in self.list_settings:
                raise make_single_value_error(setting_name, names)
        self._check_single_object_if_size_is_set()
        return self

    def _check_single_object_if_size_is_set(self) -> None:
        """Check that a size is not set for several objects.

        Raises:
            InputError: it is.
        """
        if self.size is not None and len(self.objects) > 1:
            raise InputError(
                "size: is the size of one object, and there are several; leave it out, "
                "or use `unit`"
            )

    @property
    def run_name_words(self) -> tuple[str, ...]:
        return self.object, *self.controls

    @property
    def task_name(self) -> str:
        """The name of the task."""
        return get_name_without_options(self.task)

    @property
    def n_used_threads(self) -> int | None:
        """Number of processor threads to use; None for all."""
        return 1 if self.deterministic else self.threads

    @property
    def environment_name(self) -> str:
        """The name of the environment: the setting, or the default."""
        return self.environment or DEFAULT_ENVIRONMENT

    @property
    def control_kinds(self) -> tuple[str, ...]:
        """The kind of each control: its option `kind`, or else its name."""
        controls = {**self.controls, **getattr(self, "over", {})}
        return tuple(
            str(options.get("kind", name)) for name, options in controls.items()
        )

    @property
    def search_spp(self) -> int:
        """Samples per pixel of a render of the search.

        It is the setting `spp` if that is a number; the default for the denoiser if it
        is None; and the default divided by `AUTO_SPP_DIVISOR` if it is "auto".
        """
        if isinstance(self.spp, int):
            return self.spp
        default = SEARCH_SPP[self.denoise]
        return default // AUTO_SPP_DIVISOR if self.spp == "auto" else default

    @property
    def image_settings(self) -> dict[str, Any]:
        """The settings of the images that the models see, as keywords of `render`."""
        return {
            "resolution": self.resolution,
            "denoise": self.denoise,
            "sampler": self.pixel_sampler,
            "seed": self.seed,
        }

    @property
    def max_extra_repeats(self) -> int:
        """Maximum number of extra renders of a configuration that may be the best one.

        They are made as long as the best ones are close together; with `spp` "auto"
        only.
        """
        return MAX_EXTRA_REPEATS if self.spp == "auto" else 0

    @property
    def objects(self) -> tuple[str, ...]:
        return written.split_names(self.object)

    @property
    def models(self) -> tuple[str, ...]:
        """The names of the models.

        The models of a joint task, such as "detection+depth", count as a single model,
        whose name contains commas.
        """
        is_joint_task = TASK_SEPARATOR in self.task_name
        return (self.model,) if is_joint_task else written.split_names(self.model)

    @field_validator(*TEXT_SETTINGS, mode="before", check_fields=False)
    @classmethod
    def _as_text(cls, value: Any, info: Any) -> Any:
        """Return a name as a text, and a list of names as a text with commas."""
        is_list_of_labels = info.field_name == "labels" and isinstance(
            value, (list, tuple)
        )
        # A comma inside of a label would later split it into two.
        if is_list_of_labels and any("," in str(name) for name in value):
            raise ValueError("a label with a comma; put such labels into a file")
        return written.to_text(value, several=info.field_name in LIST_SETTINGS)

    @field_validator("facing", mode="before", check_fields=False)
    @classmethod
    def _with_a_sign(cls, value: Any) -> Any:
        """Return an axis with its sign: "x" is "+x"."""
        return f"+{value}" if value in ("x", "y", "z") else value

    _things_as_text = field_validator("things", mode="before")(format_things)

    @field_validator("prompt", mode="before")
    @classmethod
    def _prompts_as_text(cls, value: Any) -> Any:
        """Join a list of prompts by " | "; none of them may be empty."""
        is_list = isinstance(value, (list, tuple))
        if is_list and all(isinstance(text, str) for text in value):
            value = " | ".join(value)
        if isinstance(value, str):
            if not all(prompt.strip() for prompt in value.split("|")):
                raise ValueError("no text")
        return value

    @field_validator("task", mode="before")
    @classmethod
    def _task_with_options(cls, value: Any) -> Any:
        return parse_joined_names(value, "task", cls.model_fields["task"].default)

    @field_validator("controls", "over", mode="before", check_fields=False)
    @classmethod
    def _controls_with_options(cls, value: Any) -> Any:
        """Return controls as a mapping from name to options.

        A control without options gets an empty mapping. Names of Mitsuba's scene
        parameters become options of the control "mitsuba".
        """
        if not isinstance(value, Mapping):
            return value
        return {
            name: {} if options is None else options
            for name, options in group_mitsuba_keys(value).items()
        }

    @field_validator("resolution", mode="before")
    @classmethod
    def _resolution_from_text(cls, value: Any) -> Any:
        """Read ``HEIGHTxWIDTH``, or ``SIDE`` for a square."""
        sides = value
        if isinstance(value, str):
            sides = value.lower().split("x")
        elif isinstance(value, int):
            sides = [value]
        is_square = isinstance(sides, (list, tuple)) and len(sides) == 1
        return [*sides, *sides] if is_square else sides

    @field_validator("resolution")
    @classmethod
    def _sides_in_range(cls, value: tuple[int, int] | None) -> tuple[int, int] | None:
        """Check that both sides are within their limits."""
        if not all(8 <= side <= 4096 for side in value or ()):
            raise ValueError("out of range")
        return value

    @field_validator("value_range", mode="before")
    @classmethod
    def _range_from_text(cls, value: Any) -> Any:
        """Read ``LOW,HIGH``."""
        return value.split(",") if isinstance(value, str) else value

    @field_validator("value_range")
    @classmethod
    def _range_in_order(
        cls, value: tuple[float, float] | None
    ) -> tuple[float, float] | None:
        """Check that the first value is below the second one."""
        if value is not None and value[0] >= value[1]:
            raise ValueError("out of order")
        return value

    @field_validator("set_", mode="before")
    @classmethod
    def _numbers_from_text(cls, value: Any) -> Any:
        """Convert texts that are numbers; YAML reads 1e-3 as a text."""
        if not isinstance(value, Mapping):
            return value
        return {
            name: written.parse_number_or_text(text) for name, text in value.items()
        }


def _check_model_per_task(models: Sequence[str], tasks: Sequence[str]) -> None:
    """Check that there is one model for each of several tasks.

    Raises:
        InputError: there are more or fewer.
    """
    if len(models) != len(tasks):
        raise InputError(
            f"model: expected {len(tasks)} with commas between them, one "
            f"for each of {', '.join(tasks)}, got {len(models)}"
        )


def make_single_value_error(name: str, names: Sequence[str]) -> InputError:
    """Return the error for several names where one is expected.

    Args:
        name: name of the setting: "object", "environment" or "model".
        names: names in its value.
    """
    got = written.format_value(",".join(names))
    return InputError(
        f"{name}: expected one {name}, got {got}; give one, or compare several with "
        "advsearch sweep"
    )


PICTURE_SPP = 64  # default number of samples per pixel of `render`
IMAGE_SUFFIXES = (".png", ".exr")  # suffixes of images that can be written


class RenderConfig(SceneConfig):
    """The settings of `render`, which renders pictures of a scene and predicts them."""

    command: ClassVar[str] = "render"
    excluded_settings: ClassVar[tuple[str, ...]] = ("run", "overwrite")

    controls: ControlsByName = setting_as_in(
        SceneConfig,
        "controls",
        default=dict,
        group="picture",
        description="what differs from the scene, separated by commas; a range has the "
        "value at which a search would start",
        expects="names of controls, or NAME={PARAMETER: VALUE}",
        min_length=None,
    )
    around: int | None = setting(
        None,
        "picture",
        "render one sheet with this number of views, from azimuths all around the "
        "object",
        otherwise="one view",
        unit="views",
        ge=2,
        le=64,
    )
    spp: int = setting(
        PICTURE_SPP, "picture", "samples per pixel", unit="samples", ge=1, le=65536
    )
    aov: str | None = setting(
        None,
        "picture",
        "write ground truth per pixel as layers of an EXR file next to the picture; "
        "names separated by commas",
        "names among mask, depth, normal, uv, id",
        otherwise="none",
        metavar="NAMES",
    )
    out: str = setting(
        ...,
        "picture",
        "the file to write: a .png contains the input of the model, an .exr linear "
        "radiance times the gain",
        "the path of a .png or .exr file",
    )

    @field_validator("out", mode="before")
    @classmethod
    def _picture_file(cls, value: Any) -> Any:
        """Return the path of an image as a text.

        Raises:
            ValueError: the path has no suffix of an image, or contains a zero byte.
        """
        text = str(value) if isinstance(value, Path) else value
        is_path = isinstance(text, str) and "\0" not in text
        if not is_path or Path(text).suffix.lower() not in IMAGE_SUFFIXES:
            raise ValueError("not a picture")
        return text


# No control needs a larger distance. The square of a far larger one overflows float32.
MAX_EPSILON = 1e6


class DerivativeConfig(SceneConfig):
    """The settings of every command that differentiates a scene.

    They add the budgets of the controls (epsilon), and the objective.
    """

    clashes: ClassVar[tuple[Clash, ...]] = (
        *SceneConfig.clashes,
        Clash(
            "epsilon",
            lambda config: config.epsilons and "epsilon" not in config.list_settings,
            "several values make a curve, which only `advsearch attack` draws; give one",
        ),
    )

    object: str = setting_as_in(SceneConfig, "object", default="mug")
    epsilon: float | dict[str, float] | tuple[float, ...] | None = setting(
        None,
        "search",
        "the maximum distance of a control from its start, in the unit of the control "
        "(for several controls CONTROL=NUMBER,...; in `attack` also NUMBER,NUMBER,... "
        "for a curve)",
        f"a number greater than 0 and at most {MAX_EPSILON:g}",
        otherwise="that of the control",
    )
    norm: Literal["linf", "l2"] | None = setting(
        None,
        "search",
        "norm of the distance that epsilon limits",
        otherwise="that of the control",
    )
    estimators: dict[str, str] = setting(
        dict,
        "search",
        "force a gradient estimator",
        "NAME for all controls, or CONTROL=NAME or CONTROL.PARAMETER=NAME; `advsearch "
        "check` shows the names",
        alias="estimator",
        flag="--estimator",
        metavar="NAME",
        read_texts=written.parse_choices,
    )
    objective: str | None = setting(
        None,
        "search",
        "the objective that the search maximizes",
        "the name of an objective",
        otherwise="that of the task: margin",
    )
    specialise: bool = setting(
        True,
        "search",
        "leave out computations that the scene and the search do not need",
        flag="--no-specialise",
        switched="compute everything, also what this search does not need; `advsearch "
        "check` shows what is left out by default",
    )

    @field_validator("epsilon", mode="before")
    @classmethod
    def _epsilon_from_text(cls, value: Any) -> Any:
        """Split a text of `epsilon` into its values, and check that they are in range.

        It is ``0.05``, or ``0.01,0.02`` for values to try one after the other, or
        ``texture=0.05,geometry=0.01`` for a value of each control. No value and no
        control may occur twice.

        Returns:
            A single value, a tuple, or a mapping by control. Values that are text
            remain text: pydantic converts them after this check.
        """
        if isinstance(value, str):
            value = _split_epsilons(value)
        if isinstance(value, (list, tuple)) and len(value) == 1:
            value = value[0]
        if value is not None:
            _check_epsilons(value)
        return value

    @property
    def epsilons(self) -> tuple[float, ...]:
        """The epsilons of a curve; empty if `epsilon` is a single value or a mapping."""
        return self.epsilon if isinstance(self.epsilon, tuple) else ()


def _check_epsilons(value: Any) -> None:
    """Check one or several values of `epsilon`.

    Args:
        value: a single value, a list or tuple, or a mapping by control.

    Raises:
        ValueError: there is none, one is out of range, or one of a list occurs twice.
    """
    if isinstance(value, Mapping):
        values = list(value.values())
    elif isinstance(value, (list, tuple)):
        values = list(value)
    else:
        values = [value]
    # raises for values out of range
    numbers = [_parse_positive(number) for number in values]
    if isinstance(value, (list, tuple)):
        written.check_no_duplicates((f"{number:g}" for number in numbers), "epsilon")
    if not numbers:  # an empty list or mapping
        raise ValueError("nothing is named")


def _split_epsilons(text: str) -> dict[str, Any] | tuple[str, ...]:
    """Split a text with values of `epsilon` at its commas.

    Returns:
        For "texture=0.05,geometry=0.01" a mapping by control; for "0.01,0.02" a tuple.

    Raises:
        InputError: there are two values for one control.
    """
    entries = [entry.strip() for entry in text.split(",")]
    if "=" not in text:
        return tuple(entries)
    pairs = [written.parse_assignment(entry, "epsilon") for entry in entries]
    written.check_no_duplicates((name for name, _ in pairs), "epsilon")
    return dict(pairs)


def _parse_positive(value: Any) -> float:
    """Return the positive number that a number or a text stands for.

    Raises:
        ValueError: it is not a number, or is out of range.
    """
    if isinstance(value, bool):
        raise ValueError("out of range")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("not a number") from None
    # 1e-30 is far below any useful distance.
    if not 1e-30 < number <= MAX_EPSILON:
        raise ValueError("out of range")
    return number


FIRST_COMMANDS = ("attack", "render", "sweep")  # the first commands in the docs


class _Configs(Mapping[str, type[Config]]):
    """The class of the settings of each command, imported when it is needed."""

    def __iter__(self) -> Iterator[str]:
        return iter(
            # by name, after the first commands
            sorted(
                registry.EXPERIMENTS,
                key=lambda name: (name not in FIRST_COMMANDS, name),
            )
        )

    def __len__(self) -> int:
        return len(registry.EXPERIMENTS)

    def __getitem__(self, name: str) -> type[Config]:
        settings: type[Config] = registry.EXPERIMENTS[name].settings
        return settings


CONFIGS: Mapping[str, type[Config]] = _Configs()
"""The class of the settings of each command, in the order of the docs."""
