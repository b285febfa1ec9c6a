"""Networks that continue an image and a text with text, such as LLaVA and Qwen-VL.

They choose one of the names that the user states, or answer freely.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from advsearch.extend import InputError, errors, models
from advsearch.models.zoo.library import (
    LoadedNetwork,
    Processing,
    are_nearly_equal,
    measure_processor,
)
from advsearch.models.zoo.zero_shot import get_spoken_names

PIXEL_TOLERANCE = 0.05
"""Maximum difference of pixel values from those that the processor computes for an
8-bit image, relative to the largest of these: the processor rounds.
"""

# Continuation by which a network that answers freely is checked.
CHECK_TEXT = "a coffee mug"
# Minimum number of weights for a warning about memory and time.
MIN_LARGE_WEIGHTS = 500_000_000


def generates_text(architecture: str, network: Any) -> bool:
    """Return whether an architecture of transformers continues images and texts.

    Args:
        architecture: name of the architecture, which decides.
        network: not used; families of networks have functions with this signature.
    """
    transformers: Any = sys.modules["transformers"]
    names = transformers.models.auto.modeling_auto.MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING_NAMES
    return architecture in names.values()


def make_language_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a network that continues an image and a text with text.

    It chooses one of the names that the user states, or answers freely.

    Raises:
        ModelError: the network is an encoder-decoder, its processor cannot be loaded,
            or its own likelihoods differ from those computed here.
        InputError: there are fewer than two names, or prompt and name are too long.
    """
    if getattr(loaded.network.config, "is_encoder_decoder", False):
        raise _make_unsupported_error(loaded, "has a separate encoder")
    processor = _load_processor(loaded)
    name = loaded.name
    is_free, question = loaded.purpose.parse_question(name, "goes on in words")
    names = loaded.purpose.names
    if not is_free:
        _check_has_choice(names, name)
    kind = type(loaded.network).__name__
    with models.translate_errors(
        f"model {loaded.spec}: is a {kind}, which cannot be questioned about "
        "an image as LLaVA can"
    ):
        reader = _LanguageModel(loaded, processor, question or models.QUESTION)
        # Without names, likelihoods are checked with another text.
        tokens = reader.tokenize_names(names or (CHECK_TEXT,))
        module, seconds = _make_checked_module(loaded, reader, tokens, is_free=is_free)
    if names is not None:
        _warn_of_prefixes(tokens, names, name)
    _warn_of_size(loaded, seconds)
    return models.make_source(
        module,
        name,
        labels=names,
        batch_limits=(1, 1),  # the reader takes one image at a time
        reads_text=True,
        **reader.preprocessing,
    )


def _make_checked_module(
    loaded: LoadedNetwork,
    reader: _LanguageModel,
    tokens: Sequence[Sequence[int]],
    *,
    is_free: bool,
) -> tuple[nn.Module, float]:
    """Return the network that answers, once its likelihoods are checked.

    Args:
        loaded: the network.
        reader: reader of images and prompt.
        tokens: tokens of each name.
        is_free: whether it answers freely, and does not choose a name.

    Returns:
        The network, and the seconds that it takes for an image.
    """
    max_answer_tokens = loaded.purpose.tokens
    max_new_tokens = max(map(len, tokens))
    if is_free:
        max_new_tokens = max(max_new_tokens, max_answer_tokens)
    _check_length(loaded, reader, max_new_tokens)
    # A network that answers freely needs the classifier for the check only.
    classifier = _NameClassifier(reader, tokens)
    module = _FreeAnswerer(reader, max_answer_tokens) if is_free else classifier
    with torch.no_grad():
        _check_likelihood(loaded, classifier)
        black_image = torch.zeros((1, 3, *reader.image_size))
        return module, _measure_call_seconds(module, black_image)


def _find_max_error(values: Tensor, expected: Tensor) -> float:
    """Return the largest absolute difference; infinity for tensors of other shapes."""
    if values.shape != expected.shape:
        return float("inf")
    return float((values - expected).abs().max())


def _measure_call_seconds(module: nn.Module, images: Tensor) -> float:
    """Return how many seconds a network takes for images (N, 3, H, W)."""
    start_time = time.perf_counter()
    module(images)
    return time.perf_counter() - start_time


