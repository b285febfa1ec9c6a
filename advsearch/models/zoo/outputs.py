"""Networks of timm and torchvision, and networks of transformers with special outputs.

The latter return features (DINOv2, ViT, the image encoder of CLIP), depth (Depth
Anything), or masks and their classes (Mask2Former), which are converted to scores of
classes for each pixel.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from advsearch.extend import InputError, errors, models
from advsearch.models.zoo import zero_shot
from advsearch.models.zoo.library import (
    AdaptedNetwork,
    LoadedNetwork,
    report_library_errors,
)

TASK = "similarity"  # the task that compares features
# Suffixes of the names of transformers' architectures without a head.
HEADLESS_SUFFIXES = ("Model", "ModelWithProjection")
# Names of the weights of a first token that stands for the full image.
CLASS_TOKEN_NAMES = ("cls_token", "class_embedding", "class_token")


def gives_features(architecture: str, network: Any) -> bool:
    """Return whether a network of transformers returns features of images.

    Such a network has no head. Detectors without a head do not count.

    Args:
        architecture: name such as "Dinov2Model" or "CLIPVisionModelWithProjection".
        network: the network or its class; None for one that transformers does not have.
    """
    if (
        network is None
        or not architecture.endswith(HEADLESS_SUFFIXES)
        or zero_shot.encodes_images_and_texts(network)
    ):
        return False
    # A network that can take `encoder_outputs` has a decoder, which looks for objects in
    # the features of the encoder, as in DETR.
    is_detector = (
        "encoder_outputs" in inspect.signature(network.forward).parameters
        or "Detr" in architecture
    )
    takes_images = getattr(network, "main_input_name", None) == "pixel_values"
    return takes_images and not is_detector


def make_no_classes_error(name: str, what: str) -> errors.ModelError:
    """Return the error for a network without classes in a task that needs them.

    The message advises the task `similarity`.

    Args:
        name: name of the model.
        what: what the network is, such as "is a Dinov2Model".
    """
    return errors.ModelError(
        f"model {name}: {what}, which returns features and has no classes: use "
        f"`task={TASK}`, which compares "
        "them with those of other pictures, or give a network with a head"
    )


def make_feature_source(
    loaded: LoadedNetwork, plain: Callable[[LoadedNetwork], models.Source] | None = None
) -> models.Source:
    """Return the source of a network whose features are compared.

    Args:
        loaded: the network.
        plain: makes the source of the network for its other tasks; None if the network
            has only features.

    Raises:
        ModelError: the network has no classes, or no features.
        InputError: there are prompts, which this task does not use.
    """
    if loaded.purpose.task != TASK:
        if plain is None:
            kind = type(loaded.network).__name__
            raise make_no_classes_error(loaded.name, f"is a {kind}")
        return plain(loaded)
    if loaded.purpose.prompts is not None:
        raise InputError(
            f"prompt: task {TASK} compares pictures and reads no text; "
            "leave `prompt` out"
        )
    return _make_comparing_source(loaded)


def _make_comparing_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a network without its head, for the task of features."""
    network = loaded.network
    config = network.config
    # the network without a head: features are its output
    backbone = network
    if zero_shot.encodes_images_and_texts(network):
        zero_shot.check_takes_pictures(network, loaded.spec)
        config = getattr(config, "vision_config", config)
    elif "ForImageClassification" in type(network).__name__:
        backbone = _find_backbone(network, loaded.spec)
    compute_features = partial(_compute_features, token=_has_class_token(backbone))
    loaded = replace(loaded, network=backbone)
    fields = loaded.get_sized_preprocessing(config)
    return loaded.make_source(compute_features, **fields)


def _has_class_token(network: Any) -> bool:
    """Return whether a network has a first token that stands for the full image.

    The parameters of a class token have names such as "cls_token".
    """
    return any(
        word in name
        for name, _ in network.named_parameters()
        for word in CLASS_TOKEN_NAMES
    )


def _compute_features(network: Any, images: Tensor, *, token: bool) -> Any:
    """Return the features (N, D) of images (N, 3, H, W).

    If there are none, the network's own return value is returned. `token` states
    whether they are those of the first token.
    """
    reads_texts = zero_shot.encodes_images_and_texts(network)
    encode = network.get_image_features if reads_texts else network
    returned = encode(pixel_values=images)
    features = models.pooled(returned, token=token)
    return returned if features is None else features


