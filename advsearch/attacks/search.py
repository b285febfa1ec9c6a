"""The one search loop: it owns the budget, stopping, the best so far and the log.
Policies only propose.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from advsearch.attacks.candidates import (
    Candidate,
    Failures,
    add_candidate,
    replace_worst,
    select_best,
    select_contenders,
)
from advsearch.attacks.domain import TOLERANCE, Distribution, Domain
from advsearch.attacks.evaluation import (
    Counts,
    Evaluate,
    Evaluation,
    Phase,
    Policy,
    Proposal,
    Query,
    max_batch_size,
)
from advsearch.attacks.policies.choices import wrap_choices
from advsearch.attacks.verification import Ending
from advsearch.copies import copy_value
from advsearch.errors import InputError
from advsearch.interrupts import interruptible
from advsearch.seeds import stream

NON_FINITE_LIMIT = 3  # non-finite objectives in a row after which a search gives up


@dataclass(frozen=True)
class StepRecord:
    """One evaluation, without its tensors."""

    step: int  # number of the evaluation, from 0; ranking goes on counting
    seed: int  # seed that it was rendered with
    phase: Phase  # "search", or "ranking" for a candidate rendered again at the end
    objective: float  # raw; NaN where it was not finite
    # best raw objective of the search so far, biased upwards; NaN before there is one
    best: float
    success: bool  # whether the model was wrong on this render
    # the policy's, in units of each block's radius; NaN where it has none
    step_size: float
    gradient_norm: float  # l2 norm of the gradient after cleaning; NaN without one
    non_finite: int  # gradient elements that had to be set to zero
    seconds: float  # seconds that the evaluation took
    # renders that all evaluations so far took together, this one included
    renders: int = 0
    samples: int = 1  # multiple of the search's samples per pixel; see `Proposal`


IsOutOfTime = Callable[[int], bool]
"""Number of evaluations so far -> whether the time is over."""

OnStep = Callable[[StepRecord, Tensor, Evaluation], None]
"""Called after every evaluation, ranking included, with its record, u, and the (usable)
evaluation.
"""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search claims. Only `verify` turns a claim into a finding (docs/design.md,
    "Verification").
    """

    # (d,) float32, what the search found; the start if nothing could be evaluated
    best_u: Tensor
    best_objective: float
    """Mean objective of `best_u` in its new renders; its raw one if it had none. NaN if
    nothing could be evaluated, or one of these renders was not finite.
    """
    claimed_objective: float  # the raw objective in the search, biased upwards
    # fraction of its new renders (else of its single raw render) that the model got
    # wrong
    success_rate: float
    # INTERRUPTED; FOUND if that rate is at least a half; else why the search stopped
    ending: Ending
    stopped: Ending  # why the loop stopped, whatever it had found
    history: tuple[StepRecord, ...]  # one record per evaluation of the search itself
    ranking: tuple[StepRecord, ...]  # one record per new render of a candidate
    # pictures in all, those that differences took and those of the ranking included
    renders: int
    gradients: int  # how many of them included a gradient
    non_finite_objectives: int  # evaluations whose objective was NaN or infinite
    # gradient elements that were set to zero, over all evaluations
    non_finite_elements: int
    seconds: float  # total time, evaluations included
    agreement: tuple[float, ...] = ()
    """Cosine similarities of each gradient with the one before, in their order: 1 less
    what noise and the step between them changed. Gradients of zero are left out.
    """
    # what the policy had to do about gradients and steps
    counts: Counts = field(default_factory=Counts)
    # what the policy found besides `best_u`, if it finds a distribution
    distribution: Distribution | None = None
    # what the policy knows of different failures, if it looks for them
    failures: Failures | None = None


def count_planned_renders(
    steps: int, candidates: int = 4, repeats: int = 2, max_extra_repeats: int = 0
) -> int:
    """Return how many pictures `search` renders at most with these arguments."""
    return steps + candidates * (repeats + max_extra_repeats)


