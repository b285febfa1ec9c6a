"""Models in files: `torch.export` archives (.pt2) and TorchScript, told apart by
content; and ONNX, by its suffix.

No Python object is ever unpickled: archives that need it are refused. A model file is a
program all the same; open only files whose makers you trust. ONNX files are run by
onnxruntime, which gives predictions and no gradients.
"""

from __future__ import annotations

import difflib
import logging
import os
import re
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from advsearch.errors import FileFormatError, ModelError
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.inputs import SIZE_INPUTS, SIZE_TYPES, EightBitInput
from advsearch.models.labels import names_in
from advsearch.models.source import Source, library, source_of
from advsearch.trust import exported_programs
from advsearch.trust.archives import (
    LARGEST,
    Archive,
    open_archive,
    refused,
    rewritten_torchscript,
    without_unpickling,
)
from advsearch.trust.foreign_code import foreign, try_torchscript
from advsearch.trust.stored_files import open_regular

#: Suffixes that make a name a file even if there is no such file.
SUFFIXES = (
    ".pt2",
    ".pt",
    ".pth",
    ".ts",
    ".torchscript",
    ".bin",
    ".pkl",
    ".pickle",
    ".ckpt",
    ".safetensors",
    ".onnx",
)

EXPORT_HINT = (
    "Export the network instead: torch.export.save(torch.export.export(net.eval(), "
    "(example,)), 'net.pt2'); or pass "
    "the nn.Module through the Python API; or store its state dict as safetensors and "
    "name what builds it: "
    "'package.module:callable@weights.safetensors'"
)

LARGEST_BATCH = 64  # that is sent to a program whose batch dimension is free


def load_file(path: Path) -> Source:
    """Return the model in a file. Raises FileFormatError: missing, empty, truncated,
    damaged, a pickle, or of another kind; the message names the file; ModelError: a
    program that does not take one floating-point image.
    """
    try:
        opened = open_regular(path, "a model file", LARGEST)
    except FileNotFoundError:
        hint = f" The folder {path.parent} does not exist either"
        if path.parent.is_dir():
            near = difflib.get_close_matches(
                path.name,
                [item.name for item in path.parent.iterdir()],
                n=3,
                cutoff=0.6,
            )
            hint = (
                f" Did you mean {' or '.join(repr(str(path.parent / name)) for name in near)}?"
                if near
                else ""
            )
        raise FileFormatError(f"model file {path}: no such file.{hint}") from None
    except OSError as error:
        raise FileFormatError(
            f"model file {path}: cannot be read ({error.strerror or error})"
        ) from None
    with opened as file:
        head = file.read(16)
        if not head:
            raise FileFormatError(
                f"model file {path}: expected a model, got an empty file"
            )
        if path.suffix.lower() == ".onnx":
            return load_onnx(path)
        if head[:2] != b"PK":
            raise FileFormatError(f"model file {path}: {_not_an_archive(path, head)}")
        archive = open_archive(path, file, os.fstat(file.fileno()).st_size)
        if _kind(archive) == "torchscript":
            checked, runs_while_loading = rewritten_torchscript(archive)
            if runs_while_loading and (wrong := try_torchscript(checked)):
                raise FileFormatError(f"model file {path}: {wrong}")
            with warnings.catch_warnings(), _damaged(path, "TorchScript"):
                # the second from torch 2.14 on
                for kind in (DeprecationWarning, FutureWarning):
                    warnings.filterwarnings(
                        "ignore",
                        message=r".*torch\.jit\.\w+.* is "
                        r"deprecated",
                        category=kind,
                    )
                module = torch.jit.load(checked, map_location="cpu")
            return source_of(module, path.stem)
        checked = exported_programs.rewritten(archive)
        # prints a traceback of what is refused with a message anyway
        logger = logging.getLogger("torch.export")
        with _damaged(path, "torch.export"), without_unpickling(), ExitStack() as stack:
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
            program = torch.export.load(checked)
            module = program.module()
        return _with_signature(source_of(module, path.stem), program)


def _kind(archive: Archive) -> str:
    """Return ``"exported"`` or ``"torchscript"``; raise for everything else."""
    path = archive.path
    names = archive.members
    if any(name.startswith("models/") and name.endswith(".json") for name in names):
        kinds = ("opaque_obj", "custom_obj")
        compiled = [
            n
            for n in names
            if n.startswith("data/aotinductor/") or Path(n).name.startswith(kinds)
        ]
        if compiled:
            raise refused(
                path,
                f"holds {min(compiled)!r}, which is a pickled object "
                "or compiled code and never loaded",
            )
        return "exported"
    if "serialized_exported_program.json" in names:
        return "exported"
    if "constants.pkl" in names and any(name.startswith("code/") for name in names):
        return "torchscript"
    if "data.pkl" in names:
        raise FileFormatError(
            f"model file {path}: is a pickle (made by torch.save), which is never "
            f"opened. {EXPORT_HINT}"
        )
    raise FileFormatError(
        f"model file {path}: a zip archive, but neither torch.export "
        f"nor TorchScript. {EXPORT_HINT}"
    )


