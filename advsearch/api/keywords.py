"""The settings of each experiment as keywords: what Python callers may write for them.

A setting is declared once: its default, its range, what it is. In Python more may be
written for it than the text of a file (`hint_of`). Signatures and docstrings are made
from both (`asks`). Type checkers read the keywords of `attack` and `sweep` in code:
`SceneKeywords` and its subclasses.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import wraps
from pathlib import Path
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from torch import nn

from advsearch.calls import check_types, unexpected
from advsearch.config import SEVERAL
from advsearch.engine import loading
from advsearch.engine.naming import (
    CONTROL,
    MODEL,
    SCENE,
    check_not_of_scene,
    check_not_spread,
    exists_here,
    in_turn,
    model_name,
)
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.options import told
from advsearch.progress import watched
from advsearch.settings import Config, PythonOnly, as_python, settings
from advsearch.trust.code import allow_named
from advsearch.trust.stored_files import is_shallow

Names = str | Sequence[str]  # names in a list, or in a text with commas between them


class SceneKeywords(TypedDict, total=False):
    """Settings that `attack` and `sweep` both take as keywords; their docstrings say
    what each is.
    """

    environment: Path | Names | None
    up: Literal["y", "z"] | None
    facing: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None
    size: float | None
    unit: Literal["mm", "cm", "m", "in"] | None
    camera: str | Path | None
    set: Mapping[str, float | str | Sequence[float]] | None
    things: str | Path | None
    judge: str | Path
    exposure: float
    resolution: int | str | tuple[int, int] | None
    labels: Path | Names | None
    prompt: Path | Names | None
    value_range: str | Sequence[float] | None
    ask: Mapping[str, Any]
    label: int | np.integer[Any] | Names | None
    texture_resolution: int | None
    denoise: Literal["oidn", "none"]
    pixel_sampler: Literal["independent", "multijitter"]
    seed: int
    threads: int | None
    deterministic: bool
    overwrite: bool
    specialise: bool
    aov: str | Path | None
    log: Literal["mlflow", "tensorboard", "wandb"] | None
    path: str | Path | None
    shutter: float | None
    rolling: float | None
    verify_spp: int | None
    workers: int | None
    cluster: str | Path | None


class _Signature(inspect.Signature):
    """A signature with all settings, for editors; `help` writes the `short` one, with
    `**settings` in their place: it lists them below.
    """

    __slots__ = ("short",)
    short: Any

    def __str__(self) -> str:
        return str(self.short) if hasattr(self, "short") else super().__str__()

    def format(self, **options: Any) -> str:
        """See `inspect.Signature.format`, of Python 3.13."""
        return str(self.short.format(**options))


ONLY_BY_NAME = inspect.Parameter.KEYWORD_ONLY
RUN = {
    "run": inspect.Parameter(
        "run", ONLY_BY_NAME, default=None, annotation="str | Path | None"
    )
}
KEPT = "The run is kept, in `run` or under runs/."
SAME = {
    "object": "from `load_scene`, or the name of an object, or a file of one.",
    "model": "from `load_model`, or what that takes.",
    "progress": "True shows a bar, False none, None one on a terminal; or told how far "
    "it is.",
}
RAISED = "InputError: anything that the caller can put right; nothing is written then."
"""What the docstrings of many questions say alike: of the run, of arguments, and of
errors.
"""
Function = TypeVar("Function", bound=Callable[..., Any])
Made = TypeVar("Made", bound=Config)


def asks(config: type[Config]) -> Callable[[Function], Function]:
    """Give a function that takes settings as `**settings` the signature and the
    docstring that they come to. Every setting becomes a keyword with the default that
    it is declared with, and a line among the arguments. One that the function has of
    its own stays as it is there.
    """

    def decorate(function: Function) -> Function:
        own = inspect.signature(function)
        plain = [
            one for one in own.parameters.values() if one.kind is not one.VAR_KEYWORD
        ]
        added = []
        lines = []
        for one in settings(config):
            name = one.field.removesuffix("_")
            if name in own.parameters or one.required:
                continue
            hint = hint_of(one.field, config.model_fields[one.field].annotation)
            added.append(
                inspect.Parameter(
                    name, ONLY_BY_NAME, default=one.default, annotation=hint
                )
            )
            lines.append(
                textwrap.fill(f"{name}: {one.text}", 110, subsequent_indent="    ")
            )
        signature = _Signature(
            [*plain, *added], return_annotation=own.return_annotation
        )
        signature.short = own

        @wraps(function)
        def asked(*args: Any, **given: Any) -> Any:
            if error := unexpected(
                function.__name__, given, list(signature.parameters)
            ):
                raise error
            check_types(
                {**own.parameters, **RUN},
                {**dict(zip(own.parameters, args, strict=False)), **given},
            )
            try:
                bound = signature.bind(*args, **given)
            except TypeError as error:
                raise TypeError(f"{function.__name__}() {error}") from None
            allow_named({**bound.arguments, **given})
            kept = ("scene", "model", "beside", "progress", "metrics", "tracker")
            plain = {
                key: one if key in kept or not is_shallow(one) else as_python(one)
                for key, one in given.items()
            }
            with ExitStack() as stack:
                stack.enter_context(in_turn())
                if "progress" in own.parameters:
                    plain["progress"] = stack.enter_context(
                        watched(plain.get("progress"))
                    )
                for key in {
                    "task",
                    "objective",
                    "policy",
                } & plain.keys() - own.parameters.keys():
                    if not isinstance(plain[key], (str, Mapping, type(None))):
                        raise InputError(
                            f"{key}: expected a name for {function.__name__}, got "
                            f"{told(plain[key])}; `attack` "
                            "takes your own, and `sweep` a task of your own"
                        )
                return function(*args, **plain)

        asked.__doc__ = _docstring(
            function.__doc__ or "", [one.name for one in plain], config.command, lines
        )
        asked.__signature__ = signature  # type: ignore[attr-defined]
        return asked  # type: ignore[return-value]

    return decorate


WRITTEN = {
    "controls": "Controls", "over": "Controls", "label": "int | np.integer[Any] | "
                                                         "Names | None",
    "resolution": "int | str | tuple[int, int] | None", "set_": "Mapping[str, float | str | Sequence[float]] | None",
    "estimators": "str | Mapping[str, str]", "value_range": "str | Sequence[float] | "
                                                            "None",
}  # fmt: skip
"""What may be written for some settings beside what they become."""
LISTED = (*SEVERAL, "prompt", "vary", "ways", "quantities", "samplers", "case", "group")
"""Settings that may be a list of names."""


def hint_of(field: str, kind: Any) -> str:
    """Return what Python callers may write for a setting that is declared as `kind`:
    for a text also a path, and for what may be several names a list.
    """
    text = (
        inspect.formatannotation(kind)
        .replace("typing.", "")
        .replace("NoneType", "None")
    )
    # bounds are no part of a hint
    text = re.sub(r"Annotated\[(\w+), .*?\]\)\]", r"\1", text)
    # a recipe's may be one of each object
    if field in WRITTEN and not (field == "label" and "dict" in text):
        return WRITTEN[field]
    match = re.fullmatch(r"Optional\[(.*)\]", text)
    parts = [match[1], "None"] if match else re.split(r" \| (?![^\[]*\])", text)
    wider = {"str": "Path | Names" if field in LISTED else "str | Path"}
    return " | ".join(
        re.sub(r"^dict\[.*", "Mapping[str, Any]", wider.get(one, one)) for one in parts
    )


def _docstring(
    text: str, names: Sequence[str], command: str, settings: Sequence[str]
) -> str:
    """A question's own docstring (what it does, and arguments that `SAME` does not
    describe) with what all of them say: where the run is kept, their arguments by
    `names`, a line for each setting, and what is raised.
    """
    said, _, own = inspect.cleandoc(text).partition("\n\nArgs:\n")
    if "other arguments are the settings of" not in " ".join(said.split()):
        said += (
            f"\n\nAll other arguments are the settings of `advsearch {command}`. {KEPT}"
        )
    told = {
        one.partition(":")[0]: one.rstrip()
        for one in re.split(r"(?m)^(?=\w+: )", textwrap.dedent(own))
        if one
    }
    listed = [told.get(name, f"{name}: {SAME.get(name)}") for name in names] + [
        *settings
    ]
    return f"{said}\n\nArgs:\n{textwrap.indent(chr(10).join(listed), '    ')}\n\nRaises:\n    {RAISED}"


def configured(config: type[Made], **given: Any) -> Made:
    """Return a configuration of settings as Python has them; None is one that was not
    given.

    A scene, a model and controls may be objects: the settings name them, hold them
    (`Config.python_object`), and know which of them exist only in this session.
    """
    settings = {name: value for name, value in given.items() if value is not None}
    objects: dict[tuple[str, str], Any] = {}
    only_here: list[PythonOnly] = []

    scene = settings.get("object")
    model = settings.get("model")
    if isinstance(scene, loading.Scene) or isinstance(model, (Model, nn.Module)):
        check_not_spread(settings)
    if isinstance(model, (Model, nn.Module)):
        settings["model"] = model_name(model)
        objects[MODEL, settings["model"]] = model
        only_here += (
            [PythonOnly("model", settings["model"])] if exists_here(model) else []
        )
    if isinstance(scene, loading.Scene):
        check_not_of_scene(
            {name: value for name, value in settings.items() if name != "object"}
        )
        described = loading.scene_as_settings(scene)
        settings |= {
            name: value for name, value in described.items() if value is not None
        }
        objects[SCENE, settings["object"]] = scene
        only_here += [PythonOnly("scene")] if scene.only_here else []
    for name in ("controls", "over"):
        controls: Any = settings.get(name)
        instances = loading.instances_in(controls)
        if instances or isinstance(controls, Mapping):
            if loading.only_here(controls):
                check_not_spread(settings)
            objects |= {(CONTROL, control.name): control for control in instances}
            only_here += [
                PythonOnly("control", kind) for kind in loading.only_here(instances)
            ]
            settings[name] = loading.settings_of(controls)
    return config(**settings).with_python_objects(objects).with_only_here(only_here)
