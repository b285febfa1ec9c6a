"""The types that a scene, a search and a trial share.

A `Query` is a configuration to evaluate, an `Evaluation` its result. A `Policy` decides
what is evaluated next. It has three methods, `start`, `propose` and `update`, that take
and return a state and store nothing, so that a search can be wrapped, replayed and
resumed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeVar

import torch
from torch import Tensor

from advsearch.attacks.domain import Distribution, Domain
from advsearch.copies import copy_method_arguments
from advsearch.errors import InputError
from advsearch.options import Value
from advsearch.seeds import derive_seed
from advsearch.tasks import Judgement

if TYPE_CHECKING:
    from advsearch.attacks.candidates import Failures

WhichGradient = bool | Literal["free"]
"""Which derivative is requested: none (False), all of it (True), or "free": only the
elements that cost no extra render, with zeros elsewhere.
"""

Phase = Literal["search", "ranking"]

MAX_QUERIES = 1024
MAX_COORDINATES = 2**21
"""Largest number of queries in a batch, and largest number of elements that all their
configurations have together.
"""


def max_batch_size(dim: int) -> int:
    """Return the maximum number of queries in a batch, for configurations (dim,)."""
    # at least 2, however large a configuration is
    return max(2, min(MAX_QUERIES, MAX_COORDINATES // dim))


@dataclass(frozen=True, eq=False)
class Query:
    """A configuration to render and evaluate, under the noise of a seed.

    There are queries of a search and trials. A search evaluates the image as it is
    rendered, with the samples and light paths of the search, and under conditions that
    it draws. A trial evaluates the image as a file would store it, rounded to 8 bits.

    Attributes:
        u: (d,) float32 in [0, 1], the configuration; must not be written to.
        seed: seed of the noise, and of the conditions that are drawn. Equal seeds mean
            equal noise.
        kind: kind of the rows that the evaluation is stored in, such as "search" or
            "verification".
        row_index: index of the row among those of its kind.
        phase: phase of a search; None for a trial.
        gradient: which gradient is requested; "free" only if the domain has
            `partial_gradients`.
        samples: multiple of the search's samples per pixel to render with, at least 1.
            The evaluation costs samples * (1 + gradient_cost) renders with a gradient,
            and samples without.
        spp: for a trial, the samples per pixel.
        draws_conditions: for a trial, whether conditions are drawn. Otherwise the scene
            stays as it is.
        values: for a trial, values that its row states of the configuration. Trials of
            one kind may share them.
        has_success: for a trial, whether a search seeks a certain prediction, so that
            the evaluation can be a success.
        requested_output: what is computed: a judgement; only an image ("picture"); or
            "light", from which images can be predicted (`advsearch.scene.transport`),
            for a u of the full space.
        includes_image: whether the evaluation contains the image, too. For a row of a
            sweep it is the bytes of a small JPEG file.
    """

    u: Tensor
    seed: int
    kind: str = "search"
    row_index: int = 0
    phase: Phase | None = None
    gradient: WhichGradient = False
    samples: int = 1
    spp: int = 1
    draws_conditions: bool = True
    values: Mapping[str, Value] = field(default_factory=dict)
    has_success: bool = True
    requested_output: Literal["judgement", "picture", "light"] = "judgement"
    includes_image: bool = False


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The result of a query.

    Attributes:
        objective: value to maximize; it has noise, as a render has.
        gradient: (d,) float32, gradient of the objective by u; None if it was not
            requested.
        success: whether the model predicts what is sought. The task decides this, not
            the objective.
        n_non_finite: number of gradient elements that were NaN or infinite and were set
            to zero.
        cost: number of images that were rendered for it: one, and those that finite
            differences took, each times `samples`. An adjoint is not an image and
            counts 0; `SearchResult.gradients` counts it. At least 1, but 0 for a row of
            a sweep whose image was predicted, or rendered for another model.
        judgement: the full result of the task, for the log; None without a task. No
            policy reads it.
        picture: (H, W, 3) image of 8-bit values in [0, 1]; None if not requested.
        collected_light: result of a query for "light"; in the last row of a batch of a
            sweep, the predictions so far.
        predicted: 0 if the image was rendered; otherwise the samples per pixel of the
            renders that it was predicted from, 1 for a matrix.
        jpeg: JPEG file of the image of a row of a sweep; None if it is not stored.
        layers: layers of ground truth by name, and notes; None if not stored.
        seconds: time that it took; None if the caller has to measure it.
        machine: name of the worker's machine that computed it; None for a machine like
            this one.
        is_lost: whether every worker that tried it died.
    """

    objective: float
    gradient: Tensor | None
    success: bool
    n_non_finite: int = 0
    cost: int = 1
    judgement: Judgement | None = None
    picture: Tensor | None = None
    collected_light: Any = None
    predicted: int = 0
    jpeg: bytes | None = None
    layers: tuple[Mapping[str, Any], Mapping[str, str]] | None = None
    seconds: float | None = None
    machine: str | None = None
    is_lost: bool = False

    @classmethod
    def from_judgement(cls, judgement: Judgement, **more: Any) -> Evaluation:
        """Return an evaluation without a gradient, from the judgement of the task."""
        value = math.nan if judgement.objective is None else judgement.objective
        return cls(value, None, judgement.success, judgement=judgement, **more)

    @property
    def required_judgement(self) -> Judgement:
        """The judgement of the task.

        Raises:
            RuntimeError: there is none, as the query was for an image or for light.
        """
        if self.judgement is None:
            raise RuntimeError("this evaluation has no judgement")
        return self.judgement

    @property
    def is_finite(self) -> bool:
        """Whether the objective is a number that can be compared."""
        return math.isfinite(self.objective)

    def sanitize(self) -> Evaluation:
        """Return the evaluation as it is passed to policies, without NaN.

        - Gradient elements that are NaN or infinite become zero. They are counted in
          `n_non_finite`, also if the objective is not finite.
        - If the objective is NaN or infinite, it becomes -inf, the worst value. All of
          its gradient becomes zero and its success false.
        """
        evaluation = self._sanitize_gradient()
        has_finite_objective = evaluation.is_finite
        if has_finite_objective:
            return evaluation
        zero_gradient = None
        if evaluation.gradient is not None:
            zero_gradient = torch.zeros_like(evaluation.gradient)
        return replace(
            evaluation, objective=-math.inf, gradient=zero_gradient, success=False
        )

    def _sanitize_gradient(self) -> Evaluation:
        """Return the evaluation with zeros in place of NaN or infinite gradients.

        The number of elements that were replaced is added to `n_non_finite`.
        """
        gradient = self.gradient
        if gradient is None:
            return self
        # The sum is not finite if an element isn't; it is faster than a test of each.
        if math.isfinite(float(gradient.sum(dtype=torch.float64))):
            return self
        n_non_finite = int((~torch.isfinite(gradient)).sum())
        return replace(
            self,
            gradient=torch.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0),
            n_non_finite=self.n_non_finite + n_non_finite,
        )


