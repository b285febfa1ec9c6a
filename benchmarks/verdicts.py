"""Whether verdicts that cost less are as good: the rule of trials, the choice of the
sample count, and close calls.

    python benchmarks/verdicts.py [--runs 400] [--epsilons .01 .02 .03 .04] [--object FILE]
        [--environment FILE] ...

*Before* is how verdicts were taken at first: samples until the margin moves by less than half of itself, and then 20
trials of which 19 have to succeed. *Now* samples stop where more of them leave the
margin on its side, and fresh trials stop with the verdict. Five tables
(`verdict_flow.py` has whole checks, with a random search and different failures):

- trials: how often a rate is found, exactly, and how many trials it takes; how often
  intervals cover the rate; both by the code that runs, in every way in which its trials
  may come out;
- trials over many conditions: the same, where 200 were tried before;
- sample counts: how often a margin passes for settled on the wrong side, where noise
lifts it over zero;
- close calls, drawn: how often what is `found` before and now, and the samples that
both take;
- close calls, rendered: searches at several epsilons; for each both verdicts, pictures
x samples, and CPU seconds.

Exits with 1 where an interval covers too seldom, a rate of 75 % is found more often
than before, one of 85 % over conditions in more than 3.3 %, a margin passes on the
wrong side in more than 5 % of all cases or, noise aside (two standard errors) more is
found at a limit that is none.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import product

import numpy as np
import numpy.typing as npt
import torch
from scipy import stats
from scipy.special import stdtrit
from torch import Tensor

from advsearch import threads
from advsearch.attacks import (
    Block,
    Domain,
    Ending,
    Evaluation,
    Query,
    Verification,
    choose_spp,
    make_policy,
    search,
    verify,
)
from advsearch.attacks.evaluation import Evaluate
from advsearch.attacks.trials import (
    LADDER,
    MarginsOf,
    TrialCounts,
    make_margin_function,
)
from advsearch.attacks.verification import (
    OVER_CONDITIONS,
    OVER_CONFIDENCE,
    OVER_LOOKS,
    TRIAL_LOOKS,
    WORST_CASE,
)
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.seeds import derive_seed
from advsearch.tasks import Judgement, Prediction

Array = npt.NDArray[np.float64]

RATES = (0.5, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 0.97, 0.99, 1.0)
WEAK = 0.75
"""The rate at which the interval of 19 of 20 begins."""
OVER_RATES = (0.5, 0.8, 0.85, 0.9, 0.95, 0.97, 0.98, 0.99, 1.0)
WEAK_OVER = 0.85
"""The rate at which the interval of 180 of 200 begins."""
CALLS = (-0.5, -0.1, 0.0, 0.1, 0.25, 0.5, 1.0, 3.0)
"""Margins of the adversarial configuration without noise; over 0 is a success."""


# ---- the rule, exactly


class Unknown(Exception):
    """A trial is asked for that the script doesn't have."""


def ended(script: str) -> Verification:
    """Return what the check itself says where trials succeed (1) or fail (0) one after
    the other; `Unknown` where it asks for more.
    """
    told = iter(script)

    def evaluate(queries: Sequence[Query]) -> Iterator[Evaluation]:
        for query in queries:
            answer = "0" if float(query.u[0]) == 0.0 else next(told, None)
            if answer is None:
                raise Unknown
            score = 1.0 if answer == "1" else -1.0
            yield Evaluation.from_judgement(
                Judgement(score, -score, score <= 0.0, Prediction(""))
            )

    domain = Domain(torch.zeros(1), (Block(1, "linf", 1.0),))
    return verify(
        evaluate,
        domain,
        torch.ones(1),
        claim=Ending.NOT_VERIFIED,
        spp=1,
        seed=0,
        trials=TRIAL_LOOKS,
    )


@cache
def paths() -> dict[tuple[int, int, bool], int]:
    """Return in how many ways trials that nobody counted end with (successes, trials,
    found), by the code that runs.
    """
    ways = Counter[tuple[int, int, bool]]()
    scripts = [""]
    while scripts:
        script = scripts.pop()
        try:
            said = ended(script)
        except Unknown:
            scripts += [script + "0", script + "1"]
            continue
        rate = said.adversarial_counts
        ways[rate.n_successes, rate.n_trials, said.ending is Ending.FOUND] += 1
    return dict(ways)


def outcomes(rate: float) -> dict[tuple[int, int, bool], float]:
    """Return how often trials end with (successes, trials, found), for a rate of
    successes.
    """
    return {
        (k, n, found): ways * rate**k * (1.0 - rate) ** (n - k)
        for (k, n, found), ways in paths().items()
    }


