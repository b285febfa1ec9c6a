"""Models that only answer: ``http://...`` and ``https://...``, each asked with a
picture over the network.

One that speaks the plain protocol is sent ``{"image": PNG in base64, "prompt": text}``
and says ``{"scores": {name: share}}`` or ``{"text": words}``. One whose path ends in
``/chat/completions`` is asked as OpenAI's chat is. What is sent beside that is a key
from the environment, to this address alone: redirects are not followed, and no message,
row or file has the key.
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
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as futures_wait
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Protocol, TypeAlias
from urllib.parse import urlunsplit

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.extend import InputError, Model, errors, models, stored_files

# how the path of an address ends that is asked as OpenAI's chat is
CHAT = "/chat/completions"

LIMITS: dict[str, float] = {
    "calls": 2000, "at_once": 4, "tokens": float("inf"), "money": float("inf"),
    "per_call": 0.0, "per_million_in": 0.0, "per_million_out": 0.0, "seconds": 120.0,
}  # fmt: skip
"""What `ask` may say, with its defaults: the most calls of a run, and how many are
under way at the same time; the most tokens and money; the price of a call and of a
million tokens in and out, in the unit of `money`; how long an answer may take.
"""

TRIES = 5
FIRST_WAIT = 1.0
LONGEST_WAIT = 60.0
"""How often a picture is sent to a server that is busy or fails, and the seconds
between: twice as long each time.
"""

MOST_AT_ONCE = 64
# statuses of a server that may answer later
BUSY = (408, 409, 425, 429, 500, 502, 503, 504, 529)
LARGEST = 1 << 20  # bytes of an answer
# bytes that are read of what comes with a status that is no success
LONGEST_FAILURE = 2000
LONGEST = 1000  # characters that are kept of an answer in words
# the share of a name that an answer leaves out, or gives less: its logarithm is the
# logit
LEAST = 1e-6
REFUSED = "(refused)"  # the words of a model that declines to answer
Levels: TypeAlias = npt.NDArray[np.uint8]  # A picture (H, W, 3) as a file has it


class KeepsAnswers(Protocol):
    """What a run keeps notes in."""

    def noted(self, key: str) -> Any:
        """Return a JSON value, or None."""

    def set_note(self, key: str, value: str) -> None:
        """Keep JSON text under a key."""


def load(spec: str, purpose: models.Purpose) -> Model:
    """Return the model behind an address, which is asked for its names where nobody
    says them. Raises InputError: only a file names it, or as `check_address`;
    ModelError: it cannot do what it is to be asked, or nobody answers.
    """
    address = models.check_address(spec)
    if not models.may_fetch(spec):
        raise models.CodeNotAllowedError(
            f"a file names the model {spec}, to which pictures would be sent, and the "
            f"key in {models.KEY}; "
            f"{models.how_to_allow(spec)}"
        )
    chat = address.path.endswith(CHAT)
    name = address.fragment or address.netloc
    free, question = purpose.in_words(name, "is behind an address")
    if chat and not free:
        raise InputError(
            f"task: a chat such as {name} answers in words; use "
            "`task=answer`, and say the right `label`"
        )
    if chat and not address.fragment:
        raise InputError(
            f"model {spec}: expected the name of the chat's model behind "
            f"a #: {spec}#NAME"
        )
    asked = AskedModel(
        url=urlunsplit(address._replace(fragment="")),
        name=name,
        spec=spec,
        limits=limits_of(purpose.ask),
        chat=address.fragment if chat else "",
        question=question or (models.QUESTION if free else ""),
        tokens=purpose.tokens,
        times=purpose.times if free else 1,
    )
    if not free:
        asked.names = purpose.names or tuple(
            asked.scores([np.full((models.SIDE, models.SIDE, 3), 128, np.uint8)])[0]
        )
        if len(asked.names) < 2:
            raise errors.ModelError(
                f"model {name}: expected scores of two names at "
                f"least, got {len(asked.names)}"
            )
    return Model(
        module=asked,
        name=name,
        labels=asked.names,
        preprocessing=models.Preprocessing((models.SIDE, models.SIDE), resizes=False),
        batch_limits=(1, 8),
        differentiable=False,
    )


def limits_of(ask: Mapping[str, float]) -> dict[str, float]:
    """Return every limit, as asked or by default. Raises InputError where a name is
    unknown, or a number below 0.
    """
    for name, value in ask.items():
        if name not in LIMITS:
            raise errors.UnknownNameError("name in `ask`", name, LIMITS)
        if (
            isinstance(value, bool)
            or not isinstance(value, (int, float))
            or not value >= 0
        ):
            raise InputError(
                f"`ask` {name}: expected a number of at least 0, got {value!r}"
            )
    limits = {**LIMITS, **ask}
    if not (
        1 <= limits["at_once"] <= MOST_AT_ONCE
        and limits["at_once"] == int(limits["at_once"])
    ):
        raise InputError(
            "`ask` at_once: expected a whole number from 1 to "
            f"{MOST_AT_ONCE}, got {limits['at_once']:g}"
        )
    priced = any(
        limits[name] for name in ("per_call", "per_million_in", "per_million_out")
    )
    if "money" in ask and not priced:
        raise InputError(
            "`ask` money: expected a price beside it; give `ask` per_call, or "
            "per_million_in and per_million_out"
        )
    return limits


class _Connection(http.client.HTTPConnection):
    """A connection that ends at a time, and that another thread can break off, whatever
    it waits for.

    A socket's own limit begins anew with each byte that comes, so it alone is no limit
    for an answer.
    """

    end = math.inf
    connected: socket.socket | None = None

    def connect(self) -> None:
        super().connect()
        self.connected = self.sock
        if time.monotonic() > self.end:  # nobody waits any more, so nothing is sent
            self.close()
            raise TimeoutError("timed out: connected too late")

    def break_off(self) -> None:
        """End whatever is being sent or read; a connection that has ended stays so."""
        for opened in (self.sock, self.connected):
            if opened is not None:
                # not the method of an SSL socket, which would wait for the other side
                with suppress(OSError):
                    socket.socket.shutdown(opened, socket.SHUT_RDWR)


class _SecureConnection(_Connection, http.client.HTTPSConnection):
    pass


class _NotesConnections(urllib.request.AbstractHTTPHandler):
    """Opens connections that end at a time, and notes them where another thread can
    break them off.
    """

    def __init__(self, end: float, connections: list[_Connection]) -> None:
        super().__init__()
        self._end = end
        self._connections = connections

    def do_open(
        self, http_class: Any, req: urllib.request.Request, **options: Any
    ) -> Any:
        is_secure = issubclass(http_class, http.client.HTTPSConnection)

        def connection_to(host: str, **more: Any) -> _Connection:
            connection = (_SecureConnection if is_secure else _Connection)(host, **more)
            connection.end = self._end
            self._connections.append(connection)
            return connection

        return super().do_open(connection_to, req, **options)


class _Handler(_NotesConnections, urllib.request.HTTPHandler):
    pass


class _SecureHandler(_NotesConnections, urllib.request.HTTPSHandler):
    pass


@dataclass(eq=False)
class AskedModel(models.RemoteNetwork):
    """Answers pictures (N, 3, H, W) in [0, 1], rounded to 8 bits: logits (N, names), or
    without names what is said of each picture (`advsearch.tasks.answers.Texts`). The
    same picture is not sent twice in a run, also if it goes on.
    """

    url: str
    name: str
    spec: str  # what its user wrote
    limits: Mapping[str, float]  # of a run, see `LIMITS`
    chat: str  # the name of a chat's model; empty for the plain protocol
    question: str  # what is asked of the picture; may be empty
    tokens: int  # the most of an answer in words
    times: int  # how often each picture is asked
    names: tuple[str, ...] = ()  # of which it gives scores
    # calls, and tokens in and out, of a run's earlier lives too
    spent: Counter[str] = field(default_factory=Counter)
    store: KeepsAnswers | None = None  # the run that keeps answers and what is spent
    # answers, where no run keeps them
    known: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __call__(self, pictures: Tensor) -> Any:
        levels = (
            (pictures.clamp(0.0, 1.0).nan_to_num() * 255.0)
            .round()
            .to(torch.uint8)
            .permute(0, 2, 3, 1)
        )
        images = list(levels.cpu().contiguous().numpy())
        if self.names:
            rows = self.scores(images)
            return torch.tensor(
                [
                    [max(row.get(name, 0.0), LEAST) for name in self.names]
                    for row in rows
                ]
            ).log()
        answers = self._answers(
            [(image, turn) for image in images for turn in range(self.times)]
        )
        shares: list[dict[str, float]] = [
            answer.get("scores") or {answer["text"]: 1.0} for answer in answers
        ]
        # the likeliest name where there are scores
        texts = iter([max(each, key=each.__getitem__) for each in shares])
        return [{"texts": list(islice(texts, self.times))} for _ in images]

    def scores(self, images: Sequence[Levels]) -> list[dict[str, float]]:
        """Return the share of each name that the answer to each picture has, in its
        order.
        """
        rows = []
        for answer in self._answers([(image, 0) for image in images]):
            if "scores" not in answer:
                raise errors.ModelError(
                    f"model {self.name}: answers in words ({answer['text'][:60]!r}), "
                    "which are no scores; use "
                    "`task=answer`, and say the right `label`"
                )
            if self.names and (other := answer["scores"].keys() - set(self.names)):
                raise errors.ModelError(
                    f"model {self.name}: says {min(other)!r}, "
                    "which is none of the `labels`"
                )
            rows.append(answer["scores"])
        return rows

    def keep_in(self, store: KeepsAnswers) -> None:
        """Keep answers and what is spent in a run from here on: answers that it has are
        not asked for again, and counting goes on where it stopped.
        """
        self.spent += Counter(store.noted(f"asked {self.spec}") or {})
        self.store = store

    def _answers(self, asked: Sequence[tuple[Levels, int]]) -> list[dict[str, Any]]:
        """The answer to each picture at each time: one that the run has, or a new one,
        kept as it comes. Trials differ in their noise, and so in their pictures.
        """
        keys = list[str]()
        answers = dict[str, Any]()
        new = dict[str, dict[str, Any]]()
        for image, turn in asked:
            body = self._body(image)
            digest = hashlib.blake2b(
                json.dumps([body, turn, self.spec]).encode(), digest_size=16
            ).hexdigest()
            keys.append(key := f"answer {digest}")
            answers[key] = (
                self.known.get(key) if self.store is None else self.store.noted(key)
            )
            if not isinstance(answers[key], dict):
                new[key] = body
        for place, sent in self._send(list(new.values())):
            self._count_tokens(sent)
            key = list(new)[place]
            answer = self._read_chat(sent) if self.chat else self._read(sent)
            answers[key] = answer
            if self.store is None:
                self.known[key] = answer
            else:
                self.store.set_note(key, json.dumps(answer))
        return [answers[key] for key in keys]

    def _body(self, image: Levels) -> dict[str, Any]:
        picture = base64.b64encode(models.png_of(image)).decode()
        if not self.chat:
            return {
                "image": picture,
                **({"prompt": self.question} if self.question else {}),
            }
        content = [
            {"type": "text", "text": self.question},
            {
                "type": "image_url",
                "image_url": {"url": f"data:image/png;base64,{picture}"},
            },
        ]
        return {
            "model": self.chat,
            "messages": [{"role": "user", "content": content}],
            "max_tokens": self.tokens,
        }

    def _read(self, answer: Mapping[str, Any]) -> dict[str, Any]:
        scores = answer.get("scores")
        text = answer.get("text")
        if isinstance(scores, dict) and scores:
            shares = list(scores.values())
            bad = [
                share
                for share in shares
                if isinstance(share, bool) or not isinstance(share, (int, float))
            ]
            if bad or not all(0.0 <= share <= 1.0 for share in shares):
                raise self._wrong(
                    "scores from 0 to 1", f"{bad or [min(shares), max(shares)]}"
                )
            return {"scores": scores}
        if isinstance(text, str):
            return {"text": text[:LONGEST]}
        raise self._wrong('{"scores": {NAME: SHARE}} or {"text": WORDS}', answer)

    def _read_chat(self, answer: Mapping[str, Any]) -> dict[str, Any]:
        try:
            message = answer["choices"][0]["message"]
            content = message.get("content")
            refusal = message.get("refusal")
        except (KeyError, IndexError, TypeError, AttributeError):
            raise self._wrong(
                "choices with a message, as a chat answers", answer
            ) from None
        if isinstance(content, list):
            content = " ".join(
                str(part.get("text", "")) for part in content if isinstance(part, dict)
            )
        if not content and (
            refusal or answer["choices"][0].get("finish_reason") == "content_filter"
        ):
            return {"text": REFUSED}
        if not isinstance(content, str):
            raise self._wrong("an answer in words", type(content).__name__)
        return {"text": content[:LONGEST]}

    def _keep_spent(self) -> None:
        if self.store is not None:
            self.store.set_note(f"asked {self.spec}", json.dumps(self.spent))

    @property
    def _so_far(self) -> dict[str, float]:
        """What has been spent, by the name of its limit; money in the unit of the
        prices.
        """
        limits = self.limits
        spent = self.spent
        by_token = (
            limits["per_million_in"] * spent["tokens_in"]
            + limits["per_million_out"] * spent["tokens_out"]
        )
        money = limits["per_call"] * spent["calls"] + by_token / 1e6
        return {
            "calls": spent["calls"],
            "tokens": spent["tokens_in"] + spent["tokens_out"],
            "money": money,
        }

    @property
    def sentence(self) -> str:
        """What a run has spent, for its reader."""
        calls, tokens, money = self._so_far.values()
        more = (f", {tokens:,} tokens" if tokens else "") + (
            f", {money:.4g} of money" if money else ""
        )
        return f"The model {self.name} was asked {calls:,} times{more}."

    @property
    def _priced_by_token(self) -> bool:
        return bool(self.limits["per_million_in"] or self.limits["per_million_out"])

    def _send(
        self, bodies: Sequence[Mapping[str, Any]]
    ) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the places of what is sent, each with the JSON object that the server
        answers; several are sent at once, and again where it is busy. Raises
        ModelError: limits are reached, nobody answers, or something else comes; what
        has been answered by then is yielded before.
        """
        left = [(place, TRIES, FIRST_WAIT) for place in range(len(bodies))]
        by_token = self._priced_by_token and self.limits["money"] < LIMITS["money"]
        # only an answer tells whether another is allowed
        waits = self.limits["tokens"] < LIMITS["tokens"] or by_token
        at_once = 1 if waits else int(self.limits["at_once"])
        while left:
            models.INTERRUPTS.look()
            wave = [left.pop(0) for _ in range(self._reserve(min(at_once, len(left))))]
            sent = self._together(
                [json.dumps(bodies[place]).encode() for place, _, _ in wave]
            )
            failed = list[str]()
            again = list[tuple[int, int, float]]()
            for (place, tries, wait), answer in zip(wave, sent, strict=True):
                if isinstance(answer, dict):
                    yield place, answer
                    continue
                if isinstance(answer, errors.ModelError):
                    failed.append(str(answer))
                    continue
                why, later, asked_to = self._failure(
                    answer, first=self.spent["calls"] <= len(wave)
                )
                if not later or tries == 1:
                    failed.append(f"model {self.name}: {why} ({self.url})")
                again.append((place, tries - 1, max(wait, asked_to)))
            if failed:
                raise errors.ModelError(failed[0])
            if again:
                time.sleep(min(max(wait for _, _, wait in again), LONGEST_WAIT))
                left = [(place, tries, 2 * wait) for place, tries, wait in again] + left

    def _reserve(self, most: int) -> int:
        """Count calls before they are made, as many as the limits allow, and return how
        many these are. Raises ModelError: none is allowed.
        """
        count = 0
        while count < most:
            reached = [
                name
                for name, number in self._so_far.items()
                if number >= self.limits[name]
            ]
            if reached and count:
                break
            if reached:
                name = reached[0]
                limit = self.limits[reached[0]]
                raise errors.ModelError(
                    f"model {self.name}: {self._so_far[name]:,.10g} {name} are spent, "
                    f"and `ask` allows {limit:,.10g}; "
                    f"`advsearch resume RUN ask.{name}={2 * limit or 1:.10g}` goes on "
                    "with more, and asks nothing twice"
                )
            self.spent["calls"] += 1
            count += 1
        self._keep_spent()
        return count

    def _together(self, bodies: Sequence[bytes]) -> list[dict[str, Any] | Exception]:
        """Send bodies at the same time, and return what is answered to each, or why
        nothing is.

        All is over `seconds` later, whatever a server does meanwhile: what is still
        under way is broken off.
        """
        seconds = self.limits["seconds"]
        end = time.monotonic() + seconds
        pool = ThreadPoolExecutor(len(bodies))
        connections: list[_Connection] = []
        try:
            futures = [
                pool.submit(self._try_to_send, body, end, connections)
                for body in bodies
            ]
            waited_for = futures_wait(
                futures, timeout=min(seconds, threading.TIMEOUT_MAX)
            )
        finally:
            pool.shutdown(wait=False)  # after Ctrl-C nobody waits for answers
            for connection in connections:
                connection.break_off()
        late = TimeoutError(f"timed out: no answer within {seconds:g} seconds")
        return [
            future.result() if future in waited_for.done else late for future in futures
        ]

    def _try_to_send(
        self, body: bytes, end: float, connections: list[_Connection]
    ) -> dict[str, Any] | Exception:
        try:
            return self._sent(body, end, connections)
        except urllib.error.HTTPError as error:
            with error, suppress(OSError, http.client.HTTPException):
                text = error.read(LONGEST_FAILURE)
                error = urllib.error.HTTPError(
                    error.url, error.code, error.reason, error.headers, io.BytesIO(text)
                )
            return error
        except (
            OSError,
            http.client.HTTPException,
            errors.ModelError,
        ) as error:  # URLError is an OSError
            return error

    def _failure(self, error: Exception, *, first: bool) -> tuple[str, bool, float]:
        """Return why nothing was answered, whether it may be later, and after how many
        seconds.
        """
        if not isinstance(error, urllib.error.HTTPError):
            reason = getattr(error, "reason", error)
            why = self._clean(
                f"{type(reason).__name__}: {reason}"
                if str(reason)
                else type(reason).__name__
            )
            nobody_yet = first and isinstance(reason, ConnectionRefusedError)
            return (
                why,
                not nobody_yet
                and not isinstance(reason, (ssl.SSLCertVerificationError, ValueError)),
                0.0,
            )
        code = error.code
        headers = error.headers
        with error:
            if 300 <= code < 400:
                there = self._clean(headers.get("Location", "elsewhere"))
                why = (
                    f"sends on to {there}, and pictures and keys are not sent there; "
                    "give that address if you trust it"
                )
            elif code in (401, 403):
                why = (
                    f"status {code}: the key in {models.KEY} "
                    f"{'is not accepted' if models.read_key() else 'is missing'}"
                )
            else:
                text = error.read(LONGEST_FAILURE).decode(errors="replace")
                why = (
                    f"status {code} {self._clean(str(error.reason))}: "
                    f"{self._clean(text)[:300]}"
                )
        asked_to = headers.get("Retry-After", "")
        return why, code in BUSY, float(asked_to) if asked_to.isdigit() else 0.0

    def _sent(
        self, body: bytes, end: float, connections: list[_Connection]
    ) -> dict[str, Any]:
        key = models.read_key()
        headers = {"Content-Type": "application/json", "User-Agent": "advsearch"}
        request = urllib.request.Request(self.url, body, headers)
        if key:
            request.add_unredirected_header("Authorization", f"Bearer {key}")
        handlers: list[Any] = [
            models.NoRedirect,
            _Handler(end, connections),
            _SecureHandler(end, connections),
        ]
        if models.is_local(request.host.rpartition(":")[0].strip("[]") or request.host):
            handlers.append(urllib.request.ProxyHandler({}))
        parts = list[bytes]()
        size = 0
        with urllib.request.build_opener(*handlers).open(
            request, timeout=self.limits["seconds"]
        ) as response:
            while part := response.read1(1 << 16):
                parts.append(part)
                size += len(part)
                if size > stored_files.scaled(LARGEST):
                    raise self._wrong(
                        f"an answer of at most {stored_files.scaled(LARGEST):,} bytes",
                        "a longer one",
                    )
        text = b"".join(parts)
        try:
            answer = stored_files.parse_json(text.decode(), finite=True)
        except ValueError as error:  # UnicodeDecodeError is one
            raise self._wrong(
                "JSON", f"{self._clean(text[:60].decode(errors='replace'))!r} ({error})"
            ) from None
        if not isinstance(answer, dict):
            raise self._wrong("a JSON object", type(answer).__name__)
        return answer

    def _clean(self, text: str) -> str:
        """What a server says, in one line and without the key, which it may send
        back.
        """
        text = text.replace(models.read_key(), "(key)") if models.read_key() else text
        return " ".join(
            "".join(sign if sign.isprintable() else " " for sign in text).split()
        )

    def _wrong(self, expected: str, got: str | Mapping[str, Any]) -> errors.ModelError:
        """Return the error for an answer that is something else, or an object with
        other keys.
        """
        if isinstance(got, Mapping):
            got = self._clean(", ".join(map(str, got)) or "nothing")[:100]
        return errors.ModelError(
            f"model {self.name}: expected {expected}, got {got} ({self.url})"
        )

    def _count_tokens(self, answer: Mapping[str, Any]) -> None:
        """Count the tokens that an answer says it took. Raises ModelError where a limit
        needs them and it says none.
        """
        usage = answer.get("usage")
        usage = usage if isinstance(usage, Mapping) else {}
        numbers = [usage.get(name) for name in ("prompt_tokens", "completion_tokens")]
        tokens = [
            n
            for n in numbers
            if isinstance(n, int) and not isinstance(n, bool) and n >= 0
        ]
        if len(tokens) == 2:
            self.spent.update(tokens_in=tokens[0], tokens_out=tokens[1])
            self._keep_spent()
        elif self.limits["tokens"] < LIMITS["tokens"] or self._priced_by_token:
            raise self._wrong(
                "`usage` with prompt_tokens and completion_tokens, as "
                "`ask` counts tokens",
                "none",
            )
