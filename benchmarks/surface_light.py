"""Light on surfaces: what a picture from a new viewpoint takes, and how far it is off,
beside a rendered one.

    python benchmarks/surface_light.py [SCENE ...] [--views 5] [--truth 1024] [--repeats 5]
        [--sizes 128,224]
    python benchmarks/surface_light.py [SCENE ...] --sweep [--rows 1000]
    python benchmarks/surface_light.py [SCENE ...] --rule [--views 20]
    python benchmarks/surface_light.py [SCENE ...] --viewpoints [--sizes 128]
    python benchmarks/surface_light.py [SCENE ...] --region

A SCENE is OBJECT@ENVIRONMENT, each a bundled name or a file; the default is the bundled
mug, bottle and bowl. The model is the reference model, for scenes whose object has a
class of it. For each scene and size, over random cameras within
their whole ranges:

- ms: processor time of one picture, predicted and rendered (8 samples, denoised),
medians of turns one after the other;
- levels: root mean square difference of 255 from a picture of `--truth` samples,
  without the noise that it has itself (two of them are traced), predicted and rendered;
- margin: mean absolute difference of the model's margin from that of the traced
pictures, predicted and rendered;
- light: seconds of processor time until the first picture can be predicted, and ms for
another environment.

With `--sweep`, of a sweep over azimuth, elevation and distance that is predicted, and
two that are rendered with other seeds: rows a second, light and comparisons included,
and how often that is of the rendered ones (asked for: 5); the accuracy; and in how many
rows the verdict is not that of the rendered ones, and how many differ between these.

With `--rule`, how often the comparison before a search accepts predictions
(`engine.problem`): by simulation; and as they are, and with mistakes planted in them,
for `--views` searches, near and from afar, where the object is small.

With `--viewpoints`, the search of the recipe of that name up to its verified result,
predicted, and rendered where the object moves in place of the shift of the picture;
with `--region`, a region over azimuth and elevation with its map, and one over more of
both and the distance, predicted and rendered: processor seconds and seconds (asked for,
of the first: a quarter).
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import advsearch
from advsearch import threads

threads.configure()

from advsearch.engine.acceptance import (
    N_VIEWS,
    ComparedView,
    Deviation,
    compare_views,
    compare_with_traced,
)
from advsearch.engine.loading import load_scene
from advsearch.models import Model, load_model
from advsearch.predictors.surface_light.renderer import SurfaceRenderer, find_refusal
from advsearch.progress import NullProgress
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.recipe.description import plan_runs, read_recipe
from advsearch.questions.recipe.result import RecipeConfig
from advsearch.questions.sweep.carry_out import load_job
from advsearch.questions.sweep.loop import Sweep
from advsearch.questions.sweep.result import SweepResult
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.scene.renderer import Renderer

SCENES = ("mug@studio", "bottle@studio", "bowl@kitchen")
SPP = 8


def main() -> None:
    """Print a row for each scene and size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--truth", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--sizes", default="128,224")
    parser.add_argument("--label", help="what the object is, for a file")
    parser.add_argument("--sweep", action="store_true", help="rows of a sweep")
    parser.add_argument(
        "--rows", type=int, default=1000, help="of it, about (default 1000)"
    )
    parser.add_argument(
        "--rule",
        action="store_true",
        help="how often predictions are accepted, right and wrong ones",
    )
    parser.add_argument(
        "--viewpoints",
        action="store_true",
        help="the search of the recipe of that name",
    )
    parser.add_argument(
        "--region", action="store_true", help="a region over viewpoints, with its map"
    )
    args = parser.parse_args()
    if args.viewpoints or args.region:
        for scene in args.scenes:
            thing, _, environment = scene.partition("@")
            for size in map(int, args.sizes.split(",")) if args.viewpoints else ():
                searched(thing, environment or "studio", size)
            if args.region:
                grown(thing, environment or "studio")
        return
    if args.rule:
        simulated()
        for scene in args.scenes:
            with torch.no_grad():
                ruled(scene, args.views)
        return
    if args.sweep:
        for scene in args.scenes:
            swept(scene, args.rows, args.label)
        return
    model = load_model("reference")
    print(
        "predicted | rendered          ms a picture       levels off         margin "
        "off     light: s   ms"
    )
    for scene in args.scenes:
        thing, _, environment = scene.partition("@")
        loaded = load_scene(thing, environment or None)
        label = args.label or loaded.description.object.label
        for size in map(int, args.sizes.split(",")):
            with torch.no_grad():
                row(
                    Path(thing).stem,
                    loaded.renderer(["camera", "environment"], resolution=size),
                    model,
                    label,
                    args,
                )


