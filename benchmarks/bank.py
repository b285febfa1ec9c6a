"""How far a texture holds over conditions that no matrix was made for, by the size of the bank and by steps.

    python benchmarks/bank.py [--object mug] [--over camera,environment] [--epsilon 0.3] [--steps 100,400] [--draws 8]
                              [--trials 50]

Each row is a search of its own, with the default policy: its steps, the conditions that its bank had in the end, the
last gap between these and unseen ones (logits), CPU seconds of the whole run, and its trials under fresh conditions.
"""

from __future__ import annotations

import argparse
import time

from advsearch import threads

threads.configure()

import advsearch  # noqa: E402


def main() -> None:
    """Print a row for each number of steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", default="mug")
    parser.add_argument("--over", default="camera,environment")
    parser.add_argument("--epsilon", type=float, default=0.3)
    parser.add_argument("--steps", default="100,400")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--trials", type=int, default=50)
    args = parser.parse_args()
    print("steps  conditions     gap  CPU seconds  wrong in unseen conditions")
    for steps in map(int, args.steps.split(",")):
        begun = time.process_time()
        summary = advsearch.attack(
            args.object,
            controls="texture",
            over=args.over,
            epsilon=args.epsilon,
            steps=steps,
            draws=args.draws,
            trials=args.trials,
            baseline=False,
        ).summary
        took, told, trials = time.process_time() - begun, summary.transport, summary.verified
        if told is None or told.conditions is None or trials is None:
            raise SystemExit(f"{steps} steps: nothing was predicted ({'' if told is None else told.reason})")
        gap = "      -" if told.conditions.gap is None else f"{told.conditions.gap:7.2f}"
        print(f"{steps:5d} {told.conditions.made:11d} {gap} {took:12.0f}  {trials.successes} of {trials.trials}")


if __name__ == "__main__":
    main()
