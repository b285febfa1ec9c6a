"""Models in ONNX files: run by onnxruntime, which gives answers and no gradients."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from advsearch.errors import FileFormatError, ModelError
from advsearch.models.labels import names_in
from advsearch.models.probe import first_line
from advsearch.models.source import Source
from advsearch.models.zoo.library import library

FLOATS = {"tensor(float)": torch.float32, "tensor(float16)": torch.float16, "tensor(double)": torch.float64}
LARGEST_BATCH = 64

OLDEST = (1, 24)
"""The first onnxruntime that reads no weights from outside the folder of a file; older ones follow `../` and links."""


class OnnxNetwork(nn.Module):
    """A session of onnxruntime as a function from a batch of images to its outputs; no gradient goes through it.

    Args:
        session: the session.
        new_options: makes options of a run, by which it can be ended.
    """

    def __init__(self, session: Any, new_options: Callable[[], Any]) -> None:
        super().__init__()
        self.session, self.new_options = session, new_options
        self.options = new_options()

    def forward(self, images: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Return the only output, or all of them in their order."""
        self.options = self.new_options()
        given = {self.session.get_inputs()[0].name: images.detach().cpu().numpy()}
        outputs = tuple(torch.from_numpy(output) for output in self.session.run(None, given, self.options))
        return outputs[0] if len(outputs) == 1 else outputs

    def stop(self) -> None:
        """End the run that is going on: a file's program may never end."""
        self.options.terminate = True


def load(path: Path) -> Source:
    """Return the network in an ONNX file that is known to be an ordinary one; onnxruntime holds its other files to its
    folder.

    Raises:
        FileFormatError: it is damaged, or refers to files that are elsewhere.
        ModelError: onnxruntime is missing or too old, or the network does not take one batch of images.
    """
    runtime = library("onnxruntime", str(path), "onnx")
    _check_version(path, runtime.__version__)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 4  # what is wrong is raised as well
    try:
        # What is constant is computed in each call, which has a deadline: while a session is made, nothing ends it.
        session = runtime.InferenceSession(
            str(path),
            options,
            providers=["CPUExecutionProvider"],
            disabled_optimizers=["ConstantFolding"],
            enable_fallback=0,  # it would print, and try the same again
        )
    except Exception as error:  # its errors have no type in common
        raise FileFormatError(
            f"model file {path}: cannot be read as ONNX with onnxruntime {runtime.__version__} ({first_line(error)})"
        ) from error
    inputs = session.get_inputs()
    shape = inputs[0].shape if inputs else []
    fixed = [side for side in shape if isinstance(side, int)]
    if len(inputs) != 1 or len(shape) != 4 or inputs[0].type not in FLOATS or min(fixed, default=1) < 1:
        found = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs) or "none"
        raise ModelError(
            f"model file {path}: expected one input, a batch of floating-point images of 4 dimensions, got {found}"
        )
    layout = "NHWC" if shape[3] == 3 and shape[1] != 3 else "NCHW"
    sides = shape[1:3] if layout == "NHWC" else shape[2:4]
    said = session.get_modelmeta().custom_metadata_map
    if not all(isinstance(side, int) for side in sides):
        sides = sizes_in(said.get("imgsz", ""))
    return Source(
        OnnxNetwork(session, runtime.RunOptions),
        path.stem,
        input_size=(sides[0], sides[1]) if sides else None,
        layout=layout,
        labels=names_in(said.get("names", "")),
        batch_limits=(shape[0], shape[0]) if isinstance(shape[0], int) else (1, LARGEST_BATCH),
        dtype=FLOATS[inputs[0].type],
    )


def sizes_in(text: str) -> tuple[int, int] | None:
    """Return (height, width) of what YOLO's exporters write as `imgsz`, such as "[640, 640]"; None of anything else."""
    found = re.fullmatch(r"\[(\d{1,5}), ?(\d{1,5})\]", text)
    return (int(found[1]), int(found[2])) if found and min(int(found[1]), int(found[2])) > 0 else None


def _check_version(path: Path, version: str) -> None:
    """Refuse an onnxruntime before `OLDEST`."""
    found = re.match(r"(\d+)\.(\d+)", version)
    if found is None or (int(found[1]), int(found[2])) < OLDEST:
        raise ModelError(
            f"model {path}: needs onnxruntime {'.'.join(map(str, OLDEST))} or newer, got {version}, which may read "
            "weights from anywhere that a file names: pip install -U 'advsearch[onnx]'"
        )
