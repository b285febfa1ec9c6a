"""What a file has and nobody took: a reader lists what the file has, takes what it uses, and the rest is named."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from advsearch.scene.importing.files import shown


class Inventory:
    """What a file has, and what of it was taken.

        inventory = Inventory()
        inventory.has("property", "confidence")
        inventory.take("property", "x")
        list(inventory.left())   # ["property 'confidence' is left out"]

    A thing is a kind (a word of the format: ``"property"``, ``"keyword"``) and its name in the file.
    """

    def __init__(self) -> None:
        self._has: Counter[tuple[str, str]] = Counter()
        self._taken: set[tuple[str, str]] = set()

    def has(self, kind: str, name: str) -> None:
        """Note that the file has this, once more."""
        self._has[kind, name] += 1

    def take(self, kind: str, name: str) -> None:
        """Note that this is used; that the file need not have it makes readers short."""
        self._taken.add((kind, name))

    def left(self) -> Iterator[str]:
        """Yield a clause for everything that the file has and nobody took, in the order of the file."""
        for (kind, name), count in self._has.items():
            if (kind, name) not in self._taken:
                times = "" if count == 1 else f" ({count:,} times)"
                yield f"{kind} {shown(name)}{times} is left out"
