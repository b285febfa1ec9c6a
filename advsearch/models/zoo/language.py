"""Networks that read a picture and a text and go on in words, as LLaVA and Qwen-VL do.

They are classifiers of names that are given, or answer freely.
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

LEVELS = 0.05
"""What values of pixels may be off from the processor's for 8-bit pictures, as a share
of the largest: it rounds.
"""

# Continuation by which a network that answers freely is checked.
CHECK_TEXT = "a coffee mug"
# Minimum number of weights for a remark on them and on the time of an answer.
MIN_LARGE_WEIGHTS = 500_000_000


def generates_text(architecture: str, network: Any) -> bool:
    """Whether a network of transformers, by its architecture, continues images and
    texts with text.
    """
    transformers: Any = sys.modules["transformers"]
    names = transformers.models.auto.modeling_auto.MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING_NAMES
    return architecture in names.values()


def make_language_source(loaded: LoadedNetwork) -> models.Source:
    """Return the source of a network that reads an image and goes on in words.

    It chooses one of the names that the user gave, or answers freely.

    Raises:
        ModelError: the network is an encoder-decoder, its processor cannot be loaded,
            or its own likelihoods differ from those computed here.
        InputError: fewer than two names, or prompt and name are too long.
    """
    if getattr(loaded.network.config, "is_encoder_decoder", False):
        raise _make_unsupported_error(loaded, "reads from an encoder of its own")
    processor = _load_processor(loaded)
    purpose = loaded.purpose
    name = loaded.name
    is_free, question = purpose.parse_question(name, "goes on in words")
    names = purpose.names
    if not is_free:
        _check_has_choice(names, name)
    kind = type(loaded.network).__name__
    with models.translate_errors(
        f"model {loaded.spec}: is a {kind}, which can't be asked about "
        "a picture as LLaVA can"
    ):
        reader = _LanguageModel(loaded, processor, question or models.QUESTION)
        # Likelihoods are checked by any text if there are no names.
        tokens = reader.tokenize_names(names or (CHECK_TEXT,))
        max_new_tokens = max(purpose.tokens if is_free else 0, *map(len, tokens))
        _check_length(loaded, reader, max_new_tokens)
        classifier = _NameClassifier(reader, tokens)
        module = _FreeAnswerer(reader, purpose.tokens) if is_free else classifier
        with torch.no_grad():
            _check_likelihood(loaded, classifier)
            start_time = time.perf_counter()
            module(torch.zeros((1, 3, *reader.image_size)))
            seconds = time.perf_counter() - start_time
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


def _check_has_choice(names: Sequence[str] | None, model_name: str) -> None:
    """Raise InputError for fewer than two names, of which none could be chosen."""
    if names is None or len(names) < 2:
        raise InputError(
            "labels: expected two names at least, such as mug,cup,bowl, of which "
            f"model {model_name} chooses one, got "
            f"{repr(names[0]) if names else 'none'}; with `task=answer` it "
            "answers freely"
        )


def _load_processor(loaded: LoadedNetwork) -> Any:
    """Load the processor of images and texts; the error names torchvision if it may be
    missing for it.
    """
    try:
        return loaded.load_part("AutoProcessor")
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
    n_tokens = (
        reader.get_prompt(reader.image_size)["input_ids"].shape[1] + max_new_tokens
    )
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
                f"(#{second}): whoever says the second has said the first"
            )
            return


# ---- the network ----


class _LanguageModel(nn.Module):
    """A network that reads an image and a question, and continues with text.

    `preprocessing` is its `Preprocessing`. A processor that is an affine map is
    measured and left to that; one that cuts an image into patches or tiles is called
    itself, which is differentiable with torchvision.
    """

    def __init__(self, loaded: LoadedNetwork, processor: Any, question: str) -> None:
        """Prepare prompt and preprocessing for a network.

        Args:
            loaded: the network, with what belongs to it.
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
        self.cache = "cache" if "cache" in parameters else "past_key_values"
        # by image size, see `get_prompt`
        self._prompts: dict[tuple[int, int], dict[str, Tensor]] = {}
        self.text = _make_prompt_text(processor, question)
        processing = _measure_affine_processor(processor, self.text, loaded.spec)
        self.is_affine = processing is not None
        if processing is None:
            _check_torchvision_installed(loaded.spec)
            processing = Processing()
        self.image_size = processing.get(
            "input_size", _read_image_size(loaded.network.config)
        )
        self.preprocessing = Processing(**{**processing, "input_size": self.image_size})
        self._check_pixels(loaded.spec)

    def _check_pixels(self, spec: str) -> None:
        """Check that a floating-point image gives the same input as the image in 8
        bits.

        Raises:
            ModelError: the processor treats them differently.
        """
        height, width = self.image_size
        vertical = torch.linspace(0, 200, height)[:, None].expand(height, width)
        horizontal = torch.linspace(0, 200, width).expand(height, width)
        # A different gradient in each channel, (3, H, W).
        diagonal = (vertical + horizontal) / 4 + 100
        levels = torch.stack([vertical, horizontal, diagonal]).round()
        image_8bit = np.ascontiguousarray(levels.byte().permute(1, 2, 0).numpy())
        expected = self._process(image_8bit)["pixel_values"]
        image = levels / 255.0
        if self.is_affine:
            mean = image.new_tensor(self.preprocessing["mean"]).view(3, 1, 1)
            std = image.new_tensor(self.preprocessing["std"]).view(3, 1, 1)
            if self.preprocessing["channels"] != "RGB":
                image = image.flip(0)
            image = (image - mean) / std
        pixels = self._compute_pixel_values(image)
        max_error = float("inf")
        if pixels.shape == expected.shape:
            max_error = float((pixels - expected).abs().max())
        if not max_error <= LEVELS * float(expected.abs().max()):
            raise errors.ModelError(
                f"model {spec}: its processor {type(self.processor).__name__} does "
                "something else to numbers than to 8-bit pictures. Wrap network and "
                "processing in an nn.Module of yours, and give that from Python"
            )

    def _process(self, image: Any, text: str = "", **options: Any) -> dict[str, Tensor]:
        """Return the network's inputs for an image and a text, by default the question.

        Inputs for training are left out.
        """
        with warnings.catch_warnings():  # of how the library reads arrays
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

        They are the tokens of prompt and name minus those of the prompt. If the text
        does not begin with the prompt's tokens, as a processor may end a text with a
        newline, they are those of the name alone.

        Raises:
            InputError: the network has no token for a name.
        """
        words = get_spoken_names(names)
        gap = self._find_gap()
        can_extend_prompt = self._keeps_prompt(f"{gap}{words[0]}")
        tokens_of_names: list[list[int]] = []
        for word in words:
            tokens = self._tokenize_after_prompt(f"{gap}{word}")
            if tokens is None or not can_extend_prompt:
                tokens = self.processor.tokenizer(word, add_special_tokens=False)[
                    "input_ids"
                ]
            if not tokens:
                raise InputError(
                    "labels: expected names that the network has tokens "
                    f"for, got {word!r}"
                )
            tokens_of_names.append(tokens)
        return tokens_of_names

    def _find_gap(self) -> str:
        """Return what separates the prompt from a name: a space, or nothing if the
        prompt ends with white space or with a special token.
        """
        prompt_tokens = self._get_prompt_tokens()
        ends_with_special = (
            prompt_tokens[-1] in self.processor.tokenizer.all_special_ids
        )
        return "" if self.text[-1:].isspace() or ends_with_special else " "

    def _keeps_prompt(self, text: str) -> bool:
        """Return whether the processor's tokens for prompt and text begin with those
        for the prompt: it may add tokens at the end.
        """
        prompt_tokens = self._get_prompt_tokens()
        inputs = self._process(_make_gray_image(self.image_size), f"{self.text}{text}")
        return inputs["input_ids"][0].tolist()[: len(prompt_tokens)] == prompt_tokens

    def _get_prompt_tokens(self) -> list[int]:
        """Return the tokens of the prompt, those of an image included."""
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
        """Return the network's inputs for a gray image of (height, width) pixels and
        the question.
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
            The logits (tokens,) float32 of the next token, and the cache of keys and
            values.

        Raises:
            ValueError: the network returns no cache.
        """
        returned = self.network(**self.make_inputs(image), use_cache=True)
        past = returned.get(self.cache)
        if past is None:
            raise ValueError("it keeps no keys and values of what it has read")
        return returned.logits[0, -1].float(), past

    def continue_with(self, tokens: Tensor, past: Any) -> Tensor:
        """Return the logits (N, L, tokens) float32 of the token after each of N x L
        tokens.

        `past` is the cache of one image.
        """
        # one copy of the cache for each row of tokens
        past.batch_repeat_interleave(len(tokens))
        logits: Tensor = self.network(
            input_ids=tokens, use_cache=True, **{self.cache: past}
        ).logits.float()
        return logits


class _NameClassifier(nn.Module):
    """Compute logits (N, names): the log-likelihood of each name after image and
    prompt.

    It is summed over the tokens of the name. Image and prompt are read once. The stem
    of a name (all of its tokens but the last) is read after them, once for all names
    that begin with it, and all stems in one batch: names of one token need no further
    step.
    """

    def __init__(self, reader: _LanguageModel, tokens: Sequence[Sequence[int]]) -> None:
        """Prepare the tables of tokens that `forward` reads likelihoods by.

        Args:
            reader: the network.
            tokens: tokens of each name, at least one.
        """
        super().__init__()
        self.reader = reader
        self.tokens = [list(name_tokens) for name_tokens in tokens]
        stems = _find_stems(self.tokens)
        stem_length = max(map(len, stems), default=0)
        # `forward` makes a table of log-likelihoods: a column for each token of the
        # vocabulary; row 0 is after the prompt, and each token of each stem has a row.
        # For each token of each name, (names, longest name): its row and column there,
        # and 1, or 0 where a name is shorter.
        rows = torch.zeros((len(tokens), max(map(len, tokens))), dtype=torch.long)
        columns = torch.zeros_like(rows)
        is_token = torch.zeros_like(rows)
        for index, name_tokens in enumerate(self.tokens):
            first_stem_row = 1 + _find_stem(stems, name_tokens[:-1]) * stem_length
            for position, token in enumerate(name_tokens):
                # the first token follows the prompt, any other the token before it
                if position > 0:
                    rows[index, position] = first_stem_row + position - 1
                columns[index, position] = token
                is_token[index, position] = 1
        padded_stems = torch.tensor(
            [[*stem, *[0] * (stem_length - len(stem))] for stem in stems]
        ).long()
        self._token_tables = padded_stems, rows, columns, is_token

    def forward(self, images: Tensor) -> Tensor:
        """Return the log-likelihoods (N, names) for images (N, 3, H, W)."""
        stems, rows, columns, is_token = (
            tensor.to(images.device) for tensor in self._token_tables
        )
        scores = []
        for image in images:
            logits, past = self.reader.read_prompt(image)
            # (1 + stems * stem length, tokens) log-likelihoods of the next token, after
            # the prompt and after each token of each stem
            likelihoods = logits.log_softmax(dim=-1)[None]
            if len(stems):
                stem_logits = self.reader.continue_with(stems, past)
                stem_likelihoods = stem_logits.log_softmax(dim=-1).flatten(0, 1)
                likelihoods = torch.cat([likelihoods, stem_likelihoods])
            scores.append((likelihoods[rows, columns] * is_token).sum(dim=1))
        return torch.stack(scores)


def _make_prompt_text(processor: Any, question: str) -> str:
    """Return the question with a placeholder for the image, in the form of a chat if
    the network was trained on chats.
    """
    if getattr(processor, "chat_template", None):
        content = [{"type": "image"}, {"type": "text", "text": question}]
        turns = [{"role": "user", "content": content}]
        text: str = processor.apply_chat_template(turns, add_generation_prompt=True)
        return text
    return f"{getattr(processor, 'image_token', None) or ''}{question}"


def _read_image_size(config: Any) -> tuple[int, int]:
    """Return (height, width) of images, of a network's ``config`` or the default."""
    vision_config = getattr(config, "vision_config", None)
    size = getattr(vision_config, "image_size", None) or models.DEFAULT_SIZE
    height, width = size if isinstance(size, (list, tuple)) else (size, size)
    return int(height), int(width)


