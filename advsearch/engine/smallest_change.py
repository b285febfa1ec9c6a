"""The smallest change that flips the answer: searches and trials in turn, within ever smaller budgets."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Domain, Ending, SearchResult
from advsearch.attacks.smallest import ATTEMPTS, MOST_CHECKS, ROUNDS, confirmed, smallest
from advsearch.engine.searches import Searches
from advsearch.engine.transport import Transport
from advsearch.engine.verifier import Verifier

CONFIRMED = 40
"""Trials in a row that the upper end of a smallest epsilon has to pass, or as many checks as have them."""


def find_smallest(searches: Searches, verifier: Verifier) -> None:
    """Bracket the smallest epsilon; every claim on the way goes through trials with seeds of its own.

    On the way the fewest trials that can verify anything are enough where none fails. The upper end is tried again in
    full, and what is verified at the end is the configuration there.
    """
    problem, findings, trials = searches.problem, searches.findings, verifier.count
    results: list[SearchResult] = []
    transport = findings.transport if isinstance(findings.transport, Transport) else None

    def found(inside: Domain, number: int) -> Tensor:
        searches.begin(
            "search", f"search {number + 1} of at most {ROUNDS}", problem.steps, "`steps` shortens each search"
        )
        kind, seed = f"search {number}" if number else "search", seeds.stream(problem.seed, "smallest", number)
        ranked = transport is None  # what is predicted has no noise
        results.append(searches.search(kind, searches.policy, problem.steps, seed, domain=inside, ranked=ranked))
        findings.search = findings.search or results[0]  # the answer if this is interrupted
        verifier.begin("trying smaller changes", MOST_CHECKS * trials, at_most=True)
        return results[-1].best_u

    def passes(u: Tensor, check: int, few: int = trials) -> bool:
        """Whether all trials together pass; so `few` do without a failure."""
        allowed, scores, failures = problem.rule.allowed(trials), list[float](), 0
        while len(scores) < trials and failures <= allowed and (failures or len(scores) < few):
            (trial,) = verifier.trials(f"check {check}", {len(scores): u})
            scores.append(trial.score)
            failures += not trial.success
        if transport is not None:
            transport.correct(u, scores)
        if failures <= allowed:
            findings.search = replace(results[-1], best_u=u)
        return failures <= allowed

    def seems(u: Tensor, check: int) -> bool:
        return passes(u, check, problem.rule.fewest)

    times = -(-CONFIRMED // trials)
    bracket = smallest(found, seems, problem.domain, likely=None if transport is None else transport.likely)
    if bracket.u is not None:
        most = ATTEMPTS * times * trials
        verifier.begin("checking the smallest change", most, at_most=True)
    bracket = confirmed(bracket, passes, problem.domain, times=times)
    renders, gradients = sum(one.renders for one in results), sum(one.gradients for one in results)
    answer = results[0].best_u if bracket.u is None else bracket.u
    ending = results[0].ending if bracket.u is None else Ending.FOUND
    findings.smallest = bracket
    own = results[0 if bracket.u is None else bracket.found_by]
    findings.search = replace(own, best_u=answer, ending=ending, renders=renders, gradients=gradients)