def _find_backbone(network: Any, spec: str) -> Any:
    """Return the part of a classifier before its head.

    Raises ModelError if it has none.
    """
    backbone = network.base_model
    # `base_model` is the network itself if transformers does not know its parts.
    if backbone is network:
        backbone = getattr(network, "vision_model", None)
    if backbone is None:
        raise errors.ModelError(
            f"model {spec}: has no part before its head; give its network without one"
        )
    return backbone


DISPARITY = "relative disparity"
METRIC = "metric depth"
"""Kinds of depth values, as in `advsearch.tasks.depth.KINDS`."""

BY_FAMILY = {
    "dpt": DISPARITY,
    "depth_pro": DISPARITY,
    "zoedepth": METRIC,
    "glpn": METRIC,
}
"""The kind of values of networks whose ``config`` does not state it, by family. It is
that of the weights that were published first.
"""


def make_depth_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a network that predicts depth.

    Its output is a mapping from the kind of values, such as "metric depth", to the
    values (N, h, w).
    """
    config = loaded.network.config
    kind_of_type = {"relative": DISPARITY, "metric": METRIC}
    kind = kind_of_type.get(getattr(config, "depth_estimation_type", ""), "")
    if not kind:
        kind = BY_FAMILY.get(config.model_type, "predicted_depth")
    is_zoedepth = config.model_type == "zoedepth"
    is_padded = is_zoedepth and bool(getattr(loaded.processor, "do_pad", False))

    def run_network(network: Any, images: Tensor) -> dict[str, Tensor]:
        """Return the values (N, h, w) under their kind for images (N, 3, H, W)."""
        if is_padded:
            return {kind: _predict_padded_depth(network, images)}
        return {kind: network(pixel_values=images).predicted_depth}

    return loaded.make_source(run_network)


def _predict_padded_depth(network: Any, images: Tensor) -> Tensor:
    """Return the depth (N, H, W) that ZoeDepth predicts for images (N, 3, H, W).

    ZoeDepth was trained on images with a mirrored border. This repeats what its
    processor in transformers does: it adds a border of this size (the formula is that
    of the library) and resizes the result to the input size. The post-processing
    resizes back and cuts the border off.
    """
    height, width = images.shape[2:]
    top = int(math.sqrt(height / 2.0) * 3.0)
    left = int(math.sqrt(width / 2.0) * 3.0)
    padded = functional.pad(images, (left, left, top, top), mode="reflect")
    resized = functional.interpolate(
        padded, size=(height, width), mode="bilinear", align_corners=True
    )
    depth: Tensor = network(pixel_values=resized).predicted_depth[:, None]
    depth = functional.interpolate(depth, size=padded.shape[2:], mode="bicubic")
    return depth[:, 0, top : top + height, left : left + width]


MASKS = (
    r"^(Mask2Former|OneFormer|Eomt\w*)ForUniversalSegmentation$"
    r"|^MaskFormerForInstanceSegmentation$"
)
"""Pattern of architectures that return masks and their classes."""

# Size to which transformers resizes the masks of every Mask2Former before their sum.
MASK_SIZE = (384, 384)
SENTENCE = "the task is semantic"  # the text input of OneFormer


def make_mask_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a network that returns masks and their classes.

    The network has queries, each with a mask and with probabilities of classes. The
    output of the source is the logarithm of a score (N, classes, H, W) of each class at
    each pixel of the input. The score of a class is a sum over queries: the probability
    that the query is of that class, times the probability that the pixel is in its mask
    (Cheng et al. 2021, arXiv 2107.06278, section 3.4, "semantic inference"). Masks are
    resized before or after that sum, as `post_process_semantic_segmentation` of each
    family does it.

    Warns:
        ModelWarning: always; it describes the scores, which are no logits.
    """
    models.warn(
        f"model {loaded.name} gives a pixel a score of each class, summed over its "
        "masks, which is no logit: its "
        "logarithm is used, so that margins are logarithms of a ratio of scores"
    )
    family = str(loaded.network.config.model_type)
    sentence = _tokenize_sentence(loaded) if family == "oneformer" else None
    run_network = partial(_run_mask_network, family=family, sentence=sentence)
    return loaded.make_source(run_network, labels=loaded.class_names or None)


