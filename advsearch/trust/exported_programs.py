"""`torch.export` archives (.pt2), rewritten before torch reads them.

torch's reader evaluates expressions and guards as Python, writes names of the graph
into code that it runs, imports modules for containers, and unpickles. So it never sees
the file: a new archive is made in memory of its description of the network and its
weights. What cannot be checked is left out, and all else has to have the form that
`torch.export.save` gives it; expressions of sizes are arithmetic with whole numbers,
symbols and listed functions.

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
from collections.abc import Callable
from pathlib import Path
from typing import Any

from advsearch.files import JsonObject, JsonValue
from advsearch.trust.archives import (
    LARGEST_TEXT,
    Archive,
    make_archive_error,
    open_archive,
)
from advsearch.trust.stored_files import parse_json

LENGTH = 20_000  # characters of an expression
DEPTH = 60  # of its nesting
# multiplied over nested powers: nobody writes s0**65, and 9**9**9 never ends
EXPONENT = 64
NUMBER = 1 << 63  # numbers are smaller than this

FUNCTIONS = frozenset(
    "Integer Rational Float Add Mul Max Min Mod Abs Eq Ne Lt Le Gt Ge Equality "
    "Unequality StrictLessThan LessThan StrictGreaterThan GreaterThan And Or Not "
    "Piecewise ExprCondPair FloorDiv ModularIndexing Where PythonMod CleanDiv "
    "CeilToInt FloorToInt CeilDiv FloatTrueDiv IntTrueDiv "
    "IsNonOverlappingAndDenseIndicator TruncToFloat TruncToInt "
    "RoundToInt RoundDecimal ToFloat Identity floor ceiling".split()
)
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
    """Whether a text may name a symbol: letters, then at most five digits (torch counts
    up to the number).
    """
    return _SYMBOL.fullmatch(text) is not None


def problem(text: object) -> str:
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
        reason = "it cannot be read"
        # A plain ValueError is that of `_check`, whose message is for the user. A
        # subclass of it, such as UnicodeError, comes from Python's parser, as do the
        # other errors.
        if type(error) is ValueError:
            reason = str(error.args[0])
        return (
            "expected arithmetic with whole numbers and symbols, got "
            f"{text[:60]!r} ({reason})"
        )
    return ""


def _check(node: ast.expr, depth: int, power: int) -> None:
    """Raise ValueError unless a node of an expression is arithmetic that ends soon.

    Args:
        node: node to check, with all nodes below it.
        depth: number of levels that may still be nested.
        power: largest value that the product of exponents below may have. Powers of
            powers multiply their exponents, so that (9**9)**9 is bounded too.
    """
    if depth <= 0:
        raise ValueError("it is nested too deeply")
    operands: list[ast.expr] = []
    match node:
        case ast.Constant(value=number):
            _check_number(number)
        case ast.Name(id=name):
            # symbols are numbered by torch: s0, u12
            is_numbered_symbol = is_symbol(name) and name[-1].isdecimal()
            if name not in NAMES and not is_numbered_symbol:
                raise ValueError(f"the name {name[:40]!r}")
        case ast.Call(func=ast.Name(id="Symbol")):
            _check_symbol(node)
        case ast.Call(func=ast.Name(id="Float")):
            _check_decimal(node)
        # The two calls above may have keywords, such as Symbol("s0", integer=True).
        # Calls of other functions may not.
        case ast.Call(keywords=[_, *_]):
            raise ValueError("keywords")
        case ast.Call(func=ast.Name(id=name), args=[base, exponent]) if name in POWERS:
            operands = [base]
            power = _power_left(exponent, power)
        case ast.Call(func=ast.Name(id=name), args=arguments) if (
            name in FUNCTIONS and len(arguments) <= 16
        ):
            operands = arguments
        case ast.Call(func=function):
            raise ValueError(f"a call of {ast.unparse(function)[:40]!r}")
        case ast.BinOp(left=base, op=ast.Pow(), right=exponent):
            operands = [base]
            power = _power_left(exponent, power)
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
            raise ValueError(f"{type(node).__name__} is none")
    for operand in operands:
        _check(operand, depth - 1, power)


def _check_number(value: object) -> None:
    """Raise ValueError unless a constant is a number of at most 64 bits."""
    if not isinstance(value, (int, float)):
        raise ValueError("text")
    if isinstance(value, int) and abs(value) >= NUMBER:
        raise ValueError("a number that is too large")


def _check_symbol(call: ast.Call) -> None:
    """Raise ValueError unless a call is like Symbol('s0', positive=True, integer=True)."""
    text = _get_only_argument(call)
    assumptions = [_get_constant(keyword.value) for keyword in call.keywords]
    # None is the name of **keywords
    has_names = all(keyword.arg is not None for keyword in call.keywords)
    are_plain = has_names and all(isinstance(value, bool) for value in assumptions)
    if not isinstance(text, str) or not is_symbol(text) or not are_plain:
        raise ValueError("a symbol of another form")


def _check_decimal(call: ast.Call) -> None:
    """Raise ValueError unless a call is like Float('0.5', precision=53).

    Sympy computes with as many bits as the precision says (53 for float64), so that a
    huge one would take all memory. 200 is more than torch writes.
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
    """Return the constant that is the only positional argument of a call; None if it is
    something else, or not the only one.
    """
    return _get_constant(call.args[0]) if len(call.args) == 1 else None