def _check_has_choice(names: Sequence[str] | None, model_name: str) -> None:
    """Raise InputError if there are fewer than two names to choose from."""
    if names is None or len(names) < 2:
        raise InputError(
            "labels: expected two names at least, such as mug,cup,bowl, of which "
            f"model {model_name} chooses one, got "
            f"{repr(names[0]) if names else 'none'}; with `task=answer` it "
            "answers freely"
        )


def _load_processor(loaded: LoadedNetwork) -> Any:
    """Load the processor of images and texts.

    Raises:
        ModelError: it cannot be loaded. Most processors need torchvision: the message
            names it if it is not installed.
    """
    try:
        return loaded.load_component("AutoProcessor")
    except errors.ModelError as error:
        if importlib.util.find_spec("torchvision") is None:
            raise errors.ModelError(
                f"model {loaded.spec}: its processor cannot be loaded, and most of "
                "such networks need torchvision for "
                "that, which is not installed: pip install 'advsearch[torchvision]'"
            ) from error
        raise


def _check_length(
    loaded: LoadedNetwork, reader: _LanguageModel, max_new_tokens: int
) -> None:
    """Check that image, prompt and answer are not too long for the network.

    Args:
        loaded: the network.
        reader: reader of images and prompt.
        max_new_tokens: maximum number of tokens of the answer.

    Raises:
        InputError: they have too many tokens.
    """
    config = loaded.network.config.get_text_config()
    max_tokens = getattr(config, "max_position_embeddings", None)
    prompt = reader.get_prompt(reader.image_size)
    n_tokens = prompt["input_ids"].shape[1] + max_new_tokens
    if isinstance(max_tokens, int) and n_tokens > max_tokens:
        raise InputError(
            f"prompt: expected picture, prompt and name to have at most {max_tokens} "
            f"tokens for model {loaded.name}, got {n_tokens}"
        )


def _warn_of_size(loaded: LoadedNetwork, seconds: float) -> None:
    """Warn of a large network, with the seconds that an answer took."""
    weights = list(loaded.network.parameters())
    count = sum(tensor.numel() for tensor in weights)
    if count >= MIN_LARGE_WEIGHTS:
        size = sum(tensor.nbytes for tensor in weights)
        models.warn(
            f"model {loaded.name} has {count / 1e9:.3g} billion weights, "
            f"{size / 1e9:.3g} GB, and took {seconds:.2g} s "
            "to answer one picture here; a gradient takes longer"
        )


def _warn_of_prefixes(
    tokens: Sequence[Sequence[int]], names: Sequence[str], model_name: str
) -> None:
    """Warn of the first name whose tokens are a prefix of another name's."""
    for (first, prefix), (second, other) in permutations(enumerate(tokens), 2):
        if list(other[: len(prefix)]) == list(prefix):
            models.warn(
                f"model {model_name} reads {names[first]!r} (#{first}) as the "
                f"beginning of {names[second]!r} "
                f"(#{second}): an answer with the second begins with the first"
            )
            return


# ---- the network ----


