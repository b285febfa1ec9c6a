"""A picture and an attack in the avenue, which is geometry, over the street, which is a
ball around a road.

    python benchmarks/avenue.py [--size 300] [--spp 16] [--rounds 5] [--steps 40]
    python benchmarks/avenue.py --attacks [--zoom] [--distances 10 30 60] [--seeds 1]
    python benchmarks/avenue.py --searches [--distances 10 30 60] [--seeds 1]
    python benchmarks/avenue.py --loading [--rounds 5] [--environments avenue room]
    python benchmarks/avenue.py --roulette [--size 96]

It prints processor time as ratios: a warm picture (a primal render with the denoiser's
guides), the gradient of a texture, and a search of `--steps` steps with both; and the
seconds and the memory of loading each. Left out are the model, the random search
beside, verification and the report, which do not know where the car stands.

`--attacks` measures whole attacks on the texture with all of that, each in a process of
its own, the most memory that each process has had, and in how many of the seeds they
are found. The model is to call the car something else than at the start. With `--zoom`
the camera's angle is such that the car is as large as from 7 m: without it, nothing is
found from 30 and 60 m in small pictures, where the car is a few pixels wide.

`--searches` measures the search of an attack alone, as a run makes it: with the window
of the picture that it chooses, and with whole pictures, both by matrices of light
transport and by renders; and in how many of the seeds whole traced pictures of what it
found are wrong. The model is to call the car what it calls it at the start.

`--loading` measures what it takes to load a car in each place, in a process of its own
that has imported everything and loaded another scene before; and the imports.

`--roulette` measures images of the avenue by where Russian roulette begins.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

from advsearch import load_model, load_scene
from advsearch.attacks import Policy, SearchResult
from advsearch.engine import windows
from advsearch.engine.crop import CroppedSearch
from advsearch.engine.journal import Journal, ParallelEvaluator
from advsearch.engine.prediction import CleanMatrix
from advsearch.engine.problem import Problem
from advsearch.engine.record import RunState
from advsearch.progress import NullProgress, Stages
from advsearch.questions.attack import stages
from advsearch.questions.attack.carry_out import load_parts, make_problem
from advsearch.questions.attack.run import choose_policy
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.library import list_environments
from advsearch.scene.mitsuba_backend.scene import NO_ROULETTE_DEPTH
from advsearch.scene.mitsuba_backend.variant import scene_registry
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import LinearRenderer

PLACES = ("street", "avenue")
TRIAL_SPP = 64
FIELD_OF_VIEW = 35.0  # of the camera, degrees
ZOOM_DISTANCE = 7.0  # metres


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--size", type=int, default=300, help="pixels along each side (default 300)"
    )
    parser.add_argument(
        "--spp", type=int, default=16, help="samples per pixel (default 16)"
    )
    parser.add_argument(
        "--rounds",
        type=int,
        default=5,
        help="pictures and gradients of each, in turn (default 5)",
    )
    parser.add_argument(
        "--steps", type=int, default=40, help="steps of the search (default 40)"
    )
    parser.add_argument(
        "--distance",
        type=float,
        default=15.0,
        help="of the camera, metres (default 15)",
    )
    parser.add_argument("--attacks", action="store_true", help="whole attacks")
    parser.add_argument(
        "--zoom", action="store_true", help="`--attacks` of a car as large as from 7 m"
    )
    parser.add_argument("--searches", action="store_true", help="searches alone")
    parser.add_argument("--loading", action="store_true", help="loading alone")
    parser.add_argument(
        "--environments",
        nargs="+",
        default=[*list_environments("street"), *list_environments("place")],
        help="of `--loading` (default: all places)",
    )
    parser.add_argument("--roulette", action="store_true", help="images alone")
    parser.add_argument(
        "--distances",
        type=float,
        nargs="+",
        default=[10.0, 30.0, 60.0],
        help="of the camera in `--attacks` and `--searches`, metres",
    )
    parser.add_argument(
        "--seeds", type=int, default=1, help="of `--attacks` and `--searches`"
    )
    parser.add_argument(
        "--renders",
        type=int,
        default=0,
        help="steps of searches without matrices in `--searches` (default 0: none)",
    )
    args = parser.parse_args(argv)
    if args.loading:
        _print_loading(args.environments, args.rounds)
        return 0
    if args.searches:
        for distance in args.distances:
            _compare_searches(distance, args)
        return 0
    if args.attacks:
        for distance in args.distances:
            _compare_attacks(distance, args)
    elif args.roulette:
        _compare_roulette(args)
    else:
        _compare(args)
    return 0


def _compare(args: argparse.Namespace) -> None:
    """Pictures, gradients and searches in this process."""
    renderers: dict[str, Renderer] = {}
    for place in PLACES:
        before = _memory()
        begin = time.perf_counter()
        scene = load_scene(
            "car",
            place,
            settings=_camera(args.distance),
        )
        read = time.perf_counter() - begin
        renderers[place] = scene.renderer(["texture"], resolution=args.size)
        loaded = time.perf_counter() - begin
        _picture(renderers[place], 0, args.spp)
        _gradient(renderers[place], 0, args.spp)
        print(
            f"{place}: described in {read:.2f} s, loaded in {loaded:.2f} s; "
            f"{_memory() - before:.0f} MB more than before at most, with a picture and "
            "a gradient"
        )
    for name, act in (("picture", _picture), ("gradient", _gradient)):
        seconds: dict[str, list[float]] = {place: [] for place in PLACES}
        for number in range(args.rounds):
            for place in PLACES:
                seconds[place].append(
                    _timed(act, renderers[place], number + 1, args.spp)
                )
        _tell(name, {place: statistics.median(one) for place, one in seconds.items()})
    searched = {
        place: _timed(_search, renderers[place], args.spp, args.steps)
        for place in PLACES
    }
    _tell(f"search of {args.steps} steps", searched)


class AttackCost(NamedTuple):
    """What a whole attack took, and what became of it."""

    seconds: float  # of the processor
    memory: float  # largest, MB
    ending: str  # value of `Ending`
    trials: int  # of the adversarial configuration


def _compare_attacks(distance: float, args: argparse.Namespace) -> None:
    """Print what whole attacks at a distance take in each place."""
    costs: dict[str, list[AttackCost]] = {place: [] for place in PLACES}
    for seed in range(args.seeds):
        for place in PLACES:  # in turn, as other programs may slow the machine
            cost = _attack_in_process(place, distance, seed, args)
            costs[place].append(cost)
            print(
                f"  {distance:.0f} m, {place}, seed {seed}: {cost.seconds:.1f} "
                f"processor seconds, {cost.memory:.0f} MB, {cost.ending} "
                f"({cost.trials} trials)",
                flush=True,
            )
    _tell(
        f"{distance:.0f} m, attack of {args.steps} steps",
        {
            place: statistics.fmean(cost.seconds for cost in of_place)
            for place, of_place in costs.items()
        },
    )


def _attack_in_process(
    place: str, distance: float, seed: int, args: argparse.Namespace
) -> AttackCost:
    """Attack once, in a process of its own."""
    camera = _camera(distance, is_zoomed=args.zoom)
    settings = {
        "place": place,
        "camera": camera,
        "steps": args.steps,
        "resolution": args.size,
        "seed": seed,
        "label": _find_label(place, distance, args.size, args.zoom),
    }
    done = subprocess.run(
        [sys.executable, "-c", ATTACK, json.dumps(settings)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return AttackCost(*json.loads(done.stdout.splitlines()[-1]))


ATTACK = """
import json, resource, sys, tempfile, advsearch
settings = json.loads(sys.argv[1])
scene = advsearch.load_scene("car", settings["place"], settings=settings["camera"])
with tempfile.TemporaryDirectory() as directory:
    result = advsearch.attack(
        scene, controls="texture", steps=settings["steps"], seed=settings["seed"],
        resolution=settings["resolution"], label=settings["label"],
        run=directory + "/run", progress=False,
    )
