"""Send images to models behind addresses (``http://...``, ``https://...``).

Such a model returns answers, but no gradients. In the plain protocol it gets
``{"image": PNG in base64, "prompt": text}`` and returns ``{"scores": {name:
fraction}}`` or ``{"text": answer}``. If the path of the address ends in
``/chat/completions``, requests follow the protocol of OpenAI's chat. A key from the
environment is sent to this address only: redirects are not followed, and the key is
written to no message, row or file.
"""

from __future__ import annotations

import base64
import hashlib
import http.client
import io
import json
import math
import socket
import ssl
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as futures_wait
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, TypeAlias
from urllib.parse import SplitResult, urlunsplit

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.extend import InputError, Model, errors, models, stored_files

# Suffix of the path of an address with OpenAI's chat protocol.
CHAT_SUFFIX = "/chat/completions"

LIMITS: dict[str, float] = {
    "calls": 2000, "at_once": 4, "tokens": float("inf"), "money": float("inf"),
    "per_call": 0.0, "per_million_in": 0.0, "per_million_out": 0.0, "seconds": 120.0,
}  # fmt: skip
"""Limits and prices that `ask` may set, with their defaults.

`calls` is the maximum number of calls of a run, and `at_once` that of concurrent calls.
`tokens` and `money` limit what a run spends; infinity means no limit. `per_call`,
`per_million_in` and `per_million_out` are the prices of a call and of a million tokens
in and out, in the unit of `money`. `seconds` is the maximum duration of an answer.
"""

MAX_TRIES = 5
FIRST_DELAY = 1.0
MAX_DELAY = 60.0
"""Maximum number of times that a request is sent if the server is busy or fails; and
the first and the maximum delay between them, in seconds. The delay doubles each time.
"""

MAX_CONCURRENT = 64
MAX_BATCH = 8  # images in one call of the model
# HTTP statuses of a server that may answer later.
RETRY_STATUSES = (408, 409, 425, 429, 500, 502, 503, 504, 529)
MAX_ANSWER_BYTES = 1 << 20  # maximum size of an answer in bytes
# Maximum number of bytes that are read of the body of an HTTP error.
MAX_ERROR_BYTES = 2000
# Maximum number of characters that are stored of an answer in words.
MAX_ANSWER_CHARACTERS = 1000
# Maximum number of characters of an answer's keys in a message.
MAX_KEYS_CHARACTERS = 100
# Size in bytes of the pieces in which an answer is read.
PIECE_BYTES = 1 << 16
# Minimum score: its logarithm is the logit of a name that an answer leaves out.
MIN_SCORE = 1e-6
REFUSED = "(refused)"  # text of a model that declines to answer
# An image (H, W, 3) with 8 bits per channel.
Image8Bit: TypeAlias = npt.NDArray[np.uint8]


class AnswerStore(Protocol):
    """The store of a run, with its notes."""

    def read_json_note(self, key: str) -> Any:
        """Return a JSON value, or None."""

    def write_note(self, key: str, value: str) -> None:
        """Store JSON text under a key."""


def load(spec: str, purpose: models.Purpose) -> Model:
    """Create the model behind an address.

    If the task needs scores, and the user gave no names of classes, one request for a
    gray image finds out the names.

    Args:
        spec: the address, perhaps with ``#NAME`` behind it, which is the name of a
            chat's model or of the model in results.
        purpose: task, names of classes and limits of the model.

    Raises:
        CodeNotAllowedError: the address comes from a file, and the user has not allowed
            it.
        InputError: it is no valid address, or the task needs scores, which a chat does
            not return.
        ModelError: it cannot do the task, or there is no answer.
    """
    address = models.check_address(spec)
    _check_sending_allowed(spec)
    module = _make_network(address, spec, purpose)
    return Model(
        module=module,
        name=module.name,
        labels=module.names,
        # The model takes images of any size: they are sent as they are rendered.
        preprocessing=models.Preprocessing(
            (models.DEFAULT_SIZE, models.DEFAULT_SIZE), resizes=False
        ),
        batch_limits=(1, MAX_BATCH),
        differentiable=False,
    )


def _check_sending_allowed(spec: str) -> None:
    """Raise CodeNotAllowedError if only a file, and not the user, names the address."""
    if not models.is_fetch_allowed(spec):
        raise models.CodeNotAllowedError(
            f"a file names the model {spec}, to which pictures would be sent, and the "
            f"key in {models.KEY}; {models.explain_how_to_allow(spec)}"
        )


