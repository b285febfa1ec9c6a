"""Label names and label sets: which classes count as right."""

from __future__ import annotations

import ast
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from advsearch.errors import FileFormatError, InputError, find_similar_names
from advsearch.trust.stored_files import parse_json, read_text

# the default text into which the name of a class is inserted
PROMPT = "a photo of a {}"
MAX_FILE_BYTES = 16 << 20  # maximum size of a label file in bytes
# Maximum number of characters of a label name; the names of ImageNet have up to 130.
MAX_NAME_CHARACTERS = 1000
# Maximum number of characters of all names in the metadata of a network.
MAX_METADATA_CHARACTERS = 1 << 20
MAX_SUGGESTIONS = 4  # labels that a message suggests for an unknown one
DATA = Path(__file__).parent / "data"
SETS = ("imagenet", "cifar10", "cifar100", "coco", "coco90", "coco91", "voc")
"""Data sets that many networks are trained on; the names of their classes are known.

`coco91` has the background first, and the numbering of its authors, in which 11 numbers
have no class. `coco90` is the same without background. `voc` has the background first.
"""

NOTHING_NAMES = frozenset(
    "background bg noobject noobj noclass nothing none null void n/a n.a. unlabeled "
    "unlabelled unused ??? ∅".split()
)
"""Names of classes that stand for no object, without blanks, hyphens and underscores.
"none of the above" is not among them.
"""


def is_nothing_name(name: str) -> bool:
    """Return whether the name of a class stands for no object.

    Such a name is that of the background, "no object", or an index without a class.
    """
    return re.sub(r"[\s_<>()\[\]-]+", "", name.casefold()) in NOTHING_NAMES


@dataclass(frozen=True)
class LabelSet:
    """The classes that count as right for an object, such as "coffee mug" and "cup".

    Attributes:
        names: the model's full label names, in the order in which the user named them.
        indices: distinct indices of these classes, in the same order.
    """

    names: tuple[str, ...]
    indices: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[int]:
        return iter(self.indices)

    def __contains__(self, index: object) -> bool:
        return index in self.indices


def find_label_set(
    text: str | int | Sequence[str | int], labels: Sequence[str], *, named: bool = True
) -> LabelSet:
    """Find the classes that a text names.

    Terms are separated by commas. A term matches a class in any case if it equals the
    class's label name or one of the comma-separated synonyms in it ("tench, Tinca
    tinca"). ``"#504"`` is always a class index; a bare ``"504"`` is one unless a label
    has that name.

    Args:
        text: the terms, e.g. ``"coffee mug,cup"``, or a sequence of terms and indices.
        labels: the model's label names in index order.
        named: whether the labels are names; else they are placeholders ("class 0").

    Raises:
        InputError: there is no term; a name is unknown (the message has similar names)
            or belongs to several classes (the message has their indices); or the model
            does not have an index.
    """
    texts: Sequence[str | int] = [text] if isinstance(text, (str, int)) else text
    # Each text may have several terms itself.
    joined_terms = ",".join(str(entry) for entry in texts)
    terms = [term.strip() for term in joined_terms.split(",") if term.strip()]
    if not terms:
        raise InputError(
            f"label: expected at least one label name or class index, got {text!r}"
        )
    table = _make_name_table(labels)
    found_indices = (_find_class(term, table, labels, named) for term in terms)
    indices = tuple(dict.fromkeys(found_indices))
    return LabelSet(tuple(labels[index] for index in indices), indices)


def find_similar_labels(word: str, labels: Sequence[str]) -> list[tuple[int, str]]:
    """Find the classes to suggest for an unknown word.

    There are two kinds of suggestions. Similar names are spelled like the word
    (`find_similar_names`), the most similar first. Synonyms ("cup" for "mug") come from
    a table of everyday things, and follow them. But if there are synonyms and no
    similar name contains the word, only the synonyms are suggested.

    Args:
        word: what the user wrote.
        labels: the model's label names in index order.

    Returns:
        Index and name of each class; the name is the part of the label that matched:
        "frying pan" of "frying pan, frypan, skillet".
    """
    # A label with commas is left out, because each name in it has its own entry.
    indices_of_name = {
        name: indices
        for name, indices in _make_name_table(labels).items()
        if "," not in name
    }
    synonyms = [name for name in _list_synonyms(word) if name in indices_of_name]
    similar = find_similar_names(word, indices_of_name)  # keys of the mapping
    key = _normalize_name(word)
    contains_word = any(key in name for name in similar)  # as a part of the name
    if synonyms and not contains_word:
        # A synonym is a better suggestion than a name that is only spelled alike.
        similar = []
    return _list_classes_of_names((*similar, *synonyms), indices_of_name)