def _get_constant(node: ast.expr) -> object:
    """Return the value of a constant; None for any other node."""
    return node.value if isinstance(node, ast.Constant) else None


def _power_left(exponent: ast.expr, power: int) -> int:
    """Return the bound on exponents that remains after this exponent.

    The exponent may be an integer, also with a sign or as ``Integer(3)``. It may also
    be 1/2 or -1/2: a root makes no number large, and leaves the bound as it is.

    Args:
        exponent: node of the exponent.
        power: largest value that the product of this exponent and those below it may
            have.

    Returns:
        `power` divided by the exponent, rounded down.

    Raises:
        ValueError: the exponent is anything else, or larger than `power`.
    """
    exponent = _without_sign(exponent)
    match exponent:
        case ast.Call(func=ast.Name(id="Integer"), args=[number]):
            exponent = _without_sign(number)
    if isinstance(exponent, ast.Call) and ast.unparse(exponent) in (
        "Rational(1, 2)",
        "Rational(-1, 2)",
    ):
        return power
    value = _get_constant(exponent)
    if not isinstance(value, int) or isinstance(value, bool) or value > power:
        raise ValueError("an exponent that is not a small number")
    return power // max(value, 1)


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
"""What the members were called up to torch 2.7."""

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
"""Operators of these namespaces that touch files, the terminal or the process."""

HIGHER_ORDER = (
    "cond|map_impl|scan|associative_scan|flex_attention|wrap_with_set_grad_enabled|"
    "wrap_with_autocast"
)

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
"""What the pickle of a tensor names; nothing of it runs anything."""
_OTHER_IMPORTS = ("STACK_GLOBAL", "INST", "OBJ", "EXT1", "EXT2", "EXT4")
"""Steps of a pickle that name a class in another way; torch.save uses none of them."""

_CONTAINERS = frozenset(
    [
        None,
        "builtins.tuple",
        "builtins.list",
        "builtins.dict",
        "collections.OrderedDict",
    ]
)
_FORGOTTEN: JsonObject = {"metadata": {}, "guards_code": []}


