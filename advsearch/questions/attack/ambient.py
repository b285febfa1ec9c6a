"""How bright ambient light may become before an adversarial pattern of light fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import (
    Ending,
    verify,
)
from advsearch.engine.journal import ProblemKey, Shared
from advsearch.engine.problem import Problem
from advsearch.engine.verifier import Verifier

BRIGHTEST = 1e5  # Lux of direct sun: nothing is tried beyond
HALVED = 2
"""How often the step between the last ambient light in which it holds and the first in
which it does not is halved: to a factor of 1.19.
"""


def find_ambient(verifier: Verifier, u: Tensor) -> None:
    """Try a verified configuration (d,) in twice the ambient light, and twice that,
    until it no longer holds.

    Nothing else changes: exposure follows the ambient light, so that the projector is
    the darker one. All points have the same seeds, which nothing else has. What comes
    of it is in `verifier.findings`.
    """
    problem = verifier.problem
    findings = verifier.findings
    ambients = [
        bound.ambient
        for bound in problem.searched_space.controls
        if bound.competes_with_ambient
    ]
    own = ambients[0] if ambients else None  # and None where they are searched too
    if own is None or findings.verification is None:
        return
    tried = findings.ambient
    tried[own] = findings.verification

    def holds(lux: float) -> bool:
        title = f"trying it in ambient light of {lux:.3g} lux"
        verifier.begin(title, 2 * verifier.count, name="ambient", at_most=True)
        shared = verifier.journal.traced
        there = Shared(in_light(problem, lux / own), shared.executor, lux / own)
        journal = replace(verifier.journal, traced=there)
        tried[lux] = verify(
            replace(verifier, journal=journal).evaluate_all, problem.domain, u, claim=Ending.FOUND, spp=findings.spp,
            seed=seeds.stream(problem.seed, "ambient"), trials=verifier.looks, rule=problem.rule,
            kind=f"ambient {lux:.6g} lux", control=f"control {lux:.6g} lux",
        )  # fmt: skip
        return tried[lux].ending is Ending.FOUND

    good = own
    bad = 2.0 * own
    while bad <= BRIGHTEST and holds(bad):
        good = bad
        bad = 2.0 * bad
    for _ in range(HALVED if bad in tried else 0):
        between = (good * bad) ** 0.5
        good, bad = (between, bad) if holds(between) else (good, between)


def problems_by_key(problem: Problem) -> Callable[[ProblemKey], Problem]:
    """Return what gives a worker the problem of a query: that of the run, or for a
    number the same in so many times the ambient light.
    """
    brightened = lru_cache(maxsize=2)(partial(in_light, problem))
    return lambda key: brightened(key) if isinstance(key, float) else problem


def in_light(problem: Problem, times: float) -> Problem:
    controls = [bound.in_light(times) for bound in problem.space.controls]
    space = replace(problem.space, controls=tuple(controls))
    renderer = problem.renderer.like()
    renderer.space = space
    return replace(problem, space=space, renderer=renderer)