def _measure_affine_processor(
    processor: Any, prompt: str, spec: str
) -> Processing | None:
    """Return size, mean and standard deviation of a processor of images and texts.

    None if it does more to an image than a gain and an offset.
    """
    with suppress(errors.ModelError):
        processing = measure_processor(
            lambda **options: processor(text=[prompt], **options), spec
        )
        if "mean" in processing:
            return processing
    return None


def _check_torchvision_installed(spec: str) -> None:
    """Raise ModelError if the processor of a network needs torchvision, which is not
    installed.
    """
    if importlib.util.find_spec("torchvision") is None:
        raise errors.ModelError(
            f"model {spec}: its processor cuts pictures into patches or tiles, and "
            "lets gradients through with torchvision only, which is not installed: "
            "pip install 'advsearch[torchvision]'"
        )


def _make_gray_image(size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Return a gray image (height, width, 3), for which any image may be put in."""
    return np.full((*size, 3), 128, np.uint8)


def _find_stem(stems: Sequence[Sequence[int]], prefix: Sequence[int]) -> int:
    """Return the index of the first stem (tokens) that begins with a prefix.

    0 if there is none, as for a name of one token without any stems.
    """
    for index, stem in enumerate(stems):
        if list(stem[: len(prefix)]) == list(prefix):
            return index
    return 0


def _find_stems(tokens: Sequence[Sequence[int]]) -> list[tuple[int, ...]]:
    """Return the stems of names, all of their tokens but the last, sorted, without
    those that are a prefix of another stem.
    """
    stems = {tuple(name_tokens[:-1]) for name_tokens in tokens if len(name_tokens) > 1}
    return sorted(
        stem
        for stem in stems
        if not any(other[: len(stem)] == stem for other in stems - {stem})
    )


class _FreeAnswerer(nn.Module):
    """Answer freely about each image, by greedy decoding: always the likeliest token.

    The outputs are `advsearch.tasks.answers.AnswerWithLogits`.
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
        # a token, several, or None
        end_tokens = reader.network.generation_config.eos_token_id
        if not isinstance(end_tokens, (list, tuple)):
            end_tokens = [end_tokens]
        self.end_tokens = frozenset(end_tokens) - {None}

    def forward(self, images: Tensor) -> list[dict[str, Any]]:
        """Return the answer about each of images (N, 3, H, W).

        Each has its text; the logits (n, tokens) that its n tokens were chosen by; and
        a function from a word to the tokens that it may begin with. It ends after an
        end token, or after `max_tokens`.
        """
        answers = []
        for image in images:
            next_logits, past = self.reader.read_prompt(image)
            logits_of_steps = [next_logits]
            tokens = [int(next_logits.argmax())]
            while tokens[-1] not in self.end_tokens and len(tokens) < self.max_tokens:
                last_token = next_logits.new_tensor([tokens[-1:]], dtype=torch.long)
                next_logits = self.reader.continue_with(last_token, past)[0, -1]
                logits_of_steps.append(next_logits)
                tokens.append(int(next_logits.argmax()))
            text = self.tokenizer.decode(tokens, skip_special_tokens=True).strip()
            answers.append(
                {
                    "text": text,
                    "logits": torch.stack(logits_of_steps),
                    "begins": self.find_first_tokens,
                }
            )
        return answers

    def find_first_tokens(self, word: str) -> list[int]:
        """Return the tokens that may begin a word, in lower case or capitalized, with
        or without a space before it.
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

    Masks and types, which the prompt has for each of its tokens, are extended.
    """
    inputs = dict(prompt)
    inputs["input_ids"] = torch.cat([prompt["input_ids"], tokens[None]], dim=1)
    for key in ("attention_mask", "mm_token_type_ids", "token_type_ids"):
        if key in prompt:
            # In most networks type 1 is the image, but in PaliGemma, which marks
            # nothing before, it is the answer.
            is_answer = key == "token_type_ids" and not prompt[key].any()
            is_attended = key == "attention_mask"
            value = 1 if is_attended or is_answer else 0
            extension = torch.full_like(tokens, value)[None]
            inputs[key] = torch.cat([prompt[key], extension], dim=1)
    return inputs


def _check_likelihood(loaded: LoadedNetwork, module: _NameClassifier) -> None:
    """Compare the likelihood of the longest name with that of the network itself.

    The latter reads image, prompt and name at once, where `_NameClassifier` reads them
    in parts and keeps what it has read.

    Raises:
        ModelError: they differ.
    """
    lengths = [len(name_tokens) for name_tokens in module.tokens]
    index = lengths.index(max(lengths))
    generator = torch.Generator().manual_seed(0)
    image = torch.rand((3, *module.reader.image_size), generator=generator)
    prompt = module.reader.make_inputs(image)
    name_tokens = torch.tensor(module.tokens[index], device=loaded.network.device)
    inputs = _append_tokens(prompt, name_tokens)
    logits = loaded.network(**inputs).logits
    if logits.shape[1] != inputs["input_ids"].shape[1]:
        raise _make_unsupported_error(
            loaded, "returns logits of another length than the text has"
        )
    # the logits at a position are those of the next token
    likelihoods = logits[0, -len(name_tokens) - 1 : -1].float().log_softmax(dim=-1)
    expected = likelihoods.gather(1, name_tokens[:, None]).sum().double()
    computed = module(image[None])[0, index].double()
    size = max(1.0, abs(float(expected)))
    if not are_nearly_equal(expected, computed, size, loaded.network.dtype):
        raise _make_unsupported_error(
            loaded,
            "goes on otherwise after what it has kept "
            f"({computed:.6g} for {expected:.6g})",
        )


def _make_unsupported_error(loaded: LoadedNetwork, what: str) -> errors.ModelError:
    """Return the error for a network that is none of those read here."""
    return errors.ModelError(
        f"model {loaded.spec}: is a {type(loaded.network).__name__}, which {what}; "
        "expected one that goes on with the text it is given, such as "
        "LlavaForConditionalGeneration or Qwen2_5_VLForConditionalGeneration"
    )