Evaluate = Callable[[Sequence[Query]], Iterable[Evaluation]]
"""Evaluates queries in their order, lazily: each one when its result is requested, so
that a caller may stop and leave the rest. The owner of the scene supplies it. From a
function f of one query, `functools.partial(map, f)` makes one.
"""


State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class Proposal:
    """A configuration to evaluate next.

    Attributes:
        u: (d,) float32 inside the domain; the caller must not write to it.
        gradient: which gradient the policy requests: none, all of it
            (`Domain.gradient_cost` more renders), or "free" (only if the domain has
            `partial_gradients`). At the end of a budget the request may be dropped.
        step_size: length of the step to u, in units of each block's radius, for the
            log; NaN if no step led here.
        samples: multiple of the search's samples per pixel to render with, at least 1.
            Each counts as a render. At the end of a budget it is reduced to the renders
            that are left.
    """

    u: Tensor
    gradient: WhichGradient = False
    step_size: float = math.nan
    samples: int = 1

    def max_cost(self, domain: Domain) -> int:
        """Return the renders that this takes at most; a "free" gradient takes none."""
        gradient_cost = domain.gradient_cost if self.gradient is True else 0
        return self.samples * (1 + gradient_cost)

    def limit_cost(self, domain: Domain, renders_left: int) -> Proposal:
        """Return the proposal, reduced so that the remaining renders suffice for it.

        Its `samples` (each costs a render) become `renders_left` at most. A gradient
        is only useful for a later render, which it leads to. So it is dropped if it
        would use up the renders.

        Args:
            domain: states how many renders a gradient costs.
            renders_left: number of renders that the budget has left, at least 1.
        """
        proposal = self
        if self.samples > renders_left:
            proposal = replace(self, samples=renders_left)
        uses_up_renders = proposal.max_cost(domain) >= renders_left
        if proposal.gradient and uses_up_renders:
            return replace(proposal, gradient=False)
        return proposal


@dataclass(frozen=True)
class CorrectionCounts:
    """How often a policy corrected gradients and steps, for the summary of a run.

    Attributes:
        cut: gradients of which single elements were outliers and were clipped
            (`pgd.clip_gradient`).
        shortened: gradients that were too long and were scaled down.
        rejected: steps that were taken back.
    """

    cut: int = 0
    shortened: int = 0
    rejected: int = 0

    def __add__(self, other: CorrectionCounts) -> CorrectionCounts:
        return CorrectionCounts(
            self.cut + other.cut,
            self.shortened + other.shortened,
            self.rejected + other.rejected,
        )