def row(
    name: str,
    renderer: Renderer,
    model: Model,
    label: str | None,
    args: argparse.Namespace,
) -> None:
    """Print what one scene at one size comes to."""
    height = renderer.formation.resolution[0]
    reason = find_refusal(renderer, ["camera", "environment"])
    if reason is not None:
        print(f"{name:20s} {height:4d} not predicted: {reason}")
        return
    begun = time.process_time()
    light = SurfaceRenderer(renderer, renderer.start, seed=0)
    light(renderer.start)
    first = time.process_time() - begun
    wholes = views(renderer, args.views)
    inputs = [
        renderer.scene.input_assembler(renderer.space.inputs(one)) for one in wholes
    ]
    others = [milliseconds(lambda one=one: light.compute_light(one)) for one in inputs]  # type: ignore[misc]
    taken: tuple[list[float], list[float]] = ([], [])
    for number in range(args.repeats + 1):
        which = number % len(wholes)
        turns: tuple[Callable[[], object], ...] = (
            lambda which=which: light(wholes[which]),  # type: ignore[misc]
            lambda which=which: renderer(wholes[which], seed=which, spp=SPP),  # type: ignore[misc]
        )
        for kept, turn in zip(taken, turns, strict=True):
            kept.append(milliseconds(turn))
    off: list[list[float]] = [[], []]
    margins: list[list[float]] = [[], []]
    for number, whole in enumerate(wholes):
        traced = [
            renderer(whole, seed=100 + 2 * number + half, spp=args.truth)
            for half in range(2)
        ]
        for kind, picture in enumerate(
            (light(whole), renderer(whole, seed=number, spp=SPP))
        ):
            square = ((picture - traced[0]) * (picture - traced[1])).mean()
            off[kind].append(255.0 * float(square.clamp_min(0.0).sqrt()))
            if label in model.labels:
                right = sum(margin(model, one, label) for one in traced) / 2.0
                margins[kind].append(abs(margin(model, picture, label) - right))
    shown = (
        "       -         "
        if not margins[0]
        else " | ".join(f"{statistics.fmean(one):6.2f}" for one in margins)
    )
    ms = " | ".join(f"{statistics.median(one[1:]):6.1f}" for one in taken)
    levels = " | ".join(f"{statistics.fmean(one):6.2f}" for one in off)
    print(
        f"{name:20s} {height:4d}  {ms}   {levels}   {shown}   {first:6.1f} "
        f"{statistics.median(others):6.0f}"
    )


def swept(scene: str, rows: int, label: str | None) -> None:
    """Print what a sweep over the camera comes to, predicted and rendered."""
    thing, _, environment = scene.partition("@")
    grid = {
        "camera.azimuth": f"0:360:{max(2, rows // 50)}",
        "camera.elevation": "5:60:10",
        "camera.sizes": "2:5:5",
    }
    config = SweepConfig(
        object=thing,
        environment=environment or "studio",
        label=label,
        grid=grid,
        trials=0,
    )
    sweeps = [
        config,
        *(
            config.model_copy(update={"specialise": False, "seed": seed})
            for seed in (0, 1)
        ),
    ]
    found = list[SweepResult]()
    speeds = list[float]()
    for one in sweeps:
        sweep = Sweep(load_job(one), None, NullProgress())
        found.append(sweep.execute())
        speeds.append(sweep.n_rows / sweep.stages.seconds["sweep"])
    right = [[row.correct for row in one.rows()] for one in found]
    differ = [
        sum(a != b for a, b in zip(*pair, strict=True))
        for pair in itertools.combinations(right, 2)
    ]
    accuracy = " | ".join(f"{statistics.fmean(map(bool, one)):.3f}" for one in right)
    speed = " | ".join(f"{one:.1f}" for one in speeds)
    told = found[0].summary.transport
    print(
        f"{scene}, {len(right[0])} rows, predicted | rendered | rendered with "
        "another seed"
    )
    print(
        f"  rows a second   {speed}   "
        f"({speeds[0] / statistics.fmean(speeds[1:]):.1f} times)"
    )
    print(f"  accuracy        {accuracy}")
    print(
        f"  verdicts that differ: {differ[0]} and {differ[1]} of the rendered ones, "
        f"{differ[2]} between these"
    )
    assert told is not None
    error = (
        ""
        if told.error is None
        else (
            f"{told.error.levels:.2f} levels off, {told.error.margin_bias:+.2f} logits; "
        )
    )
    print(f"  {error}{told.reason or 'all predicted'}", flush=True)


