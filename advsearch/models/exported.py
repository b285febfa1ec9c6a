"""`torch.export` archives (.pt2), rewritten before torch reads them.

torch's reader evaluates the expressions of sizes and the guards as Python, writes names of the graph into code that it
runs, looks operators up by any dotted name, imports modules for containers, and unpickles. So it never sees the file:
from its description of the network (`models/model.json`) and its weights a new archive is made in memory. What cannot
be checked is left out (example inputs, guards, notes on where an operator came from), and all else has to have the form
that `torch.export.save` gives it.
"""

from __future__ import annotations

import io
import json
import keyword
import math
import pickletools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.files import JsonObject, JsonValue
from advsearch.models import expressions
from advsearch.models.archive import LARGEST_TEXT, Archive, open_archive, refused

PROGRAM = "models/model.json"

OLD_NAMES = {
    PROGRAM: "serialized_exported_program.json",
    "data/weights/model.pt": "serialized_state_dict.pt",
    "data/constants/model.pt": "serialized_constants.pt",
}
"""What the members were called up to torch 2.7."""

EXAMPLE = ("data/sample_inputs/model.pt", "serialized_example_inputs.pt")

NAMESPACES = "aten|prims|quantized|_quantized|quantized_decomposed|mkldnn|onednn|torchvision|torchao"
HARMFUL = frozenset(["save", "load", "from_file", "warn", "_print", "set_data", "record_stream", "manual_seed"])
"""Operators of these namespaces that touch files, the terminal or the process."""

HIGHER_ORDER = "cond|map_impl|scan|associative_scan|flex_attention|wrap_with_set_grad_enabled|wrap_with_autocast"

_OPERATOR = re.compile(rf"torch\.ops\.(?:{NAMESPACES})\.(\w+)\.\w+|torch\.ops\.higher_order\.(?:{HIGHER_ORDER})")
_ARITHMETIC = re.compile(
    r"_operator\.(eq|ne|le|ge|lt|gt|neg|pos|mul|add|sub|floordiv|mod|pow|truediv|and_|or_|lshift|rshift|getitem)"
    r"|math\.(trunc|floor|ceil)|torch\.sym_(not|int|float|ite|max|min|sqrt|sum)"
)
_PLAIN = re.compile(r"[\w.:/ <>@=+-]{0,1000}")
_RECORD = re.compile(r"\w[\w.-]{0,200}")
_GLOBALS = re.compile(
    r"torch\._utils _rebuild_(tensor_v2|parameter)|collections OrderedDict|torch [A-Z][A-Za-z0-9]*Storage"
    r"|torch\.storage UntypedStorage|torch Size|torch device|torch\.serialization _get_layout"
    r"|torch (u?int|b?float|complex|bool)[0-9]*\w*"
)
"""What the pickle of a tensor names; nothing of it runs anything."""

_CONTAINERS = frozenset([None, "builtins.tuple", "builtins.list", "builtins.dict", "collections.OrderedDict"])
_FORGOTTEN = {"metadata": dict, "guards_code": list}
_IDENTIFIERS = frozenset(
    "name as_name user_input_name forward_arg_names tensor_values sym_int_values sym_float_values "
    "sym_bool_values".split()
)


def rewritten(archive: Archive) -> io.BytesIO:
    """Return an archive for `torch.export.load` that holds what is harmless of this one: the network and its weights.

    Raises:
        FileFormatError: it has something in it that a plain network has not; the message says what.
    """
    from torch.export.pt2_archive import PT2ArchiveWriter  # a second of compilers, which no other model needs

    names = {new: old if old in archive else new for new, old in OLD_NAMES.items()}
    program = _checked_program(archive, names[PROGRAM])
    for name in EXAMPLE:
        if name in archive:
            _check_pickle(archive, name)
    buffer = io.BytesIO()
    with PT2ArchiveWriter(buffer) as writer:  # type: ignore[no-untyped-call, arg-type, unused-ignore]
        writer.write_bytes(PROGRAM, json.dumps(program).encode())
        writer.write_bytes(EXAMPLE[0], b"")
        for folder, kind in (("data/weights/", "weights"), ("data/constants/", "constants")):
            old = names[f"{folder}model.pt"]
            if old in archive:
                _check_pickle(archive, old)
                writer.write_bytes(f"{folder}model.pt", archive.read(old))
            else:
                _copy_tensors(archive, writer, folder, f"{folder}model_{kind}_config.json")
    buffer.seek(0)
    return buffer


