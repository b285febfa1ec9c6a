"""The search loop, which is the same for all policies. A policy only proposes
configurations; the loop spends the budget, decides when to stop, and keeps the best
configurations and the log.
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
    CorrectionCounts,
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
from advsearch.interrupts import reraise_lost_interrupt
from advsearch.seeds import derive_seed

# A search ends after this many objectives in a row that are not finite.
NON_FINITE_LIMIT = 3


@dataclass(frozen=True)
class StepRecord:
    """The record of an evaluation, without its tensors.

    Attributes:
        step: index of the evaluation, from 0; the ranking continues counting.
        seed: seed that it was rendered with.
        phase: "search", or "ranking" for a candidate that is rendered again at the end.
        objective: objective of this single render; NaN if it was not finite.
        best: largest objective of the search so far, biased upwards; NaN before there
            is one.
        success: whether the model was wrong in this render.
        step_size: step size of the policy, in units of each block's radius; NaN if it
            has none.
        gradient_norm: l2 norm of the gradient, after elements that are not finite were
            set to zero; NaN without a gradient.
        non_finite: number of gradient elements that were set to zero.
        seconds: time that the evaluation took.
        renders: number of renders of all evaluations so far, including this one.
        samples: multiple of the search's samples per pixel; see `Proposal`.
    """

    step: int
    seed: int
    phase: Phase
    objective: float
    best: float
    success: bool
    step_size: float
    gradient_norm: float
    non_finite: int
    seconds: float
    renders: int = 0
    samples: int = 1


IsOutOfTime = Callable[[int], bool]
"""(number of evaluations so far) -> whether the time is over."""

OnStep = Callable[[StepRecord, Tensor, Evaluation], None]
"""Called after every evaluation, also of the ranking, with its record, u, and the
sanitized evaluation.
"""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The result of a search. It is a claim, which `verify` has to confirm
    (docs/design.md, "Verification").

    Attributes:
        best_u: (d,) float32 the best configuration; the start if nothing could be
            evaluated.
        best_objective: mean objective of `best_u` in the renders of the ranking; that
            of its first render if it was not ranked. NaN if nothing could be evaluated,
            or one of these renders was not finite.
        claimed_objective: objective of the first render of `best_u`. It is biased
            upwards, as the configuration was selected for this value.
        success_rate: fraction of the renders of `best_u` in the ranking in which the
            model was wrong; without a ranking, that of its first render, 0 or 1.
        ending: INTERRUPTED if the search was; else FOUND if the success rate is at
            least a half; else the same as `stopped`.
        stopped: why the loop stopped, whatever it had found.
        history: records of the evaluations of the search itself.
        ranking: records of the renders of the ranking.
        renders: number of images that were rendered, including those for finite
            differences and those of the ranking.
        gradients: number of evaluations with a gradient.
        non_finite_objectives: number of evaluations whose objective was NaN or
            infinite.
        non_finite_elements: number of gradient elements that were set to zero, over all
            evaluations.
        seconds: total time, including evaluations.
        agreement: cosine similarity of each gradient with the one before, in order. It
            is 1 if neither noise nor the step between them changed the direction.
            Gradients of zero are left out.
        counts: how often the policy corrected gradients and steps.
        distribution: distribution that the policy reached; None if it has none.
        failures: different failures that the policy met; None if it does not search for
            them.
    """

    best_u: Tensor
    best_objective: float
    claimed_objective: float
    success_rate: float
    ending: Ending
    stopped: Ending
    history: tuple[StepRecord, ...]
    ranking: tuple[StepRecord, ...]
    renders: int
    gradients: int
    non_finite_objectives: int
    non_finite_elements: int
    seconds: float
    agreement: tuple[float, ...] = ()
    counts: CorrectionCounts = field(default_factory=CorrectionCounts)
    distribution: Distribution | None = None
    failures: Failures | None = None


