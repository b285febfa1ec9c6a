"""The different failures of an archive: tried with fresh seeds by the rule of any answer, and told in words."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Ending, Evaluation, Query, SearchResult
from advsearch.attacks.candidates import FailureRate, Failures, FoundFailure
from advsearch.attacks.verification import TRIAL_LOOKS, VerificationRule
from advsearch.engine.journal import Journal, ParallelEvaluator
from advsearch.engine.verifier import Verifier
from advsearch.progress import NullProgress, Stages
from advsearch.questions.attack.display import failures_text, make_failures_part
from advsearch.questions.attack.outcome import describe_failures
from advsearch.questions.attack.stages import MAX_TRIED_FAILURES, verify_failures
from advsearch.questions.attack.summary import DifferentFailures
from stand_ins import StandInProblem

NAMED = Domain(torch.full((3,), 0.5), (Block(1, name="u.0"), Block(1, name="u.1"), Block(1, name="kind", n_options=2)))


class Coin(StandInProblem):
    """Wrong wherever the first number is over 0.6, and where it is over 0.3 by a coin that the seed throws."""

    def evaluate(self, query: Query) -> Evaluation:
        first = float(query.u[0])
        wrong = first > 0.6 or (first > 0.3 and query.seed % 2 == 0)
        return super().evaluate(replace(query, u=torch.linspace(0.3, 0.8, 6) if wrong else torch.zeros(6)))

    def describe(self, u: Tensor, draw: int | None = None) -> dict[str, Any]:
        said = {f"u.{number}": {"value": 90.0 * float(u[number]), "unit": "degrees"} for number in range(2)}
        return {**said, "kind": {"value": "brass" if float(u[2]) < 0.5 else "wood", "unit": "name"}}


def failure(first: float, objective: float = 1.0) -> FoundFailure:
    return FoundFailure(torch.tensor([first, 0.5, 0.25]), objective, {0: (first - 0.05, first + 0.05), 2: (0.0, 0.5)})


def checked(known: Failures, *, rule: VerificationRule | None = None, trials: int = 20) -> Verifier:
    """An attack of which everything but the different failures has been checked."""
    problem: Any = Coin(domain=NAMED)
    problem.verification_rule = rule or problem.verification_rule
    verifier = Verifier(Journal(None, ParallelEvaluator(problem)), (8,), Stages(NullProgress()), look_sizes=TRIAL_LOOKS)
    nothing = (0.0, 0.0, 0.0, Ending.FOUND, Ending.FOUND, (), (), 1, 0, 0, 0, 0.0)
    found = SearchResult(torch.full((3,), 0.5), *nothing, failures=known)
    verifier.run_state.search_result = found
    verifier.choose_spp({"clean": NAMED.start})
    clean = tuple(StandInProblem().evaluate(Query(torch.zeros(6), seed)).required_judgement for seed in range(trials))
    verifier.run_state.clean_trials = clean
    verify_failures(verifier, found)
    return verifier


def failures(*firsts: float) -> Failures:
    return Failures(tuple(failure(first, 4.0 - first) for first in firsts), (0, 2), 30, 50, 100)


def described(verifier: Verifier) -> DifferentFailures:
    told = describe_failures(verifier.problem, verifier.run_state)
    assert told is not None
    return told


def test_each_is_tried_until_it_is_clear_and_a_lucky_one_does_not_hold() -> None:
    told = described(checked(failures(0.9, 0.45, 0.8, 0.2)))
    assert [one.holds for one in told.listed] == [True, False, True, False]
    assert [one.verified.trials for one in told.listed if one.verified][0::2] == [14, 14]
    assert told.listed[3].verified is not None and told.listed[3].verified.trials == 2
    assert (told.tried, told.verified, told.found) == (4, 2, 30)


def test_no_more_are_tried_than_is_said_and_the_rest_is_a_claim() -> None:
    told = described(checked(failures(*[0.95] * (MAX_TRIED_FAILURES + 3))))
    assert told.tried == MAX_TRIED_FAILURES
    assert [one.holds for one in told.listed[MAX_TRIED_FAILURES:]] == [None] * 3
    assert failures_text(told).endswith(
        f"with fresh renders {MAX_TRIED_FAILURES} of the {MAX_TRIED_FAILURES} that were tried hold"
    )
    assert (
        len(make_failures_part(told).rows) == MAX_TRIED_FAILURES + 3
        and len(make_failures_part(told, tried=True).rows) == MAX_TRIED_FAILURES
    )
    assert make_failures_part(told).rows[-1][2] == "not tried"


def test_without_cells_it_is_draws_and_the_share_of_all_that_fails() -> None:
    share = FailureRate(0.034, (0.021, 0.08), 22.5, 500)
    known = replace(
        failures(0.9), cell_parameter_indices=(), n_failures=70, n_visited=500, n_cells=None, failure_rate=share
    )
    told = described(checked(known))
    assert failures_text(told).startswith(
        "claimed in 70 of 500 draws; of all configurations 2.1-8 % fail in one render (95 % interval), 3.4 % by the "
    )
    assert told.to_dict()["share"] == {"estimate": 0.034, "interval": [0.021, 0.08], "effective": 22.5, "draws": 500}
    few = described(checked(replace(known, failure_rate=replace(share, estimate=None))))
    assert "2.1-8 % fail in one render (95 % interval); with fresh" in failures_text(few)
    assert (
        make_failures_part(described(checked(Failures((replace(failure(0.9), ranges={}),), (), 1, 9, None)))).rows[0][0]
        == "anywhere"
    )
