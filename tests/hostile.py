"""Values that nobody should give, for batteries over everything that takes a value."""

import decimal
import math
from pathlib import Path
from typing import Any


def _nested(wrap: Any, levels: int) -> Any:
    value: Any = 1
    for _ in range(levels):
        value = wrap(value)
    return value


HOSTILE: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, -0.0, 0.0, 5e-324, 1e308, -1e308, 10**400, -(10**400), 10**5000, 2**63, -1, 0, 1,
    2.5, True, False, None, 3 + 4j, decimal.Decimal("NaN"), object(), set(), b"ab", Path("x"), range(3),
    "", " ", "\t\n", "\0", "\x1b[31m", ",", ",,", "=", "a=", "=a", "nan", "inf", "-inf", "1e999", "1e308", "-0", "{",
    "[1", "a,a", "1,1", "0.1,0.1", "1_000", "0x10", "x" * 100_000, "9" * 5000,
    [], [[]], [None], [math.nan], [1, 1], [2, 1], [1, 2, 2], [10**400, 1], ["a", "a"], [1] * 10_000, (0, 0),
    {}, {"": {}}, {1: 2}, {None: None}, {"a": {}}, {"a": math.nan}, {"a": {"b": math.inf}}, {"a": 10**400},
    {"choices": []}, {"choices": None}, {"choices": [1, 1]}, {"choices": [0, 0.0]}, {"choices": ["a", "a"]},
    {"name": ""}, {"name": None}, {"name": "pgd", "momentum": math.nan}, {"name": "pgd", "": 1},
    "pgd={momentum: nan}", "pgd={momentum: .nan}", "pgd={", "={a: 1}", "a={a: {a: {a: 1}}}",
    _nested(lambda value: [value], 2000), _nested(lambda value: {"a": value}, 2000),
)  # fmt: skip
"""Not numbers, too large ones, empty ones, doubled ones, of other types, and nested deep."""


def shown(value: Any) -> str:
    """A value for the message of a failed assertion."""
    try:
        return repr(value)[:60]
    except (RecursionError, ValueError):
        return f"a {type(value).__name__} that is too long to show"


SHORT = tuple(value for value in HOSTILE if "too long to show" not in shown(value))
"""Those that a message can show; a configuration refuses the others before controls and policies see them."""
