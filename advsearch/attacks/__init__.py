"""Objectives, domains, policies, the one search loop and verification. No renderer."""

from __future__ import annotations

from typing import Any

from advsearch.attacks.domain import Block, Domain
from advsearch.attacks.evaluation import (
    Evaluate,
    Evaluated,
    Evaluation,
    Policy,
    Proposal,
    Query,
    draw_seed,
    seeded,
)
from advsearch.attacks.objective_functions import margin
from advsearch.attacks.objectives import OBJECTIVES, Objective, get_objective
from advsearch.attacks.policies import POLICIES, make_policy
from advsearch.attacks.policies.auto import Auto
from advsearch.attacks.policies.choices import Choices
from advsearch.attacks.policies.evolution import CMAES, NES
from advsearch.attacks.policies.pgd import PGD
from advsearch.attacks.policies.sampling import Grid, Random
from advsearch.attacks.search import (
    SearchResult,
    StepRecord,
    count_planned_renders,
    search,
)
from advsearch.attacks.trials import SampleCount, TrialCounts, choose_spp
from advsearch.attacks.verification import (
    Ending,
    Verification,
    count_right,
    run_trials,
    verify,
)
from advsearch.registry import get_class
from advsearch.statistics.intervals import clopper_pearson


def __getattr__(name: str) -> Any:
    """Import the class of a policy that is an island on first use."""
    return get_class("policy", name)


__all__ = [
    "CMAES",
    "NES",
    "OBJECTIVES",
    "PGD",
    "POLICIES",
    "Auto",
    "Block",
    "Choices",
    "Domain",
    "Ending",
    "Evaluate",
    "Evaluated",
    "Evaluation",
    "Grid",
    "Objective",
    "Policy",
    "Proposal",
    "Query",
    "Random",
    "SampleCount",
    "SearchResult",
    "StepRecord",
    "TrialCounts",
    "Verification",
    "choose_spp",
    "clopper_pearson",
    "count_planned_renders",
    "count_right",
    "draw_seed",
    "get_objective",
    "make_policy",
    "margin",
    "run_trials",
    "search",
    "seeded",
    "verify",
]
