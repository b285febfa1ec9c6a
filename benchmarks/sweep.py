"""The loop of a sweep: what it adds to rendering and classifying, and that its memory
does not grow.

    python benchmarks/sweep.py --constant [--configurations 200000]
    python benchmarks/sweep.py [--pictures 96] [--turns 5]

With --constant the renderer is replaced by a constant picture and the model by a
trivial one, so that only the loop is left, store included: configurations per second
over the 10,000 that are asked for, and the growth of the resident memory between the
first tenth and the end. Otherwise: pictures per second of the sweep over those of a
bare loop of Mitsuba, Open Image Denoise and the model at the same sizes, turn by turn
in one process (asked for: 0.95).
"""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import torch
from torch import Tensor, nn

from advsearch import threads

threads.configure()

from advsearch.controls import Space
from advsearch.engine.loading import fit_camera, load_scene, make_controls
from advsearch.models import load_model
from advsearch.progress import NullProgress
from advsearch.questions.sweep import job as swept_scene
from advsearch.questions.sweep.axes import parse_axes
from advsearch.questions.sweep.job import Job, NamedScene
from advsearch.questions.sweep.loop import Sweep
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import RunDirectory
from advsearch.scene.formation import ALL_OMISSIONS, ImageFormation
from advsearch.scene.gradients import GradientPlan
from advsearch.scene.mitsuba_backend.denoise import denoise
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.tasks import Classification

ASKED_PER_SECOND = 10_000
ASKED_SHARE = 0.95
GRID = {"pose.yaw": "0:360:24", "camera.elevation": "5:60:8"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--constant", action="store_true", help="without renderer and network"
    )
    parser.add_argument(
        "--configurations",
        type=int,
        default=200_000,
        help="with --constant (default 200000)",
    )
    parser.add_argument(
        "--pictures", type=int, default=96, help="of one turn (default 96)"
    )
    parser.add_argument(
        "--turns",
        type=int,
        default=5,
        help="turns after one that is not counted (default 5)",
    )
    args = parser.parse_args()
    if args.constant:
        constant(args.configurations)
        return
    print(
        "pictures per second of a sweep over a bare loop of Mitsuba, denoiser and "
        "model (median of the turns)"
    )
    for size in (128, 224):
        low, middle, high = against_bare(size, args.pictures, args.turns)
        print(
            f"  {size:3d} x {size:<3d}  {middle:.3f}  ({low:.3f}-{high:.3f})  asked "
            f"for {ASKED_SHARE}",
            flush=True,
        )


# ---- the loop by itself
# ---------------------------------------------------------------------------


class ConstantRenderer:
    """A grey picture whatever is asked for."""

    non_finite = 0
    plan = GradientPlan(())

    def __init__(self, space: Space, size: tuple[int, int]) -> None:
        self.space, self.start, self.scene = (
            space,
            space.start,
            SimpleNamespace(assembly=dict),
        )
        self.picture = torch.full((*size, 3), 0.5)
        self.formation = ImageFormation(resolution=size)

    def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
        return self.picture


class Trivial(nn.Module):
    def forward(self, images: Tensor) -> Tensor:
        level = images[:, 0, 0, 0]
        return torch.stack([level, -level], dim=1)


class Watch(NullProgress):
    """Notes the memory of the process when a tenth is done."""

    def __init__(self, tenth: int) -> None:
        self.left = tenth
        self.memory = 0

    def advance(self, n: int = 1, **info: float | str) -> None:
        self.left -= n
        if self.left <= 0 and not self.memory:
            self.memory = resident()


