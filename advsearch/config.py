"""The typed description of a run: what YAML files, flags and Python calls all become.

Each setting states its flag, unit, range and default once, here; the command line's help and the docs are made from
that (`settings`). Names of objects, controls, policies and the rest are checked by whoever looks them up, not here, so
that this module stays light.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from advsearch.errors import AdvsearchError, FileFormatError, InputError, UnknownNameError

SCHEMA = 1
"""Version of the YAML form."""

HEADER = "# A run of advsearch. To repeat it: advsearch run FILE\n"
"""First line of every `run.yaml` that advsearch writes; a run directory is recognised by it."""


SEARCH_SPP = {"oidn": 8, "none": 16}
"""Samples a pixel of a search that asks for none. `benchmarks/formation.py` shows the noise that is left at each."""

PLACE: dict[str, Any] = {"run": None, "overwrite": False}
"""The settings that say where a run is kept, not what it does, as a repetition has them."""


class SettingsError(InputError):
    """One or more settings have values that are not allowed.

    Attributes:
        problems: pairs of a setting's name and what is wrong with it.
    """

    def __init__(self, problems: tuple[tuple[str, str], ...], spell: Callable[[str], str] = str) -> None:
        super().__init__("; ".join(f"{spell(name)}: {text}" for name, text in problems))
        self.problems = problems

    def spelled(self, spell: Callable[[str], str]) -> SettingsError:
        """Return the same error with each setting's name as `spell` writes it: ``--epsilon`` for ``epsilon``, say."""
        return SettingsError(self.problems, spell)


def _setting(
    default: Any, group: str, description: str, expects: str, *, unit: str = "", otherwise: str = "", **constraints: Any
) -> Any:
    """Return a pydantic field.

    Args:
        default: the default, a function that makes it, or ... for none.
        group: heading in the help.
        description: what it is.
        expects: completes "expected ..." in errors, and names the range in the help.
        unit: of the value.
        otherwise: what a default of None comes to.
        constraints: as of `pydantic.Field`.
    """
    notes: dict[str, Any] = {"group": group, "expects": expects, "unit": unit, "otherwise": otherwise}
    alias = constraints.pop("alias", None)
    make = {"default_factory": default} if callable(default) else {"default": default}
    return Field(**make, description=description, json_schema_extra=notes, alias=alias, **constraints)


