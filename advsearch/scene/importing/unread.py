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

        entries = TrackedKeys({"Fl-X": 500.0, "k7": 0.1}, fold=normalize_key)
        entries.get("flx", "fx")           # 500.0: the value of the first key that has one
        entries.find_unread()              # ["k7"], as the file spells it
        join_names(entries.find_unread())  # "'k7'": bounded in length, for a message

    `fold` converts a key to the form by which it is looked up, such as ``str.lower``:
    the folded key. If several keys have the same folded key, the last one is stored,
    and the earlier ones are in `repeated`.
    """

    def __init__(
        self,
        values: Mapping[str, T],
        *,
        fold: Callable[[str], str] = str,
        prefix: str = "",
    ) -> None:
        """Store the values by folded key, and collect repeated keys.

        Args:
            values: values by key, as the file spells the keys.
            fold: function that returns the folded key of a key.
            prefix: text before keys in the list of unread ones, such as "camera.".
        """
        # Keys, as the file spells them, that have the same folded key as a later one.
        self.repeated: list[str] = []
        self._fold = fold
        self._prefix = prefix
        # These four are by folded keys.
        self._values: dict[str, T] = {}
        self._spelling: dict[str, str] = {}  # keys as the file spells them
        self._read: set[str] = set()
        self._nested: dict[str, TrackedKeys[Any]] = {}
        for key, value in values.items():
            self._add_value(key, value)

    def _add_value(self, key: str, value: T) -> None:
        """Store the value of a key, which replaces that of an equal folded key."""
        folded = self._fold(key)
        if folded in self._spelling:
            earlier_key = self._spelling[folded]
            self.repeated.append(earlier_key)
        self._values[folded] = value
        self._spelling[folded] = key

    def get(self, *keys: str) -> T | None:
        """Return the value of the first of several folded keys that has one, or None.

        That key is marked as read, and so are those of `keys` that have no value. Other
        keys stay unread, since their values are ignored.
        """
        keys_with_value = [key for key in keys if self._values.get(key) is not None]
        ignored_keys = keys_with_value[1:]
        self._read.update(key for key in keys if key not in ignored_keys)
        return self._values[keys_with_value[0]] if keys_with_value else None

    def peek(self, key: str) -> T | None:
        """Return the value of a folded key without marking the key as read."""
        return self._values.get(key)

    def mark_read(self, *keys: str) -> None:
        """Mark folded keys as read."""
        self._read.update(keys)

    def get_nested(self, key: str) -> TrackedKeys[Any]:
        """Return the keys within the value of a folded key; they are tracked separately.

        If the value is missing or no mapping, there are no keys within it. A value that
        is no mapping stays unread.
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

        A key within the value of another one is listed as "camera.k7".

        Args:
            is_quiet: function of a folded key and its value that returns whether the
                key is left out of the list, because it changes nothing. It is not
                applied to keys within values.
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
        """Return a folded key as the file spells it, or itself if it is absent."""
        return self._spelling.get(key, key)

    def items(self) -> Iterator[tuple[str, T]]:
        """Yield folded keys and values, without marking any as read."""
        yield from self._values.items()

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def __len__(self) -> int:
        return len(self._values)


def join_names(names: Iterable[str], max_named: int = MAX_NAMED) -> str:
    """Format names in a file for a message: quoted, cut, and at most `max_named`.

    The number of the remaining names is added.
    """
    unique_names = list(dict.fromkeys(names))
    text = ", ".join(format_name(name) for name in unique_names[:max_named])
    n_more = len(unique_names) - max_named
    return f"{text} and {n_more:,} more" if n_more > 0 else text
