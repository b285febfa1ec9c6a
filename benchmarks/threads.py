"""torch's and Dr.Jit's thread pools in one process: what a search step costs over its two halves measured apart.

Each setting runs in a process of its own (OpenMP reads its environment once). A process times a path-traced render with
its adjoint alone, a convolutional network forward and backward alone, and the two alternating as a search does. Printed
per setting, as ratios to the fastest halves that any setting reached:

    render, torch   the halves alone
    step            render and torch alternating; 1.00 would be no fight at all
    torch in step   the network's share alone, where the fight shows

Settings take turns over several rounds and the best median counts, because other work only ever adds time. A
machine that is busy otherwise tells little; `--load` keeps one core busy on purpose.

    python benchmarks/threads.py [--sizes 64,224] [--rounds 3] [--repetitions 7] [--load]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

SETTINGS: dict[str, tuple[int, int, dict[str, str]]] = {
    "both 2, sleeping at once (PASSIVE)": (2, 2, {}),
    "both 2, a millisecond of polling": (2, 2, {"GOMP_SPINCOUNT": "10000"}),
    "both 2, torch's default polling": (2, 2, {"GOMP_SPINCOUNT": "300000"}),
    "both 2, polling on (ACTIVE)": (2, 2, {"OMP_WAIT_POLICY": "ACTIVE"}),
    "torch 1, Dr.Jit 2, as advsearch sets them": (1, 2, {}),
    "torch 2, Dr.Jit 1": (2, 1, {}),
    "both 1": (1, 1, {}),
    "both 4 (more than cores), default polling": (4, 4, {"GOMP_SPINCOUNT": "300000"}),
}
"""Name: torch's threads, Dr.Jit's threads, what is added to the environment."""

SPP = 16
POLLING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", default="64,224", help="image widths in pixels")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--load", action="store_true", help="keep one core busy with other work meanwhile")
    parser.add_argument("--child", nargs=4, type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(*args.child)))
        return
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if args.load else None
    try:
        for size in map(int, args.sizes.split(",")):
            report(size, compare(size, args.rounds, args.repetitions))
    finally:
        if busy:
            busy.kill()


def compare(size: int, rounds: int, repetitions: int) -> dict[str, dict[str, float]]:
    """Best medians in seconds of every setting at one image size."""
    best: dict[str, dict[str, float]] = {name: {} for name in SETTINGS}
    for _ in range(rounds):
        for name, (torch_threads, drjit_threads, variables) in SETTINGS.items():
            command = [
                sys.executable,
                __file__,
                "--child",
                *map(str, (torch_threads, drjit_threads, size, repetitions)),
            ]
            environ = {k: v for k, v in os.environ.items() if k not in POLLING} | variables
            done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
            for key, value in json.loads(done.stdout).items():
                best[name][key] = min(value, best[name].get(key, value))
    return best


def report(size: int, results: dict[str, dict[str, float]]) -> None:
    """Print the ratios of one image size."""
    floor = {half: min(r[half] for r in results.values()) for half in ("render", "torch")}
    total = floor["render"] + floor["torch"]
    print(
        f"\n{size} x {size}, {SPP} samples, {os.cpu_count()} cores; torch takes {floor['torch'] / total:.0%} of a step"
    )
    print(f"{'':<48}{'step':>8}{'torch in step':>15}{'render':>8}{'torch':>8}")
    for name, r in results.items():
        ratios = (r["step"] / total, r["torch_in_step"] / floor["torch"])
        alone = (r["render"] / floor["render"], r["torch"] / floor["torch"])
        print(f"{name:<48}{ratios[0]:>8.2f}{ratios[1]:>15.2f}{alone[0]:>8.2f}{alone[1]:>8.2f}")


def measure(torch_threads: int, drjit_threads: int, size: int, repetitions: int) -> dict[str, float]:
    """Medians in seconds, in this process: the halves alone and the alternating step."""
    from advsearch.scene.mitsuba_backend.variant import mitsuba  # sets OpenMP's environment, so before torch

    import torch  # isort: skip

    mi = mitsuba()
    import drjit as dr

    torch.set_num_threads(torch_threads)
    dr.set_thread_count(drjit_threads)
    render, network = render_half(mi, dr, size), network_half(torch, size)
    for _ in range(3):
        render()
        network()
    alone = {
        "render": [clock(render) for _ in range(repetitions)],
        "torch": [clock(network) for _ in range(repetitions)],
    }
    pairs = [(clock(render), clock(network)) for _ in range(repetitions)]
    medians = {name: statistics.median(times) for name, times in alone.items()}
    return medians | {
        "step": statistics.median(a + b for a, b in pairs),
        "torch_in_step": statistics.median(b for _, b in pairs),
    }


def clock(call: Callable[[], None]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def render_half(mi, dr, size: int) -> Callable[[], None]:  # type: ignore[no-untyped-def]
    """A Cornell box by path tracing, and its adjoint for the colour of a wall."""
    scene_dict = mi.cornell_box()
    scene_dict["integrator"] = {"type": "prb", "max_depth": 4}
    scene_dict["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    scene = mi.load_dict(scene_dict)
    parameters, key = mi.traverse(scene), "red.reflectance.value"
    seed = iter(range(1_000_000))

    def call() -> None:
        dr.enable_grad(parameters[key])
        image = mi.render(scene, parameters, spp=SPP, seed=next(seed))
        dr.backward(dr.mean(image, axis=None))
        dr.eval(dr.grad(parameters[key]))
        image.numpy()
        dr.sync_thread()
        dr.disable_grad(parameters[key])

    return call


def network_half(torch, size: int) -> Callable[[], None]:  # type: ignore[no-untyped-def]
    """A network of the shape of MobileNetV2 (many short layers, so many OpenMP barriers), forward and backward."""
    nn = torch.nn
    layers, width = [nn.Conv2d(3, 32, 3, 2, 1), nn.ReLU6()], 32
    for out, stride in (
        (16, 1),
        (24, 2),
        (24, 1),
        (32, 2),
        (32, 1),
        (64, 2),
        (64, 1),
        (96, 1),
        (96, 1),
        (160, 2),
        (160, 1),
    ):
        wide = 6 * width
        layers += [nn.Conv2d(width, wide, 1), nn.ReLU6(), nn.Conv2d(wide, wide, 3, stride, 1, groups=wide), nn.ReLU6()]
        layers, width = [*layers, nn.Conv2d(wide, out, 1)], out
    model = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(width, 1000)).requires_grad_(False)
    image = torch.rand(1, 3, size, size, generator=torch.Generator().manual_seed(0))

    def call() -> None:
        model(image.clone().requires_grad_()).amax().backward()

    return call


if __name__ == "__main__":
    main()
