"""Rewrite `torch.export` archives (.pt2) before torch reads them.

torch's reader evaluates expressions and guards as Python, writes names of the graph
into code that it runs, imports modules for containers, and unpickles. So it does not
read the original file, but a new archive in memory, which has the description of the
network and its weights. Entries that cannot be checked are left out. All others must
have the form in which `torch.export.save` writes them: for example, expressions of
sizes may only have arithmetic with whole numbers, symbols and the functions listed
here.

Used by `models/files.py`.
"""

from __future__ import annotations

import ast
import io
import json
import keyword
import math
import pickletools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from advsearch.errors import FileFormatError
from advsearch.files import JsonObject, JsonValue
from advsearch.trust.archives import (
    LARGEST_TEXT,
    Archive,
    make_archive_error,
    open_archive,
)
from advsearch.trust.stored_files import parse_json

LENGTH = 20_000  # maximum number of characters of an expression
DEPTH = 60  # maximum nesting of an expression
# Maximum product of the exponents of nested powers. Real sizes have no power s0**65,
# and 9**9**9 would take forever to compute.
EXPONENT = 64
MAX_TEXT_CHARACTERS = 1000  # of names and arguments
NUMBER = 1 << 63  # the absolute values of integers have to be smaller

# functions of expressions, apart from powers
FUNCTIONS = frozenset(
    "Integer Rational Float Add Mul Max Min Mod Abs Eq Ne Lt Le Gt Ge Equality "
    "Unequality StrictLessThan LessThan StrictGreaterThan GreaterThan And Or Not "
    "Piecewise ExprCondPair FloorDiv ModularIndexing Where PythonMod CleanDiv "
    "CeilToInt FloorToInt CeilDiv FloatTrueDiv IntTrueDiv "
    "IsNonOverlappingAndDenseIndicator TruncToFloat TruncToInt "
    "RoundToInt RoundDecimal ToFloat Identity floor ceiling".split()
)
MAX_ARGUMENTS = 16  # maximum number of arguments of a function
POWERS = frozenset(["Pow", "PowByNatural", "FloatPow", "LShift", "RShift"])
NAMES = frozenset(["true", "false", "oo", "int_oo"])

_SYMBOL = re.compile(r"[A-Za-z_]{1,40}[0-9]{0,5}")
_DECIMAL = re.compile(r"-?[0-9]{1,40}(\.[0-9]{0,40})?(e[-+]?[0-9]{1,3})?")
_OPERATORS = (
    ast.Add,
    ast.Sub,
    ast.Mult,
    ast.Div,
    ast.FloorDiv,
    ast.Mod,
    ast.BitAnd,
    ast.BitOr,
)
_SIGNS = (ast.UAdd, ast.USub, ast.Not, ast.Invert)
_COMPARISONS = (ast.Eq, ast.NotEq, ast.Lt, ast.LtE, ast.Gt, ast.GtE)


def is_symbol(text: str) -> bool:
    """Return whether a text may name a symbol: letters, then at most five digits.

    Torch counts up to the number, so that it has to be small.
    """
    return _SYMBOL.fullmatch(text) is not None


def find_expression_problem(text: object) -> str:
    """Return what is wrong with an expression over sizes of tensors; "" for nothing.

    A file of torch.export holds such expressions, for instance "2*s0 + 1", and torch
    evaluates them as Python code. So only arithmetic with numbers and the symbols of
    torch is allowed.
    """
    if not isinstance(text, str) or len(text) > LENGTH:
        return f"expected a text of at most {LENGTH} characters"
    try:
        tree = ast.parse(text.strip(), mode="eval")
        _check(tree.body, DEPTH, EXPONENT)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        return (
            "expected arithmetic with whole numbers and symbols, got "
            f"{text[:60]!r} ({_get_refusal_reason(error)})"
        )
    return ""


def _get_refusal_reason(error: Exception) -> str:
    """Return why an expression is refused, from the error of reading or checking it."""
    # `_check` raises a plain ValueError, whose message is for the user. Its subclasses,
    # such as UnicodeError, and the other errors come from Python's parser.
    if type(error) is ValueError:
        return str(error.args[0])
    return "it cannot be read"


