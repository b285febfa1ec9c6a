"""``timm:NAME``: classifiers of PyTorch Image Models."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import nn

from advsearch.errors import ModelError, UnknownNameError
from advsearch.models.imported import near_names, split_weights
from advsearch.models.source import Source, load_weights, source_of
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
    source = _source(timm, network.timm_model, loaded.name, getattr(network.config, "pretrained_cfg", None))
    return replace(source, labels=labels or source.labels)


def _source(timm: Any, module: Any, name: str, told: Mapping[str, Any] | None = None) -> Source:
    """Return the source of a network; `told` is what stands for its ``pretrained_cfg``."""
    if module.num_classes == 0:
        raise ModelError(
            f"model {name}: has no classes (num_classes is 0): it answers with features. Give a network with a head"
        )
    asked = timm.data.resolve_model_data_config(module, **({"pretrained_cfg": dict(told)} if told else {}))
    return source_of(
        module,
        name,
        input_size=(int(asked["input_size"][1]), int(asked["input_size"][2])),
        mean=tuple(float(number) for number in asked["mean"]),
        std=tuple(float(number) for number in asked["std"]),
        labels=_labels(timm, module),
    )


def _labels(timm: Any, module: Any) -> tuple[str, ...] | None:
    """Return the names of the classes that the weights were trained on; None where timm does not tell."""
    names = module.pretrained_cfg.get("label_names")
    subset = timm.data.infer_imagenet_subset(module)
    if not names and subset:
        names = timm.data.ImageNetInfo(subset).label_descriptions()
    return tuple(str(name) for name in names) if names and len(names) == module.num_classes else None
