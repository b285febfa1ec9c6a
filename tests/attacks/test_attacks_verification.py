"""Intervals, sample counts and verdicts. No renderer: margins are numbers with stated noise."""

import math
import runpy
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.stats import binom

from advsearch.attacks import (
    Block,
    Domain,
    Ending,
    Evaluate,
    Evaluation,
    Query,
    Random,
    TrialCounts,
    choose_spp,
    clopper_pearson,
    run_trials,
    search,
    verify,
)
from advsearch.attacks.trials import MarginsOf, count_max_samples, derive_trial_seed
from advsearch.attacks.verification import (
    EASIER,
    MIN_RATE,
    OVER_CONDITIONS,
    OVER_LOOKS,
    TRIAL_LOOKS,
    WORST_CASE,
    VerificationRule,
)
from advsearch.errors import InputError
from advsearch.questions.attack.settings import MIN_TRIALS
from advsearch.seeds import derive_seed
from advsearch.statistics.paired import paired_difference
from advsearch.tasks import Judgement, Prediction

STUDY = Path(__file__).resolve().parents[2] / "benchmarks" / "verdicts.py"

DOMAIN = Domain(torch.full((4,), 0.5), (Block(4, "linf", 0.1),))
WORST = DOMAIN.start + 0.1


def judged(margin: float) -> Evaluation:
    """The answer with so large a margin, which is what is sought."""
    return Evaluation(margin, None, margin > 0.0, judgement=Judgement(margin, -margin, margin <= 0.0, Prediction("")))


def noisy(clean: float, adversarial: float, noise: float) -> Evaluate:
    """Margins that move linearly from the start (`clean`) to WORST (`adversarial`), with gaussian noise."""

    def render(query: Query) -> Evaluation:
        way = float((query.u - DOMAIN.start).mean()) / 0.1
        margin = clean + way * (adversarial - clean) + noise * float(np.random.default_rng(query.seed).normal())
        return judged(margin)

    return partial(map, render)