class _LanguageModel(nn.Module):
    """A network that reads an image and a question, and continues with text.

    If its image processor is an affine map of pixel values, the map is measured and
    `Preprocessing` applies it. A processor that cuts an image into patches or tiles is
    called itself, which is differentiable with torchvision.

    Attributes:
        preprocessing: fields of `Preprocessing`.
        cache_name: name of the cache of keys and values, among the network's arguments
            and in its output.
        is_affine: whether the image processor is an affine map.
    """

    def __init__(self, loaded: LoadedNetwork, processor: Any, question: str) -> None:
        """Prepare prompt and preprocessing for a network.

        Args:
            loaded: the network, with its name and its repository.
            processor: processor of images and texts.
            question: question about each image.

        Raises:
            ModelError: its processor cannot be used.
        """
        super().__init__()
        self.network = loaded.network
        self.processor = processor
        parameters = inspect.signature(loaded.network.forward).parameters
        # `past_key_values` is the older name.
        self.cache_name = "cache" if "cache" in parameters else "past_key_values"
        # by image size, see `get_prompt`
        self._prompts: dict[tuple[int, int], dict[str, Tensor]] = {}
        self.text = _make_prompt_text(processor, question)
        # size, mean and standard deviation; None if the processor is not affine
        processing = _measure_affine_processor(processor, self.text, loaded.spec)
        self.is_affine = processing is not None
        if processing is None:
            # Only with torchvision does a gradient go through the processor.
            _check_torchvision_installed(loaded.spec)
            processing = Processing()
        default_size = _read_image_size(loaded.network.config)
        self.image_size = processing.get("input_size", default_size)
        self.preprocessing = Processing(**{**processing, "input_size": self.image_size})
        self._check_pixels(loaded.spec)

    def _check_pixels(self, spec: str) -> None:
        """Check that a floating-point image gives the same pixel values as in 8 bits.

        Raises:
            ModelError: the processor treats them differently.
        """
        levels = _make_ramps(*self.image_size)
        image_8bit = np.ascontiguousarray(levels.byte().permute(1, 2, 0).numpy())
        expected = self._process(image_8bit)["pixel_values"]
        image = levels / 255.0
        if self.is_affine:
            # In use, `Preprocessing` does this before the image reaches this module.
            image = self._apply_preprocessing(image)
        pixels = self._compute_pixel_values(image)
        max_error = _find_max_error(pixels, expected)
        is_accurate = max_error <= PIXEL_TOLERANCE * float(expected.abs().max())
        if not is_accurate:  # also if the error is NaN
            raise errors.ModelError(
                f"model {spec}: its processor {type(self.processor).__name__} treats "
                "floating-point images differently from 8-bit images. Wrap network and "
                "processor in an nn.Module, and pass that from Python"
            )

    def _apply_preprocessing(self, image: Tensor) -> Tensor:
        """Return an image (3, H, W) with its channel order and colors normalized."""
        mean = image.new_tensor(self.preprocessing["mean"]).view(3, 1, 1)
        std = image.new_tensor(self.preprocessing["std"]).view(3, 1, 1)
        if self.preprocessing["channels"] != "RGB":
            image = image.flip(0)
        return (image - mean) / std

    def _process(self, image: Any, text: str = "", **options: Any) -> dict[str, Tensor]:
        """Return the network's inputs for an image and a text.

        The default text is the question. Inputs for training are left out.
        """
        # The library may warn about the way in which it reads arrays.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            processed = self.processor(
                images=[image],
                text=[text or self.text],
                return_tensors="pt",
                **options,
            )
        return {
            key: value
            for key, value in processed.items()
            if isinstance(value, Tensor) and key != "labels"
        }

    def _compute_pixel_values(self, image: Tensor) -> Tensor:
        """Return the network's input of pixel values for an image (3, H, W)."""
        if self.is_affine:
            return image[None]
        return self._process(image.float(), do_rescale=False)["pixel_values"]

    def tokenize_names(self, names: Sequence[str]) -> list[list[int]]:
        """Return the tokens of each name as they follow the prompt.

        In general, prompt and name are tokenized together, and the tokens of the prompt
        are removed from the beginning. Where the result does not begin with these, such
        as for a processor that ends each text with a newline, the name is tokenized
        alone.

        Raises:
            InputError: the network has no token for a name.
        """
        words = get_spoken_names(names)
        separator = self._find_separator()
        # A processor that adds tokens at the end of a text adds them to every text: the
        # first word is enough to find out.
        keeps_prompt = self._keeps_prompt(f"{separator}{words[0]}")
        tokens_of_names: list[list[int]] = []
        for word in words:
            # None if the tokenizer joins the end of the prompt with this word.
            tokens = self._tokenize_after_prompt(f"{separator}{word}")
            if tokens is None or not keeps_prompt:
                tokens = self._tokenize_alone(word)
            if not tokens:
                raise InputError(
                    "labels: expected names that the network has tokens "
                    f"for, got {word!r}"
                )
            tokens_of_names.append(tokens)
        return tokens_of_names

    def _tokenize_alone(self, word: str) -> list[int]:
        """Return the tokens of a word without the prompt and without special tokens."""
        tokenized = self.processor.tokenizer(word, add_special_tokens=False)
        tokens: list[int] = tokenized["input_ids"]
        return tokens

    def _find_separator(self) -> str:
        """Return the text between the prompt and a name.

        It is a space, or "" if the prompt ends with white space or a special token.
        """
        prompt_tokens = self._get_prompt_tokens()
        ends_with_special = (
            prompt_tokens[-1] in self.processor.tokenizer.all_special_ids
        )
        return "" if self.text[-1:].isspace() or ends_with_special else " "

    def _keeps_prompt(self, text: str) -> bool:
        """Return whether tokens of prompt and text begin with the tokens of the prompt.

        They do not if the processor adds a token at the end of each text.
        """
        prompt_tokens = self._get_prompt_tokens()
        inputs = self._process(_make_gray_image(self.image_size), f"{self.text}{text}")
        return inputs["input_ids"][0].tolist()[: len(prompt_tokens)] == prompt_tokens

    def _get_prompt_tokens(self) -> list[int]:
        """Return the tokens of the prompt, including those of an image."""
        tokens: list[int] = self.get_prompt(self.image_size)["input_ids"][0].tolist()
        return tokens

    def _tokenize_after_prompt(self, text: str) -> list[int] | None:
        """Return the tokens that a text adds to those of the prompt.

        None if the tokens of both do not begin with those of the prompt.
        """
        tokenizer = self.processor.tokenizer
        prompt_tokens = tokenizer(self.text, verbose=False)["input_ids"]
        all_tokens: list[int] = tokenizer(f"{self.text}{text}", verbose=False)[
            "input_ids"
        ]
        if all_tokens[: len(prompt_tokens)] != prompt_tokens:
            return None
        return all_tokens[len(prompt_tokens) :]

    def get_prompt(self, image_size: tuple[int, int]) -> dict[str, Tensor]:
        """Return the network's inputs for a gray image and the question.

        Args:
            image_size: (height, width) in pixels.
        """
        if image_size not in self._prompts:
            self._prompts[image_size] = self._process(_make_gray_image(image_size))
        return self._prompts[image_size]

    def make_inputs(self, image: Tensor) -> dict[str, Tensor]:
        """Return the network's inputs for an image (3, H, W) and the question.

        Raises:
            ValueError: the processor returns another shape than for a gray image.
        """
        height, width = image.shape[1:]
        prompt = self.get_prompt((height, width))
        pixels = self._compute_pixel_values(image)
        if pixels.shape != prompt["pixel_values"].shape:
            expected = tuple(prompt["pixel_values"].shape)
            raise ValueError(
                f"expected values of shape {expected}, got {tuple(pixels.shape)}"
            )
        weights = next(self.network.parameters())
        inputs = {key: value.to(weights.device) for key, value in prompt.items()}
        inputs["pixel_values"] = pixels.to(weights.device, weights.dtype)
        return inputs

    def read_prompt(self, image: Tensor) -> tuple[Tensor, Any]:
        """Run the network on an image and the prompt.

        Returns:
            The logits (vocabulary,), float32, of the next token; and the cache of keys
            and values, which `continue_with` takes.

        Raises:
            ValueError: the network returns no cache.
        """
        returned = self.network(**self.make_inputs(image), use_cache=True)
        past = returned.get(self.cache_name)
        if past is None:
            raise ValueError("it returns no cache of keys and values")
        return returned.logits[0, -1].float(), past

    def continue_with(self, tokens: Tensor, past: Any) -> Tensor:
        """Continue the text after an image with N alternatives of L tokens each.

        The cache is changed: afterwards it has N rows, which include these tokens.

        Args:
            tokens: (N, L) tokens.
            past: cache of keys and values of one image and the text so far.

        Returns:
            The logits (N, L, vocabulary), float32, of the token after each token.
        """
        # one row of the cache for each alternative, in place
        past.batch_repeat_interleave(len(tokens))
        logits: Tensor = self.network(
            input_ids=tokens, use_cache=True, **{self.cache_name: past}
        ).logits.float()
        return logits


