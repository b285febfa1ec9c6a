"""Objectives, domains, policies, the one search loop and verification. No renderer."""

from __future__ import annotations

from advsearch.attacks.domain import Block, Domain
from advsearch.attacks.evaluation import Evaluate, Evaluation, Query
from advsearch.attacks.objectives import OBJECTIVES, Objective, get_objective, margin
from advsearch.attacks.policies import (
    CMAES,
    NES,
    PGD,
    POLICIES,
    Adam,
    Auto,
    Choices,
    Evaluated,
    Grid,
    Policy,
    Portfolio,
    Proposal,
    Random,
    Restarts,
    Sobol,
    draw_seed,
    make_policy,
    seeded,
)
from advsearch.attacks.search import SearchResult, StepRecord, planned_renders, search
from advsearch.attacks.trials import SampleCount, Trials, choose_spp, clopper_pearson
from advsearch.attacks.verification import Ending, Verification, count_right, run_trials, verify

__all__ = [
    "CMAES", "NES", "OBJECTIVES", "PGD", "POLICIES", "Adam", "Auto", "Block", "Choices", "Domain", "Ending", "Evaluate",
    "Evaluated", "Evaluation", "Grid", "Objective", "Policy", "Portfolio", "Proposal", "Query", "Random", "Restarts",
    "SampleCount", "SearchResult", "Sobol", "StepRecord", "Trials", "Verification", "choose_spp", "clopper_pearson",
    "count_right", "draw_seed", "get_objective", "make_policy", "margin", "planned_renders", "run_trials", "search",
    "seeded", "verify",
]  # fmt: skip