def test_clopper_pearson_agrees_with_scipy_and_is_exact_at_the_ends() -> None:
    for successes in range(18):
        ours = clopper_pearson(successes, 17, 0.9)
        theirs = stats.binomtest(successes, 17).proportion_ci(0.9, method="exact")
        assert ours == pytest.approx((theirs.low, theirs.high), abs=1e-9)
    assert clopper_pearson(0, 5)[0] == 0.0
    assert clopper_pearson(5, 5)[1] == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1, 0), "trials: expected at least 1, got 0"), ((3, 2), "successes: expected a number from 0 to 2, got 3"),
        ((1, 2, 1.0), "confidence: expected a number between 0 and 1, got 1.0"),
    ],
)  # fmt: skip
def test_impossible_counts_are_refused(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        clopper_pearson(*arguments)  # type: ignore[arg-type]


def test_trials_have_a_rate_and_its_interval() -> None:
    trials = TrialCounts(20, 20, 64)
    assert trials.rate == 1.0 and trials.interval == pytest.approx((0.8316, 1.0), abs=1e-4)


@pytest.mark.parametrize(
    ("counts", "low", "high"),
    [((20, 2, 12, 16), 0.0562, 0.3292), ((36, 2, 12, 0), 0.0569, 0.3404), ((20, 12, 2, 16), -0.3292, -0.0562)],
)
def test_the_difference_of_pairs_is_that_of_the_paper(
    counts: tuple[int, int, int, int], low: float, high: float
) -> None:
    """Newcombe's own examples for his method 10."""
    difference, interval = paired_difference(*counts)
    assert difference == pytest.approx((counts[2] - counts[1]) / sum(counts))
    assert interval == pytest.approx((low, high), abs=6e-5)


@pytest.mark.parametrize(("first", "second"), [(0.3, 0.1), (0.05, 0.05)])
def test_the_interval_of_pairs_covers_the_difference(first: float, second: float) -> None:
    """Of 60 pairs in which the two go together in half of all."""
    rng, true, covered = np.random.default_rng(0), second - first, 0
    for counts in rng.multinomial(60, [0.5, first, second, 0.5 - first - second], size=2000).tolist():
        low, high = paired_difference(*counts)[1]
        covered += low <= true <= high
    assert 0.94 < covered / 2000 < 0.99


def drifting(limit: float, bias: float, noise: float) -> MarginsOf:
    """Margins as Monte Carlo noise makes them: bias and variance fall with the sample count."""

    def margin_of(spp: int, seed: int) -> float:
        return limit - bias * 16 / spp + noise * math.sqrt(16 / spp) * float(np.random.default_rng(seed).normal())

    return lambda spp, seeds: [margin_of(spp, seed) for seed in seeds]


def test_margins_that_do_not_drift_settle_at_the_second_rung() -> None:
    choice = choose_spp({"clean": drifting(-3.0, 0.0, 0.1), "adversarial": drifting(2.0, 0.0, 0.1)}, seed=0)
    assert (choice.spp, choice.converged, choice.renders) == (16, True, 16), "the first look is enough"
    assert [(r.name, r.spp) for r in choice.table] == [
        ("clean", 4),
        ("clean", 16),
        ("adversarial", 4),
        ("adversarial", 16),
    ]
    assert math.isnan(choice.table[0].drift)


def test_what_half_of_the_renders_do_not_settle_all_of_them_may() -> None:
    """Margins around 1.6 that scatter by 0.5: too wide an interval for four renders, not for eight."""
    turns = {derive_seed(2, "sample count", k): k for k in range(8)}

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        return [1.6 + 0.5 * (-1.0) ** turns[seed] for seed in seeds]

    choice = choose_spp({"adversarial": margins}, seed=2, ladder=(4, 16, 64))
    assert (choice.spp, choice.converged, choice.renders) == (16, True, 16)


@pytest.mark.medium
@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_the_wrong_side_passes_in_about_one_case_of_twenty_at_most(noise: float) -> None:
    """Noise lifts a margin of zero over the decision, by half as much at four times the samples: the slowest that is
    allowed for, so that the drift foretells exactly zero at every rung."""

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        drawn = (float(np.random.default_rng([spp, seed]).normal()) for seed in seeds)
        return [math.sqrt(16 / spp) * (1.0 + noise * one) for one in drawn]

    passed = sum(choose_spp({"it": margins}, seed=seed, trials=14).converged for seed in range(300))
    assert 0 < passed <= 0.05 * 300 + 2.0 * math.sqrt(0.05 * 0.95 * 300)


def test_a_single_render_on_the_other_side_asks_for_more_samples() -> None:
    """A trial may come out like that one: not all trials of this rung would be a success."""

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        stray = derive_seed(0, "sample count", 2)
        return [-0.05 if seed == stray and spp == 16 else 1.0 for seed in seeds]

    choice = choose_spp({"it": margins}, seed=0, ladder=(4, 16, 64, 256))
    assert (choice.spp, choice.converged) == (64, True)


@pytest.mark.parametrize("seed", range(8))
def test_noise_alone_is_no_proof_that_nothing_drifts(seed: int) -> None:
    """A drift below its own uncertainty must not pass: at 16 and 64 samples these margins say nothing."""
    choice = choose_spp({"clean": drifting(-3.0, 0, 0.0), "adversarial": drifting(1.0, 1.0, 2.0)}, seed=seed)
    assert choice.spp >= 256


def test_a_margin_at_zero_never_settles_and_says_so() -> None:
    choice = choose_spp({"adversarial": drifting(0.0, 0.0, 0.3)}, seed=0, ladder=(16, 64, 256))
    assert (choice.spp, choice.converged) == (256, False)


@pytest.mark.parametrize("seed", range(8))
def test_what_has_settled_is_not_rendered_with_more_samples(seed: int) -> None:
    spent: dict[str, list[int]] = {"adversarial": [], "clean": []}

    def counted(name: str, margins: MarginsOf) -> MarginsOf:
        return lambda spp, seeds: spent[name].extend([spp] * len(seeds)) or margins(spp, seeds)  # type: ignore[func-returns-value]

    margins = {"adversarial": drifting(3.0, 4.0, 0.3), "clean": drifting(-6.0, 0.0, 0.1)}
    choice = choose_spp({name: counted(name, margin) for name, margin in margins.items()}, seed=seed)
    assert choice.converged and choice.spp == max(spent["adversarial"]) >= 64
    assert max(spent["clean"]) == 16 and choice.renders == sum(map(len, spent.values()))


def test_a_decision_that_no_rung_can_settle_is_seldom_rendered_up_to_the_last() -> None:
    """At the decision the noise of 256 samples would have to be far less than what that of 16 and 64 foretells."""
    spent: list[int] = []

    def at_the_decision(spp: int, seeds: Sequence[int]) -> Sequence[float]:
        spent.extend([spp] * len(seeds))
        return drifting(0.0, 0.0, 0.5)(spp, seeds)

    for seed in range(20):
        choice = choose_spp({"adversarial": at_the_decision, "clean": drifting(-6.0, 0.0, 0.1)}, seed=seed)
        assert (choice.spp, choice.converged) == (256, False)
        assert {rung.name for rung in choice.table} == {"adversarial"}, "the other one decides nothing any more"
    assert sum(spent) < 0.7 * 20 * count_max_samples(1)


@pytest.mark.parametrize(("limit", "bias", "noise"), [(1.0, 1.0, 0.1), (3.0, 3.0, 0.5), (-2.0, -2.0, 0.2)])
def test_a_margin_that_drifts_across_the_decision_is_followed_to_where_it_stands(
    limit: float, bias: float, noise: float
) -> None:
    """At 16 samples it is zero; at 64 it has left it, and moves on."""
    for seed in range(20):
        choice = choose_spp({"adversarial": drifting(limit, bias, noise)}, seed=seed)
        assert choice.converged and choice.spp >= 64 and choice.table[-1].mean * limit > 0.0


def test_renders_of_a_sample_count_are_no_trials_and_both_groups_share_their_seeds() -> None:
    seen: dict[str, list[tuple[int, ...]]] = {"a": [], "b": []}

    def record(name: str) -> MarginsOf:
        def noted(spp: int, seeds: Sequence[int]) -> list[float]:
            seen[name].append(tuple(seeds))
            return [1.0] * len(seeds)

        return noted

    choose_spp({name: record(name) for name in seen}, seed=3, ladder=(4, 8, 16))
    assert seen["a"] == seen["b"]
    assert len(seen["a"]) == 2 and not {derive_trial_seed(3, k) for k in range(100)} & set(sum(seen["a"], ()))


def test_a_nan_margin_never_settles() -> None:
    choice = choose_spp({"adversarial": lambda spp, seeds: [math.nan] * len(seeds)}, seed=0, ladder=(4, 8))
    assert not choice.converged


def test_a_single_rung_is_taken_unmeasured() -> None:
    choice = choose_spp({"clean": drifting(1.0, 0.0, 0.0)}, seed=0, ladder=(32,))
    assert (choice.spp, choice.converged, choice.renders) == (32, False, 0)


@pytest.mark.parametrize("ladder", [(), (0, 4), (16, 16), (64, 16)])
def test_a_bad_ladder_is_refused(ladder: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="verify_spp: expected rising sample counts"):
        choose_spp({}, seed=0, ladder=ladder)


def test_nineteen_of_twenty_are_needed() -> None:
    assert [WORST_CASE.count_needed_successes(n) for n in (10, 19, 20, 21, 40, 100, 200)] == [
        10,
        19,
        19,
        20,
        38,
        95,
        190,
    ]


@pytest.mark.parametrize("rule", [WORST_CASE, OVER_CONDITIONS, EASIER])
def test_the_fewest_trials_are_those_whose_interval_excludes_a_claim_that_mostly_fails(rule: VerificationRule) -> None:
    assert rule.min_trials == MIN_TRIALS
    assert clopper_pearson(rule.min_trials - 1, rule.min_trials - 1)[0] < MIN_RATE
    for trials in range(rule.min_trials, 300):
        assert clopper_pearson(rule.count_needed_successes(trials), trials)[0] >= MIN_RATE


@pytest.mark.parametrize("trials", range(1, 6))
def test_too_few_trials_find_nothing_even_if_all_succeed(trials: int) -> None:
    render = noisy(-3.0, 3.0, 0.1)
    result = verify(render, DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=trials)
    assert (result.adversarial_counts.n_successes, result.clean_counts.n_successes) == (trials, trials)
    assert result.ending is Ending.NOT_VERIFIED
    assert f"A success in {trials} of {trials} trials, 6 are needed" in result.counts_sentence
    enough = verify(render, DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=MIN_TRIALS)
    assert enough.ending is Ending.FOUND


def test_conditions_under_which_the_clean_scene_is_seldom_right_leave_too_few_trials() -> None:
    """Right in 5 of 10: those 5 may all succeed, and say nothing yet."""

    def render(query: Query) -> Evaluation:
        order = [derive_seed(0, "verification", number) for number in range(10)]
        hard = order.index(query.seed) % 2 == 1
        return judged(1.0 if hard or not torch.equal(query.u, DOMAIN.start) else -1.0)

    result = verify(
        partial(map, render), DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=10, rule=OVER_CONDITIONS
    )
    assert (result.adversarial_counts.n_successes, result.adversarial_counts.n_trials) == (5, 5)
    assert result.ending is Ending.NOT_VERIFIED


@pytest.mark.island("advsearch.questions.region")
def test_the_fewest_samples_of_a_region_follow_from_the_confidence_of_its_interval() -> None:
    from advsearch.questions.region.boxes import GrownBox
    from advsearch.questions.region.result import MIN_SAMPLES

    low, high = torch.zeros(1), torch.ones(1)
    for samples in (MIN_SAMPLES - 1, MIN_SAMPLES):
        region = GrownBox(low, low, high, samples, samples, samples)
        assert (region.interval[0] >= MIN_RATE) == (samples == MIN_SAMPLES)


@pytest.mark.island("advsearch.questions.region")
def test_the_interval_of_a_region_covers_although_it_is_sampled_until_nothing_differs() -> None:
    """Exactly, where a part of the box has another verdict wherever it is cut; without its correction it would not."""
    from advsearch.questions.region.boxes import GrownBox

    box, samples, attempts = torch.zeros(1), 50, 4
    shares = np.arange(samples + 1)
    ours = np.array([GrownBox(box, box, box, int(k), samples, samples).interval for k in shares])
    plain = np.array([clopper_pearson(int(k), samples) for k in shares])
    covered = []
    for ends in (ours, plain):
        covers = []
        for rate in np.linspace(0.005, 0.995, 199):
            chances, inside = binom.pmf(shares, samples, rate), (ends[:, 0] <= rate) & (rate <= ends[:, 1])
            again = (1.0 - chances[-1]) ** np.arange(attempts)
            early = chances[-1] * inside[-1] * again[:-1].sum()
            covers.append(early + again[-1] * (chances * inside).sum())
        covered.append(min(covers))
    assert covered[0] >= 0.95 > 0.93 > covered[1]


@pytest.mark.parametrize(
    ("search_ending", "clean", "adversarial", "expected"),
    [
        (Ending.FOUND, 20, 20, Ending.FOUND), (Ending.FOUND, 19, 19, Ending.FOUND),
        (Ending.FOUND, 20, 18, Ending.NOT_VERIFIED), (Ending.FOUND, 18, 18, Ending.NOT_VERIFIED),
        (Ending.FOUND, 18, 20, Ending.NOT_VERIFIED), (Ending.BUDGET_SPENT, 20, 19, Ending.FOUND),
        (Ending.BUDGET_SPENT, 20, 18, Ending.BUDGET_SPENT), (Ending.STALLED, 20, 0, Ending.STALLED),
        (Ending.NON_FINITE, 20, 0, Ending.NON_FINITE), (Ending.FOUND, 9, 9, Ending.ALREADY_WRONG),
        (Ending.BUDGET_SPENT, 0, 0, Ending.ALREADY_WRONG), (Ending.INTERRUPTED, 20, 20, Ending.INTERRUPTED),
    ],
)  # fmt: skip
def test_the_verdict(search_ending: Ending, clean: int, adversarial: int, expected: Ending) -> None:
    assert (
        WORST_CASE.decide_ending(search_ending, TrialCounts(clean, 20, 64), TrialCounts(adversarial, 20, 64))
        is expected
    )


def test_a_real_success_is_verified() -> None:
    result = verify(noisy(-3.0, 3.0, 0.3), DOMAIN, WORST, claim=Ending.FOUND, spp=64, seed=0)
    assert result.ending is Ending.FOUND
    assert (result.clean_counts.n_successes, result.adversarial_counts.n_successes, result.renders) == (20, 20, 40)
    assert result.adversarial_counts.spp == 64
    assert "A success in 20 of 20 trials, 19 are needed; clean right in 20 of 20." in result.counts_sentence


def test_a_success_counts_only_where_the_clean_one_is_right() -> None:
    """The clean margin is noise around zero: whatever the answer does, half of its trials prove nothing."""
    result = verify(noisy(-0.1, 5.0, 1.0), DOMAIN, WORST, claim=Ending.FOUND, spp=64, seed=0)
    assert all(trial.success for trial in result.adversarial_trials)
    assert result.adversarial_counts.n_successes == result.clean_counts.n_successes < 19
    assert result.ending in (Ending.NOT_VERIFIED, Ending.ALREADY_WRONG)


def test_a_start_that_is_wrong_already_is_no_find() -> None:
    result = verify(noisy(2.0, 5.0, 0.1), DOMAIN, WORST, claim=Ending.FOUND, spp=64, seed=0)
    assert result.ending is Ending.ALREADY_WRONG
    assert result.adversarial_counts.n_successes == 0
    assert result.ending.explanation in result.counts_sentence


@pytest.mark.parametrize("seed", range(5))
def test_a_lucky_claim_is_not_verified(seed: int) -> None:
    """The winner's curse: nothing in the budget beats margin -1, one logit of noise makes 60 renders look otherwise."""
    render = noisy(-1.2, -1.0, 1.0)
    claim = search(render, DOMAIN, Random(), steps=60, seed=seed, candidates=1, render_seed=seed)
    assert claim.claimed_objective > 0.2  # the raw claim: a success, 1.2 logits over anything there is
    result = verify(render, DOMAIN, claim.best_u, claim=Ending.FOUND, spp=64, seed=seed)
    assert result.ending is Ending.NOT_VERIFIED
    assert result.adversarial_counts.interval[1] < 0.9


def test_the_configuration_is_projected_again() -> None:
    result = verify(noisy(-3.0, 3.0, 0.1), DOMAIN, DOMAIN.start + 0.4, claim=Ending.FOUND, spp=1, seed=0)
    assert torch.equal(result.u, DOMAIN.upper_bounds)
    beyond = verify(noisy(-3.0, -1.0, 0.0), DOMAIN, DOMAIN.start + 0.4, claim=Ending.FOUND, spp=1, seed=0)
    assert beyond.ending is Ending.NOT_VERIFIED


def test_both_groups_get_the_same_fresh_seeds_and_the_control_can_be_shared() -> None:
    seeds: list[int] = []

    def render(query: Query) -> Evaluation:
        seeds.append(query.seed)
        return judged(-1.0 if torch.equal(query.u, DOMAIN.start) else 1.0)

    evaluate = partial(map, render)
    clean = run_trials(evaluate, DOMAIN.start, spp=8, seed=5, trials=6)
    shared = verify(evaluate, DOMAIN, WORST, claim=Ending.FOUND, spp=8, seed=5, trials=6, clean=clean)
    assert seeds[:6] == seeds[6:]
    assert len(set(seeds[:6])) == 6
    assert (shared.renders, shared.ending) == (6, Ending.FOUND)
    longer = verify(evaluate, DOMAIN, WORST, claim=Ending.FOUND, spp=8, seed=5, clean=clean)
    assert (len(longer.clean_trials), longer.renders) == (20, 34), "what is missing is tried"


def scripted(successes: str) -> Evaluate:
    """Trials of an answer that go as they are told, "1" a success; the clean one is right, but where "-" is told."""
    told = {derive_seed(0, "verification", number): what for number, what in enumerate(successes)}

    def render(query: Query) -> Evaluation:
        clean = torch.equal(query.u, DOMAIN.start)
        return judged(1.0 if told[query.seed] == ("-" if clean else "1") else -1.0)

    return partial(map, render)


@pytest.mark.parametrize("rule", [WORST_CASE, OVER_CONDITIONS])
@pytest.mark.parametrize("seed", range(40))
def test_curtailed_trials_end_with_the_verdict_of_all(rule: VerificationRule, seed: int) -> None:
    rng = np.random.default_rng(seed)
    share = rng.choice([0.0, 0.5, 0.85, 0.95])
    told = "".join(rng.choice(["1", "0", "-"], p=[share, 0.9 * (1 - share), 0.1 * (1 - share)], size=20))
    whole, short = (
        verify(scripted(told), DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, rule=rule, curtailed=curtailed)
        for curtailed in (False, True)
    )
    assert short.ending is whole.ending
    assert short.adversarial_trials == whole.adversarial_trials[: len(short.adversarial_trials)]
    assert short.renders == 20 + len(short.adversarial_trials)
    if whole.ending is Ending.FOUND:
        assert short.adversarial_counts == whole.adversarial_counts, "a success is tried to the end"


def test_a_curtailed_configuration_that_never_succeeds_is_tried_twice() -> None:
    made: list[str] = []

    def evaluate(queries: Sequence[Query]) -> Iterator[Evaluation]:
        for query, answer in zip(queries, scripted("0" * 20)(queries), strict=True):
            made.append(query.kind)
            yield answer

    found = verify(evaluate, DOMAIN, WORST, claim=Ending.BUDGET_SPENT, spp=1, seed=0, curtailed=True)
    assert made == ["control"] * 20 + ["verification"] * 2, "what nobody asks for any more is not made"
    assert (found.adversarial_counts.n_successes, found.adversarial_counts.n_trials, found.ending) == (
        0,
        2,
        Ending.BUDGET_SPENT,
    )


@pytest.mark.parametrize(
    ("told", "made", "ending"),
    [
        ("1" * 23, (14, 14), Ending.FOUND), ("0" + "1" * 22, (22, 23), Ending.FOUND),
        ("1" * 20 + "011", (14, 14), Ending.FOUND), ("0" + "1" * 20 + "01", (20, 22), Ending.NOT_VERIFIED),
        ("00" + "1" * 21, (4, 6), Ending.NOT_VERIFIED), ("-" + "1" * 22, (22, 23), Ending.FOUND),
        ("--" + "1" * 21, (4, 6), Ending.NOT_VERIFIED),
    ],
)  # fmt: skip
def test_trials_that_nobody_counted_end_with_the_verdict(told: str, made: tuple[int, int], ending: Ending) -> None:
    """Told are trials of the answer: successes, failures, and "-" where the clean scene is wrong."""
    found = verify(scripted(told), DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=TRIAL_LOOKS)
    assert (found.adversarial_counts.n_successes, found.adversarial_counts.n_trials) == made
    assert (found.ending, found.stop_reason) == (ending, "decided")
    clean = 23 if made[1] > 14 else 14
    assert (len(found.clean_trials), found.renders) == (clean, clean + made[1])


@pytest.mark.parametrize(
    ("told", "made", "clean", "ending"),
    [
        ("1" * 200, (30, 30), 30, Ending.FOUND), ("-1" * 100, (30, 30), 60, Ending.FOUND),
        ("0" + "1" * 199, (59, 60), 60, Ending.FOUND), ("00000" + "1" * 195, (95, 100), 100, Ending.FOUND),
        ("000000" + "1" * 194, (144, 150), 150, Ending.FOUND), ("0" * 10 + "1" * 190, (190, 200), 200, Ending.FOUND),
        ("-000" + "1" * 197, (97, 100), 101, Ending.FOUND), ("1" * 20 + "0" * 180, (20, 41), 60, Ending.NOT_VERIFIED),
        ("--1" * 67, (66, 66), 200, Ending.ALREADY_WRONG), ("-1" * 10 + "-" * 180, (10, 10), 200, Ending.ALREADY_WRONG),
    ],
)  # fmt: skip
def test_trials_over_conditions_end_with_the_verdict(
    told: str, made: tuple[int, int], clean: int, ending: Ending
) -> None:
    """As above; those count in which the clean scene is right."""
    rule = OVER_CONDITIONS
    found = verify(scripted(told), DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=OVER_LOOKS, rule=rule)
    assert (found.adversarial_counts.n_successes, found.adversarial_counts.n_trials, found.ending) == (*made, ending)
    assert len(found.clean_trials) == clean
    assert found.adversarial_counts.interval[0] < clopper_pearson(*made)[0], "it allows for all looks"


def test_a_configuration_over_conditions_goes_on_where_a_control_group_of_another_has_more_trials() -> None:
    """A random search beside it is tried last; what is looked at first are 30 that count all the same."""
    rule, told = OVER_CONDITIONS, "0" + "1" * 199
    first = verify(scripted(told), DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=OVER_LOOKS, rule=rule)
    again = partial(verify, scripted("1" * 200), DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, rule=rule)
    found = again(trials=OVER_LOOKS, clean=first.clean_trials)
    assert (found.adversarial_counts.n_trials, len(found.clean_trials), found.renders) == (30, 60, 30)


@pytest.mark.parametrize("counting", [29, 45, 101, 200])
def test_intervals_over_conditions_cover_as_often_as_they_say(counting: int) -> None:
    """Exactly, by the probability of every outcome, if so many of all trials count; the study takes all numbers."""
    study = runpy.run_path(str(STUDY))
    rates = np.linspace(0.01, 0.99, 197)
    assert study["over_coverage"](rates, counting).min() >= 0.95
    chances = study["over_outcomes"](np.array([0.85]), counting)
    assert sum(chance for chance, _ in chances.values()) == pytest.approx(1.0)
    if counting == 200:
        assert sum(chance for chance, found in chances.values() if found) < 0.033


def test_trials_that_were_asked_for_are_all_made() -> None:
    for told in ("0" * 20, "1" * 20):
        found = verify(scripted(told), DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=20)
        assert (found.adversarial_counts.n_trials, found.clean_counts.n_trials, found.stop_reason) == (
            20,
            20,
            "asked for",
        )


@pytest.mark.medium
@pytest.mark.parametrize(("trials", "rule"), [(20, WORST_CASE), (6, WORST_CASE), (200, OVER_CONDITIONS)])
def test_the_interval_of_curtailed_trials_covers_as_often_as_it_says(trials: int, rule: VerificationRule) -> None:
    """Exactly, by the probability of every outcome: the failure too many comes at trial n, or never."""
    failures = rule.count_allowed_failures(trials) + 1
    for rate in np.linspace(0.005, 0.995, 199):
        covered = 0.0
        for n in range(failures, trials + 1):
            low, high = clopper_pearson(n - failures, n)
            covered += stats.nbinom.pmf(n - failures, failures, 1.0 - rate) * (low <= rate <= high)
        for k in range(trials - failures + 1, trials + 1):
            low, high = clopper_pearson(k, trials)
            covered += stats.binom.pmf(k, trials, rate) * (low <= rate <= high)
        assert covered >= 0.95 - 1e-9, rate


def test_the_trials_of_a_group_are_asked_at_once() -> None:
    asked: list[list[tuple[object, ...]]] = []

    def evaluate(queries: Sequence[Query]) -> list[Evaluation]:
        asked.append([(one.kind, one.row_index, one.spp, one.phase, one.includes_image) for one in queries])
        return list(noisy(-1.0, 1.0, 0.0)(queries))

    verify(evaluate, DOMAIN, WORST, claim=Ending.FOUND, spp=4, seed=0, trials=3, kind="baseline", n_images=1)
    control = [("control", number, 4, None, False) for number in range(3)]
    assert asked == [control, [("baseline", number, 4, None, number == 0) for number in range(3)]]


def test_a_nan_margin_is_neither_right_nor_wrong() -> None:
    nothing = partial(map, lambda query: judged(math.nan))
    result = verify(nothing, DOMAIN, WORST, claim=Ending.FOUND, spp=1, seed=0, trials=4)
    assert (result.clean_counts.n_successes, result.adversarial_counts.n_successes) == (0, 0)
    assert result.ending is not Ending.FOUND


@pytest.mark.parametrize(
    ("options", "message"),
    [({"trials": 0}, "trials: expected at least 1, got 0"), ({"spp": 0}, "verify_spp: expected at least 1, got 0")],
)
def test_bad_trial_counts_are_refused(options: dict[str, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        verify(noisy(-1, 1, 0), DOMAIN, WORST, claim=Ending.FOUND, seed=0, **({"spp": 4} | options))  # type: ignore[arg-type]


def test_every_ending_has_a_value_for_json_and_a_sentence() -> None:
    values = {ending.value for ending in Ending}
    assert values >= {
        "found",
        "budget spent",
        "not verified",
        "stalled",
        "non-finite objective",
        "interrupted",
        "already wrong",
    }
    for ending in Ending:
        assert ending.explanation.endswith(".")