PLANTED = (
    "as predicted",
    "object 10 % too bright",
    "object 25 % too bright",
    "one pixel aside",
    "half a logit too good",
)


def ruled(scene: str, searches: int) -> None:
    """Print how often the comparison accepts predictions, and wrong ones."""
    thing, _, environment = scene.partition("@")
    loaded = load_scene(thing, environment or None)
    model = load_model("reference")
    label = loaded.description.object.label
    for name, camera in (("", {}), (", small", {"distance": [4.0, 5.0]})):
        renderer = loaded.renderer(
            {"camera": camera, "environment": {}}, resolution=128
        )
        light = SurfaceRenderer(renderer, renderer.start, seed=0)
        accepted = [0] * len(PLANTED)
        shares = [list[float]() for _ in PLANTED]
        margins = list[float]()
        views_seen = 0
        wholes = views(renderer, N_VIEWS * searches)
        for search in range(searches):
            seen = [
                compare(
                    renderer, light, wholes[N_VIEWS * search + n], search, model, label
                )
                for n in range(N_VIEWS)
            ]
            for kind in range(len(PLANTED)):
                column = [one[kind] for one in seen]
                found = compare_views(column.__getitem__)
                accepted[kind] += found.is_accepted
                shares[kind].append(Deviation.from_views(column).levels_fraction)
                views_seen += found.n_traced // 3 if kind == 0 else 0
            margins += [one[0].margin_bias for one in seen]
        print(
            f"{scene}{name}: accepted of {searches} searches, and levels off as a "
            "share of the limit"
        )
        for planted, count, share in zip(PLANTED, accepted, shares, strict=True):
            print(
                f"  {planted:24s} {count:3d}   {statistics.fmean(share):.2f}",
                flush=True,
            )
        told = (
            f"{statistics.fmean(margins):+.2f}, with a deviation of "
            f"{statistics.stdev(margins):.2f} over views"
        )
        print(
            f"  views compared: {views_seen / searches:.1f}; margin off by {told}",
            flush=True,
        )


def compare(
    renderer: Renderer,
    light: SurfaceRenderer,
    whole: Tensor,
    search: int,
    model: Model,
    label: str | None,
) -> list[ComparedView]:
    """One view, predicted and with each mistake planted; all beside the same traced
    pictures.
    """
    inputs = renderer.scene.input_assembler(renderer.space.inputs(whole))
    lit = light.compute_light(inputs)
    brighter = [
        replace(lit, object_irradiance=lit.object_irradiance * factor)
        for factor in (1.0, 1.1, 1.25)
    ]
    pictures = []
    for light.fixed_light in brighter:
        pictures.append(light(whole))
    light.fixed_light = None
    pictures += [pictures[0].roll(1, dims=1), pictures[0]]
    once: Any = Once(renderer)
    found = [
        compare_with_traced(
            once, one, whole, search, SPP, lambda at, _: margin(model, at, label)
        )
        for one in pictures
    ]
    return [*found[:-1], replace(found[-1], margin_bias=found[-1].margin_bias + 0.5)]


class Once:
    """A renderer that traces a configuration once."""

    def __init__(self, renderer: Renderer) -> None:
        self.mask = lru_cache(renderer.compute_object_mask)
        self.halves = lru_cache(renderer.render_independent_images)
        self.__call = lru_cache(renderer.__call__)

    def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
        return self.__call(u, seed, spp)


