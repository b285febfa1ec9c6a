"""Define `Source`: what a loader of models returns.

It is a network that is ready to run, with what its file or its author states about it.
Networks that Python code builds are loaded here: ``package.module:callable``, perhaps
with weights after an ``@``.
"""

from __future__ import annotations

import copy
import difflib
import importlib
import importlib.util
import os
import pickle
import traceback
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from advsearch.errors import (
    FileFormatError,
    InputError,
    ModelError,
    UnknownNameError,
    find_similar_names,
)
from advsearch.models.inputs import takes_image_size
from advsearch.models.model import (
    CPU,
    OUTPUTS_BY_TASK,
    PROGRAMS,
    Model,
    Triple,
    copy_sharing_weights,
    warn,
)
from advsearch.trust.archives import MAX_ARCHIVE_BYTES
from advsearch.trust.code import check_import, current_directory_importable
from advsearch.trust.foreign_code import get_first_line
from advsearch.trust.stored_files import open_regular

# the default question about an image
QUESTION = "What is this? Answer with its name only."
DEFAULT_SIZE = 448
"""Side in pixels of images for networks that take any size: a multiple of 28 and of 32,
the sizes of patches of Qwen's networks.
"""

# errors of `copy.deepcopy` for a module that cannot be copied
COPY_ERRORS = (TypeError, AttributeError, RuntimeError, pickle.PickleError, copy.Error)


@dataclass(frozen=True)
class Purpose:
    """What a network is loaded for.

    Attributes:
        task: name of the task.
        names: names of classes that the user set; None if there are none.
        prompts: prompts that the user set; None if there are none.
        tokens: maximum length of a free answer, in tokens.
        times: number of answers per image.
        ask: limits and prices of a model behind an address
            (`advsearch.models.address.LIMITS`).
    """

    task: str = "classification"
    names: tuple[str, ...] | None = None
    prompts: tuple[str, ...] | None = None
    tokens: int = 16
    times: int = 1
    ask: Mapping[str, float] = field(default_factory=dict)

    def check(self, model: str, what: str, *tasks: str) -> None:
        """Check that a network can do the task; a task of the user is not checked.

        Args:
            model: name of the model.
            what: what the network does, such as "compares a picture with texts".
            *tasks: the tasks of the package that it can do.

        Raises:
            ModelError: it cannot do the task.
        """
        is_user_task = self.task not in (*OUTPUTS_BY_TASK, "answer")
        if not is_user_task and self.task not in tasks:
            instead = " or ".join(f"`task={task}`" for task in tasks)
            raise ModelError(
                f"model {model} {what} and cannot do task {self.task}; use {instead}"
            )

    def parse_question(self, model: str, what: str) -> tuple[bool, str | None]:
        """Return how to question a network that returns texts.

        Args:
            model: name of the model, for messages.
            what: what the network does, such as "is behind an address".

        Returns:
            Whether it answers in free words, as for the task `answer`, and not by
            choosing a class; and the user's question, or None for the default question.

        Raises:
            ModelError: the network cannot do the task.
            InputError: there are several questions, or names for a free answer.
        """
        self.check(model, what, "classification", "answer")
        free = self.task == "answer"
        prompts = self.prompts or ()
        if free and self.names is not None:
            raise InputError(
                "labels: task answer has no classes; leave them out, and "
                "set the right words with `label`"
            )
        if len(prompts) > 1:
            raise InputError(
                f"prompt: expected one question for model {model}, got {len(prompts)}"
            )
        return free, prompts[0] if prompts else None

    def require_names(self, model: str, what: str, task: str) -> tuple[str, ...]:
        """Return the user's names of classes for a network that has none itself.

        Args:
            model: name of the model, for messages.
            what: what the network does, such as "compares a picture with texts".
            task: the task that it can do.

        Raises:
            ModelError: the network cannot do the task.
            InputError: there are no names.
        """
        self.check(model, what, task)
        if self.names is None:
            raise InputError(
                f"model {model} {what} and has no classes itself: set at least two, "
                "such as `labels=mug,cup,bowl` or `labels=imagenet`"
            )
        return self.names