NO_COUNTS = CorrectionCounts()


Evaluated = Sequence[tuple[Tensor, Evaluation]]
"""Configurations (d,) with their evaluations, in the order in which they were proposed.
"""


class Policy(ABC, Generic[State]):
    """Proposes configurations, in batches.

    A new policy is a dataclass that implements `start`, `propose` and `update`. Its
    options are its fields. It raises an InputError for a value outside of its range
    when it is created, and for a domain that it cannot search (for example one of too
    many numbers) when it starts.

    Attributes:
        name: name for messages and the log.
        handles_choices: whether it searches discrete choices (`Block.n_options`)
            itself. Any other policy is wrapped in `Choices` by `search`, and only gets
            numbers.
    """

    name: ClassVar[str]
    handles_choices: ClassVar[bool] = False

    def __init_subclass__(cls, **more: Any) -> None:
        """Prepare a subclass: reject a renamed method, and pass copies to its methods.

        A user's policy may write into its arguments, which the search still needs.

        Raises:
            InputError: the class defines `answer`, the old name of `distribution`.
        """
        super().__init_subclass__(**more)
        if "answer" in vars(cls):
            raise InputError(
                f"policy {cls.__name__}: `answer` is called "
                "`distribution` now; rename it"
            )
        # The methods get copies of the arguments in these slices, which begin to count
        # after `self`: of `start(domain, generator, steps)` only the domain, as the
        # generator has to advance; of `update(state, evaluated)` all after the state.
        copy_method_arguments(cls, start=slice(0, 1), update=slice(1, None))

    @property
    @abstractmethod
    def uses_gradient(self) -> bool:
        """Whether it ever requests a gradient. A subclass may set a class attribute."""

    @abstractmethod
    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> State:
        """Return the state before the first proposal.

        Args:
            domain: where to search; begin at `domain.initial_point`.
            generator: the search's source of randomness, to draw a seed from; use
                `seeded` for numbers later on.
            steps: largest number of renders, including those of gradients. Schedules
                may be planned with it, but the search may end earlier.
        """

    @abstractmethod
    def propose(self, state: State, n: int) -> tuple[tuple[Proposal, ...], State]:
        """Return the next configurations, and the state until `update`.

        Args:
            state: state after the latest `update`, or as `start` returned it.
            n: largest number of proposals, at least 1.

        Returns:
            At most n proposals that do not depend on each other's evaluations: many
            samples of a population, but a single step along a gradient. An empty tuple
            means that there is nothing more to propose, because a grid is complete or
            the objective is flat. The sequence of proposals in a search must not depend
            on n: two calls with n = 1 have to propose what one call with n = 2 does,
            provided that each batch is evaluated fully and passed to `update`.
        """

    @abstractmethod
    def update(self, state: State, evaluated: Evaluated) -> State:
        """Return the state after the latest proposals were evaluated.

        Args:
            state: state that `propose` returned.
            evaluated: the proposed configurations, in their order, with evaluations. At
                the end of the budget there may be only the first of them. Evaluations
                are sanitized (`Evaluation.sanitize`). The gradient is finite; it is
                None if it was not requested, or if its renders were not left. The
                objective is finite, or -inf if it could not be evaluated. It is noisy:
                the same u with another seed gives another value, and the largest of
                many values is biased upwards.
        """

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        """Return whether it may request gradients that cost renders, as finite
        differences do, in a search of `steps` renders.
        """
        return self.uses_gradient and domain.gradient_cost > 0

    def counts(self, state: State) -> CorrectionCounts:
        """Return how often the policy corrected gradients and steps so far."""
        return NO_COUNTS

    def distribution(self, state: State) -> Distribution | None:
        """Return the distribution that the search has reached.

        It is a result besides the best configuration. None if the policy has no
        distribution, or none yet.
        """
        return None

    def failures(self, state: State) -> Failures | None:
        """Return the different failures that the policy has met, or None if it does not
        search for different ones.
        """
        return None


def draw_seed(generator: torch.Generator) -> int:
    """Draw a seed for `seeded` from the search's generator."""
    return int(torch.randint(2**31, (1,), generator=generator))


def seeded(seed: int, number: int) -> torch.Generator:
    """Return the generator for draw `number` of a policy.

    It depends on the seed and the number only.
    """
    return torch.Generator().manual_seed(derive_seed(seed, "policy", number))


@contextmanager
def limit_to_single_thread() -> Iterator[None]:
    """Limit torch to a single thread inside the context.

    Small matrices are processed faster this way, on a busy machine many times faster,
    and the last bits of results do not depend on the number of threads. Setting it
    takes less than a microsecond.
    """
    n_threads_before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads_before)
