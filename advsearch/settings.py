"""The machinery of a typed configuration: settings with one description each, read from YAML, flags and Python alike.

`config` declares the settings themselves.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from advsearch.errors import AdvsearchError, FileFormatError, InputError, UnknownNameError
from advsearch.files import JsonObject, read_text
from advsearch.yaml_text import LARGEST, parse_yaml

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo
    from typing_extensions import Self

SCHEMA = 1
"""Version of the YAML form."""

HEADER = "# A run of advsearch. To repeat it: advsearch run FILE\n"
"""First line of every `run.yaml` that advsearch writes; a run directory is recognised by it."""

PLACE: Mapping[str, bool | None] = {"run": None, "overwrite": False}
"""The settings that say where a run is kept, not what it does, as a repetition has them."""

MOST_BASES = 4
"""Most files that a `base` names, and most that are one another's base."""

FILES = ("object", "environment", "model", "labels")
"""The settings that may name files."""


NAMED = ("policy", "task")
"""The settings that are a name, or a `name` with options."""


class SettingsError(InputError):
    """One or more settings have values that are not allowed.

    Attributes:
        problems: pairs of a setting's name and what is wrong with it.
    """

    def __init__(self, problems: tuple[tuple[str, str], ...], file: str | Path = "") -> None:
        where = f"{file}: " if file else ""
        super().__init__("; ".join(f"{where}{name}: {text}" for name, text in problems))
        self.problems = problems


Form = Literal["text", "switch", "names", "assignments", "axes", "choices", "controls"]
"""How a setting is written on a command line: as text; as a flag alone; or as what may come again: names, NAME=VALUE,
NAME=VALUES, NAME=CHOICE or a choice for all, NAME or NAME={OPTION: VALUE}."""


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
    form: Form = "text",
    switched: str = "",
    **constraints: Any,
) -> Any:
    """Return a pydantic field.

    Args:
        default: the default, a function that makes it, or ... for none.
        group: heading in the help.
        description: what it is.
        expects: completes "expected ..." in errors, and names the range in the help; empty where type and constraints
            say it.
        unit: of the value.
        otherwise: what a default of None comes to.
        flag: its flag, where that is not its name: "--control".
        metavar: what stands for the value in the help, where that is not the last word of its name.
        form: how it is written on a command line; what is true or false is a switch.
        switched: what the flag does, where that is the opposite of the description.
        constraints: as of `pydantic.Field`.
    """
    notes: JsonObject = {"group": group, "expects": expects, "unit": unit, "otherwise": otherwise, "flag": flag}
    notes |= {"metavar": metavar, "form": form, "switched": switched}
    declared: Any = {"default": default, "description": description, **notes, **constraints}
    alias = constraints.pop("alias", None)
    make = {"default_factory": default} if callable(default) else {"default": default}
    extra = {**notes, "declared": declared}
    return Field(**make, description=description, json_schema_extra=extra, alias=alias, **constraints)


def setting_as_in(config: type[Config], field: str, **changes: Any) -> Any:
    """Return a setting as another command declares it, but for some of the arguments of `setting`."""
    extra: Any = config.model_fields[field].json_schema_extra
    return setting(**{**extra["declared"], **changes})


class Clash(NamedTuple):
    """A setting that says nothing, or the opposite of another one, beside others.

    Attributes:
        setting: its field. It counts as given where it differs from its default.
        with_others: whether the others of a configuration are such.
        why: what is wrong, and what to do; completes "setting: ...".
    """

    setting: str
    with_others: Callable[[Any], object]
    why: str