used = resource.getrusage(resource.RUSAGE_SELF)
seconds = used.ru_utime + used.ru_stime
summary = result.summary
trials = summary.verified.trials if summary.verified else 0
print(json.dumps([seconds, used.ru_maxrss / 1024.0, summary.ending, trials]))
"""


LOADING = """
import json, sys, time
begin = time.process_time()
import advsearch
advsearch.load_scene("mug").renderer("texture", resolution=48)
imported = time.process_time()
scene = advsearch.load_scene("car", sys.argv[1])
described = time.process_time()
scene.renderer("texture", resolution=48)
loaded = time.process_time()
print(json.dumps([imported - begin, described - imported, loaded - described]))
"""


def _print_loading(environments: Sequence[str], rounds: int) -> None:
    """Print what loading takes in each environment, medians of processor seconds."""
    print("processor seconds     imports  load_scene  renderer   both")
    for environment in environments:
        costs: list[list[float]] = []
        for _ in range(rounds):
            output = subprocess.run(
                [sys.executable, "-c", LOADING, environment],
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            ).stdout
            costs.append(json.loads(output.splitlines()[-1]))
        medians = [statistics.median(column) for column in zip(*costs, strict=True)]
        both = statistics.median(cost[1] + cost[2] for cost in costs)
        numbers = "  ".join(f"{seconds:8.2f}" for seconds in [*medians, both])
        print(f"{environment:18} {numbers}", flush=True)


def _compare_roulette(args: argparse.Namespace) -> None:
    """Print time and squared error of images of the avenue, with and without roulette.

    Errors are those of the displayed and denoised image, in squared levels of 255, from
    one of many samples without roulette.
    """
    scene = load_scene("car", "avenue", settings=_camera(args.distance))
    renderer = scene.renderer(["texture"], resolution=args.size)
    backend = renderer.scene
    true_image = torch.zeros(())
    for depth in (NO_ROULETTE_DEPTH, 3, 2, 1):
        backend.roulette_depth = depth
        backend._integrators.clear()
        scene_registry.n_changes += 1
        with torch.no_grad():
            if depth == NO_ROULETTE_DEPTH:
                true_image = renderer(renderer.start, 0, 16 * args.spp)
            renderer(renderer.start, 1, args.spp)
            begin = time.process_time()
            images = [
                renderer(renderer.start, 2 + number, args.spp)
                for number in range(args.rounds)
            ]
            seconds = (time.process_time() - begin) / args.rounds
        errors = [float((image - true_image).square().mean()) for image in images]
        square = 255.0**2 * statistics.fmean(errors)
        print(
            f"roulette from bounce {depth} on: {seconds:.3f} processor seconds, "
            f"squared error {square:.2f}, times time {square * seconds:.2f}",
            flush=True,
        )


def _camera(distance: float, *, is_zoomed: bool = False) -> dict[str, float]:
    """The settings of a camera in the road, so many metres before the car.

    A zoomed one sees its back as large as from `ZOOM_DISTANCE`, which the model takes
    for the same in both places, with a clear margin.
    """
    settings = {
        "camera.azimuth": 0.0,
        "camera.elevation": 5.0,
        "camera.distance": distance,
    }
    if is_zoomed:
        settings |= {"camera.azimuth": 180.0, "camera.elevation": 8.0}
        tangent = math.tan(math.radians(FIELD_OF_VIEW / 2.0))
        angle = 2.0 * math.atan(tangent * ZOOM_DISTANCE / distance)
        settings["camera.fov"] = math.degrees(angle)
    return settings


class SearchCost(NamedTuple):
    """What a search took, and what became of it."""

    seconds: float  # of the processor
    area: float  # fraction of the picture that was traced
    is_found: bool  # whole traced pictures of the best texture are wrong


def _compare_searches(distance: float, args: argparse.Namespace) -> None:
    """Print what searches at a distance take in each place, with a window and whole."""
    ways = {"by matrices": (False, args.steps)}
    if args.renders:
        ways["by renders"] = (True, args.renders)
    for name, (is_rendered, steps) in ways.items():
        seconds: dict[tuple[str, bool], float] = {}
        for place in PLACES:
            for is_whole in (False, True):
                costs = [
                    _search_once(
                        place, distance, seed, steps, is_whole, is_rendered, args
                    )
                    for seed in range(args.seeds)
                ]
                seconds[place, is_whole] = statistics.fmean(c.seconds for c in costs)
                print(
                    f"  {distance:.0f} m, {place}, {name}, {steps} steps, "
                    f"{'whole' if is_whole else 'window'}: "
                    f"{seconds[place, is_whole]:.1f} processor seconds, "
                    f"{100 * costs[0].area:.0f} % of the picture, found in "
                    f"{sum(cost.is_found for cost in costs)} of {args.seeds}",
                    flush=True,
                )
        window = seconds["avenue", False]
        print(
            f"{distance:.0f} m, {name}: avenue with a window / street whole "
            f"{window / seconds['street', True]:.2f}, / street with a window "
            f"{window / seconds['street', False]:.2f}, / avenue whole "
            f"{window / seconds['avenue', True]:.2f}; avenue / street, both whole "
            f"{seconds['avenue', True] / seconds['street', True]:.2f}",
            flush=True,
        )


def _search_once(
    place: str,
    distance: float,
    seed: int,
    steps: int,
    is_whole: bool,
    is_rendered: bool,
    args: argparse.Namespace,
) -> SearchCost:
    """Search once, as an attack does; kernels are compiled before."""
    config = AttackConfig(
        object="car",
        environment=place,
        controls={"texture": {}},
        resolution=(args.size, args.size),
        steps=steps,
        seed=seed,
        set_=_camera(distance),
        label=_find_label(place, distance, args.size),
    )
    parts = load_parts(config)
    problem = make_problem(parts)
    policy = choose_policy(parts.policy, problem, None)
    _warm_up(problem)
    area = windows.MAX_AREA
    windows.MAX_AREA = 0.0 if is_whole else area
    begin = time.process_time()
    try:
        findings, result = _run_search(problem, policy, is_rendered)
    finally:
        windows.MAX_AREA = area
    seconds = time.process_time() - begin
    trials = [problem.picture(result.best_u, 1000 + n, TRIAL_SPP) for n in range(3)]
    is_found = all(problem.judge(one, result.best_u).success for one in trials)
    window = findings.predictor.window if findings.predictor else None
    fraction = window.area / args.size**2 if window else 1.0
    return SearchCost(seconds, fraction, is_found)


def _run_search(
    problem: Problem, policy: Policy[Any], is_rendered: bool
) -> tuple[RunState, SearchResult]:
    """Make the search of an attack."""
    journal = Journal(None, ParallelEvaluator(problem))
    findings = RunState()
    progress = Stages(NullProgress())
    if is_rendered:
        crop = CroppedSearch(problem, problem.steps)
        crop.prepare()
        findings.predictor = None if crop.refusal else crop
    else:
        findings.predictor = stages.choose_predictor(
            policy, journal, progress, findings, specialise=True, clean=CleanMatrix()
        )
    searches = stages.Searches(journal, progress, findings)
    result = searches.run_search(
        "search", policy, problem.steps, problem.seed, ranked=False
    )
    return findings, result


def _warm_up(problem: Problem) -> None:
    """Compile the kernels of a search."""
    start = problem.domain.start
    LinearRenderer(problem.renderer, start, 1, spp=1)
    _gradient(problem.renderer, 0, 1)


@functools.cache
def _find_label(place: str, distance: float, size: int, is_zoomed: bool = False) -> str:
    """What the model calls the car at the start."""
    model = load_model("reference")
    camera = _camera(distance, is_zoomed=is_zoomed)
    scene = load_scene("car", place, settings=camera)
    renderer = scene.renderer(["texture"], resolution=size)
    with torch.no_grad():
        output = model(renderer(renderer.start, 0, TRIAL_SPP))
    return model.labels[int(output[0].argmax())]


def _picture(renderer: Renderer, seed: int, spp: int) -> None:
    with torch.no_grad():
        renderer(renderer.start, seed, spp)


def _gradient(renderer: Renderer, seed: int, spp: int) -> None:
    renderer.gradient(lambda image: (image * image).sum(), renderer.start, seed, spp)


def _search(renderer: Renderer, spp: int, steps: int) -> None:
    """Signed steps as an attack takes them, towards a bright picture."""
    u = renderer.start.clone()
    for step in range(steps):
        slope = renderer.gradient(lambda image: image.mean(), u, step, spp)[1]
        u = (u + 0.02 * slope.sign()).clamp(0.0, 1.0)


def _timed(act: Callable[..., None], *arguments: object) -> float:
    begin = time.process_time()
    act(*arguments)
    return time.process_time() - begin


def _tell(name: str, seconds: dict[str, float]) -> None:
    told = ", ".join(f"{place} {one:.2f}" for place, one in seconds.items())
    print(
        f"{name}: avenue / street = {seconds['avenue'] / seconds['street']:.2f}   "
        f"(processor seconds: {told})"
    )


def _memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


if __name__ == "__main__":
    sys.exit(main())
