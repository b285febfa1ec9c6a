"""Load models from files: `torch.export` archives (.pt2), TorchScript and ONNX.

Archives are recognized by their content, ONNX by its suffix. No Python object is ever
unpickled: archives that need it are rejected. Still, a model file is a program: open
only files whose authors you trust. ONNX files are run by onnxruntime, which returns
predictions but no gradients.
"""

from __future__ import annotations

import difflib
import logging
import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, cast

import torch
from torch import Tensor, nn

from advsearch.errors import FileFormatError, ModelError
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.inputs import SIZE_INPUTS, SIZE_TYPES, EightBitInput
from advsearch.models.labels import parse_names
from advsearch.models.source import Source, import_library, make_source
from advsearch.trust import exported_programs
from advsearch.trust.archives import (
    MAX_ARCHIVE_BYTES,
    Archive,
    make_archive_error,
    open_archive,
    rewrite_torchscript,
    without_unpickling,
)
from advsearch.trust.foreign_code import translate_errors, try_torchscript
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

# Suffixes of files that are pickles in most cases.
PICKLE_SUFFIXES = (".pkl", ".pickle", ".pth", ".ckpt", ".bin")

EXPORT_HINT = (
    "Export the network instead: torch.export.save(torch.export.export(net.eval(), "
    "(example,)), 'net.pt2'); or pass the nn.Module through the Python API; or store "
    "its state dict as safetensors and name what builds it: "
    "'package.module:callable@weights.safetensors'"
)

MAX_BATCH = 64  # maximum batch size of a program whose batch dimension is free


def load_file(path: Path) -> Source:
    """Load the model in a file: a torch.export archive, TorchScript, or ONNX.

    The kind of an archive is recognized by its content, ONNX by its suffix.

    Raises:
        FileFormatError: the file is missing, empty, truncated, corrupt, a pickle, or of
            another kind; the message names it.
        ModelError: the program does not take one floating-point image.
    """
    with _open_file(path) as file:
        head = file.read(16)  # enough to recognize the kind of a file
        if not head:
            raise FileFormatError(
                f"model file {path}: expected a model, got an empty file"
            )
        if path.suffix.lower() == ".onnx":
            return load_onnx(path)
        is_zip_archive = head[:2] == b"PK"
        if not is_zip_archive:
            raise FileFormatError(f"model file {path}: {_describe_file(path, head)}")
        archive = open_archive(path, file, os.fstat(file.fileno()).st_size)
        if _find_archive_kind(archive) == "torchscript":
            return _load_torchscript(archive)
        return _load_exported(archive)


def _open_file(path: Path) -> BinaryIO:
    """Open a model file; raise FileFormatError if it is missing or cannot be read."""
    try:
        return open_regular(path, "a model file", MAX_ARCHIVE_BYTES)
    except FileNotFoundError:
        raise FileFormatError(
            f"model file {path}: no such file.{_make_missing_hint(path)}"
        ) from None
    except OSError as error:
        raise FileFormatError(
            f"model file {path}: cannot be read ({error.strerror or error})"
        ) from None


def _load_exported(archive: Archive) -> Source:
    """Load the network in an archive of torch.export.

    The archive is first rewritten without anything that would have to be unpickled.
    """
    path = archive.path
    checked = exported_programs.rewrite_program(archive)
    with (
        _report_corrupt(path, "torch.export"),
        without_unpickling(),
        _silence_logger("torch.export"),
    ):
        program = torch.export.load(checked)
        module = program.module()
    return _apply_signature(make_source(module, path.stem), program)