class AttackConfig(BaseModel):
    """Everything that decides what `attack` does. Frozen; unknown names are refused.

    A file is looked for relative to the current directory. None means "choose for me", and the description says how.

    Raises:
        InputError: a value is outside its range or an unknown setting is named; the message lists every problem.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False)

    object: str = _setting(
        ...,
        "scene",
        "what the model should recognise",
        "the name of an object or a .obj, .ply, .glb, .gltf or .stl file",
    )
    environment: str = _setting(
        "studio", "scene", "what lights it", "the name of an environment or a .hdr or .exr file"
    )
    up: Literal["y", "z"] | None = _setting(
        None, "scene", "axis of an imported object that points up", "y or z", otherwise="found from the file"
    )
    set_: dict[str, float | str | tuple[float, ...]] = _setting(
        dict,
        "scene",
        "fix a parameter of the scene, such as camera.azimuth=130",
        "PARAMETER=VALUE with a finite number, a name or a list of numbers",
        alias="set",
    )
    exposure: float = _setting(
        0.0, "scene", "brightness of the picture", "a number from -10 to 10", unit="stops", ge=-10.0, le=10.0
    )
    resolution: tuple[int, int] | None = _setting(
        None,
        "scene",
        "size of the rendered picture",
        "SIDE or HEIGHTxWIDTH, each from 8 to 4096",
        otherwise="what the model takes",
        unit="pixels",
    )

    model: str = _setting(
        "reference",
        "model",
        "the network under test",
        "reference, a .pt2 (torch.export), .pt or .ts (TorchScript) file, package.module:callable, or torchvision:NAME",
    )
    labels: str | None = _setting(
        None, "model", "names of the model's classes", "a JSON or text file", otherwise="the model's own"
    )
    label: str | None = _setting(
        None,
        "model",
        "the right answers, separated by commas",
        'names of classes or their numbers, such as "coffee mug,cup" or #504',
        otherwise="the object's own",
    )

    controls: dict[str, dict[str, Any]] = _setting(
        lambda: {"texture": {}},
        "search",
        "what may change, separated by commas",
        "names of controls, or NAME={PARAMETER: VALUE or [LOW, HIGH]}",
        min_length=1,
    )
    epsilon: float | None = _setting(
        None,
        "search",
        "how far a control may go from where it starts, in its own unit",
        "a number greater than 0",
        otherwise="the control's own",
        gt=0.0,
    )
    norm: Literal["linf", "l2"] = _setting("linf", "search", "how that distance is measured", "linf or l2")
    texture_resolution: int | None = _setting(
        None,
        "search",
        "side of the searched texture",
        "a whole number from 2 to 4096",
        unit="texels",
        otherwise="chosen from the object's own",
        ge=2,
        le=4096,
    )
    estimators: dict[str, str] = _setting(
        dict,
        "search",
        "force how derivatives are obtained",
        "NAME for all controls, or CONTROL=NAME or CONTROL.PARAMETER=NAME; `advsearch plan` shows the names",
        alias="estimator",
    )
    measure: Literal["no", "quick", "full"] = _setting(
        "quick",
        "search",
        "measure which valid estimator of a derivative is best on this scene; full chooses step and samples too",
        "no, quick or full",
    )
    policy: str = _setting("auto", "search", "the rule that proposes configurations", "the name of a policy")
    steps: int = _setting(
        40,
        "search",
        "steps of the search, its budget in renders",
        "a whole number from 1 to 1000000",
        ge=1,
        le=1_000_000,
    )
    step_size: float | None = _setting(
        None,
        "search",
        "first step of the policy as a share of epsilon",
        "a number greater than 0",
        otherwise="the policy's own",
        gt=0.0,
    )
    objective: str = _setting("margin", "search", "what is maximised", "the name of an objective")
    spp: int | None = _setting(
        None,
        "search",
        "samples per pixel of a render of the search",
        "a whole number from 1 to 65536",
        otherwise="8 with the denoiser, 16 without",
        unit="samples",
        ge=1,
        le=65536,
    )
    denoise: Literal["oidn", "none"] = _setting(
        "oidn", "search", "denoiser of every render, in search and verification", "oidn or none"
    )
    baseline: bool = _setting(True, "search", "run a random search with as many renders beside it", "true or false")

    verify_spp: int | None = _setting(
        None,
        "verification",
        "samples per pixel of the verification",
        "a whole number from 1 to 65536",
        otherwise="raised until noise moves nothing",
        unit="samples",
        ge=1,
        le=65536,
    )
    trials: int = _setting(
        20,
        "verification",
        "fresh renders that check the answer, and as many of the clean scene",
        "a whole number from 1 to 100000",
        unit="renders",
        ge=1,
        le=100_000,
    )

    seed: int = _setting(
        0, "run", "root of every random stream", "a whole number from 0 to 2**63 - 1", ge=0, le=2**63 - 1
    )
    threads: int | None = _setting(
        None, "run", "processor threads", "a whole number from 1 to 1024", otherwise="all", ge=1, le=1024
    )
    deterministic: bool = _setting(False, "run", "the same numbers bit for bit, at some cost in time", "true or false")
    run: str | None = _setting(
        None,
        "run",
        "where the run is kept",
        "a name (kept in runs/) or the path of a folder",
        otherwise="runs/OBJECT-CONTROL-NNN",
        min_length=1,
    )
    overwrite: bool = _setting(False, "run", "replace a run that is there already", "true or false")

    def __init__(self, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise _settings_error(error) from None

    @field_validator("*", mode="before")
    @classmethod
    def _no_number_from_bool(cls, value: Any, info: Any) -> Any:
        """Refuse true for a number: YAML's `epsilon: yes` is a slip, not 1."""
        if isinstance(value, bool) and cls.model_fields[info.field_name].annotation is not bool:
            raise ValueError("a truth value is not accepted here")
        return value

    @field_validator("object", "environment", "model", "labels", "label", "policy", "objective", "run", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        """Accept a path for a file, a number or a list of names for labels; refuse what can't be a name."""
        text = str(value) if isinstance(value, (Path, int)) and not isinstance(value, bool) else value
        if isinstance(text, (list, tuple)) and all(isinstance(part, str) for part in text):
            text = ",".join(text)
        if isinstance(text, str) and (not text.strip() or "\0" in text):
            raise ValueError("an empty name")
        return text

    @field_validator("controls", mode="before")
    @classmethod
    def _controls_from_names(cls, value: Any) -> Any:
        """Accept ``"texture"`` and ``["texture", "pose"]`` for controls with nothing set, and an empty YAML value."""
        names = [value] if isinstance(value, str) else value
        if isinstance(names, (list, tuple)):
            return {name: {} for name in names}
        if isinstance(names, Mapping):
            return {name: {} if given is None else given for name, given in names.items()}
        return value

    @field_validator("estimators", mode="before")
    @classmethod
    def _estimators_from_name(cls, value: Any) -> Any:
        """Accept ``differences`` for all controls."""
        return {"*": value} if isinstance(value, str) else value

    @field_validator("resolution", mode="before")
    @classmethod
    def _resolution_from_text(cls, value: Any) -> Any:
        """Accept 224, ``"224"`` and ``"224x320"`` (height by width)."""
        parts = value.lower().split("x") if isinstance(value, str) else value
        if isinstance(parts, int):
            parts = [parts]
        return parts * 2 if isinstance(parts, list) and len(parts) == 1 else parts

    @field_validator("resolution")
    @classmethod
    def _resolution_in_range(cls, value: tuple[int, int] | None) -> tuple[int, int] | None:
        if value is not None and not all(8 <= side <= 4096 for side in value):
            raise ValueError("out of range")
        return value

    @field_validator("set_", mode="before")
    @classmethod
    def _numbers_from_text(cls, value: Any) -> Any:
        """Read ``1e-3`` as a number: YAML takes it for text."""
        return {name: _number_or_text(given) for name, given in value.items()} if isinstance(value, Mapping) else value

    @field_validator("set_", "controls")
    @classmethod
    def _finite_inside(cls, value: Any) -> Any:
        if not _all_finite(value):
            raise ValueError("not finite")
        return value

    @classmethod
    def from_flags(cls, data: Mapping[str, Any]) -> AttackConfig:
        """Return the configuration for settings given as flags; errors name the flag.

        Raises:
            InputError: as for the class.
        """
        try:
            return cls(**data)
        except SettingsError as error:
            raise error.spelled(flag) from None

    @classmethod
    def from_yaml(cls, path: str | Path, overrides: Mapping[str, Any] | None = None) -> AttackConfig:
        """Return the configuration that the YAML file at `path` describes, with `overrides` put over it.

        Args:
            path: a file with one mapping from settings to values; `schema` and `command` may stand beside them.
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
            raise error.spelled(lambda name: f"{path}: {name}") from None

    def to_yaml(self) -> str:
        """Return the YAML form; `from_yaml` of it gives an equal configuration."""
        data = {"schema": SCHEMA, "command": "attack", **self.plain()}
        return HEADER + str(yaml.safe_dump(data, sort_keys=False))

    @property
    def search_spp(self) -> int:
        """Samples a pixel of the search: what was asked for, or the default for the denoiser."""
        return self.spp if self.spp is not None else SEARCH_SPP[self.denoise]

    def plain(self) -> dict[str, Any]:
        """Return every setting by the name it has in YAML, as JSON values."""
        return self.model_dump(by_alias=True, mode="json")

    def recipe(self) -> AttackConfig:
        """Return what `run.yaml` holds: no place for the run (a repetition gets its own) and files by absolute path."""
        places = {name: _absolute(getattr(self, name)) for name in ("object", "environment", "model", "labels")}
        return self.model_copy(update={**places, **PLACE})

    def command_line(self) -> str:
        """Return the shell command that repeats this in a place of its own: all settings that are not the default."""
        words = ["advsearch", "attack"]
        for setting in settings():
            value = getattr(self, setting.field)
            if value != setting.default and setting.field not in PLACE:
                words += _as_flags(setting, value)
        return shlex.join(words)


@dataclass(frozen=True)
class Setting:
    """What the help and the docs say about one setting.

    Attributes:
        field: attribute of `AttackConfig`.
        name: its name in YAML.
        flag: its flag on the command line.
        group: the heading it stands under: scene, model, search, verification or run.
        description: what it is.
        expects: the values it takes, with their range.
        unit: the unit of the value; may be empty.
        default: the default; None when there is none.
        otherwise: what a default of None comes to; may be empty.
        required: whether it must be given.
        is_switch: whether it is true or false.
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
    is_switch: bool


def settings() -> tuple[Setting, ...]:
    """Return every setting of `AttackConfig`, in the order in which they are shown."""
    found = []
    for field, info in AttackConfig.model_fields.items():
        notes: Any = info.json_schema_extra
        found.append(
            Setting(
                field=field,
                name=info.alias or field,
                flag=flag(field),
                group=notes["group"],
                description=info.description or "",
                expects=notes["expects"],
                unit=notes["unit"],
                default=None if info.is_required() else info.get_default(call_default_factory=True),
                otherwise=notes["otherwise"],
                required=info.is_required(),
                is_switch=info.annotation is bool,
            )
        )
    return tuple(found)


def flag(name: str) -> str:
    """Return the flag of the setting `name`: ``texture_resolution`` is ``--texture-resolution``."""
    special = {"controls": "--control", "set_": "--set", "set": "--set"}
    special |= {"estimators": "--estimator", "estimator": "--estimator", "baseline": "--no-baseline"}
    return special.get(name) or "--" + name.replace("_", "-")


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Return the mapping in the YAML file at `path`.

    Raises:
        FileFormatError: the file is missing, empty, not text, not YAML or not a mapping with names as keys.
    """
    try:
        data = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileFormatError(f"{path}: expected a YAML file, got {error.strerror}; check the path") from None
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: expected a YAML file in UTF-8, got bytes that are not text") from None
    except yaml.YAMLError as error:
        raise FileFormatError(f"{path}: expected YAML, got {' '.join(str(error).split())}; correct the file") from None
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        got = "an empty file" if data is None else type(data).__name__
        raise FileFormatError(f"{path}: expected settings and values such as 'object: mug', got {got}")
    if data.get("schema", SCHEMA) != SCHEMA:
        raise FileFormatError(f"{path}: expected schema {SCHEMA}, got {data['schema']!r}; it is of another advsearch")
    return data


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
        return name.strip(), yaml.safe_load(value) if value.strip() else ""
    except yaml.YAMLError:
        return name.strip(), value.strip()


def _settings_error(error: ValidationError) -> AdvsearchError:
    """Return pydantic's findings as one error of ours: one problem a setting."""
    known = {setting.name: setting for setting in settings()} | {setting.field: setting for setting in settings()}
    problems: dict[str, str] = {}
    for found in error.errors(include_url=False):
        name = str(found["loc"][0])
        if name not in known:
            return UnknownNameError("setting", name, {setting.name for setting in settings()})
        got = "nothing" if found["type"] == "missing" else _shown(found["input"])
        if known[name].field in ("set_", "controls") and len(found["loc"]) > 1:
            got = f"{found['loc'][1]}={got}"
        problems.setdefault(known[name].name, f"expected {known[name].expects}, got {got}")
    return SettingsError(tuple(problems.items()))


def _number_or_text(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def _shown(value: Any) -> str:
    """Return `value` for an error message: plain and not too long."""
    text = value if isinstance(value, str) and value.strip() else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _all_finite(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(_all_finite(inner) for inner in value.values())
    if isinstance(value, (list, tuple)):
        return all(_all_finite(inner) for inner in value)
    return not isinstance(value, float) or math.isfinite(value)


def _put(data: dict[str, Any], name: str, value: Any) -> None:
    """Set a dotted name in nested mappings. What follows ``set.`` is one name, since parameters have dots in theirs."""
    first, _, rest = name.partition(".")
    if not rest:
        data[first] = value
        return
    inner = data.get(first)
    inner = {key: None for key in inner} if isinstance(inner, list) else dict(inner) if isinstance(inner, dict) else {}
    if first == "set":
        inner[rest] = value
    else:
        _put(inner, rest, value)
    data[first] = inner


def _absolute(value: str | None) -> str | None:
    """Return the absolute path of `value` where it is a file, and the name it is otherwise."""
    is_path = value is not None and ("/" in value or Path(value).suffix != "") and Path(value).is_file()
    return str(Path(str(value)).resolve()) if is_path else value


def _as_flags(setting: Setting, value: Any) -> list[str]:
    """Return the words of a command line that give `setting` the value."""
    if setting.is_switch:
        return [setting.flag]
    if setting.field == "set_":
        return [word for name, given in value.items() for word in ("--set", f"{name}={_number(given)}")]
    if setting.field == "controls":
        plain, tuned = [name for name in value if not value[name]], [name for name in value if value[name]]
        words = ["--control", ",".join(plain)] if plain else []
        return words + [word for name in tuned for word in ("--control", f"{name}={_flow(value[name])}")]
    if setting.field == "estimators":
        return [word for name, given in value.items() for word in ("--estimator", f"{name}={given}")]
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
