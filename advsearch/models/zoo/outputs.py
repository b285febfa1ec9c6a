"""Networks of transformers that return features (DINOv2, ViT, the half of CLIP that
sees pictures) or by pixel.

For every pixel some say how far it is, as Depth Anything does, others masks and their
classes: these, as Mask2Former, become segmenters by the class of each pixel.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from advsearch.extend import InputError, errors, models
from advsearch.models.zoo import zero_shot
from advsearch.models.zoo.library import Adapted, Loaded, reading

TASK = "similarity"  # the task that compares features
ENDINGS = ("Model", "ModelWithProjection")
# weights of a first token that stands for the whole picture
TOKENS = ("cls_token", "class_embedding", "class_token")


def gives_features(architecture: str, network: Any) -> bool:
    """Whether a network of transformers, or the class of one, has features of a picture
    and no head; its architecture is a name such as Dinov2Model or
    CLIPVisionModelWithProjection. None stands for one that transformers has not.
    """
    if (
        network is None
        or not architecture.endswith(ENDINGS)
        or zero_shot.compares(network)
    ):
        return False
    finds = (
        "encoder_outputs" in inspect.signature(network.forward).parameters
        or "Detr" in architecture
    )
    return getattr(network, "main_input_name", None) == "pixel_values" and not finds


def no_classes(name: str, what: str) -> errors.ModelError:
    """Return the error for a model that is asked for classes and has features only;
    `what` it is: "is a Dinov2Model".
    """
    return errors.ModelError(
        f"model {name}: {what}, which returns features and has no classes: use "
        f"`task={TASK}`, which compares "
        "them with those of other pictures, or give a network with a head"
    )


def source(
    loaded: Loaded, plain: Callable[[Loaded], models.Source] | None = None
) -> models.Source:
    """Return the source of a network that has features: of these where they are
    compared, else `plain`'s, if it has anything else.
    """
    network = loaded.network
    if loaded.purpose.task != TASK:
        if plain is None:
            raise no_classes(loaded.name, f"is a {type(network).__name__}")
        return plain(loaded)
    if loaded.purpose.prompts is not None:
        raise InputError(
            f"prompt: task {TASK} compares pictures and reads no text; "
            "leave `prompt` out"
        )
    part = network
    config = network.config
    if zero_shot.compares(network):
        zero_shot.check_takes_pictures(network, loaded.spec)
        config = getattr(config, "vision_config", config)
    elif "ForImageClassification" in type(network).__name__:
        part = (
            network.base_model
            if network.base_model is not network
            else getattr(network, "vision_model", None)
        )
        if part is None:
            raise errors.ModelError(
                f"model {loaded.spec}: has no part before its "
                "head; give its network without one"
            )
    token = any(word in name for name, _ in part.named_parameters() for word in TOKENS)

    def features(network: Any, images: Tensor) -> Any:
        returned = (
            network.get_image_features if zero_shot.compares(network) else network
        )(pixel_values=images)
        found = models.pooled(returned, token=token)
        return returned if found is None else found

    return replace(loaded, network=part).source(features, **loaded.sized(config))


DISPARITY = "relative disparity"
METRIC = "metric depth"
"""What their numbers are, by the words of `advsearch.tasks.depth.KINDS`."""

BY_FAMILY = {
    "dpt": DISPARITY,
    "depth_pro": DISPARITY,
    "zoedepth": METRIC,
    "glpn": METRIC,
}
"""Of a network whose ``config`` does not say it, by family: that of the weights that
are published first.
"""


def depth_source(loaded: Loaded) -> models.Source:
    """Return the source of a network that returns how far each pixel is: a mapping with
    numbers (N, h, w) under what they are.
    """
    config = loaded.network.config
    said = {"relative": DISPARITY, "metric": METRIC}.get(
        getattr(config, "depth_estimation_type", ""), ""
    )
    kind = said or BY_FAMILY.get(config.model_type, "predicted_depth")
    framed = (
        bool(getattr(loaded.processor, "do_pad", False))
        and config.model_type == "zoedepth"
    )

    def ask(network: Any, images: Tensor) -> dict[str, Tensor]:
        if not framed:
            return {kind: network(pixel_values=images).predicted_depth}
        # ZoeDepth is shown pictures with a mirrored border, which its processor adds
        # and its post-processing removes
        height, width = images.shape[2:]
        down, across = (int(math.sqrt(side / 2.0) * 3.0) for side in (height, width))
        wide = functional.pad(images, (across, across, down, down), mode="reflect")
        shown = functional.interpolate(
            wide, size=(height, width), mode="bilinear", align_corners=True
        )
        depth = network(pixel_values=shown).predicted_depth[:, None]
        depth = functional.interpolate(depth, size=wide.shape[2:], mode="bicubic")
        return {kind: depth[:, 0, down : down + height, across : across + width]}

    return loaded.source(ask)


MASKS = r"^(Mask2Former|OneFormer|Eomt\w*)ForUniversalSegmentation$|^MaskFormerForInstanceSegmentation$"
"""The architectures that return masks and their classes, by name."""

# height and width to which transformers brings the masks of every Mask2Former before it
# adds them up
FINE = (384, 384)
SENTENCE = "the task is semantic"  # what OneFormer is told to do


def mask_source(loaded: Loaded) -> models.Source:
    """Return the source of a network that returns masks and their classes: of
    logarithms of scores (N, classes, H, W) of each pixel of the input. Warns what these
    are (ModelWarning).

    The score of a class is the sum over queries of the probability that it is a
    query's, times the probability that the pixel is in that one's mask (Cheng et al.
    2021, arXiv 2107.06278, section 3.4, "semantic inference"). Sizes are changed where
    `post_process_semantic_segmentation` of each family changes them.
    """
    models.warn(
        f"model {loaded.name} gives a pixel a score of each class, summed over its "
        "masks, which is no logit: its "
        "logarithm is used, so that margins are logarithms of a ratio of scores"
    )
    sentence = None
    config = loaded.network.config
    family = str(config.model_type)
    if family == "oneformer":  # numbers of tokens (1, L), filled up with 0
        fill = {
            "padding": "max_length",
            "max_length": config.task_seq_len,
            "truncation": True,
        }
        tokens = loaded.part("AutoTokenizer")([SENTENCE], return_tensors="pt", **fill)
        sentence = torch.as_tensor(tokens["input_ids"] * tokens["attention_mask"])

    def ask(network: Any, images: Tensor) -> Tensor:
        size = (images.shape[2], images.shape[3])
        given = (
            {}
            if sentence is None
            else {"task_inputs": sentence.to(images.device).expand(len(images), -1)}
        )
        returned = network(pixel_values=images, **given)
        masks = returned.masks_queries_logits
        classes = returned.class_queries_logits.softmax(dim=-1)[..., :-1]
        if family == "mask2former":
            masks = functional.interpolate(masks, size=FINE, mode="bilinear")
        elif family.startswith("eomt"):
            masks = functional.interpolate(masks, size=size, mode="bilinear")
        scores = torch.einsum("bqc,bqhw->bchw", classes, masks.sigmoid())
        scores = functional.interpolate(scores, size=size, mode="bilinear")
        return scores.float().clamp_min(models.SMALLEST_PROBABILITY).log()

    return loaded.source(ask, labels=loaded.names or None)


# ---------------------------------------------------------------------------------------------------------------------
# ``timm:NAME`` and ``torchvision:NAME``: networks that classify, segment or find
# objects, and features of timm's.


def load_timm(spec: str, purpose: models.Purpose) -> models.Source:
    """Return ``timm:NAME[@weights.safetensors]``, with timm's pretrained weights where
    none are given. Size, normalisation and labels are those of its pretrained weights.
    Raises ModelError: timm is missing, its weights cannot be had, or those that were
    given do not fit; UnknownNameError: timm has no network of that name.
    """
    name, weights = models.split_weights(spec.partition(":")[2])
    timm = models.library("timm", spec, "timm")
    if not timm.is_model(name.partition(".")[0]):
        raise errors.UnknownNameError(
            "timm network", name, models.near_names(name, timm.list_models())
        )
    with reading(spec, f"Give 'timm:{name}@weights.safetensors'"):
        module = timm.create_model(name, pretrained=weights is None)
    if weights is not None:
        models.load_weights(module, weights, name)
    return _source(timm, module, name, purpose)


def timm_repository(
    spec: str, name: str, revision: str, purpose: models.Purpose
) -> models.Source:
    """Return the network of a repository, or of a folder, that timm has made; `spec` is
    for messages. Raises ModelError where timm is missing, or it cannot be had.
    """
    timm = models.library("timm", spec, "timm")
    local = Path(name).is_dir()
    place = (
        f"local-dir:{name}"
        if local
        else f"hf-hub:{name}{'@' if revision else ''}{revision}"
    )
    with reading(
        spec, "Give a folder with config.json and model.safetensors, as timm saves them"
    ):
        module = timm.create_model(place, pretrained=True)
    return _source(timm, module, name.rstrip("/").rpartition("/")[2], purpose)


def of_timm(network: nn.Module, purpose: models.Purpose) -> models.Source | None:
    """Return the source of a network of timm that is there already; None of any
    other.
    """
    timm: Any = sys.modules.get("timm")
    if timm is None or not isinstance(getattr(network, "pretrained_cfg", None), dict):
        return None
    return _source(timm, network, type(network).__name__, purpose)


def wrapped_timm(loaded: Loaded) -> models.Source:
    """Return the source of a network of timm inside a
    `TimmWrapperForImageClassification` of transformers, whose ``config`` may tell more
    than timm. There are no labels where transformers only numbers them.
    """
    timm = models.library("timm", loaded.spec, "timm")
    network: Any = loaded.network
    described = getattr(network.config, "pretrained_cfg", None)
    return _source(
        timm, network.timm_model, loaded.name, loaded.purpose, described, loaded.names
    )


def _source(
    timm: Any,
    module: Any,
    name: str,
    purpose: models.Purpose,
    described: Mapping[str, Any] | None = None,
    labels: tuple[str, ...] = (),
) -> models.Source:
    """Return the source of a network of timm, which is asked for its classes or for its
    features. `described` stands for its ``pretrained_cfg``; labels go before timm's.
    """
    compared = purpose.task == TASK
    classes = module.num_classes
    if classes == 0 and not compared:
        raise no_classes(name, "is a network without a head (num_classes is 0)")
    more = {"pretrained_cfg": dict(described)} if described else {}
    config = timm.data.resolve_model_data_config(module, **more)
    names = labels or module.pretrained_cfg.get("label_names")
    if not names and (subset := timm.data.infer_imagenet_subset(module)):
        names = timm.data.ImageNetInfo(subset).label_descriptions()
    fitting = not compared and names and (labels or len(names) == classes)

    def what_the_head_reads(network: Any, images: Tensor) -> Any:
        return network.forward_head(network.forward_features(images), pre_logits=True)

    return models.source_of(
        Adapted(module, what_the_head_reads) if compared and classes else module,
        name,
        input_size=tuple(map(int, config["input_size"][1:])),
        mean=tuple(map(float, config["mean"])),
        std=tuple(map(float, config["std"])),
        labels=tuple(map(str, names)) if fitting else None,
    )


MOST_DETECTED = 4
"""Most pictures that a detector is given at once: at 800 x 800 each takes a gigabyte or
two with its derivative.
"""


def load_torchvision(spec: str) -> models.Source:
    """Return ``torchvision:NAME[@weights.safetensors]``, with torchvision's default
    weights where none are given. Size, normalisation and labels are those of the
    default weights, where torchvision tells them. Its detectors normalise by
    themselves, and resize too: their size is the one that they would resize a square
    picture to. Raises ModelError: torchvision is missing or broken, its weights cannot
    be had, those that were given do not fit, or it is quantised or for videos;
    UnknownNameError: torchvision has no such network.
    """
    name, weights = models.split_weights(spec.partition(":")[2])
    zoo = models.library("torchvision", spec, "torchvision").models
    classifies, segments, finds = (
        zoo.list_models(module=m) for m in (zoo, zoo.segmentation, zoo.detection)
    )
    if name not in (*classifies, *segments, *finds):
        for part, what in NOT_FOR_PICTURES.items():
            if name in (
                zoo.list_models(module=getattr(zoo, part)) if hasattr(zoo, part) else ()
            ):
                plain = f"torchvision:{name.removeprefix('quantized_')}"
                raise errors.ModelError(f"model {spec}: {what.format(plain=plain)}")
        raise errors.UnknownNameError(
            "torchvision network",
            name,
            models.near_names(name, (*classifies, *segments, *finds)),
        )
    default = getattr(zoo.get_model_weights(name), "DEFAULT", None)
    parts = {} if name in classifies else {"weights_backbone": None}
    with reading(spec, f"Give 'torchvision:{name}@weights.safetensors'"):
        module: nn.Module = zoo.get_model(
            name, weights=None if weights else default, **parts
        )
    if weights is not None:
        models.load_weights(module, weights, name)
    if name in classifies:
        return models.source_of(module, name, **_defaults(default, module))
    fields = _defaults(default, None)
    if name in segments:
        return models.source_of(Adapted(module, _scores_by_pixel), name, **fields)
    fields |= {"mean": None, "std": None, "batch_limits": (1, MOST_DETECTED)}
    inside = getattr(module, "transform", None)  # which would resize a square picture
    if fixed := getattr(inside, "fixed_size", None):
        fields["input_size"] = int(fixed[1]), int(fixed[0])
    elif shortest := getattr(inside, "min_size", None):
        fields["input_size"] = (
            int(shortest if isinstance(shortest, int) else shortest[-1]),
        ) * 2
    return models.source_of(Adapted(module, _found, boxes=True), name, **fields)


NOT_FOR_PICTURES = {
    "video": "is made for videos, and pictures are what is given here; name a network "
    "for pictures, or wrap it in an "
    "nn.Module that makes a video of each picture and give that from Python",
    "optical_flow": "compares two pictures of a video, and one at a time is given "
    "here; name a network for one picture",
    "quantization": "is quantised: it rounds as it runs, and no gradient goes through "
    "it; name {plain}, which it was "
    "made of, or give it from Python and search with a policy without gradients, such "
    "as nes",
}
"""What torchvision's other networks are, by its module, and the way on."""


def _found(network: Any, images: Tensor) -> Any:
    return network(list(images))


def _scores_by_pixel(network: Any, images: Tensor) -> Any:
    return network(images)["out"]


def _defaults(default: Any | None, classifier: nn.Module | None) -> dict[str, Any]:
    """Return what default weights tell of a source; the labels of a classifier only if
    they fit it.
    """
    mean, std = models.PRESETS["imagenet"]
    fields: dict[str, Any] = {"input_size": (224, 224), "mean": mean, "std": std}
    if default is None:
        return fields
    transforms = default.transforms()
    if sides := getattr(transforms, "crop_size", None) or getattr(
        transforms, "resize_size", None
    ):
        fields["input_size"] = int(sides[0]), int(sides[-1])
    for key in ("mean", "std"):
        if (numbers := getattr(transforms, key, None)) is not None:
            fields[key] = tuple(map(float, numbers))
    labels = tuple(str(label) for label in default.meta.get("categories", ()))
    last = (
        []
        if classifier is None
        else [p for p in classifier.parameters() if p.dim() == 1][-1:]
    )
    if labels and (classifier is None or (last and last[0].numel() == len(labels))):
        fields["labels"] = labels
    return fields