def _run_mask_network(
    network: Any, images: Tensor, *, family: str, sentence: Tensor | None
) -> Tensor:
    """Return logarithms of scores (N, classes, H, W) for images (N, 3, H, W).

    Args:
        network: network that returns masks and their classes.
        images: (N, 3, H, W).
        family: type of the network in its ``config``.
        sentence: (1, L) tokens of a text that states the task; None without it.
    """
    size = (images.shape[2], images.shape[3])
    task_inputs = {}
    if sentence is not None:
        tokens = sentence.to(images.device).expand(len(images), -1)
        task_inputs = {"task_inputs": tokens}
    returned = network(pixel_values=images, **task_inputs)
    masks = returned.masks_queries_logits  # (N, queries, h, w)
    # (N, queries, classes) without the last class, which means no object
    classes = returned.class_queries_logits.softmax(dim=-1)[..., :-1]
    if family == "mask2former":
        masks = functional.interpolate(masks, size=MASK_SIZE, mode="bilinear")
    elif family.startswith("eomt"):
        masks = functional.interpolate(masks, size=size, mode="bilinear")
    scores = torch.einsum("bqc,bqhw->bchw", classes, masks.sigmoid())
    scores = functional.interpolate(scores, size=size, mode="bilinear")
    log_scores: Tensor = scores.float().clamp_min(models.MIN_PROBABILITY).log()
    return log_scores


def _tokenize_sentence(loaded: LoadedNetwork) -> Tensor:
    """Return the tokens (1, L) of the text that OneFormer reads, padded with 0."""
    tokens = loaded.load_component("AutoTokenizer")(
        [SENTENCE],
        return_tensors="pt",
        padding="max_length",
        max_length=loaded.network.config.task_seq_len,
        truncation=True,
    )
    return torch.as_tensor(tokens["input_ids"] * tokens["attention_mask"])


# ---- ``timm:NAME`` and ``torchvision:NAME`` ----


def load_timm(spec: str, purpose: models.Purpose) -> models.Source:
    """Load ``timm:NAME[@weights.safetensors]``.

    By default it has timm's pretrained weights. Size, normalization and labels are
    those of the pretrained weights in any case.

    Raises:
        ModelError: timm is missing, its weights cannot be loaded, or the user's weights
            do not fit.
        UnknownNameError: timm has no network of that name.
    """
    name, weights = models.split_weights(spec.partition(":")[2])
    timm = models.import_library("timm", spec, "timm")
    if not timm.is_model(name.partition(".")[0]):
        raise errors.UnknownNameError(
            "timm network", name, models.find_near_names(name, timm.list_models())
        )
    with report_library_errors(spec, f"Give 'timm:{name}@weights.safetensors'"):
        module = timm.create_model(name, pretrained=weights is None)
    if weights is not None:
        models.load_weights(module, weights, name)
    return _make_timm_source(timm, module, name, purpose)


def load_timm_repository(
    spec: str, name: str, revision: str, purpose: models.Purpose
) -> models.Source:
    """Load the network of a repository, or of a directory, that timm has saved.

    Args:
        spec: what the user wrote, for messages.
        name: name of the repository, or path of the directory.
        revision: revision of the repository; "" for the newest.
        purpose: what the network is loaded for.

    Raises:
        ModelError: timm is missing, or the network cannot be loaded.
    """
    timm = models.import_library("timm", spec, "timm")
    if Path(name).is_dir():
        location = f"local-dir:{name}"
    else:
        location = f"hf-hub:{name}{'@' if revision else ''}{revision}"
    with report_library_errors(
        spec, "Give a folder with config.json and model.safetensors, as timm saves them"
    ):
        module = timm.create_model(location, pretrained=True)
    return _make_timm_source(timm, module, name.rstrip("/").rpartition("/")[2], purpose)


def find_timm_source(
    network: nn.Module, purpose: models.Purpose
) -> models.Source | None:
    """Return the source of an existing network of timm; None for any other network."""
    timm: Any = sys.modules.get("timm")
    if timm is None or not isinstance(getattr(network, "pretrained_cfg", None), dict):
        return None
    return _make_timm_source(timm, network, type(network).__name__, purpose)