def rewrite_program(archive: Archive) -> io.BytesIO:
    """Copy the network and the weights of an archive into a new one that is safe to load.

    `torch.export.load` reads the new archive. Members that could run code, such as
    compiled code and pickled objects, are left out or refused.

    Raises:
        FileFormatError: the archive has something that a plain network does not have;
            the message says what.
    """
    # This import takes a second, and only this kind of model needs it.
    from torch.export.pt2_archive import PT2ArchiveWriter

    # archives up to torch 2.7 have other names for the same members
    names = {new: old if old in archive else new for new, old in OLD_NAMES.items()}
    program = _read_program(archive, names[PROGRAM])
    for name in EXAMPLE:
        if name in archive:
            _check_pickle(archive, name)
    buffer = io.BytesIO()
    with PT2ArchiveWriter(buffer) as writer:  # type: ignore[no-untyped-call, arg-type, unused-ignore]
        writer.write_bytes(PROGRAM, json.dumps(program).encode())
        # torch requires this member (example inputs), but does not need its content
        writer.write_bytes(EXAMPLE[0], b"")
        for kind in ("weights", "constants"):
            folder = f"data/{kind}/"
            # An archive has either one pickle of all tensors, or a table with a file
            # for each tensor.
            pickle_name = names[f"{folder}model.pt"]
            if pickle_name in archive:
                _check_pickle(archive, pickle_name)
                writer.write_bytes(f"{folder}model.pt", archive.read(pickle_name))
            else:
                config = f"{folder}model_{kind}_config.json"
                _copy_tensors(archive, writer, folder, config)
    buffer.seek(0)
    return buffer


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

    Only files with plain numbers are copied, and no pickles. An empty file is refused
    for a tensor that should have numbers.

    Args:
        archive: archive to read.
        writer: writer of the new archive.
        folder: folder of the tensors in both archives, such as "data/weights/".
        config: name of the member with the table.

    Raises:
        FileFormatError: the table or one of its entries has another form.
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
    table = _check_value(archive.path, table, "tensor_name")
    copied: set[str] = set()  # several tensors may share one file of numbers
    for name, entry in table.items():
        member = f"{folder}{_get_record(archive, name, entry)}"
        shape = _read_shape(archive, member, entry)
        # For an empty file torch would allocate a tensor of any size that the table
        # states, which could exhaust the memory.
        if (
            member in archive
            and archive.members[member].file_size == 0
            and math.prod(shape) > 0
        ):
            raise make_archive_error(
                archive.path,
                f"{member[:80]!r} is empty, but should hold a tensor of {shape[:8]}",
            )
        if member not in copied:
            writer.write_bytes(member, archive.read(member))
            copied.add(member)
    writer.write_bytes(config, json.dumps({"config": table}).encode())


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
        sizes = [None]  # refused below
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

    Args:
        path: path of the archive, for errors.
        value: any JSON value.
        key: name of the entry that holds the value; for an element of a list, the name
            of the entry that holds the list.

    Returns:
        The value, in which entries that the network does not need (`_FORGOTTEN`) are
        replaced by harmless ones.

    Raises:
        FileFormatError: a text, number or name cannot be part of a plain network.
    """
    if isinstance(value, list):
        return [_check_value(path, inner, key) for inner in value]
    if not isinstance(value, dict):
        if wrong := _problem(value, key):
            raise make_archive_error(path, wrong)
        return value
    checked: JsonObject = {}
    for name, inner in value.items():
        # Keys of a mapping may be names of tensors. So a key is checked like a text
        # that stands under the name of the mapping.
        wrong = "" if name in ("", *_FORGOTTEN) else _problem(name, key)
        is_custom_object = name in ("as_custom_obj", "custom_obj")
        if is_custom_object or (name == "custom_obj_values" and inner):
            wrong = "holds a custom object, which is never loaded"
        if wrong:
            raise make_archive_error(path, wrong)
        if name in _FORGOTTEN:
            checked[name] = _FORGOTTEN[name]
        else:
            checked[name] = _check_value(path, inner, name)
    return checked


def _problem(value: Any, key: str) -> str:
    """Return what is wrong with a text, number or name; "" for nothing.

    Args:
        value: the value.
        key: name of the entry that holds it. It decides which check a text needs: for
            instance "expr_str" holds an expression.
    """
    if isinstance(value, str):
        find_problem = _TEXTS.get(key, _plain_problem)
        return find_problem(value)
    if key == "expr_str":
        return "an expression that is no text"
    if isinstance(value, int) and abs(value) >= NUMBER:
        return "has a number of more than 64 bits"
    return ""


def _plain_problem(text: str) -> str:
    return "" if _PLAIN.fullmatch(text) else f"has an unusual name, {text[:60]!r}"


def _identifier_problem(text: str) -> str:
    """Return what speaks against a name that torch writes into code, "" if nothing does."""
    is_proper = text == "" or (
        text.isascii()
        and text.isidentifier()
        and not keyword.iskeyword(text)
        and len(text) < 1000
    )
    return "" if is_proper else f"expected a name of a value, got {text[:60]!r}"


# that an operator is called with, such as 'same' or 'bilinear'
def _argument_problem(text: str) -> str:
    return (
        ""
        if len(text) <= 1000 and text.isprintable()
        else "has text that is too long or not printable"
    )


def _operator_problem(text: str) -> str:
    """Return what speaks against the name of an operator, "" if nothing does."""
    operator = _OPERATOR.fullmatch(text)
    if _ARITHMETIC.fullmatch(text) or (operator and operator[1] not in HARMFUL):
        return ""
    return (
        f"names the operator {text[:80]!r}, which is none of a plain network, and "
        "is never run"
    )


def _tree_problem(text: str) -> str:
    """Return what is wrong with the structure of inputs or outputs; "" for nothing.

    Torch imports the types of containers that the structure names. So only tuples,
    lists and dicts are allowed.

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
        isinstance(key, (str, int)) and not _plain_problem(str(key)) for key in keys
    )


