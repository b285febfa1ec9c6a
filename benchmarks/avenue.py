"""A picture and an attack in the avenue, which is geometry, over the street, which is a
ball around a road.

    python benchmarks/avenue.py [--size 300] [--spp 16] [--rounds 5] [--steps 40]
    python benchmarks/avenue.py --attacks                              # whole attacks alone

It prints processor time as ratios: a warm picture (a primal render with the denoiser's
guides), the gradient of a texture, and a search of `--steps` steps with both; and the
seconds and the memory of loading each. Left out are the model, the random search
beside, verification and the report, which do not know where the car stands. Last come
whole attacks on the texture with all of that, each in a process of its own, and the
most memory that each process has had.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import torch

from advsearch import load_scene
from advsearch.scene.renderer import Renderer

PLACES = ("street", "avenue")


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
    parser.add_argument("--attacks", action="store_true", help="whole attacks alone")
    args = parser.parse_args(argv)
    if not args.attacks:
        _compare(args)
    costs = {place: _in_a_process(place, args) for place in PLACES}
    _tell(
        f"attack of {args.steps} steps",
        {place: seconds for place, (seconds, _) in costs.items()},
    )
    most = {place: memory for place, (_, memory) in costs.items()}
    print(
        "memory of the attack: avenue / street = "
        f"{most['avenue'] / most['street']:.2f}   "
        f"(MB at most: {', '.join(f'{place} {memory:.0f}' for place, memory in most.items())})"
    )
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
            settings={"camera.elevation": 8.0, "camera.distance": args.distance},
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


def _in_a_process(place: str, args: argparse.Namespace) -> tuple[float, float]:
    """Processor seconds and the most memory, MB, of an attack in a process of its
    own.
    """
    asked = json.dumps(
        {
            "place": place,
            "steps": args.steps,
            "resolution": args.size,
            "distance": args.distance,
        }
    )
    done = subprocess.run(
        [sys.executable, "-c", ATTACK, asked],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    seconds, memory = json.loads(done.stdout.splitlines()[-1])
    return seconds, memory


ATTACK = """
import json, resource, sys, tempfile, advsearch
asked = json.loads(sys.argv[1])
settings = {"camera.elevation": 8.0, "camera.distance": asked["distance"]}
with tempfile.TemporaryDirectory() as folder:
    advsearch.attack(
        advsearch.load_scene("car", asked["place"], settings=settings), controls="texture", steps=asked["steps"],
        resolution=asked["resolution"], run=folder + "/run", progress=False,
        label="mug", minimise=True,  # the bundled model knows no cars: it is to call this one a mug
    )
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0]))
"""


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
