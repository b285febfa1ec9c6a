"""Networks that answer for every pixel: how far it is, as Depth Anything does, or masks and their classes.

Those of masks, as Mask2Former is, become segmenters by the class of each pixel.
"""

from __future__ import annotations

import math
import re
import warnings
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from advsearch.models.model import SMALLEST_PROBABILITY, ModelWarning
from advsearch.models.source import Source
from advsearch.models.zoo.loaded import Loaded

DISPARITY, METRIC = "relative disparity", "metric depth"
"""What their numbers are, by the words of `advsearch.tasks.depth.KINDS`."""

BY_FAMILY = {"dpt": DISPARITY, "depth_pro": DISPARITY, "zoedepth": METRIC, "glpn": METRIC}
"""Of a network whose ``config`` does not say it, by family: that of the weights that are published first."""


def depth_source(loaded: Loaded) -> Source:
    """Return the source of a network that answers with how far each pixel is."""
    return loaded.source(_DepthMap(loaded.network, bool(getattr(loaded.processor, "do_pad", False))))


class _DepthMap(nn.Module):
    """A mapping with numbers (N, h, w) under what they are.

    ZoeDepth is shown pictures with a mirrored border, which its processor adds and its post-processing removes.

    Args:
        network: of transformers.
        padded: whether its processor adds a border.
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
    """Whether an architecture answers with masks and their classes."""
    return OURS.fullmatch(architecture) is not None


def mask_source(loaded: Loaded, labels: tuple[str, ...] | None) -> Source:
    """Return the source of a network that answers with masks and their classes.

    Args:
        loaded: the network.
        labels: names of its classes.

    Warns:
        ModelWarning: what its scores are.
    """
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

    The score of a class is the sum over queries of the probability that it is a query's, times the probability that
    the pixel is in that one's mask (Cheng et al. 2021, arXiv 2107.06278, section 3.4, "semantic inference"). Sizes are
    changed where `post_process_semantic_segmentation` of each family changes them.

    Args:
        network: of transformers.
        told: the task in tokens, (1, L); None of a network that has one task.
    """

    told: Tensor | None

    def __init__(self, network: Any, told: Tensor | None) -> None:
        super().__init__()
        self.network, self.family = network, str(network.config.model_type)
        self.register_buffer("told", told)

    def forward(self, images: Tensor) -> Tensor:
        size = (images.shape[2], images.shape[3])
        tokens = {} if self.told is None else {"task_inputs": self.told.expand(len(images), -1)}
        answer = self.network(pixel_values=images, **tokens)
        masks, classes = answer.masks_queries_logits, answer.class_queries_logits.softmax(dim=-1)[..., :-1]
        if self.family == "mask2former":
            masks = functional.interpolate(masks, size=FINE, mode="bilinear")
        elif self.family.startswith("eomt"):
            masks = functional.interpolate(masks, size=size, mode="bilinear")
        scores = torch.einsum("bqc,bqhw->bchw", classes, masks.sigmoid())
        scores = functional.interpolate(scores, size=size, mode="bilinear")
        return scores.float().clamp_min(SMALLEST_PROBABILITY).log()