def found(rate: float) -> float:
    """Return how often a rate is found."""
    return sum(chance for (_, _, found), chance in outcomes(rate).items() if found)


def found_before(rate: float) -> float:
    """Return how often a rate was found by 19 of 20."""
    return float(stats.binom.sf(WORST_CASE.count_needed_successes(20) - 1, 20, rate))


def coverage(rate: float) -> float:
    """Return how often the interval that is printed covers the rate."""
    intervals = {at: TrialCounts(at[0], at[1], 1).interval for at in paths()}
    return sum(
        chance
        for at, chance in outcomes(rate).items()
        if intervals[at][0] <= rate <= intervals[at][1]
    )


def rule_table() -> int:
    """Print how the rule does; return how many things are wrong with it."""
    print(
        "| rate | found before, % | now, % | trials before | now |\n| --- | --- | "
        "--- | --- | --- |"
    )
    for rate in RATES:
        trials = sum(chance * n for (_, n, _), chance in outcomes(rate).items())
        print(
            f"| {rate:.2f} | {100 * found_before(rate):.2f} | "
            f"{100 * found(rate):.2f} | 20 | {trials:.1f} |"
        )
    least = min(coverage(rate) for rate in np.linspace(0.005, 0.995, 199))
    print(f"intervals cover the rate in {100 * least:.1f} % of all cases at least\n")
    return int(least < 0.95) + int(found(WEAK) > found_before(WEAK))


# ---- over conditions, exactly


def over_outcomes(
    rates: Array, counting: int
) -> dict[tuple[int, int], tuple[Array, bool]]:
    """Return how often trials over conditions end with (successes, trials) for rates
    (n,), and whether that is found; of `OVER_LOOKS[-1]` trials so many count.
    """
    last = min(counting, OVER_LOOKS[-1])
    lost = OVER_CONDITIONS.count_allowed_failures(OVER_LOOKS[-1])
    failing = {0: np.ones_like(rates)}
    ended = dict[tuple[int, int], tuple[Array, bool]]()
    for n in range(1, last + 1):
        went = {
            failures: failing.get(failures, 0.0) * rates
            + failing.get(failures - 1, 0.0) * (1.0 - rates)
            for failures in range(max(failing) + 2)
        }
        failing = {}
        for failures, chance in went.items():
            early = n in OVER_LOOKS and n < last
            found = (
                early or n == last
            ) and n - failures >= OVER_CONDITIONS.count_needed_successes(n, early=early)
            if found or n == last or failures > lost:
                ended[n - failures, n] = chance, found
            else:
                failing[failures] = chance
        if not failing:
            break
    return ended


def over_coverage(rates: Array, counting: int) -> Array:
    """Return how often the interval that is printed covers rates (n,)."""
    covered = np.zeros_like(rates)
    for (successes, trials), (chance, _) in over_outcomes(rates, counting).items():
        low, high = TrialCounts(successes, trials, 1, OVER_CONFIDENCE).interval
        covered += chance * ((low <= rates) & (rates <= high))
    return covered


def over_table() -> int:
    """Print how the rule over conditions does; return how many things are wrong with
    it.
    """
    print(
        "| rate | found by 200, % | now, % | trials before | now |\n| --- | --- | "
        "--- | --- | --- |"
    )
    rates = np.array(OVER_RATES)
    ends = over_outcomes(rates, OVER_LOOKS[-1])
    chances = sum(
        (chance for chance, found in ends.values() if found), np.zeros_like(rates)
    )
    trials = sum(
        (chance * n for (_, n), (chance, _) in ends.items()), np.zeros_like(rates)
    )
    for rate, chance, count in zip(rates, chances, trials, strict=True):
        before = stats.binom.sf(
            OVER_CONDITIONS.count_needed_successes(200) - 1, 200, rate
        )
        print(
            f"| {rate:.2f} | {100 * before:.2f} | {100 * chance:.2f} | 200 | "
            f"{count:.0f} |"
        )
    fine = np.linspace(0.001, 0.999, 999)
    least = min(
        float(over_coverage(fine, counting).min())
        for counting in range(1, OVER_LOOKS[-1] + 1)
    )
    print(
        f"intervals cover the rate in {100 * least:.1f} % of all cases at least, "
        "however many conditions count\n"
    )
    return int(least < 0.95) + int(chances[OVER_RATES.index(WEAK_OVER)] > 0.033)


# ---- the sample count


