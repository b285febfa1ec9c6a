"""``timm:NAME``: classifiers of PyTorch Image Models."""

from __future__ import annotations

from typing import Any

from advsearch.errors import UnknownNameError
from advsearch.models.imported import near_names, split_weights
from advsearch.models.source import Source, load_weights, source_of
from advsearch.models.zoo.library import library, reading


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
    asked = timm.data.resolve_model_data_config(module)
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