def search(
    evaluate: Evaluate,
    domain: Domain,
    policy: Policy[Any],
    *,
    steps: int,
    seed: int,
    candidates: int = 4,
    repeats: int = 2,
    max_extra_repeats: int = 0,
    on_step: OnStep | None = None,
    seconds: float | None = None,
    is_out_of_time: IsOutOfTime | None = None,
    kind: str = "search",
    render_seed: int = 0,
) -> SearchResult:
    """Run one policy on one domain and return the worst configuration it found.

    1. Until `steps` renders are spent, the policy proposes a batch of configurations
       that do not depend on each other's results. Each is checked against the domain
       and evaluated with a new seed (docs/design.md, "The search"); then the policy is
       updated. An evaluation costs `Proposal.max_cost` renders at most. What the budget
       cannot pay is not requested.
    2. The `candidates` best distinct configurations are rendered `repeats` times again,
       without gradient, all with the same new seeds. The best by these renders is what
       the search found: the best of step 1 is partly a lucky one. With `candidates=0`,
       for an objective without noise, the best of step 1 is returned.
       If every evaluation draws conditions (`Domain.draws_conditions`), the best of
       step 1 had conditions that made it easy to fail. So the last configuration of the
       policy replaces the worst candidate.
       Candidates that are not clearly worse than the best one are then rendered again,
       up to `max_extra_repeats` times (`candidates.select_contenders`).

    A policy that does not handle discrete choices is wrapped in `Choices` where the
    domain has some.

    A non-finite objective is counted, is never best, and reaches the policy as -inf.
    `NON_FINITE_LIMIT` of them in a row end the search. KeyboardInterrupt ends it at any
    time, and the result is made of the evaluations until then.

    Args:
        evaluate: renders queries and yields their evaluations, one by one.
        domain: where to search.
        policy: proposes the configurations.
        steps: number of renders in step 1, at least 1. It is the number of evaluations
            too if gradients cost no renders. All are spent, also after a failure: the
            worst case is searched, not the first failure.
        seed: root seed of the policy's randomness, at least 0.
        candidates: number of configurations that step 2 renders again.
        repeats: renders of each candidate in step 2.
        max_extra_repeats: largest number of further renders of each. Step 2 costs at
            most `candidates * (repeats + max_extra_repeats)` renders.
        on_step: called after every evaluation.
        seconds: time limit of step 1, over 0; None for no limit. It is checked after
            each evaluation, so there is always one, and step 2 comes on top. Policies
            still plan for `steps`.
        is_out_of_time: returns whether the time is over, by the number of evaluations.
            It replaces `seconds` in a run that is resumed, which must stop where it
            stopped before.
        kind: kind of the queries; it also names the stream of their seeds.
        render_seed: root seed of the noise of the renders, at least 0.

    Raises:
        InputError: steps, candidates, repeats, max_extra_repeats or seconds out of
            range, or the policy cannot search this domain.
        RuntimeError, ValueError: the policy left the domain or `evaluate` broke its
            contract; a bug.
    """
    _check_limits(steps, candidates, repeats, max_extra_repeats, seconds)
    started = time.perf_counter()
    # one candidate is stored even if none is rendered again: it is the result
    log = _Log(evaluate, domain, on_step, max(1, candidates), kind, render_seed)
    try:
        with interruptible():
            deadline = math.inf if seconds is None else started + seconds
            stopped = _explore(
                log,
                policy,
                steps,
                seed,
                is_out_of_time or (lambda _: time.perf_counter() >= deadline),
            )
            if domain.draws_conditions:
                log.pool = replace_worst(log.pool, log.last, log.size)
            if candidates:
                # Step 1 used seed indices below `steps` at most.
                _rank(log, steps, repeats, max_extra_repeats)
    except KeyboardInterrupt:
        stopped = Ending.INTERRUPTED
    return _make_result(log, stopped, time.perf_counter() - started)


