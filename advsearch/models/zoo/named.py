"""``timm:NAME`` and ``torchvision:NAME``: networks that classify, segment or find objects, and features of timm's."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from advsearch.errors import ModelError, UnknownNameError
from advsearch.models.model import PRESETS, Triple
from advsearch.models.source import Purpose, Source, load_weights, near_names, source_of, split_weights
from advsearch.models.zoo import outputs
from advsearch.models.zoo.library import Loaded, library, reading


def load_timm(spec: str) -> Source:
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


def timm_repository(spec: str, name: str, revision: str) -> Source:
    """Return the network of a repository, or of a folder, that timm has made; `spec` is for messages. Raises ModelError
    where timm is missing, or it cannot be had."""
    timm = library("timm", spec, "timm")
    local = Path(name).is_dir()
    place = f"local-dir:{name}" if local else f"hf-hub:{name}{'@' if revision else ''}{revision}"
    with reading(spec, "Give a folder with config.json and model.safetensors, as timm saves them"):
        module = timm.create_model(place, pretrained=True)
    return _source(timm, module, name.rstrip("/").rpartition("/")[2])


def of_timm(network: nn.Module) -> Source | None:
    """Return the source of a network of timm that is there already; None of any other."""
    timm: Any = sys.modules.get("timm")
    if timm is None or not isinstance(getattr(network, "pretrained_cfg", None), dict):
        return None
    return _source(timm, network, type(network).__name__)


def wrapped_timm(loaded: Loaded, labels: tuple[str, ...]) -> Source:
    """Return the source of a network of timm inside a `TimmWrapperForImageClassification` of transformers, whose
    ``config`` may tell more than timm. There are no labels where transformers only numbers them."""
    timm = library("timm", loaded.spec, "timm")
    network: Any = loaded.network
    told = getattr(network.config, "pretrained_cfg", None)
    return _source(timm, network.timm_model, loaded.name, told, labels)


def _source(
    timm: Any, module: Any, name: str, told: Mapping[str, Any] | None = None, labels: tuple[str, ...] = ()
) -> Source:
    """Return the source of a network of timm, which is asked for its classes or for its features. `told` stands for its
    ``pretrained_cfg``; labels go before timm's."""
    return Source(module, name, finish=partial(_finished, timm, module, name, told, labels))


def _finished(
    timm: Any, module: Any, name: str, told: Mapping[str, Any] | None, labels: tuple[str, ...], purpose: Purpose
) -> Source:
    compared = purpose.task == outputs.TASK
    if module.num_classes == 0 and not compared:
        raise outputs.no_classes(name, "is a network without a head (num_classes is 0)")
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


MOST_DETECTED = 4
"""Most pictures that a detector is given at once: at 800 x 800 each takes a gigabyte or two with its derivative."""


def load_torchvision(spec: str) -> Source:
    """Return ``torchvision:NAME[@weights.safetensors]``, with torchvision's default weights where none are given.

    Size, normalisation and labels are those of the default weights, where torchvision tells them. Its detectors
    normalise by themselves, and resize too: their size is the one that they would resize a square picture to.

    Raises:
        ModelError: torchvision is missing or broken, its weights cannot be had, those that were given do not fit, or
            it is quantised or for videos.
        UnknownNameError: torchvision has no such network.
    """
    name, weights = split_weights(spec.partition(":")[2])
    models = library("torchvision", spec, "torchvision").models
    classifies, segments, finds = (
        models.list_models(module=m) for m in (models, models.segmentation, models.detection)
    )
    if name not in (*classifies, *segments, *finds):
        for part, what in NOT_FOR_PICTURES.items():
            if name in (models.list_models(module=getattr(models, part)) if hasattr(models, part) else ()):
                plain = f"torchvision:{name.removeprefix('quantized_')}"
                raise ModelError(f"model {spec}: {what.format(plain=plain)}")
        raise UnknownNameError("torchvision network", name, near_names(name, (*classifies, *segments, *finds)))
    default = getattr(models.get_model_weights(name), "DEFAULT", None)
    parts = {} if name in classifies else {"weights_backbone": None}
    with reading(spec, f"Give 'torchvision:{name}@weights.safetensors'"):
        module: nn.Module = models.get_model(name, weights=None if weights else default, **parts)
    if weights is not None:
        load_weights(module, weights, name)
    if name in finds:
        return _detector(module, name, default)
    source = source_of(_FromDictionary(module) if name in segments else module, name)
    return _with_defaults(source, default, module if name in classifies else None)


NOT_FOR_PICTURES = {
    "video": "is made for videos, and pictures are what is given here; name a network for pictures, or wrap it in an "
    "nn.Module that makes a video of each picture and give that from Python",
    "optical_flow": "compares two pictures of a video, and one at a time is given here; name a network for one picture",
    "quantization": "is quantised: it rounds as it runs, and no gradient goes through it; name {plain}, which it was "
    "made of, or give it from Python and search with a policy without gradients, such as nes",
}
"""What torchvision's other networks are, by its module, and the way on."""


def _detector(module: nn.Module, name: str, default: Any | None) -> Source:
    """Return the source of a detector; without the size that it resizes to, it takes pictures as they are."""
    source = _with_defaults(source_of(_FromList(module), name), default, None)
    source = replace(source, mean=None, std=None, batch_limits=(1, MOST_DETECTED))
    size = _size_inside(getattr(module, "transform", None))
    return source if size is None else replace(source, input_size=size)


def _size_inside(transform: Any) -> tuple[int, int] | None:
    """Return (height, width) that a detector's transformation makes of a square picture; None if it does not tell."""
    fixed = getattr(transform, "fixed_size", None)
    if fixed:
        return int(fixed[1]), int(fixed[0])
    shortest = getattr(transform, "min_size", None)
    if not shortest:
        return None
    side = int(shortest if isinstance(shortest, int) else shortest[-1])
    return side, side


class _FromList(nn.Module):
    """What a detector finds in each of a list of pictures."""

    boxes_are_corners_in_pixels = True

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> list[dict[str, Tensor]]:
        found: list[dict[str, Tensor]] = self.network(list(images))
        return found


class _FromDictionary(nn.Module):
    """Logits (N, classes, H, W) of each pixel, out of a dictionary."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        logits: Tensor = self.network(images)["out"]
        return logits


def _with_defaults(source: Source, default: Any | None, classifier: nn.Module | None) -> Source:
    """Return the source with what default weights tell; the labels of a classifier only if they fit it."""
    mean, std = PRESETS["imagenet"]
    source = replace(source, input_size=(224, 224), mean=mean, std=std)
    if default is None:
        return source
    transforms = default.transforms()
    sides = getattr(transforms, "crop_size", None) or getattr(transforms, "resize_size", None)
    if sides:
        source = replace(source, input_size=(int(sides[0]), int(sides[-1])))
    if getattr(transforms, "mean", None) is not None:
        source = replace(source, mean=_triple(transforms.mean))
    if getattr(transforms, "std", None) is not None:
        source = replace(source, std=_triple(transforms.std))
    labels = tuple(str(label) for label in default.meta.get("categories", ()))
    last = [] if classifier is None else [p for p in classifier.parameters() if p.dim() == 1][-1:]
    fit = classifier is None or (last and last[0].numel() == len(labels))
    return replace(source, labels=labels) if labels and fit else source


def _triple(numbers: Sequence[float]) -> Triple:
    red, green, blue = (float(number) for number in numbers)
    return red, green, blue