def count_planned_renders(
    steps: int, candidates: int = 4, repeats: int = 2, max_extra_repeats: int = 0
) -> int:
    """Return the largest number of images that `search` renders with the arguments."""
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
       updated. An evaluation costs at most `Proposal.max_cost` renders. A gradient or
       samples that exceed the budget are not requested.
    2. The `candidates` best distinct configurations are ranked: they are rendered
       `repeats` times again, without gradient, all with the same new seeds. The best by
       these renders is returned, because the best of step 1 is partly a lucky one. With
       `candidates=0`, for an objective without noise, the best of step 1 is returned.
       If every evaluation draws conditions (`Domain.draws_conditions`), the best of
       step 1 had conditions under which it is easy to fail. So the last configuration
       of the policy, which depends on many evaluations, replaces the worst candidate.
       Candidates that are not clearly worse than the best one are then rendered again,
       up to `max_extra_repeats` times (`candidates.select_contenders`).

    If the domain has discrete choices and the policy does not handle them, it is
    wrapped in `Choices`.

    A non-finite objective is counted, is never best, and is passed to the policy as
    -inf. The search ends after `NON_FINITE_LIMIT` of them in a row. KeyboardInterrupt
    ends it at any time; the result then contains the evaluations so far.

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
            each evaluation, so there is always at least one. Step 2 is not limited.
            Policies still plan for `steps`.
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
    # without a ranking the best candidate is stored as well: it is the result
    size = max(1, candidates)
    log = _Log(evaluate, domain, on_step, size, kind, render_seed)
    if is_out_of_time is None:
        is_out_of_time = _make_deadline_check(started, seconds)
    try:
        with reraise_lost_interrupt():
            stopped = _explore(log, policy, steps, seed, is_out_of_time)
            if domain.draws_conditions:
                # the last configuration of the policy becomes a candidate
                log.pool = replace_worst(log.pool, log.last, log.size)
            if candidates:
                # Step 1 made at most `steps` evaluations, with seed indices from 0 on.
                _rank(log, steps, repeats, max_extra_repeats)
    except KeyboardInterrupt:
        stopped = Ending.INTERRUPTED
    return _make_result(log, stopped, time.perf_counter() - started)