@contextmanager
def _silence_logger(name: str) -> Iterator[None]:
    """Silence a logger inside the context, and give it its level back afterwards.

    torch logs the traceback of an error, and the user gets a message instead.
    """
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _make_missing_hint(path: Path) -> str:
    """Return a hint for a path that does not exist: names like it, if there are any."""
    if not path.parent.is_dir():
        return f" The folder {path.parent} does not exist either"
    names = [entry.name for entry in path.parent.iterdir()]
    similar = difflib.get_close_matches(path.name, names, n=3, cutoff=0.6)
    if not similar:
        return ""
    paths = [repr(str(path.parent / name)) for name in similar]
    return f" Did you mean {' or '.join(paths)}?"


def _load_torchscript(archive: Archive) -> Source:
    """Load the network in a TorchScript archive.

    Some archives run code as they are loaded. That code may never end, so that such an
    archive is loaded in another process first, which has a deadline.

    Raises:
        FileFormatError: it is corrupt, or loading it fails or does not end.
    """
    path = archive.path
    checked, runs_while_loading = rewrite_torchscript(archive)
    if runs_while_loading:
        problem = try_torchscript(checked)
        if problem:
            raise FileFormatError(f"model file {path}: {problem}")
    with warnings.catch_warnings(), _report_corrupt(path, "TorchScript"):
        # Older versions of torch warn that TorchScript is deprecated by the first
        # category; 2.14 and later by the second one.
        message = r".*torch\.jit\.\w+.* is deprecated"
        for category in (DeprecationWarning, FutureWarning):
            warnings.filterwarnings("ignore", message=message, category=category)
        module = torch.jit.load(checked, map_location="cpu")
    return make_source(module, path.stem)


def _find_archive_kind(archive: Archive) -> str:
    """Return the kind of an archive, "exported" or "torchscript".

    It follows from the names of its members.

    Raises:
        FileFormatError: it is of another kind, such as a pickle that `torch.save` made.
    """
    names = archive.members
    if any(name.startswith("models/") and name.endswith(".json") for name in names):
        _check_no_code(archive)
        return "exported"
    # older versions of torch.export
    if "serialized_exported_program.json" in names:
        return "exported"
    if "constants.pkl" in names and any(name.startswith("code/") for name in names):
        return "torchscript"
    raise _make_archive_kind_error(archive)


def _make_archive_kind_error(archive: Archive) -> FileFormatError:
    """Return the error of an archive that is neither torch.export nor TorchScript."""
    path = archive.path
    if "data.pkl" in archive.members:
        return FileFormatError(
            f"model file {path}: is a pickle (made by torch.save), which is never "
            f"opened. {EXPORT_HINT}"
        )
    return FileFormatError(
        f"model file {path}: a zip archive, but neither torch.export "
        f"nor TorchScript. {EXPORT_HINT}"
    )


def _check_no_code(archive: Archive) -> None:
    """Raise FileFormatError if an exported program has pickles or compiled code.

    Both would run whatever their author wants when they are loaded.
    """
    pickle_prefixes = ("opaque_obj", "custom_obj")
    members_with_code = [
        name
        for name in archive.members
        if name.startswith("data/aotinductor/")
        or Path(name).name.startswith(pickle_prefixes)
    ]
    if members_with_code:
        raise make_archive_error(
            archive.path,
            f"holds {min(members_with_code)!r}, which is a pickled object "
            "or compiled code and never loaded",
        )


def _describe_file(path: Path, head: bytes) -> str:
    """Describe what a file that is no zip archive may be, and what to do about it.

    Args:
        path: path of the file, whose suffix matters.
        head: its first 16 bytes.
    """
    suffix = path.suffix.lower()
    if _is_safetensors(head):
        return (
            "safetensors hold weights but no network; name what builds it: "
            "'package.module:callable@weights.safetensors' or "
            "'torchvision:NAME@weights.safetensors'"
        )
    if suffix == ".py":
        return (
            "is Python code; name what makes the network in it: "
            f"'{path.stem}:NAME', from the folder of the file"
        )
    # The first byte of a pickle is 0x80.
    if head[:1] == b"\x80" or suffix in PICKLE_SUFFIXES:
        return (
            f"is a pickle, or something like it, which is never opened. {EXPORT_HINT}"
        )
    return (
        "expected a torch.export archive (.pt2) or TorchScript, got other bytes. "
        f"{EXPORT_HINT}"
    )


