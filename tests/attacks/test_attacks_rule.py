"""By which rule a claim is verified, on judgements alone."""

import pytest
import torch

from advsearch.attacks import Block, Domain, Ending, Evaluation, TrialCounts, verify
from advsearch.attacks.verification import EASIER, OVER_CONDITIONS, WORST_CASE, VerificationRule
from advsearch.tasks import Judgement, Prediction

DOMAIN = Domain(torch.zeros(1), (Block(1),))


def trials(values: list[tuple[float, bool]]) -> list[Judgement]:
    return [Judgement(score, -score, right, Prediction("")) for score, right in values]


def run(
    rule: VerificationRule, clean: list[tuple[float, bool]], found: list[tuple[float, bool]]
) -> tuple[Ending, int, int]:
    result = verify(
        lambda queries: [Evaluation.from_judgement(trials(found)[one.row_index]) for one in queries],
        DOMAIN,
        DOMAIN.start,
        claim=Ending.BUDGET_SPENT,
        spp=1,
        seed=0,
        trials=len(found),
        clean=trials(clean),
        rule=rule,
    )
    return result.ending, result.adversarial_counts.n_successes, result.adversarial_counts.n_trials


def test_over_conditions_those_count_in_which_the_clean_scene_is_right() -> None:
    clean = [(-1.0, True)] * 10 + [(1.0, False)] * 10
    wrong, right = (1.0, False), (-1.0, True)
    assert run(OVER_CONDITIONS, clean, [wrong] * 9 + [right] + [right] * 10) == (Ending.FOUND, 9, 10)
    assert run(OVER_CONDITIONS, clean, [wrong] * 8 + [right] * 2 + [wrong] * 10) == (Ending.BUDGET_SPENT, 8, 10)
    assert run(WORST_CASE, clean, [wrong] * 20) == (Ending.BUDGET_SPENT, 10, 20)
    mostly_wrong = [(-1.0, True)] * 9 + [(1.0, False)] * 11
    assert run(OVER_CONDITIONS, mostly_wrong, [wrong] * 20)[0] is Ending.ALREADY_WRONG


def test_a_target_reached_where_the_clean_prediction_was_wrong_does_not_count() -> None:
    clean = [(-3.0, True)] * 19 + [(-1.0, False)]  # the last is wrong without being the target
    assert run(WORST_CASE, clean, [(1.0, False)] * 20) == (Ending.FOUND, 19, 20)


def test_easier_means_right_and_surer_than_the_clean_scene() -> None:
    clean = [(-1.0, False)] * 20
    assert run(EASIER, clean, [(2.0, True)] * 20) == (Ending.FOUND, 20, 20)
    sure = [(3.0, True)] * 20
    assert run(EASIER, sure, [(2.0, True)] * 20) == (Ending.BUDGET_SPENT, 0, 20)
    assert run(EASIER, sure, [(4.0, True)] * 20)[0] is Ending.FOUND


def test_no_trial_is_no_proof() -> None:
    assert (
        OVER_CONDITIONS.decide_ending(Ending.BUDGET_SPENT, TrialCounts(10, 20, 1), TrialCounts(0, 1, 1))
        is Ending.BUDGET_SPENT
    )


@pytest.mark.parametrize(
    ("successes", "decided"), [(20, True), (19, True), (18, None), (2, None), (1, False), (0, False)]
)
def test_trials_of_one_configuration_decide_unless_they_depend_on_the_noise(
    successes: int, decided: bool | None
) -> None:
    assert WORST_CASE.decide(successes, 20) is decided
