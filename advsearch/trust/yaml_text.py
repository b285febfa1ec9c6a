"""Read YAML of settings: text, numbers, booleans, lists and mappings, of limited size.

PyYAML's safe loader reads it, without features that settings do not need: numbers to
base 60 (0:360:24 is text), dates (2026-11-22 is text), tags, and short texts that stand
for huge structures (nested aliases).
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from advsearch.trust.stored_files import DEPTH, DIGITS, scale_limit

MAX_YAML_BYTES = 1 << 17  # maximum size of a YAML file
# maximum number of values of a YAML text; values that an alias repeats count again
MAX_VALUES = 100_000
_PLAIN = frozenset(
    f"tag:yaml.org,2002:{kind}"
    for kind in "str int float bool null seq map merge".split()
)
_UNFINISHED = 0  # value for a node that is being counted; a count is at least 1


class _Loader(yaml.SafeLoader):  # type: ignore[misc, unused-ignore]
    """The safe loader with our forms of numbers, and with checks of the document."""

    def get_single_data(self) -> Any:
        """Check the document, and return its value; None if it is empty."""
        node = self.get_single_node()
        if node is None:
            return None
        _count_checked(node, 0, {})
        return self.construct_document(node)

    def construct_yaml_int(self, node: yaml.Node) -> int:
        """Return an integer; raise a YAMLError if it has too many digits."""
        # The length is checked first because converting a long text takes long. In
        # binary, a number has up to 3.3 times as many digits as in decimal, and there
        # may be a sign, a prefix and underscores: 4 times is enough for usual ones.
        if len(node.value) <= 4 * DIGITS:
            number = int(super().construct_yaml_int(node))
            if abs(number) < 10**DIGITS:
                return number
        raise _make_yaml_error(node, f"a number of more than {DIGITS} digits")


_Loader.yaml_implicit_resolvers = {
    first: [
        (tag, form)
        for tag, form in forms
        if tag.rpartition(":")[2] not in ("int", "float", "timestamp")
    ]
    for first, forms in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:int",
    re.compile(
        r"^(?:[-+]?0b_*[01][01_]*|[-+]?0[0-7_]*|[-+]?[1-9][0-9_]*|[-+]?0x_*[0-9a-fA-F][0-9a-fA-F_]*)$"
    ),
    list("-+0123456789"),
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^(?:[-+]?[0-9][0-9_]*\.[0-9_]*(?:[eE][-+][0-9]+)?|\.[0-9][0-9_]*(?:[eE][-+][0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
    ),
    list("-+0123456789."),
)


_YAML_ERRORS = (
    yaml.YAMLError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    OverflowError,
)
"""Errors that PyYAML raises. Its constructors raise all of them for values that do not
fit their tags.
"""


def parse_yaml(text: str) -> Any:
    """Return the value of a YAML text.

    Raises:
        ValueError: the text is not YAML, is too large or nested too deeply, or has
            values that no setting has, such as Python objects. The message is short.
    """
    if len(text) > scale_limit(MAX_YAML_BYTES):
        raise ValueError(f"a text of {len(text):,} characters")
    try:
        return yaml.load(text, _Loader)
    except RecursionError:
        raise ValueError(f"lists or mappings nested deeper than {DEPTH}") from None
    except yaml.MarkedYAMLError as error:
        raise ValueError(_describe_yaml_error(error)) from None
    except _YAML_ERRORS as error:
        raise ValueError(_shorten(str(error))) from None


def _describe_yaml_error(error: Any) -> str:
    """Return what is wrong with a text, and where, from an error of PyYAML."""
    # Our own errors (`_make_yaml_error`) have a note. Other errors come from PyYAML.
    got = error.note or f"other text ({error.problem or error.context})"
    mark = error.problem_mark or error.context_mark
    if mark is not None:
        got = f"{got} in line {mark.line + 1}, column {mark.column + 1}"
    return _shorten(got)


def _shorten(text: str) -> str:
    """Return a text on one line, cut to 200 characters."""
    words = " ".join(text.split())
    return words if len(words) <= 200 else f"{words[:197]}..."


def _count_checked(node: yaml.Node, depth: int, counts: dict[int, int]) -> int:
    """Check a node of a YAML document, and count the values in it.

    A node that has aliases is counted again for each alias. So a short text cannot
    stand for a huge value: nested aliases ("billion laughs") are refused.

    Args:
        node: node of the document.
        depth: number of nodes that contain it.
        counts: counts so far, by id of the node, to which this function adds;
            `_UNFINISHED` while a node is being counted.

    Returns:
        The number of values, 1 for a scalar.

    Raises:
        yaml.YAMLError: the node has a tag that no setting has, is nested too deeply,
            repeats a name, or has too many values.
    """
    if node.tag not in _PLAIN:
        raise _make_yaml_error(node, f"the tag {node.tag[:40]!r}, which no setting has")
    if isinstance(node, yaml.ScalarNode):
        return 1
    # A node that is still being counted contains an alias of itself: its nesting is
    # infinite.
    contains_itself = counts.get(id(node)) == _UNFINISHED
    if depth >= DEPTH or contains_itself:
        raise _make_yaml_error(node, f"lists or mappings nested deeper than {DEPTH}")
    if isinstance(node, yaml.MappingNode):
        _check_names(node)
    if id(node) not in counts:
        counts[id(node)] = _UNFINISHED
        total = 1
        for child in _list_children(node):
            total += _count_checked(child, depth + 1, counts)
            if total > MAX_VALUES:
                raise _make_yaml_error(node, f"more than {MAX_VALUES:,} values")
        counts[id(node)] = total
    return counts[id(node)]  # an alias counts as much as its node


def _list_children(node: yaml.Node) -> list[yaml.Node]:
    """Return the items of a list, or the names and values of a mapping."""
    if isinstance(node, yaml.SequenceNode):
        items: list[yaml.Node] = node.value
        return items
    return [child for pair in node.value for child in pair]


def _check_names(node: yaml.MappingNode) -> None:
    """Check that a mapping has no name twice.

    Raises:
        yaml.YAMLError: it has a name twice.
    """
    names = set[str]()
    for name, _ in node.value:
        if isinstance(name, yaml.ScalarNode) and name.value in names:
            raise _make_yaml_error(name, f"the name {name.value[:60]!r} twice")
        names.add(str(name.value))


def _make_yaml_error(node: yaml.Node, what: str) -> yaml.YAMLError:
    """Return the error for a node that is not allowed; the message is `what`."""
    return yaml.constructor.ConstructorError(
        None, None, what, node.start_mark, note=what
    )