@dataclass(frozen=True)
class Source:
    """A frozen network with its own defaults, which options of `load_model` override.

    Fields without a description are as in `Preprocessing` and `Model`. They are None if
    the source does not state them.

    Attributes:
        module: the network in evaluation mode; its parameters have no gradients.
        batch_limits: (minimum, maximum) number of images in one call.
        dtype: dtype of the network's input.
        reads_text: whether the network also gets texts.
        takes_more: whether the network needs further inputs that are not images.
        size_type: dtype of the image size, for a network that takes it as second input
            (`WithImageSize`); None for other networks.
    """

    module: Callable[[torch.Tensor], Any]
    name: str
    input_size: tuple[int, int] | None = None
    mean: Triple | None = None
    std: Triple | None = None
    layout: str | None = None
    channels: str | None = None
    labels: tuple[str, ...] | None = None
    processor: Callable[[torch.Tensor], torch.Tensor] | None = None
    batch_limits: tuple[int, int] = (1, 64)
    dtype: torch.dtype = torch.float32
    device: torch.device = CPU
    reads_text: bool = False
    takes_more: bool = False
    value_range: tuple[float, float] | None = None
    size_type: torch.dtype | None = None


def _check_not_lazy(module: nn.Module, name: str) -> None:
    """Raise ModelError if a layer of a network has no weights yet.

    Layers such as `nn.LazyLinear` create their weights in the first call.

    Args:
        module: the network.
        name: name of the model, for the message.
    """
    all_weights = (*module.named_parameters(), *module.named_buffers())
    lazy_keys = [key for key, weights in all_weights if is_lazy(weights)]
    if not lazy_keys:
        return
    layer = lazy_keys[0].rpartition(".")[0]
    raise ModelError(
        f"model {name}: its layer {layer} "
        f"({type(module.get_submodule(layer)).__name__}) has no weights before its "
        "first call; call the network once with an image, load its weights, and pass "
        "it then"
    )


def make_source(module: nn.Module, name: str, **fields: Any) -> Source:
    """Return the source of a module, which is frozen.

    Args:
        module: the network.
        name: name of the model.
        **fields: fields of `Source`. Dtype and device are by default those of the
            module's first floating-point parameter or buffer.

    Raises:
        ModelError: it has lazy layers that have no weights yet.
    """
    _check_not_lazy(module, name)
    tensors = (*module.parameters(), *module.buffers())
    first = next((tensor for tensor in tensors if tensor.is_floating_point()), None)
    # `fields` come last: what the caller states takes precedence.
    if first is not None:
        fields = {"dtype": first.dtype, "device": first.device, **fields}
    if takes_image_size(module):
        # the usual dtype of sizes, unless the caller states another
        fields = {"size_type": torch.int64, **fields}
    return Source(freeze_network(module, name), name, **fields)


def freeze_network(module: nn.Module, name: str) -> nn.Module:
    """Return the module in evaluation mode, with parameters that collect no gradient.

    An ordinary module is copied, except for its weights, which the copy shares. So the
    caller may continue to train the original, and the copy has the new weights if they
    are changed in place, as optimizers do. Exported and scripted programs are not
    copied: they are frozen themselves. So are modules that cannot be copied, with a
    warning.

    Args:
        module: the network.
        name: name of the model, for the warning.
    """
    if not isinstance(module, PROGRAMS):
        try:
            module = copy_sharing_weights(module)
        except COPY_ERRORS as error:  # it holds a lock or an open file, for example
            warn(
                f"model {name} cannot be copied ({get_first_line(error)}): the module "
                "itself is set to evaluation mode and its parameters are frozen"
            )
    with suppress(NotImplementedError):  # programs of torch.export have no modes
        module.eval()
    for parameter in module.parameters():
        parameter.requires_grad_(False)
    return module


def load_weights(module: nn.Module, path: Path, name: str) -> None:
    """Load a safetensors file into a module, whose keys and shapes it must have.

    Counters of batch norms (`num_batches_tracked`) may be missing.

    Args:
        module: the network.
        path: path of the file.
        name: name of the model, for messages.

    Raises:
        FileFormatError: the file is missing or is not safetensors.
        ModelError: keys or shapes do not fit.
    """
    state = _read_weights(path, name)
    problems = _describe_misfit(module.state_dict(), state)
    if problems:
        raise ModelError(
            f"weights {path} do not fit model {name}: {'; '.join(problems)}"
        )
    # Not strict, since counters of batch norms may be missing.
    module.load_state_dict(state, strict=False)


