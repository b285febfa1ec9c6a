"""Networks whose classes are names that the user states.

These are classifiers that compare images with texts, such as CLIP and SigLIP; and
detectors that find objects by their names, such as OWL-ViT and Grounding DINO.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from advsearch.extend import InputError, errors, models
from advsearch.models.zoo.library import (
    AdaptedNetwork,
    LoadedNetwork,
    RunNetwork,
    are_nearly_equal,
    to_pixel_corners,
)

TEXT_BATCH_SIZE = 64  # maximum number of texts that are embedded at once


def encodes_images_and_texts(network: Any) -> bool:
    """Return whether a network of transformers, or its class, has both encoders.

    These encode images and texts.
    """
    return all(hasattr(network, f"get_{half}_features") for half in ("image", "text"))


def make_zero_shot_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a classifier of the names that the user states.

    Raises:
        ModelError: the network takes patches instead of images, or its scores differ
            from those computed here.
        InputError: there are fewer than two names, or a prompt has no ``{}``.

    Warns:
        ModelWarning: two names have the same tokens; or the network scores each name
            independently, and the reported scores are a softmax over all names.
    """
    check_takes_pictures(loaded.network, loaded.spec)
    name = loaded.name
    names = _require_several_names(loaded)
    prompts = models.get_patterns(loaded.purpose.prompts)
    tokenizer = loaded.load_component("AutoTokenizer")
    words = get_spoken_names(names)
    # One text per name, with the first prompt: scores are checked with the first of
    # them, and names with equal tokens are found by all of them.
    texts = [prompts[0].replace("{}", word) for word in words]
    with (
        models.translate_errors(f"model {name}: cannot embed the names of `labels`"),
        torch.no_grad(),
    ):
        # A copy is set to evaluation mode: the network may be the user's own.
        network: Any = models.copy_sharing_weights(loaded.network).eval()
        embeddings = embed_words(network, tokenizer, words, prompts)
        head = _make_head(network, embeddings)
        classifier = _CosineClassifier(network, head.to(network.device))
        source = loaded.make_text_source(classifier, names, network.dtype)
        _check_scores(network, classifier, tokenizer, texts[0], source)
    warn_of_equal_texts(tokenizer, texts, names, name)
    # Networks of this kind, such as SigLIP, are the only ones with a bias of logits.
    is_trained_with_sigmoid = hasattr(loaded.network, "logit_bias")
    if is_trained_with_sigmoid:
        models.warn(
            f"model {name} scores each name independently, by a sigmoid of its logit: "
            f"displayed scores are a softmax over the {len(names)} names, and margins "
            "are differences of logits"
        )
    return source


def _require_several_names(loaded: LoadedNetwork) -> tuple[str, ...]:
    """Return the names that the user states for a network to choose from.

    Raises:
        InputError: there are fewer than two names.
    """
    names = loaded.purpose.require_names(
        loaded.name, "compares a picture with texts", "classification"
    )
    if len(names) < 2:
        raise InputError(
            f"labels: expected two names at least, of which model {loaded.name} "
            f"chooses one, got {names[0]!r}"
        )
    return names


def _make_head(network: Any, embeddings: Tensor) -> nn.Linear:
    """Return the layer from embeddings of images to logits of names.

    Args:
        network: states the scale of cosines, and maybe a bias.
        embeddings: (names, F) of the names, of length 1.
    """
    if hasattr(network, "temperature"):
        scale = network.temperature.reciprocal()
    else:
        scale = network.logit_scale.exp()
    head = nn.Linear(embeddings.shape[1], embeddings.shape[0])
    # `copy_` needs a context without gradients, which the caller has opened.
    # An image's embedding has length 1 too, so that products are cosines.
    head.weight.copy_(scale.float() * embeddings)
    has_bias = hasattr(network, "logit_bias")
    head.bias.copy_(network.logit_bias.float() if has_bias else torch.zeros(()))
    return head


def check_takes_pictures(network: Any, spec: str) -> None:
    """Raise ModelError for a network that takes patches instead of images.

    Args:
        network: network of transformers.
        spec: what the user wrote, for the message.
    """
    if "spatial_shapes" in inspect.signature(network.get_image_features).parameters:
        raise errors.ModelError(
            f"model {spec}: takes patches of pictures of any size (NaFlex), which are "
            "no picture; give a checkpoint of a fixed resolution, such as "
            "hf:google/siglip2-base-patch16-224"
        )


def get_spoken_names(names: Sequence[str]) -> list[str]:
    """Return the text for each name.

    It is the first of the synonyms that commas separate: "tench" for "tench, Tinca
    tinca". If several names have the same first synonym, it is the full name.
    """
    first_synonyms = [name.partition(",")[0].strip() or name for name in names]
    return [
        synonym if first_synonyms.count(synonym) == 1 else name
        for synonym, name in zip(first_synonyms, names, strict=True)
    ]