def _check(node: ast.expr, depth: int, max_power: int) -> None:
    """Check that a node of an expression is arithmetic that takes little time.

    The allowed nodes are numbers, symbols, functions, powers with small exponents,
    operators, comparisons and tuples. Each case below checks the node itself, and
    lists its operands, which are checked in the same way.

    Args:
        node: node to check, with all nodes below it.
        depth: number of levels that may still be nested.
        max_power: maximum product of the exponents in this node and below. Exponents of
            nested powers multiply, so that (9**9)**9 is bounded, too.

    Raises:
        ValueError: it is not; the message says what was found instead.
    """
    if depth <= 0:
        raise ValueError("it is nested too deeply")
    operands: list[ast.expr] = []
    match node:
        case ast.Constant(value=number):
            _check_number(number)
        case ast.Name(id=name):
            # Torch numbers its symbols: s0, u12.
            is_numbered_symbol = is_symbol(name) and name[-1].isdecimal()
            if name not in NAMES and not is_numbered_symbol:
                raise ValueError(f"the name {name[:40]!r}")
        # A call of `Pow` has an exponent, which lowers the maximum for its base.
        case ast.Call():
            operands, max_power = _check_call(node, max_power)
        # `_divide_max_power` checks the exponent of a power: only the base is left.
        case ast.BinOp(left=base, op=ast.Pow(), right=exponent):
            operands = [base]
            max_power = _divide_max_power(exponent, max_power)
        case ast.BinOp(left=left, op=operator, right=right) if isinstance(
            operator, _OPERATORS
        ):
            operands = [left, right]
        case ast.UnaryOp(op=operator, operand=operand) if isinstance(operator, _SIGNS):
            operands = [operand]
        case ast.Compare(left=left, ops=ops, comparators=others) if all(
            isinstance(op, _COMPARISONS) for op in ops
        ):
            operands = [left, *others]
        # A Piecewise is a call with tuples (value, condition).
        case ast.BoolOp(values=parts) | ast.Tuple(elts=parts):
            operands = parts
        case _:
            raise ValueError(f"{type(node).__name__} is no arithmetic")
    for operand in operands:
        _check(operand, depth - 1, max_power)


def _check_call(call: ast.Call, max_power: int) -> tuple[list[ast.expr], int]:
    """Check that an expression may call a function.

    Args:
        call: node of the call.
        max_power: maximum product of the exponents in the call.

    Returns:
        The arguments that are still to be checked, and the maximum product of the
        exponents in them.

    Raises:
        ValueError: it may not; the message is a clause about what was got instead.
    """
    match call:
        case ast.Call(func=ast.Name(id="Symbol")):
            _check_symbol(call)
            return [], max_power
        case ast.Call(func=ast.Name(id="Float")):
            _check_decimal(call)
            return [], max_power
        # Only the two calls above may have keywords: Symbol("s0", integer=True).
        case ast.Call(keywords=[_, *_]):
            raise ValueError("a call with keywords")
        case ast.Call(func=ast.Name(id=name), args=[base, exponent]) if name in POWERS:
            return [base], _divide_max_power(exponent, max_power)
        case ast.Call(func=ast.Name(id=name), args=arguments) if (
            name in FUNCTIONS and len(arguments) <= MAX_ARGUMENTS
        ):
            return arguments, max_power
    raise ValueError(f"a call of {ast.unparse(call.func)[:40]!r}")


def _check_number(value: object) -> None:
    """Raise ValueError unless a constant is a number of at most 64 bits."""
    if not isinstance(value, (int, float)):
        raise ValueError("text")
    if isinstance(value, int) and abs(value) >= NUMBER:
        raise ValueError("a number that is too large")


def _check_symbol(call: ast.Call) -> None:
    """Raise ValueError unless a call is like Symbol('s0', integer=True)."""
    text = _get_only_argument(call)
    assumptions = [_get_constant(keyword.value) for keyword in call.keywords]
    # None is the name of **keywords
    has_names = all(keyword.arg is not None for keyword in call.keywords)
    are_plain = has_names and all(isinstance(value, bool) for value in assumptions)
    if not isinstance(text, str) or not is_symbol(text) or not are_plain:
        raise ValueError("a symbol of another form")