def _list_classes_of_names(
    names: Sequence[str], indices_of_name: Mapping[str, Sequence[int]]
) -> list[tuple[int, str]]:
    """Return index and name of each class that has one of the names, in their order.

    A class with several of the names gets the first of them.

    Args:
        names: names of classes.
        indices_of_name: indices of the classes that have a name.
    """
    name_of_index: dict[int, str] = {}
    for name in names:
        for index in indices_of_name[name]:
            name_of_index.setdefault(index, name)
    return list(name_of_index.items())


def _list_synonyms(word: str) -> list[str]:
    """Return the names of the table of everyday things that mean the same as a word."""
    synonym_groups = json.loads((DATA / "synonyms.json").read_text("utf-8"))
    key = _normalize_name(word)
    synonyms = []
    for group in synonym_groups:
        names = [_normalize_name(name) for name in group]
        if key in names:
            synonyms += names
    return synonyms


def _find_class(
    term: str, table: dict[str, list[int]], labels: Sequence[str], named: bool
) -> int:
    """Return the index of the class that a term names.

    Args:
        term: a name, or an index such as "#504".
        table: indices of classes by name, from `_make_name_table`.
        labels: labels of the model.
        named: whether the labels are names; else they are placeholders ("class 0").

    Raises:
        InputError: there is no such class, or several.
    """
    indices = table.get(_normalize_name(term), [])
    index = _parse_index(term, is_name=bool(indices))
    if index is not None:
        _check_index(index, len(labels))
        return index
    if len(indices) == 1:
        return indices[0]
    if indices:
        raise _make_ambiguous_label_error(term, indices, labels)
    hint = _hint_of_labels(term, labels, named)
    raise InputError(f"the model has no label {term!r}. {hint}")


def _make_ambiguous_label_error(
    term: str, indices: Sequence[int], labels: Sequence[str]
) -> InputError:
    """Return the error of a term that names several classes, by their indices."""
    classes = ", ".join(f"#{index} ({labels[index]})" for index in indices)
    return InputError(
        f"label {term!r} names {len(indices)} classes: {classes}. Give "
        f"the index, e.g. '#{indices[0]}'"
    )


def _parse_index(term: str, *, is_name: bool) -> int | None:
    """Return the index that a term states; None if it states none.

    "#504" is always an index, "504" only if no label has that name (`is_name`).
    """
    index_match = re.fullmatch(r"#\s*(-?\d+)", term)
    if not index_match and not is_name:
        index_match = re.fullmatch(r"(-?\d+)", term)
    return int(index_match[1]) if index_match else None


def _check_index(index: int, n_classes: int) -> None:
    """Raise InputError if a model does not have the class with an index."""
    if not 0 <= index < n_classes:
        raise InputError(
            f"label: expected a class index from 0 to {n_classes - 1}, got {index}"
        )


def _hint_of_labels(term: str, labels: Sequence[str], named: bool) -> str:
    """Return a hint for an unknown label: names like it, or what labels there are.

    Args:
        term: term that is unknown.
        labels: labels of the model.
        named: whether the labels are names; else they are placeholders ("class 0").
    """
    if not named:
        sets = list_sets_of_size(len(labels))
        sets_of_names = "".join(f" or `labels={name}`" for name in sets)
        return (
            f"Its {len(labels)} classes have no names: give a label file "
            f"(`labels`){sets_of_names}, or an index such as '#0'"
        )
    similar = find_similar_labels(term, labels)[:MAX_SUGGESTIONS]
    if similar:
        names = " or ".join(f"{name!r} (#{index})" for index, name in similar)
        return f"Did you mean {names}?"
    suffix = ", ..." if len(labels) > 20 else ""
    return f"Its {len(labels)} labels: {', '.join(labels[:20])}{suffix}"


def _normalize_name(name: str) -> str:
    """Return a name in the form in which names are compared."""
    return " ".join(name.casefold().split())


def _make_name_table(labels: Sequence[str]) -> dict[str, list[int]]:
    """Return the indices of the classes that have a name, for each name.

    "tench, Tinca tinca" has three names: the full label and both parts of it.
    """
    table: dict[str, list[int]] = {}
    for index, label in enumerate(labels):
        names = [_normalize_name(part) for part in (label, *label.split(","))]
        for name in dict.fromkeys(names):  # each name once
            if name:
                table.setdefault(name, []).append(index)
    return table


# ---- label files ----


def read_labels(source: str | os.PathLike[str] | Sequence[str]) -> tuple[str, ...]:
    """Return label names in index order.

    Args:
        source: the names themselves, in a sequence or a text with commas between them;
            one of `SETS`; or a path to a JSON list of names, a JSON object from index
            to name (every index from 0 on, once), or a text file with one name per line
            (UTF-8). A text with commas that is the path of a file is read as a path.

    Raises:
        FileFormatError: the file is missing, empty or has another content; the message
            names it.
        InputError: `source` holds something other than non-empty names.
    """
    if isinstance(source, (str, os.PathLike)):
        if str(source) in SETS:
            return _load_label_sets()[str(source)]
        if not _is_name_list(source):
            return _read_file(Path(source))
        source = str(source).split(",")
    if not isinstance(source, Sequence):
        raise InputError(
            f"labels: expected a path or a list of names, got {type(source).__name__}"
        )
    return _check_names(source, InputError, "labels")


