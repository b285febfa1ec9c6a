"""Networks of transformers that return features (DINOv2, ViT, the half of CLIP that sees pictures) or by pixel.

For every pixel some say how far it is, as Depth Anything does, others masks and their classes: these, as Mask2Former,
become segmenters by the class of each pixel.
"""

from __future__ import annotations

import inspect
import math
import re
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from advsearch.errors import InputError, ModelError
from advsearch.models.model import SMALLEST_PROBABILITY, Model, ModelWarning
from advsearch.models.source import Purpose, Source
from advsearch.models.zoo import zero_shot
from advsearch.models.zoo.library import Loaded, Measured

TASK = "similarity"
"""The task that compares features."""

ENDINGS = ("Model", "ModelWithProjection")
PARTS = ("image_embeds", "pooler_output", "last_hidden_state")
"""What holds the features in outputs of transformers, the best first."""

TOKENS = ("cls_token", "class_embedding", "class_token")
"""How weights of a first token are called that stands for the whole picture."""


def gives_features(architecture: str, network: Any) -> bool:
    """Whether a network of transformers, or the class of one, has features of a picture and no head; its architecture
    is a name such as Dinov2Model or CLIPVisionModelWithProjection. None stands for one that transformers has not."""
    if network is None or not architecture.endswith(ENDINGS) or zero_shot.compares(network):
        return False
    finds = "encoder_outputs" in inspect.signature(network.forward).parameters or "Detr" in architecture
    return getattr(network, "main_input_name", None) == "pixel_values" and not finds


def source(loaded: Loaded) -> Source:
    """Return the source of a network that has nothing but features."""
    return Source(loaded.network, loaded.name, finish=partial(_finished, loaded, None))


def also(plain: Callable[[Loaded], Source], *, reads_text: bool = False) -> Callable[[Loaded], Source]:
    """Return what makes the source of a network: that of its features where these are compared, else `plain`'s."""

    def made(loaded: Loaded) -> Source:
        return Source(loaded.network, loaded.name, finish=partial(_finished, loaded, plain), reads_text=reads_text)

    return made


def no_classes(name: str, what: str) -> ModelError:
    """Return the error for a model that is asked for classes and has features only; `what` it is: "is a
    Dinov2Model"."""
    return ModelError(
        f"model {name}: {what}, which returns features and has no classes: use `task={TASK}`, which compares "
        "them with those of other pictures, or give a network with a head"
    )


def _finished(loaded: Loaded, plain: Callable[[Loaded], Source] | None, purpose: Purpose) -> Source | Model:
    if purpose.task == TASK:
        if purpose.prompts is not None:
            raise InputError(f"prompt: task {TASK} compares pictures and reads no text; leave `prompt` out")
        network = loaded.network
        part, config = network, network.config
        if zero_shot.compares(network):
            zero_shot.check_takes_pictures(network, loaded.spec)
            config = getattr(config, "vision_config", config)
        elif "ForImageClassification" in type(network).__name__:
            part = network.base_model if network.base_model is not network else getattr(network, "vision_model", None)
            if part is None:
                raise ModelError(f"model {loaded.spec}: has no part before its head; give its network without one")
        described, side = loaded.described, getattr(config, "image_size", None)
        if "input_size" not in described and isinstance(side, int):
            described = Measured(**{**described, "input_size": (side, side)})
        return loaded.source(_Features(part), **described)
    if plain is None:
        raise no_classes(loaded.name, f"is a {type(loaded.network).__name__}")
    found = plain(loaded)
    return found if found.finish is None else found.finish(purpose)


def pooled(returned: Any, *, token: bool) -> Tensor | None:
    """Return the features (N, D) in an output of a network, a tensor (N, D) or what has one of `PARTS`; None where
    there are none. Maps (N, D, H, W) are averaged over their positions. Of several tokens (N, T, D), the first stands
    for the picture if `token`, otherwise their mean."""
    for part in PARTS:
        value = returned.get(part) if isinstance(returned, Mapping) else getattr(returned, part, None)
        if isinstance(value, Tensor):
            if value.dim() == 3:
                return value[:, 0] if token else value.mean(dim=1)
            return value.flatten(2).mean(dim=2) if value.dim() == 4 else value
    return returned if isinstance(returned, Tensor) else None