def _tokenize(
    network: Any, tokenizer: Any, texts: Sequence[str]
) -> Mapping[str, Tensor]:
    """Tokenize texts in the form in which the network was trained.

    SigLIP was trained on texts that are padded to the maximum length. Other texts are
    padded to the length of the longest.

    Raises:
        InputError: a text is too long.
    """
    max_tokens = min(
        int(network.config.text_config.max_position_embeddings),
        int(tokenizer.model_max_length),
    )
    _check_text_lengths(tokenizer, texts, max_tokens)
    is_siglip = hasattr(network, "logit_bias")
    inputs = tokenizer(
        list(texts),
        padding="max_length" if is_siglip else True,  # True: to the longest
        max_length=max_tokens,
        truncation=True,
        return_tensors="pt",
    )
    parameters = inspect.signature(network.forward).parameters
    used_inputs = {key: value for key, value in inputs.items() if key in parameters}
    return {key: value.to(network.device) for key, value in used_inputs.items()}


def _check_text_lengths(tokenizer: Any, texts: Sequence[str], max_tokens: int) -> None:
    """Raise InputError if one of several texts has too many tokens."""
    tokens_of_texts = tokenizer(list(texts), verbose=False)["input_ids"]
    for text, tokens in zip(texts, tokens_of_texts, strict=True):
        if len(tokens) > max_tokens:
            raise InputError(
                f"prompt: expected texts of at most {max_tokens} tokens, got "
                f"{len(tokens)}: {text[:80]!r}"
            )


def embed_words(
    network: Any, tokenizer: Any, words: Sequence[str], prompts: Sequence[str]
) -> Tensor:
    """Embed each word in each prompt, and average over prompts.

    Embeddings are normalized before and after (Radford et al. 2021, arXiv 2103.00020,
    section 3.1.4).

    Returns:
        (words, features), rows of length 1.
    """
    embeddings_of_prompts = []
    for prompt in prompts:
        texts = [prompt.replace("{}", word) for word in words]
        features = _embed_texts(network, tokenizer, texts)
        embeddings_of_prompts.append(functional.normalize(features, dim=-1))
    mean = torch.stack(embeddings_of_prompts).mean(dim=0)
    return functional.normalize(mean, dim=-1)


def _embed_texts(network: Any, tokenizer: Any, texts: Sequence[str]) -> Tensor:
    """Return the features (texts, D) of texts, a batch at a time."""
    batches = []
    for begin in range(0, len(texts), TEXT_BATCH_SIZE):
        batch = texts[begin : begin + TEXT_BATCH_SIZE]
        inputs = _tokenize(network, tokenizer, batch)
        batches.append(_get_features(network.get_text_features(**inputs)))
    return torch.cat(batches)


def _get_features(returned: Any) -> Tensor:
    """Return the features (N, D), float32, in the return value of an encoder."""
    features: Tensor = getattr(returned, "pooler_output", returned)
    return features.float()


class _CosineClassifier(nn.Module):
    """Compute logits (N, names): the scaled cosine of an image and each name.

    The text encoder is removed, since the embeddings of names are the weights of
    `head`.
    """

    def __init__(self, network: nn.Module, head: nn.Linear) -> None:
        super().__init__()
        self.network: Any = models.copy_sharing_weights(network)
        # This is a copy, so that its text encoder (children such as "text_model" and
        # "text_projection") can be removed.
        child_names = [name for name, _ in self.network.named_children()]
        for name in child_names:
            if name.startswith("text"):
                setattr(self.network, name, None)
        self.head = head

    def embed_images(self, images: Tensor) -> Tensor:
        """Return the features (N, D) of images, which have length 1."""
        features = _get_features(self.network.get_image_features(pixel_values=images))
        return functional.normalize(features, dim=-1)

    def forward(self, images: Tensor) -> Tensor:
        """Return the logits (N, names) of images (N, 3, H, W)."""
        scores: Tensor = self.head(self.embed_images(images))
        return scores