def parse_names(names: Any) -> tuple[str, ...] | None:
    """Return the names of classes that a network states, in index order.

    YOLO networks state them in `names` and in the metadata of their files. Files are
    not trusted, so that a text is parsed only if it is a flat mapping or list.

    Args:
        names: a mapping from 0, 1, ... to names, a list of names, or the text of one as
            Python writes it.

    Returns:
        The names; None if they have another form.
    """
    if isinstance(names, str):
        names = _parse_literal(names)
    if isinstance(names, Mapping):
        has_index_keys = list(names) == list(range(len(names)))
        names = list(names.values()) if has_index_keys else None
    if isinstance(names, (list, tuple)) and not _find_problem(names):
        return read_labels(names)
    return None


def _parse_literal(text: str) -> Any:
    """Return the flat mapping or list in a text as Python writes it; None for others."""
    if len(text) > MAX_METADATA_CHARACTERS or not _FLAT.fullmatch(text):
        return None
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError):
        return None


_TEXT = r"""(?:'(?:[^'\\\n]|\\.)*'|"(?:[^"\\\n]|\\.)*")"""
_FLAT = re.compile(
    rf"\{{(?:\d{{1,6}}: {_TEXT}(?:, |(?=\}})))*\}}|\[(?:{_TEXT}(?:, "
    r"|(?=\])))*\]"
)
"""Pattern of a flat mapping or list as Python writes it. `ast.literal_eval` is safe for
such a text: nothing in it is nested.
"""


def _is_name_list(source: str | os.PathLike[str]) -> bool:
    """Return whether a text has names with commas between them, and is no path.

    A text that ends with ".json" or ".txt" is a path even if there is no such file.
    """
    text = str(source)
    is_path = os.path.isfile(text) or text.endswith((".json", ".txt"))
    return isinstance(source, str) and "," in text and not is_path


class LabelsOrigin(NamedTuple):
    """Where labels came from."""

    text: str = "labels"  # text for messages
    is_file: bool = False


def find_labels_origin(labels: object) -> LabelsOrigin:
    """Return where labels come from: the model, a file, or the user.

    Args:
        labels: what the user wrote, see `read_labels`; None for the model's labels.
    """
    if labels is None:
        return LabelsOrigin("labels of the model")
    is_text = isinstance(labels, (str, os.PathLike))
    is_named_set = str(labels) in SETS
    if is_text and not is_named_set and not _is_name_list(labels):  # type: ignore[arg-type]
        return LabelsOrigin(f"label file {labels}", is_file=True)
    return LabelsOrigin()  # the user's names, or a named set