def _make_deadline_check(started: float, seconds: float | None) -> IsOutOfTime:
    """Return a function that says whether a search has taken more than some seconds.

    Args:
        started: when it began, as `time.perf_counter` counts.
        seconds: its time limit; None for no limit.
    """
    deadline = math.inf if seconds is None else started + seconds
    return lambda n_evaluations: time.perf_counter() >= deadline


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

    The best candidate is selected by its renders in the ranking. A failure is claimed
    (FOUND) if the model was wrong in at least half of these. An interrupted search
    claims nothing, whatever it found.

    Args:
        log: log of the search.
        stopped: why the search stopped.
        seconds: seconds that the search took.
    """
    best = _choose_best(log)
    # mean of the renders in the ranking, of which one may be -inf
    is_finite = math.isfinite(best.mean_objective)
    is_claimed = best.success_rate >= 0.5 and stopped is not Ending.INTERRUPTED
    result = SearchResult(
        best_u=best.u,
        best_objective=best.mean_objective if is_finite else math.nan,
        claimed_objective=best.objective,  # of its first render
        success_rate=best.success_rate,
        ending=Ending.FOUND if is_claimed else stopped,
        stopped=stopped,
        history=log.list_records("search"),
        ranking=log.list_records("ranking"),
        renders=log.renders,
        gradients=log.gradients,
        non_finite_objectives=log.non_finite,
        non_finite_elements=sum(record.non_finite for record in log.records),
        seconds=seconds,
        agreement=tuple(log.agreement),
    )
    return _add_policy_findings(result, log)


def _choose_best(log: _Log) -> Candidate:
    """Return the best candidate; the start, without a success, if there is none."""
    if log.pool:
        return select_best(log.pool)
    # Nothing could be evaluated. Without a success, nothing is claimed.
    return Candidate(log.domain.start, objective=math.nan, success=False)


def _add_policy_findings(result: SearchResult, log: _Log) -> SearchResult:
    """Add the counts, the distribution and the failures of the policy to a result.

    If the last batch was interrupted, the policy is updated with its evaluations first.
    """
    policy = log.policy
    state = log.state
    if policy is None or state is None:  # the search ended before the first proposal
        return result
    # A batch that was completed has been passed to the policy, and is removed here.
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
    """The mutable state of a search.

    Attributes:
        evaluate: evaluates queries.
        domain: domain of the search.
        on_step: called after every evaluation.
        size: maximum number of candidates.
        kind: kind of the queries.
        render_seed: root seed of their noise.
        pool: the best candidates so far, the best first.
        last: the latest configuration with a finite objective; it need not be in
            `pool`.
        best_objective: largest objective so far; NaN before there is one.
        records: records of all evaluations so far.
        gradients: number of gradients that were requested.
        non_finite: number of objectives that were not finite.
        renders: number of renders of all evaluations.
        previous_gradient: (d,) the latest gradient that is not zero.
        agreement: cosine similarities of each gradient with the one before.
        policy: policy that proposes, wrapped in `Choices` if necessary.
        state: state of the policy, after its latest proposals.
        evaluated_batch: evaluations of these proposals that were not passed to the
            policy yet.
        latest_non_finite: number of the latest objectives of the search, in a row, that
            were not finite.
    """

    evaluate: Evaluate
    domain: Domain
    on_step: OnStep | None
    size: int
    kind: str
    render_seed: int
    pool: tuple[Candidate, ...] = ()
    last: Candidate | None = None
    best_objective: float = math.nan
    records: list[StepRecord] = field(default_factory=list)
    gradients: int = 0
    non_finite: int = 0
    renders: int = 0
    previous_gradient: Tensor | None = None
    agreement: list[float] = field(default_factory=list)
    policy: Policy[Any] | None = None
    state: Any = None
    evaluated_batch: list[tuple[Tensor, Evaluation]] = field(default_factory=list)
    latest_non_finite: int = 0

    def list_records(self, phase: Phase) -> tuple[StepRecord, ...]:
        """Return the records of one phase."""
        return tuple(record for record in self.records if record.phase == phase)

    def begin_batch(self, state: Any) -> None:
        """Store a state of the policy that has received all evaluations so far."""
        self.state = state
        self.evaluated_batch = []

    def evaluate_and_record(
        self, proposals: Sequence[Proposal], indices: Sequence[int], phase: Phase
    ) -> Iterator[Evaluation]:
        """Evaluate proposals; yield each evaluation once it is counted and recorded.

        `self.evaluate` is lazy: an evaluation is computed when the loop below requests
        the next one. Its time is measured from there. The work of the caller, between a
        `yield` and its next request, is not included.

        Args:
            proposals: proposals to evaluate.
            indices: seed index of each proposal in the search's stream of seeds.
                Candidates that are ranked share seeds, so that they meet equal noise.
            phase: "search" or "ranking".
        """
        started = time.perf_counter()
        queries = self._make_queries(proposals, indices, phase)
        raw_evaluations = self.evaluate(queries)
        for proposal, query, raw in zip(
            proposals, queries, raw_evaluations, strict=True
        ):
            seconds = time.perf_counter() - started
            _check_evaluation(raw, proposal, self.domain)
            evaluation = raw.sanitize()
            self._record_evaluation(proposal, query, evaluation, seconds)
            self._report_latest_record(proposal.u, evaluation)
            yield evaluation
            started = time.perf_counter()

    def _record_evaluation(
        self, proposal: Proposal, query: Query, evaluation: Evaluation, seconds: float
    ) -> None:
        """Count an evaluation, append its record, and compare its gradient.

        Args:
            proposal: proposal of the policy.
            query: query that was made of the proposal.
            evaluation: its evaluation, sanitized.
            seconds: seconds that the evaluation took.
        """
        assert query.phase is not None
        self._count(proposal, evaluation, query.phase)
        self.records.append(self._make_record(proposal, query, evaluation, seconds))
        self._measure_agreement(evaluation.gradient)

    def _report_latest_record(self, u: Tensor, evaluation: Evaluation) -> None:
        """Call `on_step`, if there is one, with the latest record and its evaluation."""
        if self.on_step is not None:
            # copies, as the callback may write into the tensors
            self.on_step(self.records[-1], *copy_value((u, evaluation)))

    def _make_queries(
        self, proposals: Sequence[Proposal], seed_indices: Sequence[int], phase: Phase
    ) -> list[Query]:
        """Return the queries of proposals, numbered from the next record on.

        Args:
            proposals: proposals to evaluate.
            seed_indices: index of the seed of each proposal in the search's stream.
            phase: "search" or "ranking".
        """
        first_record = len(self.records)
        pairs = zip(proposals, seed_indices, strict=True)
        return [
            self._make_proposal_query(proposal, seed_index, record_index, phase)
            for record_index, (proposal, seed_index) in enumerate(pairs, first_record)
        ]

    def _make_proposal_query(
        self, proposal: Proposal, seed_index: int, record_index: int, phase: Phase
    ) -> Query:
        """Return the query of a proposal.

        Args:
            proposal: proposal to evaluate.
            seed_index: index of its seed in the search's stream.
            record_index: index of the record that its evaluation will have.
            phase: "search" or "ranking".
        """
        return Query(
            proposal.u.clone(),
            seed=derive_seed(self.render_seed, self.kind, seed_index),
            kind=self.kind,
            row_index=record_index,
            phase=phase,
            gradient=proposal.gradient,
            samples=proposal.samples,
        )

    def _count(self, proposal: Proposal, evaluation: Evaluation, phase: Phase) -> None:
        """Count the costs of an evaluation, and update the best and the candidates.

        Args:
            proposal: proposal of the policy.
            evaluation: its evaluation, sanitized.
            phase: "search" or "ranking". A ranking renders the candidates again, so it
                adds no candidate.
        """
        if proposal.gradient:  # all of it, or a "free" one
            self.gradients += 1
        self.renders += evaluation.cost
        if not evaluation.is_finite:
            self.non_finite += 1
        elif phase == "search":
            has_no_best = math.isnan(self.best_objective)
            if has_no_best or evaluation.objective >= self.best_objective:
                self.best_objective = evaluation.objective
            candidate = Candidate(proposal.u, evaluation.objective, evaluation.success)
            self.pool = add_candidate(self.pool, candidate, self.size)
            # stored even if it is not good enough for the pool
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
        gradient_norm = math.nan
        if evaluation.gradient is not None:
            gradient_norm = float(evaluation.gradient.norm())
        assert query.phase is not None
        return StepRecord(
            step=query.row_index,
            seed=query.seed,
            phase=query.phase,
            objective=evaluation.objective if evaluation.is_finite else math.nan,
            best=self.best_objective,
            success=evaluation.success,
            step_size=proposal.step_size,
            gradient_norm=gradient_norm,
            non_finite=evaluation.n_non_finite,
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
    generator = torch.Generator().manual_seed(derive_seed(seed, "search"))
    name = policy.name  # for messages: that of the policy that a user chose
    policy = wrap_choices(policy, log.domain)
    log.policy = policy
    state = policy.start(log.domain, generator, steps)
    while log.renders < steps:
        renders_left = steps - log.renders
        batch, state = _propose_batch(policy, state, log.domain, renders_left, name)
        if not batch:
            return Ending.STALLED
        # the state that an interrupted search makes its result from
        log.begin_batch(state)
        ending = _evaluate_proposals(log, batch, is_out_of_time)
        if ending is not None:
            return ending
        state = policy.update(state, log.evaluated_batch)
        log.begin_batch(state)
    return Ending.BUDGET_SPENT


def _propose_batch(
    policy: Policy[Any], state: Any, domain: Domain, renders_left: int, name: str
) -> tuple[list[Proposal], Any]:
    """Return the next proposals that the renders can pay, and the policy's new state.

    There are none if the policy has nothing more to propose.

    Args:
        policy: policy that proposes.
        state: state of the policy.
        domain: domain of the search.
        renders_left: number of renders that the budget has left, at least 1.
        name: name of the policy, for messages.

    Raises:
        RuntimeError: a proposal breaks the contract of a policy, which is a bug.
    """
    max_proposals = min(max_batch_size(domain.dim), renders_left)
    proposals, state = policy.propose(state, max_proposals)
    if not proposals:
        return [], state
    _check_proposals(proposals, max_proposals, domain, name)
    return _limit_batch(proposals, domain, renders_left), state


def _evaluate_proposals(
    log: _Log, batch: Sequence[Proposal], is_out_of_time: IsOutOfTime
) -> Ending | None:
    """Evaluate a batch of proposals; return why the search ends, or None.

    The evaluations are added to the log one by one.
    """
    # An evaluation may take several renders, so seeds follow from their own count.
    first_index = len(log.records)
    seed_indices = range(first_index, first_index + len(batch))
    evaluations = log.evaluate_and_record(batch, seed_indices, "search")
    for proposal, evaluation in zip(batch, evaluations, strict=True):
        log.evaluated_batch.append((proposal.u, evaluation))
        is_finite = evaluation.is_finite
        log.latest_non_finite = 0 if is_finite else log.latest_non_finite + 1
        if log.latest_non_finite == NON_FINITE_LIMIT:
            return Ending.NON_FINITE
        if is_out_of_time(len(log.records)):
            return Ending.BUDGET_SPENT
    return None


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
        # It may have become cheaper, so the limited proposal is charged.
        limited_proposal = proposal_copy.limit_cost(domain, renders_left)
        batch.append(limited_proposal)
        renders_left -= limited_proposal.max_cost(domain)
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
    candidates = log.pool
    # All renders of the first candidate come first, then those of the second, and so
    # on. Each candidate has the same seeds.
    proposals = [Proposal(candidate.u) for candidate in candidates for _ in indices]
    seed_indices = [*indices] * len(candidates)
    evaluations = log.evaluate_and_record(proposals, seed_indices, "ranking")
    for position, candidate in enumerate(candidates):
        repeated = candidate
        # `evaluations` is one iterator, so this takes the next ones
        for evaluation in islice(evaluations, len(indices)):
            repeated = repeated.with_repeat(evaluation.objective, evaluation.success)
            updated = log.pool[:position]
            not_updated = candidates[position + 1 :]
            log.pool = (*updated, repeated, *not_updated)


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

    It must have the gradient that was requested, with the shape and dtype of u. Its
    cost must be at least the proposal's samples, and at most those with a full
    gradient; a part of a gradient may have cost less.

    Args:
        evaluation: what `evaluate` returned.
        proposal: proposal that was evaluated.
        domain: states how many renders a gradient costs.
    """
    _check_returned_gradient(evaluation.gradient, proposal)
    min_cost = proposal.samples
    max_cost = proposal.max_cost(domain)
    if not min_cost <= evaluation.cost <= max_cost:
        raise RuntimeError(
            f"evaluate took {evaluation.cost} renders; expected {min_cost} to "
            f"{max_cost}, by the proposal's samples and the domain's gradient_cost"
        )


def _check_returned_gradient(gradient: Tensor | None, proposal: Proposal) -> None:
    """Raise RuntimeError if a gradient was requested and is missing or not like u."""
    u = proposal.u
    if proposal.gradient and gradient is None:
        raise RuntimeError("evaluate returned no gradient although one was asked for")
    if proposal.gradient and gradient is not None:
        is_like_u = gradient.shape == u.shape and gradient.dtype == u.dtype
        if not is_like_u:
            raise RuntimeError(
                f"evaluate returned a gradient of {gradient.dtype}, shape "
                f"{tuple(gradient.shape)}; expected {u.dtype}, shape {tuple(u.shape)}"
            )
