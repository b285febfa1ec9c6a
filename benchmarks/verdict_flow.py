"""How often whole checks of results are wrong: the code that runs, with margins in
place of pictures.

    python benchmarks/verdict_flow.py [--runs 2000] [--over-runs 300]

Everything that an attack does after its searches is carried out: the sample count, the
control group, its trials, the random search's, its second chance in fresh trials, and
the trials of different failures. Only the renderer is replaced: a picture's margin is
drawn, so that the true rate of wrong predictions is known.

- one scene: how often a configuration of some rate is found, alone and beside a random
  search whose configuration has the same rate; how often the interval that is printed
  covers the rate; how often one of the different failures is said to hold;
- over conditions: the same;
- the sample count over conditions: how far the rate is off that of many samples, and
which count is chosen.

Exits with 1 where an interval covers less often than it says, where a rate is found
more often than docs/design.md and `advsearch.attacks.verification` say, or a sample
count leaves the rate further off, noise aside (two standard errors).
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import ndtr, ndtri
from torch import Tensor

from advsearch.attacks import Block, Domain, Ending, Evaluation, Query, SearchResult
from advsearch.attacks.candidates import Failures, FoundFailure
from advsearch.attacks.trials import LADDER, choose_rate_spp
from advsearch.attacks.verification import (
    OVER_CONDITIONS,
    OVER_LOOKS,
    TRIAL_LOOKS,
    WORST_CASE,
    VerificationRule,
)
from advsearch.engine.journal import Journal, ParallelEvaluator
from advsearch.engine.record import RunState
from advsearch.engine.verifier import Verifier
from advsearch.progress import NullProgress, Stages
from advsearch.questions.attack.stages import verify_searches
from advsearch.tasks import Judgement, Prediction

RATE = 0.75
OVER_RATE = 0.85
"""Rates that are too low to be found, for one scene and over conditions."""
MOST_FOUND = 0.025
MOST_FOUND_OVER = 0.035
"""How often they may be found, with a random search beside the search."""
MOST_OFF = {0.1: 0.01, 0.05: 0.2}
"""How often a sample count that is said to be enough may leave the rate so far off."""
CLEAN = 0.0
OWN = 1.0
BASELINE = 0.5
FAILURE = 0.25
DOMAIN = Domain(torch.zeros(1), (Block(1, "linf", 1.0),))

Array = npt.NDArray[np.float64]


@dataclass
class Drawn:
    """A problem whose margins are normal: the clean scene is right, and adversarial
    ones are wrong in this share of pictures. Half of the variance is that of
    conditions, where these vary; the noise does not fall with the samples.
    """

    rate: float
    root: int
    over: bool = False
    search_spp: int = 16
    conditions_per_evaluation: int = 1
    steps: int = 100
    seed: int = field(init=False)
    verification_rule: VerificationRule = field(init=False)
    conditions: Any = field(init=False)
    domain: Domain = DOMAIN
    searched_space: ClassVar[Any] = SimpleNamespace(controls=())

    def __post_init__(self) -> None:
        self.seed, self.conditions = self.root, object() if self.over else None
        self.verification_rule = OVER_CONDITIONS if self.over else WORST_CASE
        self._middle = float(ndtri(self.rate))

    def evaluate(self, query: Query) -> Evaluation:
        at = float(query.u[0])
        if at == CLEAN:
            return _judged(-5.0)
        drawn = np.random.default_rng(
            [self.root, query.seed, query.spp, round(1000 * at)]
        ).normal(size=1)
        if self.over and query.draws_conditions:
            shared = np.random.default_rng([self.root, query.seed]).normal()
            return _judged(self._middle + math.sqrt(0.5) * (shared + float(drawn[0])))
        return _judged(self._middle + float(drawn[0]))

    def evaluate_all(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        return map(self.evaluate, queries)

    def describe(self, u: Tensor, draw_seed: int | None = None) -> dict[str, Any]:
        return {}

    def describe_conditions(self, u: Tensor, draw_seed: int) -> dict[str, Any]:
        return {}


def _judged(score: float) -> Evaluation:
    return Evaluation(
        score,
        None,
        score > 0.0,
        judgement=Judgement(score, -score, score <= 0.0, Prediction("")),
    )


def claimed(at: float, failures: Failures | None = None) -> SearchResult:
    """Return what a search claims that has found a wrong prediction."""
    nothing = (0.0, 0.0, 1.0, Ending.FOUND, Ending.FOUND, (), (), 108, 100, 0, 0, 0.0)
    return SearchResult(torch.full((1,), at), *nothing, failures=failures)


def checked(
    rate: float,
    root: int,
    *,
    over: bool = False,
    beside: bool = True,
    failures: int = 0,
) -> RunState:
    """Return what an attack's own check comes to, with a random search `beside` it, and
    so many different failures.
    """
    problem: Any = Drawn(rate, root, over)
    looks = OVER_LOOKS if over else TRIAL_LOOKS
    verifier = Verifier(
        Journal(None, ParallelEvaluator(problem)),
        LADDER,
        Stages(NullProgress()),
        look_sizes=looks,
    )
    listed = tuple(
        FoundFailure(torch.full((1,), FAILURE + 0.01 * k), 1.0, {})
        for k in range(failures)
    )
    known = Failures(listed, (0,), failures, failures, failures) if failures else None
    verifier.run_state.search_result = claimed(OWN, known)
    verifier.run_state.random_search_result = claimed(BASELINE) if beside else None
    verify_searches(verifier, is_smallest=False)
    return verifier.run_state


def flow(
    rate: float, runs: int, *, over: bool = False, beside: bool = True
) -> tuple[float, float, float]:
    """Return in which share of checks a rate is found, how often the interval covers
    it, and the mean of pictures.
    """
    found = covered = pictures = 0
    for root in range(runs):
        findings = checked(rate, root, over=over, beside=beside)
        assert findings.verification is not None
        low, high = findings.verification.adversarial_counts.interval
        found += findings.verification.ending is Ending.FOUND
        covered += low <= rate <= high
        pictures += findings.verification_renders
    return found / runs, covered / runs, pictures / runs


def error_of(share: float, runs: int) -> float:
    """Return two standard errors of a share in so many runs."""
    return 2.0 * math.sqrt(share * (1.0 - share) / runs)


def flow_table(runs: int, over: bool) -> int:
    """Print what checks come to; return how many things are wrong with them."""
    weak, most = (OVER_RATE, MOST_FOUND_OVER) if over else (RATE, MOST_FOUND)
    print(f"{'over conditions' if over else 'one scene'}: {runs} checks each")
    print(
        "| rate | random search | found, % | covered, % | pictures |\n| --- | --- | "
        "--- | --- | --- |"
    )
    wrong = 0
    for rate in (weak, 0.95, 0.99):
        for beside in (False, True):
            share, covered, pictures = flow(rate, runs, over=over, beside=beside)
            wrong += covered < 0.95 - error_of(0.95, runs)
            wrong += rate == weak and share > most + error_of(most, runs)
            told = f"{100 * share:.2f} | {100 * covered:.1f} | {pictures:.0f}"
            print(f"| {rate} | {'yes' if beside else 'no'} | {told} |", flush=True)
    print()
    return wrong


def failures_table(runs: int) -> int:
    """Print how often different failures of a rate are said to hold; return whether
    that is too often.
    """
    count = 8
    held = 0
    for root in range(-(-runs // count)):
        findings = checked(RATE, root, beside=False, failures=count)
        held += sum(
            one.ending is Ending.FOUND for one in findings.failure_verifications
        )
    tried = count * -(-runs // count)
    print(
        f"of {tried} different failures of {RATE} {100 * held / tried:.2f} % are "
        "said to hold\n"
    )
    return int(held / tried > MOST_FOUND + error_of(MOST_FOUND, tried))


@dataclass(frozen=True)
class Conditions:
    """Margins over conditions: normal, with noise and with a shift that fall with the
    samples; both at 16.
    """

    middle: float
    spread: float
    noise: float
    shift: float
    power: float

    def rate(self, spp: float) -> float:
        """The share over zero at so many samples."""
        noise = self.noise * math.sqrt(16 / spp)
        shift = self.shift * (16 / spp) ** self.power
        return float(ndtr((self.middle + shift) / math.hypot(self.spread, noise)))

    def margins(
        self, spp: int, rng: np.random.Generator, conditions: Array
    ) -> list[float]:
        """What pictures under these conditions have, at one sample count."""
        noise = self.noise * math.sqrt(16 / spp)
        shift = self.shift * (16 / spp) ** self.power
        return list(
            self.middle
            + self.spread * conditions
            + shift
            + noise * rng.normal(size=len(conditions))
        )


CASES = [
    Conditions(middle, spread, noise, shift, power)
    for middle, spread in ((3.0, 2.5), (1.5, 1.2), (2.0, 4.0), (5.0, 2.5))
    for noise in (0.3, 1.0)
    for shift in (0.0, -0.3, -0.6, -1.0, 0.6)
    for power in (0.5, 1.0)
    if shift or power == 0.5
]


def chosen(case: Conditions, root: int) -> tuple[int, float]:
    """Return the sample count that is chosen, and how far the rate there is off that of
    very many samples; NaN where the count is not said to be enough.
    """
    rng = np.random.default_rng(root)
    drawn = dict[int, Array]()

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        conditions = drawn.setdefault(0, rng.normal(size=len(seeds)))
        return case.margins(spp, rng, conditions)

    count = choose_rate_spp({"it": margins}, seed=root)
    return count.spp, abs(
        case.rate(count.spp) - case.rate(math.inf)
    ) if count.converged else math.nan


def samples_table(runs: int) -> int:
    """Print which sample counts are chosen over conditions, and how far the rate is off
    then; return how many limits are broken.
    """
    print(
        "| margins: mean, spread, noise, shift and its power | samples, mean | off "
        "by over 10 points, % | 5, % |"
    )
    print("| --- | --- | --- | --- |")
    worst = dict.fromkeys(MOST_OFF, 0.0)
    wrong = 0
    for case in CASES:
        counts, errors = np.array([chosen(case, root) for root in range(runs)]).T
        shares = {far: float(np.mean(errors > far)) for far in MOST_OFF}
        worst = {far: max(worst[far], share) for far, share in shares.items()}
        wrong += sum(
            shares[far] > most + error_of(most, runs) for far, most in MOST_OFF.items()
        )
        what = f"{case.middle}, {case.spread}, {case.noise}, {case.shift}, {case.power}"
        print(
            f"| {what} | {counts.mean():.0f} | "
            f"{' | '.join(f'{100 * one:.1f}' for one in shares.values())} |"
        )
    print(
        "in the worst case "
        + ", ".join(
            f"{100 * one:.1f} % by over {100 * far:.0f}" for far, one in worst.items()
        )
    )
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--over-runs", type=int, default=300)
    args = parser.parse_args()
    torch.set_num_threads(1)
    wrong = flow_table(args.runs, over=False) + failures_table(args.runs)
    wrong += flow_table(args.over_runs, over=True) + samples_table(args.over_runs)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
