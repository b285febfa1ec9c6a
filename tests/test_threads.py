"""Thread counts and how idle threads wait."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from advsearch import threads

SHOW = (
    "import json, os, sys; from advsearch import threads; assert 'torch' not in sys.modules\n"
    "print(json.dumps([threads.configure(), {n: os.environ.get(n) for n in threads.OPENMP_DEFAULTS}]))"
)


def in_new_process(**variables: str) -> list[object]:
    """The count that `configure` chooses in a process with these variables, and what OpenMP will read there."""
    ours = (*threads.OPENMP_DEFAULTS, "GOMP_SPINCOUNT", "OMP_NUM_THREADS")
    environ = {name: value for name, value in os.environ.items() if name not in ours} | variables
    done = subprocess.run([sys.executable, "-c", SHOW], capture_output=True, text=True, check=True, env=environ)
    answer: list[object] = json.loads(done.stdout)
    return answer


def test_every_core_and_openmp_set_without_importing_torch() -> None:
    assert in_new_process() == [threads.count_cores(), threads.OPENMP_DEFAULTS]


def test_what_the_user_has_set_is_left_alone() -> None:
    kept = {"OMP_WAIT_POLICY": "ACTIVE", "KMP_BLOCKTIME": threads.OPENMP_DEFAULTS["KMP_BLOCKTIME"]}
    assert in_new_process(OMP_WAIT_POLICY="ACTIVE", OMP_NUM_THREADS="1") == [1, kept]
    assert in_new_process(GOMP_SPINCOUNT="7") == [threads.count_cores(), dict.fromkeys(threads.OPENMP_DEFAULTS)]


@pytest.mark.parametrize(("count", "rendering", "expected"), [(1, True, 1), (4, True, 2), (4, False, 4)])
def test_a_torch_that_is_loaded_gets_its_share(count: int, rendering: bool, expected: int) -> None:
    import torch

    before = os.environ.get("OMP_NUM_THREADS")
    try:
        assert threads.configure(count, rendering=rendering) == count
        assert torch.get_num_threads() == expected
        assert "OMP_NUM_THREADS" not in os.environ or os.environ["OMP_NUM_THREADS"] == before
    finally:
        threads.configure()


@pytest.mark.parametrize(("text", "expected"), [("100000 100000\n", 1), ("20000 100000", 1), ("max 100000\n", None)])
def test_a_containers_quota_bounds_the_cores(tmp_path: Path, text: str, expected: int | None) -> None:
    quota = tmp_path / "cpu.max"
    quota.write_text(text)
    assert threads.count_cores(quota) == (expected or threads.count_cores(tmp_path / "absent"))


def test_a_file_that_asks_for_very_many_threads_gets_a_few_for_each_core() -> None:
    try:
        assert threads.configure(1024) == threads.MAX_THREADS_PER_CORE * threads.count_cores()
    finally:
        threads.configure()


@pytest.mark.medium
@pytest.mark.parametrize("photograph", [False, True])
@pytest.mark.parametrize(
    "control",
    ["light", "material", "texture", pytest.param("spot", marks=pytest.mark.island("advsearch.controls.projector"))],
)
def test_an_adjoint_does_not_depend_on_the_number_of_threads(control: str, photograph: bool, tmp_path: Path) -> None:
    """It is added up by several threads: of small sums Dr.Jit has a copy for each, unless it is told otherwise."""
    import torch
    from PIL import Image

    import advsearch

    Image.new("RGB", (32, 32), (120, 160, 90)).save(tmp_path / "a.png")
    scene = advsearch.load_scene("mug", backdrop=tmp_path / "a.png" if photograph else None)
    render = scene.renderer(control, resolution=32, denoise="none")
    adjoint = [group for group in render.plan.groups if group.estimator == "adjoint"]
    sums = list[list[float]]()
    try:
        for count in (1, 2, 4):
            threads.configure(count)
            u = torch.full((len(render.start),), 0.4).requires_grad_()
            (gradient,) = torch.autograd.grad(render(u, 1, 16).sum(), u)
            sums.append([float(gradient[group.coordinates].sum()) for group in adjoint])
    finally:
        threads.configure()
    assert adjoint and all(sums[0])
    for other in sums[1:]:
        assert other == pytest.approx(sums[0], rel=1e-3)
