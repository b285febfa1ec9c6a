"""What is declared of a setting, for the help, the docs, errors and checks alike, and
configurations made of settings.

A configuration is what a command needs to know, checked as a whole. Whatever it is made
from, flags, YAML or Python, its class reads the values.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
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
from advsearch.trust.powers import LeftOut, Power, none
from advsearch.trust.stored_files import is_shallow

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo
    from typing_extensions import Self


ReadTexts = Callable[[Sequence[str], str], Mapping[str, object]]
"""Reads texts into a mapping; the second argument is the name of the setting, for
errors. Raises ValueError where they are something else.
"""


@dataclass(frozen=True)
class Setting:
    """What is declared of a setting; `settings` works out what is empty."""

    # or a function that makes it; ... where it has to be given, which `settings` tells
    # as None
    default: Any
    group: str  # heading in the help
    description: str  # what it is
    # completes "expected ..." in errors, and names the range in the help; or type and
    # constraints do
    expects: str = ""
    unit: str = ""  # of the value
    otherwise: str = ""  # what a default of None comes to
    flag: str = ""  # where that is not its name: "--control"
    # what stands for the value in the help, where that is not the last word of its name
    metavar: str = ""
    # whether its flag may be repeated; that of a mapping always may
    repeats: bool = False
    # reads the texts that a mapping may be written as
    read_texts: ReadTexts = written.parse_assignments
    # what the flag does, where that is the opposite of the description
    switched: str = ""
    # says what a value does beyond the run, which only a person may ask for
    # (`trust.powers`)
    power: Power = none
    field: str = ""  # its name in the configuration
    name: str = ""  # its name in YAML
    required: bool = False
    is_switch: bool = False  # its flag takes no value
    is_mapping: bool = False  # its flag takes one name with a value

    @property
    def text(self) -> str:
        """What it is, its values with range and unit, and its default."""
        unit = f", in {self.unit}" if self.unit else ""
        default = self.otherwise if self.default is None else str(self.default)
        if isinstance(self.default, dict):
            default = ",".join(self.default)
        elif isinstance(self.default, float):
            default = f"{self.default:g}"
        return f"{self.description}: {self.expects}{unit}" + (
            f" (default: {default})" if default else ""
        )


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
    power: Power = none,
    **constraints: Any,
) -> Any:
    """Return a pydantic field: of a `Setting`, with constraints of `pydantic.Field`."""
    declared = Setting(
        default,
        group,
        description,
        expects,
        unit,
        otherwise,
        flag,
        metavar,
        repeats,
        read_texts,
        switched,
        power,
    )
    extra: Any = {"declared": declared, "constraints": constraints}
    make = {"default_factory": default} if callable(default) else {"default": default}
    return Field(
        **make, description=description, json_schema_extra=extra, **constraints
    )


# of a `Setting`, by `settings`
WORKED_OUT = ("field", "name", "required", "is_switch", "is_mapping")


def setting_as_in(config: type[Config], field: str, **changes: Any) -> Any:
    """Return a setting as another command declares it, but for some of the arguments of
    `setting`.
    """
    extra: Any = config.model_fields[field].json_schema_extra
    declared = {
        name: value
        for name, value in vars(extra["declared"]).items()
        if name not in WORKED_OUT
    }
    return setting(**{**declared, **extra["constraints"], **changes})


class Clash(NamedTuple):
    """A setting, by its field, that says nothing, or the opposite of another one,
    `with_others` that are such. It counts as given where it differs from its default;
    `why` completes "setting: ..." and says what to do.
    """

    setting: str
    with_others: Callable[[Any], object]
    why: str


def settings(config: type[Config]) -> tuple[Setting, ...]:
    """Return every setting of a configuration, in the order in which they are shown."""
    complete = []
    for field, info in config.model_fields.items():
        if field in config.without:
            continue
        extra: Any = info.json_schema_extra
        declared: Setting = extra["declared"]
        is_mapping = get_origin(info.annotation) is dict
        complete.append(
            replace(
                declared,
                field=field,
                name=info.alias or field,
                required=info.is_required(),
                default=None
                if info.is_required()
                else info.get_default(call_default_factory=True),
                flag=declared.flag or "--" + field.replace("_", "-"),
                expects=declared.expects or _expected(info),
                metavar=declared.metavar or field.rpartition("_")[2].upper(),
                repeats=declared.repeats or is_mapping,
                is_switch=info.annotation is bool,
                is_mapping=is_mapping,
            )
        )
    return tuple(complete)


def _expected(info: FieldInfo) -> str:
    kinds = [
        kind
        for kind in get_args(info.annotation) or (info.annotation,)
        if kind is not type(None)
    ]
    if kinds == [bool]:
        return "true or false"
    if get_origin(info.annotation) is Literal or get_origin(kinds[0]) is Literal:
        *first, last = (
            kinds if get_origin(info.annotation) is Literal else get_args(kinds[0])
        )
        return f"{', '.join(first)} or {last}"
    limits = {
        name: getattr(part, name)
        for part in info.metadata
        for name in ("ge", "gt", "le")
        if hasattr(part, name)
    }
    number = "a whole number" if kinds == [int] else "a number"
    most = limits["le"] if kinds == [int] else f"{limits['le']:g}".replace("e+0", "e")
    if "gt" in limits:
        return f"{number} greater than {limits['gt']:g} and at most {most}"
    return f"{number} from {limits['ge']:g} to {most}"


PLACE: Mapping[str, bool | None] = {"run": None, "overwrite": False}
"""The settings that say where a run is kept, not what it does, as a repetition has
them.
"""

FILES = (
    *("object", "environment", "camera", "model", "labels", "recipe", "suite"),
    *("held_out", "held_out_environment", "compared", "path"),
)
"""The settings that may name files."""


class SettingsError(InputError):
    """One or more settings have values that are not allowed: `problems` are pairs of a
    name and what is wrong.
    """

    def __init__(
        self, problems: tuple[tuple[str, str], ...], file: str | Path = ""
    ) -> None:
        where = f"{file}: " if file else ""
        super().__init__("; ".join(f"{where}{name}: {text}" for name, text in problems))
        self.problems = problems


class PythonOnly(NamedTuple):
    """A part of a run that exists only in the Python session that made it: no file and
    no command can name it.

    Attributes:
        role: what the run has it for: "model", "scene", "objective", "policy",
            "metric", "control", "task", ...
        name: its name there; empty where it has none.
    """

    role: str
    name: str = ""

    @property
    def text(self) -> str:
        return f"the {self.role} {self.name}".rstrip()


class Config(BaseModel):
    """What a command needs to know. Frozen; unknown names are refused. Each command's
    configuration is a subclass. Raises InputError: a value is outside its range or an
    unknown setting is named; the message lists every problem.
    """

    command: ClassVar[str]
    # settings of a class above that the command does not have
    without: ClassVar[tuple[str, ...]] = ()
    clashes: ClassVar[tuple[Clash, ...]] = ()
    # they decide no number: they may change before a run goes on
    free: ClassVar[tuple[str, ...]] = (*PLACE, "threads")

    _only_here: tuple[PythonOnly, ...] = PrivateAttr(())
    _python_objects: dict[tuple[str, str], Any] = PrivateAttr(default_factory=dict)
    _left_out: tuple[LeftOut, ...] = PrivateAttr(())

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False
    )

    def __init__(self, **data: Any) -> None:
        _check_shallow(type(self), data)
        values = _mappings_from_texts(type(self), written.as_python(data))
        _check_shallow(type(self), values)
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise _settings_error(type(self), error.errors(include_url=False)) from None

    @field_validator("*", mode="before")
    @classmethod
    def _no_number_from_bool(cls, value: Any, info: Any) -> Any:
        # YAML's `epsilon: yes` is a slip, not 1
        if (
            isinstance(value, bool)
            and cls.model_fields[info.field_name].annotation is not bool
        ):
            raise ValueError("a truth value is not accepted here")
        return value

    @field_validator("*")
    @classmethod
    def _finite(cls, value: Any) -> Any:
        if not written.all_finite(value):
            raise ValueError("not finite")
        return value

    @model_validator(mode="after")
    def _without_clashes(self) -> Self:
        defaults = {setting.field: setting.default for setting in settings(type(self))}
        for name in self.without:
            if getattr(self, name) != type(self).model_fields[name].get_default(
                call_default_factory=True
            ):
                raise InputError(
                    f"{name}: `advsearch {self.command}` has no such "
                    "setting; leave it out"
                )
        for clash in self.clashes:
            given = (
                clash.setting not in self.without
                and getattr(self, clash.setting) != defaults[clash.setting]
            )
            if given and clash.with_others(self):
                raise InputError(f"{clash.setting.rstrip('_')}: {clash.why}")
        return self

    @classmethod
    def from_yaml(
        cls, path: str | Path, overrides: Mapping[str, object] | None = None
    ) -> Self:
        """Return the configuration that a YAML file describes, with `overrides` put
        over it: settings which a person has asked for, by name; a dotted one reaches
        inside: ``set.camera.azimuth``, ``controls.pose.yaw``.

        The file has one mapping from settings to values; `schema`, `command` and `base`
        may stand beside them (see `read_yaml`). What it alone asks for and has power
        over more than the run is `left_out`, as if it did not stand there. Raises
        FileFormatError, or InputError as for the class; the message names the file.
        """
        data = {
            name: value
            for name, value in written.read_yaml(path).items()
            if name != "command"
        }
        data.pop("schema", None)  # checked by `read_yaml`
        for name, value in (overrides or {}).items():
            written.put(data, name, value)
        try:
            left = [
                power
                for power in cls(**data).powers
                if power.name not in (overrides or {})
            ]
            without = [name for power in left for name in (power.name, power.field)]
            made = cls(
                **{name: value for name, value in data.items() if name not in without}
            )
        except SettingsError as error:
            raise SettingsError(error.problems, path) from None
        made._left_out = tuple(left)
        return made

    @property
    def powers(self) -> tuple[LeftOut, ...]:
        """The settings that have power over more than the run."""
        given = [
            (setting, getattr(self, setting.field)) for setting in settings(type(self))
        ]
        return tuple(
            LeftOut(setting.name, setting.field, value, does, setting.default)
            for setting, value in given
            if (does := setting.power(value))
        )

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """What the file that it was read from asked for in vain."""
        return self._left_out

    @property
    def asked(self) -> dict[str, Any]:
        """The settings that may have such power and decide no number: parts of a run
        have them from this sitting.
        """
        return {
            setting.name: getattr(self, setting.field)
            for setting in settings(type(self))
            if setting.power is not none
            and setting.name in self.free
            and setting.name not in PLACE
        }

    def check_powers(self, where: str) -> None:
        """Refuse, by an InputError, settings with power over more than the run: `where`
        is a file that has them.
        """
        for name, _, _, does, _ in self.powers:
            raise InputError(
                f"{where}: {name}: {does}, which such a file can't ask "
                "for; leave it out"
            )

    @classmethod
    def shared(cls, other: Config) -> dict[str, object]:
        """Return the settings that this command and another's have from the same class,
        but for the run's place. Who shares the work is part of that place.
        """
        both = next(
            base
            for base in cls.__mro__
            if issubclass(base, Config) and isinstance(other, base)
        )
        apart = (*PLACE, "workers", "cluster", *cls.without, *other.without)
        return {
            name: getattr(other, name)
            for name in both.model_fields
            if name not in apart
        }

    @classmethod
    def of(cls, other: Config, **changes: object) -> Self:
        """Return what another command's configuration describes as one of this, in a
        place of its own: the settings that are `shared`, but for the changes.
        """
        return cls(**{**cls.shared(other), **changes}).with_python_parts_of(other)

    @property
    def only_here(self) -> tuple[PythonOnly, ...]:
        """Its parts that exist only in this Python session."""
        return self._only_here

    def with_only_here(self, parts: Sequence[PythonOnly]) -> Self:
        """Return a copy with other parts that exist only in this Python session."""
        copy = self.model_copy()
        copy._only_here = tuple(parts)
        return copy

    def python_object(self, role: str, name: str) -> Any:
        """Return the object that a Python caller passed for a name in these settings;
        None if there is only the name.

        Args:
            role: "scene", "model" or "control".
            name: of the object, as the settings have it.
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
        return self.with_only_here(other.only_here).with_python_objects(
            other._python_objects
        )

    def to_yaml(self) -> str:
        """Return the YAML form; `from_yaml` of it gives an equal configuration, where
        no `powers` are in it.
        """
        data = {"schema": written.SCHEMA, "command": self.command, **self.plain()}
        note = ""
        if self._only_here:
            note = f"# But it can't be: {python_only_text(self.python_only)}\n"
        return written.HEADER + note + str(yaml.safe_dump(data, sort_keys=False))

    def plain(self) -> JsonObject:
        """Return every setting by the name it has in YAML, as JSON values."""
        return self.model_dump(by_alias=True, mode="json")

    @property
    def place(self) -> tuple[str | None, bool]:
        """Where a run of this is kept, if that is said, and whether what is there is
        replaced.
        """
        return getattr(self, "run", None), getattr(self, "overwrite", False)

    @property
    def title(self) -> tuple[str, ...]:
        """What names a run of this whose place is not said."""
        return (self.command,)

    def to_repeat(self) -> Self:
        """Return what `run.yaml` holds: no place for the run (a repetition gets its
        own) and files by absolute path.
        """
        named = {
            name: value
            for name in FILES
            if (value := getattr(self, name, None)) is not None
        }
        absolute = {
            name: ",".join(map(_absolute, written.split_names(value)))
            for name, value in named.items()
        }
        return self.model_copy(update={**absolute, **PLACE})

    def command_line(self, run: str | Path | None) -> str | None:
        """Return the shell command that repeats the run of this that is kept in a
        folder; None where none does.
        """
        if run is None or self._only_here:
            return None
        return shlex.join(["advsearch", "run", str(Path(run) / written.CONFIG)])

    @property
    def python_only(self) -> list[str]:
        """The parts that exist only in this Python session, in words."""
        return [part.text for part in self._only_here]

    def deciding(self) -> JsonObject:
        """Return the settings that decide a run's numbers, as JSON values: all that are
        not `free`. Files have their names only, since they may have been moved.
        """
        given = {
            name: value for name, value in self.plain().items() if name not in self.free
        }
        for name in FILES:
            if isinstance(value := given.get(name), str):
                given[name] = ",".join(
                    "+".join(Path(path).name for path in split_paths(part))
                    for part in written.split_names(value)
                )
        return given


