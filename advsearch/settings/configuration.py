"""Declare the settings of commands, and make configurations from their values.

From one declaration the help, the docs, error messages and checks are made. A
configuration has the values of all settings of a command, and is validated as a whole.
Its class parses the values in the same way from flags, YAML and Python.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    get_args,
    get_origin,
)

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from advsearch.errors import AdvsearchError, InputError, UnknownNameError
from advsearch.files import JsonObject, split_paths
from advsearch.settings import values as written
from advsearch.trust.powers import OmittedSetting, Power, no_power
from advsearch.trust.stored_files import is_shallow

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo
    from typing_extensions import Self


ReadTexts = Callable[[Sequence[str], str], Mapping[str, object]]
"""A function that parses texts such as "NAME=VALUE" to a mapping. Its second argument
is the name of the setting, for errors. It raises ValueError for texts of another form.
"""


@dataclass(frozen=True)
class Setting:
    """The declaration of a setting. `settings` completes the fields that are empty."""

    # The default value, or a function that creates it. `...` if the setting is
    # required, which `settings` replaces by None.
    default: Any
    group: str  # heading in the help
    description: str  # description in the help
    # The allowed values in words, for the help and for "expected ..." in errors. By
    # default it is derived from type and constraints.
    expects: str = ""
    unit: str = ""  # unit of the value
    otherwise: str = ""  # meaning of the default None, for the help
    flag: str = ""  # flag, if it is not made from the name: "--control"
    # Placeholder of the value in the help, if it is not the last word of the name.
    metavar: str = ""
    # Whether the flag may be repeated. The flag of a mapping always may.
    repeats: bool = False
    # Function that parses texts to a mapping, for settings that are mappings.
    read_texts: ReadTexts = written.parse_assignments
    # What the flag of a switch does, if it is the opposite of the description.
    switched: str = ""
    # Function that returns the effect of a value outside of the run, such as to connect
    # to an address. Only a person may request such a value (`trust.powers`).
    power: Power = no_power
    field: str = ""  # its name in the configuration
    name: str = ""  # its name in YAML
    required: bool = False
    is_switch: bool = False  # its flag takes no value
    is_mapping: bool = False  # its flag takes NAME=VALUE

    @property
    def text(self) -> str:
        """The description, the values with range and unit, and the default, on one
        line.
        """
        unit = f", in {self.unit}" if self.unit else ""
        if isinstance(self.default, dict):
            default = ",".join(self.default)
        elif isinstance(self.default, float):
            default = f"{self.default:g}"
        elif self.default is None:
            default = self.otherwise  # the meaning of None
        else:
            default = str(self.default)
        suffix = f" (default: {default})" if default else ""
        return f"{self.description}: {self.expects}{unit}{suffix}"


def setting(
    default: Any,
    group: str,
    description: str,
    expects: str = "",
    *,
    unit: str = "",
    otherwise: str = "",
    flag: str = "",
    metavar: str = "",
    repeats: bool = False,
    read_texts: ReadTexts = written.parse_assignments,
    switched: str = "",
    power: Power = no_power,
    **constraints: Any,
) -> Any:
    """Create a pydantic field with the declaration of a setting.

    Args:
        default: the default value, or a function that creates it.
        group: group of settings in the help.
        description: description of the setting, for the help.
        expects: the values that it takes, in words; "" to derive them from the type.
        unit: unit of measurement; "" for none.
        otherwise: meaning of the default None, for the help.
        flag: flag of the command line; "" to derive it from the name of the field.
        metavar: name of the value in the help; "" to derive it.
        repeats: whether the flag may be used several times.
        read_texts: function that converts texts to a mapping, for settings with one.
        switched: what the flag does, if it is the opposite of the description; "" if
            the description says it.
        power: function that returns the effect of a value outside of the run as text,
            such as to connect to an address, or "" if it has none.
        constraints: constraints of `pydantic.Field`, such as `ge`.
    """
    declared = Setting(
        default=default,
        group=group,
        description=description,
        expects=expects,
        unit=unit,
        otherwise=otherwise,
        flag=flag,
        metavar=metavar,
        repeats=repeats,
        read_texts=read_texts,
        switched=switched,
        power=power,
    )
    # pydantic keeps this with the field; `settings` and `setting_as_in` read it
    extra: Any = {"declared": declared, "constraints": constraints}
    default_name = "default_factory" if callable(default) else "default"
    return Field(
        **{default_name: default},
        description=description,
        json_schema_extra=extra,
        **constraints,
    )


# Fields of a `Setting` that `settings` completes.
DERIVED_FIELDS = ("field", "name", "required", "is_switch", "is_mapping")


def setting_as_in(config: type[Config], field: str, **changes: Any) -> Any:
    """Create a field for a setting (`setting`) that another configuration declares.

    Args:
        config: the configuration that declares it.
        field: field of the setting there.
        changes: arguments of `setting` that differ.
    """
    # "declared" and "constraints", as `setting` has stored them
    extra: Any = config.model_fields[field].json_schema_extra
    declared_arguments = {
        name: value
        for name, value in vars(extra["declared"]).items()
        if name not in DERIVED_FIELDS
    }
    return setting(**{**declared_arguments, **extra["constraints"], **changes})


class Clash(NamedTuple):
    """A setting that has no effect together with others, or contradicts them.

    Attributes:
        setting: field of the setting. It clashes if it differs from its default, and
            `with_others` returns True.
        with_others: function of the configuration that returns whether the other
            settings clash with it.
        why: text of the error after "NAME: ", with what to do.
    """

    setting: str
    with_others: Callable[[Any], object]
    why: str


def settings(config: type[Config]) -> tuple[Setting, ...]:
    """Return every setting of a configuration, in the order of the help.

    Attributes that a declaration leaves empty, such as the flag, are derived from the
    name, the type and the constraints of the field.
    """
    return tuple(
        _complete_declaration(field, info)
        for field, info in config.model_fields.items()
        if field not in config.excluded_settings
    )


def _complete_declaration(field: str, info: FieldInfo) -> Setting:
    """Return the declaration of a setting with the attributes that were left empty.

    Args:
        field: name of the field.
        info: pydantic's description of the field.
    """
    extra: Any = info.json_schema_extra  # `setting` has stored it
    declared: Setting = extra["declared"]
    is_mapping = get_origin(info.annotation) is dict
    default = None
    if not info.is_required():
        default = info.get_default(call_default_factory=True)
    return replace(
        declared,
        field=field,
        name=info.alias or field,
        required=info.is_required(),
        default=default,
        flag=declared.flag or "--" + field.replace("_", "-"),
        expects=declared.expects or _describe_expected(info),
        # the last word of the name
        metavar=declared.metavar or field.rpartition("_")[2].upper(),
        # each use of the flag adds an entry to a mapping
        repeats=declared.repeats or is_mapping,
        is_switch=info.annotation is bool,
        is_mapping=is_mapping,
    )


def _describe_expected(info: FieldInfo) -> str:
    """Describe the values that a field takes, such as "a whole number from 1 to 100".

    The text is derived from the field's type and constraints. It is only used for
    settings without a text of their own: booleans, choices, and numbers with an upper
    limit (`le`) and a lower one (`ge` or `gt`).
    """
    types = [
        value_type
        for value_type in get_args(info.annotation) or (info.annotation,)
        if value_type is not type(None)
    ]
    if types == [bool]:
        return "true or false"
    if get_origin(info.annotation) is Literal:
        return _join_choices(types)
    is_optional_literal = get_origin(types[0]) is Literal  # a Literal or None
    if is_optional_literal:
        return _join_choices(get_args(types[0]))
    return _describe_range(info, is_integer=types == [int])


def _describe_range(info: FieldInfo, *, is_integer: bool) -> str:
    """Return the kind of number that a field takes, and its limits, as text."""
    # Constraints of pydantic: ge is "at least", gt is "greater than", le "at most".
    limits = {
        name: getattr(constraint, name)
        for constraint in info.metadata
        for name in ("ge", "gt", "le")
        if hasattr(constraint, name)
    }
    number = "a whole number" if is_integer else "a number"
    if is_integer:
        upper = str(limits["le"])
    else:
        # Python writes 1e+06; users read and write 1e6.
        upper = f"{limits['le']:g}".replace("e+0", "e")
    if "gt" in limits:
        return f"{number} greater than {limits['gt']:g} and at most {upper}"
    return f"{number} from {limits['ge']:g} to {upper}"


def _join_choices(choices: Sequence[Any]) -> str:
    """Return choices as "a, b or c"."""
    *first, last = choices
    return f"{', '.join(first)} or {last}"


RUN_LOCATION: Mapping[str, bool | None] = {"run": None, "overwrite": False}
"""Settings that determine where a run is stored, with the values that they have in a
repetition of the run.
"""

FILES = (
    *("object", "environment", "camera", "model", "labels", "recipe", "suite"),
    *("held_out", "held_out_environment", "compared", "path"),
    *("backdrop", "occluder"),
)
"""Settings that may name files."""


class SettingsError(InputError):
    """Raised if settings have values that are not allowed.

    Attributes:
        problems: pairs of the name of a setting and a text about what is wrong.
    """

    def __init__(
        self, problems: tuple[tuple[str, str], ...], file: str | Path = ""
    ) -> None:
        where = f"{file}: " if file else ""
        super().__init__("; ".join(f"{where}{name}: {text}" for name, text in problems))
        self.problems = problems


class PythonOnly(NamedTuple):
    """An object of a Python session that a run uses, and that no file and no command
    can name.

    Attributes:
        role: role of the object in the run: "model", "scene", "objective", "policy",
            "metric", "control", "task", ...
        name: its name in that role; empty if it has none.
    """

    role: str
    name: str = ""

    @property
    def text(self) -> str:
        return f"the {self.role} {self.name}".rstrip()


class Config(BaseModel):
    """The base class of configurations, which have the settings of a command.

    Each command has a subclass. An instance is validated as a whole, and is immutable.

    Raises:
        InputError: a value is out of range, or the name of a setting is unknown. The
            message lists all problems.
    """

    command: ClassVar[str]
    # inherited settings that the command does not have
    excluded_settings: ClassVar[tuple[str, ...]] = ()
    clashes: ClassVar[tuple[Clash, ...]] = ()
    # Settings on which no number of the result depends. They may change when a run is
    # resumed.
    changeable_settings: ClassVar[tuple[str, ...]] = (*RUN_LOCATION, "threads")

    _python_only_parts: tuple[PythonOnly, ...] = PrivateAttr(())
    _python_objects: dict[tuple[str, str], Any] = PrivateAttr(default_factory=dict)
    _omitted_settings: tuple[OmittedSetting, ...] = PrivateAttr(())

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False
    )

    def __init__(self, **data: Any) -> None:
        """Check the settings and create the configuration.

        Numbers and arrays of numpy and torch become Python's first.

        Args:
            data: values of settings by name.

        Raises:
            InputError: a value is wrong; the message names the setting.
        """
        _check_shallow(type(self), data)
        # The depth is checked again below, since texts are parsed to nested values.
        values = _read_mappings(type(self), written.to_python(data))
        _check_shallow(type(self), values)
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise _make_settings_error(
                type(self), error.errors(include_url=False)
            ) from None

    @field_validator("*", mode="before")
    @classmethod
    def _no_number_from_bool(cls, value: Any, info: Any) -> Any:
        """Refuse true and false where a setting is no switch; pydantic would take them
        for 1 and 0.
        """
        is_switch = cls.model_fields[info.field_name].annotation is bool
        # In YAML, `yes` is true: `epsilon: yes` is a slip, and does not mean 1.
        if isinstance(value, bool) and not is_switch:
            raise ValueError("a truth value is not accepted here")
        return value

    @field_validator("*")
    @classmethod
    def _finite(cls, value: Any) -> Any:
        """Refuse NaN and infinity, and integers of more than 64 bits."""
        if not written.are_all_finite(value):
            raise ValueError("not finite")
        return value

    @model_validator(mode="after")
    def _without_clashes(self) -> Self:
        """Check that the command has all settings, and that none contradict each other.

        A command does not have the settings in `excluded_settings`, although its class
        inherits them. `clashes` lists the settings that contradict others.
        """
        self._check_excluded_settings()
        defaults = {setting.field: setting.default for setting in settings(type(self))}
        for clash in self.clashes:
            if clash.setting in self.excluded_settings:
                continue
            is_set = getattr(self, clash.setting) != defaults[clash.setting]
            if is_set and clash.with_others(self):
                # The field of `set` is `set_`; messages have the name without "_".
                raise InputError(f"{clash.setting.rstrip('_')}: {clash.why}")
        return self

    def _check_excluded_settings(self) -> None:
        """Check that settings that the command does not have are at their defaults.

        Raises:
            InputError: one is not.
        """
        for name in self.excluded_settings:
            field = type(self).model_fields[name]
            if getattr(self, name) != field.get_default(call_default_factory=True):
                raise InputError(
                    f"{name}: `advsearch {self.command}` has no such setting; leave it "
                    "out"
                )

    @classmethod
    def from_yaml(
        cls, path: str | Path, overrides: Mapping[str, object] | None = None
    ) -> Self:
        """Load the configuration that a YAML file describes.

        The file has a mapping from settings to values, which may also have `schema`,
        `command` and `base` (see `read_yaml`). A setting in the file that affects more
        than the run, such as an address to connect to (`settings_with_effects`), is
        ignored, since somebody else may have written the file; `omitted_settings` lists
        it.

        Args:
            path: path of the file.
            overrides: settings by name that the user has requested. A dotted name
                stands for a value inside of a mapping, such as
                ``set.camera.azimuth`` or ``controls.pose.yaw``.

        Raises:
            FileFormatError: the file is missing or has another form.
            InputError: a setting is wrong; the message names the file.
        """
        data = dict(written.read_yaml(path))
        data.pop("command", None)
        data.pop("schema", None)  # checked by `read_yaml`
        overrides = overrides or {}
        for name, value in overrides.items():
            written.set_dotted(data, name, value)
        try:
            return cls._without_effects(data, overrides)
        except SettingsError as error:
            raise SettingsError(error.problems, path) from None

    @classmethod
    def _without_effects(
        cls, data: dict[str, object], overrides: Collection[str]
    ) -> Self:
        """Return the configuration without settings that affect more than the run.

        Args:
            data: values of the settings by name; ignored settings are removed.
            overrides: names of settings that the user has requested, which remain.
        """
        # This first configuration only serves to find the settings with effects.
        omitted_settings = [
            setting
            for setting in cls(**data).settings_with_effects
            if setting.name not in overrides
        ]
        for setting in omitted_settings:
            # The file may use the name of the setting or of its field.
            data.pop(setting.name, None)
            data.pop(setting.field, None)
        config = cls(**data)
        config._omitted_settings = tuple(omitted_settings)
        return config

    @property
    def settings_with_effects(self) -> tuple[OmittedSetting, ...]:
        """The settings whose values have an effect outside of the run, with the effect.

        An example is an address to which images are sent (`trust.powers`). They have
        the type of settings that are omitted if only a file, and no person, sets them.
        """
        settings_with_effects = []
        for setting in settings(type(self)):
            value = getattr(self, setting.field)
            effect = setting.power(value)
            if effect:
                omitted = _make_omitted_setting(setting, value, effect)
                settings_with_effects.append(omitted)
        return tuple(settings_with_effects)

    @property
    def omitted_settings(self) -> tuple[OmittedSetting, ...]:
        """The settings of the file that `from_yaml` has ignored, since they have an
        effect outside of the run.
        """
        return self._omitted_settings

    @property
    def session_settings(self) -> dict[str, Any]:
        """The settings that a run passes on to the runs of its parts, by name.

        A part, such as an attack of a study, reads its settings from its own file. But
        settings with an effect outside of the run, such as an address to connect to,
        are never read from files (`settings_with_effects`). So they are passed on, if
        they do not change the numbers of the run (`changeable_settings`).
        """
        return {
            setting.name: getattr(self, setting.field)
            for setting in settings(type(self))
            if setting.power is not no_power
            and setting.name in self.changeable_settings
            and setting.name not in RUN_LOCATION
        }

    def check_no_effects(self, where: str) -> None:
        """Check that no setting has an effect outside of the run.

        This is for files of which the user cannot confirm single settings, such as
        those that another file names (see `settings_with_effects`).

        Args:
            where: name of the file, for messages.

        Raises:
            InputError: a setting has one, such as an address to connect to; the message
                names the first one.
        """
        if self.settings_with_effects:
            setting = self.settings_with_effects[0]
            raise InputError(
                f"{where}: {setting.name}: {setting.effect}, which such a file can't "
                "ask for; leave it out"
            )

    @classmethod
    def get_shared_settings(cls, other: Config) -> dict[str, object]:
        """Return the settings of another configuration that this command also has.

        They are the settings of the nearest common class, except for the location of
        the run and the workers that compute it.
        """
        # the first one that fits: `__mro__` has the nearest class first
        common_class = next(
            base
            for base in cls.__mro__
            if issubclass(base, Config) and isinstance(other, base)
        )
        excluded = {*RUN_LOCATION, "workers", "cluster"}
        excluded |= {*cls.excluded_settings, *other.excluded_settings}
        return {
            name: getattr(other, name)
            for name in common_class.model_fields
            if name not in excluded
        }

    @classmethod
    def from_config(cls, other: Config, **changes: object) -> Self:
        """Create a configuration of this command from that of another command.

        It has the settings that both commands have (`get_shared_settings`), with
        changes.
        """
        values = {**cls.get_shared_settings(other), **changes}
        return cls(**values).with_python_parts_of(other)

    @property
    def python_only_parts(self) -> tuple[PythonOnly, ...]:
        """The parts that exist only in this Python session."""
        return self._python_only_parts

    def with_python_only_parts(self, parts: Sequence[PythonOnly]) -> Self:
        """Return a copy with other parts that exist only in this Python session."""
        copy = self.model_copy()
        copy._python_only_parts = tuple(parts)
        return copy

    def get_python_object(self, role: str, name: str) -> Any:
        """Return the object that a Python caller passed for a name in these settings;
        None if there is only the name.

        Args:
            role: "scene", "model" or "control".
            name: name of the object, as the settings have it.
        """
        return self._python_objects.get((role, name))

    def with_python_objects(self, objects: Mapping[tuple[str, str], Any]) -> Self:
        """Return a copy that holds objects, by role and name, in place of what these
        settings name.
        """
        copy = self.model_copy()
        copy._python_objects = {**self._python_objects, **objects}
        return copy

    def with_python_parts_of(self, other: Config) -> Self:
        """Return a copy with the objects of other settings, and with their parts that
        exist only in this session.
        """
        return self.with_python_only_parts(other.python_only_parts).with_python_objects(
            other._python_objects
        )

    def to_yaml(self) -> str:
        """Return the configuration as YAML.

        `from_yaml` returns an equal configuration. Only settings with an effect outside
        of the run (`settings_with_effects`) are lost: they are not read from files.
        """
        data = {"schema": written.SCHEMA, "command": self.command, **self.to_json()}
        note = ""
        if self._python_only_parts:
            # It continues the header: "To repeat it: advsearch run FILE".
            note = f"# But it can't be: {format_python_only(self.python_only)}\n"
        return written.HEADER + note + str(yaml.safe_dump(data, sort_keys=False))

    def to_json(self) -> JsonObject:
        """Return every setting by the name it has in YAML, as JSON values."""
        return self.model_dump(by_alias=True, mode="json")

    @property
    def run_location(self) -> tuple[str | None, bool]:
        """Where the run is stored, None if that is not set, and whether a run there is
        replaced.
        """
        return getattr(self, "run", None), getattr(self, "overwrite", False)

    @property
    def run_name_words(self) -> tuple[str, ...]:
        """The words of the default name of a run."""
        return (self.command,)

    def make_repeatable(self) -> Self:
        """Return the settings in the form that `run.yaml` stores.

        Paths of files are absolute. The location of the run is left out, since a
        repetition gets its own.
        """
        absolute = {}
        for name in FILES:
            value = getattr(self, name, None)
            if value is not None:
                convert = _make_absolute
                if name == "backdrop":  # which may be a folder
                    convert = _make_backdrop_absolute
                absolute[name] = ",".join(map(convert, written.split_names(value)))
        return self.model_copy(update={**absolute, **RUN_LOCATION})

    def command_line(self, run: str | Path | None) -> str | None:
        """Return the shell command that repeats the run in a directory; None if there
        is none.
        """
        if run is None or self._python_only_parts:
            return None
        return shlex.join(["advsearch", "run", str(Path(run) / written.CONFIG)])

    @property
    def python_only(self) -> list[str]:
        """The parts that exist only in this Python session, in words."""
        return [part.text for part in self._python_only_parts]

    def get_deciding_settings(self) -> JsonObject:
        """Return the settings on which the numbers of a run depend, as JSON values.

        They are all settings that are not in `changeable_settings`. A file is
        represented by its name without directories, since it may have been moved.
        """
        values = {
            name: value
            for name, value in self.to_json().items()
            if name not in self.changeable_settings
        }
        for name in FILES:
            value = values.get(name)
            if isinstance(value, str):
                names = [
                    _strip_directories(entry) for entry in written.split_names(value)
                ]
                values[name] = ",".join(names)
        return values


def _check_shallow(config: type[Config], data: Mapping[str, Any]) -> None:
    """Check that no value is nested too deeply.

    Raises:
        SettingsError: a value is.
    """
    problems = [
        _make_problem(name, value)
        for name, value in data.items()
        if not is_shallow(value)
    ]
    if problems:
        raise _make_settings_error(config, problems)


def _make_omitted_setting(setting: Setting, value: Any, effect: str) -> OmittedSetting:
    """Return a setting with its value, and the effect of it outside of the run."""
    return OmittedSetting(
        name=setting.name,
        field=setting.field,
        value=value,
        effect=effect,
        default=setting.default,
    )


def _read_mappings(config: type[Config], data: Mapping[str, Any]) -> dict[str, Any]:
    """Convert texts of settings that are mappings, such as "pose.yaw=3", to mappings.

    A text or a list of texts is converted; other values are returned unchanged.

    Raises:
        SettingsError: a text cannot be read.
    """
    values = dict(data)
    for setting in settings(config):
        if not setting.is_mapping:
            continue
        # pydantic accepts both names of a setting, such as "set" and "set_"
        for name in {setting.name, setting.field} & values.keys():
            values[name] = _read_mapping(config, setting, name, values[name])
    return values


def _read_mapping(config: type[Config], setting: Setting, name: str, value: Any) -> Any:
    """Convert a text, or a list of texts, to a mapping; return other values unchanged.

    Args:
        config: class with the settings.
        setting: the setting.
        name: its name, or that of its field.
        value: its value.

    Raises:
        SettingsError: a text cannot be read.
    """
    texts = [value] if isinstance(value, str) else value
    are_texts = isinstance(texts, (list, tuple)) and all(
        isinstance(text, str) for text in texts
    )
    if not are_texts:
        return value
    try:
        return setting.read_texts(texts, setting.name)
    except ValueError:
        got = texts[0] if len(texts) == 1 else texts
        # the same form as the errors of pydantic, for the same message
        problem = _make_problem(name, got)
        raise _make_settings_error(config, [problem]) from None


def _make_problem(name: str, value: Any) -> dict[str, Any]:
    """Return the problem of a setting in the form of pydantic's errors."""
    return {"loc": (name,), "input": value, "type": ""}


