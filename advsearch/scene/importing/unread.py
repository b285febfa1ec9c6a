"""Values of a file by key, with a record of which keys are read.

Every reader of a format with keys uses this, so that nothing in a file is silently
ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Generic, TypeVar

from advsearch.scene.importing.files import format_name

MAX_NAMED = 12  # keys that one message names

T = TypeVar("T")


class TrackedKeys(Generic[T]):
    """Read values by key, and list the keys that were not read.

        entries = TrackedKeys({"Fl-X": 500.0, "k7": 0.1}, fold=plain)
        entries.get("flx", "fx")        # 500.0: the value of the first of these keys that has one
        entries.unread()                # ["k7"], as the file spells it
        join_names(entries.unread())    # "'k7'": bounded in length, for a message

    `fold` turns a key into the form by which it is looked up, such as ``str.lower``. Of
    keys with the same form the last counts; the earlier ones are in `repeated`.
    """

    def __init__(
        self,
        values: Mapping[str, T],
        *,
        fold: Callable[[str], str] = str,
        prefix: str = "",
    ) -> None:
        """Fold all keys, and find those that a later one of the same form hides.

        Args:
            values: values by key, as the file spells the keys.
            fold: turns a key into the form by which it is looked up.
            prefix: is put before keys in the list of unread ones, such as "camera.".
        """
        # Keys, as spelled, that a later one of the same form hides.
        self.repeated: list[str] = []
        self._fold = fold
        self._prefix = prefix
        # All others are by folded keys.
        self._values: dict[str, T] = {}
        self._spelling: dict[str, str] = {}  # keys as the file spells them
        self._read: set[str] = set()
        self._nested: dict[str, TrackedKeys[Any]] = {}
        for key, value in values.items():
            folded = fold(key)
            if folded in self._spelling:
                earlier_key = self._spelling[folded]
                self.repeated.append(earlier_key)
            self._values[folded] = value
            self._spelling[folded] = key

    def get(self, *keys: str) -> T | None:
        """Return the value of the first of some keys, in folded form, that has one.

        The result is None if none has. The key whose value is returned counts as read.
        So do those of the keys without a value; further keys with a value stay unread.
        """
        keys_with_value = [key for key in keys if self._values.get(key) is not None]
        self._read.update(key for key in keys if key not in keys_with_value[1:])
        return self._values[keys_with_value[0]] if keys_with_value else None

    def peek(self, key: str) -> T | None:
        """Return a value without counting its key as read."""
        return self._values.get(key)

    def mark_read(self, *keys: str) -> None:
        """Count keys, in folded form, as read."""
        self._read.update(keys)

    def get_nested(self, key: str) -> TrackedKeys[Any]:
        """Return the keys within the value of a key; they are tracked separately.

        Without such a value there are no keys. A value that is no mapping stays unread.
        """
        if key not in self._nested:
            value = self._values.get(key)
            inner: dict[str, Any] = {}
            if isinstance(value, Mapping):
                self._read.add(key)
                inner = {str(name): item for name, item in value.items()}
            spelled = self._spelling.get(key, key)
            self._nested[key] = TrackedKeys(
                inner, fold=self._fold, prefix=f"{self._prefix}{spelled}."
            )
        return self._nested[key]

    def find_unread(
        self, is_quiet: Callable[[str, T], bool] | None = None
    ) -> list[str]:
        """Return the keys that were not read, as the file spells them.

        A nested key has the keys that it is in before it, with dots: "camera.k7".

        Args:
            is_quiet: returns whether a key, in folded form, with its value needs no
                note, because it changes nothing. Nested keys are not passed to it.
        """
        names = []
        for key, spelled in self._spelling.items():
            needs_no_note = is_quiet is not None and is_quiet(key, self._values[key])
            if key not in self._read and not needs_no_note:
                names.append(self._prefix + spelled)
            if key in self._nested:
                names += self._nested[key].find_unread()
        return names

    def get_spelling(self, key: str) -> str:
        """Return a key, in folded form, as the file spells it; itself if it is
        absent.
        """
        return self._spelling.get(key, key)

    def items(self) -> Iterator[tuple[str, T]]:
        """Yield folded keys and values, and count none as read."""
        yield from self._values.items()

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def __len__(self) -> int:
        return len(self._values)


def join_names(names: Iterable[str], max_named: int = MAX_NAMED) -> str:
    """Format names out of a file for a message: quoted, cut, and the rest counted."""
    unique_names = list(dict.fromkeys(names))
    text = ", ".join(format_name(name) for name in unique_names[:max_named])
    n_more = len(unique_names) - max_named
    return f"{text} and {n_more:,} more" if n_more > 0 else text
