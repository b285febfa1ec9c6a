"""What is declared of a setting, for the help, the docs, errors and checks alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args, get_origin

from pydantic import Field

from advsearch.files import JsonObject

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from advsearch.settings.configuration import Config


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


def _default(value: object) -> str:
    if isinstance(value, dict):
        return ",".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)


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