def _read_weights(path: Path, name: str) -> dict[str, Tensor]:
    """Return the tensors in a safetensors file, by key.

    Args:
        path: path of the file.
        name: name of the model, for messages.

    Raises:
        FileFormatError: the file is missing or is not safetensors.
    """
    try:
        # Opened only to check that it is a regular file of limited size.
        open_regular(path, "weights", MAX_ARCHIVE_BYTES).close()
        return load_file(path)
    except FileNotFoundError:
        raise FileFormatError(f"weights {path} of model {name}: no such file") from None
    except (SafetensorError, OSError) as error:
        raise FileFormatError(
            f"weights {path} of model {name}: expected a complete safetensors file "
            f"({get_first_line(error)}); "
            "make one with safetensors.torch.save_file(module.state_dict(), path)"
        ) from None


def _describe_misfit(
    expected: Mapping[str, Tensor], state: Mapping[str, Tensor]
) -> list[str]:
    """Describe why the tensors of a file do not fit a network; empty if they do.

    Counters of batch norms (`num_batches_tracked`) may be missing, since they do not
    matter outside of training.

    Args:
        expected: tensors of the network, by key.
        state: tensors of the file, by key.
    """
    missing = [
        key
        for key in expected
        if key not in state and not key.endswith("num_batches_tracked")
    ]
    unexpected = [key for key in state if key not in expected]
    problems = []
    for problem, keys in (("missing", missing), ("not in the network", unexpected)):
        if keys:
            suffix = ", ..." if len(keys) > 3 else ""
            problems.append(f"{len(keys)} {problem} ({', '.join(keys[:3])}{suffix})")
    # two examples of wrong shapes are enough
    return [*problems, *_describe_wrong_shapes(expected, state)[:2]]


def _describe_wrong_shapes(
    expected: Mapping[str, Tensor], state: Mapping[str, Tensor]
) -> list[str]:
    """Describe which tensors of a file have another shape than those of a network."""
    return [
        f"{key} is {tuple(state[key].shape)} in the file and "
        f"{tuple(tensor.shape)} in the network"
        for key, tensor in expected.items()
        if key in state and state[key].shape != tensor.shape
    ]


def split_weights(spec: str) -> tuple[str, Path | None]:
    """Return the part before the first ``@`` and the path after it, if there is one."""
    name, _, weights = spec.partition("@")
    return name.strip(), Path(weights.strip()) if weights.strip() else None


def load_callable(spec: str, libraries: Iterable[str] = ()) -> Source | Model:
    """Return the model behind ``package.module:callable[@weights.safetensors]``.

    The module is searched on `sys.path` and in the current directory. The attribute
    is an `nn.Module`, a `Model`, or something that returns one when called without
    arguments (a function, or a class of modules).

    Args:
        spec: the text.
        libraries: names of model sources, such as "timm". If there is no such module,
            it may be a misspelling of one of them, which the message suggests.

    Raises:
        ModelError: the module cannot be imported; or what it defines raises, returns
            something else, or does not fit the weights.
        UnknownNameError: the module has no such attribute; the message has similar
            names.
        InputError: the module may not be imported (`trust.code.check_import`).
    """
    target, weights = split_weights(spec)
    check_import(target)
    value = _build_value(target, spec, libraries)
    if isinstance(value, Model):
        if weights is not None:
            raise ModelError(
                f"model {spec}: {target} returns a ready Model, weights cannot be put "
                "into it; leave out '@...'"
            )
        return value
    if not isinstance(value, nn.Module):
        raise ModelError(
            f"model {spec}: expected it to return an nn.Module or an advsearch Model, "
            f"got {type(value).__name__}"
        )
    if weights is not None:
        load_weights(value, weights, target)
    return make_source(value, spec)


def _build_value(target: str, spec: str, libraries: Iterable[str]) -> Any:
    """Return the attribute of a module, or what it returns if it is called.

    Args:
        target: ``package.module:callable``.
        spec: what the user wrote, for messages.
        libraries: names of model sources.
    """
    module_name, _, attribute = target.partition(":")
    module = _import_module(module_name, spec, libraries)
    value = _get_attribute(module, attribute, module_name)
    if isinstance(value, (nn.Module, Model)):
        return value
    return _call_factory(value, spec)  # a function or a class


