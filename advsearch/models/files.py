"""Models in files: `torch.export` archives (.pt2) and TorchScript, told apart by content; and ONNX, by its suffix.

No Python object is ever unpickled: archives that need it are refused. A model file is a program all the same; open only
files whose makers you trust.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import logging
import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import torch

from advsearch.errors import FileFormatError, ModelError
from advsearch.files import open_regular
from advsearch.models import exported, onnx, torchscript
from advsearch.models.archive import LARGEST, Archive, open_archive, refused
from advsearch.models.deadline import TookTooLong, try_torchscript
from advsearch.models.probe import first_line
from advsearch.models.source import Source, source_of
from advsearch.models.zoo.library import without_unpickling

#: Suffixes that make a name a file even if there is no such file.
SUFFIXES = (".pt2", ".pt", ".pth", ".ts", ".torchscript", ".bin", ".pkl", ".pickle", ".ckpt", ".safetensors", ".onnx")

EXPORT_HINT = (
    "Export the network instead: torch.export.save(torch.export.export(net.eval(), (example,)), 'net.pt2'); or pass "
    "the nn.Module through the Python API; or store its state dict as safetensors and name what builds it: "
    "'package.module:callable@weights.safetensors'"
)

#: The largest batch sent to a program whose batch dimension is free.
LARGEST_BATCH = 64


def load_file(path: Path) -> Source:
    """Return the model in a file.

    Raises:
        FileFormatError: missing, empty, truncated, damaged, a pickle, or of another kind; the message names the file.
        ModelError: a program that does not take one floating-point image.
    """
    with _opened(path) as file:
        head = file.read(16)
        if not head:
            raise FileFormatError(f"model file {path}: expected a model, got an empty file")
        if path.suffix.lower() == ".onnx":
            return onnx.load(path)
        if head[:2] != b"PK":
            raise FileFormatError(f"model file {path}: {_not_an_archive(path, head)}")
        archive = open_archive(path, file, os.fstat(file.fileno()).st_size)
        if _kind(archive) == "torchscript":
            return _load_torchscript(path, archive)
        return _load_exported(path, archive)


def _opened(path: Path) -> BinaryIO:
    try:
        return open_regular(path, "a model file", LARGEST)
    except FileNotFoundError:
        raise FileFormatError(f"model file {path}: no such file.{_near_files(path)}") from None
    except OSError as error:
        raise FileFormatError(f"model file {path}: cannot be read ({error.strerror or error})") from None


def _kind(archive: Archive) -> str:
    """Return ``"exported"`` or ``"torchscript"``; raise for everything else."""
    path, names = archive.path, archive.members
    if any(name.startswith("models/") and name.endswith(".json") for name in names):
        compiled = [
            name
            for name in names
            if name.startswith("data/aotinductor/") or Path(name).name.startswith(("opaque_obj", "custom_obj"))
        ]
        if compiled:
            raise refused(path, f"holds {min(compiled)!r}, which is a pickled object or compiled code and never loaded")
        return "exported"
    if "serialized_exported_program.json" in names:
        return "exported"
    if "constants.pkl" in names and any(name.startswith("code/") for name in names):
        return "torchscript"
    if "data.pkl" in names:
        raise FileFormatError(
            f"model file {path}: is a pickle (made by torch.save), which is never opened. {EXPORT_HINT}"
        )
    raise FileFormatError(f"model file {path}: a zip archive, but neither torch.export nor TorchScript. {EXPORT_HINT}")


def _not_an_archive(path: Path, head: bytes) -> str:
    """Return what a file that is not a zip archive seems to be, and what to do."""
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 1 << 30:
        return (
            "safetensors hold weights but no network; name what builds it: "
            "'package.module:callable@weights.safetensors' or 'torchvision:NAME@weights.safetensors'"
        )
    if head[:1] == b"\x80" or path.suffix.lower() in (".pkl", ".pickle", ".pth", ".ckpt", ".bin"):
        return f"is a pickle, or something like it, which is never opened. {EXPORT_HINT}"
    return f"expected a torch.export archive (.pt2) or TorchScript, got other bytes. {EXPORT_HINT}"


def _near_files(path: Path) -> str:
    if not path.parent.is_dir():
        return f" The folder {path.parent} does not exist either"
    near = difflib.get_close_matches(path.name, [item.name for item in path.parent.iterdir()], n=3, cutoff=0.6)
    return f" Did you mean {' or '.join(repr(str(path.parent / name)) for name in near)}?" if near else ""


def _load_torchscript(path: Path, archive: Archive) -> Source:
    checked = torchscript.rewritten(archive)
    if torchscript.runs_while_loading(archive):
        _try_to_load(path, checked)
    with warnings.catch_warnings(), _damaged(path, "TorchScript"):
        for kind in (DeprecationWarning, FutureWarning):  # the second from torch 2.14 on
            warnings.filterwarnings("ignore", message=r".*torch\.jit\.\w+.* is deprecated", category=kind)
        module = torch.jit.load(checked, map_location="cpu")
    return source_of(module, path.stem)


def _try_to_load(path: Path, checked: io.BytesIO) -> None:
    try:
        wrong = try_torchscript(checked)
    except TookTooLong as error:
        wrong = str(error)
    if wrong:
        raise FileFormatError(f"model file {path}: {wrong}")


def _load_exported(path: Path, archive: Archive) -> Source:
    checked = exported.rewritten(archive)
    with _damaged(path, "torch.export"), without_unpickling(), _quiet_export():
        program = torch.export.load(checked)
        module = program.module()
    return _with_signature(source_of(module, path.stem), program)


def _with_signature(source: Source, program: torch.export.ExportedProgram) -> Source:
    """Return the source with what the program's signature tells: input size, layout, batch limits, dtype."""
    name = source.name
    inputs = program.graph_signature.user_inputs
    nodes = {node.name: node for node in program.graph.nodes if node.op == "placeholder"}
    values = [nodes[key].meta.get("val") for key in inputs if key in nodes]
    if len(values) != 1 or not isinstance(values[0], torch.Tensor) or values[0].dim() != 4:
        raise ModelError(f"model {name}: expected a program with one input, a batch of images of 4 dimensions")
    value = values[0]
    if not value.is_floating_point():
        raise ModelError(f"model {name}: expected a floating-point image as input, the program takes {value.dtype}")
    layout = "NHWC" if value.shape[3] == 3 and value.shape[1] != 3 else "NCHW"
    limits = _batch_limits(program, value.shape[0])
    source = replace(source, dtype=value.dtype, batch_limits=limits, layout=layout)
    height, width = value.shape[1:3] if layout == "NHWC" else value.shape[2:4]
    fixed = isinstance(height, int) and isinstance(width, int)
    return replace(source, input_size=(height, width)) if fixed else source


def _batch_limits(program: torch.export.ExportedProgram, batch: int | torch.SymInt) -> tuple[int, int]:
    if isinstance(batch, int):
        return batch, batch
    allowed = program.range_constraints.get(batch.node.expr)
    if allowed is None:
        return 1, LARGEST_BATCH
    low = max(int(allowed.lower), 1)
    return low, max(low, int(min(allowed.upper, LARGEST_BATCH)))


@contextlib.contextmanager
def _damaged(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a loader raises into a FileFormatError that names the file."""
    try:
        yield
    except Exception as error:  # loaders raise nearly every type on damaged files
        raise FileFormatError(
            f"model file {path}: cannot be read as {kind} with torch {torch.__version__}; damaged, made by another "
            f"version, or in need of unpickling, which is never done ({first_line(error)})"
        ) from error


@contextlib.contextmanager
def _quiet_export() -> Iterator[None]:
    """Silence the log of `torch.export`, which prints a traceback for files that are refused with a message anyway."""
    logger = logging.getLogger("torch.export")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)