def _check_scores(
    network: Any,
    classifier: _CosineClassifier,
    tokenizer: Any,
    text: str,
    source: models.Source,
) -> None:
    """Check that a classifier and its network compute the same score.

    The score is that of an image of noise and a text.

    Args:
        network: network with its text encoder.
        classifier: classifier that is checked, with the same weights.
        tokenizer: tokenizer of the network.
        text: the text.
        source: states the size of images.

    Raises:
        ModelError: the scores differ.
    """
    noise = _sample_noise_image(network, source.input_size or (224, 224))
    inputs = _tokenize(network, tokenizer, [text])
    expected = network(**inputs, pixel_values=noise).logits_per_image.float()
    # The rows of the head are embeddings of length 1, multiplied by the scale of
    # cosines.
    scale = classifier.head.weight.norm(dim=-1).max()
    # With the prompt "{}" the text is used as it is.
    embedding = embed_words(network, tokenizer, [text], ["{}"])
    computed = _compute_score(classifier, noise, scale * embedding)
    # Scores are scaled cosines, whose rounding errors are in proportion to the scale.
    magnitude = max(float(scale), float(expected.abs().max()))
    are_equal = expected.shape == computed.shape and are_nearly_equal(
        expected, computed, magnitude, network.dtype
    )
    if not are_equal:
        raise errors.ModelError(
            f"model {source.name}: is a {type(network).__name__}, whose scores are no "
            "scaled cosine of a picture and a "
            "text; expected one such as CLIPModel or SiglipModel"
        )


def _sample_noise_image(network: Any, size: tuple[int, int]) -> Tensor:
    """Return an image (1, 3, height, width) of uniform noise for a network.

    Args:
        network: states the device and the dtype.
        size: (height, width) in pixels.
    """
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand((1, 3, *size), generator=generator)
    return noise.to(network.device, network.dtype)


def _compute_score(
    classifier: _CosineClassifier, image: Tensor, embedding: Tensor
) -> Tensor:
    """Return the score (1, 1) of an image (1, 3, H, W) for a scaled embedding (1, D)."""
    bias = classifier.head.bias[0]  # the same for all names
    return classifier.embed_images(image) @ embedding.T + bias


def warn_of_equal_texts(
    tokenizer: Any, texts: Sequence[str], names: Sequence[str], name: str
) -> None:
    """Warn of the first two names with the same tokens.

    For example, they differ only in case, or the network knows neither word.

    Args:
        tokenizer: tokenizer of the network.
        texts: text of each name.
        names: names of classes.
        name: name of the model.
    """
    index_of_tokens: dict[tuple[int, ...], int] = {}
    tokens_of_texts = tokenizer(list(texts), verbose=False)["input_ids"]
    for index, tokens in enumerate(tokens_of_texts):
        first = index_of_tokens.setdefault(tuple(tokens), index)
        if first != index:
            models.warn(
                f"model {name} reads {names[first]!r} (#{first}) and {names[index]!r} "
                f"(#{index}) as the same text: it cannot distinguish them"
            )
            return


BuildDetector = Callable[[LoadedNetwork, Any, Any, Sequence[str]], RunNetwork]
"""Creates the function that runs a detector.

Its arguments are what was loaded, a copy of the network, its tokenizer, and the text of
each name. The function that it creates returns boxes (N, K, 4) in pixels, x0, y0, x1,
y1, and independent scores (N, K, names) in [0, 1].
"""