def _copy_tensors(archive: Archive, writer: Any, folder: str, config: str) -> None:
    """Copy the tensors that a table of contents names, and the table."""
    content = archive.read_json(config)
    table = content.get("config") if isinstance(content, dict) else None
    if not isinstance(table, dict) or not all(isinstance(entry, dict) for entry in table.values()):
        raise refused(archive.path, f"expected a table of tensors in {config!r}, got something else")
    table = _checked_object(archive.path, table, "tensor_name")
    copied: set[str] = set()
    for name, entry in table.items():
        record = entry.get("path_name") if isinstance(entry, dict) else None
        if (
            not isinstance(entry, dict)
            or entry.get("use_pickle")
            or not (isinstance(record, str) and _RECORD.fullmatch(record))
        ):
            raise refused(archive.path, f"{name[:80]!r} is a pickled object or compiled code, which is never loaded")
        _check_tensor(archive, f"{folder}{record}", entry.get("tensor_meta"))
        if record not in copied:
            writer.write_bytes(f"{folder}{record}", archive.read(f"{folder}{record}"))
            copied.add(record)
    writer.write_bytes(config, json.dumps({"config": table}).encode())


def _check_tensor(archive: Archive, record: str, meta: Any) -> None:
    """torch makes a tensor without data of whatever size it is told."""
    sizes: Any = meta.get("sizes") if isinstance(meta, dict) else None
    listed = sizes if isinstance(sizes, list) else [None]
    numbers: list[Any] = [size.get("as_int") if isinstance(size, dict) else None for size in listed]
    if not all(isinstance(number, int) and number >= 0 for number in numbers):
        raise refused(archive.path, f"expected the sizes of a tensor for {record[:80]!r}, got something else")
    if record in archive and archive.members[record].file_size == 0 and math.prod(numbers) > 0:
        raise refused(archive.path, f"{record[:80]!r} is empty, but should hold a tensor of {numbers[:8]}")


# ---- the description of the network ----------------------------------------------------------------------------------


def _checked_program(archive: Archive, name: str) -> JsonObject:
    """Return the description of the network as torch may see it."""
    program = archive.read_json(name)
    if not isinstance(program, dict) or not isinstance(program.get("graph_module"), dict):
        raise refused(archive.path, f"cannot be read as torch.export (expected a network in {name!r}, got other JSON)")
    return _checked_object(archive.path, program, "")


def _checked(path: Path, value: JsonValue, key: str) -> JsonValue:
    """Return a value of the description, which stands under `key`, without what is left out."""
    if isinstance(value, dict):
        return _checked_object(path, value, key)
    if isinstance(value, list):
        return [_checked(path, inner, key) for inner in value]
    wrong = _problem(value, key)
    if wrong:
        raise refused(path, wrong)
    return value


def _checked_object(path: Path, value: JsonObject, key: str) -> JsonObject:
    return {name: _checked_item(path, name, inner, key) for name, inner in value.items()}


def _checked_item(path: Path, name: str, inner: JsonValue, key: str) -> JsonValue:
    if name in _FORGOTTEN:
        return {} if _FORGOTTEN[name] is dict else []
    wrong = "" if name == "" else _problem(name, key)
    if name in ("as_custom_obj", "custom_obj") or (name == "custom_obj_values" and inner):
        wrong = "holds a custom object, which is never loaded"
    if wrong:
        raise refused(path, wrong)
    return _checked(path, inner, name)


