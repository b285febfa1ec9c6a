"""Free answers: whether the text that a model says of a picture has one of the right
words in it.
"""

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

SILENCE = "(nothing)"  # what an answer without a word is called
MOST = 256  # most tokens of an answer


class Texts(TypedDict):
    """What a model that only answers says of one picture: the text of each time that it
    was asked.
    """

    texts: list[str]


class Utterance(TypedDict):
    """What a model says of one picture: the text, logits (T, tokens) float32 of all
    that it could have said at each step, of which it took the largest, and from a word
    to the tokens that may begin it, where any does.
    """

    text: str
    logits: Tensor
    begins: Callable[[str], Sequence[int]]


@dataclass(frozen=True, kw_only=True)
class FreeAnswer(Task):
    """A model's answer has one of the right words in it, as a whole word, in any case.

    The truth is those words. The text alone says whether an answer is right; how
    nearly, the logits say. Let p be the sigmoid of the lead that tokens which begin
    such a word have over all others, at the step where it is greatest: the loss is
    log(1 - p) of a right answer and -log(p) of a wrong one.

    Of a model that gives no logits (`Texts`) the loss is 1 - 2 s, where s is the share
    of right answers among those of one picture: it is right where at least half of them
    are.

    Args:
        tokens: the most that an answer has.
        times: how often each picture is asked, for a model behind an address, whose
            answers may differ.

    Raises:
        InputError: `tokens` or `times` is less than one, or more than `MOST`.
    """

    name = "answer"
    varies = True

    tokens: int = 16
    times: int = 1
    target: Words | None = field(default=None, metadata=tasks.FROM_RUN)

    def __post_init__(self) -> None:
        for name in ("tokens", "times"):
            if not (
                isinstance(value := getattr(self, name), int) and 1 <= value <= MOST
            ):
                raise InputError(
                    f"task answer: {name}: expected a whole number from 1 "
                    f"to {MOST}, got {value!r}"
                )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> FreeAnswer:
        """See `Task.on`: the target is a word, or several with commas between them, of
        which the answer has one.
        """
        if model.read is None:
            raise InputError(
                f"model {model.name}: it was loaded for its logits; load "
                f'it with task="{self.name}"'
            )
        if target is not None and minimise:
            raise InputError(
                "minimise: makes the right answer easier to give; leave `target` out"
            )
        return replace(
            self,
            target=None if target is None else _words("target", target),
            minimise=minimise,
        )

    def read(self, returned: Any, count: int) -> list[Utterance | Texts]:
        keys = Utterance.__required_keys__
        if isinstance(returned, (list, tuple)) and all(
            isinstance(one, Mapping) and (keys <= one.keys() or "texts" in one)
            for one in returned
        ):
            return list(returned)
        raise ValueError(
            "expected a mapping with text, logits and begins for each "
            "picture, as answers in words have"
        )

    def check(self, facts: tasks.Facts) -> None:
        self.truth(facts)

    def truth(self, facts: tasks.Facts) -> Words:
        """Return the right words: what was said, or else the object's own label. Raises
        InputError: there are none, or one is the target too.
        """
        text = facts.own_label if facts.label is None else facts.label
        if text is None:
            raise InputError(
                f"label: expected the right words for {facts.object}, got none"
            )
        right = _words("label", text)
        if both := sorted(set(right) & set(self.target or ())):
            raise InputError(
                "target: expected words that are not right answers, got "
                f"{both}, which `label` has too"
            )
        return right

    def truth_names(self, truth: Words) -> Words:
        return truth

    def loss(self, output: Sequence[Utterance | Texts], truth: Words) -> Tensor:
        losses = []
        for one in output:
            if "texts" in one:
                shares = torch.tensor(
                    [float(has_word(text, truth)) for text in _texts(one)]
                )
                losses.append(1.0 - 2.0 * shares.mean())
                continue
            logits = one["logits"]
            begin = sorted({number for word in truth for number in one["begins"](word)})
            if not begin:
                raise InputError(
                    "label: the model has no token that begins one of "
                    f"{', '.join(truth)}; name others"
                )
            inside = torch.zeros(
                logits.shape[1], dtype=torch.bool, device=logits.device
            )
            inside[begin] = True
            best, other = (
                logits.masked_fill(hidden, -torch.inf).amax(dim=1)
                for hidden in (~inside, inside)
            )
            lead = (best - other).max()
            losses.append(
                functional.logsigmoid(-lead)
                if has_word(one["text"], truth)
                else -functional.logsigmoid(lead)
            )
        return torch.stack(losses)

    def predictions(
        self, output: Sequence[Utterance | Texts], count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        """Return the text of each picture, the most frequent first, in one line without
        signs that steer a terminal.
        """
        each = (Counter(_texts(one)).most_common(count) for one in output)
        return [tuple(_said(text) for text, _ in texts) for texts in each]

    def said(
        self,
        output: Sequence[Utterance | Texts],
        truth: Words,
        margins: Sequence[float],
    ) -> list[tasks.Said]:
        """See `Task.said`: of several texts the most frequent among those that decide,
        and all of them beside it.
        """
        found = list[tasks.Said]()
        for one, margin in zip(output, margins, strict=True):
            texts = _texts(one)
            deciding = [
                text for text in texts if has_word(text, truth) == (margin >= 0.0)
            ] or texts
            kept: tasks.JsonValue = {"texts": [*texts]} if len(texts) > 1 else None
            found.append((_said(Counter(deciding).most_common(1)[0][0]), kept))
        return found


def _texts(one: Utterance | Texts) -> list[str]:
    return one["texts"] if "texts" in one else [one["text"]]  # type: ignore[typeddict-item]


def _said(text: str) -> tasks.Prediction:
    shown = "".join(sign if sign.isprintable() else " " for sign in text)
    return tasks.Prediction(" ".join(shown.split()) or SILENCE)


def _words(setting: str, text: str) -> Words:
    found = tuple(
        dict.fromkeys(
            " ".join(part.split()).casefold()
            for part in text.split(",")
            if part.strip()
        )
    )
    if not found:
        raise InputError(
            f"{setting}: expected words, separated by commas, got {text!r}"
        )
    return found


def has_word(text: str, words: Words) -> bool:
    """Whether a text has one of some words, or terms of several, in any case; "mug" is
    no word of "smug".
    """
    text = " ".join(text.split()).casefold()
    return any(re.search(rf"(?<!\w){re.escape(word)}(?!\w)", text) for word in words)