def _not_an_archive(path: Path, head: bytes) -> str:
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 1 << 30:
        return (
            "safetensors hold weights but no network; name what builds it: "
            "'package.module:callable@weights.safetensors' or "
            "'torchvision:NAME@weights.safetensors'"
        )
    if path.suffix.lower() == ".py":
        return (
            "is Python code; name what makes the network in it: "
            f"'{path.stem}:NAME', from the folder of the file"
        )
    if head[:1] == b"\x80" or path.suffix.lower() in (
        ".pkl",
        ".pickle",
        ".pth",
        ".ckpt",
        ".bin",
    ):
        return (
            f"is a pickle, or something like it, which is never opened. {EXPORT_HINT}"
        )
    return (
        "expected a torch.export archive (.pt2) or TorchScript, got other bytes. "
        f"{EXPORT_HINT}"
    )


def _with_signature(source: Source, program: torch.export.ExportedProgram) -> Source:
    """Return the source with what the program's signature tells: input size, layout,
    batch limits, dtype. A program may take (N, K, 3, H, W) or (N, K, H, W, 3), all
    pictures of a rig at once.
    """
    nodes = {
        node.name: node for node in program.graph.nodes if node.op == "placeholder"
    }
    names = [key for key in program.graph_signature.user_inputs if key in nodes]
    values = [nodes[key].meta.get("val") for key in names]
    tensors = bool(values) and all(isinstance(value, Tensor) for value in values)
    rig = (
        tensors
        and len(values) == 1
        and values[0].dim() == 5
        and isinstance(values[0].shape[1], int)
    )
    if not rig and (
        not tensors
        or values[0].dim() != 4
        or any(value.dim() != 2 for value in values[1:])
    ):
        raise ModelError(
            f"model {source.name}: expected a program with one input, a batch of "
            "images of 4 dimensions"
            f"{_second_input(names)}"
        )
    images = values[0]
    eight_bit = images.dtype == torch.uint8 and not rig
    if not images.is_floating_point() and not eight_bit:
        what = (
            "floating-point images as input, got"
            if rig
            else "an image as input, floating-point or uint8, got"
        )
        raise ModelError(f"model {source.name}: expected {what} {images.dtype}")
    if len(names) == 2 and names[1] in SIZE_INPUTS and values[1].shape[1] == 2:
        source = replace(source, size_type=values[1].dtype)
    else:
        source = replace(source, takes_more=len(values) > 1, size_type=None)
    picture = images.shape[-3:]
    last = picture[2] == 3 and picture[0] != 3
    height, width = picture[:2] if last else picture[1:]
    size = (
        (height, width) if isinstance(height, int) and isinstance(width, int) else None
    )
    batch = images.shape[0]
    low, high = (batch, batch) if isinstance(batch, int) else (1, LARGEST_BATCH)
    if (
        not isinstance(batch, int)
        and (allowed := program.range_constraints.get(batch.node.expr)) is not None
    ):
        low = max(int(allowed.lower), 1)
        high = max(low, int(min(allowed.upper, LARGEST_BATCH)))
    source = replace(source, input_size=size)
    source = as_eight_bit(source) if eight_bit else replace(source, dtype=images.dtype)
    if not rig:
        return replace(
            source, batch_limits=(low, high), layout="NHWC" if last else "NCHW"
        )
    cameras = int(images.shape[1])
    module = AllAtOnce(
        cast(nn.Module, source.module), cameras, "NKHWC" if last else "NKCHW"
    )
    return replace(source, module=module, batch_limits=(low * cameras, high * cameras))


def as_eight_bit(source: Source) -> Source:
    """Return the source of a network that takes uint8, as one of floating-point
    pictures from 0 to 255.
    """
    return replace(
        source,
        module=EightBitInput(source.module),
        dtype=torch.float32,
        value_range=(0.0, 255.0),
    )


def _second_input(names: list[str]) -> str:
    """What to do with a network of two inputs, of which the second is not known; "" of
    others.
    """
    if len(names) != 2:
        return ""
    return (
        f"; its second input {names[1][:60]!r} is not known: of two inputs, the second "
        "may be the size of the "
        "pictures, (N, 2) in pixels, (width, height), named 'orig_target_sizes'. "
        "Export a network that takes pictures "
        "alone"
    )


def _damaged(path: Path, kind: str) -> AbstractContextManager[None]:
    what = f"model file {path}: cannot be read as {kind} with torch {torch.__version__}"
    more = (
        "damaged, made by another version, or in need of unpickling, which is "
        "never "
        "done"
    )
    return foreign(f"{what}; {more}", kind=FileFormatError)