def _is_safetensors(head: bytes) -> bool:
    """Return whether a file is of safetensors, by its first 16 bytes.

    It begins with the length of its header in eight bytes, then the header, a JSON
    object.
    """
    header_length = int.from_bytes(head[:8], "little")
    return head[8:9] == b"{" and header_length < 1 << 30


def _apply_signature(source: Source, program: torch.export.ExportedProgram) -> Source:
    """Return the source with input size, layout, batch limits and dtype of a program.

    An exported program states the shape and dtype of its inputs. A program may take the
    K images of a rig (several cameras) at once, (N, K, 3, H, W) or (N, K, H, W, 3):
    then it is wrapped as a network of single images.

    Args:
        source: source of the network.
        program: the exported program.

    Raises:
        ModelError: it takes something other than images.
    """
    nodes = {
        node.name: node for node in program.graph.nodes if node.op == "placeholder"
    }
    names = [name for name in program.graph_signature.user_inputs if name in nodes]
    # Example values with shape and dtype, as torch.export records them ("val").
    examples = [nodes[name].meta.get("val") for name in names]
    takes_rigs = _check_inputs(source, names, examples)
    images = examples[0]
    source = _apply_second_input(source, names, examples)
    source = _apply_image_input(source, images, is_rig=takes_rigs)
    min_batch, max_batch = _find_batch_limits(program, images.shape[0])
    source = replace(source, batch_limits=(min_batch, max_batch))
    if takes_rigs:
        return _wrap_rig_network(source, cameras=int(images.shape[1]))
    return source


def _apply_second_input(
    source: Source, names: list[str], examples: list[Any]
) -> Source:
    """Return the source with what the input after the images is, if there is one.

    Args:
        source: source of the network.
        names: names of all inputs.
        examples: example values of all inputs.
    """
    # A second input (N, 2) with such a name is the size of each image.
    takes_sizes = (
        len(names) == 2 and names[1] in SIZE_INPUTS and examples[1].shape[1] == 2
    )
    if takes_sizes:
        # The size of each image is known, so that it can be passed too.
        return replace(source, size_type=examples[1].dtype)
    # Any other second input must come from the user as a `state` (`takes_more`).
    # `make_source` may have guessed from the names of inputs that sizes are taken.
    return replace(source, takes_more=len(examples) > 1, size_type=None)


def _wrap_rig_network(source: Source, cameras: int) -> Source:
    """Return the source of a network of rigs, wrapped as a network of single images.

    Args:
        source: source of the network, whose batch limits count rigs.
        cameras: number of cameras, and so of images, of a rig.
    """
    # `AllAtOnce` takes images (N, 3, H, W), the default layout, and converts them.
    layout = "NKHWC" if source.layout == "NHWC" else "NKCHW"
    min_rigs, max_rigs = source.batch_limits
    return replace(
        source,
        module=AllAtOnce(cast(nn.Module, source.module), cameras, layout),
        layout=None,
        batch_limits=(min_rigs * cameras, max_rigs * cameras),
    )