def _check_decimal(call: ast.Call) -> None:
    """Raise ValueError unless a call is like Float('0.5', precision=53).

    Sympy computes with as many bits as the precision states (53 for float64), so that a
    huge one would fill the memory. 200 is more than torch writes.
    """
    text = _get_only_argument(call)
    if not isinstance(text, str) or not _DECIMAL.fullmatch(text):
        raise ValueError("a number of another form")
    names = {keyword.arg for keyword in call.keywords}
    precisions = [_get_constant(keyword.value) for keyword in call.keywords]
    if not names <= {"precision", "prec", "dps"} or not all(
        isinstance(value, int) and 0 < value <= 200 for value in precisions
    ):
        raise ValueError("a number of another precision")


def _get_only_argument(call: ast.Call) -> object:
    """Return the constant that is the only positional argument of a call.

    None if the argument is no constant, or if it is not the only one.
    """
    return _get_constant(call.args[0]) if len(call.args) == 1 else None


def _get_constant(node: ast.expr) -> object:
    """Return the value of a constant; None for any other node."""
    return node.value if isinstance(node, ast.Constant) else None


def _divide_max_power(exponent: ast.expr, max_power: int) -> int:
    """Return the maximum product of exponents in the base of a power.

    The exponent may be an integer, also with a sign or as ``Integer(3)``. It may also
    be 1/2 or -1/2: a root makes no number large, and does not change the maximum.

    Args:
        exponent: node of the exponent.
        max_power: maximum product of this exponent and the exponents in the base.

    Returns:
        `max_power` divided by the exponent, rounded down.

    Raises:
        ValueError: the exponent is anything else, or larger than `max_power`.
    """
    exponent = _without_sign(exponent)
    match exponent:
        case ast.Call(func=ast.Name(id="Integer"), args=[number]):
            exponent = _without_sign(number)
    is_call = isinstance(exponent, ast.Call)
    if is_call and ast.unparse(exponent) in ("Rational(1, 2)", "Rational(-1, 2)"):
        return max_power  # a root
    value = _get_constant(exponent)
    if not isinstance(value, int) or isinstance(value, bool) or value > max_power:
        raise ValueError("an exponent that is not a small number")
    # An exponent of 0 is allowed, but must not divide.
    return max_power // max(value, 1)