def settled_before(here: Sequence[float], below: Sequence[float]) -> bool:
    """Whether the margin moved by less than half of itself, as it was asked before."""
    means = [math.fsum(one) / len(one) for one in (here, below)]
    half = [
        stdtrit(len(one) - 1, 0.9875) * np.std(one, ddof=1) / math.sqrt(len(one))
        for one in (here, below)
    ]
    return bool(abs(means[0] - means[1]) + math.hypot(*half) <= 0.5 * abs(means[0]))


def may_have_settled(values: Sequence[Sequence[float]], level: int, count: int) -> bool:
    """Whether so many renders might have shown that, by those so far; else they were
    left out.
    """
    known = [one for one in range(level + 1) if values[one]]
    if not known:
        return True
    means = {one: float(np.mean(values[one])) for one in known}
    best = values[known[-1]]
    largest = (
        abs(means[known[-1]])
        + abs(means[known[-1]] - means[known[-2]])
        + np.std(best, ddof=1) / len(best) ** 0.5
    )
    spread = [
        np.std(values[one], ddof=1)
        if values[one]
        else np.std(best, ddof=1) * (LADDER[known[-1]] / LADDER[one]) ** 0.5
        for one in (level - 1, level)
    ]
    return bool(
        math.hypot(*spread) * stdtrit(count - 1, 0.9875) / count**0.5 <= 0.5 * largest
    )


def choose_before(margins: Sequence[MarginsOf], seed: int) -> int:
    """Return the sample count that was chosen before."""
    reached = 1
    looks = list(product(range(1, len(LADDER)), (4, 8)))
    for render in margins:
        values: list[list[float]] = [[] for _ in LADDER]
        for place, (level, count) in enumerate(looks):
            if not any(may_have_settled(values, *later) for later in looks[place:]):
                return LADDER[-1]
            if not may_have_settled(values, level, count):
                continue
            for one in (level - 1, level):
                new = [
                    derive_seed(seed, "sample count", 8 * one + number)
                    for number in range(len(values[one]), count)
                ]
                values[one] += render(LADDER[one], new) if new else []
            if settled_before(values[level], values[level - 1]):
                break
        else:
            return LADDER[-1]
        reached = max(reached, level)
    return LADDER[reached]


def lifted(noise: float) -> MarginsOf:
    """Margins of a limit of zero that noise lifts over it, as slowly as is allowed
    for.
    """

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        drawn = [float(np.random.default_rng([spp, seed]).normal()) for seed in seeds]
        return [math.sqrt(16 / spp) * (1.0 + noise * one) for one in drawn]

    return margins


def sample_table(runs: int) -> int:
    """Print how often the wrong side passes; return in how many cases that is too
    often.
    """
    print("| noise over lift | wrong side, % |\n| --- | --- |")
    shares = [
        (
            noise,
            np.mean(
                [
                    choose_spp(
                        {"": lifted(noise)}, seed=k, trials=TRIAL_LOOKS[0]
                    ).converged
                    for k in range(runs)
                ]
            ),
        )
        for noise in (0.03, 0.1, 0.3, 1.0)
    ]
    for noise, share in shares:
        print(f"| {noise} | {100 * share:.2f} |")
    print()
    return sum(
        bool(share > 0.05 + 2.0 * math.sqrt(0.05 * 0.95 / runs)) for _, share in shares
    )


# ---- verdicts


class Counted:
    """Answers queries and counts samples; the same picture is made once."""

    def __init__(self, answer: Callable[[Query], Evaluation]) -> None:
        self.answer = answer
        self.samples = 0
        self.pictures = 0
        self.seconds = 0.0
        self._known: dict[tuple[bytes, int, int], Evaluation] = {}

    def __call__(self, queries: Sequence[Query]) -> Iterator[Evaluation]:
        for query in queries:
            key = query.u.numpy().tobytes(), query.seed, query.spp
            if key not in self._known:
                begun = time.process_time()
                self._known[key] = self.answer(query)
                self.seconds += time.process_time() - begun
                self.samples = self.samples + query.spp
                self.pictures = self.pictures + 1
            yield self._known[key]


def verdict(
    evaluate: Evaluate, domain: Domain, u: Tensor, seed: int, *, before: bool
) -> Verification:
    """Return the verdict on what was found, with what is asked of `evaluate`, as it was
    before or as it is.
    """
    at = {"adversarial": domain.project(u), "clean": domain.start}
    margins = {
        name: make_margin_function(evaluate, name, place) for name, place in at.items()
    }
    trials: tuple[int, ...] = (20,) if before else TRIAL_LOOKS
    if before:
        spp = choose_before(list(margins.values()), seed)
    else:
        spp = choose_spp(margins, seed=seed, trials=TRIAL_LOOKS[0]).spp
    return verify(
        evaluate,
        domain,
        u,
        claim=Ending.NOT_VERIFIED,
        spp=spp,
        seed=seed,
        trials=trials,
    )