def make_wrapped_timm_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a network of timm that transformers has wrapped.

    The wrapper is a `TimmWrapperForImageClassification`. Preprocessing and names of
    classes are those in the ``config`` of transformers, which may differ from timm's.
    There are no labels if they are only numbers there.
    """
    timm = models.import_library("timm", loaded.spec, "timm")
    network: Any = loaded.network
    return _make_timm_source(
        timm,
        network.timm_model,
        loaded.name,
        loaded.purpose,
        pretrained_config=getattr(network.config, "pretrained_cfg", None),
        labels=loaded.class_names,
    )


def _make_timm_source(
    timm: Any,
    module: Any,
    name: str,
    purpose: models.Purpose,
    pretrained_config: Mapping[str, Any] | None = None,
    labels: tuple[str, ...] = (),
) -> models.Source:
    """Return the source of a network of timm, for its classes or its features.

    Args:
        timm: the library.
        module: the network.
        name: name of the model.
        purpose: what the network is loaded for.
        pretrained_config: replacement of its ``pretrained_cfg``.
        labels: names of classes that take precedence over timm's.
    """
    needs_features = purpose.task == TASK  # the task that compares features
    has_head = module.num_classes > 0
    if not has_head and not needs_features:
        problem = "is a network without a head (num_classes is 0)"
        raise make_no_classes_error(name, problem)
    options = {}
    if pretrained_config:
        options = {"pretrained_cfg": dict(pretrained_config)}
    config = timm.data.resolve_model_data_config(module, **options)
    network = module
    if needs_features and has_head:
        network = AdaptedNetwork(module, _compute_timm_features)
    names = labels or _find_timm_names(timm, module)
    return models.make_source(
        network,
        name,
        input_size=tuple(map(int, config["input_size"][1:])),
        mean=tuple(map(float, config["mean"])),
        std=tuple(map(float, config["std"])),
        labels=tuple(map(str, names)) if names and not needs_features else None,
    )


def _compute_timm_features(network: Any, images: Tensor) -> Any:
    """Return the features (N, D) that the head of a network of timm turns into logits."""
    # With `pre_logits`, timm leaves out the last layer of the head.
    return network.forward_head(network.forward_features(images), pre_logits=True)


def _find_timm_names(timm: Any, module: Any) -> Sequence[str]:
    """Return the names of the classes of a network of timm.

    Empty if they are not known, or if their count is not that of the classes.
    """
    names = module.pretrained_cfg.get("label_names")
    if not names:
        subset = timm.data.infer_imagenet_subset(module)
        if subset:
            names = timm.data.ImageNetInfo(subset).label_descriptions()
    has_all = names and len(names) == module.num_classes
    return names if has_all else ()


MAX_DETECTOR_BATCH = 4
"""Maximum batch size of a detector: at 800 x 800 pixels, an image with its derivative
takes one or two gigabytes.
"""


def load_torchvision(spec: str) -> models.Source:
    """Load ``torchvision:NAME[@weights.safetensors]``.

    By default it has torchvision's default weights. Size, normalization and labels are
    those of the default weights in any case, if torchvision has them.

    Raises:
        ModelError: torchvision is missing or broken, its weights cannot be loaded, the
            user's weights do not fit, or the network is quantized or for videos.
        UnknownNameError: torchvision has no such network.
    """
    name, weights = models.split_weights(spec.partition(":")[2])
    zoo = models.import_library("torchvision", spec, "torchvision").models
    classifiers = zoo.list_models(module=zoo)
    segmenters = zoo.list_models(module=zoo.segmentation)
    detectors = zoo.list_models(module=zoo.detection)
    known_names = (*classifiers, *segmenters, *detectors)
    if name not in known_names:
        raise _make_unknown_network_error(zoo, name, known_names, spec)
    default = getattr(zoo.get_model_weights(name), "DEFAULT", None)
    # Without this option torchvision would fetch weights of the backbone, which are
    # replaced afterwards. Classifiers have no such option.
    options: dict[str, Any] = {}
    if name not in classifiers:
        options["weights_backbone"] = None
    options["weights"] = None if weights else default
    module = _build_torchvision_network(zoo, spec, options)
    if name in classifiers:
        return models.make_source(module, name, **_get_default_fields(default, module))
    fields = _get_default_fields(default, classifier=None)
    if name in segmenters:
        network = AdaptedNetwork(module, _run_segmenter)
        return models.make_source(network, name, **fields)
    return _make_detector_source(module, name, fields)


def _build_torchvision_network(
    zoo: Any, spec: str, options: Mapping[str, Any]
) -> nn.Module:
    """Return a network of torchvision with the weights that the user states, if any.

    Args:
        zoo: torchvision's networks.
        spec: what the user wrote, ``torchvision:NAME[@weights.safetensors]``.
        options: arguments of torchvision's function that builds a network.

    Raises:
        ModelError: torchvision cannot build it, or the user's weights do not fit.
    """
    name, weights = models.split_weights(spec.partition(":")[2])
    with report_library_errors(spec, f"Give 'torchvision:{name}@weights.safetensors'"):
        module: nn.Module = zoo.get_model(name, **options)
    if weights is not None:
        models.load_weights(module, weights, name)
    return module


def _make_unknown_network_error(
    zoo: Any, name: str, known_names: Sequence[str], spec: str
) -> errors.UnknownNameError:
    """Return the error of a network that torchvision does not have.

    Args:
        zoo: torchvision's networks.
        name: name that the user wrote.
        known_names: names of all networks that can be loaded.
        spec: what the user wrote in full, for messages.

    Raises:
        ModelError: the network is for videos, or quantized.
    """
    _check_reads_images(zoo, name, spec)
    similar_names = models.find_near_names(name, known_names)
    return errors.UnknownNameError("torchvision network", name, similar_names)


def _make_detector_source(
    module: nn.Module, name: str, default_fields: Mapping[str, Any]
) -> models.Source:
    """Return the source of a detector of torchvision.

    Such a detector normalizes and resizes images by itself. The input size is the one
    to which it would resize a square image.

    Args:
        module: the detector.
        name: name of the model.
        default_fields: fields of the source that its default weights state.
    """
    fields = {
        **default_fields,
        "mean": None,
        "std": None,
        "batch_limits": (1, MAX_DETECTOR_BATCH),
    }
    input_size = _find_detector_size(module)
    if input_size is not None:
        fields["input_size"] = input_size
    network = AdaptedNetwork(module, _run_detector, returns_pixel_boxes=True)
    return models.make_source(network, name, **fields)


def _find_detector_size(module: nn.Module) -> tuple[int, int] | None:
    """Return the (height, width) to which a detector resizes a square image.

    None if its transform does not state the size.
    """
    transform = getattr(module, "transform", None)
    fixed_size = getattr(transform, "fixed_size", None)
    if fixed_size:
        width, height = fixed_size
        return int(height), int(width)
    min_size = getattr(transform, "min_size", None)
    if not min_size:
        return None
    # Of multiple sizes, torchvision uses the last one outside of training.
    size = int(min_size if isinstance(min_size, int) else min_size[-1])
    return size, size


def _check_reads_images(zoo: Any, name: str, spec: str) -> None:
    """Raise ModelError for a network of torchvision that is not for single images."""
    for module_name, text in NOT_FOR_PICTURES.items():
        module = getattr(zoo, module_name, None)
        if module is not None and name in zoo.list_models(module=module):
            plain = f"torchvision:{name.removeprefix('quantized_')}"
            raise errors.ModelError(f"model {spec}: {text.format(plain=plain)}")


NOT_FOR_PICTURES = {
    "video": "is made for videos, but gets images here; name a network for images, or "
    "wrap it in an nn.Module that makes a video of each image, and pass that from "
    "Python",
    "optical_flow": "compares two images of a video, but gets one at a time here; "
    "name a network for single images",
    "quantization": "is quantized: it rounds, and no gradient goes through it; name "
    "{plain}, of which it was made, or pass it from Python and search with a policy "
    "without gradients, such as nes",
}
"""Descriptions of torchvision's other networks by module, with advice, for messages."""