FLOATS = {
    "tensor(float)": torch.float32,
    "tensor(float16)": torch.float16,
    "tensor(double)": torch.float64,
}

OLDEST = (1, 24)
"""The first onnxruntime that reads no weights from outside the folder of a file; older
ones follow `../` and links.
"""


class OnnxNetwork(nn.Module):
    """A session of onnxruntime as a function from a batch of images to its outputs; no
    gradient goes through it. `new_options` makes options of a run, by which it can be
    ended.
    """

    def __init__(self, session: Any, new_options: Callable[[], Any]) -> None:
        super().__init__()
        self.session = session
        self.new_options = new_options
        self.options = new_options()

    def forward(self, *tensors: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Return the only output, or all of them in their order, for its inputs in
        their order.
        """
        self.options = self.new_options()
        names = [tensor.name for tensor in self.session.get_inputs()]
        named = {
            name: tensor.detach().cpu().numpy()
            for name, tensor in zip(names, tensors, strict=True)
        }
        outputs = tuple(
            torch.from_numpy(output)
            for output in self.session.run(None, named, self.options)
        )
        return outputs[0] if len(outputs) == 1 else outputs

    def stop(self) -> None:
        """End the run that is going on: a file's program may never end."""
        self.options.terminate = True


def load_onnx(path: Path) -> Source:
    """Return the network in an ONNX file that is known to be an ordinary one;
    onnxruntime holds its other files to its folder. Raises FileFormatError where it is
    damaged, or refers to files that are elsewhere, and ModelError where onnxruntime is
    missing or too old, or the network does not take one batch of images.
    """
    runtime = library("onnxruntime", str(path), "onnx")
    release = re.match(r"(\d+)\.(\d+)", runtime.__version__)
    if release is None or (int(release[1]), int(release[2])) < OLDEST:
        raise ModelError(
            f"model {path}: needs onnxruntime {'.'.join(map(str, OLDEST))} or newer, "
            f"got {runtime.__version__}, which "
            "may read weights from anywhere that a file names: pip install -U "
            "'advsearch[onnx]'"
        )
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 4  # what is wrong is raised as well
    what = (
        f"model file {path}: cannot be read as ONNX with onnxruntime "
        f"{runtime.__version__}"
    )
    with foreign(what, kind=FileFormatError):
        # What is constant is computed in each call, which has a deadline: while a
        # session is made, nothing ends it.
        session = runtime.InferenceSession(
            str(path),
            options,
            providers=["CPUExecutionProvider"],
            disabled_optimizers=["ConstantFolding"],
            enable_fallback=0,  # it would print, and try the same again
        )
    inputs = session.get_inputs()
    shape = inputs[0].shape if inputs else []
    fixed = [side for side in shape if isinstance(side, int)]
    eight_bit = bool(inputs) and inputs[0].type == "tensor(uint8)"
    is_image = (
        len(shape) == 4
        and (eight_bit or inputs[0].type in FLOATS)
        and min(fixed, default=1) > 0
    )
    more = inputs[1:]
    is_size = (
        len(more) == 1 and more[0].name in SIZE_INPUTS and more[0].type in SIZE_TYPES
    )
    is_size = is_size and len(more[0].shape) == 2 and more[0].shape[1] in (2, None)
    if not is_image or (more and not is_size):
        got = (
            ", ".join(
                f"{tensor.name} {tensor.type} {tensor.shape}" for tensor in inputs
            )
            or "none"
        )
        raise ModelError(
            f"model file {path}: expected one input, a batch of floating-point images "
            "of 4 dimensions (or of uint8), "
            f"got {got}{_second_input([tensor.name for tensor in inputs])}"
        )
    layout = "NHWC" if shape[3] == 3 and shape[1] != 3 else "NCHW"
    sides = shape[1:3] if layout == "NHWC" else shape[2:4]
    metadata = session.get_modelmeta().custom_metadata_map
    # YOLO's exporters write it, such as "[640, 640]"
    if not all(isinstance(side, int) for side in sides):
        written = re.fullmatch(r"\[(\d{1,5}), ?(\d{1,5})\]", metadata.get("imgsz", ""))
        sides = [int(side) for side in written.groups()] if written else []
        sides = sides if all(sides) else []
    source = Source(
        OnnxNetwork(session, runtime.RunOptions),
        path.stem,
        input_size=(sides[0], sides[1]) if sides else None,
        layout=layout,
        labels=names_in(metadata.get("names", "")),
        batch_limits=(shape[0], shape[0])
        if isinstance(shape[0], int)
        else (1, LARGEST_BATCH),
        dtype=torch.float32 if eight_bit else FLOATS[inputs[0].type],
        size_type=SIZE_TYPES[more[0].type] if more else None,
    )
    return as_eight_bit(source) if eight_bit else source
