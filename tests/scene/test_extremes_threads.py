"""Pictures and gradients do not depend on threads, nor break where their number changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from advsearch import threads
from advsearch.engine.gradients import smooth_loss
from advsearch.questions.stability.scene import SIZE, shown, small

HERE = Path(__file__).parent
SHIFT = {"pose": {"x": [-0.3, 0.3]}}
BITS = 1e-5
"""Difference that is one of the last bits: a 400th of an 8-bit level."""


def rendered(path: str, count: int) -> None:
    """Render with so many threads of Dr.Jit and save what comes out in an .npz file; run in a process of its own.

    Of the 40 pictures of a moved mesh: that their last bits differ is a matter of chance.
    """
    threads.configure(count)
    loss = smooth_loss((SIZE, SIZE))
    raw, denoised = small({"texture": {"resolution": 16}}), small(SHIFT, denoise="oidn")
    arrays = {"raw": shown(raw, raw.start, 0, 8), "denoised": shown(denoised, denoised.start, 0, 8)}
    arrays["moved"] = torch.stack([shown(denoised, place[None], 0, 8) for place in torch.linspace(0.1, 0.9, 40)])
    arrays["adjoint"], arrays["again"] = (raw.gradient(loss, raw.start, 0, 8)[1] for _ in range(2))
    np.savez(path, allow_pickle=False, **{name: values.numpy() for name, values in arrays.items()})


def changed_threads() -> None:
    """Render a scene again and again while the number of threads changes; run in a process of its own."""
    threads.configure(2)
    renderer = small(SHIFT)
    for count in (2, 1, 2, 1, 2, 1):
        threads.configure(count)
        shown(renderer, renderer.start, 0, 8)


def in_a_process(call: str) -> None:
    """Call a function of this file in a process of its own, which has to end well."""
    code = f"import sys; sys.path.insert(0, {str(HERE)!r}); import {Path(__file__).stem} as this; this.{call}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-500:]


@pytest.mark.slow
def test_one_thread_and_two_make_the_same_pictures(tmp_path: Path) -> None:
    """The same bits every time with one thread; with two, adjoints may differ in the last.

    A moved mesh is sorted anew by all threads, which could decide which of two triangles a ray meets on their common
    edge (seen in no picture so far); so the limit is `BITS` there.
    """
    made = []
    for number, count in enumerate((1, 1, 2)):
        path = tmp_path / f"{number}.npz"
        in_a_process(f"rendered({str(path)!r}, {count})")
        with np.load(path) as arrays:
            made.append(dict(arrays))
    once, again, two = made
    assert all(np.isfinite(array).all() for arrays in made for array in arrays.values())
    assert all(np.array_equal(once[name], again[name]) for name in once)
    assert np.array_equal(once["adjoint"], once["again"])
    assert all(np.array_equal(once[name], two[name]) for name in ("raw", "denoised"))
    assert np.abs(once["adjoint"] - two["adjoint"]).max() <= BITS * np.abs(once["adjoint"]).max()
    assert np.abs(once["moved"] - two["moved"]).max() <= BITS


@pytest.mark.slow
def test_threads_may_change_under_a_scene() -> None:
    in_a_process("changed_threads()")