def _check_limits(
    steps: int,
    candidates: int,
    repeats: int,
    max_extra_repeats: int,
    seconds: float | None,
) -> None:
    """Raise InputError if an argument of `search` is out of range.

    Args:
        steps: renders of the search, at least 1.
        candidates: number of configurations that are rendered again, at least 0.
        repeats: renders of each candidate, at least 1.
        max_extra_repeats: largest number of further renders, at least 0.
        seconds: time limit, over 0; None for no limit.
    """
    if steps < 1:
        raise InputError(f"steps: expected at least 1, got {steps}")
    if candidates < 0 or repeats < 1:
        raise InputError(
            "candidates and repeats: expected at least 0 and 1, got "
            f"{candidates} and {repeats}"
        )
    if max_extra_repeats < 0:
        raise InputError(
            f"max_extra_repeats: expected at least 0, got {max_extra_repeats}"
        )
    if seconds is not None and not seconds > 0.0:
        raise InputError(f"seconds: expected a number over 0, got {seconds}")


def _make_result(log: _Log, stopped: Ending, seconds: float) -> SearchResult:
    """Return the result of a search from its log.

    A failure is claimed (FOUND) if the model was wrong in at least half of the best
    candidate's renders. An interrupted search claims nothing, whatever it found.

    Args:
        log: log of the search.
        stopped: why the search stopped.
        seconds: seconds that the search took.
    """
    best = Candidate(log.domain.start, math.nan, False)
    if log.pool:  # else nothing could be evaluated
        best = select_best(log.pool)
    best_objective = math.nan
    if math.isfinite(best.mean_objective):
        best_objective = best.mean_objective
    is_claimed = best.success_rate >= 0.5 and stopped is not Ending.INTERRUPTED
    result = SearchResult(
        best_u=best.u,
        best_objective=best_objective,
        claimed_objective=best.objective,
        success_rate=best.success_rate,
        ending=Ending.FOUND if is_claimed else stopped,
        stopped=stopped,
        history=tuple(record for record in log.records if record.phase == "search"),
        ranking=tuple(record for record in log.records if record.phase == "ranking"),
        renders=log.renders,
        gradients=log.gradients,
        non_finite_objectives=log.non_finite,
        non_finite_elements=sum(record.non_finite for record in log.records),
        seconds=seconds,
        agreement=tuple(log.agreement),
    )
    return _add_policy_findings(result, log)


def _add_policy_findings(result: SearchResult, log: _Log) -> SearchResult:
    """Return the result of a search with what its policy knows at the end.

    An interrupted batch is passed to the policy as far as it was evaluated.
    """
    policy = log.policy
    state = log.state
    if policy is None or state is None:  # the search ended before the first proposal
        return result
    if log.evaluated_batch:
        state = policy.update(state, log.evaluated_batch)
    return replace(
        result,
        counts=policy.counts(state),
        distribution=policy.distribution(state),
        failures=policy.failures(state),
    )