def _check_shallow(config: type[Config], data: Mapping[str, Any]) -> None:
    deep = {name: value for name, value in data.items() if not is_shallow(value)}
    if deep:
        raise _settings_error(
            config, [{"loc": (name,), "input": deep[name], "type": ""} for name in deep]
        )


def _mappings_from_texts(
    config: type[Config], data: Mapping[str, Any]
) -> dict[str, Any]:
    """Return values of settings; those of mappings that are written as a text, or as
    several, are read.
    """
    values = dict(data)
    for setting in settings(config):
        if not setting.is_mapping:
            continue
        for name in {setting.name, setting.field} & values.keys():
            value = values[name]
            texts = [value] if isinstance(value, str) else value
            if isinstance(texts, (list, tuple)) and all(
                isinstance(text, str) for text in texts
            ):
                try:
                    values[name] = setting.read_texts(texts, setting.name)
                except ValueError:
                    got = texts[0] if len(texts) == 1 else texts
                    raise _settings_error(
                        config, [{"loc": (name,), "input": got, "type": ""}]
                    ) from None
    return values


def python_only_text(parts: Sequence[str]) -> str:
    """Return why no command repeats a run with parts that existed only in Python."""
    *first, last = map(written.shown, parts)
    listed = f"{', '.join(first)} and {last}" if first else last
    return (
        f"{listed} {'exist' if first else 'exists'} only in the Python session "
        "that "
        "asked."
    )


def _settings_error(config: type[Config], errors: Sequence[Any]) -> AdvsearchError:
    declared = settings(config)
    known = {each.name: each for each in declared} | {
        each.field: each for each in declared
    }
    problems: dict[str, str] = {}
    for error in errors:
        name = str(error["loc"][0])
        if name not in known:
            return UnknownNameError("setting", name, {each.name for each in declared})
        got = "nothing" if error["type"] == "missing" else written.shown(error["input"])
        if known[name].is_mapping and len(error["loc"]) > 1:
            got = f"{error['loc'][1]}={got}"
        problems.setdefault(
            known[name].name, f"expected {known[name].expects}, got {got}"
        )
    return SettingsError(tuple(problems.items()))


def _absolute(name: str) -> str:
    # of two files as in camera.csv+object.csv, that of each; of what is no file, its
    # name
    if len(both := split_paths(name)) > 1:
        return "+".join(map(_absolute, both))
    path, mark, part = (name, "", "") if os.path.isfile(name) else name.partition("#")
    is_path = ("/" in path or Path(path).suffix != "") and os.path.isfile(path)
    return f"{Path(path).resolve()}{mark}{part}" if is_path else name