_TEXTS: dict[str, Callable[[str], str]] = {
    **dict.fromkeys(
        ("name", "as_name", "user_input_name", "forward_arg_names"), _identifier_problem
    ),
    **dict.fromkeys(
        ("tensor_values", "sym_int_values", "sym_float_values", "sym_bool_values"),
        _identifier_problem,
    ),
    "expr_str": problem,
    "target": _operator_problem,
    "as_operator": _operator_problem,
    "in_spec": _tree_problem,
    "out_spec": _tree_problem,
    "as_string": _argument_problem,
    "as_strings": _argument_problem,
    "range_constraints": lambda text: "" if is_symbol(text) else problem(text),
}


# ---- pickles of tensors
# --------------------------------------------------------------------------------


def _check_pickle(archive: Archive, name: str) -> None:
    """Check that a member is a file of `torch.save` that holds only tensors.

    They may be in tuples and dicts; an empty member is accepted too. Nothing is
    unpickled here, since that may run code: the steps of the pickle are read one by
    one, and a step that imports anything but the classes of tensors is refused.

    Args:
        archive: archive of the network.
        name: name of the member.

    Raises:
        FileFormatError: the member is another file, or imports something else.
    """
    data = archive.read(name)
    if not data:
        return
    refusal = make_archive_error(
        archive.path,
        f"cannot be read as torch.export ({name!r} is in need of unpickling, which "
        "is never done)",
    )
    is_zip = data[:2] == b"PK"
    if not is_zip:
        raise refusal
    inner = open_archive(archive.path, io.BytesIO(data), len(data))
    if "data.pkl" not in inner:
        raise refusal
    try:
        steps = list(pickletools.genops(inner.read("data.pkl", LARGEST_TEXT)))
    except (ValueError, IndexError, UnicodeDecodeError):
        raise refusal from None
    for step, argument, _ in steps:
        imports_other = step.name == "GLOBAL" and not _GLOBALS.fullmatch(str(argument))
        if imports_other or step.name in _OTHER_IMPORTS:
            raise refusal
