"""Models that Python code builds: ``package.module:callable`` and ``torchvision:NAME``, each with ``@weights``."""

from __future__ import annotations

import difflib
import importlib
import os
import traceback
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from advsearch.errors import ModelError, UnknownNameError
from advsearch.models.model import Model
from advsearch.models.preprocessing import PRESETS
from advsearch.models.probe import first_line
from advsearch.models.source import Source, load_weights, source_of
from advsearch.registry import check_import, current_directory_importable

if TYPE_CHECKING:
    from collections.abc import Iterable


def split_weights(spec: str) -> tuple[str, Path | None]:
    """Return the part before the first ``@`` and the path after it, if there is one."""
    name, _, weights = spec.partition("@")
    return name.strip(), Path(weights.strip()) if weights.strip() else None


# ---------------------------------------------------------------------------------------------------------------------
# package.module:callable


def load_callable(spec: str) -> Source | Model:
    """Return the model behind ``package.module:callable[@weights.safetensors]``.

    The module is looked for on `sys.path` and in the current directory. The attribute is an `nn.Module`, a `Model`, or
    something that returns one when called without arguments (a function, or a class of modules).

    Raises:
        ModelError: it cannot be imported, raises, returns something else, or the weights do not fit.
        UnknownNameError: the module has no such attribute; near matches are named.
        InputError: it must not be imported (`registry.only_named_code`).
    """
    target, weights = split_weights(spec)
    check_import(target)
    module_name, _, attribute = target.partition(":")
    value: Any = _import_module(module_name, spec)
    for part in attribute.split("."):
        if not hasattr(value, part):
            known = [key for key in vars(value) if not key.startswith("_") and callable(getattr(value, key))]
            raise UnknownNameError(f"attribute of {module_name}", part, _near(part, known))
        value = getattr(value, part)
    built = _build(value, spec)
    if isinstance(built, Model):
        if weights is not None:
            raise ModelError(
                f"model {spec}: {target} returns a ready Model, weights cannot be put into it; leave out '@...'"
            )
        return built
    if weights is not None:
        load_weights(built, weights, target)
    return source_of(built, spec)


def _import_module(name: str, spec: str) -> ModuleType:
    with current_directory_importable():
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is not None and (name == error.name or name.startswith(error.name + ".")):
                message = f"no module named {error.name!r} on the Python path or in {os.getcwd()}"
            else:
                message = f"module {name!r} needs {error.name!r}, which is not installed"
            raise ModelError(f"model {spec}: {message}") from error
        except Exception as error:  # the user's code may raise anything
            raise ModelError(f"model {spec}: importing {name!r} failed ({_where(error)})") from error


def _build(value: Any, spec: str) -> nn.Module | Model:
    made_here = not isinstance(value, (nn.Module, Model))
    if made_here:
        if not callable(value):
            raise ModelError(f"model {spec}: expected a callable or an nn.Module, got {type(value).__name__}")
        try:
            value = value()
        except Exception as error:  # the user's code may raise anything
            raise ModelError(f"model {spec}: calling it without arguments failed ({_where(error)})") from error
    if not isinstance(value, (nn.Module, Model)):
        raise ModelError(
            f"model {spec}: expected it to return an nn.Module or an advsearch Model, got {type(value).__name__}"
        )
    return value


def _where(error: BaseException) -> str:
    """Return a foreign error with the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    return f"{first_line(error)}{place}"


def _near(name: str, known: Iterable[str]) -> list[str]:
    """Return at most a dozen names to show, the nearest first."""
    names = sorted(known)
    return difflib.get_close_matches(name, names, n=12, cutoff=0.3) or names[:12]


# ---------------------------------------------------------------------------------------------------------------------
# torchvision


def load_torchvision(spec: str) -> Source:
    """Return ``torchvision:NAME[@weights.safetensors]``, a classifier of torchvision's registry.

    Nothing is downloaded. Without ``@weights`` torchvision's default weights must already be in torch's cache. Size,
    normalisation and labels are those of the default weights, where torchvision tells them.

    Raises:
        ModelError: torchvision is missing or broken, there are no weights, or they do not fit.
        UnknownNameError: torchvision has no classifier of that name.
    """
    name, weights = split_weights(spec.partition(":")[2])
    torchvision = _import_torchvision(spec)
    known = _classifiers(torchvision)
    if name not in known:
        raise UnknownNameError("torchvision classifier", name, _near(name, known))
    default = _default_weights(torchvision, name)
    if weights is None:
        module = _with_cached_weights(torchvision, spec, name, default)
    else:
        module = torchvision.models.get_model(name, weights=None)
        load_weights(module, weights, name)
    fields: dict[str, Any] = {"input_size": (224, 224), "mean": PRESETS["imagenet"][0], "std": PRESETS["imagenet"][1]}
    return source_of(module, name, **{**fields, **_described(default, module)})


def _import_torchvision(spec: str) -> Any:
    try:
        return importlib.import_module("torchvision")
    except Exception as error:  # a build for another torch raises RuntimeError, among others
        raise ModelError(
            f"model {spec}: needs torchvision, built for torch {torch.__version__}, which cannot be imported "
            f"({first_line(error)}). Install it from the index that torch came from, or export the network with "
            "torch.export where torchvision works"
        ) from error


def _classifiers(torchvision: Any) -> list[str]:
    """Return the names in torchvision's own module of models; those in submodules segment and detect."""
    return list(torchvision.models.list_models(module=torchvision.models))


def _default_weights(torchvision: Any, name: str) -> Any | None:
    try:
        return torchvision.models.get_model_weights(name).DEFAULT
    except (AttributeError, ValueError):
        return None


def _with_cached_weights(torchvision: Any, spec: str, name: str, default: Any | None) -> nn.Module:
    url = getattr(default, "url", "")
    cached = Path(torch.hub.get_dir(), "checkpoints", url.rpartition("/")[2])
    if not url or not cached.is_file():
        raise ModelError(
            f"model {spec}: its weights are not on this machine (looked for {cached}) and nothing is downloaded. Give "
            f"'torchvision:{name}@weights.safetensors', or fetch them once with python -c \"import torchvision; "
            f"torchvision.models.get_model('{name}', weights='DEFAULT')\""
        )
    module: nn.Module = torchvision.models.get_model(name, weights=None)
    try:
        module.load_state_dict(torch.load(cached, map_location="cpu", weights_only=True))
    except Exception as error:  # a damaged file raises nearly anything
        raise ModelError(
            f"model {spec}: cannot load {cached} ({first_line(error)}); delete it and fetch it again"
        ) from error
    return module


def _described(default: Any | None, module: nn.Module) -> dict[str, Any]:
    """Return the fields of `Source` that torchvision's default weights tell."""
    if default is None:
        return {}
    fields: dict[str, Any] = {}
    transforms = default.transforms()
    crop = getattr(transforms, "crop_size", None)
    if crop:
        fields["input_size"] = (int(crop[0]), int(crop[-1]))
    for key in ("mean", "std"):
        numbers = getattr(transforms, key, None)
        if numbers is not None:
            fields[key] = tuple(float(number) for number in numbers)
    categories = default.meta.get("categories") if hasattr(default, "meta") else None
    last = [p for p in module.parameters() if p.dim() == 1][-1:]
    if categories and last and last[0].numel() == len(categories):
        fields["labels"] = tuple(categories)
    return fields