@dataclass(eq=False)
class _Log:
    """The state of a search, the only thing in it that changes.

    Attributes:
        evaluate: answers queries.
        domain: domain of the search.
        on_step: called after every evaluation.
        size: maximum number of candidates.
        kind: kind of the queries.
        render_seed: root seed of their noise.
        pool: the best candidates so far, the best first.
        last: the latest configuration with a finite objective.
        best: largest raw objective so far; NaN before there is one.
        records: records of all evaluations so far.
        gradients: number of gradients that were requested.
        non_finite: number of objectives that were not finite.
        renders: renders that all evaluations took.
        previous_gradient: (d,) the latest that is not zero.
        agreement: cosine similarities of each gradient with the one before.
        policy: policy that proposes, wrapped in `Choices` if need be.
        state: state of the policy, after its latest proposals.
        evaluated_batch: evaluations of these that the policy has not got yet.
    """

    evaluate: Evaluate
    domain: Domain
    on_step: OnStep | None
    size: int
    kind: str
    render_seed: int
    pool: tuple[Candidate, ...] = ()
    last: Candidate | None = None
    best: float = math.nan
    records: list[StepRecord] = field(default_factory=list)
    gradients: int = 0
    non_finite: int = 0
    renders: int = 0
    previous_gradient: Tensor | None = None
    agreement: list[float] = field(default_factory=list)
    policy: Policy[Any] | None = None
    state: Any = None
    evaluated_batch: list[tuple[Tensor, Evaluation]] = field(default_factory=list)

    def evaluate_and_record(
        self, proposals: Sequence[Proposal], indices: Sequence[int], phase: Phase
    ) -> Iterator[Evaluation]:
        """Evaluate proposals; yield each evaluation once it is counted and recorded.

        The time of an evaluation is measured from the one before. The caller's work
        between two of them is left out.

        Args:
            proposals: proposals to evaluate.
            indices: seed index of each proposal in the search's stream of seeds.
                Candidates that are ranked share seeds, so that they meet equal noise.
            phase: "search" or "ranking".
        """
        started = time.perf_counter()
        queries = self._make_queries(proposals, indices, phase)
        for proposal, query, raw in zip(
            proposals, queries, self.evaluate(queries), strict=True
        ):
            seconds = time.perf_counter() - started
            _check_evaluation(raw, proposal, self.domain)
            evaluation = raw.sanitize()
            self._count(proposal, evaluation, phase)
            self.records.append(self._make_record(proposal, query, evaluation, seconds))
            self._measure_agreement(evaluation.gradient)
            if self.on_step is not None:
                # copies, as the callback may write into the tensors
                self.on_step(self.records[-1], *copy_value((proposal.u, evaluation)))
            yield evaluation
            started = time.perf_counter()

    def _make_queries(
        self, proposals: Sequence[Proposal], seed_indices: Sequence[int], phase: Phase
    ) -> list[Query]:
        """Return the queries of proposals, numbered from the next record on.

        Args:
            proposals: proposals to evaluate.
            seed_indices: index of the seed of each proposal in the search's stream.
            phase: "search" or "ranking".
        """
        queries = list[Query]()
        for record_index, (proposal, seed_index) in enumerate(
            zip(proposals, seed_indices, strict=True), start=len(self.records)
        ):
            query = Query(
                proposal.u.clone(),
                seed=stream(self.render_seed, self.kind, seed_index),
                kind=self.kind,
                index=record_index,
                phase=phase,
                gradient=proposal.gradient,
                samples=proposal.samples,
            )
            queries.append(query)
        return queries

    def _count(self, proposal: Proposal, evaluation: Evaluation, phase: Phase) -> None:
        """Count the costs of an evaluation, and update the best and the candidates.

        Args:
            proposal: proposal of the policy.
            evaluation: its evaluation, sanitized.
            phase: "search" or "ranking". A ranking renders the candidates again, so it
                adds no candidate.
        """
        if proposal.gradient:
            self.gradients += 1
        self.renders += evaluation.cost
        if not evaluation.is_finite:
            self.non_finite += 1
        elif phase == "search":
            has_no_best = math.isnan(self.best)
            if has_no_best or evaluation.objective >= self.best:
                self.best = evaluation.objective
            candidate = Candidate(proposal.u, evaluation.objective, evaluation.success)
            self.pool = add_candidate(self.pool, candidate, self.size)
            self.last = candidate

    def _make_record(
        self, proposal: Proposal, query: Query, evaluation: Evaluation, seconds: float
    ) -> StepRecord:
        """Return the record of an evaluation, after `_count` has counted it.

        The objective is NaN if it was not finite; so is the norm of a gradient that was
        not requested.

        Args:
            proposal: proposal of the policy.
            query: query that was made of the proposal.
            evaluation: its evaluation, sanitized.
            seconds: seconds that the evaluation took.
        """
        objective = math.nan
        if evaluation.is_finite:
            objective = evaluation.objective
        gradient_norm = math.nan
        if evaluation.gradient is not None:
            gradient_norm = float(evaluation.gradient.norm())
        assert query.phase is not None
        return StepRecord(
            step=query.index,
            seed=query.seed,
            phase=query.phase,
            objective=objective,
            best=self.best,
            success=evaluation.success,
            step_size=proposal.step_size,
            gradient_norm=gradient_norm,
            non_finite=evaluation.non_finite,
            seconds=seconds,
            renders=self.renders,
            samples=proposal.samples,
        )

    def _measure_agreement(self, gradient: Tensor | None) -> None:
        """Append the cosine similarity of a gradient (d,) and the one before it.

        A gradient of zero has no direction and is left out.
        """
        if gradient is None or not bool(gradient.any()):
            return
        if self.previous_gradient is not None:
            # a small `eps`, as the default of 1e-8 distorts small gradients
            cosine = torch.cosine_similarity(
                gradient, self.previous_gradient, dim=0, eps=1e-30
            )
            self.agreement.append(float(cosine))
        self.previous_gradient = gradient