class Config(BaseModel):
    """What a command needs to know. Frozen; unknown names are refused. Each command's configuration is a subclass.

    Raises:
        InputError: a value is outside its range or an unknown setting is named; the message lists every problem.
    """

    command: ClassVar[str]
    without: ClassVar[tuple[str, ...]] = ()
    """Settings of a class above that the command does not have."""
    clashes: ClassVar[tuple[Clash, ...]] = ()
    free: ClassVar[tuple[str, ...]] = (*PLACE, "threads")
    """Settings that decide no number, so that they may be changed before a run goes on."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False)

    def __init__(self, **data: Any) -> None:
        deep = {name: value for name, value in data.items() if not is_shallow(value)}
        if deep:
            raise _settings_error(type(self), [{"loc": (name,), "input": deep[name], "type": ""} for name in deep])
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise _settings_error(type(self), error.errors(include_url=False)) from None

    @field_validator("*", mode="before")
    @classmethod
    def _no_number_from_bool(cls, value: Any, info: Any) -> Any:
        """Refuse true for a number: YAML's `epsilon: yes` is a slip, not 1."""
        if isinstance(value, bool) and cls.model_fields[info.field_name].annotation is not bool:
            raise ValueError("a truth value is not accepted here")
        return value

    @field_validator("*")
    @classmethod
    def _finite(cls, value: Any) -> Any:
        """Refuse NaN and infinity however deep they are, and whole numbers that no machine has."""
        if not all_finite(value):
            raise ValueError("not finite")
        return value

    @model_validator(mode="after")
    def _without_clashes(self) -> Self:
        """Refuse what would be ignored, and settings that exclude each other."""
        defaults = {one.field: one.default for one in settings(type(self))}
        for name in self.without:
            if getattr(self, name) != type(self).model_fields[name].get_default(call_default_factory=True):
                raise InputError(f"{name}: `advsearch {self.command}` has no such setting; leave it out")
        for clash in self.clashes:
            given = clash.setting not in self.without and getattr(self, clash.setting) != defaults[clash.setting]
            if given and clash.with_others(self):
                raise InputError(f"{clash.setting.rstrip('_')}: {clash.why}")
        return self

    @classmethod
    def from_yaml(cls, path: str | Path, overrides: Mapping[str, object] | None = None) -> Self:
        """Return the configuration that the YAML file at `path` describes, with `overrides` put over it.

        Args:
            path: a file with one mapping from settings to values; `schema`, `command` and `base` may stand beside
                them (see `read_yaml`).
            overrides: setting to value; a dotted name reaches inside: ``set.camera.azimuth``, ``controls.pose.yaw``.

        Raises:
            FileFormatError: the file is missing, empty or not such a mapping.
            InputError: as for the class; the message names the file.
        """
        data = {name: value for name, value in read_yaml(path).items() if name not in ("schema", "command")}
        for name, value in (overrides or {}).items():
            _put(data, name, value)
        try:
            return cls(**data)
        except SettingsError as error:
            raise SettingsError(error.problems, path) from None

    @classmethod
    def shared(cls, other: Config) -> dict[str, object]:
        """Return the settings that this command and another's have from the same class, but for the run's place."""
        both = next(one for one in cls.__mro__ if issubclass(one, Config) and isinstance(other, one))
        apart = (*PLACE, *cls.without, *other.without)
        return {name: getattr(other, name) for name in both.model_fields if name not in apart}

    @classmethod
    def of(cls, other: Config, **changes: object) -> Self:
        """Return what another command's configuration describes as one of this, in a place of its own.

        Args:
            other: gives the settings that are `shared`.
            **changes: settings that are different.
        """
        return cls(**{**cls.shared(other), **changes})

    def to_yaml(self) -> str:
        """Return the YAML form; `from_yaml` of it gives an equal configuration."""
        data = {"schema": SCHEMA, "command": self.command, **self.plain()}
        return HEADER + str(yaml.safe_dump(data, sort_keys=False))

    def plain(self) -> JsonObject:
        """Return every setting by the name it has in YAML, as JSON values."""
        return self.model_dump(by_alias=True, mode="json")

    @property
    def place(self) -> tuple[str | None, bool]:
        """Where a run of this is kept, if that is said, and whether what is there is replaced."""
        return getattr(self, "run", None), getattr(self, "overwrite", False)

    @property
    def title(self) -> tuple[str, ...]:
        """What names a run of this whose place is not said."""
        return (self.command,)

    def recipe(self) -> Self:
        """Return what `run.yaml` holds: no place for the run (a repetition gets its own) and files by absolute path."""
        places = {name: _absolute(getattr(self, name)) for name in FILES if name in type(self).model_fields}
        return self.model_copy(update={**places, **PLACE})

    def deciding(self) -> JsonObject:
        """Return the settings that decide a run's numbers, as JSON values: all that are not `free`. Files have their
        names only, since they may have been moved."""
        given = {name: value for name, value in self.plain().items() if name not in self.free}
        files = {name: _bare(value) for name in FILES if isinstance(value := given.get(name), str)}
        return {**given, **files}

    def command_line(self) -> str:
        """Return the shell command that repeats this in a place of its own: all settings that are not the default."""
        words = ["advsearch", self.command]
        for one in settings(type(self)):
            value = getattr(self, one.field)
            if value != one.default and one.field not in PLACE:
                words += _as_flags(one, value)
        return shlex.join(words)


