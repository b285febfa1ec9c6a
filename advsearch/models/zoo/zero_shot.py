"""Networks of given names: classifiers that compare pictures with texts, as CLIP and
SigLIP do, and detectors.

Detectors, as OWL-ViT and Grounding DINO are, find whatever they are told to by name.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from advsearch.extend import InputError, errors, models
from advsearch.models.zoo.library import Adapted, Ask, Loaded, in_pixels, nearly

TEXTS = 64  # texts that are embedded at once


def compares(network: Any) -> bool:
    """Whether a network of transformers, or the class of one, has a half for pictures
    and one for texts.
    """
    return all(hasattr(network, f"get_{half}_features") for half in ("image", "text"))


def source(loaded: Loaded) -> models.Source:
    """Return the source of a classifier of the names that are given. Raises ModelError
    where the network takes patches in place of pictures, or its scores are other than
    are worked out here.
    """
    check_takes_pictures(loaded.network, loaded.spec)
    name = loaded.name
    names = loaded.purpose.named(
        loaded.name, "compares a picture with texts", "classification"
    )
    prompts = models.patterns(loaded.purpose.prompts)
    if len(names) < 2:
        raise InputError(
            f"labels: expected two names at least, of which model {name} "
            f"chooses one, got {names[0]!r}"
        )
    tokenizer = loaded.part("AutoTokenizer")
    words = spoken(names)
    alone = hasattr(loaded.network, "logit_bias")
    texts = [prompts[0].replace("{}", word) for word in words]
    with (
        models.foreign(f"model {name}: cannot embed the names of `labels`"),
        torch.no_grad(),
    ):
        network: Any = models.sharing_copy(loaded.network).eval()
        scale = (
            network.temperature.reciprocal()
            if hasattr(network, "temperature")
            else network.logit_scale.exp()
        )
        rows = averaged(network, tokenizer, words, prompts)
        head = nn.Linear(rows.shape[1], len(names))
        head.weight.copy_(scale.float() * rows)
        head.bias.copy_(network.logit_bias.float() if alone else torch.zeros(()))
        compared = _Compared(network, head.to(network.device))
        made = loaded.with_texts(compared, names, network.dtype)
        _check(network, compared, tokenizer, texts[0], made)
    say_what_is_one(tokenizer, texts, names, name)
    if alone:
        models.warn(
            f"model {name} judges each name by itself, with a sigmoid of its logit: "
            "the scores that are shown are a "
            f"softmax over the {len(names)} names, and margins are differences of "
            "logits"
        )
    return made


def check_takes_pictures(network: Any, spec: str) -> None:
    """Raise a ModelError for a network that takes patches in place of pictures; `spec`
    is for the message.
    """
    if "spatial_shapes" in inspect.signature(network.get_image_features).parameters:
        raise errors.ModelError(
            f"model {spec}: takes patches of pictures of any size (NaFlex), which are "
            "no picture; give a "
            "checkpoint of a fixed resolution, such as "
            "hf:google/siglip2-base-patch16-224"
        )


def spoken(names: Sequence[str]) -> list[str]:
    """Return what stands for each name in a text: of synonyms with commas between them
    the first, if that is one's.
    """
    first = [name.partition(",")[0].strip() or name for name in names]
    return [
        short if first.count(short) == 1 else name
        for short, name in zip(first, names, strict=True)
    ]


def _encoded(
    network: Any, tokenizer: Any, texts: Sequence[str]
) -> Mapping[str, Tensor]:
    """Return texts as the network was trained on them: SigLIP's are as long as can be,
    the others' as the longest.
    """
    most = min(
        int(network.config.text_config.max_position_embeddings),
        int(tokenizer.model_max_length),
    )
    for text, tokens in zip(
        texts, tokenizer(list(texts), verbose=False)["input_ids"], strict=True
    ):
        if len(tokens) > most:
            raise InputError(
                f"prompt: expected texts of at most {most} tokens, got "
                f"{len(tokens)}: {text[:80]!r}"
            )
    padding = "max_length" if hasattr(network, "logit_bias") else True
    given = tokenizer(
        list(texts),
        padding=padding,
        max_length=most,
        truncation=True,
        return_tensors="pt",
    )
    taken = inspect.signature(network.forward).parameters
    return {
        key: value.to(network.device) for key, value in given.items() if key in taken
    }


def averaged(
    network: Any, tokenizer: Any, words: Sequence[str], prompts: Sequence[str]
) -> Tensor:
    """Return one row (words, features) of length 1 for each word: its text in each
    prompt, embedded and averaged. They are normalised before and after (Radford et al.
    2021, arXiv 2103.00020, section 3.1.4).
    """
    each = []
    for prompt in prompts:
        texts = [prompt.replace("{}", word) for word in words]
        parts = [
            _encoded(network, tokenizer, texts[begin : begin + TEXTS])
            for begin in range(0, len(texts), TEXTS)
        ]
        rows = torch.cat([_pooled(network.get_text_features(**part)) for part in parts])
        each.append(functional.normalize(rows, dim=-1))
    return functional.normalize(torch.stack(each).mean(dim=0), dim=-1)


def _pooled(returned: Any) -> Tensor:
    features: Tensor = getattr(returned, "pooler_output", returned)
    return features.float()


class _Compared(nn.Module):
    """Logits (N, names): the scaled cosine of a picture and each name. The half for
    texts is left out.
    """

    def __init__(self, network: nn.Module, head: nn.Linear) -> None:
        super().__init__()
        self.network: Any = models.sharing_copy(network)
        for part in [
            part for part, _ in self.network.named_children() if part.startswith("text")
        ]:
            setattr(self.network, part, None)
        self.head = head

    def seen(self, images: Tensor) -> Tensor:  # features (N, D) of length 1
        return functional.normalize(
            _pooled(self.network.get_image_features(pixel_values=images)), dim=-1
        )

    def forward(self, images: Tensor) -> Tensor:
        scores: Tensor = self.head(self.seen(images))
        return scores


def _check(
    network: Any, compared: _Compared, tokenizer: Any, text: str, made: models.Source
) -> None:
    """Raise a ModelError where the network itself gives a picture of noise and a text
    another score.
    """
    shape = (1, 3, *(made.input_size or (224, 224)))
    noise = torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(
        network.device, network.dtype
    )
    own = network(
        **_encoded(network, tokenizer, [text]), pixel_values=noise
    ).logits_per_image.float()
    scale = compared.head.weight.norm(dim=-1).max()
    row = scale * averaged(network, tokenizer, [text], ["{}"])
    ours = compared.seen(noise) @ row.T + compared.head.bias[0]
    if own.shape != ours.shape or not nearly(
        own, ours, max(float(scale), float(own.abs().max())), network.dtype
    ):
        raise errors.ModelError(
            f"model {made.name}: is a {type(network).__name__}, whose scores are no "
            "scaled cosine of a picture and a "
            "text; expected one such as CLIPModel or SiglipModel"
        )


def say_what_is_one(
    tokenizer: Any, texts: Sequence[str], names: Sequence[str], name: str
) -> None:
    """Warn of names that are the same to the network: in another case, say, or of words
    that it does not know.
    """
    seen: dict[tuple[int, ...], int] = {}
    for number, tokens in enumerate(tokenizer(list(texts), verbose=False)["input_ids"]):
        first = seen.setdefault(tuple(tokens), number)
        if first != number:
            models.warn(
                f"model {name} reads {names[first]!r} (#{first}) and {names[number]!r} "
                f"(#{number}) as the same text: "
                "it cannot tell one from the other"
            )
            return


Build = Callable[[Loaded, Any, Any, Sequence[str]], Ask]
"""Makes what asks a detector, of what was loaded, a copy of its network, its tokenizer
and the words for each name: for boxes (N, K, 4) in pixels, x0 y0 x1 y1, and scores (N,
K, names) in [0, 1] of each name by itself.
"""


def detector(loaded: Loaded) -> models.Source:
    """Return the source of a detector of the names that are given, of a network of one
    of `DETECTORS`.
    """
    names = loaded.purpose.named(loaded.name, "finds what it is told to", "detection")
    tokenizer = loaded.part("AutoTokenizer")
    words = spoken(names)
    with (
        models.foreign(f"model {loaded.name}: cannot read the names of `labels`"),
        torch.no_grad(),
    ):
        network: Any = models.sharing_copy(loaded.network).eval()
        ask = DETECTORS[type(network).__name__](loaded, network, tokenizer, words)
    say_what_is_one(tokenizer, words, names, loaded.name)
    return loaded.with_texts(Adapted(network, ask, boxes=True), names, network.dtype)


def _owl(loaded: Loaded, network: Any, tokenizer: Any, words: Sequence[str]) -> Ask:
    """Each patch of the picture is one box, compared with the text of each name (Minderer et al. 2022, arXiv
    2205.06230, section 3). The texts of a name are averaged as CLIP's are. The half of OWL for texts is left out
    then."""
    half = getattr(network, network.base_model_prefix)
    rows = averaged(half, tokenizer, words, models.patterns(loaded.purpose.prompts)).to(
        network.dtype
    )
    half.text_model = half.text_projection = None

    def ask(network: Any, images: Tensor) -> tuple[Tensor, Tensor]:
        features = network.image_embedder(pixel_values=images)[0]
        patches = features.flatten(1, 2)
        logits, _ = network.class_predictor(
            patches, rows.to(patches).expand(len(images), -1, -1)
        )
        return in_pixels(
            network.box_predictor(patches, features), images
        ), logits.sigmoid()

    return ask


def _grounded(
    loaded: Loaded, network: Any, tokenizer: Any, words: Sequence[str]
) -> Ask:
    """All names are one text, ``mug. cup. bowl.`` as its processor writes it, and a box
    has a score of each of its tokens (Liu et al. 2023, arXiv 2303.05499, section 3). A
    name's is the largest of its own.
    """
    name, (prompt, *others) = (
        loaded.name,
        models.patterns(loaded.purpose.prompts or ("{}",)),
    )
    if others:
        raise InputError(
            f"prompt: model {name} reads all names in one text, in which several "
            "prompts can't be averaged; give one, "
            "or none for the names alone"
        )
    text = ". ".join(prompt.replace("{}", word).strip().lower() for word in words) + "."
    tokens = torch.tensor(
        tokenizer(text, verbose=False)["input_ids"], device=network.device
    )
    most = network.config.max_text_len
    if len(tokens) > most:
        raise InputError(
            f"labels: model {name} reads a text of at most {most} tokens, and the "
            f"names take {len(tokens)}; give fewer"
        )
    marks = torch.isin(tokens, network.model.special_tokens)
    # which of the gaps between marks a token is in
    between = marks.cumsum(dim=0)[~marks]
    own = [(~marks).nonzero().flatten()[between == gap] for gap in between.unique()]
    if len(own) != len(words):
        raise InputError(
            f"labels: model {name} reads the names as one text with full stops between "
            "them, in which these "
            f"{len(words)} are {len(own)}; leave . and ? out of names and prompt"
        )
    longest = max(map(len, own))  # (names, most): a shorter one's first is there again
    places = torch.stack(
        [torch.cat([run, run[:1].expand(longest - len(run))]) for run in own]
    )

    def ask(network: Any, images: Tensor) -> tuple[Tensor, Tensor]:
        returned = network(
            pixel_values=images, input_ids=tokens.expand(len(images), -1)
        )
        return in_pixels(returned.pred_boxes, images), returned.logits[
            ..., places
        ].amax(dim=-1).sigmoid()

    return ask


DETECTORS: dict[str, Build] = {
    "OwlViTForObjectDetection": _owl,
    "Owlv2ForObjectDetection": _owl,
    "GroundingDinoForObjectDetection": _grounded,
    "MMGroundingDinoForObjectDetection": _grounded,
}
"""What makes a detector of a network, by the name of its architecture."""
