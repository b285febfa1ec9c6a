"""What passes between a scene, a search and a trial: a query, its evaluation, and the
contract of a policy: three functions over a state that is passed and never stored, so
that it can be shared, wrapped, replayed and resumed.
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
from advsearch.copies import hand_copies
from advsearch.errors import InputError
from advsearch.options import Value
from advsearch.seeds import stream
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
"""Largest number of queries in a batch, and of the elements of all their
configurations together.
"""


def max_batch_size(dim: int) -> int:
    """Return the maximum number of queries in a batch, for configurations (dim,)."""
    # at least 2, however large a configuration is
    return max(2, min(MAX_QUERIES, MAX_COORDINATES // dim))


@dataclass(frozen=True, eq=False)
class Query:
    """A configuration to render and evaluate, under the noise of a seed.

    A query of a search is about the picture as it is rendered, at the search's own
    samples and light paths, and over the conditions that it draws. A trial is about the
    picture as a file would hold it, rounded to 8 bits.
    """

    u: Tensor  # (d,) float32 in [0, 1], the configuration; must not be written to
    # Seed of the noise, and of the conditions that are drawn; equal seeds mean equal
    # noise.
    seed: int
    # which rows the evaluation belongs to, such as "search" or "verification"
    kind: str = "search"
    index: int = 0  # its place among these
    phase: Phase | None = None  # phase of a search; None for a trial
    # "free" only ever comes where the domain has `partial_gradients`
    gradient: WhichGradient = False
    samples: int = 1
    """Multiple of the search's samples per pixel to render with, at least 1. The
    evaluation costs samples * (1 + gradient_cost) renders with a gradient, and samples
    without.
    """
    spp: int = 1  # samples per pixel of a trial
    # of a trial: whether conditions are drawn; else the scene has those that it comes
    # with
    draws_conditions: bool = True
    values: Mapping[str, Value] = field(default_factory=dict)
    """Of a trial: what its row says of the configuration, which trials of one kind may
    have in common.
    """
    # of a trial: whether a search seeks some prediction there, so that there is a
    # success
    has_success: bool = True
    product: Literal["judgement", "picture", "light"] = "judgement"
    """What the evaluation is: a judgement; a picture alone; or "light", from which
    pictures can be predicted (`advsearch.scene.transport`), at u of the whole space.
    """
    # whether it has the picture, too; of a row of a sweep, the bytes of a small one
    with_image: bool = False


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The answer to a query."""

    objective: float  # what is maximised; a noisy number, because a render is
    # (d,) float32, of the objective by u; None where it was not asked for
    gradient: Tensor | None
    # the model's prediction is what is sought, by the task; never derived from the
    # objective
    success: bool
    # gradient elements that were NaN or infinite and were set to zero where they arose
    non_finite: int = 0
    cost: int = 1
    """Pictures that were rendered for it, at least 1: one, and those that differences
    took, each times `samples`. An adjoint is not a picture and counts 0;
    `SearchResult.gradients` counts it. 0 of a row of a sweep whose picture was
    predicted, or rendered for another model.
    """
    judgement: Judgement | None = None
    """What the task says of it, for the log; None where there is no task. No policy
    looks at it.
    """
    # (H, W, 3) 8-bit values in [0, 1], where it was asked for
    picture: Tensor | None = None
    # what was asked for as "light"; of a sweep's last row of a batch, what was
    # predicted so far
    light: Any = None
    # 0 if its picture was rendered; samples a pixel of what predicted it, 1 of a matrix
    predicted: int = 0
    # JPEG file of the picture of a row of a sweep, where it is kept
    jpeg: bytes | None = None
    # ground truth by name, and notes, where kept
    layers: tuple[Mapping[str, Any], Mapping[str, str]] | None = None
    # Seconds that it took; None where whoever asks has to look at the clock.
    seconds: float | None = None
    # Machine on which it was made, by its name among the workers'; None of one like
    # this.
    machine: str | None = None
    is_lost: bool = False  # whether every worker that tried it died

    @classmethod
    def from_judgement(cls, judgement: Judgement, **more: Any) -> Evaluation:
        """Return the answer to a query without derivative, from what the task says."""
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
        """Return the evaluation as policies see it, without NaN.

        - Gradient elements that are NaN or infinite become zero and are added to
          `non_finite`.
        - An objective that is NaN or infinite becomes -inf ("the worst there is"), its
          gradient zero and its success false.
        """
        evaluation = self._sanitize_gradient()
        if evaluation.is_finite:
            return evaluation
        zero_gradient = None
        if evaluation.gradient is not None:
            zero_gradient = torch.zeros_like(evaluation.gradient)
        return replace(
            evaluation, objective=-math.inf, gradient=zero_gradient, success=False
        )

    def _sanitize_gradient(self) -> Evaluation:
        """Return the evaluation with zeros in place of NaN or infinite gradients.

        The number of elements that were replaced is added to `non_finite`.
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
            non_finite=self.non_finite + n_non_finite,
        )


Evaluate = Callable[[Sequence[Query]], Iterable[Evaluation]]
"""Answers queries, in their order, each when it is asked for; whoever stops asking
leaves the rest undone. Supplied by whoever owns the scene. `functools.partial(map, f)`
makes one of a function of one query.
"""


State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class Proposal:
    """A configuration to evaluate next.

    Attributes:
        u: (d,) float32 inside the domain; the caller must not write to it.
        gradient: whether the policy wants the derivative there: not, all of it
            (`Domain.gradient_cost` more pictures), or what is "free" (only where the
            domain has `partial_gradients`). A wish: the end of a budget gets none.
        step_size: the step that led here in units of each block's radius, for the log;
            NaN where there is none.
        samples: multiple of the search's samples per pixel to render with, at least 1.
            It costs as many times the renders. At the end of a budget it is reduced to
            the renders that are left.
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

        Its `samples` (each costs a render) become `renders_left` at most. Its gradient
        is dropped if no render would be left after it, to use the gradient for.

        Args:
            domain: states how many renders a gradient costs.
            renders_left: number of renders that the budget has left, at least 1.
        """
        proposal = self
        if self.samples > renders_left:
            proposal = replace(self, samples=renders_left)
        if proposal.gradient and proposal.max_cost(domain) >= renders_left:
            return replace(proposal, gradient=False)
        return proposal


@dataclass(frozen=True)
class Counts:
    """What a policy had to do about evaluations, for the summary of a run.

    Attributes:
        cut: gradients of which single elements were outliers and were clipped
            (`pgd.clip_gradient`).
        shortened: gradients that were too long and were scaled down.
        rejected: steps that were taken back.
    """

    cut: int = 0
    shortened: int = 0
    rejected: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.cut + other.cut,
            self.shortened + other.shortened,
            self.rejected + other.rejected,
        )


NO_COUNTS = Counts()


Evaluated = Sequence[tuple[Tensor, Evaluation]]
"""Configurations (d,) with their evaluations, in the order in which they were proposed.
"""


class Policy(ABC, Generic[State]):
    """Proposes configurations, in batches. Write a new one by implementing the three
    methods below.

    Its `name` is for messages and the log. One that `handles_choices` searches discrete
    choices (`Block.options`) itself; any other is wrapped in `Choices` by `search`, so
    that it never sees any. Its options are the fields of a dataclass; what is outside
    their range is an InputError when it is made, and a domain that it cannot search (of
    too many numbers, say) when it starts.
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
        # the arguments of which the methods get copies: `domain` of `start`, without the
        # generator, which has to advance; `evaluated` of `update`
        hand_copies(cls, start=slice(1), update=slice(1, None))

    @property
    @abstractmethod
    def uses_gradient(self) -> bool:
        """Whether it ever asks for a gradient. A class where that is fixed just sets
        the attribute.
        """

    @abstractmethod
    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> State:
        """Return the state before the first proposal.

        Args:
            domain: where to search; begin at `domain.initial_point`.
            generator: the search's source of randomness, to draw a seed from; use
                `seeded` for numbers later on.
            steps: how many renders there will be at most, those of gradients included:
                a plan for schedules, never to be counted on.
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
            the objective is flat. With another n, a policy must propose the same
            configurations in the same order, if all of them are passed to `update`.
        """

    @abstractmethod
    def update(self, state: State, evaluated: Evaluated) -> State:
        """Return the state after the latest proposals were evaluated.

        They are all of these, in their order; where the budget ends, the first of them.
        Every evaluation is as `Evaluation.sanitize` leaves it: its gradient (None where
        it was not asked for or could not be paid) is finite, and its objective is
        finite or -inf, which stands for "could not be evaluated". The objective is
        noisy: the same u with another seed gives another value, and a maximum over many
        is biased upwards.
        """

    def takes_differences(self, domain: Domain, steps: int) -> bool:
        """Return whether, in `steps` renders, it may ask for gradients of a domain that
        cost renders.
        """
        return self.uses_gradient and domain.gradient_cost > 0

    def counts(self, state: State) -> Counts:
        """Return what the policy did about the evaluations so far; nothing where it
        takes them as they come.
        """
        return NO_COUNTS

    def distribution(self, state: State) -> Distribution | None:
        """Return the distribution that the search has reached, where that is its result
        beside the best configuration that it met; None where there is none (yet).
        """
        return None

    def failures(self, state: State) -> Failures | None:
        """Return the different failures that the policy has met, if it looks for more
        than one.
        """
        return None


def draw_seed(generator: torch.Generator) -> int:
    """Draw a seed for `seeded` from the search's generator."""
    return int(torch.randint(2**31, (1,), generator=generator))


def seeded(seed: int, number: int) -> torch.Generator:
    """Return the generator for draw `number` of a policy.

    It depends on the seed and the number only.
    """
    return torch.Generator().manual_seed(stream(seed, "policy", number))


@contextmanager
def limit_to_single_thread() -> Iterator[None]:
    """Limit torch to a single thread inside the context.

    This is faster for small matrices, on a busy machine many times so, and the last
    bits do not depend on the number of threads. Setting it costs less than a
    microsecond.
    """
    n_threads_before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(n_threads_before)