def _make_network(
    address: SplitResult, spec: str, purpose: models.Purpose
) -> AddressModel:
    """Return the network behind an address, which knows its names.

    Args:
        address: the address in its parts.
        spec: what the user wrote.
        purpose: task, names of classes and limits of the model.
    """
    is_chat = address.path.endswith(CHAT_SUFFIX)
    name = address.fragment or address.netloc  # what stands after a #, or the host
    is_free, question = purpose.parse_question(name, "is behind an address")
    if is_chat:
        _check_chat(spec, name, is_free=is_free, is_named=bool(address.fragment))
    module = AddressModel(
        url=urlunsplit(address._replace(fragment="")),
        name=name,
        spec=spec,
        limits=resolve_limits(purpose.ask),
        chat_model_name=address.fragment if is_chat else "",
        question=question or (models.QUESTION if is_free else ""),
        tokens=purpose.tokens,
        n_answers_per_image=purpose.times if is_free else 1,
    )
    # A free answer is in words: such a model has no names.
    if not is_free:
        module.names = purpose.names or _request_names(module)
        _check_two_names(module)
    return module


def _check_two_names(module: AddressModel) -> None:
    """Raise ModelError if a model with scores has fewer than two names."""
    if len(module.names) < 2:
        raise errors.ModelError(
            f"model {module.name}: expected scores of two names at "
            f"least, got {len(module.names)}"
        )


def _check_chat(spec: str, name: str, *, is_free: bool, is_named: bool) -> None:
    """Check that a chat can be used as the task needs it.

    Args:
        spec: what the user wrote.
        name: name of the model, for messages.
        is_free: whether the task takes answers in free words; a chat has no scores.
        is_named: whether the address names the chat's model behind a #.

    Raises:
        InputError: the task needs scores, or the address names no model.
    """
    if not is_free:
        raise InputError(
            f"task: a chat such as {name} answers in words; use "
            "`task=answer`, and set the right `label`"
        )
    if not is_named:
        raise InputError(
            f"model {spec}: expected the name of the chat's model behind "
            f"a #: {spec}#NAME"
        )


def _request_names(module: AddressModel) -> tuple[str, ...]:
    """Return the names to which a model behind an address gives scores.

    A gray image is sent, and the names in the answer are taken.
    """
    size = (models.DEFAULT_SIZE, models.DEFAULT_SIZE)
    gray_image = np.full((*size, 3), 128, np.uint8)
    return tuple(module.request_scores([gray_image])[0])


def resolve_limits(ask: Mapping[str, float]) -> dict[str, float]:
    """Return all limits of a run: those that the setting `ask` sets, else the defaults.

    Raises:
        InputError: a name is unknown, a number is out of range, or `money` is limited
            without a price.
    """
    for name, value in ask.items():
        _check_limit(name, value)
    limits = {**LIMITS, **ask}
    _check_concurrency(limits["at_once"])
    has_price = any(
        limits[name] for name in ("per_call", "per_million_in", "per_million_out")
    )
    # Without a price no money is spent, and a limit of money would never be reached.
    if "money" in ask and not has_price:
        raise InputError(
            "`ask` money: expected a price too; give `ask` per_call, or "
            "per_million_in and per_million_out"
        )
    return limits


def _check_limit(name: str, value: float) -> None:
    """Raise InputError if a limit is unknown, or no number of at least 0."""
    if name not in LIMITS:
        raise errors.UnknownNameError("name in `ask`", name, LIMITS)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not value >= 0:  # NaN is not either
        raise InputError(
            f"`ask` {name}: expected a number of at least 0, got {value!r}"
        )


def _check_concurrency(at_once: float) -> None:
    """Raise InputError if a number of requests at once is not allowed."""
    if not 1 <= at_once <= MAX_CONCURRENT or at_once != int(at_once):
        raise InputError(
            "`ask` at_once: expected a whole number from 1 to "
            f"{MAX_CONCURRENT}, got {at_once:g}"
        )


@dataclass(frozen=True)
class _Request:
    """A request that is to be sent.

    Attributes:
        index: index of its body in the list of bodies to send.
        tries_left: how often it may be sent, this time included.
        delay: seconds to wait if this try fails.
    """

    index: int
    tries_left: int
    delay: float


class _Failure(NamedTuple):
    """Why a request failed.

    Attributes:
        reason: the reason, for a message.
        may_retry: whether another try may succeed.
        retry_after: after how many seconds, if the server states it; else 0.
    """

    reason: str
    may_retry: bool
    retry_after: float = 0.0