@dataclass(frozen=True)
class Setting:
    """What the help and the docs say about one setting.

    Attributes:
        field: attribute of the configuration.
        name: its name in YAML.
        flag: its flag on the command line.
        group: the heading it stands under: scene, model, search, verification or run.
        description: what it is.
        expects: the values it takes, with their range.
        unit: the unit of the value; may be empty.
        default: the default; None when there is none.
        otherwise: what a default of None comes to; may be empty.
        required: whether it must be given.
        metavar: what stands for its value in the help.
        form: how it is written on a command line.
        switched: what its flag does, where that is the opposite of the description; may be empty.
    """

    field: str
    name: str
    flag: str
    group: str
    description: str
    expects: str
    unit: str
    default: Any
    otherwise: str
    required: bool
    metavar: str
    form: Form
    switched: str

    @property
    def text(self) -> str:
        """What it is, its values with range and unit, and its default."""
        unit = f", in {self.unit}" if self.unit else ""
        default = self.otherwise if self.default is None else _default(self.default)
        return f"{self.description}: {self.expects}{unit}" + (f" (default: {default})" if default else "")


def _default(value: object) -> str:
    if isinstance(value, dict):
        return ",".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def settings(config: type[Config]) -> tuple[Setting, ...]:
    """Return every setting of a configuration, in the order in which they are shown."""
    declared = []
    for field, info in config.model_fields.items():
        if field in config.without:
            continue
        notes: Any = info.json_schema_extra
        declared.append(
            Setting(
                field=field,
                name=info.alias or field,
                flag=notes["flag"] or "--" + field.replace("_", "-"),
                group=notes["group"],
                description=info.description or "",
                expects=notes["expects"] or _expected(info),
                unit=notes["unit"],
                default=None if info.is_required() else info.get_default(call_default_factory=True),
                otherwise=notes["otherwise"],
                required=info.is_required(),
                metavar=notes["metavar"] or field.rpartition("_")[2].upper(),
                form="switch" if info.annotation is bool else notes["form"],
                switched=notes["switched"],
            )
        )
    return tuple(declared)


def _expected(info: FieldInfo) -> str:
    """What type and constraints of a field say of its values."""
    kinds = [one for one in get_args(info.annotation) or (info.annotation,) if one is not type(None)]
    if kinds == [bool]:
        return "true or false"
    if get_origin(info.annotation) is Literal or get_origin(kinds[0]) is Literal:
        *first, last = kinds if get_origin(info.annotation) is Literal else get_args(kinds[0])
        return f"{', '.join(first)} or {last}"
    limits = {name: getattr(one, name) for one in info.metadata for name in ("ge", "gt", "le") if hasattr(one, name)}
    number = "a whole number" if kinds == [int] else "a number"
    most = limits["le"] if kinds == [int] else f"{limits['le']:g}".replace("e+0", "e")
    if "gt" in limits:
        return f"{number} greater than {limits['gt']:g} and at most {most}"
    return f"{number} from {limits['ge']:g} to {most}"