class _Features(nn.Module):
    """Features (N, D): those that the network gives, else the first token where that stands for the picture, else the
    mean over positions."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network, self.compares = network, zero_shot.compares(network)
        self.has_token = any(one in name for name, _ in network.named_parameters() for one in TOKENS)

    def forward(self, images: Tensor) -> Tensor:
        asked = self.network.get_image_features if self.compares else self.network
        returned = asked(pixel_values=images)
        found = pooled(returned, token=self.has_token)
        return returned if found is None else found


DISPARITY, METRIC = "relative disparity", "metric depth"
"""What their numbers are, by the words of `advsearch.tasks.depth.KINDS`."""

BY_FAMILY = {"dpt": DISPARITY, "depth_pro": DISPARITY, "zoedepth": METRIC, "glpn": METRIC}
"""Of a network whose ``config`` does not say it, by family: that of the weights that are published first."""


def depth_source(loaded: Loaded) -> Source:
    """Return the source of a network that returns how far each pixel is."""
    return loaded.source(_DepthMap(loaded.network, bool(getattr(loaded.processor, "do_pad", False))))


class _DepthMap(nn.Module):
    """A mapping with numbers (N, h, w) under what they are.

    ZoeDepth is shown pictures with a mirrored border, which its processor adds (`padded`) and its post-processing
    removes.
    """

    def __init__(self, network: Any, padded: bool) -> None:
        super().__init__()
        said = {"relative": DISPARITY, "metric": METRIC}.get(getattr(network.config, "depth_estimation_type", ""), "")
        self.network, self.kind = network, (said or BY_FAMILY.get(network.config.model_type, "predicted_depth"))
        self.padded = padded and network.config.model_type == "zoedepth"

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        if not self.padded:
            return {self.kind: self.network(pixel_values=images).predicted_depth}
        height, width = images.shape[2:]
        down, across = (int(math.sqrt(side / 2.0) * 3.0) for side in (height, width))
        framed = functional.pad(images, (across, across, down, down), mode="reflect")
        shown = functional.interpolate(framed, size=(height, width), mode="bilinear", align_corners=True)
        found = self.network(pixel_values=shown).predicted_depth[:, None]
        found = functional.interpolate(found, size=framed.shape[2:], mode="bicubic")
        return {self.kind: found[:, 0, down : down + height, across : across + width]}


OURS = re.compile(r"(Mask2Former|OneFormer|Eomt\w*)ForUniversalSegmentation|MaskFormerForInstanceSegmentation")
"""The architectures, by name."""

FINE = (384, 384)
"""Height and width to which transformers brings the masks of every Mask2Former before it adds them up."""

SENTENCE = "the task is semantic"
"""What OneFormer is told to do."""


def is_ours(architecture: str, network: Any) -> bool:
    """Whether an architecture returns masks and their classes."""
    return OURS.fullmatch(architecture) is not None


def mask_source(loaded: Loaded, labels: tuple[str, ...] | None) -> Source:
    """Return the source of a network that returns masks and their classes. Warns what its scores are
    (ModelWarning)."""
    warnings.warn(
        f"model {loaded.name} gives a pixel a score of each class, summed over its masks, which is no logit: its "
        "logarithm is used, so that margins are logarithms of a ratio of scores",
        ModelWarning,
        stacklevel=3,
    )
    told = None
    if loaded.network.config.model_type == "oneformer":
        told = _told(loaded.part("AutoTokenizer"), loaded.network.config.task_seq_len)
    return loaded.source(_MaskQueries(loaded.network, told), labels=labels)


def _told(tokenizer: Any, length: int) -> Tensor:
    """Return `SENTENCE` as OneFormer reads it, (1, length): numbers of tokens, filled up with 0."""
    given = tokenizer([SENTENCE], padding="max_length", max_length=length, truncation=True, return_tensors="pt")
    return torch.as_tensor(given["input_ids"] * given["attention_mask"])


class _MaskQueries(nn.Module):
    """Logarithms of scores (N, classes, H, W) of each pixel of the input.

    The score of a class is the sum over queries of the probability that it is a query's, times the probability that the
    pixel is in that one's mask (Cheng et al. 2021, arXiv 2107.06278, section 3.4, "semantic inference"). Sizes are
    changed where `post_process_semantic_segmentation` of each family changes them. A network of several tasks is told
    its own in tokens (1, L).
    """

    told: Tensor | None

    def __init__(self, network: Any, told: Tensor | None) -> None:
        super().__init__()
        self.network, self.family = network, str(network.config.model_type)
        self.register_buffer("told", told)

    def forward(self, images: Tensor) -> Tensor:
        size = (images.shape[2], images.shape[3])
        tokens = {} if self.told is None else {"task_inputs": self.told.expand(len(images), -1)}
        returned = self.network(pixel_values=images, **tokens)
        masks, classes = returned.masks_queries_logits, returned.class_queries_logits.softmax(dim=-1)[..., :-1]
        if self.family == "mask2former":
            masks = functional.interpolate(masks, size=FINE, mode="bilinear")
        elif self.family.startswith("eomt"):
            masks = functional.interpolate(masks, size=size, mode="bilinear")
        scores = torch.einsum("bqc,bqhw->bchw", classes, masks.sigmoid())
        scores = functional.interpolate(scores, size=size, mode="bilinear")
        return scores.float().clamp_min(SMALLEST_PROBABILITY).log()
