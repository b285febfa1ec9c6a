"""The grammar of what an exported program says about sizes: arithmetic with whole numbers and symbols.

torch hands these texts to sympy, which evaluates them as Python. Only what sympy itself writes passes: names, numbers,
operators, and calls of the functions listed here.
"""

from __future__ import annotations

import ast
import re

LENGTH = 20_000
"""Most characters."""

DEPTH = 60
"""Deepest nesting."""

EXPONENT = 64
"""Largest exponent, multiplied over nested powers: nobody writes s0**65, and 9**9**9 never ends."""

NUMBER = 1 << 63
"""Numbers are smaller than this."""

FUNCTIONS = frozenset(
    "Integer Rational Float Add Mul Max Min Mod Abs Eq Ne Lt Le Gt Ge Equality Unequality StrictLessThan LessThan "
    "StrictGreaterThan GreaterThan And Or Not Piecewise ExprCondPair FloorDiv ModularIndexing Where PythonMod CleanDiv "
    "CeilToInt FloorToInt CeilDiv FloatTrueDiv IntTrueDiv IsNonOverlappingAndDenseIndicator TruncToFloat TruncToInt "
    "RoundToInt RoundDecimal ToFloat Identity floor ceiling".split()
)
POWERS = frozenset(["Pow", "PowByNatural", "FloatPow", "LShift", "RShift"])
NAMES = frozenset(["true", "false", "oo", "int_oo"])

_SYMBOL = re.compile(r"[A-Za-z_]{1,40}[0-9]{0,5}")
_DECIMAL = re.compile(r"-?[0-9]{1,40}(\.[0-9]{0,40})?(e[-+]?[0-9]{1,3})?")
_OPERATORS = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow)
_SIGNS = (ast.UAdd, ast.USub, ast.Not, ast.Invert)
_COMPARISONS = (ast.Eq, ast.NotEq, ast.Lt, ast.LtE, ast.Gt, ast.GtE)


def is_symbol(text: str) -> bool:
    """Whether a text may name a symbol: letters, then at most five digits (torch counts up to the number)."""
    return _SYMBOL.fullmatch(text) is not None


def problem(text: object) -> str:
    """Return what is wrong with an expression, or nothing."""
    if not isinstance(text, str) or len(text) > LENGTH:
        return f"expected a text of at most {LENGTH} characters"
    try:
        tree = ast.parse(text.strip(), mode="eval")
        _check(tree.body, DEPTH, EXPONENT)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        return f"expected arithmetic with whole numbers and symbols, got {text[:60]!r} ({_reason(error)})"
    return ""


def _reason(error: BaseException) -> str:
    return str(error.args[0]) if type(error) is ValueError else "it cannot be read"


def _check(node: ast.expr, depth: int, power: int) -> None:
    """Raise ValueError unless the node is arithmetic; `power` is what may still be multiplied up by exponents."""
    if depth <= 0:
        raise ValueError("it is nested too deeply")
    if isinstance(node, ast.Constant):
        _check_number(node.value)
    elif isinstance(node, ast.Name):
        if not (node.id in NAMES or (is_symbol(node.id) and node.id[-1].isdigit())):
            raise ValueError(f"the name {node.id[:40]!r}")
    elif isinstance(node, ast.Call):
        _check_call(node, depth, power)
    else:
        operands, power = _operands(node, power)
        for operand in operands:
            _check(operand, depth - 1, power)


def _operands(node: ast.expr, power: int) -> tuple[list[ast.expr], int]:
    """Return the operands of an operator, and the power that is left for them."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, _SIGNS):
        return [node.operand], power
    if isinstance(node, ast.BoolOp):
        return node.values, power
    if isinstance(node, ast.BinOp) and isinstance(node.op, (*_OPERATORS, ast.BitAnd, ast.BitOr)):
        return (
            _powered(node.left, node.right, power) if isinstance(node.op, ast.Pow) else ([node.left, node.right], power)
        )
    if isinstance(node, ast.Compare) and all(isinstance(op, _COMPARISONS) for op in node.ops):
        return [node.left, *node.comparators], power
    if isinstance(node, ast.Tuple):  # the cases of a Piecewise
        return node.elts, power
    raise ValueError(f"{type(node).__name__} is none")


def _check_call(node: ast.Call, depth: int, power: int) -> None:
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if name == "Symbol":
        _check_symbol(node)
        return
    operands: list[ast.expr] = node.args
    if name == "Float":
        operands = _check_decimal(node)
    elif node.keywords:
        raise ValueError("keywords")
    elif name in POWERS and len(operands) == 2:
        operands, power = _powered(operands[0], operands[1], power)
    elif name not in FUNCTIONS or len(operands) > 16:
        raise ValueError(f"a call of {ast.unparse(node.func)[:40]!r}")
    for operand in operands:
        _check(operand, depth - 1, power)


def _check_symbol(node: ast.Call) -> None:
    """Symbol('s0', positive=True, integer=True)."""
    name = node.args[0].value if len(node.args) == 1 and isinstance(node.args[0], ast.Constant) else None
    assumed = all(isinstance(word.value, ast.Constant) and isinstance(word.value.value, bool) for word in node.keywords)
    if not (isinstance(name, str) and is_symbol(name) and assumed and None not in {word.arg for word in node.keywords}):
        raise ValueError("a symbol of another form")


def _check_decimal(node: ast.Call) -> list[ast.expr]:
    """Float('0.5', precision=53); return the operands that are left to check."""
    text = node.args[0].value if len(node.args) == 1 and isinstance(node.args[0], ast.Constant) else None
    digits = [word.value.value if isinstance(word.value, ast.Constant) else None for word in node.keywords]
    if not (isinstance(text, str) and _DECIMAL.fullmatch(text)):
        raise ValueError("a number of another form")
    if any(word.arg not in ("precision", "prec", "dps") for word in node.keywords) or any(
        not isinstance(value, int) or not 0 < value <= 200 for value in digits
    ):
        raise ValueError("a number of another precision")
    return []


def _powered(base: ast.expr, exponent: ast.expr, power: int) -> tuple[list[ast.expr], int]:
    """Return the base and the power that is left for it; the exponent has to be a number."""
    sign = 1
    if isinstance(exponent, ast.UnaryOp) and isinstance(exponent.op, ast.USub):
        sign, exponent = -1, exponent.operand
    if isinstance(exponent, ast.Call) and isinstance(exponent.func, ast.Name) and exponent.func.id == "Integer":
        exponent = exponent.args[0] if len(exponent.args) == 1 else exponent
        if isinstance(exponent, ast.UnaryOp) and isinstance(exponent.op, ast.USub):
            sign, exponent = -sign, exponent.operand
    if isinstance(exponent, ast.Call) and ast.unparse(exponent) in ("Rational(1, 2)", "Rational(-1, 2)"):
        return [base], power
    value = exponent.value if isinstance(exponent, ast.Constant) else None
    if not isinstance(value, int) or isinstance(value, bool) or value > power:
        raise ValueError("an exponent that is not a small number")
    return [base], power // max(value, 1)


def _check_number(value: object) -> None:
    if isinstance(value, (bool, float)) or (isinstance(value, int) and abs(value) < NUMBER):
        return
    raise ValueError("a number that is too large" if isinstance(value, int) else "text")