def read_prompts(prompts: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Return the prompts of a model from a list, or a text with | between them.

    Raises:
        InputError: a prompt is no text, or empty.
    """
    if prompts is None:
        return None
    if isinstance(prompts, str):
        texts = [part.strip() for part in prompts.split("|")]
    else:
        texts = list(prompts)
    for text in texts or [""]:
        if not isinstance(text, str) or not text:
            raise InputError(
                f"prompt: expected a text, such as {PROMPT!r}, got {text!r}"
            )
    return tuple(texts)


def get_patterns(prompts: tuple[str, ...] | None) -> tuple[str, ...]:
    """Return the prompts with ``{}`` for a name; the default prompt for None.

    Raises:
        InputError: a prompt has no ``{}``.
    """
    for text in prompts or ():
        if "{}" not in text:
            raise InputError(
                f"prompt: expected a text with {{}} where the name goes, "
                f"such as {PROMPT!r}, got {text!r}"
            )
    return prompts or (PROMPT,)


def list_sets_of_size(classes: int) -> list[str]:
    """Return the names of `SETS` with that many classes."""
    return [name for name, names in _load_label_sets().items() if len(names) == classes]


def _load_label_sets() -> dict[str, tuple[str, ...]]:
    """Load the names of classes of all `SETS`."""
    stored = json.loads((DATA / "labels.json").read_text("utf-8"))
    # `coco91` without its first name, which stands for the background
    stored["coco90"] = stored["coco91"][1:]
    return {name: tuple(stored[name]) for name in SETS}


def fit_labels(
    classes: int, labels: tuple[str, ...] | None, origin: LabelsOrigin, model: str
) -> tuple[str, ...]:
    """Return the labels if there is one for each class, or placeholders for None.

    Args:
        classes: number of classes of the model.
        labels: names in index order; None for placeholders ("class 0").
        origin: where the labels come from, for the message.
        model: name of the model, for the message.

    Raises:
        InputError: there are more or fewer labels than classes.
        FileFormatError: likewise, if the labels are from a file.
    """
    if labels is None:
        return tuple(f"class {index}" for index in range(classes))
    if len(labels) == classes:
        return labels
    fitting_sets = "".join(
        f" (`labels={name}` has {classes})" for name in list_sets_of_size(classes)
    )
    message = (
        f"{origin.text}: {len(labels)} labels, but model {model} has {classes} "
        f"classes; give one per class, in index order{fitting_sets}"
    )
    raise FileFormatError(message) if origin.is_file else InputError(message)


def _order_by_index(name_by_index: dict[str, Any], where: str) -> list[Any]:
    """Return the values of a JSON object whose keys are the indices 0, 1, ...

    Args:
        name_by_index: the object; its keys may be in any order.
        where: what is read, for the beginning of the message.

    Raises:
        FileFormatError: the keys are not these indices.
    """
    indices = list(map(str, range(len(name_by_index))))
    last_index = len(name_by_index) - 1
    if set(name_by_index) != set(indices):
        raise FileFormatError(
            f"{where}: expected the {len(name_by_index)} keys to be the "
            f"indices 0 to {last_index}, each once"
        )
    return [name_by_index[index] for index in indices]


def _read_file(path: Path) -> tuple[str, ...]:
    """Read label names from a JSON file, or from a text file with a name per line.

    Raises:
        FileFormatError: it cannot be read, or holds something else than names.
    """
    where = f"label file {path}"
    text = _read_label_text(path, where)
    if not text.strip():
        raise FileFormatError(f"{where}: expected label names, got an empty file")
    is_json = path.suffix.lower() == ".json" or text.lstrip()[0] in "[{"
    if is_json:
        names = _parse_json_names(text, where)
    else:  # a name on each line, even on an empty one within the text
        names = [line.strip() for line in text.strip("\r\n").splitlines()]
    return _check_names(names, FileFormatError, where)


def _read_label_text(path: Path, where: str) -> str:
    """Return the text of a label file; raise FileFormatError if it cannot be read."""
    try:
        return read_text(path, "a label file", MAX_FILE_BYTES)
    except OSError as error:
        # A text without a suffix may have been meant as a single name.
        advice = ""
        if not path.suffix:
            advice = ", and several names have commas between them, such as 'mug,cup'"
        raise FileFormatError(
            f"{where}: cannot be read ({error.strerror or error}){advice}"
        ) from None


def _parse_json_names(text: str, where: str) -> list[Any]:
    """Return the names in a JSON list, or in a JSON object from index to name.

    Args:
        text: content of a label file.
        where: what is read, for the beginning of the message.

    Raises:
        FileFormatError: it is anything else.
    """
    names = _parse_json_text(text, where)
    if isinstance(names, dict):
        return _order_by_index(names, where)
    if not isinstance(names, list):
        raise FileFormatError(
            f"{where}: expected a list of names or an object from index to name"
        )
    return names


def _parse_json_text(text: str, where: str) -> Any:
    """Return the JSON value in a label file; raise FileFormatError if it is invalid."""
    try:
        return parse_json(text)
    except json.JSONDecodeError as error:
        raise FileFormatError(
            f"{where}: not valid JSON (line {error.lineno}: {error.msg})"
        ) from None
    except ValueError as error:
        raise FileFormatError(f"{where}: expected label names, got {error}") from None


def _check_names(
    names: Sequence[Any], kind: type[InputError], where: str
) -> tuple[str, ...]:
    """Return label names without surrounding spaces.

    Args:
        names: names in index order.
        kind: class of the error that is raised if one is invalid.
        where: where they come from, for the message.
    """
    if problem := _find_problem(names):
        raise kind(f"{where}: {problem}")
    return tuple(name.strip() for name in names)


def _find_problem(names: Sequence[Any]) -> str:
    """Return what is wrong with label names as a clause; "" if nothing is."""
    if not names:
        return "expected label names, got an empty list"
    problems = (_find_name_problem(name, index) for index, name in enumerate(names))
    return next(filter(None, problems), "")


def _find_name_problem(name: Any, index: int) -> str:
    """Return what is wrong with the name of a class as a clause; "" if nothing is."""
    if not isinstance(name, str) or not name.strip():
        return (
            f"expected a name (non-empty text) for class {index}, got {repr(name)[:60]}"
        )
    if len(name) > MAX_NAME_CHARACTERS:
        return (
            f"expected a name of at most {MAX_NAME_CHARACTERS} characters for "
            f"class {index}, got {len(name):,}"
        )
    return ""