def format_python_only(parts: Sequence[str]) -> str:
    """Return why no command repeats a run with parts that exist only in Python."""
    *first, last = map(written.format_value, parts)
    if first:
        subject = f"{', '.join(first)} and {last} exist"
    else:
        subject = f"{last} exists"
    return f"{subject} only in the Python session that asked."


def _make_settings_error(config: type[Config], errors: Sequence[Any]) -> AdvsearchError:
    """Convert pydantic's errors to one error in the words of the settings.

    Only the first error of each setting is reported.

    Args:
        config: class with the settings.
        errors: errors of pydantic. "loc" is the name of the setting, perhaps followed
            by the name of an entry of its mapping; "input" is the wrong value.
    """
    declared = settings(config)
    known = {setting.name: setting for setting in declared}
    known |= {setting.field: setting for setting in declared}
    problems: dict[str, str] = {}
    for error in errors:
        name = str(error["loc"][0])
        if name not in known:
            names = {setting.name for setting in declared}
            return UnknownNameError("setting", name, names)
        setting = known[name]
        got = _describe_wrong_value(setting, error)
        problems.setdefault(setting.name, f"expected {setting.expects}, got {got}")
    return SettingsError(tuple(problems.items()))


def _describe_wrong_value(setting: Setting, error: Any) -> str:
    """Return the value that a setting has, by an error of pydantic, as text."""
    got = "nothing"
    if error["type"] != "missing":
        got = written.format_value(error["input"])
    # whether one entry of a mapping is wrong, and not the full value
    location = error["loc"]
    is_entry_wrong = setting.is_mapping and len(location) > 1
    return f"{location[1]}={got}" if is_entry_wrong else got


def _make_absolute(name: str) -> str:
    """Make the path of a file in a setting absolute.

    In ``camera.csv+object.csv`` both paths become absolute. The node in
    ``scene.glb#NODE`` is kept. A name that is no file is returned unchanged.
    """
    paths = split_paths(name)
    if len(paths) > 1:
        return "+".join(map(_make_absolute, paths))
    path = name
    node = ""
    is_file = os.path.isfile(name)
    if not is_file:  # a # in the name of an existing file separates no node
        path, mark, node_name = name.partition("#")
        node = f"{mark}{node_name}"
    looks_like_path = "/" in path or Path(path).suffix != ""
    if looks_like_path and os.path.isfile(path):
        return f"{Path(path).resolve()}{node}"
    return name


def _make_backdrop_absolute(name: str) -> str:
    """Return a photograph, a part of one or a folder of them with an absolute path."""
    if os.path.isdir(name):
        return str(Path(name).resolve())
    return _make_absolute(name)


def _strip_directories(entry: str) -> str:
    """Return the names of files without their directories."""
    return "+".join(Path(path).name for path in split_paths(entry))
