"""Compares policies on bundled scenes at equal renders, by verified margin, with a
dense sample of the space beside.

    python benchmarks/searches.py [--spaces pose camera light environment.rotation]
        [--policies auto random ...]
                                  [--renders 60] [--seeds 10] [--dense 600] [--dense-trials
                                      12] [--resolution 64]
                                  [--spp N]
                                  [--object FILE --environment FILE --model FILE --labels
                                      FILE --label NAME]
    python benchmarks/searches.py --texture [--seeds 10]
    python benchmarks/searches.py --transport [--seeds 10] [--renders 40] [--epsilon E]
        [--resolution 128]

The first prints, for each space and policy, the median over seeds of the verified
margin (the mean of fresh trials at a high sample count, in logits; below 0 the model is
wrong), how far `auto` is above the best single policy, and which share of a dense
sample of the space, ten times as many configurations, has a higher margin than what
`auto` finds. Those are verified by `--dense-trials` trials each: the best of many noisy
values is a noisy one. `--spp` is what the searches render with; the trials always have
64 samples.

The second compares the renders that gradient search needs with those of the best policy
without gradients: the margin that `pgd` reaches within a tenth of the renders, and the
margins of the others with all of them.

The third compares texture searches that render with those by a matrix of light
transport: quartiles of the verified margin, and of the processor's seconds that a
search takes, making the matrix and ranking included.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from advsearch import seeds, threads
from advsearch.attacks import Evaluation, Query, make_policy, search
from advsearch.engine.problem import Problem
from advsearch.engine.transport import Transport
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig

TRIALS = 12
TRIAL_SPP = 64
BLIND = ("random", "nes")
"""Policies without gradients that take a whole texture."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--object", default="mug")
    parser.add_argument("--environment")
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--label")
    parser.add_argument(
        "--spaces",
        nargs="+",
        default=["pose", "camera", "light", "environment.rotation"],
    )
    parser.add_argument(
        "--policies", nargs="+", default=["auto", "random", "sobol", "cmaes", "pgd"]
    )
    parser.add_argument("--renders", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--dense", type=int, default=600)
    parser.add_argument("--dense-trials", type=int, default=TRIALS)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--spp", type=int)
    parser.add_argument("--texture", action="store_true")
    parser.add_argument("--transport", action="store_true")
    parser.add_argument("--epsilon", type=float)
    args = parser.parse_args(argv)
    threads.configure(None)
    (_texture if args.texture else _transport if args.transport else _spaces)(args)
    return 0


def _problem(args: argparse.Namespace, control: str) -> Problem:
    config = AttackConfig(
        object=args.object,
        environment=args.environment,
        model=args.model,
        labels=args.labels,
        label=args.label,
        controls={control: {} if args.epsilon is None else {"epsilon": args.epsilon}},
        resolution=args.resolution,
        spp=args.spp,
        measure="no",
    )
    return problem_from_config(config)[0]


def _answer(problem: Problem, policy: str, renders: int, seed: int) -> float:
    """Verified margin of what a search finds: fresh seeds, 8 bits, a high sample
    count.
    """
    problem.seed = seeds.derive_seed(7, "searches", seed)
    steps = max(1, renders - 8)  # the ranking of candidates takes eight
    found = search(
        partial(map, problem.evaluate),
        problem.domain,
        make_policy(policy),
        steps=steps,
        seed=seeds.derive_seed(seed, policy),
        kind=policy,
        render_seed=problem.seed,
    )
    return _verified(problem, found.best_u)


def _verified(problem: Problem, u: Tensor, trials: int = TRIALS) -> float:
    queries = [
        Query(u, seeds.derive_seed(99, "trial", number), spp=TRIAL_SPP)
        for number in range(trials)
    ]
    return statistics.fmean(
        problem.evaluate(query).required_judgement.margin for query in queries
    )


def _spaces(args: argparse.Namespace) -> None:
    print(
        f"| space | {' | '.join(args.policies)} | auto above the best | share of "
        f"{args.dense} above auto |"
    )
    print("|" + " --- |" * (len(args.policies) + 3))
    for space in args.spaces:
        problem = _problem(args, space)
        margins = {
            policy: [
                _answer(problem, policy, args.renders, seed)
                for seed in range(args.seeds)
            ]
            for policy in args.policies
        }
        medians = {
            policy: statistics.median(values) for policy, values in margins.items()
        }
        generator = torch.Generator().manual_seed(5)
        dense = [
            _verified(problem, u, args.dense_trials)
            for u in problem.domain.sample(generator, args.dense)
        ]
        clean = _verified(problem, problem.domain.start)
        best = min(medians.values())
        cells = [
            f"{medians[policy]:.2f} ({min(margins[policy]):.1f} to "
            f"{max(margins[policy]):.1f})"
            for policy in margins
        ]
        behind = share = "-"
        if "auto" in medians:
            behind = f"{100 * max(0.0, medians['auto'] - best) / max(clean - best, 1e-9):.0f} %"
            share = f"{100 * sum(value > medians['auto'] for value in dense) / len(dense):.1f} %"
        print(f"| {space} | {' | '.join(cells)} | {behind} | {share} |", flush=True)


def _texture(args: argparse.Namespace) -> None:
    problem = _problem(args, "texture")
    few = max(10, args.renders // 10)
    rows = [("pgd", few), *((policy, args.renders) for policy in BLIND)]
    print("| policy | renders | verified margin, median | lowest | highest |")
    print("| --- | --- | --- | --- | --- |")
    for policy, renders in rows:
        values = [_answer(problem, policy, renders, seed) for seed in range(args.seeds)]
        median = statistics.median(values)
        print(
            f"| {policy} | {renders} | {median:.2f} | {min(values):.2f} | "
            f"{max(values):.2f} |",
            flush=True,
        )


def _evaluated(
    problem: Problem, transport: Transport | None, query: Query
) -> Evaluation:
    """Predicted where something predicts; the ranking is traced."""
    return (
        transport if transport is not None and query.phase == "search" else problem
    ).evaluate(query)


def _transport(args: argparse.Namespace) -> None:
    problem = _problem(args, "texture")
    print(
        "| pictures are | verified margin: lowest, quartiles, highest | processor's "
        "seconds, quartiles |"
    )
    print("| --- | --- | --- |")
    for name in ("rendered", "predicted"):
        margins = []
        seconds = []
        for seed in range(args.seeds + 1):
            problem.seed = seeds.derive_seed(7, "searches", seed)
            begun = time.process_time()
            predicted = name == "predicted"
            evaluate = partial(
                _evaluated,
                problem,
                Transport(problem, args.renders) if predicted else None,
            )
            found = search(
                partial(map, evaluate),
                replace(problem.domain, is_noise_free=predicted),
                make_policy("auto"),
                steps=args.renders,
                seed=seeds.derive_seed(seed, "auto"),
                render_seed=problem.seed,
            )
            if seed:  # the first one compiles the renderer's code
                seconds.append(time.process_time() - begun)
                margins.append(_verified(problem, found.best_u))
        inner = " ".join(
            f"{value:.2f}"
            for value in statistics.quantiles(margins, n=4, method="inclusive")
        )
        took = " ".join(
            f"{value:.2f}"
            for value in statistics.quantiles(seconds, n=4, method="inclusive")
        )
        print(
            f"| {name} | {min(margins):.2f}, {inner}, {max(margins):.2f} | {took} |",
            flush=True,
        )


if __name__ == "__main__":
    sys.exit(main())