def read_yaml(path: str | Path, above: tuple[Path, ...] = ()) -> dict[str, object]:
    """Return the mapping in the YAML file at `path`, laid over the files that its `base` names.

    A base is a file, or a list of files of which a later one goes over an earlier one; mappings are merged.

    Args:
        path: the file.
        above: the files that have named this one as their base.

    Raises:
        FileFormatError: the file is missing, empty, not text, not YAML or not a mapping with names as keys.
    """
    try:
        data = parse_yaml(read_text(Path(path), "a YAML file", LARGEST))
    except OSError as error:
        raise FileFormatError(f"{path}: expected a YAML file, got {error.strerror}; check the path") from None
    except ValueError as error:
        raise FileFormatError(f"{path}: expected YAML, got {error}; correct the file") from None
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        got = "an empty file" if data is None else type(data).__name__
        raise FileFormatError(f"{path}: expected settings and values such as 'object: mug', got {got}")
    if data.get("schema", SCHEMA) != SCHEMA:
        got = _shown(data["schema"])
        raise FileFormatError(f"{path}: expected schema {SCHEMA}, got {got}; it is of another advsearch")
    return _with_base(data, Path(path), above)


def merged(under: Mapping[str, object], over: Mapping[str, object]) -> dict[str, object]:
    """Return `over` laid over `under`: mappings are merged, and everything else is replaced."""
    result = dict(under)
    for name, value in over.items():
        inner = result.get(name)
        both = isinstance(inner, Mapping) and isinstance(value, Mapping)
        result[name] = merged(inner, value) if both else value  # type: ignore[arg-type]
    return result


def _with_base(data: dict[str, object], path: Path, above: tuple[Path, ...]) -> dict[str, object]:
    """Lay the settings over those of the files that their `base` names, relative to the file itself."""
    bases = data.pop("base", None) or []
    bases = [bases] if isinstance(bases, str) else bases
    if not isinstance(bases, list) or not all(isinstance(one, str) for one in bases):
        raise FileFormatError(f"{path}: base: expected a file or a list of files, got {_shown(bases)}")
    here = path.resolve()
    if len(above) >= MOST_BASES or len(bases) > MOST_BASES:
        raise FileFormatError(f"{path}: base: expected at most {MOST_BASES} files, one over the other, got more")
    if bases and here in above:
        raise FileFormatError(f"{path}: base: the file is a base of itself; take it out of one of them")
    result: dict[str, object] = {}
    for base in bases:
        result = merged(result, read_yaml(path.parent / base, (*above, here)))
    return merged(result, data)


def parse_assignment(text: str, where: str) -> tuple[str, Any]:
    """Return the name and the value of ``NAME=VALUE``; the value is read as YAML, and as plain text where it is none.

    Args:
        text: the assignment.
        where: what the error names: ``"--set"``, say.

    Raises:
        InputError: there is no ``=``, or the name is empty.
    """
    name, separator, value = text.partition("=")
    if not (separator and name.strip()):
        raise InputError(f"{where}: expected NAME=VALUE such as camera.azimuth=130, got {text!r}")
    try:
        return name.strip(), parse_yaml(value) if value.strip() else ""
    except ValueError:
        return name.strip(), value.strip()


def _settings_error(config: type[Config], errors: Sequence[Any]) -> AdvsearchError:
    """Return pydantic's findings (`ValidationError.errors`) as one error of ours: one problem a setting."""
    declared = settings(config)
    known = {one.name: one for one in declared} | {one.field: one for one in declared}
    problems: dict[str, str] = {}
    for error in errors:
        name = str(error["loc"][0])
        if name not in known:
            return UnknownNameError("setting", name, {one.name for one in declared})
        got = "nothing" if error["type"] == "missing" else _shown(error["input"])
        if known[name].form in ("assignments", "controls") and len(error["loc"]) > 1:
            got = f"{error['loc'][1]}={got}"
        problems.setdefault(known[name].name, f"expected {known[name].expects}, got {got}")
    return SettingsError(tuple(problems.items()))


def number_or_text(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def _shown(value: Any) -> str:
    """Return `value` for an error message: plain, printable and not too long."""
    try:
        text = value if isinstance(value, str) and value.strip() and value.isprintable() else repr(value)
    except (RecursionError, ValueError):  # nested too deep, or a whole number of thousands of digits
        text = f"a {type(value).__name__} that is too long to show"
    return text if len(text) <= 80 else text[:77] + "..."


DEEPEST = 16
"""Lists and mappings inside one another that a setting may have."""

LARGEST_WHOLE = 2**63 - 1


def is_shallow(value: Any, levels: int = DEEPEST) -> bool:
    """Return whether lists and mappings are nested at most so deep in `value`."""
    inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, (list, tuple)) else ()
    return levels >= 0 and all(is_shallow(one, levels - 1) for one in inner)