def simulated(searches: int = 4000) -> None:
    """Print how often the rule accepts, over views whose squared errors are log-normal,
    by simulation.
    """
    generator = np.random.default_rng(0)

    def accepts(share: float, bias: float, spread: float, deviation: float) -> str:
        sigma = math.sqrt(math.log(1.0 + spread**2))
        normal = generator.normal(size=(2, searches, N_VIEWS))
        squares = share**2 * np.exp(sigma * normal[0] - sigma**2 / 2.0)
        moved = bias + deviation * normal[1]
        good = sum(
            compare_views(
                lambda n, one=one: ComparedView(  # type: ignore[misc]
                    16.0 * float(squares[one, n]), 16.0, float(moved[one, n]), 3
                )
            ).is_accepted
            for one in range(searches)
        )
        return f"{100.0 * good / searches:5.1f}"

    levels = (0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5)
    print(
        "accepted, %, where predictions are off by a share of the limit in levels of",
        *levels,
    )
    for spread in (0.5, 0.8, 1.2):
        print(
            f"  squares spread by {spread}:",
            *(accepts(share, 0.0, spread, 0.2) for share in levels),
            flush=True,
        )
    biases = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0)
    print(
        "accepted, %, of half the limit in levels, where the margin is off by", *biases
    )
    for deviation in (0.2, 0.3, 0.45):
        print(
            f"  deviation {deviation}:",
            *(accepts(0.5, bias, 0.8, deviation) for bias in biases),
            flush=True,
        )


def searched(thing: str, environment: str, size: int) -> None:
    """Print what the search of the recipe for viewpoints takes, and one that moves the
    object instead.
    """
    asked = RecipeConfig(
        recipe="viewpoints",
        object=thing,
        environment=environment,
        resolution=(size, size),
    )
    (config,) = [
        one.config
        for one in plan_runs(read_recipe("viewpoints"), asked)
        if one.part_name == "search"
    ]
    assert isinstance(config, AttackConfig)
    camera = {
        name: ends
        for name, ends in config.controls["camera"].items()
        if not name.startswith("shift")
    }
    moved = {"camera": camera, "pose": {"x": [-0.2, 0.2], "y": [-0.2, 0.2]}}
    for name, one in (
        ("predicted", config),
        ("rendered", config.model_copy(update={"controls": moved})),
    ):
        begun = time.process_time()
        found = attack_once(one).summary
        taken = (
            f"{time.process_time() - begun:5.1f} processor seconds, "
            f"{found.seconds['total']:5.1f} seconds"
        )
        print(
            f"{thing}@{environment} {size:4d} {name:10s} {taken}, {found.ending}",
            flush=True,
        )


def grown(thing: str, environment: str) -> None:
    """Print what a region over azimuth and elevation takes, predicted and rendered."""
    whole = {"azimuth": [0, 360], "elevation": [0, 80], "distance": [1.5, 5]}
    two = ["camera.azimuth", "camera.elevation"]
    three = [f"camera.{name}" for name in whole]
    for kind, side, controls, vary in (
        ("with its map", 16, {}, two),
        ("farther", 0, whole, three),
    ):
        for name, specialise in (("predicted", True), ("rendered", False)):
            with tempfile.TemporaryDirectory() as folder:
                begun = time.process_time()
                found = advsearch.region(
                    thing, environment=environment, controls={"camera": controls}, vary=vary, map=side,
                    samples=60 if side else 100, specialise=specialise, run=Path(folder) / "run", progress=False,
                )  # fmt: skip
            taken = (
                f"{time.process_time() - begun:5.1f} processor seconds, "
                f"{found.seconds['total']:5.1f} seconds"
            )
            told = (
                f"{found.n_same} of {found.samples} in {found.volume:.2f} of the range"
                if found.volume
                else ""
            )
            print(
                f"{thing}@{environment} region {kind} {name:10s} {taken}, {told}",
                flush=True,
            )


def views(renderer: Renderer, count: int) -> list[Tensor]:
    """Configurations over the whole ranges of camera and environment."""
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(len(renderer.start), generator=generator) for _ in range(count)]


def milliseconds(work: Callable[[], object]) -> float:
    """Processor time that something takes."""
    begun = time.process_time()
    work()
    return 1e3 * (time.process_time() - begun)


def margin(model: Model, picture: Tensor, label: str | None) -> float:
    """By how much the right class is ahead of all others, logits."""
    scores = model(picture)[0].clone()
    right = model.labels.index(str(label))
    own = float(scores[right])
    scores[right] = -torch.inf
    return own - float(scores.max())


if __name__ == "__main__":
    main()