def _problem(value: Any, key: str) -> str:
    """Return what is wrong with a number or text under `key`, or nothing."""
    if isinstance(value, str):
        return _TEXTS.get(key, _identifier_problem if key in _IDENTIFIERS else _plain_problem)(value)
    if key == "expr_str":
        return "an expression that is no text"
    if isinstance(value, int) and abs(value) >= expressions.NUMBER:
        return "has a number of more than 64 bits"
    return ""


def _plain_problem(text: str) -> str:
    return "" if _PLAIN.fullmatch(text) else f"has an unusual name, {text[:60]!r}"


def _identifier_problem(text: str) -> str:
    proper = text == "" or (text.isascii() and text.isidentifier() and not keyword.iskeyword(text) and len(text) < 1000)
    return "" if proper else f"expected a name of a value, got {text[:60]!r}"


def _range_problem(text: str) -> str:
    """A symbol or an expression whose range is stated."""
    return "" if expressions.is_symbol(text) else expressions.problem(text)


def _argument_problem(text: str) -> str:
    """Text that an operator is called with, such as 'same' or 'bilinear'."""
    return "" if len(text) <= 1000 and text.isprintable() else "has text that is too long or not printable"


def _operator_problem(text: str) -> str:
    found = _OPERATOR.fullmatch(text)
    if _ARITHMETIC.fullmatch(text) or (found and found[1] not in HARMFUL):
        return ""
    return f"names the operator {text[:80]!r}, which is none of a plain network, and is never run"


def _tree_problem(text: str) -> str:
    """What a container of inputs or outputs looks like: torch imports the types that it names."""
    try:
        version, tree = files.parse_json(text)
        level: list[Any] = [tree]
        while level:
            if not all(node["type"] in _CONTAINERS and _plain_context(node["context"]) for node in level):
                return "has inputs or outputs in a container that is no tuple, list or dict"
            level = [child for node in level for child in node["children_spec"]]
    except (ValueError, TypeError, KeyError, RecursionError):
        return f"expected the structure of inputs or outputs, got {text[:60]!r}"
    return "" if version == 1 else "has inputs or outputs of another version"


def _plain_context(context: Any) -> bool:
    """Whether the context is nothing, or the names of a dict, which become names of arguments."""
    if context in (None, "null"):
        return True
    keys = files.parse_json(context) if isinstance(context, str) else None
    return isinstance(keys, list) and all(isinstance(key, (str, int)) and not _plain_problem(str(key)) for key in keys)


_TEXTS: dict[str, Callable[[str], str]] = {
    "expr_str": expressions.problem,
    "target": _operator_problem,
    "as_operator": _operator_problem,
    "in_spec": _tree_problem,
    "out_spec": _tree_problem,
    "as_string": _argument_problem,
    "as_strings": _argument_problem,
    "range_constraints": _range_problem,
}


# ---- pickles of tensors ----------------------------------------------------------------------------------------------


def _check_pickle(archive: Archive, name: str) -> None:
    """Check that a member is what `torch.save` makes of tensors in tuples and dicts; nothing is unpickled here."""
    data = archive.read(name)
    if not data:
        return
    inner = open_archive(archive.path, io.BytesIO(data), len(data)) if data[:2] == b"PK" else None
    if inner is None or "data.pkl" not in inner:
        raise _needs_unpickling(archive, name)
    try:
        steps = list(pickletools.genops(inner.read("data.pkl", LARGEST_TEXT)))
    except (ValueError, IndexError, UnicodeDecodeError):
        raise _needs_unpickling(archive, name) from None
    for step, argument, _ in steps:
        foreign = step.name == "GLOBAL" and not _GLOBALS.fullmatch(str(argument))
        if foreign or step.name in ("STACK_GLOBAL", "INST", "OBJ", "EXT1", "EXT2", "EXT4"):
            raise _needs_unpickling(archive, name)


def _needs_unpickling(archive: Archive, name: str) -> FileFormatError:
    return refused(
        archive.path, f"cannot be read as torch.export ({name!r} is in need of unpickling, which is never done)"
    )