def all_finite(value: Any) -> bool:
    """Return whether all numbers in `value`, which `is_shallow`, are finite; whole ones at most 2**63 - 1."""
    if isinstance(value, Mapping):
        return all(all_finite(inner) for inner in value.values())
    if isinstance(value, (list, tuple)):
        return all(all_finite(inner) for inner in value)
    if isinstance(value, int):
        return abs(value) <= LARGEST_WHOLE
    return not isinstance(value, float) or math.isfinite(value)


def _put(data: dict[str, object], name: str, value: object) -> None:
    """Set a dotted name in nested mappings. What follows ``set.`` is one name, since parameters have dots in theirs."""
    first, _, rest = name.partition(".")
    if not rest:
        data[first] = value
        return
    there, inner = data.get(first), dict[str, object]()
    if isinstance(there, str):
        inner = {"name": there} if first in NAMED else {there: None}
    elif isinstance(there, list):
        inner = {key: None for key in there}
    elif isinstance(there, dict):
        inner = dict(there)
    if first in ("set", "grid"):
        inner[rest] = value
    else:
        _put(inner, rest, value)
    data[first] = inner


def split_names(text: str) -> tuple[str, ...]:
    """Return the parts of ``mug,bowl``; a file whose name has a comma is one part."""
    if "," not in text or _is_file(text):
        return (text,)
    return tuple(part.strip() for part in text.split(",") if part.strip())


def check_once(names: Iterable[str], setting: str) -> None:
    """Check that nothing is given twice.

    Raises:
        InputError: a name comes twice; the message names the setting.
    """
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{setting}: {twice[0]} is given twice; leave one of them out")


def _is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except OSError:  # longer than a file's name may be
        return False


def _bare(value: str) -> str:
    """Return names with no folders before them."""
    return ",".join(Path(part).name for part in split_names(value))


def _absolute(value: str | None) -> str | None:
    """Return the absolute path of `value` where it is a file, and the name it is otherwise; of a list, each part."""
    return None if value is None else ",".join(map(_absolute_file, split_names(value)))


def _absolute_file(name: str) -> str:
    is_path = ("/" in name or Path(name).suffix != "") and _is_file(name)
    return str(Path(name).resolve()) if is_path else name


def _as_flags(setting: Setting, value: Any) -> list[str]:
    """Return the words of a command line that give `setting` the value."""
    if setting.form == "switch":
        return [setting.flag]
    if setting.form in ("assignments", "axes", "choices"):
        return [word for name, given in value.items() for word in (setting.flag, f"{name}={_number(given)}")]
    if setting.form == "controls":
        plain, tuned = [name for name in value if not value[name]], [name for name in value if value[name]]
        words = [setting.flag, ",".join(plain)] if plain else []
        return words + [word for name in tuned for word in (setting.flag, f"{name}={_flow(value[name])}")]
    if setting.field == "epsilon" and isinstance(value, (dict, tuple)):
        pairs = [f"{name}={_number(given)}" for name, given in value.items()] if isinstance(value, dict) else value
        return [setting.flag, ",".join(str(one) for one in pairs)]
    if setting.field in NAMED and isinstance(value, dict):
        options = {name: given for name, given in value.items() if name != "name"}
        return [setting.flag, f"{value['name']}={_flow(options)}"]
    if setting.field == "resolution":
        return ["--resolution", "x".join(str(side) for side in value)]
    return [f"{setting.flag}={_number(value)}"] if str(value).startswith("-") else [setting.flag, _number(value)]


def _flow(value: Any) -> str:
    """Return `value` as YAML on one line."""
    return str(yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)).strip()


def _number(value: Any) -> str:
    """Return a value as it is typed: 130 for 130.0, [0,0,1] for a list."""
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(_number(part) for part in value) + "]"
    return repr(int(value)) if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 else str(value)
