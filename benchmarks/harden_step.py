"""What a lesson of `harden` costs: a step of training in float32 over one in bfloat16 (nothing is won where the
processor has none), and a scene with four views over a scene with one.

    python benchmarks/harden_step.py [--lessons 24] [--repetitions 7]

Steps of both kinds alternate, of textured views and of rendered ones; medians count.
"""

from __future__ import annotations

import argparse
import statistics
import time
from functools import partial
from typing import Any

from advsearch import threads

threads.configure()

import torch  # noqa: E402

from advsearch.models import Model, load_model  # noqa: E402
from advsearch.models.reference import Trainable, trainable  # noqa: E402
from advsearch.questions.harden.lessons import Lesson  # noqa: E402
from advsearch.questions.harden.result import HardenConfig  # noqa: E402
from advsearch.questions.harden.scenes import (  # noqa: E402
    TRAINING,
    SceneWork,
    splits_of,
)
from advsearch.questions.harden.training import ClassifierCourse  # noqa: E402

VIEWS = 4
RENDERED = ("pose", "light")


class InSinglePrecision(Trainable):
    """The same without bfloat16."""

    def _mixed_precision(self) -> torch.autocast:
        return torch.autocast("cpu", enabled=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lessons", type=int, default=24, help="in a step")
    parser.add_argument("--repetitions", type=int, default=7)
    args = parser.parse_args()
    model = load_model("reference")
    config = HardenConfig(controls="texture,pose,light", epsilon="texture=0.03")
    work = SceneWork(config, model, splits_of(config, model))
    count, per_scene = args.lessons, -(-args.lessons // VIEWS)
    _, one_view = draw(work, range(1 + count), ("texture",), 1)
    textured, all_views = draw(work, range(1 + per_scene), ("texture",), VIEWS)
    rendered, at_random = draw(work, range(1 + count), RENDERED, 1)
    print(f"drawing, over a textured scene with one view: with {VIEWS} views {all_views / one_view:.2f}, "
          f"rendered {at_random / one_view:.2f}")  # fmt: skip
    for name, chosen in (("textured", textured[:count]), ("rendered", rendered[:count])):
        with threads.all_for_torch():
            single, mixed = step_seconds(model, chosen, args.repetitions)
        print(f"step of {count} {name} views: float32 over bfloat16 {single / mixed:.2f} ({mixed:.2f} s)")


def draw(work: SceneWork, numbers: range, controls: tuple[str, ...], views: int) -> tuple[list[Lesson], float]:
    """Lessons of scenes, and the median of seconds of each but the first, which warms up."""
    found, seconds = list[Lesson](), list[float]()
    for number in numbers:
        begun = time.perf_counter()
        how: dict[str, Any] = {"controls": controls, "views": views, "plain": 0}
        (lessons,) = work([partial(SceneWork.drawn, side=TRAINING, number=number, **how)])
        assert isinstance(lessons, list)
        found += lessons
        seconds.append(time.perf_counter() - begun)
    return found, statistics.median(seconds[1:])


def step_seconds(model: Model, chosen: list[Lesson], repetitions: int) -> list[float]:
    """Medians of seconds of a step, in float32 and as it is."""
    timed: list[list[float]] = [[], []]
    made = trainable(model)
    work = SceneWork(HardenConfig(rate=1e-6, epochs=1, views=6), model, {})
    courses = [ClassifierCourse(work, one) for one in (InSinglePrecision(made.net, made.model), made)]
    for _ in range(1 + repetitions):
        for kept, course in zip(timed, courses, strict=True):
            begun = time.perf_counter()
            course.round(1, chosen)
            kept.append(time.perf_counter() - begun)
    return [statistics.median(one[1:]) for one in timed]


if __name__ == "__main__":
    main()
