"""Networks that read a picture and a text and go on in words, as LLaVA and Qwen-VL do.

They are classifiers of names that are given, or answer freely.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
import time
import warnings
from collections.abc import Sequence
from contextlib import suppress
from itertools import permutations
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from advsearch.extend import InputError, errors, models
from advsearch.models.zoo.library import Loaded, Processing, measured, nearly
from advsearch.models.zoo.zero_shot import spoken

LEVELS = 0.05
"""What values of pixels may be off from the processor's for 8-bit pictures, as a share
of the largest: it rounds.
"""

# what is read after the prompt to see that a network which answers freely goes on as it
# reads
CHECKED = "a coffee mug"
# weights from which on a run says how many there are, and how long an answer takes
LARGE = 500_000_000


def speaks(architecture: str, network: Any) -> bool:
    """Whether a network of transformers, by the name of its architecture, goes on in
    words after picture and text.
    """
    transformers: Any = sys.modules["transformers"]
    names = transformers.models.auto.modeling_auto.MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING_NAMES
    return architecture in names.values()


def source(loaded: Loaded) -> models.Source:
    """Return the source of a classifier of the names that are given, or of free
    answers. Raises ModelError where the network has an encoder for texts of its own,
    its processor can't be had, or it goes on otherwise than is read here.
    """
    if getattr(loaded.network.config, "is_encoder_decoder", False):
        raise _another(loaded, "reads from an encoder of its own")
    try:
        processor = loaded.part("AutoProcessor")
    except errors.ModelError as error:
        if importlib.util.find_spec("torchvision") is None:
            raise errors.ModelError(
                f"model {loaded.spec}: its processor cannot be loaded, and most of "
                "such networks need torchvision for "
                "that, which is not installed: pip install 'advsearch[torchvision]'"
            ) from error
        raise
    purpose = loaded.purpose
    name = loaded.name
    (free, question) = purpose.in_words(name, "goes on in words")
    names = purpose.names
    if not free and (names is None or len(names) < 2):
        raise InputError(
            "labels: expected two names at least, such as mug,cup,bowl, of which "
            f"model {name} chooses one, got "
            f"{'none' if names is None else repr(names[0])}; with `task=answer` it "
            "answers freely"
        )
    kind = type(loaded.network).__name__
    with models.foreign(
        f"model {loaded.spec}: is a {kind}, which can't be asked about "
        "a picture as LLaVA can"
    ):
        reader = _Speaker(loaded, processor, question or models.QUESTION)
        tokens = reader.tokens_of(names or (CHECKED,))
        most = getattr(
            loaded.network.config.get_text_config(), "max_position_embeddings", None
        )
        length = reader.prompt(reader.side)["input_ids"].shape[1]
        length += max(purpose.tokens if free else 0, *map(len, tokens))
        if isinstance(most, int) and length > most:
            raise InputError(
                f"prompt: expected picture, prompt and name to have at most {most} "
                f"tokens for model {name}, "
                f"got {length}"
            )
        named = _Named(reader, tokens)
        module = _Free(reader, purpose.tokens) if free else named
        with torch.no_grad():
            _check(loaded, named)
            begun = time.perf_counter()
            module(torch.zeros((1, 3, *reader.side)))
            seconds = time.perf_counter() - begun
    if names is not None:
        _say_what_begins_another(tokens, names, name)
    weights = list(loaded.network.parameters())
    if (count := sum(tensor.numel() for tensor in weights)) >= LARGE:
        size = sum(tensor.nbytes for tensor in weights)
        models.warn(
            f"model {name} has {count / 1e9:.3g} billion weights, {size / 1e9:.3g} GB, "
            f"and took {seconds:.2g} s "
            "to answer one picture here; a gradient takes longer"
        )
    return models.source_of(
        module,
        name,
        labels=names,
        batch_limits=(1, 1),
        reads_text=True,
        **reader.described,
    )


def _say_what_begins_another(
    tokens: Sequence[Sequence[int]], names: Sequence[str], name: str
) -> None:
    for (first, short), (second, long) in permutations(enumerate(tokens), 2):
        if list(long[: len(short)]) == list(short):
            models.warn(
                f"model {name} reads {names[first]!r} (#{first}) as the beginning of "
                f"{names[second]!r} "
                f"(#{second}): whoever says the second has said the first"
            )
            return


# ---- the network
# ----------------------------------------------------------------------------------------------------


class _Speaker(nn.Module):
    """A network that reads a picture and a question, and goes on; `described` is what
    `Preprocessing` does before. A processor that is an affine map is measured and left
    to that; one that cuts a picture into patches or tiles is called itself, which is
    differentiable where it works with torchvision.
    """

    def __init__(self, loaded: Loaded, processor: Any, question: str) -> None:
        super().__init__()
        self.network = loaded.network
        self.processor = processor
        taken = inspect.signature(loaded.network.forward).parameters
        # its older name
        self.cache = "cache" if "cache" in taken else "past_key_values"
        self._prompts: dict[tuple[int, int], dict[str, Tensor]] = {}
        # the question with a place for the picture, as the network was trained on it
        self.text = f"{getattr(processor, 'image_token', None) or ''}{question}"
        if getattr(processor, "chat_template", None):
            content = [{"type": "image"}, {"type": "text", "text": question}]
            turns = [{"role": "user", "content": content}]
            self.text = processor.apply_chat_template(turns, add_generation_prompt=True)
        side = (
            getattr(
                getattr(loaded.network.config, "vision_config", None),
                "image_size",
                None,
            )
            or models.SIDE
        )
        self.side = (
            (int(side[0]), int(side[1]))
            if isinstance(side, (list, tuple))
            else (int(side), int(side))
        )
        self.described = Processing()
        with suppress(errors.ModelError):  # it is called then
            self.described = measured(
                lambda **given: processor(text=[self.text], **given), loaded.spec
            )
        self.affine = "mean" in self.described
        if self.affine:
            self.side = self.described.get("input_size", self.side)
        elif importlib.util.find_spec("torchvision") is None:
            raise errors.ModelError(
                f"model {loaded.spec}: its processor cuts pictures into patches or "
                "tiles, and lets gradients through "
                "with torchvision only, which is not installed: pip install "
                "'advsearch[torchvision]'"
            )
        self.described = Processing(
            **{**(self.described if self.affine else {}), "input_size": self.side}
        )
        self._check_pixels(loaded.spec)

    def _check_pixels(self, spec: str) -> None:
        """Raise a ModelError where a picture of slopes arrives otherwise than from
        8-bit values by the processor.
        """
        height, width = self.side
        down = torch.linspace(0, 200, height)[:, None]
        across = torch.linspace(0, 200, width)
        levels = torch.stack(
            [(down + 0 * across), (across + 0 * down), (down + across) / 4 + 100]
        ).round()
        expected = self._inputs(
            np.ascontiguousarray(levels.byte().permute(1, 2, 0).numpy())
        )["pixel_values"]
        image = levels / 255.0
        if self.affine:
            mean, std = (
                image.new_tensor(self.described[key]).view(3, 1, 1)
                for key in ("mean", "std")
            )
            image = (
                (image if self.described["channels"] == "RGB" else image.flip(0)) - mean
            ) / std
        pixels = self._pixels(image)
        off = (
            float((pixels - expected).abs().max())
            if pixels.shape == expected.shape
            else float("inf")
        )
        if not off <= LEVELS * float(expected.abs().max()):
            raise errors.ModelError(
                f"model {spec}: its processor {type(self.processor).__name__} does "
                "something else to numbers than to "
                "8-bit pictures. Wrap network and processing in an nn.Module of yours, "
                "and give that from Python"
            )

    def _inputs(
        self, picture: Any, text: str = "", **options: Any
    ) -> dict[str, Tensor]:
        """What the processor makes of a picture and a text, the question's by default,
        without what is for training.
        """
        with warnings.catch_warnings():  # of how the library reads arrays
            warnings.simplefilter("ignore")
            given = self.processor(
                images=[picture],
                text=[text or self.text],
                return_tensors="pt",
                **options,
            )
        return {
            key: value
            for key, value in given.items()
            if isinstance(value, Tensor) and key != "labels"
        }

    def _pixels(self, image: Tensor) -> Tensor:
        return (
            image[None]
            if self.affine
            else self._inputs(image.float(), do_rescale=False)["pixel_values"]
        )

    def tokens_of(self, names: Sequence[str]) -> list[list[int]]:
        """Return the tokens of each name where it follows the prompt, with a blank
        between them unless one is there. They are those that the whole text has more
        than the prompt; where it does not begin with the prompt's, as a processor may
        end a text with a line's end, those of the name alone.
        """
        tokenizer = self.processor.tokenizer
        prompt = self.prompt(self.side)["input_ids"][0].tolist()
        gap = (
            ""
            if self.text[-1:].isspace() or prompt[-1] in tokenizer.all_special_ids
            else " "
        )
        begun = tokenizer(self.text, verbose=False)["input_ids"]
        words = spoken(names)
        # whether what the processor adds stands before or behind
        grey = np.full((*self.side, 3), 128, np.uint8)
        processed = self._inputs(grey, f"{self.text}{gap}{words[0]}")["input_ids"][
            0
        ].tolist()
        joined = processed[: len(prompt)] == prompt
        each: list[list[int]] = []
        for name in words:
            whole = tokenizer(f"{self.text}{gap}{name}", verbose=False)["input_ids"]
            follows = joined and whole[: len(begun)] == begun
            tokens = (
                whole[len(begun) :]
                if follows
                else tokenizer(name, add_special_tokens=False)["input_ids"]
            )
            if not tokens:
                raise InputError(
                    "labels: expected names that the network has tokens "
                    f"for, got {name!r}"
                )
            each.append(tokens)
        return each

    def prompt(self, side: tuple[int, int]) -> dict[str, Tensor]:
        """Return what the network is given beside the values of a picture of (height,
        width) pixels, and grey ones.
        """
        if side not in self._prompts:
            self._prompts[side] = self._inputs(np.full((*side, 3), 128, np.uint8))
        return self._prompts[side]

    def given(self, image: Tensor) -> dict[str, Tensor]:
        """Return what the network is given for a picture (3, H, W). Raises ValueError
        where it is for pictures of another size.
        """
        height, width = image.shape[1:]
        prompt = self.prompt((height, width))
        pixels = self._pixels(image)
        if pixels.shape != prompt["pixel_values"].shape:
            expected = tuple(prompt["pixel_values"].shape)
            raise ValueError(
                f"expected values of shape {expected}, got {tuple(pixels.shape)}"
            )
        placed = next(self.network.parameters())
        given = {key: value.to(placed.device) for key, value in prompt.items()}
        return {**given, "pixel_values": pixels.to(placed.device, placed.dtype)}

    def begin(self, image: Tensor) -> tuple[Tensor, Any]:
        """Return the logits (tokens,) float32 of what follows picture and prompt, and
        the keys and values so far. Raises ValueError where the network keeps none.
        """
        returned = self.network(**self.given(image), use_cache=True)
        past = returned.get(self.cache)
        if past is None:
            raise ValueError("it keeps no keys and values of what it has read")
        return returned.logits[0, -1].float(), past

    def go_on(self, tokens: Tensor, past: Any) -> Tensor:
        """Return the logits (N, L, tokens) float32 of what follows each of N x L
        tokens; `past` is of one picture.
        """
        past.batch_repeat_interleave(len(tokens))
        logits: Tensor = self.network(
            input_ids=tokens, use_cache=True, **{self.cache: past}
        ).logits.float()
        return logits


class _Named(nn.Module):
    """Logits (N, names): the log-likelihood of each name after picture and prompt,
    summed over its tokens. Picture and prompt are read once. What begins a name (all of
    its tokens but the last) is read after it, once for all names that begin so, and all
    such beginnings at once: names of one token need nothing more.
    """

    def __init__(self, reader: _Speaker, tokens: Sequence[Sequence[int]]) -> None:
        super().__init__()
        self.reader = reader
        self.tokens = [list(name) for name in tokens]
        begun = {tuple(name[:-1]) for name in tokens if len(name) > 1}
        stems = sorted(
            stem
            for stem in begun
            if not any(other[: len(stem)] == stem for other in begun - {stem})
        )
        length = max(map(len, stems), default=0)
        most = max(map(len, tokens))
        rows = torch.zeros((len(tokens), most), dtype=torch.long)
        columns = torch.zeros_like(rows)
        counts = torch.zeros_like(rows)
        for number, name in enumerate(tokens):
            stem = next(
                (
                    k
                    for k, stem in enumerate(stems)
                    if stem[: len(name) - 1] == tuple(name[:-1])
                ),
                0,
            )
            for place, token in enumerate(name):
                rows[number, place] = 1 + stem * length + place - 1 if place else 0
                columns[number, place], counts[number, place] = token, 1
        padded = torch.tensor(
            [[*stem, *[0] * (length - len(stem))] for stem in stems]
        ).long()
        self._places = padded, rows, columns, counts

    def forward(self, images: Tensor) -> Tensor:
        stems, rows, columns, counts = (
            numbers.to(images.device) for numbers in self._places
        )
        scores = []
        for image in images:
            first, past = self.reader.begin(image)
            likely = first.log_softmax(dim=-1)[None]
            if len(stems):
                likely = torch.cat(
                    [
                        likely,
                        self.reader.go_on(stems, past)
                        .log_softmax(dim=-1)
                        .flatten(0, 1),
                    ]
                )
            scores.append((likely[rows, columns] * counts).sum(dim=1))
        return torch.stack(scores)


class _Free(nn.Module):
    """What is said of each picture, `advsearch.tasks.answers.Utterance`: the likeliest
    token after the other.
    """

    def __init__(self, reader: _Speaker, most: int) -> None:
        super().__init__()
        self.reader = reader
        self.tokenizer = reader.processor.tokenizer
        self.most = most
        ends = reader.network.generation_config.eos_token_id
        self.ends = frozenset(ends if isinstance(ends, (list, tuple)) else [ends]) - {
            None
        }

    def forward(self, images: Tensor) -> list[dict[str, Any]]:
        said = []
        for image in images:
            logits, past = self.reader.begin(image)
            steps = [logits]
            tokens = [int(logits.argmax())]
            while tokens[-1] not in self.ends and len(tokens) < self.most:
                steps.append(
                    self.reader.go_on(
                        logits.new_tensor([tokens[-1:]], dtype=torch.long), past
                    )[0, -1]
                )
                tokens.append(int(steps[-1].argmax()))
            text = self.tokenizer.decode(tokens, skip_special_tokens=True).strip()
            said.append(
                {"text": text, "logits": torch.stack(steps), "begins": self.begins}
            )
        return said

    def begins(self, word: str) -> list[int]:
        """Return the tokens that begin a word, in small letters or with a capital,
        after a blank or without one.
        """
        first: set[int] = set()
        for form in {word, word.capitalize(), f" {word}", f" {word.capitalize()}"}:
            tokens = self.tokenizer(form, add_special_tokens=False)["input_ids"]
            first.update(
                [token for token in tokens if self.tokenizer.decode([token]).strip()][
                    :1
                ]
            )
        return sorted(first - {self.tokenizer.unk_token_id})


def _check(loaded: Loaded, module: _Named) -> None:
    """Raise a ModelError where the network itself finds the longest name otherwise
    likely, read with the prompt.
    """
    number, longest = max(
        enumerate(module.tokens), key=lambda numbered: len(numbered[1])
    )
    image = torch.rand(
        (3, *module.reader.side), generator=torch.Generator().manual_seed(0)
    )
    given = module.reader.given(image)
    name = torch.tensor(longest, device=loaded.network.device)
    whole = {**given, "input_ids": torch.cat([given["input_ids"], name[None]], dim=1)}
    for key, value in given.items():
        if key in ("attention_mask", "mm_token_type_ids", "token_type_ids"):
            # 1 is the picture in most, but what is to be said in PaliGemma, which marks
            # nothing before
            kind = (
                1
                if key == "attention_mask"
                or (key == "token_type_ids" and not value.any())
                else 0
            )
            whole[key] = torch.cat([value, torch.full_like(name, kind)[None]], dim=1)
    logits = loaded.network(**whole).logits
    if logits.shape[1] != whole["input_ids"].shape[1]:
        raise _another(loaded, "returns logits of another length than the text has")
    likely = logits[0, -len(name) - 1 : -1].float().log_softmax(dim=-1)
    own = likely.gather(1, name[:, None]).sum().double()
    ours = module(image[None])[0, number].double()
    if not nearly(own, ours, max(1.0, abs(float(own))), loaded.network.dtype):
        raise _another(
            loaded,
            f"goes on otherwise after what it has kept ({ours:.6g} for {own:.6g})",
        )


def _another(loaded: Loaded, what: str) -> errors.ModelError:
    return errors.ModelError(
        f"model {loaded.spec}: is a {type(loaded.network).__name__}, which {what}; "
        "expected one that goes on with the "
        "text it is given, such as LlavaForConditionalGeneration or "
        "Qwen2_5_VLForConditionalGeneration"
    )
