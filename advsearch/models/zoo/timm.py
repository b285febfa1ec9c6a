"""``timm:NAME``: classifiers of PyTorch Image Models, and their features."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from advsearch.errors import UnknownNameError
from advsearch.models.imported import near_names, split_weights
from advsearch.models.source import Purpose, Source, load_weights, source_of
from advsearch.models.zoo import features
from advsearch.models.zoo.library import library, reading
from advsearch.models.zoo.loaded import Loaded


def load(spec: str) -> Source:
    """Return ``timm:NAME[@weights.safetensors]``, with timm's pretrained weights where none are given.

    Size, normalisation and labels are those of its pretrained weights.

    Raises:
        ModelError: timm is missing, its weights cannot be had, or those that were given do not fit.
        UnknownNameError: timm has no network of that name.
    """
    name, weights = split_weights(spec.partition(":")[2])
    timm = library("timm", spec, "timm")
    if not timm.is_model(name.partition(".")[0]):
        raise UnknownNameError("timm network", name, near_names(name, timm.list_models()))
    with reading(spec, f"Give 'timm:{name}@weights.safetensors'"):
        module = timm.create_model(name, pretrained=weights is None)
    if weights is not None:
        load_weights(module, weights, name)
    return _source(timm, module, name)


def load_repository(spec: str, name: str, revision: str) -> Source:
    """Return the network of a repository, or of a folder, that timm has made; `spec` is for messages.

    Raises:
        ModelError: timm is missing, or it cannot be had.
    """
    timm = library("timm", spec, "timm")
    local = Path(name).is_dir()
    place = f"local-dir:{name}" if local else f"hf-hub:{name}{'@' if revision else ''}{revision}"
    with reading(spec, "Give a folder with config.json and model.safetensors, as timm saves them"):
        module = timm.create_model(place, pretrained=True)
    return _source(timm, module, name.rstrip("/").rpartition("/")[2])


def of_network(network: nn.Module) -> Source | None:
    """Return the source of a network of timm that is there already; None of any other."""
    timm: Any = sys.modules.get("timm")
    if timm is None or not isinstance(getattr(network, "pretrained_cfg", None), dict):
        return None
    return _source(timm, network, type(network).__name__)


def of_wrapped(loaded: Loaded, labels: tuple[str, ...]) -> Source:
    """Return the source of a network of timm inside one of transformers, whose ``config`` may tell more than timm.

    Args:
        loaded: of a `TimmWrapperForImageClassification`.
        labels: that transformers knows; none where it only numbers them.
    """
    timm = library("timm", loaded.spec, "timm")
    network: Any = loaded.network
    told = getattr(network.config, "pretrained_cfg", None)
    return _source(timm, network.timm_model, loaded.name, told, labels)


def _source(
    timm: Any, module: Any, name: str, told: Mapping[str, Any] | None = None, labels: tuple[str, ...] = ()
) -> Source:
    """Return the source of a network, which is asked for its classes or for its features.

    Args:
        timm: the library.
        module: the network.
        name: what to call it.
        told: what stands for its ``pretrained_cfg``.
        labels: names of its classes that go before timm's.
    """
    return Source(module, name, finish=partial(_finished, timm, module, name, told, labels))


def _finished(
    timm: Any, module: Any, name: str, told: Mapping[str, Any] | None, labels: tuple[str, ...], purpose: Purpose
) -> Source:
    compared = purpose.task == features.TASK
    if module.num_classes == 0 and not compared:
        raise features.no_classes(name, "is a network without a head (num_classes is 0)")
    asked = timm.data.resolve_model_data_config(module, **({"pretrained_cfg": dict(told)} if told else {}))
    return source_of(
        _Headless(module) if compared and module.num_classes else module,
        name,
        input_size=(int(asked["input_size"][1]), int(asked["input_size"][2])),
        mean=tuple(float(number) for number in asked["mean"]),
        std=tuple(float(number) for number in asked["std"]),
        labels=None if compared else labels or _labels(timm, module),
    )


class _Headless(nn.Module):
    """Features (N, D): what the head of a network of timm reads."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        found: Tensor = self.network.forward_head(self.network.forward_features(images), pre_logits=True)
        return found


def _labels(timm: Any, module: Any) -> tuple[str, ...] | None:
    """Return the names of the classes that the weights were trained on; None where timm does not tell."""
    names = module.pretrained_cfg.get("label_names")
    subset = timm.data.infer_imagenet_subset(module)
    if not names and subset:
        names = timm.data.ImageNetInfo(subset).label_descriptions()
    return tuple(str(name) for name in names) if names and len(names) == module.num_classes else None