def _apply_image_input(source: Source, images: Any, *, is_rig: bool) -> Source:
    """Return the source with input size, layout and dtype of an input of images.

    Args:
        source: source of the network.
        images: example value of the input, (N, 3, H, W) or (N, H, W, 3), or the same
            with an axis of K cameras after N.
        is_rig: whether there is an axis of cameras.

    Raises:
        ModelError: its dtype is neither a floating-point one nor uint8.
    """
    is_eight_bit = images.dtype == torch.uint8 and not is_rig
    if not images.is_floating_point() and not is_eight_bit:
        expected = "an image as input, floating-point or uint8, got"
        if is_rig:
            expected = "floating-point images as input, got"
        raise ModelError(f"model {source.name}: expected {expected} {images.dtype}")
    image_shape = images.shape[-3:]
    # Channels come last if the last size is 3 and the first one is not.
    is_channels_last = image_shape[2] == 3 and image_shape[0] != 3
    height, width = image_shape[:2] if is_channels_last else image_shape[1:]
    is_fixed_size = isinstance(height, int) and isinstance(width, int)
    input_size = (height, width) if is_fixed_size else None
    layout = "NHWC" if is_channels_last else "NCHW"
    source = replace(source, input_size=input_size, layout=layout)
    if is_eight_bit:
        return make_eight_bit(source)
    return replace(source, dtype=images.dtype)


def _check_inputs(source: Source, names: list[str], inputs: list[Any]) -> bool:
    """Check the inputs of a program, and return whether it takes rigs.

    A program may take a batch of images with 4 axes, perhaps followed by vectors (N, n)
    such as image sizes. Or it may take rigs with 5 axes: K images each, one for each
    camera.

    Args:
        source: source of the program, for messages.
        names: names of the inputs.
        inputs: example values of each, with their shapes.

    Raises:
        ModelError: it takes something else.
    """
    are_tensors = bool(inputs) and all(isinstance(value, Tensor) for value in inputs)
    takes_rigs = are_tensors and _takes_rigs(inputs)
    takes_images = (
        are_tensors
        and inputs[0].dim() == 4
        and all(value.dim() == 2 for value in inputs[1:])
    )
    if not takes_rigs and not takes_images:
        raise ModelError(
            f"model {source.name}: expected a program with one input, a batch of "
            f"images of 4 dimensions{_advise_on_second_input(names)}"
        )
    return takes_rigs


def _takes_rigs(inputs: list[Any]) -> bool:
    """Return whether tensors are one input of rigs, (N, K, ...) with 5 axes."""
    if len(inputs) != 1 or inputs[0].dim() != 5:
        return False
    # the number of cameras is fixed; a free size is no int but a symbol
    return isinstance(inputs[0].shape[1], int)


def _find_batch_limits(
    program: torch.export.ExportedProgram, batch: Any
) -> tuple[int, int]:
    """Return the minimum and maximum batch size of a program.

    Args:
        program: the exported program, which may limit a free batch size.
        batch: size of the batch axis: an int if it is fixed, else a symbol.
    """
    if isinstance(batch, int):
        return batch, batch
    allowed = program.range_constraints.get(batch.node.expr)
    if allowed is None:
        return 1, MAX_BATCH
    min_batch = max(int(allowed.lower), 1)
    return min_batch, max(min_batch, int(min(allowed.upper, MAX_BATCH)))


def make_eight_bit(source: Source) -> Source:
    """Return the source of a network that takes uint8, wrapped to take float32.

    The wrapper rounds images from 0 to 255.
    """
    return replace(
        source,
        module=EightBitInput(source.module),
        dtype=torch.float32,
        value_range=(0.0, 255.0),
    )


def _advise_on_second_input(names: list[str]) -> str:
    """Return advice about a network whose second input is not known.

    Args:
        names: names of all inputs of the network.

    Returns:
        The advice, to follow a message; "" if there are not exactly two inputs.
    """
    if len(names) != 2:
        return ""
    return (
        f"; its second input {names[1][:60]!r} is not known: of two inputs, the second "
        "may be the size of the pictures, (N, 2) in pixels, (width, height), named "
        "'orig_target_sizes'. Export a network that takes pictures alone"
    )


def _report_corrupt(path: Path, kind: str) -> AbstractContextManager[None]:
    """Return a context that turns errors of torch into a FileFormatError.

    Args:
        path: path of the file that torch reads.
        kind: kind of the file, such as "TorchScript", for the message.
    """
    problem = (
        f"model file {path}: cannot be read as {kind} with torch {torch.__version__}"
    )
    causes = (
        "corrupt, made by another version, or would have to be unpickled, which is "
        "never done"
    )
    return translate_errors(f"{problem}; {causes}", kind=FileFormatError)


