"""Problems of attacks, for experiments that render and judge configurations of their own.

    from advsearch.extend import problems

    parts = problems.parts_of(config)  # what the settings of an attack name, found and loaded
    problem = problems.problem_on(parts, differentiated=False)  # renders and judges a configuration
    journal = problems.Journal(run, problems.Shared(problem))  # stores each evaluation, and reads it back
    query = problems.Query(u, seed, "trial", 0, spp=16)
    (evaluation,) = journal.evaluate_all([query])

The module imports torch. Modules that the command line reads for its help import it inside functions.
"""

from __future__ import annotations

from advsearch.attacks.evaluation import Query
from advsearch.attacks.verification import LEAST_RATE, OVER_CONDITIONS
from advsearch.engine.image_changes import AWAY, as_claimed, changed
from advsearch.engine.journal import Journal, Shared, worker_call
from advsearch.engine.record import control_group, verified_rate
from advsearch.engine.verifier import RetrialCondition, Retrials, kept_configuration, ladder_of
from advsearch.options import count_outcomes
from advsearch.questions.attack.carry_out import (
    LOADING,
    ROLES_IN_SEARCH,
    AttackParts,
    check_from_config,
    executor_for,
    judged_alone,
    parts_in,
    parts_of,
    problem_from_config,
    problem_of,
    problem_of_parts,
    problem_on,
)
from advsearch.questions.attack.summary import AttackSummary, attack_of

__all__ = [
    "AWAY",
    "LEAST_RATE",
    "LOADING",
    "OVER_CONDITIONS",
    "ROLES_IN_SEARCH",
    "AttackParts",
    "AttackSummary",
    "Journal",
    "Query",
    "RetrialCondition",
    "Retrials",
    "Shared",
    "as_claimed",
    "attack_of",
    "changed",
    "check_from_config",
    "control_group",
    "count_outcomes",
    "executor_for",
    "judged_alone",
    "kept_configuration",
    "ladder_of",
    "parts_in",
    "parts_of",
    "problem_from_config",
    "problem_of",
    "problem_of_parts",
    "problem_on",
    "verified_rate",
    "worker_call",
]
