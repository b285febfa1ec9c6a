"""Objectives, domains, policies, the one search loop and verification. Torch, numpy and scipy only: no renderer."""

from __future__ import annotations

from advsearch.attacks.domain import Block, Domain
from advsearch.attacks.ending import Ending
from advsearch.attacks.evaluation import Evaluate, Evaluation, Wanted
from advsearch.attacks.objectives import (
    OBJECTIVES,
    Objective,
    cross_entropy,
    get_objective,
    margin,
    stop_at_margin,
    succeeded,
)
from advsearch.attacks.policies import (
    PGD,
    POLICIES,
    Auto,
    Policy,
    Proposal,
    Random,
    make_policy,
)
from advsearch.attacks.sample_count import Rung, SampleCount, choose_spp
from advsearch.attacks.search import SearchResult, StepRecord, planned_renders, search
from advsearch.attacks.trials import Trials, clopper_pearson
from advsearch.attacks.verification import (
    Trial,
    Verification,
    already_wrong,
    count_right,
    needed,
    run_trials,
    typical,
    verdict,
    verify,
)

__all__ = [
    "OBJECTIVES",
    "PGD",
    "POLICIES",
    "Auto",
    "Block",
    "Domain",
    "Ending",
    "Evaluate",
    "Evaluation",
    "Objective",
    "Policy",
    "Proposal",
    "Random",
    "Rung",
    "SampleCount",
    "SearchResult",
    "StepRecord",
    "Trial",
    "Trials",
    "Verification",
    "Wanted",
    "already_wrong",
    "choose_spp",
    "clopper_pearson",
    "count_right",
    "cross_entropy",
    "get_objective",
    "make_policy",
    "margin",
    "needed",
    "planned_renders",
    "run_trials",
    "search",
    "stop_at_margin",
    "succeeded",
    "typical",
    "verdict",
    "verify",
]
