"""Whether `explain` tells planted failures, and nothing where there is none.

    python benchmarks/explain.py [--seeds 10] [--rows 10000] [--noise 0.05]

Each law makes a model wrong; a share of the answers is turned round. A law counts as told where the rules name its
parameters, no other one, and its bounds to a twentieth of their range.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from advsearch.explanations.observations import Factor, Mask, Numbers, Observations
from advsearch.explanations.rules import CountedRule, find_rules

FACTORS = (
    Factor("camera.elevation", "degrees"),
    Factor("light.power", "1"),
    Factor("pose.yaw", "degrees"),
    Factor("camera.distance", "object sizes"),
    Factor("colour", "", ("blue", "green", "red")),
    Factor("environment", "", ("dusk", "noon", "studio")),
)
LOW, HIGH = np.array([5.0, 0.0, 0.0, 1.0, 0.0, 0.0]), np.array([85.0, 2.0, 360.0, 4.0, 3.0, 3.0])
LAWS = {
    "over 60 degrees and dim": ({0: 60.0, 1: 0.6}, 1),
    "red": ({4: 2.0}, 1),
    "one of two, not both": ({2: 180.0, 3: 2.5}, 2),
    "none": ({}, 0),
}
"""Bounds by the number of the factor, and how many rules there are."""


def wrong(law: str, values: Numbers) -> Mask:
    """Where a law makes the model wrong, (n,)."""
    elevation, power, yaw, distance, colour, _ = values.T
    found: Mask = {
        "over 60 degrees and dim": (elevation > 60.0) & (power < 0.6),
        "red": colour == 2.0,
        "one of two, not both": (yaw > 180.0) != (distance > 2.5),
        "none": np.zeros(len(values), dtype=bool),
    }[law]
    return found


def is_told(law: str, rules: list[CountedRule]) -> bool:
    """Whether rules name a law, its bounds and nothing else."""
    bounds, count = LAWS[law]
    if len(rules) != count:
        return False
    for rule in rules:
        if {one.place for one in rule.conditions} != set(bounds):
            return False
        for one in rule.conditions:
            at = bounds[one.place]
            if one.options is not None:
                if one.options != frozenset({int(at)}):
                    return False
            elif min(abs(one.low - at), abs(one.high - at)) > (HIGH - LOW)[one.place] / 20.0:
                return False
    return True


def main() -> None:
    """Print a row for each law."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--noise", type=float, default=0.05)
    args = parser.parse_args()
    for law in LAWS:
        begun, told, rules = time.process_time(), 0, 0
        for seed in range(args.seeds):
            generator = np.random.default_rng(seed)
            values = generator.uniform(LOW, HIGH, (args.rows, len(FACTORS)))
            values[:, 4:] = values[:, 4:].astype(int)
            right = ~(wrong(law, values) ^ (generator.random(args.rows) < args.noise))
            found = find_rules(*Observations(FACTORS, values, right).halves(seed), seed=seed)
            told, rules = told + is_told(law, found), rules + len(found)
        seconds = (time.process_time() - begun) / args.seeds
        print(f"{law:26s} told {told} of {args.seeds}, {rules} rules in all, {seconds:.1f} CPU s each")


if __name__ == "__main__":
    main()
