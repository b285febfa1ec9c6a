"""Damage to any file: cuts, flipped bits, swapped lengths, hostile numbers in texts, other types in JSON."""

import copy
import json
import re
from typing import Any

from fuzz.case import Random

INTEGERS = (0, 1, 0x7F, 0xFF, 0x100, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF)
NUMBERS = (
    *b"nan inf -inf 1e308 -1e308 1e-320 1e9999 0 -0 -1 -2147483648 4294967295 0x10 1_0 1e".split(),
    *(b"", b"9" * 25, b"9" * 6000, b"\xc2\xb2", "\u0663".encode()),
)
VALUES: tuple[Any, ...] = (
    *json.loads("[null, true, false, 0, -1, 1, 3, 255, 5123, 2147483648, 4294967295, 9007199254740992, -0.5, 0.5]"),
    *(10**400, 1e308, 1e30, 1e-30, float("nan"), float("inf")),
    *("", "x", "x" * 5000, "\x1b]0;owned\x07\x1b[31m", "../../../../etc/passwd", "/dev/zero"),
    *json.loads('[[], [[]], {}, [1, 2], [null], ["x"], {"x": 1}, {"index": 0}]'),
)


def damaged(random: Random, data: bytes) -> tuple[str, bytes]:
    """Return what was done and the damaged content."""
    kinds = (_truncated, _flipped, _swapped, _lengths, _repeated, _spliced, _numbers)
    kind = random.choice(kinds)
    return kind.__name__.strip("_"), kind(random, data)


def _truncated(random: Random, data: bytes) -> bytes:
    return data[: random.randrange(len(data)) if len(data) > 1 else 0]


def _flipped(random: Random, data: bytes) -> bytes:
    content = bytearray(data)
    end = random.choice((min(len(content), 64), min(len(content), 1024), len(content)))
    for _ in range(random.choice((1, 2, 8, 64))):
        content[random.randrange(end)] ^= 1 << random.randrange(8)
    return bytes(content)


def _swapped(random: Random, data: bytes) -> bytes:
    """Exchange two words of 4 bytes."""
    content = bytearray(data)
    a, b = (4 * random.randrange(max(1, len(data) // 4)) for _ in range(2))
    content[a : a + 4], content[b : b + 4] = content[b : b + 4], content[a : a + 4]
    return bytes(content)


def _lengths(random: Random, data: bytes) -> bytes:
    """Write hostile integers over words near the start, where lengths are."""
    content = bytearray(data)
    for _ in range(random.choice((1, 1, 3))):
        at = random.randrange(min(len(content), random.choice((32, 256, 4096))))
        size, order = random.choice((1, 2, 4, 4)), random.choice(("little", "big"))
        value = random.choice(INTEGERS) & (256**size - 1)
        content[at : at + size] = value.to_bytes(size, order)
    return bytes(content)


def _repeated(random: Random, data: bytes) -> bytes:
    start = random.randrange(len(data))
    piece = data[start : start + random.choice((1, 16, 200, 5000))]
    return data[:start] + piece * random.choice((2, 10, 100)) + data[start:]


def _spliced(random: Random, data: bytes) -> bytes:
    noise = random.randbytes(random.choice((1, 10, 1000)))
    start = random.randrange(len(data))
    return data[:start] + noise + data[start + random.choice((0, len(noise))) :]


def _numbers(random: Random, data: bytes) -> bytes:
    """Put hostile numbers in the place of numbers in a text; binary data has a few of them by chance."""
    places = list(re.finditer(rb"-?\d+(\.\d+)?", data[:100_000]))
    for place in sorted(random.sample(places, min(len(places), random.choice((1, 1, 3)))), key=lambda p: -p.start()):
        data = data[: place.start()] + random.choice(NUMBERS) + data[place.end() :]
    return data


def confused(random: Random, value: Any) -> Any:
    """Return a copy of a JSON value in which one to three inner values are of another type, gone or doubled."""
    value = copy.deepcopy(value)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        places = list(_places(value))
        if not places:
            return value
        container, key = random.choice(places)
        kind = random.random()
        if kind < 0.75:
            container[key] = copy.deepcopy(random.choice(VALUES))
        elif kind < 0.9:
            del container[key]
        elif isinstance(container, list):
            container.append(copy.deepcopy(container[key]))
        else:
            container[key] = [container[key]]
    return value


def _places(value: Any) -> Any:
    """Yield every (container, key) inside a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def as_json(value: Any) -> bytes:
    """Return JSON, numbers of hundreds of digits, NaN and infinity included."""
    return json.dumps(value).encode()