def _without_sign(node: ast.expr) -> ast.expr:
    """Return the operand of a minus sign; any other node as it is."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return node.operand
    return node


PROGRAM = "models/model.json"

OLD_NAMES = {
    PROGRAM: "serialized_exported_program.json",
    "data/weights/model.pt": "serialized_state_dict.pt",
    "data/constants/model.pt": "serialized_constants.pt",
}
"""Names of members in archives of torch up to 2.7, by their present names."""

EXAMPLE = ("data/sample_inputs/model.pt", "serialized_example_inputs.pt")

NAMESPACES = (
    "aten|prims|quantized|_quantized|quantized_decomposed|mkldnn|onednn|torchvision|"
    "torchao"
)
HARMFUL = frozenset(
    [
        "save",
        "load",
        "from_file",
        "warn",
        "_print",
        "set_data",
        "record_stream",
        "manual_seed",
    ]
)
"""Names of operators of these namespaces that access files, the terminal or the state
of the process. They are not allowed.
"""

HIGHER_ORDER = (
    "cond|map_impl|scan|associative_scan|flex_attention|wrap_with_set_grad_enabled|"
    "wrap_with_autocast"
)

# Group 1 is the name of an operator, as in "torch.ops.aten.NAME.default".
_OPERATOR = re.compile(
    rf"torch\.ops\.(?:{NAMESPACES})\.(\w+)\.\w+|torch\.ops\.higher_order\.(?:{HIGHER_ORDER})"
)
_ARITHMETIC = re.compile(
    r"_operator\.(eq|ne|le|ge|lt|gt|neg|pos|mul|add|sub|floordiv|mod|pow|truediv|and_|or_|lshift|rshift|getitem)"
    r"|math\.(trunc|floor|ceil)|torch\.sym_(not|int|float|ite|max|min|sqrt|sum)"
)
_PLAIN = re.compile(r"[\w.:/ <>@=+-]{0,1000}")
_RECORD = re.compile(r"\w[\w.-]{0,200}")
_GLOBALS = re.compile(
    r"torch\._utils _rebuild_(tensor_v2|parameter)|collections OrderedDict|torch "
    r"[A-Z][A-Za-z0-9]*Storage"
    r"|torch\.storage UntypedStorage|torch Size|torch device|torch\.serialization "
    r"_get_layout"
    r"|torch (u?int|b?float|complex|bool)[0-9]*\w*"
)
"""Pattern of the classes and functions in the pickle of a tensor, which run no code."""
_OTHER_IMPORTS = ("STACK_GLOBAL", "INST", "OBJ", "EXT1", "EXT2", "EXT4")
"""Other steps of a pickle that import a class. torch.save writes none of them."""

_CONTAINERS = frozenset(
    [
        None,
        "builtins.tuple",
        "builtins.list",
        "builtins.dict",
        "collections.OrderedDict",
    ]
)
# Entries that the network does not need, and their replacements.
_EMPTIED_ENTRIES: JsonObject = {"metadata": {}, "guards_code": []}


def rewrite_program(archive: Archive) -> io.BytesIO:
    """Copy the network and the weights of an archive into a new, safe archive.

    `torch.export.load` reads the new archive. Members that could run code, such as
    compiled code and pickled objects, are left out or rejected. A pickle of nothing but
    tensors is kept (`_check_pickle`).

    Raises:
        FileFormatError: the archive has something that a plain network does not have;
            the message names it.
    """
    # This import takes a second, and only this kind of model needs it.
    from torch.export.pt2_archive import PT2ArchiveWriter

    # The names of members in this archive, by their present names: archives up to torch
    # 2.7 have others.
    names = {new: old if old in archive else new for new, old in OLD_NAMES.items()}
    program = _read_program(archive, names[PROGRAM])
    for name in EXAMPLE:  # the names that example inputs may have
        if name in archive:
            _check_pickle(archive, name)
    buffer = io.BytesIO()
    with PT2ArchiveWriter(buffer) as writer:  # type: ignore[no-untyped-call, arg-type, unused-ignore]
        writer.write_bytes(PROGRAM, json.dumps(program).encode())
        # torch requires this member (example inputs), but does not need its content
        writer.write_bytes(EXAMPLE[0], b"")
        for kind in ("weights", "constants"):
            _copy_all_tensors(archive, writer, kind, names)
    buffer.seek(0)
    return buffer


def _copy_all_tensors(
    archive: Archive, writer: Any, kind: str, names: Mapping[str, str]
) -> None:
    """Copy all tensors of a kind from an archive to a new one.

    An archive has either one pickle of all tensors, or a table with a file for each
    tensor.

    Args:
        archive: archive to read.
        writer: writer of the new archive.
        kind: "weights" or "constants".
        names: the names of members in the archive, by their present names.
    """
    folder = f"data/{kind}/"
    pickle_name = names[f"{folder}model.pt"]
    if pickle_name in archive:
        _check_pickle(archive, pickle_name)
        writer.write_bytes(f"{folder}model.pt", archive.read_member(pickle_name))
    else:
        config = f"{folder}model_{kind}_config.json"
        _copy_tensors(archive, writer, folder, config)


def _read_program(archive: Archive, name: str) -> Any:
    """Read the description of the network from a member of the archive, and check it.

    Entries that are not needed to run the network are emptied.

    Raises:
        FileFormatError: the member describes no network, or has something that a plain
            network does not have.
    """
    program = archive.read_json(name)
    if not isinstance(program, dict) or not isinstance(
        program.get("graph_module"), dict
    ):
        expected = f"expected a network in {name!r}, got other JSON"
        raise make_archive_error(
            archive.path, f"cannot be read as torch.export ({expected})"
        )
    return _check_value(archive.path, program, "")


def _copy_tensors(archive: Archive, writer: Any, folder: str, config: str) -> None:
    """Copy the tensors that a table names from an archive to a new one.

    Only files with plain numbers are copied, and no pickles. An empty file is rejected
    for a tensor that should have numbers.

    Args:
        archive: archive to read.
        writer: writer of the new archive.
        folder: folder of the tensors in both archives, such as "data/weights/".
        config: name of the member with the table.

    Raises:
        FileFormatError: the table or one of its entries has another form.
    """
    table = _read_tensor_table(archive, config)
    copied: set[str] = set()  # multiple tensors may share a file of numbers
    for name, entry in table.items():
        # If this member is missing, `read_member` raises an error below.
        member = f"{folder}{_get_record(archive, name, entry)}"
        _check_not_empty(archive, member, entry)
        if member not in copied:
            writer.write_bytes(member, archive.read_member(member))
            copied.add(member)
    writer.write_bytes(config, json.dumps({"config": table}).encode())


def _read_tensor_table(archive: Archive, config: str) -> Any:
    """Return the entry of each tensor by its name, from the member `config`.

    Raises:
        FileFormatError: the table has another form, or a name is not plain.
    """
    content = archive.read_json(config)
    table = content.get("config") if isinstance(content, dict) else None
    if not isinstance(table, dict) or not all(
        isinstance(entry, dict) for entry in table.values()
    ):
        raise make_archive_error(
            archive.path,
            f"expected a table of tensors in {config!r}, got something else",
        )
    # Names of tensors are the keys of the table: they have to be plain names.
    return _check_value(archive.path, table, "tensor_name")


def _check_not_empty(archive: Archive, member: str, entry: Any) -> None:
    """Check that the file of a tensor has numbers if the tensor has.

    For an empty file torch would allocate a tensor of any size that the table states,
    which could exhaust the memory.

    Args:
        archive: archive to read.
        member: name of the file.
        entry: entry of the tensor in the table.

    Raises:
        FileFormatError: the file is empty, or the entry has another form.
    """
    shape = _read_shape(archive, member, entry)
    if (
        member in archive
        and archive.members[member].file_size == 0
        and math.prod(shape) > 0
    ):
        raise make_archive_error(
            archive.path,
            f"{member[:80]!r} is empty, but should hold a tensor of {shape[:8]}",
        )


def _get_record(archive: Archive, name: str, entry: Any) -> str:
    """Return the name of the file that holds the numbers of a tensor.

    Args:
        archive: archive, for errors.
        name: name of the tensor.
        entry: entry of the tensor in the table, which names the file.

    Raises:
        FileFormatError: the file is a pickle, or is not directly in the folder of the
            tensors.
    """
    record = entry.get("path_name") if isinstance(entry, dict) else None
    if isinstance(record, str) and _RECORD.fullmatch(record):
        if not entry.get("use_pickle"):
            return record
    raise make_archive_error(
        archive.path,
        f"{name[:80]!r} is a pickled object or compiled code, which is never loaded",
    )


def _read_shape(archive: Archive, member: str, entry: JsonObject) -> list[int]:
    """Return the shape of a tensor from its entry in the table.

    Raises:
        FileFormatError: the sizes are not integers of at least 0.
    """
    meta = entry.get("tensor_meta")
    sizes: Any = meta.get("sizes") if isinstance(meta, dict) else None
    if not isinstance(sizes, list):
        sizes = [None]  # rejected below
    shape: list[Any] = [
        size.get("as_int") if isinstance(size, dict) else None for size in sizes
    ]
    if not all(isinstance(size, int) and size >= 0 for size in shape):
        raise make_archive_error(
            archive.path,
            f"expected the sizes of a tensor for {member[:80]!r}, got something else",
        )
    return shape


# ---- the description of the network
# --------------------------------------------------------------------------------


def _check_value(path: Path, value: JsonValue, key: str) -> Any:
    """Check a value of the network's description, with all values inside of it.

    A text is checked by the rules for the entry that holds it. A key of a mapping may
    be the name of a tensor, and is checked in the same way as a text would be: in
    {"tensor_values": {"x": ...}}, "x" is checked by the rules for "tensor_values".

    Args:
        path: path of the archive, for errors.
        value: any JSON value.
        key: name of the entry that holds the value; for an element of a list, the name
            of the entry that holds the list.

    Returns:
        The value, in which entries that the network does not need (`_EMPTIED_ENTRIES`)
        are replaced by harmless ones.

    Raises:
        FileFormatError: a text, number or name cannot be part of a plain network.
    """
    if isinstance(value, list):
        return [_check_value(path, inner, key) for inner in value]
    if not isinstance(value, dict):
        problem = _find_problem(value, key)
        if problem:
            raise make_archive_error(path, problem)
        return value
    return {name: _check_entry(path, name, inner, key) for name, inner in value.items()}


def _check_entry(path: Path, name: str, value: JsonValue, key: str) -> Any:
    """Check an entry of a mapping, and return its value as `_check_value` does.

    Args:
        path: path of the archive, for errors.
        name: name of the entry.
        value: value of the entry.
        key: name of the entry that holds the mapping.

    Raises:
        FileFormatError: the entry cannot be part of a plain network.
    """
    if name in _EMPTIED_ENTRIES:
        # The value is not used, so that it needs no check.
        return _EMPTIED_ENTRIES[name]
    problem = _find_entry_problem(name, value, key)
    if problem:
        raise make_archive_error(path, problem)
    return _check_value(path, value, name)


def _find_entry_problem(name: str, value: JsonValue, key: str) -> str:
    """Return what is wrong with an entry of a mapping; "" for nothing.

    Args:
        name: name of the entry.
        value: its value, of which only custom objects are checked.
        key: name of the entry that holds the mapping.
    """
    problem = _find_problem(name, key) if name else ""  # the empty key is allowed
    is_custom_object = name in ("as_custom_obj", "custom_obj")
    # torch always writes this table, which is empty for a plain network.
    has_custom_objects = name == "custom_obj_values" and bool(value)
    if is_custom_object or has_custom_objects:
        return "holds a custom object, which is never loaded"
    return problem


def _find_problem(value: Any, key: str) -> str:
    """Return what is wrong with a text or a number; "" for nothing.

    The result is the end of a message that begins with the file.

    Args:
        value: the value.
        key: name of the entry that has the value. It decides how a text is checked
            (`_TEXT_CHECKS`): for example, "expr_str" has an expression.
    """
    if isinstance(value, str):
        find_problem = _TEXT_CHECKS.get(key, _find_plain_problem)
        return find_problem(value)
    if key == "expr_str":
        return "has an expression that is no text"
    if isinstance(value, int) and abs(value) >= NUMBER:
        return "has a number of more than 64 bits"
    return ""


def _find_plain_problem(text: str) -> str:
    """Return what is wrong with a text that is only a name; "" for nothing."""
    return "" if _PLAIN.fullmatch(text) else f"has an unusual name, {text[:60]!r}"


def _find_identifier_problem(text: str) -> str:
    """Return what is wrong with a name that torch writes into code; "" for nothing.

    It has to be a short identifier of Python, or empty.
    """
    is_proper = text == "" or (
        text.isascii()
        and text.isidentifier()
        and not keyword.iskeyword(text)
        and len(text) < MAX_TEXT_CHARACTERS
    )
    return "" if is_proper else f"expected a name of a value, got {text[:60]!r}"


def _find_argument_problem(text: str) -> str:
    """Return what is wrong with a text that is the argument of an operator.

    Such a text is "same" or "bilinear". The result is "" if nothing is wrong.
    """
    if len(text) <= MAX_TEXT_CHARACTERS and text.isprintable():
        return ""
    return "has text that is too long or not printable"


def _find_operator_problem(text: str) -> str:
    """Return what is wrong with the name of an operator; "" for nothing."""
    if _ARITHMETIC.fullmatch(text):
        return ""
    match = _OPERATOR.fullmatch(text)
    if match and match[1] not in HARMFUL:
        return ""
    return (
        f"has the operator {text[:80]!r}, which plain networks do not have and which "
        "is never run"
    )


def _find_tree_problem(text: str) -> str:
    """Return what is wrong with the structure of inputs or outputs; "" for nothing.

    Torch imports the types of containers that the structure names. So only tuples,
    lists and dicts are allowed. The type of a leaf, a single input or output, is None.

    Args:
        text: JSON of [version, node]; a node has a type, a context (the keys of a dict,
            as JSON) and its children.
    """
    try:
        version, tree = parse_json(text)
        nodes: list[Any] = [tree]
        while nodes:
            node = nodes.pop()
            has_plain_keys = _has_plain_keys(node["context"])
            if node["type"] not in _CONTAINERS or not has_plain_keys:
                return "has inputs or outputs in a container that is no tuple, list or dict"
            nodes += node["children_spec"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return f"expected the structure of inputs or outputs, got {text[:60]!r}"
    return "" if version == 1 else "has inputs or outputs of another version"


def _has_plain_keys(context: Any) -> bool:
    """Return whether a container of inputs or outputs has harmless keys, or none.

    Args:
        context: keys of a dict as a JSON list, such as '["image", "size"]'. They have
            to be plain names or numbers. A tuple or a list has None or "null".

    Raises:
        ValueError: the context is a text that is not JSON.
    """
    if context in (None, "null"):
        return True
    if not isinstance(context, str):
        return False
    keys = parse_json(context)
    return isinstance(keys, list) and all(
        isinstance(key, (str, int)) and not _find_plain_problem(str(key))
        for key in keys
    )


_TEXT_CHECKS: dict[str, Callable[[str], str]] = {
    **dict.fromkeys(
        ("name", "as_name", "user_input_name", "forward_arg_names"),
        _find_identifier_problem,
    ),
    **dict.fromkeys(
        ("tensor_values", "sym_int_values", "sym_float_values", "sym_bool_values"),
        _find_identifier_problem,
    ),
    "expr_str": find_expression_problem,
    "target": _find_operator_problem,
    "as_operator": _find_operator_problem,
    "in_spec": _find_tree_problem,
    "out_spec": _find_tree_problem,
    "as_string": _find_argument_problem,
    "as_strings": _find_argument_problem,
    "range_constraints": lambda text: (
        "" if is_symbol(text) else find_expression_problem(text)
    ),
}


# ---- pickles of tensors
# --------------------------------------------------------------------------------


def _check_pickle(archive: Archive, name: str) -> None:
    """Check that a member is a file of `torch.save` that holds only tensors.

    They may be in tuples and dicts. An empty member, which `rewrite_program` writes for
    example inputs, is accepted, too. Nothing is unpickled here, since that may run
    code: the steps of the pickle are read one by one, and a step that imports anything
    but the classes of tensors is rejected.

    Args:
        archive: archive of the network.
        name: name of the member.

    Raises:
        FileFormatError: the member is another file, or imports something else.
    """
    data = archive.read_member(name)
    if not data:
        return
    refusal = make_archive_error(
        archive.path,
        f"cannot be read as torch.export ({name!r} would have to be unpickled, which "
        "is never done)",
    )
    steps = _read_pickle_steps(archive.path, data, refusal)
    if any(_imports_other(step.name, argument) for step, argument, _position in steps):
        raise refusal


def _read_pickle_steps(path: Path, data: bytes, refusal: FileFormatError) -> list[Any]:
    """Return the steps of the pickle in a file of `torch.save`, as `pickletools` does.

    Args:
        path: path of the archive that contains the file, for errors.
        data: content of the file, itself an archive.
        refusal: error to raise if it is another file.

    Raises:
        FileFormatError: it is.
    """
    is_zip = data[:2] == b"PK"
    if not is_zip:
        raise refusal
    inner = open_archive(path, io.BytesIO(data), len(data))
    if "data.pkl" not in inner:
        raise refusal
    try:
        return list(pickletools.genops(inner.read_member("data.pkl", LARGEST_TEXT)))
    except (ValueError, IndexError, UnicodeDecodeError):
        raise refusal from None


def _imports_other(step_name: str, argument: Any) -> bool:
    """Return whether a step of a pickle imports anything but the classes of tensors."""
    is_other_class = step_name == "GLOBAL" and not _GLOBALS.fullmatch(str(argument))
    return is_other_class or step_name in _OTHER_IMPORTS
