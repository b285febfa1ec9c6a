"""The different failures that a policy answers with: some of them tried with fresh seeds, all of them in words."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Ending, SearchResult, count_right
from advsearch.attacks.candidates import FoundFailure
from advsearch.engine.pictures import save_marked
from advsearch.engine.problem import Problem
from advsearch.engine.record import Findings
from advsearch.engine.rows import verified_rate
from advsearch.engine.verifier import Verifier
from advsearch.runs.directory import RunDirectory
from advsearch.runs.results.attack import (
    DescribedValue,
    DifferentFailure,
    DifferentFailures,
    FailingShare,
    PicturedAnswer,
)
from advsearch.tasks import Judgement

TRIED = 8
"""Different failures that are tried, at most: the first of the list."""


def check_failures(verifier: Verifier, found: SearchResult) -> None:
    """Verify the first of the different failures that a search answers with, each for itself.

    Each has the fewest trials that can verify anything, with the seeds that the control group had, up to the first that
    decides against it. Where the clean scene was not right in all of these, it has as many as the answer. Over
    conditions that vary one answer takes hundreds of trials, and nothing is tried here.
    """
    problem, findings = verifier.problem, verifier.findings
    known, rule = found.failures, problem.rule
    if known is None or not known.listed or rule.conditional or rule.already_wrong(count_right(findings.clean, 1)):
        return
    fewest = rule.fewest
    whole = rule.control and not all(trial.right for trial in findings.clean[:fewest])
    trials = None if whole else fewest
    tried = known.listed[:TRIED]
    verifier.begin(
        "checking different failures with fresh renders", len(tried) * (trials or verifier.count), at_most=True
    )
    checked = []
    for number, failure in enumerate(tried):
        claim = replace(found, best_u=failure.u)
        checked.append(verifier.verified(f"failure {number}", claim, trials=trials, curtailed=True))
    findings.failures = tuple(checked)


def write_failures(run: RunDirectory, problem: Problem, findings: Findings) -> None:
    """Write a picture of each failure that was tried, as the model saw it in its first trial."""
    for number, checked in enumerate(findings.failures):
        seed, name = seeds.stream(problem.seed, "verification", 0), _picture(number)
        seen = findings.pictures.get((f"failure {number}", 0))
        seen = problem.picture(checked.u, seed, findings.spp) if seen is None else seen
        run.save_image(name, seen)
        save_marked(run, name, seen, problem.marks(seen, problem.whole(checked.u, seed)))


def described_failures(problem: Problem, findings: Findings) -> DifferentFailures | None:
    """Return what a summary says of the different failures; None of a policy that looks for one."""
    known = findings.search.failures if findings.search else None
    if known is None:
        return None
    listed = [_described(problem, findings, number, failure) for number, failure in enumerate(known.listed)]
    return DifferentFailures(
        over=[problem.domain.names[place] for place in known.over],
        found=known.found,
        seen=known.seen,
        places=known.places,
        share=None if known.share is None else FailingShare.of(known.share),
        tried=len(findings.failures),
        held=sum(one.ending is Ending.FOUND for one in findings.failures),
        listed=listed,
    )


def _described(problem: Problem, findings: Findings, number: int, failure: FoundFailure) -> DifferentFailure:
    checked = findings.failures[number] if number < len(findings.failures) else None
    names, ranges = problem.domain.names, failure.ranges
    return DifferentFailure(
        ranges={names[place]: _range(problem, failure.u, place, ends) for place, ends in ranges.items()},
        configuration={name: DescribedValue.of(value) for name, value in problem.describe(failure.u).items()},
        objective=failure.objective,
        holds=None if checked is None else checked.ending is Ending.FOUND,
        verified=None if checked is None else verified_rate(checked),
        picture=None if checked is None else f"images/{_picture(number)}.png",
        pictured=None if checked is None else _pictured(checked.adversarial_trials[0]),
    )


def _pictured(first: Judgement) -> PicturedAnswer:
    return PicturedAnswer(**vars(first.answer), payload=first.payload, trial=0)


def _picture(number: int) -> str:
    return f"failure-{number:02d}"


def _range(problem: Problem, u: Tensor, place: int, ends: tuple[float, float]) -> tuple[float, float] | str:
    """Return both ends of one element of u in its parameter's unit, the option of a choice; in u where it is not told
    by itself."""
    block, said = problem.domain.block_of(place), list[float]()
    for end in ends:
        moved = u.clone()
        moved[place] = u[place] if block.options else end
        value = problem.describe(moved).get(block.name, {"value": end, "unit": "1"})["value"]
        if isinstance(value, str):
            return value
        said.append(float(value) if block.size == 1 else end)
    return min(said), max(said)