def _explore(
    log: _Log,
    policy: Policy[Any],
    steps: int,
    seed: int,
    is_out_of_time: IsOutOfTime,
) -> Ending:
    """Evaluate what the policy proposes until there is a reason to stop; return it.

    - BUDGET_SPENT: all renders are spent, or the time is over.
    - STALLED: the policy has nothing more to propose.
    - NON_FINITE: `NON_FINITE_LIMIT` objectives in a row were not finite.

    The log always has the policy's latest state and the evaluations that the policy has
    not received yet. An interrupted search makes its result from these.

    Args:
        log: log of the search; it is changed.
        policy: policy that proposes.
        steps: number of renders to spend.
        seed: root seed of the policy's randomness.
        is_out_of_time: returns whether the time is over, by the number of evaluations.
    """
    generator = torch.Generator().manual_seed(stream(seed, "search"))
    name = policy.name  # for messages: that of the policy that a user chose
    policy = wrap_choices(policy, log.domain)
    log.policy = policy
    state = policy.start(log.domain, generator, steps)
    n_non_finite = 0  # in a row
    max_batch = max_batch_size(log.domain.dim)
    while log.renders < steps:
        max_proposals = min(max_batch, steps - log.renders)
        proposals, state = policy.propose(state, max_proposals)
        if not proposals:
            return Ending.STALLED
        _check_proposals(proposals, max_proposals, log.domain, name)
        batch = _limit_batch(proposals, log.domain, steps - log.renders)
        log.state = state
        log.evaluated_batch = []
        first_index = len(log.records)
        indices = range(first_index, first_index + len(batch))
        evaluations = log.evaluate_and_record(batch, indices, "search")
        for proposal, evaluation in zip(batch, evaluations, strict=True):
            log.evaluated_batch.append((proposal.u, evaluation))
            n_non_finite = 0 if evaluation.is_finite else n_non_finite + 1
            if n_non_finite == NON_FINITE_LIMIT:
                return Ending.NON_FINITE
            if is_out_of_time(len(log.records)):
                return Ending.BUDGET_SPENT
        state = policy.update(state, log.evaluated_batch)
        log.state = state
        log.evaluated_batch = []
    return Ending.BUDGET_SPENT


def _limit_batch(
    proposals: Sequence[Proposal], domain: Domain, renders_left: int
) -> list[Proposal]:
    """Return copies of the first proposals, as many as the remaining renders pay.

    The last one may be changed to a cheaper one (`Proposal.limit_cost`), e.g. without
    its gradient.

    Args:
        proposals: proposals of the policy.
        domain: states how many renders a gradient costs.
        renders_left: number of renders that the budget has left.
    """
    batch = list[Proposal]()
    for proposal in proposals:
        if renders_left <= 0:
            break
        # A policy may write into its tensor later.
        proposal_copy = replace(proposal, u=proposal.u.clone())
        batch.append(proposal_copy.limit_cost(domain, renders_left))
        renders_left -= batch[-1].max_cost(domain)
    return batch


def _rank(log: _Log, first_seed: int, repeats: int, max_extra_repeats: int) -> None:
    """Render every candidate again, all with the same new seeds.

    Then candidates that are clearly worse than the best are dropped from the pool, and
    the others are rendered once more each. This is repeated `max_extra_repeats` times,
    or until a single candidate is left.

    Args:
        log: log of the search, whose pool changes.
        first_seed: index of the first seed that the search has not used.
        repeats: renders of every candidate at first.
        max_extra_repeats: largest number of further renders of a candidate.
    """
    first_extra_seed = first_seed + repeats
    _repeat_candidates(log, range(first_seed, first_extra_seed))
    for seed_index in range(first_extra_seed, first_extra_seed + max_extra_repeats):
        n_renders = seed_index - first_seed  # of each remaining candidate so far
        log.pool = select_contenders(log.pool, n_renders)
        if len(log.pool) < 2:
            break
        _repeat_candidates(log, range(seed_index, seed_index + 1))


