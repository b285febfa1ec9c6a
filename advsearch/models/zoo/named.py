"""``timm:NAME`` and ``torchvision:NAME``: networks that classify, segment or find objects, and features of timm's."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from advsearch.errors import ModelError, UnknownNameError
from advsearch.models.model import PRESETS
from advsearch.models.source import Purpose, Source, load_weights, near_names, source_of, split_weights
from advsearch.models.zoo import outputs
from advsearch.models.zoo.library import Adapted, Loaded, library, reading


def load_timm(spec: str) -> Source:
    """Return ``timm:NAME[@weights.safetensors]``, with timm's pretrained weights where none are given. Size,
    normalisation and labels are those of its pretrained weights. Raises ModelError: timm is missing, its weights cannot
    be had, or those that were given do not fit; UnknownNameError: timm has no network of that name."""
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


def wrapped_timm(loaded: Loaded) -> Source:
    """Return the source of a network of timm inside a `TimmWrapperForImageClassification` of transformers, whose
    ``config`` may tell more than timm. There are no labels where transformers only numbers them."""
    timm = library("timm", loaded.spec, "timm")
    network: Any = loaded.network
    described = getattr(network.config, "pretrained_cfg", None)
    return _source(timm, network.timm_model, loaded.name, described, loaded.names)


def _source(
    timm: Any, module: Any, name: str, described: Mapping[str, Any] | None = None, labels: tuple[str, ...] = ()
) -> Source:
    """Return the source of a network of timm, which is asked for its classes or for its features. `described` stands
    for its ``pretrained_cfg``; labels go before timm's."""

    def finished(purpose: Purpose) -> Source:
        compared = purpose.task == outputs.TASK
        if module.num_classes == 0 and not compared:
            raise outputs.no_classes(name, "is a network without a head (num_classes is 0)")
        told = {"pretrained_cfg": dict(described)} if described else {}
        config = timm.data.resolve_model_data_config(module, **told)
        return source_of(
            Adapted(module, _features) if compared and module.num_classes else module,
            name,
            input_size=(int(config["input_size"][1]), int(config["input_size"][2])),
            mean=tuple(float(number) for number in config["mean"]),
            std=tuple(float(number) for number in config["std"]),
            labels=None if compared else labels or _labels(timm, module),
        )

    return Source(module, name, finish=finished)


def _features(network: Any, images: Tensor) -> Any:
    """What the head of a network of timm reads."""
    return network.forward_head(network.forward_features(images), pre_logits=True)


def _labels(timm: Any, module: Any) -> tuple[str, ...] | None:
    names = module.pretrained_cfg.get("label_names")
    subset = timm.data.infer_imagenet_subset(module)
    if not names and subset:
        names = timm.data.ImageNetInfo(subset).label_descriptions()
    return tuple(str(name) for name in names) if names and len(names) == module.num_classes else None


MOST_DETECTED = 4
"""Most pictures that a detector is given at once: at 800 x 800 each takes a gigabyte or two with its derivative."""


def load_torchvision(spec: str) -> Source:
    """Return ``torchvision:NAME[@weights.safetensors]``, with torchvision's default weights where none are given. Size,
    normalisation and labels are those of the default weights, where torchvision tells them. Its detectors normalise by
    themselves, and resize too: their size is the one that they would resize a square picture to. Raises ModelError:
    torchvision is missing or broken, its weights cannot be had, those that were given do not fit, or it is quantised or
    for videos; UnknownNameError: torchvision has no such network."""
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
    if name in classifies:
        return source_of(module, name, **_defaults(default, module))
    fields = _defaults(default, None)
    if name in segments:
        return source_of(Adapted(module, _scores_by_pixel), name, **fields)
    fields |= {"mean": None, "std": None, "batch_limits": (1, MOST_DETECTED)}
    if (size := _size_inside(getattr(module, "transform", None))) is not None:
        fields["input_size"] = size
    return source_of(Adapted(module, _found, boxes=True), name, **fields)


NOT_FOR_PICTURES = {
    "video": "is made for videos, and pictures are what is given here; name a network for pictures, or wrap it in an "
    "nn.Module that makes a video of each picture and give that from Python",
    "optical_flow": "compares two pictures of a video, and one at a time is given here; name a network for one picture",
    "quantization": "is quantised: it rounds as it runs, and no gradient goes through it; name {plain}, which it was "
    "made of, or give it from Python and search with a policy without gradients, such as nes",
}
"""What torchvision's other networks are, by its module, and the way on."""


def _found(network: Any, images: Tensor) -> Any:
    return network(list(images))


def _scores_by_pixel(network: Any, images: Tensor) -> Any:
    return network(images)["out"]


def _size_inside(transform: Any) -> tuple[int, int] | None:
    """Return (height, width) that a detector's transformation makes of a square picture; None if it does not tell."""
    if fixed := getattr(transform, "fixed_size", None):
        return int(fixed[1]), int(fixed[0])
    shortest = getattr(transform, "min_size", None)
    if not shortest:
        return None
    side = int(shortest if isinstance(shortest, int) else shortest[-1])
    return side, side


def _defaults(default: Any | None, classifier: nn.Module | None) -> dict[str, Any]:
    """Return what default weights tell of a source; the labels of a classifier only if they fit it."""
    mean, std = PRESETS["imagenet"]
    fields: dict[str, Any] = {"input_size": (224, 224), "mean": mean, "std": std}
    if default is None:
        return fields
    transforms = default.transforms()
    if sides := getattr(transforms, "crop_size", None) or getattr(transforms, "resize_size", None):
        fields["input_size"] = int(sides[0]), int(sides[-1])
    for key in ("mean", "std"):
        if (numbers := getattr(transforms, key, None)) is not None:
            fields[key] = tuple(map(float, numbers))
    labels = tuple(str(label) for label in default.meta.get("categories", ()))
    last = [] if classifier is None else [p for p in classifier.parameters() if p.dim() == 1][-1:]
    if labels and (classifier is None or (last and last[0].numel() == len(labels))):
        fields["labels"] = labels
    return fields
