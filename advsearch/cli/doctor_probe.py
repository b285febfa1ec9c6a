"""What `advsearch doctor` tries in a process of its own, because a libLLVM that is too old takes its process down.

Each part that was tried prints one line of JSON: its name, whether it worked, and a detail or the error. A line that is
missing at the end names the part that ended the process. Run by `advsearch.cli.doctor`, never imported by it.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import tempfile
from collections.abc import Callable

from advsearch import threads

PIXELS = 8
NOISE = 0.08
"""Four standard deviations of the brightness of those pixels at 4 samples; the slope's are twice as large."""


def numpy() -> str:
    """Solve a small system."""
    import numpy as np  # what is probed

    if not np.allclose(np.linalg.solve(np.diag([2.0, 4.0]), [2.0, 4.0]), 1.0):
        raise ArithmeticError("a system of two equations came out wrong")
    return ""


def torch() -> str:
    """A convolution and its gradient; say which build it is and how many threads it uses."""
    threads.configure()
    import torch  # what is probed

    image = torch.ones(1, 3, PIXELS, PIXELS, requires_grad=True)
    torch.nn.functional.conv2d(image, torch.ones(1, 3, 3, 3)).sum().backward()
    if image.grad is None or float(image.grad.max()) != 9.0:
        raise ArithmeticError("the gradient of a convolution came out wrong")
    count = torch.get_num_threads()
    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU build"
    return f"{build}, {count} thread{'s' * (count > 1)}"


def probe_renderer() -> str:
    """Render a few pixels of a lit wall and differentiate them with respect to its colour, which is linear."""
    from advsearch.scene.mitsuba_backend.variant import VARIANT, mitsuba  # what is probed

    mi = mitsuba()
    import drjit as dr  # what is probed

    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0])
    sensor = {"type": "perspective", "fov": 30, "to_world": view, "film": film}
    light = {"type": "constant"}
    integrator = {"type": "prb", "max_depth": 2}
    scene = mi.load_dict(
        {"type": "scene", "wall": wall, "sensor": sensor, "light": light, "integrator": integrator}, optimize=False
    )
    parameters, key = mi.traverse(scene), "wall.bsdf.reflectance.value"
    dr.enable_grad(parameters[key])
    image = mi.render(scene, parameters, spp=4, seed=0)
    dr.backward(dr.mean(image, axis=None))
    brightness, slope = float(image.numpy().mean()), float(dr.sum(dr.grad(parameters[key])).numpy().sum())
    if not (abs(brightness - 0.5) < NOISE and abs(slope - 1.0) < 2 * NOISE):
        raise ArithmeticError(f"expected brightness 0.5 and slope 1, got {brightness:.4f} and {slope:.4f}")
    version = ".".join(map(str, dr.detail.llvm_version()))
    return f"{PIXELS} x {PIXELS} pixels and their gradient, {VARIANT}, LLVM {version}, {dr.thread_count()} threads"


def probe_denoiser() -> str:
    """Denoise a constant picture, which must stay what it is."""
    # what is probed
    import mitsuba_oidn
    import numpy as np

    result = np.asarray(mitsuba_oidn.denoise(np.full((32, 32, 3), 0.5, np.float32), hdr=True))
    if result.shape != (32, 32, 3) or not np.allclose(result, 0.5, atol=0.05):
        raise ArithmeticError("a constant picture did not stay constant")
    return ""


def openexr() -> str:
    """Write a linear picture to a file and read it back."""
    # what is probed
    import numpy as np
    import OpenEXR

    pixels = np.full((2, 2, 3), 2.5, np.float32)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "pixel.exr")
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": pixels}).write(path)
        with OpenEXR.File(path) as file:
            if not np.array_equal(file.channels()["RGB"].pixels, pixels):
                raise ArithmeticError("a picture read back is not the one written")
    return ""


def imageio() -> str:
    """Encode a picture as PNG and decode it."""
    # what is probed
    import imageio.v3 as iio
    import numpy as np

    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    if not np.array_equal(iio.imread(iio.imwrite("<bytes>", pixels, extension=".png")), pixels):
        raise ArithmeticError("a PNG decoded is not the picture encoded")
    return ""


def pyarrow() -> str:
    """Write a Parquet table and read it back."""
    # what is probed
    import pyarrow
    import pyarrow.parquet

    stream = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table({"x": [1.5]}), stream)
    found = pyarrow.parquet.read_table(io.BytesIO(stream.getvalue())).to_pylist()
    if found != [{"x": 1.5}]:
        raise RuntimeError(f"expected the table that was written, got {found}")
    return "writes and reads a table"


def matplotlib() -> str:
    """Draw an empty figure."""
    from matplotlib.figure import Figure  # what is probed

    stream = io.BytesIO()
    Figure(figsize=(1, 1)).savefig(stream, format="png")
    return f"drew {len(stream.getvalue())} bytes"


def cma() -> str:
    """Import the library of evolution strategies."""
    import cma as library  # what is probed

    return f"pycma {library.__version__.split()[0]}"


def xatlas() -> str:
    """Unwrap a triangle."""
    # what is probed
    import numpy as np
    import xatlas

    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    _, faces, uvs = xatlas.parametrize(corners, np.array([[0, 1, 2]], np.uint32))
    if faces.shape != (1, 3) or uvs.shape != (3, 2):
        raise ArithmeticError("a triangle was not unwrapped")
    return ""


TRIALS: dict[str, Callable[[], str]] = {
    "numpy": numpy,
    "torch": torch,
    "OpenEXR": openexr,
    "imageio": imageio,
    "matplotlib": matplotlib,
    "cma": cma,
    "pyarrow": pyarrow,
    "xatlas": xatlas,
    "render": probe_renderer,
    "mitsuba-oidn": probe_denoiser,
}
"""Part and trial, in the order tried: what may end the process comes last."""


def main() -> int:
    """Try every part; an error of one does not keep the next from being tried."""
    for name, trial in TRIALS.items():
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                answer = {"name": name, "ok": True, "detail": trial()}
        except Exception as error:
            answer = {"name": name, "ok": False, "detail": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