def drawn(clean: float, answer: float, lift: float) -> tuple[Counted, Domain, Tensor]:
    """Return margins of a clean scene and an adversarial one: noise of a deviation of
    0.4 at 16 samples, which also moves them by `lift` there; both are half as much at
    four times the samples.
    """
    domain = Domain(torch.zeros(1), (Block(1, "linf", 1.0),))

    def asked(query: Query) -> Evaluation:
        place = clean if float(query.u[0]) == 0.0 else answer
        noise = float(
            np.random.default_rng([query.seed, query.spp, int(query.u[0])]).normal()
        )
        score = place + math.sqrt(16 / query.spp) * (lift + 0.4 * noise)
        judged = Judgement(score, -score, score <= 0.0, Prediction(""))
        return Evaluation(score, None, score > 0.0, judgement=judged)

    return Counted(asked), domain, torch.ones(1)


def drawn_table(runs: int) -> int:
    """Print how often close calls are found; return where more is found that is
    none.
    """
    print(
        "| clean | adversarial | moved at 16 | found before, % | now, % | the same, "
        "% | samples before | now |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    wrong = 0
    for clean, answer, lift in [
        *((-3.0, one, lift) for one in CALLS for lift in (0.0, 0.3)),
        (-0.46, 30.0, -0.1),
    ]:
        shares = [0, 0]
        same = 0
        samples = [0, 0]
        for seed in range(runs):
            endings = []
            for k, before in enumerate((True, False)):
                evaluate, domain, u = drawn(clean, answer, lift)
                endings.append(
                    verdict(evaluate, domain, u, seed, before=before).ending
                    is Ending.FOUND
                )
                shares[k], samples[k] = (
                    shares[k] + endings[-1],
                    samples[k] + evaluate.samples,
                )
            same += endings[0] == endings[1]
        error = 2.0 * math.sqrt(sum(k * (runs - k) for k in shares) / runs) / runs
        wrong += answer <= 0.0 and (shares[1] - shares[0]) / runs > error + 1.0 / runs
        percent = " | ".join(f"{100 * one / runs:.1f}" for one in (*shares, same))
        print(
            f"| {clean} | {answer} | {lift} | {percent} | {samples[0] / runs:.0f} | "
            f"{samples[1] / runs:.0f} |",
            flush=True,
        )
    print()
    return wrong


def rendered_table(config: AttackConfig, epsilons: Sequence[float]) -> None:
    """Print both verdicts on what searches find."""
    print(
        "| epsilon | ending before | now | wrong before | now | pictures x samples "
        "before | now | CPU s before | now |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for epsilon in epsilons:
        problem = problem_from_config(config.model_copy(update={"epsilon": epsilon}))[0]
        answer = search(
            partial(map, problem.evaluate),
            problem.domain,
            make_policy("auto"),
            steps=8,
            seed=0,
        )
        told: list[list[str]] = [[], [], [], []]
        for before in (True, False):
            evaluate = Counted(problem.evaluate)
            said = verdict(evaluate, problem.domain, answer.best_u, 0, before=before)
            rate = said.adversarial_counts
            what = (
                said.ending.value,
                f"{rate.n_successes}/{rate.n_trials} at {rate.spp}",
            )
            for column, text in zip(
                told,
                (*what, str(evaluate.samples), f"{evaluate.seconds:.1f}"),
                strict=True,
            ):
                column.append(text)
        print(
            f"| {epsilon} | {' | '.join(text for column in told for text in column)} |",
            flush=True,
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument(
        "--epsilons", type=float, nargs="*", default=[0.01, 0.02, 0.03, 0.04]
    )
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--object", default="mug")
    parser.add_argument("--environment")
    parser.add_argument("--model", default="reference")
    parser.add_argument("--labels")
    parser.add_argument("--label")
    args = parser.parse_args()
    threads.configure(None)
    wrong = (
        rule_table()
        + over_table()
        + sample_table(10 * args.runs)
        + drawn_table(args.runs)
    )
    given = {
        name: getattr(args, name)
        for name in ("object", "environment", "model", "labels", "label")
    }
    given = {name: value for name, value in given.items() if value is not None}
    size = (args.resolution, args.resolution)
    rendered_table(
        AttackConfig(**given, controls={"texture": {}}, resolution=size, measure="no"),
        args.epsilons,
    )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