FLOATS = {
    "tensor(float)": torch.float32,
    "tensor(float16)": torch.float16,
    "tensor(double)": torch.float64,
}

MIN_VERSION = (1, 24)
"""The first onnxruntime that reads no weights from outside the directory of a file;
older versions follow `../` and links.
"""


class OnnxNetwork(nn.Module):
    """A session of onnxruntime as a function from a batch of images to its outputs.

    No gradient goes through it.

    Args:
        session: the session.
        new_options: creates the options of a run; a run can be ended through them.
    """

    def __init__(self, session: Any, new_options: Callable[[], Any]) -> None:
        super().__init__()
        self.session = session
        self.new_options = new_options
        self.options = new_options()

    def forward(self, *tensors: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Return the output of the network, or a tuple of its outputs.

        Args:
            *tensors: its inputs, in the order of the file.
        """
        # Each run has new options: `stop` sets a flag in the options of a run, and that
        # flag would end this run, too.
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
        """End the current run: the program in a file may never end."""
        self.options.terminate = True


def load_onnx(path: Path) -> Source:
    """Load the network in an ONNX file.

    The caller has checked that it is a regular file. If it names further files with
    weights, onnxruntime reads them only from the same directory.

    Raises:
        FileFormatError: it is corrupt, or refers to files elsewhere.
        ModelError: onnxruntime is missing or too old, or the network does not take one
            batch of images.
    """
    session, runtime = _open_session(path)
    inputs = session.get_inputs()
    _check_onnx_inputs(path, inputs)
    images = inputs[0]
    is_eight_bit = images.type == "tensor(uint8)"
    batch_size = images.shape[0]  # an int, or a name if it is free; so are other sizes
    has_fixed_batch = isinstance(batch_size, int)
    is_channels_last = _is_channels_last(images)
    # Files that YOLO exports state the image size (`imgsz`) and the class names.
    metadata = session.get_modelmeta().custom_metadata_map
    source = Source(
        OnnxNetwork(session, runtime.RunOptions),
        path.stem,
        input_size=_find_onnx_size(images, metadata.get("imgsz", "")),
        layout="NHWC" if is_channels_last else "NCHW",
        labels=parse_names(metadata.get("names", "")),
        batch_limits=(batch_size, batch_size) if has_fixed_batch else (1, MAX_BATCH),
        # `make_eight_bit` wraps a network of uint8 so that it takes float32.
        dtype=torch.float32 if is_eight_bit else FLOATS[images.type],
        # a second input is the sizes of the images, see `_check_onnx_inputs`
        size_type=SIZE_TYPES[inputs[1].type] if len(inputs) > 1 else None,
    )
    return make_eight_bit(source) if is_eight_bit else source


def _is_channels_last(images: Any) -> bool:
    """Return whether the channels of an input of images are the last axis.

    `images` is the input as onnxruntime describes it.
    """
    return bool(images.shape[3] == 3 and images.shape[1] != 3)


def _find_onnx_size(images: Any, stated_size: str) -> tuple[int, int] | None:
    """Return the size (height, width) of images that a network takes; None for any.

    Args:
        images: the input as onnxruntime describes it.
        stated_size: the size as metadata states it, for a network whose sizes are free;
            empty if it is not stated.
    """
    input_size = images.shape[1:3] if _is_channels_last(images) else images.shape[2:4]
    has_fixed_size = all(isinstance(size, int) for size in input_size)
    if not has_fixed_size:
        input_size = _parse_image_size(stated_size)
    return (input_size[0], input_size[1]) if input_size else None


def _open_session(path: Path) -> tuple[Any, Any]:
    """Open a network with onnxruntime.

    Returns:
        The session that runs the network, and the module `onnxruntime`.

    Raises:
        ModelError: onnxruntime is missing or too old.
        FileFormatError: the file is corrupt.
    """
    runtime = import_library("onnxruntime", str(path), "onnx")
    _check_version(runtime.__version__, path)
    options = _make_session_options(runtime)
    problem = (
        f"model file {path}: cannot be read as ONNX with onnxruntime "
        f"{runtime.__version__}"
    )
    with translate_errors(problem, kind=FileFormatError):
        # This optimizer runs the constant parts of a network while the session is
        # created, which has no deadline: a hostile file could run forever. Without it
        # they are computed in each call, which has a deadline.
        session = runtime.InferenceSession(
            str(path),
            options,
            providers=["CPUExecutionProvider"],
            disabled_optimizers=["ConstantFolding"],
            enable_fallback=0,  # it would print, and try the same again
        )
    return session, runtime


def _make_session_options(runtime: Any) -> Any:
    """Return onnxruntime's options: as many threads as torch has, and no log."""
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 4  # errors are raised as well
    return options


def _check_version(version: str, path: Path) -> None:
    """Raise ModelError if onnxruntime is older than `MIN_VERSION`.

    Args:
        version: its version.
        path: path of the model, for the message.
    """
    release = re.match(r"(\d+)\.(\d+)", version)
    if release is None or (int(release[1]), int(release[2])) < MIN_VERSION:
        raise ModelError(
            f"model {path}: needs onnxruntime {'.'.join(map(str, MIN_VERSION))} or "
            f"newer, got {version}, which may read weights from anywhere "
            "that a file names: pip install -U 'advsearch[onnx]'"
        )


def _check_onnx_inputs(path: Path, inputs: list[Any]) -> None:
    """Check that a network takes images with 4 axes, perhaps with their sizes (N, 2).

    Args:
        path: path of the file, for the message.
        inputs: inputs as onnxruntime describes them, with name, type and shape.

    Raises:
        ModelError: it takes something else.
    """
    other_inputs = inputs[1:]
    takes_images = bool(inputs) and _takes_onnx_images(inputs[0])
    if takes_images and (not other_inputs or _takes_onnx_sizes(other_inputs)):
        return
    got = ", ".join(f"{tensor.name} {tensor.type} {tensor.shape}" for tensor in inputs)
    advice = _advise_on_second_input([tensor.name for tensor in inputs])
    raise ModelError(
        f"model file {path}: expected one input, a batch of floating-point images of 4 "
        f"dimensions (or of uint8), got {got or 'none'}{advice}"
    )


def _takes_onnx_images(tensor: Any) -> bool:
    """Return whether an input, as onnxruntime describes it, is a batch of images."""
    # A size is an integer if it is fixed. If it is free, it is a name, or None.
    fixed_sizes = [size for size in tensor.shape if isinstance(size, int)]
    return (
        len(tensor.shape) == 4
        and (tensor.type == "tensor(uint8)" or tensor.type in FLOATS)
        and all(size > 0 for size in fixed_sizes)
    )


def _takes_onnx_sizes(inputs: list[Any]) -> bool:
    """Return whether the inputs after the images are one, the sizes (N, 2) of these."""
    if len(inputs) != 1:
        return False
    sizes = inputs[0]
    is_known = sizes.name in SIZE_INPUTS and sizes.type in SIZE_TYPES
    return is_known and len(sizes.shape) == 2 and sizes.shape[1] in (2, None)


def _parse_image_size(text: str) -> list[int]:
    """Parse (height, width) in pixels from a text such as "[640, 640]".

    YOLO's exporters write this form. The result is empty if the text has another form,
    or if a size is 0.
    """
    match = re.fullmatch(r"\[(\d{1,5}), ?(\d{1,5})\]", text)
    size = [int(number) for number in match.groups()] if match else []
    return size if all(size) else []
