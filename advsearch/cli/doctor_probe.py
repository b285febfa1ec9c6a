"""The trials of `advsearch doctor`, which run in a process of their own.

A libLLVM that is too old crashes the process. Each trial prints one line of JSON: the
name of the component, whether it works, and a detail or the error. The first line that
is missing belongs to the component that crashed the process. `advsearch.cli.doctor`
runs this module as a program, and never imports it.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

PIXELS = 8
# Four standard deviations of the brightness of these pixels at 4 samples per pixel.
# Those of its derivative are twice as large.
NOISE = 0.08


def probe_import(name: str) -> str:
    importlib.import_module(name)
    return "imported"


def probe_renderer() -> str:
    """Render a wall in uniform light, and the derivative by the wall's reflectance.

    The brightness is reflectance times radiance. With reflectance 0.5 and radiance 1 it
    is 0.5, and its derivative by the reflectance is 1.

    Returns:
        The variant of Mitsuba, the version of LLVM and the threads that were used.

    Raises:
        ArithmeticError: the numbers differ by more than noise.
    """
    # what is probed
    from advsearch.scene.mitsuba_backend.variant import VARIANT, import_mitsuba

    mi = import_mitsuba()
    import drjit as dr  # what is probed

    brightness, slope = _render_wall(mi, dr)
    _check_wall(brightness, slope)
    version = ".".join(map(str, dr.detail.llvm_version()))
    return (
        f"{PIXELS} x {PIXELS} pixels and their gradient, {VARIANT}, LLVM {version}, "
        f"{dr.thread_count()} threads"
    )


def _check_wall(brightness: float, slope: float) -> None:
    """Check the brightness of the wall, and its derivative by the reflectance.

    Raises:
        ArithmeticError: they differ from 0.5 and 1 by more than noise.
    """
    is_brightness_right = abs(brightness - 0.5) < NOISE
    is_slope_right = abs(slope - 1.0) < 2 * NOISE
    if not (is_brightness_right and is_slope_right):
        raise ArithmeticError(
            f"expected brightness 0.5 and slope 1, got {brightness:.4f} and {slope:.4f}"
        )


def _render_wall(mi: Any, dr: Any) -> tuple[float, float]:
    """Return the mean brightness of the wall, and its derivative by the reflectance.

    Args:
        mi: the module of Mitsuba.
        dr: the module of Dr.Jit.
    """
    scene = mi.load_dict(_describe_wall(mi), optimize=False)
    parameters = mi.traverse(scene)
    key = "wall.bsdf.reflectance.value"
    dr.enable_grad(parameters[key])
    image = mi.render(scene, parameters, spp=4, seed=0)
    dr.backward(dr.mean(image, axis=None))
    brightness = float(image.numpy().mean())
    slope = float(dr.sum(dr.grad(parameters[key])).numpy().sum())
    return brightness, slope


def _describe_wall(mi: Any) -> dict[str, Any]:
    """Return a scene for Mitsuba: a wall of reflectance 0.5 in uniform light.

    Args:
        mi: the module of Mitsuba.
    """
    wall = {
        "type": "rectangle",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
    }
    return {
        "type": "scene",
        "wall": wall,
        "sensor": _describe_wall_sensor(mi),
        "light": {"type": "constant"},
        # depth 2: light that is reflected once
        "integrator": {"type": "prb", "max_depth": 2},
    }


def _describe_wall_sensor(mi: Any) -> dict[str, Any]:
    """Return a camera for Mitsuba that looks at the wall from a distance of 2.

    Args:
        mi: the module of Mitsuba.
    """
    film = {
        "type": "hdrfilm",
        "width": PIXELS,
        "height": PIXELS,
        "rfilter": {"type": "box"},
    }
    view = mi.ScalarTransform4f().look_at(
        origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0]
    )
    return {"type": "perspective", "fov": 30, "to_world": view, "film": film}


def probe_denoiser() -> str:
    """Denoise a constant picture, which must not change."""
    # what is probed
    import mitsuba_oidn
    import numpy as np

    result = np.asarray(
        mitsuba_oidn.denoise(np.full((32, 32, 3), 0.5, np.float32), hdr=True)
    )
    if result.shape != (32, 32, 3) or not np.allclose(result, 0.5, atol=0.05):
        raise ArithmeticError("a constant picture did not stay constant")
    return ""


MODULES = {
    "imageio": "imageio.v3",
    "matplotlib": "matplotlib.figure",
    "pyarrow": "pyarrow.parquet",
}
"""The module of a package to import, if it is not the package itself."""

PACKAGES = (
    "numpy",
    "torch",
    "OpenEXR",
    "imageio",
    "matplotlib",
    "cma",
    "pyarrow",
    "xatlas",
)

TRIALS: dict[str, Callable[[], str]] = {
    **{name: partial(probe_import, MODULES.get(name, name)) for name in PACKAGES},
    "render": probe_renderer,
    "mitsuba-oidn": probe_denoiser,
}
"""The trial of each component, in the order in which they run. Those that may crash the
process are the last.
"""


def main() -> int:
    """Run every trial, and print a line of JSON for each.

    A trial imports or uses one component, and returns a detail as text. If it raises an
    error, the next ones still run.
    """
    for name, trial in TRIALS.items():
        print(json.dumps(_run_trial(name, trial)), flush=True)
    return 0


def _run_trial(name: str, trial: Callable[[], str]) -> dict[str, str | bool]:
    """Return the name of a component, whether it works, and a detail or the error."""
    # Standard output is for the lines of JSON. What a library prints is dropped.
    discarded_output = io.StringIO()
    try:
        with contextlib.redirect_stdout(discarded_output):
            return {"name": name, "ok": True, "detail": trial()}
    except Exception as error:
        detail = f"{type(error).__name__}: {error}"
        return {"name": name, "ok": False, "detail": detail}


if __name__ == "__main__":
    sys.exit(main())
