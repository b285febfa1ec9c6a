"""Task for free answers: does the text of a model contain one of the right words?"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypedDict

import torch
from torch import Tensor
from torch.nn import functional

from advsearch.extend import InputError, Model, Task, tasks

Words = tuple[str, ...]

EMPTY_ANSWER = "(nothing)"  # label of an answer without a word
MAX_COUNT = 256  # maximum of `tokens` and of `times`


class AnswersWithoutLogits(TypedDict):
    """The answers of a model without logits about one image, one for each request."""

    texts: list[str]


class AnswerWithLogits(TypedDict):
    """The answer of a model with logits about one image.

    Attributes:
        text: the answer.
        logits: (T, tokens) float32, logits of all tokens at each of T steps. The token
            with the largest one was selected.
        begins: function from a word to the tokens with which it may begin.
    """

    text: str
    logits: Tensor
    begins: Callable[[str], Sequence[int]]


@dataclass(frozen=True, kw_only=True)
class FreeAnswer(Task):
    """Judge whether an answer contains one of the right words, as a full word in any
    case.

    The truth is those words. Whether an answer is right depends on its text alone; its
    loss depends on the logits. At each step, the tokens that begin such a word have a
    lead over all others, and p is the sigmoid of the largest lead of all steps. The
    loss is log(1 - p) for a right answer and -log(p) for a wrong one.

    For a model without logits (`AnswersWithoutLogits`) the loss is 1 - 2 s, where s is
    the fraction of right answers among those about one image: it is right if at least
    half of them are.

    Args:
        tokens: maximum number of tokens of an answer.
        times: number of requests per image, for a model behind an address, whose
            answers may differ.

    Raises:
        InputError: `tokens` or `times` is less than one, or more than `MAX_COUNT`.
    """

    name = "answer"
    varies = True

    tokens: int = 16
    times: int = 1
    target: Words | None = field(default=None, metadata=tasks.FROM_RUN)

    def __post_init__(self) -> None:
        """Check that both numbers are within their limits."""
        for name in ("tokens", "times"):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= MAX_COUNT:
                raise InputError(
                    f"task answer: {name}: expected a whole number from 1 "
                    f"to {MAX_COUNT}, got {value!r}"
                )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> FreeAnswer:
        """Return the task for a model that answers in words.

        Args:
            model: the model, loaded for this task.
            target: a word, or several separated by commas, of which the answer has to
                contain one; None for any answer without a right word.
            minimise: whether a right answer is sought.

        Raises:
            InputError: the model was loaded as a classifier, or there are both a target
                and `minimise`.
        """
        if model.read is None:  # its outputs are logits, as those of a classifier
            raise InputError(
                f"model {model.name}: it was loaded for its logits; load "
                f'it with task="{self.name}"'
            )
        if target is not None and minimise:
            raise InputError("minimise: seeks the right answer; leave `target` out")
        target_words = None if target is None else _parse_words("target", target)
        return replace(self, target=target_words, minimise=minimise)

    def read(
        self, returned: Any, count: int
    ) -> list[AnswerWithLogits | AnswersWithoutLogits]:
        """Check what a network returned: a list with an answer for each image.

        An answer is a mapping. With logits, it has its "text", the "logits" of its
        tokens, and a function "begins" from a word to the tokens that may begin it.
        Without logits, it has one or several "texts".

        Args:
            returned: what the network returned.
            count: number of images, which is not checked here.

        Raises:
            ValueError: the network returned something else.
        """
        if isinstance(returned, (list, tuple)) and all(map(_is_answer, returned)):
            return list(returned)
        raise ValueError(
            "expected a mapping with text, logits and begins for each picture, as "
            "answers in words have"
        )

    def check(self, facts: tasks.Facts) -> None:
        self.truth(facts)

    def truth(self, facts: tasks.Facts) -> Words:
        """Return the right words: the setting `label`, or else the object's own label.

        Raises:
            InputError: there are none, or one is a target too.
        """
        text = facts.object_label if facts.label is None else facts.label
        if text is None:
            raise InputError(
                f"label: expected the right words for {facts.object}, got none"
            )
        right_words = _parse_words("label", text)
        common_words = sorted(set(right_words) & set(self.target or ()))
        if common_words:
            raise InputError(
                "target: expected words that are not right answers, got "
                f"{common_words}, which `label` has too"
            )
        return right_words

    def truth_names(self, truth: Words) -> Words:
        return truth

    def loss(
        self, output: Sequence[AnswerWithLogits | AnswersWithoutLogits], truth: Words
    ) -> Tensor:
        """Compute the loss of each answer, (N,); over 0 for a wrong one."""
        return torch.stack([_compute_loss(answer, truth) for answer in output])

    def predictions(
        self, output: Sequence[AnswerWithLogits | AnswersWithoutLogits], count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        """Return the `count` most frequent texts about each image.

        Each text is on one line and has no control characters.
        """
        predictions_of_images = []
        for answer in output:
            texts = Counter(_list_texts(answer)).most_common(count)
            predictions_of_images.append(
                tuple(_make_prediction(text) for text, _ in texts)
            )
        return predictions_of_images

    def describe(
        self,
        output: Sequence[AnswerWithLogits | AnswersWithoutLogits],
        truth: Words,
        margins: Sequence[float],
    ) -> list[tasks.PredictionWithPayload]:
        """Return the most frequent text about each image, and a payload.

        If the judgement is right, the most frequent right text is returned, otherwise
        the most frequent wrong one. The payload has all texts if there are several.

        Args:
            output: answers about N images.
            truth: right words.
            margins: margin of each judgement; at least 0 if it is right.
        """
        results = list[tasks.PredictionWithPayload]()
        for answer, margin in zip(output, margins, strict=True):
            texts = _list_texts(answer)
            text = _find_most_frequent_text(texts, truth, is_right=margin >= 0.0)
            payload: tasks.JsonValue = {"texts": [*texts]} if len(texts) > 1 else None
            results.append((_make_prediction(text), payload))
        return results


def _is_answer(value: Any) -> bool:
    """Return whether a value has the keys of one of the two forms of an answer."""
    required_keys = AnswerWithLogits.__required_keys__
    return isinstance(value, Mapping) and (
        required_keys <= value.keys() or "texts" in value
    )


def _compute_loss(
    answer: AnswerWithLogits | AnswersWithoutLogits, right_words: Words
) -> Tensor:
    """Compute the loss of the answer about one image, (); over 0 if it is wrong.

    Without logits it is 1 - 2 s, where s is the fraction of right texts about the
    image. With logits, the text decides the sign of the loss, and the tokens its size:
    it is log(1 - p) for a right answer and -log(p) for a wrong one. Here p is
    sigmoid(m), and m is by how much the best token that begins a right word exceeds all
    other tokens (`_compute_token_margin`).
    """
    if "texts" in answer:  # without logits
        is_right = [float(has_word(text, right_words)) for text in _list_texts(answer)]
        return 1.0 - 2.0 * torch.tensor(is_right).mean()
    margin = _compute_token_margin(answer["logits"], answer["begins"], right_words)
    # p = sigmoid(margin) is between 0 and 1: log(1 - p) < 0, and -log(p) > 0
    if has_word(answer["text"], right_words):
        return functional.logsigmoid(-margin)  # log(1 - p)
    return -functional.logsigmoid(margin)  # -log(p)


def _compute_token_margin(
    logits: Tensor, begins: Callable[[str], Sequence[int]], words: Words
) -> Tensor:
    """Compute how near an answer is to a token that begins one of the words.

    Args:
        logits: logits of all tokens at each step of the answer, (T, tokens).
        begins: function that returns the tokens that may begin a word.
        words: at least one word.

    Returns:
        The largest logit of a token that begins one of the words, minus the largest
        logit of the other tokens, (). It is taken at the step at which it is largest,
        since a word may stand anywhere in the answer.

    Raises:
        InputError: no token begins one of the words.
    """
    begin_tokens = sorted({token for word in words for token in begins(word)})
    if not begin_tokens:
        raise InputError(
            "label: the model has no token that begins one of "
            f"{', '.join(words)}; state other words"
        )
    # mask of the tokens that begin one of the words
    is_begin = torch.zeros(logits.shape[1], dtype=torch.bool, device=logits.device)
    is_begin[begin_tokens] = True
    # (T,) each
    begin_logit = logits.masked_fill(~is_begin, -torch.inf).amax(dim=1)
    other_logit = logits.masked_fill(is_begin, -torch.inf).amax(dim=1)
    return (begin_logit - other_logit).max()


def _list_texts(answer: AnswerWithLogits | AnswersWithoutLogits) -> list[str]:
    """Return all texts about an image: those of several requests, or the only one."""
    if "texts" in answer:
        return answer["texts"]  # type: ignore[typeddict-item]
    return [answer["text"]]


def _make_prediction(text: str) -> tasks.Prediction:
    """Return a text as a prediction: on one line, without control characters."""
    printable = "".join(char if char.isprintable() else " " for char in text)
    return tasks.Prediction(" ".join(printable.split()) or EMPTY_ANSWER)


def _parse_words(setting: str, text: str) -> Words:
    """Parse words separated by commas, in lower case and without duplicates."""
    words = [
        " ".join(part.split()).casefold() for part in text.split(",") if part.strip()
    ]
    if not words:
        raise InputError(
            f"{setting}: expected words, separated by commas, got {text!r}"
        )
    return tuple(dict.fromkeys(words))


def has_word(text: str, words: Words) -> bool:
    """Return whether a text contains one of the words, in upper or lower case.

    Only full words count: "smug" does not contain "mug".
    """
    text = " ".join(text.split()).casefold()
    return any(re.search(rf"(?<!\w){re.escape(word)}(?!\w)", text) for word in words)


def _find_most_frequent_text(
    texts: Sequence[str], truth: Words, *, is_right: bool
) -> str:
    """Return the most frequent of the texts that agree with a judgement.

    If none agrees, all texts count.

    Args:
        texts: texts about an image.
        truth: right words.
        is_right: whether the image was judged right.
    """
    agreeing = [text for text in texts if has_word(text, truth) == is_right]
    [(most_frequent, _)] = Counter(agreeing or texts).most_common(1)
    return most_frequent