class _NameClassifier(nn.Module):
    """Compute logits (N, names): the log-likelihood of each name after the prompt.

    The log-likelihood of a name is the sum over its tokens. Image and prompt are read
    once. Then the stem of each name, all of its tokens but the last, is read: once for
    all names that begin with it, and all stems in one batch. If all names have a single
    token, this second step is left out.
    """

    def __init__(self, reader: _LanguageModel, tokens: Sequence[Sequence[int]]) -> None:
        """Prepare stems, and the indices of the likelihoods of each name.

        `forward` computes a table of log-likelihoods of the next token, with a column
        for each token of the vocabulary. Row 0 is for the token after the prompt. Then
        follow the rows of the first stem, those of the second stem, and so on: a row
        for the token after each token of the stem. All stems are padded to the same
        length.

        Args:
            reader: the network.
            tokens: tokens of each name, at least one.
        """
        super().__init__()
        self.reader = reader
        self.tokens = [list(name_tokens) for name_tokens in tokens]
        stems = _find_stems(self.tokens)
        stem_length = max(map(len, stems), default=0)
        padded_stems = [[*stem, *[0] * (stem_length - len(stem))] for stem in stems]
        # (stems, stem length), and three times (names, longest name); see `forward`
        self._stems = torch.tensor(padded_stems).long()
        shape = (len(tokens), max(map(len, tokens)))
        self._rows = torch.zeros(shape, dtype=torch.long)
        self._columns = torch.zeros_like(self._rows)
        self._is_token = torch.zeros_like(self._rows)
        for index, name_tokens in enumerate(self.tokens):
            # the stem that is, or begins with, all tokens of the name but the last
            stem_index = _find_stem(stems, name_tokens[:-1])
            self._store_positions(index, name_tokens, 1 + stem_index * stem_length)

    def _store_positions(
        self, index: int, name_tokens: Sequence[int], first_stem_row: int
    ) -> None:
        """Store row and column in the table, and 1, for each token of a name.

        Shorter names are padded with 0.

        Args:
            index: index of the name.
            name_tokens: its tokens.
            first_stem_row: first row in the table of the stem of the name.
        """
        for position, token in enumerate(name_tokens):
            # The first token follows the prompt (row 0). Any other token follows
            # the token before it, which is in the stem.
            if position > 0:
                self._rows[index, position] = first_stem_row + position - 1
            self._columns[index, position] = token
            self._is_token[index, position] = 1

    def forward(self, images: Tensor) -> Tensor:
        """Return the log-likelihoods (N, names) for images (N, 3, H, W)."""
        # (names, longest name) each: row and column of each token of a name in the
        # table; and 1, or 0 in the padding of a shorter name
        rows = self._rows.to(images.device)
        columns = self._columns.to(images.device)
        is_token = self._is_token.to(images.device)
        scores = []
        for image in images:
            table = self._compute_table(image)
            token_likelihoods = table[rows, columns] * is_token
            scores.append(token_likelihoods.sum(dim=1))
        return torch.stack(scores)

    def _compute_table(self, image: Tensor) -> Tensor:
        """Return the log-likelihoods of the next token for an image (3, H, W).

        They are (1 + stems * stem length, vocabulary): after the prompt, and after each
        token of each stem.
        """
        stems = self._stems.to(image.device)
        logits, past = self.reader.read_prompt(image)
        table = logits.log_softmax(dim=-1)[None]
        if not len(stems):
            return table
        # This changes `past`, which is not used again.
        stem_logits = self.reader.continue_with(stems, past)
        stem_rows = stem_logits.log_softmax(dim=-1).flatten(0, 1)
        return torch.cat([table, stem_rows])