def _repeat_candidates(log: _Log, indices: range) -> None:
    """Render all candidates of the log's pool with the seeds of these indices.

    The pool is updated after every render, so that an interrupted search loses none.

    Args:
        log: log of the search, whose pool changes.
        indices: seed indices, one render of each candidate for each.
    """
    pool = log.pool
    proposals = [Proposal(candidate.u) for candidate in pool for _ in indices]
    # an iterator over the renders of the first candidate, then those of the second, ...
    evaluations = log.evaluate_and_record(proposals, [*indices] * len(pool), "ranking")
    for position, candidate in enumerate(pool):
        repeated = candidate
        for evaluation in islice(evaluations, len(indices)):
            repeated = repeated.with_repeat(evaluation.objective, evaluation.success)
            log.pool = (*log.pool[:position], repeated, *pool[position + 1 :])


def _check_proposals(
    proposals: Sequence[Proposal], max_count: int, domain: Domain, name: str
) -> None:
    """Raise RuntimeError if a policy's proposals break its contract, which is a bug.

    They may be too many, or no configurations of the domain.

    Args:
        proposals: proposals of the policy.
        max_count: largest number of proposals allowed.
        domain: domain of the search.
        name: name of the policy, for the message.
    """
    if len(proposals) > max_count:
        raise RuntimeError(
            f"policy {name!r} proposed {len(proposals)} "
            f"configurations; expected at most {max_count}"
        )
    for proposal in proposals:
        _check_inside(proposal, domain, name)


def _check_inside(proposal: Proposal, domain: Domain, name: str) -> None:
    """Raise RuntimeError if a proposal is no configuration of the domain.

    This is a bug of the policy. Its u has to be float32, have the domain's shape (d,)
    and lie within the budget, but for rounding.

    Args:
        proposal: proposal of the policy.
        domain: domain of the search.
        name: name of the policy, for the message.
    """
    u = proposal.u
    if proposal.samples < 1:
        raise RuntimeError(
            f"policy {name!r} proposed {proposal.samples} samples; expected at least 1"
        )
    if u.shape != domain.start.shape or u.dtype != torch.float32:
        raise RuntimeError(
            f"policy {name!r} proposed {u.dtype} of shape {tuple(u.shape)}; expected "
            f"torch.float32 of shape {tuple(domain.start.shape)}"
        )
    excess = domain.violation(u)
    if not excess <= TOLERANCE:  # so that NaN is rejected as well
        raise RuntimeError(
            f"policy {name!r} left its budget by {excess:.3g}; it must "
            "project what it proposes"
        )


def _check_evaluation(
    evaluation: Evaluation, proposal: Proposal, domain: Domain
) -> None:
    """Raise RuntimeError if an evaluation does not fit its proposal, which is a bug.

    It must have the gradient that was requested, like u in shape and dtype, and have
    taken as many renders as the domain states.

    Args:
        evaluation: what `evaluate` returned.
        proposal: proposal that was evaluated.
        domain: states how many renders a gradient costs.
    """
    gradient = evaluation.gradient
    u = proposal.u
    min_cost = proposal.samples
    max_cost = proposal.max_cost(domain)
    if proposal.gradient and gradient is None:
        raise RuntimeError("evaluate returned no gradient although one was asked for")
    is_like_u = gradient is not None and (gradient.shape, gradient.dtype) == (
        u.shape,
        u.dtype,
    )
    if proposal.gradient and gradient is not None and not is_like_u:
        raise RuntimeError(
            f"evaluate returned a gradient of {gradient.dtype}, shape "
            f"{tuple(gradient.shape)}; expected {u.dtype}, shape {tuple(u.shape)}"
        )
    if not min_cost <= evaluation.cost <= max_cost:
        raise RuntimeError(
            f"evaluate took {evaluation.cost} renders; expected {min_cost} to "
            f"{max_cost}, by the proposal's samples and the domain's gradient_cost"
        )
