"""Margins of textures found in equal CPU seconds, by a matrix of light transport and by
rendering each step.

    python benchmarks/equal_seconds.py [--object mug] [--environment studio] [--model
        reference] [--label mug]
                                       [--epsilon 0.1] [--seconds 8] [--seeds 10]

Each seed searches twice, turn by turn in one process: with a matrix, whose making and
comparisons count, and with rendered pictures and the adjoint. Both use the default
policy and plan as many steps as fit, by the time that a few take; the noisy search
ranks its best four beyond the budget. CPU seconds of the process are what is equal, so
that others on the machine disturb it little. Each configuration is then traced with
fresh seeds, rounded to 8 bits, and its mean margin is the result. Printed are the
quartiles of both.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from functools import partial

from torch import Tensor

from advsearch import seeds, threads

threads.configure()

from advsearch.attacks import Query, get_objective, make_policy, search
from advsearch.controls import make_space
from advsearch.controls.texture import TextureControl
from advsearch.engine.loading import load_scene, make_renderer
from advsearch.engine.problem import Problem
from advsearch.engine.transport import Transport
from advsearch.models import load_model
from advsearch.tasks import Classification, Facts

SPP = 8
TIMED = 3
"""Evaluations that say how long one takes."""
TRIALS = 8
TRIAL_SPP = 64
MOST = 100_000


def main() -> None:
    """Print the quartiles."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--object", default="mug")
    parser.add_argument("--environment", default="studio")
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--label", default="mug")
    parser.add_argument("--epsilon", type=float, default=0.1)
    parser.add_argument(
        "--seconds",
        type=float,
        default=8.0,
        help="CPU seconds of each search (default 8)",
    )
    parser.add_argument("--seeds", type=int, default=10, help="at least 2 (default 10)")
    args = parser.parse_args()
    description = load_scene(args.object, args.environment).description
    space = make_space([TextureControl(epsilon=args.epsilon)], description)
    model = load_model(args.model, labels=args.labels)
    renderer = make_renderer(description, space, model.input_size[0], "oidn", 0)
    task = Classification().on(model)
    found: dict[str, list[float]] = {"matrix": [], "rendered": []}
    steps: dict[str, list[int]] = {"matrix": [], "rendered": []}
    for seed in range(args.seeds + 1):
        for way, margins in found.items():
            facts = Facts(args.label, args.label)
            problem = Problem(
                renderer,
                space,
                model,
                task,
                lambda *_, f=facts: f,
                get_objective("margin"),
                SPP,
                seed,
            )
            u, count = searched(problem, way == "matrix", args.seconds)
            if seed:  # the first turn compiles kernels
                margins.append(verified(problem, u))
                steps[way].append(count)
    print(
        f"{args.object}, epsilon {args.epsilon:g}, {args.seconds:g} CPU seconds, "
        f"{args.seeds} seeds"
    )
    print("              least  quarter  middle  3 quarters  most   steps")
    for way, margins in found.items():
        ends = [
            min(margins),
            *statistics.quantiles(margins, n=4, method="inclusive"),
            max(margins),
        ]
        print(
            f"  {way:9s} "
            + "".join(f"{end:8.2f}" for end in ends)
            + f"  {statistics.median(steps[way]):g}"
        )


def searched(problem: Problem, predicted: bool, seconds: float) -> tuple[Tensor, int]:
    """Search for so many CPU seconds; returns the configuration and the evaluations
    that it took.
    """
    end = time.process_time() + seconds
    evaluate = problem.evaluate
    if predicted:
        transport = Transport(problem, MOST)
        transport.prepare()
        evaluate = transport.evaluate
    first = Query(
        problem.domain.start,
        seeds.stream(problem.seed, "search", 0),
        phase="search",
        gradient=True,
    )
    begun = time.process_time()
    for _ in range(TIMED):
        evaluate(first)
    steps = max(
        1, int((end - time.process_time()) * TIMED / (time.process_time() - begun))
    )
    result = search(
        partial(map, evaluate),
        replace(problem.domain, exact=predicted),
        make_policy("auto"),
        steps=min(steps, MOST),
        seed=problem.seed,
        candidates=0 if predicted else 4,
        is_out_of_time=lambda _: time.process_time() >= end,
        render_seed=problem.seed,
    )
    return result.best_u, len(result.history)


def verified(problem: Problem, u: Tensor) -> float:
    """Mean margin of a configuration in traced pictures with fresh seeds."""
    queries = [
        Query(u, seeds.stream(problem.seed, "trial", one), spp=TRIAL_SPP)
        for one in range(TRIALS)
    ]
    return statistics.fmean(
        problem.evaluate(query).required_judgement.margin for query in queries
    )


if __name__ == "__main__":
    main()