def _make_prompt_text(processor: Any, question: str) -> str:
    """Return the question with a placeholder for the image.

    It has the form of a chat if the network was trained on chats.
    """
    if getattr(processor, "chat_template", None):
        content = [{"type": "image"}, {"type": "text", "text": question}]
        turns = [{"role": "user", "content": content}]
        text: str = processor.apply_chat_template(turns, add_generation_prompt=True)
        return text
    return f"{getattr(processor, 'image_token', None) or ''}{question}"


def _read_image_size(config: Any) -> tuple[int, int]:
    """Return the image size (height, width) of a network's ``config``, or a default."""
    vision_config = getattr(config, "vision_config", None)
    size = getattr(vision_config, "image_size", None) or models.DEFAULT_SIZE
    height, width = size if isinstance(size, (list, tuple)) else (size, size)
    return int(height), int(width)


def _measure_affine_processor(
    processor: Any, prompt: str, spec: str
) -> Processing | None:
    """Return size, mean and standard deviation of a processor of images and texts.

    None if it does more to an image than to apply a gain and an offset.
    """
    # `measure_processor` raises ModelError for a processor that cuts images into
    # patches, which is not affine.
    with suppress(errors.ModelError):
        processing = measure_processor(
            # The processor takes no images without a text.
            lambda **options: processor(text=[prompt], **options),
            spec,
        )
        is_affine = "mean" in processing
        if is_affine:
            return processing
    return None


