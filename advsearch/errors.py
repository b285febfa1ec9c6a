"""The exceptions that a user can cause.

Every message states what was expected, what was received and what to do. It names a
setting as in Python: ``epsilon: ...`` at its beginning, and in backticks elsewhere, as
in "use `denoise=none`" or "`grid` pose.yaw". The command line replaces these names by
flags (`cli.flags.format_as_flags`), prints the message in one line on standard error,
and exits with status 2. Any exception that is no `AdvsearchError` is a bug, and gets a
traceback.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence

FELL_SHORT = 3
"""Exit status of a command whose check or test did not pass."""

# Minimum ratio of `difflib` for a similar name, and for a similar word of a name.
MIN_SIMILARITY = 0.6
MIN_WORD_SIMILARITY = 0.75


class AdvsearchError(Exception):
    """Base class of errors that are caused by input or by the machine, and that are no
    bug of advsearch.
    """


class InputError(AdvsearchError):
    """Raised if a value on the command line, in a file or in a call is not allowed."""


class UnknownNameError(InputError):
    """Raised if a name is unknown, such as that of an object.

    The message lists similar names and all known names.

    Attributes:
        near: the similar names, best first.
    """

    def __init__(
        self, kind: str, name: str, known: Iterable[str], hint: str = ""
    ) -> None:
        """Make the error for an unknown name.

        The message lists all known names; before them it suggests up to three that are
        similar.

        Args:
            kind: kind of the named object, such as "policy".
            name: the unknown name.
            known: the known names.
            hint: last sentence of the message; "" for none.
        """
        names = sorted(known)
        near = find_similar_names(name, names)[:3]
        guess = ""
        if near:
            guess = f" Did you mean {' or '.join(map(repr, near))}?"
        all_names = ", ".join(names) or "none"
        ending = f" {hint}" if hint else ""
        super().__init__(f"unknown {kind} {name!r}.{guess} Known: {all_names}.{ending}")
        self.near = tuple(near)


class FileFormatError(InputError):
    """Raised if a file is missing, empty, truncated or of a wrong format.

    The message contains the path.
    """


class ModelError(AdvsearchError):
    """Raised if a model cannot be loaded, or has outputs of a wrong type or shape."""


class CodeNotAllowedError(InputError, ModelError):
    """Raised if a file names Python code, weights or an address that the user has not
    allowed.
    """


class RunExistsError(InputError):
    """Raised if the run directory exists already and `overwrite` is not set."""


class StorageError(AdvsearchError):
    """Raised if the run directory cannot be written: the disk is full, the file system
    is read-only, or permission is missing.
    """


class EnvironmentSetupError(AdvsearchError):
    """Raised if software is missing or unusable, such as LLVM.

    The message contains the command that installs it.
    """


class ClusterError(AdvsearchError):
    """Raised if workers cannot be reached, or cannot compute the batches of a task."""


def find_similar_names(name: str, known: Iterable[str]) -> list[str]:
    """Return the known names that are similar to `name`, best first.

    Upper and lower case do not matter, and neither does a plural s. Names with all
    words of `name` come first ("coffee mug" for "mug"), then names with words that
    begin with its words, then names that contain it. Among equals, a name with fewer
    additional words is better, then one with the same last word. If no name is similar
    in this way, names with a similar spelling are returned, such as "mug" for "mgu".
    """
    query_words = _split_words(name)
    names = list(dict.fromkeys(known))  # without duplicates
    ranks = {}
    for known_name in names:
        rank = _rank(query_words, _split_words(known_name))
        if rank is not None:  # the words are similar
            ranks[known_name] = rank
    if ranks:
        return sorted(ranks, key=ranks.__getitem__)
    return _find_similar_spellings(name, names)


def _find_similar_spellings(name: str, known_names: Sequence[str]) -> list[str]:
    """Return the known names that are spelled like a name, the most similar first."""
    matcher = difflib.SequenceMatcher(None, "", name.casefold())
    similarity_by_name = {
        known_name: _compute_similarity(matcher, known_name)
        for known_name in known_names
    }
    similar = [name for name, value in similarity_by_name.items() if value > 0.0]
    return sorted(similar, key=similarity_by_name.__getitem__, reverse=True)


def _split_words(name: str) -> list[str]:
    """Return the words of a name in lower case; longer words without a plural s."""
    words = re.split(r"[\W_]+", name.casefold())
    return [_remove_plural_ending(word) for word in words if word]


def _remove_plural_ending(word: str) -> str:
    """Return a word without the "s" or "es" of a plural; of at most 3 letters, as it is."""
    if len(word) <= 3:
        return word
    if word.endswith(("sses", "shes", "ches")):
        return word[:-2]
    if word.endswith("s") and not word.endswith("ss"):
        return word[:-1]
    return word


def _rank(query: Sequence[str], words: Sequence[str]) -> tuple[int, int, bool] | None:
    """Return how well a name fits a query, as a key for sorting; None for not at all.

    Args:
        query: words of the query.
        words: words of the name.

    Returns:
        Three numbers, of which smaller ones are better. The first is 0 if the name has
        all words of the query, 1 if each of them begins a word of the name, and 2 if
        the name contains the query. The second is the number of additional words. The
        third is whether the last words differ.
    """
    if not query or not words:
        return None
    n_more_words = len(words) - len(query)
    has_other_end = words[-1] != query[-1]
    if set(query) <= set(words):
        return 0, n_more_words, has_other_end
    if all(_begins_any_word(query_word, words) for query_word in query):
        return 1, n_more_words, has_other_end
    if "".join(query) in "".join(words):
        return 2, n_more_words, has_other_end
    return None


def _begins_any_word(start: str, words: Sequence[str]) -> bool:
    """Return whether any word begins with a text."""
    return any(word.startswith(start) for word in words)


def _compute_similarity(matcher: difflib.SequenceMatcher[str], name: str) -> float:
    """Return how similar a name, or one of its words, is spelled to a query.

    Args:
        matcher: matcher whose second sequence is the query.
        name: name to compare.

    Returns:
        The best ratio of the matcher, in [0, 1]; 0 if it is below the threshold.
    """
    candidates = [(name.casefold(), MIN_SIMILARITY)]
    candidates += [(word, MIN_WORD_SIMILARITY) for word in _split_words(name)]
    best_ratio = 0.0
    for text, threshold in candidates:
        matcher.set_seq1(text)
        if _reaches_ratio(matcher, threshold):
            best_ratio = max(best_ratio, matcher.ratio())
    return best_ratio


def _reaches_ratio(matcher: difflib.SequenceMatcher[str], threshold: float) -> bool:
    """Return whether two sequences have at least a ratio of similarity."""
    # The first two are upper bounds of the ratio, and take less time.
    return (
        matcher.real_quick_ratio() >= threshold
        and matcher.quick_ratio() >= threshold
        and matcher.ratio() >= threshold
    )