def constant(configurations: int) -> None:
    """Print the speed of the loop and how much its memory grows, for a grid and for
    draws.
    """
    mock.patch.object(
        swept_scene,
        "make_renderer",
        lambda scene, space, size, *more, **named: ConstantRenderer(space, size),
    ).start()
    model = load_model(Trivial(), labels=("mug", "vase"), input_size=16, name="trivial")
    side = max(1, round(configurations**0.5))
    grid = {"pose.yaw": f"0:360:{side}", "camera.elevation": f"5:60:{side}"}
    for name, config in (
        ("grid", SweepConfig(object="mug", grid=grid, trials=0)),
        (
            "draws",
            SweepConfig(
                object="mug",
                controls={"pose": {}, "camera": {}},
                samples=side * side,
                trials=0,
            ),
        ),
    ):
        watch = Watch(side * side // 10)
        speed = loop(config, model, watch)
        growth = (resident() - watch.memory) / 2**20
        print(
            f"  {name:5s}  {speed / ASKED_PER_SECOND:.2f} of {ASKED_PER_SECOND} "
            "configurations per second; "
            f"{growth:+.1f} MiB over the last nine tenths of {side * side}",
            flush=True,
        )


def loop(config: SweepConfig, model, watch) -> float:  # type: ignore[no-untyped-def]
    """Sweep in a folder of its own; return configurations per second, the end of the
    run included.
    """
    job = job_of(config, model)
    with (
        tempfile.TemporaryDirectory() as folder,
        RunDirectory.create(Path(folder) / "run") as run,
    ):
        sweep = Sweep(job, run, watch)
        begun = time.perf_counter()
        sweep.execute()
        return sweep.n_rows / (time.perf_counter() - begun)


def resident() -> int:
    """Bytes of the process that are in memory now; where that is not known, the most
    there ever were.
    """
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
            1 if sys.platform == "darwin" else 1024
        )
    return pages * resource.getpagesize()


def job_of(config: SweepConfig, model) -> Job:  # type: ignore[no-untyped-def]
    drawn = make_controls(config.controls)
    axes = parse_axes(config.grid, drawn)
    place = NamedScene("mug", "studio", load_scene("mug", "studio"))
    task = Classification().on(model)
    return Job(config, (place,), (model,), (task,), drawn, axes)


# ---- beside rendering
# ---------------------------------------------------------------------------


def against_bare(size: int, pictures: int, turns: int) -> tuple[float, float, float]:
    """Return the quartiles of bare time over sweep time, picture for picture."""
    model = load_model("reference")
    side = max(1, pictures // 8)
    grid = {"pose.yaw": f"0:360:{side}", "camera.elevation": "5:60:8"}
    config = SweepConfig(object="mug", grid=grid, trials=0, resolution=(size, size))
    job = job_of(config, model)
    bare = Bare(job, size)
    ratios = []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(turns + 1):
            with RunDirectory.create(Path(folder) / str(turn)) as run:
                sweep = Sweep(job, run, NullProgress())
                sweep.execute()
                seconds = sweep.stages.seconds["sweep"]
            if turn:
                ratios.append(bare.turn(sweep.n_rows) / seconds)
            else:
                bare.turn(16)
    low, middle, high = statistics.quantiles(ratios, n=4)
    return low, middle, high


class Bare:
    """The same pictures, each one call of Mitsuba's own with nothing recorded, the
    denoiser, and the model.

    Scene inputs are worked out beforehand and what has not changed is not set again;
    the model sees as many pictures at once as the sweep shows it.
    """

    def __init__(self, job: Job, size: int) -> None:
        self.job = job
        self.size = (size, size)
        self.space = job.bind_controls(job.scenes[0], self.size)
        self.description = fit_camera(job.scenes[0].scene.description, self.size)
        self.formation = ImageFormation(
            resolution=self.size, gain=self.description.gain
        )
        self.scene = MitsubaScene(
            self.space.scene or self.description,
            self.size,
            leave_out=ALL_OMISSIONS - {"tracing"},
        )

    def turn(self, count: int) -> float:
        """Render and classify so many pictures; return the seconds."""
        job = self.job
        points = self.job.make_points(self.space)
        u = points.make_configurations(0, count)
        inputs = [self.scene.assembly(self.space.inputs(one)) for one in u]
        begun = time.perf_counter()
        with torch.no_grad():
            for begin in range(0, count, job.config.batch):
                numbers = range(begin, min(count, begin + job.config.batch))
                job.models[0](
                    torch.stack([self.picture(inputs[n], n, job.spp) for n in numbers])
                )
        return time.perf_counter() - begun

    def picture(self, inputs, seed: int, spp: int) -> Tensor:  # type: ignore[no-untyped-def]
        radiance = self.scene.render_radiance(inputs, seed, spp)
        albedo, normal = self.scene.render_guides(inputs, seed, spp)
        return self.formation.display(
            denoise(radiance[..., :3].contiguous(), albedo, normal)
        )


if __name__ == "__main__":
    main()