def _check_torchvision_installed(spec: str) -> None:
    """Raise ModelError if torchvision is not installed, which a processor needs."""
    if importlib.util.find_spec("torchvision") is None:
        raise errors.ModelError(
            f"model {spec}: its processor cuts pictures into patches or tiles, and "
            "lets gradients through with torchvision only, which is not installed: "
            "pip install 'advsearch[torchvision]'"
        )


def _make_gray_image(size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Return a gray image (height, width, 3), as a placeholder for any other image."""
    return np.full((*size, 3), 128, np.uint8)


def _make_ramps(height: int, width: int) -> Tensor:
    """Return a test image (3, H, W) of 8-bit levels, with a ramp in each channel.

    The ramps differ, so that an exchange of channels or axes is noticed.
    """
    vertical = torch.linspace(0, 200, height)[:, None].expand(height, width)
    horizontal = torch.linspace(0, 200, width).expand(height, width)
    diagonal = (vertical + horizontal) / 4 + 100  # from 100 to 200
    return torch.stack([vertical, horizontal, diagonal]).round()


def _find_stem(stems: Sequence[Sequence[int]], prefix: Sequence[int]) -> int:
    """Return the index of the first stem (tokens) that begins with a prefix.

    0 if there is none: then the name has one token, and the result is not used.
    """
    for index, stem in enumerate(stems):
        if list(stem[: len(prefix)]) == list(prefix):
            return index
    return 0


def _find_stems(tokens: Sequence[Sequence[int]]) -> list[tuple[int, ...]]:
    """Return the stems of names (all of their tokens but the last), sorted.

    Stems that are a prefix of another stem are left out.
    """
    stems = {tuple(name_tokens[:-1]) for name_tokens in tokens if len(name_tokens) > 1}
    return sorted(
        stem
        for stem in stems
        if not any(other[: len(stem)] == stem for other in stems - {stem})
    )


class _FreeAnswerer(nn.Module):
    """Answer freely about each image, by greedy decoding.

    Each next token is the most likely one. The outputs are
    `advsearch.tasks.answers.AnswerWithLogits`.
    """

    def __init__(self, reader: _LanguageModel, max_tokens: int) -> None:
        """Prepare the answers of a network.

        Args:
            reader: the network.
            max_tokens: maximum length of an answer.
        """
        super().__init__()
        self.reader = reader
        self.tokenizer = reader.processor.tokenizer
        self.max_tokens = max_tokens
        # one token, a list of tokens, or None
        end_tokens = reader.network.generation_config.eos_token_id
        if not isinstance(end_tokens, (list, tuple)):
            end_tokens = [end_tokens]
        self.end_tokens = frozenset(end_tokens) - {None}

    def forward(self, images: Tensor) -> list[dict[str, Any]]:
        """Return the answer about each of images (N, 3, H, W)."""
        return [self._answer(image) for image in images]

    def _answer(self, image: Tensor) -> dict[str, Any]:
        """Return the answer about an image (3, H, W).

        An answer of n tokens is a mapping with its "text"; the "logits" (n, vocabulary)
        from which the tokens were chosen; and under "begins" a function from a word to
        the tokens that may begin it. An answer ends with an end token, or after
        `max_tokens`.
        """
        next_logits, past = self.reader.read_prompt(image)
        logits_of_steps = [next_logits]
        tokens = [int(next_logits.argmax())]
        while tokens[-1] not in self.end_tokens and len(tokens) < self.max_tokens:
            # one alternative of one token, (1, 1)
            last_token = next_logits.new_tensor([[tokens[-1]]], dtype=torch.long)
            # This also adds the token to the cache `past`. There is one alternative,
            # and the logits after its last token are used.
            next_logits = self.reader.continue_with(last_token, past)[0, -1]
            logits_of_steps.append(next_logits)
            tokens.append(int(next_logits.argmax()))
        return {
            "text": self.tokenizer.decode(tokens, skip_special_tokens=True).strip(),
            "logits": torch.stack(logits_of_steps),
            "begins": self.find_first_tokens,
        }

    def find_first_tokens(self, word: str) -> list[int]:
        """Return the tokens that may begin a word.

        The word may be as it is or capitalized, with or without a space before it.
        """
        first_tokens: set[int] = set()
        for form in {word, word.capitalize(), f" {word}", f" {word.capitalize()}"}:
            tokens = self.tokenizer(form, add_special_tokens=False)["input_ids"]
            # A space before the word may be a token of its own, which is skipped.
            visible_tokens = [
                token for token in tokens if self.tokenizer.decode([token]).strip()
            ]
            first_tokens.update(visible_tokens[:1])
        # The token for unknown words may begin any of them.
        return sorted(first_tokens - {self.tokenizer.unk_token_id})


def _append_tokens(prompt: Mapping[str, Tensor], tokens: Tensor) -> dict[str, Tensor]:
    """Return the inputs of a network for a prompt that tokens (n,) follow.

    Masks and types, which the prompt has for each of its tokens, are extended: all new
    tokens are attended to, and have the type of text.
    """
    inputs = dict(prompt)
    inputs["input_ids"] = torch.cat([prompt["input_ids"], tokens[None]], dim=1)
    for key in ("attention_mask", "mm_token_type_ids", "token_type_ids"):
        if key in prompt:
            # In most networks type 1 means image, and 0 means text. PaliGemma is an
            # exception: all tokens of its prompt, the image too, have type 0 in
            # `token_type_ids`, and type 1 means answer.
            # Other networks mark the image by 1, so that not all types are 0.
            marks_answer = key == "token_type_ids" and not prompt[key].any()
            is_mask = key == "attention_mask"
            value = 1 if is_mask or marks_answer else 0
            extension = torch.full_like(tokens, value)[None]
            inputs[key] = torch.cat([prompt[key], extension], dim=1)
    return inputs


def _check_likelihood(loaded: LoadedNetwork, module: _NameClassifier) -> None:
    """Compare the likelihood of the longest name with that of the network itself.

    The network itself reads image, prompt and name at once. `_NameClassifier` reads
    them in two steps, with a cache.

    Raises:
        ModelError: they differ.
    """
    lengths = [len(name_tokens) for name_tokens in module.tokens]
    index = lengths.index(max(lengths))
    generator = torch.Generator().manual_seed(0)
    image = torch.rand((3, *module.reader.image_size), generator=generator)
    prompt = module.reader.make_inputs(image)
    expected = _compute_likelihood(loaded, prompt, module.tokens[index])
    computed = module(image[None])[0, index].double()
    # The tolerance is relative to this number.
    magnitude = max(1.0, abs(float(expected)))
    if not are_nearly_equal(expected, computed, magnitude, loaded.network.dtype):
        raise _make_unsupported_error(
            loaded,
            "computes another likelihood with its cache than without "
            f"({computed:.6g} for {expected:.6g})",
        )


def _compute_likelihood(
    loaded: LoadedNetwork, prompt: Mapping[str, Tensor], tokens: Sequence[int]
) -> Tensor:
    """Return the log-likelihood of tokens after a prompt, by the network itself.

    Raises:
        ModelError: the network returns logits of another length.
    """
    name_tokens = torch.tensor(tokens, device=loaded.network.device)
    inputs = _append_tokens(prompt, name_tokens)
    logits = loaded.network(**inputs).logits
    if logits.shape[1] != inputs["input_ids"].shape[1]:
        raise _make_unsupported_error(
            loaded, "returns logits of another length than the text has"
        )
    # The logits at a position are those of the next token: so the logits for the name
    # begin one position before it.
    likelihoods: Tensor = logits[0, -len(name_tokens) - 1 : -1].float()
    likelihoods = likelihoods.log_softmax(dim=-1)
    return likelihoods.gather(1, name_tokens[:, None]).sum().double()


def _make_unsupported_error(loaded: LoadedNetwork, what: str) -> errors.ModelError:
    """Return the error for a network that cannot be used here.

    Args:
        loaded: the network.
        what: what it does, such as "has a separate encoder".
    """
    return errors.ModelError(
        f"model {loaded.spec}: is a {type(loaded.network).__name__}, which {what}; "
        "expected one that continues its input text, such as "
        "LlavaForConditionalGeneration or Qwen2_5_VLForConditionalGeneration"
    )