class _Connection(http.client.HTTPConnection):
    """A connection with a deadline, which another thread can break off at any time.

    The timeout of a socket starts anew with each byte, so that it is no limit for an
    answer.
    """

    deadline = math.inf
    connected: socket.socket | None = None

    def connect(self) -> None:
        """Connect. Raises TimeoutError after the deadline, so that nothing is sent."""
        super().connect()
        self.connected = self.sock
        if time.monotonic() > self.deadline:
            self.close()
            raise TimeoutError("timed out: connected too late")

    def break_off(self) -> None:
        """End whatever is being sent or read; a connection that has ended stays so."""
        for opened in (self.sock, self.connected):
            if opened is not None:
                # Not `opened.shutdown`: that of an SSL socket would wait for the
                # server.
                with suppress(OSError):
                    socket.socket.shutdown(opened, socket.SHUT_RDWR)


class _SecureConnection(_Connection, http.client.HTTPSConnection):
    """A connection by TLS with a deadline."""


class _TrackingHandler(urllib.request.AbstractHTTPHandler):
    """Opens connections with a deadline, and lists them for another thread to break
    off.

    Args:
        deadline: deadline of each connection, as `time.monotonic` counts.
        connections: list to add to.
    """

    def __init__(self, deadline: float, connections: list[_Connection]) -> None:
        super().__init__()
        self._deadline = deadline
        self._connections = connections

    def do_open(
        self, http_class: Any, req: urllib.request.Request, **options: Any
    ) -> Any:
        """Send a request as the base class does, over a tracked connection.

        The base class makes its connection by calling a class. It gets a function
        instead, which sets the deadline and lists the connection, so that another
        thread can break it off.

        Args:
            http_class: class of connection that the base class would use.
            req: the request.
            **options: further arguments of the connection.
        """
        is_secure = issubclass(http_class, http.client.HTTPSConnection)
        connection_class = _SecureConnection if is_secure else _Connection

        def make_connection(host: str, **settings: Any) -> _Connection:
            """Make a connection to a host as `http_class` does, and list it."""
            connection = connection_class(host, **settings)
            connection.deadline = self._deadline
            self._connections.append(connection)
            return connection

        return super().do_open(make_connection, req, **options)


class _PlainHandler(_TrackingHandler, urllib.request.HTTPHandler):
    """Opens tracked connections of ``http``."""


class _SecureHandler(_TrackingHandler, urllib.request.HTTPSHandler):
    """Opens tracked connections of ``https``."""