def make_detector_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a detector of the names that the user states.

    Its network is one of `DETECTORS`.
    """
    name = loaded.name
    names = loaded.purpose.require_names(
        name, "finds objects by their names", "detection"
    )
    tokenizer = loaded.load_component("AutoTokenizer")
    words = get_spoken_names(names)
    with (
        models.translate_errors(f"model {name}: cannot read the names of `labels`"),
        torch.no_grad(),
    ):
        network: Any = models.copy_sharing_weights(loaded.network).eval()
        build_detector = DETECTORS[type(network).__name__]
        run_network = build_detector(loaded, network, tokenizer, words)
    warn_of_equal_texts(tokenizer, words, names, name)
    module = AdaptedNetwork(network, run_network, returns_pixel_boxes=True)
    return loaded.make_text_source(module, names, network.dtype)


def _build_owl(
    loaded: LoadedNetwork, network: Any, tokenizer: Any, words: Sequence[str]
) -> RunNetwork:
    """Return the function that runs an OWL-ViT detector (`BuildDetector`).

    Each patch of the image has one box, and its features are compared with those of the
    names (Minderer et al. 2022, arXiv 2205.06230, section 3). The features of a name
    are averaged over prompts, as in CLIP. After they were computed, the text encoder is
    removed from `network`, which nothing else uses.
    """
    base_model = getattr(network, network.base_model_prefix)
    prompts = models.get_patterns(loaded.purpose.prompts)
    embeddings = embed_words(base_model, tokenizer, words, prompts).to(network.dtype)
    base_model.text_model = None
    base_model.text_projection = None
    return partial(_run_owl, embeddings)


def _run_owl(embeddings: Tensor, network: Any, images: Tensor) -> tuple[Tensor, Tensor]:
    """Return boxes and scores of OWL-ViT for images (N, 3, H, W).

    Args:
        embeddings: (names, D) features of the names.
        network: the network without its text encoder.
        images: (N, 3, H, W).
    """
    features = network.image_embedder(pixel_values=images)[0]
    patches = features.flatten(1, 2)
    queries = embeddings.to(patches).expand(len(images), -1, -1)
    # It also returns embeddings of the patches, which are not needed.
    logits, _embeddings = network.class_predictor(patches, queries)
    boxes = network.box_predictor(patches, features)
    return to_pixel_corners(boxes, images), logits.sigmoid()


def _build_grounding_dino(
    loaded: LoadedNetwork, network: Any, tokenizer: Any, words: Sequence[str]
) -> RunNetwork:
    """Return the function that runs a Grounding DINO detector (`BuildDetector`).

    All names are in one text, ``mug. cup. bowl.``, and a box has a score for each token
    (Liu et al. 2023, arXiv 2303.05499, section 3). The score of a name is the maximum
    over its tokens.

    Raises:
        InputError: there are several prompts, the text is too long, or a name has a
            full stop in it.
    """
    prompt = _choose_prompt(loaded)
    text = ". ".join(prompt.replace("{}", word).strip().lower() for word in words) + "."
    tokens = torch.tensor(
        tokenizer(text, verbose=False)["input_ids"], device=network.device
    )
    name = loaded.name
    _check_token_count(len(tokens), network.config.max_text_len, name)
    # (names, longest name) indices of the tokens of each name. The full stop between
    # names is one of the special tokens, so that each run of other tokens is a name.
    token_index = _find_token_runs(tokens, network.model.special_tokens)
    if len(token_index) != len(words):
        raise InputError(
            f"labels: model {name} reads the names as one text with full stops between "
            f"them, in which it finds {len(token_index)} names instead of {len(words)}; "
            "leave . and ? out of names and prompt"
        )
    return partial(_run_grounding_dino, tokens, token_index)


def _check_token_count(count: int, max_tokens: int, name: str) -> None:
    """Raise InputError if names take more tokens than a model reads."""
    if count > max_tokens:
        raise InputError(
            f"labels: model {name} reads a text of at most {max_tokens} tokens, and "
            f"the names take {count}; give fewer"
        )


def _choose_prompt(loaded: LoadedNetwork) -> str:
    """Return the prompt of a network that reads all names in one text.

    Raises:
        InputError: there are several.
    """
    prompt, *other_prompts = models.get_patterns(loaded.purpose.prompts or ("{}",))
    if other_prompts:
        raise InputError(
            f"prompt: model {loaded.name} reads all names in one text, in which several "
            "prompts can't be averaged; give one, or none for the names alone"
        )
    return prompt


def _run_grounding_dino(
    tokens: Tensor, token_index: Tensor, network: Any, images: Tensor
) -> tuple[Tensor, Tensor]:
    """Return boxes and scores of Grounding DINO for images (N, 3, H, W).

    Args:
        tokens: (L,) tokens of the text with all names.
        token_index: (names, longest name) indices of the tokens of each name.
        network: the network.
        images: (N, 3, H, W).
    """
    returned = network(pixel_values=images, input_ids=tokens.expand(len(images), -1))
    name_logits = returned.logits[..., token_index].amax(dim=-1)
    return to_pixel_corners(returned.pred_boxes, images), name_logits.sigmoid()


def _find_token_runs(tokens: Tensor, separators: Any) -> Tensor:
    """Return the indices of the tokens between separators.

    A run is a sequence of tokens between two separators.

    Args:
        tokens: (L,) tokens of a text.
        separators: tensor or list of the tokens that separate runs.

    Returns:
        (runs, longest run) indices; a shorter run is padded with its first index.
    """
    is_separator = torch.isin(tokens, separators)
    # The tokens of a run have the same number of separators before them.
    run_of_token = is_separator.cumsum(dim=0)[~is_separator]
    token_index = (~is_separator).nonzero().flatten()
    runs = [token_index[run_of_token == run] for run in run_of_token.unique()]
    longest = max(map(len, runs), default=0)
    padded = [torch.cat([run, run[:1].expand(longest - len(run))]) for run in runs]
    return torch.stack(padded) if padded else token_index.new_zeros((0, 0))


DETECTORS: dict[str, BuildDetector] = {
    "OwlViTForObjectDetection": _build_owl,
    "Owlv2ForObjectDetection": _build_owl,
    "GroundingDinoForObjectDetection": _build_grounding_dino,
    "MMGroundingDinoForObjectDetection": _build_grounding_dino,
}
"""Functions that build detectors, by architecture."""
