"""How often an end of the interval of `advsearch test` excludes the true share, and
what a claim takes to decide.

    python benchmarks/sequential.py [--runs 10000] [--draws 500] [--confidence 0.95]

Coverage: for shares from .5 to .99, so many runs of independent draws, each looked at
after every draw. An end misses if the true share lies beyond it at any of these times.
The misses of each must not be more than the nominal error. The same for differences of
two models that are right on the same pictures (values 0, 1/2 and 1, with ties).

Decisions: of claims "at least q", for true shares beside q, how often they are held,
failed or undecided, and how many draws they take; beside these, how many they take
where the whole interval, not each end, holds at the confidence.

Exits with 1 where there are more misses, or more wrong decisions, than the nominal
error.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import numpy.typing as npt

from advsearch.statistics.sequential import STAKES

Floats = npt.NDArray[np.float64]

SHARES = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.97, 0.99)
TIES = ((0.5, 0.9), (0.49, 0.9), (0.45, 0.6), (0.55, 0.0))
"""True means of (difference + 1) / 2, and the share of pictures on which two models
agree.
"""
CLAIMS = (
    (0.9, 0.99),
    (0.9, 0.95),
    (0.9, 0.9),
    (0.9, 0.85),
    (0.9, 0.7),
    (0.95, 0.99),
    (0.95, 0.95),
    (0.95, 0.9),
)
"""What is claimed, and what is true."""


def sampled(share: float, ties: float, runs: int, draws: int, seed: int) -> Floats:
    """Return draws (runs, draws) of this mean, a share of which are 1/2 and the others
    0 or 1.
    """
    generator = np.random.default_rng(seed)
    values = (
        generator.random((runs, draws)) < (share - 0.5 * ties) / (1.0 - ties)
    ).astype(np.float64)
    values[generator.random((runs, draws)) < ties] = 0.5
    return values


def over(
    values: Floats, mean: float, confidence: float, sides: int = 1
) -> npt.NDArray[np.bool_]:
    """Return whether the mean is shown to be over a number after each draw, (runs,
    draws) bool, as `ConfidenceSequence` says it.
    """
    total: Floats = np.full(values.shape, -np.inf)
    with np.errstate(divide="ignore"):
        for stake in STAKES:
            total = np.logaddexp(
                total, np.cumsum(np.log(1.0 - stake + stake * values / mean), axis=1)
            )
    shown: npt.NDArray[np.bool_] = total - np.log(len(STAKES)) >= np.log(
        sides / (1.0 - confidence)
    )
    return shown


def under(
    values: Floats, mean: float, confidence: float, sides: int = 1
) -> npt.NDArray[np.bool_]:
    """Return whether the mean is shown to be under a number after each draw."""
    return over(1.0 - values, 1.0 - mean, confidence, sides)


def missed(
    share: float, ties: float, *, runs: int, draws: int, confidence: float, seed: int
) -> tuple[int, int]:
    """Return in how many runs the true mean is below the low end at some time, and
    above the high one.
    """
    values = sampled(share, ties, runs, draws, seed)
    low, high = (
        out(values, share, confidence).any(axis=1).sum() for out in (over, under)
    )
    return int(low), int(high)


def decisions(
    least: float,
    share: float,
    *,
    runs: int,
    draws: int,
    confidence: float,
    seed: int,
    sides: int = 1,
) -> tuple[Floats, int]:
    """Return the shares of runs that are held, failed and undecided, and the median of
    draws that were taken.
    """
    values = sampled(share, 0.0, runs, draws, seed)
    held = over(values, least, confidence, sides)
    failed = under(values, least, confidence, sides)
    first = [
        np.where(one.any(axis=1), one.argmax(axis=1), draws) for one in (held, failed)
    ]
    taken = np.minimum(draws, np.minimum(*first) + 1)
    counts = [
        np.mean(first[0] < first[1]),
        np.mean(first[1] < first[0]),
        np.mean(first[0] == first[1]),
    ]
    return np.array(counts), int(np.median(taken))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--confidence", type=float, default=0.95)
    args = parser.parse_args()
    given = {"runs": args.runs, "draws": args.draws, "confidence": args.confidence}
    error = 1.0 - args.confidence
    bad = 0
    print(
        f"{args.runs} runs of {args.draws} draws, each looked at after every draw; "
        f"nominal error {100 * error:.1f} %"
    )
    for number, (share, ties) in enumerate([*((one, 0.0) for one in SHARES), *TIES]):
        low, high = (
            count / args.runs for count in missed(share, ties, **given, seed=number)
        )
        bad += max(low, high) > error
        beside = f", {100 * ties:.0f} % ties" if ties else ""
        print(
            f"  mean {share:.2f}{beside}: the low end misses {100 * low:.2f} %, the "
            f"high one {100 * high:.2f} %"
        )
    print(
        "claims: held, failed and undecided, and draws that they take (median; by a "
        "whole interval)"
    )
    for number, (least, share) in enumerate(CLAIMS):
        shares, taken = decisions(least, share, **given, seed=100 + number)
        bad += (shares[1] if share >= least else shares[0]) > error
        _, before = decisions(least, share, **given, seed=100 + number, sides=2)
        text = ", ".join(f"{100 * one:.1f} %" for one in shares)
        print(f"  at least {least:.2f}, true {share:.2f}: {text}; {taken} ({before})")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