def _get_attribute(module: ModuleType, attribute: str, module_name: str) -> Any:
    """Return an attribute of a module, or of a class in it.

    Args:
        module: the module.
        attribute: name such as "build", or "Class.method".
        module_name: name of the module, for the message.

    Raises:
        UnknownNameError: there is no such attribute; the message has similar names.
    """
    value: Any = module
    for name in attribute.split("."):
        if not hasattr(value, name):
            similar_names = find_near_names(name, _list_public_callables(value))
            kind = f"attribute of {module_name}"
            raise UnknownNameError(kind, name, similar_names)
        value = getattr(value, name)
    return value


def _list_public_callables(value: Any) -> list[str]:
    """Return the names of the public functions and classes of a module or class."""
    return [
        key
        for key in vars(value)
        if not key.startswith("_") and callable(getattr(value, key))
    ]


def _call_factory(factory: Any, spec: str) -> Any:
    """Return what the user's function or class returns, called without arguments.

    Args:
        factory: what the user named.
        spec: what the user wrote, for messages.

    Raises:
        ModelError: it cannot be called, or fails.
    """
    if not callable(factory):
        raise ModelError(
            f"model {spec}: expected a callable or an nn.Module, got "
            f"{type(factory).__name__}"
        )
    try:
        return factory()
    except Exception as error:  # the user's code may raise anything
        raise ModelError(
            f"model {spec}: calling it without arguments failed ({_where(error)})"
        ) from error


def _import_module(name: str, spec: str, libraries: Iterable[str]) -> ModuleType:
    """Import a module, which may be in the current directory.

    Args:
        name: name of the module.
        spec: what the user wrote, for messages.
        libraries: names of model sources, such as "timm", of which the name may be a
            misspelling.

    Raises:
        ModelError: it cannot be imported.
    """
    with current_directory_importable():
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            message = _explain_missing_module(error, name, spec, libraries)
            raise ModelError(f"model {spec}: {message}") from error
        except Exception as error:  # the user's code may raise anything
            raise ModelError(
                f"model {spec}: importing {name!r} failed ({_where(error)})"
            ) from error


def _explain_missing_module(
    error: ModuleNotFoundError, name: str, spec: str, libraries: Iterable[str]
) -> str:
    """Return which module is missing.

    Either that is the module itself or a package that holds it, or another module that
    it imports.

    Args:
        error: error of the import.
        name: name of the module that was to be imported.
        spec: what the user wrote.
        libraries: names of model sources.
    """
    missing = error.name
    is_module_itself = missing is not None and f"{name}.".startswith(f"{missing}.")
    if is_module_itself:
        return (
            f"no module named {missing!r} on the Python path or in "
            f"{os.getcwd()}{_suggest_library(name, spec, libraries)}"
        )
    return f"module {name!r} needs {missing!r}, which is not installed"


def _suggest_library(name: str, spec: str, libraries: Iterable[str]) -> str:
    """Return a suggestion such as "; did you mean 'timm:resnet18'?".

    Args:
        name: name of a module that does not exist.
        spec: what the user wrote, "NAME:REST".
        libraries: names of model sources, such as "timm".

    Returns:
        The suggestion; "" if no library has a similar name.
    """
    similar = find_similar_names(name, libraries)
    if not similar:
        return ""
    return f"; did you mean '{similar[0]}:{spec.partition(':')[2]}'?"


def _where(error: BaseException) -> str:
    """Return the first line of an error, and the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    return get_first_line(error) + (
        f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    )


def find_near_names(name: str, known: Iterable[str]) -> list[str]:
    """Return at most 12 known names for a message, the most similar first.

    If none is similar, they are the first in alphabetical order.
    """
    names = sorted(known)
    return difflib.get_close_matches(name, names, n=12, cutoff=0.3) or names[:12]


def import_library(name: str, spec: str, extra: str) -> Any:
    """Import an optional library that a model needs.

    Args:
        name: name of the library.
        spec: what the user wrote, for messages.
        extra: extra of advsearch, which installs it.

    Raises:
        ModelError: it is not installed, or cannot be imported.
    """
    try:
        return importlib.import_module(name)
    # a build for another torch raises RuntimeError, among others
    except Exception as error:
        command = f"pip install 'advsearch[{extra}]'"
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            raise ModelError(
                f"model {spec}: needs {name}, which is not installed: {command}"
            ) from error
        raise ModelError(
            f"model {spec}: needs {name}, which cannot be imported here "
            f"({get_first_line(error)}). Install builds that fit each other: "
            f"{command}, torch's own index where that has them; or export the network "
            f"with torch.export where {name} works, and give the .pt2 file"
        ) from error