@dataclass(eq=False)
class AddressModel(models.RemoteNetwork):
    """A model behind an address, as a network.

    Its input are images (N, 3, H, W) in [0, 1], which are rounded to 8 bits. Its output
    are logits (N, names), or without names the texts about each image
    (`advsearch.tasks.answers.AnswersWithoutLogits`). The same image is not sent twice
    in a run, even if the run is resumed.

    Attributes:
        url: URL of requests.
        name: name in messages.
        spec: what the user wrote.
        limits: limits and prices of a run, with all names of `LIMITS`.
        chat_model_name: the name of a chat's model; empty for the plain protocol.
        question: question about the image; may be empty.
        tokens: maximum length of an answer in words.
        n_answers_per_image: number of requests per image.
        names: names with scores in answers.
        spent: number of "calls", "tokens_in" and "tokens_out" of a run. If the run was
            resumed, those before the interruption are included.
        store: the run that stores answers and what is spent; None if there is no run.
        answer_cache: answers by key, if no run stores them.
    """

    url: str
    name: str
    spec: str
    limits: Mapping[str, float]
    chat_model_name: str
    question: str
    tokens: int
    n_answers_per_image: int
    names: tuple[str, ...] = ()
    spent: Counter[str] = field(default_factory=Counter)
    store: AnswerStore | None = None
    answer_cache: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __call__(self, pictures: Tensor) -> Any:
        """Return the model's output for images (N, 3, H, W) in [0, 1].

        The output are logits (N, names). If the model has no names, it is a list with
        the texts about each image, ``{"texts": [...]}``.
        """
        # what an image file holds: integers from 0 to 255, channels last
        levels = (pictures.clamp(0.0, 1.0).nan_to_num() * 255.0).round().to(torch.uint8)
        images = list(levels.permute(0, 2, 3, 1).cpu().contiguous().numpy())
        if not self.names:
            return [{"texts": texts} for texts in self._request_texts(images)]
        # A score of 0 has no logarithm, so that `MIN_SCORE` replaces it. A name that is
        # missing in the answer has a score of 0.
        rows = [
            [max(scores.get(name, 0.0), MIN_SCORE) for name in self.names]
            for scores in self.request_scores(images)
        ]
        return torch.tensor(rows).log()

    def _request_texts(self, images: Sequence[Image8Bit]) -> list[list[str]]:
        """Return the texts about each image, one for each of `n_answers_per_image` requests.

        If an answer has scores in place of a text, its text is the name with the
        highest score.
        """
        n_turns = self.n_answers_per_image
        # turn: the number of the request about the same image
        requests = [(image, turn) for image in images for turn in range(n_turns)]
        texts = []
        for answer in self._get_answers(requests):
            scores: dict[str, float] = answer.get("scores") or {answer["text"]: 1.0}
            texts.append(max(scores, key=scores.__getitem__))
        # The texts about one image follow each other.
        starts = range(0, len(texts), n_turns)
        return [texts[start : start + n_turns] for start in starts]

    def request_scores(self, images: Sequence[Image8Bit]) -> list[dict[str, float]]:
        """Return the scores by name in the answer to each image.

        Raises:
            ModelError: an answer is in words, or has other names than the labels.
        """
        # One request is enough for scores, so that each image has turn 0 only.
        turn = 0
        rows = []
        for answer in self._get_answers([(image, turn) for image in images]):
            self._check_scored(answer)
            rows.append(answer["scores"])
        return rows

    def _check_scored(self, answer: Mapping[str, Any]) -> None:
        """Raise ModelError if an answer is in words, or has other names than labels."""
        if "scores" not in answer:
            raise errors.ModelError(
                f"model {self.name}: answers in words ({answer['text'][:60]!r}), "
                "and not with scores; use "
                "`task=answer`, and set the right `label`"
            )
        if self.names and (other := answer["scores"].keys() - set(self.names)):
            raise errors.ModelError(
                f"model {self.name}: has a score for {min(other)!r}, "
                "which is not among the `labels`"
            )

    def store_answers_in(self, store: AnswerStore) -> None:
        """Store answers and what is spent in a run from now on.

        Answers that the run has already stored are not requested again, and its counts
        are continued.
        """
        self.spent += Counter(store.read_json_note(f"asked {self.spec}") or {})
        self.store = store

    def _get_answers(
        self, requests: Sequence[tuple[Image8Bit, int]]
    ) -> list[dict[str, Any]]:
        """Return the answer to each image and turn: a stored one, or a new one.

        Each new answer is stored as it arrives, so that an interrupted run loses none.
        An equal image with an equal turn is sent only once.

        Args:
            requests: images, each with its turn. The turn is the index of the request
                about that image, from 0: a model with random answers gets the same
                image in several turns.
        """
        keys = list[str]()
        answers = dict[str, Any]()
        new_bodies = dict[str, dict[str, Any]]()
        for image, turn in requests:
            body = self._make_body(image)
            key = self._make_answer_key(body, turn)
            keys.append(key)
            stored_answer = self._read_stored_answer(key)
            if isinstance(stored_answer, dict):
                answers[key] = stored_answer
            else:  # there is none, or it is corrupt
                new_bodies[key] = body
        answers.update(self._request_answers(new_bodies))
        return [answers[key] for key in keys]

    def _make_answer_key(self, body: Mapping[str, Any], turn: int) -> str:
        """Return the key of an answer: a hash of all that the answer depends on."""
        request = json.dumps([body, turn, self.spec]).encode()
        return f"answer {hashlib.blake2b(request, digest_size=16).hexdigest()}"

    def _request_answers(
        self, body_by_key: Mapping[str, Mapping[str, Any]]
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Request new answers; yield the key and the answer of each once it is stored."""
        keys = list(body_by_key)
        read_answer = self._read_chat if self.chat_model_name else self._read_plain
        for index, response in self._send(list(body_by_key.values())):
            self._count_tokens(response)
            answer = read_answer(response)
            self._store_answer(keys[index], answer)
            yield keys[index], answer

    def _read_stored_answer(self, key: str) -> Any:
        """Return the answer that is stored under a key; None if there is none."""
        if self.store is None:
            return self.answer_cache.get(key)
        return self.store.read_json_note(key)

    def _store_answer(self, key: str, answer: dict[str, Any]) -> None:
        """Store an answer under a key."""
        if self.store is None:
            self.answer_cache[key] = answer
        else:
            self.store.write_note(key, json.dumps(answer))

    def _make_body(self, image: Image8Bit) -> dict[str, Any]:
        """Return the JSON body of a request about an image.

        It follows the protocol of OpenAI's chat if `chat_model_name` is not empty, and
        else the plain protocol, {"image": PNG in base64, "prompt": question}.
        """
        encoded = base64.b64encode(models.encode_levels(image)).decode()
        if not self.chat_model_name:
            body: dict[str, Any] = {"image": encoded}
            if self.question:
                body["prompt"] = self.question
            return body
        return self._make_chat_body(encoded)

    def _make_chat_body(self, encoded: str) -> dict[str, Any]:
        """Return the JSON body of a chat's request about an image, a PNG in base64."""
        image_url = {"url": f"data:image/png;base64,{encoded}"}
        content = [
            {"type": "text", "text": self.question},
            {"type": "image_url", "image_url": image_url},
        ]
        return {
            "model": self.chat_model_name,
            "messages": [{"role": "user", "content": content}],
            "max_tokens": self.tokens,
        }

    def _read_plain(self, response: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer in a response of the plain protocol.

        It is ``{"scores": {name: fraction}}`` or ``{"text": answer}``.

        Raises:
            ModelError: the response has neither, or scores outside [0, 1].
        """
        scores = response.get("scores")
        text = response.get("text")
        if isinstance(scores, dict) and scores:
            self._check_fractions(list(scores.values()))
            return {"scores": scores}
        if isinstance(text, str):
            return {"text": text[:MAX_ANSWER_CHARACTERS]}
        raise self._make_error(
            '{"scores": {NAME: FRACTION}} or {"text": WORDS}', response
        )

    def _check_fractions(self, values: Sequence[Any]) -> None:
        """Raise ModelError if the scores of a response are no numbers from 0 to 1."""
        not_numbers = [
            value
            for value in values
            if isinstance(value, bool) or not isinstance(value, (int, float))
        ]
        if not_numbers or not all(0.0 <= value <= 1.0 for value in values):
            got = not_numbers or [min(values), max(values)]
            raise self._make_error("scores from 0 to 1", f"{got}")

    def _read_chat(self, response: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer in a response of a chat, as ``{"text": answer}``.

        The text is `REFUSED` if the model declines to answer.

        Raises:
            ModelError: there is no text.
        """
        try:
            choice = response["choices"][0]
            message = choice["message"]
            content = message.get("content")
            refusal = message.get("refusal")
        except (KeyError, IndexError, TypeError, AttributeError):
            expected = "choices with a message, as a chat answers"
            raise self._make_error(expected, response) from None
        content = _join_pieces(content)
        if not content:  # None, or empty
            is_filtered = choice.get("finish_reason") == "content_filter"
            if refusal or is_filtered:
                return {"text": REFUSED}
        if not isinstance(content, str):
            raise self._make_error("an answer in words", type(content).__name__)
        return {"text": content[:MAX_ANSWER_CHARACTERS]}

    def _store_spent(self) -> None:
        """Store what has been spent, if there is a run."""
        if self.store is not None:
            self.store.write_note(f"asked {self.spec}", json.dumps(self.spent))

    @property
    def _spent_by_limit(self) -> dict[str, float]:
        """The calls, tokens and money that have been spent so far.

        The keys are the names of their limits: "calls", "tokens" and "money". Money is
        in the currency in which the user stated the prices.
        """
        spent = self.spent
        return {
            "calls": spent["calls"],
            "tokens": spent["tokens_in"] + spent["tokens_out"],
            "money": self._spent_money,
        }

    @property
    def _spent_money(self) -> float:
        """The cost of all calls and tokens so far."""
        prices = self.limits  # it has the prices, too
        spent = self.spent
        # the cost of all tokens, times a million
        token_cost = (
            prices["per_million_in"] * spent["tokens_in"]
            + prices["per_million_out"] * spent["tokens_out"]
        )
        return prices["per_call"] * spent["calls"] + token_cost / 1e6

    @property
    def spending_sentence(self) -> str:
        """What a run has spent, as a sentence."""
        calls, tokens, money = self._spent_by_limit.values()
        text = f"The model {self.name} was called {calls:,} times"
        if tokens:
            text += f", {tokens:,} tokens"
        if money:
            text += f", {money:.4g} of money"
        return f"{text}."

    @property
    def _priced_by_token(self) -> bool:
        """Whether tokens have a price."""
        return bool(self.limits["per_million_in"] or self.limits["per_million_out"])

    @property
    def _has_token_limit(self) -> bool:
        """Whether the user limits tokens: by default the limit is infinite."""
        return self.limits["tokens"] < LIMITS["tokens"]

    def _send(
        self, bodies: Sequence[Mapping[str, Any]]
    ) -> Iterator[tuple[int, dict[str, Any]]]:
        """Send bodies, a few at a time, and again while the server is busy.

        Yields:
            The index of each body, and the JSON object in the response to it.

        Raises:
            ModelError: a limit is reached, nobody answers, or a response is invalid;
                the responses up to then are yielded before.
        """
        # requests that are still to be sent
        pending = [
            _Request(index, MAX_TRIES, FIRST_DELAY) for index in range(len(bodies))
        ]
        max_concurrent = self._max_concurrent()
        while pending:
            models.INTERRUPTS.raise_pending()
            # fewer than requested, if a limit is near
            count = self._reserve(min(max_concurrent, len(pending)))
            batch = pending[:count]
            del pending[:count]
            retries = yield from self._send_batch(batch, bodies)
            self._wait_for_longest(retries)
            # twice the delay, for the case that they fail again
            retries = [replace(request, delay=2 * request.delay) for request in retries]
            pending = retries + pending

    def _send_batch(
        self, batch: Sequence[_Request], bodies: Sequence[Mapping[str, Any]]
    ) -> Generator[tuple[int, dict[str, Any]], None, list[_Request]]:
        """Send requests at the same time, and return those to send again.

        Args:
            batch: the requests.
            bodies: bodies of these and of other requests, by `_Request.index`.

        Yields:
            The index of each request that succeeded, and the response to it.

        Raises:
            ModelError: a request failed, and another try is pointless.
        """
        contents = [json.dumps(bodies[request.index]).encode() for request in batch]
        responses = self._send_together(contents)
        # `_reserve` has already counted the calls of this batch. If the connection is
        # refused in the first one, there is no server, and another try is pointless.
        is_first_batch = self.spent["calls"] <= len(batch)
        plans = list[tuple[str, _Request | None]]()
        for request, response in zip(batch, responses, strict=True):
            if isinstance(response, dict):
                yield request.index, response
            else:
                plan = self._plan_retry(request, response, first=is_first_batch)
                plans.append(plan)
        # This may raise, so it follows the loop: no response of the batch is lost.
        return _select_retries(plans)

    def _wait_for_longest(self, retries: Sequence[_Request]) -> None:
        """Wait for the longest delay of requests that are sent again, if there are any."""
        if retries:
            time.sleep(min(max(request.delay for request in retries), MAX_DELAY))

    def _max_concurrent(self) -> int:
        """Return how many requests may be sent at once.

        It is one if tokens or their cost are limited: how many tokens a request takes
        is known only from its response, and other requests that were sent at the same
        time could exceed the limit.
        """
        has_money_limit = self.limits["money"] < LIMITS["money"]  # default: infinity
        limits_token_cost = self._priced_by_token and has_money_limit
        if self._has_token_limit or limits_token_cost:
            return 1
        return int(self.limits["at_once"])

    def _plan_retry(
        self, request: _Request, error: Exception, *, first: bool
    ) -> tuple[str, _Request | None]:
        """Return why a request failed, and the request to send next.

        Args:
            request: request that failed.
            error: error that it raised.
            first: whether no request of the run has succeeded yet.

        Returns:
            The reason, for a message; and the request with one try less, or None if
            another try is pointless.
        """
        # an invalid response, which would come again
        if isinstance(error, errors.ModelError):
            return str(error), None
        failure = self._explain_failure(error, first=first)
        text = f"model {self.name}: {failure.reason} ({self.url})"
        if not failure.may_retry or request.tries_left == 1:
            return text, None
        delay = max(request.delay, failure.retry_after)
        return text, _Request(request.index, request.tries_left - 1, delay)

    def _reserve(self, max_count: int) -> int:
        """Count calls as spent before they are made, as many as the limits allow.

        They are counted first, so that a crash leaves no call uncounted. Each counted
        call may reach the limit of calls, or that of money by its price. Tokens are
        known only after a call, so that their limit stops later calls.

        Args:
            max_count: number of calls that the caller wants to make.

        Returns:
            The number of calls that may be made now, from 1 to `max_count`.

        Raises:
            ModelError: none is allowed.
        """
        count = 0
        while count < max_count:
            name = self._find_reached_limit()
            if name is not None and count:
                break  # the calls that are counted so far may be made
            if name is not None:
                raise self._make_limit_error(name, self._spent_by_limit[name])
            self.spent["calls"] += 1
            count += 1
        self._store_spent()
        return count

    def _find_reached_limit(self) -> str | None:
        """Return the name of the first limit that is reached; None if none is."""
        spent = self._spent_by_limit
        reached_limits = [name for name in spent if spent[name] >= self.limits[name]]
        return reached_limits[0] if reached_limits else None

    def _make_limit_error(self, name: str, spent: float) -> errors.ModelError:
        """Return the error for a limit that is reached, by its name."""
        limit = self.limits[name]
        advised_limit = 2 * limit or 1  # twice 0 would allow nothing either
        return errors.ModelError(
            f"model {self.name}: {spent:,.10g} {name} are spent, and `ask` allows "
            f"{limit:,.10g}; `advsearch resume RUN ask.{name}={advised_limit:.10g}` "
            "continues with a higher limit, and repeats no request"
        )

    def _send_together(
        self, bodies: Sequence[bytes]
    ) -> list[dict[str, Any] | Exception]:
        """Send bodies at the same time, and return the response to each, or its error.

        It takes at most `limits["seconds"]`, whatever a server does: connections that
        are still open after that are closed.
        """
        seconds = self.limits["seconds"]
        deadline = time.monotonic() + seconds
        pool = ThreadPoolExecutor(len(bodies))
        connections: list[_Connection] = []  # each thread adds its own
        try:
            futures = [
                pool.submit(self._try_to_send, body, deadline, connections)
                for body in bodies
            ]
            timeout = min(seconds, threading.TIMEOUT_MAX)
            done = futures_wait(futures, timeout=timeout).done
        finally:
            # After Ctrl-C the answers are not waited for. The threads end when their
            # connections are closed.
            pool.shutdown(wait=False)
            for connection in connections:
                connection.break_off()
        timed_out = TimeoutError(f"timed out: no answer within {seconds:g} seconds")
        return [future.result() if future in done else timed_out for future in futures]

    def _try_to_send(
        self, body: bytes, deadline: float, connections: list[_Connection]
    ) -> dict[str, Any] | Exception:
        """Return the response to a body, or the error that was raised.

        The error is returned because a later try may succeed.

        Args:
            body: JSON.
            deadline: deadline of the connection, as `time.monotonic` counts.
            connections: list that the connection is added to.
        """
        try:
            return self._send_body(body, deadline, connections)
        except urllib.error.HTTPError as error:
            # The message of the error needs its body, which cannot be read once the
            # connection is closed. So it is copied, or left out if reading it fails.
            # In the latter case the original error is returned.
            with error, suppress(OSError, http.client.HTTPException):
                text = error.read(MAX_ERROR_BYTES)
                error = urllib.error.HTTPError(
                    error.url, error.code, error.reason, error.headers, io.BytesIO(text)
                )
            return error
        # urllib's URLError is an OSError, too
        except (OSError, http.client.HTTPException, errors.ModelError) as error:
            return error

    def _explain_failure(self, error: Exception, *, first: bool) -> _Failure:
        """Explain why a request failed.

        Args:
            error: error that was raised.
            first: whether no request of the run has succeeded yet.
        """
        if not isinstance(error, urllib.error.HTTPError):
            return self._explain_connection_error(error, first=first)
        status = error.code
        with error:
            reason = self._explain_status(error)
        retry_after = error.headers.get("Retry-After", "")
        seconds = float(retry_after) if retry_after.isdecimal() else 0.0
        return _Failure(reason, status in RETRY_STATUSES, seconds)

    def _explain_connection_error(self, error: Exception, *, first: bool) -> _Failure:
        """Explain why there is no response.

        Args:
            error: error of the connection.
            first: whether no request has succeeded yet.
        """
        cause = getattr(error, "reason", error)  # what urllib's error wraps
        text = type(cause).__name__
        if str(cause):
            text += f": {cause}"
        # Later a refused connection may mean that the server is restarted.
        has_no_server = first and isinstance(cause, ConnectionRefusedError)
        is_final = isinstance(cause, (ssl.SSLCertVerificationError, ValueError))
        return _Failure(self._clean(text), may_retry=not (has_no_server or is_final))

    def _explain_status(self, error: urllib.error.HTTPError) -> str:
        """Return what an HTTP error status means, as a clause for a message.

        Redirects (300 to 399) count as errors: images and key are sent to no other
        address than the one that the user gave.
        """
        status = error.code
        if 300 <= status < 400:
            location = self._clean(error.headers.get("Location", "elsewhere"))
            return (
                f"redirects to {location}, and images and keys are not sent there; "
                "use that address if you trust it"
            )
        if status in (401, 403):
            problem = "is not accepted" if models.read_key() else "is missing"
            return f"status {status}: the key in {models.KEY} {problem}"
        body = error.read(MAX_ERROR_BYTES).decode(errors="replace")
        reason = self._clean(str(error.reason))
        return f"status {status} {reason}: {self._clean(body)[:300]}"

    def _send_body(
        self, body: bytes, deadline: float, connections: list[_Connection]
    ) -> dict[str, Any]:
        """Send one body, and return the JSON object in the response.

        Args:
            body: JSON.
            deadline: deadline of the connection, as `time.monotonic` counts.
            connections: list that the connection is added to.

        Raises:
            ModelError: the response is too long, or not a JSON object.
            OSError: the body cannot be sent, or there is no response.
            http.client.HTTPException: the response is no valid HTTP.
        """
        headers = {"Content-Type": "application/json", "User-Agent": "advsearch"}
        request = urllib.request.Request(self.url, body, headers)
        key = models.read_key()
        if key:
            # urllib does not send this header to the target of a redirect.
            request.add_unredirected_header("Authorization", f"Bearer {key}")
        opener = _make_opener(request.host, deadline, connections)
        with opener.open(request, timeout=self.limits["seconds"]) as response:
            content = self._read_limited(response)
        return self._parse_object(content)

    def _read_limited(self, response: Any) -> bytearray:
        """Return the content of a response; raise ModelError if it is too long."""
        max_size = stored_files.scale_limit(MAX_ANSWER_BYTES)
        content = bytearray()
        # In pieces: a server may send without end.
        while piece := response.read1(PIECE_BYTES):
            content += piece
            if len(content) > max_size:
                raise self._make_error(
                    f"an answer of at most {max_size:,} bytes", "a longer one"
                )
        return content

    def _parse_object(self, content: bytearray) -> dict[str, Any]:
        """Return the JSON object in a content; raise ModelError for anything else."""
        try:
            answer = stored_files.parse_json(content.decode(), finite=True)
        except ValueError as error:  # UnicodeDecodeError is one
            excerpt = self._clean(content[:60].decode(errors="replace"))
            raise self._make_error("JSON", f"{excerpt!r} ({error})") from None
        if not isinstance(answer, dict):
            raise self._make_error("a JSON object", type(answer).__name__)
        return answer

    def _clean(self, text: str) -> str:
        """Return a server's text on one line and without the key, which it may echo."""
        key = models.read_key()
        if key:
            text = text.replace(key, "(key)")
        printable = "".join(char if char.isprintable() else " " for char in text)
        return " ".join(printable.split())

    def _make_error(
        self, expected: str, got: str | Mapping[str, Any]
    ) -> errors.ModelError:
        """Return the error for an answer that is not what was expected.

        Args:
            expected: what was expected.
            got: what the answer is, or a JSON object, whose keys are named.
        """
        if isinstance(got, Mapping):
            keys = self._clean(", ".join(map(str, got)) or "nothing")
            got = keys[:MAX_KEYS_CHARACTERS]
        return errors.ModelError(
            f"model {self.name}: expected {expected}, got {got} ({self.url})"
        )

    def _count_tokens(self, response: Mapping[str, Any]) -> None:
        """Add the tokens that a response states to those that are spent.

        They are in its field `usage`, as in OpenAI's protocol.

        Raises:
            ModelError: it states none, and a limit or a price depends on them.
        """
        usage = response.get("usage")
        if not isinstance(usage, Mapping):
            usage = {}
        counts = [usage.get(name) for name in ("prompt_tokens", "completion_tokens")]
        # Tokens may be unknown if neither a limit nor a price depends on them.
        needs_tokens = self._has_token_limit or self._priced_by_token
        if all(map(_is_count, counts)):
            tokens_in, tokens_out = counts
            # `spent` is a Counter: `update` adds.
            self.spent.update({"tokens_in": tokens_in, "tokens_out": tokens_out})
            self._store_spent()
        elif needs_tokens:
            raise self._make_error(
                "`usage` with prompt_tokens and completion_tokens, as "
                "`ask` counts tokens",
                "none",
            )


def _select_retries(plans: Sequence[tuple[str, _Request | None]]) -> list[_Request]:
    """Return the requests to send again, from what is planned for those that failed.

    Args:
        plans: for each, why it failed, and the request to send next, or None.

    Raises:
        ModelError: another try of one of them is pointless; it states the reason.
    """
    retries = list[_Request]()
    final_reasons = list[str]()
    for reason, retry in plans:
        if retry is None:
            final_reasons.append(reason)
        else:
            retries.append(retry)
    if final_reasons:
        raise errors.ModelError(final_reasons[0])
    return retries


def _join_pieces(content: Any) -> Any:
    """Return the content of a chat's message, as one text if it is a text in pieces."""
    if not isinstance(content, list):
        return content
    pieces = [part for part in content if isinstance(part, dict)]
    return " ".join(str(piece.get("text", "")) for piece in pieces)


def _make_opener(
    address_host: str, deadline: float, connections: list[_Connection]
) -> urllib.request.OpenerDirector:
    """Return what opens a tracked connection to a host, and follows no redirect.

    Args:
        address_host: the host of an address, perhaps with its port.
        deadline: deadline of the connection, as `time.monotonic` counts.
        connections: list that the connection is added to.
    """
    handlers: list[Any] = [
        models.NoRedirect,
        _PlainHandler(deadline, connections),
        _SecureHandler(deadline, connections),
    ]
    # the host without the port, and without the brackets of an IPv6 address
    host = address_host.rpartition(":")[0].strip("[]") or address_host
    if models.is_local(host):
        # A proxy in the environment cannot reach a server on this machine.
        handlers.append(urllib.request.ProxyHandler({}))
    return urllib.request.build_opener(*handlers)


def _is_count(value: object) -> bool:
    """Return whether a value is an integer of at least 0."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0
