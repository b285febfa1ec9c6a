"""Networks that find whatever they are told to by name, as OWL-ViT and Grounding DINO do: detectors of given names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from advsearch.errors import InputError, ModelError
from advsearch.models.labels import patterns
from advsearch.models.probe import first_line
from advsearch.models.source import Purpose, Source, sharing_copy, source_of
from advsearch.models.zoo.loaded import Loaded, in_pixels
from advsearch.models.zoo.processors import Measured
from advsearch.models.zoo.zero_shot import averaged, say_what_is_one, spoken

BARE = ("{}",)
"""The text of a name in a list of names."""

Build = Callable[[Any, Any, Sequence[str], tuple[str, ...] | None, str], nn.Module]
"""Makes a detector of a network, its tokenizer, the words for each name, the prompts that were given, and its name."""


def finds(architecture: str) -> bool:
    """Whether networks of this architecture, by name, are read here."""
    return architecture in DETECTORS


def source(loaded: Loaded) -> Source:
    """Return the source of a network that becomes a detector when names are there."""
    return loaded.when_named(_named)


def _named(network: Any, tokenizer: Any, name: str, described: Measured, purpose: Purpose) -> Source:
    """Return the detector of these names."""
    names = purpose.named(name, "finds what it is told to", "detection")
    try:
        with torch.no_grad():
            network = sharing_copy(network).eval()
            build = DETECTORS[type(network).__name__]
            detector = build(network, tokenizer, spoken(names), purpose.prompts, name)
    except (InputError, ModelError):
        raise
    except Exception as error:  # any network may raise anything
        raise ModelError(f"model {name}: cannot read the names of `labels` ({first_line(error)})") from error
    say_what_is_one(tokenizer, spoken(names), names, name)
    return source_of(detector, name, labels=names, dtype=network.dtype, **described)


class _Owl(nn.Module):
    """Boxes (N, patches, 4) in pixels, x0 y0 x1 y1, and scores (N, patches, names) in [0, 1] of each name by itself.

    Minderer et al. 2022 (arXiv 2205.06230), section 3: each patch of the picture is one box, compared with the text of
    each name. The half for texts is left out.

    Args:
        network: ``OwlViTForObjectDetection`` or ``Owlv2ForObjectDetection``.
        rows: (names, features), the texts.
    """

    rows: Tensor
    boxes_are_corners_in_pixels = True

    def __init__(self, network: Any, rows: Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("rows", rows)
        half = _half(network)
        half.text_model = half.text_projection = None

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        features = self.network.image_embedder(pixel_values=images)[0]
        patches = features.flatten(1, 2)
        logits, _ = self.network.class_predictor(patches, self.rows.expand(len(images), -1, -1))
        boxes = self.network.box_predictor(patches, features)
        return in_pixels(boxes, images), logits.sigmoid()


def _half(network: Any) -> Any:
    """Return the CLIP in an OWL."""
    return getattr(network, network.base_model_prefix)


def _owl(network: Any, tokenizer: Any, words: Sequence[str], prompts: tuple[str, ...] | None, name: str) -> nn.Module:
    """Return the detector; the texts of a name are averaged as CLIP's are."""
    return _Owl(network, averaged(_half(network), tokenizer, words, patterns(prompts)).to(network.dtype))


class _Grounded(nn.Module):
    """Boxes (N, queries, 4) in pixels, x0 y0 x1 y1, and scores (N, queries, names) in [0, 1] of each name by itself.

    Liu et al. 2023 (arXiv 2303.05499), section 3: all names are one text, and a box has a score of each of its tokens.
    A name's is the largest of its own.

    Args:
        network: ``GroundingDinoForObjectDetection`` or ``MMGroundingDinoForObjectDetection``.
        text: (1, L) int64, its tokens.
        places: (names, most) int64, where in it the tokens of each name are; a shorter one's first is there again.
    """

    text: Tensor
    places: Tensor
    boxes_are_corners_in_pixels = True

    def __init__(self, network: Any, text: Tensor, places: Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("text", text)
        self.register_buffer("places", places)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        answer = self.network(pixel_values=images, input_ids=self.text.expand(len(images), -1))
        scores = answer.logits[..., self.places].amax(dim=-1).sigmoid()
        return in_pixels(answer.pred_boxes, images), scores


def _grounded(
    network: Any, tokenizer: Any, words: Sequence[str], prompts: tuple[str, ...] | None, name: str
) -> nn.Module:
    """Return the detector of one text, ``mug. cup. bowl.``, as its processor writes it."""
    prompt, *others = patterns(prompts or BARE)
    if others:
        raise InputError(
            f"prompt: model {name} reads all names in one text, in which several prompts can't be averaged; give one, "
            "or none for the names alone"
        )
    text = ". ".join(prompt.replace("{}", word).strip().lower() for word in words) + "."
    tokens = torch.tensor(tokenizer(text, verbose=False)["input_ids"], device=network.device)
    most = network.config.max_text_len
    if len(tokens) > most:
        raise InputError(
            f"labels: model {name} reads a text of at most {most} tokens, and the names take {len(tokens)}; give fewer"
        )
    marks = torch.isin(tokens, network.model.special_tokens)
    between = marks.cumsum(dim=0)[~marks]  # which of the gaps between marks a token is in
    own = [(~marks).nonzero().flatten()[between == gap] for gap in between.unique()]
    if len(own) != len(words):
        raise InputError(
            f"labels: model {name} reads the names as one text with full stops between them, in which these "
            f"{len(words)} are {len(own)}; leave . and ? out of names and prompt"
        )
    longest = max(map(len, own))
    places = torch.stack([torch.cat([run, run[:1].expand(longest - len(run))]) for run in own])
    return _Grounded(network, tokens[None], places)


DETECTORS: dict[str, Build] = {
    "OwlViTForObjectDetection": _owl,
    "Owlv2ForObjectDetection": _owl,
    "GroundingDinoForObjectDetection": _grounded,
    "MMGroundingDinoForObjectDetection": _grounded,
}
"""What makes a detector of a network, by the name of its architecture."""