def _run_detector(network: Any, images: Tensor) -> Any:
    """Return the detections of each image (N, 3, H, W)."""
    return network(list(images))


def _run_segmenter(network: Any, images: Tensor) -> Any:
    """Return the logits (N, classes, H, W) of a segmenter."""
    return network(images)["out"]


def _get_default_fields(
    default: Any | None, classifier: nn.Module | None
) -> dict[str, Any]:
    """Return the fields of a source that default weights of torchvision state.

    Args:
        default: the weights; None if there are none.
        classifier: network whose last layer the labels have to fit (they are left out
            otherwise); None for a network that is no classifier.
    """
    mean, std = models.PRESETS["imagenet"]
    fields: dict[str, Any] = {"input_size": (224, 224), "mean": mean, "std": std}
    if default is None:
        return fields
    fields |= _read_default_transforms(default.transforms())
    labels = tuple(str(label) for label in default.meta.get("categories", ()))
    # The user's weights may have other classes than the default weights.
    fits_classes = classifier is None or _count_classes(classifier) == len(labels)
    if labels and fits_classes:
        fields["labels"] = labels
    return fields


def _read_default_transforms(transforms: Any) -> dict[str, Any]:
    """Return size, mean and standard deviation that transforms of torchvision state."""
    fields: dict[str, Any] = {}
    crop_size = getattr(transforms, "crop_size", None)
    size = crop_size or getattr(transforms, "resize_size", None)
    if size:
        # A list of one number is the side of a square.
        fields["input_size"] = int(size[0]), int(size[-1])
    for key in ("mean", "std"):
        numbers = getattr(transforms, key, None)
        if numbers is not None:
            fields[key] = tuple(map(float, numbers))
    return fields


def _count_classes(classifier: nn.Module) -> int:
    """Return the size of the last bias of a classifier, 0 if there is none."""
    biases = [weights for weights in classifier.parameters() if weights.dim() == 1]
    return biases[-1].numel() if biases else 0
