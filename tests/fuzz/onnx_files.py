"""ONNX files by hand: protocol buffers of a few messages, so that nothing has to be installed to write them."""

import struct
from collections.abc import Sequence

FLOAT, INT64, BOOL = 1, 7, 9
EXTERNAL = 1

Dimension = int | str


def field(number: int, value: int | str | bytes) -> bytes:
    """Return a field of a message: a whole number, or text, bytes and messages by their length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    content = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(number: int) -> bytes:
    number &= (1 << 64) - 1
    parts = bytearray()
    while number > 0x7F:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*parts, number])


def tensor(name: str, shape: Sequence[int], kind: int, content: bytes) -> bytes:
    """Return a tensor with its numbers in little-endian order."""
    return b"".join(field(1, side) for side in shape) + field(2, kind) + field(8, name) + field(9, content)


def floats(name: str, values: Sequence[float], shape: Sequence[int] | None = None) -> bytes:
    """Return a tensor of float32."""
    return tensor(name, shape or [len(values)], FLOAT, struct.pack(f"<{len(values)}f", *values))


def integers(name: str, *values: int) -> bytes:
    """Return a tensor of int64."""
    return tensor(name, [len(values)], INT64, struct.pack(f"<{len(values)}q", *values))


def elsewhere(name: str, shape: Sequence[int], location: str, offset: str = "0", length: str | None = None) -> bytes:
    """Return a tensor of float32 whose numbers lie in another file."""
    said = {"location": location, "offset": offset} | ({} if length is None else {"length": length})
    entries = b"".join(field(13, field(1, key) + field(2, value)) for key, value in said.items())
    return b"".join(field(1, side) for side in shape) + field(2, FLOAT) + field(8, name) + entries + field(14, EXTERNAL)


def value(name: str, shape: Sequence[Dimension], kind: int = FLOAT) -> bytes:
    """Return what an input or an output is; a side that is free has a name."""
    sides = b"".join(field(1, field(1 if isinstance(side, int) else 2, side)) for side in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, sides)))


def node(kind: str, inputs: Sequence[str], outputs: Sequence[str], *attributes: bytes, domain: str = "") -> bytes:
    """Return one operator of a graph."""
    ends = b"".join(field(1, name) for name in inputs) + b"".join(field(2, name) for name in outputs)
    return ends + field(4, kind) + b"".join(field(5, one) for one in attributes) + field(7, domain)


def number(name: str, content: int) -> bytes:
    """Return an attribute that is a whole number."""
    return field(1, name) + field(3, content) + field(20, 2)


def numbers(name: str, *content: int) -> bytes:
    """Return an attribute of whole numbers."""
    return field(1, name) + b"".join(field(8, one) for one in content) + field(20, 7)


def inner(name: str, content: bytes) -> bytes:
    """Return an attribute that is a graph."""
    return field(1, name) + field(6, content) + field(20, 5)


def constant(name: str, content: bytes) -> bytes:
    """Return an operator with a tensor as its only attribute."""
    return node("Constant", [], [name], field(1, "value") + field(5, content) + field(20, 4))


def graph(nodes: Sequence[bytes], stored: Sequence[bytes], inputs: Sequence[bytes], outputs: Sequence[bytes]) -> bytes:
    """Return a graph with stored tensors."""
    parts = ((1, nodes), (5, stored), (11, inputs), (12, outputs))
    return field(2, "g") + b"".join(field(number, one) for number, several in parts for one in several)


def model(content: bytes) -> bytes:
    """Return a file."""
    return field(1, 9) + field(7, content) + field(8, field(2, 17))


MEAN = node("ReduceMean", ["x"], ["m"], numbers("axes", 2, 3), number("keepdims", 0))
"""From images (N, 3, H, W) to "m", (N, 3)."""


def classifier(
    nodes: Sequence[bytes], stored: Sequence[bytes] = (), shape: Sequence[Dimension] = ("N", 3, 16, 16)
) -> bytes:
    """Return a file whose nodes make logits "y" of three classes of the mean colours "m"."""
    return model(graph([MEAN, *nodes], stored, [value("x", shape)], [value("y", ["N", 3])]))


def weighted(stored: bytes, *, as_constant: bool = False, shape: Sequence[Dimension] = ("N", 3, 16, 16)) -> bytes:
    """Return a file that multiplies the mean colours by a tensor "w" of three numbers, stored as such or in a node."""
    times = node("Mul", ["m", "w"], ["y"])
    return (
        classifier([constant("w", stored), times], shape=shape) if as_constant else classifier([times], [stored], shape)
    )


def endless() -> bytes:
    """Return a file with a loop of 2**62 turns."""
    copies = [node("Identity", ["go"], ["on"]), node("Identity", ["v"], ["w"])]
    ends = [value("k", [], INT64), value("go", [], BOOL), value("v", ["N", 3])]
    body = graph(copies, [], ends, [value("on", [], BOOL), value("w", ["N", 3])])
    turns = [tensor("n", [], INT64, struct.pack("<q", 1 << 62)), tensor("t", [], BOOL, b"\1")]
    return classifier([node("Loop", ["n", "t", "m"], ["y"], inner("body", body))], turns)


def multiplied(side: int, times: int) -> bytes:
    """Return a file that multiplies a constant matrix by itself again and again, which no input changes."""
    nodes = [node("ConstantOfShape", ["n"], ["z0"])]
    nodes += [node("MatMul", [f"z{k}", "z0"], [f"z{k + 1}"]) for k in range(times)]
    nodes += [node("ReduceSum", [f"z{times}"], ["s"], number("keepdims", 0)), node("Add", ["m", "s"], ["y"])]
    return classifier(nodes, [integers("n", side, side)])
