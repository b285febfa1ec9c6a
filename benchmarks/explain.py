"""Whether `explain` tells planted failures, and nothing where there is none; and
whether its intervals hold.

    python benchmarks/explain.py [--seeds 10] [--rows 10000] [--noise 0.05] [--samples 300]
        [--studies 300]

Each law makes a model wrong; a share of the predictions is turned round. A law counts
as told where the rules name its parameters, no other one, and its bounds to a twentieth
of their range. Each rule is then tried on 100 fresh rows inside it, as `explain`
renders them.

Then studies without any law are made, of few rows and of many, and it is counted in how
many a rule is told, and in how many one is confirmed as well. Rules are found in them
as `explain` finds them: halves, trees, up to five rules, arcs of an angle. More than 1
in 100 told ends with the exit status 1.

Then predictions, yes or no, are drawn from known accuracies, and it is counted in how
many samples the interval of what decides has the true share, of the parameters that
decide and of one that does not.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from advsearch.questions.explain.importance import find_importance
from advsearch.rules import (
    CountedRule,
    Mask,
    find_covered,
    find_rules,
    make_table,
    split_in_halves,
)

Numbers = npt.NDArray[np.float64]

FACTORS = (
    "camera.elevation",
    "light.power",
    "pose.yaw",
    "camera.distance",
    "colour",
    "environment",
)
NAMES = {"colour": ("blue", "green", "red"), "environment": ("dusk", "noon", "studio")}
LOW = np.array([5.0, 0.0, 0.0, 1.0, 0.0, 0.0])
HIGH = np.array([85.0, 2.0, 360.0, 4.0, 3.0, 3.0])
LAWS: dict[str, tuple[dict[int, Any], int]] = {
    "over 60 degrees and dim": ({0: 60.0, 1: 0.6}, 1),
    "red": ({4: 2.0}, 1),
    "one of two, not both": ({2: 180.0, 3: 2.5}, 2),
    "end-on": ({2: (160.0, 20.0)}, 1),
    "end-on and far": ({2: (160.0, 20.0), 3: 2.5}, 1),
    "none": ({}, 0),
}
"""Bounds by the number of the factor, of an arc from and to; and how many rules there
are.
"""
UNITS = {"pose.yaw": "degrees"}
INSIDE = 100
"""Fresh rows inside a rule."""


def table(values: Mapping[str, Any], right: Mask) -> pd.DataFrame:
    """Independent rows as a table for rules."""
    rows = pd.DataFrame({**values, "correct": right, "unit": np.arange(len(right))})
    rows = rows.astype({name: "category" for name in NAMES if name in values})
    rows.attrs["units"] = {name: UNITS.get(name, "") for name in values}
    return make_table(rows, values)


def wrong(law: str, values: Numbers) -> Mask:
    """Where a law makes the model wrong, (n,)."""
    elevation, power, yaw, distance, colour, _ = values.T
    end_on = np.abs((yaw + 90.0) % 180.0 - 90.0) < 20.0
    found: Mask = {
        "over 60 degrees and dim": (elevation > 60.0) & (power < 0.6),
        "red": colour == 2.0,
        "one of two, not both": (yaw > 180.0) != (distance > 2.5),
        "end-on": end_on,
        "end-on and far": end_on & (distance > 2.5),
        "none": np.zeros(len(values), dtype=bool),
    }[law]
    return found


def is_told(law: str, rules: list[CountedRule]) -> bool:
    """Whether rules name a law, its bounds and nothing else."""
    bounds, count = LAWS[law]
    if len(rules) != count:
        return False
    for rule in rules:
        if {FACTORS.index(one.factor) for one in rule.conditions} != set(bounds):
            return False
        for one in rule.conditions:
            place = FACTORS.index(one.factor)
            at = bounds[place]
            if one.options is not None:
                if one.options != frozenset({NAMES[one.factor][int(at)]}):
                    return False
            elif isinstance(at, tuple):
                if (
                    not one.turn
                    or max(abs(one.low - at[0]), abs(one.high - at[1])) > 180.0 / 20.0
                ):
                    return False
            elif (
                min(abs(one.low - at), abs(one.high - at)) > (HIGH - LOW)[place] / 20.0
            ):
                return False
    return True


ACCURACIES: dict[str, Callable[[Numbers], Numbers]] = {
    "5, 12, 22 % by distance": lambda x: (
        0.05
        + 0.17 * (x[:, 0] < 1 / 3)
        + 0.07 * ((x[:, 0] >= 1 / 3) & (x[:, 0] < 2 / 3))
    ),
    "steep in one": lambda x: 1.0 / (1.0 + np.exp(-10.0 * (x[:, 0] - 0.5))),
    "two of them": lambda x: (
        1.0 / (1.0 + np.exp(-4.0 * (x[:, 0] - 0.5) - 3.0 * (x[:, 1] - 0.5)))
    ),
    "one of two, not both": lambda x: np.where(
        (x[:, 0] > 0.5) != (x[:, 1] > 0.5), 0.9, 0.15
    ),
    "rarely right": lambda x: np.where(x[:, 0] > 0.7, 0.12, 0.02),
    "nearly certain": lambda x: np.where(x[:, 0] > 0.6, 0.02, 0.98),
    "end-on and from the side": lambda x: np.where(
        np.abs(np.cos(2.0 * np.pi * x[:, 0])) > 0.8, 0.28, 0.71
    ),
}
"""Accuracies over three parameters in [0, 1], (n, 3) to (n,); the third decides
nothing.
"""


def true_shares(accuracy: Callable[[Numbers], Numbers], rows: int) -> list[float]:
    """The shares of the three parameters with the parts that so many rows have, from a
    million points.
    """
    x = np.random.default_rng(0).random((1_000_000, 3))
    at = accuracy(x)
    parts = min(20, max(2, round(rows ** (1 / 3))))
    found = []
    for column in x.T:
        means = np.array(
            [
                at[np.minimum((column * parts).astype(int), parts - 1) == k].mean()
                for k in range(parts)
            ]
        )
        found.append(float(means.var() / (at.mean() * (1.0 - at.mean()))))
    return [one if one > 1e-4 else 0.0 for one in found]


def coverage(name: str, rows: int, samples: int) -> str:
    """In how many samples the intervals have the true shares, and how wide they are."""
    accuracy = ACCURACIES[name]
    true = true_shares(accuracy, rows)
    hit = np.zeros(3)
    width = np.zeros(3)
    for seed in range(samples):
        generator = np.random.default_rng(seed)
        x = generator.random((rows, 3))
        right = generator.random(rows) < accuracy(x)
        for one in find_importance(table(dict(zip("xyz", x.T, strict=True)), right)):
            if len(one.parameters) == 1:
                place = "xyz".index(one.parameters[0])
                (low, high) = one.interval
                hit[place] += low <= true[place] <= high
                width[place] += high - low
    each = zip(true, hit / samples, 50 * width / samples, strict=True)
    told = ", ".join(
        f"{100 * share:.1f} %: {held:.1%} +-{half:.0f}" for share, held, half in each
    )
    return f"{name:26s} {rows:6d} rows, true share: covered +-points  {told}"


def drawn(
    law: str,
    rows: int,
    noise: float,
    generator: np.random.Generator,
    accuracy: float = 1.0,
) -> pd.DataFrame:
    """Rows of a law, or right by chance with an accuracy where the law does not make
    them wrong.
    """
    values = generator.uniform(LOW, HIGH, (rows, len(FACTORS)))
    values[:, 4:] = values[:, 4:].astype(int)
    right = ~(wrong(law, values) ^ (generator.random(rows) < noise)) & (
        generator.random(rows) < accuracy
    )
    columns: dict[str, Any] = dict(zip(FACTORS, values.T, strict=True))
    columns |= {
        name: np.array(names)[columns[name].astype(int)]
        for name, names in NAMES.items()
    }
    return table(columns, right)


def is_confirmed(
    rule: CountedRule,
    law: str,
    noise: float,
    generator: np.random.Generator,
    accuracy: float = 1.0,
) -> bool:
    """Whether fresh rows inside a rule tell it again; where it is small, they are drawn
    until there are enough.
    """
    fresh = pd.DataFrame()
    while len(fresh) < INSIDE:
        more = drawn(law, 20 * INSIDE, noise, generator, accuracy)
        fresh = pd.concat([fresh, more[find_covered(rule.conditions, more)]])
    fresh = fresh[:INSIDE].assign(unit=-1 - np.arange(INSIDE))
    return CountedRule(rule.conditions, fresh, rule.elsewhere).holds


def without_a_law(studies: int, rows: int) -> int:
    """Print in how many studies of no law a rule is told, and confirmed; return whether
    it is too many.
    """
    told = confirmed = 0
    for seed in range(studies):
        generator = np.random.default_rng(10_000 + seed)
        found = find_rules(
            *split_in_halves(drawn("none", rows, 0.0, generator, 0.7), seed), seed=seed
        ).accepted
        told += bool(found)
        confirmed += any(
            is_confirmed(one, "none", 0.0, generator, 0.7) for one in found
        )
    most = 0.01 * studies + 3.0 * (0.0099 * studies) ** 0.5
    print(
        f"no law, {rows} rows: a rule is told in {told} of {studies}, and confirmed "
        f"in {confirmed}",
        flush=True,
    )
    return int(told > most)


def main() -> int:
    """Print a row for each law, then one for each accuracy and number of rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--samples", type=int, default=300)
    parser.add_argument("--studies", type=int, default=300)
    args = parser.parse_args()
    for law in LAWS:
        begun = time.process_time()
        told = 0
        rules = 0
        confirmed = 0
        for seed in range(args.seeds):
            generator = np.random.default_rng(seed)
            found = find_rules(
                *split_in_halves(drawn(law, args.rows, args.noise, generator), seed),
                seed=seed,
            ).accepted
            told = told + is_told(law, found)
            rules = rules + len(found)
            confirmed += sum(
                is_confirmed(one, law, args.noise, generator) for one in found
            )
        seconds = (time.process_time() - begun) / args.seeds
        counts = (
            f"told {told} of {args.seeds}, {rules} rules in all, {confirmed} confirmed"
        )
        print(f"{law:26s} {counts}, {seconds:.1f} CPU s each", flush=True)
    bad = sum(without_a_law(args.studies, rows) for rows in (200, 1000))
    for name in ACCURACIES:
        for rows in (120, 1000):
            print(coverage(name, rows, args.samples), flush=True)
    return min(bad, 1)


if __name__ == "__main__":
    sys.exit(main())
